"""Conditions on the named edges and points of a geometry.

A condition is a support or symmetry, by the name of an edge, a point or a patch. An offer is a
property of a case that other parts may need, such as the whole shell, and that a part may withdraw.
A symmetry constraint says which mirror planes a part of the case allows, and why it is not
axisymmetric about e3. R/h is the radius over the thickness. `mirror.image_of_edge` gives the name
of the mirror image of an edge.
"""

import re
from collections.abc import Iterable
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, ValidationError

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.mesh.mirror import ROUNDING, Mirror
from magshell_fenicsx.parts.ability import Ability, Context, Offer
from magshell_fenicsx.parts.shell_sections import FLAT_GEOMETRIES, ShellSection
from magshell_fenicsx.shape.symmetry_constraint import (
    PARALLEL,
    SymmetryConstraint,
    no_plane,
    tilted,
)

if TYPE_CHECKING:
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
THIN_RUBBER = 200  # R/h beyond which the layer at a clamped edge counts less than the mesh
EDGES = {"hemisphere": ("equator",), "disc": ("rim",), "strip": ("root", "tip", "sides")}
Axis = Literal["x", "y", "z"]
EdgeCondition = Literal["clamped", "simply supported", "hinged", "symmetry", "free"]


class HeldSection(Section):
    """Some components of the displacement are zero; rotations are free."""

    held: Annotated[list[Axis], Field(min_length=1, max_length=3)]
    """The components that are zero"""

    @property
    def components(self) -> tuple[int, ...]:
        return tuple(sorted({"xyz".index(axis) for axis in self.held}))


def _condition(value: Any) -> Any:
    """Return a condition of an edge, a point or a patch after validation.

    Raises
    ------
    ValueError
        With what is allowed, in one message for all kinds of conditions.
    """
    if isinstance(value, HeldSection):
        return value
    if isinstance(value, str) and value in get_args(EdgeCondition):
        return value
    if isinstance(value, dict) and set(value) == {"held"}:
        try:
            return HeldSection.model_validate(value)
        except ValidationError:
            pass  # the message below says what is allowed
    raise ValueError(
        f"must be {', '.join(get_args(EdgeCondition))}, or {{held: [x, y, z]}} with some of these"
    )


class BoundarySection(Section, Ability):
    """Edge, point or patch of a mesh -> condition; edges that are not named are free.

    clamped: neither displacement nor rotation. hinged, or simply supported: no displacement.
    symmetry: the edge lies in a mirror plane of a shape of which this is a part (of a whole shape
    take `symmetry: half`). held: some components of the displacement; a point of `points` can be
    held too. A patch of a mesh file can be clamped or held, all of it, if no edge has its name. A
    line within the surface, a joined edge or a curve of a mesh file, can be hinged or held.
    """

    model_config = Section.model_config | {"extra": "allow"}
    __pydantic_extra__: dict[
        str,
        Annotated[
            Any, BeforeValidator(_condition, json_schema_input_type=EdgeCondition | HeldSection)
        ],
    ]

    def conditions(self) -> dict[str, EdgeCondition | HeldSection]:
        """Return name of each edge, point or patch -> its condition."""
        return dict(self.__pydantic_extra__ or {})

    def refuse_unfit(self, context: Context) -> None:
        """Refuse names of points that are taken, and of edges that the geometry does not have.

        Raises
        ------
        ValueError
            With the name.
        """
        refuse_taken(context.points)
        shell = context.shell
        edges = EDGES[shell.geometry] if isinstance(shell, ShellSection) else ()
        for name in self.conditions() if edges else ():
            if name not in edges and name not in context.points:
                raise ValueError(
                    f"boundary.{name}: a {shell.geometry} has no such edge, only {', '.join(edges)}"
                )

    def withdraws(self, context: Context) -> dict[Offer, str]:
        """Withdraw the whole shell where an edge lies in a mirror plane: the case is a part."""
        part = "symmetry" in self.conditions().values()
        return (
            {"the whole shell": "with boundary: symmetry the case is a part of it alone"}
            if part
            else {}
        )

    @property
    def fixes(self) -> bool:
        """Whether an edge or a point is held in all directions."""
        return any(
            len(condition.components) == 3
            if isinstance(condition, HeldSection)
            else condition in ("clamped", "simply supported", "hinged")
            for condition in self.conditions().values()
        )

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry that the supports of a shell preserve.

        A loaded half does not see rigid motions across its mirror plane. So a shell without a
        support against all motions must be modelled as a whole. An exception is a shell without
        loads, of which frequencies alone are computed: its free rigid motions are allowed.
        """
        constraints = list[SymmetryConstraint]()
        for name, condition in self.conditions().items():
            # why the support is not axisymmetric about e3; None if it is
            reason = None
            if isinstance(condition, HeldSection):
                # an axisymmetric support holds both x and y, or neither, and stands on the axis
                one_sided = len({0, 1} & set(condition.components)) == 1
                is_off_axis = tilted(np.array(context.points.get(name, [0.0, 0.0, 1.0])))
                if one_sided:
                    reason = f"boundary.{name}: is held along x or y alone"
                elif is_off_axis:
                    reason = f"boundary.{name}: is held off the axis"
            constraints.append(
                SymmetryConstraint(reason, mirrors=partial(self._mirrored, context, name))
            )
        frequencies_alone = not context.steps and context.sections.get("frequencies") is not None
        # a loaded shell that no support fixes is modelled as a whole: no plane is a mirror. This is
        # no reason against a meridian, whose model checks by itself whether it is held.
        if not frequencies_alone and not self.fixes:
            constraints.append(SymmetryConstraint(mirrors=no_plane))
        return constraints

    def _mirrored(self, context: Context, name: str, mirror: Mirror) -> bool:
        """Return whether a plane maps a support onto an equal one.

        A held point must lie on the plane.
        """
        conditions = self.conditions()
        condition = conditions[name]
        condition_of_image = conditions.get(mirror.image_of_edge(name), "free")
        # the reflection must map the held directions onto themselves
        if isinstance(condition, HeldSection):
            S = mirror.reflection
            held_projection = np.diag([float(i in condition.components) for i in range(3)])
            if np.abs(S @ held_projection @ S - held_projection).max() > PARALLEL:
                return False
        # distance of a point; an edge or a patch has none
        place, distance = context.points.get(name), 0.0
        if place is not None:
            distance = float(mirror.signed_distance(np.array(place) / context.shell.reference))
        return abs(distance) < ROUNDING and condition == condition_of_image


def refuse_taken(points: Iterable[str]) -> None:
    """Refuse points whose names the program uses itself, by a ValueError."""
    for point in points:
        if point == "pole":
            raise ValueError(
                "points.pole: is taken, by the point that w_pole_over_h is of; choose another name"
            )
        if re.fullmatch(r"load(_\d+)?", point):
            raise ValueError(
                f"points.{point}: is taken, by the point that is indented; choose another name"
            )


def inflation_warning(context: Context, shell: str = "") -> str | None:
    """Return a warning if pressure blows up a shell of rubber beside a clamped edge; None if not.

    Parameters
    ----------
    context
        The case of the shell alone, with the steps of the whole case.
    shell
        Its name among several shells; "" for a single one.
    """
    edges = edges_of_inflated_rubber(context, shell)
    if not edges:
        return None
    return (
        f"boundary.{edges[0]}: clamped: blown-up rubber bends there in a layer as wide as it "
        "is thick, which no shell theory describes: instabilities may be false far beyond the "
        "largest pressure, or with wider elements along this edge; a hinged edge has no such "
        "layer, and its fold is lower by less than h/R"
    )


def edges_of_inflated_rubber(context: Context, shell: str = "") -> list[str]:
    """Return names of clamped edges at which inflated rubber bends in a narrow layer.

    There are none in a solid, and in a shell so thin that the layer counts less than the mesh.

    Parameters
    ----------
    context
        The case of one shell.
    shell
        Its name among several shells; "" for a single one.
    """
    section, boundary = context.shell, context.section_of(BoundarySection)
    if boundary is None or context.solid or not section.law_section.incompressible:
        return []
    is_flat = section.geometry in FLAT_GEOMETRIES
    inflated = any(_inflates(step.load, shell, is_flat=is_flat) for step in context.steps)
    if not inflated or section.R_over_h > THIN_RUBBER:
        return []
    return [name for name, condition in boundary.conditions().items() if condition == "clamped"]


def _inflates(load: Any, shell: str, *, is_flat: bool) -> bool:
    """Return whether the load of a step blows up a shell: from inside, or a flat one at all.

    `shell` is its name among several, of which a load may press some alone; else "".
    """
    if load.kind != "pressure":
        return False
    faces = load.on or {}
    if shell and faces:
        if shell not in faces:
            return False
        faces = {shell: faces[shell]}
    pressures_from_inside = [-(load.pressure or 0.0), load.volume_change or 0.0]
    return is_flat or max(pressures_from_inside) > 0 or "inside" in faces.values()
