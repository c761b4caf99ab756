"""Fields on a shell or a body that are functions of the undeformed place and normal.

In: a pattern and a placement. Out: a discontinuous finite-element field on the cells.

- A pattern is a function of undeformed places r0 and unit normals n0 that gives vectors: a
  remanence, a load or, with one component, a factor. Places are over R.
- The placement r0 maps the flat mesh, or the mesh of a meridian, to the undeformed surface.
- A smooth pattern is interpolated. A formula that varies within a cell is projected: the field has
  the formula's moments in the cell (`formula_projection`). The result, a `ProjectedFormula`, has
  the `nodal` values, the flag `smooth` (the pattern was interpolated in all cells), and `size`: the
  integral of the formula's length over all cells.
- The nodes of a discontinuous field belong to one cell each: (cells, nodes, components).
- Facets are the edges of triangles; boundary facets have one cell. The local number of a facet in
  its cell is 0, 1 or 2.
- Owned cells come first on each rank, ghosts after them.
- A rim is the edge of a dimple; a patch is a named part of the mesh.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import basix
import numpy as np
from dolfinx import fem, mesh
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.terms import FormTerm
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

    `rebuild` is a function from another placement to the field on it, for shells of another shape.
    """

    def __init__(
        self, V: fem.FunctionSpace, name: str, rebuild: Callable[[fem.Function], fem.Function]
    ) -> None:
        """Make a field that is zero; the caller sets its values."""
        super().__init__(V, name=name)
        self.rebuild = rebuild


def fields_of_placement(terms: Sequence[FormTerm]) -> list[PlacementField]:
    """Return the fields in terms that follow from the placement, each once."""
    coefficients = (
        coefficient
        for term in terms
        for coefficient in term.form.coefficients()
        if isinstance(coefficient, PlacementField)
    )
    return list(dict.fromkeys(coefficients))


def radial(r0: Array, n0: Array) -> Array:
    """Pattern along the normal: n0 at places r0, (cells, nodes, 3) each."""
    return n0


def tangential(r0: Array, n0: Array) -> Array:
    """Pattern of unit vectors along the meridians, away from the pole of e3.

    It is zero where the normal n0 is along e3, since a pole has no such direction.
    """
    # the part of -e3 in the surface
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
    """Pattern whose components are functions of x, y, z.

    `by_formula` marks it as a formula, which `project_pattern` projects.

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
        """Those of the components that are formulas of the case; None without any."""
        return formula_group(self.of_position, self.frame)


@dataclass(frozen=True)
class WithinRims:
    """Pattern of a vector within each rim, and another one elsewhere.

    Rims run along edges of cells, so that the centre of a cell decides. Where two rims overlap, the
    first one counts.
    """

    inner_vectors: tuple[tuple[InsideRim, Array], ...]
    outer_vector: Array

    def __call__(self, r0: Array, n0: Array) -> Array:
        """Return the vectors (cells, nodes, size) at places (cells, nodes, 3); n0 is not used."""
        centre = r0.mean(axis=1)
        # in reversed order, so that the vector of the first rim is written last
        vectors = np.tile(self.outer_vector, (len(r0), 1))
        for is_inside, vector in reversed(self.inner_vectors):
            vectors[is_inside(centre)] = vector
        return np.broadcast_to(vectors[:, None], (*r0.shape[:-1], len(self.outer_vector)))


@dataclass(frozen=True)
class ByPatch:
    """Pattern of one vector for each cell of this rank: `vectors` (cells, size), with ghosts.

    It may be called with the places of owned cells alone, which come first.
    """

    vectors: Array

    def __call__(self, r0: Array, n0: Array) -> Array:
        cell_vectors = self.vectors[: len(r0), None]  # owned cells come first
        return np.broadcast_to(cell_vectors, (*r0.shape[:-1], cell_vectors.shape[-1]))


@dataclass(frozen=True)
class PosedPattern:
    """The pattern of one of several shells, moved with this shell to its pose in the model.

    `pattern` is a function in the shell's own frame; `place` is the pose: rotation Q, position and
    scale.
    """

    pattern: Pattern
    place: ShellPose
    factor: float = 1.0

    def __call__(self, r0: Array, n0: Array) -> Array:
        vectors_in_shell = self.pattern(self.place.to_shell_frame(r0), n0 @ self.place.Q)
        return np.asarray(self.factor * vectors_in_shell @ self.place.Q.T)


@dataclass(frozen=True, eq=False)
class PatternsByPatch:
    """Patterns on some cells of this rank, and one vector in each other cell.

    Attributes
    ----------
    patterns
        Pairs of flags (cells,), ghosts included, and the pattern in the flagged cells.
    others
        A vector for each cell; in flagged cells it is not used.
    """

    patterns: tuple[tuple[NDArray[np.bool_], Pattern], ...]
    others: ByPatch

    def __call__(self, r0: Array, n0: Array) -> Array:
        """Return the vectors (cells, nodes, size) at places and normals (cells, nodes, 3)."""
        vectors = np.array(self.others(r0, n0))
        for is_inside, pattern in self.patterns:
            own_cells = is_inside[: len(r0)]  # owned cells come first
            if own_cells.any():
                vectors[own_cells] = pattern(r0[own_cells], n0[own_cells])
        return vectors


@dataclass(frozen=True, eq=False)
class CellPolynomials:
    """A pattern that is a polynomial of its own in each cell, as of a user's field on the mesh.

    It can be evaluated only at places that have the same reference coordinates in all cells.

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

        `r0` may have the owned cells alone, which come first. The reference coordinates follow from
        the places in the first cell; the normals n0 are not used.
        """
        # a rank without cells has no place to start from: any points give an empty result
        points = self._reference(r0[0]) if len(r0) else self.element.points
        table = self.element.tabulate(0, points)[0, :, :, 0]
        return np.asarray(np.matmul(table, self.values[: len(r0)]))

    def values_between_nodes(self) -> tuple[Array, Array]:
        """Return values (cells, n, size) and places (cells, n, 3) in owned cells.

        They are taken on a lattice of twice the degree, so at the nodes and between them: a
        polynomial may leave the range of its nodal values there.
        """
        divisions = 2 * max(self.element.degree, 1)
        X = basix.create_lattice(
            self.element.cell_type, divisions, basix.LatticeType.equispaced, True
        )
        value_table, place_table = (
            element.tabulate(0, X)[0, :, :, 0] for element in (self.element, self.cells.element)
        )
        owned = slice(self.cells.owned)
        values = np.matmul(value_table, self.values[owned])
        return values, np.matmul(place_table, self.cells.nodal[owned])

    def _reference(self, places: Array) -> Array:
        """Return the reference coordinates (n, 2) of places (n, 3) in the first cell.

        They solve x(X) = place by the Gauss-Newton method, from the middle of the triangle.
        """
        element, nodal = self.cells.element, self.cells.nodal[0]
        X = np.full((len(places), 2), 1 / 3)
        for _ in range(MAX_NEWTON_STEPS):
            # places and tangents at the present reference points
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

    `cells` are the cells of the model with their geometry; `midsurface` finds the user's values in
    them.

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
    """Return a pattern that is made of a vector, or a pattern, on each named patch of a mesh.

    Parameters
    ----------
    vectors
        Name -> vector or pattern. "rest" names all cells that are in no patch; its vector is zero
        by default. All vectors have the same size. Where patches overlap, the later one counts.
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
    # a patch with a pattern has zero vectors, in place of which the pattern is evaluated later
    vector_by_patch = {
        name: np.zeros(3) if callable(vector) else vector for name, vector in vectors.items()
    }
    zero = np.zeros_like(next(iter(vector_by_patch.values())))
    by_cell = np.tile(vector_by_patch.get("rest", zero), (cells, 1))
    patterns = list[tuple[NDArray[np.bool_], Pattern]]()
    for name, vector in vector_by_patch.items():
        if name in patches:
            by_cell[patches[name]] = vector
            # earlier patterns lose the cells of this patch
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
    """Return a pattern as a discontinuous field on all cells, and its integral; collective.

    A smooth pattern is interpolated, a formula is projected (`project_pattern`).

    Parameters
    ----------
    pattern
        Function of undeformed places and normals.
    r0
        The placement.
    finer
        How much higher the degree of the field is than that of r0; positive for loads alone.
    name, size
        Name of the field, and its number of components.
    key
        Key of the case, for the message. Messages on loads have `loading.loads` in its place.

    Returns
    -------
    field
        The field; its `rebuild` makes it on another placement.
    integral
        Integral of the pattern's length over the surface. None if the pattern was interpolated:
        the field itself then has this integral.

    Raises
    ------
    MeshError
        On every rank, if it has no finite value somewhere.
    """
    V = r0.function_space
    Q = fem.functionspace(V.mesh, ("DG", V.element.basix_element.degree + finer, (size,)))

    def rebuild(placement: fem.Function) -> fem.Function:
        """Return the field on another placement."""
        field_there, _ = pattern_field(pattern, placement, finer, name=name, key=key, size=size)
        return field_there

    field = PlacementField(Q, name, rebuild)
    # places and normals at the nodes of the field
    nodes, n0 = positions_and_normals(r0, Q.element.basix_element.points)
    # only loads have a finer field
    refuse_unbounded(pattern(nodes, n0), nodes, V.mesh.comm, "loading.loads" if finer else key)
    at_nodes = pattern(inside_cells(nodes), n0)  # kept if the pattern is no formula
    projection = project_pattern(pattern, cell_geometry(r0), at_nodes, Q.element.basix_element)
    field.x.array.reshape(-1, size)[Q.dofmap.list] = projection.nodal
    # on a meridian (two components) integrals are per radian around the axis
    angle = 2 * np.pi if V.dofmap.index_map_bs == 2 else 1.0
    return field, None if projection.smooth else angle * projection.size


def formula_field(r0: fem.Function, parameter: FormulaParameter) -> fem.Function:
    """Return a formula of the place as a discontinuous field (1,) on all cells; collective.

    `parameter` has the formula, a function of x, y and z over R, and its key in the case.
    """
    field, _ = pattern_field(
        Components([parameter.of_place]), r0, name="factor", key=parameter.key, size=1
    )
    return field


def pattern_on_edge(
    pattern: Pattern, r0: fem.Function, facets: NDArray[np.int32], finer: int
) -> tuple[fem.Function, float | None]:
    """Return a pattern as a field on some facets of the boundary, and its integral; collective.

    The field is defined on all cells, but its values count on the facets alone. There a formula is
    projected along the facet, as a cell of dimension one: the moments are integrals over its
    length.

    Parameters
    ----------
    pattern
        Function of undeformed places and normals.
    r0
        The placement.
    facets
        Local numbers of the facets.
    finer
        How much higher the degree of the field is than that of r0.

    Returns
    -------
    field
        The field; its `rebuild` makes it on another placement.
    integral
        Integral of the pattern's length along the facets; None if the pattern was interpolated.
    """
    V = r0.function_space
    # first the pattern is interpolated on all cells; only the nodes on facets are projected below
    field, _ = pattern_field(InterpolatedPattern(pattern), r0, finer)

    def rebuild(placement: fem.Function) -> fem.Function:
        """Return the field on another placement."""
        field_there, _ = pattern_on_edge(pattern, placement, facets, finer)
        return field_there

    field.rebuild = rebuild
    Q = field.function_space
    cells, local_sides = cells_at_facets(V.mesh.topology, facets)
    edges = _facets_as_cells(r0, facets, cells, local_sides)
    element = Q.element.basix_element
    edge_element = _interval_element(element.degree)  # the field's element along a facet
    # places, and normals (zero on an edge in space), at its nodes on each facet
    x, normals, _ = edges.evaluate(edge_element.points)
    projection = project_pattern(pattern, edges, pattern(inside_cells(x), normals), edge_element)
    if projection.smooth:
        return field, None
    # for each side of a cell the nodes of the field that are nodes of the facet
    nodes_by_side = [
        _nearest_nodes(element, _points_on_side(element.cell_type, side, edge_element.points))
        for side in range(3)
    ]
    values = field.x.array.reshape(-1, 3)
    # the field keeps its values inside the cells and takes the projection at nodes on facets
    for cell, side, vectors in zip(cells, local_sides, projection.nodal, strict=True):
        values[Q.dofmap.list[cell][nodes_by_side[side]]] = vectors
    return field, projection.size


def _facets_as_cells(
    r0: fem.Function,
    facets: NDArray[np.int32],
    cells: NDArray[np.int64],
    local_sides: list[int],
) -> CellGeometry:
    """Return facets of the boundary as cells of dimension one, with their geometry.

    `cells` are the cells at the facets, `local_sides` the local number of each facet in its cell.
    """
    V, topology = r0.function_space, r0.function_space.mesh.topology
    element = V.element.basix_element
    edge_element = _interval_element(element.degree)
    # for each side of the reference triangle: the nodes of an edge on it, and there the shape
    # functions of the cell
    points_by_side = [
        _points_on_side(element.cell_type, side, edge_element.points) for side in range(3)
    ]
    tables_by_side = np.array([element.tabulate(0, X)[0, :, :, 0] for X in points_by_side])
    # places (facets, nodes, 3) of the edges' nodes, from those of the cells' nodes
    cell_places = r0.x.array.reshape(-1, 3)[V.dofmap.list[cells]]
    nodal = np.matmul(tables_by_side[local_sides], cell_places).reshape(len(cells), -1, 3)
    owned = int(np.sum(facets < topology.index_map(1).size_local))
    return CellGeometry(edge_element, nodal, owned, V.mesh.comm)


def cells_at_facets(
    topology: mesh.Topology, facets: NDArray[np.int32]
) -> tuple[NDArray[np.int64], list[int]]:
    """Return the first cell (facets,) at each facet, and the facet's local number in it.

    `facets` are their local numbers on this rank.
    """
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
    """Map points (n, 1) of the unit interval to a side of the reference triangle: (n, 2)."""
    # the two corners at the ends of the side
    _, corners_of_sides, *_ = basix.topology(cell_type)
    a, b = basix.geometry(cell_type)[corners_of_sides[side]]
    return np.asarray(a + points * (b - a))


def _nearest_nodes(element: Element, points: Array) -> list[int]:
    """Return the numbers of an element's nodes that are nearest to some points."""
    return [int(np.argmin(np.linalg.norm(element.points - p, axis=1))) for p in points]


@dataclass(frozen=True)
class InterpolatedPattern:
    """A pattern that is interpolated even if it is a formula: it has no flag `by_formula`."""

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
    """Return nodal values of a pattern in every cell; collective.

    A formula (with the flag `by_formula`) is projected by `project_formula`, so that its moments
    are right where it varies within a cell. Other patterns are interpolated: they keep `nodal`, the
    values (cells, nodes, components) at the nodes of `element`.

    Parameters
    ----------
    cells
        The cells with their geometry.
    element
        Element of the resulting values.
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

    With `points`, (n, 2) or (n, 1) on a meridian, they are taken at these reference points instead
    of the nodes. The placement of a meridian has two components, along e_rho and e_z. The results
    are then along (e_rho, e_theta, e_z).
    """
    V = r0.function_space
    element, components = V.element.basix_element, V.dofmap.index_map_bs
    # values and first derivatives, (derivative, cells, n, components)
    table = element.tabulate(1, element.points if points is None else points)[..., 0]
    jets = np.einsum("dvk,cki->dcvi", table, r0.x.array.reshape(-1, components)[V.dofmap.list])
    if components == 2:  # a meridian
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
    """Return the nodes of every cell of a body, and normals there: (cells, nodes, 3) each.

    The third reference coordinate of a cell runs through the thickness. A normal is that of the
    surface on which this coordinate is constant.
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
        Name of the field, and its number of components.
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
