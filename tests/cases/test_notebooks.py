"""The examples in cases/notebooks run as scripts: one number of each, and its comparison."""

import io
import re
import runpy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import CASES
from matplotlib.image import imread

NOTEBOOKS = CASES / "notebooks"


@cache
def namespace(name: str) -> dict[str, Any]:
    return runpy.run_path(str(NOTEBOOKS / f"{name}.py"))


def test_all_are_here() -> None:
    assert {file.stem for file in NOTEBOOKS.glob("*.py")} == {
        "buckling",
        "foundation",
        "indentation",
    }


def test_buckling_in_a_field() -> None:
    """Knockdown: axisymmetric reference, nine digits. The slopes in the patches add up."""
    found = namespace("buckling")
    assert found["knockdown"] == pytest.approx(0.552053778, rel=1e-6)
    patches = [found["sensitivities"][f"remanence {patch}"] for patch in ("dimple", "rest")]
    assert sum(patches) == pytest.approx(0.00184 * found["sensitivities"]["lambda_m"], rel=1e-8)


def test_slope_on_a_foundation() -> None:
    """From the fold against a difference of fourth order."""
    found = namespace("foundation")
    assert found["slope"] == pytest.approx(found["difference"], rel=1e-7)


def test_least_foundation() -> None:
    """A fold in the stiffness is one in the pressure too: found by both, it is the same point."""
    found = namespace("foundation")
    assert found["critical"] < 0.012
    p = found["ms"].fold_at(found["scene"], found["buckling"](found["critical"])[-1]).value
    assert p == pytest.approx(found["P"], rel=1e-8)


def test_indentation() -> None:
    """Force at w/h = 1.5 and 6: axisymmetric reference, five digits. What is drawn is the shell."""
    found = namespace("indentation")
    assert found["force"][[0, -1]] == pytest.approx([2.9616, 5.6202], rel=5e-5)
    assert found["shell"].w.max() / found["scene"].problem.material.h == pytest.approx(6, rel=1e-6)
    image = imread(io.BytesIO(found["picture"]._repr_png_()))  # what a notebook asks for
    assert np.ptp(image[..., :3], axis=2).max() > 0.4, "no colours"


def coarse_arch(folder: Path) -> None:
    """All of cases/, but of the arch that is identified each fourth datum, on a coarse mesh."""
    (folder / "cases").mkdir()
    for each in CASES.iterdir():
        (folder / "cases" / each.name).symlink_to(each)
    case, data = (folder / "cases" / f"identify_arch.{ending}" for ending in ("yaml", "csv"))
    written, (head, *lines) = (
        case.read_text(encoding="utf-8"),
        data.read_text(encoding="utf-8").splitlines(),
    )
    coarse = written.partition("  candidates:")[0].replace("size: 10 mm", "size: 20 mm, degree: 3")
    assert coarse.count("degree: 3") == 1
    for file, text in ((case, coarse), (data, "\n".join([head, *lines[::4]]))):
        file.unlink()
        file.write_text(text, encoding="utf-8")


@pytest.mark.slow
def test_python_of_the_pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Their Python, block after block, as a reader would type it; knockdown: axisymmetric
    reference.

    The arch that is identified is coarse and has fewer data (its numbers: test_identify_case.py);
    the program without a case has a test of its own (test_without_a_case.py).
    """
    coarse_arch(tmp_path)
    monkeypatch.chdir(tmp_path)
    text = "".join(
        (CASES.parent / page).read_text(encoding="utf-8")
        for page in ("docs/api.md", "docs/howto.md")
    )
    found: dict[str, Any] = {}
    for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL):
        if not block.startswith("import gmsh\n"):
            exec(block, found)
    assert found["table"]["p_over_pc"][-1] == pytest.approx(0.552053778, rel=1e-6)
    assert found["end"].point.state.mu["pressure"] > 0.552 + 0.02
    assert (tmp_path / "results/mine/curve.png").exists()
