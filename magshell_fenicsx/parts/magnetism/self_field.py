"""The own field of a model's shell: what sensors read, its derivatives, its moment, and its export
to magpylib.
"""

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import Image, rotation
from magshell_fenicsx.models.shell.patterns import Uniform, pattern_field, places
from magshell_fenicsx.models.shell.strains import TangentFrame
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.charges import (
    Faces,
    Family,
    Sides,
    field,
    gradient,
    moment,
    triangles,
)
from magshell_fenicsx.parts.magnetism.fields import MU_0
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.magnetism.magnetised_cells import Nodal, Shape
from magshell_fenicsx.parts.seen import Sight

Array = NDArray[np.float64]
JUMP = 1e-6  # of the remanence between two cells, relative
AXIS = 1e-9  # over R
STEP = 1e-4  # of differences of fourth order
CENTRAL = ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12))


def magnetised(loads: Loads) -> Magnetisation | None:
    """What is magnetised, in a field or without; None if nothing is."""
    return loads.magnetic or loads.remanence


class OwnField:
    """The charges of a model's shell; those of a solid are of `self_field_of_solid`.

    Parameters
    ----------
    sight
        The model; its system has the displacement and the amplitudes that are asked about.

    Attributes
    ----------
    magnetised
        What is magnetised.
    edges
        Cells of this rank and their local edges that may be charged.
    """

    def __init__(self, sight: Sight) -> None:
        of = magnetised(sight.loads)
        assert of
        self._sight, self._model, self.magnetised = sight, sight.model, of
        V = sight.model.r0.function_space
        topology = V.mesh.topology
        self._dim = topology.dim
        self._owned = topology.index_map(self._dim).size_local
        self._pattern = of.remanent if callable(of.remanent) else Uniform(np.asarray(of.remanent))
        self.Br = self._given()
        self._plain = of.law == "deformation" and of.soft is None
        if not self._plain:
            self._at = self._element()
        self.edges = self._sides()
        self._sign = self._parity()

    def _given(self) -> fem.Function:
        """The remanence at nodes."""
        return pattern_field(self._pattern, self._model.r0)[0]

    def _places(self) -> tuple[Array, Array]:
        """Places and normals at the nodes of cells."""
        return places(self._model.r0)

    def _element(self) -> Any:
        """That in which what is not plain is interpolated."""
        return self._model.carrier.discontinuous(3).element.basix_element  # type: ignore[attr-defined]  # of thin models

    def families(self, mu: Mapping[str, float], *, may: bool = False) -> tuple[Any, list[Family]]:
        """The shape and its charges at the displacement that the system has; `may`: of any other
        remanence.
        """
        shape = self.shape(mu)
        cells, edges = self.chargeable if may else self.edges
        faces = Faces(shape, np.arange(self._owned), may=may)
        return shape, [faces, *([Sides(shape, cells, edges)] if len(cells) else [])]

    @cached_property
    def chargeable(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """As `edges`, all that any remanence may charge."""
        return self._sides(every=True)

    def B(self, families: Sequence[Family], mu: Mapping[str, float], places: Array) -> Array:
        """The field (n, 3) at places (n, 3), of a remanence of length one; nan in the shell;
        collective.
        """
        total = np.zeros_like(places)
        for image in self._images:
            relative_to, sign = image.apply_inverse(places), self.sign_of_images(mu) if image.sign < 0 else 1.0
            total[self._holds(families, relative_to)] = np.nan
            out = ~np.isnan(total[:, 0])
            total[out] += sign * field(families, relative_to[out]) @ image.Q.T
        return np.asarray(self._model.system.comm.allreduce(total))

    def _holds(self, families: Sequence[Family], places: Array) -> NDArray[np.bool_]:
        """Which of places (n, 3) are in what is modelled on this rank."""
        faces = families[0]
        assert isinstance(faces, Faces)
        return faces.holds(places)

    def flat(self, families: Sequence[Family]) -> Sequence[Family]:
        """The same charges on surfaces."""
        return families

    def slope(self, mu: Mapping[str, float], x: Array, e: Array) -> Nodal:
        """The derivatives of e .

        B at this rank's nodes, by the displacement and by the remanence.
        """
        parts = list[Nodal]()
        for may in (
            (False, True) if self._plain else (True,)
        ):  # charges that are zero have derivatives
            shape, families = self.families(mu, may=may)
            into = Nodal(np.zeros_like(shape.u), np.zeros_like(shape.remanence))
            for image in self._images:
                sign = self.sign_of_images(mu) if image.sign < 0 else 1.0
                gradient(families, image.apply_inverse(x), sign * image.Q.T @ e, into)
            parts.append(into)
        into = Nodal(parts[0].by_u, parts[-1].by_remanence)
        return into if self._plain else self._to_material(into, mu)

    def moment(self, mu: Mapping[str, float]) -> Array:
        """The integral of what is magnetised over the volume, remanent and induced, (3,) over R³;
        collective.
        """
        total = np.asarray(self._model.system.comm.allreduce(self._moment(mu)))
        if mirror := self._sight.mirror:
            total = mirror.sum_over_images(total, self.sign_of_images(mu))
        return total

    def _moment(self, mu: Mapping[str, float]) -> Array:
        """Of this rank's part of what is modelled."""
        return moment(self.families(mu)[1])

    @property
    def _images(self) -> list[Image]:
        """Those of what is modelled, which make the whole shell."""
        mirror = self._sight.mirror
        return mirror.images if mirror else [Image(np.eye(3), np.zeros(3), 1.0)]

    def shape(self, mu: Mapping[str, float]) -> Any:
        """Its shape and remanence at the displacement that the system has."""
        model, V = self._model, self._model.r0.function_space
        element, nodes, size = V.element.basix_element, V.dofmap.list[: self._owned], V.dofmap.bs
        r0, u = (f.x.array.reshape(-1, size)[nodes] for f in (model.r0, model.system.u))
        thick, factor = None, model.thickness
        if factor is not None:
            T = factor.function_space
            thick = T.element.basix_element, factor.x.array[T.dofmap.list[: self._owned]]
        if self._plain:
            Q = self.Br.function_space
            of, B = Q.element.basix_element, self._nodal()
            return Shape(element, r0, u, of, B, model.material.h, thick, size == 2, self._thins)
        Beff = self._material(self._jets(r0), self._jets(u), mu)
        return Shape(
            element, r0, u, self._at, Beff, model.material.h, thick, size == 2, self._thins
        )

    @property
    def _thins(self) -> Array | float:
        """Of this rank's cells, see `Shape.thins`."""
        thins = self._model.law_of_cells.thins
        return np.asarray(thins)[: self._owned] if np.ndim(thins) else thins

    def _nodal(self, cells: int | None = None) -> Array:
        """The remanence at the nodes of cells."""
        Q = self.Br.function_space
        return np.asarray(
            self.Br.x.array.reshape(-1, 3)[Q.dofmap.list[: self._owned if cells is None else cells]]
        )

    def _jets(self, nodal: Array) -> Array:
        """(derivatives, cells, nodes, 3) of a field at the nodes of what is taken back to the
        undeformed shell.
        """
        V = self._model.r0.function_space
        T = V.element.basix_element.tabulate(1, self._at.points)[..., 0]
        jets = np.einsum("dmk,nki->dnmi", T, nodal)
        if self._dim > 1:
            return np.asarray(jets)
        zero = np.zeros(jets.shape[1:3])
        parts = [(f[..., 0], zero, f[..., 1]) for f in jets] + [(zero, jets[0][..., 0], zero)]
        return np.stack([np.stack(part, axis=-1) for part in parts])

    def _material(self, r0: Array, u: Array, mu: Mapping[str, float]) -> Array:
        """F^-1 of the polarisation per undeformed volume, (cells, nodes, 3), over |Br|."""
        frame, of = TangentFrame.of(np.concatenate([r0, 0 * r0])), self.magnetised
        n = frame.normal(u)
        J = np.zeros_like(n)
        if not (of.soft and of.soft.alone):
            Q = self.Br.function_space
            T = Q.element.basix_element.tabulate(0, self._at.points)[0, :, :, 0]
            Br = np.einsum("mk,nki->nmi", T, self._nodal())
            J = (
                frame.convected(Br, u, thins=self._thins)
                if of.law == "deformation"
                else frame.rotated(Br, u)
            )
        if of.soft:
            B = of.at(mu, r0[0] + u[0])
            J = J + of.soft.scale**2 * of.soft.polarisation(r0[0], frame.n0, n, B)
        r1, r2 = r0[1] + u[1], r0[2] + u[2]
        m = np.cross(r1, r2)
        area = np.sum(m * n, axis=-1, keepdims=True)
        first, second = (
            np.sum(each * J, axis=-1, keepdims=True) / area
            for each in (np.cross(r2, n), np.cross(n, r1))
        )
        across = np.sum(n * J, axis=-1, keepdims=True)
        if np.any(self._thins):  # over the stretch of the thickness
            across = across * (
                1 + np.asarray(self._thins)[..., None] * (area / frame.area[..., None] - 1)
            )
        return np.asarray(first * r0[1] + second * r0[2] + across * frame.n0)

    def _to_material(self, into: Nodal, mu: Mapping[str, float]) -> Nodal:
        """Derivatives by what is magnetised taken on to the displacement and to the remanence."""
        V, model = self._model.r0.function_space, self._model
        nodes, size = V.dofmap.list[: self._owned], V.dofmap.bs
        r0, u = (self._jets(f.x.array.reshape(-1, size)[nodes]) for f in (model.r0, model.system.u))
        on = np.zeros_like(u)
        for d in range(len(u)):
            for i in range(3):
                for way, weight in CENTRAL:
                    moved = u.copy()
                    moved[d, ..., i] += way * STEP
                    on[d, ..., i] += (
                        weight
                        / STEP
                        * np.sum(into.by_remanence * self._material(r0, moved, mu), axis=-1)
                    )
        T = V.element.basix_element.tabulate(1, self._at.points)[..., 0]
        if self._dim == 1:
            flat = on[:2][..., [0, 2]]
            flat[0][..., 0] += on[2][..., 1]
            on = flat
        by_u = into.by_u + np.einsum("dmk,dnmi->nki", T, on)
        Q = self.Br.function_space
        TB = Q.element.basix_element.tabulate(0, self._at.points)[0, :, :, 0]
        Br, by_B = np.array(self.Br.x.array), np.zeros_like(self._nodal())
        for i in range(3):
            self.Br.x.array[:] = Br
            zero = np.sum(into.by_remanence * self._material(r0, u, mu), axis=-1)
            self.Br.x.array.reshape(-1, 3)[:, i] += 1.0
            change = np.sum(into.by_remanence * self._material(r0, u, mu), axis=-1) - zero
            by_B[..., i] = np.einsum("mk,nm->nk", TB, change)
        self.Br.x.array[:] = Br
        return Nodal(by_u, by_B)

    def _sides(self, *, every: bool = False) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Own cells and their local edges at the boundary, and where the remanence jumps, or
        `every` one.

        None on a mirror plane.
        """
        V = self._model.r0.function_space
        mesh = V.mesh
        topology, dim = mesh.topology, self._dim
        topology.create_connectivity(dim - 1, dim)
        topology.create_connectivity(dim, dim - 1)
        to_cells, to_facets = (
            topology.connectivity(dim - 1, dim),
            topology.connectivity(dim, dim - 1),
        )
        at = to_facets.array.reshape(-1, dim + 1)
        several = np.diff(to_cells.offsets)
        values = self._nodal(len(at))
        largest = np.abs(values).max(initial=0.0) or 1.0
        ends = self._ends(len(at), values)
        cells, edges = list[int](), list[int]()
        cut = {int(facet) for facet in self._model.mirrored_facets}
        for cell in range(self._owned):
            for local, facet in enumerate(at[cell]):
                if facet in cut:
                    continue
                if several[facet] == 1:
                    cells.append(cell)
                    edges.append(local)
                    continue
                other = next(int(c) for c in to_cells.links(facet) if c != cell)
                its_edge = int(np.flatnonzero(at[other] == facet)[0])
                if (
                    every
                    or not self._plain
                    or np.abs(ends[cell, local] - ends[other, its_edge]).max() > JUMP * largest
                ):
                    cells.append(cell)
                    edges.append(local)
        sides = np.array(cells, dtype=np.intp), np.array(edges, dtype=np.intp)
        if dim == 2:
            return sides
        X = np.array([[0.0], [1.0]])  # a pole has no edge: local facets of an interval are its ends
        T = V.element.basix_element.tabulate(0, X)[0, :, :, 0]
        rho = np.einsum(
            "mk,nk->nm", T, self._model.r0.x.array.reshape(-1, 2)[V.dofmap.list][..., 0]
        )
        off = np.abs(rho[sides]) > AXIS
        return sides[0][off], sides[1][off]

    def _ends(self, count: int, values: Array) -> Array:
        """The remanence in the middle of each local edge, (cells, edges, 3)."""
        middles = (
            np.array([[0.5, 0.5], [0.0, 0.5], [0.5, 0.0]])
            if self._dim == 2
            else np.array([[0.0], [1.0]])
        )
        T = self.Br.function_space.element.basix_element.tabulate(0, middles)[0, :, :, 0]
        return np.asarray(np.einsum("mk,nki->nmi", T, values[:count]))

    def sign_of_images(self, mu: Mapping[str, float]) -> float:
        """1 if the mirror images of what is magnetised continue it, -1 if their opposites do."""
        sign = self._sign
        if sign == 0.0 and self._sight.loads.magnetic and self._sight.mirror:
            shown = {**mu, "lambda_m": mu.get("lambda_m", 0.0) or 1.0}
            return self._sight.loads.magnetic.sign_of_images(
                shown, self._sight.model.r0, self._sight.mirror
            )
        return sign

    def _parity(self) -> float:
        """1 if the mirror images of the remanence continue it, -1 if their opposites do;
        collective.
        """
        if self._sight.mirror is None:
            return 1.0
        x, n = (each[: self._owned] for each in self._places())
        S, pattern = self._sight.mirror.reflection, self._pattern
        images = pattern(self._sight.mirror.image(x), n @ S) @ S
        return float(
            np.sign(self._model.system.comm.allreduce(float(np.sum(images * pattern(x, n)))))
        )


def magnetic_moment(sight: Sight, mu: Mapping[str, float]) -> Array:
    """The integral of the remanence and of what a field induces, as they are carried, (3,) over R³;
    collective.

    In the frame of the model, at the displacement that its system has.
    """
    return own_field(sight).moment(mu)


def own_field(sight: Sight) -> OwnField:
    """That of a model, which keeps it until another remanence takes the place of its own."""
    model, of = sight.model, magnetised(sight.loads)
    own = model.kept.get(OwnField)
    if own is None or own.magnetised is not of:
        if sight.model.r0.function_space.mesh.topology.dim == 3:
            from magshell_fenicsx.parts.magnetism.self_field_of_solid import (
                OwnFieldOfBody,
            )  # it is an own field

            own = OwnFieldOfBody(sight)
        else:
            own = OwnField(sight)
        model.kept[OwnField] = own
    return own


def to_magpylib(sight: Sight, state: State, parts: int = 8) -> Any:
    """The body of a state as a source of magpylib, of charged triangles, in m and T; without units
    over R and |Br|.

    Parameters
    ----------
    parts
        Into how many parts each side of a cell is divided.

    Raises
    ------
    CaseError
        If nothing is magnetised, or magpylib is missing.
    """
    from magshell_fenicsx.parts.magnetism.sources.source import magpylib

    of = magnetised(sight.loads)
    if of is None:
        raise CaseError(
            "to_magpylib: of a shell with a remanence or a susceptibility, this has neither"
        )
    made, own, mirror = magpylib("to_magpylib"), own_field(sight), sight.mirror
    Q, R = rotation(sight.azimuth), of.metres or 1.0

    def present() -> list[tuple[Array, Array]]:
        _, families = own.families(state.mu)
        all_charged = [each for family in own.flat(families) for each in triangles(family, parts)]
        if mirror:
            sign = own.sign_of_images(state.mu)
            copies = [(image, sign if image.sign < 0 else 1.0) for image in mirror.images]
            all_charged = [
                (image.apply(x), factor * q) for image, factor in copies for x, q in all_charged
            ]
        return all_charged

    system = sight.model.system
    all_charged = [
        each for rank in system.comm.allgather(system.at_state(state).evaluate(present)) for each in rank
    ]
    corners, charges = (np.concatenate([each[i] for each in all_charged]) for i in range(2))
    corners = R * corners @ Q
    m = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    J = (of.tesla * R**2 * charges / np.sum(m * m, axis=-1))[:, None] * m

    def total(field: str, observers: Array) -> Array:
        """Of all triangles; magpylib asks for B or H."""
        B = np.zeros((len(observers), 3))
        for i, x in enumerate(observers):
            seen = np.broadcast_to(x, (len(J), 3))
            B[i] = made.core.triangle_Bfield(observers=seen, vertices=corners, polarizations=J).sum(
                axis=0
            )
        return np.asarray(B / MU_0 if field == "H" else B)

    return made.misc.CustomSource(field_func=total)
