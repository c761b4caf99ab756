"""Files of measured places and deviations: what is read, and what is refused."""

from pathlib import Path

import numpy as np
import pytest

from magshell_fenicsx.input.tables import TableError
from magshell_fenicsx.parts.imperfections.data import Lengths, read_scan

MM = Lengths(h=0.01, R=0.025, si=True)
BARE = Lengths(h=0.01, R=1.0, si=False)
ROWS = np.random.default_rng(1).random((30, 4))


def written(folder: Path, header: str, rows: np.ndarray = ROWS, delimiter: str = ",") -> Path:
    file = folder / "scan.csv"
    np.savetxt(file, rows, header=header, comments="", delimiter=delimiter)
    return file


@pytest.mark.parametrize(
    ("header", "lengths", "factors"),
    [
        ("x,y,z,w0", BARE, (1, 1, 1, 0.01)),
        ("x,y,z,w0 [R]", BARE, (1, 1, 1, 1)),
        ("x [mm],y [mm],z (mm),w0 [um]", MM, (0.04, 0.04, 0.04, 4e-5)),
        ("# x [mm], y [mm], z [mm], w0 [h]", MM, (0.04, 0.04, 0.04, 0.01)),
        ("x,y,z,w0", MM, (40, 40, 40, 0.01)),
    ],
)
def test_units(tmp_path: Path, header: str, lengths: Lengths, factors: tuple[float, ...]) -> None:
    """A place without a unit is in the shell's length, w0 without one over h."""
    found = read_scan(written(tmp_path, header), lengths)
    assert np.column_stack(
        [found.columns[name] for name in ("x", "y", "z", "w0")]
    ) == pytest.approx(ROWS * factors)


def test_angles_grids_and_rows_without_numbers(tmp_path: Path) -> None:
    polar, azimuth = np.linspace(0, 80, 9), np.linspace(0, 350, 36)
    w0 = np.outer(polar, azimuth)
    w0[2, 3] = np.nan
    np.savez(tmp_path / "grid.npz", polar=polar[:, None], azimuth=azimuth, w0=w0)
    found = read_scan(tmp_path / "grid.npz", BARE)
    assert (len(found.columns["w0"]), found.lost) == (9 * 36 - 1, 1)
    assert found.columns["polar"].max() == pytest.approx(np.radians(80))
    text = "polar;azimuth;w0\n" + "\n".join(
        f"{i};{10 * i};{'' if i == 5 else 0.1 * i}" for i in range(30)
    )
    (tmp_path / "a.csv").write_text(text)
    again = read_scan(tmp_path / "a.csv", BARE)
    assert (len(again.columns["w0"]), again.lost) == (29, 1)
    read_scan(written(tmp_path, "x y z w0", delimiter=" "), BARE)


@pytest.mark.parametrize(
    ("header", "rows", "words"),
    [
        ("x,y,w0", ROWS[:, :3], "needed are x, y, z, w0"),
        ("x,y,z,w0", ROWS[:5], "needed are 20"),
        (
            "x,y,z,w0",
            np.where(np.arange(30)[:, None] < 16, np.nan, ROWS),
            "14 rows of finite numbers in 30",
        ),
        ("x,y,z", ROWS, "3 names in its header and 4 columns"),
        ("x [mm],y [mm],z [mm],w0", ROWS, "column w0: has no unit"),
        ("x [kg],y [kg],z [kg],w0 [h]", ROWS, "column x: its unit kg is not convertible to metre"),
        ("polar [mm],azimuth,w0,z", ROWS, "is no angle"),
    ],
)
def test_what_is_refused(tmp_path: Path, header: str, rows: np.ndarray, words: str) -> None:
    with pytest.raises(TableError, match=words):
        read_scan(written(tmp_path, header, rows), MM)


def test_files_that_are_none(tmp_path: Path) -> None:
    (tmp_path / "a.npz").write_bytes(b"no archive")
    (tmp_path / "b.csv").write_text("x,y,z,w0\n1,2\n3\n")
    (tmp_path / "c.csv").write_text("")
    for name, words in (
        ("a.npz", "no .npz"),
        ("b.csv", "4 names in its header and 2 columns in line 2"),
        ("c.csv", "no rows"),
        ("d.csv", "No such file"),
    ):
        with pytest.raises(TableError, match=words):
            read_scan(tmp_path / name, BARE)
    with pytest.raises(TableError, match="has the unit mm, but the shell's lengths have none"):
        read_scan(written(tmp_path, "x [mm],y [mm],z [mm],w0 [h]"), BARE)
