"""How a step of a programme is driven, as data.

The data say what the step holds, where it begins, what it prescribes, how it goes on and ends. An
amplitude mu is a load parameter; its conjugate -dPi/dmu is the displacement on which it does work.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, model_validator

from magshell_fenicsx.input.section import Pressure, Section, over_size
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.quantities.quantity import VOLUME

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.point import StepOptions
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.step import Step

Array = NDArray[np.float64]
Until = Annotated[
    Literal["limit", "bifurcation", "target", "points", "zero"],
    Field(
        description="Where the path ends. limit: at the first instability. If a half or a meridian "
        "cannot show its mode, the path goes on to the first that it can show, at most to twice "
        "the load; the result is still the first. bifurcation: at the first bifurcation; folds "
        "are passed. target: at the target. points: after `points` steps by "
        "arc length. zero, with control: arc: where the load has risen and fallen back to zero, "
        "the top of an energy barrier, whose height is `barrier` in summary.json"
    ),
]
Prescribed = Literal["load", "conjugate"]
Control = Literal["load", "conjugate", "arc"]
# the chart of a place, by the azimuth of the model's frame (rad) and whether half is modelled
ChartOfPlace = Callable[[float, bool], Array]
# other amplitudes as functions of the one that a step drives: value and two derivatives
Curves = Mapping[str, Callable[[float], tuple[float, float, float]]]


class GasSection(Section):
    """An ideal gas at constant temperature under the shell: its pressure times its volume is
    constant.
    """

    ambient: Pressure | None = Field(default=None, gt=0, le=1e12)
    """Pressure outside, with a unit"""
    ambient_over_pc: float | None = Field(default=None, gt=0, le=1e12)
    """The same without one [p_c]"""
    volume: Annotated[float, over_size(VOLUME)] | None = Field(default=None, gt=0, le=1e6)
    """Volume of the gas under the undeformed shell; by default the volume under the shell itself
    [R³]"""

    @model_validator(mode="after")
    def _one_ambient(self) -> Self:
        if (self.ambient is None) == (self.ambient_over_pc is None):
            raise ValueError("give ambient or ambient_over_pc")
        return self


class Gas(Section):
    """A pressure that follows from a gas under the shell."""

    gas: GasSection
    """The gas"""


Hold = Annotated[
    Annotated[Literal["load", "conjugate"], Tag("a word")] | Annotated[Gas, Tag("a gas")],
    Discriminator(lambda data: "a gas" if isinstance(data, dict | Gas) else "a word"),
]


class SearchSection(Section):
    """Other equilibria at the last point of a step, such as snapped shapes, by deflation: no path
    leads to them.

    Everything that the step holds stays held. What is found depends on the guesses: there may be
    more.
    """

    solutions: Annotated[int, Field(ge=1, le=100)] = 3
    """Ends after so many, each a point with the label solution"""
    guesses: Annotated[int, Field(ge=1, le=1000)] = 12
    """Guesses tried at most: the shell with dents, then both directions of the softest mode of each
    solution"""
    stable: bool = False
    """Whether each guess goes down in energy until it rests at a stable solution, which takes
    minutes on surfaces; only stable ones count. A half or a meridian knows no motions beside its
    symmetry: take symmetry: none"""
    seconds: Annotated[float, Field(gt=0)] | None = None
    """No guess is tried after so long; by default there is no limit [s]"""


Errors: TypeAlias = Literal["step", "motion"]


class SnapSection(Section):
    """How the shell is released with `then: snap`."""

    push: float = Field(default=0.05, gt=0, le=10)
    """How far it leaves the fold, along the path's direction there [h]"""
    damping: float = Field(default=0.1, gt=0, le=10)
    """Part of the critical drag of the third mode of vibration at the fold, where the first one is
    neutral. It slows the snap, by some half at 0.1; a smaller one comes to rest later"""
    tolerance: float = Field(default=1e-3, ge=1e-9, le=1)
    """Largest estimated error of what `errors` names [h]"""
    errors: Errors = "motion"
    """Of each time step, or of the motion at all rows (column error_over_h): then it is rehearsed
    with longer steps, which takes several times as long; a snap magnifies the errors of steps"""


class Target(NamedTuple):
    """A quantity that the value of a key prescribes, and its column of path.csv.

    Attributes
    ----------
    quantity
        The quantity: the amplitude, or its conjugate.
    column
        Its column.
    squared
        Whether the quantity is the square of the key's value.
    """

    quantity: Prescribed
    column: str
    squared: bool = False


@dataclass(frozen=True)
class StepEnd:
    """The end of a step: its event and target, and what follows there.

    Attributes
    ----------
    until
        The event at which the step ends, in the words of a path's `until`.
    target
        The target and its value, in the unit of its key; None without.
    bound
        The latest end of a path to an instability, as `target` is given; None without.
    controls_conjugate
        Whether the conjugate is prescribed from point to point.
    at_rest
        Whether the step ends in equilibrium.
    snap
        How the shell is released at the end; None if it is not.
    follows_branch
        Whether the path goes on along the branch at the bifurcation that ends the step.
    branch_points
        Number of steps in each direction of a branch; 0 if no branch is followed.
    sensitivities
        Whether derivatives of the load at the fold by numbers of the case are requested.
    """

    until: Until = "target"
    target: tuple[Target, float] | None = None
    bound: tuple[Target, float] | None = None
    controls_conjugate: bool = False
    at_rest: bool = True
    snap: SnapSection | None = None
    follows_branch: bool = False
    branch_points: int = 0
    sensitivities: bool = False

    @property
    def goal(self) -> tuple[Target, float] | None:
        """The target, or else the latest end of a path to the first instability."""
        return self.target or self.bound

    def by_conjugate(self, *, at_target: bool) -> bool:
        """Return whether the conjugate is prescribed at the step's points, or at its target."""
        target = self.target if at_target and self.until == "target" else None
        has_conjugate_target = target is not None and target[0].quantity == "conjugate"
        return has_conjugate_target or self.controls_conjugate


@dataclass(frozen=True)
class LoadStart:
    """The amplitude of a step where the step begins.

    Attributes
    ----------
    value, conjugate
        The amplitude mu, and its conjugate -dPi/dmu.
    unit
        The conjugate -dPi/dmu of one unit of the key that prescribes it.
    is_driven
        Whether an earlier step has driven the amplitude.
    size
        The amplitude at a target of one unit of the target's key.
    h
        Thickness over R.
    """

    value: float
    conjugate: float
    unit: float
    is_driven: bool
    size: float
    h: float


@dataclass(frozen=True)
class Drive:
    """How a step drives its amplitude.

    Attributes
    ----------
    control
        The quantity that is prescribed step by step: mu, its conjugate, or the arc length.
    quantity, end
        The quantity with a target, mu or -dPi/dmu, and the target; None without.
    targets
        Requested values on the way, the last of them `end`.
    first
        Change of the amplitude in the first step.
    scale
        Value of the amplitude of order one, see `continuation.path.Path`.
    step
        The first step of a prescribed conjugate; None if it follows from `first`.
    """

    control: Control
    quantity: Prescribed
    end: float | None
    targets: list[float]
    first: float
    scale: float = 1.0
    step: float | None = None


@dataclass(frozen=True)
class ProgrammeStep:
    """A step of a programme: a load with its number and the name of its amplitude.

    Attributes
    ----------
    number
        Number of the step, from 1.
    name
        Name of the amplitude; a second force or list of dead loads has a number, such as "force_2".
    key
        Place of the step in the case file, as a key.
    load
        Section of the step.
    drives
        Amplitudes of other steps that it drives too.
    """

    number: int
    name: str
    key: str
    load: "Step"
    drives: tuple[str, ...] = ()

    @property
    def kind(self) -> str:
        """The kind of the step, such as "pressure"."""
        return str(getattr(self.load, "kind", ""))

    @property
    def until(self) -> Until:
        """The event at which the step ends."""
        return self.load.end.until


@dataclass(frozen=True)
class StepStart:
    """The state where a step begins, in the model's terms.

    Attributes
    ----------
    step
        The step.
    context
        The case.
    loads
        All that loads the model.
    turn
        Azimuth of the model's frame (rad).
    h
        Thickness over R.
    mu
        The amplitudes by name.
    potential
        Amplitude -> Pi_i(u), whose product with mu_i is the amplitude's part of the energy.
    unit
        Amplitude -> -dPi/dmu of one unit of the key that prescribes it.
    open
        Whether a live pressure has no potential.
    size
        The amplitude at a target of one unit of the target's key.
    """

    step: ProgrammeStep
    context: Context
    loads: "Loads"
    turn: float
    h: float
    mu: Mapping[str, float]
    potential: Callable[[str], float]
    unit: Callable[[str], float]
    open: bool
    size: float = 1.0

    @property
    def is_driven(self) -> bool:
        """Whether an earlier step has driven the amplitude of this step."""
        return any(
            self.step.name == earlier_step.name
            for earlier_step in self.context.steps_before(self.step.number)
        )

    def load_start(self) -> LoadStart:
        """Return the value and the conjugate of the step's amplitude at the begin of the step."""
        name = self.step.name
        return LoadStart(
            value=self.mu[name],
            conjugate=-self.potential(name),
            unit=self.unit(name),
            is_driven=self.is_driven,
            size=self.size,
            h=self.h,
        )


@dataclass(frozen=True)
class StepCourse:
    """How a step goes on from where it begins.

    Attributes
    ----------
    drive
        How the step drives its amplitude.
    until
        The event at which the path ends.
    steps
        The largest number of steps; None for that of the path.
    curves
        Other amplitudes as functions of the step's own one, each with two derivatives, and the
        value of the own one; None where the model has these functions itself.
    finer
        Function of a path's options of step lengths that returns finer ones; None to keep them.
    forbidden
        Function of the amplitudes at an instability and of its name: the message about an
        instability that must not be on the way. None if any may be.
    at_once
        Whether such an instability ends the step at once; else the step goes on to its end first.
    label
        Label of points that are no instabilities; empty for the path's own.
    impossible
        Why there is no such path; empty if there is one.
    """

    drive: Drive
    until: Literal["limit", "bifurcation", "target", "points"]
    steps: int | None = None
    curves: tuple[Curves, float] | None = None
    finer: "Callable[[StepOptions], StepOptions] | None" = None
    forbidden: Callable[[Mapping[str, float], str], str] | None = None
    at_once: bool = False
    label: Literal["", "field"] = ""
    impossible: str = ""


@dataclass(frozen=True)
class ExpectedEnd:
    """The end of a step in words, for the status line of a run.

    Attributes
    ----------
    words
        The event at which the step ends.
    end
        Value of the column of the step's amplitude; None if it ends at another event.
    steps
        Number of steps after which it ends; None if it ends otherwise.
    """

    words: str
    end: float | None = None
    steps: int | None = None


@dataclass(frozen=True)
class SizingContext:
    """The numbers on which element sizes depend.

    Attributes
    ----------
    h
        Thickness over R.
    refinement
        Divisor of the sizes.
    solid
        Whether the body is modelled in three dimensions.
    local
        Whether the shell has a local imperfection.
    """

    h: float
    refinement: float
    solid: bool
    local: bool


LONG_TUBE_SIZE = 8.0  # over sqrt(Rh): elements along a tube without axial compression


@dataclass(frozen=True)
class MeshHints:
    """The element sizes that suit a load.

    Attributes
    ----------
    growth
        How fast elements may grow away from small ones: size per distance.
    rim
        Size of elements along the edge of a curved surface, over sqrt(Rh).
    largest
        Largest element size on a curved disc, over R; None for the usual one.
    along_tube
        Largest element size along a tube, over sqrt(Rh). Half a wave of axial compression is
        pi sqrt(Rh)/(12 (1 - nu^2))^(1/4) long, 1.73 sqrt(Rh) for a Poisson's ratio of 0.3.
    """

    growth: float = 0.4
    rim: float = 1.4
    largest: float | None = None
    along_tube: float = 2.0
