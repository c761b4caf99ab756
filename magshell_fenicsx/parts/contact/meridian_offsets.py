"""Offsets of faces on meridians whose thickness varies or changes: see `face_offsets`.

The area at a node, over 2 pi, is J = rho |r'|; on the axis, where that is zero, rho' |r'| stands
for it. With b = U, a = r' . (U', W') and q the part of (U', W') across r' its derivatives along
(U, W) are

    J,u = |r'| b + rho a/|r'|,    J,uu = rho q^2/|r'| + 2 a b/|r'|.

Along a wave (U cos, V sin, W cos) of m theta the first has b = U + m V and varies with cos; twice
the mean of the second is, with P = m U + V and f = rho V' - rho' P - m z' W,

    rho (q^2 + V'^2)/|r'| + 2 a b/|r'| + |r'| (P^2 + m^2 W^2)/rho - f^2/(rho |r'|).

A row is a linear form of the displacement: its coefficients by (U, V, W) of a cell's nodes. The
unknowns of a node are (U, W), or (U, V, W) of a wave. Arrays (cells, places) have values of each
cell at its nodes. H is half the thickness, the amplitude the natural stretch (`face_offsets`).
"""

from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.free_parameters import SettableNumber
from magshell_fenicsx.parts.contact.face_offsets import FaceOffsets
from magshell_fenicsx.parts.contact.meridian_projection import AXIS_TOLERANCE, MeridianCurves

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
IN_PLANE = [0, 2]  # of (U, V, W)


class MeridianOffsets(FaceOffsets):
    """Half the thickness H at all nodes of meridians, over R, with its derivatives.

    Parameters
    ----------
    curves
        The meridians.
    r0
        (nodes, 2) undeformed rho and z.
    h
        Thickness over R.
    volume_factors
        (powers, cells, functions) undeformed volume over h times the undeformed area at the nodes
        of each cell, by powers of the amplitude.
    keeps_volume
        (cells,) whether the thickness follows from the area.
    amplitude
        The natural stretch, on which volumes depend; None without.

    The field `_slopes` (places, functions) has derivatives of shape functions at the nodes of a
    cell. `_value_table` (cells, places, functions) has shape functions of rho there, and on the
    axis those of |rho'|; `_on_axis` (cells, places) says where that is.
    """

    _wave_number: float | None = None  # m; None for displacements that are the same all around

    def __init__(
        self,
        curves: MeridianCurves,
        r0: Array,
        h: float,
        volume_factors: Array,
        keeps_volume: NDArray[np.bool_],
        amplitude: SettableNumber | None = None,
    ) -> None:
        """Tabulate shape functions at nodes; on the axis those of |rho'| stand for rho's."""
        self._slopes, rho = curves.slopes_at_nodes, r0[curves.nodes, 0]
        self._on_axis = np.abs(rho) < AXIS_TOLERANCE
        # |rho'| is the sign of rho' times rho'; off the axis a shape function is one at its own
        # node, and zero at the others: the identity
        rho_slope = np.einsum("qk,ck->cq", self._slopes, rho)
        axis_table = np.sign(rho_slope)[..., None] * self._slopes
        self._value_table = np.where(self._on_axis[..., None], axis_table, np.eye(rho.shape[1]))
        same_place = np.arange(len(r0))  # there are no images, so no two nodes are at one place
        super().__init__(curves, r0, h, volume_factors, keeps_volume, same_place, amplitude)

    def waves(self, m: float) -> "MeridianOffsets":
        """Return these offsets with derivatives by waves (U cos, V sin, W cos) of m theta.

        The displacement stays (U, W). H changes as cos m theta.
        """
        offsets_of_waves = copy(self)
        offsets_of_waves._wave_number = m
        offsets_of_waves._components = 3  # U, V and W
        return offsets_of_waves

    def undeformed_tangents(self) -> Array:
        """Return undeformed tangents (2, cells, nodes, 3): along the meridian, and around the axis.

        The second has the length rho.
        """
        rho, tangent = self._radius_and_tangent(self._r0, slice(None))
        tangents = np.zeros((2, *rho.shape, 3))  # components along rho, theta and z
        # an index list after another index puts its axis first
        tangents[0, ..., IN_PLANE] = np.moveaxis(tangent, -1, 0)
        tangents[1, ..., 1] = rho
        return tangents

    def _radius_and_tangent(self, r: Array, cells: Any) -> tuple[Array, Array]:
        """Return rho (cells, places) and r' (cells, places, 2) at the nodes of some cells.

        On the axis |rho'| stands for rho.

        Parameters
        ----------
        r
            (nodes, 2) places of nodes.
        cells
            Numbers or flags of the cells, or a slice.
        """
        nodal = r[self._cells.nodes[cells]]
        rho = np.einsum("cqk,ck->cq", self._value_table[cells], nodal[..., 0])
        return rho, np.einsum("qk,cki->cqi", self._slopes, nodal)

    def _areas(self, r: Array, cells: Any) -> Array:
        """Return the areas rho |r'| (cells, places) over 2 pi at places r (nodes, 2)."""
        rho, tangent = self._radius_and_tangent(r, cells)
        return np.asarray(rho * np.linalg.norm(tangent, axis=-1))

    def _area_rows(self, u: Array, cells: Longs) -> tuple[Array, Array, Array, Array]:
        """Return rho, |r'|, and the rows a and b of the module's formulas, at u (nodes, 2).

        Rows are (cells, places, functions, 3) by (U, V, W) of nodes; rho and |r'| are (cells,
        places).
        """
        rho, tangent = self._radius_and_tangent(self._r0 + u, cells)
        a, b = np.zeros((2, *rho.shape, rho.shape[1], 3))
        a[..., IN_PLANE] = self._slopes[..., None] * tangent[:, :, None]
        # b = U + m V
        b[..., 0] = self._value_table[cells]
        b[..., 1] = (self._wave_number or 0.0) * self._value_table[cells]
        return rho, np.linalg.norm(tangent, axis=-1), a, b

    def _by_unknowns(self, rows: Array) -> Array:
        """Return rows by the unknowns (cells, places, dofs), from rows by (U, V, W) of nodes.

        Without waves the unknowns are (U, W) alone.

        Parameters
        ----------
        rows
            (cells, places, functions, 3).
        """
        rows = rows if self._wave_number is not None else rows[..., IN_PLANE]
        return np.asarray(rows.reshape(*rows.shape[:2], rows.shape[2] * rows.shape[3]))

    def _area_slopes(self, u: Array, cells: Longs) -> Array:
        """Return derivatives (cells, places, dofs) of areas by the unknowns of cells."""
        # rho, |r'|, and the rows a and b of the module's formula J,u = |r'| b + rho a/|r'|
        rho, speed, a, b = self._area_rows(u, cells)
        slopes = self._by_unknowns(speed[..., None, None] * b + (rho / speed)[..., None, None] * a)
        if not self._wave_number:
            return slopes
        # on the axis there is one value all around, so that a wave does not change it
        return np.where(self._on_axis[cells][..., None], 0.0, slopes)

    def _area_hessians(self, u: Array, cells: Longs, w: Array) -> Array:
        """Return Hessians (cells, dofs, dofs) of the sums of w J over each cell's nodes.

        The formula is that of the module, for waves of m theta, or for m = 0.

        Parameters
        ----------
        u, w
            (nodes, 2) displacement, and weights (cells, places).
        """
        # rho, |r'|, and the rows a and b of the module's formulas
        rho, speed, a, b = self._area_rows(u, cells)
        m = self._wave_number or 0.0
        _, tangent = self._radius_and_tangent(self._r0 + u, cells)
        rho1, z1 = np.moveaxis(tangent, -1, 0)[..., None]  # rho' and z'
        value = self._value_table[cells]
        # rows of q, P, m W, f and V' in the module's formula, by (U, V, W): index 0, 1 or 2 in the
        # last axis
        q, P, m_W, f, V_slope = np.zeros((5, *a.shape))
        q[..., 0], q[..., 2] = (row * self._slopes / speed[..., None] for row in (-z1, rho1))
        P[..., 0], P[..., 1] = m * value, value
        m_W[..., 2] = m * value
        V_slope[..., 1] = self._slopes
        f[..., :] = rho[..., None, None] * V_slope - rho1[..., None] * P
        f[..., 2] -= m * z1 * value
        a, b, q, P, m_W, f, V_slope = (
            self._by_unknowns(row) for row in (a, b, q, P, m_W, f, V_slope)
        )
        # factors of the squares of q and V', of P and m W, and of f
        w_stretch, w_turn = w * rho / speed, w * speed / rho
        w_shear = -w / (rho * speed)
        squares = (w_stretch, q), (w_stretch, V_slope), (w_turn, P), (w_turn, m_W), (w_shear, f)
        # sums over the nodes of each cell, by its unknowns: of these squares, and of 2 a b/|r'|
        H = sum(np.einsum("cqm,cqn->cmn", weight[..., None] * row, row) for weight, row in squares)
        mixed = np.einsum("cqm,cqn->cmn", (w / speed)[..., None] * a, b)
        return np.asarray(H + mixed + np.swapaxes(mixed, 1, 2))
