"""Compilation of kernels: forms by FFCx, functions at points by ours, and the time that both take.

Kernels are requested where they are declared, and compiled in parallel when the first of them is
needed: then it is known how many there are, and the largest, on which the others would wait at the
end, are compiled first.

Two scenes that differ only in numbers have the same forms. A process compiles each form once and
keeps it under the signature of the form that it is derived from: for the next scene UFL neither
differentiates nor signs the derivative.

A form is an integral in UFL; its arguments are test and trial functions, its fields and constants
the data. It is bound to a mesh when it gets the data. A form derived from another, the origin, is
known by the origin's signature, so that it need not be built to be found.
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
from magshell_fenicsx.platform.compiler import PROGRESS_SECONDS, Library, compile_libraries
from magshell_fenicsx.platform.processes import raise_on_all_ranks, world

# -O1 compiles the tangents five times faster than -O2 and runs 15 % slower; -ffast-math halves the
# run time. No -march: the cache may be shared by unlike machines, and it gains nothing here.
# -fno-strict-overflow, as Python's own modules have it: without, sums are rounded otherwise.
FORM_OPTIONS = (
    "-fno-strict-overflow",
    "-std=c17",
    "-O1",
    "-g0",
    "-ffast-math",
    f"-I{compat.form_include_folder()}",
)
SILENT_SECONDS = 1.0  # of compilation without a message
REPEAT_SECONDS = 30.0  # between two lines on standard error

FormKey = tuple[str, str, int]


@dataclass(frozen=True)
class _MeshlessForm:
    """A compiled form apart from its mesh, for all forms with the same key.

    Attributes
    ----------
    kernels
        The compiled kernels.
    fields, constants
        Positions of the kernels' fields and constants among those of the form's origin.
    rank
        Number of the form's arguments.
    """

    kernels: compat.FormKernels
    fields: list[int]
    constants: list[int]
    rank: int


_compiled_forms: dict[FormKey, _MeshlessForm] = {}  # of this process


@dataclass(frozen=True)
class DerivedForm:
    """A UFL form that is derived from another one, its origin.

    Attributes
    ----------
    origin
        The form from which this one is derived.
    derivation
        Says how: with the signature of the origin and the position of `u` it determines the form.
    make
        Returns the derived form.
    u
        The field by which the origin is differentiated, whose space the arguments of the form have;
        None for the origin itself.
    factor
        A constant that the origin does not have; empty without one.
    """

    origin: ufl.Form
    derivation: str
    make: Callable[[], ufl.Form]
    u: fem.Function | None = None
    factor: tuple[fem.Constant, ...] = ()

    @property
    def key(self) -> FormKey | None:
        """Key under which the compiled form is kept: signature, derivation and position of `u`.

        It is None if the form cannot be kept: it is empty, has several meshes, or does not depend
        on `u`.
        """
        origin = self.origin
        if not isinstance(origin, ufl.Form) or origin.empty():
            return None
        if len(origin.ufl_domains()) != 1:
            return None
        if self.u is None:
            return origin.signature(), self.derivation, -1  # no position
        position = _position(self.u, origin.coefficients())
        return None if position is None else (origin.signature(), self.derivation, position)

    @property
    def constants(self) -> list[fem.Constant]:
        """Constants of the origin, and the factor."""
        return [*self.origin.constants(), *self.factor]

    def bind(self, meshless: _MeshlessForm) -> fem.Form:
        """Return a compiled form on the mesh of this one, with its fields and constants.

        Parameters
        ----------
        meshless
            A compiled form with the same key.
        """
        fields, constants = self.origin.coefficients(), self.constants
        # spaces of the arguments: the origin's own, or for a derivative that of `u`
        if self.u is None:
            spaces = [argument.ufl_function_space() for argument in self.origin.arguments()]
        else:
            spaces = [self.u.function_space] * meshless.rank
        return _bind(
            self.origin,
            meshless.kernels,
            spaces,
            [fields[i] for i in meshless.fields],
            [constants[i] for i in meshless.constants],
        )

    def without_mesh(self, form: ufl.Form, kernels: compat.FormKernels) -> _MeshlessForm | None:
        """Return the compiled form apart from its mesh, to serve other forms with the same key.

        Parameters
        ----------
        form, kernels
            The form as `make` returned it, and its compiled kernels.

        Returns
        -------
        The form; None if it has fields or constants that its origin does not have, or labels, which
        no other form has.
        """
        if has_type(self.origin, Label):
            return None
        # positions of the kernels' data among those of the origin
        origin_fields, origin_constants = self.origin.coefficients(), self.constants
        ordered_fields = kernels.order_fields(form.coefficients())
        fields = [_position(f, origin_fields) for f in ordered_fields]
        constants = [_position(c, origin_constants) for c in form.constants()]
        if None in fields or None in constants:
            return None
        rank = len(form.arguments())
        return _MeshlessForm(kernels, fields, constants, rank)  # type: ignore[arg-type]


def _position(item: Any, items: Iterable[Any]) -> int | None:
    """Return the position of an object among others; None if it is not among them."""
    return next((i for i, candidate in enumerate(items) if candidate is item), None)


def _bind(
    form: ufl.Form,
    kernels: compat.FormKernels,
    spaces: Sequence[fem.FunctionSpace],
    fields: Sequence[fem.Function],
    constants: Sequence[fem.Constant],
) -> fem.Form:
    """Return the compiled form of kernels on the mesh and the subdomains of a form.

    Parameters
    ----------
    spaces
        The spaces of its arguments.
    fields, constants
        The data of the kernels, in their order.
    """
    domain = _domain_of(form)
    subdomain_data = form.subdomain_data()[domain]
    # dolfinx demands that integrals of a kind share their tags.
    assert all(
        tags is tags_of_integrals[0]
        for tags_of_integrals in subdomain_data.values()
        for tags in tags_of_integrals
    )
    tags = {kind: tags_of_integrals[0] for kind, tags_of_integrals in subdomain_data.items()}
    return compat.bind_form(kernels, spaces, fields, constants, tags, domain.ufl_cargo())


def _domain_of(form: ufl.Form) -> ufl.Mesh:
    """Return the mesh that a form is integrated over."""
    (domain,) = form.subdomain_data()
    return domain


def underived(form: ufl.Form) -> DerivedForm:
    """Return a form as its own origin."""
    return DerivedForm(form, "", lambda: form)


def _tensor_size(form: ufl.Form) -> int:
    """Return the size of the element tensor of a form, by which compilations are ordered."""
    dofmaps = [argument.ufl_function_space().dofmap for argument in form.arguments()]
    sides = 1 + any(integral.integral_type() == "interior_facet" for integral in form.integrals())
    return int(prod(sides * dofmap.bs * dofmap.dof_layout.num_dofs for dofmap in dofmaps))


def _print_to_stderr() -> Callable[[str], None]:
    """Return a function that prints a line to standard error on rank 0.

    The function drops a line that comes less than `REPEAT_SECONDS` after the last one.
    """
    last = -REPEAT_SECONDS  # time of the last line: the first one is printed at once

    def tell(line: str) -> None:
        nonlocal last
        if world().rank == 0 and time.perf_counter() - last >= REPEAT_SECONDS:
            last = time.perf_counter()
            print(line, file=sys.stderr, flush=True)

    return tell


@dataclass
class Status:
    """Progress of compilation.

    Attributes
    ----------
    tell
        Receives messages, as a rule one line each.
    compiled, requested
        Numbers of libraries in all calls so far.
    """

    tell: Callable[[str], None] = field(default_factory=_print_to_stderr)
    compiled: int = 0
    requested: int = 0

    def compile(self, libraries: Sequence[Library]) -> None:
        """Compile libraries in parallel, and report how many are ready if this takes long."""
        if not libraries:
            return
        begin = time.perf_counter()
        # the first report comes after `SILENT_SECONDS`, whatever the count
        last_count, last_time = 0, begin + SILENT_SECONDS - PROGRESS_SECONDS
        self.requested += len(libraries)

        def tell_progress(count: int) -> None:
            """Report that `count` libraries of this call are ready, if that is new or long ago."""
            nonlocal last_count, last_time
            time_now = time.perf_counter()
            if time_now - begin < SILENT_SECONDS:
                return
            if count != last_count or time_now - last_time >= PROGRESS_SECONDS:
                last_count, last_time = count, time_now
                self.tell(f"compiling kernels (once) {self.compiled + count} of {self.requested}")

        compile_libraries(libraries, tell_progress)
        self.compiled += len(libraries)


_status = Status()


@contextmanager
def reporting_progress_to(tell: Callable[[str], None]) -> Iterator[None]:
    """Report the progress of compilation to a function, within `with`.

    Parameters
    ----------
    tell
        Receives messages on how many kernels are compiled of how many.
    """
    global _status
    previous, _status = _status, Status(tell)
    try:
        yield
    finally:
        _status = previous


@dataclass(frozen=True)
class _RequestedLibrary:
    """A library that is requested.

    Attributes
    ----------
    size
        How many numbers its function returns: the largest is compiled first.
    """

    library: Library
    size: int


@dataclass
class KernelLog:
    """Requests of the kernels of a problem, and the time spent on them.

    Attributes
    ----------
    names
        Names of all requested kernels.
    seconds
        Time spent on compiling or loading them.

    The private field `_requested` has the libraries to compile next, by the name of their file.
    """

    names: list[str] = field(default_factory=list)
    seconds: float = 0.0
    _requested: dict[str, _RequestedLibrary] = field(default_factory=dict)

    def compile(self, name: str, expression: ufl.Form) -> fem.Form:
        """Return a form compiled under a name. Collective."""
        return self.compile_derived(name, underived(expression))

    def compile_derived(self, name: str, form: DerivedForm) -> fem.Form:
        """Return a form that is derived from another one, compiled under a name. Collective."""
        (compiled,) = self._compile_together({name: form})
        return compiled

    def compile_all(self, groups: Iterable[Mapping[str, ufl.Form]]) -> dict[str, fem.Form]:
        """Return compiled forms by name, all compiled in parallel. Collective.

        Parameters
        ----------
        groups
            Mappings from the name of each form to the form.
        """
        forms = {name: form for group in groups for name, form in group.items()}
        # each form is its own origin
        compiled = self._compile_together({name: underived(form) for name, form in forms.items()})
        return dict(zip(forms, compiled, strict=True))

    def _compile_together(self, forms: Mapping[str, DerivedForm]) -> list[fem.Form]:
        """Return compiled forms, in the order of their names, all compiled in parallel.

        Collective over the mesh of the forms.
        """
        requests = [self.request_form(name, form) for name, form in forms.items()]
        origins = [form.origin for form in forms.values()]
        # forms that are not empty: an empty form has no mesh, and so no communicator
        integrals = [form for form in origins if isinstance(form, ufl.Form) and not form.empty()]
        if integrals:
            self.compile_requested(_domain_of(integrals[0]).ufl_cargo().comm)
        return [request() for request in requests]

    def request_form(self, name: str, form: DerivedForm) -> Callable[[], fem.Form]:
        """Request a compiled form, which comes from this process, the cache or the compiler.

        Returns
        -------
        A function that returns the compiled form, which is None for an empty form. Its first call
        compiles all requested kernels.
        """
        start, key = time.perf_counter(), form.key
        try:
            # the derived form is not even made if this process has it
            if key in _compiled_forms:
                compiled = form.bind(_compiled_forms[key])
                return lambda: compiled
            ufl_form = form.make()
            if not isinstance(ufl_form, ufl.Form):  # UFL has simplified it to a number
                return lambda: ufl_form
            if ufl_form.empty():
                return lambda: None
            library = self._request_library(
                key=compat.form_signature(ufl_form),
                source=partial(compat.form_code, ufl_form),
                options=FORM_OPTIONS,
                size=_tensor_size(ufl_form),
            )
            # loaded at the first call, when all requests are compiled together
            return cache(lambda: self._load_form(form, ufl_form, library()))
        finally:
            self._note(name, start)

    def _load_form(self, form: DerivedForm, ufl_form: ufl.Form, library: ctypes.CDLL) -> fem.Form:
        """Return a compiled form from its library; keep it for other forms with the same key.

        `form` says how it is derived, `ufl_form` is the derived form.
        """
        kernels, key = compat.FormKernels.from_library(ufl_form, library), form.key
        if key and (meshless := form.without_mesh(ufl_form, kernels)):
            _compiled_forms[key] = meshless
        spaces = [argument.ufl_function_space() for argument in ufl_form.arguments()]
        fields = kernels.order_fields(ufl_form.coefficients())
        return _bind(ufl_form, kernels, spaces, fields, ufl_form.constants())

    def request_library(
        self, name: str, key: str, source: Callable[[], str], options: tuple[str, ...], size: int
    ) -> Callable[[], ctypes.CDLL]:
        """Request a library with a C function.

        Parameters
        ----------
        name
            Name of the kernel in the log.
        key
            Determines the source and the options: libraries with one key are one.
        source
            Returns the C source.
        options
            Options of the compiler.
        size
            How many numbers the function returns.

        Returns
        -------
        Callable
            Returns the library. Its first call compiles all requested kernels.
        """
        start = time.perf_counter()
        library = self._request_library(key, source, options, size)
        self._note(name, start)
        return library

    def _request_library(
        self, key: str, source: Callable[[], str], options: tuple[str, ...], size: int
    ) -> Callable[[], ctypes.CDLL]:
        """Request a library with a C function, without a note in the log.

        Two requests with one key share the library.

        Parameters
        ----------
        key
            Determines the source and the options.
        source, options
            Returns the C source; options of the compiler.
        size
            How many numbers the function returns.

        Returns
        -------
        A function that returns the library. Its first call compiles all requested kernels.
        """
        library = Library(key, source, options)
        request = self._requested.setdefault(library.file, _RequestedLibrary(library, size))

        @cache
        def loaded() -> ctypes.CDLL:
            """Return the library; compile all requested ones if it is among them."""
            if library.file in self._requested:
                self._compile_requested()
            return ctypes.CDLL(str(request.library.path()))

        return loaded

    def compile_requested(self, comm: MPI.Comm) -> None:
        """Compile all libraries that were requested. Collective.

        Raises
        ------
        RuntimeError
            On all ranks, if one of them cannot write the folder of the kernels.
        CalledProcessError
            On all ranks, if a compiler fails.
        """
        raise_on_all_ranks(comm, self._compile_requested)

    def _compile_requested(self) -> None:
        """Compile all libraries that were requested, the largest first; on this rank alone."""
        start = time.perf_counter()
        largest_first = sorted(self._requested.values(), key=lambda request: -request.size)
        libraries = [request.library for request in largest_first]
        self._requested.clear()
        _status.compile([library for library in libraries if not library.is_compiled])
        self.seconds += time.perf_counter() - start

    def _note(self, name: str, start: float) -> None:
        """Note the name of a kernel, and the seconds since `start`."""
        self.seconds += time.perf_counter() - start
        self.names.append(name)
