"""A case, or the path of its file, as programs give it."""

from pathlib import Path

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.source import CaseError


def opened(case: Case | str | Path) -> Case:
    """The case itself, or the one in a file.

    Raises
    ------
    CaseError
        If it is neither, or the file is no valid case.
    """
    if isinstance(case, str | Path):
        return Case.load(case)
    if not isinstance(case, Case):
        raise CaseError(f"give a Case or the path of a case file, not a {type(case).__name__}; see Case.load")
    return case
