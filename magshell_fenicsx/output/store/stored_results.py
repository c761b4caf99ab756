"""Stored results of a run: its case and summary.json, checked, and the row that pictures show.

Runs may be finished or interrupted. A resolved case is the plain data of a case after validation. A
row is a line of path.csv: one point of the path, by column. Its label is "fold" or "bifurcation" at
an instability, "solution" for what a search found; its branch is 0 on the main path. The pole is
the point whose displacement the column w_pole_over_h has.
"""

import json
from collections.abc import Mapping, Sequence
from math import isclose, isnan, nan
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel, ValidationError

from magshell_fenicsx.input.messages import explained
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.output.store.durable import damage, read_object
from magshell_fenicsx.output.store.run_identity import CHECKPOINT, SUMMARY, identity_in
from magshell_fenicsx.output.store.table import LOCATED, POLE, SOLUTION, Row
from magshell_fenicsx.parts.magnetism.fields import GROUPS as GROUPS_OF_FIELD
from magshell_fenicsx.parts.shell_sections import FLAT_GEOMETRIES
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.quantities.quantity import NO_UNITS, CaseSizes, with_prefix

NUMBER_TYPES, NONE_TYPE = (int, float), type(None)
PHASES = ("jit_s", "setup_s", "assembly_s", "factor_s", "solve_s", "output_s", "total_s")
GROUPS = ("radius_to_thickness", "poisson_ratio", *GROUPS_OF_FIELD, "pc_over_E")
ALL_NUMBERS = {"*": NUMBER_TYPES}
MAGNETIC_SECTIONS = {"remanent?": dict, "applied?": dict}
# types of what is read from summary.json; a key with ? may be absent, * is every key, [...] a list
# of such items
SUMMARY_TYPES: dict[str, Any] = {
    "case": {
        "model": str,
        "shell?": {"geometry": str},
        **dict.fromkeys(("mesh", "output?"), dict),
        "magnetic?": MAGNETIC_SECTIONS,
        "loading?": (dict, list),
    },
    "dimensionless": dict.fromkeys(GROUPS, NUMBER_TYPES),
    "dimensions": {
        **dict.fromkeys(("radius", "thickness", "youngs_modulus"), (*NUMBER_TYPES, NONE_TYPE)),
        "units": str,
    },
    "in_units?": ALL_NUMBERS,
    "model": {"included": [str], "left_out": [str]},
    "stopped": (str, NONE_TYPE),
    "limit_points?": [{"mode_at?": [NUMBER_TYPES]}],
    "sensitivities": ALL_NUMBERS,
    "gradients?": {"*": {"value": NUMBER_TYPES, "numbers": ALL_NUMBERS, "fields": dict}},
    "knockdown": (*NUMBER_TYPES, NONE_TYPE),
    "barrier?": (*NUMBER_TYPES, NONE_TYPE),
    "errors?": ALL_NUMBERS,
    "snaps?": [dict.fromkeys(("time", "departure?", "jump?", "overshoot"), NUMBER_TYPES)],
    **dict.fromkeys(("snap_time_ms?", "snap_departure_ms?", "snap_jump_ms?"), NUMBER_TYPES),
    "solutions?": [{"point": int, "stable": bool, "residual": NUMBER_TYPES}],
    "points": int,
    "mesh": dict.fromkeys(("cells", "dofs", "degree"), int),
    "tolerance?": {
        "tolerance": NUMBER_TYPES,
        "error_estimate": (*NUMBER_TYPES, NONE_TYPE),
        "rounds": [{"result": NUMBER_TYPES}],
    },
    "timing": dict.fromkeys(PHASES, NUMBER_TYPES),
    **dict.fromkeys(("factorisations", "iterations", "ranks"), int),
    "blas": str,
    "versions": {"magshell_fenicsx": str},
}
# geometry -> words for the point of w_pole_over_h
POLE_NAMES = {
    "hemisphere": POLE,
    "disc": "the centre",
    "strip": "the tip",
    "mesh": "the highest vertex",
}


def case_in(folder: Path) -> dict[str, Any]:
    """Return the resolved case from a folder's summary.json, or from its checkpoint.

    Empty if there is neither.
    """
    if (folder / SUMMARY).exists():
        return dict(read_summary(folder)["case"])
    return dict((identity_in(folder / CHECKPOINT) or {}).get("case") or {})


def read_summary(folder: Path) -> dict[str, Any]:
    """Return the content of summary.json of a run's folder.

    Raises
    ------
    Damaged
        If it lacks something that reports and comparisons read.
    """
    summary = read_object(folder / SUMMARY)
    if wrong := _first_error(summary, SUMMARY_TYPES):
        raise damage(folder / SUMMARY, wrong, may_be_earlier=True)
    return summary


def sizes_in(folder: Path) -> CaseSizes:
    """Return the sizes of a run's case from summary.json of its folder, as `case_sizes` has them.

    They are those of a case without units if there is no summary yet.
    """
    if not (folder / SUMMARY).exists():
        return NO_UNITS
    summary = read_summary(folder)
    groups, dimensions = summary["dimensionless"], summary["dimensions"]
    in_si = dimensions["units"] == "SI"
    R, E = (dimensions[key] if in_si else None for key in ("radius", "youngs_modulus"))
    return CaseSizes(
        nu=groups["poisson_ratio"],
        R_over_h=groups["radius_to_thickness"],
        R=nan if R is None else R,
        E=nan if E is None else E,
        has_one_thickness=_has_one_thickness(summary["case"]),
    )


def _has_one_thickness(case: Mapping[str, Any]) -> bool:
    """Whether the thickness of a case's shell, or of all its shells, is the same everywhere."""
    sections = [shell.get("shell", {}) for shell in (case.get("shells") or {}).values()]
    sections.append(case.get("shell") or {})
    thicknesses = {section["thickness"] for section in sections if "thickness" in section}
    varies = any("thickness_factor" in section for section in sections)
    return len(thicknesses) < 2 and not varies


def _first_error(value: Any, types: Any, key: str = "") -> str:
    """Return in words the first key whose value no run writes; empty if there is none.

    A value is wrong if it has another type than `types`, or lacks a key. Dictionaries and lists are
    searched entry by entry.

    Parameters
    ----------
    value
        A part of summary.json.
    types
        What it must be, as in `SUMMARY_TYPES`: a type, or a tuple of several; a list with the types
        of all entries of a list; or a dictionary from keys to the types of their values.
    key
        Key path of the value, such as ".mesh.cells"; empty for all of summary.json.
    """
    entries: list[tuple[Any, Any, str]] = []  # (value, its types, its key path)
    if isinstance(types, list) and isinstance(value, list):
        entries = [(entry, types[0], f"{key}.{i}") for i, entry in enumerate(value)]
    elif isinstance(types, dict) and isinstance(value, dict):
        # name, perhaps with ? -> types; * stands for all keys that are there
        types_by_name = dict.fromkeys(value, types["*"]) if "*" in types else types
        # a name that ends with ? may be absent
        missing = [name for name in types_by_name if not name.endswith("?") and name not in value]
        if missing:
            return f"it has no {key}.{missing[0]}".replace(" .", " ")
        keys_by_name = {name: name.removesuffix("?") for name in types_by_name}
        entries = [
            (value[inner_key], types_by_name[name], f"{key}.{inner_key}")
            for name, inner_key in keys_by_name.items()
            if inner_key in value
        ]
    elif isinstance(types, list | dict) or not isinstance(value, types):
        # no list or dictionary where one is due, or a single value of another type
        return f"its {key.removeprefix('.')} is {json.dumps(value)[:40]}"
    errors = (_first_error(*entry) for entry in entries)
    return next((error for error in errors if error), "")


class _Options(BaseModel):
    """Section of a case that options of `plot` may change."""

    output: OutputSection


def style_of(case: Mapping[str, Any], options: Mapping[str, Any] | None = None) -> OutputSection:
    """Return the section `output` of a resolved case, with options in place of its keys.

    Raises
    ------
    CaseError
        If an option is wrong: the option, the value, what is allowed.
    """
    output_data, options = case.get("output") or {}, options or {}
    source = Source("options", {"output": {**output_data, **options}})
    # where each key stands, for messages: an option of the command line in place of a line of a
    # file
    for key in options:
        source.places["output", key] = f"--{key.replace('_', '-')}"
    try:
        return _Options.model_validate(source.data).output
    except ValidationError as e:
        raise CaseError(explained(e.errors(), source, _Options)) from None


LOAD_UNITS = {"force": "N", "moment": "N", "per_length": "N/m", "per_area": "Pa", "pressure": "Pa"}


def load_at_factor_one(case: Mapping[str, Any], sizes: CaseSizes) -> str:
    """Return the dead load of a case at a load factor of 1, with its unit, such as "50 mN".

    Forces in one direction are added. Empty without units, for several lists of loads, and for
    loads that are no single number.

    Examples
    --------
    >>> loads = [{"at": "A", "force": [0, 0, -0.02]}, {"at": "B", "force": [0, 0, -0.03]}]
    >>> sizes = CaseSizes(nu=0.5, R_over_h=100, R=0.01, E=1e6)
    >>> load_at_factor_one({"loading": {"kind": "dead", "loads": loads}}, sizes)
    '50 mN'
    """
    loading = case.get("loading") or {}
    steps = loading if isinstance(loading, list) else [loading]
    dead_steps = [step for step in steps if step.get("kind") == "dead"]
    if len(dead_steps) != 1 or isnan(sizes.in_si):
        return ""
    # kind of each load, and its vector or number
    loads = [
        (kind, load[kind]) for load in dead_steps[0]["loads"] for kind in LOAD_UNITS if kind in load
    ]
    kinds = {kind for kind, _ in loads}
    is_number = all(not isinstance(x, str) for _, load in loads for x in np.atleast_1d(load))
    if not is_number or (len(loads) != 1 and kinds != {"force"}):
        return ""
    total = float(np.linalg.norm(np.sum([load for _, load in loads], axis=0)))
    size = sum(float(np.linalg.norm(load)) for _, load in loads)
    if not isclose(total, size, rel_tol=1e-9):  # in several directions
        return ""
    factor, unit = with_prefix(total, LOAD_UNITS[kinds.pop()])
    return f"{factor * total:.4g} {unit}"


def headline(case: Mapping[str, Any], rows: Sequence[Row]) -> Row:
    """Return the row of path.csv that a run is about, at which its pictures show the shell.

    It is the last row of the path. For a last step with `until: limit` and no continuation it is
    the first instability, if there is one.
    """
    path = [row for row in rows if row["label"] != SOLUTION]
    loading = case.get("loading") or {}
    last_load = loading[-1] if isinstance(loading, list) else loading
    # a run that goes on beyond the instability is about its end
    goes_on = last_load.get("then") or last_load.get("branches")
    ends_at_limit = last_load.get("until") == "limit" and not goes_on
    instabilities = (row for row in path if row["label"] in LOCATED and not row["branch"])
    return next(instabilities, path[-1]) if ends_at_limit else path[-1]


def shell_of(case: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the section of the shell in a resolved case.

    Several shells are one of geometry: mesh.
    """
    return case.get("shell") or ({"geometry": "mesh"} if case.get("shells") else {})


def is_flat(case: Mapping[str, Any]) -> bool:
    """Whether the shell of a case is flat, so that a sphere's pressure p_c means nothing."""
    return shell_of(case).get("geometry") in FLAT_GEOMETRIES


def _ends_on_axis(points: Sequence[Sequence[Any]]) -> bool:
    """Return whether the last point (rho, z) of a profile, if it has any, is on the axis."""
    return bool(points) and points[-1][0] == 0


def pole_of(case: Mapping[str, Any]) -> str:
    """Return words for the point of `w_pole_over_h` on a shape, where the case names no point.

    Examples
    --------
    >>> [pole_of({"shell": {"geometry": name}}) for name in ("hemisphere", "strip", "torus")]
    ['the pole', 'the tip', 'the watched point']
    """
    shell = shell_of(case) or {"geometry": "hemisphere"}
    geometry = shell.get("geometry")
    # a cap without a hole, and a profile that ends on the axis, have a pole
    if geometry == "cap" and shell.get("hole") is None:
        return POLE
    points = (shell.get("profile") or {}).get("points") or []
    if geometry == "revolution" and _ends_on_axis(points):
        return POLE
    return POLE_NAMES.get(str(geometry), "the watched point")
