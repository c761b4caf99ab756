"""The step `kind: contact`: a rigid body that presses on the shell, and its observables.

A step of a case drives one amplitude, a load parameter by name: here the approach, the displacement
of a body along its direction over h. Its conjugate -dPi/da, with the energy Pi, is minus the force
on the body. mu holds the amplitudes of a state. An observable is a column of results that is read
from a state; a view is a model with the units in which it is reported.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from math import copysign
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from pydantic import Field

from magshell_fenicsx.input.section import Name, over_size
from magshell_fenicsx.parts.ability import Account, Context
from magshell_fenicsx.parts.observables import ModelView, Observables
from magshell_fenicsx.parts.path_step import Count, PathStep
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.parts.step_course import (
    LoadStart,
    StepCourse,
    StepStart,
    Target,
    Until,
)
from magshell_fenicsx.quantities.quantity import (
    CONTACT_PRESSURE,
    PLACE,
    POINT_FORCE,
    THICKNESS,
    Amplitude,
    Quantity,
)

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.point import StepOptions
    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.parts.loads import Loads

# of a path along a contact: folds are as sharp as the penalty's stiffness changes, over 1e-3 h
SMALLEST_STEP = 1e-9
# matrices of a step along a contact, whose rim moves from point to point before it settles
EASY_ITERATIONS, HARD_ITERATIONS = 4, 8
FIRST_APPROACH = 0.1  # over h: the first step towards a force
PRESSURE_MAX = "contact_pressure_max"  # column of path.csv, and the begin of others


class ContactSection(PathStep):
    """A body of `bodies` that approaches the shell along its direction, without friction.

    The conjugate of the approach is the force on the body. Free flight up to the first contact is
    one step.
    """

    conjugate: ClassVar[str] = "force on the body"
    load_control: ClassVar[str] = "approach"
    conjugate_control: ClassVar[str] = "force"
    touches: ClassVar[bool] = True
    targets: ClassVar[dict[str, Target]] = {
        "approach": Target("load", "approach_over_h"),
        "force": Target("conjugate", "force"),
    }
    kind: Literal["contact"]
    body: Name | None = None
    """Its name in `bodies`; not needed if there is one"""
    control: Literal["approach", "force", "arc"] = "arc"
    """What is prescribed step by step: the approach, the force, or arc length, which passes every
    fold"""
    until: Until = "target"
    approach: Annotated[float, over_size(THICKNESS)] | None = Field(default=None, ge=-1e6, le=1e6)
    """Target of the approach, from where the body is at first; with control: approach or arc [h]"""
    force: Annotated[float, over_size(POINT_FORCE)] | None = Field(default=None, ge=-1e6, le=1e6)
    """Target of the force on the body; with control: force or arc [2πD/R]"""
    points: Count = 20

    @property
    def amplitude(self) -> str:  # type: ignore[override]  # each body has an amplitude of its own
        return f"approach_{self.body}" if self.body else "approach"

    @property
    def place(self) -> Any:
        return self.body

    def approach_in(self, name_by_body: Mapping[str, str]) -> str:
        """Return the name of the load parameter that this step drives: the approach of its body.

        `name_by_body` has the names of the approaches of all bodies, see `approaches`.
        """
        # a step without `body` is for the only one; `refuse_unfit` reports other cases
        body = str(self.body or next(iter(name_by_body), ""))
        return name_by_body.get(body, self.amplitude)

    def refuse_unfit(self, context: Context) -> None:
        """Refuse a step whose body is not in the case, or is missing where there are several.

        Raises
        ------
        ValueError
            With the key and the names that are allowed.
        """
        bodies: Mapping[str, object] = context.sections["bodies"]
        # only a single body need not be named
        is_known = len(bodies) == 1 if self.body is None else self.body in bodies
        if not is_known:
            allowed = ", ".join(bodies) or "none: give it in bodies"
            raise ValueError(
                f"{context.step.key}.body: {self.body or 'is missing'}; allowed: {allowed}"
            )

    def course(self, step_start: StepStart) -> StepCourse:
        """Return the course of the step, with step control fit for contact."""
        return replace(super().course(step_start), finer=contact_step_options)

    def first_change(self, change: float, load_start: LoadStart, *, by_load: bool) -> float:
        """Return the first change of the approach, over h.

        `load_start` is not used here.

        Parameters
        ----------
        change
            Change from the begin of the step to its target: of the approach, or of the conjugate,
            which is minus the force on the body.
        by_load
            Whether `change` is one of the approach. The result is then `change` over the number of
            points. Towards a force it is `FIRST_APPROACH`, forward if the force is to grow.
        """
        return change / self.points if by_load else copysign(FIRST_APPROACH, -change)


def contact_step_options(options: "StepOptions") -> "StepOptions":
    """Return step control for a path along which contact sets in, grows and ceases.

    The active set of a contact changes within a step. So the result allows smaller steps than the
    given options, and more Newton iterations and factorisations of matrices. Up to
    `EASY_ITERATIONS` of them the next step may be longer; from `HARD_ITERATIONS` factorisations on
    it is shorter.
    """
    return replace(
        options,
        easy_factorisations=EASY_ITERATIONS,
        easy_iterations=EASY_ITERATIONS,
        hard_factorisations=HARD_ITERATIONS,
        smallest=min(options.smallest, SMALLEST_STEP),
    )


def approaches(bodies: Collection[str], loads: Sequence[Step]) -> dict[str, str]:
    """Return a mapping: name of each body -> name of its approach, the load parameter.

    A single body has plain "approach", otherwise the body's name is appended. Beside a step with a
    force it is appended too, since the column `force` is then that of the step.
    """
    is_single = len(bodies) == 1 and not any(load.amplitude == "force" for load in loads)
    return {name: "approach" if is_single else f"approach_{name}" for name in bodies}


class BodiesObservables(Observables):
    """The approach, force, penetration and radii of each body."""

    quantities = (
        Quantity(
            "approach_over_h",
            "approach",
            "Approach of a body along its direction; of several bodies, or beside an indentation, "
            "approach_over_h_NAME. `force` is then the force on the body.",
            "load",
            "a/h",
            (THICKNESS,),
            each=True,
        ),
        Quantity(
            "penetration_over_h",
            "penetration",
            "Largest penetration of a body into the shell's face, an error of the penalty; "
            "negative: minus the least gap.",
            "error",
            "",
            (THICKNESS,),
            each=True,
        ),
        Quantity(
            "contact_radius",
            "contact radius",
            "Mean distance of the pressure from the body's axis, in the shell's length; over R if "
            "that has no unit.",
            "place",
            units=(PLACE,),
            each=True,
        ),
        Quantity(
            "contact_inner",
            "contact from",
            "Least distance of the pressure from the body's axis.",
            "place",
            units=(PLACE,),
            each=True,
        ),
        Quantity(
            "contact_outer",
            "contact to",
            "Largest distance of the pressure from the body's axis.",
            "place",
            units=(PLACE,),
            each=True,
        ),
        Quantity(
            "contact_stiffness",
            "stiffness of the contact",
            "Of the penalty, in E h/R²; raised fourfold where a body without `stiffness` would "
            "penetrate too much.",
            "error",
            each=True,
        ),
        Quantity(
            PRESSURE_MAX,
            "largest contact pressure",
            "At the points of the quadrature; where the contact is narrower than a cell, as at an "
            "edge of the body, it depends on mesh and penalty.",
            "load",
            "p R/(Eh)",
            (CONTACT_PRESSURE,),
            each=True,
        ),
    )
    curve_amplitudes = (
        Amplitude("approach", "approach_over_h", "force", "", sideways=True, each=True),
    )

    def account(self, context: Context, loads: "Loads") -> Account:
        """Return the lines of `magshell check` on bodies and their penalties."""
        bodies, with_units = context.sections["bodies"], context.shell.with_units
        lines = [
            f"body {contact.body}: {bodies[contact.body].words(with_units=with_units)} without "
            f"friction, stiffness k R²/(E h) = {contact.stiffness:.4g}"
            for contact in loads.contacts
        ]
        return Account(lines)

    def amplitudes(self, loads: "Loads") -> tuple[str, ...]:
        """Return the numbers of all bodies in a state: approach, and stiffness of the penalty."""
        return tuple(
            name for contact in loads.contacts for name in (contact.amplitude, contact.setting)
        )

    def conjugates(self, loads: "Loads") -> dict[str, str]:
        """Return a mapping: name of each approach -> column of the force on that body."""
        column_by_approach = dict[str, str]()
        for contact in loads.contacts:
            _, force_column, *_ = contact_columns(contact.amplitude)
            column_by_approach[contact.amplitude] = force_column
        return column_by_approach

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        """Return the columns of all bodies, except `force`, which every run has.

        `supports` are not used here.
        """
        names = (
            column for contact in loads.contacts for column in contact_columns(contact.amplitude)
        )
        return tuple(column for column in names if column != "force")

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return the values of all bodies' columns at a state, in the units of the view.

        The mapping is column -> number. The columns of each body are its approach, the force on it,
        the penetration, three radii of the contact, the stiffness of the penalty, and the largest
        pressure. Collective.
        """
        model, h, values = view.model, view.h, dict[str, float]()
        for name in model.contacts:  # by the name of the body's approach
            # the potential of an approach is dPi/da; over a positive unit it is the force on the
            # body, but the unit of the conjugate is negative
            region, potential = model.region(state, name), view.potential(state, name)
            force = -potential / self._unit(view)
            radii = (view.length * radius for radius in (region.radius, region.inner, region.outer))
            stiffness = float(model.contacts[name].stiffness.value)
            # in the order of `contact_columns`
            numbers = (
                *(state.mu[name], force, region.penetration / h),
                *(*radii, stiffness, region.pressure),
            )
            values |= dict(zip(contact_columns(name), numbers, strict=True))
        return values

    def conjugate_unit(self, view: ModelView, name: str) -> float | None:
        return self._unit(view) if name in view.model.contacts else None

    def _unit(self, view: ModelView) -> float:
        """Return -dPi/da for a force of one unit on the body: minus the unit of force, times h."""
        return -view.model.force_unit * view.h


def contact_columns(approach: str) -> tuple[str, ...]:
    """Return the columns of one body: its approach, the force on it, then the other quantities.

    The part of the approach's name after "approach", such as "_ball", ends each column's name.
    """
    first, *others = (q.name for q in BodiesObservables.quantities)
    return tuple(column + approach.removeprefix("approach") for column in (first, "force", *others))
