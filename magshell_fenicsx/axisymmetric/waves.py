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
from petsc4py import PETSc

from magshell_fenicsx import compat
from magshell_fenicsx.axisymmetric import jets
from magshell_fenicsx.axisymmetric.energies import INTERIOR, Energy
from magshell_fenicsx.axisymmetric.meridian import Meridian, held_at
from magshell_fenicsx.shell.parameters import Condition
from magshell_fenicsx.solve.factor import Factorisation
from magshell_fenicsx.solve.inverse import nearest_to_zero
from magshell_fenicsx.solve.kernels import KernelLog
from magshell_fenicsx.solve.problem import FiniteElementSystem
from magshell_fenicsx.solve.system import State


class Waves:
    """The second variation Q_m of an axisymmetric shell, for any m >= 1.

    Parameters
    ----------
    system
        Of the axisymmetric displacement.
    energies
        Its terms as functions of a jet, and the condition of the outer edge.

    Attributes
    ----------
    V
        Space of the waves' coefficients (U + V, V, W); see `jets.wave`.
    largest
        Waves that are looked at by default: m = 1 to this. The perfect sphere buckles in
        waves of length 2 pi sqrt(Rh)/(12(1 - nu^2))^(1/4), of which
        1.73 (nu = 0.5) to 1.86 (nu = 0) times sqrt(R/h) fit around the equator.
    """

    def __init__(
        self,
        system: FiniteElementSystem,
        energies: Sequence[Energy],
        meridian: Meridian,
        condition: Condition,
        log: KernelLog,
    ) -> None:
        self._system = system
        degree = system.u.function_space.element.basix_element.degree
        self.V = V = fem.functionspace(meridian.mesh, ("Lagrange", degree, (3,)))
        self.largest = ceil(2.2 / sqrt(system.length)) + 5
        self._m = fem.Constant(V.mesh, 1.0)
        self._factor = fem.Constant(V.mesh, 1.0)
        kept = [e for e in energies if not e.linear]
        self._forms = [(e.amplitude, log.compile(f"{e.name} waves", self._second(e))) for e in kept]
        axis, rim = meridian.axis, meridian.rim
        edge = [] if condition == "free" else [held_at(V, rim, i) for i in range(3)]
        self._held_once = [held_at(V, axis, 0), held_at(V, axis, 2), *edge]
        self._held = [held_at(V, axis, 1), *self._held_once]
        pattern = next(form for e, (_, form) in zip(kept, self._forms, strict=True) if e.name == INTERIOR)
        self._K = fem_petsc.create_matrix(pattern)
        self._K.setOption(PETSc.Mat.Option.SYMMETRIC, True)
        self._factorisation = Factorisation(V.mesh.comm)

    def tangent(self, state: State, m: int) -> PETSc.Mat:
        """The matrix of Q_m at an axisymmetric state; it is reused by the next call."""
        self._system.set(state.u)
        self._m.value = m
        held = self.held(m)
        self._K.zeroEntries()
        for amplitude, form in self._forms:
            self._factor.value = 1.0 if amplitude is None else state.mu[amplitude]
            if self._factor.value:
                compat.add_matrix(self._K, form, held)
        compat.finish_matrix(self._K, self.V, held)
        return self._K

    def held(self, m: int) -> list[fem.DirichletBC]:
        """What is held at the axis and at the rim: a wave m = 1 may move the axis across itself."""
        return self._held_once if m == 1 else self._held

    def negative_pivots(self, state: State, m: int) -> int:
        """Number of unstable directions among the waves m."""
        self._factorisation.factor(self.tangent(state, m))
        return self._factorisation.negative_pivots

    def unstable(self, state: State, largest: int | None = None) -> dict[int, int]:
        """m -> number of unstable directions, for the waves that have any."""
        found = {m: self.negative_pivots(state, m) for m in range(1, (largest or self.largest) + 1)}
        return {m: count for m, count in found.items() if count}

    def critical_eigenvalue(self, state: State, m: int) -> float:
        """Eigenvalue of Q_m's matrix nearest to zero; negative where Q_m is unstable."""
        unstable = self.negative_pivots(state, m) > 0
        value, _ = nearest_to_zero(self._factorisation)
        return -abs(value) if unstable else abs(value)

    def _second(self, e: Energy) -> ufl.Form:
        v, u = fem.Function(self.V), jets.revolved(self._system.u)
        cosine, sine = jets.wave(v, self._m)
        energy = np.pi * (e.of(u + cosine) + e.of(u + sine))
        gradient = ufl.derivative(energy, v, ufl.TestFunction(self.V))
        hessian = ufl.derivative(gradient, v, ufl.TrialFunction(self.V))
        return self._factor * ufl.replace(hessian, {v: ufl.zero(3)})  # at v = 0 most of it vanishes
