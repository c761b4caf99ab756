"""After a run: the null vectors of its instabilities, and the modes that the case asks for."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from magshell_fenicsx.case.stability import StabilitySection
from magshell_fenicsx.results.durable import write_whole
from magshell_fenicsx.results.folder import by_first
from magshell_fenicsx.results.gathering import Gatherer, gatherer
from magshell_fenicsx.results.modes import caption, mode_file, mode_surface, mode_table, wave_number, write_mode
from magshell_fenicsx.results.picture import draw_modes
from magshell_fenicsx.results.summary import Result
from magshell_fenicsx.results.surface import Surface
from magshell_fenicsx.results.table import OWN_MODES, VALUE_COLUMN, Row
from magshell_fenicsx.solve.stability import ModesNotFound
from magshell_fenicsx.solve.system import State, Vector
from magshell_fenicsx.stability import ShellMode, ShellModes

Say = Callable[[str], None]
SYMBOLS = {"pressure": r"$p/p_\mathrm{c}$", "force": r"$FR/2\pi D$", "lambda_m": r"$\lambda_\mathrm{m}$"}
MOST_PANELS = 9


def modes_after(result: Result, folder: Path, say: Say) -> None:
    """Write fields/mode_*.vtu, instabilities.png and, if the case has a stability section, modes_*.png, stability.csv.

    Every rank calls, rank 0 writes. The run must be over: the model's tangent is overwritten.

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
        panels = []
        for number, state in self.result.singular.items():
            row = self.result.rows[number]
            label = "" if row["mode"] in OWN_MODES else str(row["mode"])
            surface = self._write(number, str(row["label"]), state, label, shell.null_vector(state, label))
            told = str(row["mode"]) if row["mode"] else ""
            if surface is not None and not label and (m := wave_number(surface)):
                told = f"{told}, m = {m}".lstrip(", ")
                self.say(f"the null vector at point {number} has {m} waves around e3")
            kind = f" ({told})" if told else ""
            panels.append((surface, f"{row['label']}{kind}, {_where(row)}"))
        if panels:
            self._draw(panels, f"Null vectors at instabilities\n{_shell(self.result)}", "instabilities.png")

    def modes(self, shell: ShellModes, wanted: StabilitySection) -> None:
        points = self.result.singular
        if wanted.at == "end":
            points = {len(self.result.rows) - 1: self.result.last}
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
            row, state = self.result.rows[number], points[number]
            panels = [
                (self._write(number, str(n), state, mode.label, mode.vector), caption(n, mode))
                for n, mode in enumerate(modes[: wanted.modes], 1)
            ]
            unit = r"stiffness per area $\lambda$ of each mode in $E h/R^2$"
            self._draw(panels, f"{_shell(self.result)}, {_where(row)}\n{unit}", f"modes_{number:04d}.png")
            first = modes[0]
            self.say(f"lowest stiffness at point {number}: {first.eigenvalue:.6g} E h/R^2  {first.label}".rstrip())

    def _write(self, number: int, name: str, state: State, label: str, vector: Vector) -> Surface | None:
        scene = self.result.scene
        surface = mode_surface(scene.model, self.gatherer, state.u, label, vector, scene.plan.azimuth)

        def write() -> None:
            assert surface is not None
            write_mode(mode_file(self.folder, number, name, label), surface, scene.plan.material.h)

        by_first(scene.comm, write)
        return surface

    def _draw(self, panels: Sequence[tuple[Surface | None, str]], title: str, name: str) -> None:
        def write() -> None:
            surfaces = [surface for surface, _ in panels[:MOST_PANELS] if surface is not None]
            try:
                write_whole(self.folder / name, draw_modes(surfaces, [said for _, said in panels], title))
            except RuntimeError as e:
                self.say(f"warning: no picture {name}: {e}")

        by_first(self.result.scene.comm, write)


def _shell(result: Result) -> str:
    case = result.scene.case
    said = f"$R/h$ = {case.shell.R_over_h:g}, $\\nu$ = {case.shell.poisson_ratio:g}"
    return said + (f", $\\lambda_\\mathrm{{m}}$ = {case.lambda_m:g}" if case.lambda_m else "")


def _where(row: Row) -> str:
    amplitude = str(row["amplitude"])
    value = f": {SYMBOLS[amplitude]} = {row[VALUE_COLUMN[amplitude]]:.5g}" if amplitude in SYMBOLS else ""
    return f"point {row['point']}{value}"
