"""More on a curve: those of several runs in one picture, and the shell at some points of one."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.animation import edge_of, magnification
from magshell_fenicsx.output.pictures.curve import MARK, draw_lines, drawn_points, legend
from magshell_fenicsx.output.pictures.layout import INCH, ONE, drawing
from magshell_fenicsx.output.pictures.lines import Part, axes_for, drawn_parts, named, place
from magshell_fenicsx.output.pictures.picture import Background
from magshell_fenicsx.output.pictures.scales import number_format
from magshell_fenicsx.output.pictures.view import Camera, Image, Window
from magshell_fenicsx.output.store.known import case_in, pole_of
from magshell_fenicsx.output.store.table import LOCATED, SOLUTION, Row
from magshell_fenicsx.problem.wanted import OutputSection
from magshell_fenicsx.quantities.registry import QUANTITIES

if TYPE_CHECKING:  # takes long to import
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
MOST_KEYS = 2  # of a case in the label of its run
WIDE, TALL = 0.26, 0.34  # of a shell on a curve, over the axes
GREY = 0.8
DARK, RIM = 0.3, 0.8  # of the line around a shell, and how much of it is seen
EACH_WAY, MARGIN = 9, 0.02  # places that are tried; the room around them, over the axes
COVERED, MET = (
    12.0,
    50.0,
)  # how bad it is to cover all of the curve, or another shell, beside one width of the axes


def runs_figure(runs: Mapping[Path, Sequence[Row]], style: OutputSection) -> "Figure":
    """The last curve of each run in one picture; labels say in what their cases differ.

    Parameters
    ----------
    runs
        Folder -> the rows of its path.

    Raises
    ------
    CaseError
        If they have no curve, or curves over different quantities.
    """
    from matplotlib.figure import Figure

    parts = {folder: _last(folder, rows) for folder, rows in runs.items()}
    first, *others = parts.values()
    axes_names = {folder: tuple(q.name for q in axes_for(part)) for folder, part in parts.items()}
    for folder, other in zip(list(parts)[1:], others, strict=True):
        if axes_names[folder] != axes_names[next(iter(parts))]:
            over = " over ".join(reversed([q.name for q in axes_for(other)]))
            asked = " over ".join(reversed(axes_names[next(iter(parts))]))
            raise CaseError(
                f"{folder}: its curve is {over}, that of {next(iter(parts))} {asked}: draw them alone"
            )
    cases = {folder: case_in(folder) for folder in parts}
    width = (style.width or ONE) / INCH
    with drawing(style):
        figure = Figure(figsize=(width, 0.8 * width), dpi=style.dpi, layout="constrained")
        axes = figure.subplots()
        for i, (name, part) in enumerate(zip(labels(cases), parts.values(), strict=True)):
            draw_lines(
                axes, part, f"C{i % 10 if i % 10 < 3 else i % 10 + 1}"
            )  # C3 is that of the marks
            axes.plot([], [], color=f"C{i % 10 if i % 10 < 3 else i % 10 + 1}", lw=1.2, label=name)
        pole = pole_of(next(iter(cases.values())))
        x_label, y_label = (
            named(each, first.rows[0], pole, r"\$").label for each in axes_for(first)
        )
        axes.set(xlabel=x_label, ylabel=y_label)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter(number_format())
        axes.axhline(0, color="0.8", linewidth=0.8, zorder=0)
        legend(figure, 2)
    return figure


def _last(folder: Path, rows: Sequence[Row]) -> Part:
    path = [row for row in rows if row["label"] != SOLUTION]
    if not path or not path[-1]["amplitude"]:
        raise CaseError(f"{folder}: has no curve: nothing has varied")
    return drawn_parts(path, str(path[-1]["amplitude"]))[-1]


def labels(cases: Mapping[Path, Mapping[str, Any]]) -> list[str]:
    """For each run the values of the keys in which the cases differ, or the name of its folder.

    Examples
    --------
    >>> labels({Path("a"): {"shell": {"h": 1.0}, "x": 2}, Path("b"): {"shell": {"h": 0.5}, "x": 2}})
    ['h = 1', 'h = 0.5']
    """
    flat = [dict(_flat(case)) for case in cases.values()]
    every = dict.fromkeys(key for each in flat for key in each)
    keys = [key for key in every if len({str(each.get(key)) for each in flat}) > 1]
    if not 0 < len(keys) <= MOST_KEYS:
        return [folder.name.replace("$", r"\$") for folder in cases]
    return [", ".join(f"{_short(key)} = {_said(each.get(key))}" for key in keys) for each in flat]


def _flat(part: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Key with its path -> value, of all values of a case but those of its pictures."""
    items = part.items() if isinstance(part, Mapping) else enumerate(part)
    for key, value in items:
        name = f"{before}.{key}" if before else str(key)
        if name == "output":
            continue
        if isinstance(value, Mapping | list):
            yield from _flat(value, name)
        else:
            yield name, value


def _short(key: str) -> str:
    name = key.rpartition(".")[2]
    return QUANTITIES[name].latex if name in QUANTITIES else name.replace("_", " ")


def _said(value: Any) -> str:
    if isinstance(value, float | int):
        return f"{value:.6g}".replace("-", "−")
    return str(value).replace("$", r"\$")


def add_shapes(
    figure: "Figure",
    parts: Sequence[Part],
    shapes: Sequence[tuple[Row, Surface]],
    style: OutputSection,
    camera: Camera,
) -> None:
    """Put the shell at some points on the curves of a figure, each where it covers least, with a
    line to its point.

    All have one scale; displacements that would not be seen are drawn larger, which the title says.
    """
    from matplotlib.offsetbox import AnnotationBbox, OffsetImage

    on = [
        next((i for i in range(len(parts) - 1, -1, -1) if row in parts[i].rows), None)
        for row, _ in shapes
    ]
    factor = magnification([surface for _, surface in shapes])
    moved = [replace(surface, u=factor * surface.u) for _, surface in shapes]
    for drawn_on in dict.fromkeys(i for i in on if i is not None) if factor > 1 else ():
        before = (
            f"{figure.axes[drawn_on].get_title()}; " if figure.axes[drawn_on].get_title() else ""
        )
        figure.axes[drawn_on].set_title(rf"{before}displacements of shapes $\times$ {factor:g}")
    figure.draw_without_rendering()
    everything, taken = (
        camera(np.concatenate([s.r0 + s.u for s in moved])),
        dict[int, list[Array]](),
    )
    for number, (row, _), surface in zip(on, shapes, moved, strict=True):
        if number is None:
            continue
        axes = figure.axes[number]
        box = axes.get_window_extent()
        tall = Window.around(everything, 1000).shape[0] / 1000
        width = max(int(min(WIDE * box.width, TALL * box.height / tall)), 8)
        image = _drawn(
            Background(surface, camera, width, Window.around(everything, width)).plain(GREY)
        )
        size = np.array([image.shape[1] / box.width, image.shape[0] / box.height])
        at = np.array(place(row, parts[number].amplitude))
        corner = _free(axes, at, size, taken.setdefault(number, []))
        taken[number].append(np.array([corner, corner + size]))
        line = {
            "arrowstyle": "-",
            "color": "0.5",
            "linewidth": 0.6,
            "shrinkA": 0,
            "shrinkB": MARK / 2,
        }
        end = _nearest(axes, image, at, corner, size)
        begin, (x, y) = (float(at[0]), float(at[1])), corner + size / 2
        axes.annotate("", begin, end, textcoords="axes fraction", arrowprops=line, zorder=3)
        shown = OffsetImage(image, zoom=72 / figure.dpi, resample=True)
        how: dict[str, Any] = {"xycoords": "axes fraction", "frameon": False, "pad": 0, "zorder": 3}
        axes.add_artist(AnnotationBbox(shown, (float(x), float(y)), **how))
        if row["label"] not in LOCATED:  # those have marks
            axes.plot(*at, "o", color="k", markersize=MARK, zorder=5)


def _drawn(image: Image) -> Image:
    """The part of an image on which something is, with a line around that."""
    part = image[..., 3:] / 255
    edge = RIM * edge_of(part)
    lined = image.copy()
    lined[..., :3] = np.rint((1 - edge) * image[..., :3] + edge * 255 * DARK)
    rows, across = (np.flatnonzero(part[..., 0].any(axis=axis)) for axis in (1, 0))
    return lined[rows[0] : rows[-1] + 1, across[0] : across[-1] + 1]


def _nearest(
    axes: "Axes", image: Image, at: Array, corner: Array, size: Array
) -> tuple[float, float]:
    """Where in the axes an image at a corner is nearest to a point of the data."""
    down, right = np.nonzero(image[..., 3] > 127)
    inside = corner + size * np.column_stack(
        [(right + 0.5) / image.shape[1], 1 - (down + 0.5) / image.shape[0]]
    )
    box = axes.get_window_extent()
    target = axes.transAxes.inverted().transform(axes.transData.transform(at))
    x, y = inside[np.linalg.norm((inside - target) * [box.width, box.height], axis=1).argmin()]
    return float(x), float(y)


def _free(axes: "Axes", at: Array, size: Array, taken: Sequence[Array]) -> Array:
    """The lower left corner of a box, in parts of the axes, that covers little and is near its
    point.
    """
    inside = axes.transAxes.inverted().transform
    points = inside(axes.transData.transform(drawn_points(axes)))
    target = inside(axes.transData.transform(at))

    def fault(low: Array) -> float:
        high = low + size
        covered = ((points > low) & (points < high)).all(axis=1).mean()
        met = sum(
            float(np.prod(np.clip(np.minimum(high, b) - np.maximum(low, a), 0, None)))
            for a, b in taken
        )
        return float(COVERED * covered + MET * met + np.linalg.norm(low + size / 2 - target))

    along = (np.linspace(MARGIN, max(1 - MARGIN - part, MARGIN), EACH_WAY) for part in size)
    return np.asarray(min((np.array(at) for at in product(*along)), key=fault))
