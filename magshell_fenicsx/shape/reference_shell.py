"""The shell that imperfections, bodies and sources are placed on, and lines that outline bodies.

`ReferenceShell` has the reference surface with and without imperfections, and the scales of the
case. `locate` turns a direction or a point of the case into a place and the distance from it. The
lines outline simple bodies around their own axes. Lengths are over R.

An outline is a surface as a chart (coordinates (2,), or a place (3,) for a mesh file) with its map
to space; `inverse` gives the chart of a place, `highest` the chart of the pole or tip. The surface
is perfect without its imperfections. `polar` is an angle from e3, `azimuth` one around it. "Refuse"
means: raise an error that names the key of the case file.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import TYPE_CHECKING, Annotated, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from magshell_fenicsx.input.expressions import formula
from magshell_fenicsx.input.section import Direction, or_number
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.mesh.vertex_spacing import SAME_PLACE_TOLERANCE

if TYPE_CHECKING:
    from magshell_fenicsx.shape.outline import Outline


Array = NDArray[np.float64]
Distance = Callable[[Array], Array]  # places (n, 3) over R -> distances (n,) over R, from one place
Coordinates = Annotated[
    list[Annotated[float, or_number("metre")]], Field(min_length=3, max_length=3)
]
ON_AXIS = 1e-9  # over R: distance from e3 up to which a place is on it
ON_SPHERE = 1e-6  # over R: distance of a place on the sphere from its image in the chart
HALF_DRAWN_EXTENT = 0.5  # over R: half the drawn extent of an infinite body
CIRCLE_POINTS = 49  # of a line along a circle


class At(Direction):
    """A direction from the centre of a sphere, `polar: 0` of a pole or a centre; or a place of the
    perfect surface, which alone a mesh takes.
    """

    point: Coordinates | None = None
    """Place on the perfect surface, on any shape [the shell's length; over R if that has no
    unit]"""

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        """Refuse a point together with angles, with a ValueError."""
        if self.point is not None and {"polar", "azimuth"} & self.model_fields_set:
            raise ValueError("give a point, or polar and azimuth")
        return self

    def words(self) -> str:
        """Return the place in words."""
        if self.point is not None:
            return f"at ({', '.join(f'{x:g}' for x in self.point)})"
        return f"at polar {self.polar:g}, azimuth {self.azimuth:g}" if self.polar else "at the pole"


@dataclass(frozen=True)
class ReferenceShell:
    """The shell that imperfections, bodies and sources are placed on.

    Places are over R, in the frame of the case.

    Attributes
    ----------
    geometry
        The geometry's name in the case.
    perfect, imperfect
        The surface without imperfections, and with those that do not grow.
    R
        Reference length that lengths of the case are divided by, in the case's unit.
    R_over_h, nu
        R over the thickness, and Poisson's ratio.
    with_units
        Whether lengths of the case are in metres.
    edge_polar
        Angle of the edge of a part of a sphere from e3 (degree); None of other geometries.
    thickness_factor
        A formula that multiplies the thickness; None for 1.
    identity
        Words and numbers that are equal for equal perfect surfaces.
    turn
        Angle by which the model's frame is turned about e3 (rad).
    hole_polar
        Angle of the edge of a hole in a part of a sphere, from e3 (degree); 0 without a hole.
    azimuths
        First and last azimuth (degree) of a part of a surface of revolution; None all around.
    """

    geometry: str
    perfect: "Outline"
    imperfect: "Outline"
    R: float
    R_over_h: float
    nu: float
    with_units: bool = False
    edge_polar: float | None = None
    thickness_factor: str | None = None
    identity: tuple[str | None, ...] = ()
    turn: float = 0.0
    hole_polar: float = 0.0
    azimuths: tuple[float, float] | None = None

    @property
    def h(self) -> float:
        """The thickness over R."""
        return 1 / self.R_over_h

    @cached_property
    def Q(self) -> Array:
        """Matrix (3, 3) that turns vectors of the case into the model's frame."""
        return rotation(self.turn)

    @property
    def spherical(self) -> bool:
        """Whether distances on the shell are angles."""
        return self.edge_polar is not None

    @property
    def has_pole_or_tip(self) -> bool:
        """Whether the surface has a place that stands for none given: its pole or a strip's tip."""
        outline = self.perfect
        return outline.highest is not None and (outline.disc or self.geometry == "strip")

    @cached_property
    def _thickness_formula(self) -> Callable[..., Array] | None:
        """The formula of the thickness factor as a function of x, y, z; None without one."""
        return formula(self.thickness_factor) if self.thickness_factor else None

    def half_thickness(self, x: Array) -> Array:
        """Return half the thickness over R (n,) at places x (n, 3)."""
        factor = self._thickness_formula(*x.T) if self._thickness_formula else 1.0
        return np.broadcast_to(self.h / 2 * factor, len(x))


@dataclass(frozen=True)
class AngularDistance:
    """The angle (rad) of places (n, 3) from a unit vector (3,); a `Distance`."""

    axis: Array

    def __call__(self, places: Array) -> Array:
        (a, b, c), (x, y, z) = self.axis, places.T
        # the sine; np.cross takes thrice the time
        sine = np.sqrt((b * z - c * y) ** 2 + (c * x - a * z) ** 2 + (a * y - b * x) ** 2)
        return np.asarray(np.arctan2(sine, places @ self.axis))


@dataclass(frozen=True)
class StraightDistance:
    """The distance of places (n, 3) in space from a place (3,); a `Distance`."""

    place: Array

    def __call__(self, places: Array) -> Array:
        return np.asarray(np.linalg.norm(places - self.place, axis=1))


def locate(at: At, ground: ReferenceShell, key: str) -> tuple[Array, Distance]:
    """Return a place of the perfect surface, and the function that gives distances from it.

    The distance is an angle on a sphere. From the pole of a surface of revolution it is the length
    of the meridian, otherwise it is straight.

    Parameters
    ----------
    at
        The place in the words of the case.
    ground
        The shell.
    key
        Key of the place in the case file, for messages.

    Returns
    -------
    place
        (3,) over R.
    distance
        Places (n, 3) -> (n,) over R.

    Raises
    ------
    CaseError
        If the place does not lie on the surface, or a direction does not determine it.
    """
    place = _place(at, ground, key)
    perfect = ground.perfect
    if ground.spherical:
        return place, AngularDistance(place / np.linalg.norm(place))
    if perfect.from_pole and np.hypot(*place[:2]) < ON_AXIS:
        return place, perfect.from_pole
    return place, StraightDistance(place)


def _off_sphere_text(at: At, ground: ReferenceShell) -> str:
    """Return the end of a message about a direction that is not on a part of a sphere.

    It follows the key `at`.
    """
    hole, edge = ground.hole_polar, ground.edge_polar or 0.0
    if hole and "polar" not in at.model_fields_set:
        return (
            ": is not given, and the pole is in the hole of the shell: "
            f"give polar, {hole:g} to {edge:g}"
        )
    if hole <= at.polar <= edge and ground.azimuths:
        first, last = ground.azimuths
        return f".azimuth: {at.azimuth:g}: is not on the shell: allowed {first:g} to {last:g}"
    hint = f", beside its hole of {hole:g} degrees" if at.polar < hole else ""
    return f".polar: {at.polar:g}: is not on the shell: allowed {hole:g} to {edge:g}{hint}"


def _place(at: At, ground: ReferenceShell, key: str) -> Array:
    """Return the place (3,) over R of the perfect surface that a case means by `at`.

    Raises
    ------
    CaseError
        If the place does not lie on the surface, or a direction does not determine it.
    """
    perfect = ground.perfect
    if at.point is not None:
        place = np.array(at.point) / ground.R
        if ground.geometry != "mesh":
            point_key, with_units = f"{key}.at.point", ground.with_units
            refuse_off_surface(point_key, place, perfect, ground.R, with_units=with_units)
        return place
    if ground.spherical:  # a direction
        direction = at.vector()
        is_polar_allowed = 0 <= at.polar <= 180
        # a direction beyond the edge differs from the place of its chart
        in_chart = perfect.perfect(perfect.inverse(direction)[None])[0]
        if not is_polar_allowed or np.linalg.norm(in_chart - direction) > ON_SPHERE:
            raise CaseError(f"{key}.at{_off_sphere_text(at, ground)}")
        return direction
    # elsewhere only the pole or the tip has a direction, which is zero
    if perfect.highest is None or at.polar or not ground.has_pole_or_tip:
        raise CaseError(
            f"{key}.at: on a {ground.geometry} give its place, at: {{point: [x, y, z]}}"
        )
    return np.asarray(perfect.perfect(perfect.highest[None])[0])


def refuse_off_surface(
    key: str, x: Array, outline: "Outline", R: float, *, with_units: bool
) -> None:
    """Refuse a place that is neither on the surface nor on the one without imperfections.

    Parameters
    ----------
    key
        Key of the place in the case file, for the message.
    x
        (3,) over R.
    outline
        The surface.
    R
        Reference length in the unit of the case.
    with_units
        Whether that unit is the metre.

    Raises
    ------
    CaseError
        With a place near it that is on the surface.
    """
    # the chart of a mesh file is the place itself, (3,), and nothing is refused
    chart = outline.inverse(x)
    has_chart = len(chart) == 2
    # places of the chart on the imperfect and on the perfect surface
    nearest = outline.embedding(chart[None])[0] if has_chart else x
    perfect = outline.perfect(chart[None])[0] if has_chart else x
    distances = [float(np.linalg.norm(place - x)) for place in (nearest, perfect)]
    if min(distances) > SAME_PLACE_TOLERANCE:
        # the message gives the nearest place in mm, or in the unit of the case
        unit_size, unit = (1e3 * R, " mm") if with_units else (R, "")
        # + 0.0 makes zero of a negative zero
        near_place = ", ".join(f"{c * unit_size + 0.0:.13g}{unit}" for c in np.round(nearest, 12))
        hint = "; a number without a unit is in metres here" if with_units else ""
        raise CaseError(
            f"{key}: is not on the surface; a place near it that is: [{near_place}]{hint}"
        )


def circle_line(radius: float, z: float = 0.0, *, axes: tuple[int, int, int] = (0, 1, 2)) -> Array:
    """Return places (n, 3) along a circle around the last of some axes, at the height z.

    `axes` are the numbers of the first, second and last axis of the circle.
    """
    t = np.linspace(0.0, 2 * np.pi, CIRCLE_POINTS)
    around_z = np.column_stack([radius * np.cos(t), radius * np.sin(t), np.full_like(t, z)])
    return around_z[:, np.argsort(axes)]


def cylinder_lines(radius: float, height: float) -> list[Array]:
    """Return the outline of a cylinder about z: both circles, and four lines between them."""
    ends = np.array([-height / 2, height / 2])
    corners = radius * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    bottom, top = ends
    sides = [np.array([[x, y, bottom], [x, y, top]]) for x, y in corners]
    return [*(circle_line(radius, z) for z in ends), *sides]


def sphere_lines(radius: float) -> list[Array]:
    """Return the outline of a sphere: three circles."""
    return [circle_line(radius, axes=axes) for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]


def box_lines(low: Array, high: Array) -> list[Array]:
    """Return the twelve edges of a box between two corners (3,)."""
    corners = np.array([*product((0, 1), repeat=3)])
    pairs = [(a, b) for a in corners for b in corners if (b - a).sum() == 1 and (b >= a).all()]
    return [low + np.array(pair) * (high - low) for pair in pairs]


def frame_along(axis: Array) -> Array:
    """Return a right-handed orthonormal frame (3, 3) as columns, with `axis` (3,) as the last."""
    # normal to the axis and to the coordinate axis farthest from it
    first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    first = first / np.linalg.norm(first)
    return np.column_stack([first, np.cross(axis, first), axis])
