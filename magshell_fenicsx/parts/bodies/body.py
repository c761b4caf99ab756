"""The base of rigid bodies: their sections, where they are, and their signed distance.

The approach is the displacement of a body along its direction, a load parameter; distances are
those at approach zero. The front is the point of the body that goes ahead. The case's frame has the
axes of the case, the model's frame those of the part that is modelled, turned about e3. A mirror
plane of a body is one about which it is symmetric. Lengths are over R, in sections in the case's
unit. g, n and H or N are a signed distance, its gradient and its Hessian.
"""

import re
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import inf
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.section import DirectionVector, Section, or_number
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.ability import Context, KeyAbility
from magshell_fenicsx.quantities.registry import endings
from magshell_fenicsx.shape.drawn_bodies import Solid
from magshell_fenicsx.shape.reference_shell import At, Coordinates
from magshell_fenicsx.shape.symmetry_constraint import unit

Array = NDArray[np.float64]
Axis = DirectionVector
Size = Annotated[float, or_number("metre"), Field(gt=0, le=1e9)]
AXIS_TOLERANCE = 1e-6  # an axis whose part across the approach is shorter is along it


class Distance(ABC):
    """The signed distance (over R) of a body at approach zero, positive outside; its outline."""

    @abstractmethod
    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return the distance (n,), gradient (n, 3) and Hessian (n, 3, 3) at places x (n, 3).

        All are over R, for a body at approach zero.
        """

    @property
    @abstractmethod
    def lines(self) -> list[Array]:
        """The outline of the body for drawings: polylines of places (n, 3) over R."""

    @property
    def solid(self) -> Solid | None:
        """The faces of the body for drawings; None if it has none."""
        return None

    @property
    def mirror_vectors(self) -> Sequence[Array]:
        """Vectors (3,) that each mirror plane of the body must contain.

        They belong to bodies that are round about an axis. Only mirror planes through e3 are
        considered.
        """
        return ()

    @property
    def possible_mirror_vectors(self) -> Sequence[Array]:
        """Vectors (3,) each of which spans a possible mirror plane together with e3.

        They belong to bodies with several planes of symmetry, such as a box.
        """
        return ()


@dataclass(frozen=True)
class PlacedBody:
    """A body's place and direction of approach, in the model's frame and over R.

    Attributes
    ----------
    key
        Key of the body in the case file, for messages.
    front
        Place (3,) of the point of its surface that touches first.
    centre
        Its reference point (3,), behind `front` against the direction of approach.
    direction
        Unit vector (3,) of the approach.
    Q
        (3, 3) rotation from the case's frame to the model's frame.
    R
        The length, in the case's unit, by which lengths are divided.
    """

    key: str
    front: Array
    centre: Array
    direction: Array
    Q: Array
    R: float

    def axis_across(self, axis: list[float]) -> Array:
        """Return the unit vector (3,) along the part of an axis that is across the approach.

        Parameters
        ----------
        axis
            Vector (3,) in the case's frame, of any length. The result is in the model's frame.

        Raises
        ------
        CaseError
            If the axis is along the approach.
        """
        v = self.Q @ unit(np.array(axis))
        v = v - (v @ self.direction) * self.direction
        if (length := float(np.linalg.norm(v))) < AXIS_TOLERANCE:
            raise CaseError(f"{self.key}.axis: is along the approach; give an axis across it")
        return np.asarray(v / length)

    def axes(self, axis: list[float]) -> Array:
        """Return the body's orthonormal axes as rows (3, 3), in the model's frame.

        The first is along the given axis, as far as that is across the approach. The second is
        across the first and the approach. The third is along the approach.

        Raises
        ------
        CaseError
            If the given axis is along the approach.
        """
        first = self.axis_across(axis)
        return np.stack([first, np.cross(self.direction, first), self.direction])


class BodySection(Section):
    """Base of all kinds: a rigid body without friction.

    It touches the shell's face, half a thickness from the mid-surface (of rubber half the deformed
    one). `kind: contact` moves it; otherwise it stays.
    """

    kind: str
    at: At = At.model_construct()
    """Where it first touches; it gives `direction`, and without `position` the place: the front of
    the body touches the undeformed shell there"""
    side: Literal["outside", "inside"] = "outside"
    """The side of the shell that it is on"""
    direction: Axis | None = None
    """Of the approach; by default along the shell's normal at `at`, towards the shell; of a body
    that stays it only turns its axes"""
    position: Coordinates | None = None
    """Where it is at approach 0: a point of a plane, the middle of a rod's end, the centre of
    another body [the shell's length; over R if that has no unit]"""
    stiffness: float | None = Field(default=None, gt=0, le=1e12)
    """k of the penalty k s²/2 per area of a penetration s; by default 1e6 D/(R² h²) of a plane, of
    another body of radius r 15 (1 + R/r) times as much, and four times as much each time that the
    penetration would exceed its bound [E h/R²]"""
    penetration: float = Field(default=1e-3, ge=1e-6, le=0.1)
    """Largest penetration that is allowed; with a given `stiffness` the run stops where it is more
    [h]"""

    @property
    def front_offset(self) -> float:
        """Distance of its front from its reference point, in the case's unit."""
        return 0.0

    @property
    def blunt_radius(self) -> float:
        """Radius of what touches, in the case's unit; infinite for a plane."""
        return float(getattr(self, "radius", inf))

    def words(self, *, with_units: bool) -> str:
        """Return the description of the body in `magshell check`, such as "sphere of radius 0.2".

        Parameters
        ----------
        with_units
            Whether the case has units: its radius, in metres, is then given in mm.
        """
        radius = getattr(self, "radius", None)
        if radius is None:
            return self.kind
        return f"{self.kind} of radius " + (f"{1e3 * radius:g} mm" if with_units else f"{radius:g}")

    def distance(self, placed_body: PlacedBody) -> Distance:
        """Return the signed distance function of the body at its place.

        Raises
        ------
        CaseError
            If the body's axis is along the approach.
        """
        raise NotImplementedError


def place_body(
    section: BodySection, key: str, place: Array, normal: Array, half: float, Q: Array, R: float
) -> PlacedBody:
    """Return the place and the direction of approach of a body, in the model's frame.

    By default the body's front touches the shell's face, and it approaches along the normal.

    Parameters
    ----------
    key
        Key of the body in the case file, for messages.
    place, normal
        Place (3,) of the undeformed mid-surface where the body touches first, and unit normal
        there; in the case's frame over R.
    half
        Half the thickness there, over R.
    Q
        (3, 3) rotation from the case's frame to the model's frame.
    R
        The length by which lengths are divided.
    """
    outward = normal if section.side == "outside" else -normal  # from the shell to the body
    # the direction in the case's frame, then in the model's
    direction = unit(-outward if section.direction is None else np.array(section.direction))
    direction, front_offset = Q @ direction, section.front_offset / R
    # the front is on the shell's face, or ahead of a reference point with a given position
    front = Q @ (place + half * outward)
    if section.position is not None:
        front = Q @ (np.array(section.position) / R) + front_offset * direction
    centre = front - front_offset * direction
    return PlacedBody(key, front, centre, direction, Q, R)


class RigidBodies(KeyAbility[Mapping[str, BodySection]]):
    """All bodies of a case."""

    key = "bodies"

    def refuse_unfit(self, context: Context) -> None:
        """Refuse a case whose bodies have unfit names or places, or press on a solid.

        Raises
        ------
        ValueError
            With the key of the body and what is allowed.
        """
        for name, body in self.sections.items():
            # a named point is on the shell anyway; the polar angle of a direction may not be
            context.on_shell(f"bodies.{name}", 0.0 if body.at.point else body.at.polar)
            if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,39}", name):
                raise ValueError(
                    f"bodies.{name}: a name is a letter, then letters, digits and _; at most 40"
                )
            if name in endings():  # columns end with a body's name, as others with a unit
                raise ValueError(
                    f"bodies.{name}: is taken, by columns in this unit; choose another name"
                )
        hint = "of a solid give a force on a patch (kind: indentation, patch)"
        context.needs("bodies", "a mid-surface", hint=hint)


def rounded(q: Array, edge: float) -> tuple[Array, Array, Array]:
    """Return the signed distance from a convex corner with a rounded edge, and its derivatives.

    The corner is where m faces meet at right angles. The body is all that is nearer than the radius
    of the rounding to a core, which has the same corner, sharp.

    Parameters
    ----------
    q
        (n, m) coordinates from the corner of the core in m = 2 or 3 dimensions. All of them are
        negative inside the core.
    edge
        Radius of the rounding.

    Returns
    -------
    distance, n, H
        (n,) the distance, with its gradient (n, m) and Hessian (n, m, m) by q.
    """
    # outside the core: the vector from its nearest place, and its length
    outside_part = np.maximum(q, 0.0)
    core_distance = np.linalg.norm(outside_part, axis=1)
    is_outside = core_distance > 0
    divisor = np.maximum(core_distance, 1e-300)  # finite inside the core too
    # inside the core the nearest face is that of the largest coordinate
    face_normal = np.eye(q.shape[1])[q.argmax(axis=1)]
    n = np.where(is_outside[:, None], outside_part / divisor[:, None], face_normal)
    # curved only in the directions of positive coordinates, as a circle, a sphere or a plane
    active = (outside_part > 0)[:, :, None] * np.eye(q.shape[1])
    H = (active - n[:, :, None] * n[:, None, :]) / divisor[:, None, None]
    # inside the core the signed distance is the largest coordinate; the rounding is around both
    distance = np.where(is_outside, core_distance, q.max(axis=1)) - edge
    return distance, n, np.where(is_outside[:, None, None], H, 0.0)
