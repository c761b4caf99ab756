"""Extrapolated forces of all charges on each other, from states on a path and beside it.

Input: forces that were computed at states (`ForceExtrapolation.add_state`) and an earlier second
derivative. Output: forces at nearby states. See docs/theory.md.

- A state is the displacement u of all nodes. Forces are the gradient of the energy by the unknowns
  of this rank.
- A point is a group of states near each other on a path of equilibria, its last state the newest.
- D is an earlier second derivative of the energy: only its stored part, between near nodes.
- The remainder at a state are the forces less D u. It varies slowly along the path.
- A change is the difference of two states; q is its unit vector, y the change of the remainder.
- A secant makes the model right along a change: it adds y (q . s) to the forces at u, s the change
  of u from the newest state.
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
PATH_POINTS = 3  # of the path whose forces are stored
MAX_COEFFICIENTS = 3  # of the polynomial along the path
MAX_CHANGES = 4  # beside the path whose forces are stored
STATES_PER_EARLIER_POINT = 3  # that are stored: the point, and two that tell a slope
# distance of states of one point over that from the point before, at most
SAME_POINT_RATIO = 0.5
MIN_NEW_SHARE = 0.3  # of a change, that newer changes do not have
MIN_ALONG_SHARE = 0.5  # of a way, along the path
ROTATION_TOLERANCE = 0.02  # rad that a node rotates before D is rotated again
MIN_SEPARATION = 0.1  # of two positions along the path, over the larger one
STORED_PRODUCTS = 6  # with D
DIRECTION_COSINE = 0.999  # of a change and a direction along which forces are then known
SLOPE_DISTANCE_RATIO = 0.05  # distance of two states that tell a slope, over that of points


@dataclass(frozen=True)
class ForceState:
    """A state u of all nodes, with this rank's part of the forces there and of D u.

    D is the stored part of an earlier second derivative of the energy.
    """

    u: Array
    forces: Array
    product: Array

    @property
    def remainder(self) -> Array:
        """The forces without D u."""
        return self.forces - self.product


class ForceExtrapolation:
    """Model of the forces near states at which they were computed, by an earlier D.

    D is the stored part of a second derivative, between nodes of cells in boxes that touch. The
    part that is not stored is smooth along the path, and small across it. Along the path, the
    remainder is a polynomial through the last points. It also has the right slope at points where
    two states near each other are known. Changes of u across the path correct D and the polynomial
    by secants, the newest change first (J. E. Dennis, R. B. Schnabel, SIAM Review 21, 1979, 443:
    secants of several steps).

    Parameters
    ----------
    blocks
        Products of stored blocks with vectors.
    rotations
        Function of a state and an earlier state -> quaternions (nodes, 4), scalar last: the
        rotations of nodes from the earlier state.
    is_single_rank
        Whether all nodes are on this rank.

    Attributes
    ----------
    _points, _distances
        States of each point, the newest point and state last; the distance to each point from the
        one before.
    _D, _rotated_u, _stored
        D as it was given, the state to which its nodes have been rotated, and the rotated blocks.
    _products
        The last states with their products D u.
    _model
        The polynomial along the path and the secants (q, y); None until forces are asked for.
    """

    def __init__(
        self,
        blocks: BlockProducts,
        rotations: Callable[[Array, Array], Array],
        *,
        is_single_rank: bool,
    ) -> None:
        """Begin without states and without a second derivative."""
        self._blocks, self._rotations, self._is_single_rank = blocks, rotations, is_single_rank
        self._points = list[list[ForceState]]()  # of each point its states; the newest are last
        self._distances = list[float]()  # to each point from the one before
        self._D: InteractionHessian | None = None
        self._stored: SinglePrecisionBlocks | None = None  # of D, turned to `_rotated_u`
        self._rotated_u: Array | None = None
        self._products = deque[tuple[Array, Array]](maxlen=STORED_PRODUCTS)  # the last u and D u
        self._model: tuple[PathPolynomial, list[tuple[Array, Array]]] | None = None

    def add_state(self, u: Array, forces: Array) -> None:
        """Add this rank's part of forces that were computed at a state u of all nodes.

        The state starts a new point of the path if it is far from the last point. Otherwise it is
        one more state of that point.
        """
        state = ForceState(u, forces, self._product(u) if self._D else np.zeros_like(forces))
        if self._points and not self._is_new_point(u):
            self._points[-1] = [*self._points[-1][-MAX_CHANGES:], state]
        else:
            # from the latest state of the last point
            distance = float(np.linalg.norm(u - self._points[-1][-1].u)) if self._points else 0.0
            # of earlier points a few states are kept, and the new point begins with this one
            earlier_points = [
                point[-STATES_PER_EARLIER_POINT:] for point in self._points[1 - PATH_POINTS :]
            ]
            self._points = [*earlier_points, [state]]
            self._distances = [*self._distances[1 - PATH_POINTS :], distance]
        self._model = None  # made again when forces are asked for

    def forces(self, u: Array, D: InteractionHessian, u_of_D: Array) -> Array | None:
        """Return this rank's part of the extrapolated forces at a state u.

        None if no state has been added, or u is not finite.

        Parameters
        ----------
        u
            Displacement of all nodes.
        D
            The second derivative.
        u_of_D
            The state at which D was computed.
        """
        if not (self._points and np.isfinite(u).all()):
            return None
        if D is not self._D or self._is_new_point(u):
            self._rotate_stiffness(u, D, u_of_D)
        self._model = self._model or self._make_model()
        polynomial, secants = self._model
        # D u and the remainder by the polynomial; then a correction by each secant (q, y)
        forces, s = self._product(u) + polynomial.remainder(u), u - polynomial.base.u
        for q, y in secants:
            forces = forces + (q @ s) * y
        return forces

    def extrapolation_holds_along(self, u: Array, step: Array) -> bool:
        """Return whether forces are known at two states near u that differ along `step`.

        Then the secant of these states makes extrapolated forces accurate along the step.
        """
        if not self._points or self._is_new_point(u):
            return False
        # pairs of states of the last point that follow one another: near each other and near u,
        # and different along the step
        largest_distance = SLOPE_DISTANCE_RATIO * self._distances[-1]
        step_length = float(np.linalg.norm(step))
        for state, next_state in pairwise(self._points[-1]):
            change, distance_to_u = state.u - next_state.u, float(np.linalg.norm(u - state.u))
            distance = float(np.linalg.norm(change))
            are_near = max(distance, distance_to_u) < largest_distance
            if are_near and abs(change @ step) > DIRECTION_COSINE * step_length * distance:
                return True
        return False

    def _is_new_point(self, u: Array) -> bool:
        """Return whether a state is too far from the last point to belong to it."""
        return (
            float(np.linalg.norm(u - self._points[-1][-1].u))
            > SAME_POINT_RATIO * self._distances[-1]
        )

    def _rotate_stiffness(self, u: Array, D: InteractionHessian, u_of_D: Array) -> None:
        """Rotate the blocks of D with the nodes, from the state `u_of_D` to u.

        Nothing is done if no node has rotated by `ROTATION_TOLERANCE` since the last time. Else, as
        D u changes, the products with all stored states are computed again.
        """
        earlier_u = self._rotated_u if D is self._D else None  # None: D is a new one
        if earlier_u is not None:
            # twice the vector part of a quaternion is a small angle in rad
            largest_angle = 2 * np.abs(self._rotations(u, earlier_u)[:, :3]).max()
            if largest_angle < ROTATION_TOLERANCE:
                return
        rotated = D.rotated_blocks(self._rotations(u, u_of_D))  # None if D cannot be rotated
        if rotated is None and earlier_u is not None:  # D is stored already, as it is
            return
        self._D, self._rotated_u = D, u
        self._stored = (
            SinglePrecisionBlocks.from_blocks(D.near_blocks, upper=self._is_single_rank)
            if rotated is None
            else rotated
        )
        self._model = None
        self._products.clear()
        self._points = [self._with_products(states) for states in self._points]

    def _with_products(self, states: list[ForceState]) -> list[ForceState]:
        """Return the states of a point with their products by the present D."""
        return [ForceState(state.u, state.forces, self._product(state.u)) for state in states]

    def _make_model(self) -> tuple["PathPolynomial", list[tuple[Array, Array]]]:
        """Return the polynomial along the path, and secant corrections.

        A correction is a pair (q, y). The unit vectors q are changes of u, normal to each other; y
        is the change of forces along q that D and the polynomial do not have.
        """
        polynomial, secants = PathPolynomial.from_points(self._points), list[tuple[Array, Array]]()
        # pairs of states that follow one another at the same point, the newest first
        pairs = [pair for point in reversed(self._points) for pair in pairwise(reversed(point))]
        for state, older_state in pairs[:MAX_CHANGES]:
            s = state.u - older_state.u
            length = float(np.linalg.norm(s))
            # the change of the remainder that the polynomial does not have
            y = (
                state.remainder
                - older_state.remainder
                - polynomial.remainder(state.u)
                + polynomial.remainder(older_state.u)
            )
            # Gram-Schmidt: s less its parts along newer changes q, and y less what these explain;
            # twice because of rounding
            for _ in range(2):
                for q, y_of_q in secants:
                    projection = float(q @ s)
                    s, y = s - projection * q, y - projection * y_of_q
            # a change that is almost a sum of newer ones is left out
            remaining_length = float(np.linalg.norm(s))
            if remaining_length > MIN_NEW_SHARE * length:
                secants.append((np.asarray(s / remaining_length), np.asarray(y / remaining_length)))
        return polynomial, secants

    def _product(self, u: Array) -> Array:
        """Return this rank's part of D u; the last `STORED_PRODUCTS` products are kept."""
        for stored_u, product in self._products:
            if np.array_equal(u, stored_u):
                return product
        assert self._D
        assert self._stored
        product = self._blocks.times(self._stored, u)
        self._products.appendleft((u, product))
        return product


@dataclass(frozen=True)
class PathPolynomial:
    """The remainder (forces less D u) as a polynomial of the position along a direction.

    Attributes
    ----------
    base
        The newest state, at position 0.
    direction
        Unit vector from the previous point to the newest one.
    distance
        The distance of these points, which is the unit of positions.
    coefficients
        (n, forces) coefficients of the first, second, ... power; the constant is that of `base`.
    """

    base: ForceState
    direction: Array
    distance: float
    coefficients: Array

    @classmethod
    def from_points(cls, points: list[list[ForceState]]) -> "PathPolynomial":
        """Return the polynomial through the last state of each point, with slopes where known.

        Each point of the path is a list of states near each other; the newest point and state are
        last. Points that lie across the direction, or at nearly the same position as others, are
        left out. With a single point the polynomial is constant.
        """
        base, previous = points[-1][-1], points[-2][-1] if len(points) > 1 else None
        if previous is None or np.array_equal(previous.u, base.u):
            return cls(base, np.zeros_like(base.u), 1.0, np.zeros((0, len(base.forces))))
        way, distance = base.u - previous.u, float(np.linalg.norm(base.u - previous.u))
        direction = np.asarray(way / distance)

        def position_and_length(s: Array) -> tuple[float, float]:
            """Return a change's part along the direction, and its length, both over `distance`."""
            return float(direction @ s) / distance, float(np.linalg.norm(s)) / distance

        # one row of the linear system for each value or slope that the polynomial must have
        rows, values, positions = list[Array](), list[Array](), [0.0]
        powers = np.arange(1.0, MAX_COEFFICIENTS + 1)
        for point in reversed(points):
            # an equation for the value at the last state of the point, unless that is the base,
            # whose value is the constant
            last = point[-1]
            position, length = position_and_length(last.u - base.u)
            if last is not base:
                separation = min(abs(position - x) for x in positions)
                is_across = abs(position) < MIN_ALONG_SHARE * length
                if is_across or separation < MIN_SEPARATION * max(1.0, abs(position)):
                    continue
                positions.append(position)
                rows.append(np.asarray(position**powers))
                values.append(last.remainder - base.remainder)
            # an equation for the mean slope between two states that are near each other and along
            # the path, of the newest such pair
            for state, older_state in pairwise(reversed(point)):
                step, length = position_and_length(state.u - older_state.u)
                is_slope = MIN_ALONG_SHARE * length < abs(step) and length < SLOPE_DISTANCE_RATIO
                if len(rows) < MAX_COEFFICIENTS and is_slope:
                    position, _ = position_and_length(state.u - base.u)
                    rows.append(np.asarray((position**powers - (position - step) ** powers) / step))
                    values.append(np.asarray((state.remainder - older_state.remainder) / step))
                    break
            if len(rows) == MAX_COEFFICIENTS:
                break
        # the polynomial has as many coefficients as there are equations
        n = len(rows)
        coefficients = np.linalg.solve(np.array(rows)[:, :n], np.array(values))
        return cls(base, direction, distance, np.asarray(coefficients, dtype=np.float64))

    def remainder(self, u: Array) -> Array:
        """Return this rank's part of the forces without D u at a state u of all nodes."""
        position = float(self.direction @ (u - self.base.u)) / self.distance
        return np.asarray(
            self.base.remainder
            + position ** np.arange(1, len(self.coefficients) + 1) @ self.coefficients
        )
