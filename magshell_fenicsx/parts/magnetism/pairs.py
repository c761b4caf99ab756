"""Sums over pairs of charged cells, in C: energy, gradient and second derivatives.

The C functions are in pairs.c, pair_rules.c and stacked_faces.c, which are compiled together and
work at `LANES` pairs at once. Lengths are over R, charges over Br R², energies over
Br² R³/(4 pi mu_0).

Charges are at points of elements, in layers through the thickness: a charge of height eta is at
r + eta t n, with the mid-surface place r, its normal n and the thickness t. So derivatives by a
cell's k nodes come from those by r and n. They are summed at points first (`Points.sums`), then at
nodes (`Pairs.finish`). Copies are the modelled cells and their images, which make the whole shell;
cells of all copies are numbered copy by copy. A rule is a set of quadrature points; distant cells
have rules with few points. Stacked cells are those of `stacked_faces`. Functions in C take pointers
to contiguous arrays.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Image
from magshell_fenicsx.platform.native import load_native

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
LANES, SUMS = 8, 24  # pairs at once, numbers at a point; as in pairs.c
FUNCTIONS = """
    double pairs(int64_t, int64_t, int64_t, const int64_t *, int64_t, const double *, int64_t,
        int64_t, const double *, const double *, const double *, const double *, double *,
        const int64_t *, int64_t, int64_t, const double *, const double *, const double *,
        const double *, double *, const int64_t *, int64_t, double *, double, double *, double *,
        const int32_t *, int64_t, const int64_t *, const int64_t *, const double *, int64_t);
    void points(int64_t, int64_t, const int64_t *, int64_t, const double *, int64_t, const double *,
        const double *, double *, double *);
    int64_t rules(int64_t, int64_t, int64_t, int64_t, const double *, const double *,
        const double *, const double *, const uint8_t *, double, double, double, double, int64_t,
        const double *, double, int8_t *);
    typedef struct { int64_t k, degree; const double *shape; int64_t of_charges, S;
        const double *charges, *thickness, *heights; int64_t P; const double *T, *X, *weights,
        *gauss; double h, depth, least, inside, precision; } Cells;
    double close_pairs(const Cells *, int64_t, const int64_t *, const double *, double *, double,
        double *, double *, const int32_t *, int64_t, const int64_t *, const int64_t *,
        const double *, int64_t);
    int64_t seen_of(const Cells *, int64_t, int64_t, const double *, int64_t, int64_t *, double *,
        double *, double *, double *);
"""
C_TYPES = {np.dtype(name): f"{name}_t[]" for name in ("int64", "int32", "uint8", "int8")}
C_TYPES[np.dtype(np.float64)] = "double[]"
# arrays to which a struct in C points, for as long as it is used
ARRAYS_OF_STRUCTS: WeakKeyDictionary[Any, dict[str, Array]] = WeakKeyDictionary()


@dataclass(frozen=True)
class Copies:
    """The modelled cells and their images, which make the whole shell.

    Cells of all copies are counted one copy after the other.

    Attributes
    ----------
    images
        Images under mirrors and rotations; the first is the modelled part itself. An image has a
        `sign`, 1 or -1, which is negative if it is mirrored.
    charge_sign
        1 if charges of mirrored images equal the modelled ones, -1 if they are opposite.
    """

    images: tuple[Image, ...] = (Image(np.eye(3), np.zeros(3), 1.0),)
    charge_sign: float = 1.0

    @property
    def normal_signs(self) -> Array:
        """(copies,) 1, or -1 where an image turns normals over, and with them the heights."""
        return np.array([image.sign for image in self.images])

    @property
    def charge_factors(self) -> Array:
        """(copies,) factors of the modelled charges."""
        return np.where(self.normal_signs < 0, self.charge_sign, 1.0)

    def nodes_of_all(self, nodes: Array) -> Array:
        """Return nodes (copies * cells, k, 3) of all copies, from modelled ones (cells, k, 3)."""
        return np.concatenate([image.apply(nodes) for image in self.images])


NO_IMAGES = Copies()  # the copies of a shell that is modelled whole


@dataclass(frozen=True)
class Points:
    """Charged points on elements of one kind.

    P points of an element have L layers of charges each, through the thickness.

    Attributes
    ----------
    tables
        (P, 3, k) shape functions and their derivatives by the reference coordinates. Points that
        depend on P points of another element have (P, M, 3, k).
    heights
        (.., L) heights of layers over the thickness.
    t
        (rows, ..) thickness over R.
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
        """(rows, P, SUMS) derivatives by places and normals of points; zero between evaluations."""
        return np.zeros((*self.t.shape, SUMS))


class Stiffness:
    """Blocks (3, 3) of a matrix between all nodes, to which second derivatives are added.

    Second derivatives by two nodes of one cell are first summed for each cell, in `onto`; the
    method `finish` adds these sums to the blocks.

    Parameters
    ----------
    shape
        Numbers of local nodes and of all nodes.
    factor
        Factor of all second derivatives.
    row_of, column_of
        (cells, k) numbers of nodes; rows of other ranks and of images are -1, columns of images
        follow all others.
    turn
        (copies, 3, 3) the change of a copy's nodes from a change of the modelled nodes.

    Attributes
    ----------
    blocks
        (1 or 2, local nodes, all nodes, 3, 3): derivatives by the modelled nodes; then by those of
        all images, if there are images.
    where
        (local nodes, all nodes and those of images) number of each block.
    onto
        (cells, k (k + 1)/2, 3, 3) sums of second derivatives by two nodes of the same cell, for
        each pair of its nodes in the upper triangle.
    """

    def __init__(
        self, shape: tuple[int, int], factor: float, row_of: Ints, column_of: Ints, turn: Array
    ) -> None:
        """Number the blocks and set them to zero; parameters are those of the class."""
        self.factor, self.row_of, self.column_of = factor, row_of, column_of
        # images have one more set of blocks, so that `add_to` can give it a sign
        sets = min(len(turn), 2)
        numbers = np.arange(sets * shape[0] * shape[1], dtype=np.int32).reshape(sets, *shape)
        self.where = np.concatenate(numbers, axis=1)
        self.blocks = np.zeros((sets, *shape, 3, 3))
        self.turn = np.ascontiguousarray(turn)
        cells, k = row_of.shape
        self.onto = np.zeros((cells, k * (k + 1) // 2, 3, 3))

    def finish(self) -> None:
        """Add the sums of each cell, `onto`, to the blocks of its nodes."""
        k = self.row_of.shape[1]
        a, b = np.triu_indices(k)
        blocks_of_cell = np.zeros((k, k, 3, 3))
        # own modelled cells; rows of all others are -1
        for cell in np.flatnonzero(self.row_of[:, 0] >= 0):
            sums = self.factor * self.onto[cell]
            # both triangles of the symmetric matrix (k, k, 3, 3) of its nodes
            blocks_of_cell[b, a] = sums.transpose(0, 2, 1)
            blocks_of_cell[a, b] = sums
            rows, columns = self.row_of[cell], self.column_of[cell]
            block_numbers = self.where[rows[:, None], columns]  # (k, k)
            self.blocks.reshape(-1, 3, 3)[block_numbers] += blocks_of_cell

    def add_to(self, matrix: Array, factor: float, sign: float) -> None:
        """Add a multiple of the second derivatives to a matrix (3 local nodes, 3 all nodes).

        Blocks of images are added times `sign`: -1 for displacements that are opposite in images.
        """
        rows, columns = self.blocks.shape[1:3]
        # row by row, so that no second array of this size is needed
        for i, row in enumerate(matrix.reshape(rows, 3, columns, 3)):
            blocks, *blocks_of_images = self.blocks[:, i]
            for blocks_of_image in blocks_of_images:
                blocks = blocks + sign * blocks_of_image
            row += factor * blocks.transpose(1, 0, 2)


@dataclass(frozen=True)
class PairLimits:
    """Limits that decide which quadrature rule a pair of cells has.

    Attributes
    ----------
    h
        Thickness over R: nearer cells are too near.
    space
        Least distance over size that is counted.
    above_tolerance
        Distance over a cell's radius: a place nearer than this to the middle is above or below the
        cell.
    flat
        Sine of the angle up to which a cell is beside another, not above it.
    worst
        Distance over size below which cells are too near.
    """

    h: float
    space: float
    above_tolerance: float
    flat: float
    worst: float


class Pairs:
    """The compiled functions for pairs of cells with nodes (cells, k, 3).

    Construction is collective over the ranks of `comm`, one of which compiles.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        names = "pairs.c", "pair_rules.c", "stacked_faces.c"
        source, *further_sources = (Path(__file__).with_name(name) for name in names)
        self._ffi, self._lib = load_native(source, FUNCTIONS, comm, *further_sources)

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
        """Return the energy of the first `counted` pairs, and add derivatives of all pairs.

        Derivatives by nodes of pairs are added to `gradient` (cells, k, 3) and `stiffness`. Those
        at points go first to the sums of `Points`; `finish` brings them to the nodes. Where points
        of the second cell differ from point to point of the first one, they have no sums: their
        derivatives go to the nodes at once.

        Parameters
        ----------
        cells
            (n, 2) first and second cell of each pair.
        left, right
            Points on each pair's first and second cell, and their rows (n,).
        """
        if not len(cells):
            return 0.0
        (left_points, left_rows), (right_points, right_rows) = left, right
        # to a multiple of `LANES`, with the last pair, whose repetitions C leaves out
        padding = -len(cells) % LANES
        filled_cells, filled_left, filled_right = (
            _filled(rows, padding) for rows in (cells, left_rows, right_rows)
        )
        # whether the second cell has the same points for all points of the first one
        is_shared = right_points.tables.ndim == 3
        p = self._pointer
        right_sums = p(right_points.sums) if is_shared else self._ffi.NULL
        # arguments in the order of `pairs` in C
        left_arguments = [*self._point_arguments(left_points), p(left_points.sums), p(filled_left)]
        right_arguments = [*self._point_arguments(right_points), right_sums, p(filled_right)]
        pair_arguments = [len(filled_cells), counted, padding, p(filled_cells)]
        return float(
            self._lib.pairs(
                *pair_arguments,
                nodes.shape[1],
                p(nodes),
                *left_arguments,
                *right_arguments,
                int(is_shared),
                p(gradient),
                *self._matrix(nodes, stiffness),
            )
        )

    def _point_arguments(self, points: "Points") -> list[Any]:
        """Return the numbers of points and of layers, then pointers to the arrays of `Points`."""
        arrays = points.tables, points.heights, points.t, points.q
        return [*points.q.shape[-2:], *(self._pointer(array) for array in arrays)]

    def _matrix(self, nodes: Array, stiffness: Stiffness | None) -> list[Any]:
        """Return the arguments of C functions for a stiffness; null pointers for None.

        `nodes` (cells, k, 3) are those of all copies.
        """
        if not stiffness:
            return [0.0, *3 * [self._ffi.NULL], 0, *3 * [self._ffi.NULL], 1]
        p, modelled_cells = self._pointer, len(nodes) // len(stiffness.turn)
        return [
            stiffness.factor,
            p(stiffness.onto),
            p(stiffness.blocks),
            p(stiffness.where),
            stiffness.where.shape[1],
            p(stiffness.row_of),
            p(stiffness.column_of),
            p(stiffness.turn),
            modelled_cells,
        ]

    def cells(self, arrays: dict[str, Array], **numbers: float) -> Any:
        """Return the struct `Cells` of stacked_faces.c, for `add_stacked` and `visible_points`.

        `arrays` and `numbers` are its members; the arrays live as long as the struct.
        """
        struct = self._ffi.new(
            "Cells *", numbers | {name: self._pointer(array) for name, array in arrays.items()}
        )
        ARRAYS_OF_STRUCTS[struct] = arrays
        return struct

    def add_stacked(
        self,
        struct: Any,
        nodes: Array,
        cells: Ints,
        gradient: Array,
        stiffness: Stiffness | None = None,
    ) -> float:
        """Return the energy of pairs (n, 2) of cells with stacked faces, and add derivatives.

        The energy is nan if two cells overlap.

        Parameters
        ----------
        struct
            The result of the method `cells`: the charges and rules of the cells, for C.
        gradient, stiffness
            (cells, k, 3) and a matrix, to which first and second derivatives by nodes are added;
            None for no second ones.
        """
        if not len(cells):
            return 0.0
        p, pairs = self._pointer, np.ascontiguousarray(cells)
        arrays = p(pairs), p(nodes), p(gradient)
        matrix = self._matrix(nodes, stiffness)
        return float(self._lib.close_pairs(struct, len(pairs), *arrays, *matrix))

    def visible_points(
        self, struct: Any, nodes: Array, first: int, second: int, max_points: int
    ) -> tuple[Array, Array, Array, Array] | None:
        """Return the rule on the second cell as seen from each of P points of the first cell.

        None if both cells overlap.

        Parameters
        ----------
        struct
            The result of the method `cells`: the charges and rules of the cells, for C.
        first, second
            Numbers of the cells.
        max_points
            Largest number of points of a rule.

        Returns
        -------
        places
            (P, M, 2) in the reference triangle; rules are padded to the longest.
        weights
            (P, M), zero for padding.
        inward
            (P,) 1 where the first cell's normal leads away from the second one, else -1.
        shift
            (P,) how far charges of the first cell are moved inward, to a least distance.
        """
        p, P = self._pointer, struct.P
        point_counts, (inward, shift) = np.zeros(P, dtype=np.int64), np.zeros((2, P))
        X, w = np.full((P, max_points, 2), 1 / 3), np.zeros((P, max_points))
        outputs = p(point_counts), p(X), p(w), p(inward), p(shift)
        if self._lib.seen_of(struct, first, second, p(nodes), max_points, *outputs):
            return None
        # C left the places and weights of padding as they were: the middle and zero
        longest = point_counts.max()
        return X[:, :longest], w[:, :longest], inward, shift

    def finish(
        self,
        nodes: Array,
        cells: Ints,
        points: "Points",
        gradient: Array,
        stiffness: Stiffness | None = None,
    ) -> None:
        """Add the sums at points to `gradient` and `stiffness`, and reset the sums.

        `cells` (rows,) are the cells of the points; `gradient` is (cells, k, 3).
        """
        padding, p = -len(cells) % LANES, self._pointer  # to a multiple of `LANES`
        filled, (P, *_) = _filled(cells, padding), points.tables.shape
        cell_blocks = p(stiffness.onto) if stiffness else self._ffi.NULL
        size_arguments = [len(filled), padding, p(filled), nodes.shape[1], p(nodes), P]
        self._lib.points(
            *size_arguments, p(points.tables), p(points.sums), p(gradient), cell_blocks
        )
        points.sums[:] = 0.0

    def rules(
        self,
        nodes: Array,
        own_cells: range,
        has_rule: NDArray[np.uint8],
        least_distances: Array,
        limits: PairLimits,
    ) -> NDArray[np.int8] | None:
        """Return the number of the rule of each pair, (own cells, cells); -1 without a rule.

        None if two cells are too near each other.

        Parameters
        ----------
        nodes
            (cells, k, 3) nodes, corners first.
        has_rule
            (own cells, cells) 1 for the pairs that have a rule.
        least_distances
            (rules,) the distance over the size of cells from which each rule is precise.
        """
        centre = nodes.mean(axis=1)
        normal = np.cross(nodes[:, 1] - nodes[:, 0], nodes[:, 2] - nodes[:, 0])
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        radius = np.linalg.norm(nodes - centre[:, None], axis=-1).max(axis=1)
        p, rule_numbers = self._pointer, np.empty((len(own_cells), len(nodes)), dtype=np.int8)
        size_arguments = [len(nodes), own_cells.start, own_cells.stop, nodes.shape[1]]
        arrays = [p(array) for array in (nodes, centre, normal, radius, has_rule)]
        too_near = self._lib.rules(
            *size_arguments,
            *arrays,
            limits.h,
            limits.space,
            limits.above_tolerance,
            limits.flat,
            len(least_distances),
            p(least_distances),
            limits.worst,
            p(rule_numbers),
        )
        return None if too_near else rule_numbers

    def _pointer(self, array: NDArray[Any]) -> Any:
        """Return a C pointer to a contiguous array."""
        assert array.flags.c_contiguous
        return self._ffi.from_buffer(C_TYPES[array.dtype], array)


def _filled(rows: Ints, padding: int) -> Ints:
    """Return the rows with the last one repeated `padding` times more."""
    return np.concatenate([rows, rows[-1:].repeat(padding, 0)])
