"""Parameters that enter an energy freely: derivatives in every model, and control by value, force
and volume.
"""

from pathlib import Path

import numpy as np
import pytest
import ufl
from ufl.core.expr import Expr

import magshell_fenicsx as ms
from magshell_fenicsx.continuation.control import PrescribedConjugate, PrescribedLoad
from magshell_fenicsx.continuation.device import Device, natural_scale
from magshell_fenicsx.continuation.system import dot

CASES = Path(__file__).parents[3] / "cases"
QUICK = ["mesh.degree=2", "mesh.refinement=0.4"]
SHIFTED = {"bed": 0.7, "place": 0.02, "skew": 0.3}


def bed(r0: ms.Jet, u: ms.Jet, place: Expr, skew: Expr) -> Expr:
    """Springs to a floor that moves along e3 by `place`, stiffer above by `skew`; nonlinear in
    both.
    """
    w = u.r[2] - place
    return ufl.exp(skew * r0.r[2]) * (w**2 / 2 + place * w**3)


TERM = ms.OwnTerm("bed", bed, (ms.Free("place"), ms.Free("skew")))


def scene(file: str, *settings: str) -> ms.Scene:
    return ms.Scene(ms.Case.load(CASES / file, [*QUICK, *settings]), terms=[TERM])


@pytest.mark.parametrize(
    ("file", "symmetry", "size"),  # a solid's random displacement must not turn elements inside out
    [
        ("dimple_buckling.yaml", "axisymmetric", 1e-3),
        ("dimple_buckling.yaml", "half", 1e-3),
        ("solid_buckling.yaml", "half", 1e-5),
    ],
)
def test_derivatives(file: str, symmetry: str, size: float) -> None:
    """Against central differences of the energy, the residual and the potentials, in each
    parameter.
    """
    system = scene(file, f"symmetry={symmetry}").model.system
    u, v = (
        system.zero_at_supports(size * np.random.default_rng(i).standard_normal(system.size))
        for i in range(2)
    )
    mu = dict.fromkeys(("lambda_m", "pressure"), 0.0) | SHIFTED

    def moved(name: str, step: float) -> dict[str, float]:
        return {**mu, name: mu[name] + step}

    def difference(of: str, name: str, step: float, *arguments: str) -> float:
        ahead, back = (getattr(system, of)(u, moved(name, s), *arguments) for s in (step, -step))
        return (ahead - back) / (2 * step)

    for name in ("place", "skew", "bed"):
        column = system.load(u, mu, name)
        assert column == pytest.approx(
            difference("residual", name, 1e-4), abs=1e-7 * np.abs(column).max()
        )
        along = (
            system.potential(u + 1e-4 * v, mu, name) - system.potential(u - 1e-4 * v, mu, name)
        ) / 2e-4
        assert along == pytest.approx(dot(system.comm, column, v), rel=1e-5)
        for other in ("place", "skew", "bed"):
            expected = difference("potential", other, 1e-4, name)
            assert system.curvature(u, mu, name, other) == pytest.approx(
                expected, rel=1e-6, abs=1e-10
            )
    K, other = (system.tangent(u, moved("skew", step)).norm() for step in (0.0, 1.0))
    assert abs(K - other) > 1e-8 * K  # the tangent changes with the parameter


def test_floor_by_its_place_and_by_its_force() -> None:
    """A floor moved by a given force comes to the place at which it needs that force; the device is
    stable.
    """
    held = scene("dimple_buckling.yaml", "symmetry=axisymmetric")
    newton, system, rest = held.newton, held.model.system, held.unloaded()
    rest = rest.with_(rest.u, "bed", 0.5)
    by_place = newton.solve(rest, "place", PrescribedLoad("place", -1e-3)).state
    force = -system.potential(by_place.u, by_place.mu, "place")
    by_force = newton.solve(rest, "place", PrescribedConjugate(system, "place", force)).state
    assert by_force.mu["place"] == pytest.approx(-1e-3, rel=1e-8)
    scale = {"place": natural_scale(system, newton.factor_at(rest), rest, "place")}
    device = Device(system, {"place": force}, scale)
    free = newton.for_system(device)
    found = free.solve(device.enter(rest), "pressure", PrescribedLoad("pressure", 0.0)).state
    assert device.leave(found).mu["place"] == pytest.approx(-1e-3, rel=1e-8)
    assert free.factor_at(found).negative_pivots == 0


def test_trace_in_a_free_parameter() -> None:
    """The floor is lowered and raised again by `trace`; its columns are there."""
    held = scene("dimple_buckling.yaml", "symmetry=axisymmetric")
    rest = held.unloaded()
    *_, low = ms.trace(
        held, "place", rest.with_(rest.u, "bed", 0.5), control="load", targets=[-1e-3]
    )
    *_, back = ms.trace(held, "place", low, control="load", targets=[0.0])
    assert held.observe(low.point.state)["place"] == -1e-3
    assert np.abs(back.point.state.u).max() < 1e-9 * np.abs(low.point.state.u).max()
