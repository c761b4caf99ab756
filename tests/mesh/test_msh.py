"""Meshes made elsewhere: what is read from them, and what is refused with the place named."""

from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import gmsh
import numpy as np
import pytest
from conftest import CASES
from many import make_points, sweep
from mpi4py import MPI

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.mesh.mirror import Mirror, cut
from magshell_fenicsx.mesh.msh import MeshFile, read_msh
from magshell_fenicsx.mesh.patch import MeshError, PatchMesh, as_set, check_orientation
from magshell_fenicsx.models.shell.spatial_fields import ByPatch
from magshell_fenicsx.public import run
from magshell_fenicsx.runs.files import AlreadyComplete
from magshell_fenicsx.shape.mirrors import mesh_mirrors
from magshell_fenicsx.studies.points import parse_axis

Script = Callable[[], None]


@pytest.fixture
def model() -> Iterator[Any]:
    gmsh.initialize(interruptible=False)
    gmsh.option.setNumber("General.Terminal", 0)
    yield gmsh.model
    gmsh.finalize()


def panel(model: Any, order: int, size: float = 0.25) -> None:
    """A quarter of a cylinder of radius 1 and length 1, in two patches, as a script of a user's
    makes it.
    """
    geo, edges = model.geo, {}
    axis = [geo.addPoint(0, 0, z) for z in (0, 0.5, 1)]
    left = [geo.addPoint(1, 0, z) for z in (0, 0.5, 1)]
    right = [geo.addPoint(0, 1, z) for z in (0, 0.5, 1)]
    arcs = [geo.addCircleArc(a, c, b) for a, c, b in zip(left, axis, right, strict=True)]
    up = [[geo.addLine(side[i], side[i + 1]) for i in range(2)] for side in (left, right)]
    faces = []
    for i in range(2):
        loop = geo.addCurveLoop([arcs[i], up[1][i], -arcs[i + 1], -up[0][i]])
        faces.append(geo.addSurfaceFilling([loop]))
    geo.synchronize()
    edges = {
        "bottom": [arcs[0]],
        "top": [arcs[2]],
        "left": up[0],
        "right": up[1],
        "middle": [arcs[1]],
    }
    for name, tags in edges.items():
        model.addPhysicalGroup(1, tags, name=name)
    for name, face in zip(("lower", "upper"), faces, strict=True):
        model.addPhysicalGroup(2, [face], name=name)
    gmsh.option.setNumber("Mesh.MeshSizeMax", size)
    model.mesh.generate(2)
    model.mesh.setOrder(order)


@pytest.mark.parametrize(
    "cells", [[[0, 1, 3], [0, 3, 2], [1, 4, 3]], [[3, 2, 0], [3, 1, 4], [5, 6, 7]]]
)
def test_no_mirror_through_triangles(cells: list[list[int]]) -> None:
    """A triangle that is its own image, across the plane or in it, lies on neither side: it would
    be lost.
    """
    web = [[0.0, 0, 1], [0, 1, 1], [0, 0.5, 2]]
    nodes = np.array([[-1.0, 0, 0], [1, 0, 0], [-1, 1, 0], [0, 1, 0], [1, 1, 0], *web])
    nodes = nodes[: np.max(cells) + 1]
    patch = PatchMesh(nodes, np.array(cells), lambda x: x)
    assert not mesh_mirrors(patch, [], loosely=True)
    with pytest.raises(MeshError, match="no edges of the mesh lie in the plane"):
        cut(patch, Mirror(np.array([1.0, 0, 0])))


def test_a_check_tells_what_was_read() -> None:
    """Extent, names and the outer side of the gripper, whose normals are e3."""
    told = describe(Case.load(CASES / "gripper.yaml"))
    assert (
        "extent over the radius: 7 x 7 x 0\nedges: outline; patches: hub, east, north, west, south"
        in told
    )
    assert "over the radius, is (0, 0, 1)" in told


@pytest.mark.parametrize("held", ["clamped", {"held": ["x", "y", "z"]}])
def test_a_clamped_patch_is_a_clamped_edge_to_the_rest(
    model: Any, tmp_path: Path, held: Any
) -> None:
    """Upper half of a panel on its clamped lower half: the tip moves as that of a panel of half the
    length.
    """
    panel(model, 3)
    gmsh.write(str(tmp_path / "part.msh"))
    loading = {
        "kind": "dead",
        "loads": [{"edge": "top", "force": [-1e-6, 0, 0]}],
        "factor": 1,
        "points": 1,
    }
    material = {"thickness": 0.02, "poisson_ratio": 0.3, "youngs_modulus": 1}
    common = {"loading": loading, "points": {"tip": [1, 0, 1]}}
    whole = {"geometry": "mesh", "file": str(tmp_path / "part.msh"), "radius": 1, **material}
    found = run(
        Case.from_source(Source("part", {**common, "shell": whole, "boundary": {"lower": held}}))
    )
    lower = found.scene.model.r0.x.array.reshape(-1, 3)[: len(found.last.u) // 3, 2] < 0.5 - 1e-9
    assert not found.last.u.reshape(-1, 3)[lower].any()
    half = {"geometry": "cylinder", "radius": 1, "length": 0.5, "azimuth": [0, 90], **material}
    mesh = {"size": 0.25}
    points = {"tip": [1, 0, 0.5]}
    alone = run(
        Case.from_source(
            Source(
                "half",
                {
                    **common,
                    "points": points,
                    "shell": half,
                    "mesh": mesh,
                    "boundary": {"bottom": "clamped"},
                },
            )
        )
    )
    assert found.rows[-1]["tip_ux"] == pytest.approx(alone.rows[-1]["tip_ux"], rel=2e-3)


@pytest.mark.parametrize("order", [1, 2, 3])
def test_patches_edges_and_points(model: Any, tmp_path: Path, order: int) -> None:
    panel(model, order)
    gmsh.write(str(tmp_path / "part.msh"))
    patch = read_msh(MeshFile(tmp_path / "part.msh", 2.0), {"A": np.array([2.0, 0.0, 1.0])})
    assert patch.cells.shape[1] == {1: 3, 2: 6, 3: 10}[order]
    assert set(patch.edges) == {"bottom", "top", "left", "right"}  # "middle" is within the surface
    assert patch.nodes[patch.edges["top"], 2] == pytest.approx(2.0)
    assert (patch.patches["lower"] ^ patch.patches["upper"]).all()
    assert patch.nodes[patch.cells[patch.patches["lower"]]][..., 2].max() == pytest.approx(1.0)
    assert patch.points["A"] == pytest.approx([2, 0, 1])
    assert np.hypot(*patch.nodes[:, :2].T) == pytest.approx(2.0, abs=1e-6)


LOADED = {
    "boundary": {"left": "symmetry", "right": "symmetry", "bottom": "clamped"},
    "points": {"A": [1, 0, 1]},
    "loading": {
        "kind": "dead",
        "control": "load",
        "factor": 1,
        "points": 1,
        "loads": [{"at": "A", "force": [-2e-4, 0, 0]}],
    },
    "magnetic": {
        "lambda_m": 2e-4,
        "remanent": {"kind": "uniform", "polar": 90, "azimuth": 45},
        "applied": {"polar": 0},
    },
    "mesh": {"degree": 3},
}
MATERIAL = {"thickness": 0.02, "youngs_modulus": 1, "poisson_ratio": 0.3}


def deflection(data: dict[str, Any]) -> float:
    result = run(Case.from_source(data))
    assert result.stopped is None
    return float(result.rows[-1]["A_ux"])


@cache
def built_in() -> float:
    shell = {"geometry": "cylinder", "radius": 1, "length": 1, "azimuth": [0, 90], **MATERIAL}
    return deflection({**LOADED, "shell": shell, "mesh": {"degree": 4, "size": 0.2}})


@pytest.mark.slow
@pytest.mark.parametrize(("order", "tolerance"), [(1, 0.03), (3, 3e-3)])
def test_same_answer_as_the_built_in_geometry(
    model: Any, tmp_path: Path, order: int, tolerance: float
) -> None:
    """A pinched clamped cylinder in a field; flat facets err by h^2, the others by the mesh."""
    panel(model, order, 0.12)
    gmsh.write(str(tmp_path / "part.msh"))
    shell = {"geometry": "mesh", "file": str(tmp_path / "part.msh"), "radius": 1, **MATERIAL}
    assert deflection({**LOADED, "shell": shell}) == pytest.approx(built_in(), rel=tolerance)


@pytest.mark.slow
def test_remanence_and_thickness_of_patches(model: Any, tmp_path: Path) -> None:
    """By patch as by a formula of the place, to rounding: the patches meet at z = 0.5."""
    panel(model, 2)
    gmsh.write(str(tmp_path / "part.msh"))
    shell = {"geometry": "mesh", "file": str(tmp_path / "part.msh"), "radius": 1, **MATERIAL}
    by_name = {"kind": "patches", "patches": {"lower": {"polar": 90}, "rest": {"polar": 0}}}
    by_place = {
        "kind": "expression",
        "components": ["(1 - sign(z - 0.5))/2", "0*x", "(1 + sign(z - 0.5))/2"],
    }
    found = []
    for remanent in (by_name, by_place):
        magnetic = {"lambda_m": 2e-4, "remanent": remanent, "applied": {"polar": 45}}
        found.append(Scene(Case.from_source({**LOADED, "shell": shell, "magnetic": magnetic})))
    u = 0.01 * np.sin(5 * found[0].model.r0.x.array[: found[0].model.system.size])
    energies = [scene.model.system.energies(u)["magnetic"] for scene in found]
    # where the formula jumps between two cells, each has its own value
    assert energies[0] == pytest.approx(energies[1], rel=1e-12)


def square(cells: list[list[int]], nodes: list[list[float]] | None = None) -> PatchMesh:
    """Triangles on the unit square's corners and more."""
    corners = nodes or [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]]
    return PatchMesh(np.array(corners, dtype=float), np.array(cells), lambda x: x)


def written(
    cells: list[list[int]], nodes: list[list[float]], lines: list[list[int]], file: Path
) -> None:
    """A .msh file with these triangles, all its curves named rim."""
    model = gmsh.model
    for dim, kind, elements, name in ((2, 2, cells, "all"), (1, 1, lines, "rim")):
        entity = model.addDiscreteEntity(dim, 1)
        if dim == 2:
            model.mesh.addNodes(2, entity, range(1, len(nodes) + 1), np.ravel(nodes))
        if elements:
            model.mesh.addElementsByType(entity, kind, [], (np.ravel(elements) + 1).tolist())
            model.addPhysicalGroup(dim, [entity], name=name)
    gmsh.write(str(file))


CORNERS = [[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 1]]
FRAME = [[0, 1], [1, 2], [2, 3], [3, 0]]
TWO = [[0, 1, 2], [0, 2, 3]]
STRIP = [[np.cos(t) * (1 + s * np.cos(t / 2) / 2), np.sin(t) * (1 + s * np.cos(t / 2) / 2),
          s * np.sin(t / 2) / 2]
         for t in np.linspace(0, 2 * np.pi, 12, endpoint=False) for s in (-1, 1)]  # fmt: skip
MOEBIUS = [
    cell
    for i in range(12)
    for a, b, c, d in [(2 * i, 2 * i + 1, (2 * i + 2) % 24, (2 * i + 3) % 24)]
    for cell in ([[a, b, c], [b, d, c]] if i < 11 else [[a, b, 1], [b, 0, 1]])
]
WRONG = [
    (
        [[0, 1, 2], [4, 5, 3]],
        [*CORNERS[:4], [0, 0, 0], [1, 1, 0]],
        FRAME,
        r"two nodes at \((0, 0|1, 1), 0\), and its parts are not connected",
    ),
    (
        [*TWO, [1, 5, 6]],
        [*CORNERS, [2, 0, 0], [2, -1, 0]],
        [*FRAME, [1, 5], [5, 6], [6, 1]],
        "touches itself in",
    ),
    (
        [[0, 1, 2], [0, 2, 5]],
        [*CORNERS, [0.5, 0.5, 0]],
        [[0, 1], [1, 2], [2, 5], [5, 0]],
        r"\(0, 0, 0\) has no area",
    ),
    (MOEBIUS, STRIP, [], "only one side"),
]


@pytest.mark.parametrize(("cells", "nodes", "lines", "said"), WRONG)
def test_unsound_meshes_are_refused(
    model: Any,
    tmp_path: Path,
    cells: list[list[int]],
    nodes: list[list[float]],
    lines: list[list[int]],
    said: str,
) -> None:
    written(cells, nodes, lines, tmp_path / "wrong.msh")
    with pytest.raises(MeshError, match=said):
        read_msh(MeshFile(tmp_path / "wrong.msh", 0.02), {})  # places are those of the file


def test_border_sides_without_a_curve_are_the_rest(model: Any, tmp_path: Path) -> None:
    """And a curve between triangles is a line within the surface."""
    written(TWO, CORNERS, FRAME[:3], tmp_path / "three.msh")
    patch = read_msh(MeshFile(tmp_path / "three.msh", 1.0), {})
    assert {name: as_set(pairs) for name, pairs in patch.edges.items()} == {
        "rim": {(0, 1), (1, 2), (2, 3)}, "rest": {(0, 3)},
    }  # fmt: skip
    model.add("within")
    written(TWO, CORNERS, [[0, 2]], tmp_path / "within.msh")
    patch = read_msh(MeshFile(tmp_path / "within.msh", 1.0), {})
    assert as_set(patch.inner_lines["rim"]) == {(0, 2)}
    assert list(patch.edges) == ["rest"]
    content = (tmp_path / "three.msh").read_text().replace('"rim"', '"rest"')
    (tmp_path / "named.msh").write_text(content)
    with pytest.raises(MeshError, match="there is one called rest: give it another name"):
        read_msh(MeshFile(tmp_path / "named.msh", 1.0), {})


def test_triangles_the_other_way_round_are_turned(model: Any, tmp_path: Path) -> None:
    cells = [[0, 1, 4], [2, 1, 4], [2, 3, 4], [3, 0, 4]]
    written(cells, CORNERS, FRAME, tmp_path / "turned.msh")
    patch = read_msh(MeshFile(tmp_path / "turned.msh", 1.0), {})
    check_orientation(patch)
    a, b, c = (patch.nodes[patch.cells[:, i]] for i in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()


@pytest.mark.parametrize("order", [2, 3])
def test_curved_triangles_are_turned_with_their_nodes(
    model: Any, tmp_path: Path, order: int
) -> None:
    """The surface stays the same, its normal changes sides."""
    panel(model, order, 0.5)
    gmsh.write(str(tmp_path / "one.msh"))
    patch = read_msh(MeshFile(tmp_path / "one.msh", 1.0), {})
    model.mesh.reverse()
    gmsh.write(str(tmp_path / "other.msh"))
    other = read_msh(MeshFile(tmp_path / "other.msh", 1.0), {})
    mine, theirs = (
        set(map(tuple, np.round(np.sort(p.nodes[p.cells].sum(axis=1)), 9))) for p in (patch, other)
    )
    assert mine == theirs


def test_what_is_no_mesh_is_refused(model: Any, tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="there is no such mesh file"):
        read_msh(MeshFile(tmp_path / "nowhere.msh", 1.0), {})
    (tmp_path / "text.msh").write_text("hello", encoding="utf-8")
    with pytest.raises(MeshError, match="is no mesh of gmsh's, which begins with"):
        read_msh(MeshFile(tmp_path / "text.msh", 1.0), {})
    entity = model.addDiscreteEntity(2, 1)
    model.mesh.addNodes(2, entity, range(1, 5), np.ravel(CORNERS[:4]))
    model.mesh.addElementsByType(entity, 3, [], [1, 2, 3, 4])
    gmsh.write(str(tmp_path / "quads.msh"))
    with pytest.raises(MeshError, match="Quadrilateral 4; allowed are triangles"):
        read_msh(MeshFile(tmp_path / "quads.msh", 1.0), {})


def test_named_point_must_be_a_vertex(model: Any, tmp_path: Path) -> None:
    panel(model, 1)
    gmsh.write(str(tmp_path / "part.msh"))
    with pytest.raises(
        MeshError, match=r"points.A: \(1, 0, 1.01\) in the file's .* nearest is \(1, 0, 1\)"
    ):
        read_msh(MeshFile(tmp_path / "part.msh", 0.02), {"A": np.array([0.02, 0.0, 0.0202])})


@pytest.mark.parametrize(
    ("unit", "times"), [("mm", None), ("m", "1000 times"), ("um", "0.001 times")]
)
def test_wrong_unit_is_told(model: Any, tmp_path: Path, unit: str, times: str | None) -> None:
    """A file in mm that is read as metres is a thousand times as long as its radius; nothing else
    would say so.
    """
    panel(model, 1)
    gmsh.write(str(tmp_path / "part.msh"))
    shell = {"geometry": "mesh", "file": str(tmp_path / "part.msh"), "unit": unit, "radius": "1 mm"}
    shell |= {"thickness": "10 um", "youngs_modulus": "1 MPa", "poisson_ratio": 0.3}
    told = make_problem(
        Case.model_validate({"shell": shell, "boundary": {"bottom": "clamped"}})
    ).warnings
    assert len(told) == (times is not None)
    assert all(str(times) in words for words in told)


def test_unknown_names_are_refused(model: Any, tmp_path: Path) -> None:
    """By the scene, on every rank."""
    panel(model, 1)
    gmsh.write(str(tmp_path / "part.msh"))
    shell = {"geometry": "mesh", "file": str(tmp_path / "part.msh"), "radius": 1, **MATERIAL}
    for changed, said in (
        (
            {"boundary": {"rim": "clamped"}},
            (
                "boundary.rim: the surface has no such edge, only bottom, left, lower, "
                "right, top, upper"
            ),
        ),
        (
            {"boundary": {"top": "hinged"}, "shell": {**shell, "thickness_factor": {"front": 2}}},
            "shell.thickness_factor: front: the surface has no such patch, only lower, upper",
        ),
        ({"boundary": {"top": {"held": ["z"]}}}, "the shell is not held"),
    ):
        with pytest.raises(MeshError, match=said):
            Scene(
                Case.from_source({"shell": shell, "mesh": {"degree": 2}, **changed}), MPI.COMM_SELF
            )


def test_rest_of_a_mesh_without_patches(model: Any, tmp_path: Path) -> None:
    """Is all of it."""
    written([*TWO], CORNERS, FRAME, tmp_path / "part.msh")
    model.removePhysicalGroups([(2, 1)])
    gmsh.option.setNumber("Mesh.SaveAll", 1)
    gmsh.write(str(tmp_path / "part.msh"))
    magnetic = {
        "lambda_m": 1e-3,
        "remanent": {"kind": "patches", "patches": {"rest": {"polar": 0}}},
    }
    shell = {"geometry": "mesh", "file": str(tmp_path / "part.msh"), "radius": 1, **MATERIAL}
    data = {
        "shell": shell,
        "boundary": {"rim": "clamped"},
        "magnetic": magnetic,
        "mesh": {"degree": 2},
    }
    data["symmetry"] = "none"  # its two triangles are each other's mirror images
    scene = Scene(Case.from_source(data), MPI.COMM_SELF)
    assert not scene.model.midsurface.patches
    assert isinstance(scene.model.loads.magnetic.remanent, ByPatch)  # type: ignore[union-attr]
    assert scene.model.loads.magnetic.remanent.vectors == pytest.approx(np.tile([0, 0, 1], (2, 1)))  # type: ignore[union-attr]


def test_a_curve_without_elements_is_no_edge(model: Any, tmp_path: Path) -> None:
    written(TWO, CORNERS, FRAME, tmp_path / "part.msh")
    model.addPhysicalGroup(1, [model.addDiscreteEntity(1, 2)], name="drawn")
    gmsh.option.setNumber("Mesh.SaveAll", 1)
    gmsh.write(str(tmp_path / "part.msh"))
    assert set(read_msh(MeshFile(tmp_path / "part.msh", 1.0), {}).edges) == {"rim"}


def test_unknown_patches_are_refused_when_checked(model: Any, tmp_path: Path) -> None:
    written(TWO, CORNERS, FRAME, tmp_path / "part.msh")
    shell = {"geometry": "mesh", "file": str(tmp_path / "part.msh"), "radius": 1, **MATERIAL}
    load = {"kind": "dead", "loads": [{"over": "front", "pressure": 1}], "factor": 1}
    by_name = {"lambda_m": 1e-3, "remanent": {"kind": "patches", "patches": {"front": {}}}}
    for changed in (
        {"shell": {**shell, "thickness_factor": {"front": 2}}},
        {"loading": load},
        {"magnetic": by_name},
    ):
        data = {"shell": shell, "boundary": {"rim": "clamped"}, **changed}
        with pytest.raises(CaseError, match=r"no (such )?patch"):
            describe(Case.from_source(data))


CASE_FILE = """
shell: {geometry: mesh, file: parts/part.msh, radius: 1, thickness: 0.02, youngs_modulus: 1, \
poisson_ratio: 0.3}
boundary: {rim: clamped}
loading: {kind: dead, control: load, loads: [{over: all, pressure: 1e-9}], factor: 1, points: 1}
mesh: {degree: 2}
symmetry: none
"""


@pytest.fixture
def case_file(model: Any, tmp_path: Path) -> Path:
    (tmp_path / "parts").mkdir()
    written(TWO, CORNERS, FRAME, tmp_path / "parts" / "part.msh")
    (tmp_path / "case.yaml").write_text(CASE_FILE, encoding="utf-8")
    return tmp_path / "case.yaml"


def test_a_mesh_file_is_beside_its_case(case_file: Path) -> None:
    """Also in a sweep, from any folder; the path stays as it was written."""
    points = make_points(case_file, [parse_axis("shell.poisson_ratio=0.2,0.3")])
    for case in (Case.load(case_file), *(point.case for point in points)):
        assert len(make_problem(case).triangulated().cells) == 2
        assert case.model_dump()["shell"]["file"] == "parts/part.msh"


def test_a_sweep_under_dead_loads(case_file: Path, tmp_path: Path) -> None:
    done = sweep(case_file, ["shell.poisson_ratio=0.2,0.3"], [], tmp_path / "out")
    assert not done.stopped
    lines = (tmp_path / "out" / "curves.csv").read_text(encoding="utf-8").splitlines()
    factors = [line.split(",")[lines[0].split(",").index("load_factor")] for line in lines[1:]]
    assert [float(factor) for factor in factors if factor] == [0, 1, 0, 1]


def test_another_mesh_in_the_same_file_is_another_problem(
    case_file: Path, tmp_path: Path, no_pictures: None
) -> None:
    def keys() -> list[str]:
        return [
            point.key
            for point in make_points(case_file, [parse_axis("shell.poisson_ratio=0.2,0.3")])
        ]

    before = keys()
    run(Case.load(case_file), tmp_path / "out")
    with pytest.raises(AlreadyComplete):
        run(Case.load(case_file), tmp_path / "out", resume=True)
    with (case_file.parent / "parts" / "part.msh").open("a", encoding="utf-8") as file:
        file.write("$Comments\nanother\n$EndComments\n")
    with pytest.raises(CaseError, match="belongs to another run: mesh_file"):
        run(Case.load(case_file), tmp_path / "out", resume=True)
    assert not set(before) & set(keys())
