"""The benchmark: a fixed set of runs, for comparison with an earlier one on the same machine.

`make bench`, or `python3 -m magshell_fenicsx.bench [ITEM]... [--out FILE.json] [--compare OLD.json]`.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any, Literal

from magshell_fenicsx.results.durable import write_whole
from magshell_fenicsx.study.machine import described, fingerprint
from magshell_fenicsx.study.measure import Usage, measure

CASES, OUT = Path(__file__).parents[1] / "cases", Path("results") / "bench.json"
MARKED = 1.2  # ratios beyond it, up or down

# F R/(2 pi D) at w/h, lambda_m = +0.00184: hybridised Hellan-Herrmann-Johnson elements, two meshes within 1.8e-4
FORCES = {"1": 3.0565, "5": 8.2762, "10": 15.1470, "15": 21.603, "20": 27.528}
INDENTATION = {f"force@w_over_h={w}": F for w, F in FORCES.items()}
K_D = {"knockdown": 0.326233289}  # axisymmetric solver, nine digits
TILTED_K_D = {"knockdown": 0.49154026}  # our own of degree 5: no other solver is at hand
COARSE = "mesh.refinement=0.8"  # largest error at the five depths 6e-4; 3.5e-3 at 0.7, 7e-3 at 0.6
TILTED = "magnetic={lambda_m: 0.00184, remanent: {polar: 45}, applied: {polar: 45}}"
FIELD = "magnetic.lambda_m=0.00184"
K_D_20_000, ONE_RANK, TWO_RANKS = "k_d 20 000", "tangent 100 000", "tangent 100 000, 2 ranks"
HALF = ("symmetry=half", FIELD)

Kind = Literal["path", "run", "tangent", "kernels"]
Numbers = dict[str, list[float]]


@dataclass(frozen=True)
class Item:
    """One benchmark.

    Attributes
    ----------
    kind
        "run": all of `magshell run`; else a piece of it without files, see `study.workload`.
    references
        Name of a result -> its value from elsewhere; the largest relative error is noted.
    cold
        In an empty kernel cache.
    """

    kind: Kind
    case: str
    settings: tuple[str, ...] = ()
    references: Mapping[str, float] = field(default_factory=dict)
    ranks: int = 1
    repeat: int = 3
    cold: bool = False


ITEMS = {
    "indentation": Item("path", "indentation", (), INDENTATION),
    "indentation, whole": Item("run", "indentation"),
    "indentation 2e-3": Item("path", "indentation", (COARSE,), INDENTATION),
    "indentation 2e-3, whole": Item("run", "indentation", (COARSE,)),
    "k_d tilted": Item("path", "dimple_buckling", (TILTED, "mesh.refinement=0.5"), TILTED_K_D),
    "k_d meridian": Item("path", "dimple_buckling", (), K_D),
    "k_d meridian, whole": Item("run", "dimple_buckling"),
    K_D_20_000: Item("path", "dimple_buckling", (*HALF, "mesh.refinement=1.5"), {"knockdown": 0.552053778}, repeat=1),
    "tangent 5 000": Item("tangent", "dimple_buckling", (*HALF, "mesh.refinement=0.5"), repeat=1),
    "tangent 20 000": Item("tangent", "dimple_buckling", (*HALF, "mesh.refinement=1.5"), repeat=1),
    "tangent 60 000": Item("tangent", "dimple_buckling", (*HALF, "mesh.refinement=3"), repeat=1),
    ONE_RANK: Item("tangent", "dimple_buckling", (*HALF, "mesh.refinement=4"), repeat=1),
    TWO_RANKS: Item("tangent", "dimple_buckling", (*HALF, "mesh.refinement=4"), ranks=2, repeat=1),
    "kernels, cold": Item("kernels", "indentation", ("mesh.refinement=0.3",), repeat=2, cold=True),
}


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
    case, environment = str(CASES / f"{item.case}.yaml"), {"XDG_CACHE_HOME": cache} if cache else None
    if item.kind == "run":
        settings = [word for setting in item.settings for word in ("--set", setting)]
        with TemporaryDirectory() as out:
            used = _checked(measure("magshell_fenicsx", ["run", case, *settings, "--out", out], item.ranks))
        return _process(used)
    arguments = [item.kind, case, json.dumps(item.settings), json.dumps(list(item.references))]
    used = _checked(measure("magshell_fenicsx.study.workload", arguments, item.ranks, environment))
    report = json.loads(next(line for line in used.output.splitlines() if line.startswith("{")))  # MPI may say more
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


def bench(items: Mapping[str, Item], file: Path) -> dict[str, Any]:
    """Measure a set of benchmarks into a JSON file, which is written after each; its content.

    Raises
    ------
    BenchFailed
        At the first that fails; those before it are in the file.
    """
    found: dict[str, Any] = {"machine": fingerprint(), "items": {}}
    for name, item in items.items():
        print(f"{name} ...", flush=True)
        numbers = measure_item(item)
        entry = {key: {"median": median(values), "all": values} for key, values in numbers.items()}
        print("  " + ", ".join(f"{key} {median(values):.4g}" for key, values in numbers.items()), flush=True)
        found["items"][name] = entry
        found["derived"] = derived(found["items"])
        write_whole(file, (json.dumps(found, indent=1) + "\n").encode())
    return found


def derived(items: Mapping[str, Any]) -> dict[str, float]:
    """Ratios within one benchmark, which need no second machine: those that the items measured allow."""

    def of(name: str, *keys: str) -> float:
        return float(sum(items[name][key]["median"] for key in keys))

    ratios = {}
    if K_D_20_000 in items:
        work = of(K_D_20_000, "factor_wall_s", "back_solve_wall_s")
        ratios["share of factorisation and back-solve in the solve phase at 20 000 unknowns"] = work / of(
            K_D_20_000, "solve_phase_wall_s"
        )
    if ONE_RANK in items and TWO_RANKS in items:
        iteration = ("tangent_wall_s", "factor_wall_s")
        ratios["2 ranks against 1, tangent and factorisation at 100 000 unknowns"] = of(ONE_RANK, *iteration) / of(
            TWO_RANKS, *iteration
        )
    return ratios


def compare(new: Mapping[str, Any], old: Mapping[str, Any]) -> list[str]:
    """Ratios new/old of all medians that both have, for people; those beyond `MARKED` are marked.

    On another machine times are divided by the median of their ratios: what is left is what changed
    more or less than the machine did.
    """
    ratios = {
        (name, key): entry["median"] / there["median"]
        for name, numbers in new["items"].items()
        for key, entry in numbers.items()
        if (there := old["items"].get(name, {}).get(key)) and there["median"]
    }
    lines, scale = [], 1.0
    if new["machine"] != old["machine"]:
        scale = median([ratio for (_, key), ratio in ratios.items() if key.endswith("_s")] or [1.0])
        lines += [f"new: {described(new['machine'])}", f"old: {described(old['machine'])}"]
        lines.append(f"Not the same machine or versions: times are divided by their median ratio {scale:.3g}.")
    for (name, key), ratio in ratios.items():
        ratio /= scale if key.endswith("_s") else 1.0
        mark = "  more" if ratio > MARKED else "  less" if ratio < 1 / MARKED else ""
        lines.append(f"{name:26} {key:20} {ratio:8.3f}{mark}")
    return lines


def main(words: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(prog="magshell_fenicsx.bench", description="the fixed benchmark set")
    parser.add_argument("item", nargs="*", help=f"all by default; of {', '.join(ITEMS)}")
    parser.add_argument("--out", type=Path, default=OUT, help=f"default {OUT}")
    parser.add_argument("--compare", type=Path, metavar="OLD.json", help="print ratios new/old")
    given = parser.parse_args(words)
    if unknown := [name for name in given.item if name not in ITEMS]:
        parser.error(f"no item {unknown[0]!r}; there are {', '.join(ITEMS)}")
    try:
        old = json.loads(given.compare.read_text(encoding="utf-8")) if given.compare else None
    except (OSError, ValueError) as e:
        parser.error(f"--compare {given.compare}: {e}")
    try:
        given.out.parent.mkdir(parents=True, exist_ok=True)
        found = bench({name: ITEMS[name] for name in given.item or ITEMS}, given.out)
    except (OSError, BenchFailed) as e:
        sys.exit(f"bench: {e}")
    print(*(f"{value:.3g}  {name}" for name, value in found["derived"].items()), sep="\n")
    print(f"written to {given.out}")
    print(*(compare(found, old) if old else []), sep="\n")


if __name__ == "__main__":
    main(sys.argv[1:])
