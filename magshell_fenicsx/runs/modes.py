"""Modes after a run: null vectors at the instabilities, requested modes, natural frequencies.

A null vector is the mode of an instability, which has no stiffness. A point of the path is known by
the number of its row in path.csv. A scene is the model of a problem with its solver. A model that
is reduced by symmetry (a half, a sector, a meridian) excludes modes; the whole shell is the model
that has all. The label of a mode names its symmetry, such as "m = 2" or "antisymmetric"; it is
empty for a mode of the model itself. omega2 is omega^2 rho R^2/E. E, h, R and rho are Young's
modulus, thickness, reference length and density. A gatherer brings the fields of all ranks to
rank 0. `say` prints a line of text.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import isnan, nan
from pathlib import Path

import numpy as np

from magshell_fenicsx.continuation.modes import ModesNotFound
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.output.fields.gathering import Gatherer, gatherer
from magshell_fenicsx.output.fields.mode_fields import (
    NAME,
    frequency_table,
    hertz,
    mode_file,
    mode_surface,
    mode_table,
    wave_of,
    write_mode,
)
from magshell_fenicsx.output.fields.ring import WaveCount, waves_around
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.vtu import ShellData
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.folder import access_disk
from magshell_fenicsx.problem.requests import FrequenciesSection, StabilitySection
from magshell_fenicsx.quantities.mode_labels import waves_of_label
from magshell_fenicsx.quantities.registry import OWN_MODES
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.shells.mass import Model
from magshell_fenicsx.shells.modes import ModeSpace, ShellMode, ShellModes, mode_space
from magshell_fenicsx.simulate.contact_control import (
    stiffened_equilibrium,
    touching_bodies,
    with_stiffer_bodies,
)
from magshell_fenicsx.simulate.discretisation_error import frequency_errors
from magshell_fenicsx.simulate.scene import Scene

Say = Callable[[str], None]
ROUNDING = 1e-9  # over R: a smaller coordinate is zero
MAX_CONTACT_CHANGE = 1e-3  # relative, of omega^2 by stiffer bodies, without a warning
FURTHER_MODES = 2  # that are computed with stiffer bodies, to find each mode again


def modes_after(result: Result, folder: Path, say: Say) -> None:
    """Write fields/mode_*.vtu and, if the case has a stability section, stability.csv.

    Collective; rank 0 writes. Call it after the run, because it overwrites the model's tangent.

    Parameters
    ----------
    folder
        Folder of the run.
    say
        Function that prints a line.

    Raises
    ------
    DiskError
        On every rank, if something cannot be written.
    """
    section = result.scene.problem.stability
    has_requested_modes = section is not None and not result.is_refused
    if result.singular or has_requested_modes:
        writer = _ModeWriter(result, folder, say)
        writer.null_vectors()
        if section:
            writer.modes(section)


@dataclass(frozen=True)
class _ModeWriter:
    """Writer of the modes of a run; the solvers of each scene are made once. Collective.

    Attributes
    ----------
    result
        The run; a row may have a scene (model and solver) of its own.
    folder
        Folder of the run.
    say
        Function that prints a line.
    _model_modes, _whole_shell_modes
        Id of a scene -> what was made for it: solvers, and gatherers of fields.
    """

    result: Result
    folder: Path
    say: Say
    _model_modes: dict[int, tuple[ShellModes, Gatherer]] = field(default_factory=dict)
    _whole_shell_modes: dict[int, tuple[ModeSpace, ShellModes, Gatherer]] = field(
        default_factory=dict
    )

    def _modes_of_whole_shell(self, number: int) -> tuple[ModeSpace, ShellModes, Gatherer]:
        """Return the solvers for all modes of the shell at the point of a row.

        The model of the point may be reduced by symmetry, and then excludes modes.

        Parameters
        ----------
        number
            Number of the row.

        Returns
        -------
        mode_space
            The model that has all modes, and the map of states to it.
        modes
            The solver for modes of that model.
        gathering
            The gatherer of fields of that model on rank 0.
        """
        scene = self.result.scene_of(number)
        if id(scene) not in self._whole_shell_modes:
            whole_shell = mode_space(scene.model)
            self._whole_shell_modes[id(scene)] = (
                whole_shell,
                ShellModes(whole_shell.model),
                gatherer(whole_shell.model, scene.comm),
            )
        return self._whole_shell_modes[id(scene)]

    def _modes_of(self, number: int) -> tuple[ShellModes, Gatherer]:
        """Return the solver for modes of the model of a row, and the gatherer of its fields."""
        scene = self.result.scene_of(number)
        if id(scene) not in self._model_modes:
            self._model_modes[id(scene)] = (
                ShellModes(scene.model),
                gatherer(scene.model, scene.comm),
            )
        return self._model_modes[id(scene)]

    def null_vectors(self) -> None:
        """Write the null vectors at the located instabilities, and print how many waves they have.

        The places where they are largest are kept in the result.
        """
        for number, state in self.result.singular.items():
            row, scene = self.result.rows[number], self.result.scene_of(number)
            # `symmetric` and `asymmetric` are modes of the model itself, without a label
            label = "" if row["mode"] in OWN_MODES else str(row["mode"])
            try:
                solver, _ = self._modes_of(number)
                vector = solver.null_vector(state, label)
            except ModesNotFound as e:
                self.say(f"warning: no modes of point {number}: {e}")
                continue
            surface = self._write(number, str(row["label"]), state, label, vector)
            # on rank 0, of a surface: the place where the mode is largest
            if surface is not None and scene.problem.meridian is None:
                place = surface.r0[np.argmax(np.abs(surface.fields["mode_w"]))]
                rounded_place = np.where(np.abs(place) < ROUNDING, 0.0, place)
                self.result.mode_places[number] = [
                    float(x) for x in rounded_place * scene.problem.length
                ]
            if surface is None or label:
                continue
            # on rank 0, of a mode of the model itself: the number of waves, if it has any
            if waves := waves_around(surface):
                self.say(_waves_message(number, waves, str(row["label"])))

    def modes(self, section: StabilitySection) -> None:
        """Write the modes of least stiffness that a stability section requests, and stability.csv.

        Unstable modes beyond the requested number are listed in stability.csv as well.
        """
        # number of a row -> state, of the points at which modes are requested
        points = self.result.singular
        if section.at == "end":
            points = {self.result.end: self.result.last}
        # the modes of each point
        by_point: dict[int, list[ShellMode]] = {}
        for number, state in points.items():
            whole_shell, shell, _ = self._modes_of_whole_shell(number)
            try:
                allows_rigid_motion = self.result.scene_of(number).allows_rigid_motion
                lowest = shell.lowest(
                    whole_shell.state(state), section.modes, allows_rigid_motion=allows_rigid_motion
                )
                # the solver returns the number requested of each family, and all unstable modes
                unstable = sum(mode.eigenvalue < 0 for mode in lowest)
                by_point[number] = lowest[: max(section.modes, unstable)]
            except ModesNotFound as e:
                self.say(f"warning: no modes of point {number}: {e}")
        access_disk(
            self.result.scene.comm,
            partial(write_whole, self.folder / "stability.csv", mode_table(by_point)),
        )
        # a file for each requested mode, and a line about the softest of each point
        for number, modes in by_point.items():
            for mode_number, mode in enumerate(modes[: section.modes], 1):
                file = mode_file(self.folder, number, str(mode_number), mode.label)
                whole_shell, _, gathering = self._modes_of_whole_shell(number)
                state, scene = whole_shell.state(points[number]), self.result.scene_of(number)
                write_mode_of(scene, gathering, file, state, mode.label, mode.vector, whole_shell)
            first_mode = modes[0]
            stiffness = f"{first_mode.eigenvalue:.6g} E h/R^2  {first_mode.label}".rstrip()
            self.say(f"lowest stiffness at point {number}: {stiffness}")

    def _write(
        self, number: int, name: str, state: State, label: str, vector: Vector
    ) -> Surface | None:
        """Write the null vector at a point, and return its surface on rank 0; collective.

        Parameters
        ----------
        number, name
            Number of the point's row, and the middle of the file's name, such as "fold".
        label
            Label of the mode; empty for a mode of the model itself.
        """
        file = mode_file(self.folder, number, name, label)
        _, gathering = self._modes_of(number)
        return write_mode_of(self.result.scene_of(number), gathering, file, state, label, vector)


def _waves_message(point: int, waves: WaveCount, label: str) -> str:
    """Return a message about the waves of a null vector; a warning if they are not resolved.

    `label` says whether the point is a fold or a bifurcation.
    """
    m, largest = waves.number, waves.largest
    if waves.resolved:
        words = f"the null vector at point {point} has {m} waves around e3"
        if label == "fold":
            words += (
                ": most often a bifurcation that the mesh or an imperfection perturbs to a fold"
            )
        return words
    return (
        f"warning: the null vector at point {point} has {m} waves around e3, "
        f"and the mesh resolves {largest}"
    )


def write_mode_of(
    scene: Scene,
    gatherer: Gatherer,
    file: Path,
    state: State,
    label: str,
    vector: Vector,
    whole_shell: ModeSpace | None = None,
) -> Surface | None:
    """Write a mode at a state as a file of VTK, and return its surface on rank 0; collective.

    Parameters
    ----------
    gatherer
        Gatherer of the model that has the mode.
    file
        The file to write.
    state, vector
        State and mode, in the unknowns of that model.
    label
        Label of the mode, such as "m = 2" or "antisymmetric", which tells how the mode continues
        beyond the modelled part; empty if it has the symmetry of the model.
    whole_shell
        The model with all modes of the shell, if it has the mode; None if the scene's model has it.
    """
    model = whole_shell.model if whole_shell else scene.model
    surface = mode_surface(model, gatherer, state.u, label, vector, scene.problem.azimuth, state.mu)

    def write() -> None:
        assert surface is not None
        write_mode(file, surface, ShellData(scene.problem.material.h, scene.problem.material.nu))

    access_disk(scene.comm, write)
    return surface


def keeps_state(section: FrequenciesSection | None, point: int) -> bool:
    """Return whether the state of a point must be kept for its frequencies.

    The states of the start and of the end are known anyway. `point` is the number of its row.
    """
    requested_points = section.at if section else ()
    if requested_points == "all":
        return True
    return isinstance(requested_points, list) and point in requested_points


def symmetric_wave(model: Model) -> str:
    """Return the name of the wave that modes without a label have in a model.

    It is "0" on a meridian, where they do not vary around e3. It is "symmetric" on a half, and
    empty on the whole shell.
    """
    if model.axisymmetric:
        return "0"
    return "symmetric" if model.multiplicity > 1 else ""


def contact_changes(scene: Scene, state: State, modes: Sequence[ShellMode]) -> list[float]:
    """Return by how much stiffer bodies change omega^2 of each mode, relatively; collective.

    The bodies in contact get four times their stiffness: where that matters, the penalty of the
    contact determines the frequency. A mode is compared with the nearest mode of the same label.

    Parameters
    ----------
    state
        An equilibrium with frequencies `modes`.

    Returns
    -------
    list of float
        The change of each mode: 0 without contact, 1 if the mode has vanished, nan if the shell
        finds no equilibrium near.
    """
    bodies = touching_bodies(scene, state)
    if not bodies:
        return [0.0] * len(modes)
    stiffened_state = with_stiffer_bodies(scene, state, bodies)
    if stiffened_state is None:
        return [nan] * len(modes)
    # the modes with stiffer bodies
    whole_shell = mode_space(scene.model)
    shell_modes, state = ShellModes(whole_shell.model), whole_shell.state(stiffened_state)
    stiffer_modes = shell_modes.vibrations(state, len(modes) + FURTHER_MODES)
    # the smallest change of each mode to one of the same label
    changes = []
    for mode in modes:
        differences = (
            abs(stiffer_mode.eigenvalue / mode.eigenvalue - 1)
            for stiffer_mode in stiffer_modes
            if stiffer_mode.label == mode.label
        )
        changes.append(min(differences, default=1.0))
    return changes


def _contact_warning(point: int, rank: int, mode: ShellMode, change: float) -> str:
    """Return the warning that a frequency depends on the penalty stiffness of a contact.

    Parameters
    ----------
    point
        Number of the row.
    rank
        Number of the frequency, from 1 for the lowest.
    change
        Relative change of omega^2 with bodies four times as stiff; nan if unknown.
    """
    effect = f"omega2 changes by {change:.2g} of it"
    if isnan(change):
        effect = "no equilibrium near to compare with"
    return (
        f"warning: frequency {rank} of point {point} (omega2 {mode.eigenvalue:.6g}) depends on "
        f"the stiffness of the bodies: four times as stiff, {effect}"
    )


def frequencies_after(result: Result, folder: Path | None, say: Say) -> None:
    """Compute the requested natural frequencies of a run; collective.

    The modes are kept in the result. With a folder frequencies.csv is written, and
    fields/mode_*_f*.vtu of the first and the last point. Call it after the run, because it
    overwrites the model's tangent.

    Raises
    ------
    DiskError
        On every rank, if something cannot be written.
    """
    section, scene = result.scene.problem.frequencies, result.scene
    if section is None or result.is_refused:
        return
    if scene.model.without_potential and scene.problem.loads.pressure:
        say(
            "warning: a pressure at a free edge has no potential: frequencies are those of the "
            "symmetric tangent"
        )
    states = _states_of_frequencies(result, section, say)
    time_unit = scene.problem.time_unit
    # id of a scene -> what is made once for it; number of a row -> the model with all modes there
    modes_of_scene = dict[int, tuple[ModeSpace, ShellModes]]()
    whole_shells = dict[int, ModeSpace]()
    for number, state in states.items():
        # the model with all modes of the row's scene, and the solver for them
        scene = result.scene_of(number)
        if id(scene) not in modes_of_scene:
            whole_shell = mode_space(scene.model)
            modes_of_scene[id(scene)] = whole_shell, ShellModes(whole_shell.model)
        whole_shell, shell_modes = modes_of_scene[id(scene)]
        whole_shells[number] = whole_shell
        # the state with bodies in contact so stiff that their stiffness does not matter; its modes,
        # and how they still depend on that stiffness
        state = stiffened_equilibrium(scene, state)
        try:
            modes = shell_modes.vibrations(
                whole_shell.state(state),
                section.count,
                allows_rigid_motion=scene.allows_rigid_motion,
            )
            result.frequencies[number] = modes
            if scene.model.contacts:
                changes = contact_changes(scene, state, modes)
                result.contact_changes[number] = changes
                for mode_number, (mode, change) in enumerate(zip(modes, changes, strict=True), 1):
                    if not change <= MAX_CONTACT_CHANGE:  # nor is nan
                        say(_contact_warning(number, mode_number, mode, change))
        except ModesNotFound as e:
            say(f"warning: no frequencies of point {number}: {e}")
            continue
        if folder and number == result.end:
            add_frequency_errors(result, scene, modes, time_unit)
        wave = symmetric_wave(whole_shell.model)
        say(_lowest_frequency(number, scene, modes, wave, time_unit))
    if folder is not None:
        _write_frequencies(result, folder, states, whole_shells, section.count)


def add_frequency_errors(
    result: Result, scene: Scene, modes: Sequence[ShellMode], time_unit: float | None
) -> None:
    """Add the estimated errors of the frequencies at the last point to those of a run; collective.

    Parameters
    ----------
    scene
        Scene of the last point.
    modes
        Natural modes there.
    time_unit
        Unit of time (s), for hertz; None without.
    """
    if result.last_record is None or result.stopped:
        return
    estimates, errors = result.error_estimates, dict[str, float]()
    with estimates.naming("frequencies"):
        errors = frequency_errors(scene, result.last_record, modes, result.fine_scenes)
    estimates.errors |= errors
    for number, mode in enumerate(modes, 1):
        frequency = hertz(mode.eigenvalue, time_unit)
        if frequency and (error := errors.get(f"omega2_{number}")) is not None:
            # the frequency is in proportion to the root of omega2
            estimates.errors[f"hertz_{number}"] = frequency * error / (2 * abs(mode.eigenvalue))


def _write_frequencies(
    result: Result,
    folder: Path,
    states: Mapping[int, State],
    whole_shells: Mapping[int, ModeSpace],
    count: int,
) -> None:
    """Write frequencies.csv, and the modes of the first and the last point as files; collective.

    Parameters
    ----------
    states
        Number of a row -> state, of the requested points in their order.
    whole_shells
        Number of a row -> the model with all modes of the shell there.
    count
        Number of modes that are written at a point.
    """
    comm, time_unit = result.scene.comm, result.scene.problem.time_unit
    symmetric_waves = {
        number: symmetric_wave(whole_shell.model) for number, whole_shell in whole_shells.items()
    }
    content = frequency_table(
        result.frequencies,
        symmetric_waves,
        time_unit,
        result.contact_changes,
        {result.end: result.errors},
    )
    access_disk(comm, partial(write_whole, folder / NAME, content))
    # the first and the last point, if they have frequencies
    for number in {*list(states)[:1], *list(states)[-1:]} & set(result.frequencies):
        scene, whole_shell = result.scene_of(number), whole_shells[number]
        gathering = gatherer(whole_shell.model, scene.comm)
        state = whole_shell.state(states[number])
        for mode_number, mode in enumerate(result.frequencies[number][:count], 1):
            file = mode_file(folder, number, f"f{mode_number}", mode.label)
            write_mode_of(scene, gathering, file, state, mode.label, mode.vector, whole_shell)


def _states_of_frequencies(
    result: Result, section: FrequenciesSection, say: Say
) -> dict[int, State]:
    """Return number of a row -> state, of the points whose frequencies are requested, ascending.

    A warning names requested points that the path does not have.
    """
    states = dict(sorted(result.states_for_frequencies.items()))
    if section.at in ("ends", "end"):
        # the start is row 0
        start = {0: result.scene.unloaded()} if section.at == "ends" else {}
        return {**start, result.end: result.last}
    if isinstance(section.at, list):
        missing = sorted(set(section.at) - set(states))
        if missing:
            say(f"warning: frequencies.at: the path has no point {', '.join(map(str, missing))}")
    return states


def _lowest_frequency(
    number: int,
    scene: Scene,
    modes: Sequence[ShellMode],
    wave_of_symmetric: str,
    time_unit: float | None,
) -> str:
    """Return a line about the lowest frequency at a point, and about the rigid motions below it.

    Parameters
    ----------
    number
        Number of the point's row.
    wave_of_symmetric
        Name of the wave of modes without a label: "0" on a meridian, "symmetric" on a half, empty
        on the whole shell.
    time_unit
        Unit of time (s), for hertz; None without.
    """
    # rigid motions come first, with a frequency of zero; a wave "m = ..." is one of two motions,
    # with its twin that is turned about e3
    rigid_modes = (
        [mode for mode in modes if mode.eigenvalue == 0.0] if scene.allows_rigid_motion else []
    )
    motions = sum(2 if waves_of_label(mode.label) else 1 for mode in rigid_modes)
    rigid_motions = f"{motions} rigid motions, " if motions else ""
    # the first mode that is not rigid, or the last of all
    lowest_mode = modes[min(len(rigid_modes), len(modes) - 1)]
    frequency = hertz(lowest_mode.eigenvalue, time_unit)
    hertz_words = "" if frequency is None else f", {frequency:.6g} Hz"
    wave = wave_of(lowest_mode.label, wave_of_symmetric)
    wave_words = ""
    if wave:
        wave_words = f", m = {wave}" if wave.isdigit() else f", {wave}"
    return (
        f"{rigid_motions}lowest frequency at point {number}: "
        f"omega2 {lowest_mode.eigenvalue:.6g}{hertz_words}{wave_words}"
    )
