"""Readings of magnetic sensors along a path as a picture.

A sensor is a point at which the flux density B is read; its components are the columns NAME_Bx,
NAME_By and NAME_Bz of path.csv, whose rows are the points of the path. A step (`CurveStep`) has the
rows of one load step. An amplitude is a load parameter, by name.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from magshell_fenicsx.output.pictures.curve import PlaceOf, draw_lines, legend, worth_drawing
from magshell_fenicsx.output.pictures.layout import INCH, ONE_COLUMN, TWO_COLUMNS, columns, drawing
from magshell_fenicsx.output.pictures.lines import curve_steps
from magshell_fenicsx.output.pictures.scales import number_format
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.parts.magnetism.fields import FIELD
from magshell_fenicsx.problem.requests import OutputSection
from magshell_fenicsx.quantities.registry import amplitude as registered
from magshell_fenicsx.quantities.registry import shown_quantity

if TYPE_CHECKING:  # takes long to import
    from matplotlib.figure import Figure

MAX_SENSORS = 6  # in the picture; path.csv has all
ZERO_READING = 1e-6  # over the largest reading: a smaller component is zero
MILLI = 1e3


def readings_figure(
    rows: Sequence[Row], amplitude: str, case: Mapping[str, Any], style: OutputSection
) -> "Figure":
    """Return the figure of what each magnetic sensor reads, over the load of the last step.

    Each panel has the components B_x, B_y and B_z of one sensor. Unstable parts are dashed.

    Parameters
    ----------
    rows
        Rows of path.csv.
    amplitude
        The amplitude that varied last.
    case
        The case of summary.json, with the names of its sensors.
    """
    from matplotlib.figure import Figure

    names, step = list(case["sensors"]), worth_drawing(curve_steps(rows, amplitude))[-1]
    load = shown_quantity(registered(step.amplitude).column, step.rows[0])
    size_of_unit, unit = unit_of(case)

    def over_load(column: str) -> PlaceOf:
        """Return a function from a row to the load and the reading of a column there."""
        return lambda row: (load.on_axis(row), size_of_unit * float(row[column]))

    readings = [f"{name}_B{axis}" for name in names for axis in "xyz"]
    largest = max(abs(float(row[column])) for column in readings for row in step.rows)
    # rows and columns of panels, one panel for each sensor
    panel_count = min(len(names), MAX_SENSORS)
    columns_of_panels = columns(panel_count)
    row_count = -(-panel_count // columns_of_panels)  # rounded up
    width = (style.width or (ONE_COLUMN if columns_of_panels == 1 else TWO_COLUMNS)) / INCH
    with drawing(style):
        figure = Figure(
            figsize=(width, 0.75 * width / columns_of_panels * row_count),
            dpi=style.dpi,
            layout="constrained",
        )
        grid = figure.subplots(row_count, columns_of_panels, squeeze=False).ravel()
        for axes, name in zip(grid, names, strict=False):
            for k, axis in enumerate("xyz"):
                column = f"{name}_B{axis}"
                # a component that is zero is left out
                if max(abs(float(row[column])) for row in step.rows) > ZERO_READING * largest:
                    draw_lines(axes, step, f"C{k}", over_load(column))
                    # an empty line, for the legend
                    axes.plot([], [], color=f"C{k}", lw=1.2, label=f"$B_{axis}$")
            axes.set(xlabel=load.label, ylabel=f"field at {name.replace('_', ' ')}  {unit}")
            axes.axhline(0, color="0.8", linewidth=0.8, zorder=0)
            for axis_of_panel in (axes.xaxis, axes.yaxis):
                axis_of_panel.set_major_formatter(number_format())
        for axes in grid[len(names) :]:  # panels without a sensor
            axes.set_axis_off()
        legend(figure, max_columns=5)
    return figure


def unit_of(case: Mapping[str, Any]) -> tuple[float, str]:
    r"""Return the factor from readings in path.csv to the drawn unit, and that unit in words.

    Examples
    --------
    >>> unit_of({"magnetic": {"remanent": {"flux_density": 0.08}}})
    (1000.0, '(mT)')
    >>> unit_of({"magnetic": {"remanent": {"flux_density": None}}})
    (1.0, '$B/|B^\\mathrm{r}|$')
    """
    # the sections of all remanences, of the case and of each of several shells
    magnetic = case.get("magnetic") or {}
    shells = (case.get("shells") or {}).values()
    remanences_of_shells = [shell["remanent"] for shell in shells if shell.get("remanent")]
    remanences = [
        section for section in (magnetic.get("remanent"), *remanences_of_shells) if section
    ]
    # B is in T where a remanence, or without one the field, is given in units
    if any(section.get("flux_density") for section in remanences):
        return MILLI, "(mT)"
    if remanences:
        return 1.0, r"$B/|B^\mathrm{r}|$"
    return (MILLI, "(mT)") if magnetic.get(FIELD.name) is None else (1.0, r"$B/\sqrt{\mu_0 E}$")
