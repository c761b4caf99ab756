"""The gatherer of each model: it collects nodal fields on rank 0 for pictures and ParaView.

That of a meridian gives the surface that it sweeps, in flat triangles.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

import basix
import numpy as np
from dolfinx import fem, mesh
from dolfinx.cpp.io import perm_vtk
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.mesh.patch import DeviatedEmbedding
from magshell_fenicsx.models.shell.patterns import inside
from magshell_fenicsx.output.fields.point_fields import (
    PointFields,
    Stresses,
    principal_fields,
    rubber_fields,
)
from magshell_fenicsx.output.fields.recovery import ROUNDING, Recovery, relative_jump, smooth_parts
from magshell_fenicsx.output.fields.surface import (
    SHELL,
    W0,
    Surface,
    SurfaceGatherer,
    add_contact,
    grown,
    resolved_pressure,
)
from magshell_fenicsx.shells.revolution import ENDS, Revolution

if TYPE_CHECKING:  # one of them is built
    from magshell_fenicsx.shells.meridian import MeridianModel
    from magshell_fenicsx.shells.shell import ShellModel
    from magshell_fenicsx.shells.solid import SolidModel

Array = NDArray[np.float64]


class RevolvedGatherer:
    """Gathers displacement and fields of a meridian; strains and moments are recovered from samples
    in its cells.
    """

    def __init__(self, model: "MeridianModel", comm: MPI.Comm) -> None:
        self.comm, self._model = comm, model
        self._inner, rule = basix.make_quadrature(basix.CellType.interval, 2 * model.degree - 3)
        self._swept = Revolution(model)
        self._take_placement({})
        if len(kinks := self._kinks()):
            self._swept = Revolution(model, kinks=kinks)
            self._take_placement({})
        self._recovered = RecoveredMeridian(self._swept, self._model, self._inner, rule)

    def _take_placement(self, mu: Mapping[str, float]) -> None:
        """What depends on the placement, at amplitudes of imperfections that grow."""
        model, swept, loads = self._model, self._swept, self._model.loads
        r, inner = swept.jets(model.r0), swept.inner_jets(model.r0, self._inner)
        thick, thick_inside = (
            None if model.thickness is None else swept.scalars(model.thickness, at)
            for at in (ENDS, self._inner)
        )
        others = loads.contacts, loads.remanence, loads.natural
        own = model.made_of
        made_of = (
            None
            if own is None
            else own.x.array.reshape(-1, 4)[own.function_space.dofmap.list[swept.order, 0]]
        )
        self._law = model.material.law_in(made_of)
        self._fields = PointFields(r, model.material, loads.magnetic, thick, *others, made_of)
        self._stresses = Stresses(inner, model.material, thick_inside, loads.natural, made_of)
        self._at_ends = Stresses(r, model.material, thick).frame
        if isinstance(model.meridian.embedding, DeviatedEmbedding):
            s, embedding = model.meridian.cells.ravel(), model.meridian.embedding
            deviations = (*embedding.deviations, *grown(loads.growing, mu))
            w0 = (
                replace(embedding, deviations=deviations).w0(np.column_stack([s, 0 * s]))
                / model.material.h
            )
            self._fields.constant[W0] = np.asarray(w0.reshape(-1, 2))
        if inside := [*model.meridian.patches.values()]:
            number = np.argmax(inside, axis=0)[swept.order, None].astype(np.float64)
            self._fields.constant[SHELL] = np.asarray(np.repeat(number, 2, axis=1))
        self._constant = self._around(self._fields.constant)

    def _kinks(self) -> list[int]:
        """The numbers of the vertices along the meridian where given fields or the normal jump."""
        model, fields = self._model, self._fields
        given = [each for each in (fields.Br, fields.susceptibility) if each.size]
        if model.loads.natural:
            given += model.loads.natural.at(inside(fields.jet[0]), fields.n0)
        if model.thickness is not None:
            given.append(self._swept.scalars(model.thickness))
        parts = smooth_parts(self._swept.ends, np.array([[0], [1]]), given, fields.n0)
        return [int(i) + 1 for i in np.flatnonzero(np.diff(parts))]

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """The displaced surface with its fields at the amplitudes mu, on rank 0; None on other
        ranks.
        """
        if self.comm.rank:
            return None
        state = State(u, dict(mu or {}))
        return self._model.system.at_state(state).evaluate(lambda: self._drawn(state))

    def _drawn(self, state: State) -> Surface:
        """The surface at the displacement and the placement that are set."""
        if self._model.growing:
            self._take_placement(state.mu)
        swept = self._swept
        stresses = self._stresses.of(swept.inner_jets(self._model.u, self._inner), state.mu)
        components, jumps = self._recovered.components(stresses)
        tensors = {name: self._at_ends.tensor(S) for name, S in components.items()}
        values = (
            tensors
            | principal_fields(components)
            | self._fields.of(swept.jets(self._model.u), state.mu)
        )
        if state.mu:
            add_contact(
                values,
                self._model,
                state,
                lambda of_cells: np.repeat(of_cells[swept.order, None], 2, axis=1),
            )
        values |= rubber_fields(values, self._law)
        turned = self._around(values)
        fields = resolved_pressure(swept.cells, self._constant | turned)
        shape = swept.r0, swept.displacement(state.u), swept.n0, swept.cells
        return Surface(
            *shape, fields, (), jumps["M"], jumps["E"], shells=self._model.meridian.shells
        )

    def _around(self, fields: Mapping[str, Array]) -> dict[str, Array]:
        return {
            name: self._swept.around(values, self._fields.weight) for name, values in fields.items()
        }


class RecoveredMeridian:
    """Takes components along and across the meridian from samples in its cells to their ends.

    At a pole, where both are even functions of the arc length, the cell has its mirror image beside
    it.
    """

    def __init__(
        self, swept: Revolution, model: "MeridianModel", inner: Array, rule: Array
    ) -> None:
        s, ends, poles = model.meridian.cells, swept.ends, model.meridian.poles
        length, cells = np.diff(s), np.arange(len(s))
        samples = s[:, :1] + length * inner[:, 0]
        vertices = np.empty(ends.max() + 1)
        vertices[ends] = s
        beside, end = np.nonzero(np.isclose(s[..., None], poles).any(axis=2))
        self._beside, pole, far = beside, s[beside, end], s[beside, 1 - end]
        images = len(vertices) + np.arange(len(beside))
        of = (
            np.concatenate([ends, np.column_stack([ends[beside, end], images])]),
            np.concatenate([samples, 2 * pole[:, None] - samples[beside]])[..., None],
            np.concatenate([length, length[beside]]) * rule,
            (vertices := np.concatenate([vertices, 2 * pole - far]))[:, None],
            np.ones((len(vertices), 1, 1)),
        )
        self._recovery, self._weight = Recovery(*of, model.degree), length * rule
        count = len(inner)
        hats = np.column_stack([1 - inner[:, 0], inner[:, 0]])
        self._to_samples = self._recovery.at(
            np.repeat(cells, count), samples.reshape(-1, 1), np.tile(hats, (len(cells), 1))
        )
        at_ends = (
            np.repeat(cells, 2),
            vertices[ends].reshape(-1, 1),
            np.tile(np.eye(2), (len(cells), 1)),
        )
        self._to_ends = self._recovery.at(*at_ends)

    def components(
        self, stresses: Mapping[str, Array]
    ) -> tuple[dict[str, Array], dict[str, float]]:
        """Those (cells, 2, 3) at the ends, of (cells, q, 3), and by how much those of the samples
        differ.
        """
        at_ends, jumps = {}, {}
        for name, S in stresses.items():
            fit = self._recovery.coefficients(np.concatenate([S, S[self._beside]]))
            at_ends[name] = (self._to_ends @ fit).reshape(-1, 2, 3)
            if name in ROUNDING:
                smooth = (self._to_samples @ fit).reshape(S.shape)
                jumps[name] = relative_jump(S, smooth, self._weight, ROUNDING[name])
        return at_ends, jumps


class BodyGatherer:
    """Gathers the displacement of one solid; n0 is the direction of the thickness."""

    def __init__(self, model: "SolidModel") -> None:
        self._model, self.comm = model, model.V.mesh.comm
        V = model.V
        cells = V.dofmap.list[: V.mesh.topology.index_map(3).size_local]
        numbers = V.dofmap.index_map.local_to_global(cells.ravel().astype(np.int32)).reshape(
            cells.shape
        )
        to_vtk = np.argsort(perm_vtk(mesh.CellType.hexahedron, cells.shape[1]))
        self._cells = self._on_first(numbers[:, to_vtk])
        self._fields: dict[str, Array] = {}
        if model.body.w0 is not None:
            owned = model.body.at_nodes(V, model.body.w0)[: V.dofmap.index_map.size_local]
            self._fields[W0] = self._on_first(owned / model.material.h)
        self._r0, self._n0 = self._nodes(model.r0), self._nodes(_outwards(model.r0))

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """The displaced body on rank 0; None on other ranks."""
        nodes = self._on_first(
            self._model.system.with_ghosts(u)[: self._model.system.size].reshape(-1, 3)
        )
        return (
            Surface(self._r0, nodes, self._n0, self._cells, self._fields)
            if self.comm.rank == 0
            else None
        )

    def _nodes(self, f: fem.Function) -> Array:
        """Values at the owned nodes of all ranks, in global order, on rank 0."""
        return self._on_first(f.x.array[: self._model.system.size].reshape(-1, 3))

    def _on_first(self, part: NDArray[Any]) -> NDArray[Any]:
        parts = self.comm.gather(part.copy())
        return np.concatenate(parts) if self.comm.rank == 0 else part


def _outwards(r0: fem.Function) -> fem.Function:
    """The unit vector in the direction of the thickness, at the nodes."""
    V = r0.function_space
    element = V.element.basix_element
    by_third = element.tabulate(1, element.points)[3, :, :, 0]
    along = np.einsum("vk,cki->cvi", by_third, r0.x.array.reshape(-1, 3)[V.dofmap.list])
    n0 = fem.Function(V)
    n0.x.array.reshape(-1, 3)[V.dofmap.list] = along / np.linalg.norm(along, axis=2)[..., None]
    return n0


class Gatherer(Protocol):
    """Gathers the displacement and fields of one model; collective."""

    comm: MPI.Comm

    def gather(self, u: Vector, mu: Mapping[str, float] | None = None) -> Surface | None:
        """The displaced nodes with their fields at the amplitudes mu, on rank 0; None on other
        ranks.
        """


def gatherer(model: "ShellModel | MeridianModel | SolidModel", comm: MPI.Comm) -> Gatherer:
    """The gatherer of a model."""
    if model.axisymmetric:
        return RevolvedGatherer(model, comm)
    return SurfaceGatherer(model) if model.thin else BodyGatherer(model)
