"""Edges that a live pressure leaves open.

p int n . v da is the variation of p V, V the volume between the surface and a point, where every
edge is held or stays in a plane through that point. Else a line integral over the edge remains. Its
curl, p int (v x w) . dx for two motions v and w of the edge (Romano 1972, Buefler 1984,
Schweizerhof and Ramm 1984), vanishes where the edge moves in a single direction or in its own
plane: then the pressure has a potential, `densities.swept_volume`. Elsewhere it has none.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence, Set

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.mirror import PLANARITY_TOLERANCE
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.shell.parameters import Condition, HeldComponents

Array = NDArray[np.float64]


def moving(edges: Mapping[str, Set[Hashable]], conditions: Mapping[str, Condition]) -> list[str]:
    """Names of the edges with sides that neither are held nor lie in a plane of symmetry.

    Parameters
    ----------
    edges
        Name -> sides of cells, in any way that two names share.
    """
    closed = set[Hashable]().union(
        *(edges[name] for name, c in conditions.items() if name in edges and closes(c))
    )
    return [name for name, sides in edges.items() if sides - closed]


def closes(condition: Condition) -> bool:
    """Whether an edge is held, or lies in a plane of symmetry."""
    if isinstance(condition, HeldComponents):
        return len(condition.components) == 3
    return condition != "free"


def without_potential(
    names: Sequence[str], conditions: Mapping[str, Condition], places: Callable[[str], Array]
) -> tuple[str, ...]:
    """Those of some moving edges at which a live pressure has no potential.

    Parameters
    ----------
    places
        Name -> places (n, 3) on the undeformed edge.
    """

    def has(name: str) -> bool:
        condition = conditions.get(name, "free")
        if not isinstance(condition, HeldComponents):
            return False
        axes = list(condition.components)
        return len(axes) == 2 or bool(
            np.ptp(places(name)[:, axes], axis=0).max() < PLANARITY_TOLERANCE
        )

    return tuple(name for name in names if not has(name))


def openings(
    r0: fem.Function,
    edges: Mapping[str, NDArray[np.int32]],
    conditions: Mapping[str, Condition],
    nodes: NDArray[np.bool_] | None = None,
) -> tuple[list[str], tuple[str, ...]]:
    """The moving edges of a model, and those of them without potential; collective.

    Parameters
    ----------
    edges
        Name -> facets on this rank.
    nodes
        The nodes that are on the edges' line; None for all.
    """
    V = r0.function_space
    comm, dim = V.mesh.comm, V.mesh.topology.dim - 1

    def places(name: str) -> Array:
        dofs = fem.locate_dofs_topological(V, dim, edges[name])
        by_rank = r0.x.array.reshape(-1, 3)[dofs if nodes is None else dofs[nodes[dofs]]]
        return np.concatenate(comm.allgather(by_rank))

    by_rank = comm.allgather(
        moving({name: set(map(int, facets)) for name, facets in edges.items()}, conditions)
    )
    names = [name for name in edges if any(name in rank for rank in by_rank)]
    return names, without_potential(names, conditions, places)


def on_cells(sides: Mapping[str, float], midsurface: Midsurface | Meridian) -> fem.Function:
    """Of each cell, (1,): the side on which a pressure acts there, 0 on others.

    Parameters
    ----------
    sides
        Patch -> 1 from outside, -1 from inside.
    """
    Q = fem.functionspace(midsurface.mesh, ("DG", 0, (1,)))
    pressed = fem.Function(Q, name="pressed")
    for name, side in sides.items():
        pressed.x.array[Q.dofmap.list[midsurface.patches[name]].ravel()] = side
    return pressed


def on_each(pressed: fem.Function) -> Array:
    """The same as an array (cells,)."""
    return np.asarray(pressed.x.array[pressed.function_space.dofmap.list[:, 0]])


def beside(
    edges: Mapping[str, NDArray[np.int32]], pressed: fem.Function
) -> dict[str, NDArray[np.int32]]:
    """The parts of edges, facets on this rank, whose cells are pressed."""
    topology, sides = pressed.function_space.mesh.topology, on_each(pressed)
    topology.create_connectivity(1, 2)
    links = topology.connectivity(1, 2)

    def acts(facet: int) -> bool:
        return bool(sides[links.links(facet)[0]])

    return {
        name: facets[np.array([acts(f) for f in facets], dtype=bool)]
        for name, facets in edges.items()
    }


def side_of(end: str, on: Mapping[str, float]) -> float:
    """The side on which a pressure acts on the shell of an end, as of `on_cells`; without `on` all
    from outside.
    """
    return (
        next((side for shell, side in on.items() if end.startswith(f"{shell}_")), 0.0)
        if on
        else 1.0
    )


def ring_openings(
    ends: Mapping[str, Array], conditions: Mapping[str, Condition], on: Mapping[str, float]
) -> tuple[list[str], tuple[str, ...]]:
    """The same of a meridian with ends at (rho, z), of shells that a pressure acts on, see
    `side_of`.
    """
    ends = {name: at for name, at in ends.items() if side_of(name, on)}

    def ring(name: str) -> Array:
        rho, z = ends[name]
        return np.array([[rho, 0, z], [0, rho, z], [-rho, 0, z]])

    names = moving({name: {name} for name in ends}, conditions)
    return names, without_potential(names, conditions, ring)


def meridian_openings(
    meridian: Meridian, conditions: Mapping[str, Condition], on: Mapping[str, float]
) -> tuple[list[str], tuple[str, ...]]:
    """The ends that are not held, and those of them where a live pressure has no potential."""
    places = {
        name: meridian.section(np.array([meridian.parameter(name)]))[0] for name in meridian.ends
    }
    return ring_openings(places, conditions, on)


def no_potential(names: Sequence[str]) -> str:
    """What is said of such edges."""
    where = f"edge{'s' * (len(names) > 1)} {', '.join(names)}"
    return (
        f"a potential of the pressure, which follows the free {where}: volume_change and the pressure's part of "
        "energy are those of a straight motion from the undeformed shape; of instabilities, flutter is not looked for"
    )
