"""The field outside a magnetised shell, from the magnetic charges on its faces, edges and in it.

A remanence Br that moves as F Br/J with the material has, by Nanson and Piola, charges that stay
with the material: Br.N dA0 on its faces, -Div Br dV0 inside. So the charges are computed on the
undeformed shell, with its thickness and its curvature, and placed at x = r + zeta n of the deformed
one:

    B(x) = sum of q (x - x_q)/(4 pi |x - x_q|³).

What moves otherwise (a remanence that turns and does not stretch, what a field induces) is first
taken back to the undeformed shell by F. Integrals are Gauss's rules on boxes of coordinates, which
are halved until each is far enough from the place. The result is exact at any distance, as the
thickness is modelled as it is. Theory: docs/theory.md, the field of a magnetised shell.

In: a `MagnetisedShell` (nodal values, lengths over R). Out: flux density over the remanence's
magnitude, magnetic moment, derivatives of both, and flat charged triangles.

- An element is a piece of surface or volume with charges, such as the faces above one cell. It has
  coordinates (a, b) in [0, 1]², or (a, b, c) in [0, 1]³. A family is a set of such elements.
- A box is a part of an element, a rectangle of its coordinates; arrays (n, m, ...) have n boxes
  with m points in each.
- A layer is a surface at a constant height through the thickness: the two faces, or one inside. Its
  height eta is over the thickness, from -1/2 to 1/2.
- Jets (`SurfaceJets`) are the values and derivatives by a and b of place, thickness and remanence.
- `swept` cells are those of a meridian, swept around the axis. Each is divided into `SECTORS`
  elements, one behind the other around the ring.
- q is the size of a charge; `NodalDerivatives` collect the derivatives of a number by nodal values.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.magnetised_cells import (
    MagnetisedShell,
    NodalDerivatives,
    SurfaceJets,
    unit,
)

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
GAUSS_POINTS_PER_SIDE = 6  # of the rule on a box
GAUSS_LAYERS = 6  # of charges inside a shell, through the thickness
SEPARATION_IN_RADII = 2.5  # least distance of a place from a box, over the box's radius
MAX_HALVINGS = 40  # of a box
MAX_POINTS_AT_ONCE = 40_000  # at which charges are computed
MAX_CHARGE_PLACE_PAIRS = 200_000  # whose field is computed at once
SECTORS = 8  # of the ring of a meridian's cell
CORNERS_OF_SQUARE = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
CORNER_INSET = 1e-6  # of corners at which triangles are drawn, over the square
MIN_AREA_SHARE = 1e-4  # of a triangle that is drawn, over the area of its quadrangle
GRID_POINTS_PER_SIDE = 9  # of a box, from which Newton's method starts
GRID_OF_SQUARE = np.stack(
    np.meshgrid(*[np.linspace(0, 1, GRID_POINTS_PER_SIDE)] * 2, indexing="ij"), axis=-1
).reshape(-1, 2)
NEWTON_STEPS = 15  # to the foot of a place
FOOT_TOLERANCE = 1e-6  # distance of a place from the normal in its foot, over R
BOUNDARY_INSET = 1e-3  # over the square, as a cell may have no normal at a corner


def _extent_points(dimension: int) -> Array:
    """Return points of the unit square or cube that show the extent of a box.

    They are the middle, then the middles of sides (two opposite ones after each other), then the
    corners.
    """
    middles_of_sides = [
        np.where(np.arange(dimension) == axis, end, 0.5)
        for axis in range(dimension)
        for end in (0.0, 1.0)
    ]
    corners = product((0.0, 1.0), repeat=dimension)
    return np.array([np.full(dimension, 0.5), *middles_of_sides, *corners])


EXTENT_POINTS = {dimension: _extent_points(dimension) for dimension in (2, 3)}

# of charges: their height over the thickness, and three vectors (n, m, 3), the factors of the
# remanence and of its derivatives by a and b. A charge is the sum of three scalar products, of each
# factor with the remanence, or with its derivative
Layer = tuple[Any, tuple[Array, Array, Array]]


class TooNear(ValueError):
    """Raised for places on the surface of the shell, or in it.

    Attributes
    ----------
    numbers
        Row numbers of these places.
    """

    def __init__(self, numbers: Ints) -> None:
        super().__init__(numbers)
        self.numbers = numbers


@cache
def gauss(n: int) -> tuple[Array, Array]:
    """Return points (n,) and weights (n,) of Gauss's rule on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


@dataclass(frozen=True)
class Boxes:
    """Boxes of the coordinates (a, b) in [0, 1]² of some elements, or (a, b, c) in [0, 1]³.

    Attributes
    ----------
    elements
        (n,) numbers of the elements.
    low, size
        (n, 2 or 3) lowest corners and sides.
    """

    elements: Ints
    low: Array
    size: Array

    @classmethod
    def undivided(cls, count: int, dimension: int = 2) -> "Boxes":
        """Return one box for each of `count` elements."""
        shape = count, dimension
        return cls(np.arange(count), np.zeros(shape), np.ones(shape))

    def __getitem__(self, which: Any) -> "Boxes":
        return Boxes(self.elements[which], self.low[which], self.size[which])

    def halves(self, sides: Ints) -> "Boxes":
        """Return both halves of each box; box i is divided across its coordinate `sides[i]`.

        The 2 n boxes are all lower halves, then all upper halves.
        """
        size = self.size.copy()
        rows = np.arange(len(size))
        size[rows, sides] /= 2
        second = self.low.copy()
        second[rows, sides] += size[rows, sides]
        low = np.concatenate([self.low, second])
        return Boxes(np.tile(self.elements, 2), low, np.tile(size, (2, 1)))

    def points(self, x: Array) -> Array:
        """Map points (m, 2 or 3) of the unit square or cube into each box: (n, m, 2 or 3)."""
        return np.asarray(self.low[:, None] + self.size[:, None] * x)


@dataclass(frozen=True)
class PointCharges:
    """Charges at points of boxes.

    Attributes
    ----------
    x
        (n, m, layers, 3) places of the charges.
    q
        (n, m, layers) charges, with the weights of points and layers and the size of the box.
    add_derivatives
        Function of dJ/dx (n, m, layers, 3) and dJ/dq (n, m, layers) of some number J. It adds the
        derivatives of J by nodal values to the `NodalDerivatives` that were given to `charges_at`.
        None if none were given.
    """

    x: Array
    q: Array
    add_derivatives: Callable[[Array, Array], None] | None = None


class ChargedElements:
    """Base of charged elements with coordinates (a, b), or (a, b, c) where they are solid.

    Attributes
    ----------
    count
        Number of elements.
    dimension
        Number of coordinates.
    """

    count: int
    dimension: ClassVar[int] = 2

    def box_places(self, boxes: Boxes, x: Array) -> Array:
        """Return deformed places (n, m, k, 3) over R of points x (m, 2 or 3) of n boxes.

        There are k places at each point, through the thickness. They show the extent of a box.
        """
        raise NotImplementedError

    def charges_at(
        self,
        boxes: Boxes,
        x: Array,
        weights: Array,
        nodal_derivatives: NodalDerivatives | None = None,
    ) -> PointCharges:
        """Return the charges at points x (m, 2 or 3) of the unit square or cube, in each box.

        They are multiplied by the weights (m,) of the points and by the size of the box. If
        `nodal_derivatives` is given, `add_derivatives` of the result adds to it.
        """
        raise NotImplementedError

    def separated_boxes(self, places: Array) -> Iterator[tuple[Boxes, Ints, Ints]]:
        """Yield sets of boxes, each with the places that are far enough from them for Gauss's rule.

        A box that is too near to a place is halved for this place. So for each of the places (n, 3)
        over R, the boxes with which it is paired cover all elements once.

        Yields
        ------
        boxes
            A set of boxes.
        box_of_pair, place_of_pair
            (pairs,) numbers of the box in this set and of the place, for each pair.

        Raises
        ------
        TooNear
            If a place is in the shell's surface, after all others have their boxes.
        """
        # points that show the extent of a box; a little inside, as a cell may have no normal at a
        # corner
        extent_points = np.clip(EXTENT_POINTS[self.dimension], BOUNDARY_INSET, 1 - BOUNDARY_INSET)
        # at first each element is a box, and each place is paired with all of them
        boxes = Boxes.undivided(self.count, self.dimension)
        place_of_pair = np.repeat(np.arange(len(places)), self.count)
        box_of_pair = np.tile(np.arange(self.count), len(places))
        for _ in range(MAX_HALVINGS):
            if not len(box_of_pair):
                return
            # (boxes, points, k, 3), with k places through the thickness; the first is the middle
            box_places = self.box_places(boxes, extent_points)
            centre = box_places[:, 0]
            radius = np.sqrt(((box_places - box_places[:, :1]) ** 2).sum(axis=-1)).max(axis=(1, 2))
            # there are several centres through the thickness, of which the nearest counts
            distance = np.linalg.norm(
                places[place_of_pair][:, None] - centre[box_of_pair], axis=-1
            ).min(axis=-1)
            is_separated = distance > SEPARATION_IN_RADII * radius[box_of_pair]
            if is_separated.any():
                yield boxes, box_of_pair[is_separated], place_of_pair[is_separated]
            # boxes too near to a place are halved across their longest direction, for this place
            halved, box_of_pair = np.unique(box_of_pair[~is_separated], return_inverse=True)
            place_of_pair = place_of_pair[~is_separated]
            boxes = boxes[halved].halves(_longest_directions(box_places[halved], self.dimension))
            # a place is paired with both halves: the lower halves come first, then the upper ones
            box_of_pair = np.concatenate([box_of_pair, box_of_pair + len(halved)])
            place_of_pair = np.tile(place_of_pair, 2)
        if len(box_of_pair):
            raise TooNear(np.unique(place_of_pair))


def _longest_directions(box_places: Array, dimension: int) -> Ints:
    """Return the number of the coordinate along which each of n boxes is longest.

    `box_places` (n, m, k, 3) are at the points of `_extent_points`: behind the middle come the
    middles of the `dimension` pairs of opposite sides.
    """
    ends = box_places[:, 1 : 1 + 2 * dimension]
    lengths = np.linalg.norm(ends[:, 1::2] - ends[:, ::2], axis=-1).max(axis=-1)
    return np.asarray(lengths.argmax(axis=1))


class ShellFaces(ChargedElements):
    """Charges of both faces of a shell, and of its interior where the remanence varies.

    The interior is represented by Gauss layers through the thickness. A uniform remanence has no
    charge inside, so these layers are left out; with `include_uncharged` they are kept, as
    derivatives by the remanence need them.

    Attributes
    ----------
    _cells, _sector
        (count,) the cell of each element, and its number among the sectors of this cell.
    _sectors
        Number of sectors of a swept cell; 1 for a triangle.
    _inside
        Pairs of the height and the weight of each layer inside; empty if there are none.
    shape
        The magnetised shell.
    """

    def __init__(
        self, shape: MagnetisedShell, cells: Ints, *, include_uncharged: bool = False
    ) -> None:
        """Divide swept cells into sectors, and decide whether layers inside are needed."""
        self.shape = shape
        sectors = SECTORS if shape.swept else 1
        self._cells = np.repeat(cells, sectors)
        self._sector = np.tile(np.arange(sectors), len(cells))
        self._sectors, self.count = sectors, sectors * len(cells)
        spread = np.abs(shape.remanence - shape.remanence[:, :1]).max(initial=0.0)
        # a uniform remanence has no charge inside; one that is swept around the axis is uniform in
        # space only if it is along the axis
        is_uniform = spread <= 1e-12 * np.abs(shape.remanence).max(initial=0.0)
        is_axial = not shape.swept or not np.abs(shape.remanence[..., :2]).any()
        is_uncharged = is_uniform and is_axial
        self._inside = (
            []
            if is_uncharged and not include_uncharged
            else list(zip(*_interior_layers(), strict=True))
        )

    def _jets(self, boxes: Boxes, x: Array) -> SurfaceJets:
        """Return the surface's jets at points x (m, 2) of the unit square, mapped into each box."""
        return self._jets_at(boxes, boxes.points(x))

    def _jets_at(self, boxes: Boxes, ab: Array) -> SurfaceJets:
        """Return the surface's jets at coordinates ab (n, m, 2) of the elements of n boxes.

        An element of a meridian is one sector of a ring, so that b counts within the sector.
        """
        ab = ab.copy()
        if self.shape.swept:
            ab[..., 1] = (self._sector[boxes.elements][:, None] + ab[..., 1]) / self._sectors
        return SurfaceJets.at_points(self.shape, self._cells[boxes.elements], ab)

    def box_places(self, boxes: Boxes, x: Array) -> Array:
        jets = self._jets(boxes, x)
        return np.stack([jets.place(0.5), jets.place(-0.5)], axis=2)

    def contains(self, places: Array) -> NDArray[np.bool_]:
        """Return flags (n,) of the places (n, 3) over R that are in the deformed shell.

        Such a place has a foot, the nearest point of the mid-surface, at a distance below half of
        the thickness. Newton's method for the foot starts from the nearest point of a grid on each
        element.
        """
        is_inside = np.zeros(len(places), dtype=bool)
        if not self.count:
            return is_inside
        boxes = Boxes.undivided(self.count)
        start = np.clip(GRID_OF_SQUARE, BOUNDARY_INSET, 1 - BOUNDARY_INSET)
        # pairs of a place and a box near it, with the number of the nearest grid point of the box
        place, box, point = self._nearest_grid_points(places, self._jets(boxes, start))
        if len(place):
            # whether the place of each pair is above or below a point of the box, in the shell
            has_foot = self._feet_within(
                boxes[box], ab=start[point][:, None], x=places[place][:, None]
            )
            is_inside[place[has_foot]] = True
        return is_inside

    def _nearest_grid_points(self, places: Array, grid: SurfaceJets) -> tuple[Ints, Ints, Ints]:
        """Return pairs of a place and a box that may contain it, with the nearest grid point.

        Parameters
        ----------
        places
            (n, 3) over R.
        grid
            Jets at the points of `GRID_OF_SQUARE` in all boxes, one for each element.

        Returns
        -------
        place, box, point
            (pairs,) numbers of the place, of the box, and of the point in the grid of this box.
        """
        from scipy.spatial import cKDTree  # takes long to import

        # (boxes,) distance from a box's grid points within which places in the shell lie; then for
        # each place the numbers of all grid points within the largest of these distances
        reach = _reach_of_grid(grid)
        candidates = cKDTree(grid.r[0].reshape(-1, 3)).query_ball_point(places, reach.max())
        place = np.repeat(np.arange(len(places)), [len(array) for array in candidates])
        # the tree counts grid points box by box
        points_per_box = grid.r[0].shape[1]
        box, point = np.divmod(np.concatenate([*candidates, []]).astype(np.intp), points_per_box)
        distance_to_point = np.linalg.norm(places[place] - grid.r[0][box, point], axis=-1)
        # sorted by place, then by box, then by distance; points beyond the reach are left out
        order = np.lexsort((distance_to_point, box, place))
        order = order[distance_to_point[order] <= reach[box[order]]]
        # the first entry of each pair (place, box) has the nearest point
        _, nearest = np.unique(place[order] * self.count + box[order], return_index=True)
        place, box, point = (array[order][nearest] for array in (place, box, point))
        return place, box, point

    def _feet_within(self, boxes: Boxes, ab: Array, x: Array) -> NDArray[np.bool_]:
        """Return flags (n,): whether place x[i] has a foot in box i within half of the thickness.

        Places x are (n, 1, 3): one for each box. Newton's method for the foot starts from the
        coordinates `ab` (n, 1, 2).
        """
        for _ in range(NEWTON_STEPS):
            foot = self._jets_at(boxes, ab)
            J = np.stack([foot.r[1], foot.r[2]], axis=-1)
            # the change of (a, b) to the point of the tangent plane that is nearest to the place
            step = np.einsum("nmdi,nmi->nmd", np.linalg.pinv(J), x - foot.r[0])
            # J has the derivative by b of the whole ring, while b counts within one sector here
            step[..., 1] *= self._sectors
            ab = np.clip(ab + step, BOUNDARY_INSET**3, 1 - BOUNDARY_INSET**3)
        foot = self._jets_at(boxes, ab)
        # the distance from the last iterate, along the normal and across it
        d, n = x - foot.r[0], unit(np.cross(foot.r[1], foot.r[2]))
        normal_distance = np.sum(d * n, axis=-1)
        off_normal = np.linalg.norm(d - normal_distance[..., None] * n, axis=-1)
        return np.asarray(
            (np.abs(normal_distance) <= foot.thickness / 2) & (off_normal < FOOT_TOLERANCE)
        )[:, 0]

    def charges_at(
        self,
        boxes: Boxes,
        x: Array,
        weights: Array,
        nodal_derivatives: NodalDerivatives | None = None,
    ) -> PointCharges:
        """Return the charges of both faces and of the layers inside, at points x (m, 2) of boxes.

        By Nanson, a face has the charge Br . (dX/da x dX/db), with X on the undeformed layer. A
        layer inside has -Div Br dV0: derivatives of Br by a and b times the cofactors dX/db x
        dX/deta and dX/deta x dX/da. Br does not vary through the thickness.
        """
        # (n, m) share of each point in the area of its box; an element is one sector of the ring
        area = np.prod(boxes.size, axis=1)[:, None] * weights / self._sectors

        def layers(at: SurfaceJets) -> list[Layer]:
            """Return the layers at the points of jets: both faces, then the ones inside.

            A layer has three factors: of Br and of its derivatives by a and b. On a face only the
            first is not zero, inside only the other two are not.
            """
            layers_of_jets = list[Layer]()
            for eta, sign in ((0.5, 1.0), (-0.5, -1.0)):  # outward normals are opposite
                # derivatives of the undeformed place by a and b
                G1, G2, _ = at.layer(eta)
                layers_of_jets.append(
                    (eta, ((sign * area)[..., None] * np.cross(G1, G2), 0 * G1, 0 * G1))
                )
            for eta, weight in self._inside:
                G1, G2, G3 = at.layer(eta)
                density = -(weight * area)[..., None]
                layers_of_jets.append(
                    (eta, (0 * G1, density * np.cross(G2, G3), density * np.cross(G3, G1)))
                )
            return layers_of_jets

        return _point_charges(self._jets(boxes, x), layers, nodal_derivatives)


class EdgeStrips(ChargedElements):
    """Edges of cells as charged strips: coordinates along the edge and through the thickness.

    `cells` and `edges` (n,) are the cell and the local number of each edge.

    Attributes
    ----------
    _cells, _edges
        (count,) the cell and the local number of the edge of each element.
    _sector, _sectors
        (count,) the number of each element among the sectors of its cell, and how many these are.
    """

    def __init__(self, shape: MagnetisedShell, cells: Ints, edges: Ints) -> None:
        self.shape = shape
        self._sectors = SECTORS if shape.swept else 1
        self._cells, self._edges = np.repeat(cells, self._sectors), np.repeat(edges, self._sectors)
        self._sector = np.tile(np.arange(self._sectors), len(cells))
        self.count = len(self._cells)

    def _coordinates(self, boxes: Boxes, x: Array) -> tuple[Array, Array, Array]:
        """Return where the points x (m, 2) of the unit square are in each box of a strip.

        The first coordinate of a point runs along the edge, the second through the thickness.

        Returns
        -------
        ab
            (n, m, 2) surface coordinates.
        tangents
            (n, 2) derivative of the surface coordinates along the edge.
        heights
            (n, m) heights over the thickness.
        """
        s, eta = np.moveaxis(boxes.points(x), -1, 0)
        edge = self._edges[boxes.elements][:, None]
        if self.shape.swept:
            # edge 1 is the circle a = 1, edge 0 the circle a = 0, which runs backwards
            a = np.where(edge == 1, 1.0, 0.0) + 0 * s
            b = (self._sector[boxes.elements][:, None] + s) / self._sectors
            tangents = np.where(edge == 1, 1.0, -1.0)[..., None] * np.array([0.0, 1.0])
            return np.stack([a, b], axis=-1), tangents[:, 0], eta - 0.5
        # around the triangle with the surface on the left: b = 1 backwards, a = 0 backwards, b = 0
        a = np.where(edge == 0, 1 - s, np.where(edge == 2, s, 0.0))
        b = np.where(edge == 0, 1.0, np.where(edge == 1, 1 - s, 0.0))
        tangents = np.array([[-1.0, 0.0], [0.0, -1.0], [1.0, 0.0]])[self._edges[boxes.elements]]
        return np.stack([a, b], axis=-1), tangents, eta - 0.5

    def _jets(self, boxes: Boxes, x: Array) -> tuple[SurfaceJets, Array, Array]:
        """Return the surface's jets at points x (m, 2) of boxes, then tangents and heights.

        Tangents and heights are those of `_coordinates`.
        """
        ab, tangents, eta = self._coordinates(boxes, x)
        return SurfaceJets.at_points(self.shape, self._cells[boxes.elements], ab), tangents, eta

    def box_places(self, boxes: Boxes, x: Array) -> Array:
        jets, _, eta = self._jets(boxes, x)
        n = unit(np.cross(jets.r[1], jets.r[2]))
        return np.asarray(jets.r[0] + (eta * jets.thickness)[..., None] * n)[:, :, None]

    def charges_at(
        self,
        boxes: Boxes,
        x: Array,
        weights: Array,
        nodal_derivatives: NodalDerivatives | None = None,
    ) -> PointCharges:
        """Return the charges Br . N dA0 of the strips at points x (m, 2) of boxes.

        The outward area vector is the cross product of the undeformed edge's tangent and dX/deta.
        """
        jets, tangents, eta = self._jets(boxes, x)
        # (n, m) share of each point in the area of its box; an element is one sector of the ring
        area = (
            np.prod(boxes.size, axis=1)[:, None]
            * weights
            / (self._sectors if self.shape.swept else 1)
        )

        def layers(jets: SurfaceJets) -> list[Layer]:
            """Return the points of the strip as a single layer, each with its own height."""
            # derivatives of the undeformed place by a, b and the height
            G1, G2, G3 = jets.layer(eta[..., None])  # type: ignore[arg-type]  # heights of points
            tangent = tangents[:, None, :1] * G1 + tangents[:, None, 1:] * G2
            outward = area[..., None] * np.cross(tangent, G3)
            return [(eta[..., None], (outward, 0 * outward, 0 * outward))]

        return _point_charges(jets, layers, nodal_derivatives)


def _reach_of_grid(grid: SurfaceJets) -> Array:
    """Return the distance (boxes,) from a grid point within which places of the shell lie.

    It is the longest diagonal of the grid's squares, and the thickness, for each box. `grid` are
    jets at the points of `GRID_OF_SQUARE`.
    """
    grid_places = grid.r[0].reshape(-1, GRID_POINTS_PER_SIDE, GRID_POINTS_PER_SIDE, 3)
    diagonals = [
        grid_places[:, 1:, 1:] - grid_places[:, :-1, :-1],
        grid_places[:, 1:, :-1] - grid_places[:, :-1, 1:],
    ]
    longest_diagonal = np.max(
        [np.linalg.norm(array, axis=-1).max(axis=(1, 2)) for array in diagonals], axis=0
    )
    return np.asarray(longest_diagonal + grid.thickness.max(axis=1))


def heights(faces: ShellFaces) -> Array:
    """Return the heights (layers,) of a shell's charges over the thickness: faces, then inside."""
    return np.array([0.5, -0.5, *(eta for eta, _ in faces._inside)])


def _interior_layers() -> tuple[Array, Array]:
    """Return heights (layers,) of the layers inside, over the thickness, and their weights."""
    x, w = gauss(GAUSS_LAYERS)
    return x - 0.5, w


def _point_charges(
    jets: SurfaceJets,
    layers_of: Callable[[SurfaceJets], list[Layer]],
    nodal_derivatives: NodalDerivatives | None,
) -> PointCharges:
    """Return the charges of some layers of a surface.

    Parameters
    ----------
    jets
        Jets of the surface at the points. B (3, n, m, 3) are the remanence and its derivatives.
    layers_of
        Jets -> the layers, each with its height and the factors of B in its charges.
    nodal_derivatives
        Derivatives to which `PointCharges.add_derivatives` adds; None if none are wanted.
    """
    n, layers = unit(np.cross(jets.r[1], jets.r[2])), layers_of(jets)
    thickness = jets.thickness[..., None]
    # places (n, m, layers, 3): the mid-surface, plus the height along the normal
    x = np.stack([jets.r[0] + eta * thickness * n for eta, _ in layers], axis=2)

    q = _charges_of_layers(layers, jets.B)
    if nodal_derivatives is None:
        return PointCharges(x, q)

    def add_derivatives(on_x: Array, on_q: Array) -> None:
        """Add the derivatives of a number J by nodal values to `nodal_derivatives`.

        `on_x` and `on_q` are dJ/dx and dJ/dq by places and sizes of the charges.
        """
        # the place of a charge is x = r + height n, so that dJ/dr = dJ/dx, dJ/dn = height dJ/dx
        heights = np.stack([eta * thickness + 0 * jets.r[0][..., :1] for eta, _ in layers], axis=2)
        by_B = []  # by B and its two derivatives
        for j in range(3):
            by_layers = (
                on_q[:, :, layer, None] * factors[j] for layer, (_, factors) in enumerate(layers)
            )
            by_B.append(sum(by_layers))
        jets.add_derivatives(
            nodal_derivatives,
            by_place=on_x.sum(axis=2),
            by_normal=(heights * on_x).sum(axis=2),
            by_B=np.stack(by_B),
        )
        # the charges' factors depend on the undeformed shell, too; B does not
        jets.add_reference_derivatives(
            nodal_derivatives,
            charges_of=lambda other: _charges_of_layers(layers_of(other), jets.B),
            by_charges=on_q,
        )

    return PointCharges(x, q, add_derivatives)


def _charges_of_layers(layers: list[Layer], B: Array) -> Array:
    """Return the charges (n, m, layers): factors of layers times B and its derivatives.

    B (3, n, m, 3) are the remanence and its derivatives by a and b.
    """
    charges_of_layers = []
    for _, factors in layers:
        charges = (np.sum(factor * b, axis=-1) for factor, b in zip(factors, B, strict=True))
        charges_of_layers.append(sum(charges))
    return np.stack(charges_of_layers, axis=2)


def field(families: Sequence[ChargedElements], places: Array) -> Array:
    """Return the flux density (n, 3) of charges at places (n, 3); nan in the shell's surface.

    `families` are sets of charged elements, such as faces and edge strips. Places are over R; the
    flux density is over the remanence's magnitude. Not collective: only this rank's elements count.
    """
    B = np.zeros_like(places)
    for family in families:
        for part_of_places in _slices(len(places), family.count):
            try:
                for boxes, box_of_pair, place_of_pair in family.separated_boxes(
                    places[part_of_places]
                ):
                    # the charges of a box are computed once, for all places that are paired with it
                    used_boxes, box_of_pair = np.unique(box_of_pair, return_inverse=True)
                    x, q = _charges_of_boxes(family, boxes[used_boxes])
                    _add_field(
                        B[part_of_places], place_of_pair, places[part_of_places], x, q, box_of_pair
                    )
            except TooNear as error:
                B[part_of_places][error.numbers] = np.nan
    return B


def _charges_of_boxes(family: ChargedElements, boxes: Boxes) -> tuple[Array, Array]:
    """Return the charges of n boxes by Gauss's rule: places (n, points, 3) and sizes (n, points).

    The points of a box are those of the rule, on each layer through the thickness.
    """
    rule, weights = cube(GAUSS_POINTS_PER_SIDE, family.dimension)
    parts_of_charges = [
        family.charges_at(part_of_boxes, rule, weights)
        for part_of_boxes in _chunks_of_boxes(boxes, len(weights))
    ]
    count = len(boxes.elements)
    x = np.concatenate([charges.x for charges in parts_of_charges]).reshape(count, -1, 3)
    q = np.concatenate([charges.q for charges in parts_of_charges]).reshape(count, -1)
    return x, q


def _add_field(
    B: Array, place_of_pair: Ints, places: Array, x: Array, q: Array, box_of_pair: Ints
) -> None:
    """Add to B (n, 3) at places (n, 3) the field of the charges of boxes.

    Parameters
    ----------
    place_of_pair, box_of_pair
        (pairs,) numbers of the place and of the box of each pair that is counted.
    x, q
        (boxes, points, 3) places and (boxes, points) sizes of the charges.
    """
    # each component of places, and of differences, is an array of its own, for speed
    components = np.ascontiguousarray(np.moveaxis(x, -1, 0))
    for pairs in _slices(len(place_of_pair), q.shape[1]):
        # components of x - x_q, each (pairs, points)
        d = [
            places[place_of_pair[pairs], i, None] - components[i][box_of_pair[pairs]]
            for i in range(3)
        ]
        square_of_distance = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
        q_over_cube = q[box_of_pair[pairs]] / (
            4 * np.pi * square_of_distance * np.sqrt(square_of_distance)
        )
        for i in range(3):
            # the sum over all pairs of a place
            B[:, i] += np.bincount(
                place_of_pair[pairs], np.einsum("nm,nm->n", q_over_cube, d[i]), len(B)
            )


def gradient(
    families: Sequence[ChargedElements], place: Array, e: Array, nodal_derivatives: NodalDerivatives
) -> float:
    """Return e . B at one place (3,), and add its derivatives to `nodal_derivatives`.

    B is the flux density over the remanence's magnitude, e a vector (3,), as the axis of a sensor.
    Only this rank's elements are counted.

    Raises
    ------
    TooNear
        If the place is in the shell's surface.
    """
    value = 0.0
    # all boxes that are far enough from the place, in chunks; each belongs to one family
    chunks = (
        (family, chunk)
        for family in families
        for boxes, box, _ in family.separated_boxes(place[None])
        for chunk in _chunks_of_boxes(boxes[box], GAUSS_POINTS_PER_SIDE**family.dimension)
    )
    for family, chunk in chunks:
        rule, weights = cube(GAUSS_POINTS_PER_SIDE, family.dimension)
        charges = family.charges_at(chunk, rule, weights, nodal_derivatives)
        d = place - charges.x
        r = np.linalg.norm(d, axis=-1)
        kernel = d @ e / (4 * np.pi * r**3)  # e . B of a unit charge
        value += float(np.sum(charges.q * kernel))
        # 4 pi times the derivative of the kernel by the place; by a charge's place it is opposite
        kernel_slope = e / r[..., None] ** 3 - 3 * (d @ e / r**5)[..., None] * d
        by_charge_places = -charges.q[..., None] * kernel_slope / (4 * np.pi)
        assert charges.add_derivatives
        charges.add_derivatives(by_charge_places, kernel)
    return value


def moment(families: Sequence[ChargedElements]) -> Array:
    """Return the magnetic moment (3,) of this rank's charges: the sum of q x.

    It is over R³ and the remanence's magnitude. Its value is the integral of the remanence F Br as
    the deformed shell carries it.
    """
    total = np.zeros(3)
    for family in families:
        rule, weights = cube(GAUSS_POINTS_PER_SIDE, family.dimension)
        for chunk in _chunks_of_boxes(
            Boxes.undivided(family.count, family.dimension), len(weights)
        ):
            charges = family.charges_at(chunk, rule, weights)
            total += np.einsum("nml,nmli->i", charges.q, charges.x)
    return total


@cache
def cube(n: int, dimension: int = 3) -> tuple[Array, Array]:
    """Return points (m, dimension) and weights (m,) of Gauss's rule on the unit cube or square."""
    x, w = gauss(n)
    points, weights = (
        np.stack(np.meshgrid(*[coordinates] * dimension, indexing="ij"), axis=-1)
        for coordinates in (x, w)
    )
    return points.reshape(-1, dimension), weights.prod(axis=-1).ravel()


def _chunks_of_boxes(boxes: Boxes, points_per_box: int) -> Iterator[Boxes]:
    """Divide boxes into chunks of at most `MAX_POINTS_AT_ONCE` points together."""
    boxes_at_once = max(1, MAX_POINTS_AT_ONCE // points_per_box)
    for first in range(0, len(boxes.elements), boxes_at_once):
        yield boxes[first : first + boxes_at_once]


def _slices(count: int, points_per_item: int) -> Iterator[slice]:
    """Divide `count` items into slices of at most `MAX_CHARGE_PLACE_PAIRS` points together.

    A slice has at least one item.
    """
    size = max(1, MAX_CHARGE_PLACE_PAIRS // max(points_per_item, 1))
    return (slice(first, first + size) for first in range(0, count, size))


def triangles(family: ChargedElements, parts: int) -> list[tuple[Array, Array]]:
    """Return flat charged triangles that approximate the charges of the elements.

    The list has one pair of arrays for each chunk of elements: corners (n, 3, 3) over R and charges
    (n,). Each element is divided into parts² quadrangles, and each of these, on every layer, into
    two triangles. They share the quadrangle's charge by area; triangles almost without area are
    left out.
    """
    # parts x parts boxes of each element, by their lowest corners
    low = np.stack(np.meshgrid(*[np.arange(parts) / parts] * 2, indexing="ij"), axis=-1).reshape(
        -1, 2
    )
    count = len(low)
    boxes = Boxes(
        elements=np.repeat(np.arange(family.count), count),
        low=np.tile(low, (family.count, 1)),
        size=np.full((family.count * count, 2), 1 / parts),
    )
    corners = np.clip(CORNERS_OF_SQUARE, CORNER_INSET, 1 - CORNER_INSET)
    rule, weights = cube(3, 2)
    triangles_and_charges = []
    for chunk in _chunks_of_boxes(boxes, len(weights)):
        # at the corners only places are wanted: their charges have the weight zero
        x = family.charges_at(chunk, corners, np.zeros(len(corners))).x
        q = family.charges_at(chunk, rule, weights).q.sum(axis=1).ravel()
        # x is (boxes, corners, layers, 3): a box has one quadrangle on each layer
        quads = np.moveaxis(x, 1, 2).reshape(-1, 4, 3)
        halves = quads[:, [[0, 1, 2], [0, 2, 3]]]
        area = np.linalg.norm(
            np.cross(halves[:, :, 1] - halves[:, :, 0], halves[:, :, 2] - halves[:, :, 0]), axis=-1
        )
        # each of both triangles has a share of its quadrangle's charge
        share = area / area.sum(axis=1, keepdims=True)
        has_area = (share > MIN_AREA_SHARE).ravel()
        triangles_and_charges.append(
            (halves.reshape(-1, 3, 3)[has_area], (share * q[:, None]).ravel()[has_area])
        )
    return triangles_and_charges
