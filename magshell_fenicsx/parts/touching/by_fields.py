"""What the energy of a contact changes by with its faces' growth, the thickness, and the place that
it is drawn at.

The gap depends on half the thickness H at nodes, H = V/A with V = (h/2) sum t J0 of the cells
around (see `faces`), and on the places r0 + u; the energy is a sum over points with the weights
J0(X). So of e Pi + f w . Pi,u the derivative is

    by t:  (h/2) J0 g_V,    g_V = g/A + f Pi,H (H,u w)/V,    g = e Pi,H + f (Pi,Hu w + Pi,HH H,u w),

and by r0 that by u, with what the weights and the undeformed areas in V and A add. The points stay
in their cells.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.free_parameters import Derivative, FreeParameter
from magshell_fenicsx.assembly.nonlocal_terms import Entries
from magshell_fenicsx.parts.touching.faces import Faces, Meshed, on_nodes, slope_of
from magshell_fenicsx.parts.touching.nearest import Joined, Longs, Places
from magshell_fenicsx.parts.touching.segments import Points

if TYPE_CHECKING:
    from magshell_fenicsx.parts.touching.curves import Faced, Rule

Array = NDArray[np.float64]
Penalty = tuple[Array, Array, Array]


@dataclass(frozen=True)
class Shape:
    """The fields that a gap depends on.

    Attributes
    ----------
    r0, thickness
        The undeformed place, and what multiplies h; None for 1.
    nodes
        (cells, functions) of all cells that are modelled.
    own
        Which of them are this rank's.
    """

    r0: fem.Function
    thickness: fem.Function | None
    nodes: Longs
    own: slice

    def shared(self, forces: Array) -> Array:
        """Those (nodes, d) on all nodes as parts (cells, functions, d) of this rank's cells."""
        count = np.bincount(self.nodes.ravel(), minlength=len(forces))
        return np.asarray((forces / np.maximum(count, 1)[:, None])[self.nodes[self.own]])


@dataclass(frozen=True)
class Present:
    """A contact at a state; all is of this rank's points.

    Attributes
    ----------
    r0, u
        All nodes (nodes, 3).
    pressed
        The penalty of joined places, with its derivatives by the penetration.
    forces
        Derivatives (nodes, 3 or 4) of the energy by places and H.
    find_by_parts, find_entries
        Second derivatives by these, and by u.
    geometry
        Of places: distances, normals, and beta with its nodes, see `touching`.
    """

    cells: Meshed
    r0: Array
    u: Array
    faces: Faces | None
    points: "Points | Rule"
    places: "Places | Faced"
    joined: Joined
    pressed: Penalty
    forces: Array
    find_by_parts: Callable[[], Entries]
    find_entries: Callable[[], Entries]
    geometry: Callable[[Any], tuple[Array, Array, Array, Longs]]

    @cached_property
    def of_faces(self) -> Faces:
        """They are there."""
        assert self.faces
        return self.faces

    def changed(self, along: Array) -> Array:
        """What the forces change by along changes (nodes, 4) of places and H."""
        rows, columns, values = self.find_by_parts()
        flat = np.concatenate([along[:, :-1].ravel(), along[:, -1]])
        product = np.bincount(rows, values * flat[columns], len(flat))
        count = self.r0.size
        return np.column_stack([product[:count].reshape(self.r0.shape), product[count:]])

    def moved(self, w: Array) -> Array:
        """What places and H change by along w (nodes, 3)."""
        return np.column_stack([w, self.faces.change(self.u, w)]) if self.faces else w

    def on_nodes(self, forces: Array) -> Array:
        """See `faces.on_nodes`."""
        return on_nodes(self.faces, self.u, forces)

    def of_weights(self, tables: Array, places: Array) -> Array:
        """The derivatives (n, functions, 3) of weights by nodes, relative.

        Parameters
        ----------
        tables, places
            Shape functions at points with their derivatives (3, n, functions), and so the places
            (3, n, 3).
        """
        n = np.cross(*places[1:])
        n = n / np.sum(n * n, axis=1)[:, None]
        one, two = (np.cross(a, b)[:, None] for a, b in ((places[2], n), (n, places[1])))
        return np.asarray(tables[1][..., None] * one + tables[2][..., None] * two)

    def deeper(self, w: Array) -> Array:
        """What penetrations of joined places change by along w (nodes, 3)."""
        _, n, beta, nodes = self.geometry(self.places)
        moved = self.moved(w)
        moves = -np.einsum("nki,nki->n", slope_of(n, beta, moved.shape[1]), moved[nodes])
        return np.bincount(
            self.joined.group, self.joined.weight * moves, len(self.joined.first)
        ).astype(float)


@dataclass(frozen=True)
class ByGrowth:
    """A derivative of the energy by the natural stretch, on which the thickness of faces depends."""

    of: Callable[[], Present]
    add: Callable[[Array, Array], None]
    order: int = 1
    amplitude: str | None = None

    def energy(self) -> float:
        """On this rank's part."""
        now = self.of()
        forces, growth = now.forces[:, -1], now.of_faces.by_growth(now.u, self.order)
        of_forces = (
            float(_grown(now)[:, -1] @ now.of_faces.by_growth(now.u)) if self.order == 2 else 0.0
        )
        return of_forces + float(forces @ growth)

    def add_residual(self, b: Array, factor: float) -> None:
        """Add factor times the gradient of the first one; collective."""
        now = self.of()
        forces = now.on_nodes(_grown(now)) + now.of_faces.slope_by_growth(now.u, now.forces[:, -1])
        self.add(b, factor * forces)


def with_growth(
    grows: FreeParameter, of: Callable[[], Present], add: Callable[[Array, Array], None]
) -> FreeParameter:
    """A parameter with the derivatives of a contact by it among its own."""

    def twice(q: object) -> Sequence[Derivative]:
        return [
            *grows.differentiate_slopes(q),
            *([ByGrowth(of, add, 2)] if q is grows.constant else []),
        ]

    return replace(grows, slopes=[*grows.slopes, ByGrowth(of, add)], differentiate_slopes=twice)


def _grown(now: Present) -> Array:
    """What the forces (nodes, 4) change by as the faces grow and nothing moves."""
    growth = now.of_faces.by_growth(now.u)
    return now.changed(np.column_stack([0 * now.u, growth]))


@dataclass(frozen=True)
class Weights:
    """Of energy Pi + force w . Pi,u; w (nodes, 3) is along all nodes."""

    w: Array
    energy: float
    force: float


def by_factor(now: Present, of: Weights) -> Array:
    """Its derivatives (cells, functions) by what multiplies h in the cells."""
    return now.of_faces.by_factor(_by_volumes(now, of)[0])


def by_place(now: Present, of: Weights) -> Array:
    """Its derivatives (nodes, 3) by the undeformed place."""
    rows, columns, values = now.find_entries()
    stiff = np.bincount(rows, values * of.w.ravel()[columns], now.r0.size).reshape(now.r0.shape)
    forces = of.energy * now.on_nodes(now.forces) + of.force * stiff + _by_weights(now, of)
    return forces + now.faces.by_area(*_by_volumes(now, of)) if now.faces else forces


def _by_volumes(now: Present, of: Weights) -> tuple[Array, Array]:
    """Its derivatives (nodes,) by the volumes V, and by the areas A, from which H follows."""
    H_w = now.of_faces.change(now.u, of.w)
    g = of.energy * now.forces[:, -1] + of.force * now.changed(np.column_stack([of.w, H_w]))[:, -1]
    volume, area = now.of_faces.ratio(now.u)
    slid = of.force * now.forces[:, -1] * H_w
    return g / area + slid / volume, -(g * volume / area + 2 * slid) / area


def _by_weights(now: Present, of: Weights) -> Array:
    """What it changes by (nodes, 3) as the areas around the points do."""
    forces = np.zeros_like(now.r0)
    if not len(now.places.point):
        return forces
    value, first, _ = now.pressed
    points, point = now.points, now.places.point[now.joined.first]
    per_weight = np.bincount(
        point, (of.energy * value + of.force * first * now.deeper(of.w)) / 2, len(points.cell)
    )
    some = np.unique(point)
    element, nodes = now.cells.element, now.cells.nodes[points.cell[some]]
    tables = element.tabulate(1, points.shape[some] @ element.points)[..., 0]
    slope = now.of_weights(tables, np.einsum("dnk,nki->dni", tables, now.r0[nodes]))
    np.add.at(forces, nodes, (per_weight[some] * points.weight[some])[:, None, None] * slope)
    return forces
