"""Sectors of several shells and of a mesh file, against the halves that their copies make."""

from typing import Any

import numpy as np
import pytest
from conftest import CASES

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError, read_source
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.shells.sector_modes import SectorModes
from magshell_fenicsx.shells.shell import ShellModel

h = 0.02
MATERIAL = {"thickness": h, "youngs_modulus": 1, "poisson_ratio": 0.3}
RING = {
    "shell": {"geometry": "annulus", "radius": 1, "inner_radius": 0.6, **MATERIAL},
    "boundary": {"outer": "clamped"},
}
TURNED = {**RING, "place": {"position": [0, 0, 1.2 * h], "axis": {"polar": 180, "azimuth": 20}}}
RINGS: dict[str, Any] = {
    "shells": {"lower": RING, "upper": TURNED},
    "contact": [["upper", "lower"]],
    "loading": {"kind": "pressure", "on": {"upper": "outside"}},
    "mesh": {"degree": 3, "size": 0.4},
}
GRIPPER = read_source(CASES / "gripper_closed.yaml")


def wall(radius: float) -> dict[str, Any]:
    shell = {"geometry": "cylinder", "radius": radius, "length": 0.3, **MATERIAL}
    return {"shell": shell, "boundary": {"top": "clamped"}}


JOINED: dict[str, Any] = {
    "shells": {"lower": RING, "tube": wall(0.6)},
    "joints": [
        {"edges": ["tube.bottom", "lower.inner"], "kind": "spring", "stiffness": 1e-4, "angle": 30}
    ],
    "mesh": {"degree": 3, "size": 0.2},
}


def sector(name: str) -> Case:
    """A case in the sector of 30 or of 45 degrees."""
    data = {"rings": RINGS | {"symmetry": 6}, "joined": JOINED | {"symmetry": 6}}
    return Case.from_source(data.get(name, GRIPPER))


NOT_THERE: dict[str, tuple[dict[str, Any], str]] = {
    "another axis": (
        {"shells": {"lower": RING, "upper": {**RING, "place": {"position": [3, 0, 0]}}}},
        "no two mirror planes .* each shell is held, and its own image in both",
    ),
    "a T-junction": (
        {
            "shells": {"lower": RING, "web": wall(0.8)},
            "joints": [{"edges": ["web.bottom", "lower"]}],
        },
        "symmetry: 6: not with a T-junction: take symmetry: half",
    ),
}


@pytest.mark.parametrize("name", NOT_THERE)
def test_no_sector(name: str) -> None:
    keys, message = NOT_THERE[name]
    with pytest.raises((CaseError, MeshError), match=message):
        make_problem(
            Case.from_source({**RINGS, "contact": [], "symmetry": 6, **keys})
        ).triangulated()


def symmetric(scene: Scene, size: float) -> np.ndarray:
    """A displacement of the sector with waves around e3, that closes the gap of the rings."""
    model, m = scene.model, scene.problem.mirror.waves  # type: ignore[union-attr]
    x = model.r0.x.array[: model.system.size].reshape(-1, 3)
    angle, rho = np.arctan2(x[:, 1], x[:, 0]), np.hypot(x[:, 0], x[:, 1])
    begin = scene.problem.mirror.azimuth  # type: ignore[union-attr]
    wave, out = (
        np.cos(m * (angle - begin)),
        np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]),
    )
    u = size * h * ((1 + 0.1 * wave) * rho)[:, None] * (0.2 * out + [0, 0, 1])
    upper = x[:, 2] > 0.5 * h
    u[upper] = -u[upper]
    return np.asarray(model.system.zero_at_supports(u.ravel()))


@pytest.mark.parametrize(
    "name", ["rings", pytest.param("gripper", marks=pytest.mark.slow), "joined"]
)
def test_copies_make_the_half(name: str) -> None:
    """Energy, contact force and residual of the half at the copies of a displacement: those of the
    sector, 1e-9.
    """
    scene = Scene(sector(name))
    model, waves = scene.model, scene.problem.mirror.waves  # type: ignore[union-attr]
    assert isinstance(model, ShellModel)
    assert isinstance(model.symmetry_breaking_modes, SectorModes)
    half = model.symmetry_breaking_modes.half_model
    assert (model.multiplicity, half.multiplicity) == (2 * waves, 2)
    size = {"rings": 0.4, "gripper": 2.0, "joined": 1e-7}[
        name
    ]  # the sine of its angles is the angle
    u, mu = symmetric(scene, size), {**scene.unloaded().mu}
    mu |= {key: 1e-3 for key in ("lambda_m", "pressure", "fold") if key in mu}
    copies = model.symmetry_breaking_modes.unfold(u)
    way = symmetric(scene, 1.0) * (
        1 + np.arange(model.system.size) % 2
    )  # of no meaning, and not along u
    way = u if name == "gripper" else model.system.zero_at_supports(way)
    works = [
        model.system.residual(u, mu) @ way,
        half.system.residual(copies, mu) @ model.symmetry_breaking_modes.unfold(way),
    ]
    assert works[1] == pytest.approx(waves * works[0], rel=1e-9)
    if name == "joined":
        return
    ours, theirs = (
        system.at_state(State(v, mu)) for system, v in ((model.system, u), (half.system, copies))
    )
    forces = (
        ours.evaluate(model.shell_contacts[0].force),
        theirs.evaluate(half.shell_contacts[0].force),
    )
    assert forces[1] == pytest.approx(waves * forces[0], rel=1e-9)
    assert (forces[0] > 0) == (name == "rings")


def test_a_ball_on_a_sector() -> None:
    """A ball on the axis of a cap that has waves around it presses on the copies as on the half,
    1e-9.
    """
    cap = {"geometry": "cap", "radius": 1, "polar": 20, **MATERIAL}
    ball = {
        "bodies": {"ball": {"kind": "sphere", "radius": 0.2}},
        "loading": {"kind": "contact", "approach": 1},
    }
    data = {
        "shell": cap,
        "boundary": {"rim": "clamped"},
        "mesh": {"degree": 3, "size": 0.15},
        "symmetry": 3,
        **ball,
    }
    scene = Scene(Case.from_source(data))
    model = scene.model
    assert isinstance(model, ShellModel)
    assert isinstance(model.symmetry_breaking_modes, SectorModes)
    half, u = model.symmetry_breaking_modes.half_model, symmetric(scene, -0.1)
    copies = model.symmetry_breaking_modes.unfold(u)
    mu = scene.unloaded().mu | {"approach": 0.5}
    deep = [
        each.region(State(v, mu), "approach").penetration
        for each, v in ((model, u), (half, copies))
    ]
    assert deep[0] > 0.1 * h
    assert deep[1] == pytest.approx(deep[0], rel=1e-9)
    works = [model.system.residual(u, mu) @ u, half.system.residual(copies, mu) @ copies]
    free = model.system.residual(u, mu | {"approach": 0.0}) @ u
    assert works[1] == pytest.approx(3 * works[0], rel=1e-9)
    assert abs(works[0] - free) > 1e-3 * abs(free)  # the ball is in it
