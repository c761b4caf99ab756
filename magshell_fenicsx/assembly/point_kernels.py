"""Second derivatives of a density at many points at once.

The density is a function of a few vectors (3,) that vary between points. The points are represented as cells of an
interval and the vectors as cell-wise constants, so the just-in-time compiler of expressions can be used. Its kernels do
not depend on mesh, degree or quadrature.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI
from numpy.typing import NDArray
from ufl.algorithms.analysis import extract_coefficients, extract_constants
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.platform import compat
from magshell_fenicsx.platform.compiler import many_of

Pair = tuple[int, int]


class Points:
    """Storage for a number of points, on this rank."""

    def __init__(self, capacity: int) -> None:
        self.capacity = capacity
        self._mesh = mesh.create_interval(MPI.COMM_SELF, capacity, (0.0, 1.0))
        order = fem.functionspace(self._mesh, ("DG", 0)).dofmap.list[:, 0]
        self._cells = np.argsort(order).astype(np.int32)  # the cell of the p-th value
        self._values = np.empty(0)
        self._constants: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []  # views: here, and what is copied
        self._calls = WeakKeyDictionary[fem.Expression, _Call | None]()

    def field(self, size: int) -> fem.Function:
        """A vector at each point; the caller fills its array (capacity * size,)."""
        return fem.Function(fem.functionspace(self._mesh, ("DG", 0, (size,))))

    def constant(self, of: fem.Constant) -> fem.Constant:
        """A constant here that takes the value of another constant at every evaluation."""
        here = fem.Constant(self._mesh, of.value)
        self._constants.append((here.value, of.value))
        return here

    def evaluate(self, expression: fem.Expression, count: int) -> NDArray[np.float64]:
        """(count, components) at the first points; the array is reused by the next call."""
        size = expression.value_size
        for here, of in self._constants:
            np.copyto(here, of)
        if self._values.size < count * size:
            self._values = np.empty(self.capacity * size)
        values = self._values[: count * size].reshape(count, size)
        if expression not in self._calls:
            self._calls[expression] = _Call.of(expression, self.capacity)
        if call := self._calls[expression]:
            call(count, values)
        else:
            compat.evaluate(expression, self._mesh, self._cells[:count], values)
        return values


class _Call:
    """An expression's function for many points, with what it takes; the values of fields are views."""

    def __init__(self, many: Any, fields: Sequence[fem.Function], constants: Sequence[fem.Constant], n: int) -> None:
        self._many, self._constants = many, [constant.value for constant in constants]
        self._fields = [field.x.array for field in fields]
        self._places = np.array([values.ctypes.data for values in self._fields], np.uintp)
        self._sizes = np.array([values.size // n for values in self._fields], np.int32)

    @staticmethod
    def of(expression: fem.Expression, n: int) -> "_Call | None":
        """That of an expression at storage for n points; None if there is no such function."""
        compiled, whole = expression.ufcx_expression, expression.ufl_expression
        if (many := many_of(compiled)) is None:
            return None
        known = extract_coefficients(whole)
        fields = [known[compiled.original_coefficient_positions[i]] for i in range(compiled.num_coefficients)]
        return _Call(many, fields, extract_constants(whole), n)

    def __call__(self, count: int, values: NDArray[np.float64]) -> None:
        """Evaluate at the first points, into a contiguous array (count, components)."""
        constants = np.concatenate([np.ravel(value) for value in (*self._constants, 0.0)])  # never empty
        fields, sizes, c, out = (array.ctypes.data for array in (self._places, self._sizes, constants, values))
        self._many(fields, sizes, len(self._sizes), c, count, out)


@dataclass(frozen=True)
class Pairs:
    """The nonzero blocks (3, 3) of a Hessian: d2W/dz_i dz_j for parts i, j of z, on one or two sides.

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
    name: str, W: Expr, z: fem.Function, parts: int, pairs: Pairs, log: KernelLog, comm: MPI.Comm, *, at_zero: bool
) -> fem.Expression:
    """Compile the blocks of d2W/dz2, at z itself or at z = 0.

    Parameters
    ----------
    z
        Field of `parts` vectors, or twice as many for two sides.
    comm
        All its ranks compile together.

    Returns
    -------
    fem.Expression
        For each side the symmetric parts (6, pairs) then the skew parts (3, skew pairs); after
        them the cross blocks (9, pairs).
    """
    H = ufl.diff(ufl.diff(W, z), z)
    if at_zero:
        H = ufl.replace(ufl.algorithms.expand_derivatives(H), {z: ufl.zero(z.ufl_shape)})
    components = []
    for side in range(z.ufl_shape[0] // (3 * parts)):

        def block(i: int, j: int, c: int, d: int, first: int = side * parts) -> Expr:
            return H[3 * (first + i) + c, 3 * (first + j) + d]

        components += [
            block(i, j, c, d) if i == j or c == d else (block(i, j, c, d) + block(i, j, d, c)) / 2
            for c, d in COMPONENTS
            for i, j in pairs.same
        ]
        components += [(block(i, j, c, d) - block(i, j, d, c)) / 2 for c, d in SKEW for i, j in pairs.skew]
    components += [H[3 * i + c, 3 * (parts + j) + d] for c in range(3) for d in range(3) for i, j in pairs.cross]
    return log.compile_expression(f"{name} hessian", ufl.as_vector(components), comm)
