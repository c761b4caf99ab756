"""Kernels as plain shared libraries, beside those of other programs in one cache."""

from pathlib import Path

import pytest
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

from magshell_fenicsx.assembly.kernels import JIT_OPTIONS


def area(options: dict[str, object]) -> float:
    domain = mesh.create_unit_square(MPI.COMM_SELF, 2, 2)
    two = fem.Constant(domain, 2.0)
    return float(fem.assemble_scalar(fem.form(two * ufl.dx(domain), jit_options=options)))


def test_ours_and_others_share_a_cache(tmp_path: Path) -> None:
    """Each is compiled once, and found again by its own way."""
    others = {"cffi_extra_compile_args": ["-O0"], "cache_dir": tmp_path}
    for _ in range(2):
        assert area({**JIT_OPTIONS, "cache_dir": tmp_path}) == area(others) == pytest.approx(2.0)
    plain = [file for file in tmp_path.glob("*.so") if ".cpython" not in file.name]
    assert len(plain) == 1
    assert len(list(tmp_path.glob("*.so"))) == 2


def test_what_does_not_compile(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error is raised, and the next attempt begins anew."""
    options = {**JIT_OPTIONS, "cache_dir": tmp_path}
    with monkeypatch.context() as broken:
        broken.setenv("CC", "false")
        with pytest.raises(Exception, match="false"):
            area(options)
    assert area(options) == pytest.approx(2.0)
