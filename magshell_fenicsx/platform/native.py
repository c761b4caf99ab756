"""The package's C code, compiled once into the folder of the kernels."""

import hashlib
import importlib.util
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cffi
from mpi4py import MPI

from magshell_fenicsx.platform.compiler import c_compiler, for_extensions, is_gnu
from magshell_fenicsx.platform.kept import kept_file, kernel_cache
from magshell_fenicsx.platform.processes import from_first

OPTIONS = ["-O3", "-g0"]
GNU_OPTIONS = ["-fschedule-insns", "-fsched-pressure"]  # of GCC alone: sums over pairs are a sixth faster
PRELUDE = """#include <stdint.h>
#if defined(__x86_64__) && defined(__GNUC__) && !defined(__clang__)
#define FAST __attribute__((target_clones("arch=x86-64-v4", "arch=x86-64-v3", "default")))
#else
#define FAST
#endif
#define INLINE static inline __attribute__((always_inline))
"""  # of each file: FAST functions are compiled for several processors


def native(source: Path, declarations: str, comm: MPI.Comm, *behind: Path) -> tuple[Any, Any]:
    """The cffi objects (ffi, lib) of a C file, and what is `behind` it, compiled by rank 0 on first use. Collective.

    Raises
    ------
    RuntimeError
        On all ranks, if it cannot be compiled; `NoCompiler` if nothing could be.
    """
    text = PRELUDE + "".join(each.read_text(encoding="utf-8") for each in (source, *behind))
    key = hashlib.sha256(
        repr((text, declarations, [*OPTIONS, *GNU_OPTIONS], sys.version, cffi.__version__)).encode()
    ).hexdigest()[:16]
    name, folder = f"magshell_{source.stem}_{key}", kernel_cache()

    def compiled() -> Path:
        if kept := kept_file(f"{name}.so"):
            return kept
        try:
            with for_extensions():
                _compile(name, folder, text, declarations)
        except (OSError, cffi.VerificationError) as e:
            raise RuntimeError(f"{source.name} cannot be compiled into {folder}: {e}") from None
        return folder / f"{name}.so"

    library = from_first(comm, compiled)
    spec = importlib.util.spec_from_file_location(name, library)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.ffi, module.lib


def _compile(name: str, folder: Path, text: str, declarations: str) -> None:
    """Compile NAME.so into a folder, atomically even if other processes do the same."""
    folder.mkdir(parents=True, exist_ok=True)
    builder = cffi.FFI()
    builder.cdef(declarations)
    options = [*OPTIONS, *(GNU_OPTIONS if is_gnu(c_compiler()) else ())]
    builder.set_source(name, text, extra_compile_args=options)
    with TemporaryDirectory(dir=folder) as scratch:
        made = Path(builder.compile(tmpdir=scratch))
        made.chmod(0o755)  # whatever the umask: what others may write is not trusted
        made.replace(folder / f"{name}.so")
