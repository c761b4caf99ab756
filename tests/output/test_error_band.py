"""The band of estimated errors along a curve."""

import numpy as np
import pytest
from matplotlib.patches import Polygon

from magshell_fenicsx.output.pictures.curve import curve_figure
from magshell_fenicsx.output.pictures.error_band import errors_at_points
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.problem.requests import OutputSection


def path() -> list[Row]:
    """A path from the undeformed shell to a fold, and half of the way back."""
    loads = [0.0, 0.75, 1.0, 0.75]
    row: Row = {"amplitude": "pressure", "mode": "", "branch": 0, "negative_pivots": 0}
    return [
        row | {"point": i, "label": label, "p_over_pc": load, "volume_change": -0.1 * i}
        for i, (label, load) in enumerate(
            zip(["start", "step", "fold", "target"], loads, strict=True)
        )
    ]


def bands(errors: dict[str, float]) -> list[Polygon]:
    axes = curve_figure(path(), "pressure", OutputSection(), errors=errors).axes[0]
    return [patch for patch in axes.patches if isinstance(patch, Polygon)]


def test_band_is_as_wide_as_the_errors() -> None:
    """At the fold the curve is level: the band is twice the error of the load high."""
    errors = {"limit_load": 0.1, "p_over_pc@end": 0.05, "volume_change@end": 0.0}
    (band,) = bands(errors)
    places = np.asarray(band.get_xy())
    at_fold = places[np.abs(places[:, 0] - 0.2) < 0.003, 1]
    assert at_fold.max() == pytest.approx(1.1, abs=0.01)
    assert at_fold.min() == pytest.approx(0.9, abs=0.01)
    at_start = places[np.abs(places[:, 0]) < 1e-9]
    assert np.ptp(at_start, axis=0) == pytest.approx([0, 0], abs=1e-9)


def test_no_band_where_it_is_narrower_than_the_line() -> None:
    assert not bands({"limit_load": 1e-4, "p_over_pc@end": 1e-4})
    assert not bands({})


def test_later_instabilities_and_units() -> None:
    """The error of a load in a unit is in proportion to the load."""
    row: Row = {"amplitude": "pressure", "label": "fold", "branch": 0}
    rows = [row | {"point": i, "p_over_pc": 0.1 * i, "pressure_Pa": 50.0 * i} for i in (1, 2)]
    errors = errors_at_points(rows, {"limit_load": 0.01, "limit_load_2": 0.02})
    assert errors == {1: {"pressure_Pa": pytest.approx(5)}, 2: {"pressure_Pa": pytest.approx(10)}}
