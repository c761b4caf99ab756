"""The environment of the program: versions, the BLAS of PETSc, the kernel cache."""

import platform
import re
from pathlib import Path

import dolfinx
import ufl
from petsc4py import PETSc

from magshell_fenicsx.platform.version import __version__

FAST_BLAS = re.compile(r"/lib(openblas|mkl_rt|mkl_core|blis|flexiblas|armpl)[^/]*$", re.MULTILINE)


def versions() -> dict[str, str]:
    """Versions of the packages that a result depends on."""
    return {
        "magshell_fenicsx": __version__,
        "dolfinx": dolfinx.__version__,
        "ufl": ufl.__version__,
        "petsc": ".".join(str(n) for n in PETSc.Sys.getVersion()),
        "python": platform.python_version(),
    }


def fast_blas() -> str | None:
    """Name of the optimised BLAS in this process; None for the reference BLAS.

    With the reference BLAS a factorisation takes seven times as long.
    """
    try:
        loaded = Path("/proc/self/maps").read_text(encoding="utf-8")
    except OSError:
        return "unknown"
    found = FAST_BLAS.search(loaded)
    return found[1] if found else None
