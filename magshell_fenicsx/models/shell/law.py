"""The law of a thin shell's material: energies, stresses and moments as functions of strains.

Energies are over E h per undeformed area, lengths over R. E is the membrane strain and K the change
of curvature, (..., 2, 2) in coordinates of the surface; `up` is the inverse metric of the shape
without stress. Every formula is one of components, so that it holds for an expression of UFL at a
point and for arrays of NumPy over many points.

- S is the membrane stress and M the moment: the derivatives of the energy by E and K.
- "Index up" and "index down" are contravariant and covariant components.
- A covector c (2,) at an edge is its unit conormal; K_cc = K_ij c^i c^j is the curvature across it.
- The numbers of a law, in a fixed order, become parameters of the densities.
- A side is one of the cells beside a point: two on an interior edge, else one.

A law that is none of rubber with an energy of invariants (`rubber.Rubber`) is a subclass of `Law`.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING, Any, Self, TypeAlias

import numpy as np

from magshell_fenicsx.models.strain_energy import Scalar, is_expression
from magshell_fenicsx.platform.lazy_import import lazy_import

if TYPE_CHECKING:
    import ufl
else:
    ufl = lazy_import("ufl")

Tensor: TypeAlias = Any  # an expression (2, 2), or an array (..., 2, 2)
Components: TypeAlias = tuple[
    Scalar, Scalar, Scalar
]  # 11, 12 and 22 of a symmetric tensor with indices up


@dataclass(frozen=True)
class Law(ABC):
    """The law of a material, as energies, edges, pictures and motions use it.

    The numbers of a law, which become parameters of the densities, are its fields that are given by
    position.

    Attributes
    ----------
    h
        The thickness over R by which energies are divided.
    thickness_factor
        Factor of the thickness.
    modulus_factor
        Factor of Young's modulus.
    thins
        1 where the thickness follows from the area, so that the volume stays; else 0.
    depends_on_place
        Whether directions of the law depend on the place itself.
    """

    h: Scalar
    thickness_factor: Scalar = field(default=1, kw_only=True)
    modulus_factor: Scalar = field(default=1, kw_only=True)

    @property
    def thins(self) -> Scalar:
        return 0

    @property
    def thins_somewhere(self) -> bool:
        """Whether the thickness follows from the area anywhere."""
        return bool(self.thins)

    @property
    def numbers(self) -> tuple[Any, ...]:
        """The law's numbers in a fixed order, without `thickness_factor` and `modulus_factor`.

        They become parameters of the densities; some laws have vectors among them.
        """
        return tuple(getattr(self, name) for name in self._names_of_numbers)

    def with_numbers(self, *numbers: Any) -> Self:
        """Return the law with other numbers, in the order of `numbers`.

        Its `thickness_factor` and `modulus_factor` are 1.
        """
        by_name = dict(zip(self._names_of_numbers, numbers, strict=True))
        return replace(self, thickness_factor=1, modulus_factor=1, **by_name)

    @property
    def _names_of_numbers(self) -> list[str]:
        return [number.name for number in fields(self) if not number.kw_only]

    @property
    def depends_on_place(self) -> bool:
        return False

    def at_point(self, r: Any, a1: Any, a2: Any, n: Any) -> Self:
        """Return the law at a point of the undeformed surface, where plies have their directions.

        r (..., 3) is the place, a1 and a2 are the tangents, n is a normal of any length.
        """
        return self

    def thicker(self, factor: Scalar) -> Self:
        """Return the law of a shell whose thickness is multiplied by a factor."""
        return replace(self, thickness_factor=factor * self.thickness_factor)

    def with_material(self, modulus_factor: Scalar, nu: Scalar, shell_number: Scalar = 0) -> Self:
        """Return the law with another material.

        Young's modulus is multiplied by a factor; nu replaces Poisson's ratio where the law has
        one, and is ignored here. `shell_number` selects a law of a `LawByShell`; a single law
        ignores it.
        """
        return replace(self, modulus_factor=modulus_factor * self.modulus_factor)

    @property
    def linear(self) -> "Law":
        """The law at small strains."""
        return self

    @property
    def bending_stiffness(self) -> Scalar:
        """D/(E h R^2) at small strains."""
        return self.linear.bending_stiffness

    @abstractmethod
    def membrane(self, E: Tensor, up: Tensor) -> Scalar:
        """Return the energy of stretching."""

    @abstractmethod
    def bending(self, E: Tensor, K: Tensor, up: Tensor) -> Scalar:
        """Return the energy of bending, quadratic in K."""

    @abstractmethod
    def stress(self, E: Tensor, up: Tensor) -> Components:
        """Return the derivative of `membrane` by E."""

    def force(self, E: Tensor, K: Tensor, up: Tensor) -> Components:
        """Return the membrane force: the stress and what coupled bending adds to it.

        It is the derivative of `membrane` and, where the plies couple both, of `bending` by E.
        """
        return self.stress(E, up)

    def stress_change(self, E: Tensor, change: Tensor, up: Tensor) -> Components:
        """Return the difference of the stress at E + change and the stress at E."""
        if self.linear is self:  # the stress is linear in E
            return self.stress(change, up)
        stress, changed_stress = self.stress(E, up), self.stress(E + change, up)
        S11, S12, S22 = (b - a for a, b in zip(stress, changed_stress, strict=True))
        return S11, S12, S22

    @abstractmethod
    def moment(self, E: Tensor, K: Tensor, up: Tensor) -> Components:
        """Return the derivative of `bending` by K."""

    @abstractmethod
    def edge_moment(
        self,
        E: Tensor,
        K: Tensor,
        up: Tensor,
        covector_up: tuple[Scalar, Scalar],
        covector_square: Scalar,
    ) -> Scalar:
        """Return M^ij c_i c_j, the moment contracted twice with a covector c.

        With the unit conormal of an edge as c it is the bending moment across the edge.

        Parameters
        ----------
        E, K
            Membrane strain and change of curvature.
        up
            Inverse metric of the shape without stress.
        covector_up, covector_square
            The components c^i, and the square c^i c_i. The square is 1 for a unit conormal; in the
            metric of a naturally stretched shape it differs from 1.
        """

    @abstractmethod
    def edge_stiffness(
        self, E: Tensor, up: Tensor, covector_up: tuple[Scalar, Scalar], covector_square: Scalar
    ) -> Scalar:
        """Return the stiffness by which K_cc enters `edge_moment`, for the penalty of edges.

        It is the derivative of the moment by K, contracted with c four times. Parameters are those
        of `edge_moment`.
        """


@dataclass(frozen=True)
class Koiter(Law):
    """Koiter's law: stress is linear in strain, stretching and bending are independent.

    Attributes
    ----------
    nu
        Poisson's ratio.
    """

    nu: Scalar

    def with_material(
        self, modulus_factor: Scalar, nu: Scalar, shell_number: Scalar = 0
    ) -> "Koiter":
        return replace(self, modulus_factor=modulus_factor * self.modulus_factor, nu=nu)

    @property
    def bending_stiffness(self) -> Scalar:
        return self.modulus_factor * self.thickness_factor**3 * self.h**2 / (12 * (1 - self.nu**2))

    def membrane(self, E: Tensor, up: Tensor) -> Scalar:
        """Return S : E/2 = ((1 - nu) E : E + nu tr² E)/(2 (1 - nu²)), times factors."""
        return (
            self.modulus_factor
            * self.thickness_factor
            * self._square(E, up)
            / (2 * (1 - self.nu**2))
        )

    def bending(self, E: Tensor, K: Tensor, up: Tensor) -> Scalar:
        return self.bending_stiffness / 2 * self._square(K, up)

    def stress(self, E: Tensor, up: Tensor) -> Components:
        return self._scaled(self.modulus_factor * self.thickness_factor / (1 - self.nu**2), E, up)

    def moment(self, E: Tensor, K: Tensor, up: Tensor) -> Components:
        return self._scaled(self.bending_stiffness, K, up)

    def edge_moment(
        self,
        E: Tensor,
        K: Tensor,
        up: Tensor,
        covector_up: tuple[Scalar, Scalar],
        covector_square: Scalar,
    ) -> Scalar:
        """Return D ((1 - nu) K_cc + nu c² tr K): the moment contracted twice with the covector c.

        D is the bending stiffness, K_cc = K_ij c^i c^j and c² the square of c.
        """
        curvature_across = (
            K[..., 0, 0] * covector_up[0] ** 2
            + 2 * K[..., 0, 1] * covector_up[0] * covector_up[1]
            + K[..., 1, 1] * covector_up[1] ** 2
        )
        return self.bending_stiffness * (
            (1 - self.nu) * curvature_across + self.nu * covector_square * trace(K, up)
        )

    def edge_stiffness(
        self, E: Tensor, up: Tensor, covector_up: tuple[Scalar, Scalar], covector_square: Scalar
    ) -> Scalar:
        return self.bending_stiffness * covector_square**2

    def _square(self, S: Tensor, up: Tensor) -> Scalar:
        """Return (1 - nu) S:S + nu tr^2 S."""
        T11, T12, T21, T22 = _mixed(S, up)
        return (1 - self.nu) * (T11**2 + 2 * T12 * T21 + T22**2) + self.nu * (T11 + T22) ** 2

    def _scaled(self, factor: Scalar, S: Tensor, up: Tensor) -> Components:
        """Return components of factor ((1 - nu) S^ij + nu tr S a^ij), from S with indices down."""
        T11, T12, T21, T22 = _mixed(S, up)
        a11, a12, a22 = up[..., 0, 0], up[..., 0, 1], up[..., 1, 1]
        raised_components = (T11 * a11 + T12 * a12, T11 * a12 + T12 * a22, T21 * a12 + T22 * a22)
        S11, S12, S22 = (
            factor * ((1 - self.nu) * component + self.nu * (T11 + T22) * a)
            for component, a in zip(raised_components, (a11, a12, a22), strict=True)
        )
        return S11, S12, S22


@dataclass(frozen=True)
class LawByShell(Law):
    """The laws of several shells in one model; `shell_number` says which holds at a place.

    Energies of all shells are over E h of the first one.

    Attributes
    ----------
    laws
        At least two, with the same h.
    shell_number
        The number of the law at a place: a number, an expression or an array.
    """

    laws: tuple[Law, ...] = field(default=(), kw_only=True)
    shell_number: Scalar = field(default=0, kw_only=True)

    @property
    def numbers(self) -> tuple[Any, ...]:
        return tuple(number for law in self.laws for number in law.numbers)

    def with_numbers(self, *numbers: Any) -> Self:
        """Return the laws with other numbers: first all numbers of the first law, and so on."""
        remaining_numbers, laws = list(numbers), list[Law]()
        for law in self.laws:
            count = len(law.numbers)
            laws.append(law.with_numbers(*remaining_numbers[:count]))
            del remaining_numbers[:count]
        return replace(self, laws=tuple(laws))

    @property
    def thins(self) -> Scalar:
        return self._value_at_place([law.thins for law in self.laws])

    @property
    def thins_somewhere(self) -> bool:
        return any(law.thins_somewhere for law in self.laws)

    @property
    def depends_on_place(self) -> bool:
        return any(law.depends_on_place for law in self.laws)

    def at_point(self, r: Any, a1: Any, a2: Any, n: Any) -> Self:
        return self._with_each_law(lambda law: law.at_point(r, a1, a2, n))

    def thicker(self, factor: Scalar) -> Self:
        return self._with_each_law(lambda law: law.thicker(factor))

    def with_material(self, modulus_factor: Scalar, nu: Scalar, shell_number: Scalar = 0) -> Self:
        return replace(
            self._with_each_law(lambda law: law.with_material(modulus_factor, nu)),
            shell_number=shell_number,
        )

    @property
    def linear(self) -> "LawByShell":
        if all(law.linear is law for law in self.laws):
            return self
        return self._with_each_law(lambda law: law.linear)

    @property
    def bending_stiffness(self) -> Scalar:
        return self.laws[0].bending_stiffness

    def membrane(self, E: Tensor, up: Tensor) -> Scalar:
        return self._value_at_place([law.membrane(E, up) for law in self.laws])

    def bending(self, E: Tensor, K: Tensor, up: Tensor) -> Scalar:
        return self._value_at_place([law.bending(E, K, up) for law in self.laws])

    def stress(self, E: Tensor, up: Tensor) -> Components:
        S11, S12, S22 = map(
            self._value_at_place, zip(*(law.stress(E, up) for law in self.laws), strict=True)
        )
        return S11, S12, S22

    def force(self, E: Tensor, K: Tensor, up: Tensor) -> Components:
        N11, N12, N22 = map(
            self._value_at_place, zip(*(law.force(E, K, up) for law in self.laws), strict=True)
        )
        return N11, N12, N22

    def moment(self, E: Tensor, K: Tensor, up: Tensor) -> Components:
        M11, M12, M22 = map(
            self._value_at_place, zip(*(law.moment(E, K, up) for law in self.laws), strict=True)
        )
        return M11, M12, M22

    def edge_moment(
        self,
        E: Tensor,
        K: Tensor,
        up: Tensor,
        covector_up: tuple[Scalar, Scalar],
        covector_square: Scalar,
    ) -> Scalar:
        """Return M^ij c_i c_j by the law of the shell at the place."""
        return self._value_at_place(
            [law.edge_moment(E, K, up, covector_up, covector_square) for law in self.laws]
        )

    def edge_stiffness(
        self, E: Tensor, up: Tensor, covector_up: tuple[Scalar, Scalar], covector_square: Scalar
    ) -> Scalar:
        """Return the stiffness by which K_cc enters `edge_moment`, by the law at the place."""
        return self._value_at_place(
            [law.edge_stiffness(E, up, covector_up, covector_square) for law in self.laws]
        )

    def _with_each_law(self, change: Callable[[Law], Law]) -> Self:
        return replace(self, laws=tuple(change(law) for law in self.laws))

    def _value_at_place(self, values: Sequence[Scalar]) -> Scalar:
        """Return the value of the law with the number `shell_number`, from the values of all laws.

        An expression of UFL selects by conditionals, a number or an array by NumPy.
        """
        value_at_place = values[0]
        # shell numbers are integers in floating point: above i + 1/2 counts as i + 1 or more
        for i, value in enumerate(values[1:]):
            if is_expression(self.shell_number):
                value_at_place = ufl.conditional(
                    ufl.gt(self.shell_number, i + 0.5), value, value_at_place
                )
            else:
                value_at_place = np.where(
                    np.asarray(self.shell_number) > i + 0.5, value, value_at_place
                )
        return value_at_place


def _mixed(S: Tensor, up: Tensor) -> tuple[Scalar, Scalar, Scalar, Scalar]:
    """Return the mixed components S^i_j = a^ik S_kj, in the order 11, 12, 21, 22.

    a^ij is the inverse metric `up`.
    """
    S11, S12, S22 = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    a11, a12, a22 = up[..., 0, 0], up[..., 0, 1], up[..., 1, 1]
    return (
        a11 * S11 + a12 * S12,
        a11 * S12 + a12 * S22,
        a12 * S11 + a22 * S12,
        a12 * S12 + a22 * S22,
    )


def trace(S: Tensor, up: Tensor) -> Scalar:
    """Return S^i_i."""
    return (
        up[..., 0, 0] * S[..., 0, 0]
        + 2 * up[..., 0, 1] * S[..., 0, 1]
        + up[..., 1, 1] * S[..., 1, 1]
    )


def lower_index(covector_up: tuple[Scalar, Scalar], up: Tensor) -> tuple[Scalar, Scalar]:
    """Return the components c_i of a covector with index down, from c^i with index up.

    `up` is the inverse metric a^ij (2, 2), which is inverted here: c_i = a_ij c^j.
    """
    a11, a12, a22 = up[..., 0, 0], up[..., 0, 1], up[..., 1, 1]
    det = a11 * a22 - a12**2
    first = (a22 * covector_up[0] - a12 * covector_up[1]) / det
    second = (a11 * covector_up[1] - a12 * covector_up[0]) / det
    return first, second


def work(S: Components, T: Tensor) -> Scalar:
    """Return S:T of a stress or a moment S, with indices up, on a strain T."""
    return S[0] * T[..., 0, 0] + 2 * S[1] * T[..., 0, 1] + S[2] * T[..., 1, 1]
