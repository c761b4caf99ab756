"""The shell as a system of terms: only those that its loads and edges call for.

Lengths in R, energies in E h R^2. Amplitudes: "pressure" is p/p_c, "force" is
F R/(2 pi D), "lambda_m" is lambda_m.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem, SystemVariables
from magshell_fenicsx.assembly.free_parameters import FreeParameter, PlacementAmplitudes
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.oblique_supports import Constraint, support_along
from magshell_fenicsx.assembly.prescribed_motion import EdgeCurve, triangle_sides
from magshell_fenicsx.assembly.terms import LinearTerm, Term
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.mirror import (
    SECOND_SYMMETRY_EDGE,
    SYMMETRY_EDGE,
    Y0_PLANE,
    Mirror,
    Sector,
)
from magshell_fenicsx.mesh.patch import Deviation, Embedding, MeshError
from magshell_fenicsx.models.domains import surface_domain
from magshell_fenicsx.models.shell.antisymmetric import AntisymmetricModes
from magshell_fenicsx.models.shell.edges import FOLD_ANGLE, largest_fold
from magshell_fenicsx.models.shell.energy import ShellTerm
from magshell_fenicsx.models.shell.fast_tangent import FastTangent, hessian_integrals
from magshell_fenicsx.models.shell.gradients import PointTerm
from magshell_fenicsx.models.shell.parameters import (
    Condition,
    Force,
    HeldComponents,
    Material,
    default_penalty,
)
from magshell_fenicsx.models.shell.spatial_fields import (
    user_field_polynomials,
    cell_geometry,
    formula_field,
    positions_and_normals,
)
from magshell_fenicsx.models.shell.residual import FastResidual, point_parameters
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
from magshell_fenicsx.parts.pressure.openings import beside, on_cells, on_each, openings
from magshell_fenicsx.parts.supports.support_motion import (
    Support,
    SupportKind,
    enclosed,
    motions_of,
    moving,
    pressed_edges,
    rotation_of,
)
from magshell_fenicsx.parts.supports.supports import (
    closing_point,
    held_at_vertex,
    held_on,
    plane_of,
    put_in_plane,
    refuse_unknown,
)
from magshell_fenicsx.shells.model_base import ThinModel
from magshell_fenicsx.shells.energy_factory import EnergyFactory
from magshell_fenicsx.shells.sector_modes import SectorModes

if TYPE_CHECKING:
    from magshell_fenicsx.parts.contact.surface_contact import SurfaceContact


class ShellModel(ThinModel):
    """A Koiter shell on a mid-surface.

    Parameters
    ----------
    midsurface
        Mesh and placement.
    degree
        Of displacement and placement, 2 to 5.
    conditions
        Edge name -> condition; edges that are not named are free. A vertex can be held too, and a
        patch clamped or held: then all of it.
    sigma
        Penalty of the C0 interior penalty form; None takes `default_penalty`.
    thickness
        What multiplies the thickness; None for 1.
    mirror
        The plane of the edge with the condition "symmetry", of a half model; both of a sector.

    Raises
    ------
    MeshError
        On every rank, if the surface has no such edge, point or patch, or an edge lies in no plane
        of symmetry.

    Attributes
    ----------
    system, multiplicity, normals, loads, load_size, supports
        See `ModelBase`.
    kernels
        Names and compile time of the forms in use.
    thickness
        h(x)/h, free to jump from cell to cell; None for 1.
    made_of
        Of each cell the `parameters.OwnMaterial` of its shell; None where all shells have one.
    mirror
        Of a half model or a sector.
    turns
        Whether what it is made of, and all that loads it, is axisymmetric; whoever makes the model
        may set it.
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
        self._given = material, degree, conditions, loads, sigma, thickness
        refuse_unknown(midsurface.edges, midsurface.points, midsurface.patches, conditions, loads)
        for name in ("magnetic", "remanence"):
            if field := getattr(loads, name):
                topology = midsurface.mesh.topology.index_map(2)
                cells = topology.size_local + topology.num_ghosts
                loads = replace(loads, **{name: field.on(midsurface.patches, cells)})
        self.midsurface, self.material, self.degree = midsurface, material, degree
        self.load_size, self.load_sizes = {}, {}
        sides = {
            name: plane
            for name, plane in mirror.planes.items()
            if conditions.get(name) == "symmetry"
        }
        self.multiplicity = mirror.copies if sides else 1
        self.kernels = KernelLog()
        self.V = V = fem.functionspace(midsurface.mesh, ("Lagrange", degree, (3,)))
        self.r0, self.u = midsurface.placement(V), fem.Function(V, name="u")
        in_cells = cell_geometry(self.r0)
        for name, laminate in material.every_laminate.items():
            cells = midsurface.patches[name] if name else slice(None)
            laminate.refuse_normal(positions_and_normals(self.r0)[1][cells], midsurface.mesh.comm)
        for name in ("magnetic", "remanence"):
            if (field := getattr(loads, name)) and field.given:
                vectors = user_field_polynomials(field.given, midsurface, in_cells)
                loads = replace(loads, **{name: replace(field, remanent=vectors)})
        of_place = partial(formula_field, self.r0)
        loads = self.loads = replace(
            loads,
            own=tuple(term.with_functions(of_place, midsurface.function) for term in loads.own),
        )
        if thickness and thickness.given:
            thickness = replace(
                thickness, carried=user_field_polynomials(thickness.given, midsurface, in_cells)
            )
        self.sigma = default_penalty(degree) if sigma is None else sigma
        for name in [
            name for name, c in conditions.items() if c == "plane" and not midsurface.from_mesh_file
        ]:
            put_in_plane(self.r0, midsurface.edges[name])
        shapes = {
            name: midsurface.growth(V, deviations) for name, deviations in loads.growing.items()
        }
        self.growing = PlacementAmplitudes(self.r0, shapes, material.h) if shapes else None
        self.thickness = factor = (
            thickness_field(thickness, self.r0, midsurface.patches) if thickness else None
        )
        self.made_of = None
        if material.shells:
            self.made_of = material_field(material.shells, midsurface.mesh, midsurface.patches)
        free, shape = dict[str, fem.Constant](), None
        if loads.natural:
            cells = midsurface.mesh.topology.index_map(2)
            count = cells.size_local + cells.num_ghosts
            grown = loads.natural.on(
                midsurface.patches,
                count,
                lambda given: user_field_polynomials(given, midsurface, in_cells),
            )
            loads = self.loads = replace(loads, natural=grown)
            shape = Shape.of(natural_field(grown, in_cells, self.V), grown, free)
        folded = midsurface.kinked and largest_fold(self.r0, degree) > FOLD_ANGLE
        carrier = surface_domain(self.r0, self.growing and self.growing.initial_placement)
        of_shell = material, self.sigma, self.kernels, factor, shape, free, folded
        creases = Creases.of(loads.joints, midsurface) if loads.joints else None
        pressed = on_cells(loads.pressed, midsurface) if loads.pressed else None
        self.factory = factory = EnergyFactory(
            carrier, self.u, *of_shell, pressed=pressed, creases=creases, made_of=self.made_of
        )
        interior = factory.term(factory.interior_edges())
        terms: list[Term] = [
            factory.term(factory.membrane()),
            factory.term(factory.bending()),
            interior,
        ]
        held: list[Constraint] = []
        mirrored: list[Constraint] = []
        planes: list[Mirror] = []

        def facets(condition: Condition) -> NDArray[np.int32]:
            held_unknowns = [
                midsurface.edges[name]
                for name, c in conditions.items()
                if c == condition and name in midsurface.edges
            ]
            return (
                np.unique(np.concatenate(held_unknowns)).astype(np.int32)
                if held_unknowns
                else np.empty(0, np.int32)
            )

        for name, side in sides.items():
            planes.append(side)
            where = midsurface.edges[name]
            edge = "mirror edges" if name == SYMMETRY_EDGE else f"{name} mirror edges"
            self._mirror_term = factory.term(factory.mirror_edges(where, side.normal, edge))
            terms.append(self._mirror_term)
            mirrored.append(support_along(V, 1, where, side.normal))
        clamped = [
            name for name, c in conditions.items() if c == "clamped" and name in midsurface.edges
        ]
        self.supports: dict[str, Support] = {}
        on_planes: dict[str, Support] = {}
        for name, condition in conditions.items():
            components = (
                condition.components if isinstance(condition, HeldComponents) else (0, 1, 2)
            )
            if condition in ("free", "symmetry"):
                continue
            if condition == "plane":
                planes.append(plane := plane_of(self.r0, midsurface.edges[name], name))
                plies = (
                    each
                    for of, each in material.every_laminate.items()
                    if not of or name.startswith(f"{of}_")
                )
                if not all(laminate.mirrored(plane) for laminate in plies):
                    raise MeshError(
                        f"boundary: {name}: its plane does not mirror the plies, which are neither along nor across it"
                    )
                mirrored_edges = factory.mirror_edges(
                    midsurface.edges[name], plane.normal, f"{name} mirror edges"
                )
                terms.append(factory.term(mirrored_edges))
                held.append(support_along(V, 1, midsurface.edges[name], plane.normal))
                on_edge = held_on(V, 1, midsurface.edges[name], components)
                on_planes[name] = Support.of(on_edge, f"{name} mirror edges", kind="plane")
                continue
            edge, turn = "", None
            if name in clamped:
                edge, turn = (
                    f"{name} clamped edges" if len(clamped) > 1 else "clamped edges",
                    rotation_of(loads, name, V),
                )
                terms.append(
                    factory.term(factory.clamped_edges(edge, midsurface.edges[name], turn))
                )
            if name in midsurface.edges:
                conditions_of_part = held_on(V, 1, midsurface.edges[name], components)
            elif name in midsurface.patches:
                conditions_of_part = held_on(
                    V, 2, np.flatnonzero(midsurface.patches[name]).astype(np.int32), components
                )
            else:
                conditions_of_part = held_at_vertex(
                    V, midsurface.points[name], components, midsurface.cells_of_point(name)
                )
            held += conditions_of_part
            kind: SupportKind = "point" if name in midsurface.points else "part"
            self.supports[name] = Support.of(conditions_of_part, edge, turn, kind=kind)
        self.supports |= on_planes
        self.planes = tuple(planes)
        closing = closing_point(planes)
        open_at = beside(midsurface.edges, pressed) if pressed else midsurface.edges
        free_edges, self.without_potential = openings(self.r0, open_at, conditions)
        closed = enclosed(loads, free_edges, self.without_potential)
        swept = loads.pressure or closed
        volume = (
            factory.swept_volume()
            if swept
            else factory.volume_change(np.zeros(3) if closing is None else closing)
        )
        if loads.magnetic:
            terms += [factory.term(energy) for energy in factory.magnetic(loads.magnetic)]
        if loads.pressure:
            terms.append(factory.term(factory.pressure(potential=not self.without_potential)))
        if loads.interaction:
            from magshell_fenicsx.parts.magnetism.interacting import (
                InteractionTerm,
            )  # few shells have one

            terms.append(interacting := InteractionTerm(self, self.u, loads.interaction))
        terms += [factory.term(energy) for energy in self.own_and_contacts(midsurface.edges)]
        self.normals = {
            name: vertex_normal(self.r0, x, midsurface.cells_of_point(name))
            for name, x in midsurface.points.items()
        }
        terms += [self._force(name, force) for name, force in loads.forces.items()]
        on = SurfaceMeasures(self.r0, midsurface, degree) if loads.dead else None
        for name, dead in loads.dead.items():
            assert on
            terms.append(self.load_with(name, assemble_dead_loads(dead, V, on, self.kernels)))
            terms += [
                factory.term(energy)
                for energy in factory.dead_energies(name, dead, midsurface.edges)
            ]
        meeting: Sequence[SurfaceContact] = ()
        if loads.pairs:
            from magshell_fenicsx.parts.contact.model_surface import shell_contacts

            of_images = mirror.images if sides else (), [midsurface.edges[name] for name in sides]
            thick = carrier.contact_rule, factor, factory.law_of_cells.thins
            surfaces = self.r0, self.u, midsurface.patches
            meeting = shell_contacts(
                loads.pairs, *surfaces, material.h, *thick, *of_images, shape, self.planes
            )
            terms += meeting
        self.shell_contacts = meeting
        if loads.joints or midsurface.t_junctions:
            from magshell_fenicsx.shells.t_junctions import t_junction_terms

            terms += t_junction_terms(self)
        self._sites = hessian_integrals(self.r0, degree, terms, self.kernels, factory.prestress())
        at_edges = None
        if closed:
            in_planes = {name for name, c in conditions.items() if c in ("symmetry", "plane")}
            curves = {
                name: EdgeCurve.from_facets(V, side, triangle_sides(), pressed and on_each(pressed))
                for name, side in open_at.items()
                if name in in_planes or motions_of(loads, name)
            }
            unit = material.classical_pressure / material.h
            at_edges = pressed_edges(self.r0, curves, in_planes, loads, unit, closing)
        self.moving = moving(self.r0, self.supports, loads, at_edges)
        near = None
        if self.moving:
            near = (
                self.moving.cells,
                hessian_integrals(self.r0, degree, terms, self.kernels, chosen=self.moving.cells),
            )
        fast = FastTangent(self.u, self._sites, held + mirrored, near)
        dense = [term for term in terms if isinstance(term, ShellTerm)]

        def serve(terms: Sequence[PointTerm], *, apart: bool = False) -> FastResidual:
            return FastResidual(self.r0, self.u, degree, terms, self.kernels, apart=apart)

        gradients = serve(dense)
        gradients.begin(energies=True)
        for term in dense:
            if not (
                self.growing and term.amplitude == "pressure"
            ):  # whose form measures from the drawn placement
                term.points = gradients
        parameters: dict[str, FreeParameter] = {
            **point_parameters(factory.free, dense, lambda slopes: serve(slopes, apart=True))
        }
        parameters |= field_parameters(factory.fields, terms, self.u, self.kernels)
        for each in meeting:
            parameters |= each.entered(parameters)
        self.fields = factory.fields
        if self.growing:
            parameters |= self.growing.parameters(terms, parameters, gradients)
        stiffnesses = dict(pressing.history for pressing, _ in self.contacts.values())
        for each in meeting:
            stiffnesses |= each.history
        self.system = FiniteElementSystem(
            self.u,
            terms,
            held + mirrored,
            interior,
            material.h,
            fast,
            gradients,
            SystemVariables(parameters, self.moving, stiffnesses),
        )
        self._interior, self._held, self.mirror = interior, held, mirror
        self._on_mirror = facets("symmetry")
        self.observe(
            self.kernels.compile("volume energy", volume),
            midsurface.points,
            midsurface.cells_of_point,
        )
        if loads.interaction:
            interacting.refuse_near()  # now that all is there which it reads

    @cached_property
    def excluded_modes(self) -> AntisymmetricModes | SectorModes | None:
        """The modes that a half model or a sector does not see; None for a whole one.

        Compiles kernels.
        """
        if self.multiplicity == 1:
            return None
        if isinstance(self.mirror, Sector):
            return SectorModes(self, self._as_half)
        edges = self.factory.antisymmetric_edges(self._on_mirror, self.mirror.normal)
        held = self._held + [
            support_along(self.V, 1, self._on_mirror, along)
            for along in self.mirror.in_plane_vectors
        ]
        sites = self._sites + hessian_integrals(self.r0, self.degree, [edges], self.kernels)
        fast = FastTangent(self.u, sites, held)
        terms = [edges if t is self._mirror_term else t for t in self.system.terms]
        terms = [t.antisymmetric() if hasattr(t, "antisymmetric") else t for t in terms]
        system = self.system
        return AntisymmetricModes(
            FiniteElementSystem(
                self.u,
                terms,
                held,
                self._interior,
                system.length,
                fast,
                system.gradients,
                SystemVariables(system.parameters, self.moving, system.history),
            )
        )

    def _as_half(self, midsurface: Midsurface) -> "ShellModel":
        """The same shell on the mid-surface of a half."""
        material, degree, conditions, loads, sigma, thickness = self._given
        conditions = {name: c for name, c in conditions.items() if name != SECOND_SYMMETRY_EDGE}
        plane = Mirror.through_axis(self.mirror.azimuth)
        return ShellModel(midsurface, material, degree, conditions, loads, sigma, thickness, plane)

    @property
    def mirrored_facets(self) -> NDArray[np.int32]:
        return self._on_mirror

    def growth(self, deviations: Sequence[Deviation]) -> fem.Function:
        """What further deviations add to the placement."""
        return self.midsurface.growth(self.V, deviations)

    def at_nodes(self, of: Embedding) -> NDArray[np.float64]:
        """What a function of the triangulation's nodes is at the nodes of each cell, (cells, nodes,
        ...).
        """
        return self.midsurface.evaluate(self.V.element.basix_element.points, of)

    def chart(self) -> NDArray[np.float64]:
        """Coordinates (n, 2) of this rank's nodes in the chart, of a mesh file positions (n, 3)."""
        return self._at_nodes(self.midsurface.chart_coordinates(self.V))

    def chart_by_shell(self) -> NDArray[np.float64]:
        """The same, of several shells that have charts in that of each node's shell."""
        return self._at_nodes(self.midsurface.chart_coordinates_by_shell(self.V))

    def _at_nodes(self, cells: NDArray[np.float64]) -> NDArray[np.float64]:
        nodes, index_map = self.V.dofmap.list, self.V.dofmap.index_map
        coordinates = np.full((index_map.size_local + index_map.num_ghosts, cells.shape[2]), np.inf)
        np.minimum.at(
            coordinates, nodes, cells
        )  # the first of the two positions of a node on a seam
        return coordinates[: index_map.size_local]

    def _force(self, name: str, force: Force) -> LinearTerm:
        x, inward = self.midsurface.points[force.point], -self.normals[force.point]
        beside = self.midsurface.cells_of_point(force.point)
        if force.patch:
            entries = patch_entries(
                self.r0, x, force.patch, inward, self.degree, self.kernels, beside
            )
        else:
            entries = point_entries(self.V, x, inward, beside)
        return LinearTerm(name, entries[0], self.force_unit * entries[1], self.u, name)
