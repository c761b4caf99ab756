"""The contacts of a model: its cells on all ranks, and the points of their quadrature."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
from dolfinx import fem, mesh
from numpy.typing import NDArray

from magshell_fenicsx.assembly.global_mesh import GlobalCells, gather_rows, global_values
from magshell_fenicsx.mesh.mirror import Image, Mirror
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.parts.gap import Grown
from magshell_fenicsx.parts.touching.by_fields import Shape
from magshell_fenicsx.parts.touching.faces import Faces
from magshell_fenicsx.parts.touching.mirrored import Images, Mirrored
from magshell_fenicsx.parts.touching.nearest import Cells, Longs
from magshell_fenicsx.parts.touching.section import WHOLE, Pair
from magshell_fenicsx.parts.touching.segments import Segments
from magshell_fenicsx.parts.touching.touching import Touching

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
    thickness: fem.Function | None = None,
    thins: Array | int = 0,
    images: Sequence[Image] = (),
    on_planes: Sequence[NDArray[np.int32]] = (),
    natural: Grown | None = None,
    planes: Sequence[Mirror] = (),
) -> list[Touching]:
    """The contacts of pairs; collective.

    Parameters
    ----------
    patches
        Name -> which cells of this rank.
    h
        Thickness over R; where it varies, that of the first shell.
    degree
        Of the quadrature.
    thickness
        What multiplies h, (1,); None for 1.
    thins
        1 in the cells of this rank (cells, 1) whose thickness follows from their area, or in all;
        else 0.
    images
        Of a half or a sector the copies that make the whole, itself first; none of a whole.
    on_planes
        The sides of this rank's cells on their planes.
    natural
        The natural shape; None if it is the drawn one.
    planes
        Of symmetry.

    Raises
    ------
    MeshError
        On every rank, if the surfaces of a pair overlap undeformed.
    """
    if not pairs:
        return []
    V = r0.function_space
    domain, comm, index, element = V.mesh, V.mesh.comm, V.dofmap.index_map, V.element.basix_element
    topology, cells_of_all = domain.topology, GlobalCells.gather(V)
    count, first = len(cells_of_all.own_range), cells_of_all.own_range.start
    for dims in ((2, 0), (0, 2), (1, 0)):
        topology.create_connectivity(*dims)

    nodes = cells_of_all.nodes[first : first + count]
    corners = topology.index_map(0).local_to_global(
        topology.connectivity(2, 0).array[: 3 * count].astype(np.int32)
    )
    cells = Cells(element, cells_of_all.nodes, cells_of_all.gather_values(corners.reshape(-1, 3)))
    placed = global_values(r0)
    local = first, count + topology.index_map(2).num_ghosts
    times, thinning = (
        np.ones(nodes.shape),
        np.broadcast_to(np.asarray(thins) > 0, (local[1], 1))[:, 0],
    )
    if thickness is not None:
        times = thickness.x.array[thickness.function_space.dofmap.list[:count]]
    powers, grown = np.array([times]), None
    if natural and natural.stretch is not None:
        of_nodes = element.tabulate(1, element.points)[1:, ..., 0]
        tangents = np.einsum("dqk,nki->dnqi", of_nodes, r0.x.array.reshape(-1, 3)[V.dofmap.list])
        rates = natural.volumes(tangents, element.points)
        rates[:, ~thinning] = np.eye(4)[0][:, None, None]
        powers, grown = times * rates[:, :count], natural.stretch
    powers, keeps_volume = (
        np.array([cells_of_all.gather_values(each) for each in powers]),
        cells_of_all.gather_values(thinning),
    )
    named = {name: cells_of_all.gather_values(inside) for name, inside in patches.items()}
    named[WHOLE] = np.ones(len(cells.nodes), dtype=bool)
    own = 3 * index.local_range[0], 3 * index.size_local
    moved: Callable[[], Array] = partial(global_values, u)
    kind: Callable[..., Touching] = Touching
    same = np.arange(len(placed))
    if images:
        copies = Images(images, len(placed))
        same = copies.shared(placed, _nodes(V, on_planes)).ravel()
        vertices = _vertices(topology, on_planes)
        cells, placed = copies.cells(cells, placed, vertices), copies.placed(placed)
        named = {name: copies.each(inside) for name, inside in named.items()}
        powers, keeps_volume = (
            np.array([copies.each(each) for each in powers]),
            copies.each(keeps_volume),
        )
        kind, own, moved = (
            partial(Mirrored, copies, own),
            (0, placed.size),
            lambda: copies.moved(global_values(u)),
        )
    varies = thickness is not None or keeps_volume.any()
    faces = Faces(cells, placed, h, powers, keeps_volume, same, grown) if varies else None
    segments = Segments(
        cells, first + np.arange(count), placed, (degree, element.degree), h, planes
    )
    shape = Shape(r0, thickness, cells_of_all.nodes, slice(first, first + count))
    made = list[Touching]()
    for pair in pairs:
        one, other = (named[name] for name in pair.names)

        def allowed(
            i: Longs, j: Longs, one: Inside = one, other: Inside = other
        ) -> NDArray[np.bool_]:
            return np.asarray((one[i] & other[j]) | (other[i] & one[j]))

        of_both = np.unique(cells.nodes[one | other])
        touching = kind(
            pair,
            cells,
            segments,
            allowed,
            h,
            placed,
            moved,
            own,
            local,
            comm,
            of_both,
            shape,
            faces,
        )
        deep, place = touching.deepest()
        if deep > WITHIN * h:
            where = ", ".join(f"{x:.4g}" for x in place + 0.0)
            raise MeshError(
                f"contact: {pair.words} overlap undeformed, by {deep / h:.4g} h at ({where}) R: move them apart"
            )
        made.append(touching)
    return made


def _nodes(V: fem.FunctionSpace, sides: Sequence[NDArray[np.int32]]) -> Longs:
    """Global numbers of the nodes of sides of cells, of all ranks; collective."""
    local = fem.locate_dofs_topological(
        V, 1, np.concatenate([*sides, np.empty(0, np.int32)]), remote=False
    )
    numbers = V.dofmap.index_map.local_to_global(local)
    return np.asarray(np.unique(gather_rows(V.mesh.comm, numbers)))


def _vertices(topology: mesh.Topology, sides: Sequence[NDArray[np.int32]]) -> Longs:
    """Global numbers of the vertices of sides of cells, of all ranks; collective."""
    of_side, of_all = topology.connectivity(1, 0), topology.index_map(0)
    local = [of_side.links(int(side)) for side in np.concatenate(sides)]
    numbers = of_all.local_to_global(
        np.concatenate([*local, np.empty(0, np.int32)]).astype(np.int32)
    )
    return np.asarray(np.unique(gather_rows(topology.comm, numbers)))
