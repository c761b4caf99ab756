"""CPU time of a point of a path in a shell's own field over that without: the hemisphere of
`own_field.yaml`, whole.

Points under pressure are counted up to the instability, and exact sums over pairs at each.

.ci/in-env sh -c 'OMP_NUM_THREADS=1 PYTHONPATH=cases python3 -m benchmarks.own_field --refinement
0.56'
"""

import argparse
import time
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from magshell_fenicsx.parts.magnetism.coulomb import InteractingCharges
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.follow import follow

CASE = Path(__file__).parents[1] / "own_field.yaml"


class AngleTerm:
    """Stands for `InteractingCharges.evaluate`, and counts its calls."""

    def __init__(self) -> None:
        self.count, self._evaluate = 0, InteractingCharges.evaluate

    def __get__(self, charged: InteractingCharges, _: type[InteractingCharges]) -> Any:
        def evaluate(*given: Any) -> Any:
            self.count += 1
            return self._evaluate(charged, *given)

        return evaluate


def seconds(case: dict[str, Any], points: int, counted: AngleTerm) -> list[float]:
    """Of each point under pressure."""
    found, history = list[float](), follow(Scene(case))
    while len(found) < points:
        before, count = time.process_time(), counted.count
        record = next(history, None)
        if record is None:
            break
        if pressure := record.point.state.mu["pressure"]:
            found.append(time.process_time() - before)
            print(
                f"{pressure:.6f} {found[-1]:8.3f} s {counted.count - count:4d} exact sums",
                flush=True,
            )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--refinement", type=float, default=0.56)
    parser.add_argument("--points", type=int, default=6)
    given, counted = parser.parse_args(), AngleTerm()
    InteractingCharges.evaluate = counted  # type: ignore[method-assign,assignment]
    case = yaml.safe_load(CASE.read_text(encoding="utf-8"))
    case |= {"symmetry": "none", "mesh": case["mesh"] | {"refinement": given.refinement}}
    alone = {key: value for key, value in case.items() if key != "magnetic"}
    one, other = (np.mean(seconds(each, given.points, counted)) for each in (case, alone))
    print(f"mean {one:.3f} s and {other:.3f} s: {one / other:.1f} times")


if __name__ == "__main__":
    main()
