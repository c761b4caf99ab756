"""Control points: a field as a weighted mean of values at points, without a mesh.

Designs vary these values, and measured points give them.

- B is the field, a vector at each place; places are over R.
- A pattern is a function of undeformed places r0 and normals n0 that gives vectors.
- An axisymmetric field turns about e3: its points have rho and z, its values are along e_rho and
  e_z.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

Array = NDArray[np.float64]
MIN_RELATIVE_WEIGHT = 1e-10  # weights below it, relative to the largest, are left out
FIRST_NEIGHBOURS = 32  # points that are searched first


@dataclass(frozen=True)
class ControlPoints:
    """Control points, over R: each place has the mean of their values, weighted by distance.

        B(x) = sum_i w_i(x) B_i,    w_i ~ exp(-|x - x_i|^2/l^2),    sum_i w_i = 1

    The width l is the filter length of a design: nothing varies over less. B is linear in the
    values, it has no mesh, and as a mean it is nowhere longer than the longest of them.

    Attributes
    ----------
    places
        (n, 3); or (n, 2) of rho and z, of a field that turns with the azimuth about e3.
    width
        l.
    """

    places: Array
    width: float

    @property
    def is_axisymmetric(self) -> bool:
        """Whether the field turns about e3."""
        return self.places.shape[1] == 2

    def weights(self, x: Array) -> "scipy.sparse.csr_matrix":
        """Return the weights w (m, n) of the n points at places x (m, 3), as a sparse matrix.

        The neighbours of each place are searched until all further weights are negligible. Far from
        all points the nearest one counts alone.
        """
        if self.is_axisymmetric:
            places = np.column_stack([np.hypot(x[:, 0], x[:, 1]), x[:, 2]])
        else:
            places = x
        tree, count = scipy.spatial.cKDTree(self.places), len(self.places)
        neighbour_count = min(FIRST_NEIGHBOURS, count)
        while True:
            # distances and numbers (m, neighbours) of the points, the nearest first
            distance, number = (
                v.reshape(len(places), neighbour_count) for v in tree.query(places, neighbour_count)
            )
            # relative to the nearest point, so that weights do not underflow far away
            w = np.exp((distance[:, :1] ** 2 - distance**2) / self.width**2)
            largest_last_weight = w[:, -1].max(initial=0.0)
            if neighbour_count == count or largest_last_weight < MIN_RELATIVE_WEIGHT:
                break
            neighbour_count = min(2 * neighbour_count, count)
        w /= w.sum(axis=1, keepdims=True)
        rows = np.repeat(np.arange(len(places)), neighbour_count)
        return scipy.sparse.csr_matrix(
            (w.ravel(), (rows, number.ravel())), shape=(len(places), count)
        )


@dataclass(frozen=True)
class ControlledPattern:
    """A pattern of vectors, from values at control points.

    Attributes
    ----------
    controls
        The points.
    values
        (n, 3) vectors at the points; (n, 2) along e_rho and e_z if the field turns about e3.
    frame
        (3, 3) axes of the points' frame in that of the model, as columns; None for the model's own
        frame.
    """

    controls: ControlPoints
    values: Array
    frame: Array | None = None

    def __call__(self, r0: Array, n0: Array) -> Array:
        """Return the vectors at undeformed places r0 (..., 3); normals n0 are not used."""
        # in the frame of the points
        x = np.asarray(r0.reshape(-1, 3))
        x = x if self.frame is None else x @ self.frame
        vectors: Array = np.asarray(self.controls.weights(x) @ self.values)
        if self.controls.is_axisymmetric:
            rho = np.maximum(np.hypot(x[:, 0], x[:, 1]), 1e-300)[:, None]  # not zero on the axis
            vectors = np.column_stack([vectors[:, :1] * x[:, :2] / rho, vectors[:, 1]])
        return np.asarray(vectors if self.frame is None else vectors @ self.frame.T).reshape(
            r0.shape
        )

    def transposed(self, r0: Array, forces: Array) -> Array:
        """Return the derivatives of a number by the values at the points, in the shape of `values`.

        `forces` (cells, nodes, 3) are the number's derivatives by B at places `r0` (cells, nodes,
        3). So the transpose of the map from values to B is applied, for gradients of designs.
        """
        x, f = np.asarray(r0.reshape(-1, 3)), np.asarray(forces.reshape(-1, 3))
        if self.frame is not None:
            x, f = x @ self.frame, f @ self.frame
        if self.controls.is_axisymmetric:
            rho = np.maximum(np.hypot(x[:, 0], x[:, 1]), 1e-300)[:, None]
            f = np.column_stack([np.sum(f[:, :2] * x[:, :2] / rho, axis=1), f[:, 2]])
        return np.asarray(self.controls.weights(x).T @ f)
