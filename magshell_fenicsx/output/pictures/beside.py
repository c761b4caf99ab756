"""What is beside the shell: bodies as glass, magnets with a red north and a blue south pole; names
of what is far.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.tessellation import Tessellation
from magshell_fenicsx.output.pictures.view import (
    Camera,
    Image,
    InView,
    Window,
    in_pixels,
    near_outlines,
    near_solids,
)
from magshell_fenicsx.shape.solids import Solid

Array = NDArray[np.float64]
NORTH, SOUTH, BODY = (0.80, 0.36, 0.33), (0.35, 0.52, 0.78), (0.62, 0.66, 0.66)
MAGNETS, BODIES = (
    (1.0, 0.3),
    (0.55, 0.3),
)  # how much of it is seen where there is no shell behind, and where there is
SLOPES = np.array(
    [[[-1.0, 1, 0]] * 3, [[-1.0, 0, 1]] * 3]
)  # of a triangle's shape functions, at its corners
SAME = 1e-3  # over R: lines of a solid are within the box around it
WITHIN = 2.0  # pixels: a line that is no deeper than this below a face lies on it


@dataclass(frozen=True)
class Laid:
    """One solid in a picture: its colours, and how much of them each pixel has."""

    image: Image
    part: Array

    def on(self, under: Image) -> Image:
        """An image with it in front."""
        laid, covered = under.copy(), self.part > 0
        over, back = self.part[covered], under[covered]
        below = back[:, 3] / 255 * (1 - over)
        alpha = over + below
        colours = (over[:, None] * self.image[covered, :3] + below[:, None] * back[:, :3]) / alpha[
            :, None
        ]
        laid[covered] = np.rint(np.column_stack([colours, 255 * alpha]))
        return laid


class Beside:
    """The solids near a shell in its window, and where the shell hides them."""

    def __init__(self, surface: Surface, camera: Camera, window: Window, shell: InView) -> None:
        self._camera, self._window, self._shell = camera, window, shell
        self._solids = near_solids(surface)

    @cached_property
    def _seen(self) -> list[InView]:
        return [
            InView(_pieces(solid), solid.points, self._camera, self._window)
            for solid in self._solids
        ]

    @cached_property
    def _visible(self) -> list[NDArray[np.bool_]]:
        """Where each is in front of the others and of the shell."""
        depths = [seen.depth for seen in self._seen]
        in_front = []
        for i, depth in enumerate(depths):
            others = [self._shell.depth, *(other for k, other in enumerate(depths) if k != i)]
            in_front.append(
                (depth > -np.inf) & np.logical_and.reduce([depth >= other for other in others])
            )
        return in_front

    @cached_property
    def laid(self) -> list[Laid]:
        """All of them, to be put on an image of the shell."""
        behind, laid = self._shell.depth > -np.inf, []
        for solid, seen, visible in zip(self._solids, self._seen, self._visible, strict=True):
            alone, over = BODIES if solid.poles is None else MAGNETS
            part = alone * in_pixels(visible & ~behind) + over * in_pixels(visible & behind)
            table = np.array([BODY] if solid.poles is None else [SOUTH, NORTH])
            values = np.zeros(len(solid.points)) if solid.poles is None else solid.poles
            most = float(np.abs(values).max()) or 1.0
            laid.append(
                Laid(seen.painted(values[solid.triangles.ravel()], (-most, most), table), part)
            )
        return laid

    @property
    def lines(self) -> list[Array]:
        """Outlines and edges (n, 2) in the projection, where they are seen."""
        import contourpy

        left, _, _, high = self._window.box
        pieces = list[Array]()
        for solid, seen, visible in zip(self._solids, self._seen, self._visible, strict=True):
            made: Any = contourpy.contour_generator(
                z=np.pad(in_pixels(visible), 1, mode="edge")
            ).lines(0.5)
            pieces += [
                np.array([left, high]) + (line - 0.5) * np.array([1, -1]) / self._window.scale
                for line in made
            ]
            pieces += self._edges(solid, seen)
        return pieces

    def _edges(self, solid: Solid, seen: InView) -> list[Array]:
        if not (creases := solid.creases):
            return []
        divided = [_divided(line) for line in creases]
        fine, within = np.concatenate(divided), WITHIN / self._window.scale
        places = self._camera(fine)[:, :2]
        places[~(seen.shows(fine, within) & self._shell.shows(fine, within))] = np.nan
        places[np.cumsum([len(line) for line in divided]) - 1] = np.nan  # lines are not joined
        return [places]

    @property
    def poles(self) -> list[tuple[float, float, str]]:
        """Where N and S of magnets stand, as far as they are seen."""
        letters = []
        for solid, seen in zip(self._solids, self._seen, strict=True):
            for sign, letter in ((1, "N"), (-1, "S")) if solid.poles is not None else ():
                centres = _centres(solid)
                own = centres[
                    (_poles(solid) * sign > 0)
                    & seen.shows(centres, 2 * WITHIN / self._window.scale)
                ]
                if len(own) and self._shell.shows(own.mean(axis=0)[None], 0.0)[0]:
                    x, y = self._camera(own.mean(axis=0))[:2]
                    letters.append((float(x), float(y), letter))
        return letters


def _pieces(solid: Solid) -> Tessellation:
    """Its faces as flat triangles, smooth where they share corners."""
    numbers = np.arange(3 * len(solid.triangles), dtype=np.int32).reshape(-1, 3)
    return Tessellation(solid.triangles, np.eye(3), SLOPES, numbers, flat=True)


def _divided(line: Array) -> Array:
    """A line with places between its own, the last one twice."""
    t = np.linspace(0.0, 1.0, 24 if len(line) == 2 and np.ptp(line, axis=0).max() > 0.2 else 4)[
        :, None
    ]
    return np.concatenate([(1 - t) * line[0] + t * line[-1], line[-1:]])


def _centres(solid: Solid) -> Array:
    return np.asarray(solid.points[solid.triangles].mean(axis=1))


def _poles(solid: Solid) -> Array:
    assert solid.poles is not None
    return np.asarray(solid.poles[solid.triangles].mean(axis=1))


def near_places(surface: Surface) -> Sequence[Array]:
    """Places (n, 3) of all that is drawn beside the shell."""
    return (*near_outlines(surface), *(solid.points for solid in near_solids(surface)))


def bare_outlines(surface: Surface) -> tuple[Array, ...]:
    """The lines of what has no faces, such as coils."""
    corners = [solid.points for solid in surface.solids]
    low, high = ([each(p, axis=0) for p in corners] for each in (np.min, np.max))
    return tuple(
        line
        for line in near_outlines(surface)
        if not any(
            ((line >= a - SAME) & (line <= b + SAME)).all() for a, b in zip(low, high, strict=True)
        )
    )


def far_said(surface: Surface) -> str:
    """The bodies and sources that are not drawn, as they are too far away."""
    near = near_solids(surface)
    far = [solid for solid in surface.solids if not any(solid is other for other in near)]
    middle = (surface.r0 + surface.u).mean(axis=0)
    words = [f"{solid.name} ({_away(solid, middle):.2g} R away)" for solid in far]
    if words:
        return f"Outside the picture: {', '.join(words)}."
    left_out = len(surface.outlines) - len(near_outlines(surface))
    return "Sources of the field, or bodies, are outside the picture." if left_out else ""


def _away(solid: Solid, middle: Array) -> float:
    return float(np.linalg.norm(solid.points.mean(axis=0) - middle))
