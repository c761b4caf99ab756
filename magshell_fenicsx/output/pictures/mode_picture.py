"""Pictures of modes and null vectors."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from magshell_fenicsx.case.output import OutputSection
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.pictures.bars import SIGNED
from magshell_fenicsx.output.pictures.colours import Coloured
from magshell_fenicsx.output.pictures.layout import drawing
from magshell_fenicsx.output.pictures.small import small_panels
from magshell_fenicsx.output.pictures.view import Camera

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure

SHOWN = 0.08  # drawn size of a mode's largest displacement, over R
CAPTION = "$w$ of the mode over its largest"


def modes_figure(
    surfaces: Sequence[Surface], captions: Sequence[str], style: OutputSection, camera: Camera
) -> "Figure":
    """Draw one small panel per mode: the deformed shell plus the mode, coloured by the mode's normal displacement.

    Parameters
    ----------
    surfaces
        With the fields "mode" and "mode_w"; see `fields.modes`.
    captions
        Of the panels, in matplotlib's mathematics.
    """
    moved = [replace(surface, u=surface.u + SHOWN * surface.fields["mode"]) for surface in surfaces]
    layers = []
    for surface in surfaces:
        w = surface.fields["mode_w"]
        layers.append(Coloured("mode_w", w / (np.abs(w).max() or 1.0), (-1.0, 1.0), SIGNED, CAPTION))
    with drawing(style):
        return small_panels(moved, layers, captions, style, camera)
