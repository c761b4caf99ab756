"""One dimple at 40 degrees from the pole of a full shell, with and without edges of elements along
its rim.

`python3 -m benchmarks.rims` (with PYTHONPATH=cases) prints the table of docs/study/rims.md.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.mesh.shapes import DiscShape
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.follow import follow

CASE = Path(__file__).parents[1] / "dimple_buckling.yaml"
DIMPLES = ((1.64, 3.2), (4.0, 3.2), (1.64, 1.5))  # depth over h, width


def knockdown(
    depth: float, width: float, refinement: float, *settings: str, matched: bool
) -> float:
    """k_d of a dimple at 40 degrees; the shell is whole but for other `settings`."""
    dimple = f"{{kind: dimple, amplitude: {depth}, width: {width}, at: {{polar: 40}}}}"
    common = [f"shell.imperfections=[{dimple}]", f"mesh.refinement={refinement}", "symmetry=none"]
    case = Case.load(CASE, [*common, *settings])
    problem = make_problem(case)
    if not matched:
        assert isinstance(problem.shape, DiscShape)
        problem = replace(problem, shape=replace(problem.shape, rims=()))
    *_, last = follow(Scene(problem))
    return last.point.state.mu["pressure"]


def main(refinements: Sequence[float] = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0)) -> None:
    """Print k_d, the rim matched and not."""
    for depth, width in DIMPLES:
        for refinement in refinements:
            found = (
                knockdown(depth, width, refinement, matched=matched) for matched in (True, False)
            )
            print(depth, width, refinement, *(f"{k_d:.7f}" for k_d in found), flush=True)


if __name__ == "__main__":
    main()
