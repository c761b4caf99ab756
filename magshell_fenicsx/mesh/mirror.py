"""Symmetry planes and sectors, the triangulations cut at them, and frames turned about e3.

A model with a symmetry plane is computed on one half; a model with the planes of waves
cos(m theta) is computed on a sector of 180/m degrees. `Mirror` and `Sector` say which part is
modelled and how its images make the whole surface. An image is a copy of the modelled part,
mirrored or turned about e3; the part itself is the first one. A turned frame has its first axis at
an azimuth. Edges are named by strings and given by pairs of vertices. Lengths are over R
(docs/theory.md, half shell).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import (
    MeshError,
    PatchMesh,
    among,
    as_set,
    border_pairs,
    directed_sides,
    inner_pairs,
)

Array = NDArray[np.float64]
SYMMETRY_EDGE = "symmetry"  # name of the edge in the symmetry plane
SECOND_SYMMETRY_EDGE = "symmetry 2"  # name of the edge in the second plane of a sector
PLANARITY_TOLERANCE = 1e-6  # deviation of an edge from a plane, over R
ROUNDING = 1e-9  # relative difference that is rounding


def rotation(azimuth: float) -> Array:
    """Return Q (3, 3) of a frame turned about e3 by an azimuth (rad).

    Q v are the components of v in the turned frame; w Q turns rows w back.
    """
    c, s = np.cos(azimuth), np.sin(azimuth)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True, eq=False)
class Mirror:
    """The symmetry plane normal . x = offset; the half with normal . x > offset is modelled.

    Attributes
    ----------
    normal
        Unit vector (3,); components that only rounding makes are set to zero.
    offset
        Distance of the plane from the origin, along the normal.
    removed_edges
        Name of an edge in the half that is not modelled -> name of its mirror image, which is.
    """

    normal: Array
    offset: float = 0.0
    removed_edges: Mapping[str, str] = field(default_factory=dict)

    def __eq__(self, other: object) -> bool:
        """Whether it is the same plane with the same edges; arrays are compared as a whole."""
        if not isinstance(other, Mirror):
            return NotImplemented
        same_data = (self.offset, self.removed_edges) == (other.offset, other.removed_edges)
        return same_data and np.array_equal(self.normal, other.normal)

    def __hash__(self) -> int:
        return hash((*self.normal, self.offset))

    @classmethod
    def with_normal(
        cls, normal: Array, offset: float = 0.0, removed_edges: Mapping[str, str] | None = None
    ) -> "Mirror":
        """Return the plane normal . x = offset for a normal of any length."""
        unit = np.asarray(normal) / np.linalg.norm(normal)
        unit = np.where(np.abs(unit) < ROUNDING, 0.0, unit)
        distance = offset / float(np.linalg.norm(normal))
        return cls(unit / np.linalg.norm(unit), distance, removed_edges or {})

    def is_plane_of(self, other: "Mirror") -> bool:
        """Whether both are the same half at the same plane, to rounding; edges may differ."""
        difference = np.abs(self.normal - other.normal).max()
        return bool(max(difference, abs(self.offset - other.offset)) < ROUNDING)

    @classmethod
    def through_axis(cls, azimuth: float) -> "Mirror":
        """Return the plane through e3 at an azimuth (rad)."""
        return cls.with_normal(np.array([-np.sin(azimuth), np.cos(azimuth), 0.0]))

    @property
    def through_e3(self) -> bool:
        """Whether the axis e3 lies in the plane."""
        return not self.normal[2] and not self.offset

    @property
    def azimuth(self) -> float:
        """Azimuth of a plane through e3 (rad)."""
        return float(np.arctan2(-self.normal[0], self.normal[1]))

    @property
    def plane(self) -> Array:
        """The normal, and the offset if it is not zero: (3,) or (4,)."""
        return np.append(self.normal, self.offset) if self.offset else self.normal

    @property
    def planes(self) -> Mapping[str, "Mirror"]:
        """Name of each edge in a symmetry plane -> the plane."""
        return {SYMMETRY_EDGE: self}

    @property
    def copies(self) -> int:
        """Number of images of the modelled part, itself included, that make the whole."""
        return 2

    @property
    def images(self) -> list["Image"]:
        """The images that make the whole; the first is the modelled part itself."""
        return [
            Image(np.eye(3), np.zeros(3), sign=1.0),
            Image(self.reflection, 2 * self.offset * self.normal, sign=-1.0),
        ]

    def with_images(self, x: Array) -> Array:
        """Return places (n, 3) and all their images, (copies n, 3)."""
        return np.concatenate([image.apply(x) for image in self.images])

    def sum_over_images(self, v: Array, parity: float = 1.0) -> Array:
        """Return the sum (3,) of the images of a vector.

        Parameters
        ----------
        parity
            Factor of mirrored images: 1, or -1 for axial vectors such as a moment.
        """
        factors = [parity if image.sign < 0 else 1.0 for image in self.images]
        images = [image.Q @ v for image in self.images]
        return np.asarray(
            sum(image * factor for image, factor in zip(images, factors, strict=True))
        )

    def rotated(self, azimuth: float) -> "Mirror":
        """Return this plane in the frame of the case, if it is given in a turned frame.

        Parameters
        ----------
        azimuth
            Angle (rad) about e3 by which that frame is turned.
        """
        return replace(self, normal=self.normal @ rotation(azimuth))

    @property
    def reversed(self) -> "Mirror":
        """This plane with the other half modelled."""
        removed = {image: edge for edge, image in self.removed_edges.items()}
        return Mirror(-self.normal, -self.offset, removed)

    @property
    def reflection(self) -> Array:
        """The matrix (3, 3) that mirrors vectors."""
        return np.asarray(np.eye(3) - 2 * np.outer(self.normal, self.normal))

    def image(self, x: Array) -> Array:
        """Return the mirror images of places (..., 3)."""
        return np.asarray(np.asarray(x) - 2 * self.signed_distance(x)[..., None] * self.normal)

    def keeps_lines(self, direction: Array | None) -> bool:
        """Whether the plane maps a family of lines, such as a field's, to itself.

        It does so with parallel lines that are normal to the plane or parallel to it.

        Parameters
        ----------
        direction
            (3,) of parallel lines; None for the meridians about e3.
        """
        if direction is None:
            # the axis must be mapped to itself: it lies in the plane, or is normal to it
            maps_axis = (
                abs(self.offset) < PLANARITY_TOLERANCE
                or abs(float(self.normal[2])) > PLANARITY_TOLERANCE
            )
            return maps_axis and self.keeps_lines(np.eye(3)[2])
        unit = direction / np.linalg.norm(direction)
        cosine = abs(float(unit @ self.normal))
        sine = float(np.linalg.norm(np.cross(unit, self.normal)))
        return min(cosine, sine) < PLANARITY_TOLERANCE

    def signed_distance(self, x: Array) -> Array:
        """Return the distance (...) of places (..., 3) from the plane, positive in the half."""
        return np.asarray(np.asarray(x) @ self.normal - self.offset)

    def image_of_edge(self, edge: str) -> str:
        """Return the name of the mirror image of an edge; its own name if it is its own image."""
        edge_of_image = {image: name for name, image in self.removed_edges.items()}
        return {**edge_of_image, **self.removed_edges}.get(edge, edge)

    @property
    def in_plane_vectors(self) -> tuple[Array, Array]:
        """Two unit vectors in the plane, normal to each other."""
        # the coordinate axis that is farthest from the normal
        axis = np.eye(3)[int(np.argmin(np.abs(self.normal)))]
        first = np.cross(axis, self.normal)
        first /= np.linalg.norm(first)
        return first, np.asarray(np.cross(self.normal, first))


@dataclass(frozen=True)
class Image:
    """The map x -> Q x + shift of the modelled part to one of its copies.

    Attributes
    ----------
    Q
        Orthogonal matrix (3, 3).
    shift
        (3,) over R.
    sign
        Determinant of Q: -1 of a mirror image.
    """

    Q: Array
    shift: Array
    sign: float

    def apply(self, x: Array) -> Array:
        """Return the images (..., 3) of places."""
        return np.asarray(x @ self.Q.T + self.shift)

    def apply_inverse(self, x: Array) -> Array:
        """Return the places (..., 3) whose images these are."""
        return np.asarray((x - self.shift) @ self.Q)


@dataclass(frozen=True, eq=False)
class Sector(Mirror):
    """Two symmetry planes through e3, 180/m degrees apart; the sector between them is modelled.

    Waves cos(m theta) around e3 have both as planes of symmetry. A half is the sector of m = 1.

    Attributes
    ----------
    waves
        m, at least 1.
    """

    waves: int = 2

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Sector):
            return False
        return self.waves == other.waves and super().__eq__(other)

    def __hash__(self) -> int:
        return hash((super().__hash__(), self.waves))

    @classmethod
    def from_azimuth(cls, azimuth: float, waves: int) -> "Sector":
        """Return the sector that begins at an azimuth (rad)."""
        return cls(Mirror.through_axis(azimuth).normal, waves=waves)

    @property
    def angle(self) -> float:
        """Angle between the planes (rad)."""
        return np.pi / self.waves

    @property
    def second_plane(self) -> Mirror:
        """The plane where the sector ends."""
        return Mirror.through_axis(self.azimuth + self.angle).reversed

    @property
    def planes(self) -> Mapping[str, Mirror]:
        return {SYMMETRY_EDGE: self, SECOND_SYMMETRY_EDGE: self.second_plane}

    @property
    def copies(self) -> int:
        return 2 * self.waves

    @property
    def images(self) -> list[Image]:
        """The images that make the whole: the sector and its mirror image, in m places."""
        half_images = super().images
        rotations = [rotation(-2 * self.angle * k) for k in range(self.waves)]
        return [
            Image(Q @ image.Q, Q @ image.shift, image.sign)
            for Q in rotations
            for image in half_images
        ]


# the symmetry plane of shapes whose chart is halved: the model's frame is turned into it
Y0_PLANE = Mirror(np.array([0.0, 1.0, 0.0]))


def cut(patch: PatchMesh, mirror: Mirror) -> PatchMesh:
    """Return the half or the sector of a triangulation.

    Edges in the planes get the names of `Mirror.planes`.

    Raises
    ------
    MeshError
        If triangles lie across a plane, or in it.
    """
    for name, plane in mirror.planes.items():
        patch = _halved(patch, plane, name)
    return patch


def _halved(patch: PatchMesh, mirror: Mirror, edge_name: str) -> PatchMesh:
    """Return the triangles in the half of a plane.

    Parameters
    ----------
    edge_name
        Name of the new edge in the plane; all border sides without another name belong to it.

    Raises
    ------
    MeshError
        If triangles lie across the plane or in it, or all are on one side.
    """
    in_half = _triangles_in_half(patch, mirror)
    # number the nodes of these triangles anew
    used, numbers = np.unique(patch.cells[in_half], return_inverse=True)
    cells = numbers.reshape(-1, patch.cells.shape[1])
    # old representative -> the first node that is glued to it and is in the half, in new numbers.
    # In reversed order the first of several glued nodes is written last, and stays
    glued = patch.representative
    representative = np.arange(len(patch.nodes)) if glued is None else glued
    first_node = np.full(len(patch.nodes), -1, dtype=np.int64)
    first_node[representative[used][::-1]] = np.arange(len(used))[::-1]
    edges = {name: first_node[representative[pairs]] for name, pairs in patch.edges.items()}
    # sides of one triangle alone, in old numbers and then in the new numbers of vertices
    sides = used[directed_sides(cells)]
    new_sides = first_node[representative[sides]]
    border = border_pairs(new_sides)
    # of each edge the sides in this half stay
    edges = among(edges, as_set(border))
    inner_lines = {n: first_node[representative[pairs]] for n, pairs in patch.inner_lines.items()}
    # border sides without a name are in the plane
    named_pairs = {pair for pairs in edges.values() for pair in as_set(pairs)}
    if pairs_in_plane := sorted(as_set(border) - named_pairs):
        edges[edge_name] = np.array(pairs_in_plane, dtype=np.int64)
    source_triangles = patch.source_triangles
    return replace(
        patch,
        nodes=patch.nodes[used],
        cells=cells,
        edges=edges,
        inner_lines=among(inner_lines, inner_pairs(new_sides)),
        representative=None if glued is None else first_node[representative[used]],
        patches={name: mask[in_half] for name, mask in patch.patches.items()},
        source_triangles=None if source_triangles is None else source_triangles[in_half],
        t_junctions={name: mask[in_half] for name, mask in patch.t_junctions.items()},
    )


def _triangles_in_half(patch: PatchMesh, mirror: Mirror) -> NDArray[np.bool_]:
    """Return whether each triangle (m,) is in the half of a plane.

    Raises
    ------
    MeshError
        If triangles lie across the plane or in it, or all are on one side.
    """
    places = patch.embedding(patch.nodes)
    distances, extent = mirror.signed_distance(places), np.ptp(places, axis=0).max()
    corners = distances[patch.cells[:, :3]]
    in_half = corners.mean(axis=1) > 0  # by the centre of each triangle
    depths = np.where(in_half[:, None], corners, -corners)  # into each triangle's own half
    crosses_plane = depths.min() < -ROUNDING * extent
    lies_in_plane = depths.max(axis=1).min() <= ROUNDING * extent
    is_on_one_side = in_half.all() or not in_half.any()
    meets_plane = crosses_plane or lies_in_plane
    if is_on_one_side or meets_plane:
        raise MeshError(
            f"symmetry: half: no edges of the mesh lie in the plane {plane_text(mirror)}: "
            "mesh it with a curve there"
        )
    return np.asarray(in_half)


def plane_text(mirror: Mirror) -> str:
    """Return normal and offset of a plane as text for messages."""
    normal = ", ".join(f"{c + 0.0:.4g}" for c in np.round(mirror.normal, 9))
    return f"({normal}) . x = {round(mirror.offset, 9) + 0.0:.4g} R"
