"""The displacement at one place of a surface of revolution."""

from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import Vector

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Probe:
    """Interpolates on the cell of the place, and turns the meridian's displacement to it.

    Attributes
    ----------
    nodes, weights
        Of the cell, and its shape functions there.
    turn
        (2, 3) e_rho and e_z at the azimuth of the place.
    normal
        n0 (3,) there.
    """

    nodes: NDArray[np.int32]
    weights: Array
    turn: Array
    normal: Array

    @staticmethod
    def at(s: float, azimuth: float, r0: fem.Function) -> "Probe":
        """For a parameter of the meridian with the placement `r0`."""
        V = r0.function_space
        ends = V.mesh.geometry.x[V.mesh.geometry.dofmap, 0]
        cell = int(np.argmin(np.maximum(ends.min(axis=1) - s, s - ends.max(axis=1))))
        local = np.array([[(s - ends[cell, 0]) / (ends[cell, 1] - ends[cell, 0])]])
        values, slopes = V.element.basix_element.tabulate(1, local)[:, 0, :, 0]
        nodes = V.dofmap.list[cell]
        turn = np.array([[np.cos(azimuth), np.sin(azimuth), 0.0], [0.0, 0.0, 1.0]])
        rho_s, z_s = slopes @ r0.x.array.reshape(-1, 2)[nodes]
        normal = np.array([-z_s, rho_s]) / np.hypot(rho_s, z_s)
        return Probe(nodes, values, turn, normal @ turn)

    def __call__(self, u: Vector) -> Array:
        """u/R (3,) there."""
        return np.asarray(self.weights @ u.reshape(-1, 2)[self.nodes] @ self.turn)

    def rows(self, size: int) -> Array:
        """(3, size): the same as a matrix."""
        found = np.zeros((3, size // 2, 2))
        found[:, self.nodes] = np.einsum("n,ki->ink", self.weights, self.turn)
        return found.reshape(3, size)
