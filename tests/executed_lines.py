"""A plugin of pytest that writes which lines of the package each test executes in its process, and
its CPU time.

`python3 -m pytest -p executed_lines --executed-lines FILE` appends one line of JSON for each test:
its `test`, whether it is `slow`, its `seconds` of CPU with those of its children, whether it
`passed`, and its `lines` by module.
"""

import json
import os
import sys
from collections import defaultdict
from pathlib import Path
from types import CodeType
from typing import Any

import pytest

PACKAGE = str(Path(__file__).parents[1] / "magshell_fenicsx") + os.sep
TOOL = sys.monitoring.COVERAGE_ID
EVENTS = sys.monitoring.events

lines_of_module = defaultdict[str, set[int]](set)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--executed-lines",
        type=Path,
        help="file that the executed lines of each test are appended to",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Listen to functions of the package, and in these to lines."""
    sys.monitoring.use_tool_id(TOOL, "executed lines")
    sys.monitoring.register_callback(TOOL, EVENTS.PY_START, _function_begins)
    sys.monitoring.register_callback(TOOL, EVENTS.LINE, _line_begins)
    sys.monitoring.set_events(TOOL, EVENTS.PY_START)


def pytest_unconfigure() -> None:
    sys.monitoring.set_events(TOOL, 0)
    sys.monitoring.free_tool_id(TOOL)


def _function_begins(code: CodeType, offset: int) -> Any:
    if code.co_filename.startswith(PACKAGE):
        sys.monitoring.set_local_events(TOOL, code, EVENTS.LINE)
    return sys.monitoring.DISABLE


def _line_begins(code: CodeType, number: int) -> Any:
    lines_of_module[code.co_filename.removeprefix(PACKAGE)].add(number)
    return sys.monitoring.DISABLE  # until the next test


def cpu_seconds() -> float:
    """Return the CPU seconds of this process and of its children that have ended."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Any:
    """Write the record of one test."""
    file: Path | None = item.config.getoption("--executed-lines")
    lines_of_module.clear()
    sys.monitoring.restart_events()
    begin, failures = cpu_seconds(), item.session.testsfailed
    try:
        return (yield)
    finally:
        record = {
            "test": item.nodeid,
            "slow": item.get_closest_marker("slow") is not None,
            "seconds": round(cpu_seconds() - begin, 2),
            "passed": item.session.testsfailed == failures,
            "lines": {module: sorted(lines) for module, lines in lines_of_module.items()},
        }
        if file:
            with file.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(record) + "\n")
