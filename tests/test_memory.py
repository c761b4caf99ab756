"""A process that builds many scenes, one after the other, does not grow."""

import ctypes
import gc
import subprocess
import sys

import pytest
from conftest import CASES

import magshell_fenicsx as ms
from magshell_fenicsx.continuation.modes import critical_mode
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.public import Scene
from magshell_fenicsx.simulate.follow import follow

SCENES, TEN = int(sys.argv[1]) if __name__ == "__main__" else 20, 10
COARSE = ["symmetry=half", "mesh.degree=2", "mesh.refinement=0.3"]

NAMES = (
    "arena",
    "ordblks",
    "smblks",
    "hblks",
    "hblkhd",
    "usmblks",
    "fsmblks",
    "uordblks",
    "fordblks",
    "keepcost",
)


class Allocated(ctypes.Structure):
    """What glibc's mallinfo2 returns."""

    _fields_ = tuple((name, ctypes.c_size_t) for name in NAMES)


def in_use() -> int:
    """Bytes that are allocated and not freed; how much the process holds beyond them differs from
    run to run.
    """
    gc.collect()
    mallinfo2 = ctypes.CDLL(None).mallinfo2
    mallinfo2.restype = Allocated
    found = mallinfo2()
    return int(found.uordblks + found.hblkhd)


def unstable() -> None:
    """A dimpled half hemisphere, linearly at three times p_c; of every tenth the path through its
    fold too.
    """
    for number in range(SCENES):
        scene = Scene(ms.Case.load(CASES / "dimple_buckling.yaml", COARSE))
        if number % TEN == 0:
            assert [record.label for record in follow(scene)][-1] == "fold"
        rest, newton = scene.unloaded(), scene.newton
        u = -newton.factor_at(rest).solve(newton.system.load(rest.u, {}, "pressure"))
        assert critical_mode(newton, State(3 * u, {"pressure": 3.0})).negative_pivots > 0
        print(in_use(), flush=True)


@pytest.mark.slow
def test_unstable_scenes_leave_nothing_behind() -> None:
    """The last ten scenes add less than 0.1 %: a tangent that PETSc lost added more with each."""
    done = subprocess.run(
        [sys.executable, __file__, str(SCENES)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    sizes = [int(line) for line in done.stdout.split()]
    assert len(sizes) == SCENES
    assert sizes[-1] <= 1.001 * sizes[-1 - TEN]


if __name__ == "__main__":
    unstable()
