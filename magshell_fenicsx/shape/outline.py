"""The chart of each geometry, over the reference length R: what is meshed, and how it is put into
space.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from math import inf, pi, radians

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.assembly import Assembly
from magshell_fenicsx.mesh.grading import Grading
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.mesh.mirror import CUT, SECOND_CUT, Y0, Mirror, Sector, rotation
from magshell_fenicsx.mesh.msh import MeshFile, in_space, normals, read_msh
from magshell_fenicsx.mesh.patch import Deviated, Deviation, Embedding, MeshError
from magshell_fenicsx.mesh.revolved import Capped, Profile, Revolved
from magshell_fenicsx.mesh.shapes import DiscShape, Shape, StripShape, flat, sphere, upwards
from magshell_fenicsx.shape.ground import Ground
from magshell_fenicsx.shape.mirrors import grid_mirrors, lines_on, mesh_mirrors
from magshell_fenicsx.shape.revolved import CapSurface, RevolutionSurface, RoundSection
from magshell_fenicsx.shape.sections import MeshSurface, PlateSurface, ShellSection, Surface
from magshell_fenicsx.shape.turning import Span

Array = NDArray[np.float64]
Chart = Shape | Grid | MeshFile
ANY = Grading([], 1.0)
ROUNDING = 1e-9
AROUND = 41  # samples of a meridian that is turned


@dataclass(frozen=True)
class Outline:
    """A geometry as a chart with its map to space.

    Attributes
    ----------
    chart
        What is meshed, for a mirror plane in the model's frame or None, and element sizes (of
        grids).
    normal
        Chart -> outward unit normals.
    inverse
        Chart (2,) of a place (3,); of a mesh file the place itself.
    highest
        Chart of the point whose displacement is reported where the case names none: a pole, a tip;
        None: the reader of the mesh file takes the highest.
    edge
        Distance of the outer edge from the chart's origin; infinite where the chart is no disc.
    sphere
        Whether chart distances from the origin are polar angles.
    round
        Whether it is closed around e3.
    mirrors
        Its planes, but for those through e3 of what is `round`; of a mesh file for vectors that a
        plane should hold, and whether its edges suffice (see `mesh_mirrors`).
    from_pole
        Places -> length of the meridian from the pole; None but for a pole of a surface of
        revolution.
    span
        The meridian; None if it is closed, or the surface is none of revolution.
    also
        Places (n, 3) that samples have besides: those where formulas are narrow.
    askew
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
    span: Span | None = None
    also: Array = field(default_factory=lambda: np.zeros((0, 3)))
    askew: str | None = None

    def on_half(self, chart: Array) -> Array:
        """A place of the chart on its half, from which rounding may have moved it; grids and meshes
        are cut.
        """
        if self.grid or isinstance(self.chart(None, ANY), MeshFile):
            return chart
        return np.array([chart[0], chart[1] if chart[1] > ROUNDING else 0.0])

    @property
    def grid(self) -> Grid | None:
        """What is meshed, if that is a grid."""
        shape = self.chart(None, ANY)
        return shape if isinstance(shape, Grid) else None

    def sample(self) -> Array:
        """Places (n, 3) all over the surface, with its centre, edges and axes among them."""
        if self.span and self.span.pieces:
            along = self.span.sample()
            return np.vstack(
                [*(along @ rotation(angle) for angle in np.linspace(0, 2 * pi, AROUND)), self.also]
            )
        chart, nodes = self.charts(), self.nodes
        if chart is None:
            assert nodes is not None
            return np.vstack([in_space(nodes), self.also])
        return np.vstack([self.embedding(chart), self.also])

    def with_normals(self) -> tuple[Array, Array] | None:
        """Places (n, 3) all over the surface with their outward unit normals; None of a mesh file
        and of several shells."""
        chart = None if self.span and self.span.pieces else self.charts()
        return None if chart is None else (self.embedding(chart), self.normal(chart))

    def looked_at(self, places: Array) -> "Outline":
        """With these places among its samples."""
        return replace(self, also=places, span=self.span and replace(self.span, also=places))

    @property
    def nodes(self) -> Array | None:
        """Those of a mesh file, places with normals (n, 6) or alone (n, 3); None without a file."""
        shape = self.chart(None, ANY)
        return read_msh(shape, {}).nodes if isinstance(shape, MeshFile) else None

    def normal_near(self, chart: Array) -> Array:
        """The outward unit normal (3,) at a chart (2,), or of the nearest node of a mesh file to a
        place (3,).
        """
        shape = self.chart(None, ANY)
        if not isinstance(shape, MeshFile):
            return np.asarray(self.normal(chart[None])[0])
        if isinstance(shape.given, Assembly):
            assert shape.given.normal
            return shape.given.normal(chart)
        nodes = read_msh(replace(shape, normals=True), {}).nodes
        return np.asarray(
            normals(nodes[[np.linalg.norm(nodes[:, :3] - chart, axis=1).argmin()]])[0]
        )

    def charts(self) -> Array | None:
        """Their charts (n, 2); None for a mesh file."""
        shape = self.chart(None, ANY)
        if isinstance(shape, MeshFile):
            return None
        t = np.linspace(0, 1, 41)
        if isinstance(shape, DiscShape):
            rho, theta = np.meshgrid(shape.reach * t, 2 * np.pi * t)
            x, y = rho * np.cos(theta), rho * np.sin(theta)
        elif isinstance(shape, StripShape):
            x, y = np.meshgrid(t, (t - 0.5) * shape.width)
        else:
            assert isinstance(shape, Grid)
            x, y = np.meshgrid(
                *(a + t * (b - a) for a, b in zip(shape.low, shape.high, strict=True))
            )
        return np.column_stack([x.ravel(), y.ravel()])

    def within(self, chart: Array) -> Array:
        """The nearest place of the chart (2,) to one that may be beside it."""
        shape = self.chart(None, ANY)
        if isinstance(shape, DiscShape):
            return np.asarray(chart / max(float(np.hypot(*chart)) / self.edge, 1.0))
        if isinstance(shape, StripShape):
            return np.clip(chart, [0, -shape.width / 2], [1, shape.width / 2])
        assert isinstance(shape, Grid)
        return np.clip(chart, shape.low, shape.high)

    @property
    def perfect(self) -> Embedding:
        """Chart -> the surface without its imperfections."""
        return self.embedding.perfect if isinstance(self.embedding, Deviated) else self.embedding

    def deviated(
        self, deviations: tuple[Deviation, ...], circles: tuple[float, ...], largest: float
    ) -> "Outline":
        """The outline with imperfections; the curvature jumps on circles around the pole, `largest`
        cells show them.
        """
        span = self.span and replace(
            self.span,
            embedding=Deviated(self.span.embedding, self.span.normal, deviations),
            circles=circles,
            largest=largest / 2,
        )
        return replace(self, embedding=Deviated(self.embedding, self.normal, deviations), span=span)

    def placed(self, shape: Chart) -> Embedding:
        """The map to space of what is meshed: halves of several shells have charts in frames of
        their own.
        """
        if isinstance(shape, MeshFile) and isinstance(shape.given, Assembly):
            return shape.given.patch.embedding
        return self.embedding

    @property
    def disc(self) -> bool:
        """Whether it is of revolution about e3, up to its pole."""
        return self.edge < inf


def ground_of(shell: Surface | ShellSection) -> Ground:
    """What imperfections, bodies and sources need of a shell, which has none as yet."""
    perfect = outline(shell)
    factor = shell.thickness_factor
    return Ground(
        shell.geometry,
        perfect,
        perfect,
        shell.reference,
        shell.R_over_h,
        shell.poisson_ratio,
        shell.with_units,
        shell.edge_polar,
        factor if isinstance(factor, str) else None,
        (
            shell.model_dump_json(exclude={"imperfections"}),
            shell.digest if isinstance(shell, MeshSurface) else None,
        ),
        hole_polar=getattr(shell, "hole", None) or 0.0,
        azimuths=(azimuth[0], azimuth[1]) if (azimuth := getattr(shell, "azimuth", None)) else None,
    )


def outline(shell: Surface | ShellSection) -> Outline:
    """The outline of a perfect shell."""
    if isinstance(shell, MeshSurface):
        scale, given = (shell.unit or 1.0) / shell.reference, shell.files.given.get(shell.path)
        file = MeshFile(shell.path, scale, bool(shell.imperfections), shell.files, given)
        if isinstance(given, Assembly):
            span = given.turned

            def embedded(nodes: Array) -> Array:  # they are meshed when it is asked for
                return given.patch.embedding(nodes)

            return Outline(
                lambda mirror, size: (
                    replace(file, given=given.half(mirror)) if mirror and given.half else file
                ),
                embedded,
                normals,
                lambda x: x,
                None,
                mirrors=given.mirrors,
                span=span if isinstance(span, Span) else None,
                askew=span if isinstance(span, str) else None,
            )

        def planes(vectors: Sequence[Array], loosely: bool) -> list[Mirror]:
            try:
                bare = replace(file, normals=False)
                return _either_half(mesh_mirrors(read_msh(bare, {}), vectors, loosely=loosely))
            except MeshError:  # for whoever builds it to report
                return []

        return Outline(
            lambda mirror, size: file, in_space, normals, lambda x: x, None, mirrors=planes
        )
    if isinstance(shell, ShellSection) and shell.width is not None:
        width = shell.width
        tip, corner = np.array([1.0, 0.0]), np.array([0.0, -width / 2])

        def within(x: Array) -> Array:
            return np.clip(_plane(x), corner, -corner + tip)

        return Outline(
            lambda m, size: StripShape(width, m is not None),
            flat,
            upwards,
            within,
            tip,
            mirrors=lambda *_: [Y0],
        )
    if isinstance(shell, ShellSection) and shell.geometry == "disc":
        return _disc(1.0, "rim", flat, upwards, _plane)
    if isinstance(shell, ShellSection) or (isinstance(shell, CapSurface) and shell.hole is None):
        hemisphere = isinstance(shell, ShellSection)
        edge, name = (pi / 2, "equator") if hemisphere else (radians(shell.polar), "rim")  # type: ignore[union-attr]
        return _disc(edge, name, sphere, sphere, _of_sphere, sphere=True)
    if isinstance(shell, PlateSurface):
        high = np.array([1.0, shell.width / shell.reference])
        grid = Grid((0.0, 0.0), (1.0, float(high[1])), 1.0)
        return _grid(grid, flat, upwards, lambda x: np.clip(x[:2], 0.0, high), high)
    profile, names = shell.turned
    if names[1] is None:
        capped, bent = Capped(profile), _curvature(profile)
        drawn = _disc(
            profile.length, names[0], capped, capped.normal, capped.inverse, curvature=bent
        )
        return replace(drawn, from_pole=capped.from_pole)
    return _ring(shell, profile, (names[0], names[1]))


def _disc(
    edge: float,
    name: str,
    embedding: Embedding,
    normal: Embedding,
    inverse: Callable[[Array], Array],
    *,
    sphere: bool = False,
    curvature: float = 1.0,
) -> Outline:
    def chart(mirror: Mirror | None, size: Grading) -> Chart:
        waves = mirror.waves if isinstance(mirror, Sector) else 1
        return DiscShape(edge, mirror is not None, edge=name, waves=waves)

    def within(x: Array) -> Array:
        chart = inverse(x)
        beyond = np.hypot(*chart) / edge
        return np.asarray(chart / max(beyond, 1.0))

    def place(chart: Array) -> tuple[float, float]:
        return float(np.hypot(*chart)), float(np.arctan2(chart[1], chart[0]))

    span = Span(edge, (), (None, name), embedding, normal, place, curvature)
    return Outline(
        chart, embedding, normal, within, np.zeros(2), edge, sphere, round=True, span=span
    )


def _ring(
    shell: RoundSection | RevolutionSurface, profile: Profile, names: tuple[str, str]
) -> Outline:
    first, last = shell.turn
    along = np.linspace(0, profile.length, 101, dtype=np.float64)
    rho = float(profile(along)[:, 0].max())
    glued = shell.azimuth is None, shell.closed
    low, high = (first * rho, 0.0), (last * rho, profile.length)
    embedding = Revolved(profile, rho)

    def inverse(x: Array) -> Array:
        return np.clip(embedding.inverse(x, first), low, high)

    def section(chart: Array) -> Array:
        r, z = profile(profile.length - chart[:, 0]).T  # from its end: the normal points outwards
        return np.column_stack([r, 0 * r, z])

    def normal(chart: Array) -> Array:
        along_r, along_z = profile.tangent(profile.length - chart[:, 0]).T
        return np.column_stack([along_z, 0 * along_z, -along_r])

    def place(chart: Array) -> tuple[float, float]:
        return profile.length - float(chart[1]), float(chart[0]) / rho

    span = None
    if glued == (True, False):
        span = Span(
            profile.length, (), (names[1], names[0]), section, normal, place, _curvature(profile)
        )
    grid = Grid(low, high, 1.0, ("left", "right", *names), glued)
    return _grid(
        grid, embedding, embedding.normal, inverse, np.array(low if any(glued) else high), span
    )


def _curvature(profile: Profile) -> float:
    """The largest, at least 1; to a thousandth, not to rounding."""
    s = np.linspace(0, profile.length, 1001, dtype=np.float64)
    turned = np.linalg.norm(np.diff(profile.tangent(s), axis=0), axis=1)
    return max(1.0, round(float(turned.max() / s[1]), 3))


def _grid(
    grid: Grid,
    embedding: Embedding,
    normal: Embedding,
    inverse: Callable[[Array], Array],
    highest: Array,
    span: Span | None = None,
) -> Outline:
    def chart(mirror: Mirror | None, size: Grading) -> Chart:
        if isinstance(mirror, Sector):
            return replace(
                _between(grid, mirror), size=size.across if size.features else size.largest
            )
        through = lines_on(mirror, grid, embedding) if mirror else grid.through
        return replace(grid, size=size.across if size.features else size.largest, through=through)

    def planes(vectors: Sequence[Array], loosely: bool) -> list[Mirror]:
        return _either_half(grid_mirrors(grid, embedding))

    return Outline(
        chart, embedding, normal, inverse, highest, round=grid.glued[0], mirrors=planes, span=span
    )


def _between(grid: Grid, sector: Sector) -> Grid:
    """The part of a grid that is closed around e3 from azimuth 0 to 180/m degrees, at least four
    quadrilaterals.
    """
    end = (grid.high[0] - grid.low[0]) / sector.copies
    parts = tuple(end * part for part in (0.25, 0.5, 0.75))
    sides = (CUT, SECOND_CUT, *grid.sides[2:])
    return replace(
        grid,
        low=(0.0, grid.low[1]),
        high=(end, grid.high[1]),
        sides=sides,
        glued=(False, grid.glued[1]),
        movable=(parts, grid.movable[1]),
    )


def _either_half(planes: Sequence[Mirror]) -> list[Mirror]:
    """The planes as those of the halves on both of their sides."""
    return [half for plane in planes for half in (plane, plane.reversed)]


def _plane(x: Array) -> Array:
    return x[:2]


def _of_sphere(x: Array) -> Array:
    across = np.hypot(x[0], x[1])
    return np.asarray(np.arctan2(across, x[2]) * x[:2] / across) if across > 0 else np.zeros(2)
