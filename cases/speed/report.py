"""What the measured numbers say: ratios in one benchmark, against an earlier one, and a table."""

from collections.abc import Mapping
from itertools import pairwise
from math import log
from statistics import median
from typing import Any

from speed.items import ITERATIONS, K_D_20_000, ONE_RANK, TWO_RANKS

from magshell_fenicsx.platform.environment import describe_machine

MARKED = 1.2  # ratios beyond it, up or down
PIECES = ("tangent", "factor", "back_solves", "residual")
TABLE = {  # column -> key, form
    "unknowns": ("dofs", ".0f"),
    "error": ("error", ".1e"),
    "solve phase, CPU (s)": ("solve_phase_cpu_s", ".2f"),
    "factorisations": ("factorisations", ".0f"),
    "iterations": ("iterations", ".0f"),
    "tangent, CPU (s)": ("tangent_cpu_s", ".3f"),
    "factorisation, CPU (s)": ("factor_cpu_s", ".3f"),
    "two back-solves, CPU (s)": ("back_solves_cpu_s", ".3f"),
    "residual, CPU (s)": ("residual_cpu_s", ".4f"),
    "kernels, wall (s)": ("jit_s", ".2f"),
    "process, CPU (s)": ("process_cpu_s", ".2f"),
    "process, wall (s)": ("process_wall_s", ".2f"),
    "peak (MB)": ("peak_mb", ".0f"),
}


def derived(items: Mapping[str, Any]) -> dict[str, float]:
    """Ratios within one benchmark, which need no second machine: those that the items measured
    allow.
    """

    def of(name: str, *keys: str) -> float:
        return float(sum(items[name][key]["median"] for key in keys))

    found = {}
    if K_D_20_000 in items:
        work = of(K_D_20_000, "factor_wall_s", "back_solve_wall_s")
        found["share of factorisation and back-solve in the solve phase at 20 000 unknowns"] = (
            work / of(K_D_20_000, "solve_phase_wall_s")
        )
    if ONE_RANK in items and TWO_RANKS in items:
        one, two = (
            of(name, *(f"{piece}_wall_s" for piece in PIECES)) for name in (ONE_RANK, TWO_RANKS)
        )
        found["2 ranks against 1, iteration at 100 000 unknowns"] = one / two
    for small, large in pairwise(ITERATIONS):
        if small in items and large in items:
            times = [of(name, *(f"{piece}_cpu_s" for piece in PIECES)) for name in (small, large)]
            power = log(times[1] / times[0]) / log(of(large, "dofs") / of(small, "dofs"))
            first, last = (name.removeprefix("iteration ") for name in (small, large))
            found[f"power of the unknowns that an iteration grows with, {first} to {last}"] = power
    return found


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
        lines += [
            f"new: {describe_machine(new['machine'])}",
            f"old: {describe_machine(old['machine'])}",
        ]
        lines.append(
            "Not the same machine or versions: times are divided by their median ratio "
            f"{scale:.3g}."
        )
    for (name, key), ratio in ratios.items():
        ratio /= scale if key.endswith("_s") else 1.0
        mark = "  more" if ratio > MARKED else "  less" if ratio < 1 / MARKED else ""
        lines.append(f"{name:26} {key:20} {ratio:8.3f}{mark}")
    return lines


def table(found: Mapping[str, Any]) -> str:
    """The benchmark in Markdown, for people: medians, then what is derived."""
    lines = [["", *TABLE], ["---"] * (len(TABLE) + 1)]
    for name, numbers in found["items"].items():
        values = [
            format(numbers[key]["median"], form) if key in numbers else ""
            for key, form in TABLE.values()
        ]
        lines.append([name, *values])
    rows = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    ratios = "\n".join(f"- {name}: {value:.3g}" for name, value in found["derived"].items())
    return (
        f"# Numbers of the benchmark\n\nMedians on {describe_machine(found['machine'])}.\n\n"
        f"{rows}\n\n{ratios}\n"
    )
