"""Element sizes: what dimple, loads and edges need, in units of the shell's own length sqrt(Rh)."""

from collections.abc import Sequence
from math import sqrt
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import Feature, Grading, Line, Ring
from magshell_fenicsx.parts.course import Fit
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.parts.supports.boundary import BoundarySection
from magshell_fenicsx.problem.elements import mesh_of
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.sections import MeshSurface

Array = NDArray[np.float64]
Loaded = tuple[Array, Sequence[Step]]  # place in the chart, and the loads there


class Shown(Protocol):
    """What needs small elements."""

    def features(self, outline: Outline, fit: Fit, growth: float) -> list[Feature]:
        """Them, which grow so fast away from there."""


def grading(
    context: Context,
    outline: Outline,
    h: float,
    shown: Sequence[Shown],
    everywhere: float,
    loaded: Sequence[Loaded],
    varying: Sequence[Feature] = (),
    *,
    local: bool = False,
) -> Grading:
    """Sizes for 1e-4 in k_d and 1e-3 in F at degree 4; a size that is given is everywhere the same, as in a file.

    Parameters
    ----------
    shown, everywhere
        What needs small elements somewhere, and the largest size that shows the rest.
    loaded
        The concentrated loads.
    varying
        Where formulas vary.
    local
        Whether the shell has local imperfections.
    """
    mesh = mesh_of(context)
    if mesh.size is not None or isinstance(context.shell, MeshSurface):
        size = mesh.size / context.shell.reference if mesh.size else min(2 * sqrt(h), 0.35)
        return Grading([], size / mesh.refinement)
    fit = Fit(h, mesh.refinement, context.solid, local)
    growth = _growth(context, fit)
    features = _rim(context, outline, fit)
    features += [feature for each in shown for feature in each.features(outline, fit, growth)]
    for place, loads in loaded:
        for kind in {type(load): None for load in loads}:
            features += kind.around([load for load in loads if type(load) is kind], place, fit)
    features += varying
    return Grading(features, min(_largest(context, outline, fit), everywhere) / mesh.refinement)


def _largest(context: Context, outline: Outline, fit: Fit) -> float:
    if outline.grid:
        return min(2 * sqrt(fit.h), 0.35)
    if not outline.disc or context.shell.geometry == "disc":
        return min(0.25, 0.5 * (getattr(context.shell, "width", None) or 1.0))
    return min((size for step in context.steps if (size := step.load.largest(fit)) is not None), default=0.35)


def _growth(context: Context, fit: Fit) -> float:
    return max((step.load.growth(fit) for step in context.steps), default=0.4)


def _rim(context: Context, outline: Outline, fit: Fit) -> list[Feature]:
    """Smaller elements along the edge of a curved surface."""
    h = fit.h
    if grid := outline.grid:
        boundary = context.of(BoundarySection)
        size, held = 1.2 * sqrt(h) / fit.refinement, boundary.conditions() if boundary else {}
        ends = ((axis, end[axis]) for axis in range(2) for end in (grid.low, grid.high))
        sides = zip(ends, grid.sides, grid.glued[:1] * 2 + grid.glued[1:] * 2, strict=True)
        fixed = (at for at, name, glued in sides if not glued and held.get(name, "free") not in ("free", "symmetry"))
        return [Line(axis, place, size, _growth(context, fit)) for axis, place in fixed]
    if not outline.disc or context.shell.geometry == "disc":
        return []
    size = max((step.load.rim(fit) for step in context.steps), default=1.4)
    return [Ring(outline.edge, size * sqrt(h) / fit.refinement, _growth(context, fit))]
