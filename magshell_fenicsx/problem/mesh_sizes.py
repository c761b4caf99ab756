"""Sections of the elements, and the element sizes that imperfections, loads and edges need.

Sizes follow the length sqrt(Rh); they are over R. The docstrings of sections and of their keys are
the text of docs/case.md.

R is the reference length, h the thickness. The chart is the pair of coordinates of the surface: a
disc, a grid or a strip. A feature is a place in the chart with an element size, from where sizes
grow; the grading is all of them with the largest size. k_d and F are the critical pressure and the
force that a run computes.
"""

from collections.abc import Sequence
from math import sqrt
from typing import TYPE_CHECKING, Annotated, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Section, or_number
from magshell_fenicsx.mesh.grading import Feature, Grading, LineFeature, RingFeature
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.shell_sections import MeshSurface
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.parts.step_course import MeshHints, SizingContext
from magshell_fenicsx.parts.supports.boundary import BoundarySection, edges_of_inflated_rubber

if TYPE_CHECKING:
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
Loaded = tuple[Array, Sequence[Step]]  # place in the chart, and the loads there
SOLID_DEGREE, MAX_DEGREE = 2, 5
MAX_SIZE = 0.35  # over R, where nothing needs smaller elements
UNIFORM_SIZE = 2.0  # over sqrt(Rh): of a mesh with equal elements, and the largest of grids
MAX_FLAT_SIZE, MAX_SIZE_OF_WIDTH = 0.25, 0.5  # of flat shells: over R, and over the width
# sides of triangles at clamped edges of inflated rubber, over the thickness; docs/theory.md, Rubber
RUBBER_EDGE_SIZE, RUBBER_EDGE_SIZE_AT_DEGREE_3 = 1.0, 2.8
MIN_RUBBER_EDGE_SIZE = 0.014  # of these elements over R
RUBBER_GROWTH = 1.0  # of the size per distance from there, where the shell is smooth
GRID_EDGE_SIZE = 1.2  # over sqrt(Rh), along held edges of grids
# around a tube, over sqrt(Rh) and over R: waves around it are at least twice as long as those of
# axial compression, and at least nine elements resolve an oval
AROUND_TUBE_SIZE, MAX_AROUND_TUBE_SIZE = 2.5, 0.7


class MeshSection(Section):
    """The elements: C0 interior penalty on triangles, graded towards dimple, load and held
    edges."""

    degree: int = Field(default=4, ge=2, le=MAX_DEGREE)
    """Degree k of the displacement. Degree 2 locks; a solid has degree 2 and no other"""
    refinement: float = Field(default=1.0, ge=0.1, le=20)
    """Divides every element size; not of a mesh file"""
    size: Annotated[float, or_number("metre"), Field(gt=0, le=1e12)] | None = None
    """Element size everywhere; by default graded, away from loads and held edges at most 0.35 R,
    of tubes by their waves [the shell's length]"""
    penalty: float | None = Field(default=None, ge=1e-3, le=1e9)
    """σ of the interior penalty; by default 5 k²"""
    tolerance: float | None = Field(default=None, ge=1e-6, le=0.1)
    """Relative error of the run's result; chooses degree and refinement, of a solid refinement
    and layers"""

    @model_validator(mode="after")
    def _tolerance_chooses_the_mesh(self) -> Self:
        if self.tolerance is not None and self.model_fields_set & {"degree", "refinement"}:
            raise ValueError("tolerance chooses degree and refinement: give it or them")
        return self

    def refuse_unfit_solid(self, *, mesh_file: bool) -> None:
        """Refuse keys that a solid does not have; `mesh_file` is whether its elements are a file's.

        Raises
        ------
        ValueError
            With the first such key.
        """
        for key in self.model_fields_set & {"degree", "penalty"}:
            if key != "degree" or self.degree != SOLID_DEGREE:
                remedy = "a file with smaller elements" if mesh_file else "mesh.refinement"
                raise ValueError(
                    f"mesh.{key}: not of a solid, which has degree {SOLID_DEGREE}; "
                    f"{remedy} makes it finer"
                )


class SolidSection(Section):
    """Hexahedra of degree 2 through the thickness, and the compressibility that stands for
    poisson_ratio: 0.5.
    """

    layers: int = Field(default=1, ge=1, le=10)
    """Elements through the thickness"""
    bulk_to_shear: float = Field(default=100.0, ge=10, le=1e5)
    """κ/μ, in place of ν = 0.5 and only there"""

    def refuse_unfit(self, poisson_ratio: float) -> None:
        """Refuse a compressibility beside a Poisson's ratio other than 0.5, which determines it.

        Raises
        ------
        ValueError
            If both are given.
        """
        if "bulk_to_shear" in self.model_fields_set and poisson_ratio != 0.5:
            raise ValueError(
                "solid.bulk_to_shear: takes the place of shell.poisson_ratio: 0.5; here that is "
                f"{poisson_ratio:g}, which says all"
            )


def mesh_section(context: Context) -> MeshSection:
    """Return the section of the elements of a case, or its default."""
    return context.section_of(MeshSection) or MeshSection()


def degree_of(context: Context) -> int:
    """Return the polynomial degree of the displacement in a case."""
    return SOLID_DEGREE if context.solid else mesh_section(context).degree


class Refined(Protocol):
    """A part of a case that needs small elements somewhere."""

    def features(self, outline: "Outline", sizing: SizingContext, growth: float) -> list[Feature]:
        """Return small elements in the chart, with sizes that grow by `growth` per distance."""


def grading(
    context: Context,
    outline: "Outline",
    h: float,
    refined: Sequence[Refined],
    largest: float,
    loaded: Sequence[Loaded],
    varying: Sequence[Feature] = (),
    *,
    local: bool = False,
) -> Grading:
    """Return element sizes over R for errors of 1e-4 in k_d and 1e-3 in F at degree 4.

    A size that the case gives is the same everywhere, and so is that of a mesh file.

    Parameters
    ----------
    outline
        The surface with its chart.
    h
        Thickness over R.
    refined, largest
        Parts that need small elements somewhere, and the largest size that resolves the others.
    loaded
        Places in the chart with concentrated loads, and the loads there.
    varying
        Small elements where formulas vary.
    local
        Whether the shell has local imperfections.
    """
    mesh = mesh_section(context)
    # one size everywhere, without features
    if mesh.size is not None or isinstance(context.shell, MeshSurface):
        default = min(UNIFORM_SIZE * sqrt(h), MAX_SIZE)
        size = mesh.size / context.shell.reference if mesh.size else default
        return Grading([], size / mesh.refinement)
    # small elements along edges, and where parts need them
    sizing = SizingContext(h, mesh.refinement, context.solid, local)
    growth = _growth(context, sizing)
    features = _edge_features(context, outline, sizing)
    for part in refined:
        features += part.features(outline, sizing, growth)
    # at loads: those of one class at a place share their small elements; a dict keeps the order
    for place, loads in loaded:
        for load_class in {type(load): None for load in loads}:
            loads_of_class = [load for load in loads if type(load) is load_class]
            features += load_class.mesh_features(loads_of_class, place, sizing)
    # where formulas vary
    features += varying
    largest_size = min(_largest_size(context, outline, sizing), largest)
    return Grading(features, largest_size / mesh.refinement)


def _largest_size(context: Context, outline: "Outline", sizing: SizingContext) -> float:
    """Return the element size over R where nothing needs smaller elements, before refinement."""
    if outline.grid:
        size = min(UNIFORM_SIZE * sqrt(sizing.h), MAX_SIZE)
        return max(_tube_sizes(context, sizing)) if _is_tube(context, outline) else size
    if not outline.disc or context.shell.geometry == "disc":  # a strip, or a flat disc
        width = getattr(context.shell, "width", None) or 1.0
        return min(MAX_FLAT_SIZE, MAX_SIZE_OF_WIDTH * width)
    sizes = (hints.largest for hints in _hints_of_loads(context, sizing))
    return min((size for size in sizes if size is not None), default=MAX_SIZE)


def _is_tube(context: Context, outline: "Outline") -> bool:
    """Return whether a shell, and no solid, is a cylinder that is closed around e3."""
    return context.shell.geometry == "cylinder" and outline.round and not context.solid


def _tube_sizes(context: Context, sizing: SizingContext) -> tuple[float, float]:
    """Return the largest element sizes over R around a tube and along it, before refinement."""
    length = sqrt(sizing.h)  # sqrt(Rh) over R
    along = min(hints.along_tube for hints in _hints_of_loads(context, sizing))
    return min(AROUND_TUBE_SIZE * length, MAX_AROUND_TUBE_SIZE), along * length


def _hints_of_loads(context: Context, sizing: SizingContext) -> list[MeshHints]:
    """Return the element sizes that suit each load; the usual ones for a case without a load."""
    return [step.load.mesh_hints(sizing) for step in context.steps] or [MeshHints()]


def _growth(context: Context, sizing: SizingContext) -> float:
    """Return the largest growth of the element size per distance that suits a load."""
    return max(hints.growth for hints in _hints_of_loads(context, sizing))


def _edge_features(context: Context, outline: "Outline", sizing: SizingContext) -> list[Feature]:
    """Return small elements along held edges of a grid, or along the rim of a curved disc.

    Those of a tube are limited along both axes.

    A curved disc is the chart of a sphere, for example. Flat shapes have none, but for clamped
    edges of inflated rubber, where sizes do not depend on the refinement.
    """
    h, growth = sizing.h, _growth(context, sizing)
    rubber_edges = edges_of_inflated_rubber(context)
    size_over_h = RUBBER_EDGE_SIZE if degree_of(context) > 3 else RUBBER_EDGE_SIZE_AT_DEGREE_3
    rubber_size = max(size_over_h * h, MIN_RUBBER_EDGE_SIZE)
    if grid := outline.grid:
        boundary = context.section_of(BoundarySection)
        size = GRID_EDGE_SIZE * sqrt(h) / sizing.refinement
        conditions = boundary.conditions() if boundary else {}
        features = list[Feature]()
        if _is_tube(context, outline):  # a size along each axis, the same everywhere
            for axis, tube_size in enumerate(_tube_sizes(context, sizing)):
                features.append(LineFeature(axis, 0.0, tube_size / sizing.refinement, growth=0.0))
        # the sides are the low and the high one of the first axis, then those of the second
        for i, name in enumerate(grid.sides):
            axis, corner = i // 2, (grid.low, grid.high)[i % 2]
            is_held = conditions.get(name, "free") not in ("free", "symmetry")
            if is_held and not grid.glued[axis]:
                features.append(LineFeature(axis, corner[axis], size, growth))
            if name in rubber_edges:
                features.append(LineFeature(axis, corner[axis], rubber_size, RUBBER_GROWTH))
        return features
    if not outline.disc:
        return []
    features = [RingFeature(outline.edge, rubber_size, RUBBER_GROWTH)] if rubber_edges else []
    if context.shell.geometry != "disc":
        size = max(hints.rim for hints in _hints_of_loads(context, sizing))
        features.append(RingFeature(outline.edge, size * sqrt(h) / sizing.refinement, growth))
    return features
