"""After a run: null vectors at the instabilities, the modes that the case requests, natural
frequencies.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import isnan, nan
from pathlib import Path

import numpy as np

from magshell_fenicsx.continuation.modes import ModesNotFound
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.output.fields.gathering import Gatherer, gatherer
from magshell_fenicsx.output.fields.modes import (
    NAME,
    frequency_table,
    hertz,
    mode_file,
    mode_surface,
    mode_table,
    wave_of,
    write_mode,
)
from magshell_fenicsx.output.fields.ring import Waves, waves_around
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.vtu import About
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.folder import by_first
from magshell_fenicsx.problem.wanted import FrequenciesSection, StabilitySection
from magshell_fenicsx.quantities.registry import OWN_MODES
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.shells.mass import Model
from magshell_fenicsx.shells.modes import Seen, ShellMode, ShellModes, seen_on
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.touch import hardened, pressing, rigid

Say = Callable[[str], None]
ROUNDING = 1e-9  # a coordinate over R as small as this is zero
SAME = 1e-3  # relative change of omega^2 by stiffer bodies that needs no warning


def modes_after(result: Result, folder: Path, say: Say) -> None:
    """Write fields/mode_*.vtu and, if the case has a stability section, stability.csv.

    Collective; rank 0 writes. Call it after the run, because it overwrites the model's tangent.

    Raises
    ------
    DiskError
        On every rank, if something cannot be written.
    """
    wanted = result.scene.problem.stability
    if result.singular or (wanted and not result.refused):
        writer = _Writer(result, folder, say)
        writer.null_vectors()
        if wanted:
            writer.modes(wanted)


@dataclass(frozen=True)
class _Writer:
    result: Result
    folder: Path
    say: Say
    _known: dict[int, tuple[ShellModes, Gatherer]] = field(default_factory=dict)
    _seen: dict[int, tuple[Seen, ShellModes, Gatherer]] = field(default_factory=dict)

    def _all_of(self, number: int) -> tuple[Seen, ShellModes, Gatherer]:
        """The same of the model that sees all modes of the shell."""
        scene = self.result.scene_of(number)
        if id(scene) not in self._seen:
            on = seen_on(scene.model)
            self._seen[id(scene)] = on, ShellModes(on.model), gatherer(on.model, scene.comm)
        return self._seen[id(scene)]

    def _of(self, number: int) -> tuple[ShellModes, Gatherer]:
        """The modes of the model of a point, and what gathers them."""
        scene = self.result.scene_of(number)
        if id(scene) not in self._known:
            self._known[id(scene)] = ShellModes(scene.model), gatherer(scene.model, scene.comm)
        return self._known[id(scene)]

    def null_vectors(self) -> None:
        for number, state in self.result.singular.items():
            row, scene = self.result.rows[number], self.result.scene_of(number)
            label = "" if row["mode"] in OWN_MODES else str(row["mode"])
            try:
                vector = self._of(number)[0].null_vector(state, label)
            except ModesNotFound as e:
                self.say(f"warning: no modes of point {number}: {e}")
                continue
            surface = self._write(number, str(row["label"]), state, label, vector)
            if surface is not None and scene.problem.meridian is None:
                place = surface.r0[np.argmax(np.abs(surface.fields["mode_w"]))]
                exact = np.where(np.abs(place) < ROUNDING, 0.0, place)
                self.result.largest[number] = [float(x) for x in exact * scene.problem.length]
            if surface is not None and not label and (waves := waves_around(surface)):
                self.say(_waves_said(number, waves))

    def modes(self, wanted: StabilitySection) -> None:
        points = self.result.singular
        if wanted.at == "end":
            points = {self.result.end: self.result.last}
        by_point: dict[int, list[ShellMode]] = {}
        for number, state in points.items():
            on, shell, _ = self._all_of(number)
            try:
                loose = self.result.scene_of(number).loose
                lowest = shell.lowest(on.state(state), wanted.modes, loose=loose)
                unstable = sum(mode.eigenvalue < 0 for mode in lowest)
                by_point[number] = lowest[: max(wanted.modes, unstable)]
            except ModesNotFound as e:
                self.say(f"warning: no modes of point {number}: {e}")
        by_first(
            self.result.scene.comm,
            partial(write_whole, self.folder / "stability.csv", mode_table(by_point)),
        )
        for number, modes in by_point.items():
            for n, mode in enumerate(modes[: wanted.modes], 1):
                file = mode_file(self.folder, number, str(n), mode.label)
                on, _, gathering = self._all_of(number)
                state, scene = on.state(points[number]), self.result.scene_of(number)
                write_mode_of(scene, gathering, file, state, mode.label, mode.vector, on)
            first = modes[0]
            self.say(
                f"lowest stiffness at point {number}: {first.eigenvalue:.6g} E h/R^2  {first.label}".rstrip()
            )

    def _write(
        self, number: int, name: str, state: State, label: str, vector: Vector
    ) -> Surface | None:
        file = mode_file(self.folder, number, name, label)
        return write_mode_of(
            self.result.scene_of(number), self._of(number)[1], file, state, label, vector
        )


def _waves_said(point: int, waves: Waves) -> str:
    """How many waves a null vector has, with a warning where its mesh does not resolve them."""
    m, largest = waves.number, waves.largest
    if waves.resolved:
        return f"the null vector at point {point} has {m} waves around e3"
    return f"warning: the null vector at point {point} has {m} waves around e3, and the mesh resolves {largest}"


def write_mode_of(
    scene: Scene,
    gatherer: Gatherer,
    file: Path,
    state: State,
    label: str,
    vector: Vector,
    on: Seen | None = None,
) -> Surface | None:
    """Write a mode at a state, both of the model where it is seen, and return it on rank 0;
    collective.
    """
    model = on.model if on else scene.model
    surface = mode_surface(model, gatherer, state.u, label, vector, scene.problem.azimuth, state.mu)

    def write() -> None:
        assert surface is not None
        write_mode(file, surface, About(scene.problem.material.h, scene.problem.material.nu))

    by_first(scene.comm, write)
    return surface


def wanted(section: FrequenciesSection | None, point: int) -> bool:
    """Whether the state of a point must be kept for its frequencies; the start and the end are
    known anyway.
    """
    at = section.at if section else ()
    return at == "all" or (isinstance(at, list) and point in at)


def own_wave(model: Model) -> str:
    """The wave of the model's own modes."""
    if model.axisymmetric:
        return "0"
    return "symmetric" if model.multiplicity > 1 else ""


def contact_changes(scene: Scene, state: State, modes: Sequence[ShellMode]) -> list[float]:
    """How much omega^2 of each mode changes, relative, if the bodies that touch are four times as
    stiff; collective.

    It is compared with the nearest one of the same label: a mode that is not there any more changes
    too. nan, if the shell finds no such equilibrium near.
    """
    bodies = pressing(scene, state)
    if not bodies:
        return [0.0] * len(modes)
    harder = hardened(scene, state, bodies)
    if harder is None:
        return [nan] * len(modes)
    on = seen_on(scene.model)
    others = ShellModes(on.model).vibrations(on.state(harder), len(modes) + 2)
    return [
        min(
            (abs(o.eigenvalue / mode.eigenvalue - 1) for o in others if o.label == mode.label),
            default=1.0,
        )
        for mode in modes
    ]


def _soft(point: int, n: int, mode: ShellMode, change: float) -> str:
    """The warning for a mode that depends on the penalty of a contact."""
    by = (
        "no equilibrium near to compare with"
        if isnan(change)
        else f"omega2 changes by {change:.2g} of it"
    )
    return (
        f"warning: frequency {n} of point {point} (omega2 {mode.eigenvalue:.6g}) depends on the stiffness of the "
        f"bodies: four times as stiff, {by}"
    )


def frequencies_after(result: Result, folder: Path | None, say: Say) -> None:
    """Keep the modes; with a folder write frequencies.csv, and fields/mode_*_f*.vtu of the first
    and the last point.

    Collective; rank 0 writes. Call it after the run, because it overwrites the model's tangent.

    Raises
    ------
    DiskError
        On every rank, if something cannot be written.
    """
    section, scene = result.scene.problem.frequencies, result.scene
    if section is None or result.refused:
        return
    if scene.model.without_potential and scene.problem.loads.pressure:
        say(
            "warning: a pressure at a free edge has no potential: frequencies are those of the symmetric tangent"
        )
    states = dict(sorted(result.kept.items()))
    if section.at in ("ends", "end"):
        start = {0: scene.unloaded()} if section.at == "ends" else {}
        states = {**start, result.end: result.last}
    elif isinstance(section.at, list) and (strange := sorted(set(section.at) - set(states))):
        say(f"warning: frequencies.at: the path has no point {', '.join(map(str, strange))}")
    own, unit = dict[int, str](), scene.problem.time_unit
    of, seen = dict[int, tuple[Seen, ShellModes]](), dict[int, Seen]()
    for number, state in states.items():
        scene = result.scene_of(number)
        if id(scene) not in of:
            on = seen_on(scene.model)
            of[id(scene)] = on, ShellModes(on.model)
        on, shell = of[id(scene)]
        seen[number], own[number] = on, own_wave(on.model)
        state = rigid(scene, state)
        try:
            result.frequencies[number] = modes = shell.vibrations(
                on.state(state), section.count, loose=scene.loose
            )
            if scene.model.contacts:
                result.contact_changes[number] = changes = contact_changes(scene, state, modes)
                for n, (mode, change) in enumerate(zip(modes, changes, strict=True), 1):
                    if not change <= SAME:
                        say(_soft(number, n, mode, change))
        except ModesNotFound as e:
            say(f"warning: no frequencies of point {number}: {e}")
            continue
        rigid_modes = [mode for mode in modes if mode.eigenvalue == 0.0] if scene.loose else []
        motions = sum(
            2 if mode.label.startswith("m = ") else 1 for mode in rigid_modes
        )  # a wave has a twin
        free = f"{motions} rigid motions, " if motions else ""
        first = modes[min(len(rigid_modes), len(modes) - 1)]
        f, wave = hertz(first.eigenvalue, unit), wave_of(first.label, own[number])
        in_hertz = "" if f is None else f", {f:.6g} Hz"
        of_mode = f", m = {wave}" if wave.isdigit() else wave and f", {wave}"
        say(
            f"{free}lowest frequency at point {number}: omega2 {first.eigenvalue:.6g}{in_hertz}{of_mode}"
        )
    if folder is None:
        return
    content = frequency_table(result.frequencies, own, unit, result.contact_changes)
    by_first(scene.comm, partial(write_whole, folder / NAME, content))
    for number in {*list(states)[:1], *list(states)[-1:]} & set(result.frequencies):
        scene = result.scene_of(number)
        on = seen[number]
        gathering, state = gatherer(on.model, scene.comm), on.state(states[number])
        for n, mode in enumerate(result.frequencies[number][: section.count], 1):
            file = mode_file(folder, number, f"f{n}", mode.label)
            write_mode_of(scene, gathering, file, state, mode.label, mode.vector, on)
