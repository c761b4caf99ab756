"""The self-field of a model's shell: flux density, its derivatives, moment, and export to magpylib.

The model's remanence and what a field induces become charges (`charges`), at the displacement that
the model's system has. Fields are over the remanence's magnitude |Br|, lengths over R, in the frame
of the model. Theory: docs/theory.md, the field of a magnetised shell.

mu are the amplitudes (load parameters) of a state, by name. A remanence is convected if it moves
with F: then its charges stay with the material. What else there is, a rotated remanence or an
induced polarisation J, is taken back to the undeformed shell as F^-1 J. Families are the charged
elements of one kind: all faces, or strips along all charged edges. Images are the modelled cells
and their copies by mirrors and rotations, which together make the whole shell; a mirrored copy may
have opposite charges. A jet is a field with its derivatives by reference coordinates.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import Image, Mirror, rotation
from magshell_fenicsx.models.shell.spatial_fields import (
    Uniform,
    pattern_field,
    positions_and_normals,
)
from magshell_fenicsx.models.shell.strains import TangentFrame
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.charges import (
    ChargedElements,
    EdgeStrips,
    ShellFaces,
    field,
    gradient,
    moment,
    triangles,
)
from magshell_fenicsx.parts.magnetism.fields import FIELD, MU_0
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.magnetism.magnetised_cells import MagnetisedShell, NodalDerivatives
from magshell_fenicsx.parts.observables import ModelView

Array = NDArray[np.float64]
JUMP_TOLERANCE = 1e-6  # jump of the remanence between two cells, over the largest remanence
AXIS_TOLERANCE = 1e-9  # distance from the axis, over R
DIFFERENCE_STEP = 1e-4  # step of central differences of fourth order
# steps and weights of these differences
DIFFERENCE_WEIGHTS = ((-2, 1 / 12), (-1, -2 / 3), (1, 2 / 3), (2, -1 / 12))


def magnetisation_of(loads: Loads) -> Magnetisation | None:
    """Return the magnetisation of a model, in a field or without; None if it has none."""
    return loads.magnetic or loads.remanence


class SelfField:
    """Field of a model's shell; solids have `self_field_of_solid.SelfFieldOfSolid`.

    Fields are over |Br|. Amplitudes mu matter for induced magnetisation and for the sign of mirror
    images. Methods without "collective" take this rank's cells alone. Construction is collective.

    Parameters
    ----------
    view
        The model; its system has the displacement at which the field is asked for.

    Attributes
    ----------
    magnetisation
        The model's magnetisation.
    Br
        Its remanence at nodes.
    edges
        Cells of this rank and their local edges that are charged, or may be at some state.
    _sight
        The `view`.
    _pattern
        The remanence as a function of places and normals.
    _is_convected
        Whether the remanence moves with F and nothing is induced.
    _interpolation
        Element of a remanence that is not convected.
    _owned, _dim
        Number of this rank's cells, and their dimension: 1 on a meridian.
    _model
        The model of the view.
    _image_sign
        1 if mirror images continue the remanence, -1 if their opposites do, 0 if no remanence
        decides it.
    """

    def __init__(self, view: ModelView) -> None:
        """Find the charged edges of the model's remanence; collective."""
        magnetisation = magnetisation_of(view.loads)
        assert magnetisation
        self._sight, self._model, self.magnetisation = view, view.model, magnetisation
        V = view.model.r0.function_space
        topology = V.mesh.topology
        self._dim = topology.dim
        self._owned = topology.index_map(self._dim).size_local
        remanence = magnetisation.remanent
        self._pattern = remanence if callable(remanence) else Uniform(np.asarray(remanence))
        self.Br = self._remanence_function()
        self._is_convected = magnetisation.law == "deformation" and magnetisation.soft is None
        if not self._is_convected:
            self._interpolation = self._interpolation_element()
        self.edges = self._charged_sides()
        self._image_sign = self._parity()

    def _remanence_function(self) -> fem.Function:
        """Return the remanence at nodes."""
        return pattern_field(self._pattern, self._model.r0)[0]

    def _node_places(self) -> tuple[Array, Array]:
        """Return places and normals (cells, nodes, 3) at the nodes of cells."""
        return positions_and_normals(self._model.r0)

    def _interpolation_element(self) -> Any:
        """Return the element that interpolates a remanence that rotates or is induced."""
        # only thin models have a domain
        return self._model.domain.discontinuous(  # type: ignore[attr-defined]
            3
        ).element.basix_element

    def families(
        self, mu: Mapping[str, float], *, include_uncharged: bool = False
    ) -> tuple[Any, list[ChargedElements]]:
        """Return the magnetised cells and their charges at the system's displacement.

        The charges are families of charged elements: faces, then edges if there are any. With
        `include_uncharged`, elements that another remanence may charge are there too, as
        derivatives by the remanence need.
        """
        shape = self.shape(mu)
        cells, edges = self.chargeable if include_uncharged else self.edges
        faces = ShellFaces(shape, np.arange(self._owned), include_uncharged=include_uncharged)
        return shape, [faces, *([EdgeStrips(shape, cells, edges)] if len(cells) else [])]

    @cached_property
    def chargeable(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Cells of this rank and their local edges that some remanence may charge."""
        return self._charged_sides(include_all=True)

    def B(
        self, families: Sequence[ChargedElements], mu: Mapping[str, float], places: Array
    ) -> Array:
        """Return the flux density (n, 3) at places (n, 3) over R, nan in the shell; collective.

        `families` are those of `families`, on each rank its own cells.
        """
        total = np.zeros_like(places)
        for image in self._images:
            # only reflections (determinant -1) may have opposite charges
            sign = self.sign_of_images(mu) if image.sign < 0 else 1.0
            # the field of an image is the image of the field where it came from
            original_places = image.apply_inverse(places)
            total[self._contains(families, original_places)] = np.nan
            is_outside = ~np.isnan(total[:, 0])
            total[is_outside] += sign * field(families, original_places[is_outside]) @ image.Q.T
        return np.asarray(self._model.system.comm.allreduce(total))

    def _contains(self, families: Sequence[ChargedElements], places: Array) -> NDArray[np.bool_]:
        """Return a mask (n,) of places (n, 3) that are in the modelled cells of this rank."""
        faces = families[0]
        assert isinstance(faces, ShellFaces)
        return faces.contains(places)

    def surface_charges(self, families: Sequence[ChargedElements]) -> Sequence[ChargedElements]:
        """Return the same charges, all of them on surfaces; those of a shell are there already."""
        return families

    def derivatives(self, mu: Mapping[str, float], x: Array, e: Array) -> NodalDerivatives:
        """Return the derivatives of e . B(x) by displacement and remanence at this rank's nodes.

        `x` (3,) is a place over R and `e` (3,) a direction.
        """
        # Uncharged elements have derivatives by the remanence, too. A convected remanence takes two
        # runs: derivatives by u come from the first, without these elements, and those by the
        # remanence from the second. Otherwise one run with all elements gives both.
        derivatives_of_runs = list[NodalDerivatives]()
        for include_uncharged in (False, True) if self._is_convected else (True,):
            shape, families = self.families(mu, include_uncharged=include_uncharged)
            nodal_derivatives = NodalDerivatives(
                np.zeros_like(shape.u), np.zeros_like(shape.remanence)
            )
            for image in self._images:
                sign = self.sign_of_images(mu) if image.sign < 0 else 1.0
                # place and direction are taken back to the modelled cells
                gradient(families, image.apply_inverse(x), sign * image.Q.T @ e, nodal_derivatives)
            derivatives_of_runs.append(nodal_derivatives)
        first, last = derivatives_of_runs[0], derivatives_of_runs[-1]
        nodal_derivatives = NodalDerivatives(first.by_u, last.by_remanence)
        if self._is_convected:
            return nodal_derivatives
        # so far the remanence of the charges is F^-1 J, which depends on u and Br
        return self._to_material(nodal_derivatives, mu)

    def moment(self, mu: Mapping[str, float]) -> Array:
        """Return the magnetic moment, remanent and induced, (3,) over R³; collective."""
        total = np.asarray(self._model.system.comm.allreduce(self._moment(mu)))
        if mirror := self._sight.mirror:
            total = mirror.sum_over_images(total, self.sign_of_images(mu))
        return total

    def _moment(self, mu: Mapping[str, float]) -> Array:
        """Return the moment of this rank's modelled cells."""
        _, families = self.families(mu)
        return moment(families)

    @property
    def _images(self) -> list[Image]:
        """Images of the modelled cells that make the whole shell, the cells themselves first."""
        mirror = self._sight.mirror
        return mirror.images if mirror else [Image(np.eye(3), np.zeros(3), 1.0)]

    def shape(self, mu: Mapping[str, float]) -> Any:
        """Return the magnetised cells of this rank at the system's displacement.

        Their remanence is the field that stays with the material: the remanence itself if it is
        convected, else F^-1 J at the present displacement.
        """
        model, V = self._model, self._model.r0.function_space
        nodes, components = V.dofmap.list[: self._owned], V.dofmap.bs
        r0, u = (f.x.array.reshape(-1, components)[nodes] for f in (model.r0, model.system.u))
        thickness_factor, thickness = None, model.thickness
        if thickness is not None:
            space_of_thickness = thickness.function_space
            nodal_factors = thickness.x.array[space_of_thickness.dofmap.list[: self._owned]]
            thickness_factor = space_of_thickness.element.basix_element, nodal_factors
        if self._is_convected:
            remanence_element = self.Br.function_space.element.basix_element
            remanence = self._nodal_remanence()
        else:  # F^-1 J at the present displacement
            remanence_element = self._interpolation
            remanence = self._material(self._jets(r0), self._jets(u), mu)
        return MagnetisedShell(
            element=V.element.basix_element,
            r0=r0,
            u=u,
            remanence_element=remanence_element,
            remanence=remanence,
            h=model.material.h,
            thickness_factor=thickness_factor,
            swept=components == 2,  # a meridian, with (U, W)
            incompressible=self._incompressible,
        )

    @property
    def _incompressible(self) -> Array | float:
        """1 in this rank's cells (cells, 1) that keep their volume, else 0; or one for all."""
        thins = self._model.law_of_cells.thins
        return np.asarray(thins)[: self._owned] if np.ndim(thins) else thins

    def _nodal_remanence(self, cells: int | None = None) -> Array:
        """Return the remanence (cells, nodes, 3) at the nodes of the first `cells` cells.

        None stands for all own cells.
        """
        V = self.Br.function_space
        return np.asarray(
            self.Br.x.array.reshape(-1, 3)[V.dofmap.list[: self._owned if cells is None else cells]]
        )

    def _jets(self, nodal: Array) -> Array:
        """Return jets of a field at interpolation nodes, (1 + d, cells, nodes, 3).

        They are its value and its derivatives by the d reference coordinates. On a meridian d is 2,
        and the azimuth is the second coordinate. `nodal` (cells, nodes, components) are the field's
        nodal values.
        """
        V = self._model.r0.function_space
        T = V.element.basix_element.tabulate(1, self._interpolation.points)[..., 0]
        jets = np.einsum("dmk,nki->dnmi", T, nodal)
        if self._dim > 1:
            return np.asarray(jets)
        # e_rho, e_theta and e_z at the azimuth zero; d/dtheta of U e_rho + W e_z is U e_theta
        zero = np.zeros(jets.shape[1:3])
        components = [(f[..., 0], zero, f[..., 1]) for f in jets] + [(zero, jets[0][..., 0], zero)]
        return np.stack([np.stack(derivative, axis=-1) for derivative in components])

    def _material(self, r0: Array, u: Array, mu: Mapping[str, float]) -> Array:
        """Return F^-1 J (cells, nodes, 3), J the polarisation per undeformed volume over |Br|.

        Charges of this field stay with the material. `r0` and `u` are jets of placement and
        displacement at the interpolation nodes: values and derivatives by reference coordinates.
        """
        # the undeformed tangents and normals; the frame takes second derivatives too, which are not
        # used here: zeros stand for them
        frame = TangentFrame.from_jet(np.concatenate([r0, 0 * r0]))
        magnetisation = self.magnetisation
        n = frame.normal(u)
        J, soft = np.zeros_like(n), magnetisation.soft
        # the remanence at the interpolation nodes, moved with F or rotated; a soft magnet alone has
        # none
        if not (soft and soft.alone):
            space_of_Br = self.Br.function_space
            tables = space_of_Br.element.basix_element.tabulate(0, self._interpolation.points)
            T = tables[0, :, :, 0]
            Br = np.einsum("mk,nki->nmi", T, self._nodal_remanence())
            J = (
                frame.convected(Br, u, thins=self._incompressible)
                if magnetisation.law == "deformation"
                else frame.rotated(Br, u)
            )
        # what the applied field induces; scale² takes it from the unit mu0 E/|Br| of B to |Br|
        if soft:
            B = magnetisation.field_at(mu, r0[0] + u[0])
            J = J + soft.scale**2 * soft.polarisation(r0[0], frame.n0, n, B)
        r1, r2 = r0[1] + u[1], r0[2] + u[2]
        area_vector = np.cross(r1, r2)
        area = np.sum(area_vector * n, axis=-1, keepdims=True)
        # components of J along the deformed basis r1, r2, n
        along_r1, along_r2 = (
            np.sum(dual * J, axis=-1, keepdims=True) / area
            for dual in (np.cross(r2, n), np.cross(n, r1))
        )
        along_normal = np.sum(n * J, axis=-1, keepdims=True)
        # where the shell is incompressible, the normal component is divided by the thickness
        # stretch, which is the inverse of the area ratio
        if np.any(self._incompressible):
            is_incompressible = np.asarray(self._incompressible)[..., None]
            area_ratio = area / frame.area[..., None]
            along_normal = along_normal * (1 + is_incompressible * (area_ratio - 1))
        return np.asarray(along_r1 * r0[1] + along_r2 * r0[2] + along_normal * frame.n0)

    def _to_material(
        self, nodal_derivatives: NodalDerivatives, mu: Mapping[str, float]
    ) -> NodalDerivatives:
        """Return derivatives by displacement and remanence, from those by F^-1 J.

        F^-1 J is the polarisation that stays with the material. It depends on the displacement,
        by which the chain rule takes central differences of fourth order. It is affine in the
        remanence, so that a difference with a step of one is exact.

        Parameters
        ----------
        nodal_derivatives
            Derivatives by u at fixed F^-1 J, and `by_remanence` those by F^-1 J.
        mu
            Amplitudes of the applied field.
        """
        V, model = self._model.r0.function_space, self._model
        nodes, components = V.dofmap.list[: self._owned], V.dofmap.bs
        r0, u = (
            self._jets(f.x.array.reshape(-1, components)[nodes]) for f in (model.r0, model.system.u)
        )

        def result_at(u_jets: Array) -> Array:
            """Return the part of the result due to F^-1 J at each interpolation node."""
            material = self._material(r0, u_jets, mu)
            return np.asarray(np.sum(nodal_derivatives.by_remanence * material, axis=-1))

        by_jets = _differences_by_jets(result_at, u)
        # brought to the nodes of u by the transposed shape functions
        T = V.element.basix_element.tabulate(1, self._interpolation.points)[..., 0]
        # on a meridian du/dtheta = U e_theta: its component adds to that of U; see `_jets`
        if self._dim == 1:
            by_meridian = by_jets[:2][..., [0, 2]]
            by_meridian[0][..., 0] += by_jets[2][..., 1]
            by_jets = by_meridian
        by_u = nodal_derivatives.by_u + np.einsum("dmk,dnmi->nki", T, by_jets)
        return NodalDerivatives(by_u, self._changes_by_remanence(lambda: result_at(u)))

    def _changes_by_remanence(self, result: Callable[[], Array]) -> Array:
        """Return the changes (cells, nodes, 3) of a sum for one more in each component of Br.

        The sum is that of `result` (cells, interpolation nodes) for the present Br. Br is changed
        for a moment, and then set back.
        """
        # tables of Br's shape functions, transposed below: from interpolation nodes to nodes of Br
        space_of_Br = self.Br.function_space
        TB = space_of_Br.element.basix_element.tabulate(0, self._interpolation.points)[0, :, :, 0]
        present_Br, by_Br = np.array(self.Br.x.array), np.zeros_like(self._nodal_remanence())
        for i in range(3):
            self.Br.x.array[:] = present_Br
            value_before = result()
            self.Br.x.array.reshape(-1, 3)[:, i] += 1.0
            change = result() - value_before
            by_Br[..., i] = np.einsum("mk,nm->nk", TB, change)
        self.Br.x.array[:] = present_Br
        return by_Br

    def _charged_sides(
        self, *, include_all: bool = False
    ) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Return own cells and local edges that are charged, each (n,).

        Edges at the boundary are charged, and edges across which the remanence jumps. With
        `include_all`, or if the remanence is not convected, all edges are: a jump may come with the
        state. Edges on a mirror plane or at a pole are not charged.
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
        # numbers of the facets (edges, or ends on a meridian) of each cell, and how many cells each
        # facet has
        facets_of_cells = to_facets.array.reshape(-1, dim + 1)
        cell_counts = np.diff(to_cells.offsets)
        # the remanence of all cells, ghosts included, at nodes and in the middles of edges
        nodal_remanence = self._nodal_remanence(len(facets_of_cells))
        largest = np.abs(nodal_remanence).max(initial=0.0) or 1.0
        at_edges = self._remanence_at_edges(len(facets_of_cells), nodal_remanence)
        mirrored_facets = {int(facet) for facet in self._model.mirrored_facets}
        all_are_charged = include_all or not self._is_convected

        def is_charged(cell: int, local_edge: int) -> bool:
            """Return whether an edge of a cell is charged."""
            facet = facets_of_cells[cell, local_edge]
            if facet in mirrored_facets:
                return False
            if cell_counts[facet] == 1 or all_are_charged:  # one cell: at the boundary
                return True
            # the cell on the other side, and the number of the edge there
            neighbour = next(int(c) for c in to_cells.links(facet) if c != cell)
            edge_of_neighbour = int(np.flatnonzero(facets_of_cells[neighbour] == facet)[0])
            jump = at_edges[cell, local_edge] - at_edges[neighbour, edge_of_neighbour]
            return bool(np.abs(jump).max() > JUMP_TOLERANCE * largest)

        sides = [
            (cell, local_edge)
            for cell in range(self._owned)
            for local_edge in range(dim + 1)
            if is_charged(cell, local_edge)
        ]
        cells = np.array([cell for cell, _ in sides], dtype=np.intp)
        edges = np.array([local_edge for _, local_edge in sides], dtype=np.intp)
        if dim == 2:
            return cells, edges
        # an end of a meridian on the axis is a pole, and no edge
        is_off_axis = np.abs(self._radii_of_ends()[cells, edges]) > AXIS_TOLERANCE
        return cells[is_off_axis], edges[is_off_axis]

    def _radii_of_ends(self) -> Array:
        """Return rho (cells, 2) at both ends of a meridian's cells, their local facets."""
        r0 = self._model.r0
        V = r0.function_space
        X = np.array([[0.0], [1.0]])
        T = V.element.basix_element.tabulate(0, X)[0, :, :, 0]
        nodal_rho = r0.x.array.reshape(-1, 2)[V.dofmap.list][..., 0]
        return np.asarray(np.einsum("mk,nk->nm", T, nodal_rho))

    def _remanence_at_edges(self, count: int, values: Array) -> Array:
        """Return the remanence in the middle of each local edge, (count, edges, 3).

        On a meridian, edges are ends of cells. `values` (cells, nodes, 3) are nodal; the first
        `count` cells are taken.
        """
        middles = np.array([[0.0], [1.0]])  # the two ends of an interval
        if self._dim == 2:  # the middles of a triangle's sides
            middles = np.array([[0.5, 0.5], [0.0, 0.5], [0.5, 0.0]])
        T = self.Br.function_space.element.basix_element.tabulate(0, middles)[0, :, :, 0]
        return np.asarray(np.einsum("mk,nki->nmi", T, values[:count]))

    def sign_of_images(self, mu: Mapping[str, float]) -> float:
        """Return 1 if mirror images continue the magnetisation, -1 if their opposites do.

        Where no remanence decides this, the applied field at amplitudes `mu` does; then the call is
        collective.
        """
        sign = self._image_sign
        if sign != 0.0:
            return sign
        magnetic, mirror = self._sight.loads.magnetic, self._sight.mirror
        if magnetic and mirror:
            # a field of amplitude zero has no sign; an amplitude of one has the same symmetry
            amplitudes = {**mu, FIELD.name: mu.get(FIELD.name, 0.0) or 1.0}
            return magnetic.sign_of_images(amplitudes, self._sight.model.r0, mirror)
        return sign

    def _parity(self) -> float:
        """Return 1 if mirror images continue the remanence, -1 if their opposites do; collective.

        0 if no remanence decides it, 1 without a mirror.
        """
        if self._sight.mirror is None:
            return 1.0
        x, n = (at_nodes[: self._owned] for at_nodes in self._node_places())
        S, pattern = self._sight.mirror.reflection, self._pattern
        # remanence at the mirror images of places, mirrored back; its product with that at the
        # places themselves is positive where images continue the remanence
        mirrored_back = pattern(self._sight.mirror.image(x), n @ S) @ S
        product = float(np.sum(mirrored_back * pattern(x, n)))
        return float(np.sign(self._model.system.comm.allreduce(product)))


def _differences_by_jets(f: Callable[[Array], Array], u: Array) -> Array:
    """Return derivatives (d, cells, nodes, 3) of a function by jets of the same shape.

    They are by the value (d = 0) and by the derivatives of u at each node, by central differences.

    Parameters
    ----------
    f
        Function of jets, whose value (cells, nodes) at a node depends on the jets there.
    u
        The jets at which derivatives are taken.
    """
    by_jets = np.zeros_like(u)
    for d in range(len(u)):
        for i in range(3):
            for steps, weight in DIFFERENCE_WEIGHTS:
                u_moved = u.copy()
                u_moved[d, ..., i] += steps * DIFFERENCE_STEP
                by_jets[d, ..., i] += weight / DIFFERENCE_STEP * f(u_moved)
    return by_jets


def magnetic_moment(view: ModelView, mu: Mapping[str, float]) -> Array:
    """Return the magnetic moment, remanent and induced, (3,) over R³; collective.

    It is in the frame of the model, at the displacement that its system has.
    """
    return self_field(view).moment(mu)


def self_field(view: ModelView) -> SelfField:
    """Return the self-field of a model, cached there until its magnetisation is replaced.

    The first call is collective.
    """
    model, magnetisation = view.model, magnetisation_of(view.loads)
    field_of_model = model.part_caches.get(SelfField)
    if field_of_model is None or field_of_model.magnetisation is not magnetisation:
        if view.model.r0.function_space.mesh.topology.dim == 3:
            # imported late: that class derives from `SelfField`
            from magshell_fenicsx.parts.magnetism.self_field_of_solid import SelfFieldOfSolid

            field_of_model = SelfFieldOfSolid(view)
        else:
            field_of_model = SelfField(view)
        model.part_caches[SelfField] = field_of_model
    return field_of_model


def to_magpylib(view: ModelView, state: State, parts: int = 8) -> Any:
    """Return the magnetised shell at a state as a source of magpylib; collective.

    The source is made of charged triangles. It is in m and T; in a case without units, over R and
    |Br|.

    Parameters
    ----------
    view
        The model and its frame.
    state
        Displacement and amplitudes.
    parts
        Number of parts into which each side of a cell is divided, for flat triangles.

    Raises
    ------
    CaseError
        If nothing is magnetised, or magpylib is missing.
    """
    from magshell_fenicsx.parts.magnetism.sources.source import magpylib

    magnetisation = magnetisation_of(view.loads)
    if magnetisation is None:
        raise CaseError(
            "to_magpylib: of a shell with a remanence or a susceptibility, this has neither"
        )
    module, field_of_model = magpylib("to_magpylib"), self_field(view)
    # from the model's frame, which a mirror plane may have turned, to that of the case; R in metres
    Q, R = rotation(view.azimuth), magnetisation.metres or 1.0
    # corners and charges of the triangles of all ranks at the state
    system = view.model.system
    on_rank = system.at_state(state).evaluate(
        lambda: _charged_triangles(field_of_model, view.mirror, state.mu, parts)
    )
    on_all_ranks = system.comm.allgather(on_rank)
    triangles_and_charges = [chunk for chunks in on_all_ranks for chunk in chunks]
    corners = np.concatenate([triangles for triangles, _ in triangles_and_charges])
    charges = np.concatenate([charges_of_chunk for _, charges_of_chunk in triangles_and_charges])
    corners = R * corners @ Q
    area_vectors = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    # a polarisation normal to a triangle gives it a charge per area of its size
    squared_areas = np.sum(area_vectors * area_vectors, axis=-1)
    J = (magnetisation.tesla * R**2 * charges / squared_areas)[:, None] * area_vectors

    def flux_density(field: str, observers: Array) -> Array:
        """Return B or H, whatever magpylib asks for, of all triangles at observers (n, 3)."""
        B = np.zeros((len(observers), 3))
        for i, x in enumerate(observers):
            observer = np.broadcast_to(x, (len(J), 3))
            field_of_triangles = module.core.triangle_Bfield(
                observers=observer, vertices=corners, polarizations=J
            )
            B[i] = field_of_triangles.sum(axis=0)
        return np.asarray(B / MU_0 if field == "H" else B)

    return module.misc.CustomSource(field_func=flux_density)


def _charged_triangles(
    field_of_model: SelfField, mirror: Mirror | None, mu: Mapping[str, float], parts: int
) -> list[tuple[Array, Array]]:
    """Return corners (n, 3, 3) over R and charges (n,) of this rank's triangles and their images.

    The list has a pair of arrays for each chunk of elements; `parts` is that of `to_magpylib`.
    """
    _, families = field_of_model.families(mu)
    triangles_and_charges = [
        chunk
        for family in field_of_model.surface_charges(families)
        for chunk in triangles(family, parts)
    ]
    if mirror:
        sign = field_of_model.sign_of_images(mu)
        copies = [(image, sign if image.sign < 0 else 1.0) for image in mirror.images]
        triangles_and_charges = [
            (image.apply(x), factor * q)
            for image, factor in copies
            for x, q in triangles_and_charges
        ]
    return triangles_and_charges
