"""Triangulating a plane shape by gmsh, with cubic edges."""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import Size
from magshell_fenicsx.mesh.patch import Embedding, MeshError, PatchMesh
from magshell_fenicsx.mesh.shapes import Shape

ORDER, TRIANGLE10, LINE4 = 3, 21, 26  # gmsh's numbers of the cubic elements


def triangulate(shape: Shape, size: Size, points: Mapping[str, NDArray[np.float64]], embedding: Embedding) -> PatchMesh:
    """Triangulate a shape with gmsh; call it on one rank only.

    Parameters
    ----------
    size
        Wanted element size at a point.
    points
        Named points (2,) that must be vertices.
    embedding
        From the plane to the mid-surface.

    Raises
    ------
    MeshError
        If gmsh cannot mesh the shape.
    """
    import gmsh

    gmsh.initialize(readConfigFiles=False, interruptible=False)  # ~/.gmshrc may change meshes, and run commands
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        for rule in ("MeshSizeExtendFromBoundary", "MeshSizeFromPoints", "MeshSizeFromCurvature"):
            gmsh.option.setNumber(f"Mesh.{rule}", 0)
        gmsh.model.add("chart")
        occ = gmsh.model.occ
        faces = shape.faces(occ)
        occ.fragment(faces, [(0, occ.addPoint(x[0], x[1], 0)) for x in points.values()])
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
    except Exception as e:  # gmsh's own errors have no class of their own
        raise MeshError(f"gmsh cannot mesh this surface: {e}") from None
    finally:
        gmsh.finalize()
    # gmsh's inner node misses the quadratic part of a curved edge by 2 % of its sagitta's scale, and with it
    # an order of convergence in h; this place reproduces quadratics (Lenoir, SIAM J. Numer. Anal. 23, 1986)
    nodes[cells[:, 9]] = nodes[cells[:, 3:9]].sum(axis=1) / 4 - nodes[cells[:, :3]].sum(axis=1) / 6
    edges = {name: lines[on[lines].all(axis=1)] for name, on in shape.on_edges(nodes).items()}
    return PatchMesh(nodes, cells, embedding, edges, dict(points))
