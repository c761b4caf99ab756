"""Memoised values, which are computed again only where their inputs have changed.

A system is evaluated at one state after another. Results that are needed again are kept in a
`Memo`, by the values that they depend on, so that nobody has to invalidate them: a displacement, a
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
Value = TypeVar("Value")


class Memo(Generic[Value]):
    """A value that is a function of other values.

    Parameters
    ----------
    function
        Computes the value, on each rank alone.
    inputs
        Returns the arrays and numbers that it depends on.

    Attributes
    ----------
    latest
        The value that was computed last.
    version
        How often it was computed.
    """

    def __init__(
        self, function: Callable[[], Value], inputs: Callable[[], tuple[Any, ...]]
    ) -> None:
        self._function, self._inputs, self.version = function, inputs, 0
        self._latest_inputs: tuple[Any, ...] | None = None

    def renew(self) -> Value:
        """Return the value; it is computed again if its inputs have changed."""
        inputs = self._inputs()
        if not self._is_current(inputs):
            self.latest = self._function()
            self._latest_inputs = tuple(np.array(value) for value in inputs)
            self.version += 1
        return self.latest

    def _is_current(self, inputs: tuple[Any, ...]) -> bool:
        previous = self._latest_inputs
        if previous is None or len(previous) != len(inputs):
            return False
        return all(map(np.array_equal, inputs, previous))


class PointField(fem.Function):  # type: ignore[misc]  # dolfinx has no types
    """Vectors at the quadrature points of cells: a coefficient of forms with that quadrature.

    It is a parameter of densities at the same points, too.

    Parameters
    ----------
    degree
        Of the quadrature.
    size
        Number of components.

    Attributes
    ----------
    points
        (q, dimension) on the reference cell.
    values
        (local cells, q, size), as they were last renewed.
    """

    def __init__(self, domain: mesh.Mesh, degree: int, size: int) -> None:
        cell = domain.basix_cell()
        element = basix.ufl.quadrature_element(cell, (size,), degree=degree)
        super().__init__(fem.functionspace(domain, element))
        self.points = basix.make_quadrature(cell, degree)[0]
        self._dofs = self.function_space.dofmap.list
        self.values = np.zeros((len(self._dofs), len(self.points), size))

    def compute_by(
        self, function: Callable[[], Array], inputs: Callable[[], tuple[Any, ...]]
    ) -> None:
        """Let all values be a function of others, see `Memo`."""
        self._memo = Memo(lambda: self._put(function()), inputs)

    def renew(self) -> int:
        """Compute the values again if their inputs have changed; return how often that was."""
        self._memo.renew()
        return self._memo.version

    def at_cells(self, cells: NDArray[np.int32]) -> Array:
        """Return the values (cells * q, size) at consecutive cells: a view, no copy."""
        first = cells[0] if len(cells) else 0
        return self.values[first : first + len(cells)].reshape(-1, self.values.shape[-1])

    def _put(self, values: Array) -> None:
        self.values[:] = values
        self.x.array.reshape(-1, values.shape[-1])[self._dofs] = values


def memo_input(field: fem.Function) -> Array | int:
    """Return an input of a `Memo` that changes with a field: its values, or their version."""
    return field.renew() if isinstance(field, PointField) else field.x.array


def at_quadrature(field: fem.Function, points: Array) -> Array:
    """Return a field at points of the reference cell.

    Returns
    -------
    Array
        (cells, points, components); (cells, points, 3) of the plane vectors of a meridian.
    """
    components, V = field.function_space.dofmap.bs, field.function_space
    shape = V.element.basix_element.tabulate(0, points)[0, :, :, 0]
    values = np.asarray(shape @ field.x.array.reshape(-1, components)[V.dofmap.list])
    if components != 2:
        return values
    in_space = np.zeros((*values.shape[:2], 3))
    in_space[..., ::2] = values
    return in_space
