"""MPI before dolfinx, packages that are missing, and a PETSc of complex numbers."""

import subprocess
import sys
from pathlib import Path

import pytest
from conftest import CASES

from magshell_fenicsx.platform.packages import Unusable, import_gmsh, install_hint


@pytest.mark.parametrize(
    "first", ["petsc4py.PETSc", "dolfinx", "magshell_fenicsx.continuation.factor"]
)
def test_mpi_comes_first(first: str) -> None:
    """PyPI's PETSc finds no MPI library but the one that mpi4py has loaded."""
    code = f"""
import sys
import magshell_fenicsx
assert "mpi4py" not in sys.modules
import {first}
order = list(sys.modules)
assert order.index("mpi4py.MPI") < order.index("petsc4py")
assert not any(type(finder).__name__ == "MpiFirst" for finder in sys.meta_path)
"""
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize("name", ["dolfinx", "mpi4py", "petsc4py"])
def test_a_missing_package(name: str) -> None:
    """One message that says how to install it, exit code 2."""
    code = f"""
import sys
sys.modules["{name}"] = None
from magshell_fenicsx.cli import main
sys.argv = ["magshell", "run", "{CASES}/dimple_buckling.yaml"]
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith(f"{name} cannot be imported")
    assert ".[dolfinx]" in done.stderr
    assert done.stderr.count("\n") == 1


def test_gmsh_without_the_libraries_of_a_display(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The message names the library, and the packages that have it."""
    (tmp_path / "gmsh.py").write_text(
        'raise OSError("libGLU.so.1: no such file")', encoding="utf-8"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "gmsh", raising=False)
    with pytest.raises(
        Unusable, match=r"^gmsh cannot be loaded: libGLU\.so\.1: .* apt install libglu1-mesa"
    ):
        import_gmsh()


def test_a_package_that_pip_installs() -> None:
    assert install_hint(ImportError("no x", name="pandas.x")) is None


def test_complex_numbers_are_refused() -> None:
    """As dolfinx-solver of PyPI has them."""
    code = f"""
import sys
import numpy as np
import magshell_fenicsx
import dolfinx
from petsc4py import PETSc
PETSc.ScalarType = np.complex128
from magshell_fenicsx.cli import main
sys.argv = ["magshell", "run", "{CASES}/dimple_buckling.yaml"]
main()
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert done.stderr.startswith("this PETSc computes with complex numbers")
    assert done.stderr.count("\n") == 1
