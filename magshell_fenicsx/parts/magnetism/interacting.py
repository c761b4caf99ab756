"""Magnetised parts of a shell in each other's field: the term of its energy, and what a room sees of it."""

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.sparse import coo_array

from magshell_fenicsx.assembly.connected import CellsOfAll, over_ranks, pieces, whole
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.magnetism.charged import Shape
from magshell_fenicsx.parts.magnetism.coulomb import Charged, Touching
from magshell_fenicsx.parts.magnetism.interaction import AMPLITUDE, Interaction
from magshell_fenicsx.parts.magnetism.near import Near
from magshell_fenicsx.parts.magnetism.own_field import own_field
from magshell_fenicsx.parts.seen import Sight

if TYPE_CHECKING:
    from magshell_fenicsx.shells.observed import Observed

Array = NDArray[np.float64]
Ints = NDArray[np.intp]
LARGEST = 9000  # unknowns: a matrix of 650 MB


class InteractionTerm:
    """The energy over E h R² of the parts of a model in each other's and their own field; its amplitude: `interaction`.

    Raises
    ------
    CaseError
        If the shell is one part, or the model is too large.
    """

    group, column = "magnetic", "magnetic"

    def __init__(self, model: "Observed", u: fem.Function, of: Interaction) -> None:
        self.name = self.amplitude = AMPLITUDE
        self._itself = of.itself
        self._model, self._u = model, u
        self._scale = of.strength / (4 * np.pi * model.material.h)
        V = u.function_space
        self._comm: MPI.Comm = V.mesh.comm
        self._cells = CellsOfAll.of(V)
        nodes = self._cells.nodes
        ones = np.ones(nodes.size), (nodes.ravel(), np.arange(nodes.size))
        self._to_nodes = coo_array(ones, (V.dofmap.index_map.size_global, nodes.size)).tocsr()  # from those of cells
        self._parts = self._cells.gathered(pieces(V)[V.dofmap.list[:, 0]])  # of each cell
        unknowns = 3 * V.dofmap.index_map.size_global
        if not of.itself and self._parts.max() == 0:
            raise CaseError(
                "magnetic.interaction: others: acts between parts of a mesh file that are not connected, and the shell "
                "is one part: take interaction: all, or a mesh of several parts"
            )
        if unknowns > LARGEST:
            raise CaseError(
                f"magnetic.interaction: the model has {unknowns} unknowns; as all of them act on each other, "
                f"at most {LARGEST} are allowed: take a coarser mesh or a lower mesh.degree"
            )
        self._given: tuple[Array, ...] = ()
        self._seen: tuple[Array, float, Array] | None = None

    def refuse_near(self) -> None:
        """See that the undeformed parts are as far from each other as their cells can tell; collective.

        Raises
        ------
        CaseError
            On every rank, if they are not.
        """
        near = False
        try:
            nodes = self._nodes()
            self._charged.rules(nodes, self._cells.own)
        except Touching:
            near = True
        if self._comm.allreduce(near, MPI.LOR):
            raise CaseError(
                "magnetic.interaction: others: undeformed, two parts are nearer to each other than their thickness, or "
                "than a seventh of the size of their cells: move them apart, or take smaller cells in the mesh file"
            )

    def energy(self) -> float:
        return self._evaluated()[0]

    def compile_residual(self) -> None:
        """A sum over pairs of charges."""

    def add_residual(self, b: Array, factor: float) -> None:
        V = self._u.function_space
        local = V.dofmap.list[: len(self._cells.own)]
        np.add.at(b.reshape(-1, 3), local, factor * self._evaluated()[1])

    def compile_tangent(self) -> None:
        """A sum over pairs of charges."""

    def add_tangent(self, K: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """It has no sparse part; see `add_rows`."""

    def add_rows(self, rows: Array, factor: float) -> None:
        """See `assembly.whole.WholeTerm`; collective."""
        nodes = self._nodes()
        local = self._u.function_space.dofmap.list[: len(self._cells.own)]
        k = self._cells.nodes.shape[1]

        def add(row: int, stiffness: Array) -> None:
            flat = stiffness.reshape(3 * k, -1, 3).transpose(1, 0, 2).reshape(-1, 9 * k)
            summed = (self._to_nodes @ flat).reshape(-1, k, 3, 3).transpose(1, 2, 0, 3)
            rows[local[row]] += factor * self._scale * summed

        try:
            self._charged.evaluate(nodes, self._cells.own, add)
        except Touching:
            rows[:] = np.nan
        if self._near:
            self._add_near(nodes, rows, factor * self._scale)

    def _add_near(self, nodes_of_cells: Array, rows: Array, factor: float) -> None:
        """What cells that touch add to the rows of nodes of own cells."""
        assert self._near
        own, local, nodes = self._cells.own, self._u.function_space.dofmap.list, self._cells.nodes
        for first, second, H in self._near.stiffness(nodes_of_cells):
            for i, (c, d) in enumerate(zip(first, second, strict=True)):
                if c in own:
                    at = local[c - own.start][:, None], slice(None), nodes[d], slice(None)
                    rows[at] += factor * H[i].transpose(1, 3, 0, 2)

    def _evaluated(self) -> tuple[float, Array]:
        """The energy of this rank's part and its gradient by the nodes of own cells; collective."""
        nodes = self._nodes()
        if self._seen is None or not np.array_equal(nodes, self._seen[0]):
            try:
                energy, gradient = self._charged.evaluate(nodes, self._cells.own)
            except Touching:  # there is no such equilibrium
                k = self._cells.nodes.shape[1]
                energy, gradient = np.nan, np.full((len(self._cells.own), k, 3), np.nan)
            self._seen = nodes, self._scale * energy, self._scale * gradient
        return self._seen[1:]

    def _nodes(self) -> Array:
        """(cells, k, 3) the deformed nodes of all cells; what is charged is renewed where it has changed."""
        r0, u = (whole(f) for f in (self._model.r0, self._u))
        own = own_field(self._sight)
        given = r0, self._cells.gathered(own.Br.x.array.reshape(-1, 3)[own.Br.function_space.dofmap.list])
        if len(self._given) != len(given) or not all(map(np.array_equal, given, self._given)):
            self._given, self._seen = given, None
            for name in ("_charged", "_near"):
                self.__dict__.pop(name, None)
        return np.asarray((r0 + u)[self._cells.nodes])

    @cached_property
    def _charged(self) -> Charged:
        shape, cells, edges = self._all()
        return Charged(shape, self._parts, cells, edges, self._comm, self._near)

    @cached_property
    def _near(self) -> Near | None:
        shape, cells, edges = self._all()
        if not self._itself:
            return None
        return Near(shape, self._cells.nodes[:, :3], cells, edges, self._cells.own, self._comm)

    def _all(self) -> tuple[Shape, Ints, Ints]:
        """The cells of all ranks, and their edges that may be charged; collective."""
        own = own_field(self._sight)
        shape, (cells, edges) = own.shape({}), own.edges
        thick = shape.thick and (shape.thick[0], self._cells.gathered(shape.thick[1]))
        r0, remanence = self._given[0][self._cells.nodes], self._given[1]
        everywhere = Shape(shape.element, r0, 0 * r0, shape.of_remanence, remanence, shape.h, thick)
        own_cells, every = np.asarray(cells) + self._cells.own.start, self._comm
        return everywhere, over_ranks(every, own_cells), over_ranks(every, np.asarray(edges))

    @property
    def _sight(self) -> Sight:
        return Sight(self._model, 1.0, 1.0, None, 0.0, False)
