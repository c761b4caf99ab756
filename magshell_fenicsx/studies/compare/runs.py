"""One model of a case, run in a separate process and kept in a folder."""

import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.checkpoint import FILE, NAME, begun_with
from magshell_fenicsx.output.store.durable import Damaged, read_object, write_whole
from magshell_fenicsx.output.store.known import read_summary
from magshell_fenicsx.output.store.table import read_lines
from magshell_fenicsx.platform import sources
from magshell_fenicsx.studies.study.measure import measure

ModelName = Literal["shell", "solid"]
MODELS: tuple[ModelName, ...] = ("shell", "solid")


@dataclass(frozen=True)
class ModelRun:
    """The results of a run.

    Attributes
    ----------
    refinement
        The value of mesh.refinement.
    summary, rows
        The content of summary.json and of path.csv.
    cpu_s, wall_s
        Times of the process without the compilation of kernels.
    """

    model: ModelName
    refinement: float
    summary: dict[str, Any]
    rows: list[dict[str, str]]
    cpu_s: float
    wall_s: float

    @property
    def dofs(self) -> int:
        return int(self.summary["mesh"]["dofs"])


class NothingLeft(RuntimeError):
    """A run left no results; the message has the reason."""


def run_model(
    case: Path,
    settings: Sequence[str],
    model: ModelName,
    refinement: float,
    folder: Path,
    say: Callable[[str], None] = print,
) -> ModelRun:
    """Run a case with one of the models, unless the folder has that run by the same sources.

    Raises
    ------
    NothingLeft
        If there is nothing to compare.
    """
    chosen = [*settings, f"model={model}", f"mesh.refinement={refinement:g}"]
    if model == "shell":
        chosen.append("solid=null")
    used, asked = folder / "usage.json", {"case": case.read_text(encoding="utf-8"), "settings": chosen}
    asked["sources"] = sources.ours()
    kept, known = _kept(used), None
    if kept.get("asked") == asked:
        try:
            known = read_summary(folder), read_lines(folder / "path.csv")
        except (OSError, Damaged) as e:
            say(f"{model} at refinement {refinement:g}: computed again, {e}")
    if not known:
        if kept and {**kept["asked"], "sources": asked["sources"]} == asked != kept["asked"]:
            why = "the folder has results of other sources of magshell_fenicsx"
            say(f"{model} at refinement {refinement:g}: computed again, {why}")
        sets = [part for setting in chosen for part in ("--set", setting)]
        name = _case_in(folder)
        if name and Path(name).stem != case.stem:
            raise CaseError(f"--out {folder.parent}: has a comparison of {name}, which is kept; give another folder")
        measured = measure("magshell_fenicsx", ["run", str(case), *sets, "--out", str(folder), "--overwrite"])
        if not (folder / "summary.json").exists() or measured.code not in (0, 3):
            errors = measured.errors.strip().splitlines()
            raise NothingLeft(f"model: {model}: {errors[-1] if errors else f'exit code {measured.code}'}")
        known = read_summary(folder), read_lines(folder / "path.csv")
        kept = {"asked": {**asked, "sources": known[0]["sources"]}, "cpu_s": measured.cpu_s, "wall_s": measured.wall_s}
        write_whole(used, (json.dumps(kept, indent=1) + "\n").encode())
    summary, rows = known
    compiling = float(summary["timing"]["jit_s"])
    return ModelRun(model, refinement, summary, rows, kept["cpu_s"] - compiling, kept["wall_s"] - compiling)


def _kept(file: Path) -> dict[str, Any]:
    """What usage.json says; empty if it is missing or damaged."""
    try:
        kept = read_object(file)
    except (OSError, Damaged):
        return {}
    sound = isinstance(kept.get("asked"), dict) and all(isinstance(kept.get(k), float) for k in ("cpu_s", "wall_s"))
    return kept if sound else {}


def _case_in(folder: Path) -> str:
    """The name of the case file whose run is in a folder; empty without."""
    with suppress(OSError, Damaged):
        return str((begun_with(folder / NAME) or read_object(folder / "summary.json")).get(FILE, ""))
    return ""
