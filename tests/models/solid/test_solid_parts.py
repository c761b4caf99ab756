"""The parts of a case in a solid: against its shell, which differs by O(h), and against beams and
resultants.
"""

from typing import Any

import numpy as np
import pytest
import ufl
from bodies import body_of
from conftest import CASES
from dolfinx import fem
from rubbers import NEO_HOOKEAN

import magshell_fenicsx as ms
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.fold import FoldGuess, find_fold
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell.parameters import (
    AreaForce,
    EdgeForce,
    EdgeMoment,
    Material,
    PointForce,
)
from magshell_fenicsx.models.solid.body_densities import CompressibleRubber
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.shells.solid import SolidModel
from magshell_fenicsx.simulate.sensitivity import sensitivities
from magshell_fenicsx.simulate.steps import fold_at
from magshell_fenicsx.simulate.transfer import transfer

H, WIDTH = 0.05, 0.2
STRIP = {"geometry": "plate", "length": 1.0, "width": WIDTH, "thickness": H, "youngs_modulus": 1.0}
CYLINDER = {
    "geometry": "cylinder",
    "radius": 1.0,
    "length": 1.0,
    "thickness": H,
    "youngs_modulus": 1.0,
}
EI = WIDTH * H**3 / 12
CLAMPED = {"left": "clamped"}
TIP = {"A": [1.0, WIDTH / 2, 0.0]}


def end(
    model: str, shell: dict[str, Any], size: float | None = 0.2, nu: float = 0.3, **sections: Any
) -> dict[str, float]:
    """What is observed at the end of a path."""
    elements = {"size": size} if size else {}
    degree = {"degree": 3} if model == "shell" else {}
    data = {
        "model": model,
        "shell": {"poisson_ratio": nu, **shell},
        "mesh": {**elements, **degree},
        **sections,
    }
    scene = ms.Scene(ms.Case.from_source(data))
    *_, last = ms.follow(scene)
    return scene.observe(last.point.state)


def dead(*loads: dict[str, Any]) -> dict[str, Any]:
    return {"kind": "dead", "loads": list(loads), "factor": 1, "points": 1}


BENDING: list[dict[str, Any]] = [
    {"edge": "right", "moment": 1e-5},
    {"over": "all", "pressure": -1e-5},
]


@pytest.mark.parametrize("load", BENDING)
def test_a_strip_under_dead_loads(load: dict[str, Any]) -> None:
    """Bent by 0.1 to 1 rad: as its shell to 2.5 %."""
    shell, solid = (
        end(m, STRIP, boundary=CLAMPED, points=TIP, loading=dead(load)) for m in ("shell", "solid")
    )
    assert abs(shell["A_uz"]) > 0.1
    for column in ("A_ux", "A_uz", "w_over_h", "energy"):
        assert solid[column] == pytest.approx(shell[column], rel=H / 2)


def resultant(model: SolidModel, rigid: np.ndarray) -> float:
    """The work of the loads on a displacement (nodes, 3)."""
    return float(-model.system.load(model.zero(), {}, "load") @ rigid.ravel())


@pytest.mark.parametrize(
    "load",
    [
        PointForce("A", np.array([1.0, 2.0, 3.0])),
        EdgeForce("top", np.array([1.0, 2.0, 3.0]), total=True),
        EdgeForce("top", np.array([1.0, 2.0, 3.0]) / (np.pi / 2), total=False),
        AreaForce(None, np.array([1.0, 2.0, 3.0]) / (np.pi / 2)),
    ],
)
def test_loads_add_up_to_their_resultants(load: Any) -> None:
    """On a quarter of a cylinder of two layers and a thickness that varies; an area by its
    curvature to 1e-3.
    """
    body = body_of(
        {**CYLINDER, "azimuth": [0, 90]},
        0.5,
        layers=2,
        points={"A": [1.0, 0.0, 1.0]},
        factor=lambda x: 1 + 0.3 * x[:, 2],
    )
    model = SolidModel(
        body,
        Material(0.3, H),
        CompressibleRubber.from_poisson_ratio(NEO_HOOKEAN, 0.3, 100.0),
        {},
        Loads(dead={"load": (load,)}),
    )
    X = model.r0.x.array.reshape(-1, 3)
    for axis, force in zip(np.eye(3), (1.0, 2.0, 3.0), strict=True):
        assert resultant(model, np.tile(axis, (len(X), 1))) == pytest.approx(force, rel=1e-3)


def test_a_moment_turns_the_end_about_its_edge() -> None:
    """Its work on a small rotation about y is the moment per length times the length, the sign as
    the shell's.
    """
    body = body_of(STRIP, 0.2, layers=2)
    moment = Loads(dead={"load": (EdgeMoment("right", 3.0),)})
    model = SolidModel(
        body,
        Material(0.3, H),
        CompressibleRubber.from_poisson_ratio(NEO_HOOKEAN, 0.3, 100.0),
        {},
        moment,
    )
    X = model.r0.x.array.reshape(-1, 3)
    assert resultant(model, np.cross([0.0, 1.0, 0.0], X)) == pytest.approx(3.0 * WIDTH, rel=1e-9)
    for translation in np.eye(3):
        assert resultant(model, np.tile(translation, (len(X), 1))) == pytest.approx(0.0, abs=1e-9)


def test_a_strip_on_two_hinges() -> None:
    """5 q L^4/(384 E I) of Bernoulli's beam; shear adds 2.4 (h/L)^2 to it for nu = 0 (Timoshenko),
    0.6 %.
    """
    hinged = {"left": "hinged", "right": {"held": ["z"]}}
    q = 1e-6
    middle = end(
        "solid",
        STRIP,
        nu=0.0,
        boundary=hinged,
        points={"A": [0.5, WIDTH / 2, 0.0]},
        loading=dead({"over": "all", "pressure": q}),
    )
    assert -middle["A_uz"] == pytest.approx(5 * q * WIDTH / (384 * EI) * (1 + 2.4 * H**2), rel=5e-3)


def test_a_hinged_cap_under_live_pressure() -> None:
    """The face is sealed at the middle line that holds it; the shell is loaded on its mid-surface,
    h/2 inside.
    """
    cap = {"geometry": "cap", "radius": 1.0, "thickness": H, "polar": 60}
    loading = {
        "kind": "pressure",
        "control": "load",
        "until": "target",
        "pressure": 0.02,
        "points": 1,
    }
    shell, solid = (
        end(m, cap, 0.3, boundary={"rim": "hinged"}, symmetry="half", loading=loading)
        for m in ("shell", "solid")
    )
    assert solid["w_over_h"] == pytest.approx(shell["w_over_h"] * (1 + H), rel=H)


def test_mirror_planes_of_the_case() -> None:
    """An eighth of a cylinder, drawn at its edge: 2 % of energy from the shell."""
    octant = {"left": "symmetry", "right": "symmetry", "bottom": "symmetry"}
    loading = dead({"edge": "top", "moment": 1e-6}, {"over": "all", "pressure": 1e-6})
    shell, solid = (
        end(m, {**CYLINDER, "azimuth": [0, 90]}, 0.3, boundary=octant, loading=loading)
        for m in ("shell", "solid")
    )
    assert solid["energy"] == pytest.approx(shell["energy"], rel=H / 2)


PRESSED = {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.1, "points": 1}


@pytest.mark.slow
def test_skew_mirror_planes() -> None:
    """A sector of a cylinder between planes at 25 and 85 degrees moves as that between 0 and 60."""
    given = {
        "boundary": {"left": "symmetry", "right": "symmetry", "bottom": "hinged", "top": "clamped"}
    }
    straight, skew = (
        end("solid", {**CYLINDER, "azimuth": azimuth}, 0.3, **given, loading=PRESSED)
        for azimuth in ([0, 60], [25, 85])
    )
    assert straight["energy"] != 0
    for column in ("energy", "volume_change"):
        assert skew[column] == pytest.approx(straight[column], rel=1e-6)


@pytest.mark.slow
def test_volume_beside_a_mirror_plane_away_from_the_origin() -> None:
    """Pressed, with the mirror plane at the top as with it at the bottom, to the triangles'
    diagonals.
    """
    sides = {"left": "symmetry", "right": "symmetry"}
    below, above = (
        end(
            "solid",
            {**CYLINDER, "azimuth": [0, 45]},
            0.2,
            boundary={**sides, plane: "symmetry", other: "hinged"},
            loading=PRESSED,
        )
        for plane, other in (("bottom", "top"), ("top", "bottom"))
    )
    for column in ("energy", "volume_change"):
        assert above[column] == pytest.approx(below[column], rel=1e-3)


def test_a_foundation_under_the_outer_face() -> None:
    """A strip that is hinged at both ends, pressed onto springs: as its shell."""
    shell, solid = (
        end(
            m,
            STRIP,
            boundary={"left": "hinged", "right": {"held": ["z"]}},
            points={"A": [0.5, WIDTH / 2, 0.0]},
            foundation={"stiffness": 1e-3},
            loading=dead({"over": "all", "pressure": 1e-6}),
        )
        for m in ("shell", "solid")
    )
    assert solid["A_uz"] == pytest.approx(shell["A_uz"], rel=H / 2)


@pytest.mark.slow
def test_a_closed_cylinder_dented_at_a_named_point() -> None:
    """The chart's seam is no slit: by h from the shell, as the patch is on the outer face."""
    loading = {"kind": "indentation", "at": {"point": "A"}, "depth": 0.5, "points": 1, "patch": 2}
    given = {
        "boundary": {"bottom": "clamped"},
        "points": {"A": [1, 0, 1]},
        "symmetry": "none",
        "loading": loading,
    }
    shell, solid = (end(m, CYLINDER, 0.35, **given) for m in ("shell", "solid"))
    assert solid["force"] == pytest.approx(shell["force"], rel=H)


def test_a_remanence_that_varies_in_a_field_with_a_gradient() -> None:
    """A strip bent by up to 0.4 rad: as its shell."""
    remanent = {"kind": "expression", "components": ["sin(2*pi*x)", "0", "cos(2*pi*x)"]}
    gradient = [[1, 0, 0], [0, 0, 0], [0, 0, -1]]
    magnetic = {
        "lambda_m": 2e-4,
        "remanent": remanent,
        "applied": {"polar": 60, "gradient": gradient},
    }
    shell, solid = (
        end(m, STRIP, boundary=CLAMPED, points=TIP, magnetic=magnetic) for m in ("shell", "solid")
    )
    assert abs(shell["A_uz"]) > 0.05
    for column in ("A_ux", "A_uz"):
        assert solid[column] == pytest.approx(shell[column], rel=H / 2)


def test_layers_pull_a_strip_crooked() -> None:
    """Two layers against each other along a field: tensions lambda_m E and -lambda_m E, so that
    kappa = 3 lambda_m/h.

    By hand: their moment per width is lambda_m E h^2/4, the stiffness E h^3/12 for nu = 0. A shell
    knows nothing of it.
    """
    body, e1, lambda_m = body_of(STRIP, 0.2, layers=2, points=TIP), np.eye(3)[0], 1e-6
    field = Magnetisation(0 * e1, e1, layers=((0.5, e1), (0.5, -e1)))
    model = SolidModel(
        body,
        Material(0.0, H),
        CompressibleRubber.from_poisson_ratio(NEO_HOOKEAN, 0.0, 100.0),
        {"left": "clamped"},
        Loads(magnetic=field),
    )
    factors = Factorisation(model.system.comm)
    factors.factor(model.system.tangent(model.zero(), {"lambda_m": 0.0}))
    u = factors.solve(-model.system.load(model.zero(), {}, "lambda_m"))
    assert lambda_m * model.displacement(u, "A")[2] == pytest.approx(3 * lambda_m / H / 2, rel=5e-3)


def test_a_layered_case_has_elements_for_its_layers() -> None:
    """Ends of layers and the middle of the thickness are ends of elements, whatever solid.layers
    asks for at least.
    """
    layers = [{"fraction": 0.3, "polar": 90}, {"fraction": 0.7}]
    magnetic = {"lambda_m": 1e-5, "remanent": {"kind": "layers", "layers": layers}}
    data = {
        "model": "solid",
        "shell": {"poisson_ratio": 0.3, **STRIP},
        "boundary": CLAMPED,
        "magnetic": magnetic,
    }
    scene = ms.Scene(ms.Case.from_source({**data, "mesh": {"size": 0.5}}))
    assert isinstance(scene.model, SolidModel)
    assert np.unique(scene.model.body.layer_bounds).tolist() == pytest.approx([0, 0.3, 0.5, 1])
    vectors = scene.model.loads.magnetic.remanent.vectors  # type: ignore[union-attr]
    inner = scene.model.body.layer_bounds[:, 1] < 0.31
    assert np.allclose(vectors[inner], [1, 0, 0])
    assert np.allclose(vectors[~inner], [0, 0, 1])


def test_a_strip_that_grows_thinner() -> None:
    """By a formula, from 1.5 h to h/2: as its shell."""
    loading, shell = (
        dead({"edge": "right", "force": [0, 0, 1e-6]}),
        {**STRIP, "thickness_factor": "1.5 - x"},
    )
    thin, solid = (
        end(m, shell, boundary=CLAMPED, points=TIP, loading=loading) for m in ("shell", "solid")
    )
    assert solid["A_uz"] == pytest.approx(thin["A_uz"], rel=H / 2)


def test_a_bracket_from_a_mesh_file() -> None:
    """Two plates at a right angle, mitred: their volume is exact, and so is the fold's angle to
    beams of thickness h.

    w = F b^2 (a + b/3)/(E I), a = b = 1; in the corner (h/2)^2 is stiff.
    """
    bracket = {
        "geometry": "mesh",
        "file": str(CASES.parent / "meshes/bracket.msh"),
        "radius": 1,
        "thickness": H,
    }
    width, force = 0.4, 1e-9
    scene = ms.Scene(
        ms.Case.from_source(
            Source(
                "test",
                {
                    "model": "solid",
                    "shell": {**bracket, "youngs_modulus": 1, "poisson_ratio": 0},
                    "boundary": {"root": "clamped"},
                    "points": {"tip": [1, 0.2, 1]},
                    "loading": dead({"edge": "tip", "force": [0, 0, -force]}),
                },
            )
        )
    )
    one = fem.Constant(scene.model.V.mesh, 1.0)
    volume = fem.assemble_scalar(fem.form(one * ufl.dx))
    assert volume == pytest.approx(2 * width * H, rel=1e-12)
    *_, last = ms.follow(scene)
    beams = force * (1 + 1 / 3) / (width * H**3 / 12)
    assert -scene.observe(last.point.state)["tip_uz"] == pytest.approx(beams, rel=H)


@pytest.mark.slow
def test_patches_of_a_mesh_file() -> None:
    """The gripper on a clamped hub: its arms are elasticas at q = 4, which rise by 0.66996."""
    case = ms.Case.load(
        CASES / "gripper.yaml", ["model=solid", "mesh.degree=2", "loading.points=2"]
    )
    scene = ms.Scene(case)
    *_, last = ms.follow(scene)
    assert scene.observe(last.point.state)["tip_uz"] / 3e-3 == pytest.approx(0.66996, rel=5e-3)


def test_a_body_that_overlaps_itself_is_refused() -> None:
    """A torus tube of radius 0.2 with half a thickness of 0.25."""
    torus = {
        "geometry": "torus",
        "radius": 1.0,
        "tube_radius": 0.2,
        "thickness": 0.33,
        "tube": [0, 180],
    }
    data = {
        "model": "solid",
        "shell": {**torus, "thickness_factor": "1.5", "poisson_ratio": 0.3},
        "mesh": {"size": 0.3},
    }
    with pytest.raises(MeshError, match="the body overlaps itself around"):
        ms.Scene(ms.Case.from_source({**data, "boundary": {"bottom": "clamped"}}))


def test_a_solid_that_is_free_is_refused() -> None:
    """Held at one line, it turns about it."""
    data = {
        "model": "solid",
        "shell": {"poisson_ratio": 0.3, **STRIP},
        "boundary": {"left": "hinged"},
    }
    with pytest.raises(MeshError, match="it is free to"):
        ms.Scene(ms.Case.from_source({**data, "mesh": {"size": 0.5}}))


def test_a_step_in_the_thickness_is_refused() -> None:
    settings = ["model=solid", "mesh.degree=2", "shell.thickness_factor={shelf: 2}"]
    with pytest.raises(CaseError, match="a step in the thickness"):
        ms.Case.load(CASES / "bracket.yaml", settings)


@pytest.mark.slow
def test_derivatives_of_a_fold() -> None:
    """In lambda_m and in the dimple's depth, by folds found at other values of these; of both
    patches together.
    """
    settings = [
        "shell.radius_to_thickness=20",
        "mesh.refinement=0.25",
        "symmetry=half",
        "magnetic.lambda_m=0.001",
    ]
    scene = ms.Scene(ms.Case.load(CASES / "solid_buckling.yaml", settings))
    *_, last = ms.follow(scene)
    fold = fold_at(scene, last)
    found = sensitivities(scene, fold)
    assert found["remanence dimple"] + found["remanence rest"] == pytest.approx(
        0.001 * found["lambda_m"], rel=1e-9
    )

    def buckling(other: ms.Scene, lambda_m: float) -> float:
        u, phi = (transfer(scene, other, v) for v in (fold.state.u, fold.phi))
        guess = FoldGuess(State(u, {**fold.state.mu, "lambda_m": lambda_m}), phi)
        return find_fold(other.newton, guess, "pressure").state.mu["pressure"]

    by_field = (buckling(scene, 0.00102) - buckling(scene, 0.00098)) / 4e-5
    assert found["lambda_m"] == pytest.approx(by_field, rel=1e-3)
    amplitude = scene.problem.imperfections["defect"].amplitude
    shallow, deep = (
        ms.Scene(scene.problem.with_values({"shell.defect.amplitude": amplitude + change}))
        for change in (-5e-4, 5e-4)
    )
    assert found["defect.amplitude"] == pytest.approx(
        (buckling(deep, 0.001) - buckling(shallow, 0.001)) / 1e-3, rel=1e-3
    )
