"""The points of earlier sweeps into the same folder, to which another sweep adds its own."""

import copy
import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.output.store.durable import Damaged, read_object, write_whole
from magshell_fenicsx.studies.sweep.axes import MOST_POINTS, Axis
from magshell_fenicsx.studies.sweep.points import SweepPoint, make_point

NAME, TABLE = "sweep.json", "sweep.csv"


def with_earlier(folder: Path, source: Source, axes: Sequence[Axis], points: Sequence[SweepPoint]) -> list[SweepPoint]:
    """The points of the folder's sweep and the new ones among `points`; writes down all.

    Raises
    ------
    CaseError
        If the folder has a sweep over other keys, or of another case.
    """
    file, keys, base = folder / NAME, [list(axis.keys) for axis in axes], _base(source, axes)
    known = _read(file)
    if known is None and (folder / TABLE).exists() and (folder / TABLE).stat().st_size:
        raise CaseError(f"--out {folder}: has a sweep.csv of an earlier version; give another folder")
    if known and known["keys"] != keys:
        over = " and ".join("+".join(each) for each in known["keys"])
        raise CaseError(f"--out {folder}: has a sweep over {over}, which is kept; give another folder for other keys")
    if known and known["base"] != base:
        raise CaseError(
            f"--out {folder}: has a sweep of another case or other --set, which is kept; give another folder"
        )
    asked, there = [_values(point, axes) for point in points], known["points"] if known else []
    merged = [Axis(axis.keys, tuple(v[i] for v in (*asked, *there))) for i, axis in enumerate(axes)]
    places = {_place(values, merged) for values in asked}
    earlier = [values for values in there if _place(values, merged) not in places]
    if (count := len(earlier) + len(asked)) > MOST_POINTS:
        raise CaseError(f"--out {folder}: {count} points with those there; allowed at most {MOST_POINTS}")
    write_whole(file, json.dumps({"keys": keys, "base": base, "points": [*earlier, *asked]}, indent=1).encode())
    return [*(make_point(source, axes, values) for values in earlier), *points]


def _values(point: SweepPoint, axes: Sequence[Axis]) -> list[str]:
    return [point.values[axis.keys[0]] for axis in axes]


def _place(values: Sequence[str], axes: Sequence[Axis]) -> tuple[str, ...]:
    """The same text for equal numbers, whatever their unit."""
    pairs = zip(values, axes, strict=True)
    return tuple(f"{axis.number(value):.10g}" if axis.numbers else value for value, axis in pairs)


def _read(file: Path) -> dict[str, Any] | None:
    if not file.exists():
        return None
    found = read_object(file)
    keys, points = found.get("keys"), found.get("points")
    if not (isinstance(found.get("base"), str) and _are_words(keys) and _are_words(points, of=len(keys or ""))):
        raise Damaged(f"{file}: is damaged: no keys, base and points of a sweep")
    return found


def _are_words(lists: object, of: int | None = None) -> bool:
    """Whether it is a list of lists of text, each with so many items."""
    return isinstance(lists, list) and all(
        isinstance(each, list)
        and len(each) in (of, len(each) if of is None else of)
        and all(isinstance(v, str) for v in each)
        for each in lists
    )


def _base(source: Source, axes: Sequence[Axis]) -> str:
    """Hash of the case as it is written, without the swept keys."""
    data = copy.deepcopy(source.data)
    for key in (key for axis in axes for key in axis.keys):
        *sections, last = key.split(".")
        part = data
        for name in sections:
            part = part[int(name)] if isinstance(part, list) else part.get(name, {}) if isinstance(part, dict) else {}
        if isinstance(part, dict):
            part.pop(last, None)
        elif isinstance(part, list) and last.isdecimal() and int(last) < len(part):
            part[int(last)] = None
    return hashlib.sha256(json.dumps(data, sort_keys=True, default=str).encode()).hexdigest()[:16]
