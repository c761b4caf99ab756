"""report.html: one file that says what stands in the folder of a run, whatever of it there is."""

import base64
import copy
import json
from html.parser import HTMLParser
from math import cos, pi, radians, sin
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from magshell_fenicsx.output.report.report import write_report
from magshell_fenicsx.output.report.verdict import path_table, verdict
from magshell_fenicsx.output.store.table import COLUMNS

SUMMARY: dict[str, Any] = {
    "case": {
        "model": "shell",
        "shell": {
            "geometry": "hemisphere",
            "radius": 0.0252,
            "thickness": 0.00028,
            "youngs_modulus": 1.8e6,
        },
        "loading": {"kind": "pressure", "control": "volume", "until": "limit"},
        "mesh": {"degree": 4, "refinement": 1.0},
    },
    "dimensionless": {
        "radius_to_thickness": 90.0,
        "poisson_ratio": 0.5,
        "lambda_m": 0.0,
        "Lambda_m": 0.0,
        "pc_over_E": 4 / 3 / 90**2,  # 2/sqrt(3 (1 - nu^2)) (h/R)^2 with nu = 1/2
    },
    "dimensions": {"radius": 0.0252, "thickness": 0.00028, "youngs_modulus": 1.8e6, "units": "SI"},
    "in_units": {"classical_pressure_Pa": 1.8e6 * 4 / 3 / 90**2},
    "model": {"included": ["meridian", "live pressure"], "left_out": ["force: none"]},
    "stopped": None,
    "sensitivities": {},
    "knockdown": 0.32623330500000004,
    "points": 3,
    "mesh": {"cells": 76, "dofs": 610, "degree": 4},
    "timing": dict.fromkeys(
        ("jit_s", "setup_s", "assembly_s", "factor_s", "output_s", "solve_s", "total_s"), 1.25
    ),
    "replayed": 0,
    "factorisations": 7,
    "iterations": 12,
    "ranks": 2,
    "blas": "openblas",
    "versions": {"magshell_fenicsx": "0.1.0", "dolfinx": "0.9.0"},
}
START = dict.fromkeys(COLUMNS, 0.0) | {"label": "start", "amplitude": "", "mode": "", "branch": 0}
FOLD = {
    "label": "fold",
    "amplitude": "pressure",
    "p_over_pc": 0.32623330500000004,
    "w_pole_over_h": 3.4,
}


class Page(HTMLParser):
    """Tags, text and the sources of images of a page."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.references: list[str | None] = []
        self.text = ""
        self.feed(content)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if tag == "img" and name == "src":
                self.sources.append(str(value))
            elif name in ("src", "href", "srcset", "action", "data"):
                self.references.append(value)

    def handle_data(self, data: str) -> None:
        self.text += data


def page(
    folder: Path,
    rows: list[dict[str, Any]],
    pictures: dict[str, bytes] | None = None,
    **changes: Any,
) -> Page:
    """The report of a folder with a start, so many more rows, and a summary with changes."""
    columns = dict.fromkeys((*COLUMNS, *(name for row in rows for name in row)))
    lines = [",".join(columns)]
    for number, row in enumerate([{}, *rows]):
        lines.append(
            ",".join(str((START | {"point": number} | row).get(name, 0.0)) for name in columns)
        )
    (folder / "path.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    summary = copy.deepcopy(SUMMARY) | {"points": len(rows) + 1} | changes
    (folder / "summary.json").write_text(json.dumps(summary), encoding="utf-8")
    for name, content in (pictures or {}).items():
        (folder / name).write_bytes(content)
    write_report(folder)
    return Page((folder / "report.html").read_text(encoding="utf-8"))


def test_one_file_with_every_picture_and_no_reference(tmp_path: Path) -> None:
    """Pictures are in it byte by byte, in the report's order. Nothing is looked for elsewhere."""
    names = [
        "curve.png",
        "shell.png",
        "animation.gif",
        "magnetic_loads.png",
        "instabilities.png",
        "modes_0003.png",
    ]
    pictures = {name: name.encode() for name in reversed(names)}
    found = page(tmp_path, [FOLD], pictures | {"a_user's own.png": b"no part of the run"})
    kinds = [f"data:image/{name[-3:]};base64," for name in names]
    assert [source.split(",")[0] + "," for source in found.sources] == kinds
    assert [base64.b64decode(source.split(",")[1]).decode() for source in found.sources] == names
    assert found.references == []
    assert not {"script", "link", "iframe", "object"} & set(found.tags)
    content = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "url(" not in content
    assert "@import" not in content


@pytest.mark.parametrize(("width", "across"), [(90, 0), (180, 2)])
def test_pictures_of_two_panels_are_across_the_page(
    width: int, across: int, tmp_path: Path
) -> None:
    """Beside each other their letters would be too small to read; of one panel each they are beside
    each other.
    """
    Image.new("RGB", (round(width / 25.4 * 50), 40)).save(tmp_path / "wide.png", dpi=(50, 50))
    curve = (tmp_path / "wide.png").read_bytes()
    (tmp_path / "wide.png").unlink()
    page(tmp_path, [FOLD], {"curve.png": curve, "shell.png": b"shell.png"})
    assert (tmp_path / "report.html").read_text(encoding="utf-8").count(
        '<figure class="across"'
    ) == across


def test_buckling_in_one_sentence_and_in_pascals(tmp_path: Path) -> None:
    """p_c = 1.8e6 * 4/3/90^2 = 296.296 Pa, k_d p_c = 96.6617 Pa."""
    text = page(tmp_path, [FOLD | {"pressure_Pa": 0.326233305 * 1.8e6 * 4 / 3 / 90**2}]).text
    assert (
        "The shell buckles at the knockdown factor kd = p/pc = 0.326233 (96.6617 Pa): a fold, "
        "w/h = 3.4 at the"
    ) in text
    assert "296.296Pa" in text.replace("\n", "")
    assert "326233305" not in text


def test_where_it_buckles(tmp_path: Path) -> None:
    """On a sphere in degrees, as imperfections are placed, elsewhere as a place; of a meridian not
    at all.
    """
    place = [0.0252 * sin(radians(50)) * f(radians(120)) for f in (cos, sin)] + [
        0.0252 * cos(radians(50))
    ]
    text = page(tmp_path, [FOLD], limit_points=[{"mode_at": place}]).text
    assert "w/h = 3.4 at the pole; its mode is largest at polar 50°, azimuth 120°." in text
    beside = page(
        tmp_path, [FOLD], limit_points=[{"mode_at": [0.0, 0.0252 * sin(radians(3)), 0.0252]}]
    ).text
    assert "its mode is largest near the pole." in beside
    case = SUMMARY["case"] | {"shell": {"geometry": "cylinder"}}
    text = page(tmp_path, [FOLD], limit_points=[{"mode_at": [0.0252, 0, -0.001]}], case=case).text
    assert "its mode is largest at (25.2, 0, -1) mm." in text
    assert "its mode" not in page(tmp_path, [FOLD], limit_points=[{}]).text


def test_body_that_does_not_touch(tmp_path: Path) -> None:
    """Else a force of zero at the target is a riddle."""
    row = {
        "label": "target",
        "amplitude": "approach",
        "approach_over_h": 2.0,
        "penetration_over_h": -3.5,
    }
    case = SUMMARY["case"] | {"loading": {"kind": "contact", "until": "target"}}
    text = page(tmp_path, [row], case=case, knockdown=None).text
    assert "The body has not touched the shell: there is a gap of 3.5 h." in text
    assert (
        "not touched"
        not in page(tmp_path, [row | {"penetration_over_h": 1e-4}], case=case, knockdown=None).text
    )


def test_force_at_the_target_in_newtons(tmp_path: Path) -> None:
    """2 pi D/R with D = 1.8e6 (2.8e-4)^3/9 = 4.3904e-6 N m is 1.094671e-3 N; times 27.532."""
    newtons = 27.532 * 2 * pi * 1.8e6 * 2.8e-4**3 / 9 / 0.0252
    rows = [
        {
            "label": "target",
            "amplitude": "force",
            "force": 27.532,
            "w_over_h": 20.0,
            "force_N": newtons,
        }
    ]
    case = SUMMARY["case"] | {"loading": {"kind": "indentation", "until": "target"}}
    text = page(tmp_path, rows, case=case, knockdown=None).text
    assert (
        "The run reached its target: F R/(2πD) = 27.532 (0.0301385 N), w/h = 20 at the load."
        in text
    )


def test_displacement_along_the_loads(tmp_path: Path) -> None:
    """Of moments alone, which have none, it is that of the pole."""
    lines = [
        START | {"amplitude": "load", "load_factor": 1.0, "w_over_h": 2.0, "w_pole_over_h": w}
        for w in (2.0, 1.0)
    ]
    told = [
        verdict(SUMMARY | {"case": {}}, [{key: str(v) for key, v in line.items()}])
        for line in lines
    ]
    assert told[0].endswith("load factor = 1, w/h = 2 at the pole.")
    assert told[1].endswith("load factor = 1, w/h = 2 along the loads.")


def test_critical_field_and_excluded_mode(tmp_path: Path) -> None:
    rows = [
        {"label": "bifurcation", "amplitude": "lambda_m", "lambda_m": -0.003355, "mode": "m = 7"}
    ]
    stop = "the field alone makes the shell unstable"
    found = page(tmp_path, rows, knockdown=None, stopped=stop)
    assert (
        "unstable at the critical λm = −0.003355: a bifurcation (m = 7 waves), w/h = 0 at the pole"
        in found.text
    )
    assert f"The run stopped early, after 2 points: {stop}." in found.text


def test_instabilities_of_the_last_step(tmp_path: Path) -> None:
    """A field that snaps a dome through, then back: the second step's are told too."""

    def row(label: str, lambda_m: float, step: int, mode: str = "") -> dict[str, Any]:
        """Return a point of a path in a field."""
        numbers = {"lambda_m": lambda_m, "step": step}
        return {"label": label, "amplitude": "lambda_m", "mode": mode, **numbers}

    back = [row("bifurcation", 0.02, 2, "m = 2"), row("fold", 0.03, 2)]
    found = page(tmp_path, [row("fold", -0.05, 1), *back], knockdown=None)
    assert "critical λm = −0.05: a fold" in found.text
    told = "a bifurcation (m = 2 waves) at λm = 0.02, a fold at λm = 0.03."
    assert f"Step 2, the last, has 2 instabilities: {told}" in found.text
    only = page(tmp_path, back, knockdown=None)
    assert "the last, has" not in only.text  # the first is told alone
    many = [row("fold", -0.05, 1), *(row("fold", 0.01 * i, 2) for i in range(1, 8))]
    text = page(tmp_path, many, knockdown=None).text
    assert "7 instabilities: a fold at λm = 0.01, a fold at λm = 0.02" in text
    assert "a fold at λm = 0.03, ..., a fold at λm = 0.07." in text


def test_interrupted_at_once_without_pictures(tmp_path: Path) -> None:
    """What stopped it is shown as text, whatever is in it."""
    found = page(tmp_path, [], stopped="<b>1 & 2</b>", knockdown=None)
    assert found.sources == []
    assert "after 1 point: <b>1 & 2</b>." in found.text


def test_path_has_the_columns_that_vary(tmp_path: Path) -> None:
    """Many points are folded away. A displacement that differs only by rounding stands once."""
    rows = [
        {
            "label": "step",
            "amplitude": "pressure",
            "p_over_pc": 0.01 * i,
            "w_over_h": 0.1 * i,
            "w_pole_over_h": 0.1 * i,
        }
        for i in range(1, 40)
    ]
    rows[3]["w_pole_over_h"] += 1e-15
    found = page(tmp_path, rows, knockdown=None)
    assert "details" in found.tags
    assert "All 40 points" in found.text
    heads = found.text[found.text.index("All 40 points") :].split("\n")[:4]
    assert "pointwhatvariedp/pcw/h" in "".join(heads).replace(" ", "")
    assert "details" not in page(tmp_path, rows[:5]).tags


def test_columns_name_the_point() -> None:
    """Whose displacement w_pole_over_h is: that of the first named point, whatever is in its name;
    else the pole's.
    """
    fixed = {name: str(value) for name, value in START.items()}
    rows = [fixed | {"w_over_h": str(i), "w_pole_over_h": str(i**2)} for i in range(3)]
    assert "w/h, pole" in [column.head for column in path_table(rows, "")]
    assert "w/h, A&lt;b&gt;" in [
        column.head for column in path_table([row | {"A<b>_ux": "0"} for row in rows], "")
    ]


def test_error_estimate_or_how_to_get_one(tmp_path: Path) -> None:
    tried = {
        "degree": 4,
        "refinement": 0.5,
        "cells": 40,
        "dofs": 330,
        "result": 0.32626,
        "estimate": 8e-5,
    }
    taken = {
        "degree": 4,
        "refinement": 1.0,
        "cells": 76,
        "dofs": 610,
        "result": 0.326233,
        "estimate": 1.234e-6,
    }
    tolerance = {"tolerance": 1e-5, "error_estimate": 1.234e-6, "rounds": [tried, taken]}
    sensitivities = {"lambda_m": 126.12}
    found = page(tmp_path, [FOLD], tolerance=tolerance, sensitivities=sensitivities)
    assert (
        "Estimated relative error of the discretisation: 1.2 · 10−6; asked for: below\n10−5"
        in found.text
    )
    assert 'class="taken"' in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "derivative of p/pc" in found.text
    assert "126.12" in found.text
    ended_elsewhere = page(tmp_path, [FOLD], tolerance=tolerance | {"error_estimate": None}).text
    assert "There is no estimate" in ended_elsewhere
    assert (
        "no error estimate. For one: give the case mesh: {tolerance: 1e-3}"
        in page(tmp_path, [FOLD]).text
    )
    tube = SUMMARY["case"] | {"shell": {"geometry": "cylinder"}}
    assert "mesh.tolerance is not offered" not in page(tmp_path, [FOLD], case=tube).text
    estimated = {"knockdown": 1.5e-4, "w_over_h@end": 2e-3}
    reasons = {"limit_load_2": "it would take long"}
    text = page(tmp_path, [FOLD], errors=estimated, errors_not_estimated=reasons).text
    assert "no error estimate" not in text
    assert "w_over_h@end0.002" in text
    assert "Without an estimate: limit_load_2 (it would take long)" in text


def test_estimate_names_the_result_at_a_target(tmp_path: Path) -> None:
    """A run beyond its fold: the estimate is not that of k_d, which stands before it."""
    target = {"label": "target", "amplitude": "pressure", "p_over_pc": 0.1, "w_pole_over_h": 9.0}
    loading = {"kind": "pressure", "until": "target"}
    case = SUMMARY["case"] | {"loading": loading}
    tried = {"degree": 4, "refinement": 1.0, "cells": 76, "dofs": 610, "estimate": 2e-5}
    sentence = "The estimated relative error of {} is 2 · 10−5."
    named = {
        0.1: "the pressure at the end",
        7.5: "the displacement conjugate to the pressure at the end",
    }
    for result, words in named.items():
        known = {"tolerance": 1e-4, "error_estimate": 2e-5, "rounds": [tried | {"result": result}]}
        text = page(tmp_path, [FOLD, target], case=case, tolerance=known).text
        assert sentence.format(words) in text


def test_a_flat_shell_has_no_classical_pressure(tmp_path: Path) -> None:
    """It is said of a pressure in pascals alone, and nowhere without a pressure; a time in seconds
    is said once.
    """
    case = SUMMARY["case"] | {
        "shell": {"geometry": "strip"},
        "loading": {"kind": "pressure", "until": "target"},
    }
    row = {"label": "target", "amplitude": "pressure", "p_over_pc": 0.5, "pressure_Pa": 10.0}
    assert "target: p = 10 Pa," in page(tmp_path, [row], case=case, knockdown=None).text
    moved = {"label": "target", "amplitude": "time", "time": 2.5, "time_s": 2.5}
    found = page(tmp_path, [moved], case=case, knockdown=None).text
    assert "target: t = 2.5 s," in found
    assert "pc" not in found[: found.index("Path")]


def test_units_of_ones_own(tmp_path: Path) -> None:
    """Nobody knows what an amount of them is in pascals."""
    found = page(
        tmp_path,
        [FOLD],
        dimensions=SUMMARY["dimensions"] | {"units": "the case's own"},
        in_units={},
    )
    assert "in the case's own units" in found.text
    assert "Pa" not in found.text[: found.text.index("Path")]


@pytest.mark.parametrize("missing", ["summary.json", "path.csv"])
def test_nothing_to_report(tmp_path: Path, missing: str) -> None:
    """The report that is there stays as it is."""
    page(tmp_path, [FOLD])
    before = (tmp_path / "report.html").read_bytes()
    (tmp_path / missing).unlink()
    with pytest.raises(FileNotFoundError, match=missing):
        write_report(tmp_path)
    assert (tmp_path / "report.html").read_bytes() == before
