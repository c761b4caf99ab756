"""Densities at many points at once: their values, gradients and Hessians.

A density is a function of a few vectors that vary between points. Its kernels do not depend on
mesh, degree or quadrature. The points are represented as cells of an interval, and the vectors as
functions that are constant in each. A kernel is a function in C of operations on scalars
(`scalars`), for many points in one call and four points at once.
"""

import ctypes
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations_with_replacement
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI
from numpy.typing import NDArray
from ufl.algorithms.signature import compute_expression_signature
from ufl.classes import Label
from ufl.core.expr import Expr
from ufl.domain import extract_domains

from magshell_fenicsx.assembly import scalars
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.scalars import Scalars, flat, terminals_of
from magshell_fenicsx.platform.compiler import processor_options
from magshell_fenicsx.platform.kept import keep, recall

Pair = tuple[int, int]
Array = NDArray[np.float64]
COMPILED: TypeAlias = Callable[
    [int, int, int, int, int], None
]  # addresses but for the fourth: number of points


class Points:
    """Storage for a number of points, on this rank."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._mesh = mesh.create_interval(MPI.COMM_SELF, capacity, (0.0, 1.0))
        self._values = np.empty(0)
        self._constants: list[tuple[Array, Array]] = []  # views: here, and what is copied

    def field(self, size: int) -> fem.Function:
        """A vector at each point; the caller fills its array (capacity * size,)."""
        return fem.Function(fem.functionspace(self._mesh, ("DG", 0, (size,))))

    def constant(self, of: fem.Constant) -> fem.Constant:
        """A constant here that takes the value of another constant at every evaluation."""
        own = fem.Constant(self._mesh, of.value)
        self._constants.append((own.value, of.value))
        return own

    def evaluate(self, kernel: "PointKernel", count: int) -> Array:
        """(count, components) at the first points; the array is reused by the next call."""
        for own, of in self._constants:
            np.copyto(own, of)
        if self._values.size < count * kernel.size:
            self._values = np.empty(self.capacity * kernel.size)
        values = self._values[: count * kernel.size].reshape(count, kernel.size)
        kernel.evaluate(count, values)
        return values


class PointKernel:
    """A function of fields and constants at points, which is compiled when it is first evaluated,
    if not before.

    Attributes
    ----------
    size
        Number of its components.
    """

    def __init__(
        self,
        library: Callable[[], ctypes.CDLL],
        fields: Sequence[fem.Function],
        constants: Sequence[fem.Constant],
        size: int,
    ) -> None:
        self._library, self.size = library, size
        self._constants, self._fields = (
            [c.value for c in constants],
            [f.x.array for f in fields],
        )  # views
        self._places = np.array([values.ctypes.data for values in self._fields], np.uintp)
        self._sizes = np.array([f.ufl_shape[0] for f in fields], np.int32)

    @cached_property
    def _function(self) -> COMPILED:
        return function_of(self._library())

    def evaluate(self, count: int, values: Array) -> None:
        """Fill a contiguous array (count, size) for the first points."""
        constants = np.concatenate(
            [np.ravel(value) for value in (*self._constants, 0.0)]
        )  # never empty
        fields, sizes, c, out = (
            array.ctypes.data for array in (self._places, self._sizes, constants, values)
        )
        self._function(fields, sizes, c, count, out)


Made = Callable[[Scalars, list[list[int]]], list[int]]  # from the nodes of each expression


def _kernel(
    name: str, expressions: Sequence[Expr], asked: str, size: int, made: Made, log: KernelLog
) -> PointKernel:
    """Compile what is made of some expressions, or load it.

    Parameters
    ----------
    asked
        Says what is made, besides the expressions.
    size
        Number of the nodes that are made.
    """
    fields, constants, labels = terminals_of(expressions, ufl.Coefficient, ufl.Constant, Label)
    translated = cache(lambda: _graph(expressions, fields, constants))
    structure = (asked, *_structures(expressions, fields, constants, labels))

    def code() -> str:
        graph, nodes = translated()
        return point_code(graph, made(graph, nodes))

    key = _key_of(structure, lambda: _key(asked, *translated()))
    library = log.load(name, key, code, (*OPTIONS, *processor_options()), size)
    return PointKernel(library, fields, constants, size)


_KEYS: dict[tuple[str, ...], str] = {}  # of what was translated before, by its structure


def _key_of(structure: tuple[str, ...], key: Callable[[], str]) -> str:
    """The key, from this process or one before: to translate an expression takes as long as all
    else of a kernel.
    """
    if structure not in _KEYS:
        depends = repr((_version(), ufl.__version__, structure))
        name = f"magshell_key_{hashlib.sha256(depends.encode()).hexdigest()[:40]}"
        kept = recall(name)
        _KEYS[structure] = kept.decode() if kept else key()
        if not kept:
            keep(name, _KEYS[structure].encode())
    return _KEYS[structure]


def _structures(expressions: Sequence[Expr], *inputs: Sequence[Any]) -> list[str]:
    """What is the same for expressions that differ in nothing but which inputs they have."""
    numbers = {of: i for some in inputs for i, of in enumerate(some)}
    numbers |= {domain: 0 for e in expressions for domain in extract_domains(e)}
    return [compute_expression_signature(e, numbers) for e in expressions]


def _graph(
    expressions: Sequence[Expr], fields: Sequence[fem.Function], constants: Sequence[fem.Constant]
) -> tuple[Scalars, list[list[int]]]:
    """Operations, and the nodes of each expression."""
    graph = Scalars()
    return graph, [flat(graph.components(e, fields, constants)) for e in expressions]


def _key(asked: str, graph: Scalars, nodes: list[list[int]]) -> str:
    """What the code of a kernel depends on; neither the order nor the number of other operations."""
    number = {
        node: i for i, node in enumerate(graph.reached([node for each in nodes for node in each]))
    }
    operations = [
        (graph.operations[node][0], *(number[operand] for operand in operands))
        if operands
        else graph.operations[node]
        for node in number
        for operands in [graph.operands(node)]
    ]
    ends = [[number[node] for node in each] for each in nodes]
    return hashlib.sha256(repr((_version(), asked, ends, operations)).encode()).hexdigest()


@cache
def _version() -> str:
    """Changes with the code that makes kernels."""
    files = (scalars.__file__, __file__)
    return hashlib.sha256(b"".join(Path(file).read_bytes() for file in files)).hexdigest()


def point_values(name: str, W: Expr, log: KernelLog) -> PointKernel:
    """Compile the components of an expression."""
    size = int(np.prod(W.ufl_shape))
    return _kernel(name, [W], "values", size, lambda _, nodes: nodes[0], log)


def point_gradient(
    name: str, sums: Sequence[tuple[Expr, fem.Function]], log: KernelLog
) -> PointKernel:
    """Compile the sum of dW/dz for some W, each with its own z of the same size."""
    size = sums[0][1].ufl_shape[0]

    def made(graph: Scalars, nodes: list[list[int]]) -> list[int]:
        total = [graph.zero] * size
        for (W,), z in zip(nodes[::2], nodes[1::2], strict=True):
            first, _ = graph.derivatives(W, z, second=False)
            total = [graph.add(t, first.get(i, graph.zero)) for t, i in zip(total, z, strict=True)]
        return total

    return _kernel(name, [e for one in sums for e in one], "gradient", size, made, log)


@dataclass(frozen=True)
class Pairs:
    """The nonzero blocks (3, 3) of a Hessian: d2W/dz_i dz_j for parts i, j of z, on one or two
    sides.

    A block and its transpose are stored as symmetric and skew part.

    Attributes
    ----------
    same
        i <= j, on each side.
    cross
        i on the first side, j on the second; empty for one side.
    """

    same: tuple[Pair, ...]
    cross: tuple[Pair, ...] = ()

    @property
    def skew(self) -> tuple[Pair, ...]:
        return tuple((i, j) for i, j in self.same if i < j)

    def __or__(self, other: "Pairs") -> "Pairs":
        def both(a: Sequence[Pair], b: Sequence[Pair]) -> tuple[Pair, ...]:
            return tuple(dict.fromkeys((*a, *b)))

        return Pairs(both(self.same, other.same), both(self.cross, other.cross))


COMPONENTS = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]  # of a symmetric block
SKEW = [(0, 1), (0, 2), (1, 2)]


def point_hessian(
    name: str, W: Expr, z: fem.Function, parts: int, pairs: Pairs, log: KernelLog, *, at_zero: bool
) -> PointKernel:
    """Compile the blocks of d2W/dz2, at z itself or at z = 0.

    Parameters
    ----------
    z
        Field of `parts` vectors, or twice as many for two sides.

    Returns
    -------
    PointKernel
        For each side the symmetric parts (6, pairs) then the skew parts (3, skew pairs); after
        them the cross blocks (9, pairs).
    """
    sides = z.ufl_shape[0] // (3 * parts)

    def made(graph: Scalars, nodes: list[list[int]]) -> list[int]:
        (density,), inputs = nodes
        _, second = graph.derivatives(density, inputs, second=True)

        def block(i: int, j: int, c: int, d: int) -> int:
            one, other = inputs[3 * i + c], inputs[3 * j + d]
            return second.get((min(one, other), max(one, other)), graph.zero)

        def mean(a: int, b: int) -> int:
            return graph.times(graph.number(0.5), graph.add(a, b))

        outputs = list[int]()
        for first in range(0, sides * parts, parts):
            same = [(first + i, first + j) for i, j in pairs.same]
            skew = [(first + i, first + j) for i, j in pairs.skew]
            outputs += [
                mean(block(i, j, c, d), block(i, j, d, c)) for c, d in COMPONENTS for i, j in same
            ]
            outputs += [
                mean(block(i, j, c, d), graph.minus(block(i, j, d, c)))
                for c, d in SKEW
                for i, j in skew
            ]
        outputs += [
            block(i, parts + j, c, d) for c in range(3) for d in range(3) for i, j in pairs.cross
        ]
        return graph.replaced(outputs, dict.fromkeys(inputs, graph.zero)) if at_zero else outputs

    size = sides * (6 * len(pairs.same) + 3 * len(pairs.skew)) + 9 * len(pairs.cross)
    return _kernel(name, [W, z], repr(("hessian", parts, pairs, at_zero)), size, made, log)


def whole_hessian(name: str, W: Expr, z: fem.Function, log: KernelLog) -> PointKernel:
    """Compile d2W/dz2 at z = 0: the rows of its upper triangle."""
    size = z.ufl_shape[0]

    def made(graph: Scalars, nodes: list[list[int]]) -> list[int]:
        (density,), inputs = nodes
        _, second = graph.derivatives(density, inputs, second=True)
        pairs = [(min(i, j), max(i, j)) for i, j in combinations_with_replacement(inputs, 2)]
        return graph.replaced(
            [second.get(pair, graph.zero) for pair in pairs], dict.fromkeys(inputs, graph.zero)
        )

    return _kernel(name, [W, z], "whole hessian", size * (size + 1) // 2, made, log)


NAME = "evaluate_many"
OPTIONS = (
    "-std=gnu17",
    "-O1",
    "-g0",
    "-ffast-math",
)  # -O2 compiles five times slower, for 15 % of the run time
INFIX = {"+", "*", "/", "<", ">", "<=", ">=", "==", "!=", "&", "|"}
MASKS = INFIX - {"+", "*", "/"} | {"!"}
PREAMBLE = """#include <math.h>
#include <stdint.h>

typedef double four __attribute__((vector_size(32), aligned(8)));
typedef int64_t mask __attribute__((vector_size(32), aligned(8)));

static inline four pick(mask m, four a, four b) { return (four)((m & (mask)a) | (~m & (mask)b)); }
"""
OF_ONE = "static inline four four_{f}(four x) {{ for (int i = 0; i < 4; ++i) x[i] = {f}(x[i]); return x; }}\n"
OF_TWO = """static inline four four_{f}(four x, four y)
{{ for (int i = 0; i < 4; ++i) x[i] = {f}(x[i], y[i]); return x; }}
"""
POINTS = """
/* values: of each field (n, size), row by row. constants: of all. out: (n, {count}). */
void {name}(const double* const* values, const int32_t* sizes, const double* constants, int64_t n, double* out)
{{
  const four none = {{0}};
  for (int64_t p = 0; p < n; p += 4) {{
    int64_t at[4];
    for (int i = 0; i < 4; ++i) at[i] = p + i < n ? p + i : n - 1;
{body}
    for (int i = 0; i < 4 && p + i < n; ++i)
      for (int k = 0; k < {count}; ++k) out[(p + i) * {count} + k] = A[k][i];
  }}
}}
"""


def point_code(scalars: Scalars, outputs: Sequence[int]) -> str:
    """The source of a function that gives some nodes at many points."""
    order, names = scalars.reached(outputs), dict[int, str]()
    lines, functions = [f"four A[{len(outputs)}];"], dict[str, int]()
    wanted = dict[int, list[int]]()
    for k, node in enumerate(outputs):
        wanted.setdefault(node, []).append(k)
    for node in order:
        name, *rest = scalars.operations[node]
        if name == "number":
            names[node] = f"({rest[0]!r})"
        else:
            names[node], kind = f"x{node}", "mask" if name in MASKS else "four"
            lines.append(f"const {kind} x{node} = {_operation(name, rest, names, functions)};")
        lines += [f"A[{k}] = none + {names[node]};" for k in wanted.get(node, ())]
    helpers = "".join(
        (OF_ONE if count == 1 else OF_TWO).format(f=f) for f, count in functions.items()
    )
    body = "\n".join(f"    {line}" for line in lines)
    return PREAMBLE + helpers + POINTS.format(name=NAME, count=len(outputs), body=body)


def function_of(library: ctypes.CDLL) -> COMPILED:
    """The function of a library, with the types of its arguments: fields, sizes, constants, count,
    out.
    """
    function, pointer = library[NAME], ctypes.c_void_p
    function.argtypes, function.restype = [pointer, pointer, pointer, ctypes.c_int64, pointer], None
    return function


def _operation(name: str, rest: list[int], names: dict[int, str], functions: dict[str, int]) -> str:
    if name == "field":
        return (
            "{"
            + ", ".join(
                f"values[{rest[0]}][at[{i}] * sizes[{rest[0]}] + {rest[1]}]" for i in range(4)
            )
            + "}"
        )
    if name == "constant":
        return f"none + constants[{rest[0]}]"
    operands = [names[node] for node in rest]
    if name == "pick":
        return f"pick({operands[0]}, none + {operands[1]}, none + {operands[2]})"
    if name == "!":
        return f"~{operands[0]}"
    if name in INFIX:
        first = (
            f"(none + {operands[0]})" if operands[0][0] == "(" and name in MASKS else operands[0]
        )
        return f"{first} {name} {operands[1]}"
    if name in ("jn", "yn"):  # of an order that is a number
        return (
            "{"
            + ", ".join(f"{name}((int){operands[0]}, {operands[1]}[{i}])" for i in range(4))
            + "}"
        )
    functions[name] = len(operands)
    return f"four_{name}({', '.join(f'none + {operand}' for operand in operands)})"
