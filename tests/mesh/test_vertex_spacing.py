"""Points, features and triangles that are near each other: solved right, or refused with both
places."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError, PatchMesh
from magshell_fenicsx.mesh.vertex_spacing import (
    SAME_PLACE_TOLERANCE,
    distinguishable_texts,
    flatness,
)
from magshell_fenicsx.models.axisymmetric.meridian import graded_vertices
from magshell_fenicsx.simulate.follow import follow

h, NU = 0.02, {"thickness": 0.02, "youngs_modulus": 1, "poisson_ratio": 0}
D = h**3 / 12
PLATE = {"geometry": "plate", "length": 1, "width": 0.5, **NU}
CYLINDER = {"geometry": "cylinder", "radius": 1, "length": 2, **NU}
CAP = {"geometry": "cap", "radius": 1, "polar": 60, **NU}
TORUS = {"geometry": "torus", "radius": 1, "tube_radius": 0.3, **NU}
EDGE = {"plate": "left", "cylinder": "bottom", "cap": "rim", "disc": "rim"}


def case(shell: dict[str, Any], points: dict[str, Any], size: float = 0.2, **keys: Any) -> Case:
    edges = EDGE.get(shell["geometry"])
    boundary = {edges: "clamped"} if edges else {}
    data = {
        "shell": shell,
        "boundary": boundary,
        "points": points,
        "symmetry": "none",
        "mesh": {"size": size},
        **keys,
    }
    return Case.from_source(data)


def meshed(shell: dict[str, Any], points: dict[str, Any], **keys: Any) -> PatchMesh:
    return make_problem(case(shell, points, **keys)).triangulated()


def at(azimuth: float, z: float) -> list[float]:
    return [float(np.cos(azimuth)), float(np.sin(azimuth)), z]


def polar(angle: float) -> list[float]:
    return [float(np.sin(angle)), 0.0, float(np.cos(angle))]


@pytest.mark.parametrize("apart", [1e-3, 1e-6 * 3])
def test_a_cantilever_with_two_near_gauges(apart: float) -> None:
    """Under its weight the end sinks by q L^4/(8 D), 1e-4; there were 10 to 17 unstable
    directions."""
    weight = {
        "kind": "dead",
        "control": "load",
        "loads": [{"over": "all", "per_area": [0, 0, -1e-8]}],
        "factor": 1,
    }
    gauges = {"tip": [1, 0.25, 0], "A": [0.333, 0.4, 0], "B": [0.333 + apart, 0.1, 0]}
    scene = Scene(case(PLATE, gauges, loading={**weight, "points": 1}))
    start, *_, last = follow(scene)
    assert start.point.negative_pivots == 0
    assert -scene.observe(last.point.state)["tip_uz"] == pytest.approx(1e-8 / (8 * D), rel=1e-4)


NEAR = {
    "a column of gauges": (
        PLATE,
        {k: [0.3 + 0.0021 * i, 0.05 * i + 0.05, 0] for i, k in enumerate("ABCDEFGH")},
    ),
    "rounded coordinates": (
        CYLINDER,
        {"A": [0.707107, 0.707107, 1.5], "B": [0.7071068, 0.7071067, 0.75]},
    ),
    "both sides of a seam": (
        CYLINDER,
        {"A": at(1e-5, 1), "B": at(-3e-5, 0.5), "C": at(1.5, 1.001)},
    ),
    "both seams of a torus": (
        TORUS,
        {"A": [1.3 * c for c in at(1e-4, 0)], "B": [0, 1.3 * np.cos(1e-3), 3e-4]},
    ),
}


@pytest.mark.parametrize("kind", NEAR)
def test_near_coordinates_share_a_line(kind: str) -> None:
    """Each point is a vertex to rounding, and no triangle is flat beside its neighbours."""
    shell, points = NEAR[kind]
    points = points if kind != "both seams of a torus" else points | {"B": [0, 1.3, 0]}
    patch = meshed(shell, points)
    vertices = patch.embedding(patch.nodes[np.unique(patch.cells[:, :3])])
    for name in points:
        place = patch.embedding(patch.points[name][None])[0]
        assert place == pytest.approx(points[name], abs=2 * SAME_PLACE_TOLERANCE)
        assert np.linalg.norm(vertices - place, axis=1).min() < 1e-12
    assert flatness(patch).max() < 12.5


@pytest.mark.parametrize(
    ("shell", "exact", "typed"),
    [
        (PLATE, [1, 0.25, 0], [0.9999995, 0.25, 0]),
        ({**CAP, "hole": 15, "azimuth": [-10, 10]}, polar(np.pi / 3), [0.8660254, 0, 0.5]),
        (CAP, polar(np.pi / 3), [0.86602521, 0, 0.50000033]),
        (CAP, [0, 0, 1], [3e-7, 0, 1]),
    ],
)
def test_a_point_beside_an_edge_is_on_it(
    shell: dict[str, Any], exact: list[float], typed: list[float]
) -> None:
    """A place with the digits of a message, or of a file, makes the mesh of the exact one."""
    one, other = (meshed(shell, {"A": place}) for place in (exact, typed))
    assert len(one.cells) == len(other.cells)
    assert other.points["A"] == pytest.approx(one.points["A"], abs=1e-9)


def test_elements_are_no_wider_than_the_shape() -> None:
    """A point mid-way on a narrow strip's end is not beside its sides, whatever `mesh.size`."""
    strip = {"geometry": "strip", "width": 0.2, "radius_to_thickness": 50, "poisson_ratio": 0}
    patch = meshed(strip, {"A": [0.5, 0.05, 0]}, size=10)
    assert patch.points["A"] == pytest.approx([0.5, 0.05], abs=1e-12)


def test_two_names_of_a_place() -> None:
    """Points that differ by less than 1e-6 are one vertex."""
    patch = meshed(PLATE, {"A": [0.333, 0.25, 0], "B": [0.3330004, 0.2500004, 0]})
    assert np.array_equal(patch.points["A"], patch.points["B"])


REFUSED: list[tuple[dict[str, Any], dict[str, Any], str, str]] = [
    (
        PLATE,
        {"A": [0.999998, 0.2, 0]},
        "none",
        "points.A: [0.999998, 0.2, 0]: is 2e-06 from the edge right at [1, 0.2",
    ),
    (
        PLATE,
        {"A": [0.4, 0.2, 0], "B": [0.4001, 0.2, 0]},
        "none",
        "[0.4, 0.2, 0]: is 0.0001 from points.B: [0.4001,",
    ),
    (
        PLATE,
        {"A": [0.4, 0.2501, 0]},
        "half",
        "[0.4, 0.2501, 0]: is 0.0001 from the plane of symmetry at [0.4,",
    ),
    (
        CYLINDER,
        {"A": at(1e-5, 1), "B": at(-3e-5, 1)},
        "none",
        "[1, 1e-05, 1]: is 4e-05 from points.B: [1, -3e",
    ),
    (
        CAP,
        {"A": polar(0.5), "B": polar(0.5003)},
        "none",
        "points.A: [0.47943, 0, 0.87758]: is 0.0003 from points.B: [",
    ),
    (
        CAP,
        {"A": polar(np.pi / 3 - 1e-5)},
        "none",
        "points.A: [0.86602, 0, 0.500009]: is 1e-05 from the edge rim at [0",
    ),
    (
        {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": 0.3},
        {"A": [0.9992, 0, 0]},
        "none",
        "points.A: [0.9992, 0, 0]: is 0.0008 from the edge rim at [1, 0",
    ),
]


@pytest.mark.parametrize(("shell", "points", "symmetry", "said"), REFUSED)
def test_places_too_near_are_told(
    shell: dict[str, Any], points: dict[str, Any], symmetry: str, said: str
) -> None:
    """With both places, and digits that show where they differ; `check` and `run` make the problem
    first."""
    with pytest.raises(CaseError, match=re.escape(said)):
        make_problem(case(shell, points, symmetry=symmetry))


def test_digits_that_tell_apart() -> None:
    assert distinguishable_texts(np.array([1.0, 0.3333333]), np.array([1.0, 0.33333339])) == (
        "1, 0.3333333",
        "1, 0.33333339",
    )
    assert distinguishable_texts(np.array([1.0]), np.array([2.0])) == ("1", "2")


def columns(file: Path, width: float) -> Path:
    """A strip of 1 by 0.2, triangles of 0.2 by 0.1, with one column of them that is as wide as
    said."""
    x = np.sort([*np.linspace(0, 1, 6), 0.4 + width])
    nodes = [(a, b, 0) for a in x for b in (0, 0.1, 0.2)]
    n = len(x) - 1
    lines = [(1, b, b + 1) for b in (0, 1)]
    lines += [(2, 3 * n + b, 3 * n + b + 1) for b in (0, 1)]
    lines += [(3, 3 * i + b, 3 * i + 3 + b) for i in range(n) for b in (0, 2)]
    cells = [
        tuple(3 * i + b + corner for corner in triple)
        for i in range(n)
        for b in (0, 1)
        for triple in ((0, 3, 4), (0, 4, 1))
    ]
    text = [
        "$MeshFormat",
        "2.2 0 8",
        "$EndMeshFormat",
        "$PhysicalNames",
        "4",
        '1 1 "root"',
        '1 2 "tip"',
        '1 3 "sides"',
    ]
    text += ['2 4 "all"', "$EndPhysicalNames", "$Nodes", str(len(nodes))]
    text += [f"{i + 1} {a:.17g} {b} {c}" for i, (a, b, c) in enumerate(nodes)]
    elements = [f"1 2 {tag} {tag} {a + 1} {b + 1}" for tag, a, b in lines]
    elements += [f"2 2 4 4 {a + 1} {b + 1} {c + 1}" for a, b, c in cells]
    text += [
        "$EndNodes",
        "$Elements",
        str(len(elements)),
        *(f"{i + 1} {e}" for i, e in enumerate(elements)),
    ]
    file.write_text("\n".join([*text, "$EndElements", ""]))
    return file


def of_file(file: Path, **mesh: Any) -> Case:
    shell = {"geometry": "mesh", "file": str(file), "radius": 1, **NU}
    load = {
        "kind": "dead",
        "control": "load",
        "loads": [{"edge": "tip", "force": [0, 0, 1e-9]}],
        "factor": 1,
    }
    data = {
        "shell": shell,
        "boundary": {"root": "clamped"},
        "loading": {**load, "points": 1},
        "mesh": mesh,
    }
    return Case.from_source(data | {"symmetry": "none"})


@pytest.mark.parametrize("width", [1e-3, 1e-4])
def test_flat_triangles_of_a_file(tmp_path: Path, width: float) -> None:
    """Beside triangles 200 and 2000 times as high the end rises by F L^3/(3 D b), a beam's, 1e-4;
    the first had unstable directions, of the second the clamped shell was said not to be held."""
    scene = Scene(of_file(columns(tmp_path / "a.msh", width)))
    *_, last = follow(scene)
    assert scene.observe(last.point.state)["w_over_h"] * h == pytest.approx(
        1e-9 / (3 * D * 0.2), rel=1e-4
    )


def test_a_triangle_too_flat_for_rounding(tmp_path: Path) -> None:
    """It was said that the clamped shell is not held."""
    problem = make_problem(of_file(columns(tmp_path / "a.msh", 5e-5)))
    with pytest.raises(
        MeshError, match=r"shell.file: the triangle .* \(0.40005, 0.[12], 0\) and \(0.4, 0.[12], 0"
    ):
        problem.triangulated()


def test_rims_that_nearly_meet_share_a_vertex() -> None:
    """Of a meridian with cells of 0.02: neighbours are alike, and the perfect mesh is as before."""
    one, two = (graded_vertices(1.0, [0.5, *more], 0.01) for more in ([], [0.5003]))
    assert len(two) == len(one)
    assert 0.5 < two[np.abs(two - 0.5001).argmin()] < 0.5003
    beside = graded_vertices(1.0, [0.5, 1 - 1e-5], 0.01)
    assert beside == pytest.approx(one, abs=1e-15)


@pytest.mark.parametrize("symmetry", ["axisymmetric", "none"])
def test_two_dimples_of_nearly_one_width(symmetry: str) -> None:
    """The undeformed cap is stable: the meridian had one unstable direction, the surface 1e5
    cells."""
    dimples = [{"kind": "dimple", "amplitude": 0.1, "width": width} for width in (2.0, 2.002)]
    data = {
        "shell": {**CAP, "thickness": 0.01, "imperfections": dimples},
        "boundary": {"rim": "clamped"},
        "loading": {"kind": "pressure", "until": "limit"},
        "symmetry": symmetry,
    }
    problem = make_problem(Case.from_source(data))
    if symmetry == "none":
        assert len(problem.triangulated().cells) < 1000
        return
    scene = Scene(problem)
    assert scene.newton.factor_at(scene.unloaded()).negative_pivots == 0
