"""A potential Pi(u) with its amplitude: energy, residual and tangent."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.following import PointField
from magshell_fenicsx.assembly.kernels import Derived, KernelLog, itself
from magshell_fenicsx.platform import compat

Density = TypeVar("Density")  # the type of a form's density


class Term(Protocol):
    """A summand of a problem; `amplitude` is the name of mu in mu Pi(u), or None for mu = 1."""

    @property
    def name(self) -> str: ...

    @property
    def amplitude(self) -> str | None: ...

    @property
    def group(self) -> str:
        """What its energy is reported with: that of all parts of one field."""

    @property
    def column(self) -> str:
        """The column of a path with its energy: stretching, bending or magnetic; "" without one."""

    def energy(self) -> float:
        """Pi(u) on this rank's part."""

    def compile_residual(self) -> None:
        """Compile the forms of `energy` and `add_residual`."""

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None:
        """Add factor dPi/du to the local vector (ghosts included)."""

    def compile_tangent(self) -> None:
        """Compile the form of `add_tangent`."""

    def add_tangent(self, K: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """Add factor d2Pi/du2."""


def factor_of(amplitude: str | None, mu: Mapping[str, float]) -> float:
    """What multiplies the energy of a term or slope with this amplitude."""
    return 1.0 if amplitude is None else mu[amplitude]


class FormTerm:
    """A potential given by its UFL energy; both derivatives are automatic.

    `linear` says that the energy is linear in u, so that it has no tangent; `over` is an integral
    that a linear one has been divided by.

    A load may have no potential. Then `work`, its virtual work, takes the place of the energy's
    gradient, and the energy is only reported. The derivative of the work is no symmetric form.

    Attributes
    ----------
    form
        The energy.
    energy_form, residual_form, tangent_form
        Compiled on first use, on all ranks; None for the tangent of a linear energy.
    skew_form
        What the symmetric tangent lacks; None for a potential.
    """

    def __init__(
        self,
        name: str,
        energy: ufl.Form,
        u: fem.Function,
        log: KernelLog,
        amplitude: str | None = None,
        *,
        linear: bool = False,
        work: ufl.Form | None = None,
        over: ufl.Form | None = None,
    ) -> None:
        self.name, self.amplitude, self.linear, self.over = name, amplitude, linear, over
        self.group, self.column = name, ""
        self.has_potential = work is None
        self._factor = fem.Constant(u.function_space.mesh, 1.0)
        self._u, self._log = u, log
        self.form, self._work = energy, work

    @cached_property
    def _gradient(self) -> ufl.Form:
        if self._work is not None:
            return self._work
        return ufl.derivative(self.form, self._u, ufl.TestFunction(self._u.function_space))

    @cached_property
    def energy_form(self) -> fem.Form:
        return self._energy()

    @cached_property
    def residual_form(self) -> fem.Form:
        return self._residual()

    @cached_property
    def tangent_form(self) -> fem.Form | None:
        return self._tangent() if self._tangent else None

    @cached_property
    def _energy(self) -> Callable[[], fem.Form]:
        return self._log.begin(f"{self.name} energy", itself(self.form))

    @cached_property
    def _residual(self) -> Callable[[], fem.Form]:
        return self._begin("residual", lambda: self._factor * self._gradient)

    @cached_property
    def _tangent(self) -> Callable[[], fem.Form] | None:
        return (
            None if self.linear else self._begin("tangent", lambda: self._factor * self._symmetric)
        )

    @cached_property
    def skew_form(self) -> fem.Form | None:
        if self.has_potential:
            return None

        def skew() -> ufl.Form:
            hessian = self._hessian
            return self._factor / 2 * (hessian - ufl.adjoint(hessian))

        return self._begin("skew tangent", skew)()

    def _begin(self, what: str, make: Callable[[], ufl.Form]) -> Callable[[], fem.Form]:
        of = self.form if self._work is None else self._work
        how = what if self._work is None else f"{what} of work"
        return self._log.begin(
            f"{self.name} {what}", Derived(of, how, make, self._u, (self._factor,))
        )

    @property
    def _symmetric(self) -> ufl.Form:
        hessian = self._hessian
        return hessian if self.has_potential else 0.5 * (hessian + ufl.adjoint(hessian))

    @property
    def _hessian(self) -> ufl.Form:
        return ufl.derivative(self._gradient, self._u, ufl.TrialFunction(self._u.function_space))

    @cached_property
    def _fields(self) -> list[PointField]:
        """Coefficients that follow the displacement."""
        return [field for field in self.form.coefficients() if isinstance(field, PointField)]

    def renew(self) -> None:
        """Renew the coefficients of the forms, which assembly takes as they are."""
        for field in self._fields:
            field.renew()

    def energy(self) -> float:
        self.renew()
        return float(fem.assemble_scalar(self.energy_form))

    def compile_residual(self) -> None:
        _ = self._energy, self._residual

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None:
        self.renew()
        self._factor.value = factor
        fem.assemble_vector(b, self.residual_form)

    def compile_tangent(self) -> None:
        _ = self._tangent

    def add_tangent(self, K: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        if self.tangent_form is not None:
            self.renew()
            self._factor.value = factor
            compat.add_matrix(K, self.tangent_form, clamped)

    def add_skew(self, N: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """Add factor times the skew part of the derivative of the work, of a load without
        potential.
        """
        self.renew()
        self._factor.value = factor
        compat.add_matrix(N, self.skew_form, clamped)


class Counted(FormTerm):
    """-Pi = intensity times the angle of an edge, integrated; the angle goes on beyond half a turn.

    Derivatives know no turns. The energy is that of the angle nearest to `value`, an angle that
    stands in the state, so that it is a function of the state.
    """

    def count_from(self, past: fem.Constant, whole: float) -> None:
        """Count the turns.

        Parameters
        ----------
        past
            Cosine and sine of the turn that the angle is counted from; see `edges.turning`.
        whole
            Intensity times the edge's length: -Pi of one radian.
        """
        self._past, self._whole, self._comm = past, whole, self._u.function_space.mesh.comm
        self._turned = 0.0

    @property
    def turn(self) -> str:
        """Name of `value` in a state; no user's name has a space."""
        return f"turn of {self.name}"

    @property
    def value(self) -> float:
        """The angle (rad) that turns are counted from; the mean angle of the edge is within pi of
        it.
        """
        return self._turned

    @value.setter
    def value(self, turned: float) -> None:
        if turned != self._turned:
            self._turned, self._past.value = turned, np.array([np.cos(turned), np.sin(turned)])

    def energy(self) -> float:
        return super().energy() - (self._turned * self._whole if self._comm.rank == 0 else 0.0)

    def angle(self) -> float:
        """The mean angle of the edge at the present u; collective."""
        return -float(self._comm.allreduce(self.energy())) / self._whole


class DensityTerm(FormTerm, Generic[Density]):
    """A form that keeps its density."""

    def __init__(
        self,
        name: str,
        density: Density,
        energy: ufl.Form,
        u: fem.Function,
        log: KernelLog,
        amplitude: str | None = None,
        *,
        linear: bool = False,
        work: ufl.Form | None = None,
    ) -> None:
        super().__init__(name, energy, u, log, amplitude, linear=linear, work=work)
        self.density = density


class LinearTerm:
    """A dead load, Pi(u) = -l . u: `entries` of l at local, owned degrees of freedom.

    `forms` are those of its parts that depend on the placement.
    """

    def __init__(
        self,
        name: str,
        dofs: NDArray[np.int32],
        entries: NDArray[np.float64],
        u: fem.Function,
        amplitude: str,
        forms: Sequence[FormTerm] = (),
    ) -> None:
        self.name, self.amplitude, self.forms = name, amplitude, forms
        self.group, self.column = name, ""
        self._dofs, self._entries, self._u = dofs, entries, u

    def energy(self) -> float:
        return -float(self._entries @ self._u.x.array[self._dofs])

    def compile_residual(self) -> None:
        """A sum of entries."""

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None:
        b[self._dofs] -= factor * self._entries

    def compile_tangent(self) -> None:
        """A dead load has no tangent."""

    def add_tangent(self, K: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """A dead load has no tangent."""


class TangentAssembler(Protocol):
    """Computes the tangent without the terms' forms."""

    def tangent(
        self, factors: Mapping[str, float], stress: Sequence[tuple[float, NDArray[np.float64]]] = ()
    ) -> PETSc.Mat:
        """The matrix of the terms with these factors, by name, at the present u.

        `stress` is that of `System.tangent`, of displacements with ghosts.
        """

    def times(self, v: NDArray[np.float64], factors: Mapping[str, float]) -> NDArray[np.float64]:
        """This rank's part of the matrix without supports times a vector with ghosts, exact where
        nodes move.
        """


class ResidualAssembler(Protocol):
    """Computes the residual of some terms without their forms.

    Attributes
    ----------
    names
        Names of these terms.
    """

    names: frozenset[str]

    def add(self, b: NDArray[np.float64], factors: Mapping[str, float]) -> None:
        """Add the gradients of the terms with these factors, by name, at the present u."""
