"""Formulas of the deformed place as a field."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.taylor import Taylor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class FormulasInSpace:
    """Three formulas of the deformed place as a `FieldInSpace`, in a frame whose axes are the rows of `axes`."""

    components: list[Callable[[Array], Taylor]]
    axes: Array

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        found, Q = [component(x @ self.axes) for component in self.components], self.axes
        B, G, H = (np.stack([getattr(f, d) for f in found]) for d in ("value", "gradient", "hessian"))
        return (
            np.einsum("ai,in->na", Q, B),
            np.einsum("ai,bj,ijn->nab", Q, Q, G, optimize=True),
            np.einsum("ai,bj,ck,ijkn->nabc", Q, Q, Q, H, optimize=True),
        )
