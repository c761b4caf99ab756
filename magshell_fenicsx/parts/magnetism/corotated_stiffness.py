"""Second derivatives of charges by near nodes, rotated with the nodes, in single precision.

The blocks of a `Stiffness` and the rotations of nodes go in, rotated blocks come out. The loop is
in C; see docs/theory.md.

- A block is the second derivative (3, 3) by two nodes. Rows are local nodes, columns all nodes.
- Images are mirror images of the modelled part; their blocks follow the modelled ones.
- Compressed rows are those of a sparse matrix: the blocks of row i have the positions from
  starts[i] to starts[i + 1].
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.dense_tangent import SinglePrecisionBlocks
from magshell_fenicsx.parts.magnetism.pairs import C_TYPES, Stiffness
from magshell_fenicsx.platform.native import load_native

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Indices = NDArray[np.int32]
C_DECLARATIONS = """
    void turn_blocks(int64_t, const int32_t *, const int32_t *, const int32_t *, const double *,
        const double *, double,
        const double *, const int64_t *, const double *, const int32_t *, const int32_t *, float *);
"""


@dataclass(frozen=True)
class StoredBlocks:
    """The blocks of a `Stiffness` that are rotated and stored.

    Attributes
    ----------
    starts, numbers
        Start of each row in `numbers`, and the numbers of the selected blocks in the `Stiffness`.
    first
        For each row, the position in `numbers` of the first block that is stored: blocks before it
        are below the diagonal.
    row_starts, columns
        Compressed rows of the stored blocks: start of each row, column of each block.
    """

    starts: Indices
    numbers: Indices
    first: Indices
    row_starts: Indices
    columns: Indices

    @classmethod
    def select(
        cls, stiffness: Stiffness, is_selected: NDArray[np.bool_], *, upper: bool
    ) -> "StoredBlocks":
        """Return the blocks of a stiffness where `is_selected` (blocks,).

        Parameters
        ----------
        upper
            Whether only the upper half of the symmetric matrix is stored: no blocks below the
            diagonal.
        """
        numbers = np.flatnonzero(is_selected).astype(np.int32)
        # how many blocks are selected before each block; then before each row
        counts = np.append(0, np.cumsum(is_selected, dtype=np.int32))
        starts = counts[stiffness.starts].astype(np.int32)
        rows = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
        columns = stiffness.columns[numbers]
        is_stored = columns >= (rows if upper else 0)  # all columns are at least 0
        stored_counts = np.append(0, np.cumsum(is_stored, dtype=np.int32))
        row_starts = stored_counts[starts].astype(np.int32)
        # columns ascend, so the stored blocks are the last ones of a row
        first = (starts[1:] - np.diff(row_starts)).astype(np.int32)
        return cls(starts, numbers, first, row_starts, columns[is_stored])


class BlockRotation:
    """The rotation of second derivatives with their nodes; the constructor is collective."""

    def __init__(self, comm: MPI.Comm) -> None:
        """Compile the loop; on a single rank (`_upper`) half of the symmetric matrix is stored."""
        source = Path(__file__).with_name("corotated_stiffness.c")
        self._ffi, self._lib = load_native(source, C_DECLARATIONS, comm)
        self._upper = comm.size == 1

    def stored_blocks(self, stiffness: Stiffness, is_selected: NDArray[np.bool_]) -> StoredBlocks:
        """Return the selected blocks of a stiffness, where `is_selected` (blocks,).

        On a single rank only the upper half of the matrix is stored.
        """
        return StoredBlocks.select(stiffness, is_selected, upper=self._upper)

    def rotated_blocks(
        self, stiffness: Stiffness, sign: float, number: Ints, q: Array, stored: StoredBlocks
    ) -> SinglePrecisionBlocks | None:
        """Return the stored blocks of `Stiffness.matrix(sign)` after a rotation of the nodes.

        None if there is more than one image, as the blocks of several images are not kept apart.

        Parameters
        ----------
        sign
            Factor of the blocks of images: 1 if they move as the modelled part, -1 if opposite.
        number
            (rows,) global numbers of the nodes of rows.
        q
            (all nodes, 4) quaternions, scalar last.
        stored
            The blocks to rotate.
        """
        count = len(stiffness.columns)  # of modelled blocks, before those of images
        if len(stiffness.turn) > 2:  # the modelled part and more than one image
            return None
        pointer = self._pointer
        values = np.empty((len(stored.columns), 3, 3), dtype=np.float32)
        images = self._ffi.NULL  # blocks of the image, if there is one
        if len(stiffness.turn) > 1:
            images = pointer(stiffness.blocks[count:])
        blocks = (
            pointer(stored.starts),
            pointer(stored.numbers),
            pointer(stiffness.columns),
            pointer(stiffness.blocks[:count]),
            images,
        )
        rotations = pointer(stiffness.turn[-1]), pointer(number), pointer(q)
        results = pointer(stored.first), pointer(stored.row_starts), pointer(values)
        self._lib.turn_blocks(len(stored.first), *blocks, sign, *rotations, *results)
        return SinglePrecisionBlocks(stored.row_starts, stored.columns, values, self._upper)

    def _pointer(self, array: NDArray[Any]) -> Any:
        """Return an array as a C pointer; it must be C contiguous."""
        assert array.flags.c_contiguous
        return self._ffi.from_buffer(C_TYPES[array.dtype], array)
