"""Modes and null vectors on the whole deformed shell: fields for ParaView, tables, captions.

A half shell is completed by the symmetric or antisymmetric mirror image of the mode. Waves are
given by coefficients along the meridian, which are evaluated around the axis. Files of gradients
and of frequencies are here too.

The label of a mode is its symmetry: "m = 7" for waves around e3, "torsion", "antisymmetric" to a
symmetry plane, or empty for the model's own symmetry. A gatherer collects the fields of a model on
rank 0. omega2 is ω² ρ R²/E, with the angular frequency ω, the density ρ, the reference length R and
Young's modulus E. A result's gradient is its derivative by a field of the shell.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import pi, sqrt
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.output.fields.gathering import Gatherer
from magshell_fenicsx.output.fields.ring import waves_around
from magshell_fenicsx.output.fields.surface import Surface, completed_by_symmetry, rotated_surface
from magshell_fenicsx.output.fields.vtu import ShellData, vtu_content
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.table import read_csv, table_text
from magshell_fenicsx.quantities.mode_labels import ANTISYMMETRIC, WAVES, waves_of_label
from magshell_fenicsx.shells.revolution import Revolution
from magshell_fenicsx.shells.waves import wave_in_space

if TYPE_CHECKING:  # one of them is built
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel
    from magshell_fenicsx.shells.solid import SolidModel

Array = NDArray[np.float64]
CREST_TOLERANCE = 1e-6  # relative to the largest normal component of a mode
COLUMNS = ("point", "number", "mode", "eigenvalue")


class LabelledEigenvalue(Protocol):
    """Anything with the label and the eigenvalue of a mode, computed or read from a file."""

    @property
    def label(self) -> str: ...

    @property
    def eigenvalue(self) -> float: ...


def mode_surface(
    model: "ShellModel | MeridianModel | SolidModel",
    gatherer: Gatherer,
    u: Vector,
    label: str,
    vector: Vector,
    azimuth: float = 0.0,
    mu: Mapping[str, float] | None = None,
) -> Surface | None:
    """Return the whole shell displaced by u, with a mode as its fields; collective.

    Parameters
    ----------
    u
        This rank's part of the displacement.
    label
        "m = 7" or "torsion" of a meridian: `vector` has the coefficients (U + V, V, W) of a wave.
        "antisymmetric": the other half of the mode is the opposite of its mirror image. Any other
        label: the mode has the symmetry of the model.
    vector
        This rank's part of the mode.
    azimuth
        Azimuth of the model's frame (rad).
    mu
        Amplitude -> value; needed where imperfections grow.

    Returns
    -------
    On rank 0 the surface with the fields "mode" (n, 3), scaled to a largest length of one, and
    "mode_w" (n,), the component of the mode along -n0; None on other ranks.
    """
    if (m := waves_of_label(label)) is not None and model.axisymmetric:
        if gatherer.comm.rank:
            return None
        displaced_meridian, wave = _revolved_wave(model, u, m, vector)
        return _with_mode(displaced_meridian, wave)
    # the mode is gathered like a displacement: it is the `u` of a second surface
    displaced, mode = gatherer.gather(u, mu), gatherer.gather(vector)
    if displaced is None or mode is None:  # on other ranks than 0
        return None
    surface = _with_mode(displaced, mode.u)
    if model.multiplicity > 1:  # the model is a half or a sector
        assert not model.axisymmetric
        surface = completed_by_symmetry(surface, model.mirror)
        if label == ANTISYMMETRIC:
            # nodes of the modelled half come first, those of its image after them
            for values in surface.fields.values():
                values[len(displaced.r0) :] *= -1
    return rotated_surface(surface, azimuth)


def mode_file(folder: Path, point: int, name: str, label: str) -> Path:
    """Return the path of the file of a mode in a run's folder.

    Parameters
    ----------
    folder
        Folder of the run.
    point
        Number of the point on the path.
    name
        "fold" or "bifurcation" for a null vector, otherwise the number of the mode.
    label
        Label of the mode; empty for the model's own symmetry.

    Examples
    --------
    >>> mode_file(Path("out"), 12, "bifurcation", "m = 7").as_posix()
    'out/fields/mode_0012_bifurcation_m7.vtu'
    """
    suffix = f"_{label.replace(' = ', '')}" if label else ""
    return folder / "fields" / f"mode_{point:04d}_{name}{suffix}.vtu"


def write_mode(file: Path, surface: Surface, shell_data: ShellData) -> None:
    """Write the surface of `mode_surface` as a .vtu file; rank 0 calls it alone.

    In ParaView, `Warp By Vector` with "mode" shows the mode.

    Raises
    ------
    OSError
        If the disk is full; the file is not written then.
    """
    write_whole(file, vtu_content(surface, shell_data))


def mode_table(by_point: Mapping[int, Sequence[LabelledEigenvalue]]) -> bytes:
    """Return the content of stability.csv, with eigenvalues over E h/R².

    `by_point` maps the number of a point to its modes, ascending in eigenvalues.
    """
    lines = list[tuple[int, int, str, float]]()
    for point, modes in by_point.items():
        for number, mode in enumerate(modes, 1):
            lines.append((point, number, mode.label, mode.eigenvalue))
    return table_text([COLUMNS, *lines], end="\n").encode()


def mode_caption(number: int, mode: LabelledEigenvalue) -> str:
    r"""Return the caption of a mode: number, label and eigenvalue, in matplotlib's mathematics.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> mode_caption(2, SimpleNamespace(label="m = 7", eigenvalue=-1.5e-6))
    '2 ($m$ = 7):  $\\lambda = -1.5 \\times 10^{-6}$'
    """
    mantissa, _, exponent = f"{mode.eigenvalue:.4g}".partition("e")
    value = rf"{mantissa} \times 10^{{{int(exponent)}}}" if exponent else mantissa
    label = f" ({mode.label.replace('m = ', '$m$ = ')})" if mode.label else ""
    return rf"{number}{label}:  $\lambda = {value}$"


def _with_mode(base: Surface, v: Array) -> Surface:
    """Return the surface with a mode v (n, 3) as its fields, scaled to a largest length of one.

    The fields are "mode" and its inward normal component "mode_w". The sign is such that the mode
    points inward at the first node where its normal component has its largest magnitude.
    """
    inward = -np.einsum("ij,ij->i", v, base.n0)
    magnitude = np.abs(inward)
    # the crests and troughs of a wave have magnitudes that differ only by rounding: the first one
    # is taken
    first_crest = np.argmax(magnitude > (1 - CREST_TOLERANCE) * magnitude.max())
    largest_length = np.linalg.norm(v, axis=1).max()
    scale = np.copysign(largest_length, inward[first_crest])
    return replace(base, fields={"mode": v / scale, "mode_w": inward / scale})


def _revolved_wave(
    model: "MeridianModel", u: Vector, m: int, vector: Vector
) -> tuple[Surface, Array]:
    """Return the surface of revolution of a displaced meridian, and a wave (n, 3) at its nodes.

    The surface has at least twelve sectors for each wave.

    Parameters
    ----------
    u
        Displacement of the meridian.
    m
        Number of waves; 0: torsion.
    vector
        Coefficients (U + V, V, W) at the nodes of the meridian.
    """
    sectors = max(96, 12 * m)  # 96 even without waves, for a round picture
    swept = Revolution(model, sectors)
    # numbers of the circles of nodes in the function space of the waves
    vertices = swept.vertices(model.waves.V)
    theta = np.arange(sectors) * 2 * np.pi / sectors
    v = wave_in_space(vector.reshape(-1, 3)[vertices][:, None], m, theta)  # (circles, sectors, 3)
    surface = Surface(swept.r0, swept.displacement(u), swept.n0, swept.cells, fields={})
    return surface, swept.at_nodes(v)


def wave_number(surface: Surface) -> int | None:
    """Return the number m >= 2 of a mode's waves around e3, counted on one ring of the surface.

    None if no single number fits, or the mesh does not resolve so many waves.
    """
    waves = waves_around(surface)
    return waves.number if waves and waves.resolved else None


GRADIENT_PREFIX = "gradients_"
CURVATURES = ("curvature_11", "curvature_22", "curvature_12")


def columns_of(field_name: str) -> tuple[str, ...]:
    """Return the names of the arrays in the file of a field's gradient.

    The remanence is one vector; the curvature has three components.
    """
    return CURVATURES if field_name == "curvature" else (field_name,)


def gradient_file(folder: Path, result: str) -> Path:
    """Return the path of the file of a result's gradients in a run's folder.

    Examples
    --------
    >>> gradient_file(Path("out"), "knockdown").as_posix()
    'out/fields/gradients_knockdown.vtu'
    """
    return folder / "fields" / f"{GRADIENT_PREFIX}{result}.vtu"


def gradient_files(folder: Path) -> dict[str, Path]:
    """Return result -> file of its gradients, for all such files in a run's folder."""
    return {
        file.stem.removeprefix(GRADIENT_PREFIX): file
        for file in sorted((folder / "fields").glob(f"{GRADIENT_PREFIX}*.vtu"))
    }


NAME = "frequencies.csv"
NUMBERS = ("point", "wave", "omega2", "hertz")
ERRORS = ("omega2_error", "hertz_error")  # estimated, at the last point
# relative change of omega2 if the bodies in contact are four times as stiff
CONTACT_CHANGE = "contact_change"


@dataclass(frozen=True)
class Frequency:
    """A natural frequency: one row of frequencies.csv.

    Attributes
    ----------
    point
        Number of the point on the path.
    wave
        Circumferential wave number, such as "7", or symmetry of the mode, such as "antisymmetric".
    omega2
        Square of the angular frequency, ω² ρ R²/E; negative for an unstable mode.
    hertz
        Frequency in Hz; nan without a density, and for an unstable mode, which does not vibrate.
    """

    point: int
    wave: str
    omega2: float
    hertz: float


def wave_of(label: str, symmetric_wave: str) -> str:
    """Return the circumferential wave number or the symmetry of a mode, from its label.

    `symmetric_wave` is the result for modes with the model's own symmetry, whose label is empty.

    Examples
    --------
    >>> wave_of("m = 7", "0"), wave_of("", "0"), wave_of("antisymmetric", "symmetric")
    ('7', '0', 'antisymmetric')
    """
    return label.removeprefix(WAVES) if label else symmetric_wave


def hertz(omega2: float, time_unit: float | None) -> float | None:
    """Return a frequency in Hz from omega2 = ω² ρ R²/E.

    `time_unit` is R √(ρ/E) in s. None without that unit, and for an unstable mode.
    """
    return sqrt(omega2) / (2 * pi * time_unit) if time_unit and omega2 >= 0 else None


def frequency_table(
    by_point: Mapping[int, Sequence[LabelledEigenvalue]],
    symmetric_waves: Mapping[int, str],
    time_unit: float | None,
    contact_changes: Mapping[int, Sequence[float]],
    errors: Mapping[int, Mapping[str, float]],
) -> bytes:
    """Return the content of frequencies.csv: the modes of each point, in their order.

    Parameters
    ----------
    by_point
        Number of a point -> its modes, whose eigenvalues are omega2.
    symmetric_waves
        Number of a point -> the wave of modes with the model's own symmetry.
    time_unit
        R √(ρ/E) in s; None without a density.
    contact_changes
        Number of a point -> for each of its modes the value of the column `CONTACT_CHANGE`. Empty
        without bodies; the table then has no such column.
    errors
        Number of a point -> estimated errors, "omega2_1", "hertz_1" and so on, of its modes.
    """
    head = (*NUMBERS, CONTACT_CHANGE) if contact_changes else NUMBERS
    lines: list[Sequence[Any]] = [(*head, *ERRORS)]
    for point, modes in by_point.items():
        for number, mode in enumerate(modes):
            errors_of_point = errors.get(point, {})
            lines.append(
                (
                    point,
                    wave_of(mode.label, symmetric_waves[point]),
                    mode.eigenvalue,
                    hertz(mode.eigenvalue, time_unit),
                    *([contact_changes[point][number]] if contact_changes else []),
                    errors_of_point.get(f"omega2_{number + 1}"),
                    errors_of_point.get(f"hertz_{number + 1}"),
                )
            )
    return table_text(lines, end="\n").encode()


def read_frequencies(folder: Path) -> list[Frequency]:
    """Return the rows of frequencies.csv in a run's folder; empty without that file."""

    def frequency_of(line: Mapping[str, str]) -> Frequency:
        # an empty cell: without a density, or of an unstable mode
        hertz_or_nan = float(line["hertz"] or "nan")
        return Frequency(int(line["point"]), line["wave"], float(line["omega2"]), hertz_or_nan)

    return read_csv(folder / NAME, frequency_of) if (folder / NAME).exists() else []
