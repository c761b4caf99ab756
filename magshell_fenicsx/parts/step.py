"""The base of the steps of a programme: what a step drives, how, and how far.

A programme is the list of the loads of a case, one after the other. A step drives an amplitude (a
load parameter mu, by name); the conjugate is the displacement on which the amplitude does work. A
step holds other amplitudes, or their conjugates. A target is a value at which it ends, in the unit
of its key. The chart is the pair of coordinates of the surface; the model's frame may be turned
about e3 against the case's. `Loads` has the data of the model, to which each step adds fields. R
is the reference length, over which places are.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.mesh.grading import Feature
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.ability import Context, Formulas, Modelled
from magshell_fenicsx.parts.step_course import (
    Curves,
    ExpectedEnd,
    Hold,
    SearchSection,
    SizingContext,
    SnapSection,
    StepCourse,
    StepStart,
    Target,
    Until,
)
from magshell_fenicsx.parts.step_course import (
    ProgrammeStep as ProgrammeStep,
)
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import register
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.motion.motion_step import TimeSection
    from magshell_fenicsx.shape.outline import Outline

LEAST_TARGET = 1e-9
BALANCE = 1e-2  # largest error of the balance of energy in time, over all energies
Array = NDArray[np.float64]


class Step(Section):
    """The base of all steps.

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
    """Amplitude of another step, or pressure -> what is constant in this step: the load itself
    (default), its conjugate displacement (of the pressure the volume, of a force the displacement),
    or a gas under the shell. This step's own amplitude may stand here too if it has `until: limit`:
    with `conjugate` the instability is that of a shell whose volume or displacement is held, not
    its load"""
    search: SearchSection | None = None
    """Search for further solutions at the end of the step"""

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        register(cls.quantities)

    @property
    def place(self) -> Any:
        """The place or direction that distinguishes two loads of the same kind; None without."""
        return None

    @property
    def target(self) -> tuple[Target, float] | None:
        """The target and its value, in the unit of its key; None without."""
        return None

    @property
    def limit_target(self) -> tuple[Target, float] | None:
        """The latest end of a path to the first instability, as `target` is given; None without."""
        return None

    @property
    def ends(self) -> Until:
        """The event at which the step ends, in the words of a path's `until`."""
        return "target"

    @property
    def rests(self) -> bool:
        """Whether the step ends in equilibrium."""
        return True

    @property
    def drives(self) -> tuple[str, ...]:
        """The amplitudes of other steps that this step drives too."""
        return ()

    @property
    def motion(self) -> "TimeSection | None":
        """The step as a motion; None if it is none."""
        return None

    @property
    def branch_points(self) -> int:
        """Number of steps in each direction of a branch; 0 if no branch is followed."""
        return 0

    @property
    def follows_branch(self) -> bool:
        """Whether the path goes on along the branch at the bifurcation that ends the step."""
        return False

    @property
    def wants_sensitivities(self) -> bool:
        """Whether derivatives of the load at the fold by numbers of the case are requested."""
        return False

    def size(self, context: Context) -> float:
        """Return the amplitude at a target of one unit of the target's key."""
        return 1.0

    @classmethod
    def level(cls, text: str, context: Context) -> float:
        """Return a value of a history, given as text with a unit, in the unit of the target.

        A history gives a load as a function of time.

        Raises
        ------
        ValueError
            If the target has no such unit, or the case lacks what it needs.
        """
        raise ValueError("its values have no unit: give a number")

    def of_history(self, value: float) -> float:
        """Return the amplitude at a value of a history, which has the unit of the step's target."""
        return value

    def in_history(self, amplitude: float) -> float:
        """Return the value of a history, in the unit of the step's target, at an amplitude."""
        return amplitude

    def course(self, step_start: StepStart) -> StepCourse:
        """Return how the step goes on from the state where it begins."""
        raise NotImplementedError

    def curves(self, step_start: StepStart) -> tuple[Curves, float] | None:
        """Return the other amplitudes that are functions of the step's own one.

        They come with the value of the step's own amplitude at its begin. None without such
        functions.
        """
        return None

    def expected_end(
        self, step: ProgrammeStep, context: Context, loads: "Loads", turn: float
    ) -> ExpectedEnd | None:
        """Return the end of the step in words, for the status line of a run.

        None if the target determines the end. `turn` is the azimuth of the model's frame (rad).
        """
        return None

    def changes(self, name: str, mu: Iterable[str]) -> set[str]:
        """Return those of the amplitudes `mu` that the step changes; `name` is that of its own."""
        return {name}

    def by_conjugate(self, *, at_target: bool) -> bool:
        """Return whether the conjugate is prescribed at the step's points, or at its target."""
        return False

    def on_perfect(self, *, last: bool) -> "Step | None":
        """Return the step on the shell without imperfections; None if it has no meaning there.

        `last` is whether the step is the last one, which then goes to the first instability.
        """
        return self

    @property
    def held_conjugate(self) -> bool:
        """Whether other steps may hold the conjugate of the step's amplitude."""
        return bool(self.conjugate)

    @property
    def released_by(self) -> SnapSection | None:
        """The section on how the shell is released at the end of the step; None if it is not."""
        return None

    @classmethod
    def steps_before_load(
        cls, context: Context, loading: "Step | None"
    ) -> list[tuple[str, "Step"]]:
        """Return the steps of this kind that come before the only load of a case.

        Parameters
        ----------
        loading
            The only load; None without.

        Returns
        -------
        list of tuple
            The key of the case that asks for the step, and the step.
        """
        return []

    def name_in(self, context: Context, loads: Sequence["Step"]) -> str | None:
        """Return the name of the step's amplitude beside all loads of a case.

        None stands for `amplitude`, with a number from the second load of the kind on.
        """
        return None

    def refuse_unfit(self, step: ProgrammeStep, context: Context) -> None:
        """Check that the case has what the step needs; `step` is this step in the programme.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """

    def terms(self, step: ProgrammeStep, context: Context) -> list[OwnTerm]:
        """Return the energies that the step's amplitude multiplies and that densities define."""
        return []

    def multiplies(self, step: ProgrammeStep, context: Context) -> list[str]:
        """Return keys below `shell` of the imperfections that the step's amplitude multiplies."""
        return []

    def account(self, step: ProgrammeStep, context: Context) -> str:
        """Return the step's line of `magshell check`; empty if other lines say everything."""
        return ""

    def warning(self, step: ProgrammeStep, outline: "Outline", length: float) -> str | None:
        """Return a warning, with the key, if a different load is often meant; None without.

        Places of the outline (over R) times `length` are the places of formulas.
        """
        return None

    def symmetry_constraints(
        self, step: ProgrammeStep, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry of a shell that the step preserves; empty if it preserves all."""
        return []

    def place_on(self, step: ProgrammeStep, context: Context, outline: "Outline") -> Array | None:
        """Return the one place (3,) over R where the load acts, in the case's frame; None without.

        `step` is this step in the programme, with its key for messages.

        Raises
        ------
        CaseError
            If the step does not say where the place is on this geometry.
        """
        return None

    def chart_of(self, place: Array, outline: "Outline", turn: float, *, half: bool) -> Array:
        """Return the chart of the load's place (3,), in a frame turned about e3 by `turn` (rad).

        With `half`, the chart is on the modelled half.
        """
        chart = outline.inverse(rotation(turn) @ place)
        return outline.on_half(chart) if half else chart

    def refuse_unfit_place(
        self, step: ProgrammeStep, context: Context, outline: "Outline", at: Array
    ) -> None:
        """Check that there is room for the load around its place `at` (2,) in the chart.

        By default there is.

        Raises
        ------
        CaseError
            With what is allowed.
        """

    def named_points(self) -> list[str]:
        """Return the named points at which the load is concentrated."""
        return []

    @classmethod
    def mesh_features(
        cls, loads: Sequence[Self], place: Array, sizing: "SizingContext"
    ) -> list[Feature]:
        """Return small elements around a place in the chart with loads of this class; none here.

        Parameters
        ----------
        loads
            The loads at the place.
        place
            The place (2,) in the chart.
        sizing
            Thickness and refinement, on which element sizes depend.
        """
        return []

    def growth(self, sizing: "SizingContext") -> float:
        """Return how fast elements may grow away from small ones: size per distance."""
        return 0.4

    def rim(self, sizing: "SizingContext") -> float:
        """Return the size of elements along the edge of a curved surface, over sqrt(Rh)."""
        return 1.4

    def largest(self, sizing: "SizingContext") -> float | None:
        """Return the largest element size on a curved disc, over R; None for the usual one."""
        return None

    def formulas(self, key: str, context: Context) -> Iterable[Formulas]:
        """Return the step's formulas of the undeformed place; `key` is that of the step."""
        return []

    @classmethod
    def implied(cls) -> dict[str, Any]:
        """Return fields of the model's `Loads` that another step's hold or drive asks for.

        That step holds or drives the amplitude of this kind of step.
        """
        return {}

    def adds(self, step: ProgrammeStep, context: Context, modelled: Modelled) -> dict[str, Any]:
        """Return fields of the model's `Loads`, to which those of other abilities are added."""
        return {}
