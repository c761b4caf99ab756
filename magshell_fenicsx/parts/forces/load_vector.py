"""From measures on an undeformed shell or body to the entries of load vectors."""

from dataclasses import dataclass

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.la import InsertMode
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.mesh.patch import MeshError

Entries = tuple[NDArray[np.int32], NDArray[np.float64]]
COARSE = 0.15  # of the integral that a patch has on a plane; at a corner it has a quarter


@dataclass(frozen=True)
class Weighted:
    """A measure with its density."""

    weight: Expr
    measure: ufl.Measure

    def __rmul__(self, integrand: Expr) -> ufl.Form:
        return integrand * self.weight * self.measure

    def total(self, V: fem.FunctionSpace, log: KernelLog, name: str = "load measure") -> float:
        """Length, area or whatever it measures; collective."""
        form = log.compile(name, fem.Constant(V.mesh, 1.0) * self)
        return float(V.mesh.comm.allreduce(fem.assemble_scalar(form)))


def entries(V: fem.FunctionSpace, along: Expr, on: Weighted, log: KernelLog, name: str = "load vector") -> Entries:
    """Owned entries of l with l . u = integral of along . u."""
    load = fem.assemble_vector(log.compile(name, ufl.dot(along, ufl.TestFunction(V)) * on))
    load.scatter_reverse(InsertMode.add)
    dofs = np.flatnonzero(load.array[: 3 * V.dofmap.index_map.size_local]).astype(np.int32)
    return dofs, load.array[dofs]


def smooth(x: Expr, radius: Expr) -> Expr:
    """(1 - x.x/radius^2)^2 within the radius: 1 in the middle of a patch, 0 at its rim."""
    inside = 1 - ufl.dot(x, x) / radius**2
    return ufl.conditional(ufl.gt(inside, 0), inside**2, 0)


def averaged(
    V: fem.FunctionSpace, direction: NDArray[np.float64], on: Weighted, log: KernelLog, radius: float | None = None
) -> Entries:
    """l with l . u = average of direction . u; the total is exact on any mesh.

    Parameters
    ----------
    radius
        Of the `smooth` patch on a surface whose area must be known to the mesh.

    Raises
    ------
    MeshError
        On every rank, if the mesh is too coarse to know the patch.
    """
    total = on.total(V, log, "patch weight")
    if radius is not None and not COARSE <= total / (np.pi * radius**2 / 3) <= 1 / COARSE:
        raise MeshError(
            f"loading.patch: its radius is {radius:.3g} R, which the mesh is too coarse for: choose a smaller "
            "mesh.size, or 0 for a force at a point"
        )
    dofs, values = entries(V, fem.Constant(V.mesh, direction), on, log, "patch load")
    return dofs, np.asarray(values / total)
