"""What follows from other values: it is found anew where these have changed, and nowhere else.

A system computes at one state after another. What it keeps from state to state is kept here, by the
values that it was found from, so that nobody needs to say what has become old: a displacement, a
placement, a field or a number is simply changed.
"""

from collections.abc import Callable
from typing import Any, Generic, TypeVar

import basix
import basix.ufl
import numpy as np
from dolfinx import fem, mesh
from numpy.typing import NDArray

Array = NDArray[np.float64]
Found = TypeVar("Found")


class Follows(Generic[Found]):
    """A value that is found from others.

    Parameters
    ----------
    of
        Finds it, on each rank alone.
    by
        The arrays and numbers that it depends on.

    Attributes
    ----------
    latest, version
        What was found last, and how often.
    """

    def __init__(self, of: Callable[[], Found], by: Callable[[], tuple[Any, ...]]) -> None:
        self._of, self._by, self.version = of, by, 0
        self._seen: tuple[Any, ...] | None = None

    def renew(self) -> Found:
        """The value; it is found anew if what it depends on has changed."""
        values = self._by()
        if not self._is_of(values):
            self.latest = self._of()
            self._seen = tuple(np.array(each) for each in values)
            self.version += 1
        return self.latest

    def _is_of(self, values: tuple[Any, ...]) -> bool:
        seen = self._seen
        return (
            seen is not None and len(seen) == len(values) and all(map(np.array_equal, values, seen))
        )


class PointField(fem.Function):  # type: ignore[misc]  # dolfinx has no types
    """Vectors at the quadrature points of cells: a coefficient of forms with the quadrature of that
    degree.

    It is a parameter of densities at the same points, too.

    Attributes
    ----------
    points
        (q, dimension) on the reference cell.
    values
        (local cells, q, size), as they were last renewed.
    """

    def __init__(self, domain: mesh.Mesh, degree: int, size: int) -> None:
        cell = domain.basix_cell()
        super().__init__(
            fem.functionspace(domain, basix.ufl.quadrature_element(cell, (size,), degree=degree))
        )
        self.points = basix.make_quadrature(cell, degree)[0]
        self._dofs = self.function_space.dofmap.list
        self.values = np.zeros((len(self._dofs), len(self.points), size))

    def follow(self, of: Callable[[], Array], by: Callable[[], tuple[Any, ...]]) -> None:
        """Let all values follow from others, see `Follows`."""
        self._follows = Follows(lambda: self._put(of()), by)

    def renew(self) -> int:
        """Renew the values where what they follow from has changed; how often that was."""
        self._follows.renew()
        return self._follows.version

    def at(self, cells: NDArray[np.int32]) -> Array:
        """The values (cells * q, size) at some consecutive cells: a view, which changes with them."""
        first = cells[0] if len(cells) else 0
        return self.values[first : first + len(cells)].reshape(-1, self.values.shape[-1])

    def _put(self, values: Array) -> None:
        self.values[:] = values
        self.x.array.reshape(-1, values.shape[-1])[self._dofs] = values


def values_of(field: fem.Function) -> Array | int:
    """What of a field its followers look at: its values, or how often these were renewed."""
    return field.renew() if isinstance(field, PointField) else field.x.array


def at_quadrature(field: fem.Function, points: Array) -> Array:
    """(cells, points, components) of a field at points of the reference cell; (.., 3) of a
    meridian's plane vectors.
    """
    size, V = field.function_space.dofmap.bs, field.function_space
    shape = V.element.basix_element.tabulate(0, points)[0, :, :, 0]
    values = np.asarray(shape @ field.x.array.reshape(-1, size)[V.dofmap.list])
    if size != 2:
        return values
    in_space = np.zeros((*values.shape[:2], 3))
    in_space[..., ::2] = values
    return in_space
