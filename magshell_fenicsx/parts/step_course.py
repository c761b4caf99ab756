"""How a step is driven, as data: what it holds and how it ends, where it begins, what it prescribes
and how it goes on.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple, Self, TypeAlias

from pydantic import Discriminator, Field, Tag, model_validator

from magshell_fenicsx.input.section import Pressure, Section, over_size
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.quantities.quantity import VOLUME

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.point import StepOptions
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.step import Step

Until = Annotated[
    Literal["limit", "bifurcation", "target", "points", "zero"],
    Field(
        description="Where the path ends. limit: at the first instability. Where that is a mode "
        "which a half or a meridian excludes, the path goes on to the model's own first one, but "
        "not beyond twice the load; the result is still the first. bifurcation: at the first "
        "bifurcation; folds are passed. target: at the target. points: after `points` steps by "
        "arc length. zero, with control: arc: where the load has risen and fallen back to zero, "
        "the top of an energy barrier, whose height is `barrier` in summary.json"
    ),
]
Prescribed = Literal["load", "conjugate"]
Control = Literal["load", "conjugate", "arc"]
Curves = Mapping[
    str, Callable[[float], tuple[float, float, float]]
]  # of several amplitudes, see `Along`


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
    neutral"""
    tolerance: float = Field(default=1e-3, ge=1e-9, le=1)
    """Largest estimated error of what `errors` names [h]"""
    errors: Errors = "motion"
    """Of each time step, or of the motion at all rows (column error_over_h): then it is rehearsed
    with longer steps, which takes several times as long; a snap magnifies the errors of steps"""


class Target(NamedTuple):
    """A quantity that the value of a key prescribes, with its column of path.csv."""

    quantity: Prescribed
    column: str


@dataclass(frozen=True)
class LoadStart:
    """The amplitude of a step where the step begins.

    Attributes
    ----------
    value, conjugate
        mu, and -dPi/dmu.
    unit
        -dPi/dmu of one unit of the key that prescribes it.
    is_driven
        Whether an earlier step has driven the amplitude.
    size
        The amplitude at a target of one, see `Step.size`.
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
    quantity, end
        The quantity with a target, mu or -dPi/dmu, and the target; None without.
    targets
        Requested values on the way, the last of them `end`.
    first
        Change of the amplitude in the first step.
    scale
        See `continuation.path.Path`.
    step
        The first step of a prescribed conjugate; None: it follows from `first`.
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
    """A step of a programme.

    Attributes
    ----------
    number
        From 1.
    name
        Name of its amplitude; a second force or list of dead loads has a number, such as "force_2".
    key
        Its place in the case file.
    load
        Its section.
    """

    number: int
    name: str
    key: str
    load: "Step"

    @property
    def kind(self) -> str:
        return str(getattr(self.load, "kind", ""))

    @property
    def until(self) -> Until:
        return self.load.ends


@dataclass(frozen=True)
class StepStart:
    """The state where a step begins, in the model's terms.

    Attributes
    ----------
    loads
        All that loads the model.
    turn
        Azimuth of the model's frame (rad).
    h
        Thickness over R.
    mu
        The amplitudes.
    potential
        Amplitude -> Pi_i(u).
    unit
        Amplitude -> -dPi/dmu of one unit of the key that prescribes it.
    open
        Whether a live pressure has no potential.
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

    @property
    def is_driven(self) -> bool:
        """Whether an earlier step has driven the amplitude."""
        return any(
            self.step.name == other.name for other in self.context.steps_before(self.step.number)
        )

    def load_start(self) -> LoadStart:
        """Return the amplitude of the step at its begin."""
        name = self.step.name
        size = self.step.load.size(self.context)
        return LoadStart(
            self.mu[name], -self.potential(name), self.unit(name), self.is_driven, size, self.h
        )


@dataclass(frozen=True)
class StepCourse:
    """How a step goes on from where it begins.

    Attributes
    ----------
    until
        The end of the path.
    steps
        The largest number of steps; None: the path's own.
    curves
        Amplitudes that are functions of the step's own, and its value; None where the model has it
        itself.
    finer
        Returns the lengths of steps of a path, of those that follow from the first one.
    forbidden
        Returns what is said of an instability that must not be on the way, by its amplitudes and
        its name; None if it may.
    at_once
        Whether that ends the step, or it goes on to its end first.
    label
        Of points that are no instabilities, in place of the path's own.
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
    """The end of a step in words, for those who wait for it.

    Attributes
    ----------
    end
        Value of the column of its amplitude; None if it ends at another event.
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
