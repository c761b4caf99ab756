"""The memory that is left, from the files in which the kernel says so, and models that are refused
for it.
"""

import re
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from command import magshell, mpirun
from conftest import CASES

import magshell_fenicsx as ms
from magshell_fenicsx.platform import environment
from magshell_fenicsx.problem.memory import MemoryEstimate

DIMPLE, BRACKET = CASES / "dimple_buckling.yaml", CASES / "bracket.yaml"
FULL = ["--set", "symmetry=none"]


def written(root: Path, **files: str) -> Path:
    for name, text in files.items():
        file = root / name.replace("__", "/")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text, encoding="utf-8")
    return root


def test_what_the_machine_says(tmp_path: Path) -> None:
    """Of the machine, of any group around the process, of either version, the least counts."""
    assert environment.available_memory(tmp_path) == float("inf")
    written(tmp_path, proc__meminfo="MemTotal: 9000 kB\nMemAvailable:    8000 kB\n")
    assert environment.available_memory(tmp_path) == 8000 * 1024
    written(tmp_path, proc__self__cgroup="0::/jobs/mine\n", sys__fs__cgroup__jobs__mine__x="")
    group = tmp_path / "sys/fs/cgroup/jobs"
    written(
        group,
        **{"memory.max": "5000000\n", "memory.current": "3000000\n", "memory.stat": "anon 1\n"},
    )
    written(group / "mine", **{"memory.max": "max\n", "memory.current": "3000000\n"})
    assert environment.available_memory(tmp_path) == 2_000_000
    written(group, **{"memory.stat": "anon 1\ninactive_file 500000\n"})
    assert environment.available_memory(tmp_path) == 2_500_000
    written(tmp_path, proc__self__cgroup="5:cpu:/old\n4:memory:/old\n")
    old = {"memory.limit_in_bytes": "4000000\n", "memory.usage_in_bytes": "3000000\n"}
    written(tmp_path / "sys/fs/cgroup/memory/old", **old)
    assert environment.available_memory(tmp_path) == 1_000_000


def test_a_limit_of_the_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written(tmp_path, proc__self__statm="1000 10 10 10 0 10 0\n")
    monkeypatch.setattr(environment.resource, "getrlimit", lambda what: (10**9, 10**9))
    assert environment.available_memory(tmp_path) == 10**9 - 1000 * resource.getpagesize()


def test_what_is_given_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MAGSHELL_MEMORY", "1.5")
    assert environment.available_memory(tmp_path) == 1.5e9
    for wrong in ("much", "-1", "nan"):
        monkeypatch.setenv("MAGSHELL_MEMORY", wrong)
        done = magshell("check", DIMPLE, *FULL)
        assert (done.returncode, done.stderr) == (
            2,
            f"MAGSHELL_MEMORY={wrong}: give the GB to count on, such as MAGSHELL_MEMORY=64\n",
        )


@pytest.mark.parametrize(
    ("degree", "unknowns", "half", "least", "most"),
    [
        (2, 38_142, False, 0.665, None),
        (3, 48_333, False, 0.833, None),
        (4, 85_587, False, 1.527, 2.485),
        (5, 91_833, False, 1.984, None),
        (4, 76_767, True, 2.039, 2.778),
        (4, 261_585, True, 7.129, None),
        (2, 19_485, True, None, 0.670),
        (3, 17_274, True, None, 0.640),
        (5, 31_398, True, None, 1.430),
    ],
)
def test_estimates(
    degree: int, unknowns: int, half: bool, least: float | None, most: float | None
) -> None:
    """Against the peaks of whole runs of the dimpled hemisphere in GB, of a static load and of a
    path past its fold.
    """
    case = ms.Case.load(DIMPLE, [f"mesh.degree={degree}"])
    found = MemoryEstimate.for_unknowns(case.context, unknowns, half=half)
    for measured, estimated in ((least, found.min_bytes), (most, found.max_bytes)):
        assert measured is None or estimated / 1e9 == pytest.approx(measured, rel=0.15)


@pytest.mark.parametrize(
    ("degree", "unknowns", "half", "measured"),
    [
        (2, 32_130, False, 0.769),
        (4, 34_176, False, 1.133),
        (2, 16_449, True, 0.635),
        (4, 17_223, True, 0.922),
        (3, 36_036, False, 0.996),
        (2, 71_250, False, 1.434),
        (2, 62_619, True, 1.931),
        (2, 56_163, True, 2.23),
    ],
)
def test_estimates_of_skewed_tangents(
    degree: int, unknowns: int, half: bool, measured: float
) -> None:
    """Against the peaks of paths of cylinders with a free edge under a live pressure, in GB."""
    case = ms.Case.load(DIMPLE, [f"mesh.degree={degree}"])
    found = MemoryEstimate.for_unknowns(case.context, unknowns, half=half, skewed=True)
    assert found.min_bytes / 1e9 == pytest.approx(measured, rel=0.15)


def test_a_live_pressure_beside_a_free_edge_takes_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`check` and `run` know it once there is a mesh; a dead pressure has a symmetric tangent."""
    case = tmp_path / "case.yaml"
    case.write_text(
        "shell: {geometry: cylinder, radius: 1, length: 2, thickness: 0.01, youngs_modulus: 1, "
        "poisson_ratio: 0.3}\n"
        "boundary: {bottom: clamped}\n"
        "symmetry: none\n"
        "loading: {kind: pressure, until: target, control: load, pressure: 1e-8, points: 1}\n"
        "mesh: {degree: 2, refinement: 0.85}\n"
    )
    monkeypatch.setenv("MAGSHELL_MEMORY", "0.3")
    closed = magshell("check", case, "--set", "boundary.top=clamped")
    assert (closed.returncode, closed.stderr) == (0, "")
    for command in (("check", case), ("run", case, "--out", tmp_path / "out")):
        done = magshell(*command)
        assert done.returncode == 2
        assert "of memory, and 0.3 GB are free: lower mesh.refinement" in done.stderr


@pytest.mark.parametrize("command", ["check", "run"])
def test_a_model_that_is_too_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    """One message with unknowns, estimate and what is free; with a little more memory it is only a
    warning.
    """
    words = [DIMPLE, *FULL, *(["--out", tmp_path / "out"] if command == "run" else [])]
    monkeypatch.setenv("MAGSHELL_MEMORY", "0.3")
    done = magshell(command, *words)
    assert done.returncode == 2
    said = re.fullmatch(
        r".*dimple_buckling\.yaml(?::\d+)?: mesh: about ([\d.e+]+) unknowns at radius/thickness "
        r"90 take ([\d.]+) to ([\d.]+) GB of memory, and 0\.3 GB are free: "
        r"lower mesh\.refinement \(1\) or mesh\.degree \(4\); where "
        r".* symmetry: half halves it; ranks on several machines share it; "
        r"MAGSHELL_MEMORY=GB in the environment .*\n",
        done.stderr,
    )
    assert said
    assert float(said[1]) == pytest.approx(22_000, rel=0.25)
    assert 0.3 < float(said[2]) < float(said[3]) < 1.5
    if command == "check":
        monkeypatch.setenv("MAGSHELL_MEMORY", f"{(float(said[2]) + float(said[3])) / 2}")
        done = magshell(command, *words)
        assert done.returncode == 0
        assert "GB are free: past an instability that may be too little" in done.stdout
        monkeypatch.setenv("MAGSHELL_MEMORY", "100")
        assert "GB are free" not in magshell(command, *words).stdout


def test_a_mesh_file_and_two_ranks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The cells of a file are counted; two ranks on one machine take its memory together; a
    meridian is never large.
    """
    monkeypatch.setenv("MAGSHELL_MEMORY", "0.2")
    done = magshell("check", BRACKET)
    assert done.returncode == 2
    assert "take a coarser mesh file, or a lower mesh.degree" in done.stderr
    assert magshell("check", CASES / "clamped_plate.yaml").returncode == 0
    monkeypatch.setenv("MAGSHELL_MEMORY", "0.45")  # enough for one
    words = [
        "-m",
        "magshell_fenicsx",
        "run",
        BRACKET,
        "--set",
        "mesh.degree=2",
        "--out",
        tmp_path / "out",
    ]
    ended = subprocess.run(
        [*mpirun(2), sys.executable, *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        timeout=100,
    )
    assert ended.returncode == 2
    assert ended.stderr.count("0.45 GB are free") == 1
    assert magshell("check", BRACKET, "--set", "mesh.degree=2").returncode == 0
