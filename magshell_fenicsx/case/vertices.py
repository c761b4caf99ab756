"""Places of a case that are vertices of its mesh.

Places that are nearly on edges or planes of symmetry are moved onto them. Distinct places must be
far enough from each other. A place (3,) is in space, over the reference length R; its chart (2,)
are its coordinates on the surface, for a mesh file (3,). The outline is the surface of the shell. A
chart is meshed as a disc, a strip or a grid of lines; sides of a grid that are the same curve in
space are glued. The model's frame is turned about e3 from that of the case.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grading import Grading
from magshell_fenicsx.mesh.grid import Grid, RimmedGrid
from magshell_fenicsx.mesh.mirror import ROUNDING, Mirror, rotation
from magshell_fenicsx.mesh.shapes import DiscShape, PlaneShape, StripShape
from magshell_fenicsx.mesh.vertex_spacing import (
    MIN_VERTEX_DISTANCE,
    SAME_PLACE_TOLERANCE,
    distinguishable_texts,
)
from magshell_fenicsx.shape.outline import Chart, Outline
from magshell_fenicsx.shape.reference_shell import refuse_off_surface

if TYPE_CHECKING:
    from magshell_fenicsx.case.case import Case

Array = NDArray[np.float64]
Points = dict[str, Array]
CHART = 2  # coordinates of a place in a chart
EDGE_DISTANCE = 1e-2  # over the element size: at gmsh's edges, beside which it makes flat triangles
GRID_FACTOR = 0.7  # lines of a grid are nearer than places by up to this factor


def named_points(case: "Case", outline: Outline, turn: float, plane: Mirror | None) -> Points:
    """Return name -> chart (2 | 3,) of the named points of a case, and of "pole".

    "pole" is the first named point; without one it is the highest point of the surface.

    Parameters
    ----------
    turn
        Angle about e3 (rad) of the model's frame.
    plane
        Mirror plane or sector of the modelled part, in the model's frame; None for a whole shell.

    Raises
    ------
    CaseError
        If a point is not on the surface.
    """
    Q, R = rotation(turn), case.shell.reference
    points: Points = {}
    for name, place in case.points.items():
        x = np.array(place) / R  # in the frame of the case; Q x is the place in that of the model
        refuse_off_surface(f"points.{name}", x, outline, R, with_units=case.shell.with_units)
        chart = chart_of(_on_planes(Q @ x, plane), outline, half=plane is not None)
        points[name] = on_features(chart, outline, points)
    if points:
        points["pole"] = next(iter(points.values()))
    elif outline.highest is not None:
        points["pole"] = outline.highest
    return points


def chart_of(x: Array, outline: Outline, *, half: bool) -> Array:
    """Return the chart of a place (3,) over R of the model.

    With `half`, a place on the half that is not modelled is replaced by its mirror image.
    """
    places = outline.inverse(x)
    return outline.on_half(places) if half else places


def _on_planes(x: Array, plane: Mirror | None) -> Array:
    """Return a place (3,), moved onto each plane of symmetry that it is nearly on."""
    for side in plane.planes.values() if plane else ():
        distance = float(side.signed_distance(x))
        x = x - distance * side.normal if abs(distance) <= SAME_PLACE_TOLERANCE else x
    return x


def on_features(chart: Array, outline: Outline, points: Mapping[str, Array]) -> Array:
    """Return a chart, moved onto a point, a pole or an edge that it is nearly on.

    The chart (3,) of a mesh file is not moved.

    Parameters
    ----------
    points
        Name -> chart of points that are known already; they come before poles and edges.
    """
    if len(chart) != CHART:
        return chart
    (place,) = outline.embedding(chart[None])

    def is_at(other: Array) -> bool:
        """Whether the place of another chart is the place to be moved, up to rounding."""
        return bool(
            np.linalg.norm(outline.embedding(other[None])[0] - place) <= SAME_PLACE_TOLERANCE
        )

    for point in points.values():
        if is_at(point):
            return point
    if outline.disc and is_at(np.zeros(CHART)):  # the pole is the origin of a disc's chart
        return np.zeros(CHART)
    # one edge after the other: at a corner the chart is moved onto both edges that meet there. So
    # the nearest place on an edge is that of the chart moved so far
    for edge in edges_near(chart, outline):
        on_edge = edges_near(chart, outline)[edge]
        chart = on_edge if is_at(on_edge) else chart
    return chart


def edges_near(chart: Array, outline: Outline) -> dict[str, Array]:
    """Return name -> nearest place (2,) on each edge; of opposite edges the nearer one.

    Glued sides of a grid are no edges.
    """
    # the edges are those of the whole shell, whatever the element sizes
    any_size = Grading([], 1.0)
    shape = outline.chart(None, any_size)
    if isinstance(shape, DiscShape):
        distance = float(np.hypot(*chart))
        return {shape.edge: chart * (shape.radius / distance)} if distance else {}
    if isinstance(shape, StripShape):
        lowest, highest = np.array([0.0, -shape.width / 2]), np.array([1.0, shape.width / 2])
        names, glued = ("root", "tip", "sides", "sides"), (False, False)
    else:
        assert isinstance(shape, Grid)
        lowest, highest = np.array(shape.low), np.array(shape.high)
        names, glued = shape.sides, shape.glued
    # a rectangle. For both axes x and y: whether the upper edge is nearer than the lower one, and
    # the coordinate of the nearer one
    is_high = chart - lowest >= highest - chart
    nearest = np.where(is_high, highest, lowest)
    # `names` are those of the edges at low and high x, then at low and high y. The nearest place on
    # an edge has the edge's coordinate along one axis, and that of the chart along the other
    return {
        names[2 * axis + is_high[axis]]: np.where(np.arange(CHART) == axis, nearest, chart)
        for axis in range(CHART)
        if not glued[axis]
    }


@dataclass(frozen=True)
class Vertices:
    """Points at which a mesh has vertices, and how messages name them.

    Attributes
    ----------
    points
        Name -> chart (2,).
    outline
        The surface.
    size
        Element sizes over the chart.
    turn
        Angle about e3 (rad) of the model's frame.
    R, unit
        Reference length in the unit of messages; that unit, such as " mm", empty without units.
    names_in_case
        Names that are keys of `points` in the case.
    """

    points: Mapping[str, Array]
    outline: Outline
    size: Grading
    turn: float
    R: float
    unit: str
    names_in_case: Collection[str]

    @classmethod
    def of_case(
        cls, case: "Case", points: Mapping[str, Array], outline: Outline, size: Grading, turn: float
    ) -> "Vertices":
        """Return the vertices of a case at charts `points`, those named in the case first."""
        R, unit = case.shell.reference, ""
        if case.shell.with_units:
            R, unit = 1e3 * R, " mm"
        # named ones first: "pole" may be one of them
        ordered_names = sorted(points, key=lambda name: name not in case.points)
        ordered = {name: points[name] for name in ordered_names}
        return cls(ordered, outline, size, turn, R, unit, case.points)

    def refuse_near(self, shape: Chart | RimmedGrid, plane: Mirror | None) -> None:
        """Check that points are far enough from each other, from edges and from planes of symmetry.

        `shape` is what is meshed, `plane` the mirror plane or sector of the modelled part. The
        nodes of a mesh file are not checked.

        Raises
        ------
        CaseError
            If two places are too near; the message has both.
        """
        if not isinstance(shape, Grid | DiscShape | StripShape | RimmedGrid):
            return  # vertices of a file stay where they are
        for name in self.points:
            self._refuse_beside_edges(name, shape, plane)
        charts = list(self.points.values())
        # (points, 2): of a grid the numbers of the lines that cross at each point's vertex
        vertices = shape.vertices_of(charts) if isinstance(shape, Grid) else None
        # every two points; points at one place share a vertex and are allowed
        for (i, name), (j, other_name) in combinations(enumerate(self.points), 2):
            if vertices is not None:  # in a grid points are too near if they take the same vertex
                is_near = (vertices[i] == vertices[j]).all()
            else:
                distance = float(np.hypot(*(charts[i] - charts[j])))
                size = self._size_of_elements(charts[i], shape)
                is_near = distance < MIN_VERTEX_DISTANCE * size
            if is_near and not np.array_equal(charts[i], charts[j]):
                self._refuse(
                    name,
                    other_place=self._place(charts[j]),
                    what=f"{self._key(other_name)}: [{{}}]",
                    hint="give one of them",
                    factor=MIN_VERTEX_DISTANCE,
                )

    def _refuse_beside_edges(
        self, name: str, shape: Grid | PlaneShape, plane: Mirror | None
    ) -> None:
        """Raise CaseError for a point beside an edge or a plane of symmetry, but not on it."""
        chart = self.points[name]
        factor = MIN_VERTEX_DISTANCE if isinstance(shape, Grid) else EDGE_DISTANCE
        size = self._size_of_elements(chart, shape)
        (place,) = self.outline.embedding(chart[None])
        for side in plane.planes.values() if plane else ():
            distance = float(side.signed_distance(place))
            if ROUNDING < abs(distance) < factor * size:  # beside the plane, not on it
                on_plane = self._in_case_frame(place - distance * side.normal)
                hint = "put it there, or take symmetry: none"
                self._refuse(name, on_plane, "the plane of symmetry at [{}]", hint, factor)
        for edge, on_edge in edges_near(chart, self.outline).items():
            if ROUNDING < float(np.hypot(*(on_edge - chart))) < factor * size:
                words, place_on_edge = f"the edge {edge} at [{{}}]", self._place(on_edge)
                self._refuse(name, place_on_edge, words, "put it there", factor)

    def _size_of_elements(self, chart: Array, shape: Grid | PlaneShape) -> float:
        """Return the size of the elements at a chart (2,).

        The element sizes limit it, and so do the lines of a grid, or the width of another shape.
        """
        if isinstance(shape, Grid):  # its lines may be denser than the element sizes ask for
            return min(
                self.size(chart),
                *(shape.size_at(axis, float(chart[axis])) for axis in range(CHART)),
            )
        return min(self.size(chart), float(shape.area / shape.reach))

    def _refuse(self, name: str, other_place: Array, what: str, hint: str, factor: float) -> None:
        """Raise CaseError for point `name`, which is too near to another place for its elements.

        Parameters
        ----------
        other_place
            Place (3,) in the case's frame and length.
        what
            Words for that place, with {} for its coordinates.
        hint
            What to do.
        factor
            Least distance of the two places over the element size.
        """
        chart, unit = self.points[name], self.unit
        place = self._place(chart)

        def with_unit(coordinates: str) -> str:
            """Return coordinates with the unit behind each of them."""
            return ", ".join(f"{coordinate}{unit}" for coordinate in coordinates.split(", "))

        # coordinates of both places, each with its unit
        text, other_text = map(with_unit, distinguishable_texts(place, other_place))
        distance, size = float(np.linalg.norm(place - other_place)), self.size(chart) * self.R
        # elements at which both places would fit, with a margin for the lines of a grid
        fit_size = GRID_FACTOR * distance / factor
        raise CaseError(
            f"{self._key(name)}: [{text}]: is {distance:.3g}{unit} from {what.format(other_text)}, "
            f"too near for elements of {size:.3g}{unit}: {hint}, or take elements below "
            f"{fit_size:.2g}{unit}"
        )

    def _key(self, name: str) -> str:
        """Return the key of a point in messages."""
        return f"points.{name}" if name in self.names_in_case else f"the point {name}"

    def _place(self, chart: Array) -> Array:
        """Return the place (3,) of a chart in the case's frame and length."""
        return self._in_case_frame(self.outline.embedding(chart[None])[0])

    def _in_case_frame(self, x: Array) -> Array:
        """Return a place (3,) over R of the model, in the case's frame and length."""
        return np.asarray(x @ rotation(self.turn) * self.R)
