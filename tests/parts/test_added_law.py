"""A law of the material is one file and one name: Gent's rubber, in a copy of the package.

A sphere is blown up by p = 2 (h/R) W'(l)/l^2 with W' the slope of the energy by the stretch l. For
Gent's rubber this is 4 W_1 (1/l - 1/l^7), W_1 = J_m/(6 (J_m + 3 - I1)), I1 = 2 l^2 + 1/l^4.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

import magshell_fenicsx

PACKAGE, LAW = Path(magshell_fenicsx.__file__).parent, Path(__file__).parents[1] / "gent.py"
JM, R_OVER_H = 3.0, 100
SHELL: dict[str, Any] = {
    "geometry": "hemisphere",
    "radius_to_thickness": R_OVER_H,
    "poisson_ratio": 0.5,
    "law": "gent",
    "jm": JM,
}
SPHERE: dict[str, Any] = {
    "shell": SHELL,
    "points": {"top": [0, 0, 1]},
    "boundary": {"equator": "symmetry", "top": {"held": ["x", "y"]}},
    "loading": {
        "kind": "pressure",
        "control": "volume",
        "until": "target",
        "volume_change": 2.5,
        "points": 2,
    },
    "mesh": {"refinement": 0.5},
}
COMMANDS = """
import json, sys
from typer.testing import CliRunner
from magshell_fenicsx.cli import app
for words in json.loads(sys.stdin.read()):
    result = CliRunner().invoke(app, words, prog_name="magshell")
    print(json.dumps(result.output))  # both streams
"""
RUNS = """
import json, sys
import magshell_fenicsx as ms
for case in json.loads(sys.stdin.read()):
    rows = ms.run(case).rows
    print(json.dumps([[float(row["w_pole_over_h"]), float(row["p_over_pc"])] for row in rows]))
"""
GRADIENT = """
import json, sys
import magshell_fenicsx as ms
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.gradients.gradient import gradient
scene = ms.Scene(json.loads(sys.stdin.read()))
fold = next(record for record in follow(scene) if record.label == "fold")
slope = gradient(scene, fold, of="instability", by="shell.jm")["shell.jm"]
print(json.dumps([fold.point.state.mu["pressure"], slope]))
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Variables of a process that imports the package with one more law."""
    folder = tmp_path_factory.mktemp("copy")
    package = folder / PACKAGE.name
    shutil.copytree(PACKAGE, package, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(LAW, package / "parts" / "laws")
    registry_file = package / "parts" / "registry.py"
    registry = registry_file.read_text(encoding="utf-8")
    line = '        "laws.ogden.OgdenSection",\n'
    assert registry.count(line) == 1
    with_gent = registry.replace(line, line + '        "laws.gent.GentSection",\n')
    registry_file.write_text(with_gent, encoding="utf-8")
    path = os.pathsep.join([str(folder), *sys.path])
    return {**os.environ, "PYTHONPATH": path, "PYTHONSAFEPATH": "1"}


def printed(program: str, data: Any, environment: dict[str, str]) -> list[Any]:
    """The data that a Python program prints as lines of JSON, for data that it reads as JSON."""
    done = subprocess.run(
        [sys.executable, "-c", program],
        input=json.dumps(data),
        capture_output=True,
        text=True,
        env=environment,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith(("[", '"'))]


def test_what_check_and_schema_say(environment: dict[str, str], tmp_path: Path) -> None:
    """Of the law with its number, of its number without the law, of two laws, and of a solid."""
    linear = SHELL | {"law": "koiter"}
    shells = {
        "stiffening": {"shell": SHELL},
        "linear": {
            "shell": {key: value for key, value in linear.items() if key != "jm"},
            "place": {"position": [4, 0, 0]},
        },
    }
    several = {name: keys | {"boundary": {"equator": "clamped"}} for name, keys in shells.items()}
    clamped = {"boundary": {"equator": "clamped"}, "points": {}}
    cases = [
        SPHERE,
        SPHERE | {"shell": linear},
        {"shells": several, "loading": SPHERE["loading"]},
        SPHERE | clamped | {"model": "solid"},
    ]
    commands = [["schema", "--markdown"]]
    for number, case in enumerate(cases):
        (file := tmp_path / f"{number}.yaml").write_text(json.dumps(case), encoding="utf-8")
        commands.append(["check", str(file)])
    reference, check, refused, check_of_two, check_of_solid = printed(
        COMMANDS, commands, environment
    )
    assert "- `jm`: J_m of law: gent, the value of I1 - 3 that no stretch reaches." in reference
    assert "incompressible rubber at any stretch (Gent, J_m = 3)" in check
    assert "jm: J_m belongs to law: gent, and only to it; here the law is koiter" in refused
    assert "each of its own law: gent, koiter" in check_of_two
    assert "Gent energy, J_m = 3, kappa/mu = 100 " in check_of_solid


def sphere_pressure(stretch: Any, jm: float) -> Any:
    """The pressure from inside over E h/R."""
    first = 2 * stretch**2 + stretch**-4.0 - 3
    return 2 / 3 * jm / (jm - first) * (1 / stretch - stretch**-7.0)


@pytest.mark.slow
def test_a_sphere(environment: dict[str, str]) -> None:
    """On a meridian, to the order (h/R)^2.

    Other models: `test_rubber.py` and `test_solid_derivatives.py`.
    """
    (path,) = printed(RUNS, [SPHERE], environment)
    w, p = np.array(path[1:]).T
    stretch, pressure = 1 - w / R_OVER_H, -p * 4 / 3 / R_OVER_H
    assert stretch[-1] > 1.25
    assert pressure == pytest.approx(sphere_pressure(stretch, JM), rel=1e-3)


@pytest.mark.slow
def test_slope_by_the_number_of_the_law(environment: dict[str, str]) -> None:
    """The largest pressure of a sphere has the slope of the pressure at its stretch, as there dp =
    0.
    """
    loading = SPHERE["loading"] | {"volume_change": 7}
    case = SPHERE | {"shell": SHELL | {"jm": 30.0}, "loading": loading}
    ((pressure, slope),) = printed(GRADIENT, case, environment)
    stretch = minimize_scalar(lambda x: -sphere_pressure(x, 30.0), bounds=(1.2, 1.8)).x
    known = (sphere_pressure(stretch, 30.01) - sphere_pressure(stretch, 29.99)) / 0.02
    assert slope / pressure == pytest.approx(known / sphere_pressure(stretch, 30.0), rel=1e-3)
