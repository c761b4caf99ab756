"""The base of parts and of all other abilities: what a section of a case adds to a problem.

An ability reads its section and what is around it in the case (`Context`), and gives fields of the
model's `Loads`, the symmetry that it preserves, its formulas, and its lines for `magshell check`.
"""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.quantities.quantity import CaseSizes, Quantity
from magshell_fenicsx.quantities.registry import register
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

if TYPE_CHECKING:
    from magshell_fenicsx.mesh.patch import Deviation
    from magshell_fenicsx.models.shell.spatial_fields import InsideRim
    from magshell_fenicsx.parts.step import ProgrammeStep, Step
    from magshell_fenicsx.shape.outline import Outline
    from magshell_fenicsx.shape.shell_sections import ShellSection, Surface

Array = NDArray[np.float64]
Kind = TypeVar("Kind")
AnyStep = TypeVar("AnyStep", bound="Step")


@dataclass(frozen=True)
class Scales:
    """The scales of a case: R, h and E in its units; 1, h/R and 1 for a case without lengths."""

    R: float
    h: float
    E: float
    nu: float

    @property
    def force(self) -> float:
        """2πD/R over E h R."""
        return float(np.pi * (self.h / self.R) ** 2 / (6 * (1 - self.nu**2)))


@dataclass(frozen=True)
class Context:
    """The rest of a case around a part, which takes from this what it needs.

    Attributes
    ----------
    points
        Name -> place (3,) in the shell's length.
    sections
        Key of the case -> its section.
    steps
        The programme.
    is_programme
        Whether the programme is a list of the case file, so that no step comes before it.
    solid
        Whether the body is modelled in three dimensions.
    """

    shell: "ShellSection | Surface"
    points: Mapping[str, list[float]]
    sections: Mapping[str, Any]
    steps: "Sequence[ProgrammeStep]" = field(default=())
    is_programme: bool = True
    solid: bool = False

    def section_of(self, kind: type[Kind]) -> Kind | None:
        """Return the section of a class; None without one."""
        return next(
            (section for section in self.sections.values() if isinstance(section, kind)), None
        )

    @property
    def abilities(self) -> "list[Ability]":
        """All abilities of the case."""
        from magshell_fenicsx.parts.registered import abilities_of  # knows all parts

        return abilities_of(self)

    @property
    def missing_offers(self) -> "dict[Offer, str]":
        """The offers that abilities may need and the case has not -> what to do about that."""
        missing = dict[Offer, str]()
        for ability in self.abilities:
            missing |= ability.withdraws(self)
        if self.solid:
            missing["a mid-surface"] = "a solid has none: take model: shell"
        return missing

    def needs(self, key: str, *offers: "Offer", hint: str = "") -> None:
        """Check that the case has what a key needs.

        Parameters
        ----------
        hint
            What to do; without one, what gives back the offer.

        Raises
        ------
        ValueError
            With the first of the offers that is not there.
        """
        missing = self.missing_offers
        for offer in offers:
            if offer in missing:
                raise ValueError(f"{key}: needs {offer}; {hint or missing[offer]}")

    def loads(self, kind: "type[AnyStep]") -> "dict[str, AnyStep]":
        """Return amplitude -> its last step, of the steps of a kind."""
        return {step.name: step.load for step in self.steps if isinstance(step.load, kind)}

    def steps_before(self, number: int) -> "Sequence[ProgrammeStep]":
        """Return the steps of the programme before one with a number, from 1."""
        return self.steps[: number - 1]

    def driven_before(self, number: int) -> set[str]:
        """Return the amplitudes that steps before one have driven."""
        return {
            name for step in self.steps_before(number) for name in (step.name, *step.load.drives)
        }

    def has_modulus(self, what: str) -> None:
        """Check that there is a modulus, which something needs.

        Raises
        ------
        ValueError
            If there is none.
        """
        if self.shell.modulus is None:
            raise ValueError(f"shell.youngs_modulus is needed for {what}")

    def has_point(self, key: str, name: str | None) -> None:
        """Check that a point has a place.

        Raises
        ------
        ValueError
            With the key and the points that there are.
        """
        if name is not None and name not in self.points:
            names = ", ".join(self.points) or "none"
            raise ValueError(f"{key}: {name}: name it in points, with its place; there are {names}")

    def on_shell(self, key: str, polar: float) -> None:
        """Check that a direction from the centre of a sphere is a degree from its edge at least.

        Raises
        ------
        ValueError
            With what is allowed.
        """
        edge = self.shell.edge_polar
        if edge is not None and not 0 <= polar < edge - 1:
            smallest_polar = getattr(self.shell, "hole", None) or 0
            raise ValueError(
                f"{key}.at.polar: {polar:g} is not on the shell: allowed {smallest_polar:g} to "
                f"{edge - 1:g}"
            )

    @property
    def scales(self) -> Scales:
        """The scales of the case, in which there is a modulus where something needs it."""
        shell = self.shell
        assert shell.modulus is not None
        return Scales(
            shell.reference, shell.reference / shell.R_over_h, shell.modulus, shell.poisson_ratio
        )

    @property
    def time_unit(self) -> float | None:
        """R √(ρ/E), the unit of times, in seconds where the case has units; None without
        density."""
        density, modulus = self.shell.density, self.shell.youngs_modulus
        return (
            float(self.shell.reference * np.sqrt(density / modulus))
            if density and modulus
            else None
        )


@dataclass(frozen=True)
class Modelled:
    """The part of a shell that is modelled.

    Attributes
    ----------
    outline
        Of the shell with the imperfections that do not grow.
    turn
        Azimuth of the model's frame (rad).
    mirror
        Plane, in the model's frame, of the half that is modelled; None for all. A force on the
        plane, or on an edge across it, is shared by the halves; the loads of an edge of the other
        half are left out.
    plane
        The same plane in the frame of the case.
    axisymmetric
        Whether the meridian is modelled.
    deviations
        Key of each imperfection below `shell` -> its deviation, in the model's frame.
    vertices
        Amplitude of a load at one place -> name of the vertex there.
    patch_rims
        Name of the patch of each dimple -> whether places (n, 3) are within its rim.
    """

    outline: "Outline"
    turn: float
    mirror: Mirror | None
    plane: Mirror | None
    axisymmetric: bool
    vertices: Mapping[str, str]
    patch_rims: "Mapping[str, InsideRim]"
    deviations: "Mapping[str, Deviation]"


@dataclass(frozen=True)
class Formulas:
    """A key of the case with numbers or formulas of the undeformed place.

    Attributes
    ----------
    minimum, maximum
        Allowed values.
    length
        R in the unit of the places.
    load
        Whether it is a load: what is shorter than about sqrt(Rh) bends no shell then, and its
        moments are exact on elements of any size. Strains follow all else down to its last detail.
    deformed
        Whether it is of the deformed place, where nothing but the points of integration see it.
    """

    key: str
    values: Sequence[float | str]
    minimum: float
    maximum: float
    length: float
    load: bool = False
    deformed: bool = False


@dataclass(frozen=True)
class Account:
    """The lines of `magshell check` on one ability: what is in the model, and what is left out."""

    included: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


Offer = Literal[
    "a mid-surface",
    "the whole shell",
    "a thickness that does not change",
    "the area as drawn",
    "a material without viscosity",
]


@dataclass(frozen=True)
class InTime:
    """A load that may be a function of time, though no step drives it.

    Attributes
    ----------
    name
        In `history`.
    refused
        Why it may not be one here; empty if it may.
    """

    name: str
    refused: str


class Ability:
    """The base of what adds something to a problem, mostly a section of the case file.

    By default it adds nothing. One that is no section finds itself in a case (`from_context`). All
    stand in `ABILITIES` of `registered.py`.
    """

    @classmethod
    def from_context(cls, context: Context) -> Self | None:
        """Return the ability of a case; None without."""
        return context.section_of(cls)

    def refuse_unfit(self, context: Context) -> None:
        """Check that it goes with all else in the case.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """

    def withdraws(self, context: Context) -> "dict[Offer, str]":
        """Return what other abilities may need and a case with this one has not -> what to do."""
        return {}

    def in_time(self, context: Context, driven_amplitudes: Collection[str]) -> InTime | None:
        """Return its load that may be a function of time; None without.

        Parameters
        ----------
        driven_amplitudes
            The amplitudes that steps before have driven.
        """
        return None

    def patches(self) -> dict[str, Iterable[str]]:
        """Return its keys with values by patch -> the names of these."""
        return {}

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry that it preserves of a shell."""
        return []

    def formulas(self, context: Context) -> Iterable[Formulas]:
        """Return its formulas of the undeformed place."""
        return []

    def adds(self, context: Context, modelled: Modelled) -> dict[str, Any]:
        """Return fields of the model's `Loads`, to which those of other abilities are added."""
        return {}

    def refuse_unfit_values(self, context: Context, places: Array) -> None:
        """Check that it has values at places (n, 3) over R of the undeformed shell.

        Raises
        ------
        CaseError
            If one is not finite, or beyond all sense.
        """

    def warning(self, context: Context, places: Array) -> str | None:
        """Return what is unphysical in it at these places; None if nothing is."""
        return None

    def numbers(self, context: Context) -> list[str]:
        """Return lines of `magshell check` with its numbers on the undeformed shell."""
        return []

    def units(self, context: Context, units: CaseSizes) -> CaseSizes:
        """Return the sizes of units, with those that it gives."""
        return units


@dataclass(frozen=True)
class KeyAbility(Ability, Generic[Kind]):
    """An ability whose key has a list or a mapping, which is not empty.

    Attributes
    ----------
    sections
        The value of the key.
    """

    key: ClassVar[str]
    sections: Kind

    @classmethod
    def from_context(cls, context: Context) -> Self | None:
        sections = context.sections.get(cls.key)
        return cls(sections) if sections else None


class Part(Section, Ability):
    """A section of the case file whose energies are integrals over the mid-surface.

    A subclass needs one file and one line in `registered.py`. Its docstring and those of its keys
    appear in docs/case.md. `OwnTerm` finds the arguments, the symmetry and the derivatives of its
    densities, so a part works in every model.

    Attributes
    ----------
    quantities
        The columns that it adds to path.csv: the amplitude of each term under its name, and the
        observed integrals.
    absent
        The line of `magshell check` for a case without the part.
    """

    quantities: ClassVar[tuple[Quantity, ...]]
    absent: ClassVar[str]

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        register(cls.quantities)

    def refuse_unfit(self, context: Context) -> None:
        context.has_modulus(
            next(key for key, section in context.sections.items() if section is self)
        )

    def terms(self, scales: Scales) -> Sequence[OwnTerm]:
        """Return the energies, with the values of their amplitudes."""
        raise NotImplementedError

    def account(self, scales: Scales) -> str:
        """Return the line of `magshell check` for a case with the part."""
        raise NotImplementedError
