"""Half of any shape with a mirror plane, against all of it on the mirrored mesh."""

from pathlib import Path
from typing import Any

import gmsh
import numpy as np
import pytest
from numpy.typing import NDArray
from test_composition import NU, H, end

import magshell_fenicsx as ms
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.shells.modes import ShellModes

MATERIAL = {"thickness": H, "poisson_ratio": NU, "youngs_modulus": 1.0}
AROUND = dict.fromkeys(("left", "right", "bottom", "top"), "clamped")
DEAD = {"kind": "dead", "loads": [{"over": "all", "pressure": 1e-5}], "factor": 1, "points": 1}
PLATE = {"geometry": "plate", "length": 1.0, "width": 0.5}
SQUARE = {"geometry": "plate", "length": 1.0, "width": 1.0}
PANEL = {"geometry": "cylinder", "radius": 1.0, "length": 0.5, "azimuth": [10, 65]}
TORUS = {"geometry": "torus", "radius": 1.0, "tube_radius": 0.4, "azimuth": [0, 60]}
ACROSS = {"lambda_m": 1e-3, "applied": {"polar": 90}, "remanent": {"polar": 90}}
HALVES: dict[str, tuple[list[float], dict[str, Any]]] = {
    "plate magnetised across its plane": (
        [1, 0, 0],
        {"shell": PLATE, "boundary": AROUND, "magnetic": ACROSS},
    ),
    "plate clamped at one side": ([0, 1, 0], {"shell": PLATE, "boundary": {"left": "clamped"}}),
    "plate between two clamps, pulled apart": (
        [1, 0, 0],
        {
            "shell": PLATE,
            "boundary": {"bottom": "clamped"},
            "loading": DEAD
            | {
                "loads": [
                    {"edge": "left", "force": [-1e-6, 0, 0]},
                    {"edge": "right", "force": [1e-6, 0, 0]},
                ]
            },
        },
    ),
    "square plate clamped at two sides": (
        [1, -1, 0],
        {"shell": SQUARE, "boundary": {"left": "clamped", "bottom": "clamped"}},
    ),
    "panel": (
        [-np.sin(np.radians(37.5)), np.cos(np.radians(37.5)), 0],
        {"shell": PANEL, "boundary": AROUND},
    ),
    "panel under live pressure": (
        [0, 0, 1],
        {
            "shell": PANEL,
            "boundary": AROUND | {"left": "hinged"},
            "loading": {
                "kind": "pressure",
                "until": "target",
                "control": "load",
                "pressure": 0.05,
                "points": 1,
            },
        },
    ),
    "sector of a ring": (
        [-np.sin(np.radians(27.5)), np.cos(np.radians(27.5)), 0],
        {
            "shell": {
                "geometry": "annulus",
                "radius": 1.0,
                "inner_radius": 0.5,
                "azimuth": [-30, 85],
            },
            "boundary": {"outer": "clamped"},
        },
    ),
    "piece of a torus": ([0, 0, 1], {"shell": TORUS, "boundary": {"left": "clamped"}}),
    "thicker on both sides": (
        [1, 0, 0],
        {"shell": PLATE | {"thickness_factor": "1 + (2*x - 1)**2"}, "boundary": AROUND},
    ),
}


def case(symmetry: str, **sections: Any) -> ms.Case:
    data = {"loading": DEAD, "mesh": {"degree": 3, "size": 0.26}, "symmetry": symmetry, **sections}
    data["shell"] = MATERIAL | data["shell"]
    return ms.Case.from_source(data)


@pytest.mark.parametrize("name", HALVES)
def test_half_and_whole_agree(name: str) -> None:
    """The size gives the whole a line in its plane: its mesh is the half's and the mirror image of
    that.
    """
    normal, sections = HALVES[name]
    asked = case("auto", **sections)
    problem = make_problem(asked)
    assert problem.mirror
    across = np.array(normal) / np.linalg.norm(normal)
    assert abs(problem.mirror.normal @ across) == pytest.approx(1)
    half, whole = end(asked), end(case("none", **sections))
    for column in ("w_over_h", "w_pole_over_h", "volume_change", "energy", "bending"):
        assert half[column] == pytest.approx(whole[column], rel=1e-9, abs=1e-13)


SOLID_HALVES = (
    "plate magnetised across its plane",
    "panel",
    "panel under live pressure",
)


@pytest.mark.parametrize("name", SOLID_HALVES)
def test_half_and_whole_solids_agree(name: str) -> None:
    """The same of bodies, with planes of any direction and away from the origin."""
    sections = HALVES[name][1] | {"model": "solid", "mesh": {"size": 0.26}}
    asked = case("auto", **sections)
    assert make_problem(asked).mirror
    half, whole = end(asked), end(case("none", **sections))
    for column in ("w_over_h", "w_pole_over_h", "volume_change", "energy"):
        assert half[column] == pytest.approx(whole[column], rel=1e-8, abs=1e-13)


def test_a_half_of_a_solid_knows_the_modes_of_the_whole() -> None:
    """As of shells: the plane is oblique."""
    sections = HALVES["panel"][1] | {"model": "solid", "mesh": {"size": 0.26}}
    half, whole = (ms.Scene(case(s, **sections)) for s in ("half", "none"))
    found = [ShellModes(scene.model).lowest(scene.unloaded(), 4) for scene in (half, whole)]
    assert {mode.label for mode in found[0][:4]} == {"", "antisymmetric"}
    values = [[mode.eigenvalue for mode in modes[:4]] for modes in found]
    assert values[0] == pytest.approx(values[1], rel=1e-6)


NOT_HALVED: list[dict[str, Any]] = [
    {"shell": PLATE, "boundary": {"left": "clamped", "bottom": "hinged"}},
    {"shell": PLATE | {"thickness_factor": "1 + x*y"}, "boundary": AROUND},
    {
        "shell": PLATE,
        "boundary": {"left": {"held": ["x", "y", "z"]}},
        "points": {"A": [1, 0, 0], "B": [1, 0.5, 0]},
    },
    {
        "shell": PLATE,
        "boundary": {"left": "clamped"},
        "loading": DEAD | {"loads": [{"edge": "right", "force": [0, 1e-6, 0]}]},
    },
    {
        "shell": SQUARE,
        "boundary": {"A": {"held": ["x", "y", "z"]}, "left": "hinged"},
        "points": {"A": [1, 0, 0]},
    },
    {
        "shell": PANEL,
        "boundary": AROUND | {"left": {"held": ["x"]}, "right": {"held": ["x"]}, "top": "free"},
    },
    {
        "shell": PLATE,
        "boundary": AROUND,
        "magnetic": ACROSS | {"applied": {"polar": 45, "azimuth": 30}},
    },
]


@pytest.mark.parametrize("sections", NOT_HALVED)
def test_a_part_that_leaves_no_plane(sections: dict[str, Any]) -> None:
    assert not make_problem(case("auto", **sections)).mirror
    with pytest.raises(CaseError, match="no common mirror plane"):
        make_problem(case("half", **sections))


def test_a_half_knows_the_modes_of_the_whole() -> None:
    """Its own and those antisymmetric to an oblique plane are those of the whole panel."""
    half, whole = (ms.Scene(case(s, **HALVES["panel"][1])) for s in ("half", "none"))
    found = [ShellModes(scene.model).lowest(scene.unloaded(), 4) for scene in (half, whole)]
    assert {mode.label for mode in found[0][:4]} == {"", "antisymmetric"}
    values = [[mode.eigenvalue for mode in modes[:4]] for modes in found]
    assert values[0] == pytest.approx(values[1], rel=1e-7)


def written(
    file: Path,
    nodes: NDArray[np.float64],
    cells: NDArray[np.int64],
    rim: NDArray[np.int64],
    order: int = 3,
) -> Path:
    """A file of triangles, with the edge `rim`."""
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    surface, curve = gmsh.model.addDiscreteEntity(2), gmsh.model.addDiscreteEntity(1)
    gmsh.model.mesh.addNodes(2, surface, np.arange(1, len(nodes) + 1), nodes.ravel())
    gmsh.model.mesh.addElementsByType(surface, {1: 2, 3: 21}[order], [], (cells + 1).ravel())
    gmsh.model.mesh.addElementsByType(curve, 1, [], (rim + 1).ravel())
    gmsh.model.addPhysicalGroup(2, [surface], name="all")
    gmsh.model.addPhysicalGroup(1, [curve], name="rim")
    gmsh.write(str(file))
    gmsh.finalize()
    return file


def mesh_of(asked: ms.Case, file: Path) -> Path:
    """The triangles of a built-in half, and their mirror images, as an order-3 mesh file."""
    patch = make_problem(asked).triangulated()
    places, n = patch.embedding(patch.nodes), len(patch.nodes)
    on_plane = np.abs(places[:, 1]) < 1e-12
    places[on_plane, 1] = 0
    image = np.where(on_plane, np.arange(n), n + np.cumsum(~on_plane) - 1)
    cells = np.vstack([patch.cells, image[patch.cells[:, [0, 2, 1, 8, 7, 6, 5, 4, 3, 9]]]])
    rim = np.vstack([patch.edges["equator"], image[patch.edges["equator"]]])
    return written(file, np.vstack([places, places[~on_plane] * [1, -1, 1]]), cells, rim)


DIMPLED = {"defect": {"kind": "dimple", "amplitude": 1.64, "width": 3.2}}
FOUND = {
    "force": ({}, {"kind": "indentation", "at": {"polar": 0}, "depth": 10, "points": 4}),
    "p_over_pc": (DIMPLED, {"kind": "pressure"}),
}


def result(asked: ms.Case, column: str) -> float:
    """At the first instability, or at the end."""
    scene = ms.Scene(asked)
    records = list(ms.follow(scene))
    located = [record for record in records if record.label in ("fold", "bifurcation")]
    return scene.observe((located or records[-1:])[0].point.state)[column]


@pytest.mark.slow
@pytest.mark.parametrize("column", FOUND)
def test_an_order_3_mesh_file_of_a_hemisphere(column: str, tmp_path: Path) -> None:
    """F(10) and k_d on the triangles of the built-in half, cubic in place of exact; by half and
    whole.
    """
    defect, loading = FOUND[column]
    shell = {"geometry": "hemisphere", "radius_to_thickness": 1 / H, "poisson_ratio": NU, **defect}
    mesh = {"degree": 3, "refinement": 0.5}
    data = {
        "shell": shell,
        "boundary": {"equator": "clamped"},
        "loading": loading,
        "mesh": mesh,
        "symmetry": "half",
    }
    built_in = ms.Case.from_source(data)
    file = mesh_of(built_in, tmp_path / "hemisphere.msh")
    shell = {
        "geometry": "mesh",
        "file": str(file),
        "radius": 1.0,
        "thickness": H,
        "poisson_ratio": NU,
    }
    data = {
        "shell": shell,
        "boundary": {"rim": "clamped"},
        "mesh": {"degree": 3},
        "loading": loading,
    }
    if column == "force":
        data |= {"points": {"A": [0, 0, 1]}, "loading": loading | {"at": {"point": "A"}}}
    half, whole = (ms.Case.from_source(data | {"symmetry": s}) for s in ("auto", "none"))
    assert (make_problem(half).is_half, make_problem(whole).is_half) == (True, False)
    found = result(half, column)
    assert found == pytest.approx(result(built_in, column), rel=2e-4)
    assert found == pytest.approx(result(whole, column), rel=1e-9)


SOLID = pytest.param({"model": "solid"}, marks=pytest.mark.slow)


@pytest.mark.parametrize("model", [{"mesh": {"degree": 3}}, SOLID])
def test_a_mesh_file_with_a_curve_in_its_plane(model: dict[str, Any], tmp_path: Path) -> None:
    """Other triangles on either side: one of them is half of the surface, if that is asked for."""
    grid = {"shell": MATERIAL | PLATE, "boundary": {}, "mesh": {"size": 0.25}, "symmetry": "none"}
    patch = make_problem(ms.Case.from_source(grid)).triangulated()
    nodes = patch.embedding(patch.nodes)
    move = (nodes[:, 0] > 0.51) & (nodes[:, 0] < 0.99) & (nodes[:, 1] > 0.01) & (nodes[:, 1] < 0.49)
    nodes[move] += [0.03, 0.02, 0.0]
    file = written(
        tmp_path / "plate.msh", nodes, patch.cells, np.vstack(list(patch.edges.values())), order=1
    )
    shell = {"geometry": "mesh", "file": str(file), "radius": 1.0, **MATERIAL}
    sections = {"shell": shell, "boundary": {"rim": "clamped"}, "mesh": {}, **model}
    assert not make_problem(case("auto", **sections)).mirror
    half, whole = (end(case(s, **sections)) for s in ("half", "none"))
    # the triangles differ: 5e-3 apart
    assert half["w_over_h"] == pytest.approx(whole["w_over_h"], rel=1e-2)
    nodes[(np.abs(nodes[:, 0] - 0.5) < 1e-9) & (nodes[:, 1] > 0.4), 0] += 0.01
    written(file, nodes, patch.cells, np.vstack(list(patch.edges.values())), order=1)
    with pytest.raises(CaseError, match="mesh a half, mirror the nodes"):
        make_problem(case("half", **sections))
