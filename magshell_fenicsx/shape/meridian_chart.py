"""The meridian of a surface of revolution, and whether formulas are axisymmetric about e3.

`MeridianChart` is the chart of one meridian, or of those of several shells with one axis. The other
functions compare a formula of x, y, z, or a field, along many meridians. Lengths are over R.

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

from magshell_fenicsx.input.expressions import formula
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.mesh.patch import Embedding

Array = NDArray[np.float64]
# azimuths (rad) by the golden angle: nothing periodic meets them all, nor anything wider than 0.01
ANGLES = [2.399963 * i for i in range(720)]
SMOOTH_ANGLES, SMOOTH_STRIDE = 12, 20  # azimuths, and places passed over, for a smooth field
SAMPLES = 401  # places along a meridian
MAX_OFFSET = 0.1  # over R, of the places beside the surface that it may move to
OFFSET_SEED = 2026
RELATIVE_TOLERANCE = 1e-9  # over the largest value: differences that are rounding


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


def scalar_is_axisymmetric(text: str, meridian: MeridianChart, length: float = 1.0) -> bool:
    """Return whether a formula has the same value all around e3.

    Parameters
    ----------
    text
        Formula of x, y, z.
    meridian
        Meridian whose places are turned about e3.
    length
        R in the unit of length of the formula.
    """
    f, places = formula(text), length * meridian.interior_sample()
    # samples of the meridian, turned about e3 by all angles
    values_by_angle = [f(*(places @ rotation(angle)).T)[:, None] for angle in ANGLES]
    # narrow places, and these turned to azimuth zero
    narrow_places = length * meridian.narrow_places
    turned_places, _ = _at_azimuth_zero(meridian.narrow_places)
    at_azimuth_zero = length * turned_places
    return _all_equal(values_by_angle) and _all_equal(
        [f(*narrow_places.T)[:, None], f(*at_azimuth_zero.T)[:, None]]
    )


def vector_is_axisymmetric(
    components: Sequence[str],
    meridian: MeridianChart,
    length: float = 1.0,
    *,
    in_space: bool = False,
) -> bool:
    """Return whether a vector field turns with the meridian and has no component across it.

    Parameters
    ----------
    components
        Formulas of the components.
    length
        R in the unit of length of the formulas.
    in_space
        Whether this is asked beside the surface too, up to `MAX_OFFSET` from it.
    """
    vectors, places = vector_function(components), meridian.interior_sample()
    # places beside the surface are put back into the plane y = 0
    if in_space:
        places = with_nearby_places(places) * [1.0, 0.0, 1.0]
    # narrow places are compared with their images at azimuth zero
    at_azimuth_zero, Q = _at_azimuth_zero(meridian.narrow_places)
    rotated = np.einsum("nij,nj->ni", Q, vectors(length * meridian.narrow_places))
    return _turns_with_meridian(lambda x: vectors(length * x), places) and _all_equal(
        [vectors(length * at_azimuth_zero), rotated]
    )


def _at_azimuth_zero(x: Array) -> tuple[Array, Array]:
    """Return places (n, 3) turned about e3 into y = 0, and the rotations (n, 3, 3) that do so."""
    rho, ones, zeros = np.hypot(x[:, 0], x[:, 1]), np.ones(len(x)), np.zeros(len(x))
    # cosine and sine of the azimuth, which is zero on the axis
    divisor = np.where(rho > 0, rho, 1.0)
    c, s = np.where(rho > 0, x[:, :2].T / divisor, [[1.0], [0.0]])
    Q = np.array([[c, s, zeros], [-s, c, zeros], [zeros, zeros, ones]])
    return np.column_stack([rho, zeros, x[:, 2]]), np.moveaxis(Q, 2, 0)


def field_is_axisymmetric(
    field: Callable[[Array], Array], meridian: MeridianChart, *, smooth: bool = True
) -> bool:
    """Return whether a field turns with the meridian and has no component across it.

    Parameters
    ----------
    field
        Places (n, 3) -> vectors (n, 3).
    smooth
        Whether the field is as smooth as that of distant sources, so that few samples suffice.
    """
    places = meridian.interior_sample()
    if smooth:
        return _turns_with_meridian(field, places[::SMOOTH_STRIDE], ANGLES[:SMOOTH_ANGLES])
    return _turns_with_meridian(field, places)


def _turns_with_meridian(
    field: Callable[[Array], Array], places: Array, angles: Sequence[float] = ANGLES
) -> bool:
    """Return whether a field turns with places of the plane y = 0 and has no component along e2.

    `places` are (n, 3), `angles` are azimuths in radians.
    """
    # vectors at each azimuth, turned back; then the first without its component along e2
    in_plane = [field(places @ Q) @ Q.T for Q in map(rotation, angles)]
    return _all_equal([*in_plane, in_plane[0] * [1.0, 0.0, 1.0]])


def vector_function(components: Sequence[str]) -> Callable[[Array], Array]:
    """Return the function of places (n, 3) to vectors (n, 3) with these formulas as components."""
    fs = [formula(text) for text in components]
    return lambda x: np.stack([f(*x.T) for f in fs], axis=-1)


def with_nearby_places(x: Array) -> Array:
    """Return places (2 n, 3): the given ones, then one at random near each."""
    offsets = np.random.default_rng(OFFSET_SEED).uniform(-1, 1, x.shape)
    return np.vstack([x, x + MAX_OFFSET * offsets])


def _all_equal(values: Sequence[Array]) -> bool:
    """Return whether arrays are equal to the first one, to rounding."""
    first = values[0]
    if not first.size:
        return True
    tolerance = RELATIVE_TOLERANCE * np.abs(first).max()
    return all(bool((np.abs(v - first) <= tolerance).all()) for v in values)
