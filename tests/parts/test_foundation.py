"""Shells on a Winkler foundation: beams and plates in closed form, every model, and what a case
says of it.
"""

from math import pi
from typing import Any

import numpy as np
import pytest
from conftest import CASES
from scipy.special import airy

import magshell_fenicsx as ms
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.mesh.mirror import Y0_PLANE
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.quantities.registry import quantity
from magshell_fenicsx.shells.modes import ShellModes

DISC: dict[str, Any] = {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": 0.3}
PRESSED = {"kind": "pressure", "control": "load", "until": "target", "pressure": 1e-3, "points": 1}


def load(**sections: Any) -> ms.Case:
    return ms.Case.from_source(sections)


def end(case: ms.Case) -> dict[str, float]:
    """What is observed at the end of the path."""
    scene = ms.Scene(case)
    *_, last = ms.follow(scene)
    return scene.observe(last.point.state)


def test_plate_under_a_force() -> None:
    """Hertz 1884, in Timoshenko and Woinowsky-Krieger, Theory of Plates and Shells, section 57: w0
    = F l^2/(8 D).
    """
    case = ms.Case.load(CASES / "foundation.yaml")
    found, l_over_R, force = end(case), 1 / 12, 1e-4
    assert case.foundation.terms(case.context)[0].value == pytest.approx(
        1e-4 / (12 * 0.91) / l_over_R**4, 1e-6
    )
    assert found["w_over_h"] == pytest.approx(2 * pi * force * l_over_R**2 / 8 * 100, rel=1e-5)
    assert found["foundation_force"] == pytest.approx(force, rel=2e-3)  # the rim takes the rest


def beam(beta: float) -> tuple[dict[str, float], float, float]:
    """Half of a strip on a foundation under a line load P: what is observed, w at the load in
    closed form, and P/2.
    """
    E, h, width, P = 3.0, 0.01, 0.1, 1e-10
    K = beta**4 * E * h**3 / 3  # beta^4 = K width/(4 E I), I = width h^3/12
    case = load(
        shell={
            "geometry": "plate",
            "length": 1,
            "width": width,
            "thickness": h,
            "youngs_modulus": E,
            "poisson_ratio": 0,
        },
        boundary={"left": "symmetry", "bottom": "symmetry"},
        points={"middle": [0, 0, 0]},
        foundation={"stiffness": K},
        loading={
            "kind": "dead",
            "control": "load",
            "factor": 1,
            "points": 1,
            "loads": [{"edge": "left", "force": [0, 0, -P / 2]}],
        },
        mesh={"degree": 4, "size": 0.05},
    )
    return end(case), P * beta / (2 * K * width) / h, P / 2 / (E * h) / case.context.scales.force


def test_long_beam_under_a_force() -> None:
    """Hetenyi, Beams on Elastic Foundation, 1946: w = P beta/(2 k), with the other end at 8/beta.

    The foundation alone carries the load: it reacts with all of it, whatever the mesh.
    """
    found, w, half = beam(8.0)
    assert found["w_pole_over_h"] == pytest.approx(w, rel=2e-6)
    assert found["foundation_force"] == pytest.approx(half, rel=1e-7)
    softer, w, _ = beam(7.0)
    assert softer["w_pole_over_h"] == pytest.approx(w, rel=1e-5)


@pytest.mark.parametrize(
    ("symmetry", "refinement", "tolerance"),
    [pytest.param("half", 2, 2e-7, marks=pytest.mark.slow), ("none", 1, 2e-5)],
)
def test_the_same_in_every_shell(symmetry: str, refinement: float, tolerance: float) -> None:
    """A clamped plate, on the meridian and on triangles; without a foundation it deflects 17 times
    as far.
    """
    sections = {
        "shell": DISC,
        "boundary": {"rim": "clamped"},
        "loading": PRESSED,
        "foundation": {"stiffness": 1e-3},
    }
    meridian = end(load(**sections, symmetry="axisymmetric"))
    whole = end(load(**sections, symmetry=symmetry, mesh={"refinement": refinement}))
    without = end(load(**{key: value for key, value in sections.items() if key != "foundation"}))
    for name in ("w_pole_over_h", "foundation_force", "energy", "volume_change"):
        assert whole[name] == pytest.approx(meridian[name], rel=tolerance)
    assert meridian["w_pole_over_h"] < 0.06 * without["w_pole_over_h"]
    assert meridian["foundation"] == pytest.approx(1e-3 * 50)


@pytest.mark.slow
def test_under_a_solid() -> None:
    """On its outer face; it is more flexible than the shell by its shear, of order (h/R)^2."""
    sections = {
        "shell": DISC,
        "boundary": {"rim": "clamped"},
        "loading": PRESSED,
        "foundation": {"stiffness": 1e-3},
    }
    shell, solid = (end(load(**sections, model=model)) for model in ("shell", "solid"))
    for name in ("w_pole_over_h", "foundation_force"):
        assert solid[name] == pytest.approx(shell[name], rel=0.01)


@pytest.mark.parametrize("symmetry", ["half", "none"])
def test_tangent(symmetry: str) -> None:
    """Against central differences of the residual, and it grows with the stiffness."""
    mesh = {"degree": 2, "refinement": 0.5}
    case = load(
        shell=DISC,
        boundary={"rim": "clamped"},
        foundation={"stiffness": 0.3},
        mesh=mesh,
        symmetry=symmetry,
    )
    scene = ms.Scene(case)
    system, mu = scene.model.system, scene.unloaded().mu
    assert mu == {"foundation": pytest.approx(15.0)}
    u, v = (
        system.zero_at_supports(1e-3 * np.random.default_rng(i).standard_normal(system.size))
        for i in range(2)
    )

    def along(stiffness: float) -> np.ndarray:
        K = system.tangent(u, {"foundation": stiffness})
        given, out = K.createVecRight(), K.createVecLeft()
        given.array[:] = v
        K.mult(given, out)
        return np.array(out.array)

    step = 1e-3
    residuals = [system.residual(u + change * v, mu) for change in (step, -step)]
    slope = (residuals[0] - residuals[1]) / (2 * step)
    assert np.abs(along(15.0) - slope).max() < 1e-6 * np.abs(slope).max()
    assert v @ along(30.0) - v @ along(15.0) == pytest.approx(
        v @ along(15.0) - v @ along(0.0), rel=1e-9
    )
    assert v @ along(15.0) > v @ along(0.0)


@pytest.mark.slow
def test_buckling_is_that_of_ones_own_energy() -> None:
    """The key of the case file and an `OwnTerm` with the same density."""
    case = ms.Case.load(CASES / "dimple_buckling.yaml", ["mesh.degree=3"])
    key = case.model_validate(
        case.model_dump() | {"foundation": {"stiffness": 0.02 / case.shell.R_over_h}}
    )
    density = key.foundation.terms(key.context)[0].density
    scene = ms.Scene(case, terms=[ms.OwnTerm("springs", density, (1.0,), 0.02)])
    *_, last = ms.trace(scene, "pressure", first=0.1)
    found = ms.run(key).knockdown
    assert found == pytest.approx(last.point.state.mu["pressure"], rel=1e-7)
    assert found is not None
    assert found > 0.33  # 0.3262 without


def test_units() -> None:
    """0.3 MPa/m under a shell of 1 MPa and 20 mm is 0.006 E/R."""
    sphere = {"geometry": "hemisphere", "poisson_ratio": 0.5}
    lengths = {"radius": "20 mm", "thickness": "0.2 mm", "youngs_modulus": "1 MPa"}
    held = {"boundary": {"equator": "clamped"}}
    si = load(shell=sphere | lengths, foundation={"stiffness": "0.3 MPa/m"}, **held)
    plain = load(
        shell=sphere | {"radius_to_thickness": 100}, foundation={"stiffness": 0.006}, **held
    )
    terms = [case.foundation.terms(case.context)[0] for case in (si, plain)]
    assert terms[0].value == pytest.approx(terms[1].value, rel=1e-12)
    assert terms[0].value == pytest.approx(0.6, rel=1e-12)
    assert terms[0].parameters[0] == pytest.approx(2 * pi * 1e-4 / 9, rel=1e-12)


def test_check_and_labels() -> None:
    """Built or left out; its column is drawn with its symbol."""
    said = describe(load(shell=DISC, boundary={"rim": "clamped"}, foundation={"stiffness": 0.3}))
    assert "  Winkler foundation, k R²/(E h) = 15\n" in said.partition("left out:")[0]
    assert (
        "  foundation: none"
        in describe(load(shell=DISC, boundary={"rim": "clamped"})).partition("left out:")[2]
    )
    assert quantity("foundation").label == "stiffness  $k R^2/(E h)$"
    assert quantity("foundation_force").html == "F<sub>k</sub> R/(2πD)"


@pytest.mark.parametrize(
    ("foundation", "shell", "said"),
    [
        ({"stiffness": -1}, DISC, "foundation.stiffness: -1"),
        ({"stifness": 1}, DISC, "did you mean stiffness"),
        ({}, DISC, "foundation: give stiffness, tangential, or both"),
        ({"stiffness": "1 N/m^3"}, DISC, "foundation.stiffness: has a unit"),
        ({"stiffness": "1 N/m"}, {**DISC, "radius": "1 m"}, "not convertible"),
        ({"stiffness": 1e30}, DISC, "foundation: foundation is 5e"),
        (
            {"stiffness": "1 N/m^3"},
            {"geometry": "disc", "radius": "1 m", "thickness": "1 cm", "poisson_ratio": 0},
            "shell.youngs_modulus is needed for foundation",
        ),
    ],
)
def test_what_is_refused(foundation: dict[str, Any], shell: dict[str, Any], said: str) -> None:
    with pytest.raises(ms.CaseError, match=said):
        describe(load(shell=shell, boundary={"rim": "clamped"}, foundation=foundation))


def test_bar_on_springs_that_stiffen() -> None:
    """A bar with k_t = k x/L is pulled at x = L: u'' = b³ x u, so that u is a sum of Airy's
    functions of b x.
    """
    h, pulled, b = 0.02, 1e-8, 2.0
    case = load(
        shell={
            "geometry": "plate",
            "length": 1,
            "width": 0.2,
            "thickness": h,
            "youngs_modulus": 1,
            "poisson_ratio": 0,
        },
        boundary={"left": {"held": ["z"]}, "right": {"held": ["z"]}},
        points={"tip": [1, 0.1, 0]},
        foundation={"tangential": b**3 * h, "factor": "x"},
        loading={
            "kind": "dead",
            "control": "load",
            "factor": 1,
            "points": 1,
            "loads": [{"edge": "right", "per_length": [pulled, 0, 0]}],
        },
        mesh={"degree": 4, "size": 0.1},
    )
    found = end(case)
    (Ai, Ai1, Bi, Bi1), (_, free_A, _, free_B) = airy(b), airy(0.0)
    u, slope = Ai * free_B - Bi * free_A, b * (Ai1 * free_B - Bi1 * free_A)
    assert found["tip_ux"] == pytest.approx(pulled / h * u / slope, rel=1e-7)
    assert found["foundation_tangential"] == pytest.approx(b**3)


@pytest.mark.parametrize(
    ("y", "r", "model"),
    [
        (0.0, 0.02, "shell"),
        pytest.param(0.17, 0.004, "shell", marks=pytest.mark.slow),
        pytest.param(0.17, 0.02, "solid", marks=pytest.mark.slow),
    ],
)
def test_narrow_springs(y: float, r: float, model: str) -> None:
    """Springs on a disc of radius r, and k everywhere: the energy of a unit of w is k (pi + A pi
    r²)/2.

    On a plane through e3 they leave a half, elsewhere all of the plate; a meridian would not see
    them.
    """
    A = 1 / r**2
    factor = f"1 + {A}*(1 - sign((x - 0.31)**2 + (y - {y})**2 - {r}**2))/2"
    case = load(
        model=model,
        shell=DISC,
        boundary={"rim": "clamped"},
        foundation={"stiffness": 1, "factor": factor},
        loading=PRESSED,
    )
    assert make_problem(case).mirror is (None if y else Y0_PLANE)
    of = ms.Scene(case).model
    up = np.tile([0.0, 0.0, 1.0], of.system.size // 3)
    energy = of.multiplicity * of.system.potential(up, {}, "foundation")
    assert energy == pytest.approx(pi * (1 + 1) / 2, rel=1e-5)


def test_springs_of_negative_stiffness() -> None:
    case = load(
        shell=DISC,
        boundary={"rim": "clamped"},
        foundation={"tangential": 1, "factor": "x"},
        loading=PRESSED,
    )
    with pytest.raises(ms.CaseError, match=r"foundation\.factor: .x.: is -"):
        make_problem(case)


FREE_DISC = {"shell": DISC, "boundary": {"rim": "free"}}


@pytest.mark.parametrize("symmetry", ["axisymmetric", pytest.param("none", marks=pytest.mark.slow)])
def test_a_free_disc_on_springs(symmetry: str) -> None:
    """It is held by its springs alone, in equilibrium with a force: their reaction is the force."""
    force = {
        "kind": "indentation",
        "at": {"polar": 0},
        "control": "load",
        "until": "target",
        "force": 1e-3,
    }
    springs = {"stiffness": 1e-3, "tangential": 1e-3}
    case = load(**FREE_DISC, foundation=springs, loading={**force, "points": 1}, symmetry=symmetry)
    assert "Winkler foundation" in describe(case)
    assert end(case)["foundation_force"] == pytest.approx(1e-3, rel=1e-6)


def test_a_free_disc_on_springs_swings_as_a_rigid_body() -> None:
    """Springs of k and k_t per area: omega^2 rho h is k_t along and around the disc, k across it
    and tilting.
    """
    R_over_h = DISC["radius_to_thickness"]
    springs = {"stiffness": 1e-4 / R_over_h, "tangential": 3e-4 / R_over_h}  # over E/R
    scene = ms.Scene(load(**FREE_DISC, foundation=springs, frequencies={}, symmetry="axisymmetric"))
    modes = ShellModes(scene.model).vibrations(
        scene.unloaded(), 4, allows_rigid_motion=scene.allows_rigid_motion
    )
    assert sorted(mode.label for mode in modes) == ["", "m = 1", "m = 1", "torsion"]
    expected = {("", 1e-4), ("m = 1", 1e-4), ("m = 1", 3e-4), ("torsion", 3e-4)}
    assert {(mode.label, round(mode.eigenvalue, 7)) for mode in modes} == expected


def test_springs_along_the_normal_leave_a_disc_free_across() -> None:
    case = load(
        **FREE_DISC, foundation={"stiffness": 1e-3}, loading=PRESSED, symmetry="axisymmetric"
    )
    with pytest.raises(MeshError, match=r"free to move along \(1, 0, 0\)"):
        ms.Scene(case)
