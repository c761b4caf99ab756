"""The self-field of a magnetised solid, from the charges of its cells (`charges_of_solid`).

A remanence is convected if it moves with F: then its charges stay with the material. A rotated
remanence, or what a field induces, is taken back to the undeformed solid as F^-1 J, J the
polarisation per undeformed volume. Families are the charged elements of one kind: faces of cells,
then interiors, where the remanence varies. X is the undeformed place, u the displacement; a jet is
a field with its derivatives by reference coordinates. mu are the amplitudes (load parameters) by
name. Fields are over the remanence's magnitude |Br|, lengths over R.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import basix
import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.mesh.hexahedra import QUADRATURE_DEGREE
from magshell_fenicsx.models.shell.spatial_fields import body_positions_and_normals, field_in_body
from magshell_fenicsx.parts.magnetism.charges import ChargedElements
from magshell_fenicsx.parts.magnetism.charges_of_solid import (
    CellFaces,
    CellInteriors,
    MagnetisedSolid,
    cells_with_varying_remanence,
    on_surfaces,
    places_on_faces,
)
from magshell_fenicsx.parts.magnetism.magnetised_cells import unit
from magshell_fenicsx.parts.magnetism.self_field import JUMP_TOLERANCE, SelfField

Array = NDArray[np.float64]
CellsAndFaces = tuple[NDArray[np.intp], NDArray[np.intp]]
# degree of a remanence that rotates or is induced, above that of the displacement
DEGREE_INCREMENT = 1
# coordinates of a face at which the remanence of two cells is compared
FACE_SAMPLES = np.array([[0.5, 0.5], [0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]])


class SelfFieldOfSolid(SelfField):
    """Field of a model's solid, from charges of faces and interiors of cells.

    Methods have the contracts of `SelfField`. `edges` are own cells and their local faces that are
    charged. Private fields of the base class: `_owned` is the number of this rank's cells,
    `_is_convected` says whether the remanence moves with F and nothing is induced, and
    `_interpolation` is the element of F^-1 J if not. `_jets` gives the value and the reference
    derivatives of a nodal field at the points of that element.
    """

    def _remanence_function(self) -> fem.Function:
        """Return the remanence at nodes of the body."""
        return field_in_body(self._pattern, self._model.r0.function_space)

    def _node_places(self) -> tuple[Array, Array]:
        return body_positions_and_normals(self._model.r0.function_space)

    def _interpolation_element(self) -> Any:
        """Return the element that interpolates a remanence that rotates or is induced.

        Its degree is above the displacement's, since F^-1 J is no polynomial.
        """
        degree_of_u = self._model.r0.function_space.element.basix_element.degree
        return basix.create_element(
            basix.ElementFamily.P,
            basix.CellType.hexahedron,
            degree_of_u + DEGREE_INCREMENT,
            basix.LagrangeVariant.gll_warped,
        )

    def families(
        self, mu: Mapping[str, float], *, include_uncharged: bool = False
    ) -> tuple[MagnetisedSolid, list[ChargedElements]]:
        """Return the magnetised cells and their charges at the system's displacement.

        Charges are those of faces, then those of cells' interiors. With `include_uncharged`, all
        elements that another remanence may charge are there.
        """
        shape = self.shape(mu)
        # charges inside are -Div Br: only a remanence that varies has some
        cells = np.arange(self._owned) if include_uncharged else cells_with_varying_remanence(shape)
        inside = [CellInteriors(shape, cells)] if len(cells) else []
        cells_and_faces = self.chargeable if include_uncharged else self.edges
        return shape, [CellFaces(shape, *cells_and_faces), *inside]

    def shape(self, mu: Mapping[str, float]) -> MagnetisedSolid:
        """Return the magnetised cells of this rank at the system's displacement."""
        V = self._model.r0.function_space
        nodes = V.dofmap.list[: self._owned]
        X, u = (f.x.array.reshape(-1, 3)[nodes] for f in (self._model.r0, self._model.system.u))
        element = V.element.basix_element
        if self._is_convected:
            return MagnetisedSolid(
                element, X, u, self.Br.function_space.element.basix_element, self._nodal_remanence()
            )
        return MagnetisedSolid(
            element, X, u, self._interpolation, self._material(self._jets(X), self._jets(u), mu)
        )

    def _contains(self, families: Sequence[ChargedElements], places: Array) -> NDArray[np.bool_]:
        faces = families[0]
        assert isinstance(faces, CellFaces)
        return faces.shape.contains(places)

    def surface_charges(self, families: Sequence[ChargedElements]) -> Sequence[ChargedElements]:
        return on_surfaces(families)

    def _polarised(
        self, X: Array, u: Array, Br: Array, mu: Mapping[str, float]
    ) -> tuple[Array, Array]:
        """Return F and the polarisation J per undeformed volume over |Br|, at points of cells.

        F is (cells, points, 3, 3) and J (cells, points, 3).

        Parameters
        ----------
        X, u
            Jets (4, cells, points, 3) of undeformed places and displacements: value and reference
            derivatives.
        Br
            Remanence (cells, points, 3) there.
        mu
            Amplitudes of the applied field, which induces a part of J.
        """
        magnetisation = self.magnetisation
        # derivatives of places and displacements by reference coordinates, as columns; layers of
        # the solid are surfaces of the first two of these
        G, H = (np.moveaxis(jet[1:], 0, -1) for jet in (X, u))
        F, n0 = np.eye(3) + H @ np.linalg.inv(G), unit(np.cross(X[1], X[2]))
        J, soft = np.zeros_like(n0), magnetisation.soft
        # the remanence, moved with F or with its rotation; a soft magnet alone has none
        if not (soft and soft.alone):
            carrier = F
            if magnetisation.law == "rotation":
                # R of the polar decomposition
                U, _, W = np.linalg.svd(F)
                carrier = U @ W
            J = np.einsum("cqij,cqj->cqi", carrier, Br)
        # what the applied field induces
        if soft:
            # F^-T n0: the deformed normal of layers
            n = unit(np.asarray(np.linalg.solve(np.swapaxes(F, -1, -2), n0[..., None]))[..., 0])
            B = magnetisation.field_at(mu, X[0] + u[0])
            # scale²: from the unit mu0 E/|Br| of B to |Br|
            J = J + soft.scale**2 * soft.polarisation(X[0], n0, n, B)
        return F, J

    def _material(self, r0: Array, u: Array, mu: Mapping[str, float]) -> Array:
        """Return F^-1 J (cells, nodes, 3), the polarisation that stays with the material.

        `r0` and `u` are jets (4, cells, nodes, 3) of undeformed places and displacements at the
        interpolation nodes.
        """
        # the remanence at the interpolation nodes, then F and J there
        element = self.Br.function_space.element.basix_element
        T = element.tabulate(0, self._interpolation.points)[0, :, :, 0]
        Br = np.einsum("mk,nki->nmi", T, self._nodal_remanence())
        F, J = self._polarised(r0, u, Br, mu)
        return np.asarray(np.linalg.solve(F, J[..., None])[..., 0])

    def _moment(self, mu: Mapping[str, float]) -> Array:
        """Return the moment (3,) of this rank's modelled cells, over R³."""
        V = self._model.r0.function_space
        points, weights = basix.make_quadrature(V.mesh.basix_cell(), QUADRATURE_DEGREE)
        # shape functions of u and of Br with derivatives at the points; then jets of X and u there
        T, TB = (
            space.element.basix_element.tabulate(1, points)[..., 0]
            for space in (V, self.Br.function_space)
        )
        nodes = V.dofmap.list[: self._owned]
        X, u = (
            np.einsum("dqk,cki->dcqi", T, f.x.array.reshape(-1, 3)[nodes])
            for f in (self._model.r0, self._model.system.u)
        )
        Br = np.einsum("qk,cki->cqi", TB[0], self._nodal_remanence())
        _, J = self._polarised(X, u, Br, mu)
        # undeformed volume of each point; the moment is the integral of J over it
        volume = np.abs(np.linalg.det(np.moveaxis(X[1:], 0, -1))) * weights
        return np.asarray(np.einsum("cq,cqi->i", volume, J))

    @cached_property
    def chargeable(self) -> CellsAndFaces:
        return self._charged_sides(include_all=True)

    def _charged_sides(self, *, include_all: bool = False) -> CellsAndFaces:
        """Return own cells and local faces that are charged, each (n,).

        Faces on the surface are charged, and faces across which the remanence jumps. With
        `include_all`, or if the remanence is not convected, all faces are: a jump may come with the
        state. Faces on a mirror plane are not charged.
        """
        V = self._model.r0.function_space
        topology = V.mesh.topology
        for dimensions in ((2, 3), (3, 2)):
            topology.create_connectivity(*dimensions)
        facets_of_cells = topology.connectivity(3, 2).array.reshape(-1, 6)
        cell_counts = np.diff(topology.connectivity(2, 3).offsets)  # of each facet
        is_charged = np.isin(facets_of_cells, self._model.mirrored_facets, invert=True)
        if not include_all and self._is_convected:
            is_on_surface = cell_counts[facets_of_cells] == 1
            is_charged &= is_on_surface | self._jumps(facets_of_cells)
        cells, faces = np.nonzero(is_charged[: self._owned])
        return cells, faces

    def _jumps(self, facets_of_cells: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Return a mask (cells, 6) of faces across which the remanence jumps.

        `facets_of_cells` (cells, 6) are the mesh's numbers of the cells' faces, ghosts included.
        Both cells of a face are compared at the five places of `FACE_SAMPLES`.
        """
        space_of_Br, V = self.Br.function_space, self._model.r0.function_space
        nodal_remanence = self._nodal_remanence(len(facets_of_cells))
        # places X and remanence B at the samples of all faces of all cells: (faces, samples, 3)
        coordinates = np.broadcast_to(FACE_SAMPLES, (6, *FACE_SAMPLES.shape))
        samples = places_on_faces(np.arange(6), coordinates).reshape(-1, 3)
        T, TB = (
            space.element.basix_element.tabulate(0, samples)[0, :, :, 0]
            for space in (V, space_of_Br)
        )
        nodal_places = self._model.r0.x.array.reshape(-1, 3)[V.dofmap.list]
        X = np.einsum("mk,nki->nmi", T, nodal_places).reshape(-1, len(FACE_SAMPLES), 3)
        B = np.einsum("mk,nki->nmi", TB, nodal_remanence).reshape(-1, len(FACE_SAMPLES), 3)
        # an inner face is there twice, with one facet number: as a side of both its cells
        facets = facets_of_cells.ravel()
        order = np.argsort(facets, kind="stable")
        pairs = np.flatnonzero(np.diff(facets[order]) == 0)
        sides, sides_of_neighbours = order[pairs], order[pairs + 1]
        # two cells have their samples of a common face in different orders: match nearest ones
        separations = X[sides][:, :, None] - X[sides_of_neighbours][:, None]
        matching = np.linalg.norm(separations, axis=-1).argmin(axis=2)
        B_of_neighbours = np.take_along_axis(B[sides_of_neighbours], matching[..., None], axis=1)
        largest = np.abs(nodal_remanence).max(initial=0.0) or 1.0
        jump = np.abs(B[sides] - B_of_neighbours).max(axis=(1, 2), initial=0.0)
        differs = jump > JUMP_TOLERANCE * largest
        jumps = np.zeros(facets_of_cells.size, dtype=bool)
        jumps[sides[differs]] = jumps[sides_of_neighbours[differs]] = True
        return jumps.reshape(facets_of_cells.shape)
