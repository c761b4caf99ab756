"""What a program gets of a run: its history as a table, records with their displacement, pictures
without a display.
"""

import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pandas
import pytest
import pyvista
from conftest import CASES
from dolfinx import fem, plot
from matplotlib.image import imread
from mpi4py import MPI

import magshell_fenicsx as ms
from magshell_fenicsx.output.store.table import COLUMNS

QUICK = ["mesh.refinement=0.4"]


@pytest.fixture(scope="module")
def result() -> ms.Result:
    return ms.run(ms.Case.load(CASES / "dimple_buckling.yaml", QUICK))


def test_history_is_a_table(result: ms.Result) -> None:
    """Columns as in path.csv; the frame has the same numbers, and its last row is k_d."""
    table = result.history
    assert set(COLUMNS) <= set(table)
    assert {len(column) for column in table.values()} == {len(result.rows)}
    frame = table.to_pandas()
    assert isinstance(frame, pandas.DataFrame)
    assert frame["p_over_pc"].iloc[-1] == result.knockdown
    assert frame.query("label == 'fold'").shape[0] == 1
    assert frame["volume_change"].dtype == np.float64
    with pytest.raises(KeyError, match="-1: columns have names, such as p_over_pc"):
        table[-1]  # type: ignore[index]


def test_columns_are_the_same(result: ms.Result) -> None:
    """Of a record alone, but for the time."""
    found = ms.columns(result.scene, [result.record])
    assert "wall_s" not in found
    assert found["p_over_pc"][0] == pytest.approx(result.history["p_over_pc"][-1], rel=1e-12)


def test_without_pandas(result: ms.Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ModuleNotFoundError, match="to_pandas: needs pandas"):
        result.history.to_pandas()


def test_records_of_a_run(result: ms.Result) -> None:
    """The last one is the fold, with the displacement as a function; its space has the degree of
    the case.
    """
    (fold,) = result.instabilities
    assert fold is result.record
    assert fold.u.function_space.element.basix_element.degree == result.scene.model.degree
    assert np.array_equal(fold.u.x.array, result.last.u)
    assert ms.fold_at(result.scene, fold).value == pytest.approx(result.knockdown, rel=1e-8)


PROGRAM = """
import os, sys
import pyvista
import magshell_fenicsx as ms

disc = {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": 0.3}
pressed = {"kind": "pressure", "control": "load", "until": "target", "pressure": 1e-3}
result = ms.run({"shell": disc, "boundary": {"rim": "clamped"}, "loading": pressed})
ms.off_screen()
shell = ms.polydata(result.scene, result.record)
for file in sys.argv[1:]:
    shell.plot(scalars="w_over_h", screenshot=file, window_size=[300, 200])
print(os.environ["DISPLAY"])
"""


@pytest.mark.slow
def test_pictures_of_pyvista_without_a_display(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two pictures with colours; the virtual display is gone with the process."""
    monkeypatch.delenv("DISPLAY", raising=False)
    files = [tmp_path / "one.png", tmp_path / "two.png"]
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *map(str, files)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    for file in files:
        assert np.ptp(imread(file)[..., :3], axis=2).max() > 0.3, "no colours"
    socket = Path("/tmp/.X11-unix") / f"X{done.stdout.split()[-1].removeprefix(':')}"
    for _ in range(50):
        if not socket.exists():
            return
        time.sleep(0.1)
    raise AssertionError(f"{socket} is still there")


def test_a_case_of_a_mapping() -> None:
    """Documented with `Case.load`; a mistake is one message with the key."""
    disc = {"geometry": "disc", "radius_to_thickness": 50, "poisson_ratio": 0.3}
    case = ms.Case.from_source(
        {"shell": disc, "boundary": {"rim": "clamped"}, "loading": {"kind": "pressure"}}
    )
    assert case.problem().material.h == 1 / 50
    with pytest.raises(
        ms.CaseError, match=r"shell\.poisson_ratio: 0\.7: must be less than or equal to 0\.5"
    ):
        ms.Case.from_source(
            {"shell": {**disc, "poisson_ratio": 0.7}, "boundary": {"rim": "clamped"}}
        )


def test_no_display_and_no_virtual_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.setattr(pyvista, "OFF_SCREEN", False)
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(RuntimeError, match="no Xvfb to make one"):
        ms.off_screen()


@pytest.mark.slow
def test_frequencies_and_gradients_need_no_folder() -> None:
    """A clamped disc rings at 10.2158 sqrt(D/(rho h R^4)) (Leissa); its bending stiffness is that
    of h^3.
    """
    case = {
        "shell": {"geometry": "disc", "radius_to_thickness": 1000, "poisson_ratio": 0.3},
        "boundary": {"rim": "clamped"},
        "loading": {
            "kind": "pressure",
            "control": "load",
            "until": "target",
            "pressure": 1e-9,
            "points": 1,
        },
        "frequencies": {"count": 1, "at": "ends"},
        "gradients": {"of": ["w_pole_over_h"], "by": ["shell.radius_to_thickness", "thickness"]},
    }
    result = ms.run(case)
    D = result.scene.problem.material.bending_stiffness
    found = [float(np.sqrt(modes[0].eigenvalue / D)) for modes in result.frequencies.values()]
    assert sorted(result.frequencies) == [0, result.end]
    assert found == pytest.approx([10.2158, 10.2158], rel=1e-4)
    gradient = result.gradients["w_pole_over_h"]
    assert gradient["fields"]["thickness"]["alike"][0] == pytest.approx(
        -3 * gradient["value"], rel=1e-4
    )


def test_functions_in_files_of_others(tmp_path: Path) -> None:
    """A displacement and a mode, node by node; pyvista reads them, and io4dolfinx where it is."""
    coarse = ["symmetry=half", "mesh.refinement=0.4"]
    model = ms.Model(ms.Case.load(CASES / "clamped_plate.yaml", coarse))
    *_, record = ms.follow(model)
    model.put(record)
    mode = model.modes(1)[0].u
    assert mode is not None
    suffix = "vtkhdf" if pyvista.vtk_version_info >= (9, 4) else "vtu"
    for name, u in (("displacement", record.u), ("mode", mode)):
        grid = pyvista.UnstructuredGrid(*plot.vtk_mesh(u.function_space))
        grid["u"] = u.x.array.reshape(-1, 3)
        grid.save(tmp_path / f"{name}.{suffix}")
        assert np.array_equal(pyvista.read(tmp_path / f"{name}.{suffix}")["u"], grid["u"])
        assert np.ptp(grid.points, axis=0)[:2] == pytest.approx([2, 1])
    io4dolfinx = pytest.importorskip("io4dolfinx")
    file = tmp_path / "plate.h5"
    io4dolfinx.write_mesh(file, record.u.function_space.mesh, backend="h5py")
    io4dolfinx.write_function(file, record.u, backend="h5py")
    mesh = io4dolfinx.read_mesh(file, MPI.COMM_WORLD, backend="h5py")
    copy = fem.Function(fem.functionspace(mesh, record.u.function_space.ufl_element()))
    copy.name = record.u.name
    io4dolfinx.read_function(file, copy, backend="h5py")
    assert np.linalg.norm(copy.x.array) == pytest.approx(np.linalg.norm(record.u.x.array))
