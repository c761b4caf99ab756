"""The derivatives of energies by all values of a field at once."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.la import InsertMode
from numpy.typing import NDArray

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Share:
    """What a term gives to a gradient: `energy` times Pi_f plus `work` times the derivative of
    Pi_u[w] by f.
    """

    term: FormTerm
    energy: float
    work: float


@dataclass(frozen=True)
class FieldGradient:
    """The derivatives of a number with respect to the values of a field at the nodes of its cells.

    Attributes
    ----------
    forces
        (cells, nodes, components) of this rank's own cells; the components are the field's.
    places, normals
        (cells, nodes, 3) of these nodes, undeformed, over R; of a deviation those of the perfect
        shell.
    """

    field: fem.Function
    forces: Array
    places: Array
    normals: Array

    def along(self, change: Array) -> float:
        """The derivative along a change (cells, nodes, components) of the field; collective."""
        return float(self._sum(np.sum(self.forces * change)))

    def cells(self) -> Array:
        """(cells, components): of a field that is the same within each cell, of this rank's own
        cells.
        """
        return np.asarray(self.forces.sum(axis=1))

    def within(self, cells: NDArray[np.bool_]) -> Array:
        """(components,): of a field that is the same within a patch of own cells; collective."""
        return np.asarray(self._sum(self.forces[cells].sum(axis=(0, 1))))

    def _sum(self, own: Any) -> Any:
        return self.field.function_space.mesh.comm.allreduce(own)


def by_field(
    shares: Iterable[Share], f: fem.Function, u: fem.Function, w: fem.Function, log: KernelLog
) -> Array:
    """The sum of the shares' derivatives by f, (cells, nodes, components) on this rank's own cells;
    collective.

    A field that is the same in neighbouring cells, such as a placement, changes in each cell alone:
    the sum over cells that share a node is what the node's own change gives.

    Parameters
    ----------
    u, w
        The displacement of the terms, and the vector along which their residual is taken.
    """
    domain = f.function_space.mesh
    Q = broken(f.function_space)
    v, derivatives = ufl.TestFunction(Q), fem.Function(Q)
    for share in shares:
        energy = share.term.form
        if f not in energy.coefficients():
            continue
        for order, factor in enumerate((share.energy, share.work)):
            if not domain.comm.allreduce(abs(factor)):
                continue
            taken = ufl.derivative(energy, u, w) if order else energy
            weight = fem.Constant(domain, float(factor))
            form = log.compile(
                f"{share.term.name} by {f.name} {order}", weight * ufl.derivative(taken, f, v)
            )
            share.term.renew()
            fem.assemble_vector(derivatives.x.array, form)
    derivatives.x.scatter_reverse(InsertMode.add)
    cells = domain.topology.index_map(domain.topology.dim).size_local
    return np.asarray(derivatives.x.array.reshape(-1, Q.dofmap.bs)[Q.dofmap.list[:cells]])


def broken(V: fem.FunctionSpace) -> fem.FunctionSpace:
    """The space, free to jump from cell to cell."""
    element = V.element.basix_element
    if element.discontinuous:
        return V
    return fem.functionspace(V.mesh, ("DG", element.degree, (V.dofmap.bs,)))
