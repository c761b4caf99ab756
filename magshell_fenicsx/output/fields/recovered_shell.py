"""Smooth strains and moments at the nodes of a shell, from samples in its cells."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.strains import TangentFrame
from magshell_fenicsx.output.fields.jump import ROUNDING, relative_jump
from magshell_fenicsx.output.fields.recovery import Recovery
from magshell_fenicsx.output.fields.stresses import in_frame, in_space, principal_fields

Array = NDArray[np.float64]
UPPER = ([0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2])  # the components of a symmetric tensor
WHOLE = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
TWICE = np.sqrt([1.0, 2, 2, 1, 2, 1])  # so that the sum of squares is that of all nine


class RecoveredShell:
    """Takes tensors from samples to nodes.

    Parameters
    ----------
    numbers
        (m, s) nodes of all cells, corners first; smooth parts share none.
    reference
        (s, 2) their places in the reference cell.
    nodes, normals
        (m, s, 3) places and undeformed normals there.
    samples, weight
        (m, q, 3) places and (m, q) weights.
    table
        (q, s) values of the nodes' shape functions at the samples.
    degree
        Of the displacement, and of the polynomials that are fitted.
    """

    def __init__(
        self,
        numbers: NDArray[np.int64],
        reference: Array,
        nodes: Array,
        normals: Array,
        samples: Array,
        weight: Array,
        table: Array,
        degree: int,
    ) -> None:
        vertices, corners = np.unique(numbers[:, :3], return_inverse=True)
        corners = corners.reshape(-1, 3)
        place, normal = np.zeros((2, len(vertices), 3))
        place[corners] = nodes[:, :3]
        np.add.at(normal, corners, normals[:, :3])
        self._recovery = Recovery(corners, samples, weight, place, frames(normal), degree)
        _, first = np.unique(numbers, return_index=True)
        cell, node = np.divmod(first, numbers.shape[1])
        barycentric = np.column_stack([1 - reference.sum(axis=1), reference])[node]
        self._to_nodes = self._recovery.at(cell, nodes[cell, node], barycentric)
        self._numbers, self._weight, self._table = numbers, weight, table

    def fields(self, tensors: Mapping[str, Array], n0: Array) -> tuple[dict[str, Array], dict[str, float]]:
        """E, M, ... at the nodes with normals n0 (n, 3), their principal values, by how much samples differ.

        Parameters
        ----------
        tensors
            Name -> (m, q, 6) at the samples, see `six`.
        """
        fit = self._recovery.coefficients(np.concatenate(list(tensors.values()), axis=-1))
        found = dict(zip(tensors, np.split(self._to_nodes @ fit, len(tensors), axis=-1), strict=True))
        jumps = {
            name: relative_jump(tensors[name], self._table @ found[name][self._numbers], self._weight, zero)
            for name, zero in ROUNDING.items()
        }
        t = frames(n0)
        components = {name: in_frame((values / TWICE)[..., WHOLE], t) for name, values in found.items()}
        smooth = {name: in_space(S, t) for name, S in components.items()}
        return smooth | principal_fields(components), jumps


def six(frame: TangentFrame) -> Array:
    """(..., 6, 3) from S_11, S_12, S_22 in a frame to the components of a tensor in space, times `TWICE`."""
    return np.asarray(frame.in_space[..., *UPPER, :] * TWICE[:, None])


def frames(normals: Array) -> Array:
    """Two unit vectors (n, 2, 3) across each of some vectors (n, 3)."""
    n = normals / np.linalg.norm(normals, axis=-1, keepdims=True)
    t1 = np.cross(n, np.where(np.abs(n[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    t1 /= np.linalg.norm(t1, axis=-1, keepdims=True)
    return np.stack([t1, np.cross(n, t1)], axis=1)
