"""A remanence is found again from the shape that it gives."""

import contextlib
from pathlib import Path

import numpy as np
import pytest
import scipy
from many import variables
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import read_source
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.scene_cache import SceneCache
from magshell_fenicsx.studies.design.evaluation import evaluate

Array = NDArray[np.float64]
STRIP = """
shell: {geometry: strip, radius_to_thickness: 100, width: 0.2, poisson_ratio: 0.2}
boundary: {root: clamped}
magnetic: {lambda_m: 1.0e-4, remanent: {polar: 90}, applied: {polar: 0}}
mesh: {degree: 2, refinement: 0.5}
design: {objective: {shape: {components: [x, y, z]}}, remanence: {points: 6}}
"""


@pytest.mark.slow
def test_from_its_own_shape(tmp_path: Path) -> None:
    """The misfit falls by 1e6, and the field is found where it shows: a torque near the root bends
    little of it.
    """
    (tmp_path / "strip.yaml").write_text(STRIP)
    source = read_source(tmp_path / "strip.yaml")
    case = Case.from_source(source)
    assert case.design
    vary, file = variables(source, case, case.design), tmp_path / "B.csv"
    known = vary.start_values + 0.5 * np.sin(np.arange(6.0))

    def made(x: Array) -> Case:
        vary.write(x, file)
        return vary.case_of(x, file)

    scene = Scene(made(known))
    *_, last = follow(scene)
    u = scene.model.system.with_ghosts(last.point.state.u)
    places = scene.model.r0.x.array.reshape(-1, 3)  # type: ignore[union-attr]
    there, tree = places + u.reshape(-1, 3), scipy.spatial.cKDTree(places)
    misfits, standing = list[float](), SceneCache(overwrites=True)

    def misfit(x: Array) -> tuple[float, Array]:
        shape = {"shape": lambda at: there[tree.query(at)[1]]}
        found = evaluate(made(x), x, vary, ["shape"], shape, standing)
        misfits.append(found.values["shape"])
        return 1e6 * found.values["shape"], 1e6 * np.array(found.gradients["shape"])

    class Enough(Exception):
        """The misfit is as small as it shall be."""

    best = vary.start_values

    def watched(x: Array) -> tuple[float, Array]:
        nonlocal best
        value, slope = misfit(x)
        best = np.array(x) if misfits[-1] == min(misfits) else best
        if misfits[-1] < 1e-7 * misfits[0]:
            raise Enough
        return value, slope

    with contextlib.suppress(Enough):
        scipy.optimize.minimize(
            watched,
            vary.start_values,
            jac=True,
            method="L-BFGS-B",
            options={"maxiter": 80, "ftol": 0.0},
        )
    assert min(misfits) < 1e-6 * misfits[0]
    last_numeric_axis = np.linspace(0, 1, 11)
    assert vary.controls
    weights = vary.controls.weights(
        np.column_stack([last_numeric_axis, 0 * last_numeric_axis, 0 * last_numeric_axis])
    )
    found, wanted = (weights @ vary.vectors(x) for x in (best, known))
    away = np.linalg.norm(found - wanted, axis=1)
    assert away[last_numeric_axis > 0.35].max() < 0.015
    assert away.max() < 0.05
