"""A scene with the fields of another case has the path of a scene that is made for it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from conftest import CASES

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.tables import write_vectors
from magshell_fenicsx.problem.problem import Document, Problem
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.scene import Scene as SceneOfProblem
from magshell_fenicsx.simulate.scene_cache import SceneCache, UnfitMesh, update_fields

STRIP = """
shell: {geometry: strip, radius_to_thickness: 100, width: 0.1, poisson_ratio: 0.2, \
thickness_factor: "1"}
boundary: {root: clamped}
magnetic: {lambda_m: 3.3e-5, remanent: {kind: points, file: one.csv, filter: 0.3}, \
applied: {polar: 0}}
natural: {curvature: [0, 0, 0]}
mesh: {degree: 2, refinement: 0.4}
loading: {kind: field, points: 2}
"""
OTHER = [
    "magnetic.remanent.file=two.csv",
    "shell.thickness_factor=1 + x/5",
    "natural.curvature=[0.3*x, 0.1, 0]",
]
BUCKLING = [
    "shell.thickness_factor=1 + 0*z",
    "natural={curvature: [0, 0, 0]}",
    "magnetic.lambda_m=0.001",
]
THICKER = [
    "shell.thickness_factor=1 + z/10",
    "natural={curvature: [0.1, 0.2*z, 0]}",
    "magnetic.lambda_m=0.001",
]


def test_half_strip(tmp_path: Path) -> None:
    s = np.linspace(0, 1, 5)
    for name, angle in (("one", 1.5 + 0 * s), ("two", 2 * s)):
        vectors = np.column_stack([np.sin(angle), 0 * s, np.cos(angle)])
        write_vectors(tmp_path / f"{name}.csv", np.column_stack([s, 0 * s, 0 * s]), vectors)
    (tmp_path / "strip.yaml").write_text(STRIP)
    agree(Case.load(tmp_path / "strip.yaml"), Case.load(tmp_path / "strip.yaml", OTHER))


@pytest.mark.slow
def test_meridian() -> None:
    agree(
        *(Case.load(CASES / "dimple_buckling.yaml", settings) for settings in (BUCKLING, THICKER))
    )


def agree(first: Case, second: Case) -> None:
    """Forwards and back."""
    scene = Scene(first)
    *_, there = follow(scene)
    *_, other = follow(Scene(second))
    for case, expected in ((second, other), (first, there)):
        assert update_fields(scene, case.problem())
        *_, last = follow(scene)
        assert last.label == expected.label
        assert last.point.state.mu == pytest.approx(expected.point.state.mu, rel=1e-10)
        size = np.abs(expected.point.state.u).max()
        np.testing.assert_allclose(
            last.point.state.u, expected.point.state.u, rtol=0, atol=1e-9 * size
        )


def test_another_case_is_another_scene() -> None:
    """What is not a field in the terms, or changes more, makes a new scene."""
    case = Case.load(CASES / "dimple_buckling.yaml", BUCKLING)
    known = SceneCache(overwrites=True)
    scene = known.scene_for(case.problem())
    assert known.scene_for(case.problem()) is scene
    for setting in ("shell.poisson_ratio=0.3", "symmetry=half", "mesh.degree=3"):
        assert not update_fields(
            scene, Case.load(CASES / "dimple_buckling.yaml", [*BUCKLING, setting]).problem()
        )
    bare = replace(case.problem(), document=Document())
    assert not update_fields(Scene(bare), bare)


def test_known_values_have_their_scene() -> None:
    """Of two scenes, where there is room for one, the latest stays."""
    case = Case.load(CASES / "dimple_buckling.yaml", BUCKLING)
    cache, made = SceneCache(base=Scene(case), max_unknowns=0), list[float]()

    def at(ratio: float) -> SceneOfProblem:
        def problem() -> Problem:
            made.append(ratio)
            return case.problem().with_values({"shell.poisson_ratio": ratio})

        return cache.scene_at(ratio, problem)

    assert at(0.4) is at(0.4)
    assert at(0.3).problem.material.nu == 0.3
    at(0.4)
    assert made == [0.4, 0.3, 0.4]


def test_a_mesh_that_does_not_fit() -> None:
    """A field across the axis needs more than a meridian."""
    base = Scene(Case.load(CASES / "dimple_buckling.yaml", BUCKLING))
    across = Case.load(CASES / "dimple_buckling.yaml", [*BUCKLING, "magnetic.applied.polar=30"])
    for moves_mesh, message in ((False, "breaks the symmetry"), (True, "changes on the way")):
        with pytest.raises(UnfitMesh, match=message):
            SceneCache(base=base, moves_mesh=moves_mesh).scene_for(across.problem())
