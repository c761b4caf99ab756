"""The symmetry that imperfections leave, by their values, and their places in the chart.

w0 is the deviation along the outward normal. Places, widths and depths are over R, the reference
length. A local imperfection is a deviation -depth f((distance/width)²) around a centre, with a
profile f; its reach is where it ends, its rim the curve on which its curvature jumps. A symmetry
constraint says which planes mirror a part of a case, and why it is not axisymmetric about e3. The
chart is the pair of coordinates of the perfect surface; `perfect.perfect` maps it to places,
`perfect.inverse` back. A mirror is a plane, and `image` the reflection in it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import product
from math import atan2, sqrt

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grading import DiscFeature, Feature
from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.mesh.patch import Deviation
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionGeometry, Local
from magshell_fenicsx.parts.step_course import SizingContext
from magshell_fenicsx.shape.field_symmetry import (
    ANGLES,
    FIELD_TOLERANCE,
    equal_to_rounding,
    is_mirror_image,
)
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.reference_shell import AngularDistance, StraightDistance
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint, common_azimuth

Array = NDArray[np.float64]
COMPARED_PARTS_OF_REACH = (0.2, 0.5, 0.8)  # of the reach, at which a local imperfection is compared
# places, depths and widths that differ by less are equal: of w0 that is far below FIELD_TOLERANCE
IMAGE_TOLERANCE = 1e-12
FIRST_COMPARED = 3  # imperfections without an image that are looked at before all places are
CONTOUR_CORNERS = 128  # of a closed curve: a cubic spline through them is exact to 1e-6 of its size
CONTOUR_STEPS, FALSE_POSITION_ROUNDS = 40, 12
RIM_TOLERANCE = 0.02  # of the element size
MAX_RIMS = 60  # more would take gmsh minutes
MAX_CHART_STRETCH = 4.0  # distance in the chart over the distance on the surface
AXIS_TOLERANCE = 1e-9  # over R


@dataclass(frozen=True)
class _Numbers:
    """Local deviations as numbers; the depths of those that are alike otherwise are added up.

    Attributes
    ----------
    rows
        (n, 5): centre (3), width, and number of the profile.
    depths
        (n,) depths, inwards positive.
    angles
        Whether distances from a centre are angles.
    profiles
        Functions f of (distance/width)², see `Local`; `rows` has their numbers.
    """

    rows: Array
    depths: Array
    angles: bool
    profiles: Sequence[Callable[[Array], Array]]

    @cached_property
    def tree(self) -> "scipy.spatial.cKDTree":
        """Tree of the rows, to find the image of each under a mirror."""
        return scipy.spatial.cKDTree(self.rows)

    def __call__(self, x: Array) -> Array:
        """Return the sum w0 (m,) over R of the deviations at a few places (m, 3).

        Each is -depth f((distance/width)²), with the profile f of its row.
        """
        centres, widths = self.rows[:, :3], self.rows[:, 3]
        distance = np.linalg.norm(x[:, None] - centres, axis=-1)
        if self.angles:  # between unit vectors; the half-angle formula is exact for small angles
            distance = 2 * np.arctan2(distance, np.linalg.norm(x[:, None] + centres, axis=-1))
        squared = (distance / widths) ** 2
        w0 = np.zeros(len(x))
        for number, profile in enumerate(self.profiles):
            has_profile = np.round(self.rows[:, 4]) == number
            w0 -= profile(squared[:, has_profile]) @ self.depths[has_profile]
        return w0


@dataclass(frozen=True)
class _Sum:
    """The sum of some deviations, as a function of places (n, 3)."""

    deviations: Sequence[Deviation]

    def __call__(self, x: Array) -> Array:
        return np.asarray(sum((deviation(x) for deviation in self.deviations), np.zeros(len(x))))

    @cached_property
    def numbers(self) -> _Numbers | None:
        """The local deviations as numbers; None if there are deviations of other kinds.

        None also for a mixture of angular and straight distances. There may be thousands of
        deviations.
        """
        # centres: unit vectors if distances are angles, else places
        local_deviations = [d for d in self.deviations if isinstance(d, Local)]
        axes = [
            d.distance.axis for d in local_deviations if isinstance(d.distance, AngularDistance)
        ]
        centres = axes or [
            d.distance.place for d in local_deviations if isinstance(d.distance, StraightDistance)
        ]
        # fewer centres than deviations: some are not local, or their distances are of both kinds
        if not centres or len(centres) < len(self.deviations):
            return None
        # a row of each deviation: centre, width and number of the profile. Each subclass of `Local`
        # has one profile; its number is that of the class
        classes = list(dict.fromkeys(type(d) for d in local_deviations))
        shapes = [(d.width, classes.index(type(d))) for d in local_deviations]
        rows = np.round(np.column_stack([centres, shapes]) / IMAGE_TOLERANCE) * IMAGE_TOLERANCE
        # deviations with equal rows become one with the sum of their depths, unless that is zero
        rows, row_of_deviation = np.unique(rows, axis=0, return_inverse=True)
        depths = np.bincount(row_of_deviation.ravel(), [d.depth for d in local_deviations])
        is_kept = np.abs(depths) > IMAGE_TOLERANCE * np.abs(depths).max()
        if not is_kept.any():
            return None
        profiles = [profile_class.profile for profile_class in classes]
        return _Numbers(rows[is_kept], depths[is_kept], angles=bool(axes), profiles=profiles)

    def mirrored(self, mirror: Mirror) -> bool | None:
        """Return whether a plane mirrors the sum onto itself; None if the numbers do not decide it.

        None means that the deviations must be compared by their values at many places.
        """
        numbers = self.numbers
        if numbers is None:
            return None
        # only a plane through the origin maps unit vectors to unit vectors
        if numbers.angles and mirror.offset:
            return None
        # the deviation that lies nearest to the mirror image of each one
        rows, depths = numbers.rows, numbers.depths
        mirrored_rows = np.column_stack([mirror.image(rows[:, :3]), rows[:, 3:]])
        distance, nearest = numbers.tree.query(mirrored_rows)
        # it is the image if place, width, profile and depth agree
        depth_differs = np.abs(depths[nearest] - depths) > IMAGE_TOLERANCE * np.abs(depths).max()
        has_no_image = (distance > 4 * IMAGE_TOLERANCE) | depth_differs
        if not has_no_image.any():
            # not decided if two deviations have the same image
            return True if len(np.unique(nearest)) == len(nearest) else None
        # several deviations together may still make the image of one. Where the sum w0 differs
        # between the centre of one without an image and its mirror image, they do not; else nothing
        # is decided
        centres = rows[np.flatnonzero(has_no_image)[:FIRST_COMPARED], :3]
        difference = np.abs(numbers(centres) - numbers(mirror.image(centres))).max()
        return False if difference > 2 * FIELD_TOLERANCE * np.abs(depths).sum() else None


def imperfection_constraints(
    imperfections: Mapping[str, ImperfectionGeometry], perfect: Outline, *, one_by_one: bool
) -> list[SymmetryConstraint]:
    """Return the symmetry that imperfections preserve; empty without imperfections.

    Parameters
    ----------
    imperfections
        Key below `shell` -> geometry.
    perfect
        The perfect shell.
    one_by_one
        Whether each imperfection must be its own image, as where it is a patch with a name. Else
        an imperfection may be the image of another: only their sum is compared.
    """
    if not imperfections:
        return []
    deviations = [imperfection.deviation for imperfection in imperfections.values()]
    groups = [_Sum([deviation]) for deviation in deviations] if one_by_one else [_Sum(deviations)]
    sample = cache(lambda: _sample(imperfections, perfect))  # costly, and often not needed

    def mirrors(mirror: Mirror) -> bool:
        """Return whether a plane is a plane of symmetry of all groups of imperfections.

        A comparison of centres, widths and depths decides most groups. The others are compared by
        values w0 at the sample.
        """
        undecided = []
        for group in groups:
            # False: it is none; None: not decided
            if (answer := group.mirrored(mirror)) is False:
                return False
            if answer is None:
                undecided.append(group)
        return all(is_mirror_image(group, mirror, sample()) for group in undecided)

    # why the shell is not axisymmetric; None if it is
    centres = [i.centre for i in imperfections.values() if i.centre is not None]
    centres_off_axis = [centre for centre in centres if np.hypot(*centre[:2]) > AXIS_TOLERANCE]
    reason = None
    if centres_off_axis and perfect.round:
        reason = "an imperfection is off the axis"
    elif perfect.meridian and _differ_around_e3(groups, perfect.meridian.interior_sample()):
        reason = "an imperfection differs around e3"
    # of a shell that is not round, such as a plate, the shell itself says which planes may be
    # planes of symmetry: no vectors or azimuths are given
    if not perfect.round:
        return [SymmetryConstraint(reason, (), mirrors)]
    # of a round shell they are planes through e3: that through all centres, if there is one, else
    # those between centres of different azimuths
    if common_azimuth(centres_off_axis) is None:
        azimuths = _azimuths_of_planes(centres_off_axis)
        return [SymmetryConstraint(reason, (), mirrors, azimuths=azimuths)]
    return [SymmetryConstraint(reason, centres_off_axis, mirrors)]


def _differ_around_e3(groups: Sequence[_Sum], places: Array) -> bool:
    """Return whether a sum of deviations changes where places (n, 3) turn about e3."""
    w0_at_angles = list[Array]()
    for a in ANGLES[:24]:
        w0_of_groups = [group(places @ rotation(a)) for group in groups]
        w0_at_angles.append(np.concatenate(w0_of_groups))
    return not all(equal_to_rounding(w0_at_angles[0], w0) for w0 in w0_at_angles)


def _azimuths_of_planes(centres: Sequence[Array]) -> tuple[float, ...]:
    """Return azimuths (rad) of planes through e3 that may be planes of symmetry of places.

    Each plane maps the first place to itself, or to a place at the same height and distance from
    e3.
    """
    first_place, *other_places = centres
    at_same_distance = [
        x
        for x in other_places
        if abs(np.hypot(*x[:2]) - np.hypot(*first_place[:2])) < AXIS_TOLERANCE
        and abs(x[2] - first_place[2]) < AXIS_TOLERANCE
    ]
    # the plane at the mean of two azimuths maps one place to the other; with the first place in
    # both roles it contains that place
    azimuth = atan2(first_place[1], first_place[0])
    return tuple((atan2(x[1], x[0]) + azimuth) / 2 for x in (first_place, *at_same_distance))


def _sample(imperfections: Mapping[str, ImperfectionGeometry], perfect: Outline) -> Array:
    """Return places (n, 3) at which deviations are compared with their images.

    They lie all over the shell, and around each local imperfection: at its centre, and on contours
    within its reach.
    """
    places = [perfect.sample()]
    for key, imperfection in imperfections.items():
        if imperfection.centre is None:
            continue
        places.append(imperfection.centre[None])
        chart = perfect.inverse(imperfection.centre)
        if len(chart) == 2:  # a surface without a chart has no contours
            places += [
                # every seventh of the contour's 128 points
                perfect.perfect(
                    contour(key, imperfection, perfect, turn=0.0, centre=chart, part=part)[::7]
                )
                for part in COMPARED_PARTS_OF_REACH
            ]
    return np.concatenate(places)


@dataclass(frozen=True)
class LocalImperfection:
    """A local imperfection in the chart.

    Attributes
    ----------
    centre, radius
        The disc in the chart that needs small elements.
    size
        The largest element size over R that resolves it.
    circle
        Whether its outline is a circle around the chart's origin.
    jumps
        Whether the curvature jumps where it ends.
    rim
        Points (n, 2) of the closed curve on which the curvature jumps; None where it does not, and
        of a circle.
    """

    centre: Array
    radius: float
    size: float
    circle: bool = False
    jumps: bool = False
    rim: Array | None = None

    def features(self, outline: Outline, sizing: SizingContext, growth: float) -> list[Feature]:
        """Return mesh sizes: small elements on the imperfection and a little around, then growing.

        `growth` is the growth of the size per distance.
        """
        radius, size = self.radius + 0.7 * sqrt(sizing.h), self.size / sizing.refinement
        return [
            DiscFeature((float(x), float(y)), radius, size, growth)
            for x, y in images(self, outline)
        ]


def local_imperfections(
    imperfections: Iterable[tuple[str, ImperfectionGeometry]], perfect: Outline, turn: float
) -> list[LocalImperfection]:
    """Return the local imperfections of a case in the chart of a frame turned about e3.

    Parameters
    ----------
    imperfections
        Keys below `shell` and geometries.
    perfect
        The perfect shell.
    turn
        Angle of the frame (rad).

    Raises
    ------
    CaseError
        If an imperfection reaches around the shell.
    """
    local_imperfections = []
    for key, imperfection in imperfections:
        if imperfection.centre is None:
            continue
        # at the pole of a disc its outline is a circle about the origin of the chart
        if perfect.disc and np.hypot(*imperfection.centre[:2]) < AXIS_TOLERANCE:
            local_imperfections.append(
                LocalImperfection(
                    np.zeros(2),
                    imperfection.reach,
                    imperfection.size,
                    circle=True,
                    jumps=imperfection.rim,
                )
            )
            continue
        centre = perfect.inverse(rotation(turn) @ imperfection.centre)
        curve = contour(key, imperfection, perfect, turn, centre, part=1.0)  # the whole reach
        radius = float(np.linalg.norm(curve - centre, axis=1).max())
        local_imperfections.append(
            LocalImperfection(
                centre,
                radius,
                imperfection.size,
                circle=False,
                jumps=imperfection.rim,
                rim=curve if imperfection.rim else None,
            )
        )
    return local_imperfections


def distinct_rims(local: Iterable[LocalImperfection]) -> tuple[Array, ...]:
    """Return the rims that need edges of elements; of nearly equal rims only the first."""
    rims: list[Array] = []
    for local_imperfection in local:
        rim = local_imperfection.rim
        if rim is not None and all(
            np.abs(rim - kept_rim).max() > RIM_TOLERANCE * local_imperfection.size
            for kept_rim in rims
        ):
            rims.append(rim)
    return tuple(rims)


def contour(
    key: str,
    imperfection: ImperfectionGeometry,
    perfect: Outline,
    turn: float,
    centre: Array,
    part: float,
) -> Array:
    """Return points (n, 2) of the chart at which an imperfection reaches a part of its reach.

    There is one point on each ray from the centre: the first at the distance `part` times the
    reach, by the rule of false position.

    Parameters
    ----------
    key
        Key of the imperfection below `shell`, for the message.
    turn
        Angle about e3 of the frame of the chart (rad).
    centre
        Centre (2,) of the imperfection in the chart.
    part
        Part of the reach, 1 for all of it.

    Raises
    ------
    CaseError
        If the imperfection reaches around the shell.
    """
    assert imperfection.distance
    distance, Q, reach = imperfection.distance, rotation(turn), part * imperfection.reach
    # unit vectors (corners, 2) of the rays
    angles = np.arange(CONTOUR_CORNERS) * 2 * np.pi / CONTOUR_CORNERS
    rays = np.column_stack([np.cos(angles), np.sin(angles)])

    def distance_beyond(t: Array) -> Array:
        """Return distances (..., corners) from the centre at t along rays, less the wanted one."""
        chart = centre + t[..., None] * rays
        return distance(perfect.perfect(chart.reshape(-1, 2)) @ Q).reshape(t.shape) - reach

    # the ends of equal intervals of each ray, and flags (intervals, rays) whether an interval ends
    # at the wanted distance or beyond
    ray_lengths = np.linspace(0, MAX_CHART_STRETCH * reach, CONTOUR_STEPS + 1)[1:]
    is_outside = distance_beyond(np.tile(ray_lengths[:, None], CONTOUR_CORNERS)) >= 0
    if not is_outside.any(axis=0).all():
        raise CaseError(
            f"shell.{key}.width: its width over R, {imperfection.reach:.3g}, is too much for this "
            "place: it would reach around the shell or its axis"
        )
    # the wanted point of each ray is in its first interval that ends outside, from low to high
    high = ray_lengths[is_outside.argmax(axis=0)]
    length = _root_by_false_position(distance_beyond, low=high - ray_lengths[0], high=high)
    return np.asarray(centre + length[:, None] * rays)


def _root_by_false_position(f: Callable[[Array], Array], low: Array, high: Array) -> Array:
    """Return zeros (n,) of n functions between `low` and `high`, where their signs differ.

    The rule of false position takes the zero of the secant as one end of the next interval. If the
    other end stays, its value counts half (the Illinois rule), which makes convergence fast.

    Parameters
    ----------
    f
        Arguments (n,) -> value of each function at its argument.
    """
    f_low, f_high = f(low), f(high)
    for _ in range(FALSE_POSITION_ROUNDS):
        secant_zero = high - f_high * (high - low) / (f_high - f_low)
        f_zero = f(secant_zero)
        # the secant's zero becomes one end, called `high`. The other end, called `low`, is the old
        # `high` if f changes its sign between them; else the old `low` stays with half its value
        is_crossed = f_zero * f_high < 0
        low, f_low = np.where(is_crossed, high, low), np.where(is_crossed, f_high, f_low / 2)
        # where the zero is hit, a tiny value keeps the quotient from 0/0
        high, f_high = secant_zero, np.where(f_zero == 0, 1e-300, f_zero)
    return high


def images(local_imperfection: LocalImperfection, perfect: Outline) -> list[Array]:
    """Return the centre (2,) of a local imperfection, and its images across glued sides.

    Glued are opposite sides of a grid, as of a closed cylinder.
    """
    if not (grid := perfect.grid):
        return [local_imperfection.centre]
    # an image is one width of the grid to either side, in the directions that are glued
    steps = product(*((-1, 0, 1) if glued else (0,) for glued in grid.glued))
    return [
        local_imperfection.centre + np.multiply(step, np.subtract(grid.high, grid.low))
        for step in steps
    ]
