"""The sum of terms on a finite-element space, as a system for the solvers."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from dolfinx.la import InsertMode
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.parameter import Parameter
from magshell_fenicsx.assembly.sliding import Constraint, Projection, Sliding
from magshell_fenicsx.assembly.terms import FormTerm, Term
from magshell_fenicsx.continuation.noise import Noise
from magshell_fenicsx.continuation.system import Amplitudes, Skewed, Vector, Weighted
from magshell_fenicsx.continuation.timing import Stopwatch
from magshell_fenicsx.platform import compat


class TangentAssembler(Protocol):
    """Computes the tangent without the terms' forms."""

    def tangent(
        self, factors: Mapping[str, float], stress: Sequence[tuple[float, NDArray[np.float64]]] = ()
    ) -> PETSc.Mat:
        """The matrix of the terms with these factors, by name, at the present u.

        `stress` is that of `System.tangent`, of displacements with ghosts.
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


class FiniteElementSystem:
    """Sum of terms for a displacement u with supports.

    Parameters
    ----------
    u
        The displacement in the terms' forms; it is overwritten.
    held
        Supports: where u, or a component of it in any direction, is zero.
    pattern
        The term with the widest coupling; it determines the sparsity of the tangent.
    length
        See `System`.
    assembler
        Computes the tangent with the same supports, instead of the terms' forms.
    gradients
        Computes the residual, instead of the terms' forms.
    parameters
        Free parameters of terms, by name.
    """

    def __init__(
        self,
        u: fem.Function,
        terms: Sequence[Term],
        held: Sequence[Constraint],
        pattern: FormTerm,
        length: float,
        assembler: TangentAssembler | None = None,
        gradients: ResidualAssembler | None = None,
        parameters: Mapping[str, Parameter] | None = None,
    ) -> None:
        V = u.function_space
        self.u, self.terms, self.length = u, terms, length
        self.clamped = clamped = [c for c in held if isinstance(c, fem.DirichletBC)]
        sliding = [c for c in held if isinstance(c, Sliding)]
        self.projection = Projection(V, sliding, clamped) if sliding else None
        self.parameters = parameters or {}
        self.coordinates = frozenset(self.parameters)
        self.comm = V.mesh.comm
        self.size = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
        self.dofs = V.dofmap.index_map.size_global * V.dofmap.index_map_bs
        self.assembly, self.noise = Stopwatch(), Noise.from_environment()
        fixed = [bc.dof_indices()[0] for bc in clamped]
        fixed_dofs = np.unique(np.concatenate(fixed)) if fixed else np.empty(0, dtype=np.int32)
        self._fixed = fixed_dofs[fixed_dofs < self.size]
        self._b = fem.Function(V)
        self._assembler, self.gradients = assembler, gradients
        self._N: PETSc.Mat | None = None
        self._own_residual = [t for t in terms if gradients is None or t.name not in gradients.names]
        for term in self._own_residual:
            term.compile_residual()
        if assembler is None:
            for term in terms:
                term.compile_tangent()
            self._K = fem_petsc.create_matrix(pattern.tangent_form)
            self._K.setOption(PETSc.Mat.Option.SYMMETRIC, True)

    def set(self, u: Vector) -> None:
        """Copy a displacement into the Function of the terms, which follow it."""
        self._copy(u)
        for term in self.terms:
            term.follow()

    def _copy(self, u: Vector) -> None:
        self.u.x.array[: self.size] = u
        self.u.x.scatter_forward()

    def _with_ghosts(self, u: Vector) -> NDArray[np.float64]:
        self._copy(u)
        return np.array(self.u.x.array)

    def held(self, u: Vector) -> Vector:
        """The displacement with zeros at the supports."""
        u = np.array(u)
        self._hold(u)
        return u

    def _hold(self, u: Vector) -> None:
        u[self._fixed] = 0
        if self.projection:
            self.projection.project(u)

    def place(self, mu: Amplitudes) -> None:
        """Set the free parameters of the terms."""
        for name, parameter in self.parameters.items():
            parameter.constant.value = mu[name]

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        self.place(mu)
        factors = {t.name: _factor(t, mu) for t in self.terms}
        if self.noise is None:
            return self._gradient(u, factors)
        first = self.u.function_space.dofmap.index_map.local_range[0] * self.u.function_space.dofmap.index_map_bs
        parts = [self._gradient(u, {name: factor}) for name, factor in factors.items()]
        return np.asarray(np.sum([self.noise.on_vector(part, first) for part in parts], axis=0))

    def load(self, u: Vector, mu: Amplitudes, name: str) -> Vector:
        self.place(mu)
        if name in self.parameters:
            slopes = self.parameters[name].slopes
            return self._gradient(u, {}, [(mu[amplitude], slope) for amplitude, slope in slopes.items()])
        return self._gradient(u, {t.name: 1.0 for t in self.terms if t.amplitude == name})

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        self.set(u)
        self.place(mu)
        if name in self.parameters:
            here = sum(mu[amplitude] * slope.energy() for amplitude, slope in self.parameters[name].slopes.items())
        else:
            here = sum(t.energy() for t in self.terms if t.amplitude == name)
        return float(self.comm.allreduce(here))

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        if not {name, other} & set(self.parameters):
            return 0.0  # amplitudes that multiply their terms
        self.set(u)
        self.place(mu)
        if name not in self.parameters:
            name, other = other, name
        parameter = self.parameters[name]
        if other in self.parameters:
            bends = parameter.bends.get(other, {})
            here = sum(mu[amplitude] * fem.assemble_scalar(form) for amplitude, form in bends.items())
        else:
            here = parameter.slopes[other].energy() if other in parameter.slopes else 0.0
        return float(self.comm.allreduce(here))

    def accept(self, u: Vector) -> None:
        """Accept u as a point of the path; moments count full turns from here."""
        self.set(u)
        for term in self.terms:
            term.accept()

    def energies(self, u: Vector) -> dict[str, float]:
        """Each term's potential, without its amplitude."""
        self.set(u)
        return {t.name: float(self.comm.allreduce(t.energy())) for t in self.terms}

    def integral(self, u: Vector, form: fem.Form) -> float:
        """The value of a compiled form at a displacement, summed over all ranks."""
        self.set(u)
        return float(self.comm.allreduce(fem.assemble_scalar(form)))

    def tangent(self, u: Vector, mu: Amplitudes, stress: Sequence[Weighted] = ()) -> PETSc.Mat | Skewed:
        with self.assembly:
            whole = [(weight, self._with_ghosts(v)) for weight, v in stress]
            self.set(u)
            self.place(mu)
            factors = {t.name: _factor(t, mu) for t in self.terms}
            K = self._assembler.tangent(factors, whole) if self._assembler else self._of_forms(factors)
            if self.projection:
                K = self.projection.tangent(K)
            if self.noise:
                self.noise.on_matrix(K)
            N = self._skew(factors)
            return Skewed(K, N) if N else K

    def _skew(self, factors: Mapping[str, float]) -> PETSc.Mat | None:
        """The skew part of the tangent, of loads without potential; None without."""
        loads = [t for t in self.terms if isinstance(t, FormTerm) and not t.has_potential and factors[t.name]]
        if not loads:
            return None
        if self._N is None:
            self._N = fem_petsc.create_matrix(loads[0].skew_form)
        self._N.zeroEntries()
        for t in loads:
            t.add_skew(self._N, factors[t.name], self.clamped)
        self._N.assemble()
        return self.projection.both_sides(self._N) if self.projection else self._N

    def _of_forms(self, factors: Mapping[str, float]) -> PETSc.Mat:
        """The tangent from the terms' own forms."""
        self._K.zeroEntries()
        for t in self.terms:
            if factor := factors[t.name]:
                t.add_tangent(self._K, factor, self.clamped)
        compat.finish_matrix(self._K, self.u.function_space, self.clamped)
        return self._K

    def _gradient(
        self, u: Vector, factors: Mapping[str, float], besides: Sequence[tuple[float, Term]] = ()
    ) -> NDArray[np.float64]:
        """The gradient of the terms with these factors, by name, plus further terms."""
        with self.assembly:
            self.set(u)
            b = self._b.x.array
            b[:] = 0
            if self.gradients and factors:
                self.gradients.add(b, factors)
            for factor, term in [*((factors.get(t.name, 0.0), t) for t in self._own_residual), *besides]:
                if factor:
                    term.add_residual(b, factor)
            self._b.x.scatter_reverse(InsertMode.add)
            self._hold(b)
            return np.array(b[: self.size])


def _factor(term: Term, mu: Amplitudes) -> float:
    return 1.0 if term.amplitude is None else mu[term.amplitude]
