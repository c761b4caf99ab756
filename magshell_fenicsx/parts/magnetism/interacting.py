"""Magnetised parts of a shell in each other's field: the term of its energy.

The energy couples all nodes, so the second derivative has all entries. Theory: docs/theory.md,
parts that act on each other.

- A part is a set of connected cells. Its remanence leaves charges on its faces and edges, and
  inside; the energy Pi is a sum over pairs of charges (`InteractingCharges`).
- A half or a sector of a shell is modelled; copies are the modelled cells and their images, in
  arrays (copies * cells, ...) one after the other. Even changes of u move the images as mirror
  images of the modelled cells, odd changes move them oppositely.
- Own cells are those of this rank; the cells of all ranks are gathered (`GlobalCells`), and a
  "global" value is one for all nodes of the mesh, the same on every rank.
- D is the second derivative of the energy.
- A state is one displacement u of all nodes.
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

from magshell_fenicsx.assembly.global_mesh import (
    GlobalCells,
    component_numbers,
    gather_rows,
    global_values,
)
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.magnetism.charge_derivatives import Weights
from magshell_fenicsx.parts.magnetism.coulomb import InteractingCharges, PartsTooNear
from magshell_fenicsx.parts.magnetism.interaction import AMPLITUDE, Interaction, refuse_large
from magshell_fenicsx.parts.magnetism.magnetised_cells import MagnetisedShell
from magshell_fenicsx.parts.magnetism.pairs import NO_IMAGES, Copies, Stiffness
from magshell_fenicsx.parts.magnetism.self_field import self_field
from magshell_fenicsx.parts.magnetism.singular_pairs import SingularPairs
from magshell_fenicsx.parts.observables import ModelView

if TYPE_CHECKING:
    from magshell_fenicsx.parts.observed_model import ObservedModel

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
MAX_REMEMBERED_STATES = (
    3  # energies and forces: a point of a path is looked at again after its tangent
)
IMAGE_TOLERANCE = 1e-7  # between a node on a mirror plane and its image, over R
TOO_NEAR = (
    "magnetic.interaction: undeformed, two parts are nearer to each other than their thickness, "
    "or than a seventh of the size of their cells: move them apart, or take smaller cells"
)


class InteractionTerm:
    """Energy over E h R² of the parts of a model in each other's field, and in their own.

    It is an `assembly.dense_tangent.DenseTerm`, multiplied by the amplitude `interaction`. Like the
    constructor, methods that evaluate the energy are collective.

    Parameters
    ----------
    model
        The shells' model, with placement, thickness and magnetisation.
    u
        The displacement.
    interaction
        Strength, and whether each part acts on itself too.

    Attributes
    ----------
    _scale
        Factor that turns energies of `InteractingCharges` into those over E h R².
    _cells
        The cells of all ranks, with the numbers of their nodes.
    _inputs_of_charges
        The values by which the charges were made: placement, remanence and perhaps the thickness.
    _evaluations
        Nodes, energy and forces at the last states.
    _latest_stiffness
        Nodes, and the second derivatives there; None before the first.
    _even_term
        For a term from `antisymmetric`, the term that it was made from; else None.
    _charges, _singular_pairs, _copies, _corners, _part_of_cells
        Made at their first use: the charges, the pairs of adjacent cells, the modelled part with
        its images, and the corners and the part of each cell.

    Raises
    ------
    CaseError
        If the model is too large.
    """

    group, column = "magnetic", "magnetic"

    def __init__(self, model: "ObservedModel", u: fem.Function, interaction: Interaction) -> None:
        """Gather the cells of all ranks; charges and derivatives are computed when asked for."""
        self.name = self.amplitude = AMPLITUDE
        self._acts_on_itself = interaction.itself
        self._model, self._u = model, u
        self._scale = interaction.strength / (4 * np.pi * model.material.h)
        V = u.function_space
        self._comm: MPI.Comm = V.mesh.comm
        self._cells = GlobalCells.gather(V)
        self._even_term: InteractionTerm | None = None
        refuse_large(3 * V.dofmap.index_map.size_global)
        self._inputs_of_charges: tuple[Array, ...] = ()
        self._evaluations = deque[tuple[Array, float, Array]](maxlen=MAX_REMEMBERED_STATES)
        self._latest_stiffness: tuple[Array, Stiffness] | None = None

    @property
    def no_number(self) -> str:
        """Explanation for the user in case the energy is not a number."""
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
        """Return this term with the second derivative by odd changes of u.

        It serves the modes that a mirror plane excludes. The returned term takes its second
        derivative from this one, which computes that by even and by odd changes at once.
        """
        odd_term = copy(self)
        odd_term._even_term = self
        return odd_term

    def refuse_near(self) -> None:
        """Check that undeformed parts can act on each other; collective.

        Raises
        ------
        CaseError
            On every rank, if all is one part that does not act on itself, or if parts are too near.
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
        """Return this rank's part of the energy; collective."""
        energy, _ = self._evaluated()
        return energy

    def compile_residual(self) -> None:
        """Compile nothing: the residual is a sum over pairs of charges."""

    def add_residual(self, b: Array, factor: float) -> None:
        """Add factor dPi/du of this rank's cells to b, with ghosts; collective."""
        _, forces = self._evaluated()
        b += factor * forces

    def compile_tangent(self) -> None:
        """Compile nothing: the tangent is a sum over pairs of charges."""

    def add_tangent(self, K: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """Add nothing: distant nodes act on each other, and the tangent is dense."""

    def add_hessian(self, rows: Array, factor: float) -> None:
        """Add factor D, this rank's part, to a matrix (3 local nodes, 3 all nodes); collective.

        A term from `antisymmetric` adds the derivative by odd changes, which move the images
        oppositely.
        """
        even_term = self._even_term or self
        even_term._stiffness().add_to(rows, factor, sign=-1.0 if self._even_term else 1.0)

    def _stiffness(self) -> Stiffness:
        """Return the second derivatives by u at the present state; collective.

        Those of the latest state are kept, and are nan if parts overlap.
        """
        nodes, own_cells = self._nodes(), self._cells.own_range
        if self._latest_stiffness is not None:
            latest_nodes, stiffness = self._latest_stiffness
            if np.array_equal(nodes, latest_nodes):
                return stiffness
        self._latest_stiffness = None  # the old ones free their memory first
        dofmap = self._u.function_space.dofmap
        index_map = dofmap.index_map
        image_transforms = np.stack([image.Q for image in self._copies.images])
        column_of = np.tile(self._cells.nodes, (len(image_transforms), 1)).astype(np.int64)
        # nodes of images have columns of their own
        column_of[len(self._cells.nodes) :] += index_map.size_global
        # rows are local nodes of own cells; those of other ranks and of images are -1
        row_of = np.full(column_of.shape, -1)
        row_of[own_cells.start : own_cells.stop] = dofmap.list[: len(own_cells)]
        shape = index_map.size_local + index_map.num_ghosts, index_map.size_global
        stiffness = Stiffness(shape, self._scale, row_of, column_of, image_transforms)
        try:
            self._charges.evaluate(nodes, own_cells, stiffness)
        except PartsTooNear:
            stiffness.blocks[:] = np.nan
        self._latest_stiffness = nodes, stiffness
        return stiffness

    def by_field(
        self, name: str, direction: fem.Function, energy: float, force: float
    ) -> tuple[fem.Function, Array] | None:
        """Return derivatives of `energy` Pi + `force` v . dPi/du by a field's values; collective.

        Pi is the energy over E h R², `energy` and `force` are two numbers.

        Parameters
        ----------
        name
            Name of the remanence, "thickness", or "r0" for the placement.
        direction
            The direction v, a displacement.
        energy, force
            The factors of Pi and of v . dPi/du.

        Returns
        -------
        tuple or None
            The field, and derivatives (own cells, nodes, components) by its values. None if the
            term does not depend on a field of that name.
        """
        field_of_model, of_shape = self_field(self._view), name in ("thickness", "r0")
        # deformed nodes of all copies; the direction v at the modelled nodes, and then at all
        nodes, rates = self._nodes(), global_values(direction)[self._cells.nodes]
        rates_of_copies = np.concatenate([rates @ image.Q.T for image in self._copies.images])
        weights = Weights(energy=self._scale * energy, force=self._scale * force)
        own_cells = self._cells.own_range
        own_rows = slice(own_cells.start, own_cells.stop)
        # by the shape: through the charges and their heights, summed over ranks; a change of place
        # also moves the charges
        if of_shape:
            nodal_derivatives = self._charges.field_derivatives(
                nodes, rates_of_copies, own_cells, weights, of_shape=True
            )
            by_place, by_thickness = (
                self._comm.allreduce(derivative)[own_rows]
                for derivative in (nodal_derivatives.by_place, nodal_derivatives.by_thickness)
            )
            if name == "thickness":
                assert self._model.thickness
                return self._model.thickness, np.asarray(by_thickness[..., None])
            return self._model.r0, by_place + self._at_fixed_charges(direction, energy, force)
        if name != field_of_model.Br.name:
            return None
        # by the remanence: through the charges, also of elements that have none now
        by_remanence = (
            self._charges_of_all_elements()
            .field_derivatives(nodes, rates_of_copies, own_cells, weights)
            .by_remanence
        )
        return field_of_model.Br, np.asarray(self._comm.allreduce(by_remanence))[own_rows]

    def _charges_of_all_elements(self) -> InteractingCharges:
        """Return the charges with those elements that have none; collective.

        Derivatives by the remanence need them, as another remanence would charge them.
        """
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
        return InteractingCharges(
            shape,
            self._part_of_cells,
            cells,
            edges,
            self._comm,
            singular_pairs if self._acts_on_itself else None,
            self._copies,
            include_uncharged=True,
        )

    def _at_fixed_charges(self, direction: fem.Function, energy: float, force: float) -> Array:
        """Return derivatives (own cells, nodes, 3) by the placement at fixed charges; collective.

        The number is that of `by_field`. A placement moves charges as a displacement does, so its
        derivatives are `energy` dPi/du + `force` D v, with the direction v. Derivatives are wanted
        by the nodes of each cell: the one by a shared node is divided equally among its own cells.
        """
        V, count = self._u.function_space, len(self._cells.own_range)
        v = global_values(direction).ravel()
        D = np.zeros((len(self._u.x.array), len(v)))
        self.add_hessian(D, 1.0)
        _, gradient = self._evaluated()
        by_nodes = energy * gradient + force * (D @ v)
        nodes = V.dofmap.list[:count]
        # the number of own cells at each node; nodes of ghost cells alone are not used
        cells_of_node = np.bincount(nodes.ravel(), minlength=len(by_nodes) // 3)
        shares = by_nodes.reshape(-1, 3) / np.maximum(cells_of_node, 1)[:, None]
        return np.asarray(shares[nodes])

    def _evaluated(self) -> tuple[float, Array]:
        """Return this rank's part of the energy, and its gradient by local unknowns; collective.

        Both are over E h R²; the gradient includes ghosts. Both are nan if parts overlap. Results
        at the last states are kept, as a point of a path is evaluated more than once.
        """
        nodes, V, own_cells = self._nodes(), self._u.function_space, self._cells.own_range
        for nodes_before, energy, forces in self._evaluations:
            if np.array_equal(nodes, nodes_before):
                return energy, forces
        try:
            energy, gradient = self._charges.evaluate(nodes, own_cells)
        except PartsTooNear:  # there is no such equilibrium
            nodes_per_cell = self._cells.nodes.shape[1]
            energy, gradient = np.nan, np.full((len(own_cells), nodes_per_cell, 3), np.nan)
        # the gradient by the nodes of each cell is added up at the nodes
        forces = np.zeros_like(self._u.x.array)
        np.add.at(forces.reshape(-1, 3), V.dofmap.list[: len(own_cells)], self._scale * gradient)
        self._evaluations.appendleft((nodes, self._scale * energy, forces))
        return self._scale * energy, forces

    def _nodes(self) -> Array:
        """Return the deformed nodes (copies * cells, k, 3) over R of all cells; collective.

        As a side effect, results that depend on placement, remanence or thickness are forgotten if
        one of these has changed since the last call: charges, evaluations and second derivatives.
        """
        r0, u = (global_values(f) for f in (self._model.r0, self._u))
        # the inputs of the charges: placement, remanence, and perhaps the thickness, of all cells
        Br, thickness = self_field(self._view).Br, self._model.thickness
        remanence_of_cells = Br.x.array.reshape(-1, 3)[Br.function_space.dofmap.list]
        inputs: tuple[Array, ...] = (r0, self._cells.gather_values(remanence_of_cells))
        if thickness is not None:
            thickness_of_cells = thickness.x.array[thickness.function_space.dofmap.list]
            inputs += (self._cells.gather_values(thickness_of_cells),)
        are_unchanged = len(self._inputs_of_charges) == len(inputs) and all(
            map(np.array_equal, inputs, self._inputs_of_charges)
        )
        if not are_unchanged:
            self._inputs_of_charges, self._latest_stiffness = inputs, None
            self._evaluations.clear()
            for name in ("_charges", "_singular_pairs"):  # cached properties
                self.__dict__.pop(name, None)
        return self._copies.nodes_of_all((r0 + u)[self._cells.nodes])

    @cached_property
    def _charges(self) -> InteractingCharges:
        """The charges of all cells, undeformed; collective at the first use."""
        shape, cells, edges = self._cells_and_charged_edges()
        return InteractingCharges(
            shape, self._part_of_cells, cells, edges, self._comm, self._singular_pairs, self._copies
        )

    @cached_property
    def _singular_pairs(self) -> SingularPairs | None:
        """Pairs of adjacent cells; None if parts do not act on themselves. Collective."""
        shape, cells, edges = self._cells_and_charged_edges()
        if not self._acts_on_itself:
            return None
        return SingularPairs(
            shape, self._corners, cells, edges, self._cells.own_range, self._comm, self._copies
        )

    def _cells_and_charged_edges(
        self, *, include_uncharged: bool = False
    ) -> tuple[MagnetisedShell, Ints, Ints]:
        """Return the cells of all ranks, and the edges that have charges; collective.

        The edges are two arrays: the number of the cell, among all ranks' cells, and the local
        number of the edge in it. With `include_uncharged`, edges that another remanence could
        charge are included.
        """
        field_of_model = self_field(self._view)
        shape = field_of_model.shape({})  # of this rank's cells
        cells, edges = field_of_model.chargeable if include_uncharged else field_of_model.edges
        # inputs as gathered by `_nodes`: placement, remanence, and perhaps the thickness factor
        r0_of_nodes, remanence, *thickness_factor = self._inputs_of_charges
        r0 = r0_of_nodes[self._cells.nodes]
        factor = None
        if shape.thickness_factor:
            element, _ = shape.thickness_factor
            factor = element, thickness_factor[0]
        all_cells = MagnetisedShell(
            element=shape.element,
            r0=r0,
            u=0 * r0,
            remanence_element=shape.remanence_element,
            remanence=remanence,
            h=shape.h,
            thickness_factor=factor,
        )
        own_cells, comm = np.asarray(cells) + self._cells.own_range.start, self._comm
        return all_cells, gather_rows(comm, own_cells), gather_rows(comm, np.asarray(edges))

    @cached_property
    def _copies(self) -> Copies:
        """The modelled cells and the images that make a half or a sector whole; collective.

        Images whose field is opposite have opposite charges.
        """
        if self._model.multiplicity == 1:
            return NO_IMAGES
        field_of_model, mirror = self_field(self._view), self._view.mirror
        assert mirror
        return Copies(tuple(mirror.images), field_of_model.sign_of_images({}))

    @cached_property
    def _corners(self) -> Ints:
        """(copies * cells, 3) numbers of the cells' corners; collective.

        A corner on a mirror plane and its image have the same number, so that cells on both sides
        count as adjacent.
        """
        r0, corners = global_values(self._model.r0), self._cells.nodes[:, :3]  # corners come first
        places = self._copies.nodes_of_all(r0[None])
        numbers = np.arange(places[..., 0].size).reshape(len(places), -1)
        for later, x in enumerate(places):
            for earlier in range(later):
                is_shared = np.abs(x - places[earlier]).max(axis=1) < IMAGE_TOLERANCE
                numbers[later][is_shared] = numbers[earlier][is_shared]
        return np.concatenate([copy_numbers[corners] for copy_numbers in numbers])

    @cached_property
    def _part_of_cells(self) -> Ints:
        """(copies * cells,) number of the connected part of each cell; collective."""
        V, corners = self._u.function_space, self._corners
        if len(self._copies.images) == 1:  # the parts are those of the mesh
            return np.asarray(self._cells.gather_values(component_numbers(V)[V.dofmap.list[:, 0]]))
        # parts are the components of a graph whose links join the first corner of a cell to all
        ones, size = np.ones(corners.size, dtype=np.int8), int(corners.max()) + 1
        first_corners = corners[:, :1].repeat(3, axis=1)
        graph = coo_array((ones, (first_corners.ravel(), corners.ravel())), (size, size))
        _, part_of_corner = connected_components(graph, directed=False)
        # numbers without gaps, as not every component has a cell
        _, part_of_cells = np.unique(part_of_corner[corners[:, 0]], return_inverse=True)
        return np.asarray(part_of_cells)

    @property
    def _view(self) -> ModelView:
        """The model as its self-field needs it: in its own units and frame, with its mirror."""
        mirror = self._model.mirror if self._model.multiplicity > 1 else None  # type: ignore[attr-defined]  # of shells
        return ModelView(
            self._model, length=1.0, modulus=1.0, mirror=mirror, azimuth=0.0, reactions=False
        )
