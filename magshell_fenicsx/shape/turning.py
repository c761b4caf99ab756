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
class Piece:
    """The meridian of one of several shells, a part of a `Span`.

    Attributes
    ----------
    name
        Of the shell.
    ends
        First and last value of the parameter.
    place
        Place (3,) in space -> parameter of the nearest place of it, and azimuth (rad).
    vertices
        Those of its mesh, with cells of that size up to that distance from its pole, where
        something presses on it.
    """

    name: str
    ends: tuple[float, float]
    place: Callable[[Array], tuple[float, float]]
    vertices: Callable[[Sequence[tuple[float, float]]], Array]

    @property
    def length(self) -> float:
        """Of its parameter."""
        return self.ends[1] - self.ends[0]


@dataclass(frozen=True)
class Span:
    """A meridian, walked from the pole or one edge to the other; or those of several shells with
    one axis.

    Attributes
    ----------
    length
        Of its chart, which starts at 0.
    circles
        Where the curvature jumps.
    names
        Of its ends; None for a pole, and where shells are joined.
    embedding, normal
        Chart (n, 2), its second coordinate 0 -> the plane of e1 and e3, and the normal of the
        perfect surface there.
    place
        Chart (2,) of the surface -> parameter of this one and azimuth (rad).
    curvature
        The largest of the meridian over 1/R, at least 1; of several that which has the most waves
        around e3.
    largest
        Size of cells that shows the imperfections.
    vertices
        Those of its mesh, if that is given.
    also
        Places (n, 3) of the surface at which formulas are narrow.
    pieces
        Those of several shells; none of one.
    joints
        Of each joint of shells both parameters: two edges that meet have the same one.
    """

    length: float
    circles: tuple[float, ...]
    names: tuple[str | None, ...]
    embedding: Embedding
    normal: Embedding
    place: Callable[[NDArray[np.float64]], tuple[float, float]]
    curvature: float = 1.0
    largest: float = inf
    vertices: NDArray[np.float64] | None = None
    also: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    pieces: tuple[Piece, ...] = ()
    joints: tuple[tuple[float, float], ...] = ()

    def sample(self) -> NDArray[np.float64]:
        """Places (n, 3) along it, its ends among them."""
        return self._at(
            [np.linspace(first, last, 401, dtype=np.float64) for first, last in self._parts]
        )

    def between(self) -> NDArray[np.float64]:
        """The same without its ends: a formula may divide by zero on the axis."""
        return self._at(
            [np.linspace(first, last, 401, dtype=np.float64)[1:-1] for first, last in self._parts]
        )

    def place_of(self, name: str, x: Array) -> tuple[float, float]:
        """Parameter and azimuth (rad) of a named place, which is that of the shell in its name."""
        piece = next((each for each in self.pieces if name.startswith(f"{each.name}_")), None)
        return piece.place(x) if piece else self.place(x)

    @property
    def knots(self) -> Array:
        """Parameters that cells do not pass over."""
        return np.array(sorted({*np.ravel(self._parts), *self.circles}))

    def ends(self) -> dict[str, NDArray[np.float64]]:
        """Name of each edge -> its place (rho, z)."""
        places = self._at([np.array(ends) for ends in self._parts])[:, [0, 2]]
        return {
            name: np.asarray(place) for name, place in zip(self.names, places, strict=True) if name
        }

    @property
    def _parts(self) -> list[tuple[float, float]]:
        return [piece.ends for piece in self.pieces] or [(0.0, self.length)]

    def _at(self, parameters: Sequence[Array]) -> Array:
        s = np.concatenate(parameters)
        return self.embedding(np.column_stack([s, 0 * s]))


def scalar_turns(text: str, span: Span, length: float = 1.0) -> bool:
    """Whether a formula has the same value all around; its unit of length is R over `length`."""
    f, places = formula(text), length * span.between()
    around, turned = length * span.also, length * _at_azimuth_zero(span.also)[0]
    return _same([f(*(places @ rotation(angle)).T)[:, None] for angle in ANGLES]) and _same(
        [f(*around.T)[:, None], f(*turned.T)[:, None]]
    )


def vector_turns(
    components: Sequence[str], span: Span, length: float = 1.0, *, in_space: bool = False
) -> bool:
    """Whether the vector with these components turns with the meridian and has none across it.

    On the surface, and with `in_space` beside it, where it may move to.

    Parameters
    ----------
    length
        R in the unit of the formulas' places.
    """
    vectors, places = vectors_of(components), span.between()
    if in_space:
        places = beside(places) * [1.0, 0.0, 1.0]
    turned, Q = _at_azimuth_zero(span.also)
    around = np.einsum("nij,nj->ni", Q, vectors(length * span.also))
    return _turns(lambda x: vectors(length * x), places) and _same(
        [vectors(length * turned), around]
    )


def _at_azimuth_zero(x: Array) -> tuple[Array, Array]:
    """Places (n, 3) turned about e3 into y = 0, and the rotations (n, 3, 3)."""
    rho, one, none = np.hypot(x[:, 0], x[:, 1]), np.ones(len(x)), np.zeros(len(x))
    c, s = np.where(rho > 0, x[:, :2].T / np.where(rho > 0, rho, 1.0), [[1.0], [0.0]])
    Q = np.array([[c, s, none], [-s, c, none], [none, none, one]])
    return np.column_stack([rho, none, x[:, 2]]), np.moveaxis(Q, 2, 0)


def field_turns(field: Callable[[Array], Array], span: Span, *, smooth: bool = True) -> bool:
    """Whether a field, smooth as that of sources, turns with the meridian and has no component
    across it, there.
    """
    return (
        _turns(field, span.between()[::20], ANGLES[:12])
        if smooth
        else _turns(field, span.between())
    )


def _turns(
    field: Callable[[Array], Array], places: Array, angles: Sequence[float] = ANGLES
) -> bool:
    turned = [field(places @ Q) @ Q.T for Q in map(rotation, angles)]
    return _same([*turned, turned[0] * [1.0, 0.0, 1.0]])


def vectors_of(components: Sequence[str]) -> Callable[[Array], Array]:
    """The vectors (n, 3) with these components at places (n, 3)."""
    fs = [formula(text) for text in components]
    return lambda x: np.stack([f(*x.T) for f in fs], axis=-1)


def beside(x: Array) -> Array:
    """Places (n, 3), and others near them."""
    return np.vstack([x, x + NEAR * np.random.default_rng(2026).uniform(-1, 1, x.shape)])


def _same(values: Sequence[Array]) -> bool:
    first = values[0]
    return not first.size or all(
        bool((np.abs(v - first) <= SAME * np.abs(first).max()).all()) for v in values
    )
