"""The modes and null vectors of a run as figures, from the files of its folder."""

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from magshell_fenicsx.case.output import OutputSection
from magshell_fenicsx.output.fields.modes import mode_caption, mode_file, wave_number
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.output.fields.vtu import read_vtu
from magshell_fenicsx.output.pictures.captions import named_value
from magshell_fenicsx.output.pictures.curve import numbered
from magshell_fenicsx.output.pictures.mode_picture import modes_figure
from magshell_fenicsx.output.pictures.view import Camera
from magshell_fenicsx.output.store.durable import Damaged
from magshell_fenicsx.output.store.table import LOCATED, Row
from magshell_fenicsx.quantities.registry import OWN_MODES, amplitude

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure

MOST_PANELS = 12


@dataclass(frozen=True)
class Mode:
    """A mode of stability.csv."""

    label: str
    eigenvalue: float


def mode_figures(
    folder: Path, rows: Sequence[Row], style: OutputSection, camera: Camera
) -> Iterator[tuple[str, "Figure"]]:
    """`instabilities` of the null vectors, and `modes_NNNN` of the modes in stability.csv."""
    numbers = numbered(rows)
    singular = [row for row in rows if row["label"] in LOCATED]
    if panels := [panel for row in singular if (panel := _null_vector(folder, row, numbers))]:
        yield "instabilities", _figure(panels, style, camera)
    table = folder / "stability.csv"
    if not table.exists():
        return
    try:
        with table.open(encoding="utf-8", newline="") as stream:
            listed = [
                (int(line["point"]), Mode(line["mode"], float(line["eigenvalue"]))) for line in csv.DictReader(stream)
            ]
    except (KeyError, ValueError, TypeError, csv.Error) as e:
        raise Damaged(f"{table}: is damaged: {type(e).__name__}: {e}") from None
    for row in rows:
        point = int(row["point"])
        modes = [mode for number, mode in listed if number == point]
        files = [(mode_file(folder, point, str(n), mode.label), n, mode) for n, mode in enumerate(modes, 1)]
        if panels := [(read_vtu(file)[0], mode_caption(n, mode)) for file, n, mode in files if file.exists()]:
            yield f"modes_{point:04d}", _figure(panels, style, camera)


def _figure(panels: Sequence[tuple[Surface, str]], style: OutputSection, camera: Camera) -> "Figure":
    surfaces, captions = zip(*panels[:MOST_PANELS], strict=True)
    return modes_figure(surfaces, captions, style, camera)


def _null_vector(folder: Path, row: Row, numbers: dict[int, int]) -> tuple[Surface, str] | None:
    """The surface with a null vector, and its caption: number, kind, where on the path."""
    label = "" if row["mode"] in OWN_MODES else str(row["mode"])
    file = mode_file(folder, int(row["point"]), str(row["label"]), label)
    if not file.exists():
        return None
    surface, _ = read_vtu(file)
    details = [str(row["mode"])] if row["mode"] else []
    if not label and (m := wave_number(surface)):
        details.append(f"m = {m}")
    details = [detail.replace("m = ", "$m$ = ") for detail in details]
    kind = f" ({', '.join(details)})" if details else ""
    column = amplitude(str(row["amplitude"])).column
    where = f"\n{named_value(column, row, 5)}" if row["amplitude"] else ""
    return surface, f"{numbers[int(row['point'])]}: {row['label']}{kind}{where}"
