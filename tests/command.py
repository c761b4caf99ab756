"""Running the command line as a user does."""

import csv
import gc
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from typer.testing import CliRunner

from magshell_fenicsx.cli import app
from magshell_fenicsx.platform import processes

NICE = ["nice", "-n", "-10"]
# click before 8.2 mixes both streams by default
APART: dict[str, Any] = (
    {"mix_stderr": False} if "mix_stderr" in inspect.signature(CliRunner).parameters else {}
)
FIRST = (
    [] if subprocess.run([*NICE, "true"], capture_output=True, check=False).stderr else NICE
)  # root may


def magshell(*arguments: str | Path | float, ranks: int = 0) -> subprocess.CompletedProcess[str]:
    """Run `magshell ...`: in this process, which saves two seconds, or undrawn under mpirun if it
    has more ranks.
    """
    words = [str(word) for word in arguments]
    if ranks > 1:
        return started(*words, ranks=ranks, pictures=False)
    words += ["--no-pictures"] if words[:1] == ["run"] and ranks else []
    done = CliRunner(**APART).invoke(app, words, prog_name="magshell")
    gc.unfreeze()  # a run freezes what it leaves, as its process ends soon
    if done.exception and not isinstance(done.exception, SystemExit):
        raise done.exception
    return subprocess.CompletedProcess(words, done.exit_code, done.stdout, done.stderr)


def importing_environment() -> dict[str, str]:
    """Return the environment of a Python process that imports what this one can."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}


def mpirun(ranks: int) -> list[str]:
    """The launcher of so many ranks.

    Ranks poll while they wait for each other: beside another test they take several times as long
    if not first.
    """
    return [*FIRST, *processes.mpirun_command(ranks)]


def started(
    *arguments: str | Path | float, ranks: int = 0, pictures: bool = True
) -> subprocess.CompletedProcess[str]:
    """Run `magshell ...` in processes of its own, under mpirun if `ranks` is given."""
    launcher, words = mpirun(ranks) if ranks else [], [str(word) for word in arguments]
    undrawn = ["--no-pictures"] if words[:1] == ["run"] and not pictures else []
    command = [
        *launcher,
        sys.executable,
        "-m",
        "magshell_fenicsx",
        *words[:1],
        *undrawn,
        *words[1:],
    ]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def read_path(folder: Path) -> list[dict[str, str]]:
    """Rows of path.csv."""
    with (folder / "path.csv").open(encoding="utf-8") as stream:
        return list(csv.DictReader(stream))


SEVERAL = """
import gc, json, sys
from magshell_fenicsx.cli import main
for words in json.loads(sys.argv[1]):
    sys.argv = ["magshell", *words]
    try:
        main()
    except SystemExit as e:
        if e.code:
            raise
    gc.unfreeze()
"""


def all_started(commands: list[list[str]], ranks: int) -> subprocess.CompletedProcess[str]:
    """Run `magshell ...` several times in the same processes under mpirun, which start once; all
    must succeed.
    """
    command = [*mpirun(ranks), sys.executable, "-c", SEVERAL, json.dumps(commands)]
    return subprocess.run(command, capture_output=True, text=True, check=False)
