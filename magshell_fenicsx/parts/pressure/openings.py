"""Edges that a live pressure leaves open.

p int n . v da is the variation of p V, V the volume between the surface and a point, where every
edge is held or stays in a plane through that point. Else a line integral over the edge remains. Its
curl, p int (v x w) . dx for two motions v and w of the edge (Romano 1972, Buefler 1984,
Schweizerhof and Ramm 1984), vanishes where the edge moves in a single direction or in its own
plane: then the pressure has a potential, `densities.swept_volume`. Elsewhere it has none.

A live pressure turns with the surface and follows its area. An edge is closed if it is held or lies
in a plane of symmetry; a moving edge is one with a part that is not. Openings are the moving edges,
with those of them at which the pressure has no potential. So is the border of a pressed part within
the surface. The side of a cell or shell is the face
that is pressed: 1 outside, -1 inside, 0 none. On a meridian, the curve of a shell of revolution, an
edge is an end.
"""

from collections.abc import Callable, Hashable, Mapping, Sequence, Set

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.mirror import PLANARITY_TOLERANCE
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.shell.parameters import Condition, HeldComponents

Array = NDArray[np.float64]
INNER_BORDER = "where the pressed part ends"  # in place of an edge's name


def moving_edges(
    edges: Mapping[str, Set[Hashable]], conditions: Mapping[str, Condition]
) -> list[str]:
    """Return the names of edges with a part that neither is held nor lies in a plane of symmetry.

    Parameters
    ----------
    edges
        Name of each edge -> its sides of cells, known by labels such as the numbers of facets. Two
        edges may share sides.
    conditions
        Name of an edge -> its support; an edge without one is free.
    """
    closed_edges = [
        name for name, condition in conditions.items() if name in edges and is_closed(condition)
    ]
    closed_sides = set[Hashable]().union(*(edges[name] for name in closed_edges))
    return [name for name, sides in edges.items() if sides - closed_sides]


def is_closed(condition: Condition) -> bool:
    """Return whether an edge with this support is held, or lies in a plane of symmetry."""
    if isinstance(condition, HeldComponents):
        return len(condition.components) == 3
    return condition != "free"


def without_potential(
    names: Sequence[str], conditions: Mapping[str, Condition], places: Callable[[str], Array]
) -> tuple[str, ...]:
    """Return the moving edges at which a live pressure has no potential.

    It has one where the edge moves in a single direction or in its own plane.

    Parameters
    ----------
    names
        Names of moving edges.
    conditions
        Name of an edge -> its support.
    places
        Name of an edge -> places (n, 3) on it, undeformed over R.
    """

    def has_potential(name: str) -> bool:
        """Return whether an edge moves in a single direction, or in its own plane."""
        condition = conditions.get(name, "free")
        if not isinstance(condition, HeldComponents):
            return False
        axes = list(condition.components)  # that are held
        if len(axes) == 2:  # it moves along the third axis
            return True
        # it moves in its own plane if the held coordinate is the same at all its places
        return bool(np.ptp(places(name)[:, axes], axis=0).max() < PLANARITY_TOLERANCE)

    return tuple(name for name in names if not has_potential(name))


def edge_openings(
    r0: fem.Function,
    edges: Mapping[str, NDArray[np.int32]],
    conditions: Mapping[str, Condition],
    nodes: NDArray[np.bool_] | None = None,
) -> tuple[list[str], tuple[str, ...]]:
    """Return the moving edges of a surface, and those of them without potential; collective.

    Parameters
    ----------
    r0
        Undeformed placement over R.
    edges
        Name of each edge -> its facets on this rank.
    conditions
        Name of an edge -> its support.
    nodes
        Flags of the nodes that are on the edges' line; None for all.
    """
    V = r0.function_space
    comm, dim = V.mesh.comm, V.mesh.topology.dim - 1

    def places(name: str) -> Array:
        """Return the places (n, 3) of an edge, from all ranks."""
        dofs = fem.locate_dofs_topological(V, dim, edges[name])
        if nodes is not None:  # on the edges' line alone
            dofs = dofs[nodes[dofs]]
        own_places = r0.x.array.reshape(-1, 3)[dofs]
        return np.concatenate(comm.allgather(own_places))

    # the sides of an edge are its facets; an edge moves if it does on any rank
    sides = {name: set(map(int, facets)) for name, facets in edges.items()}
    moving_on_ranks = comm.allgather(moving_edges(sides, conditions))
    moving_names = set[str]().union(*moving_on_ranks)
    names = [name for name in edges if name in moving_names]
    return names, without_potential(names, conditions, places)


def side_field(sides: Mapping[str, float], midsurface: Midsurface | Meridian) -> fem.Function:
    """Return a cellwise constant field (1,): the side from which a pressure acts, else 0.

    Parameters
    ----------
    sides
        Name of a patch -> 1 from outside, -1 from inside.
    """
    Q = fem.functionspace(midsurface.mesh, ("DG", 0, (1,)))
    side_of_cells = fem.Function(Q, name="pressed")
    for name, side in sides.items():
        side_of_cells.x.array[Q.dofmap.list[midsurface.patches[name]].ravel()] = side
    return side_of_cells


def sides_of_cells(side_of_cells: fem.Function) -> Array:
    """Return the values of a `side_field` as an array (cells,)."""
    return np.asarray(side_of_cells.x.array[side_of_cells.function_space.dofmap.list[:, 0]])


def ends_within(side_of_cells: fem.Function | None) -> tuple[str, ...]:
    """Return `INNER_BORDER` if a pressed part ends within the surface, else nothing; collective.

    There the surface moves, and a live pressure has no potential. `side_of_cells` is a
    `side_field`, or None where all is pressed from outside.
    """
    if side_of_cells is None:
        return ()
    mesh, sides = side_of_cells.function_space.mesh, sides_of_cells(side_of_cells)
    dim = mesh.topology.dim
    mesh.topology.create_connectivity(dim - 1, dim)
    cells_of_facets = mesh.topology.connectivity(dim - 1, dim)
    facets = range(cells_of_facets.num_nodes)
    is_there = any(np.ptp(sides[cells_of_facets.links(facet)]) > 0 for facet in facets)
    return (INNER_BORDER,) if mesh.comm.allreduce(is_there, MPI.LOR) else ()


def pressed_parts(
    edges: Mapping[str, NDArray[np.int32]], side_of_cells: fem.Function
) -> dict[str, NDArray[np.int32]]:
    """Return the facets of each edge, on this rank, whose cells are pressed.

    Parameters
    ----------
    edges
        Name of each edge -> its facets.
    side_of_cells
        Field of the side that is pressed in each cell: 1 outside, -1 inside, 0 none.
    """
    topology, sides = side_of_cells.function_space.mesh.topology, sides_of_cells(side_of_cells)
    topology.create_connectivity(1, 2)
    links = topology.connectivity(1, 2)

    def select_pressed(facets: NDArray[np.int32]) -> NDArray[np.int32]:
        # a facet of an edge has one cell
        is_pressed = [bool(sides[links.links(facet)[0]]) for facet in facets]
        return np.asarray(facets[np.array(is_pressed, dtype=bool)])

    return {name: select_pressed(facets) for name, facets in edges.items()}


def side_of(end: str, sides: Mapping[str, float]) -> float:
    """Return the side from which a pressure acts on the shell of an end: 1, -1, or 0.

    Without sides all shells are pressed from outside.

    Parameters
    ----------
    end
        Name of an end, of several shells "SHELL_...".
    sides
        Name of a shell -> 1 from outside, -1 from inside.
    """
    if not sides:
        return 1.0
    return next((side for shell, side in sides.items() if end.startswith(f"{shell}_")), 0.0)


def ring_openings(
    ends: Mapping[str, Array], conditions: Mapping[str, Condition], sides: Mapping[str, float]
) -> tuple[list[str], tuple[str, ...]]:
    """Return the moving ends of a meridian, and those of them without potential.

    Only ends of pressed shells count. An end is a circle about the axis; the pressure has a
    potential there if it moves in a single direction or in its own plane.

    Parameters
    ----------
    ends
        Name of each end -> its place (rho, z) over R.
    conditions
        Name of an end -> its support.
    sides
        Name of a shell -> 1 if it is pressed from outside, -1 from inside. Without any, all shells
        are pressed from outside.
    """
    ends = {name: place for name, place in ends.items() if side_of(name, sides)}

    def ring(name: str) -> Array:
        rho, z = ends[name]
        # three places of the circle, in x, y, z, show in which plane it is
        return np.array([[rho, 0, z], [0, rho, z], [-rho, 0, z]])

    # an end is one side, which may have the end's name as its label
    names = moving_edges({name: {name} for name in ends}, conditions)
    return names, without_potential(names, conditions, ring)


def meridian_openings(
    meridian: Meridian, conditions: Mapping[str, Condition], sides: Mapping[str, float]
) -> tuple[list[str], tuple[str, ...]]:
    """Return the moving ends of a meridian, and those at which a pressure has no potential.

    Parameters
    ----------
    conditions
        Name of an end -> its support.
    sides
        Name of a shell -> side on which a pressure acts; empty: all from outside.
    """
    # (rho, z) of each end: `section` takes several parameters and returns a row for each
    places = {
        name: meridian.section(np.array([meridian.parameter(name)]))[0] for name in meridian.ends
    }
    return ring_openings(places, conditions, sides)


def no_potential(names: Sequence[str]) -> str:
    """Return the message that a live pressure has no potential at some named edges."""
    edges = f"edge{'s' * (len(names) > 1)} {', '.join(names)}"
    return (
        f"a potential of the pressure, which follows the free {edges}: volume_change and the "
        "pressure's part of energy are those of a straight motion from the undeformed shape; of "
        "instabilities, flutter is not looked for"
    )
