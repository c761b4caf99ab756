"""Compilation: forms by FFCx, functions at points by ours, and the time that both take.

Kernels are begun where they are declared, and compiled side by side when the first of them is asked
for: then it is known how many there are, and the largest, on which the others would wait at the
end, are compiled first.

Two scenes that differ only in numbers have the same forms. A process compiles each form once and
keeps it under the signature of the form that it is derived from: for the next scene UFL neither
differentiates nor signs the derivative.
"""

import ctypes
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from math import prod
from typing import Any

import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.algorithms.analysis import has_type
from ufl.variable import Label

from magshell_fenicsx.platform import compat
from magshell_fenicsx.platform.compiler import RENEWED, Library, side_by_side
from magshell_fenicsx.platform.processes import raised_by_all, world

# -O1 compiles the tangents five times faster than -O2 and runs 15 % slower; -ffast-math halves the
# run time. No -march: the cache may be shared by unlike machines, and it gains nothing here.
# -fno-strict-overflow, as Python's own modules have it: without, sums are rounded otherwise.
FORM_OPTIONS = (
    "-fno-strict-overflow",
    "-std=c17",
    "-O1",
    "-g0",
    "-ffast-math",
    f"-I{compat.form_include()}",
)
SILENT_SECONDS = 1.0  # of compilation that nobody need be told of
REPEAT_SECONDS = 30.0  # between two lines on standard error

Key = tuple[str, str, int]


@dataclass(frozen=True)
class _Shared:
    """A compiled form apart from its mesh: the places of its fields and numbers among those of what
    it is made from.
    """

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
        What is made of it: with the signature of `of` and the place of `u` this determines the
        form.
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
        given = [fields[i] for i in shared.fields], [numbers[i] for i in shared.numbers]
        return _bound(self.of, shared.kernels, spaces, *given)

    def shared(self, made: ufl.Form, kernels: compat.Kernels) -> _Shared | None:
        """What is kept of the compiled form; None if it has other fields or numbers, or labels,
        which no other has.
        """
        if has_type(self.of, Label):
            return None
        fields = [
            _place(each, self.of.coefficients()) for each in kernels.in_order(made.coefficients())
        ]
        numbers = [_place(each, self.numbers) for each in made.constants()]
        if None in fields or None in numbers:
            return None
        return _Shared(kernels, fields, numbers, len(made.arguments()))  # type: ignore[arg-type]


def _place(one: Any, among: Iterable[Any]) -> int | None:
    return next((i for i, each in enumerate(among) if each is one), None)


def _bound(
    of: ufl.Form,
    kernels: compat.Kernels,
    spaces: Sequence[fem.FunctionSpace],
    fields: Sequence[fem.Function],
    numbers: Sequence[fem.Constant],
) -> fem.Form:
    """The kernels on the mesh of a form, and on the parts of it that this is over."""
    domain = _domain_of(of)
    of_mesh = of.subdomain_data()[domain]
    assert all(tags is data[0] for data in of_mesh.values() for tags in data)  # as dolfinx asks
    marks = {kind: data[0] for kind, data in of_mesh.items()}
    return compat.bound(kernels, spaces, fields, numbers, marks, domain.ufl_cargo())


def _domain_of(form: ufl.Form) -> ufl.Mesh:
    """Return the mesh that a form is integrated over."""
    (domain,) = form.subdomain_data()
    return domain


def itself(form: ufl.Form) -> Derived:
    """A form as it is."""
    return Derived(form, "", lambda: form)


def _entries(form: ufl.Form) -> int:
    """The size of the element tensor of a form, for a rough order of the times that kernels take to
    compile.
    """
    layouts = [each.ufl_function_space().dofmap for each in form.arguments()]
    sides = 1 + any(integral.integral_type() == "interior_facet" for integral in form.integrals())
    return int(prod(sides * layout.bs * layout.dof_layout.num_dofs for layout in layouts))


def _print_to_stderr() -> Callable[[str], None]:
    """Return a function that prints a line on rank 0, unless it has printed one in the last
    `REPEAT_SECONDS`.
    """
    last = -REPEAT_SECONDS

    def tell(line: str) -> None:
        nonlocal last
        if world().rank == 0 and time.perf_counter() - last >= REPEAT_SECONDS:
            last = time.perf_counter()
            print(line, file=sys.stderr, flush=True)

    return tell


@dataclass
class Status:
    """Progress of compilation: how many kernels of how many."""

    tell: Callable[[str], None] = field(default_factory=_print_to_stderr)
    done: int = 0
    known: int = 0

    def compile(self, libraries: Sequence[Library]) -> None:
        """Compile libraries side by side; see there."""
        if not libraries:
            return
        begin = time.perf_counter()
        last = 0, begin + SILENT_SECONDS - RENEWED
        self.known += len(libraries)

        def tell_progress(there: int) -> None:
            nonlocal last
            now, (before, then) = time.perf_counter(), last
            if now - begin >= SILENT_SECONDS and (there != before or now - then >= RENEWED):
                last = there, now
                self.tell(f"compiling kernels (once) {self.done + there} of {self.known}")

        side_by_side(libraries, tell_progress)
        self.done += len(libraries)


_status = Status()


@contextmanager
def reported(tell: Callable[[str], None]) -> Iterator[None]:
    """Tell a function how many kernels are compiled of how many, within `with`."""
    global _status
    before, _status = _status, Status(tell)
    try:
        yield
    finally:
        _status = before


@dataclass(frozen=True)
class _RequestedLibrary:
    """A library that is asked for, and how many numbers its function gives."""

    library: Library
    size: int


@dataclass
class KernelLog:
    """Names of the kernels of a problem and the seconds spent on compiling or loading them."""

    names: list[str] = field(default_factory=list)
    seconds: float = 0.0
    _begun: dict[str, _RequestedLibrary] = field(default_factory=dict)

    def compile(self, name: str, expression: ufl.Form) -> fem.Form:
        """A compiled form; collective."""
        return self.derived(name, itself(expression))

    def derived(self, name: str, form: Derived) -> fem.Form:
        """A compiled form; collective."""
        (compiled,) = self._compiled_together({name: form})
        return compiled

    def compile_all(self, named: Iterable[Mapping[str, ufl.Form]]) -> dict[str, fem.Form]:
        """Compiled forms under their names; collective."""
        forms = {name: form for each in named for name, form in each.items()}
        compiled = self._compiled_together({name: itself(form) for name, form in forms.items()})
        return dict(zip(forms, compiled, strict=True))

    def _compiled_together(self, named: Mapping[str, Derived]) -> list[fem.Form]:
        begun = [self.begin(name, form) for name, form in named.items()]
        given = [
            form.of
            for form in named.values()
            if isinstance(form.of, ufl.Form) and not form.of.empty()
        ]
        if given:
            self.finish(_domain_of(given[0]).ufl_cargo().comm)
        return [compiled() for compiled in begun]

    def begin(self, name: str, form: Derived) -> Callable[[], fem.Form]:
        """Return a function that gives the compiled form: from this process, from the cache or from
        the compiler.
        """
        start, key = time.perf_counter(), form.key
        try:
            if key in _compiled_forms:
                known = form.bound(_compiled_forms[key])
                return lambda: known
            made = form.make()
            if not isinstance(made, ufl.Form) or made.empty():
                return lambda: None if isinstance(made, ufl.Form) else made
            of_form = (
                compat.form_signature(made),
                partial(compat.form_code, made),
                FORM_OPTIONS,
                _entries(made),
            )
            library = self._library(*of_form)
            return cache(lambda: self._form(form, made, library()))
        finally:
            self._note(name, start)

    def _form(self, form: Derived, made: ufl.Form, library: ctypes.CDLL) -> fem.Form:
        kernels, key = compat.Kernels.of(made, library), form.key
        if key and (shared := form.shared(made, kernels)):
            _compiled_forms[key] = shared
        spaces = [each.ufl_function_space() for each in made.arguments()]
        return _bound(
            made, kernels, spaces, kernels.in_order(made.coefficients()), made.constants()
        )

    def load(
        self, name: str, key: str, source: Callable[[], str], options: tuple[str, ...], size: int
    ) -> Callable[[], ctypes.CDLL]:
        """Return a function that gives a library, whose function gives `size` numbers.

        See `Library`.
        """
        start = time.perf_counter()
        library = self._library(key, source, options, size)
        self._note(name, start)
        return library

    def _library(
        self, key: str, source: Callable[[], str], options: tuple[str, ...], size: int
    ) -> Callable[[], ctypes.CDLL]:
        library = Library(key, source, options)
        begun = self._begun.setdefault(library.file, _RequestedLibrary(library, size))

        @cache
        def loaded() -> ctypes.CDLL:
            if library.file in self._begun:
                self._finish()
            return ctypes.CDLL(str(begun.library.path()))

        return loaded

    def finish(self, comm: MPI.Comm) -> None:
        """Compile what was begun; collective.

        Raises
        ------
        RuntimeError
            On all ranks, if one of them cannot write the folder of the kernels.
        CalledProcessError
            On all ranks, if a compiler fails.
        """
        raised_by_all(comm, self._finish)

    def _finish(self) -> None:
        start, begun = (
            time.perf_counter(),
            sorted(self._begun.values(), key=lambda each: -each.size),
        )
        self._begun.clear()
        _status.compile([each.library for each in begun if not each.library.there])
        self.seconds += time.perf_counter() - start

    def _note(self, name: str, start: float) -> None:
        self.seconds += time.perf_counter() - start
        self.names.append(name)
