"""The own field of a shell: closed forms, magpylib's charged triangles, and derivatives by
differences.
"""

from dataclasses import replace
from functools import cache
from typing import Any

import basix
import magpylib
import numpy as np
import pytest
from conftest import CASES
from scipy.integrate import quad
from scipy.spatial.transform import Rotation

from magshell_fenicsx import Case, Scene, gradient
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.magnetism.charges import ShellFaces, field, moment
from magshell_fenicsx.parts.magnetism.magnetised_cells import MagnetisedShell
from magshell_fenicsx.parts.magnetism.readings import moment_in_summary, slope_of_sensor
from magshell_fenicsx.public import follow, run

MM = 1e-3
LAGRANGE = basix.ElementFamily.P, basix.LagrangeVariant.gll_warped


def dipole(x: np.ndarray, m: np.ndarray) -> np.ndarray:
    r = np.linalg.norm(x, axis=1)[:, None]
    return np.asarray((3 * x * (x @ m)[:, None] / r**5 - m / r**3) / (4 * np.pi))


def sphere_of_meridians(h: float, B: np.ndarray) -> MagnetisedShell:
    """A closed sphere as a meridian from pole to pole."""
    element = basix.create_element(LAGRANGE[0], basix.CellType.interval, 6, LAGRANGE[1])
    angle = np.pi * (np.arange(16)[:, None] + element.points[:, 0]) / 16
    r0 = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    return MagnetisedShell(
        element, r0, 0 * r0, element, np.broadcast_to(B, (*r0.shape[:2], 3)), h, None, True
    )


def sphere_of_triangles(h: float, B: np.ndarray) -> MagnetisedShell:
    """An octahedron of 8 x 64 triangles, on the sphere."""
    element = basix.create_element(LAGRANGE[0], basix.CellType.triangle, 6, LAGRANGE[1])
    X, cells = element.points, list[np.ndarray]()
    for signs in np.array(np.meshgrid([1, -1], [1, -1], [1, -1])).reshape(3, -1).T:
        corners = np.diag(signs)[:: int(np.prod(signs))]
        for i in range(8):
            for j in range(8 - i):
                up = [(i, j), (i + 1, j), (i, j + 1)]
                for triple in [
                    up,
                    *([[(i + 1, j), (i + 1, j + 1), (i, j + 1)]] if i + j < 7 else []),
                ]:
                    barycentric = np.array([[8 - a - b, a, b] for a, b in triple]) / 8
                    cells.append((np.column_stack([1 - X.sum(axis=1), X]) @ barycentric) @ corners)
    flat = np.array(cells)
    r0 = flat / np.linalg.norm(flat, axis=-1, keepdims=True)
    return MagnetisedShell(element, r0, 0 * r0, element, np.broadcast_to(B, r0.shape), h)


@pytest.mark.parametrize("made", [sphere_of_meridians, sphere_of_triangles])
def test_a_closed_sphere(made: Any) -> None:
    """Uniformly magnetised it has no field inside (1e-4 of Br h/R), and outside that of the dipole
    (1e-6).
    """
    h, B = 0.02, np.array([0.0, 0.0, 1.0])
    families = [ShellFaces(made(h, B), np.arange(len(made(h, B).r0)))]
    assert (
        np.abs(field(families, np.array([[0, 0, 0], [0.3, 0.2, 0.1], [0, 0.5, -0.7]]))).max()
        < 1e-4 * h
    )
    m = 4 * np.pi / 3 * ((1 + h / 2) ** 3 - (1 - h / 2) ** 3) * B
    np.testing.assert_allclose(moment(families), m, atol=1e-6 * m[2])
    x = np.array([[0, 0, 1.5], [1.2, 0.4, 0.3], [0, -3, 2], [1 + 1.5 * h, 0, 0]])
    expected = dipole(x, m)
    error = np.linalg.norm(field(families, x) - expected, axis=1) / np.linalg.norm(expected, axis=1)
    assert (error < 1e-6).all(), error


def test_the_case_hall_sensor() -> None:
    """The dome's field on its axis before the ball comes, by SciPy: charges of both faces and of
    the rim; 1e-6.
    """
    R, h, z, edge = 14.142135623730951 * MM, 0.7 * MM, 7 * MM, np.pi / 4

    def face(r: float) -> float:
        def rate(a: float) -> float:
            d = np.hypot(r * np.sin(a), z - r * np.cos(a))
            return float(np.cos(a) * (z - r * np.cos(a)) / d**3 * r**2 * np.sin(a) / 2)

        return float(quad(rate, 0, edge, epsabs=0, epsrel=1e-10)[0])

    def rim(r: float) -> float:
        d = np.hypot(r * np.sin(edge), z - r * np.cos(edge))
        return float(-np.sin(edge) * (z - r * np.cos(edge)) / d**3 * r * np.sin(edge) / 2)

    expected = 0.08 * (
        face(R + h / 2) - face(R - h / 2) + quad(rim, R - h / 2, R + h / 2, epsrel=1e-10)[0]
    )
    first, *_, last = run(Case.load(CASES / "hall_sensor.yaml", ["loading.points=2"])).rows
    assert first["hall_Bz"] == pytest.approx(expected, rel=1e-6)
    assert last["hall_Bz"] < 0.9 * first["hall_Bz"]


CAP = {
    "geometry": "cap",
    "radius": "20 mm",
    "thickness": "1 mm",
    "polar": 45,
    "youngs_modulus": "1 MPa",
}
STRIP = {
    "geometry": "strip",
    "radius": "30 mm",
    "width": 0.3,
    "thickness": "0.6 mm",
    "youngs_modulus": "1 MPa",
}
BLOCK = {**STRIP, "radius": "20 mm", "thickness": "2 mm"}
SQUASHED = np.array([[1.2, 0.1, 0.0], [0.0, 0.9, 0.1], [0.1, 0.0, 0.6]])


def made(
    shell: dict[str, Any], magnetic: dict[str, Any], sensors: dict[str, Any], **sections: Any
) -> Scene:
    edge = {"root": "clamped"} if shell["geometry"] == "strip" else {"rim": "clamped"}
    given = {
        "shell": {"poisson_ratio": 0.3, **shell},
        "boundary": edge,
        "magnetic": magnetic,
        "sensors": sensors,
    }
    return Scene(
        Case.model_validate(given | {"loading": {"kind": "pressure"}} | sections).problem()
    )


def triangles_of_a_cap(
    n: int, h: float, B: np.ndarray, A: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Corners and polarizations of flat triangles on faces and rim of a cap of radius 1 that A has
    deformed.

    Their charges are Br.N of the undeformed cap in the middle of each.
    """
    phi, theta = np.pi / 4 * np.linspace(0, 1, n + 1), 2 * np.pi * np.arange(6 * n + 1) / (6 * n)

    def place(phi: np.ndarray, theta: np.ndarray, eta: np.ndarray) -> np.ndarray:
        n0 = np.stack(
            [np.sin(phi) * np.cos(theta), np.sin(phi) * np.sin(theta), np.cos(phi)], axis=-1
        )
        n = n0 @ np.linalg.inv(A)
        return np.asarray(
            n0 @ A.T + (h * eta)[..., None] * n / np.linalg.norm(n, axis=-1, keepdims=True)
        )

    def drawn(phi: np.ndarray, theta: np.ndarray, eta: np.ndarray) -> np.ndarray:
        n0 = np.stack(
            [np.sin(phi) * np.cos(theta), np.sin(phi) * np.sin(theta), np.cos(phi)], axis=-1
        )
        return np.asarray((1 + h * eta)[..., None] * n0)

    def squares(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        P, Q = np.meshgrid(a, b, indexing="ij")
        corners = [
            (P[i:j, k:m], Q[i:j, k:m])
            for i, j in ((0, -1), (1, None))
            for k, m in ((0, -1), (1, None))
        ]
        p = np.array([np.stack(c, axis=-1).reshape(-1, 2) for c in corners])
        return np.concatenate([p[[0, 2, 3]], p[[0, 3, 1]]], axis=1)  # (3, triangles, 2)

    corners, charges = [], []
    for eta, flip in ((0.5, 1), (-0.5, -1)):
        a, b = np.moveaxis(squares(phi, theta), -1, 0)
        corners.append((place(a, b, eta + 0 * a), drawn(a, b, eta + 0 * a), flip))
    eta, b = np.moveaxis(squares(np.linspace(-0.5, 0.5, n // 10 + 1), theta), -1, 0)
    corners.append((place(np.pi / 4 + 0 * b, b, eta), drawn(np.pi / 4 + 0 * b, b, eta), -1))
    vertices = np.concatenate([np.moveaxis(x, 0, 1) for x, _, _ in corners])
    for _, X, flip in corners:
        charges.append(flip * np.cross(X[1] - X[0], X[2] - X[0]) @ B / 2)
    m = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]) / 2
    area = np.linalg.norm(m, axis=-1)
    kept = area > 1e-14
    q = np.concatenate(charges)
    return vertices[kept], (q[kept] / area[kept] ** 2)[:, None] * m[kept]


@pytest.mark.parametrize("symmetry", ["none", "half"])
def test_a_deformed_cap_against_magpylib(symmetry: str) -> None:
    """Charged triangles of two sizes, extrapolated: 1e-3, 1e-5 and 1e-6 at 0.5, 5 and 50 h from the
    outer face.
    """
    h, A = (
        0.05,
        SQUASHED if symmetry == "none" else np.array([[1.2, 0, 0.1], [0, 0.9, 0], [0.1, 0, 0.6]]),
    )
    B = np.array([0.6, 0.0, 0.8])
    u, v = 0.3, 0.2 if symmetry == "none" else 0.0
    n0 = np.array([u, v, np.sqrt(1 - u**2 - v**2)])
    n = np.linalg.inv(A).T @ n0
    x = np.array([A @ n0 + (0.5 + away) * h * n / np.linalg.norm(n) for away in (0.5, 5.0, 50.0)])
    sensors = {
        f"s{i}": {"position": [0.0, 0.0, 0.05]} for i in range(3)
    }  # outside the undeformed cap
    polar = float(np.degrees(np.arctan2(0.6, 0.8)))
    scene = made(CAP, {"remanent": {"polar": polar, "flux_density": "1 T"}}, sensors,
                 symmetry=symmetry, mesh={"degree": 4, "size": 1.6 * MM})  # fmt: skip
    loads = scene.model.loads
    scene.model.loads = replace(
        loads,
        sensors=tuple(
            replace(each, place=place) for each, place in zip(loads.sensors, x, strict=True)
        ),
    )
    r0 = scene.model.r0.x.array.reshape(-1, 3)
    moved = (r0 @ (A - np.eye(3)).T).ravel()[: scene.model.system.size]
    row = scene.observe(State(moved, scene.unloaded().mu))
    found = np.array([[row[f"s{i}_B{axis}"] for axis in "xyz"] for i in range(3)])
    rough, fine = (_reference(k, h, B, A, x) for k in (40, 80))
    expected = fine + (fine - rough) / 3
    error = np.linalg.norm(found - expected, axis=1) / np.linalg.norm(expected, axis=1)
    assert (error < [1e-3, 1e-5, 1e-6]).all(), error


@pytest.mark.parametrize("law", ["deformation", "rotation"])
def test_a_stretched_disc_of_rubber(law: str) -> None:
    """Magnetised across and stretched by 1.5: a cylinder of the same volume, 1/2.25 as thick; on
    its axis.

    F takes the remanence down to 1/2.25 too, its rotation leaves it. The cylinder's field is that
    of two charged discs.
    """
    R, h, z = 10 * MM, 0.5 * MM, 3 * MM
    disc = {
        "geometry": "disc",
        "radius": "10 mm",
        "thickness": "0.5 mm",
        "youngs_modulus": "1 MPa",
        "poisson_ratio": 0.5,
    }
    case = {
        "shell": {**disc, "law": "neo-hookean"},
        "boundary": {"rim": "clamped"},
        "magnetic": {
            "remanent": {"polar": 0, "flux_density": "1 T"},
            "applied": {"flux_density": "1 mT"},
            "remanence": law,
        },
        "sensors": {"hall": {"position": [0, 0, "3 mm"]}},
        "loading": {"kind": "field"},
    }
    scene = Scene(Case.from_source(case))
    u = 0.5 * scene.model.r0.x.array[: scene.model.system.size]
    found = scene.observe(State(u, scene.unloaded().mu))["hall_Bz"]
    half, rim, size = h / 2.25 / 2, 1.5 * R, 1 / 2.25 if law == "deformation" else 1.0
    up, down = ((z + way * half) / np.hypot(z + way * half, rim) for way in (1, -1))
    assert found == pytest.approx(size * (up - down) / 2, rel=1e-7)


def test_a_strip_that_turns_takes_its_remanence_along() -> None:
    """Without strain both laws give one field, which a sensor that turns along reads unchanged."""
    strip = {
        "geometry": "plate",
        "length": "10 mm",
        "width": "2 mm",
        "thickness": "0.2 mm",
        "youngs_modulus": "1 MPa",
        "poisson_ratio": 0.5,
    }
    turn = Rotation.from_euler("z", 90, degrees=True)
    place = np.array([3.0, 2.0, 1.0])
    fields = []
    for law, turned in (("deformation", False), ("rotation", False), ("rotation", True)):
        x, y, z = (float(component) for component in (turn.apply(place) if turned else place))
        case = {
            "shell": strip,
            "boundary": {"left": "clamped"},
            "symmetry": "none",
            "magnetic": {
                "remanent": {"polar": 70, "azimuth": 20, "flux_density": "1 T"},
                "applied": {"flux_density": "1 mT"},
                "remanence": law,
            },
            "sensors": {"hall": {"position": [f"{x} mm", f"{y} mm", f"{z} mm"]}},
            "loading": {"kind": "field"},
        }
        scene = Scene(Case.from_source(case))
        r0 = scene.model.r0.x.array[: scene.model.system.size].reshape(-1, 3)
        u = turn.apply(r0) - r0 if turned else 0 * r0
        row = scene.observe(State(u.ravel(), scene.unloaded().mu))
        field_at_sensor = np.array([row[f"hall_B{axis}"] for axis in "xyz"])
        fields.append(turn.inv().apply(field_at_sensor) if turned else field_at_sensor)
    expected, *others = fields
    for other in others:
        assert other == pytest.approx(expected, rel=1e-7)


@cache
def _key(
    k: int, h: float, B: tuple[float, ...], A: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    return triangles_of_a_cap(k, h, np.array(B), np.array(A).reshape(3, 3))


def _reference(k: int, h: float, B: np.ndarray, A: np.ndarray, x: np.ndarray) -> np.ndarray:
    vertices, J = _key(k, h, tuple(B), tuple(A.ravel()))
    rows = []
    for each in x:
        seen = np.broadcast_to(each, (len(J), 3))
        rows.append(
            magpylib.core.triangle_Bfield(observers=seen, vertices=vertices, polarizations=J).sum(
                axis=0
            )
        )
    return np.array(rows)


FIELD = {
    "remanent": {"polar": 70, "flux_density": "60 mT"},
    "applied": {"polar": 20, "flux_density": "30 mT"},
}
KINDS = {
    "full": lambda: made(
        CAP,
        {**FIELD, "remanent": {"kind": "expression", "components": ["1 + x", "y", "z*x"],
                               "flux_density": "60 mT"}},
        {"hall": {"position": [2 * MM, 1 * MM, 8 * MM], "field": "total"}}, symmetry="none",
        mesh={"degree": 2, "size": 0.4}),
    "half, rotation law": lambda: made(
        STRIP, {**FIELD, "remanence": "rotation"},
        {"hall": {"position": [20 * MM, 1 * MM, 3 * MM]}}, symmetry="half",
        mesh={"degree": 2, "size": 0.3}, loading={"kind": "field"}),
    "half, soft": lambda: made(STRIP, {**FIELD, "susceptibility": "1 + x"},
                               {"hall": {"position": [20 * MM, 1 * MM, 3 * MM]}}, symmetry="half",
                               mesh={"degree": 2, "size": 0.3}, loading={"kind": "field"}),
    "meridian, radial": lambda: made(
        CAP,
        {**FIELD, "remanent": {"kind": "radial", "flux_density": "60 mT"},
         "applied": {"flux_density": "30 mT"}},
        {"hall": {"position": [3 * MM, 1 * MM, 12 * MM]}}),
    "meridian, thickness, soft": lambda: made(
        {**CAP, "thickness_factor": "1 + z/4"},
        {"susceptibility": 2, "applied": {"flux_density": "30 mT"}},
        {"hall": {"position": [3 * MM, 1 * MM, 12 * MM]}}),
    "full, rubber": lambda: made({**CAP, "law": "neo-hookean", "poisson_ratio": 0.5}, FIELD,
                                 {"hall": {"position": [2 * MM, 1 * MM, 8 * MM]}}, symmetry="none",
                                 mesh={"degree": 2, "size": 0.4}),
    "meridian, rubber, rotation law": lambda: made(
        {**CAP, "law": "neo-hookean", "poisson_ratio": 0.5, "thickness_factor": "1 + z/4"},
        {**FIELD, "remanent": {"kind": "radial", "flux_density": "60 mT"},
         "applied": {"flux_density": "30 mT"}, "remanence": "rotation"},
        {"hall": {"position": [3 * MM, 1 * MM, 12 * MM]}}),
    "solid": lambda: made(
        BLOCK,
        {**FIELD, "remanent": {"kind": "expression", "components": ["1 + x", "y", "z*x"],
                               "flux_density": "60 mT"}},
        {"hall": {"position": [12 * MM, 1 * MM, 4 * MM], "field": "total"}}, symmetry="none",
        model="solid", mesh={"refinement": 0.3}),
    "half solid, rotation law, soft": lambda: made(
        BLOCK, {**FIELD, "susceptibility": "1 + x", "remanence": "rotation"},
        {"hall": {"position": [12 * MM, 1 * MM, 4 * MM]}}, symmetry="half",
        model="solid", mesh={"refinement": 0.3}, loading={"kind": "field"}),
}  # fmt: skip
QUICK = ("full", "meridian, radial", "full, rubber")


@cache
def scene(kind: str) -> Scene:
    return KINDS[kind]()


@pytest.mark.parametrize(
    "kind", [k if k in QUICK else pytest.param(k, marks=pytest.mark.slow) for k in KINDS]
)
def test_slopes_of_a_reading(kind: str) -> None:
    """By the displacement and the amplitudes: central differences of the reading."""
    here = scene(kind)
    rng, system = np.random.default_rng(3), here.model.system
    u, v = (
        system.zero_at_supports(size * rng.standard_normal(system.size)) for size in (2e-4, 1.0)
    )
    mu = {**here.unloaded().mu, "lambda_m": 0.4}
    for column in ("hall_Bx", "hall_Bz"):
        slope = slope_of_sensor(here.view, State(u, mu), column)
        assert slope

        def value(u: np.ndarray, mu: dict[str, float], column: str = column) -> float:
            return here.observe(State(u, mu))[column]

        e = 1e-5
        a, b, c, d = (value(u + way * e * v, mu) for way in (-2, -1, 1, 2))
        assert slope.value == pytest.approx(value(u, mu), rel=1e-12)
        assert slope.by_u @ v == pytest.approx((a - 8 * b + 8 * c - d) / (12 * e), rel=1e-6)
        a, b, c, d = (value(u, {**mu, "lambda_m": 0.4 + way * 1e-3}) for way in (-2, -1, 1, 2))
        expected = (a - 8 * b + 8 * c - d) / 12e-3
        assert slope.by_mu.get("lambda_m", 0.0) == pytest.approx(expected, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("law", ["deformation", pytest.param("rotation", marks=pytest.mark.slow)])
def test_gradient_by_a_remanence(law: str) -> None:
    """A strip that its field bends: the reading of two solved strips with other remanences, 1e-5;
    and by its angle.
    """

    def solved(e: float, polar: float = 10.0) -> tuple[Scene, Any]:
        components = [f"0.9 + {e!r}*x", f"{e!r}*x**2", f"0.1 + {e!r}*(1 - x)"]
        remanent = {"kind": "expression", "components": components, "flux_density": "60 mT"}
        applied = {"polar": polar, "flux_density": "1 mT"}
        magnetic = {"remanent": remanent, "applied": applied, "remanence": law}
        others = {
            "symmetry": "none",
            "loading": {"kind": "field", "points": 1},
            "mesh": {"degree": 3, "size": 0.3},
        }
        here = made(STRIP, magnetic, {"hall": {"position": [25 * MM, 1 * MM, -4 * MM]}}, **others)
        *_, last = follow(here)
        return here, last

    here, last = solved(0.0)
    found = gradient(
        here, last, of="hall_Bz", by=["remanence", "lambda_m", "magnetic.applied.polar"]
    )
    x, _, _ = np.moveaxis(found["remanence"].places, -1, 0)
    change = np.stack([x, x**2, 1 - x], axis=-1)

    def reading(*given: float) -> float:
        there, end = solved(*given)
        return there.observe(end.point.state)["hall_Bz"]

    e = 2e-3
    by_field = (reading(e) - reading(-e)) / (2 * e)
    assert found["remanence"].along(change) == pytest.approx(by_field, rel=1e-5)
    by_angle = (reading(0.0, 10.01) - reading(0.0, 9.99)) / 0.02
    assert found["magnetic.applied.polar"] == pytest.approx(by_angle, rel=1e-5)


def test_export_to_magpylib() -> None:
    """Its field is the sensor's, up to flat triangles. The moment is Br V/mu0 of a rigid cap."""
    place = [3 * MM, 1 * MM, 12 * MM]
    here = made(
        CAP, {"remanent": {"polar": 0, "flux_density": "60 mT"}}, {"hall": {"position": place}}
    )
    record = type("Start", (), {"point": type("Point", (), {"state": here.unloaded()})})
    rough, fine = (here.to_magpylib(record, parts) for parts in (4, 8))
    row = here.observe(here.unloaded())
    read = np.array([row[f"hall_B{axis}"] for axis in "xyz"])
    B = [magpylib.getB(shell, place) for shell in (rough, fine)]
    np.testing.assert_allclose(B[1], read, atol=3e-3 * abs(read[2]))
    np.testing.assert_allclose((4 * B[1] - B[0]) / 3, read, atol=1e-4 * abs(read[2]))
    np.testing.assert_allclose(magpylib.getH(fine, place), B[1] / (4e-7 * np.pi), rtol=1e-9)
    said = moment_in_summary(here.view, here.unloaded())
    volume = 2 * np.pi * (1 - np.sqrt(0.5)) * ((20.5 * MM) ** 3 - (19.5 * MM) ** 3) / 3
    assert said["magnetic_moment"]["value"][2] == pytest.approx(
        0.06 * volume / (4e-7 * np.pi), rel=1e-8
    )


@pytest.mark.parametrize(
    ("sensors", "magnetic", "said"),
    [
        (
            {"hall": {"position": [0, 0, 20 * MM]}},
            FIELD,
            "sensors.hall.position: .* is in the shell",
        ),
        (
            {"hall": {"position": [0, 0, 1], "field": "total"}},
            {"lambda_m": 1e-3},
            "sensors.hall.field: total",
        ),
        ({"hall": {"position": [0, 0]}}, FIELD, "sensors.hall.position"),
        ({"2nd": {"position": [0, 0, 1]}}, FIELD, "sensors: 2nd: a name is made of"),
        ({"hall": {"position": [0, 0, 1]}}, None, "sensors: need magnetic"),
        ({}, {"remanent": {"flux_density": "1 T"}}, "give lambda_m, or"),
    ],
)
def test_what_is_refused(
    sensors: dict[str, Any], magnetic: dict[str, Any] | None, said: str
) -> None:
    case = {
        "shell": {**CAP, "poisson_ratio": 0.3},
        "boundary": {"rim": "clamped"},
        "sensors": sensors,
    }
    case |= {"magnetic": magnetic} if magnetic else {}
    with pytest.raises((ValueError, CaseError), match=said):
        Case.model_validate({**case, "loading": {"kind": "pressure"}}).problem()


def test_a_sensor_that_the_shell_reaches() -> None:
    """Where the shell has moved over it there is no reading."""
    here = made(CAP, {"remanent": {"flux_density": "60 mT"}},
                {"hall": {"position": [0, 0, 19 * MM]}}, symmetry="none",
                mesh={"degree": 2, "size": 0.3})  # fmt: skip
    r0 = here.model.r0.x.array.reshape(-1, 3)
    moved = np.zeros_like(r0)
    for down, there in ((0.3, True), (1.0, False)):
        moved[:, 2] = -down / 20
        assert (
            np.isfinite(here.observe(State(moved.ravel(), here.unloaded().mu))["hall_Bz"]) == there
        )


def test_rubber_that_swells_is_refused() -> None:
    shell = {**CAP, "law": "neo-hookean", "poisson_ratio": 0.5}
    with pytest.raises(
        ValueError, match=r"sensors: needs the area as drawn; leave out natural\.stretch"
    ):
        made(shell, FIELD, {"hall": {"position": [0, 0, 30 * MM]}}, natural={"stretch": 1.1})


def test_units_of_sensors_and_what_they_are_called() -> None:
    """Without units `field: total` is no length, and a sensor may have the name of a key."""
    case: dict[str, Any] = {
        "shell": {
            "geometry": "strip",
            "radius_to_thickness": 200,
            "width": 0.1,
            "poisson_ratio": 0,
        },
        "boundary": {"root": "clamped"},
        "magnetic": {"susceptibility": 2, "lambda_m": 1e-3},
        "sensors": {"at": {"position": [0, 0, 1], "field": "total"}},
        "loading": {"kind": "field"},
    }
    Case.model_validate(case).problem()
    case["sensors"]["at"]["position"][1] = "1 mm"
    with pytest.raises(
        ValueError, match=r"sensors\.at\.position\.1: has a unit, but the shell's lengths have none"
    ):
        Case.model_validate(case)
    case["sensors"] = {}
    case["points"] = {"edge": [0.5, 0, "1 mm"]}
    with pytest.raises(ValueError, match=r"points\.edge\.2: has a unit"):
        Case.model_validate(case)


def moment_and_tip(case: Case) -> tuple[np.ndarray, dict[str, float]]:
    """A m² at the end of the path, and its row."""
    scene = Scene(case.problem())
    *_, last = follow(scene)
    found = moment_in_summary(scene.view, last.point.state)
    assert found["magnetic_moment"]["unit"] == "A m²"
    return np.array(found["magnetic_moment"]["value"]), scene.observe(last.point.state)


@pytest.mark.parametrize(
    "sections", [{"symmetry": "none"}, {"symmetry": "half"}, {"model": "solid"}]
)
def test_moment_of_a_bent_strip(sections: dict[str, Any]) -> None:
    """Of a remanence along the strip it is Br b h/mu0 times the way from root to tip, as F Br is Br
    times r,1.
    """
    shell = {**STRIP, "thickness": "1.5 mm", "poisson_ratio": 0.0}
    magnetic = {
        "remanent": {"polar": 90, "flux_density": "60 mT"},
        "applied": {"polar": 0, "flux_density": "200 mT"},
    }
    case = {
        "shell": shell,
        "boundary": {"root": "clamped"},
        "magnetic": magnetic,
        "loading": {"kind": "field"},
    }
    m, row = moment_and_tip(
        Case.model_validate(case | sections | {"points": {"tip": ["30 mm", 0, 0]}})
    )
    way = np.array([30 * MM + row["tip_ux"], 0.0, row["tip_uz"]])
    assert way[2] > 5 * MM
    expected = 0.06 * 9 * MM * 1.5 * MM / (4e-7 * np.pi) * way
    np.testing.assert_allclose(
        m, expected, atol=2e-6 * expected[2]
    )  # the tip is one point of its edge


@pytest.mark.parametrize(
    "sections", [{}, {"symmetry": "half"}, pytest.param({"model": "solid"}, marks=pytest.mark.slow)]
)
def test_moment_of_what_is_induced(sections: dict[str, Any]) -> None:
    """In a weak field, of a soft disc, chi/(1 + chi) B V/mu0, whether meridian, solid or half."""
    shell = {
        "geometry": "disc",
        "radius": "20 mm",
        "thickness": "1 mm",
        "youngs_modulus": "1 GPa",
        "poisson_ratio": 0.3,
    }
    magnetic = {"susceptibility": 2, "applied": {"polar": 0, "flux_density": "1 mT"}}
    case = {
        "shell": shell,
        "boundary": {"rim": "clamped"},
        "magnetic": magnetic,
        "loading": {"kind": "field"},
    }
    m, row = moment_and_tip(Case.model_validate(case | sections))
    volume = np.pi * 400 * MM**2 * 1 * MM
    np.testing.assert_allclose(
        m, [0, 0, 1e-3 * 2 / 3 * volume / (4e-7 * np.pi)], rtol=1e-4, atol=1e-9 * m[2]
    )
    assert m[2] == pytest.approx(row["induced_z"] * volume / (4e-7 * np.pi), rel=1e-4)


@pytest.mark.parametrize(
    ("magnetic", "sections", "there"),
    [
        ({"lambda_m": 0.0}, {}, False),
        ({"lambda_m": 0}, {"sensors": {"hall": {"position": [0, 0, 2]}}}, True),
        ({"lambda_m": 1e-3}, {}, True),
        ({"remanent": {"flux_density": "60 mT"}, "applied": {"flux_density": "0 T"}}, {}, True),
        ({"susceptibility": 2, "lambda_m": 0}, {}, False),
        (None, {}, False),
    ],
)
def test_what_has_a_moment(
    magnetic: dict[str, Any] | None, sections: dict[str, Any], there: bool
) -> None:
    """With lambda_m: 0 a case says that nothing is magnetised, unless it asks for the field."""
    sized = {"radius_to_thickness": 20}
    if magnetic and "lambda_m" not in magnetic:
        sized = {"radius": "20 mm", "thickness": "1 mm", "youngs_modulus": "1 MPa"}
    case = {
        "shell": {"geometry": "hemisphere", "poisson_ratio": 0.3, **sized},
        "boundary": {"equator": "clamped"},
    }
    case |= {"loading": {"kind": "pressure"}, **sections} | (
        {"magnetic": magnetic} if magnetic else {}
    )
    scene = Scene(Case.model_validate(case).problem())
    said = moment_in_summary(scene.view, scene.unloaded())
    assert bool(said) == there
