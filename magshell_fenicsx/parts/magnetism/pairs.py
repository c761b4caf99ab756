"""Sums over pairs of charged cells in C: energy, gradient and second derivatives, `LANES` pairs at once."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Image
from magshell_fenicsx.platform.native import native

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
LANES, SUMS = 8, 24  # as in pairs.c
FUNCTIONS = """
    double pairs(int64_t, int64_t, int64_t, const int64_t *, int64_t, const double *, int64_t, int64_t, const double *,
        const double *, const double *, const double *, double *, const int64_t *, int64_t, int64_t, const double *,
        const double *, const double *, const double *, double *, const int64_t *, int64_t, double *, double, double *,
        double *, int64_t, const int64_t *, const int64_t *, const double *, int64_t);
    void points(int64_t, int64_t, const int64_t *, int64_t, const double *, int64_t, const double *, const double *,
        double *, double *);
    int64_t rules(int64_t, int64_t, int64_t, int64_t, const double *, const double *, const double *, const double *,
        const uint8_t *, double, double, double, int64_t, const double *, double, int8_t *);
"""
KINDS = {"float64": "double[]", "int64": "int64_t[]", "uint8": "uint8_t[]", "int8": "int8_t[]"}


@dataclass(frozen=True)
class Copies:
    """What is modelled and its images, which make the whole; cells of all are counted one copy after the other.

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
        """(copies,) the side of the mid-surface, as cross products of a copy see it, on which height is positive."""
        return np.array([image.sign for image in self.images])

    @property
    def charges(self) -> Array:
        """(copies,) factors of the charges."""
        return np.where(self.up < 0, self.charge, 1.0)

    def of(self, nodes: Array) -> Array:
        """The nodes (copies cells, k, 3) of all."""
        return np.concatenate([image.of(nodes) for image in self.images])


ALL = Copies()  # of a shell that is modelled whole


@dataclass(frozen=True)
class Points:
    """Charged points on elements of one kind.

    Attributes
    ----------
    tables
        (P, 3, k) shape functions and their derivatives by the reference coordinates, or (P, M, 3, k): M points for each
        of the P of another element.
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
        """(rows, P, SUMS) derivatives at points that stay on their elements; zero between evaluations."""
        return np.zeros((*self.t.shape, SUMS))


class Stiffness:
    """Second derivatives: those by the nodes of one cell, summed, and rows of a matrix.

    Parameters
    ----------
    rows
        (local nodes, 3, all nodes, 3), added to.
    factor
        What they are multiplied by.
    row_of, column_of
        (cells, k) numbers of nodes; rows of other ranks and of images are -1.
    turn
        (copies, 3, 3) what takes a change of the modelled nodes to that of the copy's.
    """

    def __init__(self, rows: Array, factor: float, row_of: Ints, column_of: Ints, turn: Array) -> None:
        self.rows, self.factor, self.row_of, self.column_of = rows, factor, row_of, column_of
        self.turn = np.ascontiguousarray(turn)
        cells, k = row_of.shape
        self.onto = np.zeros((cells, k * (k + 1) // 2, 3, 3))

    def finish(self) -> None:
        """Add what each cell has with itself."""
        k = self.row_of.shape[1]
        a, b = np.triu_indices(k)
        own = np.flatnonzero(self.row_of[:, 0] >= 0)
        block = np.zeros((k, k, 3, 3))
        for cell in own:
            onto = self.factor * self.onto[cell]
            block[b, a], block[a, b] = onto.transpose(0, 2, 1), onto
            at = self.row_of[cell][:, None], slice(None), self.column_of[cell][None], slice(None)
            self.rows[at] += block


class Pairs:
    """The sums over pairs of cells with nodes (cells, k, 3)."""

    def __init__(self, comm: MPI.Comm) -> None:
        self._ffi, self._lib = native(Path(__file__).with_name("pairs.c"), FUNCTIONS, comm)

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
        """The energy of the first pairs of cells (n, 2); the gradient (cells, k, 3) and the stiffness of all are added.

        What they add at points that stay on their elements is in the sums of these: see `finish`.

        Parameters
        ----------
        left, right
            Points on each pair's first and second cell, and their rows (n,).
        """
        if not len(cells):
            return 0.0
        idle = -len(cells) % LANES
        both, first, second = (_filled(each, idle) for each in (cells, left[1], right[1]))
        same = right[0].tables.ndim == 3
        (P, L), (M, S), p = left[0].q.shape[1:], right[0].q.shape[-2:], self._pointer
        into = [self._ffi.NULL, self._ffi.NULL, 0, self._ffi.NULL, self._ffi.NULL, self._ffi.NULL, 1]
        if stiffness:
            onto, rows, width = stiffness.onto, stiffness.rows, stiffness.rows.shape[2]
            turn, modelled = stiffness.turn, len(nodes) // len(stiffness.turn)
            into = [p(onto), p(rows), width, p(stiffness.row_of), p(stiffness.column_of), p(turn), modelled]
        one, other = ([p(each.tables), p(each.heights), p(each.t), p(each.q)] for each in (left[0], right[0]))
        sizes = [len(both), counted, idle, p(both), nodes.shape[1], p(nodes)]
        factor = stiffness.factor if stiffness else 0.0
        sums = p(right[0].sums) if same else self._ffi.NULL
        seen = [P, L, *one, p(left[0].sums), p(first), M, S, *other, sums, p(second), int(same), p(gradient), factor]
        return float(self._lib.pairs(*sizes, *seen, *into))

    def finish(
        self, nodes: Array, cells: Ints, of: "Points", gradient: Array, stiffness: Stiffness | None = None
    ) -> None:
        """Add the sums at points on elements in cells (rows,), which are zero again."""
        idle, p = -len(cells) % LANES, self._pointer
        every = _filled(cells, idle)
        onto = p(stiffness.onto) if stiffness else self._ffi.NULL
        given = [len(every), idle, p(every), nodes.shape[1], p(nodes), of.tables.shape[0], p(of.tables), p(of.sums)]
        self._lib.points(*given, p(gradient), onto)
        of.sums[:] = 0.0

    def rules(self, nodes: Array, own: range, apart: NDArray[np.uint8], least: Array, *numbers: float) -> Any:
        """See pairs.c; None if two cells are too near each other."""
        centre = nodes.mean(axis=1)
        normal = np.cross(nodes[:, 1] - nodes[:, 0], nodes[:, 2] - nodes[:, 0])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        radius = np.linalg.norm(nodes - centre[:, None], axis=-1).max(axis=1)
        (h, space, above, worst), p = numbers, self._pointer
        found = np.empty((len(own), len(nodes)), dtype=np.int8)
        given = [p(each) for each in (nodes, centre, normal, radius, apart)]
        failed = self._lib.rules(
            len(nodes),
            own.start,
            own.stop,
            nodes.shape[1],
            *given,
            h,
            space,
            above,
            len(least),
            p(least),
            worst,
            p(found),
        )
        return None if failed else found

    def _pointer(self, array: NDArray[Any]) -> Any:
        assert array.flags.c_contiguous
        return self._ffi.from_buffer(KINDS[array.dtype.name], array)


def _filled(each: Ints, idle: int) -> Ints:
    """Rows with some more of the last one."""
    return np.concatenate([each, each[-1:].repeat(idle, 0)])
