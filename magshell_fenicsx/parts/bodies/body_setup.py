"""The rigid bodies of a case in the model's terms: where they are, how stiff the penalty is, and
the symmetry that they preserve.

The approach is the displacement of a body along its direction, a load parameter; a driven amplitude
is a load parameter that a step changes. The chart has the coordinates of the shell's mid-surface;
the reference is the undeformed shell, perfect or with its imperfections. Q turns the case's frame
into the model's. Under a plane the contact is a ring, the rim of a flat disc. Lengths are over R,
approaches over h, stiffnesses over E h/R^2; D is the bending stiffness.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from math import atan2, inf, sqrt

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grading import DiscFeature, Feature
from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.parts.bodies.body import BodySection, place_body
from magshell_fenicsx.parts.bodies.body_contact import ContactBody
from magshell_fenicsx.parts.bodies.contact_step import ContactSection
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.parts.step_course import SizingContext
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.reference_shell import ReferenceShell, locate
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

Array = NDArray[np.float64]
DEFAULT_APPROACH = 10.0  # of a body without a target, over h
RING_SIZE = 0.35  # of elements that show the ring of a contact, over sqrt(Rh)
DEFAULT_STIFFNESS = 1e6  # over D/(R h)^2: plate and ball then penetrate less than 1e-3 h
# stiffness of a body that touches in a spot over the default, times 1 + R/its radius
POINTED_STIFFNESS_FACTOR = 15.0
PENETRATION_TOLERANCE = 1e-6  # over h: an undeformed penetration below that is rounding
SEARCH_ROUNDS = 6  # of a search for a minimum
RANGE_REDUCTION = 0.2  # of the range of a search in each round
HALF_SEARCH_EXTENT = 1.5  # half the side, over R, of the cube in which bodies may overlap
SYMMETRY_TOLERANCE = 1e-10  # of distances and directions of images


def contact_bodies(
    bodies: Mapping[str, BodySection],
    approaches: Mapping[str, str],
    driven_amplitudes: Collection[str],
    reference: ReferenceShell,
    shells: Collection[str] = (),
) -> tuple[ContactBody, ...]:
    """Return the rigid bodies of a case as a model needs them.

    Parameters
    ----------
    bodies
        Name of each body -> its section of the case.
    approaches
        Name of each body -> name of the load parameter that is its approach.
    driven_amplitudes
        Load parameters that the steps of the case drive.
    reference
        The undeformed shell.
    shells
        Names of the shells, where there are several.

    Raises
    ------
    CaseError
        If a body penetrates the undeformed shell, or a body that moves overlaps another.
    """
    contacts = [
        replace(_contact(name, body, approaches[name], reference), shells=(*shells,))
        for name, body in bodies.items()
    ]
    for i, body in enumerate(contacts):
        for other in contacts[i + 1 :]:
            # bodies that stay may overlap
            if not {body.amplitude, other.amplitude} & {*driven_amplitudes}:
                continue
            if (depth := overlap(body, other)) > 0:
                raise CaseError(
                    f"bodies.{other.body}.position: overlaps bodies.{body.body} by {depth:.3g} R "
                    "at approach 0; bodies that move must be apart"
                )
    return tuple(contacts)


def _contact(
    name: str, section: BodySection, approach: str, reference: ReferenceShell
) -> ContactBody:
    """Return one rigid body of a case at its place, with the stiffness of its penalty.

    By default the body touches the shell at the section's `at`, with the shell's normal there as
    its direction. The default stiffness is larger for a body of finite radius than for a plane.

    Parameters
    ----------
    name, section
        Name of the body, and its section of the case.
    approach
        Name of the load parameter that is its approach.

    Raises
    ------
    CaseError
        If the body penetrates the undeformed shell at approach zero.
    """
    key, h, Q = f"bodies.{name}", reference.h, reference.Q
    place = _place_on_shell(section, reference, key)
    chart = reference.perfect.inverse(place)
    # the start: where the body touches, on the imperfect shell, with the normal of the perfect one.
    # The chart of a mesh file is the place itself (3,): it has no map from a chart to the surface
    normal = reference.perfect.normal_near(chart)
    start = place if len(chart) == 3 else reference.imperfect.embedding(chart[None])[0]
    half_thickness = float(reference.half_thickness(start[None])[0])
    placed_body = place_body(
        section, key, start, normal / np.linalg.norm(normal), half_thickness, Q, reference.R
    )
    # the default stiffness is a number times D/(R h)^2; here D is over E h R^2, the radius over R
    D, body_radius = h**2 / (12 * (1 - reference.nu**2)), section.blunt_radius / placed_body.R
    stiffness = section.stiffness or DEFAULT_STIFFNESS * D / h**2 * _stiffness_ratio(body_radius)
    starts_at_shell = section.position is None
    contact = ContactBody(
        body=name,
        amplitude=approach,
        distance=section.distance(placed_body),
        direction=placed_body.direction,
        front=placed_body.front,
        stiffness=stiffness,
        max_penetration=section.penetration,
        size=body_radius,
        has_given_stiffness=section.stiffness is not None,
        front_offset=section.front_offset / placed_body.R,
        start=Q @ start if starts_at_shell else None,
        lift=placed_body.front - Q @ start if starts_at_shell else None,
    )
    _refuse_penetration(contact, reference, key)
    return contact


def _place_on_shell(section: BodySection, reference: ReferenceShell, key: str) -> Array:
    """Return the place (3,) over R of the perfect shell that stands for the section's `at`.

    It is `at`, or its default, unless the body has a `position` and no `at`. Then it is the place
    of the shell that is nearest to the position, if the normal at the default of `at` is not needed
    since the direction is given, or if the shell has no such default.

    Parameters
    ----------
    key
        Key of the body in the case file, for messages.
    """
    has_own_place = section.position is not None and "at" not in section.model_fields_set
    has_default_place = reference.spherical or reference.has_pole_or_tip
    if has_own_place and (section.direction is not None or not has_default_place):
        places = reference.perfect.sample()
        from_body = places - np.array(section.position) / reference.R
        return np.asarray(places[np.linalg.norm(from_body, axis=1).argmin()])
    place, _ = locate(section.at, reference, key)
    return place


def _refuse_penetration(contact: ContactBody, reference: ReferenceShell, key: str) -> None:
    """Refuse a body that penetrates the undeformed shell at approach zero.

    Raises
    ------
    CaseError
        With the key of the body, and the depth.
    """
    h, depth = reference.h, -least_gap(contact, reference)
    if depth > PENETRATION_TOLERANCE * h:
        position_key, hint = "position", "move it back"
        if contact.start is not None:  # the body has no position of its own
            position_key, hint = "at", "give a place `at` that it reaches first, or its `position`"
        raise CaseError(
            f"{key}.{position_key}: the body penetrates the undeformed shell by {depth / h:.4g} h "
            f"at approach 0; {hint}"
        )


def _stiffness_ratio(body_radius: float) -> float:
    """Return the default stiffness of a body with a radius (over R), over that of a plane."""
    return 1.0 if body_radius == inf else POINTED_STIFFNESS_FACTOR * (1 + 1 / body_radius)


@dataclass(frozen=True)
class ContactZone:
    """The zone in which a body presses, for the sizes of elements; lengths are over R.

    Attributes
    ----------
    place
        Middle of the zone in the shell's chart; of several shells first the place (3,).
    reach
        Radius of the zone.
    size
        Radius of the body's part that touches; infinite for a plane.
    ring_size
        Size of elements that show the ring of the contact, over sqrt(Rh).
    """

    place: Array
    reach: float
    size: float
    ring_size: float = RING_SIZE

    @classmethod
    def of_body(
        cls, contact: ContactBody, loads: Iterable[Step], reference: ReferenceShell
    ) -> "ContactZone":
        """Return the zone in which a body presses, up to the largest approach of the steps.

        For a plane its radius is about that of a ring, sqrt(2 R a) at an approach a, with margins.
        For other bodies it is at most their radius and a margin. Without a target of the approach
        `DEFAULT_APPROACH` is assumed.

        Parameters
        ----------
        contact
            The body.
        loads
            The steps of the case, of which those of `kind: contact` have a target of the approach.
        reference
            The undeformed shell.
        """
        approach = largest_approach(loads) or DEFAULT_APPROACH
        place = reference.imperfect.inverse(contact.front)
        return cls.at_place(place, contact.size, reference.h, approach)

    @classmethod
    def at_place(
        cls, place: Array, size: float, h: float, approach: float = DEFAULT_APPROACH
    ) -> "ContactZone":
        """Return the zone around a place in which a body presses; the approach is over h."""
        ring_radius = 1.1 * sqrt(2 * approach * h)
        return cls(place, min(ring_radius + 0.5 * sqrt(h), size + sqrt(h)), size)

    def features(self, outline: Outline, sizing: SizingContext, growth: float) -> list[Feature]:
        """Return the discs of small elements that resolve the ring of the contact and a small body.

        Parameters
        ----------
        outline
            Not used here.
        sizing
            Thickness h over R, and the refinement, which divides sizes of elements.
        growth
            Growth of the element size with the distance from the disc.
        """
        x, y = map(float, self.place)
        ring_width, body_radius = sqrt(sizing.h), self.size
        # sizes of elements: those that resolve the ring, and those that resolve the body
        ring_size = self.ring_size * ring_width / sizing.refinement
        features: list[Feature] = [
            DiscFeature((x, y), radius=self.reach, size=ring_size, growth=growth)
        ]
        if body_radius < ring_width:
            # three elements per radius, but no finer than h/10; the numbers are rules of thumb
            body_size = max(body_radius / 3, 0.1 * sizing.h)
            features.append(
                DiscFeature((x, y), radius=1.5 * body_radius, size=body_size, growth=0.4)
            )
        return features


def largest_approach(loads: Iterable[Step]) -> float:
    """Return the largest approach, over h, among the targets of contact steps.

    It is 0 if no step has such a target.
    """
    return max(
        (abs(load.approach or 0.0) for load in loads if isinstance(load, ContactSection)),
        default=0.0,
    )


def body_symmetry(contact: ContactBody) -> SymmetryConstraint:
    """Return the symmetry constraint of a rigid body: the mirrors and turns that preserve it.

    The signed distances at random places and at their images are compared.
    """
    random_places, direction = np.random.default_rng(17).uniform(-2, 2, (40, 3)), contact.direction
    distances, *_ = contact.distance(random_places)  # without gradients and Hessians

    def is_image(S: Array, image: Array) -> bool:
        """Return whether a map S preserves the direction, and distances at the places' images."""
        keeps_direction = np.abs(S @ direction - direction).max() < SYMMETRY_TOLERANCE
        distances_at_image, *_ = contact.distance(image)
        change = np.abs(distances_at_image - distances).max()
        tolerance = SYMMETRY_TOLERANCE * (1 + np.abs(distances).max())
        return bool(keeps_direction and change < tolerance)

    # whether all turns about e3 preserve the body: two stand for all, since no turn by a fraction
    # of a circle has these angles (rad)
    is_turned = all(is_image(Q, random_places @ Q.T) for Q in (rotation(1.0), rotation(2.5)))
    # vectors that a mirror plane of the body must contain
    vectors_in_plane = [contact.front, direction, *contact.distance.mirror_vectors]
    # azimuths of possible mirror planes: each goes through e3 and a vector, which must not be along
    # e3
    azimuths = tuple(
        atan2(v[1], v[0])
        for v in contact.distance.possible_mirror_vectors
        if np.hypot(*v[:2]) > SYMMETRY_TOLERANCE
    )

    def mirrors(mirror: Mirror) -> bool:
        """Return whether the reflection at a plane preserves the body."""
        return is_image(mirror.reflection, mirror.image(random_places))

    return SymmetryConstraint(
        not_axisymmetric=None if is_turned else f"bodies.{contact.body} is not turned about e3",
        vectors=vectors_in_plane,
        mirrors=mirrors,
        azimuths=azimuths,
    )


def least_gap(contact: ContactBody, reference: ReferenceShell) -> float:
    """Return the least gap over R between a body at approach zero and the undeformed shell's face.

    It is searched at samples of the shell, and refined where the shell has a chart.
    """
    outline = reference.imperfect

    def gap(x: Array) -> Array:
        """Return gaps (n,) at undeformed places x (n, 3) of the shell, in the case's frame."""
        half = reference.half_thickness(x)
        gaps, *_ = contact.gap(x @ reference.Q.T, approach=0.0, half=half)
        return gaps

    chart = outline.chart_samples()
    if chart is None:  # of a mesh file, where samples alone are compared
        return float(gap(outline.sample()).min())
    # the search goes on in a box around the best sample; half its side is a tenth of the chart
    reach = np.full(2, 0.1 * float(np.ptp(chart, axis=0).max()))

    def gap_on_chart(points: Array) -> Array:
        """Return gaps (n,) at points (n, 2) of the chart; points outside are moved to its edge."""
        return gap(outline.embedding(np.array([outline.clip_to_chart(p) for p in points])))

    values = gap(outline.embedding(chart))
    return _refined_minimum(gap_on_chart, chart[values.argmin()], float(values.min()), reach)


def overlap(body: ContactBody, other: ContactBody) -> float:
    """Return the depth over R by which two bodies overlap near the shell, at approach zero.

    It is negative if they are apart. At each place the larger of both signed distances is taken;
    the depth is minus its least value, since a place where both are negative is in both bodies.
    """

    def larger_distance(x: Array) -> Array:
        """Return the larger signed distance (n,) of both bodies at places x (n, 3)."""
        distance, *_ = body.distance(x)
        distance_from_other, *_ = other.distance(x)
        return np.maximum(distance, distance_from_other)

    # random places near the shell, and the points where bodies are most likely to meet
    x = np.concatenate(
        [
            np.random.default_rng(3).uniform(-HALF_SEARCH_EXTENT, HALF_SEARCH_EXTENT, (4000, 3)),
            [body.front, other.front],
        ]
    )
    values = larger_distance(x)
    return -_refined_minimum(
        larger_distance,
        best=x[values.argmin()],
        minimum=float(values.min()),
        reach=np.full(3, 0.5),
    )


def _refined_minimum(
    f: Callable[[Array], Array], best: Array, minimum: float, reach: Array
) -> float:
    """Return the minimum of a function near a place, by random search.

    Random places are tried in a box that shrinks around the best place.

    Parameters
    ----------
    f
        Returns values (n,) at places (n, dim).
    best, minimum
        (dim,) the place to begin at, and the value there.
    reach
        (dim,) half the sides of the first box.
    """
    rng = np.random.default_rng(5)  # a fixed seed: results are the same in each run
    for _ in range(SEARCH_ROUNDS):
        trial_places = best + reach * rng.uniform(-1, 1, (200, len(best)))
        values = f(trial_places)
        if values.min() < minimum:
            best, minimum = trial_places[values.argmin()], float(values.min())
        reach = RANGE_REDUCTION * reach
    return minimum
