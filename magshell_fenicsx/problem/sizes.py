"""The elements: what a case says of them, and the sizes that dimple, loads and edges need, over the
length sqrt(Rh).
"""

from collections.abc import Sequence
from math import sqrt
from typing import TYPE_CHECKING, Annotated, Protocol, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Section, or_number
from magshell_fenicsx.mesh.grading import Feature, Grading, Line, Ring
from magshell_fenicsx.parts.course import Fit
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.parts.supports.boundary import BoundarySection
from magshell_fenicsx.shape.sections import MeshSurface

if TYPE_CHECKING:
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
Loaded = tuple[Array, Sequence[Step]]  # place in the chart, and the loads there
SOLID_DEGREE = 2


class MeshSection(Section):
    """The elements: C0 interior penalty on triangles, graded towards dimple, load and held edges."""

    degree: int = Field(default=4, ge=2, le=5)
    """Degree k of the displacement. Degree 2 locks; a solid has degree 2 and no other"""
    refinement: float = Field(default=1.0, ge=0.1, le=20)
    """Divides every element size; not of a mesh file"""
    size: Annotated[float, or_number("metre"), Field(gt=0, le=1e12)] | None = None
    """Element size everywhere; by default graded, away from loads and held edges at most 0.35 R [the shell's length]"""
    penalty: float | None = Field(default=None, ge=1e-3, le=1e9)
    """σ of the interior penalty; by default 5 k²"""
    tolerance: float | None = Field(default=None, ge=1e-6, le=0.1)
    """Relative error of the run's result; chooses degree and refinement, of a solid refinement and layers"""

    @model_validator(mode="after")
    def _tolerance_chooses_the_mesh(self) -> Self:
        if self.tolerance is not None and self.model_fields_set & {"degree", "refinement"}:
            raise ValueError("tolerance chooses degree and refinement: give it or them")
        return self

    def refuse_unfit_solid(self, *, read: bool) -> None:
        """Refuse what a solid does not have; `read` says that its elements are those of a file."""
        for key in self.model_fields_set & {"degree", "penalty"}:
            if key != "degree" or self.degree != SOLID_DEGREE:
                finer = "a file with smaller elements" if read else "mesh.refinement"
                raise ValueError(
                    f"mesh.{key}: not of a solid, which has degree {SOLID_DEGREE}; {finer} makes it finer"
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
        """Refuse a compressibility beside a ratio that says all."""
        if "bulk_to_shear" in self.model_fields_set and poisson_ratio != 0.5:
            raise ValueError(
                "solid.bulk_to_shear: takes the place of shell.poisson_ratio: 0.5; here that is "
                f"{poisson_ratio:g}, which says all"
            )


def mesh_of(context: Context) -> MeshSection:
    """The elements that are asked for."""
    return context.of(MeshSection) or MeshSection()


def degree_of(context: Context) -> int:
    """The degree of the displacement."""
    return SOLID_DEGREE if context.solid else mesh_of(context).degree


class Shown(Protocol):
    """What needs small elements."""

    def features(self, outline: "Outline", fit: Fit, growth: float) -> list[Feature]:
        """Them, which grow so fast away from there."""


def grading(
    context: Context,
    outline: "Outline",
    h: float,
    shown: Sequence[Shown],
    everywhere: float,
    loaded: Sequence[Loaded],
    varying: Sequence[Feature] = (),
    *,
    local: bool = False,
) -> Grading:
    """Sizes for 1e-4 in k_d and 1e-3 in F at degree 4; a size that is given is everywhere the same,
    as in a file.

    Parameters
    ----------
    shown, everywhere
        What needs small elements somewhere, and the largest size that shows the rest.
    loaded
        The concentrated loads.
    varying
        Where formulas vary.
    local
        Whether the shell has local imperfections.
    """
    mesh = mesh_of(context)
    if mesh.size is not None or isinstance(context.shell, MeshSurface):
        size = mesh.size / context.shell.reference if mesh.size else min(2 * sqrt(h), 0.35)
        return Grading([], size / mesh.refinement)
    fit = Fit(h, mesh.refinement, context.solid, local)
    growth = _growth(context, fit)
    features = _rim(context, outline, fit)
    features += [feature for each in shown for feature in each.features(outline, fit, growth)]
    for place, loads in loaded:
        for kind in {type(load): None for load in loads}:
            features += kind.around([load for load in loads if type(load) is kind], place, fit)
    features += varying
    return Grading(features, min(_largest(context, outline, fit), everywhere) / mesh.refinement)


def _largest(context: Context, outline: "Outline", fit: Fit) -> float:
    if outline.grid:
        return min(2 * sqrt(fit.h), 0.35)
    if not outline.disc or context.shell.geometry == "disc":
        return min(0.25, 0.5 * (getattr(context.shell, "width", None) or 1.0))
    return min(
        (size for step in context.steps if (size := step.load.largest(fit)) is not None),
        default=0.35,
    )


def _growth(context: Context, fit: Fit) -> float:
    return max((step.load.growth(fit) for step in context.steps), default=0.4)


def _rim(context: Context, outline: "Outline", fit: Fit) -> list[Feature]:
    """Smaller elements along the edge of a curved surface."""
    h = fit.h
    if grid := outline.grid:
        boundary = context.of(BoundarySection)
        size, held = 1.2 * sqrt(h) / fit.refinement, boundary.conditions() if boundary else {}
        ends = ((axis, end[axis]) for axis in range(2) for end in (grid.low, grid.high))
        sides = zip(ends, grid.sides, grid.glued[:1] * 2 + grid.glued[1:] * 2, strict=True)
        fixed = (
            at
            for at, name, glued in sides
            if not glued and held.get(name, "free") not in ("free", "symmetry")
        )
        return [Line(axis, place, size, _growth(context, fit)) for axis, place in fixed]
    if not outline.disc or context.shell.geometry == "disc":
        return []
    size = max((step.load.rim(fit) for step in context.steps), default=1.4)
    return [Ring(outline.edge, size * sqrt(h) / fit.refinement, _growth(context, fit))]
