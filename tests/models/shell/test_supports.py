"""A shell that can move as a rigid body is refused before it is solved."""

from typing import Any

import numpy as np
import pytest

from magshell_fenicsx import Case, Scene, follow
from magshell_fenicsx.continuation.control import PrescribedLoad
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.mesh.patch import MeshError

THIN = {"thickness": 0.02, "poisson_ratio": 0.3}
PLATE = {"geometry": "plate", "length": 1, "width": 1, "thickness": 0.02, "poisson_ratio": 0.3}
CYLINDER = {
    "geometry": "cylinder",
    "radius": 1,
    "length": 1,
    "thickness": 0.02,
    "poisson_ratio": 0.3,
}
CORNERS = {"A": [0, 0, 0], "B": [1, 0, 0], "C": [0, 1, 0]}


def scene(shell: dict[str, Any], boundary: dict[str, Any], points: dict[str, Any]) -> Scene:
    mesh = {"degree": 2, "size": 0.5}
    return Scene(
        Case.from_source({"shell": shell, "boundary": boundary, "points": points, "mesh": mesh})
    )


@pytest.mark.parametrize(
    ("shell", "boundary", "motion"),
    [
        (PLATE, {}, "free to"),
        (PLATE, {"left": "hinged"}, "free to"),  # turns about the hinge
        (PLATE, {"left": "symmetry", "bottom": "symmetry"}, r"free to move along \(0, 0, -?1\)"),
        (
            PLATE,
            {"left": {"held": ["x", "z"]}, "right": {"held": ["z"]}},
            r"free to move along \(0, -?1, 0\)",
        ),
        (PLATE, {"A": {"held": ["x", "y", "z"]}, "B": {"held": ["z"]}}, "free to"),
        (CYLINDER, {"bottom": {"held": ["z"]}}, "free to"),
    ],
)
def test_loose(shell: dict[str, Any], boundary: dict[str, Any], motion: str) -> None:
    with pytest.raises(MeshError, match=motion):
        scene(shell, boundary, CORNERS if shell is PLATE else {})


def test_a_half_of_a_ring_that_turns_about_its_point() -> None:
    """It turns within the planes of its edges, which the half cannot, and the ring can."""
    ring = CYLINDER | {"length": 0.2, "youngs_modulus": 1}
    edges = {"bottom": "symmetry", "top": "symmetry"}
    points = {"east": [1, 0, 0], "west": [-1, 0, 0]}
    pressed = {"kind": "dead", "loads": [{"at": "west", "force": [1, 0, 0]}], "factor": 1e-6}
    case = {"shell": ring, "points": points, "loading": pressed, "symmetry": "half"}
    case["mesh"] = {"degree": 2, "size": 0.5}
    at_one_point = edges | {"east": {"held": ["x", "y", "z"]}}
    with pytest.raises(MeshError, match="boundary: the shell is not held: it is free to"):
        Scene(Case.from_source(case | {"boundary": at_one_point}))
    at_two_points = at_one_point | {"west": {"held": ["y"]}}
    assert Scene(Case.from_source(case | {"boundary": at_two_points})).newton


@pytest.mark.parametrize(
    ("shell", "boundary"),
    [
        (PLATE, {"left": "clamped"}),
        (PLATE, {"left": "hinged", "B": {"held": ["z"]}}),
        (PLATE, {"A": {"held": ["x", "y", "z"]}, "B": {"held": ["y", "z"]}, "C": {"held": ["z"]}}),
        (PLATE, {"left": "symmetry", "bottom": "symmetry", "A": {"held": ["z"]}}),
        (CYLINDER, {"bottom": {"held": ["x", "y"]}, "top": "hinged"}),
    ],
)
def test_held(shell: dict[str, Any], boundary: dict[str, Any]) -> None:
    assert scene(shell, boundary, CORNERS if shell is PLATE else {}).newton


def test_plane_of_symmetry_must_be_one() -> None:
    """A cone crosses the plane of its edge at 45 degrees."""
    cone = {"geometry": "revolution", "profile": {"points": [[1, 0], [0.5, 0.5]]}, **THIN}
    with pytest.raises(
        MeshError, match=r"boundary.bottom: symmetry: the edge must lie in a plane that the surf"
    ):
        scene(cone, {"bottom": "symmetry", "top": "clamped"}, {})


ANNULUS = {
    "geometry": "annulus",
    "radius": 1,
    "inner_radius": 0.5,
    "thickness": 0.02,
    "poisson_ratio": 0.3,
}


@pytest.mark.parametrize(
    ("shell", "boundary", "refused"),
    [
        (
            ANNULUS,
            {"inner": "clamped", "outer": "symmetry"},
            True,
        ),  # its plane z = 0 is the surface's own
        (CYLINDER, {"bottom": "symmetry", "top": "clamped"}, False),
    ],
)
def test_a_symmetry_plane_is_crossed(
    shell: dict[str, Any], boundary: dict[str, Any], *, refused: bool
) -> None:
    """The conormals of a closed edge cancel in the mean; their sizes do not."""
    if not refused:
        assert scene(shell, boundary, {}).newton
        return
    with pytest.raises(
        MeshError, match=r"boundary.outer: symmetry: the edge must lie in a plane that"
    ):
        scene(shell, boundary, {})


def pressed(shell: dict[str, Any], boundary: dict[str, Any]) -> Case:
    loading = {
        "kind": "pressure",
        "until": "target",
        "control": "load",
        "pressure": 0.05,
        "points": 1,
    }
    mesh = {"degree": 3, "size": 0.25}
    return Case.from_source(
        Source(
            "test",
            {
                "shell": shell,
                "boundary": boundary,
                "loading": loading,
                "mesh": mesh,
                "symmetry": "none",
            },
        )
    )


@pytest.mark.slow
def test_live_pressure_beside_a_symmetry_plane_anywhere() -> None:
    """Half of a plate of twice the length, held at x = 0 or beside x = 1: volumes are measured from
    that plane.
    """
    found = []
    for edge in ("left", "right"):
        held = dict.fromkeys({"left", "right", "bottom", "top"} - {edge}, "clamped")
        *_, last = follow(half := Scene(pressed(PLATE, {**held, edge: "symmetry"})))
        found.append(half.observe(last.point.state)["volume_change"])
    held = dict.fromkeys(("left", "right", "bottom", "top"), "clamped")
    long = {**PLATE, "length": 2, "thickness": 0.02}
    loading = {"pressure": 0.05 * 4}  # p_c is over R^2, and R twice as long
    asked = pressed(long, held)
    assert asked.loading
    asked = asked.model_copy(update={"loading": asked.loading.model_copy(update=loading)})
    *_, last = follow(whole := Scene(asked))
    expected = whole.observe(last.point.state)["volume_change"] * 2**3 / 2
    assert found == pytest.approx([expected, expected], rel=1e-6)


def test_live_pressure_between_parallel_symmetry_planes() -> None:
    """They have no common point; the plate bends as a clamped beam: volume p L^5/(720 D),
    deflection p L^4/(384 D).
    """
    edges = {"left": "symmetry", "right": "symmetry", "bottom": "clamped", "top": "clamped"}
    asked = pressed({**PLATE, "length": 0.4, "thickness": 0.04}, edges)
    assert asked.loading
    finer = {
        "loading": asked.loading.model_copy(update={"pressure": 1e-6}),
        "mesh": asked.mesh.model_copy(update={"size": 0.1}),
    }
    asked = asked.model_copy(update=finer)
    *_, last = follow(plate := Scene(asked))
    h, R = plate.problem.material.h, 0.4  # lengths are over R
    p = 1e-6 * plate.problem.material.classical_pressure
    expected = -p * (1 / R) ** 5 / 720 / (h**3 / (12 * (1 - 0.3**2)))
    assert plate.observe(last.point.state)["volume_change"] == pytest.approx(expected, rel=2e-3)


def test_sectors_between_oblique_symmetry_planes() -> None:
    """Of a cylinder under dead pressure: one has the energy per angle of a quarter between x = 0
    and y = 0.
    """
    loading = {
        "kind": "dead",
        "loads": [{"over": "all", "pressure": 1e-4}],
        "factor": 1,
        "points": 1,
    }
    edges = {"left": "symmetry", "right": "symmetry", "bottom": "clamped", "top": "clamped"}
    found = []
    for first, last in ((0, 90), (-25, 35)):
        shell = {**CYLINDER, "youngs_modulus": 1, "azimuth": [first, last]}
        data = {
            "shell": shell,
            "boundary": edges,
            "loading": loading,
            "mesh": {"degree": 2, "size": 0.5236},
        }
        *_, end = follow(sector := Scene(Case.from_source({**data, "symmetry": "none"})))
        found.append(sector.observe(end.point.state)["energy"] / (last - first))
    assert found[1] == pytest.approx(found[0], rel=1e-9)


def test_a_remanence_without_value_is_refused() -> None:
    """At a node, and at places that a problem does not look at by samples alone."""
    magnetic = {
        "lambda_m": 1e-3,
        "remanent": {"kind": "expression", "components": ["0*x", "0*x", "1/(3*x - 1)"]},
    }
    data = {
        "shell": PLATE,
        "boundary": {"left": "clamped"},
        "magnetic": magnetic,
        "mesh": {"degree": 2, "size": 0.34},
    }
    with pytest.raises(CaseError, match=r"magnetic.remanent.components: .* is inf at .* \(0.333, "):
        Scene(Case.from_source(data))


def test_energy_of_mirror_edges_is_bending() -> None:
    """Turning a symmetry edge out of its plane costs bending alone. All of it is in the column."""
    half = scene(PLATE, {"left": "symmetry", "bottom": "clamped"}, {})
    state = half.unloaded()
    x = half.model.r0.x.array.reshape(-1, 3)[: len(state.u) // 3]
    state.u.reshape(-1, 3)[:, 2] = 1e-3 * x[:, 0]
    seen, energies = half.observe(state), half.model.system.energies(state.u)
    assert energies["left mirror edges"] > 0.5 * seen["energy"]
    assert seen["bending"] + seen["stretching"] == pytest.approx(seen["energy"])
    assert seen["bending"] >= energies["left mirror edges"]


def test_displacement_beside_moments_alone() -> None:
    """They have none of their own: the first named point's, w = -u.n0."""
    load = {"kind": "dead", "loads": [{"edge": "right", "moment": 1}], "factor": 1}
    shell, mesh = {**PLATE, "youngs_modulus": 1}, {"degree": 2, "size": 0.5}
    data = {
        "shell": shell,
        "boundary": {"left": "clamped"},
        "points": CORNERS,
        "loading": load,
        "mesh": mesh,
    }
    beam = Scene(Case.from_source({**data, "points": {"B": CORNERS["B"]}}))
    state = beam.unloaded()
    state.u.reshape(-1, 3)[:, 2] = -0.02
    assert beam.observe(state)["w_over_h"] == pytest.approx(1.0)


def test_newton_puts_nodes_back_on_oblique_planes() -> None:
    """Nodes that a guess moves off the planes of a sector: an extrapolation multiplies rounding
    from step to step.
    """
    shell = {"geometry": "cap", "radius": 1, "polar": 20, "hole": 4, "azimuth": [0, 20],
             "thickness": 0.02,
             "youngs_modulus": 1, "poisson_ratio": 0.3}  # fmt: skip
    held = {"rim": "hinged", "left": "symmetry", "right": "symmetry"}
    load = {"loading": {"kind": "pressure"}, "symmetry": "none"}
    sector = Scene(
        Case.model_validate({"shell": shell, "boundary": held, "mesh": {"degree": 2}} | load)
    )
    system = sector.model.system
    u = 1e-6 * sector.problem.material.h * np.random.default_rng(0).standard_normal(system.size)
    u[system._fixed] = 0
    assert np.abs(u - system.zero_at_supports(u)).max() > 1e-8
    outcome = sector.newton.solve(
        State(u, sector.unloaded().mu), "pressure", PrescribedLoad("pressure", 0.0)
    )
    assert outcome.converged
    solved = outcome.state.u
    assert np.abs(solved - system.zero_at_supports(solved)).max() < 1e-18
