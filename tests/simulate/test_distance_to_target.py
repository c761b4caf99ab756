"""The distance of a shell to a shape that is wanted."""

import numpy as np
import pytest

from magshell_fenicsx import Case
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.results import distances


@pytest.mark.parametrize("symmetry", ["axisymmetric", "half"])
def test_distance_of_an_undeformed_shell(symmetry: str) -> None:
    """Where the target is the shell, moved by 0.3 R along its axis: 0.3 at every node."""
    shell = {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.3}
    held = {"boundary": {"equator": "clamped"}, "loading": {"kind": "pressure"}}
    mesh = {"refinement": 0.3, "degree": 2}
    scene = Scene(Case.from_source({"shell": shell, "symmetry": symmetry, "mesh": mesh, **held}))
    moved = distances(scene, scene.unloaded(), lambda places: places + np.array([0.0, 0.0, 0.3]))
    assert moved == pytest.approx((0.3, 0.3), rel=1e-12)
