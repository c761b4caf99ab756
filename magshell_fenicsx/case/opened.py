"""A case, or the path of its file, as programs give it; on several ranks as rank 0 reads it."""

from collections.abc import Sequence
from pathlib import Path

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.file import FileKeys
from magshell_fenicsx.input.source import CaseError, Source, read_source
from magshell_fenicsx.platform.first import from_first


def opened(case: Case | str | Path, comm: MPI.Comm, settings: Sequence[str] = ()) -> Case:
    """The case itself, or the one in a file, with the same files on all ranks; collective.

    Raises
    ------
    CaseError
        On every rank, if it is neither, the file is no valid case, or the ranks have different cases.
    """
    if isinstance(case, str | Path):
        case = Case.from_source(read_together(case, comm, settings))
    if not isinstance(case, Case):
        raise CaseError(f"give a Case or the path of a case file, not a {type(case).__name__}; see Case.load")
    return with_same_files(case, comm)


def read_together(file: str | Path, comm: MPI.Comm, settings: Sequence[str] = ()) -> Source:
    """The case file as rank 0 reads it; collective. See `read_source`."""
    return from_first(comm, lambda: read_source(Path(file), settings))


def with_same_files(case: Case, comm: MPI.Comm) -> Case:
    """The case, whose files rank 0 reads for all ranks; collective.

    Raises
    ------
    CaseError
        On every rank, if the ranks have different cases.
    """
    readers = case.readers
    if comm.size == 1 or (readers and all(reader.files.shared for reader in readers.values())):
        return case
    own = case.model_dump_json()
    first, found = from_first(comm, lambda: (own, {key: _content(reader) for key, reader in readers.items()}))
    if sum(comm.allgather(first != own)):
        raise CaseError("the ranks were given different cases: give the same on each, or the path of a file")
    for key, reader in readers.items():
        reader.files.contents[reader.path] = found[key]
    for reader in readers.values():
        reader.files.shared = True
    return case


def _content(reader: FileKeys) -> bytes | OSError:
    try:
        return reader.files.content(reader.path)
    except OSError as e:
        return e
