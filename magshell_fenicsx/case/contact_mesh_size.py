"""Mesh sizes at contact: elements are small where shells that may touch are nearest, and where
a rigid body is nearest to one of several shells.

Distances are those of the undeformed shells. A place (3,) is in space, a chart (2,) the pair of
coordinates of a place on its surface. The gap of two places is the distance of the faces there:
that of the mid-surfaces less half of both thicknesses. h and R are thickness and reference length.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from math import sqrt

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.mesh.grading import DiscFeature, Feature
from magshell_fenicsx.mesh.multi_shell import ShellPose
from magshell_fenicsx.parts.bodies.body import BodySection, place_body
from magshell_fenicsx.parts.bodies.body_setup import ContactZone
from magshell_fenicsx.parts.contact.contact_section import WHOLE_SHELL
from magshell_fenicsx.parts.step_course import SizingContext
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.reference_shell import ReferenceShell

Array = NDArray[np.float64]
CONTACT_CELL_SIZE = 0.5  # over sqrt(R h), where shells come into contact
BODY_CELL_SIZE = 0.7  # over sqrt(R h), where a rigid body is near: it may be near a whole shell
CONTACT_REGION = 1.0  # over sqrt(R h): radius of the region with such cells
ONE_PLACE_DISTANCE = 2.0  # over sqrt(R h): places no farther from each other are one
GAP_TOLERANCE = 0.5  # over the thickness: places with so much larger a gap may meet as well
MAX_GAP = 20.0  # thicknesses: shells that are farther apart may meet anywhere, or nowhere
SEARCH_TOLERANCE = 1e-12  # change of the square of the distance at which a search ends
FACE_CANDIDATES = 50  # places of a mid-surface among which that of the nearest face is


@dataclass(frozen=True)
class ContactPlace:
    """Place (2,) in the chart where another shell is nearest and elements must be small.

    Before the shell has its chart it is the place (3,) in space.
    """

    place: Array

    def features(self, outline: Outline, sizing: SizingContext, growth: float) -> list[Feature]:
        """Return the element sizes that resolve the ring of a contact around the place.

        `growth` is the increase of the element size per distance from it.
        """
        x, y = map(float, self.place)
        length = sqrt(sizing.h)  # sqrt(R h) over R, the width of a boundary layer
        size = CONTACT_CELL_SIZE * length / sizing.refinement
        return [DiscFeature((x, y), CONTACT_REGION * length, size, growth)]


def contact_places(
    pairs: Sequence[Sequence[str]],
    places: Mapping[str, Array],
    thickness: Mapping[str, Array | float],
    one_place_distance: Mapping[str, float],
    charted: "Mapping[str, ChartedShell]",
) -> dict[str, list[Array]]:
    """Return the places where other shells are nearest and the mesh is to be refined.

    A shell gets a place only where its nearest places to another shell are close together. Where
    they are an extended area, the contact may begin anywhere, and no place is better than others.

    Parameters
    ----------
    pairs
        Names of shells that may touch; WHOLE_SHELL with itself stands for all pairs.
    places
        Name -> places (n, 3) all over the shell.
    thickness
        Name -> thickness at all places (n,), or everywhere.
    one_place_distance
        Name -> distance up to which places count as one. All lengths are in one unit.
    charted
        Name -> the shell with its chart, which makes its place exact; other shells have the given
        places alone.

    Returns
    -------
    Name of a shell -> places (3,).
    """
    names = list(places)
    all_pairs = [(a, b) for i, a in enumerate(names) for b in names[i + 1 :]]
    places_of_contact: dict[str, list[Array]] = {name: [] for name in names}
    half_thickness = {
        name: np.broadcast_to(np.asarray(thickness[name]) / 2, len(places[name])) for name in names
    }
    all_may_touch = [WHOLE_SHELL, WHOLE_SHELL] in [[*pair] for pair in pairs]
    for a, b in all_pairs if all_may_touch else pairs:
        if a == b or not {a, b} <= places.keys():
            continue
        # the gap at each place of one shell to the other, and the number of the nearest place there
        gaps_a, nearest_in_b = _gaps(places[a], places[b], half_thickness[a], half_thickness[b])
        gaps_b, _ = _gaps(places[b], places[a], half_thickness[b], half_thickness[a])
        # the pair of places with the least gap of all
        nearest = int(np.argmin(gaps_a))
        nearest_places = {a: places[a][nearest], b: places[b][nearest_in_b[nearest]]}
        mean_thickness = {name: 2 * float(half_thickness[name].mean()) for name in (a, b)}
        # shells of which all places with nearly the least gap are close together
        with_one_place = []
        for name, gaps in ((a, gaps_a), (b, gaps_b)):
            similar = places[name][gaps < gaps_a.min() + GAP_TOLERANCE * mean_thickness[name]]
            if _extent(similar, nearest_places[name]) < one_place_distance[name]:
                with_one_place.append(name)
        # the two places were samples; charts of both shells make them exact
        if with_one_place and {a, b} <= charted.keys():
            exact_a, exact_b = _nearest(
                nearest_places[a], nearest_places[b], charted[a], charted[b]
            )
            nearest_places = {a: exact_a, b: exact_b}
        distance = np.linalg.norm(nearest_places[a] - nearest_places[b])
        for name in with_one_place:
            if distance < MAX_GAP * mean_thickness[name]:
                places_of_contact[name].append(nearest_places[name])
    return places_of_contact


def body_zones(
    bodies: Mapping[str, BodySection], reference: ReferenceShell, pose: ShellPose, R: float
) -> list[ContactZone]:
    """Return the zones of one of several shells in which rigid bodies press on it.

    A body has a zone around the places where it is nearest, under the same conditions as another
    shell. Bodies without a position, which begin on a shell, have none. Zones are in the shell's
    own frame and over its own length.

    Parameters
    ----------
    bodies
        Name -> section.
    reference, pose
        The undeformed shell, and its place among all shells.
    R
        Reference length of all shells, in the unit of the sections.
    """
    h, places, zones = reference.h, reference.perfect.sample(), list[ContactZone]()
    for name, section in bodies.items():
        if section.position is None:
            continue
        in_space, position = pose(places), np.array(section.position) / R
        nearest = in_space[np.linalg.norm(in_space - position, axis=1).argmin()]
        # the normal from which the direction follows, where the case gives none
        length = np.linalg.norm(position - nearest)
        normal = (position - nearest) / length if length else np.eye(3)[2]
        body = place_body(section, f"bodies.{name}", nearest, normal, 0.0, np.eye(3), R)
        distances, *_ = section.distance(body)(in_space)
        gaps = distances / pose.scale - reference.half_thickness(places)
        similar = places[gaps < gaps.min() + GAP_TOLERANCE * h]
        middle = similar.mean(axis=0)
        is_one_place = _extent(similar, middle) < ONE_PLACE_DISTANCE * sqrt(h)
        if is_one_place and gaps.min() < MAX_GAP * h:
            radius = section.blunt_radius / (R * pose.scale)
            zone = ContactZone.at_place(middle, radius, h)
            zones.append(replace(zone, ring_size=BODY_CELL_SIZE))
    return zones


def _extent(places: Array, centre: Array) -> float:
    """Return the largest distance of places (n, 3) from a place (3,)."""
    return float(np.linalg.norm(places - centre, axis=1).max())


def _gaps(x: Array, y: Array, half_x: Array, half_y: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the gaps between the faces of one shell and the nearest faces of another.

    Parameters
    ----------
    x, y
        Places (n, 3) and (m, 3) of the two mid-surfaces.
    half_x, half_y
        Half the thicknesses there.

    Returns
    -------
    gaps
        (n,) between the faces at x and the nearest faces.
    numbers
        (n,) of the places y with these nearest faces.
    """
    # where the thickness is uniform, the nearest mid-surface has the nearest face; else one of the
    # nearest mid-surfaces has it
    candidate_count = min(FACE_CANDIDATES if np.ptp(half_y) else 1, len(y))
    # (n, candidates): for each x the nearest places y, by their mid-surfaces
    distances, candidates = scipy.spatial.KDTree(y).query(x, k=range(1, 1 + candidate_count))
    gaps = distances - half_y[candidates] - half_x[:, None]
    least_in_row = np.arange(len(x)), gaps.argmin(axis=1)  # rows and columns of these entries
    return gaps[least_in_row], candidates[least_in_row]


@dataclass(frozen=True)
class ChartedShell:
    """A shell in a common frame, with the map between its charts (2,) and places (3,).

    Attributes
    ----------
    outline
        Outline of the shell, in its own frame.
    place, to_own_frame
        Maps of places from its own frame to the common frame, and back.
    half
        Function from its own places (n, 3) to half the thickness there, over the common length;
        None if the thickness is uniform.
    """

    outline: Outline
    place: Callable[[Array], Array]
    to_own_frame: Callable[[Array], Array]
    half: Callable[[Array], Array] | None = None

    def chart(self, x: Array) -> Array:
        """Return the chart (2,) of a place (3,) in the common frame."""
        return self.outline.inverse(self.to_own_frame(x))

    def place_of(self, chart: Array) -> Array:
        """Return the place (3,) of a chart (2,), or of the nearest chart that the shell has."""
        return self.place(self.outline.embedding(self.outline.clip_to_chart(chart)[None])[0])

    def depth(self, x: Array) -> float:
        """Return half the thickness at a place (3,) in the common frame; 0 if it is uniform.

        A uniform thickness changes no comparison of gaps.
        """
        return float(self.half(self.to_own_frame(x)[None])[0]) if self.half else 0.0


def _nearest(x: Array, y: Array, of_x: ChartedShell, of_y: ChartedShell) -> tuple[Array, Array]:
    """Return the places (3,) of two shells whose faces are nearest to each other, near x and y.

    Parameters
    ----------
    x, y
        Places (3,) in the common frame at which the search begins.
    of_x, of_y
        The shells of these places.
    """

    def difference(charts: Array) -> Array:
        """Return the vector (3,) between the places of two charts (4,)."""
        return of_x.place_of(charts[:2]) - of_y.place_of(charts[2:])

    def gap(charts: Array) -> float:
        """Return the gap between the faces at two charts (4,), up to uniform thicknesses."""
        place_x, place_y = of_x.place_of(charts[:2]), of_y.place_of(charts[2:])
        distance = float(np.linalg.norm(place_x - place_y))
        return distance - of_x.depth(place_x) - of_y.depth(place_y)

    # both charts are sought together, as one vector (4,)
    start = np.concatenate([of_x.chart(x), of_y.chart(y)])
    # where the thickness varies, the gap itself is made least; else the distance of the
    # mid-surfaces, which is a least-squares problem
    if of_x.half or of_y.half:
        charts = scipy.optimize.minimize(gap, start).x
    else:
        tolerances = dict.fromkeys(("ftol", "xtol", "gtol"), SEARCH_TOLERANCE)
        charts = scipy.optimize.least_squares(difference, start, **tolerances).x
    return of_x.place_of(charts[:2]), of_y.place_of(charts[2:])
