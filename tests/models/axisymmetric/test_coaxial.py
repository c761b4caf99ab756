"""Several shells with one axis on their meridians: each is as it is alone, pairs are as on
surfaces, and they touch.
"""

from typing import Any

import numpy as np
import pytest
import scipy
from along import csr

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.fields.gathering import RevolvedGatherer
from magshell_fenicsx.parts.gap import SOFT_PENETRATION, Penalty
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.simulate.follow import follow

h = 0.02
PRESSURE = {"kind": "pressure", "control": "load", "until": "target", "pressure": 0.05, "points": 1}


def cap(**shell: Any) -> dict[str, Any]:
    """One of several shells."""
    keys = {
        "geometry": "cap",
        "radius": 1,
        "polar": 30,
        "thickness": h,
        "youngs_modulus": 1,
        "poisson_ratio": 0.3,
    }
    return {"shell": keys | shell, "boundary": {"rim": "clamped"}}


def placed(shell: dict[str, Any], z: float, polar: float = 180) -> dict[str, Any]:
    """That shell with its origin at z; by default upside down."""
    return shell | {"place": {"position": [0, 0, z], "axis": {"polar": polar}}}


def end(data: dict[str, Any]) -> tuple[Scene, dict[str, float]]:
    """The scene of a case, and what is observed at its end."""
    scene = Scene(Case.from_source(data))
    *_, last = follow(scene)
    return scene, scene.observe(last.point.state)


FLAW = {"kind": "formula", "w0": "0.1*z"}
OWN = {
    "radius": 1.4,
    "thickness": 0.03,
    "hole": 4,
    "youngs_modulus": 2,
    "poisson_ratio": 0.4,
    "imperfections": [FLAW],
}


def test_far_apart() -> None:
    """Each is as it is alone, whatever its place, side, size and material: path, ends and waves
    around, 1e-9.
    """
    edge = {"points": {"edge": [1.4 * np.sin(np.radians(4)), 0, 1.4 * np.cos(np.radians(4))]}}
    upper = cap(**OWN, density=3) | edge
    both = {"shells": {"lower": cap(density=1), "upper": placed(upper, 9)}}
    scene, seen = end(both | {"loading": PRESSURE | {"on": {"upper": "inside"}}})
    assert scene.model.axisymmetric
    assert {*scene.model.meridian.ends} == {"lower_rim", "upper_rim", "upper_hole"}
    of_own = (
        2 * (0.03 / 1.4) ** 2 / (1 - 0.4**2) ** 0.5 / (h**2 / (1 - 0.3**2) ** 0.5)
    )  # p_c over that of the first
    alone, its = end(upper | {"loading": PRESSURE | {"pressure": -0.05 / of_own}})
    for axis in "xz":  # turned about e2
        assert seen[f"upper_edge_u{axis}"] == pytest.approx(-its[f"edge_u{axis}"], rel=1e-9)
    assert abs(scene.model.displacement(scene.unloaded().u, "pole")).max() == 0
    assert seen["volume_change"] == pytest.approx(-(1.4**3) * its["volume_change"], rel=1e-9)
    first = Scene(Case.from_source(cap(density=1) | {"loading": PRESSURE}))
    squares = [
        [(m.eigenvalue, m.label) for m in ShellModes(each.model).vibrations(each.unloaded(), 8)]
        for each in (scene, first, alone)
    ]
    unit = 2 / 3 / 1.4**2  # E/(rho R^2) over that of the first
    separate = sorted(squares[1] + [(unit * value, label) for value, label in squares[2]])[:8]
    for (value, label), (own, its_label) in zip(squares[0], separate, strict=True):
        assert (value, label) == (pytest.approx(own, rel=1e-8), its_label)


@pytest.mark.slow
def test_pair_in_a_field() -> None:
    """Tops and volume as of halves of both, whose mesh converges to that: 1e-3 (3.7e-3 on elements
    of 0.15).
    """
    lower = cap() | {"remanent": {"kind": "radial"}, "points": {"top": [0, 0, 1]}}
    upper = placed(
        cap(**OWN) | {"remanent": {"polar": 0}, "points": {"edge": [0.09765906, 0, 1.39658967]}}, 3
    )
    data = {
        "shells": {"lower": lower, "upper": upper},
        "magnetic": {"lambda_m": 0.004, "applied": {"polar": 0}},
        "loading": PRESSURE | {"pressure": 0.3, "on": {"upper": "inside", "lower": "outside"}},
    }
    scene, seen = end(data)
    assert scene.model.axisymmetric
    half, other = end(data | {"symmetry": "half", "mesh": {"degree": 3, "size": 0.1}})
    assert half.model.multiplicity == 2
    for name in ("lower_top_uz", "upper_edge_uz", "volume_change", "magnetic"):
        assert seen[name] == pytest.approx(other[name], rel=1e-3)


def test_drawn() -> None:
    """Triangles of both turn their outer side up, cover their areas, and have the numbers of their
    shells.
    """
    data = {
        "shells": {"lower": cap(), "upper": placed(cap(radius=1.4, hole=4), 3)},
        "loading": PRESSURE,
    }
    scene = Scene(Case.from_source(data))
    surface = RevolvedGatherer(scene.model, scene.comm).gather(
        scene.unloaded().u, scene.unloaded().mu
    )
    assert surface.shells == ("lower", "upper")
    a, b, c = np.moveaxis(surface.r0[surface.cells], 1, 0)
    normal = np.cross(b - a, c - a) / 2
    assert (np.sum(normal * surface.n0[surface.cells].sum(axis=1), axis=1) > 0).all()
    of = surface.fields["shell"][surface.cells[:, 0]]
    areas = [np.linalg.norm(normal[of == i], axis=1).sum() for i in range(2)]
    cosines = np.cos(np.radians([30, 4]))
    exact = [2 * np.pi * (1 - cosines[0]), 2 * np.pi * 1.4**2 * (cosines[1] - cosines[0])]
    assert areas == pytest.approx(exact, rel=3e-3)


def test_highest_place_that_moves() -> None:
    """w is of the pole of an upside-down shell, whose clamped rim is above it: as alone; a rim that
    is free counts.
    """
    load = PRESSURE | {"on": {"upper": "outside"}}
    _, seen = end({"shells": {"lower": cap(), "upper": placed(cap(), 3)}, "loading": load})
    _, its = end(cap() | {"loading": PRESSURE})
    assert seen["w_over_h"] == pytest.approx(its["w_over_h"], rel=1e-9)
    free = {
        "shells": {
            "lower": cap(),
            "upper": placed(cap(hole=4) | {"boundary": {"hole": "clamped"}}, 3),
        }
    }
    meridian = Scene(Case.from_source(free | {"loading": load})).model.meridian
    assert meridian.section(np.array([meridian.points["pole"][0]]))[0, 1] == pytest.approx(
        3 - np.cos(np.radians(30))
    )


def test_ball_on_one_of_two() -> None:
    """A body that is placed `at` a shell comes along its normal: as on that shell alone, turned
    over or tilted.
    """
    load = {"kind": "contact", "approach": 1, "points": 1}
    on_shell = {"bodies": {"ball": {"kind": "sphere", "radius": 0.2}}, "loading": load}
    _, one = end(cap() | on_shell)
    ball = {"kind": "sphere", "radius": 0.2, "at": {"point": [0, 0, 2]}}
    both = {
        "shells": {"lower": cap(), "upper": placed(cap(), 3)},
        "bodies": {"ball": ball},
        "loading": load,
    }
    _, two = end(both)
    assert two["force"] == pytest.approx(one["force"], rel=1e-6)
    tilted = {"shells": {"lower": cap(), "upper": placed(cap(), 3, 150)}, "loading": PRESSURE}
    axis = np.array([0.5, 0.0, -np.sqrt(0.75)])
    normal = Case.from_source(tilted).problem().shape.in_memory.normal(np.add([0, 0, 3], axis))
    assert normal == pytest.approx(axis, abs=1e-12)


def touching(upper: dict[str, Any], z: float, load: dict[str, Any], **shell: Any) -> Scene:
    """Two shells that may touch, the lower one with other keys."""
    shells = {"lower": cap(**shell), "upper": placed(upper, z)}
    return Scene(
        Case.from_source({"shells": shells, "contact": [["upper", "lower"]], "loading": load})
    )


def pressed(scene: Scene, down: float) -> State:
    """The upper shell pushed into the lower one, both bent a little."""
    model, r = scene.model, scene.model.r0.x.array.reshape(-1, 2)
    u = 1e-2 * h * np.sin(5 * r + 1)
    u[np.unique(model.V.dofmap.list[model.meridian.patches["upper"]]), 1] -= down * h
    return State(model.system.zero_at_supports(u.ravel()), scene.unloaded().mu)


@pytest.mark.parametrize(
    ("hole", "z", "shell"),
    [
        (None, 2 + 1.0001 * h, {}),
        (6, np.cos(np.radians(6)) * 2 + 1.01 * h, {}),
        (None, 2 + 1.35001 * h, {"thickness_factor": "1.5 - 4*(x**2 + y**2)"}),
    ],
)
def test_contact_derivatives(hole: float | None, z: float, shell: dict[str, Any]) -> None:
    """Residual and tangent by differences, face on face and an edge on a face; waves of m = 0 have
    half the tangent.
    """
    upper = (
        cap(**({"thickness_factor": "1.2 - 6*(1 - z)"} if shell else {}))
        if hole is None
        else cap(hole=hole)
    )
    scene = touching(upper, z, PRESSURE, **shell)
    system, state, (contact,) = scene.model.system, pressed(scene, 0.05), scene.model.shell_contacts
    at = system.at_state(state)
    assert at.evaluate(contact.force) > 0
    v = system.zero_at_supports(np.random.default_rng(1).standard_normal(state.u.size))
    step = 1e-7 * h
    ahead, back = (State(state.u + way * step * v, state.mu) for way in (1, -1))
    energies = [sum(scene.energies(each).values()) for each in (ahead, back)]
    residuals = [
        system.zero_at_supports(system.residual(each.u, each.mu)) for each in (ahead, back)
    ]
    slope = system.residual(state.u, state.mu) @ v
    assert slope == pytest.approx((energies[0] - energies[1]) / (2 * step), rel=1e-6)
    Kv = system.zero_at_supports(csr(system.tangent(state.u, state.mu)) @ v)
    assert np.linalg.norm(Kv - (residuals[0] - residuals[1]) / (2 * step)) < 1e-6 * np.linalg.norm(
        Kv
    )
    waves, plane = at.evaluate(lambda: contact.entries_of_waves(0.0)), at.evaluate(contact.entries)
    n = state.u.size // 2
    Q = scipy.sparse.coo_array((waves[2], waves[:2]), (3 * n, 3 * n))
    K = scipy.sparse.coo_array((plane[2], plane[:2]), (2 * n, 2 * n))
    wave = np.insert(v.reshape(-1, 2), 1, 0.0, axis=1).ravel()
    assert wave @ Q @ wave == pytest.approx(v @ K @ v / 2, rel=1e-12)


def test_a_released_contact_is_that_of_its_state() -> None:
    """A contact that was held at a light state has, once released, the energy of the deep one."""
    scene = touching(cap(radius=1.3), 2.3 + (1 + 1e-4) * h, PRESSURE)
    system, (contact,) = scene.model.system, scene.model.shell_contacts
    deep, light = (system.at_state(pressed(scene, depth)) for depth in (0.05, 0.01))
    energy = deep.evaluate(contact.energy)
    contact.hold(light.evaluate(contact.freeze))
    assert deep.evaluate(contact.energy) != energy
    contact.hold(None)
    assert deep.evaluate(contact.energy) == energy


@pytest.mark.parametrize("symmetry", ["axisymmetric", "half"])
def test_an_edge_presses_on_a_face(symmetry: str) -> None:
    """The pressure over each of both shells is the contact force."""
    disc = cap(polar=10)
    top = np.sqrt(1 - 0.1**2) - 1.01 * h
    tube = {
        "geometry": "cylinder",
        "radius": 0.1,
        "length": 0.1,
        "thickness": h,
        "youngs_modulus": 1,
        "poisson_ratio": 0,
    }
    tube = {"shell": tube, "boundary": {"bottom": "clamped"}}
    shells = {"disc": disc, "tube": tube | {"place": {"position": [0, 0, top - 0.1]}}}
    data = {
        "shells": shells,
        "contact": [["disc", "tube"]],
        "symmetry": symmetry,
        "loading": PRESSURE,
    }
    scene = Scene(
        Case.from_source(
            data | {"mesh": {"degree": 2, "size": 0.04 if symmetry == "axisymmetric" else 0.06}}
        )
    )
    model = scene.model
    u = np.zeros((model.system.size // model.V.dofmap.bs, model.V.dofmap.bs))
    of_shells = model.meridian.patches if model.axisymmetric else model.midsurface.patches
    u[np.unique(model.V.dofmap.list[of_shells["tube"]]), -1] = 0.02 * h
    (contact,), at = (
        model.shell_contacts,
        model.system.at_state(State(u.ravel(), scene.unloaded().mu)),
    )
    pressure, force = at.evaluate(contact.cell_pressures_and_gaps)[0], at.evaluate(contact.force)
    points = contact._points
    area = np.bincount(points.cell, points.weight, len(pressure))
    assert force > 0
    for inside in of_shells.values():
        assert (pressure * area)[inside].sum() == pytest.approx(force, rel=1e-12)


@pytest.mark.parametrize(
    ("m", "factor"), [(1, None), pytest.param(2, "1.5 - 4*(x**2 + y**2)", marks=pytest.mark.slow)]
)
def test_waves_of_contact(m: int, factor: str | None) -> None:
    """The second variation along a wave, of half the thickness too, is that of the distances of its
    points in space.
    """
    shell, thick = ({"thickness_factor": factor}, 1.25) if factor else ({}, 1.0)
    scene = touching(cap(radius=1.3), 2.3 + (thick + 1e-4) * h, PRESSURE, **shell)
    system, state, (contact,) = scene.model.system, pressed(scene, 0.05), scene.model.shell_contacts
    at = system.at_state(state)
    faced, (H, nodes) = (
        at.evaluate(contact._active_set).places,
        at.evaluate(lambda: contact._second_derivative(m)),
    )
    r = scene.model.r0.x.array.reshape(-1, 2)
    U, V, W, T = (
        100 * r[:, 0] ** 2 * np.cos(k * r[:, 0] + r[:, 1]) for k in (1, 2, 3, 4)
    )  # regular on the axis
    some = range(0, len(faced.point), 5)
    waves = np.column_stack([U, V, W, T])[nodes[some]].reshape(len(some), -1)
    Q = np.einsum("na,nab,nb", waves, H[some], waves) / 2
    nodal = np.column_stack([r + state.u.reshape(-1, 2), U, V, W])
    element, cells = scene.model.V.element.basix_element, scene.model.V.dofmap.list
    rule, k, size, half = contact._points, contact.stiffness.value, contact._h, contact._half

    def moved(row: Any, theta: Any, e: float) -> Any:
        rho, z, u, v, w = row
        radial, around = rho + e * u * np.cos(m * theta), e * v * np.sin(m * theta)
        cos, sin = np.cos(theta), np.sin(theta)
        return np.array(
            [
                radial * cos - around * sin,
                radial * sin + around * cos,
                z + e * w * np.cos(m * theta),
            ]
        )

    def thick(cell: int, theta: Any, e: float) -> Any:
        return (half + e * np.cos(m * theta) * T)[cells[cell]]

    def energy(e: float) -> float:
        total, angles = 0.0, 2 * np.pi * (np.arange(2 * m + 1) + 0.3) / (2 * m + 1)
        for point, cell, X in zip(faced.point[some], faced.cell[some], faced.X[some], strict=True):
            own = rule.shape[point] @ nodal[cells[rule.cell[point]]]
            for theta in angles:
                x = moved(own, theta, e)

                def gap(y: Any, x: Any = x, cell: int = cell, theta: float = theta) -> Any:
                    shape = element.tabulate(0, np.array([[y[0]]]))[0, 0, :, 0]
                    row = shape @ nodal[cells[cell]]
                    around = theta + y[1]
                    return np.linalg.norm(x - moved(row, around, e)) - shape @ thick(
                        cell, around, e
                    )

                def slope(y: Any, gap: Any = gap) -> Any:
                    return [gap(y + step) - gap(y - step) for step in 1e-3 * np.eye(2)]

                near = scipy.optimize.root(slope, [X, 0.0], tol=1e-14)
                deep = rule.shape[point] @ thick(rule.cell[point], theta, e) - gap(near.x)
                total += (
                    rule.weight[point]
                    / 2
                    * Penalty(k, SOFT_PENETRATION * size).derivatives(np.array(deep))[0]
                    / len(angles)
                )
        return total

    e = 1e-4 * h
    second = (energy(e) - 2 * energy(0.0) + energy(-e)) / e**2
    assert pytest.approx(second, rel=1e-3) == Q


def test_messages() -> None:
    """Why there is no meridian."""
    beside = cap() | {"place": {"position": [3, 0, 0]}}
    dented_states = cap(imperfections=[{"kind": "formula", "w0": "0.1*x"}])
    for other, reason in (
        (beside, r"shells.upper.place: its axis is not e3 through the origin"),
        (dented_states, r"shells.upper.an imperfection differs around e3"),
    ):
        data = {
            "shells": {"lower": cap(), "upper": other},
            "symmetry": "axisymmetric",
            "loading": PRESSURE,
        }
        with pytest.raises(CaseError, match=rf"symmetry: axisymmetric: {reason}"):
            Case.from_source(data).problem()


@pytest.mark.slow
def test_two_caps_are_one_on_a_plane() -> None:
    """Tapered ones, pressed pole to pole: each is as one on a rigid plane, F at one thickness to
    1e-3.
    """
    factor, top = "1.3 - 4*(1 - z)", 1.3

    def moved(**moves: float) -> dict[str, Any]:
        moving = [
            {"supports": [name.replace("_", ".")], "translation": [0, 0, z * h]}
            for name, z in moves.items()
        ]
        return {
            "kind": "edge",
            "name": "w",
            "control": "load",
            "factor": 1,
            "points": 1,
            "moves": moving,
        }

    plane = {"kind": "plane", "position": [0, 0, 1 + top * h / 2], "direction": [0, 0, -1]}
    shell = cap(polar=40, thickness_factor=factor)
    _, one = end(shell | {"bodies": {"plane": plane}, "loading": moved(rim=1)})
    shells = {"lower": shell, "upper": placed(shell, 2 + top * h)}
    load = moved(lower_rim=1, upper_rim=-1)
    two, seen = end({"shells": shells, "contact": [["upper", "lower"]], "loading": load})
    assert two.model.axisymmetric
    assert seen["contact_force"] * two.model.force_unit == pytest.approx(
        one["reaction"] / h, rel=1e-3
    )


@pytest.mark.slow
def test_ridges_that_are_highest_between_nodes() -> None:
    """Discs 2 h apart, with ridges of 1.8 h: faces of mid-surfaces in space 0.2 h apart."""
    ridge = "1 + 0.8*exp(-((x**2 + y**2) - 0.09)**2/0.0036)"
    disc = {
        "geometry": "disc",
        "radius": "1 m",
        "thickness": "0.03 m",
        "youngs_modulus": "1 Pa",
        "poisson_ratio": 0.3,
    }
    shells = {
        name: {"shell": disc | {"thickness_factor": ridge}, "boundary": {"rim": "clamped"}} | place
        for name, place in (("lower", {}), ("upper", {"place": {"position": [0, 0, "0.06 m"]}}))
    }
    loading = PRESSURE | {"pressure": "1 mPa", "on": {"upper": "outside"}}
    data = {
        "shells": shells,
        "contact": [["upper", "lower"]],
        "mesh": {"size": "0.05 m"},
        "loading": loading,
    }
    scene = Scene(Case.from_source(data))
    (touching,) = scene.model.shell_contacts
    assert scene.model.axisymmetric
    assert scene.model.system.at_state(scene.unloaded()).evaluate(
        touching.least_gap
    ) == pytest.approx(0.2 * 0.03, rel=1e-2)


@pytest.mark.slow
def test_a_wave_that_comes_and_goes_in_contact() -> None:
    """Pressed domes tilt (m = 1) in a window with a point of the path, where 100 loads find it on
    this mesh.
    """
    dome = {
        "geometry": "cap",
        "radius": 1,
        "polar": 20,
        "hole": 2,
        "thickness": 0.015,
        "poisson_ratio": 0.3,
    }
    lower, upper = (
        {"shell": dome | {"youngs_modulus": E}, "boundary": {"rim": "hinged"}} for E in (3, 1)
    )
    upper["place"] = {"position": [0, 0, 1.5 * 0.015]}
    load = {
        "kind": "dead",
        "control": "arc",
        "until": "target",
        "displacement": 5.5 * 0.015,
        "points": 1,
    }
    data = {
        "shells": {"lower": lower, "upper": upper}, "contact": [["upper", "lower"]],
        "mesh": {"refinement": 0.5},
        "loading": load | {"loads": [{"edge": "upper.hole", "force": [0, 0, -1]}]},
    }  # fmt: skip
    scene = Scene(Case.from_source(data))
    found = [
        (r.mode, scene.observe(r.point.state)) for r in follow(scene) if r.label == "bifurcation"
    ]
    assert [mode for mode, _ in found] == ["m = 1", "m = 1"]
    assert [seen["w_over_h"] for _, seen in found] == pytest.approx([5.1391, 5.4461], abs=1e-3)
    assert [seen["contact_force"] for _, seen in found] == pytest.approx([6.7579, 7.0356], abs=1e-3)
