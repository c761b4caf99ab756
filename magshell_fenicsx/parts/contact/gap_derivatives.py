"""Derivatives of gaps by the places of nodes, and by the offsets H of faces there.

The unknowns of a node are its place (dim = 2 or 3 components), and the offset H, half the
thickness, where that varies. A place of `Projections` is the closest place y of the other surface
to a contact point x, in a cell with the shape functions N_y; y_a are its derivatives by the two
coordinates of the cell. beta are the shape functions of x, then minus those of y: so x - y is the
sum of beta times the nodes' places. The distance of mid-surfaces is d, its direction n. The second
derivative of d by the nodes' unknowns is

    d,uu = [beta beta (I - n n) - C^T A^-1 C]/d,   C_a = -beta y_a - d n (0, N_y,a),

where A is the Hessian of d^2/2 by the coordinates of y. Joined places are places of one point in
neighbouring cells that count as one.
"""

from collections.abc import Sequence

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
    """Return the distances between points and places, their normals, and beta with its nodes.

    Parameters
    ----------
    points, places
        Contact points, and n places that they face.
    r
        (nodes, 3) places of all nodes over R.

    Returns
    -------
    d, n
        (n,) distances of mid-surfaces over R, and (n, 3) unit vectors from places to points.
    beta, nodes
        (n, functions of both cells) shape functions of the point, minus those of the place; and the
        numbers of their nodes.
    """
    own_nodes = cells.nodes[points.cell[places.point]]
    nodes = np.concatenate([own_nodes, cells.nodes[places.cell]], axis=1)
    # the first half of a row's nodes belongs to the point, the second to the place
    half, shape_of_points = nodes.shape[1] // 2, points.shape[places.point]
    # shape functions at the places, and the places y; no derivatives
    (shape_of_places, y), *_ = jets(cells.element, places.X, r[nodes[:, half:]], order=0)
    off = np.einsum("nk,nki->ni", shape_of_points, r[nodes[:, :half]]) - y
    d = np.linalg.norm(off, axis=1)
    return d, off / d[:, None], np.concatenate([shape_of_points, -shape_of_places], axis=1), nodes


def distance_slopes(n: Array, beta: Array, components: int) -> Array:
    """Return the derivative (n, functions, components) of distances by the unknowns of nodes.

    Parameters
    ----------
    n, beta
        Normals (n, dim) from places to points, and beta (n, functions of both cells).
    components
        Unknowns of a node: dim, or dim + 1 with the offset H as the last one. The derivative by H
        is -1 times the shape function, of the point and of the place.
    """
    half = beta.shape[1] // 2  # functions of the point, before those of the place
    by_offset = np.concatenate([-beta[:, :half], beta[:, half:]], axis=1)
    by_place = beta[:, :, None] * n[:, None, :]
    by_all_unknowns = np.concatenate([by_place, by_offset[..., None]], axis=2)
    return np.asarray(by_all_unknowns[..., :components])  # without H where it is no unknown


def gap_hessians(
    cells: Cells,
    places: Projections,
    geometry: tuple[Array, Array, Array, Longs],
    r: Array,
    penalties: tuple[Array, Array, Array],
) -> Array:
    """Return the Hessians (n, dofs, dofs) of the weighted penalty by the nodes of both cells.

    With the penalty psi they are the weight times psi'' d,u d,u - psi' d,uu. They are computed as
    V^T c V with a 4 by 4 matrix c. The rows of V are d,u by all unknowns, d,u by places alone, C_1
    and C_2. At last the term beta beta I of d,uu is subtracted.

    Parameters
    ----------
    places
        n closest places y of contact points.
    geometry
        Distances, normals, beta, and the numbers of its nodes: the result of `gap_geometry`.
    r
        (nodes, components) places of all nodes; with the offset H as the last component where the
        thickness varies.
    penalties
        (n,) weights, and first and second derivatives of the penalty by the penetration.
    """
    (d, n, beta, nodes), (weight, first, second) = geometry, penalties
    half, components = nodes.shape[1] // 2, r.shape[1]  # the second half belongs to the place
    # shape functions at the places, and the places y, each with first and second derivatives
    shapes, place_jets = zip(*jets(cells.element, places.X, r[nodes[:, half:]]), strict=True)
    # n and d n; where H is an unknown, with one more component: 0 of n, and d of d n
    normal = np.column_stack([n, 0 * d])[:, None, :components]
    off = d[:, None, None] * np.column_stack([n, np.ones_like(d)])[:, None, :components]
    _, A = slopes(off[:, 0], *place_jets[1:])  # the Hessian of d^2/2 by the coordinates of y
    free_directions = places.free_directions
    # the inverse of A in the directions in which the place can move
    M = np.einsum(
        "nik,nkl,njl->nij",
        free_directions,
        inverse_in_free_directions(free_directions, A),
        free_directions,
    )
    # the four rows of V
    by_all, by_places = distance_slopes(n, beta, components), beta[:, :, None] * normal
    place_motion = _place_motion(beta, normal, off, shapes[1:3], place_jets[1:3])
    row_groups = [by_all[:, None], by_places[:, None], place_motion]
    row_vectors = np.concatenate(row_groups, axis=1).reshape(len(d), 4, -1)
    # the matrix c
    pressure_over_distance = weight * first / d
    coefficients = np.zeros((len(d), 4, 4))
    coefficients[:, 0, 0] = weight * second
    coefficients[:, 1, 1] = pressure_over_distance
    coefficients[:, 2:, 2:] = pressure_over_distance[:, None, None] * M
    H = row_vectors.transpose(0, 2, 1) @ (coefficients @ row_vectors)
    isotropic_part = pressure_over_distance[:, None, None] * beta[:, :, None] * beta[:, None, :]
    for i in range(3):  # components of places
        H[:, i::components, i::components] -= isotropic_part
    return np.asarray(H)


def _place_motion(
    beta: Array,
    normal: Array,
    off: Array,
    shape_slopes: Sequence[Array],
    tangents: Sequence[Array],
) -> Array:
    """Return the rows C_1 and C_2 (n, 2, functions of both cells, components) of n places.

    They say how a change of the nodes moves the closest place along y_1 and y_2.

    Parameters
    ----------
    beta
        (n, functions of both cells) shape functions of the points, then minus those of the places.
    normal, off
        (n, 1, components) n and d n, with 0 and d in the fourth component.
    shape_slopes, tangents
        For both directions the derivatives (n, functions) of shape functions at the places, and
        (n, components) of the places, y_1 and y_2.
    """
    components, half = normal.shape[2], beta.shape[1] // 2
    rows = np.zeros((len(beta), 2, *beta.shape[1:], components))
    for a, (shape_slope, tangent) in enumerate(zip(shape_slopes, tangents, strict=True)):
        # y_a without its component of H and without its part along the normal
        tangential = tangent[:, None] * (COMPONENT_SIGNS[:components] > 0)
        tangential -= np.sum(normal * tangential, axis=2, keepdims=True) * normal
        rows[:, a] = -beta[:, :, None] * tangential
        rows[:, a, half:] -= shape_slope[:, :, None] * off
    return rows


def joint_entries(
    slopes_of_places: Array, nodes: Longs, group: Longs, weight: Array, count: int
) -> Entries:
    """Return the tangent's entries of joined places that come on top of those of each place.

    They are the products D,u D,u of derivatives of the joined distances D, times `weight`. The
    entries are row numbers, column numbers and values.

    Parameters
    ----------
    slopes_of_places
        (n, functions, components) weighted derivatives of the distances of all places.
    nodes
        (n, functions) nodes of these functions.
    group
        (n,) number of the joined place to which each place belongs.
    weight
        (m,) factor of the product of each joined place.
    count
        Number of all nodes.
    """
    components = slopes_of_places.shape[2]
    dofs = unknown_numbers(nodes, count, components)
    # G: derivatives D,u (m, all unknowns) of the joined distances, sums over their places
    rows = np.repeat(group, dofs.shape[1])
    entries = slopes_of_places.ravel(), (rows, dofs.ravel())
    G = scipy.sparse.coo_array(entries, (len(weight), components * count)).tocsr()
    hessian = (G.T @ scipy.sparse.diags_array(weight) @ G).tocoo()
    return hessian.row.astype(np.int64), hessian.col.astype(np.int64), hessian.data


def forces_on_nodes(offsets: FaceOffsets | None, u: Array, forces: Array) -> Array:
    """Return the forces by the displacement u (nodes, dim), where offsets H depend on u.

    Forces are derivatives of the energy Pi: by the chain rule they are Pi,r + Pi,H H,u.

    Parameters
    ----------
    offsets
        None where the thickness is uniform: then `forces` is returned.
    forces
        (nodes, dim + 1) derivatives of the energy by places and by H.
    """
    return np.asarray(forces[:, :-1] + offsets.slope(u, forces[:, -1])) if offsets else forces
