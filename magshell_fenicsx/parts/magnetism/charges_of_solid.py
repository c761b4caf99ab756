"""The charges of a magnetised solid: on faces of its cells, and inside where the remanence varies.

As the charges of a shell (see `charges`) they stay with the material: Br.N dA0 on faces, -Div Br
dV0 inside. Here both are exact for the mesh, whose cells are mapped from a cube; between cells only
a jump of the remanence leaves a charge. Theory: docs/theory.md, the field of a magnetised shell.

- An element is the face or the interior of a cell with its charges; a family is a set of elements.
- A box is a part of an element, a rectangle or cuboid of its coordinates (a, b) or (a, b, c) in
  [0, 1]. Arrays (n, m, ...) have n boxes with m points in each.
- X is the undeformed place, u the displacement, Br the remanence; places are over R.
- q is the size of a charge; `NodalDerivatives` collect the derivatives of a number by nodal values.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import basix
import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.parts.magnetism.charges import (
    FOOT_TOLERANCE,
    GAUSS_LAYERS,
    MAX_POINTS_AT_ONCE,
    NEWTON_STEPS,
    Boxes,
    ChargedElements,
    PointCharges,
    gauss,
)
from magshell_fenicsx.parts.magnetism.magnetised_cells import NodalDerivatives, tables

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
# of the largest remanence: a cell in which the remanence differs by less has no charge inside
UNIFORMITY_TOLERANCE = 1e-12
NEWTON_OVERSHOOT = 0.3  # how far Newton's method may leave the unit cube
CUBE_TOLERANCE = 1e-9  # places that are outside the unit cube by less count as inside
RADIUS_FACTOR = 1.1  # of the radius of a cell's nodes: no place of it is farther from its middle
CORNERS_OF_CUBE = basix.geometry(basix.CellType.hexahedron)
CORNERS_OF_FACES = np.array(basix.topology(basix.CellType.hexahedron)[2])  # (6, 4)
# corner at which the coordinates (a, b) of each face begin, and the vectors along them
FACE_ORIGINS = CORNERS_OF_CUBE[CORNERS_OF_FACES[:, 0]]
FACE_TANGENTS = CORNERS_OF_CUBE[CORNERS_OF_FACES[:, 1:3]] - CORNERS_OF_CUBE[CORNERS_OF_FACES[:, :1]]
OUTWARD_SIGNS = np.sign(
    np.sum(
        np.cross(FACE_TANGENTS[:, 0], FACE_TANGENTS[:, 1])
        * basix.cell.facet_outward_normals(basix.CellType.hexahedron),
        axis=1,
    )
)


@dataclass(frozen=True)
class MagnetisedSolid:
    """Cells of a magnetised solid, with nodal values; lengths over R.

    Attributes
    ----------
    element
        Lagrange element of the undeformed place and of the displacement, on the unit cube.
    X, u
        (cells, nodes, 3) undeformed places and displacements.
    remanence_element
        Discontinuous element of the remanence.
    remanence
        (cells, its nodes, 3) remanence in the undeformed solid.
    """

    element: Any
    X: Array
    u: Array
    remanence_element: Any
    remanence: Array

    def contains(self, places: Array) -> NDArray[np.bool_]:
        """Return flags (n,) of the places (n, 3) over R that are in deformed cells of this rank.

        A cell is looked at if the ball around its nodes, slightly enlarged, contains the place.
        """
        from scipy.spatial import cKDTree  # takes long to import

        is_inside = np.zeros(len(places), dtype=bool)
        if not len(self.X):
            return is_inside
        x = self.X + self.u
        middle = x.mean(axis=1)
        radius = RADIUS_FACTOR * np.linalg.norm(x - middle[:, None], axis=-1).max(axis=1)
        candidates = cKDTree(middle).query_ball_point(places, radius.max())
        # all pairs (place, cell): one number of each in two arrays of the same length
        place = np.repeat(
            np.arange(len(places)), [len(cells_of_place) for cells_of_place in candidates]
        )
        cell = np.concatenate([*candidates, []]).astype(np.intp)
        # pairs (place, cell) whose ball contains the place
        is_near = np.linalg.norm(places[place] - middle[cell], axis=-1) <= radius[cell]
        place, cell = place[is_near], cell[is_near]
        for first in range(0, len(place), MAX_POINTS_AT_ONCE):
            pairs = slice(first, first + MAX_POINTS_AT_ONCE)
            in_cell = self._are_in_cells(nodes=x[cell[pairs]], x=places[place[pairs]])
            is_inside[place[pairs][in_cell]] = True
        return is_inside

    def _are_in_cells(self, nodes: Array, x: Array) -> NDArray[np.bool_]:
        """Return flags (n,): whether place x[i] is in the deformed cell with nodes `nodes[i]`.

        Places are (n, 3), nodes (n, k, 3). Newton's method for the reference coordinates of a place
        starts from the nearest node.
        """
        nearest = np.linalg.norm(nodes - x[:, None], axis=-1).argmin(axis=1)
        # reference coordinates (n, 3) of the places, each in its cell
        reference = self.element.points[nearest]
        for _ in range(NEWTON_STEPS):
            # deformed places there, and their three derivatives by reference coordinates
            value, *gradients = np.einsum(
                "dnk,nki->dni", tables(self.element, reference[:, None], 1)[:, :, 0], nodes
            )
            # clipped, so that an iterate does not leave the range where the map is regular
            step = np.linalg.pinv(np.stack(gradients, axis=-1)) @ (x - value)[..., None]
            reference = np.clip(reference + step[..., 0], -NEWTON_OVERSHOOT, 1 + NEWTON_OVERSHOOT)
        value = np.einsum("nk,nki->ni", tables(self.element, reference[:, None], 0)[0, :, 0], nodes)
        is_in_cube = (reference > -CUBE_TOLERANCE).all(axis=1) & (
            reference < 1 + CUBE_TOLERANCE
        ).all(axis=1)
        return np.asarray(is_in_cube & (np.linalg.norm(x - value, axis=1) < FOOT_TOLERANCE))


class SolidCharges(ChargedElements):
    """Base of the charges of some cells of a solid.

    Attributes
    ----------
    shape
        The solid with all its cells.
    cells
        (count,) the number of each element's cell; a cell may occur once for each face.

    The field `_nodes` (cells, nodes, 3) has the deformed nodes of all cells.
    """

    def __init__(self, shape: MagnetisedSolid, cells: Ints) -> None:
        self.shape, self.cells, self.count = shape, cells, len(cells)

    def reference(self, boxes: Boxes, x: Array) -> Array:
        """Return places (n, m, 3) on the reference cube of points x of boxes.

        The points (m, 2) of a face or (m, 3) of a cell are in the unit square or cube of each box.
        """
        raise NotImplementedError

    def remanence_factors(self, boxes: Boxes, X: Array, weights: Array) -> Array:
        """Return factors C (4, n, m, 3) of the remanence and its derivatives in the charges.

        A charge is q = C[0] . Br + C[1] . Br_a + C[2] . Br_b + C[3] . Br_c, with derivatives by the
        reference coordinates.

        Parameters
        ----------
        boxes
            The n boxes.
        X
            (3, n, m, 3) derivatives of undeformed places by reference coordinates.
        weights
            (n, m) weights of the points, with the size of the box.
        """
        raise NotImplementedError

    def box_places(self, boxes: Boxes, x: Array) -> Array:
        return self.places(boxes, self.reference(boxes, x))[:, :, None]

    def places(self, boxes: Boxes, reference: Array) -> Array:
        """Return the deformed places (n, m, 3) of reference coordinates (n, m, 3)."""
        cells = self.cells[boxes.elements]
        return np.asarray(
            np.einsum(
                "nmk,nki->nmi", tables(self.shape.element, reference, 0)[0], self._nodes[cells]
            )
        )

    @cached_property
    def _nodes(self) -> Array:
        return self.shape.X + self.shape.u

    def charges_at(
        self,
        boxes: Boxes,
        x: Array,
        weights: Array,
        nodal_derivatives: NodalDerivatives | None = None,
    ) -> PointCharges:
        """Return the charges at points x (m, 2 or 3) of each of n boxes, in one layer.

        They are multiplied by the weights (m,) and the size of the box. If `nodal_derivatives` is
        given, `add_derivatives` of the result adds to it.
        """
        reference, cells, solid = self.reference(boxes, x), self.cells[boxes.elements], self.shape
        # values and derivatives by (a, b, c) at the points: of shape functions, then of fields
        shape_tables = tables(solid.element, reference, 1)
        remanence_tables = tables(solid.remanence_element, reference, 1)
        slopes_of_X = np.einsum("dnmk,nki->dnmi", shape_tables[1:], solid.X[cells])
        remanence = np.einsum("dnmk,nki->dnmi", remanence_tables, solid.remanence[cells])
        # a charge is the sum of factors (4, n, m, 3) times the remanence and its derivatives
        weights_in_boxes = np.prod(boxes.size, axis=1)[:, None] * weights
        factors = self.remanence_factors(boxes, slopes_of_X, weights_in_boxes)
        place = np.einsum("nmk,nki->nmi", shape_tables[0], self._nodes[cells])
        q = np.sum(factors * remanence, axis=(0, -1))
        if nodal_derivatives is None:
            return PointCharges(place[:, :, None], q[..., None])

        def add_derivatives(on_x: Array, on_q: Array) -> None:
            """Add a number's derivatives by nodal values to `nodal_derivatives`.

            `on_x` and `on_q` are its derivatives by places and sizes of the charges. The undeformed
            place is fixed.
            """
            np.add.at(
                nodal_derivatives.by_u,
                cells,
                np.einsum("nmk,nmi->nki", shape_tables[0], on_x[:, :, 0]),
            )
            np.add.at(
                nodal_derivatives.by_remanence,
                cells,
                np.einsum("dnmk,dnmi->nki", remanence_tables, factors * on_q),
            )

        return PointCharges(place[:, :, None], q[..., None], add_derivatives)


class CellFaces(SolidCharges):
    """Charges Br . N dA0 of cells' faces with outward normals N.

    The field `_faces` (count,) is the local number of each element's face in its cell.
    """

    def __init__(self, shape: MagnetisedSolid, cells: Ints, faces: Ints) -> None:
        super().__init__(shape, cells)
        self._faces = faces

    def reference(self, boxes: Boxes, x: Array) -> Array:
        return places_on_faces(self._faces[boxes.elements], boxes.points(x))

    def remanence_factors(self, boxes: Boxes, X: Array, weights: Array) -> Array:
        """Return the factors (4, n, m, 3) of Br, and of its derivatives, in the charges.

        That of Br is the outward area vector times the weight; those of its derivatives are zero.
        Arguments are those of the base class: X are derivatives of undeformed places.
        """
        faces, factors = self._faces[boxes.elements], np.zeros((4, *X.shape[1:]))
        # derivatives of undeformed places along both coordinates of the face
        tangent_a, tangent_b = (
            np.einsum("nd,dnmi->nmi", FACE_TANGENTS[faces, side], X) for side in range(2)
        )
        factors[0] = (OUTWARD_SIGNS[faces][:, None] * weights)[..., None] * np.cross(
            tangent_a, tangent_b
        )
        return factors


class CellInteriors(SolidCharges):
    """Charges -Div Br dV0 in cells."""

    dimension: ClassVar[int] = 3

    def reference(self, boxes: Boxes, x: Array) -> Array:
        return boxes.points(x)

    def remanence_factors(self, boxes: Boxes, X: Array, weights: Array) -> Array:
        """Return the factors (4, n, m, 3) of Br, which is zero, and of its derivatives.

        -Div Br dV0 has minus the cofactors of dX/d(a, b, c) times weights: the volume element
        cancels the determinant in the inverse of this matrix. Arguments are those of the base
        class: X are derivatives of undeformed places.
        """
        factors, density = np.zeros((4, *X.shape[1:])), -weights[..., None]
        for d in range(3):
            factors[1 + d] = density * np.cross(X[(d + 1) % 3], X[(d + 2) % 3])
        return factors


class ChargeLayers(ChargedElements):
    """Charges of cell interiors, as layers across the third coordinate.

    Unlike charges in a volume they can be divided into triangles.
    """

    def __init__(self, inside: CellInteriors) -> None:
        self._inside, self.count, self.shape = inside, inside.count, inside.shape

    def charges_at(
        self,
        boxes: Boxes,
        x: Array,
        weights: Array,
        nodal_derivatives: NodalDerivatives | None = None,
    ) -> PointCharges:
        """Return the charges of cells' interiors, in `GAUSS_LAYERS` layers, without derivatives.

        The points x (m, 2) of the n boxes are repeated at the height of each layer: the result has
        the shape (n, m, layers). `nodal_derivatives` is not used.
        """
        heights, weights_through = gauss(GAUSS_LAYERS)
        # boxes of (a, b) become boxes of (a, b, c) through the whole thickness
        zero, one = np.zeros((len(boxes.elements), 1)), np.ones((len(boxes.elements), 1))
        boxes_in_solid = Boxes(
            boxes.elements, np.hstack([boxes.low, zero]), np.hstack([boxes.size, one])
        )
        # all points at the first height, then all at the second one, and so on
        points = np.concatenate([np.column_stack([x, np.full(len(x), c)]) for c in heights])
        weights_of_points = np.concatenate([w * weights for w in weights_through])
        charges = self._inside.charges_at(boxes_in_solid, points, weights_of_points)
        # layers become the last index of the charges
        shape = (len(boxes.elements), GAUSS_LAYERS, len(x))
        places = charges.x.reshape(*shape, 3).swapaxes(1, 2)
        return PointCharges(places, charges.q.reshape(shape).swapaxes(1, 2))


def on_surfaces(families: Sequence[ChargedElements]) -> list[ChargedElements]:
    """Return charges on surfaces: those in cell interiors become layers."""
    return [
        ChargeLayers(family) if isinstance(family, CellInteriors) else family for family in families
    ]


def places_on_faces(faces: Ints, ab: Array) -> Array:
    """Return places (n, m, 3) on the reference cube of coordinates ab (n, m, 2) of faces (n,)."""
    return np.asarray(FACE_ORIGINS[faces][:, None] + ab @ FACE_TANGENTS[faces])


def cells_with_varying_remanence(shape: MagnetisedSolid) -> Ints:
    """Return the numbers of the cells in which the remanence varies by more than rounding."""
    spread = np.abs(shape.remanence - shape.remanence[:, :1]).max(axis=(1, 2), initial=0.0)
    return np.flatnonzero(spread > UNIFORMITY_TOLERANCE * np.abs(shape.remanence).max(initial=0.0))
