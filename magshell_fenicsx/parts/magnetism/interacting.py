"""Magnetised parts of a shell in each other's field: the term of its energy.

The energy couples all nodes, so the second derivative is dense: near blocks and multipoles
(`multipole_expansion.InteractionHessian`). Theory: docs/theory.md, parts in each other's field.
"""

from collections import deque
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from magshell_fenicsx.assembly.dense_tangent import BlockProducts
from magshell_fenicsx.assembly.global_mesh import (
    GlobalCells,
    component_numbers,
    gather_rows,
    global_values,
)
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.magnetism.charge_derivatives import Weights
from magshell_fenicsx.parts.magnetism.corotated_stiffness import BlockRotation
from magshell_fenicsx.parts.magnetism.coulomb import InteractingCharges, PartsTooNear
from magshell_fenicsx.parts.magnetism.force_extrapolation import ForceExtrapolation
from magshell_fenicsx.parts.magnetism.interaction import AMPLITUDE, Interaction
from magshell_fenicsx.parts.magnetism.magnetised_cells import MagnetisedShell, unit
from magshell_fenicsx.parts.magnetism.multipole_expansion import CellNodes, InteractionHessian
from magshell_fenicsx.parts.magnetism.pairs import NO_IMAGES, Copies, Stiffness
from magshell_fenicsx.parts.magnetism.self_field import self_field
from magshell_fenicsx.parts.magnetism.singular_pairs import SingularPairs
from magshell_fenicsx.parts.observables import ModelView

if TYPE_CHECKING:
    from magshell_fenicsx.shells.model_base import ModelBase

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
MAX_REMEMBERED_STATES = (
    3  # energies and forces: a point of a path is looked at again after its tangent
)
IMAGE_TOLERANCE = 1e-7  # between a node on a mirror plane and its image, over R
MAX_UNKNOWNS = 9000  # a matrix of 650 MB where the sum is factored
TOO_NEAR = (
    "magnetic.interaction: undeformed, two parts are nearer to each other than their thickness, "
    "or than a seventh of the size of their cells: move them apart, or take smaller cells"
)


def polar(F: Array) -> Array:
    """Return the rotations (n, 3, 3) nearest to matrices F (n, 3, 3)."""
    U, _, V = np.linalg.svd(F)
    # a determinant of -1 is a reflection, where an iterate has turned a cell inside out
    U[:, :, 2] *= np.linalg.det(U @ V)[:, None]
    return np.asarray(U @ V)


class InteractionTerm:
    """Energy over E h R² of the parts of a model in each other's field, and in their own.

    It is multiplied by the amplitude `interaction`.

    Raises
    ------
    CaseError
        If the model is too large.
    """

    group, column = "magnetic", "magnetic"

    def __init__(self, model: "ModelBase", u: fem.Function, interaction: Interaction) -> None:
        self.name = self.amplitude = AMPLITUDE
        self._acts_on_itself = interaction.itself
        self._model, self._u = model, u
        self._scale = interaction.strength / (4 * np.pi * model.material.h)
        V = u.function_space
        self._comm: MPI.Comm = V.mesh.comm
        self._cells = GlobalCells.gather(V)
        self._even_term: InteractionTerm | None = None  # of an antisymmetric one the other
        unknowns = 3 * V.dofmap.index_map.size_global
        if unknowns > MAX_UNKNOWNS:
            raise CaseError(
                f"magnetic.interaction: the model has {unknowns} unknowns; as all of them act on "
                f"each other, at most {MAX_UNKNOWNS} are allowed: take a coarser mesh or a lower "
                "mesh.degree"
            )
        self._inputs_of_charges: tuple[Array, ...] = ()
        self._evaluations = deque[tuple[Array, float, Array]](maxlen=MAX_REMEMBERED_STATES)
        self._blocks, self._turning = BlockProducts(self._comm), BlockRotation(self._comm)
        self._extrapolation = ForceExtrapolation(
            self._blocks, self._rotations, is_single_rank=self._comm.size == 1
        )
        self._latest_hessians: (
            tuple[Array, tuple[InteractionHessian, InteractionHessian], Array] | None
        ) = None  # beside its nodes and u

    @property
    def no_number(self) -> str:
        """Explanation for the user where the energy is not a number."""
        if self._model.shell_contacts:
            return (
                " (parts are in each other, or too near for the size of their cells: take smaller "
                "ones)"
            )
        return (
            " (parts touch or nearly do, and magnetism does not keep them apart: name them in "
            "contact)"
        )

    def antisymmetric(self) -> "InteractionTerm":
        """Return the same term for additions to u that are opposite in the images."""
        odd_term = copy(self)
        odd_term._even_term = self
        return odd_term

    def refuse_near(self) -> None:
        """Refuse a single part, or undeformed parts that are too near each other; collective.

        Raises
        ------
        CaseError
            On every rank, for such parts.
        """
        if not self._acts_on_itself and self._part_of_cells.max() == 0:
            raise CaseError(
                "magnetic.interaction: others: acts between shells that no joint connects, or "
                "parts of a mesh file, and here all is one part: take interaction: all"
            )
        is_near = False
        try:
            nodes = self._nodes()  # first: the charges are made of what it gathers
            self._charges.rules(nodes, self._cells.own_range)
        except PartsTooNear:
            is_near = True
        if self._comm.allreduce(is_near, MPI.LOR):
            raise CaseError(TOO_NEAR)

    def energy(self) -> float:
        return self._evaluated()[0]

    def compile_residual(self) -> None:
        """A sum over pairs of charges."""

    def add_residual(self, b: Array, factor: float) -> None:
        b += factor * self._evaluated()[1]

    def add_extrapolated_residual(self, b: Array, factor: float) -> None:
        """Add the residual of extrapolated forces, see `assembly.dense_tangent.DenseTerm`."""
        self._nodes()  # what is known is forgotten if shape or remanence changed
        extrapolated = (
            self._extrapolation.forces(
                global_values(self._u).ravel(),
                self._latest_hessians[1][0],
                self._latest_hessians[2],
            )
            if self._latest_hessians
            else None
        )
        b += factor * (self._evaluated()[1] if extrapolated is None else extrapolated)

    def extrapolation_holds_along(self, step: Array) -> bool:
        """Return whether forces are known along a step, see `assembly.dense_tangent.DenseTerm`."""
        self._nodes()
        displacement, index_map = global_values(self._u), self._u.function_space.dofmap.index_map
        step_of_rank = step.reshape(-1, 3)[: index_map.size_local]
        return self._extrapolation.extrapolation_holds_along(
            displacement.ravel(), np.concatenate(self._comm.allgather(step_of_rank)).ravel()
        )

    def compile_tangent(self) -> None:
        """A sum over pairs of charges."""

    def add_tangent(self, K: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """Nodes far apart act on each other; see `acting`."""

    def hessian(self, *, inexact: bool = False) -> "InteractionHessian":
        """Return the second derivative, see `assembly.dense_tangent.DenseTerm`; collective."""
        return (
            self._even_term.even_and_odd_hessians(inexact=inexact)[1]
            if self._even_term
            else self.even_and_odd_hessians(inexact=inexact)[0]
        )

    def even_and_odd_hessians(
        self, *, inexact: bool
    ) -> tuple["InteractionHessian", "InteractionHessian"]:
        """Return the second derivative by u, and that by odd additions to u; collective.

        Odd additions are opposite in the images.
        """
        nodes = self._nodes()
        if self._latest_hessians is None or not (
            inexact or np.array_equal(nodes, self._latest_hessians[0])
        ):
            self._latest_hessians = None  # two are not kept at once
            self._latest_hessians = nodes, self._hessians_at(nodes), global_values(self._u).ravel()
        return self._latest_hessians[1]

    def by_field(
        self, name: str, direction: fem.Function, energy: float, force: float
    ) -> tuple[fem.Function, Array] | None:
        """Return derivatives by remanence, thickness or placement; collective.

        See `assembly.nonlocal_terms.FieldDifferentiable`.
        """
        field_of_model, of_shape = self_field(self._view), name in ("thickness", "r0")
        nodes, rates = self._nodes(), global_values(direction)[self._cells.nodes]
        rates_of_copies = np.concatenate([rates @ image.Q.T for image in self._copies.images])
        weights, own_cells = (
            Weights(self._scale * energy, self._scale * force),
            self._cells.own_range,
        )
        part = slice(own_cells.start, own_cells.stop)
        if of_shape:
            into = self._charges.field_derivatives(
                nodes, rates_of_copies, own_cells, weights, of_shape=True
            )
            by_place, by_thickness = (
                self._comm.allreduce(derivative)[part]
                for derivative in (into.by_place, into.by_thickness)
            )
            if name == "thickness":
                assert self._model.thickness
                return self._model.thickness, np.asarray(by_thickness[..., None])
            return self._model.r0, by_place + self._at_fixed_charges(direction, energy, force)
        if name != field_of_model.Br.name:
            return None
        shape, cells, edges = self._cells_and_charged_edges(include_uncharged=True)
        singular_pairs = SingularPairs(
            shape,
            self._corners,
            cells,
            edges,
            self._cells.own_range,
            self._comm,
            self._copies,
            include_uncharged=True,
        )
        charges = InteractingCharges(
            shape,
            self._part_of_cells,
            cells,
            edges,
            self._comm,
            singular_pairs if self._acts_on_itself else None,
            self._copies,
            include_uncharged=True,
        )
        by_remanence = charges.field_derivatives(
            nodes, rates_of_copies, own_cells, weights
        ).by_remanence
        return field_of_model.Br, np.asarray(self._comm.allreduce(by_remanence))[part]

    def _at_fixed_charges(self, direction: fem.Function, energy: float, force: float) -> Array:
        """Return derivatives by the placement of own cells' nodes at fixed charges; collective.

        A placement moves charges as a displacement does.
        """
        V, count = self._u.function_space, len(self._cells.own_range)
        D, v = self.hessian(), global_values(direction).ravel()
        of_nodes = energy * self._evaluated()[1] + force * (
            D.near_blocks @ v + D.times_far(v[:, None]).ravel()
        )
        nodes = V.dofmap.list[:count]
        cells_of_node = np.bincount(nodes.ravel(), minlength=len(of_nodes) // 3)
        return np.asarray((of_nodes.reshape(-1, 3) / np.maximum(cells_of_node, 1)[:, None])[nodes])

    def _hessians_at(self, nodes: Array) -> tuple["InteractionHessian", "InteractionHessian"]:
        own_cells, images, V = self._cells.own_range, self._copies.images, self._u.function_space
        count, has_images = V.dofmap.index_map.size_global, len(images) > 1
        column_of = np.tile(self._cells.nodes, (len(images), 1)).astype(np.int64)
        column_of[len(self._cells.nodes) :] += count  # those of images are apart
        row_of = np.full(column_of.shape, -1)
        row_of[own_cells.start : own_cells.stop] = V.dofmap.list[: len(own_cells)]
        turn = np.stack([image.Q for image in images])
        local = V.dofmap.index_map.size_local + V.dofmap.index_map.num_ghosts
        multipoles, near_cells = self._charges.boxes(nodes, own_cells)
        has_block, adjacent = (
            np.zeros((local, count), dtype=bool),
            np.zeros((count, count), dtype=bool),
        )
        for pattern, row_numbers, pairs in (
            (has_block, row_of, near_cells),
            (adjacent, self._cells.nodes, multipoles.adjacent_cells(own_cells)),
        ):
            for cell, row in zip(own_cells, pairs, strict=True):
                columns = np.unique(column_of[np.append(np.flatnonzero(row), cell)] % count)
                pattern[row_numbers[cell][:, None], columns] = True
        self._comm.Allreduce(
            MPI.IN_PLACE, adjacent, MPI.LOR
        )  # the same blocks on any number of ranks
        stiffness = Stiffness(has_block, self._scale, row_of, column_of, turn)
        try:
            self._charges.evaluate(nodes, own_cells, stiffness)
        except PartsTooNear:
            stiffness.blocks[:] = np.nan
        numbers = V.dofmap.index_map.local_to_global(np.arange(local, dtype=np.int32))
        cells = CellNodes(
            self._cells.nodes, own_cells, row_of[own_cells.start : own_cells.stop], numbers, turn
        )
        B = multipoles.jacobian(multipoles.place_charges(nodes))
        even_hessian, odd_hessian = (
            InteractionHessian(
                stiffness,
                multipoles,
                B,
                self._scale,
                cells,
                sign,
                adjacent[numbers][has_block],
                self._turning,
            )
            for sign in ([1.0, -1.0] if has_images else [1.0, 1.0])
        )
        return even_hessian, odd_hessian

    def _evaluated(self) -> tuple[float, Array]:
        """Return the energy of this rank's cells and its gradient by local nodes; collective."""
        nodes, V = self._nodes(), self._u.function_space
        for nodes_before, energy, forces in self._evaluations:
            if np.array_equal(nodes, nodes_before):
                return energy, forces
        try:
            energy, gradient = self._charges.evaluate(nodes, self._cells.own_range)
        except PartsTooNear:  # there is no such equilibrium
            k = self._cells.nodes.shape[1]
            energy, gradient = np.nan, np.full((len(self._cells.own_range), k, 3), np.nan)
        forces = np.zeros_like(self._u.x.array)
        np.add.at(
            forces.reshape(-1, 3),
            V.dofmap.list[: len(self._cells.own_range)],
            self._scale * gradient,
        )
        self._evaluations.appendleft((nodes, self._scale * energy, forces))
        if self._comm.allreduce(bool(np.isfinite(energy)), MPI.LAND):
            self._extrapolation.add_state(global_values(self._u).ravel(), forces)
        return self._scale * energy, forces

    def _nodes(self) -> Array:
        """Return the deformed nodes (copies * cells, k, 3) of all cells; collective.

        Charges are computed again if placement, remanence or thickness changed.
        """
        r0, u = (global_values(f) for f in (self._model.r0, self._u))
        field_of_model = self_field(self._view)
        thickness, of_nodes = (
            self._model.thickness,
            field_of_model.Br.x.array.reshape(-1, 3)[field_of_model.Br.function_space.dofmap.list],
        )
        inputs: tuple[Array, ...] = (r0, self._cells.gather_values(of_nodes))
        if thickness is not None:
            inputs += (
                self._cells.gather_values(thickness.x.array[thickness.function_space.dofmap.list]),
            )
        if len(self._inputs_of_charges) != len(inputs) or not all(
            map(np.array_equal, inputs, self._inputs_of_charges)
        ):
            self._inputs_of_charges, self._latest_hessians = inputs, None
            self._evaluations.clear()
            self._extrapolation = ForceExtrapolation(
                self._blocks, self._rotations, is_single_rank=self._comm.size == 1
            )
            for name in ("_charges", "_singular_pairs"):
                self.__dict__.pop(name, None)
        return self._copies.nodes_of_all((r0 + u)[self._cells.nodes])

    def _rotations(self, u: Array, u_before: Array) -> Array:
        """Return the rotations of all nodes from one displacement to another.

        They are quaternions (nodes, 4), scalar last.
        """
        r0, nodes = global_values(self._model.r0), self._cells.nodes
        element = self._u.function_space.element.basix_element
        T = element.tabulate(1, element.points)[1:, :, :, 0]

        def frames(u: Array) -> Array:
            a1, a2 = np.einsum("dpk,cki->dcpi", T, (r0 + u.reshape(-1, 3))[nodes], optimize=True)
            return np.stack([a1, a2, unit(np.cross(a1, a2))], axis=-1)

        F = np.zeros((len(r0), 3, 3))
        np.add.at(F, nodes, frames(u) @ np.linalg.inv(frames(u_before)))
        return np.ascontiguousarray(Rotation.from_matrix(polar(F)).as_quat())

    @cached_property
    def _charges(self) -> InteractingCharges:
        shape, cells, edges = self._cells_and_charged_edges()
        return InteractingCharges(
            shape, self._part_of_cells, cells, edges, self._comm, self._singular_pairs, self._copies
        )

    @cached_property
    def _singular_pairs(self) -> SingularPairs | None:
        shape, cells, edges = self._cells_and_charged_edges()
        if not self._acts_on_itself:
            return None
        return SingularPairs(
            shape, self._corners, cells, edges, self._cells.own_range, self._comm, self._copies
        )

    def _cells_and_charged_edges(
        self, *, include_uncharged: bool = False
    ) -> tuple[MagnetisedShell, Ints, Ints]:
        """Return the cells of all ranks, and their charged edges by cell and number; collective.

        With `include_uncharged`, edges that another remanence may charge are there too.
        """
        field_of_model = self_field(self._view)
        shape, (cells, edges) = (
            field_of_model.shape({}),
            field_of_model.chargeable if include_uncharged else field_of_model.edges,
        )
        factor = shape.thickness_factor and (
            shape.thickness_factor[0],
            self._inputs_of_charges[2],
        )
        r0, remanence = self._inputs_of_charges[0][self._cells.nodes], self._inputs_of_charges[1]
        everywhere = MagnetisedShell(
            shape.element, r0, 0 * r0, shape.remanence_element, remanence, shape.h, factor
        )
        own_cells, comm = np.asarray(cells) + self._cells.own_range.start, self._comm
        return everywhere, gather_rows(comm, own_cells), gather_rows(comm, np.asarray(edges))

    @cached_property
    def _copies(self) -> Copies:
        """The modelled cells, and the images that make the whole of a half or a sector."""
        if self._model.multiplicity == 1:
            return NO_IMAGES
        field_of_model, mirror = self_field(self._view), self._view.mirror
        assert mirror
        return Copies(tuple(mirror.images), field_of_model.sign_of_images({}))

    @cached_property
    def _corners(self) -> Ints:
        """(copies * cells, 3) numbers of corners; collective.

        A corner on a mirror plane and its image have one number.
        """
        r0, corners = global_values(self._model.r0), self._cells.nodes[:, :3]
        places = self._copies.nodes_of_all(r0[None])
        numbers = np.arange(places[..., 0].size).reshape(len(places), -1)
        for later, x in enumerate(places):
            for earlier in range(later):
                is_shared = np.abs(x - places[earlier]).max(axis=1) < IMAGE_TOLERANCE
                numbers[later][is_shared] = numbers[earlier][is_shared]
        return np.concatenate([of_copy[corners] for of_copy in numbers])

    @cached_property
    def _part_of_cells(self) -> Ints:
        """(copies * cells,) the part of each cell; collective."""
        V, corners = self._u.function_space, self._corners
        if len(self._copies.images) == 1:
            return np.asarray(self._cells.gather_values(component_numbers(V)[V.dofmap.list[:, 0]]))
        ones, size = np.ones(corners.size, dtype=np.int8), int(corners.max()) + 1
        graph = coo_array(
            (ones, (corners[:, :1].repeat(3, axis=1).ravel(), corners.ravel())), (size, size)
        )
        _, part_of_corner = connected_components(graph, directed=False)
        return np.asarray(np.unique(part_of_corner[corners[:, 0]], return_inverse=True)[1])

    @property
    def _view(self) -> ModelView:
        mirror = self._model.mirror if self._model.multiplicity > 1 else None  # type: ignore[attr-defined]  # of shells
        return ModelView(self._model, 1.0, 1.0, mirror, 0.0, False)
