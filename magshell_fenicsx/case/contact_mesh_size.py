"""Mesh sizes at contact: elements are smaller where shells that may touch are nearest.

Distances are between the undeformed shells.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import DiscFeature, Feature
from magshell_fenicsx.parts.contact.contact_section import WHOLE_SHELL
from magshell_fenicsx.parts.step_course import SizingContext
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
CONTACT_CELL_SIZE = 0.5  # over sqrt(R h), where shells come into contact
CONTACT_REGION = 1.0  # over sqrt(R h): radius of the region with such cells
ONE_PLACE_DISTANCE = 2.0  # over sqrt(R h): places no farther from each other are one
GAP_TOLERANCE = 0.5  # over the thickness: places with so much larger a gap may meet as well
MAX_GAP = 20.0  # thicknesses: shells that are farther apart may meet anywhere, or nowhere
SEARCH_TOLERANCE = 1e-12  # change of the square of the distance at which a search ends
FACE_CANDIDATES = 50  # places of a mid-surface among which that of the nearest face is


@dataclass(frozen=True)
class ContactPlace:
    """Place in the chart where another shell is nearest."""

    place: Array

    def features(self, outline: Outline, sizing: SizingContext, growth: float) -> list[Feature]:
        """Return the element sizes that resolve the ring of a contact."""
        x, y = map(float, self.place)
        length = sqrt(sizing.h)
        size = CONTACT_CELL_SIZE * length / sizing.refinement
        return [DiscFeature((x, y), CONTACT_REGION * length, size, growth)]


def contact_places(
    pairs: Sequence[Sequence[str]],
    places: Mapping[str, Array],
    thickness: Mapping[str, Array | float],
    one_place_distance: Mapping[str, float],
    charted: "Mapping[str, ChartedShell]",
) -> dict[str, list[Array]]:
    """Return places (3,) where other shells are nearest, by name of a shell.

    There are places only where the nearest places are one place and no area.

    Parameters
    ----------
    pairs
        Names of shells that may come into contact, or `shell` and itself for all.
    places
        Name -> places (n, 3) all over the shell.
    thickness, one_place_distance
        Name -> its thickness, at all places or everywhere, and up to which distance places are one;
        of all in the same length.
    charted
        Name -> its chart; without one its places are those that are given.
    """
    names = list(places)
    all_pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    places_of_contact: dict[str, list[Array]] = {name: [] for name in names}
    half_thickness = {
        name: np.broadcast_to(np.asarray(thickness[name]) / 2, len(places[name])) for name in names
    }
    are_all = [WHOLE_SHELL, WHOLE_SHELL] in [[*pair] for pair in pairs]
    for a, b in all_pairs if are_all else pairs:
        if a == b or a not in places or b not in places:
            continue
        gaps_between = {
            first: _gaps(
                places[first], places[second], half_thickness[first], half_thickness[second]
            )
            for first, second in ((a, b), (b, a))
        }
        gaps, number = gaps_between[a]
        nearest = int(np.argmin(gaps))
        ends, with_one_place = {a: places[a][nearest], b: places[b][number[nearest]]}, list[str]()
        h = {name: 2 * float(half_thickness[name].mean()) for name in (a, b)}
        for name in (a, b):
            similar = places[name][gaps_between[name][0] < gaps.min() + GAP_TOLERANCE * h[name]]
            if np.linalg.norm(similar - ends[name], axis=1).max() < one_place_distance[name]:
                with_one_place.append(name)
        if with_one_place and a in charted and b in charted:
            ends = dict(
                zip((a, b), _nearest(ends[a], ends[b], charted[a], charted[b]), strict=True)
            )
        for name in with_one_place:
            if np.linalg.norm(ends[a] - ends[b]) < MAX_GAP * h[name]:
                places_of_contact[name].append(ends[name])
    return places_of_contact


def _gaps(x: Array, y: Array, half_x: Array, half_y: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the gaps between faces of places x (n, 3) and the nearest faces of places y (m, 3).

    The second result has the numbers of the latter; `half_x`, `half_y` are half the thicknesses.
    """
    distances, candidates = scipy.spatial.KDTree(y).query(
        x, k=range(1, 1 + min(FACE_CANDIDATES if np.ptp(half_y) else 1, len(y)))
    )
    gaps = distances - half_y[candidates] - half_x[:, None]
    nearest = np.arange(len(x)), gaps.argmin(axis=1)
    return gaps[nearest], candidates[nearest]


@dataclass(frozen=True)
class ChartedShell:
    """A shell in the frame of all, with the map between charts (2,) and places (3,).

    Attributes
    ----------
    outline
        Its outline, in its own frame.
    place, to_own_frame
        Maps from its own frame to that of all, and back.
    half
        Half the thickness at its own places (n, 3), over the length of all; None where it is the
        same everywhere.
    """

    outline: Outline
    place: Callable[[Array], Array]
    to_own_frame: Callable[[Array], Array]
    half: Callable[[Array], Array] | None = None

    def chart(self, x: Array) -> Array:
        """Return the chart of a place."""
        return self.outline.inverse(self.to_own_frame(x))

    def place_of(self, chart: Array) -> Array:
        """Return the place of a chart, or of the nearest one that the shell has."""
        return self.place(self.outline.embedding(self.outline.clip_to_chart(chart)[None])[0])

    def depth(self, x: Array) -> float:
        """Return the depth of a place below the face, less the uniform one."""
        return float(self.half(self.to_own_frame(x)[None])[0]) if self.half else 0.0


def _nearest(x: Array, y: Array, of_x: ChartedShell, of_y: ChartedShell) -> tuple[Array, Array]:
    """Return the places of two surfaces, near x and y, whose faces are nearest to each other."""

    def difference(charts: Array) -> Array:
        return of_x.place_of(charts[:2]) - of_y.place_of(charts[2:])

    def gap(charts: Array) -> float:
        ends = of_x.place_of(charts[:2]), of_y.place_of(charts[2:])
        return float(np.linalg.norm(ends[0] - ends[1])) - of_x.depth(ends[0]) - of_y.depth(ends[1])

    start = np.concatenate([of_x.chart(x), of_y.chart(y)])
    if of_x.half or of_y.half:
        charts = scipy.optimize.minimize(gap, start).x
    else:
        tolerances = dict.fromkeys(("ftol", "xtol", "gtol"), SEARCH_TOLERANCE)
        charts = scipy.optimize.least_squares(difference, start, **tolerances).x
    return of_x.place_of(charts[:2]), of_y.place_of(charts[2:])
