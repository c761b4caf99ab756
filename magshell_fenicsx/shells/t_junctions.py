"""T-junctions: an edge of one shell that stands on another one, and moves and turns with it.

Points of the edge, as many on each side of a triangle as the degree and on a meridian one, are tied
to the places of the other mid-surface at which they are undeformed. So the edge follows the other
shell, whose own displacements stay free: cells need not meet. Both ties are springs,
`TIE_STIFFNESS_RATIO` times as stiff as an element beside them. With n of the edge's cell and m of
the other shell, t along the edge, s = t . (n x m) and c = n . m:

    k/2 |u - u'|^2 + (q/2) (angle of (c c0 + s s0, s c0 - c s0))^2        per undeformed length.

k and q are the stiffnesses of the tie of places and of the tie of normals, u' is the displacement
of the other shell, and c0 and s0 are c and s of the undeformed placement. So the angle is the
change of the angle from n to m, about t.

A place is a point of a mid-surface, known by a cell and reference coordinates in it. "Refuse"
means: raise an error on every rank. A joint of a case (`Joint`) either connects two edges whose
cells share nodes, or is a T-junction; T-junctions have None in `Midsurface.joints`. Lengths are
over R, energies over E h R².
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import TYPE_CHECKING, NamedTuple, Self

import basix
import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from scipy.linalg import block_diag
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.global_mesh import GlobalCells, add_to_owners, global_values
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.nonlocal_terms import Entries, pairs_of
from magshell_fenicsx.assembly.point_kernels import (
    PointKernel,
    PointStorage,
    full_hessian,
    point_gradient,
    point_values,
)
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.patch import MeshError, place_text
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.parts.contact.projection import Cells, nearest_places
from magshell_fenicsx.parts.joints import Joint
from magshell_fenicsx.platform import compat

if TYPE_CHECKING:
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel

Array = NDArray[np.float64]
Longs = NDArray[np.int64]
TIE_STIFFNESS_RATIO = 1e4  # stiffness of a tie over that of an element
PARAMETER_TOLERANCE = 2e-9  # difference of two parameters that is rounding
MAX_DISTANCE_IN_THICKNESSES = (
    0.05  # thicknesses: a place of the edge that is farther from the other mid-surface is not on it
)
SIDE_CORNERS = np.array([[1, 2], [0, 2], [0, 1]])  # corners of each side of a triangle
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])  # of the reference triangle
CELL_RADIUS_FACTOR = 1.2  # radius of a whole cell over that of its nodes, about their centre
TANGENT_COMPONENTS = 12  # components of both tangents of both shells at a point
# (U, W), the components along e_rho and e_z, -> vector and its derivative by theta, in the frame
# (e_rho, e_theta, e_z); for `MeridianTJunction._maps`
AROUND_E3 = np.array([[[1, 0], [0, 0], [0, 1]], [[0, 0], [1, 0], [0, 0]]])


class TiedPoints(NamedTuple):
    """Points of an edge that are tied to places of another shell.

    Attributes
    ----------
    unknowns
        (n, k) global numbers of the unknowns on which each point depends.
    gap
        (n, 3, k) maps from these unknowns to u - u', with u' the displacement of the other shell.
    tangents
        (n, 12, k) maps from these unknowns to both tangents of both shells.
    edge_directions
        (n, 2) direction of the edge in the coordinates of its cell.
    stiffness
        (n, 2) stiffness of the tie of places and of that of normals.
    """

    unknowns: Longs
    gap: Array
    tangents: Array
    edge_directions: Array
    stiffness: Array


class TiedEdge(NamedTuple):
    """An edge that stands on another shell.

    Attributes
    ----------
    joint
        The edge and the other shell, with the stiffness of their connection.
    key
        Key of the case file, with which messages begin.
    is_other_shell
        Mask of this rank's cells, ghosts included, that belong to the other shell.
    """

    joint: Joint
    key: str
    is_other_shell: NDArray[np.bool_]


class TieTerm:
    """Energy of points of an edge that are tied to places of another shell.

    It is an `assembly.terms.Term` (a summand of the potential) and a `NonlocalTerm` (its tangent
    has entries outside the sparsity pattern). Construction is collective and compiles kernels.

    Attributes
    ----------
    amplitude
        None: no load parameter multiplies the energy.
    column
        Column of the energy in the results.
    _unknowns, _gaps, _tangents
        `unknowns`, `gap` and `tangents` of the `TiedPoints`.
    _tie
        (n,) stiffness of the tie of places.
    _turns
        Whether there is a tie of normals: a hinge has none.
    _comm, _u
        Ranks of the mesh, and the displacement.
    _components
        Number of unknowns at a node.
    _own
        Number of this rank's first unknown, and how many are its own.
    _placed
        (n, 12) both tangents of both shells, undeformed.
    _points
        Storage of the fields that kernels read, one value at each tied point.
    _present, _moved
        Fields of 12 numbers, whose sum is both tangents of both shells. `_moved` stays zero:
        kernels take derivatives by it.
    _fixed
        Field of 5 numbers that stay. 0 and 1: direction of the edge in its cell. 2 and 3: sine and
        cosine of the undeformed angle. 4: stiffness of the tie of normals.
    _kernels
        Kernels by name: "angle" gives its sine and cosine, "energy" that of the tie of normals,
        "gradient" and "hessian" its derivatives by the 12 tangent components.
    """

    amplitude = None
    column = "bending"

    def __init__(
        self,
        joint: Joint,
        r0: fem.Function,
        u: fem.Function,
        tied_points: TiedPoints,
        log: KernelLog,
    ) -> None:
        """Compile the kernels of the term and take the angles of the placement; collective.

        `r0` is the placement, `u` the displacement that the term follows.
        """
        V = u.function_space
        self._comm, self._u, self._components = V.mesh.comm, u, V.dofmap.bs
        index = V.dofmap.index_map
        self._own = self._components * index.local_range[0], self._components * index.size_local
        self.name = self.group = f"joint of {' and '.join(joint.edges)}"
        self._unknowns, self._gaps = tied_points.unknowns, tied_points.gap
        self._tangents, self._tie = tied_points.tangents, tied_points.stiffness[:, 0]
        self._turns = bool(joint.rigid or joint.stiffness)  # a hinge has no tie of normals
        # a rank without points has storage for one, which is never read
        self._points = PointStorage(max(len(self._unknowns), 1))
        self._present = self._points.field(TANGENT_COMPONENTS)
        self._moved = self._points.field(TANGENT_COMPONENTS)
        self._fixed = self._points.field(5)
        self._kernels = self._compile_kernels(log)
        self._placed = self._apply(self._tangents, global_values(r0))
        # direction of the edge and stiffness of the tie of normals
        fixed_values = self._fixed.x.array.reshape(-1, 5)[: len(self._unknowns)]
        fixed_values[:, :2] = tied_points.edge_directions
        fixed_values[:, 4] = tied_points.stiffness[:, 1]
        # sine and cosine of the undeformed angle; this kernel reads the direction alone
        zero_displacement = 0 * global_values(r0)
        fixed_values[:, 2:4] = self._evaluate("angle", zero_displacement)

    def _compile_kernels(self, log: KernelLog) -> Mapping[str, PointKernel]:
        """Return the kernels of the angle, and of the energy of the tie of normals; collective.

        The energy is quadratic in the change of the angle from the undeformed one.
        """
        fixed = self._fixed
        undeformed_sine, undeformed_cosine, stiffness = fixed[2], fixed[3], fixed[4]
        sine_and_cosine = _angle(self._present, self._moved, fixed)
        # sine and cosine of the difference of the present and the undeformed angle
        sine = sine_and_cosine[0] * undeformed_cosine - sine_and_cosine[1] * undeformed_sine
        cosine = sine_and_cosine[1] * undeformed_cosine + sine_and_cosine[0] * undeformed_sine
        energy = stiffness / 2 * ufl.atan2(sine, cosine) ** 2
        self._moved.x.array[:] = 0.0
        return {
            "angle": point_values("T-junction angle", sine_and_cosine, log),
            "energy": point_values("T-junction energy", energy, log),
            "gradient": point_gradient("T-junction gradient", [(energy, self._moved)], log),
            "hessian": full_hessian("T-junction Hessian", energy, self._moved, log),
        }

    # the interface of a term

    def compile_residual(self) -> None:
        """Compile nothing: the kernels of the term are compiled with it."""

    def compile_tangent(self) -> None:
        """Compile nothing: the kernels of the term are compiled with it."""

    def energy(self) -> float:
        """Return the elastic energy of both ties at this rank's points; collective."""
        u = global_values(self._u)
        squared_gaps = np.sum(self._apply(self._gaps, u) ** 2, axis=1)
        energy_of_places = float(self._tie @ squared_gaps) / 2
        energy_of_normals = float(self._evaluate("energy", u).sum()) if self._turns else 0.0
        return energy_of_places + energy_of_normals

    def add_residual(self, b: Array, factor: float) -> None:
        """Add factor times the forces of the ties to the local vector b; collective."""
        u = global_values(self._u)
        residual = np.zeros(u.size)
        # forces of the tie of places on the unknowns of each point (n, k)
        spring_forces = self._tie[:, None] * self._apply(self._gaps, u)
        forces = np.einsum("nc,nck->nk", spring_forces, self._gaps)
        if self._turns:  # those of the tie of normals
            forces += np.einsum("nc,nck->nk", self._evaluate("gradient", u), self._tangents)
        # summed over points, then sent to the ranks that own the unknowns
        np.add.at(residual, self._unknowns, factor * forces)
        add_to_owners(b, residual, self._own, self._comm)

    def add_tangent(self, K: object, factor: float, clamped: object) -> None:
        """Add nothing: the assembler of nonlocal terms adds `entries`."""

    def entries(self) -> Entries:
        """Return this rank's global rows, columns and values of the tangent; collective."""
        return _entries(self._unknowns, self._second_variation(self._gaps, self._tangents))

    def coupled_pairs(self) -> tuple[Longs, Longs]:
        """Return the pairs of global nodes that act on each other, which never change.

        The two arrays hold the first and the second node of each pair.
        """
        # every block of unknowns begins with a node's first component
        return pairs_of(self._unknowns[:, :: self._components] // self._components)

    @property
    def pattern_key(self) -> float:
        """Number that tells one pattern of coupled nodes from another; here it never changes."""
        return 0.0

    def _second_variation(self, gap: Array, tangents: Array) -> Array:
        """Return the second variation (n, k, k) of the energy at the present u; collective.

        Parameters
        ----------
        gap, tangents
            Maps (n, 3, k) and (n, 12, k) from k unknowns to the gap u - u' and to both tangents of
            both shells. The unknowns are those of the displacement, or coefficients of a wave.
        """
        H = np.einsum("n,nck,ncl->nkl", self._tie, gap, gap, optimize=True)
        u = global_values(self._u)
        if self._turns and len(H):  # the tie of normals
            hessians = np.zeros((len(H), TANGENT_COMPONENTS, TANGENT_COMPONENTS))
            # the kernel gives the upper triangle of each symmetric Hessian
            i, j = np.triu_indices(TANGENT_COMPONENTS)
            upper_entries = self._evaluate("hessian", u)
            hessians[:, i, j] = upper_entries
            hessians[:, j, i] = upper_entries
            H += np.einsum("nik,nij,njl->nkl", tangents, hessians, tangents, optimize=True)
        return np.asarray(H)

    def _apply(self, maps: Array, u: Array) -> Array:
        """Return maps (n, c, k) applied to the values (nodes, components) of all nodes: (n, c)."""
        return np.asarray(np.einsum("nck,nk->nc", maps, u.ravel()[self._unknowns]))

    def _evaluate(self, kernel: str, u: Array) -> Array:
        """Return the values of a kernel (n, numbers) at this rank's n points.

        Parameters
        ----------
        kernel
            "angle" (2 numbers), "energy" (1), "gradient" (12) or "hessian" (78, its upper
            triangle).
        u
            (nodes, components) displacement at the nodes of all ranks.
        """
        count = len(self._unknowns)
        self._present.x.array[: count * TANGENT_COMPONENTS] = (
            self._placed + self._apply(self._tangents, u)
        ).ravel()
        return np.array(self._points.evaluate(self._kernels[kernel], count))


class SurfaceTJunction(TieTerm):
    """The junction of two surfaces.

    Parameters
    ----------
    tied_edge
        The edge and the shell on which it stands.
    r0, u
        Placement and displacement over R.
    facets
        Local facets of the edge.
    stiffness
        (cells of this rank, 2) E h and E h^3 of each cell over those of the first shell.

    Raises
    ------
    MeshError
        On every rank, if the edge is not on the other shell.
    """

    def __init__(
        self,
        tied_edge: TiedEdge,
        r0: fem.Function,
        u: fem.Function,
        facets: NDArray[np.int32],
        stiffness: Array,
        material: Material,
        log: KernelLog,
    ) -> None:
        """Find the places that the edge is tied to; collective."""
        joint, surfaces = tied_edge.joint, MidSurfaces.gather(r0)
        edge = surfaces.edge_on_shell(facets, tied_edge.is_other_shell)
        edge.refuse_misplaced(r0.function_space.mesh.comm, material.h, tied_edge.key, joint)
        cell_stiffness = surfaces.cells.gather_values(stiffness)  # of all ranks' cells
        # a tie must be stiff beside the stiffer one of the two cells
        stiffer = np.maximum(cell_stiffness[edge.cell], cell_stiffness[edge.other_cell])
        ties = _tie_stiffness(joint, material, stiffer, edge.length, edge.weight)
        super().__init__(joint, r0, u, _tied_points(surfaces, edge, ties), log)


@dataclass(frozen=True)
class EdgeOnShell:
    """Quadrature points of an edge, and the places of another shell that are nearest to them.

    Attributes
    ----------
    cell, other_cell
        (n,) global numbers of the cells of the edge and of the other shell.
    on_edge
        (3, n, functions): shape functions of the edge's cells at the points, and their derivatives
        by both reference coordinates.
    x
        (n, 3) the points, undeformed.
    directions
        (n, 2) the edge's direction in the coordinates of its cell.
    weight, length
        (n,) the length for which a point stands, and the length of its cell's side.
    Y
        (n, 2) reference coordinates of the nearest places in their cells.
    distances
        (n,) distances to the nearest places over R, inf without a cell.
    clearance
        For each cell of this rank beside the edge, the greatest distance of its nodes from the
        other shell; the least of these over the cells. Near zero if a cell lies in the other shell.
    """

    cell: Longs
    on_edge: Array
    x: Array
    directions: Array
    weight: Array
    length: Array
    other_cell: Longs
    Y: Array
    distances: Array
    clearance: float

    def refuse_misplaced(self, comm: MPI.Comm, h: float, key: str, joint: Joint) -> None:
        """Refuse an edge off the other shell, or one whose own shell lies in it; collective.

        `h` is the thickness over R, `key` the key of the case file that messages begin with.

        Raises
        ------
        MeshError
            On every rank, with the place and the distance.
        """
        _refuse_apart(comm, self.distances, self.x, h, key, joint)
        if min(comm.allgather(self.clearance)) < MAX_DISTANCE_IN_THICKNESSES * h:
            edge, other = joint.edges
            raise MeshError(
                f"{key}: the shell of the edge {edge} lies in the mid-surface of {other}, where "
                "both take the same place: turn it out, or join edges of both"
            )


@dataclass(frozen=True)
class MidSurfaces:
    """The undeformed mid-surfaces of all shells, complete on every rank.

    Attributes
    ----------
    V
        Space of the placement.
    cells
        Cells of all ranks.
    r0
        (nodes, 3) places of all nodes over R.
    """

    V: fem.FunctionSpace
    cells: GlobalCells
    r0: Array

    @classmethod
    def gather(cls, r0: fem.Function) -> Self:
        """Return the mid-surfaces of a placement; collective."""
        return cls(r0.function_space, GlobalCells.gather(r0.function_space), global_values(r0))

    @property
    def _element(self) -> basix.finite_element.FiniteElement:
        return self.V.element.basix_element

    def shapes(self, X: Array) -> Array:
        """Return shape functions and both derivatives (3, n, functions) at places X (n, 2)."""
        return np.asarray(self._element.tabulate(1, X)[..., 0])

    def edge_on_shell(
        self, facets: NDArray[np.int32], is_other_shell: NDArray[np.bool_]
    ) -> EdgeOnShell:
        """Return quadrature points of an edge and their places on another shell; collective.

        Parameters
        ----------
        facets
            Local facets of the edge.
        is_other_shell
            Mask of the local cells that belong to the other shell.
        """
        # this rank's cells beside the edge, and both ends (n, 2, 2) of their sides on it, in the
        # reference cell
        own_cells, ends = _cell_sides(self.V, facets, owned=len(self.cells.own_range))
        edge_cells = self.cells.own_range.start + own_cells  # global numbers
        # exact to this degree with as many Gauss points as the element's degree
        s, weights = basix.make_quadrature(basix.CellType.interval, 2 * self._element.degree - 1)
        # Gauss points along each side, in the coordinates of its cell
        X = ends[:, None, 0] + s[None, :, :1] * (ends[:, None, 1] - ends[:, None, 0])
        # for each point: direction and cell of its side, its place, and the tangent there
        edge_directions = np.repeat(ends[:, 1] - ends[:, 0], len(s), axis=0)
        cell = np.repeat(edge_cells, len(s))
        on_edge = self.shapes(X.reshape(-1, 2))
        nodal_places = self.r0[self.cells.nodes[cell]]
        x = np.einsum("nk,nki->ni", on_edge[0], nodal_places)
        tangent = np.einsum("na,ank,nki->ni", edge_directions, on_edge[1:], nodal_places)
        # a point stands for a part of its side's length; the parts sum to the length
        weight = np.tile(weights, len(own_cells)) * np.linalg.norm(tangent, axis=1)
        length = np.repeat(np.sum(weight.reshape(-1, len(s)), axis=1), len(s))
        # global numbers of the other shell's cells
        other_shell = np.flatnonzero(self.cells.gather_values(is_other_shell))
        other_cell, Y, distances = self.nearest_places(x, other_shell)
        return EdgeOnShell(
            cell=cell,
            on_edge=on_edge,
            x=x,
            directions=edge_directions,
            weight=weight,
            length=length,
            other_cell=other_cell,
            Y=Y,
            distances=distances,
            clearance=self._clearance(edge_cells, other_shell),
        )

    def _clearance(self, edge_cells: Longs, other_shell: Longs) -> float:
        """Return the clearance of cells beside an edge from another shell, inf without cells.

        A cell has the greatest distance of its nodes from the other shell; the clearance is the
        least of these over the cells. Both arguments are global numbers of cells.
        """
        nodal_places = self.r0[self.cells.nodes[edge_cells]]
        _, _, distances = self.nearest_places(nodal_places.reshape(-1, 3), other_shell)
        farthest_of_cells = distances.reshape(nodal_places.shape[:2]).max(axis=1, initial=0.0)
        return float(farthest_of_cells.min(initial=np.inf))

    def nearest_places(self, x: Array, cells: Longs) -> tuple[Longs, Array, Array]:
        """Return the nearest places of some cells to points.

        Parameters
        ----------
        x
            (n, 3) points over R.
        cells
            (m,) global numbers of the cells.

        Returns
        -------
        nearest
            (n,) global number of the nearest cell.
        Y
            (n, 2) reference coordinates of the place in that cell.
        distances
            (n,) distance over R; inf where no cell is near.
        """
        # the values of points without a near cell
        nearest = np.zeros(len(x), dtype=np.int64)
        Y = np.zeros((len(x), 2))
        distances = np.full(len(x), np.inf)
        candidate_points, candidate_cells = self._candidates(x, cells)
        if not len(candidate_points):
            return nearest, Y, distances
        # one row for each pair of a point and a cell onto which the point can be projected
        point, cell, reference_place, distance = self._projections(
            x, cells, candidate_points, candidate_cells
        )
        # by point, then nearest first; of equally near ones the cell of the least number
        order = np.lexsort((cell, np.round(distance, 12), point))
        # the first projection of each point in this order
        best = order[np.flatnonzero(np.diff(point[order], prepend=-1))]
        nearest[point[best]] = cell[best]
        Y[point[best]] = reference_place[best]
        distances[point[best]] = distance[best]
        return nearest, Y, distances

    def _projections(
        self, x: Array, cells: Longs, candidate_points: Longs, candidate_cells: Longs
    ) -> tuple[Longs, Longs, Array, Array]:
        """Project points onto cells, for given pairs of a point and a cell.

        Parameters
        ----------
        x, cells
            (n, 3) points over R, and (m,) global numbers of cells.
        candidate_points, candidate_cells
            Of each pair, the position of the point in `x` and that of the cell in `cells`.

        Returns
        -------
        point, cell
            Position of the point and global number of the cell, for each projection found.
        X, distance
            Its reference coordinates (.., 2) in the cell, and its distance from the point over R.
        """
        # projection needs no corners here: they are for neighbours alone
        surface = Cells(
            self._element, self.cells.nodes[cells], np.zeros((len(cells), 3), dtype=np.int64)
        )
        # as `nearest_places` takes pairs: cell, position of its first point, number of points (one
        # each), and the list of points
        candidates = (
            candidate_cells,
            np.arange(len(candidate_cells)),
            np.ones(len(candidate_cells), dtype=np.int64),
            candidate_points,
        )
        # `pair` numbers the candidate pair of each projection
        pair, projections = nearest_places(surface, self.r0, x, candidates, np.inf)
        cell = cells[candidate_cells[pair]]
        return projections.point, cell, projections.X, projections.distance

    def _candidates(self, x: Array, cells: Longs) -> tuple[Longs, Longs]:
        """Return pairs of points x (n, 3) and near cells, which may hold the nearest places.

        Returns
        -------
        points
            Number of the point of each pair, in ascending order.
        near_cells
            Position in `cells` of the cell of each pair.
        """
        from scipy.spatial import cKDTree  # takes long to import

        nodal_places = self.r0[self.cells.nodes[cells]]
        centres = nodal_places.mean(axis=1)
        distances_from_centre = np.linalg.norm(nodal_places - centres[:, None], axis=2)
        radii = CELL_RADIUS_FACTOR * distances_from_centre.max(axis=1)
        # The nearest place lies within a radius of the centre of its cell. A point farther than a
        # radius from the surface needs no place. So two radii from point to centre are enough.
        if len(cells):
            cells_near = cKDTree(centres).query_ball_point(x, 2 * radii.max())
        else:
            cells_near = [[]] * len(x)
        points = np.repeat(np.arange(len(x)), [len(numbers) for numbers in cells_near])
        # the empty list at the end is for ranks without points
        near_cells = np.concatenate(
            [np.asarray(numbers, dtype=np.int64) for numbers in (*cells_near, [])]
        )
        return points, near_cells


class MeridianTJunction(TieTerm):
    """The junction of two meridians, tied by a `TieTerm` at one point.

    Parameters
    ----------
    key
        Key of the case file, with which messages begin.
    r0, u
        Placement and displacement, with components along e_rho and e_z.
    tied
        Parameters s on the meridian chart, the coordinate along all meridians: of the edge, then of
        its place on the other meridian.
    stiffness
        (cells, 2) E h and E h^3 of each cell over those of the first shell.

    Attributes
    ----------
    _shapes
        Values and slopes by s of shape functions: at the edge, then at its place on the other
        meridian.
    _nodes
        (1, nodes) nodes of the cells at the edge, then of those at its place.

    Raises
    ------
    MeshError
        If the edge is not on the other shell.
    """

    def __init__(
        self,
        joint: Joint,
        key: str,
        r0: fem.Function,
        u: fem.Function,
        tied: tuple[float, float],
        stiffness: Array,
        material: Material,
        log: KernelLog,
    ) -> None:
        """Find the parallel that the edge is tied to; parameters are those of the class."""
        V = r0.function_space
        ends, dofs = _ends_of_cells(V), V.dofmap.list
        # cells and shape functions at the edge, then at its place on the other meridian
        cells, self._shapes = _cells_and_shapes(V, tied)
        self._nodes = dofs[np.concatenate(cells)].reshape(1, -1).astype(np.int64)
        nodal_places = r0.x.array.reshape(-1, 2)
        rho = _checked_radius(r0, tied, material.h, key, joint)  # radius of the edge's ring
        # length of the edge's cell, as if it were straight: its extent in s times |dr0/ds|
        edge_cell = int(cells[0][0])
        _, slopes = self._shapes[0]
        length = np.abs(ends[edge_cell, 1] - ends[edge_cell, 0]) * np.linalg.norm(
            slopes @ nodal_places[dofs[edge_cell]]
        )
        # a tie must be stiff beside the stiffest of these cells
        stiffer = stiffness[np.concatenate(cells)].max(axis=0, keepdims=True)
        circumference = 2 * np.pi * np.array([rho])  # the length for which the point stands
        ties = _tie_stiffness(
            joint, material, factors=stiffer, length=np.array([length]), weight=circumference
        )
        # maps from the unknowns to the gap u - u' and to both tangents of both shells
        gap, tangents = self._maps(AROUND_E3)
        along_e_theta = np.array([[0.0, 1.0]])
        tied_points = TiedPoints(self._unknown_numbers(2), gap, tangents, along_e_theta, ties)
        super().__init__(joint, r0, u, tied_points, log)

    def entries_of_waves(self, m: float) -> Entries:
        """Return the entries of the second variation along a wave; collective.

        The wave is U cos(m theta) e_rho + V sin(m theta) e_theta + W cos(m theta) e_z. Rows and
        columns number its coefficients (U + V, V, W) at nodes.
        """
        # coefficients (U, V, W) -> vector and its derivative by theta, in (e_rho, e_theta, e_z),
        # of (U cos, V sin, W cos)(m theta): the parts with cos, then with sin
        cosine = np.array([[[1, 0, 0], [0, 0, 0], [0, 0, 1]], [[0, 0, 0], [1, m, 0], [0, 0, 0]]])
        sine = np.array([[[0, 0, 0], [0, 1, 0], [0, 0, 0]], [[-m, -1, 0], [0, 0, 0], [0, 0, -m]]])
        # from (P, V, W) with P = U + V to (U, V, W)
        U_from_P = np.array([[1, -1, 0], [0, 1, 0], [0, 0, 1]])
        H = sum(self._second_variation(*self._maps(part @ U_from_P)) for part in (cosine, sine))
        # half: the mean of cos² and sin² around e3
        return _entries(self._unknown_numbers(3), np.asarray(H / 2))

    def _unknown_numbers(self, components: int) -> Longs:
        """Return the numbers (1, k) of the unknowns of both cells, `components` of each node."""
        first_numbers = components * self._nodes[:, :, None]
        return np.asarray(first_numbers + np.arange(components)).reshape(1, -1)

    def _maps(self, components: Array) -> tuple[Array, Array]:
        """Return the maps (1, 3, k) and (1, 12, k) from unknowns to the gap and to the tangents.

        The gap is u - u'. The tangents are the derivatives along the meridian and around e3, of the
        edge and then of the other meridian. The k unknowns are those of the nodes of both cells, c
        at each node.

        Parameters
        ----------
        components
            (2, 3, c) maps from the unknowns of a node to its vector, and to that vector's
            derivative around e3.
        """
        value, derivative = components
        gap_blocks, tangent_blocks = [], []  # of the edge, then of the other meridian
        for N, slopes in self._shapes:
            gap_blocks.append(np.kron(N, value))
            tangent_blocks.append(np.vstack([np.kron(slopes, value), np.kron(N, derivative)]))
        return np.hstack([gap_blocks[0], -gap_blocks[1]])[None], block_diag(*tangent_blocks)[None]


def _ends_of_cells(V: fem.FunctionSpace) -> Array:
    """Return the parameters (cells, 2) of the ends of a meridian's cells."""
    return np.asarray(V.mesh.geometry.x[compat.geometry_dofs(V.mesh), 0])


def _cells_and_shapes(
    V: fem.FunctionSpace, tied: tuple[float, float]
) -> tuple[list[Longs], list[tuple[Array, Array]]]:
    """Return the cells at both parameters of a junction, and their shape functions.

    `tied` holds the parameters of the edge and of its place on the other meridian.

    Returns
    -------
    cells
        Cells at each parameter; a vertex has two.
    shapes
        For each parameter, values and slopes of the shape functions of its cells in one row. At a
        vertex each cell counts half.
    """
    ends, shapes = _ends_of_cells(V), []
    # for each parameter, a mask of the cells in which or at whose end it is
    has_parameter = [
        (ends.min(axis=1) < s + PARAMETER_TOLERANCE) & (s - PARAMETER_TOLERANCE < ends.max(axis=1))
        for s in tied
    ]
    cells = [np.flatnonzero(mask) for mask in has_parameter]
    for s, cells_at in zip(tied, cells, strict=True):
        # s in the reference coordinates of its cells, and slopes by s
        lengths = (ends[cells_at, 1] - ends[cells_at, 0])[:, None]
        reference_places = (s - ends[cells_at, :1]) / lengths
        tables = V.element.basix_element.tabulate(1, reference_places)[..., 0]
        # at a vertex, the mean of two cells is tied
        N, slopes = tables / len(cells_at)
        shapes.append((N.ravel(), (slopes / lengths).ravel()))
    return cells, shapes


def _checked_radius(
    r0: fem.Function, tied: tuple[float, float], h: float, key: str, joint: Joint
) -> float:
    """Return the radius over R of an edge's ring, after a check that it is on the other meridian.

    `tied` holds the parameters of the edge and of its place, `h` is the thickness over R, and `key`
    the key of the case file that messages begin with. Collective.

    Raises
    ------
    MeshError
        If the edge is not on the other shell.
    """
    V, nodal = r0.function_space, r0.x.array.reshape(-1, 2)
    cells, shapes = _cells_and_shapes(V, tied)
    # (rho, z) at both parameters: nodal values times shape functions
    (rho, z), other_place = (
        N @ nodal[V.dofmap.list[cells_at].ravel()]
        for (N, _), cells_at in zip(shapes, cells, strict=True)
    )
    distances = np.array([np.hypot(*(other_place - [rho, z]))])
    _refuse_apart(V.mesh.comm, distances, np.array([[rho, 0.0, z]]), h, key, joint)
    return float(rho)


def refuse_misplaced_parallels(
    joints: Sequence[Joint], meridian: Meridian, r0: fem.Function, h: float
) -> None:
    """Refuse T-junctions of meridians whose edge is off the other shell, before a model is made.

    `r0` is the placement and `h` the thickness, both over R.

    Raises
    ------
    MeshError
        With the name of the edge.
    """
    for i, (joint, s, joint_cells) in enumerate(
        zip(joints, meridian.tied, meridian.joints, strict=True)
    ):
        if joint_cells is None:  # a T-junction: its edges share no cells
            _checked_radius(r0, s, h, f"joints.{i}.edges", joint)  # only the check matters here


def _entries(unknowns: Longs, H: Array) -> Entries:
    """Return rows, columns and values of matrices H (n, k, k) between unknowns (n, k), flat."""
    rows, columns = np.broadcast_arrays(unknowns[:, :, None], unknowns[:, None, :])
    return rows.ravel(), columns.ravel(), H.ravel()


def _tied_points(surfaces: MidSurfaces, edge: EdgeOnShell, ties: Array) -> TiedPoints:
    """Return the tied points of an edge, with maps from the unknowns of both cells.

    `ties` (n, 2) are the stiffnesses of both ties.
    """
    nodes = surfaces.cells.nodes
    # of each point: nodes of the edge's cell, then of the other cell
    nodes_of_pairs = np.concatenate([nodes[edge.cell], nodes[edge.other_cell]], axis=1)
    # sizes by name: -1 in `reshape` fails on a rank without points
    point_count, node_count = len(edge.x), nodes_of_pairs.shape[1]
    edge_nodes, unknown_count, axes = nodes.shape[1], 3 * node_count, np.eye(3)
    on_other = surfaces.shapes(edge.Y)  # shape functions of the other cells, and derivatives
    # u - u': the other shell's shape functions count negative
    gap_weights = np.concatenate([edge.on_edge[0], -on_other[0]], axis=1)
    # derivatives along both tangents of the edge's cell, then of the other cell
    derivatives = np.zeros((point_count, 4, node_count))
    derivatives[:, :2, :edge_nodes] = edge.on_edge[1:].transpose(1, 0, 2)
    derivatives[:, 2:, edge_nodes:] = on_other[1:].transpose(1, 0, 2)
    # the same weights for each of the three components
    gap = np.einsum("nk,cd->nckd", gap_weights, axes)
    tangents = np.einsum("nik,cd->nickd", derivatives, axes)
    unknowns = 3 * nodes_of_pairs[:, :, None] + np.arange(3)
    return TiedPoints(
        unknowns=unknowns.reshape(point_count, unknown_count),
        gap=gap.reshape(point_count, 3, unknown_count),
        tangents=tangents.reshape(point_count, TANGENT_COMPONENTS, unknown_count),
        edge_directions=edge.directions,
        stiffness=ties,
    )


def _tie_stiffness(
    joint: Joint, material: Material, factors: Array, length: Array, weight: Array
) -> Array:
    """Return the stiffness (n, 2) of the tie of places and of the tie of normals.

    Parameters
    ----------
    factors
        (n, 2) E h and E h^3 of the stiffer cell over those of the first shell.
    length
        (n,) length over R of the side of the edge's cell.
    weight
        (n,) length over R for which each point stands.
    """
    # A spring has the stiffness of its joint, and a hinge has zero. That of a rigid joint is a
    # multiple of the cell's.
    turning_stiffness: Array | float = joint.stiffness
    if joint.rigid:
        turning_stiffness = (
            TIE_STIFFNESS_RATIO * factors[:, 1] * material.bending_stiffness / length
        )
    stiffness_of_places = weight * TIE_STIFFNESS_RATIO * factors[:, 0] / length
    return np.column_stack([stiffness_of_places, weight * turning_stiffness])


def _refuse_apart(
    comm: MPI.Comm, distances: Array, x: Array, h: float, key: str, joint: Joint
) -> None:
    """Refuse an edge whose points are off the other mid-surface; collective.

    Parameters
    ----------
    distances, x
        (n,) distances over R of this rank's points, and the points (n, 3).

    Raises
    ------
    MeshError
        On every rank, with the greatest distance and its place.
    """
    worst_of_rank = (0.0, np.zeros(3))  # of a rank without points
    if len(distances):
        worst = int(distances.argmax())
        worst_of_rank = (float(distances[worst]), x[worst])
    largest_distance, place = max(
        comm.allgather(worst_of_rank), key=lambda distance_and_place: distance_and_place[0]
    )
    if largest_distance > MAX_DISTANCE_IN_THICKNESSES * h:
        edge, other = joint.edges
        if np.isfinite(largest_distance):
            distance_text = f"by {largest_distance:.4g} R"
        else:
            distance_text = "by more than a cell"
        raise MeshError(
            f"{key}: the edge {edge} is not on the mid-surface of {other}, {distance_text} at "
            f"{place_text(place)}, over R: move one of the shells"
        )


def _cell_sides(V: fem.FunctionSpace, facets: NDArray[np.int32], owned: int) -> tuple[Longs, Array]:
    """Return this rank's own cells on boundary facets, with the sides that lie there.

    `owned` is the number of this rank's own cells, which have the first local numbers.

    Returns
    -------
    cells
        (n,) local numbers.
    ends
        (n, 2, 2) both ends of each side in the reference cell.
    """
    topology = V.mesh.topology
    topology.create_connectivity(1, 2)
    topology.create_connectivity(2, 1)
    to_cell, to_facet = topology.connectivity(1, 2), topology.connectivity(2, 1)
    cells, ends = list[int](), list[Array]()
    for facet in facets:
        cell = int(to_cell.links(facet)[0])  # a boundary facet has one cell
        if cell < owned:  # ghosts are other ranks'
            side = int(np.flatnonzero(to_facet.links(cell) == facet)[0])
            cells.append(cell)
            ends.append(CORNERS[SIDE_CORNERS[side]])
    return np.array(cells, dtype=np.int64), np.array(ends).reshape(-1, 2, 2)


def _angle(tangents: fem.Function, increments: fem.Function, edge_direction: fem.Function) -> Expr:
    """Return sine and cosine of the angle from normal n to normal m about the edge.

    `tangents` and `increments` (12,) add up to both tangents of the edge's cell and of the other
    one. The first two components of `edge_direction` give the edge in the coordinates of its cell.
    """

    def tangent(i: int) -> Expr:
        return ufl.as_vector([tangents[3 * i + c] + increments[3 * i + c] for c in range(3)])

    # tangents of the edge's cell (a) and of the other one (b)
    a1, a2, b1, b2 = (tangent(i) for i in range(4))

    def unit(v: Expr) -> Expr:
        return v / ufl.sqrt(ufl.dot(v, v))

    n = unit(ufl.cross(a1, a2))
    m = unit(ufl.cross(b1, b2))
    t = unit(edge_direction[0] * a1 + edge_direction[1] * a2)
    return ufl.as_vector([ufl.dot(ufl.cross(n, m), t), ufl.dot(n, m)])


def _tied_edges(joints: Sequence[Joint], surface: Midsurface) -> list[TiedEdge]:
    """Return the edges of T-junctions: first those of the case's joints, then a mesh file's.

    Those of a mesh file are rigid.
    """
    tied = [
        TiedEdge(joint, f"joints.{i}.edges", surface.patches[joint.edges[1]])
        for i, (joint, joint_cells) in enumerate(zip(joints, surface.joints, strict=True))
        if joint_cells is None  # else both edges share nodes and need no tie
    ]
    for name, is_other_shell in surface.t_junctions.items():
        joint = Joint((name, "the sheet"), rigid=True)
        tied.append(TiedEdge(joint, "shell.file", is_other_shell))
    return tied


def refuse_misplaced_edges(
    joints: Sequence[Joint], surface: Midsurface, r0: fem.Function, h: float
) -> None:
    """Refuse T-junctions of surfaces whose edge is off the other shell; collective.

    `h` is the thickness over R.

    Raises
    ------
    MeshError
        On every rank, with the edge.
    """
    tied_edges = _tied_edges(joints, surface)
    if not tied_edges:
        return
    surfaces, comm = MidSurfaces.gather(r0), r0.function_space.mesh.comm
    for joint, key, is_other_shell in tied_edges:
        edge = surfaces.edge_on_shell(surface.edges[joint.edges[0]], is_other_shell)
        edge.refuse_misplaced(comm, h, key, joint)
    _refuse_coinciding_shells(tied_edges, surface, r0, h)


def _refuse_coinciding_shells(
    tied_edges: Sequence[TiedEdge], surface: Midsurface, r0: fem.Function, h: float
) -> None:
    """Refuse two shells with tied edges that coincide where one edge is; collective.

    They do so if a cell beside one edge lies in the mid-surface of the other edge's shell, as where
    two shells stand on the same place of a third one. `h` is the thickness over R.

    Raises
    ------
    MeshError
        On every rank, with both edges.
    """
    if len(tied_edges) < 2:
        return
    surfaces, comm = MidSurfaces.gather(r0), r0.function_space.mesh.comm
    for tied_edge, other_tied_edge in permutations(tied_edges, 2):
        key, edge = tied_edge.key, tied_edge.joint.edges[0]
        other_edge = other_tied_edge.joint.edges[0]
        shell, other_shell = (_shell_of_edge(name, surface) for name in (edge, other_edge))
        # one shell with two edges, or an edge of a mesh file, whose sheets have no names
        if shell == other_shell or other_shell is None:
            continue
        # distance of the cells beside the edge from the shell of the other edge
        edge_on_other = surfaces.edge_on_shell(surface.edges[edge], surface.patches[other_shell])
        clearance = min(comm.allgather(edge_on_other.clearance))
        if clearance < MAX_DISTANCE_IN_THICKNESSES * h:
            raise MeshError(
                f"{key}: the shells of the edges {edge} and {other_edge} lie in each other: leave "
                "one of them out, or move it"
            )


def _shell_of_edge(edge: str, surface: Midsurface) -> str | None:
    """Return the shell with whose name an edge's name begins; None for a mesh file's edge."""
    # an edge's name is its shell's name, a dot or an underscore, and the edge's own
    beginnings = {name: (f"{name}.", f"{name}_") for name in surface.patches}
    return next((name for name, words in beginnings.items() if edge.startswith(words)), None)


def t_junction_terms(model: "ShellModel") -> list[SurfaceTJunction]:
    """Return the T-junction terms of a model on a mid-surface; collective.

    Raises
    ------
    MeshError
        On every rank, if an edge is misplaced.
    """
    surface = model.midsurface
    tied_edges = _tied_edges(model.loads.joints, surface)
    if not tied_edges:
        return []
    _refuse_coinciding_shells(tied_edges, surface, model.r0, model.material.h)
    stiffness, material, log = _stiffness_factors(model), model.material, model.kernels
    terms = []
    for tied_edge in tied_edges:
        facets = surface.edges[tied_edge.joint.edges[0]]
        terms.append(
            SurfaceTJunction(tied_edge, model.r0, model.u, facets, stiffness, material, log)
        )
    return terms


def meridian_t_junction_terms(model: "MeridianModel") -> list[MeridianTJunction]:
    """Return the T-junction terms of a model on a meridian; collective.

    Raises
    ------
    MeshError
        If an edge is not on the other meridian.
    """
    meridian, factors, log = model.meridian, _stiffness_factors(model), model.kernels
    # each joint with the parameters of its edge and place, and its cells; None: a T-junction
    joints = enumerate(zip(model.loads.joints, meridian.tied, meridian.joints, strict=True))
    return [
        MeridianTJunction(
            joint, f"joints.{i}.edges", model.r0, model.u, tied, factors, model.material, log
        )
        for i, (joint, tied, joint_cells) in joints
        if joint_cells is None
    ]


def _stiffness_factors(model: "ShellModel | MeridianModel") -> Array:
    """Return E h and E h^3 (cells, 2) of this rank's cells over those of the first shell."""
    cells = model.V.mesh.topology.index_map(model.V.mesh.topology.dim)
    factors = np.ones((cells.size_local + cells.num_ghosts, 2))
    if model.thickness is not None:
        # h(x)/h, its mean in each cell
        dofs_of_cells = model.thickness.function_space.dofmap.list
        ratio = model.thickness.x.array[dofs_of_cells].mean(axis=1)
        factors *= np.column_stack([ratio, ratio**3])
    if model.cell_materials is not None:
        # the first of a cell's four material numbers is its modulus over the first shell's
        material_numbers = model.cell_materials.x.array.reshape(-1, 4)
        dof_of_cells = model.cell_materials.function_space.dofmap.list[:, 0]
        factors *= material_numbers[dof_of_cells, :1]
    return factors
