"""Manifest of a folder: which files a run has written, so that another run replaces only these.

The manifest is written.txt, a list of names. A run's names are all names that a run may write,
`RUN_NAMES`; a file with such a name is foreign if no run is known to have written it. The identity
in a checkpoint has the case and the program's sources of the run that began it.
"""

import re
import stat
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

from magshell_fenicsx.output.pictures.picture import PICTURES
from magshell_fenicsx.output.store import run_identity
from magshell_fenicsx.output.store.durable import (
    UNFINISHED,
    Damaged,
    read_object,
    read_result,
    write_whole,
)
from magshell_fenicsx.output.store.folder import refuse_foreign
from magshell_fenicsx.output.store.run_identity import CHECKPOINT, NEW_CHECKPOINT, SUMMARY
from magshell_fenicsx.output.store.table import is_path

NAME = "written.txt"
HEADER = "# files that magshell_fenicsx has written here: another run replaces these alone\n"
MESH = "mesh.json"  # the mesh chosen for a tolerance
FILES_OF_PATH = (CHECKPOINT, "path.csv", MESH)
PICTURE_NAMES = (
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
RUN_NAMES = re.compile(
    r"(checkpoint(\.new)?|(path|stability|frequencies)\.csv|(mesh|summary)\.json"
    r"|report\.html|animation\.gif|written\.txt"
    rf"|({'|'.join(PICTURE_NAMES)})(_\d{{4,}})?\.(png|svg|pdf)"
    r"|fields(/((path|whole)\.pvd|outlines(_\d{4,})?\.vtp|map_.+\.pvd"
    r"|((point|whole|map_.+)_\d{4,}|mode_\d{4,}_.+|gradients_.+)\.vtu))?)"
    rf"((\.[0-9a-f]{{8}})?{re.escape(UNFINISHED)})?"
)


def files_with_run_names(folder: Path) -> set[str]:
    """Return the names in a folder that a run may write, such as `path.csv` and `fields/path.pvd`.

    They are relative to the folder, whoever wrote the files. No link is followed.
    """
    files = list(folder.iterdir())
    has_fields = _irregular_kind(folder / "fields") == "a folder"
    if has_fields:  # not if it is a link to another folder
        files += (folder / "fields").iterdir()
    relative = {file.relative_to(folder).as_posix() for file in files}
    names = {name for name in relative if RUN_NAMES.fullmatch(name)}
    return names - {"fields"} if has_fields else names


def _irregular_kind(file: Path) -> str:
    """Return words for something that is no regular file; empty for a regular file or nothing."""
    kinds = {stat.S_IFREG: "", stat.S_IFDIR: "a folder", stat.S_IFLNK: "a link"}
    with suppress(FileNotFoundError):
        return kinds.get(stat.S_IFMT(file.lstat().st_mode), "a device or a pipe")
    return ""


def files_of_runs(folder: Path) -> set[str]:
    """Return those names of `files_with_run_names` that a run is known to have written.

    With a manifest they are the names listed there. Without one, as earlier versions left folders,
    they are all names if summary.json is a run's. Besides, the files of a path count if the
    checkpoint is a run's, for instance after a kill; or if there is no manifest, but a path.csv.
    Files that a killed run has left unfinished count too. Only regular files count.
    """
    regular_names = {
        name for name in files_with_run_names(folder) if not _irregular_kind(folder / name)
    }
    # files that a killed run has left
    names = {name for name in regular_names if name.endswith(UNFINISHED)}
    if run_identity.is_replacement_unfinished(folder):
        names.add(NEW_CHECKPOINT)
    # files in the manifest
    text = read_result(folder / NAME).decode(errors="replace") if NAME in regular_names else ""
    if text.startswith(HEADER):
        names |= regular_names & {NAME, *text.splitlines()}
    elif _is_of_run(lambda: read_object(folder / SUMMARY)):  # of an earlier version
        return regular_names
    # files of a path; the manifest's own name is in `names` if there is a manifest
    has_checkpoint = _is_of_run(lambda: run_identity.identity_in(folder / CHECKPOINT))
    has_manifest = NAME in names
    has_files_of_path = has_checkpoint
    if not has_checkpoint and not has_manifest:
        has_files_of_path = is_path(folder / "path.csv")
    if has_files_of_path:
        names |= {
            name for name in regular_names if name in FILES_OF_PATH or name.startswith("fields/")
        }
    return names


def _is_of_run(read_content: Callable[[], dict[str, Any] | None]) -> bool:
    """Whether a file has the case and the program of a run.

    `read_content` returns its content, or None without a file. False if the file is damaged.
    """
    with suppress(OSError, Damaged):
        content = read_content() or {}
        has_program = bool(content.keys() & {"sources", "versions"})
        return isinstance(content.get("case"), dict) and has_program
    return False


def refuse_unwritten(folder: Path) -> None:
    """Check that no file under a run's name in a folder is foreign.

    Raises
    ------
    CaseError
        With the names of the foreign files.
    """
    foreign = files_with_run_names(folder) - files_of_runs(folder)
    kinds = {name: _irregular_kind(folder / name) for name in foreign}
    names = [f"{name} ({kind})" if kind else name for name, kind in kinds.items()]
    refuse_foreign(folder, names, "a run")


def write_manifest(folder: Path, added: Iterable[str] = ()) -> None:
    """Write the list of all files in a folder that runs have written.

    `added` are names of further files, such as pictures that `plot` has drawn.
    """
    names = {*files_of_runs(folder), NAME, *added}
    lines = "".join(f"{name}\n" for name in sorted(names))
    write_whole(folder / NAME, (HEADER + lines).encode())


def remove(folder: Path, names: Iterable[str]) -> None:
    """Delete files that a run has written, the manifest last, and `fields` if it is empty."""
    for name in sorted(names, key=lambda name: name == NAME):
        (folder / name).unlink(missing_ok=True)
    with suppress(OSError):  # it is not there, or has files of others
        (folder / "fields").rmdir()
