"""Contacts of a system in steps in time, with bodies and between shells.

Their forces are averaged along a step so that it conserves energy (docs/theory.md, time).
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
    """Places where bodies press, and displacements of shells that may touch, at a step's end."""

    bodies: list[tuple[Array, float | Array]]
    shells: list[Array]


class ContactsInTime:
    """All contacts of a system in steps in time; a `continuation.motion.AveragedContact`.

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
    """

    def __init__(
        self,
        system: FiniteElementSystem,
        body_contacts: Mapping[str, BodyContact],
        shell_contacts: Sequence[TimeAveragedContact],
    ) -> None:
        self._system, self._shell_contacts = system, shell_contacts
        self._body_contacts = list(body_contacts.values())
        self.names = frozenset(body_contacts)
        self.settings = frozenset(contact.pair.setting for contact in shell_contacts)
        self._begin: tuple[Vector, _ContactPlaces] | None = None

    def stiffened_settings(self, begin: State, v: Vector) -> dict[str, float]:
        """Return settings of pairs of shells that are apart and may meet too fast for their
        penalty.
        """
        if not self._shell_contacts:
            return {}
        comm, nodes = self._system.comm, v.reshape(-1, self._system.u.function_space.dofmap.bs)
        largest = np.max([nodes, -nodes], axis=1, initial=0.0)  # (2, 3): along each axis and back
        fastest = np.max(comm.allgather(largest), axis=0)
        # no two places move faster relative to each other
        speed = float(np.linalg.norm(fastest.sum(axis=0)))
        evaluation, settings = self._system.at_state(begin), dict[str, float]()
        for contact in self._shell_contacts:
            pair = contact.pair
            k = begin.mu.get(pair.setting, pair.stiffness)
            needed = stiff_for(pair, speed, self._system.length)
            if (
                needed > k
                and not pair.has_given_stiffness
                and evaluation.evaluate(contact.penetration) <= 0
            ):
                settings[pair.setting] = needed
        return settings

    def average_along(self, begin: State, end: State, part: float) -> None:
        """Take the forces of a step at a part of it."""
        places_before, places_after = self._at_begin(begin), self._places(end)
        for pressing, low, high in zip(
            self._body_contacts, places_before.bodies, places_after.bodies, strict=True
        ):
            pressing.average(low, high, part)
        for contact, u, v in zip(
            self._shell_contacts, places_before.shells, places_after.shells, strict=True
        ):
            contact.samples = ()
            contact.samples = samples_of_step(contact, u, v, part)

    def use_state_forces(self) -> None:
        """Take the present forces again."""
        for pressing in self._body_contacts:
            pressing.use_present_forces()
        for contact in self._shell_contacts:
            contact.samples = ()

    def penetration_message(self, begin: State, end: State) -> str:
        """Return which shells pass through each other in a step, in words; empty if none do."""
        displacements = zip(self._at_begin(begin).shells, self._places(end).shells, strict=True)
        for contact, (places_before, places_after) in zip(
            self._shell_contacts, displacements, strict=True
        ):
            if contact.images_pass_through(places_before, places_after):
                return f"{contact.pair.words} pass through each other"
        return ""

    def stored_energy(self, u: Vector, mu: Amplitudes) -> float:
        """Return the energy of the shell itself with that of the contacts."""
        self.use_state_forces()
        return self._system.stored_energy(u, mu)

    def _at_begin(self, begin: State) -> _ContactPlaces:
        """Return the places at the begin of a step, which are computed once."""
        if self._begin is None or self._begin[0] is not begin.u:
            self._begin = begin.u, self._places(begin)
        return self._begin[1]

    def _places(self, state: State) -> _ContactPlaces:
        return self._system.at_state(state).evaluate(
            lambda: _ContactPlaces(
                [contact.point_state for contact in self._body_contacts],
                [contact.displacement for contact in self._shell_contacts],
            )
        )
