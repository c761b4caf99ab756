"""The report in a web browser."""

import webbrowser
from pathlib import Path

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.report.report import NAME, write_report


def report_of(folder: Path) -> Path:
    """The report of a run's folder, written if it is not there.

    Raises
    ------
    CaseError
        If the folder holds no run with a summary.
    """
    if not (folder / NAME).exists():
        if not (folder / "summary.json").exists():
            raise CaseError(f"{folder} holds no report.html, and no summary.json to make one of")
        write_report(folder)
    return (folder / NAME).resolve()


def opened(file: Path) -> bool:
    """Whether a web browser could be asked to show a file."""
    try:
        return webbrowser.open(file.as_uri())
    except webbrowser.Error:
        return False
