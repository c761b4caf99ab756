"""The energy of magnetised parts in each other's field: pairs of charges, their forces and their stiffness.

The charges of `charges` stay with the material, so the energy of parts A and B is, over Br² R³/(4 pi mu_0),

    W = sum of q_i q_j/|x_i - x_j|, i in A, j in B,    x = r + zeta n,

and that of a part in its own field half of this, with both in A: functions of the displacement by the places alone.
Forces and stiffness are their derivatives, exact for the rule. Each pair of cells has a Gauss rule whose error is below
`PRECISION` at their distance (`degree`), the same for both; for those that touch see `near`.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import log
from pathlib import Path
from typing import Any

import basix
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.charged import Shape
from magshell_fenicsx.parts.magnetism.charges import Boxes, Faces, Sides, gauss, heights
from magshell_fenicsx.parts.magnetism.near import NOTHING, Near
from magshell_fenicsx.platform.native import native

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
DEGREES = (3, 5, 7, 10, 14, 20, 30)  # of the rules on triangles that there are
PRECISION = 1e-5  # of a pair of cells at their distance
BEYOND = 50  # degree of a rule for which cells are too wide: there is no number with that of 30
MOST = 4_000_000  # pairs of charges with second derivatives at once
ABOVE = 0.5  # of the radius of a cell: what is so near to its middle is above or below it
SPACE = 1e-3  # of cells that touch, over their size
FUNCTIONS = """
    double coulomb(int64_t, const double *, const double *, int64_t, const double *, const double *, double *,
        double *, double *);
"""


def degree(distance: Array, size: Array) -> NDArray[np.int8]:
    """The number in `DEGREES` of the rule for cells of a size at a distance.

    The error of Gauss's rule of degree n falls as rho^-(n + 1), with the sum of half axes rho of the largest ellipse
    around the cell in which the integrand has no pole (Trefethen, Approximation Theory, theorem 19.3).

    Raises
    ------
    Touching
        If cells are too wide for their distance.
    """
    z = 2 * np.maximum(distance / size, SPACE)
    needed = log(1 / PRECISION) / np.log(z + np.sqrt(1 + z**2)) - 1
    if needed.max(initial=0.0) > BEYOND:
        raise Touching
    return np.asarray(np.minimum(np.searchsorted(DEGREES, needed), len(DEGREES) - 1), dtype=np.int8)


class Touching(ValueError):
    """Two parts are in each other, or nearer than a seventh of the size of their cells."""


@dataclass(frozen=True)
class Rule:
    """Places on elements of a kind, layers through the thickness, and the charges there.

    Attributes
    ----------
    tables
        (3, P, k) shape functions and their derivatives by the reference coordinates.
    heights
        (L,) over the thickness.
    t
        (n, P) the thickness over R.
    q
        (n, P L) charges over Br R².
    """

    tables: Array
    heights: Array
    t: Array
    q: Array


class Kind:
    """The faces of all cells, or their edges with one local number that are charged."""

    def __init__(self, shape: Shape, cells: Ints, edge: int | None = None) -> None:
        self.cells, self._edge, self._shape = cells, edge, shape
        self.family = Faces(shape, cells) if edge is None else Sides(shape, cells, np.full(len(cells), edge))
        self.number = np.full(len(shape.r0), -1)
        self.number[cells] = np.arange(len(cells))
        self._rules: dict[int, Rule] = {}

    def rule(self, which: int) -> Rule:
        """That with a number in `DEGREES`."""
        if which not in self._rules:
            self._rules[which] = self._face(which) if self._edge is None else self._side(which)
        return self._rules[which]

    def charged(self, which: int) -> float:
        return float(np.abs(self.rule(which).q).max(initial=0.0))

    def _face(self, which: int) -> Rule:
        X, w = basix.make_quadrature(basix.CellType.triangle, DEGREES[which])
        ab = np.stack([X[:, 0], X[:, 1] / (1 - X[:, 0])], axis=-1)
        q = self.family.at(Boxes.whole(self.family.count), ab, np.array(w / (1 - X[:, 0]), dtype=np.float64)).q
        assert isinstance(self.family, Faces)
        return self._made(X, heights(self.family), q.reshape(len(q), -1))

    def _side(self, which: int) -> Rule:
        s, ws = gauss((DEGREES[which] + 2) // 2)
        eta, we = gauss(2 + which)
        points = np.stack(np.meshgrid(s, eta, indexing="ij"), axis=-1).reshape(-1, 2)
        q = self.family.at(
            Boxes.whole(self.family.count), points, np.asarray(np.outer(ws, we).ravel(), dtype=np.float64)
        ).q[..., 0]
        X = [np.stack([1 - s, s], -1), np.stack([0 * s, 1 - s], -1), np.stack([s, 0 * s], -1)][self._edge or 0]
        return self._made(X, eta - 0.5, q)

    def _made(self, X: Array, eta: Array, q: Array) -> Rule:
        T = self._shape.element.tabulate(1, X)[..., 0]
        t = self._shape.thickness(self.cells, np.broadcast_to(X, (len(self.cells), *X.shape)))[0]
        return Rule(np.ascontiguousarray(T), np.asarray(eta), t, q)


@dataclass(frozen=True)
class Placed:
    """Charges of some elements where they are.

    Attributes
    ----------
    number
        (cells,) where a cell's element stands below; -1 without one.
    x, q
        (n, P L, 3) and (n, P L).
    r, n, up
        The rule, the normals (n, P, 3), and the dual basis (2, n, P, 3) of the mid-surface.
    t
        (n, P).
    """

    rule: Rule
    number: NDArray[np.intp]
    x: Array
    q: Array
    n: Array
    up: Array
    t: Array

    @classmethod
    def of(cls, kind: Kind, which: int, nodes: Array, used: NDArray[np.bool_]) -> "Placed":
        """Of the elements in the cells that are used; `nodes` (cells, k, 3) are the deformed ones."""
        rule, some = kind.rule(which), used[kind.cells]
        r, r1, r2 = np.einsum("dpk,nki->dnpi", rule.tables, nodes[kind.cells[some]], optimize=True)
        m = np.cross(r1, r2)
        size = np.linalg.norm(m, axis=-1, keepdims=True)
        n = m / size
        up = np.stack([np.cross(r2, n), np.cross(n, r1)]) / size
        t = rule.t[some]
        x = r[:, :, None] + (t[..., None] * rule.heights)[..., None] * n[:, :, None]
        number = np.full(len(kind.number), -1)
        number[kind.cells[some]] = np.arange(int(some.sum()))
        return cls(rule, number, np.ascontiguousarray(x.reshape(len(x), rule.q.shape[1], 3)), rule.q[some], n, up, t)

    @cached_property
    def levers(self) -> Array:
        """(n, 3 P L, 3 k) the places by the nodes: dx = N du - zeta n . du,a a^a."""
        T, count = self.rule.tables, len(self.x)
        turned = -np.einsum("apk,anpi,npj->npikj", T[1:], self.up, self.n)
        B = np.einsum("l,np,npikj->nplikj", self.rule.heights, self.t, turned)
        for i in range(3):
            B[..., i, :, i] += T[0][:, None]
        return np.ascontiguousarray(B.reshape(count, -1, 3 * T.shape[2]))

    def along(self, at: int, g: Array) -> Array:
        """(k, 3) the derivative by one element's nodes, from that by its charges' places g (P L, 3)."""
        T, n, up = self.rule.tables, self.n[at], self.up[:, at]
        each = g.reshape(len(n), -1, 3)
        W = self.t[at][:, None] * np.einsum("l,pli->pi", self.rule.heights, each)
        found = T[0].T @ each.sum(axis=1)
        for shapes, a in zip(T[1:], up, strict=True):
            found -= shapes.T @ (np.sum(W * a, axis=-1, keepdims=True) * n)
        return np.asarray(found)

    def bent(self, at: int, g: Array) -> Array:
        """(3 k, 3 k) what forces g (P L, 3) on one element's charges add to the stiffness, as its normals turn."""
        T, n, up = self.rule.tables, self.n[at], self.up[:, at]
        w = np.einsum("p,l,pli->pi", self.t[at], self.rule.heights, g.reshape(len(n), -1, 3))
        on, along = np.einsum("pi,pi->p", w, n), np.einsum("pi,api->ap", w, up)
        metric = np.einsum("api,bpi->abp", up, up)
        G = np.einsum("bp,pi,apj->apibj", along, n, up) + np.einsum("ap,bpi,pj->apibj", along, up, n)
        G -= np.einsum("abp,p,pi,pj->apibj", metric, on, n, n)
        k = T.shape[2]
        return np.asarray(np.einsum("apk,apibj,bpl->kilj", T[1:], G, T[1:], optimize=True).reshape(3 * k, 3 * k))


Sink = Callable[[int, Array], None]


class Charged:
    """All charges of a shell, of which those of different parts act on each other, or all.

    Parameters
    ----------
    shape
        All cells.
    parts
        (cells,) the number of each one's part.
    cells, edges
        Edges that may be charged, by cell and local number.
    near
        The pairs of cells that touch, where each part acts on itself too; None where it does not.
    """

    def __init__(
        self, shape: Shape, parts: Ints, cells: Ints, edges: Ints, comm: MPI.Comm, near: Near | None = None
    ) -> None:
        self._ffi, self._lib = native(Path(__file__).with_name("coulomb.c"), FUNCTIONS, comm)
        self._parts, self._h, self._near = parts, shape.h, near
        kinds = [Kind(shape, np.arange(len(shape.r0)))]
        kinds += [Kind(shape, cells[edges == edge], edge) for edge in range(3) if (edges == edge).any()]
        sizes = [kind.charged(0) for kind in kinds]
        self._kinds = [kind for kind, size in zip(kinds, sizes, strict=True) if size > NOTHING * max(sizes)]

    def rules(self, nodes: Array, own: range) -> NDArray[np.int8]:
        """(own, cells) the number in `DEGREES` of the rule of each pair of cells; -1 of those that have none here.

        Raises
        ------
        Touching
            If two parts are closer than their thickness.
        """
        centre = nodes.mean(axis=1)
        normal = np.cross(nodes[:, 1] - nodes[:, 0], nodes[:, 2] - nodes[:, 0])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        radius = np.linalg.norm(nodes - centre[:, None], axis=-1).max(axis=1)
        found = np.full((len(own), len(nodes)), -1, dtype=np.int8)
        for row, cell in enumerate(own):
            apart = self._parts != self._parts[cell]
            if self._near:
                apart[:] = True
                apart[self._near.touching[cell]] = False
            others = np.flatnonzero(apart)
            size = 2 * np.maximum(radius[others], radius[cell])
            gap = np.linalg.norm(centre[others] - centre[cell], axis=-1) - radius[others] - radius[cell] - self._h
            close = gap < size
            if close.any():
                away = nodes[others[close]][:, :, None] - nodes[cell][None, None]
                between = np.sqrt((away**2).sum(axis=-1).min(axis=(1, 2)))
                d = nodes[others[close]] - centre[cell]
                across = d @ normal[cell]
                beside = np.linalg.norm(d - across[..., None] * normal[cell], axis=-1)
                if ((np.abs(across) < self._h) & (beside < ABOVE * radius[cell])).any():
                    raise Touching
                gap[close] = np.maximum(gap[close], np.maximum(between - self._h, between / 2))
            found[row, others] = degree(gap, size)
        return found

    def evaluate(self, nodes: Array, own: range, sink: Sink | None = None) -> tuple[float, Array]:
        """The energy of the pairs that own cells are in, each half, and its gradient (own, k, 3) by their nodes.

        Parameters
        ----------
        nodes
            (cells, k, 3) the deformed ones.
        sink
            Gets the second derivatives (3 k, cells, 3 k) by the nodes of each own cell and those of all cells, without
            those of cells that touch.

        Raises
        ------
        Touching
            See `rules`.
        """
        rules, energy = self.rules(nodes, own), 0.0
        gradient = np.zeros((len(own), *nodes.shape[1:]))
        placed = dict[int, list[Placed]]()
        for which in np.unique(rules[rules >= 0]):
            used = (rules == which).any(axis=0)
            used[own.start : own.stop] |= (rules == which).any(axis=1)
            placed[int(which)] = [Placed.of(kind, int(which), nodes, used) for kind in self._kinds]
        width = 3 * nodes.shape[1]
        for row, cell in enumerate(own):
            stiffness = np.zeros((width, len(nodes), width)) if sink else None
            for which, kinds in placed.items():
                others = np.flatnonzero(rules[row] == which)
                for of in kinds if len(others) else ():
                    if of.number[cell] >= 0:
                        value, slope = self._seen(of, cell, kinds, others, stiffness)
                        energy += value / 2
                        gradient[row] += slope
            if sink and stiffness is not None:
                sink(row, stiffness)
        if self._near:
            slope = np.zeros_like(nodes)
            energy += self._near.add(nodes, slope)
            gradient += slope[own.start : own.stop]
        return energy, gradient

    def _seen(
        self, of: Placed, cell: int, kinds: Sequence[Placed], others: Ints, stiffness: Array | None
    ) -> tuple[float, Array]:
        """The energy of an element of a cell among others, and its gradient (k, 3); its stiffness is added."""
        at = int(of.number[cell])
        x, q, energy = of.x[at], np.ascontiguousarray(of.q[at]), 0.0
        g, H = np.zeros_like(x), np.zeros((len(x), 3, 3))
        B = of.levers[at] if stiffness is not None else None
        for source in kinds:
            cells = others[source.number[others] >= 0]
            each = max(1, MOST // (len(x) * source.x.shape[1]))
            for first in range(0, len(cells), each):
                some = cells[first : first + each]
                there = source.number[some]
                y, p = source.x[there].reshape(-1, 3), source.q[there].ravel()
                K = np.empty((3 * len(x), 3 * len(y))) if stiffness is not None else None
                energy += self._sum(x, q, y, p, g, H, K)
                if stiffness is not None and K is not None and B is not None:
                    left = (B.T @ K).reshape(len(B.T), len(some), -1).transpose(1, 0, 2)
                    stiffness[:, some] += np.matmul(left, source.levers[there]).transpose(1, 0, 2)
        if stiffness is not None and B is not None:
            each_B = B.reshape(len(x), 3, -1)
            own = np.einsum("mia,mib->ab", each_B, np.matmul(H, each_B))
            stiffness[:, cell] += own + of.bent(at, g)
        return energy, of.along(at, g)

    def _sum(self, x: Array, q: Array, y: Array, p: Array, g: Array, H: Array, K: Array | None) -> float:
        def pointer(array: Array | None) -> Any:
            return self._ffi.NULL if array is None else self._ffi.from_buffer("double[]", array)

        return float(self._lib.coulomb(len(x), *map(pointer, (x, q)), len(y), *map(pointer, (y, p, g, H, K))))
