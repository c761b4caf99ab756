"""Readings of an instrument on the path of a scene: results at places, with their slopes.

A place is a value of what the last step prescribes, its load or the displacement conjugate to it,
in the case's unit; a result may be read at the end of the path too. At a place the equilibrium is
solved, and a result y has the derivative

    dy/dp at the place = dy/dp + dy/dmu dmu/dp,

with dmu/dp of the load that keeps the place: where its unit depends on p, as the buckling pressure
does on a thickness.

Words and symbols:

- p is a number of the case, given by its key; a slope is a derivative by p. mu is the load, an
  amplitude; its conjugate -dPi/dmu is the displacement on which it does work, with the potential
  energy Pi.
- A column is one of path.csv, without unit or in a unit of the case. The size of a unit turns the
  first into the second.
- A history has the records of a run that its end depends on. An adjoint has what the derivatives of
  one result by any p need.
- Low and high are the two points of the path, or values of p, at both sides.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.continuation.control import ConstraintRow, PrescribedConjugate, PrescribedLoad
from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import State, System, max_abs
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.motion.motion_step import TimeSection
from magshell_fenicsx.problem.columns import sizes_in_units
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.registry import amplitude, principal
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.follow import BEYOND_INSTABILITY, follow_alone
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, adjoint
from magshell_fenicsx.simulate.gradients.gradient import derivative
from magshell_fenicsx.simulate.gradients.instabilities import (
    FOLDS,
    LostResult,
    instabilities,
    refuse_moving,
)
from magshell_fenicsx.simulate.gradients.results import adjoint_at_end
from magshell_fenicsx.simulate.perturbation import number_at_key, scale_at_key
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.results import conjugates
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.scene_cache import SceneCache
from magshell_fenicsx.simulate.stage import Stage
from magshell_fenicsx.simulate.steps import stage_of_step

Array = NDArray[np.float64]
StateAtPlace = tuple[float, State]  # a place, and an equilibrium there
DIFFERENCE_STEP = 1e-4  # of what a change of a number is small against
UNIT_RATE_TOLERANCE = 1e-6  # relative difference of rates that are the same
PATH_END_TOLERANCE = 1e-9  # relative; a place so far beyond the path is its end
# how often a place between two points comes nearer to one of them before it is given up
MAX_HALVINGS = 4

ByField = Callable[[FieldGradient], Array]


class UnreadPlace(LostResult):
    """A place at which there is no equilibrium.

    Attributes
    ----------
    place
        Value of the prescribed quantity, in the unit of readings.
    """

    def __init__(self, message: str, place: float) -> None:
        super().__init__(message)
        self.place = place


class PlaceOutsidePath(UnreadPlace):
    """A place that the path does not reach."""


@dataclass(frozen=True)
class Reading:
    """A result that is read on a path.

    Attributes
    ----------
    of
        Name of the result, a column of path.csv or an instability.
    at
        The place where it is read; None: the end of the path.
    change
        Whether the change since the step began is read instead of the value.
    """

    of: str
    at: float | None = None
    change: bool = False


@dataclass
class Readings:
    """Values of n readings, with their derivatives by p numbers.

    Attributes
    ----------
    values, slopes
        (n,) and (n, p).
    curves
        Result -> pairs of place and value at all points of the last step's path.
    """

    values: Array
    slopes: Array
    curves: dict[str, list[tuple[float, float]]] = field(default_factory=dict)


class PrescribedQuantity:
    """The load or the displacement that the last step of a scene prescribes; its values are places.

    Attributes
    ----------
    scene, step
        The scene, and its last step.
    name
        The amplitude of the step.
    by_conjugate
        Whether the displacement conjugate to the load is prescribed.
    column, dimensionless_column
        Column of the quantity in the case's unit, and that without unit.
    _unit
        Value of the amplitude, or of its conjugate, that is 1 in the dimensionless column.
    _size
        Size of the case's unit: a value of `column` over that of the dimensionless one.

    Raises
    ------
    CaseError
        If the case has no load, or its amplitude is no single load.
    """

    def __init__(self, scene: Scene) -> None:
        """Find the quantity by the last step, with its columns and the size of its unit."""
        programme = scene.problem.programme  # the list of steps; a motion prescribes no load
        if not programme or isinstance(programme[-1].load, TimeSection):
            raise CaseError("the case has no last step that prescribes a load or a displacement")
        self.scene, self.step = scene, programme[-1]
        self.name = self.step.name
        self.by_conjugate = self.step.load.end.by_conjugate(at_target=True)
        self._unit, self.dimensionless_column = 1.0, amplitude(self.name).column
        if self.by_conjugate:
            columns = {name: (column, unit) for column, (name, unit) in conjugates(scene).items()}
            if self.name not in columns:
                raise CaseError(
                    f"{self.step.key}: what it prescribes is no column: give it control: load or "
                    "arc"
                )
            self.dimensionless_column, self._unit = columns[self.name]
        self._size = scene.sizes.size(self.dimensionless_column)
        column_in_unit = scene.sizes.column(self.dimensionless_column)
        self.column = column_in_unit.name if column_in_unit else self.dimensionless_column

    def place_of(self, state: State) -> float:
        """Return the place of a state, in the unit of `column`."""
        if not self.by_conjugate:
            return float(self._size * state.mu[self.name])
        potential = self.scene.model.system.potential(state.u, state.mu, self.name)
        return float(-self._size * potential / self._unit)

    def constraint(self, system: System, place: float) -> ConstraintRow:
        """Return the equation that prescribes the load or the displacement at a place.

        Parameters
        ----------
        system
            System of the step, with possible further unknowns.
        place
            Value of the load or displacement, in the unit of `column`.
        """
        value = place / self._size * self._unit
        if self.by_conjugate:
            return PrescribedConjugate(system, self.name, value)
        return PrescribedLoad(self.name, value)

    def load_rate(self, key: str) -> float:
        """Return the rate (dmu/dp)/mu by which the load keeps its place, less that of gradients.

        A place is mu times the size of its unit, which may depend on p. So at a fixed place mu
        changes at the negative rate of this size. A gradient by p already lets the load change with
        the targets of the case; the difference of the two rates is returned. Where the displacement
        is prescribed it must be zero, and 0 is returned.

        Parameters
        ----------
        key
            Key of the number p of the case.

        Raises
        ------
        CaseError
            If a displacement does not keep its place.
        """
        problem = self.scene.problem
        value = number_at_key(problem.context, key)
        step = DIFFERENCE_STEP * scale_at_key(problem.context, key)
        low_problem, high_problem = (
            problem.with_values({key: value + sign * step}) for sign in (-1, 1)
        )
        # the size of the unit at both values, and the factor by which gradients scale the load
        low_size, high_size = [
            sizes_in_units(problem_nearby).size(self.dimensionless_column)
            for problem_nearby in (low_problem, high_problem)
        ]
        low_factor, high_factor = [
            self._load_factor(problem_nearby) for problem_nearby in (low_problem, high_problem)
        ]
        two_steps = 2 * step
        needed_rate = -(high_size - low_size) / (two_steps * self._size)
        rate_of_gradients = (high_factor - low_factor) / two_steps
        if not self.by_conjugate:
            return float(needed_rate - rate_of_gradients)
        if abs(needed_rate - rate_of_gradients) * abs(value or 1.0) > UNIT_RATE_TOLERANCE:
            raise CaseError(
                f"{key}: changes the unit of {self.column}: give the target of {self.step.key} "
                "that unit"
            )
        return 0.0

    def _load_factor(self, other: Problem) -> float:
        """Return the load of a problem over that of the scene, as gradients scale it.

        It is the ratio of the strengths that the cases give, or of the targets. The loads of states
        that gradients compare are scaled alike (`simulate.perturbation.state_with_new_loads`).

        Parameters
        ----------
        other
            The same case with another number.
        """
        problem = self.scene.problem
        load_name = principal(self.name)
        if strength := problem.context.strengths.get(load_name):
            return other.context.strengths[load_name] / strength
        # a target is a pair of what it prescribes and its value
        old_target, new_target = self.step.load.end.target, other.programme[-1].load.end.target
        quantity = "conjugate" if self.by_conjugate else "load"
        if not (old_target and new_target):
            return 1.0
        if old_target[0].quantity != quantity:
            return 1.0
        (_, old_value), (_, new_value) = old_target, new_target
        return new_value / old_value if old_value else 1.0


class ResultSampler:
    """The path of a scene, on which results are read.

    The path is followed when a sampler is made, as far as the readings need it. All methods are
    collective.

    Parameters
    ----------
    requests
        The readings to come.

    Attributes
    ----------
    _records, _history
        All records of the run so far, and those of them on which its end depends.
    _record_at_place
        Place -> record of the equilibrium that has been solved there.
    _stop_reason
        Why the path has stopped before its end; "" if it has not.
    """

    def __init__(self, scene: Scene, requests: Sequence[Reading]) -> None:
        """Follow the path until all places are passed, or to its end if a reading needs this."""
        self.scene, self._history = scene, History()
        self._records, self._record_at_place = list[Record](), dict[float | None, Record]()
        self._stop_reason, remarks = "", list[str]()
        places_ahead = {request.at for request in requests if request.at is not None}
        to_end = any(request.at is None for request in requests)
        last_step = len(scene.problem.programme)
        try:
            for record in follow_alone(scene, remark=remarks.append):
                self._history.add(record)
                self._records.append(record)
                if places_ahead and record.step == last_step:
                    places_ahead -= self._just_passed(places_ahead)
                if not places_ahead and not to_end:
                    break
        except Stopped as e:
            self._stop_reason = str(e)
        # a path that stops beyond its instability has a remark in place of an error
        remarks_on_end = (text for text in remarks if text.startswith(BEYOND_INSTABILITY))
        self._stop_reason = self._stop_reason or next(remarks_on_end, "")

    def _just_passed(self, places: set[float]) -> set[float]:
        """Return those of some places that are between the last two points of the path."""
        last_records = self._path()[-2:]
        place_before, place_now = (
            self.prescribed.place_of(record.point.state) for record in last_records
        )
        return {place for place in places if (place_before - place) * (place_now - place) <= 0}

    @cached_property
    def prescribed(self) -> PrescribedQuantity:
        """The quantity that the last step prescribes."""
        return PrescribedQuantity(self.scene)

    def _path(self) -> list[Record]:
        """Return the records of the last step from its begin, without modes and branches."""
        last_step = len(self.scene.problem.programme)
        records = [record for record in self._records if not record.branch and not record.mode]
        numbers = (i for i, record in enumerate(records) if record.step == last_step)
        begin = next(numbers, len(records))
        return records[max(begin - 1, 0) :]

    def curve(self, column: str, *, change: bool = False) -> list[tuple[float, float]]:
        """Return pairs of place and value of a column at the points of the last step.

        Parameters
        ----------
        change
            Whether values are changes since the step began.
        """
        first_row = self._observed[0][1] if change else {}
        at_begin = float(first_row[column]) if change else 0.0
        return [(place, float(row[column]) - at_begin) for place, row in self._observed]

    @cached_property
    def _observed(self) -> list[tuple[float, dict[str, float]]]:
        """Pairs of place and row (column -> value) at the points of the last step."""
        states = [record.point.state for record in self._path()]
        rows = [(state, self.scene.observe(state)) for state in states]
        return [
            (self.prescribed.place_of(state), {**row, **self.scene.sizes.values(row)})
            for state, row in rows
        ]

    def adjoint(self, reading: Reading) -> Adjoint:
        """Return the adjoint of a reading's result: at its place, or at the end of the path.

        It is that of the value itself, also where the reading is a change since the begin.

        Raises
        ------
        LostResult
            If the reading is not on the path.
        """
        scene, result = self.scene, reading.of
        if reading.at is not None:
            return self.adjoint_at(self.record_at(reading.at), result)
        if self._stop_reason and result not in FOLDS:
            raise LostResult(self._stop_reason)
        try:
            if result in FOLDS:
                begins = self._history.begins
                (_, lowest), *_ = instabilities(scene, self._records, result, begins=begins)
                return lowest
            refuse_moving(scene, self._records[-1], result)
            _, adjoint_of_end = adjoint_at_end(scene, self._history, result)
            return adjoint_of_end
        except FoldLost as e:
            raise LostResult(f"no {result}: {e}") from None

    def adjoint_at(self, record: Record, column: str) -> Adjoint:
        """Return the adjoint of a column at a record of the last step."""
        return adjoint(self.scene, record, column, hold=None, begins=self._history.begins)

    def slopes(self, adjoints: Sequence[Adjoint], key: str, has_place: Sequence[bool]) -> Array:
        """Return derivatives (n,) of results by a number of the case.

        Parameters
        ----------
        adjoints
            Adjoints of the n results.
        key
            Key of the number in the case.
        has_place
            For each result, whether it is read at a place, which stays as the number changes.
        """
        scenes = SceneCache(base=self.scene)  # the same for all results
        slopes = np.array(
            [
                float(derivative(result_adjoint, key, scenes))  # type: ignore[arg-type]
                for result_adjoint in adjoints
            ]
        )
        # `rate` is (dmu/dp)/mu of the load that keeps the place, beyond what gradients count
        if not any(has_place) or not (rate := self.prescribed.load_rate(key)):
            return slopes
        name = self.prescribed.name
        # dy/dmu times dmu/dp
        slopes_by_place = [
            float(derivative(result_adjoint, name))  # type: ignore[arg-type]
            * result_adjoint.state.mu[name]
            * rate
            if keeps_place
            else 0.0
            for result_adjoint, keeps_place in zip(adjoints, has_place, strict=True)
        ]
        return np.asarray(slopes + np.array(slopes_by_place))

    @property
    def begin(self) -> Record:
        """The begin of the last step, as a record of this step."""
        name, step = self.prescribed.name, self.prescribed.step.number
        return replace(self._path()[0], label="target", amplitude=name, step=step)

    def record_at(self, place: float) -> Record:
        """Return the record of the equilibrium at a place, where the path first passes this place.

        Each place is solved once.

        Raises
        ------
        PlaceOutsidePath
            If the path does not reach the place.
        LostResult
            If Newton's method fails there.
        """
        if place not in self._record_at_place:
            self._record_at_place[place] = self._record_at(place)
        return self._record_at_place[place]

    def _record_at(self, place: float) -> Record:
        """Solve the equilibrium at a place, and return its record; collective.

        It is solved between the first two points of the path that have the place between them.

        Raises
        ------
        PlaceOutsidePath
            If no points of the path have it between them.
        UnreadPlace
            If Newton's method fails there.
        """
        path, prescribed = self._path(), self.prescribed
        values = [prescribed.place_of(record.point.state) for record in path]
        tolerance = PATH_END_TOLERANCE * (max(values) - min(values)) if values else 0.0
        segments = (
            segment
            for segment in range(len(path) - 1)
            if self._is_between(values[segment], values[segment + 1], place, tolerance)
        )
        segment = next(segments, None)
        if segment is None:
            extent = "has no such point"
            if len(values) > 1:
                extent = f"goes from {min(values):.6g} to {max(values):.6g}"
            stop_text = f" ({self._stop_reason})" if self._stop_reason else ""
            raise PlaceOutsidePath(
                f"{prescribed.column} = {place:.6g} is outside the path, which {extent}{stop_text}",
                place,
            )
        # place and state at both sides
        low, high = ((values[i], path[i].point.state) for i in (segment, segment + 1))
        _, low_state = low
        stage = stage_of_step(self.scene, prescribed.step, low_state)
        try:
            state = self._state_between(stage, low, high, place)
        except LostResult as e:
            raise UnreadPlace(
                f"no equilibrium is found at {prescribed.column} = {place:.6g}: {e}", place
            ) from None
        # gradients read the state alone: s, the tangent and pivots of the point are zero
        point = Point(state, 0.0, 0.0 * state.u, 0.0, 0, 0)
        return Record("target", prescribed.name, point, step=prescribed.step.number)

    def _state_between(
        self,
        stage: Stage,
        low: StateAtPlace,
        high: StateAtPlace,
        place: float,
        halvings: int = MAX_HALVINGS,
    ) -> State:
        """Return the equilibrium at a place between two states of the path.

        Where Newton's method fails, an equilibrium halfway to the nearer state is found first.

        Parameters
        ----------
        low, high
            Place and state of the model at both sides.
        halvings
            How many more halvings are allowed.

        Raises
        ------
        LostResult
            If Newton's method fails after all halvings, or leaves the path.
        """
        (low_place, low_state), (high_place, high_state) = low, high
        # how far the place is from low to high; 1.0 avoids a division by zero
        part = float(np.clip((place - low_place) / ((high_place - low_place) or 1.0), 0.0, 1.0))
        mu = {
            name: (1 - part) * value + part * high_state.mu.get(name, value)
            for name, value in low_state.mu.items()
        }
        system, comm = self.scene.model.system, self.scene.comm
        guess = system.with_moved_supports(
            State((1 - part) * low_state.u + part * high_state.u, mu)
        )
        row = self.prescribed.constraint(stage.newton.system, place)
        outcome = stage.newton.solve(stage.enter(guess), self.prescribed.name, row)
        state = stage.leave(outcome.state)
        # a solution farther from the guess than the two states from each other is not on the path
        tolerance = max_abs(comm, high_state.u - low_state.u) + PATH_END_TOLERANCE * system.length
        if outcome.converged and max_abs(comm, state.u - guess.u) <= tolerance:
            return state
        if not halvings:
            raise LostResult(
                "the iteration has left the path" if outcome.converged else outcome.reason
            )
        # The equilibrium half way to the nearer end is solved first. It replaces this end.
        half_way_place = (place + (low_place if part < 0.5 else high_place)) / 2
        middle = half_way_place, self._state_between(stage, low, high, half_way_place, halvings - 1)
        new_low, new_high = (middle, high) if part < 0.5 else (low, middle)
        return self._state_between(stage, new_low, new_high, place, halvings - 1)

    @staticmethod
    def _is_between(low: float, high: float, place: float, tolerance: float) -> bool:
        """Return whether a place is between two places, up to a tolerance."""
        return min(low, high) - tolerance <= place <= max(low, high) + tolerance


def read(
    scene: Scene,
    requests: Sequence[Reading],
    keys: Sequence[str],
    *,
    slopes: bool = True,
    fields: Mapping[str, tuple[int, ByField]] | None = None,
) -> Readings:
    """Follow the path of a scene and read results on it; collective.

    Parameters
    ----------
    requests
        The n readings.
    keys
        Numbers of the case by which results are differentiated.
    slopes
        Whether to differentiate; else slopes are zero.
    fields
        Field by which results are differentiated as well, as "remanence" or "thickness" -> how many
        numbers this field has, and a function from a gradient to the derivatives by these numbers.
        They follow the derivatives by `keys`.

    Raises
    ------
    LostResult
        If the path does not have a reading.
    CaseError
        If a result has no derivative.
    """
    sampler, fields = ResultSampler(scene, requests), fields or {}
    # rows of the requests, then of results whose value at the begin of the step is needed too
    changing = list(dict.fromkeys(request.of for request in requests if request.change))
    adjoints = [sampler.adjoint(request) for request in requests]
    adjoints += [sampler.adjoint_at(sampler.begin, result) for result in changing]
    has_place = [request.at is not None for request in requests] + [True for _ in changing]
    values = np.array([result_adjoint.value_in_unit for result_adjoint in adjoints])
    # one column for each key, then for each number of each field
    count_of_numbers = len(keys) + sum(count for count, _ in fields.values())
    derivatives = np.zeros((len(adjoints), count_of_numbers))
    for i, key in enumerate(keys if slopes else ()):
        derivatives[:, i] = sampler.slopes(adjoints, key, has_place)
    first_column = len(keys)  # of the numbers of a field
    for field_name, (count, derivatives_by_numbers) in fields.items() if slopes else ():
        for row, result_adjoint in zip(derivatives, adjoints, strict=True):
            row[first_column : first_column + count] = derivatives_by_numbers(
                derivative(result_adjoint, field_name)  # type: ignore[arg-type]
            )
        first_column += count
    # a change is the reading less that at the begin of the step
    for i, request in enumerate(requests):
        if request.change:
            at_begin = len(requests) + changing.index(request.of)
            values[i] = values[i] - values[at_begin]
            derivatives[i] = derivatives[i] - derivatives[at_begin]
    curves = {
        request.of: sampler.curve(request.of, change=request.change)
        for request in requests
        if request.at is not None
    }
    n = len(requests)  # without the rows at the begin of the step
    return Readings(values[:n], derivatives[:n], curves)
