"""A system of energy terms on a finite-element space, as the solvers see it.

A state is evaluated, never visited: what `FiniteElementSystem.at_state` returns is a function of
the state alone. History variables stand in the state too; `FiniteElementSystem.advance` updates
them when a path accepts it. Theory: docs/theory.md, equilibrium and continuation.

The energy is a sum of terms mu_i Pi_i(u); mu are amplitudes, that is load parameters and numbers
such as positions of supports, by name. Coordinates are amplitudes that do not just multiply terms:
they move supports by the displacement E(mu), or are free parameters in the terms. Factors of terms
are their amplitudes' values. Settings are numbers in the forms that a state sets. A clamped
edge has a term that holds its normal, which turns by a rotation Q where the support turns. A lid is
a surface that closes a moving edge under a live pressure. Own nodes belong to this rank, ghosts to
others.
"""

import itertools
from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from dolfinx.la import InsertMode
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.evaluation import Evaluation, Noise
from magshell_fenicsx.assembly.free_parameters import Derivative, FreeParameter, SettableNumber
from magshell_fenicsx.assembly.nonlocal_terms import added_tangents
from magshell_fenicsx.assembly.oblique_supports import Constraint, ObliqueSupport, Projection
from magshell_fenicsx.assembly.prescribed_motion import PrescribedMotion
from magshell_fenicsx.assembly.terms import (
    AngleTerm,
    FormTerm,
    ResidualAssembler,
    TangentAssembler,
    Term,
    factor_of,
)
from magshell_fenicsx.continuation.factor import Stopwatch
from magshell_fenicsx.continuation.system import (
    Amplitudes,
    SkewedTangent,
    State,
    Vector,
    WeightedDisplacement,
)
from magshell_fenicsx.platform import compat

# A number that terms depend on, and its value in a state that does not have it.
Setting: TypeAlias = tuple[SettableNumber, float]


@dataclass(frozen=True)
class SystemVariables:
    """What varies in a system besides the displacement u.

    Attributes
    ----------
    parameters
        Free parameters of terms, by name.
    moving
        Prescribed displacement E(mu) of nodes among the supported ones; None: no support moves.
        Increments of u are zero there, and whatever u holds there is replaced by E(mu).
    history
        History variables, stored in a state next to its load parameters: name -> the number in the
        terms, and its value where a state has none.
    """

    parameters: Mapping[str, FreeParameter] = field(default_factory=dict)
    moving: PrescribedMotion | None = None
    history: Mapping[str, Setting] = field(default_factory=dict)


class FiniteElementSystem:
    """Sum of energy terms for a displacement u with supports; a `continuation.system.System`.

    Parameters
    ----------
    u
        The displacement in the terms' forms; it is overwritten.
    terms
        The energies, each with the amplitude that multiplies it.
    supports
        Constraints where u, or a component of it in any direction, is zero.
    pattern
        The term with the widest coupling; it determines the sparsity of the tangent.
    length
        A displacement that counts as of order one.
    assembler
        Computes the tangent with the same supports, instead of the terms' forms; None: the forms
        do.
    gradients
        Computes the residual, instead of the terms' forms; None: the forms do.
    variables
        What varies besides u.

    Attributes
    ----------
    u
        The displacement in the terms' forms: that of the latest evaluation.
    history
        The given history variables, and the reference angles of edges under moments.
    nan_terms
        Names of the terms that were not numbers at the latest residual that was none.
    coordinates
        Names of the amplitudes that move supports or are free parameters.
    clamped, projection
        The supports: Dirichlet conditions, and the projection P of oblique supports, or None.
    parameters, moving, edge_pressure
        Free parameters by name, the motion E(mu), and the live pressure at edges that move.
    added_tangents
        The tangents of terms with entries outside the sparsity pattern.
    assembly, noise
        Stopwatch of the assembly, and artificial rounding errors for tests, or None.

    Private fields: `_fixed` are the own clamped unknowns, `_settings` the numbers in the forms with
    their values in a state that has none. `_angle_terms` are the moments on edges, whose angle is a
    history variable. `_terms_with_residual` are the terms whose own forms give the residual. `_b`
    is a field for exchange between ranks. `_K` and `_K_free` are the matrices of the forms with and
    without supports, `_N` that of the skew part.
    """

    def __init__(
        self,
        u: fem.Function,
        terms: Sequence[Term],
        supports: Sequence[Constraint],
        pattern: FormTerm,
        length: float,
        assembler: TangentAssembler | None = None,
        gradients: ResidualAssembler | None = None,
        variables: SystemVariables | None = None,
    ) -> None:
        """Request the kernels of all terms, and create the matrices. Collective.

        The terms' own forms give the tangent only without `assembler`; only then `_K` exists, and
        `_K_free` for motions of supports.
        """
        variables = variables or SystemVariables()
        moving = variables.moving
        V = u.function_space
        # unknowns and supports
        self.u, self.terms, self.length = u, terms, length
        self.comm = V.mesh.comm
        self.size = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
        self.dofs = V.dofmap.index_map.size_global * V.dofmap.index_map_bs
        self._set_supports(V, supports)
        # what varies besides u
        self.parameters = variables.parameters
        self.moving, self.edge_pressure = moving, moving.edge_pressure if moving else None
        self._angle_terms = [t for t in terms if isinstance(t, AngleTerm)]
        # the reference angle of each edge under a moment is a number of the state, zero at first
        # (`turn` is its name in the state, the term itself is the number that can be set)
        reference_angles = {t.turn: (t, 0.0) for t in self._angle_terms}
        self.history: dict[str, Setting] = {**variables.history, **reference_angles}
        constants = {name: parameter.constant for name, parameter in self.parameters.items()}
        settings = {name: (number, float(number.value)) for name, number in constants.items()}
        self._settings = settings | self.history
        self.coordinates = frozenset(self.parameters) | (moving.names if moving else frozenset())
        self.nan_terms: list[str] = []
        self.assembly, self.noise = Stopwatch(), Noise.from_environment()
        # terms outside the sparsity pattern
        self.added_tangents = added_tangents(V, terms, self.clamped)
        self._b = fem.Function(V)
        self._assembler, self.gradients = assembler, gradients
        self._N: PETSc.Mat | None = None
        # terms whose own forms give the residual, then the tangent
        self._terms_with_residual = [
            t for t in terms if gradients is None or t.name not in gradients.names
        ]
        for term in self._terms_with_residual:
            term.compile_residual()
        if assembler is None:
            for term in terms:
                term.compile_tangent()
            self._K = fem_petsc.create_matrix(pattern.tangent_form)
            self._K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            self._K_free = fem_petsc.create_matrix(pattern.tangent_form) if moving else None

    def _set_supports(self, V: fem.FunctionSpace, supports: Sequence[Constraint]) -> None:
        """Sort the supports: Dirichlet conditions, and a projection for those in any direction."""
        self.clamped = [
            constraint for constraint in supports if isinstance(constraint, fem.DirichletBC)
        ]
        oblique = [constraint for constraint in supports if isinstance(constraint, ObliqueSupport)]
        self.projection = Projection(V, oblique, self.clamped) if oblique else None
        no_dofs = np.empty(0, dtype=np.int32)
        # an empty array first: there may be no conditions
        fixed_dofs = np.unique(
            np.concatenate([no_dofs, *(bc.dof_indices()[0] for bc in self.clamped)])
        )
        self._fixed = fixed_dofs[fixed_dofs < self.size]

    @property
    def fixed_unknowns(self) -> NDArray[np.int32]:
        """This rank's own unknowns that are zero or move with a support."""
        return np.asarray(self._fixed, dtype=np.int32)

    def with_number(self, name: str, number: SettableNumber, value: float) -> "FiniteElementSystem":
        """Return the same system with one more number of its terms that a state may set.

        Parameters
        ----------
        name
            Name of the number among the amplitudes of a state.
        number
            The number in the terms.
        value
            Its value in all states without that name.
        """
        # a shallow copy with a matrix of its own: both systems may be in use at once
        system = copy(self)
        system._settings = {name: (number, value)} | self._settings
        if self._assembler is None:
            system._K = self._K.duplicate()
        return system

    def at_state(self, state: State) -> Evaluation:
        """Return the evaluation of the system at a state."""
        return Evaluation(self, state.u, state.mu)

    def advance(self, state: State, before: Amplitudes) -> State:
        """Return an accepted state with its new history: the angles of edges under moments.

        Edges under moments turn by less than half a turn in a step. Collective.

        Parameters
        ----------
        before
            Amplitudes and history of the accepted state before.
        """
        if not self._angle_terms:
            return state
        # the angles are measured near the earlier ones, so that whole turns are counted
        past = {t.turn: before.get(t.turn, 0.0) for t in self._angle_terms}
        angles = self.at_state(State(state.u, state.mu | past)).evaluate(
            lambda: {t.turn: t.angle() for t in self._angle_terms}
        )
        return State(state.u, state.mu | angles)

    def with_moved_supports(self, state: State) -> State:
        """Return a state whose u has the displacement E(mu) of the nodes that move. Collective."""
        if not self.moving:
            return state
        return State(self.with_ghosts(state.u, state.mu)[: self.size], state.mu)

    def with_ghosts(self, u: Vector, mu: Amplitudes | None = None) -> NDArray[np.float64]:
        """Return the displacement of all local nodes, ghosts included. Collective.

        Parameters
        ----------
        u
            Displacement of own nodes.
        mu
            Amplitudes. If they are given, nodes that move have the displacement E(mu) instead.
        """
        self._b.x.array[: self.size] = u
        self._b.x.scatter_forward()
        local = np.array(self._b.x.array)
        if self.moving and mu is not None:
            self.moving.put(local, mu)
        return local

    def residual(self, u: Vector, mu: Amplitudes) -> Vector:
        """Return R = dPi/du at own unknowns. Collective."""
        return Evaluation(self, u, mu).residual()

    def forces(self, u: Vector, mu: Amplitudes, name: str = "") -> Vector:
        """Return dPi/du at all own nodes, with the forces of the supports on the shell. Collective.

        Parameters
        ----------
        name
            Name of a single term; "": all terms, with their amplitudes.
        """
        return Evaluation(self, u, mu).forces(name)

    def load(self, u: Vector, mu: Amplitudes, name: str, *, constrained: bool = True) -> Vector:
        """Return d2Pi/du dmu; zero at supports if `constrained`. Collective."""
        return Evaluation(self, u, mu).load(name, constrained=constrained)

    def potential(self, u: Vector, mu: Amplitudes, name: str) -> float:
        """Return dPi/dmu, on every rank. Collective."""
        return Evaluation(self, u, mu).potential(name)

    def curvature(self, u: Vector, mu: Amplitudes, name: str, other: str) -> float:
        """Return d2Pi/dmu_i dmu_j of the amplitudes `name` and `other`, on every rank. Collective.

        It is zero between amplitudes that multiply their terms.
        """
        if not {name, other} & self.coordinates:
            return 0.0
        return Evaluation(self, u, mu).curvature(name, other)

    def energies(self, u: Vector, mu: Amplitudes | None = None) -> dict[str, float]:
        """Return the potential Pi_i of each term by name, without its amplitude. Collective.

        Supports do not move if no amplitudes are given.
        """
        return Evaluation(self, u, mu or {}).energies()

    def stored_energy(self, u: Vector, mu: Amplitudes) -> float:
        """Return the energy without the potentials of loads. Collective."""
        return Evaluation(self, u, mu).stored_energy()

    def tangent(
        self,
        u: Vector,
        mu: Amplitudes,
        stress: Sequence[WeightedDisplacement] = (),
        times: Mapping[str, float] | None = None,
    ) -> PETSc.Mat | SkewedTangent:
        """Assemble d2Pi/du2, or dR/du where a load has no potential. Collective.

        Parameters
        ----------
        stress
            Weighted displacements. The sum of their stresses replaces the stress of u, which small
            errors of a guess u change much.
        times
            Term name -> further factor of its tangent; None: no further factors.
        """
        return Evaluation(self, u, mu).tangent(stress, times)

    def zero_at_supports(self, u: Vector) -> Vector:
        """Return the displacement with zeros at the supports."""
        u = np.array(u)
        self._constrain(u)
        return u

    def _constrain(self, u: Vector) -> None:
        """Make a vector zero at clamped unknowns and along oblique supports, in place."""
        u[self._fixed] = 0
        if self.projection:
            self.projection.project(u)

    def _put(self, u: Vector, mu: Amplitudes) -> None:
        """Put a state into the forms: the displacement, the numbers and the nodes that move.

        Nodes move only if the state has the amplitudes of all motions.
        """
        for name, (number, value) in self._settings.items():
            number.value = mu.get(name, value)
        self.u.x.array[: self.size] = u
        self.u.x.scatter_forward()
        if self.moving:
            self.moving.turn(mu)
            if self.moving.names <= mu.keys():
                self.moving.put(self.u.x.array, mu)

    def _finite(self, value: float) -> bool:
        """Return whether a number is finite on all ranks."""
        finite = bool(np.isfinite(value))
        return finite if self.comm.size == 1 else bool(self.comm.allreduce(finite, MPI.LAND))

    def step_along(self, v: Vector, fraction: float) -> float:
        """Return the factor of v whose largest entry is then a fraction of the system's length.

        Collective.
        """
        largest = self.comm.allreduce(float(np.abs(v).max(initial=0.0)), MPI.MAX)
        return float(fraction * self.length / (largest or 1.0))

    def lid_potential(self, mu: Amplitudes, *names: str) -> float:
        """Return the derivative of p V by one or two amplitudes, V the volume that lids sweep.

        Parameters
        ----------
        names
            The one or two amplitudes: of the pressure p or of motions.

        Returns
        -------
        The derivative; zero without a live pressure at moving edges.
        """
        pressure = self.edge_pressure
        if pressure is None:
            return 0.0
        # p V is linear in p: by two amplitudes of the pressure the derivative is zero
        motions = [name for name in names if name != pressure.load]
        if len(names) - len(motions) > 1:
            return 0.0
        # the factor of V is the pressure, or its derivative by the amplitude
        by_pressure = len(motions) < len(names)
        factor = pressure.unit if by_pressure else pressure.unit * mu.get(pressure.load, 0.0)
        # V or its first or second derivative, by as many motions
        derivatives = pressure.swept_volume, pressure.volume_slope, pressure.volume_curvature
        return factor * derivatives[len(motions)](mu, *motions)

    def _motion_curvature(
        self, moving: PrescribedMotion, mu: Amplitudes, other: str, name: str
    ) -> float:
        """Return this rank's part of d2Pi/dmu_i dmu_j, where one amplitude moves supports.

        Parameters
        ----------
        other, name
            The two amplitudes; `name` moves supports, `other` may do so.
        """
        # `name` moves nodes with the rate dE/dmu, along which `other` changes forces by d2Pi/du dmu
        curvature = moving.rate(mu, name) @ self._column(mu, other)
        if other not in moving.names:
            return float(curvature)
        # both move supports: the nodes that `other` moves do work with the forces that change as
        # `name` turns normals, and the forces do work along the second derivative of E
        residual, u = self._gradient(self._factors(mu)), self.u.x.array
        curvature += (
            moving.rate(mu, other) @ self._turning_column(mu, name)
            + moving.bend(mu, name, other) @ residual
        )
        # both turn the normal of an edge, which acts like two displacements A r: the forces change
        # along one of them, and do work along the other
        spins_by_other = dict(moving.turning(mu, other))
        for edge, A in moving.turning(mu, name):
            if edge in spins_by_other:
                spin = moving.spin_displacement(A, u)
                curvature += spin @ self._turned_column(edge, spins_by_other[edge])
        # the forces also do work along the derivative of one displacement by the other amplitude
        for edge, A_slope in moving.turning_twice(mu, (name, other)):
            curvature += moving.spin_displacement(A_slope, u) @ self._gradient({edge: 1.0})
        return float(curvature)

    def _column(self, mu: Amplitudes, name: str) -> NDArray[np.float64]:
        """Return this rank's part of d2Pi/du dmu at all nodes, at the displacement in the forms.

        The amplitude `name` moves supports, is a free parameter, or multiplies terms.
        """
        if self.moving and name in self.moving.names:
            # the forces change by K dE/dmu as nodes move, and as the normals of edges turn
            rate = self.moving.rate(mu, name)
            product = self._tangent_product(rate, self._factors(mu))
            return product + self._turning_column(mu, name)
        if name in self.parameters:
            # the derivatives of terms by the parameter, each with the factor of its term; the
            # parameter may multiply other terms as well
            slopes = [
                (factor_of(slope.amplitude, mu), slope) for slope in self.parameters[name].slopes
            ]
            return self._gradient(self._unit_factors(name), slopes)
        return self._gradient(self._unit_factors(name))

    def _unit_factors(self, name: str) -> dict[str, float]:
        """Return the factor 1 of each term that the amplitude `name` multiplies."""
        return {t.name: 1.0 for t in self.terms if t.amplitude == name}

    def _turning_column(self, mu: Amplitudes, name: str) -> NDArray[np.float64]:
        """Return the part of d2Pi/du dmu from clamped edges whose normals turn with the motion.

        Parameters
        ----------
        name
            The amplitude of the motion.
        """
        assert self.moving
        column: NDArray[np.float64] = np.zeros_like(self.u.x.array)
        for edge, A in self.moving.turning(mu, name):
            column += self._turned_column(edge, A)
        return column

    def _turned_column(self, edge: str, A: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the change of a clamped edge's forces as its normal turns, this rank's part.

        The energy depends on the normal through Q^T r alone, r the place. So a turn acts like the
        displacement A r, and turns the forces in addition.

        Parameters
        ----------
        edge
            Name of the term that holds the normal of the edge.
        A
            (3, 3): Q dQ^T of the edge's rotation Q.
        """
        assert self.moving
        spin = self.moving.spin_displacement(A, self.u.x.array)
        turned_forces = self._tangent_product(spin, {edge: 1.0})
        return turned_forces + self.moving.transform(A.T, self._gradient({edge: 1.0}))

    def _tangent_product(
        self, v: NDArray[np.float64], factors: Mapping[str, float]
    ) -> NDArray[np.float64]:
        """Return this rank's part of the tangent without supports times a vector. Collective.

        Parameters
        ----------
        v
            The vector at all local nodes, with ghosts, as is the product.
        factors
            Term name -> factor of its tangent.
        """
        if self._assembler:
            product = self._assembler.times(v, factors)
        else:
            K = self._assemble_forms(self._K_free, factors, clamped=[])  # without supports
            x, product = K.createVecRight(), np.zeros_like(v)
            x.array[:] = v[: self.size]
            product[: self.size] = (K * x).array
        for nonlocal_tangent in self.added_tangents:
            product = product + nonlocal_tangent.times(v, factors)
        return product

    def _tangent(
        self,
        factors: Mapping[str, float],
        stress: Sequence[tuple[float, NDArray[np.float64]]],
    ) -> PETSc.Mat | SkewedTangent:
        """Assemble the tangent at the displacement in the forms. Collective.

        Parameters
        ----------
        factors
            Term name -> factor of its tangent.
        stress
            Weighted displacements, with ghosts, whose stress replaces that of u; empty: its own.
        """
        if self._assembler:
            K = self._assembler.tangent(factors, stress)
        else:
            K = self._assemble_forms(self._K, factors, self.clamped)
        for nonlocal_tangent in self.added_tangents:
            K = nonlocal_tangent.sum(K, factors)
        N = self._skew(factors)  # None if all loads have a potential
        if self.projection:
            K = self.projection.tangent(K)
        if self.noise:
            self.noise.on_matrix(K)
        return SkewedTangent(K, N) if N else K

    def _skew(self, factors: Mapping[str, float]) -> PETSc.Mat | None:
        """Return the skew part of the tangent, of loads without potential; None without such.

        `factors` maps the name of a term to the factor of its tangent. Collective.
        """
        form_terms = [t for t in self.terms if isinstance(t, FormTerm)]
        loads_without_potential = [t for t in form_terms if not t.has_potential and factors[t.name]]
        if not loads_without_potential:
            return None
        if self._N is None:
            self._N = fem_petsc.create_matrix(loads_without_potential[0].skew_form)
        self._N.zeroEntries()
        for t in loads_without_potential:
            t.add_skew(self._N, factors[t.name], self.clamped)
        self._N.assemble()
        return self.projection.project_both_sides(self._N) if self.projection else self._N

    def _assemble_forms(
        self, K: PETSc.Mat, factors: Mapping[str, float], clamped: list[fem.DirichletBC]
    ) -> PETSc.Mat:
        """Assemble the tangent from the terms' own forms into K, and return K. Collective.

        Parameters
        ----------
        factors
            Term name -> factor of its tangent; others are left out.
        clamped
            Conditions whose rows and columns become those of the identity.
        """
        K.zeroEntries()
        for t in self.terms:
            if factor := factors.get(t.name):
                t.add_tangent(K, factor, clamped)
        compat.finish_matrix(K, self.u.function_space, clamped)
        return K

    def _factors(self, mu: Amplitudes) -> dict[str, float]:
        """Return the factor of each term, by its name: its amplitude, or 1 without one."""
        return {t.name: factor_of(t.amplitude, mu) for t in self.terms}

    def _gradient(
        self,
        factors: Mapping[str, float],
        further: Sequence[tuple[float, Derivative]] = (),
    ) -> NDArray[np.float64]:
        """Return this rank's part of the gradient of terms at all local nodes, ghosts included.

        Parameters
        ----------
        factors
            Term name -> factor of its gradient; others are left out.
        further
            Derivatives by free parameters that are added, with their factors.
        """
        with self.assembly:
            b: NDArray[np.float64] = np.zeros_like(self.u.x.array)
            # terms that `gradients` computes, then those with forms of their own
            if self.gradients and factors:
                self.gradients.add(b, factors)
            weighted = [(factors.get(t.name, 0.0), t) for t in self._terms_with_residual]
            for factor, term in itertools.chain(weighted, further):
                if factor:
                    term.add_residual(b, factor)
            return b

    def _summed(self, local: NDArray[np.float64], *, constrained: bool = True) -> Vector:
        """Return the sum of all ranks' parts of a vector, at own nodes. Collective.

        Parameters
        ----------
        local
            Vector at all local nodes, ghosts included.
        constrained
            Whether the sum is zero at supports.
        """
        with self.assembly:
            b = self._b.x.array
            b[:] = local
            self._b.x.scatter_reverse(InsertMode.add)
            if constrained:
                self._constrain(b)
            return np.array(b[: self.size])
