"""Where shells that may touch are nearest to each other undeformed: their elements are smaller there."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import Disc, Feature
from magshell_fenicsx.parts.course import Fit
from magshell_fenicsx.parts.touching.section import WHOLE
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
FINE = 0.5  # of sqrt(R h): cells where shells meet
AROUND, APART = 1.0, 2.0  # of sqrt(R h): how far from there, and how far from each other places are one
ALIKE = 0.5  # of the thickness: places that are so much farther from each other may meet as well
FAR = 20.0  # thicknesses: shells that are farther from each other may meet anywhere, or nowhere
EXACT = 1e-12  # change of the square of the distance at which a search ends


@dataclass(frozen=True)
class Meeting:
    """A place in the chart where another shell is nearest."""

    place: Array

    def features(self, outline: Outline, fit: Fit, growth: float) -> list[Feature]:
        """Elements that show the ring of a contact."""
        x, y = map(float, self.place)
        return [Disc((x, y), AROUND * sqrt(fit.h), FINE * sqrt(fit.h) / fit.refinement, growth)]


def meetings(
    pairs: Sequence[Sequence[str]],
    places: Mapping[str, Array],
    thickness: Mapping[str, float],
    apart: Mapping[str, float],
    charted: "Mapping[str, Charted]",
) -> dict[str, list[Array]]:
    """Name of a shell -> places (3,) where others that it may touch are nearest, if that is one place and no area.

    Parameters
    ----------
    pairs
        Names of shells that may touch, or `shell` and itself for all.
    places
        Name -> places (n, 3) all over it.
    thickness, apart
        Name -> its thickness, and how far from each other places are one; of all in the same length.
    charted
        Name -> its chart; without one its places are those that are given.
    """
    names = list(places)
    every = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    found: dict[str, list[Array]] = {name: [] for name in names}
    for a, b in every if [WHOLE, WHOLE] in [[*pair] for pair in pairs] else pairs:
        if a == b or a not in places or b not in places:
            continue
        away = {a: _away(places[a], places[b]), b: _away(places[b], places[a])}
        far, number = away[a]
        nearest = int(np.argmin(far))
        ends, alone = {a: places[a][nearest], b: places[b][number[nearest]]}, list[str]()
        for name in (a, b):
            alike = places[name][away[name][0] < far.min() + ALIKE * thickness[name]]
            if np.linalg.norm(alike - ends[name], axis=1).max() < apart[name]:
                alone.append(name)
        if alone and a in charted and b in charted:
            ends = dict(zip((a, b), _nearest(ends[a], ends[b], charted[a], charted[b]), strict=True))
        for name in alone:
            if np.linalg.norm(ends[a] - ends[b]) < FAR * thickness[name]:
                found[name].append(ends[name])
    return found


def _away(x: Array, y: Array) -> tuple[Array, NDArray[np.int64]]:
    """How far the nearest of the places y is from each x, and its number."""
    away, number = scipy.spatial.KDTree(y).query(x)
    return np.asarray(away), np.asarray(number)


@dataclass(frozen=True)
class Charted:
    """A shell in the frame of all: charts (2,) of places (3,), and the other way round."""

    outline: Outline
    place: Callable[[Array], Array]
    own: Callable[[Array], Array]

    def chart(self, x: Array) -> Array:
        """That of a place."""
        return self.outline.inverse(self.own(x))

    def at(self, chart: Array) -> Array:
        """The place of a chart, or of the nearest one that the shell has."""
        return self.place(self.outline.embedding(self.outline.within(chart)[None])[0])


def _nearest(x: Array, y: Array, of_x: Charted, of_y: Charted) -> tuple[Array, Array]:
    """The places of two surfaces, near x and y, that are nearest to each other."""

    def apart(charts: Array) -> Array:
        return of_x.at(charts[:2]) - of_y.at(charts[2:])

    start = np.concatenate([of_x.chart(x), of_y.chart(y)])
    found = scipy.optimize.least_squares(apart, start, ftol=EXACT, xtol=EXACT, gtol=EXACT).x
    return of_x.at(found[:2]), of_y.at(found[2:])
