"""Pictures of the deformed shell: its displacement, the magnetic loads on it, its modes."""

import io
import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyvista
from numpy.typing import NDArray

from magshell_fenicsx.results.surface import Surface
from magshell_fenicsx.results.vtu import unstructured_grid


@contextmanager
def screen() -> Iterator[None]:
    """A display to render on: the user's, or a virtual one while inside.

    Raises
    ------
    RuntimeError
        If there is neither a display nor Xvfb.
    """
    if os.environ.get("DISPLAY"):
        yield
        return
    if shutil.which("Xvfb") is None:
        raise RuntimeError("no display and no Xvfb to draw the deformed shell on")
    read, write = os.pipe()
    with_us = ["setpriv", "--pdeathsig", "TERM"] if shutil.which("setpriv") else []  # even if we are killed
    server = subprocess.Popen(
        [*with_us, "Xvfb", "-displayfd", str(write), "-screen", "0", "1600x1200x24", "-nolisten", "tcp"],
        pass_fds=[write],
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    try:
        with os.fdopen(read) as stream:
            number = stream.readline().strip()
        if not number:
            raise RuntimeError("Xvfb did not start")
        os.environ["DISPLAY"] = f":{number}"
        yield
    finally:
        os.environ.pop("DISPLAY", None)
        server.terminate()
        server.wait()


def smooth_surface(surface: Surface, h: float) -> pyvista.PolyData:
    """The deformed surface in flat triangles, each curved one divided."""
    return unstructured_grid(surface, h).extract_surface(nonlinear_subdivision=2)


def draw_shell(surface: Surface, h: float, title: str, file: Path) -> None:
    """Draw the deformed mid-surface with its colour bar, seen so that the deepest place shows."""
    pyvista.OFF_SCREEN = True
    smooth = smooth_surface(surface, h)
    with screen():
        plotter = pyvista.Plotter(off_screen=True, window_size=(1200, 1000))
        limit = float(np.abs(surface.w).max() / h) or 1.0
        plotter.add_mesh(
            smooth,
            scalars="w_over_h",
            cmap="RdBu_r",
            clim=(-limit, limit),
            smooth_shading=True,
            scalar_bar_args={"title": "w/h", "n_labels": 5, "fmt": "%.3g", "color": "black", "vertical": True},
        )
        plotter.add_text(title, font_size=10, color="black")
        plotter.set_background("white")
        _look_at(plotter, surface.r0[np.argmax(np.abs(surface.w))])
        plotter.camera.zoom(1.15)
        plotter.show_axes()
        plotter.screenshot(file)
        plotter.close()


def _look_at(plotter: pyvista.Plotter, place: NDArray[np.float64]) -> None:
    """From above, from the side where `place` (3,) shows."""
    heading = np.arctan2(place[1], place[0]) if np.hypot(*place[:2]) > 0.1 else -np.pi / 3
    plotter.camera_position = [
        (4.2 * np.cos(heading - 0.5), 4.2 * np.sin(heading - 0.5), 3.2),
        (0, 0, 0.45),
        (0, 0, 1),
    ]
    plotter.reset_camera()


LOADS = {
    "p_mag": "magnetic pressure p_mag",
    "f_mag": "in-plane force |f_mag|",
    "k": "stiffness of rotational springs k",
    "tau": "torque |tau(u)|",
}


def draw_loads(surface: Surface, h: float, title: str, file: Path) -> None:
    """Draw the magnetic energy read as loads, one panel each, on the deformed shell."""
    pyvista.OFF_SCREEN = True
    smooth = smooth_surface(surface, h)
    shown = [name for name in LOADS if name in surface.fields]
    with screen():
        plotter = pyvista.Plotter(off_screen=True, shape=(2, 2), window_size=(1600, 1300), border=False)
        for i, name in enumerate(shown):
            plotter.subplot(i // 2, i % 2)
            values = smooth.point_data[name]
            panel = smooth.copy()
            panel.point_data[LOADS[name]] = np.linalg.norm(values, axis=1) if values.ndim == 2 else values
            bar = {"title": LOADS[name] + "\n", "n_labels": 4, "fmt": "%.3g", "color": "black"}
            plotter.add_mesh(panel, scalars=LOADS[name], cmap="viridis", smooth_shading=True, scalar_bar_args=bar)
            plotter.camera_position = [(2.2, -3.6, 3.0), (0, 0, 0.15), (0, 0, 1)]
            plotter.reset_camera()
        plotter.subplot(0, 0)
        plotter.add_text(title, font_size=9, color="black")
        plotter.set_background("white")
        plotter.screenshot(file)
        plotter.close()


SHOWN = 0.08  # lengths R that the largest displacement of a mode is drawn with


def draw_modes(surfaces: Sequence[Surface], captions: Sequence[str], title: str) -> bytes:
    """Draw modes, one panel each: the deformed shell with the mode added, coloured by its normal displacement.

    Parameters
    ----------
    surfaces
        With the fields "mode" and "mode_w"; see `results.modes`.
    captions, title
        Of the panels and of all, with matplotlib's mathematics.

    Returns
    -------
    A PNG file.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    first = surfaces[0]
    place = first.r0[np.argmax(np.abs(first.fields["mode_w"]))]  # one view of all, so that they can be compared
    with screen():
        panels = _cropped(np.stack([_mode_panel(surface, place) for surface in surfaces]))
    columns = int(np.ceil(np.sqrt(len(panels))))
    rows = -(-len(panels) // columns)
    height, width = panels.shape[1:3]
    size = (3.6 * columns + 1.2, (3.6 * height / width + 0.3) * rows + 0.6)
    figure, axes = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for place in axes.flat:
        place.set_axis_off()
    for place, panel, caption in zip(axes.flat, panels, captions, strict=False):
        place.imshow(panel)
        place.set_title(caption, fontsize=10)
    colours = plt.cm.ScalarMappable(plt.Normalize(-1, 1), cmap="RdBu_r")
    bar = figure.colorbar(colours, ax=axes, shrink=0.8, aspect=30, ticks=[-1, -0.5, 0, 0.5, 1])
    bar.set_label("inward normal displacement\nover its largest", fontsize=9)
    figure.suptitle(title, fontsize=10)
    content = io.BytesIO()
    figure.savefig(content, format="png", dpi=150)
    plt.close(figure)
    return content.getvalue()


def _mode_panel(surface: Surface, place: NDArray[np.float64]) -> NDArray[np.uint8]:
    """One mode as an image (height, width, 3) without text, seen so that `place` (3,) shows."""
    pyvista.OFF_SCREEN = True
    v, w = surface.fields["mode"], surface.fields["mode_w"]
    moved = replace(surface, u=surface.u + SHOWN * v, fields={"mode_w": w / (np.abs(w).max() or 1.0)})
    plotter = pyvista.Plotter(off_screen=True, window_size=(1200, 1000))
    plotter.add_mesh(
        smooth_surface(moved, 1.0),
        scalars="mode_w",
        cmap="RdBu_r",
        clim=(-1, 1),
        smooth_shading=True,
        show_scalar_bar=False,
    )
    plotter.set_background("white")
    _look_at(plotter, place)
    picture = np.asarray(plotter.screenshot(return_img=True))
    plotter.close()
    return picture


def _cropped(pictures: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Images (n, height, width, 3) without the white margin that all have, but for 20 pixels."""
    darkest = np.min(pictures, axis=(0, 3))
    rows, columns = (np.flatnonzero(np.min(darkest, axis=axis) < 255) for axis in (1, 0))
    high, low, left, right = max(rows[0] - 20, 0), rows[-1] + 20, max(columns[0] - 20, 0), columns[-1] + 20
    return pictures[:, high:low, left:right]
