"""Energy terms: a potential Pi(u) with its amplitude, its energy, residual and tangent.

The potential of a system is the sum of mu Pi(u) over its terms; mu is an amplitude (load parameter)
by name, or 1. Residual and tangent are the first and second derivative by u; a dead load has no
tangent. A form is an integral in UFL, whose kernel the log requests and compiles on first use. A
load without potential has a virtual work in place of an energy. Each rank computes its own part of
a sum.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc
from ufl.form import BaseForm

from magshell_fenicsx.assembly.kernels import DerivedForm, KernelLog, underived
from magshell_fenicsx.assembly.memo import PointField
from magshell_fenicsx.platform import compat

Density = TypeVar("Density")  # the type of a form's density


class Term(Protocol):
    """A summand mu Pi(u) of the potential; mu = 1 where `amplitude` is None.

    Its methods see the displacement u in the forms of the system.
    """

    @property
    def name(self) -> str: ...

    @property
    def amplitude(self) -> str | None:
        """Name of the amplitude mu; None: the term has the factor 1."""

    @property
    def group(self) -> str:
        """Name of the group of terms whose energies are reported as one sum."""

    @property
    def column(self) -> str:
        """Column of a path with its energy: stretching, bending or magnetic; "" without one."""

    def energy(self) -> float:
        """Return Pi(u), this rank's part."""

    def compile_residual(self) -> None:
        """Compile the forms of `energy` and `add_residual`."""

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None:
        """Add factor dPi/du to the local vector (ghosts included)."""

    def compile_tangent(self) -> None:
        """Compile the form of `add_tangent`."""

    def add_tangent(self, K: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """Add factor d2Pi/du2 to K, without rows and columns of clamped unknowns."""


def factor_of(amplitude: str | None, mu: Mapping[str, float]) -> float:
    """Return the factor of the energy of a term or slope: the value of its amplitude, or 1."""
    return 1.0 if amplitude is None else mu[amplitude]


class FormTerm:
    """A potential given by its UFL energy; both derivatives are automatic.

    A load may have no potential. Then its virtual work takes the place of the energy's gradient,
    and the energy is only reported. The derivative of the work is no symmetric form.

    Parameters
    ----------
    name
        Name of the term.
    energy
        The form of Pi(u), or a function that returns it: terms that are evaluated at points need no
        form, and to write one takes long.
    u
        The displacement in the form.
    log
        Requests and counts the compiled kernels.
    amplitude
        Name of the factor mu; None: 1.
    linear
        Whether the energy is linear in u, so that it has no tangent.
    work
        The virtual work of a load without potential; None: the load has a potential.
    over
        An integral that a linear energy has been divided by; None: it has not been divided.

    Attributes
    ----------
    form
        The energy.
    energy_form, residual_form, tangent_form
        Compiled on first use, on all ranks; None for the tangent of a linear energy.
    skew_form
        The skew part that the symmetric tangent lacks; None for a potential.

    The private field `_factor` is a constant in all forms but that of the energy; it is set before
    each assembly. `_energy`, `_u` and `_work` are arguments of the constructor. To read
    `_requested_energy`, `_requested_residual` and `_requested_tangent` requests the compilation;
    they return the compiled forms.
    """

    def __init__(
        self,
        name: str,
        energy: ufl.Form | Callable[[], ufl.Form],
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
        self._energy, self._work = energy, work

    @cached_property
    def form(self) -> ufl.Form:
        return self._energy if isinstance(self._energy, BaseForm) else self._energy()

    @cached_property
    def _gradient(self) -> ufl.Form:
        """The gradient of the energy as a linear form, or the virtual work in its place."""
        if self._work is not None:
            return self._work
        return ufl.derivative(self.form, self._u, ufl.TestFunction(self._u.function_space))

    @cached_property
    def energy_form(self) -> fem.Form:
        return self._requested_energy()

    @cached_property
    def residual_form(self) -> fem.Form:
        return self._requested_residual()

    @cached_property
    def tangent_form(self) -> fem.Form | None:
        return self._requested_tangent() if self._requested_tangent else None

    @cached_property
    def _requested_energy(self) -> Callable[[], fem.Form]:
        return self._log.request_form(f"{self.name} energy", underived(self.form))

    @cached_property
    def _requested_residual(self) -> Callable[[], fem.Form]:
        return self._request("residual", lambda: self._factor * self._gradient)

    @cached_property
    def _requested_tangent(self) -> Callable[[], fem.Form] | None:
        if self.linear:
            return None
        return self._request("tangent", lambda: self._factor * self._symmetric_hessian)

    @cached_property
    def skew_form(self) -> fem.Form | None:
        """The compiled skew part of the derivative of the work; None for a potential."""
        if self.has_potential:
            return None

        def skew() -> ufl.Form:
            """Return half the difference of the derivative and its transpose."""
            hessian = self._hessian
            return self._factor / 2 * (hessian - ufl.adjoint(hessian))

        return self._request("skew tangent", skew)()

    def _request(self, kind: str, make: Callable[[], ufl.Form]) -> Callable[[], fem.Form]:
        """Request a form that is made of the energy, or of the work of a load without potential.

        Parameters
        ----------
        kind
            Name of the form, which tells it from others with the same origin.
        make
            Returns the form.

        Returns
        -------
        A function that returns the compiled form.
        """
        # the form under whose signature the compiled one is kept
        origin = self.form if self._work is None else self._work
        description = kind if self._work is None else f"{kind} of work"
        derived = DerivedForm(origin, description, make, self._u, (self._factor,))
        return self._log.request_form(f"{self.name} {kind}", derived)

    @property
    def _symmetric_hessian(self) -> ufl.Form:
        """The second derivative of the energy; for a work the symmetric part of its derivative."""
        hessian = self._hessian
        return hessian if self.has_potential else 0.5 * (hessian + ufl.adjoint(hessian))

    @property
    def _hessian(self) -> ufl.Form:
        return ufl.derivative(self._gradient, self._u, ufl.TrialFunction(self._u.function_space))

    @cached_property
    def _point_fields(self) -> list[PointField]:
        """Coefficients that are functions of the displacement."""
        return [field for field in self.form.coefficients() if isinstance(field, PointField)]

    def renew(self) -> None:
        """Renew the coefficients of the forms that are functions of u; assembly does not do so."""
        for field in self._point_fields:
            field.renew()

    def energy(self) -> float:
        """Return Pi(u), this rank's part."""
        self.renew()
        return float(fem.assemble_scalar(self.energy_form))

    def compile_residual(self) -> None:
        """Request the forms of energy and residual."""
        _ = self._requested_energy, self._requested_residual

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None:
        """Add factor dPi/du to the local vector (ghosts included)."""
        self.renew()
        self._factor.value = factor
        fem.assemble_vector(b, self.residual_form)

    def compile_tangent(self) -> None:
        """Request the form of the tangent."""
        _ = self._requested_tangent

    def add_tangent(self, K: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """Add factor d2Pi/du2, its symmetric part for a load without potential."""
        if self.tangent_form is not None:
            self.renew()
            self._factor.value = factor
            compat.add_matrix(K, self.tangent_form, clamped)

    def add_skew(self, N: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """Add factor times the skew part of the work's derivative, for a load without potential."""
        self.renew()
        self._factor.value = factor
        compat.add_matrix(N, self.skew_form, clamped)


class AngleTerm(FormTerm):
    """The potential of a moment at an edge: -Pi = intensity times the edge's angle, integrated.

    The angle goes on beyond half a turn, while forms know no turns. So the energy is that of the
    angle nearest to `value`, a reference angle that stands in the state: it is a function of the
    state.

    Private fields: `_reference_angle` is `value`, `_cosine_and_sine` the constant in the form that
    follows from it, `_moment` is -Pi of one radian.
    """

    def set_reference_turn(self, cosine_and_sine: fem.Constant, moment: float) -> None:
        """Set the reference angle to zero, and the numbers that the energy needs; call it once.

        Parameters
        ----------
        cosine_and_sine
            (2,): cosine and sine of the reference angle, a constant in the form, which measures
            angles from there.
        moment
            Intensity times the edge's length: -Pi of one radian.
        """
        self._cosine_and_sine, self._moment = cosine_and_sine, moment
        self._comm = self._u.function_space.mesh.comm
        self._reference_angle = 0.0

    @property
    def turn(self) -> str:
        """Name of `value` in a state; no user's name has a space."""
        return f"turn of {self.name}"

    @property
    def value(self) -> float:
        """The reference angle (rad); the mean angle of the edge is within pi of it."""
        return self._reference_angle

    @value.setter
    def value(self, angle: float) -> None:
        if angle != self._reference_angle:
            self._reference_angle = angle
            self._cosine_and_sine.value = np.array([np.cos(angle), np.sin(angle)])

    def energy(self) -> float:
        """Return Pi(u), this rank's part."""
        # the form has the angle beyond the reference; the rest counts once, on the first rank
        reference = self._reference_angle * self._moment if self._comm.rank == 0 else 0.0
        return super().energy() - reference

    def angle(self) -> float:
        """Return the mean angle (rad) of the edge at the present u; collective."""
        return -float(self._comm.allreduce(self.energy())) / self._moment


class DensityTerm(FormTerm, Generic[Density]):
    """A form term that keeps its density, from which point kernels are made.

    Parameters
    ----------
    density
        The density that the form integrates.
    """

    def __init__(
        self,
        name: str,
        density: Density,
        energy: ufl.Form | Callable[[], ufl.Form],
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
    """A dead load, Pi(u) = -l . u; a `Term` without a tangent.

    Parameters
    ----------
    name
        Name of the term.
    dofs
        Local, owned degrees of freedom.
    entries
        The load vector l there.
    u
        The displacement.
    amplitude
        Name of the amplitude of the load.
    forms
        Those parts of the load that depend on the placement, as terms.
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
        """Return Pi(u), this rank's part."""
        return -float(self._entries @ self._u.x.array[self._dofs])

    def compile_residual(self) -> None:
        """Do nothing: the residual is a sum of entries."""

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None:
        """Add factor dPi/du to the local vector."""
        b[self._dofs] -= factor * self._entries

    def compile_tangent(self) -> None:
        """Do nothing: a dead load has no tangent."""

    def add_tangent(self, K: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """Do nothing: a dead load has no tangent."""


class TangentAssembler(Protocol):
    """Computes the tangent without the terms' forms. All methods are collective."""

    def tangent(
        self, factors: Mapping[str, float], stress: Sequence[tuple[float, NDArray[np.float64]]] = ()
    ) -> PETSc.Mat:
        """Return the tangent of some terms at the present u, with the system's supports.

        Parameters
        ----------
        factors
            Term name -> factor of its tangent; others are left out.
        stress
            Weighted displacements, with ghosts, whose stress replaces that of u; empty: its own.
        """

    def times(self, v: NDArray[np.float64], factors: Mapping[str, float]) -> NDArray[np.float64]:
        """Return this rank's part of the tangent without supports times a vector with ghosts.

        It is exact where nodes move.

        Parameters
        ----------
        factors
            Term name -> factor of its tangent.
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
        """Add the gradients of terms at the present u to a local vector with ghosts.

        Parameters
        ----------
        factors
            Term name -> factor of its gradient.
        """
