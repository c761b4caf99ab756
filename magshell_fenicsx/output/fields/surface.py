"""The deformed mid-surface gathered on rank 0, for pictures and for ParaView."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import basix
import basix.ufl
import numpy as np
import scipy
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_vtk
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.mesh.mirror import Mirror, Sector, rotation
from magshell_fenicsx.mesh.patch import Deviation
from magshell_fenicsx.models.shell.law import Law, OfShells
from magshell_fenicsx.models.shell.patterns import inside
from magshell_fenicsx.output.fields.point_fields import PointFields, Stresses, rubber_fields
from magshell_fenicsx.output.fields.recovery import RecoveredShell, six, smooth_parts, split
from magshell_fenicsx.shape.drawn_bodies import Solid

if TYPE_CHECKING:  # one of them is built
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel

TRIANGLE, LAGRANGE_TRIANGLE, LAGRANGE_HEXAHEDRON = 5, 69, 72  # VTK's numbers of cell types
HEXAHEDRON_NODES = 27
SAMPLED, OF_MANY = (
    6,
    4,
)  # degree of the rule whose points are samples of strains and moments, at least; of many
MANY = 20_000  # cells, whose recovery would take a quarter of a gigabyte
GAP = "gap_over_h"  # to the faces of bodies, and of other parts of the shell: the least in a cell
# of bodies and of parts of the shell, over E h/R; nan where cells are too wide
PRESSURE = "contact_pressure"
RESOLVED, RESOLVED_PRESSURE, GAP_OPEN = (
    "evenly_pressed",
    "pressure_of_even",
    "open",
)  # see `add_contact`
LARGEST_CLOSED_GAP = 1e-2  # over h
SHELL = "shell"  # the number of the shell, where there are several
W0 = "w0_over_h"  # the imperfections: the deviation of the drawn surface from the perfect one
BOTH_WAYS = {
    "Br",
    "Ba",
    "J",
}  # a half shell's fields may be symmetric or antisymmetric to its plane
ON_PLANE = 1e-9  # over R
NEAREST, FLAT = (
    12,
    1e-2,
)  # nodes of a linear fit, and directions without any extent that it leaves out
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """Nodes of the whole mid-surface or of a whole solid; lengths are over R.

    Attributes
    ----------
    r0, u, n0
        (n, 3) undeformed placement, displacement, undeformed normal.
    cells
        (m, k) node numbers of triangles of the displacement's degree or of hexahedra, in VTK's
        order.
    fields
        Name -> (n,), (n, 3) or (n, 3, 3): E, M as tensors in space, tangent to the undeformed
        surface, and E_total where there is a natural shape (see `stresses.Stresses`); E_1, E_2,
        M_1, M_2, their principal values, the larger first; those of `point_fields.PointFields`;
        w0_over_h where there are imperfections, of a solid that alone.
    outlines
        Places (n, 3) along lines: the sources of the applied field, and bodies.
    jump
        By how much the cells' own bending moments differ from the smooth field M, over their size
        (see `jump`). None of a solid.
    strain_jump
        The same of the strains E.
    solids
        The faces of those.
    shells
        The names of several shells, in the order of their numbers in the field `shell`; nodes of
        two are double.
    """

    r0: Array
    u: Array
    n0: Array
    cells: NDArray[np.int64]
    fields: dict[str, Array]
    outlines: tuple[Array, ...] = ()
    jump: float | None = None
    strain_jump: float | None = None
    solids: tuple[Solid, ...] = ()
    shells: tuple[str, ...] = ()

    @property
    def is_body(self) -> bool:
        """Whether the cells are hexahedra."""
        return self.cells.shape[1] == HEXAHEDRON_NODES

    @property
    def w(self) -> Array:
        """Inward normal displacement -u . n0 over R, (n,)."""
        return np.asarray(-np.einsum("ij,ij->i", self.u, self.n0))


class SurfaceGatherer:
    """Gathers displacements and fields of one shell; constant fields are computed and gathered
    once.

    Strains and moments are recovered from samples inside the cells, in each smooth part of the
    surface; all else is the mean of the cells that share a node.
    """

    def __init__(self, model: "ShellModel") -> None:
        self._model = model
        domain, degree = model.V.mesh, model.degree
        self.comm = domain.comm
        # VTK's nodes are equidistant, the displacement's are not; their numbers on edges and in
        # cells are equal
        self._element = basix.create_element(
            basix.ElementFamily.P, basix.CellType.triangle, degree, basix.LagrangeVariant.equispaced
        )
        self._places = self._element.points
        cells = domain.topology.index_map(2)
        sampled = SAMPLED if cells.size_global < MANY else OF_MANY
        self._inner, self._rule = basix.make_quadrature(
            basix.CellType.triangle, max(sampled, degree)
        )
        self._owned = cells.size_local
        V = fem.functionspace(
            domain, basix.ufl.wrap_element(self._element)
        )  # numbers each shared node once
        local = V.dofmap.list[: self._owned]
        numbers = V.dofmap.index_map.local_to_global(local.ravel().astype(np.int32)).reshape(
            local.shape
        )
        self._recovered: RecoveredShell | None = None
        undeformed = model.system.at_state(State(model.zero(), {}))
        undeformed.evaluate(lambda: self._take_placement({}, self._gathered(numbers)))

    def _take_placement(
        self, mu: Mapping[str, float], numbers: NDArray[np.int64] | None = None
    ) -> None:
        """What depends on the placement, at amplitudes of imperfections that grow; at first given
        the nodes.
        """
        model, loads = self._model, self._model.loads
        r, inner = self._jet(model.r0, self._places), self._jet(model.r0, self._inner)
        thick, thick_inside = (self._thickness(at) for at in (self._places, self._inner))
        others = loads.contacts, loads.remanence, loads.natural
        self._fields = PointFields(
            r, model.material, loads.magnetic, thick, *others, self._made_of()
        )
        self._stresses = Stresses(
            inner, model.material, thick_inside, loads.natural, self._made_of()
        )
        self._six = six(self._stresses.frame)
        if numbers is not None:
            self._number(numbers, r[0], inner[0])
        self._mean = self._weighted_mean()
        deviation = model.midsurface.deviation(self._places, grown(loads.growing, mu))
        if deviation is not None:
            self._fields.constant[W0] = np.asarray(deviation[: self._owned] / model.material.h)
        if self._model.midsurface.shells:
            self._fields.constant[SHELL] = self._shell_of()
        n0 = self._averaged(self._fields.n0)
        self._r0, self._n0 = self._averaged(r[0]), n0 / np.linalg.norm(n0, axis=-1)[..., None]
        self._constant = {
            name: self._averaged(values) for name, values in self._fields.constant.items()
        }

    def _number(self, numbers: NDArray[np.int64], r: Array, inner: Array) -> None:
        """Take the nodes of all cells, split between smooth parts, and the recovery on them."""
        loads, fields = self._model.loads, self._fields
        given = [
            fields.Br,
            fields.susceptibility,
            *(loads.natural.at(inside(r), fields.n0) if loads.natural else ()),
        ]
        thickness = self._thickness(self._places)
        given += [self._shell_of()] if self._model.midsurface.shells else []
        if isinstance(self._model.material.law, OfShells) and (own := self._made_of()) is not None:
            given.append(np.repeat(own[:, None, 3], r.shape[1], axis=1))
        given = [
            self._gathered(f)
            for f in (*given, *(() if thickness is None else (thickness,)))
            if f.size
        ]
        r, n0, inner, weight = (
            self._gathered(f) for f in (r, fields.n0, inner, self._stresses.frame.area * self._rule)
        )
        self._numbers = numbers
        if self.comm.rank:
            return
        sides = np.array(self._element.entity_closure_dofs[1])
        self._numbers = split(numbers, smooth_parts(numbers, sides, given, n0))
        self._cells = self._numbers[
            :, np.argsort(perm_vtk(mesh.CellType.triangle, numbers.shape[1]))
        ]
        table = self._element.tabulate(0, self._inner)[0, :, :, 0]
        self._recovered = RecoveredShell(
            self._numbers, self._places, r, n0, inner, weight, table, self._model.degree
        )

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """The displaced surface with its fields at the amplitudes mu, on rank 0; None on other
        ranks.
        """
        state = State(u, dict(mu or {}))
        return self._model.system.at_state(state).evaluate(lambda: self._drawn(state))

    def _drawn(self, state: State) -> Surface | None:
        """The surface at the displacement and the placement that are set."""
        if self._model.growing:
            self._take_placement(state.mu)
        jet = self._jet(self._model.u, self._places, 1)
        values = self._fields.of(jet, state.mu)
        if state.mu:
            nodes_of_cell = len(self._places)
            add_contact(
                values,
                self._model,
                state,
                lambda of_cells: np.repeat(of_cells[: self._owned, None], nodes_of_cell, axis=1),
            )
        averaged = {name: self._averaged(each) for name, each in values.items()}
        nodes, law = self._averaged(jet[0]), self._law_at_nodes()
        stresses = self._stresses.of(self._jet(self._model.u, self._inner), state.mu)
        tensors = {
            name: self._gathered(np.einsum("...ia,...a->...i", self._six, S))
            for name, S in stresses.items()
        }
        if not self._recovered:
            return None
        smooth, jumps = self._recovered.fields(tensors, self._n0)
        fields = self._constant | smooth | rubber_fields(smooth, law) | averaged
        fields = resolved_pressure(self._cells, fields)
        names = self._model.midsurface.shells
        return Surface(
            self._r0, nodes, self._n0, self._cells, fields, (), jumps["M"], jumps["E"], shells=names
        )

    def _shell_of(self) -> Array:
        """The number of its shell at the nodes of each owned cell."""
        midsurface = self._model.midsurface
        inside = [midsurface.patches[name][: self._owned] for name in midsurface.shells]
        return np.repeat(
            np.argmax(inside, axis=0)[:, None].astype(np.float64), len(self._places), axis=1
        )

    def _gathered(self, values: NDArray[Any]) -> NDArray[Any]:
        """Values of all ranks' cells on rank 0, elsewhere those of its own."""
        parts = self.comm.gather(values)
        return values if self.comm.rank else np.concatenate(parts)

    def _jet(self, f: fem.Function, at: Array, order: int = 2) -> Array:
        """f, f,_1, f,_2, f,_11, f,_12, f,_22 in reference coordinates at points of each owned cell,
        up to an order.
        """
        table = self._model.V.element.basix_element.tabulate(order, at)[:, :, :, 0]
        coefficients = f.x.array.reshape(-1, 3)[self._model.V.dofmap.list[: self._owned]]
        return np.asarray(np.matmul(table[:, None], coefficients))

    def _thickness(self, at: Array) -> Array | None:
        """h(x)/h at points of each owned cell, if it varies."""
        factor = self._model.thickness
        if factor is None:
            return None
        V = factor.function_space
        values = V.element.basix_element.tabulate(0, at)[0, :, :, 0]
        return np.asarray(factor.x.array[V.dofmap.list[: self._owned]] @ values.T)

    def _made_of(self) -> Array | None:
        """The material of each owned cell, where shells have their own."""
        own = self._model.made_of
        return (
            None
            if own is None
            else own.x.array.reshape(-1, 4)[own.function_space.dofmap.list[: self._owned, 0]]
        )

    def _law_at_nodes(self) -> Law:
        """Collective; on rank 0 with arrays (nodes,)."""
        own, law = self._made_of(), self._model.material.law
        if own is None:
            return law
        e, nu, _, which = (
            self._averaged(np.repeat(each[:, None], len(self._places), axis=1)) for each in own.T
        )
        return law.made_of(e, nu, which)

    def _weighted_mean(self) -> "scipy.sparse.csr_matrix | None":
        """The matrix of the mean of the cells that share a node, weighted by area, from the nodes
        of all cells.
        """
        weights = self._gathered(self._fields.weight).ravel()
        if self.comm.rank:
            return None
        where = self._numbers.ravel()
        share = weights / np.bincount(where, weights)[where]
        return scipy.sparse.csr_matrix((share, (where, np.arange(len(where)))))

    def _averaged(self, values: Array) -> Array:
        """Weighted mean over the cells that share a node, on rank 0."""
        whole = self._gathered(values)
        if self._mean is None:
            return values
        return np.asarray(self._mean @ whole.reshape(self._mean.shape[1], -1)).reshape(
            -1, *values.shape[2:]
        )


def add_contact(
    values: dict[str, Array],
    model: "ShellModel | MeridianModel",
    state: State,
    at_nodes: Callable[[Array], Array],
) -> None:
    """Add the contact pressure and the gap between shells to fields at the nodes of cells;
    collective.

    Beside the pressure it adds what `resolved_pressure` takes out again: `RESOLVED`, one in a cell
    that is pressed all over; `RESOLVED_PRESSURE`, the pressure of such a cell; `GAP_OPEN`, one
    where there is a gap to a body.

    Parameters
    ----------
    values
        Name -> (cells, nodes of a cell). The gap to bodies is there already, over h.
    at_nodes
        Makes (cells, nodes of a cell) of a value of each local cell.
    """
    pressure = model.cell_pressures(state)
    if pressure is not None:
        resolved = at_nodes(model.cells_evenly_pressed(state).astype(np.float64))
        gap_to_bodies = values.get(GAP, np.zeros(resolved.shape))
        values[PRESSURE] = at_nodes(pressure)
        values[RESOLVED] = resolved
        values[RESOLVED_PRESSURE] = values[PRESSURE] * resolved
        values[GAP_OPEN] = np.where(gap_to_bodies > LARGEST_CLOSED_GAP, 1.0, 0.0)
    gap = model.cell_gaps(state)
    if gap is not None:
        gap_of_shells = at_nodes(gap) / model.material.h
        values[GAP] = np.minimum(values.get(GAP, np.inf), gap_of_shells)


def resolved_pressure(cells: NDArray[np.int64], fields: dict[str, Array]) -> dict[str, Array]:
    """Return the fields with the contact pressure where the mesh resolves it, and nan where not.

    In a cell that is pressed in part its mean is no pressure. Beside one that is pressed all over
    it is the edge of that zone, which ends where the gap is open; by itself it may be any part of
    what presses there.

    Parameters
    ----------
    cells
        (m, k) node numbers.
    fields
        At nodes, the means of the cells that meet there, as `add_contact` makes them.
    """
    if PRESSURE not in fields:
        return fields
    auxiliary = {RESOLVED, RESOLVED_PRESSURE, GAP_OPEN}
    drawn = {name: values for name, values in fields.items() if name not in auxiliary}
    in_zone = fields[RESOLVED] > 0
    in_zone_or_edge = in_zone.copy()
    in_zone_or_edge[cells[in_zone[cells].any(axis=1)]] = True
    pressure_in_zone = fields[RESOLVED_PRESSURE] / np.where(in_zone, fields[RESOLVED], 1.0)
    edge_is_open = in_zone_or_edge & (fields[GAP_OPEN] > 0)
    pressure_outside = np.where(edge_is_open, 0.0, drawn[PRESSURE])
    pressure = np.where(in_zone, pressure_in_zone, pressure_outside)
    drawn[PRESSURE] = np.where((pressure > 0) & ~in_zone_or_edge, np.nan, pressure)
    return drawn


def grown(growing: Mapping[str, tuple[Deviation, ...]], mu: Mapping[str, float]) -> list[Deviation]:
    """Imperfections that grow, at their amplitudes."""

    def times(deviation: Deviation, factor: float) -> Deviation:
        return lambda places: factor * deviation(places)

    return [
        times(deviation, mu.get(name, 0.0)) for name, each in growing.items() for deviation in each
    ]


def turned(surface: Surface, azimuth: float) -> Surface:
    """The surface rotated about e3 by an angle in rad: from the model's frame to the user's."""
    return _moved(surface, rotation(azimuth))


def completed(surface: Surface, mirror: Array) -> Surface:
    """A half surface together with its mirror image.

    `mirror` is the plane's unit normal (3,), followed by its offset if that is not zero. Seen from
    outside, the image's triangles have the opposite orientation.
    """
    normal, offset = mirror[:3], float(mirror[3:].sum())
    image = _moved(surface, np.eye(3) - 2 * np.outer(normal, normal))
    image = replace(image, r0=image.r0 + 2 * offset * normal)

    sign = _parity(surface, normal, offset)
    for name in BOTH_WAYS & surface.fields.keys():
        image.fields[name] *= sign

    def both(f: Array, other: Array) -> Array:
        return np.concatenate([f, other])

    return Surface(
        both(surface.r0, image.r0),
        both(surface.u, image.u),
        both(surface.n0, image.n0),
        np.concatenate([surface.cells, surface.cells + len(surface.r0)]),
        {name: both(f, image.fields[name]) for name, f in surface.fields.items()},
        surface.outlines,
        surface.jump,
        surface.strain_jump,
        surface.solids,
        surface.shells,
    )


def whole(surface: Surface, mirror: Mirror) -> Surface:
    """All of the shell from the half, or the sector, that is modelled."""
    joined = completed(surface, mirror.plane)
    if not isinstance(mirror, Sector):
        return joined
    turns = [image.Q.T for image in mirror.images if image.sign > 0]
    copies = [_moved(joined, Q) for Q in turns]
    count = len(joined.r0)

    def every(of: Callable[[Surface], Array]) -> Array:
        return np.concatenate([of(copy) for copy in copies])

    return replace(
        joined,
        r0=every(lambda s: s.r0),
        u=every(lambda s: s.u),
        n0=every(lambda s: s.n0),
        cells=np.concatenate([joined.cells + k * count for k in range(len(copies))]),
        fields={name: every(lambda s, name=name: s.fields[name]) for name in joined.fields},  # type: ignore[misc]
    )


def on_nodes_of(surface: Surface, like: Surface) -> Surface:
    """Displacements and fields at the nodes of another mesh of the same shell; itself on that mesh.

    By linear functions through the nearest nodes: exact to the second order of their distance.
    """
    if surface.r0.shape == like.r0.shape and np.abs(surface.r0 - like.r0).max() < ON_PLANE:
        return surface
    distance, near = scipy.spatial.cKDTree(surface.r0).query(like.r0, NEAREST)
    beside = surface.r0[near] - like.r0[:, None]
    size = np.maximum(distance.max(axis=1), ON_PLANE)[:, None]
    weight = np.exp(-((2 * distance / size) ** 2))[..., None]
    basis = np.concatenate([np.ones((*near.shape, 1)), beside / size[..., None]], axis=2)
    rows = np.linalg.pinv(weight * basis, rcond=FLAT)[:, 0] * weight[..., 0]

    def moved(f: Array) -> Array:
        return np.asarray(np.einsum("nk,nk...->n...", rows, f[near]))

    fields = {name: moved(f) for name, f in surface.fields.items()}
    return replace(
        surface, r0=like.r0, u=moved(surface.u), n0=like.n0, cells=like.cells, fields=fields
    )


def _parity(surface: Surface, normal: Array, offset: float) -> float:
    """1 if the mirror images of remanence and applied field continue them, -1 if their opposites
    do.

    Both have the same sign. It is that of the applied field at the plane, which is continuous
    there; without one, that of the remanence, if it does not jump at the plane.
    """
    on = np.abs(surface.r0 @ normal - offset) < ON_PLANE
    for name in ("Ba", "Br"):
        vectors = surface.fields.get(name, np.zeros((len(on), 3)))[on]
        size = np.nan_to_num(np.linalg.norm(vectors, axis=1))
        if size.max(initial=0.0) > 0:
            jumps = size.min() < size.max() / 2
            return (
                1.0 if jumps or 2 * np.nansum((vectors @ normal) ** 2) <= np.sum(size**2) else -1.0
            )
    return 1.0


def _moved(surface: Surface, Q: Array) -> Surface:
    """Transform points and vectors v -> v Q, and tensors T -> Q^T T Q."""

    def moved(f: Array) -> Array:
        return f if f.ndim == 1 else f @ Q if f.ndim == 2 else Q.T @ f @ Q

    fields = {name: moved(f) for name, f in surface.fields.items()}
    lines = tuple(line @ Q for line in surface.outlines)
    solids = tuple(solid.transformed(Q.T, np.zeros(3)) for solid in surface.solids)
    r0, u, n0 = (moved(f) for f in (surface.r0, surface.u, surface.n0))
    return replace(surface, r0=r0, u=u, n0=n0, fields=fields, outlines=lines, solids=solids)
