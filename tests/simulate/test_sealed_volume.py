"""A sealed shell under a second load: the volume is held, the pressure follows."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from command import mpirun

CASES = Path(__file__).parents[2] / "cases"
SEALED = """
import json, sys
import magshell_fenicsx as ms
from magshell_fenicsx.continuation.control import PrescribedConjugate, PrescribedLoad
from magshell_fenicsx.continuation.device import Device, natural_scale
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import StepOptions

settings = ["symmetry=none", "mesh.degree=2", "mesh.refinement=0.4"]
case = ms.Case.load(sys.argv[1], settings)
scene = ms.Scene(case, terms=[ms.OwnTerm("weight", lambda r0, u: u.r[2])])
newton, system, rest = scene.newton, scene.model.system, scene.unloaded()
scale = {"pressure": natural_scale(system, newton.factor_at(rest), rest, "pressure")}
sealed = newton.for_system(device := Device(system, {"pressure": 0.0}, scale))
load = -4e-4
path = Path(sealed, "weight", "load", StepOptions(abs(load) / 3, abs(load), 1e-9))
*_, (end, _) = path.continue_to(path.start(device.enter(rest)), [load])
state = device.leave(end.state)

# the same by another way: the weight first, then the pressure until the volume is that of before
open_ = newton.solve(rest, "weight", PrescribedLoad("weight", load))
volume = PrescribedConjugate(system, "pressure", 0.0)
closed = newton.solve(open_.state, "pressure", volume)
direct = newton.response(closed.state, "pressure", volume, exact=True)
held = direct.negative_pivots - (direct.softness < 0)
if scene.comm.rank == 0:
    print(json.dumps({"pressure": state.mu["pressure"], "again": closed.state.mu["pressure"],
        "unstable": end.negative_pivots, "held": held, "scale": scale["pressure"]}))
volumes = [-system.potential(s.u, s.mu, "pressure") for s in (state, open_.state)]
assert abs(volumes[0]) < 1e-7 * abs(volumes[1]), volumes
"""


def sealed(ranks: int) -> dict[str, float]:
    command = [*mpirun(ranks), sys.executable, "-c", SEALED]
    done = subprocess.run(
        [*command, str(CASES / "dimple_buckling.yaml")], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.splitlines()[-1]))


@pytest.mark.slow
def test_sealed_shell_on_ranks() -> None:
    """The state is that of the weight with the pressure that restores the volume, and the same on
    two ranks.
    """
    one, *others = (sealed(ranks) for ranks in (1, 2))
    assert one["pressure"] == pytest.approx(one["again"], rel=1e-8)
    assert abs(one["pressure"]) > 0.01
    assert one["unstable"] == one["held"] == 0
    for other in others:
        assert other == pytest.approx(one, rel=1e-9)
