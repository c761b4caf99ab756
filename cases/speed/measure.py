"""Measuring one benchmark: every repeat a process of its own."""

import json
from contextlib import nullcontext
from tempfile import TemporaryDirectory
from typing import Any

from speed.items import CASES, WITH_CAMPAIGNS, Item

from magshell_fenicsx.platform.processes import Usage, measure

Numbers = dict[str, list[float]]


class BenchFailed(RuntimeError):
    """A benchmark ended without a result; the message has what it said."""


def measure_item(item: Item) -> Numbers:
    """Every number of a benchmark, once for each repeat; its kernels are compiled before.

    Raises
    ------
    BenchFailed
        If a run fails or does not reach its target.
    """
    if not item.cold:
        _run(Item("kernels", item.case, (*item.settings, "mesh.refinement=0.3")), None)
    numbers: Numbers = {}
    for _ in range(item.repeat):
        with TemporaryDirectory() if item.cold else nullcontext() as cache:
            for key, value in _run(item, cache).items():
                numbers.setdefault(key, []).extend(value if isinstance(value, list) else [value])
    return numbers


def _run(item: Item, cache: str | None) -> dict[str, Any]:
    case, environment = str(CASES / f"{item.case}.yaml"), {"XDG_CACHE_HOME": cache} if cache else {}
    if item.kind == "run":
        settings = [word for setting in item.settings for word in ("--set", setting)]
        with TemporaryDirectory() as out:
            used = _checked(
                measure("magshell_fenicsx", ["run", case, *settings, "--out", out], item.ranks)
            )
        return _process(used)
    arguments = [item.kind, case, json.dumps(item.settings), json.dumps(list(item.references))]
    used = _checked(measure("speed.workload", arguments, item.ranks, WITH_CAMPAIGNS | environment))
    report = json.loads(
        next(line for line in used.output.splitlines() if line.startswith("{"))
    )  # MPI may say more
    values, stopped = report.pop("values", {}), report.pop("stopped", None)
    if stopped or None in values.values():
        raise BenchFailed(f"stopped early: {stopped}")
    errors = [abs(values[name] / reference - 1) for name, reference in item.references.items()]
    return {**report, **({"error": max(errors)} if errors else {}), **_process(used)}


def _checked(used: Usage) -> Usage:
    if used.code:
        raise BenchFailed(f"exit code {used.code}: {used.errors.strip()}")
    return used


def _process(used: Usage) -> dict[str, float]:
    """What the whole process took, the start of Python included."""
    memory = {} if used.peak_mb is None else {"peak_mb": used.peak_mb}
    return {"process_wall_s": used.wall_s, "process_cpu_s": used.cpu_s, **memory}
