"""User-defined energies in whole runs, and what Python says where a path or a state is not what was
meant.
"""

import json
import warnings
from pathlib import Path

import numpy as np
import pytest
import ufl
from command import read_path
from conftest import CASES

import magshell_fenicsx as ms

COARSE = ["mesh.degree=3", "mesh.refinement=0.5"]


def springs(r0: ms.Jet, u: ms.Jet, k: float) -> ufl.core.expr.Expr:
    return k * ufl.dot(u.r, ms.kinematics.normal(r0)) ** 2 / 2


def case_of(*settings: str) -> ms.Case:
    return ms.Case.load(CASES / "dimple_buckling.yaml", [*COARSE, *settings])


def test_run_with_ones_own_energy(tmp_path: Path) -> None:
    """Springs with k as a parameter against those of the case file; all files, resumed, and the
    report.
    """
    mine = ms.OwnTerm("my_springs", springs, (0.02,), value=1.0)
    stopped = ms.run(case_of(), tmp_path / "own", terms=[mine], pictures=False, time_limit=0)
    assert "interrupted" in (stopped.stopped or "")
    with pytest.raises(ms.CaseError, match=r"belongs to another run: terms\.my_springs is"):
        ms.run(
            case_of(),
            tmp_path / "own",
            terms=[ms.OwnTerm("my_springs", springs, (0.03,), value=1.0)],
            resume=True,
        )
    with pytest.raises(ms.CaseError, match=r"terms\.my_springs is .* there and nothing here"):
        ms.run(case_of(), tmp_path / "own", resume=True)
    own = ms.run(case_of(), tmp_path / "own", terms=[mine], pictures=False, resume=True)
    built_in = ms.run(case_of(f"foundation={{stiffness: {0.02 / 90}}}"), pictures=False)
    assert own.knockdown == pytest.approx(built_in.knockdown, rel=1e-9)
    assert own.knockdown > 1.01 * ms.run(case_of()).knockdown
    assert float(read_path(tmp_path / "own")[-1]["my_springs"]) == 1
    summary = json.loads((tmp_path / "own/summary.json").read_text(encoding="utf-8"))
    assert "own energy: my_springs" in summary["model"]["included"]
    assert "own energy: my_springs" in (tmp_path / "own/report.html").read_text(encoding="utf-8")


def test_trace_says_that_it_has_not_arrived() -> None:
    """The shell buckles at 0.33 p_c, on the way to 0.5."""
    scene = ms.Scene(case_of())
    with pytest.warns(
        UserWarning,
        match=r"trace: pressure: ends at a fold at pressure = 0\.32\d*, before its target 0\.5",
    ):
        *before, last = ms.trace(scene, "pressure", targets=[0.2, 0.5])
    assert (last.label, last.reached) == ("fold", False)
    assert all(record.reached for record in before)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        *_, last = ms.trace(scene, "pressure", targets=[0.1, 0.2])
    assert last.reached


def test_state_of_another_scene_is_refused() -> None:
    scene, finer = ms.Scene(case_of()), ms.Scene(case_of("mesh.degree=4"))
    with_springs = ms.Scene(case_of(), terms=[ms.OwnTerm("k", springs, (1.0,))])
    *_, last = ms.trace(scene, "pressure", targets=[0.1])
    *_, sprung = ms.trace(with_springs, "pressure", targets=[0.1])
    with pytest.raises(
        ValueError, match="its amplitudes are k, pressure, those of this scene pressure"
    ):
        ms.surface(scene, sprung)
    for other, said in (
        (finer, r"it has \d+ unknowns on this rank, this scene has \d+"),
        (with_springs, "those of this"),
    ):
        for use in (
            lambda other: list(ms.trace(other, "pressure", last, targets=[0.2])),
            lambda other: other.observe(last.point.state),
            lambda other: ms.surface(other, last),
            lambda other: list(ms.solutions(other, last)),
        ):
            with pytest.raises(ValueError, match=f"this state is of another scene: .*{said}"):
                use(other)


def test_slope_of_the_knockdown_where_the_field_is_zero() -> None:
    """Against differences of folds in small fields of both signs."""

    def knockdown(field: float) -> float:
        scene = ms.Scene(case_of(f"magnetic.lambda_m={field}"))
        *_, last = ms.follow(scene)
        return ms.fold_at(scene, last).value

    scene, step = ms.Scene(case_of("magnetic.lambda_m=0")), 2e-5
    *_, last = ms.follow(scene)
    found = ms.sensitivities(scene, ms.fold_at(scene, last))
    assert found["lambda_m"] == pytest.approx(
        (knockdown(step) - knockdown(-step)) / (2 * step), rel=1e-5
    )


@pytest.mark.parametrize(
    ("density", "said"),
    [
        (lambda r0, u: np.sqrt(u.r), "not of NumPy or math"),
        (
            lambda r0: r0.r[0],
            r"takes 1 positional argument but 2 were given.*r0, u and 0 parameters",
        ),
        (lambda r0, u: None, "returns a scalar"),
        (lambda r0, u: u.nothing, "has no attribute 'nothing'"),
        (lambda r0, u: u.r, r"a density is a scalar; this has the shape \(3,\)"),
    ],
)
def test_mistakes_in_a_density_in_words(density, said: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=f"(?s)^mine: .*{said}"):
        ms.OwnTerm("mine", density)
