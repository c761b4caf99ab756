"""The problem: everything that will be computed, from which a scene is built."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import ceil, inf, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.distinct import flat_triangle, refuse_flat
from magshell_fenicsx.mesh.grading import Size
from magshell_fenicsx.mesh.grid import Grid, RimmedGrid, grid_mesh
from magshell_fenicsx.mesh.hexahedra import MIDDLE
from magshell_fenicsx.mesh.mirror import Mirror, Sector, cut
from magshell_fenicsx.mesh.msh import MeshFile, read_msh
from magshell_fenicsx.mesh.patch import Embedding, PatchMesh
from magshell_fenicsx.mesh.shapes import DiscShape, Shape
from magshell_fenicsx.mesh.triangulation import triangulate
from magshell_fenicsx.mesh.unfolding import doubled
from magshell_fenicsx.models.axisymmetric.meridian import graded_vertices
from magshell_fenicsx.models.shell.parameters import Condition, Material, default_penalty
from magshell_fenicsx.models.shell.patterns import Inside
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.models.solid.densities import MooneyRivlin
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionSection
from magshell_fenicsx.parts.imperfections.modes import Mode
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.problem.names import refuse_unfit
from magshell_fenicsx.problem.sizes import MeshSection, SolidSection
from magshell_fenicsx.problem.wanted import (
    FrequenciesSection,
    GradientsSection,
    OutputSection,
    StabilitySection,
)
from magshell_fenicsx.shape.turning import Span

ROUNDING = 1e-9
PRESSED = 0.08  # of sqrt(Rh): cells of a meridian that show the ring of a contact


@dataclass(frozen=True)
class Body:
    """The material of a solid, and where its elements through the thickness begin and end, 0 inside
    to 1 outside.
    """

    material: MooneyRivlin
    layers: list[float]


def body_of(context: Context) -> Body | None:
    """The solid of a case; None of a shell."""
    if not context.solid:
        return None
    shell, ratio = context.shell, _section(context).bulk_to_shear
    share = shell.rubber or 0.0
    assert isinstance(share, float)  # Ogden's law needs a mid-surface
    return Body(MooneyRivlin.of(shell.poisson_ratio, ratio, share), layers(context))


def layers(context: Context) -> list[float]:
    """Where the elements through the thickness begin and end, from 0 inside to 1 outside.

    Magnetised layers end where elements do, and so does the inner half then: nodes lie in the
    middle.
    """
    count, magnetic = _section(context).layers, context.of(MagneticSection)
    remanent = magnetic and magnetic.remanent
    magnetised = (remanent and remanent.layers) or []
    if not magnetised:
        return [n / count for n in range(count + 1)]
    tops = [
        sum(layer.fraction for layer in magnetised[: n + 1]) for n in range(len(magnetised) - 1)
    ]
    ends = [0.0, *sorted({MIDDLE, *(round(top, 9) for top in tops)}), 1.0]
    begins = [0.0]
    for low, high in pairwise(ends):
        parts = max(ceil((high - low) * count - ROUNDING), 1)
        begins += [low + (high - low) * (n + 1) / parts for n in range(parts)]
    return begins


def _section(context: Context) -> SolidSection:
    return context.of(SolidSection) or SolidSection()


@dataclass(frozen=True)
class Document:
    """What a run writes of that from which its problem was made, and by which it knows the run
    again.

    Attributes
    ----------
    data
        A JSON object, for instance the resolved case.
    name
        Of the file.
    outside
        Hashes of what is solved besides `data`, such as files; None for one that cannot be read.
    placed
        Message that begins with a key -> the same with the place of the key before it.
    """

    data: Mapping[str, Any] = field(default_factory=dict)
    name: str = ""
    outside: Mapping[str, str | None] = field(default_factory=dict)
    placed: Callable[[str], str] = str


@dataclass(frozen=True)
class Awaited:
    """The modes of the perfect shell that a problem has as imperfections, before they are computed.

    Attributes
    ----------
    count
        How many are needed.
    perfect
        Makes the problem of the perfect shell.
    given
        Modes -> the problem that has them.
    """

    count: int
    perfect: "Callable[[], Problem]"
    given: "Callable[[tuple[Mode, ...]], Problem]"


def _needs_inertia_alone(step: ProgrammeStep) -> bool:
    return step.load.motion is not None and step.load.motion.needs_inertia_alone


@dataclass(frozen=True)
class Problem:
    """Everything that will be computed, dimensionless (lengths in R).

    Attributes
    ----------
    context
        What its parts know: the shell, the named places in the shell's length, the programme.
    mesh
        The elements that are asked for.
    body
        What a solid is made of; None of a shell.
    meridian
        What is modelled instead of the surface; None if that is modelled.
    mirror
        Plane of the half, or both planes of the sector, that is modelled; None for all.
    turns
        Whether all parts are axisymmetric, whatever is modelled.
    azimuth
        The model's frame is turned about e3 by it (rad).
    shape, size, points, embedding
        What is triangulated, and how it is put into space. The point "pole" is the one whose
        displacement is reported: the pole, the disc's centre, the strip's tip.
    normal
        Chart -> outward unit normals of the perfect surface, of one that has a chart.
    included, left_out
        What the model has and lacks, for people.
    thickness
        What multiplies the thickness; None for 1.
    length
        R in the unit of results: metres of a case with units, else the unit of its lengths.
    pressed
        Size of each body, and how far from its first contact it presses; over R.
    warnings
        What is unphysical, or often meant in another way.
    within
        Name of the patch of each dimple -> whether places (n, 3) are within its rim.
    lambda_m
        |Br||Ba|/(mu_0 E); 0 without a field.
    unknowns
        About how many there will be, if the meridian is not modelled.
    patched
        Whether something has values by patches, so that the mesh has their edges.
    stability, frequencies, gradients
        What is asked of the path besides itself.
    output
        How pictures look.
    awaited
        The modes of the perfect shell, which must be computed first; None without.
    document
        What a run writes of the case.
    remade
        Values by keys -> the problem of the case with these; see `again`.
    """

    context: Context
    mesh: MeshSection
    body: Body | None
    material: Material
    loads: Loads
    conditions: dict[str, Condition]
    meridian: Span | None
    mirror: Mirror | None
    azimuth: float
    shape: Shape | Grid | MeshFile | PatchMesh
    embedding: Embedding
    points: dict[str, NDArray[np.float64]]
    size: Size
    included: list[str]
    left_out: list[str]
    normal: Embedding | None = None
    turns: bool = False
    thickness: Thickness | None = None
    length: float = 1.0
    pressed: tuple[tuple[float, float], ...] = ()
    supports: tuple[str, ...] = ()
    reactions: bool = False
    warnings: tuple[str, ...] = ()
    within: Mapping[str, Inside] = field(default_factory=dict)
    lambda_m: float = 0.0
    unknowns: float = 0.0
    patched: bool = False
    stability: StabilitySection | None = None
    frequencies: FrequenciesSection | None = None
    gradients: GradientsSection | None = None
    output: OutputSection = field(default_factory=OutputSection)
    awaited: Awaited | None = None
    document: Document = field(default_factory=Document)
    remade: "Callable[[Mapping[str, Any]], Problem] | None" = None

    @property
    def programme(self) -> tuple[ProgrammeStep, ...]:
        """Its steps; before a single load the natural shape grows, then the field."""
        return tuple(self.context.steps)

    @property
    def listed(self) -> bool:
        """Whether the programme is a list of steps, and no single load."""
        return self.context.whole

    @property
    def time_unit(self) -> float | None:
        """See `Context.time_unit`."""
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
    def half(self) -> bool:
        return self.mirror is not None

    @property
    def outward(self) -> Embedding | None:
        """Nodes of the mesh, or charts of the meridian -> normals of the perfect shell; None if
        they are not known.
        """
        return (
            self.meridian.normal
            if self.meridian
            else getattr(self.embedding, "normal", self.normal)
        )

    @property
    def given(self) -> MeshFile | None:
        """The mesh of a file or a program; None of other surfaces."""
        return self.shape if isinstance(self.shape, MeshFile) else None

    @property
    def fixed(self) -> bool:
        """Whether something is clamped, so that there is no rigid motion."""
        return "clamped" in self.conditions.values()

    @property
    def at_rest(self) -> bool:
        """Whether nothing loads the shell and its frequencies alone are asked: it need not be held."""
        return not self.programme and self.frequencies is not None

    @property
    def moves_freely(self) -> bool:
        """Whether the shell moves in time alone, so that it need not be held: its rigid motions
        cost inertia.
        """
        statics = [step for step in self.programme if not _needs_inertia_alone(step)]
        return bool(self.programme) and not (statics or self.frequencies or self.stability)

    @property
    def support_hint(self) -> str:
        """The step of a load that acts before a motion which needs no support, for a message; empty
        where there is none.
        """
        if self.moves_freely or not any(map(_needs_inertia_alone, self.programme)):
            return ""
        return (
            "; a shell that moves in time alone need not be held: let a field, for instance, act in "
            "the history of the step of kind: time, and no load before it"
        )

    @property
    def imperfections(self) -> Mapping[str, ImperfectionSection]:
        """Key of each below `shell` -> its section."""
        return self.context.sections.get("imperfections") or {}

    def again(self, values: Mapping[str, Any]) -> "Problem":
        """The same with other values, such as {"mesh.degree": 3}.

        Raises
        ------
        CaseError
            If it cannot be made again, or a value is not allowed.
        """
        if self.remade is None:
            raise CaseError(
                f"{', '.join(values)}: needs the problem with another value, and this one is made without a case: "
                "give it 'remade'"
            )
        return self.remade(values)

    def triangulated(self) -> PatchMesh:
        """The triangulation; call it on one rank only.

        Raises
        ------
        MeshError
            If there is none, it cannot carry a shell, or it has not what the problem names.
        """
        patch = self._made()
        refuse_unfit(patch, self.conditions, self.loads, self.thickness)
        if not self.body:
            refuse_flat(patch, *self._flat[1:], "shell.file" if self._of_file else "mesh")
        return patch

    def flat_triangle(self, patch: PatchMesh) -> str:
        """Say where a triangle is too flat for the penalty, and what helps; empty if none is."""
        return flat_triangle(patch, *self._flat)

    @property
    def _of_file(self) -> "MeshFile | None":
        """The mesh file of the one shell; None without."""
        file = self.shape
        return file if isinstance(file, MeshFile) and not file.given else None

    @property
    def _flat(self) -> tuple[float, float, float, str]:
        """The penalty and that of the degree by default; how messages tell places."""
        default = default_penalty(self.mesh.degree)
        told = (
            (1 / self._of_file.scale, "in the file's coordinates")
            if self._of_file
            else (1.0, "over R")
        )
        return self.mesh.penalty or default, default, *told

    def _triangulated(self, shape: Shape) -> PatchMesh:
        """The mesh of a shape by gmsh; that of a sector is symmetric, so that crests and troughs of
        waves are alike.
        """
        if not (isinstance(self.mirror, Sector) and isinstance(shape, DiscShape)):
            return triangulate(shape, self.size, self.points, self.embedding)
        middle = Mirror.upright(self.mirror.angle / 2)
        at = {name: np.append(x, 0.0) for name, x in self.points.items()}
        points = {
            name: (x if middle.beyond(x) <= 0 else middle.image(x))[:2] for name, x in at.items()
        }
        half = triangulate(
            replace(shape, waves=2 * self.mirror.waves), self.size, points, self.embedding
        )
        return replace(doubled(half, self.mirror.angle), points=dict(self.points))

    def _made(self) -> PatchMesh:
        if isinstance(self.shape, MeshFile):
            held = [
                name
                for name, condition in self.conditions.items()
                if condition in ("clamped", "hinged")
            ]
            return replace(
                read_msh(self.shape, self.points, self.mirror, held), embedding=self.embedding
            )
        if isinstance(self.shape, PatchMesh):
            return replace(self.shape, embedding=self.embedding)
        if isinstance(self.shape, Grid):
            patch = grid_mesh(self.shape, self.points, self.embedding)
        else:
            patch = self._triangulated(self.shape)
        whole = isinstance(self.shape, Grid | RimmedGrid)  # other shapes are made as halves
        whole = whole and not isinstance(self.mirror, Sector)  # whose chart is narrower
        return cut(patch, self.mirror) if self.mirror and whole else patch


def meridian_vertices(problem: Problem) -> NDArray[np.float64]:
    """Vertices of the meridian's mesh, in the chart; those of several shells one after the other."""
    span = problem.meridian
    assert span
    if span.vertices is not None:
        return span.vertices
    if span.pieces:
        meets = {
            piece.name: any(pair.has(piece.name) for pair in problem.loads.pairs)
            for piece in span.pieces
        }
        pressed = {
            piece.name: [(inf, piece.length)] if meets[piece.name] else [] for piece in span.pieces
        }
        each = [piece.vertices([*problem.pressed, *pressed[piece.name]]) for piece in span.pieces]
        ends = [float(s[-1]) for s in each[:-1]]
        return np.concatenate(
            [s[s > end] for s, end in zip(each, [-inf, *ends], strict=True)]
        )  # joined ones meet
    pole = span.names[0] is None
    h = problem.material.h / span.curvature
    reach = max((one[1] for one in problem.pressed), default=0.0)
    reach = span.length if problem.loads.pairs else reach  # folds meet anywhere
    return graded_vertices(
        span.length,
        span.circles,
        min([h, *(size / 3 for size, _ in problem.pressed)]),
        refinement=problem.mesh.refinement,
        axis=pole,
        largest=min(0.2 * sqrt(h), span.largest),
        pressed=((reach if pole else span.length), PRESSED * sqrt(h)) if reach else None,
        everywhere=problem.mesh.size and problem.mesh.size / problem.length,
    )
