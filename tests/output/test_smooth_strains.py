"""Smooth strains and moments: nearer to exact fields than those of cells are, with true jumps
alone.
"""

from typing import Any

import numpy as np
import pytest
from conftest import CASES, disc
from numpy.typing import NDArray

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.output.fields.gathering import gatherer
from magshell_fenicsx.output.fields.point_fields import PointFields
from magshell_fenicsx.output.fields.recovery import Recovery, smooth_parts, split
from magshell_fenicsx.output.fields.surface import SurfaceGatherer
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.shells.shell import ShellModel
from magshell_fenicsx.simulate.follow import follow

Array = NDArray[np.float64]
NU = 0.3


def scene_of(file: str = "", *settings: str, **sections: Any) -> Scene:
    return Scene(Case.load(CASES / file, list(settings)) if file else Case.from_source(sections))


def unmoved(scene: Scene, **mu: float) -> Any:
    found = gatherer(scene.model, scene.comm).gather(scene.unloaded().u, mu)
    assert found is not None
    return found


@pytest.mark.parametrize("dimensions", [1, 2])
def test_polynomials_are_recovered_exactly(dimensions: int) -> None:
    """Of the fitted degree, from three samples in each cell, also at the ends of cells on the
    border.
    """
    if dimensions == 1:
        x = np.linspace(0, 1, 7)[:, None] ** 1.5
        cells = np.column_stack([np.arange(6), np.arange(1, 7)])
    else:
        x = np.array([[i, k] for i in range(5) for k in range(5)]) + 0.2 * np.random.default_rng(
            1
        ).random((25, 2))
        lower = np.array([5 * i + k for i in range(4) for k in range(4)])[:, None]
        cells = np.concatenate([lower + np.array(three) for three in ([0, 5, 6], [0, 6, 1])])
    inside = (
        0.2 + 0.4 * np.eye(dimensions + 1)
        if dimensions == 2
        else np.array([[0.9, 0.1], [0.5, 0.5], [0.2, 0.8]])
    )
    samples = np.einsum("qv,mvk->mqk", inside, x[cells])
    frames = np.tile(np.eye(dimensions), (len(x), 1, 1))
    recovery = Recovery(cells, samples, np.ones(samples.shape[:2]), x, frames, 2)

    def field(places: Array) -> Array:
        return np.asarray(1 + places[..., 0] ** 2 - 3 * places[..., 0] * places[..., -1])

    cell, corners = (
        np.repeat(np.arange(len(cells)), dimensions + 1),
        x[cells].reshape(-1, dimensions),
    )
    to_corners = recovery.evaluation_matrix(
        cell, corners, np.tile(np.eye(dimensions + 1), (len(cells), 1))
    )
    found = to_corners @ recovery.coefficients(field(samples))
    assert found[:, 0] == pytest.approx(field(corners), abs=1e-9)


def clamped_ring(r: Array, a: float) -> tuple[Array, Array]:
    """Radial and circumferential moments over p R² of a ring, clamped at a and 1.

    Timoshenko and Woinowsky-Krieger, Theory of Plates and Shells, art. 17:
    w = r⁴/64 + c1 + c2 r² + c3 ln r + c4 r² ln r.
    """

    def held(r: float) -> list[list[float]]:
        return [[1, r**2, np.log(r), r**2 * np.log(r)], [0, 2 * r, 1 / r, r * (2 * np.log(r) + 1)]]

    right = [-(a**4) / 64, -(a**3) / 16, -1 / 64, -1 / 16]
    _, c2, c3, c4 = np.linalg.solve(held(a) + held(1.0), right)
    radial = 3 * r**2 / 16 + 2 * c2 - c3 / r**2 + c4 * (2 * np.log(r) + 3)
    around = r**2 / 16 + 2 * c2 + c3 / r**2 + c4 * (2 * np.log(r) + 1)
    return radial + NU * around, around + NU * radial


def moment_errors(refinement: float) -> tuple[float, float]:
    """Errors (rms) of the recovered moments and of the means of the cells' at nodes, over the
    largest moment.
    """
    ring = {
        "geometry": "annulus",
        "radius": 1,
        "inner_radius": 0.4,
        "thickness": 0.02,
        "poisson_ratio": NU,
    }
    scene = scene_of(
        shell=ring,
        boundary={"inner": "clamped", "outer": "clamped"},
        loading={
            "kind": "pressure",
            "control": "load",
            "until": "target",
            "pressure": 1e-9,
            "points": 1,
        },
        mesh={"degree": 3, "refinement": refinement},
        symmetry="none",
    )
    *_, record = follow(scene)
    model, u = scene.model, record.point.state.u
    shell = SurfaceGatherer(model)
    found = shell.gather(u)
    assert found is not None
    r = np.linalg.norm(found.r0, axis=1)
    radial, around = found.r0 / r[:, None], np.cross([0.0, 0.0, 1.0], found.r0 / r[:, None])
    load = 1e-9 * model.material.classical_pressure * 12 * (1 - NU**2) / model.material.h**3
    exact = -load * np.concatenate(clamped_ring(r, 0.4))  # a pressure from above

    def error(M: Array) -> float:
        along = [np.einsum("nij,ni,nj->n", M, e, e) for e in (radial, around)]
        return float(np.sqrt(np.mean((np.concatenate(along) - exact) ** 2)) / np.abs(exact).max())

    return error(found.fields["M"]), error(means_of_cells(shell, u))


def means_of_cells(shell: SurfaceGatherer, u: Array) -> Array:
    """M/D = (1 - nu) K + nu tr K of each cell at its nodes, averaged there."""
    frame = PointFields(
        shell._jet(shell._model.r0, shell._reference_nodes), shell._model.material, None, None
    )._frame
    K = frame.tensor(frame.curvature_change(shell._jet(shell._model.u, shell._reference_nodes)))
    flat = np.diag([1.0, 1.0, 0.0])
    return shell._averaged(
        (1 - NU) * K + NU * np.trace(K, axis1=-2, axis2=-1)[..., None, None] * flat
    )


def test_recovered_moments_are_nearer_to_the_exact_ones() -> None:
    """A ring under pressure, whose deflection is no polynomial: better on both meshes, and more so
    on the finer one.
    """
    (coarse, its_means), (fine, finer_means) = moment_errors(1.0), moment_errors(2.0)
    assert coarse < 0.8 * its_means
    assert fine < 0.65 * finer_means
    assert fine < 0.4 * coarse


def test_fields_jump_between_patches() -> None:
    """A flat cross held flat: M = -D (1 + nu) kappa on one arm, zero elsewhere, at the seam both;
    |Br| is 1 or 0.
    """
    grown = "loading={kind: natural, curvature: 1}", "natural={curvature: {east: [400, 400, 0]}}"
    scene = scene_of("gripper.yaml", *grown, "symmetry=none")
    found = unmoved(scene, natural_curvature=1.0)
    M = found.fields["M_2"]
    held = np.abs(M) > 1e-9
    size = -0.4 * (1 + scene.problem.context.shell.poisson_ratio)  # R is 1 mm
    assert M[held] == pytest.approx(size)
    assert found.fields["M_1"][held] == pytest.approx(size)
    seam = {tuple(x) for x in np.round(found.r0[held], 9)} & {
        tuple(x) for x in np.round(found.r0[~held], 9)
    }
    assert len(seam) > 2
    Br = np.linalg.norm(found.fields["Br"], axis=1)
    assert ((np.abs(Br - 1) < 1e-9) | (Br < 1e-9)).all()


def test_a_meridian_has_two_circles_where_the_remanence_jumps() -> None:
    """One along e3 within a dimple, along -e3 outside."""
    shell = {"geometry": "hemisphere", "radius_to_thickness": 50, "poisson_ratio": NU}
    shell["defect"] = {"kind": "dimple", "amplitude": 0.5, "width": 3}
    remanent = {"kind": "patches", "patches": {"dimple": {"polar": 0}, "rest": {"polar": 180}}}
    scene = scene_of(
        shell=shell,
        boundary={"equator": "clamped"},
        magnetic={"lambda_m": 1e-6, "remanent": remanent},
        loading={"kind": "pressure", "control": "load", "until": "target", "pressure": 0.01},
    )
    assert scene.problem.axisymmetric
    found = unmoved(scene)
    assert np.abs(found.fields["Br"][:, 2]) == pytest.approx(1.0)
    places, times = np.unique(np.round(found.r0, 9), axis=0, return_counts=True)
    assert (times == 2).sum() == 96
    assert np.ptp(places[times == 2, 2]) < 1e-9


def test_parts_are_apart_at_jumps_and_kinks_alone() -> None:
    """Four squares in a row: a jump of a field, then a normal that turns by 10 degrees, then one
    that turns by 60.
    """
    corners = np.array([[2 * i, 2 * i + 2, 2 * i + 1, 2 * i + 3] for i in range(4)])
    sides = np.array([[0, 1], [2, 3], [0, 2], [1, 3]])
    angles = np.radians([0.0, 0, 10, 70])
    normals = np.column_stack([np.sin(angles), 0 * angles, np.cos(angles)])[:, None].repeat(
        4, axis=1
    )
    given = np.array([1.0, 2, 2, 2])[:, None].repeat(4, axis=1)
    assert smooth_parts(corners, sides, [given, normals], normals).tolist() == [0, 1, 1, 2]
    assert len(np.unique(split(corners, np.array([0, 1, 1, 2])))) == 10 + 2 + 2


def test_a_disc_in_one_part_has_one_node_at_each_place() -> None:
    """No field is given that could jump."""
    model = ShellModel(disc(0.7), Material(NU, 0.05), 2, {}, Loads())
    found = SurfaceGatherer(model).gather(np.zeros(model.system.size))
    assert found is not None
    assert len(found.r0) == len(np.unique(np.round(found.r0, 9), axis=0))
