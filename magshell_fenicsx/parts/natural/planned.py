"""The natural shape of a case in the model's frame, and the symmetry that it leaves."""

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.by_formula import ByFormula, function
from magshell_fenicsx.mesh.frame import rotation
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.models.shell.patterns import Inside, Pattern, WithinRims
from magshell_fenicsx.parts.natural.section import components
from magshell_fenicsx.parts.natural.shape import Natural, Varying, meridians
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.sections import MeshSurface, PlateSurface
from magshell_fenicsx.shape.shell import ShellSection
from magshell_fenicsx.shape.turning import scalar_turns

Array = NDArray[np.float64]
SAME = 1e-9  # of the largest value: differences that are rounding
MERIDIAN = "meridian"


def natural(case: Case, turn: float, within: Mapping[str, Inside]) -> Natural | None:
    """The natural shape in a frame turned about e3 (rad); None if the case has none; `within` is of `Plan`."""
    section = case.natural
    if section is None:
        return None
    Q, R = rotation(turn), case.shell.reference

    def varying(value: object, whole: Callable[[object], list[float | str]], factor: float) -> Varying | None:
        if value is None:
            return None
        if not isinstance(value, dict):
            found = whole(value)
            if any(isinstance(v, str) for v in found):
                return ByFormula([function(v) for v in found], Q, R, factor)
            return factor * np.array(found, dtype=float)
        vectors = {name: factor * np.array(whole(each), dtype=float) for name, each in value.items()}
        if isinstance(case.shell, MeshSurface):
            return vectors
        outside = vectors.get("rest", np.zeros(3))
        return WithinRims(tuple((inside, vectors.get(name, outside)) for name, inside in within.items()), outside)

    curvature, stretch = varying(section.curvature, _curvatures, R), varying(section.stretch, _stretches, 1.0)
    return Natural(curvature, stretch, frame(case, turn))


def frame(case: Case, turn: float) -> Pattern:
    """A pattern whose part in the surface is the first direction of the frame, in a frame turned about e3 (rad)."""
    direction = along(case)
    if direction == MERIDIAN:
        return meridians
    return ByFormula([function(v) for v in direction], rotation(turn), case.shell.reference, vectors=True)


def along(case: Case) -> list[float | str] | str:
    """The first direction of the frame, by default where the case has no natural shape."""
    flat = isinstance(case.shell, MeshSurface | PlateSurface)
    flat = flat or (isinstance(case.shell, ShellSection) and case.shell.geometry == "strip")
    return (case.natural and case.natural.along) or ([1.0, 0.0, 0.0] if flat else MERIDIAN)


def uneven(case: Case) -> bool:
    """Whether the frame counts: something is not the same in all directions."""
    assert case.natural
    values = [case.natural.curvature, case.natural.stretch]
    each = [v for value in values for v in (value.values() if isinstance(value, dict) else [value])]
    return any(isinstance(v, list) for v in each)


def askew(case: Case, outline: Outline) -> str | None:
    """Why the natural shape cannot be turned about e3; None if it can."""
    assert case.natural
    direction, R = along(case), case.shell.reference
    k = components(case.natural.curvature)
    of_patches = case.natural.curvature.values() if isinstance(case.natural.curvature, dict) else []
    if any(len(c) == 3 and c[2] not in (0, "0") for c in map(components, [k, *of_patches])):
        return "the natural curvature twists: k12 is not zero"
    upright = [v == 0 for v in direction] == [True, True, False]
    if uneven(case) and direction != MERIDIAN and not upright:
        return "the natural shape is not along the meridians"
    if outline.span and not all(scalar_turns(text, outline.span, R) for text in case.natural.formulas):
        return "the natural shape differs around e3"
    return None


def mirrored(case: Case, outline: Outline, mirror: Mirror) -> bool:
    """Whether a plane mirrors the natural shape; patches are mapped onto themselves."""
    assert case.natural
    x, R, direction = outline.sample(), case.shell.reference, along(case)

    def alike(text: float | str, sign: float = 1.0) -> bool:
        here, there = (function(text)(*(R * places).T) for places in (x, mirror.image(x)))
        size = np.abs(here).max(initial=0.0)
        return bool(np.isfinite(here).all() and (np.abs(here - sign * there) <= SAME * size).all())

    twists = [c[2] for c in _each(case.natural.curvature) if len(c) == 3]
    even = [v for c in (*_each(case.natural.curvature), *_each(case.natural.stretch)) for v in c[:2]]
    if not (all(alike(v) for v in even) and all(alike(v, -1.0) for v in twists)):
        return False
    if not uneven(case):
        return True
    if direction == MERIDIAN:
        return mirror.through_e3 or bool(np.hypot(*mirror.normal[:2]) == 0)
    d, image = (np.stack([function(v)(*(R * p).T) for v in direction], -1) for p in (x, mirror.image(x)))
    return any(bool((np.abs(d @ mirror.reflection - sign * image) <= SAME * np.abs(d).max()).all()) for sign in (1, -1))


def _each(value: object) -> list[list[float | str]]:
    return [components(v) for v in (value.values() if isinstance(value, dict) else [value])]


def _curvatures(value: object) -> list[float | str]:
    found = components(value)
    return found if len(found) == 3 else [*found, *found, 0.0]


def _stretches(value: object) -> list[float | str]:
    """Less one; of one number the thickness grows too."""
    found = components(value)
    less = [f"{v} - 1" if isinstance(v, str) else v - 1 for v in found]
    return [*less, 0.0] if len(found) == 2 else less * 3
