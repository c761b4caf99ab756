"""The list of all parts, and of all kinds of steps."""

from functools import cache
from importlib import import_module
from inspect import cleandoc
from typing import TYPE_CHECKING

from pydantic import Field, create_model

from magshell_fenicsx.parts.own import WithOwnTerms
from magshell_fenicsx.parts.part import Account, Context, Part
from magshell_fenicsx.parts.step import Step

REGISTERED: dict[str, str] = {
    # key of the case file, and name of the file here -> the class in it
    "foundation": "Foundation",
}
PARTS: dict[str, type[Part]] = {
    key: getattr(import_module(f"{__package__}.{key}"), name) for key, name in REGISTERED.items()
}

KINDS_OF_STEPS: dict[str, str] = {
    # kind -> module here and class in it
    "pressure": "pressure.pressure.PressureSection",
    "indentation": "forces.indentation.IndentationSection",
    "field": "magnetism.field_step.FieldSection",
    "rotation": "magnetism.field_step.RotationSection",
    "natural": "natural.section.GrowthSection",
    "imperfection": "imperfections.growth.ImperfectionStep",
    "dead": "forces.dead.DeadSection",
    "edge": "supports.motion.EdgeSection",
    "contact": "bodies.press.ContactSection",
    "source": "magnetism.source_step.SourceStep",
    "time": "motion.step.TimeSection",
    "spin": "spin.SpinStep",
}
FIRST = ("natural", "field")  # the kinds of which steps may come before the one load of a case, in their order

WHAT_IS_SEEN = (  # module here and class in it, in the order of columns
    "natural.planned.NaturalSeen",
    "imperfections.growth.GrowingSeen",
    "pressure.pressure.PressureSeen",
    "forces.loads.ForcesSeen",
    "supports.reacting.Moved",
    "magnetism.sources.field.SourcesSeen",
    "magnetism.softness.SoftSeen",
    "magnetism.own_field.SensorsSeen",
    "bodies.standing.BodiesSeen",
)
ACCOUNTS = (  # modules here with a function `account`, in the order of `magshell check`
    "magnetism.magnetisation",
    "natural.planned",
    "pressure.pressure",
    "forces.loads",
    "supports.reacting",
    "bodies.standing",
)


def parts_of(context: Context) -> dict[str, Part]:
    """The registered parts that a problem has, by key."""
    return {key: part for key in PARTS if (part := context.sections.get(key)) is not None}


def accounts(context: Context, loads: "Loads") -> list[Account]:
    """What all rooms have in a model."""
    return [import_module(f"{__package__}.{module}").account(context, loads) for module in ACCOUNTS]


@cache
def seen() -> "tuple[Seen, ...]":
    """What all rooms see of a state; they need the solver, which takes long to import."""
    named = (path.rpartition(".") for path in WHAT_IS_SEEN)
    return tuple(getattr(import_module(f"{__package__}.{module}"), name)() for module, _, name in named)


def _step(path: str) -> type[Step]:
    module, _, name = path.rpartition(".")
    found: type[Step] = getattr(import_module(f"{__package__}.{module}"), name)
    return found


STEPS: dict[str, type[Step]] = {kind: _step(path) for kind, path in KINDS_OF_STEPS.items()}


def _meaning(part: type[Part]) -> str:
    """The first sentence of its docstring."""
    return cleandoc(part.__doc__ or "").split(".")[0]


if TYPE_CHECKING:
    from magshell_fenicsx.models.shell.parameters import Loads
    from magshell_fenicsx.parts.seen import Seen

    WithParts = WithOwnTerms
else:  # an optional key for each part
    WithParts = create_model(
        "WithParts",
        __base__=WithOwnTerms,
        **{key: (part | None, Field(default=None, description=_meaning(part))) for key, part in PARTS.items()},
    )
