"""After a run: null vectors at the instabilities, and the modes that the case requests."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from magshell_fenicsx.continuation.modes import ModesNotFound
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.models.modes import ShellMode, ShellModes
from magshell_fenicsx.output.fields.gathering import Gatherer, gatherer
from magshell_fenicsx.output.fields.modes import mode_file, mode_surface, mode_table, wave_number, write_mode
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.vtu import About
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.folder import by_first
from magshell_fenicsx.problem.wanted import StabilitySection
from magshell_fenicsx.quantities.registry import OWN_MODES
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.simulate.scene import Scene

Say = Callable[[str], None]
ROUNDING = 1e-9  # a coordinate over R as small as this is zero


def modes_after(result: Result, folder: Path, say: Say) -> None:
    """Write fields/mode_*.vtu and, if the case has a stability section, stability.csv.

    Collective; rank 0 writes. Call it after the run, because it overwrites the model's tangent.

    Raises
    ------
    DiskError
        On every rank, if something cannot be written.
    """
    scene, wanted = result.scene, result.scene.case.stability
    if result.singular or wanted:
        writer = _Writer(result, folder, say, gatherer(scene.model, scene.comm))
        shell = ShellModes(scene.model)
        writer.null_vectors(shell)
        if wanted:
            writer.modes(shell, wanted)


@dataclass(frozen=True)
class _Writer:
    result: Result
    folder: Path
    say: Say
    gatherer: Gatherer

    def null_vectors(self, shell: ShellModes) -> None:
        for number, state in self.result.singular.items():
            row = self.result.rows[number]
            label = "" if row["mode"] in OWN_MODES else str(row["mode"])
            try:
                vector = shell.null_vector(state, label)
            except ModesNotFound as e:
                self.say(f"warning: no modes of point {number}: {e}")
                continue
            surface = self._write(number, str(row["label"]), state, label, vector)
            if surface is not None and self.result.scene.plan.meridian is None:
                place = surface.r0[np.argmax(np.abs(surface.fields["mode_w"]))]
                exact = np.where(np.abs(place) < ROUNDING, 0.0, place)
                self.result.largest[number] = [float(x) for x in exact * self.result.scene.plan.length]
            if surface is not None and not label and (m := wave_number(surface)):
                self.say(f"the null vector at point {number} has {m} waves around e3")

    def modes(self, shell: ShellModes, wanted: StabilitySection) -> None:
        points = self.result.singular
        if wanted.at == "end":
            points = {self.result.end: self.result.last}
        found: dict[int, list[ShellMode]] = {}
        for number, state in points.items():
            try:
                lowest = shell.lowest(state, wanted.modes)
                unstable = sum(mode.eigenvalue < 0 for mode in lowest)
                found[number] = lowest[: max(wanted.modes, unstable)]
            except ModesNotFound as e:
                self.say(f"warning: no modes of point {number}: {e}")
        by_first(self.result.scene.comm, partial(write_whole, self.folder / "stability.csv", mode_table(found)))
        for number, modes in found.items():
            for n, mode in enumerate(modes[: wanted.modes], 1):
                self._write(number, str(n), points[number], mode.label, mode.vector)
            first = modes[0]
            self.say(f"lowest stiffness at point {number}: {first.eigenvalue:.6g} E h/R^2  {first.label}".rstrip())

    def _write(self, number: int, name: str, state: State, label: str, vector: Vector) -> Surface | None:
        file = mode_file(self.folder, number, name, label)
        return write_mode_of(self.result.scene, self.gatherer, file, state, label, vector)


def write_mode_of(
    scene: Scene, gatherer: Gatherer, file: Path, state: State, label: str, vector: Vector
) -> Surface | None:
    """Write a mode at a state, and return it on rank 0; collective."""
    surface = mode_surface(scene.model, gatherer, state.u, label, vector, scene.plan.azimuth, state.mu)

    def write() -> None:
        assert surface is not None
        write_mode(file, surface, About(scene.plan.material.h, scene.plan.material.nu))

    by_first(scene.comm, write)
    return surface
