"""A scene in a notebook: the deformed surface as arrays and for pyvista, and pictures without
files.

All functions are collective. Results that only rank 0 has are None on other ranks.
"""

import os
import sys
from collections.abc import Sequence
from functools import partial
from select import select
from shutil import which
from subprocess import DEVNULL, PIPE, Popen
from typing import TYPE_CHECKING, Any, Literal

from magshell_fenicsx.output.fields.gathering import gatherer
from magshell_fenicsx.output.fields.surface import Surface, turned, whole
from magshell_fenicsx.output.fields.vtu import unstructured_grid
from magshell_fenicsx.output.pictures.curve import curve_figure
from magshell_fenicsx.output.pictures.layout import png
from magshell_fenicsx.output.pictures.picture import PICTURES, figures
from magshell_fenicsx.output.pictures.view import run_camera
from magshell_fenicsx.output.store.known import pole_of
from magshell_fenicsx.quantities.registry import axes_of
from magshell_fenicsx.runs.rows import rows
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene

if TYPE_CHECKING:  # take long to import
    import pyvista
    from matplotlib.figure import Figure

STARTING = 20.0  # s in which a virtual display is there
_displays: list[Popen[bytes]] = []  # the pipes to those that were started


def surface(scene: Scene, record: Record) -> Surface | None:
    """The whole deformed mid-surface as NumPy arrays, lengths in R: `r0`, `u`, `n0`, `w`, `cells`
    and `fields`.

    The fields are membrane strains `E` and bending moments over D/R `M`, their principal values
    `E_1`, `E_2`, `M_1`, `M_2`, and those of the magnetic field: `Br`, `Ba`, `p_mag`, `f_mag`, `k`,
    `tau`; see `Surface`.
    """
    problem, state = scene.problem, record.point.state
    scene.refuse_foreign(state)
    base = gatherer(scene.model, scene.comm).gather(state.u, state.mu)
    return (
        turned(whole(base, problem.mirror) if problem.mirror else base, problem.azimuth)
        if base
        else None
    )


def polydata(scene: Scene, record: Record) -> "pyvista.PolyData | None":
    """The deformed mid-surface in flat triangles, for pyvista, with w_over_h, u_over_h, ... at its
    points.

    `points` (n, 3) and `regular_faces` (m, 3) are the nodes in R and the triangles as NumPy arrays;
    `plot(scalars="w_over_h")` shows it, after `off_screen()` also where there is no display.
    """
    drawn = surface(scene, record)
    return _smooth(drawn, scene.problem.material.h) if drawn else None


def off_screen() -> None:
    """Let pyvista draw without windows, also where there is no display; otherwise it ends the whole
    program there.

    VTK needs a display even for pictures in files. Where `DISPLAY` names none, a virtual one is
    started (Xvfb, Debian's package xvfb) that lasts as long as this process.

    Raises
    ------
    RuntimeError
        If there is no display and no Xvfb, or it does not start.
    """
    import pyvista

    pyvista.OFF_SCREEN = True
    if os.environ.get("DISPLAY") or sys.platform != "linux":
        return
    if not which("Xvfb"):
        raise RuntimeError(
            "pyvista: finds no display, and there is no Xvfb to make one: install the package xvfb"
        )
    read, number = os.pipe()
    made = f"Xvfb -displayfd {number} -noreset -screen 0 1600x1200x24 -nolisten tcp & cat; kill $!"
    with os.fdopen(read) as shown:
        try:
            # the shell waits for this process: a display that ended before VTK has left it would
            # end the process too a ^C in the terminal is not for the display
            quiet: dict[str, Any] = {
                "stdout": DEVNULL,
                "stderr": DEVNULL,
                "start_new_session": True,
            }
            shell = Popen(["sh", "-c", made], stdin=PIPE, pass_fds=[number], **quiet)
        finally:
            os.close(number)
        _displays.append(shell)
        ready, _, _ = select([shown], [], [], STARTING)
        said = (
            shown.readline().strip() if ready else ""
        )  # the whole line: Xvfb ends if it cannot write that
    if not said.isdecimal():
        raise RuntimeError("pyvista: finds no display, and Xvfb has made none")
    os.environ["DISPLAY"] = f":{said}"


def picture(
    scene: Scene,
    record: Record,
    of: Literal["shell", "strains", "stretches", "moments", "fields", "magnetic_loads"] = "shell",
) -> "Figure | None":
    """One picture of a run, as in shell.png, strains.png, ...; None also if the scene has no such
    fields.
    """
    if of not in PICTURES:
        raise ValueError(f"picture: {of}: allowed are {', '.join(PICTURES)}")
    drawn_surface = surface(scene, record)
    if drawn_surface is None:
        return None
    style = scene.problem.output
    drawn = figures(
        drawn_surface, scene.problem.material.h, style, run_camera(drawn_surface, style), [of]
    )
    return _in_line(drawn[of]) if drawn else None


def curve(scene: Scene, records: Sequence[Record], amplitude: str | None = None) -> "Figure":
    """The curve of the path, as in curve.png; by default for the amplitude that varied last.

    Raises
    ------
    ValueError
        If nothing has varied, or the scene has no such amplitude.
    """
    records = list(records)
    varied = amplitude or (records[-1].amplitude if records else "")
    if not varied:
        raise ValueError(
            "curve: nothing has varied in these records: give those of follow or trace, all of them"
        )
    drawn, place = rows(scene, records), pole_of(scene.problem.document.data)
    axes = axes_of(varied, drawn[0])
    if not all(axis.name in drawn[0] for axis in axes):
        amplitudes = ", ".join(
            dict.fromkeys(record.amplitude for record in records if record.amplitude)
        )
        raise ValueError(
            f"curve: {varied}: the scene has no such amplitude; these records vary {amplitudes or 'none'}"
        )
    return _in_line(curve_figure(drawn, varied, scene.problem.output, place))


def _smooth(surface: Surface, h: float) -> "pyvista.PolyData":
    """Flat triangles with normals; curved triangles are divided."""
    import pyvista
    from vtkmodules.vtkFiltersGeometry import vtkDataSetSurfaceFilter

    divided = vtkDataSetSurfaceFilter()
    divided.SetInputData(unstructured_grid(surface, h, deformed=True))
    divided.SetNonlinearSubdivisionLevel(2)
    divided.Update()
    smooth = pyvista.PolyData(divided.GetOutput())
    body = surface.is_body  # its edges stay sharp
    return smooth.compute_normals(
        cell_normals=False, split_vertices=body, feature_angle=60.0, consistent_normals=False
    )


def _in_line(figure: "Figure") -> "Figure":
    """The same figure, which a notebook then shows without pyplot."""
    figure._repr_png_ = partial(png, figure)  # type: ignore[attr-defined]
    return figure
