"""How far faces are from a mid-surface whose thickness varies or changes: half of it, continuous
from cell to cell.

At each node it is the undeformed volume per deformed area of the cells around, and between nodes
their polynomial:

    H_k = (h/2) sum V / sum A,   V = t J0,   A = J where the shell gets thinner as it stretches, J0 where it does not,

with t h the undeformed thickness and J = |a_1 x a_2| of the cell at the node. Of a shell that has
grown V is the natural volume, a polynomial of the amplitude "natural_stretch". The derivatives by
the displacement and by this are exact.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.assembly.free_parameters import SettableNumber
from magshell_fenicsx.assembly.nonlocal_terms import Entries
from magshell_fenicsx.parts.touching.nearest import (
    SIGNS,
    Cells,
    Longs,
    Places,
    inverse,
    jets,
    slopes,
)
from magshell_fenicsx.parts.touching.segments import Points

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Tilted:
    """Areas of some cells at their nodes.

    Attributes
    ----------
    J
        (cells, places).
    normal
        (cells, places, 3).
    by_node
        (cells, places, 3 nodes, 3): derivatives of a_1 x a_2 by the components of all nodes.
    """

    J: Array
    normal: Array
    by_node: Array

    @property
    def slope(self) -> Array:
        """Derivatives (cells, places, 3 nodes) of J."""
        return np.asarray(np.einsum("cqmi,cqi->cqm", self.by_node, self.normal))


class Meshed(Protocol):
    """Cells with an element of basix, and (cells, functions) the numbers of their nodes."""

    @property
    def element(self) -> Any: ...
    @property
    def nodes(self) -> Longs: ...


class Faces:
    """Half the thickness at all nodes.

    Parameters
    ----------
    r0
        (nodes, 3) undeformed.
    h
        Thickness over R.
    thickness, thins
        (n, cells, functions) coefficients, by powers of the amplitude, of what multiplies it at the
        nodes of each cell, and (cells,) whether it follows from the area.
    same
        (nodes,) for each node the first of those at its place: images share what is on their
        planes.
    grown
        The amplitude; None without.

    Attributes
    ----------
    grown
        The same.
    undeformed
        Half the undeformed thickness (nodes,) over R, before anything grows.
    """

    def __init__(
        self,
        cells: Meshed,
        r0: Array,
        h: float,
        thickness: Array,
        thins: NDArray[np.bool_],
        same: Longs,
        grown: SettableNumber | None = None,
    ) -> None:
        self._cells, self._r0, self._thins, self._thin = cells, r0, thins, np.flatnonzero(thins)
        self._same, self.grown, self._places = same, grown, same[cells.nodes]
        self._parts = r0.shape[1]  # of a displacement
        J0 = self._areas(r0, slice(None))
        self._volumes = h / 2 * np.array([self._sum(slice(None), each * J0) for each in thickness])
        self._thickness = thickness[0]
        self._per_factor = h / 2 * thickness / thickness[0]  # by powers of the amplitude
        self._stays = self._sum(~thins, J0[~thins])
        self.undeformed = np.asarray(self._volumes[0] / self._sum(slice(None), J0))

    @property
    def constant(self) -> bool:
        """Whether the thickness does not depend on the displacement."""
        return not len(self._thin)

    @property
    def value(self) -> float:
        """Of the amplitude at present."""
        return float(self.grown.value) if self.grown is not None else 0.0

    def half(self, u: Array) -> Array:
        """(nodes,), over R, at a displacement (nodes, 3)."""
        return np.asarray(self._volume() / self._area(u))

    def by_growth(self, u: Array, order: int = 1) -> Array:
        """The derivative (nodes,) of H by the amplitude."""
        return np.asarray(self._volume(order) / self._area(u))

    def slope(self, u: Array, f: Array) -> Array:
        """The derivative (nodes, 3) of sum f H, with f (nodes,)."""
        if self.constant:
            return np.zeros_like(u)
        return np.asarray((self.jacobian(u, f != 0).T @ f).reshape(len(u), -1))

    def jacobian(self, u: Array, which: NDArray[np.bool_]) -> Any:
        """The sparse derivative (nodes, 3 nodes) of H at some nodes."""
        area = self._area(u)
        return scipy.sparse.diags_array(
            np.where(which, -self._volume() / area**2, 0.0)
        ) @ self._slopes(u, which)

    def change(self, u: Array, w: Array) -> Array:
        """What H (nodes,) changes by along w (nodes, 3)."""
        if self.constant:
            return 0 * u[:, 0]
        return np.asarray(self.jacobian(u, np.ones(len(u), dtype=bool)) @ w.ravel())

    def ratio(self, u: Array) -> tuple[Array, Array]:
        """The volumes and areas (nodes,) whose ratio is H."""
        return self._volume(), self._area(u)

    def by_factor(self, by_volume: Array) -> Array:
        """The derivatives (cells, functions) by what multiplies h, of those (nodes,) by volumes."""
        at_places = np.bincount(self._same, by_volume, len(by_volume))[self._places]
        per_factor = np.polynomial.polynomial.polyval(self.value, self._per_factor)
        return np.asarray(at_places * per_factor * self._areas(self._r0, slice(None)))

    def by_area(self, by_volume: Array, by_area: Array) -> Array:
        """Those (nodes, 3) by the undeformed place, as far as volumes and areas that stay depend on
        it alone.
        """
        of_volume, of_area = (
            np.bincount(self._same, f, len(f))[self._places] for f in (by_volume, by_area)
        )
        h_t = np.polynomial.polynomial.polyval(self.value, self._per_factor) * self._thickness
        by_J0 = of_volume * h_t + of_area * ~self._thins[:, None]
        some = np.flatnonzero((by_J0 != 0).any(axis=1))
        forces = np.zeros(self._r0.size)
        by_place = np.einsum("cq,cqm->cm", by_J0[some], self._area_slopes(0 * self._r0, some))
        np.add.at(forces, self._unknowns(some), by_place)
        return forces.reshape(self._r0.shape)

    def slope_by_growth(self, u: Array, f: Array) -> Array:
        """The derivative (nodes, 3) of sum f dH, with dH by the amplitude."""
        weight = -f * self._volume(1) / self._area(u) ** 2
        return np.asarray((self._slopes(u, f != 0).T @ weight).reshape(len(u), -1))

    def hessian(self, u: Array, f: Array) -> Any:
        """The sparse second derivative (3 nodes, 3 nodes) of sum f H."""
        some, area, by = self._around(f != 0), self._area(u), self._slopes(u, f != 0)
        weight = -f * self._volume() / area**2
        whole = by.T @ scipy.sparse.diags_array(-2 * weight / area) @ by
        H = self._bends(
            u, some, np.bincount(self._same, weight, len(weight)).astype(float)[self._places[some]]
        )
        dofs = self._unknowns(some)
        rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
        return (
            whole
            + scipy.sparse.coo_array(
                (H.ravel(), (rows.ravel(), columns.ravel())), whole.shape
            ).tocsr()
        )

    def entries(self, u: Array, entries: Entries, f: Array) -> Entries:
        """Those of a second derivative by the displacement, of one by the displacement and H.

        Parameters
        ----------
        f
            (nodes,) the first derivative by H.
        """
        rows, columns, values = entries
        count = self._parts * len(f)
        size = count + len(f)
        if self.constant:  # H stays
            of_places = (rows < count) & (columns < count)
            return rows[of_places], columns[of_places], values[of_places]
        which = np.zeros(size, dtype=bool)
        which[rows] = True
        by_u = scipy.sparse.vstack(
            [scipy.sparse.eye_array(count), self.jacobian(u, which[count:])]
        ).tocsr()
        K = scipy.sparse.coo_array((values, (rows, columns)), (size, size)).tocsr()
        i, j, v = scipy.sparse.find(by_u.T @ K @ by_u + self.hessian(u, f))
        return i.astype(np.int64), j.astype(np.int64), v

    def coupled_pairs(self, rows: Longs, columns: Longs) -> tuple[Longs, Longs]:
        """Pairs of nodes that act on each other, where places and thickness at pairs of nodes do."""
        if self.constant:
            return rows, columns
        nodes, count = self._places, len(self._r0)
        has = np.repeat(np.arange(len(nodes)), nodes.shape[1])
        cells = scipy.sparse.coo_array(
            (np.ones(nodes.size), (has, nodes.ravel())), (len(nodes), count)
        ).tocsr()
        moves = scipy.sparse.coo_array(
            (np.ones(nodes.size), (has, self._cells.nodes.ravel())), cells.shape
        ).tocsr()
        of_places = scipy.sparse.coo_array(
            (np.ones(count), (np.arange(count), self._same)), (count, count)
        ).tocsr()
        by = scipy.sparse.eye_array(count) + of_places @ cells.T @ moves
        acting = scipy.sparse.coo_array(
            (np.ones(len(rows)), (rows, columns)), (count, count)
        ).tocsr()
        i, j = (by.T @ acting @ by).nonzero()
        return i.astype(np.int64), j.astype(np.int64)

    def _volume(self, order: int = 0) -> Array:
        """(h/2) sum V at all nodes, or a derivative of it by the amplitude."""
        powers = np.polynomial.polynomial
        return np.asarray(powers.polyval(self.value, powers.polyder(self._volumes, order)))

    def _area(self, u: Array) -> Array:
        return self._stays + self._sum(self._thin, self._areas(self._r0 + u, self._thin))

    def _sum(self, some: Any, values: Array) -> Array:
        """At nodes, of values (cells, functions) in some cells."""
        of_places = np.bincount(self._places[some].ravel(), values.ravel(), len(self._r0))
        return np.asarray(of_places[self._same], dtype=float)

    def _around(self, which: NDArray[np.bool_]) -> Longs:
        """The cells with any of some nodes whose areas count."""
        at_places = np.bincount(self._same, which, len(which)) > 0
        return np.flatnonzero(at_places[self._places].any(axis=1) & self._thins)

    def _slopes(self, u: Array, which: NDArray[np.bool_]) -> Any:
        """Derivatives (nodes, 3 nodes) of the areas at some nodes."""
        some = self._around(which)
        slope, places = self._area_slopes(u, some), self._places[some]
        rows, columns = np.broadcast_arrays(places[:, :, None], self._unknowns(some)[:, None, :])
        size = len(self._r0), self._parts * len(self._r0)
        return scipy.sparse.coo_array(
            (slope.ravel(), (rows.ravel(), columns.ravel())), size
        ).tocsr()[self._same]

    def _unknowns(self, some: Longs) -> Longs:
        """Numbers of those of the displacement in some cells."""
        return unknowns(self._cells.nodes[some], len(self._r0), self._parts, self._parts)

    # of surfaces

    @cached_property
    def _table(self) -> Array:
        """The derivatives (2, places, functions) of shape functions at the nodes."""
        return np.asarray(self._cells.element.tabulate(1, self._cells.element.points)[1:, :, :, 0])

    def _areas(self, r: Array, some: Any) -> Array:
        a1, a2 = np.einsum("dqk,cki->dcqi", self._table, r[self._cells.nodes[some]])
        return np.asarray(np.linalg.norm(np.cross(a1, a2), axis=-1))

    def _area_slopes(self, u: Array, some: Longs) -> Array:
        """The derivatives (cells, places, dofs) of areas by what moves the nodes of their cells."""
        return self._tilted(u, some).slope

    def _bends(self, u: Array, some: Longs, w: Array) -> Array:
        """The second derivatives (cells, dofs, dofs) of areas times w (cells, places)."""
        at = self._tilted(u, some)
        T, slope = at.by_node, at.slope
        H = np.einsum("cqmi,cqni->cmn", T * (w / at.J)[..., None, None], T)
        H -= np.einsum("cqm,cqn->cmn", slope * (w / at.J)[..., None], slope)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            twist = np.einsum("cq,qm,qn->cmn", w * at.normal[..., k], *self._table)
            twist -= np.swapaxes(twist, 1, 2)
            H[:, i::3, j::3] += twist
            H[:, j::3, i::3] -= twist
        return np.asarray(H)

    def _tilted(self, u: Array, some: Longs) -> _Tilted:
        a1, a2 = np.einsum("dqk,cki->dcqi", self._table, (self._r0 + u)[self._cells.nodes[some]])
        n = np.cross(a1, a2)
        J = np.linalg.norm(n, axis=-1)
        one, two = self._table[..., None]
        between = one * a2[:, :, None] - two * a1[:, :, None]  # e x this is the derivative along e
        turned = np.cross(np.eye(3), between[..., None, :])
        return _Tilted(J, n / J[..., None], turned.reshape(*J.shape, 3 * J.shape[1], 3))


def unknowns(nodes: Longs, count: int, parts: int = 3, dim: int = 3) -> Longs:
    """Numbers (n, parts functions) of the unknowns at nodes (n, functions) of `count`: those of H, the last of parts
    where these are more than `dim`, after all of the displacement."""
    of_place = dim * nodes[:, :, None] + np.arange(dim)
    dofs = np.concatenate([of_place, dim * count + nodes[:, :, None]], axis=2)[..., :parts]
    return np.asarray(dofs.reshape(len(nodes), parts * nodes.shape[1]))


def slope_of(n: Array, beta: Array, parts: int) -> Array:
    """The derivative (n, functions, parts) of distances along n (n, 3) by the unknowns, with beta
    of `touching`.
    """
    half = beta.shape[1] // 2
    thicker = np.concatenate([-beta[:, :half], beta[:, half:]], axis=1)
    return np.asarray(
        np.concatenate([beta[:, :, None] * n[:, None, :], thicker[..., None]], axis=2)[..., :parts]
    )


def hessians(
    cells: Cells,
    at: Places,
    geometry: tuple[Array, Array, Array, Longs],
    placed: Array,
    penalty: tuple[Array, Array, Array],
) -> Array:
    """Those of the weighted penalty (n, dofs, dofs) by the nodes of both cells, see `touching`.

    Parameters
    ----------
    geometry
        Distances, normals, beta and its nodes.
    placed
        All nodes (nodes, parts).
    penalty
        Weights, and first and second derivatives by the penetration.
    """
    (d, n, beta, nodes), (weight, first, second) = geometry, penalty
    half, parts = nodes.shape[1] // 2, placed.shape[1]
    shapes, y = zip(*jets(cells.element, at.X, placed[nodes[:, half:]]), strict=True)
    normal = np.column_stack([n, 0 * d])[:, None, :parts]
    off = d[:, None, None] * np.column_stack([n, np.ones_like(d)])[:, None, :parts]
    A = slopes(off[:, 0], *y[1:])[1]
    M = np.einsum("nik,nkl,njl->nij", at.free, inverse(at.free, A), at.free)
    C = np.zeros((len(d), 2, *beta.shape[1:], parts))
    for a in range(2):
        across = y[1 + a][:, None] * (SIGNS[:parts] > 0)
        across -= np.sum(normal * across, axis=2, keepdims=True) * normal
        C[:, a] = -beta[:, :, None] * across
        C[:, a, half:] -= shapes[1 + a][:, :, None] * off
    bent = weight * first / d
    rows = [slope_of(n, beta, parts)[:, None], (beta[:, :, None] * normal)[:, None], C]
    left = np.concatenate(rows, axis=1).reshape(len(d), 4, -1)
    middle = np.zeros((len(d), 4, 4))
    middle[:, 0, 0], middle[:, 1, 1], middle[:, 2:, 2:] = (
        weight * second,
        bent,
        bent[:, None, None] * M,
    )
    H = left.transpose(0, 2, 1) @ (middle @ left)
    both = bent[:, None, None] * beta[:, :, None] * beta[:, None, :]
    for i in range(3):
        H[:, i::parts, i::parts] -= both
    return np.asarray(H)


def on_nodes(faces: Faces | None, u: Array, forces: Array) -> Array:
    """The forces by the displacement u (nodes, 3), of those by place and thickness."""
    return np.asarray(forces[:, :-1] + faces.slope(u, forces[:, -1])) if faces else forces


def between(slopes: Array, nodes: Longs, group: Longs, weight: Array, count: int) -> Entries:
    """What the Hessian of joined places has besides those of each.

    Parameters
    ----------
    slopes, nodes, group
        Of all places: the weighted derivative (n, functions, parts) of the distance by the nodes
        (n, functions) of `count`, and the joined one (n,) that it belongs to.
    weight
        Of each joined one.
    """
    parts = slopes.shape[2]
    dofs = unknowns(nodes, count, parts)
    entries = slopes.ravel(), (np.repeat(group, dofs.shape[1]), dofs.ravel())
    G = scipy.sparse.coo_array(entries, (len(weight), parts * count)).tocsr()
    hessian = (G.T @ scipy.sparse.diags_array(weight) @ G).tocoo()
    return hessian.row.astype(np.int64), hessian.col.astype(np.int64), hessian.data


def geometry(
    cells: Cells, points: Points, r: Array, at: Places
) -> tuple[Array, Array, Array, Longs]:
    """Distances, normals, and beta (n, functions of both cells) with its nodes, where all nodes are
    at r.
    """
    nodes = np.concatenate([cells.nodes[points.cell[at.point]], cells.nodes[at.cell]], axis=1)
    half, N = nodes.shape[1] // 2, points.shape[at.point]
    (shape, y), *_ = jets(cells.element, at.X, r[nodes[:, half:]], 0)
    off = np.einsum("nk,nki->ni", N, r[nodes[:, :half]]) - y
    d = np.linalg.norm(off, axis=1)
    return d, off / d[:, None], np.concatenate([N, -shape], axis=1), nodes
