"""The picture of a comparison: both curves, their difference, error against run time."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from magshell_fenicsx.quantities.registry import amplitude, quantity
from magshell_fenicsx.studies.compare.curves import Difference, amplitude_of, curve
from magshell_fenicsx.studies.compare.runs import ModelRun

Errors = Mapping[str, Sequence[tuple[float, float]]]


def draw_comparison(
    shell: ModelRun, solid: ModelRun, found: Sequence[Difference], errors: Errors, title: str, file: Path
) -> None:
    """Write the picture.

    Parameters
    ----------
    errors
        Model -> (relative error, CPU seconds) of its coarser runs; without any the panel is left out.
    """
    from matplotlib.figure import Figure

    panels = 1 + bool(found) + any(errors.values())
    figure = Figure(figsize=(4.4 * panels, 3.7), dpi=160, layout="constrained")
    varied = amplitude(amplitude_of(shell))
    x_label, y_label = f"{quantity('w_over_h').latex} {varied.place} since the field", quantity(varied.column).label
    first, *others = figure.subplots(1, panels, squeeze=False)[0]
    first.plot(*curve(shell), ".-", color="C0", markersize=4, linewidth=1, label=f"shell, {shell.dofs} unknowns")
    first.plot(*curve(solid), "o", color="C3", markersize=4, fillstyle="none", label=f"solid, {solid.dofs} unknowns")
    first.set(xlabel=x_label, ylabel=y_label)
    first.legend(frameon=False, fontsize=8)
    if found:
        others[0].plot([d.w_over_h for d in found], [100 * d.relative for d in found], ".-", color="C3")
        others[0].axhline(0, color="0.8", linewidth=0.8, zorder=0)
        others[0].set(xlabel=x_label, ylabel="solid over shell, difference (%)")
    if any(errors.values()):
        for (model, points), color in zip(errors.items(), ("C0", "C3"), strict=True):
            if ordered := sorted((s, e) for e, s in points):
                others[-1].loglog(*zip(*ordered, strict=True), "o-", color=color, label=model)
        others[-1].set(xlabel="CPU time of the process (s)", ylabel="relative error, of each model's own limit")
        others[-1].grid(which="both", color="0.92")
        others[-1].legend(frameon=False, fontsize=8)
    figure.suptitle(title, fontsize=9)
    figure.savefig(file)
