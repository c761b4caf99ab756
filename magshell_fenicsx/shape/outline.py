"""The surface of a shell as a chart and its map to space, over the reference length R.

An `Outline` says what is meshed, how it is put into space, and which symmetry the surface has. Each
kind of surface has a function that makes its outline, of plain numbers and profiles.

A chart is a plane domain that is meshed: a disc around a pole, a strip, or a rectangle (`Grid`).
"The chart of a place" is its coordinates (2,) there. A mesh file has no chart: nodes in space stand
for it. An embedding is the map from charts to places in space. A surface is round if it is closed
around e3. Its meridian is the profile curve from which an axisymmetric model is made; the length
along it is a chart of its own. A mirror is a symmetry plane with one of its two halves; a sector
lies between two planes through e3. A deviation is the distance of the imperfect surface along the
normal. A grading gives element sizes. Samples are places all over a surface, on which symmetry is
tested.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import inf, pi

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import Grading
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.mesh.mirror import (
    SECOND_SYMMETRY_EDGE,
    SYMMETRY_EDGE,
    Y0_PLANE,
    Mirror,
    Sector,
    rotation,
)
from magshell_fenicsx.mesh.msh import MeshFile, node_normals, read_msh, space_embedding
from magshell_fenicsx.mesh.multi_shell import MultiShellMesh
from magshell_fenicsx.mesh.patch import DeviatedEmbedding, Deviation, Embedding, MeshError
from magshell_fenicsx.mesh.shapes import (
    DiscShape,
    PlaneShape,
    StripShape,
    plane_embedding,
    plane_normals,
    sphere_embedding,
)
from magshell_fenicsx.mesh.surfaces_of_revolution import (
    CappedEmbedding,
    Profile,
    RevolvedEmbedding,
)
from magshell_fenicsx.shape.meridian_chart import MeridianChart
from magshell_fenicsx.shape.mirrors import grid_mirrors, mesh_mirrors, mirror_lines

Array = NDArray[np.float64]
Chart = PlaneShape | Grid | MeshFile  # what is meshed
ANY_GRADING = Grading([], 1.0)  # where only the chart's extent matters
ROUNDING = 1e-9  # over R: a coordinate across the symmetry plane that is zero
CHART_SAMPLES = 41  # along each axis of a chart
SAMPLED_AZIMUTHS = 41  # of meridians turned about e3
PROFILE_SAMPLES, CURVATURE_SAMPLES = 101, 1001  # along a profile
CURVATURE_DIGITS = 3  # decimals of the largest curvature, which is not known to rounding


@dataclass(frozen=True)
class Outline:
    """A surface as a chart with its map to space.

    Attributes
    ----------
    chart
        Function of the symmetry plane in the model's frame (or None) and of element sizes (of
        grids), to what is meshed.
    embedding
        Chart (n, 2) -> places (n, 3), with imperfections if the surface has some.
    normal
        Chart -> outward unit normals.
    inverse
        Place (3,) -> its chart (2,); of a mesh file the place itself.
    highest
        Chart of the point whose displacement is reported where the case names none: a pole, a tip.
        None: the reader of the mesh file takes the highest point.
    edge
        Distance of the outer edge from the chart's origin; infinite where the chart is no disc.
    sphere
        Whether chart distances from the origin are polar angles.
    round
        Whether it is closed around e3.
    mirrors
        Function that gives its symmetry planes, except planes through e3 of a `round` surface. Of a
        mesh file it takes vectors that a plane should contain, and whether loose symmetry suffices
        (see `mesh_mirrors`).
    from_pole
        Places (n, 3) -> length (n,) of the meridian from the pole; None except for a surface of
        revolution with a pole.
    meridian
        The meridian; None if it is closed, or the surface is none of revolution.
    extra_samples
        Further places (n, 3) of `sample`: those near which a formula varies over a short distance,
        so that the other samples could miss it.
    why_no_meridian
        Why several shells have no meridian.
    """

    chart: Callable[[Mirror | None, Grading], Chart]
    embedding: Embedding
    normal: Embedding
    inverse: Callable[[Array], Array]
    highest: Array | None
    edge: float = inf
    sphere: bool = False
    round: bool = False
    mirrors: Callable[[Sequence[Array], bool], Sequence[Mirror]] = lambda vectors, loosely: []
    from_pole: Callable[[Array], Array] | None = None
    meridian: MeridianChart | None = None
    extra_samples: Array = field(default_factory=lambda: np.zeros((0, 3)))
    why_no_meridian: str | None = None

    def on_half(self, chart: Array) -> Array:
        """Return a place of the chart (2,) on the half with y >= 0, if rounding has moved it off.

        Places of grids and meshes are returned as they are: there the half is cut off along the
        symmetry plane itself.
        """
        if self.grid or isinstance(self.chart(None, ANY_GRADING), MeshFile):
            return chart
        return np.array([chart[0], chart[1] if chart[1] > ROUNDING else 0.0])

    @property
    def grid(self) -> Grid | None:
        """The grid that is meshed; None for other charts."""
        shape = self.chart(None, ANY_GRADING)
        return shape if isinstance(shape, Grid) else None

    def sample(self) -> Array:
        """Return places (n, 3) all over the surface, its centre, edges and axes among them."""
        if self.meridian and self.meridian.shell_meridians:
            # of several shells: their meridians, turned about e3
            in_plane = self.meridian.sample()
            azimuths = np.linspace(0, 2 * pi, SAMPLED_AZIMUTHS)
            return np.vstack([*(in_plane @ rotation(a) for a in azimuths), self.extra_samples])
        chart, nodes = self.chart_samples(), self.nodes
        if chart is None:  # a mesh file
            assert nodes is not None
            return np.vstack([space_embedding(nodes), self.extra_samples])
        return np.vstack([self.embedding(chart), self.extra_samples])

    def samples_with_normals(self) -> tuple[Array, Array] | None:
        """Return places (n, 3) all over the surface with their outward unit normals (n, 3).

        None for a mesh file and for several shells.
        """
        is_of_several_shells = self.meridian and self.meridian.shell_meridians
        chart = None if is_of_several_shells else self.chart_samples()
        return None if chart is None else (self.embedding(chart), self.normal(chart))

    def with_samples(self, places: Array) -> "Outline":
        """Return the outline with further places (n, 3) among its samples."""
        meridian = self.meridian and replace(self.meridian, narrow_places=places)
        return replace(self, extra_samples=places, meridian=meridian)

    @property
    def nodes(self) -> Array | None:
        """Nodes of a mesh file, places with normals (n, 6) or alone (n, 3); None without a file."""
        shape = self.chart(None, ANY_GRADING)
        return read_msh(shape, {}).nodes if isinstance(shape, MeshFile) else None

    def normal_near(self, chart: Array) -> Array:
        """Return the outward unit normal (3,) at a chart (2,).

        The chart of a mesh file is a place (3,); the normal is then that of the nearest node.
        """
        shape = self.chart(None, ANY_GRADING)
        if not isinstance(shape, MeshFile):
            return np.asarray(self.normal(chart[None])[0])
        if isinstance(shape.in_memory, MultiShellMesh):  # several shells
            assert shape.in_memory.normal
            return shape.in_memory.normal(chart)
        nodes = read_msh(replace(shape, normals=True), {}).nodes
        nearest = np.linalg.norm(nodes[:, :3] - chart, axis=1).argmin()
        return np.asarray(node_normals(nodes[[nearest]])[0])

    def chart_samples(self) -> Array | None:
        """Return charts (n, 2) all over the surface, up to its edges; None for a mesh file."""
        shape = self.chart(None, ANY_GRADING)
        if isinstance(shape, MeshFile):
            return None
        t = np.linspace(0, 1, CHART_SAMPLES)
        # a disc by radius and azimuth, a strip and a grid along both axes
        if isinstance(shape, DiscShape):
            rho, theta = np.meshgrid(shape.reach * t, 2 * np.pi * t)
            x, y = rho * np.cos(theta), rho * np.sin(theta)
        elif isinstance(shape, StripShape):
            x, y = np.meshgrid(t, (t - 0.5) * shape.width)
        else:
            assert isinstance(shape, Grid)
            axes = [a + t * (b - a) for a, b in zip(shape.low, shape.high, strict=True)]
            x, y = np.meshgrid(*axes)
        return np.column_stack([x.ravel(), y.ravel()])

    def clip_to_chart(self, chart: Array) -> Array:
        """Return the place of the chart (2,) nearest to one that may be outside.

        The chart must not be that of a mesh file.
        """
        shape = self.chart(None, ANY_GRADING)
        if isinstance(shape, DiscShape):
            return np.asarray(chart / max(float(np.hypot(*chart)) / self.edge, 1.0))
        if isinstance(shape, StripShape):
            return np.clip(chart, [0, -shape.width / 2], [1, shape.width / 2])
        assert isinstance(shape, Grid)
        return np.clip(chart, shape.low, shape.high)

    @property
    def perfect(self) -> Embedding:
        """Chart -> places (n, 3) of the surface without its imperfections."""
        if isinstance(self.embedding, DeviatedEmbedding):
            return self.embedding.perfect
        return self.embedding

    def deviated(
        self, deviations: tuple[Deviation, ...], circles: tuple[float, ...], largest: float
    ) -> "Outline":
        """Return the outline with imperfections.

        Parameters
        ----------
        deviations
            Deviations along the normal.
        circles
            Radii around the pole at which the curvature jumps.
        largest
            Cell size that resolves the imperfections; on a meridian half of it is taken.
        """
        meridian = self.meridian and replace(
            self.meridian,
            embedding=DeviatedEmbedding(self.meridian.embedding, self.meridian.normal, deviations),
            curvature_jumps=circles,
            largest=largest / 2,
        )
        embedding = DeviatedEmbedding(self.embedding, self.normal, deviations)
        return replace(self, embedding=embedding, meridian=meridian)

    def embedding_of(self, shape: Chart) -> Embedding:
        """Return the map to space of the chart that is meshed.

        Halves of several shells have charts in frames of their own.
        """
        if isinstance(shape, MeshFile) and isinstance(shape.in_memory, MultiShellMesh):
            return shape.in_memory.patch.embedding
        return self.embedding

    @property
    def disc(self) -> bool:
        """Whether it is a surface of revolution about e3, up to its pole."""
        return self.edge < inf


def plate_outline(width: float) -> Outline:
    """Return the outline of a rectangle of length one; `width` is over the length."""
    high = np.array([1.0, width])
    grid = Grid((0.0, 0.0), (1.0, float(high[1])), 1.0)
    return _grid_outline(
        grid, plane_embedding, plane_normals, lambda x: np.clip(x[:2], 0.0, high), high
    )


def capped_outline(profile: Profile, edge_name: str) -> Outline:
    """Return the outline of a surface of revolution whose profile ends at a pole."""
    embedding = CappedEmbedding(profile)
    perfect = _disc_outline(
        profile.length,
        edge_name,
        embedding,
        embedding.normal,
        embedding.inverse,
        curvature=_largest_curvature(profile),
    )
    return replace(perfect, from_pole=embedding.from_pole)


def flat_disc_outline() -> Outline:
    """Return the outline of a flat disc of radius 1 with its edge, the rim."""
    return _disc_outline(1.0, "rim", plane_embedding, plane_normals, _plane_chart)


def mesh_outline(file: MeshFile) -> Outline:
    """Return the outline of a mesh file, of a program's triangles, or of several shells."""
    if isinstance(file.in_memory, MultiShellMesh):
        return _multi_shell_outline(file, file.in_memory)

    def mirrors(vectors: Sequence[Array], loosely: bool) -> list[Mirror]:
        """Return the planes that map the triangles onto themselves, each with either half.

        The planes contain `vectors`, if there is a choice. With `loosely`, a plane may also map
        areas and centres onto each other, but not the triangles.
        """
        try:
            patch = read_msh(replace(file, normals=False), {})
            return _with_reversed(mesh_mirrors(patch, vectors, loosely=loosely))
        except MeshError:  # the mesh reader reports it when the mesh is built
            return []

    return Outline(
        chart=lambda mirror, size: file,
        embedding=space_embedding,
        normal=node_normals,
        inverse=lambda x: x,  # a place stands for its chart
        highest=None,
        mirrors=mirrors,
    )


def _multi_shell_outline(file: MeshFile, shells: MultiShellMesh) -> Outline:
    """Return the outline of several shells that take the place of a mesh file.

    Their meridian is a chart, or a text that says why they have none.
    """
    meridian = shells.meridian

    def chart(mirror: Mirror | None, size: Grading) -> MeshFile:
        # shells mesh themselves with their own sizes; `size` is not used
        if mirror and shells.symmetric_part:
            return replace(file, in_memory=shells.symmetric_part(mirror))
        return file

    def embedding(nodes: Array) -> Array:  # the first call meshes the shells
        return shells.patch.embedding(nodes)

    return Outline(
        chart=chart,
        embedding=embedding,
        normal=node_normals,
        inverse=lambda x: x,  # a place stands for its chart
        highest=None,
        mirrors=shells.mirrors,
        meridian=meridian if isinstance(meridian, MeridianChart) else None,
        why_no_meridian=meridian if isinstance(meridian, str) else None,
    )


def strip_outline(width: float) -> Outline:
    """Return the outline of a flat strip of length 1 along e1; `width` is over the length."""
    tip, corner = np.array([1.0, 0.0]), np.array([0.0, -width / 2])

    def inverse(x: Array) -> Array:
        """Return the chart (2,) of the strip's place nearest to x (3,)."""
        return np.clip(_plane_chart(x), corner, -corner + tip)

    # the mesher takes element sizes itself: `size` is for grids
    return Outline(
        chart=lambda mirror, size: StripShape(width, mirror is not None),
        embedding=plane_embedding,
        normal=plane_normals,
        inverse=inverse,
        highest=tip,
        mirrors=lambda *_: [Y0_PLANE],
    )


def sphere_outline(edge: float, edge_name: str) -> Outline:
    """Return the outline of a part of the unit sphere about e3, with its pole.

    `edge` is the polar angle of its edge in radians.
    """
    return _disc_outline(
        edge, edge_name, sphere_embedding, sphere_embedding, _sphere_chart, sphere=True
    )


def _disc_outline(
    edge: float,
    edge_name: str,
    embedding: Embedding,
    normal: Embedding,
    inverse: Callable[[Array], Array],
    *,
    sphere: bool = False,
    curvature: float = 1.0,
) -> Outline:
    """Return the outline of a surface of revolution with a pole, charted by a disc.

    Parameters
    ----------
    edge, edge_name
        Radius of the disc, and name of its edge.
    embedding, normal
        Chart (n, 2) -> places and outward unit normals (n, 3).
    inverse
        Place (3,) -> its chart (2,), which may be beyond the edge.
    sphere
        Whether chart distances from the origin are polar angles.
    curvature
        The largest of the meridian, over 1/R.
    """

    def chart(mirror: Mirror | None, size: Grading) -> Chart:
        # a half has one wave between its planes, a sector m; `size` is for grids
        waves = mirror.waves if isinstance(mirror, Sector) else 1
        return DiscShape(edge, mirror is not None, edge=edge_name, waves=waves)

    def inverse_in_disc(x: Array) -> Array:
        """Return the chart of x (3,), moved to the edge if it is beyond."""
        chart = inverse(x)
        return np.asarray(chart / max(np.hypot(*chart) / edge, 1.0))

    def locate(chart: Array) -> tuple[float, float]:
        """Return the meridian's parameter and the azimuth of a chart (2,)."""
        return float(np.hypot(*chart)), float(np.arctan2(chart[1], chart[0]))

    meridian = MeridianChart(
        length=edge,
        curvature_jumps=(),
        names=(None, edge_name),
        embedding=embedding,
        normal=normal,
        locate=locate,
        curvature=curvature,
    )
    return Outline(
        chart=chart,
        embedding=embedding,
        normal=normal,
        inverse=inverse_in_disc,
        highest=np.zeros(2),  # the pole
        edge=edge,
        sphere=sphere,
        round=True,
        meridian=meridian,
    )


def ring_outline(
    profile: Profile,
    names: tuple[str, str],
    azimuths: tuple[float, float],
    closed: tuple[bool, bool],
) -> Outline:
    """Return the outline of a surface of revolution without a pole, or of a part of one.

    Its chart is a grid: the azimuth times the largest radius, and the length along the profile.

    Parameters
    ----------
    profile
        Curve (rho, z) over R that is turned about e3.
    names
        Names of the edges where the profile begins and ends.
    azimuths
        First and last azimuth (rad).
    closed
        Whether the surface is closed around e3, and the profile ends where it begins.
    """
    first, last = azimuths
    s = np.linspace(0, profile.length, PROFILE_SAMPLES, dtype=np.float64)
    rho = float(profile(s)[:, 0].max())
    low, high = (first * rho, 0.0), (last * rho, profile.length)
    embedding = RevolvedEmbedding(profile, rho)

    def inverse(x: Array) -> Array:
        return np.clip(embedding.inverse(x, first), low, high)

    # the chart of the meridian begins at the profile's end: its normal points outwards
    def meridian_embedding(chart: Array) -> Array:
        r, z = profile(profile.length - chart[:, 0]).T
        return np.column_stack([r, 0 * r, z])

    def meridian_normal(chart: Array) -> Array:
        along_r, along_z = profile.tangent(profile.length - chart[:, 0]).T
        return np.column_stack([along_z, 0 * along_z, -along_r])

    def locate(chart: Array) -> tuple[float, float]:
        """Return the meridian's parameter and the azimuth of a chart (2,)."""
        return profile.length - float(chart[1]), float(chart[0]) / rho

    # only a surface closed around e3, with edges, has a meridian
    meridian = None
    if closed == (True, False):
        meridian = MeridianChart(
            length=profile.length,
            curvature_jumps=(),
            names=(names[1], names[0]),
            embedding=meridian_embedding,
            normal=meridian_normal,
            locate=locate,
            curvature=_largest_curvature(profile),
        )
    # the element size of 1 is replaced when the grid is meshed
    grid = Grid(low, high, 1.0, ("left", "right", *names), closed)
    # the reported point is a corner of the chart: the first one if two sides are one line in space
    highest = np.array(low if any(closed) else high)
    return _grid_outline(grid, embedding, embedding.normal, inverse, highest, meridian)


def _largest_curvature(profile: Profile) -> float:
    """Return the largest curvature of a profile over 1/R, at least 1.

    It is rounded to a thousandth, since it is known no better.
    """
    s = np.linspace(0, profile.length, CURVATURE_SAMPLES, dtype=np.float64)
    # turn of the tangent over the step s[1]
    changes = np.linalg.norm(np.diff(profile.tangent(s), axis=0), axis=1)
    return max(1.0, round(float(changes.max() / s[1]), CURVATURE_DIGITS))


def _grid_outline(
    grid: Grid,
    embedding: Embedding,
    normal: Embedding,
    inverse: Callable[[Array], Array],
    highest: Array,
    meridian: MeridianChart | None = None,
) -> Outline:
    """Return the outline of a surface that is charted by a rectangle.

    Parameters
    ----------
    grid
        The rectangle, with the names of its edges and the sides that are glued together.
    embedding, normal
        Chart (n, 2) -> places and outward unit normals (n, 3).
    inverse
        Place (3,) -> its chart (2,).
    highest
        Chart (2,) of the point whose displacement is reported where the case names none.
    meridian
        The meridian of a surface of revolution; None without one.
    """

    def chart(mirror: Mirror | None, grading: Grading) -> Chart:
        """Return the grid to mesh: a sector, or all with lines where a mirror plane cuts it."""
        # a grid whose size varies places its lines by a function
        size = grading.line_spacing if grading.features else grading.largest
        if isinstance(mirror, Sector):
            return replace(_sector_of_grid(grid, mirror), size=size)
        fixed_lines = mirror_lines(mirror, grid, embedding) if mirror else grid.fixed_lines
        return replace(grid, size=size, fixed_lines=fixed_lines)

    def mirrors(vectors: Sequence[Array], loosely: bool) -> list[Mirror]:
        # both parameters are for mesh files, and not used here
        return _with_reversed(grid_mirrors(grid, embedding))

    return Outline(
        chart=chart,
        embedding=embedding,
        normal=normal,
        inverse=inverse,
        highest=highest,
        round=grid.glued[0],
        mirrors=mirrors,
        meridian=meridian,
    )


def _sector_of_grid(grid: Grid, sector: Sector) -> Grid:
    """Return the part of a grid, closed around e3, between azimuths 0 and 180/m degrees.

    It has at least four quadrilaterals along the azimuth, as there are lines at its quarters.
    """
    # 2 m copies of a sector make the whole
    end = (grid.high[0] - grid.low[0]) / sector.copies
    quarters = tuple(end * fraction for fraction in (0.25, 0.5, 0.75))
    sides = (SYMMETRY_EDGE, SECOND_SYMMETRY_EDGE, *grid.sides[2:])
    return replace(
        grid,
        low=(0.0, grid.low[1]),
        high=(end, grid.high[1]),
        sides=sides,
        glued=(False, grid.glued[1]),
        movable_lines=(quarters, grid.movable_lines[1]),
    )


def _with_reversed(planes: Sequence[Mirror]) -> list[Mirror]:
    """Return each plane twice: with the half on either side modelled."""
    return [half for plane in planes for half in (plane, plane.reversed)]


def _plane_chart(x: Array) -> Array:
    """Return the chart (2,) of a place (3,) on the plane of e1 and e2."""
    return x[:2]


def _sphere_chart(x: Array) -> Array:
    """Return the chart (2,) of a direction (3,) from the centre of the unit sphere.

    It is the polar angle in radians, along the azimuth.
    """
    rho = np.hypot(x[0], x[1])
    return np.asarray(np.arctan2(rho, x[2]) * x[:2] / rho) if rho > 0 else np.zeros(2)
