"""The meridian of a surface of revolution: an interval mesh and, separately, the placement r0.

- The parameter s runs along the meridian; it is the mesh's coordinate. A chart (n, 2) has s and 0.
- The embedding maps charts to places in space, over R; rho and z are those of the meridian.
- Facets are vertices of the interval mesh, by local number.
- The axis is e3; a pole is a place of the surface on it. Several shells may share the axis: each
  has an interval of s.
- A joint ties the edges of two shells by two parameters, which are equal where the edges meet; at a
  T-junction they differ, as an edge ends within another shell.
- h is the thickness over R.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from math import inf, sqrt

import basix.ufl
import numpy as np
from dolfinx import fem, mesh
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import DeviatedEmbedding, Deviation, Embedding, MeshError
from magshell_fenicsx.mesh.vertex_spacing import line_coordinates
from magshell_fenicsx.models.shell.spatial_fields import positions_and_normals
from magshell_fenicsx.platform import compat

Array = NDArray[np.float64]
MAX_CELLS = 1_000_000
PARAMETER_TOLERANCE = 1e-9  # of a parameter
Names = Sequence[str | None]


@dataclass(frozen=True)
class Meridian:
    """A meridian, the whole of it on every rank: it is too small to be worth sharing.

    Attributes
    ----------
    mesh
        Interval mesh over the parameter s, the distance from the origin of the chart.
    axis
        Facets of the points on the axis, none where the surface has holes there.
    ends
        Name -> facets of the ends that are edges of the surface.
    embedding
        Chart (n, 2) -> surface (n, 3), of revolution about e3.
    points
        Name -> parameter s and azimuth (rad) of a place whose displacement is observed.
    curvature
        Largest curvature of the meridian times R, at least 1. Of several shells, that of the one
        with the most waves around the axis.
    patches
        Name of each of several shells -> flags (cells,) of the cells in it; empty for one shell.
    tied
        Pairs of parameters, one for each joint.
    """

    mesh: mesh.Mesh
    axis: NDArray[np.int32]
    ends: Mapping[str, NDArray[np.int32]]
    embedding: Embedding
    points: Mapping[str, tuple[float, float]]
    curvature: float
    patches: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)
    tied: Sequence[tuple[float, float]] = ()

    @property
    def shells(self) -> tuple[str, ...]:
        """The names of several shells."""
        return tuple(self.patches)

    @property
    def order(self) -> NDArray[np.int64]:
        """Numbers of the cells, sorted along the parameter."""
        return np.argsort(self._cell_ends.mean(axis=1))

    @property
    def cells(self) -> Array:
        """Parameters (cells, 2) at the ends of the cells, sorted along the meridian."""
        return self._cell_ends[self.order]

    @property
    def poles(self) -> Array:
        """The parameters of the points on the axis, in ascending order."""
        return np.sort(self._parameters_of(self.axis))

    @property
    def reach(self) -> float:
        """The largest distance from the axis, at least 1."""
        return max(1.0, float(self.section(self.mesh.geometry.x[:, 0])[:, 0].max()))

    def parameter(self, end: str) -> float:
        """Return the parameter s of an end."""
        return float(self._parameters_of(self.ends[end])[0])

    def begins(self, end: str) -> bool:
        """Return whether the parameter grows from an end into the surface."""
        return bool(np.isclose(self._cell_ends.min(axis=1), self.parameter(end)).any())

    def facets_at(self, point: str) -> NDArray[np.int32]:
        """Return the facet on the axis that is nearest to a named place; empty without an axis."""
        distances = np.abs(self._parameters_of(self.axis) - self.points[point][0])
        return np.asarray(self.axis[distances == distances.min(initial=inf)][:1])

    @property
    def bodies(self) -> list[NDArray[np.bool_]]:
        """Flags (cells,) of each connected body: a shell, or several that joints connect.

        Bodies that a joint touches are merged, one joint after the other.
        """
        bodies = [*self.patches.values()] or [np.ones(len(self._cell_ends), dtype=bool)]
        for tied_parameters in self.tied:
            # cells that contain one of the two parameters
            begin = self._cell_ends[:, :1] - PARAMETER_TOLERANCE
            end = self._cell_ends[:, 1:] + PARAMETER_TOLERANCE
            touched_cells = ((begin < tied_parameters) & (tied_parameters < end)).any(axis=1)
            connected = [body for body in bodies if (body & touched_cells).any()]
            unconnected = [body for body in bodies if not (body & touched_cells).any()]
            bodies = [*unconnected, np.any(connected, axis=0)]
        return bodies

    @property
    def joints(self) -> list[Array | None]:
        """Marks (cells,) for each joint of two edges; None for a T-junction.

        A mark is 1 in the cell that ends at the joint, -1 in the cell that begins there, else 0.
        """
        end_matches = [
            np.abs(self._cell_ends - first) < PARAMETER_TOLERANCE for first, _ in self.tied
        ]
        return [
            1.0 * ends_at_joint[:, 1] - 1.0 * ends_at_joint[:, 0] if first == second else None
            for ends_at_joint, (first, second) in zip(end_matches, self.tied, strict=True)
        ]

    @property
    def _cell_ends(self) -> Array:
        """Parameters (cells, 2) at the ends of the cells, in the order of the cells' numbers."""
        return np.sort(self.mesh.geometry.x[compat.geometry_dofs(self.mesh), 0], axis=1)

    def _parameters_of(self, facets: NDArray[np.int32]) -> Array:
        """Return the parameters (n,) of facets; dolfinx itself refuses an empty array."""
        if not len(facets):
            return np.empty(0)
        return np.asarray(
            self.mesh.geometry.x[mesh.entities_to_geometry(self.mesh, 0, facets).ravel(), 0]
        )

    def section(self, s: Array) -> Array:
        """Return rho and z (n, 2) over R at parameters s (n,)."""
        return np.asarray(self.embedding(np.column_stack([s, 0 * s]))[:, [0, 2]])

    def placement(self, V: fem.FunctionSpace) -> fem.Function:
        """Return (rho, z) over R in the Lagrange space `V` of two components.

        The placement is interpolated, so that axial motions are exact.
        """
        s = V.tabulate_dof_coordinates()[:, 0]
        r0 = fem.Function(V, name="r0")
        r0.x.array[:] = self.section(s).ravel()
        return r0

    def largest_fold(self, r0: fem.Function) -> float:
        """Return the largest angle (rad) between the undeformed normals at a joint of two edges.

        T-junctions do not count. The placement `r0` is that of the model.
        """
        nodes, (_, normals) = r0.function_space.dofmap.list, positions_and_normals(r0)
        angles = [0.0]
        for marks in self.joints:
            if marks is not None:
                # the cell that ends at the joint (mark 1), and the one that begins there (-1)
                first, second = int(marks.argmax()), int(marks.argmin())
                # the node that both cells at the joint share, by its number in each
                (i,), (j,) = np.nonzero(np.equal.outer(nodes[first], nodes[second]))
                n, m = normals[first, i], normals[second, j]
                angles.append(float(np.arctan2(np.linalg.norm(np.cross(n, m)), n @ m)))
        return max(angles)

    def growth(self, V: fem.FunctionSpace, deviations: Sequence[Deviation]) -> fem.Function:
        """Return the change (rho, z) of the placement by further deviations, a function in V.

        A deviation is a distance along the normal, as of an imperfection that grows.
        """
        s, growth = V.tabulate_dof_coordinates()[:, 0], fem.Function(V, name="growth")
        assert isinstance(self.embedding, DeviatedEmbedding)
        change = self.embedding.along_normal(np.column_stack([s, 0 * s]), deviations)
        growth.x.array[:] = change[:, [0, 2]].ravel()  # the meridian is in the plane of e1 and e3
        return growth


def make_meridian(
    embedding: Embedding,
    vertices: Array,
    names: Names = (None, "rim"),
    points: Mapping[str, tuple[float, float]] | None = None,
    curvature: float = 1.0,
    shell_intervals: Sequence[tuple[str, tuple[float, float]]] = (),
    supported_ends: Collection[str] = (),
    tied: Sequence[tuple[float, float]] = (),
) -> Meridian:
    """Mesh a meridian, on each rank the whole of it.

    Parameters
    ----------
    embedding
        Chart (n, 2) -> surface (n, 3), of revolution about e3.
    vertices
        (n,) parameters of the vertices, ascending from 0.
    names
        Names of the ends along the meridian, None for the axis.
    points
        Name -> parameter s and azimuth (rad) of an observed place. By default "pole" is at 0; of
        several shells it is the highest place or, if that is supported, the highest free one.
    curvature
        Largest curvature of the meridian times R, at least 1.
    shell_intervals
        Name and ends of each of several shells, between which there are no cells.
    supported_ends
        Names of the ends that supports hold.
    tied
        Pairs of parameters that joints tie.
    """
    numbers = np.arange(len(vertices), dtype=np.int64)
    intervals = [ends for _, ends in shell_intervals] or [(float(vertices[0]), float(vertices[-1]))]
    is_cell = _is_in_interval(vertices, intervals)
    element = basix.ufl.element("Lagrange", "interval", 1, shape=(1,))
    domain = mesh.create_mesh(
        MPI.COMM_SELF,
        cells=np.column_stack([numbers[:-1], numbers[1:]])[is_cell],
        x=vertices[:, None].astype(np.float64),
        e=element,
    )
    domain.topology.create_connectivity(0, 1)
    # the facet of each end, in the order of `names`
    facets = [_facets_at_end(domain, end) for ends in intervals for end in ends]
    poles = [facet for name, facet in zip(names, facets, strict=True) if not name]
    axis = np.sort(np.concatenate([np.empty(0, np.int32), *poles]))
    ends = {name: end for name, end in zip(names, facets, strict=True) if name}
    known_points = points or {}
    needs_pole = points is None or bool(shell_intervals)
    if needs_pole and "pole" not in known_points:
        named_ends = zip(names, np.ravel(intervals), strict=True)
        supported = [float(end) for name, end in named_ends if name in supported_ends]
        s = _highest_parameter(embedding, vertices, supported) if shell_intervals else 0.0
        known_points = {**known_points, "pole": (s, 0.0)}
    middles = domain.geometry.x[compat.geometry_dofs(domain), 0].mean(axis=1)
    patches = {name: (begin < middles) & (middles < end) for name, (begin, end) in shell_intervals}
    return Meridian(domain, axis, ends, embedding, known_points, curvature, patches, tied)


def _is_in_interval(vertices: Array, intervals: Sequence[tuple[float, float]]) -> NDArray[np.bool_]:
    """Return whether each step (n - 1,) from a vertex to the next is a cell of an interval.

    It is one if it lies within the last interval that begins before it; other steps lead from one
    shell to the next.
    """
    interval_of_cell = np.searchsorted(
        [begin for begin, _ in intervals], vertices[:-1] + PARAMETER_TOLERANCE
    )
    ends = np.array([end for _, end in intervals])
    return np.asarray(vertices[:-1] < ends[interval_of_cell - 1] - PARAMETER_TOLERANCE)


def _facets_at_end(domain: mesh.Mesh, end: float) -> NDArray[np.int32]:
    """Return the facet at an end of a meridian, by its parameter, as an array (1,)."""
    return np.asarray(
        mesh.locate_entities_boundary(domain, 0, lambda x: np.abs(x[0] - end) < PARAMETER_TOLERANCE)
    )


def _highest_parameter(embedding: Embedding, vertices: Array, supported: Sequence[float]) -> float:
    """Return the parameter of the vertex whose displacement is reported by default.

    It is the highest vertex along e3. If this is at one of the `supported` parameters, it is the
    highest vertex without support, among those on the axis if there are any.
    """
    positions = embedding(np.column_stack([vertices, 0 * vertices]))
    # distance of each vertex from the nearest support, by the parameter
    distances = np.abs(np.subtract.outer(vertices, supported)).min(axis=1, initial=inf)
    is_free = distances > PARAMETER_TOLERANCE
    highest = np.argmax(positions[:, 2])
    if not is_free[highest] and is_free.any():
        is_free_on_axis = is_free & (np.abs(positions[:, 0]) < PARAMETER_TOLERANCE)
        candidates = is_free_on_axis if is_free_on_axis.any() else is_free
        highest = np.argmax(np.where(candidates, positions[:, 2], -inf))
    return float(vertices[highest])


def graded_vertices(
    end: float,
    circles: Sequence[float],
    h: float,
    *,
    refinement: float = 1.0,
    axis: bool = True,
    largest: float = inf,
    contact_size: tuple[float, float] | None = None,
    everywhere: float | None = None,
) -> Array:
    """Return the parameters (n,) of a meridian's vertices, with cells of a fraction of sqrt(h).

    sqrt(h) is the length of a bending boundary layer over R. Cells are finer on the axis, if the
    surface has a point there. At degree 4 they give the knockdown factor k_d to 1e-7.

    Parameters
    ----------
    end
        Value of the parameter at the outer edge.
    circles
        Parameters where the curvature jumps, and rims of dimples. A vertex is put at each; those
        that nearly coincide share one.
    h
        Thickness over R, or the smaller size of the cells on the axis.
    refinement
        Factor by which all cells are smaller, but for those on the axis.
    axis
        Whether the surface has a point on the axis.
    largest
        Largest size of the cells, whatever the thickness.
    contact_size
        Distance from the start within which bodies press, and size of the cells there.
    everywhere
        Size of all cells, over the refinement, in place of all these.

    Raises
    ------
    MeshError
        If there would be more than `MAX_CELLS`.

    Notes
    -----
    A point force bends the shell like s^2 log s. On the axis the cells shrink to a thickness
    whatever the refinement: the logarithmic stretch under an ideal point has no limit.
    """
    if everywhere is not None:
        size = _CellSize(everywhere / refinement)
    else:
        # tuned for that accuracy: the largest size, that on the axis, and the growth along s
        largest = min(0.2 * sqrt(h), largest) / refinement
        on_axis, growth = h if axis else None, 0.3 / refinement
        contact = (contact_size[0], contact_size[1] / refinement) if contact_size else None
        size = _CellSize(largest, on_axis, growth, contact)
    lines = line_coordinates(np.array(circles), lambda s: float(size(np.array([s]))[0]), (0.0, end))
    corners = [0.0, *lines, end]
    return _equidistributed(corners, size)


def with_cell_at_edge(vertices: Array, edge: float, width: float) -> Array:
    """Return vertices (n,) of a meridian with one cell of a given width at one of its ends.

    Vertices within 1.5 times the width of the end `edge` are left out. A meridian that is shorter
    than three cells of this width stays as it is.
    """
    first, last = vertices[[0, -1]]
    if last - first < 3 * width:
        return vertices
    inner_end = first + width if edge == first else last - width
    outside = vertices[np.abs(vertices - edge) > 1.5 * width]
    return np.sort([*outside, inner_end, edge])


@dataclass(frozen=True)
class _CellSize:
    """The wanted size of cells along a meridian: the least that any feature asks for.

    Attributes
    ----------
    largest
        The largest size.
    on_axis
        Size on the axis, at s = 0; None if the surface has no point there.
    growth
        Growth of the size per distance from the axis, and from the place of contact.
    contact
        Distance from the start within which bodies press, and the size there; None without bodies.
    """

    largest: float
    on_axis: float | None = None
    growth: float = 0.0
    contact: tuple[float, float] | None = None

    def __call__(self, s: Array) -> Array:
        """Return the sizes (n,) at parameters s (n,)."""
        if self.on_axis is None:
            sizes = np.full_like(s, self.largest)
        else:
            sizes = np.minimum(self.on_axis + self.growth * s, self.largest)
        if self.contact:
            contact_reach, size_in_contact = self.contact
            sizes = np.minimum(
                sizes, size_in_contact + self.growth * np.maximum(0.0, s - contact_reach)
            )
        return sizes


def _equidistributed(corners: Sequence[float], size: Callable[[Array], Array]) -> Array:
    """Return vertices (n,) at the corners and between them, with cells in proportion to `size`.

    `size` maps parameters (n,) to the wanted sizes of cells there. Between two corners all cells
    are smaller by the same factor, so that a whole number of them fits.

    Raises
    ------
    MeshError
        If there would be more than `MAX_CELLS` between two corners.
    """
    segments = []
    for a, b in pairwise(corners):
        s = np.linspace(a, b, 20001)  # fine enough for the integral of 1/size
        middles = (s[:-1] + s[1:]) / 2
        with np.errstate(over="ignore", divide="ignore"):
            # the number of cells up to s is the integral of 1/size
            cells_before = np.concatenate([[0.0], np.cumsum(np.diff(s) / size(middles))])
        if not cells_before[-1] < MAX_CELLS:
            raise MeshError(
                f"mesh: the meridian would have {cells_before[-1]:.2g} cells, allowed "
                f"{MAX_CELLS:g}: take a larger "
                "mesh.size, a lower mesh.refinement, or larger bodies"
            )
        # a whole number of cells; vertices are where equal shares of the integral are reached
        cells = int(np.ceil(cells_before[-1]))
        segment = np.interp(np.linspace(0, cells_before[-1], cells + 1), cells_before, s)
        segment[[0, -1]] = a, b  # without rounding
        segments.append(segment[:-1])
    return np.concatenate([*segments, corners[-1:]])
