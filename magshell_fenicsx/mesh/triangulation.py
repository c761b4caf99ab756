"""Triangulation of a plane shape by gmsh, with cubic edges.

`triangulate` refines where cubic triangles are overturned, and names the boundary edges. The plane
is the chart of the surface, and an embedding maps it to space. A rim is a closed curve that edges
follow, such as the edge of a dimple. Opposite sides that are one line of the surface are glued:
their nodes have one representative. Lengths are those of the chart, over R.
"""

import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from math import inf
from types import FrameType
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import Size
from magshell_fenicsx.mesh.grid import CHART_TOLERANCE
from magshell_fenicsx.mesh.patch import Embedding, MeshError, PatchMesh, place_text
from magshell_fenicsx.mesh.shapes import PlaneShape
from magshell_fenicsx.platform.packages import import_gmsh

Array = NDArray[np.float64]
Numbers = NDArray[np.int64]
BOX_TOLERANCE = 1e-6  # gmsh's boxes are larger than what is in them by 1e-7
MAX_ATTEMPTS = 7
SIZE_GROWTH = 0.4  # of the size per distance, from where triangles were overturned
# attempt after which rims are widened, and by what part: no part of the error
WIDENING_ATTEMPT, WIDENING = 2, 3e-3
GLUING_TOLERANCE = 1e3 * CHART_TOLERANCE  # distance of nodes of glued sides
POINT_DIGITS = 12  # decimals of coordinates by which points are one
ORDER, TRIANGLE10, LINE4 = 3, 21, 26  # gmsh's numbers of the cubic elements


def triangulate(
    shape: PlaneShape, size: Size, points: Mapping[str, Array], embedding: Embedding
) -> PatchMesh:
    """Triangulate a shape with gmsh; call it on one rank only.

    The size is halved, and the shape meshed again, where cubic triangles are overturned.

    Parameters
    ----------
    size
        Largest element size at a point (2,); smaller ones are made where curves nearly touch.
    points
        Named points (2,) that must be vertices.
    embedding
        Map from the plane to the mid-surface.

    Raises
    ------
    MeshError
        If gmsh cannot mesh the shape.
    """
    for attempt in range(MAX_ATTEMPTS):
        nodes, cells, lines = _gmsh_mesh(shape, size, points)
        overturned_corners = _overturned_corners(nodes[cells])
        if not len(overturned_corners):
            break
        size = _halved_at(size, overturned_corners)
        # curves that touch leave cusps between them, in which no triangle has area: wider rims
        # overlap instead
        if attempt == WIDENING_ATTEMPT:
            rims = tuple(x + WIDENING * (x - x.mean(axis=0)) for x in shape.rims)
            shape = replace(shape, rims=rims)  # type: ignore[type-var]
    else:
        place = place_text(embedding(overturned_corners[:1])[0])
        raise MeshError(
            f"gmsh leaves an element without area around {place}, over R: rims of "
            "dimples nearly touch, or a rim nearly touches an edge; move one of them a little, "
            "or use kind: gaussian, which has no rim"
        )
    representative = _glued_nodes(shape, nodes)
    edges = dict[str, Numbers]()
    for name, is_on_edge in shape.on_edges(nodes).items():
        edges[name] = representative[lines[is_on_edge[lines].all(axis=1)]]
    return PatchMesh(
        nodes,
        cells,
        embedding,
        edges,
        dict(points),
        representative=representative if shape.glued else None,
    )


def _gmsh_mesh(
    shape: PlaneShape, size: Size, points: Mapping[str, Array]
) -> tuple[Array, Numbers, Numbers]:
    """Return nodes (n, 2), cubic triangles (m, 10) and vertices of border lines (k, 2) by gmsh.

    Raises
    ------
    MeshError
        If gmsh cannot mesh the shape.
    """
    gmsh = import_gmsh()
    element_size = _ElementSize(size)

    # ~/.gmshrc may change meshes, and run commands
    gmsh.initialize(readConfigFiles=False, interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)  # gmsh writes nothing
        # sizes come from the callback alone
        for rule in ("MeshSizeExtendFromBoundary", "MeshSizeFromPoints", "MeshSizeFromCurvature"):
            gmsh.option.setNumber(f"Mesh.{rule}", 0)
        gmsh.model.add("chart")
        occ = gmsh.model.occ
        faces = shape.faces(occ)
        # points and inner faces divide the shape, so that nodes and edges are there
        occ.fragment(faces, [(0, occ.addPoint(x[0], x[1], 0)) for x in _with_images(shape, points)])
        occ.synchronize()
        for axis, low, high in shape.glued:
            _make_periodic(gmsh.model, axis, low, high)
        # some sizes vary so much along a curve that gmsh must integrate them more precisely
        if precision := getattr(size, "precision", None):
            gmsh.option.setNumber("Mesh.LcIntegrationPrecision", precision)
        gmsh.model.mesh.setSizeCallback(element_size)
        with _deferred_interrupts(element_size):
            gmsh.model.mesh.generate(2)
        if element_size.error:
            raise element_size.error
        gmsh.model.mesh.setOrder(ORDER)
        nodes, cells, lines = _nodes_and_elements(gmsh.model)
    except Exception as e:  # gmsh's own errors have no class of their own
        message = f"gmsh cannot mesh this surface: {e}"
        raise (element_size.error or MeshError(message)) from None
    finally:
        gmsh.finalize()
    # at a curved edge gmsh's inner node is a little off, which costs an order of convergence in the
    # element size. The place that is taken here is exact for quadratic edges (Lenoir, SIAM J.
    # Numer. Anal. 23, 1986)
    nodes[cells[:, 9]] = nodes[cells[:, 3:9]].sum(axis=1) / 4 - nodes[cells[:, :3]].sum(axis=1) / 6
    return nodes, cells, lines


class _ElementSize:
    """Element size at a place, as gmsh asks for it.

    gmsh ignores an exception in a function that it calls, and takes the size 0 there. The first
    exception is therefore kept, and large elements then end the triangulation soon.

    Attributes
    ----------
    error
        The first exception, or an interrupt; None if there is none.
    """

    def __init__(self, size: Size):
        self._size = size
        self.error: BaseException | None = None

    def __call__(
        self, dim: int, tag: int, x: float, y: float, z: float, default_size: float
    ) -> float:
        """Return the element size at (x, y) in the chart; the other arguments are not used."""
        if self.error is None:
            try:
                return self._size(np.array([x, y]))
            except Exception as e:
                self.error = e
        return inf


@contextmanager
def _deferred_interrupts(element_size: _ElementSize) -> Iterator[None]:
    """Note an interrupt as the error of an element size, in place of raising it within gmsh.

    gmsh ignores what is raised in its callback. Another handler of the program stays.
    """
    raises = signal.getsignal(signal.SIGINT) is signal.default_int_handler
    if not raises or threading.current_thread() is not threading.main_thread():
        yield
        return

    def note(number: int, frame: FrameType | None) -> None:
        element_size.error = KeyboardInterrupt()

    signal.signal(signal.SIGINT, note)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _halved_at(size: Size, places: Array) -> Size:
    """Return an element size that is half the old one at places (n, 2), growing from there."""
    halved = np.array([size(x) / 2 for x in places])
    return lambda x: min(size(x), float((halved + SIZE_GROWTH * np.hypot(*(places - x).T)).min()))


def _nodes_and_elements(model: Any) -> tuple[Array, Numbers, Numbers]:
    """Return nodes (n, 2), triangles (m, 10) and vertices of lines (k, 2) of gmsh's model."""
    tags, xyz, _ = model.mesh.getNodes()
    # gmsh's tag of a node -> its number from 0
    number = np.zeros(int(tags.max()) + 1, dtype=np.int64)
    number[tags.astype(np.int64)] = np.arange(len(tags))
    nodes = xyz.reshape(-1, 3)[:, :2].copy()
    triangle_tags = model.mesh.getElementsByType(TRIANGLE10)[1].astype(np.int64)
    cells = number[triangle_tags].reshape(-1, 10)
    # the first two of a line's four nodes are its ends
    line_tags = model.mesh.getElementsByType(LINE4)[1].astype(np.int64)
    lines = number[line_tags].reshape(-1, 4)[:, :2]
    return nodes, cells, lines


def _with_images(shape: PlaneShape, points: Mapping[str, Array]) -> list[Array]:
    """Return the places (2,) of the points, each once.

    Points on a glued side have images on the opposite side.
    """
    places = list(points.values())
    for axis, low, high in shape.glued:
        for side, opposite in ((low, high), (high, low)):
            for x in [x for x in places if abs(x[axis] - side) < CHART_TOLERANCE]:
                places.append(np.where(np.arange(2) == axis, opposite, x))
    if not shape.glued:
        return places
    return list(np.unique(np.round(places, POINT_DIGITS), axis=0))


def _make_periodic(model: Any, axis: int, low: float, high: float) -> None:
    """Give the curves of two opposite sides the same nodes.

    Parameters
    ----------
    axis, low, high
        Axis (0 or 1), and the coordinates across it of both sides.
    """

    def curves_at(coordinate: float) -> list[tuple[float, int]]:
        """Return middle and tag of the curves at a coordinate, sorted along the side."""
        curves = []
        for _, tag in model.getEntities(1):
            box = np.reshape(model.getBoundingBox(1, tag), (2, 3))
            if np.abs(box[:, axis] - coordinate).max() < BOX_TOLERANCE:
                curves.append((float(box[:, 1 - axis].mean()), tag))
        return sorted(curves)

    first, second = curves_at(low), curves_at(high)
    shift = np.eye(4)  # gmsh's affine map from the first side to the second
    shift[axis, 3] = high - low
    model.mesh.setPeriodic(
        1, [tag for _, tag in second], [tag for _, tag in first], shift.ravel().tolist()
    )


def _glued_nodes(shape: PlaneShape, nodes: Array) -> NDArray[np.int64]:
    """Return for each node (n,) the node that it is glued to, or itself.

    Raises
    ------
    MeshError
        If the nodes of two glued sides differ.
    """
    representative = np.arange(len(nodes))
    for axis, low, high in shape.glued:
        # nodes on both sides
        first, second = (
            np.flatnonzero(np.abs(nodes[:, axis] - end) < CHART_TOLERANCE) for end in (low, high)
        )
        # nodes of both sides are compared by their coordinate along the side
        tree = scipy.spatial.cKDTree(nodes[first, 1 - axis, None])
        distance, nearest = tree.query(nodes[second, 1 - axis, None])
        if len(first) != len(second) or distance.max() > GLUING_TOLERANCE:
            raise MeshError(
                "gmsh cannot mesh this surface: the two sides that are glued have different nodes"
            )
        representative[second] = representative[first[nearest]]
    return representative


def _overturned_corners(nodes: Array) -> Array:
    """Return the corners (k, 2) at which cubic triangles (m, 10, 2) are overturned.

    There the tangents of both sides have a determinant that is not positive.
    """
    x = nodes.transpose(1, 0, 2)
    sides = ((0, 3, 4, 1), (1, 5, 6, 2), (2, 7, 8, 0))  # nodes along each, in its direction
    # derivatives of the cubic through four equispaced nodes, at its ends
    tangents_at_start = [-5.5 * x[a] + 9 * x[p] - 4.5 * x[q] + x[b] for a, p, q, b in sides]
    tangents_at_end = [-x[a] + 4.5 * x[p] - 9 * x[q] + 5.5 * x[b] for a, p, q, b in sides]
    corners = list[Array]()
    for i in range(3):  # at vertex i side i - 1 ends and side i begins
        incoming, outgoing = tangents_at_end[i - 1], tangents_at_start[i]
        determinant = incoming[:, 0] * outgoing[:, 1] - incoming[:, 1] * outgoing[:, 0]
        corners.append(x[sides[i][0]][determinant <= 0])
    return np.concatenate(corners)
