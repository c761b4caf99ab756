"""A smooth field among the parameters of a fit.

Its prior is as strong as the data make most likely.

By the prior the numbers B (n, c) of a field at n places are normal about their mean. Its c
components have the same distribution and are independent of each other, with

    cov(B(x), B(y)) = s^2 k(|x - y|/l),    k(r) = (1 + sqrt(3) r) exp(-sqrt(3) r)

(C. E. Rasmussen and C. K. I. Williams, Gaussian Processes for Machine Learning, MIT Press 2006, eq.
4.17). The deviation s, the length l and the noise of columns are those under which the data d are
most likely (there, eq. 5.8). With the model linear about x, r the residuals of data and priors
over their standard deviations, and A their slopes,

    -2 ln p(d) = sum ln noise^2 - ln det Q + ln det A^T A + min |r - A dx|^2 + constant,

Q being the inverse covariance of the field. A parameter without prior is integrated over too (D. A.
Harville, J. Am. Stat. Assoc. 72, 320, 1977). s and l are the strengths of the prior. Knows no
shell.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
JITTER = 1e-8  # of a variance: keeps the matrix of places that are close definite
WEAKEST, STRONGEST = 1e-3, 1e2  # bounds of s, over the field's unit
LONGEST = 3.0  # bound of l, over the largest distance
START_VALUES = 4  # values of s and of l that the search starts from
EDGE = 1.01  # factor within which a bound is reached


@dataclass(frozen=True)
class Smooth:
    """The prior of a field among the parameters, under which the field is smooth.

    Attributes
    ----------
    first
        Index of the field's first number in the vector of parameters.
    distances
        (n, n) distances of the places.
    components
        Number c of components at each place.
    deviation, length
        s and l; nan where the data choose them.
    """

    first: int
    distances: Array
    components: int
    deviation: float = np.nan
    length: float = np.nan

    @property
    def size(self) -> int:
        """Number of values of the field, n c."""
        return len(self.distances) * self.components

    @property
    def block(self) -> slice:
        """Slice of the field in the vector of parameters."""
        return slice(self.first, self.first + self.size)

    @property
    def bounds(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Least and largest s, and least and largest l, of a search.

        The least l is the median distance of neighbours.
        """
        # the distance of each place to itself counts as infinite, so that another one is nearest
        distances = self.distances + np.where(np.eye(len(self.distances)), np.inf, 0.0)
        shortest = float(np.median(distances.min(axis=1)))
        return (WEAKEST, STRONGEST), (shortest, LONGEST * float(self.distances.max()))

    @cached_property
    def _factor(self) -> tuple[Array, float]:
        """W (n, n) with W^T W = Q, and ln det Q, of one component.

        The covariance is L L^T, with a lower triangle L. W is the inverse of L.
        """
        r = np.sqrt(3) * self.distances / self.length
        K = (1 + r) * np.exp(-r) + JITTER * np.eye(len(r))
        L = self.deviation * np.linalg.cholesky(K)
        W = scipy.linalg.solve_triangular(L, np.eye(len(L)), lower=True)
        return W, -2 * float(np.log(np.diag(L)).sum())

    @property
    def rows(self) -> Array:
        """W (size, size) of the whole field, with W^T W = Q; components vary fastest."""
        W, _ = self._factor
        return np.asarray(np.kron(W, np.eye(self.components)))

    @property
    def determinant(self) -> float:
        """ln det Q."""
        _, determinant = self._factor
        return self.components * determinant

    def at_bounds(self) -> list[str]:
        """Return the names of deviation s and length l, where they have reached a bound."""
        return [
            name
            for name, value, (low, high) in zip(
                ("deviation", "length"), (self.deviation, self.length), self.bounds, strict=True
            )
            if not low * EDGE < value < high / EDGE
        ]

    def with_strength(self, deviation: float, length: float) -> "Smooth":
        """Return the prior with another deviation and length."""
        return replace(self, deviation=deviation, length=length)

    def starts(self, prior: "Smooth") -> list[tuple[float, float]]:
        """Return pairs (s, l) from which a search begins.

        If this prior has values, of an earlier search, they are the only start. If it has none, the
        starts are spread between the bounds. But an s or l that is given keeps its value.

        Parameters
        ----------
        prior
            The prior as given, with nan for unknown values.
        """
        if np.isfinite(self.deviation):
            return [(self.deviation, self.length)]
        _, (shortest, longest) = self.bounds
        # deviations over the field's unit, the given one alone if there is one
        deviations = (
            np.geomspace(0.03, 3.0, START_VALUES)
            if np.isnan(prior.deviation)
            else [prior.deviation]
        )
        lengths = (
            np.geomspace(2 * shortest, longest / 2, START_VALUES)
            if np.isnan(prior.length)
            else [prior.length]
        )
        return [(float(s), float(ell)) for s in deviations for ell in lengths]
