"""The chart of each geometry, over the reference length R: what is meshed, and how it is put into space."""

from collections.abc import Callable
from dataclasses import dataclass
from math import inf, pi, radians

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.shell import ShellSection
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.case.surfaces import (
    AnnulusSurface,
    CapSurface,
    CylinderSurface,
    MeshSurface,
    PlateSurface,
    RevolutionSurface,
    RoundSection,
    Surface,
    TorusSurface,
)
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.mesh.msh import MeshFile, in_space
from magshell_fenicsx.mesh.patch import Embedding
from magshell_fenicsx.mesh.revolved import Arc, Capped, Profile, Revolved, Segment, Spline
from magshell_fenicsx.mesh.shapes import DiscShape, Shape, StripShape
from magshell_fenicsx.mesh.sphere import Dimple, SphereEmbedding, flat
from magshell_fenicsx.plan.plan import Span

Array = NDArray[np.float64]
Chart = Shape | Grid | MeshFile
ROUNDING = 1e-9
ON_SURFACE = 1e-6  # of R, within which a named point lies on the surface


@dataclass(frozen=True)
class Outline:
    """A geometry as a chart with its map to space.

    Attributes
    ----------
    chart
        What is meshed, of the half y >= 0 or of all, for an element size (of grids).
    inverse
        Chart (2,) of a place (3,); of a mesh file the place itself.
    highest
        Chart of the point whose displacement is reported where the case names none: a pole, a tip; None: the
        reader of the mesh file takes the highest.
    edge
        Distance of the outer edge from the chart's origin; infinite where the chart is no disc.
    sphere
        Whether chart distances from the origin are polar angles.
    round
        Whether it is closed around e3.
    ends
        First chart coordinates between which the half of a ring lies; None where the second coordinate is y.
    span
        The meridian; None if it is closed, or the surface is none of revolution.
    """

    chart: Callable[[bool, float], Chart]
    embedding: Embedding
    inverse: Callable[[Array], Array]
    highest: Array | None
    edge: float = inf
    sphere: bool = False
    round: bool = False
    ends: tuple[float, float] | None = None
    span: Span | None = None

    def on_half(self, chart: Array) -> Array:
        """A place of the chart on the half y >= 0, from which rounding may have moved it."""
        if self.ends is not None:
            low, high = self.ends
            x = low if chart[0] < low + ROUNDING else high if chart[0] > high - ROUNDING else chart[0]
            return np.array([x, chart[1]])
        return np.array([chart[0], chart[1] if chart[1] > ROUNDING else 0.0])

    @property
    def disc(self) -> bool:
        """Whether it is of revolution about e3, up to its pole."""
        return self.edge < inf


def outline(case: Case, defect: Dimple | None) -> Outline:
    """The outline of a case's shell."""
    shell = case.shell
    if isinstance(shell, MeshSurface):
        file = MeshFile(shell.path, (shell.unit or 1.0) / shell.reference)
        return Outline(lambda half, size: file, in_space, lambda x: x, None)
    if isinstance(shell, ShellSection) and shell.width is not None:
        width = shell.width
        return Outline(lambda half, size: StripShape(width, half), flat, _plane, np.array([1.0, 0.0]))
    if isinstance(shell, ShellSection) and shell.geometry == "disc":
        return _disc(1.0, "rim", flat, _plane)
    if isinstance(shell, ShellSection) or (isinstance(shell, CapSurface) and shell.hole is None):
        hemisphere = isinstance(shell, ShellSection)
        edge, name = (pi / 2, "equator") if hemisphere else (radians(shell.polar), "rim")  # type: ignore[union-attr]
        return _disc(edge, name, SphereEmbedding(defect), _of_sphere, defect.phi_o if defect else None, sphere=True)
    if isinstance(shell, PlateSurface):
        high = np.array([1.0, shell.width / shell.reference])
        return Outline(
            lambda half, size: Grid((0.0, 0.0), (1.0, float(high[1])), size),
            flat,
            lambda x: np.clip(x[:2], 0.0, high),
            high,
        )
    profile, names = _profile(shell)
    if names[1] is None:
        perfect = Capped(profile)
        circle = defect.phi_o if defect else None
        bent = _curvature(profile)
        return _disc(profile.length, names[0], Capped(profile, defect), perfect.inverse, circle, curvature=bent)
    return _ring(shell, profile, (names[0], names[1]))


def refuse_beside(name: str, x: Array, outline: Outline, R: float) -> None:
    """See that a named point (3,) is on the surface.

    Raises
    ------
    CaseError
        With a place near it that is.
    """
    found = outline.inverse(x)
    there = x if len(found) == 3 else outline.embedding(found[None])[0]
    if np.linalg.norm(there - x) > ON_SURFACE:
        near = ", ".join(f"{c * R:.8g}" for c in there)
        raise CaseError(f"points.{name}: is not on the surface; a place near it that is: [{near}]")


def _disc(
    edge: float,
    name: str,
    embedding: Embedding,
    inverse: Callable[[Array], Array],
    circle: float | None = None,
    *,
    sphere: bool = False,
    curvature: float = 1.0,
) -> Outline:
    def chart(half: bool, size: float) -> Chart:
        return DiscShape(edge, half, circle, name)

    def within(x: Array) -> Array:
        found = inverse(x)
        beyond = np.hypot(*found) / edge
        return np.asarray(found / max(beyond, 1.0))

    def place(chart: Array) -> tuple[float, float]:
        return float(np.hypot(*chart)), float(np.arctan2(chart[1], chart[0]))

    span = Span(edge, circle, (None, name), embedding, place, curvature)
    return Outline(chart, embedding, within, np.zeros(2), edge, sphere, round=True, span=span)


def _ring(shell: Surface, profile: Profile, names: tuple[str, str]) -> Outline:
    assert isinstance(shell, RoundSection | RevolutionSurface)
    first, last = shell.turn
    along = np.linspace(0, profile.length, 101, dtype=np.float64)
    rho = float(profile(along)[:, 0].max())
    glued = shell.azimuth is None, isinstance(shell, TorusSurface) and shell.tube is None
    low, high = (first * rho, 0.0), (last * rho, profile.length)
    embedding = Revolved(profile, rho)

    def chart(half: bool, size: float) -> Chart:
        if half:
            mirror = ("symmetry", "symmetry", *names)
            return Grid((0.0, 0.0), (pi * rho, profile.length), size, mirror, (False, glued[1]))
        return Grid(low, high, size, ("left", "right", *names), glued)

    def inverse(x: Array) -> Array:
        return np.clip(embedding.inverse(x, first), low, high)

    def section(chart: Array) -> Array:
        r, z = profile(profile.length - chart[:, 0]).T  # from its end: the normal points outwards
        return np.column_stack([r, 0 * r, z])

    def place(chart: Array) -> tuple[float, float]:
        return profile.length - float(chart[1]), float(chart[0]) / rho

    span = None
    if glued == (True, False):
        span = Span(profile.length, None, (names[1], names[0]), section, place, _curvature(profile))
    seen = np.array(low if any(glued) else high)
    return Outline(chart, embedding, inverse, seen, round=glued[0], ends=(0.0, pi * rho), span=span)


def _curvature(profile: Profile) -> float:
    """The largest, at least 1; to a thousandth, not to rounding."""
    s = np.linspace(0, profile.length, 1001, dtype=np.float64)
    turned = np.linalg.norm(np.diff(profile.tangent(s), axis=0), axis=1)
    return max(1.0, round(float(turned.max() / s[1]), 3))


def _profile(shell: Surface) -> tuple[Profile, tuple[str, str | None]]:
    """The curve that is turned about e3, over R, and the names of its ends; no second one for the pole."""
    if isinstance(shell, CapSurface):
        assert shell.hole is not None
        return Arc(1.0, pi / 2 - radians(shell.polar), pi / 2 - radians(shell.hole)), ("rim", "hole")
    if isinstance(shell, CylinderSurface):
        return Segment((1.0, 0.0), (1.0, shell.length / shell.radius)), ("bottom", "top")
    if isinstance(shell, AnnulusSurface):
        return Segment((1.0, 0.0), (shell.inner_radius / shell.radius, 0.0)), ("outer", "inner")
    if isinstance(shell, TorusSurface):
        first, last = shell.tube or (0.0, 360.0)
        return Arc(shell.tube_radius / shell.radius, radians(first), radians(last), 1.0), ("bottom", "top")
    assert isinstance(shell, RevolutionSurface)
    curve = shell.profile.curve / shell.reference
    straight = len(curve) == 2
    ends = tuple(map(float, curve[0])), tuple(map(float, curve[1]))
    profile: Profile = Segment(*ends) if straight else Spline(curve)  # type: ignore[arg-type]
    return profile, ("bottom", None if curve[-1, 0] == 0 else "top")


def _plane(x: Array) -> Array:
    return x[:2]


def _of_sphere(x: Array) -> Array:
    across = np.hypot(x[0], x[1])
    return np.asarray(np.arctan2(across, x[2]) * x[:2] / across) if across > 0 else np.zeros(2)
