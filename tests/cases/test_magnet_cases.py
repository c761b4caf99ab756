"""Strips and magnets: against a rod in the same field by SciPy, and a magnet that is driven past
and back.
"""

from pathlib import Path

import magpylib
import numpy as np
import pytest
import yaml
from conftest import CASES
from scipy.integrate import solve_bvp
from solved import result

from magshell_fenicsx import Case, Result
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.public import run

RADIUS, STACK = (
    16.913636363636364,
    0.7976,
)  # of a cap of cases/magnet_stack.yaml (mm), and k_d of the stack by degree 4
LENGTH, WIDTH, H, E, BR = 30e-3, 5e-3, 0.5e-3, 1e6, 0.1  # of cases/magnet_strip.yaml


def rod(position: tuple[float, float, float]) -> tuple[float, float]:
    """Displacement of the tip along x and z of a rod with stretch e and curvature k, by SciPy.

    Energy per length EA (e² - 1)²/8 + EI (e k)²/2 - c e B.t at each place, the field averaged over
    the width. Force n and moment M: n' = -c e grad(B.t), M' = -e n.d - c e B.d with the normal d,
    n.t = dW/de, M = dW/dk.
    """
    magnet = magpylib.magnet.Cylinder(
        dimension=(20e-3, 10e-3), polarization=(0, 0, 1.3), position=position
    )
    EA, EI, c = E * WIDTH * H, E * WIDTH * H**3 / 12, WIDTH * H * BR / magpylib.mu_0
    across, weights = np.polynomial.legendre.leggauss(3)

    def field(x: np.ndarray, z: np.ndarray) -> np.ndarray:
        places = [np.column_stack([x, np.full_like(x, WIDTH / 2 * a), z]) for a in across]
        return np.tensordot(weights / 2, [magnet.getB(p)[:, [0, 2]].T for p in places], 1)

    def rates(s: np.ndarray, y: np.ndarray, load: float, d: float = 1e-5) -> np.ndarray:
        x, z, a, nx, nz, M = y
        t, normal = np.array([np.cos(a), np.sin(a)]), np.array([-np.sin(a), np.cos(a)])
        B = load * c * field(x, z)
        slopes = [
            load * c * (field(x + d * i, z + d * j) - field(x - d * i, z - d * j)) / (2 * d)
            for i, j in np.eye(2)
        ]
        N, e = nx * t[0] + nz * t[1] + (B * t).sum(0), np.ones_like(x)
        for _ in range(10):
            e = e - (EA / 2 * (e**2 - 1) * e + M**2 / (EI * e**3) - N) / EA
        pull = [-e * (slope * t).sum(0) for slope in slopes]
        turn = -e * (nx * normal[0] + nz * normal[1] + (B * normal).sum(0))
        return np.stack([e * t[0], e * t[1], M / (EI * e**2), *pull, turn])

    s = np.linspace(0, LENGTH, 41)
    y = np.vstack([s, np.zeros((5, 41))])
    for load in (0.1, 0.4, 1.0):
        found = solve_bvp(
            lambda s, y, load=load: rates(s, y, load),
            lambda a, b: np.array([*a[:3], *b[3:]]),
            s,
            y,
            tol=1e-5,
        )
        assert found.success
        s, y = found.x, found.y
    return float(y[0, -1] - LENGTH), float(y[1, -1])


@pytest.mark.slow
@pytest.mark.parametrize("place", [None, (50e-3, 0.0, -35e-3)])
def test_magnet_strip(place: tuple[float, float, float] | None) -> None:
    """Its tip, at the case's own place of the magnet and at another one."""
    key = "magnetic.applied.sources.0.position"
    settings = [f"{key}=[{', '.join(f'{1e3 * x:g} mm' for x in place)}]"] if place else []
    row = result("magnet_strip.yaml", *settings).rows[-1]
    tip = np.array([row["tip_ux"], row["tip_uz"]], dtype=float)
    assert np.linalg.norm(tip) > LENGTH / 2
    np.testing.assert_allclose(tip, rod(place or (40e-3, 0.0, -60e-3)), rtol=1e-5)


PAST = ("mesh={degree: 2, refinement: 0.3}",)


@pytest.mark.slow
def test_magnet_past_strip() -> None:
    """A closed curve; the snaps are folds at places that are mirror images; the force is the slope
    of the energy.
    """
    found = result("magnet_past_strip.yaml", *PAST)
    assert found.stopped is None
    rows = found.rows
    way = {step: [row for row in rows if row["step"] == step] for step in (2, 3)}
    folds = {step: [row for row in way[step] if row["label"] == "fold"] for step in way}
    for there, back in zip(folds[2], reversed(folds[3]), strict=True):
        assert there["source"] == pytest.approx(
            back["source"], rel=1e-7
        )  # the place at a fold is less exact
        assert there["tip_uz"] == pytest.approx(back["tip_uz"], rel=1e-3)
    first, second = folds[2]
    assert first["source"] + second["source"] == pytest.approx(1, abs=1e-6)
    assert first["tip_uz"] + second["tip_uz"] == pytest.approx(0, abs=1e-3 * first["tip_uz"])
    assert first["source"] > 0.6
    begin, end = (next(row for row in reversed(rows) if row["step"] == step) for step in (1, 3))
    assert end["tip_uz"] == pytest.approx(begin["tip_uz"], rel=1e-8)
    f, pi, force = (
        np.array([row[key] for row in way[2]], dtype=float)
        for key in ("source", "energy", "source_force")
    )
    near = (np.abs(np.diff(f)) < 0.05) & (
        np.abs(np.diff(force)) < 0.15 * np.abs(force).max()
    )  # trapezoidal rule
    assert near.sum() > 10
    work = (np.diff(f) * (force[1:] + force[:-1]) / 2 * 60e-3)[near]
    energy = (E * H * LENGTH**2 * np.diff(pi))[near]  # over E h R²
    assert np.abs(work + energy).max() < 0.02 * np.abs(energy).max()


@pytest.mark.slow
def test_own_field() -> None:
    """The paper's hemisphere buckles a little later in its own field: by less than h/R, as on finer
    meshes.

    There k_d rises by 0.32 % (elements 1.5 times smaller).
    """
    data = yaml.safe_load((CASES / "own_field.yaml").read_text())
    alone = run(
        {**{key: value for key, value in data.items() if key != "magnetic"}, "symmetry": "half"}
    )
    found = result("own_field.yaml")
    assert found.scene.model.multiplicity == 2
    assert found.knockdown / alone.knockdown - 1 == pytest.approx(0.0032, rel=0.1)
    assert found.knockdown / alone.knockdown - 1 < 0.28 / 25.2


@pytest.mark.slow
def test_magnet_stack() -> None:
    """The lowest cap snaps first, within 1 % of what elements of degree 4 say; alone each would at
    0.644527.

    That is of the meridian of one cap.
    """
    alone = {
        "shell": {
            "geometry": "cap",
            "radius": 1,
            "thickness": 0.5 / RADIUS,
            "polar": np.degrees(np.arcsin(6 / RADIUS)),
        }
        | {"youngs_modulus": 1, "poisson_ratio": 0.49},
        "boundary": {"rim": "clamped"},
        "loading": {"kind": "pressure", "until": "limit"},
    }
    assert run(alone).knockdown == pytest.approx(0.644527, rel=1e-5)
    found = result("magnet_stack.yaml")
    moves = moved_caps(found)
    assert moves[0] == 1.0
    assert max(moves[1:]) < 0.5
    assert found.knockdown == pytest.approx(STACK, rel=1e-2)


@pytest.mark.slow
def test_the_interaction_decides_the_order_of_a_stack(tmp_path: Path) -> None:
    """The upper cap, 1.5 % thinner, snaps first, at a load as h². With interaction the lowest."""
    thinner = "shell.thickness_factor={upper: 0.985}"
    case = yaml.safe_load((CASES / "magnet_stack.yaml").read_text())
    del case["magnetic"]
    case["shell"]["file"] = str(CASES / case["shell"]["file"])
    (tmp_path / "alone.yaml").write_text(yaml.safe_dump(case))
    alone, together = (
        run(Case.load(tmp_path / "alone.yaml", [thinner])),
        result("magnet_stack.yaml", thinner),
    )
    assert [np.argmax(moved_caps(each)) for each in (alone, together)] == [2, 0]
    assert alone.knockdown == pytest.approx(0.644527 * 0.985**2, rel=2e-2)
    assert together.knockdown > 1.2 * alone.knockdown


def moved_caps(found: Result) -> list[float]:
    """How far each cap of the stack moves at most in the mode of a fold, over the largest."""
    (fold,) = found.limit_points
    assert fold["kind"] == "fold"
    system, (state,) = found.scene.model.system, found.singular.values()
    factors, mode = (
        Factorisation(system.comm),
        system.zero_at_supports(np.cos(np.arange(system.size))),
    )
    factors.factor(system.tangent(state.u, state.mu))
    for _ in range(4):  # inverse iterations
        mode = factors.solve(mode)
        mode /= np.abs(mode).max()
    z = RADIUS * found.scene.model.r0.x.array.reshape(-1, 3)[:, 2]
    return [
        float(np.abs(mode.reshape(-1, 3)[(z > 3 * i - 0.1) & (z < 3 * i + 1.2)]).max())
        for i in range(3)
    ]
