"""Small scenes with supports that move."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.assembly.rigid_motion import RigidMotion
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.models.shell.parameters import Move

NONE = np.zeros(3)
PLATE = {
    "geometry": "plate",
    "length": 1.0,
    "width": 0.1,
    "thickness": 0.01,
    "youngs_modulus": 1.2e8,
}  # E I = 1
RING = {
    "geometry": "annulus",
    "radius": 1.0,
    "inner_radius": 0.4,
    "thickness": 0.01,
    "youngs_modulus": 1.0,
}
CLAMPED = {"left": "clamped", "right": "clamped"}


def move(name: str, *edges: str, shift: Any = NONE, turn: Any = NONE, centre: Any = NONE) -> Move:
    """A motion of edges; lengths over R, the rotation vector in radians."""
    return Move(
        edges,
        RigidMotion(name, np.array(shift, float), np.array(turn, float), np.array(centre, float)),
    )


def moving_scene(
    moves: tuple[Move, ...],
    shell: Mapping[str, Any] = PLATE,
    boundary: Mapping[str, Any] = CLAMPED,
    *,
    symmetry: str = "none",
    **sections: Any,
) -> Scene:
    """A scene whose loads are these motions, and what its other sections say."""
    data = {
        "shell": {"poisson_ratio": 0.0, **shell},
        "boundary": boundary,
        "symmetry": symmetry,
        **sections,
    }
    case = Case.model_validate(data)
    problem = make_problem(case)
    return Scene(replace(problem, loads=replace(problem.loads, moves=moves)))
