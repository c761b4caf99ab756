"""A source in its own axes, in metres and tesla, and the same at its place in the model's frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.magnetism.driven import FieldInSpace

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Known:
    """A source in its own axes.

    Attributes
    ----------
    field
        Places (n, 3) in m -> B in T with its first and second derivatives; not finite where there is none.
    lines
        Its outline: places (n, 3) along lines, in m.
    nowhere
        What a place without a field is.
    """

    field: FieldInSpace
    lines: Sequence[Array]
    nowhere: str


@dataclass(frozen=True)
class Placed:
    """A source at its place as a `FieldInSpace`: lengths over R, B over |B^a|.

    Attributes
    ----------
    position
        (3,) over R, in the model's frame.
    axes
        (3, 3) the source's own axes as columns, in the same frame.
    length, factor
        R in m; what multiplies B in T.
    key
        Of the case file.
    """

    known: Known
    position: Array
    axes: Array
    length: float
    factor: float
    key: str

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        Q, R = self.axes, self.length
        B, G, H = self.known.field(R * (x - self.position) @ Q)
        return (
            self.factor * B @ Q.T,
            np.einsum("ai,bj,nij->nab", Q, Q, G, optimize=True) * (self.factor * R),
            np.einsum("ai,bj,ck,nijk->nabc", Q, Q, Q, H, optimize=True) * (self.factor * R**2),
        )

    def distance(self, x: Array) -> Array:
        """From places (n, 3) to its body, over R, negative inside; infinite if it has none."""
        of = getattr(self.known.field, "distance", None)
        return (
            np.full(len(x), np.inf) if of is None else of(self.length * (x - self.position) @ self.axes) / self.length
        )

    @property
    def nowhere(self) -> str:
        """What a place without a field is, in words."""
        return f"is {self.known.nowhere} {self.key}"

    @property
    def lines(self) -> list[Array]:
        """Its outline: places (n, 3) along lines, over R."""
        return [self.position + line / self.length @ self.axes.T for line in self.known.lines]


def magpylib(key: str) -> ModuleType:
    """The package, imported where a case has a source that needs it.

    Raises
    ------
    CaseError
        With the command that installs it.
    """
    try:
        import magpylib as found
    except ImportError:
        raise CaseError(
            f"{key}: magnets and coils need the package magpylib: python3 -m pip install --no-deps magpylib"
        ) from None
    return found  # type: ignore[no-any-return]


Values = Callable[[Array], Array]
