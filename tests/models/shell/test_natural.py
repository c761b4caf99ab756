"""The natural shape: closed forms, derivatives, every model against the others, and what a case
says of it.
"""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from along import difference

import magshell_fenicsx as ms
from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem, SystemVariables
from magshell_fenicsx.assembly.terms import FormTerm
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.continuation.system import State, dot
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.output.fields.point_fields import principal_fields
from magshell_fenicsx.parts.natural.shape import Natural
from magshell_fenicsx.shells.stress_resultants import StressResultants

CAP = {"geometry": "cap", "polar": 40, "radius": 1, "thickness": 0.02, "poisson_ratio": 0.3}
STRIP = {"geometry": "strip", "radius_to_thickness": 50, "width": 0.1, "poisson_ratio": 0}
UNEVEN = {"stretch": ["1.1 + 0.1*x*y", 0.95], "curvature": ["0.3 + x**2", 0.1, 0.2]}
BOTH = {"natural_curvature": 0.7, "natural_stretch": 0.8}
DEGREES = {
    "none": {"degree": 3},
    "half": {"degree": 3},
    "axisymmetric": {"degree": 4},
}  # few: kernels take long


def load(**sections: Any) -> ms.Case:
    return ms.Case.from_source(sections)


def grow(scene: ms.Scene, *names: str) -> State:
    """Let the amplitudes grow to one, one after the other."""
    state = scene.unloaded()
    for name in names:
        *_, last = ms.trace(scene, name, state, control="load", targets=[1.0])
        state = last.point.state
    return state


def swells(case: ms.Case, centre: list[float]) -> dict[str, float]:
    """What is observed when a shell has grown to 1.3 of its size around a place, without stress."""
    scene = ms.Scene(case)
    state = grow(scene, "natural_stretch")
    r0 = scene.model.r0.x.array[: state.u.size].reshape(-1, len(centre))
    assert np.abs(state.u.reshape(r0.shape) - 0.3 * (r0 - centre)).max() < 1e-10
    found = scene.observe(state)
    assert found["energy"] < 1e-22
    return found


def test_hemisphere_swells_without_stress() -> None:
    """On a mirror plane, with h/R = 0.02: u = (lambda - 1) r0, to rounding."""
    case = load(
        shell={**CAP, "polar": 90},
        boundary={"rim": "symmetry", "top": {"held": ["x", "y"]}},
        points={"top": [0, 0, 1]},
        natural={"stretch": 1.3},
        mesh={"degree": 4, "refinement": 0.5},
    )
    assert swells(case, [0, 0])["volume_change"] == pytest.approx(
        (1.3**3 - 1) * 2 * np.pi / 3, rel=1e-6
    )


def test_hemisphere_of_triangles_swells_without_stress() -> None:
    """Its cubic edges leave the nodes 1e-6 beside the mirror plane, into which they are moved."""
    case = load(
        shell={**CAP, "polar": 90},
        boundary={"rim": "symmetry", "top": {"held": ["x", "y"]}, "east": {"held": ["y"]}},
        points={"top": [0, 0, 1], "east": [1, 0, 0]},
        natural={"stretch": 1.3},
        mesh={"degree": 3, "refinement": 0.3},
        symmetry="none",
    )
    assert swells(case, [0, 0, 0])["volume_change"] == pytest.approx(
        (1.3**3 - 1) * 2 * np.pi / 3, rel=3e-4
    )


def test_cap_swells_without_stress() -> None:
    """On its triangles, held in a statically determinate way, with a free edge."""
    s, c = float(np.sin(np.radians(40))), float(np.cos(np.radians(40)))
    points = {"top": [0, 0, 1], "east": [s, 0, c], "west": [-s, 0, c], "north": [0, s, c]}
    held = {"top": ["x", "y", "z"], "east": ["y"], "west": ["y"], "north": ["x"]}
    case = load(
        shell=CAP,
        boundary={name: {"held": components} for name, components in held.items()},
        points=points,
        natural={"stretch": 1.3},
        mesh={"degree": 3, "refinement": 0.5},
        symmetry="none",
    )
    swells(case, [0, 0, 1])


@pytest.mark.parametrize(
    ("model", "mesh", "error"),
    [
        ("shell", {"degree": 3, "size": 0.13}, 1e-6),
        pytest.param("solid", {"size": 0.06}, 1e-5, marks=pytest.mark.slow),
    ],
)
def test_stretched_and_bent_strip(model: str, mesh: dict[str, Any], error: float) -> None:
    """Free of stress, a circle with kappa per natural length; so is a solid, to the error of its
    elements.
    """
    case = load(
        model=model,
        shell=STRIP,
        boundary={"root": "clamped"},
        natural={"curvature": [1.0, 0, 0], "stretch": [1.05, 1]},
        mesh=mesh,
    )
    scene = ms.Scene(case)
    found = scene.observe(grow(scene, "natural_stretch", "natural_curvature"))
    assert found["w_pole_over_h"] / 50 == pytest.approx(-(1 - np.cos(1.05)), rel=error)
    assert found["energy"] < 1e-11


@pytest.mark.slow
def test_bilayer() -> None:
    """Timoshenko 1925: two equal layers of a beam that grow apart by a strain e bend to kappa = 3
    e/(2 h).
    """
    e, layers = 1e-4, {"layers": 2}
    case = load(
        model="solid",
        shell=STRIP,
        boundary={"root": "clamped"},
        mesh={"size": 0.1},
        solid=layers,
        symmetry="none",
    )
    problem = make_problem(case)

    def apart(r0: np.ndarray, n0: np.ndarray) -> np.ndarray:
        above = np.sign(r0.mean(axis=1, keepdims=True)[..., 2:])
        return np.asarray(np.broadcast_to(e / 2 * above * [1.0, 0.0, 0.0], r0.shape))

    natural = Natural(None, apart, lambda r0, n0: np.broadcast_to([1.0, 0.0, 0.0], r0.shape))
    scene = ms.Scene(replace(problem, loads=replace(problem.loads, natural=natural)))
    found = scene.observe(grow(scene, "natural_stretch"))
    kappa = 3 * e / 2 * 50
    assert abs(found["w_pole_over_h"]) / 50 == pytest.approx((1 - np.cos(kappa)) / kappa, rel=2e-3)


@pytest.mark.parametrize(
    ("model", "symmetry", "shell", "size"),
    [
        ("shell", "none", CAP, 1e-3),
        ("shell", "axisymmetric", CAP, 1e-3),
        ("solid", "none", STRIP, 1e-5),
    ],
)
def test_derivatives(model: str, symmetry: str, shell: dict[str, Any], size: float) -> None:
    """Residual, tangent, columns and curvatures against central differences, at random places and
    amplitudes.

    The residual changes with each amplitude, and so does the tangent.
    """
    natural = (
        UNEVEN
        if symmetry == "none"
        else {"stretch": ["1.1 + 0.1*z", 0.95], "curvature": ["0.3 + z", 0.1, 0]}
    )
    mesh = {"refinement": 0.5} if model == "solid" else DEGREES[symmetry] | {"refinement": 0.2}
    edge = "rim" if shell is CAP else "root"
    case = load(
        model=model,
        shell=shell,
        boundary={edge: "clamped"},
        natural=natural,
        mesh=mesh,
        symmetry=symmetry,
    )
    system = ms.Scene(case).model.system
    u, v = (
        system.zero_at_supports(size * np.random.default_rng(i).standard_normal(system.size))
        for i in range(2)
    )
    mu = dict(BOTH)

    def energy(x: np.ndarray, at: dict[str, float]) -> float:
        return sum(system.energies(x, at).values())

    def moved(name: str, step: float) -> dict[str, float]:
        return {**mu, name: mu[name] + step}

    def rate(of: Any, step: float) -> Any:
        return (8 * (of(step) - of(-step)) - (of(2 * step) - of(-2 * step))) / (12 * step)

    R, e = system.residual(u, mu), 1e-2
    assert R @ v == pytest.approx(rate(lambda s: energy(u + s * v, mu), e), rel=1e-6)
    rows, columns, values = system.tangent(u, mu).getValuesCSR()
    K = scipy.sparse.csr_array((values, columns, rows), shape=(u.size, u.size))
    change = rate(lambda s: system.residual(u + s * v, mu), e)
    assert np.linalg.norm(system.zero_at_supports(K @ v) - change) <= 1e-6 * np.linalg.norm(change)
    for name in BOTH:
        at, column = partial(moved, name), system.load(u, mu, name)
        assert np.linalg.norm(column) > 1e-6 * np.linalg.norm(R)
        change = rate(lambda s, at=at: system.residual(u, at(s)), 1e-3)
        assert np.linalg.norm(column - change) <= 1e-6 * np.linalg.norm(column)
        along = rate(lambda s, name=name: system.potential(u + s * v, mu, name), e)
        assert along == pytest.approx(dot(system.comm, column, v), rel=1e-5)
        slope = rate(lambda s, at=at: energy(u, at(s)), 1e-3)
        assert system.potential(u, mu, name) == pytest.approx(slope, rel=1e-6)
        for other in BOTH:
            there = partial(moved, other)
            bend = rate(lambda s, there=there, name=name: system.potential(u, there(s), name), 1e-3)
            assert system.curvature(u, mu, name, other) == pytest.approx(bend, rel=1e-5)
        changed = scipy.sparse.csr_array(
            (system.tangent(u, at(0.1)).getValuesCSR()[2], columns, rows), shape=K.shape
        )
        assert abs(changed - K).max() > 1e-6 * abs(K).max()


def test_fast_tangent_and_residual() -> None:
    """Those from point kernels are those of FFCx's forms."""
    case = load(
        shell=CAP,
        boundary={"rim": "clamped"},
        natural=UNEVEN,
        mesh={"degree": 2, "refinement": 0.3},
        symmetry="none",
    )
    fast = ms.Scene(case).model.system
    pattern = next(t for t in fast.terms if t.name == "interior edges")
    assert isinstance(pattern, FormTerm)
    variables = SystemVariables(fast.parameters)
    forms = FiniteElementSystem(
        fast.u, fast.terms, fast.clamped, pattern, 1.0, fast._assembler, variables=variables
    )
    u = fast.zero_at_supports(1e-3 * np.random.default_rng(0).standard_normal(fast.size))
    assert difference(fast, u, BOTH) <= 1e-11
    R, expected = (system.residual(u, BOTH) for system in (fast, forms))
    assert np.abs(R - expected).max() <= 1e-11 * np.abs(expected).max()


@pytest.mark.slow
def test_the_same_in_every_shell() -> None:
    """A clamped cap that grows unevenly: half and full shell converge to the meridian, the solid to
    h/R.
    """
    natural = {"stretch": "1 + 0.02*z", "curvature": ["0.2 + x**2 + y**2", 0.2, 0]}

    def end(symmetry: str, model: str = "shell", **mesh: Any) -> dict[str, float]:
        mesh = mesh if model == "solid" else {**mesh, **DEGREES[symmetry]}
        case = load(
            model=model,
            shell=CAP,
            boundary={"rim": "clamped"},
            natural=natural,
            mesh=mesh,
            symmetry=symmetry,
        )
        scene = ms.Scene(case)
        return scene.observe(grow(scene, "natural_stretch", "natural_curvature"))

    meridian = end("axisymmetric")

    def error(symmetry: str, refinement: float) -> list[float]:
        found = end(symmetry, refinement=refinement)
        return [abs(found[name] / meridian[name] - 1) for name in ("w_pole_over_h", "energy")]

    coarse, fine, full = error("half", 1.0), error("half", 2.0), error("none", 1.0)
    assert [a / b for a, b in zip(coarse, fine, strict=True)] == pytest.approx(
        [7, 8], rel=0.2
    )  # order 3
    assert fine[0] < 3e-4
    assert full[0] < 3e-3
    assert end("half", "solid")["w_pole_over_h"] == pytest.approx(
        meridian["w_pole_over_h"], rel=0.02
    )


def test_fields_of_what_is_held() -> None:
    """A plate that cannot move: E = (1/lambda^2 - 1)/2 of its natural size, M = -D (1 + nu) kappa
    of its shape.
    """
    jet = np.zeros((6, 1, 4, 3))
    jet[1, ..., 0], jet[2, ..., 1] = 2.0, 0.5
    stretch, curvature, along = np.full(3, 0.2), np.array([0.4, 0.4, 0.0]), lambda r0, n0: 0 * r0
    stresses = StressResultants(jet, Material(0.3, 0.01), None, Natural(curvature, stretch, along))
    held = stresses.values_of(0 * jet, {"natural_stretch": 1.0, "natural_curvature": 0.0})
    found = principal_fields(held)
    assert found["E_1"] == pytest.approx((1 / 1.44 - 1) / 2)
    assert held["E_total"] == pytest.approx(0)
    assert found["M_1"] == pytest.approx(0)
    found = principal_fields(
        stresses.values_of(0 * jet, {"natural_stretch": 0.0, "natural_curvature": 1.0})
    )
    assert found["M_2"] == pytest.approx(-1.3 * 0.4)
    assert found["E_1"] == pytest.approx(0)


@pytest.mark.parametrize(
    ("natural", "said"),
    [
        ({}, "give curvature, stretch, or both"),
        ({"stretch": 0}, "0.05"),
        ({"stretch": "1 - 3*z"}, r"natural.stretch: .*: is .* at .*: allowed 0.05 to 20"),
        ({"curvature": "1/(x - x)"}, r"natural.curvature: .*: is .* at"),
        ({"curvature": "5/m"}, "natural.curvature: has a unit"),
        ({"curvature": {"rest": 1}}, "natural.curvature: the shell has no dimple"),
        (
            {"curvature": [1, 0, 0], "along": [0, 0, 1]},
            "natural.along: has no direction in the surface",
        ),
    ],
)
def test_refused(natural: dict[str, Any], said: str) -> None:
    """One message with the key."""
    with pytest.raises(
        Exception, match=said.replace("(", "\\(")
    ):  # a CaseError, or a MeshError at the nodes
        ms.Scene(
            load(
                shell=CAP,
                boundary={"rim": "clamped"},
                natural=natural,
                mesh={"degree": 2, "refinement": 0.3},
            )
        )


def test_units_of_curvature() -> None:
    """Per length, over 1/R inside."""
    shell = {**CAP, "radius": "20 mm", "thickness": "0.4 mm"}
    for text in ("5/m", "0.005 mm^-1", "0.005 1/mm"):
        case = load(shell=shell, boundary={"rim": "clamped"}, natural={"curvature": text})
        natural = make_problem(case).loads.natural
        assert natural
        assert natural.curvature == pytest.approx([0.1, 0.1, 0])


def test_symmetry() -> None:
    """Growth alike around the axis leaves the meridian. Growth alike on both sides, a half."""
    for natural, model in (
        ({"stretch": ["1 + z", 1]}, "meridian"),
        ({"curvature": [1, 0, 0.5]}, "full shell"),
        ({"curvature": [1, 0, 0], "along": [1, 0, 0]}, "half shell"),
        ({"curvature": "y"}, "half shell"),
        ({"curvature": "y + x*x"}, "half shell"),
        ({"curvature": "y**3 + x"}, "full shell"),
    ):
        assert (
            make_problem(load(shell=CAP, boundary={"rim": "clamped"}, natural=natural)).included[0]
            == model
        ), natural
