"""A scene in a notebook: the deformed surface as arrays and for pyvista, pictures without files.

All functions are collective. Results that only rank 0 has are None on other ranks. A scene is the
model of a problem with its solver; a record is a point of its path. An amplitude is a load
parameter. Lengths are over R, the reference length; h is the thickness, D the bending stiffness.
"""

import os
import sys
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from math import nan
from select import select
from shutil import which
from subprocess import DEVNULL, PIPE, Popen
from typing import TYPE_CHECKING, Any, Literal

from magshell_fenicsx.output.fields.gathering import gatherer
from magshell_fenicsx.output.fields.surface import Surface, completed_by_symmetry, rotated_surface
from magshell_fenicsx.output.fields.vtu import unstructured_grid
from magshell_fenicsx.output.pictures.colours import sizes_at
from magshell_fenicsx.output.pictures.curve import curve_figure
from magshell_fenicsx.output.pictures.layout import png
from magshell_fenicsx.output.pictures.picture import PICTURES, figures
from magshell_fenicsx.output.pictures.rendering import run_camera
from magshell_fenicsx.output.store.stored_results import pole_of
from magshell_fenicsx.parts.magnetism.fields import FIELD
from magshell_fenicsx.quantities.quantity import NO_UNITS
from magshell_fenicsx.quantities.registry import axes_of
from magshell_fenicsx.runs.rows import rows
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene

if TYPE_CHECKING:  # take long to import
    import pyvista
    from matplotlib.figure import Figure

DISPLAY_TIMEOUT = 20.0  # s in which a virtual display starts
_displays: list[Popen[bytes]] = []  # the virtual displays that were started


def surface(scene: Scene, record: Record) -> Surface | None:
    """Return the whole deformed mid-surface as NumPy arrays, on rank 0; collective.

    The arrays are `r0`, `u`, `n0`, `w`, `cells` and `fields`, with lengths in R. The fields are
    membrane strains `E` and bending moments over D/R `M`, their principal values `E_1`, `E_2`,
    `M_1`, `M_2`, and those of the magnetic field: `Br`, `Ba`, `p_mag`, `f_mag`, `k`, `tau`; see
    `Surface`.

    Parameters
    ----------
    record
        A point of a history of the scene.
    """
    Scene.refuse_other_arguments("surface", scene, [record])
    problem, state = scene.problem, record.point.state
    scene.refuse_foreign(state)
    # the modelled part, then the whole shell, in the frame of the case
    modelled = gatherer(scene.model, scene.comm).gather(state.u, state.mu)
    if modelled is None:
        return None
    shell = completed_by_symmetry(modelled, problem.mirror) if problem.mirror else modelled
    return rotated_surface(shell, problem.azimuth)


def polydata(scene: Scene, record: Record) -> "pyvista.PolyData | None":
    """Return the deformed mid-surface in flat triangles, for pyvista.

    Its points have w_over_h, u_over_h, .... `points` (n, 3) and `regular_faces` (m, 3) are the
    nodes in R and the triangles as NumPy arrays; `plot(scalars="w_over_h")` shows it, after
    `off_screen()` also where there is no display.
    """
    shell = surface(scene, record)
    return _smooth(shell, scene.problem.material.h) if shell else None


def off_screen() -> None:
    """Let pyvista draw without windows, also where there is no display.

    Without a display VTK would end the whole program, even for pictures in files. Where `DISPLAY`
    names none, a virtual display (Xvfb, Debian's package xvfb) is started. It lasts as long as this
    process.

    Raises
    ------
    RuntimeError
        If there is no display and no Xvfb, or Xvfb does not start.
    """
    import pyvista

    pyvista.OFF_SCREEN = True
    if os.environ.get("DISPLAY") or sys.platform != "linux":
        return
    if not which("Xvfb"):
        raise RuntimeError(
            "pyvista: finds no display, and there is no Xvfb to make one: install the package xvfb"
        )
    # Xvfb chooses a free number for the display, and writes it into the pipe. `cat` waits until
    # this process ends, which closes its input; then the display is killed.
    read_end, write_end = os.pipe()
    command = (
        f"Xvfb -displayfd {write_end} -noreset -screen 0 1600x1200x24 -nolisten tcp & cat; kill $!"
    )
    with os.fdopen(read_end) as stream:
        try:
            # The shell waits for this process: a display that ended before VTK has left it would
            # end the process too. A ^C in the terminal is not for the display.
            options: dict[str, Any] = {
                "stdout": DEVNULL,
                "stderr": DEVNULL,
                "start_new_session": True,
            }
            shell_process = Popen(
                ["sh", "-c", command], stdin=PIPE, pass_fds=[write_end], **options
            )
        finally:
            os.close(write_end)  # Xvfb has its own: if it ends, the pipe ends too
        _displays.append(shell_process)
        # the number of the display, or nothing if Xvfb does not write in time; it writes the whole
        # line at once, or ends
        readable, _, _ = select([stream], [], [], DISPLAY_TIMEOUT)
        name = stream.readline().strip() if readable else ""
    if not name.isdecimal():
        raise RuntimeError("pyvista: finds no display, and Xvfb has made none")
    os.environ["DISPLAY"] = f":{name}"


def picture(
    scene: Scene,
    record: Record,
    of: Literal["shell", "strains", "stretches", "moments", "fields", "magnetic_loads"] = "shell",
) -> "Figure | None":
    """Return one picture of a point of a run, as shell.png, strains.png, ... have it.

    None on ranks other than 0, and if the scene has no such fields.

    Parameters
    ----------
    record
        The point.
    of
        Name of the picture.

    Raises
    ------
    ValueError
        If there is no such picture.
    """
    if of not in PICTURES:
        raise ValueError(f"picture: {of}: allowed are {', '.join(PICTURES)}")
    shell = surface(scene, record)
    if shell is None:
        return None
    style, camera = scene.problem.output, run_camera(shell, scene.problem.output)
    has_one_thickness = scene.model.thickness is None
    sizes = replace(scene.sizes.case_sizes or NO_UNITS, has_one_thickness=has_one_thickness)
    mu = record.point.state.mu
    is_turned = any(mu.get(name) for name in FIELD.components)
    sizes = sizes_at(sizes, shell, nan if is_turned else mu.get(FIELD.name, nan))
    pictures = figures(shell, scene.problem.material.h, style, camera, [of], sizes)
    return _in_line(pictures[of]) if pictures else None


def curve(scene: Scene, records: Sequence[Record], amplitude: str | None = None) -> "Figure":
    """Return the curve of a path, as in curve.png; by default for the amplitude that varied last.

    Parameters
    ----------
    records
        All points of the path.
    amplitude
        Name of the amplitude on the curve.

    Raises
    ------
    ValueError
        If nothing has varied, or the scene has no such amplitude.
    """
    records = list(records)
    Scene.refuse_other_arguments("curve", scene, records)
    name = amplitude or (records[-1].amplitude if records else "")
    if not name:
        raise ValueError(
            "curve: nothing has varied in these records: give those of follow or trace, all of them"
        )
    table_rows = rows(scene, records)
    pole = pole_of(scene.problem.document.data)
    # the columns of both axes must be there
    axes = axes_of(name, table_rows[0])
    if not all(axis.name in table_rows[0] for axis in axes):
        varied = dict.fromkeys(record.amplitude for record in records if record.amplitude)
        raise ValueError(
            f"curve: {name}: the scene has no such amplitude; "
            f"these records vary {', '.join(varied) or 'none'}"
        )
    return _in_line(curve_figure(table_rows, name, scene.problem.output, pole))


def _smooth(surface: Surface, h: float) -> "pyvista.PolyData":
    """Return the deformed surface as flat triangles with normals; curved triangles are divided.

    `h` is the thickness over R.
    """
    import pyvista
    from vtkmodules.vtkFiltersGeometry import vtkDataSetSurfaceFilter

    divided = vtkDataSetSurfaceFilter()
    divided.SetInputData(unstructured_grid(surface, h, deformed=True))
    divided.SetNonlinearSubdivisionLevel(2)  # each side in four
    divided.Update()
    smooth = pyvista.PolyData(divided.GetOutput())
    body = surface.is_body  # its edges stay sharp
    # normals of points alone; the cells of a surface are oriented alike already
    return smooth.compute_normals(
        cell_normals=False, split_vertices=body, feature_angle=60.0, consistent_normals=False
    )


def _in_line(figure: "Figure") -> "Figure":
    """Return a figure after giving it the method by which a notebook shows it without pyplot."""
    figure._repr_png_ = partial(png, figure)  # type: ignore[attr-defined]
    return figure
