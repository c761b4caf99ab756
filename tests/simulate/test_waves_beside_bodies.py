"""Waves around the axis beside a body: the same shell without it, and the half shell that has the waves itself."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.control import GivenLoad
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene

SHELL = {
    "shell": {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.3},
    "boundary": {"equator": "clamped"},
    "mesh": {"degree": 4},
}
PRESSURE = {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.84, "points": 2}
APART = {
    "stop": {"kind": "sphere", "radius": 0.05, "side": "inside", "at": {"polar": 0}, "position": [0, 0, 0.7]},
}


def rows(**sections: object) -> list[Record]:
    return list(follow(Scene(Case.from_source(Source("test", {**SHELL, **sections})))))


def seen(records: list[Record]) -> list[tuple[str, float, str, int]]:
    return [(r.label, round(r.point.state.mu["pressure"], 7), r.mode, r.excluded_pivots) for r in records]


def test_a_body_that_touches_nothing_changes_no_row() -> None:
    """Rows in their order, the target last, with every unstable wave."""
    free = seen(rows(loading=PRESSURE))
    assert seen(rows(loading=PRESSURE, bodies=APART)) == free
    assert [label for label, *_ in free].count("bifurcation") == free[-1][-1] == 4
    assert free[-1][0] == "target"


def test_until_bifurcation_ends_at_the_first() -> None:
    *_, last = rows(loading={"kind": "pressure", "control": "load", "until": "bifurcation"}, bodies=APART)
    assert (last.label, last.mode) == ("bifurcation", "m = 6")
    assert last.point.state.mu["pressure"] == pytest.approx(0.7828, abs=2e-3)


@pytest.mark.slow
def test_a_half_shell_under_a_plate_has_every_wave_twice() -> None:
    """One of each pair of waves is symmetric, the other is excluded."""
    steps = [{"kind": "contact", "approach": 0.3, "points": 1}, PRESSURE]
    sections = {**SHELL, "bodies": {"plate": {"kind": "plane"}}, "loading": steps}
    meridian, half = (Scene(Case.from_source(Source("test", sections | {"symmetry": s}))) for s in ("auto", "half"))
    *_, last = follow(meridian)
    symmetric, antisymmetric = waves_of_half(meridian, half, last)
    assert last.excluded_pivots == antisymmetric == symmetric == 4


@pytest.mark.slow
def test_a_magnet_over_gas_leaves_a_half_as_many_waves() -> None:
    """The gas holds the axisymmetric motion alone, the waves are counted at its pressure; 5 at the end, 4 before."""
    shell = {"geometry": "hemisphere", "radius": "20 mm", "thickness": "1 mm", "youngs_modulus": "1 MPa"}
    magnet = {"kind": "cylinder", "diameter": "20 mm", "height": "10 mm", "polarization": "1.2 T"}
    field = {"sources": [magnet | {"position": ["0 mm", "0 mm", "32 mm"]}]}
    gas = {"pressure": {"gas": {"ambient_over_pc": 3}}}
    sections = {
        **SHELL,
        "shell": {**shell, "poisson_ratio": 0.3},
        "magnetic": {"remanent": {"flux_density": "80 mT"}, "applied": field},
        "loading": [PRESSURE, {"kind": "field", "factor": 1.3, "points": 2, "hold": gas}],
    }
    meridian, half = (Scene(Case.from_source(Source("test", sections | {"symmetry": s}))) for s in ("auto", "half"))
    targets = [record for record in follow(meridian) if record.label == "target"][-3:]
    assert [record.excluded_pivots for record in targets] == [4, 4, 5]
    for record in targets:
        assert waves_of_half(meridian, half, record) == (record.excluded_pivots, record.excluded_pivots)


def waves_of_half(meridian: Scene, half: Scene, last: Record) -> tuple[int, int]:
    """Unstable waves of a half at a state of the meridian: those that it has itself, and those that it excludes."""
    state = last.point.state
    rho, z = meridian.model.r0.x.array.reshape(-1, 2).T
    order = np.argsort(np.arctan2(rho, z))
    along = CubicSpline(np.arctan2(rho, z)[order], state.u.reshape(-1, 2)[order])
    x = half.model.r0.x.array.reshape(-1, 3)
    U, W = along(np.arctan2(np.hypot(x[:, 0], x[:, 1]), x[:, 2])).T
    theta = np.arctan2(x[:, 1], x[:, 0])
    u = np.column_stack([U * np.cos(theta), U * np.sin(theta), W]).ravel()
    guess = State(half.model.system.held(u[: half.model.system.size]), {**half.unloaded().mu, **state.mu})
    solved = half.newton.solve(guess, "pressure", GivenLoad("pressure", state.mu["pressure"]))
    assert solved.converged
    assert half.model.excluded_modes is not None
    antisymmetric = half.model.excluded_modes.families[0].factor_at(solved.state).negative_pivots
    return half.newton.factor_at(solved.state).negative_pivots, antisymmetric
