"""The shell spins about e3: centrifugal forces, which grow with the square of its speed.

The amplitude (load parameter) "spin" is ρ ω² R²/E, with the angular speed ω, density ρ, reference
length R and Young's modulus E. A target is a value at which a step ends. A jet is a map with its
derivatives at a point.
"""

from math import sqrt
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field

from magshell_fenicsx.input.section import over_size
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.path_step import BodyForceStep
from magshell_fenicsx.parts.step_course import Target
from magshell_fenicsx.quantities.quantity import NEEDS_DENSITY, Quantity, Unit

if TYPE_CHECKING:
    from ufl.core.expr import Expr

SPEED = Unit(
    "√(E/ρ)/R", text="radian/second", size=lambda g: sqrt(g.E / g.rho) / g.R, needs=NEEDS_DENSITY
)
SQUARED = Unit("E/(ρ R²)", "1/s²", "per_s2", "1/s²", lambda g: g.E / (g.rho * g.R**2), symbol="ω²")


def _of_angles(value: Any) -> Any:
    """Return a speed unchanged; refuse hertz, which pint would read as radians per second."""
    if isinstance(value, str) and "z" in value.lower():
        raise ValueError(f"{value}: give rpm or rad/s, which say what turns")
    return value


class SpinStep(BodyForceStep):
    """The shell spins about e3 through the origin: the forces ρ ω² r away from the axis, where it
    has moved to.

    Points are equal parts of ω²; a `history` in time is of ω itself, over √(E/ρ)/R. Forces of
    Coriolis are left out: the shell rests beside its axis, and frequencies of such a shell are
    those without them.
    """

    amplitude: ClassVar[str] = "spin"
    targets: ClassVar[dict[str, Target]] = {"speed": Target("load", "spin", squared=True)}
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity(
            "spin",
            "spin squared",
            "Centrifugal load ρ ω² R²/E; in SI ω².",
            "load",
            "ρ ω² R²/E",
            (SQUARED,),
        ),
    )
    kind: Literal["spin"]
    speed: Annotated[float, over_size(SPEED), BeforeValidator(_of_angles)] | None = Field(
        default=None, ge=0, le=1e3
    )
    """Target of the angular speed ω, as "3000 rpm" or "300 rad/s" where the shell has a density
    [√(E/ρ)/R]"""

    def terms(self, context: Context) -> list[OwnTerm]:
        return [OwnTerm(context.step.name, energy, of_volume=True)]

    def account(self, context: Context) -> str:
        words = "centrifugal forces of a shell that spins about e3, amplitude"
        return f"{words} {context.step.name} = ρ ω² R²/E"


def energy(r0: Jet, u: Jet) -> "Expr":
    """Return the energy density of the centrifugal force for ρ ω² R²/E = 1.

    It is (d0² - d²)/2, with the distances d0 and d from the axis e3 before and after the
    displacement; without a displacement it is zero.
    """
    return -sum(u.r[i] * (r0.r[i] + u.r[i] / 2) for i in range(2))
