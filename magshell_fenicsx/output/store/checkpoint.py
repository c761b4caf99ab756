"""DIR/checkpoint: the case, then every result and finding of a history, each on disk before the
next is computed.

Rank 0 alone writes one file, so that a full disk stops all ranks together. ADIOS2 (2.10, through
adios4dolfinx 0.9.3) raises on one rank in `Close` then, and the other ranks wait for ever.
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
from magshell_fenicsx.output.store.folder import by_first
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.problem.problem import Document

HEAD = struct.Struct("<4sQI")  # mark, length and checksum of the content
MARK = b"MSF1"


def framed(content: bytes) -> bytes:
    """The bytes to append for one element.

    Examples
    --------
    >>> import io
    >>> file = io.BytesIO(framed(b"whole") + framed(b"torn by a kill")[:-1])
    >>> read_frame(file), read_frame(file), file.tell()
    (b'whole', None, 21)
    """
    return HEAD.pack(MARK, len(content), zlib.crc32(content)) + content


def read_frame(stream: BinaryIO) -> bytes | None:
    """The element at the stream's position; None, with the position unchanged, if there is no
    complete one.
    """
    start = stream.tell()
    head = stream.read(HEAD.size)
    if len(head) == HEAD.size:
        mark, length, checksum = HEAD.unpack(head)
        left = stream.seek(0, os.SEEK_END) - stream.seek(
            start + HEAD.size
        )  # a damaged length may be any number
        if (
            mark == MARK
            and length <= left
            and zlib.crc32(content := stream.read(length)) == checksum
        ):
            return content
    stream.seek(start)
    return None


Array = NDArray[np.float64]
CLOSE = 1e-9  # nodes at a smaller distance, over the mesh's size, are equal


class Ordering:
    """The nodes of a function space, numbered once and identified by their positions.

    Parameters
    ----------
    V
        A space distributed over all ranks, or the same space on every rank.
    comm
        The communicator of all ranks.
    known
        On rank 0, the (n, 3) positions on the affine mesh in the order to use, or None for the
        present order.

    Raises
    ------
    CaseError
        On every rank, if the nodes differ from `known`.

    Attributes
    ----------
    places
        (n, 3) positions in the order in use.
    size, last
        Number of values on this rank, and whether it is the last rank of the space.
    """

    def __init__(self, V: fem.FunctionSpace, comm: MPI.Comm, places: Array | None = None) -> None:
        self._within, self._comm = V.mesh.comm, comm
        self._values = V.dofmap.index_map_bs
        mine = V.tabulate_dof_coordinates()[: V.dofmap.index_map.size_local]
        present = self._within.allgather(mine)
        places = comm.bcast(places)
        if places is None:
            self.places: Array = np.concatenate(present)
            first = sum(len(part) for part in present[: self._within.rank])
            self._mine: NDArray[np.int64] = first + np.arange(len(mine))
        else:
            self.places, self._mine = places, self._found(places, mine, comm)
        self._parts = self._within.allgather(self._mine)
        self.size, self.last = (
            len(self._mine) * self._values,
            self._within.rank == self._within.size - 1,
        )

    def _found(self, places: Array, mine: Array, comm: MPI.Comm) -> NDArray[np.int64]:
        """The numbers of this rank's nodes among the known ones."""
        distance, number = scipy.spatial.cKDTree(places).query(mine)
        parts = self._within.allgather(number)
        one_to_one = np.array_equal(np.sort(np.concatenate(parts)), np.arange(len(places)))
        close = np.all(distance < CLOSE * np.abs(places).max())
        if not comm.allreduce(bool(one_to_one and close), MPI.LAND):
            raise CaseError(
                "--resume: the mesh differs from the checkpoint's; give another folder, or --overwrite in place of "
                "--resume"
            )
        return np.asarray(number)

    @property
    def is_present(self) -> bool:
        """Whether the order in use is the present one: each rank has the nodes that it had in the
        file's run."""
        return np.array_equal(np.concatenate(self._parts), np.arange(len(self.places)))

    def gather(self, u: Vector) -> Array:
        """All values (n, components) of a displacement on rank 0 of its space; empty on other
        ranks.
        """
        parts = self._within.gather(u)
        whole = np.empty((len(self.places), self._values)) if parts else np.empty((0, self._values))
        for where, part in zip(self._parts, parts or [], strict=False):
            whole[where] = part.reshape(-1, self._values)
        return whole

    def scatter(self, whole: Array) -> Vector:
        """This rank's part of values that every rank has."""
        return np.asarray(whole.reshape(-1, self._values)[self._mine].ravel())


NAME = "checkpoint"
FILE = "case_file"  # key with the name of the case file, which changes no result


def begun(document: Document) -> bytes:
    """The content of an empty checkpoint."""
    return framed(json.dumps({**identity(document), FILE: document.name}).encode())


def check_resumable(file: Path, document: Document) -> None:
    """Check that a checkpoint belongs to this case and these sources.

    Raises
    ------
    CaseError
        If there is no checkpoint, it is damaged, or it belongs to another case or other sources.
    """
    saved = begun_with(file)
    if saved is None:
        raise CaseError(f"--resume: {file.parent} holds no checkpoint; run without --resume")
    refuse_other(saved, document, file.parent)


def begun_with(file: Path) -> dict[str, Any] | None:
    """The `identity` of the run that began a checkpoint; None if there is no checkpoint.

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
    """Everything that a run depends on: the case, the files that it names, the program."""
    data = {"case": document.data, **document.outside, "sources": code_version()}
    return dict(json.loads(json.dumps(data)))  # as read back from a file


class OtherSources(CaseError):
    """The saved results were computed by other sources of this program."""


def refuse_other(saved: dict[str, Any], document: Document, folder: Path) -> None:
    """Check that saved results belong to this case and these sources.

    Raises
    ------
    CaseError
        With the first difference; `OtherSources` if only the sources differ.
    """
    now, saved = _solved(identity(document)), _solved(saved)
    theirs, ours = saved.get("sources", saved.get("version")), now["sources"]
    saved_case = _of_case(saved)
    if saved_case != _of_case(now):
        raise CaseError(
            f"--resume: {folder} belongs to another run: {_difference(saved_case, now)}; "
            "give another folder, or --overwrite in place of --resume"
        )
    if theirs != ours:
        raise OtherSources(
            f"--resume: {folder} was computed by other sources of magshell_fenicsx ({theirs}; these are {ours}); "
            "--overwrite in place of --resume computes it again"
        )


def is_of(saved: dict[str, Any], document: Document) -> bool:
    """Whether saved results belong to this case, by whatever sources."""
    return _of_case(_solved(saved)) == _of_case(_solved(identity(document)))


def _of_case(data: dict[str, Any]) -> dict[str, Any]:
    """Without the program."""
    return {key: value for key, value in data.items() if key not in ("sources", "version")}


def _solved(data: dict[str, Any]) -> dict[str, Any]:
    """Without the name of the file and how pictures look, which change no result."""
    case = {key: value for key, value in (data.get("case") or {}).items() if key != "output"}
    return {**{key: value for key, value in data.items() if key != FILE}, "case": case}


class Checkpoint:
    """The journal of a run in its folder; every rank calls, rank 0 reads and writes.

    Parameters
    ----------
    file
        The file of a run that begins (`begun`), or of an earlier run; an incomplete last entry is
        cut off.
    V
        The displacement's space.
    comm
        The communicator of all ranks.

    Attributes
    ----------
    replayed
        Number of results taken from the file.
    """

    def __init__(self, file: Path, V: fem.FunctionSpace, comm: MPI.Comm) -> None:
        self._file, self._comm, self.replayed = file, comm, 0
        self._writing: AppendedFile | None = None
        self._replaying = True
        by_first(comm, self._begin, "cannot be read")
        self.begin(V)

    def _begin(self) -> None:
        self._reading = open_result(self._file)
        read_frame(self._reading)

    def begin(self, space: fem.FunctionSpace) -> None:
        """The results from here on have the values of this space, whose nodes come first."""
        places = by_first(self._comm, self._places, "cannot be read") if self._replaying else None
        self._ordering = Ordering(space, self._comm, places)
        self._replaying = places is not None
        if not self._replaying:
            self._append(self._ordering.places.tobytes())

    def _places(self) -> Array | None:
        """The positions of the nodes, if the file has them."""
        content = read_frame(self._reading)
        return None if content is None else np.frombuffer(content).reshape(-1, 3)

    def replay(self) -> Point | str | None:
        """The next result in the file; None at its end."""
        content = self._next()
        if content is None:
            return None
        self.replayed += 1
        return self._decoded(content)

    def _next(self) -> bytes | None:
        """The next element of the file; None at its end."""
        if not self._replaying:
            return None
        content = by_first(self._comm, lambda: read_frame(self._reading), "cannot be read")
        self._replaying = content is not None
        return content

    def recorded_values(self, find: Callable[[], RecordedValues]) -> RecordedValues:
        """The next finding in the file; at its end that of `find`, which is put there."""
        if content := self._next():
            return self._read(content)
        found = find()
        parts = self._comm.gather(found.vector)
        vectors = [part for part in parts or () if part is not None]
        head = json.dumps(
            {"values": found.values, "parts": [part.size for part in vectors]}, default=_plain
        )
        self._append(b"\n".join([head.encode(), b"".join(part.tobytes() for part in vectors)]))
        return found

    def _read(self, content: bytes) -> RecordedValues:
        """Return a finding, with this rank's part of its vector if the ranks have the nodes that
        they had."""
        text, _, data = content.partition(b"\n")
        decoded = json.loads(text)
        self._refuse_other_kind(is_other="values" not in decoded)
        parts, rank = decoded["parts"], self._comm.rank
        if len(parts) != self._comm.size or not self._ordering.is_present:
            return RecordedValues(decoded["values"])
        return RecordedValues(
            decoded["values"], np.split(np.frombuffer(data), np.cumsum(parts[:-1]))[rank]
        )

    def _refuse_other_kind(self, *, is_other: bool) -> None:
        """See that the file has a result where a result is wanted, and a finding where one is.

        Raises
        ------
        Damaged
            If it is the other: the history has gone another way than that of the file.
        """
        if is_other:
            raise Damaged(
                f"{self._file}: is damaged: its results are in another order than this run's"
            )

    def record(self, result: Point | str) -> None:
        """Put a result on disk."""
        if isinstance(result, str):
            self._append(json.dumps({"failure": result}).encode())
            return
        size = self._ordering.size
        beyond = [
            self._comm.bcast(v[size:].tolist(), root=self._comm.size - 1)
            for v in (result.state.u, result.du)
        ]
        u, du = (self._ordering.gather(v[:size]) for v in (result.state.u, result.du))
        self._append(_encoded(result, u, du, beyond))

    def check(self, known: bool) -> None:
        pass

    def close(self) -> None:
        def close() -> None:
            self._reading.close()
            if self._writing:
                self._writing.close()

        by_first(self._comm, close)

    def remove(self) -> None:
        """Delete the file: the run is complete."""
        by_first(self._comm, self._file.unlink)

    def _append(self, content: bytes) -> None:
        def write() -> None:
            if self._writing is None:  # cut off an incomplete last entry
                self._writing = AppendedFile(self._file, self._reading.tell())
            self._writing.append(framed(content))

        by_first(self._comm, write)

    def _decoded(self, content: bytes) -> Point | str:
        text, _, data = content.partition(b"\n")
        decoded = json.loads(text)
        self._refuse_other_kind(is_other="values" in decoded)
        if "failure" in decoded:
            return str(decoded["failure"])
        u, du = (self._ordering.scatter(v) for v in np.split(np.frombuffer(data), 2))
        beyond = decoded.pop("beyond")
        if self._ordering.last:  # the numbers of a loading device
            u, du = (np.concatenate([v, more]) for v, more in zip((u, du), beyond, strict=True))
        return Point(State(u, decoded.pop("mu")), du=du, **decoded)


def _plain(number: Any) -> Any:
    """A number of NumPy as one of Python."""
    return number.item()


def _encoded(point: Point, u: Array, du: Array, beyond: list[list[float]]) -> bytes:
    """A line of JSON with the numbers of a point, then its two vectors; `beyond` has their numbers
    without a node.
    """
    numbers = {
        f.name: getattr(point, f.name) for f in fields(point) if f.name not in ("state", "du")
    }
    return (
        json.dumps({**numbers, "mu": point.state.mu, "beyond": beyond}).encode()
        + b"\n"
        + u.tobytes()
        + du.tobytes()
    )


def _difference(saved: Any, present: Any, key: str = "") -> str:
    """The first key with different values, and both values."""
    if isinstance(saved, dict) and isinstance(present, dict):
        name = next(name for name in {**saved, **present} if saved.get(name) != present.get(name))
        return _difference(
            saved.get(name),
            present.get(name),
            f"{key}.{name}".removeprefix(".").removeprefix("case."),
        )
    values = ["nothing" if value is None else json.dumps(value) for value in (saved, present)]
    return f"{key} is {values[0]} there and {values[1]} here"
