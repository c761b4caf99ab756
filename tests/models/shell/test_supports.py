"""A shell that can move as a rigid body is refused before it is solved."""

from typing import Any

import pytest

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.case.source import Source
from magshell_fenicsx.mesh.patch import MeshError

PLATE = {"geometry": "plate", "length": 1, "width": 1, "thickness": 0.02, "poisson_ratio": 0.3}
CYLINDER = {"geometry": "cylinder", "radius": 1, "length": 1, "thickness": 0.02, "poisson_ratio": 0.3}
CORNERS = {"A": [0, 0, 0], "B": [1, 0, 0], "C": [0, 1, 0]}


def scene(shell: dict[str, Any], boundary: dict[str, Any], points: dict[str, Any]) -> Scene:
    mesh = {"degree": 2, "size": 0.5}
    return Scene(
        Case.from_source(Source("test", {"shell": shell, "boundary": boundary, "points": points, "mesh": mesh}))
    )


@pytest.mark.parametrize(
    ("shell", "boundary", "motion"),
    [
        (PLATE, {}, "free to"),
        (PLATE, {"left": "hinged"}, "free to"),  # turns about the hinge
        (PLATE, {"left": "symmetry", "bottom": "symmetry"}, r"free to move along \(0, 0, -?1\)"),
        (PLATE, {"left": {"held": ["x", "z"]}, "right": {"held": ["z"]}}, r"free to move along \(0, -?1, 0\)"),
        (PLATE, {"A": {"held": ["x", "y", "z"]}, "B": {"held": ["z"]}}, "free to"),
        (CYLINDER, {"bottom": {"held": ["z"]}}, "free to"),
    ],
)
def test_loose(shell: dict[str, Any], boundary: dict[str, Any], motion: str) -> None:
    with pytest.raises(MeshError, match=motion):
        scene(shell, boundary, CORNERS if shell is PLATE else {})


@pytest.mark.parametrize(
    ("shell", "boundary"),
    [
        (PLATE, {"left": "clamped"}),
        (PLATE, {"left": "hinged", "B": {"held": ["z"]}}),
        (PLATE, {"A": {"held": ["x", "y", "z"]}, "B": {"held": ["y", "z"]}, "C": {"held": ["z"]}}),
        (PLATE, {"left": "symmetry", "bottom": "symmetry", "A": {"held": ["z"]}}),
        (CYLINDER, {"bottom": {"held": ["x", "y"]}, "top": "hinged"}),
    ],
)
def test_held(shell: dict[str, Any], boundary: dict[str, Any]) -> None:
    assert scene(shell, boundary, CORNERS if shell is PLATE else {}).newton


def test_plane_of_symmetry_must_be_one() -> None:
    panel = {**CYLINDER, "azimuth": [0, 60]}
    with pytest.raises(MeshError, match=r"boundary.right: symmetry: the edge must lie in a plane normal to x, y or z"):
        scene(panel, {"right": "symmetry", "bottom": "clamped"}, {})


ANNULUS = {"geometry": "annulus", "radius": 1, "inner_radius": 0.5, "thickness": 0.02, "poisson_ratio": 0.3}


@pytest.mark.parametrize(
    ("shell", "boundary", "refused"),
    [
        (ANNULUS, {"inner": "clamped", "outer": "symmetry"}, True),  # its plane z = 0 is the surface's own
        (CYLINDER, {"bottom": "symmetry", "top": "clamped"}, False),
    ],
)
def test_a_symmetry_plane_is_crossed(shell: dict[str, Any], boundary: dict[str, Any], *, refused: bool) -> None:
    """The conormals of a closed edge cancel in the mean; their sizes do not."""
    if not refused:
        assert scene(shell, boundary, {}).newton
        return
    with pytest.raises(MeshError, match=r"boundary.outer: symmetry: the edge must lie in a plane normal to"):
        scene(shell, boundary, {})


@pytest.mark.parametrize("edge", ["left", "right"])
def test_live_pressure_at_symmetry_planes(edge: str) -> None:
    """Of int x.n/3 an edge in the plane x.m = c has the line integral of dx.(c m cross t)/3 left."""
    held = dict.fromkeys({"left", "right", "bottom", "top"} - {edge}, "clamped")
    data = {"shell": PLATE, "boundary": {**held, edge: "symmetry"}, "loading": {"kind": "pressure"}}
    case = Case.from_source(Source("test", {**data, "mesh": {"degree": 2, "size": 0.5}}))
    if edge == "left":  # x = 0
        assert Scene(case).newton
        return
    with pytest.raises(MeshError, match=r"loading.kind: pressure: the edge right must be held"):
        Scene(case)


def test_a_remanence_without_value_is_refused() -> None:
    magnetic = {"lambda_m": 1e-3, "remanent": {"kind": "expression", "components": ["0*x", "0*x", "1/(x - 0.5)"]}}
    data = {"shell": PLATE, "boundary": {"left": "clamped"}, "magnetic": magnetic, "mesh": {"degree": 2, "size": 0.5}}
    with pytest.raises(MeshError, match=r"magnetic.remanent: has no finite value .* \(0.5, "):
        Scene(Case.from_source(Source("test", data)))


def test_energy_of_mirror_edges_is_bending() -> None:
    """Turning a symmetry edge out of its plane costs bending alone, and all of it is in the column."""
    half = scene(PLATE, {"left": "symmetry", "bottom": "clamped"}, {})
    state = half.unloaded()
    x = half.model.r0.x.array.reshape(-1, 3)[: len(state.u) // 3]
    state.u.reshape(-1, 3)[:, 2] = 1e-3 * x[:, 0]
    seen, energies = half.observe(state), half.model.system.energies(state.u)
    assert energies["left mirror edges"] > 0.5 * seen["energy"]
    assert seen["bending"] + seen["stretching"] == pytest.approx(seen["energy"])
    assert seen["bending"] >= energies["left mirror edges"]


def test_displacement_beside_moments_alone() -> None:
    """They have none of their own: the first named point's, w = -u.n0."""
    load = {"kind": "dead", "loads": [{"edge": "right", "moment": 1}], "factor": 1}
    shell, mesh = {**PLATE, "youngs_modulus": 1}, {"degree": 2, "size": 0.5}
    data = {"shell": shell, "boundary": {"left": "clamped"}, "points": CORNERS, "loading": load, "mesh": mesh}
    beam = Scene(Case.from_source(Source("test", {**data, "points": {"B": CORNERS["B"]}})))
    state = beam.unloaded()
    state.u.reshape(-1, 3)[:, 2] = -0.02
    assert beam.observe(state)["w_over_h"] == pytest.approx(1.0)
