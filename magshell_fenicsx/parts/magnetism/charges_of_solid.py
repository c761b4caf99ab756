"""The charges of a magnetised solid: on faces of its cells, and inside where the remanence varies.

As those of a shell (see `charges`) they stay with the material: Br.N dA0 on faces, -Div Br dV0
inside. Here both are exact for the mesh, whose cells are mapped from a cube; between cells only a
jump of the remanence leaves a charge.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import basix
import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.charges import (
    BESIDE,
    CHUNK,
    LAYERS,
    NEWTON,
    Boxes,
    Family,
    Found,
    gauss,
)
from magshell_fenicsx.parts.magnetism.magnetised_cells import Nodal, tables

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
EVEN = 1e-12  # of the remanence: a cell in which it differs by less has no charge inside
BEYOND, EDGE = 0.3, 1e-9  # how far Newton's method may leave the cube, and what counts as inside
BULGE = 1.1  # of the radius of a cell's nodes: no place of it is farther from its middle
CORNERS = basix.geometry(basix.CellType.hexahedron)
AROUND = np.array(basix.topology(basix.CellType.hexahedron)[2])  # (6, 4) the corners of each face
STARTS, ENDS = (
    CORNERS[AROUND[:, 0]],
    CORNERS[AROUND[:, 1:3]] - CORNERS[AROUND[:, :1]],
)  # of its coordinates (a, b)
OUTWARD = np.sign(
    np.sum(
        np.cross(ENDS[:, 0], ENDS[:, 1])
        * basix.cell.facet_outward_normals(basix.CellType.hexahedron),
        axis=1,
    )
)


@dataclass(frozen=True)
class Body:
    """The cells of a solid with what is magnetised, at nodes.

    Attributes
    ----------
    element
        Of the undeformed place and of u, on a cube.
    X, u
        (cells, nodes, 3) at its nodes.
    of_remanence, remanence
        As of `charged.Shape`.
    """

    element: Any
    X: Array
    u: Array
    of_remanence: Any
    remanence: Array

    def holds(self, places: Array) -> NDArray[np.bool_]:
        """Which of places (n, 3) are in the deformed cells."""
        from scipy.spatial import cKDTree  # takes long to import

        held = np.zeros(len(places), dtype=bool)
        if not len(self.X):
            return held
        x = self.X + self.u
        middle = x.mean(axis=1)
        radius = BULGE * np.linalg.norm(x - middle[:, None], axis=-1).max(axis=1)
        beside = cKDTree(middle).query_ball_point(places, radius.max())
        of = np.repeat(np.arange(len(places)), [len(each) for each in beside])
        cell = np.concatenate([*beside, []]).astype(np.intp)
        near = np.linalg.norm(places[of] - middle[cell], axis=-1) <= radius[cell]
        of, cell = of[near], cell[near]
        for first in range(0, len(of), CHUNK):
            some = slice(first, first + CHUNK)
            held[of[some][self._within(x[cell[some]], places[of[some]])]] = True
        return held

    def _within(self, nodes: Array, x: Array) -> NDArray[np.bool_]:
        """Whether places (n, 3) are in cells with nodes (n, k, 3), each in its own; Newton's
        method.
        """
        nearest = np.linalg.norm(nodes - x[:, None], axis=-1).argmin(axis=1)
        at = self.element.points[nearest]
        for _ in range(NEWTON):
            value, *by = np.einsum(
                "dnk,nki->dni", tables(self.element, at[:, None], 1)[:, :, 0], nodes
            )
            step = np.linalg.pinv(np.stack(by, axis=-1)) @ (x - value)[..., None]
            at = np.clip(at + step[..., 0], -BEYOND, 1 + BEYOND)
        value = np.einsum("nk,nki->ni", tables(self.element, at[:, None], 0)[0, :, 0], nodes)
        inside = (at > -EDGE).all(axis=1) & (at < 1 + EDGE).all(axis=1)
        return np.asarray(inside & (np.linalg.norm(x - value, axis=1) < BESIDE))


class OfBody(Family):
    """What the charges of cells have in common.

    Attributes
    ----------
    shape
        All cells.
    """

    def __init__(self, shape: Body, cells: Ints) -> None:
        self.shape, self.cells, self.count = shape, cells, len(cells)

    def reference(self, boxes: Boxes, x: Array) -> Array:
        """Places (n, m, 3) of points of boxes on the reference cube."""
        raise NotImplementedError

    def charged(self, boxes: Boxes, X: Array, weights: Array) -> Array:
        """What the remanence and its derivatives by X are multiplied by, (4, n, m, 3), from dX (3,
        n, m, 3).
        """
        raise NotImplementedError

    def middle(self, boxes: Boxes, x: Array) -> Array:
        return self.places(boxes, self.reference(boxes, x))[:, :, None]

    def places(self, boxes: Boxes, at: Array) -> Array:
        """(n, m, 3) of the deformed body."""
        cells = self.cells[boxes.of]
        return np.asarray(
            np.einsum("nmk,nki->nmi", tables(self.shape.element, at, 0)[0], self._nodes[cells])
        )

    @cached_property
    def _nodes(self) -> Array:
        return self.shape.X + self.shape.u

    def at(self, boxes: Boxes, x: Array, weights: Array, into: Nodal | None = None) -> Found:
        at, cells, shape = self.reference(boxes, x), self.cells[boxes.of], self.shape
        T, TB = tables(shape.element, at, 1), tables(shape.of_remanence, at, 1)
        X = np.einsum("dnmk,nki->dnmi", T[1:], shape.X[cells])
        B = np.einsum("dnmk,nki->dnmi", TB, shape.remanence[cells])
        C = self.charged(boxes, X, np.prod(boxes.size, axis=1)[:, None] * weights)
        place = np.einsum("nmk,nki->nmi", T[0], self._nodes[cells])
        q = np.sum(C * B, axis=(0, -1))
        if into is None:
            return Found(place[:, :, None], q[..., None])

        def back(on_x: Array, on_q: Array) -> None:
            np.add.at(into.by_u, cells, np.einsum("nmk,nmi->nki", T[0], on_x[:, :, 0]))
            np.add.at(into.by_remanence, cells, np.einsum("dnmk,dnmi->nki", TB, C * on_q))

        return Found(place[:, :, None], q[..., None], back)


class CellFaces(OfBody):
    """Faces of cells, by their local numbers: Br.N dA0 outwards."""

    def __init__(self, shape: Body, cells: Ints, faces: Ints) -> None:
        super().__init__(shape, cells)
        self._faces = faces

    def reference(self, boxes: Boxes, x: Array) -> Array:
        return on_faces(self._faces[boxes.of], boxes.points(x))

    def charged(self, boxes: Boxes, X: Array, weights: Array) -> Array:
        faces, C = self._faces[boxes.of], np.zeros((4, *X.shape[1:]))
        first, second = (np.einsum("nd,dnmi->nmi", ENDS[faces, side], X) for side in range(2))
        C[0] = (OUTWARD[faces][:, None] * weights)[..., None] * np.cross(first, second)
        return C


class Inside(OfBody):
    """-Div Br dV0 of cells."""

    across: ClassVar[int] = 3

    def reference(self, boxes: Boxes, x: Array) -> Array:
        return boxes.points(x)

    def charged(self, boxes: Boxes, X: Array, weights: Array) -> Array:
        C, density = np.zeros((4, *X.shape[1:])), -weights[..., None]
        for d in range(3):
            C[1 + d] = density * np.cross(X[(d + 1) % 3], X[(d + 2) % 3])
        return C


class Layers(Family):
    """The charges inside as layers across the third coordinate of cells, which can be drawn as
    triangles.
    """

    def __init__(self, inside: Inside) -> None:
        self._inside, self.count, self.shape = inside, inside.count, inside.shape

    def at(self, boxes: Boxes, x: Array, weights: Array, into: Nodal | None = None) -> Found:
        heights, through = gauss(LAYERS)
        zero, one = np.zeros((len(boxes.of), 1)), np.ones((len(boxes.of), 1))
        solid = Boxes(boxes.of, np.hstack([boxes.low, zero]), np.hstack([boxes.size, one]))
        points = np.concatenate([np.column_stack([x, np.full(len(x), c)]) for c in heights])
        found = self._inside.at(solid, points, np.concatenate([w * weights for w in through]))
        across = (len(boxes.of), LAYERS, len(x))
        return Found(
            found.x.reshape(*across, 3).swapaxes(1, 2), found.q.reshape(across).swapaxes(1, 2)
        )


def flat(families: Sequence[Family]) -> list[Family]:
    """The same charges on surfaces."""
    return [Layers(family) if isinstance(family, Inside) else family for family in families]


def on_faces(faces: Ints, ab: Array) -> Array:
    """Places (n, m, 3) on the reference cube of coordinates (n, m, 2) of faces (n,)."""
    return np.asarray(STARTS[faces][:, None] + ab @ ENDS[faces])


def uneven(shape: Body) -> Ints:
    """The cells in which the remanence differs."""
    spread = np.abs(shape.remanence - shape.remanence[:, :1]).max(axis=(1, 2), initial=0.0)
    return np.flatnonzero(spread > EVEN * np.abs(shape.remanence).max(initial=0.0))
