"""One's own energies on a named edge: closed forms on meridian and half, and what is refused."""

from typing import Any

import numpy as np
import pytest
import ufl
from along import difference as tangent_difference
from conftest import CASES, hemisphere, random_displacement
from test_fast_residual import difference as residual_difference
from ufl.core.expr import Expr

import magshell_fenicsx as ms
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.mesh.mirror import Y0_PLANE, Mirror
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Edge, Jet
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.shells.shell import ShellModel

H, NU = 0.02, 0.3


def pull(r0: Jet, u: Jet, edge: Edge) -> Expr:
    return -ufl.dot(edge.outward, u.r)


def ring(r0: Jet, u: Jet, edge: Edge) -> Expr:
    """An elastic fibre along the edge."""
    stretched = edge.by_length(r0 + u)
    return (ufl.sqrt(ufl.dot(stretched, stretched)) - 1) ** 2 / 2


def hinge(r0: Jet, u: Jet, edge: Edge) -> Expr:
    """Springs against the slope across the edge."""
    return ufl.dot(kin.normal(r0), edge.by_outward(u)) ** 2 / 2


def loaded(
    symmetry: str, amplitude: str, target: float, *terms: ms.OwnTerm, **sections: Any
) -> dict[str, float]:
    """What is observed at a small load of one amplitude."""
    data = {"symmetry": symmetry, "mesh": {"degree": 4, "refinement": 0.5}, **sections}
    scene = ms.Scene(ms.Case.from_source(data), terms=terms)
    *_, end = ms.trace(scene, amplitude, targets=[target])
    return scene.observe(end.point.state)


def test_ring_around_a_flat_ring_that_is_pulled() -> None:
    """On its meridian.

    Lamé: u = A r + B/r, held at r = a, with the pull q less the ring's force EA u/R² at r = R.
    """
    a, q, EA = 0.5, 1e-6, 0.7
    outward = ms.OwnTerm(
        "pull", pull, on="outer", observed={"spread": lambda r0, u, edge: -pull(r0, u, edge)}
    )
    found = loaded(
        "axisymmetric",
        "pull",
        q,
        outward,
        ms.OwnTerm("ring", ring, on="outer", value=EA),
        shell={
            "geometry": "annulus",
            "radius": 1,
            "inner_radius": a,
            "thickness": H,
            "poisson_ratio": NU,
        },
        boundary={"inner": "clamped"},
    )
    A = q / (((1 + NU) + (1 - NU) * a**2) / (1 - NU**2) + EA * (1 - a**2))  # and B = -A a²
    u = A * (1 - a**2)
    assert found["spread"] / q == pytest.approx(2 * np.pi * u, rel=2e-5)


def test_plate_on_an_elastic_hinge() -> None:
    """On a half.

    Timoshenko, Plates and Shells, section 15: between a simply supported and a clamped plate.
    """
    D, K, p = H**2 / (12 * (1 - NU**2)), 2.0, 1e-6
    found = loaded(
        "half",
        "pressure",
        p,
        ms.OwnTerm("hinge", hinge, on="rim", value=K * D),
        shell={"geometry": "disc", "radius_to_thickness": 1 / H, "poisson_ratio": NU},
        boundary={"rim": "simply supported"},
        loading={"kind": "pressure", "pressure": p, "control": "load", "until": "target"},
    )
    load = p * Material(NU, H).classical_pressure / H
    assert found["w_pole_over_h"] * H == pytest.approx(
        load / (64 * D) * (5 + NU + K) / (1 + NU + K), rel=2e-4
    )


@pytest.mark.parametrize("density", [ring, hinge])
def test_residual_and_tangent(density: Any) -> None:
    """Of the point derivatives against those of the forms."""
    loads = Loads(pressure=True, user_terms=(ms.OwnTerm("own", density, on="rim"),))
    model = ShellModel(hemisphere(0.8), Material(NU, 0.05), 2, {}, loads)
    u, mu = random_displacement(model, 1e-2), {"pressure": 0.3, "own": 1.3}
    assert tangent_difference(model.system, u, mu) <= 1e-12
    assert residual_difference(model.system, u, mu) <= 1e-12


def test_symmetry() -> None:
    """That of the density and of the edge. A preferred direction along the edge has no mirror."""
    sided = Mirror(np.array([1.0, 0.0, 0.0]), 0.5, {"right": "left"})
    assert ms.OwnTerm("own", ring, on="bottom").mirrored(sided)
    assert not ms.OwnTerm("own", ring, on="left").mirrored(sided)
    around = ms.OwnTerm("own", ring, on="rim")
    assert (around.turns, around.mirrored(Y0_PLANE)) == (True, True)
    along = ms.OwnTerm("own", lambda r0, u, edge: ufl.dot(edge.along, u.r), on="rim")
    assert (along.turns, along.mirrored(Y0_PLANE)) == (True, False)


def test_what_is_refused() -> None:
    with pytest.raises(ValueError, match="that of a volume or that of an edge"):
        ms.OwnTerm("own", pull, on="rim", of_volume=True)
    with pytest.raises(ValueError, match="a function of r0, u, an edge and 0 parameters"):
        ms.OwnTerm("own", lambda r0, u: u.r[2], on="rim")
    with pytest.raises(ms.CaseError, match="own is an energy of an edge, which only a shell has"):
        make_problem(
            ms.Case.load(CASES / "solid_buckling.yaml"), [ms.OwnTerm("own", pull, on="equator")]
        )
    with pytest.raises(MeshError, match="terms: own: on: brim: the surface has no such edge, only"):
        make_problem(
            ms.Case.load(CASES / "dimple_buckling.yaml"), [ms.OwnTerm("own", pull, on="brim")]
        )
