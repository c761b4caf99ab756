"""The undeformed placement as a function of amplitudes: shapes that are added to it grow.

    r0 = r0_drawn + sum_i mu_i d_i

Displacements are measured from r0, the shape without stress. All terms follow it; their derivatives by an amplitude are
differences of fourth order over steps of h/200, exact to about 1e-9.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.assemblers import ResidualAssembler
from magshell_fenicsx.assembly.parameter import Derivative, FreeParameter
from magshell_fenicsx.assembly.terms import Term

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
        largest = {name: comm.allreduce(np.abs(d).max(initial=0.0), MPI.MAX) for name, d in self._shapes.items()}
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
        """The sum over neighbouring placements of a function of the weight: a derivative of what is linear in it."""
        here, step = self._values[name], self.steps[name]
        found = 0.0
        for number, weight in FOURTH:
            self.put(name, here + number * step)
            found += of(weight / step)
        self.put(name, here)
        return found

    def parameters(
        self, terms: Sequence[Term], others: Mapping[str, FreeParameter], gradients: ResidualAssembler | None = None
    ) -> dict[str, FreeParameter]:
        """The amplitudes as free parameters of the terms, beside the other ones."""
        return {name: GrowingParameter(GrowingValue(self, name, terms, others), gradients) for name in self._values}


@dataclass(eq=False)
class GrowingValue:
    """The value of an amplitude, which takes the place of a constant in a form."""

    growing: Growing
    name: str
    terms: Sequence[Term]
    others: Mapping[str, FreeParameter]

    @property
    def value(self) -> float:
        return self.growing.value(self.name)

    @value.setter
    def value(self, value: float) -> None:
        self.growing.put(self.name, float(value))

    def bends(self, q: object) -> list[Derivative]:
        """d2Pi_i/dmu dq with the amplitudes mu_i; q is the value of another parameter, or this one."""
        if isinstance(q, GrowingValue):
            slopes: Sequence[Derivative] = GrowingParameter(q, None).slopes
        else:
            slopes = next(other.slopes for other in self.others.values() if other.constant is q)
        return [_Slope(slope.amplitude, self, [slope], None) for slope in slopes]

    def slope_of(self, energy: Callable[[], float]) -> float:
        """The derivative of an energy."""
        return self.growing.by(self.name, lambda weight: weight * energy())


@dataclass(frozen=True)
class GrowingParameter:
    """An amplitude of the placement, as `assembly.parameter.Parameter`."""

    constant: GrowingValue
    gradients: ResidualAssembler | None

    @property
    def slopes(self) -> list[Derivative]:
        """dPi_i/dmu as terms."""
        terms = self.constant.terms
        each = {amplitude: [t for t in terms if t.amplitude == amplitude] for amplitude in (t.amplitude for t in terms)}
        return [_Slope(amplitude, self.constant, of, self.gradients) for amplitude, of in each.items()]

    def bends(self, q: object) -> list[Derivative]:
        """See `GrowingValue.bends`."""
        return self.constant.bends(q)


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
