"""A source in its own axes, in metres and tesla, and the same at its place in the model's frame."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.models.shell.driven import FieldInSpace

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


def circle(radius: float, z: float = 0.0, *, axes: tuple[int, int, int] = (0, 1, 2)) -> Array:
    """Places (n, 3) along a circle around the last of some axes."""
    t = np.linspace(0.0, 2 * np.pi, 49)
    return np.column_stack([radius * np.cos(t), radius * np.sin(t), np.full_like(t, z)])[:, np.argsort(axes)]


def upright(radius: float, height: float) -> list[Array]:
    """The outline of a cylinder: both circles, and four lines between them."""
    ends = np.array([-height / 2, height / 2])
    sides = [np.array([[x, y, z] for z in ends]) for x, y in radius * np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])]
    return [*(circle(radius, z) for z in ends), *sides]


Values = Callable[[Array], Array]
