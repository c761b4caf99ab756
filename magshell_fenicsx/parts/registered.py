"""The registered abilities, steps and observables, as classes; see `registry.py`.

An ability is what a section adds to a problem; a step is a part of the load programme; observables
are what is read from a state. All of them are imported here, so their columns are known.
"""

from typing import get_args

from magshell_fenicsx.parts.ability import Ability, Context, Part
from magshell_fenicsx.parts.observables import Observables
from magshell_fenicsx.parts.registry import registered_classes
from magshell_fenicsx.parts.step import Step

ABILITY_CLASSES: tuple[type[Ability], ...] = registered_classes("abilities")
PART_CLASSES: dict[str, type[Part]] = {  # by their keys in a case
    ability.key: ability for ability in ABILITY_CLASSES if issubclass(ability, Part)
}
STEPS: dict[str, type[Step]] = {  # by their kinds
    kind: step_class
    for step_class in registered_classes("steps")
    for kind in get_args(step_class.model_fields["kind"].annotation)
}
FORMER_KINDS = (("fold", "crease"),)  # of steps in older case files, with the present ones
OBSERVABLES: tuple[Observables, ...] = tuple(
    observables_class() for observables_class in registered_classes("observables")
)


def step_class_of(name: str) -> type[Step]:
    """Return the class of the steps of a kind, or of those that drive an amplitude of this name."""
    if name in STEPS:
        return STEPS[name]
    return next(
        step_class
        for step_class in STEPS.values()
        if getattr(step_class, "amplitude", None) == name
    )


def abilities_of(context: Context) -> list[Ability]:
    """Return all abilities that a problem has, in the order in which they are registered."""
    abilities = (ability_class.from_context(context) for ability_class in ABILITY_CLASSES)
    return [ability for ability in abilities if ability is not None]
