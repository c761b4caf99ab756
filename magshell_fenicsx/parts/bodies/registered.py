"""The rigid bodies of a case in the model's terms, from the function of each kind."""

from collections.abc import Callable
from math import atan2, inf
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.expressions import formula
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.frame import rotation
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.parts.bodies.box import box
from magshell_fenicsx.parts.bodies.contact import Contact, Distance
from magshell_fenicsx.parts.bodies.cylinder import cylinder
from magshell_fenicsx.parts.bodies.placed import Placed, place_body
from magshell_fenicsx.parts.bodies.plane import plane
from magshell_fenicsx.parts.bodies.press import ContactSection
from magshell_fenicsx.parts.bodies.rod import rod
from magshell_fenicsx.parts.bodies.sphere import sphere
from magshell_fenicsx.parts.bodies.touching import least_gap, overlap
from magshell_fenicsx.parts.imperfections.distance import located
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.symmetry import Leaves

Array = NDArray[np.float64]
KINDS: dict[str, Callable[[Any, Placed], Distance]] = {
    "plane": plane,
    "sphere": sphere,
    "cylinder": cylinder,
    "rod": rod,
    "box": box,
}
NATURAL = 1e6  # default stiffness over D/(R h)^2: plate and ball then penetrate less than 1e-3 h
POINTED = 15.0  # times as stiff is the penalty of a body that touches in a spot, times 1 + R/its radius
WITHIN = 1e-6  # penetration over h that is rounding


def contacts(case: Case, perfect: Outline, drawn: Outline, turn: float) -> tuple[Contact, ...]:
    """What bodies bring to the model, in a frame turned about e3 (rad).

    Parameters
    ----------
    perfect, drawn
        The perfect shell and the one with imperfections, in the case's own frame.

    Raises
    ------
    CaseError
        If a body penetrates the undeformed shell, or one that moves overlaps another.
    """
    found = [_contact(case, perfect, drawn, turn, name) for name in case.bodies]
    for i, one in enumerate(found):
        for other in found[i + 1 :]:
            moved = [c.amplitude for c in (one, other) if c.amplitude in {step.name for step in case.programme}]
            if moved and (depth := overlap(one, other)) > 0:
                raise CaseError(
                    f"bodies.{other.body}.position: overlaps bodies.{one.body} by {depth:.3g} R at approach 0; bodies "
                    "that move must be apart"
                )
    return tuple(found)


def _contact(case: Case, perfect: Outline, drawn: Outline, turn: float, name: str) -> Contact:
    section, key, h = case.bodies[name], f"bodies.{name}", 1 / case.shell.R_over_h
    place, _ = located(case, perfect, section.at, key)
    chart = perfect.inverse(place)
    normal = place_normal(case, perfect, chart)
    Q = rotation(turn)
    here = place if len(chart) == 3 else drawn.embedding(chart[None])[0]
    factor = case.thickness_factor
    varies = formula(factor) if isinstance(factor, str) else None

    def half(x: Array) -> Array:
        return np.broadcast_to(h / 2 * (varies(*x.T) if varies else 1.0), len(x))

    placed = place_body(section, key, here, normal, float(half(here[None])[0]), Q, case.shell.reference)
    distance = KINDS[section.kind](section, placed)
    D, size = h**2 / (12 * (1 - case.shell.poisson_ratio**2)), section.blunt / placed.R
    k = section.stiffness or NATURAL * D / h**2 * (1.0 if size == inf else POINTED * (1 + 1 / size))
    found = Contact(
        name,
        case.approaches[name],
        distance,
        placed.direction,
        placed.front,
        k,
        section.penetration,
        size,
        section.stiffness is not None,
        *((Q @ here, placed.front - Q @ here) if section.position is None else ()),
    )
    depth = -least_gap(found, drawn, Q, half)
    if depth > WITHIN * h:
        raise CaseError(
            f"{key}.{'at' if section.position is None else 'position'}: the body penetrates the undeformed shell by "
            f"{depth / h:.4g} h at approach 0; "
            + (
                "give a place `at` that it reaches first, or its `position`"
                if section.position is None
                else "move it back"
            )
        )
    return found


def pressed(case: Case, body: str) -> float:
    """The largest approach over h that a target asks for; 0 without."""
    steps = (step.load for step in case.programme if step.name == case.approaches[body])
    return max((abs(load.approach or 0.0) for load in steps if isinstance(load, ContactSection)), default=0.0)


def place_normal(case: Case, perfect: Outline, chart: Array) -> Array:
    """The outward unit normal (3,) of the perfect surface; of a mesh file that at its nearest node."""
    n = perfect.normal(chart[None])[0]
    return np.asarray(n / np.linalg.norm(n))


def body_leaves(contact: Contact) -> Leaves:
    """The symmetry that a body leaves, found at random places."""
    x = np.random.default_rng(17).uniform(-2, 2, (40, 3))
    g, d, scale = contact.distance(x)[0], contact.direction, 1e-10

    def alike(S: Array, image: Array) -> bool:
        other = contact.distance(image)[0]
        return bool(np.abs(S @ d - d).max() < scale and np.abs(other - g).max() < scale * (1 + np.abs(g).max()))

    turns = all(alike(Q, x @ Q.T) for Q in (rotation(1.0), rotation(2.5)))
    tilted = [contact.front, d, *([contact.distance.axis] if hasattr(contact.distance, "axis") else [])]
    between = tuple(atan2(v[1], v[0]) for v in getattr(contact.distance, "axes", ()) if np.hypot(*v[:2]) > scale)

    def mirrors(mirror: Mirror) -> bool:
        return alike(mirror.reflection, mirror.image(x))

    return Leaves(None if turns else f"bodies.{contact.body} is not turned about e3", tilted, mirrors, azimuths=between)
