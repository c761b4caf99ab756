"""frequencies.csv: the natural frequencies at points of a path."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import pi, sqrt
from pathlib import Path

from magshell_fenicsx.output.fields.modes import WAVES, Mode
from magshell_fenicsx.output.store.durable import Damaged

NAME = "frequencies.csv"
COLUMNS = ("point", "wave", "omega2", "hertz")
CONTACT_CHANGE = "contact_change"  # of omega2, relative, if the bodies that touch are four times as stiff


@dataclass(frozen=True)
class Frequency:
    """A row: omega2 is ω² ρ R²/E; hertz is nan without a density, and of an unstable mode, which does not vibrate."""

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
    found: Mapping[int, Sequence[Mode]],
    own: str,
    time_unit: float | None,
    contact_changes: Mapping[int, Sequence[float]],
) -> bytes:
    """The file: modes of each point, ascending; `contact_changes` is a column where there are bodies."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((*COLUMNS, CONTACT_CHANGE) if contact_changes else COLUMNS)
    for point, modes in found.items():
        for n, mode in enumerate(modes):
            f = hertz(mode.eigenvalue, time_unit)
            row = (point, wave_of(mode.label, own), repr(mode.eigenvalue), "" if f is None else repr(f))
            writer.writerow((*row, repr(contact_changes[point][n])) if contact_changes else row)
    return text.getvalue().encode()


def read_frequencies(folder: Path) -> list[Frequency]:
    """The rows of a run's folder; none without the file."""
    if not (folder / NAME).exists():
        return []
    try:
        with (folder / NAME).open(encoding="utf-8", newline="") as stream:
            return [
                Frequency(int(line["point"]), line["wave"], float(line["omega2"]), float(line["hertz"] or "nan"))
                for line in csv.DictReader(stream)
            ]
    except (KeyError, ValueError, TypeError, csv.Error) as e:
        raise Damaged(f"{folder / NAME}: is damaged: {type(e).__name__}: {e}") from None
