"""Stability of an axisymmetric state against waves cos(m theta), m >= 1.

Along a wave v every component of a jet is a coefficient times cos(m theta) or sin(m theta),
so the second variation of an axisymmetric energy is pi times the sum of that of the
cosine's and of the sine's coefficients: one form on the meridian with m as a number.
"""

from collections.abc import Sequence
from math import ceil, sqrt

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.fem import petsc as fem_petsc
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.at_zero import at_zero
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.problem import FiniteElementSystem
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.continuation.banded import Banded
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.inverse import nearest_to_zero
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.axisymmetric import jets
from magshell_fenicsx.models.axisymmetric.energies import INTERIOR, Energy
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.axisymmetric.supports import Supports
from magshell_fenicsx.platform import compat


class Waves:
    """The second variation Q_m of an axisymmetric shell, for any m >= 1.

    Parameters
    ----------
    system
        Of the axisymmetric displacement.
    energies
        Its terms as functions of a jet.
    supports
        What is held.

    Attributes
    ----------
    V
        Space of the waves' coefficients (U + V, V, W); see `jets.wave`.
    largest
        Waves that are looked at by default: m = 1 to this. The perfect sphere buckles in
        waves of length 2 pi sqrt(Rh)/(12(1 - nu^2))^(1/4), of which
        1.73 (nu = 0.5) to 1.86 (nu = 0) times sqrt(R/h) fit around the equator; a wider circle has more, and
        so has a surface of smaller radii of curvature.
    """

    def __init__(
        self,
        system: FiniteElementSystem,
        energies: Sequence[Energy],
        meridian: Meridian,
        supports: Supports,
        log: KernelLog,
    ) -> None:
        self._system = system
        degree = system.u.function_space.element.basix_element.degree
        self.V = V = fem.functionspace(meridian.mesh, ("Lagrange", degree, (3,)))
        self.largest = ceil(2.2 * meridian.reach * sqrt(meridian.curvature / system.length)) + 5
        self._m = fem.Constant(V.mesh, 1.0)
        self._factor = fem.Constant(V.mesh, 1.0)
        self._kept = kept = [e for e in energies if not e.linear]
        self._forms = [(e.amplitude, log.compile(f"{e.name} waves", self._second(e))) for e in kept]
        self._phi, self._energies, self._log = fem.Function(V, name="phi"), list[FormTerm](), log
        self._held_once, self._held = supports.held_waves(V, 1), supports.held_waves(V, 2)
        pattern = next(form for e, (_, form) in zip(kept, self._forms, strict=True) if e.name == INTERIOR)
        self._K = fem_petsc.create_matrix(pattern)
        self._K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._nodes = 1 + (self.largest - 1) * (1 - np.cos(np.pi * np.arange(5) / 4)) / 2
        self._parts = [fem_petsc.create_matrix(pattern) for _ in self._nodes]
        self._interpolated: PETSc.Mat | None = None
        self._bands: list[Banded] = []
        self._factorisation, self._counting = Factorisation(V.mesh.comm), Factorisation(V.mesh.comm)

    def tangent(self, state: State, m: int) -> PETSc.Mat:
        """The matrix of Q_m at an axisymmetric state; it is reused by the next call."""
        self._system.at(state.u, state.mu)
        self._assemble(self._K, state, m, self.held(m))
        return self._K

    def along(self, phi: NDArray[np.float64], m: int) -> list[FormTerm]:
        """Q_m(phi), summand by summand as energies of the axisymmetric displacement, for one phi and m at a time."""
        self._phi.x.array[:], self._m.value = phi, m
        if not self._energies:
            for e in self._kept:
                energy, v = self._of_wave(e)
                twice = ufl.derivative(ufl.derivative(energy, v, self._phi), v, self._phi)
                form = ufl.replace(twice, {v: ufl.zero(3)})
                self._energies.append(FormTerm(f"{e.name} along a wave", form, self._system.u, self._log, e.amplitude))
        return self._energies

    def held(self, m: int) -> list[fem.DirichletBC]:
        """What is held at the axis and at the ends: a wave m = 1 may move the axis across itself."""
        return self._held_once if m == 1 else self._held

    def factor_at(self, state: State, m: int) -> Factorisation:
        """Factor the matrix of Q_m at an axisymmetric state; the next call overwrites the factors."""
        self._factorisation.factor(self.tangent(state, m))
        return self._factorisation

    def counts(self, state: State) -> list[int]:
        """Number of unstable directions among the waves 1, 2, ... `largest`.

        A jet of a wave is quadratic in m, and so Q_m is a polynomial of degree 4: its matrices are interpolated
        between five. Only those that are not positive definite are factored for their inertia.
        """
        self._system.at(state.u, state.mu)
        for part, node in zip(self._parts, self._nodes, strict=True):
            self._assemble(part, state, node, [])
        if not self._bands:
            self._bands = [Banded(self._parts[0], self._rows(m)) for m in (1, 2)]
        values, found = [part.getValuesCSR()[2] for part in self._parts], list[int]()
        entries = [band.entries(values) for band in self._bands]
        for m in range(1, self.largest + 1):
            weights = _lagrange(self._nodes, m)
            definite = self._bands[m > 1].positive(entries[m > 1], weights)
            found.append(0 if definite else self._interpolated_pivots(m, weights))
        return found

    def _interpolated_pivots(self, m: int, weights: Sequence[float]) -> int:
        if self._interpolated is None:
            self._interpolated = self._parts[0].copy()
            self._interpolated.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            self._interpolated.setOption(PETSc.Mat.Option.KEEP_NONZERO_PATTERN, True)
        K = self._interpolated
        K.zeroEntries()
        for part, weight in zip(self._parts, weights, strict=True):
            K.axpy(weight, part, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        K.zeroRowsColumnsLocal(self._rows(m), 1.0)
        self._counting.factor(K)
        return self._counting.negative_pivots

    def _rows(self, m: int) -> NDArray[np.int32]:
        return np.concatenate([bc.dof_indices()[0] for bc in self.held(m)])

    def negative_pivots(self, state: State, m: int) -> int:
        """Number of unstable directions among the waves m."""
        return self.factor_at(state, m).negative_pivots

    def unstable(self, state: State, largest: int | None = None) -> dict[int, int]:
        """m -> number of unstable directions, for the waves that have any."""
        found = {m: self.negative_pivots(state, m) for m in range(1, (largest or self.largest) + 1)}
        return {m: count for m, count in found.items() if count}

    def critical_eigenvalue(self, state: State, m: int) -> float:
        """Eigenvalue of Q_m's matrix nearest to zero; negative where Q_m is unstable."""
        unstable = self.negative_pivots(state, m) > 0
        value, _ = nearest_to_zero(self._factorisation)
        return -abs(value) if unstable else abs(value)

    def _assemble(self, K: PETSc.Mat, state: State, m: float, held: list[fem.DirichletBC]) -> None:
        """Q_m's matrix at the displacement that the system has."""
        self._m.value = m
        K.zeroEntries()
        for amplitude, form in self._forms:
            self._factor.value = 1.0 if amplitude is None else state.mu[amplitude]
            if self._factor.value:
                compat.add_matrix(K, form, held)
        compat.finish_matrix(K, self.V, held)

    def _second(self, e: Energy) -> ufl.Form:
        energy, v = self._of_wave(e)
        gradient = ufl.derivative(energy, v, ufl.TestFunction(self.V))
        hessian = ufl.derivative(gradient, v, ufl.TrialFunction(self.V))
        return at_zero(self._factor * hessian, v)  # where most of it vanishes

    def _of_wave(self, e: Energy) -> tuple[ufl.Form, fem.Function]:
        v, u = fem.Function(self.V), jets.revolved(self._system.u)
        cosine, sine = jets.wave(v, self._m)
        return np.pi * (e.added(u, cosine) + e.added(u, sine)), v


def _lagrange(nodes: NDArray[np.float64], at: float) -> list[float]:
    """What the values at some nodes weigh in their polynomial's value elsewhere."""
    others = [np.delete(nodes, i) for i in range(len(nodes))]
    return [float(np.prod((at - rest) / (node - rest))) for node, rest in zip(nodes, others, strict=True)]
