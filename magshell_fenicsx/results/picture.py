"""A picture of the deformed shell, coloured by w/h."""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pyvista

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
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "1600x1200x24", "-nolisten", "tcp"],
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
    return unstructured_grid(surface, h).extract_surface(nonlinear_subdivision=4)


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
        deepest = surface.r0[np.argmax(np.abs(surface.w))]
        heading = np.arctan2(deepest[1], deepest[0]) if np.hypot(*deepest[:2]) > 0.1 else -np.pi / 3
        plotter.camera_position = [
            (4.2 * np.cos(heading - 0.5), 4.2 * np.sin(heading - 0.5), 3.2),
            (0, 0, 0.45),
            (0, 0, 1),
        ]
        plotter.reset_camera()
        plotter.camera.zoom(1.15)
        plotter.show_axes()
        plotter.screenshot(file)
        plotter.close()


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
