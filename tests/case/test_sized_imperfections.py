"""Depths and widths of imperfections with units: the same numbers over h, and messages."""

from math import sqrt

import pytest
from conftest import CASES

import magshell_fenicsx as ms
from magshell_fenicsx.case.case_variants import case_with_values
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionSection

R, H, NU = 25.2, 0.28, 0.5
WIDTH = R / sqrt(sqrt(12 * (1 - NU**2)) * R / H)  # mm: the width 1
SPHERE = f"geometry: hemisphere, radius: {R} mm, thickness: {H} mm, poisson_ratio: {NU}"
CAP = f"geometry: cap, radius: {R} mm, thickness: {H} mm, poisson_ratio: {NU}, polar: 60"
BARE = SPHERE.replace(f"radius: {R} mm, thickness: {H} mm", "radius_to_thickness: 90")
DRAWN = (
    "{kind: random, seed: 1, dimples: {count: 2, amplitude: AMPLITUDE, width: 2, polar: [0, 40], "
    "distance: 25}}"
)


def loaded(shell: str, imperfection: str) -> list[ImperfectionSection]:
    """The imperfections of a case."""
    edge = "rim" if "cap" in shell else "equator"
    settings = [
        f"shell={{{shell}, imperfections: [{imperfection}]}}",
        f"boundary={{{edge}: clamped}}",
    ]
    return list(ms.Case.load(CASES / "dimple_buckling.yaml", settings).imperfections.values())


@pytest.mark.parametrize("shell", [SPHERE, CAP])
@pytest.mark.parametrize(
    ("written", "number"),
    [
        (
            f"{{kind: dimple, amplitude: {2 * H} mm, width: {3 * WIDTH} mm}}",
            "{kind: dimple, amplitude: 2, width: 3}",
        ),
        (
            f"{{kind: gaussian, amplitude: {-500 * H} um, width: 3}}",
            "{kind: gaussian, amplitude: -0.5, width: 3}",
        ),
        (
            f"{{kind: modes, amplitudes: [{H / 5} mm, 0.1]}}",
            "{kind: modes, amplitudes: [0.2, 0.1]}",
        ),
        (
            f"{{kind: random, seed: 3, amplitude: {H / 10} mm, length: {2 * WIDTH / 10} cm}}",
            "{kind: random, seed: 3, amplitude: 0.1, length: 2}",
        ),
        (
            DRAWN.replace("AMPLITUDE", f"{{kind: choice, values: [{H}], unit: mm}}"),
            DRAWN.replace("AMPLITUDE", "1"),
        ),
        (
            f"{{kind: data, file: a.csv, noise: {H / 100} mm}}",
            "{kind: data, file: a.csv, noise: 0.01}",
        ),
    ],
)
def test_the_same_numbers(shell: str, written: str, number: str) -> None:
    found, expected = (
        [each.model_dump() for each in loaded(shell, one)] for one in (written, number)
    )
    assert len(found) == len(expected) > 0
    for one, other in zip(found, expected, strict=True):
        assert one.keys() == other.keys()
        for key, value in one.items():
            assert value == (
                pytest.approx(other[key]) if isinstance(value, float | list) else other[key]
            )


@pytest.mark.parametrize(
    ("shell", "imperfection", "said"),
    [
        (
            BARE,
            "{kind: dimple, amplitude: 0.3 mm, width: 3}",
            "amplitude: '0.3 mm': has a unit: that needs lengths of",
        ),
        (
            BARE,
            "{kind: dimple, amplitude: 1, width: 3 mm}",
            "a number is in the unit of a dimple's width",
        ),
        (
            SPHERE,
            "{kind: dimple, amplitude: 3 Pa, width: 3}",
            "0.amplitude: '3 Pa': is not convertible to metre",
        ),
        (
            SPHERE,
            "{kind: gaussian, amplitude: deep, width: 3}",
            "0.amplitude: 'deep': is not a number with a unit",
        ),
        (
            SPHERE,
            "{kind: gaussian, amplitude: 30 mm, width: 3}",
            "amplitude: '30 mm' is 107.143: must be less than or equal to 50",
        ),
        (
            BARE,
            DRAWN.replace("AMPLITUDE", "{kind: normal, mean: 1, deviation: 0.1, unit: mm}"),
            (
                "shell.imperfections.0: dimples: amplitude: has a unit: that needs lengths of the "
                "shell with units"
            ),
        ),
    ],
)
def test_mistakes(shell: str, imperfection: str, said: str) -> None:
    with pytest.raises(ms.CaseError) as e:
        loaded(shell, imperfection)
    assert said in str(e.value)
    assert "\n" not in str(e.value)


def test_a_wrong_shell_has_one_message() -> None:
    with pytest.raises(ms.CaseError) as e:
        loaded(
            SPHERE.replace("poisson_ratio: 0.5", "poisson_ratio: 0.7"),
            "{kind: dimple, amplitude: 1 mm, width: 3}",
        )
    assert "poisson_ratio: 0.7: must be less" in str(e.value)
    assert "\n" not in str(e.value)


def test_the_defect() -> None:
    (found,) = ms.Case.load(
        CASES / "dimple_buckling.yaml",
        [f"shell={{{SPHERE}, defect: {{kind: dimple, amplitude: {H} mm, width: {WIDTH} mm}}}}"],
    ).imperfections.values()
    assert found.model_dump(include={"amplitude", "width"}) == pytest.approx(
        {"amplitude": 1, "width": 1}
    )


@pytest.mark.parametrize("written", [f"{2 * H} mm", "0 mm", "2"])
@pytest.mark.parametrize("several", [False, True])
def test_other_numbers_of_what_has_a_unit(several: bool, written: str) -> None:
    """As derivatives take them: over h, and in widths, whatever the case has written."""
    flaw = {
        "kind": "gaussian",
        "amplitude": float(written) if written == "2" else written,
        "width": f"{3 * WIDTH} mm",
    }
    shell = {
        "geometry": "cap",
        "radius": f"{R} mm",
        "thickness": f"{H} mm",
        "poisson_ratio": NU,
        "polar": 60,
    }
    one = {"shell": {**shell, "imperfections": [flaw]}, "boundary": {"rim": "clamped"}}
    above = {"shell": shell, "boundary": {"rim": "clamped"}, "place": {"position": [0, 0, "5 mm"]}}
    loading = {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.01}
    case = ms.Case.from_source(
        ({"shells": {"a": one, "b": above}} if several else one) | {"loading": loading}
    )
    key = ("shells.a." if several else "") + "shell.imperfections.0."
    other = case_with_values(case, {f"{key}amplitude": 1.5, f"{key}width": 2.0})
    assert other.origin.data is not None
    for each in (other, ms.Case.from_source(other.origin.data)):
        section = (each.shells["a"] if several and each.shells else each).shell.imperfections[0]
        assert (section.amplitude, section.width) == pytest.approx((1.5, 2.0), rel=1e-12)
