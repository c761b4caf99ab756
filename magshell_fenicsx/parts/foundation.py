"""A Winkler foundation: springs along the undeformed normal, everywhere on the surface."""

from typing import Annotated

import ufl
from pydantic import Field
from ufl.core.expr import Expr

from magshell_fenicsx.input.section import or_number
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.part import Part, Scales
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.units import POINT_FORCE, STIFFNESS

Stiffness = Annotated[float, Field(gt=0)]


class Foundation(Part):
    """Winkler foundation: springs with the energy k w²/2 per undeformed area, w = -u·n0 the inward displacement.

    The springs resist tension and compression. On a solid they act on the outer face.
    """

    stiffness: Annotated[float, or_number("newton/metre**3", Stiffness), Field(gt=0)]
    """k, a force per area and displacement [E/R; force/length³]"""

    quantities = (
        Quantity("foundation", "stiffness", "Stiffness k of the foundation.", "load", "k R²/(E h)", (STIFFNESS,)),
        Quantity(
            "foundation_force",
            "reaction",
            "Reaction of the foundation, ∫ k w dA, positive outwards.",
            "load",
            "F_k R/(2πD)",
            (POINT_FORCE,),
        ),
    )
    absent = "foundation: none"

    def terms(self, scales: Scales) -> list[OwnTerm]:
        k, parameters = self._dimensionless(scales), (scales.force,)
        return [OwnTerm("foundation", energy, parameters, k, {"foundation_force": reaction})]

    def account(self, scales: Scales) -> str:
        return f"Winkler foundation, k R²/(E h) = {self._dimensionless(scales):.6g}"

    def _dimensionless(self, scales: Scales) -> float:
        return self.stiffness * scales.R**2 / (scales.E * scales.h)


def energy(r0: Jet, u: Jet, force: Expr) -> Expr:
    """The energy density for k = 1."""
    return ufl.dot(u.r, kin.normal(r0)) ** 2 / 2


def reaction(r0: Jet, u: Jet, force: Expr) -> Expr:
    """The density of the reaction for k = 1, over the unit of the force."""
    return -ufl.dot(u.r, kin.normal(r0)) / force
