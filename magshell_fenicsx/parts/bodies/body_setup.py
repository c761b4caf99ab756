"""The rigid bodies of a case in the model's terms: where they stand, how stiff they are, and what
they leave.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from math import atan2, inf, sqrt

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grading import DiscFeature, Feature
from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.parts.bodies.body import BodySection, place_body
from magshell_fenicsx.parts.bodies.body_contact import Contact
from magshell_fenicsx.parts.bodies.contact_step import ContactSection
from magshell_fenicsx.parts.step_course import SizingContext
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.ability import Account, Context
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.reference_shell import ReferenceShell, locate
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

Array = NDArray[np.float64]
RING = 0.35  # of sqrt(Rh): elements that show the ring of a contact
NATURAL = 1e6  # default stiffness over D/(R h)^2: plate and ball then penetrate less than 1e-3 h
POINTED = (
    15.0  # times as stiff is the penalty of a body that touches in a spot, times 1 + R/its radius
)
WITHIN = 1e-6  # penetration over h that is rounding
ROUNDS, FINER = 6, 0.2  # refinements of a search, and how much smaller its range is each time
AROUND = 1.5  # half the side, over R, of the cube in which bodies may overlap
ALIKE = 1e-10  # distances and directions of images: rounding


def contacts(
    bodies: Mapping[str, BodySection],
    approaches: Mapping[str, str],
    driven: Collection[str],
    ground: ReferenceShell,
) -> tuple[Contact, ...]:
    """What bodies bring to the model.

    Parameters
    ----------
    approaches
        Body -> name of its approach, the amplitude.
    driven
        The amplitudes that steps drive.

    Raises
    ------
    CaseError
        If a body penetrates the undeformed shell, or one that moves overlaps another.
    """
    standing = [_contact(name, body, approaches[name], ground) for name, body in bodies.items()]
    for i, one in enumerate(standing):
        for other in standing[i + 1 :]:
            if not {one.amplitude, other.amplitude} & {*driven}:
                continue
            if (depth := overlap(one, other)) > 0:
                raise CaseError(
                    f"bodies.{other.body}.position: overlaps bodies.{one.body} by {depth:.3g} R at approach 0; bodies "
                    "that move must be apart"
                )
    return tuple(standing)


def _contact(name: str, section: BodySection, approach: str, ground: ReferenceShell) -> Contact:
    key, h, Q = f"bodies.{name}", ground.h, ground.Q
    stands = section.position is not None and "at" not in section.model_fields_set
    if stands and (ground.geometry == "mesh" or section.direction is not None):
        places = ground.perfect.sample()
        place = places[
            np.linalg.norm(places - np.array(section.position) / ground.R, axis=1).argmin()
        ]
    else:
        place, _ = locate(section.at, ground, key)
    chart = ground.perfect.inverse(place)
    normal = ground.perfect.normal_near(chart)
    start = place if len(chart) == 3 else ground.imperfect.embedding(chart[None])[0]
    half = float(ground.half_thickness(start[None])[0])
    placed = place_body(section, key, start, normal / np.linalg.norm(normal), half, Q, ground.R)
    D, size = h**2 / (12 * (1 - ground.nu**2)), section.blunt / placed.R
    k = section.stiffness or NATURAL * D / h**2 * (1.0 if size == inf else POINTED * (1 + 1 / size))
    contact = Contact(
        name,
        approach,
        section.distance(placed),
        placed.direction,
        placed.front,
        k,
        section.penetration,
        size,
        section.stiffness is not None,
        *((Q @ start, placed.front - Q @ start) if section.position is None else ()),
    )
    depth = -least_gap(contact, ground)
    if depth > WITHIN * h:
        at, hint = "position", "move it back"
        if section.position is None:
            at, hint = "at", "give a place `at` that it reaches first, or its `position`"
        raise CaseError(
            f"{key}.{at}: the body penetrates the undeformed shell by {depth / h:.4g} h at approach 0; {hint}"
        )
    return contact


@dataclass(frozen=True)
class Pressed:
    """Where a body presses: its place in the chart, how far from there, and its size; over R."""

    place: Array
    reach: float
    size: float

    @classmethod
    def by(cls, contact: Contact, loads: Iterable[Step], ground: ReferenceShell) -> "Pressed":
        """Up to the largest approach of steps: a plane in a ring up to sqrt(2 R a), others on their
        front.
        """
        h, size = ground.h, contact.size
        reach = min(1.1 * sqrt(2 * (pressed(loads) or 10.0) * h) + 0.5 * sqrt(h), size + sqrt(h))
        return cls(ground.imperfect.inverse(contact.front), reach, size)

    def features(self, outline: Outline, sizing: SizingContext, growth: float) -> list[Feature]:
        """Elements that show the ring of a contact, and a small body."""
        x, y = map(float, self.place)
        finer, size = sqrt(sizing.h), self.size
        small = (
            [DiscFeature((x, y), 1.5 * size, max(size / 3, 0.1 * sizing.h), 0.4)]
            if size < finer
            else []
        )
        return [DiscFeature((x, y), self.reach, RING * finer / sizing.refinement, growth), *small]


def pressed(loads: Iterable[Step]) -> float:
    """The largest approach over h that a target of steps asks for; 0 without."""
    return max(
        (abs(load.approach or 0.0) for load in loads if isinstance(load, ContactSection)),
        default=0.0,
    )


def body_leaves(contact: Contact) -> SymmetryConstraint:
    """The symmetry that a body leaves, found at random places."""
    x = np.random.default_rng(17).uniform(-2, 2, (40, 3))
    g, d = contact.distance(x)[0], contact.direction

    def alike(S: Array, image: Array) -> bool:
        other = contact.distance(image)[0]
        return bool(
            np.abs(S @ d - d).max() < ALIKE
            and np.abs(other - g).max() < ALIKE * (1 + np.abs(g).max())
        )

    turns = all(alike(Q, x @ Q.T) for Q in (rotation(1.0), rotation(2.5)))
    tilted = [contact.front, d, *contact.distance.held]
    between = tuple(atan2(v[1], v[0]) for v in contact.distance.across if np.hypot(*v[:2]) > ALIKE)

    def mirrors(mirror: Mirror) -> bool:
        return alike(mirror.reflection, mirror.image(x))

    return SymmetryConstraint(
        None if turns else f"bodies.{contact.body} is not turned about e3",
        tilted,
        mirrors,
        azimuths=between,
    )


def least_gap(contact: Contact, ground: ReferenceShell) -> float:
    """The least gap over R between a body and the face of the undeformed shell."""
    drawn = ground.imperfect

    def gap(x: Array) -> Array:
        return contact.gap(x @ ground.Q.T, 0.0, ground.half_thickness(x))[0]

    chart = drawn.chart_samples()
    if chart is None:
        return float(gap(drawn.sample()).min())
    reach = np.full(2, 0.1 * float(np.ptp(chart, axis=0).max()))

    def on_chart(x: Array) -> Array:
        return gap(drawn.embedding(np.array([drawn.clip_to_chart(p) for p in x])))

    values = gap(drawn.embedding(chart))
    return _refined(on_chart, chart[values.argmin()], float(values.min()), reach)


def overlap(one: Contact, other: Contact) -> float:
    """How deep two bodies overlap near the shell at approach zero, over R; negative if they are
    apart.
    """

    def farther(x: Array) -> Array:
        return np.maximum(one.distance(x)[0], other.distance(x)[0])

    x = np.concatenate(
        [np.random.default_rng(3).uniform(-AROUND, AROUND, (4000, 3)), [one.front, other.front]]
    )
    values = farther(x)
    return -_refined(farther, x[values.argmin()], float(values.min()), np.full(3, 0.5))


def _refined(f: Callable[[Array], Array], best: Array, least: float, reach: Array) -> float:
    """The minimum near a place, by random places in a box that shrinks around the best one."""
    rng = np.random.default_rng(5)
    for _ in range(ROUNDS):
        x = best + reach * rng.uniform(-1, 1, (200, len(best)))
        values = f(x)
        if values.min() < least:
            best, least = x[values.argmin()], float(values.min())
        reach = FINER * reach
    return least


def account(context: Context, loads: Loads) -> Account:
    """What presses, and how stiff it is."""
    bodies, with_units = context.sections["bodies"], context.shell.with_units
    words = [
        f"body {contact.body}: {bodies[contact.body].words(with_units=with_units)} without friction, "
        f"stiffness k R²/(E h) = {contact.stiffness:.4g}"
        for contact in loads.contacts
    ]
    return Account(words)
