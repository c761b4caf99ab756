"""What computes tangents and residuals in place of the terms' forms."""

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc


class TangentAssembler(Protocol):
    """Computes the tangent without the terms' forms."""

    def tangent(
        self, factors: Mapping[str, float], stress: Sequence[tuple[float, NDArray[np.float64]]] = ()
    ) -> PETSc.Mat:
        """The matrix of the terms with these factors, by name, at the present u.

        `stress` is that of `System.tangent`, of displacements with ghosts.
        """

    def times(self, v: NDArray[np.float64], factors: Mapping[str, float]) -> NDArray[np.float64]:
        """This rank's part of the matrix without supports times a vector with ghosts, exact where nodes move."""


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
