"""Perturbation of a number of a problem, for differences of two scenes on the same mesh.

The problem is the one that a file with this number would give: lengths with units stay, those over
h or in the unit of a dimple's width change with these. States get its loads, and contact stays in
the same places.

A key is the path of a number in the case's file, such as "magnetic.remanent.polar"; a section is a
part of the file. Amplitudes are load parameters and stiffnesses of contact, by name in `State.mu`.
"""

from collections.abc import Collection
from functools import partial
from typing import Any

import numpy as np

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.section import is_length
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.kinds import LawKeys
from magshell_fenicsx.parts.registered import section_of_strength, strength_ratios
from magshell_fenicsx.parts.revolution_sections import MaterialSection
from magshell_fenicsx.quantities.registry import amplitude, quantity
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.scene_cache import SceneCache, UnfitMesh

# keys of a shell whose numbers change neither its mesh nor its perfect shape, and imperfections
DIFFERENTIABLE_KEYS = {
    *MaterialSection.model_fields,
    *LawKeys.model_fields,
    *("laminate", "radius_to_thickness", "imperfections", "defect"),
}
KEYS_OUTSIDE_THE_MODEL = (
    "mesh",
    "stability",
    "frequencies",
    "gradients",
    "ensemble",
    "design",
    "identify",
    "output",
)
KEYS_WITHOUT_GRADIENT = (*KEYS_OUTSIDE_THE_MODEL, "loading", "points", "boundary")


def number_at_key(context: Context, key: str) -> float:
    """Return the number of a case at a key such as "magnetic.remanent.polar".

    Raises
    ------
    CaseError
        If there is no number, or one that changes the mesh, a target or the modes of the perfect
        shell.
    """
    number, _ = _value_and_length(context, key)
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise CaseError(f"{key}: is no number that the case gives: {number!r}")
    if isinstance(number, int):
        raise CaseError(f"{key}: is a whole number: it has no gradient")
    if key.startswith("magnetic.remanent.layers.") and key.endswith(".fraction"):
        raise CaseError(
            f"{key}: the fractions of the layers add up to 1: one alone has no gradient"
        )
    if key.startswith("shell.laminate.plies.") and key.endswith(".fraction"):
        raise CaseError(f"{key}: the fractions of the plies add up to 1: one alone has no gradient")
    # numbers of the mesh, the shape and the output; shells.NAME.KEY is the KEY of one of several
    # shells
    own_key = key.split(".", 2)[2] if key.startswith("shells.") else key
    section_key, _, key_in_section = own_key.partition(".")
    is_geometry = section_key == "shell" and key_in_section.split(".")[0] not in DIFFERENTIABLE_KEYS
    if section_key in KEYS_WITHOUT_GRADIENT or is_geometry:
        raise CaseError(
            f"{key}: a number of the mesh, of the shape, of a target or of the output has no "
            "gradient here"
        )
    # modes of the perfect shell as imperfections, of the case or of one of its shells
    imperfections = [*(context.sections.get("imperfections") or {}).values()]
    for section in (context.sections.get("shells") or {}).values():
        imperfections += section.shell.imperfections
    has_modes = any(imperfection.of_perfect_shell for imperfection in imperfections)
    if has_modes and ".imperfections." not in key:
        raise CaseError(
            f"{key}: the modes of the perfect shell, which the case has as imperfections, change "
            "with it: give their file (kind: modes, file)"
        )
    return float(number)


def scale_at_key(context: Context, key: str) -> float:
    """Return the scale of the number at a key; steps of differences are small against this scale.

    It is the absolute value of the number. For a zero it is the largest number of the list that has
    the zero; or else the reference length in the case's unit for a length, and one for others.
    """
    value, is_length_key = _value_and_length(context, key)
    if magnitude := float(abs(value)):
        return magnitude
    # a zero: the other numbers of its list
    parent_value, _ = _value_and_length(context, key.rpartition(".")[0])
    if isinstance(parent_value, list):
        magnitudes = [
            abs(neighbour) for neighbour in parent_value if isinstance(neighbour, float | int)
        ]
        if largest := max(magnitudes, default=0.0):
            return largest
    return context.shell.reference if is_length_key else 1.0


def _value_and_length(context: Context, key: str) -> tuple[Any, bool]:
    """Return the value at a key, and whether its section declares it as a length.

    Parameters
    ----------
    key
        Names and indices, joined by dots.

    Returns
    -------
    value, is_length_key
        A number, text, list, dictionary or section; and whether it is a length.

    Raises
    ------
    CaseError
        If there is no such key.
    """
    # "imperfections" is made from the sections of the shells: the case has no such key itself
    value: Any = {
        name: section for name, section in context.sections.items() if name != "imperfections"
    }
    is_length_key = False
    for name in key.split("."):
        try:
            if isinstance(value, list):
                value = value[int(name)]
            elif isinstance(value, dict):
                value = value[name]
            else:
                field = type(value).model_fields[name]
                is_length_key = is_length(field.annotation, field.metadata)
                value = getattr(value, name)
        except (LookupError, ValueError, AttributeError):
            raise CaseError(f"{key}: the case has no such key ({name})") from None
    return value, is_length_key


def perturbed_scene(scenes: SceneCache, key: str, value: float) -> Scene:
    """Return the scene of the case with another number, on the same mesh; collective.

    Parameters
    ----------
    scenes
        Scenes on the mesh of a base: the scene of the case.
    key, value
        Key of the number in the case, and its new value.

    Raises
    ------
    CaseError
        If the number breaks the symmetry by which only a part is modelled, or moves an edge of a
        patch.
    """
    assert scenes.base
    try:
        return scenes.scene_at((key, value), partial(scenes.base.problem.with_values, {key: value}))
    except UnfitMesh as e:
        raise CaseError(f"{key}: {e}") from None


def state_with_new_loads(
    old: Scene,
    new: Scene,
    state: State,
    dependent_names: Collection[str] = (),
    steps: int | None = None,
) -> State:
    """Return a state of the scene `old` with the loads of the scene `new`.

    Each amplitude is scaled by a ratio of values in the two scenes. For a load it is the ratio of
    its targets, for a penalty of the stiffnesses, for a magnetic amplitude of the strengths of the
    field, and for others of the initial values.

    Parameters
    ----------
    dependent_names
        Amplitudes that stay: results, and unknowns at held conjugates.
    steps
        How many steps of the programme led to the state; None: all.

    Raises
    ------
    CaseError
        If a load of the first scene, such as the field, is zero, and that of the second is not.
    """
    # loads with targets: amplitude -> factor
    ratios = target_ratios(old, new, "load", steps)
    # penalties of contact with bodies
    for contact, new_contact in zip(
        old.problem.loads.contacts, new.problem.loads.contacts, strict=True
    ):
        ratios[contact.setting] = new_contact.stiffness / contact.stiffness
    # amplitudes with an initial value, as stiffnesses of parts
    old_values, new_values = old.unloaded().mu, new.unloaded().mu
    ratios |= {
        name: new_values[name] / value
        for name, value in old_values.items()
        if value and name in new_values
    }
    # loads whose strength the case gives
    strengths, new_strengths = old.problem.context.strengths, new.problem.context.strengths
    for name in strengths.keys() & state.mu.keys():
        if new_strengths.get(name) and not strengths[name]:
            words = quantity(amplitude(name).column).words
            raise CaseError(
                f"{section_of_strength(name)}: a {words} of zero has no derivative by a number: "
                f"take by: {name}"
            )
    ratios |= strength_ratios(old.problem.context, new.problem.context)
    mu = {
        name: value * (1.0 if name in dependent_names else ratios.get(name, 1.0))
        for name, value in state.mu.items()
    }
    return State(state.u, mu)


def target_ratios(
    old: Scene, new: Scene, quantity: str, steps: int | None = None
) -> dict[str, float]:
    """Return amplitude -> target of the new scene over that of the old one, where they differ.

    Targets are dimensionless. One that the case gives in pascals differs if a number of the case
    changes the unit of pressures.

    Parameters
    ----------
    quantity
        "load" or "conjugate": what the targets prescribe.
    steps
        How many steps of the programme count; None: all.
    """
    ratios = dict[str, float]()
    # a target is a pair: what it prescribes, and the value
    for step, new_step in zip(
        old.problem.programme[:steps], new.problem.programme[:steps], strict=True
    ):
        old_target, new_target = step.load.end.target, new_step.load.end.target
        if not (old_target and new_target):
            continue
        if old_target[0].quantity != quantity:
            continue
        (_, old_value), (_, new_value) = old_target, new_target
        if old_value and old_value != new_value:
            ratios[step.name] = new_value / old_value
    return ratios


def expand_contact(scene: Scene, other: Scene, state: State) -> None:
    """Expand all contact in another scene into polynomials about a state of the first scene.

    Places in contact then stay, so that differences of residuals are smooth. Both scenes have the
    same mesh. Contact of bodies is expanded about the gap at the state. Collective.
    """
    expand_shell_contact(scene, other, state)
    evaluation = scene.model.system.at_state(state)
    # the same body in both scenes
    for name, body_contact in scene.model.contacts.items():
        other.model.contacts[name].expand_about(evaluation.evaluate(body_contact.freeze))


def expand_shell_contact(scene: Scene, other: Scene, state: State) -> None:
    """Expand contact between shells in another scene into polynomials about a state of the first.

    Both scenes have the same mesh. If contact of the first scene is an expansion already, the other
    scene takes this one. Collective.
    """
    assert np.array_equal(scene.model.V.dofmap.list, other.model.V.dofmap.list), (
        "contact is given by numbers of cells"
    )
    evaluation = scene.model.system.at_state(state)
    for shell_contact, other_contact in zip(
        scene.model.shell_contacts, other.model.shell_contacts, strict=True
    ):
        if shell_contact.held:  # the expansion that takes its place
            other_contact.hold(shell_contact.held)
        else:
            other_contact.expand_about(evaluation.evaluate(shell_contact.freeze))
