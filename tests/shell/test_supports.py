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
        (PLATE, {"left": "symmetry", "bottom": "symmetry"}, r"free to move along \(-?0, -?0, -?1\)"),
        (PLATE, {"left": {"held": ["x", "z"]}, "right": {"held": ["z"]}}, r"free to move along \(-?0, -?1, -?0\)"),
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
