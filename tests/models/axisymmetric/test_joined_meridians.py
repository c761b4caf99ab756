"""Joined coaxial shells on their meridians: beams on elastic foundations, a shell cut in two,
differences.
"""

from typing import Any

import numpy as np
import pytest
from conftest import CASES

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError, read_source
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Record

NU, THIN, THICK, LENGTH, PRESSURE = 0.3, 1e-4, 2e-4, 0.15, 1e-6
PRESSED = {"kind": "pressure", "until": "target", "pressure": PRESSURE, "points": 1}


def cylinder(
    z: float, h: float, points: dict[str, Any] | None = None, **keys: Any
) -> dict[str, Any]:
    shell = {"geometry": "cylinder", "radius": 1, "length": LENGTH, "thickness": h}
    material = {"youngs_modulus": 1, "poisson_ratio": NU}
    return {
        "shell": {**shell, **material},
        "place": {"position": [0, 0, z]},
        "points": points or {},
        **keys,
    }


def end(data: dict[str, Any]) -> tuple[Scene, Record, dict[str, Any]]:
    scene = Scene(Case.from_source({"symmetry": "axisymmetric", **data}))
    *_, last = follow(scene)
    return scene, last, scene.observe(last.point.state)


def beam(h: float) -> tuple[float, float, float]:
    """Bending stiffness, decay, and the radial displacement under p = 1 of a long cylinder (R = E =
    1).
    """
    return h**3 / (12 * (1 - NU**2)), (3 * (1 - NU**2)) ** 0.25 / np.sqrt(h), -1 / h


def of_two_cylinders(k: float) -> float:
    """Where they meet, under p = 1, joined by a spring k: Timoshenko & Woinowsky-Krieger, Plates
    and Shells, 114.

    With w = delta + exp(-beta x)(A cos beta x + B sin beta x), x away from the joint, w' = beta (B
    - A), w'' = -2 beta^2 B and w''' = 2 beta^3 (A + B) there; shear and moment are D w''' and D
    w''.
    """
    (D, b, d), (E, c, e) = beam(THIN), beam(THICK)
    rows = [
        [1, 0, -1, 0],  # w
        [D * b**3, D * b**3, E * c**3, E * c**3],  # shear
        [0, D * b**2, 0, -E * c**2],  # moment
        [-k * b, k * b + 2 * D * b**2, -k * c, k * c],  # k (w1' + w2') = moment
    ]
    A = np.linalg.solve(np.array(rows), [e - d, 0, 0, 0])[0]
    return float(d + A)


@pytest.mark.parametrize("kind", ["rigid", "hinge", "spring"])
def test_two_cylinders(kind: str) -> None:
    """Of different thickness, joined, under pressure: where they meet they move as by beam theory,
    1e-5.
    """
    D, b, _ = beam(THIN)
    k = {"rigid": 1e6 * D * b, "hinge": 0.0, "spring": D * b}[kind]
    joint = {
        "edges": ["low.top", "high.bottom"],
        "kind": kind,
        **({"stiffness": k} if kind == "spring" else {}),
    }
    low = cylinder(0, THIN, {"joint": [1, 0, LENGTH]}, boundary={"bottom": "clamped"})
    scene, _, seen = end(
        {
            "shells": {"low": low, "high": cylinder(LENGTH, THICK)},
            "joints": [joint],
            "loading": PRESSED,
        }
    )
    p = PRESSURE * scene.model.material.classical_pressure
    assert seen["low_joint_ux"] == pytest.approx(p * of_two_cylinders(k), rel=1e-5)


def test_a_ring_in_a_cylinder() -> None:
    """A T-junction: the beam at a point support of a ring by Lamé; what is left is what the tie
    gives way, 2e-4.
    """
    inner = 0.97
    wall = cylinder(0, THIN, {"foot": [1, 0, LENGTH / 2]}, boundary={"bottom": "clamped"})
    ring = {
        "geometry": "annulus",
        "radius": 1,
        "inner_radius": inner,
        "thickness": THICK,
        "youngs_modulus": 1,
    }
    rib = {"shell": {**ring, "poisson_ratio": NU}, "place": {"position": [0, 0, LENGTH / 2]}}
    joints = [{"edges": ["rib.outer", "wall"]}]
    loading = {**PRESSED, "on": {"wall": "outside"}}
    scene, _, seen = end(
        {"shells": {"wall": wall, "rib": rib}, "joints": joints, "loading": loading}
    )
    D, b, d = beam(THIN)
    of_ring = ((1 - NU) + (1 + NU) * inner**2) / (1 - inner**2) / THICK
    force = d / (of_ring + 1 / (8 * b**3 * D))
    p = PRESSURE * scene.model.material.classical_pressure
    assert seen["wall_foot_ux"] == pytest.approx(p * force * of_ring, rel=2e-4)


def cap(**keys: Any) -> dict[str, Any]:
    shell = {
        "geometry": "cap",
        "radius": 1,
        "thickness": 0.03,
        "youngs_modulus": 1,
        "poisson_ratio": 0.3,
        **keys,
    }
    return {"shell": shell}


def test_a_shell_cut_in_two_is_the_shell() -> None:
    """It buckles under the same pressure, in the same waves around e3, to 1e-9."""
    top, low = cap(polar=40), {**cap(polar=80, hole=40), "boundary": {"rim": "clamped"}}
    loading = {"kind": "pressure", "until": "bifurcation"}
    cut = {"shells": {"top": top, "low": low}, "joints": [{"edges": ["low.hole", "top.rim"]}]}
    shell = {**cap(polar=80), "boundary": {"rim": "clamped"}}
    one, other = (
        end({**data, "loading": loading, "mesh": {"size": 2 * np.pi / 180}})[1]
        for data in (cut, shell)
    )
    assert one.mode == other.mode != "symmetric"
    assert one.point.state.mu["pressure"] == pytest.approx(
        other.point.state.mu["pressure"], rel=1e-9
    )


def test_frequencies_of_a_free_shell_cut_in_two() -> None:
    """Its rigid motions are those of one body, and its vibrations those of the shell, 1e-5 on
    coarse cells.
    """
    cut = {"shells": {"top": cap(polar=40), "low": cap(polar=80, hole=40)}}
    cut |= {"joints": [{"edges": ["low.hole", "top.rim"]}]}
    found = []
    for data in (cut, cap(polar=80) | {"boundary": {"rim": "free"}}):
        scene = Scene(Case.from_source({**data, "mesh": {"size": np.pi / 18}, "frequencies": {}}))
        assert scene.model.axisymmetric
        found.append(
            ShellModes(scene.model).vibrations(scene.unloaded(), 6, allows_rigid_motion=True)
        )
    assert [mode.label for mode in found[0]] == [mode.label for mode in found[1]]
    squares = [np.array([mode.eigenvalue for mode in of]) for of in found]
    assert not squares[0][:4].any()
    assert squares[0][4:] == pytest.approx(squares[1][4:], rel=1e-5)


DOME = {**cap(polar=60), "points": {"top": [0, 0, 1]}}
WALL = {
    "shell": {
        "geometry": "cylinder",
        "radius": np.sqrt(3) / 2,
        "length": 0.3,
        "thickness": 0.02,
        "youngs_modulus": 2,
        "poisson_ratio": 0.25,
    },
    "boundary": {"bottom": "clamped"},
    "place": {"position": [0, 0, 0.2]},
}
RING = {
    "shell": {
        "geometry": "annulus",
        "radius": np.sqrt(3) / 2,
        "inner_radius": 0.7,
        "thickness": 0.02,
        "youngs_modulus": 1,
        "poisson_ratio": 0.3,
    },
    "place": {"position": [0, 0, 0.4]},
}


@pytest.mark.parametrize(
    "edges", [["dome.rim", "wall.top"], ["ring.outer", "wall"]], ids=["edges", "tee"]
)
def test_derivatives(edges: list[str]) -> None:
    """Of energy and forces against differences at a rough state; more with a stiffer spring."""
    shells = (
        {"wall": WALL, "dome": DOME} if edges[0] == "dome.rim" else {"wall": WALL, "ring": RING}
    )
    products = []
    for stiffness in (1e-4, 2e-4):
        joints = [{"edges": edges, "kind": "spring", "stiffness": stiffness}]
        scene = Scene(Case.from_source({"shells": shells, "joints": joints, "mesh": {"size": 0.1}}))
        model, mu = scene.model, scene.unloaded().mu
        assert model.axisymmetric
        system, rng = model.system, np.random.default_rng(0)
        u, v = (
            system.zero_at_supports(size * rng.standard_normal(system.size)) for size in (1e-4, 1.0)
        )
        K = system.tangent(u, mu)
        x, product = K.createVecs()
        x.setArray(v)
        K.mult(x, product)
        low, high = (system.residual(u + side * 1e-7 * v, mu) for side in (-0.5, 0.5))
        assert (
            np.abs((high - low) / 1e-7 - product.array).max() < 1e-6 * np.abs(product.array).max()
        )
        products.append(v @ product.array)
    assert products[1] > products[0]


def test_dome_on_wall() -> None:
    """The case buckles where a half of both surfaces does with cells of 0.08, at 0.572106: 1e-5."""
    _, last, _ = end(read_source(CASES / "dome_on_wall.yaml").data)
    assert last.mode == "m = 5"
    assert last.point.state.mu["pressure"] == pytest.approx(0.572106, rel=1e-5)


@pytest.mark.slow
def test_a_half_of_both_surfaces() -> None:
    """Folded by a spring, then pressed: as a half with cells of 0.12, 2e-5."""
    case = read_source(CASES / "dome_on_wall.yaml").data
    joints = [
        {"edges": ["dome.rim", "wall.top"], "kind": "spring", "stiffness": 1e-5, "angle": -40}
    ]
    case |= {
        "joints": joints,
        "loading": {"kind": "pressure", "until": "target", "pressure": 0.25, "points": 1},
    }
    _, _, seen = end(case)
    _, _, half = end(case | {"symmetry": "half", "mesh": {"size": 0.12}})
    for key in ("volume_change", "dome_top_uz"):
        assert seen[key] == pytest.approx(half[key], rel=2e-5)


RIM = {
    "geometry": "annulus",
    "radius": 1,
    "inner_radius": 0.8,
    "thickness": 0.02,
    "youngs_modulus": 1,
}
BOX = {
    "outer": {**cylinder(0, 0.02), "boundary": {}},
    "top": {"shell": {**RIM, "poisson_ratio": NU}, "place": {"position": [0, 0, LENGTH]}},
    "low": {
        "shell": {**RIM, "poisson_ratio": NU},
        "place": {"axis": {"polar": 180}},
        "boundary": {"inner": "clamped"},
    },
}
AROUND = [{"edges": ["outer.top", "top.outer"]}, {"edges": ["outer.bottom", "low.outer"]}]
TUBE = {
    "geometry": "torus",
    "radius": 1,
    "tube_radius": 0.3,
    "thickness": 0.02,
    "youngs_modulus": 1,
}
CLOSED = {
    "shells": {
        "up": {"shell": {**TUBE, "poisson_ratio": NU, "tube": [0, 180]}, "boundary": {}},
        "down": {"shell": {**TUBE, "poisson_ratio": NU, "tube": [180, 360]}, "boundary": {}},
    },
    "joints": [{"edges": ["up.top", "down.bottom"]}, {"edges": ["down.top", "up.bottom"]}],
}
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "ring": (CLOSED, "joints: shells are joined in a ring"),
    "contact": (
        {"contact": [["outer", "top"]]},
        "contact: shells that are joined to each other are modelled with",
    ),
    "sides": ({"joints": [{"edges": ["outer.top", "low.outer"]}]}, "point to opposite sides"),
    "apart": (
        {"joints": [{"edges": ["outer.top", "top.inner"]}]},
        "point to opposite sides|do not meet",
    ),
    "none": ({"joints": [{"edges": ["outer.top", "top.rim"]}]}, "there is no such edge"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_modelled_on_surfaces(name: str) -> None:
    """What has no meridian says why, and `symmetry: auto` takes surfaces."""
    keys, message = REFUSED[name]
    data = {"shells": BOX, "joints": AROUND, **keys}
    with pytest.raises(CaseError, match=message):
        make_problem(Case.from_source({**data, "symmetry": "axisymmetric"}))
    if name == "contact":
        assert make_problem(Case.from_source({**data, "symmetry": "auto"})).meridian is None
        assert make_problem(Case.from_source({**data, "contact": []})).meridian
