"""The pictures of a run, drawn from the files of its folder: path.csv and fields/*.vtu.

A row is a line of path.csv: one point of the path. The headline is the row that a run is about, at
which its pictures show the shell. Options are keys of the section `output` (style, camera, formats)
in place of those of the case. A map is a grid outside the shell with the magnetic field. A shape is
a picture of the shell that is put on the curve. A motion is a step in time.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.grids import read_map
from magshell_fenicsx.output.fields.mode_fields import gradient_files, read_frequencies
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.vtu import (
    ShellData,
    grid_file,
    point_file,
    read_point,
    read_vtu,
    write_whole_shells,
)
from magshell_fenicsx.output.pictures.animation import animated
from magshell_fenicsx.output.pictures.captions import caption
from magshell_fenicsx.output.pictures.colours import field_at, sizes_at
from magshell_fenicsx.output.pictures.curve import curve_figure, drawn_panels, frequencies_figure
from magshell_fenicsx.output.pictures.curve_additions import add_shapes, runs_figure
from magshell_fenicsx.output.pictures.error_band import errors_at_points
from magshell_fenicsx.output.pictures.field_maps import field_maps_figure
from magshell_fenicsx.output.pictures.layout import drawing, figure_files
from magshell_fenicsx.output.pictures.lines import curve_steps
from magshell_fenicsx.output.pictures.mode_pictures import (
    gradients_figure,
    mode_figures,
    solution_rows,
    solutions_figure,
)
from magshell_fenicsx.output.pictures.picture import figures
from magshell_fenicsx.output.pictures.readings import readings_figure
from magshell_fenicsx.output.pictures.rendering import Camera, run_camera
from magshell_fenicsx.output.report.report import write_report
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.manifest import refuse_unwritten, write_manifest
from magshell_fenicsx.output.store.stored_results import (
    case_in,
    headline,
    load_at_factor_one,
    pole_of,
    read_summary,
    sizes_in,
    style_of,
)
from magshell_fenicsx.output.store.table import SOLUTION, Row, read_rows
from magshell_fenicsx.parts.bodies.contact_step import PRESSURE_MAX
from magshell_fenicsx.parts.observables import MapGrid
from magshell_fenicsx.quantities.quantity import CaseSizes
from magshell_fenicsx.quantities.registry import field_columns

MAX_PANELS = 12  # of solutions.png
MAPS = "field_maps"  # key of the case with the names of grids
MAX_FRAMES = 40


class PicturedRun:
    """Data of a run's folder for its pictures; files are read once.

    Parameters
    ----------
    folder
        Folder of the run.
    options
        Keys of the section `output` in place of those of the case.

    Attributes
    ----------
    rows, on_path
        The rows of path.csv whose points have fields, and those among them that are no solutions of
        a search.
    resolved
        The case of summary.json or of the checkpoint.
    headline
        The row at which pictures show the shell.
    style
        The section `output`, with the options.

    Raises
    ------
    CaseError
        If the folder has no run, or an option is wrong.
    """

    def __init__(self, folder: Path, options: Mapping[str, Any] | None = None) -> None:
        """Read the rows and the case; surfaces are read when they are needed.

        `_points` has the surfaces that have been read, by the number of the point.
        """
        self.folder = folder
        self.rows = _rows(folder)
        self.on_path = [row for row in self.rows if row["label"] != SOLUTION]
        self.resolved = case_in(folder)
        self.headline = headline(self.resolved, self.rows)
        self.style = style_of(self.resolved, options)
        self._points: dict[int, tuple[Surface, ShellData]] = {}

    @property
    def pole_name(self) -> str:
        """Name of the point of w_pole_over_h."""
        return pole_of(self.resolved)

    @property
    def errors(self) -> Mapping[str, float]:
        """Estimated errors of the results; empty for a run that has no summary yet."""
        if not (self.folder / "summary.json").exists():
            return {}
        estimates: Mapping[str, float] = read_summary(self.folder).get("errors", {})
        return estimates

    @cached_property
    def sizes(self) -> CaseSizes:
        """Sizes of the case, without those of the magnetic field at a point."""
        return sizes_in(self.folder)

    @cached_property
    def camera(self) -> Camera:
        """Camera of all pictures of the run."""
        surface, _ = self.surface_at(self.headline)
        return run_camera(surface, self.style)

    def surface_at(self, row: Row) -> tuple[Surface, ShellData]:
        """Return the whole deformed shell at a point, and the shell's data."""
        number = int(row["point"])
        if number not in self._points:
            surface, shell_data = read_point(self.folder / "fields", number)
            magnetic = self.resolved.get("magnetic") or {}
            rotates = magnetic.get("remanence") == "rotation"
            self._points[number] = replace(surface, remanence_rotates=rotates), shell_data
        return self._points[number]

    def maps_at(self, row: Row) -> list[tuple[MapGrid, float]]:
        """Return the grids outside the shell at a point, each with R in metres."""
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
    """Draw the pictures of a run again, and write report.html again.

    A foreign picture in the folder is refused, not replaced.

    Parameters
    ----------
    point
        Draw only this point: shell_0007.png, strains_0007.png, ... The report then stays as it is.
    options
        Keys of the section `output` in place of those of the case.
    shapes
        Points whose shells are put on the curve.
    animation
        Whether to draw animation.gif too.

    Returns
    -------
    The names of the files; whole.pvd lists the files `fields/whole_*`, which are left out.
    """
    _rows(folder)  # raises if there is no run
    refuse_unwritten(folder)
    names = draw(folder, point, options, shapes)
    if animation:
        names.append(draw_animation(folder, options))
    if point is None and (folder / "summary.json").exists():
        write_report(folder)
        names.append("report.html")
    write_manifest(folder, names)
    return [name for name in names if not name.startswith("fields/whole_")]


def _is_given(value: object) -> bool:
    """Return whether an argument is given: one that is not is None, False or an empty list."""
    if value is None or value is False:
        return False
    return value != []


def plot_folders(
    folders: Sequence[Path], out: Path, options: Mapping[str, Any], **options_of_one: Any
) -> str:
    """Draw one run again, as `plot` does, or the curves of several; return the files in words.

    Parameters
    ----------
    folders
        Folders of the runs.
    out
        File of the picture of several curves.
    options
        Keys of the section `output` in place of those of the case.
    options_of_one
        Further arguments of `plot`.

    Raises
    ------
    CaseError
        If several runs are given with arguments that are for one.
    """
    if len(folders) == 1:
        return f"{', '.join(plot(folders[0], options=options, **options_of_one))} in {folders[0]}/"
    if any(_is_given(value) for value in options_of_one.values()):
        raise CaseError(
            "plot: of several runs the curves are drawn in one picture: give one folder for more"
        )
    return ", ".join(plot_runs(folders, out, options))


def plot_runs(
    folders: Sequence[Path], file: Path, options: Mapping[str, Any] | None = None
) -> list[str]:
    """Draw the curves of several runs in one picture, `file` and its further formats.

    Returns
    -------
    The names of the files.

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
    for name, content in figure_files(runs_figure(runs, style), style, file.stem):
        write_whole(file.parent / name, content)
        names.append(str(file.parent / name))
    return names


def draw(
    folder: Path,
    point: int | None = None,
    options: Mapping[str, Any] | None = None,
    shapes: Sequence[int] = (),
) -> list[str]:
    """Draw every picture of a finished or interrupted run into its folder.

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
    run = PicturedRun(folder, options)
    if point is not None and not 0 <= point < len(run.rows):
        raise CaseError(f"--point {point}: {folder} has points 0 to {len(run.rows) - 1}")
    for number in shapes:
        if not 0 <= number < len(run.rows):
            raise CaseError(f"--shapes {number}: {folder} has points 0 to {len(run.rows) - 1}")
    names = []
    pictures = _pictures_of_run(run, shapes) if point is None else _pictures_of_point(run, point)
    for name, content in pictures:  # drawn and written one after the other
        write_whole(folder / name, content)
        names.append(name)
    if run.style.whole:
        names += [f"fields/{name}" for name in write_whole_shells(folder)]
    return names


def _pictures_of_point(run: PicturedRun, point: int) -> Iterator[tuple[str, bytes]]:
    """Yield names and contents of the pictures of one point, named with its number."""
    surface, shell_data = run.surface_at(run.rows[point])
    shown_surface = without_zero_fields(surface, run.rows[point], run.rows)
    figures_by_name = figures(
        shown_surface,
        shell_data.h,
        run.style,
        run.camera,
        sizes=sizes_at(run.sizes, surface, field_at(run.rows[point])),
    )
    for name, figure in figures_by_name.items():
        yield from figure_files(figure, run.style, f"{name}_{point:04d}")
    if maps := run.maps_at(run.rows[point]):
        figure = field_maps_figure(maps, surface, shell_data.h, run.resolved, run.style)
        yield from figure_files(figure, run.style, f"field_maps_{point:04d}")


def _pictures_of_run(run: PicturedRun, shapes: Sequence[int]) -> Iterator[tuple[str, bytes]]:
    """Yield names and contents of all pictures of a run.

    `shapes` are the numbers of points whose shells are put on the curve.
    """
    style, last_row = run.style, run.on_path[-1]
    # pictures for which the run has no data are left out below
    surface, shell_data = run.surface_at(run.headline)
    # over the load: the curve, and what sensors read
    if amplitude := str(last_row["amplitude"]):
        load = load_at_factor_one(run.resolved, run.sizes)
        curve = curve_figure(run.rows, amplitude, style, run.pole_name, run.errors, load)
        if shapes:
            with drawing(style):
                shells = list[tuple[Row, Surface]]()
                for number in shapes:
                    surface_of_shape, _ = run.surface_at(run.rows[number])
                    shells.append((run.rows[number], surface_of_shape))
                add_shapes(
                    curve,
                    drawn_panels(run.rows, amplitude),
                    shells,
                    shell_data.h,
                    run.camera,
                    run.sizes,
                )
        yield from figure_files(curve, style, "curve")
        if run.resolved.get("sensors"):
            figure = readings_figure(run.rows, amplitude, run.resolved, style)
            yield from figure_files(figure, style, "sensors")
    # of the shell at one point, and of the field around it
    shown_surface = without_zero_fields(surface, run.headline, run.rows)
    shown_surface = with_contact_errors(shown_surface, run)
    sizes = sizes_at(run.sizes, surface, field_at(run.headline))
    figures_by_name = figures(shown_surface, shell_data.h, style, run.camera, sizes=sizes)
    for name, figure in figures_by_name.items():
        yield from figure_files(figure, style, name)
    if maps := run.maps_at(run.headline):
        figure = field_maps_figure(maps, surface, shell_data.h, run.resolved, style)
        yield from figure_files(figure, style, "field_maps")
    # of what the run has computed besides its path
    for name, figure in mode_figures(run.folder, run.rows, style, run.camera):
        yield from figure_files(figure, style, name)
    if frequencies := read_frequencies(run.folder):
        with drawing(style):
            figure = frequencies_figure(frequencies, run.rows, style)
        yield from figure_files(figure, style, "frequencies")
    if files := gradient_files(run.folder):
        by_result = dict[str, Surface]()
        for result, file in files.items():
            by_result[result], _ = read_vtu(file)
        figure = gradients_figure(by_result, style, run.camera)
        yield from figure_files(figure, style, "gradients")
    if solutions := solution_rows(run.rows)[:MAX_PANELS]:
        surfaces, _ = zip(*(run.surface_at(row) for row in solutions), strict=True)
        figure = solutions_figure(surfaces, solutions, shell_data.h, style, run.camera, run.sizes)
        yield from figure_files(figure, style, "solutions")


def with_contact_errors(surface: Surface, run: PicturedRun) -> Surface:
    """Return the surface of a run's headline, with the errors of its contact's numbers."""
    row, peak = run.headline, surface.contact_peak
    if peak is None:
        return surface
    errors = errors_at_points(run.rows, run.errors).get(int(row["point"]), {})
    normal_forces = [f"{body}_normal_force" for body in run.resolved.get("bodies") or ()]

    def relative_error(columns: Sequence[str]) -> float:
        """Return the error of the sum of some columns over the sum; nan if it is not known."""
        if not columns or any(column not in errors for column in columns):
            return nan
        return sum(errors[column] for column in columns) / sum(float(row[c]) for c in columns)

    peak_with_errors = replace(
        peak,
        pressure_error=relative_error([PRESSURE_MAX]),
        force_error=relative_error(normal_forces),
    )
    return replace(surface, contact_peak=peak_with_errors)


def has_field(row: Row) -> bool:
    """Return whether a field is applied at the point of a row."""
    return any(row[column] for column in field_columns())


def without_zero_fields(surface: Surface, row: Row, rows: Sequence[Row]) -> Surface:
    """Return a surface without the applied field Ba, if that is zero at the point of `row`.

    The remanence Br is left out too where no row has a field.
    """
    if has_field(row):
        return surface
    # a remanence is of interest as soon as a field is applied on the path
    left_out = {"Ba"} if any(map(has_field, rows)) else {"Ba", "Br"}
    fields = {name: values for name, values in surface.fields.items() if name not in left_out}
    return replace(surface, fields=fields)


def draw_animation(folder: Path, options: Mapping[str, Any] | None = None) -> str:
    """Draw animation.gif into a run's folder, and return its name.

    It shows all steps of a programme, or the part in which the last amplitude varied. If the run
    ends with a motion, it shows motions alone, at equal times. `options` are keys of the section
    `output` in place of those of the case.
    """
    run = PicturedRun(folder, options)
    rows = run.on_path
    amplitude = str(rows[-1]["amplitude"])
    steps = curve_steps(rows, amplitude) if amplitude else []
    shown_rows = rows if len(steps) != 1 else steps[0].rows
    # the rows that are shown as frames: of motions those at equal times
    frame_rows = (
        in_true_time(rows) if amplitude == "time" else evenly_chosen(shown_rows, MAX_FRAMES)
    )
    surfaces, data_of_frames = zip(*(run.surface_at(row) for row in frame_rows), strict=True)
    shell_data: ShellData = data_of_frames[0]
    amplitudes = list(dict.fromkeys(str(row["amplitude"]) for row in rows if row["amplitude"]))
    titles = [caption(shell_data.h, shell_data.nu, row, amplitudes) for row in frame_rows]
    content = animated(
        surfaces,
        shell_data.h,
        titles,
        rows,
        frame_rows,
        run.camera,
        pole=run.pole_name,
        sizes=run.sizes,
    )
    write_whole(folder / "animation.gif", content)
    return "animation.gif"


def in_true_time(rows: Sequence[Row]) -> list[Row]:
    """Return the rows of a path's motions that are nearest to equal times, at most MAX_FRAMES."""
    motion = [row for row in rows if row["amplitude"] == "time"]
    times = np.array([float(row["time"]) for row in motion])
    # frames are at least as far apart as the two rows that are nearest in time; there is one frame
    # if all rows have one time
    shortest = np.diff(np.unique(times)).min(initial=np.ptp(times) or 1.0)
    count = int(min(MAX_FRAMES, np.ptp(times) / shortest + 1.5))
    return [
        motion[int(np.abs(times - time).argmin())]
        for time in np.linspace(times[0], times[-1], count)
    ]


def evenly_chosen(rows: Sequence[Row], max_rows: int) -> list[Row]:
    """Return at most `max_rows` rows, the first and the last among them."""
    count = min(len(rows), max_rows)
    return [rows[round(i * (len(rows) - 1) / max(count - 1, 1))] for i in range(count)]


def _rows(folder: Path) -> list[Row]:
    """Return the rows of path.csv whose points have field files.

    Raises
    ------
    CaseError
        If there are none.
    """
    try:
        rows = read_rows(folder / "path.csv")
    except (FileNotFoundError, NotADirectoryError):
        raise CaseError(f"{folder} holds no run: it has no path.csv") from None
    rows = [row for row in rows if (folder / "fields" / point_file(int(row["point"]))).exists()]
    if not rows:
        raise CaseError(f"{folder} has no point to draw: no fields/{point_file(0)}")
    return rows
