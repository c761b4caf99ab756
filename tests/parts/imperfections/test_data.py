"""Measured imperfections: feet on every shape, what a file becomes, what is refused."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.parts.imperfections.data import _on_quadrics, feet
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionGeometry
from magshell_fenicsx.parts.shell_outline import outline, reference_shell_of
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
RNG = np.random.default_rng(16)
H = 0.02
CYLINDER = {"geometry": "cylinder", "radius": 1.0, "length": 1.5}
SHAPES: list[dict[str, Any]] = [
    CYLINDER,
    {"geometry": "torus", "radius": 1.0, "tube_radius": 0.3},
    {
        "geometry": "revolution",
        "profile": {"points": [[1.0, 0.0], [0.9, 0.5], [0.5, 0.9], [0.0, 1.0]]},
    },
    {"geometry": "plate", "length": 1.0, "width": 0.5},
    {"geometry": "cap", "radius": 1.0, "polar": 60.0},
]


def made(shell: dict[str, Any], folder: Path = Path(), **item: Any) -> Case:
    items = [{"kind": "data", "file": "scan.csv", **item}]
    content = {
        "shell": {"thickness": H, "poisson_ratio": 0.3, "imperfections": items, **shell},
        "boundary": {},
    }
    return Case.from_source(Source("case.yaml", content, folder=folder))


def read(case: Case) -> ImperfectionGeometry:
    return case.shell.imperfections[0].geometry(
        reference_shell_of(case.shell), "shell.imperfections.0"
    )


def places(drawn: Outline, count: int) -> tuple[Array, Array]:
    """Places of the surface and the normals there."""
    sample = drawn.sample()
    chart = np.array([drawn.inverse(x) for x in sample[RNG.permutation(len(sample))[:count]]])
    return drawn.perfect(chart), drawn.normal(chart)


def write(folder: Path, header: str, *columns: Array) -> None:
    np.savetxt(
        folder / "scan.csv", np.column_stack(columns), header=header, comments="", delimiter=","
    )


@pytest.mark.parametrize("shell", SHAPES, ids=lambda shell: shell["geometry"])
def test_feet(shell: dict[str, Any]) -> None:
    """Places beside a surface, at known heights along its normal."""
    drawn = outline(made(shell).shell)
    x, n = places(drawn, 60)
    w0 = 0.02 * RNG.standard_normal(60)
    found, heights = feet(drawn, x + w0[:, None] * n)
    assert heights == pytest.approx(w0, abs=1e-10)
    assert found == pytest.approx(x, abs=1e-9)


def test_feet_on_the_nodes_of_a_mesh_file() -> None:
    """A sphere by 4000 nodes: third order in their distance, 0.04."""
    z = np.linspace(-0.99, 0.99, 4000)
    theta = np.pi * (1 + 5**0.5) * np.arange(4000)
    nodes = np.column_stack(
        [np.sqrt(1 - z * z) * np.cos(theta), np.sqrt(1 - z * z) * np.sin(theta), z]
    )
    x = nodes[500:3500:50] + 0.01 * RNG.standard_normal((60, 3))
    found, heights = _on_quadrics(np.hstack([nodes, nodes]), x)
    assert heights == pytest.approx(np.linalg.norm(x, axis=1) - 1, abs=1e-5)
    assert found == pytest.approx(x / np.linalg.norm(x, axis=1)[:, None], abs=1e-4)


def wave(x: Array) -> Array:
    """w0/h"""
    return np.asarray(np.cos(3 * x[:, 2]) * np.sin(2 * np.arctan2(x[:, 1], x[:, 0])))


@pytest.mark.parametrize("way", ["w0", "lengths", "real surface", "angles"])
def test_one_map_in_four_files(tmp_path: Path, way: str) -> None:
    """Places and w0, the same with units, places of the real surface, azimuth and z."""
    lengths = (
        {"thickness": "0.5 mm", "radius": "25 mm", "length": "37.5 mm"} if way == "lengths" else {}
    )
    case = made({**CYLINDER, **lengths}, tmp_path)
    drawn = outline(case.shell)
    x, n = places(drawn, 600)
    w = wave(x)
    theta, z = np.degrees(np.arctan2(x[:, 1], x[:, 0])), x[:, 2]
    if way == "lengths":
        write(tmp_path, "x [mm],y [mm],z [mm],w0 [um]", 25 * x, 500 * w)
    elif way == "angles":
        write(tmp_path, "azimuth,z,w0", theta, z, w)
    else:
        write(
            tmp_path,
            *(("x,y,z", x + H * w[:, None] * n) if way == "real surface" else ("x,y,z,w0", x, w)),
        )
    flaw = read(case)
    elsewhere, _ = places(drawn, 300)
    assert flaw.deviation(elsewhere) / H == pytest.approx(wave(elsewhere), abs=1e-2)
    assert flaw.account.startswith("scan.csv: 600 values, w0 from -")
    assert "residual of the fit" in flaw.account


def test_factor_and_noise(tmp_path: Path) -> None:
    case = made(CYLINDER, tmp_path, amplitude=2.0)
    x, _ = places(outline(case.shell), 700)
    write(tmp_path, "x,y,z,w0", x, wave(x) + 0.05 * RNG.standard_normal(len(x)))
    flaw, again = read(case), read(made(CYLINDER, tmp_path, noise=0.05))
    for found, factor in ((flaw, 2), (again, 1)):
        assert np.sqrt(np.mean((found.deviation(x) / H / factor - wave(x)) ** 2)) < 0.025
    assert float(flaw.account.split("noise ")[1].split()[0]) == pytest.approx(0.05, rel=0.1)
    assert case.outside["imperfections.0.file"]


def test_what_is_refused(tmp_path: Path) -> None:
    case = made(CYLINDER, tmp_path)
    x, n = places(outline(case.shell), 600)
    w = wave(x)
    hole = np.linalg.norm(x - [1, 0, 0.75], axis=1) > 0.5
    for header, columns, words in (
        (
            "x,y,z,w0",
            (x, w / H**2),
            "w0 reaches .* h; allowed at most 25; without a unit in the header, w0 is over h",
        ),
        ("x,y,z,w0", (25.2 * x, w), "R from the shell: give the columns their unit, such as x"),
        ("x,y,z,w0", (x + 0.2 * n, w), "the unit of one of them is wrong"),
        ("x,y,z", (x + np.array([0.0, 0.0, 0.6]),), "R from the shell|frame|no value lies within"),
        ("x,y,z,w0", (x[hole], w[hole]), "no value lies within .* give values there"),
        ("polar,azimuth,w0", (x[:, :2], w), "polar and azimuth are of a sphere"),
    ):
        write(tmp_path, header, *columns)
        with pytest.raises(
            CaseError, match=rf"shell\.imperfections\.0\.file: scan\.csv: .*({words})"
        ):
            read(made(CYLINDER, tmp_path))
    with pytest.raises(CaseError, match="cannot be read: No such file"):
        read(made(CYLINDER, tmp_path / "elsewhere"))
