"""The field of a magnetised shell outside it, from the magnetic charges on its faces, edges and in
it.

A remanence Br that moves as F Br/J with the material has, by Nanson and Piola, charges that stay
with the material: Br.N dA0 on its faces, -Div Br dV0 inside. So they are found on the undeformed
shell, with its thickness and its curvature, and seen at the places x = r + zeta n of the deformed
one:

    B(x) = sum of q (x - x_q)/(4 pi |x - x_q|³).

What moves otherwise (a remanence that turns and does not stretch, what a field induces) is first
taken back to the undeformed shell by F. Integrals are Gauss's rules on boxes of coordinates, which
are halved until each is far enough from the place: exact at any distance, as there is nothing else
in it but the thickness as it is.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.magnetised_cells import Jets, Nodal, Shape, unit

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
POINTS, LAYERS = 6, 6  # of Gauss's rules in a box, and of the charges through the thickness
FAR, MOST = 2.5, 40  # radii of a box that a place is away from it, and halvings at most
CHUNK, PAIRS = 40_000, 200_000  # points that are found at once, and pairs of a charge and a place
SECTORS = 8  # of a meridian's ring
AROUND, TINY, SMALL = (
    np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]]),
    1e-6,
    1e-4,
)  # corners of a box, and what has no area
SIDE = 9
GRID = np.stack(np.meshgrid(*[np.linspace(0, 1, SIDE)] * 2, indexing="ij"), axis=-1).reshape(
    -1, 2
)  # of a box
NEWTON, BESIDE = 15, 1e-6  # steps to the foot of a place in a box, and over R
INSIDE = 1e-3  # of a box, as at a corner it may have no normal
# of its square or cube: the middle, middles of opposite sides one after the other, corners
SEEN = {
    d: np.array(
        [
            np.full(d, 0.5),
            *(
                np.where(np.arange(d) == along, end, 0.5)
                for along in range(d)
                for end in (0.0, 1.0)
            ),
            *product((0.0, 1.0), repeat=d),
        ]
    )
    for d in (2, 3)
}


Layer = tuple[
    Any, tuple[Array, Array, Array]
]  # a height, and what B, B_a and B_b are multiplied by


class TooNear(ValueError):
    """Places are on the surface of the shell, or in it.

    Attributes
    ----------
    of
        Their numbers.
    """

    def __init__(self, of: Ints) -> None:
        super().__init__(of)
        self.of = of


@cache
def gauss(n: int) -> tuple[Array, Array]:
    """Points in [0, 1] and weights."""
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


@dataclass(frozen=True)
class Boxes:
    """Boxes of the coordinates (a, b) in [0, 1]² of some elements, or (a, b, c) in [0, 1]³.

    Attributes
    ----------
    of
        (n,) the elements.
    low, size
        (n, 2 or 3) corners and sides.
    """

    of: Ints
    low: Array
    size: Array

    @classmethod
    def whole(cls, count: int, across: int = 2) -> "Boxes":
        return cls(np.arange(count), np.zeros((count, across)), np.ones((count, across)))

    def __getitem__(self, which: Any) -> "Boxes":
        return Boxes(self.of[which], self.low[which], self.size[which])

    def halves(self, along: Ints) -> "Boxes":
        """Both halves of each along one of its sides."""
        size = self.size.copy()
        rows = np.arange(len(size))
        size[rows, along] /= 2
        second = self.low.copy()
        second[rows, along] += size[rows, along]
        return Boxes(np.tile(self.of, 2), np.concatenate([self.low, second]), np.tile(size, (2, 1)))

    def points(self, x: Array) -> Array:
        """(n, m, 2 or 3) of points (m, 2 or 3) of the unit square or cube."""
        return np.asarray(self.low[:, None] + self.size[:, None] * x)


@dataclass(frozen=True)
class Found:
    """Charges at points of boxes.

    Attributes
    ----------
    x
        (n, m, layers, 3) where they are.
    q
        (n, m, layers) the charges per (a, b), without the weights of layers that are in `x`.
    back
        From dJ/dx (n, m, layers, 3) and dJ/dq to what it adds to dJ/d(nodal u) and dJ/d(nodal
        remanence), see `Family`.
    """

    x: Array
    q: Array
    back: Callable[[Array, Array], None] | None = None


class Family:
    """Elements with coordinates (a, b), or (a, b, c) where they are solid, of which charges can be
    found.
    """

    count: int
    across: ClassVar[int] = 2  # how many coordinates there are

    def middle(self, boxes: Boxes, x: Array) -> Array:
        """Places (n, m, k, 3) of points of boxes, k of them through the thickness."""
        raise NotImplementedError

    def at(self, boxes: Boxes, x: Array, weights: Array, into: Nodal | None = None) -> Found:
        """Charges at points x (m, 2) of the unit square times weights (m,)."""
        raise NotImplementedError

    def near(self, places: Array) -> Iterator[tuple[Boxes, Ints, Ints]]:
        """Boxes, and pairs of the number of one of them and of the place from which it is seen; far
        enough.

        Each box is found once for all places.

        Raises
        ------
        TooNear
            If a place is in the shell's surface, when all others have their boxes.
        """
        corners = np.clip(SEEN[self.across], INSIDE, 1 - INSIDE)
        boxes = Boxes.whole(self.count, self.across)
        where = np.repeat(np.arange(len(places)), self.count)
        which = np.tile(np.arange(self.count), len(places))
        for _ in range(MOST):
            if not len(which):
                return
            x = self.middle(boxes, corners)
            centre = x[:, 0]
            radius = np.sqrt(((x - x[:, :1]) ** 2).sum(axis=-1)).max(axis=(1, 2))
            gap = np.linalg.norm(places[where][:, None] - centre[which], axis=-1).min(axis=-1)
            far = gap > FAR * radius[which]
            if far.any():
                yield boxes, which[far], where[far]
            halved, which = np.unique(which[~far], return_inverse=True)
            where, x = where[~far], x[halved]
            ends = x[:, 1 : 1 + 2 * self.across]
            sides = np.linalg.norm(ends[:, 1::2] - ends[:, ::2], axis=-1).max(axis=-1)
            boxes = boxes[halved].halves(sides.argmax(axis=1))
            which, where = np.concatenate([which, which + len(halved)]), np.tile(where, 2)
        if len(which):
            raise TooNear(np.unique(where))


class Faces(Family):
    """Both faces, and what is inside where the remanence varies, or `may` vary."""

    def __init__(self, shape: Shape, cells: Ints, *, may: bool = False) -> None:
        self.shape = shape
        count = SECTORS if shape.swept else 1
        self._cells, self._sector = np.repeat(cells, count), np.tile(np.arange(count), len(cells))
        self._parts, self.count = count, count * len(cells)
        spread = np.abs(shape.remanence - shape.remanence[:, :1]).max(initial=0.0)
        even = spread <= 1e-12 * np.abs(shape.remanence).max(initial=0.0)
        upright = not shape.swept or not np.abs(shape.remanence[..., :2]).any()
        self._inside = [] if even and upright and not may else list(zip(*_through(), strict=True))

    def _jets(self, boxes: Boxes, x: Array) -> Jets:
        return self._jets_at(boxes, boxes.points(x))

    def _jets_at(self, boxes: Boxes, ab: Array) -> Jets:
        ab = ab.copy()
        if self.shape.swept:
            ab[..., 1] = (self._sector[boxes.of][:, None] + ab[..., 1]) / self._parts
        return Jets.of(self.shape, self._cells[boxes.of], ab)

    def middle(self, boxes: Boxes, x: Array) -> Array:
        at = self._jets(boxes, x)
        return np.stack([at.place(0.5), at.place(-0.5)], axis=2)

    def holds(self, places: Array) -> NDArray[np.bool_]:
        """Which of places (n, 3) are in the shell: the foot on the mid-surface is within half of
        the thickness.
        """
        from scipy.spatial import cKDTree  # takes long to import

        held = np.zeros(len(places), dtype=bool)
        if not self.count:
            return held
        boxes, start = Boxes.whole(self.count), np.clip(GRID, INSIDE, 1 - INSIDE)
        grid = self._jets(boxes, start)
        square = grid.r[0].reshape(-1, SIDE, SIDE, 3)
        across = [square[:, 1:, 1:] - square[:, :-1, :-1], square[:, 1:, :-1] - square[:, :-1, 1:]]
        reach = np.max([np.linalg.norm(each, axis=-1).max(axis=(1, 2)) for each in across], axis=0)
        reach = reach + grid.thickness.max(axis=1)
        beside = cKDTree(grid.r[0].reshape(-1, 3)).query_ball_point(places, reach.max())
        of = np.repeat(np.arange(len(places)), [len(each) for each in beside])
        near, point = np.divmod(np.concatenate([*beside, []]).astype(np.intp), len(start))
        away = np.linalg.norm(places[of] - grid.r[0][near, point], axis=-1)
        order = np.lexsort((away, near, of))
        order = order[away[order] <= reach[near[order]]]
        _, first = np.unique(
            of[order] * self.count + near[order], return_index=True
        )  # the nearest in each box
        of, near, point = (each[order][first] for each in (of, near, point))
        if len(of):
            held[of[self._feet_within(boxes[near], start[point][:, None], places[of][:, None])]] = (
                True
            )
        return held

    def _feet_within(self, boxes: Boxes, ab: Array, x: Array) -> NDArray[np.bool_]:
        """Whether places (n, 1, 3) have a foot in a box within half of the thickness; Newton's
        method from `ab`.
        """
        for _ in range(NEWTON):
            foot = self._jets_at(boxes, ab)
            J = np.stack([foot.r[1], foot.r[2]], axis=-1)
            step = np.einsum("nmdi,nmi->nmd", np.linalg.pinv(J), x - foot.r[0])
            step[..., 1] *= self._parts
            ab = np.clip(ab + step, INSIDE**3, 1 - INSIDE**3)
        foot = self._jets_at(boxes, ab)
        d, n = x - foot.r[0], unit(np.cross(foot.r[1], foot.r[2]))
        across = np.sum(d * n, axis=-1)
        beside = np.linalg.norm(d - across[..., None] * n, axis=-1)
        return np.asarray((np.abs(across) <= foot.thickness / 2) & (beside < BESIDE))[:, 0]

    def at(self, boxes: Boxes, x: Array, weights: Array, into: Nodal | None = None) -> Found:
        area = np.prod(boxes.size, axis=1)[:, None] * weights / self._parts

        def layers(at: Jets) -> list[Layer]:
            made = list[Layer]()
            for eta, sign in ((0.5, 1.0), (-0.5, -1.0)):
                G1, G2, _ = at.layer(eta)
                made.append((eta, ((sign * area)[..., None] * np.cross(G1, G2), 0 * G1, 0 * G1)))
            for eta, weight in self._inside:
                G1, G2, G3 = at.layer(eta)
                density = -(weight * area)[..., None]
                made.append((eta, (0 * G1, density * np.cross(G2, G3), density * np.cross(G3, G1))))
            return made

        return _found(self._jets(boxes, x), layers, into)


class Sides(Family):
    """Edges of cells as strips: coordinates along the edge and through the thickness."""

    def __init__(self, shape: Shape, cells: Ints, edges: Ints) -> None:
        self.shape = shape
        self._parts = SECTORS if shape.swept else 1
        self._cells, self._edges = np.repeat(cells, self._parts), np.repeat(edges, self._parts)
        self._sector = np.tile(np.arange(self._parts), len(cells))
        self.count = len(self._cells)

    def _coordinates(self, boxes: Boxes, x: Array) -> tuple[Array, Array, Array]:
        """Coordinates (n, m, 2) of the surface, their slopes along the edge (n, 2), and heights (n,
        m).
        """
        s, eta = np.moveaxis(boxes.points(x), -1, 0)
        edge = self._edges[boxes.of][:, None]
        if self.shape.swept:
            b = (self._sector[boxes.of][:, None] + s) / self._parts
            along = np.where(edge == 1, 1.0, -1.0)[..., None] * np.array([0.0, 1.0])
            return (
                np.stack([np.where(edge == 1, 1.0, 0.0) + 0 * s, b], axis=-1),
                along[:, 0],
                eta - 0.5,
            )
        # around the triangle with the surface on the left: b = 1 backwards, a = 0 backwards, b = 0
        a = np.where(edge == 0, 1 - s, np.where(edge == 2, s, 0.0))
        b = np.where(edge == 0, 1.0, np.where(edge == 1, 1 - s, 0.0))
        along = np.array([[-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])[self._edges[boxes.of]]
        return np.stack([a, b], axis=-1), along, eta - 0.5

    def _jets(self, boxes: Boxes, x: Array) -> tuple[Jets, Array, Array]:
        ab, along, eta = self._coordinates(boxes, x)
        return Jets.of(self.shape, self._cells[boxes.of], ab), along, eta

    def middle(self, boxes: Boxes, x: Array) -> Array:
        at, _, eta = self._jets(boxes, x)
        n = unit(np.cross(at.r[1], at.r[2]))
        return np.asarray(at.r[0] + (eta * at.thickness)[..., None] * n)[:, :, None]

    def at(self, boxes: Boxes, x: Array, weights: Array, into: Nodal | None = None) -> Found:
        at, along, eta = self._jets(boxes, x)
        area = (
            np.prod(boxes.size, axis=1)[:, None]
            * weights
            / (self._parts if self.shape.swept else 1)
        )

        def layers(at: Jets) -> list[Layer]:
            G1, G2, G3 = at.layer(eta[..., None])  # type: ignore[arg-type]  # heights of points
            tangent = along[:, None, :1] * G1 + along[:, None, 1:] * G2
            outward = area[..., None] * np.cross(tangent, G3)
            return [(eta[..., None], (outward, 0 * outward, 0 * outward))]

        return _found(at, layers, into)


def heights(faces: Faces) -> Array:
    """The layers of a shell's charges, over the thickness: both faces, and those in it."""
    return np.array([0.5, -0.5, *(eta for eta, _ in faces._inside)])


def _through() -> tuple[Array, Array]:
    """Heights over the thickness and weights."""
    x, w = gauss(LAYERS)
    return x - 0.5, w


def _found(at: Jets, layers_of: Callable[[Jets], list[Layer]], into: Nodal | None) -> Found:
    """Charges of layers."""
    n, layers = unit(np.cross(at.r[1], at.r[2])), layers_of(at)
    thickness = at.thickness[..., None]
    x = np.stack([at.r[0] + eta * thickness * n for eta, _ in layers], axis=2)

    def charges(layers: list[Layer]) -> Array:
        return np.stack(
            [sum(np.sum(c * b, axis=-1) for c, b in zip(C, at.B, strict=True)) for _, C in layers],
            axis=2,
        )

    q = charges(layers)
    if into is None:
        return Found(x, q)

    def back(on_x: Array, on_q: Array) -> None:
        heights = np.stack([eta * thickness + 0 * at.r[0][..., :1] for eta, _ in layers], axis=2)
        by_B = [
            sum(on_q[:, :, i, None] * C[j] for i, (_, C) in enumerate(layers)) for j in range(3)
        ]
        at.back(into, on_x.sum(axis=2), (heights * on_x).sum(axis=2), np.stack(by_B))
        at.back_of_undeformed(into, lambda other: charges(layers_of(other)), on_q)

    return Found(x, q, back)


def field(families: Sequence[Family], places: Array) -> Array:
    """B (n, 3) at places (n, 3), of these charges; nan in the shell's surface."""
    B = np.zeros_like(places)
    for family in families:
        rule, weights = cube(POINTS, family.across)
        for some in _parts(len(places), family.count):
            try:
                for boxes, which, where in family.near(places[some]):
                    used, which = np.unique(which, return_inverse=True)
                    at = [
                        family.at(part, rule, weights)
                        for part in _chunks(boxes[used], len(weights))
                    ]
                    x = np.concatenate([each.x for each in at]).reshape(len(used), -1, 3)
                    q = np.concatenate([each.q for each in at]).reshape(len(used), -1)
                    _add_field(B[some], where, places[some], x, q, which)
            except TooNear as near:
                B[some][near.of] = np.nan
    return B


def _add_field(B: Array, where: Ints, places: Array, x: Array, q: Array, which: Ints) -> None:
    """Add to B (n, 3) at places `where` that of charges (boxes, points) of boxes `which`."""
    components = np.ascontiguousarray(np.moveaxis(x, -1, 0))
    for some in _parts(len(where), q.shape[1]):
        d = [places[where[some], i, None] - components[i][which[some]] for i in range(3)]
        square_of_distance = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        share = q[which[some]] / (4 * np.pi * square_of_distance * np.sqrt(square_of_distance))
        for i in range(3):
            B[:, i] += np.bincount(where[some], np.einsum("nm,nm->n", share, d[i]), len(B))


def gradient(families: Sequence[Family], place: Array, e: Array, into: Nodal) -> float:
    """e . B at one place (3,), with its derivatives by the displacement and the remanence at nodes.

    Raises
    ------
    TooNear
        If it is in the shell's surface.
    """
    value = 0.0
    parts = (
        (family, part)
        for family in families
        for boxes, which, _ in family.near(place[None])
        for part in _chunks(boxes[which], POINTS**family.across)
    )
    for family, part in parts:
        rule, weights = cube(POINTS, family.across)
        at = family.at(part, rule, weights, into)
        d = place - at.x
        r = np.linalg.norm(d, axis=-1)
        kernel = d @ e / (4 * np.pi * r**3)
        value += float(np.sum(at.q * kernel))
        slope = e / r[..., None] ** 3 - 3 * (d @ e / r**5)[..., None] * d
        assert at.back
        at.back(-at.q[..., None] * slope / (4 * np.pi), kernel)
    return value


def moment(families: Sequence[Family]) -> Array:
    """The sum of q x, (3,): the integral of the remanence as the shell carries it."""
    total = np.zeros(3)
    for family in families:
        rule, weights = cube(POINTS, family.across)
        for part in _chunks(Boxes.whole(family.count, family.across), len(weights)):
            at = family.at(part, rule, weights)
            total += np.einsum("nml,nmli->i", at.q, at.x)
    return total


@cache
def cube(n: int, across: int = 3) -> tuple[Array, Array]:
    """Gauss's rule on the unit cube, or the square."""
    x, w = gauss(n)
    points, weights = (
        np.stack(np.meshgrid(*[each] * across, indexing="ij"), axis=-1) for each in (x, w)
    )
    return points.reshape(-1, across), weights.prod(axis=-1).ravel()


def _chunks(boxes: Boxes, points: int) -> Iterator[Boxes]:
    each = max(1, CHUNK // points)
    for first in range(0, len(boxes.of), each):
        yield boxes[first : first + each]


def _parts(count: int, each: int) -> Iterator[slice]:
    """So many things, `each` of which has so many points, in parts of about `PAIRS` points."""
    size = max(1, PAIRS // max(each, 1))
    return (slice(first, first + size) for first in range(0, count, size))


def triangles(family: Family, parts: int) -> list[tuple[Array, Array]]:
    """Flat triangles, corners (n, 3, 3), with the charges (n,) of the elements divided into parts²
    each.
    """
    low = np.stack(np.meshgrid(*[np.arange(parts) / parts] * 2, indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    count = len(low)
    boxes = Boxes(
        np.repeat(np.arange(family.count), count),
        np.tile(low, (family.count, 1)),
        np.full((family.count * count, 2), 1 / parts),
    )
    corners, (rule, weights) = np.clip(AROUND, TINY, 1 - TINY), cube(3, 2)
    flat = []
    for part in _chunks(boxes, len(weights)):
        x = family.at(part, corners, np.zeros(len(corners))).x
        q = family.at(part, rule, weights).q.sum(axis=1).ravel()
        quads = np.moveaxis(x, 1, 2).reshape(-1, 4, 3)
        both = quads[:, [[0, 1, 2], [0, 2, 3]]]
        area = np.linalg.norm(
            np.cross(both[:, :, 1] - both[:, :, 0], both[:, :, 2] - both[:, :, 0]), axis=-1
        )
        share = area / area.sum(axis=1, keepdims=True)
        kept = (share > SMALL).ravel()
        flat.append((both.reshape(-1, 3, 3)[kept], (share * q[:, None]).ravel()[kept]))
    return flat
