"""The body of a shell as a three-dimensional solid: a system of terms, with the interface of
`ShellModel`.

Lengths in R, energies in E h R^2, amplitudes (load parameters, by name) as in `ShellModel`.
Displacements that are reported are those of nodes in the middle of the thickness; the pressure, the
volume and the loaded patch are of the outer face.

A body has an outer face, and an end above each edge of its mid-surface: a face through the
thickness. Heights go from 0 inside to 1 outside. A condition is an end's support: "clamped" holds
the face, "symmetry" (of a half model) and "plane" (of the shell itself) put it in a mirror plane;
any other but "free" holds the middle line alone, and the end is hinged. A lid closes a moving end
under a live pressure. The natural shape is the one without stress. Layers are fractions of the
thickness with a remanence each.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Literal

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem, SystemVariables
from magshell_fenicsx.assembly.free_parameters import FreeParameter, make_parameters
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.oblique_supports import Constraint, support_along
from magshell_fenicsx.assembly.prescribed_motion import EdgeCurve, EdgePressure, level_sides
from magshell_fenicsx.assembly.terms import LinearTerm, Term
from magshell_fenicsx.mesh.hexahedra import MIDSURFACE_HEIGHT, OUTER_FACE, BodyMesh, quadratic_space
from magshell_fenicsx.mesh.mirror import Y0_PLANE, Mirror
from magshell_fenicsx.models.shell.antisymmetric import AntisymmetricModes
from magshell_fenicsx.models.shell.fast_tangent import FastTangent
from magshell_fenicsx.models.shell.formula_projection import CellGeometry
from magshell_fenicsx.models.shell.own_term import FormulaParameter
from magshell_fenicsx.models.shell.parameters import Condition, Material
from magshell_fenicsx.models.shell.spatial_fields import (
    ByPatch,
    Components,
    body_cell_geometry,
    body_positions_and_normals,
    field_in_body,
)
from magshell_fenicsx.models.solid.body_densities import CompressibleRubber
from magshell_fenicsx.parts.forces.load_vectors import assemble_dead_loads
from magshell_fenicsx.parts.forces.on_body import BodyMeasures, outer_patch
from magshell_fenicsx.parts.loads import Loads, moments, potentials
from magshell_fenicsx.parts.magnetism.applied import field_parameters
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.natural.shape import Shape, body_shape, growth_in_body
from magshell_fenicsx.parts.pressure.openings import edge_openings
from magshell_fenicsx.parts.supports.support_motion import (
    enclosed,
    motions_of,
    moving,
    pressed_edges,
)
from magshell_fenicsx.parts.supports.supports import ROUNDING, closing_point, in_middle, supports
from magshell_fenicsx.shells.model_base import ModelBase
from magshell_fenicsx.shells.solid_hessians import body_hessian_integrals
from magshell_fenicsx.shells.solid_terms import SolidDensity, TermFactory, unchanged

Array = NDArray[np.float64]
MIRRORS = ("symmetry", "plane")  # conditions on mirror planes


class SolidModel(ModelBase):
    """A rubbery, hard-magnetic body around a mid-surface.

    Parameters
    ----------
    body
        Mesh of the body with its named faces.
    law
        Elastic law of the solid.
    conditions
        Conditions as in `ShellModel`: a whole face is clamped or in a mirror plane, else its middle
        line is held.
    loads
        A force has a patch, on the outer face; the magnetic energy is the full one.
    mirror
        The plane of the faces with the condition "symmetry", of a half model.

    Raises
    ------
    MeshError
        On every rank, if an edge lies in no plane of symmetry, or if a patch is not there or
        unknown to the mesh.

    Attributes
    ----------
    system
        The equations that solvers take.
    multiplicity
        Number of modelled parts that make the body: 2 for a half, else 1.
    normals
        n0 (3,) at the named points.
    kernels
        Names and compile time of the forms in use.
    supports
        Name of an edge -> its support.
    V, r0, u
        Space of the displacement; undeformed places and displacement over R.
    factory
        Factory of the terms.
    fields
        Applied fields that are known by their values.
    observed
        Column -> form over the modelled part, of what the user's terms observe and of the
        polarisation that a field induces.
    degree
        Degree of the displacement: 2.
    sigma
        None: nothing is penalised.
    without_potential
        Ends at which a live pressure has no potential.
    _conditions
        The parameter `conditions`.
    _terms, _pattern
        All terms of the system, and the one whose form gives the sparsity pattern.
    _held
        Constraints by the conditions, without those on the plane of `mirror`.
    _faces
        Facets of each face on the plane of `mirror`.
    _hessians
        Integrals of the terms' Hessians.
    _moving
        The motion of the supports; None if none moves.
    """

    thin: Literal[False] = False
    axisymmetric: Literal[False] = False
    cell_materials: None = None  # a solid has one material
    degree = 2
    sigma = None

    def __init__(
        self,
        body: BodyMesh,
        material: Material,
        law: CompressibleRubber,
        conditions: Mapping[str, Condition],
        loads: Loads,
        mirror: Mirror = Y0_PLANE,
    ) -> None:
        """Make the terms of the body and its system; parameters are those of the class."""
        # magnetisations by cell; None where there is none
        magnetic, remanence = (
            field and _in_cells(field, body) for field in (loads.magnetic, loads.remanence)
        )
        loads = replace(loads, magnetic=magnetic, remanence=remanence)
        self.body, self.material, self.law = body, material, law
        self.mirror, self._conditions = mirror, conditions
        self.normals = body.normals
        self.multiplicity = 2 if "symmetry" in conditions.values() else 1
        self.load_size, self.load_sizes, self.contacts = {}, {}, {}
        self.kernels = KernelLog()
        self.V = quadratic_space(body.mesh)
        self.u, self.r0 = fem.Function(self.V, name="u"), fem.Function(self.V, name="r0")
        self.r0.interpolate(lambda x: x)
        user_terms = tuple(term.with_functions(self._formula_field) for term in loads.user_terms)
        self.loads = replace(loads, user_terms=user_terms)
        self.factory = factory = self._make_factory()
        # the first term is everywhere: its form gives the sparsity pattern
        self._pattern = factory.distortion()
        # supports, and the planes of the body's own symmetry; a point on all planes, or None
        self._held, planes, self.supports = supports(body, self.r0, conditions)
        origin = closing_point([mirror, *planes] if self.multiplicity == 2 else planes)
        # ends that move, those of them without potential, and whether lids close all
        ends = {name: facets for name, facets in body.faces.items() if name != OUTER_FACE}
        free_ends, self.without_potential = edge_openings(
            self.r0, ends, conditions, in_middle(body, self.V)
        )
        is_enclosed = enclosed(self.loads, free_ends, self.without_potential)
        self._terms: list[Term] = [self._pattern, factory.compression()]
        self._terms += self._field_and_pressure_terms()
        self._terms += [factory.user_term(term) for term in self.loads.user_terms if term.density]
        self.observed = self._observed_forms()
        self._terms += self._force_terms()
        self._faces = [
            body.faces[name] for name, condition in conditions.items() if condition == "symmetry"
        ]
        self._hessians = body_hessian_integrals(body, self.r0, self._terms, self.kernels)
        edge_pressure = self._edge_pressure(ends, origin) if is_enclosed else None
        self._moving = moving(self.r0, self.supports, self.loads, edge_pressure)
        self.system = self._system(self._held + self._held_on_mirror([mirror.normal]))
        # Under a pressure it is the volume that points sweep, for which the origin is None. Else it
        # is the volume between the outer face and the origin.
        if self.loads.pressure or is_enclosed:
            origin = None
        elif origin is None:
            origin = np.zeros(3)
        volume = factory.volume_change(origin)
        self.observe(self.kernels.compile("volume energy", volume), body.points)

    def _formula_field(self, parameter: FormulaParameter) -> fem.Function:
        """Return a formula of the undeformed place as a field (1,) in the body."""
        pattern = Components([parameter.of_place])
        return field_in_body(pattern, self.V, name="factor", key=parameter.key, size=1)

    @property
    def _hinged(self) -> tuple[str, ...]:
        """Names of the ends whose middle line alone is held."""
        return tuple(
            name
            for name, condition in self._conditions.items()
            if name in self.body.faces and condition not in ("free", "clamped", *MIRRORS)
        )

    def _make_factory(self) -> TermFactory:
        """Return the factory of the terms of this body."""
        free_constants: dict[str, fem.Constant] = {}
        grown: Callable[[SolidDensity], SolidDensity] = unchanged
        if self.loads.natural:
            shape = body_shape(self.loads.natural, self.body, self.V, free_constants)
            grown = partial(grown_in_body, shape=shape)
        return TermFactory(
            self.body,
            self.u,
            self.law,
            self.material.h,
            self.kernels,
            self._hinged,
            grown,
            free_constants,
        )

    def _field_and_pressure_terms(self) -> list[Term]:
        """Return the terms of magnetisation in an applied field and of a live pressure."""
        terms: list[Term] = []
        if self.loads.magnetic:
            terms += self.factory.magnetic(self.loads.magnetic)
        if self.loads.pressure:
            classical, potential = self.material.classical_pressure, not self.without_potential
            terms += self.factory.pressure(classical, potential=potential)
        return terms

    def _observed_forms(self) -> dict[str, fem.Form]:
        """Return the compiled forms of observed integrals, by name.

        They are those of the user's terms, and of the polarisation that a field induces.
        """
        factory, kernels = self.factory, self.kernels
        observed = kernels.compile_all(factory.observed(term) for term in self.loads.user_terms)
        if self.loads.magnetic:
            observed |= kernels.compile_all([factory.induced(self.loads.magnetic)])
        return observed

    def _force_terms(self) -> list[Term]:
        """Return the terms of forces on patches, then those of all dead loads; collective."""
        terms: list[Term] = []
        for name, force in self.loads.forces.items():
            # degrees of freedom around the point, and the shares of a unit force
            dofs, shares = outer_patch(self.body, self.V, force.point, force.patch, self.kernels)
            terms.append(LinearTerm(name, dofs, self.force_unit * shares, self.u, name))
        if not self.loads.dead:
            return terms
        measures = BodyMeasures(self.body, self.V, self.kernels)
        for name, dead in self.loads.dead.items():
            vectors = assemble_dead_loads(dead, self.V, measures, self.kernels)
            terms.append(self.dead_load_term(name, vectors))
            terms += [
                self.factory.moment(f"{name} moment {m.edge} {i}", m.edge, m.moment, name)
                for i, m in enumerate(moments(dead))
            ]
            terms += [self.factory.user_term(term, name) for term in potentials(dead)]
        return terms

    def _edge_pressure(
        self, ends: Mapping[str, NDArray[np.int32]], origin: Array | None
    ) -> EdgePressure:
        """Return the work of a live pressure on lids at the ends that move.

        Parameters
        ----------
        ends
            Name of an end -> its facets.
        origin
            Point (3,) over R on all symmetry planes, or None.
        """
        # the pressed surface ends at the middle line of a hinged end, else at the outer face
        hinged = self._hinged
        in_planes = {name for name, condition in self._conditions.items() if condition in MIRRORS}
        curves = {
            name: self._rim(ends[name], MIDSURFACE_HEIGHT if name in hinged else 1.0)
            for name in ends
            if name in in_planes or motions_of(self.loads, name)
        }
        # pressure at an amplitude of one: p_c over E h/R
        unit = self.material.classical_pressure / self.material.h
        return pressed_edges(self.r0, curves, in_planes, self.loads, unit, origin)

    @cached_property
    def symmetry_breaking_modes(self) -> AntisymmetricModes | None:
        """Modes that a half model cannot have; None for a whole shell.

        They move freely across the mirror plane and not within it.
        """
        if self.multiplicity == 1:
            return None
        return AntisymmetricModes(
            self._system(self._held + self._held_on_mirror(self.mirror.in_plane_vectors))
        )

    def over_area(self) -> Callable[[Expr], ufl.Form]:
        """Return the function that integrates an expression over the body's undeformed volume."""
        return lambda f: f * ufl.dx(domain=self.V.mesh)

    def cells_of_fields(self) -> CellGeometry:
        """Return the geometry of the cells in which formulas give fields."""
        return body_cell_geometry(self.V)

    def places(self, nodes: Array) -> tuple[Array, Array]:
        """Return the nodes (cells, n, 3) of every cell, and normals of the surface at their height.

        `nodes` is not used here; it belongs to the interface of `ThinModel`.
        """
        return body_positions_and_normals(self.V)

    def chart(self) -> Array:
        """Return coordinates (n, 3) of this rank's nodes: the chart's, then the height.

        The height runs through the thickness from 0 inside to 1 outside.
        """
        coordinates = self.body.at_nodes(
            self.V, np.column_stack([self.body.chart, self.body.heights])
        )
        return np.asarray(coordinates[: self.V.dofmap.index_map.size_local])

    def _rim(self, facets: NDArray[np.int32], height: float) -> EdgeCurve:
        """Return the curve at which the pressed surface ends, on the facets of one end.

        `height` is the place of the curve in the thickness: 1 is the outer face. All cells that the
        curve passes have it at the same fraction of their own thickness.
        """
        cells_of_facets = self.body.mesh.topology.connectivity(2, 3)
        cells = cells_of_facets.array[cells_of_facets.offsets[facets]]  # behind each facet
        # bounds of these cells in the thickness
        low, high = self.body.layer_bounds[cells].T
        has_height = (low < height - ROUNDING) & (height < high + ROUNDING)
        fraction_of_cell = (height - low[has_height]) / (high - low)[has_height]
        return EdgeCurve.from_facets(
            self.V,
            facets[has_height],
            # the fraction of all; a rank may have no such cell, and then any fraction will do
            level_sides(float(fraction_of_cell[0]) if len(fraction_of_cell) else 1.0),
        )

    @property
    def mirrored_facets(self) -> NDArray[np.int32]:
        return np.asarray(np.concatenate([np.empty(0, dtype=np.int32), *self._faces]))

    def _held_on_mirror(self, directions: Iterable[Array]) -> list[Constraint]:
        """Return constraints along some directions (3,) on all faces of the mirror plane."""
        return [
            support_along(self.V, 2, facets, direction)
            for facets in self._faces
            for direction in directions
        ]

    def _system(self, constraints: list[Constraint]) -> FiniteElementSystem:
        """Return the system of all terms under some constraints."""
        # cells with nodes that supports move, and the tangent's integrals on these cells alone
        moving_cells, factory, motion = None, self.factory, self._moving
        if motion:
            integrals = body_hessian_integrals(
                self.body, self.r0, self._terms, self.kernels, cell_mask=motion.cells
            )
            moving_cells = motion.cells, integrals
        fast_tangent = FastTangent(self.u, self._hessians, constraints, moving_cells)
        parameters: dict[str, FreeParameter] = {
            **make_parameters(factory.free_constants, self._terms, self.u, self.kernels)
        }
        parameters |= field_parameters(factory.fields, self._terms, self.u, self.kernels)
        self.fields = factory.fields
        return FiniteElementSystem(
            self.u,
            self._terms,
            constraints,
            self._pattern,
            self.material.h,
            fast_tangent,
            variables=SystemVariables(parameters, motion),
        )


def _in_cells(field: Magnetisation, body: BodyMesh) -> Magnetisation:
    """Return a magnetisation with a vector for each cell, in place of patches or layers.

    Raises
    ------
    MeshError
        If the body has no such patch.
    """
    by_cell = field.on_cells(body.patches, len(body.layer_bounds))
    # patches take the place of layers
    if field.layers and not field.patches:
        return replace(by_cell, remanent=_layered(field.layers, body))
    return by_cell


def _layered(layers: Sequence[tuple[float, Array]], body: BodyMesh) -> ByPatch:
    """Return the field of layers through the thickness, a vector for each cell.

    `layers` are fractions of the thickness and vectors (3,), from the inner face outwards;
    fractions end where cells do.
    """
    ends = np.cumsum([fraction for fraction, _ in layers])
    vectors = np.array([vector for _, vector in layers])
    # the layer of each cell is that around the middle of its height
    middle = body.layer_bounds.mean(axis=1)
    layer_of_cell = np.searchsorted(ends[:-1], middle)
    return ByPatch(vectors[layer_of_cell])


def grown_in_body(density: SolidDensity, shape: Shape) -> SolidDensity:
    """Return the density of a body with a natural shape, from one of a body without.

    The function of `density` must take a keyword `growth`: the deformation from the undeformed to
    the natural shape. The natural shape's parameters follow those of the density.
    """

    def grown(*arguments: Expr) -> Expr:
        own_count = len(arguments) - len(shape.parameters)
        own_arguments, shape_parameters = arguments[:own_count], arguments[own_count:]
        growth = growth_in_body(shape, *shape_parameters)
        return density.function(*own_arguments, growth=growth)

    return replace(density, function=grown, parameters=(*density.parameters, *shape.parameters))
