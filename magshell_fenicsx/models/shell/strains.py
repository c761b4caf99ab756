"""Membrane strains, changes of curvature and bending moments at points, in NumPy, for output.

The tensors are those of the energy (`kinematics`, `law`), on the undeformed surface: E_ij = (a_ij -
a0_ij)/2, K_ij = b_ij - b0_ij, and M_ij, the derivative of the energy by K. The normal is outward
and b = n . r,_ij, so a sphere has b = -a/R, and a positive moment flattens it: it stretches the
inner face.

- A jet (6, ..., 3) is a value with its two first and three second derivatives by coordinates of the
  surface; r0 is the placement, u the displacement, both over R.
- A frame is two orthonormal vectors t_1, t_2 tangent to the undeformed surface, at each point.
  Components 11, 12, 22 of a tensor in it are an array (..., 3).
- a^i is the dual basis, F = a_i (x) a0^i + n (x) n0 the deformation gradient.
- The natural shape is the one that the shell would have without stress; the index n marks it.
- U is the stretch tensor of the natural shape in the surface, kappa its additional curvature.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.kinematics import curvature_components, strain_components
from magshell_fenicsx.models.shell.law import Law

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TangentFrame:
    """Undeformed points, each with an orthonormal frame.

    Attributes
    ----------
    jet
        (6, ..., 3) r0, r0,_1, r0,_2, r0,_11, r0,_12, r0,_22 in coordinates of the surface, lengths
        in R.
    t
        (..., 2, 3) the frame, tangent to the surface.
    n0
        (..., 3) unit normal a0_1 x a0_2.
    dual
        (..., 2, 2) components a0^a . t_i, as [i, a].
    in_frame
        (..., 3, 3) matrix from S_11, S_12, S_22 in the coordinates to components in the frame.
    in_space
        (..., 3, 3, 3) map from components in the frame to the tensor in space.
    area
        (...) |a0_1 x a0_2|.
    """

    jet: Array
    t: Array
    n0: Array
    dual: Array
    in_frame: Array
    in_space: Array
    area: Array

    @classmethod
    def from_jet(cls, jet: Array) -> "TangentFrame":
        """Return the frame at points of a placement with this jet; t_1 is along r0,_1."""
        m, area = _area_vector(jet)
        n0 = m / area[..., None]
        t1 = jet[1] / np.linalg.norm(jet[1], axis=-1, keepdims=True)
        t = np.stack([t1, np.cross(n0, t1)], axis=-2)
        basis = np.moveaxis(jet[1:3], 0, -2) @ np.swapaxes(t, -1, -2)  # a0_a . t_i as [a, i]
        dual = np.linalg.inv(basis)
        # the change of basis of symmetric tensors, of which the components 11, 12 and 22 are kept
        in_frame = _of_symmetric(dual)[..., [0, 0, 1], [0, 1, 1], :]
        in_space = _of_symmetric(np.swapaxes(t, -1, -2))
        return cls(jet, t, n0, dual, in_frame, in_space, area)

    def membrane_strain(self, u: Array) -> Array:
        """Return E_11, E_12, E_22 (..., 3) in the frame, of a displacement.

        The displacement's jet u is (6, ..., 3), over R. E is computed from the derivatives of u and
        not as a difference of two metrics, whose leading digits would cancel.
        """
        components = strain_components(self.jet[1:3], u[1:3], _dot)
        return _times(self.in_frame, np.stack(components, axis=-1))

    def curvature_change(self, u: Array) -> Array:
        """Return R times K_11, K_12, K_22 (..., 3) in the frame, of a displacement.

        The displacement's jet u is (6, ..., 3), over R.
        """
        n = self.normal(u)
        components = curvature_components(n, n - self.n0, self.jet[3:], u[3:], _dot)
        return _times(self.in_frame, np.stack(components, axis=-1))

    def normal(self, u: Array) -> Array:
        """Return the deformed unit normal (..., 3), from a displacement's jet."""
        m, area = _area_vector(self.jet[:3] + u[:3])
        return np.asarray(m / area[..., None])

    def convected(self, v: Array, u: Array, *, thins: Array | float = 0) -> Array:
        """Return F v (..., 3) of vectors v, with F = a_i (x) a0^i + s n (x) n0.

        A remanence moves with the shell in this way. Where `thins` is 1, the stretch s of the
        thickness keeps the volume; where it is 0, s = 1. `u` is the displacement's jet.
        """
        convected = self._moved_with(self._deformed(u), v, u)
        if not np.any(thins):
            return convected
        m, area = _area_vector(self.jet[:3] + u[:3])
        # s - 1: of a constant volume, the thickness grows as the area shrinks; m/area is n
        stretch_less_one = thins * (self.area / area - 1)
        return np.asarray(convected + (stretch_less_one * _dot(self.n0, v) / area)[..., None] * m)

    def rotated(self, v: Array, u: Array) -> Array:
        """Return R v (..., 3) of vectors v, with the rotation R of the polar decomposition F = R U.

        `u` is the displacement's jet. A remanence that does not stretch moves in this way.
        """
        f, n = self._deformed(u), self.normal(u)  # f: F t_1 and F t_2, (..., 2, 3)
        # the cofactor of F is J F C^-1, here applied to t_1 and t_2, with C = F^T F and
        # J = sqrt(det C) in the surface. There R = (F + J F C^-1)/T with T² = tr C + 2 J
        cofactor = np.stack([np.cross(f[..., 1, :], n), np.cross(n, f[..., 0, :])], axis=-2)
        T = np.sqrt(np.sum(f * (f + cofactor), axis=(-2, -1)))
        return self._moved_with((f + cofactor) / T[..., None, None], v, u)

    def _deformed(self, u: Array) -> Array:
        """Return F t_1 and F t_2 (..., 2, 3), from a displacement's jet."""
        return np.asarray(np.einsum("...ia,a...j->...ij", self.dual, self.jet[1:3] + u[1:3]))

    def _moved_with(self, t: Array, v: Array, u: Array) -> Array:
        """Return v with its frame exchanged: t and the deformed normal in place of t_1, t_2, n0.

        `t` (..., 2, 3) are two vectors tangent to the deformed surface; components stay the same.
        """
        in_surface = np.einsum("...ik,...k,...ij->...j", self.t, v, t)
        return np.asarray(in_surface + _dot(self.n0, v)[..., None] * self.normal(u))

    def tensor(self, S: Array) -> Array:
        """Return the tensor in space (..., 3, 3) of S_11, S_12, S_22 (..., 3) in the frame."""
        return np.asarray(np.einsum("...ija,...a->...ij", self.in_space, S))


@dataclass(frozen=True)
class NaturalFrame:
    """Natural forms at points in their frames, at given amplitudes.

    They are the metric a_n and the curvature b_n that the shell would have without stress.

    Attributes
    ----------
    strain, bend
        (..., 3) (a_n - a0)/2 and b_n - b0, the latter times R.
    inverse
        (..., 2, 2) inverse of the stretch tensor U.
    thickness
        (...) h_n over h.
    """

    strain: Array
    bend: Array
    inverse: Array
    thickness: Array

    @classmethod
    def from_tensors(
        cls, frame: TangentFrame, T: Array, kappa: Array, t: Array, bent: float, stretched: float
    ) -> "NaturalFrame":
        """Return the natural forms at points, from tensors of the natural shape and amplitudes.

        Parameters
        ----------
        frame
            The points with their frames.
        T, kappa
            (..., 3, 3) tensors in space: natural stretch in the surface less one, U - 1, and
            natural curvature times R.
        t
            (...) natural stretch of the thickness less one.
        bent, stretched
            Factors of kappa, and of T and t.
        """
        # U - 1 and kappa in the frame, (..., 2, 2)
        stretch, curvature = (
            np.einsum("...ai,...ij,...bj->...ab", frame.t, S, frame.t)
            for S in (stretched * T, bent * kappa)
        )
        # undeformed curvature b0 = n0 . r0,_ij, and the natural thickness s over h
        b = np.einsum("d...i,...i->...d", frame.jet[3:], frame.n0)
        b0, s = _matrix(_times(frame.in_frame, b)), (1 + stretched * t)[..., None, None]
        U = np.eye(2) + stretch
        # b_n - b0: b0 stretched by U and thickened by s, plus the natural curvature in the metric
        # of U
        bend = (b0 @ U @ U + U @ U @ b0) / (2 * s) - b0 + U @ curvature @ U
        # (U² - 1)/2
        strain = stretch + stretch @ stretch / 2
        return cls(_components(strain), _components(bend), np.linalg.inv(U), s[..., 0, 0])

    def elastic(self, E: Array) -> Array:
        """Return U^-1 (E - E_n) U^-1, (..., 3): the strain as measured in the natural shape."""
        return _components(self.inverse @ _matrix(E - self.strain) @ self.inverse)

    def force(self, E: Array, K: Array, law: Law) -> Array:
        """Return N (..., 3) over E h, the derivative of the energy by E.

        E and K (..., 3) are strain and change of curvature in the frame, from the undeformed shape.
        """
        up, area = self.inverse @ self.inverse, 1 / np.linalg.det(self.inverse)
        N = law.thicker(self.thickness).force(_matrix(E - self.strain), _matrix(K - self.bend), up)
        return np.asarray(area[..., None] * np.stack(N, axis=-1))

    def moment(self, E: Array, K: Array, law: Law) -> Array:
        """Return M (..., 3) over E h R, the derivative of the energy by K.

        E and K (..., 3) are strain and change of curvature in the frame, from the undeformed shape.
        """
        # inverse metric U^-2 of the natural shape, and its area det U per undeformed area
        up, area = self.inverse @ self.inverse, 1 / np.linalg.det(self.inverse)
        M = law.thicker(self.thickness).moment(_matrix(E - self.strain), _matrix(K - self.bend), up)
        return np.asarray(area[..., None] * np.stack(M, axis=-1))


def _matrix(S: Array) -> Array:
    """Return S_11, S_12, S_22 (..., 3) as matrices (..., 2, 2)."""
    return np.stack([S[..., :2], S[..., 1:]], axis=-2)


def _components(S: Array) -> Array:
    """Return the components S_11, S_12, S_22 (..., 3) of symmetric matrices (..., 2, 2)."""
    return np.stack([S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]], axis=-1)


def membrane_force(E: Array, K: Array, law: Law) -> Array:
    """Return N_11, N_12, N_22 (..., 3) over E h, in an orthonormal frame.

    E and K (..., 3) are the components 11, 12, 22 of strain and change of curvature.
    """
    return np.stack(law.force(_matrix(E), _matrix(K), np.eye(2)), axis=-1)


def bending_moment(E: Array, K: Array, law: Law) -> Array:
    """Return M_11, M_12, M_22 (..., 3) over E h R, in an orthonormal frame.

    E and K (..., 3) are the components 11, 12, 22 of strain and change of curvature.
    """
    return np.stack(law.moment(_matrix(E), _matrix(K), np.eye(2)), axis=-1)


def principal(S: Array) -> tuple[Array, Array]:
    """Return the larger and the smaller eigenvalue (...) of symmetric tensors.

    S (..., 3) are the components 11, 12, 22 in an orthonormal frame.
    """
    mean, radius = (S[..., 0] + S[..., 2]) / 2, np.hypot((S[..., 0] - S[..., 2]) / 2, S[..., 1])
    return mean + radius, mean - radius


def _of_symmetric(A: Array) -> Array:
    """Return B (..., n, n, 3) with A S A^T = B (S_11, S_12, S_22), for A (..., n, 2).

    It makes the change of basis of symmetric tensors S a product with their three components.
    """
    first, second = A[..., 0], A[..., 1]
    mixed = first[..., :, None] * second[..., None, :]
    first_square, second_square = (v[..., :, None] * v[..., None, :] for v in (first, second))
    return np.stack([first_square, mixed + np.swapaxes(mixed, -1, -2), second_square], axis=-1)


def _times(A: Array, S: Array) -> Array:
    """Return the products (..., n) of matrices A (..., n, m) and vectors S (..., m)."""
    return np.asarray(np.einsum("...ij,...j->...i", A, S))


def _dot(a: Array, b: Array) -> Array:
    """Return the scalar products (...) of vectors (..., 3)."""
    return np.asarray(np.einsum("...i,...i->...", a, b))


def _area_vector(jet: Array) -> tuple[Array, Array]:
    """Return a_1 x a_2 (..., 3) and its length (...), from a jet."""
    m = np.cross(jet[1], jet[2])
    return m, np.linalg.norm(m, axis=-1)
