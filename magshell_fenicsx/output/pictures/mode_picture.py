"""Pictures of modes and null vectors."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.layout import png
from magshell_fenicsx.output.pictures.picture import towards
from magshell_fenicsx.output.pictures.render import View, rendered, smooth_surface

SHOWN = 0.08  # drawn size of a mode's largest displacement, over R


def draw_modes(surfaces: Sequence[Surface], captions: Sequence[str], title: str) -> bytes:
    """Draw one panel per mode: the deformed shell plus the mode, coloured by the mode's normal displacement.

    Parameters
    ----------
    surfaces
        With the fields "mode" and "mode_w"; see `fields.modes`.
    captions, title
        Captions of the panels and title of the picture, in matplotlib's mathematics.

    Returns
    -------
    A PNG file.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize
    from matplotlib.figure import Figure

    first = surfaces[0]
    camera = towards(first.r0[np.argmax(np.abs(first.fields["mode_w"]))])  # the same camera for all panels
    panels = rendered([_mode(surface, camera) for surface in surfaces])
    columns = int(np.ceil(np.sqrt(len(panels))))
    rows = -(-len(panels) // columns)
    height, width = panels[0].shape[:2]
    figure = Figure(
        figsize=(3.6 * columns + 1.2, (3.6 * height / width + 0.3) * rows + 0.6), dpi=150, layout="constrained"
    )
    axes = figure.subplots(rows, columns, squeeze=False)
    for place in axes.flat:
        place.set_axis_off()
    for place, panel, caption in zip(axes.flat, panels, captions, strict=False):
        place.imshow(panel)
        place.set_title(caption, fontsize=10)
    colours = ScalarMappable(Normalize(-1, 1), cmap="RdBu_r")
    bar = figure.colorbar(colours, ax=axes, shrink=0.8, aspect=30, ticks=[-1, -0.5, 0, 0.5, 1])
    bar.set_label("inward normal displacement\nover its largest", fontsize=9)
    figure.suptitle(title, fontsize=10)
    return png(figure)


def _mode(surface: Surface, camera: NDArray[np.float64]) -> View:
    v, w = surface.fields["mode"], surface.fields["mode_w"]
    moved = replace(surface, u=surface.u + SHOWN * v, fields={"mode_w": w / (np.abs(w).max() or 1.0)})
    smooth = smooth_surface(moved, 1.0)
    return View(smooth, smooth.point_data["mode_w"], (-1.0, 1.0), "RdBu_r", camera, 1000)
