"""DIR/checkpoint: the case, then every result and finding of a run, each on disk before the next.

- A result is a point of a path, or the reason of a failed solve.
- A finding is an expensive value computed at a point, perhaps with a vector (`RecordedValues`).
- A resumed run replays results and findings: it reads them in place of computing them again.
- An element of the file is the head with the identity of the run (`run_identity.py`), the places
  of a space's nodes, a result, or a finding.
- A loading device adds unknowns to a state, which belong to no node.
- Vectors are u and du, the displacement and the tangent of the path. Each rank has the values at
  its own nodes.
- `access_disk` lets rank 0 read or write, and gives the result, or raises, on all ranks.

Rank 0 alone writes one file, so that a full disk stops all ranks together. With ADIOS2 (2.10,
through adios4dolfinx 0.9.3) a full disk raises on one rank in `Close`, and the other ranks wait for
ever.
"""

from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import numpy as np
import scipy
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.point import Point, RecordedValues
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.durable import damage
from magshell_fenicsx.output.store.folder import access_disk
from magshell_fenicsx.output.store.journal_file import JournalFile, decoded, encoded

Array = NDArray[np.float64]
SAME_PLACE_TOLERANCE = 1e-9  # distance of equal nodes over the mesh's size


class Ordering:
    """Order of the nodes of a function space that does not depend on the number of ranks.

    Nodes are numbered once and identified by their positions.

    Parameters
    ----------
    V
        A space distributed over all ranks, or the same space on every rank.
    comm
        The communicator of all ranks.
    places
        On rank 0, positions (n, 3) on the affine mesh in the order to use; None for the present
        order.

    Raises
    ------
    CaseError
        On every rank, if the nodes differ from `places`.

    Attributes
    ----------
    places
        (n, 3) positions in the order in use.
    size, last
        Number of this rank's values, and whether it is the last rank of the space.

    `_space_comm` has the ranks over which the space is distributed. `_own_numbers` are the numbers
    of this rank's nodes in the order in use, `_numbers_of_ranks` those of each rank.
    """

    def __init__(self, V: fem.FunctionSpace, comm: MPI.Comm, places: Array | None = None) -> None:
        """Number the nodes of all ranks; collective."""
        self._space_comm, self._comm = V.mesh.comm, comm
        self._values_per_node = V.dofmap.index_map_bs
        own_places = V.tabulate_dof_coordinates()[: V.dofmap.index_map.size_local]
        places_of_ranks = self._space_comm.allgather(own_places)
        places = comm.bcast(places)
        if places is None:  # the run begins: the present order is stored
            self.places: Array = np.concatenate(places_of_ranks)
            # in the present order, nodes are numbered rank after rank
            first_number = sum(
                len(places_of_rank) for places_of_rank in places_of_ranks[: self._space_comm.rank]
            )
            self._own_numbers: NDArray[np.int64] = first_number + np.arange(len(own_places))
        else:
            self.places, self._own_numbers = places, self._numbers_of(places, own_places, comm)
        self._numbers_of_ranks = self._space_comm.allgather(self._own_numbers)
        self.size = len(self._own_numbers) * self._values_per_node
        self.last = self._space_comm.rank == self._space_comm.size - 1

    def _numbers_of(self, places: Array, own_places: Array, comm: MPI.Comm) -> NDArray[np.int64]:
        """Return the number in `places` of each node of this rank; collective.

        Parameters
        ----------
        places
            (n, 3) positions in the order to use.
        own_places
            Positions of this rank's nodes.
        comm
            The communicator of all ranks.

        Raises
        ------
        CaseError
            On every rank, if nodes and places do not match one to one.
        """
        # a node is the nearest of the places; all ranks together must have each place once
        distance, number = scipy.spatial.cKDTree(places).query(own_places)
        numbers_of_ranks = self._space_comm.allgather(number)
        one_to_one = np.array_equal(
            np.sort(np.concatenate(numbers_of_ranks)), np.arange(len(places))
        )
        all_close = np.all(distance < SAME_PLACE_TOLERANCE * np.abs(places).max())
        if not comm.allreduce(bool(one_to_one and all_close), MPI.LAND):
            raise CaseError(
                "--resume: the mesh differs from the checkpoint's; give another folder, "
                "or --overwrite in place of --resume"
            )
        return np.asarray(number)

    @property
    def is_present(self) -> bool:
        """Whether the order in use is that of the ranks now: no node has changed its rank."""
        return np.array_equal(np.concatenate(self._numbers_of_ranks), np.arange(len(self.places)))

    def gather(self, u: Vector) -> Array:
        """Return a displacement as values (n, components) in the order in use; collective.

        On rank 0 of the space; empty on other ranks. `u` has this rank's values.
        """
        vectors_of_ranks = self._space_comm.gather(u)  # None on other ranks than 0
        values = np.empty((len(self.places) if vectors_of_ranks else 0, self._values_per_node))
        for numbers, vector in zip(self._numbers_of_ranks, vectors_of_ranks or [], strict=False):
            values[numbers] = vector.reshape(-1, self._values_per_node)
        return values

    def scatter(self, values: Array) -> Vector:
        """Return this rank's part, a vector, of values (n, components) in the order in use."""
        return np.asarray(values.reshape(-1, self._values_per_node)[self._own_numbers].ravel())


class Checkpoint:
    """The journal of a run in its folder; every rank calls it, rank 0 reads and writes.

    A journal keeps the results of all solves in their order. While the file (`JournalFile`) has
    results, they are replayed; further ones are appended.

    Parameters
    ----------
    file
        The file of a run that begins (`run_identity.empty_checkpoint`), or of an earlier run; an
        incomplete last element is cut off.
    V
        The displacement's space.
    comm
        The communicator of all ranks.

    Attributes
    ----------
    replayed
        Number of results taken from the file.

    `_replaying` is whether the file may have further elements; all ranks have the same.
    `_elements` is the open file, on rank 0. `_ordering` is the order of the nodes in the file.
    """

    def __init__(self, file: Path, V: fem.FunctionSpace, comm: MPI.Comm) -> None:
        """Open the file, and read the places of the nodes of `V`, or append them; collective."""
        self._file, self._comm, self.replayed = file, comm, 0
        self._replaying = True
        access_disk(comm, self._open, "cannot be read")
        self.begin(V)

    def _open(self) -> None:
        """Open the file for reading, at the first element after its head; on rank 0."""
        self._elements = JournalFile(self._file)
        self._elements.next_content()

    def begin(self, space: fem.FunctionSpace) -> None:
        """Announce results whose vectors are values in `space`; collective.

        The places of its nodes come first in the file. They are read there, or appended.
        """
        # a run that is resumed uses the order of the nodes in the file, a new one writes its own
        content = self._next_content()
        places = None if content is None else np.frombuffer(content).reshape(-1, 3)
        self._ordering = Ordering(space, self._comm, places)
        if places is None:
            self._append(self._ordering.places.tobytes())

    def replay(self) -> Point | str | None:
        """Return the next result in the file; None at its end. Collective.

        A result is a point, or the reason of a failed solve.
        """
        content = self._next_content()
        if content is None:
            return None
        self.replayed += 1
        return self._decoded_result(content)

    def _next_content(self) -> bytes | None:
        """Return the content of the next element of the file; None at its end. Collective."""
        if not self._replaying:
            return None
        content = access_disk(self._comm, lambda: self._elements.next_content(), "cannot be read")
        self._replaying = content is not None
        return content

    def recorded_values(self, find: Callable[[], RecordedValues]) -> RecordedValues:
        """Return the next finding in the file; at its end call `find`, and append what it finds.

        A finding is an expensive value at a point, and optionally a vector, of which each rank has
        a part. Collective; `find` is called on every rank.
        """
        if content := self._next_content():
            return self._decoded_finding(content)
        finding = find()
        # on rank 0 the parts of all ranks; none if the finding has no vector
        vectors_of_ranks = self._comm.gather(finding.vector)
        vectors = [vector for vector in vectors_of_ranks or () if vector is not None]
        sizes = [vector.size for vector in vectors]
        self._append(encoded({"values": finding.values, "parts": sizes}, *vectors))
        return finding

    def _decoded_finding(self, content: bytes) -> RecordedValues:
        """Return the finding in an element of the file, with this rank's part of its vector.

        The vector is None if the ranks do not have the nodes that they had when it was written.
        """
        head, vector = decoded(content)  # the vector has its parts rank after rank
        self._refuse_other_kind(is_other="values" not in head)  # only a finding has values
        sizes = head["parts"]  # number of values of each rank that wrote the vector
        if len(sizes) != self._comm.size or not self._ordering.is_present:
            return RecordedValues(head["values"])
        parts_of_ranks = np.split(vector, np.cumsum(sizes[:-1]))
        return RecordedValues(head["values"], parts_of_ranks[self._comm.rank])

    def _refuse_other_kind(self, *, is_other: bool) -> None:
        """Check that an element is a result where a result is due, and a finding where one is due.

        Raises
        ------
        Damaged
            If `is_other`: the run has then taken another way than the run of the file.
        """
        if is_other:
            raise damage(self._file, "its results are in another order than this run's")

    def record(self, result: Point | str) -> None:
        """Append a result: a point, or the reason of a failed solve. Collective."""
        if isinstance(result, str):
            self._append(encoded({"failure": result}))
            return
        size = self._ordering.size
        # a loading device adds unknowns, which the last rank has after its nodes
        values_beyond_nodes = [
            self._comm.bcast(vector[size:].tolist(), root=self._comm.size - 1)
            for vector in (result.state.u, result.du)
        ]
        names = [field.name for field in fields(result) if field.name not in ("state", "du")]
        numbers = {name: getattr(result, name) for name in names}
        head = {**numbers, "mu": result.state.mu, "beyond": values_beyond_nodes}
        u, du = (self._ordering.gather(vector[:size]) for vector in (result.state.u, result.du))
        self._append(encoded(head, u, du))

    def check(self, known: bool) -> None:
        """Do nothing: a checkpoint takes every point, whether `known` or not."""

    def close(self) -> None:
        """Close the file. Collective."""
        access_disk(self._comm, lambda: self._elements.close())

    def remove(self) -> None:
        """Delete the file of a complete run. Collective."""
        access_disk(self._comm, self._file.unlink)

    def _append(self, content: bytes) -> None:
        """Append an element with `content` to the file, on rank 0. Collective."""
        access_disk(self._comm, lambda: self._elements.append(content))

    def _decoded_result(self, content: bytes) -> Point | str:
        """Return the result in an element of the file, with this rank's part of its vectors."""
        head, values = decoded(content)
        self._refuse_other_kind(is_other="values" in head)  # only a finding has values
        if "failure" in head:
            return str(head["failure"])
        u, du = map(self._ordering.scatter, np.split(values, 2))  # from those at all nodes
        # values of u and of du that belong to no node, but to a loading device: the last rank has
        # them after its nodes
        values_beyond_nodes = head.pop("beyond")
        if self._ordering.last:
            u, du = (
                np.concatenate([vector, further])
                for vector, further in zip((u, du), values_beyond_nodes, strict=True)
            )
        return Point(State(u, head.pop("mu")), du=du, **head)
