"""Element sizes: what dimple, loads and edges need, in units of the shell's own length sqrt(Rh)."""

from collections.abc import Sequence
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.mesh.grading import Disc, Feature, Grading, Line, Ring
from magshell_fenicsx.parts.forces.dead import DeadSection
from magshell_fenicsx.parts.forces.indentation import IndentationSection
from magshell_fenicsx.parts.imperfections.rims import Spot, images
from magshell_fenicsx.parts.pressure.pressure import PressureSection
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.sections import MeshSurface

Array = NDArray[np.float64]
RING = 0.35  # of sqrt(Rh): elements that show the ring of a contact
Pressed = tuple[Array, float, float]  # place in the chart, how far from there the body presses, its size; over R
Loaded = tuple[Array, Sequence[IndentationSection]]  # place in the chart, and the indentations there


def grading(
    case: Case,
    outline: Outline,
    h: float,
    spots: Sequence[Spot],
    everywhere: float,
    loaded: Sequence[Loaded],
    pressed: Sequence[Pressed] = (),
    varying: Sequence[Feature] = (),
) -> Grading:
    """Sizes for 1e-4 in k_d and 1e-3 in F at degree 4; the case's own size is everywhere the same.

    Parameters
    ----------
    spots, everywhere
        The local imperfections, and the largest size that shows the others.
    loaded
        The concentrated loads.
    pressed
        Where bodies press.
    varying
        Where formulas vary.
    """
    if case.mesh.size is not None or isinstance(case.shell, MeshSurface):
        return Grading([], _uniform(case, h))
    features = [*_rim(case, outline, h), *_imperfections(case, outline, h, spots)]
    for place, indentations in loaded:
        features += _load(case, h, place, indentations)
    features += [*(feature for one in pressed for feature in _contact(case, h, *one)), *varying]
    return Grading(features, min(_largest(case, outline, h, local=bool(spots)), everywhere) / case.mesh.refinement)


def _uniform(case: Case, h: float) -> float:
    """By default twice sqrt(Rh), within reason."""
    size = case.mesh.size / case.shell.reference if case.mesh.size else min(2 * sqrt(h), 0.35)
    return size / case.mesh.refinement


def _largest(case: Case, outline: Outline, h: float, *, local: bool) -> float:
    if outline.grid:
        return min(2 * sqrt(h), 0.35)
    if not outline.disc or case.shell.geometry == "disc":
        return min(0.25, 0.5 * (case.width or 1.0))
    dead = 2 * sqrt(h) if case.loads_of(DeadSection) else 0.35
    # without a local imperfection a sphere buckles anywhere, in waves of about 3.6 sqrt(Rh)
    live = 1.2 * sqrt(h) if not local and case.loads_of(PressureSection) else 0.35
    return min(dead, live) if dead < 0.35 else live


def _growth(case: Case) -> float:
    if not case.loads_of(IndentationSection):
        return 0.4
    return 0.5 if case.model == "solid" else 0.6  # far from the ridge degree 2 needs more than degree 4


def _rim(case: Case, outline: Outline, h: float) -> list[Feature]:
    """Smaller elements along the edge of a curved surface; of a hemisphere the edge is far from a dent."""
    if grid := outline.grid:
        size, held = 1.2 * sqrt(h) / case.mesh.refinement, case.boundary.conditions()
        ends = ((axis, end[axis]) for axis in range(2) for end in (grid.low, grid.high))
        sides = zip(ends, grid.sides, grid.glued[:1] * 2 + grid.glued[1:] * 2, strict=True)
        fixed = (at for at, name, glued in sides if not glued and held.get(name, "free") not in ("free", "symmetry"))
        return [Line(axis, place, size, _growth(case)) for axis, place in fixed]
    if not outline.disc or case.shell.geometry == "disc":
        return []
    indented = (2.0 if case.model == "solid" else 2.8) if case.loads_of(IndentationSection) else 1.4
    return [Ring(outline.edge, indented * sqrt(h) / case.mesh.refinement, _growth(case))]


def _imperfections(case: Case, outline: Outline, h: float, spots: Sequence[Spot]) -> list[Feature]:
    """Small elements on each and a little around it."""
    return [
        Disc((float(x), float(y)), spot.radius + 0.7 * sqrt(h), spot.size / case.mesh.refinement, _growth(case))
        for spot in spots
        for x, y in images(spot, outline)
    ]


def _load(case: Case, h: float, place: Array, indentations: Sequence[IndentationSection]) -> list[Feature]:
    """Of an indentation the dent too: by mirror buckling the radius of its ridge is about sqrt(2 R w)."""
    x, y = map(float, place)
    patch = min((load.patch for load in indentations), default=0.0)
    # finer than h the point force's logarithmic stretch would be resolved, which has no limit
    features: list[Feature] = [Disc((x, y), patch * h, max(patch * h / 2, h), _growth(case))]
    if indentations:
        depth = max(abs(load.depth) if load.depth else 10.0 for load in indentations)
        dent = (1.0 if case.model == "solid" else 0.85) * sqrt(2 * depth * h) + 0.5 * sqrt(h)
        features.insert(0, Disc((x, y), dent, sqrt(h) / case.mesh.refinement, _growth(case)))
    return features


def travel(h: float, approach: float, size: float) -> float:
    """How far from the first contact a body presses: a plane in a ring up to sqrt(2 R a), others on their front."""
    return min(1.1 * sqrt(2 * (approach or 10.0) * h) + 0.5 * sqrt(h), size + sqrt(h))


def _contact(case: Case, h: float, place: Array, reach: float, size: float) -> list[Feature]:
    x, y = map(float, place)
    centre, finer = (x, y), sqrt(h) / case.mesh.refinement
    small = [Disc(centre, 1.5 * size, max(size / 3, 0.1 * h), 0.4)] if size < sqrt(h) else []
    return [Disc(centre, reach, RING * finer, _growth(case)), *small]
