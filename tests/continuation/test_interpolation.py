"""Stationary points of a cubic that is given by its rise and its slopes at 0 and 1."""

import pytest

from magshell_fenicsx.continuation.interpolation import flat_beyond, stationary


def test_stationary_points_of_a_cubic() -> None:
    """The cubic with the slope (t - 0.3) (t - 2)."""
    rise, slope_at_0, slope_at_1 = 1 / 3 - 2.3 / 2 + 0.6, 0.6, -0.7
    assert stationary(rise, slope_at_0, slope_at_1) == pytest.approx(0.3, rel=1e-12)
    assert flat_beyond(rise, slope_at_0, slope_at_1) == pytest.approx(2.0, rel=1e-12)
