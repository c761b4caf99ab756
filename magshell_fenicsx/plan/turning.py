"""Whether a formula of x, y, z is the same along every meridian."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.expressions import formula
from magshell_fenicsx.mesh.frame import rotation
from magshell_fenicsx.plan.plan import Span

ANGLES = [2.399963 * i for i in range(90)]  # the golden angle: nothing periodic meets them all
Array = NDArray[np.float64]
SAME = 1e-9  # of the largest value: differences that are rounding


def scalar_turns(text: str, span: Span, length: float = 1.0) -> bool:
    """Whether a formula has the same value all around; its unit of length is R over `length`."""
    f, places = formula(text), length * _places(span)
    return _same([f(*(places @ rotation(angle)).T)[:, None] for angle in ANGLES])


def vector_turns(components: Sequence[str], span: Span, length: float = 1.0) -> bool:
    """Whether the vector with these components turns with the meridian and has none across it."""
    fs, places, found = [formula(text) for text in components], length * _places(span), []
    for Q in map(rotation, ANGLES):
        found.append(np.column_stack([f(*(places @ Q).T) for f in fs]) @ Q.T)
    return _same([*found, found[0] * [1.0, 0.0, 1.0]])


def _places(span: Span) -> Array:
    """Along a meridian, without its ends: a formula may divide by zero on the axis."""
    return span.sample()[1:-1]


def _same(values: Sequence[Array]) -> bool:
    first = values[0]
    return all(bool((np.abs(v - first) <= SAME * np.abs(first).max()).all()) for v in values)
