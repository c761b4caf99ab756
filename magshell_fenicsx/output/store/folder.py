"""The output folder: making it, locking it, and disk access through rank 0."""

import fcntl
import json
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.platform.input_files import read_bounded
from magshell_fenicsx.platform.processes import on_first_rank

if TYPE_CHECKING:  # a refused case does without
    from mpi4py import MPI

T = TypeVar("T")
MOST_NAMED = 6
OF_POINTS = {"outcome", "evaluation", "samples"}  # keys of the files in points/


class DiskError(RuntimeError):
    """A file could not be written or read; the message has its name and the reason."""


def given_folder(out: Path | str) -> Path:
    """The folder that a user names.

    Raises
    ------
    CaseError
        If the name is empty, as that of a variable which is not set: the working folder is `.`. If
        no folder may have it, or none can be looked for there.
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


def refuse_foreign(folder: Path, names: Iterable[str], what: str) -> None:
    """Refuse to replace files that are not known as results.

    Raises
    ------
    CaseError
        With their names, if there are any.
    """
    if foreign := sorted(names):
        more = f" and {len(foreign) - MOST_NAMED} more" * (len(foreign) > MOST_NAMED)
        raise CaseError(
            f"{folder}: has files that {what} would replace and that none is known to have written: "
            f"{', '.join(foreign[:MOST_NAMED])}{more}; move them away, or give another folder"
        )


def refuse_others(
    folder: Path, names: Sequence[str], kept: Collection[str], what: str, case: str = ""
) -> None:
    """Refuse a folder for the tables of many runs that has those of another case file, or files of
    others.

    Parameters
    ----------
    names
        The tables; the first is a JSON object with the keys `kept`, and the name of the case file
        as `case`.
    case
        The name of the case file, if another one is refused.

    Raises
    ------
    CaseError
        On the rank that calls.
    """
    content = _object(folder / names[0])
    if content.keys() >= set(kept):
        name = content.get("case")
        if case and isinstance(name, str) and Path(name).stem != Path(case).stem:
            raise CaseError(
                f"--out {folder}: has {what} of {name}, which is kept; give another folder"
            )
    elif not any(_object(file).keys() & OF_POINTS for file in (folder / "points").glob("*.json")):
        # of an interrupted one there would be points
        refuse_foreign(folder, (name for name in names if _is_filled(folder / name)), what)


def _object(file: Path) -> dict[str, Any]:
    """The JSON object in a file; empty if there is none."""
    try:
        content = json.loads(read_bounded(file))
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _is_filled(file: Path) -> bool:
    """Whether there is something that is no empty file."""
    return file.exists() and (not file.is_file() or file.stat().st_size > 0)


def prepare_folder(out: Path, comm: "MPI.Comm", make: Callable[[Path], None]) -> Path:
    """Let rank 0 prepare a folder; collective.

    Raises
    ------
    CaseError
        On every rank, if the folder cannot be made or written to.
    """

    def made() -> Path:
        try:
            make(out)
        except OSError as e:
            within = e.filename is not None and Path(e.filename) != out
            raise CaseError(
                f"--out {out}: {f'{e.filename} ' * within}cannot be written: {e.strerror}"
            ) from None
        return out

    return on_first_rank(comm, made)


@contextmanager
def held_folder(out: Path, comm: "MPI.Comm", make: bool) -> Iterator[None]:
    """Lock a folder against other runs inside `with`; ranks of a killed mpirun may still be
    writing.

    Parameters
    ----------
    make
        Whether to create a missing folder.

    Raises
    ------
    CaseError
        On every rank, if the folder cannot be made, or a run is writing to it.
    """
    number: list[int] = []

    def hold(folder: Path) -> None:
        if make:
            folder.mkdir(parents=True, exist_ok=True)
        number.append(os.open(folder, os.O_RDONLY))
        try:
            fcntl.flock(number[0], fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise BlockingIOError(0, "another run is writing to it") from None
        except OSError:
            pass  # a file system without locks

    new = make and not out.exists()
    try:
        prepare_folder(out, comm, hold)
        yield
    finally:
        for n in number:
            os.close(n)
            with suppress(OSError):  # what was refused leaves no empty folder
                if new:
                    out.rmdir()


def by_first(
    comm: "MPI.Comm",
    do: Callable[[], T],
    failed: Literal["cannot be written", "cannot be read"] = "cannot be written",
) -> T:
    """Let rank 0 write or read; return its result on every rank, see `on_first_rank`. Collective.

    Raises
    ------
    DiskError
        On every rank, for instance if the disk is full.
    """

    def done() -> T:
        try:
            return do()
        except OSError as e:
            raise DiskError(f"{e.filename or 'the results'} {failed}: {e.strerror or e}") from e

    return on_first_rank(comm, done)
