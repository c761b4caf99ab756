"""Fields at a shell's points besides displacement, strains and moments: magnetic fields and loads, gaps."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.parameters import ACROSS, Magnetisation, Material
from magshell_fenicsx.models.shell.patterns import inside
from magshell_fenicsx.models.shell.strains import TangentFrame
from magshell_fenicsx.output.fields.interpretation import SurfaceGeometry, Torque, magnetic_loads
from magshell_fenicsx.parts.bodies.contact import Contact

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
    n0
        (cells, points, 3) undeformed normals.
    weight
        (cells, points) area; the weight of a cell in the mean over the cells that share a point.
    Br
        (cells, points, 3) the undeformed remanence; (cells, points, 0) without.
    """

    def __init__(
        self,
        r0: Array,
        material: Material,
        field: Magnetisation | None,
        thickness: Array | None,
        contacts: Sequence[Contact] = (),
        remanence: Magnetisation | None = None,
    ) -> None:
        self._contacts, self._h = contacts, material.h
        self._frame, self._field, self._thickness = TangentFrame.of(r0), field, thickness
        self.constant: dict[str, Array] = {}
        self._torque: Torque | None = None
        self.n0, self.weight = self._frame.n0, self._frame.area
        self._carried, self.Br = field or remanence, np.zeros((*r0.shape[1:-1], 0))
        if self._carried:
            pattern = self._carried.remanent
            self.Br = pattern(inside(r0[0]), self.n0) if callable(pattern) else np.broadcast_to(pattern, r0[0].shape)
        if field and field.uniform:
            h = material.h if thickness is None else material.h * thickness
            self.constant, self._torque = magnetic_loads(self._geometry(), field, inside(r0[0]), h)

    @property
    def jet(self) -> Array:
        """(6, cells, points, 3) of the placement."""
        return self._frame.jet

    def of(self, u: Array, mu: Mapping[str, float]) -> dict[str, Array]:
        """The fields of a displacement with the jet u (3 or 6, cells, points, 3) over R, at the amplitudes mu.

        Returns
        -------
        Br, Ba
            (..., 3) the remanence as the shell carries it, over its magnitude; the applied flux density at the
            deformed point, over mu_0 E / |Br|, so that its magnitude is lambda_m.
        tau
            (..., 3) torque, for a uniform field.
        gap_over_h
            (...) the least gap to a body.
        """
        frame, found = self._frame, dict[str, Array]()
        if self._carried:
            carried = frame.convected if self._carried.law == "deformation" else frame.rotated
            found["Br"] = carried(self.Br, u)
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
