"""The registry of quantities: the contract of path.csv, and labels that can be drawn."""

import pytest
from matplotlib.mathtext import MathTextParser

from magshell_fenicsx import Case, Scene, columns, follow
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.output.report.verdict import path_table
from magshell_fenicsx.output.store.table import COLUMNS
from magshell_fenicsx.quantities.registry import (
    AMPLITUDES,
    QUANTITIES,
    amplitude,
    axes_of,
    quantity,
)

FIRST_RELEASE = """
point label amplitude p_over_pc lambda_m force w_over_h w_from_field_over_h w_pole_over_h
volume_change energy negative_pivots negative_pivots_held iterations factorisations wall_s
stretching bending magnetic U1 Uq Utau mode
field_angle branch w_point_over_h error_over_h load_error excluded_pivots
"""


def test_no_column_is_renamed_or_moved() -> None:
    """Others read path.csv: columns are only added."""
    assert list(COLUMNS)[: len(FIRST_RELEASE.split())] == FIRST_RELEASE.split()


def test_a_run_has_the_columns_of_every_run() -> None:
    data = {
        "shell": {"geometry": "disc", "radius_to_thickness": 20, "poisson_ratio": 0.3},
        "boundary": {"rim": "clamped"},
        "loading": {
            "kind": "pressure",
            "control": "load",
            "until": "target",
            "pressure": 0.1,
            "points": 1,
        },
        "mesh": {"degree": 2},
    }
    scene = Scene(Case.from_source(Source("disc", data)))
    found = columns(scene, follow(scene))
    assert list(found) == [name for name in COLUMNS if name != "wall_s"]


@pytest.mark.parametrize("name", QUANTITIES)
def test_labels_can_be_drawn(name: str) -> None:
    known, parser = QUANTITIES[name], MathTextParser("path")
    assert known.meaning.endswith(".")
    for text in (known.latex, known.label):
        assert parser.parse(text).width > 0
    assert known.ascii_symbol.isascii()


@pytest.mark.parametrize("name", AMPLITUDES)
def test_an_amplitude_leads_to_columns(name: str) -> None:
    assert amplitude(name).column in QUANTITIES
    assert {each.name for each in axes_of(name)} == {
        amplitude(name).column,
        amplitude(name).conjugate,
    }


def test_ones_own_amplitude_is_called_by_its_name() -> None:
    over, drawn = axes_of("my_term")
    assert (over.label, drawn.label) == ("displacement of the pole  $w/h$", "my term")


def test_only_named_points_have_the_unit_of_lengths() -> None:
    """In the report one's own amplitude has no unit."""
    lines = [
        {"point": str(i), "label": "step", "my_term": str(i), "A_ux": str(i)} for i in range(2)
    ]
    units = {str(column.head): str(column.unit).strip() for column in path_table(lines, "m")}
    assert (units["my term"], units["A ux"]) == ("", "m")


def test_force_has_one_symbol_in_all_spellings() -> None:
    force = quantity("force")
    assert (force.ascii_symbol, force.latex, force.html) == (
        "F R/(2piD)",
        r"$F R/(2\pi D)$",
        "F R/(2πD)",
    )
