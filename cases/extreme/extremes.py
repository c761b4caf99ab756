"""The extremes: every case of cases/extreme/ in its variants, and a table of what became of each.

`make extremes`, or `python3 -m extreme.extremes [FAMILY]...`, writes docs/extremes/.
"""

import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from extreme.extremes_table import Line, cells, write
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path as EquilibriumPath
from magshell_fenicsx.continuation.point import PathStopped, StepOptions
from magshell_fenicsx.continuation.system import State, dot
from magshell_fenicsx.mesh.grading import Grading
from magshell_fenicsx.mesh.shapes import StripShape
from magshell_fenicsx.public import run
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.simulate.scene import build_model

CASES = Path(__file__).parent
OUT = CASES.parents[1] / "docs" / "extremes"
FINER = (
    "mesh.degree=5",
    "mesh.refinement=2",
)  # of the solution that one without a reference is compared with
LIMIT = 300.0  # seconds for a row


@dataclass(frozen=True)
class Variant:
    """A row of the table.

    Attributes
    ----------
    settings
        As of `--set`.
    value
        "first": of the first instability; "fold": of the first fold; or a column of path.csv, at
        the end.
    reference
        Of the value, from an independent solver; None compares with a finer mesh of higher degree.
    against
        The case that is run on the finer mesh, if it is another.
    """

    case: str
    settings: tuple[str, ...] = ()
    value: str = "first"
    reference: float | None = None
    against: str = ""


def _varied(
    case: str, key: str, references: dict[float, float | None], *others: str
) -> list[Variant]:
    return [
        Variant(case, (f"{key}={number:g}", *others), reference=r)
        for number, r in references.items()
    ]


LAMBDA, NU, THICKNESS, PENALTY = (
    "magnetic.lambda_m",
    "shell.poisson_ratio",
    "shell.radius_to_thickness",
    "mesh.penalty",
)
HALF = ("symmetry=half", "mesh.refinement=0.6")
CLASSICAL, FIELD, DIMPLE = (
    "loading={kind: pressure}",
    "magnetic={lambda_m: 0.00184}",
    "shell.defect={kind: dimple, amplitude: 1.64, width: 3.2}",
)
K_D = 0.326233289  # R/h = 90, nu = 0.5, delta/h = 1.64: axisymmetric, nine digits
VARIANTS = [
    *_varied(
        "thickness",
        THICKNESS,
        {20: None, 90: None, 300: None, 1000: 0.325723564, 3000: None, 10000: None},
    ),
    *_varied("thickness", THICKNESS, {1000: 0.325723564}, *HALF),
    *_varied("beyond", THICKNESS, {1000: 0.325723564}),
    *(
        Variant("beyond", (f"{THICKNESS}={number}",), against="thickness")
        for number in (3000, 10000)
    ),
    *_varied("poisson", NU, {-0.9: None, 0: None, 0.3: None, 0.5: K_D}),
    *_varied("poisson", NU, {-0.9: None}, *HALF),
    *_varied(
        "dimple",
        "shell.defect.amplitude",
        {0.01: None, 0.1: None, 0.5: None, 1.64: K_D, 3: None, 6: None},
    ),
    *_varied("field", LAMBDA, {-0.02: -0.0033554, -0.005: -0.0033554, -0.00184: 0.120723848}),
    *_varied("field", LAMBDA, {0.00184: 0.552053778, 0.01: None, 0.05: None}),
    *_varied("critical_field", NU, {0.3: -0.000946554, 0.5: -0.001042}),
    Variant("inside_out", value="fold"),
    Variant("inside_out", ("loading.control=displacement",), "fold"),
    Variant("inside_out", ("loading.patch=0",), "fold"),
    *_varied("penalty", PENALTY, dict.fromkeys((0.1, 1, 10, 100, 1e3, 1e4, 1e5, 1e6, 1e7), K_D)),
    *_varied("penalty", PENALTY, dict.fromkeys((1, 10, 1e3, 1e5), K_D), *HALF),
    Variant("nothing", (), "w_pole_over_h", 0.0),
    Variant("nothing", (CLASSICAL,)),
    Variant("nothing", (FIELD,), "w_pole_over_h"),
    Variant("nothing", (DIMPLE,), "w_pole_over_h", 0.0),
    Variant("nothing", (CLASSICAL, FIELD)),
    Variant("nothing", (DIMPLE, FIELD), "w_pole_over_h"),
    Variant("nothing", (CLASSICAL, DIMPLE), reference=K_D),
    Variant("nothing", (CLASSICAL, DIMPLE, FIELD), reference=0.552053778),
]
ASPECTS = [(1.0, "along"), (10.0, "along"), (50.0, "along"), (50.0, "across")]
TIP = 0.66996  # of the elastica at q = 4, over its length


def line(variant: Variant) -> Line:
    """Run a variant, and the finer solution that it is compared with."""
    start = time.perf_counter()
    result = run(Case.load(CASES / f"{variant.case}.yaml", variant.settings), time_limit=LIMIT)
    seconds = time.perf_counter() - start
    found, reference, source = value_of(result, variant.value), variant.reference, "reference"
    if reference is None and found is not None:
        finer = Case.load(
            CASES / f"{variant.against or variant.case}.yaml", (*variant.settings, *FINER)
        )
        reference, source = value_of(run(finer, time_limit=LIMIT), variant.value), "finer mesh"
    newton, scene = result.scene.newton, result.scene
    steps = [
        row
        for row in result.rows
        if row["label"] in ("start", "field", "step") and not row["branch"]
    ]
    return Line(
        family=variant.case,
        variant=", ".join(variant.settings),
        outcome=outcome(result),
        value=found,
        reference=reference,
        source=source if reference is not None else "",
        points=len(result.rows),
        iterations=sum(int(row["iterations"]) for row in result.rows),
        factorisations=newton.factorisation.count,
        smallest_step=smallest([float(row["w_pole_over_h"]) for row in steps]),
        condition_undeformed=condition(newton, scene.unloaded()),
        condition_last=condition(newton, result.last),
        unknowns=scene.model.system.dofs,
        seconds=seconds,
    )


def slivers(aspect: float, way: str) -> Line:
    """The strip with its triangles stretched along or across it: the problem with another chart."""
    start = time.perf_counter()
    case = Case.load(CASES / "slivers.yaml")
    problem, target = make_problem(case), case.lambda_m
    assert case.width
    stretch = aspect if way == "along" else 1 / aspect
    # as many triangles along the strip as across, but for the stretch
    size = 0.25 if way == "along" and aspect > 1 else min(0.05, 2 * case.width / aspect)
    shape = StripShape(case.width * stretch, half=False)
    problem = replace(problem, shape=shape, size=Grading([], size), embedding=_Stretched(stretch))
    model = build_model(problem, MPI.COMM_WORLD)
    newton = BorderedNewton(model.system)
    path = EquilibriumPath(
        newton, "lambda_m", "load", StepOptions(target / 4, target, 1e-4 * target)
    )
    unloaded = State(model.zero(), {"lambda_m": 0.0})
    points, said = [path.start(unloaded)], "reached"
    try:
        points += [point for point, _ in path.continue_to(points[0], [target])]
    except PathStopped as e:
        said = f"stopped: {e}"
    last = points[-1].state
    tip = float(model.displacement(last.u, "pole")[2]) if said == "reached" else None
    step = smallest(
        [model.deflection(point.state.u, "pole") / problem.material.h for point in points]
    )
    seconds = time.perf_counter() - start
    return Line(
        family="slivers",
        variant=f"aspect {aspect:g} {way} the strip",
        outcome=said,
        value=tip,
        reference=TIP,
        source="reference",
        points=len(points),
        iterations=sum(point.iterations for point in points),
        factorisations=newton.factorisation.count,
        smallest_step=step,
        condition_undeformed=condition(newton, unloaded),
        condition_last=condition(newton, last),
        unknowns=model.system.dofs,
        seconds=seconds,
    )


@dataclass(frozen=True)
class _Stretched:
    """Chart (x, y) -> (x, y/stretch, 0)."""

    stretch: float

    def __call__(self, chart: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.column_stack([chart[:, 0], chart[:, 1] / self.stretch, 0 * chart[:, 0]])


def value_of(result: Result, name: str) -> float | None:
    """The number of a run that its row compares; None if there is none."""
    if int(result.rows[0]["negative_pivots"]):
        return None  # see `outcome`
    if name not in ("first", "fold"):
        return float(result.rows[-1][name])
    kinds = ("fold",) if name == "fold" else ("fold", "bifurcation")
    return next(
        (float(point["value"]) for point in result.limit_points if point["kind"] in kinds), None
    )


def outcome(result: Result) -> str:
    """What became of a run: reached or stopped, why, and the instabilities on the way."""
    undeformed = int(result.rows[0]["negative_pivots"])
    if undeformed:
        return f"no result: the undeformed shell has {undeformed} unstable directions"
    met = ", ".join(
        f"{point['mode'] + ' ' if point['mode'].startswith('m') else ''}{point['kind']} at "
        f"{'p/p_c' if point['amplitude'] == 'pressure' else point['amplitude']} = "
        f"{point['value']:.5g}"
        for point in result.limit_points
    )
    said = f"stopped: {result.stopped}" if result.stopped else "reached"
    return f"{said}{'; ' if met else ''}{met}"


def smallest(w_over_h: Sequence[float]) -> float | None:
    """The smallest step of the pole."""
    return min((float(d) for d in np.abs(np.diff(w_over_h))), default=None)


def condition_estimate(
    factors: Factorisation, size: int, comm: MPI.Comm, iterations: int = 30
) -> float:
    """Largest over smallest |eigenvalue| of the matrix last factored; a lower bound, good to some
    per cent.

    Parameters
    ----------
    size
        Unknowns on this rank.
    iterations
        Power iterations for the largest eigenvalue, and inverse iterations for the smallest.
    """
    largest, inverse = 0.0, 0.0
    a = b = np.sin(1.0 + np.arange(size) + comm.rank)
    for _ in range(iterations):
        a, b = a / np.sqrt(dot(comm, a, a)), b / np.sqrt(dot(comm, b, b))
        a, b = factors.times(a), factors.solve(b)
        largest, inverse = np.sqrt(dot(comm, a, a)), np.sqrt(dot(comm, b, b))
    return float(largest * inverse)


def condition(newton: BorderedNewton, state: State) -> float:
    """Of the tangent at a state."""
    return condition_estimate(newton.factor_at(state), state.u.size, newton.system.comm)


def main(families: Sequence[str]) -> None:
    """Run the families, all if none is named; collective. The table is written of all together."""
    first, lines = MPI.COMM_WORLD.rank == 0, []

    def add(made: Line) -> None:
        lines.append(made)
        if first:
            print(*cells(made), sep="  ", flush=True)

    for variant in VARIANTS:
        if not families or variant.case in families:
            add(line(variant))
    for aspect, way in ASPECTS:
        if not families or "slivers" in families:
            add(slivers(aspect, way))
    if first and not families:
        write(lines, OUT)


if __name__ == "__main__":
    main(sys.argv[1:])
