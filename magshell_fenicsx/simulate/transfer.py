"""Transfer of displacements between scenes with the same kind of model, as an initial guess.

Places of nodes are compared in the chart: the coordinates of the undeformed surface, (n, 1) along a
meridian, (n, 2) of a surface, with the rim (edge) of a dimple as a circle about the pole. Between
dimpled spheres whose rims differ the chart is stretched (`_Stretch`).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import scipy
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.mesh.patch import DeviatedEmbedding
from magshell_fenicsx.mesh.shapes import DiscShape, sphere_embedding
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
NEIGHBOURS = {1: 10, 2: 40, 3: 10}  # number of nodes for interpolation, by dimension of the chart
TINY = 1e-300  # avoids a division by zero at the pole
ROUNDING = 1e-9


def transfer(source: Scene, target: Scene, u: Vector) -> Vector:
    """Return a displacement of one scene in the unknowns of another; collective.

    On the same mesh it is copied. Otherwise it is interpolated in the chart. Then it is scaled with
    the thickness; or between dimpled spheres with the ratio of the rims' radii (`_Stretch`).

    Parameters
    ----------
    u
        Owned degrees of freedom of `source`.

    Returns
    -------
    Vector
        Owned degrees of freedom of `target`, zero at its supports.
    """
    comm, system = source.model.system.comm, target.model.system
    if source.model is target.model:
        return u
    # displacements (nodes, components) at all nodes of the source
    values = np.concatenate(comm.allgather(u.reshape(-1, source.model.V.dofmap.bs)))
    node_numbers = _matching(source, target)
    if node_numbers is not None:  # the same mesh
        return np.asarray(values[node_numbers].ravel())
    nodes, chart_places, stretch = _all_nodes(source), chart(target), _stretch(source, target)
    if stretch:
        places_in_source = stretch.place(chart_places)
        u_at_places = _interpolated(nodes, values, places_in_source, rim=stretch.source_rim)
        displacement = stretch.turn(u_at_places, chart_places)
    else:
        # the length of a system is the thickness
        scale = system.length / source.model.system.length
        displacement = np.zeros((len(chart_places), values.shape[1]))
        for source_nodes, target_nodes in nodes_by_shell(source, target):
            if target_nodes.any():
                displacement[target_nodes] = scale * _interpolated(
                    nodes[source_nodes],
                    values[source_nodes],
                    chart_places[target_nodes],
                    rim=np.inf,
                )
    return system.zero_at_supports(displacement.ravel())


def _interpolated(nodes: Array, values: Array, x: Array, rim: float) -> Array:
    """Return values (n, k) at places of the chart, interpolated by radial basis functions.

    Derivatives jump at the rim, so each side uses only its own nodes.

    Parameters
    ----------
    nodes, values
        Nodes (m, 1, 2 or 3) and values (m, k) there.
    x
        Places (n, 1, 2 or 3).
    rim
        Distance of the rim from the origin of the chart; inf without a rim.
    """
    values_at_x: Array = np.zeros((len(x), values.shape[1]))
    polar_of_nodes, polar = np.linalg.norm(nodes, axis=1), np.linalg.norm(x, axis=1)
    # masks of nodes and of places for each side of the rim; those on the rim are in both sides
    within_rim = polar_of_nodes < rim * (1 + ROUNDING), polar < rim * (1 + ROUNDING)
    beyond_rim = polar_of_nodes > rim * (1 - ROUNDING), polar > rim * (1 - ROUNDING)
    dim = nodes.shape[1]
    # a cubic polynomial in space may vanish on a surface, and so would not be determined by it
    kernel, degree = ("quintic", 3) if dim < 3 else ("linear", 0)
    for has_node, has_place in (within_rim, beyond_rim):
        if has_place.any():
            field = scipy.interpolate.RBFInterpolator(
                nodes[has_node],
                values[has_node],
                neighbors=NEIGHBOURS[dim],
                kernel=kernel,
                degree=degree,
            )
            values_at_x[has_place] = field(x[has_place])
    return values_at_x


def same_mesh(source: Scene, target: Scene) -> bool:
    """Return whether two scenes have the same nodes, in any order and on any ranks; collective."""
    return _matching(source, target) is not None


def _matching(source: Scene, target: Scene) -> NDArray[np.int64] | None:
    """Return the number of each node of the target on this rank among all nodes of the source.

    None on all ranks if the nodes of the two scenes differ. Collective.
    """
    return matching(_all_nodes(source), chart(target), source.model.system.comm)


def matching(
    nodes: Array, chart_places: Array, comm: MPI.Comm = MPI.COMM_SELF
) -> NDArray[np.int64] | None:
    """Return the number of each of this rank's places among nodes; collective.

    None on all ranks if places and nodes differ.

    Parameters
    ----------
    nodes
        Coordinates (n, k) of the nodes of all ranks.
    chart_places
        Coordinates (m, k) of this rank's places; those of all ranks together must be the nodes.
    """
    distance, number = scipy.spatial.cKDTree(nodes).query(chart_places)
    equal = (
        comm.allreduce(len(chart_places)) == len(nodes)
        and comm.allreduce(distance.max(initial=0.0), MPI.MAX) < ROUNDING
    )
    return np.asarray(number) if equal else None


@dataclass(frozen=True)
class _Stretch:
    """The map between the charts of two dimpled spheres with the same edge and different rims.

    The charts are similar up to the rim and equal at the edge. With the ratio q of the rims,
    displacements normal to the surface are scaled by q^2 and tangential ones by q^3. This preserves
    the shape of the strains u_n/R + u_t,s + u_n,s^2/2 of a shallow shell, which Newton's method is
    most sensitive to.

    Attributes
    ----------
    rim, source_rim
        Polar angles (rad) of the rims of target and source.
    edge
        Polar angle (rad) of the edge of both.
    """

    rim: float
    source_rim: float
    edge: float

    def place(self, x: Array) -> Array:
        """Return the points of the source that correspond to points x (n, 1 or 2) of the target."""
        polar = np.linalg.norm(x, axis=1, keepdims=True)
        return np.asarray(x * self._polar(polar) / np.maximum(polar, TINY))

    def turn(self, u: Array, x: Array) -> Array:
        """Return displacements of the source, rotated to the frames of the target and scaled.

        Parameters
        ----------
        u
            Displacements (n, 2 or 3) at the corresponding places of the source.
        x
            Points (n, 1 or 2) of the target's chart.
        """
        polar = np.linalg.norm(x, axis=1, keepdims=True)
        azimuth = x / np.maximum(polar, TINY) if x.shape[1] == 2 else np.ones_like(polar)
        # unit vectors normal to the sphere and along the meridian, at the source and at the target
        normal_at_source, meridian_at_source = _frame(self._polar(polar), azimuth)
        normal, meridian = _frame(polar, azimuth)
        # components (n, 1) along these vectors; the rest is across the meridian
        normal_part, meridian_part = (
            np.sum(u * e, axis=1, keepdims=True) for e in (normal_at_source, meridian_at_source)
        )
        sideways = u - normal_part * normal_at_source - meridian_part * meridian_at_source
        ratio = self.rim / self.source_rim
        tangential = (meridian_part * meridian + sideways) / self._slope(polar)
        return np.asarray(ratio**2 * (normal_part * normal + tangential))

    def _polar(self, polar: Array) -> Array:
        """Return polar angles of the source from those of the target.

        They are in proportion up to the rim. Beyond it a quadratic part makes the edges agree.
        """
        part_beyond_rim = self._part_beyond_rim(polar)
        ratio = self.source_rim / self.rim
        return np.asarray(
            np.clip(ratio * polar + (1 - ratio) * self.edge * part_beyond_rim**2, 0, self.edge)
        )

    def _slope(self, polar: Array) -> Array:
        """Return the derivative of the source's polar angles by those of the target."""
        ratio, part_beyond_rim = self.source_rim / self.rim, self._part_beyond_rim(polar)
        slope = ratio + (1 - ratio) * self.edge * 2 * part_beyond_rim / (self.edge - self.rim)
        return np.asarray(np.maximum(slope, 0.5))  # displacements are divided by it

    def _part_beyond_rim(self, polar: Array) -> Array:
        """Return a function that grows linearly from 0 at the rim to 1 at the edge."""
        return np.asarray(np.maximum((polar - self.rim) / (self.edge - self.rim), 0.0))


def _frame(polar: Array, azimuth: Array) -> tuple[Array, Array]:
    """Return unit vectors (n, 2 or 3) normal to the sphere and along its meridians.

    Parameters
    ----------
    polar
        Polar angles (n, 1).
    azimuth
        Unit vectors of the azimuth (n, 1 or 2).
    """
    normal = np.hstack([np.sin(polar) * azimuth, np.cos(polar)])
    meridian = np.hstack([np.cos(polar) * azimuth, -np.sin(polar)])
    return normal, meridian


def _stretch(source: Scene, target: Scene) -> _Stretch | None:
    """Return the map between the charts of two dimpled spheres; None for other surfaces."""
    rims, edges = [], []  # polar angles of target and source
    for scene in (target, source):
        embedding, shape = scene.problem.embedding, scene.problem.shape
        spherical = (
            isinstance(embedding, DeviatedEmbedding) and embedding.perfect is sphere_embedding
        )
        # only spheres with one dimple about the pole
        if not spherical or not isinstance(shape, DiscShape):
            return None
        if len(shape.circles) != 1 or shape.rims:
            return None
        rims.append(shape.circles[0])
        edges.append(shape.radius)
    rim, source_rim = rims
    edge, source_edge = edges
    return _Stretch(rim, source_rim, edge) if abs(edge - source_edge) < ROUNDING else None


def nodes_by_shell(
    source: Scene, target: Scene
) -> Iterator[tuple[NDArray[np.bool_], NDArray[np.bool_]]]:
    """Yield for each shell its nodes among all of `source`, and among this rank's of `target`.

    Both are masks. Shells that touch are near each other but move in different ways, so they must
    not be mixed. Collective.
    """
    return zip(all_nodes_of_shells(source), nodes_of_shells(target), strict=True)


def all_nodes_of_shells(scene: Scene) -> list[NDArray[np.bool_]]:
    """Return a mask for each shell: which nodes of all ranks belong to it; collective."""
    comm = scene.model.system.comm
    return [np.concatenate(comm.allgather(is_own)) for is_own in nodes_of_shells(scene)]


def nodes_of_shells(scene: Scene) -> list[NDArray[np.bool_]]:
    """Return a mask for each shell: which of this rank's nodes belong to it; one shell has all.

    A node belongs to the shells of its cells, ghosts included.
    """
    model = scene.model
    # (cells, nodes of a cell), and the number of this rank's nodes
    nodes, count = model.V.dofmap.list, model.system.size // model.V.dofmap.bs
    return [
        np.isin(np.arange(count), nodes[np.flatnonzero(cells)].ravel())
        for cells in cells_of_shells(scene)
    ]


def cells_of_shells(scene: Scene) -> list[NDArray[np.bool_]]:
    """Return a mask for each shell: which of this rank's cells, ghosts included, belong to it.

    One shell has all cells.
    """
    model, names = scene.model, list(scene.problem.context.sections.get("shells") or {})
    if len(names) < 2:
        return [np.ones(len(model.V.dofmap.list), dtype=bool)]
    patches = (
        model.meridian.patches
        if model.axisymmetric
        else model.midsurface.patches
        if model.midsurface
        else {}
    )
    return [patches[name] for name in names]


def _all_nodes(scene: Scene) -> Array:
    """Return the coordinates of the nodes of all ranks in the chart; collective."""
    return np.concatenate(scene.model.system.comm.allgather(chart(scene)))


def chart(scene: Scene) -> Array:
    """Return coordinates (n, 1 or 2) of this rank's nodes in the chart, independent of a defect.

    Nodes of a solid have the height in the thickness as a further coordinate: displacements of
    solids are carried to the same mesh only. Nodes of a mesh file have their positions (n, 3).
    """
    return scene.model.chart()
