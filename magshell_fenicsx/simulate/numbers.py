"""A scene with another number of its case, on the same mesh: for derivatives by differences."""

from dataclasses import replace
from typing import Any

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.plan.planner import make_plan
from magshell_fenicsx.simulate.scene import Scene

OF_MATERIAL = ("density", "poisson_ratio", "radius_to_thickness", "thickness", "youngs_modulus", "thickness_factor")
ELSEWHERE = ("mesh", "loading", "points", "boundary", "stability", "frequencies", "gradients", "ensemble", "design")


def number_of(case: Case, key: str) -> float:
    """The number at a key such as "magnetic.remanent.polar".

    Raises
    ------
    CaseError
        If there is no number, or one that changes the mesh or a target.
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
    section, _, rest = key.partition(".")
    geometry = section == "shell" and rest.split(".")[0] not in OF_MATERIAL
    thinner = section == "shell" and rest in ("radius_to_thickness", "thickness") and case.imperfections
    if section in ELSEWHERE or geometry or thinner:
        raise CaseError(
            f"{key}: a number of the mesh, of the shape or of a target has no gradient here; those of imperfections at "
            "a fold are in sensitivities"
        )
    return float(part)


def _key(part: Any, name: str) -> Any:
    if isinstance(part, dict):
        return part[name]
    if name not in type(part).model_fields:
        raise AttributeError(name)
    return getattr(part, name)


def with_number(part: Any, key: str, value: float) -> Any:
    """The case with another number; it is not validated again."""
    if not key:
        return value
    first, _, rest = key.partition(".")
    if isinstance(part, list):
        return [with_number(item, rest, value) if i == int(first) else item for i, item in enumerate(part)]
    if isinstance(part, dict):
        return {name: with_number(item, rest, value) if name == first else item for name, item in part.items()}
    return part.model_copy(update={first: with_number(getattr(part, first), rest, value)})


def scene_with(scene: Scene, key: str, value: float) -> Scene:
    """The scene of the case with another number, on the same mesh; collective.

    Raises
    ------
    CaseError
        If the number breaks the symmetry by which only a part is modelled.
    """
    case: Case = with_number(scene.case, key, value)
    old, new = scene.plan, make_plan(case, scene.plan.own)
    if (old.axisymmetric, old.mirror, old.azimuth) != (new.axisymmetric, new.mirror, new.azimuth):
        raise CaseError(f"{key}: a change of it breaks the symmetry of the model: give the case symmetry: none")
    plan = replace(old, material=new.material, loads=new.loads, thickness=new.thickness)
    return Scene(case, scene.comm, plan)


def carried(old: Scene, new: Scene, state: State) -> State:
    """The state with the field of the new case: lambda_m is in proportion to that of the case."""
    if "lambda_m" not in state.mu or new.case.lambda_m == old.case.lambda_m:
        return state
    fields = [name for name in state.mu if name.startswith("lambda_")]
    if not old.case.lambda_m:
        raise CaseError("magnetic: a field of zero has no derivative by a number: take by: lambda_m")
    ratio = new.case.lambda_m / old.case.lambda_m
    return State(state.u, state.mu | {name: ratio * state.mu[name] for name in fields})
