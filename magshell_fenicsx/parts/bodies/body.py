"""The base of rigid bodies: their sections, where they are, and their signed distance."""

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
        """Return the distance (n,), gradient (n, 3) and Hessian (n, 3, 3) at places (n, 3)."""

    @property
    @abstractmethod
    def lines(self) -> list[Array]:
        """The outline of the body: places (n, 3) along lines."""

    @property
    def solid(self) -> Solid | None:
        """The faces of the body; None without."""
        return None

    @property
    def mirror_vectors(self) -> Sequence[Array]:
        """Vectors (3,) that a mirror plane through e3 must contain, of a body that is round about
        them.
        """
        return ()

    @property
    def possible_mirror_vectors(self) -> Sequence[Array]:
        """Vectors (3,) of which each may lie in a mirror plane through e3, of a body with several
        planes.
        """
        return ()


@dataclass(frozen=True)
class PlacedBody:
    """A body's place, dimensionless and in the model's frame.

    Attributes
    ----------
    key
        Of the case file, for messages.
    front, centre
        The place (3,) of its surface that goes ahead, and its reference point behind that.
    direction
        Unit vector (3,) of the approach.
    Q
        Turns vectors of the case into the model's frame.
    R
        The length that lengths are over.
    """

    key: str
    front: Array
    centre: Array
    direction: Array
    Q: Array
    R: float

    def axis_across(self, axis: list[float]) -> Array:
        """Return the unit vector along the part of an axis that is across the approach.

        Raises
        ------
        CaseError
            If there is none.
        """
        v = self.Q @ unit(np.array(axis))
        v = v - (v @ self.direction) * self.direction
        if (size := float(np.linalg.norm(v))) < AXIS_TOLERANCE:
            raise CaseError(f"{self.key}.axis: is along the approach; give an axis across it")
        return np.asarray(v / size)

    def axes(self, axis: list[float]) -> Array:
        """Return unit vectors as rows (3, 3).

        They are along an axis, across it and the approach, and along the approach.
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
    """Of the approach; by default along the shell's normal at `at`, towards the shell"""
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
        """Return its description in `magshell check`."""
        radius = getattr(self, "radius", None)
        if radius is None:
            return self.kind
        return f"{self.kind} of radius " + (f"{1e3 * radius:g} mm" if with_units else f"{radius:g}")

    def distance(self, placed_body: PlacedBody) -> Distance:
        """Return its signed distance where it is.

        Raises
        ------
        CaseError
            If its axis is along the approach.
        """
        raise NotImplementedError


def place_body(
    section: BodySection, key: str, place: Array, normal: Array, half: float, Q: Array, R: float
) -> PlacedBody:
    """Return where a body is.

    Parameters
    ----------
    place, normal
        Of the undeformed mid-surface where it touches first, in the case's frame over R.
    half
        Half the thickness over R.
    """
    outward = normal if section.side == "outside" else -normal
    d = unit(-outward if section.direction is None else np.array(section.direction))
    d, front_offset = Q @ d, section.front_offset / R
    front = Q @ (place + half * outward)
    if section.position is not None:
        front = Q @ (np.array(section.position) / R) + front_offset * d
    return PlacedBody(key, front, front - front_offset * d, d, Q, R)


class RigidBodies(KeyAbility[Mapping[str, BodySection]]):
    """All bodies of a case."""

    key = "bodies"

    def refuse_unfit(self, context: Context) -> None:
        """Refuse names and places, and bodies beside a solid."""
        for name, body in self.sections.items():
            context.on_shell(f"bodies.{name}", 0.0 if body.at.point else body.at.polar)
            if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,39}", name):
                raise ValueError(
                    f"bodies.{name}: a name is a letter, then letters, digits and _; at most 40"
                )
            if name in endings():
                raise ValueError(
                    f"bodies.{name}: is taken, by columns in this unit; choose another name"
                )
        patch = "of a solid give a force on a patch (kind: indentation, patch)"
        context.needs("bodies", "a mid-surface", hint=patch)


def rounded(q: Array, edge: float) -> tuple[Array, Array, Array]:
    """Return the signed distance from a rounded convex corner, with derivatives by q.

    The corner is in two or three coordinates.

    Parameters
    ----------
    q
        (n, m) coordinates from the corner of the core, which is where all are negative.
    edge
        Radius that rounds the core.
    """
    outside_part = np.maximum(q, 0.0)
    distance = np.linalg.norm(outside_part, axis=1)
    is_outside = distance > 0
    nearest = np.eye(q.shape[1])[q.argmax(axis=1)]
    n = np.where(is_outside[:, None], outside_part / np.maximum(distance, 1e-300)[:, None], nearest)
    active = (outside_part > 0)[:, :, None] * np.eye(q.shape[1])
    H = (active - n[:, :, None] * n[:, None, :]) / np.maximum(distance, 1e-300)[:, None, None]
    return (
        np.where(is_outside, distance, q.max(axis=1)) - edge,
        n,
        np.where(is_outside[:, None, None], H, 0.0),
    )
