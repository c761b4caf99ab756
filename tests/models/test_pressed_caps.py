"""Two equal caps pressed pole to pole: by symmetry each is one on a rigid plane between them."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial import cKDTree

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.simulate.follow import follow

h, TOP = 0.02, np.cos(np.radians(2))
CAP = {
    "geometry": "cap", "radius": 1, "polar": 40, "hole": 2, "azimuth": [-2.5, 2.5], "thickness": h,
    "youngs_modulus": 1, "poisson_ratio": 0.3,
}  # fmt: skip
HELD = {"rim": "clamped", "left": "symmetry", "right": "symmetry"}
MESH = {"degree": 3, "size": 0.04}
TURNED, MOVED = (
    np.diag([1.0, -1, -1]),
    np.array([0, 0, 2 * TOP + h]),
)  # the upper cap: the lower one about the x axis


def pressed(**moves: float) -> dict[str, Any]:
    """Rims that move along e3 by so many thicknesses for a factor of one, to one."""
    moving = [
        {"supports": [name.replace("_", ".")], "translation": [0, 0, z * h]}
        for name, z in moves.items()
    ]
    return {
        "kind": "edge",
        "name": "w",
        "control": "load",
        "factor": 1,
        "points": 1,
        "moves": moving,
    }


@pytest.mark.slow
def test_two_caps_are_one_on_a_plane() -> None:
    """F at h to 1e-3.

    The equilibrium of two begins as that of one and its image, and is solved. Two share a
    penetration, so that the same law has half the stiffness. The meshes do not match: one is the
    other turned, and a plane would mirror it.
    """
    plane = {
        "kind": "plane",
        "at": {"polar": 2, "azimuth": 0},
        "position": [0, 0, TOP + h / 2],
        "direction": [0, 0, -1],
    }
    alone = {"shell": CAP, "boundary": HELD, "symmetry": "none", "bodies": {"plane": plane}}
    one = Scene(Case.from_source({**alone, "mesh": MESH, "loading": pressed(rim=1)}))
    cap = {"shell": CAP, "boundary": HELD}
    place = {"position": list(MOVED), "axis": {"polar": 180}, "turn": 180}
    shells = {"lower": cap, "upper": {**cap, "place": place}}
    loading = pressed(lower_rim=1, upper_rim=-1)
    data = {
        "shells": shells,
        "contact": [["upper", "lower"]],
        "symmetry": "none",
        "mesh": MESH,
        "loading": loading,
    }
    two = Scene(Case.from_source(data))
    (touching,) = two.model.shell_contacts
    r, of_one = (scene.model.r0.x.array.reshape(-1, 3) for scene in (two, one))
    (far, i), (far_turned, j) = (
        cKDTree(nodes).query(r) for nodes in (of_one, of_one @ TURNED.T + MOVED)
    )
    lower = far < far_turned
    assert np.minimum(far, far_turned).max() < 1e-12
    compared = 0
    for record in follow(one):
        state, w = record.point.state, record.point.state.mu["w"]
        if record.label != "target":
            continue
        seen, u = one.observe(state), state.u.reshape(-1, 3)
        image = np.where(lower[:, None], u[i], u[j] @ TURNED.T).ravel()
        mu = {**two.unloaded().mu, "w": w, touching.pair.setting: seen["contact_stiffness"] / 2}
        outcome = two.newton.solve(
            State(two.model.system.zero_at_supports(image), mu), "w", PrescribedLoad("w", w)
        )
        assert outcome.converged, outcome.reason
        force = two.observe(outcome.state)["contact_force"] * two.model.force_unit
        assert force == pytest.approx(seen["reaction"] / h, rel=1e-3)
        compared += 1
    assert compared == 1
