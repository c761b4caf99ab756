"""Vectors at the quadrature points of cells that follow the displacement."""

import basix
import basix.ufl
import numpy as np
from dolfinx import fem, mesh
from numpy.typing import NDArray

Array = NDArray[np.float64]


class PointField(fem.Function):  # type: ignore[misc]  # dolfinx has no types
    """A coefficient of forms with the quadrature of that degree, and a parameter of densities at the same points.

    Attributes
    ----------
    points
        (q, dimension) on the reference cell.
    values
        (local cells, q, size), to be changed by `renew` alone.
    """

    def __init__(self, domain: mesh.Mesh, degree: int, size: int) -> None:
        cell = domain.basix_cell()
        super().__init__(fem.functionspace(domain, basix.ufl.quadrature_element(cell, (size,), degree=degree)))
        self.points = basix.make_quadrature(cell, degree)[0]
        self._dofs = self.function_space.dofmap.list
        self.values = np.zeros((len(self._dofs), len(self.points), size))

    def renew(self, values: Array) -> None:
        """Change all values."""
        self.values[:] = values
        self.x.array.reshape(-1, values.shape[-1])[self._dofs] = values

    def at(self, cells: NDArray[np.int32]) -> Array:
        """The values (cells * q, size) at some consecutive cells: a view, which changes with them."""
        first = cells[0] if len(cells) else 0
        return self.values[first : first + len(cells)].reshape(-1, self.values.shape[-1])


def at_quadrature(field: fem.Function, points: Array) -> Array:
    """(cells, points, components) of a field at points of the reference cell; (.., 3) of a meridian's plane vectors."""
    size, V = field.function_space.dofmap.bs, field.function_space
    shape = V.element.basix_element.tabulate(0, points)[0, :, :, 0]
    found = np.asarray(shape @ field.x.array.reshape(-1, size)[V.dofmap.list])
    if size != 2:
        return found
    in_space = np.zeros((*found.shape[:2], 3))
    in_space[..., ::2] = found
    return in_space
