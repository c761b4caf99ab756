"""Compilation of UFL forms: the options of the just-in-time compiler, and the time."""

import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from ffcx.ir.analysis.valuenumbering import ValueNumberer
from mpi4py import MPI
from ufl.core.expr import Expr

from magshell_fenicsx.platform.compiler import MANY, SHARED, install_compiler
from magshell_fenicsx.platform.index_maps import install_index_maps
from magshell_fenicsx.platform.kept import kernel_cache

# -O1 compiles the tangents five times faster than -O2 and runs 15 % slower; -ffast-math halves the run time.
# No -march: the cache may be shared by unlike machines, and it gains nothing here.
JIT_OPTIONS: dict[str, Any] = {"cffi_extra_compile_args": ["-O1", "-g0", "-ffast-math", SHARED], "timeout": 600}
POINT_OPTIONS = {**JIT_OPTIONS, "cffi_extra_compile_args": [*JIT_OPTIONS["cffi_extra_compile_args"], MANY]}
install_compiler()
install_index_maps()


def _node_symbols(numberer: ValueNumberer, node: Expr) -> list[int]:
    """The symbols of a node, found by the dictionary of its graph."""
    found: list[int] = numberer.V_symbols[numberer.G.e2i[node]]
    return found


# FFCx compares the node with all others, so that large forms take quadratic time: a sixth of all compilation.
ValueNumberer.get_node_symbols = _node_symbols


@dataclass
class KernelLog:
    """Names of the kernels of a problem and the seconds spent on compiling or loading them."""

    names: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def compile(self, name: str, expression: ufl.Form) -> fem.Form:
        """Compile a form, or load it from the cache."""
        start = time.perf_counter()
        form = fem.form(expression, jit_options={**JIT_OPTIONS, "cache_dir": kernel_cache()})
        self.seconds += time.perf_counter() - start
        self.names.append(name)
        return form

    def compile_all(self, named: Iterable[Mapping[str, ufl.Form]]) -> dict[str, fem.Form]:
        """Compile forms under their names."""
        return {name: self.compile(name, form) for each in named for name, form in each.items()}

    def compile_expression(self, name: str, expression: Expr, comm: MPI.Comm) -> fem.Expression:
        """Compile an expression of cell-wise constants, or load it from the cache; collective."""
        start = time.perf_counter()
        anywhere, options = np.full((1, 1), 0.5), {**POINT_OPTIONS, "cache_dir": kernel_cache()}
        compiled = fem.Expression(expression, anywhere, comm, jit_options=options)
        self.seconds += time.perf_counter() - start
        self.names.append(name)
        return compiled
