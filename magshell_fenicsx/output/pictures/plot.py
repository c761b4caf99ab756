"""The pictures of a run, drawn from the files of its folder: path.csv and fields/*.vtu."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.grids import read_map
from magshell_fenicsx.output.fields.modes import gradient_files, read_frequencies
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.vtu import (
    About,
    grid_file,
    point_file,
    read_point,
    read_vtu,
    write_whole_shells,
)
from magshell_fenicsx.output.pictures.animation import animated
from magshell_fenicsx.output.pictures.captions import caption
from magshell_fenicsx.output.pictures.curve import curve_figure, frequencies_figure, worth_drawing
from magshell_fenicsx.output.pictures.field_maps import field_maps_figure
from magshell_fenicsx.output.pictures.layout import drawing, written
from magshell_fenicsx.output.pictures.lines import drawn_parts
from magshell_fenicsx.output.pictures.modes import (
    gradients_figure,
    mode_figures,
    searched,
    solutions_figure,
)
from magshell_fenicsx.output.pictures.picture import figures
from magshell_fenicsx.output.pictures.readings import readings_figure
from magshell_fenicsx.output.pictures.several import add_shapes, runs_figure
from magshell_fenicsx.output.pictures.view import Camera, run_camera
from magshell_fenicsx.output.report.report import write_report
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.known import case_in, headline, pole_of, style_of
from magshell_fenicsx.output.store.table import SOLUTION, Row, read_rows
from magshell_fenicsx.output.store.written import note, refuse_unwritten
from magshell_fenicsx.parts.seen import MapGrid

MOST_PANELS = 12
MAPS = "field_maps"  # key of the case with their names
MOST_FRAMES = 40


class Drawn:
    """A run's folder as pictures need it; files are read once.

    Parameters
    ----------
    options
        Keys of the section `output` in place of those of the case.

    Attributes
    ----------
    resolved
        The case as in summary.json.

    Raises
    ------
    CaseError
        If the folder has no run, or an option is wrong.
    """

    def __init__(self, folder: Path, options: Mapping[str, Any] | None = None) -> None:
        self.folder = folder
        self.rows = _rows(folder)
        self.on_path = [row for row in self.rows if row["label"] != SOLUTION]
        self.resolved = case_in(folder)
        self.headline = headline(self.resolved, self.rows)
        self.style = style_of(self.resolved, options)
        self._points: dict[int, tuple[Surface, About]] = {}

    @property
    def place(self) -> str:
        """What the point of w_pole_over_h is called."""
        return pole_of(self.resolved)

    @cached_property
    def camera(self) -> Camera:
        """Of all pictures of the run."""
        return run_camera(self.at(self.headline)[0], self.style)

    def at(self, row: Row) -> tuple[Surface, About]:
        """The whole deformed shell at a point."""
        number = int(row["point"])
        if number not in self._points:
            self._points[number] = read_point(self.folder / "fields", number)
        return self._points[number]

    def maps_at(self, row: Row) -> list[tuple[MapGrid, float]]:
        """The grids beside the shell at a point, and R in metres."""
        files = (
            self.folder / "fields" / grid_file(name, int(row["point"]))
            for name in self.resolved.get(MAPS) or ()
        )
        return [read_map(file) for file in files]


def plot(
    folder: Path,
    point: int | None = None,
    animation: bool = False,
    options: Mapping[str, Any] | None = None,
    shapes: Sequence[int] = (),
) -> list[str]:
    """Draw the pictures again, also animation.gif if requested, and write report.html again; see
    `draw`.

    A picture of somebody else in the folder is refused, not replaced.
    """
    _rows(folder)  # there is a run
    refuse_unwritten(folder)
    drawn = draw(folder, point, options, shapes)
    if animation:
        drawn.append(draw_animation(folder, options))
    if point is None and (folder / "summary.json").exists():
        write_report(folder)
        drawn.append("report.html")
    note(folder, drawn)
    return [name for name in drawn if not name.startswith("fields/whole_")]  # whole.pvd lists them


def plotted(folders: Sequence[Path], out: Path, options: Mapping[str, Any], **alone: Any) -> str:
    """Draw one run again, as `plot`, or the curves of several; the files in words.

    Raises
    ------
    CaseError
        Of several runs with arguments `alone`, which are for one.
    """
    if len(folders) == 1:
        return f"{', '.join(plot(folders[0], options=options, **alone))} in {folders[0]}/"
    if any(value is not None and value is not False and value != [] for value in alone.values()):
        raise CaseError(
            "plot: of several runs the curves are drawn in one picture: give one folder for more"
        )
    return ", ".join(plot_runs(folders, out, options))


def plot_runs(
    folders: Sequence[Path], file: Path, options: Mapping[str, Any] | None = None
) -> list[str]:
    """Draw the curves of several runs in one picture; the names of its files.

    Raises
    ------
    CaseError
        If a folder has no run, or the curves do not belong together.
    OSError
        If a file cannot be written.
    """
    runs = {folder: _rows(folder) for folder in folders}
    style = style_of(case_in(folders[0]), options)
    names = []
    for name, content in written(runs_figure(runs, style), style, file.stem):
        write_whole(file.parent / name, content)
        names.append(str(file.parent / name))
    return names


def draw(
    folder: Path,
    point: int | None = None,
    options: Mapping[str, Any] | None = None,
    shapes: Sequence[int] = (),
) -> list[str]:
    """Draw every picture of a finished or interrupted run.

    Parameters
    ----------
    point
        Draw only this point: shell_0007.png, strains_0007.png, ...
    options
        Keys of the section `output` in place of those of the case.
    shapes
        Points whose shells are put on the curve.

    Returns
    -------
    The names of the files.

    Raises
    ------
    CaseError
        If the folder has no run, the run has no such point, or an option is wrong.
    OSError
        If a file cannot be written.
    """
    run = Drawn(folder, options)
    if point is not None and not 0 <= point < len(run.rows):
        raise CaseError(f"--point {point}: {folder} has points 0 to {len(run.rows) - 1}")
    for number in shapes:
        if not 0 <= number < len(run.rows):
            raise CaseError(f"--shapes {number}: {folder} has points 0 to {len(run.rows) - 1}")
    names = []
    for name, content in _of_point(run, point) if point is not None else _of_run(run, shapes):
        write_whole(folder / name, content)
        names.append(name)
    if run.style.whole:
        names += [f"fields/{name}" for name in write_whole_shells(folder)]
    return names


def _of_point(run: Drawn, point: int) -> Iterator[tuple[str, bytes]]:
    surface, about = run.at(run.rows[point])
    for name, figure in figures(
        in_its_field(surface, run.rows[point], run.rows), about.h, run.style, run.camera
    ).items():
        yield from written(figure, run.style, f"{name}_{point:04d}")
    if maps := run.maps_at(run.rows[point]):
        figure = field_maps_figure(maps, surface, about.h, run.resolved, run.style)
        yield from written(figure, run.style, f"field_maps_{point:04d}")


def _of_run(run: Drawn, shapes: Sequence[int]) -> Iterator[tuple[str, bytes]]:
    style, last = run.style, run.on_path[-1]
    surface, about = run.at(run.headline)
    if amplitude := str(last["amplitude"]):
        curve = curve_figure(run.rows, amplitude, style, run.place)
        if shapes:
            with drawing(style):
                chosen = [(run.rows[number], run.at(run.rows[number])[0]) for number in shapes]
                parts = worth_drawing(drawn_parts(run.rows, amplitude))
                add_shapes(curve, parts, chosen, style, run.camera)
        yield from written(curve, style, "curve")
        if run.resolved.get("sensors"):
            yield from written(
                readings_figure(run.rows, amplitude, run.resolved, style), style, "sensors"
            )
    for name, figure in figures(
        in_its_field(surface, run.headline, run.rows), about.h, style, run.camera
    ).items():
        yield from written(figure, style, name)
    if maps := run.maps_at(run.headline):
        yield from written(
            field_maps_figure(maps, surface, about.h, run.resolved, style), style, "field_maps"
        )
    for name, figure in mode_figures(run.folder, run.rows, style, run.camera):
        yield from written(figure, style, name)
    if frequencies := read_frequencies(run.folder):
        with drawing(style):
            figure = frequencies_figure(frequencies, run.rows, style)
        yield from written(figure, style, "frequencies")
    if files := gradient_files(run.folder):
        by_result = {of: read_vtu(file)[0] for of, file in files.items()}
        yield from written(gradients_figure(by_result, style, run.camera), style, "gradients")
    if solutions := searched(run.rows)[:MOST_PANELS]:
        surfaces = [run.at(each)[0] for each in solutions]
        yield from written(
            solutions_figure(surfaces, solutions, about.h, style, run.camera), style, "solutions"
        )


def in_its_field(surface: Surface, row: Row, rows: Sequence[Row]) -> Surface:
    """A surface without the direction of a field that is zero, and without the remanence where no
    row has a field.
    """
    if row["lambda_m"]:
        return surface
    none = {"Ba"} if any(each["lambda_m"] for each in rows) else {"Ba", "Br"}
    return replace(
        surface,
        fields={name: values for name, values in surface.fields.items() if name not in none},
    )


def draw_animation(folder: Path, options: Mapping[str, Any] | None = None) -> str:
    """Draw animation.gif: all steps of a programme, or the part in which the last amplitude varied;
    see `draw`.

    After a motion only it, at equal times.

    Returns
    -------
    The name of the file.
    """
    run = Drawn(folder, options)
    rows = run.on_path
    amplitude = str(rows[-1]["amplitude"])
    parts = drawn_parts(rows, amplitude) if amplitude else []
    part = rows if len(parts) != 1 else parts[0].rows
    chosen = in_true_time(rows) if amplitude == "time" else evenly(part, MOST_FRAMES)
    surfaces, abouts = zip(*(run.at(row) for row in chosen), strict=True)
    about: About = abouts[0]
    driven = list(dict.fromkeys(str(row["amplitude"]) for row in rows if row["amplitude"]))
    titles = [caption(about.h, about.nu, row, driven) for row in chosen]
    content = animated(surfaces, about.h, titles, rows, chosen, run.camera, run.place)
    write_whole(folder / "animation.gif", content)
    return "animation.gif"


def in_true_time(rows: Sequence[Row]) -> list[Row]:
    """The rows of a path's motions that are nearest to equal times."""
    part = [row for row in rows if row["amplitude"] == "time"]
    times = np.array([float(row["time"]) for row in part])
    shortest = np.diff(np.unique(times)).min(initial=np.ptp(times) or 1.0)
    count = int(min(MOST_FRAMES, np.ptp(times) / shortest + 1.5))
    return [part[int(np.abs(times - t).argmin())] for t in np.linspace(times[0], times[-1], count)]


def evenly(part: Sequence[Row], most: int) -> list[Row]:
    """At most so many rows, the first and the last among them."""
    count = min(len(part), most)
    return [part[round(i * (len(part) - 1) / max(count - 1, 1))] for i in range(count)]


def _rows(folder: Path) -> list[Row]:
    """The rows of the points whose field files exist."""
    try:
        rows = read_rows(folder / "path.csv")
    except (FileNotFoundError, NotADirectoryError):
        raise CaseError(f"{folder} holds no run: it has no path.csv") from None
    rows = [row for row in rows if (folder / "fields" / point_file(int(row["point"]))).exists()]
    if not rows:
        raise CaseError(f"{folder} has no point to draw: no fields/{point_file(0)}")
    return rows
