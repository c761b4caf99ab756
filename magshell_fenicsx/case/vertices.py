"""Places of a case that are vertices of its mesh: on edges and planes that they nearly are on, and distinct."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.distinct import NEAR, SAME_PLACE, told_apart
from magshell_fenicsx.mesh.grading import Grading
from magshell_fenicsx.mesh.grid import CLOSE, Grid, RimmedGrid
from magshell_fenicsx.mesh.mirror import ROUNDING, Mirror, rotation
from magshell_fenicsx.mesh.shapes import DiscShape, StripShape
from magshell_fenicsx.shape.ground import refuse_beside
from magshell_fenicsx.shape.outline import Chart, Outline

if TYPE_CHECKING:
    from magshell_fenicsx.case.case import Case

Array = NDArray[np.float64]
Points = dict[str, Array]
CHART = 2  # coordinates of a place in a chart
FEWER = 0.7  # lines of a grid are nearer than places by up to this factor


def named_points(case: "Case", drawn: Outline, turn: float, plane: Mirror | None) -> Points:
    """Return the named vertices in the chart, "pole" among them.

    Parameters
    ----------
    turn
        The model's frame is turned about e3 by it (rad).
    plane
        The mirror plane or the sector of what is modelled, in the model's frame.

    Raises
    ------
    CaseError
        If one is not on the surface.
    """
    Q, R, points = rotation(turn), case.shell.reference, Points()
    for name, place in case.points.items():
        x = np.array(place) / R
        refuse_beside(f"points.{name}", x, drawn, R, with_units=case.shell.with_units)
        chart = chart_of(_on_planes(Q @ x, plane), drawn, half=plane is not None)
        points[name] = settled(chart, drawn, points)
    if points:
        points["pole"] = next(iter(points.values()))
    elif drawn.highest is not None:
        points["pole"] = drawn.highest
    return points


def chart_of(x: Array, drawn: Outline, *, half: bool) -> Array:
    """Return the chart of a place (3,), of its image where the other half is modelled."""
    places = drawn.inverse(x)
    return drawn.on_half(places) if half else places


def _on_planes(x: Array, plane: Mirror | None) -> Array:
    """A place (3,), moved onto planes of symmetry that it nearly is on."""
    for side in plane.sides.values() if plane else ():
        off = float(side.beyond(x))
        x = x - off * side.normal if abs(off) <= SAME_PLACE else x
    return x


def settled(chart: Array, drawn: Outline, points: Mapping[str, Array]) -> Array:
    """Return that of the points which is at the same place as a chart (2 | 3,), or the chart, moved onto an edge or a
    pole that it nearly is on."""
    if len(chart) != CHART:
        return chart
    (place,) = drawn.embedding(chart[None])

    def same(other: Array) -> bool:
        return bool(np.linalg.norm(drawn.embedding(other[None])[0] - place) <= SAME_PLACE)

    for point in points.values():
        if same(point):
            return point
    for other in _on_edges(chart, drawn):
        if same(other):
            chart = other
    return chart


def _on_edges(chart: Array, drawn: Outline) -> list[Array]:
    """The nearest places of the edges, each with the coordinates of the ones before, and of a pole."""
    shape = drawn.chart(None, Grading([], 1.0))
    if isinstance(shape, DiscShape):
        away = float(np.hypot(*chart))
        return [0 * chart, *([chart * (shape.radius / away)] if away else [])]
    if isinstance(shape, StripShape):
        low, high = np.array([0.0, -shape.width / 2]), np.array([1.0, shape.width / 2])
    else:
        assert isinstance(shape, Grid)
        low, high = np.array(shape.low), np.array(shape.high)
    nearest = np.where(chart - low < high - chart, low, high)
    one, other = (np.where(np.arange(CHART) == axis, nearest, chart) for axis in range(CHART))
    return [one, other, nearest]


@dataclass(frozen=True)
class Vertices:
    """Points that a mesh has vertices at, and how messages tell them.

    Attributes
    ----------
    points
        Name -> chart (2,).
    drawn
        The surface.
    size
        Element sizes over the chart.
    turn
        The model's frame is turned about e3 by it (rad).
    R, unit
        The reference length in messages, and their unit of lengths, empty without.
    named
        The names that stand in `points` of the case.
    """

    points: Mapping[str, Array]
    drawn: Outline
    size: Grading
    turn: float
    R: float
    unit: str
    named: Collection[str]

    @classmethod
    def of(cls, case: "Case", points: Mapping[str, Array], drawn: Outline, size: Grading, turn: float) -> "Vertices":
        """Return those of a case."""
        R, unit = (1e3 * case.shell.reference, " mm") if case.shell.with_units else (case.shell.reference, "")
        order = sorted(points, key=lambda name: name not in case.points)  # "pole" may be one of them
        return cls({name: points[name] for name in order}, drawn, size, turn, R, unit, case.points)

    def refuse_near(self, shape: Chart | RimmedGrid, plane: Mirror | None) -> None:
        """See that points are far enough from each other, from edges and from planes of symmetry.

        Raises
        ------
        CaseError
            With both places.
        """
        if isinstance(shape, Grid):
            self._refuse_beside_lines(shape, plane)
        elif not isinstance(shape, DiscShape | StripShape | RimmedGrid):
            return  # vertices of a file stay where they are
        places = list(self.points.values())
        taken = shape.vertices_of(places) if isinstance(shape, Grid) else None
        for (i, one), (j, other) in combinations(enumerate(self.points), 2):
            apart = float(np.hypot(*(places[i] - places[j])))
            near = (taken[i] == taken[j]).all() if taken is not None else apart < NEAR * self.size(places[i])
            if near and not np.array_equal(places[i], places[j]):
                self._refuse(one, self._place(places[j]), f"{self._key(other)}: [{{}}]", "give one of them")

    def _refuse_beside_lines(self, grid: Grid, plane: Mirror | None) -> None:
        """See that no point is beside an edge or a plane of symmetry of a grid, but not on it."""
        for name, chart in self.points.items():
            near = NEAR * min(grid.size_at(axis, float(chart[axis])) for axis in range(CHART))
            (place,) = self.drawn.embedding(chart[None])
            for side in plane.sides.values() if plane else ():
                off = float(side.beyond(place))
                if ROUNDING < abs(off) < near:
                    on = self._told(place - off * side.normal)
                    self._refuse(name, on, "the plane of symmetry at [{}]", "put it there, or take symmetry: none")
            for axis in range(CHART):
                line = grid.beside(axis, float(chart[axis]))
                ends = (grid.low[axis], grid.high[axis])
                if line not in ends or grid.glued[axis] or abs(chart[axis] - line) <= CLOSE * np.subtract(*ends[::-1]):
                    continue
                on = self._place(np.where(np.arange(CHART) == axis, line, chart))
                edge = grid.sides[2 * axis + ends.index(line)]
                self._refuse(name, on, f"the edge {edge} at [{{}}]", "put it there")

    def _refuse(self, name: str, other: Array, what: str, hint: str) -> None:
        """Refuse a point beside a place (3,) of the case, which stands in `what`."""
        chart = self.points[name]
        one, two = self._place(chart), other
        here, there = (", ".join(f"{c}{self.unit}" for c in told.split(", ")) for told in told_apart(one, two))
        apart, size = float(np.linalg.norm(one - two)), self.size(chart) * self.R
        raise CaseError(
            f"{self._key(name)}: [{here}]: is {apart:.3g}{self.unit} from {what.format(there)}, too near for elements "
            f"of {size:.3g}{self.unit}: {hint}, or take elements below {FEWER * apart / NEAR:.2g}{self.unit}"
        )

    def _key(self, name: str) -> str:
        return f"points.{name}" if name in self.named else f"the point {name}"

    def _place(self, chart: Array) -> Array:
        return self._told(self.drawn.embedding(chart[None])[0])

    def _told(self, x: Array) -> Array:
        """A place (3,) over R of the model, in the case's frame and length."""
        return np.asarray(x @ rotation(self.turn) * self.R)
