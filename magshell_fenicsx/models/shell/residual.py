"""Energies and residuals from densities and their gradients at points, without UFL forms.

In: terms (`PointTerm`: a name, an amplitude and a density). Out: a term's energy, and its residual
added to a vector. The derivatives of both by free parameters are computed in the same way.

- A jet is a vector field's value with its first and second derivatives by two coordinates; its
  parts have the names in `JET_NAMES`.
- r0 is the placement, u the displacement; W is a density, an energy per area or length.
- Nodal values are (cells, functions * 3): the displacements at the nodes of each cell.
- Element vectors are (cells, functions * 3) too: the derivatives of energies by nodal values.
- Factors are the numbers that multiply the terms, by name.
- An amplitude is a load parameter, by name, that multiplies a term; None stands for the factor 1.
- The frame of a cell are four numbers p, q, s and area (`cell_frames`). With X, Y the reference
  coordinates, d/dx = p d/dX and d/dy = q d/dX + s d/dY are derivatives in orthonormal coordinates
  of the cell; area is the Jacobian determinant.
- An edge has one side on the boundary, and two between cells.
- A kernel is a compiled function of the values at points. Points are evaluated in chunks (slices),
  since the arrays of a kernel have room for one chunk.
- A `Memo` holds a value that is computed again when its inputs change: `renew` returns it.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.batches import boundary_edges, interior_edges
from magshell_fenicsx.assembly.free_parameters import FreeParameter
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.memo import Memo
from magshell_fenicsx.assembly.point_kernels import PointKernel
from magshell_fenicsx.assembly.shape_tables import (
    PointSampling,
    ShapeTable,
    cell_frames,
    cell_rule,
    edge_covector,
    edge_rule,
)
from magshell_fenicsx.models.shell.element_hessians import JET_NAMES, at_points
from magshell_fenicsx.models.shell.energy import (
    Density,
    ShellTerm,
    cell_quadrature,
    edge_quadrature,
)
from magshell_fenicsx.models.shell.gradients import (
    FRAME_SIZE,
    PointGradient,
    PointTerm,
    in_own_coordinates,
)
from magshell_fenicsx.models.shell.kinematics import ALL_DERIVATIVES, FIRST_DERIVATIVES, Jet

Array = NDArray[np.float64]


class _ResidualPart(Protocol):
    """Terms on cells, or on edges, that are evaluated together."""

    names: list[str]

    def energy(self, nodal: Array, name: str) -> float:
        """Return the energy of the named term on this rank's part.

        `nodal` (cells, functions * 3) are the displacements of all local cells.
        """

    def begin(self, *, energies: bool) -> None:
        """Begin to compile the kernels of `add`; with `energies`, those of `energy` too."""

    def add(self, nodal: Array, factors: Mapping[str, float], elements: Array) -> None:
        """Add the element vectors (cells, functions * 3) of terms to `elements`.

        `factors` are by name; a term without one is left out. `nodal` (cells, functions * 3) are
        the displacements of all local cells.
        """


class FastResidual:
    """The residual of a sum of terms; an `assembly.terms.ResidualAssembler`.

    Terms on cells that share an amplitude also share a kernel: their geometry is found once.

    Parameters
    ----------
    r0, u
        The placement, and the displacement that the terms were written with.
    degree
        Degree of the elements.
    terms
        Terms with a density.
    log
        Log of compiled kernels.
    one_by_one
        Whether each term has a kernel of its own, so that it can be added alone.

    Attributes
    ----------
    names
        Names of the terms.

    The field `_parts` has the groups of terms that are evaluated together. `_nodes` (cells,
    functions) are the nodes of u in each cell; `_dofs` are the numbers of their components in the
    order of the element vectors.
    """

    def __init__(
        self,
        r0: fem.Function,
        u: fem.Function,
        degree: int,
        terms: Sequence[PointTerm],
        log: KernelLog,
        *,
        one_by_one: bool = False,
    ) -> None:
        """Group the terms: cells by quadrature and amplitude, then all edges."""
        cell_terms = [term for term in terms if not term.density.on_edges]
        edge_terms = [term for term in terms if term.density.on_edges]

        def kernel_key(term: PointTerm) -> tuple[int | None, str | None, str]:
            """Return a key: terms on cells with equal keys share a kernel.

            It is the degree of the quadrature (None for the usual one), the amplitude and, if each
            term is to have its own kernel, the name.
            """
            return term.density.quadrature, term.amplitude, term.name if one_by_one else ""

        residual_parts: list[_ResidualPart] = []
        for key in dict.fromkeys(map(kernel_key, cell_terms)):  # each key once, in order
            terms_of_kernel = [term for term in cell_terms if kernel_key(term) == key]
            quadrature, _, _ = key
            residual_parts.append(
                _CellTerms(r0, quadrature or cell_quadrature(degree), terms_of_kernel, log)
            )
        if edge_terms:
            residual_parts.append(_EdgeTerms(r0, edge_quadrature(degree), edge_terms, log))
        self._parts = residual_parts
        self.names = frozenset(term.name for term in terms)
        self._u, self._nodes = u, u.function_space.dofmap.list
        self._dofs = (3 * self._nodes[:, :, None] + np.arange(3)).ravel()

    def begin(self, *, energies: bool = False) -> None:
        """Begin to compile the kernels of the residual; with `energies`, those of energies too."""
        for part in self._parts:
            part.begin(energies=energies)

    def energy(self, name: str) -> float:
        """Return the energy of the named term on this rank's part, at the present u.

        The first call is collective: kernels are compiled.
        """
        part_with_term = next(part for part in self._parts if name in part.names)
        return part_with_term.energy(self._nodal(), name)

    def add(self, b: Array, factors: Mapping[str, float]) -> None:
        """Add the residual at the present u to the local vector b (ghosts included).

        Terms without an entry in `factors` are left out. The first call is collective: kernels are
        compiled.
        """
        nodal = self._nodal()
        elements = np.zeros_like(nodal)  # element vectors, to which all parts add
        for part in self._parts:
            part.add(nodal, factors, elements)
        b += np.bincount(self._dofs, elements.ravel(), len(b))

    def _nodal(self) -> Array:
        """Return the displacements (cells, functions * 3) at the nodes of each cell."""
        nodal = np.take(self._u.x.array.reshape(-1, 3), self._nodes, axis=0)
        return np.asarray(nodal.reshape(-1, 3 * self._nodes.shape[1]))


class _CellTerms:
    """Terms with one amplitude and one quadrature on the owned cells.

    The gradients of their densities are summed at each point before they are integrated.

    Parameters
    ----------
    r0
        The placement.
    degree
        Degree of the quadrature.
    terms
        The terms; their densities are on cells.
    log
        Log of compiled kernels.

    Attributes
    ----------
    _weights
        Weights of the quadrature on a cell.
    _sampling
        From nodal values to jets at points, and from gradients at points to element vectors.
    _points
        The densities and their gradients at the points: `gradient` and `energy(name)` are kernels,
        `input_array(chunk)` is the array in which they find the jets of u at a chunk of points.
    """

    def __init__(
        self, r0: fem.Function, degree: int, terms: Sequence[PointTerm], log: KernelLog
    ) -> None:
        """Prepare the sampling of u at the points of the owned cells, and the kernels there."""
        V = r0.function_space
        self.names = [term.name for term in terms]
        reference_points, self._weights = cell_rule(degree)
        points_per_cell = len(reference_points)
        table = ShapeTable.tabulate(V.element.basix_element, reference_points)
        # the first derivatives are always needed: the area of the surface is made of them
        jet_parts = _jet_parts_of(terms, FIRST_DERIVATIVES)
        self._sampling = PointSampling(
            table, self._weights, [JET_NAMES.index(part) for part in jet_parts]
        )
        cells = np.arange(V.mesh.topology.index_map(2).size_local, dtype=np.int32)  # owned ones
        frames = cell_frames(V.mesh)
        count = len(cells) * points_per_cell

        def placement() -> Array:
            """Return the placement's jets (points, parts * 3) at the points of the owned cells."""
            all_cells = _placement(r0, table, frames, jet_parts)
            return all_cells[cells].reshape(count, 3 * len(jet_parts))

        self._points = PointGradient(
            terms,
            jet_parts,
            points_per_entity=points_per_cell,
            count=count,
            r0=Memo(placement, lambda: (r0.x.array,)),
            geometry=np.repeat(frames[cells], points_per_cell, axis=0),
            values=lambda field: at_points(field, reference_points, cells),
            log=log,
        )

    def begin(self, *, energies: bool) -> None:
        """Begin to compile the gradient's kernel; with `energies`, those of energies too."""
        # reading a kernel begins its compilation; the values are not used here
        _ = self._points.gradient, [self._points.energy(name) for name in self.names if energies]

    def energy(self, nodal: Array, name: str) -> float:
        """Return the energy of the named term on the owned cells."""
        if (kernel := self._points.energy(name)) is None:
            return 0.0
        total = 0.0
        for chunk, _ in self._chunks_with_displacement(nodal):
            # (cells of the chunk, points) the density at the points of each cell
            values = self._points.evaluate(chunk, kernel).reshape(-1, len(self._weights))
            total += float(np.sum(values @ self._weights))
        return total

    def add(self, nodal: Array, factors: Mapping[str, float], elements: Array) -> None:
        """Add the element vectors of all terms to `elements` (cells, functions * 3).

        The terms have one amplitude, so that the factor of the first one holds for all.
        """
        factor = factors.get(self.names[0], 0.0)
        if not factor or (kernel := self._points.gradient) is None:
            return
        for chunk, cells in self._chunks_with_displacement(nodal):
            gradients = self._points.evaluate(chunk, kernel)
            elements[cells] += factor * self._sampling.at_nodes(gradients)

    def _chunks_with_displacement(self, nodal: Array) -> Iterator[tuple[slice, slice]]:
        """Yield each chunk of points and its cells, as slices.

        When a chunk is yielded, the jets of u at its points are in the input of the kernels.
        """
        points_per_cell = len(self._weights)
        for chunk in self._points.chunks():
            cells = slice(chunk.start // points_per_cell, chunk.stop // points_per_cell)
            self._sampling.at_points(nodal[cells], self._points.input_array(chunk))
            yield chunk, cells


class _EdgeTerms:
    """Terms on edges, interior and boundary.

    The jets on the edges of all cells are computed together, three edges for each cell.

    Parameters
    ----------
    r0
        The placement.
    degree
        Degree of the quadrature along edges.
    terms
        The terms; their densities are on edges.
    log
        Log of compiled kernels.

    Attributes
    ----------
    _weights
        Weights of the quadrature on an edge.
    _width
        Number of components of a jet.
    _sampling
        From nodal values to jets at the points of all cells' edges, and from gradients there to
        element vectors.
    _displacement_jets, _gradients
        (points of all cells' edges, `_width`): the jets of u, and gradients of the energy by them.
    _points_of_terms
        Name of a term -> rows (points, sides) of its points among these, and its density there.
    """

    def __init__(
        self, r0: fem.Function, degree: int, terms: Sequence[PointTerm], log: KernelLog
    ) -> None:
        """Prepare the sampling of u on the edges of all cells, and the kernels of each term."""
        V = r0.function_space
        self.names = [term.name for term in terms]
        reference_points, self._weights = _rule_on_three_edges(degree)
        points_per_edge, all_weights = len(self._weights), np.tile(self._weights, 3)
        table = ShapeTable.tabulate(V.element.basix_element, reference_points)
        jet_parts = _jet_parts_of(terms, ALL_DERIVATIVES)
        self._width = 3 * len(jet_parts)
        self._sampling = PointSampling(
            table, all_weights, [JET_NAMES.index(part) for part in jet_parts]
        )
        frames, cells = cell_frames(V.mesh), np.arange(len(V.dofmap.list), dtype=np.int32)
        self._displacement_jets, self._gradients = (
            np.empty((len(cells) * len(reference_points), self._width)) for _ in range(2)
        )
        self._points_of_terms = dict[str, tuple[NDArray[np.intp], PointGradient]]()
        # of each term the rows of its points, and the geometry there
        rows_and_geometry = {
            term.name: _points_on_edges(V, term.density, frames, points_per_edge) for term in terms
        }

        def placements() -> dict[str, Array]:
            """Return the placement's jets (points, sides * parts * 3) of each term, by name.

            They are computed on all cells' edges at once, then picked for each term.
            """
            all_jets = _placement(r0, table, frames, jet_parts).reshape(-1, self._width)
            return {
                name: _on_sides(all_jets, rows) for name, (rows, _) in rows_and_geometry.items()
            }

        def inputs() -> tuple[Array]:
            """Return the array whose change makes placements outdated."""
            return (r0.x.array,)

        all_placements = Memo(placements, inputs)
        for term in terms:
            rows, geometry = rows_and_geometry[term.name]

            def values(field: fem.Function, rows: NDArray[np.intp] = rows) -> Array:
                """Return a field's values (points, sides * components) at the points of a term."""
                return _on_sides(at_points(field, reference_points, cells), rows)

            points = PointGradient(
                [term],
                jet_parts,
                points_per_entity=points_per_edge,
                count=len(rows),
                r0=Memo(partial(lambda name: all_placements.renew()[name], term.name), inputs),
                geometry=geometry,
                values=values,
                log=log,
            )
            self._points_of_terms[term.name] = rows, points

    def begin(self, *, energies: bool) -> None:
        """Begin to compile the gradients' kernels; with `energies`, those of energies too."""
        # reading a kernel begins its compilation; the values are not used here
        for name, (_, points) in self._points_of_terms.items():
            _ = points.gradient, points.energy(name) if energies else None

    def energy(self, nodal: Array, name: str) -> float:
        """Return the energy of the named term on its edges."""
        self._sampling.at_points(nodal, self._displacement_jets)
        _, points = self._points_of_terms[name]
        kernel, total = points.energy(name), 0.0
        for _, values in self._evaluated(name, kernel):
            at_edges = values.reshape(-1, len(self._weights))  # (edges of the chunk, points)
            total += float(np.sum(at_edges @ self._weights))
        return total

    def add(self, nodal: Array, factors: Mapping[str, float], elements: Array) -> None:
        """Add the element vectors of the terms that have a factor to `elements`.

        The gradients of all terms at points of edges are added in `_gradients`, where each side of
        an edge has the rows of its own cell. One product with the shape functions then turns them
        into element vectors.
        """
        active = [name for name in self.names if factors.get(name)]
        if not active:
            return
        self._sampling.at_points(nodal, self._displacement_jets)
        self._gradients[:] = 0
        for name in active:
            _, points = self._points_of_terms[name]
            for numbers, values in self._evaluated(name, points.gradient):
                self._gradients[numbers] += factors[name] * values.reshape(-1, self._width)
        elements += self._sampling.at_nodes(self._gradients)

    def _evaluated(
        self, name: str, kernel: PointKernel | None
    ) -> Iterator[tuple[NDArray[np.intp], Array]]:
        """Yield pairs (numbers, values) of a kernel at the points of a term's edges, by chunks.

        The numbers say where the points of the chunk, on all sides, are among the points of all
        cells' edges. Nothing is yielded for the kernel None, of a density that is zero.
        """
        if kernel is None:
            return
        rows, points = self._points_of_terms[name]
        for chunk in points.chunks():
            numbers = rows[chunk].ravel()
            # the jets of u are copied into the kernel's input
            kernel_input = points.input_array(chunk).reshape(len(numbers), -1)
            np.take(self._displacement_jets, numbers, axis=0, out=kernel_input, mode="clip")
            yield numbers, points.evaluate(chunk, kernel)


def _rule_on_three_edges(degree: int) -> tuple[Array, Array]:
    """Return points (3 n, 2) on the reference triangle's edges, and weights (n,) on one edge.

    The points of the three edges come one after the other; all edges have the same weights.
    """
    rules = [edge_rule(degree, edge, is_reversed=False) for edge in range(3)]
    _, weights = rules[0]
    return np.concatenate([points for points, _ in rules]), weights


def _jet_parts_of(terms: Sequence[PointTerm], always: Sequence[str]) -> list[str]:
    """Return the parts of jets that some terms need, and those that are `always` needed.

    They are in the order of `JET_NAMES`.
    """
    needed = {*always, *(name for term in terms for name in term.density.jet_parts)}
    return [name for name in JET_NAMES if name in needed]


def _on_sides(values: Array, rows: NDArray[np.intp]) -> Array:
    """Return values (points, sides * size) on all sides of points, from values (rows, size).

    `rows` (points, sides) are the rows of each point on its sides.
    """
    return values[rows].reshape(len(rows), rows.shape[1] * values.shape[1])


def _placement(r0: fem.Function, table: ShapeTable, frames: Array, parts: Sequence[str]) -> Array:
    """Return the named parts (local cells, points, parts, 3) of the placement's jet.

    Derivatives are by the cells' own orthonormal coordinates. `table` has the shape functions at
    the points of the reference cell, `frames` (cells, 4) are `cell_frames`.
    """
    nodes = r0.x.array.reshape(-1, 3)[r0.function_space.dofmap.list]
    by_reference_coordinates = Jet(*np.moveaxis(table.jets(nodes), 2, 0))
    frame = [numbers[:, None, None] for numbers in frames.T]  # for all points and components
    jet = in_own_coordinates(by_reference_coordinates, frame)
    return np.stack([getattr(jet, part) for part in parts], axis=2)


def _points_on_edges(
    V: fem.FunctionSpace, density: Density, frames: Array, points_per_edge: int
) -> tuple[NDArray[np.intp], Array]:
    """Return where a density's points are among those of all cells' edges, and their geometry.

    The two cells at an interior edge number its points from opposite ends. A rule on an edge is
    symmetric, so that the points of one side are those of the other in the opposite order.

    Parameters
    ----------
    V
        Space of the displacement.
    density
        Density on interior edges, or on its boundary edges.
    frames
        (cells, 4) of all local cells, from `cell_frames`.
    points_per_edge
        Number of points of the rule.

    Returns
    -------
    rows
        (points, sides) numbers of the points, counted cell by cell and edge by edge.
    geometry
        (points, 6 sides): the frame of each side, then the covector of each side.
    """
    # cells and local numbers of the edges, (edges, sides) each; the second side may be reversed
    if density.facets is None:
        cells, edges, backwards = interior_edges(V)
        is_reversed = np.column_stack([np.zeros_like(backwards), backwards])
    else:
        cells, edges = boundary_edges(V, density.facets)
        is_reversed = np.zeros(cells.shape, dtype=bool)
    # (edges, points, sides): the number of a point within its edge, then among all points
    forwards = np.arange(points_per_edge)
    order = np.where(is_reversed[:, None], forwards[::-1, None], forwards[:, None])
    first_of_edge = points_per_edge * (3 * cells + edges)
    rows = first_of_edge[:, None] + order
    # covectors of the reference triangle's edges (two components), taken to the cells' own
    # coordinates as derivatives are; they are normal to the edge and as long as it
    p, q, s, area = frames[cells].transpose(2, 0, 1)
    first, second = np.array([edge_covector(edge) for edge in range(3)])[edges].transpose(2, 0, 1)
    m = np.stack([area * p * first, area * (q * first + s * second)], axis=2)
    # all points of an edge have the same geometry
    columns = [
        frames[cells].reshape(-1, FRAME_SIZE * density.sides),
        m.reshape(-1, 2 * density.sides),
    ]
    geometry = np.repeat(np.concatenate(columns, axis=1), points_per_edge, axis=0)
    return rows.reshape(-1, density.sides), geometry


Serve = Callable[[Sequence[PointTerm]], FastResidual]


@dataclass
class ParameterDerivative:
    """A term's derivative by a free parameter, or by two, as a term of its own.

    Attributes
    ----------
    name, amplitude
        Name, and amplitude of the term; None without one.
    density
        Derivative of the density.
    points
        Computes its integral and residual. It is set after the object is made, since the
        derivatives of several terms share it.
    """

    name: str
    amplitude: str | None
    density: Density
    points: FastResidual = field(init=False)

    def energy(self) -> float:
        """Return the derivative's integral on this rank's part, at the present u."""
        return self.points.energy(self.name)

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None:
        """Add factor times its derivative by u to the local vector b (ghosts included)."""
        self.points.add(b, {self.name: factor})


def point_parameters(
    constants: Mapping[str, fem.Constant], terms: Sequence[ShellTerm], serve: Serve
) -> dict[str, FreeParameter]:
    """Return the free parameters of a shell, by name; collective.

    A `FreeParameter` holds the constant p, the terms dPi/dp, and a function from another constant
    q to the terms d2Pi/dp dq.

    Parameters
    ----------
    constants
        Name -> the parameter as it stands in the densities.
    terms
        All terms.
    serve
        Function from terms to a `FastResidual` that can add each of them alone.
    """
    parameters = {}
    for name, p in constants.items():
        term_slopes = slopes(p, terms, f"by {name}", serve)
        # derivatives of several terms may share a residual, of which the compilation begins once
        for residual in {id(slope.points): slope.points for slope in term_slopes}.values():
            residual.begin()
        # a function of another constant q, which gives the derivatives of these terms by q
        slopes_by_another = partial(slopes, terms=term_slopes, words="twice", serve=serve)
        parameters[name] = FreeParameter(p, term_slopes, slopes_by_another)
    return parameters


def slopes(
    p: fem.Constant, terms: Sequence[PointTerm], words: str, serve: Serve
) -> list[ParameterDerivative]:
    """Return the derivatives by a parameter p of the terms whose densities depend on it.

    A derivative is named after its term, followed by `words`. `serve` is a function from terms to a
    `FastResidual` that can add each of them alone.
    """

    def depends_on_p(term: PointTerm) -> bool:
        """Return whether p is a parameter of a term's density."""
        return any(q is p for q in term.density.parameters)

    terms_with_p = [term for term in terms if depends_on_p(term)]
    derivatives = [
        ParameterDerivative(f"{term.name} {words}", term.amplitude, derivative_by(term.density, p))
        for term in terms_with_p
    ]
    residual = serve(derivatives) if derivatives else None  # one for all of them
    for derivative in derivatives:
        assert residual
        derivative.points = residual
    return derivatives


def derivative_by(density: Density, p: fem.Constant) -> Density:
    """Return the density's derivative by one of its parameters p.

    The result has no virtual work, and no parts of jets in which it is known to be linear.
    """

    def derivative(*arguments: Any) -> Expr:
        """Return the derivative at the density's arguments.

        The parameter p may stand at several positions among these: one variable takes all of them.
        """
        # the positions of p among the arguments, of which the parameters are the last ones
        first = len(arguments) - len(density.parameters)
        positions = [first + i for i, q in enumerate(density.parameters) if q is p]
        variable = ufl.variable(arguments[positions[0]])
        substituted = [
            variable if i in positions else argument for i, argument in enumerate(arguments)
        ]
        return ufl.algorithms.expand_derivatives(ufl.diff(density.function(*substituted), variable))

    return replace(density, function=derivative, work=None, linear=())
