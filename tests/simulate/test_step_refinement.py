"""The error of a whole motion against fixed, far finer steps, which come to SciPy's motion
(`test_semi_discrete.py`).

A departure from a fold magnifies the errors of steps, and so does one from a fold that a ramp
passes.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.advance import TimeSteps, advance
from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.continuation.transient import Integrator
from magshell_fenicsx.runs.rows import motion_errors
from magshell_fenicsx.runs.rows import rows as table_of
from magshell_fenicsx.shells.mass import mass
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Record

THICKNESS = 0.02
SHELL = {
    "geometry": "cap",
    "polar": 20,
    "radius": 1.0,
    "thickness": THICKNESS,
    "poisson_ratio": 0.3,
}
MESH = {"degree": 3, "refinement": 0.5}  # 58 unknowns
ROWS = 45  # of a snap, until it rings
END, TOP, DRAG = 60.0, 0.65, 0.3  # a ramp beyond the fold at 0.574
TOLERANCES = (1e-1, 1e-2, 1e-3)
Array = NDArray[np.float64]


def rows_of(step: dict[str, Any]) -> tuple[Scene, Record, list[Record]]:
    """With the last record before those in time."""
    sections = {
        "shell": SHELL,
        "boundary": {"rim": "clamped"},
        "symmetry": "axisymmetric",
        "mesh": MESH,
    }
    scene = Scene(Case.from_source(sections | {"loading": [step]}))
    records = list(follow(scene))
    moving = [
        record for record in records if record.clock and record.point.dmu
    ]  # not the equilibrium at rest
    return scene, records[records.index(moving[0]) - 1], moving


def snap(tolerance: float, **how: str) -> tuple[Scene, Record, list[Record]]:
    scene, fold, rows = rows_of(
        {
            "kind": "pressure",
            "until": "limit",
            "then": "snap",
            "snap": {"tolerance": tolerance, **how},
        }
    )
    return scene, fold, rows[:ROWS]


def ramp(tolerance: float, **how: str) -> tuple[Scene, Record, list[Record]]:
    history = {"pressure": {"kind": "ramp", "to": TOP, "over": END}}
    moving = {"kind": "time", "duration": END, "points": 30, "drag": DRAG, "history": history}
    return rows_of(moving | {"tolerance": tolerance, **how})


def exact(
    scene: Scene, u: Vector, drag: float, pressure: Callable[[float], float], times: list[float]
) -> Array:
    """From rest at u: the displacements in thicknesses, extrapolated to no step."""
    found = list[list[Vector]]()
    for parts in (32, 64):
        integrator = Integrator(
            scene.model.system,
            mass(scene.model),
            lambda t, before: {"pressure": pressure(t)},
            0.8,
            drag,
        )
        now, dt = integrator.begin(0.0, u, 0.0 * u), times[0] / parts
        found.append([])
        for t in times:
            now, _ = advance(integrator, now, t, TimeSteps(dt, 1.0, dt), dt)
            found[-1].append(now.u / THICKNESS)
    coarse, fine = np.array(found)
    assert np.abs(fine - coarse).max() < 2e-3  # so that the extrapolated one is right to some 1e-5
    return np.asarray((4 * fine - coarse) / 3)


def errors(rows: list[Record], reference: Array) -> Array:
    return np.array(
        [
            np.abs(row.point.state.u / THICKNESS - u).max()
            for row, u in zip(rows, reference, strict=True)
        ]
    )


@pytest.mark.slow
def test_the_error_of_a_snap_is_below_its_tolerance() -> None:
    """And the estimate is right within a factor of two; where steps have that error it is 30 times
    the tolerance.
    """
    scene, fold, rows = snap(1.0, errors="step")
    own = [
        mode.eigenvalue
        for mode in ShellModes(scene.model).lowest(fold.point.state, 3)
        if not mode.label
    ]
    away, p = scene.model.system.zero_at_supports(fold.point.du), fold.point.state.mu["pressure"]
    u = fold.point.state.u + 0.05 * THICKNESS * away / np.abs(away).max()
    times = [row.clock["time"] for row in rows]
    reference = exact(scene, u, 0.2 * float(np.sqrt(max(own[1:]))), lambda t: p, times)
    assert np.abs(reference[-1] - reference[0]).max() > 4
    for tolerance in TOLERANCES:
        _, _, rows = snap(tolerance)
        error = errors(rows, reference)
        assert tolerance / 10 < error.max() < tolerance
        assert 0.5 < max(row.point.error for row in rows) / error.max() < 2
    assert errors(snap(tolerance, errors="step")[2], reference).max() > 10 * tolerance


@pytest.mark.slow
def test_a_ramp_passes_a_fold() -> None:
    """Which it does late; the error of the whole motion is below the tolerance, or is said to be
    magnified.
    """
    scene, begin, rows = ramp(1e-2, errors="step")
    times = [row.clock["time"] for row in rows]
    (said,) = motion_errors(scene.problem.programme, table_of(scene, rows))
    assert said.startswith("step 1: it passes unstable states")
    reference = exact(scene, begin.point.state.u, DRAG, lambda t: TOP * t / END, times)
    assert np.abs(reference[-1]).max() > 2
    for tolerance in TOLERANCES:
        scene, _, rows = ramp(tolerance, errors="motion")
        assert not list(motion_errors(scene.problem.programme, table_of(scene, rows)))
        error = errors(rows, reference)
        assert error.max() < tolerance
        assert 0.5 < max(row.point.error for row in rows) / error.max() < 2
    assert errors(ramp(tolerance, errors="step")[2], reference).max() > tolerance
