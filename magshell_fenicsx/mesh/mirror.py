"""Mirror planes, the meshes cut by them, and turned frames."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import (
    MeshError,
    PatchMesh,
    as_set,
    border_pairs,
    directed_sides,
    on_border,
)


def rotation(azimuth: float) -> NDArray[np.float64]:
    """Q (3, 3) of a frame turned by an azimuth (rad): Q v are the components of v in it, and w Q
    turns rows w back.
    """
    c, s = np.cos(azimuth), np.sin(azimuth)
    return np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


Array = NDArray[np.float64]
CUT = "symmetry"  # name of the edge on the plane
STRAIGHT = 1e-6  # deviation of an edge from a plane, in lengths of R
SECOND_CUT = "symmetry 2"  # of that on the second plane of a sector
ROUNDING = 1e-9


@dataclass(frozen=True, eq=False)
class Mirror:
    """The plane normal . x = offset; the half with normal . x > offset is modelled.

    Attributes
    ----------
    normal
        Unit vector (3,); components that only rounding makes are set to zero.
    lost
        Edges of the other half -> their mirror images.
    """

    normal: Array
    offset: float = 0.0
    lost: Mapping[str, str] = field(default_factory=dict)

    def __eq__(self, other: object) -> bool:
        """Whether it is the same plane with the same edges: the parts of an array are compared one
        by one.
        """
        if not isinstance(other, Mirror):
            return NotImplemented
        same = (self.offset, self.lost) == (other.offset, other.lost)
        return same and np.array_equal(self.normal, other.normal)

    def __hash__(self) -> int:
        return hash((*self.normal, self.offset))

    @classmethod
    def of(
        cls, normal: Array, offset: float = 0.0, lost: Mapping[str, str] | None = None
    ) -> "Mirror":
        """The plane with a normal of any length."""
        unit = np.asarray(normal) / np.linalg.norm(normal)
        unit = np.where(np.abs(unit) < ROUNDING, 0.0, unit)
        return cls(unit / np.linalg.norm(unit), offset / float(np.linalg.norm(normal)), lost or {})

    def is_plane_of(self, other: "Mirror") -> bool:
        """Whether both are the same half at the same plane, to rounding; edges may differ."""
        normals = np.abs(self.normal - other.normal).max()
        return bool(max(normals, abs(self.offset - other.offset)) < ROUNDING)

    @classmethod
    def upright(cls, azimuth: float) -> "Mirror":
        """The plane through e3 at an azimuth (rad)."""
        return cls.of(np.array([-np.sin(azimuth), np.cos(azimuth), 0.0]))

    @property
    def through_e3(self) -> bool:
        """Whether the axis e3 lies in the plane."""
        return not self.normal[2] and not self.offset

    @property
    def azimuth(self) -> float:
        """The azimuth of a plane through e3 (rad)."""
        return float(np.arctan2(-self.normal[0], self.normal[1]))

    @property
    def plane(self) -> Array:
        """The normal, and the offset if it is not zero: (3,) or (4,)."""
        return np.append(self.normal, self.offset) if self.offset else self.normal

    @property
    def sides(self) -> Mapping[str, "Mirror"]:
        """Name of each edge on a plane -> the plane."""
        return {CUT: self}

    @property
    def copies(self) -> int:
        """How many copies of what is modelled make the whole."""
        return 2

    @property
    def images(self) -> list["Image"]:
        """The copies that make the whole; the first is what is modelled itself."""
        return [
            Image(np.eye(3), np.zeros(3), 1.0),
            Image(self.reflection, 2 * self.offset * self.normal, -1.0),
        ]

    def everywhere(self, x: Array) -> Array:
        """Places (n, 3) and all their images, (copies n, 3)."""
        return np.concatenate([image.of(x) for image in self.images])

    def summed(self, v: Array, parity: float = 1.0) -> Array:
        """The sum (3,) of the images of a vector; mirrored ones count `parity` times."""
        return np.asarray(
            sum(image.Q @ v * (parity if image.sign < 0 else 1.0) for image in self.images)
        )

    def turned(self, azimuth: float) -> "Mirror":
        """This plane, given in a frame turned about e3 by an azimuth (rad), in the frame that is
        not turned.
        """
        return replace(self, normal=self.normal @ rotation(azimuth))

    @property
    def reversed(self) -> "Mirror":
        """The same plane with the other half."""
        return Mirror(-self.normal, -self.offset, {kept: lost for lost, kept in self.lost.items()})

    @property
    def reflection(self) -> Array:
        """The matrix (3, 3) that mirrors vectors."""
        return np.asarray(np.eye(3) - 2 * np.outer(self.normal, self.normal))

    def image(self, x: Array) -> Array:
        """Mirrored places (..., 3)."""
        return np.asarray(np.asarray(x) - 2 * self.beyond(x)[..., None] * self.normal)

    def keeps_lines(self, along: Array | None) -> bool:
        """Whether images of lines along a vector (3,), or if None of meridians about e3, are such
        lines.
        """
        if along is None:
            through = abs(self.offset) < STRAIGHT or abs(float(self.normal[2])) > STRAIGHT
            return through and self.keeps_lines(np.eye(3)[2])
        unit = along / np.linalg.norm(along)
        cosine, sine = (
            abs(float(unit @ self.normal)),
            float(np.linalg.norm(np.cross(unit, self.normal))),
        )
        return min(cosine, sine) < STRAIGHT

    def beyond(self, x: Array) -> Array:
        """Distances (...) from the plane, positive in the half that is modelled."""
        return np.asarray(np.asarray(x) @ self.normal - self.offset)

    def other(self, edge: str) -> str:
        """The mirror image of an edge."""
        return {**{kept: lost for lost, kept in self.lost.items()}, **self.lost}.get(edge, edge)

    @property
    def in_plane(self) -> tuple[Array, Array]:
        """Two unit vectors in the plane, normal to each other."""
        first = np.eye(3)[int(np.argmin(np.abs(self.normal)))]
        along = np.cross(first, self.normal)
        along /= np.linalg.norm(along)
        return along, np.asarray(np.cross(self.normal, along))


@dataclass(frozen=True)
class Image:
    """A copy of what is modelled, x -> Q x + shift; `sign` is the determinant of Q."""

    Q: Array
    shift: Array
    sign: float

    def of(self, x: Array) -> Array:
        """The images (..., 3) of places."""
        return np.asarray(x @ self.Q.T + self.shift)

    def back(self, x: Array) -> Array:
        """The places (..., 3) whose images these are."""
        return np.asarray((x - self.shift) @ self.Q)


@dataclass(frozen=True, eq=False)
class Sector(Mirror):
    """Two planes through e3, this one and one that is turned by 180/m degrees; what lies between
    them is modelled.

    Waves cos(m theta) around e3 have both as planes of symmetry. A half is the sector of m = 1.

    Attributes
    ----------
    waves
        m, at least 1.
    """

    waves: int = 2

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sector) and self.waves == other.waves and super().__eq__(other)

    def __hash__(self) -> int:
        return hash((super().__hash__(), self.waves))

    @classmethod
    def at(cls, azimuth: float, waves: int) -> "Sector":
        """The sector that begins at an azimuth (rad)."""
        return cls(Mirror.upright(azimuth).normal, waves=waves)

    @property
    def angle(self) -> float:
        """Between the planes (rad)."""
        return np.pi / self.waves

    @property
    def second(self) -> Mirror:
        """The plane where it ends."""
        return Mirror.upright(self.azimuth + self.angle).reversed

    @property
    def sides(self) -> Mapping[str, Mirror]:
        return {CUT: self, SECOND_CUT: self.second}

    @property
    def copies(self) -> int:
        return 2 * self.waves

    @property
    def images(self) -> list[Image]:
        turns = [rotation(-2 * self.angle * k) for k in range(self.waves)]
        return [Image(Q @ one.Q, Q @ one.shift, one.sign) for Q in turns for one in super().images]


Y0 = Mirror(
    np.array([0.0, 1.0, 0.0])
)  # for shapes whose chart is halved: the model's frame is turned so that this is their plane


def cut(patch: PatchMesh, mirror: Mirror) -> PatchMesh:
    """The half of a triangulation, or its sector; its edges on the planes have the names of these.

    Raises
    ------
    MeshError
        If triangles lie across a plane, or in it.
    """
    for name, plane in mirror.sides.items():
        patch = _halved(patch, plane, name)
    return patch


def _halved(patch: PatchMesh, mirror: Mirror, name: str) -> PatchMesh:
    places = patch.embedding(patch.nodes)
    beyond, extent = mirror.beyond(places), np.ptp(places, axis=0).max()
    corners = beyond[patch.cells[:, :3]]
    kept = corners.mean(axis=1) > 0
    within = np.where(kept[:, None], corners, -corners)  # how far on their own side of the plane
    across = within.min() < -ROUNDING * extent or within.max(axis=1).min() <= ROUNDING * extent
    if kept.all() or not kept.any() or across:
        raise MeshError(
            f"symmetry: half: no edges of the mesh lie in the plane {plane_text(mirror)}: mesh it with a curve there"
        )
    cells = patch.cells[kept]
    used, cells = np.unique(cells, return_inverse=True)
    cells = cells.reshape(-1, patch.cells.shape[1])
    one = np.arange(len(patch.nodes)) if patch.one is None else patch.one
    first = np.full(
        len(patch.nodes), -1, dtype=np.int64
    )  # for each vertex, its first node that is kept
    first[one[used][::-1]] = np.arange(len(used))[::-1]
    edges = {edge: first[one[pairs]] for edge, pairs in patch.edges.items()}
    border = border_pairs(first[one[used[directed_sides(cells)]]])
    edges = on_border(edges, border)
    in_edges = {pair for lines in edges.values() for pair in as_set(lines)}
    if on_plane := sorted(as_set(border) - in_edges):
        edges[name] = np.array(on_plane, dtype=np.int64)
    return replace(
        patch,
        nodes=patch.nodes[used],
        cells=cells,
        edges=edges,
        one=None if patch.one is None else first[one[used]],
        patches={each: inside[kept] for each, inside in patch.patches.items()},
        given=None if patch.given is None else patch.given[kept],
        feet={edge: on[kept] for edge, on in patch.feet.items()},
    )


def plane_text(mirror: Mirror) -> str:
    """Normal and offset, for messages."""
    normal = ", ".join(f"{c + 0.0:.4g}" for c in np.round(mirror.normal, 9))
    return f"({normal}) . x = {round(mirror.offset, 9) + 0.0:.4g} R"
