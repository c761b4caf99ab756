"""The lowest modes of shells: published plate frequencies, known folds and waves, the files of a
report.
"""

import csv
from collections import Counter
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
from command import magshell, started
from conftest import CASES
from numpy.typing import NDArray

from magshell_fenicsx import Case, Record, Scene
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.output.fields.gathering import gatherer
from magshell_fenicsx.output.fields.mode_fields import mode_surface, wave_number
from magshell_fenicsx.output.fields.ring import WaveCount, waves_around
from magshell_fenicsx.output.fields.surface import Surface
from magshell_fenicsx.public import run
from magshell_fenicsx.runs.modes import _waves_message
from magshell_fenicsx.shells.modes import ShellModes
from magshell_fenicsx.simulate.follow import follow

# Clamped circular plate, k R of the modes with n nodal diameters: A. W. Leissa, Vibration of
# Plates, NASA SP-160 (1969), table 2.1, square roots of 10.2158, 21.26, 34.88, 39.771, 51.04.
LEISSA = {0: 3.1962, 1: 4.6109, 2: 5.906, 3: 7.144}
SECOND_WITHOUT_DIAMETER = 6.3064


def plate(symmetry: str) -> Scene:
    return Scene(Case.load(CASES / "clamped_plate.yaml", [f"symmetry={symmetry}"]))


def wave_numbers(scene: Scene, count: int) -> list[tuple[str, float]]:
    """Label and k R = (lambda/D)^(1/4) of the lowest modes of the unloaded plate, thin enough for
    Kirchhoff's.
    """
    D = scene.problem.material.bending_stiffness
    modes = ShellModes(scene.model).lowest(scene.unloaded(), count)
    return [(mode.label, (mode.eigenvalue / D) ** 0.25) for mode in modes]


def test_clamped_plate_by_the_meridian() -> None:
    found = wave_numbers(plate("axisymmetric"), 2)[:5]
    assert [label for label, _ in found] == ["", "m = 1", "m = 2", "", "m = 3"]
    expected = [LEISSA[0], LEISSA[1], LEISSA[2], SECOND_WITHOUT_DIAMETER, LEISSA[3]]
    assert [k for _, k in found] == pytest.approx(expected, rel=2e-4)


def test_clamped_plate_by_half_and_whole() -> None:
    """A half sees one of each pair and calls the other antisymmetric; the whole sees both."""
    pairs = [LEISSA[0], *2 * [LEISSA[1]], *2 * [LEISSA[2]], SECOND_WITHOUT_DIAMETER]
    half, whole = wave_numbers(plate("half"), 4), wave_numbers(plate("none"), 6)
    assert [k for _, k in whole] == pytest.approx(pairs, rel=2e-4)
    assert [k for _, k in half[:6]] == pytest.approx(pairs, rel=2e-4)
    assert Counter(label for label, _ in half[:6]) == {"": 4, "antisymmetric": 2}


def band_of_triangles(rows: int, around: int, *, closed: bool = True) -> NDArray[np.int64]:
    """The triangles between rows of nodes; of rows that are closed the last nodes are beside the
    first."""
    row, node = (
        x.ravel()
        for x in np.meshgrid(np.arange(rows - 1), np.arange(around - (not closed)), indexing="ij")
    )
    beside = (node + 1) % around
    a, b, c, d = (
        row * around + node,
        row * around + beside,
        (row + 1) * around + node,
        (row + 1) * around + beside,
    )
    return np.concatenate([np.column_stack([a, b, c]), np.column_stack([b, d, c])])


def drawn_mode(
    r0: NDArray[np.float64], w: NDArray[np.float64], cells: NDArray[np.int64]
) -> Surface:
    return Surface(r0, 0 * r0, r0, cells, {"mode_w": w})


def test_a_dent_between_small_elements_has_no_waves() -> None:
    """Points of a ring count by their distance: most of them are in a dent, which a wave of few
    crests fits there."""
    theta = np.concatenate(
        [np.linspace(-0.5, 0.5, 400), np.linspace(0.5, 2 * np.pi - 0.5, 40)[1:-1]]
    )
    rim = np.column_stack([np.cos(theta), np.sin(theta), 1e-3 * np.sin(theta)])  # it is not even
    r0 = np.concatenate([rim, rim + np.array([0.0, 0.0, 1.0])])
    cells = band_of_triangles(2, len(theta))
    for w, waves in ((np.exp(-((theta / 0.5) ** 2)), None), (np.cos(3 * theta), 3)):
        assert wave_number(drawn_mode(r0, np.concatenate([w, 0 * w]), cells)) == waves


@cache
def past_the_fold() -> tuple[Scene, dict[str, Record]]:
    """cases/dimple_buckling.yaml: a point before its fold, the fold, and one past it."""
    loading = "loading={kind: pressure, control: arc, until: points, points: 7}"
    scene = Scene(Case.load(CASES / "dimple_buckling.yaml", [loading]))
    records = [record for record in follow(scene) if not record.mode]
    (fold,) = [i for i, record in enumerate(records) if record.label == "fold"]
    return scene, {"before": records[fold - 1], "fold": records[fold], "past": records[-1]}


def test_lowest_stiffness_changes_sign_at_the_fold() -> None:
    """k_d = 0.3262 of the independent axisymmetric solver; as many negative eigenvalues as negative
    pivots.
    """
    scene, records = past_the_fold()
    shell = ShellModes(scene.model)
    lowest = {}
    for name, record in records.items():
        own = [mode.eigenvalue for mode in shell.lowest(record.point.state, 2) if not mode.label]
        lowest[name] = own[0]
        if name != "fold":
            assert sum(value < 0 for value in own) == record.point.negative_pivots
    assert records["fold"].point.state.mu["pressure"] == pytest.approx(0.326233289, rel=2e-3)
    assert lowest["before"] > 1e-3
    assert abs(lowest["fold"]) < 1e-4
    assert lowest["past"] < -1e-3


@pytest.mark.slow
def test_half_shell_and_meridian_agree_at_the_fold() -> None:
    """Two discretisations: a half's antisymmetric modes are the meridian's waves."""
    half = Scene(
        Case.load(CASES / "dimple_buckling.yaml", ["symmetry=half", "mesh.refinement=0.4"])
    )
    *_, at_fold = (record for record in follow(half) if record.label == "fold" and not record.mode)
    scene, records = past_the_fold()
    lowest = {}
    for symmetry, of, record in (("auto", scene, records["fold"]), ("half", half, at_fold)):
        modes = ShellModes(of.model).lowest(record.point.state, 4)
        lowest[symmetry] = [mode.eigenvalue for mode in modes if mode.label]
    assert lowest["half"][:4] == pytest.approx(lowest["auto"][:4], rel=5e-3)


@pytest.mark.slow
def test_waves_of_the_perfect_hemisphere() -> None:
    """14 waves at p/p_c = 0.84111 (test_waves.py) have no stiffness; every other mode has some.

    At the axisymmetric limit the unstable modes are those that the waves' inertia counts.
    """
    data = {
        "shell": {"geometry": "hemisphere", "radius_to_thickness": 90, "poisson_ratio": 0.5},
        "boundary": {"equator": "clamped"},
        "loading": {"kind": "pressure"},
    }
    scene = Scene(Case.from_source(Source("sphere", data)))
    located = [record for record in follow(scene) if record.label in ("fold", "bifurcation")]
    found = {record.mode: record for record in reversed(located)}  # the first of each
    limit, first = found[""], found["m = 14"]
    shell = ShellModes(scene.model)
    modes = shell.lowest(first.point.state, 1)
    assert modes[0].label == "m = 14"
    assert abs(modes[0].eigenvalue) < 1e-6
    null, mode = (
        surface_of(scene, first.point.state.u, "m = 14", vector).fields["mode"]
        for vector in (shell.null_vector(first.point.state, "m = 14"), modes[0].vector)
    )
    assert null == pytest.approx(mode, abs=1e-4)
    assert modes[1].eigenvalue > 1e-4
    unstable = Counter(
        mode.label
        for mode in shell.lowest(limit.point.state, 1)
        if mode.eigenvalue < 0 and mode.label
    )
    assert unstable == {
        f"m = {m}": n for m, n in scene.model.waves.unstable(limit.point.state).items()
    }
    assert len(unstable) > 3


@pytest.mark.slow
def test_short_waves_on_a_sphere_under_pressure() -> None:
    """lambda = 1 - (p/p_c)^2 over E h/R^2: D q^4 - p R q^2/2 + E h/R^2 at its lowest (van der Neut,
    Koiter).

    The tangential part adds mass of order h/R. Below it lies one axisymmetric mode that is no short
    wave, whose stiffness the pressure hardly changes.
    """
    data = {
        "shell": {"geometry": "hemisphere", "radius_to_thickness": 1000, "poisson_ratio": 0.3},
        "boundary": {"equator": "clamped"},
        "loading": {
            "kind": "pressure",
            "control": "load",
            "until": "target",
            "pressure": 0.6,
            "points": 1,
        },
    }
    scene = Scene(Case.from_source(Source("sphere", data)))
    *_, last = [record for record in follow(scene) if not record.mode]
    own = [
        mode.eigenvalue
        for mode in ShellModes(scene.model).lowest(last.point.state, 2)
        if not mode.label
    ]
    assert own[1] == pytest.approx(1 - 0.6**2, rel=3e-3)


def surface_of(scene: Scene, u: np.ndarray, label: str, vector: np.ndarray) -> Any:
    return mode_surface(scene.model, gatherer(scene.model, scene.comm), u, label, vector)


def test_translation_as_a_wave() -> None:
    """U = 1, V = -1, W = 0 with m = 1 is e1 everywhere, the axis included; the sign of a mode is
    free.
    """
    scene = plate("axisymmetric")
    coefficients = np.tile([0.0, -1.0, 0.0], scene.model.waves.V.dofmap.index_map.size_global)
    surface = surface_of(scene, scene.model.zero(), "m = 1", coefficients)
    assert np.abs(np.abs(surface.fields["mode"]) - [1.0, 0.0, 0.0]).max() < 1e-12
    assert np.ptp(surface.fields["mode"][:, 0]) < 1e-12


@pytest.mark.parametrize("symmetry", ["axisymmetric", "half"])
def test_shapes_have_their_nodal_diameters(symmetry: str) -> None:
    """Every mode of the plate has the waves around it that Leissa's table gives its frequency; odd
    ones are sines.
    """
    scene = plate(symmetry)
    D = scene.problem.material.bending_stiffness
    modes = {
        k: mode
        for mode in ShellModes(scene.model).lowest(scene.unloaded(), 4)
        if (k := (mode.eigenvalue / D) ** 0.25) < 7
    }
    assert len(modes) == {"axisymmetric": 4, "half": 6}[symmetry]
    for kR, mode in modes.items():
        surface = surface_of(scene, scene.model.zero(), mode.label, mode.vector)
        x, y = surface.r0[:, :2].T
        theta = np.arctan2(y, x)
        of_angle = np.sin if mode.label == "antisymmetric" else np.cos
        fits = [
            abs(surface.fields["mode_w"] @ (of_angle(m * theta) * np.hypot(x, y) ** 2))
            for m in range(7)
        ]
        waves = (
            0
            if abs(kR - SECOND_WITHOUT_DIAMETER) < 0.01
            else min(LEISSA, key=lambda m: abs(LEISSA[m] - kR))
        )
        assert int(np.argmax(fits)) == waves
        assert np.linalg.norm(surface.fields["mode"], axis=1).max() == pytest.approx(1.0)


def test_antisymmetric_mode_is_odd() -> None:
    """The mirror image of (v1, v2, v3) at (x, -y) is (-v1, v2, -v3); that of a symmetric mode (v1,
    -v2, v3).
    """
    scene = plate("half")
    modes = ShellModes(scene.model).lowest(scene.unloaded(), 1)
    assert {mode.label for mode in modes} == {"", "antisymmetric"}
    for mode in modes:
        surface = surface_of(scene, scene.model.zero(), mode.label, mode.vector)
        here, there = np.split(surface.fields["mode"], 2)
        sign = -1.0 if mode.label else 1.0
        assert there == pytest.approx(sign * here * [1.0, -1.0, 1.0], abs=1e-12)
        assert np.split(surface.r0, 2)[1] == pytest.approx(
            np.split(surface.r0, 2)[0] * [1.0, -1.0, 1.0], abs=1e-12
        )


def test_null_vector_is_the_mode_without_stiffness() -> None:
    scene, records = past_the_fold()
    state, shell = records["fold"].point.state, ShellModes(scene.model)
    null = surface_of(scene, state.u, "", shell.null_vector(state, ""))
    lowest = next(mode for mode in shell.lowest(state, 1) if not mode.label)
    mode = surface_of(scene, state.u, "", lowest.vector)
    assert np.abs(null.fields["mode"] - mode.fields["mode"]).max() < 1e-4
    deepest = int(np.argmax(np.abs(null.fields["mode_w"])))
    assert null.fields["mode_w"][deepest] > 0.9  # inward
    assert null.r0[deepest][2] > 0.95  # within the dimple


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "stability.csv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


COARSE = [
    "--set=mesh.degree=3",
    "--set=mesh.refinement=0.3",
    "--set=loading.depth=2",
    "--set=loading.points=1",
]


@pytest.mark.slow
@pytest.mark.parametrize("symmetry", ["axisymmetric", "half"])
def test_same_modes_on_one_rank_and_two(tmp_path: Path, symmetry: str) -> None:
    """The same table on one rank and on two, with pictures on the meridian."""
    tables = []
    for ranks in (1, 2):
        out = tmp_path / str(ranks)
        settings = [*COARSE, f"--set=symmetry={symmetry}", "--set=stability.modes=3"]
        drawn = symmetry == "axisymmetric"
        words = [
            "run",
            CASES / "pole_indentation.yaml",
            *settings,
            *(["--no-pictures"][drawn:]),
            "--out",
            out,
        ]
        done = started(*words, ranks=ranks) if ranks > 1 else magshell(*words)
        assert done.returncode == 0, done.stderr
        tables.append(table(out))
        assert len(list((out / "fields").glob("mode_*.vtu"))) == 3
        assert bool(list(out.glob("modes_*.png"))) == drawn
    eigenvalues = [[float(row["eigenvalue"]) for row in rows] for rows in tables]
    assert len(eigenvalues[0]) >= 3
    for other in eigenvalues[1:]:
        assert other == pytest.approx(eigenvalues[0], rel=1e-8, abs=1e-9)


@pytest.mark.slow
def test_files_at_instabilities(tmp_path: Path) -> None:
    found = run(
        Case.load(CASES / "dimple_buckling.yaml", ["stability={modes: 2, at: instabilities}"]),
        tmp_path,
    )
    number = len(found.rows) - 1
    fields = sorted(file.name for file in (tmp_path / "fields").glob("mode_*"))
    assert fields == [f"mode_{number:04d}_{name}.vtu" for name in ("1", "2_m1", "fold")]
    assert (tmp_path / f"modes_{number:04d}.png").exists()
    assert (tmp_path / "instabilities.png").exists()
    first, second = table(tmp_path)[:2]
    assert (first["mode"], second["mode"]) == ("", "m = 1")
    grid = pyvista.read(tmp_path / "fields" / fields[1])
    assert np.linalg.norm(grid.point_data["mode"], axis=1).max() == pytest.approx(1.0)
    assert "u_over_h" in grid.point_data


def test_nothing_is_compiled_without_the_section(tmp_path: Path) -> None:
    found = run(
        Case.load(CASES / "pole_indentation.yaml", ["loading.depth=1", "loading.points=1"]),
        tmp_path,
    )
    assert not [name for name in found.scene.model.kernels.names if "mass" in name]
    assert not list(tmp_path.glob("**/mode*"))
    assert not (tmp_path / "stability.csv").exists()


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("stability.modes=0", "stability.modes: 0: must be greater than or equal to 1"),
        ("stability.at=fold", "stability.at: 'fold': must be 'end' or 'instabilities'"),
        ("stability.count=3", "stability.count: unknown key; allowed here: at, modes"),
    ],
)
def test_mistakes_in_the_section(setting: str, message: str) -> None:
    with pytest.raises(CaseError) as error:
        Case.load(CASES / "dimple_buckling.yaml", [setting])
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("m", "turn", "counted"),
    [(0, 2, None), (1, 2, None), (5, 2, 5), (28, 2, 28), (5, 1, None), (5, 1.6, None)],
)
def test_waves_around_the_axis_are_counted(m: int, turn: float, counted: int | None) -> None:
    """Not on a part of a shell that does not go around it."""
    around, down = np.linspace(0, turn * np.pi, 400, endpoint=False), np.linspace(1, 1.5, 30)
    theta, phi = (x.ravel() for x in np.meshgrid(around, down))
    n0 = np.column_stack([np.sin(phi) * np.cos(theta), np.sin(phi) * np.sin(theta), np.cos(phi)])
    w = np.cos(m * (theta - 0.3)) * np.exp(-50 * (phi - 1.3) ** 2)
    cells = band_of_triangles(30, 400, closed=turn == 2)
    assert wave_number(drawn_mode(n0, w, cells)) == counted


def test_a_fold_of_waves_is_a_perturbed_bifurcation() -> None:
    """The run says so: the mesh of a half has no bifurcation where the perfect shell has one."""
    waves = WaveCount(2, 9)
    assert _waves_message(7, waves, "bifurcation").endswith("point 7 has 2 waves around e3")
    assert "2 waves around e3: most often a bifurcation" in _waves_message(7, waves, "fold")


@pytest.mark.parametrize("staggered", [0.0, 1 / 3, 0.5])
@pytest.mark.parametrize(("m", "resolved"), [(2, True), (3, True), (5, True), (8, False)])
def test_waves_are_counted_whatever_nodes_lie_on_rings(
    m: int, staggered: float, resolved: bool
) -> None:
    """cos(m theta) at 21 nodes around, on rows so near that one ring has three: there 63 - m and 42
    + m fit as well.

    Where rows are staggered, a row's nodes are between those of the next. Eight waves have less
    than three nodes each.
    """
    node, row = (x.ravel() for x in np.meshgrid(np.arange(21), np.arange(41)))
    theta, z = 2 * np.pi * (node + staggered * row) / 21, 0.015 * row
    r0 = np.column_stack([np.cos(theta), np.sin(theta), z])
    w = np.cos(m * theta - 4 * z) * np.exp(-50 * (z - 0.3) ** 2)
    waves = waves_around(drawn_mode(r0, w, band_of_triangles(41, 21)))
    assert waves is not None
    assert waves.resolved == resolved
    if resolved:
        assert waves.number == m


def test_waves_are_counted_on_an_irregular_mesh() -> None:
    """cos(3 theta) at nodes of which no two have one height, the largest of all 0.07 R from the
    next."""
    chance = np.random.default_rng(0)
    node, row = (x.ravel() for x in np.meshgrid(np.arange(24), np.arange(9)))
    theta = 2 * np.pi * (node + row / 2 + 0.3 * chance.uniform(-0.5, 0.5, len(node))) / 24
    z = 0.25 * (row + 0.3 * chance.uniform(-0.5, 0.5, len(node)))
    r0 = np.column_stack([np.cos(theta), np.sin(theta), z])
    w = np.cos(3 * theta - z) * np.sin(np.pi * z / 2)
    assert wave_number(drawn_mode(r0, w, band_of_triangles(9, 24))) == 3
