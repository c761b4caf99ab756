"""ensemble.png: panels that have something to show."""

from pathlib import Path

import matplotlib.figure
import numpy as np
import pytest

from magshell_fenicsx.studies.ensemble.picture import draw_ensemble
from magshell_fenicsx.studies.ensemble.statistics import RESULT


@pytest.mark.parametrize(
    ("samples", "labels"),
    [
        (4, ["probability of a smaller value"]),
        (24, ["probability density", "probability of a smaller value"]),
    ],
)
def test_few_samples_have_no_density(
    samples: int, labels: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four samples are steps of the distribution function alone; 24 have Weibull's density too."""
    drawn: list[matplotlib.figure.Figure] = []
    monkeypatch.setattr(
        matplotlib.figure.Figure, "savefig", lambda figure, file: drawn.append(figure)
    )
    values = 0.3 + 0.02 * np.random.default_rng(1).weibull(2.0, samples)
    draw_ensemble(
        [{RESULT: float(value)} for value in values], "knockdown", tmp_path / "ensemble.png"
    )
    assert [axes.get_ylabel() for axes in drawn[0].axes] == labels
