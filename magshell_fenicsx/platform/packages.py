"""The packages that no pip dependency names: dolfinx, PETSc and MPI, from PyPI's wheels or from the
system.

PyPI's wheel of dolfinx and PETSc links the MPI library that `mpi4py.MPI` has loaded, wherever that
is; it finds none itself. So MPI comes first, whatever asks for dolfinx.
"""

import sys
from importlib.abc import MetaPathFinder
from typing import Any

OF_MPI = {"dolfinx", "petsc4py", "slepc4py"}
NAMES = {*OF_MPI, "mpi4py", "basix", "ffcx", "ufl", "cffi", "gmsh"}
WAYS = (
    '`python3 -m pip install ".[dolfinx]"` in the repository installs it on Linux with an x86_64 processor and '
    "Python 3.12 or newer; docs/install.md has ways for other machines"
)


LIBRARIES = "libglu1-mesa libgl1 libxrender1 libxcursor1 libxfixes3 libxft2 libxinerama1 libfontconfig1 libgomp1"


class Unusable(RuntimeError):
    """What the program needs is missing on this machine, or is of another kind."""


class MpiFirst(MetaPathFinder):
    """Imports MPI where dolfinx, PETSc or SLEPc is first asked for; finds nothing itself."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> None:
        """Find nothing."""
        if fullname in OF_MPI:
            sys.meta_path.remove(self)
            import mpi4py.MPI  # noqa: F401


def load_mpi_first() -> None:
    """Have MPI imported before dolfinx; takes no time until then."""
    if not OF_MPI & sys.modules.keys():
        sys.meta_path.insert(0, MpiFirst())


def gmsh_module() -> Any:
    """The package gmsh.

    Raises
    ------
    Unusable
        If a library of the system is missing that it takes.
    """
    try:
        import gmsh
    except OSError as e:
        raise Unusable(
            f"gmsh cannot be loaded: {e}: install that library, on Debian by apt install {LIBRARIES}"
        ) from None
    return gmsh


def missing(e: ImportError) -> str | None:
    """What to do about an import that failed; None if it is not of one of these packages."""
    package = (e.name or "").partition(".")[0]
    return f"{package} cannot be imported ({e}): {WAYS}" if package in NAMES else None
