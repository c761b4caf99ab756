"""Findings of a history in its checkpoint: those of an interrupted run are not made again."""

from pathlib import Path

import numpy as np
import pytest
from dolfinx import fem, mesh
from mpi4py import MPI

from magshell_fenicsx.continuation.point import RecordedValues
from magshell_fenicsx.output.store.checkpoint import Checkpoint
from magshell_fenicsx.output.store.durable import Damaged
from magshell_fenicsx.output.store.journal_file import framed

VECTOR = np.linspace(0, 1, 7) / 3


def made_once() -> RecordedValues:
    values = {
        "counts": [np.int64(2)],
        "size": np.inf,
        "gap": np.nan,
        "said": "",
        "part": np.float64(0.1),
    }
    return RecordedValues(values, VECTOR)


def made_again() -> RecordedValues:
    raise AssertionError("it is known")


@pytest.mark.parametrize("renumbered", [False, True])
def test_a_finding_is_read_back(tmp_path: Path, renumbered: bool) -> None:
    """All numbers to the last digit; not a vector whose order on the ranks is another one now."""
    V = fem.functionspace(mesh.create_unit_square(MPI.COMM_SELF, 2, 2), ("Lagrange", 1, (3,)))
    places = V.tabulate_dof_coordinates()
    file = tmp_path / "checkpoint"
    file.write_bytes(framed(b"{}") + framed((places[::-1] if renumbered else places).tobytes()))
    first = Checkpoint(file, V, MPI.COMM_SELF)
    first.recorded_values(made_once)
    first.recorded_values(lambda: RecordedValues({"raised": {}}))
    first.close()
    second = Checkpoint(file, V, MPI.COMM_SELF)
    found, without = second.recorded_values(made_again), second.recorded_values(made_again)
    assert found.values["counts"] == [2]
    assert (found.values["size"], found.values["part"], found.values["said"]) == (np.inf, 0.1, "")
    assert np.isnan(found.values["gap"])
    assert found.vector is None if renumbered else np.array_equal(found.vector, VECTOR)
    assert without == RecordedValues({"raised": {}})
    assert second.recorded_values(lambda: RecordedValues({"next": 1})).values == {"next": 1}
    second.close()


def test_a_finding_is_no_result(tmp_path: Path) -> None:
    """Nor is a result a finding. A history that goes another way than its file's is refused."""
    V = fem.functionspace(mesh.create_unit_square(MPI.COMM_SELF, 2, 2), ("Lagrange", 1, (3,)))
    file = tmp_path / "checkpoint"
    file.write_bytes(framed(b"{}") + framed(V.tabulate_dof_coordinates().tobytes()))
    first = Checkpoint(file, V, MPI.COMM_SELF)
    first.recorded_values(made_once)
    first.record("no convergence")
    first.close()
    second = Checkpoint(file, V, MPI.COMM_SELF)
    with pytest.raises(Damaged, match="its results are in another order"):
        second.replay()
    with pytest.raises(Damaged, match="its results are in another order"):
        second.recorded_values(made_again)
    second.close()
