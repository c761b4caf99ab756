"""The package's C code, compiled once into the folder of the kernels."""

from pathlib import Path
from typing import Any

import cffi
from mpi4py import MPI

from magshell_fenicsx.platform.compiler import Library
from magshell_fenicsx.platform.processes import raised_by_all

OPTIONS = ("-O3", "-g0", "-DNDEBUG", "-fno-strict-overflow", "-std=gnu17")
GNU_OPTIONS = (
    "-fschedule-insns",
    "-fsched-pressure",
)  # of GCC alone: sums over pairs are a sixth faster
PRELUDE = """#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define FAST __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define FAST
#endif
#define INLINE static inline __attribute__((always_inline))
"""  # of each file: FAST functions are compiled for several processors


def native(source: Path, declarations: str, comm: MPI.Comm, *behind: Path) -> tuple[Any, Any]:
    """Return the cffi objects (ffi, lib) of a C file and of what is `behind` it, compiled on first
    use. Collective.

    Raises
    ------
    NoCompiler
        On all ranks, if there is no compiler.
    RuntimeError
        On all ranks, if the folder of the kernels cannot be written.
    """
    texts = (
        f'#line 1 "{each.name}"\n{each.read_text(encoding="utf-8")}\n' for each in (source, *behind)
    )
    text = PRELUDE + "".join(texts)
    library = Library(text, lambda: text, OPTIONS, GNU_OPTIONS)
    raised_by_all(comm, library.path)
    ffi = cffi.FFI()
    ffi.cdef(declarations)
    return ffi, ffi.dlopen(str(library.path()))
