"""Free parameters of terms, and the derivatives of energies by them.

A parameter is a constant in forms, or an amplitude of the undeformed placement, to which shapes are
added that grow:

    r0 = r0_initial + sum_i mu_i d_i

Displacements are measured from r0, the shape without stress. All terms depend on it; their
derivatives by such an amplitude are differences of fourth order over steps of h/200, exact to about
1e-9. Theory: docs/theory.md, free parameters and growing imperfections.
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
    """A number that terms depend on."""

    value: Any


class Derivative(Protocol):
    """An energy's derivative by parameters, with the amplitude of its term."""

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
        Returns the derivatives of the slopes by another parameter q in the terms, or by p itself.
        Where q is no constant but has a method `second_derivatives`, this is called instead.
    """

    constant: SettableNumber
    slopes: Sequence[Derivative]
    differentiate_slopes: SlopeDerivatives
    _second_derivatives: dict[Any, Sequence[Derivative]] = field(default_factory=dict)

    def second_derivatives(self, q: Any) -> Sequence[Derivative]:
        """Return d2Pi_i/dp dq with the amplitudes mu_i; q may be p."""
        if q not in self._second_derivatives:
            if hasattr(q, "second_derivatives"):
                self._second_derivatives[q] = q.second_derivatives(self.constant)
            else:
                self._second_derivatives[q] = self.differentiate_slopes(q)
        return self._second_derivatives[q]


def make_parameters(
    constants: Mapping[str, fem.Constant], terms: Sequence[Term], u: fem.Function, log: KernelLog
) -> dict[str, FreeParameter]:
    """Return the free parameters of a model, by name; collective.

    Parameters
    ----------
    constants
        The parameters as they stand in the forms of the terms.
    """
    form_terms = [term for term in terms if isinstance(term, FormTerm)]

    def derivatives(p: fem.Constant, terms: Sequence[FormTerm], suffix: str) -> list[FormTerm]:
        return [
            FormTerm(f"{term.name} {suffix}", derived(term.form, p), u, log, term.amplitude)
            for term in terms
            if p in term.form.constants()
        ]

    parameters = {}
    for name, p in constants.items():
        slopes = derivatives(p, form_terms, f"by {name}")
        for slope in slopes:
            slope.compile_residual()
        differentiate_slopes = partial(derivatives, terms=slopes, suffix="twice")
        parameters[name] = FreeParameter(p, slopes, differentiate_slopes)
    return parameters


def derived(energy: ufl.Form, p: fem.Constant) -> ufl.Form:
    """Return the derivative of a form by a constant in it."""
    variable = ufl.variable(p)
    return ufl.diff(ufl.replace(energy, {p: variable}), variable)


class PlacementAmplitudes:
    """Amplitudes of shapes that are added to the undeformed placement.

    Parameters
    ----------
    r0
        The placement, which this changes; at first all amplitudes are zero.
    shapes
        Amplitude -> d, in the space of r0.
    length
        A small displacement.

    Attributes
    ----------
    initial_placement
        A copy of the placement with zero amplitudes.
    steps
        Amplitude -> step of its differences.
    """

    def __init__(self, r0: fem.Function, shapes: Mapping[str, fem.Function], length: float) -> None:
        self._r0, self.initial_placement = r0, r0.copy()
        self._values = dict.fromkeys(shapes, 0.0)
        self._shapes = {name: np.array(d.x.array) for name, d in shapes.items()}
        comm = r0.function_space.mesh.comm
        self.steps = {}
        for name, d in self._shapes.items():
            largest = comm.allreduce(np.abs(d).max(initial=0.0), MPI.MAX)
            self.steps[name] = PLACEMENT_DIFFERENCE_STEP * length / largest if largest else 1.0

    def value(self, name: str) -> float:
        """Return an amplitude of the present placement."""
        return self._values[name]

    def set_value(self, name: str, value: float) -> None:
        """Change an amplitude of the placement."""
        if value == self._values[name]:
            return
        self._values[name] = value
        added = sum(v * self._shapes[shape] for shape, v in self._values.items())
        self._r0.x.array[:] = self.initial_placement.x.array + added

    def differentiate(self, name: str, function: Callable[[float], float]) -> float:
        """Return a derivative by an amplitude, from values at neighbouring placements.

        Parameters
        ----------
        function
            Returns a weight times the value at the present placement; it is called once for each
            placement of the difference.
        """
        value, step = self._values[name], self.steps[name]
        total = 0.0
        for number, weight in DIFFERENCE_WEIGHTS:
            self.set_value(name, value + number * step)
            total += function(weight / step)
        self.set_value(name, value)
        return total

    def parameters(
        self,
        terms: Sequence[Term],
        others: Mapping[str, FreeParameter],
        gradients: ResidualAssembler | None = None,
    ) -> dict[str, FreeParameter]:
        """Return the amplitudes as free parameters of the terms.

        Parameters
        ----------
        others
            The other free parameters.
        gradients
            Computes residuals of some terms instead of their forms.
        """
        amplitudes = {name: PlacementAmplitude(self, name, terms, others) for name in self._values}
        return {
            name: FreeParameter(
                amplitude, amplitude.slopes(gradients), amplitude.second_derivatives
            )
            for name, amplitude in amplitudes.items()
        }


@dataclass(eq=False)
class PlacementAmplitude:
    """One amplitude of the placement, which takes the place of a constant in a form."""

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
        """Return dPi_i/dmu as terms, one for each amplitude of terms."""
        by_amplitude = dict[str | None, list[Term]]()
        for term in self.terms:
            by_amplitude.setdefault(term.amplitude, []).append(term)
        return [
            _PlacementDerivative(amplitude, self, terms, gradients)
            for amplitude, terms in by_amplitude.items()
        ]

    def second_derivatives(self, q: object) -> list[Derivative]:
        """Return d2Pi_i/dmu dq with the amplitudes mu_i.

        Parameters
        ----------
        q
            The constant of another parameter, or another amplitude, or this one.
        """
        if isinstance(q, PlacementAmplitude):
            slopes: Sequence[Derivative] = q.slopes()
        else:
            slopes = next(other.slopes for other in self.others.values() if other.constant is q)
        return [_PlacementDerivative(slope.amplitude, self, [slope], None) for slope in slopes]

    def derivative_of(self, energy: Callable[[], float]) -> float:
        """Return the derivative of an energy by the amplitude."""
        return self.amplitudes.differentiate(self.name, lambda weight: weight * energy())


@dataclass(frozen=True)
class _PlacementDerivative:
    """The derivative of some energies, which share an amplitude, by one of the placement."""

    amplitude: str | None
    variable: PlacementAmplitude
    terms: Sequence[Term | Derivative]
    gradients: ResidualAssembler | None

    def energy(self) -> float:
        """Return the derivative of the energies, this rank's part."""
        return self.variable.derivative_of(lambda: sum(term.energy() for term in self.terms))

    def add_residual(self, b: Array, factor: float) -> None:
        """Add factor times its gradient to the local vector."""
        assembled = self.gradients.names if self.gradients else frozenset[str]()
        names = [name for term in self.terms if (name := getattr(term, "name", "")) in assembled]
        others = [term for term in self.terms if getattr(term, "name", "") not in assembled]

        def add(weight: float) -> float:
            if self.gradients:
                self.gradients.add(b, dict.fromkeys(names, weight * factor))
            for term in others:
                term.add_residual(b, weight * factor)
            return 0.0

        self.variable.amplitudes.differentiate(self.variable.name, add)
