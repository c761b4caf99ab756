"""Packages that no pip dependency names: dolfinx, PETSc and MPI, from PyPI or the system.

PyPI's wheel of dolfinx and PETSc links the MPI library that `mpi4py.MPI` has loaded, and finds none
itself. So MPI must be imported before dolfinx, whichever module asks for dolfinx.
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
    """Import hook that imports MPI before dolfinx, PETSc or SLEPc; it finds no package itself."""

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> None:
        """Import MPI if the package needs it, and find nothing, so that other finders go on."""
        if fullname in MPI_PACKAGES:  # it is needed once only
            sys.meta_path.remove(self)
            import mpi4py.MPI  # noqa: F401


def load_mpi_first() -> None:
    """Install the hook that imports MPI before dolfinx; this itself imports nothing."""
    if not MPI_PACKAGES & sys.modules.keys():
        sys.meta_path.insert(0, MpiFirst())


def import_gmsh() -> Any:
    """Import gmsh and return it.

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
    """Return a message about how to install the package whose import failed.

    None if the package is none of `EXTERNAL_PACKAGES`.
    """
    package = (e.name or "").partition(".")[0]
    return (
        f"{package} cannot be imported ({e}): {INSTALL_WAYS}"
        if package in EXTERNAL_PACKAGES
        else None
    )
