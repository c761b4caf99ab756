"""Free parameters of terms, and the derivatives of energies by them.

A parameter is a constant in forms, or an amplitude of the undeformed placement, to which shapes are
added that grow:

    r0 = r0_initial + sum_i mu_i d_i

Displacements are measured from r0, the shape without stress. All terms depend on it; their
derivatives by such an amplitude are differences of fourth order over steps of h/200, exact to about
1e-9. Theory: docs/theory.md, free parameters and growing imperfections.

Terms are energies mu_i Pi_i(u; p) with amplitudes mu_i (load parameters); a derivative by p keeps
the amplitude of its term. A slope is dPi_i/dp as a term. h is the thickness. A constant is a number
of UFL in forms; `value` is its present value.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Protocol

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm, ResidualAssembler, Term

Array = NDArray[np.float64]

# Step of differences: the largest displacement that it makes, over the system's length.
PLACEMENT_DIFFERENCE_STEP = 5e-3

# Numbers of steps, and weights over the step, of a first derivative of fourth order.
DIFFERENCE_WEIGHTS = ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12))


class SettableNumber(Protocol):
    """A number in the terms that may be set: a constant of forms, or an amplitude."""

    value: Any


class Derivative(Protocol):
    """The derivative of an energy by parameters, with the amplitude of its term."""

    @property
    def amplitude(self) -> str | None: ...

    def energy(self) -> float:
        """Return the derivative of the energy, this rank's part."""

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None:
        """Add factor times the derivative's gradient to the local vector."""


# Returns the derivatives of the slopes by another parameter.
SlopeDerivatives = Callable[[Any], Sequence[Derivative]]


@dataclass(frozen=True)
class FreeParameter:
    """A free parameter p of a system with the terms mu_i Pi_i(u; p).

    Attributes
    ----------
    constant
        p in the terms: a constant, or what takes its place.
    slopes
        dPi_i/dp as terms with the amplitudes mu_i.
    differentiate_slopes
        Called with another constant q in the terms, or with p itself. It returns the derivatives of
        the slopes by it. Where q is a `PlacementAmplitude`, its method `second_derivatives` is
        called instead, since forms cannot be differentiated by it.

    The private field `_second_derivatives` keeps the result for each q.
    """

    constant: SettableNumber
    slopes: Sequence[Derivative]
    differentiate_slopes: SlopeDerivatives
    _second_derivatives: dict[Any, Sequence[Derivative]] = field(default_factory=dict)

    def second_derivatives(self, q: Any) -> Sequence[Derivative]:
        """Return d2Pi_i/dp dq as terms with the amplitudes mu_i; they are made once.

        Parameters
        ----------
        q
            Another parameter as it stands in the terms, or p itself.
        """
        if q not in self._second_derivatives:
            # an amplitude of the placement differentiates by differences, a constant by forms
            if hasattr(q, "second_derivatives"):
                self._second_derivatives[q] = q.second_derivatives(self.constant)
            else:
                self._second_derivatives[q] = self.differentiate_slopes(q)
        return self._second_derivatives[q]


def make_parameters(
    constants: Mapping[str, fem.Constant], terms: Sequence[Term], u: fem.Function, log: KernelLog
) -> dict[str, FreeParameter]:
    """Return the free parameters of a model, by name. Collective.

    Parameters
    ----------
    constants
        Name -> the parameter as it stands in the forms of the terms.
    terms
        The terms; those without forms do not depend on the parameters.
    u
        The displacement in the forms.
    """
    form_terms = [term for term in terms if isinstance(term, FormTerm)]

    def derivatives(p: fem.Constant, terms: Sequence[FormTerm], suffix: str) -> list[FormTerm]:
        """Return the derivatives by p of the terms that have it, named by a suffix."""
        return [
            FormTerm(f"{term.name} {suffix}", derived(term.form, p), u, log, term.amplitude)
            for term in terms
            if p in term.form.constants()
        ]

    # residuals of slopes are needed from the start, second derivatives only on request
    parameters = {}
    for name, p in constants.items():
        slopes = derivatives(p, form_terms, f"by {name}")
        for slope in slopes:
            slope.compile_residual()
        differentiate_slopes = partial(derivatives, terms=slopes, suffix="twice")
        parameters[name] = FreeParameter(
            constant=p, slopes=slopes, differentiate_slopes=differentiate_slopes
        )
    return parameters


def derived(energy: ufl.Form, p: fem.Constant) -> ufl.Form:
    """Return the derivative of a form by a scalar constant p in it."""
    variable = ufl.variable(p)
    return ufl.diff(ufl.replace(energy, {p: variable}), variable)


class PlacementAmplitudes:
    """Amplitudes of shapes that are added to the undeformed placement.

    Parameters
    ----------
    r0
        The placement, which this object changes; at first all amplitudes are zero.
    shapes
        Amplitude -> the shape d, in the space of r0.
    length
        A small displacement, which scales the steps of differences.

    Attributes
    ----------
    initial_placement
        A copy of the placement with zero amplitudes.
    steps
        Amplitude -> step of its differences.

    Private fields: `_r0` is the placement, `_values` has the present value of each amplitude,
    `_shapes` the nodal values of each shape.
    """

    def __init__(self, r0: fem.Function, shapes: Mapping[str, fem.Function], length: float) -> None:
        """Copy the placement, and choose the step of each amplitude's differences. Collective."""
        self._r0, self.initial_placement = r0, r0.copy()
        self._values = dict.fromkeys(shapes, 0.0)
        self._shapes = {name: np.array(shape.x.array) for name, shape in shapes.items()}
        comm = r0.function_space.mesh.comm
        self.steps = {}
        for name, shape in self._shapes.items():
            largest = comm.allreduce(np.abs(shape).max(initial=0.0), MPI.MAX)
            self.steps[name] = PLACEMENT_DIFFERENCE_STEP * length / largest if largest else 1.0

    def value(self, name: str) -> float:
        """Return an amplitude of the present placement."""
        return self._values[name]

    def set_value(self, name: str, value: float) -> None:
        """Set an amplitude, and change the placement accordingly."""
        if value == self._values[name]:
            return
        self._values[name] = value
        added = sum(v * self._shapes[shape] for shape, v in self._values.items())
        self._r0.x.array[:] = self.initial_placement.x.array + added

    def differentiate(self, name: str, function: Callable[[float], float]) -> float:
        """Return a derivative by an amplitude, from values at neighbouring placements.

        The placement is as before afterwards.

        Parameters
        ----------
        name
            The amplitude.
        function
            Called with a weight, once at each placement of the difference. It returns the weight
            times the value there; the sum is the derivative.
        """
        value, step = self._values[name], self.steps[name]
        derivative = 0.0
        for number, weight in DIFFERENCE_WEIGHTS:
            self.set_value(name, value + number * step)
            derivative += function(weight / step)
        self.set_value(name, value)
        return derivative

    def parameters(
        self,
        terms: Sequence[Term],
        others: Mapping[str, FreeParameter],
        gradients: ResidualAssembler | None = None,
    ) -> dict[str, FreeParameter]:
        """Return the amplitudes as free parameters of the terms, by name.

        They have the interface of constants in forms, though only differences give derivatives.

        Parameters
        ----------
        others
            The other free parameters, by name.
        gradients
            Computes residuals of some terms instead of their forms; None: forms do.
        """
        amplitudes = {name: PlacementAmplitude(self, name, terms, others) for name in self._values}
        return {
            name: FreeParameter(
                constant=amplitude,
                slopes=amplitude.slopes(gradients),
                differentiate_slopes=amplitude.second_derivatives,
            )
            for name, amplitude in amplitudes.items()
        }


@dataclass(eq=False)
class PlacementAmplitude:
    """One amplitude of the placement, which takes the place of a constant in a form.

    Attributes
    ----------
    amplitudes
        All amplitudes of the placement.
    name
        The name of this one.
    terms
        The terms of the system.
    others
        Other free parameters, by name.
    """

    amplitudes: PlacementAmplitudes
    name: str
    terms: Sequence[Term]
    others: Mapping[str, FreeParameter]

    @property
    def value(self) -> float:
        """The amplitude of the present placement."""
        return self.amplitudes.value(self.name)

    @value.setter
    def value(self, value: float) -> None:
        self.amplitudes.set_value(self.name, float(value))

    def slopes(self, gradients: ResidualAssembler | None = None) -> list[Derivative]:
        """Return dPi_i/dmu as terms, one for each amplitude mu_i of terms.

        Parameters
        ----------
        gradients
            Computes residuals of some terms instead of their forms; None: forms do.
        """
        by_amplitude = dict[str | None, list[Term]]()
        for term in self.terms:
            by_amplitude.setdefault(term.amplitude, []).append(term)
        return [
            _PlacementDerivative(amplitude, self, terms, gradients)
            for amplitude, terms in by_amplitude.items()
        ]

    def second_derivatives(self, q: object) -> list[Derivative]:
        """Return d2Pi_i/dmu dq as terms with the amplitudes mu_i.

        Parameters
        ----------
        q
            The constant of another parameter, or another amplitude, or this one.
        """
        if isinstance(q, PlacementAmplitude):
            slopes: Sequence[Derivative] = q.slopes()
        else:
            slopes = next(
                parameter.slopes for parameter in self.others.values() if parameter.constant is q
            )
        return [_PlacementDerivative(slope.amplitude, self, [slope], None) for slope in slopes]

    def derivative_of(self, energy: Callable[[], float]) -> float:
        """Return the derivative by this amplitude of an energy that a function computes."""
        return self.amplitudes.differentiate(self.name, lambda weight: weight * energy())


@dataclass(frozen=True)
class _PlacementDerivative:
    """The derivative of some energies, which share an amplitude, by one of the placement.

    Attributes
    ----------
    amplitude
        The amplitude that multiplies the energies; None: 1.
    variable
        The amplitude of the placement by which they are differentiated.
    terms
        The energies.
    gradients
        Computes residuals of some of them; None: their forms do.
    """

    amplitude: str | None
    variable: PlacementAmplitude
    terms: Sequence[Term | Derivative]
    gradients: ResidualAssembler | None

    def energy(self) -> float:
        """Return the derivative of the energies, this rank's part."""
        return self.variable.derivative_of(lambda: sum(term.energy() for term in self.terms))

    def add_residual(self, b: Array, factor: float) -> None:
        """Add factor times the gradient of the derivative to the local vector b."""
        # names: the terms whose residual `gradients` computes; others: those with forms of their
        # own, and derivatives, which have no name
        assembled = self.gradients.names if self.gradients else frozenset[str]()
        names = [name for term in self.terms if (name := getattr(term, "name", "")) in assembled]
        others = [term for term in self.terms if getattr(term, "name", "") not in assembled]

        def add(weight: float) -> float:
            """Add the gradients at the present placement, times a weight, to b.

            The sum in b is the result. The value 0 is returned because `differentiate` sums values.
            """
            if self.gradients:
                self.gradients.add(b, dict.fromkeys(names, weight * factor))
            for term in others:
                term.add_residual(b, weight * factor)
            return 0.0

        self.variable.amplitudes.differentiate(self.variable.name, add)
