"""Outlines of sources and bodies: where the amplitudes have driven them, written and read again."""

from pathlib import Path

import numpy as np
import pytest
import pyvista
from conftest import CASES

from magshell_fenicsx import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.output.fields.outlines import (
    FILE_OF_ALL_POINTS,
    FILE_OF_POINT,
    outlines,
    read_outlines,
    solids,
    vtp_content,
)
from magshell_fenicsx.shape.drawn_bodies import cylinder, globe

TURN = "{kind: source, name: roll, turn: {axis: [0, 1, 0], angle: 90}}"
STEPS = f"loading=[{{kind: field}}, {{kind: source, move: [0, 0, 6 mm]}}, {TURN}]"
POSITION = np.array([40.0, 0, -60]) / 30


def test_outlines(tmp_path: Path) -> None:
    """A cylinder of 20 x 10 mm: still, then half way up and lying on its side; the files hold the
    same lines.
    """
    still = outlines(make_problem(Case.load(CASES / "magnet_strip.yaml")).loads, {}, 0.0)
    size = np.ptp(np.concatenate(still) - POSITION, axis=0) * 30
    np.testing.assert_allclose(size, [20, 20, 10], atol=1e-12)
    driven = make_problem(Case.load(CASES / "magnet_strip.yaml", [STEPS])).loads
    lying = outlines(driven, {"source": 0.5, "roll": 1.0}, 0.0)
    middle = (np.concatenate(lying).max(axis=0) + np.concatenate(lying).min(axis=0)) / 2
    np.testing.assert_allclose(middle - POSITION, [0, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(np.ptp(np.concatenate(lying), axis=0) * 30, [10, 20, 20], atol=1e-12)
    (magnet,) = solids(driven, {"source": 0.5, "roll": 1.0}, 0.0)
    assert magnet.name == "cylinder magnet"
    assert magnet.poles is not None
    assert np.ptp(magnet.points, axis=0) * 30 == pytest.approx([10, 20, 20])
    north = magnet.points[magnet.poles > 0].mean(axis=0) - magnet.points[magnet.poles < 0].mean(
        axis=0
    )
    assert north / np.linalg.norm(north) == pytest.approx(
        [1, 0, 0], abs=1e-12
    )  # it was e3 before the quarter turn
    (tmp_path / FILE_OF_ALL_POINTS).write_bytes(vtp_content(still))
    (tmp_path / FILE_OF_POINT.format(3)).write_bytes(vtp_content(lying, [magnet]))
    for number, lines in ((2, still), (3, lying)):
        for found, line in zip(read_outlines(tmp_path, number)[0], lines, strict=True):
            np.testing.assert_allclose(found, line, atol=1e-6)
    _, (same,) = read_outlines(tmp_path, 3)
    assert same.name == magnet.name
    assert same.points == pytest.approx(magnet.points, abs=1e-6)
    assert (same.triangles == magnet.triangles).all()
    shown = pyvista.read(tmp_path / FILE_OF_POINT.format(3))
    assert (shown.n_lines, shown.n_faces_strict) == (len(lying), len(magnet.triangles))
    assert list(shown.field_data["names"]) == [magnet.name]
    assert read_outlines(tmp_path / "none", 0) == ((), ())


def test_bodies_are_where_their_approach_has_brought_them() -> None:
    """A ball above the pole; a plate, a rod, a cylinder and a box: as far down e3 as they came."""
    h = 1 / 90
    for kind, wide in (
        ("kind: sphere, radius: 0.2", 0.4),
        ("kind: plane", 1.0),
        ("kind: rod, radius: 0.1, edge: 0.01", 0.2),
        ("kind: cylinder, radius: 0.1, axis: [1, 0, 0]", 0.2),
        ("kind: box, size: [0.2, 0.3, 0.1], edge: 0.01, axis: [1, 0, 0]", 0.2),
    ):
        case = Case.load(CASES / "ball_contact.yaml", [f"bodies={{ball: {{{kind}}}}}"])
        lines = np.concatenate(outlines(make_problem(case).loads, {"approach": 3.0}, h))
        np.testing.assert_allclose(lines[:, 2].min(), 1 + h / 2 - 3 * h, atol=1e-12)
        (solid,) = solids(make_problem(case).loads, {"approach": 3.0}, h)
        assert solid.name == "ball"
        assert solid.poles is None
        assert [solid.points.min(axis=0), solid.points.max(axis=0)] == pytest.approx(
            np.array([lines.min(axis=0), lines.max(axis=0)]), abs=2e-3
        )
        np.testing.assert_allclose(np.ptp(lines, axis=0)[:2].min(), wide, rtol=3e-3)


def test_a_sphere_has_no_creases() -> None:
    """Its poles once had: the cosine of 90 degrees is 6e-17. Lines around it made a black spot."""
    ball = globe(2.0)
    assert ball.creases == []
    corners = ball.points[ball.triangles]
    areas = (
        np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        / 2
    )
    assert areas.sum() == pytest.approx(16 * np.pi, rel=1e-2)
    assert len(cylinder(1.0, 2.0).creases) > 0
