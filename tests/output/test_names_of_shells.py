"""Several shells in pictures and files: each has its name."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.output.fields.surface import SHELL, SurfaceGatherer
from magshell_fenicsx.output.fields.vtu import FieldSeries, ShellData, read_point
from magshell_fenicsx.output.pictures.colours import shell
from magshell_fenicsx.output.pictures.picture import Background
from magshell_fenicsx.output.pictures.rendering import Camera
from magshell_fenicsx.problem.requests import OutputSection


def plate(x: float, **boundary: str) -> dict[str, Any]:
    keys = {"geometry": "plate", "length": 1, "width": 0.5, "thickness": 0.02, "poisson_ratio": 0.3}
    return {"shell": keys, "boundary": boundary, "place": {"position": [x, 0, 0]}}


def test_names_of_shells(tmp_path: Path) -> None:
    """Halves of two plates joined in one plane: files tell the shell of each node, and a picture
    has a name on each.
    """
    data = {
        "shells": {"left": plate(0, left="clamped"), "right": plate(1, right="clamped")},
        "joints": [{"edges": ["left.right", "right.left"]}],
        "mesh": {"degree": 2, "size": 0.25},
    }
    scene = Scene(Case.from_source(data))
    surface, mirror = SurfaceGatherer(scene.model).gather(scene.unloaded().u), scene.problem.mirror
    assert surface is not None
    assert mirror is not None
    FieldSeries(tmp_path, ShellData(scene.problem.material.h, 0.3, mirror.plane)).write(0, surface)
    read, about = read_point(tmp_path, 0)
    assert read.shells == ("left", "right")
    number, x = np.rint(read.fields[SHELL]), read.r0[:, 0]
    assert (number[x < 0.999] == 0).all()
    assert (number[x > 1.001] == 1).all()
    assert np.bincount(number[np.abs(x - 1) < 1e-9].astype(int)).tolist() == [
        6,
        6,
    ]  # nodes of two shells are double
    view = Background(read, Camera(np.array([0.0, -0.1, 1.0])), 300)
    names = view.panel(shell(read, about.h)[0], OutputSection()).names
    camera = Camera(np.array([0.0, -0.1, 1.0]))
    left, right = (camera(np.array([[x, 0.25, 0.0]]))[0, 0] for x in (0.5, 1.5))
    assert {name: x for x, _, name in names} == {
        "left": pytest.approx(left, abs=0.1),
        "right": pytest.approx(right, abs=0.1),
    }
