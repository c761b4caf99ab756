"""What `check` finds of formulas and of the names of results, without a model."""

import pytest

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.gradients.results import NamesOnlyScene, refuse_unknown_results
from magshell_fenicsx.simulate.results import differentiable

CASE = {
    "shell": {"geometry": "hemisphere", "radius_to_thickness": 50, "poisson_ratio": 0.3},
    "boundary": {"equator": "clamped"},
    "loading": {
        "kind": "pressure",
        "control": "load",
        "until": "target",
        "pressure": 0.1,
        "points": 1,
    },
    "mesh": {"degree": 3, "refinement": 0.5},
}


@pytest.mark.parametrize("factor", ["1/0", "log(-1)", "0", "-1", "1e-30"])
def test_a_thickness_that_is_none(factor):
    case = Case.model_validate(CASE | {"shell": CASE["shell"] | {"thickness_factor": factor}})
    with pytest.raises(
        CaseError, match=r"shell\.thickness_factor: .*: is .* at .*: allowed 0\.001 to 1000"
    ):
        describe(case)


@pytest.mark.parametrize("natural", [{"stretch": "1/0"}, {"curvature": "1/x"}])
def test_a_natural_shape_that_is_none(natural):
    with pytest.raises(CaseError, match=r"natural\.(stretch|curvature): .* is inf at"):
        describe(Case.model_validate(CASE | {"natural": natural}))


@pytest.mark.parametrize(
    ("section", "said"),
    [
        (
            {"gradients": {"of": ["nope"]}},
            r"gradients\.of: nope: has no gradient here; allowed are knockdown",
        ),
        ({"gradients": {"by": ["nope"]}}, r"gradients\.by: nope: the case has no such key"),
        (
            {"gradients": {"by": ["lambda_m"]}},
            r"gradients\.by: lambda_m: nothing in the case has this amplitude; it has pressure",
        ),
        (
            {
                "design": {
                    "numbers": {"shell.poisson_ratio": [0.2, 0.4]},
                    "objective": {"maximise": "nope"},
                }
            },
            r"design\.objective\.maximise: nope: has no gradient here",
        ),
    ],
)
def test_unknown_results_and_parameters(section, said):
    case = Case.model_validate(CASE | section)
    with pytest.raises(CaseError, match=said):
        refuse_unknown_results(case.problem(), case.design.named_results if case.design else {})


def test_names_of_a_problem_are_those_of_its_scene():
    case = Case.model_validate(CASE | {"reactions": True, "points": {"a": [0, 0, 1]}})
    scene = Scene(case)
    expected = NamesOnlyScene(scene.problem)
    assert differentiable(expected, expected.unloaded()) == differentiable(scene, scene.unloaded())
