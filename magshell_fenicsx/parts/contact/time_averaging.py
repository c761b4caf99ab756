"""The force of a contact between shells in a step in time: its mean along the straight way between
two displacements.

Contact sets in and ceases within a step, so that its force at one time of the step would create
energy. The force of a point, and its derivative, are those of Simpson's rule along the way. Where
that passes a kink of the penalty, factors give the point's force the work that its energy changes
by, and its derivative that of this quotient: for one place in a straight motion these are the mean
pressure of `Penalty.mean_pressure`. See docs/theory.md, Motion.

A sample is a displacement on the way; positions on it go from 0 to 1. The penalty has kinks of its
second derivative where contact begins, and at the soft penetration, up to which its stiffness
grows. A place is the closest place that a point faces, with the cell that has it. Offsets are half
the thickness where it varies (`face_offsets`). Generalised alpha is the scheme of time integration:
it takes forces at a part of the step, and dissipates high frequencies. A frozen contact has the
active set, the places in contact, of one state.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.gap import PENETRATION_ROUNDING, Penalty

if TYPE_CHECKING:
    from magshell_fenicsx.parts.contact.pair_contact import PairContact

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Value = TypeVar("Value")
SIMPSON_RULE = ((0.0, 1 / 6), (0.5, 4 / 6), (1.0, 1 / 6))  # positions on the way, and weights
MAX_FACTOR = 4.0  # of a point's force; for one place in a straight motion it is at most 3


@dataclass(frozen=True)
class StepSample:
    """A displacement on the way of a step in time, with weights of the penalty there.

    Attributes
    ----------
    u
        (nodes, 2 or 3) displacement of all nodes.
    first, second
        (points,) factors of the first and second derivative of the penalty; None for 1.
    slope
        (points,) factor in place of `first` in the tangent, where it multiplies the derivative of
        the sample's geometry by the displacement.
    """

    u: Array
    first: Array | None = None
    second: Array | None = None
    slope: Array | None = None

    def weigh(
        self, point: NDArray[np.int64], penalties: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Array]:
        """Return the penalty of places with its two derivatives, times this sample's factors.

        Parameters
        ----------
        point
            (n,) number of each place's point.
        penalties
            (n,) the penalty and its first and second derivatives by the penetration.
        """
        if self.first is None or self.second is None:  # no factors: a sample that only gives rates
            return penalties
        value, first, second = penalties
        return value, self.first[point] * first, self.second[point] * second


@dataclass(frozen=True)
class SampleRates:
    """The penalty of each contact point at a sample of a step; (points,) each.

    Attributes
    ----------
    value
        The penalty.
    rate, curvature
        Its first and second derivative along the whole way, as if the motion were straight.
    segment
        A number that changes where the penalty passes a kink.
    """

    value: Array
    rate: Array
    curvature: Array
    segment: Array

    @classmethod
    def sum_over_points(
        cls,
        count: int,
        point: NDArray[np.int64],
        penetration: Array,
        closing: Array,
        penalty: Penalty,
    ) -> "SampleRates":
        """Return the penalties of places summed over each point's places.

        Parameters
        ----------
        count
            Number of points.
        point, penetration, closing
            (n,) for each place: number of its point, penetration, and increase of the penetration
            along the whole way.
        """
        value, first, second = penalty.derivatives(penetration)
        # changes by rounding alone do not count, as they become divisors
        rounding = PENETRATION_ROUNDING * penalty.soft_penetration
        closing = np.where(np.abs(closing) > rounding, closing, 0.0)
        segment = penalty.segments(penetration).astype(float)  # summed over a point's places
        values_of_places = value, first * closing, second * closing**2, segment
        return cls(
            *(np.bincount(point, values, count).astype(float) for values in values_of_places)
        )


class SampleCache(Generic[Value]):
    """A cache of values at the samples of the last step, as many as Simpson's rule has points.

    The field `_samples` has pairs of a state and its value. The next one to be dropped comes first.
    """

    def __init__(self) -> None:
        self._samples = list[tuple[Sequence[Any], Value]]()

    def get(self, state: Sequence[Any], compute: Callable[[], Value]) -> Value:
        """Return the value at a state, computed if the state is not among the cached ones.

        Parameters
        ----------
        state
            Arrays and numbers that identify the state.
        compute
            Returns the value at this state.
        """
        for i, (cached_state, value) in enumerate(self._samples):
            if all(map(np.array_equal, cached_state, state)):
                # the begin of a step is asked for at each iteration: it stays longest
                self._samples.append(self._samples.pop(i))
                return value
        value = compute()
        # two values stay, one less than the rule has points, and the new one comes after them
        copied_state = [np.array(item) for item in state]
        self._samples = [*self._samples[1 - len(SIMPSON_RULE) :], (copied_state, value)]
        return value


def samples_of_step(
    contact: "PairContact[Any]", begin: Array, end: Array, part: float
) -> list[StepSample]:
    """Return the samples whose weighted sum is the force of a contact in a step; collective.

    The force is Simpson's mean along the way, plus a force that dissipates as generalised alpha
    does: the change of the force over the step, times `part` - 1/2. At points that pass a kink the
    mean gets a factor so that its work is the change of the penalty's energy. The tangent is the
    derivative by the displacement at `part`, so the end of the way moves by 1/`part` of it. See
    docs/theory.md, Motion.

    Parameters
    ----------
    begin, end
        (nodes, 2 or 3) displacements at both ends of the step.
    part
        Position within the step, from 0 to 1, at which the system takes its forces.
    """
    # the penalty of each point, with its rates along the way, at the begin, in the middle and at
    # the end
    displacements = [begin + position * (end - begin) for position, _ in SIMPSON_RULE]
    rates = list[SampleRates]()
    for u in displacements:
        contact.sample = StepSample(u)  # without factors
        rates.append(contact.sample_rates(end - begin))
    contact.sample = None
    force_factor, slope_factor, factor_at_begin = _kink_factors(rates)
    opening_factor = factor_at_begin / part
    off_middle = part - 0.5
    samples = list[StepSample]()
    for u, (position, weight) in zip(displacements, SIMPSON_RULE, strict=True):
        # the dissipative force is that at the end less that at the begin; the middle has none
        dissipative = {0.0: -off_middle, 1.0: off_middle}.get(position, 0.0)
        slope = position * (weight * force_factor + dissipative) / part
        second = position * (weight * slope_factor + dissipative) / part
        samples.append(
            StepSample(
                u,
                first=np.asarray(weight * force_factor + dissipative),
                second=np.asarray(second if position else opening_factor),
                slope=np.asarray(slope),
            )
        )
    return samples


def _kink_factors(rates: Sequence[SampleRates]) -> tuple[Array, Array, Array]:
    """Return factors (points,) that correct Simpson's mean force where it passes a kink.

    At such points the work of the mean force is to be the change of the energy. The derivative by
    the end of the way is to be that of this change, less that of the way's length.

    Parameters
    ----------
    rates
        The penalty of each point at the begin, in the middle and at the end of the way.

    Returns
    -------
    force_factor, slope_factor
        Factors of the force, and of its derivative by the end of the way; 1 without a kink.
    factor_at_begin
        Factor of the derivative at the begin, for points that open; 0 for all others.
    """
    # work of Simpson's mean force, and its derivative by the end of the way
    positions, weights = np.transpose(SIMPSON_RULE)
    work = weights @ [sample_rates.rate for sample_rates in rates]
    curvature = (positions * weights) @ [sample_rates.curvature for sample_rates in rates]
    # what both are to be at points that pass a kink
    is_kink = np.any(
        [earlier.segment != later.segment for earlier, later in pairwise(rates)], axis=0
    )
    energy_change = rates[-1].value - rates[0].value
    end_slope = rates[-1].rate - energy_change
    force_factor = _factor(energy_change, work, is_kink)
    slope_factor = _factor(end_slope, curvature, is_kink)
    # a point that opens has no contact in the middle and at the end. Its force depends on the end
    # of the way only by the length of the way; the sample at the begin has this derivative
    is_opening = is_kink & (curvature == 0)
    factor_at_begin = np.where(is_opening, _factor(end_slope, rates[0].curvature, is_kink), 0.0)
    return force_factor, slope_factor, factor_at_begin


def _factor(target: Array, computed: Array, is_kink: Flags) -> Array:
    """Return factors (points,): at points with a kink the factor times `computed` is the target.

    Elsewhere, and where the computed number is zero, the factor is 1. It is at least 0 and at most
    `MAX_FACTOR`, for computed numbers that nearly vanish.
    """
    is_changed = is_kink & (computed != 0)
    ratio = np.divide(target, computed, out=np.ones_like(computed), where=is_changed)
    return np.clip(ratio, 0.0, MAX_FACTOR)


def at_each_sample(
    contact: "PairContact[Any]", compute: Callable[[], Value], *, tangent: bool = False
) -> list[Value]:
    """Return a value at each sample of the step; without a step, one at the present state.

    Parameters
    ----------
    compute
        Returns the value of the contact at its `sample`.
    tangent
        Whether the value belongs to the tangent, where `slope` counts in place of `first`.
    """
    if not contact.samples:
        return [compute()]
    values = list[Value]()
    for sample in contact.samples:
        contact.sample = replace(sample, first=sample.slope) if tangent else sample
        values.append(compute())
    contact.sample = None
    return values
