"""Stability of an axisymmetric state against waves cos(m theta), m >= 1, which its model does not
see.

Along a wave v every component of a jet is a coefficient times cos(m theta) or sin(m theta),
so the second variation of an axisymmetric energy is pi times the sum of that of the
cosine's and of the sine's coefficients: one form on the meridian with m as a number.
"""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cache, cached_property
from math import ceil, comb, sqrt
from typing import TYPE_CHECKING

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.linalg import lapack
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.nonlocal_terms import with_entries
from magshell_fenicsx.assembly.terms import FormTerm, factor_of
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.stability_monitor import ModeFamily
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models import domains
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.axisymmetric.wave_hessians import WaveHessians
from magshell_fenicsx.models.domains import Energy, IntegrationDomain
from magshell_fenicsx.parts.contact.meridian_contact import MeridianContact
from magshell_fenicsx.parts.supports.on_meridian import Supports

if TYPE_CHECKING:
    from magshell_fenicsx.shells.t_junctions import MeridianTJunction

Array = NDArray[np.float64]
DEGREE = 4  # of the matrix of a wave as a polynomial in m


class Waves:
    """The second variation Q_m of an axisymmetric shell, for any m >= 1.

    Parameters
    ----------
    system
        System of the axisymmetric displacement.
    energies
        Its terms as functions of a jet.
    supports
        Supports of the axis and the ends.
    nonlocal_terms
        Contacts and T-junctions, whose entries are not in the pattern of the others.

    Attributes
    ----------
    V
        Space of the waves' coefficients (U + V, V, W); see `domains.wave_jets`.
    largest
        Largest m that is examined by default, from 1 on. The perfect sphere buckles in waves of
        length 2 pi sqrt(Rh)/(12(1 - nu^2))^(1/4), of which 1.73 (nu = 0.5) to 1.86 (nu = 0) times
        sqrt(R/h) fit around the equator; a wider circle has more, and so has a surface of smaller
        radii of curvature.
    """

    def __init__(
        self,
        system: FiniteElementSystem,
        energies: Sequence[Energy],
        meridian: Meridian,
        domain: IntegrationDomain,
        supports: Supports,
        log: KernelLog,
        nonlocal_terms: "Sequence[MeridianContact | MeridianTJunction]" = (),
    ) -> None:
        self.nonlocal_terms = nonlocal_terms
        degree = system.u.function_space.element.basix_element.degree
        self.V = V = fem.functionspace(meridian.mesh, ("Lagrange", degree, (3,)))
        self._m = fem.Constant(V.mesh, 1.0)
        self._nonlinear_energies = [e for e in energies if not e.linear]
        self._points = WaveHessians(domain, system.u, self._nonlinear_energies, log)
        self._phi, self._energies, self._log = fem.Function(V, name="phi"), list[FormTerm](), log
        self._held_once, self._held = supports.wave_conditions(V, 1), supports.wave_conditions(V, 2)
        self._set_largest(largest_wave_number(meridian, system.length))
        self._set_system(system)

    def _set_largest(self, largest: int) -> None:
        self.largest = largest
        self._nodes = largest * np.sin(np.pi / 4 * np.array([0, 1, 2, -1, -2]))
        self._weights = _lagrange_weights(self._nodes, np.arange(largest + 1))
        self._ranges = [_WaveRange(2, largest, self._nodes)]

    def _set_system(self, system: FiniteElementSystem) -> None:
        self._system, self._matrices = system, dict[str, PETSc.Mat]()
        self._factorisation, self._counting = (Factorisation(self.V.mesh.comm) for _ in range(2))

    def for_system(self, system: FiniteElementSystem, largest: int) -> "Waves":
        """Return the waves of another system with the same terms."""
        _ = self._bands, self._rows_of_matrix  # both have these
        other = copy(self)
        other._set_system(system)
        if largest != self.largest:
            other._set_largest(largest)
        return other

    def tangent(self, state: State, m: int) -> PETSc.Mat:
        """Return the matrix of Q_m at an axisymmetric state; it is reused by the next call."""
        (entries,) = self._system.at_state(state).evaluate_forms(lambda: self._entries(state, [m]))
        return self._with_nonlocal_entries(state, self._filled("tangent", entries.ravel(), m), m)

    def _with_nonlocal_entries(self, state: State, K: PETSc.Mat, m: int) -> PETSc.Mat:
        """Return the matrix K with the entries of contacts and T-junctions at a state."""
        if not self.nonlocal_terms:
            return K
        entries = self._system.at_state(state).evaluate(
            lambda: [term.entries_of_waves(m) for term in self.nonlocal_terms]
        )
        rows, columns, values = (np.concatenate(parts) for parts in zip(*entries, strict=True))
        fixed = np.zeros(K.getSize()[0], dtype=bool)
        fixed[self._rows(m)] = True
        return with_entries(K, (rows, columns, values), fixed)

    def energies_along(self, phi: NDArray[np.float64], m: int) -> list[FormTerm]:
        """Return Q_m(phi) as energies of the axisymmetric displacement, one for each energy of the
        shell; for one phi and m at a time.
        """
        self._phi.x.array[:], self._m.value = phi, m
        if not self._energies:
            for e in self._nonlinear_energies:
                energy, v = self._of_wave(e)
                twice = ufl.derivative(ufl.derivative(energy, v, self._phi), v, self._phi)
                form = ufl.replace(twice, {v: ufl.zero(3)})
                self._energies.append(
                    FormTerm(f"{e.name} along a wave", form, self._system.u, self._log, e.amplitude)
                )
        return self._energies

    def constraints(self, m: int) -> list[fem.DirichletBC]:
        """Return the constraints at the axis and at the ends: a wave m = 1 may move the axis across
        itself.
        """
        return self._held_once if m == 1 else self._held

    def factor_at(self, state: State, m: int) -> Factorisation:
        """Factor the matrix of Q_m at an axisymmetric state; the next call overwrites the
        factors.
        """
        self._factorisation.factor(self.tangent(state, m))
        return self._factorisation

    def counts(self, state: State) -> list[int]:
        """Return the number of unstable directions of each wave m = 1, 2, ... `largest`.

        A jet of a wave is quadratic in m, and so Q_m is a polynomial of degree 4: its matrices are
        interpolated between five, of m = 0, +-a and +-b. Q_-m is Q_m of the mirrored wave (U, -V,
        W), and so three are assembled. Only those that are not positive definite are factored for
        their inertia.
        """
        values = self.sampled_tangents(state)
        if not self.nonlocal_terms:
            return self.counts_from(values)
        unstable = list[int]()
        for m in range(1, self.largest + 1):
            K = self._filled("interpolated", self._weights[m] @ values, m)
            self._counting.factor(self._with_nonlocal_entries(state, K, m))
            unstable.append(self._counting.negative_pivots)
        return unstable

    def sampled_tangents(self, state: State) -> NDArray[np.float64]:
        """Return the entries (5, entries) of the matrices at the five m."""
        of_nodes = self._system.at_state(state).evaluate_forms(
            lambda: self._entries(state, self._nodes[:3])
        )
        return np.concatenate([of_nodes, _mirrored(of_nodes[1:])]).reshape(len(self._nodes), -1)

    def counts_from(self, values: NDArray[np.float64]) -> list[int]:
        """Return `counts` from the matrices that `sampled_tangents` gives."""
        unstable = [0] * self.largest
        for m in self._indefinite(values):
            unstable[m - 1] = self._interpolated_pivots(m, values)
        return unstable

    def indefinite(self, values: NDArray[np.float64]) -> set[int]:
        """Return m - 1 of the waves whose matrices, as `sampled_tangents` gives them, are not
        positive definite.
        """
        ranges = self._ranges
        try:
            return {m - 1 for m in self._indefinite(values)}
        finally:
            self._ranges = ranges  # fit for states of the path

    def _entries(
        self, state: State, waves: Sequence[float] | NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the entries (waves, pairs of nodes, 3, 3) of Q_m's matrices, without constraints,
        at the system's displacement.
        """
        factors = {e.amplitude: factor_of(e.amplitude, state.mu) for e in self._nonlinear_energies}
        return self._points.entries(factors, [float(m) for m in waves])

    @cached_property
    def _bands(self) -> "list[BandedMatrices]":
        """Banded matrices of m = 1, and of all other m."""
        return [BandedMatrices(*self._sparsity, self._rows(m)) for m in (1, 2)]

    @cached_property
    def _sparsity(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows and columns of these entries: those of one triangle, and all of the nodes' own
        blocks.
        """
        rows, columns = (
            3 * a[:, None, None] + np.zeros((3, 3), dtype=np.int64)
            for a in (self._points.rows, self._points.columns)
        )
        return (rows + np.arange(3)[:, None]).ravel(), (columns + np.arange(3)).ravel()

    @cached_property
    def _rows_of_matrix(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
        """The whole matrix in compressed rows: row starts, columns, and the number of each entry in
        `_sparsity`.
        """
        rows, columns = self._sparsity
        mirrored_entries = np.flatnonzero(rows // 3 != columns // 3)  # mirrored: the other triangle
        positions = (
            np.concatenate([rows, columns[mirrored_entries]]),
            np.concatenate([columns, rows[mirrored_entries]]),
        )
        K = coo_array((np.concatenate([np.arange(len(rows)), mirrored_entries]), positions)).tocsr()
        return K.indptr.astype(PETSc.IntType), K.indices.astype(PETSc.IntType), K.data

    def _indefinite(self, values: NDArray[np.float64]) -> list[int]:
        """Return the waves whose matrices are not positive definite, from the entries (nodes,
        entries) at the nodes.

        On a range of m the matrix is a mean of its five Bernstein coefficients with
        weights that are not negative: if these are positive definite, it is so for every m of the
        range. Else the range is halved, for the next states too, until its waves are as few as
        coefficients.
        """
        bands_of_one, bands_of_others = self._bands
        matrix_of_one = bands_of_one.bands([self._weights[1] @ values])
        matrices_of_others = bands_of_others.bands(values)

        def is_definite(weights: NDArray[np.float64]) -> bool:
            return bands_of_others.is_positive_definite(matrices_of_others, weights)

        is_definite_wave = cache(lambda m: is_definite(self._weights[m]))
        indefinite = set[int]()
        if not bands_of_one.is_positive_definite(matrix_of_one, np.ones(1)):
            indefinite.add(1)
        open_ranges, self._ranges = [*self._ranges], []  # of others of the same terms too
        while open_ranges:
            wave_range = open_ranges.pop()
            first, last = wave_range.first, wave_range.last
            if wave_range.short:
                indefinite |= {m for m in range(first, last + 1) if not is_definite_wave(m)}
            elif not (
                is_definite_wave(first)
                and is_definite_wave(last)
                and all(is_definite(weights) for weights in wave_range.inner)
            ):
                open_ranges += wave_range.halves(self._nodes)
                continue
            self._ranges.append(wave_range)
        return sorted(indefinite)

    def _interpolated_pivots(self, m: int, values: NDArray[np.float64]) -> int:
        self._counting.factor(self._filled("interpolated", self._weights[m] @ values, m))
        return self._counting.negative_pivots

    def _filled(self, name: str, entries: NDArray[np.float64], m: int) -> PETSc.Mat:
        """Return a matrix with these entries, in the order of `_sparsity`, and constraints; the
        next call overwrites it.
        """
        first, columns, places = self._rows_of_matrix
        data = entries[places]
        if name not in self._matrices:
            matrix = PETSc.Mat().createAIJ(
                (len(first) - 1,) * 2, csr=(first, columns, data), comm=self.V.mesh.comm
            )
            matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            matrix.setOption(PETSc.Mat.Option.KEEP_NONZERO_PATTERN, True)
            self._matrices[name] = matrix
        matrix = self._matrices[name]
        matrix.setValuesCSR(first, columns, data)
        matrix.assemble()
        matrix.zeroRowsColumns(self._rows(m), 1.0)
        return matrix

    def _rows(self, m: int) -> NDArray[np.int32]:
        return np.concatenate([bc.dof_indices()[0] for bc in self.constraints(m)])

    def negative_pivots(self, state: State, m: int) -> int:
        """Number of unstable directions among the waves m."""
        return self.factor_at(state, m).negative_pivots

    def unstable(self, state: State, largest: int | None = None) -> dict[int, int]:
        """m -> number of unstable directions, for the waves that have any."""
        pivots = {
            m: self.negative_pivots(state, m) for m in range(1, (largest or self.largest) + 1)
        }
        return {m: count for m, count in pivots.items() if count}

    def _of_wave(self, e: Energy) -> tuple[ufl.Form, fem.Function]:
        v, u = fem.Function(self.V), domains.revolved_jet(self._system.u)
        cosine, sine = domains.wave_jets(v, self._m)
        return np.pi * (e.perturbed_form(u, cosine) + e.perturbed_form(u, sine)), v


def largest_wave_number(meridian: Meridian, length: float) -> int:
    """Return the largest m that is examined, see `Waves.largest`."""
    return ceil(2.2 * meridian.reach * sqrt(meridian.curvature / length)) + 5


class _WaveRange:
    """The waves from a first to a last one.

    Attributes
    ----------
    inner
        (3, nodes) weights of values at the nodes in the inner three Bernstein coefficients.
    """

    def __init__(self, first: int, last: int, nodes: NDArray[np.float64]) -> None:
        self.first, self.last, self.short = first, last, last - first < DEGREE
        places = np.arange(DEGREE + 1) / DEGREE
        bernstein = [
            comb(DEGREE, i) * places**i * (1 - places) ** (DEGREE - i) for i in range(DEGREE + 1)
        ]
        values = _lagrange_weights(nodes, first + (last - first) * places)
        self.inner = np.linalg.solve(np.stack(bernstein, axis=1), values)[1:-1]

    def halves(self, nodes: NDArray[np.float64]) -> list["_WaveRange"]:
        middle = round(sqrt(self.first * self.last))  # the matrices vary most at small m
        return [_WaveRange(self.first, middle, nodes), _WaveRange(middle, self.last, nodes)]


def _lagrange_weights(
    nodes: NDArray[np.float64], places: NDArray[np.float64] | NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the weights (places, nodes) of values at nodes in their polynomial's values at other
    places.
    """
    others = [np.delete(nodes, i) for i in range(len(nodes))]
    columns = [
        np.prod((places[:, None] - rest) / (node - rest), axis=1)
        for node, rest in zip(nodes, others, strict=True)
    ]
    return np.stack(columns, axis=1)


def _mirrored(entries: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the entries (.., 3, 3) of Q_-m from those of Q_m: with -V in place of V, P = U + V
    becomes P - 2 V.
    """
    mirrored = entries.copy()
    mirrored[..., 1] = -2 * mirrored[..., 0] - mirrored[..., 1]
    mirrored[..., 1, :] = -2 * mirrored[..., 0, :] - mirrored[..., 1, :]
    return mirrored


@dataclass(frozen=True)
class WaveFamily:
    """The waves of one number m; a `continuation.stability_monitor.ModeFamily`."""

    waves: Waves
    m: int

    @property
    def label(self) -> str:
        return f"m = {self.m}"

    def factor_at(self, state: State) -> Factorisation:
        """Factor their tangent at an axisymmetric state."""
        return self.waves.factor_at(state, self.m)


@dataclass(frozen=True)
class SymmetryBreakingWaves:
    """All waves around the axis that are examined."""

    waves: Waves

    @property
    def families(self) -> Sequence[ModeFamily]:
        """Families of a `StabilityMonitor`: one for each m."""
        return [WaveFamily(self.waves, m) for m in range(1, self.waves.largest + 1)]

    @property
    def tangents(self) -> Waves | None:
        """Tangents for a `StabilityMonitor`; None with contacts, whose entries have no pattern in
        common.
        """
        return None if self.waves.nonlocal_terms else self.waves

    def counts(self, state: State) -> Sequence[int]:
        """Numbers of unstable directions of all families at a state."""
        return self.waves.counts(state)

    def is_unstable(self, state: State) -> bool:
        """Whether some wave is unstable at an axisymmetric state."""
        return any(self.waves.counts(state))


class BandedMatrices:
    """Weighted sums of small symmetric matrices that share one sparsity pattern, and whether they
    are definite.

    LAPACK's banded Cholesky factors answer that.

    Parameters
    ----------
    rows, columns
        Row and column of each entry of the pattern; one triangle is enough.
    constrained_rows
        Rows and columns that are replaced by those of the unit matrix.
    """

    def __init__(
        self,
        rows: NDArray[np.int64],
        columns: NDArray[np.int64],
        constrained_rows: NDArray[np.int32],
    ) -> None:
        n = int(rows.max()) + 1
        positions = np.concatenate([rows, columns]), np.concatenate([columns, rows])
        pattern = coo_array((np.ones(2 * len(rows)), positions), (n, n)).tocsr()
        order = reverse_cuthill_mckee(pattern, symmetric_mode=True)
        place = np.empty(n, dtype=np.int64)
        place[order] = np.arange(n)
        is_free = np.ones(n, dtype=bool)
        is_free[constrained_rows] = False
        self._free_entries = np.flatnonzero(is_free[rows] & is_free[columns])
        rows, columns = rows[self._free_entries], columns[self._free_entries]
        i, j = np.maximum(place[rows], place[columns]), np.minimum(place[rows], place[columns])
        self._shape = (int((i - j).max(initial=0)) + 1, n)
        self._band_positions = (i - j) + j * self._shape[
            0
        ]  # in LAPACK's lower band, column by column
        self._held_places = place[constrained_rows]

    def bands(self, values: Iterable[Array]) -> Array:
        """Return the lower bands (matrices, entries) of some matrices, with ones on the diagonal of
        constrained rows.
        """
        values = list(values)
        stacked = np.zeros((len(values), self._shape[0] * self._shape[1]))
        for band, v in zip(stacked, values, strict=True):
            band[self._band_positions] = v.ravel()[self._free_entries]
        stacked[:, self._held_places * self._shape[0]] = 1.0
        return stacked

    def is_positive_definite(self, bands: Array, weights: Array) -> bool:
        """Whether the weighted sum of some matrices is positive definite; the weights' sum is
        one.
        """
        band = (weights @ bands).reshape(self._shape, order="F")
        return bool(lapack.dpbtrf(band, lower=1, overwrite_ab=1)[1] == 0)
