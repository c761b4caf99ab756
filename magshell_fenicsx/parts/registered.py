"""The lists of all parts, of all kinds of steps and of all observables; and the base of a case.

A part is a section of a case with a key of its own. An ability is what a section adds to a problem;
an observable what is read from a state. A step is a part of the load programme. An account is a
list of lines of `magshell check`. Own terms are energies that a program adds to a case. Classes are
named by text, so that this file can list them in order without importing each.
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from inspect import cleandoc
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from pydantic import Field, PrivateAttr, create_model

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.ability import Ability, Account, Context, Part
from magshell_fenicsx.parts.observables import Observables
from magshell_fenicsx.parts.step import Step

REGISTERED: dict[str, str] = {
    # key of the case file, and name of the file here -> the class in it
    "foundation": "Foundation",
}

KINDS_OF_STEPS: dict[str, str] = {
    # kind -> module here and class in it
    "pressure": "pressure.pressure.PressureSection",
    "indentation": "forces.indentation.IndentationSection",
    "field": "magnetism.field_step.FieldSection",
    "rotation": "magnetism.field_step.RotationSection",
    "natural": "natural.section.GrowthSection",
    "imperfection": "imperfections.growth.ImperfectionStep",
    "dead": "forces.dead_load_step.DeadSection",
    "edge": "supports.motion.EdgeSection",
    "contact": "bodies.contact_step.ContactSection",
    "source": "magnetism.source_step.SourceStep",
    "time": "motion.motion_step.TimeSection",
    "spin": "spin.SpinStep",
    "gravity": "gravity.GravityStep",
    "interaction": "magnetism.interaction.InteractionStep",
    "crease": "joints.CreaseStep",
}
FORMER_KINDS = (("fold", "crease"),)  # of older case files, with the present ones
KINDS_BEFORE_LOAD = (
    "natural",
    "crease",
    "interaction",
    "field",
)  # kinds of steps that may come before the one load, in order

ABILITIES = (  # module here and class in it, of those without a key and a line in REGISTERED
    "supports.boundary.BoundarySection",
    "magnetism.fields.MagneticSection",
    "magnetism.sensors.Sensing",
    "magnetism.field_maps.FieldMapping",
    "natural.section.NaturalSection",
    "imperfections.imperfection.Imperfect",
    "laminate.ShellLaminate",
    "laws.rubber_material.RubberMaterial",
    "motion.history.ViscousMaterial",
    "bodies.body.RigidBodies",
    "contact.contact_section.ShellContact",
    "joints.CaseJoints",
)
OBSERVABLE_CLASSES = (  # module here and class in it, in the order of columns
    "natural.section.NaturalObservables",
    "imperfections.growth.GrowingObservables",
    "pressure.pressure.PressureObservables",
    "forces.dead_load_step.ForcesObservables",
    "supports.reacting.ReactionsObservables",
    "magnetism.readings.FieldObservables",
    "magnetism.source_step.SourcesObservables",
    "magnetism.readings.SoftObservables",
    "magnetism.interaction.InteractionObservables",
    "magnetism.readings.SensorsObservables",
    "magnetism.field_maps.FieldMapsObservables",
    "bodies.contact_step.BodiesObservables",
    "contact.contact_observables.ContactObservables",
    "joints.CreaseObservables",
)
ACCOUNTS = (  # modules here with a function `account`, in the order of `magshell check`
    "magnetism.magnetisation",
    "natural.planned",
    "pressure.pressure",
    "forces.load_vectors",
    "supports.reacting",
    "bodies.body_setup",
    "contact.contact_section",
    "joints",
)


@dataclass(frozen=True)
class Origin:
    """The places where the keys of a case were written, and its data.

    Origins do not count when cases are compared: equal cases may come from different files.

    Attributes
    ----------
    place
        Location (keys that lead to a value) -> place in the file; None without a file.
    data
        Plain data of the case, as of `Source`; None without a file.
    context
        Context with which the data are validated: the folder of the case and the files that were
        read.
    """

    place: Callable[[tuple[str | int, ...]], str] | None = field(default=None, compare=False)
    data: dict[str, Any] | None = field(default=None, compare=False, repr=False)
    context: dict[str, Any] = field(default_factory=dict, compare=False, repr=False)


class WithOwnTerms(Section):
    """The base of a case."""

    _own_terms: tuple[OwnTerm, ...] = PrivateAttr(default=())
    _origin: Origin = PrivateAttr(default=Origin())

    def written_as(self, origin: Origin) -> Self:
        """Set the origin of the case, for messages that others make, and return the case."""
        self._origin = origin
        return self

    @property
    def origin(self) -> Origin:
        """The places where the case was written, and its data."""
        return self._origin

    @property
    def file_name(self) -> str:
        """The name of its case file; empty without one."""
        return Path(self._origin.place(())).name if self._origin.place else ""

    def with_place(self, message: str) -> str:
        """Return a message that begins with a key of the case, after the place of the key.

        A name after the key, such as that of a patch, is looked up below the key. Other messages
        are returned unchanged.
        """
        # "key.below: name: ..." or "key.below: ..."
        match = re.match(r"([a-z]\w*(?:\.\w+)*): (?:([\w.]+): )?", message)
        if not (match and self._origin.place):
            return message
        keys, name = match[1].split("."), match[2]
        if keys[0] not in type(self).model_fields:
            return message
        if name:
            keys.append(name)
        # numbers are positions in lists
        location = tuple(int(key) if key.isdecimal() else key for key in keys)
        return f"{self._origin.place(location)}: {message}"

    @property
    def own_terms(self) -> tuple[OwnTerm, ...]:
        """The user-defined energies, which every problem and scene of the case has."""
        return self._own_terms

    def with_terms(self, terms: Sequence[OwnTerm]) -> Self:
        """Return a copy of the case with user-defined energies, to be used as any other case."""
        copied = self.model_copy()
        copied._own_terms = tuple(terms)
        return copied

    @property
    def term_digests(self) -> dict[str, str | None]:
        """Hashes of the user-defined energies, by which a resumed run is recognised."""
        return {f"terms.{term.name}": term.digest for term in self._own_terms}


def step_class(name: str) -> type[Step]:
    """Return the class of the steps of a kind, or of those that drive an amplitude of this name."""
    if name in STEPS:
        return STEPS[name]
    return next(
        step_kind for step_kind in STEPS.values() if getattr(step_kind, "amplitude", None) == name
    )


def parts_of(context: Context) -> dict[str, Part]:
    """Return the registered parts that a problem has, by the keys of their sections."""
    return {key: part for key in PART_CLASSES if (part := context.sections.get(key)) is not None}


def abilities_of(context: Context) -> list[Ability]:
    """Return all abilities that a problem has: the registered parts first, then the others."""
    listed = (ability.from_context(context) for ability in ABILITY_CLASSES)
    return [*parts_of(context).values(), *(ability for ability in listed if ability is not None)]


def accounts(context: Context, loads: "Loads") -> list[Account]:
    """Return the lines of `magshell check` on all abilities of a model, in a fixed order."""
    return [import_module(f"{__package__}.{module}").account(context, loads) for module in ACCOUNTS]


def _class_at(path: str) -> Any:
    """Return the class at a path "module.Class" below this package."""
    module, _, name = path.rpartition(".")
    return getattr(import_module(f"{__package__}.{module}"), name)


PART_CLASSES: dict[str, type[Part]] = {
    key: getattr(import_module(f"{__package__}.{key}"), name) for key, name in REGISTERED.items()
}
STEPS: dict[str, type[Step]] = {kind: _class_at(path) for kind, path in KINDS_OF_STEPS.items()}
ABILITY_CLASSES: tuple[type[Ability], ...] = tuple(map(_class_at, ABILITIES))
OBSERVABLES: tuple[Observables, ...] = tuple(_class_at(path)() for path in OBSERVABLE_CLASSES)


def _meaning(part: type[Part]) -> str:
    """Return the first sentence of a part's docstring."""
    return cleandoc(part.__doc__ or "").split(".")[0]


if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads

    WithParts = WithOwnTerms
else:  # an optional key for each part
    WithParts = create_model(
        "WithParts",
        __base__=WithOwnTerms,
        **{
            key: (part | None, Field(default=None, description=_meaning(part)))
            for key, part in PART_CLASSES.items()
        },
    )
