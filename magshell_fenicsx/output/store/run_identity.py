"""The identity of a run, and whether the run in a folder may go on or be replaced.

- The identity of a run is all that its results depend on: the case and its files, and the sources
  of the program. A document has what a run writes down about its case.
- The checkpoint begins with the identity of its run. A complete run has no checkpoint any more, but
  the same keys in summary.json.
- While a run replaces an earlier one, its checkpoint has another name, `NEW_CHECKPOINT`.
"""

import json
from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.durable import (
    Damaged,
    damage,
    open_result,
    read_object,
)
from magshell_fenicsx.output.store.journal_file import framed, read_frame
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.problem.problem import Document

CHECKPOINT = "checkpoint"
NEW_CHECKPOINT = f"{CHECKPOINT}.new"
SUMMARY = "summary.json"
CASE_FILE = "case_file"  # key with the name of the case file, which changes no result


def empty_checkpoint(document: Document) -> bytes:
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
        raise damage(file, "its head cannot be read")
    return identity


def stored_identity(folder: Path, outside: Collection[str] = ()) -> dict[str, Any]:
    """Return the `identity` of the run in a folder; empty without checkpoint and summary.json.

    Parameters
    ----------
    outside
        Names of what results depend on besides the case, to be read from summary.json.

    Raises
    ------
    Damaged
        If the checkpoint or summary.json cannot be read.
    """
    if is_replacement_unfinished(folder):  # what is left of the earlier run is no run
        return identity_in(folder / NEW_CHECKPOINT) or {}
    if stored := identity_in(folder / CHECKPOINT):
        return stored
    # a complete run has no checkpoint any more
    summary = read_object(folder / SUMMARY) if (folder / SUMMARY).exists() else {}
    return {key: summary[key] for key in ("case", CASE_FILE, "sources", *outside) if key in summary}


def is_replacement_unfinished(folder: Path) -> bool:
    """Whether a run was killed while it removed the files of an earlier run from a folder."""
    with suppress(OSError, Damaged):
        return identity_in(folder / NEW_CHECKPOINT) is not None
    return False


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
