"""Compilation: forms by dolfinx, functions at points by ours, and the time that both take.

Two scenes that differ only in numbers have the same forms. A process compiles each form once and keeps it under the
signature of the form that it is derived from: for the next scene UFL neither differentiates nor signs the derivative.
"""

import ctypes
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import cffi
import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.algorithms.analysis import has_type
from ufl.variable import Label

from magshell_fenicsx.platform import compat
from magshell_fenicsx.platform.compiler import check_room, for_extensions, library
from magshell_fenicsx.platform.kept import compiling, kernel_cache
from magshell_fenicsx.platform.processes import from_first

# -O1 compiles the tangents five times faster than -O2 and runs 15 % slower; -ffast-math halves the run time.
# No -march: the cache may be shared by unlike machines, and it gains nothing here.
JIT_OPTIONS: dict[str, Any] = {"cffi_extra_compile_args": ["-O1", "-g0", "-ffast-math"], "timeout": 600}


Key = tuple[str, str, int]


@dataclass(frozen=True)
class _Shared:
    """A compiled form apart from its mesh: the places of its fields and numbers among those of what it is made from."""

    kernels: compat.Kernels
    fields: list[int]
    numbers: list[int]
    rank: int


_compiled_forms: dict[Key, _Shared] = {}


@dataclass(frozen=True)
class Derived:
    """A form that is made from another one.

    Attributes
    ----------
    of
        The other form.
    how
        What is made of it: with the signature of `of` and the place of `u` this determines the form.
    make
        Makes it.
    u
        The field that it is derived by, whose space its arguments have; None for `of` itself.
    factor
        A number that `of` has not.
    """

    of: ufl.Form
    how: str
    make: Callable[[], ufl.Form]
    u: fem.Function | None = None
    factor: tuple[fem.Constant, ...] = ()

    @property
    def key(self) -> Key | None:
        """None if it cannot be shared: it is empty, has several meshes, or does not depend on `u`."""
        if not isinstance(self.of, ufl.Form) or self.of.empty() or len(self.of.ufl_domains()) != 1:
            return None
        if self.u is None:
            return self.of.signature(), self.how, -1
        place = _place(self.u, self.of.coefficients())
        return None if place is None else (self.of.signature(), self.how, place)

    @property
    def numbers(self) -> list[fem.Constant]:
        return [*self.of.constants(), *self.factor]

    def bound(self, shared: _Shared) -> fem.Form:
        """The compiled form on the mesh, with the fields and numbers of this one."""
        fields, numbers = self.of.coefficients(), self.numbers
        spaces = [each.ufl_function_space() for each in self.of.arguments()]
        if self.u is not None:
            spaces = [self.u.function_space] * shared.rank
        of_mesh = self.of.subdomain_data()[self.of.ufl_domain()]
        assert all(tags is data[0] for data in of_mesh.values() for tags in data)  # as dolfinx asks
        return compat.bound(
            shared.kernels,
            spaces,
            [fields[i] for i in shared.fields],
            [numbers[i] for i in shared.numbers],
            {kind: data[0] for kind, data in of_mesh.items()},
            self.of.ufl_domain().ufl_cargo(),
        )

    def shared(self, made: ufl.Form, compiled: fem.Form) -> _Shared | None:
        """What is kept of the compiled form; None if it has other fields or numbers, or labels, which no other has."""
        if has_type(self.of, Label):
            return None
        kernels = compat.kernels_of(compiled)
        fields = [_place(each, self.of.coefficients()) for each in kernels.in_order(made.coefficients())]
        numbers = [_place(each, self.numbers) for each in made.constants()]
        if None in fields or None in numbers:
            return None
        return _Shared(kernels, fields, numbers, compiled.rank)  # type: ignore[arg-type]


def _place(one: Any, among: Iterable[Any]) -> int | None:
    return next((i for i, each in enumerate(among) if each is one), None)


@dataclass
class KernelLog:
    """Names of the kernels of a problem and the seconds spent on compiling or loading them."""

    names: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def compile(self, name: str, expression: ufl.Form) -> fem.Form:
        """Compile a form, or load it from the cache."""
        return self.derived(name, Derived(expression, "", lambda: expression))

    def derived(self, name: str, form: Derived) -> fem.Form:
        """Compile a form, or take what this process has compiled; collective."""
        key = form.key
        if key is None:
            return self._compiled(name, form.make())
        comm, start = form.of.ufl_domain().ufl_cargo().comm, time.perf_counter()
        if comm.allreduce(key in _compiled_forms, MPI.LAND):  # ranks may have compiled others alone
            bound = form.bound(_compiled_forms[key])
            self._note(name, start)
            return bound
        made = form.make()
        compiled = self._compiled(name, made)
        if isinstance(made, ufl.Form) and compiled is not None and (shared := form.shared(made, compiled)):
            _compiled_forms[key] = shared
        return compiled

    def _compiled(self, name: str, expression: ufl.Form) -> fem.Form:
        start, folder = time.perf_counter(), kernel_cache()
        try:
            with compiling(folder), for_extensions():
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
