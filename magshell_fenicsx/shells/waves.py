"""Stability of an axisymmetric state against waves cos(m theta), m >= 1, which its model does not
see.

Along a wave v every component of a jet is a coefficient times cos(m theta) or sin(m theta),
so the second variation of an axisymmetric energy is pi times the sum of that of the
cosine's and of the sine's coefficients: one form on the meridian with m as a number.

Q_m is the second variation along waves m. In go an axisymmetric state and the energies as functions
of a jet (value and derivatives at a point); out come the matrix of Q_m, its number of negative
pivots (unstable directions), or all waves with any. A wave has three coefficients (U + V, V, W) at
each node of the meridian. "Entries" are the values of one triangle of a matrix, flat, as 3 x 3
blocks of pairs of nodes; all matrices have the same rows and columns for them (`Waves._sparsity`).
The constraints of the axis and the ends are put in later. Lengths are over R, energies over E h R².
"""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cache, cached_property
from math import ceil, comb, sqrt
from typing import Protocol

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
from magshell_fenicsx.assembly.nonlocal_terms import Entries, with_entries
from magshell_fenicsx.assembly.terms import FormTerm, factor_of
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.stability_monitor import ModeFamily
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models import domains
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.axisymmetric.wave_hessians import WaveHessians
from magshell_fenicsx.models.domains import Energy, IntegrationDomain
from magshell_fenicsx.parts.supports.on_meridian import Supports
from magshell_fenicsx.quantities.mode_labels import wave_label

Array = NDArray[np.float64]
DEGREE = 4  # degree in m of a wave's matrix, which five values of m determine


class NonlocalWaveTerm(Protocol):
    """A term that couples places of a meridian that are apart: a contact, or a T-junction."""

    def entries_of_waves(self, m: float) -> Entries:
        """Return the entries of its second variation along waves of m theta, as `Waves` has it."""


class Waves:
    """The second variation Q_m of an axisymmetric shell along waves cos(m theta), for any m >= 1.

    They are the `SymmetryBreakingModes` of a meridian (`continuation.stability_monitor`). Their
    matrices are those of coefficients (U + V, V, W) at the meridian's nodes.

    Parameters
    ----------
    system
        System of the axisymmetric displacement.
    energies
        The system's energies as functions of a jet.
    meridian
        Mesh of the meridian.
    domain
        Integration domain on the meridian.
    supports
        Supports of the axis and the ends.
    log
        Log that compiles kernels.
    nonlocal_terms
        Contacts and T-junctions, whose entries are not in the pattern of the other terms.

    Attributes
    ----------
    V
        Space of the waves' coefficients (U + V, V, W).
    largest
        Largest m that is examined by default, from 1 on. The perfect sphere buckles in waves of
        length 2 pi sqrt(Rh)/(12(1 - nu^2))^(1/4), of which 1.73 (nu = 0.5) to 1.86 (nu = 0) times
        sqrt(R/h) fit around the equator; a wider circle has more, and so has a surface of smaller
        radii of curvature.
    _system
        The parameter `system`.
    _log
        The parameter `log`.
    _m, _phi
        Wave number, and coefficients of a wave, as they stand in forms.
    _nonlinear_energies, _points
        Energies that are not linear in u, and their Hessians along waves at quadrature points.
    _energies
        Terms of Q_m(phi), made at the first call of `energies_along`.
    _nodes, _weights
        The five m of the interpolation, and the weights (largest + 1, 5) of their matrices for each
        m from 0 on.
    _ranges
        Ranges of m on which definiteness is tested, finer where the last states needed it.
    _held_once, _held
        Conditions of the axis and the ends for m = 1, and for all other m.
    _matrices
        Matrices that are filled again, by name.
    _factorisation, _counting
        Factors that `factor_at` returns, and factors for counts alone.
    """

    def __init__(
        self,
        system: FiniteElementSystem,
        energies: Sequence[Energy],
        meridian: Meridian,
        domain: IntegrationDomain,
        supports: Supports,
        log: KernelLog,
        nonlocal_terms: Sequence[NonlocalWaveTerm] = (),
    ) -> None:
        """Make the space of waves and the Hessians of the energies; parameters are the class's."""
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
        """Set the largest m, and the interpolation of matrices in m.

        The five nodes 0, +-a and +-b are Chebyshev points of [-largest, largest].
        """
        self.largest = largest
        self._nodes = largest * np.sin(np.pi / 4 * np.array([0, 1, 2, -1, -2]))
        self._weights = _lagrange_weights(self._nodes, np.arange(largest + 1))
        self._ranges = [_WaveRange(2, largest, self._nodes)]

    def _set_system(self, system: FiniteElementSystem) -> None:
        """Set the system whose waves these are, with empty matrices and factors."""
        self._system, self._matrices = system, dict[str, PETSc.Mat]()
        self._factorisation, self._counting = (Factorisation(self.V.mesh.comm) for _ in range(2))

    def for_system(self, system: FiniteElementSystem, largest: int) -> "Waves":
        """Return the waves of another system with the same terms, which shares their kernels.

        `largest` is its largest m, on which only the interpolation in m depends.
        """
        _ = self._bands, self._rows_of_matrix  # computed before copying, as both share these
        waves = copy(self)
        waves._set_system(system)
        if largest != self.largest:
            waves._set_largest(largest)
        return waves

    @property
    def families(self) -> Sequence[ModeFamily]:
        """Families of a `StabilityMonitor`: one for each m from 1 to `largest`."""
        return [WaveFamily(self, m) for m in range(1, self.largest + 1)]

    @property
    def tangents(self) -> "Waves | None":
        """The waves, which give tangents to a `StabilityMonitor`; None with nonlocal terms.

        The entries of these have no sparsity pattern in common, and are no polynomials in m.
        """
        return None if self.nonlocal_terms else self

    def tangent(self, state: State, m: int) -> PETSc.Mat:
        """Return the matrix of Q_m at an axisymmetric state; the next call overwrites it.

        It has the constraints of wave m, and the entries of contacts and T-junctions.
        """
        (entries,) = self._system.at_state(state).evaluate_forms(lambda: self._entries(state, [m]))
        K = self._matrix_of_entries("tangent", entries.ravel(), m)
        return self._with_nonlocal_entries(state, K, m)

    def _with_nonlocal_entries(self, state: State, K: PETSc.Mat, m: int) -> PETSc.Mat:
        """Return the matrix K of wave m with the entries of contacts and T-junctions at a state."""
        if not self.nonlocal_terms:
            return K
        entries = self._system.at_state(state).evaluate(
            lambda: [term.entries_of_waves(m) for term in self.nonlocal_terms]
        )
        # of each term: rows, columns and values
        rows, columns, values = (np.concatenate(arrays) for arrays in zip(*entries, strict=True))
        is_constrained = np.zeros(K.getSize()[0], dtype=bool)
        is_constrained[self._constrained_rows(m)] = True
        return with_entries(K, (rows, columns, values), is_constrained)

    def energies_along(self, phi: NDArray[np.float64], m: int) -> list[FormTerm]:
        """Return the terms of Q_m(phi), as functions of the axisymmetric displacement u.

        Their derivatives, by u or by the placement, tell how the stiffness of a mode changes. There
        is one term for each nonlinear energy of the shell. phi are a wave's coefficients at nodes.
        All calls return the same terms: a later call for other phi or m changes them.
        """
        self._phi.x.array[:], self._m.value = phi, m
        if not self._energies:
            for e in self._nonlinear_energies:
                # the second derivative by v along phi, at v = 0
                energy, v = self._energy_of_wave(e)
                second = ufl.derivative(ufl.derivative(energy, v, self._phi), v, self._phi)
                form = ufl.replace(second, {v: ufl.zero(3)})
                self._energies.append(
                    FormTerm(f"{e.name} along a wave", form, self._system.u, self._log, e.amplitude)
                )
        return self._energies

    def constraints(self, m: int) -> list[fem.DirichletBC]:
        """Return the conditions of wave m at the axis and the ends.

        A wave m = 1 may move the axis across itself, others may not.
        """
        return self._held_once if m == 1 else self._held

    def factor_at(self, state: State, m: int) -> Factorisation:
        """Factor the matrix of Q_m at an axisymmetric state.

        The next call overwrites the factors.
        """
        self._factorisation.factor(self.tangent(state, m))
        return self._factorisation

    def counts(self, state: State) -> list[int]:
        """Return the number of unstable directions of each wave m = 1, 2, ... `largest`.

        A jet of a wave is quadratic in m, and so Q_m is a polynomial of degree 4. Its matrices are
        interpolated between five, of m = 0, +-a and +-b. Q_-m is Q_m of the mirrored wave (U, -V,
        W), and so three are assembled. Only matrices that are not positive definite are factored
        for their inertia.
        """
        values = self.sampled_tangents(state)  # entries of the five matrices
        if not self.nonlocal_terms:
            return self.counts_from(values)
        # entries of contacts are no polynomials in m: each wave is factored with its own
        unstable = list[int]()
        for m in range(1, self.largest + 1):
            K = self._matrix_of_entries("interpolated", self._weights[m] @ values, m)
            self._counting.factor(self._with_nonlocal_entries(state, K, m))
            unstable.append(self._counting.negative_pivots)
        return unstable

    def sampled_tangents(self, state: State) -> NDArray[np.float64]:
        """Return the entries (5, entries) of the matrices at m = 0, a, b, -a, -b.

        These are the nodes of the interpolation in m. Constraints are not put in.
        """
        entries = self._system.at_state(state).evaluate_forms(
            lambda: self._entries(state, self._nodes[:3])
        )
        # those of -a and -b follow from those of a and b
        return np.concatenate([entries, _mirrored(entries[1:])]).reshape(len(self._nodes), -1)

    def counts_from(self, values: NDArray[np.float64]) -> list[int]:
        """Return the number of unstable directions of each wave m = 1, 2, ... `largest`.

        `values` (5, entries) are matrices that `sampled_tangents` gave.
        """
        unstable = [0] * self.largest
        for m in self._indefinite(values):
            unstable[m - 1] = self._interpolated_pivots(m, values)
        return unstable

    def indefinite(self, values: NDArray[np.float64]) -> set[int]:
        """Return the indices m - 1 of the waves whose matrices are not positive definite.

        An index is that of a wave's family (`families`). `values` are matrices that
        `sampled_tangents` gave.
        """
        ranges = self._ranges
        try:
            return {m - 1 for m in self._indefinite(values)}
        finally:
            self._ranges = ranges  # the ranges stay those that fit states of the path

    def _entries(
        self, state: State, waves: Sequence[float] | NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the entries of Q_m's matrices at the system's displacement, without constraints.

        The shape is (waves, pairs of nodes, 3, 3); `waves` are the numbers m, which need not be
        whole.
        """
        # amplitude (None: 1) -> factor of its energies
        factors = {e.amplitude: factor_of(e.amplitude, state.mu) for e in self._nonlinear_energies}
        return self._points.entries(factors, [float(m) for m in waves])

    @cached_property
    def _bands(self) -> "list[BandedMatrices]":
        """Banded matrices of m = 1, and of all other m, which have other constraints."""
        return [BandedMatrices(*self._sparsity, self._constrained_rows(m)) for m in (1, 2)]

    @cached_property
    def _sparsity(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Row and column of each entry of a wave's matrix, two flat arrays.

        They cover one triangle of node pairs, with the full blocks of a node with itself.
        """
        # rows and columns of the 3 x 3 blocks: those of the nodes, plus the component
        first_rows, first_columns = (
            3 * nodes[:, None, None] + np.zeros((3, 3), dtype=np.int64)
            for nodes in (self._points.rows, self._points.columns)
        )
        components = np.arange(3)
        rows, columns = first_rows + components[:, None], first_columns + components
        return rows.ravel(), columns.ravel()

    @cached_property
    def _rows_of_matrix(self) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.int64]]:
        """The full matrix in compressed rows: row starts, columns, and for each value its entry.

        Entries are of one triangle. So a value of the other triangle has the same entry as its
        mirror image.
        """
        rows, columns = self._sparsity
        # entries that the other triangle mirrors
        mirrored_entries = np.flatnonzero(rows // 3 != columns // 3)
        positions = (
            np.concatenate([rows, columns[mirrored_entries]]),
            np.concatenate([columns, rows[mirrored_entries]]),
        )
        # a matrix whose values are the numbers of entries
        numbers = np.concatenate([np.arange(len(rows)), mirrored_entries])
        K = coo_array((numbers, positions)).tocsr()
        return K.indptr.astype(PETSc.IntType), K.indices.astype(PETSc.IntType), K.data

    def _indefinite(self, values: NDArray[np.float64]) -> list[int]:
        """Return the waves whose matrices are not positive definite, sorted.

        `values` (5, entries) are the matrices at the nodes of the interpolation in m. On a range of
        m the matrix is a mean of its five Bernstein coefficients with weights that are not
        negative. If all five are positive definite, the matrix is so for every m of the range. Else
        the range is halved, for the next states too. A range with no more waves than coefficients
        is tested wave by wave.
        """
        # banded matrices: of the wave m = 1, and the five that other waves are interpolated from
        bands_of_one, bands_of_others = self._bands
        matrix_of_one = bands_of_one.bands([self._weights[1] @ values])
        matrices_of_others = bands_of_others.bands(values)

        def is_definite(weights: NDArray[np.float64]) -> bool:
            """Return whether the sum of the five with these weights is positive definite."""
            return bands_of_others.is_positive_definite(matrices_of_others, weights)

        is_definite_wave = cache(lambda m: is_definite(self._weights[m]))  # ends are shared
        indefinite = set[int]()
        if not bands_of_one.is_positive_definite(matrix_of_one, np.ones(1)):
            indefinite.add(1)
        # Ranges still to be tested. Those that pass make a new list: copies of these waves share
        # the old one.
        open_ranges, self._ranges = [*self._ranges], []
        while open_ranges:
            wave_range = open_ranges.pop()
            first, last = wave_range.first, wave_range.last
            if wave_range.short:
                indefinite |= {m for m in range(first, last + 1) if not is_definite_wave(m)}
                self._ranges.append(wave_range)
                continue
            # the first and the last of the Bernstein coefficients are the matrices of these waves
            ends_are_definite = is_definite_wave(first) and is_definite_wave(last)
            if ends_are_definite and all(is_definite(weights) for weights in wave_range.inner):
                self._ranges.append(wave_range)
            else:
                open_ranges += wave_range.halves(self._nodes)
        return sorted(indefinite)

    def _interpolated_pivots(self, m: int, values: NDArray[np.float64]) -> int:
        """Return the number of negative pivots of the interpolated matrix of wave m."""
        self._counting.factor(self._matrix_of_entries("interpolated", self._weights[m] @ values, m))
        return self._counting.negative_pivots

    def _matrix_of_entries(self, name: str, entries: NDArray[np.float64], m: int) -> PETSc.Mat:
        """Return the matrix of wave m from its entries, with its constraints.

        The next call with the same `name` overwrites it.
        """
        row_starts, columns, entry_numbers = self._rows_of_matrix
        data = entries[entry_numbers]
        if name not in self._matrices:
            matrix = PETSc.Mat().createAIJ(
                (len(row_starts) - 1,) * 2, csr=(row_starts, columns, data), comm=self.V.mesh.comm
            )
            matrix.setOption(PETSc.Mat.Option.SYMMETRIC, True)
            matrix.setOption(PETSc.Mat.Option.KEEP_NONZERO_PATTERN, True)
            self._matrices[name] = matrix
        matrix = self._matrices[name]
        matrix.setValuesCSR(row_starts, columns, data)
        matrix.assemble()
        matrix.zeroRowsColumns(self._constrained_rows(m), 1.0)
        return matrix

    def _constrained_rows(self, m: int) -> NDArray[np.int32]:
        """Return the numbers of the constrained rows of wave m."""
        return np.concatenate([bc.dof_indices()[0] for bc in self.constraints(m)])

    def negative_pivots(self, state: State, m: int) -> int:
        """Return the number of unstable directions among the waves m at a state."""
        return self.factor_at(state, m).negative_pivots

    def unstable(self, state: State, largest: int | None = None) -> dict[int, int]:
        """Return m -> number of unstable directions, for waves up to `largest` with any."""
        pivots = {
            m: self.negative_pivots(state, m) for m in range(1, (largest or self.largest) + 1)
        }
        return {m: count for m, count in pivots.items() if count}

    def _energy_of_wave(self, e: Energy) -> tuple[ufl.Form, fem.Function]:
        """Return a form whose Hessian by v, at v = 0, is that of an energy along waves m; and v.

        v holds the coefficients of the wave. The form is pi times the sum of the energies of the
        cosine's and of the sine's coefficients, since both squares have the integral pi around e3.
        """
        v, u = fem.Function(self.V), domains.revolved_jet(self._system.u)
        cosine, sine = domains.wave_jets(v, self._m)
        return np.pi * (e.perturbed_form(u, cosine) + e.perturbed_form(u, sine)), v


def wave_in_space(coefficients: Array, m: int, theta: Array) -> Array:
    """Return the displacement (..., 3) of a wave m at azimuths theta.

    It is U cos(m theta) e_rho + V sin(m theta) e_theta + W cos(m theta) e_z. Torsion, m = 0, is
    V e_theta.

    Parameters
    ----------
    coefficients
        (..., 3): U + V, V and W; the sum is zero on the axis.
    theta
        Azimuths (rad), of a shape that broadcasts with that of each coefficient.
    """
    U_plus_V, V, W = np.moveaxis(coefficients, -1, 0)
    cosine, sine = (np.cos(m * theta), np.sin(m * theta)) if m else (0 * theta, 1 + 0 * theta)
    radial, azimuthal = (U_plus_V - V) * cosine, V * sine
    x = radial * np.cos(theta) - azimuthal * np.sin(theta)
    y = radial * np.sin(theta) + azimuthal * np.cos(theta)
    return np.stack([x, y, W * cosine], axis=-1)


def largest_wave_number(meridian: Meridian, length: float) -> int:
    """Return the largest m that is examined by default; `length` is h/R.

    Waves of the length in which a sphere buckles fit 1.73 to 1.86 sqrt(R/h) times around its
    equator. A wider circle and a larger curvature, both relative to the sphere, have more.
    """
    # 2.2, and 5 more, is a margin over the sphere's number
    return ceil(2.2 * meridian.reach * sqrt(meridian.curvature / length)) + 5


class _WaveRange:
    """The waves from a first to a last one.

    Attributes
    ----------
    first, last
        Smallest and largest m.
    short
        Whether its waves are as few as Bernstein coefficients.
    inner
        (3, nodes) weights of values at the nodes in the inner three Bernstein coefficients.
    """

    def __init__(self, first: int, last: int, nodes: NDArray[np.float64]) -> None:
        """Compute the Bernstein weights of the waves `first` to `last`, from the `nodes` in m."""
        self.first, self.last, self.short = first, last, last - first < DEGREE
        places = np.arange(DEGREE + 1) / DEGREE
        bernstein = [
            comb(DEGREE, i) * places**i * (1 - places) ** (DEGREE - i) for i in range(DEGREE + 1)
        ]
        # Bernstein coefficients from values at five equidistant places of the range
        weights_at_places = _lagrange_weights(nodes, first + (last - first) * places)
        self.inner = np.linalg.solve(np.stack(bernstein, axis=1), weights_at_places)[1:-1]

    def halves(self, nodes: NDArray[np.float64]) -> list["_WaveRange"]:
        """Return both halves of the range; the geometric mean of its ends is in both.

        `nodes` are those of the interpolation in m.
        """
        middle = round(sqrt(self.first * self.last))  # the matrices vary most at small m
        return [_WaveRange(self.first, middle, nodes), _WaveRange(middle, self.last, nodes)]


def _lagrange_weights(
    nodes: NDArray[np.float64], places: NDArray[np.float64] | NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the weights (places, nodes) of Lagrange's interpolation at other places.

    The polynomial's value at a place is the sum of the weights times the values at the nodes.
    """
    # one column for each node: the polynomial that is one there and zero at the others
    others = [np.delete(nodes, i) for i in range(len(nodes))]
    columns = [
        np.prod((places[:, None] - other_nodes) / (node - other_nodes), axis=1)
        for node, other_nodes in zip(nodes, others, strict=True)
    ]
    return np.stack(columns, axis=1)


def _mirrored(entries: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the entries (.., 3, 3) of Q_-m from those of Q_m.

    With -V in place of V, P = U + V becomes P - 2 V. So the matrix is S^T Q S with S = ((1, -2, 0),
    (0, -1, 0), (0, 0, 1)): columns first, then rows.
    """
    mirrored = entries.copy()
    mirrored[..., 1] = -2 * mirrored[..., 0] - mirrored[..., 1]
    mirrored[..., 1, :] = -2 * mirrored[..., 0, :] - mirrored[..., 1, :]
    return mirrored


@dataclass(frozen=True)
class WaveFamily:
    """The waves of one number m, whose stability a monitor follows.

    It is a `continuation.stability_monitor.ModeFamily`.
    """

    waves: Waves
    m: int

    @property
    def label(self) -> str:
        return wave_label(self.m)

    def factor_at(self, state: State) -> Factorisation:
        """Factor the matrix of Q_m at an axisymmetric state.

        The next call for these waves overwrites the factors.
        """
        return self.waves.factor_at(state, self.m)


class BandedMatrices:
    """Weighted sums of small symmetric matrices that share one sparsity pattern.

    LAPACK's banded Cholesky factors tell whether a sum is positive definite.

    Parameters
    ----------
    rows, columns
        Row and column of each entry of the pattern; one triangle is enough.
    constrained_rows
        Rows and columns that are replaced by those of the unit matrix.

    Attributes
    ----------
    _free_entries, _band_positions
        Entries of the pattern outside constrained rows and columns, and their positions in a band.
    _shape
        Diagonals and columns of the band.
    _held_numbers
        Numbers of the constrained rows in the band, which has the rows in the order of reverse
        Cuthill and McKee.
    """

    def __init__(
        self,
        rows: NDArray[np.int64],
        columns: NDArray[np.int64],
        constrained_rows: NDArray[np.int32],
    ) -> None:
        """Order rows for a narrow band; parameters are those of the class."""
        n = int(rows.max()) + 1
        positions = np.concatenate([rows, columns]), np.concatenate([columns, rows])
        pattern = coo_array((np.ones(2 * len(rows)), positions), (n, n)).tocsr()
        # new number of each row
        order = reverse_cuthill_mckee(pattern, symmetric_mode=True)
        new_number = np.empty(n, dtype=np.int64)
        new_number[order] = np.arange(n)
        # entries in constrained rows and columns are left out
        is_free = np.ones(n, dtype=bool)
        is_free[constrained_rows] = False
        self._free_entries = np.flatnonzero(is_free[rows] & is_free[columns])
        new_rows = new_number[rows[self._free_entries]]
        new_columns = new_number[columns[self._free_entries]]
        # entries of the lower triangle
        i, j = np.maximum(new_rows, new_columns), np.minimum(new_rows, new_columns)
        self._shape = (int((i - j).max(initial=0)) + 1, n)  # diagonals of the band, columns
        # in LAPACK's lower band, column by column
        self._band_positions = (i - j) + j * self._shape[0]
        self._held_numbers = new_number[constrained_rows]

    def bands(self, values: Iterable[Array]) -> Array:
        """Return the lower bands (matrices, band entries) of some matrices.

        Each matrix is given by the values of its pattern's entries; constrained rows get ones on
        the diagonal.
        """
        values = list(values)
        stacked = np.zeros((len(values), self._shape[0] * self._shape[1]))
        for band, v in zip(stacked, values, strict=True):
            band[self._band_positions] = v.ravel()[self._free_entries]
        # the diagonal is the first in each column of the band
        stacked[:, self._held_numbers * self._shape[0]] = 1.0
        return stacked

    def is_positive_definite(self, bands: Array, weights: Array) -> bool:
        """Return whether a weighted sum of matrices is positive definite.

        `bands` (matrices, band entries) are their lower bands. The weights add up to one, and so do
        the ones on the diagonal of constrained rows.
        """
        band = (weights @ bands).reshape(self._shape, order="F")
        _, info = lapack.dpbtrf(band, lower=1, overwrite_ab=1)
        return bool(info == 0)
