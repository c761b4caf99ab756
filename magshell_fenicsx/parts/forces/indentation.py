"""The step `kind: indentation`: a force that pushes on one place.

A step of a case drives one amplitude, a load parameter by name, here the force F over 2 pi D/R. Its
conjugate is the displacement w under the force, inward. The chart has the coordinates of the
mid-surface; on a sphere their distance from the origin is the polar angle. An outline is the
undeformed shell, a disc one with a pole or a centre, its edge the largest distance in the chart.
e3 is the axis. h, R and D are thickness, reference length and bending stiffness.
"""

from collections.abc import Sequence
from math import copysign, radians, sqrt
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Direction, over_size
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grading import DiscFeature, Feature
from magshell_fenicsx.mesh.mirror import ROUNDING, rotation
from magshell_fenicsx.parts.ability import Context, Modelled
from magshell_fenicsx.parts.path_step import Count, PathStep
from magshell_fenicsx.parts.step_course import (
    ChartOfPlace,
    LoadStart,
    MeshHints,
    SizingContext,
    Target,
    Until,
)
from magshell_fenicsx.quantities.quantity import POINT_FORCE, THICKNESS
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint, tilted

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]

LEAST_HUMP = 0.01  # F of the first step towards the top of an energy barrier


class Place(Direction):
    """A direction from the centre of a hemisphere or cap, `polar: 0` of a pole, centre or tip; or a
    named point, which alone a mesh takes.
    """

    point: str | None = None
    """Name of a point of `points`, on any geometry"""

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        """Check that the place is either a point or a direction."""
        if self.point is not None and {"polar", "azimuth"} & self.model_fields_set:
            raise ValueError("give a point, or polar and azimuth")
        return self


class IndentationSection(PathStep):
    """A dead force along the undeformed normal at one place of the shell.

    F > 0 pushes in. With `until: points` a depth may be given that the mesh shall be fine enough
    for.
    """

    amplitude: ClassVar[str] = "force"
    conjugate: ClassVar[str] = "displacement under the force"
    targets: ClassVar[dict[str, Target]] = {
        "depth": Target("conjugate", "w_over_h"),
        "force": Target("load", "force"),
    }
    kind: Literal["indentation"]
    at: Place = Place.model_construct()
    """Where the force is, by default the pole or the centre; on a hemisphere polar is below 89"""
    control: Literal["displacement", "load", "arc"] = "displacement"
    """What is prescribed step by step: w, F, or arc length, which passes every fold; the default is
    load with a target `force`"""
    until: Until = "target"
    depth: Annotated[float, over_size(THICKNESS)] | None = Field(default=None, ge=-1e4, le=1e4)
    """Target w under the load; with control: displacement or arc [h]"""
    force: Annotated[float, over_size(POINT_FORCE)] | None = Field(default=None, ge=-1e6, le=1e6)
    """Target F; with control: load or arc [2πD/R]"""
    points: Count = 20
    patch: Annotated[float, over_size(THICKNESS)] = Field(default=0.0, ge=0, le=1000)
    """Radius of the patch that the force is spread over, from 0.3; 0 is a point [h]"""

    @property
    def place(self) -> Any:
        return self.at, self.patch

    def refuse_unfit(self, context: Context) -> None:
        """Refuse a force at the edge, at an unknown point, or concentrated on a solid.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """
        context.on_shell(context.step.key, self.at.polar)
        context.has_point(f"{context.step.key}.at.point", self.at.point)
        if context.solid and not self.patch:
            raise ValueError(
                "loading.patch: 0: a point force sinks into a solid without limit; give the patch "
                "its radius over h (of the paper's indenter, 0.2 mm at R = 25.2 mm, with R/h = "
                "90: 0.714)"
            )

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry that the force preserves: mirrors through its place."""
        place = self._place_on(context, outline)
        reason = "the force is not at the pole" if tilted(place) else None
        return [
            SymmetryConstraint(
                reason, [place], lambda mirror: bool(abs(mirror.signed_distance(place)) < ROUNDING)
            )
        ]

    def _place_on(self, context: Context, outline: "Outline") -> Array:
        """Return the place (3,) of the force over R, in the case's frame.

        Raises
        ------
        CaseError
            If the section does not say where the force is on this geometry.
        """
        at, geometry, key = self.at, context.shell.geometry, context.step.key
        if at.point is not None:
            return np.asarray(np.array(context.points[at.point]) / context.shell.reference)
        # of shells that are no spheres only the pole, centre or tip is a direction
        polar = radians(at.polar)
        if not outline.sphere and polar:
            allowed_places = "at its centre or tip, polar: 0, or at a point of points"
            raise CaseError(
                f"{key}.at.polar: {at.polar:g}: a {geometry} is loaded {allowed_places}"
            )
        # `highest` has the chart coordinates (2,) of the pole, centre or tip; None without one
        has_pole = outline.disc or geometry == "strip"
        if outline.highest is None or not has_pole:
            raise CaseError(f"{key}.at: a {geometry} has no pole: give {{point: NAME}}, of points")
        if not outline.sphere:
            return np.asarray(outline.embedding(outline.highest[None])[0])
        if 0 < polar < 1 / context.shell.R_over_h:  # the mesh could not tell it from the pole
            raise CaseError(
                f"{key}.at.polar: {at.polar:g}: 0, or more than a thickness from the pole"
            )
        # chart coordinates: the polar angle times the unit vector of the azimuth. At the pole that
        # vector is 0/0, and 1e-300 makes it zero
        chart = polar * at.vector()[:2] / max(np.hypot(*at.vector()[:2]), 1e-300)
        return np.asarray(outline.embedding(chart[None])[0])

    def concentrated(self, context: Context, outline: "Outline") -> Sequence[ChartOfPlace]:
        """Return the place of the force, as its chart.

        On a sphere it follows from the angles, which are exact. If half of the shell is modelled,
        the place is exactly on its plane of symmetry: coordinate zero.
        """
        place = self._place_on(context, outline)

        def chart(turn: float, half: bool) -> Array:
            """Return the place in the chart of a frame turned about e3 by `turn` radians."""
            if self.at.point is not None or not outline.sphere:
                chart_of_place = outline.inverse(rotation(turn) @ place)
                return outline.on_half(chart_of_place) if half else chart_of_place
            polar, theta = radians(self.at.polar), radians(self.at.azimuth) - turn
            y = 0.0 if half else np.sin(theta)
            return polar * np.array([np.cos(theta), y]) if polar else np.zeros(2)

        if self.patch:
            self._refuse_unfit_patch(context, outline, chart(0.0, False))
        return [chart]

    def _refuse_unfit_patch(self, context: Context, outline: "Outline", chart: Array) -> None:
        """Check that the patch of the force fits between its place and the shell's edge.

        `chart` (2 | 3,) is the place.

        Raises
        ------
        CaseError
            With the radii that are allowed, over h.
        """
        # distance over R from the place to the edge. On a sphere it is known. Elsewhere it is taken
        # to be 1, or the width of a strip if that is less
        width = getattr(context.shell, "width", None) if context.shell.geometry == "strip" else None
        distance_to_edge = (
            outline.edge - float(np.hypot(*chart[:2])) if outline.sphere else min(1.0, width or 1.0)
        )
        largest = distance_to_edge * context.shell.R_over_h
        if not 0.3 <= self.patch <= largest:
            raise CaseError(
                f"{context.step.key}.patch: {self.patch:g}: allowed are 0 for a point, or 0.3 to "
                f"{largest:.4g}, where it reaches the edge"
            )

    @classmethod
    def mesh_features(
        cls, loads: Sequence[Self], place: Array, sizing: SizingContext
    ) -> list[Feature]:
        """Return the discs of small elements for the dent and for the patch of the force.

        By mirror buckling the radius of the dent's ridge is about sqrt(2 R w) at a depth w.

        Parameters
        ----------
        loads
            The sections of forces at this place.
        place
            Coordinates of the place in the chart.
        """
        h, (x, y) = sizing.h, map(float, place)
        # the smallest patch and the largest depth, over h; without a depth ten thicknesses are
        # assumed
        patch = min(load.patch for load in loads)
        depth = max(abs(load.depth) if load.depth else 10.0 for load in loads)
        # the radius of the disc over R: the ridge's radius times a factor by experience, and a
        # margin
        dent_radius = (1.0 if sizing.solid else 0.85) * sqrt(2 * depth * h) + 0.5 * sqrt(h)
        growth = loads[0].mesh_hints(sizing).growth
        # elements at the patch are not finer than h: else they would resolve the stretch under a
        # point force, which is logarithmic and has no limit
        return [
            DiscFeature(
                (x, y), radius=dent_radius, size=sqrt(h) / sizing.refinement, growth=growth
            ),
            DiscFeature((x, y), radius=patch * h, size=max(patch * h / 2, h), growth=growth),
        ]

    def mesh_hints(self, sizing: SizingContext) -> MeshHints:
        """Return growth and size of elements along the edge; both are larger for a shell.

        Far from the ridge degree 2 needs more elements than degree 4. The edge of a hemisphere is
        far from a dent.
        """
        return MeshHints(growth=0.5, rim=2.0) if sizing.solid else MeshHints(growth=0.6, rim=2.8)

    def contribution(self, context: Context, modelled: Modelled) -> "Loads":
        """Return the step's amplitude -> the force."""
        # the solver takes long to import
        from magshell_fenicsx.models.shell.parameters import Force
        from magshell_fenicsx.parts.loads import Loads

        name = context.step.name
        force = Force(modelled.vertices[name], self.patch / context.shell.R_over_h)
        return Loads(forces={name: force})

    def first_change(self, change: float, load_start: LoadStart, *, by_load: bool) -> float:
        """Return the first change of the force, in its unit 2 pi D/R.

        Towards the top of an energy barrier, where the force is zero again, it is small. Under a
        prescribed force it is an equal part of the way, otherwise one.

        Parameters
        ----------
        change
            The whole change to the target, of the force or of the displacement.
        load_start, by_load
            Not used here: the force where the step begins, and whether the target is a force.
        """
        if self.until == "zero":  # up to the top of an energy barrier
            return LEAST_HUMP
        return change / self.points if self.control == "load" else copysign(1.0, change)

    def step(self, change: float | None, load_start: LoadStart) -> float | None:
        return load_start.unit if self.control == "displacement" else None
