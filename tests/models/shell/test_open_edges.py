"""Live pressure beside edges that move: its virtual work, its potential where there is one, and
what it does.
"""

from math import pi, sqrt
from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from petsc4py import PETSc
from scipy.integrate import solve_bvp

import magshell_fenicsx as ms
from magshell_fenicsx.continuation.system import SkewedTangent, Tangent
from magshell_fenicsx.mesh.hexahedra import OUTER_FACE, face_measure
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.shells.solid import SolidModel

Array = NDArray[np.float64]
CYLINDER = {
    "geometry": "cylinder",
    "radius": 1.0,
    "length": 1.0,
    "thickness": 0.1,
    "poisson_ratio": 0.3,
}
PLATE = {"geometry": "plate", "length": 1.0, "width": 0.1, "thickness": 1e-3, "poisson_ratio": 0.0}
SLIDING, FLAT, FREE = {"held": ["x", "y"]}, {"held": ["z"]}, "free"
EDGES: list[tuple[Any, bool]] = [(SLIDING, True), (FLAT, True), ("symmetry", True), (FREE, False)]
MODELS = [("shell", "none"), ("shell", "half"), ("shell", "axisymmetric"), ("solid", "none")]


def scene(
    shell: dict[str, Any], boundary: dict[str, Any], mesh: dict[str, Any], **more: Any
) -> ms.Scene:
    loading = {
        "kind": "pressure",
        "control": "load",
        "until": "target",
        "pressure": 0.05,
        "points": 1,
    }
    data = {"shell": shell, "boundary": boundary, "loading": loading, "mesh": mesh, **more}
    return ms.Scene(ms.Case.from_source(data))


def cylinder(top: Any, model: str, symmetry: str) -> ms.Scene:
    mesh = {"size": 0.7} if model == "solid" else {"degree": 2, "size": 0.5}
    return scene(CYLINDER, {"bottom": "clamped", "top": top}, mesh, model=model, symmetry=symmetry)


def displacement(of: ms.Scene, seed: int, size: float = 0.02) -> Array:
    system = of.model.system
    size = size / 10 if of.problem.body else size  # its elements must not turn inside out
    return system.zero_at_supports(size * np.random.default_rng(seed).standard_normal(system.size))


def times(tangent: Tangent, v: Array) -> Array:
    def product(K: PETSc.Mat) -> Array:
        x, y = K.createVecs()
        x.setArray(v)
        K.mult(x, y)
        return np.array(y.array_r)

    return (
        product(tangent.K) + product(tangent.N)
        if isinstance(tangent, SkewedTangent)
        else product(tangent)
    )


def work(of: ms.Scene, u: Array, v: Array) -> float:
    """p int n . v da of p/p_c = 1 by Nanson's formula, with a rule of another degree; of a solid on
    its outer face.
    """
    model = of.model
    model.u.x.array[:] = u
    w = fem.Function(model.V)
    w.x.array[: len(v)] = v
    unit = model.material.classical_pressure / model.material.h
    domain = model.V.mesh
    if isinstance(model, MeridianModel):
        dx = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": 12})
        r = model.r0 + model.u
        U, Us, Ws = r[0], ufl.grad(r)[0, 0], ufl.grad(r)[1, 0]
        return 2 * pi * unit * fem.assemble_scalar(fem.form((w[1] * Us - w[0] * Ws) * U * dx))
    if isinstance(model, SolidModel):
        F, ds = (
            ufl.Identity(3) + ufl.grad(model.u),
            face_measure(domain, [model.body.faces[OUTER_FACE]]),
        )
        n = ufl.det(F) * ufl.inv(F).T * ufl.FacetNormal(domain)
        return unit * fem.assemble_scalar(fem.form(ufl.dot(w, n) * ds(1)))
    dx = ufl.Measure("dx", domain=domain, metadata={"quadrature_degree": 10})
    J = ufl.Jacobian(domain)
    a1, a2 = (ufl.dot(ufl.grad(model.r0 + model.u), J[:, i]) for i in range(2))
    area = ufl.cross(J[:, 0], J[:, 1])
    return unit * fem.assemble_scalar(
        fem.form(ufl.dot(w, ufl.cross(a1, a2)) / ufl.sqrt(ufl.dot(area, area)) * dx)
    )


@pytest.mark.parametrize(
    ("top", "potential", "model", "symmetry"),
    [  # the edge that is held along e3 alone on half and meridian, the free one on all
        (*edge, *model)
        for edge in EDGES
        for model in MODELS
        if edge[0] == FREE
        or model[1] == "axisymmetric"
        or (edge[0] == FLAT) == (model == ("shell", "half"))
    ],
)
def test_virtual_work_and_tangent(top: Any, potential: bool, model: str, symmetry: str) -> None:
    """The load is the integral of n . v, its tangent the difference of it, symmetric where there is
    a potential.
    """
    tube = cylinder(top, model, symmetry)
    system, (u, v, w) = tube.model.system, (displacement(tube, seed) for seed in range(3))
    assert bool(tube.model.without_potential) != potential
    load = system.load(u, {}, "pressure")
    if model != "solid" or top in (
        "symmetry",
        FREE,
    ):  # else the half of the end above its middle line is pressed too
        assert load @ v == pytest.approx(work(tube, u, v), rel=1e-10)
    none, some, e = {"pressure": 0.0}, {"pressure": 1e3}, 1e-4
    change = (system.load(u + e * v, {}, "pressure") - system.load(u - e * v, {}, "pressure")) / (
        2 * e
    )
    tangent = (times(system.tangent(u, some), v) - times(system.tangent(u, none), v)) / 1e3
    assert tangent == pytest.approx(change, rel=1e-6, abs=1e-8 * np.abs(change).max())
    reverse = (times(system.tangent(u, some), w) - times(system.tangent(u, none), w)) / 1e3
    skew = abs(w @ tangent - v @ reverse) / abs(w @ tangent)
    assert (skew < 1e-9) if potential else (skew > 1e-3)
    potentials = [system.potential(u + d * v, {}, "pressure") for d in (e, -e)]
    slope = (potentials[0] - potentials[1]) / (2 * e)
    assert (slope == pytest.approx(load @ v, rel=1e-6)) == potential


@pytest.mark.parametrize(("top", "ends"), [(SLIDING, 2), (FREE, 1)])
@pytest.mark.parametrize(
    ("symmetry", "h", "error"), [("axisymmetric", 1e-3, 2e-5), ("half", 1e-2, 2e-3)]
)
def test_open_cylinder(top: Any, ends: int, symmetry: str, h: float, error: float) -> None:
    """Membrane and edge bending of a hinged tube that is free to shorten: w = w_p (1 - exp(-b x)
    cos b x) at each end.

    Timoshenko and Woinowsky-Krieger, Theory of Plates and Shells, art. 114. No axial force, so it
    shortens by nu w/R per length; the volume is 2 pi R times the integral of w.
    """
    mesh = {} if symmetry == "axisymmetric" else {"degree": 4, "size": 0.25}
    loading = {
        "kind": "pressure",
        "control": "load",
        "until": "target",
        "pressure": 1e-4,
        "points": 1,
    }
    more = {"points": {"A": [1, 0, 1]}, "loading": loading, "symmetry": symmetry}
    tube = scene({**CYLINDER, "thickness": h}, {"bottom": "hinged", "top": top}, mesh, **more)
    *_, last = ms.follow(tube)
    found = tube.observe(last.point.state)
    w = -1e-4 * tube.problem.material.classical_pressure / h
    integral = w * (1 - ends / (2 * (3 * (1 - 0.3**2)) ** 0.25 / sqrt(h)))
    assert found["A_uz"] == pytest.approx(-0.3 * integral, rel=error)
    assert found["volume_change"] == pytest.approx(2 * pi * integral, rel=error)
    if top == FREE:
        assert found["A_ux"] == pytest.approx(w, rel=10 * error)


def elastica(q: float) -> Array:
    """Displacement (2,) of the tip of an inextensible cantilever, L = EI = 1, under a follower load
    q per length.
    """
    s, y = np.linspace(0, 1, 101), np.zeros((6, 101))
    for load in np.linspace(0, q, 6)[1:]:

        def slopes(s: Array, y: Array, load: float = load) -> Array:
            theta, kappa, N, V, _, _ = y
            return np.array([kappa, -V, kappa * V, -kappa * N - load, np.cos(theta), np.sin(theta)])

        def ends(a: Array, b: Array) -> Array:
            return np.array([a[0], a[4], a[5], b[1], b[2], b[3]])

        found = solve_bvp(slopes, ends, s, y, tol=1e-9, max_nodes=10000)
        assert found.success
        s, y = found.x, found.y
    return np.asarray(y[4:, -1] - [1, 0])


@pytest.mark.slow
def test_strip_under_pressure() -> None:
    """Clamped at one end, its tip turned by 89 degrees, against the elastica; at most ten
    iterations a step.
    """
    h, q = 1e-3, 10.0
    mu = -q * h**3 / 12 / (2 / sqrt(3) * h**2)
    loading = {
        "kind": "pressure",
        "control": "load",
        "until": "target",
        "pressure": mu,
        "points": 2,
    }
    more = {"points": {"A": [1, 0.05, 0]}, "loading": loading}
    strip = scene(PLATE, {"left": "clamped"}, {"degree": 4, "size": 0.1}, **more)
    assert set(strip.model.without_potential) == {"right", "top"}
    records = list(ms.follow(strip))
    assert max(record.point.iterations for record in records) <= 10
    at = [strip.observe(record.point.state) for record in records if record.label == "target"]
    for found, load in zip(at, (q / 2, q), strict=True):
        assert [found["A_ux"], found["A_uz"]] == pytest.approx(elastica(load), abs=1e-5)
    assert {record.point.negative_pivots for record in records} == {0}
