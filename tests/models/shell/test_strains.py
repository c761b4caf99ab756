"""Strains and moments at points against closed forms, and what is gathered of them from every
model.
"""

from typing import Any

import numpy as np
import pytest
from conftest import disc, hemisphere

from magshell_fenicsx import Case, Scene, surface
from magshell_fenicsx.models.shell.law import Koiter
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.strains import TangentFrame, bending_moment, principal
from magshell_fenicsx.output.fields.point_fields import principal_fields
from magshell_fenicsx.output.fields.surface import Surface, SurfaceGatherer
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.shells.shell import ShellModel
from magshell_fenicsx.shells.stress_resultants import StressResultants
from magshell_fenicsx.simulate.follow import follow

NU, H = 0.3, 0.05
RNG = np.random.default_rng(1)


def gathered(size: float, u: Any, *, flat: bool = False) -> Surface:
    """A free shell with a displacement that is a function of x, y, z."""
    model = ShellModel((disc if flat else hemisphere)(size), Material(NU, H), 4, {}, Loads())
    nodes = model.r0.x.array.reshape(-1, 3)
    found = SurfaceGatherer(model).gather(np.ravel(u(*nodes.T)))
    assert found is not None
    return found


def test_any_rigid_motion_strains_nothing() -> None:
    """Exactly, at random points of any curvature, in coordinates that are not orthogonal."""
    jet = RNG.standard_normal((6, 50, 3))
    Q, _ = np.linalg.qr(RNG.standard_normal((3, 3)))
    Q *= np.linalg.det(Q)
    frame, u = TangentFrame.from_jet(jet), jet @ Q.T - jet
    u[0] += [1.0, -2.0, 3.0]
    assert frame.membrane_strain(u) == pytest.approx(0, abs=1e-11)
    assert frame.curvature_change(u) == pytest.approx(0, abs=1e-10)
    v = RNG.standard_normal((50, 3))
    assert frame.convected(v, u) == pytest.approx(v @ Q.T, abs=1e-11)


def test_swelling_sphere() -> None:
    """r = (1 + e) r0: E = (e + e^2/2) a0 and K = -e a0, so M/D = -(1 + nu) e."""
    e = 0.01
    swollen = gathered(0.5, lambda x, y, z: e * np.column_stack([x, y, z]))
    P = np.eye(3) - swollen.n0[:, :, None] * swollen.n0[:, None]
    assert swollen.fields["E_2"] == pytest.approx(e + e**2 / 2, rel=2e-3)
    assert swollen.fields["M_1"] == pytest.approx(-(1 + NU) * e, rel=2e-2)
    assert swollen.fields["E"] == pytest.approx((e + e**2 / 2) * P, abs=1e-4)


def bent(x: Any, y: Any, z: Any, kappa: float = 0.5) -> Any:
    """A plate rolled up about y, away from its normal e3: the exact circle."""
    return np.column_stack([np.sin(kappa * x) / kappa - x, 0 * y, (np.cos(kappa * x) - 1) / kappa])


def test_plate_bent_to_a_cylinder() -> None:
    """K = -kappa e1 (x) e1: M_xx = -D kappa, M_yy = -nu D kappa; no strain."""
    kappa, errors = 0.5, []
    for size in (0.5, 0.25):
        roll = gathered(size, bent, flat=True)
        expected = -kappa * np.diag([1, NU, 0])
        errors.append([np.abs(roll.fields["M"] - expected).max(), np.abs(roll.fields["E"]).max()])
        assert roll.fields["M_1"] == pytest.approx(-NU * kappa, abs=2 * errors[-1][0])
        assert roll.fields["M_2"] == pytest.approx(-kappa, abs=2 * errors[-1][0])
    assert errors[1][0] < 2e-4
    assert errors[0][0] / errors[1][0] > 6  # second derivatives of degree 4 are of third order
    assert errors[0][1] / errors[1][1] > 12  # first derivatives of fourth


def test_principal_values_are_eigenvalues() -> None:
    S = RNG.standard_normal((20, 2, 2))
    S = S + np.swapaxes(S, 1, 2)
    parts = S[:, [0, 0, 1], [0, 1, 1]]
    assert np.column_stack(principal(parts)[::-1]) == pytest.approx(np.linalg.eigvalsh(S))
    law = Koiter(0.05, 0.0)
    assert bending_moment(parts, parts, law) == pytest.approx(law.bending_stiffness * parts)


def scene_of(**sections: Any) -> Scene:
    return Scene(Case.from_source(sections))


def last(scene: Scene) -> Surface:
    *_, record = follow(scene)
    found = surface(scene, record)
    assert found is not None
    return found


HEMISPHERE = {"geometry": "hemisphere", "radius_to_thickness": 90, "poisson_ratio": NU}
PRESSED = {"kind": "pressure", "control": "load", "until": "target", "pressure": 1e-3, "points": 1}


def test_sphere_under_pressure() -> None:
    """E = -p R (1 - nu)/(2 E h) a0 away from the clamped equator; there E_1 = 0 and M_1 = nu M_2:
    held and turned.
    """
    found = last(scene_of(shell=HEMISPHERE, boundary={"equator": "clamped"}, loading=PRESSED))
    material = Material(NU, 1 / 90)
    inner, edge = found.r0[:, 2] > 0.8, np.abs(found.r0[:, 2]) < 1e-9
    for name in ("E_1", "E_2"):
        expected = -1e-3 * material.classical_pressure * (1 - NU) / (2 * material.h)
        assert found.fields[name][inner] == pytest.approx(expected, rel=2e-3)
    size = np.abs(found.fields["E_2"]).max()
    assert found.fields["E_1"][edge] == pytest.approx(
        0, abs=1e-5 * size
    )  # recovered from inside the cells
    assert found.fields["M_1"][edge] == pytest.approx(NU * found.fields["M_2"][edge], rel=1e-6)
    assert found.fields["M_2"].min() == pytest.approx(found.fields["M_2"][edge].mean())


@pytest.mark.slow
def test_meridian_and_half_shell_agree() -> None:
    """Two discretisations of the same fields, away from the layer at the clamped edge."""
    magnetic = {"lambda_m": 1e-3, "remanent": {"kind": "radial"}}
    case = {
        "shell": HEMISPHERE,
        "boundary": {"equator": "clamped"},
        "magnetic": magnetic,
        "loading": PRESSED,
    }
    one, half = (last(scene_of(**case, symmetry=symmetry)) for symmetry in ("axisymmetric", "half"))
    inner = half.r0[:, 2] > 0.35
    order = np.argsort(-one.r0[:, 2])
    for name, scale in {"E_1": 1e-5, "E_2": 1e-5, "M_1": 1e-4, "M_2": 1e-4}.items():
        line = np.interp(-half.r0[inner, 2], -one.r0[order, 2], one.fields[name][order])
        assert half.fields[name][inner] == pytest.approx(line, abs=scale), name
    for name in ("Br", "Ba"):
        along = [np.einsum("ij,ij->i", s.fields[name], s.n0) for s in (one, half)]
        line = np.interp(-half.r0[inner, 2], -one.r0[order, 2], along[0][order])
        assert along[1][inner] == pytest.approx(line, abs=1e-3 * np.abs(line).max())
    whole = half.fields["E"]
    assert whole[: len(whole) // 2] * [[1, -1, 1], [-1, 1, -1], [1, -1, 1]] == pytest.approx(
        whole[len(whole) // 2 :]
    )


def test_moments_take_the_thickness_that_is_there() -> None:
    """D grows with its third power."""
    jet, u = RNG.standard_normal((2, 6, 4, 3, 3))
    fields = [
        principal_fields(StressResultants(jet, Material(NU, H), t).values_of(u, {}))
        for t in (None, np.full((4, 3), 2.0))
    ]
    assert fields[1]["M_1"] == pytest.approx(8 * fields[0]["M_1"])
    assert fields[1]["E_1"] == pytest.approx(fields[0]["E_1"])


def test_remanence_turns_with_the_shell() -> None:
    """A plate bent to an angle t about e2: Br = e1 becomes (cos t, 0, -sin t), and keeps its
    length.
    """
    model = ShellModel(
        disc(0.5), Material(NU, H), 4, {}, Loads(magnetic=Magnetisation(np.eye(3)[0], np.eye(3)[2]))
    )
    nodes = model.r0.x.array.reshape(-1, 3)
    found = SurfaceGatherer(model).gather(np.ravel(bent(*nodes.T)), {"lambda_m": -2e-3})
    assert found is not None
    t = 0.5 * found.r0[:, 0]
    assert found.fields["Br"] == pytest.approx(
        np.column_stack([np.cos(t), 0 * t, -np.sin(t)]), abs=1e-3
    )
    assert found.fields["Ba"] == pytest.approx(np.tile([0, 0, -2e-3], (len(t), 1)), abs=1e-15)
