"""The model of a thin shell: a system of those terms that its loads and edges call for.

In go a mid-surface (mesh and placement r0), material, loads and edge conditions. Out comes a model
with its `system`, the equations that solvers take. Lengths are in R, energies in E h R^2.

A term is a summand of the potential or of the virtual work. An amplitude is a load parameter, by
name, such as "pressure" (p/p_c) and "force" (F R/(2 pi D)). A condition is the
support of an edge: "symmetry" puts the edge on the mirror plane of a half model or a sector,
"plane" on another plane of symmetry. A growing imperfection is a deviation from the perfect surface
that an amplitude scales. An opening is an edge where the pressed surface ends; a lid is the surface
that closes a moving one. A user field is a caller's function on the mesh. "Refuse" means: raise an
error on every rank.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import ufl
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem, SystemVariables
from magshell_fenicsx.assembly.free_parameters import FreeParameter, PlacementAmplitudes
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.oblique_supports import Constraint, support_along
from magshell_fenicsx.assembly.prescribed_motion import EdgeCurve, EdgePressure, triangle_sides
from magshell_fenicsx.assembly.terms import FormTerm, LinearTerm, Term
from magshell_fenicsx.continuation.system import Amplitudes
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.mirror import (
    SECOND_SYMMETRY_EDGE,
    Y0_PLANE,
    Mirror,
    Sector,
)
from magshell_fenicsx.mesh.patch import Deviation, Embedding, UserField
from magshell_fenicsx.models.domains import surface_domain
from magshell_fenicsx.models.shell.antisymmetric import AntisymmetricModes
from magshell_fenicsx.models.shell.edges import FOLD_ANGLE, largest_fold
from magshell_fenicsx.models.shell.energy import ShellTerm
from magshell_fenicsx.models.shell.fast_tangent import FastTangent, hessian_integrals
from magshell_fenicsx.models.shell.formula_projection import CellGeometry
from magshell_fenicsx.models.shell.gradients import PointTerm
from magshell_fenicsx.models.shell.parameters import (
    Condition,
    Force,
    Material,
    default_penalty,
)
from magshell_fenicsx.models.shell.residual import FastResidual, point_parameters
from magshell_fenicsx.models.shell.spatial_fields import (
    CellPolynomials,
    cell_geometry,
    fields_of_placement,
    formula_field,
    positions_and_normals,
    user_field_polynomials,
)
from magshell_fenicsx.models.shell.thickness import Thickness, material_field, thickness_field
from magshell_fenicsx.parts.forces.load_vectors import (
    SurfaceMeasures,
    assemble_dead_loads,
    patch_entries,
    point_entries,
    vertex_normal,
)
from magshell_fenicsx.parts.joints import Creases
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.applied import field_parameters
from magshell_fenicsx.parts.natural.shape import Shape, natural_field
from magshell_fenicsx.parts.pressure.openings import (
    edge_openings,
    ends_within,
    pressed_parts,
    side_field,
    sides_of_cells,
)
from magshell_fenicsx.parts.supports.support_motion import (
    enclosed,
    motions_of,
    moving,
    pressed_edges,
)
from magshell_fenicsx.parts.supports.supports import (
    closing_point,
    free_motion,
    put_in_plane,
    refuse_unknown,
)
from magshell_fenicsx.shells.energy_factory import EnergyFactory
from magshell_fenicsx.shells.model_base import ThinModel
from magshell_fenicsx.shells.sector_modes import SectorModes
from magshell_fenicsx.shells.shell_supports import ShellSupports

if TYPE_CHECKING:
    from magshell_fenicsx.parts.contact.pair_contact import PairContact
    from magshell_fenicsx.parts.magnetism.interacting import InteractionTerm

Array = NDArray[np.float64]


class ShellModel(ThinModel):
    """A Koiter shell on a mid-surface. Construction is collective and compiles kernels.

    Parameters
    ----------
    midsurface
        Mesh and placement.
    material
        Thickness and elastic law.
    degree
        Degree of displacement and placement, 2 to 5.
    conditions
        Edge name -> condition; edges that are not named are free. A vertex can be held too, and a
        patch, all of it, clamped or held.
    loads
        All loads with their amplitudes.
    sigma
        Penalty of the C0 interior penalty form; None takes `default_penalty`.
    thickness
        Factor of the thickness; None for 1.
    mirror
        The plane of the edge with the condition "symmetry", of a half model; both planes of a
        sector.

    Raises
    ------
    MeshError
        On every rank, if the surface has no such edge, point or patch, or an edge lies in no plane
        of symmetry.

    Attributes
    ----------
    system
        The equations that solvers take.
    multiplicity
        Number of modelled parts that make the shell: 2 for a half, 2 m for a sector, else 1.
    normals
        n0 (3,) at the named points.
    loads
        All that loads the model, with functions on the mesh in place of formulas.
    load_size, load_sizes
        By amplitude, the sum of the sizes of its dead loads over E h R, and that sum as forms.
    supports
        Name of an edge, point or patch -> its support.
    V, r0, u
        Space of the displacement; placement and displacement over R.
    shell_contacts
        The contacts of parts of the shell with each other, or with itself.
    fields
        Applied fields that are known by their values.
    factory
        Factory that made the energies.
    kernels
        Names and compile time of the forms in use.
    thickness
        h(x)/h, free to jump from cell to cell; None for 1.
    cell_materials
        `parameters.ShellMaterial.numbers` of each cell; None where all shells have one material.
    mirror
        Planes of a half model or a sector.
    growing
        The placement with amplitudes of growing imperfections; None without.
    turns
        Whether its material and all its loads are axisymmetric, so that it may turn about its axis;
        whoever makes the model may set it.
    moving
        The motion of the supports; None if none moves.
    planes
        All symmetry planes on which edges lie, those of the modelled part first.
    without_potential
        Edges at which a live pressure has no potential.
    _arguments
        Arguments of the constructor after the mid-surface, without the mirror.
    _conditions
        The parameter `conditions`.
    _mirror_planes
        Edge with the condition "symmetry" -> its plane.
    _mirrored_facets
        Local facets of all these edges, sorted.
    _mirror_term, _pattern_term
        Term of the edges on the last of these planes, and the term of interior edges, which gives
        the sparsity pattern.
    _constraints
        Constraints of the displacement by the conditions, without those on mirror planes.
    _hessians
        Integrals of the terms' Hessians.
    """

    thin: Literal[True] = True
    axisymmetric: Literal[False] = False
    turns: bool = False
    midsurface: Midsurface

    def __init__(
        self,
        midsurface: Midsurface,
        material: Material,
        degree: int,
        conditions: Mapping[str, Condition],
        loads: Loads,
        sigma: float | None = None,
        thickness: Thickness | None = None,
        mirror: Mirror = Y0_PLANE,
    ) -> None:
        """Make placement, loads on the mesh and factory, then terms and system, in this order."""
        self._arguments = material, degree, conditions, loads, sigma, thickness
        names = midsurface.edges, midsurface.points, midsurface.patches
        refuse_unknown(*names, conditions, loads, midsurface.inner_lines)
        loads = _magnetisation_by_cell(loads, midsurface)
        self.midsurface, self.material, self.degree = midsurface, material, degree
        self.mirror, self._conditions = mirror, conditions
        self._mirror_planes = {
            edge: plane
            for edge, plane in mirror.planes.items()
            if conditions.get(edge) == "symmetry"
        }
        self.multiplicity = mirror.copies if self._mirror_planes else 1
        self.sigma = default_penalty(degree) if sigma is None else sigma
        self.load_size, self.load_sizes = {}, {}
        self.kernels = KernelLog()
        self._has_old_fields = False
        # of the functions of a program: field, its values in the model, and what reads them anew
        self._user_values: list[tuple[UserField, Array, Callable[[], Array]]] = []
        self.V = fem.functionspace(midsurface.mesh, ("Lagrange", degree, (3,)))
        self.r0, self.u = midsurface.placement(self.V), fem.Function(self.V, name="u")
        cells = cell_geometry(self.r0)  # in which fields are projected onto polynomials
        self._refuse_normal_plies()
        self.loads = self._with_functions(loads, cells)
        self._put_edges_in_planes()
        self.growing = self._growing_placement()
        self.thickness = self._thickness_field(thickness, cells)
        self.cell_materials = None
        if material.shells:
            self.cell_materials = material_field(
                material.shells, midsurface.mesh, midsurface.patches
            )
        self.factory = self._make_factory(cells)
        self._assemble()

    def _assemble(self) -> None:
        """Make all terms of the factory's energies, and the system; collective.

        Sets the attributes of the model that come with terms and supports.
        """
        factory, midsurface = self.factory, self.midsurface
        # elastic energies
        self._pattern_term = factory.term(factory.interior_edges())
        terms: list[Term] = [
            factory.term(factory.membrane()),
            factory.term(factory.bending()),
            self._pattern_term,
        ]
        # supports, with energies of clamped edges and of edges on mirror planes
        supports = ShellSupports(
            self.r0,
            midsurface,
            self._conditions,
            self._mirror_planes,
            self.material.laminate_by_shell,
            self.loads,
            factory,
        )
        terms += supports.terms
        self._mirror_term, self._constraints = supports.mirror_term, supports.constraints
        self.supports, self.planes = supports.by_name, tuple(supports.planes)
        # volume, applied field and live pressure
        opening_edges, is_enclosed = self._find_openings()
        origin = closing_point(self.planes)  # a point on all planes, or None
        volume = self._volume_form(origin, is_enclosed=is_enclosed)
        terms += self._field_and_pressure_terms()
        interaction = self._interaction_term()
        if interaction is not None:
            terms.append(interaction)
        terms += [factory.term(energy) for energy in self.user_and_body_energies(midsurface.edges)]
        # forces, which act along the normals
        self.normals = self._normals_at_points()
        terms += self._force_terms()
        # contacts and junctions between parts of the shell
        self.shell_contacts = self._make_shell_contacts()
        terms += self.shell_contacts
        terms += self._t_junction_terms()
        # the system
        self._hessians = hessian_integrals(
            self.r0, self.degree, terms, self.kernels, factory.prestress()
        )
        edge_pressure = self._edge_pressure(opening_edges, origin) if is_enclosed else None
        self.moving = moving(self.r0, self.supports, self.loads, edge_pressure)
        constraints = supports.constraints + supports.mirror_constraints
        self.fields = factory.fields
        self.system = self._make_system(terms, constraints)
        self._mirrored_facets = self._facets_on_mirror()
        self.observe(
            self.kernels.compile("volume energy", volume),
            midsurface.points,
            midsurface.cells_of_point,
        )
        self._observe_inside_cells()
        if interaction is not None:
            interaction.refuse_near()  # reads the finished model

    def _observe_inside_cells(self) -> None:
        """Observe points of stresses that are no vertices, as those of a mesh file; collective."""
        for point in self.loads.stress.points if self.loads.stress else ():
            if point.name not in self.midsurface.points:
                from magshell_fenicsx.shells.stress_recovery import point_of_shell

                location = point_of_shell(self, point)
                self.observe_inside(point.name, location.cells, location.reference)

    def _normals_at_points(self) -> dict[str, NDArray[np.float64]]:
        """Return the undeformed normals (3,) at the named points; collective."""
        return {
            name: vertex_normal(self.r0, x, self.midsurface.cells_of_point(name))
            for name, x in self.midsurface.points.items()
        }

    def _refuse_normal_plies(self) -> None:
        """Refuse plies whose direction is normal to the surface of their shell; collective."""
        for shell, laminate in self.material.laminate_by_shell.items():
            # mask of the shell's cells; the only shell of a model has an empty name
            cells = self.midsurface.patches[shell] if shell else slice(None)
            _, normals_of_cells = positions_and_normals(self.r0)
            normals = normals_of_cells[cells]
            laminate.refuse_normal(normals, self.midsurface.mesh.comm)

    def _with_functions(self, loads: Loads, cells: CellGeometry) -> Loads:
        """Return the loads with functions on the mesh in place of user fields and formulas.

        User fields give magnetisations, formulas give parameters of terms. `cells` is the geometry
        in which fields are projected onto polynomials.
        """
        for name in ("magnetic", "remanence"):
            magnetisation = getattr(loads, name)
            if magnetisation and magnetisation.given:  # vectors as a user field
                vectors = self._polynomials(magnetisation.given, cells)
                loads = replace(loads, **{name: replace(magnetisation, remanent=vectors)})
        formula_to_field = partial(formula_field, self.r0)
        user_terms = (
            term.with_functions(formula_to_field, self._function_of_term)
            for term in loads.user_terms
        )
        return replace(loads, user_terms=tuple(user_terms))

    def _polynomials(self, user_field: UserField, cells: CellGeometry) -> CellPolynomials:
        """Return a user's field as polynomials in cells, with values that `read_functions` sets."""
        polynomials = user_field_polynomials(user_field, self.midsurface, cells)
        read = partial(self.midsurface.in_cells, user_field)
        self._user_values.append((user_field, polynomials.values, read))
        return polynomials

    def _function_of_term(self, user_field: UserField) -> fem.Function:
        """Return a user's field as a function, with values that `read_functions` sets."""
        function = self.midsurface.function(user_field)
        dofs = function.function_space.dofmap.list

        def read() -> Array:
            """Return the values of the function anew."""
            values = np.empty_like(function.x.array)
            values.reshape(-1, user_field.size)[dofs] = self.midsurface.in_cells(user_field)
            return np.asarray(values)

        self._user_values.append((user_field, function.x.array, read))
        return function

    def read_functions(self) -> bool:
        """Read the functions that a program has given again; collective.

        The energies, and fields that follow from the functions, have the new values.

        Returns
        -------
        Whether any value has changed on any rank.

        Raises
        ------
        MeshError
            On every rank, if values are not allowed.
        """
        has_changed = self._has_old_fields
        for user_field, values, read in self._user_values:
            user_field.update()
            new_values = read()
            has_changed |= not np.array_equal(new_values, values)
            values[...] = new_values
        if not self.midsurface.mesh.comm.allreduce(has_changed, MPI.LOR):
            return False
        self._has_old_fields = True  # until all are made: a value may be refused
        forms = [term for term in self.system.terms if isinstance(term, FormTerm)]
        for field in fields_of_placement(forms):
            field.x.array[:] = field.rebuild(self.r0).x.array
        self._has_old_fields = False
        return True

    def _put_edges_in_planes(self) -> None:
        """Move the nodes of edges with the condition "plane" into their planes."""
        # nodes of a mesh file stay where the file has them
        if self.midsurface.from_mesh_file:
            return
        for name, condition in self._conditions.items():
            if condition == "plane":
                put_in_plane(self.r0, self.midsurface.edges[name])

    def _growing_placement(self) -> PlacementAmplitudes | None:
        """Return the placement with amplitudes of growing imperfections; None if none grows."""
        shapes = {
            name: self.midsurface.growth(self.V, deviations)
            for name, deviations in self.loads.growing_imperfections.items()
        }
        return PlacementAmplitudes(self.r0, shapes, self.material.h) if shapes else None

    def _thickness_field(
        self, thickness: Thickness | None, cells: CellGeometry
    ) -> fem.Function | None:
        """Return h(x)/h as a function (1,) on the mesh; None for 1.

        `cells` is the geometry in which a user field is projected onto polynomials.
        """
        if thickness is None:
            return None
        if thickness.user_field:
            polynomials = self._polynomials(thickness.user_field, cells)
            thickness = replace(thickness, polynomials=polynomials)
        return thickness_field(thickness, self.r0, self.midsurface.patches)

    def _make_factory(self, cells: CellGeometry) -> EnergyFactory:
        """Return the factory that makes the energies of this shell.

        `cells` is the geometry in which the natural shape is projected onto polynomials.
        """
        midsurface, loads = self.midsurface, self.loads
        free_constants: dict[str, fem.Constant] = {}  # the factory's energies add theirs
        natural_shape = self._natural_shape(cells, free_constants)
        # small angles between cells need only jumps of rotations
        is_folded = midsurface.kinked and largest_fold(self.r0, self.degree) > FOLD_ANGLE
        initial_placement = self.growing and self.growing.initial_placement
        domain = surface_domain(self.r0, initial_placement)
        creases = Creases.of_joints(self.loads.joints, midsurface) if loads.joints else None
        pressed_sides = side_field(loads.pressed_sides, midsurface) if loads.pressed_sides else None
        return EnergyFactory(
            domain,
            self.u,
            self.material,
            self.sigma,
            self.kernels,
            self.thickness,
            natural_shape,
            free_constants,
            has_folds=is_folded,
            pressed_sides=pressed_sides,
            creases=creases,
            cell_materials=self.cell_materials,
        )

    def _natural_shape(
        self, cells: CellGeometry, free_constants: dict[str, fem.Constant]
    ) -> Shape | None:
        """Return the natural shape, the one without stress; None if it is the undeformed one.

        Its amplitudes are added to `free_constants`, name -> constant. `self.loads` gets the shape
        cell by cell in place of patch by patch. `cells` is the geometry in which it is projected
        onto polynomials.
        """
        if not self.loads.natural:
            return None
        natural = self.loads.natural.on_cells(  # a user field gives polynomials in cells
            self.midsurface.patches,
            _cell_count(self.midsurface),
            lambda user_field: self._polynomials(user_field, cells),
        )
        self.loads = replace(self.loads, natural=natural)
        return Shape.from_field(natural_field(natural, cells, self.V), natural, free_constants)

    def _find_openings(self) -> tuple[Mapping[str, NDArray[np.int32]], bool]:
        """Find the edges where the pressed surface ends; collective.

        Sets `without_potential`, the names of edges at which a live pressure has no potential.

        Returns
        -------
        opening_edges
            Edge name -> its facets with a pressed cell.
        is_enclosed
            Whether moving supports close all openings with lids.
        """
        edges, pressed_cells = self.midsurface.edges, self.factory.pressed_sides
        # without `pressed_cells` all cells are pressed
        opening_edges = pressed_parts(edges, pressed_cells) if pressed_cells else edges
        # names of edges that move, and of those among them where a pressure has no potential
        free_edges, self.without_potential = edge_openings(self.r0, opening_edges, self._conditions)
        is_enclosed = enclosed(self.loads, free_edges, self.without_potential)
        self.without_potential += ends_within(pressed_cells)
        return opening_edges, is_enclosed

    def _volume_form(self, origin: NDArray[np.float64] | None, *, is_enclosed: bool) -> ufl.Form:
        """Return the form of Delta V/R^3 of the modelled part.

        `origin` (3,) over R lies on all its symmetry planes; None, where these have no common
        point, stands for zero. Under a live pressure, or if lids close the shell, the volume is the
        one that the surface sweeps; a pressure does work on it.
        """
        if self.loads.pressure or is_enclosed:
            return self.factory.swept_volume()
        return self.factory.volume_change(np.zeros(3) if origin is None else origin)

    def _field_and_pressure_terms(self) -> list[Term]:
        """Return the terms of magnetisation in an applied field and of a live pressure."""
        factory, loads, terms = self.factory, self.loads, list[Term]()
        if loads.magnetic:
            terms += [factory.term(energy) for energy in factory.magnetic(loads.magnetic)]
        if loads.pressure:
            energy = factory.pressure(loads.pressure_profile, potential=not self.without_potential)
            terms.append(factory.term(energy))
        return terms

    def _interaction_term(self) -> "InteractionTerm | None":
        """Return the term of magnetic interaction between parts of the shell; None without."""
        if not self.loads.interaction:
            return None
        # imported late: few shells have an interaction
        from magshell_fenicsx.parts.magnetism.interacting import InteractionTerm

        return InteractionTerm(self, self.u, self.loads.interaction)

    def _force_terms(self) -> list[Term]:
        """Return the terms of forces at points, then those of all dead loads; collective."""
        loads = self.loads
        terms: list[Term] = [self._force(name, force) for name, force in loads.forces.items()]
        if not loads.dead:
            return terms
        measures = SurfaceMeasures(self.r0, self.midsurface, self.degree)
        for name, dead in loads.dead.items():
            vectors = assemble_dead_loads(dead, self.V, measures, self.kernels)
            terms.append(self.dead_load_term(name, vectors))
            energies = self.factory.dead_energies(name, dead, self.midsurface.edges)
            terms += [self.factory.term(energy) for energy in energies]
        return terms

    @property
    def shell_cells(self) -> Mapping[str, NDArray[np.bool_]]:
        return {name: self.midsurface.patches[name] for name in self.midsurface.shells}

    def _make_shell_contacts(self) -> "Sequence[PairContact[Any]]":
        """Return the contacts between parts of the shell, as terms; empty without contact pairs."""
        if not self.loads.pairs:
            return ()
        # imported late: few shells have a contact
        from magshell_fenicsx.parts.contact.model_surface import ModelSurface, surface_contacts

        factory, edges = self.factory, self.midsurface.edges
        surface = ModelSurface(
            self.r0,
            self.u,
            self.midsurface.patches,
            self.material.h,
            factory.domain.contact_rule,
            self.thickness,
            factory.law_of_cells.thins,
            self.mirror.images if self._mirror_planes else (),
            [edges[name] for name in self._mirror_planes],
            factory.natural,
            self.planes,
        )
        return surface_contacts(self.loads.pairs, surface)

    def _t_junction_terms(self) -> Sequence[Term]:
        """Return the terms that tie edges to other shells on which they stand; collective."""
        if not (self.loads.joints or self.midsurface.t_junctions):
            return ()
        # imported late: few shells have junctions
        from magshell_fenicsx.shells.t_junctions import t_junction_terms

        return t_junction_terms(self)

    def _edge_pressure(
        self,
        opening_edges: Mapping[str, NDArray[np.int32]],
        origin: NDArray[np.float64] | None,
    ) -> EdgePressure:
        """Return the work of a live pressure on the lids at moving edges; collective.

        Lids end on edges in planes of symmetry, so these have curves too.

        Parameters
        ----------
        opening_edges
            Edge name -> its facets with a pressed cell.
        origin
            Point (3,) over R on all symmetry planes, or None.
        """
        pressed_cells, loads = self.factory.pressed_sides, self.loads
        in_planes = {
            name
            for name, condition in self._conditions.items()
            if condition in ("symmetry", "plane")
        }
        cell_sides = pressed_cells and sides_of_cells(pressed_cells)
        curves = {
            name: EdgeCurve.from_facets(self.V, facets, triangle_sides(), cell_sides)
            for name, facets in opening_edges.items()
            if name in in_planes or motions_of(loads, name)
        }
        # pressure at an amplitude of one: p_c over E h/R
        unit = self.material.classical_pressure / self.material.h
        return pressed_edges(self.r0, curves, in_planes, loads, unit, origin)

    def _make_system(
        self, terms: Sequence[Term], constraints: list[Constraint]
    ) -> FiniteElementSystem:
        """Return the system of all terms under constraints.

        Where terms have densities, their tangents and residuals are evaluated at quadrature points
        by compiled kernels; other terms are assembled as forms.
        """
        # tangent; for moving supports also cells with nodes that they move, and integrals on these
        moving_cells = None
        if self.moving:
            cells = self.moving.cells
            integrals = hessian_integrals(
                self.r0, self.degree, terms, self.kernels, cell_mask=cells
            )
            moving_cells = cells, integrals
        tangent = FastTangent(self.u, self._hessians, constraints, moving_cells)
        # residual and energies of the terms that have densities
        density_terms = [term for term in terms if isinstance(term, ShellTerm)]
        residual = self._point_residual(density_terms)
        residual.begin(energies=True)  # begins to compile its kernels
        for term in density_terms:
            # the form of a pressure on a growing shape measures from the initial placement
            if not (self.growing and term.amplitude == "pressure"):
                term.points = residual
        parameters = self._free_parameters(terms, density_terms, residual)
        return FiniteElementSystem(
            self.u,
            terms,
            constraints,
            self._pattern_term,
            self.material.h,
            tangent,
            residual,
            SystemVariables(parameters, self.moving, self.contact_history),
        )

    def _point_residual(
        self, terms: Sequence[PointTerm], *, one_by_one: bool = False
    ) -> FastResidual:
        """Return the residual that evaluates the densities of terms at quadrature points.

        `one_by_one` keeps the residual of each term apart, as derivatives by a parameter need it.
        """
        return FastResidual(
            self.r0, self.u, self.degree, terms, self.kernels, one_by_one=one_by_one
        )

    def _free_parameters(
        self, terms: Sequence[Term], density_terms: Sequence[ShellTerm], residual: FastResidual
    ) -> dict[str, FreeParameter]:
        """Return the parameters of energies that may vary, by name; collective.

        They are constants of densities, amplitudes of moving fields, of contacts and of growing
        imperfections. `terms` are all terms, `density_terms` those with a density, which `residual`
        evaluates.
        """
        factory = self.factory
        residuals_one_by_one = partial(self._point_residual, one_by_one=True)
        parameters: dict[str, FreeParameter] = {
            **point_parameters(factory.free_constants, density_terms, residuals_one_by_one)
        }
        parameters |= field_parameters(factory.fields, terms, self.u, self.kernels)
        # parameters that change a contact too, such as the thickness of a natural shape
        for contact in self.shell_contacts:
            parameters |= contact.growth_parameters(parameters)
        if self.growing:
            parameters |= self.growing.parameters(terms, parameters, residual)
        return parameters

    def _facets_on_mirror(self) -> NDArray[np.int32]:
        """Return the local facets (n,) of all edges with the condition "symmetry", sorted."""
        edges = self.midsurface.edges
        facets = [
            edges[name]
            for name, condition in self._conditions.items()
            if condition == "symmetry" and name in edges
        ]
        if not facets:
            return np.empty(0, np.int32)
        return np.unique(np.concatenate(facets)).astype(np.int32)

    def free_motion(self, amplitudes: Amplitudes) -> str:
        """Return a message that names a rigid motion left free; "" if there is none; collective.

        A half has motions that are antisymmetric to its plane too, as about a point that is held
        there: its own system does not see them.
        """
        message, modes = super().free_motion(amplitudes), self.symmetry_breaking_modes
        if message or not isinstance(modes, AntisymmetricModes):
            return message
        return free_motion(modes.system, self.r0, amplitudes)

    @cached_property
    def symmetry_breaking_modes(self) -> AntisymmetricModes | SectorModes | None:
        """Modes that break the symmetry of a half model or a sector; None for a whole shell.

        Modes of a half are antisymmetric displacements, with another tangent on the mirror plane
        and other constraints there. Modes of a sector are counted on the half that its copies make.
        The first access compiles kernels and is collective.
        """
        if self.multiplicity == 1:
            return None
        if isinstance(self.mirror, Sector):
            return SectorModes(self, self._as_half)
        # term of the edges on the mirror plane, in place of that of symmetric displacements
        edges = self.factory.antisymmetric_edges(self._mirrored_facets, self.mirror.normal)
        # antisymmetric displacements are normal to the mirror plane on it
        constraints = self._constraints + [
            support_along(self.V, 1, self._mirrored_facets, direction)
            for direction in self.mirror.in_plane_vectors
        ]
        integrals = self._hessians + hessian_integrals(self.r0, self.degree, [edges], self.kernels)
        fast_tangent = FastTangent(self.u, integrals, constraints)
        # terms with the tangents of antisymmetric displacements
        terms = [edges if t is self._mirror_term else t for t in self.system.terms]
        terms = [t.antisymmetric() if hasattr(t, "antisymmetric") else t for t in terms]
        system = self.system
        return AntisymmetricModes(
            FiniteElementSystem(
                self.u,
                terms,
                constraints,
                self._pattern_term,
                system.length,
                fast_tangent,
                system.gradients,
                SystemVariables(system.parameters, self.moving, system.history),
            )
        )

    def _as_half(self, midsurface: Midsurface) -> "ShellModel":
        """Return the model of half of the shell of which this model is a sector; collective.

        `midsurface` is the half's mesh and placement.
        """
        material, degree, conditions, loads, sigma, thickness = self._arguments
        # a half has one mirror plane
        conditions = {name: c for name, c in conditions.items() if name != SECOND_SYMMETRY_EDGE}
        plane = Mirror.through_axis(self.mirror.azimuth)
        return ShellModel(midsurface, material, degree, conditions, loads, sigma, thickness, plane)

    @property
    def mirrored_facets(self) -> NDArray[np.int32]:
        """Local facets on the mirror planes of a half model or a sector; else empty."""
        return self._mirrored_facets

    def growth(self, deviations: Sequence[Deviation]) -> fem.Function:
        """Return the change of the placement, over R, by further deviations from the surface."""
        return self.midsurface.growth(self.V, deviations)

    def at_nodes(self, function: Embedding) -> NDArray[np.float64]:
        """Return the values (cells, nodes, ...) of a function at the nodes of each cell.

        The function takes places in the coordinates of the triangulation's nodes, as an embedding
        does.
        """
        return self.midsurface.evaluate(self.V.element.basix_element.points, function)

    def chart(self) -> NDArray[np.float64]:
        """Return coordinates (n, 2) of this rank's nodes in the chart.

        The surface of a mesh file has no chart: positions (n, 3) take its place.
        """
        return self._at_nodes(self.midsurface.chart_coordinates(self.V))

    def chart_by_shell(self) -> NDArray[np.float64]:
        """Return coordinates (n, 2) of this rank's nodes, each in the chart of its own shell.

        Positions (n, 3) take their place on the surface of a mesh file, which has no chart.
        """
        return self._at_nodes(self.midsurface.chart_coordinates_by_shell(self.V))

    def _at_nodes(self, cells: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return coordinates (n, d) of this rank's own nodes from those (cells, nodes, d) in cells.

        A node on a seam of the chart has two positions there: it gets the smaller coordinates.
        """
        nodes, index_map = self.V.dofmap.list, self.V.dofmap.index_map
        coordinates = np.full((index_map.size_local + index_map.num_ghosts, cells.shape[2]), np.inf)
        np.minimum.at(coordinates, nodes, cells)
        return coordinates[: index_map.size_local]

    def _force(self, name: str, force: Force) -> LinearTerm:
        """Return the term of a force along the inward normal; collective.

        It acts at a vertex, or over a patch of radius `force.patch` around it. `name` is that of
        its amplitude.
        """
        x, inward = self.midsurface.points[force.point], -self.normals[force.point]
        cells_at_point = self.midsurface.cells_of_point(force.point)
        # degrees of freedom, and the shares of a unit force on them
        if force.patch:
            dofs, values = patch_entries(
                self.r0, x, force.patch, inward, self.degree, self.kernels, cells_at_point
            )
        else:
            dofs, values = point_entries(self.V, x, inward, cells_at_point)
        return LinearTerm(name, dofs, self.force_unit * values, self.u, name)


def _cell_count(midsurface: Midsurface) -> int:
    """Return the number of cells of this rank, ghosts included."""
    index_map = midsurface.mesh.topology.index_map(2)
    return int(index_map.size_local + index_map.num_ghosts)


def _magnetisation_by_cell(loads: Loads, midsurface: Midsurface) -> Loads:
    """Return the loads with magnetisations given cell by cell in place of patch by patch.

    `loads.magnetic` is the magnetisation in an applied field, `loads.remanence` that without one.
    """
    for name in ("magnetic", "remanence"):
        if magnetisation := getattr(loads, name):
            in_cells = magnetisation.on_cells(midsurface.patches, _cell_count(midsurface))
            loads = replace(loads, **{name: in_cells})
    return loads
