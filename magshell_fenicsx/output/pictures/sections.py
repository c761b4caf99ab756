"""Sections of a surface: the lines in which a plane cuts it, also as a drawing below its picture.

Bodies that the surface may touch are cut too. Lines on which a field is constant are found alike.

Places are over the reference length R. An upright plane contains e3.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.tessellation import tessellate
from magshell_fenicsx.output.pictures.rendering import deflected_place, near_solids

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
PLANE_TOLERANCE = 1e-6  # over R: distance of places on a plane
BODY_MARGIN = 0.25  # over the surface's extent: of what is drawn of bodies beyond its section
BODY_COLOUR = (0.38, 0.52, 0.55)
MIN_OFFSET = 0.05  # over the surface's extent: distance from the axis of a place beside it
MIN_LENGTH = 0.5  # of the lines of a section, over the surface's extent
DIRECTIONS = (("e_1", (1.0, 0.0)), ("e_2", (0.0, 1.0)))  # of planes through a place on the axis


@dataclass(frozen=True)
class UprightSection:
    """Deformed and undeformed surface in an upright plane.

    Attributes
    ----------
    undeformed, deformed, bodies
        (n, 2, 2) lines in the plane: to the right, and up along e3.
    direction
        Horizontal unit vector (x, y) in the plane.
    words
        Where the plane is.
    """

    undeformed: Array
    deformed: Array
    bodies: Array
    direction: tuple[float, float]
    words: str

    @property
    def box(self) -> tuple[float, float, float, float]:
        """Limits (left, right, low, high) of the surface, and of bodies that are not far beyond."""
        places = np.concatenate([self.undeformed, self.deformed]).reshape(-1, 2)
        low, high = places.min(axis=0), places.max(axis=0)
        margin = BODY_MARGIN * float((high - low).max())
        low, high = low - margin, high + margin
        is_near = (self.bodies.max(axis=1) > low) & (self.bodies.min(axis=1) < high)
        near_bodies = self.bodies[is_near.all(axis=1)].reshape(-1, 2)
        places = np.concatenate([places, np.clip(near_bodies, low, high)])
        (left, lower), (right, upper) = places.min(axis=0), places.max(axis=0)
        return float(left), float(right), float(lower), float(upper)

    def draw(self, axes: "Axes") -> None:
        """Draw the deformed lines black, the undeformed ones and bodies grey, in equal scales.

        Lines of bodies end at the box.
        """
        from matplotlib.collections import LineCollection

        for lines, colour, width in (
            (self.bodies, BODY_COLOUR, 0.8),
            (self.undeformed, "0.65", 0.8),
            (self.deformed, "0.1", 1.2),
        ):
            collection = LineCollection(list(lines), colors=colour, linewidths=width)
            collection.set_capstyle("round")
            # the box is that of the surface's lines without their width
            collection.set_clip_on(lines is self.bodies)
            axes.add_collection(collection, autolim=False)
        left, right, low, high = self.box
        axes.set(xlim=(left, right), ylim=(low, high))
        axes.set_axis_off()


def upright_section(surface: Surface) -> UprightSection | None:
    """Return the section of a surface through its axis and the place that moves most.

    The axis is upright, in the middle. Through a place on the axis the plane is along e1 or e2,
    where the section is taller.

    Returns
    -------
    The section; None if such a plane cuts less than a small part of the surface.
    """
    low, high = surface.r0.min(axis=0), surface.r0.max(axis=0)
    middle = (low + high) / 2
    offset = (deflected_place(surface) - middle)[:2]
    distance, extent = float(np.linalg.norm(offset)), float((high - low).max())
    if distance > MIN_OFFSET * extent:
        x, y = offset / distance
        sections = [section_along(surface, (x, y), "through the largest displacement")]
    else:
        sections = [
            section_along(surface, direction, f"along ${name}$") for name, direction in DIRECTIONS
        ]
    long_sections = [
        section
        for section in sections
        if min(_length(section.undeformed), _length(section.deformed)) > MIN_LENGTH * extent
    ]
    return max(long_sections, key=_height) if long_sections else None


def _length(lines: Array) -> float:
    """Return the length of all lines (n, 2, 2) together."""
    return float(np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum())


def _height(section: UprightSection) -> float:
    """Return the height of a section."""
    _, _, low, high = section.box
    return high - low


def section_along(surface: Surface, direction: tuple[float, float], words: str) -> UprightSection:
    """Return the section by the upright plane along a horizontal unit vector, through the middle.

    The middle is that of the box around the undeformed surface. `words` say where the plane is.
    """
    x, y = direction
    middle = (surface.r0.min(axis=0) + surface.r0.max(axis=0)) / 2
    axes, normal = np.array([[x, y, 0.0], [0.0, 0.0, 1.0]]), np.array([-y, x, 0.0])
    lines_of_bodies = [
        level_lines(
            solid.triangles, solid.points, (solid.points - middle) @ normal, PLANE_TOLERANCE
        )
        for solid in near_solids(surface)
    ]
    undeformed, deformed, bodies = (
        (lines - middle) @ axes.T
        for lines in (
            plane_section(surface, surface.r0, middle, normal),
            plane_section(surface, surface.r0 + surface.u, middle, normal),
            np.concatenate([np.zeros((0, 2, 3)), *lines_of_bodies]),
        )
    )
    return UprightSection(undeformed, deformed, bodies, direction, words)


def plane_section(surface: Surface, r: Array, place: Array, normal: Array) -> Array:
    """Return the lines (n, 2, 3) in which a surface meets a plane; each lies in one triangle.

    Parameters
    ----------
    surface
        The mid-surface of a shell, or the surface of a solid.
    r
        (nodes, 3) places of its nodes.
    place, normal
        (3,) a place on the plane, and the plane's normal, of any length.
    """
    tessellation = tessellate(surface)
    places = tessellation.at_points(r)
    height = (places - place) @ (normal / np.linalg.norm(normal))
    return level_lines(tessellation.triangles, places, height, PLANE_TOLERANCE)


def level_lines(
    triangles: NDArray[np.integer[Any]], places: Array, values: Array, tolerance: float
) -> Array:
    """Return the lines (n, 2, 3) on a surface on which values are zero; each lies in one triangle.

    Parameters
    ----------
    triangles
        (k, 3) numbers of the corners of flat triangles.
    places, values
        (m, 3) and (m,) at the corners.
    tolerance
        Smaller magnitudes of values count as positive, so that no line runs through a region in
        which values are zero up to rounding.
    """
    values = np.where(np.abs(values) < tolerance, tolerance, values)
    corners, heights = places[triangles], values[triangles]
    crossed = np.abs(np.sign(heights).sum(axis=1)) < 3  # whether corners are on both sides
    corners, heights = corners[crossed], heights[crossed]
    # the corner that is alone on its side of zero: the lowest one if two are above
    two_are_above = np.sign(heights).sum(axis=1) > 0
    single_corner = np.where(two_are_above, heights.argmin(axis=1), heights.argmax(axis=1))
    rows = np.arange(len(corners))
    single_place, single_height = corners[rows, single_corner], heights[rows, single_corner]
    # the line cuts the two sides from that corner to the others
    ends = list[Array]()
    for shift in (1, 2):
        other_corner = (single_corner + shift) % 3
        other_place, other_height = corners[rows, other_corner], heights[rows, other_corner]
        fraction = (single_height / (single_height - other_height))[:, None]
        ends.append((1 - fraction) * single_place + fraction * other_place)
    return np.stack(ends, axis=1)
