"""The base of parts and of all other abilities: what a section of a case adds to a problem.

An ability reads its section and the rest of the case (`Context`). It contributes to the model's
`Loads`, and gives its energies, the symmetry that it preserves, its formulas, and its lines for
`magshell check`. Sections and the loads of steps are abilities alike.

An offer is a property of a case that some abilities need, such as "a mid-surface", and others
withdraw. A programme is the list of the case's steps, its loads one after the other; each drives an
amplitude (a load parameter, by name). R, h and E are reference length, thickness and Young's
modulus.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Literal, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import register
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

if TYPE_CHECKING:
    from magshell_fenicsx.mesh.patch import Deviation
    from magshell_fenicsx.models.shell.spatial_fields import InsideRim
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.shell_sections import ShellSection, Surface
    from magshell_fenicsx.parts.step import ProgrammeStep, Step
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
Kind = TypeVar("Kind")
AnyStep = TypeVar("AnyStep", bound="Step")
# whose directions in the surface are given by e1: there is no meridian about e3
GEOMETRIES_WITHOUT_MERIDIAN = ("strip", "plate", "mesh")


@dataclass(frozen=True)
class Scales:
    """The scales of a case: R, h and E in its units; 1, h/R and 1 for a case without lengths.

    Attributes
    ----------
    nu
        Poisson's ratio.
    """

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
    """The whole case around an ability, which reads from it what it needs.

    Attributes
    ----------
    shell
        The section of the shell.
    points
        Name -> place (3,) in the shell's length.
    sections
        Key of the case -> its section.
    steps
        The steps of the programme, in order.
    is_programme
        Whether the programme is a list of the case file, so that no step comes before it.
    solid
        Whether the body is modelled in three dimensions.
    current_step
        The step whose load reads the case; None where a section reads it.
    """

    shell: "ShellSection | Surface"
    points: Mapping[str, list[float]]
    sections: Mapping[str, Any]
    steps: "Sequence[ProgrammeStep]" = field(default=())
    is_programme: bool = True
    solid: bool = False
    current_step: "ProgrammeStep | None" = None

    @property
    def step(self) -> "ProgrammeStep":
        """The step whose load reads the case; loads alone may ask for it."""
        assert self.current_step is not None
        return self.current_step

    def at_step(self, step: "ProgrammeStep") -> "Context":
        """Return the case as the load of a step reads it."""
        return replace(self, current_step=step)

    @property
    def last_steps(self) -> "dict[str, ProgrammeStep]":
        """Amplitude -> the last step that drives it, which counts where several drive one."""
        return {step.name: step for step in self.steps}

    def section_of(self, kind: type[Kind]) -> Kind | None:
        """Return the first section of the case that is of a class; None without one."""
        return next(
            (section for section in self.sections.values() if isinstance(section, kind)), None
        )

    @property
    def abilities(self) -> "list[Ability]":
        """All abilities of the case."""
        from magshell_fenicsx.parts.registered import abilities_of  # knows all parts

        return abilities_of(self)

    @property
    def strengths(self) -> dict[str, float]:
        """Amplitude -> its value at a factor of one, of loads whose strength a section gives."""
        from magshell_fenicsx.parts.registered import strengths_of  # knows all steps

        return strengths_of(self)

    @property
    def missing_offers(self) -> "dict[Offer, str]":
        """The offers that the case lacks -> advice how to get each of them.

        An offer is a property of a case that an ability may need, such as "a mid-surface".
        """
        advice_by_offer = dict[Offer, str]()
        for ability in self.abilities:
            advice_by_offer |= ability.withdraws(self)
        if self.solid:
            advice_by_offer["a mid-surface"] = "a solid has none: take model: shell"
        return advice_by_offer

    def contributors(self, *, last_steps: bool = False) -> "list[tuple[Ability, Context]]":
        """Return all abilities, then the loads of steps, each with the case as it reads it.

        `last_steps` is whether of several steps with one name the last one counts alone.
        """
        steps = self.last_steps.values() if last_steps else self.steps
        loads = [(step.load, self.at_step(step)) for step in steps]
        return [*((ability, self) for ability in self.abilities), *loads]

    def needs(self, key: str, *offers: "Offer", hint: str = "") -> None:
        """Check that the case has the offers that a key needs.

        Parameters
        ----------
        key
            Key of the case that needs them, for the message.
        offers
            Properties of the case, such as "a mid-surface".
        hint
            Advice for the message; empty for the advice of `missing_offers`.

        Raises
        ------
        ValueError
            With the first of the offers that the case lacks.
        """
        advice_by_offer = self.missing_offers
        for offer in offers:
            if offer in advice_by_offer:
                raise ValueError(f"{key}: needs {offer}; {hint or advice_by_offer[offer]}")

    def loads(self, kind: "type[AnyStep]") -> "dict[str, AnyStep]":
        """Return amplitude -> load of its last step, of those steps whose load is of a class."""
        return {step.name: step.load for step in self.steps if isinstance(step.load, kind)}

    def steps_before(self, number: int) -> "Sequence[ProgrammeStep]":
        """Return the steps of the programme before the step with a number, counted from 1."""
        return self.steps[: number - 1]

    def driven_before(self, number: int) -> set[str]:
        """Return the amplitudes that steps before the step with a number have driven.

        A step drives the amplitude of its name, and perhaps amplitudes of other steps
        (`ProgrammeStep.drives`).
        """
        return {name for step in self.steps_before(number) for name in (step.name, *step.drives)}

    def has_modulus(self, what: str) -> None:
        """Check that the shell has a Young's modulus; `what` names the thing that needs it.

        Raises
        ------
        ValueError
            If there is none.
        """
        if self.shell.modulus is None:
            raise ValueError(f"shell.youngs_modulus is needed for {what}")

    def has_point(self, key: str, name: str | None) -> None:
        """Check that a named point has a place in the case; None as the name needs none.

        Raises
        ------
        ValueError
            With the key and the points that there are.
        """
        if name is not None and name not in self.points:
            names = ", ".join(self.points) or "none"
            raise ValueError(f"{key}: {name}: name it in points, with its place; there are {names}")

    def on_shell(self, key: str, polar: float) -> None:
        """Check that a polar angle (degrees) on a sphere is at least a degree inside its edge.

        Other geometries have no such edge, and are not checked.

        Raises
        ------
        ValueError
            With the allowed angles; the message begins with `key`.
        """
        edge = self.shell.edge_polar  # of a sphere (degrees); None of others
        if edge is not None and not 0 <= polar < edge - 1:
            smallest_polar = getattr(self.shell, "hole", None) or 0
            raise ValueError(
                f"{key}.at.polar: {polar:g} is not on the shell: allowed {smallest_polar:g} to "
                f"{edge - 1:g}"
            )

    @property
    def scales(self) -> Scales:
        """The scales of the case; to be used only where the case is known to have a modulus."""
        shell = self.shell
        assert shell.modulus is not None
        return Scales(
            shell.reference, shell.reference / shell.R_over_h, shell.modulus, shell.poisson_ratio
        )

    @property
    def time_unit(self) -> float | None:
        """The unit R √(ρ/E) of times, in seconds where the case has units; None without density."""
        density, modulus = self.shell.density, self.shell.youngs_modulus
        if not (density and modulus):
            return None
        return float(self.shell.reference * np.sqrt(density / modulus))


@dataclass(frozen=True)
class Modelled:
    """The part of a shell that is modelled, and the frame of its model.

    Attributes
    ----------
    outline
        The surface with its chart, with the imperfections that do not grow.
    turn
        Azimuth of the model's frame (rad).
    mirror
        Plane, in the model's frame, of the half that is modelled; None for all. A force on the
        plane, or on an edge across it, is shared by the halves; the loads of an edge of the other
        half are left out.
    plane
        The plane of `mirror` in the frame of the case.
    axisymmetric
        Whether the meridian is modelled.
    vertices
        Amplitude of a load at one place -> name of the vertex there.
    patch_rims
        Name of the patch of each dimple -> function that tells whether places (n, 3) are within the
        dimple's rim.
    deviations
        Key of each imperfection below `shell` -> its deviation, in the model's frame.
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
    key
        The key, for messages.
    values
        Numbers, and texts of formulas.
    minimum, maximum
        Allowed values.
    length
        R in the unit of the places.
    load
        Whether the values are a load. Details of a load that are shorter than about sqrt(Rh) do not
        bend a shell, and its moments are exact on elements of any size. Strains follow all other
        formulas down to the last detail.
    deformed
        Whether the formulas are of the deformed place, where only quadrature points evaluate them.
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
    """The lines of `magshell check` on one ability.

    Attributes
    ----------
    included
        What the model has by it.
    left_out
        What the model does not have.
    """

    included: list[str] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)


Offer = Literal[
    "a mid-surface",
    "the whole shell",
    "a thickness that does not change",
    "the area as drawn",
    "a material without viscosity",
]


class Ability:
    """The base of what adds something to a problem, mostly a section of the case file.

    The methods are called while a case becomes a problem; by default they add nothing. A subclass
    that is no section finds itself in a case by `from_context`. All subclasses are lines of
    `REGISTERED` in `registry.py`.
    """

    @classmethod
    def from_context(cls, context: Context) -> Self | None:
        """Return the ability if the case has it, else None."""
        return context.section_of(cls)

    def refuse_unfit(self, context: Context) -> None:
        """Check that the ability goes with the rest of the case.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """

    def withdraws(self, context: Context) -> "dict[Offer, str]":
        """Return the offers that a case with this ability lacks -> advice how to get them.

        An offer is a property of a case that other abilities may need.
        """
        return {}

    def patches(self) -> dict[str, Iterable[str]]:
        """Return the ability's keys with values by patch -> the names of these patches."""
        return {}

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry of a shell that the ability preserves; empty if it preserves all."""
        return []

    def formulas(self, context: Context) -> Iterable[Formulas]:
        """Return the ability's formulas of the undeformed place."""
        return []

    def terms(self, context: Context) -> Sequence[OwnTerm]:
        """Return the ability's energies that follow from densities, each with its amplitude."""
        return []

    def contribution(self, context: Context, modelled: Modelled) -> "Loads | None":
        """Return what the ability adds to the loads of the model; None if it adds nothing."""
        return None

    def account(self, context: Context) -> str:
        """Return the ability's line of `magshell check`; empty if other lines say everything."""
        return ""

    def refuse_unfit_values(self, context: Context, places: Array) -> None:
        """Check the ability's values at places (n, 3) over R of the undeformed shell.

        Raises
        ------
        CaseError
            If a value is not finite, or absurdly large.
        """

    def warning(self, context: Context, places: Array) -> str | None:
        """Return a warning about unphysical values at places (n, 3) over R; None without."""
        return None

    def numbers(self, context: Context) -> list[str]:
        """Return lines of `magshell check` with the ability's numbers on the undeformed shell."""
        return []


@dataclass(frozen=True)
class KeyAbility(Ability, Generic[Kind]):
    """An ability whose key in the case has a list or a mapping; it exists if that is not empty.

    Attributes
    ----------
    key
        Name of the key.
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
    """A section of the case file that adds something, and its columns of path.csv.

    Its docstring and those of its keys appear in docs/case.md. `OwnTerm` finds the arguments, the
    symmetry and the derivatives of its densities, so its energies hold in every model.

    Attributes
    ----------
    quantities
        The columns that it adds: the amplitude of each term under its name, and the observed
        integrals.
    key
        Its key in the case, which follows from the registry; not of steps.
    absent
        The line of `magshell check` for a case without the section; empty for none.
    """

    quantities: ClassVar[tuple[Quantity, ...]] = ()
    key: ClassVar[str]
    absent: ClassVar[str] = ""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        register(cls.quantities)
