"""Points of a quadrature that respects the cells of both surfaces: a cell is cut along the sides of
those it faces.

The forces of a pressure on the other surface are integrals of its shape functions, which have kinks
at the sides of its cells. A rule on the cells of one surface integrates across them: the forces of
a uniform pressure are then not those of one. So the corners of what a cell faces are projected on
its plane, and each part of the cell that faces one other cell is cut into triangles with a rule of
their own. M. A. Puso and T. A. Laursen, Computer Methods in Applied Mechanics and Engineering 193
(2004) 601-629.

The cuts are those at an earlier state, whose number stands in a state as part of its history. So
the points stay where they are on their surface while a state is solved: energy, forces and tangent
are exact derivatives of each other, and need none of the cuts. Where surfaces slide,
`touching.Touching.recut` makes the cuts anew.

Two curved surfaces touch in a zone that may be narrower than the distance of the points. Its force
then sits on single points and goes along with their material, so that a mode which slides there
seems to be unstable. For such states the triangles in the zone are divided, as often as the number
of the cuts says: see `Cuts`.
"""

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.parts.touching.nearest import BULGE, CORNERS, Cells, Longs, Places
from magshell_fenicsx.parts.touching.rules import BEFORE, covers, ending_rule, inner_rule

Array = NDArray[np.float64]
Inside = NDArray[np.bool_]
CELL = 0.5  # area of the reference cell
NOTHING = 1e-12  # an area in it that is none
LARGE = 0.1  # an area in it, on which the rule is that of a whole cell
# a barycentric coordinate that becomes zero, so that sides that nearly meet leave no slivers
SNAP = 0.01
CLOSE = 1e-9  # between corners that are one
# of the thickness: how far a corner's point is before it, or cells that meet opposite would share
# it
CORNER = 0.01
INSIDE = -1  # a triangle that is not on an edge
TURN = 0.97  # the cosine of an angle by which an edge turns, at corners that have points
NOBODY = -1  # the cell that a part of a cell faces where none is
ALONG = np.array(
    [1.0, 2**0.5, 3**0.5]
)  # a direction in which no two corners are level: it orders them on any ranks
DIGITS = 6  # bytes of the hash of a displacement in the number of its cuts
LEVELS = 16  # more divisions the number of cuts cannot tell: a float has these and the hash exactly
CORNERS_AND_CENTROID = np.array(
    [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1 / 3, 1 / 3]]
)  # in the reference triangle


@dataclass(frozen=True)
class Points:
    """The points of this rank at which gaps are measured.

    Attributes
    ----------
    cell
        (n,) global number.
    shape
        (n, functions) of that cell.
    weight
        (n,) undeformed area over R^2.
    faces
        (n,) the cell that a point faced where the cuts were made; `NOBODY` where it faced none.
    on_edge
        (n,) whether it is on an edge of the surface.
    divisions
        (n,) how often its triangle was divided.
    """

    cell: Longs
    shape: Array
    weight: Array
    faces: Longs
    on_edge: Inside
    divisions: Longs

    @cached_property
    def by_cell(self) -> tuple[Longs, Longs]:
        """Their order by cells, and these cells."""
        order = np.argsort(self.cell, kind="stable")
        return order, self.cell[order]

    def of(self, which: Inside) -> "Points":
        """Some of them."""
        return Points(*(getattr(self, each.name)[which] for each in fields(self)))

    @classmethod
    def joined(cls, parts: Sequence["Points"]) -> "Points":
        """All of several."""
        return cls(
            *(np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(cls))
        )


@dataclass(frozen=True)
class Triangles:
    """Parts of reference cells.

    Attributes
    ----------
    cell, faces
        (n,) their cells, and what they face.
    first, e1, e2
        (n, 2) a corner, and the sides from there.
    ends
        (n,) `INSIDE`, or where the edge turns at the third side, which is on it: see `ending_rule`.
    """

    cell: Longs
    faces: Longs
    first: Array
    e1: Array
    e2: Array
    ends: Longs

    @property
    def size(self) -> Array:
        """(n,) twice their areas."""
        return np.asarray(self.e1[:, 0] * self.e2[:, 1] - self.e1[:, 1] * self.e2[:, 0])

    def of(self, which: Inside) -> "Triangles":
        """Some of them."""
        return Triangles(*(getattr(self, each.name)[which] for each in fields(self)))

    def divided(self) -> "Triangles":
        """Return the four halves of each: at the first corner, at both ends of the third side, and
        in the middle."""
        half1, half2, middle = self.e1 / 2, self.e2 / 2, self.first + (self.e1 + self.e2) / 2
        inside = np.full_like(self.ends, INSIDE)
        at_begin, at_end = (
            np.where(self.ends == INSIDE, INSIDE, self.ends & corner) for corner in (1, 2)
        )
        quarters = (
            (self.first, half1, half2, inside),
            (self.first + half1, half1, half2, at_begin),
            (self.first + half2, half1, half2, at_end),
            (middle, -half1, -half2, inside),
        )
        first, e1, e2, ends = (np.concatenate(each) for each in zip(*quarters, strict=True))
        return Triangles(np.tile(self.cell, 4), np.tile(self.faces, 4), first, e1, e2, ends)


@dataclass(frozen=True)
class Pieces:
    """Convex polygons in reference cells.

    Attributes
    ----------
    cell, faces
        (n,) their cells, and what they face.
    corners
        (n, m, 2) from the left, some of them repeated.
    """

    cell: Longs
    faces: Longs
    corners: Array

    @classmethod
    def cells(cls, cell: Longs) -> "Pieces":
        """Cells as they are, facing nobody."""
        return cls(
            cell, np.full(len(cell), NOBODY), np.array(np.broadcast_to(CORNERS, (len(cell), 3, 2)))
        )

    def of(self, which: Longs | Inside) -> "Pieces":
        """Some of them."""
        return Pieces(self.cell[which], self.faces[which], self.corners[which])

    def facing(self, faces: Longs) -> "Pieces":
        """The same, facing others."""
        return Pieces(self.cell, faces, self.corners)

    def some(self) -> "Pieces":
        """Those that have an area."""
        return self.of(area(self.corners) > NOTHING)

    def beside(self, other: "Pieces") -> "Pieces":
        """These and others."""
        most = max(self.corners.shape[1], other.corners.shape[1])
        wider = [((0, 0), (0, most - each.corners.shape[1]), (0, 0)) for each in (self, other)]
        corners = [
            np.pad(each.corners, by, "edge") for each, by in zip((self, other), wider, strict=True)
        ]
        cell, faces = ([getattr(self, name), getattr(other, name)] for name in ("cell", "faces"))
        return Pieces(np.concatenate(cell), np.concatenate(faces), np.concatenate(corners))

    def triangles(self, open_sides: Inside, turns: Inside) -> Triangles:
        """Those of the centroids and each side; a triangle with one side on an edge of the surface,
        or none, is one by itself. So they do not depend on which corner is the first.

        Parameters
        ----------
        open_sides, turns
            (cells, 3) whether the side opposite to each corner is on an edge, and whether the edge
            turns in the corner.
        """
        c, after = self.corners, np.roll(self.corners, -1, axis=1)
        apart = np.linalg.norm(c - after, axis=2) > CLOSE
        on = np.abs(np.stack([1 - c.sum(axis=2), c[..., 0], c[..., 1]], axis=2)) < CLOSE
        along = apart & (on & np.roll(on, -1, axis=1) & open_sides[self.cell][:, None]).any(axis=2)
        turned = (on[..., [1, 2, 0]] & on[..., [2, 0, 1]] & turns[self.cell][:, None]).any(axis=2)
        ends = np.where(along, turned + 2 * np.roll(turned, -1, axis=1), INSIDE)
        whole = (apart.sum(axis=1) == 3) & (along.sum(axis=1) <= 1)
        middle = np.zeros((len(c), 2))
        middle[~whole] = centroid(c[~whole])
        n, k = np.nonzero(apart & ~whole[:, None])
        sides = c[n, k] - middle[n], after[n, k] - middle[n]
        fans = Triangles(self.cell[n], self.faces[n], middle[n], *sides, ends[n, k])
        own = np.argsort(~apart[whole], axis=1, kind="stable")[:, :3]
        three = np.take_along_axis(c[whole], own[..., None], axis=1)
        at_end = np.take_along_axis(ends[whole], own, axis=1)
        apex = np.where((at_end != INSIDE).any(axis=1), (at_end.argmax(axis=1) + 2) % 3, 0)[:, None]
        first, a, b = (
            np.take_along_axis(three, ((apex + i) % 3)[..., None], axis=1)[:, 0] for i in range(3)
        )
        alone = Triangles(
            self.cell[whole], self.faces[whole], first, a - first, b - first, at_end.max(axis=1)
        )
        both = [
            np.concatenate([getattr(part, each.name) for part in (alone, fans)])
            for each in fields(Triangles)
        ]
        return Triangles(*both)

    def cut(self, a: Array, b: Array) -> "Pieces":
        """What is left of lines from a (n, 2) to b."""
        normal = np.stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]], axis=1)
        left = np.einsum("nki,ni->nk", self.corners - a[:, None], normal)
        left[np.abs(left) < NOTHING] = 0.0
        after, to = np.roll(left, -1, axis=1), np.roll(self.corners, -1, axis=1)
        crossed = left * after < 0
        part = left / np.where(crossed, left - after, 1.0)
        count, m = left.shape
        ends = np.stack(
            [self.corners, self.corners + part[..., None] * (to - self.corners)], axis=2
        )
        apart = (to != self.corners).any(axis=2)
        there = np.stack([(left >= 0) & apart, crossed], axis=2).reshape(count, 2 * m)
        most = max(3, int(there.sum(axis=1).max(initial=0)))
        first = np.argsort(~there, axis=1, kind="stable")[:, :most]
        corners = np.take_along_axis(ends.reshape(count, 2 * m, 2), first[..., None], axis=1)
        kept = np.take_along_axis(there, first, axis=1)
        return Pieces(self.cell, self.faces, np.where(kept[..., None], corners, corners[:, :1]))


def area(corners: Array) -> Array:
    """Of polygons (n, m, 2), from the left."""
    at = corners - corners[:, :1]
    x, y = at[..., 0], at[..., 1]
    return np.asarray(np.sum(x * np.roll(y, -1, 1) - np.roll(x, -1, 1) * y, axis=1) / 2)


def centroid(corners: Array) -> Array:
    """(n, 2) of polygons that have an area."""
    at = corners - corners[:, :1]
    after = np.roll(at, -1, 1)
    twice = at[..., 0] * after[..., 1] - after[..., 0] * at[..., 1]
    inner = np.einsum("nk,nki->ni", twice, at + after) / (3 * twice.sum(axis=1))[:, None]
    return np.asarray(corners[:, 0] + inner)


class Segments:
    """The points on all parts of cells.

    Parameters
    ----------
    own
        The cells of this rank.
    r0
        (nodes, 3) undeformed.
    degrees
        Of the rule on whole cells and on large parts, and on small parts.
    h
        Thickness over R.
    planes
        Of symmetry: an edge goes on in its image, and does not turn there.

    Attributes
    ----------
    rule
        The points of these cells, uncut.
    within
        (cells,): no place of a cell is farther from all points of the rule.
    """

    def __init__(
        self,
        cells: Cells,
        own: Longs,
        r0: Array,
        degrees: tuple[int, int],
        h: float,
        planes: Sequence[Mirror] = (),
    ) -> None:
        self._cells, self._r0, self._degrees, self._before = cells, r0, degrees, CORNER * h
        corners = self._corners(r0, np.arange(len(cells.nodes)))
        self._turns = cells.turns(r0, TURN)
        for plane in planes:
            self._turns &= np.abs(plane.signed_distance(corners)) > CLOSE
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
        inside, at_edge = covers(inner_rule(degrees[0])[0]), covers(ending_rule(degrees[0])[0])
        self.within: Array = (
            BULGE * sides * np.where((cells.across < 0).any(axis=1), max(inside, at_edge), inside)
        )
        self.rule = Points.joined(self._on(self._triangles(Pieces.cells(own))))

    def points(
        self, near: Places, r: Array, divisions: int, gaps: Callable[[Points], Array]
    ) -> Points:
        """All points of this rank.

        Parameters
        ----------
        near
            Places in all cells that are near the rule's points.
        r
            (nodes, 3) where the cuts are made.
        divisions
            How often triangles in which the gap may be closed are divided into four.
        gaps
            Return the gaps (n,) of points (n) there, over R.
        """
        number, rule = len(self._cells.nodes), self.rule
        if not len(near.point):
            return rule
        keys = np.unique(rule.cell[near.point] * number + near.cell)
        one, other = keys // number, keys % number
        order = np.argsort(self._corners(self._r0, other).mean(axis=1) @ ALONG, kind="stable")
        one, other = one[order], other[order]
        pieces = cut_along(Pieces(one, other, self._projected(one, other, r)))
        points, triangles = [rule.of(~np.isin(rule.cell, one))], self._triangles(pieces)
        for times in range(divisions):
            is_closing = self._closing(triangles, gaps)
            points += self._on(triangles.of(~is_closing), times)
            triangles = triangles.of(is_closing).divided()
        return Points.joined([*points, *self._on(triangles, divisions)])

    def _closing(self, triangles: Triangles, gaps: Callable[[Points], Array]) -> Inside:
        """Whether the gap in triangles (n,) may be closed: it changes there by as much again as
        between some points."""
        X = CORNERS_AND_CENTROID
        gap = gaps(self._by_rule(triangles, X, np.ones(len(X)), 0)).reshape(-1, len(X))
        return np.asarray(gap.min(axis=1) < np.ptp(gap, axis=1))

    def _triangles(self, pieces: Pieces) -> Triangles:
        """The triangles that pieces are cut into."""
        triangles = pieces.triangles(self._cells.across < 0, self._turns)
        return triangles.of(triangles.size > NOTHING)

    def _on(self, triangles: Triangles, divisions: int = 0) -> list[Points]:
        """The points on triangles that are divided so often."""
        c, along = self._corners(self._r0, triangles.cell), triangles.e2 - triangles.e1
        side = np.linalg.norm(np.einsum("na,nai->ni", along, c[:, 1:] - c[:, :1]), axis=1)
        corner = np.minimum(
            np.exp2(np.round(np.log2(self._before / side))), 1 / 64
        )  # of few values, so of few rules
        small = triangles.size * 4**divisions <= 2 * LARGE
        kind = np.stack([small, triangles.ends, np.where(triangles.ends > 0, corner, 0)], axis=1)
        made, (kinds, number) = list[Points](), np.unique(kind, axis=0, return_inverse=True)
        for k, (small, ends, part) in enumerate(kinds):
            degree = self._degrees[int(small)]
            rule = (
                inner_rule(degree)
                if ends == INSIDE
                else ending_rule(degree, int(ends), float(part))
            )
            made.append(self._by_rule(triangles.of(number.ravel() == k), *rule, divisions))
        return made

    def _by_rule(self, triangles: Triangles, X: Array, weights: Array, divisions: int) -> Points:
        at = (
            triangles.first[:, None]
            + X[:, :1] * triangles.e1[:, None]
            + X[:, 1:] * triangles.e2[:, None]
        )
        cell, faces = (np.repeat(each, len(X)) for each in (triangles.cell, triangles.faces))
        table = self._cells.element.tabulate(1, at.reshape(-1, 2))[..., 0]
        a1, a2 = np.einsum("dnk,nki->dni", table[1:], self._r0[self._cells.nodes[cell]])
        weight = np.outer(triangles.size, weights).ravel() * np.linalg.norm(
            np.cross(a1, a2), axis=1
        )
        on_edge = np.outer(triangles.ends != INSIDE, X.sum(axis=1) > 1 - 2 * BEFORE).ravel()
        return Points(cell, table[0], weight, faces, on_edge, np.full(len(cell), divisions))

    def normals(self, r: Array) -> Array:
        """(cells, 3) of the planes through the corners."""
        c = self._corners(r, np.arange(len(self._cells.nodes)))
        n = np.cross(c[:, 1] - c[:, 0], c[:, 2] - c[:, 0])
        return np.asarray(n / np.linalg.norm(n, axis=1)[:, None])

    def _corners(self, r: Array, cell: Longs) -> Array:
        return np.asarray(self._cells.at_corners @ r[self._cells.nodes[cell]])

    def _projected(self, one: Longs, other: Longs, r: Array) -> Array:
        """The corners (n, 3, 2) of cells in reference cells of others, along the normals of these."""
        c, y = self._corners(r, one), self._corners(r, other)
        sides = np.stack([c[:, 1] - c[:, 0], c[:, 2] - c[:, 0]], axis=1)
        X = (y - c[:, :1]) @ np.linalg.pinv(sides)
        coordinates = np.concatenate([1 - X.sum(axis=2, keepdims=True), X], axis=2)
        coordinates[np.abs(coordinates) < SNAP] = 0.0
        X = np.asarray((coordinates / coordinates.sum(axis=2, keepdims=True))[..., 1:])
        level = np.argsort(self._corners(self._r0, other) @ ALONG, axis=1)
        return np.take_along_axis(X, level[..., None], axis=1)


class Cuts:
    """The points with the cuts of displacements, which have numbers; 0 is undeformed, without
    divisions.

    A number is `LEVELS` times a hash of the displacement, plus how often triangles in a zone of
    contact are divided.

    Parameters
    ----------
    near
        The places in all cells that are near the rule's points at a displacement (nodes, 3).
    gaps
        The gaps (n,) over R of points at a displacement.
    """

    def __init__(
        self,
        segments: Segments,
        near: Callable[[Array], Places],
        gaps: Callable[[Points, Array], Array],
        r0: Array,
    ) -> None:
        self._segments, self._near, self._gaps, self._r0 = segments, near, gaps, r0
        self._displacements = {0.0: np.zeros_like(r0)}
        self._latest = dict[float, tuple[Points, Array]]()

    def points(self, number: float, u: Array) -> tuple[Points, Array]:
        """Those of a number, and the normals (cells, 3) there; one that is not known, as in a state from elsewhere,
        becomes that of u."""
        if number not in self._latest:
            at = self._displacements.setdefault(number, np.array(u))
            made = self.at(at, divisions_of(number))
            self._latest = {**dict([*self._latest.items()][-1:]), number: made}
        return self._latest[number]

    def displacement(self, number: float) -> Array:
        """That of a number of which there are points."""
        return self._displacements[number]

    def at(self, u: Array, divisions: int) -> tuple[Points, Array]:
        """Those of a displacement."""
        r = self._r0 + u
        points = self._segments.points(
            self._near(u), r, divisions, lambda points: self._gaps(points, u)
        )
        return points, self._segments.normals(r)

    def numbered(self, u: Array, divisions: int) -> float:
        """The number of a displacement with so many divisions, the same for the same ones."""
        digest = hashlib.blake2b(np.array(u).tobytes(), digest_size=DIGITS).digest()
        number = float(LEVELS * int.from_bytes(digest) + divisions)
        self.recall(number, u)
        return number

    def recall(self, number: float, u: Array) -> None:
        """Let a number stand for a displacement."""
        self._displacements[number] = np.array(u)


def divisions_of(number: float) -> int:
    """How often triangles are divided with cuts of this number."""
    return int(number) % LEVELS


def sides_of(triangles: Array) -> tuple[Array, Array]:
    """The ends (n, 3, 2) of the sides of triangles, which have these on their left."""
    a, b = triangles, np.roll(triangles, -1, axis=1)
    right = (area(triangles) < 0)[:, None, None]
    return np.where(right, b, a), np.where(right, a, b)


def cut_along(triangles: Pieces) -> Pieces:
    """Reference cells cut along the sides of triangles that they face.

    Where these neither overlap nor leave a part of the cell, the pieces are what the cell has in
    common with each.
    """
    cells, number = np.unique(triangles.cell, return_inverse=True)
    a, b = sides_of(triangles.corners)
    common = Pieces.cells(triangles.cell).facing(triangles.faces)
    for k in range(3):
        common = common.cut(a[:, k], b[:, k])
    met = (np.abs(area(triangles.corners)) > NOTHING) & (area(common.corners) > NOTHING)
    common, number = common.of(met), number[met]
    total = np.bincount(number, area(common.corners), len(cells))
    part = np.abs(total - CELL) > NOTHING
    if not part.any():
        return common
    inside, rest = _one_by_one(triangles.of(met).of(part[number]), cells[part])
    left = np.bincount(np.searchsorted(cells, rest.cell), area(rest.corners), len(cells))
    twice = cells[part & (np.abs(total + left - CELL) > NOTHING)]
    kept = common.of(~np.isin(common.cell, twice))
    return kept.beside(inside.of(np.isin(inside.cell, twice))).beside(rest)


def _one_by_one(triangles: Pieces, cells: Longs) -> tuple[Pieces, Pieces]:
    """What cells have in common with triangles, the later ones without the earlier ones; and what
    is left.
    """
    triangles = triangles.of(np.argsort(triangles.cell, kind="stable"))
    first = np.searchsorted(triangles.cell, cells)
    number = np.searchsorted(triangles.cell, cells, "right") - first
    rest = Pieces.cells(cells)
    inside = rest.of(np.zeros(0, dtype=np.int64))
    for turn in range(int(number.max(initial=0))):
        at = np.searchsorted(cells, rest.cell)
        has = number[at] > turn
        by = triangles.of(first[at[has]] + turn)
        asked, (a, b) = rest.of(has), sides_of(by.corners)
        common = asked.facing(by.faces)
        for k in range(3):
            common = common.cut(a[:, k], b[:, k])
        met = area(common.corners) > NOTHING
        inside, rest, within = (
            inside.beside(common.of(met)),
            rest.of(~has).beside(asked.of(~met)),
            asked.of(met),
        )
        for k in range(3):
            rest = rest.beside(within.cut(b[met, k], a[met, k]).some())
            within = within.cut(a[met, k], b[met, k])
    return inside, rest
