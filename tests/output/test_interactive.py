"""The part of a report to play with: read back as a browser would, it has the numbers of the
folder.
"""

import base64
import csv
import json
import re
import shutil
import webbrowser
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import magshell_fenicsx as ms
from magshell_fenicsx.case.planner import document_of
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.vtu import read_point
from magshell_fenicsx.output.pictures.colours import couple
from magshell_fenicsx.output.pictures.lines import (
    cubics,
    curve_coordinates,
    curve_steps,
    line_coordinates,
    load_axis,
)
from magshell_fenicsx.output.pictures.plot import plot
from magshell_fenicsx.output.report.interactive import chosen_frames, plotly, simplify
from magshell_fenicsx.output.report.report import open_in_browser, report_of, write_report
from magshell_fenicsx.output.store.run_identity import identity, refuse_other_case
from magshell_fenicsx.output.store.table import read_rows, write_csv

needs_plotly = pytest.mark.skipif(plotly() is None, reason="Plotly is not installed")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dimpled hemisphere in a field, up to its fold."""
    defect = {"kind": "dimple", "amplitude": 0.5, "width": 3.2}
    sections = {
        "shell": {
            "geometry": "hemisphere",
            "radius_to_thickness": 90,
            "poisson_ratio": 0.5,
            "defect": defect,
        },
        "boundary": {"equator": "clamped"},
        "magnetic": {"lambda_m": 1e-4, "remanent": {"polar": 0}, "applied": {"polar": 180}},
        "loading": {"kind": "pressure", "until": "limit"},
    }
    out = tmp_path_factory.mktemp("played")
    ms.run(ms.Case.from_source(sections), out, pictures=False)
    write_report(out)
    return out


def parts(folder: Path) -> dict[str, str]:
    """Id -> content of the page's scripts."""
    page = (folder / "report.html").read_text(encoding="utf-8")
    return dict(re.findall(r'<script type="[^"]*" id="(\w+)">(.*?)</script>', page, re.DOTALL))


def read(folder: Path) -> tuple[dict[str, Any], bytes]:
    found = parts(folder)
    return json.loads(found["about"]), zlib.decompress(base64.b64decode(found["shells"]))


def array(data: bytes, it: dict[str, Any]) -> np.ndarray:
    values = np.frombuffer(data, it["kind"], it["size"], it["at"])
    return it["low"] + it["step"] * values.reshape(-1, 3) if "step" in it else values


@needs_plotly
def test_numbers_are_those_of_the_path(folder: Path) -> None:
    """Every column to the last digit, every point; the slider's last shell is the last point."""
    about, _ = read(folder)
    with (folder / "path.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert {"p_over_pc", "volume_change", "w_pole_over_h", "lambda_m"} <= about["columns"].keys()
    for name, column in about["columns"].items():
        assert column["values"] == [float(row[name]) for row in rows], name
    assert about["labels"] == [row["label"] for row in rows]
    before, pressed = about["steps"]
    assert before["title"] == "field"
    assert pressed["axes"] == ["volume_change", "p_over_pc"]
    assert {name: about["columns"][name]["sign"] for name in pressed["axes"]} == {
        "volume_change": -1,
        "p_over_pc": 1,
    }
    assert about["columns"]["volume_change"]["label"] == "change of volume −ΔV/R³"
    assert sorted({*before["rows"], *pressed["rows"]}) == list(range(len(rows)))
    assert about["frames"][0] == 0
    assert about["frames"][-1] == len(rows) - 1


@needs_plotly
def test_curves_are_those_of_the_picture(folder: Path) -> None:
    """Between the points too, where the page has parameter and slopes of every column."""
    about, data = read(folder)
    rows, names = read_rows(folder / "path.csv"), list(about["columns"])
    step = about["steps"][-1]
    lines = line_coordinates(curve_steps(rows, "pressure")[-1])
    assert [line["pieces"] for line in step["lines"]] == [
        [list(piece) for piece in line.segments] for line in lines
    ]
    for found, line in zip(step["lines"], lines, strict=True):
        places = [curve_coordinates(row, "pressure") for row in line.rows]
        columns = [about["columns"][name] for name in step["axes"]]
        values = [c["sign"] * np.array(c["values"])[found["rows"]] for c in columns]
        of_columns = array(data, found["slopes"]).reshape(len(names), -1)
        slopes = [about["columns"][n]["sign"] * of_columns[names.index(n)] for n in step["axes"]]
        drawn = line.smooth_curve(*zip(*places, strict=True), load_axis=load_axis("pressure"))
        joined = cubics(np.array(found["parameter"]), np.array(values), np.array(slopes))
        assert (np.abs(joined - drawn) <= 1e-6 * np.ptp(drawn, axis=1)[:, None]).all()


@needs_plotly
def test_a_column_without_numbers(folder: Path, tmp_path: Path) -> None:
    """A solid's energy has no parts: nan, which JSON does not know and a browser refuses."""
    shutil.copytree(folder, tmp_path / "solid")
    file = tmp_path / "solid/path.csv"
    with file.open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    write_csv([row | {"stretching": "nan", "bending": "nan"} for row in rows], list(rows[0]), file)
    write_report(tmp_path / "solid")
    text = parts(tmp_path / "solid")["about"]
    assert "NaN" not in text
    assert {"stretching", "bending"}.isdisjoint(json.loads(text)["columns"])
    assert "stretching" in json.loads(parts(folder)["about"])["columns"]


@needs_plotly
def test_shells_are_those_of_the_fields(folder: Path) -> None:
    """Places to 1e-4 R, colours to a 256th of their range."""
    about, data = read(folder)
    surface, _ = read_point(folder / "fields", about["points"][about["frames"][-1]])
    mesh = simplify(surface, 20_000)
    r = array(data, about["r0"]) + array(data, about["u"][-1])
    assert r == pytest.approx(mesh.at_vertices(surface.r0 + surface.u), abs=1e-4)
    triangles = array(data, about["triangles"]).reshape(-1, 3)
    assert triangles.max() == mesh.count - 1
    a, b, c = (mesh.at_vertices(surface.r0)[triangles[:, k]] for k in range(3))
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a) >= 0).all()  # all outwards
    fields = {field["name"]: field for field in about["fields"]}
    assert {"w_over_h", "E_1", "E_2", "M_1", "M_2", "couple", "p_mag"} <= fields.keys()
    assert not {"gap_over_h", "contact_pressure"} & fields.keys()  # nothing touches
    expected = {"M_1": surface.fields["M_1"], "couple": np.linalg.norm(couple(surface), axis=1)}  # type: ignore[arg-type]
    for name, values in expected.items():
        field = fields[name]
        steps = array(data, field["at"][-1]) / 255
        reach = field["high"] - field["low"]
        assert field["low"] + reach * steps == pytest.approx(
            mesh.at_vertices(values), abs=reach / 500
        )
    M = fields["M_1"]
    zero = -M["low"] / (M["high"] - M["low"])
    _, colour = min(M["colours"], key=lambda stop: abs(stop[0] - zero))
    assert min(bytes.fromhex(colour[1:])) > 0.9 * 255  # as in the pictures, zero is white
    assert not fields["couple"]["colours"]  # a length has plotly's own


@pytest.mark.slow
@needs_plotly
def test_one_page_below_six_megabytes(folder: Path, tmp_path: Path) -> None:
    """Nothing is looked for elsewhere; large pictures are reduced to the page's width."""
    noise = (
        np.random.default_rng(0)
        .integers(0, 255, (60, 60, 3), np.uint8)
        .repeat(60, axis=0)
        .repeat(60, axis=1)
    )
    Image.fromarray(noise + np.random.default_rng(1).integers(0, 9, noise.shape, np.uint8)).save(
        folder / "shell.png"
    )
    assert (folder / "shell.png").stat().st_size > 6e6
    write_report(folder)
    assert (folder / "report.html").stat().st_size < 6e6
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert not re.search(r"<(script|img|link|iframe)[^>]*(src|href)=.(?!data:)", page)
    assert (
        "plotly.js v" in zlib.decompress(base64.b64decode(parts(folder)["library"])).decode()[:200]
    )
    (folder / "shell.png").unlink()


def test_frames_are_few_and_have_the_instabilities() -> None:
    rows: list[dict[str, Any]] = [
        {"point": i, "label": "fold" if i in (71, 72) else "step"} for i in range(300)
    ]
    chosen = [row["point"] for row in chosen_frames(rows, 24)]
    assert len(chosen) == 24
    assert {0, 71, 72, 299} <= set(chosen)
    assert chosen == sorted(chosen)


def test_large_meshes_are_thinned() -> None:
    """A flat grid of 40 000 vertices to at most 5000, with the same area up to its edge."""
    x, y = np.meshgrid(np.linspace(0, 1, 200), np.linspace(0, 1, 200))
    r = np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()])
    low = (np.arange(199)[:, None] * 200 + np.arange(199)).ravel()
    cells = np.concatenate(
        [
            np.column_stack([low, low + 1, low + 200]),
            np.column_stack([low + 1, low + 201, low + 200]),
        ]
    )
    mesh = simplify(Surface(r, 0 * r, r, cells, {}), 5000)
    a, b, c = np.moveaxis(mesh.at_vertices(r)[mesh.triangles], 1, 0)
    assert 2000 < mesh.count <= 5000
    assert np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2 == pytest.approx(1, rel=0.05)


def test_without_plotly(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The report is there, without that part."""
    monkeypatch.setattr("magshell_fenicsx.output.report.interactive.plotly", lambda: None)
    write_report(folder)
    assert "shell3d" not in parts(folder)
    assert "<h2>Path</h2>" in (folder / "report.html").read_text(encoding="utf-8")


def test_view(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The browser is asked for the file, which is made if it is not there."""
    (folder / "report.html").unlink(missing_ok=True)
    asked = list[str]()
    monkeypatch.setattr(webbrowser, "open", lambda url: bool(asked.append(url)) or len(asked) == 1)
    file = report_of(folder)
    assert open_in_browser(file)
    assert asked == [file.as_uri()]
    assert not open_in_browser(file)
    with pytest.raises(CaseError, match=r"holds no report\.html, and no summary\.json"):
        report_of(tmp_path)


def test_options_are_keys_of_the_case(folder: Path) -> None:
    """Wrong options are reported with their names, as wrong keys of a case are."""
    drawn = plot(folder, 1, options={"formats": ["pdf"], "width": 50.0, "dpi": 60})
    assert {"shell_0001.png", "shell_0001.pdf", "fields_0001.pdf"} <= set(drawn)
    with Image.open(folder / "shell_0001.png") as image:
        assert image.width == pytest.approx(50 / 25.4 * 60, abs=2)
    with pytest.raises(
        CaseError, match=r"--dpi: output\.dpi: 5: must be greater than or equal to 50"
    ):
        plot(folder, 1, options={"dpi": 5})
    with pytest.raises(CaseError, match=r"E_3: no field with colours; there are w_over_h"):
        plot(folder, 1, options={"ranges": {"E_3": [0.0, 1.0]}})


def test_pictures_are_no_part_of_what_is_resumed(tmp_path: Path) -> None:
    """A run goes on with other pictures; with another mesh it is another run."""
    shell = {"geometry": "strip", "radius_to_thickness": 50, "width": 0.2, "poisson_ratio": 0}
    plain: dict[str, Any] = {"shell": shell, "boundary": {"root": "clamped"}}
    first, other, finer = (
        document_of(ms.Case.from_source(plain | more))
        for more in ({}, {"output": {"dpi": 90}}, {"mesh": {"degree": 3}})
    )
    refuse_other_case(identity(first), other, tmp_path)
    with pytest.raises(CaseError, match="another run"):
        refuse_other_case(identity(first), finer, tmp_path)
