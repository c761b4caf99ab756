"""A meridian, and whether a formula of x, y, z is the same along every one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import inf

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import formula
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.mesh.patch import Embedding

ANGLES = [
    2.399963 * i for i in range(720)
]  # the golden angle: nothing periodic meets them all, nor anything wider than 0.01
Array = NDArray[np.float64]
NEAR = 0.1  # over R
SAME = 1e-9  # of the largest value: differences that are rounding


@dataclass(frozen=True)
class Span:
    """A meridian, walked from the pole or one edge to the other.

    Attributes
    ----------
    length
        Of its chart, which starts at 0.
    circles
        Where the curvature jumps.
    names
        Of its ends; None for the pole.
    embedding, normal
        Chart (n, 2), its second coordinate 0 -> the plane of e1 and e3, and the normal of the perfect surface there.
    place
        Chart (2,) of the surface -> parameter of this one and azimuth (rad).
    curvature
        The largest of the meridian over 1/R, at least 1.
    largest
        Size of cells that shows the imperfections.
    vertices
        Those of its mesh, if that is given.
    also
        Places (n, 3) of the surface at which formulas are narrow.
    """

    length: float
    circles: tuple[float, ...]
    names: tuple[str | None, str]
    embedding: Embedding
    normal: Embedding
    place: Callable[[NDArray[np.float64]], tuple[float, float]]
    curvature: float = 1.0
    largest: float = inf
    vertices: NDArray[np.float64] | None = None
    also: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))

    def sample(self) -> NDArray[np.float64]:
        """Places (n, 3) along it, its ends among them."""
        s = np.linspace(0.0, self.length, 401)
        return self.embedding(np.column_stack([s, 0 * s]))


def scalar_turns(text: str, span: Span, length: float = 1.0) -> bool:
    """Whether a formula has the same value all around; its unit of length is R over `length`."""
    f, places = formula(text), length * _places(span)
    around, turned = length * span.also, length * _at_azimuth_zero(span.also)[0]
    return _same([f(*(places @ rotation(angle)).T)[:, None] for angle in ANGLES]) and _same(
        [f(*around.T)[:, None], f(*turned.T)[:, None]]
    )


def vector_turns(components: Sequence[str], span: Span, length: float = 1.0, *, in_space: bool = False) -> bool:
    """Whether the vector with these components turns with the meridian and has none across it.

    On the surface, and with `in_space` beside it, where it may move to.

    Parameters
    ----------
    length
        R in the unit of the formulas' places.
    """
    vectors, places = vectors_of(components), _places(span)
    if in_space:
        places = beside(places) * [1.0, 0.0, 1.0]
    turned, Q = _at_azimuth_zero(span.also)
    around = np.einsum("nij,nj->ni", Q, vectors(length * span.also))
    return _turns(lambda x: vectors(length * x), places) and _same([vectors(length * turned), around])


def _at_azimuth_zero(x: Array) -> tuple[Array, Array]:
    """Places (n, 3) turned about e3 into y = 0, and the rotations (n, 3, 3)."""
    rho, one, none = np.hypot(x[:, 0], x[:, 1]), np.ones(len(x)), np.zeros(len(x))
    c, s = np.where(rho > 0, x[:, :2].T / np.where(rho > 0, rho, 1.0), [[1.0], [0.0]])
    Q = np.array([[c, s, none], [-s, c, none], [none, none, one]])
    return np.column_stack([rho, none, x[:, 2]]), np.moveaxis(Q, 2, 0)


def field_turns(field: Callable[[Array], Array], span: Span) -> bool:
    """Whether the smooth field of sources turns with the meridian and has no component across it, on the surface."""
    return _turns(field, _places(span)[::20], ANGLES[:12])


def _turns(field: Callable[[Array], Array], places: Array, angles: Sequence[float] = ANGLES) -> bool:
    turned = [field(places @ Q) @ Q.T for Q in map(rotation, angles)]
    return _same([*turned, turned[0] * [1.0, 0.0, 1.0]])


def vectors_of(components: Sequence[str]) -> Callable[[Array], Array]:
    """The vectors (n, 3) with these components at places (n, 3)."""
    fs = [formula(text) for text in components]
    return lambda x: np.stack([f(*x.T) for f in fs], axis=-1)


def beside(x: Array) -> Array:
    """Places (n, 3), and others near them."""
    return np.vstack([x, x + NEAR * np.random.default_rng(2026).uniform(-1, 1, x.shape)])


def _places(span: Span) -> Array:
    """Along a meridian, without its ends: a formula may divide by zero on the axis."""
    return span.sample()[1:-1]


def _same(values: Sequence[Array]) -> bool:
    first = values[0]
    return not first.size or all(bool((np.abs(v - first) <= SAME * np.abs(first).max()).all()) for v in values)
