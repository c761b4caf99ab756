"""Paths of the meridian model against an independent axisymmetric solver (nine digits)."""

import time
from pathlib import Path as File

import numpy as np
import pytest
from conftest import CASES
from meridian_scenes import POLE_FORCE, buckle, buckled, dimpled, hemisphere, indent, unloaded

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import StepOptions
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.mesh.shapes import plane_embedding
from magshell_fenicsx.models.axisymmetric.meridian import graded_vertices, make_meridian
from magshell_fenicsx.models.shell.parameters import Force, Material
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.problem.problem import meridian_vertices
from magshell_fenicsx.public import run
from magshell_fenicsx.shells.meridian import MeridianModel


@pytest.mark.parametrize(
    ("R_over_h", "lambda_m", "k_d"),
    [
        (90, 0, 0.326233289),
        (90, 0.00184, 0.552053778),
        (90, -0.00184, 0.120723848),
        (78.75, 0, 0.326944309),
        (300, 0.00184, 1.093385),
    ],
)
def test_knockdown(R_over_h: float, lambda_m: float, k_d: float) -> None:
    found = buckled(R_over_h, lambda_m)[1].instability
    assert found.kind == "fold"
    assert found.point.state.mu["pressure"] == pytest.approx(k_d, rel=2e-7)


def test_pole_indentation() -> None:
    """F R/(2 pi D) at w/h = 1.5 and 6, R/h = 90, nu = 0.5."""
    forces = indent(hemisphere(90, 0.5, POLE_FORCE), [1.5, 6.0])
    assert forces == pytest.approx([2.9615563, 5.6202235], rel=1e-5)


def test_patch_carries_the_whole_force_and_tends_to_the_point() -> None:
    models = [
        hemisphere(90, 0.5, Loads(forces={"force": Force("pole", patch / 90)}))
        for patch in (2.0, 0.5)
    ]
    for model in models:
        down = model.zero()
        down[1::2] = -1
        assert -model.system.load(down, {}, "force") @ down == pytest.approx(
            model.force_unit, rel=1e-12
        )
        assert model.loaded_deflection(down, "force") == pytest.approx(1.0, rel=1e-12)
    point, *patches = (
        indent(model, [1.5])[0] for model in [hemisphere(90, 0.5, POLE_FORCE), *models]
    )
    assert point < patches[1] < patches[0] < 1.02 * point


def test_clamped_plate() -> None:
    """w0 = p R^4/(64 D) (Timoshenko)."""
    h, nu, p_over_pc = 1 / 50, 0.3, 1e-5
    meridian = make_meridian(plane_embedding, graded_vertices(1.0, [], h))
    model = MeridianModel(meridian, Material(nu, h), 4, {"rim": "clamped"}, Loads(pressure=True))
    path = Path(
        BorderedNewton(model.system),
        "pressure",
        "load",
        StepOptions(p_over_pc, p_over_pc, p_over_pc),
    )
    ((point, _),) = path.continue_to(path.start(unloaded(model)), [p_over_pc])
    p = p_over_pc * model.material.classical_pressure / h
    w0 = model.deflection(point.state.u, "pole")
    assert w0 == pytest.approx(
        p / (64 * model.material.bending_stiffness), rel=2e-5
    )  # the membrane carries 1e-5
    assert model.volume_change(point.state.u) == pytest.approx(-np.pi * w0 / 3, rel=2e-5)


def test_axial_motion_costs_nothing() -> None:
    model = hemisphere(30, 0.3, Loads(), condition="free")
    u = model.zero()
    u[1::2] = 0.7
    R, K = model.system.residual(u, {}), model.system.tangent(u, {})
    assert np.abs(R).max() < 1e-14 * K.norm()


def test_takes_seconds() -> None:
    """Of the processor, with warm kernels."""
    dimpled(90, 0.00184)
    start = time.process_time()
    buckle(dimpled(90, 0.00184), 0.00184)
    assert time.process_time() - start < 2


def test_every_rank_has_the_whole_meridian() -> None:
    """So it runs under mpirun as it does alone."""
    assert hemisphere(30, 0.3, Loads()).system.comm.size == 1


def test_cells_of_a_given_size() -> None:
    """All alike, but for a vertex on each rim; far too many are refused before they are made."""
    case = Case.load(CASES / "dimple_buckling.yaml", ["mesh.size=0.1", "mesh.refinement=2"])
    problem = make_problem(case)
    lengths = np.diff(meridian_vertices(problem))
    (rim,) = problem.meridian.curvature_jumps
    assert len(lengths) == np.ceil(rim / 0.05) + np.ceil((np.pi / 2 - rim) / 0.05)
    assert lengths.max() < 0.05 < 1.3 * lengths.min()
    tiny = Case.load(CASES / "dimple_buckling.yaml", ["mesh.size=1e-9"])
    with pytest.raises(MeshError, match=r"would have .* cells, allowed 1e\+06"):
        meridian_vertices(make_problem(tiny))


@pytest.mark.slow
def test_waves_that_come_and_go_within_a_step() -> None:
    """A designed remanence: the same bifurcations on the path's own steps, up to 0.08 of the load,
    as at 50 loads.
    """
    remanent = f"{{kind: points, file: {File(__file__).parent / 'window.csv'}, filter: 0.0667}}"
    settings = ["magnetic.lambda_m=0.001", f"magnetic.remanent={remanent}"]
    found = {}
    for how in ("until: limit", "control: load, until: target, pressure: 1, points: 50"):
        case = Case.load(
            CASES / "dimple_buckling.yaml", [*settings, f"loading={{kind: pressure, {how}}}"]
        )
        found[how] = [
            (p["mode"], p["p_over_pc"]) for p in run(case).limit_points if p["p_over_pc"] < 1
        ]
    steps, loads = found.values()
    assert (
        [mode for mode, _ in steps]
        == [mode for mode, _ in loads]
        == ["m = 4", "m = 5", "m = 5", "m = 4"]
    )
    assert [load for _, load in steps] == pytest.approx([load for _, load in loads], rel=1e-6)
