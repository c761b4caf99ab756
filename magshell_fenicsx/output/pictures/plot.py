"""The pictures of a run, drawn from the files of its folder: path.csv and fields/*.vtu."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.output.fields.frequencies import read_frequencies
from magshell_fenicsx.output.fields.gradients import gradient_files
from magshell_fenicsx.output.fields.modes import mode_caption, mode_file, wave_number
from magshell_fenicsx.output.fields.outlines import read_outlines
from magshell_fenicsx.output.fields.surface import Surface, completed
from magshell_fenicsx.output.fields.vtu import About, point_file, read_vtu
from magshell_fenicsx.output.pictures.animation import animated
from magshell_fenicsx.output.pictures.captions import caption, named_value, shell_caption
from magshell_fenicsx.output.pictures.curve import curve_figure, drawn_parts
from magshell_fenicsx.output.pictures.frequencies import frequencies_figure
from magshell_fenicsx.output.pictures.gradient_picture import draw_gradients
from magshell_fenicsx.output.pictures.layout import png
from magshell_fenicsx.output.pictures.mode_picture import draw_modes
from magshell_fenicsx.output.pictures.picture import figures
from magshell_fenicsx.output.pictures.solutions import searched, solutions_figure
from magshell_fenicsx.output.report.report import write_report
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.table import LOCATED, OWN_MODES, SOLUTION, Row, read_rows
from magshell_fenicsx.quantities.registry import amplitude as registered

MOST_PANELS = 9
MOST_FRAMES = 40
Panel = tuple[Surface, About, str]  # the surface with a mode, and its caption
UNIT = r"stiffness per area $\lambda$ of each mode in $E h/R^2$"


@dataclass(frozen=True)
class Mode:
    """A mode of stability.csv."""

    label: str
    eigenvalue: float


def plot(folder: Path, point: int | None = None, animation: bool = False) -> list[str]:
    """Draw the pictures again, also animation.gif if requested, and write report.html again; see `draw`."""
    drawn = draw(folder, point)
    if animation:
        drawn.append(draw_animation(folder))
    if point is None and (folder / "summary.json").exists():
        write_report(folder)
        drawn.append("report.html")
    return drawn


def draw(folder: Path, point: int | None = None) -> list[str]:
    """Draw every picture of a finished or interrupted run.

    Parameters
    ----------
    point
        Draw only this point: shell_0007.png, strains_0007.png, ...

    Returns
    -------
    The names of the files.

    Raises
    ------
    CaseError
        If the folder has no run, or the run has no such point.
    OSError
        If a file cannot be written.
    NoScreen
        If there is no display.
    """
    rows = _rows(folder)
    drawn: list[str] = []

    def write(name: str, content: bytes) -> None:
        write_whole(folder / name, content)
        drawn.append(name)

    if point is not None and not 0 <= point < len(rows):
        raise CaseError(f"--point {point}: {folder} has points 0 to {len(rows) - 1}")
    row = _on_path(rows)[-1] if point is None else rows[point]
    surface, about = _point(folder, row)
    suffix = "" if point is None else f"_{point:04d}"
    title, amplitude = caption(about.h, about.nu, row), str(row["amplitude"])
    if amplitude and point is None:
        write("curve.png", png(curve_figure(rows, amplitude, title)))
    for name, figure in figures(surface, about.h, title).items():
        write(f"{name}{suffix}.png", png(figure))
    if point is None:
        for name, content in _modes(folder, rows):
            write(name, content)
        if frequencies := read_frequencies(folder):
            write("frequencies.png", png(frequencies_figure(frequencies, rows, title)))
        if files := gradient_files(folder):
            title = "Change of a result per area by the change of a field there\n" + title
            write("gradients.png", draw_gradients({of: read_vtu(f)[0] for of, f in files.items()}, about.h, title))
        if found := searched(rows):
            surfaces = [_point(folder, each)[0] for each in found[:MOST_PANELS]]
            title = caption(about.h, about.nu, found[0])
            write("solutions.png", png(solutions_figure(surfaces, found[:MOST_PANELS], about.h, title)))
    return drawn


def draw_animation(folder: Path) -> str:
    """Draw animation.gif: all steps of a programme, or the part in which the last amplitude varied; see `draw`.

    After a motion only it, at equal times.

    Returns
    -------
    The name of the file.
    """
    rows = _on_path(_rows(folder))
    amplitude = str(rows[-1]["amplitude"])
    parts = drawn_parts(rows, amplitude) if amplitude else []
    part = rows if len(parts) != 1 else parts[0].rows
    chosen = in_true_time(rows) if amplitude == "time" else _evenly(part)
    surfaces, abouts = zip(*(_point(folder, row) for row in chosen), strict=True)
    about: About = abouts[0]
    titles = [caption(about.h, about.nu, row) for row in chosen]
    write_whole(folder / "animation.gif", animated(surfaces, about.h, titles, rows, chosen))
    return "animation.gif"


def in_true_time(rows: Sequence[Row]) -> list[Row]:
    """The rows of a path's motions that are nearest to equal times."""
    part = [row for row in rows if row["amplitude"] == "time"]
    times = np.array([float(row["time"]) for row in part])
    shortest = np.diff(np.unique(times)).min(initial=np.ptp(times) or 1.0)
    count = int(min(MOST_FRAMES, np.ptp(times) / shortest + 1.5))
    return [part[int(np.abs(times - t).argmin())] for t in np.linspace(times[0], times[-1], count)]


def _evenly(part: Sequence[Row]) -> list[Row]:
    count = min(len(part), MOST_FRAMES)
    return [part[round(i * (len(part) - 1) / max(count - 1, 1))] for i in range(count)]


def _rows(folder: Path) -> list[Row]:
    """The rows of the points whose field files exist."""
    try:
        rows = read_rows(folder / "path.csv")
    except (FileNotFoundError, NotADirectoryError):
        raise CaseError(f"{folder} holds no run: it has no path.csv") from None
    rows = [row for row in rows if _file(folder, row).exists()]
    if not rows:
        raise CaseError(f"{folder} has no point to draw: no fields/{point_file(0)}")
    return rows


def _on_path(rows: Sequence[Row]) -> list[Row]:
    """The rows without the solutions of searches."""
    return [row for row in rows if row["label"] != SOLUTION]


def _file(folder: Path, row: Row) -> Path:
    return folder / "fields" / point_file(int(row["point"]))


def _point(folder: Path, row: Row) -> tuple[Surface, About]:
    """The whole deformed shell at a point."""
    surface, about = read_vtu(_file(folder, row))
    surface = replace(surface, outlines=read_outlines(folder / "fields", int(row["point"])))
    return surface if about.mirror is None else completed(surface, about.mirror), about


def _modes(folder: Path, rows: Sequence[Row]) -> list[tuple[str, bytes]]:
    """instabilities.png of the null vectors, and modes_NNNN.png of the modes in stability.csv."""
    found = []
    singular = [row for row in rows if row["label"] in LOCATED]
    if panels := [panel for row in singular if (panel := _null_vector(folder, row))]:
        title = f"Null vectors at instabilities\n{_shell(panels, singular[0])}"
        found.append(("instabilities.png", _drawn(panels, title)))
    if (table := folder / "stability.csv").exists():
        with table.open(encoding="utf-8", newline="") as stream:
            listed = list(csv.DictReader(stream))
        for row in rows:
            number = int(row["point"])
            modes = [Mode(line["mode"], float(line["eigenvalue"])) for line in listed if int(line["point"]) == number]
            files = [(mode_file(folder, number, str(n), mode.label), n, mode) for n, mode in enumerate(modes, 1)]
            panels = [(*read_vtu(file), mode_caption(n, mode)) for file, n, mode in files if file.exists()]
            if panels:
                title = f"{_shell(panels, row)}, {_where(row)}\n{UNIT}"
                found.append((f"modes_{number:04d}.png", _drawn(panels, title)))
    return found


def _null_vector(folder: Path, row: Row) -> Panel | None:
    label = "" if row["mode"] in OWN_MODES else str(row["mode"])
    file = mode_file(folder, int(row["point"]), str(row["label"]), label)
    if not file.exists():
        return None
    surface, about = read_vtu(file)
    details = [str(row["mode"])] if row["mode"] else []
    if not label and (m := wave_number(surface)):
        details.append(f"m = {m}")
    kind = f" ({', '.join(details)})" if details else ""
    return surface, about, f"{row['label']}{kind}, {_where(row)}"


def _shell(panels: Sequence[Panel], row: Row) -> str:
    about = panels[0][1]
    return shell_caption(about.h, about.nu, row)


def _drawn(panels: Sequence[Panel], title: str) -> bytes:
    surfaces, _, captions = zip(*panels[:MOST_PANELS], strict=True)
    return draw_modes(surfaces, captions, title)


def _where(row: Row) -> str:
    name = registered(str(row["amplitude"])).column
    value = f": {named_value(name, row, 5)}" if row["amplitude"] else ""
    return f"point {row['point']}{value}"
