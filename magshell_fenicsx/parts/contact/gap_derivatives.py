"""Derivatives of gaps by the places of nodes, and by the offsets H of faces there.

The unknowns of a node are its place (2 or 3 components), and H where the thickness varies. See
`surface_contact` for the formulas and for beta.
"""

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.assembly.nonlocal_terms import Entries
from magshell_fenicsx.parts.contact.face_offsets import FaceOffsets, unknown_numbers
from magshell_fenicsx.parts.contact.projection import (
    COMPONENT_SIGNS,
    Cells,
    Longs,
    Projections,
    inverse_in_free_directions,
    jets,
    slopes,
)
from magshell_fenicsx.parts.contact.segments import ContactPoints

Array = NDArray[np.float64]


def gap_geometry(
    cells: Cells, points: ContactPoints, r: Array, places: Projections
) -> tuple[Array, Array, Array, Longs]:
    """Return distances (n,), normals (n, 3), beta and its nodes (n, functions of both cells).

    Parameters
    ----------
    r
        (nodes, 3) places of all nodes.
    """
    own_nodes = cells.nodes[points.cell[places.point]]
    nodes = np.concatenate([own_nodes, cells.nodes[places.cell]], axis=1)
    half, N = nodes.shape[1] // 2, points.shape[places.point]
    (shape, y), *_ = jets(cells.element, places.X, r[nodes[:, half:]], 0)
    off = np.einsum("nk,nki->ni", N, r[nodes[:, :half]]) - y
    d = np.linalg.norm(off, axis=1)
    return d, off / d[:, None], np.concatenate([N, -shape], axis=1), nodes


def distance_slopes(n: Array, beta: Array, components: int) -> Array:
    """Return the derivative (n, functions, components) of distances by the unknowns of nodes.

    Parameters
    ----------
    n, beta
        Normals (n, dim), and beta (n, functions of both cells).
    components
        dim, or one more: then the last is the derivative by H, which is -1 times the shape function
        on either side.
    """
    half = beta.shape[1] // 2
    by_offset = np.concatenate([-beta[:, :half], beta[:, half:]], axis=1)
    by_place = beta[:, :, None] * n[:, None, :]
    return np.asarray(np.concatenate([by_place, by_offset[..., None]], axis=2)[..., :components])


def gap_hessians(
    cells: Cells,
    places: Projections,
    geometry: tuple[Array, Array, Array, Longs],
    r: Array,
    penalties: tuple[Array, Array, Array],
) -> Array:
    """Return the Hessians (n, dofs, dofs) of the weighted penalty by the nodes of both cells.

    Parameters
    ----------
    geometry
        Distances, normals, beta and its nodes, see `gap_geometry`.
    r
        (nodes, components) all nodes, see `distance_slopes`.
    penalties
        Weights, and first and second derivatives of the penalty by the penetration.
    """
    (d, n, beta, nodes), (weight, first, second) = geometry, penalties
    half, components = nodes.shape[1] // 2, r.shape[1]
    shapes, y = zip(*jets(cells.element, places.X, r[nodes[:, half:]]), strict=True)
    normal = np.column_stack([n, 0 * d])[:, None, :components]
    off = d[:, None, None] * np.column_stack([n, np.ones_like(d)])[:, None, :components]
    A = slopes(off[:, 0], *y[1:])[1]
    free_directions = places.free_directions
    M = np.einsum(
        "nik,nkl,njl->nij",
        free_directions,
        inverse_in_free_directions(free_directions, A),
        free_directions,
    )
    C = np.zeros((len(d), 2, *beta.shape[1:], components))
    for a in range(2):
        tangential = y[1 + a][:, None] * (COMPONENT_SIGNS[:components] > 0)
        tangential -= np.sum(normal * tangential, axis=2, keepdims=True) * normal
        C[:, a] = -beta[:, :, None] * tangential
        C[:, a, half:] -= shapes[1 + a][:, :, None] * off
    pull = weight * first / d
    along_normal = beta[:, :, None] * normal
    rows = [distance_slopes(n, beta, components)[:, None], along_normal[:, None], C]
    row_vectors = np.concatenate(rows, axis=1).reshape(len(d), 4, -1)
    middle = np.zeros((len(d), 4, 4))
    middle[:, 0, 0] = weight * second
    middle[:, 1, 1] = pull
    middle[:, 2:, 2:] = pull[:, None, None] * M
    H = row_vectors.transpose(0, 2, 1) @ (middle @ row_vectors)
    of_places = pull[:, None, None] * beta[:, :, None] * beta[:, None, :]
    for i in range(3):
        H[:, i::components, i::components] -= of_places
    return np.asarray(H)


def joint_entries(
    slopes_of_places: Array, nodes: Longs, group: Longs, weight: Array, count: int
) -> Entries:
    """Return the entries that joined places have besides those of each place.

    Parameters
    ----------
    slopes_of_places, nodes, group
        Of all places: the weighted derivative (n, functions, components) of the distance, its
        nodes (n, functions), and the number (n,) of the joined place that it belongs to.
    weight
        (m,) of each joined place.
    count
        Number of all nodes.
    """
    components = slopes_of_places.shape[2]
    dofs = unknown_numbers(nodes, count, components)
    rows = np.repeat(group, dofs.shape[1])
    values = slopes_of_places.ravel(), (rows, dofs.ravel())
    G = scipy.sparse.coo_array(values, (len(weight), components * count)).tocsr()
    hessian = (G.T @ scipy.sparse.diags_array(weight) @ G).tocoo()
    return hessian.row.astype(np.int64), hessian.col.astype(np.int64), hessian.data


def forces_on_nodes(offsets: FaceOffsets | None, u: Array, forces: Array) -> Array:
    """Return the forces by the displacement u (nodes, dim), of those by places and offsets."""
    return np.asarray(forces[:, :-1] + offsets.slope(u, forces[:, -1])) if offsets else forces
