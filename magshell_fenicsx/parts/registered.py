"""The registered abilities, steps and observables, as classes; see `registry.py`.

An ability is what a section adds to a problem; a step is a part of the load programme; observables
are what is read from a state. All of them are imported here, so their columns are known.
"""

from typing import get_args

from magshell_fenicsx.parts.ability import Ability, Context, Part
from magshell_fenicsx.parts.observables import Observables
from magshell_fenicsx.parts.path_step import FactorStep
from magshell_fenicsx.parts.registry import registered_classes
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.quantities.registry import amplitude

ABILITY_CLASSES: tuple[type[Ability], ...] = registered_classes("abilities")
PART_CLASSES: dict[str, type[Part]] = {  # by their keys in a case
    ability.key: ability for ability in ABILITY_CLASSES if issubclass(ability, Part)
}
STEPS: dict[str, type[Step]] = {  # by their kinds
    kind: step_class
    for step_class in registered_classes("steps")
    for kind in get_args(step_class.model_fields["kind"].annotation)
}
FACTOR_STEPS = [  # what grows to a factor
    step_class for step_class in STEPS.values() if issubclass(step_class, FactorStep)
]
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


def strengths_of(context: Context) -> dict[str, float]:
    """Return amplitude -> its value at a factor of one, of loads whose strength a section gives."""
    strengths = {step_class.amplitude: step_class.strength(context) for step_class in FACTOR_STEPS}
    return {name: strength for name, strength in strengths.items() if strength is not None}


def section_of_strength(name: str) -> str:
    """Return the key of the section that gives the strength of a load, by its amplitude."""
    return next(step_class.section for step_class in FACTOR_STEPS if step_class.amplitude == name)


def strength_ratios(old: Context, new: Context) -> dict[str, float]:
    """Return amplitude -> strength of a load in a case over that in another, where they differ.

    The components of a load have its ratio. A load that is zero in the old case has none.
    """
    new_strengths, ratios = strengths_of(new), dict[str, float]()
    for name, strength in strengths_of(old).items():
        new_strength = new_strengths.get(name, 0.0)
        if strength and new_strength != strength:
            names = (name, *amplitude(name).components)
            ratios |= dict.fromkeys(names, new_strength / strength)
    return ratios


def abilities_of(context: Context) -> list[Ability]:
    """Return all abilities that a problem has, in the order in which they are registered."""
    abilities = (ability_class.from_context(context) for ability_class in ABILITY_CLASSES)
    return [ability for ability in abilities if ability is not None]
