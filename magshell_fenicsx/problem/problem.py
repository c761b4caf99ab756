"""The problem: everything that will be computed, from which a scene is built.

A `Problem` is dimensionless: lengths are over R, and moduli over Young's modulus. It makes its own
triangulation, or the vertices of its meridian.

A scene is the model of a problem with its solver. The context is the case as its parts know it. A
programme is the list of load steps. The chart is the pair of coordinates of the surface, or the
parameter of the meridian. A half or a sector is the part of a shell on one side of a symmetry
plane, or between two. The perfect shell is the one without imperfections. R is the reference
length, h the thickness. The penalty is the factor with which edges between cells resist kinks.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import ceil, inf, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grading import Size
from magshell_fenicsx.mesh.grid import Grid, RimmedGrid, grid_mesh
from magshell_fenicsx.mesh.hexahedra import MIDSURFACE_HEIGHT
from magshell_fenicsx.mesh.mirror import Mirror, Sector, cut
from magshell_fenicsx.mesh.msh import MeshFile, read_msh
from magshell_fenicsx.mesh.patch import Embedding, PatchMesh
from magshell_fenicsx.mesh.shapes import DiscShape, PlaneShape
from magshell_fenicsx.mesh.triangulation import triangulate
from magshell_fenicsx.mesh.unfolding import double_sector
from magshell_fenicsx.mesh.vertex_spacing import refuse_flat
from magshell_fenicsx.models.axisymmetric.meridian import graded_vertices, with_cell_at_edge
from magshell_fenicsx.models.shell.parameters import Condition, Material, PointForce
from magshell_fenicsx.models.shell.spatial_fields import InsideRim
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.models.solid.body_densities import CompressibleRubber
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionSection
from magshell_fenicsx.parts.imperfections.modes import Mode
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.fields import MagneticSection, strength
from magshell_fenicsx.parts.motion.motion_step import TimeSection
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.parts.supports.boundary import edges_of_inflated_rubber
from magshell_fenicsx.problem.mesh_sizes import MeshSection, SolidSection
from magshell_fenicsx.problem.requests import (
    FrequenciesSection,
    GradientsSection,
    OutputSection,
    StabilitySection,
)
from magshell_fenicsx.problem.surface_names import refuse_unfit
from magshell_fenicsx.shape.meridian_chart import MeridianChart

COUNT_TOLERANCE = 1e-9  # of a number of elements, which is rounded up
HEIGHT_DIGITS = 9  # decimals of heights in the thickness by which they are one
CONTACT_CELL_SIZE = 0.08  # over sqrt(Rh): cells of a meridian that resolve the ring of a contact
# width of a cell at a clamped edge of inflated rubber, over the thickness; docs/theory.md, Rubber
RUBBER_EDGE_CELL = 1.4
MAX_MERIDIAN_CELL_SIZE = 0.2  # over sqrt(Rh)
CELLS_OF_CONTACT = 3  # of a meridian, over the size of a body's contact


@dataclass(frozen=True)
class SolidBody:
    """The material of a solid, and the bounds of its elements through the thickness.

    Attributes
    ----------
    layer_bounds
        Heights at which the elements begin and end, from 0 inside to 1 outside.
    """

    material: CompressibleRubber
    layer_bounds: list[float]


def solid_body_of(context: Context) -> SolidBody | None:
    """Return the material and the elements of the solid of a case; None if the case is a shell.

    A `Context` holds the sections of a case: shell, places, programme.
    """
    if not context.solid:
        return None
    shell, bulk_to_shear = context.shell, _solid_section(context).bulk_to_shear
    law = shell.law_section.solid_law
    assert law  # another law needs a mid-surface
    return SolidBody(
        CompressibleRubber.from_poisson_ratio(
            law.strain_energy(), shell.poisson_ratio, bulk_to_shear
        ),
        layer_bounds(context),
    )


def layer_bounds(context: Context) -> list[float]:
    """Return the heights at which elements through the thickness begin and end, from 0 to 1.

    0 is the inner face, 1 the outer one. Elements end where magnetised layers do, and at the
    mid-surface, where nodes then lie. Without such layers all elements are equally thick.
    """
    element_count, magnetic = _solid_section(context).layers, context.section_of(MagneticSection)
    # layers of the remanence, from the inner face outwards
    remanent = magnetic and magnetic.remanent
    layers = remanent.layers if remanent else None
    magnetised = layers or []
    if not magnetised:
        return [n / element_count for n in range(element_count + 1)]

    def end_of_layer(n: int) -> float:
        """Return the height at which the magnetised layer n ends."""
        return sum(layer.fraction for layer in magnetised[: n + 1])

    # ends of magnetised layers inside the thickness; the last one ends at the outer face
    layer_tops = [end_of_layer(n) for n in range(len(magnetised) - 1)]
    # heights at which elements must end; each interval between them is divided equally
    inner_bounds = {MIDSURFACE_HEIGHT, *(round(top, HEIGHT_DIGITS) for top in layer_tops)}
    bounds = [0.0]
    for low, high in pairwise([0.0, *sorted(inner_bounds), 1.0]):
        elements = max(ceil((high - low) * element_count - COUNT_TOLERANCE), 1)
        bounds += [low + (high - low) * (n + 1) / elements for n in range(elements)]
    return bounds


def _solid_section(context: Context) -> SolidSection:
    """Return the section `solid` of a case, or its default."""
    return context.section_of(SolidSection) or SolidSection()


@dataclass(frozen=True)
class Document:
    """The document that a problem was made of; a run writes it, and is recognised by it.

    Attributes
    ----------
    data
        A JSON object, for instance the resolved case.
    name
        Name of the file.
    outside
        Name -> hash of what results depend on besides `data`, such as files; None for a file that
        cannot be read.
    with_place
        Function that puts the place in the file before a message that begins with a key.
    """

    data: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    outside: Mapping[str, str | None] = field(default_factory=dict)
    with_place: Callable[[str], str] = str


@dataclass(frozen=True)
class PendingModes:
    """Modes of the perfect shell that will be imperfections of a problem, not yet computed.

    Attributes
    ----------
    count
        Number of modes that are needed.
    perfect
        Function that makes the problem of the perfect shell.
    with_modes
        Function that makes, from the computed modes, the problem that has them as imperfections.
    """

    count: int
    perfect: "Callable[[], Problem]"
    with_modes: "Callable[[tuple[Mode, ...]], Problem]"


def _needs_inertia_alone(step: ProgrammeStep) -> bool:
    """Return whether a step is a motion of a shell that may be free of supports."""
    return isinstance(step.load, TimeSection) and step.load.needs_inertia_alone


def _made_by(maker: "Callable[[], Problem]") -> "Problem":
    """Return the problem that a function makes, which can be pickled again."""
    return maker().made_by(maker)


@dataclass(frozen=True, repr=False)
class Problem:
    """Everything that will be computed, dimensionless (lengths in R).

    It can be pickled if it is as its case has made it.

    Attributes
    ----------
    context
        The case, as parts know it: the shell, named places in the shell's length, the programme.
    mesh
        The elements that are requested.
    body
        Material and elements of a solid; None of a shell.
    material, loads
        Material of the shell, and all loads.
    conditions
        Name of an edge, a point or a patch -> its support.
    meridian
        The meridian that is modelled instead of the surface; None if the surface is modelled.
    mirror
        Symmetry plane of the half, or the sector, that is modelled; None for all.
    azimuth
        Angle about e3 (rad) by which the model's frame is turned.
    shape, size, points, embedding
        What is triangulated, the element size, the named points, and the map to space. The point
        "pole" is the one whose displacement is reported: the pole, the disc's centre, the strip's
        tip.
    included, left_out
        Phrases about the physics that the model includes, and leaves out.
    normal
        Chart -> outward unit normals of the perfect surface; None for a surface without a chart.
    turns
        Whether all parts are axisymmetric, whatever is modelled.
    thickness
        Factor of the thickness that varies; None for 1.
    length
        R in the unit of results: metres of a case with units, else the unit of its lengths.
    body_contacts
        For each body the size of its contact, and the distance from the first contact within which
        the body presses; over R.
    supports, reactions
        Names of supports, and whether their reactions are reported.
    warnings
        Messages about what is unphysical, or often meant in another way.
    within
        Name of the patch of each dimple -> whether places (n, 3) are within its rim.
    unknowns
        Approximate number of unknowns, if the meridian is not modelled.
    patched
        Whether something has values by patches, so that the mesh has their edges.
    stability, frequencies, gradients
        Requests besides the path.
    output
        Style of pictures.
    pending_modes
        The modes of the perfect shell, which must be computed first; None without.
    document
        The document that the problem was made of.
    remade
        Function of values by keys that makes the problem of the case with these; see `with_values`.
        None without a case.
    maker
        Function that makes the same problem again, in another process; None if it was changed since
        its case made it.
    """

    context: Context
    mesh: MeshSection
    body: SolidBody | None
    material: Material
    loads: Loads
    conditions: dict[str, Condition]
    meridian: MeridianChart | None
    mirror: Mirror | None
    azimuth: float
    shape: PlaneShape | Grid | MeshFile | PatchMesh
    embedding: Embedding
    points: dict[str, NDArray[np.float64]]
    size: Size
    included: list[str]
    left_out: list[str]
    normal: Embedding | None = None
    turns: bool = False
    thickness: Thickness | None = None
    length: float = 1.0
    body_contacts: tuple[tuple[float, float], ...] = ()
    supports: tuple[str, ...] = ()
    reactions: bool = False
    warnings: tuple[str, ...] = ()
    within: Mapping[str, InsideRim] = field(default_factory=dict)
    unknowns: float = 0.0
    patched: bool = False
    stability: StabilitySection | None = None
    frequencies: FrequenciesSection | None = None
    gradients: GradientsSection | None = None
    output: OutputSection = field(default_factory=OutputSection)
    pending_modes: PendingModes | None = None
    document: Document = field(default_factory=Document)
    remade: "Callable[[Mapping[str, Any]], Problem] | None" = None
    # `dataclasses.replace` does not copy it
    maker: "Callable[[], Problem] | None" = field(default=None, init=False, compare=False)

    def made_by(self, maker: "Callable[[], Problem]") -> "Problem":
        """Return the problem itself, with the function that makes it again."""
        object.__setattr__(self, "maker", maker)
        return self

    def __reduce__(self) -> tuple[Any, ...]:
        """Return what makes the problem again where it is unpickled."""
        if self.maker is None:
            raise TypeError(
                "a problem that was changed since its case made it cannot be pickled: pickle that "
                "of ms.Problem, or the case"
            )
        return _made_by, (self.maker,)

    def __repr__(self) -> str:
        """Return the problem in a few lines."""
        supports = ", ".join(f"{name} {condition}" for name, condition in self.conditions.items())
        steps = ", ".join(step.kind for step in self.programme)
        lines = [
            f"Problem {self.document.name}",
            f"  shell    {self.context.shell.geometry}, R/h = {1 / self.material.h:.6g}",
            f"  model    {', '.join(self.included)}",
            f"  supports {supports or 'none'}",
            f"  steps    {steps or 'none'}",
        ]
        return "\n".join(lines)

    @property
    def programme(self) -> tuple[ProgrammeStep, ...]:
        """Steps of the programme; before a single load the natural shape grows, then the field."""
        return tuple(self.context.steps)

    @property
    def lambda_m(self) -> float:
        """Strength |Br||Ba|/(mu_0 E) of the applied field; 0 without one."""
        return strength(self.context)

    @property
    def listed(self) -> bool:
        """Whether the programme is a list of steps, and no single load."""
        return self.context.is_programme

    @property
    def time_unit(self) -> float | None:
        """Unit of time in seconds, see `Context.time_unit`."""
        return self.context.time_unit

    @property
    def modulus(self) -> float:
        """Young's modulus in the unit of results; 1 if none is given."""
        return self.context.shell.modulus or 1.0

    @property
    def axisymmetric(self) -> bool:
        """Whether the meridian is modelled."""
        return self.meridian is not None

    @property
    def is_half(self) -> bool:
        """Whether a half or a sector is modelled."""
        return self.mirror is not None

    @property
    def outward(self) -> Embedding | None:
        """Nodes of the mesh, or charts of the meridian -> outward normals of the perfect shell.

        None if the normals are not known.
        """
        if self.meridian:
            return self.meridian.normal
        return getattr(self.embedding, "normal", self.normal)

    @property
    def mesh_file(self) -> MeshFile | None:
        """The mesh of a file or a program; None of other surfaces."""
        return self.shape if isinstance(self.shape, MeshFile) else None

    @property
    def fixed(self) -> bool:
        """Whether something is clamped, so that there is no rigid motion."""
        return "clamped" in self.conditions.values()

    @property
    def at_rest(self) -> bool:
        """Whether only frequencies of an unloaded shell are requested: it needs no supports."""
        return not self.programme and self.frequencies is not None

    @property
    def moves_freely(self) -> bool:
        """Whether the shell only moves in time, so that it needs no supports.

        Inertia then resists its rigid motions.
        """
        has_requests_at_rest = self.frequencies or self.stability
        if not self.programme or has_requests_at_rest:
            return False
        return all(_needs_inertia_alone(step) for step in self.programme)

    @property
    def support_hint(self) -> str:
        """Advice for a message about a shell that is not held; empty where it does not help.

        Planes of symmetry need a point that is held along them. Where static steps need supports
        and a motion needs none, the load of the static step may act within the motion instead.
        """
        if any(condition in ("plane", "symmetry") for condition in self.conditions.values()):
            return (
                "; planes of symmetry hold it across them alone: hold a point along them too, for "
                "instance points: {top: [0, 0, 50 mm]}, boundary: {top: {held: [x, y]}}"
            )
        if self.moves_freely or not any(map(_needs_inertia_alone, self.programme)):
            return ""
        return (
            "; a shell that moves in time alone need not be held: let a field, for instance, act "
            "in the history of the step of kind: time, and no load before it"
        )

    @property
    def imperfections(self) -> Mapping[str, ImperfectionSection]:
        """Mapping: key of each imperfection below `shell` -> its section."""
        return self.context.sections.get("imperfections") or {}

    def with_values(self, values: Mapping[str, Any]) -> "Problem":
        """Return the problem of the case with other values at keys, such as {"mesh.degree": 3}.

        Raises
        ------
        CaseError
            If the problem was made without a case, or a value is not allowed.
        """
        if self.remade is None:
            raise CaseError(
                f"{', '.join(values)}: needs the problem with another value, "
                "and this one is made without a case: give it 'remade'"
            )
        return self.remade(values)

    def triangulated(self) -> PatchMesh:
        """Return the triangulation of the modelled surface, after checks; call it on one rank only.

        Raises
        ------
        MeshError
            If a triangle is too flat, or the mesh lacks an edge, a point or a patch that the
            problem names.
        """
        patch = self._triangulation()
        if self.body:  # whose lines within the surface cannot be held or loaded
            patch = replace(patch, inner_lines={})
        refuse_unfit(patch, self.conditions, self.loads, self.thickness)
        if not self.body:
            key = "shell.file" if self._file_of_shell else "mesh"
            refuse_flat(patch, self.mesh.degree, *self.unit_of_places, key)
        return patch

    @property
    def _file_of_shell(self) -> MeshFile | None:
        """The mesh file of a shell that consists of one file; None for other surfaces."""
        file = self.mesh_file
        return file if file and not file.in_memory else None

    @property
    def unit_of_places(self) -> tuple[float, str]:
        """R in the unit of places in messages on the mesh, and this unit in words.

        It is R, or that of the coordinates of the shell's mesh file.
        """
        if self._file_of_shell:
            return 1 / self._file_of_shell.scale, "in the file's coordinates"
        return 1.0, "over R"

    def _triangulated_by_gmsh(self, shape: PlaneShape) -> PatchMesh:
        """Return the mesh of a plane shape by gmsh; on one rank.

        The mesh of a sector of a disc is symmetric about the middle plane of the sector: gmsh
        meshes one half of it. So crests and troughs of waves have equal elements.
        """
        if not (isinstance(self.mirror, Sector) and isinstance(shape, DiscShape)):
            return triangulate(shape, self.size, self.points, self.embedding)
        # points in the first half of the sector, or their images there
        middle_plane = Mirror.through_axis(self.mirror.angle / 2)
        points = dict[str, NDArray[np.float64]]()
        for name, chart in self.points.items():
            x = np.append(chart, 0.0)  # a mirror reflects points (3,) of space
            in_first_half = middle_plane.signed_distance(x) <= 0
            points[name] = (x if in_first_half else middle_plane.image(x))[:2]
        half_shape = replace(shape, waves=2 * self.mirror.waves)
        half = triangulate(half_shape, self.size, points, self.embedding)
        return replace(double_sector(half, self.mirror.angle), points=dict(self.points))

    @property
    def _points_anywhere(self) -> set[str]:
        """Names of the points of a mesh file that need not be vertices: stresses alone are read.

        Where the first point of the case is one, so is "pole", its other name.
        """
        stress = self.loads.stress
        names = {point.name for point in stress.points} if stress else set[str]()
        names -= {*self.conditions, *(force.point for force in self.loads.forces.values())}
        names -= {load.point for load in self.loads.all_dead if isinstance(load, PointForce)}
        first_name = next(iter(self.context.points), None)
        return names | ({"pole"} if first_name in names else set())

    def _triangulation(self) -> PatchMesh:
        """Return the triangulation of the half, the sector or the whole surface, unchecked.

        It comes from a mesh file, a given mesh, a grid or gmsh; a grid or a rimmed grid is cut at
        the mirror plane.
        """
        if isinstance(self.shape, MeshFile):
            held_edges = [
                name
                for name, condition in self.conditions.items()
                if condition in ("clamped", "hinged")
            ]
            patch = read_msh(
                self.shape, self.points, self.mirror, held_edges, self._points_anywhere
            )
            return replace(patch, embedding=self.embedding)
        if isinstance(self.shape, PatchMesh):
            return replace(self.shape, embedding=self.embedding)
        if isinstance(self.shape, Grid):
            patch = grid_mesh(self.shape, self.points, self.embedding)
        else:
            patch = self._triangulated_by_gmsh(self.shape)
        # a grid has both sides of the mirror plane of a half, and must be cut; other shapes are
        # made as halves, and the grid of a sector is as narrow as the sector
        is_grid = isinstance(self.shape, Grid | RimmedGrid)
        has_both_sides = is_grid and not isinstance(self.mirror, Sector)
        return cut(patch, self.mirror) if self.mirror and has_both_sides else patch


def meridian_vertices(problem: Problem) -> NDArray[np.float64]:
    """Return the vertices (n,) of the meridian's mesh as chart parameters, in increasing order.

    Elements are graded: small near edges, jumps of curvature and contacts with bodies. The vertices
    of several shells stand one shell after the other.
    """
    meridian = problem.meridian
    assert meridian
    if meridian.vertices is not None:
        return meridian.vertices
    if meridian.shell_meridians:
        return _vertices_of_shells(problem, meridian)
    has_pole = meridian.names[0] is None  # it begins on the axis, where there is no edge
    h = problem.material.h / meridian.curvature
    # how far from the begin bodies may touch the shell; shells may meet anywhere
    contact_reach = max((distance for _, distance in problem.body_contacts), default=0.0)
    if problem.loads.pairs:
        contact_reach = meridian.length
    # how far from the begin there are small cells, and their size; None without contact
    contact_cells = None
    if contact_reach:
        contact_cells = contact_reach if has_pole else meridian.length, CONTACT_CELL_SIZE * sqrt(h)
    # the thickness, or a smaller size of cells on the axis that resolves the contact of a body
    size_on_axis = min([h, *(size / CELLS_OF_CONTACT for size, _ in problem.body_contacts)])
    vertices = graded_vertices(
        meridian.length,
        meridian.curvature_jumps,
        size_on_axis,
        refinement=problem.mesh.refinement,
        axis=has_pole,
        largest=min(MAX_MERIDIAN_CELL_SIZE * sqrt(h), meridian.largest),
        contact_size=contact_cells,
        # the size that the case gives for all cells, over R; None without
        everywhere=problem.mesh.size and problem.mesh.size / problem.length,
    )
    rubber_edges = edges_of_inflated_rubber(problem.context)
    ends = zip((0.0, meridian.length), (meridian.names[0], meridian.names[-1]), strict=True)
    for end, name in ends:
        if name in rubber_edges:
            vertices = with_cell_at_edge(vertices, end, RUBBER_EDGE_CELL * problem.material.h)
    return vertices


def _vertices_of_shells(problem: Problem, meridian: MeridianChart) -> NDArray[np.float64]:
    """Return the vertices (n,) of the meridians of several shells, one after the other.

    Where two shells are joined, the vertex that both have stands once.
    """
    vertices, last_vertex = list[NDArray[np.float64]](), -inf
    for shell in meridian.shell_meridians:
        # contacts as (size, distance from the begin within which they may be); another shell may
        # touch all of this one, and asks for no size of its own
        touches_shells = any(pair.has(shell.name) for pair in problem.loads.pairs)
        contact_of_shells = [(inf, shell.length)] if touches_shells else []
        shell_vertices = shell.vertices([*problem.body_contacts, *contact_of_shells])
        vertices.append(shell_vertices[shell_vertices > last_vertex])
        last_vertex = float(shell_vertices[-1])
    return np.concatenate(vertices)
