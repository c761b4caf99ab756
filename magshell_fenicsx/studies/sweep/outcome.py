"""The outcome of a point of a sweep, and its file."""

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal
from uuid import uuid4

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.platform import sources
from magshell_fenicsx.runs.run import Result
from magshell_fenicsx.runs.summary import in_units

CURVE = (
    "label",
    "amplitude",
    "p_over_pc",
    "lambda_m",
    "field_angle",
    "force",
    "load_factor",  # of dead loads only
    "w_over_h",
    "w_pole_over_h",
    "volume_change",
    "mode",
    "branch",
)
Found = Literal["path", "fold"]


@dataclass(frozen=True)
class Outcome:
    """The outcome of one point.

    Attributes
    ----------
    knockdown
        k_d; None if there is no instability under pressure.
    barrier
        The energy barrier over E h R²; None if the case does not ask for one.
    limit
        The first limit point (the one of k_d) as in summary.json, or the event that ends a motion; None without.
    stopped
        Why the run ended before its target; None if it reached it.
    curve
        Every accepted point, with the columns of `CURVE` that the run has, and with those of its own bodies, supports,
        sources and points.
    found
        "path": the full path was computed; "fold": the fold of the previous point was followed, and the curve has
        only this point.
    factorisations
        Factorisations of the model's tangent, including failed attempts; without those for excluded modes.
    cpu_s
        CPU time of a sample of an ensemble.
    in_units
        Numbers of a case with units, as in summary.json.
    """

    knockdown: float | None
    limit: dict[str, Any] | None
    stopped: str | None
    dofs: int | None
    wall_s: float
    curve: list[Row]
    found: Found
    factorisations: int
    barrier: float | None = None
    cpu_s: float = 0.0
    in_units: dict[str, float] = field(default_factory=dict)


def outcome_of(result: Result, found: Found, factorisations: int, wall_s: float) -> Outcome:
    """The outcome of a run, or of a fold in the form of a run."""
    limits = sorted(result.limit_points, key=lambda p: p["amplitude"] != "pressure" or p["value"] != result.knockdown)
    columns = dict.fromkeys((*CURVE, *result.scene.extra_columns))
    return Outcome(
        knockdown=result.knockdown,
        limit=next(iter(limits), None) or _event(result),
        stopped=result.stopped,
        dofs=result.scene.model.system.dofs,
        wall_s=round(wall_s, 3),
        curve=[{key: row[key] for key in columns if key in row} for row in result.rows],
        found=found,
        factorisations=factorisations,
        barrier=result.barrier,
        in_units=in_units(result),
    )


def _event(result: Result) -> dict[str, Any] | None:
    """The point at which a motion has ended by an event or an instability, in the form of a limit point."""
    last, steps = result.rows[-1], result.scene.case.programme
    until = getattr(steps[-1].load, "until", "") if steps else ""
    if result.stopped or last["amplitude"] != "time" or until not in ("event", "instability"):
        return None
    known = {key: last[key] for key in ("p_over_pc", "w_pole_over_h", "amplitude")}
    return {**known, "kind": until, "mode": "", "value": last["time"]}


def save(outcome: Outcome, case: Case, file: Path) -> None:
    """Write a point's file; a killed sweep leaves the complete file or none."""
    known = {"case": case.model_dump(mode="json", exclude_none=True), **case.outside, "sources": sources.ours()}
    content = {**known, "outcome": asdict(outcome)}
    unfinished = file.with_suffix(f".{uuid4().hex}")  # two sweeps may write to one folder
    unfinished.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    unfinished.replace(file)


def load(file: Path) -> Outcome | None:
    """Read a point's file; None if it is missing, damaged or from other sources."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        found = Outcome(**content["outcome"]) if content["sources"] == sources.ours() else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return found if found is None or _is_sound(found) else None


def _is_sound(found: Outcome) -> bool:
    """Whether it has the types that `save` has written."""
    number, nothing = (int, float), type(None)
    return (
        isinstance(found.curve, list)
        and all(isinstance(row, dict) for row in found.curve)
        and isinstance(found.limit, dict | None)
        and isinstance(found.in_units, dict)
        and all(isinstance(v, (*number, nothing)) for v in (found.knockdown, found.barrier, found.dofs))
        and all(isinstance(v, number) for v in (found.wall_s, found.cpu_s, found.factorisations))
        and isinstance(found.stopped, str | None)
    )
