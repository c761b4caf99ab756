"""The rigid bodies of a case in the model's terms: where they are, how stiff the penalty is, and
the symmetry that they preserve.

The approach is the displacement of a body along its direction, a load parameter; a driven amplitude
is a load parameter that a step changes. The chart has the coordinates of the shell's mid-surface;
the reference is the undeformed shell, perfect or with its imperfections. Q turns the case's frame
into the model's. Under a plane the contact is a ring, the rim of a flat disc. Lengths are over R,
approaches over h, stiffnesses over E h/R^2; D is the bending stiffness.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from math import atan2, inf, sqrt

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grading import DiscFeature, Feature
from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.parts.ability import Account, Context
from magshell_fenicsx.parts.bodies.body import BodySection, place_body
from magshell_fenicsx.parts.bodies.body_contact import ContactBody
from magshell_fenicsx.parts.bodies.contact_step import ContactSection
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.parts.step_course import SizingContext
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.reference_shell import ReferenceShell, locate
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

Array = NDArray[np.float64]
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

    Raises
    ------
    CaseError
        If a body penetrates the undeformed shell, or a body that moves overlaps another.
    """
    contacts = [_contact(name, body, approaches[name], reference) for name, body in bodies.items()]
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
    its direction. A body with a `position` and no `at` has the default of `at`. But where that
    normal is not needed, as the direction is given, the nearest place of the shell stands for `at`;
    so it does on a mesh. The default stiffness is larger for a body of finite radius than for a
    plane.

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
    has_own_place = section.position is not None and "at" not in section.model_fields_set
    # the nearest sample, unless the normal at the default `at` is to give the direction
    if has_own_place and (reference.geometry == "mesh" or section.direction is not None):
        places = reference.perfect.sample()
        from_body = places - np.array(section.position) / reference.R
        place = places[np.linalg.norm(from_body, axis=1).argmin()]
    else:
        place, _ = locate(section.at, reference, key)
    chart = reference.perfect.inverse(place)
    # where the body touches: on the imperfect shell, with the normal of the perfect one. The chart
    # of a mesh file is the place itself (3,): there is no map from a chart to the surface
    normal = reference.perfect.normal_near(chart)
    start = place if len(chart) == 3 else reference.imperfect.embedding(chart[None])[0]
    half_thickness = float(reference.half_thickness(start[None])[0])
    placed_body = place_body(
        section, key, start, normal / np.linalg.norm(normal), half_thickness, Q, reference.R
    )
    # the default stiffness is a number times D/(R h)^2; D is over E h R^2, the radius over R
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
        start=Q @ start if starts_at_shell else None,
        lift=placed_body.front - Q @ start if starts_at_shell else None,
    )
    depth = -least_gap(contact, reference)
    if depth > PENETRATION_TOLERANCE * h:
        position_key, hint = "position", "move it back"
        if starts_at_shell:
            position_key, hint = "at", "give a place `at` that it reaches first, or its `position`"
        raise CaseError(
            f"{key}.{position_key}: the body penetrates the undeformed shell by {depth / h:.4g} h "
            f"at approach 0; {hint}"
        )
    return contact


def _stiffness_ratio(body_radius: float) -> float:
    """Return the default stiffness of a body with a radius (over R), over that of a plane."""
    return 1.0 if body_radius == inf else POINTED_STIFFNESS_FACTOR * (1 + 1 / body_radius)


@dataclass(frozen=True)
class ContactZone:
    """The zone in which a body presses, for the sizes of elements; lengths are over R.

    Attributes
    ----------
    place
        Middle of the zone in the shell's chart.
    reach
        Radius of the zone.
    size
        Radius of the body's part that touches; infinite for a plane.
    """

    place: Array
    reach: float
    size: float

    @classmethod
    def of_body(
        cls, contact: ContactBody, loads: Iterable[Step], reference: ReferenceShell
    ) -> "ContactZone":
        """Return the zone in which a body presses, up to the largest approach of the steps.

        For a plane its radius is about that of a ring, sqrt(2 R a) at an approach a, with margins.
        For other bodies it is at most their radius and a margin. Without a target of the approach,
        ten thicknesses are assumed.
        """
        h, size = reference.h, contact.size
        approach = largest_approach(loads) or 10.0
        ring_radius = 1.1 * sqrt(2 * approach * h)
        reach = min(ring_radius + 0.5 * sqrt(h), size + sqrt(h))
        return cls(reference.imperfect.inverse(contact.front), reach, size)

    def features(self, outline: Outline, sizing: SizingContext, growth: float) -> list[Feature]:
        """Return the discs of small elements that resolve the ring of the contact and a small body.

        Parameters
        ----------
        growth
            Growth of the element size with the distance from the disc.
        """
        x, y = map(float, self.place)
        ring_width, size = sqrt(sizing.h), self.size
        # here `size` is the radius of the body, in a feature the size of elements
        ring_elements = RING_SIZE * ring_width / sizing.refinement
        features: list[Feature] = [
            DiscFeature((x, y), radius=self.reach, size=ring_elements, growth=growth)
        ]
        if size < ring_width:
            # three elements per radius, but no finer than h/10; the numbers are rules of thumb
            body_elements = max(size / 3, 0.1 * sizing.h)
            features.append(DiscFeature((x, y), radius=1.5 * size, size=body_elements, growth=0.4))
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
    random_places = np.random.default_rng(17).uniform(-2, 2, (40, 3))
    distances, direction = contact.distance(random_places)[0], contact.direction

    def is_image(S: Array, image: Array) -> bool:
        """Return whether a map S preserves the direction, and distances at the places' images."""
        keeps_direction = np.abs(S @ direction - direction).max() < SYMMETRY_TOLERANCE
        change = np.abs(contact.distance(image)[0] - distances).max()
        tolerance = SYMMETRY_TOLERANCE * (1 + np.abs(distances).max())
        return bool(keeps_direction and change < tolerance)

    # two turns by angles (rad) that no symmetry of finite order has
    is_turned = all(is_image(Q, random_places @ Q.T) for Q in (rotation(1.0), rotation(2.5)))
    # vectors that a mirror plane of the body must contain
    held_vectors = [contact.front, direction, *contact.distance.mirror_vectors]
    # azimuths of possible mirror planes: each goes through e3 and a vector, which must not be along
    # e3
    azimuths = tuple(
        atan2(v[1], v[0])
        for v in contact.distance.possible_mirror_vectors
        if np.hypot(*v[:2]) > SYMMETRY_TOLERANCE
    )

    def mirrors(mirror: Mirror) -> bool:
        return is_image(mirror.reflection, mirror.image(random_places))

    return SymmetryConstraint(
        None if is_turned else f"bodies.{contact.body} is not turned about e3",
        held_vectors,
        mirrors,
        azimuths=azimuths,
    )


def least_gap(contact: ContactBody, reference: ReferenceShell) -> float:
    """Return the least gap over R between a body at approach zero and the undeformed shell's face.

    It is searched at samples of the shell, and refined where the shell has a chart.
    """
    outline = reference.imperfect

    def gap(x: Array) -> Array:
        half = reference.half_thickness(x)
        gaps, *_ = contact.gap(x @ reference.Q.T, approach=0.0, half=half)
        return gaps

    chart = outline.chart_samples()
    if chart is None:  # of a mesh file, where samples alone are compared
        return float(gap(outline.sample()).min())
    # the search goes on in a box around the best sample; half its side is a tenth of the chart
    reach = np.full(2, 0.1 * float(np.ptp(chart, axis=0).max()))

    def on_chart(x: Array) -> Array:
        return gap(outline.embedding(np.array([outline.clip_to_chart(p) for p in x])))

    values = gap(outline.embedding(chart))
    return _refined_minimum(on_chart, chart[values.argmin()], float(values.min()), reach)


def overlap(body: ContactBody, other: ContactBody) -> float:
    """Return the depth over R by which two bodies overlap near the shell, at approach zero.

    It is negative if they are apart. At each place the larger of both signed distances is taken;
    the depth is minus its least value, since a place where both are negative is in both bodies.
    """

    def larger_distance(x: Array) -> Array:
        return np.maximum(body.distance(x)[0], other.distance(x)[0])

    # random places near the shell, and the points where bodies are most likely to meet
    x = np.concatenate(
        [
            np.random.default_rng(3).uniform(-HALF_SEARCH_EXTENT, HALF_SEARCH_EXTENT, (4000, 3)),
            [body.front, other.front],
        ]
    )
    values = larger_distance(x)
    return -_refined_minimum(
        larger_distance, x[values.argmin()], float(values.min()), np.full(3, 0.5)
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


def account(context: Context, loads: Loads) -> Account:
    """Return the lines of `magshell check` on the bodies and the stiffness of their penalties."""
    bodies, with_units = context.sections["bodies"], context.shell.with_units
    lines = [
        f"body {contact.body}: {bodies[contact.body].words(with_units=with_units)} without "
        f"friction, stiffness k R²/(E h) = {contact.stiffness:.4g}"
        for contact in loads.contacts
    ]
    return Account(lines)
