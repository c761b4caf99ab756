"""Forces of contact on bodies: normal forces and resultants against reactions, weights, a ring's
elastica.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_bvp

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.output.fields.contact_peak import contact_peak
from magshell_fenicsx.simulate.follow import follow

Array = NDArray[np.float64]
Row = dict[str, float]


def ends(**sections: Any) -> tuple[Scene, list[State]]:
    """Return the scene of a case, and the states at the targets of its steps."""
    scene = Scene(Case.from_source({"reactions": True, **sections}))
    return scene, [r.point.state for r in follow(scene) if r.label == "target"]


def targets(**sections: Any) -> list[Row]:
    """Return what is observed at the targets of a case's steps."""
    scene, states = ends(**sections)
    return [scene.observe(state) for state in states]


def vector(row: Row, name: str, kind: str) -> Array:
    return np.array([row[f"{name}_{kind}{axis}"] for axis in "xyz"])


HEMISPHERE = {"geometry": "hemisphere", "radius_to_thickness": 40, "poisson_ratio": 0.3}


def test_models_agree() -> None:
    """A plate on the pole: meridian and half have the same forces, those of the support."""
    rows = [
        targets(
            shell=HEMISPHERE,
            boundary={"equator": "clamped"},
            bodies={"plate": {"kind": "plane", "stiffness": 1e3, "penetration": 0.1}},
            loading={"kind": "contact", "approach": 0.5, "points": 1},
            mesh={"degree": 3, "refinement": 0.5},
            symmetry=symmetry,
        )[0]
        for symmetry in ("axisymmetric", "half")
    ]
    for row in rows:
        assert row["plate_normal_force"] == pytest.approx(row["force"], rel=1e-12)
        assert vector(row, "plate", "contact_f") == pytest.approx(
            vector(row, "equator", "f"), abs=1e-9 * row["equator_fz"]
        )
        assert vector(row, "plate", "contact_m") == pytest.approx(
            np.zeros(3), abs=1e-3 * row["equator_fz"]
        )
    assert rows[1]["plate_normal_force"] == pytest.approx(rows[0]["plate_normal_force"], rel=0.01)


@pytest.mark.parametrize("symmetry", ["axisymmetric", "half"])
def test_moment_about_a_point_off_the_axis(symmetry: str) -> None:
    """A plate presses at the pole: the moment is that of its force there."""
    position = np.array([0.3, 0.2, 1 + 1 / 80])
    (row,) = targets(
        shell=HEMISPHERE,
        boundary={"equator": "clamped"},
        bodies={
            "plate": {
                "kind": "plane", "stiffness": 1e3, "penetration": 0.1,
                "position": position.tolist(), "direction": [0, 0, -1],
            }
        },
        loading={"kind": "contact", "approach": 0.5, "points": 1},
        mesh={"degree": 3, "refinement": 0.4},
        symmetry=symmetry,
    )  # fmt: skip
    force = vector(row, "plate", "contact_f")
    expected = np.cross([0, 0, position[2]] - position, force)
    assert np.linalg.norm(expected) > 0.3 * abs(force[2])
    assert vector(row, "plate", "contact_m") == pytest.approx(expected, abs=2e-3 * force[2])


@pytest.mark.parametrize("symmetry", ["half", "none"])
def test_moment_about_a_point_off_the_mirror_plane(symmetry: str) -> None:
    """A bar across a cantilever, whose reference point is on an edge: the force is in the middle.

    The ball on which it rests has its centre as reference point: its forces have no moment.
    """
    bar = {"kind": "cylinder", "radius": 0.1, "axis": [0, 1, 0], "direction": [0, 0, -1]}
    ball = {"kind": "sphere", "radius": 0.1, "direction": [0, 0, 1], "side": "inside"}
    (row,) = targets(
        shell=STRIP,
        boundary={"left": "clamped"},
        bodies={
            "bar": bar | {"position": [0.9, 0, 0.1 + h / 2]},
            "ball": ball | {"position": [0.5, WIDTH / 2, -0.1 - h / 2]},
        },
        loading={"kind": "contact", "body": "bar", "approach": 2, "points": 1},
        mesh={"degree": 3, "size": 0.2},
        symmetry=symmetry,
    )
    force, moment = (vector(row, "bar", f"contact_{kind}") for kind in "fm")
    assert moment[[0, 2]] == pytest.approx(
        WIDTH / 2 * np.array([force[2], -force[0]]), rel=1e-6, abs=1e-9 * force[2]
    )
    assert moment[1] == pytest.approx(0, abs=1e-6 * force[2])
    assert row["ball_normal_force"] > row["bar_normal_force"]
    assert vector(row, "ball", "contact_m") == pytest.approx(np.zeros(3), abs=1e-9 * force[2])


h, WIDTH = 0.01, 0.1
STRIP = {
    "geometry": "plate", "length": 1, "width": WIDTH, "thickness": h, "youngs_modulus": 1,
    "poisson_ratio": 0,
}  # fmt: skip


def test_two_fingers_squeeze_a_bar() -> None:
    """The bar has no force along its direction, which is across the squeeze; each finger's normal
    force is the reaction of its clamp, the resultant the sum of both.
    """
    radius = 0.1
    place = {"position": [0, 0, h + 2 * radius]}
    finger = {"shell": STRIP, "boundary": {"left": "clamped"}}
    (row,) = targets(
        shells={"lower": finger, "upper": {**finger, "place": place}},
        bodies={"bar": {
            "kind": "cylinder", "radius": radius, "axis": [0, 1, 0], "direction": [1, 0, 0],
            "position": [0.8, WIDTH / 2, h / 2 + radius],
        }},
        mesh={"degree": 3, "size": 0.2},
        loading={
            "kind": "edge", "control": "load", "factor": 1, "points": 1,
            "moves": [{"supports": ["upper.left"], "translation": [0, 0, -5 * h]}],
        },
    )  # fmt: skip
    reactions = {name: vector(row, f"{name}_left", "f") for name in ("lower", "upper")}
    unit = 2 * np.pi * h**3 / 12  # of normal forces: 2 pi D/R
    normals = [row[f"bar_{name}_normal_force"] for name in reactions]
    assert sum(normals) == pytest.approx(row["bar_normal_force"], rel=1e-12)
    assert normals[1] > 0
    assert unit * np.array(normals) == pytest.approx(
        [np.linalg.norm(force) for force in reactions.values()], rel=1e-3
    )
    largest = np.abs([*reactions.values()]).max()
    assert vector(row, "bar", "contact_f") == pytest.approx(
        sum(reactions.values()), abs=1e-8 * largest
    )
    assert vector(row, "bar", "contact_m") == pytest.approx(np.zeros(3), abs=1e-8 * largest)


SHELLS: dict[str, tuple[dict[str, Any], float]] = {
    "disc": ({"geometry": "disc", "radius": "1 m"}, np.pi),
    "plate": ({"geometry": "plate", "length": "1 m", "width": "0.5 m"}, 0.5),
}  # shell, and its area
SUPPORTING = {
    "plane": {"kind": "plane", "position": [0, 0, -0.025], "side": "inside"},
    "box": {
        "kind": "box", "size": [0.6, 0.6, 0.2], "edge": 0.02, "axis": [1, 0, 0],
        "position": [0.5, 0.25, -0.125],
    },
    "bar": {"kind": "cylinder", "radius": 0.3, "axis": [0, 1, 0], "position": [0.5, 0.25, -0.325]},
}  # fmt: skip


@pytest.mark.parametrize(
    ("shell_name", "body_name", "spring"),
    [("disc", "plane", 1e-5), ("plate", "plane", 1e-5), ("plate", "box", 1e-6),
     ("plate", "bar", 1e-7)],
)  # fmt: skip
def test_weight(shell_name: str, body_name: str, spring: float) -> None:
    """A shell without supports rests on a body, which bears its weight, 1e-3; springs, which would
    let it sink by a part of its thickness and more, hold it while it does not touch.
    """
    shell, area = SHELLS[shell_name]
    acceleration, thickness = spring, 0.05  # over E/(rho R), and R
    (row,) = targets(
        shell={
            "thickness": f"{thickness} m", "youngs_modulus": "1 Pa", "poisson_ratio": 0.3,
            "density": "1 kg/m^3", **shell,
        },
        boundary={},
        foundation={"stiffness": spring, "tangential": spring},
        bodies={"support": {**SUPPORTING[body_name], "direction": [0, 0, 1]}},
        loading={"kind": "gravity", "acceleration": acceleration, "points": 1},
        mesh={"refinement": 0.5},
    )  # fmt: skip
    weight = acceleration * thickness * area
    assert row["support_contact_fz"] == pytest.approx(-weight, rel=1e-3)
    unit = 2 * np.pi * thickness**3 / 12 / (1 - 0.3**2)
    assert unit * row["support_normal_force"] == pytest.approx(weight, rel=1e-3)


def squeezed_ring(approach: float) -> float:
    """Return the force of a plate on a quarter of an inextensible ring, R = EI = 1.

    From the plate on, t is the tangent's angle to it and k the curvature: t' = k, k' = P cos t,
    y' = sin t. The ring touches where k > 0, or with k = 0 behind a flat part of length a.
    """

    def slopes(s: Array, z: Array, p: Array, *, flat: bool) -> Array:
        P, length = p[0], np.pi / 2 - (p[1] if flat else 0)
        return np.asarray(length * np.stack([z[1], P * np.cos(z[0]), np.sin(z[0])]))

    def ends(z0: Array, z1: Array, p: Array, *, flat: bool) -> Array:
        touching = [z0[0], z0[2], z0[1] - (0 if flat else p[1])]
        return np.array([*touching, z1[0] - np.pi / 2, z1[2] - (1 - approach)])

    s = np.linspace(0, 1, 41)
    guess = np.stack([np.pi / 2 * s, 1 + 0 * s, s])
    for flat in (False, True):
        found = solve_bvp(
            lambda *args, flat=flat: slopes(*args, flat=flat),
            lambda *args, flat=flat: ends(*args, flat=flat),
            s, guess, p=[2.0, 0.3], tol=1e-8,
        )  # fmt: skip
        assert found.success
        if found.p[1] > 0:
            break
    return float(found.p[0])


@pytest.mark.slow
def test_a_ring_between_plates() -> None:
    """The force is the elastica's while it touches along one line, and along two, 1e-3; so is the
    force per length that pictures name, within some per cent.
    """
    thickness, width, approaches = 0.02, 0.12, (15, 35)
    edges = "left", "right", "bottom", "top"
    scene, states = ends(
        shell={
            "geometry": "cylinder", "radius": 1, "length": width, "thickness": thickness,
            "youngs_modulus": 1, "poisson_ratio": 0, "azimuth": [0, 90],
        },
        boundary=dict.fromkeys(edges, "symmetry"),
        bodies={"plate": {"kind": "plane", "at": {"point": [0, 1, width / 2]}}},
        mesh={"degree": 3, "size": 0.1},
        loading=[{"kind": "contact", "approach": a, "points": 1} for a in approaches],
    )  # fmt: skip
    for approach, state in zip(approaches, states, strict=True):
        row, peak = scene.observe(state), contact_peak(scene.model, state)
        force = squeezed_ring(approach * thickness) * width * thickness**3 / 12
        assert row["plate_contact_fy"] == pytest.approx(force, rel=1e-3)
        assert peak is not None
        assert peak.line_force == pytest.approx(force / (width * thickness), rel=0.05)
        assert sum(row[f"{edge}_fy"] for edge in edges) == pytest.approx(
            row["plate_contact_fy"], rel=1e-8
        )
