"""Element matrices of terms: the Hessians of their densities at points, contracted in batches.

The densities are covariant, so the jets are taken in reference coordinates: the tables of the
shape functions are then the same for all cells.

- A jet is a vector field's value with its first and second derivatives by two coordinates: six
  vectors (`JET_SIZE`), in the order of `JET_NAMES`.
- r0 is the placement, u the displacement, v an addition to u; W is a density.
- Entities are cells, interior or boundary edges. A batch has entities with the same quadrature
  rule; "points" of a batch are the quadrature points of all its entities.
- A side is one of the cells beside a point: two on an interior edge, else one.
- A point field is a fem.Function whose values at the points of a batch are a kernel's input.
- A Hessian's block (3, 3) is the derivative by two parts of jets. To contract it is to multiply it
  with shape functions and sum over points.
- A `Memo` holds a value that is computed again (`renew`) when its inputs have changed.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields
from functools import partial, reduce
from itertools import combinations_with_replacement, product
from operator import or_

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.batches import Contraction, EntityBatch, HessianBlocks
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.memo import Memo, PointField, memo_input
from magshell_fenicsx.assembly.point_kernels import (
    BlockPairs,
    IndexPair,
    PointStorage,
    point_hessian,
)
from magshell_fenicsx.assembly.shape_tables import JET_SIZE
from magshell_fenicsx.models.shell.energy import Density, HessianTerm, Parameter, ShellTerm
from magshell_fenicsx.models.shell.kinematics import Jet, strain_components

PointTerm = ShellTerm | HessianTerm
Array = NDArray[np.float64]
JET_NAMES = tuple(f.name for f in fields(Jet))  # in the order of `reference.Table`
REFERENCE_AREA = 0.5  # of the triangle; an edge's parameter runs from 0 to 1
DERIVATIVE_RANK = (
    2,
    0,
    0,
    1,
    1,
    1,
)  # pairs of first derivatives come first: the terms' pairs are then neighbours


class HessianIntegral:
    """Integral of the Hessians of terms on the same entities: cells, interior or boundary edges.

    Parameters
    ----------
    r0
        The placement.
    batches
        Batches of this rank's entities, perhaps none.
    sides
        2 for interior edges, else 1.
    terms
        Terms with densities on these entities.
    log
        Log of compiled kernels.
    prestress
        The second variation under an additional membrane stress as a density, for `replace_strain`.
        Its first parameter that varies is the additional strain. None if the strain is never
        replaced.

    Attributes
    ----------
    coupling
        The batches of interior edges, which couple two cells; else empty.
    _u, _r0, _geometry
        Point fields of one batch at a time: the jets of u and of r0 on all sides; the covector of
        each side.
    _placements
        The jets of r0 at the points of each batch.
    _kernels, _prestress
        Kernels of the terms by name, and that of the additional stress.
    _replaced
        Whether `replace_strain` has been called for the next `add`.
    _coupled, _contractions
        Pairs of jet parts that any term couples, and their contraction for each quadrature rule.
    _points, _dofs, _sides
        Storage of the kernels' inputs, nodes (cells, functions) of the cells, and `sides`.
    """

    def __init__(
        self,
        r0: fem.Function,
        batches: list[EntityBatch],
        sides: int,
        terms: Sequence[PointTerm],
        log: KernelLog,
        prestress: Density | None = None,
    ) -> None:
        """Declare a kernel for each term, and a contraction for each quadrature rule."""
        V = r0.function_space
        self.batches, self._dofs, self._sides = batches, V.dofmap.list, sides
        self._points = PointStorage(max([1, *(batch.size for batch in batches)]))
        self._u, self._r0 = (self._points.field(3 * JET_SIZE * sides) for _ in range(2))
        self._geometry = self._points.field(2 * sides)
        self._placements = Memo(
            lambda: [self._jets(batch, r0.x.array) for batch in batches], lambda: (r0.x.array,)
        )
        self._kernels = {
            t.name: Kernel(
                t.name,
                t.density,
                self._points,
                batches,
                of_v=isinstance(t, HessianTerm) or bool(t.density.work),
            )
            for t in terms
        }
        self._prestress: Kernel | None = None
        if prestress:
            self._prestress = Kernel("prestress", prestress, self._points, batches, of_v=True)
        self._replaced = False
        for kernel in [*self._kernels.values(), *([self._prestress] if self._prestress else [])]:
            kernel.begin(self._u, self._r0, self._geometry, sides, log)
        self.coupling = batches if sides == 2 else []
        # pairs of jet parts that any term couples: one contraction serves all terms
        pairs = reduce(or_, (kernel.pairs for kernel in self._kernels.values()))
        pairs = BlockPairs(tuple(sorted(pairs.within_side, key=_neighbours)), pairs.cross)
        self._coupled = pairs
        rules = {batch.rule for batch in batches}
        self._contractions = {rule: Contraction(rule, pairs) for rule in rules}

    def add(
        self,
        u: Array,
        factors: Mapping[str, float],
        element_matrices: Array,
        couple: Callable[[int, Array], None],
    ) -> None:
        """Add the terms' element matrices at the displacement u.

        After `replace_strain`, the additional membrane stress is included; it serves one call.

        Parameters
        ----------
        u
            (dofs,) with ghosts.
        factors
            Factors of terms by name; terms without a factor are left out.
        element_matrices
            (local cells, 9, pairs a <= b of functions), to which the matrices are added: six
            symmetric and three skew parts of each block (3, 3).
        couple
            Is called for each batch of interior edges, with its number and the matrices that couple
            the two cells at its edges.
        """
        kernels = [
            (kernel, factors[name]) for name, kernel in self._kernels.items() if factors.get(name)
        ]
        placements = self._placements.renew()
        for kernel, _ in kernels:
            kernel.renew()
        for number, batch in enumerate(self.batches):
            # the kernels' inputs at the points of the batch
            fill(self._u, self._jets(batch, u))
            fill(self._r0, placements[number])
            fill(self._geometry, np.repeat(batch.geometry, len(batch.rule.weights), axis=0))
            # the weighted sum of all terms' Hessians
            blocks = HessianBlocks(batch, self._coupled)
            for kernel, factor in kernels:
                blocks.add(kernel.evaluate(number), factor, kernel.pairs)
            if self._replaced and self._prestress:
                blocks.add(self._prestress.evaluate(number), 1.0, self._prestress.pairs)
            # element matrices from these, within the cells on each side and between them
            contraction = self._contractions[batch.rule]
            for side, cells in enumerate(batch.cells):
                element_matrices[cells] += contraction.within_side(blocks, side)
            if self._sides == 2:
                couple(number, contraction.cross(blocks))
        self._replaced = False

    def replace_strain(
        self,
        u: Array,
        weighted_displacements: Sequence[tuple[float, Array]],
        excepted_cells: NDArray[np.bool_] | None = None,
    ) -> None:
        """Take the membrane stress of the next call of `add` from other displacements than u.

        The stress is then that of a weighted sum of their membrane strains. Only the difference
        from the strain of u enters, by the density `prestress`. Nothing happens without this
        density.

        Parameters
        ----------
        u
            (dofs,) the displacement, with ghosts.
        weighted_displacements
            Weights and displacements (dofs,).
        excepted_cells
            Flags (local cells,) of cells that keep the strain of u: their nodes move, and the other
            displacements do not know this motion.
        """
        if self._prestress is None:
            return
        placements = self._placements.renew()
        for number, (batch, r0) in enumerate(zip(self.batches, placements, strict=True)):
            # the weighted sum, less the strain of u
            strains = [
                w * _strain(r0, self._jets(batch, v))
                for w, v in (*weighted_displacements, (-1.0, u))
            ]
            strain = np.sum(strains, axis=0)
            if excepted_cells is not None:
                cells, points_per_cell = batch.cells[0], len(batch.rule.weights)
                strain[np.repeat(excepted_cells[cells], points_per_cell)] = 0.0
            self._prestress.vary(number, strain)
        self._prestress.renew()
        self._replaced = True

    def _jets(self, batch: EntityBatch, field: Array) -> Array:
        """Return the jets (points, sides, 6, 3) of a field (dofs,) at the points of a batch."""
        nodes = field.reshape(-1, 3)
        jets_of_sides = [
            t.jets(nodes[self._dofs[cells]])
            for t, cells in zip(batch.rule.tables, batch.cells, strict=True)
        ]
        return np.stack(jets_of_sides, axis=2)


class Kernel:
    """Kernel of the point Hessian of one term's density.

    Parameters
    ----------
    name
        Name of the term.
    density
        Its density.
    points
        Storage of the inputs at the points of a batch.
    batches
        Batches of entities.
    of_v
        True for a density of u and v, whose Hessian by v at v = 0 is taken; False for a density of
        u, whose Hessian by u is taken.

    Attributes
    ----------
    pairs
        Pairs of jet parts for which the Hessian has a block that is not zero.
    _parameters
        The density's parameters at points.
    _varying
        Pairs of a point field among these and its values on each batch.
    """

    def __init__(
        self,
        name: str,
        density: Density,
        points: PointStorage,
        batches: list[EntityBatch],
        *,
        of_v: bool,
    ) -> None:
        """Declare inputs for the density's parameters; fields are sampled at points in `renew`."""
        self._name, self._density, self._of_v = name, density, of_v
        self._points, self._batches = points, batches
        self._parameters, varying = parameters_at(points, density.parameters, density.sides)
        self._varying = [
            (target, on_batches(field, batches, density.sides)) for target, field in varying
        ]

    def begin(
        self, u: fem.Function, r0: fem.Function, geometry: fem.Function, sides: int, log: KernelLog
    ) -> None:
        """Declare the kernel; it is compiled at its first use.

        Parameters
        ----------
        u, r0
            Point fields with the jets of displacement and placement.
        geometry
            Point field with the covectors (2,) on all sides.
        sides
            Number of cells beside a point.
        """
        density, name, of_v = self._density, self._name, self._of_v
        self.pairs = _pairs(density)
        # z is what the density is differentiated by: v, or the jets of u
        z = self._points.field(3 * JET_SIZE) if of_v else u
        arguments = (r0, u, z) if of_v else (r0, u)
        jets = [_jets(field, sides) for field in arguments]
        # on edges: the covector on each side, and the area of the reference triangle
        m = [ufl.as_vector([geometry[2 * side], geometry[2 * side + 1]]) for side in range(sides)]
        edge = (m, [REFERENCE_AREA] * sides) if density.on_edges else None
        W = density.value_at(jets, edge, self._parameters)
        # W is then a virtual work w(u, v), linear in v. Half of its derivative by u along v is
        # quadratic in v, and has the symmetric part of that derivative as its Hessian.
        if density.work:
            W = ufl.dot(ufl.diff(W, u), z) / 2
        self._hessian = point_hessian(name, W, z, JET_SIZE, self.pairs, log, at_zero=of_v)

    def vary(self, number: int, values: Array) -> None:
        """Set the values of the first varying parameter at the points of batch `number`."""
        _, values_of_batches = self._varying[0]
        values_of_batches.renew()[number] = values

    def renew(self) -> None:
        """Renew the values of fields at the points of all batches."""
        for _, values in self._varying:
            values.renew()

    def evaluate(self, number: int) -> Array:
        """Return the Hessian's blocks, for the pairs of jet parts, at the points of a batch.

        `number` is the batch's position; the order of blocks is that of `point_hessian`. The point
        fields of r0, u and the geometry must hold the batch's values.
        """
        for target, values in self._varying:
            fill(target, values.latest[number])
        return self._points.evaluate(self._hessian, self._batches[number].size)


def _strain(r0: Array, u: Array) -> Array:
    """Return the membrane strain E_11, E_12, E_22 (points, 3) in reference coordinates.

    `r0` and `u` are jets (..., 6, 3) of placement and displacement.
    """
    # rows 1 and 2 of a jet are the first derivatives
    first0, first = (np.moveaxis(jets.reshape(-1, JET_SIZE, 3)[:, 1:3], 1, 0) for jets in (r0, u))
    return np.stack(strain_components(first0, first, partial(np.einsum, "pc,pc->p")), axis=1)


def _pairs(density: Density) -> BlockPairs:
    """Return the pairs of jet parts for which the density's Hessian has a block that is not zero.

    Two parts in which the density is linear have none. Parts are numbered as in `JET_NAMES`. Pairs
    on one side are listed once, pairs across an edge in both orders.
    """
    parts = [JET_NAMES.index(name) for name in density.parts]
    linear = [JET_NAMES.index(name) for name in density.linear]

    def coupled(pairs: Iterable[IndexPair]) -> tuple[IndexPair, ...]:
        """Return the pairs that are not both among the linear parts."""
        return tuple(p for p in pairs if not (p[0] in linear and p[1] in linear))

    within_side = coupled((min(p), max(p)) for p in combinations_with_replacement(parts, 2))
    return BlockPairs(within_side, coupled(product(parts, parts)) if density.sides == 2 else ())


def _neighbours(pair: IndexPair) -> tuple[int, IndexPair]:
    """Return a key that sorts pairs by highest derivative: a term's pairs are then adjacent."""
    return max(DERIVATIVE_RANK[pair[0]], DERIVATIVE_RANK[pair[1]]), pair


def _jets(field: fem.Function, sides: int) -> list[Jet]:
    """Return the jets on all sides from a point field."""
    return [_jet(field, side) for side in range(sides)]


def _jet(field: fem.Function, side: int) -> Jet:
    """Return the jet on one side (0 or 1) as UFL vectors, from a point field of jets on all sides.

    The field holds the six parts of the first side, three components each, then the second side's.
    """
    first_entries = range(3 * side * JET_SIZE, 3 * (side + 1) * JET_SIZE, 3)
    return Jet(*(ufl.as_vector([field[i], field[i + 1], field[i + 2]]) for i in first_entries))


def parameters_at(
    points: PointStorage, parameters: Sequence[Parameter], sides: int
) -> tuple[list[Parameter], list[tuple[fem.Function, fem.Function]]]:
    """Return a density's parameters at points, and the point fields that must be filled.

    Returns
    -------
    at_points
        A constant or a point field for each parameter. With two sides, a field holds the values of
        the first side, then those of the second.
    varying
        Pairs of a point field and the field on the mesh that gives its values.
    """
    at_points = [
        points.constant(p) if isinstance(p, fem.Constant) else points.field(sides * p.ufl_shape[0])
        for p in parameters
    ]
    pairs = zip(at_points, parameters, strict=True)
    return at_points, [(target, p) for target, p in pairs if isinstance(p, fem.Function)]


def at_points(field: fem.Function, X: Array, cells: NDArray[np.int32]) -> Array:
    """Return the values (cells * points, components) of a field on cells, at reference points.

    X (points, 2) are the same points in each of the cells. A `PointField` is known at its own
    points alone, and X is not used. The array that it returns for consecutive cells is a view,
    which follows later values.
    """
    if isinstance(field, PointField):
        return field.at_cells(cells)
    Q, size = field.function_space, field.ufl_shape[0]
    values = Q.element.basix_element.tabulate(0, X)[0, :, :, 0]
    nodal = field.x.array.reshape(-1, size)[Q.dofmap.list[cells]]
    return np.asarray(np.matmul(values, nodal)).reshape(-1, size)


def on_batches(
    field: fem.Function, batches: Sequence[EntityBatch], sides: int = 1
) -> Memo[list[Array]]:
    """Return a memo of a field's values (points, sides * components) on each batch."""
    return Memo(
        lambda: [_on_sides(field, batch, range(sides)) for batch in batches],
        lambda: (memo_input(field),),
    )


def _on_sides(field: fem.Function, batch: EntityBatch, sides: range) -> Array:
    """Return the values (points, sides * components) of a field at the points of a batch."""
    values = [at_points(field, batch.rule.points[side], batch.cells[side]) for side in sides]
    return np.hstack(values) if len(values) > 1 else values[0]


def fill(field: fem.Function, values: Array) -> None:
    """Copy values of the first points into a point field; other points are not used."""
    field.x.array[: values.size] = values.ravel()
