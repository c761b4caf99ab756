"""Joints: edges of shells that meet, joined rigidly, by a hinge, or by a spring, as creases are.

The vertices of both edges are glued, so that displacements agree. What is left is the energy of the
edge between two cells, which C0 interior penalty has on every one: of a rigid joint it is that, of
a hinge there is none, and of a spring it is (k/2) (theta - theta_0)^2 per undeformed length, with
the angle theta between the normals. docs/theory.md.

theta_0 is the angle at which a spring rests. It may grow with the amplitude (load parameter) of
creases, from the angle of the undeformed shells (0) to its own (1). Stiffnesses k are over E h R.
A density is an energy per area or length as a function of jets: maps with their derivatives at a
point. `plus` and `minus` are the two sides of an edge.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import inf, radians
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Section, or_number
from magshell_fenicsx.parts.ability import Account, Context, KeyAbility, Modelled
from magshell_fenicsx.parts.observables import Observables
from magshell_fenicsx.parts.path_step import FactorStep
from magshell_fenicsx.parts.step_course import StepCourse, Target
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

if TYPE_CHECKING:
    from dolfinx import fem

    from magshell_fenicsx.mesh.midsurface import Midsurface
    from magshell_fenicsx.models.axisymmetric.meridian import Meridian
    from magshell_fenicsx.models.shell.energy import Density
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.shape.outline import Outline

AMPLITUDE = "fold"  # a column of path.csv, which keeps the word
# of a spring over E h²/(12 (1 - ν²)), D/h: within 1e-6 of a rigid joint, and rounding costs as much
MAX_RELATIVE_STIFFNESS = 1e6


class JointSection(Section):
    """Two edges that meet, or an edge and the shell on which it is, joined."""

    edges: Annotated[list[str], Field(min_length=2, max_length=2)]
    """Both, each with the name of its shell, as [upper.rim, lower.rim]; of a T-junction, as
    [stiffener.foot, plate], the edge, then the shell on whose mid-surface it is"""
    kind: Literal["rigid", "hinge", "spring"] = "rigid"
    """The angle between the shells stays, is free, or has a spring"""
    stiffness: Annotated[float, or_number("newton"), Field(ge=0, le=1e30)] | None = None
    """Of kind: spring: moment per length and radian [force]"""
    angle: float | None = Field(default=None, ge=-179, le=179)
    """Of kind: spring: the angle at which it rests, from flat; positive where the shells are folded
    towards their normals. By default that of the shells where they are; else it grows from there
    before the load, or as a step of kind: crease [degree]"""

    @model_validator(mode="after")
    def _of_a_spring(self) -> Self:
        """Check that a spring has a stiffness, and other joints neither stiffness nor angle."""
        if (self.stiffness is not None) != (self.kind == "spring"):
            raise ValueError(
                "stiffness belongs to kind: spring, and must be given there; the kind is "
                f"{self.kind}"
            )
        if self.angle is not None and self.kind != "spring":
            raise ValueError(f"angle: belongs to kind: spring; the kind is {self.kind}")
        return self


Joints = Annotated[list[JointSection], Field(max_length=100)]


@dataclass(frozen=True)
class Joint:
    """A joint of two edges in a model.

    Attributes
    ----------
    edges
        Names of both edges.
    rigid
        Whether the edge is as one within a shell; else it is a spring or a hinge.
    stiffness
        Moment per length and radian over E h R; 0 of a hinge.
    angle
        Angle at which the spring rests (rad), from flat; None for that of the placement.
    """

    edges: tuple[str, str]
    rigid: bool
    stiffness: float = 0.0
    angle: float | None = None


class CaseJoints(KeyAbility[Sequence[JointSection]]):
    """All joints of a case."""

    key = "joints"

    def refuse_unfit(self, context: Context) -> None:
        """Check the joints of a case.

        Their edges must be of several shells, each joined once. Springs must not be too stiff.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """
        shells = context.sections.get("shells")
        if not shells:
            raise ValueError("joints: join edges of several shells: give shells")
        # raises if a part of the case excludes either of them
        context.needs("joints", "a mid-surface", "a material without viscosity")
        joined_edges = set[str]()
        for i, section in enumerate(self.sections):
            if section.stiffness:
                context.has_modulus(f"joints.{i}.stiffness")
                _refuse_too_stiff(i, section, context)
            _, other = section.edges
            if other in shells:  # an edge on another shell; else `other` is an edge too
                _refuse_unfit_t_junction(i, section, list(shells))
            # an edge may be joined once; on a shell several edges may be
            for name in section.edges:
                if name in shells:
                    continue
                if name in joined_edges:
                    raise ValueError(
                        f"joints.{i}: {name}: an edge that is joined twice; an edge joins one other"
                    )
                joined_edges.add(name)

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the planes that cross each joint: those that map each of its edges onto itself."""
        names = [name for section in self.sections for name in section.edges]
        return [
            SymmetryConstraint(
                mirrors=lambda mirror: all(mirror.image_of_edge(n) == n for n in names)
            )
        ]

    def contribution(self, context: Context, modelled: Modelled) -> "Loads":
        """Return the joints, with stiffnesses over E h R."""
        from magshell_fenicsx.parts.loads import Loads  # the solver takes long to import

        # a case without springs may have no units, hence no scales
        scales = context.scales if any(section.stiffness for section in self.sections) else None
        joints = list[Joint]()
        for section in self.sections:
            stiffness = 0.0
            if scales:
                stiffness = (section.stiffness or 0.0) / (scales.E * scales.h * scales.R)
            joints.append(
                Joint(
                    edges=(section.edges[0], section.edges[1]),
                    rigid=section.kind == "rigid",
                    stiffness=stiffness,
                    angle=None if section.angle is None else radians(section.angle),
                )
            )
        return Loads(joints=tuple(joints))


def _refuse_unfit_t_junction(number: int, section: JointSection, shells: Sequence[str]) -> None:
    """Refuse a T-junction, an edge on a shell, with an angle or on the shell of the edge itself.

    `number` is the position of the joint in `joints`, from 0, and `shells` are the names of all
    shells.

    Raises
    ------
    ValueError
        With the key and what is allowed.
    """
    edge, shell = section.edges
    if section.angle is not None:
        raise ValueError(
            f"joints.{number}.angle: of an edge on another shell the spring rests as it is "
            "placed: leave it out"
        )
    if edge.startswith(f"{shell}_"):
        others = ", ".join(sorted(set(shells) - {shell})) or "none"
        raise ValueError(
            f"joints.{number}: {shell}: is the shell of the edge itself, which joins nothing; "
            f"allowed: {others}"
        )


def _refuse_too_stiff(number: int, section: JointSection, context: Context) -> None:
    """Refuse a spring that is too stiff for rounding beside the softer of its two shells.

    `number` is the position of the joint in `joints`, from 0.

    Raises
    ------
    ValueError
        With the largest stiffness that is allowed.
    """
    # the least bending stiffness of both shells over the thickness, D/h = E h²/(12 (1 - ν²))
    shells, least_stiffness = context.sections["shells"], inf
    for edge in section.edges:
        shells_of_edge = [name for name in shells if edge == name or edge.startswith(f"{name}_")]
        if not shells_of_edge:
            continue
        # "a_b_rim" begins with the names of shells a and a_b: the longest name is the right one
        shell = shells[sorted(shells_of_edge, key=len)[-1]].shell
        thickness = shell.reference / shell.R_over_h
        stiffness_of_shell = (
            (shell.modulus or inf) * thickness**2 / (12 * (1 - shell.poisson_ratio**2))
        )
        least_stiffness = min(least_stiffness, stiffness_of_shell)
    stiffness = section.stiffness or 0.0
    if stiffness > MAX_RELATIVE_STIFFNESS * least_stiffness:
        raise ValueError(
            f"joints.{number}.stiffness: {stiffness:g}: is {stiffness / least_stiffness:.2g} "
            "times that of the shell over its thickness, E h²/(12 (1 - ν²)) = "
            f"{least_stiffness:.4g}; allowed up to {MAX_RELATIVE_STIFFNESS:g} times, "
            f"{MAX_RELATIVE_STIFFNESS * least_stiffness:.4g}: a joint so stiff is rigid, use "
            "kind: rigid"
        )


def _words(joint: Joint) -> str:
    """Return which edges a joint joins, and how."""
    kind = "rigidly" if joint.rigid else "by a hinge"
    if joint.stiffness:
        kind = f"by a spring, stiffness over E h R {joint.stiffness:.4g}"
    return f"{' and '.join(joint.edges)} joined {kind}"


class CreaseStep(FactorStep):
    """The angles at which springs of joints rest grow from those of the shells where they are (0)
    to their own (1). Older case files have `kind: fold` for it.
    """

    amplitude: ClassVar[str] = AMPLITUDE
    section: ClassVar[str] = "joints"
    rank_before_load: ClassVar[int] = 2
    targets: ClassVar[dict[str, Target]] = {"factor": Target("load", AMPLITUDE)}
    quantities: ClassVar[tuple[Quantity, ...]] = (
        Quantity(
            AMPLITUDE,
            "crease",
            "How far the rest angles of joints have grown to those of the case.",
            "load",
        ),
    )
    kind: Literal["crease"]
    factor: float | None = Field(default=None, ge=-1e3, le=1e3)
    """Target of the factor, 1 by default"""

    @classmethod
    def asked_for(cls, context: Context) -> bool:
        """Return whether a spring has an angle of its own."""
        return any(section.angle is not None for section in context.sections.get("joints") or ())

    def refuse_unfit(self, context: Context) -> None:
        if not self.asked_for(context):
            raise ValueError(f"{context.step.key}.kind: crease: needs a joint with an angle")

    def unstable_alone(self, value: float, course: StepCourse, what: str) -> str:
        return (
            f"the springs of joints alone make the shells unstable at {value:.9g} of their angles "
            f"({what}): to go on, take these as a load, kind: crease"
        )


class CreaseObservables(Observables):
    """The observable of creases: how far their angles have grown."""

    def account(self, context: Context, loads: "Loads") -> Account:
        """Return the lines of `magshell check` on joints: which edges are joined, and how."""
        return Account([_words(joint) for joint in loads.joints])

    def free_amplitudes(self, loads: "Loads") -> Mapping[str, float]:
        return {AMPLITUDE: 0.0} if any(joint.angle is not None for joint in loads.joints) else {}


@dataclass(frozen=True)
class Creases:
    """The edges between cells at which there are springs and hinges, as data of the densities.

    Attributes
    ----------
    marks
        (n,) in each cell, for n joints: 1 beside the joint's first edge, -1 beside the second, else
        0.
    stiffness
        (n,) moments per length and radian over E h R; 0 of a hinge.
    angle, has_angle
        (n,) angles (rad) at which springs rest, where `has_angle` is 1. Where it is 0, the angle is
        that of the placement.
    """

    marks: "fem.Function"
    stiffness: "fem.Constant"
    angle: "fem.Constant"
    has_angle: "fem.Constant"

    @classmethod
    def of_joints(
        cls, joints: Sequence[Joint], midsurface: "Midsurface | Meridian"
    ) -> "Creases | None":
        """Return the creases of joints on the cells of a mesh; None if all joints are rigid.

        Parameters
        ----------
        joints
            The joints of the model.
        midsurface
            The mesh of the surface or the meridian, with the sides of each joint in its cells.
        """
        import numpy as np
        from dolfinx import fem

        creases, marks_of_cells = list[Joint](), list[Any]()
        for joint, marks_of_joint in zip(joints, midsurface.joints, strict=True):
            # a rigid joint is an edge as any other, and a joint without marks is not on this mesh
            if not (joint.rigid or marks_of_joint is None):
                creases.append(joint)
                marks_of_cells.append(marks_of_joint)
        if not creases:
            return None
        count = len(creases)
        # a field with `count` numbers in each cell
        Q = fem.functionspace(midsurface.mesh, ("DG", 0, (count,)))
        marks = fem.Function(Q, name="joints")
        cells = Q.dofmap.list[:, 0]
        marks.x.array.reshape(-1, count)[cells] = np.column_stack(marks_of_cells)

        def constant(values: list[float]) -> fem.Constant:
            return fem.Constant(midsurface.mesh, np.array(values))

        return cls(
            marks,
            constant([joint.stiffness for joint in creases]),
            constant([joint.angle or 0.0 for joint in creases]),
            constant([float(joint.angle is not None) for joint in creases]),
        )

    @property
    def grow(self) -> bool:
        """Whether the rest angle of a spring grows with the amplitude of creases."""
        return bool(self.has_angle.value.any())

    def replace_at_joints(self, density: "Density", factor: "fem.Constant") -> "Density":
        """Return the density of edges between cells, with springs in its place at joints.

        The energy of a spring is (k/2) (theta - theta_0)^2 per undeformed length, with the angle
        theta between the normals.

        Parameters
        ----------
        density
            Energy density on edges between two cells.
        factor
            Amplitude by which the rest angles have grown, from the placement (0) to their own (1).
        """
        from magshell_fenicsx.models.shell import kinematics as kin
        from magshell_fenicsx.models.shell.edges import fold_angle

        count, grow = self.marks.ufl_shape[0], self.grow

        def with_springs(*arguments: Any, **options: Any) -> Any:
            """Return the density at an edge, with springs at the joints.

            The last five arguments are the marks on both sides of the edge, the three constants of
            the creases and the growth of the rest angles; all others are those of the density.
            """
            *edge_arguments, (plus, minus), k, angle, has_angle, growth = arguments
            # pairs, one for each side: jets of placement and displacement, and covectors m normal
            # to the edge in the reference plane
            r0, u, m = edge_arguments[:3]
            within_shell = density.function(*edge_arguments, **options)
            # undeformed length of the edge over that of the reference, a mean over both sides
            stretches = list[Any]()
            for jet, covector in zip(r0, m, strict=True):
                *_, stretch_of_side = kin.conormal(jet, covector)
                stretches.append(stretch_of_side)
            stretch = sum(stretches) / 2
            # sine and cosine of the angle between the normals: undeformed, and deformed
            undeformed = fold_angle(r0[0], r0[1], m[0])
            deformed = fold_angle(r0[0] + u[0], r0[1] + u[1], m[0])
            # sums over joints: of the energies of springs, and of 1 at a joint
            springs, is_joint = 0, 0
            for i in range(count):
                # 1 between the edges of joint i, where the marks are 1 and -1; 0 elsewhere
                product = plus[i] * minus[i]
                at_joint = product * (product - 1) / 2
                # the angle theta_0 at rest: that of the placement, or on the way to the spring's
                at_rest = undeformed
                if grow:
                    at_rest = _sine_and_cosine_at_rest(undeformed, angle[i], growth * has_angle[i])
                rotation = _angle_between(at_rest, deformed)  # theta - theta_0
                springs += at_joint * k[i] / 2 * rotation**2 * stretch
                is_joint += at_joint
            return (1 - is_joint) * within_shell + springs

        added = self.marks, self.stiffness, self.angle, self.has_angle, factor
        return replace(density, function=with_springs, parameters=(*density.parameters, *added))


def _angle_between(first: tuple[Any, Any], second: tuple[Any, Any]) -> Any:
    """Return the difference of two angles, the second less the first, as a UFL expression.

    Each is given by its sine and cosine, so that the difference has no jump at 180 degrees.
    """
    import ufl

    (first_sine, first_cosine), (sine, cosine) = first, second
    return ufl.atan2(
        sine * first_cosine - cosine * first_sine,
        cosine * first_cosine + sine * first_sine,
    )


def _sine_and_cosine_at_rest(undeformed: Any, angle: Any, growth: Any) -> tuple[Any, Any]:
    """Return sine and cosine of the angle at which a spring rests, as UFL expressions.

    Parameters
    ----------
    undeformed
        Sine and cosine of the angle of the placement.
    angle, growth
        The spring's own angle (rad), and how far the rest angle has grown to it, from 0 to 1.
    """
    import ufl

    angle_of_placement = ufl.atan2(undeformed[0], undeformed[1])
    rest_angle = angle_of_placement + growth * (angle - angle_of_placement)
    return ufl.sin(rest_angle), ufl.cos(rest_angle)
