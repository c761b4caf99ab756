"""The base of the steps of a programme: what a step drives, how, and how far.

A programme is the list of the loads of a case, one after the other. A step drives an amplitude (a
load parameter mu, by name); the conjugate is the displacement on which the amplitude does work. A
step holds other amplitudes, or their conjugates. A target is a value at which it ends, in the unit
of its key. The chart is the pair of coordinates of the surface; the model's frame may be turned
about e3 against the case's. R is the reference length, over which places are.
"""

from collections.abc import Sequence
from math import sqrt
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.mesh.grading import Feature
from magshell_fenicsx.parts.ability import Context, Part
from magshell_fenicsx.parts.step_course import (
    ChartOfPlace,
    ExpectedEnd,
    Hold,
    MeshHints,
    SearchSection,
    SizingContext,
    StepCourse,
    StepEnd,
    StepStart,
    Target,
)
from magshell_fenicsx.parts.step_course import (
    ProgrammeStep as ProgrammeStep,
)

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.shape.outline import Outline

LEAST_TARGET = 1e-9
BALANCE = 1e-2  # largest error of the balance of energy in time, over all energies
Array = NDArray[np.float64]


class Step(Part):
    """The base of all steps.

    As an ability it reads the case with its own step, `context.step`.

    Attributes
    ----------
    amplitude
        Name of the amplitude that it drives.
    targets
        The keys of targets.
    conjugate
        The displacement that `hold: conjugate` holds, in words; empty if it cannot be held.
    released
        Why the conjugate cannot be held while the shell moves; empty if it can.
    holdable
        Whether other steps may say what they hold of its amplitude.
    jumps
        Whether its amplitude may jump in time.
    alters
        Amplitudes of other steps that change with its own.
    changes_gaps
        Whether its amplitude changes the gaps between undeformed shells.
    in_lengths
        Whether a target of its conjugate is in the shell's length.
    touches
        Whether it begins where something touches the shell first.
    rank_before_load
        Its place among the steps that may come before the one load of a case; 0 if it may not.
    """

    amplitude: ClassVar[str]
    targets: ClassVar[dict[str, Target]] = {}
    conjugate: ClassVar[str] = ""
    released: ClassVar[str] = ""
    holdable: ClassVar[bool] = True
    jumps: ClassVar[bool] = True
    alters: ClassVar[tuple[str, ...]] = ()
    changes_gaps: ClassVar[bool] = False
    in_lengths: ClassVar[bool] = False
    touches: ClassVar[bool] = False
    rank_before_load: ClassVar[int] = 0
    points: int
    hold: dict[str, Hold] = Field(default_factory=dict)
    """Amplitude of another step, or pressure -> what is constant in this step: the load itself
    (default), its conjugate displacement (of the pressure the volume, of a force the displacement),
    or a gas under the shell. With `until: limit` this step's own load may be named too: `conjugate`
    then finds the instability at a prescribed volume or displacement"""
    search: SearchSection | None = None
    """Search for further solutions at the end of the step"""

    @property
    def place(self) -> Any:
        """The place or direction that distinguishes two loads of the same kind; None without."""
        return None

    @property
    def end(self) -> StepEnd:
        """The event and the target at which the step ends, and what follows there."""
        return StepEnd()

    @property
    def _squares(self) -> bool:
        """Whether the amplitude is the square of the value of its target's key."""
        return any(target.squared for target in self.targets.values())

    @classmethod
    def history_value(cls, text: str, context: Context) -> float:
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
        return value**2 if self._squares else value

    def in_history(self, amplitude: float) -> float:
        """Return the value of a history, in the unit of the step's target, at an amplitude."""
        return sqrt(max(amplitude, 0.0)) if self._squares else amplitude

    def course(self, step_start: StepStart) -> StepCourse:
        """Return how the step goes on from the state where it begins."""
        raise NotImplementedError

    def expected_end(self, context: Context, loads: "Loads", turn: float) -> ExpectedEnd | None:
        """Return the end of the step in words, for the status line of a run.

        None if the target determines the end. `turn` is the azimuth of the model's frame (rad).
        """
        return None

    def on_perfect(self, *, last: bool) -> "Step | None":
        """Return the step on the shell without imperfections; None if it has no meaning there.

        `last` is whether the step is the last one, which then goes to the first instability.
        """
        return self

    @classmethod
    def steps_before_load(cls, context: Context) -> list[tuple[str, "Step"]]:
        """Return the steps of this kind that come before the only load of a case, of another kind.

        Returns
        -------
        list of tuple
            The key of the case that asks for the step, and the step.
        """
        return []

    def concentrated(self, context: Context, outline: "Outline") -> Sequence[str | ChartOfPlace]:
        """Return the places where the load is concentrated.

        Each is the name of a point of the case, or a function that returns the chart (2 | 3,) of a
        place of the load's own, of which there is at most one.

        Raises
        ------
        CaseError
            If there is no such place on this geometry, or no room for the load.
        """
        return ()

    @classmethod
    def mesh_features(
        cls, loads: Sequence[Self], place: Array, sizing: SizingContext
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

    def mesh_hints(self, sizing: SizingContext) -> MeshHints:
        """Return the element sizes that suit the load."""
        return MeshHints()
