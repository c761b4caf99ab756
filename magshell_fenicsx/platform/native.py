"""The package's own C code, compiled once into the folder of the kernels.

cffi calls functions of a C library: `ffi` knows their declarations, and `lib` has the functions.
"""

from pathlib import Path
from typing import Any

import cffi
from mpi4py import MPI

from magshell_fenicsx.platform.compiler import Library
from magshell_fenicsx.platform.processes import raise_on_all_ranks

OPTIONS = ("-O3", "-g0", "-DNDEBUG", "-fno-strict-overflow", "-std=gnu17")
# For GCC alone: sums over pairs are a sixth faster.
GNU_OPTIONS = ("-fschedule-insns", "-fsched-pressure")

# The begin of each file: FAST functions are compiled for several processors.
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
"""


def load_native(
    source: Path, declarations: str, comm: MPI.Comm, *further_sources: Path
) -> tuple[Any, Any]:
    """Return the cffi objects (ffi, lib) of C files, compiled on first use. Collective.

    Parameters
    ----------
    source
        The first C file.
    declarations
        Declarations of the files' functions, for cffi.
    further_sources
        Files that are compiled together with the first one, after it.

    Raises
    ------
    NoCompiler
        On all ranks, if there is no compiler.
    RuntimeError
        On all ranks, if the folder of the kernels cannot be written.
    """
    text = PRELUDE
    for file in (source, *further_sources):
        text += f'#line 1 "{file.name}"\n{file.read_text(encoding="utf-8")}\n'
    library = Library(text, lambda: text, OPTIONS, GNU_OPTIONS)
    raise_on_all_ranks(comm, library.path)  # compiles it
    ffi = cffi.FFI()
    ffi.cdef(declarations)
    return ffi, ffi.dlopen(str(library.path()))
