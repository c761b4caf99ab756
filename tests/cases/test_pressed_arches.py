"""Two equal arches pressed top to top: each is as one that is pressed by a rigid plane."""

from typing import Any

import pytest

from magshell_fenicsx import Case
from magshell_fenicsx.public import run

h = 0.02
ARCH = {
    "geometry": "cylinder",
    "radius": 1,
    "length": 0.12,
    "azimuth": [60, 120],
    "thickness": h,
    "youngs_modulus": 1,
    "poisson_ratio": 0.3,
}
HELD = {"left": "clamped", "right": "clamped", "bottom": "symmetry", "top": "symmetry"}
ELEMENTS = {"degree": 3, "size": 0.12}


def forces(data: dict[str, Any], column: str) -> list[float]:
    rows = run(Case.from_source(data | {"mesh": ELEMENTS})).rows
    return [row[column] for row in rows if row["label"] == "target"]


@pytest.mark.slow
def test_two_arches_and_a_plane() -> None:
    """The force at approaches of h/2 and h of each, 1e-3.

    Both are halves on the same mesh. That of a whole arch has no sides of cells along the line of
    contact: on it two arches, and one on the plane, have 1.4 % more force.
    """
    top = {"position": [0, 2 + 1.0001 * h, 0], "turn": 180}
    move = {"supports": ["upper.left", "upper.right"], "translation": [0, -2 * h, 0]}
    both = {
        "shells": {
            "lower": {"shell": ARCH, "boundary": HELD},
            "upper": {"shell": ARCH, "boundary": HELD, "place": top},
        },
        "contact": [["upper", "lower"]],
        "loading": [{"kind": "edge", "moves": [move], "factor": f, "points": 1} for f in (0.5, 1)],
    }
    plane = {"kind": "plane", "at": {"point": [0, 1, 0.06]}}
    one = {
        "shell": ARCH,
        "boundary": HELD,
        "bodies": {"plane": plane},
        "loading": [
            {"kind": "contact", "body": "plane", "approach": f, "points": 1} for f in (0.5, 1)
        ],
    }
    assert forces(both, "contact_force") == pytest.approx(forces(one, "force"), rel=1e-3)
