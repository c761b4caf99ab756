"""A clamped hemisphere without defect under pressure: the waves that come first, by two models.

The meridian model finds them by its second variation, the surface model by its inertia. On the
surface the mesh is a small imperfection: near the bifurcation the path bends into a fold or steps
over it, and either tells the pressure.
"""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.modes import critical_mode
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.output.fields.gathering import gatherer
from magshell_fenicsx.simulate.follow import follow


def scene(symmetry: str, R_over_h: float, **mesh: Any) -> Scene:
    data = {
        "shell": {"geometry": "hemisphere", "radius_to_thickness": R_over_h, "poisson_ratio": 0.5},
        "boundary": {"equator": "clamped"},
        "loading": {"kind": "pressure"},
        "mesh": mesh,
        "symmetry": symmetry,
    }
    return Scene(Case.from_source(Source("sphere", data)))


def waves_of(found: Scene, vector: np.ndarray) -> int:
    """The number of waves that fits the normal displacement best.

    This is on the circle where it is largest.
    """
    surface = gatherer(found.model, found.comm).gather(vector)
    assert surface is not None
    theta = np.arctan2(surface.r0[:, 1], surface.r0[:, 0])
    height = surface.r0[:, 2]
    ring = np.abs(height - height[np.argmax(np.abs(surface.w))]) < 0.02
    fits = []
    for m in range(1, 60):
        basis = np.column_stack([np.cos(m * theta[ring]), np.sin(m * theta[ring])])
        fits.append(np.linalg.lstsq(basis, surface.w[ring], rcond=None)[1].sum())
    return 1 + int(np.argmin(fits))


def compare(symmetry: str, R_over_h: float, **mesh: Any) -> tuple[str, float, int, float]:
    """Mode and p/p_c of the meridian model, waves and p/p_c of the surface model."""
    waves, *_ = [r for r in follow(scene("axisymmetric", R_over_h)) if r.mode]
    surface = scene(symmetry, R_over_h, **mesh)
    *_, before, found = [r for r in follow(surface) if r.mode != "antisymmetric"]
    state = before.point.state if found.label == "fold" else found.point.state
    mode = critical_mode(surface.newton, state)
    return (
        waves.mode,
        waves.point.state.mu["pressure"],
        waves_of(surface, mode.vector),
        found.point.state.mu["pressure"],
    )


@pytest.mark.slow
def test_same_waves_at_the_same_pressure() -> None:
    mode, p, waves, p_surface = compare("half", 20, refinement=1.5)
    assert mode == f"m = {waves}"
    assert p_surface == pytest.approx(p, rel=5e-3)


if __name__ == "__main__":
    print(
        "R/h = 90, nu = 0.5, full shell (meridian: mode, p/p_c; surface: waves, p/p_c):",
        compare("none", 90.0),
    )
