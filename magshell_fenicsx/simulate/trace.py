"""A path in any amplitude of a scene from any state, for notebooks.

Targets are numbers, or text with a unit where the case has units.

An amplitude is a load parameter, by name in `State.mu`. Pi_i is the derivative of the potential
energy by amplitude i; the conjugate -Pi_i is the displacement on which it does work. An amount is a
number or such a text. The scale of a quantity is the name of its unit in the model, such as "p_c".
"""

import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import chain
from numbers import Real
from typing import Any, cast, get_args

import numpy as np

from magshell_fenicsx.continuation.continuation_run import MAX_STEPS, ContinuationGoal, Until
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.path import ZERO_DISPLACEMENT, Control, Quantity
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.continuation.system import State, max_abs
from magshell_fenicsx.input.section import in_units
from magshell_fenicsx.quantities.registry import amplitude, quantity
from magshell_fenicsx.simulate.path_records import follow_path
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import load_stage

Amount = float | str


def target_values(
    scene: Scene, name: str, key: str, amounts: Sequence[Amount] | Amount, *, of_load: bool
) -> list[float]:
    """Return amounts of an amplitude, or of its conjugate -Pi_i(u), as numbers of the model.

    One amount alone gives a list of one number.

    Parameters
    ----------
    name
        The amplitude.
    key
        The argument of `trace` that has the amounts, for messages.
    amounts
        Numbers, or texts with a unit.
    of_load
        Whether they are amounts of the amplitude itself.

    Raises
    ------
    ValueError
        If one is neither a number nor text with a unit that this quantity has in this case.
    """
    is_single = isinstance(amounts, str | Real) or amounts is None
    list_of_amounts: Sequence[Any] = [amounts] if is_single else cast(Sequence[Any], amounts)
    return [
        number_of_amount(scene, name, f"trace: {key}: {amount!r}", amount, of_load=of_load)
        for amount in list_of_amounts
    ]


def number_of_amount(
    scene: Scene, name: str, place: str, amount: Any, *, of_load: bool = True
) -> float:
    """Return one amount of an amplitude, or of its conjugate, as a number of the model.

    Parameters
    ----------
    place
        Begin of a message.
    amount
        Number, or text with a unit.
    of_load
        Whether it is an amount of the amplitude, rather than of its conjugate.

    Raises
    ------
    ValueError
        If it is neither, or the quantity has no unit in this case.
    """
    if isinstance(amount, Real):
        return float(amount)
    if not isinstance(amount, str):
        raise ValueError(f'{place}: must be a number, or text with a unit such as "100 Pa"')
    column = amplitude(name).column if of_load else amplitude(name).conjugate
    # unit of this quantity in the case, None without units; and the name of its unit in the model
    unit, scale = scene.sizes.unit(column), quantity(column).scale
    # conjugates with a unit: the change of volume of a pressure, the displacement of a force
    forces = (*scene.model.loads.forces, *scene.model.contacts)
    may_have_unit = of_load or name in ("pressure", *forces)
    # in a case without units, any unit of the quantity shows that a text could have one
    any_unit = next((unit_of_quantity.text for unit_of_quantity in quantity(column).units), "")
    text = unit.text if unit else any_unit
    if not (text and may_have_unit):
        quantity_text = name if of_load else f"the conjugate of {name}"
        raise ValueError(f"{place}: {quantity_text} has no unit here: give a number")
    if unit is None:
        needed_keys = "youngs_modulus and lengths of the shell with units"
        raise ValueError(f"{place}: has a unit: that needs {needed_keys}; a number is in {scale}")
    try:
        number = in_units(text)(amount) / scene.sizes.by_unit[unit.key]
    except ValueError as e:
        raise ValueError(f"{place}: {e}") from None
    # a conjugate in its own unit is made a value of -Pi_i
    return number if of_load else number * scene.conjugate_unit(name)


def trace(  # noqa: PLR0913
    scene: Scene | Record,
    name: str,
    start: Record | State | None = None,
    *,
    control: Control = "arc",
    until: Until = "limit",
    targets: Sequence[Amount] | Amount = (),
    quantity: Quantity = "load",
    first: Amount | None = None,
    steps: int = MAX_STEPS,
) -> Iterator[Record]:
    """Follow the equilibria of a scene while one amplitude varies and the others are constant.

    The first record is the start, after Newton's method at its amplitudes. As in `follow`, the last
    record may be an earlier instability that a reduced model excludes (`Record.mode`). Where the
    path ends before its last target, the last record has `reached=False`, and a warning names the
    place.

    Parameters
    ----------
    scene
        The model; or a record of it, from which the path starts.
    name
        The amplitude: "pressure" (p/p_c), "force" (F R/(2 pi D)), "load", that of the field, or
        that of a user-defined term.
    start
        A record or a state, also of another model with as many unknowns and the same amplitudes; by
        default the undeformed shell with all amplitudes zero.
    control
        "load": prescribe the amplitude; "conjugate": prescribe the conjugate displacement -Pi_i(u)
        (`scene.model.system.potential` gives Pi_i); "arc": prescribe the arc length, which passes
        folds of both.
    until
        The end of the path: "limit" at the first instability or the last target, "bifurcation" at
        the first bifurcation or there, "target" there, "points" after `steps` steps.
    targets
        Values to be reached by the prescribed quantity or, with arc length, by `quantity`: numbers,
        or text with a unit such as "100 Pa" where the case has units; -Pi_i(u) is then the change
        of volume ("-80 mm^3"), or the displacement of a force ("2 mm").
    quantity
        "load": the amplitude; "conjugate": -Pi_i(u). Only with arc length.
    first
        Change of the amplitude in the first step; its sign is the direction. By default a tenth of
        the distance to the last target; required for conjugate targets with arc length.
    steps
        Largest number of steps; with "points" the number of steps.

    Raises
    ------
    ValueError
        If the scene has no such amplitude, an argument is none of the words above, a target has a
        unit that the case or the amplitude has not, or the length of the first step is unknown.
    Stopped
        If the path is lost, or there is no equilibrium to start from.
    """
    _refuse_unknown_words(control=(control, Control), until=(until, Until))
    _refuse_unknown_words(quantity=(quantity, Quantity))
    if not (start is None or isinstance(start, Record | State)):
        raise ValueError(f"trace: start: a {type(start).__name__}: give a record or a state")
    if steps < 1:
        raise ValueError(f"trace: steps: {steps}: give a number from 1 on")
    if isinstance(scene, Record):
        start = start or scene
        scene = scene.known_scene("trace", "give a model as well")
    scene.read_functions()
    state = start.point.state if isinstance(start, Record) else start or scene.unloaded()
    scene.refuse_foreign(state)
    scene.refuse_unknown_amplitude("trace", name)
    quantity_of_targets = quantity if control == "arc" else control
    of_load = quantity_of_targets == "load"
    targets = target_values(scene, name, "targets", targets, of_load=of_load)
    # one amount gives one number
    first = None if first is None else target_values(scene, name, "first", first, of_load=True)[0]
    if until == "target" and not targets:
        raise ValueError("trace: until='target' needs targets")
    if first is None and targets:
        if of_load:
            first = (targets[-1] - state.mu[name]) / 10
        elif control == "conjugate":
            first = 1.0  # the targets determine the step length
    if not first:
        raise ValueError(
            f"trace: {name}: give first, the change of the amplitude in the first step, not zero"
        )
    # the equilibrium at the start, at its amplitudes
    outcome = scene.newton.solve(state, name, PrescribedLoad(name, state.mu[name]))
    if not outcome.converged:
        raise Stopped(
            f"there is no equilibrium to start from near the given state: {outcome.reason}"
        )
    if control == "conjugate":
        _refuse_without_effect(scene, name, outcome.state, first)
    # ten first steps are about the distance to a target: the scale of the amplitude
    path, first_point = load_stage(scene).begin(name, control, outcome.state, first, 10 * first)
    if targets and control == "conjugate":
        step = abs(targets[-1] - first_point.s) / 10
        path = path.with_step_options(StepOptions(step, 2 * step, 1e-5 * step))
    sense = float(np.copysign(1.0, first * first_point.dmu))
    goal = ContinuationGoal(until, targets, quantity, steps, sense)
    records_of_path = follow_path(load_stage(scene), path, first_point, goal)
    # a state of which nothing is known is taken for stable but for the modes of the model itself
    excluded_pivots = start.excluded_pivots if isinstance(start, Record) else 0
    first_record = Record("start", "", first_point, excluded_pivots=excluded_pivots)
    records = chain([first_record], records_of_path)
    yield from _with_reached(
        (record.with_scene(scene) for record in records),
        name,
        targets,
    )


def _refuse_unknown_words(**arguments: tuple[str, Any]) -> None:
    """Check that arguments of `trace` are words that it knows.

    Parameters
    ----------
    arguments
        Name of the argument -> the word, and the `Literal` of all that are allowed.

    Raises
    ------
    ValueError
        With the first other word, and those that are allowed.
    """
    for name, (word, words) in arguments.items():
        if word not in get_args(words):
            raise ValueError(f"trace: {name}: {word!r}: allowed are {', '.join(get_args(words))}")


def _refuse_without_effect(scene: Scene, name: str, state: State, change: float) -> None:
    """Check that an amplitude moves the shell; the conjugate of one that does not stays zero.

    Parameters
    ----------
    state
        An equilibrium.
    change
        Change of the amplitude, whose displacement must not be negligible.

    Raises
    ------
    Stopped
        If it moves nothing.
    """
    # derivative of the displacement by the amplitude
    du = scene.newton.response(state, name, PrescribedLoad(name, 0.0), exact=True).du
    system = scene.newton.system
    largest_displacement = max_abs(system.comm, du) * abs(change)
    if largest_displacement < ZERO_DISPLACEMENT * system.length:
        raise Stopped(
            f"{name} moves nothing at the start, so nothing is conjugate to it: follow it by "
            "arc length"
        )


def _with_reached(
    records: Iterator[Record], name: str, targets: Sequence[float]
) -> Iterator[Record]:
    """Yield records; the last one says whether the last target was reached.

    If it was not reached, a warning says where the path ends.

    Parameters
    ----------
    name
        The amplitude.
    targets
        Targets in order; each has a record with the label "target" if it is reached.
    """
    # each record is held back until there is a next one, so that the last is known
    last_record, targets_ahead = next(records), len(targets)
    for record in records:
        yield last_record
        last_record = record
        targets_ahead -= record.label == "target"
    if targets_ahead > 0:
        mode = f" ({last_record.mode})" if last_record.mode else ""
        place = f"{last_record.label}{mode} at {name} = {last_record.point.state.mu[name]:.6g}"
        warnings.warn(
            f"trace: {name}: ends at a {place}, before its target {targets[-1]:.6g}", stacklevel=2
        )
    yield replace(last_record, reached=targets_ahead <= 0)
