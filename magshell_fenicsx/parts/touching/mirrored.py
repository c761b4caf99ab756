"""Contact where a half or a sector is modelled: its points face the cells of all images too.

Images move as the model does, with their matrices Q: the unknowns of all are u' = P u. The points
on the modelled cells have their part of the energy, Pi(u'), so that the forces are P^T Pi,u' and
the tangent is P^T Pi,u'u' P. Of additions v that are antisymmetric to a plane the mirrored half has
-Q v.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from magshell_fenicsx.assembly.nonlocal_terms import Entries
from magshell_fenicsx.mesh.mirror import Image
from magshell_fenicsx.parts.touching.nearest import Cells, Longs
from magshell_fenicsx.parts.touching.touching import Touching

Array = NDArray[np.float64]
CLOSE = 1e-9  # of the extent: images of a vertex that are one


@dataclass(frozen=True)
class Images:
    """The copies that make the whole, numbered one after the other; the first is what is modelled.

    Attributes
    ----------
    count
        Of the nodes that are modelled.
    parity
        Mirrored copies have so many times the image of a displacement: 1, or -1 of antisymmetric
        ones.
    """

    images: Sequence[Image]
    count: int
    parity: float = 1.0

    @cached_property
    def matrix(self) -> scipy.sparse.csr_array:
        """P (3 copies count, 3 count)."""
        turns = [image.Q * (self.parity if image.sign < 0 else 1.0) for image in self.images]
        return scipy.sparse.vstack(
            [scipy.sparse.kron(scipy.sparse.eye_array(self.count), Q) for Q in turns]
        ).tocsr()

    def moved(self, u: Array) -> Array:
        """Displacements (copies count, 3) of those (count, 3) that are modelled."""
        return np.asarray((self.matrix @ u.ravel()).reshape(-1, 3))

    def placed(self, r0: Array) -> Array:
        """Places (copies count, 3) of all nodes."""
        return np.concatenate([image.apply(r0) for image in self.images])

    def each(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values of cells, of all copies."""
        return np.concatenate([values] * len(self.images))

    def cells(self, cells: Cells, r0: Array, on_planes: Longs) -> Cells:
        """The cells of all copies, which share the vertices on their planes.

        Parameters
        ----------
        r0
            (count, 3) undeformed.
        on_planes
            Numbers of these vertices.
        """
        x = np.zeros((int(cells.corners.max()) + 1, 3))
        x[cells.corners] = cells.at_corners @ r0[cells.nodes]
        numbers = self.shared(x, on_planes)
        return Cells(
            cells.element,
            np.concatenate([cells.nodes + k * self.count for k in range(len(self.images))]),
            np.concatenate([number[cells.corners] for number in numbers]),
        )

    def shared(self, x: Array, on_planes: Longs) -> Longs:
        """Numbers (copies, n) of the places (n, 3) of all copies, which share those on their
        planes.
        """
        images, extent = (
            [image.apply(x[on_planes]) for image in self.images],
            np.ptp(x, axis=0).max(),
        )
        numbers = np.arange(len(self.images) * len(x)).reshape(-1, len(x))
        for k, places in enumerate(images):
            for before in range(k - 1, -1, -1):
                same = np.linalg.norm(places - images[before], axis=1) < CLOSE * extent
                numbers[k, on_planes[same]] = numbers[before, on_planes[same]]
        return numbers

    def forces(self, whole: Array) -> Array:
        """Those (3 count,) on what is modelled, of forces on all copies."""
        return np.asarray(self.matrix.T @ whole)

    def entries(self, whole: Entries) -> Entries:
        """Those of a tangent of what is modelled, of one of all copies."""
        rows, columns, values = whole
        size = self.matrix.shape[0]
        K = (
            self.matrix.T
            @ scipy.sparse.coo_array((values, (rows, columns)), (size, size)).tocsr()
            @ self.matrix
        )
        i, j, v = scipy.sparse.find(K)
        return i.astype(np.int64), j.astype(np.int64), v


class Mirrored(Touching):
    """The contact of a pair of which a half or a sector is modelled.

    Parameters
    ----------
    part
        Number of the first degree of freedom of this rank, and how many it has.
    given
        What a `Touching` asks for, with the cells and nodes of all copies; its own are all of their
        unknowns.
    """

    def __init__(self, images: Images, part: tuple[int, int], *given: Any) -> None:
        super().__init__(*given)
        self._images, self._part = images, part

    def antisymmetric(self) -> "Mirrored":
        """The same term for additions to u that are antisymmetric to the plane, at a symmetric
        state.
        """
        other = copy(self)
        other._images = replace(self._images, parity=-1.0)
        return other

    def _add(self, b: Array, forces: Array) -> None:
        whole = np.zeros(self._images.matrix.shape[0])
        super()._add(whole, forces)
        start, size = self._part
        b[:size] += self._images.forces(whole)[start : start + size]

    def entries(self) -> Entries:
        return self._images.entries(super().entries())

    def coupled_pairs(self) -> tuple[Longs, Longs]:
        rows, columns = super().coupled_pairs()
        return rows % self._images.count, columns % self._images.count

    def _of_copies(self, u: Array) -> Array:
        return self._images.moved(u)

    def _in_modelled(self, values: Array) -> Array:
        return np.asarray(values.reshape(len(self._images.images), -1, values.shape[1]).sum(axis=0))

    def _on_modelled(self, forces: Array) -> Array:
        return self._images.forces(forces.ravel()).reshape(-1, 3)
