"""Studies in several processes: the processes of an executor give the tables of one process."""

import csv
from pathlib import Path

from command import magshell
from conftest import CASES

FILE = CASES / "dimple_buckling.yaml"
COARSE = "mesh.refinement=0.5"
DEPTHS = "shell.defect.amplitude=0.5,1,1.5"


def knockdowns(folder: Path, *jobs: str) -> list[str]:
    """The knockdown factors of three depths of a dimple, each along its own path."""
    done = magshell(
        *("sweep", FILE, "--over", DEPTHS, "--set", COARSE, "--full-paths", "--out", folder),
        *jobs,
    )
    assert done.returncode == 0
    with (folder / "sweep.csv").open() as table:
        return [row["k_d"] for row in csv.DictReader(table)]


def test_jobs_give_the_same_numbers(tmp_path: Path) -> None:
    one_process, two_processes = tmp_path / "one", tmp_path / "two"
    assert knockdowns(two_processes, "--jobs", "2") == knockdowns(one_process)
