"""Densities and their first derivatives at points.

The derivatives of u are those by the coordinates of the reference cell, so that one table of shape
functions serves all cells. The kernels take them to the flat cell's own orthonormal coordinates
first: the metric of a sliver is then as well conditioned as in a form.

- A jet is a vector field's value with its first and second derivatives: parts r, r1, r2, r11, r12
  and r22, of which only those that a density needs are known at points.
- r0 is the placement, u the displacement, v a virtual displacement; W is a density.
- A side is one of the cells beside a point: two on an interior edge, else one.
- A point field is a fem.Function whose values at points are a kernel's input. A chunk is a slice of
  all points that is evaluated at a time, in the same point fields.
- A `Memo` holds a value that is computed again (`renew`) when its inputs have changed.
- p, q, s and a determinant are a cell's frame: d/dx = p d/dX and d/dy = q d/dX + s d/dY.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.algorithms import extract_coefficients
from ufl.constantvalue import Zero
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.memo import Memo, memo_input
from magshell_fenicsx.assembly.point_kernels import (
    PointKernel,
    PointStorage,
    point_gradient,
    point_values,
)
from magshell_fenicsx.models.shell.element_hessians import JET_NAMES, fill, parameters_at
from magshell_fenicsx.models.shell.energy import Density
from magshell_fenicsx.models.shell.kinematics import Jet

Array = NDArray[np.float64]
CHUNK_POINTS = 16384  # points at a time: their vectors stay within some ten megabytes
FRAME_SIZE = 4  # numbers of a cell's frame, see `cell_frames`


class PointTerm(Protocol):
    """A term with a density."""

    @property
    def name(self) -> str: ...

    @property
    def amplitude(self) -> str | None: ...

    @property
    def density(self) -> Density: ...


class PointGradient:
    """Densities of some terms at points, and the gradient dW/du of their sum.

    For a virtual work, the derivative by v takes the place of dW/du. Kernels are compiled at their
    first use, on all ranks.

    Parameters
    ----------
    terms
        Terms that are all on cells, or all on edges with the same number of sides.
    parts
        Names of the jet parts that are known at the points.
    points_per_entity, count
        Number of points of an entity, and of all points; a chunk has whole entities.
    r0
        Jets (points, sides * parts * 3) of the placement, in the cells' own coordinates.
    geometry
        (points, 4): p, q, s and the determinant of the cell's frame. On edges (points, 6
        sides): the frame of each side, then the covectors (2,) of the edge in the sides' own
        coordinates.
    values
        Function from a field that a density depends on to its values (points, components).
    log
        Log of compiled kernels.

    Attributes
    ----------
    _size
        Number of components of jets on all sides.
    _u, _v
        Point fields of the jets of u and v.
    _inputs
        What else is filled in for each chunk: placement, geometry, fields of the densities.
    _W, _work
        The energy of each term, and the virtual works of loads without potential.
    _conservative
        The energies of terms that have no virtual work.
    _points, _chunks
        Storage of the point fields, and slices of all points, one for each chunk.
    _names, _energies
        Names of the terms, and the kernels of their energies that have been made, by name.
    """

    def __init__(
        self,
        terms: Sequence[PointTerm],
        parts: Sequence[str],
        points_per_entity: int,
        count: int,
        r0: Memo[Array],
        geometry: Array,
        values: Callable[[fem.Function], Array],
        log: KernelLog,
    ) -> None:
        """Write the densities as expressions of point fields; kernels are made of them later."""
        self._size = terms[0].density.sides * len(parts) * 3
        chunk = max(CHUNK_POINTS // points_per_entity, 1) * points_per_entity
        self._chunks = [slice(first, min(first + chunk, count)) for first in range(0, count, chunk)]
        # point fields for the points of one chunk
        points = self._points = PointStorage(max(min(count, chunk), 1))
        self._u, placement, point_geometry = (
            points.field(size) for size in (self._size, self._size, geometry.shape[1])
        )
        self._inputs = [
            _KernelInput(placement, r0),
            _KernelInput(point_geometry, Memo(lambda: geometry, tuple)),
        ]
        self._names, self._log = [term.name for term in terms], log
        self._W, self._work, self._v = list[Expr](), list[Expr](), points.field(self._size)
        for term in terms:
            parameters, varying = parameters_at(points, term.density.parameters, term.density.sides)
            self._inputs += [
                _KernelInput(target, _field_values(field, values)) for target, field in varying
            ]
            fields = [placement, self._u]
            self._W.append(_energy(term.density, fields, point_geometry, parts, parameters))
            if term.density.work:  # with a third field its virtual work is returned
                fields = [placement, self._u, self._v]
                self._work.append(_energy(term.density, fields, point_geometry, parts, parameters))
        self._conservative = [
            W for W, term in zip(self._W, terms, strict=True) if not term.density.work
        ]
        self._energies: dict[str, PointKernel | None] = {}

    @cached_property
    def gradient(self) -> PointKernel | None:
        """Kernel of the gradient of the terms' sum, for `evaluate`; None if none depends on u."""
        # energies are differentiated by u, virtual works by v; what does not depend on that field
        # is left out
        sums = [
            (sum(self._conservative, ufl.zero()), self._u),
            (sum(self._work, ufl.zero()), self._v),
        ]
        sums = [(W, z) for W, z in sums if z in extract_coefficients(W)]
        if sums:
            return point_gradient(f"{', '.join(self._names)} gradient", sums, self._log)
        return None

    def energy(self, name: str) -> PointKernel | None:
        """Return the kernel of the named term's density, for `evaluate`; None if it is zero.

        Kernels are kept by name.
        """
        if name not in self._energies:
            W = self._W[self._names.index(name)]
            is_zero = isinstance(W, Zero)
            self._energies[name] = None if is_zero else point_values(f"{name} energy", W, self._log)
        return self._energies[name]

    def chunks(self) -> list[slice]:
        """Renew the inputs and return the chunks of points, to be evaluated one after the other."""
        for kernel_input in self._inputs:
            kernel_input.values.renew()
        return self._chunks

    def input_array(self, chunk: slice) -> Array:
        """Return the input array (points of the chunk, sides * parts * 3) for the jets of u.

        It is a view of the kernels' input: the caller writes derivatives by reference coordinates
        into it, before `evaluate`.
        """
        count = chunk.stop - chunk.start
        return np.asarray(self._u.x.array[: count * self._size].reshape(count, self._size))

    def evaluate(self, chunk: slice, kernel: PointKernel) -> Array:
        """Return a kernel's values at the points of a chunk, from the inputs that were filled in.

        They are in the order of `input_array`; the next call reuses the array.
        """
        for kernel_input in self._inputs:
            kernel_input.fill(chunk)
        return self._points.evaluate(kernel, chunk.stop - chunk.start)


@dataclass
class _KernelInput:
    """An input of a kernel besides u.

    Attributes
    ----------
    field
        Point field of the values in a chunk.
    values
        Values at all points.
    filled
        Chunk whose values are in the field, and their version; None before the first.
    """

    field: fem.Function
    values: Memo[Array]
    filled: tuple[slice, int] | None = None

    def fill(self, chunk: slice) -> None:
        """Copy the latest values of a chunk into the field, unless they are there already."""
        if self.filled != (chunk, self.values.version):
            fill(self.field, self.values.latest[chunk])
            self.filled = chunk, self.values.version


def _field_values(field: fem.Function, values: Callable[[fem.Function], Array]) -> Memo[Array]:
    """Return a memo of a field's values at all points."""
    return Memo(lambda: values(field), lambda: (memo_input(field),))


def in_own_coordinates(jet: Jet, frame: Sequence[Expr | Array]) -> Jet:
    """Return a jet in the cell's own coordinates, from one in reference coordinates.

    `frame` begins with p, q and s: d/dx = p d/dX and d/dy = q d/dX + s d/dY, with the cell's own
    coordinates x, y and those of the reference cell X, Y. Parts are UFL expressions or arrays.
    """
    p, q, s = frame[:3]
    return Jet(
        jet.r,
        p * jet.r1,
        q * jet.r1 + s * jet.r2,
        p * p * jet.r11,
        p * (q * jet.r11 + s * jet.r12),
        q * q * jet.r11 + 2 * q * s * jet.r12 + s * s * jet.r22,
    )


def _energy(
    density: Density,
    fields: Sequence[fem.Function],
    point_geometry: fem.Function,
    parts: Sequence[str],
    parameters: Sequence[fem.Constant | fem.Function],
) -> Expr:
    """Return a density, or its virtual work, per area of the reference cell.

    On edges it is per parameter of the edge, which runs from 0 to 1.

    Parameters
    ----------
    density
        The density.
    fields
        Point fields of r0 (in the cells' own coordinates), of u and perhaps of v (both in reference
        coordinates).
    point_geometry
        Point field of the frames; on edges, then the covectors of all sides.
    parts
        Names of the jet parts in the fields.
    parameters
        The density's parameters at points.
    """
    placement, *displacements = fields
    # frames and jets on each side
    sides = range(density.sides)
    frames = [_frame(point_geometry, side) for side in sides]
    r0_jets = [_jet(placement, side, parts) for side in sides]

    def own_jets(displacement: fem.Function) -> list[Jet]:
        """Return the jets of a displacement on each side, in the cells' own coordinates."""
        return [in_own_coordinates(_jet(displacement, side, parts), frames[side]) for side in sides]

    displacement_jets = [own_jets(displacement) for displacement in displacements]
    # the determinant in the frame turns an area of the flat cell into one of the reference cell
    if not density.on_edges:
        *_, determinant = frames[0]
        return determinant * density.value_at([r0_jets, *displacement_jets], None, parameters)
    first = FRAME_SIZE * density.sides  # the covectors follow the frames
    m = [
        ufl.as_vector([point_geometry[first + 2 * side], point_geometry[first + 2 * side + 1]])
        for side in sides
    ]
    areas = [frame[-1] / 2 for frame in frames]  # of the flat cells; an edge runs from 0 to 1
    return density.value_at([r0_jets, *displacement_jets], (m, areas), parameters)


def _frame(point_geometry: fem.Function, side: int) -> list[Expr]:
    """Return the frame on one side, from the point field of frames."""
    return [point_geometry[FRAME_SIZE * side + i] for i in range(FRAME_SIZE)]


def _jet(field: fem.Function, side: int, parts: Sequence[str]) -> Jet:
    """Return the jet on one side, from a point field of jet parts.

    Parts that are not known at the points are zero, since no density needs them.
    """
    first_entries = range(3 * len(parts) * side, 3 * len(parts) * (side + 1), 3)
    vectors = {
        part: ufl.as_vector([field[i], field[i + 1], field[i + 2]])
        for part, i in zip(parts, first_entries, strict=True)
    }
    return Jet(*(vectors.get(name, ufl.zero(3)) for name in JET_NAMES))
