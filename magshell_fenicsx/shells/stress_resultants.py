"""Strains, membrane forces and moments at points of a shell, and stresses of its layers.

The strain E, the membrane force N and the moment M are those of the energy (`models/shell/law.py`):
N and M are its derivatives by E and by the change of curvature K, per length of the undeformed
surface, and turn with it. A positive moment stretches the inner face. Tensors have the components
11, 12 and 22 (..., 3) in an orthonormal frame. N is over E h, M over D/R, stresses are over E: E, h
and R are Young's modulus, thickness and reference length, D the bending stiffness. A jet is a map
with its first and second derivatives by coordinates at points; lengths are over R.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.law import Law
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.strains import (
    NaturalFrame,
    TangentFrame,
    bending_moment,
    membrane_force,
)
from magshell_fenicsx.parts.natural.shape import CURVATURE, STRETCH, Natural
from magshell_fenicsx.quantities.stresses import LAYERS

Array = NDArray[np.float64]


class StressResultants:
    """Membrane strains, forces and moments at points (cells, points per cell) of a shell.

    Parameters
    ----------
    r0
        (6, cells, points, 3) jet of the placement: r0, r0,_1, r0,_2, r0,_11, r0,_12, r0,_22.
    material
        Material of the shell.
    thickness
        (cells, points) factor of the thickness h; None for 1.
    natural
        The natural shape; None if the drawn shape is without stress.
    made_of
        (cells, 4) numbers of each cell's material: modulus over that of the first shell, Poisson's
        ratio, density ratio, number of the law. None if all cells have `material`.

    Attributes
    ----------
    frame
        Tangent bases and normals of the undeformed surface at the points.

    The field `_law` is the law of elasticity for the thickness h, `_thickness` the factor of h.
    `_natural` are the tensors of the natural shape, None without one. `_unit` is the unit of
    moments.
    """

    def __init__(
        self,
        r0: Array,
        material: Material,
        thickness: Array | None,
        natural: Natural | None = None,
        made_of: Array | None = None,
    ) -> None:
        """Set frames, law and natural shape at the points."""
        self.frame = frame = TangentFrame.from_jet(r0)
        self._thickness = thickness
        self._law = material.law_in(made_of).at_point(
            r0[0], frame.t[..., 0, :], frame.t[..., 1, :], frame.n0
        )
        self._natural = natural and natural.tensors_at(r0[0], self.frame.n0)
        self._unit = material.bending_stiffness  # D of the thickness h, the unit of M
        self._has_plies = bool(material.laminate_by_shell)

    def values_of(self, u: Array, mu: Mapping[str, float]) -> dict[str, Array]:
        """Return strains and moments of a displacement at the points.

        Parameters
        ----------
        u
            (6, cells, points, 3) jet of the displacement over R.
        mu
            Amplitudes of the state.

        Returns
        -------
        E, M
            (..., 3) components 11, 12 and 22 of membrane strain and bending moment over D/R, with D
            of the thickness h; the strain from the natural shape, if there is one.
        E_total
            The strain from the drawn shape, if there is a natural one.
        """
        frame = self.frame
        E, K = frame.membrane_strain(u), frame.curvature_change(u)
        if not self._natural:
            return {"E": E, "M": np.asarray(bending_moment(E, K, self._law_here) / self._unit)}
        # stresses come from the strain beyond the natural shape, which grows with two amplitudes
        shape = self._natural_frame(mu)
        elastic_strain, M = shape.elastic(E), shape.moment(E, K, self._law_here)
        return {"E": elastic_strain, "M": np.asarray(M / self._unit), "E_total": E}

    def forces_of(self, u: Array, mu: Mapping[str, float]) -> dict[str, Array]:
        """Return the membrane forces N over E h and the stresses of layers over E, each (..., 3).

        Stresses are "stress_top", "stress_middle" and "stress_bottom", those of plane stress that
        vary linearly through the thickness; of a laminate, whose plies have their own, there are
        none. Parameters are those of `values_of`.
        """
        E, K = self.frame.membrane_strain(u), self.frame.curvature_change(u)
        M = self.values_of(u, mu)["M"]
        thickness = 1.0 if self._thickness is None else self._thickness
        if self._natural:
            shape = self._natural_frame(mu)
            N, thickness = shape.force(E, K, self._law_here), thickness * shape.thickness
        else:
            N = membrane_force(E, K, self._law_here)
        if self._has_plies:
            return {"N": N}
        # M is over D/R, and the stress of bending at a face 6 M/t²
        t, bending = np.asarray(thickness)[..., None], 6 * self._unit / self._law.h * M
        faces = {name: N / t - side * bending / t**2 for name, side in LAYERS.items()}
        return {"N": N} | {f"stress_{name}": stress for name, stress in faces.items()}

    def _natural_frame(self, mu: Mapping[str, float]) -> NaturalFrame:
        """Return the natural shape at the amplitudes of a state."""
        assert self._natural
        return NaturalFrame.from_tensors(
            self.frame, *self._natural, bent=mu.get(CURVATURE, 0.0), stretched=mu.get(STRETCH, 0.0)
        )

    @property
    def _law_here(self) -> Law:
        """The law with the thickness at the points."""
        return self._law if self._thickness is None else self._law.thicker(self._thickness)
