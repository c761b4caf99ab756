"""A disc, or the half of it with y >= 0, triangulated by gmsh with cubic edges."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import Size

ORDER, TRIANGLE10, LINE4 = 3, 21, 26  # gmsh numbers of the cubic elements


def triangulate_disc(
    radius: float,
    size: Size,
    *,
    half: bool,
    circle: float | None = None,
    points: Mapping[str, NDArray[np.float64]],
) -> tuple[NDArray[np.float64], NDArray[np.int64], dict[str, NDArray[np.int64]]]:
    """Triangulate a disc with gmsh; call it on one rank only.

    Parameters
    ----------
    radius
        Radius of the disc.
    size
        Wanted element size at a point.
    half
        Only the half with y >= 0; its straight side becomes the edge "symmetry".
    circle
        Radius of an inner circle that edges must follow (the rim of a dimple).
    points
        Points that must be vertices.

    Returns
    -------
    nodes, cells, edges
        (n, 2) coordinates, (m, 10) cubic triangles in gmsh's order, boundary edges
        "rim" and "symmetry" as (e, 2) vertex pairs.
    """
    import gmsh

    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        for rule in ("MeshSizeExtendFromBoundary", "MeshSizeFromPoints", "MeshSizeFromCurvature"):
            gmsh.option.setNumber(f"Mesh.{rule}", 0)
        gmsh.model.add("disc")
        occ = gmsh.model.occ
        faces = [(2, occ.addDisk(0, 0, 0, r, r)) for r in ([radius, circle] if circle else [radius])]
        if half:
            faces = occ.intersect(faces, [(2, occ.addRectangle(-2 * radius, 0, 0, 4 * radius, 2 * radius))])[0]
        corners = [(0, occ.addPoint(x[0], x[1], 0)) for x in points.values()]
        occ.fragment(faces, corners)
        occ.synchronize()
        gmsh.model.mesh.setSizeCallback(lambda dim, tag, x, y, z, lc: size(np.array([x, y])))
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.setOrder(ORDER)
        tags, xyz, _ = gmsh.model.mesh.getNodes()
        number = np.zeros(int(tags.max()) + 1, dtype=np.int64)
        number[tags.astype(np.int64)] = np.arange(len(tags))
        nodes = xyz.reshape(-1, 3)[:, :2].copy()
        cells = number[gmsh.model.mesh.getElementsByType(TRIANGLE10)[1].astype(np.int64)].reshape(-1, 10)
        lines = number[gmsh.model.mesh.getElementsByType(LINE4)[1].astype(np.int64)].reshape(-1, 4)[:, :2]
    finally:
        gmsh.finalize()
    # gmsh's inner node misses the quadratic part of a curved edge by 2 % of its sagitta's scale, and with it
    # an order of convergence in h; this place reproduces quadratics (Lenoir, SIAM J. Numer. Anal. 23, 1986)
    nodes[cells[:, 9]] = nodes[cells[:, 3:9]].sum(axis=1) / 4 - nodes[cells[:, :3]].sum(axis=1) / 6
    on_rim = np.isclose(np.hypot(*nodes[lines].transpose(2, 0, 1)), radius, rtol=1e-9).all(axis=1)
    edges = {"rim": lines[on_rim]}
    if half:
        edges["symmetry"] = lines[(np.abs(nodes[lines][:, :, 1]) < 1e-9 * radius).all(axis=1)]
    return nodes, cells, edges
