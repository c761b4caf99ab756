"""What a run's folder says of its case, of a finished or an interrupted run."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from magshell_fenicsx.input.messages import explained
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.output.store import checkpoint
from magshell_fenicsx.output.store.durable import Damaged, read_object
from magshell_fenicsx.output.store.table import LOCATED, POLE, SOLUTION, Row
from magshell_fenicsx.problem.wanted import OutputSection
from magshell_fenicsx.shape.sections import FLAT

SUMMARY = "summary.json"
NUMBER, NOTHING = (int, float), type(None)
PHASES = ("jit_s", "setup_s", "assembly_s", "factor_s", "solve_s", "output_s", "total_s")
GROUPS = ("radius_to_thickness", "poisson_ratio", "lambda_m", "Lambda_m", "pc_over_E")
NUMBERS = {"*": NUMBER}
SECTIONS = {"remanent?": dict, "applied?": dict}
# the types of what is read from summary.json; a key with ? may be absent, * is every key, [...] a
# list of such items
SHAPE: dict[str, Any] = {
    "case": {
        "model": str,
        "shell?": {"geometry": str},
        **dict.fromkeys(("mesh", "output?"), dict),
        "magnetic?": SECTIONS,
        "loading?": (dict, list),
    },
    "dimensionless": dict.fromkeys(GROUPS, NUMBER),
    "dimensions": {
        **dict.fromkeys(("radius", "thickness", "youngs_modulus"), (*NUMBER, NOTHING)),
        "units": str,
    },
    "in_units?": NUMBERS,
    "model": {"included": [str], "left_out": [str]},
    "stopped": (str, NOTHING),
    "limit_points?": [{"mode_at?": [NUMBER]}],
    "sensitivities": NUMBERS,
    "gradients?": {"*": {"value": NUMBER, "numbers": NUMBERS, "fields": dict}},
    "knockdown": (*NUMBER, NOTHING),
    "barrier?": (*NUMBER, NOTHING),
    "snaps?": [dict.fromkeys(("time", "departure?", "jump?", "overshoot"), NUMBER)],
    **dict.fromkeys(("snap_time_ms?", "snap_departure_ms?", "snap_jump_ms?"), NUMBER),
    "solutions?": [{"point": int, "stable": bool, "residual": NUMBER}],
    "points": int,
    "mesh": dict.fromkeys(("cells", "dofs", "degree"), int),
    "tolerance?": {
        "tolerance": NUMBER,
        "error_estimate": (*NUMBER, NOTHING),
        "rounds": [{"result": NUMBER}],
    },
    "timing": dict.fromkeys(PHASES, NUMBER),
    **dict.fromkeys(("factorisations", "iterations", "ranks"), int),
    "blas": str,
    "versions": {"magshell_fenicsx": str},
}
NAMES = {"hemisphere": POLE, "disc": "the centre", "strip": "the tip", "mesh": "the highest vertex"}


def case_in(folder: Path) -> dict[str, Any]:
    """The resolved case of a folder's summary.json or checkpoint; empty without both."""
    if (folder / SUMMARY).exists():
        return dict(read_summary(folder)["case"])
    return dict((checkpoint.begun_with(folder / checkpoint.NAME) or {}).get("case") or {})


def read_summary(folder: Path) -> dict[str, Any]:
    """The content of summary.json.

    Raises
    ------
    Damaged
        If it lacks something that reports and comparisons read.
    """
    summary = read_object(folder / SUMMARY)
    if wrong := _unlike(summary, SHAPE):
        raise Damaged(f"{folder / SUMMARY}: is damaged, or of an earlier version: {wrong}")
    return summary


def _unlike(value: Any, kind: Any, key: str = "") -> str:
    """The first place where a value is none that a run writes, in words; empty if there is none;
    see `SHAPE`.
    """
    within: list[tuple[Any, Any, str]] = []
    if isinstance(kind, list) and isinstance(value, list):
        within = [(each, kind[0], f"{key}.{i}") for i, each in enumerate(value)]
    elif isinstance(kind, dict) and isinstance(value, dict):
        inner = dict.fromkeys(value, kind["*"]) if "*" in kind else kind
        for name in (name for name in inner if not name.endswith("?") and name not in value):
            return f"it has no {key}.{name}".replace(" .", " ")
        names = {name: name.removesuffix("?") for name in inner}
        within = [(value[k], inner[name], f"{key}.{k}") for name, k in names.items() if k in value]
    elif isinstance(kind, list | dict) or not isinstance(value, kind):
        return f"its {key.removeprefix('.')} is {json.dumps(value)[:40]}"
    return next((wrong for each in within if (wrong := _unlike(*each))), "")


class _Options(BaseModel):
    output: OutputSection


def style_of(case: Mapping[str, Any], options: Mapping[str, Any] | None = None) -> OutputSection:
    """The section `output` of a resolved case, with options in place of its keys.

    Raises
    ------
    CaseError
        If an option is wrong: the option, the value, what is allowed.
    """
    given, options = case.get("output") or {}, options or {}
    source = Source("options", {"output": {**given, **options}})
    for key in options:
        source.places["output", key] = f"--{key.replace('_', '-')}"
    try:
        return _Options.model_validate(source.data).output
    except ValidationError as e:
        raise CaseError(explained(e.errors(), source, _Options)) from None


def headline(case: Mapping[str, Any], rows: Sequence[Row]) -> Row:
    """The row that a run is about, at which its pictures show the shell.

    With `until: limit` at its end that is the first instability, even if the path goes on from
    there.
    """
    path = [row for row in rows if row["label"] != SOLUTION]
    loading = case.get("loading") or {}
    last = loading[-1] if isinstance(loading, list) else loading
    asked = last.get("until") == "limit" and not (last.get("then") or last.get("branches"))
    located = (row for row in path if row["label"] in LOCATED and not row["branch"])
    return next(located, path[-1]) if asked else path[-1]


def shell_of(case: Mapping[str, Any]) -> Mapping[str, Any]:
    """The section of the shell in a case; several are one of geometry: mesh."""
    return case.get("shell") or ({"geometry": "mesh"} if case.get("shells") else {})


def is_flat(case: Mapping[str, Any]) -> bool:
    """Whether the shell of a case is drawn flat, so that the pressure p_c of a sphere is a unit at
    most.
    """
    return shell_of(case).get("geometry") in FLAT


def pole_of(case: Mapping[str, Any]) -> str:
    """What the point of `w_pole_over_h` is called on a shape, where the case names no point.

    Examples
    --------
    >>> [pole_of({"shell": {"geometry": name}}) for name in ("hemisphere", "strip", "torus")]
    ['the pole', 'the tip', 'the watched point']
    """
    shell = shell_of(case) or {"geometry": "hemisphere"}
    geometry = shell.get("geometry")
    if geometry == "cap" and shell.get("hole") is None:
        return POLE
    points = (shell.get("profile") or {}).get("points") or []
    if geometry == "revolution" and points and points[-1][0] == 0:
        return POLE
    return NAMES.get(str(geometry), "the watched point")
