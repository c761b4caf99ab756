"""The own field of a solid: magpylib's cuboid and mesh of triangles, the dipoles of F Br in it, and
the thin shell.
"""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import basix
import magpylib
import numpy as np
import pytest

from magshell_fenicsx import Case, Scene, gradient
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.magnetism.field_maps import maps_at
from magshell_fenicsx.public import follow

MM = 1e-3
BLOCK = {"geometry": "strip", "radius": "20 mm", "width": 0.5, "thickness": "2 mm",
         "youngs_modulus": "1 MPa",
         "poisson_ratio": 0.3}  # fmt: skip
HALF = np.array([10.0, 5.0, 1.0]) * MM
PLACES = (
    np.array([[10, 3, 40], [12, 2, 1.1], [10, 5.3, 1.5], [21, 6, 1.3], [3, 1, -7], [20.2, 1, 0.0]])
    * MM
)
TILTED = {"polar": 40, "azimuth": 30, "flux_density": "60 mT"}
ALONG = {"polar": 40, "azimuth": 0, "flux_density": "60 mT"}
VARIED = {"kind": "expression", "components": ["1 + x", "y", "z*x + x**2"], "flux_density": "60 mT"}
AFFINE = np.array([[1.2, 0.1, 0.0], [0.0, 0.9, 0.1], [0.1, 0.0, 0.7]])
UPRIGHT = np.array([[1.2, 0.0, 0.1], [0.0, 0.9, 0.0], [0.1, 0.0, 0.7]])


def made(magnetic: dict[str, Any], places: np.ndarray = PLACES, **sections: Any) -> Scene:
    """A magnetised block, and places where its field is read."""
    sensors = {f"s{i}": {"position": [0, 0, "40 mm"]} for i in range(len(places))}
    given = {"shell": BLOCK, "boundary": {"root": "clamped"}, "model": "solid", "symmetry": "none",
             "magnetic": {"applied": {"flux_density": "1 mT"}, **magnetic}, "sensors": sensors,
             "loading": {"kind": "field", "points": 1}, "mesh": {"refinement": 0.5}}  # fmt: skip
    scene = Scene(Case.from_source(given | sections).problem())
    loads, R = scene.model.loads, scene.problem.length
    moved = [replace(each, place=x / R) for each, x in zip(loads.sensors, places, strict=True)]
    scene.model.loads = replace(loads, sensors=tuple(moved))
    return scene


def moved(scene: Scene, map_of: Any) -> State:
    """Each place x over R at another one."""
    X = scene.model.r0.x.array.reshape(-1, 3)
    return State((map_of(X) - X).ravel()[: scene.model.system.size], scene.unloaded().mu)


def readings(scene: Scene, state: State) -> np.ndarray:
    row = scene.observe(state)
    return np.array(
        [[row[f"{each.name}_B{axis}"] for axis in "xyz"] for each in scene.model.loads.sensors]
    )


def error(found: np.ndarray, expected: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(found - expected, axis=1) / np.linalg.norm(expected, axis=1))


def polarization(remanent: dict[str, Any]) -> np.ndarray:
    polar, azimuth = np.radians([remanent["polar"], remanent["azimuth"]])
    return 0.06 * np.array(
        [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
    )


@pytest.mark.parametrize(("symmetry", "remanent"), [("none", TILTED), ("half", ALONG)])
def test_a_block_is_magpylibs_cuboid(symmetry: str, remanent: dict[str, Any]) -> None:
    """Also a tenth of the thickness from a face and beside an edge: 1e-8; the export's flat faces
    are the same.
    """
    scene = made({"remanent": remanent}, symmetry=symmetry)
    block = magpylib.magnet.Cuboid(
        dimension=2 * HALF, polarization=polarization(remanent), position=[HALF[0], 0, 0]
    )
    expected = block.getB(PLACES)
    assert (error(readings(scene, scene.unloaded()), expected) < 1e-8).all()
    record: Any = SimpleNamespace(point=SimpleNamespace(state=scene.unloaded()))
    assert (error(scene.to_magpylib(record, 2).getB(PLACES), expected) < 1e-4).all()


@pytest.mark.parametrize(
    ("symmetry", "A", "remanent"), [("none", AFFINE, TILTED), ("half", UPRIGHT, ALONG)]
)
def test_a_deformed_block_is_magpylibs_mesh(
    symmetry: str, A: np.ndarray, remanent: dict[str, Any]
) -> None:
    """An affine map makes a parallelepiped with the polarization A Br/det A: 1e-7; in it a map has
    no values.
    """
    corners = (np.array(np.meshgrid([0, 2], [-1, 1], [-1, 1])).reshape(3, -1).T * HALF) @ A.T
    body = magpylib.magnet.TriangularMesh.from_ConvexHull(
        points=corners, polarization=A @ polarization(remanent) / np.linalg.det(A)
    )
    x = PLACES @ A.T
    box = {
        "corner": [-3 * MM, 1 * MM, -3 * MM],
        "sides": [[28 * MM, 0, 0], [0, 0, 8 * MM]],
        "points": [8, 7],
    }
    scene = made({"remanent": remanent}, x, symmetry=symmetry, field_maps={"box": box})
    state = moved(scene, lambda X: X @ A.T)
    assert (error(readings(scene, state), body.getB(x)) < 1e-7).all()
    (grid,) = maps_at(scene.view, state)
    drawn = scene.problem.length * grid.places @ np.linalg.inv(A).T - [HALF[0], 0, 0]
    inside = (np.abs(drawn) < HALF).all(axis=1)
    assert 5 < inside.sum() < 30
    np.testing.assert_array_equal(np.isnan(grid.values).any(axis=1), inside)
    outside = scene.problem.length * grid.places[~inside]
    assert (error(grid.values[~inside], body.getB(outside)) < 1e-6).all()


def bent(X: np.ndarray) -> np.ndarray:
    """A quadratic map of the block, which the mesh has exactly."""
    x, y, z = X.T
    return np.column_stack([x - 0.3 * x * z, y * (1 + 0.2 * x), z + 0.35 * x**2])


def dipoles(scene: Scene, state: State, x: np.ndarray, polarised: Any) -> np.ndarray:
    """By Gauss's rule the field of the polarisation per undeformed volume, in units of |Br|, at
    places x over R.
    """
    V = scene.model.V
    points, weights = basix.make_quadrature(V.mesh.basix_cell(), 14)
    T = V.element.basix_element.tabulate(1, points)[..., 0]
    nodes = V.dofmap.list
    X, u = (
        np.einsum("dqk,cki->dcqi", T, f.reshape(-1, 3)[nodes])
        for f in (scene.model.r0.x.array, state.u)
    )
    G, H = (np.moveaxis(jet[1:], 0, -1) for jet in (X, u))
    F, volume = np.eye(3) + H @ np.linalg.inv(G), (np.linalg.det(G) * weights)[..., None]
    J, B = volume * polarised(X[0], F), []
    for each in x:
        d = each - X[0] - u[0]
        r = np.linalg.norm(d, axis=-1, keepdims=True)
        B.append(
            ((3 * np.sum(J * d, axis=-1, keepdims=True) * d / r**5 - J / r**3) / (4 * np.pi)).sum(
                axis=(0, 1)
            )
        )
    return np.array(B)


def turned(F: np.ndarray) -> np.ndarray:
    U, _, W = np.linalg.svd(F)
    return np.asarray(U @ W)


@pytest.mark.parametrize(
    ("magnetic", "polarised", "allowed"),
    [
        (
            {"remanent": VARIED},
            lambda X, F: np.einsum("...ij,...j->...i", F,
                                   np.stack([1 + X[..., 0], X[..., 1],
                                             X[..., 2] * X[..., 0] + X[..., 0] ** 2], axis=-1)),
            1e-8,
        ),
        (
            {"remanent": VARIED, "remanence": "rotation"},
            lambda X, F: np.einsum("...ij,...j->...i", turned(F),
                                   np.stack([1 + X[..., 0], X[..., 1],
                                             X[..., 2] * X[..., 0] + X[..., 0] ** 2], axis=-1)),
            1e-7,
        ),
        (
            {"remanent": {"kind": "layers",
                          "layers": [{"fraction": 0.5, "polar": 90}, {"fraction": 0.5, "polar": 0}],
                          "flux_density": "60 mT"}},
            lambda X, F: np.where((X[..., 2] < 0)[..., None], F[..., :, 0], F[..., :, 2]),
            1e-8,
        ),
    ],
)  # fmt: skip
def test_a_bent_block_is_its_dipoles(
    magnetic: dict[str, Any], polarised: Any, allowed: float
) -> None:
    """A formula, whose divergence is charge inside, layers, which jump, and the law that turns:
    other formulas.
    """
    x = np.array([[10, 3, 40], [-6, 2, 8], [10, 14, 3], [28, 1, 9]]) * MM
    layers = {"solid": {"layers": 2}} if "layers" in magnetic["remanent"] else {}
    scene = made(magnetic, x, **layers)
    state = moved(scene, bent)
    expected = 0.06 * dipoles(scene, state, x / scene.problem.length, polarised)
    assert (error(readings(scene, state), expected) < allowed).all(), error(
        readings(scene, state), expected
    )


@pytest.mark.slow
def test_a_thin_strip_as_a_shell_and_as_a_solid() -> None:
    """Bent to 22 of 30 mm: 1e-3 on a fine mesh, which is by how much its tip is beside that of the
    shell.
    """
    shell = {**BLOCK, "radius": "30 mm", "width": 0.3, "thickness": "0.3 mm", "poisson_ratio": 0.0}
    magnetic = {
        "remanent": {"polar": 90, "flux_density": "60 mT"},
        "applied": {"polar": 0, "flux_density": "1 mT"},
    }
    x = np.array([[25, 1, 12], [15, 0, -3]]) * MM
    here = {"shell": shell, "symmetry": "half"}
    found = []
    for sections in ({"model": "shell", "mesh": {}}, {"model": "solid", "mesh": {"refinement": 2}}):
        scene = made(magnetic, x, **here, **sections)
        *_, last = follow(scene)
        found.append(readings(scene, last.point.state))
    assert (error(*found) < 1e-3).all(), error(*found)


@cache
def solved(law: str, e: float, polar: float = 10.0) -> tuple[Scene, Any]:
    components = [f"0.9 + {e!r}*x", f"{e!r}*x**2", f"0.1 + {e!r}*(1 - x)"]
    magnetic = {"remanent": {"kind": "expression", "components": components,
                             "flux_density": "60 mT"},
                "applied": {"polar": polar, "flux_density": "1 mT"}, "remanence": law}  # fmt: skip
    scene = made(magnetic, np.array([[18, 1, -4]]) * MM, mesh={"refinement": 0.3})
    *_, last = follow(scene)
    return scene, last


@pytest.mark.parametrize("law", ["deformation", pytest.param("rotation", marks=pytest.mark.slow)])
def test_gradient_of_a_reading(law: str) -> None:
    """By the remanence and by an angle: differences of solved blocks, 1e-6."""
    scene, last = solved(law, 0.0)
    found = gradient(scene, last, of="s0_Bz", by=["remanence", "magnetic.applied.polar"])
    x = found["remanence"].places[..., 0]
    by_field = found["remanence"].along(np.stack([x, x**2, 1 - x], axis=-1))

    def reading(*given: float) -> float:
        there, end = solved(law, *given)
        return float(readings(there, end.point.state)[0, 2])

    assert by_field == pytest.approx((reading(2e-3) - reading(-2e-3)) / 4e-3, rel=1e-6)
    by_angle = (reading(0.0, 10.01) - reading(0.0, 9.99)) / 0.02
    assert found["magnetic.applied.polar"] == pytest.approx(by_angle, rel=1e-6)


def test_a_sensor_in_a_solid_is_refused() -> None:
    given = {"shell": BLOCK, "boundary": {"root": "clamped"}, "model": "solid",
             "loading": {"kind": "field"},
             "magnetic": {"remanent": TILTED, "applied": {"flux_density": "1 mT"}},
             "sensors": {"hall": {"position": ["10 mm", 0, "0.9 mm"]}}}  # fmt: skip
    with pytest.raises(CaseError, match=r"sensors\.hall\.position: .* is in the shell"):
        Case.from_source(given).problem()
