"""Free parameters of a shell's energies: the derivatives of densities by them, at points."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.parameters import Parameter
from magshell_fenicsx.models.shell.energy import Density, ShellTerm
from magshell_fenicsx.models.shell.gradients import PointTerm
from magshell_fenicsx.models.shell.residual import FastResidual

Serve = Callable[[Sequence[PointTerm]], FastResidual]


@dataclass
class Slope:
    """A term's derivative by parameters, with the amplitude of the term."""

    name: str
    amplitude: str | None
    density: Density
    points: FastResidual = field(init=False)

    def energy(self) -> float:
        """On this rank's part, at the present u."""
        return self.points.energy(self.name)

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None:
        """Add factor times its derivative by u to the local vector (ghosts included)."""
        self.points.add(b, {self.name: factor})


def point_parameters(
    constants: Mapping[str, fem.Constant], terms: Sequence[ShellTerm], serve: Serve
) -> dict[str, Parameter]:
    """The free parameters of a shell, by name; collective.

    Parameters
    ----------
    constants
        The parameters as they stand in the densities of the terms.
    serve
        Makes what serves terms each apart.
    """
    found = {}
    for name, p in constants.items():
        of_terms = slopes(p, terms, f"by {name}", serve)
        for served in {id(slope.points): slope.points for slope in of_terms}.values():
            served.compile()
        found[name] = Parameter(p, of_terms, partial(slopes, terms=of_terms, words="twice", serve=serve))
    return found


def slopes(p: fem.Constant, terms: Sequence[PointTerm], words: str, serve: Serve) -> list[Slope]:
    """The derivatives of those terms that a parameter enters."""
    entered = [term for term in terms if any(q is p for q in term.density.parameters)]
    found = [Slope(f"{term.name} {words}", term.amplitude, derived(term.density, p)) for term in entered]
    points = serve(found) if found else None
    for slope in found:
        assert points
        slope.points = points
    return found


def derived(density: Density, p: fem.Constant) -> Density:
    """The density's derivative by a parameter of it."""

    def of(*arguments: Any) -> Expr:
        first = len(arguments) - len(density.parameters)
        here = [first + i for i, q in enumerate(density.parameters) if q is p]
        variable = ufl.variable(arguments[here[0]])
        given = [variable if i in here else argument for i, argument in enumerate(arguments)]
        return ufl.algorithms.expand_derivatives(ufl.diff(density.of(*given), variable))

    return replace(density, of=of, work=None, linear=())
