"""Outlines of sources and bodies: where the amplitudes have driven them, written and read again."""

from pathlib import Path

import numpy as np
from conftest import CASES

from magshell_fenicsx import Case
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.output.fields.vtu import DRIVEN, STILL, outlines, read_outlines, vtp_content

TURN = "{kind: source, name: roll, turn: {axis: [0, 1, 0], angle: 90}}"
STEPS = f"loading=[{{kind: field}}, {{kind: source, move: [0, 0, 6 mm]}}, {TURN}]"
POSITION = np.array([40.0, 0, -60]) / 30


def test_outlines(tmp_path: Path) -> None:
    """A cylinder of 20 x 10 mm: still, then half way up and lying on its side; the files hold the same lines."""
    still = outlines(make_problem(Case.load(CASES / "magnet_strip.yaml")).loads, {}, 0.0)
    size = np.ptp(np.concatenate(still) - POSITION, axis=0) * 30
    np.testing.assert_allclose(size, [20, 20, 10], atol=1e-12)
    driven = make_problem(Case.load(CASES / "magnet_strip.yaml", [STEPS])).loads
    lying = outlines(driven, {"source": 0.5, "roll": 1.0}, 0.0)
    middle = (np.concatenate(lying).max(axis=0) + np.concatenate(lying).min(axis=0)) / 2
    np.testing.assert_allclose(middle - POSITION, [0, 0, 0.1], atol=1e-12)
    np.testing.assert_allclose(np.ptp(np.concatenate(lying), axis=0) * 30, [10, 20, 20], atol=1e-12)
    (tmp_path / STILL).write_bytes(vtp_content(still))
    (tmp_path / DRIVEN.format(3)).write_bytes(vtp_content(lying))
    for number, lines in ((2, still), (3, lying)):
        for found, line in zip(read_outlines(tmp_path, number), lines, strict=True):
            np.testing.assert_allclose(found, line, atol=1e-6)
    assert read_outlines(tmp_path / "none", 0) == ()


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
        np.testing.assert_allclose(np.ptp(lines, axis=0)[:2].min(), wide, rtol=3e-3)
