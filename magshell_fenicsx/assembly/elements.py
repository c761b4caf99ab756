"""Element matrices times a vector, without a global matrix."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.point_kernels import COMPONENTS, SKEW

Array = NDArray[np.float64]
Ints = NDArray[np.int32]


def add_own(y: Array, K: Array, nodes: Ints, x: Array) -> None:
    """Add the matrices (cells, 9, pairs a <= b) of cells times x (nodes, 3) to y; see `BlockMatrix.add_cells`."""
    a, b = np.triu_indices(nodes.shape[1])
    blocks = np.empty((len(K), len(a), 3, 3))
    for number, (c, d) in enumerate(COMPONENTS):
        blocks[:, :, c, d] = blocks[:, :, d, c] = K[:, number]
    for number, (c, d) in enumerate(SKEW, len(COMPONENTS)):
        blocks[:, :, c, d] += K[:, number]
        blocks[:, :, d, c] -= K[:, number]
    np.add.at(y, nodes[:, a], np.einsum("epcd,epd->epc", blocks, x[nodes[:, b]]))
    beside = a < b
    np.add.at(y, nodes[:, b[beside]], np.einsum("epdc,epd->epc", blocks[:, beside], x[nodes[:, a[beside]]]))


def add_coupled(y: Array, K: Array, here: Ints, there: Ints, x: Array) -> None:
    """Add the blocks (pairs of cells, 9, functions^2) and their transposes; see `BlockMatrix.add_coupling`."""
    n = here.shape[1]
    blocks = K.reshape(len(K), 3, 3, n, n)
    np.add.at(y, here, np.einsum("ecdab,ebd->eac", blocks, x[there]))
    np.add.at(y, there, np.einsum("ecdab,eac->ebd", blocks, x[here]))
