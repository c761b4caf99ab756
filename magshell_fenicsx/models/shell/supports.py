"""What holds a shell: displacements that are zero, and whether it is held against rigid motions."""

from collections.abc import Collection, Iterable, Mapping

import numpy as np
from dolfinx import fem, mesh
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.problem import FiniteElementSystem
from magshell_fenicsx.continuation.system import Amplitudes
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell.parameters import Condition, Held, Loads
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
STRAIGHT = 1e-6  # deviation of an edge from a plane, in lengths of R
CROSSING = 0.9  # mean cosine between flat cells and the normal of the plane that the surface crosses
FREE = 1e-12  # of the squares that a rigid motion has where the shell is held, over the largest: rounding
LOOSE = 1e-13  # of a rigid motion's energy, over the tangent's largest row


def held_on(
    V: fem.FunctionSpace,
    dim: int,
    entities: NDArray[np.int32],
    axes: Iterable[int],
    nodes: NDArray[np.bool_] | None = None,
) -> list[fem.DirichletBC]:
    """Those components are zero on entities of some dimension, or at some of the `nodes` there alone."""
    V.mesh.topology.create_connectivity(dim, V.mesh.topology.dim)
    found = []
    for space in (V.sub(i) for i in axes):
        dofs = fem.locate_dofs_topological(space, dim, entities)
        found.append(fem.dirichletbc(0.0, dofs if nodes is None else dofs[nodes[dofs // 3]], space))
    return found


def held_at_vertex(V: fem.FunctionSpace, x: Array, axes: Iterable[int]) -> list[fem.DirichletBC]:
    """Those components are zero at the node at a vertex."""
    near = fem.locate_dofs_geometrical(V, lambda y: np.linalg.norm(y.T - x, axis=1) < 1e-9)
    return [fem.dirichletbc(0.0, 3 * near + np.int32(i), V.sub(i)) for i in axes]


def refuse_unknown(
    edges: Collection[str],
    points: Collection[str],
    patches: Collection[str],
    conditions: Mapping[str, Condition],
    loads: Loads,
) -> None:
    """See that every edge, point and patch that is held or loaded by its name is there.

    Raises
    ------
    MeshError
        With the name and those that there are.
    """
    for name, condition in conditions.items():
        allowed = set(edges)
        allowed |= set(points) - {"pole"} if isinstance(condition, Held) else set()
        allowed |= set(patches) if isinstance(condition, Held) or condition == "clamped" else set()
        if name not in allowed:
            there = ", ".join(sorted(allowed)) or "none"
            raise MeshError(f"boundary.{name}: the surface has no such edge, only {there}")
    for load in loads.dead:
        edge = getattr(load, "edge", None)
        if edge is not None and edge not in edges:
            there = ", ".join(sorted(edges)) or "none"
            raise MeshError(f"loading.loads: edge: {edge}: the surface has only {there}")


def open_to_pressure(name: str) -> str:
    """What is said of an edge where the energy p V of a live pressure would load the edge too."""
    return (
        f"loading.kind: pressure: the edge {name} must be held (clamped or hinged), or lie in a symmetry plane through "
        "the origin; kind: dead with {over: all, pressure: ..} has no such limit (not on a strip)"
    )


def plane_of(V: fem.FunctionSpace, r0: fem.Function, facets: NDArray[np.int32], name: str) -> tuple[int, float]:
    """The axis that the plane of an edge, or face of a body, is normal to, and where on it it is, over R; collective.

    Raises
    ------
    MeshError
        On every rank, if the edge lies in no plane normal to e1, e2 or e3, or in more than one.
    """
    dim = V.mesh.topology.dim - 1
    dofs = fem.locate_dofs_topological(V, dim, facets)
    here = r0.x.array.reshape(-1, 3)[dofs]
    places = np.concatenate(V.mesh.comm.allgather(here))
    flat = np.flatnonzero(np.ptp(places, axis=0) < STRAIGHT)
    # a straight edge lies in two planes, one in its own surface in none that this surface crosses
    if dim == 1:
        flat = flat[_conormal_axes(V, facets)[flat] > CROSSING]
    if len(flat) != 1:
        raise MeshError(
            f"boundary.{name}: symmetry: the edge must lie in a plane normal to x, y or z that the surface crosses at "
            "right angles; turn the geometry so that it does"
        )
    return int(flat[0]), float(places[:, flat[0]].mean())


def _conormal_axes(V: fem.FunctionSpace, facets: NDArray[np.int32]) -> Array:
    """Mean size (3,) of the components of the flat cells' conormals at some edges; collective."""
    domain = V.mesh
    domain.topology.create_connectivity(1, 2)
    domain.topology.create_connectivity(1, 0)
    domain.topology.create_connectivity(2, 0)
    total, length, owned = np.zeros(3), 0.0, domain.topology.index_map(1).size_local
    corners = domain.geometry.x[compat.corner_numbers(domain)]
    for facet in facets[facets < owned]:
        cell = domain.topology.connectivity(1, 2).links(facet)[0]
        ends = domain.geometry.x[mesh.entities_to_geometry(domain, 1, np.array([facet], dtype=np.int32))[0]]
        size = np.linalg.norm(ends[1] - ends[0])
        along = (ends[1] - ends[0]) / size
        outward = ends.mean(axis=0) - corners[cell].mean(axis=0)
        outward -= (outward @ along) * along
        total += size * np.abs(outward) / np.linalg.norm(outward)
        length += float(size)
    return np.asarray(domain.comm.allreduce(total) / domain.comm.allreduce(length))


def refuse_loose(system: FiniteElementSystem, r0: fem.Function, amplitudes: Amplitudes) -> None:
    """See that no rigid motion is left free; collective.

    Raises
    ------
    MeshError
        On every rank; the message tells the motion.
    """
    x = r0.x.array[: system.size].reshape(-1, 3)
    total = system.comm.allreduce(len(x))
    centre = system.comm.allreduce(x.sum(axis=0)) / total
    motions = np.zeros((6, *x.shape))
    for i, axis in enumerate(np.eye(3)):
        motions[i, :, i] = 1.0
        motions[3 + i] = np.cross(axis, x - centre)
    rigid = motions.reshape(6, -1)
    stopped = rigid - np.array([system.held(v) for v in rigid])
    _, values, vectors = np.linalg.svd(system.comm.allreduce(stopped @ stopped.T))
    free = vectors[values < FREE * max(values.max(), 1.0)] @ rigid
    if not len(free):
        return
    free /= np.sqrt(system.comm.allreduce((free**2).sum(axis=1)))[:, None]
    K = system.tangent(np.zeros(system.size), amplitudes)
    out, energies = K.createVecLeft(), []
    for v in free:
        given = K.createVecRight()
        given.array[:] = v
        K.mult(given, out)
        energies.append(system.comm.allreduce(free @ out.array))
    values, vectors = np.linalg.eigh(np.array(energies))
    if values[0] < LOOSE * K.norm(PETSc.NormType.INFINITY):
        said = vectors[:, 0] @ free
        shift = system.comm.allreduce(said.reshape(-1, 3).sum(axis=0)) / total
        moves = np.linalg.norm(shift) > 0.5 * np.sqrt(1 / total)
        raise MeshError(
            "boundary: the shell is not held: it is free to "
            + (
                f"move along ({', '.join(f'{c + 0.0:.2g}' for c in np.round(shift / np.linalg.norm(shift), 3))})"
                if moves
                else "turn"
            )
        )
