"""The symmetry that the imperfections of a case leave, by their values."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from math import atan2

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.mesh.patch import Deviation
from magshell_fenicsx.parts.imperfections.imperfection import Flaw, Local
from magshell_fenicsx.parts.imperfections.rims import AXIS, contour
from magshell_fenicsx.shape.ground import Angle, Straight
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.symmetry import Leaves, common_azimuth
from magshell_fenicsx.shape.turning import ANGLES

Array = NDArray[np.float64]
SAME = 1e-9  # of the largest w0
PARTS = (0.2, 0.5, 0.8)  # of the reach, at which a local imperfection is compared
IMAGE = 1e-12  # places, depths and widths that differ by less are equal: of w0 that is far below SAME
FIRST = 3  # imperfections without an image that are looked at before all places are


@dataclass(frozen=True)
class _Numbers:
    """Local deviations, those that differ in their depth alone added up.

    Attributes
    ----------
    rows
        Centres, widths, and the numbers of the profiles, (n, 5).
    depths
        (n,).
    angles
        Whether distances are angles.
    profiles
        See `Local`.
    """

    rows: Array
    depths: Array
    angles: bool
    profiles: Sequence[Callable[[Array], Array]]

    @cached_property
    def tree(self) -> "scipy.spatial.cKDTree":
        return scipy.spatial.cKDTree(self.rows)

    def __call__(self, x: Array) -> Array:
        """Their sum at a few places (m, 3)."""
        centres, widths = self.rows[:, :3], self.rows[:, 3]
        distance = np.linalg.norm(x[:, None] - centres, axis=-1)
        if self.angles:
            distance = 2 * np.arctan2(distance, np.linalg.norm(x[:, None] + centres, axis=-1))
        squared = (distance / widths) ** 2
        w0 = np.zeros(len(x))
        for number, profile in enumerate(self.profiles):
            of_it = np.round(self.rows[:, 4]) == number
            w0 -= profile(squared[:, of_it]) @ self.depths[of_it]
        return w0


@dataclass(frozen=True)
class _Sum:
    """The sum of some deviations."""

    deviations: Sequence[Deviation]

    def __call__(self, x: Array) -> Array:
        return np.asarray(sum((deviation(x) for deviation in self.deviations), np.zeros(len(x))))

    @cached_property
    def numbers(self) -> _Numbers | None:
        """What it is made of, if that is local deviations alone: there may be thousands."""
        local = [d for d in self.deviations if isinstance(d, Local)]
        kinds = list(dict.fromkeys(type(d) for d in local))
        angles = [d.distance.axis for d in local if isinstance(d.distance, Angle)]
        places = angles or [d.distance.place for d in local if isinstance(d.distance, Straight)]
        if not places or len(places) < len(self.deviations):
            return None
        shapes = [(d.width, kinds.index(type(d))) for d in local]
        rows = np.round(np.column_stack([places, shapes]) / IMAGE) * IMAGE
        rows, number = np.unique(rows, axis=0, return_inverse=True)
        depths = np.bincount(number.ravel(), [d.depth for d in local])
        kept = np.abs(depths) > IMAGE * np.abs(depths).max()
        profiles = [kind.profile for kind in kinds]
        return _Numbers(rows[kept], depths[kept], bool(angles), profiles) if kept.any() else None

    def mirrored(self, mirror: Mirror) -> bool | None:
        """Whether it is its own image, by its numbers; None if they do not say."""
        numbers = self.numbers
        if numbers is None or (numbers.angles and mirror.offset):
            return None
        rows, depths = numbers.rows, numbers.depths
        away, image = numbers.tree.query(np.column_stack([mirror.image(rows[:, :3]), rows[:, 3:]]))
        alone = (away > 4 * IMAGE) | (np.abs(depths[image] - depths) > IMAGE * np.abs(depths).max())
        if not alone.any():
            return True if len(np.unique(image)) == len(image) else None
        centres = rows[np.flatnonzero(alone)[:FIRST], :3]
        differs = np.abs(numbers(centres) - numbers(mirror.image(centres))).max()
        return False if differs > 2 * SAME * np.abs(depths).sum() else None


def leaves(flaws: Mapping[str, Flaw], drawn: Outline, *, each: bool) -> list[Leaves]:
    """What imperfections leave.

    Parameters
    ----------
    drawn
        The perfect shell.
    each
        Whether each must be its own image, as patches with names are.
    """
    if not flaws:
        return []
    grouped = [[flaw] for flaw in flaws.values()] if each else [list(flaws.values())]
    groups = [_Sum([flaw.deviation for flaw in group]) for group in grouped]

    sample = cache(lambda: _sample(flaws, drawn))

    def mirrors(mirror: Mirror) -> bool:
        unsure = []
        for group in groups:
            if (answer := group.mirrored(mirror)) is False:
                return False
            if answer is None:
                unsure.append(group)
        return all(_same(group(sample()), group(mirror.image(sample()))) for group in unsure)

    centres = [flaw.centre for flaw in flaws.values() if flaw.centre is not None]
    off = [centre for centre in centres if np.hypot(*centre[:2]) > AXIS]
    reason = None
    if off and drawn.round:
        reason = "an imperfection is off the axis"
    elif drawn.span:
        places = drawn.span.sample()[1:-1]
        turned = [np.concatenate([group(places @ rotation(a)) for group in groups]) for a in ANGLES[:24]]
        if not all(_same(turned[0], w0) for w0 in turned):
            reason = "an imperfection differs around e3"
    if not drawn.round:
        return [Leaves(reason, (), mirrors)]
    if common_azimuth(off) is None:
        return [Leaves(reason, (), mirrors, azimuths=_between(off))]
    return [Leaves(reason, off, mirrors)]


def _between(centres: Sequence[Array]) -> tuple[float, ...]:
    """Azimuths (rad) of the planes through e3 that map the first place to itself or to one at the same distance."""
    first, *others = centres
    alike = [x for x in others if abs(np.hypot(*x[:2]) - np.hypot(*first[:2])) < AXIS and abs(x[2] - first[2]) < AXIS]
    return tuple((atan2(x[1], x[0]) + atan2(first[1], first[0])) / 2 for x in (first, *alike))


def _sample(flaws: Mapping[str, Flaw], drawn: Outline) -> Array:
    """Places (n, 3) all over the shell, and around each local imperfection."""
    places = [drawn.sample()]
    for key, flaw in flaws.items():
        if flaw.centre is None:
            continue
        places.append(flaw.centre[None])
        chart = drawn.inverse(flaw.centre)
        if len(chart) == 2:
            places += [drawn.perfect(contour(key, flaw, drawn, 0.0, chart, part)[::7]) for part in PARTS]
    return np.concatenate(places)


def _same(w0: Array, image: Array) -> bool:
    return bool((np.abs(w0 - image) <= SAME * max(np.abs(w0).max(), np.abs(image).max())).all())
