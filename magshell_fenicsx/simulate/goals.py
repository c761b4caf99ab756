"""The targets of a `trace`: numbers, or text with a unit where the case has units."""

from collections.abc import Sequence
from numbers import Real
from typing import Any, cast

from magshell_fenicsx.input.section import in_units
from magshell_fenicsx.quantities.registry import amplitude, quantity
from magshell_fenicsx.simulate.scene import Scene

Amount = float | str


def goals(scene: Scene, name: str, key: str, amounts: Sequence[Amount] | Amount, *, of_load: bool) -> list[float]:
    """Amounts of an amplitude, or of its conjugate -Pi_i(u), as numbers; one alone is a list of one.

    Parameters
    ----------
    key
        The argument of `trace` that has them, for messages.
    of_load
        Whether they are of the amplitude itself.

    Raises
    ------
    ValueError
        If one is neither a number nor text with a unit that this quantity has in this case.
    """
    alone = isinstance(amounts, str | Real) or amounts is None
    several: Sequence[Any] = [amounts] if alone else cast(Sequence[Any], amounts)
    return [_number(scene, name, f"trace: {key}: {each!r}", each, of_load) for each in several]


def _number(scene: Scene, name: str, where: str, amount: Any, of_load: bool) -> float:
    if isinstance(amount, Real):
        return float(amount)
    if not isinstance(amount, str):
        raise ValueError(f'{where}: must be a number, or text with a unit such as "100 Pa"')
    known = amplitude(name)
    column = known.column if of_load else known.conjugate
    unit, scale = scene.sizes.unit(column), quantity(column).scale
    sized = of_load or name == "pressure" or name in (*scene.model.loads.forces, *scene.model.contacts)
    text = unit.text if unit else next((each.text for each in quantity(column).units), "")
    if not (text and sized):
        of = name if of_load else f"the conjugate of {name}"
        raise ValueError(f"{where}: {of} has no unit here: give a number")
    if unit is None:
        needed = "youngs_modulus and lengths of the shell with units"
        raise ValueError(f"{where}: has a unit: that needs {needed}; a number is in {scale}")
    try:
        number = in_units(text)(amount) / scene.sizes.of[unit.key]
    except ValueError as e:
        raise ValueError(f"{where}: {e}") from None
    return number if of_load else number * scene.conjugate_unit(name)
