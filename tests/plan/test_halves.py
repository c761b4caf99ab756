"""Half of any shape with a mirror plane, against all of it on the mirrored mesh."""

from pathlib import Path
from typing import Any

import gmsh
import numpy as np
import pytest
from numpy.typing import NDArray
from test_composition import NU, H, end

import magshell_fenicsx as ms
from magshell_fenicsx.case.source import CaseError, Source
from magshell_fenicsx.models.modes import ShellModes
from magshell_fenicsx.plan.planner import make_plan

MATERIAL = {"thickness": H, "poisson_ratio": NU, "youngs_modulus": 1.0}
AROUND = dict.fromkeys(("left", "right", "bottom", "top"), "clamped")
DEAD = {"kind": "dead", "loads": [{"over": "all", "pressure": 1e-5}], "factor": 1, "points": 1}
PLATE = {"geometry": "plate", "length": 1.0, "width": 0.5}
SQUARE = {"geometry": "plate", "length": 1.0, "width": 1.0}
PANEL = {"geometry": "cylinder", "radius": 1.0, "length": 0.5, "azimuth": [10, 65]}
TORUS = {"geometry": "torus", "radius": 1.0, "tube_radius": 0.4, "azimuth": [0, 60]}
ACROSS = {"lambda_m": 1e-3, "applied": {"polar": 90}, "remanent": {"polar": 90}}
HALVES: dict[str, tuple[list[float], dict[str, Any]]] = {
    "plate": ([1, 0, 0], {"shell": PLATE, "boundary": AROUND}),
    "plate magnetised across its plane": ([1, 0, 0], {"shell": PLATE, "boundary": AROUND, "magnetic": ACROSS}),
    "plate clamped at one side": ([0, 1, 0], {"shell": PLATE, "boundary": {"left": "clamped"}}),
    "plate between two clamps, pulled apart": (
        [1, 0, 0],
        {
            "shell": PLATE,
            "boundary": {"bottom": "clamped"},
            "loading": DEAD
            | {"loads": [{"edge": "left", "force": [-1e-6, 0, 0]}, {"edge": "right", "force": [1e-6, 0, 0]}]},
        },
    ),
    "square plate clamped at two sides": (
        [1, -1, 0],
        {"shell": SQUARE, "boundary": {"left": "clamped", "bottom": "clamped"}},
    ),
    "panel": ([-np.sin(np.radians(37.5)), np.cos(np.radians(37.5)), 0], {"shell": PANEL, "boundary": AROUND}),
    "panel clamped at one side": ([0, 0, 1], {"shell": PANEL, "boundary": {"left": "clamped"}}),
    "panel under live pressure": (
        [0, 0, 1],
        {
            "shell": PANEL,
            "boundary": AROUND | {"left": "hinged"},
            "loading": {"kind": "pressure", "until": "target", "control": "load", "pressure": 0.05, "points": 1},
        },
    ),
    "sector of a ring": (
        [-np.sin(np.radians(27.5)), np.cos(np.radians(27.5)), 0],
        {
            "shell": {"geometry": "annulus", "radius": 1.0, "inner_radius": 0.5, "azimuth": [-30, 85]},
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
    return ms.Case.from_source(Source("test", data))


@pytest.mark.parametrize("name", HALVES)
def test_half_and_whole_agree(name: str) -> None:
    """The size gives the whole a line in its plane: its mesh is the half's and the mirror image of that."""
    normal, sections = HALVES[name]
    asked = case("auto", **sections)
    plan = make_plan(asked)
    assert plan.mirror
    across = np.array(normal) / np.linalg.norm(normal)
    assert abs(plan.mirror.normal @ across) == pytest.approx(1)
    half, whole = end(asked), end(case("none", **sections))
    for column in ("w_over_h", "w_pole_over_h", "volume_change", "energy", "bending"):
        assert half[column] == pytest.approx(whole[column], rel=1e-9, abs=1e-13)


NOT_HALVED: list[dict[str, Any]] = [
    {"shell": PLATE, "boundary": {"left": "clamped", "bottom": "hinged"}},
    {"shell": PLATE | {"thickness_factor": "1 + x*y"}, "boundary": AROUND},
    {"shell": PLATE, "boundary": {"left": {"held": ["x", "y", "z"]}}, "points": {"A": [1, 0, 0], "B": [1, 0.5, 0]}},
    {
        "shell": PLATE,
        "boundary": {"left": "clamped"},
        "loading": DEAD | {"loads": [{"edge": "right", "force": [0, 1e-6, 0]}]},
    },
    {"shell": SQUARE, "boundary": {"A": {"held": ["x", "y", "z"]}, "left": "hinged"}, "points": {"A": [1, 0, 0]}},
    {"shell": PANEL, "boundary": AROUND | {"left": {"held": ["x"]}, "right": {"held": ["x"]}, "top": "free"}},
    {"shell": PLATE, "boundary": AROUND, "magnetic": ACROSS | {"applied": {"polar": 45, "azimuth": 30}}},
]


@pytest.mark.parametrize("sections", NOT_HALVED)
def test_a_part_that_leaves_no_plane(sections: dict[str, Any]) -> None:
    assert not make_plan(case("auto", **sections)).mirror
    with pytest.raises(CaseError, match="no common mirror plane"):
        make_plan(case("half", **sections))


def test_a_half_knows_the_modes_of_the_whole() -> None:
    """Its own and those antisymmetric to an oblique plane are those of the whole panel."""
    half, whole = (ms.Scene(case(s, **HALVES["panel"][1])) for s in ("half", "none"))
    found = [ShellModes(scene.model).lowest(scene.unloaded(), 4) for scene in (half, whole)]
    assert {mode.label for mode in found[0][:4]} == {"", "antisymmetric"}
    values = [[mode.eigenvalue for mode in modes[:4]] for modes in found]
    assert values[0] == pytest.approx(values[1], rel=1e-7)


def written(file: Path, nodes: NDArray[np.float64], cells: NDArray[np.int64], rim: NDArray[np.int64]) -> Path:
    """A file of cubic triangles, with the edge `rim`."""
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    surface, curve = gmsh.model.addDiscreteEntity(2), gmsh.model.addDiscreteEntity(1)
    gmsh.model.mesh.addNodes(2, surface, np.arange(1, len(nodes) + 1), nodes.ravel())
    gmsh.model.mesh.addElementsByType(surface, 21, [], (cells + 1).ravel())
    gmsh.model.mesh.addElementsByType(curve, 1, [], (rim + 1).ravel())
    gmsh.model.addPhysicalGroup(2, [surface], name="all")
    gmsh.model.addPhysicalGroup(1, [curve], name="rim")
    gmsh.write(str(file))
    gmsh.finalize()
    return file


@pytest.fixture(scope="module")
def hemisphere_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The triangles of the built-in half, and their mirror images, as an order-3 mesh file."""
    shell = {"geometry": "hemisphere", "radius_to_thickness": 1 / H, "poisson_ratio": NU}
    data = {"shell": shell, "boundary": {"equator": "clamped"}, "symmetry": "half", **INDENTED}
    patch = make_plan(ms.Case.from_source(Source("test", data))).triangulated()
    places, n = patch.embedding(patch.nodes), len(patch.nodes)
    on_plane = np.abs(places[:, 1]) < 1e-12
    places[on_plane, 1] = 0
    image = np.where(on_plane, np.arange(n), n + np.cumsum(~on_plane) - 1)
    cells = np.vstack([patch.cells, image[patch.cells[:, [0, 2, 1, 8, 7, 6, 5, 4, 3, 9]]]])
    rim = np.vstack([patch.edges["equator"], image[patch.edges["equator"]]])
    nodes = np.vstack([places, places[~on_plane] * [1, -1, 1]])
    return written(tmp_path_factory.mktemp("mesh") / "hemisphere.msh", nodes, cells, rim)


INDENTED = {
    "loading": {"kind": "indentation", "at": {"polar": 0}, "depth": 10, "points": 4},
    "mesh": {"degree": 4, "refinement": 0.7},
}


def test_an_order_3_mesh_file_of_a_hemisphere(hemisphere_file: Path) -> None:
    """F(10) on the triangles of the built-in shape, cubic in place of exact; its half and its whole."""
    shell = {"geometry": "hemisphere", "radius_to_thickness": 1 / H, "poisson_ratio": NU}
    data = {"shell": shell, "boundary": {"equator": "clamped"}, "symmetry": "half", **INDENTED}
    built_in = end(ms.Case.from_source(Source("test", data)))["force"]
    shell = {"geometry": "mesh", "file": str(hemisphere_file), "radius": 1.0, "thickness": H, "poisson_ratio": NU}
    loading = INDENTED["loading"] | {"at": {"point": "A"}}
    data = {"shell": shell, "boundary": {"rim": "clamped"}, "points": {"A": [0, 0, 1]}, "loading": loading}
    asked = ms.Case.from_source(Source("test", data | {"mesh": {"degree": 4}, "symmetry": "half"}))
    assert end(asked)["force"] == pytest.approx(built_in, rel=2e-4)
