"""Compilation: forms by dolfinx, functions at points by ours, and the time that both take."""

import ctypes
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cffi
import ufl
from dolfinx import fem
from mpi4py import MPI

from magshell_fenicsx.platform.compiler import check_room, library
from magshell_fenicsx.platform.kept import compiling, kernel_cache
from magshell_fenicsx.platform.processes import from_first

# -O1 compiles the tangents five times faster than -O2 and runs 15 % slower; -ffast-math halves the run time.
# No -march: the cache may be shared by unlike machines, and it gains nothing here.
JIT_OPTIONS: dict[str, Any] = {"cffi_extra_compile_args": ["-O1", "-g0", "-ffast-math"], "timeout": 600}


@dataclass
class KernelLog:
    """Names of the kernels of a problem and the seconds spent on compiling or loading them."""

    names: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def compile(self, name: str, expression: ufl.Form) -> fem.Form:
        """Compile a form, or load it from the cache."""
        start, folder = time.perf_counter(), kernel_cache()
        try:
            with compiling(folder):
                form = fem.form(expression, jit_options={**JIT_OPTIONS, "cache_dir": folder})
        except (OSError, cffi.VerificationError):
            check_room(folder)
            raise
        self._note(name, start)
        return form

    def compile_all(self, named: Iterable[Mapping[str, ufl.Form]]) -> dict[str, fem.Form]:
        """Compile forms under their names."""
        return {name: self.compile(name, form) for each in named for name, form in each.items()}

    def load(
        self, name: str, key: str, source: Callable[[], str], options: tuple[str, ...], comm: MPI.Comm
    ) -> ctypes.CDLL:
        """Load a library, which rank 0 compiles if there is none; collective. See `library`."""
        start = time.perf_counter()
        from_first(comm, lambda: library(key, source, options))
        loaded = ctypes.CDLL(str(library(key, source, options)))  # where disks are not shared each rank has its own
        self._note(name, start)
        return loaded

    def _note(self, name: str, start: float) -> None:
        self.seconds += time.perf_counter() - start
        self.names.append(name)
