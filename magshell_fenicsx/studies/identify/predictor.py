"""Predictions of a case for values of its parameters; each evaluation is stored in a folder.

Parameters are a vector x (p,): numbers of the case, in the units of its file, then the numbers of
a remanence field. A reading is a result of the case at a place, a value of what its last step
prescribes. Settings are assignments `key=value`, which make a case of each row of data. A slope is
a derivative by the parameters.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from dataclasses import field as field_of
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError, Source, override
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.output.store.folder import access_disk
from magshell_fenicsx.simulate.gradients.instabilities import LostResult
from magshell_fenicsx.simulate.readings import PlaceOutsidePath, Reading, UnreadPlace, read
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.design.blocks import NumberVariable
from magshell_fenicsx.studies.identify.parameters import Parameter
from magshell_fenicsx.studies.identify.remanence_field import NAME, RemanenceField
from magshell_fenicsx.studies.points import MakeCase
from magshell_fenicsx.studies.store import OutcomeStore

Array = NDArray[np.float64]
Settings = tuple[str, ...]


@dataclass
class PredictedReadings:
    """Readings predicted for a vector of parameters; empty if there is a note.

    Attributes
    ----------
    values, slopes
        (n,) and (n, p), in the units of data and parameters.
    curves
        Result -> places and values along the path, of the case with the first settings.
    note
        Why nothing is predicted; "" otherwise.
    invalid
        Whether nothing is predicted because data are outside the path or the case is not valid.
    """

    values: list[float] = field_of(default_factory=list)
    slopes: list[list[float]] = field_of(default_factory=list)
    curves: dict[str, list[tuple[float, float]]] = field_of(default_factory=dict)
    note: str = ""
    invalid: bool = False


@dataclass
class Predictor:
    """Predicts readings for vectors of parameters, and keeps the predictions; collective.

    Attributes
    ----------
    source
        The identified case.
    make_case
        Makes a case of its source.
    parameters
        Numbers of the case that are identified, the first ones of a vector x.
    readings
        Settings of the case -> results and places that are read.
    folder
        Folder of the identification.
    mark
        Text that determines the case, so that stored predictions of another case are not used.
    field
        The remanence that is identified; its numbers follow the parameters.
    rows
        Settings of the case -> where each reading there stands in the data, for messages.
    count
        Number of predictions that were computed, not stored.
    """

    source: Source
    make_case: MakeCase
    parameters: Sequence[Parameter]
    readings: dict[Settings, list[Reading]]
    folder: Path
    mark: str
    comm: MPI.Intracomm
    field: RemanenceField | None = None
    rows: Mapping[Settings, Sequence[str]] = field_of(default_factory=dict)
    count: int = 0

    def __call__(self, x: Array, *, slopes: bool = True) -> PredictedReadings:
        """Return the prediction for parameters x (p,), stored or newly computed; collective.

        Parameters
        ----------
        slopes
            Whether derivatives by the parameters are computed too.
        """
        # all ranks take the parameters of rank 0
        x = np.array(self.comm.bcast(x))
        settings_and_readings = json.dumps(
            [[settings, _as_data(readings)] for settings, readings in self.readings.items()]
        )
        # the name of the file is a hash of the parameters and of all that a prediction depends on
        text = f"{self.mark} {settings_and_readings} {slopes}".encode()
        name = hashlib.sha256(x.tobytes() + text).hexdigest()[:16]
        store = OutcomeStore(self.folder / "points", PredictedReadings)
        vectors = store.folder / f"{name}.csv"

        def compute() -> PredictedReadings:
            """Compute the prediction on all ranks together."""
            self.count += 1
            if self.field:
                access_disk(self.comm, lambda: self.write(x, vectors))
            return PredictedReadings(**self.comm.bcast(asdict(self._predict(x, slopes, vectors))))

        return store.obtain(name, compute, self.comm)

    def write(self, x: Array, vectors: Path) -> None:
        """Write the vectors of the remanence for parameters x into a file; called on rank 0."""
        assert self.field
        vectors.parent.mkdir(parents=True, exist_ok=True)
        self.field.write(x[len(self.parameters) :], vectors)

    def _predict(self, x: Array, slopes: bool, vectors: Path) -> PredictedReadings:
        """Compute the readings for parameters x with all settings; collective.

        Parameters
        ----------
        vectors
            File with the vectors of the remanence, if a field is identified.
        """
        prediction = PredictedReadings()
        parameter_keys = [parameter.key for parameter in self.parameters]
        for settings, requested in self.readings.items():
            try:
                scene = self._scene(x, settings, vectors)
                # name of the field -> its number of values, and the function that gives the
                # derivatives by them
                field = self.field
                fields = (
                    {NAME: (field.start_values.size, partial(field.derivatives, scene))}
                    if field
                    else None
                )
                readings = read(scene, requested, parameter_keys, slopes=slopes, fields=fields)
            except (LostResult, CaseError, MeshError) as e:
                message_parts = [self._row_of(e, settings), ", ".join(settings), str(e)]
                note = ": ".join(filter(None, message_parts))
                return PredictedReadings(
                    note=note,
                    invalid=not isinstance(e, LostResult) or isinstance(e, PlaceOutsidePath),
                )
            prediction.values += [float(v) for v in readings.values]
            # derivatives by numbers in SI units become those by parameters, which are in the units
            # of the case; numbers of a field have no unit
            unit_sizes = self._unit_sizes(x)
            unit_sizes += [1.0] * (readings.slopes.shape[1] - len(unit_sizes))
            prediction.slopes += [list(map(float, row)) for row in readings.slopes * unit_sizes]
            prediction.curves = prediction.curves or readings.curves
        return prediction

    def _unit_sizes(self, x: Array) -> list[float]:
        """Return the size of each parameter's unit in SI units.

        It is the derivative of the number in SI units by the parameter.
        """
        # None stands for the scene, which a number does not need
        slopes_of_keys = (
            parameter.number.gradient(x, None, {parameter.key: 1.0})  # type: ignore[arg-type]
            for parameter in self.parameters
        )
        return [float(slope[0]) for slope in slopes_of_keys]

    def _row_of(self, error: Exception, settings: Settings) -> str:
        """Return file and line of the datum whose place is not reached; empty for another error."""
        if not isinstance(error, UnreadPlace):
            return ""
        rows = zip(self.rows.get(settings, ()), self.readings[settings], strict=False)
        return next((row for row, reading in rows if reading.at == error.place), "")

    def source_at(self, x: Array, base: Source, vectors: Path) -> Source:
        """Return a case with parameters x.

        Parameters
        ----------
        base
            The identified case, or another one with the same keys.
        vectors
            File with the vectors of the remanence, if a field is identified.
        """
        source = source_with_numbers(
            base, [parameter.number for parameter in self.parameters], x[: len(self.parameters)]
        )
        if self.field:
            self.field.put(source.data, vectors)
        return source

    def _scene(self, x: Array, settings: Settings, vectors: Path) -> Scene:
        """Return the scene, a model with its solver, for parameters x and settings; collective."""
        source = self.source_at(x, self.source, vectors)
        for setting in settings:
            override(source, setting)
        return Scene(self.make_case(source).problem(), self.comm)


def _as_data(readings: Sequence[Reading]) -> list[dict[str, Any]]:
    """Return readings as plain data."""
    return [asdict(reading) for reading in readings]


def source_with_numbers(source: Source, numbers: Sequence[NumberVariable], x: Array) -> Source:
    """Return the source of a case with other values of some numbers, and without `identify`.

    Parameters
    ----------
    x
        Values in the order and in the units of `numbers`.
    """
    data = json.loads(json.dumps(source.data))  # a deep copy of plain data
    data.pop("identify", None)
    for number, value in zip(numbers, x, strict=True):
        number.put(data, np.array([value]))
    return Source(source.name, data, folder=source.folder, files=source.files)
