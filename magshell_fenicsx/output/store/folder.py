"""The output folder: making and locking it, and access to the disk through rank 0.

A foreign file is one that no run of this program is known to have written; it is never replaced. A
study is many runs of one case; its folder has tables of them, and a file for each run in points/. A
collective function is called on all ranks, and raises on all of them (`on_first_rank` lets rank 0
alone call a function, and gives its result, or raises its error, on every rank).
"""

import fcntl
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.durable import Damaged, read_object
from magshell_fenicsx.platform.processes import on_first_rank

if TYPE_CHECKING:  # a refused case does without
    from mpi4py import MPI

T = TypeVar("T")
MAX_NAMED_FILES = 6  # in a message
KEYS_OF_POINTS = {"outcome", "evaluation", "samples"}  # of the files in points/


class DiskError(RuntimeError):
    """Error: a file could not be written or read; the message has its name and the reason."""


def user_folder(out: Path | str) -> Path:
    """Return the folder that a user names; it need not exist.

    Raises
    ------
    CaseError
        If the name is empty, as that of a variable which is not set, or cannot be a folder's name.
    """
    if out == "":
        raise CaseError("--out: is empty; give the name of a folder, . for the working folder")
    folder = Path(out)
    try:
        str(folder).encode()  # reports are in UTF-8
        if "\0" in str(folder):
            raise ValueError
        folder.exists()
    except ValueError:
        raise CaseError(
            f"--out {str(folder)!r}: is no name in UTF-8 without zero bytes; give another"
        ) from None
    except OSError as e:
        raise CaseError(f"--out {folder}: cannot be written: {e.strerror}") from None
    return folder


def refuse_foreign(folder: Path, names: Iterable[str], new_files: str) -> None:
    """Raise an error if files would be replaced that are not known as results.

    Parameters
    ----------
    folder
        The folder of these files.
    names
        Names of the unknown files, relative to the folder.
    new_files
        Words for the new files.

    Raises
    ------
    CaseError
        With the names, if there are any.
    """
    if foreign := sorted(names):
        further_count = len(foreign) - MAX_NAMED_FILES
        further = f" and {further_count} more" if further_count > 0 else ""
        raise CaseError(
            f"{folder}: has files that {new_files} would replace and that none is known to have "
            f"written: {', '.join(foreign[:MAX_NAMED_FILES])}{further}; "
            "move them away, or give another folder"
        )


def refuse_other_tables(
    folder: Path, names: Sequence[str], keys: Collection[str], new_files: str, case: str = ""
) -> None:
    """Refuse a folder for tables of many runs that has tables of another case, or foreign files.

    Tables of the same case are replaced, and so are empty files.

    Parameters
    ----------
    folder
        The folder, which may be missing.
    names
        Names of the tables; the first one is a JSON object.
    keys
        Keys by which that object is known as a result. Its key `case` has the name of the case
        file.
    new_files
        Words for the new files.
    case
        Name of the present case file, to refuse tables of another case; empty to accept any.

    Raises
    ------
    CaseError
        On the calling rank.
    """
    content = _json_object(folder / names[0])
    # tables that are known as results are replaced, unless they are those of another case
    if content.keys() >= set(keys):
        name = content.get("case")
        is_of_other_case = isinstance(name, str) and Path(name).stem != Path(case).stem
        if case and is_of_other_case:
            raise CaseError(
                f"--out {folder}: has {new_files} of {name}, which is kept; give another folder"
            )
        return
    # unknown files are replaced only if they are empty, or if the folder has the points of a study
    # that was interrupted before it wrote its tables
    has_points = any(
        _json_object(file).keys() & KEYS_OF_POINTS for file in (folder / "points").glob("*.json")
    )
    if not has_points:
        refuse_foreign(folder, (name for name in names if _is_filled(folder / name)), new_files)


def _json_object(file: Path) -> dict[str, Any]:
    """Return the JSON object in a file; empty if there is none or it cannot be read."""
    with suppress(OSError, Damaged):
        return read_object(file)
    return {}


def _is_filled(file: Path) -> bool:
    """Whether there is a file with content, or anything else that is no file."""
    if not file.exists():
        return False
    return not file.is_file() or file.stat().st_size > 0


def prepare_folder(out: Path, comm: "MPI.Comm", make: Callable[[Path], None]) -> Path:
    """Let rank 0 prepare the folder `out` by calling `make` on it; collective.

    Returns
    -------
    The folder.

    Raises
    ------
    CaseError
        On every rank, if the folder cannot be made or written to.
    """

    def prepared() -> Path:
        """Call `make` on rank 0, with an error of the disk turned into a CaseError."""
        try:
            make(out)
        except OSError as e:
            is_inside = e.filename is not None and Path(e.filename) != out
            name = f"{e.filename} " if is_inside else ""
            raise CaseError(f"--out {out}: {name}cannot be written: {e.strerror}") from None
        return out

    return on_first_rank(comm, prepared)


@contextmanager
def locked_folder(out: Path, comm: "MPI.Comm", make: bool) -> Iterator[None]:
    """Lock a folder against other runs inside `with`; collective.

    Rank 0 alone holds the lock, also a rank 0 that a killed mpirun has left behind. A folder that
    was created here and is still empty at the end is removed.

    Parameters
    ----------
    make
        Whether to create a missing folder.

    Raises
    ------
    CaseError
        On every rank, if the folder cannot be made, or another run is writing to it.
    """
    descriptors: list[int] = []  # of the folder, on rank 0; closing it ends the lock

    def lock(folder: Path) -> None:
        """Make the folder if that is due, and lock it; on rank 0."""
        if make:
            folder.mkdir(parents=True, exist_ok=True)
        descriptors.append(os.open(folder, os.O_RDONLY))
        try:
            fcntl.flock(descriptors[0], fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BlockingIOError(0, "another run is writing to it") from None
        except OSError:
            pass  # a file system without locks

    is_new = make and not out.exists()
    try:
        prepare_folder(out, comm, lock)
        yield
    finally:
        for descriptor in descriptors:
            os.close(descriptor)
            with suppress(OSError):  # what was refused leaves no empty folder
                if is_new:
                    out.rmdir()


def access_disk(
    comm: "MPI.Comm",
    operation: Callable[[], T],
    failed: Literal["cannot be written", "cannot be read"] = "cannot be written",
) -> T:
    """Read or write on rank 0, and return the result on every rank; collective.

    Parameters
    ----------
    operation
        Function that rank 0 calls.
    failed
        Words for what went wrong if it raises OSError.

    Raises
    ------
    DiskError
        On every rank, for instance if the disk is full.
    """

    def result() -> T:
        """Return the result of the operation, with an error of the disk turned into a DiskError."""
        try:
            return operation()
        except OSError as e:
            raise DiskError(f"{e.filename or 'the results'} {failed}: {e.strerror or e}") from e

    return on_first_rank(comm, result)
