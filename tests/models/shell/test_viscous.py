"""Viscous shells in motion: exact damped vibrations and creep, and rigid motions, which are not
damped.
"""

from typing import Any

import numpy as np
import pytest
import scipy.linalg
from along import csr
from plies import ply, section
from scipy.spatial.transform import Rotation

from magshell_fenicsx import Case, Scene, follow
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.runs.rows import columns
from magshell_fenicsx.shells.mass import mass
from magshell_fenicsx.shells.viscous import Viscosity

OMEGA = 3.5160 * np.sqrt(1 / 12) / 50  # of a cantilever, R/h = 50, nu = 0


def case_of(
    shell: dict[str, Any], step: dict[str, Any], symmetry: str = "half", degree: int = 3
) -> Case:
    strip = {"geometry": "strip", "radius_to_thickness": 50, "poisson_ratio": 0.0, "width": 0.2}
    data = {
        "shell": strip | shell,
        "boundary": {"root": "clamped"},
        "mesh": {"degree": degree, "size": 0.5},
    }
    return Case.from_source(data | {"symmetry": symmetry, "loading": [{"kind": "time", **step}]})


def exact(polynomial: list[float], t: Any) -> Any:
    """The solution from x = 1 at rest with these coefficients, of the second or third order."""
    roots = np.roots(polynomial)
    weights = np.linalg.solve(
        np.vander(roots, len(roots), increasing=True).T, [1, 0, -1][: len(roots)]
    )
    return np.real(np.exp(np.outer(t, roots)) @ weights)


@pytest.mark.parametrize(
    ("shell", "polynomial"),
    [
        ({"viscosity": 0.1 / OMEGA}, [1, 0.1, 1]),
        pytest.param(
            {"relaxation": [{"modulus": 0.3, "time": 1 / OMEGA}]},
            [1, 1, 1.3, 1],  # (s^2 + 1)(s + 1) + 0.3 s
            marks=pytest.mark.slow,
        ),
    ],
)
def test_damped_vibration(shell: dict[str, Any], polynomial: list[float]) -> None:
    """A mode of a cantilever is an oscillator of one freedom; the energies add up."""
    period, push = 2 * np.pi / OMEGA, {"mode": 1, "displacement": 0.01}
    step = {"duration": period / 2, "points": 4, "step": period / 80, "rho_inf": 1.0, "push": push}
    scene = Scene(case_of(shell, step))
    found = columns(scene, follow(scene))
    assert found["w_over_h"][1:] / 0.01 == pytest.approx(
        exact(polynomial, OMEGA * found["time"][1:]), abs=2e-3
    )
    energy = (found["kinetic"] + found["stored"] + found["dissipated"])[1:]
    assert np.ptp(energy) < 1e-7 * energy[0]
    assert found["dissipated"][-1] > 0.1 * energy[0]


COUPLED = {"plies": [ply(0, 3.0, 0.5, nu12=0.0), ply(90, 3.0, 0.5, nu12=0.0)]}


@pytest.mark.slow
def test_damped_vibration_of_plies() -> None:
    """A cantilever of [0/90]: an oscillator with the stiffness D11 - B11^2/A11 of lamination
    theory.
    """
    A, B, D = section(*COUPLED["plies"]).matrices(1.0)[:, 0]
    omega = OMEGA * float(np.sqrt(12 * (D - B**2 / A)))
    period, push = 2 * np.pi / omega, {"mode": 1, "displacement": 0.01}
    step = {"duration": period / 2, "points": 4, "step": period / 80, "rho_inf": 1.0, "push": push}
    shell = {
        "laminate": COUPLED,
        "viscosity": 0.1 / omega,
        "relaxation": [{"modulus": 0.3, "time": 1 / omega}],
    }
    scene = Scene(case_of(shell, step))
    found = columns(scene, follow(scene))
    damped = exact([1, 1.1, 1.4, 1], omega * found["time"][1:])  # (s^2 + 0.1 s + 1)(s + 1) + 0.3 s
    assert found["w_over_h"][1:] / 0.01 == pytest.approx(damped, abs=2e-3)
    energy = (found["kinetic"] + found["stored"] + found["dissipated"])[1:]
    assert np.ptp(energy) < 1e-6 * energy[0]


def test_viscous_plies_are_as_stiff() -> None:
    """Of a thickness that varies. The forces of a smooth velocity are the elastic tangent's."""
    plies = [ply(20, 3.0, 0.3), ply(-70, 0.7, 0.7)]
    shell = {
        "laminate": {"along": [0.3, 1.0, 0.0], "plies": plies},
        "thickness_factor": "1 + x/2",
        "viscosity": 2.0,
    }
    scene = Scene(case_of(shell, {"duration": 1.0}, symmetry="none"))
    model, u = scene.model, np.zeros(scene.model.system.size)
    x, y, _ = model.r0.x.array.reshape(-1, 3).T
    v = np.column_stack([x * y, x**2 - x * y, x**2 * (1 + y)]).ravel()
    elastic = csr(model.system.tangent(u, {})) @ v
    free = np.flatnonzero(model.system.zero_at_supports(np.ones(v.size)))
    force = Viscosity(model, {}, 2.0, []).force(u, u, v, 1.0, 0.0)  # type: ignore[arg-type]
    assert force[free] == pytest.approx(2 * elastic[free], abs=1e-5 * np.abs(elastic).max())


def test_tangent_of_viscous_rubber() -> None:
    """Half a strip, stretched by a third: what viscosity adds to the tangent is its force by the
    velocity.
    """
    rubber = {"law": "neo-hookean", "poisson_ratio": 0.5, "viscosity": 2.0}
    model = Scene(case_of(rubber, {"duration": 1.0}, degree=2)).model
    x, y, _ = model.r0.x.array.reshape(-1, 3).T
    u, v = (
        np.column_stack(of).ravel()
        for of in ([0.3 * x, -0.1 * x * y, 0.2 * x**2], [x, x * y, x**2])
    )
    viscous, rate = Viscosity(model, {}, 2.0, []), 3.0  # type: ignore[arg-type]
    added = csr(viscous.tangent(u, {}, 0.1, rate)) @ v - csr(model.system.tangent(u, {})) @ v
    free = np.flatnonzero(model.system.zero_at_supports(np.ones(v.size)))
    force = viscous.force(u, u, v, 1.0, 0.0)
    assert added[free] / rate == pytest.approx(force[free], abs=1e-4 * np.abs(force[free]).max())


@pytest.mark.slow
def test_creep() -> None:
    """Under a load c t, slow against all vibrations, w is c (t - g tau (1 - exp(-t/((1 + g)
    tau)))).
    """
    g, tau = 0.5, 1e4 / OMEGA
    load = {"pressure": {"kind": "ramp", "to": 1e-9, "over": 4 * tau}}
    step = {"duration": 4 * tau, "points": 4, "step": tau / 50, "rho_inf": 0.0, "history": load}
    scene = Scene(case_of({"relaxation": [{"modulus": g, "time": tau}]}, step, degree=4))
    found = columns(scene, follow(scene))
    t = found["time"][1:] / tau
    creep = t - g * (1 - np.exp(-t / (1 + g)))
    assert found["w_over_h"][2:] / found["w_over_h"][1] == pytest.approx(
        creep[1:] / creep[0], rel=1e-5
    )


TIME = 1e4 / OMEGA


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shell", "fast"),
    [({"relaxation": [{"modulus": 1.0, "time": TIME / 2}]}, 0.5), ({"viscosity": TIME}, 1.0)],
    ids=["Maxwell", "Kelvin and Voigt"],
)
def test_creep_with_steps_for_a_tolerance(shell: dict[str, Any], fast: float) -> None:
    """Under a load that is there at once w is 1 - c exp(-t/TIME), c = 1/2 or 1, to the tolerance
    asked.

    Many steps are refused while the shell still rings.
    """
    load = {"kind": "pressure", "control": "load", "until": "target", "pressure": 5e-5, "points": 1}
    still = Scene(steps_of({}, [load]))
    rest = columns(still, follow(still))["w_over_h"][-1]
    assert 0.2 < rest < 0.3
    for tolerance, points in ((1e-2, 2), (1e-3, 20)):
        history = {"pressure": {"kind": "step", "to": 5e-5}}
        step = {
            "kind": "time",
            "duration": TIME,
            "points": points,
            "tolerance": tolerance,
            "history": history,
        }
        drag = {} if "viscosity" in shell else {"drag": 2 * OMEGA}  # of 2e-4 of TIME
        scene = Scene(steps_of(shell, [step | drag]))
        found = columns(scene, follow(scene))
        exact = rest * (1 - fast * np.exp(-found["time"][1:] / TIME))
        error = np.abs(found["w_over_h"][1:] - exact).max()
        assert error < tolerance
        assert np.sum(found["iterations"]) < 6000


@pytest.mark.slow
def test_creep_after_a_ramp() -> None:
    """The history has a corner at its end: w/rest is the integral of the creep under each part of
    the load.
    """
    over, history = 0.1 * TIME, {"pressure": {"kind": "ramp", "to": 5e-5, "over": 0.1 * TIME}}
    step = {"kind": "time", "duration": TIME, "points": 2, "history": history, "drag": 2 * OMEGA}
    load = {"kind": "pressure", "control": "load", "until": "target", "pressure": 5e-5, "points": 1}
    still = Scene(steps_of({}, [load]))
    rest = columns(still, follow(still))["w_over_h"][-1]
    scene = Scene(steps_of({"relaxation": [{"modulus": 1.0, "time": TIME / 2}]}, [step]))
    exact = rest * (1 - 0.5 * np.exp(-1) * np.expm1(over / TIME) * TIME / over)
    assert columns(scene, follow(scene))["w_over_h"][-1] == pytest.approx(exact, abs=1e-3)


def steps_of(shell: dict[str, Any], steps: list[dict[str, Any]]) -> Case:
    strip = {"geometry": "strip", "radius_to_thickness": 50, "poisson_ratio": 0.0, "width": 0.2}
    data = {
        "shell": strip | shell,
        "boundary": {"root": "clamped"},
        "mesh": {"degree": 3, "size": 0.5},
    }
    return Case.from_source(data | {"symmetry": "half", "loading": steps})


@pytest.mark.slow
def test_damped_vibration_of_a_natural_shape() -> None:
    """A strip rolled up by its natural curvature: a mode of its own, of one freedom too."""
    strip = {"geometry": "strip", "radius_to_thickness": 50, "poisson_ratio": 0.0, "width": 0.2}
    data = {
        "boundary": {"root": "clamped"},
        "natural": {"curvature": [1.0, 0, 0]},
        "mesh": {"degree": 3, "size": 0.5},
    }
    grown: dict[str, Any] = {"kind": "natural", "curvature": 1.0, "control": "load", "points": 1}
    still = Scene(Case.from_source(data | {"shell": strip, "loading": [grown]}))
    *_, last = follow(still)
    system = still.model.system
    K, M = (
        csr(A).toarray()
        for A in (system.tangent(last.point.state.u, last.point.state.mu), mass(still.model))
    )
    free = np.flatnonzero(system.zero_at_supports(np.ones(system.size)))
    omega = float(
        np.sqrt(
            scipy.linalg.eigh(K[np.ix_(free, free)], M[np.ix_(free, free)], eigvals_only=True)[0]
        )
    )
    period, push = 2 * np.pi / omega, {"mode": 1, "displacement": 0.01}
    step = {
        "kind": "time",
        "duration": period / 2,
        "points": 2,
        "step": period / 80,
        "rho_inf": 1.0,
        "push": push,
    }
    shell = strip | {"viscosity": 0.1 / omega}
    scene = Scene(Case.from_source(data | {"shell": shell, "loading": [grown, step]}))
    found = columns(scene, follow(scene))
    moved = (found["w_over_h"] - scene.observe(last.point.state)["w_over_h"])[-2:] / 0.01
    damped = exact([1, 0.1, 1], np.arange(1, 3) * np.pi / 2)
    assert moved / moved[-1] == pytest.approx(damped / damped[-1], abs=1e-2)


def test_rigid_motion_is_not_damped() -> None:
    """The velocity of a rotation about a tilted axis, of a strip that is turned already and was
    bent before.
    """
    scene = Scene(case_of({"viscosity": 1.0}, {"duration": 1.0}, symmetry="none"))
    model = scene.model
    viscous = Viscosity(model, {}, 1.0, [])  # type: ignore[arg-type]
    r0 = model.r0.x.array.reshape(-1, 3)
    bent = r0 + np.outer(0.1 * r0[:, 0] ** 2, [0, 0, 1])
    place = bent @ Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix().T
    turning, stretching = np.cross([0.2, 0.5, -0.4], place), place
    forces = [
        viscous.force(u, u, v.ravel(), 1.0, 0.0)
        for u in [(place - r0).ravel()]
        for v in (turning, stretching)
    ]
    assert np.abs(forces[0]).max() < 1e-6 * np.abs(forces[1]).max()


@pytest.mark.parametrize(
    ("shell", "message"),
    [
        (
            {"viscosity": "1 ms"},
            "shell.viscosity: 1 ms: its unit needs shell.density, youngs_modulus and lengths",
        ),
        ({"viscosity": -1.0}, "shell.viscosity: -1.0: must be positive"),
        (
            {"relaxation": [{"modulus": 0.5, "time": 0.0}]},
            "shell.relaxation.0.time: 0.0: must be positive",
        ),
    ],
)
def test_mistakes(shell: dict[str, Any], message: str) -> None:
    with pytest.raises(CaseError) as error:
        case_of(shell, {"duration": 1.0})
    assert message in str(error.value)
