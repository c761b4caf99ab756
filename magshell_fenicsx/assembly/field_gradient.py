"""Derivatives of energies by all values of a field at once.

Theory: docs/theory.md, derivatives of results.

A term is an energy Pi(u; f) with a field f, such as a thickness or a placement, beside the
displacement u. dPi/du[w] is the work of the term's forces along a vector w. Derivatives are kept by
cell, (cells, nodes, components), so that a change may be constant in a cell or in a patch.
"""

from collections.abc import Callable, Iterable
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
class WeightedTerm:
    """A term Pi(u; f) with its weights in a gradient by the field f.

    Attributes
    ----------
    term
        The term.
    energy
        Factor of the derivative of Pi by f.
    work
        Factor of the derivative of dPi/du[w] by f, w a given vector.
    """

    term: FormTerm
    energy: float
    work: float


@dataclass(frozen=True)
class FieldGradient:
    """The derivatives of a number by the values of a field at the nodes of its cells.

    Attributes
    ----------
    field
        The field.
    forces
        (cells, nodes, components): the derivatives in this rank's own cells; the components are the
        field's.
    places, normals
        (cells, nodes, 3): undeformed places, over R, and normals at these nodes; of a deviation
        those of the perfect shell.
    at_nodes
        Function from one on a program's mesh to its values at these nodes, as `forces`; collective.
    """

    field: fem.Function
    forces: Array
    places: Array
    normals: Array
    at_nodes: Callable[[fem.Function], Array]

    def along(self, change: Array | fem.Function) -> float:
        """Return the derivative along a change of the field. Collective.

        Parameters
        ----------
        change
            The change in the unit of the gradient's field: a function on the mesh that the program
            has given, or an array (cells, nodes, components), as `forces`. A formula at `places` is
            another change than the function into which it was interpolated, unless this has the
            degree of the displacement.

        Raises
        ------
        ValueError
            If the array has another shape, or there is no mesh on which a function could be.
        MeshError
            If the function is on another mesh, or its degree is above that of the displacement.
        """
        values = self.at_nodes(change) if isinstance(change, fem.Function) else np.asarray(change)
        if values.shape != self.forces.shape:
            raise ValueError(
                f"along: the change has the shape {values.shape}: give {self.forces.shape} (cells, "
                "nodes, components), or a fem.Function on the shell's mesh"
            )
        return float(self._sum(np.sum(self.forces * values)))

    def cells(self) -> Array:
        """Return the derivatives by a field that is constant within each cell.

        Returns
        -------
        Array
            (cells, components) of this rank's own cells; on one process those of a mesh that the
            program has given are in its order.
        """
        return np.asarray(self.forces.sum(axis=1))

    def within(self, cells: NDArray[np.bool_]) -> Array:
        """Return the derivatives (components,) by a field that is constant in a patch. Collective.

        Parameters
        ----------
        cells
            (cells,): which of this rank's own cells are in the patch.
        """
        return np.asarray(self._sum(self.forces[cells].sum(axis=(0, 1))))

    def _sum(self, local: Any) -> Any:
        """Return the sum over all ranks of a number or an array."""
        return self.field.function_space.mesh.comm.allreduce(local)


def derivatives_by_field(
    weighted_terms: Iterable[WeightedTerm],
    f: fem.Function,
    u: fem.Function,
    w: fem.Function,
    log: KernelLog,
) -> Array:
    """Return the sum of the weighted terms' derivatives by a field f. Collective.

    Even a continuous field, such as a placement, is changed in each cell on its own. The sum over
    the cells that share a node is the derivative by the node's value.

    Parameters
    ----------
    weighted_terms
        The terms; those without the field are left out.
    u, w
        The displacement of the terms, and the vector along which their residual is taken.
    log
        Requests the compiled kernels.

    Returns
    -------
    Array
        (cells, nodes, components) in this rank's own cells.
    """
    domain = f.function_space.mesh
    # the space of f without continuity: each cell has values of its own
    Q = broken_space(f.function_space)
    v, derivatives = ufl.TestFunction(Q), fem.Function(Q)
    for weighted in weighted_terms:
        energy = weighted.term.form
        if f not in energy.coefficients():
            continue
        # order 0 is the energy itself, order 1 its derivative along w
        for order, factor in enumerate((weighted.energy, weighted.work)):
            if not domain.comm.allreduce(abs(factor)):  # zero on all ranks: no kernel is needed
                continue
            # the energy, or the work dPi/du[w] of its forces
            functional = ufl.derivative(energy, u, w) if order else energy
            weight = fem.Constant(domain, float(factor))
            name = f"{weighted.term.name} by {f.name} {order}"
            form = log.compile(name, weight * ufl.derivative(functional, f, v))
            weighted.term.renew()
            fem.assemble_vector(derivatives.x.array, form)
    derivatives.x.scatter_reverse(InsertMode.add)
    own_cells = domain.topology.index_map(domain.topology.dim).size_local
    by_node = derivatives.x.array.reshape(-1, Q.dofmap.bs)
    return np.asarray(by_node[Q.dofmap.list[:own_cells]])


def broken_space(V: fem.FunctionSpace) -> fem.FunctionSpace:
    """Return the space with the same element as V, discontinuous between cells."""
    element = V.element.basix_element
    if element.discontinuous:
        return V
    return fem.functionspace(V.mesh, ("DG", element.degree, (V.dofmap.bs,)))
