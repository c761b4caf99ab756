"""Reports in a real browser: headless Chromium opens them as a reader would, on a screen and on a
phone.
"""

import csv
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import PROGRAM, Page, browser
from many import design
from test_interactive import array, read

import magshell_fenicsx as ms
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.output.pictures.curve import INSET_MARGIN
from magshell_fenicsx.output.pictures.lines import cubics
from magshell_fenicsx.output.report.interactive import plotly
from magshell_fenicsx.output.report.report import write_report

pytestmark = [
    pytest.mark.skipif(PROGRAM is None, reason="Chromium is not installed"),
    pytest.mark.skipif(plotly() is None, reason="Plotly is not installed"),
]
SPHERE = {
    "shell": {"geometry": "hemisphere", "radius_to_thickness": 50, "poisson_ratio": 0.3},
    "boundary": {"equator": "clamped"},
    "mesh": {"degree": 2, "refinement": 0.5},
}
STRIP = {
    "shell": {"geometry": "strip", "radius_to_thickness": 50, "width": 0.2, "poisson_ratio": 0.0},
    "boundary": {"root": "clamped"},
    "mesh": {"degree": 3, "size": 0.5},
}
IN_UNITS = {
    "geometry": "strip",
    "radius": "30 mm",
    "width": 0.2,
    "thickness": "0.5 mm",
    "poisson_ratio": 0.0,
}
MAGNET = {"kind": "cylinder", "diameter": "20 mm", "height": "10 mm", "polarization": "1.3 T"}
CASES: dict[str, dict[str, Any]] = {
    "indentation": {
        **SPHERE,
        "loading": {"kind": "indentation", "at": {"polar": 0}, "depth": 3, "points": 3},
    },
    "body": {
        **SPHERE,
        "bodies": {"plate": {"kind": "plane"}},
        "loading": {"kind": "contact", "approach": 1, "points": 2},
    },
    "magnet": {
        **STRIP,
        "shell": {**IN_UNITS, "youngs_modulus": "1 MPa"},
        "magnetic": {
            "remanent": {"polar": 90, "flux_density": "3 mT"},
            "applied": {
                "sources": [{**MAGNET, "axis": {"polar": -90}, "position": ["55 mm", 0, "-30 mm"]}]
            },
        },
        "loading": [
            {"kind": "field", "points": 1},
            {"kind": "source", "move": [0, 0, "12 mm"], "points": 2},
        ],
    },
    "time": {
        **STRIP,
        "loading": [
            {
                "kind": "time",
                "duration": 1000.0,
                "points": 12,
                "push": {"mode": 1, "displacement": 0.5},
            },
        ],
    },
}
DESIGN = """
shell: {geometry: strip, radius_to_thickness: 50, width: 0.2, poisson_ratio: 0}
boundary: {root: clamped}
points: {tip: [1, 0, 0]}
magnetic: {lambda_m: 1.0e-4, remanent: {polar: 90}, applied: {polar: 0}}
mesh: {degree: 2}
symmetry: none
design: {objective: {maximise: tip_uz}, remanence: {points: 2}, iterations: 1}
"""
KINDS = (*CASES, "design")
SCENE = "document.getElementById('shell3d')._fullLayout.scene"
DRAWN = "document.getElementById('shell3d')._fullData"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    with browser(tmp_path_factory.mktemp("browser")) as running:
        yield running.page()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Makes, once each, the report of a kind of run."""
    made: dict[str, Path] = {}

    def make(kind: str) -> Path:
        if kind not in made:
            out = tmp_path_factory.mktemp(kind)
            if kind == "design":
                (out / "strip.yaml").write_text(DESIGN)
                design(out / "strip.yaml", out=out / "design")
                out = out / "design/verified"
            else:
                ms.run(ms.Case.from_source(Source(kind, CASES[kind])), out, pictures=kind == "body")
            write_report(out)
            made[kind] = out / "report.html"
        return made[kind]

    return make


PANES = (
    "['shell3d', 'curve2d'].map(n => document.getElementById(n).getBoundingClientRect().toJSON())"
)


@pytest.mark.parametrize(
    "kind", ["magnet", *(pytest.param(k, marks=pytest.mark.slow) for k in KINDS if k != "magnet")]
)
def test_a_report_is_whole_on_a_screen_and_on_a_phone(kind: str, page: Page, report: Any) -> None:
    """No error, nothing wider than the window; the shell in its true proportions, neither tiny nor
    cut off.
    """
    page.open(report(kind), 1200)
    page.wait("document.body.dataset.ready === 'yes'")
    assert page.value("document.documentElement.scrollWidth") <= 1200
    left, right = page.value(PANES)
    assert min(left["width"], right["width"]) >= 420
    assert left["right"] <= right["left"]
    proportions_are_true(page)
    page.resize(400)
    page.wait(
        "['shell3d', 'curve2d'].every(n => document.getElementById(n)._fullLayout.width <= 400)"
    )
    assert page.value("document.documentElement.scrollWidth") <= 400
    above, below = page.value(PANES)
    assert min(above["width"], below["width"]) >= 320
    assert above["bottom"] <= below["top"]
    proportions_are_true(page)
    assert page.errors == []


def proportions_are_true(page: Page) -> None:
    """The ranges of the axes are finite, have one scale, and hold all that is drawn without much
    around it.
    """
    ranges = np.array(page.value(f"['x', 'y', 'z'].map(c => {SCENE}[c + 'axis'].range)"), float)
    ratio = np.array(page.value(f"['x', 'y', 'z'].map(c => {SCENE}.aspectratio[c])"), float)
    assert np.isfinite(ranges).all()
    assert page.value(f"{SCENE}.aspectmode") == "manual"
    sizes = np.ptp(ranges, axis=1)
    assert ratio / ratio.max() == pytest.approx(
        sizes / sizes.max(), rel=1e-6
    )  # a sphere is a sphere
    traces = f"{DRAWN}.slice(0, -1).flatMap(t => [...t[c]].filter(v => v !== null))"
    places = page.value(
        f"['x', 'y', 'z'].map(c => {{const v = {traces}; "
        "return [Math.min(...v), Math.max(...v)];})"
    )
    drawn = np.array(places)
    assert (drawn[:, 0] >= ranges[:, 0]).all()
    assert (drawn[:, 1] <= ranges[:, 1]).all()
    assert np.ptp(drawn, axis=1).max() > 0.35 * sizes.max()


@pytest.mark.parametrize("kind", ["time", "magnet"])
def test_the_curve_is_that_of_the_picture(kind: str, page: Page, report: Any) -> None:
    """Between the points too: the page's cubics against those of curve.png, in every column."""
    page.open(report(kind), 800)
    page.wait("document.body.dataset.ready === 'yes'")
    about, data = read(report(kind).parent)
    columns = about["columns"]
    for s, step in enumerate(about["steps"]):
        for n, line in enumerate(step["lines"]):
            found = page.value(
                "Object.keys(magshell.about.columns).map("
                f"name => magshell.joined(magshell.about.steps[{s}].lines[{n}], name))"
            )
            values = [np.array(column["values"])[line["rows"]] for column in columns.values()]
            slopes = array(data, line["slopes"]).reshape(len(columns), -1)
            signs = np.array([column["sign"] for column in columns.values()])[:, None]
            drawn = cubics(np.array(line["parameter"]), np.array(values), slopes)
            assert np.array(found) == pytest.approx(signs * drawn, rel=1e-12, abs=1e-12)
            assert set(step["axes"]) <= columns.keys()


def test_steps_are_lines_of_their_own(page: Page, report: Any) -> None:
    """The field is not joined to the way of the magnet; labels have the units of the case; a click
    moves the slider.
    """
    page.open(report("magnet"), 1200)
    page.wait("document.body.dataset.ready === 'yes'")
    about = page.value("magshell.about")
    first, second = about["steps"]
    last = first["rows"][-1]  # where the field has reached its value, after one step or more
    assert first["rows"] == list(range(last + 1))
    assert second["rows"] == list(range(last, len(about["points"])))
    assert about["columns"]["source_force_N"]["label"] == "force on the source (N)"
    assert about["columns"]["w_pole_mm"]["label"] == "displacement of the tip w (mm)"
    assert page.value("document.getElementById('step').value") == "1"
    page.value("const s = document.getElementById('slider'); s.value = 0; s.oninput({target: s})")
    assert page.value("document.getElementById('step').value") == "0"


@pytest.mark.slow
def test_an_unstable_part_that_its_marks_hide_is_drawn_again(
    page: Page, report: Any, tmp_path: Path
) -> None:
    """Folds 1 % of the curve apart have an inset, as in curve.png. Folds far apart have none."""
    for gap, drawn in ((0.01, True), (0.5, False)):
        folder = tmp_path / f"{gap}"
        shutil.copytree(report("time").parent, folder)
        with (folder / "path.csv").open() as file:
            rows = list(csv.DictReader(file))
        middle, load = len(rows) // 2, lambda w: 1 - np.exp(-w)
        for i, row in enumerate(rows):
            x = 1.0 * i if i < middle else (1 - gap) * (middle - 1) if i == middle else i + 1.0
            located = i in (middle - 1, middle)
            row |= {
                "amplitude": "force" if i else "",
                "label": "fold" if located else "step" if i else "start",
            }
            row |= {
                "w_over_h": f"{x}",
                "w_pole_over_h": f"{x}",
                "force": f"{load(x)}",
                "negative_pivots": "0",
                "step": "1",
            }
        with (folder / "path.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0].keys())
            writer.writeheader()
            writer.writerows(rows)
        write_report(folder)
        page.open(folder / "report.html", 1200)
        page.wait("document.body.dataset.ready === 'yes'")
        ranges = page.value(
            "['x', 'y'].map(c => "
            "document.getElementById('curve2d')._fullLayout[`${c}axis2`]?.range)"
        )
        if drawn:
            low, high = np.array([[w, load(w)] for w in ((1 - gap) * (middle - 1), middle - 1)])
            around = np.array(
                [low - INSET_MARGIN * (high - low), high + INSET_MARGIN * (high - low)]
            )
            assert np.array(ranges) == pytest.approx(around.T)
            boxes = (
                "['shell3d', 'curve2d'].map(n => "
                "document.getElementById(n).getBoundingClientRect().right)"
            )
            assert max(page.value(boxes)) <= 1200
        else:
            assert ranges == [None, None]
        assert page.errors == []
