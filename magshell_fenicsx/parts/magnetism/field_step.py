"""The applied magnetic field as a load: steps that change its strength or its direction.

- The strength of the field along its first direction is an amplitude (load parameter). A uniform
  field that turns has further amplitudes, one for each direction normal to the first; mu holds all
  amplitudes by name. Curves give the amplitudes as functions of one parameter.
- A programme is a list of steps; a step's course says how it goes on from its begin.
- A field in space (of sources, formulas or a gradient) has one strength and turns as a whole.
- The conjugate of an amplitude is the displacement on which it does work; the field has none.
- `turn` is the angle (rad) about e3 by which the model's frame is turned.
"""

from collections.abc import Mapping
from dataclasses import replace
from math import acos, degrees
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.section import Direction, in_units
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.magnetism.fields import ANGLE, FIELD, MagneticSection, strength
from magshell_fenicsx.parts.path_step import FactorStep
from magshell_fenicsx.parts.step import ProgrammeStep, Step
from magshell_fenicsx.parts.step_course import (
    Drive,
    ExpectedEnd,
    LoadStart,
    StepCourse,
    StepStart,
    Target,
)
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
EQUALITY_TOLERANCE = 1e-9  # cosine of directions: rounding


class FieldSection(FactorStep):
    """The field itself is the load: lambda_m from zero, with its instabilities located.

    `until: target` ends at the field of `magnetic` or its `factor`, the others go on in its
    direction. By default the path is followed by arc length, through folds of lambda_m.
    """

    amplitude: ClassVar[str] = FIELD.name
    section: ClassVar[str] = "magnetic"
    label: ClassVar[Literal["", "field"]] = "field"
    rank_before_load: ClassVar[int] = 4
    targets: ClassVar[dict[str, Target]] = {"factor": Target("load", FIELD.column)}
    kind: Literal["field"]
    factor: float | None = Field(default=None, ge=-1e3, le=1e3)
    """Target over the field of `magnetic`; 1 by default, 0 switches the field off"""

    def scale(self, load_start: LoadStart) -> float:
        """Return the strength of the case: it counts as of order one in the arc length."""
        return load_start.size

    @classmethod
    def history_value(cls, text: str, context: Context) -> float:
        """Return a flux density as a factor of that of `magnetic.applied`.

        `text` is a number with a unit, a value of a load as a function of time.

        Raises
        ------
        ValueError
            If the case has no `magnetic.applied.flux_density`.
        """
        magnetic = context.section_of(MagneticSection)
        if magnetic is None or not magnetic.applied.flux_density:
            raise ValueError("needs magnetic.applied.flux_density")
        return float(in_units("tesla")(text)) / magnetic.applied.flux_density

    def course(self, step_start: StepStart) -> StepCourse:
        """Return the course of the step, along the present direction of the field.

        Beside its first direction, the course has curves of the field's components, as functions of
        the strength along the present one. The field has no conjugate displacement.
        """
        from magshell_fenicsx.parts.magnetism.direction import (
            straight,
        )  # the solver takes long to import

        def zero_conjugate(name: str) -> float:
            """Return the conjugate of the field, and its unit."""
            return 0.0

        direction, value = self._direction_and_value(step_start)
        along_direction = replace(
            step_start,
            mu={**step_start.mu, step_start.step.name: value},
            potential=zero_conjugate,
            unit=zero_conjugate,
            size=strength(step_start.context),
        )
        course = super().course(along_direction)
        return (
            replace(course, curves=(straight(direction), value)) if direction[1:].any() else course
        )

    def expected_end(self, context: Context, loads: "Loads", turn: float) -> ExpectedEnd | None:
        """Return the field at the target; None without a target."""
        target = self.end.target if self.until == "target" else None
        return ExpectedEnd("", target[1] * strength(context)) if target else None

    def _direction_and_value(self, step_start: StepStart) -> tuple[Array, float]:
        """Return the field's direction at the begin of the step, and its strength there.

        The direction is an array of components, one for each amplitude of the field that exists:
        along its first direction, then those across it. A field in space has the component 1.
        """
        from magshell_fenicsx.parts.magnetism.direction import components, directions, field_at

        field = step_start.loads.magnetic
        all_directions = directions(step_start.context.steps, field, step_start.turn)
        present_direction = all_directions[step_start.step.number - 1]  # steps count from 1
        direction = components(present_direction, field)
        return direction, float(direction @ field_at(step_start.mu))

    @classmethod
    def strength(cls, context: Context) -> float | None:
        """Return the strength of the case's field, which may be 0; None without its section."""
        return strength(context) if context.section_of(MagneticSection) else None

    @classmethod
    def asked_for(cls, context: Context) -> bool:
        """Return whether the case has a field."""
        return bool(strength(context))

    def refuse_unfit(self, context: Context) -> None:
        """Refuse a step without a field."""
        if not strength(context):
            magnetic = context.section_of(MagneticSection)
            in_tesla = magnetic is not None and magnetic.lambda_m is None
            key = "magnetic.applied.flux_density" if in_tesla else "magnetic.lambda_m"
            raise ValueError(
                f"{context.step.key}.kind: field needs {key}, not zero, for its target or direction"
            )

    def unstable_alone(self, value: float, course: StepCourse, what: str) -> str:
        """Tell the user that the field alone makes the shell unstable, at lambda_m = `value`."""
        return (
            f"the field alone makes the shell unstable: critical field lambda_m = {value:.9g} of "
            f"{course.drive.end or 0.0:g} ({what})"
        )


class RotationSection(Step):
    """The applied field, at its magnitude, turns on the shortest way to another direction.

    The requested points are equal angles apart; the field keeps its magnitude. A gradient, formulas
    and sources turn with it, about the origin; the direction of formulas, and of sources that are
    the whole field, is e3 at first.
    """

    amplitude: ClassVar[str] = ANGLE
    holdable: ClassVar[bool] = False
    alters: ClassVar[tuple[str, ...]] = (FIELD.name, *FIELD.components)
    kind: Literal["rotation"]
    to: Direction
    """Its last direction"""
    points: Annotated[int, Field(ge=1, le=10000)] = 12
    """Equal angles to it"""

    def refuse_unfit(self, context: Context) -> None:
        """Check that there is a field before the step, which it can turn to its direction.

        Raises
        ------
        ValueError
            If there is none, or if the direction is parallel or opposite to it.
        """
        start = direction_before(context.step.number, context)
        if start is None or not strength(context):
            raise ValueError(
                f"{context.step.key}.kind: rotation needs a field: magnetic.lambda_m, not zero"
            )
        driven_amplitudes = context.driven_before(context.step.number)
        if context.is_programme and FieldSection.amplitude not in driven_amplitudes:
            raise ValueError(
                f"{context.step.key}.kind: rotation needs a field: a step of kind: field before it"
            )
        if abs(start @ self.to.vector()) > 1 - EQUALITY_TOLERANCE:
            subject = (
                "the field at its beginning"
                if self.amplitude in driven_amplitudes
                else "magnetic.applied"
            )
            raise ValueError(
                f"{context.step.key}.to: must be neither parallel nor opposite to {subject}"
            )

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the constraint that a plane contains the last direction of the field."""
        return [SymmetryConstraint("the field turns", [self.to.vector()])]

    def course(self, step_start: StepStart) -> StepCourse:
        """Return how the step goes on: the field turns to its last direction at constant magnitude.

        The path is followed by arc length along curves of the field's components, whose parameter
        is the angle (rad) from the begin of the step. The course is impossible if the field is
        zero.
        """
        from magshell_fenicsx.parts.magnetism import direction  # the solver takes long to import

        field, number = step_start.loads.magnetic, step_start.step.number
        # unit vectors before and after the step, in space and by components for the amplitudes
        all_directions = direction.directions(step_start.context.steps, field, step_start.turn)
        start_vector, end_vector = all_directions[number - 1 : number + 1]
        start = direction.components(start_vector, field)
        end = direction.components(end_vector, field)
        size = float(start @ direction.field_at(step_start.mu))  # signed magnitude of the field
        total = acos(float(start_vector @ end_vector))
        # the requested angles, without that of the begin of the step
        targets = [float(t) for t in np.linspace(0.0, total, self.points + 1)[1:]]
        drive = Drive(
            control="arc",
            quantity="load",
            end=total,
            targets=targets,
            first=total / self.points,
            scale=total / self.points,
        )
        if size == 0:
            return StepCourse(drive, "limit", impossible="the field is zero and cannot turn")

        def forbidden(mu: Mapping[str, float], what: str) -> str:
            """Tell the user at which angle the shell gets unstable, by the instability `what`."""
            angle = direction.field_angle(mu, field) % 360
            return f"the turning field makes the shell unstable at {angle:.4g} degrees: {what}"

        # a field in space turns by one amplitude, a uniform one by all components along a circle
        rotates_as_whole = field and field.turns
        curves = (
            direction.as_a_whole(turn_name(step_start.step), total)
            if rotates_as_whole
            else direction.circle(size, start, end)
        )
        return StepCourse(drive, "limit", curves=(curves, 0.0), forbidden=forbidden, at_once=True)

    def expected_end(self, context: Context, loads: "Loads", turn: float) -> ExpectedEnd:
        """Return the expected end of the step, in words and as an angle (degrees).

        The angle is counted from the first direction of the field. It is None if the step does not
        begin there: the angle that is reported is then not the one by which the step turns.
        """
        from magshell_fenicsx.parts.magnetism.direction import (
            directions,
        )  # the solver takes long to import

        # before each step and after the last one: at the begin of the programme and of the step,
        # and at the end of the step
        all_directions = directions(context.steps, loads.magnetic, turn)
        first, start, end = (
            all_directions[i] for i in (0, context.step.number - 1, context.step.number)
        )
        angle = degrees(acos(float(np.clip(end @ first, -1, 1))))
        return ExpectedEnd(
            "its last direction", angle if start @ first > 1 - EQUALITY_TOLERANCE else None
        )


def turn_name(step: ProgrammeStep) -> str:
    """Return the name of the amplitude by which a step of kind `rotation` turns a field in space.

    It is the step's name and number. The space in it keeps it apart from names of users.
    """
    return f"{step.name} {step.number}"


def direction_before(number: int, context: Context) -> NDArray[np.float64] | None:
    """Return the unit vector (3,) of the field where step `number` begins; None without a field."""
    rotated_to = [
        step.load.to
        for step in context.steps_before(number)
        if isinstance(step.load, RotationSection)
    ]
    if rotated_to:
        return rotated_to[-1].vector()
    magnetic = context.section_of(MagneticSection)
    return magnetic.applied.vector() if magnetic else None
