"""All loads of a shell, dimensionless: the sum of what the parts of a problem contribute."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

from magshell_fenicsx.mesh.patch import Deviation
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.parameters import (
    AreaForce,
    DeadLoad,
    EdgeForce,
    EdgeMoment,
    Force,
    Move,
    PointForce,
    Potential,
)

if TYPE_CHECKING:
    from magshell_fenicsx.parts.bodies.body_contact import ContactBody
    from magshell_fenicsx.parts.contact.contact_section import Pair
    from magshell_fenicsx.parts.joints import Joint
    from magshell_fenicsx.parts.magnetism.field_maps import FieldMap
    from magshell_fenicsx.parts.magnetism.interaction import Interaction
    from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
    from magshell_fenicsx.parts.magnetism.sensors import Sensor
    from magshell_fenicsx.parts.natural.shape import Natural
    from magshell_fenicsx.parts.pressure.profile import PressureProfile
    from magshell_fenicsx.parts.stress import StressReading


@dataclass(frozen=True)
class Loads:
    """The loads of a shell, or what one part contributes to them.

    What is empty, None or False has no term and no kernel.

    Attributes
    ----------
    pressure
        Whether there is a live pressure.
    pressed_sides
        Patches that a live pressure acts on: 1 from outside, -1 from inside; empty: on all from
        outside.
    pressure_profile
        Polynomial of the deformed place that multiplies the live pressure; None for 1.
    forces, dead
        Amplitude -> the force, or the dead loads that grow together.
    magnetic
        The magnetisation in an applied field.
    user_terms
        User-defined energies.
    natural
        The natural shape.
    moves
        Prescribed motions of supports.
    contacts
        Rigid bodies that may touch the shell.
    growing_imperfections
        Amplitude -> imperfections that grow.
    remanence
        The magnetisation where no field is applied: it loads nothing, and is drawn.
    sensors
        Places where the shell's magnetic field is read.
    field_maps
        Grids on which the shell's magnetic field is computed.
    interaction
        How strongly the shell's magnetised parts act on each other; None if they do not.
    pairs
        The pairs that may touch: the shell itself, or parts of it.
    joints
        The edges that are joined.
    stress
        The points at which stresses are read; None without.
    """

    pressure: bool = False
    pressed_sides: Mapping[str, float] = field(default_factory=dict)
    pressure_profile: "PressureProfile | None" = None
    forces: Mapping[str, Force] = field(default_factory=dict)
    magnetic: "Magnetisation | None" = None
    dead: Mapping[str, tuple[DeadLoad, ...]] = field(default_factory=dict)
    user_terms: tuple[OwnTerm, ...] = ()
    natural: "Natural | None" = None
    moves: tuple[Move, ...] = ()
    contacts: "tuple[ContactBody, ...]" = ()
    growing_imperfections: Mapping[str, tuple[Deviation, ...]] = field(default_factory=dict)
    remanence: "Magnetisation | None" = None
    sensors: "tuple[Sensor, ...]" = ()
    field_maps: "tuple[FieldMap, ...]" = ()
    interaction: "Interaction | None" = None
    pairs: "tuple[Pair, ...]" = ()
    joints: "tuple[Joint, ...]" = ()
    stress: "StressReading | None" = None

    def __add__(self, other: "Loads") -> "Loads":
        """Return the sum of both: mappings and tuples are joined.

        Of other values the first one that is set counts.
        """
        values = dict[str, Any]()
        for entry in fields(self):
            mine, theirs = getattr(self, entry.name), getattr(other, entry.name)
            if isinstance(mine, Mapping):
                values[entry.name] = {**mine, **theirs}
            elif isinstance(mine, tuple):
                values[entry.name] = (*mine, *theirs)
            else:
                values[entry.name] = mine or theirs
        return Loads(**values)

    @property
    def all_dead(self) -> tuple[DeadLoad, ...]:
        """The dead loads of all amplitudes."""
        return tuple(load for loads in self.dead.values() for load in loads)

    @property
    def displaced(self) -> str | None:
        """The amplitude whose displacement is the column w_over_h; None if it is the pole's."""
        return next(iter((*self.forces, *self.dead)), None)


def moments(loads: Iterable[DeadLoad]) -> list[EdgeMoment]:
    """Return the moments among dead loads."""
    return [load for load in loads if isinstance(load, EdgeMoment)]


def potentials(loads: Iterable[DeadLoad]) -> list[OwnTerm]:
    """Return the energies of the dead loads that depend on the deformed place."""
    return [load.term for load in loads if isinstance(load, Potential)]


def forces(loads: Iterable[DeadLoad]) -> list[PointForce | EdgeForce | AreaForce]:
    """Return the forces among dead loads.

    Each does the work of its size times the displacement along it.
    """
    return [load for load in loads if isinstance(load, PointForce | EdgeForce | AreaForce)]
