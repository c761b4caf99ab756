"""Solutions that several tests read: a case is solved once in a process."""

from functools import lru_cache

from conftest import CASES

from magshell_fenicsx import Case, run
from magshell_fenicsx.runs.summary import Result


@lru_cache(maxsize=4)  # a result holds its scene, some 100 MB
def result(file: str, *settings: str) -> Result:
    """Return the result of a file of cases/, which nobody may change."""
    return run(Case.load(CASES / file, settings))


def result_of_whole_path(file: str, *settings: str) -> Result:
    """Return the same of a path that has reached its end."""
    whole = result(file, *settings)
    assert whole.stopped is None
    return whole
