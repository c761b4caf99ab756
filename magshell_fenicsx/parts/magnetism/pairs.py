"""Sums over pairs of charged cells, in C: energy, gradient and second derivatives, `LANES` pairs at
once.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray
from scipy.sparse import bsr_array

from magshell_fenicsx.mesh.mirror import Image
from magshell_fenicsx.platform.native import load_native

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
LANES, SUMS = 8, 24  # as in pairs.c
FUNCTIONS = """
    double pairs(int64_t, int64_t, int64_t, const int64_t *, int64_t, const double *, int64_t, int64_t, const double *,
        const double *, const double *, const double *, double *, const int64_t *, int64_t, int64_t, const double *,
        const double *, const double *, const double *, double *, const int64_t *, int64_t, double *, double, double *,
        double *, const int32_t *, int64_t, const int64_t *, const int64_t *, const double *, int64_t);
    void points(int64_t, int64_t, const int64_t *, int64_t, const double *, int64_t, const double *, const double *,
        double *, double *);
    int64_t rules(int64_t, int64_t, int64_t, int64_t, const double *, const double *, const double *, const double *,
        const uint8_t *, double, double, double, double, int64_t, const double *, double, int8_t *);
    void translate(int64_t, const int64_t *, const int64_t *, const int64_t *, int64_t, const int64_t *, int64_t,
        int64_t, const double *, const double *, double *);
    typedef struct { int64_t k, degree; const double *shape; int64_t of_charges, S; const double *charges, *thickness,
        *heights; int64_t P; const double *T, *X, *weights, *gauss; double h, depth, least, inside,
        precision; } Cells;
    double close_pairs(const Cells *, int64_t, const int64_t *, const double *, double *, double, double *, double *,
        const int32_t *, int64_t, const int64_t *, const int64_t *, const double *, int64_t);
    int64_t seen_of(const Cells *, int64_t, int64_t, const double *, int64_t, int64_t *, double *, double *, double *,
        double *);
"""
INTEGERS = {np.dtype(of): f"{of}_t[]" for of in ("int64", "int32", "uint8", "int8")}
KEPT: WeakKeyDictionary[Any, dict[str, Array]] = WeakKeyDictionary()
KINDS = INTEGERS | {np.dtype(np.float64): "double[]", np.dtype(np.float32): "float[]"}


@dataclass(frozen=True)
class Copies:
    """What is modelled and its images, which make the whole; cells of all are counted one copy
    after the other.

    Attributes
    ----------
    images
        The first is what is modelled itself.
    charge
        1 if charges of mirrored images are those of what is modelled, -1 if they are opposite.
    """

    images: tuple[Image, ...] = (Image(np.eye(3), np.zeros(3), 1.0),)
    charge: float = 1.0

    @property
    def up(self) -> Array:
        """(copies,) 1, or -1 where an image turns normals over, so that its heights have the other
        sign.
        """
        return np.array([image.sign for image in self.images])

    @property
    def charges(self) -> Array:
        """(copies,) factors of the charges."""
        return np.where(self.up < 0, self.charge, 1.0)

    def of(self, nodes: Array) -> Array:
        """The nodes (copies * cells, k, 3) of all."""
        return np.concatenate([image.apply(nodes) for image in self.images])


ALL = Copies()  # of a shell that is modelled whole


@dataclass(frozen=True)
class Points:
    """Charged points on elements of one kind.

    Attributes
    ----------
    tables
        (P, 3, k) shape functions and their derivatives by the reference coordinates, or (P, M, 3,
        k): M points for each of the P of another element.
    heights
        (.., L) of layers over the thickness.
    t
        (rows, ..) the thickness over R.
    q
        (rows, .., L) charges over Br R².
    """

    tables: Array
    heights: Array
    t: Array
    q: Array

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, np.ascontiguousarray(value))

    @cached_property
    def sums(self) -> Array:
        """(rows, P, SUMS) derivatives at points that stay on their elements; zero between
        evaluations.
        """
        return np.zeros((*self.t.shape, SUMS))


class Stiffness:
    """Second derivatives, added to blocks of a matrix; those by the nodes of one cell are first
    summed for each cell.

    Parameters
    ----------
    beside
        (local nodes, all nodes) which blocks there are.
    factor
        Of all second derivatives.
    row_of, column_of
        (cells, k) numbers of nodes; rows of other ranks and of images are -1, columns of images
        follow all others.
    turn
        (copies, 3, 3) the change of a copy's nodes by that of the modelled ones.

    Attributes
    ----------
    blocks
        (n, 3, 3) row by row, added to; then those of images.
    """

    def __init__(
        self, beside: NDArray[np.bool_], factor: float, row_of: Ints, column_of: Ints, turn: Array
    ) -> None:
        self.factor, self.row_of, self.column_of = factor, row_of, column_of
        number = np.where(
            beside, np.cumsum(beside, dtype=np.int32).reshape(beside.shape) - 1, -1
        ).astype(np.int32)
        self._count = int(np.count_nonzero(beside))
        self.columns = np.nonzero(beside)[1].astype(np.int32)
        self.starts = np.concatenate([[0], np.cumsum(np.count_nonzero(beside, axis=1))]).astype(
            np.int32
        )
        self.shape = 3 * beside.shape[0], 3 * beside.shape[1]
        of_images = [number + self._count] if len(turn) > 1 else []
        self.where = np.concatenate([number, *of_images], axis=1)
        self.blocks = np.zeros((self._count * (1 + len(of_images)), 3, 3))
        self.turn = np.ascontiguousarray(turn)
        cells, k = row_of.shape
        self.onto = np.zeros((cells, k * (k + 1) // 2, 3, 3))

    def finish(self) -> None:
        """Add the second derivatives by the nodes of one cell."""
        k = self.row_of.shape[1]
        a, b = np.triu_indices(k)
        block = np.zeros((k, k, 3, 3))
        for cell in np.flatnonzero(self.row_of[:, 0] >= 0):
            onto = self.factor * self.onto[cell]
            block[b, a], block[a, b] = onto.transpose(0, 2, 1), onto
            self.blocks[self.where[self.row_of[cell][:, None], self.column_of[cell]]] += block

    def matrix(self, sign: float) -> bsr_array:
        """(3 local nodes, 3 all nodes), with the columns of images times the sign."""
        of_itself, of_images = self.blocks[: self._count], self.blocks[self._count :]
        return bsr_array(
            (
                of_itself + sign * of_images if len(of_images) else of_itself,
                self.columns,
                self.starts,
            ),
            self.shape,
        )


class Pairs:
    """The sums over pairs of cells with nodes (cells, k, 3)."""

    def __init__(self, comm: MPI.Comm) -> None:
        source, *behind = (
            Path(__file__).with_name(name) for name in ("pairs.c", "multipole_expansion.c", "stacked_faces.c")
        )
        self._ffi, self._lib = load_native(source, FUNCTIONS, comm, *behind)

    def add(
        self,
        nodes: Array,
        cells: Ints,
        counted: int,
        left: tuple["Points", Ints],
        right: tuple["Points", Ints],
        gradient: Array,
        stiffness: Stiffness | None = None,
    ) -> float:
        """The energy of the first `counted` pairs (n, 2) of cells; gradient (cells, k, 3) and
        stiffness get all pairs.

        What they add at points that stay on their elements is in the sums of these: see `finish`.

        Parameters
        ----------
        left, right
            Points on each pair's first and second cell, and their rows (n,).
        """
        if not len(cells):
            return 0.0
        idle = -len(cells) % LANES
        both, left_rows, right_rows = (_filled(rows, idle) for rows in (cells, left[1], right[1]))
        same = right[0].tables.ndim == 3
        (P, L), (M, S), p = left[0].q.shape[1:], right[0].q.shape[-2:], self._pointer
        on_left, on_right = (
            [p(of.tables), p(of.heights), p(of.t), p(of.q)] for of in (left[0], right[0])
        )
        sizes = [len(both), counted, idle, p(both), nodes.shape[1], p(nodes)]
        sums = p(right[0].sums) if same else self._ffi.NULL
        points = [
            P,
            L,
            *on_left,
            p(left[0].sums),
            p(left_rows),
            M,
            S,
            *on_right,
            sums,
            p(right_rows),
            int(same),
        ]
        return float(self._lib.pairs(*sizes, *points, p(gradient), *self._matrix(nodes, stiffness)))

    def _matrix(self, nodes: Array, stiffness: Stiffness | None) -> list[Any]:
        if not stiffness:
            return [0.0, *3 * [self._ffi.NULL], 0, *3 * [self._ffi.NULL], 1]
        p, where = self._pointer, stiffness.where
        onto, blocks = p(stiffness.onto), p(stiffness.blocks)
        nodes_of = p(stiffness.row_of), p(stiffness.column_of)
        turn, modelled = p(stiffness.turn), len(nodes) // len(stiffness.turn)
        return [stiffness.factor, onto, blocks, p(where), where.shape[1], *nodes_of, turn, modelled]

    def cells(self, arrays: dict[str, Array], **numbers: float) -> Any:
        """What `add_close` and `seen` have of all pairs: see `Cells` in stacked_faces.c."""
        made = self._ffi.new(
            "Cells *", numbers | {name: self._pointer(array) for name, array in arrays.items()}
        )
        KEPT[made] = arrays  # as long as what points at them
        return made

    def add_close(
        self,
        of: Any,
        nodes: Array,
        cells: Ints,
        gradient: Array,
        stiffness: Stiffness | None = None,
    ) -> float:
        """The energy of pairs (n, 2) of cells that are close, as `add`; no number if two are in
        each other.
        """
        p, pairs = self._pointer, np.ascontiguousarray(cells)
        matrix = self._matrix(nodes, stiffness)
        return (
            float(self._lib.close_pairs(of, len(pairs), p(pairs), p(nodes), p(gradient), *matrix))
            if len(cells)
            else 0.0
        )

    def seen(
        self, of: Any, nodes: Array, one: int, other: int, most: int
    ) -> tuple[Array, Array, Array, Array] | None:
        """What P points of a cell see of another: places (P, M, 2), weights (P, M), `inward` and
        `shift` (P,).

        None if both are in each other.
        """
        p, count, (inward, shift) = (
            self._pointer,
            np.zeros(of.P, dtype=np.int64),
            np.zeros((2, of.P)),
        )
        X, w = np.full((of.P, most, 2), 1 / 3), np.zeros((of.P, most))
        if self._lib.seen_of(
            of, one, other, p(nodes), most, p(count), p(X), p(w), p(inward), p(shift)
        ):
            return None
        longest = count.max()
        return X[:, :longest], w[:, :longest], inward, shift

    def finish(
        self,
        nodes: Array,
        cells: Ints,
        points: "Points",
        gradient: Array,
        stiffness: Stiffness | None = None,
    ) -> None:
        """Add the sums at points of elements in cells (rows,) to gradient and stiffness, and make
        them zero.
        """
        idle, p = -len(cells) % LANES, self._pointer
        filled, (P, *_) = _filled(cells, idle), points.tables.shape
        onto = p(stiffness.onto) if stiffness else self._ffi.NULL
        sizes = [len(filled), idle, p(filled), nodes.shape[1], p(nodes), P]
        self._lib.points(*sizes, p(points.tables), p(points.sums), p(gradient), onto)
        points.sums[:] = 0.0

    def rules(
        self,
        nodes: Array,
        own: range,
        apart: NDArray[np.uint8],
        least: Array,
        *,
        h: float,
        space: float,
        above: float,
        flat: float,
        worst: float,
    ) -> NDArray[np.int8] | None:
        """(own, cells) the number of the rule of each pair, -1 without one; None if two cells are
        too near each other.

        Parameters
        ----------
        apart
            (own, cells) 1 for the pairs that have a rule.
        least
            (rules,) the distance over the size of cells from which each rule is precise.
        h
            Of the shell, over R: nearer cells are too near.
        space
            Least distance over size that is counted.
        above
            Part of a cell's radius: what is so near to its middle is above or below the cell.
        flat
            Sine of the angle up to which a cell is beside another, not above it.
        worst
            As `least`, of the rule beyond the last: cells below it are too near.
        """
        centre = nodes.mean(axis=1)
        normal = np.cross(nodes[:, 1] - nodes[:, 0], nodes[:, 2] - nodes[:, 0])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        radius = np.linalg.norm(nodes - centre[:, None], axis=-1).max(axis=1)
        p, chosen = self._pointer, np.empty((len(own), len(nodes)), dtype=np.int8)
        sizes = [len(nodes), own.start, own.stop, nodes.shape[1]]
        arrays = [p(array) for array in (nodes, centre, normal, radius, apart)]
        too_near = self._lib.rules(
            *sizes, *arrays, h, space, above, flat, len(least), p(least), worst, p(chosen)
        )
        return None if too_near else chosen

    def translate(
        self, one: Ints, other: Ints, which: Ints, ends: Ints, G: Array, M: Array, L: Array
    ) -> None:
        """Add G number `which` times M of boxes `other` to L (boxes, .., n) of boxes `one`.

        Parameters
        ----------
        ends
            How many of each row of G are not zero.
        G
            (.., sum of ends) these, of the rows of each.
        """
        p, arrays = self._pointer, [np.ascontiguousarray(each) for each in (G, M)]
        if len(one):
            numbers = [p(each) for each in (one, other, which)]
            self._lib.translate(
                len(one),
                *numbers,
                M.shape[1],
                p(ends),
                G.shape[1],
                M.shape[2],
                *(p(each) for each in arrays),
                p(L),
            )

    def _pointer(self, array: NDArray[Any]) -> Any:
        assert array.flags.c_contiguous
        return self._ffi.from_buffer(KINDS[array.dtype], array)


def _filled(rows: Ints, idle: int) -> Ints:
    """The rows, and the last one `idle` times more."""
    return np.concatenate([rows, rows[-1:].repeat(idle, 0)])
