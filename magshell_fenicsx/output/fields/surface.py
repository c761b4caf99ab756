"""The deformed mid-surface gathered on rank 0, for pictures and for ParaView."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import basix
import basix.ufl
import numpy as np
import scipy
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_vtk
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.mesh.deviation import Deviated, Deviation
from magshell_fenicsx.mesh.frame import rotation
from magshell_fenicsx.models.axisymmetric.model import MeridianModel
from magshell_fenicsx.models.axisymmetric.revolution import Revolution
from magshell_fenicsx.models.shell.model import ShellModel
from magshell_fenicsx.output.fields.jump import relative_jump
from magshell_fenicsx.output.fields.point_fields import PointFields

TRIANGLE, LAGRANGE_TRIANGLE, LAGRANGE_HEXAHEDRON = 5, 69, 72  # VTK's numbers of cell types
HEXAHEDRON_NODES = 27
PRESSURE = "contact_pressure"  # of bodies, over E h/R: the mean over a cell
W0 = "w0_over_h"  # the imperfections: the deviation of the drawn surface from the perfect one
BOTH_WAYS = {"Br", "Ba"}  # a half shell's fields may be symmetric or antisymmetric to its plane
ON_PLANE = 1e-9  # over R
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Surface:
    """Nodes of the whole mid-surface or of a whole solid; lengths are over R.

    Attributes
    ----------
    r0, u, n0
        (n, 3) undeformed placement, displacement, undeformed normal.
    cells
        (m, k) node numbers of triangles of the displacement's degree or of hexahedra, in VTK's order.
    fields
        Name -> (n,), (n, 3) or (n, 3, 3), see `point_fields.PointFields`, and w0_over_h where there are
        imperfections; of a solid that alone.
    outlines
        Places (n, 3) along lines: the sources of the applied field.
    jump
        By how much the bending moments jump between cells, over their size; see `jump`. None of a solid.
    """

    r0: Array
    u: Array
    n0: Array
    cells: NDArray[np.int64]
    fields: dict[str, Array]
    outlines: tuple[Array, ...] = ()
    jump: float | None = None

    @property
    def is_body(self) -> bool:
        """Whether the cells are hexahedra."""
        return self.cells.shape[1] == HEXAHEDRON_NODES

    @property
    def w(self) -> Array:
        """Inward normal displacement -u . n0 over R, (n,)."""
        return np.asarray(-np.einsum("ij,ij->i", self.u, self.n0))


class SurfaceGatherer:
    """Gathers displacements and fields of one shell; constant fields are computed and gathered once."""

    def __init__(self, model: ShellModel) -> None:
        self._model = model
        domain, degree, map_ = model.V.mesh, model.degree, model.V.dofmap.index_map
        self.comm = domain.comm
        # VTK's nodes are equidistant, the displacement's are not; their numbers on edges and in cells are equal
        element = basix.create_element(
            basix.ElementFamily.P, basix.CellType.triangle, degree, basix.LagrangeVariant.equispaced
        )
        self._places = element.points
        self._table = model.V.element.basix_element.tabulate(2, self._places)[:, :, :, 0]
        self._owned = domain.topology.index_map(2).size_local
        V = fem.functionspace(domain, basix.ufl.wrap_element(element))  # numbers each shared node once
        local = V.dofmap.list[: self._owned]
        numbers = V.dofmap.index_map.local_to_global(local.ravel().astype(np.int32)).reshape(local.shape)
        cells = self.comm.gather(numbers[:, np.argsort(perm_vtk(mesh.CellType.triangle, local.shape[1]))])
        self._cells = np.concatenate(cells) if self.comm.rank == 0 else numbers
        self._numbers, self._size = numbers, map_.size_global
        self._take_placement({})

    def _take_placement(self, mu: Mapping[str, float]) -> None:
        """What depends on the placement, at amplitudes of imperfections that grow."""
        model, loads = self._model, self._model.loads
        r = self._at_nodes(model.r0)
        factor = None if model.thickness is None else self._thickness(model.thickness)
        others = loads.natural, loads.contacts, loads.remanence
        self._fields = PointFields(r, model.material, loads.magnetic, factor, *others)
        self._mean = self._weighted_mean(self._numbers, self._size)
        deviation = model.midsurface.deviation(self._places, grown(loads.growing, mu))
        if deviation is not None:
            self._fields.constant[W0] = np.asarray(deviation[: self._owned] / model.material.h)
        n0 = self._averaged(self._fields.n0)
        self._r0, self._n0 = self._averaged(r[0]), n0 / np.linalg.norm(n0, axis=1)[:, None]
        self._constant = {name: self._averaged(values) for name, values in self._fields.constant.items()}

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """The displaced surface with its fields at the amplitudes mu, on rank 0; None on other ranks."""
        if self._model.growing and mu:
            self._model.system.place(mu)
            self._take_placement(mu)
        self._model.system.set(u)
        jet = self._at_nodes(self._model.u)
        values = self._fields.of(jet, mu or {})
        pressure = self._model.cell_pressures(State(u, dict(mu))) if mu else None
        if pressure is not None:
            values[PRESSURE] = np.repeat(pressure[: self._owned, None], len(self._places), axis=1)
        found = {name: self._averaged(each) for name, each in values.items()}
        nodes, jump = self._averaged(jet[0]), self._jump(values["M"], found["M"])
        if self.comm.rank:
            return None
        return Surface(self._r0, nodes, self._n0, self._cells, self._constant | found, jump=jump)

    def _jump(self, values: Array, averaged: Array) -> float:
        """How much a field jumps between the cells of all ranks, on rank 0."""
        parts = self.comm.gather((values, self._fields.weight, self._numbers))
        if self.comm.rank:
            return 0.0
        whole, weight, numbers = (np.concatenate(part) for part in zip(*parts, strict=True))
        return relative_jump(whole, averaged[numbers], weight)

    def _at_nodes(self, f: fem.Function) -> Array:
        """f, f,_1, f,_2, f,_11, f,_12, f,_22 in reference coordinates at each owned cell's nodes."""
        coefficients = f.x.array.reshape(-1, 3)[self._model.V.dofmap.list[: self._owned]]
        return np.asarray(np.matmul(self._table[:, None], coefficients))

    def _thickness(self, factor: fem.Function) -> Array:
        """h(x)/h at each owned cell's nodes."""
        V = factor.function_space
        element = V.element.basix_element
        values = element.tabulate(0, self._places)[0, :, :, 0]
        return np.asarray(factor.x.array[V.dofmap.list[: self._owned]] @ values.T)

    def _weighted_mean(self, numbers: NDArray[np.int64], size: int) -> "scipy.sparse.csr_matrix | None":
        """The matrix of the weighted mean, from the nodes of all cells to global nodes, on rank 0.

        Second derivatives jump between cells, so values at a shared node are averaged with the cells' areas as weights.
        """
        parts = self.comm.gather((numbers.ravel(), self._fields.weight.ravel()))
        if self.comm.rank:
            return None
        where, weights = (np.concatenate(part) for part in zip(*parts, strict=True))
        weights = weights / np.bincount(where, weights)[where]
        return scipy.sparse.csr_matrix((weights, (where, np.arange(len(where)))), (size, len(where)))

    def _averaged(self, values: Array) -> Array:
        """Weighted mean over the cells that share a node, in global order, on rank 0."""
        parts = self.comm.gather(values)
        if self._mean is None:
            return values
        whole = np.concatenate(parts)
        return np.asarray(self._mean @ whole.reshape(self._mean.shape[1], -1)).reshape(-1, *values.shape[2:])


class RevolvedGatherer:
    """The surface of revolution of a meridian, in flat triangles."""

    def __init__(self, model: MeridianModel, comm: MPI.Comm) -> None:
        self.comm, self._model = comm, model
        self._take_placement({})

    def _take_placement(self, mu: Mapping[str, float]) -> None:
        """What depends on the placement, at amplitudes of imperfections that grow."""
        model = self._model
        self._swept = Revolution(model)
        factor = None if model.thickness is None else self._swept.scalars(model.thickness)
        r, loads = self._swept.jets(model.r0), model.loads
        others = loads.natural, loads.contacts, loads.remanence
        self._fields = PointFields(r, model.material, loads.magnetic, factor, *others)
        if isinstance(model.meridian.embedding, Deviated):
            s = np.sort(model.meridian.mesh.geometry.x[:, 0])
            embedding = model.meridian.embedding
            deviations = (*embedding.deviations, *grown(loads.growing, mu))
            w0 = replace(embedding, deviations=deviations).w0(np.column_stack([s, 0 * s])) / model.material.h
            self._fields.constant[W0] = np.column_stack([w0[:-1], w0[1:]])
        self._constant = self._around(self._fields.constant)

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """The displaced surface with its fields at the amplitudes mu, on rank 0; None on other ranks."""
        if self.comm.rank:
            return None
        if self._model.growing and mu:
            self._model.system.place(mu)
            self._take_placement(mu)
        self._model.system.set(u)
        swept, values = self._swept, self._fields.of(self._swept.jets(self._model.u), mu or {})
        pressure = self._model.cell_pressures(State(u, dict(mu))) if mu else None
        if pressure is not None:
            values[PRESSURE] = np.repeat(pressure[swept.order, None], 2, axis=1)
        found = self._around(values)
        M, weight = values["M"], self._fields.weight
        jump = relative_jump(M, swept.continuous(M, weight), weight)
        return Surface(swept.r0, swept.displacement(u), swept.n0, swept.cells, self._constant | found, jump=jump)

    def _around(self, fields: Mapping[str, Array]) -> dict[str, Array]:
        return {name: self._swept.around(values, self._fields.weight) for name, values in fields.items()}


def grown(growing: Mapping[str, tuple[Deviation, ...]], mu: Mapping[str, float]) -> list[Deviation]:
    """Imperfections that grow, at their amplitudes."""

    def times(deviation: Deviation, factor: float) -> Deviation:
        return lambda places: factor * deviation(places)

    return [times(deviation, mu.get(name, 0.0)) for name, each in growing.items() for deviation in each]


def turned(surface: Surface, azimuth: float) -> Surface:
    """The surface rotated about e3 by an angle in rad: from the model's frame to the user's."""
    return _moved(surface, rotation(azimuth))


def completed(surface: Surface, mirror: Array) -> Surface:
    """A half surface together with its mirror image.

    `mirror` is the plane's unit normal (3,), followed by its offset if that is not zero. Seen from outside, the
    image's triangles have the opposite orientation.
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
    )


def _parity(surface: Surface, normal: Array, offset: float) -> float:
    """1 if the mirror images of remanence and applied field continue them, -1 if their opposites do.

    Both have the same sign. It is that of the applied field at the plane, which is continuous there; without one, that
    of the remanence, if it does not jump at the plane.
    """
    on = np.abs(surface.r0 @ normal - offset) < ON_PLANE
    for name in ("Ba", "Br"):
        there = surface.fields.get(name, np.zeros((len(on), 3)))[on]
        size = np.nan_to_num(np.linalg.norm(there, axis=1))
        if size.max(initial=0.0) > 0:
            jumps = size.min() < size.max() / 2
            return 1.0 if jumps or 2 * np.nansum((there @ normal) ** 2) <= np.sum(size**2) else -1.0
    return 1.0


def _moved(surface: Surface, Q: Array) -> Surface:
    """Transform points and vectors v -> v Q, and tensors T -> Q^T T Q."""

    def moved(f: Array) -> Array:
        return f if f.ndim == 1 else f @ Q if f.ndim == 2 else Q.T @ f @ Q

    fields = {name: moved(f) for name, f in surface.fields.items()}
    lines = tuple(line @ Q for line in surface.outlines)
    r0, u, n0 = (moved(f) for f in (surface.r0, surface.u, surface.n0))
    return replace(surface, r0=r0, u=u, n0=n0, fields=fields, outlines=lines)
