"""The sum of terms on a finite-element space, as a system for the solvers."""

import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from dolfinx.la import InsertMode
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.assemblers import ResidualAssembler, TangentAssembler
from magshell_fenicsx.assembly.moving import Moving
from magshell_fenicsx.assembly.parameter import Derivative, FreeParameter, Settable
from magshell_fenicsx.assembly.sliding import Constraint, Projection, Sliding
from magshell_fenicsx.assembly.terms import Counted, FormTerm, Term, factor_of
from magshell_fenicsx.continuation.noise import Noise
from magshell_fenicsx.continuation.system import Amplitudes, Skewed, State, Vector, Weighted
from magshell_fenicsx.continuation.timing import Stopwatch
from magshell_fenicsx.platform import compat

ASIDE = 1e-3  # the largest displacement of a difference, over h
CENTRAL = {1.0: 2 / 3, -1.0: -2 / 3, 2.0: -1 / 12, -2.0: 1 / 12}  # multiple of a step -> weight over it of a slope


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
    moving
        Nodes among the held ones whose displacement E(mu) is prescribed. Increments of u are zero there, and
        whatever u holds there is replaced by E(mu).
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
        parameters: Mapping[str, FreeParameter] | None = None,
        moving: Moving | None = None,
    ) -> None:
        V = u.function_space
        self.u, self.terms, self.length = u, terms, length
        self.clamped = clamped = [c for c in held if isinstance(c, fem.DirichletBC)]
        sliding = [c for c in held if isinstance(c, Sliding)]
        self.projection = Projection(V, sliding, clamped) if sliding else None
        self.parameters = parameters or {}
        self.moving, self._pressed = moving, moving.pressed if moving else None
        self._counted = [t for t in terms if isinstance(t, Counted)]
        # numbers that a state's amplitudes may have besides their own, and their values without
        self.settings: dict[str, tuple[Settable, float]] = {t.setting: (t, 0.0) for t in self._counted}
        self.coordinates = frozenset(self.parameters) | (moving.names if moving else frozenset())
        self.comm = V.mesh.comm
        self.size = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
        self.dofs = V.dofmap.index_map.size_global * V.dofmap.index_map_bs
        self.strange: list[str] = []  # terms that were not numbers at the latest residual that was none
        self.assembly, self.noise = Stopwatch(), Noise.from_environment()
        fixed = np.unique(np.concatenate([np.empty(0, dtype=np.int32), *(bc.dof_indices()[0] for bc in clamped)]))
        self._fixed = fixed[fixed < self.size]
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
            self._unheld = fem_petsc.create_matrix(pattern.tangent_form) if moving else None

    def set(self, u: Vector) -> None:
        """Copy a displacement into the Function of the terms, which follow it."""
        self._copy(u)
        for term in self.terms:
            term.follow()

    def _copy(self, u: Vector) -> None:
        self.u.x.array[: self.size] = u
        self.u.x.scatter_forward()

    def placed(self, state: State) -> State:
        """The state with the displacement of the nodes that move."""
        if self.moving is None:
            return state
        self.at(state.u, state.mu)
        return State(np.array(self.u.x.array[: self.size]), state.mu)

    def at(self, u: Vector, mu: Amplitudes) -> None:
        """Set the displacement and the free parameters of the terms."""
        self._copy(u)
        self.place(mu)
        for term in self.terms:
            term.follow()

    def gradient_of(self, u: Vector, mu: Amplitudes, forms: Sequence[fem.Form]) -> Vector:
        """The sum of compiled linear forms at a displacement over all ranks, zero at supports."""
        self.at(u, mu)
        part: NDArray[np.float64] = np.zeros_like(self.u.x.array)
        for form in forms:
            fem.assemble_vector(part, form)
        return self._summed(part)

    def with_ghosts(self, u: Vector, mu: Amplitudes) -> NDArray[np.float64]:
        """All nodes' displacement on this rank, of those that move too."""
        self._copy(u)
        self.place(mu)
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
        """Set the free parameters of the terms, and move the nodes that move."""
        for name, parameter in self.parameters.items():
            parameter.constant.value = mu[name]
        for name, (constant, value) in self.settings.items():
            constant.value = mu.get(name, value)
        if self.moving:
            self.moving.put(self.u.x.array, mu)

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        self.at(u, mu)
        factors = self._factors(mu)
        if self.noise is None:
            found = self._summed(self._gradient(factors))
            if not self._finite(found.sum()):
                self.strange = self._not_numbers(factors)
            return found
        first = self.u.function_space.dofmap.index_map.local_range[0] * self.u.function_space.dofmap.index_map_bs
        parts = [self._summed(self._gradient({name: factor})) for name, factor in factors.items()]
        return np.asarray(np.sum([self.noise.on_vector(part, first) for part in parts], axis=0))

    def _finite(self, value: float) -> bool:
        """Whether a number is one on all ranks."""
        here = bool(np.isfinite(value))
        return here if self.comm.size == 1 else bool(self.comm.allreduce(here, MPI.LAND))

    def _not_numbers(self, factors: Mapping[str, float]) -> list[str]:
        """The terms whose energy or gradient at the present u is not a number; collective."""
        used = [t for t in self.terms if factors[t.name]]
        sizes = {t.name: t.energy() + self._gradient({t.name: 1.0}).sum() for t in used}
        return [name for name, size in sizes.items() if not self._finite(size)] or ["the sum of all terms"]

    def forces(self, u: Vector, mu: Amplitudes, name: str = "") -> Vector:
        """dPi/du at all nodes, of all terms or of one: of all at supports the forces of these on the shell."""
        self.at(u, mu)
        part = self._gradient({name: 1.0} if name else self._factors(mu))
        if self.moving and self._pressed and not name:
            part += mu.get(self._pressed.load, 0.0) * self.moving.on_edges(self.u.x.array)
        return self._summed(part, held=False)

    def step_along(self, v: Vector, part: float) -> float:
        """What v is multiplied by so that its largest entry is a part of the system's length; collective."""
        largest = self.comm.allreduce(float(np.abs(v).max(initial=0.0)), MPI.MAX)
        return float(part * self.length / (largest or 1.0))

    def stiffness_along(self, u: Vector, mu: Amplitudes, v: Vector) -> Vector:
        """K v of all terms with the rows and columns of supports, by differences of fourth order."""
        step, found = self.step_along(v, ASIDE), np.zeros(self.size)
        for way, weight in CENTRAL.items():
            self.at(u, mu)
            self.u.x.array[: self.size] += way * step * v
            self.u.x.scatter_forward()
            for term in self.terms:
                term.follow()
            found += weight / step * self._summed(self._gradient(self._factors(mu)), held=False)
        return found

    def load(self, u: Vector, mu: Amplitudes, name: str, *, held: bool = True) -> Vector:
        """d2Pi/du dmu, zero at supports if `held`."""
        self.at(u, mu)
        part = self._column(mu, name)
        if self.moving and self._pressed and name == self._pressed.load and not held:
            part += self.moving.on_edges(self.u.x.array)
        return self._summed(part, held=held)

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        self.at(u, mu)
        if self.moving and name in self.moving.names:
            here = float(self._gradient(self._factors(mu)) @ self.moving.rate(mu, name))
            for edge, A in self.moving.turning(mu, name):
                here += float(self._gradient({edge: 1.0}) @ self.moving.along(A, self.u.x.array))
        elif name in self.parameters:
            slopes = self.parameters[name].slopes
            here = sum(factor_of(slope.amplitude, mu) * slope.energy() for slope in slopes)
        else:
            here = sum(t.energy() for t in self.terms if t.amplitude == name)
        return float(self.comm.allreduce(here)) + self._of_lids(mu, name)

    def _of_lids(self, mu: Amplitudes, *names: str) -> float:
        """The derivative of p V, V what the lids sweep, by one or two amplitudes."""
        if self._pressed is None:
            return 0.0
        load, unit = self._pressed.load, self._pressed.unit
        motions = [name for name in names if name != load]
        if len(names) - len(motions) > 1:
            return 0.0
        factor = unit if len(motions) < len(names) else unit * mu.get(load, 0.0)
        derivative = (self._pressed.swept, self._pressed.slope, self._pressed.bend)[len(motions)]
        return factor * derivative(mu, *motions)

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        if not {name, other} & self.coordinates:
            return 0.0  # amplitudes that multiply their terms
        self.at(u, mu)
        if self.moving and {name, other} & self.moving.names:
            here = self._motion_curvature(self.moving, mu, *sorted((name, other), key=self.moving.names.__contains__))
            return float(self.comm.allreduce(here)) + self._of_lids(mu, name, other)
        if name not in self.parameters:
            name, other = other, name
        parameter = self.parameters[name]
        if other in self.parameters:
            bends = parameter.bends(self.parameters[other].constant)
            here = sum(factor_of(bend.amplitude, mu) * bend.energy() for bend in bends)
        else:
            here = sum(slope.energy() for slope in parameter.slopes if slope.amplitude == other)
        return float(self.comm.allreduce(here))

    def _motion_curvature(self, moving: Moving, mu: Amplitudes, other: str, name: str) -> float:
        """This rank's part of d2Pi/dmu_i dmu_j, the second amplitude that of a motion."""
        found = moving.rate(mu, name) @ self._column(mu, other)
        if other not in moving.names:
            return float(found)
        R, r = self._gradient(self._factors(mu)), self.u.x.array
        found += moving.rate(mu, other) @ self._turning_column(mu, name) + moving.bend(mu, name, other) @ R
        rates = dict(moving.turning(mu, other))
        for edge, A in moving.turning(mu, name):
            if edge in rates:
                found += moving.along(A, r) @ self._turned_column(edge, rates[edge])
        for edge, B in moving.turning_twice(mu, (name, other)):
            found += moving.along(B, r) @ self._gradient({edge: 1.0})
        return float(found)

    def _column(self, mu: Amplitudes, name: str) -> NDArray[np.float64]:
        """This rank's part of d2Pi/du dmu at all nodes, of the displacement that is set."""
        if self.moving and name in self.moving.names:
            return self._times(self.moving.rate(mu, name), self._factors(mu)) + self._turning_column(mu, name)
        if name in self.parameters:
            slopes = self.parameters[name].slopes
            return self._gradient({}, [(factor_of(slope.amplitude, mu), slope) for slope in slopes])
        return self._gradient({t.name: 1.0 for t in self.terms if t.amplitude == name})

    def _turning_column(self, mu: Amplitudes, name: str) -> NDArray[np.float64]:
        """The part of it that normals of edges make, which turn with the motion."""
        assert self.moving
        found: NDArray[np.float64] = np.zeros_like(self.u.x.array)
        for edge, A in self.moving.turning(mu, name):
            found += self._turned_column(edge, A)
        return found

    def _turned_column(self, edge: str, A: NDArray[np.float64]) -> NDArray[np.float64]:
        assert self.moving
        turned = self._times(self.moving.along(A, self.u.x.array), {edge: 1.0})
        return turned + self.moving.times(A.T, self._gradient({edge: 1.0}))

    def _times(self, v: NDArray[np.float64], factors: Mapping[str, float]) -> NDArray[np.float64]:
        """This rank's part of the tangent without supports times a vector, both with ghosts."""
        if self._assembler:
            return self._assembler.times(v, factors)
        K = self._of_forms(self._unheld, factors, [])
        given, found = K.createVecRight(), np.zeros_like(v)
        given.array[:] = v[: self.size]
        found[: self.size] = (K * given).array
        return found

    def counted(self, state: State, before: Amplitudes) -> State:
        """The state with the turns of its edges under moments, less than half a turn from those of `before`."""
        if not self._counted:
            return state
        past = {t.setting: before.get(t.setting, 0.0) for t in self._counted}
        self.at(state.u, state.mu | past)
        return State(state.u, state.mu | {t.setting: t.angle() for t in self._counted})

    def energies(self, u: Vector, mu: Amplitudes | None = None) -> dict[str, float]:
        """Each term's potential, without its amplitude; of supports that do not move if none are given."""
        self.set(u) if mu is None else self.at(u, mu)
        potentials = {t.name: float(self.comm.allreduce(t.energy())) for t in self.terms}
        if mu and self._pressed and self._pressed.load in potentials:
            potentials[self._pressed.load] += self._of_lids(mu, self._pressed.load)
        return potentials

    def stored(self, u: Vector, mu: Amplitudes) -> float:
        """The energy without the potentials of loads."""
        self.at(u, mu)
        own = (t for t in self.terms if t.amplitude is None or t.amplitude in self.coordinates)
        return float(self.comm.allreduce(sum(factor_of(t.amplitude, mu) * t.energy() for t in own)))

    def integral(self, u: Vector, form: fem.Form) -> float:
        """The value of a compiled form at a displacement, summed over all ranks."""
        self.set(u)
        return float(self.comm.allreduce(fem.assemble_scalar(form)))

    def tangent(
        self, u: Vector, mu: Amplitudes, stress: Sequence[Weighted] = (), times: Mapping[str, float] | None = None
    ) -> PETSc.Mat | Skewed:
        """See `System`; `times` multiplies the tangents of some terms, by name."""
        with self.assembly:
            whole = [(weight, self.with_ghosts(v, mu)) for weight, v in stress]
            self.at(u, mu)
            factors = self._factors(mu)
            for name, size in (times or {}).items():
                factors[name] *= size
            K = (
                self._assembler.tangent(factors, whole)
                if self._assembler
                else self._of_forms(self._K, factors, self.clamped)
            )
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

    def _of_forms(self, K: PETSc.Mat, factors: Mapping[str, float], held: list[fem.DirichletBC]) -> PETSc.Mat:
        """The tangent from the terms' own forms."""
        K.zeroEntries()
        for t in self.terms:
            if factor := factors.get(t.name):
                t.add_tangent(K, factor, held)
        compat.finish_matrix(K, self.u.function_space, held)
        return K

    def _factors(self, mu: Amplitudes) -> dict[str, float]:
        return {t.name: factor_of(t.amplitude, mu) for t in self.terms}

    def _gradient(
        self, factors: Mapping[str, float], besides: Sequence[tuple[float, Derivative]] = ()
    ) -> NDArray[np.float64]:
        """This rank's part of the gradient of the terms with these factors, by name, plus further terms."""
        with self.assembly:
            b: NDArray[np.float64] = np.zeros_like(self.u.x.array)
            if self.gradients and factors:
                self.gradients.add(b, factors)
            own = [(factors.get(t.name, 0.0), t) for t in self._own_residual]
            for factor, term in itertools.chain(own, besides):
                if factor:
                    term.add_residual(b, factor)
            return b

    def _summed(self, part: NDArray[np.float64], *, held: bool = True) -> Vector:
        """The sum of all ranks' parts; zero at supports if `held`."""
        with self.assembly:
            b = self._b.x.array
            b[:] = part
            self._b.x.scatter_reverse(InsertMode.add)
            if held:
                self._hold(b)
            return np.array(b[: self.size])
