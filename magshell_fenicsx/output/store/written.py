"""Which files of a folder a run has written: another run removes and replaces these alone."""

import re
import stat
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from magshell_fenicsx.output.pictures.picture import PICTURES
from magshell_fenicsx.output.store import checkpoint
from magshell_fenicsx.output.store.durable import Damaged, read_object, read_result, write_whole
from magshell_fenicsx.output.store.folder import refuse_foreign
from magshell_fenicsx.output.store.table import is_path

NAME = "written.txt"
FIRST = "# files that magshell_fenicsx has written here: another run replaces these alone\n"
MESH = "mesh.json"  # the mesh chosen for a tolerance
OF_PATH = (checkpoint.NAME, "path.csv", MESH)
NEW = f"{checkpoint.NAME}.new"  # there while a run replaces an earlier one
DRAWN = (
    *PICTURES,
    "curve",
    "sensors",
    "field_maps",
    "instabilities",
    "modes",
    "frequencies",
    "solutions",
    "gradients",
)
# every name that a run, or `plot` after it, may write, also while it writes
NAMES = re.compile(
    r"(checkpoint(\.new)?|(path|stability|frequencies)\.csv|(mesh|summary)\.json|report\.html|animation\.gif|written\.txt"
    rf"|({'|'.join(DRAWN)})(_\d{{4,}})?\.(png|svg|pdf)"
    r"|fields(/((path|whole)\.pvd|outlines(_\d{4,})?\.vtp|map_.+\.pvd|((point|whole|map_.+)_\d{4,}|mode_\d{4,}_.+|gradients_.+)\.vtu))?)(\.unfinished)?"
)


def of_names(folder: Path) -> set[str]:
    """What a folder has under names that a run writes, as `path.csv` and `fields/path.pvd`; no link
    is followed.
    """
    parts = [folder, *([folder / "fields"] if _kind(folder / "fields") == "a folder" else [])]
    files = {file.relative_to(folder).as_posix() for part in parts for file in part.iterdir()}
    return {name for name in files if NAMES.fullmatch(name)} - (
        {"fields"} if len(parts) > 1 else set()
    )


def _kind(file: Path) -> str:
    """What is there, if it is no regular file as those of a run."""
    kinds = {stat.S_IFREG: "", stat.S_IFDIR: "a folder", stat.S_IFLNK: "a link"}
    with suppress(FileNotFoundError):
        return kinds.get(stat.S_IFMT(file.lstat().st_mode), "a device or a pipe")
    return ""


def written(folder: Path) -> set[str]:
    """Those of `of_names` that a run is known to have written.

    They are listed in written.txt at the end of a run. Without it they are all, if summary.json is
    a run's, as of earlier versions. The files of a path are, if checkpoint is, also after a kill,
    or without the list path.csv. What is no regular file is none of theirs.
    """
    present = {name for name in of_names(folder) if not _kind(folder / name)}
    ours = {name for name in present if name.endswith(".unfinished")}  # left by a kill
    text = read_result(folder / NAME).decode(errors="replace") if NAME in present else ""
    if replaced(folder):
        ours.add(NEW)
    if text.startswith(FIRST):
        ours |= present & {NAME, *text.splitlines()}
    elif _is_of_run(lambda: read_object(folder / "summary.json")):
        return present
    if _is_of_run(lambda: checkpoint.begun_with(folder / checkpoint.NAME)) or (
        NAME not in ours and is_path(folder / "path.csv")
    ):
        ours |= {name for name in present if name in OF_PATH or name.startswith("fields/")}
    return ours


def replaced(folder: Path) -> bool:
    """Whether a new run was killed while it removed the files of an earlier one."""
    return _is_of_run(lambda: checkpoint.begun_with(folder / NEW))


def _is_of_run(read: Callable[[], dict[str, Any] | None]) -> bool:
    """Whether a file has what a run depends on."""
    with suppress(OSError, Damaged):
        content = read() or {}
        return isinstance(content.get("case"), dict) and bool(
            content.keys() & {"sources", "versions"}
        )
    return False


def refuse_unwritten(folder: Path) -> None:
    """Refuse to write where a file that no run has written has a name that runs use.

    Raises
    ------
    CaseError
        With the names of these files.
    """
    kinds = {name: _kind(folder / name) for name in of_names(folder) - written(folder)}
    refuse_foreign(
        folder, (f"{name} ({kind})" if kind else name for name, kind in kinds.items()), "a run"
    )


def note(folder: Path, more: Iterable[str] = ()) -> None:
    """List what a run has written, and what `plot` has added."""
    names = {*written(folder), NAME, *more}
    write_whole(folder / NAME, (FIRST + "".join(f"{name}\n" for name in sorted(names))).encode())


def remove(folder: Path, names: Iterable[str]) -> None:
    """Delete files that a run has written, the list of them last; and fields/ if it is empty then."""
    for name in sorted(names, key=lambda name: name == NAME):
        (folder / name).unlink(missing_ok=True)
    with suppress(OSError):  # it is not there, or has files of others
        (folder / "fields").rmdir()
