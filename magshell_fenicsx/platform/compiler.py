"""FFCx's kernels as plain shared libraries: without the headers of Python, each compiles 0.2 s sooner.

Only kernels with `SHARED` among the compiler's arguments are concerned: other programs may share the cache.
"""

import ctypes
import os
import re
import shlex
import subprocess
import sys
import sysconfig
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cffi
from ffcx.codegeneration import get_include_path, jit

from magshell_fenicsx.platform import compat
from magshell_fenicsx.platform.kept import kept_file, trusted
from magshell_fenicsx.platform.many import declared, with_many

SHARED, MANY = "-shared", "-DMANY"
FULL = re.compile("No space left on device|Disk quota exceeded|File too large|Read-only file system")
WAIT = 0.05  # s between two looks for what another process compiles
DECLARATIONS = (
    jit.UFC_HEADER_DECL.format("float64") + jit.UFC_INTEGRAL_DECL + jit.UFC_FORM_DECL + jit.UFC_EXPRESSION_DECL
)
OTHERS = jit._compile_objects, jit._load_objects, jit.get_cached_module
_loaded: dict[Path, tuple[list[Any], Any]] = {}
_many: dict[int, Any] = {}  # functions by the places of their kernels in memory


def _compile_objects(
    decl: str,
    objects: Any,
    names: list[str],
    module: str,
    options: dict[str, Any],
    folder: Path,
    arguments: list[str],
    *rest: Any,
    **others: Any,
) -> Any:
    if SHARED not in arguments:
        return OTHERS[0](decl, objects, names, module, options, folder, arguments, *rest, **others)
    code = compat.kernel_code(objects, module, options)
    source = folder / f"{module}.c"
    with written_into(folder):
        source.write_text(with_many(code) if MANY in arguments else code)
    compiler = shlex.split(os.environ.get("CC") or sysconfig.get_config_var("CC") or "cc")
    include = f"-I{get_include_path()}"
    library = str(source.with_suffix(".so"))
    command = [*compiler, "-std=c17", "-fPIC", *arguments, include, str(source), "-o", library, "-lm"]
    with written_into(folder):
        done = subprocess.run(command, stderr=subprocess.PIPE, text=True, errors="replace", check=False)
        print(done.stderr, end="", file=sys.stderr)
        if done.returncode and (full := FULL.search(done.stderr)):  # of its own, or of the folder for temporary files
            raise OSError(0, full[0])
        done.check_returncode()
        Path(library).chmod(0o755)  # whatever the umask: what others may write is not trusted
        source.with_suffix(".c.cached").touch(mode=0o644)
    return code


@contextmanager
def written_into(folder: Path) -> Iterator[None]:
    """Turn an error of the disk into one that names the cache; dolfinx passes on only its words on several ranks."""
    try:
        yield
    except OSError as e:
        raise RuntimeError(f"kernels cannot be compiled into {folder}: {e.strerror}") from None


def _load_objects(folder: Path, module: str, names: list[str]) -> tuple[list[Any], Any]:
    library = Path(folder) / f"{module}.so"
    if not library.exists():
        found: tuple[list[Any], Any] = OTHERS[1](folder, module, names)
        return found
    if library not in _loaded:
        kind = "ufcx_form *" if module.startswith("libffcx_forms") else "ufcx_expression *"
        lib, ffi = ctypes.CDLL(str(library)), _ffi()
        places = [ctypes.addressof(ctypes.c_char.in_dll(lib, name)) for name in names]  # cffi would parse declarations
        objects = [ffi.cast(kind, place)[0] for place in places]
        _loaded[library] = objects, SimpleNamespace(ffi=ffi, lib=lib)
        if (many := declared(lib)) is not None:
            _many[_place(objects[0])] = many
    return _loaded[library]


def many_of(expression: Any) -> Any:
    """The function `evaluate_many` of a loaded expression of FFCx; None if it has none."""
    return _many.get(_place(expression))


def _place(expression: Any) -> int:
    return int(_ffi().cast("uintptr_t", expression.tabulate_tensor_float64))


@cache
def _ffi() -> cffi.FFI:
    found = cffi.FFI()
    # of complex numbers only pointers occur; for them themselves cffi would need a compiler
    found.cdef(DECLARATIONS.replace("_Complex", ""))
    return found


def _get_cached_module(module: str, names: list[str], folder: Path, timeout: int) -> tuple[Any, Any]:
    if (there := kept_file(f"{module}.so")) and there.with_suffix(".c.cached").exists():
        return _load_objects(there.parent, module, names)
    source, end = Path(folder) / f"{module}.c", time.monotonic() + timeout
    with written_into(folder):
        source.parent.mkdir(exist_ok=True, parents=True)
        _discard_strange(source)
    while True:
        with written_into(folder), suppress(FileExistsError):
            # who makes the file compiles it; FFCx would load as its own what appears meanwhile
            os.close(os.open(source, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644))
            return None, None
        while not source.with_suffix(".c.cached").exists() and source.exists() and time.monotonic() < end:
            time.sleep(WAIT)
        if source.with_suffix(".so").exists() and source.with_suffix(".c.cached").exists():
            return _load_objects(folder, module, names)
        if source.exists() or time.monotonic() >= end:
            return OTHERS[2](module, names, folder, timeout)  # type: ignore[no-any-return]


def _discard_strange(source: Path) -> None:
    """Remove a kernel that another user has put here, or may have changed: it is compiled again."""
    there = list(source.parent.glob(f"{source.stem}*"))
    if not all(map(trusted, there)):
        for file in there:
            file.unlink(missing_ok=True)


def install_compiler() -> None:
    """Take the place of FFCx's own functions."""
    jit._compile_objects, jit._load_objects, jit.get_cached_module = _compile_objects, _load_objects, _get_cached_module
