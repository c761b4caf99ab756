"""Forms that scenes share: compiled once, bound to the mesh, the fields and the numbers of each."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import fem

from magshell_fenicsx.assembly import kernels
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.point_kernels import PointStorage, point_values
from magshell_fenicsx.case.open_problem import problem_of
from magshell_fenicsx.continuation.system import SkewedTangent, State
from magshell_fenicsx.platform import compat, disk_cache
from magshell_fenicsx.simulate.scene import Scene

CAP = {
    "shell": {
        "geometry": "cap",
        "radius": 1.0,
        "thickness": 0.01,
        "polar": 12.0,
        "poisson_ratio": 0.3,
    },
    "boundary": {"rim": "clamped"},
    "symmetry": "axisymmetric",
    "loading": {"kind": "pressure", "until": "limit"},
}
RING = CAP | {  # a pressure without potential, and its skew tangent
    "shell": {
        "geometry": "cylinder",
        "radius": 1.0,
        "length": 0.8,
        "thickness": 0.02,
        "poisson_ratio": 0.2,
    },
    "boundary": {"bottom": "clamped"},
}


def _evaluated(case: dict[str, Any]) -> list[np.ndarray[Any, Any]]:
    scene = Scene(problem_of(case))
    system, start = scene.model.system, scene.unloaded()
    u = system.zero_at_supports(1e-3 * np.sin(np.arange(system.size)))
    state = State(u, start.mu | {"pressure": 0.3})
    tangent = system.tangent(state.u, state.mu)
    products = list[np.ndarray[Any, Any]]()
    for part in (tangent.K, tangent.N) if isinstance(tangent, SkewedTangent) else (tangent,):
        x, y = part.createVecs()
        x.setArray(u)
        part.mult(x, y)
        products.append(np.array(y.array))
    volume = fem.assemble_scalar(scene.model._volume)
    energies = [*system.energies(u, state.mu).values(), volume]
    return [system.residual(state.u, state.mu), np.concatenate(products), np.array(energies)]


@pytest.mark.parametrize("case", [CAP, RING])
def test_a_scene_with_other_numbers_compiles_nothing(
    case: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its residual, tangent and energies are, to the last bit, those of forms that are compiled for
    it alone.
    """
    other = case | {"shell": case["shell"] | {"poisson_ratio": 0.37, "thickness": 0.013}}
    monkeypatch.setattr(kernels, "_compiled_forms", {})
    alone = _evaluated(other)
    monkeypatch.setattr(kernels, "_compiled_forms", {})
    first = _evaluated(case)

    def refused(*given: Any, **options: Any) -> None:
        raise AssertionError("a form is compiled again")

    monkeypatch.setattr(compat, "form_signature", refused)
    again = _evaluated(other)
    assert all(np.array_equal(one, two) for one, two in zip(alone, again, strict=True))
    assert not np.allclose(alone[-1], first[-1], rtol=1e-2, atol=0)


def test_progress_where_nobody_listens(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Scenes in Python, sweeps, boundaries: a line on standard error, and the next one half a
    minute later.
    """
    clock = iter([40.0, 40.0, 50.0, 70.0, 70.0])
    monkeypatch.setattr(kernels.time, "perf_counter", lambda: next(clock))
    status = kernels.Status()
    for line in ("first", "soon after", "later"):
        status.tell(line)
    assert capsys.readouterr() == ("", "first\nlater\n")


def test_what_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """How many kernels are there, of all that were begun; nothing where all are there."""
    monkeypatch.setattr(disk_cache, "_usual_folder", lambda: tmp_path)
    monkeypatch.setattr(kernels, "SILENT_SECONDS", 0.0)
    told, log = list[str](), KernelLog()

    def values() -> list[float]:
        points = PointStorage(1)
        z = points.field(1)
        z.x.array[:] = 0.5
        begun = [
            point_values(f"{power}", z[0] ** power * ufl.as_vector([1.0]), log)
            for power in (2, 3, 4)
        ]
        with kernels.reporting_progress_to(told.append):
            return [float(points.evaluate(each, 1)[0, 0]) for each in begun]

    assert values() == [0.25, 0.125, 0.0625]
    assert told[0] == "compiling kernels (once) 0 of 3"
    assert told[-1] == "compiling kernels (once) 3 of 3"
    told.clear()
    assert values() == [0.25, 0.125, 0.0625]
    assert not told
    assert log.names == ["2", "3", "4"] * 2
