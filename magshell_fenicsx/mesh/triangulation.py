"""Triangulating a plane shape by gmsh, with cubic edges."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import Size
from magshell_fenicsx.mesh.grid import CLOSE
from magshell_fenicsx.mesh.patch import Embedding, MeshError, PatchMesh, place_text
from magshell_fenicsx.mesh.shapes import Shape
from magshell_fenicsx.platform.packages import gmsh_module

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
BOX = 1e-6  # gmsh's boxes are larger than what is in them by 1e-7
ATTEMPTS, GROWTH = 7, 0.4
WIDER, WIDEN = (
    2,
    3e-3,
)  # after how many attempts rims are made wider, and by how much: no part of the error
ORDER, TRIANGLE10, LINE4 = 3, 21, 26  # gmsh's numbers of the cubic elements


def triangulate(
    shape: Shape, size: Size, points: Mapping[str, Array], embedding: Embedding
) -> PatchMesh:
    """Triangulate a shape with gmsh; call it on one rank only.

    Parameters
    ----------
    size
        Wanted element size at a point; smaller ones are made where curves nearly touch.
    points
        Named points (2,) that must be vertices.
    embedding
        From the plane to the mid-surface.

    Raises
    ------
    MeshError
        If gmsh cannot mesh the shape.
    """
    for attempt in range(ATTEMPTS):
        nodes, cells, lines = _meshed(shape, size, points)
        bad = _overturned(nodes[cells])
        if not len(bad):
            break
        size = _smaller(size, bad)
        if attempt == WIDER:  # curves that touch leave cusps: they shall overlap
            shape = replace(shape, rims=tuple(x + WIDEN * (x - x.mean(axis=0)) for x in shape.rims))  # type: ignore[type-var]
    else:
        raise MeshError(
            f"gmsh leaves an element without area around {place_text(embedding(bad[:1])[0])}, over R: rims of "
            "dimples nearly touch, or a rim nearly touches an edge; move one of them a little, or use kind: gaussian, "
            "which has no rim"
        )
    one = _glue(shape, nodes)
    edges = {name: one[lines[on[lines].all(axis=1)]] for name, on in shape.on_edges(nodes).items()}
    return PatchMesh(nodes, cells, embedding, edges, dict(points), one=one if shape.glued else None)


def _meshed(
    shape: Shape, size: Size, points: Mapping[str, Array]
) -> tuple[Array, Numbers, Numbers]:
    """Nodes (n, 2), cubic triangles (m, 10) and vertices of lines (k, 2)."""
    gmsh = gmsh_module()

    gmsh.initialize(
        readConfigFiles=False, interruptible=False
    )  # ~/.gmshrc may change meshes, and run commands
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        for rule in ("MeshSizeExtendFromBoundary", "MeshSizeFromPoints", "MeshSizeFromCurvature"):
            gmsh.option.setNumber(f"Mesh.{rule}", 0)
        gmsh.model.add("chart")
        occ = gmsh.model.occ
        faces = shape.faces(occ)
        occ.fragment(faces, [(0, occ.addPoint(x[0], x[1], 0)) for x in _with_images(shape, points)])
        occ.synchronize()
        for axis, low, high in shape.glued:
            _make_periodic(gmsh.model, axis, low, high)
        if precision := getattr(size, "precision", None):
            gmsh.option.setNumber("Mesh.LcIntegrationPrecision", precision)
        gmsh.model.mesh.setSizeCallback(lambda dim, tag, x, y, z, lc: size(np.array([x, y])))
        gmsh.model.mesh.generate(2)
        gmsh.model.mesh.setOrder(ORDER)
        tags, xyz, _ = gmsh.model.mesh.getNodes()
        number = np.zeros(int(tags.max()) + 1, dtype=np.int64)
        number[tags.astype(np.int64)] = np.arange(len(tags))
        nodes = xyz.reshape(-1, 3)[:, :2].copy()
        cells = number[gmsh.model.mesh.getElementsByType(TRIANGLE10)[1].astype(np.int64)].reshape(
            -1, 10
        )
        lines = number[gmsh.model.mesh.getElementsByType(LINE4)[1].astype(np.int64)].reshape(-1, 4)[
            :, :2
        ]
    except Exception as e:  # gmsh's own errors have no class of their own
        raise MeshError(f"gmsh cannot mesh this surface: {e}") from None
    finally:
        gmsh.finalize()
    # gmsh's inner node misses the quadratic part of a curved edge by 2 % of its sagitta's scale,
    # and with it an order of convergence in h; this place reproduces quadratics (Lenoir, SIAM J.
    # Numer. Anal. 23, 1986)
    nodes[cells[:, 9]] = nodes[cells[:, 3:9]].sum(axis=1) / 4 - nodes[cells[:, :3]].sum(axis=1) / 6
    return nodes, cells, lines


def _smaller(size: Size, places: Array) -> Size:
    """Half the size at places (n, 2), growing from there."""
    halved = np.array([size(x) / 2 for x in places])
    return lambda x: min(size(x), float((halved + GROWTH * np.hypot(*(places - x).T)).min()))


def _with_images(shape: Shape, points: Mapping[str, Array]) -> list[Array]:
    """The points, each once, and on glued sides their images on the other one."""
    places = list(points.values())
    for axis, low, high in shape.glued:
        for side, image in ((low, high), (high, low)):
            for x in [x for x in places if abs(x[axis] - side) < CLOSE]:
                places.append(np.where(np.arange(2) == axis, image, x))
    return list(np.unique(np.round(places, 12), axis=0)) if shape.glued else places


def _make_periodic(model: Any, axis: int, low: float, high: float) -> None:
    """Give the curves of two opposite sides the same nodes."""

    def side(across: float) -> list[tuple[float, int]]:
        lines = []
        for _, tag in model.getEntities(1):
            box = np.reshape(model.getBoundingBox(1, tag), (2, 3))
            if np.abs(box[:, axis] - across).max() < BOX:
                lines.append((float(box[:, 1 - axis].mean()), tag))
        return sorted(lines)

    first, second = side(low), side(high)
    shift = np.eye(4)
    shift[axis, 3] = high - low
    model.mesh.setPeriodic(
        1, [tag for _, tag in second], [tag for _, tag in first], shift.ravel().tolist()
    )


def _glue(shape: Shape, nodes: Array) -> NDArray[np.int64]:
    """For each node the node that it is glued to, or itself."""
    one = np.arange(len(nodes))
    for axis, low, high in shape.glued:
        first, second = (
            np.flatnonzero(np.abs(nodes[:, axis] - end) < CLOSE) for end in (low, high)
        )
        distance, nearest = scipy.spatial.cKDTree(nodes[first, 1 - axis, None]).query(
            nodes[second, 1 - axis, None]
        )
        if len(first) != len(second) or distance.max() > 1e3 * CLOSE:
            raise MeshError(
                "gmsh cannot mesh this surface: the two sides that are glued have different nodes"
            )
        one[second] = one[first[nearest]]
    return one


def _overturned(nodes: Array) -> Array:
    """The corners (k, 2) of cubic triangles (m, 10, 2) that are turned over there."""
    x = nodes.transpose(1, 0, 2)
    sides = ((0, 3, 4, 1), (1, 5, 6, 2), (2, 7, 8, 0))  # nodes along each, in its direction
    out = [
        -5.5 * x[a] + 9 * x[p] - 4.5 * x[q] + x[b] for a, p, q, b in sides
    ]  # derivatives at the beginning
    into = [-x[a] + 4.5 * x[p] - 9 * x[q] + 5.5 * x[b] for a, p, q, b in sides]
    turned = [
        into[i - 1][:, 0] * out[i][:, 1] - into[i - 1][:, 1] * out[i][:, 0] <= 0 for i in range(3)
    ]
    return np.concatenate([x[sides[i][0]][turned[i]] for i in range(3)])
