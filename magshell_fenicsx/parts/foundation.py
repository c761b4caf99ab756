"""An elastic foundation: springs along the undeformed normal and in the surface, of stiffnesses
that may vary.

k and k_t are the stiffnesses along the normal n0 and in the surface, as forces per area and
displacement; their amplitudes (load parameters) are over E h/R², with Young's modulus E, thickness
h and reference length R. A jet is a map with its derivatives at a point. An `OwnTerm` is an energy
that the case adds to the model: its name, its density, the density's parameters, and the value of
its amplitude.
"""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Self

from pydantic import Field, model_validator

from magshell_fenicsx.input.expressions import Formula
from magshell_fenicsx.input.section import or_number
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.own_term import FormulaParameter, OwnTerm
from magshell_fenicsx.parts.ability import Context, Formulas, Part, Scales
from magshell_fenicsx.platform.lazy_import import lazy_import
from magshell_fenicsx.quantities.quantity import POINT_FORCE, STIFFNESS, Quantity

if TYPE_CHECKING:
    import ufl
    from ufl.core.expr import Expr
else:
    ufl = lazy_import("ufl")

Number = Annotated[float, Field(gt=0)]
Stiffness = Annotated[float, or_number("newton/metre**3", Number), Field(gt=0)]
MAX_FACTOR = 1e6


class Foundation(Part):
    """Winkler foundation: springs with the energy k w²/2 per undeformed area, w = -u·n0 the inward
    displacement.

    The springs resist tension and compression. On a solid they act on the outer face. Others lie in
    the surface, with the energy k_t |u_t|²/2 of the displacement u_t = u - (u·n0) n0.
    """

    stiffness: Stiffness | None = None
    """k, a force per area and displacement [E/R; force/length³]"""
    tangential: Stiffness | None = None
    """k_t of the springs in the surface [E/R; force/length³]"""
    factor: Formula | None = None
    """Multiplies k and k_t: a formula of x, y, z over R, not negative"""

    quantities = (
        Quantity(
            "foundation",
            "stiffness",
            "Stiffness k of the foundation.",
            "load",
            "k R²/(E h)",
            (STIFFNESS,),
        ),
        Quantity(
            "foundation_force",
            "reaction",
            "Reaction of the foundation, ∫ k w dA, positive outwards.",
            "load",
            "F_k R/(2πD)",
            (POINT_FORCE,),
        ),
        Quantity(
            "foundation_tangential",
            "stiffness",
            "Stiffness k_t of the foundation's springs in the surface.",
            "load",
            "k_t R²/(E h)",
            (STIFFNESS,),
        ),
    )
    key = "foundation"
    absent = "foundation: none"

    @model_validator(mode="after")
    def _has_springs(self) -> Self:
        if self.stiffness is None and self.tangential is None:
            raise ValueError("give stiffness, tangential, or both")
        return self

    def formulas(self, context: Context) -> Iterable[Formulas]:
        """Return the formula of the factor; empty without one."""
        return (
            [Formulas("foundation.factor", [self.factor], 0.0, MAX_FACTOR, 1.0)]
            if self.factor
            else []
        )

    def refuse_unfit(self, context: Context) -> None:
        context.has_modulus(self.key)

    def terms(self, context: Context) -> list[OwnTerm]:
        """Return the energies of the springs that are given, along the normal and in the surface.

        Their amplitudes are the stiffnesses over E h/R².
        """
        scales = context.scales
        stiffnesses = self._dimensionless(scales)  # of "k" and "k_t", those that are given
        energies = list[OwnTerm]()
        factor = (FormulaParameter(self.factor, "foundation.factor"),) if self.factor else (1.0,)
        # the springs along the normal also have a column of results, with the density `reaction`
        if "k" in stiffnesses:
            observed = {"foundation_force": reaction}
            energies.append(
                OwnTerm("foundation", energy, (scales.force, *factor), stiffnesses["k"], observed)
            )
        if "k_t" in stiffnesses:
            energies.append(
                OwnTerm("foundation_tangential", tangential_energy, factor, stiffnesses["k_t"])
            )
        return energies

    def account(self, context: Context) -> str:
        stiffnesses = ", ".join(
            f"{name} R²/(E h) = {value:.6g}"
            for name, value in self._dimensionless(context.scales).items()
        )
        return f"Winkler foundation, {stiffnesses}{', times a formula' if self.factor else ''}"

    def _dimensionless(self, scales: Scales) -> dict[str, float]:
        """Return the stiffnesses that are given, k and k_t by name, over E h/R²."""
        stiffnesses = {"k": self.stiffness, "k_t": self.tangential}
        return {
            name: k * scales.R**2 / (scales.E * scales.h)
            for name, k in stiffnesses.items()
            if k is not None
        }


def energy(r0: Jet, u: Jet, force: "Expr", factor: "Expr | float" = 1.0) -> "Expr":
    """Return the energy density k w²/2 of the foundation for k = 1, with w = -u . n0.

    The arguments are those of an `OwnTerm`: jets (maps with derivatives) of placement and
    displacement, then parameters. `force` is not used here.
    """
    return factor * ufl.dot(u.r, kin.normal(r0)) ** 2 / 2


def reaction(r0: Jet, u: Jet, force: "Expr", factor: "Expr | float" = 1.0) -> "Expr":
    """Return the density k w of the reaction for k = 1, with w = -u . n0.

    `force` is the unit of the force, by which the density is divided; `factor` multiplies k.
    """
    return -factor * ufl.dot(u.r, kin.normal(r0)) / force


def tangential_energy(r0: Jet, u: Jet, factor: "Expr | float" = 1.0) -> "Expr":
    """Return the energy density k_t |u_t|²/2 of springs in the surface for k_t = 1.

    |u_t|² is |u|² - (u . n0)²; `factor` multiplies k_t.
    """
    return factor * (ufl.dot(u.r, u.r) - ufl.dot(u.r, kin.normal(r0)) ** 2) / 2
