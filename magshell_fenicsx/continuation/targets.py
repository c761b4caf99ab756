"""Targets of a path by arc length: requested loads or displacements between two points, solved for.

Polynomials through the points predict where a target lies; Newton's method solves at its value.

A quantity is the load (amplitude) of the path or its conjugate, the displacement on which the load
does work. s is the arc length, measured from a point of the path. Predictors are the points that a
polynomial with their tangents goes through.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

from magshell_fenicsx.continuation.path import Path, Quantity
from magshell_fenicsx.continuation.point import PathStopped, Point

# a step ends at this multiple of the distance to the last target, so that its factors serve there
END_PAST_TARGET = 1.01
MIN_FRACTION_OF_STEP = 0.01  # of a planned step that ends behind a target
MAX_PREDICTORS = 4  # points that a polynomial goes through
# least distance of these points, over the distance of the two points around a target
MIN_PREDICTOR_DISTANCE = 0.1
ROUNDING_OF_TARGET = 1e-4  # in lengths: smaller distances tell no branches apart
MAX_TRIALS = 20
ZERO_TOLERANCE = 1e-6  # of the bracket that is left: nearer places are the same


class TargetMissed(PathStopped):
    """The solve at a requested point between two points failed, or left the branch."""


def end_near_last_target(
    path: Path, quantity: Quantity, target: float, s: float, predictors: Sequence[Point]
) -> float:
    """Return where a step to `s` ends: close behind the last target, if it would pass that.

    Parameters
    ----------
    quantity, target
        The quantity that is prescribed at the target, and its value there.
    predictors
        Points from which the step is extrapolated, the last one its start.
    """
    current = predictors[-1].s

    def difference(s: float) -> float:
        """Return the quantity at the predicted state, less its target."""
        return path.value(quantity, path.predicted_state(s, predictors)) - target

    if not difference(current) * difference(s) < 0:
        return s
    # a little behind the target, even if that is the current point but for rounding, and not behind
    # the planned end
    fraction = END_PAST_TARGET * (_zero(difference, current, s) - current) / (s - current)
    fraction = max(fraction, MIN_FRACTION_OF_STEP)
    return current + min(fraction, 1.0) * (s - current)


def targets_between(
    path: Path, quantity: Quantity, targets: Sequence[float], sense: float, points: Sequence[Point]
) -> Iterator[tuple[float, Point]]:
    """Yield the targets between two successive points of a path, in its order. Collective.

    Parameters
    ----------
    quantity, targets
        The quantity that is requested, and its values at the requested points.
    sense
        The sign of the change of the quantity along the path.
    points
        The two points, and before them the previous one, if there is one.

    Yields
    ------
    A target and its point, whose arc length is measured from the first of both points.

    Raises
    ------
    PathStopped
        If the path turns back at once, or a target is not found.
    """
    low, high = points[-2:]
    low_value, high_value = path.value(quantity, low.state), path.value(quantity, high.state)
    # the step begins at a target, and the quantity changes against its sense: the path seems to
    # turn back at once. The error makes the caller try a shorter step, which may see it rise first
    if low_value in targets and (high_value - low_value) * sense < 0:
        raise PathStopped(f"{path.name} falls from the start", low)
    # no polynomial continues behind a kink
    smooth_points = points[-2:] if path.newton.options.has_onsets else points
    predictors = [path.relative_to(low, path.measured_from(low, point)) for point in smooth_points]
    crossed_targets = [
        target
        for target in targets
        if (target - low_value) * (target - high_value) < 0 or high_value == target
    ]
    for target in sorted(crossed_targets, key=lambda target: abs(target - low_value)):
        point = path.measured_from(low, _solve(path, quantity, target, predictors))
        # it predicts the next target, as the last point before `high`
        predictors.insert(-1, path.relative_to(low, point))
        yield target, point


def _solve(path: Path, quantity: Quantity, target: float, points: Sequence[Point]) -> Point:
    """Return the point at a target between the last two of some points of a path.

    The polynomial through these and some earlier ones predicts it.

    Raises
    ------
    TargetMissed
        If the solve fails.
    """
    low, high = points[-2:]
    # both points, and earlier ones that are not too close: close ones would multiply rounding
    predictors = [low, high]
    for earlier in reversed(points[:-2]):
        distance = abs(predictors[0].s - earlier.s)
        is_far = distance > MIN_PREDICTOR_DISTANCE * abs(high.s - low.s)
        if len(predictors) < MAX_PREDICTORS and is_far:
            predictors.insert(0, earlier)

    def difference(s: float) -> float:
        """Return the quantity at the interpolated state, less its target."""
        return path.value(quantity, path.interpolated_state(s, *predictors)) - target

    s = _zero(difference, low.s, high.s)
    t = (s - low.s) / (high.s - low.s)
    # the stress at the target, interpolated between both points
    stress = [(1 - t, low.state.u), (t, high.state.u)]
    # the factors of the step's end serve where it is close, and the inertia does not change
    inertias = {(point.negative_pivots, point.negative_pivots_held) for point in (low, high)}
    is_close = abs(high.s - s) < 2 * (END_PAST_TARGET - 1) * abs(high.s - low.s)
    neighbour = high.state if len(inertias) == 1 and is_close else None
    guess = path.interpolated_state(s, *predictors)
    point = path.solve(path.prescribed(quantity, target), s, guess, stress, neighbour=neighbour)
    if isinstance(point, str):
        raise TargetMissed(f"a requested point cannot be found: {point}", low)
    # with a prescribed load or displacement Newton's method may end on another branch. The tangents
    # of both ends tell how far the path goes between them
    if path.are_apart(low, replace(high, state=point.state), ROUNDING_OF_TARGET):
        raise TargetMissed("a requested point was found on another branch", low)
    return point


def _zero(f: Callable[[float], float], low: float, high: float) -> float:
    """Return about where a function is zero between two places, by Illinois' regula falsi.

    It is the second place if the function has one sign at both.
    """
    a, b = f(low), f(high)
    place, side = high, 0  # side: which end was replaced last, -1 the low one, 1 the high one
    for _ in range(MAX_TRIALS if a * b < 0 else 0):
        previous, place = place, low + (high - low) * a / (a - b)
        is_same = abs(place - previous) <= ZERO_TOLERANCE * abs(high - low)
        if is_same or not (value := f(place)):
            break
        # the place replaces one end; Illinois: the value at an end that stays twice in turn is
        # halved
        if value * b < 0:
            b = b / 2 if side < 0 else b
            low, a, side = place, value, -1
        else:
            a = a / 2 if side > 0 else a
            high, b, side = place, value, 1
    return place
