"""Meridians that touch themselves, and those of rubber: derivatives, and the same as sectors and on
a rigid plane.
"""

from typing import Any

import numpy as np
import pytest
from along import check_derivatives
from numpy.typing import NDArray

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.system import State

Array = NDArray[np.float64]
h = 0.02
PRESSURE = {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.05, "points": 1}
RUBBER = {"poisson_ratio": 0.5, "law": "neo-hookean"}
FOLD = 0.5  # of the length of a bellows: how far its ends are pushed together


def cap(**shell: Any) -> dict[str, Any]:
    """One of two shells."""
    keys = {
        "geometry": "cap",
        "radius": 1,
        "polar": 30,
        "thickness": h,
        "youngs_modulus": 1,
        "poisson_ratio": 0.3,
    }
    return {"shell": keys | shell, "boundary": {"rim": "clamped"}}


def opposite(shell: dict[str, Any], z: float) -> dict[str, Any]:
    """That shell upside down with its origin at z."""
    return shell | {"place": {"position": [0, 0, z], "axis": {"polar": 180}}}


def two(lower: dict[str, Any], upper: dict[str, Any], z: float, **more: Any) -> Scene:
    """Both, which may touch."""
    case = {
        "shells": {"lower": lower, "upper": opposite(upper, z)},
        "contact": [["upper", "lower"]],
    }
    return Scene(Case.from_source(case | {"loading": PRESSURE} | more))


def stretched(scene: Scene, down: float) -> Array:
    """The displacement of both, stretched by 0.3 and pressed together."""
    model, r = scene.model, scene.model.r0.x.array.reshape(-1, 2)
    u = np.column_stack(
        [(0.3 + 0.02 * h * np.sin(5 * r[:, 0] + 1)) * r[:, 0], 0.02 * h * np.sin(5 * r[:, 0] + 1)]
    )
    u[np.unique(model.V.dofmap.list[model.meridian.patches["upper"]]), 1] -= down
    return u


def bellows(**more: Any) -> dict[str, Any]:
    """A tube with two pleats, whose ends are pushed together."""
    shell = {
        "geometry": "cylinder",
        "radius": 1,
        "length": 0.6,
        "thickness": h,
        "youngs_modulus": 1,
    }
    pleats = [{"kind": "formula", "w0": "0.09*sin(pi*z/0.15)"}]
    moves = [{"supports": ["top"], "translation": [0, 0, -FOLD]}]
    load = {
        "kind": "edge",
        "name": "down",
        "control": "load",
        "factor": 1,
        "points": 1,
        "moves": moves,
    }
    return {
        "shell": shell | {"poisson_ratio": 0.3, "imperfections": pleats},
        "boundary": {"bottom": "hinged", "top": "hinged"},
        "contact": [["shell", "shell"]],
        "loading": load,
    } | more


def folded(r: Array) -> Array:
    """A displacement (nodes, 2) at which walls of pleats are pressed on each other: omegas along
    e_z.
    """
    s, w = 2 * np.pi * r[:, 1] / 0.3, 0.09 * np.sin(np.pi * r[:, 1] / 0.15)
    return np.column_stack([1 + w - r[:, 0], 0.012 * s + 0.0049 * np.sin(4 * s) - r[:, 1]])


@pytest.mark.parametrize(
    ("lower", "upper", "z", "down"),
    [
        (RUBBER, RUBBER, 2 + h, 0.51 * h),
        ({}, RUBBER | {"thickness_factor": "1.2 - 6*(1 - z)"}, 2 + 1.1 * h, 0.4 * h),
        (RUBBER, RUBBER | {"hole": 5}, 2 * np.cos(np.radians(5)) + 1.01 * h, 0.52 * h),
    ],
)
def test_derivatives_of_rubber(
    lower: dict[str, Any], upper: dict[str, Any], z: float, down: float
) -> None:
    """Pole to pole, beside a shell that keeps its thickness, and an edge on a face: 1e-6."""
    scene = two(cap(**lower), cap(**upper), z)
    assert scene.model.axisymmetric
    check_derivatives(scene, stretched(scene, down), (0.02 * h, 0.9 * h), h, far=10.0)


def test_derivatives_of_what_has_grown() -> None:
    """Energy and forces by the natural stretch, of fourth order: 1e-6."""
    load = [{"kind": "natural", "stretch": 1}, PRESSURE]
    scene = two(cap(**RUBBER), cap(**RUBBER), 2 + h, natural={"stretch": 1.1}, loading=load)
    system, (term,), step = scene.model.system, scene.model.shell_contacts, 1e-6
    slope, u = (
        system.parameters["natural_stretch"].slopes[-1],
        system.zero_at_supports(stretched(scene, 0.4 * h).ravel()),
    )

    def mu(n: int) -> dict[str, float]:
        return scene.unloaded().mu | {"natural_stretch": 0.6 + n * step}

    def differed(of: Any) -> Any:
        return (8 * (of(1) - of(-1)) - (of(2) - of(-2))) / (12 * step)

    at, force = system.at_state(State(u, mu(0))), np.zeros_like(u)
    assert at.evaluate(term.penetration) > 0.02 * h
    assert at.evaluate(slope.energy) == pytest.approx(
        differed(lambda n: system.energies(u, mu(n))[term.name]), rel=1e-6
    )
    at.evaluate(lambda: slope.add_residual(force, 1.0))
    forces = differed(lambda n: system.forces(u, mu(n), term.name))
    assert np.abs(force - forces).max() < 1e-6 * np.abs(forces).max()


def test_derivatives_of_a_fold() -> None:
    """Walls of pleats of one shell, on both sides: 1e-6."""
    scene = Scene(Case.from_source(bellows(boundary={"bottom": "hinged"}, loading=PRESSURE)))
    r = scene.model.r0.x.array.reshape(-1, 2)
    check_derivatives(scene, folded(r), (0.02 * h, 0.9 * h), h)


def test_a_pair_of_all_shells_is_that_of_two() -> None:
    """`[[shell, shell]]` of two caps keeps the meridian, and has the energy and forces of `[[upper,
    lower]]`.
    """
    one, all_of = (
        two(cap(), cap(), 2 + h, **more) for more in ({}, {"contact": [["shell", "shell"]]})
    )
    assert all_of.model.axisymmetric
    seen = list[tuple[float, Array]]()
    for scene in (one, all_of):
        system, (term,) = scene.model.system, scene.model.shell_contacts
        u, mu = system.zero_at_supports(stretched(scene, 0.4 * h).ravel()), scene.unloaded().mu
        seen.append((system.energies(u, mu)[term.name], system.forces(u, mu, term.name)))
    assert seen[0][0] > 0
    assert seen[1][0] == pytest.approx(seen[0][0], rel=1e-12)
    assert seen[1][1] == pytest.approx(seen[0][1], abs=1e-12 * np.abs(seen[0][1]).max())


@pytest.mark.parametrize("m", [1, 3])
def test_thickness_along_a_wave(m: int) -> None:
    """Half the thickness changes as areas of the waved surface in space do: by cos m theta, twice
    by its mean.
    """
    scene = two(cap(**RUBBER), cap(**RUBBER), 2 + h)
    (term,), r = scene.model.shell_contacts, scene.model.r0.x.array.reshape(-1, 2)
    faces, u, nodes = term._offsets, stretched(scene, 0.1 * h), term._nodes
    U, V, W = (r[:, 0] ** (m + 1) * np.cos(k + 3 * r[:, 0] + r[:, 1]) for k in (1, 2, 3))
    wave, along, count = np.column_stack([U, V, W]), term._curves.slopes_at_nodes, 4 * m
    nodal = np.column_stack([r + u, wave])[nodes]
    values, slopes = nodal, np.einsum("qk,cki->cqi", along, nodal)

    def half(theta: float, e: float) -> Array:
        cos, sin = np.cos(m * theta), np.sin(m * theta)
        (rho, _, a, b, c), (rho1, z1, a1, b1, c1) = (
            np.moveaxis(each, -1, 0) for each in (values, slopes)
        )
        on = np.stack([rho1 + e * a1 * cos, e * b1 * sin, z1 + e * c1 * cos])
        around = np.stack(
            [-e * (m * a + b) * sin, rho + e * (a + m * b) * cos, -e * m * c * sin]
        )  # along e_rho, e_theta, e_z
        area = np.bincount(
            nodes.ravel(), np.linalg.norm(np.cross(on, around, axis=0), axis=0).ravel(), len(r)
        )
        return np.asarray(area)

    off, e = r[:, 0] > 1e-9, 1e-3
    volume = faces.half_thickness(u) * half(0.0, 0.0)
    angles = 2 * np.pi * (np.arange(count) + 0.3) / count
    ahead, here, back = (
        np.array([volume[off] / half(t, way * e)[off] for t in angles]) for way in (1, 0, -1)
    )
    of_wave = faces.waves(m)
    first = of_wave.jacobian(u, off) @ wave.ravel()
    expected = np.cos(m * angles)[:, None] * first[off]
    assert np.abs((ahead - back) / (2 * e) - expected).max() < 1e-5 * np.abs(expected).max()
    f = np.where(off, 1.0 + r[:, 0], 0.0)
    second = np.mean((ahead - 2 * here + back) / e**2, axis=0) @ f[off]
    assert wave.ravel() @ of_wave.hessian(u, f) @ wave.ravel() / 2 == pytest.approx(
        second, rel=1e-5
    )
