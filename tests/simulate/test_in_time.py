"""Shells in time: vibrations of known frequency, energy, jumps, rest, resumed runs, ranks."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import magshell

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.motion.motion_step import level_in
from magshell_fenicsx.public import run
from magshell_fenicsx.runs.rows import columns, rows
from magshell_fenicsx.runs.summary import snaps
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.trace import trace

STRIP = {
    "shell": {"geometry": "strip", "radius_to_thickness": 50, "poisson_ratio": 0.0, "width": 0.2},
    "boundary": {"root": "clamped"},
    "mesh": {"degree": 3, "size": 0.5},
}
PLATE = {
    "shell": {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": 0.3},
    "boundary": {"rim": "clamped"},
    "mesh": {"degree": 3, "refinement": 0.5},
}
BEAM = 3.5160 * np.sqrt(1 / 12) / 50  # omega of a cantilever, R/h = 50, nu = 0


def case_of(base: dict[str, Any], *steps: dict[str, Any], **sections: Any) -> Case:
    return Case.from_source({**base, **sections, "loading": list(steps)})


def columns_of(case: Case) -> dict[str, Any]:
    scene = Scene(case)
    return columns(scene, follow(scene))


def test_a_cantilever_swings() -> None:
    """A small push along the first mode: cos omega t with the frequency of beam theory; energy
    conserved.
    """
    period = 2 * np.pi / BEAM
    push = {"mode": 1, "displacement": 0.01}
    swing = {
        "kind": "time",
        "duration": 2 * period,
        "points": 8,
        "step": period / 40,
        "rho_inf": 1.0,
        "push": push,
    }
    found = columns_of(case_of(STRIP, swing, symmetry="half"))
    w = found["w_over_h"][1:]
    assert w[[1, 3, 5, 7]] == pytest.approx([-0.01, 0.01, -0.01, 0.01], rel=5e-3)
    assert w[[0, 2, 4]] == pytest.approx(np.zeros(3), abs=1e-3)
    energy = (found["kinetic"] + found["stored"])[1:]
    assert np.ptp(energy) < 1e-8 * energy[0]


@pytest.mark.parametrize("symmetry", ["axisymmetric", pytest.param("half", marks=pytest.mark.slow)])
def test_a_sudden_pressure_doubles_the_deflection(symmetry: str) -> None:
    """1.9 to 2.1 of the static w; work = kinetic + stored + dissipated; with drag it comes to rest
    in equilibrium.
    """
    static = {
        "kind": "pressure",
        "control": "load",
        "until": "target",
        "pressure": 1e-4,
        "points": 1,
    }
    w = columns_of(case_of(PLATE, static, symmetry=symmetry))["w_pole_over_h"][-1]
    sudden = {"pressure": {"kind": "step", "to": 1e-4}}
    first = {"kind": "time", "duration": 120.0, "points": 24, "history": sudden, "rho_inf": 0.9}
    still = {
        "kind": "time",
        "duration": 4000.0,
        "points": 40,
        "drag": 0.06,
        "until": "rest",
        "tolerance": 1e-2,
    }
    found = columns_of(case_of(PLATE, first, still, symmetry=symmetry))
    moving = found["step"] == 1
    assert 1.9 < found["w_pole_over_h"][moving].max() / w < 2.1
    balance = found["kinetic"] + found["stored"] + found["dissipated"] - found["work"]
    assert np.abs(balance[moving]).max() < 1e-3 * found["work"].max()
    assert found["w_pole_over_h"][-1] == pytest.approx(w, rel=1e-8)
    assert found["label"][-1] == "target"
    assert found["kinetic"][-1] == 0


def test_a_cap_snaps_and_goes_on() -> None:
    """Released at its fold it comes to rest where a static path by arc length comes to at the same
    pressure.
    """
    shell = {"geometry": "cap", "polar": 20, "radius": 1.0, "thickness": 0.02, "poisson_ratio": 0.3}
    base = {
        "shell": shell,
        "boundary": {"rim": "clamped"},
        "symmetry": "axisymmetric",
        "mesh": {"refinement": 0.5},
    }
    snap = {"kind": "pressure", "until": "limit", "then": "snap"}
    scene = Scene(case_of(base, snap))
    records = list(follow(scene))
    (fold,) = [record for record in records if record.label == "fold" and not record.mode]
    rest, p = records[-1], fold.point.state.mu["pressure"]
    assert rest.label == "target"
    path = trace(
        scene, "pressure", until="target", targets=[1.01 * p], first=0.1
    )  # first reached beyond both folds
    far = [record.point.state for record in path if record.label == "target"][-1]
    *_, back = trace(scene, "pressure", far, control="load", until="target", targets=[p])
    assert rest.point.state.u == pytest.approx(back.point.state.u, abs=1e-6 * 0.02)
    found = rows(scene, records)
    (made,) = snaps(found)
    assert made["time"] > 0
    assert 0 < made["overshoot"] < 1
    first, last = found[made["point"]], found[made["rest"]]
    push = 0.05  # of h: its energy is of third order
    assert made["dissipated"] == pytest.approx(first["energy"] - last["energy"], rel=push)


GAS = {"gas": {"ambient_over_pc": 1e-3, "volume": 0.01}}
PUSHED = {"kind": "indentation", "at": {"polar": 0}, "points": 1}
HELD: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "the displacement of an indenter": (
        PUSHED | {"depth": 0.3},
        {"history": {"pressure": {"kind": "step", "to": 1e-4}}, "hold": {"force": "conjugate"}},
        {
            "kind": "pressure",
            "control": "load",
            "until": "target",
            "pressure": 1e-4,
            "hold": {"force": "conjugate"},
        },
    ),
    "a gas": (
        PUSHED | {"control": "load", "force": 1e-3},
        {"history": {"force": {"kind": "step", "to": 0.02}}, "hold": {"pressure": GAS}},
        PUSHED | {"control": "load", "force": 0.02, "hold": {"pressure": GAS}},
    ),
}


@pytest.mark.parametrize("what", HELD)
def test_held(what: str) -> None:
    """It swings, and comes to rest where the static step ends; the gas and the loads do all work
    that is not lost.
    """
    before, moving, static = HELD[what]
    mesh = {"degree": 3, "refinement": 0.3}
    swing = {
        "kind": "time",
        "duration": 100.0,
        "points": 20,
        "rho_inf": 0.9,
        "tolerance": 1e-4,
    } | moving
    if (
        what == "a gas"
    ):  # an energy, which the middle of each step conserves; a constraint's force would alternate
        swing |= {"rho_inf": 1.0, "step": 1.0}
    still = {
        "kind": "time",
        "duration": 4000.0,
        "points": 40,
        "drag": 0.06,
        "until": "rest",
        "tolerance": 1e-2,
    }
    case = case_of(
        PLATE, before, swing, still | {"hold": moving["hold"]}, symmetry="axisymmetric", mesh=mesh
    )
    found = columns_of(case)
    there = columns_of(case_of(PLATE, before, static, symmetry="axisymmetric", mesh=mesh))
    for key in ("w_pole_over_h", "force", "p_over_pc", "volume_change"):
        assert found[key][-1] == pytest.approx(there[key][-1], rel=1e-6, abs=1e-15)
    moved = found["step"] == 2
    w = found["w_pole_over_h"][moved]
    if what == "a gas":
        assert w.max() > 1.3 * there["w_pole_over_h"][-1]
        assert np.ptp(found["p_over_pc"][moved]) > 1e-7
    else:
        assert w == pytest.approx(np.full(len(w), 0.3), abs=1e-10)
        assert np.ptp(found["force"][moved]) > 1e-3
    change = found["kinetic"] + found["stored"] + found["dissipated"] - found["work"]
    assert np.ptp(change[moved]) < 1e-3 * found["kinetic"][moved].max()


HISTORIES = {
    "ramp": ({"kind": "ramp", "to": 1e-5, "over": 4.0}, [0.25, 0.5, 0.75, 1, 1, 1, 1, 1]),
    "step": ({"kind": "step", "to": 1e-5, "at": 2.5}, [0, 0, 1, 1, 1, 1, 1, 1]),
    "triangle": (
        {"kind": "triangle", "size": 1e-5, "period": 8.0},
        [0.5, 1, 0.5, 0, -0.5, -1, -0.5, 0],
    ),
    "sine": ({"kind": "sine", "size": 1e-5, "period": 4.0, "mean": 1e-5}, [2, 1, 0, 1, 2, 1, 0, 1]),
    "table": ([[0, 0], [2, 1e-5], [2, -1e-5], [4, 0]], [0.5, 1, -0.5, 0, 0, 0, 0, 0]),
    "formula": ("1e-5*t**2/16", [1 / 16, 4 / 16, 9 / 16, 1, 25 / 16, 36 / 16, 49 / 16, 4]),
}


@pytest.mark.parametrize("kind", HISTORIES)
def test_histories(kind: str) -> None:
    """The pressure at eight times, just before a jump."""
    history, expected = HISTORIES[kind]
    step = {
        "kind": "time",
        "duration": 8.0,
        "points": 8,
        "history": {"pressure": history},
        "step": 1.0,
    }
    found = columns_of(
        case_of(PLATE, step, symmetry="axisymmetric", mesh={"degree": 2, "refinement": 0.2})
    )
    assert found["p_over_pc"][1:] / 1e-5 == pytest.approx(expected, abs=1e-9)
    assert found["time"][1:] == pytest.approx(np.arange(1, 9))


def test_histories_in_units() -> None:
    """A value means what a target of that load would, by the formulas of p_c, 2πD/R, h and
    √(E/ρ)/R.
    """
    E, h, R, nu, rho = 1.2e6, 0.6e-3, 30e-3, 0.49, 1200.0
    shell = {
        "geometry": "cap",
        "polar": 25,
        "radius": "30 mm",
        "thickness": "0.6 mm",
        "youngs_modulus": "1.2 MPa",
    }
    expected = {
        "pressure": ("400 Pa", 400 / (2 * E / np.sqrt(3 * (1 - nu**2)) * (h / R) ** 2)),
        "force": ("2 mN", 2e-3 * 6 * R * (1 - nu**2) / (np.pi * E * h**3)),
        "approach_ball": ("0.3 mm", 0.5),
        "spin": ("200 rpm", 200 * np.pi / 30 * R / np.sqrt(E / rho)),
        "field": ("-5 mT", -0.25),
    }
    time = {
        "kind": "time",
        "duration": "1 s",
        "history": {k: [[0, 0], ["1 s", v]] for k, (v, _) in expected.items()},
    }
    case = case_of(
        {
            "shell": {**shell, "poisson_ratio": nu, "density": "1200 kg/m^3"},
            "boundary": {"rim": "clamped"},
            "bodies": {"ball": {"kind": "sphere", "radius": "5 mm"}},
            "magnetic": {
                "remanent": {"flux_density": "50 mT"},
                "applied": {"flux_density": "20 mT"},
            },
        },
        {"kind": "indentation", "depth": "0.1 mm"},
        {"kind": "spin", "speed": "10 rpm"},
        {"kind": "contact", "approach": "0.1 mm"},
        time,
    )
    context = make_problem(case).context
    for name, (text, value) in expected.items():
        assert level_in(context, name, text) == pytest.approx(value, rel=1e-12), name


MISTAKES = [
    ({"duration": "2 s"}, "a time with a unit needs shell.density, youngs_modulus and lengths"),
    ({"duration": -1.0}, "duration: -1.0: must be positive"),
    ({"history": {"force": "t"}}, "history.force: no such load; allowed: field, pressure"),
    (
        {"history": {"pressure": [[0, 0], [1, "5 mT"]]}},
        "history.pressure: 5 mT: is not convertible to pascal",
    ),
    ({"history": {"field": "t"}}, "history.field: needs magnetic.lambda_m, not zero"),
    (
        {"history": {"pressure": [[1, 0], [0, 1]]}},
        "the times of a table must not fall, nor be negative",
    ),
    ({"history": {"pressure": "x + t"}}, "is not a formula of the time t"),
    (
        {"hold": {"pressure": "conjugate"}, "history": {"pressure": "t"}},
        "hold.pressure: it follows its history: only load is allowed",
    ),
]


@pytest.mark.parametrize(("given", "message"), MISTAKES)
def test_mistakes(given: dict[str, Any], message: str) -> None:
    with pytest.raises(CaseError) as error:
        case_of(PLATE, {"kind": "time", "duration": 1.0, **given})
    assert message in str(error.value)


def test_a_static_step_needs_rest() -> None:
    with pytest.raises(
        CaseError, match="begins in equilibrium: the step of kind: time before it needs until: rest"
    ):
        case_of(PLATE, {"kind": "time", "duration": 1.0}, {"kind": "pressure"})


def test_resumed(tmp_path: Path, no_pictures: None) -> None:
    """Stopped after each point by its time limit, and resumed: the same rows."""
    sudden = {"pressure": {"kind": "step", "to": 1e-4}}
    case = case_of(
        PLATE,
        {"kind": "time", "duration": 40.0, "points": 3, "history": sudden},
        symmetry="axisymmetric",
    )
    whole = run(case, tmp_path / "whole")
    first = run(case, tmp_path / "parts", time_limit=1e-9)
    assert first.stopped
    assert len(first.rows) < len(whole.rows)
    second = run(case, tmp_path / "parts", resume=True)
    assert second.stopped is None
    for key in ("time", "w_pole_over_h", "kinetic", "stored", "work"):
        assert [row[key] for row in second.rows] == pytest.approx(
            [row[key] for row in whole.rows], rel=1e-9
        )


@pytest.mark.slow
def test_ranks(tmp_path: Path) -> None:
    """The same columns on one rank and on two. A volume is held and a support moves."""
    file = tmp_path / "case.yaml"
    file.write_text(
        "shell: {geometry: disc, radius_to_thickness: 50, poisson_ratio: 0.3}\n"
        "boundary: {rim: clamped}\n"
        "symmetry: half\nmesh: {degree: 2, refinement: 0.5}\nloading:\n"
        "- {kind: edge, name: lift, moves: [{supports: [rim], translation: [0, 0, 1]}], "
        "factor: 1e-9, control: load}\n"
        "- {kind: indentation, at: {polar: 0}, control: load, force: 0.01, points: 1}\n"
        "- {kind: time, duration: 20, step: 4, points: 1, hold: {pressure: conjugate}, "
        "history: {force: '0.1'}}\n"
        "- {kind: time, duration: 20, step: 4, points: 1, history: {lift: 1e-9 + t**2*1e-5}}\n"
    )
    columns = ("kinetic", "stored", "work", "w_over_h")
    found, pressures = [], []
    for ranks in (1, 2):
        out = tmp_path / str(ranks)
        done = magshell("run", file, "--out", out, ranks=ranks)
        assert done.returncode == 0, done.stderr
        *_, a, b = csv.DictReader((out / "path.csv").open(encoding="utf-8"))
        found.append([[float(row[key]) for row in (a, b)] for key in columns])
        pressures.append([float(row["p_over_pc"]) for row in (a, b)])
    for one, two in zip(*found, strict=True):
        assert two == pytest.approx(one, rel=2e-9)
    # the plate's membrane forces round to about 1e-12 p_c, however small the pressure that holds
    # the volume is
    assert pressures[1] == pytest.approx(pressures[0], abs=1e-11)
    assert abs(pressures[0][1]) > 1e-6
