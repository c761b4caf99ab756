"""A scene with another number of its case, on the same mesh: for derivatives by differences.

The case is the one that a file with this number would give: lengths with units stay, those over h or in the unit of a
dimple's width change with these.
"""

from collections.abc import Collection, Iterable
from copy import deepcopy
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import ValidationError

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.section import number_and_unit, si_size
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.imperfections.imperfection import LocalSection
from magshell_fenicsx.problem.planner import make_plan
from magshell_fenicsx.problem.problem import Plan
from magshell_fenicsx.problem.wanted import FIELDS
from magshell_fenicsx.simulate.scene import Scene

OF_MATERIAL = ("density", "poisson_ratio", "radius_to_thickness", "thickness", "youngs_modulus", "thickness_factor")
ELSEWHERE = ("mesh", "loading", "points", "boundary", "stability", "frequencies", "gradients", "ensemble", "design")


def number_of(case: Case, key: str) -> float:
    """The number at a key such as "magnetic.remanent.polar".

    Raises
    ------
    CaseError
        If there is no number, or one that changes the mesh, a target or the modes that the case has as imperfections.
    """
    part: Any = case
    for name in key.split("."):
        try:
            part = (
                part[int(name)]
                if isinstance(part, list)
                else part[name]
                if isinstance(part, dict)
                else _key(part, name)
            )
        except (LookupError, ValueError, AttributeError):
            raise CaseError(f"{key}: the case has no such key ({name})") from None
    if isinstance(part, bool) or not isinstance(part, int | float):
        raise CaseError(f"{key}: is no number that the case gives: {part!r}")
    if key.startswith("magnetic.remanent.layers.") and key.endswith(".fraction"):
        raise CaseError(f"{key}: the fractions of the layers add up to 1: one alone has no gradient")
    section, _, rest = key.partition(".")
    geometry = section == "shell" and rest.split(".")[0] not in OF_MATERIAL
    if section in ELSEWHERE or geometry:
        raise CaseError(
            f"{key}: a number of the mesh, of the shape or of a target has no gradient here; those of imperfections at "
            "a fold are in sensitivities"
        )
    if any(section.of_perfect_shell for section in case.imperfections.values()):
        raise CaseError(
            f"{key}: the modes of the perfect shell, which the case has as imperfections, change with it: give their "
            "file (kind: modes, file)"
        )
    return float(part)


def _key(part: Any, name: str) -> Any:
    if isinstance(part, dict):
        return part[name]
    if name not in type(part).model_fields:
        raise AttributeError(name)
    return getattr(part, name)


def with_number(case: Case, key: str, value: float) -> Case:
    """The case whose file has another number.

    Raises
    ------
    CaseError
        If the number is not allowed.
    """
    written = case.origin.data
    changed: Case = _replaced(case, key, value)
    if written is None or not key.startswith("shell."):  # no other number is one that others are given over
        return changed
    data = deepcopy(written)
    *path, last = key.split(".")
    part: Any = data
    for name in path:
        part = part[name]
    unit = number_and_unit(part[last])[1] if isinstance(part.get(last), str) else ""
    part[last] = f"{value / si_size(unit)!r} {unit}" if unit else value
    try:
        other = Case.model_validate(data, context=case.origin.context)
    except ValidationError as e:
        raise CaseError(f"{key}: {e.errors()[0]['msg'].removeprefix('Value error, ')}") from None
    return changed.model_copy(update={"shell": other.shell, "loading": other.loading})


def _replaced(part: Any, key: str, value: float) -> Any:
    """A part of a case with another number; it is not validated again."""
    if not key:
        return value
    first, _, rest = key.partition(".")
    if isinstance(part, list):
        return [_replaced(item, rest, value) if i == int(first) else item for i, item in enumerate(part)]
    if isinstance(part, dict):
        return {name: _replaced(item, rest, value) if name == first else item for name, item in part.items()}
    return part.model_copy(update={first: _replaced(getattr(part, first), rest, value)})


def refuse_unknown_parameters(case: Case, names: Iterable[str], start: State) -> None:
    """See that gradients can be taken by fields, amplitudes and numbers with these names.

    Raises
    ------
    CaseError
        If one is none of the case.
    """
    try:
        for by in names:
            if by not in FIELDS and by not in start.mu:
                number_of(case, by)
    except CaseError as e:
        raise CaseError(f"gradients.by: {e}") from None


def scene_with(scene: Scene, key: str, value: float) -> Scene:
    """The scene of the case with another number, on the same mesh; collective.

    Raises
    ------
    CaseError
        If the number breaks the symmetry by which only a part is modelled, or moves an edge of a patch.
    """
    case = with_number(scene.case, key, value)
    old, new = scene.plan, make_plan(case, scene.plan.own)
    if (old.axisymmetric, old.mirror, old.azimuth) != (new.axisymmetric, new.mirror, new.azimuth):
        raise CaseError(f"{key}: a change of it breaks the symmetry of the model: give the case symmetry: none")
    if case.patches and _rims(case) != _rims(scene.case):
        raise CaseError(
            f"{key}: moves the rim of a dimple, which is the edge of a patch in the mesh: give its width a unit"
        )
    return Scene(case, scene.comm, on_mesh_of(scene, new))


def _rims(case: Case) -> list[float]:
    shell, local = case.shell, [each for each in case.imperfections.values() if isinstance(each, LocalSection)]
    return [each.half_width(shell.R_over_h, shell.poisson_ratio) for each in local if each.patch]


def on_mesh_of(scene: Scene, new: Plan) -> Plan:
    """What a plan changes beside the mesh, for the mesh of a scene in its chart; imperfections change with it."""
    old, model, meridian, shape = scene.plan, scene.model, scene.plan.meridian, scene.plan.shape
    if model.midsurface:
        shape = model.midsurface.reshaped(new.embedding)
    elif model.axisymmetric:
        assert new.meridian
        meridian = replace(new.meridian, vertices=np.sort(model.meridian.mesh.geometry.x[:, 0]))
    return replace(
        old,
        context=new.context,
        lambda_m=new.lambda_m,
        body=new.body,
        material=new.material,
        loads=new.loads,
        thickness=new.thickness,
        embedding=new.embedding,
        meridian=meridian,
        shape=shape,
    )


def carried(old: Scene, new: Scene, state: State, own: Collection[str] = (), steps: int | None = None) -> State:
    """The state with the loads of the new case: where its targets are other numbers, amplitudes are in proportion.

    Parameters
    ----------
    own
        Amplitudes that are results, or follow from what is held.
    steps
        How many steps of the programme led to the state; None: all.
    """
    ratios, fields = goals(old, new, "load", steps), [name for name in state.mu if name.startswith("lambda_")]
    for contact, other in zip(old.plan.loads.contacts, new.plan.loads.contacts, strict=True):
        ratios[contact.setting] = other.stiffness / contact.stiffness
    given, now = old.unloaded().mu, new.unloaded().mu  # stiffnesses of parts are amplitudes too
    ratios |= {name: now[name] / value for name, value in given.items() if value and name in now}
    if "lambda_m" in state.mu and new.case.lambda_m != old.case.lambda_m:
        if not old.case.lambda_m:
            raise CaseError("magnetic: a field of zero has no derivative by a number: take by: lambda_m")
        ratios |= dict.fromkeys(fields, new.case.lambda_m / old.case.lambda_m)
    return State(
        state.u, {name: value * (1.0 if name in own else ratios.get(name, 1.0)) for name, value in state.mu.items()}
    )


def goals(old: Scene, new: Scene, quantity: str, steps: int | None = None) -> dict[str, float]:
    """Amplitude -> target of the new case over that of the old one, where they differ: those that have units."""
    found = dict[str, float]()
    for before, after in zip(old.case.programme[:steps], new.case.programme[:steps], strict=True):
        one, two = before.load.target, after.load.target
        if one and two and one[0].quantity == quantity and one[1] and one[1] != two[1]:
            found[before.name] = two[1] / one[1]
    return found
