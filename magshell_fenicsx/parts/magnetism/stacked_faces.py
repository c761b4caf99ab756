"""The energy of the faces of cells that lie above each other, nearer than rules on both cells
resolve.

Each of Gauss's points of the first cell sees the second in polar coordinates about its foot on it,
with r = s sinh v, the gap s between the faces there, and t = sqrt(p² + s²) sinh w along each side
at a distance p: what is integrated has no pole nearer than pi/2 at any gap, so Gauss's rules
converge as fast at all (Trefethen, Approximation Theory, theorem 19.3). The places follow the
state; what that misses of a derivative is of the order of the error.

What all cells of a part make together is smooth above it, what one of them makes is not. So of two
parts it is always the smaller one whose points see the other. At free edges of the first cell they
are in rows, dense at the edge: there the force falls over a gap, and that of the other faces over a
thickness.

The face of the first cell that is near the other has its charges in three layers below it, from
which they are extrapolated: the sum of such charges is that of the face up to its third moment. So
nothing is singular where faces touch or press on each other, and energy, forces and tangent are one
smooth sum down to a penetration of `DEPTH`.
"""

from functools import cached_property
from itertools import product

import basix
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.charge_derivatives import Complex, Weights, add
from magshell_fenicsx.parts.magnetism.charges import Boxes, Faces, gauss, heights
from magshell_fenicsx.parts.magnetism.duffy_rules import CORNERS, ENDS, graded
from magshell_fenicsx.parts.magnetism.magnetised_cells import Nodal, Shape, unit
from magshell_fenicsx.parts.magnetism.pairs import Copies, Pairs, Points, Stiffness

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
DEGREE = 14  # of the rule on the first cell
ROWS, ALONG_ROWS = 10, 7  # of points at free edges, from there on and along them
WIDTH = 0.05  # of the thickness: how near to the edge the first rows are
PRECISION = 1e-9  # of what one of its points sees of the second
GAUSS, MOST = (
    24,
    3 * 24**2,
)  # points of the longest rule, and points that are seen at most, as in stacked_faces.c
OF_CHARGES = 5  # degree of charges on a cell
REACH = 0.25  # of the size of cells: nearer faces are close
DEPTH = (
    0.005  # of the thickness: between layers below a face, from which its charges are extrapolated
)
LEAST = 0.00125  # of the thickness: nearer to a face no layer comes
INSIDE = 0.5  # of the thickness: mid-surfaces that are nearer are in each other
EXTRAPOLATED = 3.0, -3.0, 1.0  # from three layers, as in stacked_faces.c
SAME = 1e-7  # over R: places of the middle of a side of two cells
ALONG = 0.7  # cosine of the angle of cells that lie above each other, at least
CHARGES = basix.create_element(
    basix.ElementFamily.P,
    basix.CellType.triangle,
    OF_CHARGES,
    basix.LagrangeVariant.gl_isaac,
    discontinuous=True,
)
BORDER = np.concatenate(
    [CORNERS[i] + np.arange(4)[:, None] / 4 * (CORNERS[j] - CORNERS[i]) for i, j in ENDS]
)


def monomials(X: Array, degree: int) -> Array:
    """(n, ..) at places (n, 2), in the order of stacked_faces.c."""
    return np.stack(
        [X[:, 0] ** (n - j) * X[:, 1] ** j for n in range(degree + 1) for j in range(n + 1)], axis=1
    )


def of_nodes(element: basix.finite_element.FiniteElement) -> Array:
    """(monomials, nodes) what the values at nodes of a Lagrange element multiply."""
    return np.ascontiguousarray(
        np.linalg.inv(monomials(np.asarray(element.points), element.degree))
    )


def distances(x: Array, corners: Array) -> tuple[Array, Array]:
    """The least distance (n,) of places (n, m, 3) from flat triangles (n, 3, 3), and how much of it
    is across them.
    """
    sides = corners[:, [1, 2, 0]] - corners
    normal = unit(np.asarray(np.cross(sides[:, 0], sides[:, 1]), dtype=np.float64))
    off = x[:, :, None] - corners[:, None]
    across = np.einsum("nmi,ni->nm", off[:, :, 0], normal)
    behind = np.einsum("nmki,nki->nmk", off, np.cross(normal[:, None], sides))
    square = np.sum(sides * sides, axis=-1)
    t = np.clip(np.einsum("nmki,nki->nmk", off, sides) / square[:, None], 0.0, 1.0)
    to_sides = np.linalg.norm(off - t[..., None] * sides[:, None], axis=-1).min(axis=-1)
    distance = np.where((behind >= 0).all(axis=-1), np.abs(across), to_sides)
    rows, at = np.arange(len(x)), distance.argmin(axis=1)
    return distance[rows, at], np.abs(across[rows, at])


Free = tuple[bool, bool, bool]  # of the sides of a cell


def graded_at(free: Free, s: float) -> tuple[Array, Array]:
    """A rule of the reference triangle with rows of points along its free sides, dense there on the
    scale s.
    """
    sides = [side for side, of_part in zip(ENDS, free, strict=True) if of_part]
    if not sides:
        X, w = basix.make_quadrature(basix.CellType.triangle, DEGREE)
        return np.array(X), np.array(w)
    top = CORNERS.mean(axis=0)  # of a triangle on each side
    if len(sides) == 1:
        (top,) = (CORNERS[i] for i in range(3) if i not in sides[0])
    elif len(sides) == 2:
        top = CORNERS[[i for i in range(3) if not all(i in side for side in sides)]].mean(axis=0)
    (a, wa), (b, wb) = graded(ROWS, s), gauss(ALONG_ROWS)
    points, weights = list[Array](), list[Array]()
    for i, j in sides:
        A, B = CORNERS[i], CORNERS[j]
        side = (1 - a)[:, None, None] * (A + b[:, None] * (B - A))
        points.append((side + a[:, None, None] * top).reshape(-1, 2))
        area = (B - A)[0] * (top - A)[1] - (B - A)[1] * (top - A)[0]
        weights.append(area * np.outer(wa * (1 - a), wb).ravel())
    return np.concatenate(points), np.concatenate(weights)


def free_sides(corners: Array, parts: Ints) -> list[Free]:
    """Which sides of flat triangles (n, 3, 3) no other cell of their part has."""
    from scipy.spatial import cKDTree  # takes long to import

    middles = np.stack([corners[:, [i, j]].mean(axis=1) for i, j in ENDS], axis=1).reshape(-1, 3)
    beside = cKDTree(middles).query(middles, 2, distance_upper_bound=SAME)[1][:, 1]
    of = np.append(np.repeat(parts, 3), -1)
    return [tuple(map(bool, each)) for each in (of[beside] != of[:-1]).reshape(-1, 3)]  # type: ignore[misc]


class Close:
    """Pairs of the faces of all cells that are close.

    Parameters
    ----------
    shape
        All cells that are modelled.
    parts
        (copies * cells,) that of each cell.
    order
        (copies * cells,) of two cells the first is that with the lower number.
    """

    def __init__(
        self, shape: Shape, faces: Faces, copies: Copies, parts: Ints, order: Ints, comm: MPI.Comm
    ) -> None:
        self._shape, self._faces, self._copies, self._order = shape, faces, copies, order
        self._pairs = Pairs(comm)
        free = free_sides(copies.of(shape.r0)[:, :3], parts)
        self._kinds = sorted(set(free))  # of first cells, by their free sides
        self._kind = np.array([self._kinds.index(each) for each in free])
        self._border = shape.element.tabulate(0, BORDER)[0, :, :, 0]

    def of(self, nodes: Array, own: range, apart: NDArray[np.uint8]) -> NDArray[np.bool_]:
        """(own, cells) which of the pairs that are `apart` lie above each other, close."""
        close, h = np.zeros(apart.shape, dtype=bool), self._shape.h
        middle = nodes.mean(axis=1)
        radius = np.linalg.norm(nodes - middle[:, None], axis=-1).max(axis=1)
        normal = unit(
            np.asarray(
                np.cross(nodes[:, 1] - nodes[:, 0], nodes[:, 2] - nodes[:, 0]), dtype=np.float64
            )
        )
        first, second = np.nonzero(apart)
        c = first + own.start
        size = 2 * np.maximum(radius[c], radius[second])
        ball = np.linalg.norm(middle[c] - middle[second], axis=-1) - radius[c] - radius[second]
        may = (ball < h + REACH * size) & (
            np.abs(np.sum(normal[c] * normal[second], axis=-1)) > ALONG
        )
        if not may.any():
            return close
        first, second, c, size = (each[may] for each in (first, second, c, size))
        border = np.einsum("mk,nki->nmi", self._border, nodes)
        one, other = (distances(border[a], nodes[b, :3]) for a, b in ((c, second), (second, c)))
        least, up = np.where(one[0] < other[0], one, other)
        close[first, second] = (least - h < REACH * size) & (up > INSIDE * h)
        return close

    def add(
        self,
        nodes: Array,
        own: range,
        close: NDArray[np.bool_],
        gradient: Array,
        stiffness: Stiffness | None = None,
    ) -> float:
        """The energy of pairs that own cells are in, each half; their gradient (cells, k, 3) is
        added.

        It is no number if two cells are in each other.
        """
        pairs, both = self._ordered(own, close)
        energy, kinds = 0.0, self._kind[pairs[:, 0]]
        for kind, share in product(np.unique(kinds), (0.5, 1.0)):
            of = pairs[(kinds == kind) & (both == (share == 1.0))]
            energy += share * self._pairs.add_close(
                self._cells[kind], nodes, of, gradient, stiffness
            )
        return energy

    def by_fields(
        self,
        nodes: Array,
        own: range,
        close: NDArray[np.bool_],
        moved: Complex,
        weights: Weights,
        into: Nodal,
    ) -> None:
        """Add the derivatives that `into` has, of own cells: see `Charged.by_fields`."""
        on_charges, row, basis = (
            np.zeros_like(self._charges),
            np.zeros(1, dtype=np.int64),
            of_nodes(CHARGES),
        )
        for one, other in self._ordered(own, close)[0]:
            first, first_w = self._rules[self._kind[one]]
            seen = self._pairs.seen(self._cells[self._kind[one]], nodes, one, other, MOST)
            if seen is None:
                continue
            X, w, *deep = seen
            places, flat = (first, X.reshape(-1, 2)), (len(first), w.shape[1])
            (t, q), (t_of, q_of) = (
                self._of(cell, at) for cell, at in zip((one, other), places, strict=True)
            )
            layers, of_layers, by_t = self._layered(t, *deep)
            q = first_w[:, None] * np.einsum("pls,ps->pl", of_layers, q)
            left = Points(self._tabulated(first), layers, t[None], q[None])
            q_of = w.reshape(1, *flat, 1) * q_of.reshape(1, *flat, -1)
            tables = self._tabulated(places[1]).reshape(*flat, 3, -1)
            right = Points(
                tables, np.broadcast_to(self._heights, q_of.shape[1:]), t_of.reshape(1, *flat), q_of
            )
            pair, sides = np.array([[one, other]]), ((left, row), (right, row))
            on_q = add(moved, pair, *sides, weights)
            on_heights = (
                None
                if into.by_thickness is None
                else add(moved, pair, *sides, weights, heights=True)
            )
            for i, (cell, at, weight) in enumerate(
                zip((one, other), places, (first_w, w.ravel()), strict=True)
            ):
                if cell not in own:
                    continue
                copy, number = divmod(cell, len(self._shape.r0))
                on, of_height = on_q[i].reshape(len(at), -1), self._heights if i else by_t
                on = on if i else np.einsum("pls,pl->ps", of_layers, on)
                on = self._copies.charges[copy] * weight[:, None] * on
                on_charges[number] += (monomials(at, OF_CHARGES) @ basis).T @ on
                if on_heights:
                    on_t = self._copies.up[copy] * np.sum(
                        on_heights[i].reshape(len(at), -1) * of_height, axis=-1
                    )
                    self._shape.back_of_thickness(np.array([number]), at, on_t[None], into)
        made = self._faces.at(*self._nodes_of_charges, into)
        assert made.back
        made.back(np.zeros_like(made.x), on_charges)

    def _layered(self, t: Array, inward: Array, shift: Array) -> tuple[Array, Array, Array]:
        """Of layers (n, L) their heights, what multiplies charges (n, L, S), and the heights' part
        that follows t.

        See `layered` of stacked_faces.c.
        """
        S, n = len(self._heights), np.arange(len(t))
        near = np.where(inward * t < 0, 0, 1)
        of_layers = np.broadcast_to(np.eye(S + 2, S), (len(t), S + 2, S)).copy()
        of_layers[n, near] = 0.0
        by_t, deep = (
            np.pad(np.tile(self._heights, (len(t), 1)), ((0, 0), (0, 2))),
            np.zeros((len(t), S + 2)),
        )
        for j in range(3):
            at = np.full_like(near, S - 1 + j) if j else near
            of_layers[n, at, near], by_t[n, at] = EXTRAPOLATED[j], self._heights[near]
            deep[n, at] = (j + 1) * DEPTH * self._shape.h
        return by_t + (inward / t)[:, None] * (shift[:, None] + deep), of_layers, by_t

    def _ordered(self, own: range, close: NDArray[np.bool_]) -> tuple[Ints, NDArray[np.bool_]]:
        """The pairs (n, 2), each once, and which of them are of own cells only."""
        first, second = np.nonzero(close)
        first = first + own.start
        both = (second >= own.start) & (second < own.stop)
        once = ~both | (first < second)
        pairs, both = np.column_stack([first, second])[once], both[once]
        swap = self._order[pairs[:, 0]] > self._order[pairs[:, 1]]
        pairs[swap] = pairs[swap, ::-1]
        return pairs, both

    def _tabulated(self, X: Array) -> Array:
        """(n, 3, k)"""
        return np.asarray(self._shape.element.tabulate(1, X)[..., 0].transpose(1, 0, 2))

    def _of(self, cell: int, X: Array) -> tuple[Array, Array]:
        """Thickness (n,) and charges (n, layers) per area of the reference triangle at places X (n,
        2) of a cell.
        """
        values = monomials(X, OF_CHARGES)
        return values @ self._thickness[cell], values @ self._of_copies[cell]

    @cached_property
    def _rules(self) -> list[tuple[Array, Array]]:
        """Points and weights on the first cell, of each kind."""
        sides = [
            np.linalg.norm(self._shape.r0[:, i] - self._shape.r0[:, j], axis=-1) for i, j in ENDS
        ]
        return [
            graded_at(free, WIDTH * self._shape.h / float(np.median(sides))) for free in self._kinds
        ]

    @cached_property
    def _cells(self) -> list[object]:
        """Of each kind of first cells."""
        rules = [np.column_stack(gauss(n)).ravel() for n in range(1, GAUSS + 1)]
        shared = {
            "shape": of_nodes(self._shape.element),
            "charges": self._of_copies,
            "thickness": self._thickness,
            "heights": self._heights,
            "gauss": np.concatenate(rules),
        }
        numbers = {
            "k": shared["shape"].shape[1],
            "degree": self._shape.element.degree,
            "of_charges": OF_CHARGES,
        }
        numbers |= {
            "S": len(self._heights),
            "h": self._shape.h,
            "depth": DEPTH,
            "least": LEAST,
            "inside": INSIDE,
        }
        made = list[object]()
        for X, w in self._rules:
            arrays = shared | {"T": np.ascontiguousarray(self._tabulated(X)), "X": X, "weights": w}
            made.append(self._pairs.cells(arrays, **numbers, P=len(w), precision=PRECISION))
        return made

    @cached_property
    def _heights(self) -> Array:
        return heights(self._faces)

    @cached_property
    def _charges(self) -> Array:
        """(cells, n, layers) charges per area of the reference triangle at nodes of what is
        modelled.
        """
        return self._faces.at(*self._nodes_of_charges).q

    @cached_property
    def _of_copies(self) -> Array:
        """(copies * cells, monomials, layers) charges."""
        q = of_nodes(CHARGES) @ self._charges
        return np.concatenate([factor * q for factor in self._copies.charges])

    @cached_property
    def _thickness(self) -> Array:
        """(copies * cells, monomials)"""
        cells, X = np.arange(len(self._shape.r0)), np.asarray(CHARGES.points)
        t = (
            self._shape.thickness(cells, np.broadcast_to(X, (len(cells), *X.shape)))[0]
            @ of_nodes(CHARGES).T
        )
        return np.concatenate([up * t for up in self._copies.up])

    @property
    def _nodes_of_charges(self) -> tuple[Boxes, Array, Array]:
        a, b = CHARGES.points.T
        return Boxes.whole(self._faces.count), np.column_stack([a, b / (1 - a)]), 1 / (1 - a)
