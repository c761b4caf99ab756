"""What a state shows is a function of the state: whether it is observed at once, alone, later or in
another order.
"""

from math import pi
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.system import SkewedTangent, State
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.public import Scene
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Record

Array = NDArray[np.float64]
MOMENT = [
    {"edge": "tip", "moment": -2 * pi * 0.01**3 / 12}
]  # rolls a strip of length 1 up to a circle
ROLLED = {
    "shell": {"geometry": "strip", "radius_to_thickness": 100, "width": 0.1, "poisson_ratio": 0.0},
    "boundary": {"root": "clamped"},
    "mesh": {"degree": 3, "refinement": 0.4},
}
BY_LOAD = {"kind": "dead", "loads": MOMENT, "factor": 1.25, "points": 10, "control": "load"}
IN_TIME = [
    {**BY_LOAD, "factor": 0.1, "points": 1},
    {
        "kind": "time",
        "duration": 4e3,
        "points": 2,
        "drag": 3e-3,
        "history": {"load": {"kind": "ramp", "to": 1.25, "over": 3e3}},
    },
]


def strip(loading: object) -> Case:
    return Case.from_source(Source("rolled", {**ROLLED, "loading": loading}))


def energies(scene: Scene, records: list[Record]) -> list[float]:
    return [scene.observe(record.point.state)["energy"] for record in records]


@pytest.mark.slow
def test_a_strip_rolled_up() -> None:
    """Seen on the way, and without what came before: the energy of a moment M on a strip is -M
    angle/2.
    """
    scene, seen, records = Scene(strip(BY_LOAD)), list[float](), list[Record]()
    for record in follow(scene):
        records.append(record)
        seen += energies(scene, [record])
    assert energies(scene, records[::-1])[::-1] == seen
    other = Scene(strip(BY_LOAD))
    alone = [record for record in follow(other) if record.label == "target"]
    turned = 2 * pi * np.array([record.point.state.mu["load"] for record in alone])
    assert energies(other, alone[-1:]) == pytest.approx(seen[-1:], rel=1e-12)
    assert energies(other, alone) == pytest.approx(-(turned**2) * 0.01**2 * 0.1 / 24, rel=2e-3)


@pytest.mark.slow
def test_a_strip_rolled_up_in_time() -> None:
    """Kinetic, stored and dissipated energy are the work of the moment, from rows more than half a
    turn apart.
    """
    scene = Scene(strip(IN_TIME))
    *_, begin, middle, last = follow(scene)
    for record in (last, middle):
        energy = scene.observe(record.point.state)["energy"]
        stored = scene.energy_of_shell(record.point.state, energy) - scene.energy_of_shell(
            begin.point.state, energies(scene, [begin])[0]
        )
        clock = record.clock
        assert clock["kinetic"] + stored + clock["dissipated"] == pytest.approx(
            clock["work"], rel=1e-3
        )
    assert clock["work"] > 0


HEMISPHERE = {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.5}
DIMPLE = {"kind": "dimple", "amplitude": 1.64, "width": 3.2}
BALL = {"kind": "sphere", "radius": 0.3, "stiffness": 1e3}
PLATE = {
    "geometry": "plate",
    "length": 1.0,
    "width": 0.2,
    "thickness": 0.02,
    "youngs_modulus": 1,
    "poisson_ratio": 0,
}
MAGNET = {
    "kind": "cylinder", "diameter": "20 mm", "height": "10 mm", "polarization": "1.3 T",
    "axis": {"polar": -90}, "position": ["55 mm", 0, "-30 mm"],
}  # fmt: skip
SOURCES = {
    "remanent": {"polar": 90, "azimuth": 0, "flux_density": "3 mT"},
    "applied": {"sources": [MAGNET]},
}
STRIP_OF_MM = {
    "geometry": "strip", "radius": "30 mm", "width": 0.1666, "thickness": "0.5 mm",
    "youngs_modulus": "1 MPa", "poisson_ratio": 0,
}  # fmt: skip
OF_ALL_KINDS: dict[str, dict[str, Any]] = {
    "contact of a meridian under pressure": {
        "shell": HEMISPHERE, "boundary": {"equator": "clamped"}, "bodies": {"ball": BALL},
        "mesh": {"refinement": 0.3},
        "loading": [{"kind": "contact", "body": "ball", "approach": 1}, {"kind": "pressure"}],
    },
    "contact and growing dimple of half a shell": {
        "shell": {**HEMISPHERE, "imperfections": [DIMPLE]}, "boundary": {"equator": "clamped"},
        "symmetry": "half", "bodies": {"ball": BALL}, "mesh": {"degree": 2, "refinement": 0.3},
        "loading": [
            {"kind": "contact", "body": "ball", "approach": 1},
            {"kind": "imperfection", "factor": 1}, {"kind": "pressure"},
        ],
    },
    "growing dimple of a meridian in a field": {
        "shell": {**HEMISPHERE, "imperfections": [DIMPLE]}, "boundary": {"equator": "clamped"},
        "magnetic": {"lambda_m": 0.01}, "mesh": {"refinement": 0.3},
        "loading": [{"kind": "pressure"}, {"kind": "imperfection", "factor": 1}],
    },
    "magnet that moves past a strip": {
        "shell": STRIP_OF_MM, "boundary": {"root": "clamped"}, "magnetic": SOURCES,
        "mesh": {"degree": 2},
        "loading": [{"kind": "field", "points": 1},
                    {"kind": "source", "move": [0, 0, "60 mm"], "points": 1}],
    },
    "magnet above a solid": {
        "model": "solid", "shell": {**STRIP_OF_MM, "thickness": "3 mm"},
        "boundary": {"root": "clamped"}, "magnetic": SOURCES, "mesh": {"refinement": 0.3},
        "loading": [{"kind": "field", "points": 1},
                    {"kind": "source", "move": [0, 0, "60 mm"], "points": 1}],
    },
    "moving edge under live pressure": {
        "shell": PLATE, "boundary": {"left": "clamped", "right": "clamped"},
        "mesh": {"degree": 2, "size": 0.2}, "symmetry": "none",
        "loading": [
            {"kind": "pressure"},
            {"kind": "edge", "name": "lift", "factor": 1,
             "moves": [{"supports": ["right"], "translation": [0, 0, 0.4],
                        "rotation": {"axis": [0, 1, 0], "angle": 20, "point": [1, 0, 0]}}]},
        ],
    },
    "strip under a moment": {**ROLLED, "loading": [BY_LOAD],
                             "mesh": {"degree": 2, "refinement": 0.3}},
}  # fmt: skip


def rough_states(scene: Scene, count: int) -> list[State]:
    """States with rough displacements, each with other amplitudes and another history."""
    start, system, states = scene.unloaded(), scene.model.system, list[State]()
    for number in range(count):
        u = system.zero_at_supports(
            1e-3 * np.random.default_rng(number).standard_normal(system.size)
        )
        mu = {name: 0.05 * (1 + i) * (number - 1.3) for i, name in enumerate(start.mu)}
        past = {
            name: (1.0 + number) * (value or 3.0) for name, (_, value) in system.history.items()
        }
        states.append(system.with_moved_supports(State(u, mu | past)))
    return states


def all_of(scene: Scene, state: State) -> list[Array]:
    """All that a state shows, and what the solvers ask of it."""
    system, u, mu = scene.model.system, state.u, state.mu
    names = [name for name in mu if name not in system.history]
    shown = np.array(list(scene.observe(state).values()))
    numbers = [system.potential(u, mu, name) for name in names]
    numbers += [system.curvature(u, mu, name, other) for name in names for other in names]
    columns = [system.load(u, mu, name) for name in names]
    tangent = system.tangent(u, mu)
    parts = (tangent.K, tangent.N) if isinstance(tangent, SkewedTangent) else (tangent,)
    values = [np.array(part.getValuesCSR()[2]) for part in parts]
    if isinstance(scene.model, MeridianModel):
        values.append(np.array(scene.model.waves.tangent(state, 2).getValuesCSR()[2]))
    return [
        shown,
        np.array(numbers),
        system.residual(u, mu),
        system.forces(u, mu),
        *columns,
        *values,
    ]


SLOW = "contact and growing dimple of half a shell"


@pytest.mark.parametrize(
    "kind", [pytest.param(each, marks=[pytest.mark.slow] * (each == SLOW)) for each in OF_ALL_KINDS]
)
def test_in_any_order(kind: str) -> None:
    """To the last bit, in order, at random, twice, and by a scene that has seen nothing else."""
    case = Case.from_source(Source(kind, OF_ALL_KINDS[kind]))
    scene, other = Scene(case), Scene(case)
    states = rough_states(scene, 3)
    known = [all_of(scene, state) for state in states]
    for number in (2, 0, 0, 1, 2, 1):
        for of in (scene, other):
            for mine, first in zip(all_of(of, states[number]), known[number], strict=True):
                np.testing.assert_array_equal(mine, first)
    assert all(np.isfinite(each).all() for of_state in known for each in of_state[1:])
    assert not np.array_equal(known[0][2], known[1][2])


RAMP = {"pressure": {"kind": "ramp", "to": 0.3, "over": 1.0}}
VISCOUS = {
    "shell": {**HEMISPHERE, "viscosity": 0.2, "relaxation": [{"modulus": 0.5, "time": 3.0}]},
    "boundary": {"equator": "clamped"},
    "mesh": {"refinement": 0.3},
    "loading": [
        {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.1, "points": 1},
        {"kind": "time", "duration": 2.0, "points": 3, "history": RAMP},
    ],
}


def test_seen_on_the_way() -> None:
    """A viscous shell moves the same whether it is looked at between two points or not."""
    seen, unseen = (Scene(Case.from_source(Source("viscous", VISCOUS))) for _ in range(2))
    records = list[Record]()
    for record in follow(seen):
        records.append(record)
        for before in records[::-1]:
            all_of(seen, before.point.state)
    for mine, first in zip(follow(unseen), records, strict=True):
        np.testing.assert_array_equal(mine.point.state.u, first.point.state.u)
