"""Membrane strains and bending moments at a shell's points, in an orthonormal frame at each."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.strains import NaturalFrame, TangentFrame, bending_moment, principal
from magshell_fenicsx.parts.natural.shape import CURVATURE, STRETCH, Natural

Array = NDArray[np.float64]


class Stresses:
    """Strains and moments at points (cells, points per cell).

    Parameters
    ----------
    r0
        (6, cells, points, 3) jet of the placement; see `strains.TangentFrame`.
    thickness
        (cells, points) factor of h; None for 1.
    """

    def __init__(self, r0: Array, material: Material, thickness: Array | None, natural: Natural | None = None) -> None:
        self.frame, self._nu, self._thickness = TangentFrame.of(r0), material.nu, thickness
        self._natural = natural and natural.at(r0[0], self.frame.n0)

    def of(self, u: Array, mu: Mapping[str, float]) -> dict[str, Array]:
        """Those of a displacement with the jet u (6, cells, points, 3) over R, at the amplitudes mu.

        Returns
        -------
        E, M
            (..., 3) components 11, 12 and 22 of membrane strain and bending moment over D/R, with D of the thickness
            h; the strain from the natural shape, if there is one.
        E_total
            The strain from the drawn shape, if there is a natural one.
        """
        frame, total = self.frame, {}
        E, K = frame.membrane_strain(u), frame.curvature_change(u)
        M = bending_moment(K, self._nu)
        if self._natural:
            total["E_total"] = E
            shape = NaturalFrame.of(frame, *self._natural, mu.get(CURVATURE, 0.0), mu.get(STRETCH, 0.0))
            E, M = shape.elastic(E), shape.moment(K, self._nu)
        if self._thickness is not None:
            M *= self._thickness[..., None] ** 3
        return {"E": E, "M": M, **total}


def principal_fields(components: Mapping[str, Array]) -> dict[str, Array]:
    """E_1, E_2, M_1, M_2 (...): the principal values of E and M (..., 3), the larger first."""
    return {
        f"{name}_{number}": values
        for name in ("E", "M")
        for number, values in enumerate(principal(components[name]), 1)
    }


def in_space(S: Array, t: Array) -> Array:
    """Components (..., 3) in frames t (..., 2, 3) as tensors (..., 3, 3)."""
    return np.asarray(np.swapaxes(t, -1, -2) @ S[..., [[0, 1], [1, 2]]] @ t)


def in_frame(S: Array, t: Array) -> Array:
    """Components (..., 3) in frames t (..., 2, 3) of symmetric tensors (..., 3, 3)."""
    return np.asarray((t @ S @ np.swapaxes(t, -1, -2))[..., [0, 0, 1], [0, 1, 1]])
