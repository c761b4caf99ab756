"""Magnetised parts of a shell in each other's field: the term of its energy, and what a room sees
of it.
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
from magshell_fenicsx.parts.magnetism.coulomb import InteractingCharges, PartsTooNear
from magshell_fenicsx.parts.magnetism.foreseen import Foreseen
from magshell_fenicsx.parts.magnetism.interaction import AMPLITUDE, Interaction
from magshell_fenicsx.parts.magnetism.magnetised_cells import MagnetisedShell, unit
from magshell_fenicsx.parts.magnetism.multipole_expansion import Cells, InteractionHessian
from magshell_fenicsx.parts.magnetism.pairs import NO_IMAGES, Copies, Stiffness
from magshell_fenicsx.parts.magnetism.self_field import self_field
from magshell_fenicsx.parts.magnetism.singular_pairs import SingularPairs
from magshell_fenicsx.parts.magnetism.turned import Turning
from magshell_fenicsx.parts.seen import Sight

if TYPE_CHECKING:
    from magshell_fenicsx.shells.observed import Observed

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
REMEMBERED = 3  # energies and forces: a point of a path is looked at again after its tangent
SAME = 1e-7  # over R: places of a node and its image on a mirror plane
LARGEST = 9000  # unknowns: a matrix of 650 MB where the sum is factored


TOO_NEAR = (
    "magnetic.interaction: undeformed, two parts are nearer to each other than their thickness, "
    "or than a seventh of the size of their cells: move them apart, or take smaller cells"
)


def polar(F: Array) -> Array:
    """The rotations nearest to matrices (n, 3, 3)."""
    U, _, V = np.linalg.svd(F)
    U[:, :, 2] *= np.linalg.det(U @ V)[
        :, None
    ]  # a reflection where an iterate has turned a cell inside out
    return np.asarray(U @ V)


class InteractionTerm:
    """The energy over E h R² of the parts of a model in each other's and their own field; its
    amplitude: `interaction`.

    Raises
    ------
    CaseError
        If the model is too large.
    """

    group, column = "magnetic", "magnetic"

    def __init__(self, model: "Observed", u: fem.Function, of: Interaction) -> None:
        self.name = self.amplitude = AMPLITUDE
        self._itself = of.itself
        self._model, self._u = model, u
        self._scale = of.strength / (4 * np.pi * model.material.h)
        V = u.function_space
        self._comm: MPI.Comm = V.mesh.comm
        self._cells = GlobalCells.gather(V)
        self._even: InteractionTerm | None = None  # of an antisymmetric one the other
        unknowns = 3 * V.dofmap.index_map.size_global
        if unknowns > LARGEST:
            raise CaseError(
                f"magnetic.interaction: the model has {unknowns} unknowns; as all of them act on "
                f"each other, at most {LARGEST} are allowed: take a coarser mesh or a lower "
                "mesh.degree"
            )
        self._given: tuple[Array, ...] = ()
        self._seen = deque[tuple[Array, float, Array]](maxlen=REMEMBERED)
        self._blocks, self._turning = BlockProducts(self._comm), Turning(self._comm)
        self._foreseen = Foreseen(self._blocks, self._turns, alone=self._comm.size == 1)
        self._stiff: tuple[Array, tuple[InteractionHessian, InteractionHessian], Array] | None = (
            None  # beside its nodes and u
        )

    @property
    def no_number(self) -> str:
        """What is said where it is not a number."""
        if self._model.touchings:
            return " (parts are in each other, or too near for the size of their cells: take smaller ones)"
        return " (parts touch or nearly do, and magnetism does not keep them apart: name them in contact)"

    def antisymmetric(self) -> "InteractionTerm":
        """The same term for additions to u that are opposite in the images."""
        other = copy(self)
        other._even = self
        return other

    def refuse_near(self) -> None:
        """See that there are several parts, undeformed as far from each other as their cells can
        tell; collective.

        Raises
        ------
        CaseError
            On every rank, if they are not.
        """
        if not self._itself and self._parts.max() == 0:
            raise CaseError(
                "magnetic.interaction: others: acts between shells that no joint connects, or "
                "parts of a mesh file, and here all is one part: take interaction: all"
            )
        near = False
        try:
            nodes = self._nodes()  # first: the charges are made of what it gathers
            self._charged.rules(nodes, self._cells.own_range)
        except PartsTooNear:
            near = True
        if self._comm.allreduce(near, MPI.LOR):
            raise CaseError(TOO_NEAR)

    def energy(self) -> float:
        return self._evaluated()[0]

    def compile_residual(self) -> None:
        """A sum over pairs of charges."""

    def add_residual(self, b: Array, factor: float) -> None:
        b += factor * self._evaluated()[1]

    def add_extrapolated_residual(self, b: Array, factor: float) -> None:
        """See `assembly.dense_tangent.DenseTerm`."""
        self._nodes()  # what is known is forgotten if shape or remanence changed
        foreseen = (
            self._foreseen.at(global_values(self._u).ravel(), self._stiff[1][0], self._stiff[2])
            if self._stiff
            else None
        )
        b += factor * (self._evaluated()[1] if foreseen is None else foreseen)

    def extrapolation_holds_along(self, step: Array) -> bool:
        """See `assembly.dense_tangent.DenseTerm`."""
        self._nodes()
        there, nodes = global_values(self._u), self._u.function_space.dofmap.index_map
        own = step.reshape(-1, 3)[: nodes.size_local]
        return self._foreseen.extrapolation_holds_along(
            there.ravel(), np.concatenate(self._comm.allgather(own)).ravel()
        )

    def compile_tangent(self) -> None:
        """A sum over pairs of charges."""

    def add_tangent(self, K: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """Nodes far apart act on each other; see `acting`."""

    def hessian(self, *, inexact: bool = False) -> "InteractionHessian":
        """See `assembly.dense_tangent.DenseTerm`; collective."""
        return self._even.both(inexact=inexact)[1] if self._even else self.both(inexact=inexact)[0]

    def both(self, *, inexact: bool) -> tuple["InteractionHessian", "InteractionHessian"]:
        """The second derivative, and that by additions to u that are opposite in the images;
        collective.
        """
        nodes = self._nodes()
        if self._stiff is None or not (inexact or np.array_equal(nodes, self._stiff[0])):
            self._stiff = None  # two are not kept at once
            self._stiff = nodes, self._acting_at(nodes), global_values(self._u).ravel()
        return self._stiff[1]

    def by_field(
        self, name: str, direction: fem.Function, energy: float, force: float
    ) -> tuple[fem.Function, Array] | None:
        """Of remanence, thickness and placement; see `assembly.nonlocal_terms.FieldDifferentiable`;
        collective."""
        own, of_shape = self_field(self._sight), name in ("thickness", "r0")
        nodes, rates = self._nodes(), global_values(direction)[self._cells.nodes]
        turned = np.concatenate([rates @ image.Q.T for image in self._copies.images])
        weights, own_cells = (
            Weights(self._scale * energy, self._scale * force),
            self._cells.own_range,
        )
        part = slice(own_cells.start, own_cells.stop)
        if of_shape:
            into = self._charged.field_derivatives(nodes, turned, own_cells, weights, of_shape=True)
            by_place, by_thickness = (
                self._comm.allreduce(by)[part] for by in (into.by_place, into.by_thickness)
            )
            if name == "thickness":
                assert self._model.thickness
                return self._model.thickness, np.asarray(by_thickness[..., None])
            return self._model.r0, by_place + self._at_fixed_charges(direction, energy, force)
        if name != own.Br.name:
            return None
        shape, cells, edges = self._all(include_uncharged=True)
        near = SingularPairs(
            shape,
            self._corners,
            cells,
            edges,
            self._cells.own_range,
            self._comm,
            self._copies,
            include_uncharged=True,
        )
        charged = InteractingCharges(
            shape,
            self._parts,
            cells,
            edges,
            self._comm,
            near if self._itself else None,
            self._copies,
            include_uncharged=True,
        )
        found = charged.field_derivatives(nodes, turned, own_cells, weights).by_remanence
        return own.Br, np.asarray(self._comm.allreduce(found))[part]

    def _at_fixed_charges(self, direction: fem.Function, energy: float, force: float) -> Array:
        """By the nodes of own cells: a placement moves charges as a displacement does;
        collective."""
        V, count = self._u.function_space, len(self._cells.own_range)
        D, v = self.hessian(), global_values(direction).ravel()
        of_nodes = energy * self._evaluated()[1] + force * (
            D.near_blocks @ v + D.times_far(v[:, None]).ravel()
        )
        nodes = V.dofmap.list[:count]
        shared = np.bincount(nodes.ravel(), minlength=len(of_nodes) // 3)
        return np.asarray((of_nodes.reshape(-1, 3) / np.maximum(shared, 1)[:, None])[nodes])

    def _acting_at(self, nodes: Array) -> tuple["InteractionHessian", "InteractionHessian"]:
        own, images, V = self._cells.own_range, self._copies.images, self._u.function_space
        count, several = V.dofmap.index_map.size_global, len(images) > 1
        column_of = np.tile(self._cells.nodes, (len(images), 1)).astype(np.int64)
        column_of[len(self._cells.nodes) :] += count  # those of images are apart
        row_of = np.full(column_of.shape, -1)
        row_of[own.start : own.stop] = V.dofmap.list[: len(own)]
        turn = np.stack([image.Q for image in images])
        local = V.dofmap.index_map.size_local + V.dofmap.index_map.num_ghosts
        far, near = self._charged.boxes(nodes, own)
        stored, touching = (
            np.zeros((local, count), dtype=bool),
            np.zeros((count, count), dtype=bool),
        )
        for into, row_in, pairs in (
            (stored, row_of, near),
            (touching, self._cells.nodes, far.beside(own)),
        ):
            for cell, row in zip(own, pairs, strict=True):
                columns = np.unique(column_of[np.append(np.flatnonzero(row), cell)] % count)
                into[row_in[cell][:, None], columns] = True
        self._comm.Allreduce(
            MPI.IN_PLACE, touching, MPI.LOR
        )  # the same blocks on any number of ranks
        stiffness = Stiffness(stored, self._scale, row_of, column_of, turn)
        try:
            self._charged.evaluate(nodes, own, stiffness)
        except PartsTooNear:
            stiffness.blocks[:] = np.nan
        numbers = V.dofmap.index_map.local_to_global(np.arange(local, dtype=np.int32))
        cells = Cells(self._cells.nodes, own, row_of[own.start : own.stop], numbers, turn)
        B = far.jacobian(far.placed(nodes))
        even, odd = (
            InteractionHessian(
                stiffness,
                far,
                B,
                self._scale,
                cells,
                sign,
                touching[numbers][stored],
                self._turning,
            )
            for sign in ([1.0, -1.0] if several else [1.0, 1.0])
        )
        return even, odd

    def _evaluated(self) -> tuple[float, Array]:
        """The energy of this rank's part and its gradient by local nodes; collective."""
        nodes, V = self._nodes(), self._u.function_space
        for seen, energy, forces in self._seen:
            if np.array_equal(nodes, seen):
                return energy, forces
        try:
            energy, gradient = self._charged.evaluate(nodes, self._cells.own_range)
        except PartsTooNear:  # there is no such equilibrium
            k = self._cells.nodes.shape[1]
            energy, gradient = np.nan, np.full((len(self._cells.own_range), k, 3), np.nan)
        forces = np.zeros_like(self._u.x.array)
        np.add.at(
            forces.reshape(-1, 3),
            V.dofmap.list[: len(self._cells.own_range)],
            self._scale * gradient,
        )
        self._seen.appendleft((nodes, self._scale * energy, forces))
        if self._comm.allreduce(bool(np.isfinite(energy)), MPI.LAND):
            self._foreseen.learn(global_values(self._u).ravel(), forces)
        return self._scale * energy, forces

    def _nodes(self) -> Array:
        """(copies * cells, k, 3) deformed nodes of all cells; charges are made anew if what makes
        them changed.
        """
        r0, u = (global_values(f) for f in (self._model.r0, self._u))
        own = self_field(self._sight)
        factor, of_nodes = (
            self._model.thickness,
            own.Br.x.array.reshape(-1, 3)[own.Br.function_space.dofmap.list],
        )
        given: tuple[Array, ...] = (r0, self._cells.gather_values(of_nodes))
        if factor is not None:
            given += (self._cells.gather_values(factor.x.array[factor.function_space.dofmap.list]),)
        if len(self._given) != len(given) or not all(map(np.array_equal, given, self._given)):
            self._given, self._stiff = given, None
            self._seen.clear()
            self._foreseen = Foreseen(self._blocks, self._turns, alone=self._comm.size == 1)
            for name in ("_charged", "_near"):
                self.__dict__.pop(name, None)
        return self._copies.nodes_of_all((r0 + u)[self._cells.nodes])

    def _turns(self, u: Array, before: Array) -> Array:
        """(nodes, 4) quaternions of the rotations of all nodes from one state to another, scalar
        last.
        """
        r0, nodes = global_values(self._model.r0), self._cells.nodes
        element = self._u.function_space.element.basix_element
        T = element.tabulate(1, element.points)[1:, :, :, 0]

        def frames(u: Array) -> Array:
            a1, a2 = np.einsum("dpk,cki->dcpi", T, (r0 + u.reshape(-1, 3))[nodes], optimize=True)
            return np.stack([a1, a2, unit(np.cross(a1, a2))], axis=-1)

        F = np.zeros((len(r0), 3, 3))
        np.add.at(F, nodes, frames(u) @ np.linalg.inv(frames(before)))
        return np.ascontiguousarray(Rotation.from_matrix(polar(F)).as_quat())

    @cached_property
    def _charged(self) -> InteractingCharges:
        shape, cells, edges = self._all()
        return InteractingCharges(
            shape, self._parts, cells, edges, self._comm, self._near, self._copies
        )

    @cached_property
    def _near(self) -> SingularPairs | None:
        shape, cells, edges = self._all()
        if not self._itself:
            return None
        return SingularPairs(
            shape, self._corners, cells, edges, self._cells.own_range, self._comm, self._copies
        )

    def _all(self, *, include_uncharged: bool = False) -> tuple[MagnetisedShell, Ints, Ints]:
        """The cells of all ranks, and their edges that are charged, or `may` be by any remanence;
        collective.
        """
        own = self_field(self._sight)
        shape, (cells, edges) = own.shape({}), own.chargeable if include_uncharged else own.edges
        thick = shape.thick and (shape.thick[0], self._given[2])
        r0, remanence = self._given[0][self._cells.nodes], self._given[1]
        everywhere = MagnetisedShell(
            shape.element, r0, 0 * r0, shape.of_remanence, remanence, shape.h, thick
        )
        own_cells, every = np.asarray(cells) + self._cells.own_range.start, self._comm
        return everywhere, gather_rows(every, own_cells), gather_rows(every, np.asarray(edges))

    @cached_property
    def _copies(self) -> Copies:
        """What is modelled, and the images that make the whole of a half or a sector."""
        if self._model.multiplicity == 1:
            return NO_IMAGES
        own, mirror = self_field(self._sight), self._sight.mirror
        assert mirror
        return Copies(tuple(mirror.images), own.sign_of_images({}))

    @cached_property
    def _corners(self) -> Ints:
        """(copies * cells, 3) numbers of corners; on a mirror plane an image has that of its
        original; collective.
        """
        r0, corners = global_values(self._model.r0), self._cells.nodes[:, :3]
        places = self._copies.nodes_of_all(r0[None])
        numbers = np.arange(places[..., 0].size).reshape(len(places), -1)
        for later, x in enumerate(places):
            for earlier in range(later):
                same = np.abs(x - places[earlier]).max(axis=1) < SAME
                numbers[later][same] = numbers[earlier][same]
        return np.concatenate([of_copy[corners] for of_copy in numbers])

    @cached_property
    def _parts(self) -> Ints:
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
    def _sight(self) -> Sight:
        mirror = self._model.mirror if self._model.multiplicity > 1 else None  # type: ignore[attr-defined]  # of shells
        return Sight(self._model, 1.0, 1.0, mirror, 0.0, False)
