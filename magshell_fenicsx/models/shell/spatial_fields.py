"""Fields that are functions of the undeformed position and normal."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import ClassVar

import basix
import numpy as np
from dolfinx import fem, mesh
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import FormulaGroup, formula_group
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.multi_shell import ShellPose
from magshell_fenicsx.mesh.patch import MeshError, UserField, refuse_places
from magshell_fenicsx.mesh.user_mesh import lagrange_element
from magshell_fenicsx.models.shell.formula_projection import (
    CellGeometry,
    Element,
    ProjectedFormula,
    project_formula,
)
from magshell_fenicsx.models.shell.own_term import FormulaParameter

Array = NDArray[np.float64]
MAX_COMPONENT = 1e6  # of a remanence's components
ADDED_LOAD_DEGREE = (
    2  # degrees of a load by formula above that of the displacement: no part of the error
)
INWARD_SHARE = 1e-10  # of the way from a node to the middle of its cell
MAX_NEWTON_STEPS, NEWTON_STEP_TOLERANCE = (
    30,
    1e-13,
)  # steps to a reference point, and a step that is rounding
# (cells, nodes, 3) positions r0 and normals n0 -> (cells, nodes, 3) vectors
Pattern = Callable[[Array, Array], Array]
InsideRim = Callable[[Array], NDArray[np.bool_]]  # places (n, 3) -> whether they are within a rim


class PlacementField(fem.Function):  # type: ignore[misc]  # dolfinx has no types
    """A field, perhaps discontinuous, that follows from the placement.

    `rebuild` is a function from another placement to the field on it.
    """

    def __init__(
        self, V: fem.FunctionSpace, name: str, rebuild: Callable[[fem.Function], fem.Function]
    ) -> None:
        super().__init__(V, name=name)
        self.rebuild = rebuild


def radial(r0: Array, n0: Array) -> Array:
    """Pattern along the normal: n0 at places r0, (cells, nodes, 3) each."""
    return n0


def tangential(r0: Array, n0: Array) -> Array:
    """Pattern along the meridians, away from e3; zero where the normal is along e3."""
    down = n0[..., 2:3] * n0 - np.array([0.0, 0.0, 1.0])
    length = np.linalg.norm(down, axis=-1, keepdims=True)
    return np.where(length > 1e-9, down / np.maximum(length, 1e-300), 0.0)


@dataclass(frozen=True)
class Uniform:
    """Pattern of the same vector (3,) everywhere."""

    vector: Array

    def __call__(self, r0: Array, n0: Array) -> Array:
        return np.broadcast_to(self.vector, r0.shape)


@dataclass(frozen=True)
class Components:
    """Pattern of three functions of x, y, z.

    Attributes
    ----------
    of_position
        Functions of arrays x, y, z over R, one for each component.
    frame
        (3, 3) axes of the functions' frame as columns, in the model's frame; None for that frame.
    """

    by_formula: ClassVar[bool] = True
    of_position: list[Callable[[Array, Array, Array], Array]]
    frame: Array | None = None

    def __call__(self, r0: Array, n0: Array) -> Array:
        if self.frame is not None:
            return np.asarray(Components(self.of_position)(r0 @ self.frame, n0) @ self.frame.T)
        return np.stack([f(*np.moveaxis(r0, -1, 0)) for f in self.of_position], axis=-1)

    @property
    def formulas(self) -> FormulaGroup | None:
        return formula_group(self.of_position, self.frame)


@dataclass(frozen=True)
class WithinRims:
    """Pattern of a vector within each rim, and another one elsewhere.

    Rims separate cells; where two overlap, the first counts.
    """

    inner_vectors: tuple[tuple[InsideRim, Array], ...]
    outer_vector: Array

    def __call__(self, r0: Array, n0: Array) -> Array:
        centre = r0.mean(axis=1)
        vectors = np.tile(self.outer_vector, (len(r0), 1))
        for is_inside, vector in reversed(self.inner_vectors):
            vectors[is_inside(centre)] = vector
        return np.broadcast_to(vectors[:, None], (*r0.shape[:-1], len(self.outer_vector)))


@dataclass(frozen=True)
class ByPatch:
    """A vector for each cell of this rank, ghosts included: (cells, size)."""

    vectors: Array

    def __call__(self, r0: Array, n0: Array) -> Array:
        cell_vectors = self.vectors[: len(r0), None]  # owned cells come first
        return np.broadcast_to(cell_vectors, (*r0.shape[:-1], cell_vectors.shape[-1]))


@dataclass(frozen=True)
class PosedPattern:
    """The pattern of one shell of several in its own frame, turned and times a factor."""

    pattern: Pattern
    place: ShellPose
    factor: float = 1.0

    def __call__(self, r0: Array, n0: Array) -> Array:
        vectors_in_shell = self.pattern(self.place.to_shell_frame(r0), n0 @ self.place.Q)
        return np.asarray(self.factor * vectors_in_shell @ self.place.Q.T)


@dataclass(frozen=True, eq=False)
class PatternsByPatch:
    """Patterns on some cells of this rank, and vectors elsewhere.

    Attributes
    ----------
    patterns
        Flags (cells,) of cells, ghosts included, with the pattern there.
    others
        The vectors.
    """

    patterns: tuple[tuple[NDArray[np.bool_], Pattern], ...]
    others: ByPatch

    def __call__(self, r0: Array, n0: Array) -> Array:
        vectors = np.array(self.others(r0, n0))
        for is_inside, pattern in self.patterns:
            own_cells = is_inside[: len(r0)]  # owned cells come first
            if own_cells.any():
                vectors[own_cells] = pattern(r0[own_cells], n0[own_cells])
        return vectors


@dataclass(frozen=True, eq=False)
class CellPolynomials:
    """A field that is a polynomial of its own in each cell.

    It can be evaluated at places that are the same in the reference cell for all cells.

    Attributes
    ----------
    values
        (cells, nodes, size) at the nodes of the element `element`.
    element
        Lagrange element of the polynomials.
    cells
        The cells with their geometry.
    """

    values: Array
    element: Element
    cells: CellGeometry

    def __call__(self, r0: Array, n0: Array | None = None) -> Array:
        """Return the values (cells, n, size) at places r0 (cells, n, 3) in the first cells.

        Owned cells come first. The reference points are found from the places in the first cell.
        """
        table = self.element.tabulate(
            0, self._reference(r0[0]) if len(r0) else self.element.points
        )[0, :, :, 0]
        return np.asarray(np.matmul(table, self.values[: len(r0)]))  # owned cells come first

    def values_between_nodes(self) -> tuple[Array, Array]:
        """Return values and places in owned cells, at the nodes and between them.

        Both are (cells, n, size or 3), on a lattice of twice the degree.
        """
        X = basix.create_lattice(
            self.element.cell_type,
            2 * max(self.element.degree, 1),
            basix.LatticeType.equispaced,
            True,
        )
        value_table, place_table = (
            element.tabulate(0, X)[0, :, :, 0] for element in (self.element, self.cells.element)
        )
        owned = slice(self.cells.owned)
        return np.matmul(value_table, self.values[owned]), np.matmul(
            place_table, self.cells.nodal[owned]
        )

    def _reference(self, places: Array) -> Array:
        """Return the reference points (n, 2) of places (n, 3) of the first cell.

        Newton's method starts from the middle.
        """
        element, nodal = self.cells.element, self.cells.nodal[0]
        X = np.full((len(places), 2), 1 / 3)
        for _ in range(MAX_NEWTON_STEPS):
            x, a1, a2 = (
                derivative_table[..., 0] @ nodal for derivative_table in element.tabulate(1, X)
            )
            slopes = np.stack([a1, a2], axis=-1)
            step = np.einsum("nai,ni->na", np.linalg.pinv(slopes), places - x)
            X = X + step
            if np.abs(step).max() < NEWTON_STEP_TOLERANCE:
                break
        return X


def user_field_polynomials(
    user_field: UserField, midsurface: Midsurface, cells: CellGeometry
) -> CellPolynomials:
    """Return a user's field on the mesh as polynomials in the cells of this rank.

    Raises
    ------
    MeshError
        If its degree is higher than that of the displacement.
    """
    if user_field.degree > cells.element.degree:
        raise MeshError(
            f"{user_field.name}: is a function of degree {user_field.degree}; allowed is at most "
            "that of the displacement, "
            f"{cells.element.degree}"
        )
    return CellPolynomials(
        midsurface.in_cells(user_field), lagrange_element(user_field.degree), cells
    )


def by_patch(
    vectors: Mapping[str, Array | Pattern],
    patches: Mapping[str, NDArray[np.bool_]],
    cells: int,
    key: str = "magnetic.remanent.patches",
) -> ByPatch | PatternsByPatch:
    """Return a pattern with a vector, or a pattern, on each named patch of a mesh.

    Parameters
    ----------
    vectors
        Name -> vector or pattern. The vector of "rest" is that of all other cells, zero by default.
        All vectors have the same size; patches that come later take the place of others.
    patches
        Name -> flags (cells,) of this rank's cells in the patch.
    cells
        Number of this rank's cells.
    key
        Key of the case file, for the message.

    Raises
    ------
    MeshError
        If there is no such patch.
    """
    vector_by_patch = {
        name: np.zeros(3) if callable(vector) else vector for name, vector in vectors.items()
    }
    zero = np.zeros_like(next(iter(vector_by_patch.values())))
    by_cell = np.tile(vector_by_patch.get("rest", zero), (cells, 1))
    patterns = list[tuple[NDArray[np.bool_], Pattern]]()
    for name, vector in vector_by_patch.items():
        if name in patches:
            by_cell[patches[name]] = vector
            patterns = [(is_inside & ~patches[name], pattern) for is_inside, pattern in patterns]
            pattern = vectors[name]
            if callable(pattern):
                patterns.append((patches[name], pattern))
        elif name != "rest":
            allowed = ", ".join(patches) or "none"
            raise MeshError(f"{key}: {name}: the surface has no such patch, only {allowed}")
    return PatternsByPatch(tuple(patterns), ByPatch(by_cell)) if patterns else ByPatch(by_cell)


def pattern_field(
    pattern: Pattern,
    r0: fem.Function,
    finer: int = 0,
    *,
    name: str = "Br",
    key: str = "magnetic.remanent",
    size: int = 3,
) -> tuple[PlacementField, float | None]:
    """Return a pattern as a discontinuous field on all cells, see `project_pattern`; collective.

    Parameters
    ----------
    pattern
        Function of undeformed places and normals.
    r0
        The placement.
    finer
        Degree of the field less that of r0; positive for loads.
    name, size
        Name of the field, and how many numbers it has.
    key
        Key of the case, for the message.

    Returns
    -------
    field
        The field; its `rebuild` makes it on another placement.
    size
        Integral of its size; None if the field itself has that integral.

    Raises
    ------
    MeshError
        On every rank, if it has no finite value somewhere.
    """
    V = r0.function_space
    Q = fem.functionspace(V.mesh, ("DG", V.element.basix_element.degree + finer, (size,)))
    nodes, n0 = positions_and_normals(r0, Q.element.basix_element.points)
    field = PlacementField(
        Q, name, lambda r: pattern_field(pattern, r, finer, name=name, key=key, size=size)[0]
    )
    refuse_unbounded(pattern(nodes, n0), nodes, V.mesh.comm, "loading.loads" if finer else key)
    projection = project_pattern(
        pattern, cell_geometry(r0), pattern(inside_cells(nodes), n0), Q.element.basix_element
    )
    field.x.array.reshape(-1, size)[Q.dofmap.list] = projection.nodal
    angle = 2 * np.pi if V.dofmap.index_map_bs == 2 else 1.0
    return field, None if projection.smooth else angle * projection.size


def formula_field(r0: fem.Function, parameter: FormulaParameter) -> fem.Function:
    """Return a formula's field (1,) on all cells, see `pattern_field`; collective."""
    return pattern_field(
        Components([parameter.of_place]), r0, name="factor", key=parameter.key, size=1
    )[0]


def pattern_on_edge(
    pattern: Pattern, r0: fem.Function, facets: NDArray[np.int32], finer: int
) -> tuple[fem.Function, float | None]:
    """Return a pattern as a field on some facets of the boundary; collective.

    Its values are valid on the facets alone: its moments are those along them.

    Parameters
    ----------
    pattern
        Function of undeformed places and normals.
    r0
        The placement.
    facets
        Local numbers of the facets.
    finer
        Degree of the field less that of r0.

    Returns
    -------
    field, size
        As those of `pattern_field`.
    """
    V = r0.function_space
    field, _ = pattern_field(InterpolatedPattern(pattern), r0, finer)
    field.rebuild = lambda r: pattern_on_edge(pattern, r, facets, finer)[0]
    Q, topology = field.function_space, V.mesh.topology
    cells, local_sides = _cells_at_facets(topology, facets)
    element, placement_element = Q.element.basix_element, V.element.basix_element
    edge_element = _interval_element(element.degree)
    edge_placement_element = _interval_element(placement_element.degree)
    points_by_side = [
        _points_on_side(element.cell_type, side, edge_placement_element.points) for side in range(3)
    ]
    place_tables = [placement_element.tabulate(0, X)[0, :, :, 0] for X in points_by_side]
    cell_places = r0.x.array.reshape(-1, 3)[V.dofmap.list[cells]]
    # places on the facets, as cells of dimension one
    nodal = np.matmul(np.array(place_tables)[local_sides], cell_places).reshape(len(cells), -1, 3)
    owned = int(np.sum(facets < topology.index_map(1).size_local))
    edge = CellGeometry(edge_placement_element, nodal, owned, V.mesh.comm)
    x, normals, _ = edge.evaluate(edge_element.points)
    projection = project_pattern(pattern, edge, pattern(inside_cells(x), normals), edge_element)
    if projection.smooth:
        return field, None
    nodes_by_side = [
        _nearest_nodes(element, _points_on_side(element.cell_type, side, edge_element.points))
        for side in range(3)
    ]
    values = field.x.array.reshape(-1, 3)
    # the field keeps its nodes inside the cells and takes the projection at those on facets
    for cell, side, vectors in zip(cells, local_sides, projection.nodal, strict=True):
        values[Q.dofmap.list[cell][nodes_by_side[side]]] = vectors
    return field, projection.size


def _cells_at_facets(
    topology: mesh.Topology, facets: NDArray[np.int32]
) -> tuple[NDArray[np.int64], list[int]]:
    """Return the cells (facets,) with boundary facets, and each facet's number in its cell."""
    topology.create_connectivity(1, 2)
    topology.create_connectivity(2, 1)
    to_cell, to_facet = topology.connectivity(1, 2), topology.connectivity(2, 1)
    cells = np.array([to_cell.links(facet)[0] for facet in facets], dtype=np.int64)
    local_sides = [
        int(np.flatnonzero(to_facet.links(cell) == facet)[0])
        for cell, facet in zip(cells, facets, strict=True)
    ]
    return cells, local_sides


def _interval_element(degree: int) -> Element:
    """Return the Lagrange element of a degree on an interval."""
    return basix.create_element(
        basix.ElementFamily.P, basix.CellType.interval, degree, basix.LagrangeVariant.gll_warped
    )


def _points_on_side(cell_type: basix.CellType, side: int, points: Array) -> Array:
    """Return the points (n, 2) of a triangle's side, from those (n, 1) of the interval."""
    a, b = basix.geometry(cell_type)[basix.topology(cell_type)[1][side]]
    return np.asarray(a + points * (b - a))


def _nearest_nodes(element: Element, points: Array) -> list[int]:
    """Return the numbers of an element's nodes that are nearest to some points."""
    return [int(np.argmin(np.linalg.norm(element.points - p, axis=1))) for p in points]


@dataclass(frozen=True)
class InterpolatedPattern:
    """A pattern that is interpolated, even if it is a formula."""

    pattern: Pattern

    def __call__(self, r0: Array, n0: Array) -> Array:
        return self.pattern(r0, n0)


def cell_geometry(r0: fem.Function) -> CellGeometry:
    """Return the cells of a placement, on a surface or a meridian, with their geometry."""
    V = r0.function_space
    owned = V.mesh.topology.index_map(V.mesh.topology.dim).size_local
    return CellGeometry(
        V.element.basix_element,
        r0.x.array.reshape(-1, V.dofmap.bs)[V.dofmap.list],
        owned,
        V.mesh.comm,
    )


def project_pattern(
    pattern: Pattern, cells: CellGeometry, nodal: Array, element: Element
) -> ProjectedFormula:
    """Return a pattern in every cell; collective.

    A formula has the same moments, see `project_formula`; other patterns are interpolated. `nodal`
    are the values (cells, nodes, components) at the nodes of `element`.
    """
    if not getattr(pattern, "by_formula", False):
        return ProjectedFormula(nodal, smooth=True, size=0.0)
    formulas = getattr(pattern, "formulas", None)
    return project_formula(pattern, cells, nodal, element, cells.element.degree, formulas=formulas)


def inside_cells(nodes: Array) -> Array:
    """Return the nodes (cells, nodes, 3) moved slightly into their cells.

    So a formula that jumps between two cells has both its values.
    """
    return np.asarray(nodes + INWARD_SHARE * (nodes.mean(axis=1, keepdims=True) - nodes))


def positions_and_normals(r0: fem.Function, points: Array | None = None) -> tuple[Array, Array]:
    """Return the places and unit normals at the nodes of every cell: (cells, n, 3) each.

    With `points` (n, 2), or (n, 1) on a meridian, they are those at these reference points. On a
    meridian, whose placement has components along e_rho and e_z, results are along (e_rho, e_theta,
    e_z).
    """
    V = r0.function_space
    element, size = V.element.basix_element, V.dofmap.index_map_bs
    table = element.tabulate(1, element.points if points is None else points)[..., 0]
    jets = np.einsum("dvk,cki->dcvi", table, r0.x.array.reshape(-1, size)[V.dofmap.list])
    if size == 2:
        (rho, z), (rho_s, z_s) = np.moveaxis(jets, -1, 1)
        normals = np.stack([-z_s, 0 * z_s, rho_s], axis=-1) / np.hypot(rho_s, z_s)[..., None]
        return np.stack([rho, 0 * rho, z], axis=-1), np.asarray(normals)
    x, a1, a2 = jets
    m = np.cross(a1, a2)
    return x, np.asarray(m / np.linalg.norm(m, axis=-1, keepdims=True))


def body_cell_geometry(V: fem.FunctionSpace) -> CellGeometry:
    """Return the cells of a body with their geometry; V is its Lagrange space."""
    owned = V.mesh.topology.index_map(3).size_local
    return CellGeometry(
        V.element.basix_element, V.tabulate_dof_coordinates()[V.dofmap.list], owned, V.mesh.comm
    )


def body_positions_and_normals(V: fem.FunctionSpace) -> tuple[Array, Array]:
    """Return the nodes of every cell of a body, and the normals of the surface at their height.

    Both are (cells, nodes, 3). That surface is where the third reference coordinate is constant.
    """
    element = V.element.basix_element
    table = element.tabulate(1, element.points)[:, :, :, 0]
    nodes = V.tabulate_dof_coordinates()[V.dofmap.list]
    a1, a2 = np.einsum("dvk,cki->dcvi", table[1:3], nodes)
    m = np.cross(a1, a2)
    return nodes, np.asarray(m / np.linalg.norm(m, axis=-1, keepdims=True))


def field_in_body(
    pattern: Pattern,
    V: fem.FunctionSpace,
    *,
    name: str = "Br",
    key: str = "magnetic.remanent",
    size: int = 3,
) -> fem.Function:
    """Return a pattern as a discontinuous field on the cells of a body; collective.

    Parameters
    ----------
    pattern
        Function of undeformed places and normals.
    V
        Lagrange space of the body.
    name, size
        Name of the field, and how many numbers it has.
    key
        Key of the case, for the message.

    Raises
    ------
    MeshError
        On every rank, if it has no finite value somewhere.
    """
    nodes, normals = body_positions_and_normals(V)
    Q = fem.functionspace(V.mesh, ("DG", V.element.basix_element.degree, (size,)))
    field = fem.Function(Q, name=name)
    refuse_unbounded(pattern(nodes, normals), nodes, V.mesh.comm, key)
    projection = project_pattern(
        pattern,
        body_cell_geometry(V),
        pattern(inside_cells(nodes), normals),
        Q.element.basix_element,
    )
    field.x.array.reshape(-1, size)[Q.dofmap.list] = projection.nodal
    return field


def refuse_unbounded(
    vectors: Array, nodes: Array, comm: MPI.Comm, key: str = "magnetic.remanent"
) -> None:
    """Refuse vectors that are not finite or above `MAX_COMPONENT`; collective.

    `vectors` and the places `nodes` are (cells, nodes, 3).

    Raises
    ------
    MeshError
        On every rank, with the first such place; it begins with `key`.
    """
    refuse_places(
        nodes[~(np.abs(vectors) <= MAX_COMPONENT).all(axis=-1)],
        f"{key}: has no finite value (or one above {MAX_COMPONENT:g})",
        comm,
    )
