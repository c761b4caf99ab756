"""How far the faces of a meridian are from it where the thickness varies or changes: see `faces`.

The area at a node, over 2 pi, is J = rho |r'|; on the axis, where that is zero, rho' |r'| stands
for it. With b = U, a = r' . (U', W') and q the part of (U', W') across r' its derivatives along (U,
W) are

    J,u = |r'| b + rho a/|r'|,    J,uu = rho q^2/|r'| + 2 a b/|r'|.

Along a wave (U cos, V sin, W cos) of m theta the first has b = U + m V and varies with cos; twice
the mean of the second is, with P = m U + V and f = rho V' - rho' P - m z' W,

    rho (q^2 + V'^2)/|r'| + 2 a b/|r'| + |r'| (P^2 + m^2 W^2)/rho - f^2/(rho |r'|).
"""

from copy import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.free_parameters import SettableNumber
from magshell_fenicsx.parts.touching.curves import SAME, Curves
from magshell_fenicsx.parts.touching.faces import Faces

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
IN_PLANE = [0, 2]  # of (U, V, W)


class Rings(Faces):
    """Half the thickness at all nodes of meridians."""

    _m: float | None = None  # of waves

    def __init__(
        self,
        curves: Curves,
        r0: Array,
        h: float,
        thickness: Array,
        thins: NDArray[np.bool_],
        grown: SettableNumber | None = None,
    ) -> None:
        self._along, rho = curves.at_nodes, r0[curves.nodes, 0]
        slope = np.einsum("qk,ck->cq", self._along, rho)
        on_axis = (np.abs(rho) < SAME)[..., None]
        self._values = np.where(
            on_axis, np.sign(slope)[..., None] * self._along, np.eye(rho.shape[1])
        )
        self._on_axis = on_axis[..., 0]
        super().__init__(curves, r0, h, thickness, thins, np.arange(len(r0)), grown)

    def waves(self, m: float) -> "Rings":
        """The same for waves (U, V, W) of m theta at a displacement (U, W), with what H changes by
        as cos m theta.
        """
        other = copy(self)
        other._m, other._parts = m, 3
        return other

    def tangents(self) -> Array:
        """Along the undeformed meridian, and around, (2, cells, nodes, 3)."""
        rho, along = self._section(self._r0, slice(None))
        of_both = np.zeros((2, *rho.shape, 3))
        of_both[0, ..., IN_PLANE], of_both[1, ..., 1] = np.moveaxis(along, -1, 0), rho
        return of_both

    def _section(self, r: Array, some: Any) -> tuple[Array, Array]:
        """rho and r' at the nodes of some cells."""
        nodal = r[self._cells.nodes[some]]
        rho = np.einsum("cqk,ck->cq", self._values[some], nodal[..., 0])
        return rho, np.einsum("qk,cki->cqi", self._along, nodal)

    def _areas(self, r: Array, some: Any) -> Array:
        rho, along = self._section(r, some)
        return np.asarray(rho * np.linalg.norm(along, axis=-1))

    def _changes(self, u: Array, some: Longs) -> tuple[Array, Array, Array, Array]:
        """rho, |r'|, and by (U, V, W) of the nodes (cells, places, functions, 3) the rows a and b."""
        rho, along = self._section(self._r0 + u, some)
        a, b = np.zeros((2, *rho.shape, rho.shape[1], 3))
        a[..., IN_PLANE] = self._along[..., None] * along[:, :, None]
        b[..., 0], b[..., 1] = self._values[some], (self._m or 0.0) * self._values[some]
        return rho, np.linalg.norm(along, axis=-1), a, b

    def _of(self, rows: Array) -> Array:
        """By the unknowns (cells, places, dofs)."""
        rows = rows if self._m is not None else rows[..., IN_PLANE]
        return np.asarray(rows.reshape(*rows.shape[:2], rows.shape[2] * rows.shape[3]))

    def _area_slopes(self, u: Array, some: Longs) -> Array:
        rho, speed, a, b = self._changes(u, some)
        slopes = self._of(speed[..., None, None] * b + (rho / speed)[..., None, None] * a)
        return (
            np.where(self._on_axis[some][..., None], 0.0, slopes) if self._m else slopes
        )  # one value all around

    def _bends(self, u: Array, some: Longs, w: Array) -> Array:
        rho, speed, a, b = self._changes(u, some)
        m, (rho1, z1) = (
            self._m or 0.0,
            np.moveaxis(self._section(self._r0 + u, some)[1], -1, 0)[..., None],
        )
        q, p, c, f, v = np.zeros((5, *a.shape))
        value = self._values[some]
        q[..., 0], q[..., 2] = (each * self._along / speed[..., None] for each in (-z1, rho1))
        p[..., 0], p[..., 1] = m * value, value
        c[..., 2], v[..., 1] = m * value, self._along
        f[..., :] = rho[..., None, None] * v - rho1[..., None] * p
        f[..., 2] -= m * z1 * value
        a, b, q, p, c, f, v = (self._of(each) for each in (a, b, q, p, c, f, v))
        stretched, turned = w * rho / speed, w * speed / rho
        squares = (stretched, q), (stretched, v), (turned, p), (turned, c), (-w / (rho * speed), f)
        H = sum(np.einsum("cqm,cqn->cmn", weight[..., None] * row, row) for weight, row in squares)
        mixed = np.einsum("cqm,cqn->cmn", (w / speed)[..., None] * a, b)
        return np.asarray(H + mixed + np.swapaxes(mixed, 1, 2))
