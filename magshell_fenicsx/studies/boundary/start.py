"""The start of a boundary: the end of its case, or a located point of another run of it.

A boundary of stability is a curve of instabilities; it starts at one of them. A record is a point
of a history, a row of path.csv; a located one is a fold or a bifurcation. An amplitude is a load
parameter, by name.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isclose
from pathlib import Path
from typing import Any

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import document_of
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.output.store.durable import Damaged
from magshell_fenicsx.output.store.stored_results import case_in
from magshell_fenicsx.output.store.table import LOCATED, read_rows
from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene_family import NoInstability, first_instability

LOAD_TOLERANCE = 1e-3  # of a load: the run and its repetition, on another processor
FORM = (
    "write it as DIR:POINT, with the folder of a run and the number of a fold or bifurcation "
    "in its path.csv"
)


@dataclass(frozen=True)
class Start:
    """The instability of a history at which a boundary starts.

    Attributes
    ----------
    text
        DIR:POINT as given; "" for the first instability of the last step.
    point
        Number of the point in the history; -1 for any number.
    load
        The load at the point, as in its column of path.csv.
    """

    text: str = ""
    point: int = -1
    load: float = 0.0

    def complete(self, records: Sequence[Record]) -> bool:
        """Return whether the records reach the point, so that no further ones are needed."""
        return 0 <= self.point < len(records)

    def instability_in(self, records: Sequence[Record]) -> Record:
        """Return the record of the instability in a history.

        It is the point with the number, if it has the load. If not, it is the fold or bifurcation
        with the nearest load, within a tolerance.

        Raises
        ------
        NoInstability
            If the history has no such point.
        """
        if not self.text:
            return first_instability(records)
        # folds and bifurcations with nearly the load of the start
        candidates = [
            r
            for r in records
            if r.label in LOCATED and isclose(_load(r), self.load, rel_tol=LOAD_TOLERANCE)
        ]
        # equal sources give equal numbers; another processor may have added points
        if self.complete(records) and records[self.point] in candidates:
            return records[self.point]
        if not candidates:
            raise NoInstability(f"--from {self.text}: the run, repeated, has no such point")
        return min(candidates, key=lambda r: abs(_load(r) - self.load))

    def anywhere(self) -> "Start":
        """Return the start for a history whose points have other numbers, as of the whole shell.

        The instability is then found by its load alone.
        """
        return replace(self, point=-1)


def _load(record: Record) -> float:
    """Return the load of a record, the amplitude that varies there."""
    return float(record.point.state.mu.get(record.amplitude, 0.0))


def start_from(text: str | None, source: Source) -> tuple[Start, Source]:
    """Read `--from`: return the instability, and the case of its run in place of a case.

    Without a text the case is unchanged, and the instability is the first of the last step.

    Raises
    ------
    CaseError
        If the text has another form, or there is no such point.
    """
    if not text:
        return Start(), source
    start_match = re.fullmatch(r"(.+):(\d+)", text)
    if not start_match:
        raise CaseError(f"--from {text}: {FORM}")
    folder, point = Path(start_match[1]), int(start_match[2])
    try:
        data, rows = case_in(folder), read_rows(folder / "path.csv")
    except (Damaged, OSError) as e:
        raise CaseError(f"--from {text}: {e}") from None
    if not data:
        raise CaseError(f"--from {text}: {folder} has no run")
    # number of a point -> its row, of folds and bifurcations
    located: dict[Any, Any] = {row["point"]: row for row in rows if row["label"] in LOCATED}
    if point not in located:
        numbers = (
            ", ".join(f"{number} ({row['label']})" for number, row in located.items()) or "none"
        )
        raise CaseError(
            f"--from {text}: is no fold or bifurcation of this run; these are {numbers}"
        )
    row = located[point]
    # the amplitude that varies there
    load = float(row[amplitude(row["amplitude"]).column])
    # places in the file, for messages, are not those of the stored case
    data = with_texts(data, document_of(Case.from_source(source)).data, source.data)
    return Start(text, point, load), replace(source, data=data, places={})


def with_texts(stored: Any, resolved: Any, written: Any) -> Any:
    """Return a stored case with the texts of a case file, such as "90 mT" for 0.09.

    Numbers of a stored case have lost their units. A value is the text of the file where both cases
    have the same number, and else the stored one.

    Parameters
    ----------
    stored
        The case of a run, or a part of it.
    resolved
        The same part of the case in the file, as a run would store it.
    written
        The same part of the case as it is written in the file.
    """
    if isinstance(written, str) and stored == resolved:
        return written
    if all(isinstance(part, Mapping) for part in (stored, resolved, written)):
        return {
            key: with_texts(value, resolved.get(key), written.get(key))
            for key, value in stored.items()
        }
    parts = stored, resolved, written
    if all(isinstance(part, list) for part in parts) and len({len(part) for part in parts}) == 1:
        return [with_texts(*items) for items in zip(*parts, strict=True)]
    return stored
