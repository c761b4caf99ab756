"""The benchmark: a fixed set of runs, for comparison with an earlier one.

`make bench`, or `python3 cases/speed [ITEM]... [--out FILE.json] [--compare OLD.json]`.
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from speed.items import ITEMS, Item
from speed.measure import BenchFailed, measure_item
from speed.report import compare, derived, table

from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.platform.environment import machine_fingerprint

OUT = Path("results") / "bench.json"


def bench(items: Mapping[str, Item], file: Path) -> dict[str, Any]:
    """Measure a set of benchmarks into a JSON file, which is written after each, and a table beside
    it; its content.

    Raises
    ------
    BenchFailed
        At the first that fails; those before it are in the file.
    """
    found: dict[str, Any] = {"machine": machine_fingerprint(), "items": {}}
    for name, item in items.items():
        print(f"{name} ...", flush=True)
        numbers = measure_item(item)
        entry = {key: {"median": median(values), "all": values} for key, values in numbers.items()}
        print(
            "  " + ", ".join(f"{key} {median(values):.4g}" for key, values in numbers.items()),
            flush=True,
        )
        found["items"][name] = entry
        found["derived"] = derived(found["items"])
        write_whole(file, (json.dumps(found, indent=1) + "\n").encode())
        write_whole(file.with_suffix(".md"), table(found).encode())
    return found


def main(words: Sequence[str]) -> None:
    parser = argparse.ArgumentParser(prog="speed", description="the fixed benchmark set")
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
