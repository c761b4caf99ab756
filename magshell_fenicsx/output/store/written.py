"""Which files of a folder a run has written: another run removes and replaces these alone."""

import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from magshell_fenicsx.output.pictures.picture import PICTURES
from magshell_fenicsx.output.store import checkpoint
from magshell_fenicsx.output.store.durable import Damaged, read_object, write_whole
from magshell_fenicsx.output.store.folder import refuse_foreign
from magshell_fenicsx.output.store.table import is_path

NAME = "written.txt"
FIRST = "# files that magshell_fenicsx has written here: another run replaces these alone\n"
MESH = "mesh.json"  # the mesh chosen for a tolerance
OF_PATH = (checkpoint.NAME, "path.csv", MESH)
DRAWN = (*PICTURES, "curve", "instabilities", "modes", "frequencies", "solutions", "gradients")
# every name that a run, or `plot` after it, may write
NAMES = re.compile(
    r"checkpoint|(path|stability|frequencies)\.csv|(mesh|summary)\.json|report\.html|animation\.gif|written\.txt"
    rf"|({'|'.join(DRAWN)})(_\d{{4,}})?\.(png|svg|pdf)"
    r"|fields(/(path\.pvd|outlines(_\d{4,})?\.vtp|(point_\d{4,}|mode_\d{4,}_.+|gradients_.+)\.vtu))?"
)


def of_names(folder: Path) -> set[str]:
    """The files of a folder under names that a run writes, as `path.csv` and `fields/path.pvd`."""
    parts = [folder, *([folder / "fields"] if (folder / "fields").is_dir() else [])]
    there = {file.relative_to(folder).as_posix() for part in parts for file in part.iterdir()}
    return {name for name in there if NAMES.fullmatch(name)} - ({"fields"} if len(parts) > 1 else set())


def written(folder: Path) -> set[str]:
    """Those of `of_names` that a run is known to have written.

    They are listed in written.txt at the end of a run. Without it they are all, if summary.json is a run's, as of
    earlier versions. The files of a path are, if checkpoint is, also after a kill, or without the list path.csv.
    """
    there, found = of_names(folder), set[str]()
    text = (folder / NAME).read_text(encoding="utf-8", errors="replace") if (folder / NAME).is_file() else ""
    if text.startswith(FIRST):
        found = there & {NAME, *text.splitlines()}
    elif _is_of_run(lambda: read_object(folder / "summary.json")):
        return there
    if _is_of_run(lambda: checkpoint.begun_with(folder / checkpoint.NAME)) or (
        not found and is_path(folder / "path.csv")
    ):
        found |= {name for name in there if name in OF_PATH or name.startswith("fields/")}
    return found


def _is_of_run(read: Callable[[], dict[str, Any] | None]) -> bool:
    """Whether a file has what a run depends on."""
    with suppress(OSError, Damaged):
        known = read() or {}
        return isinstance(known.get("case"), dict) and bool(known.keys() & {"sources", "versions"})
    return False


def refuse_unwritten(folder: Path) -> None:
    """Refuse to write where a file that no run has written has a name that runs use.

    Raises
    ------
    CaseError
        With the names of these files.
    """
    refuse_foreign(folder, of_names(folder) - written(folder), "a run")


def note(folder: Path, more: Iterable[str] = ()) -> None:
    """List what a run has written, and what `plot` has added."""
    names = {*written(folder), NAME, *more}
    write_whole(folder / NAME, (FIRST + "".join(f"{name}\n" for name in sorted(names))).encode())


def remove(folder: Path, names: Iterable[str]) -> None:
    """Delete files that a run has written, the list of them first; and fields/ if it is empty then."""
    for name in sorted(names, key=lambda name: name != NAME):
        (folder / name).unlink(missing_ok=True)
    with suppress(OSError):  # it is not there, or has files of others
        (folder / "fields").rmdir()
