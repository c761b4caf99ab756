"""Every case under noise: make noise ARGS="[--seeds 20] [--seconds 60] [CASE ...]"

The noise (`assembly/evaluation.py`) stands for the rounding of another processor, at 1e-15, 1e-14
and 1e-13 in turn. A case should reach the same end through the same instabilities, with numbers
within their estimated errors.
"""

import argparse
import os
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import magshell_fenicsx as ms
from magshell_fenicsx.assembly.evaluation import NOISE_VARIABLE
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.continuation.snes import LENGTH_PER_DISPLACEMENT
from magshell_fenicsx.continuation.system import max_abs

LEVELS = 1e-15, 1e-14, 1e-13
COARSE = ["mesh.degree=3", "mesh.refinement=0.5"], ["mesh.refinement=0.5"], ["mesh.degree=3"]
LOCATED = "fold", "bifurcation"
FLOOR = 1e-8  # relative: an instability is located to this where its own estimate is smaller
HEAD = """# All cases under noise

Relative noise of 1e-15, 1e-14 and 1e-13 in residual and tangent, in turn, \
each evaluation with other numbers
(`cases/noise/table.py`). *Instabilities* counts the seeds with the same instabilities, \
of the same kinds, in the same
order; *load* is the largest deviation of their loads over the sum of both estimated errors, \
*u* that of the
displacements at the points asked for.

| case | seeds | same end | same instabilities | load | u |
| --- | --- | --- | --- | --- | --- |"""


@dataclass(frozen=True)
class Outcome:
    """What a run came to: its records, and why it stopped, without the numbers."""

    scene: ms.Scene
    records: Sequence[ms.Record]
    stopped: bool

    @property
    def end(self) -> tuple[str, str, bool]:
        return self.records[-1].label, self.records[-1].mode, self.stopped

    @property
    def instabilities(self) -> list[ms.Record]:
        return [r for r in self.records if r.label in LOCATED]

    @property
    def targets(self) -> list[ms.Record]:
        return [r for r in self.records if r.label == "target"]


def followed(case: ms.Case, noise: str) -> Outcome:
    """Follow a case with noise, "" for none."""
    os.environ[NOISE_VARIABLE] = noise
    scene, records = ms.Scene(case), list[ms.Record]()
    history = ms.follow(scene)
    while True:
        try:
            records.append(next(history))
        except StopIteration:
            return Outcome(scene, records, stopped=False)
        except ms.Stopped:
            return Outcome(scene, records, stopped=True)


def load_ratio(a: ms.Record, b: ms.Record) -> float:
    """The deviation of an instability's load over its estimated error."""
    here, there = (abs(r.point.state.mu.get(r.amplitude, 0.0)) for r in (a, b))
    error = a.point.load_error + b.point.load_error + FLOOR * max(here, there)
    return abs(here - there) / error if error else 0.0


def u_ratio(a: ms.Record, b: ms.Record, scene: ms.Scene) -> float:
    """The same of the displacement at a point that was asked for."""
    length = scene.model.system.length
    moved = max_abs(scene.comm, a.point.state.u - b.point.state.u) / length
    scale = max(
        1.0, LENGTH_PER_DISPLACEMENT * max_abs(scene.comm, a.point.state.u) / length
    )  # as points are accepted
    tolerance = scene.newton.options.tolerance * scale
    return moved / (a.point.error + b.point.error + tolerance)


def loaded(file: Path, coarse: bool) -> ms.Case:
    """A case, with as coarse a mesh as its kind can have."""
    for settings in (*(COARSE if coarse else ()), ()):
        with suppress(ms.CaseError):
            case = ms.Case.load(file, settings)
            make_problem(case)
            return case
    return ms.Case.load(file)


def row(file: Path, seeds: int, seconds: float, coarse: bool) -> str:
    """A case's row of the table; as many seeds as the time allows, three at least."""
    case, start = loaded(file, coarse), time.perf_counter()
    clean = followed(case, "")
    ends = same = done = 0
    load = u = 0.0
    for seed in range(1, seeds + 1):
        if done >= len(LEVELS) and time.perf_counter() - start > seconds:
            break
        noisy = followed(case, f"{LEVELS[seed % len(LEVELS)]} {seed}")
        done, ends = done + 1, ends + (noisy.end == clean.end)
        kinds = [[(r.label, r.branch) for r in o.instabilities] for o in (clean, noisy)]
        if kinds[0] == kinds[1]:
            same += 1
            pairs = zip(clean.instabilities, noisy.instabilities, strict=True)
            load = max([load, *(load_ratio(a, b) for a, b in pairs)])
        if len(clean.targets) == len(noisy.targets):
            u = max(
                [
                    u,
                    *(
                        u_ratio(a, b, clean.scene)
                        for a, b in zip(clean.targets, noisy.targets, strict=True)
                    ),
                ]
            )
    return f"| {file.stem} | {done} | {ends} | {same} | {load:.2g} | {u:.2g} |"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument(
        "--coarse",
        action="store_true",
        help="degree 3 and twice the element size, where there is one",
    )
    parser.add_argument("cases", nargs="*", type=Path)
    given = parser.parse_args()
    folder = Path(__file__).parents[1]
    every = [
        file
        for pattern in ("*.yaml", "benchmarks/*.yaml", "extreme/*.yaml")
        for file in sorted(folder.glob(pattern))
    ]
    print(HEAD)
    for file in given.cases or every:
        print(row(file, given.seeds, given.seconds, given.coarse), flush=True)


if __name__ == "__main__":
    main()
