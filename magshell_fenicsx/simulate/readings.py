"""What an instrument reads on the path of a scene: results at places of the last step, or at its
end; with slopes.

A place is a value of what the last step prescribes, its load or the displacement conjugate to it,
in the case's unit. There the equilibrium is solved, and a result y has the derivative

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
from magshell_fenicsx.simulate.follow import BEYOND, follow_alone
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, adjoint
from magshell_fenicsx.simulate.gradients.gradient import derivative
from magshell_fenicsx.simulate.gradients.instabilities import (
    FOLDS,
    LostResult,
    instabilities,
    refuse_moving,
)
from magshell_fenicsx.simulate.gradients.results import adjoint_at_end
from magshell_fenicsx.simulate.numbers import number_of, size_of
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.results import conjugates
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage
from magshell_fenicsx.simulate.steps import stage_of

Array = NDArray[np.float64]
Placed = tuple[float, State]  # a place, and an equilibrium there
STEP = 1e-4  # of what a change of a number is small against
SAME = 1e-6  # relative difference of rates that are the same
SLACK = 1e-9  # relative; a place so far beyond the path is its end
TRIES = 4  # how often a place between two points comes nearer to one of them before it is given up

ByField = Callable[[FieldGradient], Array]


class NotRead(LostResult):
    """A place at which there is no equilibrium.

    Attributes
    ----------
    place
        In the unit of readings.
    """

    def __init__(self, message: str, place: float) -> None:
        super().__init__(message)
        self.place = place


class Outside(NotRead):
    """A place that the path does not reach."""


@dataclass(frozen=True)
class Reading:
    """A result, the place where it is read (None: the end of the path), and whether it is the change since the step
    began."""

    of: str
    at: float | None = None
    change: bool = False


@dataclass
class Readings:
    """What is read.

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


class Places:
    """What the last step of a scene prescribes.

    Attributes
    ----------
    name
        The amplitude of the step.
    column, bare
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
        self._unit, self.bare = 1.0, amplitude(self.name).column
        if self.by_conjugate:
            own = {of: (column, unit) for column, (of, unit) in conjugates(scene).items()}
            if self.name not in own:
                raise CaseError(
                    f"{self.step.key}: what it prescribes is no column: give it control: load or arc"
                )
            self.bare, self._unit = own[self.name]
        self._size = scene.sizes.size(self.bare)
        shown = scene.sizes.column(self.bare)
        self.column = shown.name if shown else self.bare

    def of(self, state: State) -> float:
        """The place of a state."""
        if not self.by_conjugate:
            return float(self._size * state.mu[self.name])
        potential = self.scene.model.system.potential(state.u, state.mu, self.name)
        return float(-self._size * potential / self._unit)

    def row(self, system: System, place: float) -> ConstraintRow:
        """What holds at a place."""
        value = place / self._size * self._unit
        return (
            PrescribedConjugate(system, self.name, value)
            if self.by_conjugate
            else PrescribedLoad(self.name, value)
        )

    def rate(self, key: str) -> float:
        """d ln mu/dp of the load that keeps its place, less that of the load which gradients keep.

        Raises
        ------
        CaseError
            If a displacement does not keep its place.
        """
        problem = self.scene.problem
        value, step = number_of(problem.context, key), STEP * size_of(problem.context, key)
        low, high = (problem.with_values({key: value + way * step}) for way in (-1, 1))
        sizes = [sizes_in_units(each).size(self.bare) for each in (low, high)]
        kept = [self._kept(each) for each in (low, high)]
        over = 2 * step
        needed, used = -(sizes[1] - sizes[0]) / (over * self._size), (kept[1] - kept[0]) / over
        if self.by_conjugate and abs(needed - used) * abs(value or 1.0) > SAME:
            raise CaseError(
                f"{key}: changes the unit of {self.column}: give the target of {self.step.key} that unit"
            )
        return 0.0 if self.by_conjugate else float(needed - used)

    def _kept(self, other: Problem) -> float:
        """What gradients multiply the load with in another problem; see `simulate.numbers.carried`."""
        problem = self.scene.problem
        if self.name.startswith("lambda_") and problem.lambda_m:
            return other.lambda_m / problem.lambda_m
        one, two = self.step.load.target, other.programme[-1].load.target
        prescribed = "conjugate" if self.by_conjugate else "load"
        return two[1] / one[1] if one and two and one[0].quantity == prescribed and one[1] else 1.0


class Read:
    """The path of a scene, and what is read on it; collective.

    Parameters
    ----------
    wanted
        What will be read: the path is followed as far as that needs it.

    Raises
    ------
    LostResult
        If the path is lost before.
    """

    def __init__(self, scene: Scene, wanted: Sequence[Reading]) -> None:
        self.scene, self._history = scene, History()
        self._records, self._solved = list[Record](), dict[float | None, Record]()
        self._lost, remarks = "", list[str]()
        waiting = {each.at for each in wanted if each.at is not None}
        to_end = any(each.at is None for each in wanted)
        last = len(scene.problem.programme)
        try:
            for record in follow_alone(scene, remark=remarks.append):
                self._history.add(record)
                self._records.append(record)
                if waiting and record.step == last:
                    way = self._way()[-2:]
                    low, high = (self.places.of(each.point.state) for each in way)
                    waiting -= {at for at in waiting if (low - at) * (high - at) <= 0}
                if record.step == last and not waiting and not to_end:
                    break
        except Stopped as e:
            self._lost = str(e)
        self._lost = self._lost or next((text for text in remarks if text.startswith(BEYOND)), "")

    @cached_property
    def places(self) -> Places:
        """What the last step prescribes."""
        return Places(self.scene)

    def _way(self) -> list[Record]:
        """The records of the last step from where it begins, without modes and branches."""
        last = len(self.scene.problem.programme)
        own = [each for each in self._records if not each.branch and not each.mode]
        begun = next((i for i, each in enumerate(own) if each.step == last), len(own))
        return own[max(begun - 1, 0) :]

    def curve(self, of: str, *, change: bool = False) -> list[tuple[float, float]]:
        """Places and values of a column at the points of the last step."""
        begun = float(self._observed[0][1][of]) if change else 0.0
        return [(place, float(row[of]) - begun) for place, row in self._observed]

    @cached_property
    def _observed(self) -> list[tuple[float, dict[str, float]]]:
        """Places and rows of the points of the last step."""
        states = [record.point.state for record in self._way()]
        rows = [(state, self.scene.observe(state)) for state in states]
        return [
            (self.places.of(state), {**row, **self.scene.sizes.values(row)}) for state, row in rows
        ]

    def adjoint(self, reading: Reading) -> Adjoint:
        """That of a reading, not of a change.

        Raises
        ------
        LostResult
            If it is not on the path.
        """
        scene, of = self.scene, reading.of
        if reading.at is None:
            if self._lost and of not in FOLDS:
                raise LostResult(self._lost)
            try:
                if of in FOLDS:
                    return instabilities(scene, self._records, of, begins=self._history.begins)[0][
                        1
                    ]
                refuse_moving(scene, self._records[-1], of)
                return adjoint_at_end(scene, self._history, of)[1]
            except FoldLost as e:
                raise LostResult(f"no {of}: {e}") from None
        return self.adjoint_at(self.record_at(reading.at), of)

    def adjoint_at(self, record: Record, of: str) -> Adjoint:
        """That of a column at a point of the last step."""
        return adjoint(self.scene, record, of, None, self._history.begins)

    def slopes(self, adjoints: Sequence[Adjoint], key: str, placed: Sequence[bool]) -> Array:
        """Derivatives of results by a number of the case; a place stays where `placed` says that
        there is one.
        """
        others = dict[float, Scene]()  # the same for all results
        slopes = np.array([float(derivative(each, key, others)) for each in adjoints])  # type: ignore[arg-type]
        if not any(placed) or not (rate := self.places.rate(key)):
            return slopes
        name = self.places.name
        moved = [
            float(derivative(each, name)) * each.state.mu[name] * rate if there else 0.0  # type: ignore[arg-type]
            for each, there in zip(adjoints, placed, strict=True)
        ]
        return np.asarray(slopes + np.array(moved))

    @property
    def begin(self) -> Record:
        """Where the last step begins, as a point of it."""
        return replace(
            self._way()[0], label="target", amplitude=self.places.name, step=self.places.step.number
        )

    def record_at(self, place: float) -> Record:
        """The equilibrium at a place, where the path first passes it; collective.

        Raises
        ------
        Outside
            If it does not.
        LostResult
            If Newton's method fails there.
        """
        if place not in self._solved:
            self._solved[place] = self._record_at(place)
        return self._solved[place]

    def _record_at(self, place: float) -> Record:
        way, places = self._way(), self.places
        values = [places.of(each.point.state) for each in way]
        slack = SLACK * (max(values) - min(values)) if values else 0.0
        k = next(
            (
                k
                for k in range(len(way) - 1)
                if self._between(values[k], values[k + 1], place, slack)
            ),
            None,
        )
        if k is None:
            reached = (
                f"goes from {min(values):.6g} to {max(values):.6g}"
                if len(values) > 1
                else "has no such point"
            )
            why = f" ({self._lost})" if self._lost else ""
            raise Outside(
                f"{places.column} = {place:.6g} is outside the path, which {reached}{why}", place
            )
        low, high = ((values[i], way[i].point.state) for i in (k, k + 1))
        try:
            state = self._between_states(
                stage_of(self.scene, places.step, low[1]), low, high, place
            )
        except LostResult as e:
            raise NotRead(
                f"no equilibrium is found at {places.column} = {place:.6g}: {e}", place
            ) from None
        point = Point(state, 0.0, 0.0 * state.u, 0.0, 0, 0)
        return Record("target", places.name, point, step=places.step.number)

    def _between_states(
        self, stage: Stage, low: Placed, high: Placed, place: float, tries: int = TRIES
    ) -> State:
        """The equilibrium at a place between two; where Newton's method fails, first one halfway to
        the nearer.
        """
        (first, a), (last, b) = low, high
        part = float(np.clip((place - first) / ((last - first) or 1.0), 0.0, 1.0))
        mu = {
            name: (1 - part) * value + part * b.mu.get(name, value) for name, value in a.mu.items()
        }
        guess = self.scene.model.system.with_moved_supports(
            State((1 - part) * a.u + part * b.u, mu)
        )
        row = self.places.row(stage.newton.system, place)
        ended = stage.newton.solve(stage.enter(guess), self.places.name, row)
        state, comm = stage.leave(ended.state), self.scene.comm
        apart = max_abs(comm, b.u - a.u) + SLACK * self.scene.model.system.length
        if ended.converged and max_abs(comm, state.u - guess.u) <= apart:
            return state
        if not tries:
            raise LostResult("the iteration has left the path" if ended.converged else ended.reason)
        half = (place + (first if part < 0.5 else last)) / 2
        middle = half, self._between_states(stage, low, high, half, tries - 1)
        ends = (middle, high) if part < 0.5 else (low, middle)
        return self._between_states(stage, *ends, place, tries - 1)

    @staticmethod
    def _between(low: float, high: float, place: float, slack: float) -> bool:
        return min(low, high) - slack <= place <= max(low, high) + slack


def read(
    scene: Scene,
    wanted: Sequence[Reading],
    keys: Sequence[str],
    *,
    slopes: bool = True,
    fields: Mapping[str, tuple[int, ByField]] | None = None,
) -> Readings:
    """Follow the path of a scene and read results on it; collective.

    Parameters
    ----------
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
    path = Read(scene, wanted)
    changed = list(dict.fromkeys(each.of for each in wanted if each.change))
    adjoints = [path.adjoint(each) for each in wanted] + [
        path.adjoint_at(path.begin, of) for of in changed
    ]
    placed = [each.at is not None for each in wanted] + [True for _ in changed]
    values = np.array([each.value_in_unit for each in adjoints])
    by = np.zeros((len(adjoints), len(keys) + sum(count for count, _ in (fields or {}).values())))
    for i, key in enumerate(keys if slopes else ()):
        by[:, i] = path.slopes(adjoints, key, placed)
    begun = len(keys)
    for field_name, (count, of_field) in (fields or {}).items() if slopes else ():
        for row, each in zip(by, adjoints, strict=True):
            row[begun : begun + count] = of_field(derivative(each, field_name))  # type: ignore[arg-type]
        begun += count
    for i, reading in enumerate(wanted):
        if reading.change:
            at_begin = len(wanted) + changed.index(reading.of)
            values[i], by[i] = values[i] - values[at_begin], by[i] - by[at_begin]
    curves = {
        each.of: path.curve(each.of, change=each.change) for each in wanted if each.at is not None
    }
    return Readings(values[: len(wanted)], by[: len(wanted)], curves)
