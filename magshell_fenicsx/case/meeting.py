"""Where shells that may touch are nearest to each other undeformed: their elements are smaller there."""

from collections.abc import Mapping, Sequence
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
    """
    names = list(places)
    every = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    found: dict[str, list[Array]] = {name: [] for name in names}
    for a, b in every if [WHOLE, WHOLE] in [[*pair] for pair in pairs] else pairs:
        if a == b or a not in places or b not in places:
            continue
        for one, other in ((a, b), (b, a)):
            x = places[one]
            away = scipy.spatial.KDTree(places[other]).query(x)[0]
            nearest = x[np.argmin(away)]
            alike = x[away < away.min() + ALIKE * thickness[one]]
            if np.linalg.norm(alike - nearest, axis=1).max() < apart[one]:
                found[one].append(nearest)
    return found
