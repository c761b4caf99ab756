"""Cases of tests, and solutions that several tests read: a case is solved once in a process."""

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

from command import magshell

from magshell_fenicsx import Case
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.public import run
from magshell_fenicsx.runs.summary import Result

CASES = Path(__file__).parents[1] / "cases"


def case(**sections: Any) -> Case:
    """Return the case of these sections, which are checked as those of a file."""
    return Case.from_source(Source("test", sections))


@cache
def result(file: str, *settings: str) -> Result:
    """Return the result of a file of cases/, which nobody may change."""
    return run(Case.load(CASES / file, settings))


@cache
def _solved_folder(file: Path, settings: tuple[str, ...], pictures: bool) -> Path:
    """Return the results of a file, in a folder that is removed as the process ends."""
    scratch = Path(tempfile.mkdtemp(prefix="solved"))
    atexit.register(shutil.rmtree, scratch, ignore_errors=True)
    options = [f"--set={setting}" for setting in settings] + ([] if pictures else ["--no-pictures"])
    done = magshell("run", file, *options, "--out", scratch / "run")
    assert done.returncode == 0, done.stderr
    return scratch / "run"


def copy_of_solved(folder: Path, file: Path | str, *settings: str, pictures: bool = False) -> Path:
    """Solve a case on the command line, once in this process, and copy its folder of results.

    Parameters
    ----------
    folder
        Where the copy shall be; it must not exist.
    file
        Of the case; a relative one is one of cases/.
    settings
        As with `--set`.
    """
    return Path(shutil.copytree(_solved_folder(CASES / file, settings, pictures), folder))
