"""The interaction of magnetised parts as a load: from none to all of it.

Parts are shells, or pieces of a mesh file, that are not connected. Each has a remanence and acts on
the others by its field. The load parameter (amplitude) `interaction` multiplies the energy of this
interaction; 1 is the physical value.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.magnetism.fields import MU_0, MagneticSection, strength
from magshell_fenicsx.parts.magnetism.sensors import is_read
from magshell_fenicsx.parts.observables import Observables
from magshell_fenicsx.parts.path_step import FactorStep
from magshell_fenicsx.parts.shell_sections import MeshSurface
from magshell_fenicsx.parts.step_course import StepCourse, Target
from magshell_fenicsx.quantities.quantity import Quantity

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads

AMPLITUDE = "interaction"
MAX_UNKNOWNS = 9000  # of a model, whose tangent then has 650 MB


@dataclass(frozen=True)
class Interaction:
    """Interaction of magnetised parts.

    Attributes
    ----------
    strength
        |Br|²/(mu_0 E), with the remanence Br in T and Young's modulus E.
    itself
        Whether each part acts on itself, too.
    """

    strength: float
    itself: bool = False


class InteractionStep(FactorStep):
    """What is magnetised begins to act on the other parts of the shell: the factor of their energy
    grows from 0 to 1.

    The square root of the factor multiplies the remanence in the interaction alone. By default the
    path is followed by arc length, through its folds.
    """

    amplitude: ClassVar[str] = AMPLITUDE
    section: ClassVar[str] = "magnetic"
    rank_before_load: ClassVar[int] = 3
    targets: ClassVar[dict[str, Target]] = {"factor": Target("load", AMPLITUDE)}
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity(
            AMPLITUDE,
            "interaction",
            "Factor of the energy of magnetised parts in each other's field.",
            "load",
        ),
    )
    kind: Literal["interaction"]
    factor: float | None = Field(default=None, ge=0, le=1e3)
    """Target of the factor; 1 by default, 0 switches the interaction off"""

    @classmethod
    def asked_for(cls, context: Context) -> bool:
        """Return whether the case has an interaction of magnetised parts."""
        return acts(context)

    def refuse_unfit(self, context: Context) -> None:
        """Refuse a step without an interaction of magnetised parts."""
        if not acts(context):
            raise ValueError(
                f"{context.step.key}.kind: interaction needs magnetic.interaction: others or all"
            )

    def unstable_alone(self, value: float, course: StepCourse, what: str) -> str:
        """Tell the user that the interaction alone makes the shell unstable, at factor `value`."""
        return (
            f"the interaction alone makes the shell unstable at {value:.9g} of it ({what}): to go "
            "on, take it as a load, kind: interaction"
        )


def acts(context: Context) -> bool:
    """Return whether magnetised parts act on each other."""
    magnetic = context.section_of(MagneticSection)
    return magnetic is not None and magnetic.interaction != "none"


def has_effect(context: Context) -> bool:
    """Return whether a field acts on the shell, something magnetic is read, or parts interact."""
    return bool(strength(context)) or is_read(context) or acts(context)


def interaction(context: Context) -> Interaction | None:
    """Return a case's interaction: its strength, and whether parts act on themselves too.

    None without an interaction.
    """
    magnetic, E = context.section_of(MagneticSection), context.shell.youngs_modulus
    if magnetic is None or not acts(context):
        return None
    assert magnetic.remanent
    assert magnetic.remanent.flux_density
    assert E
    return Interaction(
        strength=magnetic.remanent.flux_density**2 / (MU_0 * E),
        itself=magnetic.interaction == "all",
    )


def refuse_large(unknowns: int) -> None:
    """Check that a model with an interaction is small enough for a tangent with all entries.

    Raises
    ------
    CaseError
        With the number of unknowns that is allowed.
    """
    if unknowns > MAX_UNKNOWNS:
        raise CaseError(
            f"magnetic.interaction: the model has {unknowns} unknowns; as all of them act on "
            f"each other, at most {MAX_UNKNOWNS} are allowed: take a coarser mesh or a lower "
            "mesh.degree"
        )


def refuse_unfit_interaction(context: Context) -> None:
    """Check that the case has what its interaction needs: flux density, units, parts and a step.

    A case without an interaction passes.

    Raises
    ------
    CaseError
        With the key and what is allowed.
    """
    magnetic = context.section_of(MagneticSection)
    if magnetic is None or not acts(context):
        return
    has_flux_density = bool(magnetic.remanent and magnetic.remanent.flux_density)
    if not context.shell.youngs_modulus or not has_flux_density:
        raise CaseError(
            f"magnetic.interaction: {magnetic.interaction}: how strong it is follows from "
            "remanent.flux_density and shell.youngs_modulus: give both"
        )
    if not context.shell.with_units:
        raise CaseError(
            f"magnetic.interaction: {magnetic.interaction}: shell.youngs_modulus has no unit: "
            "give it in pascals, and lengths in units"
        )
    if magnetic.interaction == "others" and not isinstance(context.shell, MeshSurface):
        raise CaseError(
            f"magnetic.interaction: {magnetic.interaction}: acts between parts of a mesh file "
            "that are not connected: take geometry: mesh, or interaction: all or none"
        )
    if context.is_programme and AMPLITUDE not in {step.name for step in context.steps}:
        raise CaseError(
            f"magnetic.interaction: {magnetic.interaction}: no step of the programme drives it: "
            "begin loading with a step of kind: interaction, or take interaction: none"
        )


class InteractionObservables(Observables):
    """The factor of the interaction."""

    def free_amplitudes(self, loads: "Loads") -> Mapping[str, float]:
        return {AMPLITUDE: 0.0} if loads.interaction else {}
