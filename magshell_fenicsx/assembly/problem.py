"""The sum of terms on a finite-element space, as a system for the solvers.

A state is evaluated, never visited: what `FiniteElementSystem.at` gives is a function of the state
alone. What a state has from its history stands in it, and goes on by `FiniteElementSystem.advance`
when a path accepts it.
"""

import itertools
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import replace
from typing import TypeAlias

import numpy as np
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from dolfinx.la import InsertMode
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.coupled import couplings, of_all
from magshell_fenicsx.assembly.evaluated import Evaluated, Noise
from magshell_fenicsx.assembly.moving import Moving
from magshell_fenicsx.assembly.parameters import Derivative, Parameter, Settable
from magshell_fenicsx.assembly.sliding import Constraint, Projection, Sliding
from magshell_fenicsx.assembly.terms import (
    Counted,
    FormTerm,
    ResidualAssembler,
    TangentAssembler,
    Term,
    factor_of,
)
from magshell_fenicsx.assembly.whole import WholeTerm
from magshell_fenicsx.continuation.factor import Stopwatch
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    Beside,
    Skewed,
    State,
    Vector,
    Weighted,
    symmetric_part,
)
from magshell_fenicsx.platform import compat

Setting: TypeAlias = tuple[
    Settable, float
]  # a number of the terms, and its value in a state that has none


DIFFERENCE = 1e-5  # of the length: the step of differences of forces


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
        Nodes among the held ones whose displacement E(mu) is prescribed. Increments of u are zero
        there, and whatever u holds there is replaced by E(mu).
    history
        Numbers that states have beside their amplitudes, by name, with their values where a state
        has none.

    Attributes
    ----------
    u
        The displacement in the terms' forms: that of whatever was evaluated last.
    history
        The given ones, and the turns of edges under moments.
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
        moving: Moving | None = None,
        history: Mapping[str, Setting] | None = None,
    ) -> None:
        V = u.function_space
        self.u, self.terms, self.length = u, terms, length
        self.clamped = clamped = [c for c in held if isinstance(c, fem.DirichletBC)]
        sliding = [c for c in held if isinstance(c, Sliding)]
        self.projection = Projection(V, sliding, clamped) if sliding else None
        self.parameters = parameters or {}
        self.moving, self._pressed = moving, moving.pressed if moving else None
        self._counted = [t for t in terms if isinstance(t, Counted)]
        self.history: dict[str, Setting] = {
            **(history or {}),
            **{t.turn: (t, 0.0) for t in self._counted},
        }
        free = {name: parameter.constant for name, parameter in self.parameters.items()}
        self._numbers = {
            name: (number, float(number.value)) for name, number in free.items()
        } | self.history
        self.coordinates = frozenset(self.parameters) | (moving.names if moving else frozenset())
        self.comm = V.mesh.comm
        self.size = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
        self.dofs = V.dofmap.index_map.size_global * V.dofmap.index_map_bs
        self.strange: list[
            str
        ] = []  # terms that were not numbers at the latest residual that was none
        self.assembly, self.noise = Stopwatch(), Noise.from_environment()
        fixed = np.unique(
            np.concatenate([np.empty(0, dtype=np.int32), *(bc.dof_indices()[0] for bc in clamped)])
        )
        self._fixed = fixed[fixed < self.size]
        self.couplings, self.of_all = couplings(V, terms, clamped), of_all(V, terms, clamped)
        self._b = fem.Function(V)
        self._assembler, self.gradients = assembler, gradients
        self._N: PETSc.Mat | None = None
        self._own_residual = [
            t for t in terms if gradients is None or t.name not in gradients.names
        ]
        for term in self._own_residual:
            term.compile_residual()
        if assembler is None:
            for term in terms:
                term.compile_tangent()
            self._K = fem_petsc.create_matrix(pattern.tangent_form)
            self._K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            self._unheld = fem_petsc.create_matrix(pattern.tangent_form) if moving else None

    def with_number(self, name: str, number: Settable, value: float) -> "FiniteElementSystem":
        """The same system, all states of which have a value of a further number of its terms, in
        place.
        """
        other = copy(self)
        other._numbers = {name: (number, value)} | self._numbers
        if self._assembler is None:
            other._K = self._K.duplicate()
        return other

    @property
    def dear(self) -> bool:
        """See `continuation.system.Roughly`."""
        return self.of_all is not None

    def at(self, state: State) -> Evaluated:
        """A state, to be asked for what it has."""
        return Evaluated(self, state.u, state.mu)

    def advance(self, state: State, before: Amplitudes) -> State:
        """An accepted state with its history, from that of the state before on a path.

        The turns of edges under moments are less than half a turn from those before.
        """
        if not self._counted:
            return state
        past = {t.turn: before.get(t.turn, 0.0) for t in self._counted}
        angles = self.at(State(state.u, state.mu | past)).of(
            lambda: {t.turn: t.angle() for t in self._counted}
        )
        return State(state.u, state.mu | angles)

    def placed(self, state: State) -> State:
        """The state with the displacement of the nodes that move."""
        return (
            State(self.with_ghosts(state.u, state.mu)[: self.size], state.mu)
            if self.moving
            else state
        )

    def with_ghosts(self, u: Vector, mu: Amplitudes | None = None) -> NDArray[np.float64]:
        """The displacement of all nodes on this rank, of those that move too."""
        self._b.x.array[: self.size] = u
        self._b.x.scatter_forward()
        whole = np.array(self._b.x.array)
        if self.moving and mu is not None:
            self.moving.put(whole, mu)
        return whole

    def residual(self, u: Vector, mu: Amplitudes, *, rough: bool = False) -> Vector:
        """See `System` and `Roughly`."""
        return Evaluated(self, u, mu).residual(rough=rough)

    def knows_along(self, u: Vector, mu: Amplitudes, du: Vector) -> bool:
        """See `Roughly`."""
        step = self.with_ghosts(du)
        return all(
            self.at(State(u, dict(mu))).of(
                lambda: [t.knows_along(step) for t in self.of_all.terms] if self.of_all else []
            )
        )

    def forces(self, u: Vector, mu: Amplitudes, name: str = "") -> Vector:
        """See `Evaluated.forces`."""
        return Evaluated(self, u, mu).forces(name)

    def load(self, u: Vector, mu: Amplitudes, name: str, *, held: bool = True) -> Vector:
        """d2Pi/du dmu, zero at supports if `held`."""
        return Evaluated(self, u, mu).load(name, held=held)

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        return Evaluated(self, u, mu).potential(name)

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        if not {name, other} & self.coordinates:
            return 0.0  # amplitudes that multiply their terms
        return Evaluated(self, u, mu).curvature(name, other)

    def energies(self, u: Vector, mu: Amplitudes | None = None) -> dict[str, float]:
        """See `Evaluated.energies`; of supports that do not move if no amplitudes are given."""
        return Evaluated(self, u, mu or {}).energies()

    def stored(self, u: Vector, mu: Amplitudes) -> float:
        """See `Evaluated.stored`."""
        return Evaluated(self, u, mu).stored()

    def tangent(
        self,
        u: Vector,
        mu: Amplitudes,
        stress: Sequence[Weighted] = (),
        times: Mapping[str, float] | None = None,
        *,
        rough: bool = False,
    ) -> PETSc.Mat | Beside | Skewed:
        """See `System`; `times` multiplies the tangents of some terms, by name.

        If `rough`, what all unknowns add to each other may be that of an earlier state.
        """
        return Evaluated(self, u, mu).tangent(stress, times, rough=rough)

    def held(self, u: Vector) -> Vector:
        """The displacement with zeros at the supports."""
        u = np.array(u)
        self._hold(u)
        return u

    def _hold(self, u: Vector) -> None:
        u[self._fixed] = 0
        if self.projection:
            self.projection.project(u)

    def _put(self, u: Vector, mu: Amplitudes) -> None:
        """Set the displacement, the numbers and the nodes that move."""
        for name, (number, value) in self._numbers.items():
            number.value = mu.get(name, value)
        self.u.x.array[: self.size] = u
        self.u.x.scatter_forward()
        if self.moving:
            self.moving.turn(mu)
            if self.moving.names <= mu.keys():
                self.moving.put(self.u.x.array, mu)

    def _finite(self, value: float) -> bool:
        """Whether a number is one on all ranks."""
        finite = bool(np.isfinite(value))
        return finite if self.comm.size == 1 else bool(self.comm.allreduce(finite, MPI.LAND))

    def step_along(self, v: Vector, part: float) -> float:
        """What v is multiplied by so that its largest entry is a part of the system's length;
        collective.
        """
        largest = self.comm.allreduce(float(np.abs(v).max(initial=0.0)), MPI.MAX)
        return float(part * self.length / (largest or 1.0))

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

    def _motion_curvature(self, moving: Moving, mu: Amplitudes, other: str, name: str) -> float:
        """This rank's part of d2Pi/dmu_i dmu_j, the second amplitude that of a motion."""
        bend = moving.rate(mu, name) @ self._column(mu, other)
        if other not in moving.names:
            return float(bend)
        R, r = self._gradient(self._factors(mu)), self.u.x.array
        bend += (
            moving.rate(mu, other) @ self._turning_column(mu, name)
            + moving.bend(mu, name, other) @ R
        )
        rates = dict(moving.turning(mu, other))
        for edge, A in moving.turning(mu, name):
            if edge in rates:
                bend += moving.along(A, r) @ self._turned_column(edge, rates[edge])
        for edge, B in moving.turning_twice(mu, (name, other)):
            bend += moving.along(B, r) @ self._gradient({edge: 1.0})
        return float(bend)

    def _column(self, mu: Amplitudes, name: str) -> NDArray[np.float64]:
        """This rank's part of d2Pi/du dmu at all nodes, of the displacement that is set."""
        if self.moving and name in self.moving.names:
            return self._times(
                self.moving.rate(mu, name), self._factors(mu)
            ) + self._turning_column(mu, name)
        if name in self.parameters:
            slopes = [
                (factor_of(slope.amplitude, mu), slope) for slope in self.parameters[name].slopes
            ]
            return self._gradient(self._multiplied(name), slopes)
        return self._gradient(self._multiplied(name))

    def _multiplied(self, name: str) -> dict[str, float]:
        """The terms that an amplitude multiplies."""
        return {t.name: 1.0 for t in self.terms if t.amplitude == name}

    def _turning_column(self, mu: Amplitudes, name: str) -> NDArray[np.float64]:
        """The part of it that normals of edges make, which turn with the motion."""
        assert self.moving
        column: NDArray[np.float64] = np.zeros_like(self.u.x.array)
        for edge, A in self.moving.turning(mu, name):
            column += self._turned_column(edge, A)
        return column

    def _turned_column(self, edge: str, A: NDArray[np.float64]) -> NDArray[np.float64]:
        assert self.moving
        turned = self._times(self.moving.along(A, self.u.x.array), {edge: 1.0})
        return turned + self.moving.times(A.T, self._gradient({edge: 1.0}))

    def _times(self, v: NDArray[np.float64], factors: Mapping[str, float]) -> NDArray[np.float64]:
        """This rank's part of the tangent without supports times a vector, both with ghosts."""
        if self._assembler:
            product = self._assembler.times(v, factors)
        else:
            K = self._of_forms(self._unheld, factors, [])
            given, product = K.createVecRight(), np.zeros_like(v)
            given.array[:] = v[: self.size]
            product[: self.size] = (K * given).array
        for coupling in self.couplings:
            product = product + coupling.times(v, factors)
        if self.of_all:
            product = product + self.of_all.times(v, factors)
        return product

    def _tangent(
        self,
        factors: Mapping[str, float],
        stress: Sequence[tuple[float, NDArray[np.float64]]],
        *,
        rough: bool = False,
    ) -> PETSc.Mat | Beside | Skewed:
        """That of the terms with these factors; `stress` has ghosts."""
        if self._assembler:
            K = self._assembler.tangent(factors, stress)
        else:
            K = self._of_forms(self._K, factors, self.clamped)
        for coupling in self.couplings:
            K = coupling.sum(K, factors)
        N = self._skew(factors)
        if self.of_all:
            K = self.of_all.beside(K, factors, rough=rough)
            if isinstance(K, Beside) and rough:
                of_all = {t.name: factors[t.name] for t in self.of_all.terms}
                present, foreseen = (
                    self._present_of_all(of_all, rough=rough) for rough in (False, True)
                )
                K = replace(K, present=present, foreseen=foreseen)
            K = symmetric_part(K) if N or self.projection or self.noise else K
        if self.projection:
            K = self.projection.tangent(K)
        if self.noise:
            self.noise.on_matrix(K)
        return Skewed(K, N) if N else K

    def _present_of_all(
        self, factors: Mapping[str, float], *, rough: bool
    ) -> Callable[[Vector], Vector]:
        """The tangent of some terms, at the displacement that is set now, times a vector: by
        differences of forces.

        If `rough`, of forces that are foreseen.
        """
        u = np.array(self.u.x.array)

        def times(v: Vector) -> Vector:
            step, along = self.step_along(v, DIFFERENCE), self.with_ghosts(v)
            before, product = np.array(self.u.x.array), np.zeros(self.size)
            for way in (1.0, -1.0):
                self.u.x.array[:] = u + way * step * along
                product += way / (2 * step) * self._summed(self._gradient(factors, rough=rough))
            self.u.x.array[:] = before
            return product

        return times

    def _skew(self, factors: Mapping[str, float]) -> PETSc.Mat | None:
        """The skew part of the tangent, of loads without potential; None without."""
        loads = [
            t
            for t in self.terms
            if isinstance(t, FormTerm) and not t.has_potential and factors[t.name]
        ]
        if not loads:
            return None
        if self._N is None:
            self._N = fem_petsc.create_matrix(loads[0].skew_form)
        self._N.zeroEntries()
        for t in loads:
            t.add_skew(self._N, factors[t.name], self.clamped)
        self._N.assemble()
        return self.projection.both_sides(self._N) if self.projection else self._N

    def _of_forms(
        self, K: PETSc.Mat, factors: Mapping[str, float], held: list[fem.DirichletBC]
    ) -> PETSc.Mat:
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
        self,
        factors: Mapping[str, float],
        besides: Sequence[tuple[float, Derivative]] = (),
        *,
        rough: bool = False,
    ) -> NDArray[np.float64]:
        """This rank's part of the gradient of the terms with these factors, by name, plus further
        terms.

        If `rough`, those in which all unknowns act on each other may be foreseen.
        """
        with self.assembly:
            b: NDArray[np.float64] = np.zeros_like(self.u.x.array)
            if self.gradients and factors:
                self.gradients.add(b, factors)
            own = [(factors.get(t.name, 0.0), t) for t in self._own_residual]
            for factor, term in itertools.chain(own, besides):
                if factor and rough and isinstance(term, WholeTerm):
                    term.add_foreseen(b, factor)
                elif factor:
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
