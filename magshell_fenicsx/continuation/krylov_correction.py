"""Inertia and solutions of a sparse matrix with a dense correction, from sparse factors.

A tangent K = K0 + D has a sparse part K0, which is factored, and a dense part D, mostly small
compared with it, of which only products are computed. The matrix A = K0^-1 D has an eigenvalue -1
where K is singular. On the way K0 + t D, t from 0 to 1, an eigenvalue nu < -1 of A makes it
singular once, at t = -1/nu, with the vector x of nu: one more negative eigenvalue where
x . D x < 0, else one less. So the inertia of K is that of K0 plus what the few eigenvalues of A
below -1 contribute. Arnoldi's method finds them; generalised conjugate residuals solve with K.

A lagged part of K belongs to an earlier state, so its error may be as large as the part itself.
Vectors are parts of this rank; a dot is the inner product over all ranks. Two vectors are
K-conjugate if x . K y = 0.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import CorrectedTangent, DenseCorrection, Vector, dot

SMALL_EIGENVALUE = 0.1  # eigenvalues of A within this magnitude are not computed one by one
# products with A per Arnoldi run: at least as many as show that no other large eigenvalue exists,
# and at most so many before it is given up
MIN_PRODUCTS, MAX_PRODUCTS = 4, 30
# Arnoldi runs, each without the vectors found before: eigenvalues may be multiple
MAX_RUNS = 6
EIGENVALUE_TOLERANCE = 0.1  # error of an eigenvalue over its distance from -1
TOLERANCE = 1e-12  # of a solution's residual, over that of zero
ACCEPTED_TOLERANCE = 1e-7  # the same where rounding prevents more
LOOSE_TOLERANCE = 3e-2  # the same for a step of Newton's method
# of the tangent: extrapolated changes below it alter no sign, even if their error is as large
MAX_MISSING_PART = 0.5
# a larger uncertainty is reduced: the lagged part is corrected along vectors of large eigenvalues,
MAX_UNCERTAINTY = 1.0
MAX_CORRECTED_VECTORS = 3  # if there are no more than this many
MAX_STORED_PRODUCTS = 40  # products with D that are stored
DEPENDENCE_TOLERANCE = 1e-12  # square of the part of a vector that is independent of others
Array = NDArray[np.float64]
LinearMap = Callable[[Vector], Vector]


class ArnoldiBasis:
    """An orthonormal basis of a Krylov space and the matrix H in it (Arnoldi's method).

    H has one row more than columns: the last entry is the part of the newest image outside the
    space.

    Parameters
    ----------
    times
        Product of the matrix with a vector.
    first
        The vector that the space begins with.
    max_size
        Largest number of columns of H.
    """

    def __init__(self, times: LinearMap, first: Vector, comm: MPI.Comm, max_size: int) -> None:
        self._times, self._comm = times, comm
        self.norm = float(np.sqrt(dot(comm, first, first)))
        self.basis: list[Vector] = [np.array(first / (self.norm or 1.0), dtype=np.float64)]
        self.H = np.zeros((max_size + 1, max_size))

    def grow(self) -> int:
        """Extend the Krylov space by one vector; return the number of columns of H. Collective.

        The vector is zero if the space is invariant.
        """
        # the image of the last vector gives column j of H
        j, new_vector = len(self.basis) - 1, np.array(self._times(self.basis[-1]))
        # Gram-Schmidt, twice for what rounding has left
        for _ in range(2):
            for i, vector in enumerate(self.basis):
                component = dot(self._comm, vector, new_vector)
                self.H[i, j] += component
                new_vector -= component * vector
        self.H[j + 1, j] = np.sqrt(dot(self._comm, new_vector, new_vector))
        self.basis.append(new_vector / (self.H[j + 1, j] or 1.0))
        return j + 1

    def combination(self, coefficients: Array) -> Vector:
        """Return the linear combination of the first basis vectors, as many as coefficients."""
        return np.asarray(sum(c * q for c, q in zip(coefficients, self.basis, strict=False)))


class ProductCache:
    """A dense correction D with its first products, which serve solutions with any K0.

    Attributes
    ----------
    D
        The correction.
    pairs
        Pairs of a vector v and D v, at most `MAX_STORED_PRODUCTS`.
    """

    def __init__(self, D: DenseCorrection) -> None:
        self.D, self.pairs = D, list[tuple[Vector, Vector]]()

    def times(self, v: Vector) -> Vector:
        """Return D v, and store the pair while there is room. Collective."""
        product = self.D.times(v)
        if len(self.pairs) < MAX_STORED_PRODUCTS:
            self.pairs.append((np.array(v), product))
        return product

    def cache_for(self, D: DenseCorrection) -> "ProductCache":
        """Return a cache for a correction D.

        If D is a known multiple of this one, the stored products are scaled and kept.
        """
        factor = D.multiple_of(self.D)
        if factor == 1.0:
            return self
        cache = ProductCache(D)
        if factor:
            cache.pairs = [(v, factor * product) for v, product in self.pairs]
        return cache


class CorrectionSolver:
    """Solver of (I + A) x = b, A = K0^-1 D, by generalised conjugate residuals.

    The iteration begins with all earlier products. So a solution needs few new ones, or none: A has
    few large eigenvalues, and earlier vectors hold their directions (M. L. Parks, E. de Sturler, G.
    Mackey, D. D. Johnson, S. Maiti, SIAM J. Sci. Comput. 28, 2006, 1651). The constructor is
    collective.

    Parameters
    ----------
    solve_sparse, solve_columns
        K0^-1 times a vector, and times the columns of a matrix.
    products
        D with earlier products.
    size
        Number of unknowns on this rank.

    Private fields: the first `_count` columns of `_U` and `_C` are in use. Those of C are
    orthonormal, and each is I + A times the same column of U.
    """

    def __init__(
        self,
        solve_sparse: LinearMap,
        solve_columns: LinearMap,
        products: ProductCache,
        comm: MPI.Comm,
        size: int,
    ) -> None:
        """Orthonormalise the earlier products, with which each solution begins. Collective."""
        self._solve_sparse, self._products, self._comm = solve_sparse, products, comm
        shape = (size, MAX_STORED_PRODUCTS + MAX_PRODUCTS)
        self._U, self._C = (np.empty(shape, order="F") for _ in range(2))
        self._count = 0
        if products.pairs:
            U, DU = (np.column_stack(vectors) for vectors in zip(*products.pairs, strict=True))
            C = U + solve_columns(DU)
            for _ in range(2):  # the second time for what rounding has left
                # orthonormal columns C from the eigenvectors of C^T C; dependent ones are left out
                squares, Q = np.linalg.eigh(comm.allreduce(C.T @ C))
                independent = squares > DEPENDENCE_TOLERANCE * squares[-1]
                scale = np.sqrt(squares[independent])
                U, C = (columns @ Q[:, independent] / scale for columns in (U, C))
            self._count = C.shape[1]
            self._U[:, : self._count], self._C[:, : self._count] = U, C

    def solve(self, b: Vector, tolerance: float) -> Vector:
        """Return the solution x of (I + A) x = b, with b = K0^-1 times a right side. Collective.

        Parameters
        ----------
        tolerance
            Residual of the solution, relative to b.

        Returns
        -------
        The solution; NaN if neither the tolerance nor the level of rounding is reached.
        """
        norm_of_b = np.sqrt(dot(self._comm, b, b))
        if not 0.0 < norm_of_b < np.inf:
            return b
        # x: the best combination of the columns of U; remainder: b - (I + A) x
        x, remainder = self._project_out(np.zeros_like(b), np.array(b), sign=-1.0)
        residual = np.sqrt(dot(self._comm, remainder, remainder)) / norm_of_b
        column_count = self._count
        while residual > tolerance and column_count < MAX_STORED_PRODUCTS + MAX_PRODUCTS:
            # the remainder as new direction, and its image by I + A: both become new columns, with
            # the image orthogonal to all earlier ones
            image = remainder + self._solve_sparse(self._products.times(remainder))
            u, c = self._project_out(remainder, image, sign=1.0, count=column_count)
            norm = np.sqrt(dot(self._comm, c, c))
            new_u, new_c = self._U[:, column_count], self._C[:, column_count]
            new_u[:], new_c[:] = u / norm, c / norm
            component = dot(self._comm, new_c, remainder)
            x = x + component * new_u
            remainder = remainder - component * new_c
            column_count, previous = column_count + 1, residual
            residual = np.sqrt(dot(self._comm, remainder, remainder)) / norm_of_b
            # rounding prevents more
            if previous < ACCEPTED_TOLERANCE and residual > previous / 2:
                break
        self._count = min(column_count, MAX_STORED_PRODUCTS)
        if not residual <= max(ACCEPTED_TOLERANCE, tolerance):
            return np.full_like(b, np.nan)
        # the error e of x solves (I + A) e = remainder. A is small there: e is about the remainder
        return x + remainder if residual <= tolerance else x

    def _project_out(
        self, u: Vector, c: Vector, sign: float, count: int | None = None
    ) -> tuple[Vector, Vector]:
        """Remove from c its components along the columns of C, and from u the same columns of U.

        Since C = (I + A) U, a pair with c = (I + A) u stays such a pair.

        Parameters
        ----------
        sign
            1 as described. With -1 the columns of U are added to u: if c is a right side, u gains
            the solution for what c loses.
        count
            Number of columns; None: all in use.
        """
        column_count = self._count if count is None else count
        U, C = self._U[:, :column_count], self._C[:, :column_count]
        for _ in range(2):  # the second time for what rounding has left
            components = self._comm.allreduce(C.T @ c)
            u = u - sign * (U @ components)
            c = c - C @ components
        return u, c


@dataclass(frozen=True)
class EigenvalueCrossings:
    """The change of the number of negative eigenvalues from K0 to K0 + D.

    Attributes
    ----------
    added
        How many more negative eigenvalues K0 + D has.
    uncertainty
        The largest |nu|/|1 + nu|: errors of D below its inverse, relative to D, do not change the
        number.
    large_vectors
        Vectors of the eigenvalues beyond `SMALL_EIGENVALUE`.
    """

    added: int
    uncertainty: float
    large_vectors: list[Vector]


class ConjugateComplement:
    """The complement of some vectors X: all vectors that are K-conjugate to them, x . K y = 0.

    The constructor and all methods are collective.

    Parameters
    ----------
    X, KX
        Vectors, which may be none, and K times each.

    Attributes
    ----------
    X, KX
        The same as columns; not set without vectors.
    M
        X^T K X, a small matrix.

    The private field `_is_proper` tells whether there are vectors X.
    """

    def __init__(self, X: Sequence[Vector], KX: Sequence[Vector], comm: MPI.Comm) -> None:
        self._comm, self._is_proper = comm, bool(X)
        if X:
            self.X, self.KX = (np.column_stack(vectors) for vectors in (X, KX))
            self.M = comm.allreduce(self.X.T @ self.KX)

    def components(self, v: Vector) -> Array:
        """Return the components of v along X in the inner product of K. Collective."""
        return np.asarray(np.linalg.solve(self.M, self._comm.allreduce(self.KX.T @ v)))

    def project(self, v: Vector) -> Vector:
        """Return the part of v that is K-conjugate to X. Collective."""
        return np.asarray(v - self.X @ self.components(v)) if self._is_proper else v


class SymmetricUpdate:
    """A lagged D with a symmetric update F that gives the present product along some vectors X.

    Y is the product that is missing along X. With F X = Y, Powell's symmetric update for several
    vectors is F = Y C + C^T Y^T - C^T X^T Y C with C X = 1, here C = (X^T K X)^-1 X^T K: nothing is
    added between vectors that are K-conjugate to X.

    Parameters
    ----------
    D
        The lagged correction.
    X, KX
        Vectors, and K times each.
    missing
        Y, the products of what D lacks with X.

    Private fields: `_complement` has X, KX and X^T K X, `_Y` the columns of Y, and `_XY` is the
    symmetric part of X^T Y.
    """

    def __init__(
        self,
        D: DenseCorrection,
        X: Sequence[Vector],
        missing: Sequence[Vector],
        KX: Sequence[Vector],
        comm: MPI.Comm,
    ) -> None:
        """Compute the small matrices of the update. Collective."""
        self._D, self._comm = D, comm
        self._complement, self._Y = ConjugateComplement(X, KX, comm), np.column_stack(missing)
        XY = comm.allreduce(self._complement.X.T @ self._Y)
        self._XY = (XY + XY.T) / 2

    def times(self, v: Vector) -> Vector:
        """Return (D + F) v. Collective."""
        # c = C v, y = Y^T v
        c, y = self._complement.components(v), self._comm.allreduce(self._Y.T @ v)
        # C^T (Y^T v - X^T Y C v) is K X times this
        transposed = np.linalg.solve(self._complement.M.T, y - self._XY @ c)
        return np.asarray(self._D.times(v) + self._Y @ c + self._complement.KX @ transposed)


def count_crossings(
    D: LinearMap, solve_sparse: LinearMap, first: Vector, comm: MPI.Comm
) -> EigenvalueCrossings | None:
    """Count how many more negative eigenvalues K0 + D has than K0. Collective.

    Each real eigenvalue of A = K0^-1 D below -1 stands for one change of sign on the way from K0 to
    K0 + D. Arnoldi runs find the eigenvalues, each run without the vectors found before, until no
    large one is left.

    Parameters
    ----------
    D, solve_sparse
        D and K0^-1 times a vector.
    first
        Start vector of the iteration.

    Returns
    -------
    The count; None if A has too many large eigenvalues.
    """
    added, uncertainty, found_vectors = 0, 0.0, list[Vector]()

    def orthogonal_to_found(v: Vector) -> Vector:
        """Return v without its components along the vectors found before."""
        for q in found_vectors:
            v = v - dot(comm, q, v) * q
        return v

    def deflated_product(v: Vector) -> Vector:
        """Return A v without its components along the vectors found before."""
        return orthogonal_to_found(solve_sparse(D(v)))

    # a run finds one vector of each multiple eigenvalue
    for _ in range(MAX_RUNS):
        krylov = ArnoldiBasis(deflated_product, orthogonal_to_found(first), comm, MAX_PRODUCTS)
        eigenpairs = _converged_eigenpairs(krylov)
        if eigenpairs is None:
            return None
        values, vectors = eigenpairs  # vectors by their coefficients in the Krylov basis
        uncertainty = max(uncertainty, float((np.abs(values) / np.abs(1 + values)).max()))
        large_indices = np.flatnonzero(np.abs(values) > SMALL_EIGENVALUE)
        if not len(large_indices):
            return EigenvalueCrossings(added, uncertainty, found_vectors)
        for i in large_indices[values[large_indices].imag >= 0]:  # of a conjugate pair one
            # coefficients of one real vector, or of the real and imaginary part of a complex one
            coefficients = [vectors[:, i].real]
            if values[i].imag > 0:
                coefficients.append(vectors[:, i].imag)
            vectors_of_value = [krylov.combination(c) for c in coefficients]
            is_below_minus_one = values[i].imag == 0 and values[i].real < -1
            if is_below_minus_one:
                x = vectors_of_value[0]
                # on the way from K0 to K0 + D the matrix is singular once along x
                added += 1 if dot(comm, x, D(x)) < 0 else -1
            # the next runs leave these vectors out
            for x in vectors_of_value:
                x = orthogonal_to_found(x)
                found_vectors.append(x / np.sqrt(dot(comm, x, x)))
    return None


def _converged_eigenpairs(krylov: ArnoldiBasis) -> tuple[Array, Array] | None:
    """Grow a Krylov space until the large eigenvalues of its matrix H are accurate. Collective.

    Returns
    -------
    Eigenvalues of H and, as columns, their vectors in the basis; None if they do not converge.
    """
    while (size := krylov.grow()) <= MAX_PRODUCTS:
        H = krylov.H[:size, :size]
        if not np.isfinite(H).all():
            return None
        values, vectors = np.linalg.eig(H)
        # the residual of each pair: the part of A x outside the space
        errors = abs(krylov.H[size, size - 1] * vectors[-1])
        large_indices = np.flatnonzero(np.abs(values) > SMALL_EIGENVALUE)
        # of each large eigenvalue from -1 or from 0, the nearer one
        distances = np.minimum(abs(1 + values[large_indices]), abs(values[large_indices]))
        are_accurate = errors[large_indices] < EIGENVALUE_TOLERANCE * distances
        if size >= MIN_PRODUCTS and np.all(are_accurate):
            return values, vectors
        if size == MAX_PRODUCTS:
            break
    return None


def crossings_with_lag(
    tangent: CorrectedTangent,
    crossings: EigenvalueCrossings,
    solve_sparse: LinearMap,
    K: LinearMap,
    first: Vector,
    comm: MPI.Comm,
) -> EigenvalueCrossings:
    """Return a count with the uncertainty that the lagged part of a tangent adds. Collective.

    The lagged part L may have an error as large as itself. Such an error changes the sign along a
    vector x where x . L x is larger than x . (K + D) x. The uncertainty is the largest ratio of
    both, along the vectors of large eigenvalues and in their K-conjugate complement. Where it is
    large along a few vectors, D is corrected there with the present product, and the count is
    repeated.

    Parameters
    ----------
    tangent
        K + D with its lagged part; without one the count is returned unchanged.
    crossings
        The count with the lagged D.
    solve_sparse, K
        K^-1 and K times a vector.
    first
        Start vector of the iterations.
    """
    lagged = tangent.lagged
    if lagged is None:
        return crossings
    # the ratios along the vectors of large eigenvalues, then the largest one in their complement
    X = crossings.large_vectors
    KX = [K(x) for x in X]
    uncertainties = _uncertainties_along(X, KX, tangent.D, lagged, comm)
    complement = ConjugateComplement(X, KX, comm)
    in_complement = _uncertainty_in_complement(
        tangent, lagged, complement, solve_sparse, first, comm
    )
    # where few vectors have a large ratio, D is corrected along them with the present product
    large_indices = [i for i, value in enumerate(uncertainties) if not value <= MAX_UNCERTAINTY]
    present = tangent.present_product
    are_few = 0 < len(large_indices) <= MAX_CORRECTED_VECTORS
    can_correct = are_few and in_complement <= MAX_UNCERTAINTY
    if present and can_correct:
        X, KX = [X[i] for i in large_indices], [KX[i] for i in large_indices]
        missing_products = [present(x) - lagged.times(x) for x in X]
        D = SymmetricUpdate(tangent.D, X, missing_products, KX, comm)
        if corrected := count_crossings(D.times, solve_sparse, first, comm):
            # along the corrected vectors nothing is uncertain any more
            small_uncertainties = [value for value in uncertainties if value <= MAX_UNCERTAINTY]
            return replace(corrected, uncertainty=max([in_complement, *small_uncertainties]))
    return replace(crossings, uncertainty=max([in_complement, *uncertainties]))


def _uncertainties_along(
    X: Sequence[Vector],
    KX: Sequence[Vector],
    D: DenseCorrection,
    lagged: DenseCorrection,
    comm: MPI.Comm,
) -> list[float]:
    """Return the ratio of x . L x to x . (K + D) x along each vector x. Collective.

    Parameters
    ----------
    X, KX
        The vectors, and K times each.
    lagged
        L, the lagged part of D.
    """
    uncertainties = list[float]()
    for x, Kx in zip(X, KX, strict=True):
        lagged_part = dot(comm, x, lagged.times(x))
        stiffness = dot(comm, x, Kx) + dot(comm, x, D.times(x))
        uncertainties.append(abs(lagged_part / stiffness))
    return uncertainties


def _uncertainty_in_complement(
    tangent: CorrectedTangent,
    lagged: DenseCorrection,
    complement: ConjugateComplement,
    solve_sparse: LinearMap,
    first: Vector,
    comm: MPI.Comm,
) -> float:
    """Return a bound of the uncertainty from the lagged part, in a K-conjugate complement.

    It is the largest magnitude of an eigenvalue of K^-1 L there. If the present part can be
    extrapolated, what L lacks of it counts too. Collective.

    Parameters
    ----------
    lagged
        L, the lagged part of D.
    complement
        The complement of the vectors of large eigenvalues of K^-1 D.
    solve_sparse, first
        K^-1 times a vector, and the start vector of the iterations.
    """
    project = complement.project

    def spectral_radius_in_complement(times: LinearMap) -> float:
        """Return the largest magnitude of an eigenvalue of K^-1 times a map."""

        def product(v: Vector) -> Vector:
            return project(solve_sparse(times(project(v))))

        return spectral_radius(product, project(first), comm)

    # a bound along all vectors whose eigenvalues of K^-1 D are not large
    smallest = SMALL_EIGENVALUE / (1 - SMALL_EIGENVALUE)
    in_complement = max(smallest, spectral_radius_in_complement(lagged.times))
    if tangent.extrapolated_product:  # the lagged part may be small where the present one is not
        missing = spectral_radius_in_complement(tangent.missing_product)
        in_complement = max(in_complement, missing / MAX_MISSING_PART)
    return in_complement


def spectral_radius(times: LinearMap, first: Vector, comm: MPI.Comm) -> float:
    """Return the largest magnitude of an eigenvalue of a linear map. Collective.

    Its relative error is at most `EIGENVALUE_TOLERANCE`. It is infinite if Arnoldi's method does
    not converge.

    Parameters
    ----------
    times
        The map times a vector.
    first
        Start vector of the iteration.
    """
    krylov = ArnoldiBasis(times, first, comm, MAX_PRODUCTS)
    while (size := krylov.grow()) < MAX_PRODUCTS:
        values, vectors = np.linalg.eig(krylov.H[:size, :size])
        i = int(np.argmax(np.abs(values)))
        error = abs(krylov.H[size, size - 1] * vectors[-1, i])
        if size >= MIN_PRODUCTS and error <= EIGENVALUE_TOLERANCE * abs(values[i]):
            return float(abs(values[i]))
    return np.inf
