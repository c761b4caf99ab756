"""The goal of a design: an objective to be minimised, constraints that must not be negative; and
its search by SciPy's optimisers.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import formula
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.simulate.gradients.instabilities import MAX_INSTABILITIES, MAX_LOAD_RATIO
from magshell_fenicsx.simulate.results import Target
from magshell_fenicsx.studies.design_evaluation import LOWEST, DesignEvaluation
from magshell_fenicsx.studies.design_variables import Variables
from magshell_fenicsx.studies.max_min import raise_lowest
from magshell_fenicsx.studies.runner import Case
from magshell_fenicsx.studies.sections import DesignSection, LimitSection, ShapeSection

Array = NDArray[np.float64]

EQUALITY_TOLERANCE = 1e-3  # relative difference of results that are to be the same
CONSTRAINT_TOLERANCE = 1e-6  # a constraint counts as kept to this part of its bound
TARGET_TOLERANCE = 1e-3  # a value counts as reached to this part of it
WORSE = 1.0  # a lost path counts as this much worse than the worst known
SPLINE_POINTS = 4001  # points by which the length of a spline is measured
AT_ROOT = 1e-6


@dataclass(frozen=True)
class Limit:
    """A result above (sign 1) or below (sign -1) a bound, or another result but for a margin."""

    of: str
    sign: float
    bound: float = 0.0
    other: str = ""
    margin: float = 0.0

    def slack(self, values: Mapping[str, float]) -> float:
        """How far it is from being broken."""
        reference = values[self.other] if self.other else self.bound
        return self.sign * (values[self.of] - reference) + self.margin

    def slope(self, gradients: Mapping[str, Sequence[float]]) -> Array:
        """The gradient of `slack`."""
        reference_slope = np.array(gradients[self.other]) if self.other else 0.0
        return np.asarray(self.sign * (np.array(gradients[self.of]) - reference_slope))

    @property
    def words(self) -> str:
        if self.other:
            return f"{self.of} the same as {self.other}"
        return f"{self.of} {'at least' if self.sign > 0 else 'at most'} {self.bound:g}"


def limits_of(section: LimitSection, scale: Mapping[str, float]) -> list[Limit]:
    """Return the inequality constraints of a section; `scale` has the sizes of results at the
    start.
    """
    sides = ((section.least, 1.0), (section.most, -1.0))
    limits = [
        Limit(section.of, sign, bound_value)
        for bound_value, sign in sides
        if bound_value is not None
    ]
    if section.same_as:
        margin = EQUALITY_TOLERANCE * max(
            scale.get(result, 0.0) for result in (section.of, section.same_as)
        )
        limits += [
            Limit(section.of, sign, other=section.same_as, margin=margin) for sign in (1.0, -1.0)
        ]
    return limits


def target_of(section: ShapeSection, case: Case, bent: float = 1.0) -> Target:
    """Undeformed places (n, 3) over R -> wanted places; of a curve with a part of its curvature.

    Raises
    ------
    CaseError
        If a curve is wanted of another shell than a strip, or begins elsewhere than at its root.
    """
    if section.components:
        components = [formula(text) for text in section.components]
        return lambda x: np.stack([f(*x.T) for f in components], axis=-1)
    if case.shell.geometry != "strip":
        raise CaseError("design.objective.shape.curve: is of a strip; give components")
    points = np.array(section.curve)
    if np.abs(points[0]).max() > AT_ROOT:
        raise CaseError(
            f"design.objective.shape.curve: begins at {points[0].tolist()}, but the strip's root "
            "is at 0, 0, 0"
        )
    return Curve(points, bent)


class Curve:
    """Spline through points, of length one, as the target of a strip: its places keep their
    distance to the middle line along y.
    """

    def __init__(self, points: Array, bent: float = 1.0) -> None:
        chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        spline = scipy.interpolate.CubicSpline(chord, points)
        dense_points = spline(np.linspace(0.0, chord[-1], SPLINE_POINTS))
        dense_points = dense_points if bent == 1.0 else _with_part_of_curvature(dense_points, bent)
        length = np.concatenate(
            [[0.0], np.cumsum(np.linalg.norm(np.diff(dense_points, axis=0), axis=1))]
        )
        self._at = scipy.interpolate.CubicSpline(length / length[-1], dense_points / length[-1])

    def __call__(self, x: Array) -> Array:
        return np.asarray(self._at(x[:, 0])) + x[:, 1:2] * [0.0, 1.0, 0.0]


def _with_part_of_curvature(points: Array, part: float) -> Array:
    """The curve with the same first tangent and lengths, and a part of its curvature, in a frame
    without twist.
    """
    steps = np.diff(points, axis=0)
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = steps / length
    # from the frame of the curve to that of the bent one
    directions, rotation = [tangents[0]], np.eye(3)
    for tangent, next_tangent in itertools.pairwise(tangents):
        turn = np.cross(tangent, next_tangent)
        angle = np.arctan2(np.linalg.norm(turn), tangent @ next_tangent)
        axis = turn * (angle / max(float(np.linalg.norm(turn)), 1e-300))
        inverse_turn = scipy.spatial.transform.Rotation.from_rotvec(-axis).as_matrix()
        rotation = (
            rotation
            @ scipy.spatial.transform.Rotation.from_rotvec(part * axis).as_matrix()
            @ inverse_turn
        )
        directions.append(rotation @ next_tangent)
    return np.vstack([points[:1], points[0] + np.cumsum(length * np.array(directions), axis=0)])


@dataclass
class DesignGoal:
    """Objective and constraints of a design; results are scaled with their values at the start.

    Attributes
    ----------
    results
        Names of the results that are needed, that of the objective first.
    targets
        Target of the last stage: undeformed places -> places of the desired shape.
    stages
        Targets of the stages before it.
    scale
        Absolute values of the results at the start.
    """

    section: DesignSection
    targets: Mapping[str, Target]
    stages: Sequence[Mapping[str, Target]] = ()
    scale: dict[str, float] = field(default_factory=dict)

    @property
    def results(self) -> list[str]:
        return self.section.results

    def begin(self, first: DesignEvaluation) -> None:
        """Scale results with their values at the start."""
        self.scale = {result: abs(value) or 1.0 for result, value in first.values.items()}

    def objective(self, evaluation: DesignEvaluation) -> float:
        """Return the scaled objective; the least value is the best."""
        return self._objective(evaluation)[0]

    def slope(self, evaluation: DesignEvaluation) -> Array:
        """Gradient of the objective."""
        return self._objective(evaluation)[1] * np.array(
            evaluation.gradients[self.section.objective.result]
        )

    def _objective(self, evaluation: DesignEvaluation) -> tuple[float, float]:
        objective = self.section.objective
        value = min(evaluation.values[result] for result in objective.results)
        scale = self._scale or abs(value) or 1.0
        if objective.value is not None:
            scale = abs(objective.value) or scale
            return ((value - objective.value) / scale) ** 2, 2 * (
                value - objective.value
            ) / scale**2
        sign = -1.0 if objective.maximise else 1.0
        return sign * value / scale, sign / scale

    @property
    def _scale(self) -> float:
        """The largest of the objective's results at the start."""
        return max(
            (self.scale.get(result, 0.0) for result in self.section.objective.results), default=0.0
        )

    @property
    def lowest(self) -> bool:
        """Whether the lowest of several values is to be raised: of results, instabilities or
        frequencies.
        """
        objective = self.section.objective
        return objective.maximise is not None and (
            len(objective.results) > 1 or objective.result in LOWEST
        )

    @property
    def crossed(self) -> bool:
        """Whether values are raised that others cross, which may be of any number."""
        return self.lowest and any(result in LOWEST for result in self.section.objective.results)

    def lowest_values(self, evaluation: DesignEvaluation) -> Array:
        """Values to be raised over the scale, always equally many: missing ones are replaced by an
        upper bound.
        """
        groups = [
            _value_and_close_ones(evaluation.values[result], evaluation.beside.get(result))
            for result in self.section.objective.results
        ]
        return np.asarray(
            np.concatenate([[value for value, _ in several] for several in groups]) / self._scale
        )

    def lowest_slopes(self, evaluation: DesignEvaluation) -> Array:
        """Return the gradients (values, variables) of `lowest_values`."""
        results = self.section.objective.results
        groups = [
            _value_and_close_ones(
                evaluation.values[result],
                evaluation.beside.get(result),
                evaluation.gradients[result],
            )
            for result in results
        ]
        return np.asarray(
            np.concatenate([[slope for _, slope in several] for several in groups]) / self._scale
        )

    def constraints(self, evaluation: DesignEvaluation) -> Array:
        """Return the scaled slacks of the constraints; negative where one is violated."""
        return np.array(
            [limit.slack(evaluation.values) / self._size(limit) for limit in self._limits]
        )

    def constraint_slopes(self, evaluation: DesignEvaluation) -> Array:
        """Return the gradients (constraints, variables) of `constraints`."""
        return np.array(
            [limit.slope(evaluation.gradients) / self._size(limit) for limit in self._limits]
        )

    @property
    def _limits(self) -> list[Limit]:
        """The inequalities of all constraints."""
        return [
            limit
            for section in self.section.constraints
            for limit in limits_of(section, self.scale)
        ]

    def _size(self, limit: Limit) -> float:
        return (
            abs(limit.bound)
            or max(self.scale.get(result, 0.0) for result in (limit.of, limit.other))
            or 1.0
        )

    def violation(self, evaluation: DesignEvaluation) -> float:
        """Return the largest relative violation of the constraints; zero if all are satisfied."""
        return float(max([0.0, *(-self.constraints(evaluation))]))

    def merit(self, evaluation: DesignEvaluation) -> tuple[float, float]:
        """Return the pair by which evaluations are compared: violation, then objective; the least
        is best.
        """
        violation = self.violation(evaluation)
        return (violation if violation > CONSTRAINT_TOLERANCE else 0.0, self.objective(evaluation))

    def words(self, evaluation: DesignEvaluation) -> str:
        """Return the results of an evaluation as text."""
        return ", ".join(
            f"{key} = {value:.6g}" for key, value in (evaluation.values | evaluation.seen).items()
        )

    def missed(self, evaluation: DesignEvaluation) -> str:
        """Describe targets and constraints that an evaluation misses; empty if it misses none."""
        objective, sentences = self.section.objective, list[str]()
        if objective.value is not None and objective.reach:
            value = evaluation.values[objective.reach]
            if abs(value - objective.value) > TARGET_TOLERANCE * (abs(objective.value) or 1.0):
                request = (
                    f"{objective.reach} = {objective.value:g} is not reached within the bounds"
                )
                sentences.append(f"{request}: the nearest found is {value:.6g}")
        for limit in self._limits:
            if limit.slack(evaluation.values) < -CONSTRAINT_TOLERANCE * self._size(limit):
                sentences.append(
                    f"{limit.words} is not kept: the nearest found is "
                    f"{evaluation.values[limit.of]:.6g}"
                )
        return "; ".join(sentences)


def _value_and_close_ones(
    value: float,
    close_values: Sequence[tuple[float, list[float]]] | None,
    slope: Sequence[float] = (),
) -> list[tuple[float, Sequence[float]]]:
    """A result and those beside it with their slopes: MOST of what may cross others, else one."""
    if close_values is None:
        return [(value, slope)]
    upper_value = (MAX_LOAD_RATIO * value, [MAX_LOAD_RATIO * v for v in slope])
    return [(value, slope), *close_values, *[upper_value] * MAX_INSTABILITIES][:MAX_INSTABILITIES]


def design_goal_of(case: Case, section: DesignSection) -> DesignGoal:
    """Build the goal from the section of a case."""
    shape = section.objective.shape
    if shape is None:
        return DesignGoal(section, {})
    parts = [(i + 1) / shape.stages for i in range(shape.stages)]
    *stages, last = [{"shape": target_of(shape, case, part)} for part in parts]
    return DesignGoal(section, last, stages)


def search_optimum(
    evaluated: Callable[[Array], DesignEvaluation],
    goal: DesignGoal,
    vary: Variables,
    first: Array,
    iterations: int,
) -> str:
    """Look for the best variables from the first on; why the optimiser ended."""
    if goal.crossed:
        return raise_lowest(evaluated, goal, vary.limits, first, iterations)
    if goal.lowest:
        return _raise_lowest_smooth(evaluated, goal, vary, first, iterations)
    tried: list[tuple[Array, float]] = []

    def objective(x: Array) -> tuple[float, Array]:
        evaluation = evaluated(x)
        if not evaluation.values:
            direction = x - min(tried, key=lambda evaluated_point: evaluated_point[1])[0]
            uphill = np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-300))
            return max(value for _, value in tried) + WORSE, uphill
        value = goal.objective(evaluation)
        tried.append((np.array(x), value))
        return value, goal.slope(evaluation)

    def constraint_values(x: Array) -> Array:
        return goal.constraints(last(x)[0])

    def constraint_gradients(x: Array) -> Array:
        return goal.constraint_slopes(last(x)[0])

    last, how = _last_known(evaluated), dict[str, Any]()
    if goal.section.constraints:
        how = {
            "method": "SLSQP",
            "constraints": {"type": "ineq", "fun": constraint_values, "jac": constraint_gradients},
        }
    options = (
        {"maxiter": iterations, "ftol": 1e-9}
        if how
        else {"maxiter": iterations, "ftol": 1e-15, "gtol": 1e-9}
    )
    how = how or {"method": "L-BFGS-B"}
    ended = scipy.optimize.minimize(
        objective, first, jac=True, bounds=vary.limits, options=options, **how
    )
    return str(ended.message)


def _raise_lowest_smooth(
    evaluated: Callable[[Array], DesignEvaluation],
    goal: DesignGoal,
    vary: Variables,
    first: Array,
    iterations: int,
) -> str:
    """Raise the lowest of several results: the largest t with all of them above t, for (x, t).

    Where two of them cross, their minimum has a corner, and this problem has none.
    """
    last = _last_known(evaluated)

    def values_above_level(z: Array) -> Array:
        evaluation, converged = last(z[:-1])
        values: Array = np.concatenate(
            [goal.lowest_values(evaluation) - z[-1], goal.constraints(evaluation)]
        )
        return values if converged else np.full_like(values, -WORSE)

    def slopes(z: Array) -> Array:
        evaluation, _ = last(z[:-1])
        parts = ((goal.lowest_slopes(evaluation), -1.0), (goal.constraint_slopes(evaluation), 0.0))
        return np.vstack(
            [np.column_stack([part, np.full(len(part), by_t)]) for part, by_t in parts if len(part)]
        )

    start = np.append(first, goal.lowest_values(evaluated(first)).min())
    down = np.append(0 * first, -1.0)
    ended = scipy.optimize.minimize(
        lambda z: (-z[-1], down),
        start,
        jac=True,
        method="SLSQP",
        bounds=[*vary.limits, (None, None)],
        constraints={"type": "ineq", "fun": values_above_level, "jac": slopes},
        options={"maxiter": iterations, "ftol": 1e-7},
    )
    return str(ended.message)


def _last_known(
    evaluated: Callable[[Array], DesignEvaluation],
) -> Callable[[Array], tuple[DesignEvaluation, bool]]:
    """Wrap an evaluation so that a lost path gives the last known evaluation, and False."""
    last: list[DesignEvaluation] = []

    def evaluate_or_last(x: Array) -> tuple[DesignEvaluation, bool]:
        evaluation = evaluated(x)
        if evaluation.values:
            last[:] = [evaluation]
        return last[0], bool(evaluation.values)

    return evaluate_or_last
