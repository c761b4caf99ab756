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
    """A value that is computed from other values, and again only if these have changed.

    Parameters
    ----------
    function
        Computes the value, on each rank alone.
    inputs
        Returns the arrays and numbers on which the value depends.

    Attributes
    ----------
    latest
        The value that was computed last.
    version
        How often the value was computed.

    The private field `_latest_inputs` has copies of its inputs; None: none was computed yet.
    """

    def __init__(
        self, function: Callable[[], Value], inputs: Callable[[], tuple[Any, ...]]
    ) -> None:
        self._function, self._inputs, self.version = function, inputs, 0
        self._latest_inputs: tuple[Any, ...] | None = None

    def renew(self) -> Value:
        """Return the value; compute it again if its inputs have changed."""
        inputs = self._inputs()
        if not self._is_current(inputs):
            self.latest = self._function()
            self._latest_inputs = tuple(np.array(value) for value in inputs)
            self.version += 1
        return self.latest

    def _is_current(self, inputs: tuple[Any, ...]) -> bool:
        """Return whether inputs are equal to those of the latest value."""
        previous = self._latest_inputs
        if previous is None or len(previous) != len(inputs):
            return False
        return all(map(np.array_equal, inputs, previous))


class PointField(fem.Function):  # type: ignore[misc]  # dolfinx has no types
    """Vectors at the quadrature points of cells: a coefficient of forms with that quadrature.

    It is a parameter of densities at the same points, too.

    Parameters
    ----------
    domain
        The mesh.
    degree
        Degree of the quadrature.
    size
        Number of components.

    Attributes
    ----------
    points
        (q, dimension): the quadrature points on the reference cell.
    values
        (local cells, q, size), as they were last renewed.

    The private field `_dofs` (local cells, q) has the numbers of each cell's points in the field's
    array; `_memo` computes the values.
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
        """Let a function compute the values at every `renew` after its inputs have changed.

        Parameters
        ----------
        function
            Returns the values (local cells, q, size).
        inputs
            Returns the arrays and numbers on which they depend.
        """
        self._memo = Memo(lambda: self._put(function()), inputs)

    def renew(self) -> int:
        """Compute the values again if their inputs have changed; return how often that was."""
        self._memo.renew()
        return self._memo.version

    def at_cells(self, cells: NDArray[np.int32]) -> Array:
        """Return the values (cells * q, size) at consecutive cells: a view, no copy.

        Parameters
        ----------
        cells
            (cells,): local numbers, ascending without gaps.
        """
        first_cell = cells[0] if len(cells) else 0
        return self.values[first_cell : first_cell + len(cells)].reshape(-1, self.values.shape[-1])

    def _put(self, values: Array) -> None:
        """Store values (local cells, q, size) here and in the coefficient."""
        self.values[:] = values
        self.x.array.reshape(-1, values.shape[-1])[self._dofs] = values


def memo_input(field: fem.Function) -> Array | int:
    """Return a field's values, or their version: an input of a `Memo` that changes with them."""
    return field.renew() if isinstance(field, PointField) else field.x.array


def at_quadrature(field: fem.Function, points: Array) -> Array:
    """Return a nodal field at points of the reference cell, in all local cells.

    Parameters
    ----------
    points
        (points, dimension) on the reference cell.

    Returns
    -------
    Array
        (cells, points, components); (cells, points, 3) of the plane vectors of a meridian, whose
        second component is zero.
    """
    components, V = field.function_space.dofmap.bs, field.function_space
    # the shape functions (points, functions), times the nodal values of each cell
    shape = V.element.basix_element.tabulate(0, points)[0, :, :, 0]
    values = np.asarray(shape @ field.x.array.reshape(-1, components)[V.dofmap.list])
    if components != 2:
        return values
    # the plane of a meridian has the axes e1 and e3
    in_space = np.zeros((*values.shape[:2], 3))
    in_space[..., ::2] = values
    return in_space
