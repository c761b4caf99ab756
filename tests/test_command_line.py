"""Exit codes, messages and files of the command line."""

import json
import os
import shlex
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from command import magshell, read_path, started
from conftest import CASES

from magshell_fenicsx import __version__

PLATE = CASES / "clamped_plate.yaml"
COLUMNS = (
    "point,label,amplitude,p_over_pc,lambda_m,force,w_over_h,w_from_field_over_h,w_pole_over_h,volume_change,energy,"
    "negative_pivots,negative_pivots_held,iterations,factorisations,wall_s,stretching,bending,magnetic,U1,Uq,Utau,mode,field_angle,"
    "branch,w_point_over_h,error_over_h,load_error,excluded_pivots,step"
)


@pytest.fixture(scope="module")
def plate(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that one process has written."""
    out = tmp_path_factory.mktemp("plate") / "deep" / "folder"
    done = started("run", PLATE, "--out", out)
    assert done.returncode == 0, done.stderr
    return out


def test_run_writes_everything(plate: Path) -> None:
    out = plate
    assert (out / "path.csv").read_text(encoding="utf-8").splitlines()[0] == COLUMNS
    summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
    assert summary["case"]["shell"]["geometry"] == "disc"
    assert summary["knockdown"] is None
    assert summary["limit_points"] == []
    assert summary["mesh"].keys() == {"cells", "dofs", "degree"}
    assert summary["timing"].keys() >= {
        "jit_s",
        "setup_s",
        "assembly_s",
        "factor_s",
        "solve_s",
        "total_s",
    }
    assert summary["blas"] != "reference"
    kernels = summary["model"]["kernels"]
    assert not any("magnetic" in name for name in kernels)
    assert summary["model"]["forms"] == len(kernels)
    assert not (out / "checkpoint").exists()
    rows = len(read_path(out))
    assert len(list((out / "fields").glob("*.vtu"))) == rows
    assert (out / "fields" / "path.pvd").read_text(encoding="utf-8").count("DataSet") == rows
    for picture in ("shell.png", "curve.png"):
        assert (out / picture).stat().st_size > 10_000
    assert (out / "report.html").read_text(encoding="utf-8").count("data:image/png;base64,") == 4


def test_a_second_run_replaces_the_first(plate: Path, no_pictures: None) -> None:
    rows = len(read_path(plate))
    assert magshell("run", PLATE, "--out", plate).returncode == 0
    assert len(read_path(plate)) == rows


def test_fields_hold_the_displacement(plate: Path) -> None:
    """Points of the .vtu are r0, to be warped by u, and w/h is -u . n0."""
    import numpy as np
    import pyvista

    grid = pyvista.read(plate / "fields" / "point_0001.vtu")
    u = grid.point_data["u"]
    assert u == pytest.approx(grid.point_data["u_over_h"] / 50, abs=1e-15)
    assert grid.points == pytest.approx(grid.point_data["r0"], abs=1e-7)
    assert grid.point_data["w_over_h"] == pytest.approx(-u[:, 2] * 50, abs=1e-9)
    assert np.linalg.norm(grid.point_data["n0"], axis=1) == pytest.approx(1.0)


@pytest.mark.parametrize("ranks", [0, 2])
def test_invalid_case_is_one_message_and_leaves_nothing(tmp_path: Path, ranks: int) -> None:
    out = tmp_path / "out"
    done = started("run", PLATE, "--set", "shell.poisson_ratio=0.7", "--out", out, ranks=ranks)
    assert done.returncode == 2
    assert done.stderr.count("shell.poisson_ratio: 0.7: must be less than or equal to 0.5") == 1
    assert "Traceback" not in done.stderr
    assert not out.exists()


@pytest.mark.parametrize("out", ["/dev/null/x", "/proc/none"])
def test_unwritable_out(out: str) -> None:
    done = magshell("run", PLATE, "--out", out)
    assert done.returncode == 2
    assert done.stderr.startswith(f"--out {out}: cannot be written: ")
    assert len(done.stderr.splitlines()) == 1


AFTER_PETSC = """
from magshell_fenicsx import cli
def app(**_):
    from petsc4py import PETSc
    from magshell_fenicsx.platform.terminal import print_line
    print_line("said")
cli.app = app
cli.main()
"""


@pytest.mark.parametrize("words", [["-m", "magshell_fenicsx", "schema"], ["-c", AFTER_PETSC]])
def test_nobody_reads_what_is_said(words: list[str]) -> None:
    """As of `| head`: the end of any program, without a report by PETSc of a crash."""
    with subprocess.Popen(
        [sys.executable, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as said:
        assert said.stdout
        assert said.stderr
        said.stdout.close()
        assert said.stderr.read() == b""
    assert said.returncode == -signal.SIGPIPE


def test_a_bug_on_one_rank_ends_all(tmp_path: Path) -> None:
    """The other waits for it in a collective call."""
    program = """
from mpi4py import MPI
from magshell_fenicsx import cli
def app(**_):
    if MPI.COMM_WORLD.rank == 0:
        raise AssertionError("a bug")
    MPI.COMM_WORLD.Barrier()
cli.app = app
cli.main()
"""
    (tmp_path / "program.py").write_text(program)
    command = [
        "mpirun",
        "--map-by",
        ":OVERSUBSCRIBE",
        "-n",
        "2",
        sys.executable,
        str(tmp_path / "program.py"),
    ]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode
    assert "AssertionError: a bug" in done.stderr


def test_an_interrupt_within_a_solve_of_petsc() -> None:
    """PETSc's error hides it; the program ends as after any other interrupt."""
    program = """
from petsc4py import PETSc
from magshell_fenicsx import cli
class Interrupted:
    def mult(self, A, x, y):
        raise KeyboardInterrupt
def app(**_):
    A = PETSc.Mat().createPython((2, 2), Interrupted())
    A.setUp()
    x, b = A.createVecs()
    b.set(1.0)
    ksp = PETSc.KSP().create()
    ksp.setOperators(A)
    ksp.pc.setType("none")
    ksp.solve(b, x)
cli.app = app
cli.main()
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (130, "")


def test_an_interrupt_while_the_program_is_imported() -> None:
    """It ends at once, as after any other interrupt."""
    program = """
import signal, sys
from magshell_fenicsx.__main__ import main
class Interrupting:
    def find_spec(self, name, path=None, target=None):
        if name == "typer":
            signal.raise_signal(signal.SIGINT)
signal.signal(signal.SIGINT, signal.default_int_handler)  # a background job ignores it
sys.meta_path.insert(0, Interrupting())
main()
"""
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_missing_file_and_no_case() -> None:
    done = magshell("run", "nowhere.yaml")
    assert (done.returncode, done.stderr) == (
        2,
        "nowhere.yaml: cannot be read: No such file or directory\n",
    )
    assert magshell("run").returncode == 2


@pytest.mark.slow
def test_stopping_early_is_told_and_keeps_the_points(tmp_path: Path) -> None:
    """Load control cannot pass the limit point of the dimpled shell."""
    settings = ["loading={kind: pressure, control: load, until: target, pressure: 0.5, points: 2}"]
    settings += ["symmetry=half", "mesh.degree=3", "mesh.refinement=0.6"]
    done = magshell(
        "run",
        CASES / "dimple_buckling.yaml",
        *(f"--set={s}" for s in settings),
        "--out",
        tmp_path / "out",
    )
    assert done.returncode == 3
    assert "load control stopped" in done.stderr
    rows = read_path(tmp_path / "out")
    assert 0.32 < float(rows[-1]["p_over_pc"]) < 0.34
    assert (
        "load control"
        in json.loads((tmp_path / "out" / "summary.json").read_text(encoding="utf-8"))["stopped"]
    )


def test_check_tells_what_is_left_out() -> None:
    done = magshell("check", CASES / "dimple_buckling.yaml")
    assert done.returncode == 0
    assert "magnetic energy: lambda_m is zero" in done.stdout
    assert "R/h = 90" in done.stdout
    assert "p_c/E = " in done.stdout
    assert (
        "p_c" not in magshell("check", CASES / "magnetic_strip.yaml").stdout
    )  # of a flat shell without a pressure


def test_version() -> None:
    done = started("--version")
    assert (done.returncode, done.stdout, done.stderr) == (
        0,
        f"magshell_fenicsx {__version__}\n",
        "",
    )


REFUSED = f"run {CASES / 'dimple_buckling.yaml'} --set shell.poisson_ratio=9"


@pytest.mark.parametrize(
    "asked",
    [["--version", "example", REFUSED, REFUSED.replace("run", "check", 1), "schema"], ["--help"]],
)
def test_words_load_no_solver(asked: list[str]) -> None:
    """They would take seconds. Schema and cases have the keys of parts, whose energies are written
    in UFL.

    One after the other in a process, whose modules are seen after each.
    """
    code = """
import sys
from magshell_fenicsx.cli import app
for words in sys.argv[1:]:
    try:
        app(words.split())
    except SystemExit as e:
        print("after", e.code or 0, *sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", code, *asked], capture_output=True, text=True, check=True
    )
    after = [line.split()[1:] for line in done.stdout.splitlines() if line.startswith("after ")]
    for words, (code, *modules) in zip(asked, after, strict=True):
        assert int(code) == (2 if "=9" in words else 0)
        solvers = {"dolfinx", "petsc4py", "scipy"} | (
            {"ufl"} if words in ("--version", "example", "--help") else set()
        )
        solvers |= {"rich"} if words != "--help" else set()  # a seventh of a second
        assert not solvers & {*modules}, words


def test_the_package_is_imported_as_it_is_used() -> None:
    """Every public name is there, and `run` is the function even after an import of the folder
    runs/.
    """
    code = """
import sys
import magshell_fenicsx as ms
assert "dolfinx" not in sys.modules
import magshell_fenicsx.runs.running, magshell_fenicsx.runs.status
assert ms.run.__name__ == "run" and "run" in dir(ms)
slow = {"scipy.optimize", "scipy.interpolate", "scipy.spatial"}  # a quarter of a second of each run
assert not slow & sys.modules.keys()
from magshell_fenicsx import *
assert run is ms.run and kinematics.Jet is ms.Jet
assert set(ms.__all__) <= set(globals())
assert not hasattr(ms, "none of it")
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_examples_have_names() -> None:
    """Which are listed, and told where a name is none."""
    listed = magshell("example").stdout.splitlines()
    assert "clamped_plate            Clamped circular plate under a small pressure" in listed
    done = magshell("example", "plate")
    assert done.returncode == 2
    assert done.stderr.count("example plate: there is no such case, only arch, ") == 1


def test_an_example_is_written_once(tmp_path: Path) -> None:
    """What is there is kept, with exit code 2 and one message."""
    target = tmp_path / "mine.yaml"
    assert magshell("example", "clamped_plate", target).stdout == f"wrote {target}\n"
    before = target.read_bytes()
    again = magshell("example", "clamped_plate", target)
    assert (again.returncode, again.stdout) == (2, "")
    assert again.stderr == f"{target}: is there already, and is kept; name a file elsewhere\n"
    assert target.read_bytes() == before


def test_info() -> None:
    done = magshell("info")
    assert done.returncode == 0
    assert "openblas" in done.stdout


SMALL = (CASES / "dimple_buckling.yaml", "--set=mesh={refinement: 0.3, degree: 2}", "--no-pictures")
CLOSED = "exec {python} -m magshell_fenicsx run {case} --out {out} <&- >&- 2>&-"


def test_standard_output_on_a_full_disk(tmp_path: Path) -> None:
    """A run goes on: its results are in its folder.

    What only prints says that nothing was printed.
    """
    for words, code in (("run", *SMALL, "--out", tmp_path / "out"), 0), (("schema",), 3):
        command = [sys.executable, "-m", "magshell_fenicsx", *map(str, words)]
        with Path("/dev/full").open("w") as full:
            done = subprocess.run(
                command, stdout=full, stderr=subprocess.PIPE, text=True, check=False
            )
        said = "standard output cannot be written: No space left on device"
        assert done.returncode == code
        assert done.stderr.splitlines() == [
            f"warning: {said}; nothing more is printed",
            *[f"stopped early: {said}"][:code],
        ]
    assert len(read_path(tmp_path / "out")) == 5


def test_closed_descriptors(tmp_path: Path) -> None:
    """No file of the run takes their numbers."""
    words = CLOSED.format(
        python=sys.executable,
        case=shlex.join(map(str, SMALL)),
        out=shlex.quote(str(tmp_path / "out")),
    )
    assert subprocess.run(["sh", "-c", words], check=False).returncode == 0
    assert len(read_path(tmp_path / "out")) == 5


@pytest.mark.slow
def test_a_kernel_cache_that_cannot_be_written(tmp_path: Path) -> None:
    """Another folder of the user's own takes its place."""
    command = [sys.executable, "-m", "magshell_fenicsx", "run", *map(str, SMALL), "--no-pictures"]
    environment = {**os.environ, "XDG_CACHE_HOME": "/dev/null/cache", "HOME": str(tmp_path)}
    done = subprocess.run(
        [*command, "--out", tmp_path / "out"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert list(tmp_path.glob(".cache/magshell/**/*.so"))


@pytest.mark.parametrize(
    "words",
    [
        ("check", CASES / "programme.yaml", "--set", "loading.²=1"),
        ("sweep", SMALL[0], "--over", "mesh.degree=2,3,4", "--part", "²/³"),
        ("ensemble", CASES / "random_dimples.yaml", "--samples=3", "--seed=1", "--part", "¹/²"),
        ("run", *SMALL, "--time-limit", "nan"),
    ],
    ids=["item of a list", "part of a sweep", "part of an ensemble", "time limit"],
)
def test_no_numbers(tmp_path: Path, words: tuple[str | Path, ...]) -> None:
    out = () if words[0] == "check" else ("--out", tmp_path / "out")
    done = magshell(*words, *out)
    assert done.returncode == 2
    assert str(words[-1]) in done.stderr
    assert not (tmp_path / "out").exists()


def test_options_of_petsc(tmp_path: Path) -> None:
    done = started(
        "run",
        *SMALL,
        "--out",
        tmp_path / "out",
        "-snes_monitor",
        "-snes_max_it",
        30,
        pictures=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    assert "0 SNES Function norm" in done.stdout


def test_options_of_petsc_come_last(tmp_path: Path) -> None:
    """Else PETSc would take a case file for the file into which it writes."""
    done = started("run", "-snes_monitor", *SMALL, "--out", tmp_path / "out", pictures=False)
    assert done.returncode == 2
    assert "options of PETSc come last" in done.stderr
    assert not (tmp_path / "out").exists()
