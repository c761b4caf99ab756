"""A field of remanence, and what is predicted with it; the same on 1, 2 and 3 ranks."""

import json
from pathlib import Path
from typing import Any

import pytest
from command import magshell, started

CASE = """
shell: {geometry: cap, radius: 40 mm, thickness: 0.8 mm, polar: 45, youngs_modulus: 1.3 MPa, \
poisson_ratio: 0.49}
boundary: {rim: clamped}
magnetic: {remanent: {flux_density: 60 mT}, applied: {flux_density: 10 mT}}
mesh: {degree: 2, refinement: 0.3}
loading: {kind: field, points: 1}
identify:
  remanence: {points: 2, length: 0.5, deviation: 0.05}
  noise: {w_pole: 1 um}
  narrow: remanence
  candidates: [{of: w_pole_mm, noise: 100 um}, {of: energy_mJ, noise: 0.001 uJ}]
  predict:
    turned:
      settings: [magnetic.applied.flux_density=-10 mT, magnetic.remanent.flux_density=-60 mT]
      of: ["w_pole_mm@end", "energy_mJ@end"]
      samples: 20
"""  # its meridian
FAR = ("value", "low", "high")


@pytest.mark.slow
def test_a_field_and_its_predictions(tmp_path: Path) -> None:
    """Bands of 20 runs of a reversed history, which changes nothing, are those of slopes; narrowed
    is the field.

    On 2 and 3 ranks all is the same, but for sums in another order.
    """
    case, data = tmp_path / "cap.yaml", tmp_path / "measured.csv"
    case.write_text(CASE)
    data.write_text("applied [mT],w_pole [um]\n10,-15\n")
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
    assert (best["parameter"], best["result"]) == ("remanence", "energy_mJ")
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
    """Values and deviations of the field, and all that is predicted with it."""
    field = content["remanence"]
    several = [*content["predicted"], *content["programmes"]["turned"]["numbers"].values()]
    of_field = [v for name in ("value", "deviation") for row in field[name] for v in row]
    return [*of_field, *(each[name] for each in several for name in FAR)]
