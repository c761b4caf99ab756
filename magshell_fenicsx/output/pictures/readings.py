"""What sensors of the field read along a path."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from magshell_fenicsx.output.pictures.curve import PlaceOf, draw_lines, legend, worth_drawing
from magshell_fenicsx.output.pictures.layout import INCH, ONE, SEVERAL, columns, drawing
from magshell_fenicsx.output.pictures.lines import drawn_parts
from magshell_fenicsx.output.pictures.scales import number_format
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.quantities.registry import amplitude as registered
from magshell_fenicsx.quantities.registry import shown_quantity

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure

MOST = 6  # sensors in the picture; path.csv has all
SILENT = 1e-6  # of the largest reading: a component as small as this is zero
MILLI = 1e3


def readings_figure(
    rows: Sequence[Row], amplitude: str, case: Mapping[str, Any], style: OutputSection
) -> "Figure":
    """Draw the components that each sensor reads over the load of the last step; unstable parts are
    dashed.

    Parameters
    ----------
    case
        As in summary.json, with the names of its sensors.
    """
    from matplotlib.figure import Figure

    names, part = list(case["sensors"]), worth_drawing(drawn_parts(rows, amplitude))[-1]
    load = shown_quantity(registered(part.amplitude).column, part.rows[0])
    size, unit = unit_of(case)

    def over_load(column: str) -> PlaceOf:
        return lambda row: (load.on_axis(row), size * float(row[column]))

    largest = max(
        abs(float(row[f"{name}_B{axis}"])) for name in names for axis in "xyz" for row in part.rows
    )
    across = columns(min(len(names), MOST))
    high, wide = (
        -(-min(len(names), MOST) // across),
        (style.width or (ONE if across == 1 else SEVERAL)) / INCH,
    )
    with drawing(style):
        figure = Figure(
            figsize=(wide, 0.75 * wide / across * high), dpi=style.dpi, layout="constrained"
        )
        grid = figure.subplots(high, across, squeeze=False).ravel()
        for axes, name in zip(grid, names, strict=False):
            for k, axis in enumerate("xyz"):
                column = f"{name}_B{axis}"
                if max(abs(float(row[column])) for row in part.rows) > SILENT * largest:
                    draw_lines(axes, part, f"C{k}", over_load(column))
                    axes.plot([], [], color=f"C{k}", lw=1.2, label=f"$B_{axis}$")
            axes.set(xlabel=load.label, ylabel=f"field at {name.replace('_', ' ')}  {unit}")
            axes.axhline(0, color="0.8", linewidth=0.8, zorder=0)
            for each in (axes.xaxis, axes.yaxis):
                each.set_major_formatter(number_format())
        for axes in grid[len(names) :]:
            axes.set_axis_off()
        legend(figure, 5)
    return figure


def unit_of(case: Mapping[str, Any]) -> tuple[float, str]:
    """What one of a reading is in the unit that is drawn, and that unit.

    Examples
    --------
    >>> unit_of({"magnetic": {"remanent": {"flux_density": 0.08}}})
    (1000.0, '(mT)')
    >>> unit_of({"magnetic": {"remanent": {"flux_density": None}, "lambda_m": 1e-4}})
    (1.0, '$B/|B^\\\\mathrm{r}|$')
    """
    magnetic = case.get("magnetic") or {}
    own = [each["remanent"] for each in (case.get("shells") or {}).values() if each.get("remanent")]
    remanent = [each for each in (magnetic.get("remanent"), *own) if each]
    if any(each.get("flux_density") for each in remanent):
        return MILLI, "(mT)"
    if remanent:
        return 1.0, r"$B/|B^\mathrm{r}|$"
    return (MILLI, "(mT)") if magnetic.get("lambda_m") is None else (1.0, r"$B/\sqrt{\mu_0 E}$")
