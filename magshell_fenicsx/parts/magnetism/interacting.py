"""Magnetised parts of a shell in each other's field: the term of its energy, and what a room sees of it."""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.sparse import coo_array, csr_array

from magshell_fenicsx.assembly.connected import pieces
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


@dataclass(frozen=True)
class Cells:
    """The cells of all ranks.

    Attributes
    ----------
    nodes
        (cells, k) global numbers.
    own
        Those of this rank.
    parts
        (cells,) numbers of the connected components.
    to_nodes
        (nodes, cells k) with ones.
    """

    nodes: Ints
    own: range
    parts: Ints
    to_nodes: csr_array

    @classmethod
    def of(cls, V: fem.FunctionSpace) -> "Cells":
        """Of a space; collective."""
        comm, index = V.mesh.comm, V.dofmap.index_map
        owned = V.mesh.topology.index_map(V.mesh.topology.dim).size_local
        local = V.dofmap.list[:owned]
        mine = index.local_to_global(local.ravel().astype(np.int32)).reshape(local.shape)
        every = comm.allgather(mine)
        nodes = np.concatenate(every).astype(np.intp)
        first = sum(len(each) for each in every[: comm.rank])
        count = index.size_global
        parts = np.concatenate(comm.allgather(pieces(V)[local[:, 0]]))
        cells = np.ones(nodes.size), (nodes.ravel(), np.arange(nodes.size))
        return cls(nodes, range(first, first + owned), parts, coo_array(cells, (count, nodes.size)).tocsr())


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
        self._cells = Cells.of(V)
        unknowns = 3 * V.dofmap.index_map.size_global
        if not of.itself and self._cells.parts.max() == 0:
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
            summed = (self._cells.to_nodes @ flat).reshape(-1, k, 3, 3).transpose(1, 2, 0, 3)
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
        r0, u = (self._whole(f) for f in (self._model.r0, self._u))
        own = own_field(self._sight)
        given = r0, self._over_ranks(own.Br.x.array.reshape(-1, 3)[own.Br.function_space.dofmap.list], cells=True)
        if len(self._given) != len(given) or not all(map(np.array_equal, given, self._given)):
            self._given, self._seen = given, None
            for name in ("_charged", "_near"):
                self.__dict__.pop(name, None)
        return np.asarray((r0 + u)[self._cells.nodes])

    @cached_property
    def _charged(self) -> Charged:
        shape, cells, edges = self._all()
        return Charged(shape, self._cells.parts, cells, edges, self._comm, self._near)

    @cached_property
    def _near(self) -> Near | None:
        shape, cells, edges = self._all()
        if not self._itself:
            return None
        return Near(shape, self._cells.nodes[:, :3], cells, edges, self._cells.own, self._comm)

    def _all(self) -> tuple[Shape, Ints, Ints]:
        """The cells of all ranks, and their edges that may be charged; collective."""
        own = own_field(self._sight)
        shape, (cells, edges) = own._shape({}), own._edges
        thick = shape.thick and (shape.thick[0], self._over_ranks(shape.thick[1], cells=True))
        r0, remanence = self._given[0][self._cells.nodes], self._given[1]
        whole = Shape(shape.element, r0, 0 * r0, shape.of_remanence, remanence, shape.h, thick)
        return whole, self._over_ranks(np.asarray(cells) + self._cells.own.start), self._over_ranks(np.asarray(edges))

    @property
    def _sight(self) -> Sight:
        return Sight(self._model, 1.0, 1.0, None, 0.0, False)

    def _whole(self, f: fem.Function) -> Array:
        """(nodes, 3) of all ranks."""
        owned = f.function_space.dofmap.index_map.size_local
        return self._over_ranks(f.x.array[: 3 * owned].reshape(-1, 3))

    def _over_ranks(self, values: NDArray[Any], *, cells: bool = False) -> NDArray[Any]:
        own = values[: len(self._cells.own)] if cells else values
        return np.concatenate(self._comm.allgather(own)) if self._comm.size > 1 else np.array(own)
