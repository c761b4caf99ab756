"""Kernels for densities at many points at once: their values, gradients and Hessians.

A density is a function of a few vectors that vary between points. Its kernels do not depend on
mesh, degree or quadrature. The points are represented as cells of an interval, and the vectors as
functions that are constant in each. A kernel is a function in C of operations on scalars
(`scalar_graph`), for many points in one call and four points at once. Theory: docs/tangent.md.

W is a density as an expression of UFL, z a field of vectors by which it is differentiated. A graph
has the operations on scalars as nodes, which are numbers; a list of nodes stands for the components
of an expression or of a result. A kernel is kept under a key, a hash of all that its code depends
on; the log requests compilation. Vectors of z are counted by i, j and their components by c, d.
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

from magshell_fenicsx.assembly import scalar_graph
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.scalar_graph import ScalarGraph, flat, terminals_of
from magshell_fenicsx.platform.compiler import processor_options
from magshell_fenicsx.platform.disk_cache import load_cached, save_cached

IndexPair = tuple[int, int]
Array = NDArray[np.float64]

# Arguments: addresses of fields, sizes, constants; the number of points; the address of results.
PointFunction: TypeAlias = Callable[[int, int, int, int, int], None]


class PointStorage:
    """Storage for fields at a number of points, on this rank.

    Parameters
    ----------
    capacity
        Largest number of points.
    """

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._mesh = mesh.create_interval(MPI.COMM_SELF, capacity, (0.0, 1.0))
        self._values = np.empty(0)
        # Values here, and those that are copied to them at every evaluation.
        self._constants: list[tuple[Array, Array]] = []

    def field(self, size: int) -> fem.Function:
        """Return a vector field; the caller fills its array (capacity * size,)."""
        return fem.Function(fem.functionspace(self._mesh, ("DG", 0, (size,))))

    def constant(self, original: fem.Constant) -> fem.Constant:
        """Return a constant that takes the value of another one at every evaluation."""
        copied = fem.Constant(self._mesh, original.value)
        self._constants.append((copied.value, original.value))
        return copied

    def evaluate(self, kernel: "PointKernel", count: int) -> Array:
        """Return the values (count, components) of a kernel at the first `count` points.

        The constants get the present values of their originals before. The array is reused by the
        next call.
        """
        for copied, original in self._constants:
            np.copyto(copied, original)
        if self._values.size < count * kernel.size:
            self._values = np.empty(self.capacity * kernel.size)
        values = self._values[: count * kernel.size].reshape(count, kernel.size)
        kernel.evaluate(count, values)
        return values


class PointKernel:
    """A function of fields and constants at points, compiled when it is first evaluated.

    Parameters
    ----------
    library
        Returns the compiled library.
    fields, constants
        The inputs, in the order of the code; their present values are taken at each evaluation.

    Attributes
    ----------
    size
        Number of components of the function.
    """

    def __init__(
        self,
        library: Callable[[], ctypes.CDLL],
        fields: Sequence[fem.Function],
        constants: Sequence[fem.Constant],
        size: int,
    ) -> None:
        """Take the addresses of the inputs' arrays, which the C function reads."""
        self._library, self.size = library, size
        # Views of the arrays, whose values may change.
        self._constants = [c.value for c in constants]
        self._fields = [f.x.array for f in fields]
        self._addresses = np.array([values.ctypes.data for values in self._fields], np.uintp)
        self._sizes = np.array([f.ufl_shape[0] for f in fields], np.int32)

    @cached_property
    def _function(self) -> PointFunction:
        """The compiled function, see `PointFunction`."""
        return kernel_function(self._library())

    def evaluate(self, count: int, values: Array) -> None:
        """Fill a contiguous array (count, size) with the results at the first points."""
        # With a zero at the end, so that it is never empty.
        constants = np.concatenate([np.ravel(value) for value in (*self._constants, 0.0)])
        arrays = self._addresses, self._sizes, constants, values
        fields, sizes, c, out = (array.ctypes.data for array in arrays)
        self._function(fields, sizes, c, count, out)


# From a graph and the nodes of each expression to the nodes of the results.
MakeNodes = Callable[[ScalarGraph, list[list[int]]], list[int]]


def _kernel(
    name: str,
    expressions: Sequence[Expr],
    task: str,
    size: int,
    make_nodes: MakeNodes,
    log: KernelLog,
) -> PointKernel:
    """Return the kernel of results that are made of some expressions.

    Parameters
    ----------
    name
        Name of the kernel in the log.
    expressions
        The expressions of UFL; fields, constants and labels in them are numbered.
    task
        Says what is made of the expressions; a part of the key.
    size
        Number of the results.
    make_nodes
        Called with the graph and the nodes of each expression; it returns the nodes of the results.
    log
        Requests the compiled library.
    """
    # the graph is only made where the key or the code is not known
    fields, constants, labels = terminals_of(expressions, ufl.Coefficient, ufl.Constant, Label)
    translate = cache(lambda: _graph(expressions, fields, constants))
    structure = (task, *_structures(expressions, fields, constants, labels))

    def code() -> str:
        """Return the C source of the kernel."""
        graph, nodes = translate()
        return point_code(graph, make_nodes(graph, nodes))

    key = _cached_key(structure, lambda: _key(task, *translate()))
    library = log.request_library(name, key, code, (*POINT_OPTIONS, *processor_options()), size)
    return PointKernel(library, fields, constants, size)


_KEYS: dict[tuple[str, ...], str] = {}  # of kernels, by the structure of their expressions


def _cached_key(structure: tuple[str, ...], compute_key: Callable[[], str]) -> str:
    """Return the key of a kernel, from this process or from the cache on disk if it is known.

    To translate an expression takes as long as all else of a kernel.

    Parameters
    ----------
    structure
        The task, and signatures of the expressions, which determine the key.
    compute_key
        Computes the key of an unknown structure.
    """
    if structure not in _KEYS:
        # a new generator of code, or a new UFL, makes other keys
        inputs = repr((_version(), ufl.__version__, structure))
        name = f"magshell_key_{hashlib.sha256(inputs.encode()).hexdigest()[:40]}"
        cached = load_cached(name)
        if cached:
            _KEYS[structure] = cached.decode()
        else:
            _KEYS[structure] = compute_key()
            save_cached(name, _KEYS[structure].encode())
    return _KEYS[structure]


def _structures(expressions: Sequence[Expr], *inputs: Sequence[Any]) -> list[str]:
    """Return signatures of expressions in which inputs count by their position alone.

    Parameters
    ----------
    inputs
        Fields, constants and labels, each in its order.
    """
    # all meshes count as one
    numbers = {terminal: i for terminals in inputs for i, terminal in enumerate(terminals)}
    numbers |= {domain: 0 for e in expressions for domain in extract_domains(e)}
    return [compute_expression_signature(e, numbers) for e in expressions]


def _graph(
    expressions: Sequence[Expr], fields: Sequence[fem.Function], constants: Sequence[fem.Constant]
) -> tuple[ScalarGraph, list[list[int]]]:
    """Return the graph of some expressions, and the nodes of each expression.

    Parameters
    ----------
    fields, constants
        All that occur, in their order among the inputs.
    """
    graph = ScalarGraph()
    return graph, [flat(graph.components(e, fields, constants)) for e in expressions]


def _key(task: str, graph: ScalarGraph, nodes: list[list[int]]) -> str:
    """Return the key of a kernel: a hash of everything on which its code depends.

    It is independent of the order and number of other operations in the graph.

    Parameters
    ----------
    task
        Says what is made of the expressions.
    nodes
        The nodes of each expression.
    """
    all_nodes = [node for nodes_of_one in nodes for node in nodes_of_one]
    # nodes are numbered anew, in the order in which the code needs them
    number = {node: i for i, node in enumerate(graph.dependencies(all_nodes))}
    operations = list[tuple[Any, ...]]()
    for node in number:
        operands = graph.operands(node)
        operation = graph.operations[node]
        if operands:
            operation = (operation[0], *(number[operand] for operand in operands))
        operations.append(operation)
    results = [[number[node] for node in nodes_of_one] for nodes_of_one in nodes]
    return hashlib.sha256(repr((_version(), task, results, operations)).encode()).hexdigest()


@cache
def _version() -> str:
    """Return a hash of the source that generates kernels."""
    files = (scalar_graph.__file__, __file__)
    return hashlib.sha256(b"".join(Path(file).read_bytes() for file in files)).hexdigest()


def point_values(name: str, W: Expr, log: KernelLog) -> PointKernel:
    """Return the kernel of the components of an expression W."""
    size = int(np.prod(W.ufl_shape))
    return _kernel(name, [W], "values", size, lambda _, nodes: nodes[0], log)


def point_gradient(
    name: str, sums: Sequence[tuple[Expr, fem.Function]], log: KernelLog
) -> PointKernel:
    """Return the kernel of a sum of gradients dW/dz at points.

    Parameters
    ----------
    sums
        Pairs of a density W and the field z by which it is differentiated; all z have the same
        size.
    """
    _, first_field = sums[0]
    size = first_field.ufl_shape[0]

    def gradient(graph: ScalarGraph, nodes: list[list[int]]) -> list[int]:
        """Return the nodes of the sum's components."""
        sum_nodes = [graph.zero] * size
        # lists of nodes alternate: the density's only node, then the components of its field
        for (W,), z in zip(nodes[::2], nodes[1::2], strict=True):
            slopes, _ = graph.derivatives(W, z, second=False)
            sum_nodes = [
                graph.add(total, slopes.get(component, graph.zero))
                for total, component in zip(sum_nodes, z, strict=True)
            ]
        return sum_nodes

    expressions = [expression for pair in sums for expression in pair]
    return _kernel(name, expressions, "gradient", size, gradient, log)


@dataclass(frozen=True)
class BlockPairs:
    """The nonzero blocks (3, 3) of a Hessian: d2W/dz_i dz_j for vectors i, j of z.

    z consists of the vectors of one side of an edge, or of two. A block and its transpose are
    stored as symmetric and skew part.

    Attributes
    ----------
    within_side
        Pairs i <= j, the same on each side.
    cross
        Pairs of i on the first side and j on the second; empty for one side.
    """

    within_side: tuple[IndexPair, ...]
    cross: tuple[IndexPair, ...] = ()

    @property
    def skew(self) -> tuple[IndexPair, ...]:
        """Pairs whose blocks have a skew part: i < j, on each side."""
        return tuple((i, j) for i, j in self.within_side if i < j)

    def __or__(self, other: "BlockPairs") -> "BlockPairs":
        """Return the pairs of both, in order, each once."""

        def union(a: Sequence[IndexPair], b: Sequence[IndexPair]) -> tuple[IndexPair, ...]:
            return tuple(dict.fromkeys((*a, *b)))

        return BlockPairs(
            union(self.within_side, other.within_side), union(self.cross, other.cross)
        )


COMPONENTS = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]  # of the symmetric part of a block
SKEW = [(0, 1), (0, 2), (1, 2)]  # components of the skew part


def point_hessian(
    name: str,
    W: Expr,
    z: fem.Function,
    vectors: int,
    pairs: BlockPairs,
    log: KernelLog,
    *,
    at_zero: bool,
) -> PointKernel:
    """Return the kernel of blocks of d2W/dz2, at z itself or at z = 0.

    Parameters
    ----------
    W
        The density.
    z
        Field of `vectors` vectors, or twice as many for two sides.
    vectors
        Number of vectors on a side.
    pairs
        The blocks that are not zero.
    at_zero
        Whether the Hessian is taken at z = 0.

    Returns
    -------
    PointKernel
        For each side the symmetric parts (6, pairs) then the skew parts (3, skew pairs); after them
        the cross blocks (9, pairs).
    """
    sides = z.ufl_shape[0] // (3 * vectors)  # 1 or 2

    def hessian(graph: ScalarGraph, nodes: list[list[int]]) -> list[int]:
        """Return the nodes of the kernel's results, in their order.

        `inputs` are the components of z: three of each vector, one side after the other.
        """
        (density,), inputs = nodes
        _, second = graph.derivatives(density, inputs, second=True)

        def entry(i: int, j: int, c: int, d: int) -> int:
            """Return the second derivative by component c of vector i and d of vector j."""
            row, column = inputs[3 * i + c], inputs[3 * j + d]
            # second derivatives are known by the pair with the smaller node first; others are zero
            return second.get((min(row, column), max(row, column)), graph.zero)

        def mean(a: int, b: int) -> int:
            """Return the node of (a + b)/2."""
            return graph.times(graph.number(0.5), graph.add(a, b))

        outputs = list[int]()
        for first_vector in range(0, sides * vectors, vectors):
            within = [(first_vector + i, first_vector + j) for i, j in pairs.within_side]
            skew = [(first_vector + i, first_vector + j) for i, j in pairs.skew]
            # symmetric parts of the blocks, then skew ones
            outputs += [
                mean(entry(i, j, c, d), entry(i, j, d, c)) for c, d in COMPONENTS for i, j in within
            ]
            outputs += [
                mean(entry(i, j, c, d), graph.minus(entry(i, j, d, c)))
                for c, d in SKEW
                for i, j in skew
            ]
        # blocks between the sides: vectors of the second one follow those of the first
        outputs += [
            entry(i, vectors + j, c, d) for c in range(3) for d in range(3) for i, j in pairs.cross
        ]
        return graph.substitute(outputs, dict.fromkeys(inputs, graph.zero)) if at_zero else outputs

    per_side = 6 * len(pairs.within_side) + 3 * len(pairs.skew)
    size = sides * per_side + 9 * len(pairs.cross)
    task = repr(("hessian", vectors, pairs, at_zero))
    return _kernel(name, [W, z], task, size, hessian, log)


def full_hessian(name: str, W: Expr, z: fem.Function, log: KernelLog) -> PointKernel:
    """Return the kernel of d2W/dz2 at z = 0: the upper triangle, row by row.

    All components of z count, not blocks of vectors.
    """
    size = z.ufl_shape[0]

    def hessian(graph: ScalarGraph, nodes: list[list[int]]) -> list[int]:
        """Return the nodes of the upper triangle's entries, with zeros in place of z."""
        (density,), inputs = nodes
        _, second = graph.derivatives(density, inputs, second=True)
        pairs = [(min(i, j), max(i, j)) for i, j in combinations_with_replacement(inputs, 2)]
        entries = [second.get(pair, graph.zero) for pair in pairs]
        return graph.substitute(entries, dict.fromkeys(inputs, graph.zero))

    return _kernel(name, [W, z], "full hessian", size * (size + 1) // 2, hessian, log)


FUNCTION_NAME = "evaluate_many"

# -O2 compiles five times slower, for 15 % of the run time.
POINT_OPTIONS = ("-std=gnu17", "-O1", "-g0", "-ffast-math")

INFIX_OPERATIONS = {"+", "*", "/", "<", ">", "<=", ">=", "==", "!=", "&", "|"}
MASK_OPERATIONS = INFIX_OPERATIONS - {"+", "*", "/"} | {"!"}  # whose results are true or false
PREAMBLE = """#include <math.h>
#include <stdint.h>

typedef double four __attribute__((vector_size(32), aligned(8)));
typedef int64_t mask __attribute__((vector_size(32), aligned(8)));

static inline four pick(mask m, four a, four b) { return (four)((m & (mask)a) | (~m & (mask)b)); }
"""
UNARY_HELPER = """static inline four four_{f}(four x)
{{ for (int i = 0; i < 4; ++i) x[i] = {f}(x[i]); return x; }}
"""
BINARY_HELPER = """static inline four four_{f}(four x, four y)
{{ for (int i = 0; i < 4; ++i) x[i] = {f}(x[i], y[i]); return x; }}
"""
FUNCTION_TEMPLATE = """
/* values: of each field (n, size), row by row. constants: of all. out: (n, {count}). */
void {name}(const double* const* values, const int32_t* sizes, const double* constants, int64_t n,
            double* out)
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


def point_code(graph: ScalarGraph, outputs: Sequence[int]) -> str:
    """Return the C source of a function that computes some nodes at many points.

    Each node becomes a local variable that holds four points at once.

    Parameters
    ----------
    outputs
        The nodes of the results, in order; a node may occur several times.
    """
    # node -> its name in C, and helper function -> number of its arguments
    names, helpers = dict[int, str](), dict[str, int]()
    lines = [f"four A[{len(outputs)}];"]
    result_positions = dict[int, list[int]]()
    for k, node in enumerate(outputs):
        result_positions.setdefault(node, []).append(k)
    for node in graph.dependencies(outputs):
        operator, *arguments = graph.operations[node]
        # a number is written in place, in parentheses; any other node becomes a variable
        if operator == "number":
            names[node] = f"({arguments[0]!r})"
        else:
            names[node] = f"x{node}"
            kind = "mask" if operator in MASK_OPERATIONS else "four"
            lines.append(
                f"const {kind} x{node} = {_c_expression(operator, arguments, names, helpers)};"
            )
        lines += [f"A[{k}] = none + {names[node]};" for k in result_positions.get(node, ())]
    helper_code = "".join(
        (UNARY_HELPER if count == 1 else BINARY_HELPER).format(f=f) for f, count in helpers.items()
    )
    body = "\n".join(f"    {line}" for line in lines)
    function = FUNCTION_TEMPLATE.format(name=FUNCTION_NAME, count=len(outputs), body=body)
    return PREAMBLE + helper_code + function


def kernel_function(library: ctypes.CDLL) -> PointFunction:
    """Return the C function of a library, with the types of its arguments: a `PointFunction`."""
    function, pointer = library[FUNCTION_NAME], ctypes.c_void_p
    function.argtypes, function.restype = [pointer, pointer, pointer, ctypes.c_int64, pointer], None
    return function


def _c_expression(
    operation: str, rest: list[int], names: dict[int, str], helpers: dict[str, int]
) -> str:
    """Return an operation as a C expression.

    Parameters
    ----------
    operation
        Name of the operation.
    rest
        The nodes of its operands; of an input its numbers.
    names
        Node -> its name in C.
    helpers
        Function -> number of its arguments, of all functions that the code needs; may be added to.
    """
    if operation == "field":
        number, component = rest
        lanes = (f"values[{number}][at[{i}] * sizes[{number}] + {component}]" for i in range(4))
        return "{" + ", ".join(lanes) + "}"
    if operation == "constant":
        return f"none + constants[{rest[0]}]"
    operands = [names[node] for node in rest]
    if operation == "pick":
        return f"pick({operands[0]}, none + {operands[1]}, none + {operands[2]})"
    if operation == "!":
        return f"~{operands[0]}"
    if operation in INFIX_OPERATIONS:
        left, right = operands
        # a number on the left becomes a vector, so that the result is a mask
        if operation in MASK_OPERATIONS and left[0] == "(":
            left = f"(none + {left})"
        return f"{left} {operation} {right}"
    if operation in ("jn", "yn"):  # whose order is a number
        order, x = operands
        lanes = (f"{operation}((int){order}, {x}[{i}])" for i in range(4))
        return "{" + ", ".join(lanes) + "}"
    helpers[operation] = len(operands)
    return f"four_{operation}({', '.join(f'none + {operand}' for operand in operands)})"
