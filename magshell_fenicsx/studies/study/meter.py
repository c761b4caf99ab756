"""Runs a module as `python3 -m` does, and writes the peak memory of this rank to a folder.

`python3 -m magshell_fenicsx.studies.study.meter FOLDER MODULE ARGUMENT...`

The peak is the kernel's VmHWM. getrusage is no substitute: a process inherits the peak of its parent, and the parent
of several ranks gets only the largest.
"""

import os
import re
import runpy
import sys
from pathlib import Path


def main() -> None:
    folder, module, *arguments = sys.argv[1:]
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    finally:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
        peak = re.search(r"^VmHWM:\s*(\d+) kB$", status, re.MULTILINE)
        if peak:
            (Path(folder) / f"peak.{os.getpid()}").write_text(peak[1], encoding="utf-8")


if __name__ == "__main__":
    main()
