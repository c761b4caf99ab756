"""The own field of a magnetised solid, from the charges of its cells."""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import basix
import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.mesh.hexahedra import QUADRATURE_DEGREE
from magshell_fenicsx.models.shell.patterns import field_in_body, places_in_body
from magshell_fenicsx.parts.magnetism.charges import Family
from magshell_fenicsx.parts.magnetism.charges_of_solid import (
    Body,
    CellFaces,
    Inside,
    flat,
    on_faces,
    uneven,
)
from magshell_fenicsx.parts.magnetism.magnetised_cells import unit
from magshell_fenicsx.parts.magnetism.self_field import JUMP, OwnField

Array = NDArray[np.float64]
Sides = tuple[NDArray[np.intp], NDArray[np.intp]]
FINER = 1  # degree of what turns or is induced above that of the displacement
LOOKED = np.array(
    [[0.5, 0.5], [0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]
)  # where two cells meet


class OwnFieldOfBody(OwnField):
    """The charges of a solid; `edges` are own cells and the faces of them that are charged."""

    def _given(self) -> fem.Function:
        return field_in_body(self._pattern, self._model.r0.function_space)

    def _places(self) -> tuple[Array, Array]:
        return places_in_body(self._model.r0.function_space)

    def _element(self) -> Any:
        family, degree = (
            basix.ElementFamily.P,
            self._model.r0.function_space.element.basix_element.degree + FINER,
        )
        return basix.create_element(
            family, basix.CellType.hexahedron, degree, basix.LagrangeVariant.gll_warped
        )

    def families(self, mu: Mapping[str, float], *, may: bool = False) -> tuple[Body, list[Family]]:
        shape = self.shape(mu)
        cells = np.arange(self._owned) if may else uneven(shape)
        inside = [Inside(shape, cells)] if len(cells) else []
        return shape, [CellFaces(shape, *(self.chargeable if may else self.edges)), *inside]

    def shape(self, mu: Mapping[str, float]) -> Body:
        V = self._model.r0.function_space
        nodes = V.dofmap.list[: self._owned]
        X, u = (f.x.array.reshape(-1, 3)[nodes] for f in (self._model.r0, self._model.system.u))
        element = V.element.basix_element
        if self._plain:
            return Body(element, X, u, self.Br.function_space.element.basix_element, self._nodal())
        return Body(element, X, u, self._at, self._material(self._jets(X), self._jets(u), mu))

    def _holds(self, families: Sequence[Family], places: Array) -> NDArray[np.bool_]:
        faces = families[0]
        assert isinstance(faces, CellFaces)
        return faces.shape.holds(places)

    def flat(self, families: Sequence[Family]) -> Sequence[Family]:
        return flat(families)

    def _polarised(
        self, X: Array, u: Array, Br: Array, mu: Mapping[str, float]
    ) -> tuple[Array, Array]:
        """F, and the polarisation per undeformed volume, at points with jets (4, cells, points, 3)."""
        of = self.magnetised
        G, H = (np.moveaxis(jet[1:], 0, -1) for jet in (X, u))
        F, n0 = np.eye(3) + H @ np.linalg.inv(G), unit(np.cross(X[1], X[2]))
        J = np.zeros_like(n0)
        if not (of.soft and of.soft.alone):
            moved = F
            if of.law == "rotation":
                U, _, W = np.linalg.svd(F)
                moved = U @ W
            J = np.einsum("cqij,cqj->cqi", moved, Br)
        if of.soft:
            n = unit(np.asarray(np.linalg.solve(np.swapaxes(F, -1, -2), n0[..., None]))[..., 0])
            J = J + of.soft.scale**2 * of.soft.polarisation(X[0], n0, n, of.at(mu, X[0] + u[0]))
        return F, J

    def _material(self, r0: Array, u: Array, mu: Mapping[str, float]) -> Array:
        T = self.Br.function_space.element.basix_element.tabulate(0, self._at.points)[0, :, :, 0]
        F, J = self._polarised(r0, u, np.einsum("mk,nki->nmi", T, self._nodal()), mu)
        return np.asarray(np.linalg.solve(F, J[..., None])[..., 0])

    def _moment(self, mu: Mapping[str, float]) -> Array:
        V = self._model.r0.function_space
        points, weights = basix.make_quadrature(V.mesh.basix_cell(), QUADRATURE_DEGREE)
        T, TB = (
            f.element.basix_element.tabulate(1, points)[..., 0] for f in (V, self.Br.function_space)
        )
        nodes = V.dofmap.list[: self._owned]
        X, u = (
            np.einsum("dqk,cki->dcqi", T, f.x.array.reshape(-1, 3)[nodes])
            for f in (self._model.r0, self._model.system.u)
        )
        _, J = self._polarised(X, u, np.einsum("qk,cki->cqi", TB[0], self._nodal()), mu)
        volume = np.abs(np.linalg.det(np.moveaxis(X[1:], 0, -1))) * weights
        return np.asarray(np.einsum("cq,cqi->i", volume, J))

    @cached_property
    def chargeable(self) -> Sides:
        return self._sides(every=True)

    def _sides(self, *, every: bool = False) -> Sides:
        """Own cells and their local faces on the surface, and where the remanence jumps, or `every`
        one.

        None on a mirror plane.
        """
        V = self._model.r0.function_space
        topology = V.mesh.topology
        for pair in ((2, 3), (3, 2)):
            topology.create_connectivity(*pair)
        of_cells = topology.connectivity(3, 2).array.reshape(-1, 6)
        several = np.diff(topology.connectivity(2, 3).offsets)
        chosen = np.isin(of_cells, self._model.mirrored_facets, invert=True)
        if not every and self._plain:
            chosen &= (several[of_cells] == 1) | self._jumps(of_cells)
        cells, faces = np.nonzero(chosen[: self._owned])
        return cells, faces

    def _jumps(self, of_cells: NDArray[np.int32]) -> NDArray[np.bool_]:
        """(cells, 6) whether the remanence is another one beyond each face."""
        Q, V, values = (
            self.Br.function_space,
            self._model.r0.function_space,
            self._nodal(len(of_cells)),
        )
        at = on_faces(np.arange(6), np.broadcast_to(LOOKED, (6, *LOOKED.shape)))
        T, TB = (f.element.basix_element.tabulate(0, at.reshape(-1, 3))[0, :, :, 0] for f in (V, Q))
        X = np.einsum("mk,nki->nmi", T, self._model.r0.x.array.reshape(-1, 3)[V.dofmap.list])
        B = np.einsum("mk,nki->nmi", TB, values).reshape(-1, len(LOOKED), 3)
        X = X.reshape(-1, len(LOOKED), 3)
        order = np.argsort(of_cells.ravel(), kind="stable")
        same = np.flatnonzero(np.diff(of_cells.ravel()[order]) == 0)
        one, other = order[same], order[same + 1]
        matching = np.linalg.norm(X[one][:, :, None] - X[other][:, None], axis=-1).argmin(axis=2)
        beyond = np.take_along_axis(B[other], matching[..., None], axis=1)
        largest = np.abs(values).max(initial=0.0) or 1.0
        apart = np.abs(B[one] - beyond).max(axis=(1, 2), initial=0.0) > JUMP * largest
        jumps = np.zeros(of_cells.size, dtype=bool)
        jumps[one[apart]] = jumps[other[apart]] = True
        return jumps.reshape(of_cells.shape)
