"""The forces of contact on rigid bodies, as columns: normal force, resultant and moment.

The normal force is the integral of the contact pressure over the area that touches, whatever the
direction of the pressure: what a sensor of the grip reads. The resultant is the vector sum of the
forces, the moment is about the body's reference point (the centre of a ball), where it is at
present. All are of the whole shell on the body. docs/theory.md, Contact.
"""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.parts.observables import ModelView, Observables

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.parts.bodies.body_contact import BodyContact, ContactBody
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.observed_model import ObservedModel

Array = NDArray[np.float64]


class BodyForcesObservables(Observables):
    """The forces of contact on each body: columns of path.csv."""

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        """Return the names of the columns of all bodies; `supports` are not used here."""
        return tuple(column for contact in loads.contacts for column in _columns(contact))

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return column -> force or moment on a body at a state; collective.

        Normal forces are over 2 pi D/R, resultants and moments in the case's units and frame.
        """
        model, values = view.model, dict[str, float]()
        evaluation, frame = model.system.at_state(state), rotation(view.azimuth)
        for contact in model.contacts.values():
            sums = evaluation.evaluate(partial(_sums, contact, model))
            point = contact.contact.reference_point
            force, moment = _whole_force_and_moment(sums[:3], sums[3:6], point, model, view.mirror)
            numbers = (
                *(sums[6:] / model.force_unit),
                *(view.force * force @ frame),
                *(view.force * view.length * moment @ frame),
            )
            values |= dict(zip(_columns(contact.contact), map(float, numbers), strict=True))
        return values


def _columns(contact: "ContactBody") -> Iterator[str]:
    """Return the columns of a body: normal forces, of each of several shells too, and vectors."""
    yield f"{contact.body}_normal_force"
    yield from (f"{contact.body}_{shell}_normal_force" for shell in contact.shells)
    yield from (f"{contact.body}_contact_{kind}{axis}" for kind in "fm" for axis in "xyz")


def _sums(contact: "BodyContact", model: "ObservedModel") -> Array:
    """Return sums over the modelled part, in one array; collective.

    They are the force (3) over E h R and the moment (3) over E h R² on the body, and the normal
    forces: that of all, and of each of several shells.
    """
    forces, moments = contact.forces_and_moments()
    normal_forces = np.linalg.norm(forces, axis=-1).sum(axis=1)  # of own cells
    of_shells = [
        normal_forces @ model.shell_cells[shell][: len(normal_forces)]
        for shell in contact.contact.shells
    ]
    vectors = forces.sum(axis=(0, 1)), moments.sum(axis=(0, 1))
    sums = np.concatenate([*vectors, [normal_forces.sum(), *of_shells]])
    return np.asarray(model.system.comm.allreduce(sums))


def _whole_force_and_moment(
    force: Array, moment: Array, point: Array, model: "ObservedModel", mirror: Mirror | None
) -> tuple[Array, Array]:
    """Return force and moment (3,) of the whole shell from those of the modelled part.

    Moments are about a point (3,), which need not be its own image. The moment of an image is about
    the image of the point, from where it is shifted.
    """
    if len(model.axes) == 2:  # a meridian: around the axis all but the force along it cancels
        axial_force = force * [0.0, 0.0, 1.0]
        to_axis = point * [-1.0, -1.0, 0.0]
        return axial_force, np.asarray(np.cross(to_axis, axial_force), np.float64)
    if mirror is None:
        return force, moment
    moments = [
        image.sign * image.Q @ moment + np.cross(image.apply(point) - point, image.Q @ force)
        for image in mirror.images
    ]
    return mirror.sum_over_images(force), np.asarray(sum(moments))
