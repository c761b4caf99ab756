"""What a state shows is a function of the state: whether it is observed at once, alone, later or in another order."""

from math import pi

import numpy as np
import pytest

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene

MOMENT = [{"edge": "tip", "moment": -2 * pi * 0.01**3 / 12}]  # rolls a strip of length 1 up to a circle
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


def test_a_strip_rolled_up() -> None:
    """Seen on the way, and without what came before: the energy of a moment M on a strip is -M angle/2."""
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
    """Kinetic, stored and dissipated energy are the work of the moment, from rows more than half a turn apart."""
    scene = Scene(strip(IN_TIME))
    *_, begin, middle, last = follow(scene)
    for record in (last, middle):
        energy = scene.observe(record.point.state)["energy"]
        stored = scene.stored(record.point.state, energy) - scene.stored(begin.point.state, energies(scene, [begin])[0])
        clock = record.clock
        assert clock["kinetic"] + stored + clock["dissipated"] == pytest.approx(clock["work"], rel=1e-3)
    assert clock["work"] > 0
