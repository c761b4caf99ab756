"""The programme of a case: its load steps, rules that all of them share, and names of patches.

The programme is the sequence of load steps that a run follows. A step drives an amplitude: a load
parameter, by name. The conjugate of an amplitude is the displacement on which it does work (of a
pressure the volume). During a step other loads are held: the load itself stays, or its conjugate,
or a gas is enclosed. A limit is the first instability on a path; with `until: limit` a step ends
there.
"""

from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias, Union

from pydantic import Discriminator, Field, Tag

from magshell_fenicsx.input.section import ChosenByKey
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.bodies.contact_step import ContactSection, approaches
from magshell_fenicsx.parts.motion.motion_step import TimeSection
from magshell_fenicsx.parts.registered import FORMER_KINDS, STEPS
from magshell_fenicsx.parts.shell_sections import MeshSurface, ShellSection, Surface
from magshell_fenicsx.parts.step import LEAST_TARGET, ProgrammeStep, Step
from magshell_fenicsx.parts.step_course import Gas

if TYPE_CHECKING:
    OneStep: TypeAlias = Step
else:
    OneStep = Annotated[Union[tuple(STEPS.values())], ChosenByKey("kind", FORMER_KINDS)]  # noqa: UP007
PROGRAMME = "programme"  # tag of a list of steps
Loading: TypeAlias = Annotated[
    Annotated[OneStep, Tag("one")]
    | Annotated[list[OneStep], Tag(PROGRAMME), Field(min_length=1, max_length=1000)],
    Discriminator(lambda data: PROGRAMME if isinstance(data, list) else "one"),
]


def loads_by_key(loading: Any) -> dict[str, Any]:
    """Return key -> load of the section `loading`, which is one load or a list of steps.

    Keys are "loading", or "loading.0" and so on. Plain data of loads are accepted too.
    """
    if isinstance(loading, Sequence):
        return {f"loading.{i}": load for i, load in enumerate(loading)}
    return {"loading": loading} if loading else {}


def programme(loading: Step | Sequence[Step] | None, context: Context) -> tuple[ProgrammeStep, ...]:
    """Return the load steps of a case.

    They are those of a list. Before a single load come the steps that it implies, such as the
    field.

    Parameters
    ----------
    loading
        The load or the list of the case; None without.
    context
        The rest of the case.
    """
    implied_steps: list[tuple[str, Step]] = []
    if not isinstance(loading, Sequence):  # in a list the author has written all steps
        kinds = [kind for kind in STEPS.values() if kind.rank_before_load]
        for kind in sorted(kinds, key=lambda kind: kind.rank_before_load):
            # what the load drives itself does not grow before it
            by_history = getattr(kind, "amplitude", "") in _driven_by_history(loading)
            if not (isinstance(loading, kind) or by_history):
                implied_steps += kind.steps_before_load(context)
    keyed_loads = [*implied_steps, *loads_by_key(loading).items()]
    loads = [load for _, load in keyed_loads]
    places_of_amplitude = dict[str, list[Any]]()  # different places, in the order of the steps
    steps = []
    for number, (key, load) in enumerate(keyed_loads, 1):
        if isinstance(load, ContactSection):  # a body has one approach, whatever step moves it
            name = load.approach_in(approaches(context.sections["bodies"], loads))
        else:  # loads of one kind at different places get numbers: force, force_2, ...
            places = places_of_amplitude.setdefault(load.amplitude, [])
            if load.place not in places:
                places.append(load.place)
            number_of_place = places.index(load.place) + 1
            name = load.amplitude + (f"_{number_of_place}" if number_of_place > 1 else "")
        steps.append(ProgrammeStep(number, name, key, load, _driven_by_history(load)))
    return tuple(steps)


def _driven_by_history(load: Step | None) -> tuple[str, ...]:
    """Return the amplitudes that follow histories in a load; none but in a motion."""
    return load.drives if isinstance(load, TimeSection) else ()


def refuse_unfit_steps(context: Context) -> None:
    """Check that each load step has what it needs, a way to go, and known amplitudes to hold.

    Raises
    ------
    ValueError
        With the key and what is allowed.
    """
    for step in context.steps:
        load, key = step.load, step.key
        load.refuse_unfit(context.at_step(step))
        # the first step that drives an amplitude begins at zero, so that its goal must not be zero
        _, goal_value = load.end.goal or (None, None)
        if step.name not in context.driven_before(step.number) and goal_value == 0:
            raise ValueError(
                f"{key}: the target must not be zero (at least {LEAST_TARGET:g} in size): the "
                "first step of a load begins there"
            )
        # a static step needs equilibrium at its begin: after a motion the shell must have come to
        # rest
        earlier_steps = context.steps_before(step.number)
        begins_in_motion = bool(earlier_steps) and not earlier_steps[-1].load.end.at_rest
        if begins_in_motion and not isinstance(load, TimeSection):
            kind = earlier_steps[-1].kind
            raise ValueError(
                f"{key}: begins in equilibrium: the step of kind: {kind} before it needs "
                "until: rest"
            )
        _refuse_unfit_hold(step, context.steps)


def _refuse_unfit_hold(step: ProgrammeStep, steps: Sequence[ProgrammeStep]) -> None:
    """Raise ValueError if a step asks to hold an amplitude, or its conjugate, that it cannot hold.

    `steps` are all steps of the programme, whose amplitudes a step may hold.
    """
    # amplitude -> the load that drives it; a pressure can be held even where no step applies one
    holdable_loads: dict[str, Step | None] = {"pressure": None}
    holdable_loads |= {any_step.name: any_step.load for any_step in steps if any_step.load.holdable}
    if isinstance(step.load, TimeSection):  # its amplitude is the time
        holdable_loads.pop(step.name)
    to_limit = step.until == "limit"
    # a step that ends at an instability may hold the conjugate of its own amplitude
    refused_names = set() if to_limit else {step.name}
    names = sorted(set(holdable_loads) - refused_names)
    allowed = ", ".join(names) or "none"
    for name, manner in step.load.hold.items():
        key = f"{step.key}.hold.{name}"
        holds_conjugate = manner == "conjugate"
        # the step's own amplitude: its conjugate alone, on a way to an instability without an end
        may_hold_own = to_limit and holds_conjugate
        if name == step.name and not may_hold_own:
            raise ValueError(f"{key}: this step drives {name}; allowed: {allowed}")
        if name == step.name and step.load.end.bound:
            raise ValueError(
                f"{key}: conjugate: the way to the instability has no end: leave out the target"
            )
        # any amplitude, and a gas for the pressure alone
        if name not in holdable_loads:
            raise ValueError(f"{key}: the programme has no such amplitude; allowed: {allowed}")
        if isinstance(manner, Gas) and name != "pressure":
            raise ValueError(
                f"{key}: a gas holds the pressure, not {name}; allowed: load, conjugate"
            )
        # a load, or a pressure that no step applies, can always be held
        load = holdable_loads[name]
        if (holds_conjugate or isinstance(manner, Gas)) and load is not None:
            _refuse_unfit_conjugate(key, load, step)


def _refuse_unfit_conjugate(key: str, load: Step, step: ProgrammeStep) -> None:
    """Raise ValueError if a step cannot hold the conjugate of another step's amplitude.

    Parameters
    ----------
    key
        Key of the request, for the message.
    load
        The load that drives the amplitude.
    step
        The step that would hold the conjugate.
    """
    if not load.conjugate:
        # a pressure with a profile works on no volume, so that no gas holds it either
        what = "a pressure with a profile" if getattr(load, "profile", None) else "it"
        raise ValueError(
            f"{key}: conjugate: nothing that can be held is conjugate to {what}; allowed: load"
        )
    # `released` is the reason why a conjugate cannot be held while the shell moves; it moves in a
    # motion, and where it is released at the end of a step
    if not load.released:
        return
    if isinstance(step.load, TimeSection) or step.load.end.snap:
        raise ValueError(f"{key}: conjugate: {load.released}")


def refuse_unknown_patches(
    key: str, patches: Iterable[str], shell: ShellSection | Surface, dimples: Collection[str]
) -> None:
    """Check that a shell has the patches that a key of the case names.

    A mesh file is not checked here: its patches are known when it is read.

    Parameters
    ----------
    dimples
        Names of the patches within the rims of the shell's dimples.

    Raises
    ------
    ValueError
        If it has not.
    """
    if isinstance(shell, MeshSurface):
        return
    if not dimples:
        needs_dimple = "dimple" in patches or not isinstance(shell, ShellSection)
        if needs_dimple:
            raise ValueError(
                f"{key}: the shell has no dimple: patches are those within dimples, or of a mesh "
                "file"
            )
    # the patches within dimples, and all of the surface outside them
    allowed = [*(dimples or ["dimple"]), "rest"]
    if unknown := set(patches) - set(allowed):
        raise ValueError(
            f"{key}: {min(unknown)}: a {shell.geometry} has only {', '.join(allowed[:-1])} and rest"
        )
