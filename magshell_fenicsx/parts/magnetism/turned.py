"""Second derivatives of charges by nodes where these have turned, in C: near nodes, in single
precision.
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
FUNCTIONS = """
    void turn_blocks(int64_t, const int32_t *, const int32_t *, const int32_t *, const double *, const double *, double,
        const double *, const int64_t *, const double *, const int32_t *, const int32_t *, float *);
"""


@dataclass(frozen=True)
class Kept:
    """Some of the blocks of a `Stiffness`.

    Attributes
    ----------
    starts, which
        Of each row of blocks, their numbers.
    first
        Which of these is the first one of its row that is stored.
    onto, columns
        Starts of rows and columns of what is stored.
    """

    starts: Indices
    which: Indices
    first: Indices
    onto: Indices
    columns: Indices

    @classmethod
    def of(cls, stiffness: Stiffness, some: NDArray[np.bool_], *, upper: bool) -> "Kept":
        """Some (blocks,) of all; if `upper`, those below the diagonal are not stored."""
        which = np.flatnonzero(some).astype(np.int32)
        starts = np.append(0, np.cumsum(some, dtype=np.int32))[stiffness.starts].astype(np.int32)
        rows, columns = (
            np.repeat(np.arange(len(starts) - 1), np.diff(starts)),
            stiffness.columns[which],
        )
        stored = columns >= (rows if upper else 0)
        onto = np.append(0, np.cumsum(stored, dtype=np.int32))[starts].astype(np.int32)
        return cls(
            starts, which, (starts[1:] - np.diff(onto)).astype(np.int32), onto, columns[stored]
        )


class Turning:
    """Turns second derivatives with their nodes; the constructor is collective."""

    def __init__(self, comm: MPI.Comm) -> None:
        self._ffi, self._lib = load_native(Path(__file__).with_name("turned.c"), FUNCTIONS, comm)
        self._upper = comm.size == 1

    def kept(self, stiffness: Stiffness, some: NDArray[np.bool_]) -> Kept:
        """What is kept of some blocks (blocks,); of a matrix that is all on one rank those of one
        half.
        """
        return Kept.of(stiffness, some, upper=self._upper)

    def turned(
        self, stiffness: Stiffness, sign: float, number: Ints, q: Array, kept: Kept
    ) -> SinglePrecisionBlocks | None:
        """Blocks of `Stiffness.matrix` where the nodes `number` (rows,) are turned by q (all nodes,
        4), scalar last.

        None where there are several images, whose blocks are not stored apart.
        """
        count = len(stiffness.columns)
        if len(stiffness.turn) > 2:
            return None
        p, values = self._pointer, np.empty((len(kept.columns), 3, 3), dtype=np.float32)
        images = p(stiffness.blocks[count:]) if len(stiffness.turn) > 1 else self._ffi.NULL
        arrays = (
            p(kept.starts),
            p(kept.which),
            p(stiffness.columns),
            p(stiffness.blocks[:count]),
            images,
        )
        onto = p(kept.first), p(kept.onto), p(values)
        self._lib.turn_blocks(
            len(kept.first), *arrays, sign, p(stiffness.turn[-1]), p(number), p(q), *onto
        )
        return SinglePrecisionBlocks(kept.onto, kept.columns, values, self._upper)

    def _pointer(self, array: NDArray[Any]) -> Any:
        assert array.flags.c_contiguous
        return self._ffi.from_buffer(C_TYPES[array.dtype], array)
