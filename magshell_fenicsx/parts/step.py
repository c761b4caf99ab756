"""The base of the steps of a programme: what a step drives, how, and how far."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.mesh.grading import Feature
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.course import (
    Ahead,
    Course,
    Curves,
    Fit,
    Here,
    Hold,
    SearchSection,
    SnapSection,
    Target,
    Until,
)
from magshell_fenicsx.parts.course import (
    ProgrammeStep as ProgrammeStep,
)
from magshell_fenicsx.parts.part import Context, Formulas, Modelled
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import register
from magshell_fenicsx.shape.symmetry import Leaves

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.motion.step import TimeSection
    from magshell_fenicsx.shape.outline import Outline

LEAST_TARGET = 1e-9
BALANCE = 1e-2  # largest error of the balance of energy in time, over all energies
Array = NDArray[np.float64]


class Step(Section):
    """What every step has in common.

    Attributes
    ----------
    quantities
        The columns that it adds to path.csv.
    amplitude
        Name of the amplitude that it drives.
    conjugate
        The displacement that `hold: conjugate` holds, in words; empty if it cannot be held.
    released
        Why the conjugate cannot be held while the shell moves; empty if it can.
    holdable
        Whether other steps may say what they hold of its amplitude.
    jumps
        Whether its amplitude may jump in time.
    in_time
        Whether it is a motion, which need not begin in equilibrium.
    in_lengths
        Whether a target of its conjugate is in the shell's length.
    touches
        Whether it begins where something touches the shell first.
    """

    quantities: ClassVar[tuple[Quantity, ...]] = ()
    amplitude: ClassVar[str]
    conjugate: ClassVar[str] = ""
    released: ClassVar[str] = ""
    holdable: ClassVar[bool] = True
    jumps: ClassVar[bool] = True
    in_time: ClassVar[bool] = False
    in_lengths: ClassVar[bool] = False
    touches: ClassVar[bool] = False
    points: int
    hold: dict[str, Hold] = Field(default_factory=dict)
    """Amplitude of another step, or pressure -> what is constant in this step: the load itself (default), its
    conjugate displacement (of the pressure the volume, of a force the displacement), or a gas under the shell. This
    step's own amplitude may stand here too if it has `until: limit`: with `conjugate` the instability is that of a
    shell whose volume or displacement is held, not its load"""
    search: SearchSection | None = None
    """Search for further solutions at the end of the step"""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        register(cls.quantities)

    @property
    def place(self) -> Any:
        """What distinguishes two loads of the same kind."""
        return None

    @property
    def target(self) -> tuple[Target, float] | None:
        """The target and its value, in the unit of its key; None without."""
        return None

    @property
    def bound(self) -> tuple[Target, float] | None:
        """Where a way to the first instability ends at the latest, as `target`; None without."""
        return None

    @property
    def ends(self) -> Until:
        """Where it ends, in the words of a path."""
        return "target"

    @property
    def rests(self) -> bool:
        """Whether it ends in equilibrium."""
        return True

    @property
    def drives(self) -> tuple[str, ...]:
        """Amplitudes of other steps that it drives too."""
        return ()

    @property
    def motion(self) -> "TimeSection | None":
        """The step as a motion; None if it is none."""
        return None

    @property
    def branch_points(self) -> int:
        """How many steps it follows each direction of a branch; 0 if none is followed."""
        return 0

    @property
    def follows_branch(self) -> bool:
        """Whether it goes on along the branch at the bifurcation that ends it."""
        return False

    @property
    def wants_sensitivities(self) -> bool:
        """Whether the load at its fold is derived by what is given."""
        return False

    def size(self, context: Context) -> float:
        """What a target of one is of the amplitude."""
        return 1.0

    @classmethod
    def level(cls, text: str, context: Context) -> float:
        """A value of a history with a unit as a number, as the target of its load is without one.

        Raises
        ------
        ValueError
            If the target has no such unit, or the case lacks what it needs.
        """
        raise ValueError("its values have no unit: give a number")

    def of_history(self, value: float) -> float:
        """The amplitude at a value of a history, which is as the target is."""
        return value

    def in_history(self, amplitude: float) -> float:
        """The value of a history at an amplitude."""
        return amplitude

    def course(self, here: Here) -> Course:
        """How it goes on."""
        raise NotImplementedError

    def curves(self, here: Here) -> tuple[Curves, float] | None:
        """See `Course`, from any state of the step."""
        return None

    def ahead(
        self, step: ProgrammeStep, context: Context, loads: "Loads", turn: float
    ) -> Ahead | None:
        """Its end, if its target does not say it."""
        return None

    def changes(self, name: str, mu: Iterable[str]) -> set[str]:
        """Which of all amplitudes it changes as it is given; `name` is its own."""
        return {name}

    def by_conjugate(self, *, at_target: bool) -> bool:
        """Whether the conjugate is prescribed at its points, or at its target."""
        return False

    def on_perfect(self, *, last: bool) -> "Step | None":
        """The step on the shell without imperfections, to the first instability if it is the last;
        None without.
        """
        return self

    @property
    def held_conjugate(self) -> bool:
        """Whether other steps may hold its conjugate."""
        return bool(self.conjugate)

    @property
    def released_by(self) -> SnapSection | None:
        """How the shell is released at its end; None if it is not."""
        return None

    @classmethod
    def before(cls, context: Context, loading: "Step | None") -> list[tuple[str, "Step"]]:
        """The steps of this kind that come before the only load of a case, each with the key that
        asks for it.
        """
        return []

    def name_in(self, context: Context, loads: Sequence["Step"]) -> str | None:
        """The name of its amplitude beside all loads of a case; None: `amplitude`, with a number
        from the second on.
        """
        return None

    def refuse_unfit(self, step: ProgrammeStep, context: Context) -> None:
        """See that the case has what the step needs.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """

    def terms(self, step: ProgrammeStep, context: Context) -> list[OwnTerm]:
        """Energies with its amplitude, from nothing but their densities; see `OwnTerm`."""
        return []

    def multiplies(self, step: ProgrammeStep, context: Context) -> list[str]:
        """Keys below `shell` of the imperfections that it multiplies."""
        return []

    def account(self, step: ProgrammeStep, context: Context) -> str:
        """The line of `magshell check`, if nothing else says it."""
        return ""

    def warning(self, step: ProgrammeStep, outline: "Outline", length: float) -> str | None:
        """What is often meant in another way, with the key; None if nothing is.

        Places of the outline times `length` are those of formulas.
        """
        return None

    def leaves(self, step: ProgrammeStep, context: Context, outline: "Outline") -> list[Leaves]:
        """The symmetry that it leaves of a shell."""
        return []

    def place_on(self, step: ProgrammeStep, context: Context, outline: "Outline") -> Array | None:
        """The one place (3,) over R where it is, in the frame of the case; None if it is not at
        one.

        Raises
        ------
        CaseError
            If it does not say where it is on this geometry.
        """
        return None

    def chart_of(self, place: Array, outline: "Outline", turn: float, *, half: bool) -> Array:
        """That place in the chart of a frame turned about e3 (rad)."""
        chart = outline.inverse(rotation(turn) @ place)
        return outline.on_half(chart) if half else chart

    def refuse_unfit_place(
        self, step: ProgrammeStep, context: Context, outline: "Outline", at: Array
    ) -> None:
        """See that there is room for it around its place in the chart.

        Raises
        ------
        CaseError
            With what is allowed.
        """

    def named_points(self) -> list[str]:
        """The named points at which it is concentrated."""
        return []

    @classmethod
    def around(cls, loads: Sequence[Self], place: Array, fit: "Fit") -> list[Feature]:
        """Small elements around a place in the chart with these loads of the kind."""
        return []

    def growth(self, fit: "Fit") -> float:
        """How fast elements may grow away from small ones."""
        return 0.4

    def rim(self, fit: "Fit") -> float:
        """Size of elements along the edge of a curved surface, over sqrt(Rh)."""
        return 1.4

    def largest(self, fit: "Fit") -> float | None:
        """Largest size of elements on a curved disc, over R; None: as without it."""
        return None

    def formulas(self, key: str, context: Context) -> Iterable[Formulas]:
        """What varies with the undeformed place."""
        return []

    @classmethod
    def implied(cls) -> dict[str, Any]:
        """The same, where another step holds the amplitude of this kind or drives it in time."""
        return {}

    def adds(self, step: ProgrammeStep, context: Context, modelled: Modelled) -> dict[str, Any]:
        """Fields of the model's `Loads`, to which those of other parts are added."""
        return {}
