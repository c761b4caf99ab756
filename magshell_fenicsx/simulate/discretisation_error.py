"""Errors of the discretisation in the results of a run, by one degree more on the same mesh.

A result is computed again with elements of one degree more, where it stands on the path
(`degree_comparison.py`). The change of the result, times `SAFETY`, estimates its error.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field

from mpi4py import MPI

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.bodies.contact_step import PRESSURE_MAX
from magshell_fenicsx.quantities.registry import AMPLITUDES, amplitude
from magshell_fenicsx.shells.modes import ShellMode, ShellModes, mode_space
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.degree_comparison import (
    DegreeComparison,
    NotEstimated,
    TooCoarse,
    fine_scene,
    refuse_no_comparison,
)
from magshell_fenicsx.simulate.path_records import LOCATED
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene

SAFETY = 1.25  # factor of the change by one degree more, for the error
FURTHER_MODES = 2  # that are computed with one degree more, as their order may differ
LATER = "limit_load_"  # before the number of an instability after the first
LATER_TAKE_LONG = "this and later instabilities have no estimate, as it would take long"
MOST_INSTABILITIES = 4  # of a path on a meridian, whose errors are estimated


@dataclass
class ErrorEstimates:
    """Estimated errors of the results of a run.

    Attributes
    ----------
    errors
        Name of a result -> its estimated absolute error. Names: "knockdown", "critical_field",
        "limit_load" (the first value of `limit_points` in summary.json), "limit_load_2" and so on
        for later ones that are not on a branch, and "barrier"; at the last point COLUMN@end of
        columns of path.csv, and "omega2_1", "omega2_2" and so on.
    reasons
        Name of a result, "end" for all at the last point -> why it has no estimate.
    too_coarse
        Those of these names for which the mesh may be too coarse, without later instabilities.
    """

    errors: dict[str, float] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    too_coarse: list[str] = field(default_factory=list)

    @contextmanager
    def naming(self, *names: str) -> Iterator[None]:
        """Note the reason for some results where their estimate fails inside `with`."""
        try:
            yield
        except NotEstimated as e:
            self.reasons |= dict.fromkeys(names, str(e))
            if isinstance(e, TooCoarse):
                self.too_coarse += [name for name in names if not name.startswith(LATER)]
        except Exception as e:  # whatever it is: the run has its results, and the summary names it
            self.reasons |= dict.fromkeys(names, f"{type(e).__name__}: {e}".rstrip(": "))


class FineScenes:
    """Fine scenes of the scenes of a run, and the comparisons at its records, each made once.

    Parameters
    ----------
    check
        Called before each of them, on all ranks; it raises `NotEstimated` to end the estimate.
    """

    def __init__(self, check: Callable[[], None] = lambda: None) -> None:
        self._check = check
        self._scenes = dict[int, Scene]()
        self._comparisons = dict[int, DegreeComparison]()

    def comparison(
        self, first_scene: Scene, record: Record, *, is_later: bool = False
    ) -> DegreeComparison:
        """Return the comparison at a record, whose state is computed; collective.

        `is_later` tells that the record is an instability after another one.

        Raises
        ------
        NotEstimated, CaseError, MeshError
            If there is none; and other errors if the state is not found.
        """
        if id(record) not in self._comparisons:
            scene = record.scene or first_scene
            refuse_no_comparison(scene, record)
            self._check()
            if id(scene) not in self._scenes:
                self._scenes[id(scene)] = fine_scene(scene)
                self._check()
            comparison = DegreeComparison(scene, self._scenes[id(scene)], record, is_later)
            _ = comparison.state
            self._comparisons[id(record)] = comparison
        return self._comparisons[id(record)]

    def clear(self) -> None:
        """Let go of all scenes and comparisons, which take memory."""
        self._scenes.clear()
        self._comparisons.clear()


def estimate_errors(
    scene: Scene, history: History, fine_scenes: FineScenes, *, has_stopped: bool = False
) -> ErrorEstimates:
    """Return the estimated errors of the results of a run; collective.

    Parameters
    ----------
    scene
        The first scene of the run.
    history
        The records of the run.
    fine_scenes
        Scenes with one degree more, to which those of the run are added.
    has_stopped
        Whether the run stopped before its end: then only instabilities are results.
    """
    estimates, end = ErrorEstimates(), history.end

    def comparison(record: Record) -> DegreeComparison:
        """Return the comparison at a record."""
        is_later = record.label in LOCATED and record is not history.located[0]
        return fine_scenes.comparison(scene, record, is_later=is_later)

    for record, columns in _instabilities(scene, history):
        with estimates.naming(*columns):
            changes = comparison(record).changes
            estimates.errors |= {
                name: _estimated(changes.get(column, 0.0), record.point.load_error)
                for name, column in columns.items()
            }
    if len(history.located) > (count := _estimated_count(scene)):
        estimates.reasons[f"{LATER}{count + 1}"] = LATER_TAKE_LONG
    if has_stopped:
        estimates.reasons["end"] = "the run stopped early"
        return estimates
    if end and end.amplitude:
        with estimates.naming("end"):
            changes = comparison(end).changes
            estimates.errors |= {
                f"{column}@end": _estimated(change) for column, change in changes.items() if change
            }
            _leave_out_narrow_pressure(estimates, end.scene or scene, end.point.state)
            _leave_out_stresses(estimates, end.scene or scene)
    steps = scene.problem.programme
    if steps and steps[-1].until == "zero" and history.begin and history.last:
        with estimates.naming("barrier"):
            begin, last = (comparison(record) for record in (history.begin, history.last))
            if begin.fine is not last.fine:
                raise NotEstimated("the step begins in another model")
            change = last.barrier_from(begin)
            estimates.errors["barrier"] = _estimated(change)
    return estimates


def frequency_errors(
    scene: Scene, record: Record, modes: Sequence[ShellMode], fine_scenes: FineScenes
) -> dict[str, float]:
    """Return name -> estimated error of the natural modes at a record, "omega2_1", ...; collective.

    A mode is compared with the mode of the same label and rank.

    Parameters
    ----------
    scene
        Scene of the record.
    modes
        Natural modes there, in ascending order.
    fine_scenes
        Scenes with one degree more, to which that of the record is added.

    Raises
    ------
    NotEstimated
        If they cannot be compared; and other errors if the state or the modes are not found.
    """
    if scene.model.contacts or scene.model.shell_contacts:
        raise NotEstimated("frequencies depend on the stiffness of contacts")
    comparison = fine_scenes.comparison(scene, record)
    space = mode_space(comparison.fine.model)
    fine_modes = ShellModes(space.model).vibrations(
        space.state(comparison.state),
        len(modes) + FURTHER_MODES,
        allows_rigid_motion=scene.allows_rigid_motion,
    )
    errors, ranks = dict[str, float](), Counter[str]()
    for number, mode in enumerate(modes, 1):
        of_label = [other.eigenvalue for other in fine_modes if other.label == mode.label]
        if mode.eigenvalue and ranks[mode.label] < len(of_label):  # zero of a rigid motion is exact
            change = of_label[ranks[mode.label]] - mode.eigenvalue
            errors[f"omega2_{number}"] = _estimated(change)
        ranks[mode.label] += 1
    return errors


def _leave_out_narrow_pressure(estimates: ErrorEstimates, scene: Scene, state: State) -> None:
    """Leave out the errors of largest pressures where no cell is in contact all over; collective.

    There the pressure falls with the width of the contact, which one degree more does not show.
    """
    names = [name for name in estimates.errors if name.startswith(PRESSURE_MAX)]
    if not names or scene.comm.allreduce(scene.model.cells_evenly_pressed(state).any(), MPI.LOR):
        return
    for name in names:
        del estimates.errors[name]
    estimates.reasons[f"{PRESSURE_MAX}@end"] = "the contact is narrower than a cell of the mesh"


def _leave_out_stresses(estimates: ErrorEstimates, scene: Scene) -> None:
    """Leave out the errors of forces, moments and stresses at points.

    They are fitted to the cells around a point. One degree more shares the error of the fit, which
    at an edge may be larger than that of the mesh by orders of magnitude.
    """
    reading = scene.problem.loads.stress
    if not reading or not reading.columns:
        return
    columns = tuple(reading.columns)
    for name in [*estimates.errors]:
        column = name.removesuffix("@end")
        if column in columns or column.startswith(tuple(f"{c}_" for c in columns)):
            del estimates.errors[name]
    estimates.reasons["stress@end"] = "stresses at points are fitted: compare with a finer mesh"


def _estimated(change: float, load_error: float = 0.0) -> float:
    """Return the error of a number that one degree more changes, with that of the solver."""
    return float(SAFETY * abs(change) + load_error)


def _estimated_count(scene: Scene) -> int:
    """Return of how many instabilities errors are estimated; on a meridian that is quick."""
    return MOST_INSTABILITIES if scene.problem.axisymmetric else 1


def _instabilities(scene: Scene, history: History) -> list[tuple[Record, dict[str, str]]]:
    """Return instabilities of a path, each with name of the result -> its column.

    They are those that are results, and the first ones of the path. All but the very first have the
    name `LATER` with their number.
    """
    columns_of = dict[int, dict[str, str]]()
    steps_with_held_conjugate = {
        step.number for step in scene.problem.programme if step.name in step.load.hold
    }
    # name of a result -> the load that has it; "" for any load
    load_of_result = {a.critical_names[0]: a.name for a in AMPLITUDES.values() if a.critical_names}
    for name, mu in {**load_of_result, "limit_load": ""}.items():
        for number, record in enumerate(history.located):
            at_held_volume = name == "knockdown" and record.step in steps_with_held_conjugate
            if mu in ("", record.amplitude) and not at_held_volume:
                column = amplitude(record.amplitude).column
                columns_of.setdefault(number, {})[name] = column
                break
    for number, record in enumerate(history.located[1 : _estimated_count(scene)], 1):
        column = amplitude(record.amplitude).column
        columns_of.setdefault(number, {})[f"{LATER}{number + 1}"] = column
    return [(history.located[number], columns) for number, columns in sorted(columns_of.items())]
