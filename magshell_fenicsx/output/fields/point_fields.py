"""Fields at a shell's points besides the displacement: strains, moments, magnetic fields and loads."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.contact import Contact
from magshell_fenicsx.models.shell.natural import CURVATURE, STRETCH, Natural
from magshell_fenicsx.models.shell.parameters import ACROSS, Magnetisation, Material
from magshell_fenicsx.models.shell.strains import NaturalFrame, TangentFrame, bending_moment, principal
from magshell_fenicsx.output.fields.interpretation import SurfaceGeometry, Torque, magnetic_loads

Array = NDArray[np.float64]


class PointFields:
    """Fields of a shell at points (cells, points per cell).

    Parameters
    ----------
    r0
        (6, cells, points, 3) jet of the placement; see `strains.TangentFrame`.
    field
        The magnetisation, or None.
    thickness
        (cells, points) factor of h; None for 1.
    contacts
        Bodies that press.
    remanence
        What is magnetised if there is no field.

    Attributes
    ----------
    constant
        Name -> values (cells, points, ...) of the fields that do not depend on the displacement: p_mag, k and f_mag
        of a uniform applied field.
    weight
        (cells, points) area; the weight of a cell in the mean over the cells that share a point.
    """

    def __init__(
        self,
        r0: Array,
        material: Material,
        field: Magnetisation | None,
        thickness: Array | None,
        natural: Natural | None = None,
        contacts: Sequence[Contact] = (),
        remanence: Magnetisation | None = None,
    ) -> None:
        self._contacts, self._h = contacts, material.h
        self._frame, self._nu, self._field, self._thickness = TangentFrame.of(r0), material.nu, field, thickness
        self._natural = natural and natural.at(r0[0], self._frame.n0)
        self.constant: dict[str, Array] = {}
        self._torque: Torque | None = None
        self.n0, self.weight = self._frame.n0, self._frame.area
        self._carried = field or remanence
        if self._carried:
            pattern = self._carried.remanent
            self._Br = pattern(r0[0], self.n0) if callable(pattern) else np.broadcast_to(pattern, r0[0].shape)
        if field and field.uniform:
            h = material.h if thickness is None else material.h * thickness
            self.constant, self._torque = magnetic_loads(self._geometry(), field, r0[0], h)

    def of(self, u: Array, mu: Mapping[str, float]) -> dict[str, Array]:
        """The fields of a displacement with the jet u (6, cells, points, 3) over R, at the amplitudes mu.

        Returns
        -------
        E, M
            (..., 3, 3) membrane strain and bending moment over D/R, with D of the thickness h, as tensors in space
            that are tangent to the undeformed surface; the strain from the natural shape, if there is one.
        E_total
            (..., 3, 3) the strain from the drawn shape, if there is a natural one.
        E_1, E_2, M_1, M_2
            (...) their principal values, the larger first.
        Br, Ba
            (..., 3) the remanence as the shell carries it, over its magnitude; the applied flux density at the
            deformed point, over mu_0 E / |Br|, so that its magnitude is lambda_m.
        tau
            (..., 3) torque, for a uniform field.
        gap_over_h
            (...) the least gap to a body.
        """
        frame, total = self._frame, {}
        E, K = frame.membrane_strain(u), frame.curvature_change(u)
        M = bending_moment(K, self._nu)
        if self._natural:
            total["E_total"] = frame.tensor(E)
            shape = NaturalFrame.of(frame, *self._natural, mu.get(CURVATURE, 0.0), mu.get(STRETCH, 0.0))
            E, M = shape.elastic(E), shape.moment(K, self._nu)
        if self._thickness is not None:
            M *= self._thickness[..., None] ** 3
        found = {"E": frame.tensor(E), "M": frame.tensor(M), **total}
        found["E_1"], found["E_2"] = principal(E)
        found["M_1"], found["M_2"] = principal(M)
        if self._carried:
            carried = frame.convected if self._carried.law == "deformation" else frame.rotated
            found["Br"] = carried(self._Br, u)
        if self._field:
            found["Ba"] = _applied(self._field, mu, frame.jet[0] + u[0])
        if self._torque:
            found["tau"] = self._torque(np.moveaxis(u[1:3], 0, -2))
        if self._contacts:
            found["gap_over_h"] = self._gap(frame.jet[0] + u[0], mu)
        return found

    def _gap(self, r: Array, mu: Mapping[str, float]) -> Array:
        h, factor = self._h, 1.0 if self._thickness is None else self._thickness.ravel()
        gaps = [c.gap(r.reshape(-1, 3), h * mu.get(c.amplitude, 0.0), h / 2 * factor)[0] for c in self._contacts]
        return np.asarray(np.min(gaps, axis=0) / h).reshape(r.shape[:-1])

    def _geometry(self) -> SurfaceGeometry:
        r0 = self._frame.jet
        b11, b12, b22 = np.einsum("d...i,...i->d...", r0[3:], self.n0)
        b0 = np.stack([np.stack([b11, b12], -1), np.stack([b12, b22], -1)], -2)
        return SurfaceGeometry(np.moveaxis(r0[1:3], 0, -2), self.n0, b0)


def _applied(field: Magnetisation, mu: Mapping[str, float], r: Array) -> Array:
    """The applied flux density (..., 3) at points r (..., 3)."""
    along = mu.get("lambda_m", 0.0)
    if field.in_space and not along:
        return np.zeros_like(r)
    if field.in_space:
        x = r.reshape(-1, 3)
        B = field.in_space(x)[0] + sum((each.at(x, mu).value[0] for each in field.driven), np.zeros(3))
        return np.asarray(along * B.reshape(r.shape))
    uniform = along * field.applied
    for name, across in zip(ACROSS, field.across, strict=False):
        uniform = uniform + mu.get(name, 0.0) * across
    return np.broadcast_to(uniform, r.shape) if field.gradient is None else uniform + along * r @ field.gradient.T
