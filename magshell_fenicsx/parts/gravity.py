"""The shell's own weight: its density times an acceleration along one direction."""

from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.section import DirectionVector, over_size
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.path_step import BodyForceStep
from magshell_fenicsx.parts.step_course import Target
from magshell_fenicsx.platform.lazy_import import lazy_import
from magshell_fenicsx.quantities.quantity import NEEDS_DENSITY, Quantity, Unit
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint, unit

if TYPE_CHECKING:
    import ufl
    from ufl.core.expr import Expr

    from magshell_fenicsx.shape.outline import Outline
else:
    ufl = lazy_import("ufl")

ACCELERATION = Unit(
    "E/(ρ R)",
    "m/s²",
    "m_per_s2",
    "m/s²",
    lambda g: g.E / (g.rho * g.R),
    text="metre/second**2",
    needs=NEEDS_DENSITY,
    symbol="g",
)


class GravityStep(BodyForceStep):
    """The shell's own weight, or that of a steady acceleration: the forces ρ g per volume along a
    direction.

    The weight follows the thickness where this varies, and acts in all of a solid. Steps in
    different directions have weights of their own, which add up: gravity, gravity_2.
    """

    amplitude: ClassVar[str] = "gravity"
    targets: ClassVar[dict[str, Target]] = {"acceleration": Target("load", "gravity")}
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity(
            "gravity",
            "gravity",
            "Weight ρ g R/E of the shell; in SI g.",
            "load",
            "ρ g R/E",
            (ACCELERATION,),
        ),
    )
    kind: Literal["gravity"]
    direction: DirectionVector = Field(default=[0.0, 0.0, -1.0])
    """Its three components, of any length; by default down e3"""
    acceleration: Annotated[float, over_size(ACCELERATION)] | None = Field(
        default=None, ge=-1e3, le=1e3
    )
    """Target of g, as "9.81 m/s^2" where the shell has a density; negative: against the direction
    [E/(ρ R)]"""

    @property
    def place(self) -> Any:
        return tuple(self.direction)

    @property
    def _unit_direction(self) -> NDArray[np.float64]:
        """The unit vector (3,) of the acceleration."""
        return unit(np.array(self.direction))

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        return [SymmetryConstraint(vectors=[self._unit_direction])]

    def terms(self, context: Context) -> list[OwnTerm]:
        return [OwnTerm(context.step.name, weight_energy, (self._unit_direction,), of_volume=True)]

    def account(self, context: Context) -> str:
        components = ", ".join(f"{c + 0.0:.3g}" for c in self._unit_direction)
        return f"the shell's weight along [{components}], amplitude {context.step.name} = ρ g R/E"


def weight_energy(r0: Jet, u: Jet, direction: "Expr") -> "Expr":
    """Return the density -u . g of the weight's energy for ρ g R/E = 1; zero without displacement.

    `r0` and `u` are jets (maps with derivatives), `direction` is the unit vector g.
    """
    return -ufl.dot(u.r, direction)
