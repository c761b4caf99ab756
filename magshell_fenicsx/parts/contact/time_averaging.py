"""The force of a contact between shells in a step in time: its mean along the straight way between
two displacements.

Contact sets in and ceases within a step, so that its force at one time of the step would create
energy. The force of a point, and its derivative, are those of Simpson's rule along the way. Where
that passes a kink of the penalty, factors give the point's force the work that its energy changes
by, and its derivative that of this quotient: for one place in a straight motion these are the mean
pressure of `gap.mean_pressure`. See docs/theory.md, Motion.

A sample is a displacement on the way; positions on it go from 0 to 1. The penalty has kinks of its
second derivative where contact begins, and at the soft penetration, up to which its stiffness
grows. A place is the closest place that a point faces, with the cell that has it. Offsets are half
the thickness where it varies (`face_offsets`). Generalised alpha is the scheme of time integration:
it takes forces at a part of the step, and dissipates high frequencies. A frozen contact has the
active set, the places in contact, of one state.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.free_parameters import FreeParameter
from magshell_fenicsx.assembly.nonlocal_terms import Entries
from magshell_fenicsx.parts.contact.contact_section import Pair
from magshell_fenicsx.parts.contact.face_offsets import FaceOffsets
from magshell_fenicsx.parts.contact.field_derivatives import (
    ContactFields,
    ContactState,
    with_growth,
)
from magshell_fenicsx.parts.contact.gap_derivatives import forces_on_nodes
from magshell_fenicsx.parts.gap import PENETRATION_ROUNDING, penalty

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
        k: float,
        soft_penetration: float,
    ) -> "SampleRates":
        """Return the penalties of places summed over each point's places.

        Parameters
        ----------
        count
            Number of points.
        point, penetration, closing
            (n,) for each place: number of its point, penetration, and increase of the penetration
            along the whole way.
        k, soft_penetration
            Stiffness of the penalty, which grows from zero to k over the soft penetration.
        """
        value, first, second = penalty(penetration, k, soft_penetration)
        # changes by rounding alone do not count, as they become divisors
        closing = np.where(np.abs(closing) > PENETRATION_ROUNDING * soft_penetration, closing, 0.0)
        # 0 for an open place, 1 up to the soft penetration, 2 beyond; summed over a point's places
        segment = np.digitize(penetration, (0.0, soft_penetration)).astype(float)
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


class TimeAveragedContact(Protocol):
    """A contact whose force may be the mean force of a step in time.

    Attributes
    ----------
    pair
        The two members of the contact.
    samples
        The samples of the step; empty while the contact has the force of the present state.
    sample
        The sample at which the contact is evaluated now; None for the present state.
    """

    pair: Pair
    samples: Sequence[StepSample]
    sample: StepSample | None

    @property
    def displacement(self) -> Array:
        """The present displacement (nodes, 2 or 3) of all cells; collective."""

    def penetration(self) -> float:
        """Return the largest penetration over R; collective."""

    def images_pass_through(self, u: Array, v: Array) -> bool:
        """Return whether points pass through a surface on the way from u to v; collective."""

    def sample_rates(self, motion: Array) -> SampleRates:
        """Return the penalty of the points at this sample, with its rates along a motion.

        The motion (nodes, 2 or 3) is the displacement of the whole step.
        """


def samples_of_step(
    contact: TimeAveragedContact, begin: Array, end: Array, part: float
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
    contact: TimeAveragedContact, compute: Callable[[], Value], *, tangent: bool = False
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


@dataclass
class StateNumber:
    """A number that a state sets."""

    value: float


class ContactTerm:
    """The base of the contact terms of a pair, on surfaces and on meridians.

    A subclass gives forces and `_entries` at one sample, and fixes its active set in `freeze`.

    Attributes
    ----------
    stiffness
        Stiffness k of the penalty, over E h/R^2.
    samples
        The samples of a step in time; empty while the contact has the force of the present state.
    sample
        The sample at which the contact is evaluated now; None for the present state.
    held
        The frozen contact of one state that replaces the search in all states; None without. It is
        set by `hold`.
    pair, name, group
        The two members, and the name of the term, which is also that of its group.
    amplitude, column
        None and "": no load parameter multiplies the energy, which has no column in results.

    The field `_at` is the displacement of the last active set. `_fields` are the fields of the case
    on which gaps depend, and `_offsets` is half the thickness at nodes; None where it is h/2.
    `_frozen` is the frozen contact that replaces the search, if there is one.
    """

    amplitude = None
    column = ""

    def __init__(self, pair: Pair, fields: ContactFields, offsets: FaceOffsets | None) -> None:
        """Begin outside a step in time, with the pair's stiffness, and with no contact held.

        Parameters
        ----------
        fields
            The fields of the case on which gaps depend, such as the thickness.
        offsets
            Half the thickness at nodes; None where it is h/2 everywhere and in all states.
        """
        self.pair, self.name = pair, f"contact{pair.suffix}"
        self._fields, self._offsets = fields, offsets
        self._at: Array = np.zeros((0, 0))  # the displacement of the active set
        self.group = self.name
        self.stiffness = StateNumber(pair.stiffness)
        self.samples: Sequence[StepSample] = ()
        self.sample: StepSample | None = None
        self.held: Any = None
        self._frozen: Any = None  # the frozen contact that replaces the search, if there is one

    def hold(self, frozen: Any) -> None:
        """Fix the active set for all states by a frozen contact, or release it with None.

        Parameters
        ----------
        frozen
            The result of `freeze` at one state.
        """
        self.held = self._frozen = None
        # `expand_about` sets `_frozen`; called by itself it serves another scene's contact, and
        # then `held` stays None
        if frozen is not None:
            self.expand_about(frozen)
            self.held = frozen

    def expand_about(self, frozen: Any) -> None:
        """Use the active set of another scene on the same mesh, fixed, for all later states."""
        raise NotImplementedError

    @property
    def history(self) -> dict[str, tuple[StateNumber, float]]:
        """The numbers that a state sets, with defaults; see `FiniteElementSystem`."""
        return {self.pair.setting: (self.stiffness, self.pair.stiffness)}

    def add_residual(self, b: Array, factor: float) -> None:
        """Add factor dPi/du to the vector b; collective."""
        forces = at_each_sample(self, lambda: self._on_nodes(self._forces()))  # type: ignore[arg-type]
        self._add(b, factor * np.sum(forces, axis=0))

    def compile_residual(self) -> None:
        """Do nothing: the term has no forms."""

    compile_tangent = compile_residual

    def add_tangent(self, K: object, factor: float, clamped: object) -> None:
        """Add nothing: the tangent's assembly takes `entries`."""

    def entries(self) -> Entries:
        """Return this rank's entries of the tangent, summed over the samples of a step; collective.

        See `NonlocalTerm`.
        """
        # a position in the matrix may come several times: such entries are added
        samples = at_each_sample(self, self._entries, tangent=True)  # type: ignore[arg-type]
        rows, columns, values = zip(*samples, strict=True)
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)

    def entered(self, parameters: Mapping[str, FreeParameter]) -> dict[str, FreeParameter]:
        """Return the free parameters on which the faces depend, with this term's derivatives.

        Only the natural stretch moves faces, through the thickness of a shell that has grown. The
        result has this parameter alone, with the contact forces added to its derivatives; it is
        empty where nothing grows.

        Parameters
        ----------
        parameters
            Name -> number that varies in the energies.
        """
        amplitude = self._offsets.amplitude if self._offsets else None  # the natural stretch
        return {
            name: with_growth(p, self._state, self._add)
            for name, p in parameters.items()
            if p.constant is amplitude
        }

    def _on_nodes(self, forces: Array) -> Array:
        """Return the derivative (nodes, dim) by the displacement, from that by places and H.

        H depends on the displacement.
        """
        # `_forces` has set `_at` to its displacement
        return forces_on_nodes(self._offsets, self._at, forces)

    def _forces(self) -> Array:
        """Return the derivative (nodes, dim) of this rank's energy by the places of all nodes.

        (nodes, dim + 1) with that by the offsets H where they vary.
        """
        raise NotImplementedError

    def _entries(self) -> Entries:
        """Return the entries of the tangent at the present state or sample; collective."""
        raise NotImplementedError

    def _state(self) -> ContactState:
        """Return the contact at the present state, for derivatives by fields; collective."""
        raise NotImplementedError

    def _add(self, b: Array, forces: Array) -> None:
        """Add forces (nodes, 2 or 3) of this rank's points to the vector b; collective."""
        raise NotImplementedError
