"""An imperfection as a load: its depth grows while other loads are held.

A step is a part of a case's load programme; it drives an amplitude, that is a load parameter. The
amplitude of a growing imperfection is the factor of its deviation w0. Imperfections have keys below
`shell`, such as "imperfections.0".
"""

from collections.abc import Collection, Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from pydantic import Field

from magshell_fenicsx.parts.ability import Context, Modelled
from magshell_fenicsx.parts.observables import Observables
from magshell_fenicsx.parts.path_step import LoadStep
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.parts.step_course import Target
from magshell_fenicsx.quantities.quantity import Quantity

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads


class ImperfectionStep(LoadStep):
    """An imperfection grows: the factor of its w0, from 0 (the shell without it) to 1 (as given)
    and beyond.

    Displacements count from the stress-free shape, which itself grows with the imperfection.
    Volumes count from the drawn shape. Directions and areas of dead loads, thickness and remanence
    by formula are those of the drawn shape too. `until: target` ends at a factor.
    """

    amplitude: ClassVar[str] = "imperfection"
    targets: ClassVar[dict[str, Target]] = {"factor": Target("load", "imperfection")}
    changes_gaps: ClassVar[bool] = True
    kind: Literal["imperfection"]
    item: int | None = Field(default=None, ge=0)
    """Number of the imperfection in shell.imperfections, from 0; all of them together by default"""
    factor: float | None = Field(default=None, ge=-1e3, le=1e3)
    """Target of the factor"""

    @property
    def place(self) -> Any:
        return self.item

    def on_perfect(self, *, last: bool) -> None:
        return None

    def account(self, context: Context) -> str:
        return f"{context.step.name} grows: {', '.join(_grown_in(context))}"

    def contribution(self, context: Context, modelled: Modelled) -> "Loads":
        """Return the step's amplitude -> the deviations that its factor multiplies."""
        from magshell_fenicsx.parts.loads import Loads  # the solver takes long to import

        deviations = tuple(modelled.deviations[key] for key in _grown_in(context))
        return Loads(growing_imperfections={context.step.name: deviations})

    def refuse_unfit(self, context: Context) -> None:
        """Check that the case has the imperfection of the step, which no other step may share.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """
        key = context.step.key
        imperfections: Mapping[str, object] = context.sections["imperfections"]
        load_of_amplitude = context.loads(ImperfectionStep)  # amplitude -> section of its step
        context.needs(f"{key}.kind: imperfection", "a mid-surface")
        if not imperfections:
            raise ValueError(
                f"{key}.kind: imperfection: the case has none; give shell.imperfections"
            )
        if not _grown_in(context):
            raise ValueError(
                f"{key}.item: {self.item}: shell.imperfections has no such item, counted from 0"
            )
        # without an item the step grows all, which another step may not
        if load_of_amplitude[context.step.name].item is None and len(load_of_amplitude) > 1:
            raise ValueError(
                f"{key}.item: give it: another step grows another item of shell.imperfections"
            )


class GrowingObservables(Observables):
    """The amplitudes of imperfections that grow."""

    quantities = (
        Quantity(
            "imperfection",
            "imperfection",
            "Factor of the imperfections that grow; 0: without them.",
            "load",
        ),
    )

    def free_amplitudes(self, loads: "Loads") -> Mapping[str, float]:
        return dict.fromkeys(loads.growing_imperfections, 0.0)


def _grown_in(context: Context) -> list[str]:
    """Return the keys of the imperfections that the step of a context multiplies."""
    return grown_by([context.step], context.sections["imperfections"])[context.step.name]


def grown_by(steps: Iterable[ProgrammeStep], keys: Collection[str]) -> dict[str, list[str]]:
    """Return name of each growth step's amplitude -> keys of the imperfections that it multiplies.

    Parameters
    ----------
    steps
        Steps of the programme, of which those of `kind: imperfection` count.
    keys
        Keys below `shell` of the imperfections, such as "imperfections.0".
    """
    items = {step.name: step.load.item for step in steps if isinstance(step.load, ImperfectionStep)}

    def grows(key: str, item: int | None) -> bool:
        # the dot at the end distinguishes items 1 and 10. The key of a random dimple goes on after
        # the number of its item: "imperfections.0.dimples.3"
        return item is None or f"{key}.".startswith(f"imperfections.{item}.")

    grown_keys = dict[str, list[str]]()
    for name, item in items.items():
        grown_keys[name] = [key for key in keys if grows(key, item)]
    return grown_keys
