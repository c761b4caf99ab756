"""Mirror planes of remanences along the normals, in a uniform field."""

import numpy as np
import pytest

from magshell_fenicsx import Case
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.parts.magnetism.magnetisation import remanence_constraints
from magshell_fenicsx.parts.shell_outline import reference_shell_of

CYLINDER = {
    "shell": {
        "geometry": "cylinder",
        "radius": 1,
        "length": 1,
        "thickness": 0.02,
        "poisson_ratio": 0.3,
    },
    "boundary": {"bottom": "clamped", "top": "clamped"},
}
THROUGH_AXIS, ACROSS_AXIS, OBLIQUE = [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.6, 0.0, 0.8]


@pytest.mark.parametrize(
    ("kind", "polar", "normal", "is_mirror"),
    [
        # the energy is a product of both: either both keep their signs, or both change them
        ("radial", 0, THROUGH_AXIS, True),
        ("radial", 0, ACROSS_AXIS, False),
        ("radial", 90, ACROSS_AXIS, True),
        ("radial", 90, THROUGH_AXIS, False),
        ("tangential", 0, THROUGH_AXIS, True),
        ("tangential", 0, ACROSS_AXIS, True),
        ("tangential", 90, ACROSS_AXIS, False),
        ("tangential", 0, OBLIQUE, False),
    ],
)
def test_signs_of_images(kind: str, polar: float, normal: list[float], is_mirror: bool) -> None:
    """A tangential remanence is the opposite of its image in a plane across its axis."""
    magnetic = {"lambda_m": 1e-3, "remanent": {"kind": kind}, "applied": {"polar": polar}}
    case = Case.from_source({**CYLINDER, "magnetic": magnetic})
    outline = reference_shell_of(case.shell).perfect
    (constraint,) = remanence_constraints(case.context, outline)
    plane = Mirror(np.array(normal), 0.0, {})
    assert constraint.mirrors(plane) is is_mirror
