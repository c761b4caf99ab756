"""Rubber that touches rubber, other shells and itself: faces are half the deformed thickness from
mid-surfaces.
"""

from itertools import pairwise
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
h, FOUNDATION = 0.02, 1e-3  # over R; over E/R
TENSION, PRESSURE = 0.2, 2.0  # over E h, and over E h/R


def sheets(
    *,
    laws: tuple[str, str] = ("neo-hookean", "neo-hookean"),
    thick: float = 1.0,
    grown: float | None = None,
) -> Scene:
    """Two unit squares whose faces meet, pulled in both directions and pressed together; the upper
    one h `thick`.
    """

    def sheet(law: str, thickness: float, z: float) -> dict[str, Any]:
        shell = {
            "geometry": "plate",
            "length": 1,
            "width": 1,
            "youngs_modulus": 1,
            "poisson_ratio": 0.5,
        }
        return {
            "shell": shell | {"thickness": thickness, "law": law},
            "boundary": {"left": "symmetry", "bottom": "symmetry"},
            "place": {"position": [0, 0, z]},
        }

    names, T = ("lower", "upper"), TENSION * h
    pulls = [{"edge": f"{name}.right", "per_length": [T, 0, 0]} for name in names]
    pulls += [{"edge": f"{name}.top", "per_length": [0, T, 0]} for name in names]
    pushes = [
        {"over": name, "per_area": [0, 0, side * PRESSURE * h]}
        for name, side in zip(names, (1, -1), strict=True)
    ]
    case = {
        "shells": {
            "lower": sheet(laws[0], h, 0),
            "upper": sheet(laws[1], thick * h, (1 + thick) / 2 * h),
        },
        "contact": [["upper", "lower"]],
        "foundation": {"stiffness": FOUNDATION},
        "mesh": {"degree": 2, "size": 0.7},
        "loading": [
            {
                "kind": "dead",
                "control": "load",
                "factor": 1,
                "points": 1,
                "loads": [*pulls, *pushes],
            }
        ],
    }
    if grown:
        case |= {"natural": {"stretch": grown}}
        case["loading"] = [{"kind": "natural", "stretch": 1}, *case["loading"]]
    return Scene(Case.model_validate(case))


def test_gap_of_stretched_sheets() -> None:
    """Rubber that is 1.5 h thick has h 1.5/(1.3 1.2) when stretched, a sheet of Koiter's law h as
    before.
    """
    scene = sheets(laws=("koiter", "neo-hookean"), thick=1.5)
    model, r0 = scene.model, scene.model.r0.x.array.reshape(-1, 3)
    u = (r0 * [0.3, 0.2, 0.1]).ravel()
    gap = model.system.at_state(State(u, scene.unloaded().mu)).evaluate(
        model.shell_contacts[0].least_gap
    )
    assert gap == pytest.approx(1.1 * 1.25 * h - h / 2 - 0.75 * h / (1.3 * 1.2), abs=1e-14)


def test_pressed_sheets() -> None:
    """Newton's method is quadratic; mid-surfaces are h/l^2 apart, and pressing stretches: h 1e-6.

    With the pressure q per undeformed area, the tension T and the penetration s, of each sheet that
    has grown to g

        (E g h/3)(l - l^-5) = T/g + q h/(2 g l^3),   d = g h/l^2 - s,   q = k (s - SOFT_PENETRATION
        h/2).
    """
    g = 1.1
    scene = sheets(grown=g)
    model, (term,) = scene.model, scene.model.shell_contacts
    system, r0 = model.system, model.r0.x.array.reshape(-1, 3)
    upper = r0[:, 2] > h / 2
    guess = r0 * (g * np.array([1.14, 1.15, 1.0]) - [1, 1, g])
    guess[upper, 2] = (0.75 * g - 1) * h
    mu = scene.unloaded().mu | {"load": 1.0, "natural_stretch": 1.0}
    u, steps = system.zero_at_supports(guess.ravel()), list[float]()
    for _ in range(12):
        step = spsolve(csr(system.tangent(u, mu)).tocsc(), system.residual(u, mu))
        u, steps = u - step, [*steps, float(np.abs(step).max())]
    assert steps[-1] < 1e-12
    below = [(a, b) for a, b in pairwise(steps) if a < 0.1 and b > 1e-12]
    assert len(below) >= 2
    assert all(b < 1e3 * a**2 for a, b in below), steps
    r = r0 + u.reshape(-1, 3)
    assert np.ptp(r[upper, 2]) < 1e-9 * h
    stretch, d = r[upper, 0].max() / g, r[upper, 2].mean() - r[~upper, 2].mean()
    assert stretch > 1.1
    q = system.at_state(State(u, mu)).evaluate(term.force)  # over E h/R, of an area of one
    assert q == pytest.approx(
        PRESSURE + FOUNDATION * u.reshape(-1, 3)[upper, 2].mean() / h, rel=1e-9
    )
    assert g**2 * (stretch - stretch**-5) / 3 == pytest.approx(
        TENSION + q * h / (2 * stretch**3), rel=1e-6
    )
    s = q / term.stiffness.value + SOFT_PENETRATION * h / 2
    assert d == pytest.approx(g * h / stretch**2 - s, abs=1e-6 * h)


def ring(**more: Any) -> Scene:
    """A tube between mirrors that can be pressed flat."""
    shell = {
        "geometry": "cylinder",
        "radius": 1,
        "length": 0.12,
        "thickness": h,
        "youngs_modulus": 1,
    }
    held = {"east": {"held": ["y"]}, "west": {"held": ["y"]}, "north": {"held": ["x"]}}
    return Scene(
        Case.model_validate(
            {
                "shell": shell | {"poisson_ratio": 0.5, "law": "mooney-rivlin", "mooney": 0.1},
                "boundary": {"bottom": "symmetry", "top": "symmetry"} | held,
                "points": {"east": [1, 0, 0], "west": [-1, 0, 0], "north": [0, 1, 0]},
                "contact": [["shell", "shell"]],
                "mesh": {"size": 0.2, "degree": 3},
                "loading": {"kind": "pressure"},
            }
            | more
        )
    )


def flattened(scene: Scene) -> Array:
    """The displacement (nodes, 3) of a tube that is pressed flat and stretched."""
    r = scene.model.r0.x.array.reshape(-1, 3)
    flat = 0 * r
    flat[:, 0] = 0.3 * r[:, 0]
    width = 0.4 * h * (1 + 0.02 * r[:, 0]) + 2.5 * np.maximum(np.abs(r[:, 0]) - 0.5, 0) ** 2
    flat[:, 1] = np.tanh(r[:, 1] / 0.2) * width - r[:, 1]
    return flat


def test_derivatives() -> None:
    """Of a tube that is pressed flat and stretched, at a rough state: differences of energy and
    forces, 1e-6.
    """
    scene = ring()
    check_derivatives(scene, flattened(scene), (0.05 * h, 0.3 * h), h)


@pytest.mark.slow
def test_derivatives_by_the_natural_stretch() -> None:
    """The slope of the energy, of the forces and of the slope itself: differences of fourth order,
    1e-6.
    """
    load = [{"kind": "natural", "stretch": 1}, {"kind": "pressure"}]
    scene = ring(natural={"stretch": ["1.2 + 0.1*x", 0.9], "along": [0, 0, 1]}, loading=load)
    system, (term,), flat = scene.model.system, scene.model.shell_contacts, flattened(scene).ravel()
    u = system.zero_at_supports(
        flat + 0.002 * h * np.random.default_rng(1).standard_normal(flat.size)
    )
    slope, step = system.parameters["natural_stretch"].slopes[-1], 1e-6
    (twice,) = system.parameters["natural_stretch"].second_derivatives(
        system.parameters["natural_stretch"].constant
    )[-1:]

    def mu(n: int) -> dict[str, float]:
        return scene.unloaded().mu | {"natural_stretch": 0.6 + n * step}

    def differed(of: Any) -> Any:
        return (8 * (of(1) - of(-1)) - (of(2) - of(-2))) / (12 * step)

    at = system.at_state(State(u, mu(0)))
    assert at.evaluate(term.penetration) > 0.05 * h
    force = np.zeros_like(u)
    at.evaluate(lambda: slope.add_residual(force, 1.0))
    assert at.evaluate(slope.energy) == pytest.approx(
        differed(lambda n: system.energies(u, mu(n))[term.name]), rel=1e-6
    )
    forces = differed(lambda n: system.forces(u, mu(n), term.name))
    assert np.abs(force - forces).max() < 1e-6 * np.abs(forces).max()
    assert at.evaluate(twice.energy) == pytest.approx(
        differed(lambda n: system.at_state(State(u, mu(n))).evaluate(slope.energy)), rel=1e-6
    )


def test_thin_walls_that_pass_through() -> None:
    """Stretched walls may come nearer than half the undeformed thickness, and still be apart."""
    scene = sheets()
    (term,), r0 = scene.model.shell_contacts, scene.model.r0.x.array.reshape(-1, 3)
    upper = r0[:, 2] > h / 2

    def apart(d: float) -> Array:
        u = r0 * [1.0, 1.0, 0.0]  # a quarter of h thick
        u[upper, 2] = (d - 1) * h
        return u

    assert not term.passes_through(apart(1.0), apart(0.26))
    assert term.passes_through(apart(0.3), apart(-0.3))
