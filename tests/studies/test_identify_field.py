"""A field of remanence beside a number, and what is predicted with both; the same on 1, 2 and 3 ranks."""

import json
from pathlib import Path
from typing import Any

import pytest
from command import magshell, started
from conftest import STRIP

COARSE = STRIP.replace("degree: 3, refinement: 0.5", "degree: 2, refinement: 0.3").replace("points: 4", "points: 1")
LOOKED_FOR = """
identify:
  parameters: {shell.youngs_modulus: {prior: 900 kPa, deviation: 9 kPa}}
  remanence: {points: 3, length: 0.5, deviation: 0.05}
  noise: {ux: 0.05 mm}
  narrow: remanence
  candidates: [{of: tip_ux_mm, noise: 0.02 mm}, {of: tip_uz_mm, noise: 1 mm}]
  predict:
    turned:
      settings: [magnetic.applied.flux_density=-20 mT, magnetic.remanent.flux_density=-143 mT]
      of: ["tip_ux_mm@end", "tip_uz_mm@end"]
      samples: 20
"""
SHAPE = "x [mm],y [mm],z [mm],ux [mm]\n8,0,0,-0.8\n"  # for 72 degrees -0.802 mm
FAR = ("value", "low", "high")


@pytest.mark.slow
def test_a_field_and_its_predictions(tmp_path: Path) -> None:
    """Bands of 20 runs of a reversed history, which changes nothing, are those of slopes; narrowed is the field.

    On 2 and 3 ranks all is the same, but for sums in another order.
    """
    case, data = tmp_path / "strip.yaml", tmp_path / "shape.csv"
    case.write_text(COARSE + LOOKED_FOR)
    data.write_text(SHAPE)
    words = ["identify", case, "--data", data, "--out"]
    done = magshell(*words, tmp_path / "1")
    assert done.returncode == 0, done.stderr
    found = [_content(tmp_path / "1")]
    assert "warning: the data do not say" not in done.stdout  # the prior is given
    numbers = found[0]["programmes"]["turned"]["numbers"]
    for by_slopes in found[0]["predicted"]:
        by_runs = numbers[f"{by_slopes['result']}@end"]
        assert by_runs["value"] == pytest.approx(by_slopes["value"], rel=1e-6)
        width = by_slopes["high"] - by_slopes["low"]
        for end in ("low", "high"):
            assert by_runs[end] == pytest.approx(by_slopes[end], abs=0.15 * width)
    best = found[0]["next"]
    assert (best["parameter"], best["result"]) == ("remanence", "tip_ux_mm")
    assert best["to"] < best["from"]
    for ranks in (2, 3):
        done = started(*words, tmp_path / str(ranks), ranks=ranks)
        assert done.returncode == 0, done.stderr
        found.append(_content(tmp_path / str(ranks)))
    one, *others = (_numbers(each) for each in found)
    for other in others:
        assert other == pytest.approx(one, rel=1e-5)


def _content(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "identify.json").read_text()))


def _numbers(content: dict[str, Any]) -> list[float]:
    """Values and deviations of number and field, and all that is predicted with them."""
    modulus, field = content["parameters"]["shell.youngs_modulus"], content["remanence"]
    several = [*content["predicted"], *content["programmes"]["turned"]["numbers"].values()]
    of_field = [v for name in ("value", "deviation") for row in field[name] for v in row]
    return [modulus["value"], modulus["deviation"], *of_field, *(each[name] for each in several for name in FAR)]
