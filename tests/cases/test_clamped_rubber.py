"""Rubber at a clamped rim: the layer in which it bends sharply makes no fold and no bifurcation that are none.

Sources: an axisymmetric solid of three dimensions has p R/(mu h) = 1.891 at the fold of a clamped disc with R/h = 50,
where a membrane has 1.8792, and 35.97 p_c at that of a clamped cap of 40 degrees, which stays stable against waves.
"""

from collections.abc import Mapping
from typing import Any

import pytest

from magshell_fenicsx.public import run

RUBBER = {"poisson_ratio": 0.5, "law": "neo-hookean"}
FINER = [{"refinement": 0.5}, {"refinement": 4}, {"degree": 3}, {"degree": 5}]


@pytest.mark.parametrize("mesh", [{}, *(pytest.param(each, marks=pytest.mark.slow) for each in FINER)], ids=str)
def test_the_fold_of_a_clamped_disc(mesh: Mapping[str, Any]) -> None:
    """On these meshes to 1.3e-3 of the default one, and to 5e-3 of the solid; p R/(mu h) is 4 k_d h/R."""
    shell = {"geometry": "disc", "radius_to_thickness": 50} | RUBBER
    loading = {"kind": "pressure", "control": "arc", "until": "limit"}
    last = run({"shell": shell, "boundary": {"rim": "clamped"}, "mesh": mesh, "loading": loading}).rows[-1]
    assert last["label"] == "fold"
    pressure = 4 * float(last["p_over_pc"]) / 50
    assert pressure == pytest.approx(1.8972, rel=1.3e-3)
    assert pressure == pytest.approx(1.891, rel=5e-3)


@pytest.mark.parametrize("mesh", [{}, pytest.param({"refinement": 2}, marks=pytest.mark.slow)], ids=str)
def test_a_clamped_cap_blown_up(mesh: Mapping[str, Any]) -> None:
    """Its fold to 3e-3, and no mode is unstable beside the fold's own up to the volume 3 R^3."""
    shell = {"geometry": "cap", "polar": 40, "radius": 1, "thickness": 0.02, "youngs_modulus": 1} | RUBBER
    loading = {"kind": "pressure", "control": "volume", "until": "target", "volume_change": 3.0, "points": 3}
    rows = run({"shell": shell, "boundary": {"rim": "clamped"}, "mesh": mesh, "loading": loading}).rows
    (event,) = [row for row in rows if row["label"] in ("fold", "bifurcation")]
    assert event["label"] == "fold"
    assert float(event["p_over_pc"]) == pytest.approx(-35.97, rel=3e-3)
    assert float(rows[-1]["volume_change"]) == pytest.approx(3.0)
