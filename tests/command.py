"""Running the command line as a user does."""

import csv
import subprocess
import sys
from pathlib import Path


def magshell(*arguments: str | Path, ranks: int = 0) -> subprocess.CompletedProcess[str]:
    """Run `magshell ...`, under mpirun if `ranks` is given."""
    launcher = ["mpirun", "--map-by", ":OVERSUBSCRIBE", "-n", str(ranks)] if ranks else []
    command = [*launcher, sys.executable, "-m", "magshell_fenicsx", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def read_path(folder: Path) -> list[dict[str, str]]:
    """Rows of path.csv."""
    with (folder / "path.csv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))
