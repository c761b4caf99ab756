"""A hemisphere pressed by a rigid plate, and by a stiff shell that stands for it: user CPU of whole
runs, alternating.

The shell is a coarse disc with a clamped edge, a thousand times as stiff. Both press by 0.4 h on
the same mesh.

python3 cases/benchmarks/pressed.py [--rounds 3] [--size "9 mm"]
"""

import argparse
import json
import resource
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

DOME = {
    "geometry": "hemisphere",
    "radius": "90 mm",
    "thickness": "1 mm",
    "youngs_modulus": "1 MPa",
    "poisson_ratio": 0.5,
}
DISC = {
    "geometry": "disc",
    "radius": "18 mm",
    "thickness": "1 mm",
    "youngs_modulus": "1 GPa",
    "poisson_ratio": 0.5,
}
CLAMPED = {"equator": "clamped"}
DEPTH = 0.4  # mm


def cases(size: str) -> dict[str, dict[str, Any]]:
    """Both cases, by name."""
    mesh = {"symmetry": "half", "mesh": {"degree": 3, "size": size}}
    down = {"supports": ["plate.rim"], "translation": ["0 mm", "0 mm", f"-{DEPTH} mm"]}
    plate = {
        "shell": DISC, "boundary": {"rim": "clamped"}, "mesh": {"refinement": 0.3},
        "place": {"position": ["0 mm", "0 mm", "91 mm"]},
    }  # fmt: skip
    return {
        "plate": {
            "shell": DOME, "boundary": CLAMPED, "bodies": {"plate": {"kind": "plane"}}, **mesh,
            "loading": {"kind": "contact", "control": "approach", "approach": f"{DEPTH} mm",
                        "points": 2},
        },
        "shell": {
            "shells": {"dome": {"shell": DOME, "boundary": CLAMPED}, "plate": plate},
            "contact": [["dome", "plate"]], **mesh,
            "loading": {"kind": "edge", "control": "load", "factor": 1, "points": 2,
                        "moves": [down]},
        },
    }  # fmt: skip


def seconds(file: Path, out: Path) -> float:
    """User CPU of a run."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    run = [
        sys.executable,
        "-m",
        "magshell_fenicsx",
        "run",
        str(file),
        "--out",
        str(out),
        "--overwrite",
        "--no-pictures",
    ]
    subprocess.run(run, check=True, stdout=subprocess.DEVNULL)
    return resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--size", default="9 mm")
    given = parser.parse_args()
    with TemporaryDirectory() as folder:
        for name, case in cases(given.size).items():
            (Path(folder) / f"{name}.yaml").write_text(json.dumps(case), encoding="utf-8")
        for _ in range(given.rounds):
            plate, shell = (
                seconds(Path(folder) / f"{name}.yaml", Path(folder) / name)
                for name in ("plate", "shell")
            )
            print(
                f"plate {plate:.2f} s, shell {shell:.2f} s, {shell / plate:.2f} times", flush=True
            )
