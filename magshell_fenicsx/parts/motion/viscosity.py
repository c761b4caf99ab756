"""The viscosity of a shell in motion."""

from typing import Annotated, Protocol, TypeAlias

from pydantic import Field

from magshell_fenicsx.input.section import Section, in_units
from magshell_fenicsx.parts.motion.history import Time, measured
from magshell_fenicsx.parts.natural.section import NaturalSection

Ratio: TypeAlias = measured("pascal")  # type: ignore[valid-type]


class BranchSection(Section):
    """A branch of Maxwell: a spring in series with a dashpot, beside the elastic shell."""

    modulus: Ratio
    """Its Young's modulus, text with a unit, or a number over that of the shell"""
    time: Time
    """Its relaxation time"""


Branches = Annotated[list[BranchSection], Field(max_length=20)]


class Viscous(Protocol):
    """What has these keys."""

    viscosity: float | str | None
    relaxation: list[BranchSection]
    youngs_modulus: float | None


def refuse_unfit_viscosity(shell: Viscous, natural: NaturalSection | None, *, density: bool, solid: bool) -> None:
    """See that its numbers are positive and that their units have a meaning.

    Parameters
    ----------
    density
        Whether times and moduli may have units.
    solid
        Whether the model is a solid.

    Raises
    ------
    ValueError
        With the key and what is allowed.
    """
    times = {"viscosity": shell.viscosity, **{f"relaxation.{i}.time": b.time for i, b in enumerate(shell.relaxation)}}
    moduli = {f"relaxation.{i}.modulus": b.modulus for i, b in enumerate(shell.relaxation)}
    for key, value in (times | moduli).items():
        unit = "pascal" if key in moduli else "second"
        if value is None:
            continue
        if solid or (natural and natural.stretch):
            raise ValueError(f"shell.{key}: is of a shell, not of a solid, and not with natural.stretch")
        if in_units(unit)(value) <= 0:
            raise ValueError(f"shell.{key}: {value}: must be positive")
        if isinstance(value, str) and not density:
            raise ValueError(f"shell.{key}: {value}: its unit needs shell.density, youngs_modulus and lengths")
