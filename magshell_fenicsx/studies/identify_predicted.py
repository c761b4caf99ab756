"""What a case predicts for values of its parameters; each evaluation is kept in a folder."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from dataclasses import field as field_of
from functools import partial
from pathlib import Path

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from pydantic import TypeAdapter

from magshell_fenicsx.input.source import CaseError, Source, override
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.output.store.folder import by_first
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.platform.processes import from_first
from magshell_fenicsx.simulate.gradients.instabilities import Lost
from magshell_fenicsx.simulate.readings import NotRead, Outside, Reading, read
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.design_blocks import Number
from magshell_fenicsx.studies.identify_data import Parameter
from magshell_fenicsx.studies.identify_field import NAME, RemanenceField
from magshell_fenicsx.studies.runner import Made, keep, kept

Array = NDArray[np.float64]
Settings = tuple[str, ...]


@dataclass
class Seen:
    """What is predicted for a vector of parameters; with a note there is nothing.

    Attributes
    ----------
    values, slopes
        (n,) and (n, p), in the units of data and parameters.
    curves
        Result -> places and values along the path, of the case without settings of rows.
    invalid
        Whether there is nothing as data are outside the path, or the case is none.
    """

    values: list[float] = field_of(default_factory=list)
    slopes: list[list[float]] = field_of(default_factory=list)
    curves: dict[str, list[tuple[float, float]]] = field_of(default_factory=dict)
    note: str = ""
    invalid: bool = False


@dataclass
class Predictor:
    """Predicts readings for vectors of parameters; collective.

    Attributes
    ----------
    readings
        Settings of the case -> what is read there.
    field
        The remanence that is looked for; its numbers follow the parameters.
    rows
        Settings of the case -> where each reading there stands in the data, for messages.
    """

    source: Source
    made: Made
    parameters: Sequence[Parameter]
    readings: dict[Settings, list[Reading]]
    folder: Path
    mark: str
    comm: MPI.Intracomm
    field: RemanenceField | None = None
    rows: Mapping[Settings, Sequence[str]] = field_of(default_factory=dict)
    count: int = 0

    def __call__(self, x: Array, *, slopes: bool = True) -> Seen:
        """What is predicted, known or new."""
        x = np.array(self.comm.bcast(x))
        listed = json.dumps(
            [[settings, [asdict(each) for each in of]] for settings, of in self.readings.items()]
        )
        text = f"{self.mark} {listed} {slopes}".encode()
        file = (
            self.folder / "points" / f"{hashlib.sha256(x.tobytes() + text).hexdigest()[:16]}.json"
        )
        seen = from_first(
            self.comm, lambda: kept(file, TypeAdapter(Seen), "seen", sources=code_version())
        )
        if seen is None:
            vectors = file.with_suffix(".csv")
            if self.field:
                by_first(self.comm, lambda: self.write(x, vectors))
            seen = Seen(**self.comm.bcast(asdict(self._new(x, slopes, vectors))))
            self.count += 1
            from_first(
                self.comm, lambda: keep(file, {"sources": code_version(), "seen": asdict(seen)})
            )
        return seen

    def write(self, x: Array, vectors: Path) -> None:
        """Write the vectors of a field."""
        assert self.field
        vectors.parent.mkdir(parents=True, exist_ok=True)
        self.field.write(x[len(self.parameters) :], vectors)

    def _new(self, x: Array, slopes: bool, vectors: Path) -> Seen:
        seen, keys = Seen(), [each.key for each in self.parameters]
        for settings, wanted in self.readings.items():
            try:
                scene = self._scene(x, settings, vectors)
                field = self.field
                fields = {NAME: (field.first.size, partial(field.by, scene))} if field else None
                readings = read(scene, wanted, keys, slopes=slopes, fields=fields)
            except (Lost, CaseError, MeshError) as e:
                about = [self._row_of(e, settings), ", ".join(settings), str(e)]
                note = ": ".join(filter(None, about))
                return Seen(note=note, invalid=not isinstance(e, Lost) or isinstance(e, Outside))
            seen.values += [float(v) for v in readings.values]
            # the number of a key needs no scene
            slopes_of_keys = (
                each.number.gradient(x, None, {each.key: 1.0})  # type: ignore[arg-type]
                for each in self.parameters
            )
            sizes = [float(slope[0]) for slope in slopes_of_keys]
            sizes += [1.0] * (readings.slopes.shape[1] - len(sizes))
            seen.slopes += [list(map(float, row)) for row in readings.slopes * sizes]
            seen.curves = seen.curves or readings.curves
        return seen

    def _row_of(self, error: Exception, settings: Settings) -> str:
        """Where the place that is not reached stands in the data; empty of another error."""
        if not isinstance(error, NotRead):
            return ""
        rows = zip(self.rows.get(settings, ()), self.readings[settings], strict=False)
        return next((row for row, reading in rows if reading.at == error.place), "")

    def source_at(self, x: Array, base: Source, vectors: Path) -> Source:
        """A case, this or another one, for a vector of parameters; those of a field are in a file."""
        source = varied(base, [each.number for each in self.parameters], x[: len(self.parameters)])
        if self.field:
            self.field.put(source.data, vectors)
        return source

    def _scene(self, x: Array, settings: Settings, vectors: Path) -> Scene:
        source = self.source_at(x, self.source, vectors)
        for setting in settings:
            override(source, setting)
        return Scene(self.made(source).problem(), self.comm)


def varied(source: Source, numbers: Sequence[Number], x: Array) -> Source:
    """The source of a case with other numbers."""
    data = json.loads(json.dumps(source.data))
    data.pop("identify", None)
    for number, value in zip(numbers, x, strict=True):
        number.put(data, np.array([value]))
    return Source(source.name, data, folder=source.folder, files=source.files)
