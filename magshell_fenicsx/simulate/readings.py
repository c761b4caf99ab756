"""Readings of an instrument on the path of a scene: results at places, with their slopes.

A place is a value of what the last step prescribes, its load or the displacement conjugate to it,
in the case's unit; a result may be read at the end of the path too. At a place the equilibrium is
solved, and a result y has the derivative

    dy/dp at the place = dy/dp + dy/dmu dmu/dp,

with dmu/dp of the load that keeps the place: where its unit depends on p, as the buckling pressure
does on a thickness.
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
from magshell_fenicsx.problem.columns import sizes_in_units
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.registry import amplitude
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
        In the unit of readings.
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
        Name of the result.
    at
        The place where it is read; None: the end of the path.
    change
        Whether it is the change since the step began.
    """

    of: str
    at: float | None = None
    change: bool = False


@dataclass
class Readings:
    """Values of readings, with their slopes.

    Attributes
    ----------
    values, slopes
        (n,) and (n, p).
    curves
        Result -> places and values at all points of the last step's path.
    """

    values: Array
    slopes: Array
    curves: dict[str, list[tuple[float, float]]] = field(default_factory=dict)


class PrescribedQuantity:
    """The load or the displacement that the last step of a scene prescribes; its values are places.

    Attributes
    ----------
    name
        The amplitude of the step.
    column, dimensionless_column
        Its column in the case's unit, and without.

    Raises
    ------
    CaseError
        If the case has no load, or its amplitude is no single load.
    """

    def __init__(self, scene: Scene) -> None:
        programme = scene.problem.programme
        if not programme or programme[-1].load.motion:
            raise CaseError("the case has no last step that prescribes a load or a displacement")
        self.scene, self.step = scene, programme[-1]
        self.name = self.step.name
        self.by_conjugate = self.step.load.by_conjugate(at_target=True)
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
        """Return the place of a state."""
        if not self.by_conjugate:
            return float(self._size * state.mu[self.name])
        potential = self.scene.model.system.potential(state.u, state.mu, self.name)
        return float(-self._size * potential / self._unit)

    def constraint(self, system: System, place: float) -> ConstraintRow:
        """Return the equation that holds at a place."""
        value = place / self._size * self._unit
        if self.by_conjugate:
            return PrescribedConjugate(system, self.name, value)
        return PrescribedLoad(self.name, value)

    def load_rate(self, key: str) -> float:
        """Return d ln mu/dp of the load that keeps its place, less that which gradients keep.

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
        low, high = (problem.with_values({key: value + sign * step}) for sign in (-1, 1))
        sizes = [sizes_in_units(each).size(self.dimensionless_column) for each in (low, high)]
        factors = [self._load_factor(each) for each in (low, high)]
        width = 2 * step
        needed = -(sizes[1] - sizes[0]) / (width * self._size)
        kept_by_gradients = (factors[1] - factors[0]) / width
        if not self.by_conjugate:
            return float(needed - kept_by_gradients)
        if abs(needed - kept_by_gradients) * abs(value or 1.0) > UNIT_RATE_TOLERANCE:
            raise CaseError(
                f"{key}: changes the unit of {self.column}: give the target of {self.step.key} "
                "that unit"
            )
        return 0.0

    def _load_factor(self, other: Problem) -> float:
        """Return the load of another problem over that of the scene, as gradients have it.

        See `simulate.perturbation.state_with_new_loads`.
        """
        problem = self.scene.problem
        if self.name.startswith("lambda_") and problem.lambda_m:
            return other.lambda_m / problem.lambda_m
        old_target, new_target = self.step.load.target, other.programme[-1].load.target
        prescribed = "conjugate" if self.by_conjugate else "load"
        if not (old_target and new_target and old_target[0].quantity == prescribed):
            return 1.0
        return new_target[1] / old_target[1] if old_target[1] else 1.0


class ResultSampler:
    """The path of a scene, on which results are read; collective.

    Parameters
    ----------
    requests
        What will be read: the path is followed as far as that needs it.

    Raises
    ------
    LostResult
        If the path is lost before.
    """

    def __init__(self, scene: Scene, requests: Sequence[Reading]) -> None:
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
                    ends = self._path()[-2:]
                    low, high = (self.prescribed.place_of(end.point.state) for end in ends)
                    passed = {x for x in places_ahead if (low - x) * (high - x) <= 0}
                    places_ahead -= passed
                if record.step == last_step and not places_ahead and not to_end:
                    break
        except Stopped as e:
            self._stop_reason = str(e)
        remarks_on_end = (text for text in remarks if text.startswith(BEYOND_INSTABILITY))
        self._stop_reason = self._stop_reason or next(remarks_on_end, "")

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
        """Return places and values of a column at the points of the last step."""
        at_begin = float(self._observed[0][1][column]) if change else 0.0
        return [(place, float(row[column]) - at_begin) for place, row in self._observed]

    @cached_property
    def _observed(self) -> list[tuple[float, dict[str, float]]]:
        """Places and rows of the points of the last step."""
        states = [record.point.state for record in self._path()]
        rows = [(state, self.scene.observe(state)) for state in states]
        return [
            (self.prescribed.place_of(state), {**row, **self.scene.sizes.values(row)})
            for state, row in rows
        ]

    def adjoint(self, reading: Reading) -> Adjoint:
        """Return the adjoint of a reading, not of its change.

        Raises
        ------
        LostResult
            If it is not on the path.
        """
        scene, result = self.scene, reading.of
        if reading.at is not None:
            return self.adjoint_at(self.record_at(reading.at), result)
        if self._stop_reason and result not in FOLDS:
            raise LostResult(self._stop_reason)
        try:
            if result in FOLDS:
                begins = self._history.begins
                _, first_adjoint = instabilities(scene, self._records, result, begins=begins)[0]
                return first_adjoint
            refuse_moving(scene, self._records[-1], result)
            return adjoint_at_end(scene, self._history, result)[1]
        except FoldLost as e:
            raise LostResult(f"no {result}: {e}") from None

    def adjoint_at(self, record: Record, column: str) -> Adjoint:
        """Return the adjoint of a column at a point of the last step."""
        return adjoint(self.scene, record, column, None, self._history.begins)

    def slopes(self, adjoints: Sequence[Adjoint], key: str, has_place: Sequence[bool]) -> Array:
        """Return derivatives of results by a number of the case.

        A place stays where `has_place` says that there is one.
        """
        others = dict[float, Scene]()  # the same for all results
        slopes = np.array([float(derivative(each, key, others)) for each in adjoints])  # type: ignore[arg-type]
        if not any(has_place) or not (rate := self.prescribed.load_rate(key)):
            return slopes
        name = self.prescribed.name
        by_place = [
            float(derivative(each, name)) * each.state.mu[name] * rate if keeps_place else 0.0  # type: ignore[arg-type]
            for each, keeps_place in zip(adjoints, has_place, strict=True)
        ]
        return np.asarray(slopes + np.array(by_place))

    @property
    def begin(self) -> Record:
        """Begin of the last step, as a point of it."""
        name, step = self.prescribed.name, self.prescribed.step.number
        return replace(self._path()[0], label="target", amplitude=name, step=step)

    def record_at(self, place: float) -> Record:
        """Return the equilibrium at a place, where the path first passes it; collective.

        Raises
        ------
        PlaceOutsidePath
            If it does not.
        LostResult
            If Newton's method fails there.
        """
        if place not in self._record_at_place:
            self._record_at_place[place] = self._record_at(place)
        return self._record_at_place[place]

    def _record_at(self, place: float) -> Record:
        path, prescribed = self._path(), self.prescribed
        values = [prescribed.place_of(record.point.state) for record in path]
        slack = PATH_END_TOLERANCE * (max(values) - min(values)) if values else 0.0
        segments = (
            k
            for k in range(len(path) - 1)
            if self._is_between(values[k], values[k + 1], place, slack)
        )
        k = next(segments, None)
        if k is None:
            extent = "has no such point"
            if len(values) > 1:
                extent = f"goes from {min(values):.6g} to {max(values):.6g}"
            why = f" ({self._stop_reason})" if self._stop_reason else ""
            raise PlaceOutsidePath(
                f"{prescribed.column} = {place:.6g} is outside the path, which {extent}{why}", place
            )
        low, high = ((values[i], path[i].point.state) for i in (k, k + 1))
        stage = stage_of_step(self.scene, prescribed.step, low[1])
        try:
            state = self._state_between(stage, low, high, place)
        except LostResult as e:
            raise UnreadPlace(
                f"no equilibrium is found at {prescribed.column} = {place:.6g}: {e}", place
            ) from None
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
        """Return the equilibrium at a place between two.

        Where Newton's method fails, first one halfway to the nearer of the two is found.
        """
        (first, a), (last, b) = low, high
        part = float(np.clip((place - first) / ((last - first) or 1.0), 0.0, 1.0))
        mu = {
            name: (1 - part) * value + part * b.mu.get(name, value) for name, value in a.mu.items()
        }
        system, comm = self.scene.model.system, self.scene.comm
        guess = system.with_moved_supports(State((1 - part) * a.u + part * b.u, mu))
        row = self.prescribed.constraint(stage.newton.system, place)
        outcome = stage.newton.solve(stage.enter(guess), self.prescribed.name, row)
        state = stage.leave(outcome.state)
        tolerance = max_abs(comm, b.u - a.u) + PATH_END_TOLERANCE * system.length
        if outcome.converged and max_abs(comm, state.u - guess.u) <= tolerance:
            return state
        if not halvings:
            raise LostResult(
                "the iteration has left the path" if outcome.converged else outcome.reason
            )
        half = (place + (first if part < 0.5 else last)) / 2
        middle = half, self._state_between(stage, low, high, half, halvings - 1)
        ends = (middle, high) if part < 0.5 else (low, middle)
        return self._state_between(stage, *ends, place, halvings - 1)

    @staticmethod
    def _is_between(low: float, high: float, place: float, slack: float) -> bool:
        return min(low, high) - slack <= place <= max(low, high) + slack


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
        What is read.
    keys
        Numbers of the case that results are differentiated by.
    slopes
        Whether they are; else slopes are zero.
    fields
        Fields that they are differentiated by too (see `gradients.gradient`) -> how many numbers
        they have, and what makes the derivatives by these of a gradient; they follow those by keys.

    Raises
    ------
    LostResult
        If the path does not have one of them.
    CaseError
        If a result has no derivative.
    """
    sampler, fields = ResultSampler(scene, requests), fields or {}
    changing = list(dict.fromkeys(request.of for request in requests if request.change))
    adjoints = [sampler.adjoint(request) for request in requests]
    adjoints += [sampler.adjoint_at(sampler.begin, result) for result in changing]
    has_place = [request.at is not None for request in requests] + [True for _ in changing]
    values = np.array([each.value_in_unit for each in adjoints])
    count_of_numbers = len(keys) + sum(count for count, _ in fields.values())
    derivatives = np.zeros((len(adjoints), count_of_numbers))
    for i, key in enumerate(keys if slopes else ()):
        derivatives[:, i] = sampler.slopes(adjoints, key, has_place)
    first = len(keys)
    for field_name, (count, of_field) in fields.items() if slopes else ():
        for row, each in zip(derivatives, adjoints, strict=True):
            row[first : first + count] = of_field(derivative(each, field_name))  # type: ignore[arg-type]
        first += count
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
    count = len(requests)
    return Readings(values[:count], derivatives[:count], curves)
