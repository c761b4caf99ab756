"""Forms made from others: at v = 0 of a coefficient v, and the derivatives by all values of a field at once.

The algebra of the first, done once, takes longer than a small run. A file beside the kernels keeps what is left of it.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.la import InsertMode
from numpy.typing import NDArray

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.platform.kept import keep, recall

KEPT = {"signature", "coefficients", "constants"}


class _Found(ufl.Form):  # type: ignore[misc]
    """A form with the signature of another and, of its own coefficients and constants, those that are left there."""

    def __init__(self, form: ufl.Form, signature: str, coefficients: Sequence[int], constants: Sequence[int]) -> None:
        super().__init__(form.integrals())
        left = [form.coefficients()[i] for i in coefficients], [form.constants()[i] for i in constants]
        self._found = signature, *left

    def signature(self) -> str:
        return self._found[0]

    def coefficients(self) -> list[Any]:
        return self._found[1]

    def constants(self) -> list[Any]:
        return self._found[2]


def at_zero(form: ufl.Form, v: fem.Function, compiled: Callable[[ufl.Form], fem.Form]) -> fem.Form:
    """The form at v = 0, compiled; derivatives by v are taken before.

    What is left is kept once its kernel is there: a kernel of the whole form under its signature would be another's.
    """
    number = form.coefficients().index(v)
    key = hashlib.sha256(f"{ufl.__version__} {form.signature()} {number}".encode()).hexdigest()[:40]
    name = f"at_zero_{key}.json"
    known = json.loads(recall(name) or b"{}")
    if known.keys() == KEPT:
        return compiled(_Found(form, **known))
    rest = ufl.replace(form, {v: ufl.zero(v.ufl_shape)})
    kernel = compiled(rest)
    if not (rest.empty() or known):  # what another version of the package has kept stays as it is
        left = {
            "signature": rest.signature(),
            "coefficients": _numbers(form.coefficients(), rest.coefficients()),
            "constants": _numbers(form.constants(), rest.constants()),
        }
        keep(name, json.dumps(left).encode())
    return kernel


def _numbers(all_: Sequence[Any], some: Sequence[Any]) -> list[int]:
    return [next(i for i, each in enumerate(all_) if each is one) for one in some]


Array = NDArray[np.float64]


@dataclass(frozen=True)
class Share:
    """What a term gives to a gradient: `energy` times Pi_f plus `work` times the derivative of Pi_u[w] by f."""

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
        (cells, nodes, 3) of these nodes, undeformed, over R; of a deviation those of the perfect shell.
    """

    field: fem.Function
    forces: Array
    places: Array
    normals: Array

    def along(self, change: Array) -> float:
        """The derivative along a change (cells, nodes, components) of the field; collective."""
        return float(self._sum(np.sum(self.forces * change)))

    def cells(self) -> Array:
        """(cells, components): of a field that is the same within each cell, of this rank's own cells."""
        return np.asarray(self.forces.sum(axis=1))

    def within(self, cells: NDArray[np.bool_]) -> Array:
        """(components,): of a field that is the same within a patch of own cells; collective."""
        return np.asarray(self._sum(self.forces[cells].sum(axis=(0, 1))))

    def _sum(self, own: Any) -> Any:
        return self.field.function_space.mesh.comm.allreduce(own)


def by_field(shares: Iterable[Share], f: fem.Function, u: fem.Function, w: fem.Function, log: KernelLog) -> Array:
    """The sum of the shares' derivatives by f, (cells, nodes, components) on this rank's own cells; collective.

    A field that is the same in neighbouring cells, such as a placement, changes in each cell alone: the sum over cells
    that share a node is what the node's own change gives.

    Parameters
    ----------
    u, w
        The displacement of the terms, and the vector along which their residual is taken.
    """
    domain = f.function_space.mesh
    Q = _broken(f.function_space)
    v, found = ufl.TestFunction(Q), fem.Function(Q)
    for share in shares:
        energy = share.term.form
        if f not in energy.coefficients():
            continue
        for order, factor in enumerate((share.energy, share.work)):
            if not domain.comm.allreduce(abs(factor)):
                continue
            taken = ufl.derivative(energy, u, w) if order else energy
            weight = fem.Constant(domain, float(factor))
            form = log.compile(f"{share.term.name} by {f.name} {order}", weight * ufl.derivative(taken, f, v))
            share.term.renew()
            fem.assemble_vector(found.x.array, form)
    found.x.scatter_reverse(InsertMode.add)
    cells = domain.topology.index_map(domain.topology.dim).size_local
    return np.asarray(found.x.array.reshape(-1, Q.dofmap.bs)[Q.dofmap.list[:cells]])


def _broken(V: fem.FunctionSpace) -> fem.FunctionSpace:
    """The space, free to jump from cell to cell."""
    element = V.element.basix_element
    if element.discontinuous:
        return V
    return fem.functionspace(V.mesh, ("DG", element.degree, (V.dofmap.bs,)))
