"""Loads and supports along lines within a surface: joined edges, and curves of a mesh file."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sheets import Sheet, write

from magshell_fenicsx import Case, CaseError, Scene
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.simulate.follow import follow

THICKNESS, MODULUS = 0.01, 210e9
MATERIAL = {"thickness": THICKNESS, "youngs_modulus": MODULUS, "poisson_ratio": 0.3}
D = MODULUS * THICKNESS**3 / 12 / (1 - 0.3**2)
HALVES = [
    Sheet("a", (0, 0, 0), (0.5, 0, 0), (0, 1, 0), (4, 8)),
    Sheet("b", (0.5, 0, 0), (0.5, 0, 0), (0, 1, 0), (4, 8)),
]


def joined(load: dict[str, Any], line: Any = "free", **further: Any) -> Case:
    """Two plates that are joined, hinged all around."""
    plate = {"geometry": "plate", "length": 0.5, "width": 1, **MATERIAL}
    hinged = {"bottom": "hinged", "top": "hinged"}
    held = {} if line == "free" else {"right": line}
    return Case.from_source({
        "shells": {
            "a": {"shell": plate, "boundary": {**held, "left": "hinged", **hinged},
                  "points": {"middle": [0.25, 0.5, 0]}},
            "b": {"shell": plate, "boundary": {"right": "hinged", **hinged},
                  "place": {"position": [0.5, 0, 0]}, "points": {"edge": [0, 0.5, 0]}},
        },
        "joints": [{"edges": ["a.right", "b.left"]}],
        "loading": {"kind": "dead", "loads": [load], "factor": 1, "control": "load", "points": 1},
        "mesh": {"size": 0.125}, "reactions": True, **further,
    })  # fmt: skip


def from_file(folder: Path, load: dict[str, Any], model: str = "shell", **boundary: Any) -> Case:
    """The same plate in a mesh file, hinged at all free edges but those that `boundary` names."""
    file = write(folder / "plate.msh", HALVES, joined=True)
    sides = dict.fromkeys(("a_1", "a_3", "a_4", "b_1", "b_2", "b_3"), "hinged")
    return Case.from_source({
        "shell": {"geometry": "mesh", "file": str(file), "radius": 1, **MATERIAL},
        "boundary": {**boundary, **sides},
        "points": {"middle": [0.25, 0.5, 0], "edge": [0.5, 0.5, 0]},
        "loading": {"kind": "dead", "loads": [load], "factor": 1, "control": "load", "points": 1},
        "model": model, "reactions": True,
    })  # fmt: skip


def row(case: Case) -> dict[str, float]:
    scene = Scene(case)
    *_, last = follow(scene)
    return scene.observe(last.point.state)


@pytest.mark.parametrize(
    "load",
    [{"per_length": [0, 0, -1]}, {"force": [0, 0, -1]}, {"per_length": [0, 0, "-1 + 0*y"]}],
    ids=["per length", "in all", "formula"],
)
def test_line_load_on_a_plate(tmp_path: Path, load: dict[str, Any]) -> None:
    """A square plate under a line load in its middle: 0.00674 q a³/D (Timoshenko), 3.505e-7 m.

    The loaded line is a joint of two plates, and a curve of a mesh file.
    """
    of_joint = row(joined({"edge": "a.right", **load}))
    assert of_joint["b_edge_uz"] == pytest.approx(-0.006741 / D, rel=1e-3)
    assert of_joint["b_edge_uz"] == pytest.approx(-3.505e-7, rel=1e-3)
    curve = row(from_file(tmp_path, {"edge": "a_2", **load}))
    assert curve["edge_uz"] == pytest.approx(of_joint["b_edge_uz"], rel=1e-3)


def knife_edge() -> tuple[float, float]:
    """Return w at (1/4, 1/2) and the force on a knife edge at x = 1/2, for a pressure of 1, over D.

    Navier's series of a simply supported square plate: the edge's forces r_m sin(m pi y) cancel the
    deflection along it.
    """
    m, n = (odd.astype(float) for odd in np.meshgrid(np.arange(1, 400, 2), np.arange(1, 2000)))
    pressure = np.where(n % 2, 16 / (np.pi**2 * m * n), 0.0)
    flexibility = 1 / (np.pi**4 * (m**2 + n**2) ** 2)
    at_edge, at_quarter = np.sin(n * np.pi / 2), np.sin(n * np.pi / 4)
    compliance = (2 * at_edge**2 * flexibility).sum(axis=0)
    forces = (pressure * at_edge * flexibility).sum(axis=0) / compliance
    amplitudes = ((pressure - 2 * forces * at_edge) * flexibility * at_quarter).sum(axis=0)
    orders = m[0]
    w = float((amplitudes * np.sin(orders * np.pi / 2)).sum())
    return w, float((forces * 2 / (np.pi * orders)).sum())


@pytest.mark.parametrize("line", ["hinged", {"held": ["z"]}], ids=["hinged", "held"])
def test_knife_edge_under_a_plate(tmp_path: Path, line: Any) -> None:
    """A plate under a pressure on a knife edge in its middle: w by Navier's series, 1e-3.

    Its force, of all nodes on it, has a part of the corners' that mesh decides: 2e-2.
    """
    w, force = knife_edge()
    pressed = {"over": "all", "pressure": 1}
    of_joint = row(joined(pressed, line))
    curve = row(from_file(tmp_path, pressed, a_2=line))
    for deflection in (of_joint["a_middle_uz"], curve["middle_uz"]):
        assert deflection == pytest.approx(-w / D, rel=1e-3)
    for reaction in (of_joint["a_right_fz"], curve["a_2_fz"]):
        assert reaction == pytest.approx(force, rel=2e-2)


def test_a_line_is_not_clamped_or_halved(tmp_path: Path) -> None:
    """What a line cannot have is refused; a half that could cut along it is not taken."""
    with pytest.raises(MeshError, match="a_2: is a line within the surface"):
        from_file(tmp_path, {"over": "all", "pressure": 1}, a_2="clamped").problem().triangulated()
    with pytest.raises(MeshError, match="edge: a_2: is a line within the surface"):
        Scene(from_file(tmp_path, {"edge": "a_2", "moment": 1}))
    whole = from_file(tmp_path, {"edge": "a_2", "force": [0, 0, 1]})
    assert Scene(whole).model.multiplicity == 1
    with pytest.raises(CaseError, match=r"half: a line within a mesh file .* does not share it"):
        whole.model_copy(update={"symmetry": "half"}).problem()
    solid = from_file(tmp_path, {"over": "all", "pressure": 1}, model="solid", a_2="hinged")
    with pytest.raises(MeshError, match=r"boundary\.a_2: the surface has no such edge"):
        solid.problem().triangulated()


def test_a_ring_within_a_sector() -> None:
    """The whole shell of a sector, in which other modes are counted, has the line on all copies."""
    tube = {"geometry": "cylinder", "radius": 1, "length": 0.5, "thickness": 0.05,
            "youngs_modulus": 1e4, "poisson_ratio": 0.3}  # fmt: skip
    lower, upper = (
        {"shell": tube, "points": {"point": [1, 0, 0.25]}, **further}
        for further in ({"boundary": {"bottom": "clamped"}}, {"place": {"position": [0, 0, 0.5]}})
    )
    load = {"edge": "upper.bottom", "per_length": [0, 0, -1e-3]}
    scene = Scene(
        Case.from_source({
            "shells": {"lower": lower, "upper": upper},
            "joints": [{"edges": ["lower.top", "upper.bottom"]}],
            "loading": {"kind": "dead", "loads": [load], "factor": 1, "control": "load",
                        "points": 1},
            "mesh": {"refinement": 0.5, "degree": 3}, "reactions": True, "symmetry": 4,
        })
    )  # fmt: skip
    *_, last = follow(scene)
    observed = scene.observe(last.point.state)
    assert observed["lower_bottom_fz"] == pytest.approx(2 * np.pi * 1e-3, rel=1e-4)
    assert last.excluded_pivots == 0
