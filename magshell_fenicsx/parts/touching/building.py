"""The contacts of a model: its cells on all ranks, and the points of their quadrature."""

from collections.abc import Mapping, Sequence
from typing import Any

import basix
import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.parts.touching.nearest import Cells, Longs
from magshell_fenicsx.parts.touching.section import WHOLE
from magshell_fenicsx.parts.touching.touching import Pair, Points, Touching

Array = NDArray[np.float64]
Inside = NDArray[np.bool_]
WITHIN = 1e-6  # penetration over h that is rounding


def touchings(
    pairs: Sequence[Pair],
    r0: fem.Function,
    u: fem.Function,
    patches: Mapping[str, NDArray[np.bool_]],
    h: float,
    degree: int,
) -> list[Touching]:
    """The contacts of pairs; collective.

    Parameters
    ----------
    patches
        Name -> which cells of this rank.
    h
        Thickness over R.
    degree
        Of the quadrature.

    Raises
    ------
    MeshError
        On every rank, if a pair names no patch, or its surfaces overlap undeformed.
    """
    if not pairs:
        return []
    V = r0.function_space
    domain, comm, index, element = V.mesh, V.mesh.comm, V.dofmap.index_map, V.element.basix_element
    topology = domain.topology
    count = topology.index_map(2).size_local
    for dims in ((2, 0), (0, 2)):
        topology.create_connectivity(*dims)

    def gathered(own: NDArray[Any]) -> NDArray[Any]:
        return np.concatenate(comm.allgather(own))

    def of_nodes(f: fem.Function) -> Array:
        return np.asarray(gathered(f.x.array[: 3 * index.size_local])).reshape(-1, 3)

    nodes = index.local_to_global(V.dofmap.list[:count].ravel().astype(np.int32)).reshape(count, -1)
    corners = topology.index_map(0).local_to_global(topology.connectivity(2, 0).array[: 3 * count].astype(np.int32))
    cells = Cells(element, gathered(nodes), gathered(corners.reshape(-1, 3)))
    first = sum(comm.allgather(count)[: comm.rank])
    X, weights = basix.make_quadrature(basix.CellType.triangle, degree)
    table = element.tabulate(1, X)[..., 0]
    placed = of_nodes(r0)
    a1, a2 = np.einsum("dqk,nki->dnqi", table[1:], placed[nodes])
    points = Points(
        np.repeat(first + np.arange(count), len(X)),
        np.tile(table[0], (count, 1)),
        (weights * np.linalg.norm(np.cross(a1, a2), axis=2)).ravel(),
        first,
        count + topology.index_map(2).num_ghosts,
    )
    named = {name: gathered(inside[:count]) for name, inside in patches.items()}
    named[WHOLE] = np.ones(len(cells.nodes), dtype=bool)
    made = list[Touching]()
    for pair in pairs:
        for name in pair.names:
            if name not in named:
                there = ", ".join(sorted(named))
                raise MeshError(f"contact: {name}: the surface has no such part, only {there}")
        one, other = (named[name] for name in pair.names)
        for before in made:
            a, b = (named[name] for name in before.pair.names)
            if ((one & a).any() and (other & b).any()) or ((one & b).any() and (other & a).any()):
                raise MeshError(
                    f"contact: {pair.words}: shares cells with {before.pair.words}: no place is in two pairs"
                )

        def allowed(i: Longs, j: Longs, one: Inside = one, other: Inside = other) -> NDArray[np.bool_]:
            return np.asarray((one[i] & other[j]) | (other[i] & one[j]))

        own = 3 * index.local_range[0], 3 * index.size_local
        own_h = pair.thickness * h
        touching = Touching(pair, cells, points, allowed, own_h, placed, lambda: of_nodes(u), own, comm)
        deep, place = touching.deepest()
        if deep > WITHIN * own_h:
            where = ", ".join(f"{x:.4g}" for x in place + 0.0)
            raise MeshError(
                f"contact: {pair.words} overlap undeformed, by {deep / h:.4g} h at ({where}) R: move them apart"
            )
        made.append(touching)
    return made
