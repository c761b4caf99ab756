"""Contacts of a system in steps in time, with bodies and between shells.

Their forces are averaged along a step so that it conserves energy (docs/theory.md, time).

An approach is the amplitude that moves a rigid body, by name in `State.mu`. A setting is the entry
of `State.mu` with the stiffness of contact between a pair of shells. A contact force follows from
its arguments, the places of what touches at a state. A sample is a displacement within the step at
which a contact force is taken.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.continuation.system import Amplitudes, State, Vector
from magshell_fenicsx.parts.bodies.body_contact import BodyContact
from magshell_fenicsx.parts.contact.time_averaging import TimeAveragedContact, samples_of_step
from magshell_fenicsx.simulate.contact_control import stiff_for

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _ContactPlaces:
    """Arguments of contact forces at one end of a step in time.

    Attributes
    ----------
    bodies
        For each body the relative displacements of the points on which it presses, and their
        factors of the thickness.
    shells
        For each contact between shells the displacement of the shells that may touch.
    """

    bodies: list[tuple[Array, float | Array]]
    shells: list[Array]


class ContactsInTime:
    """All contacts of a system in steps in time; a `continuation.motion.AveragedContact`.

    All methods are collective.

    Parameters
    ----------
    body_contacts
        Name of an approach -> the contact of its body.
    shell_contacts
        Contacts between shells.

    Attributes
    ----------
    names
        The approaches.
    settings
        Names of the stiffnesses between shells.
    _system, _body_contacts, _shell_contacts
        The system; and the contacts of bodies and between shells, each as a sequence.
    _begin
        Displacement at the begin of the present step, and the arguments of contact forces there.
    """

    def __init__(
        self,
        system: FiniteElementSystem,
        body_contacts: Mapping[str, BodyContact],
        shell_contacts: Sequence[TimeAveragedContact],
    ) -> None:
        """Take the contacts; nothing is computed before the first step."""
        self._system, self._shell_contacts = system, shell_contacts
        self._body_contacts = list(body_contacts.values())
        self.names = frozenset(body_contacts)
        self.settings = frozenset(contact.pair.setting for contact in shell_contacts)
        self._begin: tuple[Vector, _ContactPlaces] | None = None

    def stiffened_settings(self, begin: State, v: Vector) -> dict[str, float]:
        """Return setting -> stiffness of pairs of shells that may meet too fast for their penalty.

        Only pairs count that are apart, and whose stiffness the case does not give.

        Parameters
        ----------
        begin
            State where the step begins.
        v
            Velocity of the unknowns, over the speed of waves sqrt(E/rho).
        """
        if not self._shell_contacts:
            return {}
        comm, nodes = self._system.comm, v.reshape(-1, self._system.u.function_space.dofmap.bs)
        # (2, 2 or 3): the largest velocity along each axis, and that against it
        largest_of_axes = np.max([nodes, -nodes], axis=1, initial=0.0)
        largest_of_all = np.max(comm.allgather(largest_of_axes), axis=0)
        # no two places move faster relative to each other
        speed = float(np.linalg.norm(largest_of_all.sum(axis=0)))
        evaluation, settings = self._system.at_state(begin), dict[str, float]()
        for contact in self._shell_contacts:
            pair = contact.pair
            stiffness = begin.mu.get(pair.setting, pair.stiffness)
            needed_stiffness = stiff_for(pair, speed, self._system.length)
            may_be_too_soft = needed_stiffness > stiffness and not pair.has_given_stiffness
            if may_be_too_soft and evaluation.evaluate(contact.penetration) <= 0:
                settings[pair.setting] = needed_stiffness
        return settings

    def average_along(self, begin: State, end: State, part: float) -> None:
        """Let contact forces be means over a step in time, until `use_state_forces` is called.

        The mean is along the straight way from the state at the begin to the state at the end.

        Parameters
        ----------
        begin, end
            States at both ends of the step.
        part
            Position within the step, from 0 to 1, at which the system takes its forces.
        """
        places_before, places_after = self._at_begin(begin), self._places(end)
        for body_contact, place_before, place_after in zip(
            self._body_contacts, places_before.bodies, places_after.bodies, strict=True
        ):
            body_contact.average(place_before, place_after, part)
        for contact, displacement_before, displacement_after in zip(
            self._shell_contacts, places_before.shells, places_after.shells, strict=True
        ):
            contact.samples = ()  # old ones must not be in use while new ones are computed
            contact.samples = samples_of_step(
                contact, displacement_before, displacement_after, part
            )

    def use_state_forces(self) -> None:
        """Let contact forces be those of the present state again."""
        for body_contact in self._body_contacts:
            body_contact.use_present_forces()
        for contact in self._shell_contacts:
            contact.samples = ()  # without samples it takes the force of the present state

    def penetration_message(self, begin: State, end: State) -> str:
        """Return which shells pass through each other in a step, in words; "" if none do."""
        displacements = zip(self._at_begin(begin).shells, self._places(end).shells, strict=True)
        for contact, (places_before, places_after) in zip(
            self._shell_contacts, displacements, strict=True
        ):
            if contact.images_pass_through(places_before, places_after):
                return f"{contact.pair.words} pass through each other"
        return ""

    def stored_energy(self, u: Vector, mu: Amplitudes) -> float:
        """Return the energy of the shell itself together with that of its contacts."""
        self.use_state_forces()
        return self._system.stored_energy(u, mu)

    def _at_begin(self, begin: State) -> _ContactPlaces:
        """Return the arguments of contact forces at the begin of a step, computed once."""
        # the displacement is compared by identity of the array
        if self._begin is None or self._begin[0] is not begin.u:
            self._begin = begin.u, self._places(begin)
        _, places = self._begin
        return places

    def _places(self, state: State) -> _ContactPlaces:
        """Return the arguments of contact forces at a state."""
        return self._system.at_state(state).evaluate(
            lambda: _ContactPlaces(
                [contact.point_state for contact in self._body_contacts],
                [contact.displacement for contact in self._shell_contacts],
            )
        )
