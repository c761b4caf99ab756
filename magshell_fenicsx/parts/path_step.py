"""The base of the steps that follow a path: their controls, targets, and what comes after an
instability.

A step is a part of the load programme; a path is the sequence of equilibria that it follows. Its
amplitude is a load parameter; the conjugate is the displacement on which the amplitude does work. A
control says which of these, or arc length, is prescribed from point to point. A target is a value
at which the path ends, in the unit of its key; it is of the load or of the conjugate. A limit is
an instability. `LoadStart` has what the drive needs from the state where the step begins: the value
and the conjugate of its amplitude, and their units. A `Drive` says how the amplitude goes on from
there, a `StepCourse` also how the path ends.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

import numpy as np
from pydantic import Field, PrivateAttr, model_validator

from magshell_fenicsx.input.section import is_over_unit, over_unit
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.step import LEAST_TARGET, Step
from magshell_fenicsx.parts.step_course import (
    Control,
    Drive,
    LoadStart,
    Prescribed,
    SnapSection,
    StepCourse,
    StepEnd,
    StepStart,
    Target,
    Until,
)

Count = Annotated[
    int, Field(ge=1, le=10000, description="Equal parts to the target, each a row; or steps")
]


class PathStep(Step):
    """The base of loads that are followed along a path.

    Attributes
    ----------
    load_control, conjugate_control
        Names of the controls that prescribe the amplitude, and the conjugate displacement.
    divides_whole_way
        Whether the equal parts of the first way to a target begin at zero, not where the step does.
    """

    load_control: ClassVar[str] = "load"
    conjugate_control: ClassVar[str] = "displacement"
    divides_whole_way: ClassVar[bool] = True
    control: str
    until: Until
    points: Count = 10
    then: Literal["snap", "follow"] | None = None
    """What follows the instability that ends the step. `snap`, with `until: limit` or
    `bifurcation`: the shell is released, and moves under its loads and what else is held, damped as
    `snap` says, until it rests on the branch that it snaps to. `follow`, with `until: bifurcation`:
    the branch that begins there is followed, to a target that may stand here, or for `points`
    steps. A mode that a meridian or a half excludes takes the smallest model that has it: for m
    waves the sector of 180/m degrees between two mirror planes, else a half, else the whole shell.
    The next step goes on from there, in that model"""
    snap: SnapSection = SnapSection.model_construct()
    """How it is released"""
    branches: bool = False
    """Follow the branch at the first bifurcation too, to the target or for `points` steps: both
    directions of one that the model has itself; of a mode that it excludes one, in the smallest
    model that has it, and the other is the same shape, turned or mirrored"""
    sensitivities: bool = False
    """Derive the load at the fold that ends the path by all other amplitudes, the defect and each
    patch's remanence"""

    @model_validator(mode="before")
    @classmethod
    def _control_of_the_target(cls, data: Any) -> Any:
        """Choose the control of a step from its target, if the case gives none.

        A load as a target is reached by load control, where the default control prescribes its
        conjugate.
        """
        default = cls.model_fields["control"].default
        if not isinstance(data, dict) or "control" in data:
            return data
        if default != cls.conjugate_control:
            return data
        quantities = {
            target.quantity for key, target in cls.targets.items() if data.get(key) is not None
        }
        is_bound = _is_to_instability(data.get("until"), data.get("then"))
        control = "arc" if is_bound else "load"  # load control passes no fold
        return {**data, "control": control} if quantities == {"load"} else data

    @model_validator(mode="after")
    def _target_fits_control(self) -> Self:
        """Check that `until: target` has one target that fits the control, and other ends none.

        Exceptions are a bound beside an instability, and the target of a branch that is followed.
        """
        targets, prescribed = self._given_targets, self.prescribed
        # keys of targets that the control reaches: arc length those of the load and of the
        # conjugate, other controls those of the quantity that they prescribe
        fitting = [
            key for key, target in self.targets.items() if prescribed in ("arc", target.quantity)
        ]
        for key, value in targets.items():
            if 0 < abs(value) < LEAST_TARGET:
                raise ValueError(
                    f"{key} is a target and must be zero, or at least {LEAST_TARGET:g} in size"
                )
        # until: target needs one target that fits; a step with a default target, `_end`, needs none
        has_default_alone = not targets and bool(self._end)
        has_one_target = len(targets) == 1 or has_default_alone
        targets_fit = has_one_target and set(targets) <= set(fitting)
        if self.until == "target" and not targets_fit:
            names = " or ".join(fitting) or "another control"
            raise ValueError(
                f"until: target with control: {self.control} needs {names} (and nothing else) as "
                f"target; control: arc takes {' or '.join(self.targets)}"
            )
        # a followed branch may have one target; beside other ends a target is refused or a bound
        follows_branch = self.until == "bifurcation" and self.then == "follow"
        if follows_branch and len(targets) > 1:
            raise ValueError(f"{' and '.join(targets)}: a branch has one target")
        if self.until == "zero" and targets:
            raise ValueError(f"{next(iter(targets))} is a target: it goes with until: target")
        if _is_to_instability(self.until, self.then) and targets:
            self._refuse_unfit_bound(list(targets), fitting)
        self._refuse_unfit_end()
        return self

    def _refuse_unfit_end(self) -> None:
        """Check that the control fits the end of the path, and what follows it fits the end."""
        # ends that need arc length
        if self.until in ("points", "zero") and self.prescribed != "arc":
            why = (
                "counts steps by arc length"
                if self.until == "points"
                else "passes the largest load"
            )
            raise ValueError(f"until: {self.until} {why}: it goes with control: arc")
        # what follows an instability needs one
        if self.then == "snap" and self.until not in ("limit", "bifurcation"):
            raise ValueError("then: snap: goes with until: limit or until: bifurcation")
        if self.then == "follow" and self.until != "bifurcation":
            raise ValueError("then: follow: goes with until: bifurcation")
        if self.snap != SnapSection() and self.then != "snap":
            raise ValueError("snap: goes with then: snap")

    def _refuse_unfit_bound(self, targets: list[str], fitting: list[str]) -> None:
        """Check the target beside `until: limit` or `bifurcation`: the end of the path.

        Parameters
        ----------
        targets
            The keys of targets that the case gives.
        fitting
            The keys of targets that fit the control.
        """
        if "until" not in self.model_fields_set:  # limit is the default of this kind of step
            raise ValueError(
                f"{targets[0]} is a target: it goes with until: target; or write until: limit, "
                "for the first instability on the way there"
            )
        has_fitting_target = len(targets) == 1 and targets[0] in fitting
        if self.prescribed == "load" or not has_fitting_target:
            raise ValueError(
                f"{' and '.join(targets)}: beside until: {self.until} stands one target, the end "
                "of the way, with control: arc"
            )

    @classmethod
    def history_value(cls, text: str, context: Context) -> float:
        """Return a value of a history with a unit, converted as a target of the load."""
        # the type of the key of a load's target says how text with a unit is converted
        for key in (key for key, target in cls.targets.items() if target.quantity == "load"):
            annotation = cls.model_fields[key].annotation
            if is_over_unit(annotation):
                return over_unit(annotation, text, context.shell)
        return super().history_value(text, context)

    @property
    def end(self) -> StepEnd:
        return StepEnd(
            until=self.until,
            target=self._target,
            bound=self._bound,
            controls_conjugate=self.control == self.conjugate_control,
            snap=self.snap if self.then == "snap" else None,
            follows_branch=self.then == "follow",
            branch_points=self.points if self.branches else 0,
            sensitivities=self.sensitivities,
        )

    @property
    def _given_targets(self) -> dict[str, float]:
        """Mapping: key of each target that the case gives -> its value, or the square of that."""
        given = {key: value for key in self.targets if (value := getattr(self, key)) is not None}
        return {
            key: value**2 if self.targets[key].squared else value for key, value in given.items()
        }

    @property
    def _end(self) -> float | None:
        """The target that counts if no key gives one; None without."""
        return None

    @property
    def prescribed(self) -> Control:
        """The quantity that the solver prescribes step by step: load, conjugate or arc length."""
        if self.control == self.conjugate_control:
            return "conjugate"
        return "load" if self.control == self.load_control else "arc"

    @property
    def _target(self) -> tuple[Target, float] | None:
        """The target at which the path ends, and its value in the unit of its key; None without.

        A target beside an instability does not count here: it is a bound.
        """
        if self._bound:
            return None
        for key, value in self._given_targets.items():
            return self.targets[key], value
        if self._end is None or self.until != "target":
            return None
        return next(iter(self.targets.values())), self._end

    @property
    def _bound(self) -> tuple[Target, float] | None:
        """The latest end of a path to an instability, and its direction; None without."""
        if not _is_to_instability(self.until, self.then):
            return None
        return next(
            ((self.targets[key], value) for key, value in self._given_targets.items()), None
        )

    def first_change(self, change: float, load_start: LoadStart, *, by_load: bool) -> float:
        """Return the change of the amplitude in the first step of a path.

        By default it is the change up to the target, divided into `points` equal parts.

        Parameters
        ----------
        change
            Change from the begin of the path to its target. Without a target it is the size of the
            load.
        load_start
            The amplitude where the step begins.
        by_load
            Whether `change` is a change of the amplitude; else it is one of the conjugate.
        """
        return change / self.points

    def step(self, change: float | None, load_start: LoadStart) -> float | None:
        """Return the first step of the conjugate, where that is prescribed.

        None if `first_change`, of the amplitude, says how the path begins. `change` is that of the
        conjugate from the begin to the target; None without a target.
        """
        return None

    def drive(self, load_start: LoadStart) -> Drive:
        """Return how the step drives its amplitude from its begin.

        The targets divide the way into equal parts. The way begins at zero if the amplitude is
        driven for the first time; targets that earlier steps have passed are left out.
        """
        # the end of the path: a target or bound, with its value in the unit of its key; it is of
        # the load (`by_load`), the amplitude, or of its conjugate
        goal = self._target or self._bound
        quantity: Prescribed = goal[0].quantity if goal else "load"
        by_load = quantity == "load"
        begin_value = load_start.value if by_load else load_start.conjugate
        end = None if goal is None else goal[1] * (load_start.size if by_load else load_start.unit)
        change = load_start.size if end is None else end - begin_value
        # values at which the path must have a point: ahead of the begin, in the direction of change
        targets: list[float] = []
        goes_to_end = self.until == "target" or self._bound is not None
        if end is not None and goes_to_end:
            divides_whole_way = self.divides_whole_way and not load_start.is_driven
            begin = 0.0 if divides_whole_way else begin_value
            targets = [float(t) for t in np.linspace(begin, end, self.points + 1)[1:]]
            targets = [t for t in targets if (t - begin_value) * change > 0]
        if self.until == "zero":  # back to the load zero, past the largest load
            targets = [0.0]
        # how it begins
        first_change = self.first_change(change, load_start, by_load=by_load)
        first_step = self.step(None if goal is None else change, load_start)
        return Drive(
            control=self.prescribed,
            quantity=quantity,
            end=end,
            targets=targets,
            first=first_change,
            scale=self.scale(load_start),
            step=first_step,
        )

    def course(self, step_start: StepStart) -> StepCourse:
        """Return how the step follows its path from the state where it begins."""
        until = "target" if self.until == "zero" else self.until
        steps = self.points if until == "points" else None
        return StepCourse(self.drive(step_start.load_start()), until, steps)

    def scale(self, load_start: LoadStart) -> float:
        """Return a value of the amplitude that counts as of order one in the arc length."""
        return 1.0


def _is_to_instability(until: str | None, then: str | None) -> bool:
    """Return whether a path ends at an instability, and its target is the end of the way there.

    A target beside a branch that is followed is the end of the branch.
    """
    return until == "limit" or (until == "bifurcation" and then != "follow")


class LoadStep(PathStep):
    """The base of loads that the amplitude or the arc length leads to their target.

    No displacement is prescribed.
    """

    control: Literal["load", "arc"] = "arc"
    """What is prescribed step by step: the load's amplitude, or arc length, which passes every
    fold"""
    until: Until = "target"


class BodyForceStep(LoadStep):
    """The base of forces by the shell's own mass, in E/R: those of the order of h² bend it."""

    def first_change(self, change: float, load_start: LoadStart, *, by_load: bool) -> float:
        return change / self.points if self.end.goal else load_start.h**2

    def scale(self, load_start: LoadStart) -> float:
        goal = self.end.goal
        return abs(goal[1]) or load_start.h**2 if goal else load_start.h**2


class FactorStep(LoadStep):
    """The base of what grows to a factor, 1 by default.

    Where no step drives it, it grows before the one load of a case, up to the first instability at
    most.

    Attributes
    ----------
    section
        Key of the case that asks for it.
    label
        Of its points before the load, see `StepCourse`.
    """

    section: ClassVar[str]
    label: ClassVar[Literal["", "field"]] = ""
    # whether the program has put the step before the load, which the case alone gives
    _alone: bool = PrivateAttr(default=False)

    @property
    def _end(self) -> float | None:
        return 1.0

    @classmethod
    def asked_for(cls, context: Context) -> bool:
        """Return whether the case asks for the growth by a section or a key of it."""
        raise NotImplementedError

    @classmethod
    def strength(cls, context: Context) -> float | None:
        """Return the amplitude at a factor of one if a section gives it; None if it is 1.

        Cases that differ by it alone have one model.
        """
        return None

    @classmethod
    def steps_before_load(cls, context: Context) -> list[tuple[str, Step]]:
        """Return the step that lets the factor grow to 1 before the only load of a case.

        Empty if the case does not ask for it.
        """
        if not cls.asked_for(context):
            return []
        (kind,) = get_args(cls.model_fields["kind"].annotation)  # the one word of its Literal
        step = cls.model_validate({"kind": kind})
        step._alone = True
        return [(cls.section, step)]

    def course(self, step_start: StepStart) -> StepCourse:
        """Return the course of the step.

        Before the load the factor grows by arc length, with a first step of half the way, and there
        must be no instability on the way.
        """
        course = super().course(step_start)
        if not self._alone:
            return course
        size = step_start.size  # the amplitude at a factor of one
        drive = Drive("arc", "load", end=size, targets=[size], first=size / 2, scale=size)
        course = replace(course, drive=drive)

        def forbidden(mu: Mapping[str, float], what: str) -> str:
            """Return the message about an instability, at amplitudes `mu`, with its name."""
            return self.unstable_alone(mu[self.amplitude], course, what)

        return replace(course, until="limit", forbidden=forbidden, label=self.label)

    def unstable_alone(self, value: float, course: StepCourse, what: str) -> str:
        """Return the message about an instability during the growth before the load.

        Parameters
        ----------
        value
            The amplitude at the instability.
        course
            The course of the step.
        what
            Name of the instability.
        """
        raise NotImplementedError
