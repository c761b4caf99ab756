"""Packages that no pip dependency names: dolfinx, PETSc and MPI, from PyPI or the system.

PyPI's wheel of dolfinx and PETSc links the MPI library that `mpi4py.MPI` has loaded, wherever that
is; it finds none itself. So MPI comes first, whatever asks for dolfinx.
"""

import sys
from importlib.abc import MetaPathFinder
from typing import Any

MPI_PACKAGES = {"dolfinx", "petsc4py", "slepc4py"}
EXTERNAL_PACKAGES = {*MPI_PACKAGES, "mpi4py", "basix", "ffcx", "ufl", "cffi", "gmsh"}
INSTALL_WAYS = (
    '`python3 -m pip install ".[dolfinx]"` in the repository installs it on Linux with an x86_64 '
    "processor and Python 3.12 or newer; docs/install.md has ways for other machines"
)


GMSH_LIBRARIES = (
    "libglu1-mesa libgl1 libxrender1 libxcursor1 libxfixes3 libxft2 libxinerama1 libfontconfig1 "
    "libgomp1"
)


class Unusable(RuntimeError):
    """A requirement of the program is missing on this machine, or is of another kind."""


class MpiFirst(MetaPathFinder):
    """Imports MPI where dolfinx, PETSc or SLEPc is first asked for; finds nothing itself."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> None:
        """Find nothing."""
        if fullname in MPI_PACKAGES:
            sys.meta_path.remove(self)
            import mpi4py.MPI  # noqa: F401


def load_mpi_first() -> None:
    """Let MPI be imported before dolfinx; takes no time until then."""
    if not MPI_PACKAGES & sys.modules.keys():
        sys.meta_path.insert(0, MpiFirst())


def import_gmsh() -> Any:
    """Return the package gmsh.

    Raises
    ------
    Unusable
        If it needs a library that the system lacks.
    """
    try:
        import gmsh
    except OSError as e:
        raise Unusable(
            f"gmsh cannot be loaded: {e}: install that library, on Debian by apt install "
            f"{GMSH_LIBRARIES}"
        ) from None
    return gmsh


def install_hint(e: ImportError) -> str | None:
    """Return what to do about a failed import; None if it is of none of these packages."""
    package = (e.name or "").partition(".")[0]
    return (
        f"{package} cannot be imported ({e}): {INSTALL_WAYS}"
        if package in EXTERNAL_PACKAGES
        else None
    )
