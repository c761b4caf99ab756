"""Supports of a shell or a solid: displacements that are zero, and rigid motions left free.

Of a solid these are whole faces above clamped edges and in mirror planes, else the mid-surface
alone. A condition is what the case says of a named edge, point or patch: clamped, some components
held, "symmetry" in the mirror plane of a half model, or "plane" in one that belongs to the shell as
it is described. Facets are edges of cells, or faces of a solid. A piece is a connected part of the
shell. Amplitudes are load parameters. Places are over R, the reference length; the components of a
displacement are x, y, z at each node.
"""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

import basix
import numpy as np
from dolfinx import fem, mesh
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.assembly.global_mesh import component_count, component_numbers
from magshell_fenicsx.assembly.oblique_supports import Constraint, support_along
from magshell_fenicsx.continuation.system import Amplitudes, Tangent, Vector, symmetric_part
from magshell_fenicsx.mesh.hexahedra import MIDSURFACE_HEIGHT, BodyMesh
from magshell_fenicsx.mesh.mirror import PLANARITY_TOLERANCE, Mirror
from magshell_fenicsx.mesh.patch import MeshError, place_text
from magshell_fenicsx.models.shell.parameters import Condition, EdgeForce, HeldComponents
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.supports.support_motion import Support

Array = NDArray[np.float64]
ALL_COMPONENTS = (0, 1, 2)
ROUNDING = 1e-9
MAX_OFFSET_FROM_PLANE = (
    1e-3  # largest distance from its plane at which curved elements leave an edge
)
# mean cosine between the conormals of an edge and the normal of the plane that the surface crosses
MIN_CROSSING_COSINE = 0.99
# of the squares that a rigid motion has where the shell is held, over the largest: rounding
FREE_MOTION_TOLERANCE = 1e-12
NOT_HELD = "boundary: the shell is not held: it is free to "
ENERGY_TOLERANCE = (
    1e-13  # of a rigid motion's energy, over the sum of magnitudes that it is made of: rounding
)


def held_on(
    V: fem.FunctionSpace,
    dim: int,
    entities: NDArray[np.int32],
    axes: Iterable[int],
    nodes: NDArray[np.bool_] | None = None,
) -> list[fem.DirichletBC]:
    """Return conditions that components of the displacement are zero on entities of a mesh.

    Parameters
    ----------
    V
        The vector space of the displacement.
    dim, entities
        Dimension of the entities, and their local numbers.
    axes
        The components, from 0.
    nodes
        (nodes,) whether each local node may be held; None if all may.
    """
    V.mesh.topology.create_connectivity(dim, V.mesh.topology.dim)
    conditions = []
    for space in (V.sub(i) for i in axes):
        dofs = fem.locate_dofs_topological(space, dim, entities)
        if nodes is not None:
            # the number of a dof is that of its node times the block size, plus the component
            node_of_dof = dofs // V.dofmap.bs
            dofs = dofs[nodes[node_of_dof]]
        conditions.append(fem.dirichletbc(0.0, dofs, space))
    return conditions


def held_at_vertex(
    V: fem.FunctionSpace,
    x: Array,
    axes: Iterable[int],
    cells_at_vertex: NDArray[np.bool_] | None = None,
) -> list[fem.DirichletBC]:
    """Return conditions that components of the displacement are zero at the node at a place.

    Parameters
    ----------
    x
        Place (3,) of the vertex, in coordinates of the mesh.
    axes
        The components, from 0.
    cells_at_vertex
        (cells,) whether each local cell may have the node: shells that touch have several nodes at
        one place. None for all cells.
    """
    nodes_at_vertex = fem.locate_dofs_geometrical(
        V, lambda y: np.linalg.norm(y.T - x, axis=1) < 1e-9
    )
    if cells_at_vertex is not None:
        nodes_of_cells = V.dofmap.list[cells_at_vertex]
        nodes_at_vertex = nodes_at_vertex[np.isin(nodes_at_vertex, nodes_of_cells)]
    # a node has three unknowns
    return [fem.dirichletbc(0.0, 3 * nodes_at_vertex + np.int32(i), V.sub(i)) for i in axes]


def refuse_unknown(
    edges: Collection[str],
    points: Collection[str],
    patches: Collection[str],
    conditions: Mapping[str, Condition],
    loads: Loads,
    inner_lines: Collection[str] = (),
) -> None:
    """Refuse supports and loads on edges, points and patches that do not exist.

    Parameters
    ----------
    edges, points, patches, inner_lines
        Names that the surface has.
    conditions
        Name of an edge, a point, a patch or a line within the surface -> its support.

    Raises
    ------
    MeshError
        With the missing name and those that there are.
    """

    def refuse_inner_line(key: str, name: str) -> None:
        """Refuse what a line within the surface cannot have."""
        if name in inner_lines:
            raise MeshError(
                f"{key}: is a line within the surface, a joined edge or a curve of the mesh: it "
                "can be hinged or held, and loaded by force or per_length"
            )

    # supports
    for name, condition in conditions.items():
        allowed = _names_that_can_have(condition, edges, points, patches, inner_lines)
        if name not in allowed:
            refuse_inner_line(f"boundary.{name}", name)
            allowed_names = ", ".join(sorted(allowed)) or "none"
            raise MeshError(f"boundary.{name}: the surface has no such edge, only {allowed_names}")
    # dead loads on edges
    for load in loads.all_dead:
        lines = {*edges, *inner_lines} if isinstance(load, EdgeForce) else edges
        edge = getattr(load, "edge", None)
        if edge is not None and edge not in lines:
            refuse_inner_line(f"loading.loads: edge: {edge}", edge)
            allowed_names = ", ".join(sorted(lines)) or "none"
            raise MeshError(f"loading.loads: edge: {edge}: the surface has only {allowed_names}")
    # terms of a program on edges
    for term in loads.user_terms:
        if term.on is not None and term.on not in edges:
            allowed_names = ", ".join(sorted(edges)) or "none"
            key = term.key or f"terms: {term.name}: on"
            raise MeshError(f"{key}: {term.on}: the surface has no such edge, only {allowed_names}")


def _names_that_can_have(
    condition: Condition,
    edges: Collection[str],
    points: Collection[str],
    patches: Collection[str],
    inner_lines: Collection[str],
) -> set[str]:
    """Return the names of edges, points, patches and lines within that can have a support.

    An edge can have any support. A point can have held components, but for the pole, which is a
    name of the program's own. A patch can have held components, or be clamped. A line within the
    surface can have held components, or all of them.
    """
    names = set(edges)
    holds_components = isinstance(condition, HeldComponents)
    if holds_components:
        names |= set(points) - {"pole"}
    if holds_components or condition == "clamped":
        names |= set(patches)
    if holds_components or condition in ("simply supported", "free"):
        names |= set(inner_lines)
    return names


def no_mirror(name: str) -> str:
    """Return the message about an edge that lies in no plane of symmetry."""
    return (
        f"boundary.{name}: symmetry: the edge must lie in a plane that the surface crosses at "
        "right angles"
    )


def plane_of(r0: fem.Function, facets: NDArray[np.int32], name: str) -> Mirror:
    """Return the plane of an edge of a surface, or of a face of a solid; collective.

    The surface must cross the plane of an edge at right angles.

    Parameters
    ----------
    r0
        Undeformed placement of the nodes, over R.
    facets
        Local facets of the edge or the face.
    name
        Name of the edge, for the message.

    Raises
    ------
    MeshError
        On every rank, if there is no such plane.
    """
    V = r0.function_space
    on_edge = V.mesh.topology.dim == 2
    dofs = fem.locate_dofs_topological(V, V.mesh.topology.dim - 1, facets)
    places = np.concatenate(V.mesh.comm.allgather(r0.x.array.reshape(-1, 3)[dofs]))
    centre = places.mean(axis=0)
    # axes of the places, from the largest to the smallest extent: the last is normal to a plane
    _, spread, axes = np.linalg.svd(places - centre, full_matrices=False)
    # directions that must be normal to the plane: of an edge its conormals, of a solid's face the
    # normal of the face itself
    conormals = _conormals(r0, facets) if on_edge else axes[2:]
    # candidates for the normal of the plane
    is_straight = spread[1] <= PLANARITY_TOLERANCE * spread[0]
    candidates = [axes[2]]
    if is_straight:
        # a straight edge lies in many planes. First come those with an exact normal: along an
        # axis, or, for a plane through e3, at right angles to the way from e3 to the centre. The
        # last normal is the sum of the conormals without its part along the edge.
        upright = np.array([-centre[1], centre[0], 0.0])
        fitted_normal = conormals.sum(axis=0) @ (np.eye(3) - np.outer(axes[0], axes[0]))
        candidates = [*np.eye(3), *([upright] if upright.any() else []), fitted_normal]
    # the first plane that contains the places and is crossed at right angles
    for normal in candidates:
        plane = Mirror.with_normal(normal, float(normal @ centre))
        # the mean is weighted with the lengths of the edges of cells, as conormals are so long
        mean_cosine = (
            np.abs(conormals @ plane.normal).sum() / np.linalg.norm(conormals, axis=1).sum()
        )
        contains_places = np.ptp(plane.signed_distance(places)) < PLANARITY_TOLERANCE
        if contains_places and mean_cosine > MIN_CROSSING_COSINE:
            return plane
    raise MeshError(no_mirror(name))


def put_in_plane(r0: fem.Function, facets: NDArray[np.int32]) -> None:
    """Move the nodes of an edge into the plane of its vertices if they are near; collective.

    The vertices of a chart are exact, the cubic edges between them are not. The placement `r0` is
    changed. Nodes stay where they are if the vertices do not define a plane, or are far from it.
    """
    V, domain = r0.function_space, r0.function_space.mesh
    # the vertices of the edge on all ranks
    ends = (
        mesh.entities_to_geometry(domain, 1, facets) if len(facets) else np.empty(0, dtype=np.int32)
    )
    vertices = np.concatenate(domain.comm.allgather(domain.geometry.x[ends.ravel()]))
    # their plane: its normal is the axis of the smallest extent
    centre = vertices.mean(axis=0)
    _, spread, axes = np.linalg.svd(vertices - centre, full_matrices=False)
    if spread[1] <= PLANARITY_TOLERANCE * spread[0]:  # vertices on a straight line
        return
    normal = axes[2]
    if np.ptp(vertices @ normal) > PLANARITY_TOLERANCE:
        return
    # the nodes of the edge are moved along the normal, unless one of them is far from the plane
    dofs, x = fem.locate_dofs_topological(V, 1, facets), r0.x.array.reshape(-1, 3)
    distance_from_plane = (x[dofs] - centre) @ normal
    largest_distance = domain.comm.allreduce(np.abs(distance_from_plane).max(initial=0.0), MPI.MAX)
    if largest_distance < MAX_OFFSET_FROM_PLANE:
        x[dofs] -= np.outer(distance_from_plane, normal)
    r0.x.scatter_forward()


def closing_point(planes: Sequence[Mirror]) -> Array | None:
    """Return a point (3,) that lies on all planes of symmetry, from which volumes are measured.

    Without planes it is the origin. It is None if the planes have no common point.
    """
    if not planes:
        return np.zeros(3)
    normals, offsets = np.array([p.normal for p in planes]), np.array([p.offset for p in planes])
    point = np.linalg.lstsq(normals, offsets, rcond=PLANARITY_TOLERANCE)[0]
    is_on_planes = np.abs(normals @ point - offsets).max() < PLANARITY_TOLERANCE
    return np.asarray(point) if is_on_planes else None


def _conormals(r0: fem.Function, facets: NDArray[np.int32]) -> Array:
    """Return outward conormals (n, 3) at the middles of edges of cells; collective.

    Each is as long as its edge, tangent to the surface and normal to the edge. The result has those
    of all ranks.
    """
    V = r0.function_space
    topology = V.mesh.topology
    for dims in ((1, 2), (2, 1)):
        topology.create_connectivity(*dims)
    corners, conormals = basix.geometry(basix.CellType.triangle), []
    own_facets = facets[facets < topology.index_map(1).size_local]
    for facet in own_facets:
        # the first cell beside the facet, and the number of the facet among the cell's sides
        cell = topology.connectivity(1, 2).links(facet)[0]
        side = int(np.flatnonzero(topology.connectivity(2, 1).links(cell) == facet)[0])
        # a side of the reference triangle has the number of the opposite corner
        ends = np.delete(corners, side, axis=0)
        middle = ends.mean(axis=0)
        # tangents (2, 3) of the surface at the middle of the side, from the table (derivatives,
        # points, shape functions, components) of the element
        derivatives = V.element.basix_element.tabulate(1, middle[None])[1:, 0, :, 0]
        tangents = derivatives @ r0.x.array.reshape(-1, 3)[V.dofmap.list[cell]]
        # vectors in space: along the side, and from the opposite corner to its middle
        along_side, outward = (ends[1] - ends[0]) @ tangents, (middle - corners[side]) @ tangents
        # without its part along the side, the second is the conormal
        outward -= (outward @ along_side) / (along_side @ along_side) * along_side
        conormals.append(np.linalg.norm(along_side) * outward / np.linalg.norm(outward))
    return np.concatenate(V.mesh.comm.allgather(np.reshape(conormals, (-1, 3))))


def free_motion(system: FiniteElementSystem, r0: fem.Function, amplitudes: Amplitudes) -> str:
    """Describe a rigid motion of a piece of the shell that nothing resists; collective.

    Returns
    -------
    str
        A message such as "boundary: the shell is not held: ..."; empty if all motions are resisted.
    """
    x = r0.x.array[: system.size].reshape(-1, 3)
    pieces_of_shell = _nodes_of_pieces(system, r0)
    for nodes_of_piece in pieces_of_shell:
        motions = _unresisted_motions(system, x, amplitudes, nodes_of_piece)
        if not len(motions):
            continue
        # mean displacement of the first motion, and centre of the piece
        node_count = system.comm.allreduce(int(nodes_of_piece.sum()))
        shift = system.comm.allreduce(motions[0].reshape(-1, 3).sum(axis=0)) / node_count
        centre = system.comm.allreduce(x[nodes_of_piece].sum(axis=0)) / node_count
        # the length of the motion over all nodes is one: a pure translation has the mean
        # (1/nodes)^(1/2), and a turn about the centre has the mean zero
        movement = "turn"
        if np.linalg.norm(shift) > 0.5 * np.sqrt(1 / node_count):
            direction = np.round(shift / np.linalg.norm(shift), 3)
            components = ", ".join(f"{c + 0.0:.2g}" for c in direction)  # + 0.0 makes -0 a 0
            movement = f"move along ({components})"
        location = ""
        if len(pieces_of_shell) > 1:
            location = f"; this is its piece around {place_text(centre)}, over R"
        return NOT_HELD + movement + location
    return ""


def rigid_motions(system: FiniteElementSystem, r0: fem.Function, amplitudes: Amplitudes) -> int:
    """Return the number of rigid motions that nothing resists, over all pieces; collective.

    The pieces of a shell are its connected components; `r0` is the undeformed placement.
    """
    x = r0.x.array[: system.size].reshape(-1, 3)
    return sum(
        len(_unresisted_motions(system, x, amplitudes, nodes_of_piece))
        for nodes_of_piece in _nodes_of_pieces(system, r0)
    )


def _nodes_of_pieces(system: FiniteElementSystem, r0: fem.Function) -> list[NDArray[np.bool_]]:
    """Return for each connected piece of the shell the mask (nodes,) of its nodes; collective.

    The nodes are those that this rank owns.
    """
    # the first nodes of a rank are its own; each has three unknowns
    piece_of_node = component_numbers(r0.function_space)[: system.size // 3]
    return [piece_of_node == n for n in range(component_count(r0.function_space))]


def _unresisted_motions(
    system: FiniteElementSystem, x: Array, amplitudes: Amplitudes, nodes_of_piece: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return rigid motions (k, unknowns) of a piece of the shell that nothing resists; collective.

    The motion of the lowest energy is the first.

    Parameters
    ----------
    x
        Undeformed places (nodes, 3) of this rank's nodes, over R.
    nodes_of_piece
        (nodes,) whether each node belongs to the piece.
    """
    node_count = system.comm.allreduce(int(nodes_of_piece.sum()))
    centre = system.comm.allreduce(x[nodes_of_piece].sum(axis=0)) / node_count
    # rigid motions: translations along three axes, and rotations about them
    motions = np.zeros((6, *x.shape))
    for i, axis in enumerate(np.eye(3)):
        motions[i, :, i] = nodes_of_piece  # 1 at the nodes of the piece, else 0
        motions[3 + i] = np.cross(axis, x - centre) * nodes_of_piece[:, None]
    return unresisted(
        motions.reshape(6, -1),
        system.zero_at_supports,
        lambda: system.tangent(np.zeros(system.size), amplitudes),
        system.comm,
    )


def unresisted(
    rigid: Array,
    zero_at_supports: Callable[[Vector], Vector],
    tangent: Callable[[], Tangent],
    comm: MPI.Comm,
) -> Array:
    """Return the rigid motions that neither a support nor the shell's energy resists; collective.

    Parameters
    ----------
    rigid
        Rigid motions (k, unknowns of this rank) of the undeformed shell.
    zero_at_supports
        Puts zeros into a displacement where the shell is held.
    tangent
        Makes the tangent of the undeformed shell. It is not called where supports stop all motions.

    Returns
    -------
    Array
        (n, unknowns) combinations of length one, n at most k, the one of the lowest energy first.
    """
    # combinations of motions that no support stops: the stopped parts of the motions have the
    # matrix of products (k, k), summed over ranks, and the combinations are its null vectors
    stopped = rigid - np.array([zero_at_supports(motion) for motion in rigid])
    _, squares, combinations = np.linalg.svd(comm.allreduce(stopped @ stopped.T))
    is_free = squares < FREE_MOTION_TOLERANCE * max(squares.max(), 1.0)
    free_motions = combinations[is_free] @ rigid
    if not len(free_motions):
        return np.asarray(free_motions)
    free_motions /= _lengths(free_motions, comm)
    # energies of pairs of these motions
    K = symmetric_part(tangent())
    product, energies = K.createVecLeft(), []
    for motion in free_motions:
        displacement = K.createVecRight()
        displacement.array[:] = motion
        K.mult(displacement, product)
        energies.append(comm.allreduce(free_motions @ product.array))
    # energies by the sums of magnitudes in the rows of K: the rounding of an energy is a small
    # part of this bound
    bounds = comm.allreduce((free_motions * _sums_of_rows(K)) @ free_motions.T)
    # eigenvalues of the energies over these bounds, for combinations whose bound is one: a motion
    # whose energy is only rounding is not resisted
    to_unit_bounds = np.linalg.inv(np.linalg.cholesky(bounds))
    values, vectors = np.linalg.eigh(to_unit_bounds @ np.array(energies) @ to_unit_bounds.T)
    unresisted_motions = vectors.T[values < ENERGY_TOLERANCE] @ to_unit_bounds @ free_motions
    return np.asarray(unresisted_motions / _lengths(unresisted_motions, comm))


def _lengths(motions: Array, comm: MPI.Comm) -> Array:
    """Return the lengths (n, 1) of motions (n, unknowns of this rank), over all ranks.

    Collective.
    """
    return np.asarray(np.sqrt(comm.allreduce((motions**2).sum(axis=1)))[:, None])


def _sums_of_rows(K: PETSc.Mat) -> Array:
    """Return the sum of the magnitudes of the entries in each of this rank's rows of a matrix."""
    starts, _, values = K.getValuesCSR()
    rows = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    return np.asarray(np.bincount(rows, np.abs(values), len(starts) - 1), dtype=np.float64)


def supports(
    body: BodyMesh, r0: fem.Function, conditions: Mapping[str, Condition]
) -> tuple[list[Constraint], list[Mirror], dict[str, Support]]:
    """Return the supports of a solid; collective.

    Parameters
    ----------
    body
        The mesh of the solid, with its named faces, patches and points.
    conditions
        Name of an edge, a patch or a point -> its support.

    Returns
    -------
    constraints
        Conditions that hold unknowns at zero, or along directions.
    planes
        Planes of symmetry of faces, without the mirror plane of a half model.
    named_supports
        Name -> the unknowns that the support holds.

    Raises
    ------
    MeshError
        On every rank, if an edge lies in no plane of symmetry.
    """
    V = r0.function_space
    is_in_middle = in_middle(body, V)
    constraints, planes = list[Constraint](), list[Mirror]()
    named_supports, supports_on_planes = dict[str, Support](), dict[str, Support]()
    for name, condition in conditions.items():
        if condition in ("free", "symmetry"):
            continue
        # a plane: the face moves in it only
        if condition == "plane":
            planes.append(plane := plane_of(r0, body.faces[name], name))
            constraints.append(support_along(V, 2, body.faces[name], plane.normal))
            # the support has all components: the reaction of an oblique plane has each of them
            supports_on_planes[name] = Support.from_conditions(
                held_on(V, 2, body.faces[name], ALL_COMPONENTS), kind="plane"
            )
            continue
        # clamped or held components: of an edge, a patch or a point
        components = (
            condition.components if isinstance(condition, HeldComponents) else ALL_COMPONENTS
        )
        # clamped is the whole thickness; else the mid-surface alone, so that the edge can turn
        nodes = None if condition == "clamped" else is_in_middle
        if name in body.faces:
            conditions_of_part = held_on(V, 2, body.faces[name], components, nodes)
        elif name in body.patches:  # it has cells (dimension 3) of the solid
            cells_of_patch = np.flatnonzero(body.patches[name]).astype(np.int32)
            conditions_of_part = held_on(V, 3, cells_of_patch, components, nodes)
        else:
            conditions_of_part = held_at_vertex(V, body.points[name], components)
        constraints += conditions_of_part
        named_supports[name] = Support.from_conditions(
            conditions_of_part, kind="point" if name in body.points else "part"
        )
    return constraints, planes, named_supports | supports_on_planes  # planes come last


def in_middle(body: BodyMesh, V: fem.FunctionSpace) -> NDArray[np.bool_]:
    """Return the mask (nodes,) of nodes in the middle of the thickness, ghosts included."""
    return np.asarray(np.abs(body.at_nodes(V, body.heights) - MIDSURFACE_HEIGHT) < ROUNDING)
