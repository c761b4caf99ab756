"""The force of a contact between shells in a step in time: its mean along the straight way between
two displacements.

Contact sets in and ceases within a step, so that its force at one place of the step would create
energy. The force of a point, and its derivative, are those of Simpson's rule along the way. Where
that passes a kink of the penalty, factors give the point's force the work that its energy changes
by, and its derivative that of this quotient: for one place in a straight motion these are the mean
pressure of `gap.mean_pressure`. See docs/theory.md, Motion.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.free_parameters import FreeParameter
from magshell_fenicsx.assembly.nonlocal_terms import Entries
from magshell_fenicsx.parts.gap import ROUNDING, penalty
from magshell_fenicsx.parts.touching.by_fields import Present, Shape, with_growth
from magshell_fenicsx.parts.touching.faces import Faces, on_nodes
from magshell_fenicsx.parts.touching.section import Pair

Array = NDArray[np.float64]
Of = TypeVar("Of")
SIMPSON = ((0.0, 1 / 6), (0.5, 4 / 6), (1.0, 1 / 6))  # parts of the way, and their weights
MOST = 4.0  # a factor; for one place in a straight motion it is at most 3


@dataclass(frozen=True)
class Look:
    """A displacement on the way of a step, and what the penalty of each point counts there.

    Attributes
    ----------
    u
        Of all nodes, (nodes, 2 or 3).
    first, second
        (points,) times the derivatives of the penalty; None for 1.
    slope
        (points,) in place of `first` in the tangent.
    """

    u: Array
    first: Array | None = None
    second: Array | None = None
    slope: Array | None = None

    def of(
        self, point: NDArray[np.int64], penalty: tuple[Array, Array, Array]
    ) -> tuple[Array, Array, Array]:
        """The penalty of places of points with its derivatives, as they count."""
        if self.first is None or self.second is None:
            return penalty
        value, first, second = penalty
        return value, self.first[point] * first, self.second[point] * second


@dataclass(frozen=True)
class Along:
    """What the points of a contact have at a displacement on the way of a step, (points,) each.

    Attributes
    ----------
    value, rate, bend
        The penalty, and its derivatives along the whole way, the second of a straight motion.
    piece
        Changes where the penalty passes a kink.
    """

    value: Array
    rate: Array
    bend: Array
    piece: Array

    @classmethod
    def of(
        cls, count: int, point: NDArray[np.int64], deep: Array, moves: Array, k: float, soft: float
    ) -> "Along":
        """Of places of some of `count` points with penetrations, which grow by `moves` along the
        whole way.
        """
        value, first, second = penalty(deep, k, soft)
        moves = np.where(np.abs(moves) > ROUNDING * soft, moves, 0.0)
        each = value, first * moves, second * moves**2, np.digitize(deep, (0.0, soft)).astype(float)
        return cls(*(np.bincount(point, part, count).astype(float) for part in each))


class Kept(Generic[Of]):
    """What was found at the looks of the last step."""

    def __init__(self) -> None:
        self._found = list[tuple[Sequence[Any], Of]]()

    def of(self, at: Sequence[Any], find: Callable[[], Of]) -> Of:
        """What is found at a place, a sequence of arrays and numbers."""
        for i, (place, found) in enumerate(self._found):
            if all(map(np.array_equal, place, at)):
                self._found.append(
                    self._found.pop(i)
                )  # the begin of a step is there at each iteration
                return found
        new = find()
        self._found = [*self._found[1 - len(SIMPSON) :], ([np.array(each) for each in at], new)]
        return new


class InSteps(Protocol):
    """A contact whose force may be that of a step.

    Attributes
    ----------
    looks
        Those of the step; empty while it has the force of the present state.
    look
        The one that it is seen at now.
    """

    pair: Pair
    looks: Sequence[Look]
    look: Look | None

    @property
    def where(self) -> Array:
        """The displacement of all that is faced; collective."""

    def penetration(self) -> float:
        """The largest, over R; collective."""

    def passes(self, u: Array, v: Array) -> bool:
        """Whether points pass through a surface between two of these; collective."""

    def along(self, moved: Array) -> Along:
        """What its points have at this look, on a way (nodes, 2 or 3)."""


def looks_of_step(contact: InSteps, begin: Array, end: Array, part: float) -> list[Look]:
    """The looks whose sum is the force at a part of a step: the mean one, and what generalised
    alpha dissipates.

    The tangent is by the displacement at that part.
    """
    seen = list[Along]()
    ends = [begin + t * (end - begin) for t, _ in SIMPSON]
    for u in ends:
        contact.look = Look(u)
        seen.append(contact.along(end - begin))
    contact.look = None
    parts, weights = np.transpose(SIMPSON)
    work = weights @ [at.rate for at in seen]
    bend = (parts * weights) @ [at.bend for at in seen]
    kink = np.any([a.piece != b.piece for a, b in pairwise(seen)], axis=0)
    change = seen[-1].value - seen[0].value
    stiff, late = seen[-1].rate - change, part - 0.5
    of_force, of_bend = _factor(change, work, kink), _factor(stiff, bend, kink)
    leaves = kink & (bend == 0)  # its force depends on the end of the way alone by how long that is
    of_begin = np.where(leaves, _factor(stiff, seen[0].bend, kink), 0.0) / part
    made = list[Look]()
    for u, (t, weight) in zip(ends, SIMPSON, strict=True):
        more = {0.0: -late, 1.0: late}.get(t, 0.0)
        slope, second = ((t * (weight * of + more)) / part for of in (of_force, of_bend))
        made.append(
            Look(
                u,
                np.asarray(weight * of_force + more),
                np.asarray(second if t else of_begin),
                np.asarray(slope),
            )
        )
    return made


def _factor(wanted: Array, given: Array, kink: NDArray[np.bool_]) -> Array:
    """What makes numbers wanted ones at kinks; 1 elsewhere."""
    there = kink & (given != 0)
    return np.clip(np.divide(wanted, given, out=np.ones_like(given), where=there), 0.0, MOST)


def of_each(contact: InSteps, of: Callable[[], Of], *, tangent: bool = False) -> list[Of]:
    """Something at each look of the step; without a step, at the present state."""
    if not contact.looks:
        return [of()]
    found = list[Of]()
    for look in contact.looks:
        contact.look = replace(look, first=look.slope) if tangent else look
        found.append(of())
    contact.look = None
    return found


@dataclass
class Number:
    """A number that a state sets."""

    value: float


class ContactTerm:
    """What the contacts of a pair are as terms, on surfaces and on meridians; `_entries` are those
    at one look.
    """

    amplitude = None
    column = ""

    def __init__(self, pair: Pair, shape: Shape, faces: Faces | None) -> None:
        self.pair, self.name = pair, f"contact{pair.suffix}"
        self._shape, self._faces = shape, faces
        self._at: Array = np.zeros((0, 0))  # the displacement of the places
        self.group = self.name
        self.stiffness = Number(pair.stiffness)
        self.looks: Sequence[Look] = ()  # see `InSteps`
        self.look: Look | None = None
        self.held: Any = None  # see `hold`
        self._about: Any = None

    def hold(self, pressed: Any) -> None:
        """Take what is pressed at one state for that at all states, see `expanded`; None: no more."""
        self.held = self._about = None
        if pressed is not None:
            self.expand_about(pressed)
            self.held = pressed

    def expand_about(self, pressed: Any) -> None:
        raise NotImplementedError

    @property
    def history(self) -> dict[str, tuple[Number, float]]:
        """See `FiniteElementSystem`."""
        return {self.pair.setting: (self.stiffness, self.pair.stiffness)}

    def add_residual(self, b: Array, factor: float) -> None:
        """Add factor dPi/du; collective."""
        self._add(b, factor * np.sum(of_each(self, lambda: self._on_nodes(self._forces())), axis=0))  # type: ignore[arg-type]

    def compile_residual(self) -> None:
        """It has no forms."""

    compile_tangent = compile_residual

    def add_tangent(self, K: object, factor: float, clamped: object) -> None:
        """None here: what assembles the others adds `entries`."""

    def entries(self) -> Entries:
        """See `NonlocalTerm`."""
        rows, columns, values = zip(*of_each(self, self._entries, tangent=True), strict=True)  # type: ignore[arg-type]
        return np.concatenate(rows), np.concatenate(columns), np.concatenate(values)

    def entered(self, parameters: Mapping[str, FreeParameter]) -> dict[str, FreeParameter]:
        """The parameters that the thickness of its faces depends on, with its derivatives among
        theirs.
        """
        grown = self._faces.grown if self._faces else None
        return {
            name: with_growth(p, self._present, self._add)
            for name, p in parameters.items()
            if p.constant is grown
        }

    def _on_nodes(self, forces: Array) -> Array:
        return on_nodes(
            self._faces, self._at, forces
        )  # which stands at the forces' displacement since they were found

    def _forces(self) -> Array:
        """The derivative (nodes, dim) of this rank's energy by the places of all nodes, or by H
        too.
        """
        raise NotImplementedError

    def _entries(self) -> Entries:
        raise NotImplementedError

    def _present(self) -> Present:
        raise NotImplementedError

    def _add(self, b: Array, forces: Array) -> None:
        """Add forces (nodes, 2 or 3) of this rank's points; collective."""
        raise NotImplementedError
