"""Whether a field is its own mirror image, or axisymmetric about e3: compared at many places.

A field is a function of places (n, 3) over R. Its values are scalars (n,) or vectors (n, 3). Two
values count as equal if they differ by less than `FIELD_TOLERANCE` of the largest one: formulas
and places have errors of rounding of some 1e-15, and a difference that is meant is larger. A place
x of a meridian (in the plane of e1 and e3) is `x @ rotation(azimuth)` at another azimuth.
"""

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import formula_function
from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.shape.meridian_chart import MeridianChart

Array = NDArray[np.float64]
FieldFunction: TypeAlias = Callable[[Array], Array]
FIELD_TOLERANCE = 1e-9  # over the largest value: differences that are rounding
# azimuths (rad) by the golden angle: no period fits them all; neighbours are at most 0.0122 apart
ANGLES = [2.399963 * i for i in range(720)]
SMOOTH_ANGLES, SMOOTH_STRIDE = 12, 20  # azimuths, and places passed over, for a smooth field
MAX_SHIFT = 0.1  # over R, along each axis: how far a place beside the surface may be from it
SHIFT_SEED = 2026


def formula_field(
    components: float | str | Sequence[float | str], length: float = 1.0
) -> FieldFunction:
    """Return the field of a number or formula, or of one for each component of a vector.

    Parameters
    ----------
    length
        R in the unit of length of the formulas.
    """
    if isinstance(components, float | int | str):
        scalar = formula_function(components)
        return lambda x: np.asarray(scalar(*(length * x).T))
    functions = [formula_function(component) for component in components]
    return lambda x: np.stack([f(*(length * x).T) for f in functions], axis=-1)


def is_mirror_image(
    field: FieldFunction,
    mirror: Mirror,
    places: Array,
    image: FieldFunction | None = None,
    sign: float = 1.0,
) -> bool:
    """Return whether a plane maps a field to another one, or to itself.

    Parameters
    ----------
    places
        (n, 3) places over R, whose images are looked at too.
    image
        The other field; None: the field itself.
    sign
        Factor of the other field: -1 if mirror images change their sign.
    """
    values, values_at_images = field(places), (image or field)(mirror.image(places))
    mirrored_values = values @ mirror.reflection if values.ndim == 2 else values
    return equal_to_rounding(mirrored_values, sign * values_at_images)


def is_axisymmetric(
    field: FieldFunction,
    meridian: MeridianChart | None,
    *,
    in_space: bool = False,
    is_smooth: bool = False,
) -> bool:
    """Return whether a field is the same all around e3, and has no component around e3.

    It is compared along many meridians, and at the places where formulas are known to be narrow.

    Parameters
    ----------
    meridian
        Meridian of the surface; None if it is no surface of revolution, which has no such field.
    in_space
        Whether this is asked beside the surface too, up to `MAX_SHIFT` from it.
    is_smooth
        Whether the field is as smooth as that of distant sources, so that few samples suffice.
    """
    if meridian is None:
        return False
    places, angles = meridian.interior_sample(), ANGLES
    if in_space:  # places beside the surface are put back into the plane of the meridian
        places = with_nearby_places(places) * [1.0, 0.0, 1.0]
    if is_smooth:
        places, angles = places[::SMOOTH_STRIDE], ANGLES[:SMOOTH_ANGLES]

    def values_at(azimuth: float) -> Array:
        """Return the values on the meridian at an azimuth, as components in its frame."""
        values, Q = field(places @ rotation(azimuth)), rotation(azimuth)
        return values @ Q.T if values.ndim == 2 else values

    first = values_at(ANGLES[0])
    if not all(equal_to_rounding(first, values_at(azimuth)) for azimuth in angles[1:]):
        return False
    if first.ndim == 2 and not equal_to_rounding(first, first * [1.0, 0.0, 1.0]):
        return False
    narrow_places = meridian.narrow_places
    if is_smooth or not len(narrow_places):
        return True
    # narrow places, and these turned to the azimuth zero
    at_azimuth_zero, Q = _at_azimuth_zero(narrow_places)
    values = field(narrow_places)
    if values.ndim == 2:
        values = np.einsum("nij,nj->ni", Q, values)
    return equal_to_rounding(field(at_azimuth_zero), values)


def _at_azimuth_zero(x: Array) -> tuple[Array, Array]:
    """Return places (n, 3) turned about e3 into y = 0, and the rotations (n, 3, 3) that do so."""
    rho, ones, zeros = np.hypot(x[:, 0], x[:, 1]), np.ones(len(x)), np.zeros(len(x))
    # cosine and sine of the azimuth, which is zero on the axis
    divisor = np.where(rho > 0, rho, 1.0)
    c, s = np.where(rho > 0, x[:, :2].T / divisor, [[1.0], [0.0]])
    Q = np.array([[c, s, zeros], [-s, c, zeros], [zeros, zeros, ones]])
    return np.column_stack([rho, zeros, x[:, 2]]), np.moveaxis(Q, 2, 0)


def with_nearby_places(x: Array) -> Array:
    """Return places (2 n, 3): the given ones, then one at random near each."""
    offsets = np.random.default_rng(SHIFT_SEED).uniform(-1, 1, x.shape)
    return np.vstack([x, x + MAX_SHIFT * offsets])


def equal_to_rounding(a: Array, b: Array) -> bool:
    """Return whether arrays are finite, and equal to `FIELD_TOLERANCE` of the largest value."""
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return False
    return bool((np.abs(a - b) <= FIELD_TOLERANCE * np.abs(a).max(initial=0.0)).all())
