"""T-junctions: a stiffened plate against its beam, a plate that a web twists, derivatives, ranks,
and messages.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sheets import Sheet, write

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.assembly.nonlocal_terms import times
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.shells.t_junctions import SurfaceTJunction
from magshell_fenicsx.simulate.follow import follow

h, WIDTH = 0.02, 0.25
D = h**3 / 12


def plate(length: float, width: float, **keys: Any) -> dict[str, Any]:
    shell = {"geometry": "plate", "length": length, "width": width, "thickness": h}
    return {"shell": shell | {"youngs_modulus": 1, "poisson_ratio": 0}, **keys}


def stiffened(length: float, height: float, modulus: float = 1.0) -> dict[str, Any]:
    """A cantilever with a web along its middle, under a force at its end."""
    place = {"position": [0, WIDTH / 2, 0], "axis": {"polar": 90, "azimuth": -90}, "turn": 90}
    web = plate(length, height, place=place, boundary={"left": "clamped"})
    web["shell"]["youngs_modulus"] = modulus
    base = plate(
        length, WIDTH, boundary={"left": "clamped"}, points={"tip": [length, WIDTH / 2, 0]}
    )
    return {
        "shells": {"base": base, "web": web},
        "joints": [{"edges": ["web.bottom", "base"]}],
        "mesh": {"degree": 3, "size": 0.15},
        "loading": {"kind": "dead", "control": "load",
                    "loads": [{"edge": "base.right", "force": [0, 0, 1e-9]}],
                    "factor": 1, "points": 1},
    }  # fmt: skip


def pushed(joint: dict[str, Any], off: float = 0.0) -> dict[str, Any]:
    """A plate between clamped ends. A force pushes the top of a web across its middle sideways."""
    base = plate(1, WIDTH, boundary={"left": "clamped", "right": "clamped"})
    place = {"position": [0.5, 0, 0.3 + off], "axis": {"polar": 90}}
    web = plate(0.3, WIDTH, place=place, points={"top": [0, WIDTH / 2, 0]})
    return {
        "shells": {"base": base, "web": web},
        "joints": [{"edges": ["web.right", "base"], **joint}],
        "mesh": {"degree": 3, "size": 0.1},
        "loading": {"kind": "dead", "control": "load",
                    "loads": [{"edge": "web.left", "force": [1e-9, 0, 0]}],
                    "factor": 1, "points": 1},
    }  # fmt: skip


def placed(place: dict[str, Any]) -> dict[str, Any]:
    """The same with the web elsewhere."""
    data = pushed({})
    data["shells"]["web"]["place"] = place
    return data


def end(data: dict[str, Any]) -> tuple[Scene, State, dict[str, float]]:
    scene = Scene(Case.from_source(data))
    *_, last = follow(scene)
    return scene, last.point.state, scene.observe(last.point.state)


def test_stiffened_plate() -> None:
    """F L^3/(3 EI) of the T-shaped section, 3e-3; the tip is that of the plate, not of the web at
    the same place.
    """
    length, height, modulus = 4.0, 0.1, 4.0
    flange, web = WIDTH * h, modulus * height * h
    axis = web * height / 2 / (flange + web)
    EI = WIDTH * D + flange * axis**2 + web * height**2 / 12 + web * (height / 2 - axis) ** 2
    _, _, seen = end(stiffened(length, height, modulus))
    assert seen["base_tip_uz"] == pytest.approx(1e-9 * length**3 / (3 * EI), rel=3e-3)


@pytest.mark.parametrize("height", [0.1, pytest.param(-0.1, marks=pytest.mark.slow)])
def test_a_mesh_file_in_which_edges_have_three_triangles(tmp_path: Path, height: float) -> None:
    """The same plate, read: the beam's deflection, 3e-3; with a web on both sides too, as an edge
    with four.
    """
    length, parts = 4.0, (16, 2)
    sheets = [
        Sheet("base", (0, 0, 0), (length, 0, 0), (0, WIDTH, 0), parts),
        Sheet("web", (0, WIDTH / 2, 0), (length, 0, 0), (0, 0, abs(height)), (16, 1)),
    ]
    EI = WIDTH * D
    if height > 0:
        axis = height**2 * h / 2 / (WIDTH * h + height * h)
        EI += WIDTH * h * axis**2 + h * height**3 / 12 + height * h * (height / 2 - axis) ** 2
    else:
        sheets.append(Sheet("keel", (0, WIDTH / 2, 0), (length, 0, 0), (0, 0, height), (16, 1)))
        EI += h * (2 * abs(height)) ** 3 / 12
    file = write(tmp_path / "beam.msh", sheets, joined=True)
    data = {
        "shell": {"geometry": "mesh", "file": str(file), "radius": 1, "thickness": h,
                  "youngs_modulus": 1,
                  "poisson_ratio": 0},
        "boundary": {f"{sheet.name}_4": "clamped" for sheet in sheets},
        "points": {"tip": [length, WIDTH / 2, 0]},
        "mesh": {"degree": 3},
        "symmetry": "none",
        "loading": {"kind": "dead", "control": "load",
                    "loads": [{"edge": "base_2", "force": [0, 0, 1e-9]}],
                    "factor": 1, "points": 1},
    }  # fmt: skip
    _, _, seen = end(data)
    assert seen["tip_uz"] == pytest.approx(1e-9 * length**3 / (3 * EI), rel=3e-3)


def test_a_web_that_turns_a_plate() -> None:
    """The plate turns by M/(16 D), a spring by M/k, and the web bends: beam theory, 2e-3."""
    height, force = 0.3, 1e-9 / WIDTH
    bent = force * height**3 / (3 * D) + force * height**2 / (16 * D)
    _, _, seen = end(pushed({}))
    assert seen["web_top_ux"] == pytest.approx(bent, rel=2e-3)
    _, _, seen = end(pushed({"kind": "spring", "stiffness": 2 * D}))
    assert seen["web_top_ux"] == pytest.approx(bent + force * height**2 / (2 * D), rel=5e-4)


def test_derivatives() -> None:
    """Central differences at a rough state: of the energy, and of the forces to 1e-6."""
    scene = Scene(
        Case.from_source(
            pushed({"kind": "spring", "stiffness": 1.0}) | {"mesh": {"degree": 3, "size": 0.2}}
        )
    )
    system, mu = scene.model.system, scene.unloaded().mu
    (term,) = (each for each in system.terms if isinstance(each, SurfaceTJunction))
    rng = np.random.default_rng(0)
    u, v = (
        system.zero_at_supports(size * rng.standard_normal(system.size)) for size in (1e-3, 1.0)
    )
    at = system.at_state(State(u, mu))
    Kv = times([(1.0, at.evaluate(term.entries))], v)
    low, high = (system.forces(u + side * 1e-7 * v, mu, term.name) for side in (-0.5, 0.5))
    assert np.abs((high - low) / 1e-7 - Kv).max() < 1e-6 * np.abs(Kv).max()
    below, above = (system.energies(u + side * 1e-6 * v, mu)[term.name] for side in (-0.5, 0.5))
    assert (above - below) / 1e-6 == pytest.approx(system.forces(u, mu, term.name) @ v, rel=1e-5)


def test_a_hinge_lets_the_web_fall() -> None:
    with pytest.raises(MeshError, match="free to"):
        list(follow(Scene(Case.from_source(pushed({"kind": "hinge"})))))


def test_messages() -> None:
    with pytest.raises(
        MeshError,
        match=r"joints.0.edges: the edge web_right is not on the mid-surface of base, by 0.01 R",
    ):
        Scene(Case.from_source(pushed({}, off=0.01)))
    with pytest.raises(
        MeshError, match=r"joints.0.edges: web.rim: is no edge; an edge stands first"
    ):
        Scene(Case.from_source(pushed({}) | {"joints": [{"edges": ["web.rim", "base"]}]}))


def ringed(radius: float) -> dict[str, Any]:
    """A cylinder with a ring of some radius inside, on their meridians."""
    material = {"thickness": h, "youngs_modulus": 1, "poisson_ratio": 0.3}
    wall = {"geometry": "cylinder", "radius": 1, "length": 1, **material}
    rib = {"geometry": "annulus", "radius": radius, "inner_radius": 0.9, **material}
    return {
        "shells": {
            "wall": {"shell": wall, "boundary": {"bottom": "clamped"}},
            "rib": {"shell": rib, "place": {"position": [0, 0, 0.5]}},
        },
        "joints": [{"edges": ["rib.outer", "wall"]}],
        "loading": {"kind": "pressure"},
    }


LYING = {
    "position": [0.2, 0, 0],
    "axis": {"polar": 0},
}  # in the plane of the base, its right edge in the middle
ASLANT = {
    "position": [0.5 - 0.3 * np.cos(0.1), 0, 0.3 * np.sin(0.1)],
    "axis": {"polar": 180 * 0.1 / np.pi},
}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (pushed({}, off=0.01), "the edge web.right is not on the mid-surface of base, by 0.01 R"),
        (
            pushed({}) | {"joints": [{"edges": ["web.left", "base"]}]},
            "the edge web.left is not on the mid-surface of base, by more",
        ),
        (
            ringed(0.99),
            "the edge rib.outer is not on the mid-surface of wall, by 0.01 R at (0.99, 0, 0.5)",
        ),
        (
            placed(LYING),
            (
                "the shell of the edge web.right lies in the mid-surface of base, "
                "where both take the same place"
            ),
        ),
    ],
)
def test_check_refuses_what_a_run_refuses(data: dict[str, Any], message: str) -> None:
    """In the same words, but for the names of edges, which are those of the case."""
    case = Case.from_source(data)
    with pytest.raises(MeshError) as of_run:
        Scene(case)
    with pytest.raises(CaseError) as of_check:
        describe(case)
    assert message in str(of_check.value)
    assert re.sub("(web|rib)_", r"\1.", str(of_run.value)) in str(of_check.value)


def two_webs(distance: float) -> Case:
    """Two webs that stand on one base, side by side."""
    data = pushed({})
    twin = {**data["shells"]["web"], "points": {}}
    twin["place"] = {"position": [0.5 + distance, 0, 0.3], "axis": {"polar": 90}}
    joints = [*data["joints"], {"edges": ["twin.right", "base"]}]
    return Case.from_source(data | {"shells": {**data["shells"], "twin": twin}, "joints": joints})


def test_two_webs_in_one_place_are_refused() -> None:
    """Both would be joined to the base and not to each other: 1.7 times as stiff as one web."""
    words = "shells of the edges web.right and twin.right lie in each other: leave one"
    with pytest.raises(CaseError, match=words):
        describe(two_webs(0.0))
    with pytest.raises(MeshError, match=words.replace(".right", "_right")):
        Scene(two_webs(0.0))
    assert "mesh: " in describe(two_webs(0.1))


def test_a_web_that_stands_aslant_is_accepted() -> None:
    """At six degrees, where it takes the same place for ten thicknesses."""
    assert "mesh: " in describe(Case.from_source(placed(ASLANT)))
