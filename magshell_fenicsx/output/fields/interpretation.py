"""The magnetic energy as equivalent loads: pressure, in-plane force, rotational springs, torques.

Paper, section "Reduced magneto-elastic energy as load potentials": for a field that is uniform in space, at the nodes
of the undeformed surface, dimensionless as in the paper. For a remanence that does not stretch, the same of its
expansion: no pressure, a spring that differs between axes (k is the mean), a torque of the symmetric gradient too.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.models.shell.parameters import Magnetisation

Array = NDArray[np.float64]


def magnetic_loads(
    g: "SurfaceGeometry", field: Magnetisation, r0: Array, h: float | Array
) -> tuple[dict[str, Array], "Torque"]:
    """The loads p_mag and k at points r0 (..., 3), and the torque as a function of u.

    f_mag is added if the remanence and the thickness are uniform.

    Parameters
    ----------
    h
        Thickness over R; an array (...) if it varies.
    """
    pattern = field.remanent
    Br = pattern(r0, g.n0) if callable(pattern) else np.broadcast_to(pattern, r0.shape)
    Ba = field.applied
    rotates = field.law == "rotation"
    loads = {"p_mag": magnetic_pressure(g, Br, Ba, h), "k": spring_stiffness(g, Br, Ba)}
    if rotates:
        loads = {"p_mag": 0 * loads["p_mag"], "k": loads["k"] - (Br @ Ba + loads["k"]) / 2}
    if not callable(pattern) and isinstance(h, float):  # the formula of f_mag assumes uniform vectors and thickness
        loads["f_mag"] = in_plane_force(g, Br, Ba, h)
        if rotates:
            loads["f_mag"] = (loads["f_mag"] - in_plane_force(g, Ba, pattern, h)) / 2
    return loads, torque(g, Br, Ba, rotates=rotates)


@dataclass(frozen=True)
class SurfaceGeometry:
    """Undeformed bases and curvature at points: a1, a2 (..., 2, 3), n0 (..., 3), b0_ij (..., 2, 2)."""

    a: Array
    n0: Array
    b0: Array

    @property
    def dual(self) -> Array:
        """a0^1, a0^2, (..., 2, 3)."""
        metric = np.einsum("...ai,...bi->...ab", self.a, self.a)
        return np.asarray(np.einsum("...ab,...bi->...ai", np.linalg.inv(metric), self.a))


def magnetic_pressure(g: SurfaceGeometry, Br: Array, Ba: Array, h: float | Array) -> Array:
    """p_mag = h b0:B0 with B0 = -Br (x) Ba, (...)."""
    b = np.einsum("...ab,...ai,...bj->...ij", g.b0, g.dual, g.dual)
    return np.asarray(-h * np.einsum("...ij,...i,j->...", b, Br, Ba))


def in_plane_force(g: SurfaceGeometry, Br: Array, Ba: Array, h: float) -> Array:
    """f_mag (..., 3) for uniform Br and Ba.

    f_c is -h times the surface divergence of -(a_c . Ba)(a^a . Br). For constant vectors this equals
    h [b_ca (n . Ba)(a^a . Br) + tr b (n . Br)(a_c . Ba)].
    """
    dual = g.dual
    along, normal_Ba = np.einsum("...ai,...i->...a", dual, Br), np.einsum("...i,i->...", g.n0, Ba)
    trace = np.einsum("...ab,...ai,...bi->...", g.b0, dual, dual)
    covariant = np.einsum("...ca,...a->...c", g.b0, along) * normal_Ba[..., None]
    covariant += (trace * np.einsum("...i,...i->...", g.n0, Br))[..., None] * np.einsum("...ci,i->...c", g.a, Ba)
    return np.asarray(h * np.einsum("...c,...ci->...i", covariant, dual))


def spring_stiffness(g: SurfaceGeometry, Br: Array, Ba: Array) -> Array:
    """k = (n0 (x) n0):B0, (...)."""
    return np.asarray(-np.einsum("...i,...i->...", g.n0, Br) * np.einsum("...i,i->...", g.n0, Ba))


@dataclass(frozen=True)
class Torque:
    """The torque tau at points with normals n0 (..., 3); `along` is -(n0 . Br)(a0^a . Ba), (..., 2).

    For a remanence that does not stretch, that and half of (n0 . Ba)(a0^a . Br); `dual` and `transposed` are then the
    dual basis (..., 2, 3) and half of (n0 . Ba) Br, (..., 3).
    """

    n0: Array
    along: Array
    dual: Array | None = None
    transposed: Array | None = None

    def __call__(self, du: Array) -> Array:
        """tau_c = B0^ij (a0^a . e_j)(n0 . e_i) (u,_a . a0_c) as a vector (..., 3), from u,_1 and u,_2 (..., 2, 3)."""
        turned = np.matmul(self.along[..., None, :], du)[..., 0, :]
        found = turned - np.sum(turned * self.n0, axis=-1, keepdims=True) * self.n0
        if self.dual is not None and self.transposed is not None:
            found = found + np.einsum("...ac,...c,...ai->...i", du, self.transposed, self.dual)
        return np.asarray(found)


def torque(g: SurfaceGeometry, Br: Array, Ba: Array, *, rotates: bool = False) -> Torque:
    """The torque as a function of the displacement's derivatives, of a remanence that `rotates` or is convected."""
    along = -np.einsum("...i,...i->...", g.n0, Br)[..., None] * np.einsum("...ai,i->...a", g.dual, Ba)
    if not rotates:
        return Torque(g.n0, along)
    in_surface = Br - np.einsum("...i,...i->...", g.n0, Br)[..., None] * g.n0
    half = (g.n0 @ Ba / 2)[..., None]
    along = along + half * np.einsum("...ai,...i->...a", g.dual, Br)
    return Torque(g.n0, along, g.dual, half * in_surface)
