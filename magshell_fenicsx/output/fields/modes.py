"""Modes and null vectors on the whole deformed shell: fields for ParaView, a table, captions.

A half shell is completed by the symmetric or antisymmetric mirror image of the mode. The
coefficients of waves are evaluated around the axis.
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
from magshell_fenicsx.output.fields.surface import Surface, turned, whole
from magshell_fenicsx.output.fields.vtu import About, vtu_content
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.table import read_csv, table_text
from magshell_fenicsx.shells.modes import TORSION
from magshell_fenicsx.shells.revolution import Revolution

if TYPE_CHECKING:  # one of them is built
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel
    from magshell_fenicsx.shells.solid import SolidModel

Array = NDArray[np.float64]
WAVES = "m = "
COLUMNS = ("point", "number", "mode", "eigenvalue")


class Mode(Protocol):
    """What a mode's files need; see `shells.modes.ShellMode`."""

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
    """The whole shell displaced by u, with a mode as its fields; collective.

    Parameters
    ----------
    label, vector
        "m = 7", "torsion": the vector has the coefficients (U + V, V, W) of waves; "antisymmetric":
        the other half is the mirror image with the opposite sign; any other label: the mode has the
        model's own symmetry.
    azimuth
        Azimuth of the model's frame, rad.
    mu
        The amplitudes, where imperfections grow.

    Returns
    -------
    On rank 0 the surface with the fields "mode" (n, 3), scaled to a largest length of one, and "mode_w" (n,), its
    component along -n0; None on other ranks.
    """
    if (label.startswith(WAVES) or label == TORSION) and model.axisymmetric:
        if gatherer.comm.rank:
            return None
        m = 0 if label == TORSION else int(label.removeprefix(WAVES))
        return _with_mode(*_revolved_wave(model, u, m, vector))
    base, mode = gatherer.gather(u, mu), gatherer.gather(vector)
    if base is None or mode is None:
        return None
    surface = _with_mode(base, mode.u)
    if model.multiplicity > 1:
        assert not model.axisymmetric
        surface = whole(surface, model.mirror)
        if label == "antisymmetric":
            for values in surface.fields.values():
                values[len(base.r0) :] *= -1
    return turned(surface, azimuth)


def mode_file(folder: Path, point: int, name: str, label: str) -> Path:
    """The file of a mode.

    Parameters
    ----------
    name
        "fold" or "bifurcation" for a null vector, otherwise the number of the mode.

    Examples
    --------
    >>> mode_file(Path("out"), 12, "bifurcation", "m = 7").as_posix()
    'out/fields/mode_0012_bifurcation_m7.vtu'
    """
    suffix = f"_{label.replace(' = ', '')}" if label else ""
    return folder / "fields" / f"mode_{point:04d}_{name}{suffix}.vtu"


def write_mode(file: Path, surface: Surface, about: About) -> None:
    """Write the surface of `mode_surface`; in ParaView, `Warp By Vector` with "mode" shows it.

    Raises
    ------
    OSError
        If the disk is full; the file is not written then.
    """
    write_whole(file, vtu_content(surface, about))


def mode_table(by_point: Mapping[int, Sequence[Mode]]) -> bytes:
    """stability.csv: the modes of each point, in the order of their eigenvalues over E h/R^2."""
    listed = (
        (point, n, mode) for point, modes in by_point.items() for n, mode in enumerate(modes, 1)
    )
    lines = ((point, n, mode.label, mode.eigenvalue) for point, n, mode in listed)
    return table_text([COLUMNS, *lines], end="\n").encode()


def mode_caption(number: int, mode: Mode) -> str:
    """The caption of a panel: number, label and eigenvalue, in matplotlib's mathematics.

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> mode_caption(2, SimpleNamespace(label="m = 7", eigenvalue=-1.5e-6))
    '2 ($m$ = 7):  $\\\\lambda = -1.5 \\\\times 10^{-6}$'
    """
    mantissa, _, exponent = f"{mode.eigenvalue:.4g}".partition("e")
    value = rf"{mantissa} \times 10^{{{int(exponent)}}}" if exponent else mantissa
    label = f" ({mode.label.replace('m = ', '$m$ = ')})" if mode.label else ""
    return rf"{number}{label}:  $\lambda = {value}$"


def _with_mode(base: Surface, v: Array) -> Surface:
    """Scale a mode to a largest length of one, and inward at the first node where its normal
    component is largest.
    """
    inward = -np.einsum("ij,ij->i", v, base.n0)
    size = np.abs(inward)
    first = np.argmax(
        size > (1 - 1e-6) * size.max()
    )  # the crests and troughs of a wave differ only by rounding
    scale = np.copysign(np.linalg.norm(v, axis=1).max(), inward[first])
    return replace(base, fields={"mode": v / scale, "mode_w": inward / scale})


def _revolved_wave(
    model: "MeridianModel", u: Vector, m: int, vector: Vector
) -> tuple[Surface, Array]:
    """The surface with at least twelve sectors per wave, and the wave at its nodes.

    v = U cos(m theta) e_rho + V sin(m theta) e_theta + W cos(m theta) e_z; of m = 0, torsion, V
    e_theta.
    """
    sectors = max(96, 12 * m)
    swept = Revolution(model, sectors)
    U_and_V, V, W = vector.reshape(-1, 3)[swept.vertices(model.excluded_modes.waves.V)].T[
        :, :, None
    ]
    theta = np.arange(sectors) * 2 * np.pi / sectors
    cosine, sine = (np.cos(m * theta), np.sin(m * theta)) if m else (0 * theta, 1 + 0 * theta)
    radial, azimuthal = (U_and_V - V) * cosine, V * sine
    x, y = (
        radial * np.cos(theta) - azimuthal * np.sin(theta),
        radial * np.sin(theta) + azimuthal * np.cos(theta),
    )
    v = np.stack([x, y, W * cosine], axis=-1)
    return Surface(swept.r0, swept.displacement(u), swept.n0, swept.cells, {}), swept.at_nodes(v)


def wave_number(surface: Surface) -> int | None:
    """The number m >= 2 of waves of a mode around e3, see `ring.waves_around`.

    None also if the mesh does not resolve them.
    """
    waves = waves_around(surface)
    return waves.number if waves and waves.resolved else None


PREFIX = "gradients_"
CURVATURES = ("curvature_11", "curvature_22", "curvature_12")


def columns_of(by: str) -> tuple[str, ...]:
    """The names in the file of a field's gradient; that of the remanence is a vector."""
    return CURVATURES if by == "curvature" else (by,)


def gradient_file(folder: Path, of: str) -> Path:
    """The file of a result's gradients.

    Examples
    --------
    >>> gradient_file(Path("out"), "knockdown").as_posix()
    'out/fields/gradients_knockdown.vtu'
    """
    return folder / "fields" / f"{PREFIX}{of}.vtu"


def gradient_files(folder: Path) -> dict[str, Path]:
    """Result -> file of those in a folder."""
    return {
        file.stem.removeprefix(PREFIX): file
        for file in sorted((folder / "fields").glob(f"{PREFIX}*.vtu"))
    }


NAME = "frequencies.csv"
NUMBERS = ("point", "wave", "omega2", "hertz")
CONTACT_CHANGE = (
    "contact_change"  # of omega2, relative, if the bodies that touch are four times as stiff
)


@dataclass(frozen=True)
class Frequency:
    """A row: omega2 is ω² ρ R²/E; hertz is nan without a density, and of an unstable mode, which
    does not vibrate.
    """

    point: int
    wave: str
    omega2: float
    hertz: float


def wave_of(label: str, own: str) -> str:
    """The circumferential number or the symmetry of a mode; `own` is that of the model's own modes.

    Examples
    --------
    >>> wave_of("m = 7", "0"), wave_of("", "0"), wave_of("antisymmetric", "symmetric")
    ('7', '0', 'antisymmetric')
    """
    return label.removeprefix(WAVES) if label else own


def hertz(omega2: float, time_unit: float | None) -> float | None:
    """The frequency, with `time_unit` R √(ρ/E); None without it, and of an unstable mode."""
    return sqrt(omega2) / (2 * pi * time_unit) if time_unit and omega2 >= 0 else None


def frequency_table(
    by_point: Mapping[int, Sequence[Mode]],
    own: Mapping[int, str],
    time_unit: float | None,
    contact_changes: Mapping[int, Sequence[float]],
) -> bytes:
    """The file: modes of each point, ascending; `own` is the wave of its model's own modes.

    `contact_changes` is a column where there are bodies.
    """
    lines: list[Sequence[Any]] = [(*NUMBERS, CONTACT_CHANGE) if contact_changes else NUMBERS]
    for point, modes in by_point.items():
        for n, mode in enumerate(modes):
            row = (
                point,
                wave_of(mode.label, own[point]),
                mode.eigenvalue,
                hertz(mode.eigenvalue, time_unit),
            )
            lines.append((*row, contact_changes[point][n]) if contact_changes else row)
    return table_text(lines, end="\n").encode()


def read_frequencies(folder: Path) -> list[Frequency]:
    """The rows of a run's folder; none without the file."""

    def made(line: Mapping[str, str]) -> Frequency:
        return Frequency(
            int(line["point"]), line["wave"], float(line["omega2"]), float(line["hertz"] or "nan")
        )

    return read_csv(folder / NAME, made) if (folder / NAME).exists() else []
