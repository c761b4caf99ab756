"""An ellipsoid as a body: its distance against brute force and a sphere, its place, and a shell
pressed by it.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from magshell_fenicsx import Case, CaseError
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.parts.bodies.ellipsoid import Ellipsoid
from magshell_fenicsx.parts.bodies.sphere import Sphere
from magshell_fenicsx.public import run

Array = NDArray[np.float64]
SEMI, CENTRE = np.array([0.5, 0.2, 0.3]), np.array([0.1, -0.2, 0.4])
AXES = np.linalg.qr(np.random.default_rng(2).normal(size=(3, 3)))[0]
BODY = Ellipsoid(CENTRE, AXES, SEMI)


def places(count: int, reach: float = 1.0) -> Array:
    return CENTRE + np.random.default_rng(1).uniform(-reach, reach, (count, 3))


def test_distance_is_that_of_the_nearest_of_many_places() -> None:
    """By angles, from the best of 40 000 places on, inside and outside."""
    theta, phi = (
        angles.ravel()
        for angles in np.meshgrid(np.linspace(0, np.pi, 200), np.linspace(0, 2 * np.pi, 200))
    )

    def surface(theta: Array, phi: Array) -> Array:
        unit = np.stack(
            [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
        )
        return np.asarray(CENTRE + SEMI * unit @ AXES)

    x = np.vstack([places(12), places(8, 0.15)])
    g = BODY(x)[0]
    assert (g < 0).any()
    assert (g > 0).any()
    for place, distance in zip(x, g, strict=True):
        away = np.linalg.norm(surface(theta, phi) - place, axis=1)
        first = theta[away.argmin()], phi[away.argmin()]

        def squared(angles: Array, place: Array = place) -> float:
            return float(((surface(*angles) - place) ** 2).sum())

        least = np.sqrt(minimize(squared, first, tol=1e-14).fun)
        assert abs(distance) == pytest.approx(least, abs=1e-8)


def test_gradient_and_hessian() -> None:
    """Against central differences; the gradient is a unit vector, and g grows by one along it."""
    x, step = places(200), 1e-6
    g, n, H = BODY(x)
    assert np.linalg.norm(n, axis=1) == pytest.approx(1)
    near = g > -0.05  # deeper inside another place is the nearest
    x, g, n, H = x[near], g[near], n[near], H[near]
    assert BODY(x + 0.1 * n)[0] == pytest.approx(g + 0.1)
    (low, along_low), (high, along_high) = (
        [np.stack([BODY(x + s * e)[i] for e in np.eye(3)], axis=-1) for i in (0, 1)]
        for s in (-step, step)
    )
    assert (high - low) / (2 * step) == pytest.approx(n, abs=1e-8)
    assert (along_high - along_low) / (2 * step) == pytest.approx(H, abs=1e-6 * np.abs(H).max())


@pytest.mark.parametrize("semi", [np.full(3, 0.3), np.array([0.5, 0.5, 0.3])])
def test_planes_of_symmetry(semi: Array) -> None:
    """At places on its axes and in its planes, its centre and its surface among them, all is
    finite.
    """
    body = Ellipsoid(np.zeros(3), np.eye(3), semi)
    x = np.vstack(
        [np.zeros(3), np.diag(0.5 * semi), np.diag(semi), np.diag(2 * semi), [[0.2, 0.0, 0.1]]]
    )
    g, n, H = body(x)
    assert all(np.isfinite(each).all() for each in (g, n, H))
    assert g[4:7] == pytest.approx(0, abs=1e-15)
    assert g[7:10] == pytest.approx(semi)
    assert n[7:10] == pytest.approx(np.eye(3), abs=1e-11)


def test_a_ball_is_a_sphere() -> None:
    body, ball = Ellipsoid(CENTRE, AXES, np.full(3, 0.3)), Sphere(CENTRE, 0.3)
    for own, other in zip(body(places(50)), ball(places(50)), strict=True):
        assert own == pytest.approx(other, abs=1e-10)


def case(symmetry: str = "auto", **body: Any) -> Case:
    """A flat disc under an ellipsoid, coarse."""
    ellipsoid = {"kind": "ellipsoid", "semi_axes": [0.6, 0.3, 0.2], "axis": [1, 0, 0], **body}
    return Case.model_validate(
        {
            "shell": {"geometry": "disc", "radius_to_thickness": 30, "poisson_ratio": 0.3},
            "boundary": {"rim": "clamped"},
            "bodies": {"egg": ellipsoid},
            "loading": {"kind": "contact", "approach": 0.5, "points": 2},
            "mesh": {"degree": 2, "size": 0.15},
            "symmetry": symmetry,
        }
    )


def test_place_and_symmetry() -> None:
    """Its front touches the face; of equal semi-axes it turns about the approach."""
    (contact,) = make_problem(case()).loads.contacts
    assert contact.front == pytest.approx([0, 0, 1 / 60])
    assert contact.size == pytest.approx(0.3**2 / 0.2)
    assert contact.distance(contact.front[None])[0] == pytest.approx(0, abs=1e-15)
    assert make_problem(case()).is_half
    assert make_problem(case(axis=[1, 2, 0])).is_half
    assert make_problem(case(semi_axes=[0.3, 0.3, 0.2])).axisymmetric
    short, unit = (
        make_problem(case(axis=[size, 2 * size, 0], direction=[0, 0, -size])).loads.contacts[0]
        for size in (1e-300, 1)
    )
    assert np.array_equal(short.distance.axes, unit.distance.axes)  # type: ignore[attr-defined]


def test_mistakes() -> None:
    """A unit beside a shell without one is refused."""
    with pytest.raises(CaseError, match="axis: is along the approach"):
        make_problem(case(axis=[0, 0, 1]))
    for key in ("position", "semi_axes"):
        with pytest.raises(
            ValueError, match=f"bodies.egg.{key}.0: has a unit, but the shell's lengths have none"
        ):
            case(**{key: ["1 mm", "2 mm", "30 mm"]})


def force(one: Case) -> float:
    """On the body at the end of its way."""
    result = run(one)
    assert result.stopped is None
    return float(result.rows[-1]["force"])


@pytest.mark.slow
def test_half_and_full_shells_push_back_alike() -> None:
    """On coarse meshes that differ; and with equal semi-axes as the meridian under a ball."""
    half, full = (force(case(symmetry)) for symmetry in ("half", "none"))
    assert full > 0.1
    assert half == pytest.approx(full, rel=1e-2)
    egg = case(semi_axes=[0.3] * 3)
    ball = egg.model_dump(exclude_unset=True) | {
        "bodies": {"ball": {"kind": "sphere", "radius": 0.3}}
    }
    assert force(egg) == pytest.approx(force(Case.model_validate(ball)), rel=1e-9)
