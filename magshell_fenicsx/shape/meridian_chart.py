"""The meridian of a surface of revolution about e3.

`MeridianChart` is the chart of one meridian, or of those of several shells with one axis. Lengths
are over R.

A meridian is the profile curve of a surface of revolution, in the plane of e1 and e3 (azimuth 0).
Its parameter s is the first coordinate of its chart; the second is 0. Several shells have one
interval of s each. A place x of the meridian at another azimuth is `x @ rotation(azimuth)`. A
narrow place is one at which a formula is known to vary over a short distance, so that samples could
miss it: it is tested too.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from math import inf

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import Embedding

Array = NDArray[np.float64]
SAMPLES = 401  # places along a meridian


@dataclass(frozen=True)
class ShellMeridian:
    """The meridian of one of several shells, a part of a `MeridianChart`.

    Attributes
    ----------
    name
        Name of the shell.
    ends
        First and last value of the parameter.
    place
        Place (3,) in space -> parameter of the nearest place of the meridian, and azimuth (rad).
    vertices
        Function of contacts, each by its size and by the distance from the pole up to which it is
        possible, to vertices (n,) of the meridian's mesh.
    """

    name: str
    ends: tuple[float, float]
    place: Callable[[Array], tuple[float, float]]
    vertices: Callable[[Sequence[tuple[float, float]]], Array]

    @property
    def length(self) -> float:
        """Length of the interval of the parameter."""
        return self.ends[1] - self.ends[0]


@dataclass(frozen=True)
class MeridianChart:
    """A meridian from the pole or one edge to the other; or those of several shells with one axis.

    Attributes
    ----------
    length
        Length of its chart, which starts at 0.
    curvature_jumps
        Parameters at which the curvature jumps.
    names
        Names of its ends; None for a pole, and where shells are joined.
    embedding, normal
        Functions of charts (n, 2), with a second coordinate of 0, to places and normals (n, 3) in
        the plane of e1 and e3; normals are those of the perfect surface.
    locate
        Chart (2,) of the surface -> parameter of this meridian and azimuth (rad).
    curvature
        Largest curvature of the meridian over 1/R, at least 1. Of several shells, the curvature of
        the one with the most waves around e3.
    largest
        Cell size that resolves the imperfections.
    vertices
        (n,) vertices of its mesh; None if the mesh is not given.
    narrow_places
        Places (n, 3) of the surface at which formulas are narrow.
    shell_meridians
        Meridians of several shells; empty for one shell.
    joints
        For each joint of two shells the parameter on the first and on the second one. Two edges
        that meet have the same; where an edge ends on another shell (a T-junction), they differ.
    """

    length: float
    curvature_jumps: tuple[float, ...]
    names: tuple[str | None, ...]
    embedding: Embedding
    normal: Embedding
    locate: Callable[[Array], tuple[float, float]]
    curvature: float = 1.0
    largest: float = inf
    vertices: Array | None = None
    narrow_places: Array = field(default_factory=lambda: np.zeros((0, 3)))
    shell_meridians: tuple[ShellMeridian, ...] = ()
    joints: tuple[tuple[float, float], ...] = ()

    def sample(self) -> Array:
        """Return places (n, 3) along the meridian of each shell, the ends among them."""
        return self._places_at(
            [np.linspace(first, last, SAMPLES, dtype=np.float64) for first, last in self._intervals]
        )

    def interior_sample(self) -> Array:
        """Return places (n, 3) along the meridian without its ends.

        A formula may divide by zero on the axis.
        """
        return self._places_at(
            [
                np.linspace(first, last, SAMPLES, dtype=np.float64)[1:-1]
                for first, last in self._intervals
            ]
        )

    def locate_named(self, name: str, x: Array) -> tuple[float, float]:
        """Return parameter and azimuth (rad) of a named place x.

        Of several shells, the name begins with that of the shell; x is then a place (3,), else a
        chart.
        """
        meridians = (m for m in self.shell_meridians if name.startswith(f"{m.name}_"))
        meridian = next(meridians, None)
        return meridian.place(x) if meridian else self.locate(x)

    @property
    def knots(self) -> Array:
        """Sorted parameters (n,) at which cells end: ends of shells, jumps of the curvature."""
        return np.array(sorted({*np.ravel(self._intervals), *self.curvature_jumps}))

    def ends(self) -> dict[str, Array]:
        """Return the place (rho, z) of each named end."""
        places = self._places_at([np.array(ends) for ends in self._intervals])[:, [0, 2]]
        return {
            name: np.asarray(place) for name, place in zip(self.names, places, strict=True) if name
        }

    @property
    def _intervals(self) -> list[tuple[float, float]]:
        """First and last parameter of each shell."""
        return [meridian.ends for meridian in self.shell_meridians] or [(0.0, self.length)]

    def _places_at(self, parameters: Sequence[Array]) -> Array:
        """Return places (n, 3) at parameters, which are given in several arrays."""
        s = np.concatenate(parameters)
        return self.embedding(np.column_stack([s, 0 * s]))
