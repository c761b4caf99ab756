"""How near a body is to the undeformed shell, and to another body."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.bodies.contact import Contact
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
ROUNDS, FINER = 6, 0.2  # refinements of a search, and how much smaller its range is each time
AROUND = 1.5  # half the side, over R, of the cube in which bodies may overlap


def least_gap(contact: Contact, drawn: Outline, Q: Array, half: Callable[[Array], Array]) -> float:
    """The least gap over R between a body and the face of the undeformed shell.

    Parameters
    ----------
    Q
        Turns places into the body's frame.
    half
        Half the thickness over R at places (n, 3).
    """

    def gap(x: Array) -> Array:
        return contact.gap(x @ Q.T, 0.0, half(x))[0]

    chart = drawn.charts()
    if chart is None:
        return float(gap(drawn.sample()).min())
    reach = np.full(2, 0.1 * float(np.ptp(chart, axis=0).max()))

    def on_chart(x: Array) -> Array:
        return gap(drawn.embedding(np.array([drawn.within(p) for p in x])))

    values = gap(drawn.embedding(chart))
    return _refined(on_chart, chart[values.argmin()], float(values.min()), reach)[1]


def overlap(one: Contact, other: Contact) -> float:
    """How deep two bodies overlap near the shell at approach zero, over R; negative if they are apart."""

    def farther(x: Array) -> Array:
        return np.maximum(one.distance(x)[0], other.distance(x)[0])

    x = np.concatenate([np.random.default_rng(3).uniform(-AROUND, AROUND, (4000, 3)), [one.front, other.front]])
    values = farther(x)
    return -_refined(farther, x[values.argmin()], float(values.min()), np.full(3, 0.5))[1]


def _refined(f: Callable[[Array], Array], best: Array, least: float, reach: Array) -> tuple[Array, float]:
    """A minimum near a place, by random places in a box that shrinks around the best one."""
    rng = np.random.default_rng(5)
    for _ in range(ROUNDS):
        x = best + reach * rng.uniform(-1, 1, (200, len(best)))
        values = f(x)
        if values.min() < least:
            best, least = x[values.argmin()], float(values.min())
        reach = FINER * reach
    return best, least
