"""Where imperfections are in the chart of the model, for its mesh."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import product
from math import sqrt

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grading import Disc, Feature
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.course import Fit
from magshell_fenicsx.parts.imperfections.imperfection import Flaw
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
CORNERS = 128  # of a closed curve: a cubic spline through them is exact to 1e-6 of its size
STEPS, ROUNDS = 40, 12
SAME_RIM = 0.02  # of the element size
MOST_RIMS = 60  # more would take gmsh minutes
WIDEST = 4.0  # distance in the chart over the distance on the surface
AXIS = 1e-9  # over R


@dataclass(frozen=True)
class Spot:
    """A local imperfection in the chart.

    Attributes
    ----------
    centre, radius
        The disc that it needs small elements in.
    size
        See `Flaw`.
    circle
        Whether its outline is a circle around the chart's origin.
    rim
        Points (n, 2) of the closed curve on which the curvature jumps; None where it does not, and of a circle.
    """

    centre: Array
    radius: float
    size: float
    circle: bool = False
    jumps: bool = False
    rim: Array | None = None

    def features(self, outline: Outline, fit: Fit, growth: float) -> list[Feature]:
        """Small elements on it and a little around it, which grow so fast away from there."""
        radius, size = self.radius + 0.7 * sqrt(fit.h), self.size / fit.refinement
        return [Disc((float(x), float(y)), radius, size, growth) for x, y in images(self, outline)]


def spots(flaws: Iterable[tuple[str, Flaw]], drawn: Outline, turn: float) -> list[Spot]:
    """The local imperfections of a case in the chart of a frame that is turned about e3 (rad).

    Parameters
    ----------
    drawn
        The perfect shell.

    Raises
    ------
    CaseError
        If one reaches around the shell.
    """
    placed = []
    for key, flaw in flaws:
        if flaw.centre is None:
            continue
        if drawn.disc and np.hypot(*flaw.centre[:2]) < AXIS:
            placed.append(Spot(np.zeros(2), flaw.reach, flaw.size, circle=True, jumps=flaw.rim))
            continue
        centre = drawn.inverse(rotation(turn) @ flaw.centre)
        curve = contour(key, flaw, drawn, turn, centre, 1.0)
        radius = float(np.linalg.norm(curve - centre, axis=1).max())
        placed.append(Spot(centre, radius, flaw.size, False, flaw.rim, curve if flaw.rim else None))
    return placed


def different(local: Iterable[Spot]) -> tuple[Array, ...]:
    """The rims that need edges of elements; of several that are nearly the same, the first."""
    kept: list[Array] = []
    for spot in local:
        rim = spot.rim
        if rim is not None and all(np.abs(rim - other).max() > SAME_RIM * spot.size for other in kept):
            kept.append(rim)
    return tuple(kept)


def contour(key: str, flaw: Flaw, drawn: Outline, turn: float, centre: Array, part: float) -> Array:
    """Points (n, 2) of the chart at a part of the reach of an imperfection: the first on each ray from its centre."""
    assert flaw.distance
    distance, Q, wanted = flaw.distance, rotation(turn), part * flaw.reach
    angles = np.arange(CORNERS) * 2 * np.pi / CORNERS
    rays = np.column_stack([np.cos(angles), np.sin(angles)])

    def beyond(t: Array) -> Array:
        """On each ray the distance at (..., corners) of the chart, less the one that is wanted."""
        chart = centre + t[..., None] * rays
        return distance(drawn.perfect(chart.reshape(-1, 2)) @ Q).reshape(t.shape) - wanted

    tried = np.linspace(0, WIDEST * wanted, STEPS + 1)[1:]
    outside = beyond(np.tile(tried[:, None], CORNERS)) >= 0
    if not outside.any(axis=0).all():
        raise CaseError(
            f"shell.{key}.width: its width over R, {flaw.reach:.3g}, is too much for this place: it would reach "
            "around the shell or its axis"
        )
    high = tried[outside.argmax(axis=0)]
    low, below, above = high - tried[0], beyond(high - tried[0]), beyond(high)
    for _ in range(ROUNDS):  # of the rule of false position, where the end that stays counts half
        middle = high - above * (high - low) / (above - below)
        between = beyond(middle)
        crossed = between * above < 0
        low, below = np.where(crossed, high, low), np.where(crossed, above, below / 2)
        high, above = middle, np.where(between == 0, 1e-300, between)
    return np.asarray(centre + high[:, None] * rays)


def images(spot: Spot, drawn: Outline) -> list[Array]:
    """Its centre (2,), and the same across glued sides of a grid."""
    if not (grid := drawn.grid):
        return [spot.centre]
    steps = product(*((-1, 0, 1) if glued else (0,) for glued in grid.glued))
    return [spot.centre + np.multiply(step, np.subtract(grid.high, grid.low)) for step in steps]
