"""A step in time: the shell moves, with inertia, under loads that are functions of time.

A step of a case drives one amplitude, a load parameter by name; a step in time drives those that
have a history here, and the time. A history is a load's values over the time of the step. To hold
an amplitude is to keep the load, or the displacement on which it does work, constant. An ability is
what a section of the case adds to a problem; some say what their load does in a step in time. A
context is the case around a section, an outline the undeformed shell, e3 the axis.
"""

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self, TypeAlias

from pydantic import Field, model_validator

from magshell_fenicsx.input.expressions import Formula
from magshell_fenicsx.input.section import Section, in_units
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.motion.history import (
    History,
    Level,
    Time,
    levels_of,
    measured,
    times_of,
)
from magshell_fenicsx.parts.step import BALANCE, Step
from magshell_fenicsx.parts.step_course import Errors, ExpectedEnd, StepEnd
from magshell_fenicsx.quantities.quantity import Amplitude
from magshell_fenicsx.quantities.registry import AMPLITUDES, amplitude
from magshell_fenicsx.shape.field_symmetry import formula_field, is_axisymmetric, is_mirror_image
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.shape.outline import Outline

Rate: TypeAlias = measured("1/second")  # type: ignore[valid-type]


class PushSection(Section):
    """The shell leaves its state along a natural mode of the model's own symmetry, with a largest
    component of one.
    """

    mode: int = Field(default=1, ge=1, le=50)
    """Number of the mode, from the lowest frequency"""
    displacement: float = Field(default=0.0, ge=-1e3, le=1e3)
    """Displacement, inward at the pole or the first named point [h]"""
    velocity: float = Field(default=0.0, ge=-1e9, le=1e9)
    """Velocity, likewise, per unit of time [h]"""


class EventSection(Section):
    """A column of path.csv that comes to a value."""

    column: str
    """Its name, such as w_over_h, w_mm or middle_uz"""
    value: float
    """In the column's unit"""


class TimeSection(Step):
    """The shell moves for a time, from the state before; loads follow their `history`, all others
    are constant.

    Times are text with a unit, or numbers: with `shell.density` in the unit of time of the case
    (seconds), else over R √(ρ/E). Generalised alpha, second order, with steps for `tolerance`.
    """

    amplitude: ClassVar[str] = "time"
    kind: Literal["time"]
    duration: Time
    """How long"""
    points: Annotated[int, Field(ge=1, le=100000)] = 100
    """Equal parts of the duration, each a row"""
    history: dict[str, History] = Field(default_factory=dict)
    """Load -> its values over the time of the step: `field` (over that of `magnetic`, or as a flux
    density), `pressure` (over p_c, or as 400 Pa), `interaction` (its factor), or the amplitude of
    another step, as its target: a ramp, step, triangle or sine, a table [[time, value], ...] with
    straight lines and jumps, or a formula of the time t without units"""
    rho_inf: float = Field(default=0.8, ge=0, le=1)
    """Factor by which the highest frequencies fade at each step; 1 conserves energy"""
    step: Time | None = None
    """Fixed time step; by default steps follow from `tolerance`"""
    tolerance: float = Field(default=1e-3, ge=1e-9, le=1)
    """Largest estimated error of what `errors` names [h]"""
    errors: Errors = "step"
    """Of each time step, or of the motion at all rows (column error_over_h): then it is rehearsed
    with longer steps, which takes several times as long; a snap magnifies the errors of steps"""
    balance: float = Field(default=BALANCE, ge=1e-9, le=1)
    """Largest error of the balance of energy (column imbalance), over kinetic + stored + dissipated
    + work; beside a body a time step with more than its share is repeated with a smaller one,
    unless `step` is given; a run warns where it is larger"""
    drag: Rate = 0.0
    """Force over mass and velocity; free vibrations fade at half of it [per unit of time; 20 Hz is
    20 per second]"""
    push: PushSection | None = None
    """How it begins to move"""
    velocity: Annotated[list[Formula], Field(min_length=3, max_length=3)] | None = None
    """Initial velocity along e1, e2, e3, added: formulas of the undeformed place x, y, z in the
    length of the shell, over R if that has no unit [the same length per unit of time]"""
    until: Literal["duration", "rest", "event", "instability"] = "duration"
    """At the end of the duration; as soon as the shell rests: then its equilibrium is the last row;
    at the `event`; or at the first row at which the shell has an unstable direction"""
    event: EventSection | None = None
    """What ends the step with `until: event`"""

    @model_validator(mode="after")
    def _keys_fit(self) -> Self:
        """Check that the keys of the step go together, and that its times are positive.

        Histories that do not jump need positive times; those of a table must not fall.
        """
        for name, quantity in self.hold.items():
            if quantity != "load" and name in self.drives:
                raise ValueError(f"hold.{name}: it follows its history: only load is allowed")
        if (self.event is None) == (self.until == "event"):
            raise ValueError("event: goes with until: event, which needs one")
        if self.search:
            raise ValueError("search: is for steps that end in equilibrium")
        for key, value in (("duration", self.duration), ("step", self.step), ("drag", self.drag)):
            if value is None:  # not given
                continue
            number = in_units("1/second" if key == "drag" else "second")(value)
            is_too_small = number < 0 if key == "drag" else number <= 0
            if is_too_small:
                raise ValueError(f"{key}: {value}: must be positive")
        for name, history in self.history.items():
            times = [float(in_units("second")(t)) for t in times_of(history)]
            if isinstance(history, list):
                if times[0] < 0 or times != sorted(times):
                    raise ValueError(
                        f"history.{name}: the times of a table must not fall, nor be negative"
                    )
                continue
            # a jump may be at time zero, but the length of a ramp and the period of a wave are
            # positive; a formula has no times
            jumps, least_time = getattr(history, "kind", "") == "step", min(times, default=1.0)
            is_too_early = least_time < 0 if jumps else least_time <= 0
            if is_too_early:
                raise ValueError(f"history.{name}: times must be positive")
        return self

    @property
    def drives(self) -> tuple[str, ...]:
        """The amplitudes that follow histories."""
        amplitudes = _amplitudes_of_histories()
        return tuple(amplitudes[name].name if name in amplitudes else name for name in self.history)

    def expected_end(self, context: Context, loads: "Loads", turn: float) -> ExpectedEnd:
        """Return the end of the step in words, after its number of rows."""
        return ExpectedEnd("the end", steps=self.points)

    @property
    def end(self) -> StepEnd:
        return StepEnd(at_rest=self.until == "rest")

    @property
    def needs_inertia_alone(self) -> bool:
        """Whether the step needs neither an equilibrium nor a mode: then the shell may be free."""
        needs_equilibrium_or_mode = self.push is not None or bool(self.hold)
        return self.until in ("duration", "event") and not needs_equilibrium_or_mode

    def refuse_unfit(self, context: Context) -> None:
        """Check that the case has the loads whose histories the step gives, in units that it knows.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """
        from magshell_fenicsx.parts.registered import section_of_strength  # it has this step too

        key = context.step.key
        driven_before = context.driven_before(context.step.number)
        turned_loads = {amplitude(name).turned_load for name in driven_before}
        for name, field in _amplitudes_of_histories().items():
            if name not in self.history:
                continue
            # a field has its first direction, and a strength
            if not context.strengths.get(field.name):
                section = section_of_strength(field.name)
                raise ValueError(f"{key}.history.{name}: needs {section}.{field.name}, not zero")
            if field.name in turned_loads:
                raise ValueError(f"{key}.history.{name}: not after kind: rotation")
        # times with units need a case that has units
        for time_key, text in self.with_units():
            if context.time_unit is None or not context.shell.with_units:
                raise ValueError(
                    f"{key}.{time_key}: {text}: a time with a unit needs shell.density, "
                    "youngs_modulus and lengths"
                )
        self._refuse_unfit_histories(key, context)

    def _refuse_unfit_histories(self, key: str, context: Context) -> None:
        """Check that each history is of a load of the case, in units that this load knows.

        Also, a load that cannot jump must not have a history with jumps. `key` is that of the step.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """
        # loads that may have a history: of steps, and of sections without a step. Fields have
        # another name here than their amplitude; angle and time follow from steps of their own
        loads = {case_step.name: case_step.load for case_step in context.steps}
        section_amplitudes = _factors_of_sections(context)
        fields = _amplitudes_of_histories()
        allowed = {*fields, "pressure", *section_amplitudes, *loads}
        allowed -= {*(field.name for field in fields.values()), "angle", "time"}
        for name, history in self.history.items():
            if name not in allowed:
                raise ValueError(
                    f"{key}.history.{name}: no such load; allowed: {', '.join(sorted(allowed))}"
                )
            times = [t for t, _ in history] if isinstance(history, list) else []
            # two rows of a table at one time are a jump
            jumps = getattr(history, "kind", "") == "step" or len(set(times)) < len(times)
            load = loads.get(name)
            cannot_jump = load is not None and not load.jumps
            if jumps and cannot_jump:
                raise ValueError(f"{key}.history.{name}: a support cannot jump")
            # values must have a unit that the load knows
            for level in levels_of(history):
                try:
                    level_in(context, name, level)
                except ValueError as e:
                    raise ValueError(f"{key}.history.{name}: {level}: {e}") from None

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry that the initial velocity preserves; all without one."""
        if not self.velocity:
            return []
        velocity = formula_field(self.velocity, context.shell.reference)
        is_same_around = is_axisymmetric(velocity, outline.meridian)
        return [
            SymmetryConstraint(
                None if is_same_around else "the initial velocity differs around e3",
                mirrors=lambda mirror: is_mirror_image(velocity, mirror, outline.sample()),
            )
        ]

    def with_units(self) -> Iterator[tuple[str, str]]:
        """Yield (key below the step, text) for each time or rate that has a unit."""
        times: dict[str, Any] = {"duration": self.duration, "step": self.step, "drag": self.drag}
        # several times of one history would have one key: a number after a space tells them apart
        for name, history in self.history.items():
            times |= {f"history.{name} {i}": t for i, t in enumerate(times_of(history))}
        yield from (
            (key.split(" ")[0], value) for key, value in times.items() if isinstance(value, str)
        )


def _amplitudes_of_histories() -> dict[str, Amplitude]:
    """Return name in histories -> amplitude, of fields, whose amplitude has another name."""
    return {a.history_name: a for a in AMPLITUDES.values() if a.history_name}


def _factors_of_sections(context: Context) -> set[str]:
    """Return amplitudes that sections of the case ask for, such as "interaction".

    They grow to a factor without a step of the programme.
    """
    from magshell_fenicsx.parts.registered import FACTOR_STEPS  # which has this step too

    return {step_class.amplitude for step_class in FACTOR_STEPS if step_class.asked_for(context)}


def level_in(context: Context, name: str, level: Level) -> float:
    """Return a value of a load's history as a number, as a target of that load would be.

    Parameters
    ----------
    name
        Name of the load's amplitude.
    level
        A number, or text with a unit.

    Raises
    ------
    ValueError
        If the load has no such unit in this case.
    """
    from magshell_fenicsx.parts.registered import step_class_of  # which has this step too

    if not isinstance(level, str):
        return level
    # units are known to the kind of the load's step: of the step that the case has, else by name
    step_kind = next((type(step.load) for step in context.steps if step.name == name), None)
    return (step_kind or step_class_of(name)).history_value(level, context)
