"""The law of a laminate: Koiter's energies with stiffnesses A, B and D of plies.

With z along the normal the layer at z has the strain E - z K, so that the energy per area is (E : A
: E - 2 E : B : K + K : D : K)/2. A, B and D are the integrals of 1, z and z^2 times the stiffness
of the plies (R. M. Jones, *Mechanics of Composite Materials*, 1999, chapter 4). E h, E h^2 and E
h^3 are taken out.

- E is the membrane strain, K the change of curvature, S the stress and M the moment; `up` is the
  inverse metric of the shape without stress.
- The components 11, 12, 22, 16, 26, 66 of a stiffness are those of its matrix by (11, 22, 12), in
  Voigt's notation: 6 stands for the shear.
- The angle 0 is the direction from which the angles of plies are counted. It is given by a vector,
  or runs along the meridians about an axis.
- "Index up" and "index down" are contravariant and covariant components.
- A covector c (2,) at an edge is its unit conormal.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Self, TypeAlias

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell.law import Components, Koiter, Law, Tensor, lower_index
from magshell_fenicsx.models.strain_energy import Scalar

Array = NDArray[np.float64]
DIRECTION_TOLERANCE = 1e-6  # of directions
Triple: TypeAlias = tuple[
    Scalar, Scalar, Scalar
]  # 11, 22 and 12 of a stress, or twice 12 of a strain
Stiffness: TypeAlias = Any  # 11, 12, 22, 16, 26, 66: numbers, or an expression (6,)


@dataclass(frozen=True)
class Laminate:
    """Stiffness and directions of a shell's plies.

    Attributes
    ----------
    matrices
        (3, 6) A, B, D, each as 11, 12, 22, 16, 26, 66.
    direction
        Direction of the angle 0 in the shell's frame; None for the meridians of its e3.
    isotropic
        Whether all directions are alike.
    axes, origin
        The shell's frame in that of the model: (3, 3) whose columns are its axes, and (3,).
    """

    matrices: Array = field(repr=False)
    direction: Array | None
    isotropic: bool = False
    axes: Array = field(default_factory=lambda: np.eye(3), repr=False)
    origin: Array = field(default_factory=lambda: np.zeros(3), repr=False)

    def refuse_normal(self, normals: Array, comm: MPI.Comm) -> None:
        """Refuse a direction that is normal to a whole cell; collective.

        `normals` are (cells, nodes, 3) in the frame of the model.

        Raises
        ------
        MeshError
            On every rank, for such a direction.
        """
        if self.direction is None or self.isotropic:
            return
        unit = self.axes @ self.direction / np.linalg.norm(self.direction)
        # length of the direction's part in the surface, at each node of each cell
        in_surface = np.linalg.norm(np.cross(normals, unit), axis=-1)
        # the least one of all cells, each by its largest
        least = comm.allreduce(float(in_surface.max(axis=1).min(initial=1.0)), MPI.MIN)
        if least < DIRECTION_TOLERANCE:
            raise MeshError(
                "shell.laminate.along: is normal to a part of the shell, where the angle 0 has no "
                "direction"
            )

    def mirrored(self, plane: Mirror) -> bool:
        """Return whether a plane of the model maps the directions of the plies to themselves.

        The angle 0 must be along or across the plane everywhere. Plies that couple stretching and
        twist are not looked at here.
        """
        plane_in_shell_frame = replace(
            plane,
            normal=plane.normal @ self.axes,
            offset=plane.offset - float(plane.normal @ self.origin),
        )
        return self.isotropic or plane_in_shell_frame.keeps_lines(self.direction)


@dataclass(frozen=True)
class Laminated(Law):
    """The law of a laminate.

    Attributes
    ----------
    nu
        Poisson's ratio with which the stiffness of the units is defined, no property of the plies.
    A, B, D
        Over E h, E h^2 and E h^3, each as 11, 12, 22, 16, 26, 66.
    axis
        Vector (3,): the angle 0 is along its part in the surface or, with `meridian`, along the
        meridians about it.
    origin
        A place (3,) on the axis of meridians.
    meridian
        Whether the angle 0 is along the meridians of `axis`.
    direction
        Components, with index down, of the angle 0 at a point, of any length; see `at_point`.
    """

    nu: Scalar
    A: Stiffness
    B: Stiffness
    D: Stiffness
    axis: Any
    origin: Any
    meridian: bool = field(default=False, kw_only=True)
    direction: tuple[Scalar, Scalar] = field(default=(1.0, 0.0), kw_only=True)

    @classmethod
    def from_laminate(cls, laminate: Laminate, h: float, nu: float) -> Self:
        """Return the law of plies with the thickness h over R.

        `nu` is the Poisson's ratio with which the stiffness of the units is defined, no property of
        the plies.
        """
        A, B, D = (tuple(map(float, S)) for S in laminate.matrices)
        direction, meridian = laminate.direction, laminate.direction is None
        # meridians are those about the shell's e3
        axis_in_model = laminate.axes @ (np.eye(3)[2] if direction is None else direction)
        axis, origin = tuple(map(float, axis_in_model)), tuple(map(float, laminate.origin))
        return cls(h, nu, A, B, D, axis, origin, meridian=meridian)

    @property
    def depends_on_place(self) -> bool:
        return self.meridian

    def at_point(self, r: Any, a1: Any, a2: Any, n: Any) -> Self:
        """Return the law with the direction of the angle 0 at a point of the undeformed surface.

        r (..., 3) is the place, a1 and a2 are the tangents, n is a normal of any length. The
        direction has the covariant components t . a1 and t . a2 of a vector t along it.
        """

        def dot(v: Any, a: Any) -> Scalar:
            """Return the scalar product of a vector (3,) with vectors (..., 3)."""
            return v[0] * a[..., 0] + v[1] * a[..., 1] + v[2] * a[..., 2]

        # t is the axis itself
        component_1, component_2 = (dot(self.axis, a) for a in (a1, a2))
        if self.meridian:
            # t = (axis x x) x n is along the meridian, with the place x from a point on the axis:
            # then t . a = (axis . n) (x . a) - (x . n) (axis . a)
            x = [r[..., i] - self.origin[i] for i in range(3)]
            component_1, component_2 = (
                dot(self.axis, n) * dot(x, a) - dot(x, n) * component
                for a, component in ((a1, component_1), (a2, component_2))
            )
        return replace(self, direction=(component_1, component_2))

    @property
    def bending_stiffness(self) -> Scalar:
        return Koiter(
            self.h,
            self.nu,
            thickness_factor=self.thickness_factor,
            modulus_factor=self.modulus_factor,
        ).bending_stiffness

    def membrane(self, E: Tensor, up: Tensor) -> Scalar:
        """Return E : A : E/2, the energy of stretching over E h per undeformed area."""
        strain = _Frame(self.direction, up).strain_components(E)
        return (
            self.modulus_factor * self.thickness_factor / 2 * _work(_stress(self.A, strain), strain)
        )

    def stress(self, E: Tensor, up: Tensor) -> Components:
        """Return S with indices up: A times the strain in the frame of the plies."""
        frame = _Frame(self.direction, up)
        return frame.components_up(
            self.modulus_factor * self.thickness_factor, _stress(self.A, frame.strain_components(E))
        )

    def force(self, E: Tensor, K: Tensor, up: Tensor) -> Components:
        """Return A times the strain less B times the change of curvature, with indices up."""
        frame = _Frame(self.direction, up)
        coupled = frame.components_up(
            self._coupling_factor, _stress(self.B, frame.strain_components(K))
        )
        N11, N12, N22 = (S - C for S, C in zip(self.stress(E, up), coupled, strict=True))
        return N11, N12, N22

    def bending(self, E: Tensor, K: Tensor, up: Tensor) -> Scalar:
        """Return K : D : K/2 - E : B : K, the energy of bending over E h per undeformed area.

        It has the coupling of unsymmetric plies too, by the layer strain E - z K.
        """
        frame = _Frame(self.direction, up)
        stretched, bent = frame.strain_components(E), frame.strain_components(K)
        bending_work = _work(_stress(self.D, bent), bent)
        coupling_work = _work(_stress(self.B, bent), stretched)
        return self._bending_factor / 2 * bending_work - self._coupling_factor * coupling_work

    def moment(self, E: Tensor, K: Tensor, up: Tensor) -> Components:
        frame = _Frame(self.direction, up)
        return frame.components_up(1, self._moment(frame, E, K))

    def edge_moment(
        self,
        E: Tensor,
        K: Tensor,
        up: Tensor,
        covector_up: tuple[Scalar, Scalar],
        covector_square: Scalar,
    ) -> Scalar:
        """Return the moment M^ij c_i c_j for a covector c, computed in the frame of the plies.

        `covector_square` is not used: plies have no trace term.
        """
        frame = _Frame(self.direction, up)
        return _work(self._moment(frame, E, K), frame.product(covector_up))

    def edge_stiffness(
        self, E: Tensor, up: Tensor, covector_up: tuple[Scalar, Scalar], covector_square: Scalar
    ) -> Scalar:
        """Return D contracted with the covector c four times; `covector_square` is not used."""
        bent = _Frame(self.direction, up).product(covector_up)
        return self._bending_factor * _work(_stress(self.D, bent), bent)

    @property
    def _coupling_factor(self) -> Scalar:
        return self.modulus_factor * self.h * self.thickness_factor**2

    @property
    def _bending_factor(self) -> Scalar:
        return self.modulus_factor * self.h**2 * self.thickness_factor**3

    def _moment(self, frame: "_Frame", E: Tensor, K: Tensor) -> Triple:
        """Return M_11, M_22, M_12 in the frame: D times K less B times E, with their factors."""
        bending_part = _stress(self.D, frame.strain_components(K))
        stretching_part = _stress(self.B, frame.strain_components(E))
        M1, M2, M6 = (
            self._bending_factor * bent - self._coupling_factor * stretched
            for bent, stretched in zip(bending_part, stretching_part, strict=True)
        )
        return M1, M2, M6


class _Frame:
    """Orthonormal vectors t1 along a direction and t2 = n x t1 in a surface.

    Parameters
    ----------
    direction
        Components (c_1, c_2) of the direction with index down, of any length.
    up
        Inverse metric; the vectors are orthonormal in its metric.

    Attributes
    ----------
    t1, t2
        Components of the two vectors with index up.
    """

    def __init__(self, direction: tuple[Scalar, Scalar], up: Tensor) -> None:
        """Normalise the direction in the metric, and find the vector normal to it."""
        (c1, c2), (a11, a12, a22) = direction, (up[..., 0, 0], up[..., 0, 1], up[..., 1, 1])
        direction_up = a11 * c1 + a12 * c2, a12 * c1 + a22 * c2
        inverse_length = (c1 * direction_up[0] + c2 * direction_up[1]) ** -0.5
        det = a11 * a22 - a12**2
        self._up = up
        self.t1 = direction_up[0] * inverse_length, direction_up[1] * inverse_length
        # the vector normal to the covector c is (-c_2, c_1), times the root of the determinant
        self.t2 = -(det**0.5) * c2 * inverse_length, det**0.5 * c1 * inverse_length

    def strain_components(self, S: Tensor) -> Triple:
        """Return S_11, S_22 and 2 S_12 in the frame, of a strain S with indices down.

        The shear is doubled, as in Voigt's notation.
        """

        def component(a: tuple[Scalar, Scalar], b: tuple[Scalar, Scalar]) -> Scalar:
            """Return S_ij a^i b^j."""
            mixed = a[0] * b[1] + a[1] * b[0]
            return S[..., 0, 0] * a[0] * b[0] + S[..., 0, 1] * mixed + S[..., 1, 1] * a[1] * b[1]

        return (
            component(self.t1, self.t1),
            component(self.t2, self.t2),
            2 * component(self.t1, self.t2),
        )

    def product(self, covector_up: tuple[Scalar, Scalar]) -> Triple:
        """Return the components 11, 22 and 2 * 12, in the frame, of the tensor c (x) c.

        `covector_up` are the components of the covector c with index up.
        """
        c = lower_index(covector_up, self._up)
        c_1, c_2 = (t[0] * c[0] + t[1] * c[1] for t in (self.t1, self.t2))
        return c_1**2, c_2**2, 2 * c_1 * c_2

    def components_up(self, factor: Scalar, S: Triple) -> Components:
        """Return a factor times a stress, as components 11, 12, 22 with indices up.

        The stress S is given by its components 11, 22, 12 in the frame.
        """
        (a1, a2), (b1, b2), (S1, S2, S6) = self.t1, self.t2, S
        S11 = S1 * a1**2 + S2 * b1**2 + 2 * S6 * a1 * b1
        S12 = S1 * a1 * a2 + S2 * b1 * b2 + S6 * (a1 * b2 + a2 * b1)
        S22 = S1 * a2**2 + S2 * b2**2 + 2 * S6 * a2 * b2
        return factor * S11, factor * S12, factor * S22


def _stress(Q: Stiffness, e: Triple) -> Triple:
    """Return S_11, S_22, S_12 of a strain e_11, e_22, 2 e_12, by a stiffness Q."""
    return (
        Q[0] * e[0] + Q[1] * e[1] + Q[3] * e[2],
        Q[1] * e[0] + Q[2] * e[1] + Q[4] * e[2],
        Q[3] * e[0] + Q[4] * e[1] + Q[5] * e[2],
    )


def _work(S: Triple, e: Triple) -> Scalar:
    return S[0] * e[0] + S[1] * e[1] + S[2] * e[2]
