"""Views of the deformed shell, drawn by VTK without text or colour bar."""

import ctypes
import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.vtu import unstructured_grid

if TYPE_CHECKING:  # VTK takes long to import
    import pyvista

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
MARGIN = 10  # pixels around what is drawn


class NoScreen(RuntimeError):
    """There is no display to draw the shell on."""


@dataclass(frozen=True)
class Arrows:
    """Arrows at points (n, 3) with vectors (n, 3); a matplotlib colour, and the radius of the shafts."""

    places: Array
    vectors: Array
    colour: str
    radius: float


@dataclass(frozen=True)
class View:
    """One view.

    Attributes
    ----------
    smooth
        See `smooth_surface`.
    values
        (points,) values that are shown as colours.
    limits
        Values of the first and the last colour of `colours`, a matplotlib colour map.
    camera
        Direction (3,) from the shell to the eye; e3 is up.
    size
        Side of the window in pixels.
    caption
        The meaning of the colours.
    arrows
        Arrows in the view.
    bounds
        (xmin, xmax, ymin, ...) of the window's content; None fits it to the view.
    outlines
        Places (n, 3) along lines, of the sources of the field.
    """

    smooth: "pyvista.PolyData"
    values: Array
    limits: tuple[float, float]
    colours: str
    camera: Array
    size: int
    caption: str = ""
    arrows: tuple[Arrows, ...] = ()
    bounds: tuple[float, ...] | None = None
    outlines: tuple[Array, ...] = ()


def smooth_surface(surface: Surface, h: float) -> "pyvista.PolyData":
    """The deformed surface in flat triangles with normals; curved triangles are divided."""
    import pyvista
    from vtkmodules.vtkFiltersGeometry import vtkDataSetSurfaceFilter

    divided = vtkDataSetSurfaceFilter()
    divided.SetInputData(unstructured_grid(surface, h))
    divided.SetNonlinearSubdivisionLevel(2)
    divided.Update()
    smooth = pyvista.PolyData(divided.GetOutput())
    body = surface.is_body  # its edges stay sharp
    return smooth.compute_normals(cell_normals=False, split_vertices=body, feature_angle=60.0, consistent_normals=False)


def rendered(views: Sequence[View]) -> list[Image]:
    """An image (height, width, 3) of each view; images of one window size are cropped alike.

    Raises
    ------
    NoScreen
        If there is no display.
    """
    import pyvista

    pyvista.OFF_SCREEN = True
    with screen():
        plotter = pyvista.Plotter(off_screen=True)  # one for all views: creating it takes as long as a view
        try:
            plotter.set_background("white")
            plotter.enable_anti_aliasing("fxaa")  # looks as good as multisampling and takes half the time
            images = [_image(plotter, view) for view in views]
        finally:
            plotter.close()
    drawn = [(image != 255).any(axis=2) for image in images]
    boxes = {size: _box([d for d in drawn if d.shape == (size, size)]) for size in {view.size for view in views}}
    return [image[boxes[view.size]] for image, view in zip(images, views, strict=True)]


def _box(drawn: Sequence[NDArray[np.bool_]]) -> tuple[slice, slice]:
    """The part of the windows in which anything is drawn, with a margin."""
    anywhere = np.any(drawn, axis=0)
    rows, columns = (np.flatnonzero(anywhere.any(axis=axis)) for axis in (1, 0))
    high, left = (max(at[0] - MARGIN, 0) for at in (rows, columns))
    return slice(high, rows[-1] + MARGIN), slice(left, columns[-1] + MARGIN)


def _image(plotter: "pyvista.Plotter", view: View) -> Image:
    shown = view.smooth.copy(deep=False)
    shown.point_data["shown"] = view.values
    surface = plotter.add_mesh(
        shown,
        scalars="shown",
        clim=view.limits,
        cmap=view.colours,
        smooth_shading=True,
        ambient=0.25,  # keeps colours readable on the dark side
        diffuse=0.8,
        show_scalar_bar=False,
        copy_mesh=False,
        render=False,
    )
    drawn = [surface, *(_arrows(plotter, arrows) for arrows in view.arrows)]
    drawn += [plotter.add_lines(line, color="dimgray", width=2, connected=True) for line in view.outlines]
    plotter.render_window.SetSize(view.size, view.size)
    plotter.camera.focal_point, plotter.camera.up = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
    plotter.camera.position = view.camera
    plotter.reset_camera(render=False, bounds=view.bounds)
    image = np.array(plotter.screenshot(return_img=True))
    for actor in drawn:
        plotter.remove_actor(actor, render=False)
    return image


def _arrows(plotter: "pyvista.Plotter", arrows: Arrows) -> "pyvista.Actor":
    import pyvista
    from matplotlib.colors import to_rgb

    points, length = pyvista.PolyData(arrows.places), np.linalg.norm(arrows.vectors, axis=1).max()
    points.point_data["v"] = arrows.vectors
    thickness = arrows.radius / length  # relative to an arrow of length one
    shape = pyvista.Arrow(shaft_radius=thickness, tip_radius=2.5 * thickness, tip_length=0.35, shaft_resolution=12)
    glyphs = points.glyph(orient="v", scale="v", geom=shape)
    return plotter.add_mesh(glyphs, color=to_rgb(arrows.colour), ambient=0.35, smooth_shading=False, render=False)


def axes_on_screen(camera: Array) -> Array:
    """The components (3, 2) of e1, e2, e3 to the right and up on the screen, seen from `camera`."""
    towards = camera / np.linalg.norm(camera)
    right = np.cross([0.0, 0.0, 1.0], towards)
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(towards, right)])


@contextmanager
def screen() -> Iterator[None]:
    """A display to render on inside `with`: the user's if it answers, otherwise a virtual one.

    Raises
    ------
    NoScreen
        If there is neither a display nor Xvfb.
    """
    given = os.environ.get("DISPLAY")
    if given and _can_be_opened():
        yield
        return
    if shutil.which("Xvfb") is None:
        raise NoScreen("no display and no Xvfb to draw the deformed shell on")
    read, write = os.pipe()
    with_us = ["setpriv", "--pdeathsig", "TERM"] if shutil.which("setpriv") else []  # ends with us
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
            raise NoScreen("Xvfb did not start")
        os.environ["DISPLAY"] = f":{number}"
        yield
    finally:
        os.environ.pop("DISPLAY", None)
        os.environ.update({"DISPLAY": given} if given else {})
        server.terminate()
        server.wait()


def _can_be_opened() -> bool:
    """Whether the display of the environment answers; if it does not, VTK would end the process."""
    try:
        x11 = ctypes.CDLL("libX11.so.6")
    except OSError:
        return True  # VTK draws without X11
    x11.XOpenDisplay.restype, x11.XCloseDisplay.argtypes = ctypes.c_void_p, [ctypes.c_void_p]
    display = x11.XOpenDisplay(None)
    if display:
        x11.XCloseDisplay(display)
    return bool(display)
