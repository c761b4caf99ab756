"""The goal of a design, and the search for the best variables by SciPy's optimisers.

The goal is an objective to be minimised, and constraints that must not be negative.

A design varies p variables x, and an evaluation has the results of the case at x with their
gradients; it has no values if the equilibrium path is lost. The slack of a constraint is the
difference to its bound. A wanted shape is given by a target, a map from undeformed to wanted
places; a wanted curve is approached in stages of growing curvature. A result may be the lowest of
several instabilities or frequencies, which may cross; `beside` has the others of an evaluation.
Results are scaled with their absolute values at the start. Places are over R.
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
from magshell_fenicsx.studies.design.evaluation import LOWEST, DesignEvaluation
from magshell_fenicsx.studies.design.max_min import raise_lowest
from magshell_fenicsx.studies.design.sections import DesignSection, LimitSection, ShapeSection
from magshell_fenicsx.studies.design.variables import Variables
from magshell_fenicsx.studies.points import Case

Array = NDArray[np.float64]

EQUALITY_TOLERANCE = 1e-3  # relative difference of results that are to be the same
CONSTRAINT_TOLERANCE = 1e-6  # a constraint counts as kept to this part of its bound
TARGET_TOLERANCE = 1e-3  # a value counts as reached to this part of it
WORSE = 1.0  # a lost path counts as this much worse than the worst known
SPLINE_POINTS = 4001  # points by which the length of a spline is measured
AT_ROOT = 1e-6  # distance of a curve's first point from the strip's root


@dataclass(frozen=True)
class Limit:
    """An inequality constraint on a result.

    Without `other` it is sign (result - bound) >= 0. With `other` it is sign (result - other's
    value) + margin >= 0: two of these, with both signs, make an equality.

    Attributes
    ----------
    of, other
        Names of results; `other` is "" for a bound that is a number.
    sign
        1 for a lower bound, -1 for an upper one.
    bound, margin
        A number, and the largest difference from `other`.
    """

    of: str
    sign: float
    bound: float = 0.0
    other: str = ""
    margin: float = 0.0

    def slack(self, values: Mapping[str, float]) -> float:
        """Return the difference to the bound; negative if the constraint is violated.

        Parameters
        ----------
        values
            Name of a result -> its value.
        """
        reference = values[self.other] if self.other else self.bound
        return self.sign * (values[self.of] - reference) + self.margin

    def slope(self, gradients: Mapping[str, Sequence[float]]) -> Array:
        """Return the gradient (p,) of `slack` by the variables.

        Parameters
        ----------
        gradients
            Name of a result -> its gradient (p,).
        """
        reference_slope = np.array(gradients[self.other]) if self.other else 0.0
        return np.asarray(self.sign * (np.array(gradients[self.of]) - reference_slope))

    @property
    def words(self) -> str:
        """The constraint in words."""
        if self.other:
            return f"{self.of} the same as {self.other}"
        return f"{self.of} {'at least' if self.sign > 0 else 'at most'} {self.bound:g}"


def limits_of(section: LimitSection, scale: Mapping[str, float]) -> list[Limit]:
    """Return the inequality constraints of a section; an equality makes two with a margin.

    Parameters
    ----------
    scale
        Name of a result -> its absolute value at the start.
    """
    sides = ((section.least, 1.0), (section.most, -1.0))
    limits = [
        Limit(section.of, sign, bound_value)
        for bound_value, sign in sides
        if bound_value is not None
    ]
    if section.same_as:  # equal up to a margin
        margin = EQUALITY_TOLERANCE * max(
            scale.get(result, 0.0) for result in (section.of, section.same_as)
        )
        limits += [
            Limit(section.of, sign, other=section.same_as, margin=margin) for sign in (1.0, -1.0)
        ]
    return limits


def target_of(section: ShapeSection, case: Case, bent: float = 1.0) -> Target:
    """Return the target of a shape: undeformed places (n, 3) over R -> wanted places (n, 3).

    Parameters
    ----------
    bent
        Part of the curvature of a wanted curve, from 0 to 1.

    Raises
    ------
    CaseError
        If a curve is wanted of another shell than a strip, or begins elsewhere than at its root.
    """
    if section.components:  # the wanted place as three formulas
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
    """A spline through points, scaled to length one, as the target of the middle line of a strip.

    Places beside the middle line keep their distance from it, along y. The call maps undeformed
    places (n, 3) over R to wanted places (n, 3).

    Parameters
    ----------
    points
        (k, 3) from the root on, in any unit of length.
    bent
        Part of the curve's curvature that the target has.

    Attributes
    ----------
    _at
        Spline: arc length from 0 to 1 -> place (3,), over the length of the curve.
    """

    def __init__(self, points: Array, bent: float = 1.0) -> None:
        """Make the spline of the target over its arc length, from 0 at the root to 1 at the tip."""
        # parameter: the length along the chords
        chord = _lengths_along(points)
        spline = scipy.interpolate.CubicSpline(chord, points)
        dense_points = spline(np.linspace(0.0, chord[-1], SPLINE_POINTS))
        if bent != 1.0:
            dense_points = _with_part_of_curvature(dense_points, bent)
        arc_length = _lengths_along(dense_points)
        # place over arc length, both over the length of the curve
        self._at = scipy.interpolate.CubicSpline(
            arc_length / arc_length[-1], dense_points / arc_length[-1]
        )

    def __call__(self, x: Array) -> Array:
        """Return the wanted places (n, 3) of undeformed places (n, 3) over R.

        An undeformed strip lies along x from 0 to 1, so x is the arc length.
        """
        return np.asarray(self._at(x[:, 0])) + x[:, 1:2] * [0.0, 1.0, 0.0]


def _lengths_along(points: Array) -> Array:
    """Return the lengths (n,) along the chords from the first of points (n, 3) to each."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def _with_part_of_curvature(points: Array, part: float) -> Array:
    """Return the curve (n, 3) with a part of its curvature, and the same first tangent and lengths.

    Each turn between successive tangents is scaled by the part, in a frame that moves along the
    curve without twist.
    """
    steps = np.diff(points, axis=0)
    length = np.linalg.norm(steps, axis=1, keepdims=True)
    tangents = steps / length
    # `rotation` turns tangents of the given curve to those of the curve with less curvature
    new_tangents, rotation = [tangents[0]], np.eye(3)
    for tangent, next_tangent in itertools.pairwise(tangents):
        # the turn from one tangent to the next, as axis times angle
        axis_times_sine = np.cross(tangent, next_tangent)
        sine = np.linalg.norm(axis_times_sine)
        angle = np.arctan2(sine, tangent @ next_tangent)
        turn = axis_times_sine * (angle / max(float(sine), 1e-300))
        # undo the whole turn, and make a part of it
        rotation = rotation @ _rotation_matrix(part * turn) @ _rotation_matrix(-turn)
        new_tangents.append(rotation @ next_tangent)
    # the new curve follows the new tangents, with the old lengths
    return np.vstack([points[:1], points[0] + np.cumsum(length * np.array(new_tangents), axis=0)])


def _rotation_matrix(axis_times_angle: Array) -> Array:
    """Return the matrix (3, 3) of a rotation, given by axis times angle (3,)."""
    return np.asarray(scipy.spatial.transform.Rotation.from_rotvec(axis_times_angle).as_matrix())


@dataclass
class DesignGoal:
    """Objective and constraints of a design; results are scaled with their values at the start.

    Attributes
    ----------
    section
        The section `design` of the case.
    targets
        Name of a shape -> target of the present stage; at first that of the last one.
    stages
        For each stage before the last: such targets.
    scale
        Name of a result -> its absolute value at the start.
    """

    section: DesignSection
    targets: Mapping[str, Target]
    stages: Sequence[Mapping[str, Target]] = ()
    scale: dict[str, float] = field(default_factory=dict)

    @property
    def results(self) -> list[str]:
        """Names of the needed results, that of the objective first."""
        return self.section.results

    def begin(self, first: DesignEvaluation) -> None:
        """Scale results with their values at the start."""
        self.scale = {result: abs(value) or 1.0 for result, value in first.values.items()}

    def objective(self, evaluation: DesignEvaluation) -> float:
        """Return the scaled objective; the least value is the best."""
        objective, _ = self._objective(evaluation)
        return objective

    def slope(self, evaluation: DesignEvaluation) -> Array:
        """Return the gradient (p,) of the scaled objective by the variables."""
        _, derivative = self._objective(evaluation)
        return derivative * np.array(evaluation.gradients[self.section.objective.result])

    def _objective(self, evaluation: DesignEvaluation) -> tuple[float, float]:
        """Return the scaled objective, to be minimised, and its derivative by the result.

        With a wanted value it is the squared relative difference.
        """
        objective = self.section.objective
        # of several results, which are maximised, the lowest counts
        value = min(evaluation.values[result] for result in objective.results)
        own_scale = abs(value) or 1.0
        scale = self._objective_scale or own_scale
        if objective.value is not None:
            scale = abs(objective.value) or scale
            difference = value - objective.value
            return (difference / scale) ** 2, 2 * difference / scale**2
        sign = -1.0 if objective.maximise else 1.0
        return sign * value / scale, sign / scale

    @property
    def _objective_scale(self) -> float:
        """Largest absolute value of the objective's results at the start; 0 if unknown."""
        return max(
            (self.scale.get(result, 0.0) for result in self.section.objective.results), default=0.0
        )

    @property
    def lowest(self) -> bool:
        """Whether the lowest of several results, instabilities or frequencies is maximised."""
        objective = self.section.objective
        if objective.maximise is None:
            return False
        return len(objective.results) > 1 or objective.result in LOWEST

    @property
    def crossed(self) -> bool:
        """Whether the maximised values are instabilities or frequencies, which others may cross.

        Their number may change from point to point.
        """
        return self.lowest and any(result in LOWEST for result in self.section.objective.results)

    def lowest_values(self, evaluation: DesignEvaluation) -> Array:
        """Return the values (n,) of which the lowest is maximised, over the scale.

        They are the objective's results, each with the instabilities or frequencies next to it.
        Their number is constant: missing ones are replaced by an upper bound.
        """
        # for each result its value and those next to it, without gradients
        groups = list[list[float]]()
        for result in self.section.objective.results:
            values_and_slopes = _value_and_close_ones(
                evaluation.values[result], evaluation.beside.get(result)
            )
            groups.append([value for value, _ in values_and_slopes])
        return np.asarray(np.concatenate(groups) / self._objective_scale)

    def lowest_slopes(self, evaluation: DesignEvaluation) -> Array:
        """Return the gradients (n, p) of `lowest_values`, in the same order."""
        # for each result its gradient and those of the values next to it
        groups = list[list[Sequence[float]]]()
        for result in self.section.objective.results:
            values_and_slopes = _value_and_close_ones(
                evaluation.values[result],
                evaluation.beside.get(result),
                evaluation.gradients[result],
            )
            groups.append([slope for _, slope in values_and_slopes])
        return np.asarray(np.concatenate(groups) / self._objective_scale)

    def constraints(self, evaluation: DesignEvaluation) -> Array:
        """Return the scaled slacks of the constraints; negative where one is violated."""
        return np.array(
            [limit.slack(evaluation.values) / self._slack_scale(limit) for limit in self._limits]
        )

    def constraint_slopes(self, evaluation: DesignEvaluation) -> Array:
        """Return the gradients (constraints, variables) of `constraints`."""
        return np.array(
            [limit.slope(evaluation.gradients) / self._slack_scale(limit) for limit in self._limits]
        )

    @property
    def _limits(self) -> list[Limit]:
        """The inequality constraints of all sections; their scale needs the values at the start."""
        return [
            limit
            for section in self.section.constraints
            for limit in limits_of(section, self.scale)
        ]

    def _slack_scale(self, limit: Limit) -> float:
        """Return the scale of a constraint's slack.

        It is the absolute bound; without a bound, or with the bound zero, the larger of the two
        results at the start; and 1 if these are zero too.
        """
        scale = abs(limit.bound) or max(
            self.scale.get(result, 0.0) for result in (limit.of, limit.other)
        )
        return scale or 1.0

    def violation(self, evaluation: DesignEvaluation) -> float:
        """Return the largest relative violation of the constraints; zero if all are satisfied."""
        return float(max([0.0, *(-self.constraints(evaluation))]))

    def merit(self, evaluation: DesignEvaluation) -> tuple[float, float]:
        """Return violation and objective of an evaluation, by which evaluations are compared.

        The least pair is the best; a violation within the tolerance counts as zero.
        """
        violation = self.violation(evaluation)
        return (violation if violation > CONSTRAINT_TOLERANCE else 0.0, self.objective(evaluation))

    def words(self, evaluation: DesignEvaluation) -> str:
        """Return the results of an evaluation as text."""
        return ", ".join(
            f"{key} = {value:.6g}" for key, value in (evaluation.values | evaluation.seen).items()
        )

    def missed(self, evaluation: DesignEvaluation) -> str:
        """Return sentences about missed targets and constraints; "" if none is missed."""
        objective, sentences = self.section.objective, list[str]()
        if objective.value is not None and objective.reach:
            value = evaluation.values[objective.reach]
            if abs(value - objective.value) > TARGET_TOLERANCE * (abs(objective.value) or 1.0):
                request = (
                    f"{objective.reach} = {objective.value:g} is not reached within the bounds"
                )
                sentences.append(f"{request}: the nearest found is {value:.6g}")
        for limit in self._limits:
            # the margin of an equality is in its slack
            if limit.slack(evaluation.values) < -CONSTRAINT_TOLERANCE * self._slack_scale(limit):
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
    """Return a result and the values next to it, each with its gradient (p,).

    Parameters
    ----------
    value, slope
        The result and its gradient.
    close_values
        Values and gradients of further instabilities; None for a result that no other crosses.

    Returns
    -------
    The result alone if nothing crosses it; else exactly `MAX_INSTABILITIES` pairs, of which missing
    ones are an upper bound.
    """
    if close_values is None:
        return [(value, slope)]
    upper_value = (MAX_LOAD_RATIO * value, [MAX_LOAD_RATIO * v for v in slope])
    return [(value, slope), *close_values, *[upper_value] * MAX_INSTABILITIES][:MAX_INSTABILITIES]


def design_goal_of(case: Case, section: DesignSection) -> DesignGoal:
    """Build the goal of a design section, with a target for each stage of a wanted curve."""
    shape = section.objective.shape
    if shape is None:
        return DesignGoal(section, {})
    curvature_parts = [(i + 1) / shape.stages for i in range(shape.stages)]
    *stages, last_targets = [
        {"shape": target_of(shape, case, curvature_part)} for curvature_part in curvature_parts
    ]
    return DesignGoal(section, last_targets, stages)


def search_optimum(
    evaluated: Callable[[Array], DesignEvaluation],
    goal: DesignGoal,
    vary: Variables,
    first: Array,
    iterations: int,
) -> str:
    """Search the best variables; return the optimiser's message about its end.

    Parameters
    ----------
    evaluated
        Evaluates variables (p,); it has no values if the path is lost.
    vary
        The design variables with their bounds.
    first
        Variables (p,) at the start.
    iterations
        Largest number of the optimiser's steps.
    """
    if goal.crossed:  # results whose number or order changes
        return raise_lowest(evaluated, goal, vary.limits, first, iterations)
    if goal.lowest:  # several smooth results
        return _raise_lowest_smooth(evaluated, goal, vary, first, iterations)
    return _improve_smooth(evaluated, goal, vary, first, iterations)


def _improve_smooth(
    evaluated: Callable[[Array], DesignEvaluation],
    goal: DesignGoal,
    vary: Variables,
    first: Array,
    iterations: int,
) -> str:
    """Minimise the objective of one smooth result; return the optimiser's message about its end.

    Parameters
    ----------
    evaluated
        Evaluates variables (p,); it has no values if the path is lost.
    first
        Variables (p,) at the start.
    """
    # variables and objective of all evaluations with values
    tried: list[tuple[Array, float]] = []

    def objective(x: Array) -> tuple[float, Array]:
        """Return the objective and its gradient (p,)."""
        evaluation = evaluated(x)
        if not evaluation.values:
            # where the path is lost, the objective is worse than all, and rises from the best point
            best_x, _ = min(tried, key=lambda evaluated_point: evaluated_point[1])
            direction = x - best_x
            uphill = np.asarray(direction / max(float(np.linalg.norm(direction)), 1e-300))
            return max(value for _, value in tried) + WORSE, uphill
        value = goal.objective(evaluation)
        tried.append((np.array(x), value))
        return value, goal.slope(evaluation)

    def constraint_values(x: Array) -> Array:
        """Return the slacks of the constraints; where the path is lost, the last known ones."""
        evaluation, _ = evaluate_or_last(x)
        return goal.constraints(evaluation)

    def constraint_gradients(x: Array) -> Array:
        """Return the gradients (constraints, p) of `constraint_values`."""
        evaluation, _ = evaluate_or_last(x)
        return goal.constraint_slopes(evaluation)

    evaluate_or_last, method_options = _last_known(evaluated), dict[str, Any]()
    # without constraints L-BFGS-B is better, but it takes only bounds
    if goal.section.constraints:
        method_options = {
            "method": "SLSQP",
            "constraints": {"type": "ineq", "fun": constraint_values, "jac": constraint_gradients},
        }
    options = (
        {"maxiter": iterations, "ftol": 1e-9}
        if method_options
        else {"maxiter": iterations, "ftol": 1e-15, "gtol": 1e-9}
    )
    method_options = method_options or {"method": "L-BFGS-B"}
    ended = scipy.optimize.minimize(
        objective, first, jac=True, bounds=vary.limits, options=options, **method_options
    )
    return str(ended.message)


def _raise_lowest_smooth(
    evaluated: Callable[[Array], DesignEvaluation],
    goal: DesignGoal,
    vary: Variables,
    first: Array,
    iterations: int,
) -> str:
    """Raise the lowest of several results: maximise t with all results above t, for (x, t).

    Where two results cross, their minimum has a corner, at which an optimiser of smooth functions
    stops. This problem has none.

    Parameters
    ----------
    evaluated
        Evaluates variables (p,); it has no values if the path is lost.
    first
        Variables (p,) at the start.

    Returns
    -------
    The optimiser's message about its end.
    """
    evaluate_or_last = _last_known(evaluated)

    def values_above_level(z: Array) -> Array:
        """Return results less t, then slacks of constraints, for z = (x, t)."""
        evaluation, converged = evaluate_or_last(z[:-1])
        values: Array = np.concatenate(
            [goal.lowest_values(evaluation) - z[-1], goal.constraints(evaluation)]
        )
        # where the path is lost all constraints are violated, so the optimiser goes back
        return values if converged else np.full_like(values, -WORSE)

    def slopes(z: Array) -> Array:
        """Return the gradients (n + constraints, p + 1) of `values_above_level`."""
        evaluation, _ = evaluate_or_last(z[:-1])
        # derivatives by x, and by t
        gradients_by_x_and_t = (
            (goal.lowest_slopes(evaluation), -1.0),
            (goal.constraint_slopes(evaluation), 0.0),
        )
        return np.vstack(
            [
                np.column_stack([gradients, np.full(len(gradients), by_t)])
                for gradients, by_t in gradients_by_x_and_t
                if len(gradients)
            ]
        )

    start = np.append(first, goal.lowest_values(evaluated(first)).min())
    down = np.append(0 * first, -1.0)  # gradient of the objective -t
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
    """Wrap an evaluation so that it always has values.

    The new function returns the evaluation at x, and True. Where the path is lost, it returns the
    last evaluation that had values, and False.
    """
    last: list[DesignEvaluation] = []  # one item, which the inner function replaces

    def evaluate_or_last(x: Array) -> tuple[DesignEvaluation, bool]:
        """Return the evaluation at x and True; if it has no values, the last one and False."""
        evaluation = evaluated(x)
        if evaluation.values:
            last[:] = [evaluation]
        return last[0], bool(evaluation.values)

    return evaluate_or_last
