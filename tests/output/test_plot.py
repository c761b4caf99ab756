"""`magshell plot`: the pictures of a folder again, from the folder alone, and the moving one."""

import io
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import pyvista
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

import magshell_fenicsx as ms
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.pictures.curve import curve_figure, drawn_panels, worth_drawing
from magshell_fenicsx.output.pictures.curve_additions import (
    _cropped,
    _free_corner,
    add_shapes,
    runs_figure,
)
from magshell_fenicsx.output.pictures.lines import curve_steps
from magshell_fenicsx.output.pictures.picture import PICTURES
from magshell_fenicsx.output.pictures.plot import (
    PicturedRun,
    draw,
    draw_animation,
    in_true_time,
    plot,
    plot_runs,
)
from magshell_fenicsx.output.pictures.readings import readings_figure
from magshell_fenicsx.output.store.table import read_rows
from magshell_fenicsx.problem.requests import OutputSection


def test_a_picture_without_its_margins() -> None:
    image = np.zeros((10, 12, 4))
    image[3:6, 2:9, 3] = 255  # drawn: rows 3 to 5, columns 2 to 8
    assert _cropped(image)[..., 3] == pytest.approx(np.full((3, 7), 255))


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dimpled hemisphere in a field, up to its fold: meridian, seconds."""
    defect = {"kind": "dimple", "amplitude": 0.5, "width": 3.2}
    sections = {
        "shell": {
            "geometry": "hemisphere",
            "radius_to_thickness": 90,
            "poisson_ratio": 0.5,
            "defect": defect,
        },
        "boundary": {"equator": "clamped"},
        "magnetic": {"lambda_m": 1e-4},
        "loading": {"kind": "pressure", "until": "limit"},
    }
    out = tmp_path_factory.mktemp("run")
    ms.run(ms.Case.from_source(sections), out)
    return out


def copied(run: Path, to: Path, *without: str) -> Path:
    return Path(shutil.copytree(run, to / "copy", ignore=shutil.ignore_patterns(*without)))


def pixels(file: Path) -> np.ndarray:
    return np.asarray(Image.open(file).convert("RGB"), dtype=int)


@pytest.mark.slow
@pytest.mark.telling
def test_pictures_of_a_run_are_those_of_its_folder(run: Path, tmp_path: Path) -> None:
    """Without summary, as a killed run is: the same files with the same pixels."""
    there = {file.name for file in run.glob("*.png")}
    wanted = {
        "shell.png",
        "curve.png",
        "magnetic_loads.png",
        "strains.png",
        "moments.png",
        "fields.png",
    }
    assert there == wanted | {"instabilities.png"}
    again = copied(run, tmp_path, "*.png", "summary.json")
    assert set(draw(again)) == there
    for name in there:
        assert (pixels(again / name) == pixels(run / name)).all(), name


def test_whole_shells_of_a_half(tmp_path: Path) -> None:
    """The key writes them beside the half in a run, and the area of the disc is pi."""
    sections = {
        "shell": {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": 0.3},
        "boundary": {"rim": "clamped"},
        "symmetry": "half",
        "loading": {
            "kind": "pressure",
            "control": "load",
            "until": "target",
            "pressure": 1e-4,
            "points": 1,
        },
        "mesh": {"degree": 2, "refinement": 0.3},
        "output": {"whole": True},
    }
    ms.run(ms.Case.from_source(sections), tmp_path)
    half, whole = (
        pyvista.get_reader(tmp_path / f"fields/{name}.pvd") for name in ("path", "whole")
    )
    assert half.time_values == whole.time_values == [0.0, 1e-4]
    for reader, share in ((half, 0.5), (whole, 1.0)):
        reader.set_active_time_value(1e-4)
        shell = reader.read()[0].warp_by_vector("u").extract_surface(nonlinear_subdivision=3)
        assert shell.area == pytest.approx(share * np.pi, rel=5e-3)
    assert "fields/whole_0001.vtu" in (tmp_path / "written.txt").read_text()


def test_a_torn_row_is_no_point(run: Path, tmp_path: Path) -> None:
    again = copied(run, tmp_path, "*.png")
    text = (again / "path.csv").read_text()
    (again / "path.csv").write_text(text[: text.rstrip().rfind("\n") + 20])
    assert len(read_rows(again / "path.csv")) == len(read_rows(run / "path.csv")) - 1
    assert "shell.png" in draw(again)


@pytest.mark.slow
def test_another_point(run: Path, tmp_path: Path) -> None:
    """The last one has the pixels of the run's own pictures, and the first has others."""
    again, last = copied(run, tmp_path, "*.png"), len(read_rows(run / "path.csv")) - 1
    for point in (1, last):
        names = {name for name in PICTURES if name not in ("contact", "stretches")}
        assert set(draw(again, point)) == {f"{name}_{point:04d}.png" for name in names}
    for name in names:
        whole = pixels(run / f"{name}.png")
        np.testing.assert_array_equal(pixels(again / f"{name}_{last:04d}.png"), whole, name)
        assert not np.array_equal(pixels(again / f"{name}_0001.png"), whole), name
    with pytest.raises(CaseError, match=r"--point 99: .* has points 0 to"):
        draw(again, 99)


def test_a_turning_field(tmp_path: Path) -> None:
    """Its amplitudes are NumPy's numbers, whose repr no reader of path.csv understands."""
    sections = {
        "shell": {
            "geometry": "strip",
            "radius_to_thickness": 100,
            "width": 0.1,
            "poisson_ratio": 0,
        },
        "boundary": {"root": "clamped"},
        "magnetic": {"lambda_m": 3.3e-6, "remanent": {"polar": 90}, "applied": {"polar": 90}},
        "loading": {"kind": "rotation", "to": {"polar": 0}, "points": 1},
        "mesh": {"degree": 2, "refinement": 0.5},
    }
    ms.run(ms.Case.from_source(sections), tmp_path)
    last = read_rows(tmp_path / "path.csv")[-1]
    assert last["field_angle"] == pytest.approx(90)
    assert isinstance(last["energy"], float)
    assert (tmp_path / "curve.png").exists()


@pytest.mark.parametrize("name", ["", "absent", "case.yaml"])
def test_nothing_there(tmp_path: Path, name: str) -> None:
    """An empty folder, none, or a file in its place: one line."""
    (tmp_path / "case.yaml").touch()
    with pytest.raises(CaseError, match=rf"{tmp_path / name} holds no run: it has no path\.csv"):
        plot(tmp_path / name)


def test_frames_at_equal_times() -> None:
    """Two steps in time, the second with rows ten times as close: as many frames to each unit of
    time.
    """
    times = [*range(1, 11), *(10 + 0.1 * i for i in range(1, 101))]
    rows = [
        {"amplitude": "pressure", "time": 0.0},
        *({"amplitude": "time", "time": t} for t in times),
    ]
    chosen = [row["time"] for row in in_true_time(rows)]
    assert len(chosen) == 40
    assert np.diff(chosen) == pytest.approx(np.full(39, 19 / 39), abs=1.0)
    assert sum(t < 10.5 for t in chosen) == pytest.approx(20, abs=1)
    assert len(in_true_time(rows[:11])) == 10


@pytest.mark.slow
def test_animation(run: Path, tmp_path: Path) -> None:
    """A frame for every point of the pressure's path; what does not move has the same pixels in
    all.
    """
    again = copied(run, tmp_path)
    assert draw_animation(again) == "animation.gif"
    content = (again / "animation.gif").read_bytes()
    rows = [row for row in read_rows(again / "path.csv") if row["amplitude"] == "pressure"]
    with Image.open(io.BytesIO(content)) as moving:
        frames = []
        for i in range(moving.n_frames):  # type: ignore[attr-defined]
            moving.seek(i)
            frames.append(np.asarray(moving.convert("RGB"), dtype=int))
    assert len(content) < 3e6
    assert all((frame[:5] == 255).all() for frame in frames)  # white paper, not a colour near it
    assert len(rows) <= len(frames) <= len(rows) + 1
    changes = np.array([np.abs(frame - frames[0]).max(axis=2) for frame in frames])
    foot = changes[:, -20:]
    assert (foot == 0).all()
    assert (changes[-1] > 40).any()


def test_runs_in_one_picture(run: Path, tmp_path: Path) -> None:
    """The labels say in what the cases differ; marks and lines of each; curves over other
    quantities are refused.
    """
    again = copied(run, tmp_path)
    summary = again / "summary.json"
    summary.write_text(summary.read_text().replace('"lambda_m": 0.0001', '"lambda_m": 0.0002'))
    rows = {folder: read_rows(folder / "path.csv") for folder in (run, again)}
    (axes,) = runs_figure(rows, OutputSection()).axes
    assert [line.get_label() for line in axes.lines if "lambda" in str(line.get_label())] == [
        r"$\lambda_\mathrm{m}$ = 0.0001",
        r"$\lambda_\mathrm{m}$ = 0.0002",
    ]
    assert plot_runs([run, again], tmp_path / "both.png", {"formats": ["pdf"]}) == [
        str(tmp_path / "both.png"),
        str(tmp_path / "both.pdf"),
    ]
    other = [{**row, "amplitude": row["amplitude"] and "force"} for row in rows[run]]
    said = r"copy: its curve is force over w_over_h, that of .* p_over_pc over volume_change: draw"
    with pytest.raises(CaseError, match=said):
        runs_figure({run: rows[run], again: other}, OutputSection())


def test_what_sensors_read_is_a_curve(run: Path) -> None:
    """In mT over the load, through the values of path.csv in T; a component that is zero has no
    line.
    """
    rows = read_rows(run / "path.csv")
    read = [
        row | {"hall_Bx": 1e-12, "hall_By": -2e-3, "hall_Bz": 1e-3 * float(row["p_over_pc"])}
        for row in rows
    ]
    case = {"sensors": {"hall": {}}, "magnetic": {"remanent": {"flux_density": 0.08}}}
    (axes,) = readings_figure(read, "pressure", case, OutputSection()).axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == (
        r"pressure  $p/p_\mathrm{c}$",
        "field at hall  (mT)",
    )
    assert axes.get_legend_handles_labels()[1] == ["fold", "$B_y$", "$B_z$"]
    last = [
        line.get_xydata()[-1]
        for line in axes.lines
        if line.get_linestyle() == "-" and len(line.get_xydata()) > 2
    ]
    load = float(rows[-1]["p_over_pc"])
    assert np.array(last) == pytest.approx(np.array([[load, -2.0], [load, load]]))


def test_a_displacement_by_rounding_is_no_curve(run: Path) -> None:
    """A step in which nothing moves, and one in which it does a little, before the path."""
    (path,) = worth_drawing(curve_steps(read_rows(run / "path.csv"), "pressure"))
    still, little = (
        replace(
            path, rows=[{**row, "volume_change": size * i**2} for i, row in enumerate(path.rows)]
        )
        for size in (1e-17, 1e-9)
    )
    assert [part.rows[-1] for part in worth_drawing([still, little, path])] == [
        little.rows[-1],
        path.rows[-1],
    ]


def test_shells_on_a_curve(run: Path, tmp_path: Path) -> None:
    """Each beside its point, within the axes, and not on each other."""
    again = copied(run, tmp_path, "*.png")
    last = len(read_rows(again / "path.csv")) - 1
    drawn = PicturedRun(again)
    figure = curve_figure(drawn.rows, "pressure", drawn.style)
    panels = drawn_panels(drawn.rows, "pressure")
    shown = [(drawn.rows[i], drawn.surface_at(drawn.rows[i])[0]) for i in (2, last)]
    add_shapes(figure, panels, shown, 0.01, drawn.camera)
    figure.draw_without_rendering()
    boxes = [each.offsetbox.get_window_extent() for each in figure.axes[0].artists]
    assert len(boxes) == 2
    assert not boxes[0].overlaps(boxes[1])
    frame = figure.axes[0].get_window_extent()
    assert all(frame.contains(*corner) for box in boxes for corner in box.corners())
    assert "curve.png" in draw(again, shapes=[2, last])
    with pytest.raises(CaseError, match=f"--shapes 999: .* has points 0 to {last}"):
        draw(again, shapes=[999])


@pytest.mark.parametrize("size", [(0.26, 0.1), (0.1, 0.34)])
def test_a_shell_beside_a_curve_covers_nothing(size: tuple[float, float]) -> None:
    """Wide or tall, five of them at points of a wave: within the axes, beside the curve and beside
    each other.
    """
    figure = Figure()
    axes = figure.add_axes((0.1, 0.1, 0.8, 0.8))
    x = np.linspace(0, 1, 400)
    y = np.sin(2 * np.pi * x)
    axes.plot(x, y)
    figure.draw_without_rendering()
    curve = axes.transAxes.inverted().transform(axes.transData.transform(np.column_stack([x, y])))
    boxes = list[NDArray[np.float64]]()
    for i in (0, 100, 200, 300, 399):
        low = _free_corner(axes, np.array([x[i], y[i]]), np.array(size), boxes)
        boxes.append(np.array([low, low + size]))
    for i, (low, high) in enumerate(boxes):
        assert (low >= 0).all()
        assert (high <= 1).all()
        assert not ((curve > low) & (curve < high)).all(axis=1).any()
        for one, two in boxes[:i]:
            assert (np.minimum(high, two) <= np.maximum(low, one)).any()
