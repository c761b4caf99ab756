"""Small panels of several shells with one colour bar: modes, and the solutions of a search."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from magshell_fenicsx.case.output import OutputSection
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.bars import colour_bar
from magshell_fenicsx.output.pictures.colours import Coloured
from magshell_fenicsx.output.pictures.layout import (
    GAP,
    INCH,
    LINE,
    ONE,
    SEVERAL,
    Boxes,
    directions,
    draw_panel,
)
from magshell_fenicsx.output.pictures.picture import Background
from magshell_fenicsx.output.pictures.view import Camera, Window

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure


def small_panels(
    surfaces: Sequence[Surface],
    layers: Sequence[Coloured],
    captions: Sequence[str],
    style: OutputSection,
    camera: Camera,
) -> "Figure":
    """All in one window, with captions above them; the layers have the same limits."""
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
    height = -(-number // across) * each + below
    figure = Figure(figsize=(width, height), dpi=style.dpi)
    boxes = Boxes(figure)
    for i, (surface, layer, caption) in enumerate(zip(surfaces, layers, captions, strict=True)):
        panel = Background(surface, camera, 0, window).panel(layer, style)
        left, low = i % across * wide, height - (i // across + 1) * each
        draw_panel(boxes.axes(left + gap / 2, low, wide - gap, tall), panel, style)
        figure.text(*boxes.place(left + wide / 2, low + tall + lines * line / 2), caption, ha="center", va="center")
    reach = min(width - gap - 8 * line, 4.0)
    box = boxes.axes((width - reach) / 2, 1.7 * line, reach, 0.65 * line)
    colour_bar(figure, box, panel.scale)
    directions(boxes.axes(gap / 2, 0.4 * line, 3.4 * line, 3.4 * line), camera, style)
    return figure
