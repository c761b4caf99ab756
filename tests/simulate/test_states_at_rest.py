"""An energy that moves the undeformed shell: it comes to rest before its programme begins."""

from math import sqrt

import pytest
from ufl.core.expr import Expr

import magshell_fenicsx as ms
from magshell_fenicsx.models.shell.kinematics import Jet

TENSION, NU = 0.02, 0.3


def tension(r0: Jet, u: Jet) -> Expr:
    """Of the deformed area."""
    return ms.kinematics.area_ratio(r0 + u) / ms.kinematics.area_ratio(r0)


def test_a_plate_shrinks_under_its_surface_tension() -> None:
    """W = E²/(1 - ν) + γ λ² with the strain E = (λ² - 1)/2 is least at E = -(1 - ν) γ; a quarter of
    it.
    """
    shell = {"geometry": "plate", "length": 1, "width": 1, "thickness": 0.02, "poisson_ratio": NU}
    held = {
        "left": "symmetry",
        "bottom": "symmetry",
        "right": {"held": ["z"]},
        "top": {"held": ["z"]},
    }
    pressed = {"kind": "pressure", "pressure": 1e-6, "until": "target", "points": 1}
    sections = {
        "shell": shell,
        "boundary": held,
        "points": {"corner": [1, 1, 0]},
        "loading": pressed,
    }
    case = ms.Case.from_source({**sections, "mesh": {"size": 0.5}})
    scene = ms.Scene(case.with_terms([ms.OwnTerm("tension", tension, value=TENSION)]))
    first, *rise, last = ms.follow(scene)
    assert first.point.state.mu["tension"] == 0
    at_rest = [record for record in rise if record.amplitude == "tension"][-1]
    assert (at_rest.label, at_rest.step, at_rest.point.state.mu["tension"]) == (
        "target",
        0,
        TENSION,
    )
    shrunk = sqrt(1 - 2 * (1 - NU) * TENSION) - 1
    assert scene.observe(at_rest.point.state)["corner_ux"] == pytest.approx(shrunk, rel=1e-9)
    assert scene.observe(last.point.state)["corner_uy"] == pytest.approx(shrunk, rel=1e-3)


def test_weight_that_a_cap_does_not_carry() -> None:
    """Four times p_c, which no cap carries: p_c R/(E h) = 2/√(3(1 - ν²)) h/R."""
    shell = {"geometry": "cap", "polar": 40, "radius": 1.0, "thickness": 0.01, "poisson_ratio": NU}
    weight = ms.OwnTerm("weight", lambda r0, u: u.r[2], value=0.05)
    case = ms.Case.from_source({"shell": shell, "boundary": {"rim": "hinged"}}).with_terms([weight])
    with pytest.raises(ms.Stopped, match="on the way to rest under the energy weight: "):
        list(ms.follow(ms.Scene(case)))
