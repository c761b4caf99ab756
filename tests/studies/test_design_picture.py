"""design.png: which results share an axis."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from magshell_fenicsx.studies.design.picture import ReachedShape, draw_design

MANY = [
    "buckling_pressure_Pa",
    "mass",
    "tip_uz_mm",
    "w_mm",
    "knockdown",
    "tip_fz_N",
    "hertz_1",
    "hertz_2",
]


@pytest.mark.parametrize(
    ("results", "labels"),
    [
        (MANY, ["buckling pressure  (Pa)", "results", "mm", "$f_z$ of tip  (N)", "Hz"]),
        (["mass"], ["mass"]),
        (["critical_field", "force"], ["critical field", "force"]),
    ],
)
def test_one_axis_for_each_unit(
    results: list[str], labels: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, file: drawn.append(figure))
    row: dict[str, Any] = {"evaluation": 1, "best": True, **dict.fromkeys(results, 1.0)}
    nothing: Any = SimpleNamespace(controls=None, fields=[], blocks={})
    draw_design(
        [row, {**row, "evaluation": 2, results[0]: None}],
        results,
        nothing,
        np.zeros(0),
        tmp_path / "d.png",
    )
    axes = drawn[0].axes
    assert [each.get_ylabel() for each in axes] == labels
    assert sum(len(each.lines) for each in axes) == 2 * len(results)
    assert [bool(each.get_xlabel()) for each in axes] == [False] * (len(labels) - 1) + [True]


def test_the_remanence_is_drawn_on_the_edges_of_the_shell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From above, where the shell is flat; results of several points share what they are."""
    drawn: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, file: drawn.append(figure))
    places, edges = (
        np.eye(3) * [1.0, 1.0, 0.0],
        np.array([[0.0, 0, 0], [2, 0, 0], [np.nan] * 3, [2, 1, 0], [0, 1, 0]]),
    )
    vary: Any = SimpleNamespace(
        controls=SimpleNamespace(places=places, is_axisymmetric=False),
        vectors=lambda x: np.eye(3),
        remanence=SimpleNamespace(planar=False),
        fields=[],
        blocks={},
    )
    row: dict[str, Any] = {"evaluation": 1, "best": True, "east_fz": 1.0, "west_fz": 2.0}
    shape = ReachedShape(None, places, places, edges)
    draw_design([row], ["east_fz", "west_fz"], vary, np.zeros(0), tmp_path / "d.png", shape=shape)
    history, remanence = drawn[0].axes
    assert history.get_ylabel() == "$f_z$"
    assert any(
        np.array_equal(line.get_xydata(), edges[:, :2], equal_nan=True) for line in remanence.lines
    )
