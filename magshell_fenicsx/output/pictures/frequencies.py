"""Natural frequencies along the path as a picture."""

from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING

from magshell_fenicsx.case.output import OutputSection
from magshell_fenicsx.output.fields.frequencies import Frequency
from magshell_fenicsx.output.pictures.layout import INCH, ONE
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.quantities.registry import amplitude as registered
from magshell_fenicsx.quantities.registry import shown

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure

NAMED = 12  # most waves in the legend


def frequencies_figure(found: Sequence[Frequency], rows: Sequence[Row], style: OutputSection) -> "Figure":
    """ω² ρ R²/E over the amplitude that varied last; the n-th lowest of each wave is one line."""
    from matplotlib.figure import Figure

    varied = next((str(row["amplitude"]) for row in reversed(rows) if row["amplitude"]), "")
    column = shown(registered(varied).column, rows[0]) if varied else None
    places = {int(row["point"]): float(row[column.name]) if column else 0.0 for row in rows}
    lines = defaultdict[tuple[str, int], list[tuple[float, float]]](list)
    count = defaultdict[tuple[int, str], int](int)
    for it in (it for it in found if it.point in places):
        lines[it.wave, count[it.point, it.wave]].append((places[it.point], it.omega2))
        count[it.point, it.wave] += 1
    width = (style.width or ONE) / INCH
    figure = Figure(figsize=(width, 0.75 * width), dpi=style.dpi, layout="constrained")
    axes, waves = figure.subplots(), list(dict.fromkeys(wave for wave, _ in lines))
    for (wave, number), points in sorted(lines.items()):
        named = wave if number == 0 and waves.index(wave) < NAMED else None
        axes.plot(*zip(*points, strict=True), ".-", color=f"C{waves.index(wave) % 10}", label=named, lw=1, ms=4)
    axes.axhline(0, color="0.6", lw=0.6)
    axes.set(xlabel=column.label if column else "", ylabel=r"$\omega^2 \rho R^2/E$")
    if waves != [""]:
        axes.legend(title="wave", frameon=False)
    return figure
