"""Stability of a sector against the modes that its two planes exclude, on the half that its copies make.

The mesh of the half is that of the sector and its images, so the state of the half is that of the sector to rounding.
Its own tangent and that of its antisymmetric modes count all modes of the shell. Where nothing but the buckled shape
itself distinguishes one azimuth from another, that shape may turn about e3 without any force: this one direction is
left out of the count, which would depend on rounding.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.system import State, Vector, dot, max_abs
from magshell_fenicsx.continuation.watch import Family
from magshell_fenicsx.mesh.midsurface import Midsurface, distribute
from magshell_fenicsx.mesh.mirror import CUT, SECOND_CUT, Sector, rotation
from magshell_fenicsx.mesh.patch import PatchMesh

if TYPE_CHECKING:
    from magshell_fenicsx.shells.shell import ShellModel

Array = NDArray[np.float64]
CLOSE = 1e-7  # over the chart's extent: nodes that are one
SEEN = 1e-3  # in lengths: a state that differs less around e3 is axisymmetric
TURNED_OVER = {3: [0, 2, 1], 6: [0, 2, 1, 5, 4, 3], 10: [0, 2, 1, 8, 7, 6, 5, 4, 3, 9]}  # gmsh's nodes of a mirrored cell


class Folding:
    """The copies of a sector that make a half: copy k lies between the azimuths k and k + 1 times its angle.

    Parameters
    ----------
    chart
        Coordinates (n, 2) of a disc around the axis, or of a rectangle whose first axis goes around e3.
    """

    def __init__(self, sector: Sector, patch: PatchMesh) -> None:
        self.waves, self._angle = sector.waves, sector.angle
        places, turn = patch.embedding(patch.nodes), rotation(-sector.angle)
        turned = patch.embedding(patch.nodes @ turn[:2, :2].T)
        self.round = bool(np.abs(turned - places @ turn.T).max() < CLOSE * np.abs(places).max())
        self.end = sector.angle if self.round else float(patch.nodes[:, 0].max())

    def image(self, chart: Array, k: int) -> Array:
        """Copy k of places of the chart."""
        if self.round:
            return chart @ self.turn(k)[:2, :2].T
        x = (k + 1) * self.end - chart[:, 0] if k % 2 else k * self.end + chart[:, 0]
        return np.column_stack([x, chart[:, 1]])

    def turn(self, k: int) -> Array:
        """The matrix (3, 3) that takes vectors of the sector to copy k."""
        if k % 2:
            return rotation(-(k + 1) * self._angle) @ np.diag([1.0, -1.0, 1.0])
        return rotation(-k * self._angle)

    def copies(self, chart: Array) -> NDArray[np.int64]:
        """In which copy each place (n, 2) of the half lies."""
        along = np.arctan2(chart[:, 1], chart[:, 0]) if self.round else chart[:, 0]
        return np.clip(np.floor(along / self.end), 0, self.waves - 1).astype(np.int64)

    def back(self, chart: Array) -> Array:
        """The places of the sector whose copies these are."""
        found, copies = np.empty_like(chart), self.copies(chart)
        for k in range(self.waves):
            here = copies == k
            if self.round:
                found[here] = chart[here] @ self.turn(k)[:2, :2]
            else:
                x = chart[here, 0]
                found[here, 0] = (k + 1) * self.end - x if k % 2 else x - k * self.end
                found[here, 1] = chart[here, 1]
        return found


def unfolded(patch: PatchMesh, folding: Folding) -> PatchMesh:
    """The triangulation of the half, from that of the sector."""
    n, waves = len(patch.nodes), folding.waves
    nodes = np.concatenate([folding.image(patch.nodes, k) for k in range(waves)])
    over = TURNED_OVER[patch.cells.shape[1]]
    cells = np.concatenate([k * n + (patch.cells[:, over] if k % 2 else patch.cells) for k in range(waves)])
    tree = scipy.spatial.cKDTree(nodes)
    near = tree.query_ball_point(nodes, CLOSE * np.ptp(nodes, axis=0).max())
    same = np.array([min(each) for each in near])
    one = np.arange(n) if patch.one is None else patch.one
    glued = same[np.concatenate([k * n + one for k in range(waves)])]
    used, numbers = np.unique(same, return_inverse=True)
    new = np.full(len(nodes), -1, dtype=np.int64)
    new[used] = np.arange(len(used))

    def copied(name: str, ks: Sequence[int]) -> NDArray[np.int64]:
        return np.concatenate([new[glued[k * n + patch.edges[name]]] for k in ks])

    last = waves - 1
    edges = {name: copied(name, range(waves)) for name in patch.edges if name not in (CUT, SECOND_CUT)}
    edges[CUT] = np.concatenate([copied(CUT, [0]), copied(CUT if last % 2 else SECOND_CUT, [last])])
    return replace(
        patch,
        nodes=nodes[used],
        cells=numbers[cells],
        edges=edges,
        one=None if patch.one is None else new[glued[used]],
        patches={name: np.tile(inside, waves) for name, inside in patch.patches.items()},
    )


class UnfoldedModes:
    """Numbers of the unstable modes that a sector excludes.

    Parameters
    ----------
    model
        Of the sector.
    as_half
        The same shell on the mid-surface of a half.
    """

    families: Sequence[Family] = ()  # they are counted and not located: the turned shape is always neutral

    def __init__(self, model: "ShellModel", as_half: "Callable[[Midsurface], ShellModel]") -> None:
        self._model, self._as_half = model, as_half
        self._own, self._others = Factorisation(model.system.comm), Factorisation(model.system.comm)

    @cached_property
    def half(self) -> "ShellModel":
        """The model whose tangents are counted."""
        sector, patch = self._model.mirror, self._model.midsurface.patch
        assert isinstance(sector, Sector)
        self._folding = Folding(sector, patch)
        half = self._as_half(distribute(unfolded(patch, self._folding), self._model.system.comm))
        comm, chart = self._model.system.comm, half.chart()
        nodes = np.concatenate(comm.allgather(self._model.chart()))
        self._numbers = scipy.spatial.cKDTree(nodes).query(self._folding.back(chart))[1]
        self._turns = np.array([self._folding.turn(k) for k in range(sector.waves)])[self._folding.copies(chart)]
        return half

    def unfolded(self, u: Vector) -> Vector:
        """A displacement of the sector as that of the half; collective."""
        half, system = self.half, self._model.system
        whole = np.concatenate(system.comm.allgather(u[: system.size].reshape(-1, 3)))
        return np.asarray(half.system.held(np.einsum("nij,nj->ni", self._turns, whole[self._numbers]).ravel()))

    def counts(self, state: State) -> Sequence[int]:
        """Unstable modes of the half that the sector excludes, and those that are antisymmetric to the half."""
        half, there = self.half, State(self.unfolded(state.u), dict(state.mu))
        self._own.factor(self._model.system.tangent(state.u, state.mu))
        own = self._own.negative_pivots
        self._others.factor(half.system.tangent(there.u, there.mu))
        symmetric = self._others.negative_pivots - own
        modes = half.excluded_modes
        assert modes is not None
        factors = modes.factor_at(there)
        antisymmetric = factors.negative_pivots
        t = self._turning(there)
        if t is not None and dot(half.system.comm, t, factors.solve(t)) < 0:  # of the tangent on the complement of t
            antisymmetric -= 1
        return [max(symmetric, 0), antisymmetric]

    def _turning(self, state: State) -> Vector | None:
        """e3 x u - du/dtheta, by which the shape turns about e3 on an axisymmetric shell; None without any."""
        half, system, modes = self.half, self.half.system, self.half.excluded_modes
        if modes is None or not self._model.turns:
            return None
        V = half.V
        u, r0 = system.with_ghosts(state.u, state.mu).reshape(-1, 3), half.r0.x.array.reshape(-1, 3)
        dofs, element = V.dofmap.list, V.element.basix_element
        table = element.tabulate(1, element.points)[1:, :, :, 0]
        a, du = (np.einsum("dqk,nki->nqdi", table, f[dofs]) for f in (r0, u))
        around = np.cross([0.0, 0.0, 1.0], r0[dofs])
        metric = np.einsum("nqdi,nqei->nqde", a, a)
        c = np.linalg.solve(metric, np.einsum("nqdi,nqi->nqd", a, around)[..., None])[..., 0]
        by_angle, total, count = np.einsum("nqd,nqdi->nqi", c, du), np.zeros_like(u), np.zeros(len(u))
        np.add.at(total, dofs, by_angle)
        np.add.at(count, dofs, 1.0)
        t = np.cross([0.0, 0.0, 1.0], u) - total / np.maximum(count, 1.0)[:, None]
        t = modes.system.held(t.ravel()[: system.size])
        return t if max_abs(system.comm, t) > SEEN * system.length else None

