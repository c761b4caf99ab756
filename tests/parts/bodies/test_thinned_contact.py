"""A body on rubber touches half the deformed thickness from the mid-surface: gaps in closed form,
and tangents.
"""

from typing import Any

import numpy as np
import pytest
from along import check, difference
from conftest import disc, hemisphere, random_displacement
from rubbers import NEO_HOOKEAN, mooney

import magshell_fenicsx as ms
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.axisymmetric.meridian import make_meridian
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.rubber import Rubber
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.bodies.body_contact import ContactBody
from magshell_fenicsx.parts.bodies.plane import Plane
from magshell_fenicsx.parts.bodies.sphere import Sphere
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.natural.shape import Natural, meridians
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.shells.shell import ShellModel

DOWN, H = np.array([0.0, 0.0, -1.0]), 0.05
NATURAL = Natural(np.array([0.3, -0.2, 0.1]), np.array([0.1, -0.05, 0.08]), meridians)


def pressing(distance: Any) -> ContactBody:
    return ContactBody("ball", "a_ball", distance, DOWN, np.array([0.0, 0.0, 1.0]), 1e3, 1.0, 0.5)


BALL = pressing(
    Sphere(np.array([0.0, 0.0, 1.5]), 0.5 - H / 4)
)  # half within the upper half of the shell


def test_gap_of_a_stretched_disc() -> None:
    """Stretched by 1.5 and 1.2 it is h/1.8 thick; where it has grown by 1.1 in all directions 1.1^3
    times that.
    """
    plane, natural = (
        pressing(Plane(np.array([0.0, 0.0, 0.1]), DOWN)),
        Natural(None, np.full(3, 0.1), meridians),
    )
    for grown, factor in ((None, 1 / 1.8), (natural, 1.1**3 / 1.8)):
        model = ShellModel(
            disc(0.8),
            Material(0.5, H, Rubber(H, NEO_HOOKEAN)),
            2,
            {},
            Loads(contacts=(plane,), natural=grown),
        )
        x = model.r0.x.array.reshape(-1, 3)
        u = (x * [0.5, 0.2, 0.0]).ravel()
        known = model.contacts["a_ball"]
        mu = {"a_ball": 0.0} | ({"natural_stretch": 1.0} if grown else {})
        state = State(u, mu)
        assert model.system.at_state(state).evaluate(
            lambda known=known: known.gap
        ) == pytest.approx(0.1 - H / 2 * factor)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["plain", "varied and grown"])
def test_residual_and_tangent(kind: str) -> None:
    """By differences of the energy, and against FFCx's forms."""
    varied = kind != "plain"
    thickness = Thickness(lambda x, y, z: 1 + 0.5 * z**2) if varied else None
    loads = Loads(contacts=(BALL,), natural=NATURAL if varied else None)
    model = ShellModel(
        hemisphere(0.5),
        Material(0.5, H, Rubber(H, mooney(0.2))),
        3,
        {"rim": "clamped"},
        loads,
        thickness=thickness,
    )
    mu = {"a_ball": 0.3} | ({"natural_curvature": 0.5, "natural_stretch": 0.6} if varied else {})
    u = random_displacement(model, 1e-3)
    assert model.system.energies(u, mu)["contact ball"] > 1e-5
    check(model.system, u, mu)
    assert difference(model.system, u, mu) <= 1e-12


@pytest.mark.slow
def test_meridian() -> None:
    def dome(chart: np.ndarray) -> np.ndarray:
        s = chart[:, 0]
        return np.column_stack([np.sin(s), 0 * s, np.cos(s)])

    meridian = make_meridian(dome, np.linspace(0, np.pi / 2, 9), (None, "rim"))
    model = MeridianModel(
        meridian,
        Material(0.5, H, Rubber(H, mooney(0.2))),
        4,
        {"rim": "clamped"},
        Loads(contacts=(BALL,)),
    )
    u = random_displacement(model, 1e-3)
    assert model.system.energies(u, {"a_ball": 0.3})["contact ball"] > 1e-6
    check(model.system, u, {"a_ball": 0.3})


@pytest.mark.slow
def test_balloon_under_a_plate() -> None:
    """A blown-up dome under a plate that stays: its pole is half the deformed thickness below."""
    shell = {
        "geometry": "cap",
        "polar": 60,
        "radius": 1,
        "thickness": 0.05,
        "poisson_ratio": 0.5,
        "law": "neo-hookean",
    }
    sections = {
        "shell": shell,
        "boundary": {"rim": "clamped"},
        "bodies": {"plate": {"kind": "plane", "position": [0, 0, 1.4]}},
        "loading": {
            "kind": "pressure",
            "control": "volume",
            "until": "target",
            "volume_change": 1.4,
            "points": 6,
        },
    }
    scene = ms.Scene(ms.Case.from_source(sections))
    *_, last = ms.follow(scene)
    model, state = scene.model, last.point.state
    r0, r = (x.reshape(-1, 2) for x in (model.r0.x.array, model.r0.x.array + state.u))
    order = np.argsort(r0[:, 0])
    pole, near = order[:2]
    stretch = r[near, 0] / r0[near, 0]
    assert stretch > 1.2
    pressing = scene.model.contacts[next(iter(scene.model.contacts))]
    assert model.system.at_state(state).evaluate(
        lambda: float(pressing.gap.min())
    ) == pytest.approx(0, abs=1.01e-3 * 0.05)
    assert r[pole, 1] == pytest.approx(1.4 - 0.025 / stretch**2, abs=2e-3 * 0.05)
