"""Programmes: steps that drive one load and hold the others, in any order.

Elastic equilibria do not depend on the order of the loads that lead to them, and the work of all
loads is the change of the energy: these are the independent sources here.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import scipy
from conftest import CASES
from petsc4py import PETSc

from magshell_fenicsx import Record, columns, run
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.steps import stage_of_step

FIELD = {"kind": "field", "until": "target", "points": 2}
PRESSURE = {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.3, "points": 3}
POKE = {"kind": "indentation", "at": {"polar": 0}, "depth": 1.5, "points": 6}
COARSE = {"mesh": {"refinement": 0.4}}


def case(*loading: dict[str, Any], **others: Any) -> Case:
    data = {
        "shell": {"geometry": "hemisphere", "radius_to_thickness": 50, "poisson_ratio": 0.5},
        "boundary": {"equator": "clamped"},
        "magnetic": {"lambda_m": 0.004},
        "loading": list(loading),
        **COARSE,
    }
    return Case.from_source(data | others)


def history(asked: Case) -> tuple[Scene, list[Record]]:
    scene = Scene(asked)
    return scene, list(follow(scene))


def test_the_order_of_loads_does_not_matter() -> None:
    ends = []
    for steps in ((FIELD, PRESSURE), (PRESSURE, FIELD)):
        _, records = history(case(*steps))
        ends.append(records[-1].point.state)
        assert [record.step for record in records] == sorted(record.step for record in records)
    assert ends[0].mu == pytest.approx(ends[1].mu, rel=1e-12)
    assert np.abs(ends[0].u - ends[1].u).max() < 1e-8 * np.abs(ends[0].u).max()


def test_a_closed_cycle_returns_to_zero() -> None:
    """Field up, pressure up, field down, pressure down."""
    down = ({**FIELD, "factor": 0}, {**PRESSURE, "pressure": 0})
    scene, records = history(case(FIELD, PRESSURE, *down))
    found = columns(scene, records)
    assert abs(found["energy"][-1]) < 1e-10 * np.abs(found["energy"]).max()
    assert abs(found["w_over_h"][-1]) < 1e-8
    assert [found[name][-1] for name in ("lambda_m", "p_over_pc", "step")] == [0, 0, 4]


def test_the_work_of_all_loads_is_the_change_of_the_energy() -> None:
    """The elastic and magnetic energy U = Pi + sum mu q; dU = sum mu dq, by Hermite's quadrature of
    mu over q.
    """
    poke = {**POKE, "points": 40, "hold": {"pressure": "conjugate"}}
    scene, records = history(case({**PRESSURE, "points": 10}, poke, magnetic=None))
    system, work = scene.model.system, 0.0
    for step, name in ((1, "pressure"), (2, "force")):
        first = next(i for i, record in enumerate(records) if record.step == step) - 1
        part = [r.point for r in records[first:] if r.step in (step, step - 1) and not r.mode]
        q = [-system.potential(p.state.u, p.state.mu, name) for p in part]
        mu = [p.state.mu[name] for p in part]
        rates = [-system.load(p.state.u, p.state.mu, name) @ p.du for p in part[1:]]
        slopes = [p.dmu / rate for p, rate in zip(part[1:], rates, strict=True)]
        stage = stage_of_step(scene, scene.problem.programme[step - 1], part[0].state)
        start = stage.point(stage.begin(name, "load", part[0].state, 1.0)[1])
        begin = 1 / (-system.load(start.state.u, start.state.mu, name) @ start.du)
        work += scipy.interpolate.CubicHermiteSpline(q, mu, [begin, *slopes]).integrate(q[0], q[-1])
    end = records[-1].point.state
    inner = sum(
        system.energies(end.u)[name]
        for name in ("membrane", "bending", "interior edges", "clamped edges")
    )
    assert work == pytest.approx(inner, rel=1e-6)


def unstable_at_constant_volume(scene: Scene, state: State) -> int:
    """Negative eigenvalues of the dense tangent on the displacements that keep the volume."""
    system = scene.model.system
    whole = system.tangent(state.u, state.mu).convert(
        "dense", PETSc.Mat()
    )  # its array lives no longer than it
    upper = np.triu(whole.getDenseArray())
    dense = upper + np.triu(upper, 1).T
    free = np.array(system.zero_at_supports(np.ones(system.size)), dtype=bool)
    normal = system.load(state.u, state.mu, "pressure")[free]
    keep = scipy.linalg.null_space(normal[None])
    return int((np.linalg.eigvalsh(keep.T @ dense[np.ix_(free, free)] @ keep) < 0).sum())


def test_stability_under_a_held_volume() -> None:
    """Over the hill of the probing force: unstable under the pressure, and under the volume by the
    dense tangent.
    """
    probe = {**POKE, "depth": None, "control": "arc", "until": "zero"}
    counts = {}
    for hold in ("load", "conjugate"):
        scene, records = history(
            case({**PRESSURE, "pressure": 0.6}, {**probe, "hold": {"pressure": hold}})
        )
        counts[hold] = [record.point.negative_pivots for record in records if record.step == 2]
        for record in records[-6::2]:
            expected = unstable_at_constant_volume(scene, record.point.state)
            sealed = scene.problem.programme[1].load.model_copy(
                update={"hold": {"pressure": "conjugate"}}
            )
            step = type(scene.problem.programme[1])(2, "force", "loading.1", sealed)
            stage = stage_of_step(scene, step, record.point.state)
            assert (
                stage.newton.factor_at(stage.enter(record.point.state)).negative_pivots == expected
            )
    assert counts["load"][0] == counts["conjugate"][0] == 0
    assert counts["load"][-1] == 1


@pytest.mark.slow
def test_a_gas_keeps_pressure_times_volume() -> None:
    """Boyle's law; with little gas the shell is nearly sealed, with much of it nearly under a
    constant pressure.
    """
    ends = {}
    for volume in (0.1, 1e5):
        gas = {"gas": {"ambient_over_pc": 3.0, "volume": volume}}
        scene, records = history(case(PRESSURE, {**POKE, "hold": {"pressure": gas}}, magnetic=None))
        found = columns(scene, records)
        poked = found["step"] == 2
        inside, under = 3.0 - found["p_over_pc"], volume + found["volume_change"]
        first = np.flatnonzero(poked)[0] - 1
        assert inside[poked] * under[poked] == pytest.approx(inside[first] * under[first], rel=1e-9)
        ends[volume] = found["p_over_pc"][-1]
    assert ends[1e5] == pytest.approx(0.3, abs=1e-6)
    sealed = history(case(PRESSURE, {**POKE, "hold": {"pressure": "conjugate"}}, magnetic=None))[1][
        -1
    ]
    assert ends[0.1] < ends[1e5]
    assert sealed.point.state.mu["pressure"] < ends[0.1]


def test_the_field_first_as_in_the_paper() -> None:
    """The same numbers as with the field of `magnetic` before one load; those are compared with the
    paper elsewhere.
    """
    settings = ["magnetic.lambda_m=0.00184", "mesh.refinement=0.5"]
    file = CASES / "dimple_buckling.yaml"
    alone = run(Case.load(file, settings))
    steps = (
        "loading=[{kind: field, until: target}, {kind: pressure, control: volume, until: limit}]"
    )
    programme = run(Case.load(file, [*settings, steps]))
    assert alone.knockdown
    assert programme.knockdown == pytest.approx(alone.knockdown, rel=1e-9)
    assert programme.last.mu == pytest.approx(alone.last.mu, rel=1e-9)


def test_forces_at_two_places() -> None:
    """Each has its columns; the order does not matter."""
    other = {
        "kind": "indentation",
        "at": {"polar": 40},
        "control": "load",
        "force": 0.5,
        "points": 1,
    }
    first = {**POKE, "depth": None, "control": "load", "force": 1, "points": 2}
    coarse = {"mesh": {"degree": 2, "refinement": 0.3}, "magnetic": None}
    ends = []
    for steps in ((first, other), (other, first)):
        scene, records = history(case(*steps, **coarse))
        found = columns(scene, records)
        assert scene.problem.is_half
        ends.append(
            {
                name: found[name][-1]
                for name in ("w_over_h", "w_force_2_over_h", "force", "force_2", "energy")
            }
        )
    here, there = ends
    assert (here["force"], here["force_2"]) == (1, 0.5)
    assert here["energy"] == pytest.approx(there["energy"], rel=1e-8)
    assert here["w_over_h"] == pytest.approx(there["w_force_2_over_h"], rel=1e-8)


def test_the_field_turns_twice() -> None:
    """The end is that of a field that grows in the last direction, and then the field goes back to
    zero.
    """
    strip = {
        "shell": {"geometry": "strip", "radius_to_thickness": 50, "width": 0.2, "poisson_ratio": 0},
        "boundary": {"root": "clamped"},
        "mesh": {"degree": 3, "size": 0.2},
    }
    turns = ({"polar": 60}, {"polar": 60, "azimuth": 70})
    steps = [{"kind": "rotation", "to": to, "points": 2} for to in turns]
    off = {"kind": "field", "factor": 0, "points": 2}
    field = {"remanent": {"polar": 90}, "lambda_m": 2e-4}
    scene, records = history(
        case(FIELD, *steps, off, magnetic={**field, "applied": {"polar": 20}}, **strip)
    )
    turned = [record for record in records if record.step == 3][-1]
    other, direct = history(
        case(FIELD, magnetic={**field, "applied": turns[1]}, **strip, symmetry="none")
    )
    w = [
        s.observe(r.point.state)["w_pole_over_h"] for s, r in ((scene, turned), (other, direct[-1]))
    ]
    assert w[0] == pytest.approx(w[1], rel=1e-8)
    assert abs(scene.observe(records[-1].point.state)["w_pole_over_h"]) < 1e-8 * abs(w[0])
    assert scene.observe(turned.point.state)["lambda_m"] == pytest.approx(2e-4, rel=1e-12)


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        (
            [PRESSURE, {**POKE, "hold": {"presure": "load"}}],
            "loading.1.hold.presure: the programme has no such",
        ),
        (
            [PRESSURE, {**POKE, "hold": {"pressure": "kept"}}],
            "loading.1.hold.pressure: 'kept': must be 'load'",
        ),
        (
            [FIELD, {**POKE, "hold": {"lambda_m": "conjugate"}}],
            "nothing that can be held is conjugate",
        ),
        ([PRESSURE, {**PRESSURE, "hold": {"pressure": "load"}}], "this step drives pressure"),
        ([{**PRESSURE, "pressure": 0}], "loading.0: the target must not be zero"),
        ([PRESSURE, {"kind": "rotation", "to": {"polar": 9}}], "a step of kind: field before it"),
        ([{**FIELD, "foo": 1}], "loading.0.foo: unknown key"),
        ([{"kind": "presure"}], "loading.0.kind: 'presure'; allowed: pressure, "),
        ([{**POKE, "until": "zero", "depth": None}], "it goes with control: arc"),
    ],
)
def test_mistakes_in_a_programme(steps: Sequence[dict[str, Any]], said: str) -> None:
    with pytest.raises(CaseError) as error:
        case(*steps)
    assert said in str(error.value)


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        (
            [{**PRESSURE, "pressure": 1.5}, POKE],
            "step 1 of 2 (pressure): load control cannot pass the fold",
        ),
        ([{"kind": "pressure", "until": "limit"}, POKE], "step 1 of 2 (pressure): ends at a"),
    ],
)
def test_a_step_that_cannot_be_done(steps: Sequence[dict[str, Any]], said: str) -> None:
    """The message says which step, and all points are there."""
    shell = {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.5}
    result = run(case(*steps, magnetic=None, shell=shell))
    assert result.stopped
    assert said in result.stopped
    assert result.rows[-1]["p_over_pc"] > 0.5


def test_first_instability_on_the_way_to_a_target() -> None:
    """A field of -3 times is three times the opposite one: the same fold; before it there is
    none."""
    load = {"kind": "field", "until": "limit", "points": 2}
    dome = {"geometry": "cap", "polar": 40, "radius": 20, "thickness": 1, "poisson_ratio": 0.49}
    critical = []
    for size, factor in ((-0.01, 3), (0.01, -3)):
        scene, records = history(
            case(
                {**load, "factor": factor},
                shell=dome,
                boundary={"rim": "hinged"},
                magnetic={"lambda_m": size},
            )
        )
        assert [record.label for record in records if record.label != "step"] == [
            "start",
            "target",
            "fold",
        ]
        critical.append(scene.observe(records[-1].point.state)["lambda_m"])
    assert critical[0] == pytest.approx(critical[1], rel=1e-8)
    for until, event in (("limit", "instability"), ("bifurcation", "bifurcation")):
        near = case(
            {**load, "until": until, "factor": -1},
            shell=dome,
            boundary={"rim": "hinged"},
            magnetic={"lambda_m": 0.01},
        )
        said = list[str]()
        *_, last = follow(Scene(near), remark=said.append)
        assert (last.label, last.point.state.mu["lambda_m"]) == ("target", pytest.approx(-0.01))
        assert said == [
            f"step 1 of 1 (field): there is no {event} up to the target, where until: {until} ends "
            "too"
        ]


def test_a_way_that_ends_before_the_first_contact_ends_there() -> None:
    """A ball 4.5 h from a cap approaches by 1 h: it does not go to the cap first, and back then."""
    cap = {"geometry": "cap", "radius": 1, "polar": 30, "thickness": 0.05, "poisson_ratio": 0.3}
    ball = {"kind": "sphere", "radius": 0.5, "position": [0, 0, 1.75], "direction": [0, 0, -1]}
    load = {"kind": "contact", "until": "limit", "approach": 1}
    data = {"shell": cap, "boundary": {"rim": "clamped"}, "bodies": {"ball": ball}, "loading": load}
    records = [*follow(Scene(Case.model_validate(data)), remark=lambda said: None)]
    assert [(record.label, record.point.state.mu["approach"]) for record in records] == [
        ("start", 0.0),
        ("target", 1.0),
    ]


@pytest.mark.parametrize(
    ("step", "message"),
    [
        (
            {"until": "limit", "factor": -3, "control": "load"},
            "factor: beside until: limit stands one target",
        ),
        (
            {"until": "bifurcation", "factor": -3, "control": "load"},
            "factor: beside until: bifurcation stands one target",
        ),
        ({"until": "limit", "factor": 0}, "the target must not be zero"),
    ],
)
def test_targets_that_are_no_end_of_a_way(step: dict[str, Any], message: str) -> None:
    with pytest.raises(CaseError) as error:
        case({"kind": "field", **step})
    assert message in str(error.value)
