"""Contact where a half or a sector is modelled: its points face the cells of all images too.

Images move as the model does, with their matrices Q: the unknowns of all copies are u' = P u. The
points on the modelled cells have their part of the energy, Pi(u'), so that the forces are
P^T Pi,u' and the tangent is P^T Pi,u'u' P. Of additions v that are antisymmetric to a plane the
mirrored half has -Q v.

Images or copies are the modelled part and its mirrored or turned copies, which make the whole
surface. Node n of copy k has the number k count + n. Each copy has nodes of its own, but copies
share vertices on planes of symmetry. Pi is the energy of the points on the modelled cells, r0 are
undeformed places, u displacements.
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
from magshell_fenicsx.parts.contact.contact_section import Pair
from magshell_fenicsx.parts.contact.projection import Cells, Longs
from magshell_fenicsx.parts.contact.surface_contact import SurfaceContact, SurfaceContactGeometry

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
SAME_PLACE_TOLERANCE = 1e-9  # over the extent: images of a vertex nearer than that are one


@dataclass(frozen=True)
class Images:
    """The copies of a half or a sector that make the whole; the first is the model.

    Nodes and cells of the copies are numbered one copy after the other.

    Attributes
    ----------
    images
        The copies, each with its matrix Q (3, 3) and a sign that is negative if it is mirrored.
    count
        Number of nodes of the model.
    parity
        Factor of the displacement of mirrored copies: 1, or -1 of an antisymmetric one.
    """

    images: Sequence[Image]
    count: int
    parity: float = 1.0

    @cached_property
    def matrix(self) -> scipy.sparse.csr_array:
        """The sparse matrix P (3 copies count, 3 count): displacements of all copies are P u."""
        # the displacement of each copy is a matrix (3, 3) times that of the model at each node
        matrices = [image.Q * (self.parity if image.sign < 0 else 1.0) for image in self.images]
        identity = scipy.sparse.eye_array(self.count)
        return scipy.sparse.vstack([scipy.sparse.kron(identity, Q) for Q in matrices]).tocsr()

    def displacements(self, u: Array) -> Array:
        """Return the displacements (copies count, 3) of all copies for u (count, 3)."""
        return np.asarray((self.matrix @ u.ravel()).reshape(-1, 3))

    def places(self, r0: Array) -> Array:
        """Return the undeformed places (copies count, 3) of all copies for r0 (count, 3)."""
        return np.concatenate([image.apply(r0) for image in self.images])

    def repeat(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values of the model's cells, repeated for all copies."""
        return np.concatenate([values] * len(self.images))

    def cells(self, cells: Cells, r0: Array, vertices_on_planes: Longs) -> Cells:
        """Return the cells of all copies, which share the vertices on planes of symmetry.

        Nodes are not shared.

        Parameters
        ----------
        cells
            Cells of the model.
        r0
            (count, 3) undeformed places of its nodes.
        vertices_on_planes
            Numbers of the vertices on planes of symmetry.
        """
        x = np.zeros((int(cells.corners.max()) + 1, 3))  # of vertices, from their cells' nodes
        x[cells.corners] = cells.at_corners @ r0[cells.nodes]
        vertex_numbers = self.shared_numbers(x, vertices_on_planes)
        return Cells(
            cells.element,
            np.concatenate([cells.nodes + k * self.count for k in range(len(self.images))]),
            np.concatenate([numbers_of_copy[cells.corners] for numbers_of_copy in vertex_numbers]),
        )

    def shared_numbers(self, x: Array, on_planes: Longs) -> Longs:
        """Return numbers (copies, n) of all images of places x (n, 3), one where images coincide.

        Parameters
        ----------
        on_planes
            Rows of the places that are on planes of symmetry; only these may coincide.
        """
        images = [image.apply(x[on_planes]) for image in self.images]
        tolerance = SAME_PLACE_TOLERANCE * np.ptp(x, axis=0).max()
        # at first place i of copy k has the number k n + i
        numbers = np.arange(len(self.images) * len(x)).reshape(-1, len(x))
        for k, places in enumerate(images):
            # where several images coincide, each has the number of the first: the earlier copies
            # are compared from the last to the first, so that the first one's number stays
            for earlier in range(k - 1, -1, -1):
                is_same = np.linalg.norm(places - images[earlier], axis=1) < tolerance
                numbers[k, on_planes[is_same]] = numbers[earlier, on_planes[is_same]]
        return numbers

    def sum_forces(self, forces: Array) -> Array:
        """Return the forces P^T f (3 count,) on the model for forces f on all copies."""
        return np.asarray(self.matrix.T @ forces)

    def sum_entries(self, entries: Entries) -> Entries:
        """Return the entries of P^T K P, the model's tangent, for those of K of all copies."""
        rows, columns, values = entries
        size = self.matrix.shape[0]
        K = scipy.sparse.coo_array((values, (rows, columns)), (size, size)).tocsr()
        i, j, v = scipy.sparse.find(self.matrix.T @ K @ self.matrix)
        return i.astype(np.int64), j.astype(np.int64), v


class ContactWithImages(SurfaceContact):
    """The contact of a pair of which a half or a sector is modelled.

    Parameters
    ----------
    images
        The copies that make the whole.
    modelled_dofs
        Number of the first degree of freedom of this rank in the model, and how many it has.
    pair
        The two members, with the stiffness of their penalty.
    geometry
        The cells and nodes of all copies. All degrees of freedom of the copies count as those of
        this rank, since forces are first summed over all of them.
    sides
        (cells,) flags of the cells of the first member of the pair, and of the second.

    The field `_images` moves the copies as the state does, and `_images_of_changes` as changes of
    the state do, which may be antisymmetric to the plane.
    """

    def __init__(
        self,
        images: Images,
        modelled_dofs: tuple[int, int],
        pair: Pair,
        geometry: SurfaceContactGeometry,
        sides: tuple[Flags, Flags],
    ) -> None:
        """Prepare the contact of all copies as if they were modelled."""
        super().__init__(pair, geometry, sides)
        self._images, self._modelled_dofs = images, modelled_dofs
        self._images_of_changes = images

    def antisymmetric(self) -> "ContactWithImages":
        """Return this term for changes of u that are antisymmetric to the plane.

        The state itself stays symmetric.
        """
        # the search and the active set are those of the symmetric state: only P differs
        antisymmetric_term = copy(self)
        antisymmetric_term._images_of_changes = replace(self._images, parity=-1.0)
        return antisymmetric_term

    def _add(self, b: Array, forces: Array) -> None:
        """Add P^T f, for forces f on all copies, to the vector b of this rank; collective."""
        of_copies = np.zeros(self._images.matrix.shape[0])  # (3 copies count,)
        super()._add(of_copies, forces)
        start, size = self._modelled_dofs
        b[:size] += self._images_of_changes.sum_forces(of_copies)[start : start + size]

    def entries(self) -> Entries:
        """Return the entries of the model's tangent, from those of all copies; collective."""
        return self._images_of_changes.sum_entries(super().entries())

    def coupled_pairs(self) -> tuple[Longs, Longs]:
        """Return pairs of the model's nodes between which the tangent may have entries; collective.

        A pair of copies' nodes couples the nodes of the model of which they are copies.
        """
        rows, columns = super().coupled_pairs()
        return rows % self._images.count, columns % self._images.count

    def _of_copies(self, u: Array) -> Array:
        """Return the displacement (copies count, 3) of all copies for that of the model."""
        return self._images.displacements(u)

    def _in_modelled(self, values: Array) -> Array:
        """Return derivatives by values in modelled cells, from those by values in all cells.

        A value of the model is that of all copies of its cell, so derivatives are added.
        """
        copies = len(self._images.images)
        return np.asarray(values.reshape(copies, -1, values.shape[1]).sum(axis=0))

    def _on_modelled(self, forces: Array) -> Array:
        """Return the forces (count, 3) on the model's nodes, from those on all copies."""
        return self._images.sum_forces(forces.ravel()).reshape(-1, 3)
