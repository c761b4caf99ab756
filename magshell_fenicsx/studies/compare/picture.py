"""compare.png: both curves, their differences, and the errors over run time."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from magshell_fenicsx.quantities.registry import amplitude, quantity
from magshell_fenicsx.studies.compare.curves import Difference, amplitude_of, curve
from magshell_fenicsx.studies.compare.model_runs import ModelRun
from magshell_fenicsx.studies.figures import add_legend, saved_figure

Errors = Mapping[str, Sequence[tuple[float, float]]]


def draw_comparison(
    shell: ModelRun,
    solid: ModelRun,
    differing: Sequence[Difference],
    errors: Errors,
    title: str,
    file: Path,
) -> None:
    """Draw the curves of both finest runs, their differences and the errors over CPU time.

    Parameters
    ----------
    differing
        Differences between these curves; without any the panel is left out.
    errors
        Model -> (relative error, CPU seconds) of its coarser runs; without any the panel is left
        out.
    file
        Name of the picture file.
    """
    panels = 1 + bool(differing) + any(errors.values())
    load_amplitude = amplitude(amplitude_of(shell))
    x_label = f"{quantity('w_over_h').latex} {load_amplitude.place} since the field"
    y_label = quantity(load_amplitude.column).label
    with saved_figure(file, 4.4 * panels, 3.7, dpi=160) as figure:
        # the curves, then the differences if there are any, and last the errors if there are any
        first, *other_panels = figure.subplots(1, panels, squeeze=False)[0]
        _draw_curves(first, shell, solid)
        first.set(xlabel=x_label, ylabel=y_label)
        if differing:
            w, percent = zip(*((d.w_over_h, 100 * d.relative) for d in differing), strict=True)
            other_panels[0].plot(w, percent, ".-", color="C3")
            other_panels[0].axhline(0, color="0.8", linewidth=0.8, zorder=0)
            other_panels[0].set(xlabel=x_label, ylabel="solid over shell, difference (%)")
        if any(errors.values()):
            _draw_errors(other_panels[-1], errors)
        figure.suptitle(title, fontsize=9)


def _draw_curves(plot: Any, shell: ModelRun, solid: ModelRun) -> None:
    """Draw load over displacement of both models on the axes `plot`."""
    plot.plot(
        *curve(shell),
        ".-",
        color="C0",
        markersize=4,
        linewidth=1,
        label=f"shell, {shell.dofs} unknowns",
    )
    plot.plot(
        *curve(solid),
        "o",
        color="C3",
        markersize=4,
        fillstyle="none",
        label=f"solid, {solid.dofs} unknowns",
    )
    add_legend(plot)


def _draw_errors(plot: Any, errors: Errors) -> None:
    """Draw error over CPU time of both models on the axes `plot`, with logarithmic scales.

    Parameters
    ----------
    errors
        Model -> (relative error, CPU seconds) of its coarser runs.
    """
    for (model, errors_and_seconds), color in zip(errors.items(), ("C0", "C3"), strict=True):
        if seconds_and_errors := sorted((s, e) for e, s in errors_and_seconds):
            plot.loglog(*zip(*seconds_and_errors, strict=True), "o-", color=color, label=model)
    plot.set(
        xlabel="CPU time of the process (s)", ylabel="relative error, of each model's own limit"
    )
    plot.grid(which="both", color="0.92")
    add_legend(plot)
