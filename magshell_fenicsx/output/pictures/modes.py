"""Pictures of modes and of further solutions as small panels; gradients.png.

The last shows where a result would change most with more of a field.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.modes import mode_caption, mode_file, wave_number
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.vtu import read_vtu
from magshell_fenicsx.output.pictures.captions import named_value
from magshell_fenicsx.output.pictures.colours import Coloured
from magshell_fenicsx.output.pictures.layout import (
    GAP,
    INCH,
    LINE,
    ONE,
    SEVERAL,
    Arrow,
    Boxes,
    Panel,
    columns,
    directions,
    draw_panel,
    drawing,
    panel_width,
    panels_figure,
)
from magshell_fenicsx.output.pictures.lines import numbered
from magshell_fenicsx.output.pictures.picture import Background, spread
from magshell_fenicsx.output.pictures.scales import SIGNED, colour_bar, from_zero
from magshell_fenicsx.output.pictures.view import Camera, Window
from magshell_fenicsx.output.store.table import LOCATED, SOLUTION, Row, read_csv, stability
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.quantities.registry import OWN_MODES, amplitude, quantity, shown_quantity

if TYPE_CHECKING:
    from matplotlib.figure import Figure


Array = NDArray[np.float64]
QUANTILE, PEAK = 0.995, 1.3  # colours end at most PEAK times above this quantile of the nodes
SMALL, APART = (
    0.15,
    0.16,
)  # vectors below this part of the largest have none; their distance over the extent of those
# of the largest load on the path: a load as small as this is zero, up to the error of where a path
# ends
ZERO = 1e-4
AGAIN = (
    5e-3  # of the largest displacements: an instability as near as this to an earlier one is that
)
NOTE = "Change of a result per area by the change of a field there."
WORDS = {
    "remanence": "more remanence, along arrows",
    "magnitude": "stronger magnet",
    "thickness": "more thickness",
    "curvature_11": r"natural curvature $\kappa_{11}$",
    "curvature_22": r"natural curvature $\kappa_{22}$",
    "curvature_12": r"natural twist $\kappa_{12}$",
    "deviation": r"shape moved outwards, $w_0/R$",
}


def small_panels(
    surfaces: Sequence[Surface],
    layers: Sequence[Coloured],
    captions: Sequence[str],
    style: OutputSection,
    camera: Camera,
    note: str = "",
) -> "Figure":
    """All in one window, with captions above them; the layers have the same limits.

    A note stands at the foot.
    """
    from matplotlib.figure import Figure

    number, line, gap = len(surfaces), LINE * style.font_size, GAP / INCH
    across = number if number < 4 else 2 if number == 4 else 3 if number < 10 else 4
    width = (style.width or (ONE if number == 1 else SEVERAL)) / INCH
    wide = width / across
    drawn = np.concatenate([camera(np.concatenate([s.r0, s.r0 + s.u])) for s in surfaces])
    window = Window.around(drawn, max(int((wide - gap) * style.dpi), 50))
    tall = window.shape[0] / style.dpi
    lines = max(caption.count("\n") + 1 for caption in captions)
    each, below = tall + lines * line + gap / 2, 4.4 * line
    foot = line if note else 0.0
    height = -(-number // across) * each + below + foot
    figure = Figure(figsize=(width, height), dpi=style.dpi)
    boxes = Boxes(figure)
    figure.text(
        *boxes.place(gap / 2, 0.5 * line), note, va="center", fontsize=0.9 * style.font_size
    )
    for i, (surface, layer, caption) in enumerate(zip(surfaces, layers, captions, strict=True)):
        panel = Background(surface, camera, 0, window).panel(layer, style)
        left, low = i % across * wide, height - (i // across + 1) * each
        draw_panel(boxes.axes(left + gap / 2, low, wide - gap, tall), panel, style)
        figure.text(
            *boxes.place(left + wide / 2, low + tall + lines * line / 2),
            caption,
            ha="center",
            va="center",
        )
    reach = min(width - gap - 8 * line, 4.0)
    box = boxes.axes((width - reach) / 2, foot + 1.7 * line, reach, 0.65 * line)
    colour_bar(figure, box, panel.scale, room=reach)
    directions(boxes.axes(gap / 2, foot + 0.4 * line, 3.4 * line, 3.4 * line), camera, style)
    return figure


def searched(rows: Sequence[Row]) -> list[Row]:
    """The rows of all solutions, and before those of a step the last point of its path."""
    rows_of_solutions: list[Row] = []
    for i, row in enumerate(rows):
        if row["label"] == SOLUTION:
            first = rows[i - 1]["label"] != SOLUTION or rows[i - 1]["step"] != row["step"]
            before = [rows[max(j for j in range(i) if rows[j]["branch"] == 0)]] if first else []
            rows_of_solutions += [*before, row]
    return rows_of_solutions


def solutions_figure(
    surfaces: Sequence[Surface], rows: Sequence[Row], h: float, style: OutputSection, camera: Camera
) -> "Figure":
    """Draw the deformed shells of some rows with the same colours."""
    limits = from_zero(
        min(float(s.w.min()) for s in surfaces) / h, max(float(s.w.max()) for s in surfaces) / h
    )
    layers = [
        Coloured(
            "w_over_h", np.asarray(s.w / h), limits, SIGNED, "inward normal displacement $w/h$"
        )
        for s in surfaces
    ]
    captions = [f"{_name(row)}: {stability(row).split()[0]}" for row in rows]
    with drawing(style):
        return small_panels(surfaces, layers, captions, style, camera)


def _name(row: Row) -> str:
    return f"solution {row['branch']}" if row["label"] == SOLUTION else "end of the path"


SHOWN = 0.05  # drawn size of a mode's largest displacement, over R
MOST_PANELS = 12
CAPTION = "$w$ of the mode over its largest, of any sign"


def modes_figure(
    surfaces: Sequence[Surface],
    captions: Sequence[str],
    style: OutputSection,
    camera: Camera,
    most: int = MOST_PANELS,
) -> "Figure":
    """Draw one small panel per mode: the deformed shell plus the mode, coloured by the mode's
    normal displacement.

    Parameters
    ----------
    surfaces
        With the fields "mode" and "mode_w"; see `fields.modes`.
    captions
        Of the panels, in matplotlib's mathematics.
    most
        Panels; the picture says how many modes it leaves out.
    """
    note = f"The first {most} of {len(captions)} modes." if len(captions) > most else ""
    surfaces, captions = surfaces[:most], captions[:most]
    moved = [replace(surface, u=surface.u + SHOWN * surface.fields["mode"]) for surface in surfaces]
    layers = []
    for surface in surfaces:
        w = surface.fields["mode_w"]
        layers.append(
            Coloured("mode_w", w / (np.abs(w).max() or 1.0), (-1.0, 1.0), SIGNED, CAPTION)
        )
    with drawing(style):
        return small_panels(moved, layers, captions, style, camera, note)


@dataclass(frozen=True)
class Mode:
    """A mode of stability.csv."""

    label: str
    eigenvalue: float


def mode_figures(
    folder: Path, rows: Sequence[Row], style: OutputSection, camera: Camera
) -> Iterator[tuple[str, "Figure"]]:
    """`instabilities` of the null vectors, and `modes_NNNN` of the modes in stability.csv."""
    numbers = numbered(rows)
    singular = [row for row in rows if row["label"] in LOCATED]
    met = _met_again(singular)
    first = [row for row in singular if int(row["point"]) in met]
    if panels := [
        panel for row in first if (panel := _null_vector(folder, row, rows, numbers, met))
    ]:
        yield "instabilities", _figure(panels, style, camera)
    table = folder / "stability.csv"
    if not table.exists():
        return
    listed = read_csv(
        table, lambda line: (int(line["point"]), Mode(line["mode"], float(line["eigenvalue"])))
    )
    for row in rows:
        point = int(row["point"])
        modes = [mode for number, mode in listed if number == point]
        files = [
            (mode_file(folder, point, str(n), mode.label), n, mode)
            for n, mode in enumerate(modes, 1)
        ]
        if panels := [
            (read_vtu(file)[0], mode_caption(n, mode)) for file, n, mode in files if file.exists()
        ]:
            yield f"modes_{point:04d}", _figure(panels, style, camera)


def _figure(
    panels: Sequence[tuple[Surface, str]], style: OutputSection, camera: Camera
) -> "Figure":
    surfaces, captions = zip(*panels, strict=True)
    return modes_figure(surfaces, captions, style, camera)


def _met_again(singular: Sequence[Row]) -> dict[int, list[Row]]:
    """Point of an instability -> the rows of the same one where the path comes back to it, itself
    the first.
    """
    met: dict[int, list[Row]] = {}
    moved = [
        name
        for name in (singular[0] if singular else ())
        if quantity(name).kind in ("displacement", "place")
    ]
    sizes = {name: max(abs(float(row[name])) for row in singular) for name in moved}

    def alike(one: Row, other: Row) -> bool:
        near = all(
            abs(float(one[name]) - float(other[name])) <= AGAIN * sizes[name] for name in moved
        )
        return near and all(one[name] == other[name] for name in ("label", "mode", "amplitude"))

    for row in singular:
        same = next((each for each in met.values() if alike(each[0], row)), None)
        if same is None:
            met[int(row["point"])] = [row]
        else:
            same.append(row)
    return met


def _null_vector(
    folder: Path,
    row: Row,
    rows: Sequence[Row],
    numbers: dict[int, int],
    met: Mapping[int, Sequence[Row]],
) -> tuple[Surface, str] | None:
    """The surface with a null vector, and its caption: numbers, kind, where on the path."""
    label = "" if row["mode"] in OWN_MODES else str(row["mode"])
    file = mode_file(folder, int(row["point"]), str(row["label"]), label)
    if not file.exists():
        return None
    surface, _ = read_vtu(file)
    details = [str(row["mode"])] if row["mode"] else []
    if not label and (m := wave_number(surface)):
        details.append(f"m = {m}")
    details = [detail.replace("m = ", "$m$ = ") for detail in details]
    kind = f" ({', '.join(details)})" if details else ""
    where = ""
    if row["amplitude"]:
        column = amplitude(str(row["amplitude"])).column
        largest = max(abs(float(each[column])) for each in rows)
        rounded = row if abs(float(row[column])) > ZERO * largest else {**row, column: 0.0}
        rounded = rounded if rounded is row else {**rounded, shown_quantity(column, row).name: 0.0}
        where = f"\n{named_value(column, rounded, 5)}"
    which = ", ".join(str(numbers[int(each["point"])]) for each in met[int(row["point"])])
    return surface, f"{which}: {row['label']}{kind}{where}"


def gradients_figure(
    by_result: Mapping[str, Surface], style: OutputSection, camera: Camera
) -> "Figure":
    """One panel for each result and field: red raises the result, blue lowers it; of vectors their
    length.
    """
    count = sum(name in surface.fields for surface in by_result.values() for name in WORDS)
    width = panel_width(style, columns(count))
    with drawing(style):
        panels = [
            panel
            for of, surface in by_result.items()
            for panel in _panels(of, surface, style, camera, width)
        ]
        return panels_figure(panels, style, NOTE)


def _panels(
    of: str, surface: Surface, style: OutputSection, camera: Camera, width: int
) -> Iterator[Panel]:
    view = Background(surface, camera, width)
    for name in (name for name in WORDS if name in surface.fields):
        caption, values = f"{of.replace('_', ' ')}: {WORDS[name]}", surface.fields[name]
        if values.ndim == 1:
            limit = _limit(np.abs(values))
            limits = from_zero(max(float(values.min()), -limit), min(float(values.max()), limit))
            yield view.panel(Coloured(name, values, limits, SIGNED, caption), style)
            continue
        size = np.asarray(np.linalg.norm(values, axis=1))
        panel = view.panel(Coloured(name, size, (0.0, _limit(size)), "Reds", caption), style)
        yield replace(panel, arrows=(_arrows(surface, values, view, camera),))


def _limit(sizes: Array) -> float:
    """The largest, without peaks at few nodes."""
    return float(min(sizes.max(), PEAK * np.quantile(sizes, QUANTILE))) or 1.0


def _arrows(surface: Surface, vectors: Array, view: Background, camera: Camera) -> Arrow:
    r, length = surface.r0 + surface.u, np.linalg.norm(vectors, axis=1)
    most, extent = length.max() or 1.0, float(np.ptp(r, axis=0).max())
    large = np.flatnonzero((length >= SMALL * most) & view.seen.shows(r, 0.03 * extent))
    apart = APART * float(np.ptp(r[large], axis=0).max())
    seeds = large[spread(r[large], apart)]
    return Arrow(camera(r[seeds]), camera(apart / most * vectors[seeds]), "0.15", "")
