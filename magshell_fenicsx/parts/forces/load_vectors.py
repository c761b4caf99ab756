"""Dead loads and forces in the model's terms: the entries of their load vectors.

Sizes are over E h R, in the model's frame. A section of a case becomes a load of the model by
`dead_load`; `assemble_dead_loads` makes vectors l of these with l . u = their work at u.

A dead load keeps its direction. Its density is a force per length or area; a pattern is a density
that is a function of the undeformed place and normal, as of a formula. Entries of a vector are
numbers of degrees of freedom and values, owned by this rank. A log compiles forms and keeps account
of them. r0 is the undeformed placement, a jet a map with its derivatives at quadrature points, an
amplitude a load parameter by name. A patch is a part of the surface: of a mesh by name, or a disc
around a point over which its force is spread.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import basix
import numpy as np
import ufl
from dolfinx import fem, mesh
from dolfinx.la import InsertMode
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.input.expressions import FormulaVectors, InwardPressure, formula_function
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.energy import edge_quadrature
from magshell_fenicsx.models.shell.parameters import (
    AreaForce,
    DeadLoad,
    EdgeForce,
    EdgeMoment,
    PointForce,
    Potential,
)
from magshell_fenicsx.models.shell.spatial_fields import (
    ADDED_LOAD_DEGREE,
    Pattern,
    cells_at_facets,
    pattern_field,
    pattern_on_edge,
)
from magshell_fenicsx.models.shell.thickness import patch_of
from magshell_fenicsx.parts.ability import Context, Modelled
from magshell_fenicsx.parts.forces.dead_load_step import DeadLoadSection, potential
from magshell_fenicsx.platform import compat

Entries = tuple[NDArray[np.int32], NDArray[np.float64]]
Inside = NDArray[np.bool_]
MIN_PATCH_SHARE = 0.15  # a patch's integral over that on a plane; at a corner it is a quarter
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Weighted:
    """A measure with a density: integrand * Weighted is the form of the weighted integral.

    Attributes
    ----------
    weight
        Density of the measure, such as undeformed area per reference area.
    measure
        A ufl measure.
    """

    weight: Expr
    measure: ufl.Measure

    def __rmul__(self, integrand: Expr) -> ufl.Form:
        return integrand * self.weight * self.measure

    def total(self, V: fem.FunctionSpace, log: KernelLog, name: str = "load measure") -> float:
        """Return the integral of one, such as a length or an area; collective.

        Parameters
        ----------
        name
            Name of the kernel in the log.
        """
        form = log.compile(name, fem.Constant(V.mesh, 1.0) * self)
        return float(V.mesh.comm.allreduce(fem.assemble_scalar(form)))


def load_entries(
    V: fem.FunctionSpace,
    direction: Expr,
    measure: Weighted,
    log: KernelLog,
    name: str = "load vector",
) -> Entries:
    """Return the owned entries of l with l . u = integral of direction . u; collective.

    They are local numbers of degrees of freedom, and values.

    Parameters
    ----------
    direction
        Vector (3,) density of the load.
    measure
        Weighted measure of the integral.
    log, name
        Compiles the form, which has this name there.
    """
    load = fem.assemble_vector(log.compile(name, ufl.dot(direction, ufl.TestFunction(V)) * measure))
    load.scatter_reverse(InsertMode.add)
    dofs = np.flatnonzero(load.array[: 3 * V.dofmap.index_map.size_local]).astype(np.int32)
    return dofs, load.array[dofs]


def smooth(x: Expr, radius: Expr) -> Expr:
    """Return the weight (1 - x.x/radius^2)^2 within a radius of x = 0, and 0 outside."""
    depth = 1 - ufl.dot(x, x) / radius**2
    return ufl.conditional(ufl.gt(depth, 0), depth**2, 0)


def averaged(
    V: fem.FunctionSpace,
    direction: NDArray[np.float64],
    measure: Weighted,
    log: KernelLog,
    radius: float | None = None,
) -> Entries:
    """Return the entries of l with l . u = average of direction . u; collective.

    The average is by the same quadrature as its weight, so that the total force is exact on any
    mesh.

    Parameters
    ----------
    direction
        The force (3,).
    radius
        Radius over R of a `smooth` patch, whose integral the mesh must resolve; None: no check.

    Raises
    ------
    MeshError
        On every rank, if the mesh is too coarse for the patch.
    """
    weight_integral = measure.total(V, log, "patch weight")
    if radius is not None and not _is_resolved(weight_integral, radius):
        raise MeshError(
            f"loading.patch: its radius is {radius:.3g} R, which the mesh is too coarse for: "
            "choose a smaller mesh.size, or 0 for a force at a point"
        )
    dofs, values = load_entries(V, fem.Constant(V.mesh, direction), measure, log, "patch load")
    return dofs, np.asarray(values / weight_integral)


def _is_resolved(weight_integral: float, radius: float) -> bool:
    """Return whether the integral of a `smooth` weight is about that on a plane.

    On a plane it is pi radius^2/3; a share of that is allowed, see `MIN_PATCH_SHARE`.
    """
    share = weight_integral / (np.pi * radius**2 / 3)
    return bool(MIN_PATCH_SHARE <= share <= 1 / MIN_PATCH_SHARE)


def point_entries(
    V: fem.FunctionSpace,
    x: NDArray[np.float64],
    direction: NDArray[np.float64],
    cells: Inside | None = None,
) -> Entries:
    """Return the owned entries of l with l . u = direction . u(x) for a vertex x (3,).

    They are local numbers of degrees of freedom, and values; empty on other ranks.

    Parameters
    ----------
    x
        Undeformed place of the vertex over R.
    direction
        The force (3,).
    cells
        Flags of the local cells that may have the vertex; None for all.
    """
    # numbers of the nodes at the place, which may be several where sheets meet; each has three
    # degrees of freedom
    nodes_at_x = fem.locate_dofs_geometrical(
        V, lambda points: np.linalg.norm(points.T - x, axis=1) < 1e-9
    )
    owned = nodes_at_x[nodes_at_x < V.dofmap.index_map.size_local]
    if cells is not None:
        owned = owned[np.isin(owned, V.dofmap.list[cells])]
    load_dofs = (3 * owned[:, None] + np.arange(3)).ravel().astype(np.int32)
    return load_dofs, np.tile(direction, len(owned))


def patch_entries(
    r0: fem.Function,
    x: NDArray[np.float64],
    radius: float,
    direction: NDArray[np.float64],
    degree: int,
    log: KernelLog,
    cells: Inside | None = None,
) -> Entries:
    """Return the entries of l with l . u = average of direction . u around x; collective.

    The weight is (1 - d^2/radius^2)^2, with d the distance from x in space. Its integral is taken
    with the same quadrature, so that the total force is exact on any mesh.

    Parameters
    ----------
    r0
        Undeformed placement over R.
    x, radius
        Centre (3,) and radius of the patch over R.
    direction
        The force (3,).
    degree
        Degree of the placement; the quadrature has twice as much.
    cells
        Flags of the local cells that the patch may be on; None for all.

    Raises
    ------
    MeshError
        On every rank, if the mesh is too coarse for the patch.
    """
    V = r0.function_space
    domain = V.mesh
    centre, patch_radius = (fem.Constant(domain, v) for v in (x, radius))
    dx = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": 2 * degree})
    # `smooth` is the weight of the patch; times undeformed area per area of the flat mesh
    weight = smooth(r0 - centre, patch_radius) * kin.area_ratio(kin.jet(r0, domain))
    # on other sheets near the point the weight is zero
    weight = weight if cells is None else weight * patch_indicator(domain, cells)
    return averaged(V, direction, Weighted(weight, dx), log, radius)


def vertex_normal(
    r0: fem.Function, x: NDArray[np.float64], cells: Inside | None = None
) -> NDArray[np.float64]:
    """Return the unit normal (3,) of the undeformed mid-surface at a vertex; collective.

    It is the mean of its triangles' normals, weighted by areas.

    Parameters
    ----------
    x
        Place (3,) of the vertex in the mesh's geometry.
    cells
        Flags of the local cells that count; None for all.
    """
    # flags of the cells' corners at the vertex, and both tangents at all corners
    _, is_at_vertex, (a1, a2) = _corners(r0, x, cells)
    # a1 x a2 is twice a triangle's area along its normal
    area_vector = r0.function_space.mesh.comm.allreduce(
        np.cross(a1[is_at_vertex], a2[is_at_vertex]).sum(axis=0)
    )
    return np.asarray(area_vector / np.linalg.norm(area_vector))


def by_vertex_normal(r0: fem.Function, x: Array, v: Array, cells: Inside | None = None) -> Array:
    """Return derivatives (own cells, nodes, 3) of v . n by the places of nodes; collective.

    n is the unit normal of the undeformed mid-surface at the vertex x: the mean of its triangles'
    normals, weighted by areas. The derivative by a node is the sum over the cells with this node.

    Parameters
    ----------
    x, v
        Place (3,) of the vertex, and a vector (3,).
    cells
        Flags of the local cells that count; None for all.
    """
    # derivatives of shape functions at corners, flags of the corners at the vertex, and tangents
    gradients, is_at_vertex, (a1, a2) = _corners(r0, x, cells)
    area_vector = r0.function_space.mesh.comm.allreduce(
        np.cross(a1[is_at_vertex], a2[is_at_vertex]).sum(axis=0)
    )
    area = np.linalg.norm(area_vector)
    # n is t/|t|, with the sum t of area vectors a1 x a2; v . n has the gradient p by t
    p = (v - area_vector * (area_vector @ v) / area**2) / area
    # p . (a1 x a2) has the gradients a2 x p by a1, and p x a1 by a2
    by_tangents = np.stack([np.cross(a2, p), np.cross(p, a1)]) * is_at_vertex[..., None]
    # by nodes k: sums over both tangents d and all corners v of cell c
    return np.asarray(np.einsum("dvk,dcvi->cki", gradients, by_tangents))


def _corners(r0: fem.Function, x: Array, cells: Inside | None) -> tuple[Array, Inside, Array]:
    """Return shape function gradients, flags of corners at a vertex, and tangents at corners.

    Parameters
    ----------
    x
        Place (3,) of the vertex in the mesh's geometry.
    cells
        Flags of the local cells that count; None for all.

    Returns
    -------
    gradients
        (2, corners, nodes) derivatives of shape functions at corners.
    is_at_vertex
        (own cells, corners) whether the corner is at the vertex x, in cells that count.
    tangents
        (2, own cells, corners, 3) undeformed tangents.
    """
    V = r0.function_space
    corners = basix.geometry(basix.CellType.triangle)
    gradients = V.element.basix_element.tabulate(1, corners)[1:, :, :, 0]
    owned = V.mesh.topology.index_map(2).size_local
    nodes = r0.x.array.reshape(-1, 3)[V.dofmap.list[:owned]]
    # corners in the mesh's geometry
    corner_places = V.mesh.geometry.x[compat.geometry_dofs(V.mesh)[:owned]]
    is_at_vertex = np.linalg.norm(corner_places - x, axis=2) < 1e-9
    if cells is not None:
        is_at_vertex = is_at_vertex & cells[:owned, None]
    return gradients, is_at_vertex, np.einsum("dvk,cki->dcvi", gradients, nodes)


def _is_shared_by_copies(load: DeadLoadSection, modelled: Modelled) -> bool:
    """Return whether the copies of the modelled part share a force of a load on the whole shell.

    On an edge whose mirror image is another edge there is only the force of that edge, which stays
    whole.
    """
    mirror = modelled.mirror
    if mirror is None:
        return False
    return load.edge is None or mirror.image_of_edge(load.edge) == load.edge


def dead_load(load: DeadLoadSection, name: str, context: Context, modelled: Modelled) -> DeadLoad:
    """Return a load of the case as the model takes it: dimensionless and in the model's frame.

    A half or a sector is modelled where there are mirror planes. A force of the whole shell is then
    divided by the number of copies, but not one on an edge that is not its own mirror image.

    Parameters
    ----------
    load
        Section of the case.
    name
        Name of its energy, if the load is a potential.
    context, modelled
        The case around the load, and the part of the shell that is modelled.
    """
    mirror = modelled.mirror
    is_shared = _is_shared_by_copies(load, modelled)
    Q, scales = rotation(modelled.turn), context.scales
    E, thickness, R = scales.E, scales.h, scales.R
    # loads by formula: of the deformed place, or of the undeformed one
    if load.potential is not None:
        return Potential(potential(name, load.potential, Q, scales))
    if load.varies:
        load_unit = E * thickness if load.edge else E * thickness / R  # per length, or per area
        pattern = _pattern(load, Q, length=R, factor=1 / load_unit)
        return (
            EdgeForce(load.edge, pattern, total=False)
            if load.edge
            else AreaForce(_patch_of_load(load), pattern)
        )
    # at a point or on an edge; `force` is zero, and not used, for a load that has no force
    share = 1 / mirror.copies if mirror and is_shared else 1.0
    force = np.asarray(share * (Q @ (load.force or np.zeros(3))) / (E * thickness * R))
    if load.at is not None:
        return PointForce(load.at, force)
    if load.edge is not None and load.moment is not None:
        return EdgeMoment(load.edge, load.moment / (E * thickness * R))
    if load.edge is not None and load.force is not None:
        return EdgeForce(load.edge, force, total=True)
    if load.edge is not None:
        assert load.per_length is not None
        per_length = np.asarray(Q @ np.array(load.per_length, dtype=float) / (E * thickness))
        return EdgeForce(load.edge, per_length, total=False)
    # over the surface
    if load.pressure is not None:
        assert isinstance(load.pressure, float | int)
        return AreaForce(_patch_of_load(load), load.pressure * R / (E * thickness))
    assert load.per_area is not None
    per_area = np.asarray(Q @ np.array(load.per_area, dtype=float) * R / (E * thickness))
    return AreaForce(_patch_of_load(load), per_area)


def _patch_of_load(load: DeadLoadSection) -> str | None:
    """Return the patch of a load; None for all of the surface."""
    return None if load.over == "all" else load.over


def _pattern(load: DeadLoadSection, Q: Array, length: float, factor: float) -> Pattern:
    """Return a load by formula as a pattern: a function of places and normals in the model's frame.

    A pressure is against the normal.

    Parameters
    ----------
    Q
        (3, 3) rotation from the case's frame to the model's frame.
    length
        Length R in the unit of the formula's places.
    factor
        Factor of the formula's values.
    """
    if load.vector is not None:  # whose values turn with the frame, as those of a pressure do not
        return FormulaVectors(
            [formula_function(v) for v in load.vector], Q, length, factor, vectors=True
        )
    assert load.pressure is not None
    return InwardPressure(FormulaVectors([formula_function(load.pressure)], Q, length, factor))


class Measures(Protocol):
    """The measures of the points, edges and surfaces of a model, on which loads act.

    Attributes
    ----------
    normal
        The undeformed outward unit normal, as a UFL expression.
    """

    normal: Expr

    def edge(self, name: str) -> Weighted:
        """Return the measure of undeformed length on a named edge."""

    def area(self, patch: str | None) -> Weighted:
        """Return the measure of undeformed area on a named patch; None for all."""

    def field(self, pattern: Pattern, edge: str | None) -> tuple[Expr, float | None]:
        """Return a pattern as a field on the surface or a named edge, and the integral of its size.

        The integral is None where it is not known; see `pattern_field`. Collective.
        """

    def at_point(self, name: str, force: NDArray[np.float64]) -> Entries:
        """Return the owned entries of the load vector of a force (3,) at a named vertex."""


@dataclass(frozen=True)
class DeadLoads:
    """The sum of the dead loads of one amplitude.

    Attributes
    ----------
    entries
        Owned entries of the load vector l, where l . u is the work of the loads at u, over E h R^2.
    size
        The sum of the loads' sizes over E h R, by which work is divided to get a displacement along
        the loads. The size of a force is its length. That of a distributed load is the integral of
        its density's length.
    spread
        For each distributed load its density, its measure, and whether the density is a total force
        divided by the length of its edge.
    sizes
        Parts of `size` as forms, where it depends on the undeformed placement.
    """

    entries: Entries
    size: float
    spread: "Sequence[tuple[Expr, Weighted, bool]]" = ()
    sizes: "Sequence[ufl.Form]" = ()


class _DeadLoadSum:
    """The sum of dead loads while it is made; all methods are collective.

    Parameters
    ----------
    V
        Space of the displacement.
    measures
        The points, edges and areas on which loads act.
    log
        Compiles forms.

    Attributes
    ----------
    parts
        Entries of the load vector of each load.
    size
        The sum of the loads' sizes over E h R. The size of a distributed load is the integral of
        its density's length.
    densities
        For each distributed load its density (3,), its measure, and whether the density is a total
        force divided by the length of its edge.
    size_forms
        Parts of `size` as forms, where it depends on the undeformed placement.
    """

    def __init__(self, V: fem.FunctionSpace, measures: Measures, log: KernelLog) -> None:
        self._V, self._measures, self._log = V, measures, log
        self.parts, self.size = list[Entries](), 0.0
        self.densities = list[tuple[Expr, Weighted, bool]]()
        self.size_forms = list[ufl.Form]()

    def add(self, load: DeadLoad) -> None:
        """Add a load to the sum; moments and potentials have no load vectors."""
        if isinstance(load, PointForce):
            self.parts.append(self._measures.at_point(load.point, load.force))
            self.size += float(np.linalg.norm(load.force))
        elif isinstance(load, EdgeForce):
            self._add_edge_force(load)
        elif isinstance(load, AreaForce):
            self._add_area_force(load)
        else:
            assert isinstance(load, EdgeMoment | Potential)

    def _add_edge_force(self, load: EdgeForce) -> None:
        """Add a force on an edge: a total, a density, or a pattern."""
        ds = self._measures.edge(load.edge)
        if callable(load.force):  # a pattern
            self._add_pattern(load.force, ds, load.edge)
            return
        edge_length = ds.total(self._V, self._log)
        force_per_length = np.asarray(load.force / edge_length) if load.total else load.force
        strength = float(np.linalg.norm(force_per_length))
        self._add_density(self._constant(force_per_length), ds, strength, is_total=load.total)
        self.size += strength * edge_length

    def _add_area_force(self, load: AreaForce) -> None:
        """Add a force per area: a pressure against the normal, a vector, or a pattern."""
        dx = self._measures.area(load.patch)
        if callable(load.force):  # a pattern
            self._add_pattern(load.force, dx, is_part=load.patch is not None)
            return
        if isinstance(load.force, float):  # a pressure
            direction = -self._constant(load.force) * self._measures.normal
            strength = abs(load.force)
        else:
            direction = self._constant(load.force)
            strength = float(np.linalg.norm(load.force))
        self._add_density(direction, dx, strength)
        self.size += strength * dx.total(self._V, self._log)

    def _add_pattern(
        self, pattern: Pattern, measure: Weighted, edge: str | None = None, *, is_part: bool = False
    ) -> None:
        """Add a load by formula, and the integral of its density's length to the size.

        Parameters
        ----------
        edge
            Name of its edge; None for a surface.
        is_part
            Whether it is on a patch, and not on all of the surface.
        """
        # the pattern as a field; for some patterns the integral of its length over all of the
        # surface or edge comes with it, else None
        density, integral_over_all = self._measures.field(pattern, edge)
        strength = ufl.sqrt(ufl.dot(density, density))
        self._add_density(density, measure, strength)
        if integral_over_all is not None and not is_part:
            self.size += integral_over_all
            return
        form = self._log.compile("load size", strength * measure)
        self.size += float(self._V.mesh.comm.allreduce(fem.assemble_scalar(form)))

    def _add_density(
        self, density: Expr, measure: Weighted, strength: Expr | float, *, is_total: bool = False
    ) -> None:
        """Add a load density (3,) on a measure.

        Parameters
        ----------
        strength
            Length of the density.
        is_total
            Whether the density is a total force over the length of its edge: then the load's size
            does not depend on the placement, and has no form.
        """
        self.parts.append(load_entries(self._V, density, measure, self._log))
        self.densities.append((density, measure, is_total))
        if not is_total:
            strength_form = self._constant(strength) if isinstance(strength, float) else strength
            self.size_forms.append(strength_form * measure)

    def _constant(self, value: float | Array) -> fem.Constant:
        return fem.Constant(self._V.mesh, value)


def assemble_dead_loads(
    loads: Sequence[DeadLoad], V: fem.FunctionSpace, measures: Measures, log: KernelLog
) -> DeadLoads:
    """Return the load vector of all dead loads except moments and potentials; collective."""
    load_sum = _DeadLoadSum(V, measures, log)
    for load in loads:
        load_sum.add(load)
    # several loads may have entries of one degree of freedom, which are added
    vector = np.zeros(3 * V.dofmap.index_map.size_local)
    for dofs, values in load_sum.parts:
        np.add.at(vector, dofs, values)
    dofs = np.flatnonzero(vector).astype(np.int32)
    entries = dofs, vector[dofs]
    return DeadLoads(entries, load_sum.size, load_sum.densities, load_sum.size_forms)


def patch_indicator(domain: mesh.Mesh, patch: NDArray[np.bool_]) -> fem.Function:
    """Return a field that is one in the cells of a patch, zero in the others.

    Parameters
    ----------
    patch
        (cells,) flags of local cells, ghosts included.
    """
    indicator = fem.Function(fem.functionspace(domain, ("DG", 0)))
    indicator.x.array[indicator.function_space.dofmap.list[:, 0]] = patch
    return indicator


def sides_of_cells(domain: mesh.Mesh, facets: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return the sides over which a line within a surface is integrated, each facet on one rank.

    Parameters
    ----------
    facets
        Local numbers of its facets.

    Returns
    -------
    numpy.ndarray
        (2 n,): for each of this rank's own facets a cell beside it, and the number of the facet
        there.
    """
    own_facets = facets[facets < domain.topology.index_map(1).size_local]
    return np.column_stack(cells_at_facets(domain.topology, own_facets)).astype(np.int32).ravel()


class SurfaceMeasures:
    """The `Measures` of a mid-surface.

    Parameters
    ----------
    r0
        Undeformed placement over R.
    midsurface
        The mesh with its edges, patches and points by name.
    degree
        Degree of the placement.

    The field `_j0` is the jet of the placement: itself with its derivatives.
    """

    def __init__(self, r0: fem.Function, midsurface: Midsurface, degree: int) -> None:
        """Take the undeformed placement, whose jet gives normals and areas."""
        self._V, self._r0 = r0.function_space, r0
        self._midsurface, self._degree = midsurface, degree
        self._j0 = kin.jet(r0, midsurface.mesh)
        self.normal = kin.normal(self._j0)

    def edge(self, name: str) -> Weighted:
        """Return the measure of undeformed length on a named edge."""
        domain, lines = self._midsurface.mesh, self._midsurface.inner_lines
        if name in lines:  # seen from one of the two cells beside each facet
            tags: Any = [(1, sides_of_cells(domain, lines[name]))]
        else:
            facets = self._midsurface.edges[name]
            tags = mesh.meshtags(domain, 1, facets, np.ones_like(facets))
        # two degrees more, as lengths and formulas along the edge are no polynomials
        rule = {"quadrature_degree": edge_quadrature(self._degree) + 2}
        ds = ufl.Measure("ds", domain=domain, subdomain_data=tags, metadata=rule)(1)  # the tag 1
        # undeformed length of the edge per length of the flat mesh's edge
        *_, length_ratio = kin.conormal(self._j0, kin.facet_covector(domain))
        return Weighted(length_ratio, ds)

    def area(self, patch: str | None) -> Weighted:
        """Return the measure of undeformed area on a named patch; None for all."""
        domain = self._midsurface.mesh
        dx = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": 2 * self._degree})
        weight = kin.area_ratio(self._j0)  # undeformed area per area of the flat mesh
        if patch is not None:
            weight = weight * patch_indicator(domain, patch_of(self._midsurface.patches, patch))
        return Weighted(weight, dx)

    def field(self, pattern: Pattern, edge: str | None) -> tuple[Expr, float | None]:
        """Return a pattern as a field, and the integral of its length if that is known, else None.

        The field is on the surface, or on a named edge. Collective.
        """
        if edge is None:
            return pattern_field(pattern, self._r0, ADDED_LOAD_DEGREE)
        surface = self._midsurface
        facets = {**surface.edges, **surface.inner_lines}[edge]
        return pattern_on_edge(pattern, self._r0, facets, ADDED_LOAD_DEGREE)

    def at_point(self, name: str, force: NDArray[np.float64]) -> Entries:
        surface = self._midsurface
        return point_entries(self._V, surface.points[name], force, surface.cells_of_point(name))
