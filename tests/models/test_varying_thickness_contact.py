"""Shells whose thickness varies touch: faces are half the local thickness from mid-surfaces."""

from typing import Any

import numpy as np
import pytest
from along import check_derivatives, csr
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.gap import SOFT_PENETRATION

Array = NDArray[np.float64]
h = 0.02
PRESSURE, FOUNDATION = 0.2, 1.0  # over E h/R; over E/R


def sheets(factors: tuple[str | None, str | None], apart: float = h, thick: float = 1.0) -> Scene:
    """Two unit squares on a soft foundation whose mid-surfaces are this far apart, pressed
    together.
    """

    def sheet(factor: str | None, z: float) -> dict[str, Any]:
        shell = {
            "geometry": "plate",
            "length": 1,
            "width": 1,
            "youngs_modulus": 1,
            "poisson_ratio": 0,
        }
        shell |= {"thickness": h * thick} | ({"thickness_factor": factor} if factor else {})
        held = {"left": {"held": ["x"]}, "right": {"held": ["x"]}, "bottom": "symmetry"}
        return {"shell": shell, "boundary": held, "place": {"position": [0, 0, z]}}

    pushes = [
        {"over": name, "per_area": [0, 0, way * PRESSURE * h]}
        for name, way in (("lower", 1), ("upper", -1))
    ]
    case = {
        "shells": {"lower": sheet(factors[0], 0), "upper": sheet(factors[1], apart)},
        "contact": [["upper", "lower"]],
        "foundation": {"stiffness": FOUNDATION},
        "mesh": {"degree": 2, "size": 0.7},
        "loading": {"kind": "dead", "control": "load", "factor": 1, "points": 1, "loads": pushes},
    }
    return Scene(Case.from_source(case))


def gap_of(scene: Scene) -> float:
    return float(
        scene.model.system.at_state(scene.unloaded()).evaluate(
            scene.model.shell_contacts[0].least_gap
        )
    )


def test_gap_of_wedges() -> None:
    """At the thick ends of equal wedges; of opposite ones, whose faces are parallel and inclined,
    everywhere.
    """
    assert gap_of(sheets(("1 + 0.6*x", "1 + 0.6*x"), 2 * h)) == pytest.approx(
        2 * h - 1.6 * h, abs=1e-5 * h
    )
    opposite = sheets(("0.7 + 0.6*x", "1.3 - 0.6*x"), 2 * h)
    assert gap_of(opposite) == pytest.approx(2 * h * np.sqrt(1 - (0.3 * h) ** 2) - h, abs=1e-14)


def test_pressed_wedges() -> None:
    """Newton's method is quadratic; opposite wedges press on each other uniformly, as faces that
    are parallel.

    Forces are across the faces, so that the foundation bears the couple of what holds the sheets
    along.
    """
    inclined = np.sqrt(1 - (0.03 * h) ** 2)
    scene = sheets(("0.97 + 0.06*x", "1.03 - 0.06*x"), h / inclined)
    model, (term,) = scene.model, scene.model.shell_contacts
    system, r0, mu = (
        model.system,
        model.r0.x.array.reshape(-1, 3),
        scene.unloaded().mu | {"load": 1.0},
    )
    upper = r0[:, 2] > h / 2
    guess = np.zeros_like(r0)
    guess[upper, 2] = -2e-3 * h
    u, steps = system.zero_at_supports(guess.ravel()), list[float]()
    for _ in range(14):
        step = spsolve(csr(system.tangent(u, mu)).tocsc(), system.residual(u, mu))
        u, steps = u - step, [*steps, float(np.abs(step).max())]
    assert steps[-1] < 1e-13
    r = r0 + u.reshape(-1, 3)
    assert np.ptp(r[upper, 2]) < 5e-5 * h
    d = r[upper, 2].mean() - r[~upper, 2].mean()
    q = (PRESSURE + FOUNDATION * u.reshape(-1, 3)[upper, 2].mean() / h) / inclined
    force = system.at_state(State(u, mu)).evaluate(term.force)
    assert force == pytest.approx(q, rel=1e-5)
    p = system.at_state(State(u, mu)).evaluate(term.cell_pressures_and_gaps)[0]
    assert np.ptp(p) < 1e-3 * p.mean()
    s = np.sqrt(2 * SOFT_PENETRATION * h * q / term.stiffness.value)
    assert s < SOFT_PENETRATION * h  # the penalty is k s^2/(2 SOFT_PENETRATION h)
    assert d == pytest.approx((h - s) / inclined, abs=1e-6 * h)


def ring(**more: Any) -> Scene:
    """A tube between mirrors that can be pressed flat, thicker on one side."""
    shell = {
        "geometry": "cylinder",
        "radius": 1,
        "length": 0.12,
        "thickness": h,
        "youngs_modulus": 1,
    }
    held = {"east": {"held": ["y"]}, "west": {"held": ["y"]}, "north": {"held": ["x"]}}
    data = {
        "shell": shell | {"poisson_ratio": 0, "thickness_factor": "1 + 0.5*x + 0.1*y"},
        "boundary": {"bottom": "symmetry", "top": "symmetry"} | held,
        "points": {"east": [1, 0, 0], "west": [-1, 0, 0], "north": [0, 1, 0]},
        "contact": [["shell", "shell"]],
        "mesh": {"size": 0.2, "degree": 3},
        "loading": {"kind": "pressure"},
    }
    return Scene(Case.model_validate(data | more))


def flattened(scene: Scene, wide: float = 0.0, half: float = 0.495, ends: float = 0.4) -> Array:
    """The displacement (nodes, 3) of a tube that is pressed flat, and stretched."""
    r = scene.model.r0.x.array.reshape(-1, 3)
    flat = np.zeros_like(r)
    flat[:, 0] = wide * r[:, 0]
    width = half * h * (1 + 0.5 * r[:, 0]) + ends * np.maximum(np.abs(r[:, 0]) - 0.5, 0) ** 2
    flat[:, 1] = np.tanh(r[:, 1] / 0.2) * width - r[:, 1]
    return flat


RUBBER = {"law": "mooney-rivlin", "mooney": 0.1, "poisson_ratio": 0.5}


@pytest.mark.parametrize(("law", "flat"), [({}, (0.0, 0.495)), (RUBBER, (0.3, 0.4, 2.5))])
def test_derivatives(law: dict[str, Any], flat: tuple[float, ...]) -> None:
    """Of a tube that is pressed flat, also of rubber, at a rough state: differences of energy and
    forces, 1e-6.
    """
    shell = {
        "geometry": "cylinder",
        "radius": 1,
        "length": 0.12,
        "thickness": h,
        "youngs_modulus": 1,
    }
    scene = ring(shell=shell | {"poisson_ratio": 0, "thickness_factor": "1 + 0.5*x + 0.1*y"} | law)
    check_derivatives(scene, flattened(scene, *flat), (0.01 * h, 0.3 * h), h)
