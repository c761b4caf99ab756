"""Nodes whose displacement is prescribed by rigid motions, and edges whose normals turn with them."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.assembly.lids import Pressed
from magshell_fenicsx.assembly.motion import Motion, Pair, moved, turned

Array = NDArray[np.float64]
Amplitudes = Mapping[str, float]
PLANE = {2: (0, 2), 3: (0, 1, 2)}  # the axes of a displacement's components


@dataclass(frozen=True)
class Body:
    """What moves as one rigid body.

    Attributes
    ----------
    motions
        One after the other.
    dofs
        Local numbers, with ghosts, of the components that are prescribed.
    edge
        Name of the term that holds the normal of a clamped edge; "" without.
    turn
        The rotation in that term; None if no motion turns.
    """

    motions: Sequence[Motion]
    dofs: NDArray[np.int32]
    edge: str = ""
    turn: fem.Constant | None = None

    @property
    def names(self) -> set[str]:
        return {motion.name for motion in self.motions}


class Moving:
    """The displacement E(mu) of all nodes that move; vectors are local, with ghosts.

    The energy of a clamped edge depends on its normal through Q^T r alone, Q the edge's rotation. So its derivatives
    by Q are those by the displacement along A r, with A = Q dQ^T.

    Parameters
    ----------
    r0
        The placement.
    pressed
        What a live pressure does at edges that move.
    """

    def __init__(self, r0: fem.Function, bodies: Sequence[Body], pressed: Pressed | None = None) -> None:
        self.pressed = pressed
        self._axes = list(PLANE[r0.function_space.dofmap.index_map_bs])
        self._r0, self._bodies = r0, bodies
        places = in_space(r0.x.array, len(self._axes))
        self._places = [places[body.dofs // len(self._axes)] for body in bodies]
        self.names = frozenset(name for body in bodies for name in body.names)
        V = r0.function_space
        still = np.zeros(len(r0.x.array) // len(self._axes), dtype=bool)
        for body in bodies:
            still[body.dofs // len(self._axes)] = True
        self.cells = still[V.dofmap.list].any(axis=1)  # local cells with a node that moves

    def put(self, u: Array, mu: Amplitudes) -> None:
        """Write E(mu) into a displacement."""
        for body, places in zip(self._bodies, self._places, strict=True):
            u[body.dofs] = self._components(body, moved(body.motions, mu, places).x - places)

    def turn(self, mu: Amplitudes) -> None:
        """Write the rotations into the terms of the edges; amplitudes that are not given are zero."""
        for body in self._bodies:
            if body.turn is not None:
                body.turn.value[:] = turned(body.motions, dict.fromkeys(body.names, 0.0) | dict(mu)).x.T

    def rate(self, mu: Amplitudes, name: str) -> Array:
        """dE/dmu."""
        found = np.zeros(len(self._r0.x.array))
        for body, places in self._with(name):
            found[body.dofs] = self._components(body, moved(body.motions, mu, places).by[name])
        return found

    def bend(self, mu: Amplitudes, name: str, other: str) -> Array:
        """d2E/dmu_i dmu_j."""
        found = np.zeros(len(self._r0.x.array))
        for body, places in self._with(name, other):
            found[body.dofs] = self._components(body, moved(body.motions, mu, places).twice[name, other])
        return found

    def on_edges(self, u: Array) -> Array:
        """Nodal forces of p = 1 that the derivative of its potential does not have, see `Pressed.on_edges`."""
        if not (self.pressed and self.pressed.curves):
            return np.zeros_like(u)
        return self.pressed.on_edges(self._r0.x.array.reshape(-1, 3), u.reshape(-1, 3)).ravel()

    def turning(self, mu: Amplitudes, name: str) -> Iterator[tuple[str, Array]]:
        """Edges that the motion turns, each with A = Q dQ^T/dmu (3, 3)."""
        for body, _ in self._with(name):
            if body.turn is not None:
                now = turned(body.motions, mu)
                yield body.edge, now.x.T @ now.by[name]

    def turning_twice(self, mu: Amplitudes, pair: Pair) -> Iterator[tuple[str, Array]]:
        """The same edges with dA_i/dmu_j."""
        for body, _ in self._with(*pair):
            if body.turn is not None:
                now = turned(body.motions, mu)
                yield body.edge, now.by[pair[1]].T @ now.by[pair[0]] + now.x.T @ now.twice[pair]

    def along(self, A: Array, u: Array) -> Array:
        """The displacement A r."""
        return self.times(A, self._r0.x.array + u)

    def times(self, A: Array, v: Array) -> Array:
        """A matrix (3, 3) times the vectors of all nodes."""
        return np.ascontiguousarray((in_space(v, len(self._axes)) @ A.T)[:, self._axes]).ravel()

    def _with(self, *names: str) -> Iterator[tuple[Body, Array]]:
        """Bodies that all these motions move, with the places of their nodes."""
        for body, places in zip(self._bodies, self._places, strict=True):
            if body.names.issuperset(names):
                yield body, places

    def _components(self, body: Body, vectors: Array) -> Array:
        axes = np.array(self._axes)[body.dofs % len(self._axes)]
        return np.asarray(vectors[np.arange(len(axes)), axes])


def in_space(v: Array, components: int) -> Array:
    """Vectors (n, 3) of nodes with all components, or with those of the plane of a meridian."""
    found = np.zeros((len(v) // components, 3))
    found[:, PLANE[components]] = v.reshape(-1, components)
    return found
