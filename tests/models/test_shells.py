"""Several shells in one case: each is as it is alone, they touch, and they are magnetised in their
own frames.
"""

from typing import Any

import numpy as np
import pytest
from along import csr

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.output.fields.surface import SurfaceGatherer
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.simulate.follow import follow

h = 0.02


def cap(**shell: Any) -> dict[str, Any]:
    """One of several shells; keys with a value of None are left out."""
    keys = {
        "geometry": "cap",
        "radius": 1,
        "polar": 40,
        "thickness": h,
        "youngs_modulus": 1,
        "poisson_ratio": 0.3,
    }
    return {"shell": keys | shell, "boundary": {"rim": "clamped"}, "points": {"tip": [0, 0, 1]}}


def end(data: dict[str, Any]) -> tuple[Scene, State, dict[str, float]]:
    """The scene of a case modelled whole, the state at its end, and what is observed there."""
    scene = Scene(Case.from_source({"symmetry": "none"} | data))
    *_, last = follow(scene)
    return scene, last.point.state, scene.observe(last.point.state)


def test_far_apart() -> None:
    """Each is as it is alone, on the same mesh, whatever its place, thickness and side: 1e-10."""
    flaw = {"kind": "gaussian", "amplitude": 0.3, "width": 0.2}
    lower, upper = cap(imperfections=[flaw]), cap(thickness_factor="1 + x**2")
    mesh = {"degree": 3, "size": 0.3}
    place = {"position": [7, 1, 5], "axis": {"polar": 180, "azimuth": 25}}
    load = {"kind": "pressure", "control": "load", "until": "target", "pressure": 1e-5, "points": 1}
    both = {"shells": {"lower": lower, "upper": upper | {"place": place}}, "mesh": mesh}
    _, _, seen = end(both | {"loading": load | {"on": {"upper": "outside"}}})
    _, _, alone = end(upper | {"mesh": mesh, "symmetry": "none", "loading": load})
    assert seen["upper_tip_uz"] == pytest.approx(-alone["tip_uz"], rel=1e-10)
    assert seen["volume_change"] == pytest.approx(alone["volume_change"], rel=1e-10)
    assert abs(seen["lower_tip_uz"]) < 1e-16
    _, _, seen = end(both | {"loading": load | {"on": {"lower": "inside"}, "pressure": -1e-5}})
    _, _, alone = end(lower | {"mesh": mesh, "symmetry": "none", "loading": load})
    assert seen["lower_tip_uz"] == pytest.approx(alone["tip_uz"], rel=1e-10)


def test_what_is_watched() -> None:
    """The highest of all vertices is on plates that are level: one that no clamp holds."""
    plate = {
        "geometry": "plate",
        "length": 1,
        "width": 0.5,
        "thickness": h,
        "youngs_modulus": 1,
        "poisson_ratio": 0.3,
    }
    above = {"shell": plate, "boundary": {"right": "clamped"}, "place": {"position": [0, 0, 0.2]}}
    shells = {"below": {"shell": plate, "boundary": {"left": "clamped"}}, "above": above}
    problem = Case.from_source(
        {"shells": shells, "loading": {"kind": "pressure"}, "mesh": {"size": 0.25}}
    ).problem()
    x, _, z = problem.triangulated().points["pole"][:3]
    assert x < 1
    assert z == pytest.approx(0.2)


@pytest.mark.parametrize("symmetry", [pytest.param("axisymmetric", marks=pytest.mark.slow), "half"])
def test_pressure_beside_edges_that_move(symmetry: str) -> None:
    """One of two rings is pressed while its inner edge is lifted: energy, volume and reactions as
    alone, 1e-9.

    From inside they are those of the negative pressure. The lift of a shell that is not pressed
    does not feel it.
    """
    ring = {
        "shell": {
            "geometry": "cap",
            "radius": 1,
            "polar": 40,
            "hole": 10,
            "thickness": 0.03,
            "poisson_ratio": 0.3,
        }
    }
    ring |= {"boundary": {"rim": "clamped", "hole": "clamped"}}
    shells = {"lower": ring, "upper": ring | {"place": {"position": [0, 0, 5]}}}

    def lifted(data: dict[str, Any], edge: str, pressure: float, **on: Any) -> dict[str, float]:
        press = {
            "kind": "pressure",
            "control": "load",
            "until": "target",
            "pressure": pressure,
            "points": 1,
        }
        lift = {"kind": "edge", "name": "lift", "points": 1}
        lift["moves"] = [{"supports": [edge], "translation": [0, 0, 0.02]}]
        mesh = {"mesh": {"degree": 3, "refinement": 0.5}, "symmetry": symmetry}
        return end(data | mesh | {"loading": [press | on, lift]})[2]

    def same(seen: dict[str, float], alone: dict[str, float], side: float) -> None:
        for key in ("energy", "reaction", "hole_fz", "rim_fz"):
            there = seen[key if key in seen else f"upper_{key}"]
            assert there == pytest.approx(alone[key], rel=1e-9), key
        assert seen["volume_change"] == pytest.approx(side * alone["volume_change"], rel=1e-9)

    for face, side in (("outside", 1.0), ("inside", -1.0))[symmetry == "half" :]:
        seen = lifted({"shells": shells}, "upper.hole", 0.2, on={"upper": face})
        same(seen, lifted(ring, "hole", 0.2 * side), side)
    if symmetry == "half":
        return
    apart = lifted({"shells": shells}, "upper.hole", 0.2, on={"lower": "inside"})
    assert apart["reaction"] == pytest.approx(apart["upper_hole_fz"], rel=1e-9)
    assert apart["reaction"] == pytest.approx(lifted(ring, "hole", 1e-9)["reaction"], rel=1e-7)


def test_sizes() -> None:
    """One with another radius and thickness is as it is alone; numbers are over R and h of the
    first: 1e-5.
    """
    upper = cap(radius=1.5, thickness=0.01) | {"points": {"tip": [0, 0, 1.5]}}
    load = {"kind": "indentation", "control": "load", "points": 1}
    data = {
        "shells": {"lower": cap(), "upper": upper | {"place": {"position": [0, 0, 9]}}},
        "mesh": {"degree": 3},
    }
    scene, _, seen = end(data | {"loading": load | {"at": {"point": "upper.tip"}, "force": 0.05}})
    assert scene.problem.thickness.patches == {"lower": 1.0, "upper": 0.5}
    force = 0.05 * (0.02**3 / 1) / (0.01**3 / 1.5)  # 2 pi D/R of both
    alone = upper | {"mesh": {"degree": 3}, "symmetry": "none"}
    _, _, other = end(alone | {"loading": load | {"at": {"point": "tip"}, "force": force}})
    assert seen["upper_tip_uz"] == pytest.approx(other["tip_uz"], rel=1e-5)


def test_material_of_each() -> None:
    """With E, nu, density of its own each moves, bends and vibrates as it does alone, 1e-9; scales
    are of the first.
    """
    own = {"youngs_modulus": 3, "poisson_ratio": 0.45}
    load = {"kind": "indentation", "control": "load", "points": 1}
    mesh = {"degree": 3, "size": 0.3}
    lower, upper = cap(density=1), cap(density=5, **own) | {"place": {"position": [0, 0, 9]}}
    data = {"shells": {"lower": lower, "upper": upper}, "mesh": mesh}
    scene, state, seen = end(
        data | {"loading": load | {"at": {"point": "upper.tip"}, "force": 0.05}}
    )
    force = 0.05 * (1 - 0.45**2) / (1 - 0.3**2) / 3  # 2 pi D/R of both
    single = cap(**own) | {"mesh": mesh, "symmetry": "none"}
    other, its_state, its = end(
        single | {"loading": load | {"at": {"point": "tip"}, "force": force}}
    )
    assert seen["upper_tip_uz"] == pytest.approx(its["tip_uz"], rel=1e-9)
    moments = [
        max(
            np.abs(SurfaceGatherer(each.model).gather(u.u).fields[name]).max()
            for name in ("M_1", "M_2")
        )
        for each, u in ((scene, state), (other, its_state))
    ]
    assert moments[0] == pytest.approx(
        3 * (1 - 0.3**2) / (1 - 0.45**2) * moments[1], rel=1e-6
    )  # over D/R of the first
    squares = [
        np.array([m.eigenvalue for m in ShellModes(s.model).vibrations(s.unloaded(), 4)])
        for s in (scene, other)
    ]
    assert squares[0] == pytest.approx(3 / 5 * squares[1], rel=1e-7)


PLIES = {
    "plies": [
        {"angle": angle, "E1": 3, "E2": 1, "nu12": 0.3, "G12": 0.4, "fraction": 0.5}
        for angle in (20, -70)
    ]
}
RUBBER = {"poisson_ratio": 0.5, "law": "neo-hookean", "youngs_modulus": 2}
LAWS: dict[str, dict[str, Any]] = {
    "koiter": {},
    "rubber": RUBBER,
    "plies": {"laminate": PLIES | {"along": [1, 2, 0]}},
    "woven": {"laminate": PLIES, "youngs_modulus": 1.5},
}
TURNS = {
    "koiter": {},
    "rubber": {"position": [7, 1, 5], "axis": {"polar": 180, "azimuth": 25}},
    "plies": {"position": [-7, 1, 5], "axis": {"polar": 50, "azimuth": 25}, "turn": 30},
    "woven": {"position": [0, 9, 0], "axis": {"polar": 70, "azimuth": -25}, "turn": 80},
}


@pytest.mark.slow
def test_law_of_each() -> None:
    """With a law of its own each is blown up and magnetised as it is alone, 1e-10; with the
    derivatives of that.
    """
    load = {"kind": "pressure", "control": "load", "until": "target", "points": 1}
    magnetic, mesh = {"lambda_m": 0.01, "applied": {"polar": 40}}, {"degree": 2, "size": 0.45}
    shells = {
        name: cap(**law) | {"place": TURNS[name], "remanent": {"polar": 0}}
        for name, law in LAWS.items()
    }
    both = {"shells": shells, "mesh": mesh, "magnetic": magnetic}
    scene, state, _ = end(both | {"loading": load | {"pressure": -0.3}})
    u, V = state.u.reshape(-1, 3), scene.model.V
    for name, law in LAWS.items():
        unit = (
            law.get("youngs_modulus", 1)
            / (1 - law.get("poisson_ratio", 0.3) ** 2) ** 0.5
            * (1 - 0.3**2) ** 0.5
        )
        place = scene.problem.context.sections["shells"][name].place
        applied = place.Q.T @ [np.sin(np.radians(40)), 0, np.cos(np.radians(40))]
        polar, azimuth = (
            np.degrees(np.arccos(applied[2])),
            np.degrees(np.arctan2(applied[1], applied[0])),
        )
        own = {"lambda_m": 0.01 / law.get("youngs_modulus", 1), "remanent": {"polar": 0}}
        own |= {"applied": {"polar": float(polar), "azimuth": float(azimuth)}}
        alone = cap(**law) | {"mesh": mesh, "symmetry": "none", "magnetic": own}
        _, its, _ = end(alone | {"loading": load | {"pressure": -0.3 / unit}})
        nodes = np.unique(V.dofmap.list[scene.model.midsurface.patches[name]])
        assert np.linalg.norm(u[nodes]) == pytest.approx(np.linalg.norm(its.u), rel=1e-10)
    v, e, system = np.random.default_rng(3).standard_normal(state.u.size), 1e-7, scene.model.system
    v = system.zero_at_supports(v)
    ahead, back = (system.residual(state.u + way * e * v, state.mu) for way in (1, -1))
    Kv = system.zero_at_supports(csr(system.tangent(state.u, state.mu)) @ v)
    assert np.linalg.norm(Kv - (ahead - back) / (2 * e)) < 1e-6 * np.linalg.norm(Kv)
    drawn = SurfaceGatherer(scene.model).gather(state.u, state.mu).fields
    of_rubber = np.isfinite(
        drawn["stretch_3"]
    )  # a quarter of the nodes; others have no such stretch
    assert np.mean(of_rubber) == pytest.approx(0.25, abs=0.01)
    volume = np.prod([drawn[f"stretch_{i}"][of_rubber] for i in (1, 2, 3)], axis=0)
    assert volume == pytest.approx(1, abs=1e-12)


def test_spin_of_each() -> None:
    """Centrifugal forces are of each density: twice E and twice the density, and it moves as the
    other does, 1e-9.
    """
    shells = {
        name: cap(density=e, youngs_modulus=e, polar=30) | {"place": {"position": [0, 0, z]}}
        for name, e, z in (("lower", 1, 0), ("upper", 2, 3))
    }
    _, _, seen = end(
        {
            "shells": shells,
            "mesh": {"degree": 2},
            "loading": {"kind": "spin", "speed": 0.02, "points": 1},
        }
    )
    assert seen["upper_tip_uz"] == pytest.approx(seen["lower_tip_uz"], rel=1e-9)


def test_remanence_of_each() -> None:
    """In its own frame, turned with it, and over that of the first one."""
    remanents = {
        "lower": {"flux_density": "50 mT", "kind": "radial"},
        "upper": {"flux_density": "100 mT", "polar": 90},
        "plain": None,
    }
    on = {
        "shells": {"lower": cap(), "upper": cap()},
        "loading": {"kind": "pressure", "on": {"upper.rim": "inside"}},
    }
    with pytest.raises(
        MeshError, match=r"loading.on: upper_rim: the surface has no such patch, only lower, upper"
    ):
        Case.from_source(on).problem().triangulated()
    units = {"radius": "10 mm", "thickness": "0.2 mm", "youngs_modulus": "1 MPa"}
    shells = {}
    for i, (name, remanent) in enumerate(remanents.items()):
        place = {"position": [0, 0, f"{50 * i} mm"], "axis": {"polar": 90 * i, "azimuth": 90}}
        shells[name] = (
            cap(**units)
            | {"points": {}, "place": place}
            | ({"remanent": remanent} if remanent else {})
        )
    data = {
        "shells": shells,
        "magnetic": {"applied": {"flux_density": "1 mT"}},
        "mesh": {"degree": 2, "size": "5 mm"},
    }
    scene = Scene(Case.from_source(data))
    model, patches = scene.model, scene.model.midsurface.patches
    Br = model.loads.magnetic.remanent(*model.places(model.V.element.basix_element.points))
    _, n = model.places(model.V.element.basix_element.points)
    assert Br[patches["lower"]] == pytest.approx(n[patches["lower"]], abs=1e-12)
    # e1 turns by 90 degrees about e2 to -e3, which stays where it is about e3
    assert Br[patches["upper"]] == pytest.approx(
        np.broadcast_to([0, 0, -2], Br[patches["upper"]].shape), abs=1e-12
    )
    assert not Br[patches["plain"]].any()
    again = scene.problem.with_values({"shells.upper.shell.thickness": 1e-4})
    assert again.thickness.patches["upper"] == pytest.approx(0.5)


def test_messages() -> None:
    data = {"shells": {"lower": cap(), "upper": cap()}, "contact": [["upper", "lover"]]}
    with pytest.raises(
        CaseError, match=r"contact.0: lover: there is no such shell, only lower, upper"
    ):
        Case.from_source(data)
    with pytest.raises(
        CaseError, match=r"shells: each has its own boundary: leave out boundary, or shells"
    ):
        Case.from_source(data | {"boundary": {}})
    with pytest.raises(CaseError, match=r"shells.upper.shell.thickness: 0: must be greater than 0"):
        Case.from_source({"shells": {"lower": cap(), "upper": cap(thickness=0)}})
    with pytest.raises(
        CaseError, match=r"shells.upper.shell.viscosity: is another than that of lower"
    ):
        Case.from_source({"shells": {"lower": cap(viscosity=0.1), "upper": cap()}})
    with pytest.raises(CaseError, match=r"shells.upper.shell.density: is missing; lower has one"):
        Case.from_source({"shells": {"lower": cap(density=1), "upper": cap()}})
    with pytest.raises(
        CaseError,
        match=r"shells.upper.shell.youngs_modulus: is 1e\+09 times that of lower: allowed",
    ):
        Case.from_source({"shells": {"lower": cap(), "upper": cap(youngs_modulus=1e9)}})
    units = {"radius": "10 mm", "thickness": "0.2 mm", "youngs_modulus": "1 MPa"}
    measured = {"shells": {"lower": cap(), "upper": cap(**units) | {"points": {}}}}
    with pytest.raises(
        CaseError, match=r"shells.upper.shell: lengths of upper have units and those of lower none"
    ):
        Case.from_source(measured)
    wrong = {"shells": {"lower": cap(), "upper": cap() | {"boundary": {"rimm": "clamped"}}}}
    with pytest.raises(MeshError, match=r"shells.upper.*rimm"):
        Case.from_source(wrong).problem()
    near = cap() | {"place": {"position": [0, 0, 2 + 0.5 * h], "axis": {"polar": 180}}}
    data = {
        "shells": {"lower": cap(), "upper": near},
        "contact": [["upper", "lower"]],
        "mesh": {"degree": 2},
    }
    with pytest.raises(
        MeshError, match=r"contact: upper and lower overlap undeformed, by 0\.[45]\d* h at \("
    ):
        Scene(Case.from_source(data))
