"""Sources as fields: values of magpylib, derivatives of a dipole, fields on grids against those
built in.
"""

import re
import sys
from pathlib import Path
from typing import Any

import magpylib
import numpy as np
import pytest
import pyvista
from command import magshell
from conftest import CASES
from scipy.spatial.transform import Rotation

from magshell_fenicsx import Case, CaseError, Scene
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.expressions import FormulasInSpace, formula_with_derivatives
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.parts.magnetism.applied import crossed_place
from magshell_fenicsx.parts.magnetism.sources.field import in_space, placed_sources
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Stopped

STRIP: dict[str, Any] = {
    "shell": {
        "geometry": "strip",
        "radius": "30 mm",
        "width": 0.2,
        "thickness": "1 mm",
        "youngs_modulus": "1 MPa",
    }
    | {"poisson_ratio": 0.0},
    "boundary": {"root": "clamped"},
    "points": {"tip": ["30 mm", 0, 0]},
    "mesh": {"degree": 2, "refinement": 0.5},
}
L, PLACE, TURN = 30e-3, [0.05, 0.01, -0.04], Rotation.from_euler("ZYZ", [40, 70, 25], degrees=True)
OWN = {"position": PLACE, "axis": {"azimuth": 40, "polar": 70}, "spin": 25}
J, SIDE = [0.5, -0.3, 1.0], {"position": PLACE, "orientation": TURN}
POLARIZATION = {"polarization": [f"{x} T" for x in J]}
KINDS = {
    "cylinder": ({"diameter": "20 mm", "height": "10 mm", **POLARIZATION},
                 magpylib.magnet.Cylinder(dimension=(20e-3, 10e-3), polarization=J, **SIDE)),
    "cuboid": ({"dimension": ["20 mm", "5 mm", "10 mm"], **POLARIZATION},
               magpylib.magnet.Cuboid(dimension=(20e-3, 5e-3, 10e-3), polarization=J, **SIDE)),
    "sphere": ({"diameter": "20 mm", **POLARIZATION},
               magpylib.magnet.Sphere(diameter=20e-3, polarization=J, **SIDE)),
    "ring": ({"diameter": "20 mm", "inner_diameter": "8 mm", "height": "10 mm", **POLARIZATION},
             magpylib.magnet.CylinderSegment(dimension=(4e-3, 10e-3, 10e-3, 0, 360), polarization=J,
                                             **SIDE)),
    "coil": ({"diameter": "20 mm", "current": "5 A", "turns": 100},
             magpylib.current.Circle(diameter=20e-3, current=500, **SIDE)),
    "wire": ({"vertices": [[0, 0, 0], [0.02, 0, 0], [0.02, 0.03, 0.01], [0, 0, 0]],
              "current": "5 A"},
             magpylib.current.Polyline(
                 current=5, vertices=[[0, 0, 0], [0.02, 0, 0], [0.02, 0.03, 0.01], [0, 0, 0]],
                 **SIDE)),
}  # fmt: skip
RANDOM = np.random.default_rng(5).uniform([0, -0.2, -0.3], [1.0, 0.2, 0.5], (40, 3))  # over R


def case(sources: list[dict[str, Any]], folder: Path | None = None, **sections: Any) -> Case:
    magnetic = {"remanent": {"polar": 90, "flux_density": "50 mT"}, "applied": {"sources": sources}}
    data = {**STRIP, "magnetic": magnetic, **sections}
    return Case.from_source(Source("test", data, folder=folder or Path()))


@pytest.mark.parametrize("kind", KINDS)
def test_values_and_derivatives(kind: str) -> None:
    """Values are magpylib's at the place and angle; derivatives those of central differences of it,
    to 1e-7.
    """
    keys, own = KINDS[kind]
    still, _ = in_space(case([{"kind": "coil" if kind == "wire" else kind, **OWN, **keys}]).context)
    assert still
    B, G, H = still(RANDOM)
    np.testing.assert_allclose(B, own.getB(L * RANDOM), rtol=1e-9, atol=1e-12 * np.abs(B).max())
    step, near = 0.02, np.array([-3, -2, -1, 1, 2, 3])
    weights = np.array([-1, 9, -45, 45, -9, 1]) / (60 * step)

    def difference(of: Any) -> np.ndarray:
        shifted = [
            [weight * of(RANDOM + s * step * e) for s, weight in zip(near, weights, strict=True)]
            for e in np.eye(3)
        ]
        return np.moveaxis(np.sum(shifted, axis=1), 0, -1)

    np.testing.assert_allclose(G, difference(lambda x: still(x)[0]), atol=1e-6 * np.abs(G).max())
    np.testing.assert_allclose(H, difference(lambda x: still(x)[1]), atol=1e-6 * np.abs(H).max())


def test_sphere_is_a_dipole() -> None:
    """All derivatives to 1e-8 of those by formulas, which are exact: 3 (m.s) s/s^5 - m/s^3 times B0
    r^3/3.
    """
    r, z0 = 10e-3 / L, -0.9
    s = f"(x**2 + y**2 + (z - ({z0}))**2)"
    texts = [
        f"(z - ({z0}))*x/{s}**2.5",
        f"(z - ({z0}))*y/{s}**2.5",
        f"(z - ({z0}))**2/{s}**2.5 - {s}**-1.5/3",
    ]
    exact = FormulasInSpace([formula_with_derivatives(text) for text in texts], np.eye(3))
    magnet = {
        "kind": "sphere",
        "diameter": "20 mm",
        "polarization": "1.3 T",
        "position": [0, 0, z0 * L],
    }
    still, _ = in_space(case([magnet]).context)
    assert still
    for found, known in zip(still(RANDOM), exact(RANDOM), strict=True):
        np.testing.assert_allclose(
            found, 1.3 * r**3 * known, atol=1e-8 * np.abs(1.3 * r**3 * known).max()
        )


def written(folder: Path, form: str, b: np.ndarray, G: np.ndarray, top: float = 33.0) -> str:
    """A grid of b + G r/R in mT around the strip, in a file."""
    axes = [
        np.linspace(-12.0, 42.0, 5),
        np.linspace(-9.0, 9.0, 4),
        np.array([-33.0, -20, -1, 1, top]),
    ]  # mm
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    B = b + x / (1e3 * L) @ G.T
    file = folder / f"grid.{form}"
    if form == "csv":
        rows = np.hstack([x.reshape(-1, 3), B.reshape(-1, 3)])
        np.random.default_rng(1).shuffle(rows)
        np.savetxt(
            file,
            rows,
            "%.15g",
            ",",
            header="x [mm],y [mm],z [mm],Bx [mT],By [mT],Bz [mT]",
            comments="",
        )
    elif form == "npz":
        xyz = dict(zip("xyz", (1e-3 * axis for axis in axes), strict=True))
        np.savez(file, **xyz, **{f"B{k}": 1e-3 * B[..., i] for i, k in enumerate("xyz")})
    else:
        grid = pyvista.RectilinearGrid(*(1e-3 * axis for axis in axes))
        grid.point_data["B"] = 1e-3 * np.swapaxes(B, 0, 2).reshape(-1, 3)
        grid.save(file)
    return file.name


FIELD, SLOPE = np.array([3.0, 0.0, 4.0]), np.array([[6.0, 0, 2], [0, 1, 0], [2, 0, -7]])


@pytest.mark.telling
@pytest.mark.parametrize(("form", "slope"), [("csv", False), ("npz", True), ("vtr", True)])
def test_grid_of_a_built_in_field(form: str, slope: bool, tmp_path: Path) -> None:
    """A uniform field, and a constant gradient. The deflection is the built-in one's to 1e-6."""
    file = written(tmp_path, form, FIELD, slope * SLOPE)
    grid = case([{"kind": "grid", "file": file}], tmp_path, loading={"kind": "field", "points": 1})
    polar = float(np.degrees(np.arctan2(3, 4)))
    applied = {
        "flux_density": "5 mT",
        "polar": polar,
        **({"gradient": (SLOPE / 5).tolist()} if slope else {}),
    }
    magnetic = {"remanent": {"polar": 90, "flux_density": "50 mT"}, "applied": applied}
    built_in = Case.model_validate(
        {**STRIP, "magnetic": magnetic, "loading": {"kind": "field", "points": 1}}
    )
    tips = []
    for one in (grid, built_in):
        scene = Scene(one)
        *_, last = follow(scene)
        tips.append(scene.model.displacement(last.point.state.u, "tip"))
    assert np.abs(tips[1]).max() > 0.05
    np.testing.assert_allclose(tips[0], tips[1], rtol=1e-6, atol=1e-9)


def test_sum(tmp_path: Path) -> None:
    """Uniform field, gradient, formula, grid and magnet add up; a source by formula has its own
    axes.
    """
    file = written(tmp_path, "npz", FIELD, SLOPE)
    magnet = {"kind": "cylinder", **OWN, **KINDS["cylinder"][0]}
    formula = {
        "kind": "formula",
        "components": ["x*z", "0", "x**2 - z**2"],
        "flux_density": "7 mT",
        **OWN,
    }
    given = case([magnet, {"kind": "grid", "file": file, "strength": -2.0}, formula], tmp_path)
    data = given.model_dump(exclude_unset=True)
    data["magnetic"]["applied"] |= {
        "flux_density": "20 mT",
        "polar": 90.0,
        "gradient": np.eye(3).tolist(),
    }
    for section in (data["magnetic"]["remanent"], *data["magnetic"]["applied"]["sources"]):
        for key in ("flux_density", "polarization"):
            if key in section:
                value = section[key]
                section[key] = (
                    [f"{x} T" for x in value] if isinstance(value, list) else f"{value} T"
                )
    for key in ("radius", "thickness"):
        data["shell"][key] = f"{data['shell'][key]} m"
    data["shell"]["youngs_modulus"] = "1 MPa"
    still, driven = in_space(Case.from_source(Source("test", data, folder=tmp_path)).context)
    assert still
    assert not driven
    x = RANDOM * [0.9, 0.8, 0.9]
    own = TURN.inv().apply(x - np.array(PLACE) / L)
    by_formula = 7e-3 * np.column_stack(
        [own[:, 0] * own[:, 2], 0 * own[:, 0], own[:, 0] ** 2 - own[:, 2] ** 2]
    )
    expected = (
        KINDS["cylinder"][1].getB(L * x) + TURN.apply(by_formula) - 2e-3 * (FIELD + x @ SLOPE.T)
    )
    expected = expected / 20e-3 + np.array([1.0, 0, 0]) + x
    np.testing.assert_allclose(still(x)[0], expected, rtol=1e-9, atol=1e-9)


ALONG = {"diameter": "20 mm", "height": "10 mm", "polarization": "1 T"}


@pytest.mark.parametrize(
    ("position", "axis", "model"),
    [
        ([0, 0, -0.04], {}, "meridian"),
        ([0.03, 0.03, -0.04], {}, "half"),
        ([0, 0, -0.04], {"polar": 30, "azimuth": 20}, "half"),
        ([0.03, 0.0, -0.04], {"polar": 30, "azimuth": 20}, "full"),
    ],
)
def test_symmetry_of_a_magnet(position: list[float], axis: dict[str, float], model: str) -> None:
    """On the axis it leaves the meridian; beside it the plane through it, and none if it is tilted
    out of that.
    """
    shell = {"geometry": "disc", "radius": "30 mm", "thickness": "1 mm", "youngs_modulus": "1 MPa"}
    magnetic = {
        "remanent": {"flux_density": "50 mT"},
        "applied": {"sources": [{"kind": "cylinder", **ALONG, "position": position, "axis": axis}]},
    }
    found = make_problem(
        Case.model_validate(
            {
                "shell": {**shell, "poisson_ratio": 0.3},
                "boundary": {"rim": "clamped"},
                "magnetic": magnetic,
            }
        )
    )
    assert found.included[0].startswith(model)


BAD = [
    (
        "0.position=[20 mm, 0, 2 mm]",
        r"sources.0: the shell's point .* is inside magnetic.applied.sources.0",
    ),
    ("0.kind=cone", "cylinder, cuboid, sphere, ring, coil, grid, formula"),
    ("0.polarization=1.3", 'needs a unit, for example "60 mT"'),
    ("0={kind: grid, file: none.csv}", "none.csv: cannot be read"),
    (
        "0={kind: coil, diameter: 1 mm, vertices: [[0, 0, 0], [1, 0, 0]], current: 1 A}",
        "give diameter or vertices",
    ),
]


@pytest.mark.parametrize(("setting", "said"), BAD)
def test_what_is_refused(setting: str, said: str) -> None:
    """One clear message with the key."""
    done = magshell(
        "check", CASES / "magnet_strip.yaml", "--set", f"magnetic.applied.sources.{setting}"
    )
    assert done.returncode == 2
    assert re.search(said, done.stderr), done.stderr


def test_grids_that_are_none(tmp_path: Path) -> None:
    """Too few places, a hole, a shell beyond it."""
    wrong = {
        "x,y,z,Bx,By,Bz\n"
        + "\n".join(f"{i},0,0,1,1,1" for i in range(9)): "needs four along each axis",
        "x,y,z,Bx,By\n0,0,0,0,0\n": "has no column Bz",
    }
    for text, said in wrong.items():
        (tmp_path / "grid.csv").write_text(text)
        with pytest.raises(CaseError, match=said):
            make_problem(case([{"kind": "grid", "file": "grid.csv"}], tmp_path))
    file = written(tmp_path, "csv", FIELD, SLOPE)
    lines = (tmp_path / file).read_text().splitlines()
    (tmp_path / "hole.csv").write_text("\n".join(lines[:-1]))
    with pytest.raises(CaseError, match="is no rectilinear grid"):
        make_problem(case([{"kind": "grid", "file": "hole.csv"}], tmp_path))
    with pytest.raises(CaseError, match="is beyond the grid of magnetic"):
        make_problem(case([{"kind": "grid", "file": file, "position": [0.02, 0, 0]}], tmp_path))


def test_without_magpylib(monkeypatch: pytest.MonkeyPatch) -> None:
    """One message with the command; a grid or a formula does not need it."""
    monkeypatch.setitem(sys.modules, "magpylib", None)
    with pytest.raises(CaseError, match="pip install --no-deps magpylib"):
        make_problem(case([{"kind": "cylinder", **OWN, **KINDS["cylinder"][0]}]))
    make_problem(case([{"kind": "formula", "components": ["0", "0", "1"]}]))


def stopped(scene: Scene) -> tuple[list[dict[str, float]], str]:
    """The rows up to where a history stops, and why."""
    rows, records = [], follow(scene)
    try:
        for record in records:
            rows.append(scene.observe(record.point.state))
    except Stopped as e:
        return rows, str(e)
    raise AssertionError("it did not stop")


def test_shell_leaves_the_grid(tmp_path: Path) -> None:
    """The points up to there stay; the message says where it is."""
    file = written(tmp_path, "csv", FIELD, 0 * SLOPE, top=11.0)
    scene = Scene(
        case([{"kind": "grid", "file": file, "strength": 3.0}], tmp_path, loading={"kind": "field"})
    )
    rows, said = stopped(scene)
    assert re.search(
        r"on this way a step has found no field: the shell's point .* is beyond the grid of", said
    )
    assert 9e-3 < rows[-1]["tip_uz"] < 11.2e-3  # the outermost quadrature point is not the tip


def test_thin_magnet_in_the_way() -> None:
    """It is passed through in one step: the distance of the ends of a way says nothing about its
    middle.
    """
    (plate,) = placed_sources(
        case([{"kind": "cylinder", **ALONG, "height": "0.02 mm", "position": [0, 0, 0]}]).context
    )
    x = np.array([[0.01, 0.02, 0.3], [5.0, 0, 0.3]])
    found = crossed_place(plate.distance, x, x - [0, 0, 0.7])
    assert found is not None
    assert plate.distance(found[None])[0] < 0
    assert crossed_place(plate.distance, x, x - [0, 0, 0.29]) is None
    steps = [
        {"kind": "field", "points": 1},
        {"kind": "source", "move": [0, 0, "60 mm"], "points": 1},
    ]
    thin = {
        "kind": "cylinder",
        **ALONG,
        "height": "0.02 mm",
        "strength": 1e-9,
        "position": [0.02, 0, -0.03],
    }
    rows, said = stopped(Scene(case([thin], loading=steps)))
    assert "is inside magnetic.applied.sources.0 between two points" in said
    assert rows[-1]["source"] == 0


@pytest.mark.slow
def test_magnet_in_the_way() -> None:
    """It is driven into the strip."""
    steps = [
        {"kind": "field", "points": 1},
        {"kind": "source", "move": [0, 0, "30 mm"], "points": 2},
    ]
    low = {"kind": "cylinder", **ALONG, "strength": 1e-6, "position": [0.02, 0, -0.03]}
    scene = Scene(case([low], loading=steps))
    rows, said = stopped(scene)
    assert "is inside magnetic.applied.sources.0" in said
    assert 0.7 < rows[-1]["source"] < 25 / 30


def test_check_tells_how_strong_they_are() -> None:
    """A ball is a dipole, on its axis 2 J/3 (a/d)^3; numbers that were meant in mm are metres, and
    nothing is felt.
    """
    shell = {
        "geometry": "disc",
        "radius": "25 mm",
        "thickness": "1 mm",
        "youngs_modulus": "1 MPa",
        "poisson_ratio": 0.5,
    }
    ball = {
        "kind": "sphere",
        "diameter": "10 mm",
        "polarization": "1.2 T",
        "position": [0, 0, "-30 mm"],
    }

    def told(**changes: Any) -> float:
        magnetic = {"remanent": {"flux_density": "60 mT"}, "applied": {"sources": [ball | changes]}}
        data = {"shell": shell, "boundary": {"rim": "clamped"}, "magnetic": magnetic}
        found = re.search(
            r"field of the sources on the undeformed shell: .* to (.*) mT",
            describe(Case.model_validate(data)),
        )
        assert found
        return float(found[1])

    assert told() == pytest.approx(1e3 * 2 / 3 * 1.2 * (5 / 30) ** 3, rel=1e-3)
    assert told(position=[0, 0, -30]) < 1e-7
