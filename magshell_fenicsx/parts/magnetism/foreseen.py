"""Forces of all charges on each other near states at which they were computed, along a path and
beside it.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.dense_tangent import BlockProducts, SinglePrecisionBlocks
from magshell_fenicsx.parts.magnetism.multipole_expansion import InteractionHessian

Array = NDArray[np.float64]
POINTS, MOST = 3, 3  # of the path that are remembered, and coefficients of the polynomial along it
CHANGES = 4  # beside the path that are remembered
FEW = 3  # states of a point before: it, and two that tell a slope
# states nearer to each other than this part of the way from the point before belong to one point
TOGETHER = 0.5
OWN = 0.3  # of a change: what newer ones do not have, at least
STRAIGHT = 0.5  # of a way: along the path, at least
TURNED = 0.02  # angle by which a node has turned since D was turned: it is turned again
APART = 0.1  # of the larger one of two places along the path: their distance, at least
LAST = 6  # products with D that are kept
ALONG = (
    0.999  # cosine of the angle between a change and a direction along which forces are then known
)
SLOPE = 0.05  # of a way: two states as near as this one to each other tell a slope


@dataclass(frozen=True)
class Known:
    """A state u of all nodes with this rank's part of the forces there, and of D u."""

    u: Array
    forces: Array
    product: Array

    @property
    def rest(self) -> Array:
        """The forces without D u."""
        return self.forces - self.product


class Foreseen:
    """Forces near states at which they were computed, by an earlier second derivative D and by what
    D lacks.

    D is here what is stored between nodes of cells in boxes that touch: what it lacks is smooth
    along the path, and small beside it. Along the path, the forces without D u are a polynomial
    through its last points. It has slopes at points where two states near each other are known.
    Changes of u beside the path correct D and the polynomial by secants, the newest change first
    (J. E. Dennis, R. B. Schnabel, SIAM Review 21, 1979, 443: secants of several steps).
    """

    def __init__(
        self, blocks: BlockProducts, turns: Callable[[Array, Array], Array], *, alone: bool
    ) -> None:
        self._blocks, self._turns, self._alone = blocks, turns, alone  # on one rank
        self._points = list[list[Known]]()  # the newest last; of each point several states
        self._ways = list[float]()  # to each point from the one before
        self._D: InteractionHessian | None = None
        self._stored: SinglePrecisionBlocks | None = None  # of D, turned to `_turned`
        self._turned: Array | None = None
        self._products = deque[tuple[Array, Array]](maxlen=LAST)  # the last u and D u
        self._model: tuple[Along, list[tuple[Array, Array]]] | None = None

    def learn(self, u: Array, forces: Array) -> None:
        """Forces at a state."""
        known = Known(u, forces, self._product(u) if self._D else np.zeros_like(forces))
        if self._points and not self._begins(u):
            self._points[-1] = [*self._points[-1][-CHANGES:], known]
        else:
            way = float(np.linalg.norm(u - self._points[-1][-1].u)) if self._points else 0.0
            before = [point[-FEW:] for point in self._points[1 - POINTS :]]
            self._points, self._ways = [*before, [known]], [*self._ways[1 - POINTS :], way]
        self._model = None

    def at(self, u: Array, D: InteractionHessian, of_D: Array) -> Array | None:
        """This rank's part of the forces, from those of D at its state; None if nothing is
        known."""
        if not (self._points and np.isfinite(u).all()):
            return None
        if D is not self._D or self._begins(u):
            self._turn(u, D, of_D)
        along, changes = self._model = self._model or self._made()
        foreseen, s = self._product(u) + along.rest(u), u - along.base.u
        for q, y in changes:
            foreseen = foreseen + (q @ s) * y
        return foreseen

    def extrapolation_holds_along(self, u: Array, step: Array) -> bool:
        """Whether the forces at two states near each other and u are known, one from the other
        along a direction.
        """
        if not self._points or self._begins(u):
            return False
        near, size = SLOPE * self._ways[-1], float(np.linalg.norm(step))
        for one, other in pairwise(self._points[-1]):
            change, away = one.u - other.u, float(np.linalg.norm(u - one.u))
            way = float(np.linalg.norm(change))
            if max(way, away) < near and abs(change @ step) > ALONG * size * way:
                return True
        return False

    def _begins(self, u: Array) -> bool:
        """Whether a state is not of the last point."""
        return float(np.linalg.norm(u - self._points[-1][-1].u)) > TOGETHER * self._ways[-1]

    def _turn(self, u: Array, D: InteractionHessian, of_D: Array) -> None:
        """Take D as it is at another state, if nodes have turned enough."""
        before = self._turned if D is self._D else None
        if before is not None and 2 * np.abs(self._turns(u, before)[:, :3]).max() < TURNED:
            return
        turned = D.turned(self._turns(u, of_D))
        if turned is None and before is not None:
            return
        self._D, self._turned = D, u
        self._stored = (
            SinglePrecisionBlocks.from_blocks(D.near_blocks, upper=self._alone)
            if turned is None
            else turned
        )
        self._model = None
        self._products.clear()
        self._points = [
            [Known(k.u, k.forces, self._product(k.u)) for k in point] for point in self._points
        ]

    def _made(self) -> tuple["Along", list[tuple[Array, Array]]]:
        """The polynomial along the path, and orthonormal changes with what is lacking along
        them."""
        along, changes = Along.through(self._points), list[tuple[Array, Array]]()
        pairs = [pair for point in reversed(self._points) for pair in pairwise(reversed(point))]
        for one, other in pairs[:CHANGES]:
            s = one.u - other.u
            y, size = (
                one.rest - other.rest - along.rest(one.u) + along.rest(other.u),
                float(np.linalg.norm(s)),
            )
            for _ in range(2):
                for q, of_q in changes:
                    part = float(q @ s)
                    s, y = s - part * q, y - part * of_q
            rest = float(np.linalg.norm(s))
            if rest > OWN * size:
                changes.append((np.asarray(s / rest), np.asarray(y / rest)))
        return along, changes

    def _product(self, u: Array) -> Array:
        for before, product in self._products:
            if np.array_equal(u, before):
                return product
        assert self._D
        assert self._stored
        product = self._blocks.times(self._stored, u)
        self._products.appendleft((u, product))
        return product


@dataclass(frozen=True)
class Along:
    """What forces are without D u, as a polynomial of the place along a direction, from the newest
    state on.

    Attributes
    ----------
    direction
        Of size one.
    way
        The unit of places.
    coefficients
        Of the powers from the first on.
    """

    base: Known
    direction: Array
    way: float
    coefficients: Array

    @classmethod
    def through(cls, points: list[list[Known]]) -> "Along":
        """The polynomial through the last state of each point; the newest point is the last."""
        base, before = points[-1][-1], points[-2][-1] if len(points) > 1 else None
        if before is None or np.array_equal(before.u, base.u):
            return cls(base, np.zeros_like(base.u), 1.0, np.zeros((0, len(base.forces))))
        direction, way = base.u - before.u, float(np.linalg.norm(base.u - before.u))
        direction = np.asarray(direction / way)
        rows, values, places = list[Array](), list[Array](), [0.0]
        powers = np.arange(1.0, MOST + 1)
        for point in reversed(points):
            last = point[-1]
            s = last.u - base.u
            at, size = float(direction @ s) / way, float(np.linalg.norm(s)) / way
            if last is not base:
                if abs(at) < STRAIGHT * size or min(abs(at - x) for x in places) < APART * max(
                    1.0, abs(at)
                ):
                    continue
                places.append(at)
                rows.append(np.asarray(at**powers))
                values.append(last.rest - base.rest)
            for one, other in pairwise(reversed(point)):
                change = one.u - other.u
                step, length = float(direction @ change) / way, float(np.linalg.norm(change)) / way
                if len(rows) < MOST and STRAIGHT * length < abs(step) and length < SLOPE:
                    at = float(direction @ (one.u - base.u)) / way
                    rows.append(np.asarray((at**powers - (at - step) ** powers) / step))
                    values.append(np.asarray((one.rest - other.rest) / step))
                    break
            if len(rows) == MOST:
                break
        n = len(rows)
        coefficients = np.linalg.solve(np.array(rows)[:, :n], np.array(values))
        return cls(base, direction, way, np.asarray(coefficients, dtype=np.float64))

    def rest(self, u: Array) -> Array:
        """At a state, on the path."""
        at = float(self.direction @ (u - self.base.u)) / self.way
        return np.asarray(
            self.base.rest + at ** np.arange(1, len(self.coefficients) + 1) @ self.coefficients
        )
