"""Where shells that may touch are nearest to each other undeformed: their elements are smaller
there.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import DiscFeature, Feature
from magshell_fenicsx.parts.course import Fit
from magshell_fenicsx.parts.touching.section import WHOLE
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
FINE = 0.5  # of sqrt(R h): cells where shells meet
AROUND, APART = (
    1.0,
    2.0,
)  # of sqrt(R h): how far from there, and how far from each other places are one
ALIKE = 0.5  # of the thickness: places that are so much farther from each other may meet as well
FAR = 20.0  # thicknesses: shells that are farther from each other may meet anywhere, or nowhere
EXACT = 1e-12  # change of the square of the distance at which a search ends
NEAREST = 50  # places of a mid-surface among which that of the nearest face is


@dataclass(frozen=True)
class Meeting:
    """A place in the chart where another shell is nearest."""

    place: Array

    def features(self, outline: Outline, fit: Fit, growth: float) -> list[Feature]:
        """Elements that show the ring of a contact."""
        x, y = map(float, self.place)
        return [DiscFeature((x, y), AROUND * sqrt(fit.h), FINE * sqrt(fit.h) / fit.refinement, growth)]


def meetings(
    pairs: Sequence[Sequence[str]],
    places: Mapping[str, Array],
    thickness: Mapping[str, Array | float],
    apart: Mapping[str, float],
    charted: "Mapping[str, Charted]",
) -> dict[str, list[Array]]:
    """Name of a shell -> places (3,) where others that it may touch are nearest, if that is one
    place and no area.

    Parameters
    ----------
    pairs
        Names of shells that may touch, or `shell` and itself for all.
    places
        Name -> places (n, 3) all over it.
    thickness, apart
        Name -> its thickness, at all places or everywhere, and how far from each other places are
        one; of all in the same length.
    charted
        Name -> its chart; without one its places are those that are given.
    """
    names = list(places)
    every = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    found: dict[str, list[Array]] = {name: [] for name in names}
    half = {
        name: np.broadcast_to(np.asarray(thickness[name]) / 2, len(places[name])) for name in names
    }
    for a, b in every if [WHOLE, WHOLE] in [[*pair] for pair in pairs] else pairs:
        if a == b or a not in places or b not in places:
            continue
        away = {
            one: _gaps(places[one], places[other], half[one], half[other])
            for one, other in ((a, b), (b, a))
        }
        gaps, number = away[a]
        nearest = int(np.argmin(gaps))
        ends, alone = {a: places[a][nearest], b: places[b][number[nearest]]}, list[str]()
        h = {name: 2 * float(half[name].mean()) for name in (a, b)}
        for name in (a, b):
            alike = places[name][away[name][0] < gaps.min() + ALIKE * h[name]]
            if np.linalg.norm(alike - ends[name], axis=1).max() < apart[name]:
                alone.append(name)
        if alone and a in charted and b in charted:
            ends = dict(
                zip((a, b), _nearest(ends[a], ends[b], charted[a], charted[b]), strict=True)
            )
        for name in alone:
            if np.linalg.norm(ends[a] - ends[b]) < FAR * h[name]:
                found[name].append(ends[name])
    return found


def _gaps(x: Array, y: Array, of_x: Array, of_y: Array) -> tuple[Array, NDArray[np.int64]]:
    """How far faces of places x (n, 3) are from those of places y (m, 3), and the numbers of the
    nearest of these.
    """
    away, near = scipy.spatial.KDTree(y).query(
        x, k=range(1, 1 + min(NEAREST if np.ptp(of_y) else 1, len(y)))
    )
    gaps = away - of_y[near] - of_x[:, None]
    least = np.arange(len(x)), gaps.argmin(axis=1)
    return gaps[least], near[least]


@dataclass(frozen=True)
class Charted:
    """A shell in the frame of all: charts (2,) of places (3,), and the other way round.

    `half` is half the thickness at its own places (n, 3), over the length of all; None where it is
    the same everywhere.
    """

    outline: Outline
    place: Callable[[Array], Array]
    own: Callable[[Array], Array]
    half: Callable[[Array], Array] | None = None

    def chart(self, x: Array) -> Array:
        """That of a place."""
        return self.outline.inverse(self.own(x))

    def at(self, chart: Array) -> Array:
        """The place of a chart, or of the nearest one that the shell has."""
        return self.place(self.outline.embedding(self.outline.clip_to_chart(chart)[None])[0])

    def depth(self, x: Array) -> float:
        """How far a place is below the face, less what it is everywhere."""
        return float(self.half(self.own(x)[None])[0]) if self.half else 0.0


def _nearest(x: Array, y: Array, of_x: Charted, of_y: Charted) -> tuple[Array, Array]:
    """The places of two surfaces, near x and y, whose faces are nearest to each other."""

    def apart(charts: Array) -> Array:
        return of_x.at(charts[:2]) - of_y.at(charts[2:])

    def gap(charts: Array) -> float:
        ends = of_x.at(charts[:2]), of_y.at(charts[2:])
        return float(np.linalg.norm(ends[0] - ends[1])) - of_x.depth(ends[0]) - of_y.depth(ends[1])

    start = np.concatenate([of_x.chart(x), of_y.chart(y)])
    if of_x.half or of_y.half:
        found = scipy.optimize.minimize(gap, start).x
    else:
        found = scipy.optimize.least_squares(apart, start, ftol=EXACT, xtol=EXACT, gtol=EXACT).x
    return of_x.at(found[:2]), of_y.at(found[2:])
