"""Evaluation of vector fields at the same reference points of all cells, and its transpose, by matrix products."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.shape_tables import Table

Array = NDArray[np.float64]


class Sheet:
    """Some of a field's derivatives at points of every cell, in the order (cell; point, part, component).

    The table of shape functions is expanded to vectors. This triples the arithmetic but avoids sorting.

    Parameters
    ----------
    parts
        The chosen derivatives of a `Table`.
    """

    def __init__(self, table: Table, weights: Array, parts: Sequence[int]) -> None:
        D, one = table.values[:, list(parts)], np.eye(3)
        size = 3 * D.shape[2]
        self._there = np.einsum("qpf,cd->fcqpd", D, one).reshape(size, -1)
        self._back = np.einsum("q,qpf,cd->qpdfc", weights, D, one).reshape(-1, size)

    def at_points(self, nodal: Array, out: Array) -> None:
        """Write the values at the points to `out`, in any shape, from nodal vectors (cells, functions * 3)."""
        np.matmul(nodal, self._there, out=out.reshape(-1, self._there.shape[1]))

    def at_nodes(self, gradients: Array) -> Array:
        """The weighted sum (cells, functions * 3) over points of gradients, in any shape."""
        return np.asarray(gradients.reshape(-1, len(self._back)) @ self._back)
