"""What a run's folder says of its case, of a finished or an interrupted run."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from magshell_fenicsx.case.options import output_section
from magshell_fenicsx.case.output import OutputSection
from magshell_fenicsx.output.store import checkpoint
from magshell_fenicsx.output.store.table import POLE

NAMES = {"hemisphere": POLE, "disc": "the centre", "strip": "the tip", "mesh": "the highest vertex"}


def case_in(folder: Path) -> dict[str, Any]:
    """The resolved case of a folder's summary.json or checkpoint; empty without both."""
    file = folder / "summary.json"
    begun = (
        json.loads(file.read_text(encoding="utf-8"))
        if file.exists()
        else checkpoint.begun_with(folder / checkpoint.NAME)
    )
    return dict((begun or {}).get("case") or {})


def style_of(case: Mapping[str, Any], options: Mapping[str, Any] | None = None) -> OutputSection:
    """The section `output` of a resolved case, with options in place of its keys.

    Raises
    ------
    CaseError
        If an option is wrong.
    """
    return output_section(case.get("output") or {}, options or {})


def pole_of(case: Mapping[str, Any]) -> str:
    """What the point of `w_pole_over_h` is called on a shape, where the case names no point.

    Examples
    --------
    >>> [pole_of({"shell": {"geometry": name}}) for name in ("hemisphere", "strip", "torus")]
    ['the pole', 'the tip', 'the watched point']
    """
    shell = case.get("shell") or {"geometry": "hemisphere"}
    geometry = shell.get("geometry")
    if geometry == "cap" and shell.get("hole") is None:
        return POLE
    points = (shell.get("profile") or {}).get("points") or []
    if geometry == "revolution" and points and points[-1][0] == 0:
        return POLE
    return NAMES.get(str(geometry), "the watched point")
