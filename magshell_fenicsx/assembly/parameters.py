"""Free parameters of terms, and the derivatives of energies by them.

A parameter is a constant in forms, or an amplitude of the undeformed placement, to which shapes are
added that grow:

    r0 = r0_drawn + sum_i mu_i d_i

Displacements are measured from r0, the shape without stress. All terms follow it; their derivatives
by such an amplitude are differences of fourth order over steps of h/200, exact to about 1e-9.
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


class Settable(Protocol):
    """A number that terms depend on."""

    value: Any


class Derivative(Protocol):
    """An energy's derivative by parameters, with the amplitude of its term."""

    @property
    def amplitude(self) -> str | None: ...

    def energy(self) -> float: ...

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None: ...


Twice = Callable[[Any], Sequence[Derivative]]


@dataclass(frozen=True)
class Parameter:
    """A free parameter p of a system with the terms mu_i Pi_i(u; p).

    Attributes
    ----------
    constant
        p in the terms: a constant, or what takes its place.
    slopes
        dPi_i/dp as terms with the amplitudes mu_i.
    twice
        Makes the derivatives of the slopes by another parameter in the terms, or by p itself. Where
        q is no constant but has a method `bends`, that makes them.
    """

    constant: Settable
    slopes: Sequence[Derivative]
    twice: Twice
    _bends: dict[Any, Sequence[Derivative]] = field(default_factory=dict)

    def bends(self, q: Any) -> Sequence[Derivative]:
        """d2Pi_i/dp dq with the amplitudes mu_i; q may be p."""
        if q not in self._bends:
            self._bends[q] = q.bends(self.constant) if hasattr(q, "bends") else self.twice(q)
        return self._bends[q]


def make_parameters(
    constants: Mapping[str, fem.Constant], terms: Sequence[Term], u: fem.Function, log: KernelLog
) -> dict[str, Parameter]:
    """The free parameters of a model, by name; collective.

    Parameters
    ----------
    constants
        The parameters as they stand in the forms of the terms.
    """
    forms = [term for term in terms if isinstance(term, FormTerm)]

    def by(p: fem.Constant, entered: Sequence[FormTerm], words: str) -> list[FormTerm]:
        return [
            FormTerm(f"{term.name} {words}", derived(term.form, p), u, log, term.amplitude)
            for term in entered
            if p in term.form.constants()
        ]

    parameters = {}
    for name, p in constants.items():
        slopes = by(p, forms, f"by {name}")
        for slope in slopes:
            slope.compile_residual()
        parameters[name] = Parameter(p, slopes, partial(by, entered=slopes, words="twice"))
    return parameters


def derived(energy: ufl.Form, p: fem.Constant) -> ufl.Form:
    """The derivative of a form by a constant in it."""
    variable = ufl.variable(p)
    return ufl.diff(ufl.replace(energy, {p: variable}), variable)


Array = NDArray[np.float64]
STEP = 5e-3  # of the length, that the largest displacement of a difference has
FOURTH = ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12))  # steps and weights


class Growing:
    """The placement and its amplitudes.

    Parameters
    ----------
    r0
        The drawn placement, which this changes.
    shapes
        Amplitude -> d, in the space of r0.
    length
        A small displacement.

    Attributes
    ----------
    drawn
        A copy of the drawn placement.
    """

    def __init__(self, r0: fem.Function, shapes: Mapping[str, fem.Function], length: float) -> None:
        self._r0, self.drawn, self._values = r0, r0.copy(), dict.fromkeys(shapes, 0.0)
        self._shapes = {name: np.array(d.x.array) for name, d in shapes.items()}
        comm = r0.function_space.mesh.comm
        largest = {
            name: comm.allreduce(np.abs(d).max(initial=0.0), MPI.MAX)
            for name, d in self._shapes.items()
        }
        self.steps = {name: STEP * length / size if size else 1.0 for name, size in largest.items()}

    def value(self, name: str) -> float:
        """The amplitude of the present placement."""
        return self._values[name]

    def put(self, name: str, value: float) -> None:
        """Change an amplitude of the placement."""
        if value == self._values[name]:
            return
        self._values[name] = value
        grown = sum(v * self._shapes[each] for each, v in self._values.items())
        self._r0.x.array[:] = self.drawn.x.array + grown

    def by(self, name: str, of: Callable[[float], float]) -> float:
        """The sum over neighbouring placements of a function of the weight: a derivative of what is
        linear in it.
        """
        value, step = self._values[name], self.steps[name]
        total = 0.0
        for number, weight in FOURTH:
            self.put(name, value + number * step)
            total += of(weight / step)
        self.put(name, value)
        return total

    def parameters(
        self,
        terms: Sequence[Term],
        others: Mapping[str, Parameter],
        gradients: ResidualAssembler | None = None,
    ) -> dict[str, Parameter]:
        """The amplitudes as free parameters of the terms, beside the other ones."""
        values = {name: GrowingValue(self, name, terms, others) for name in self._values}
        return {
            name: Parameter(value, value.slopes(gradients), value.bends)
            for name, value in values.items()
        }


@dataclass(eq=False)
class GrowingValue:
    """The value of an amplitude, which takes the place of a constant in a form."""

    growing: Growing
    name: str
    terms: Sequence[Term]
    others: Mapping[str, Parameter]

    @property
    def value(self) -> float:
        return self.growing.value(self.name)

    @value.setter
    def value(self, value: float) -> None:
        self.growing.put(self.name, float(value))

    def slopes(self, gradients: ResidualAssembler | None = None) -> list[Derivative]:
        """dPi_i/dmu as terms."""
        together = dict[str | None, list[Term]]()
        for term in self.terms:
            together.setdefault(term.amplitude, []).append(term)
        return [_Slope(amplitude, self, of, gradients) for amplitude, of in together.items()]

    def bends(self, q: object) -> list[Derivative]:
        """d2Pi_i/dmu dq with the amplitudes mu_i; q is the value of another parameter, or this one."""
        if isinstance(q, GrowingValue):
            slopes: Sequence[Derivative] = q.slopes()
        else:
            slopes = next(other.slopes for other in self.others.values() if other.constant is q)
        return [_Slope(slope.amplitude, self, [slope], None) for slope in slopes]

    def slope_of(self, energy: Callable[[], float]) -> float:
        """The derivative of an energy."""
        return self.growing.by(self.name, lambda weight: weight * energy())


@dataclass(frozen=True)
class _Slope:
    """The derivative of some energies with one amplitude."""

    amplitude: str | None
    by: GrowingValue
    of: Sequence[Term | Derivative]
    gradients: ResidualAssembler | None

    def energy(self) -> float:
        """On this rank's part."""
        return self.by.slope_of(lambda: sum(one.energy() for one in self.of))

    def add_residual(self, b: Array, factor: float) -> None:
        """Add factor times its gradient to the local vector."""
        served = self.gradients.names if self.gradients else frozenset[str]()
        names = [name for one in self.of if (name := getattr(one, "name", "")) in served]

        def add(weight: float) -> float:
            if self.gradients:
                self.gradients.add(b, dict.fromkeys(names, weight * factor))
            for one in self.of:
                if getattr(one, "name", "") not in served:
                    one.add_residual(b, weight * factor)
            return 0.0

        self.by.growing.by(self.by.name, add)
