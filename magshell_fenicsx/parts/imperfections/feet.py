"""The places of a perfect surface that are nearest to measured ones."""

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.msh import MeshFile, read_msh
from magshell_fenicsx.shape.outline import ANY, Outline

Array = NDArray[np.float64]
STEPS, STEP = 30, 1e-5  # of Newton's method, and of differences in the chart
AROUND = 12  # nodes of a mesh file that a quadric goes through


def feet(drawn: Outline, x: Array) -> tuple[Array, Array]:
    """Feet (n, 3) of the normals through places x (n, 3), all over R, and the heights (n,) of these above the surface.

    Of a mesh file, on quadrics through its nodes.
    """
    shape = drawn.chart(None, ANY)
    if isinstance(shape, MeshFile):
        return _on_quadrics(read_msh(shape, {}).nodes, x)
    if drawn.sphere:
        r = np.linalg.norm(x, axis=1)
        return x / r[:, None], r - 1
    sample = drawn.sample()
    nearest, again = np.unique(scipy.spatial.cKDTree(sample).query(x)[1], return_inverse=True)
    chart = np.array([drawn.inverse(place) for place in sample[nearest]])[again]
    for _ in range(STEPS):  # Gauss and Newton's, which converges as fast as w0 is small against the radius of curvature
        along = [(drawn.perfect(chart + e) - drawn.perfect(chart - e)) / (2 * STEP) for e in STEP * np.eye(2)]
        J = np.stack(along, axis=-1)
        off = np.einsum("nij,ni->nj", J, x - drawn.perfect(chart))
        step = np.linalg.solve(np.einsum("nij,nik->njk", J, J), off[..., None])[..., 0]
        chart = chart + np.clip(step, -0.2, 0.2)
        if np.abs(step).max() < 1e-12:
            break
    found = drawn.perfect(chart)
    return found, np.einsum("ij,ij->i", x - found, drawn.normal(chart))


def _on_quadrics(nodes: Array, x: Array) -> tuple[Array, Array]:
    """The same from nodes (m, 6): places and normals."""
    nodes = np.unique(nodes.round(14), axis=0)
    tree = scipy.spatial.cKDTree(nodes[:, :3])
    near = tree.query(x, AROUND)[1]
    centre, normal = nodes[near[:, 0], :3], nodes[near[:, 0], 3:]
    normal = normal / np.linalg.norm(normal, axis=1)[:, None]
    first = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal), axis=1)])
    first /= np.linalg.norm(first, axis=1)[:, None]
    frame = np.stack([first, np.cross(normal, first), normal], axis=1)
    s, t, z = np.moveaxis(np.einsum("nkj,nij->nki", nodes[near, :3] - centre[:, None], frame), -1, 0)
    quadric = np.linalg.pinv(np.stack([0 * s + 1, s, t, s * s, s * t, t * t], axis=-1)) @ z[..., None]
    a, b, c, d, e, f = quadric[..., 0].T
    p, q, height = np.einsum("nj,nij->ni", x - centre, frame).T
    slope_s, slope_t = b + 2 * d * p + e * q, c + e * p + 2 * f * q
    gap = height - (a + b * p + c * q + d * p * p + e * p * q + f * q * q)
    upwards = np.stack([-slope_s, -slope_t, 0 * p + 1], axis=-1)
    upwards /= np.linalg.norm(upwards, axis=1)[:, None]
    w0 = gap * upwards[:, 2]
    return x - w0[:, None] * np.einsum("ni,nij->nj", upwards, frame), w0
