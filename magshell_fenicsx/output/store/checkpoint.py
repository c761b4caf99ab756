"""DIR/checkpoint: the case, then every result and finding of a run, each on disk before the next.

- A result is a point of a path, or the reason of a failed solve.
- A finding is an expensive value computed at a point, perhaps with a vector (`RecordedValues`).
- A resumed run replays results and findings: it reads them in place of computing them again.
- An element (a frame) of the file is a mark, a length, a checksum and the content: the head with
  the identity of the run, the places of a space's nodes, a result, or a finding.
- The identity of a run is all that its results depend on: the case and its files, and the sources
  of the program. A document has what a run writes down about its case.
- A loading device adds unknowns to a state, which belong to no node.
- Vectors are u and du, the displacement and the tangent of the path. Each rank has the values at
  its own nodes.
- `access_disk` lets rank 0 read or write, and gives the result, or raises, on all ranks.

Rank 0 alone writes one file, so that a full disk stops all ranks together. With ADIOS2 (2.10,
through adios4dolfinx 0.9.3) a full disk raises on one rank in `Close`, and the other ranks wait for
ever.
"""

import json
import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import scipy
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.point import Point, RecordedValues
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.durable import AppendedFile, Damaged, open_result
from magshell_fenicsx.output.store.folder import access_disk
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.problem.problem import Document

FRAME_HEAD = struct.Struct("<4sQI")  # mark, length and checksum of the content
MARK = b"MSF1"


def framed(content: bytes) -> bytes:
    """Return one element of the file as bytes: mark, length and checksum, then its content.

    Examples
    --------
    >>> import io
    >>> file = io.BytesIO(framed(b"whole") + framed(b"torn by a kill")[:-1])
    >>> read_frame(file), read_frame(file), file.tell()
    (b'whole', None, 21)
    """
    return FRAME_HEAD.pack(MARK, len(content), zlib.crc32(content)) + content


def read_frame(stream: BinaryIO) -> bytes | None:
    """Return the content of the element at the stream's position, and go on to the next one.

    None if there is no complete element with a right checksum; the position is then unchanged.
    """
    start = stream.tell()
    head = stream.read(FRAME_HEAD.size)
    if len(head) == FRAME_HEAD.size:
        mark, length, checksum = FRAME_HEAD.unpack(head)
        end = stream.seek(0, os.SEEK_END)
        content_start = stream.seek(start + FRAME_HEAD.size)
        # a damaged length may be any number
        if mark == MARK and length <= end - content_start:
            content = stream.read(length)
            if zlib.crc32(content) == checksum:
                return content
    stream.seek(start)
    return None


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


NAME = "checkpoint"
CASE_FILE = "case_file"  # key with the name of the case file, which changes no result


def empty_content(document: Document) -> bytes:
    """Return the content of a checkpoint without results."""
    return framed(json.dumps({**identity(document), CASE_FILE: document.name}).encode())


def check_resumable(file: Path, document: Document) -> None:
    """Check that a checkpoint belongs to this case and these sources.

    Raises
    ------
    CaseError
        If there is no checkpoint, it is damaged, or it belongs to another case or other sources.
    """
    saved = identity_in(file)
    if saved is None:
        raise CaseError(f"--resume: {file.parent} holds no checkpoint; run without --resume")
    refuse_other_case(saved, document, file.parent)


def identity_in(file: Path) -> dict[str, Any] | None:
    """Return the `identity` of the run that began a checkpoint; None if there is no such file.

    Raises
    ------
    Damaged
        If its head cannot be read.
    """
    try:
        with open_result(file) as stream:
            head = read_frame(stream)
    except FileNotFoundError:
        return None
    try:
        identity = json.loads(head or b"")
    except ValueError:
        identity = None
    if not isinstance(identity, dict) or not isinstance(identity.get("case"), dict):
        raise Damaged(f"{file}: is damaged: its head cannot be read")
    return identity


def identity(document: Document) -> dict[str, Any]:
    """Return everything on which the results of a run depend.

    These are the case, the files that it names, and the program's sources.
    """
    data = {"case": document.data, **document.outside, "sources": code_version()}
    return dict(json.loads(json.dumps(data)))  # as read back from a file


class OtherSources(CaseError):
    """Error: the saved results were computed by other sources of this program."""


def refuse_other_case(saved: dict[str, Any], document: Document, folder: Path) -> None:
    """Check that saved results belong to this case and to these sources.

    Raises
    ------
    CaseError
        With the first difference; `OtherSources` if only the sources differ.
    """
    identity_now, saved = _without_appearance(identity(document)), _without_appearance(saved)
    # checkpoints of earlier versions have a key `version` in place of `sources`
    saved_sources, sources = saved.get("sources", saved.get("version")), identity_now["sources"]
    saved_case = _without_program(saved)
    if saved_case != _without_program(identity_now):
        raise CaseError(
            f"--resume: {folder} belongs to another run: {_difference(saved_case, identity_now)}; "
            "give another folder, or --overwrite in place of --resume"
        )
    if saved_sources != sources:
        raise OtherSources(
            f"--resume: {folder} was computed by other sources of magshell_fenicsx "
            f"({saved_sources}; these are {sources}); "
            "--overwrite in place of --resume computes it again"
        )


def belongs_to(saved: dict[str, Any], document: Document) -> bool:
    """Whether saved results belong to this case, whichever sources computed them.

    `saved` is the `identity` of their run.
    """
    saved_case = _without_program(_without_appearance(saved))
    present_case = _without_program(_without_appearance(identity(document)))
    return saved_case == present_case


def _without_program(data: dict[str, Any]) -> dict[str, Any]:
    """Return an identity without the program's sources."""
    return {key: value for key, value in data.items() if key not in ("sources", "version")}


def _without_appearance(data: dict[str, Any]) -> dict[str, Any]:
    """Return an identity without the name of the case file and without the section `output`.

    Neither of them changes a result.
    """
    case = {key: value for key, value in (data.get("case") or {}).items() if key != "output"}
    return {**{key: value for key, value in data.items() if key != CASE_FILE}, "case": case}


class Checkpoint:
    """The journal of a run in its folder; every rank calls it, rank 0 reads and writes.

    A journal keeps the results of all solves in their order. While the file has results, they are
    replayed; further ones are appended.

    Parameters
    ----------
    file
        The file of a run that begins (`empty_content`), or of an earlier run; an incomplete last
        element is cut off.
    V
        The displacement's space.
    comm
        The communicator of all ranks.

    Attributes
    ----------
    replayed
        Number of results taken from the file.

    `_replaying` is whether the file may have further elements; all ranks have the same. `_reading`
    is the file as it is read, on rank 0. `_writing` is the file as it is appended to, on rank 0;
    None before the first element is appended. `_ordering` is the order of the nodes in the file.
    """

    def __init__(self, file: Path, V: fem.FunctionSpace, comm: MPI.Comm) -> None:
        """Open the file, and read the places of the nodes of `V`, or append them; collective."""
        self._file, self._comm, self.replayed = file, comm, 0
        self._writing: AppendedFile | None = None
        self._replaying = True
        access_disk(comm, self._open, "cannot be read")
        self.begin(V)

    def _open(self) -> None:
        """Open the file for reading, at the first element after its head; on rank 0."""
        self._reading = open_result(self._file)
        read_frame(self._reading)

    def begin(self, space: fem.FunctionSpace) -> None:
        """Announce results whose vectors are values in `space`; collective.

        The places of its nodes come first in the file. They are read there, or appended.
        """
        # a run that is resumed uses the order of the nodes in the file, a new one writes its own
        places = (
            access_disk(self._comm, self._places_in_file, "cannot be read")
            if self._replaying
            else None
        )
        self._ordering = Ordering(space, self._comm, places)
        self._replaying = places is not None
        if not self._replaying:
            self._append(self._ordering.places.tobytes())

    def _places_in_file(self) -> Array | None:
        """Return the positions (n, 3) of the nodes from the file; None at its end. On rank 0."""
        content = read_frame(self._reading)
        return None if content is None else np.frombuffer(content).reshape(-1, 3)

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
        content = access_disk(self._comm, lambda: read_frame(self._reading), "cannot be read")
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
        head = json.dumps(
            {"values": finding.values, "parts": [vector.size for vector in vectors]},
            default=_python_number,
        )
        self._append(b"\n".join([head.encode(), b"".join(vector.tobytes() for vector in vectors)]))
        return finding

    def _decoded_finding(self, content: bytes) -> RecordedValues:
        """Return the finding in an element of the file, with this rank's part of its vector.

        The vector is None if the ranks do not have the nodes that they had when it was written.
        """
        # a line of JSON, then the parts of the vector, rank after rank
        text, _, data = content.partition(b"\n")
        decoded = json.loads(text)
        self._refuse_other_kind(is_other="values" not in decoded)  # only a finding has values
        sizes = decoded["parts"]  # number of values of each rank that wrote the vector
        if len(sizes) != self._comm.size or not self._ordering.is_present:
            return RecordedValues(decoded["values"])
        parts_of_ranks = np.split(np.frombuffer(data), np.cumsum(sizes[:-1]))
        return RecordedValues(decoded["values"], parts_of_ranks[self._comm.rank])

    def _refuse_other_kind(self, *, is_other: bool) -> None:
        """Check that an element is a result where a result is due, and a finding where one is due.

        Raises
        ------
        Damaged
            If `is_other`: the run has then taken another way than the run of the file.
        """
        if is_other:
            raise Damaged(
                f"{self._file}: is damaged: its results are in another order than this run's"
            )

    def record(self, result: Point | str) -> None:
        """Append a result: a point, or the reason of a failed solve. Collective."""
        if isinstance(result, str):
            self._append(json.dumps({"failure": result}).encode())
            return
        size = self._ordering.size
        # a loading device adds unknowns, which the last rank has after its nodes
        values_beyond_nodes = [
            self._comm.bcast(vector[size:].tolist(), root=self._comm.size - 1)
            for vector in (result.state.u, result.du)
        ]
        u, du = (self._ordering.gather(vector[:size]) for vector in (result.state.u, result.du))
        self._append(_encoded(result, u, du, values_beyond_nodes))

    def check(self, known: bool) -> None:
        """Do nothing: a checkpoint takes every point, whether `known` or not."""

    def close(self) -> None:
        """Close the file. Collective."""

        def close_files() -> None:
            """Close the file as it is read, and as it is appended to; on rank 0."""
            self._reading.close()
            if self._writing:
                self._writing.close()

        access_disk(self._comm, close_files)

    def remove(self) -> None:
        """Delete the file of a complete run. Collective."""
        access_disk(self._comm, self._file.unlink)

    def _append(self, content: bytes) -> None:
        """Append an element with `content` to the file, on rank 0. Collective."""

        def write() -> None:
            """Append the element; at the first one cut off an incomplete last element."""
            if self._writing is None:
                self._writing = AppendedFile(self._file, self._reading.tell())
            self._writing.append(framed(content))

        access_disk(self._comm, write)

    def _decoded_result(self, content: bytes) -> Point | str:
        """Return the result in an element of the file, with this rank's part of its vectors."""
        # a line of JSON, then the values of both vectors
        text, _, data = content.partition(b"\n")
        decoded = json.loads(text)
        self._refuse_other_kind(is_other="values" in decoded)  # only a finding has values
        if "failure" in decoded:
            return str(decoded["failure"])
        vectors = np.split(np.frombuffer(data), 2)  # u and du, at all nodes
        u, du = (self._ordering.scatter(vector) for vector in vectors)
        # values of u and of du that belong to no node, but to a loading device: the last rank has
        # them after its nodes
        values_beyond_nodes = decoded.pop("beyond")
        if self._ordering.last:
            u, du = (
                np.concatenate([vector, further])
                for vector, further in zip((u, du), values_beyond_nodes, strict=True)
            )
        return Point(State(u, decoded.pop("mu")), du=du, **decoded)


def _python_number(number: Any) -> Any:
    """Return a number of NumPy as one of Python, which JSON can write."""
    return number.item()


def _encoded(point: Point, u: Array, du: Array, values_beyond_nodes: list[list[float]]) -> bytes:
    """Return a point as bytes: a line of JSON with its numbers, then its two vectors.

    Parameters
    ----------
    u, du
        Displacement and its tangent (n, components), in the order of the file.
    values_beyond_nodes
        Values of u and of du that belong to no node.
    """
    names = [field.name for field in fields(point) if field.name not in ("state", "du")]
    numbers = {name: getattr(point, name) for name in names}
    head = json.dumps({**numbers, "mu": point.state.mu, "beyond": values_beyond_nodes})
    return head.encode() + b"\n" + u.tobytes() + du.tobytes()


def _difference(saved: Any, present: Any, key: str = "") -> str:
    """Return in words the first key at which two cases differ, and both its values.

    Parameters
    ----------
    saved, present
        Parts of the two cases at `key`.
    key
        Key path of these parts; empty for the whole case.
    """
    if isinstance(saved, dict) and isinstance(present, dict):  # go on into the first other key
        name = next(name for name in {**saved, **present} if saved.get(name) != present.get(name))
        inner_key = f"{key}.{name}".removeprefix(".").removeprefix("case.")
        return _difference(saved.get(name), present.get(name), inner_key)
    there, here = ("nothing" if value is None else json.dumps(value) for value in (saved, present))
    return f"{key} is {there} there and {here} here"
