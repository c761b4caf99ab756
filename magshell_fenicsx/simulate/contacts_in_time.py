"""Contacts of a system in steps in time, with bodies and between shells.

Their forces are averaged along a step so that it conserves energy (docs/theory.md, time).

An approach is the amplitude that moves a rigid body, by name in `State.mu`. A setting is the entry
of `State.mu` with the stiffness of contact between a pair of shells. A configuration is what the
force of a contact depends on at a state.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from magshell_fenicsx.continuation.system import Amplitudes, State, Vector
from magshell_fenicsx.shells.model_base import ModelBase
from magshell_fenicsx.simulate.contact_control import stiff_for


class ContactsInTime:
    """All contacts of a system in steps in time; a `continuation.motion.AveragedContact`.

    All methods are collective.

    Parameters
    ----------
    model
        The model, with its contacts.

    Attributes
    ----------
    names
        The approaches.
    settings
        Names of the stiffnesses between shells.
    _system, _contacts, _shell_contacts
        The system; all contacts, and those between shells.
    _begin
        Displacement at the begin of the present step, and the configurations of all contacts there.
    """

    def __init__(self, model: ModelBase) -> None:
        """Take the contacts; nothing is computed before the first step."""
        self._system = model.system
        self._contacts, self._shell_contacts = model.all_contacts, model.shell_contacts
        self.names = frozenset(model.contacts)
        self.settings = frozenset(contact.pair.setting for contact in model.shell_contacts)
        self._begin: tuple[Vector, Sequence[Any]] | None = None

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
        ends = zip(self._at_begin(begin), self._configurations(end), strict=True)
        for contact, (begin_state, end_state) in zip(self._contacts, ends, strict=True):
            contact.average(begin_state, end_state, part)

    def use_state_forces(self) -> None:
        """Let contact forces be those of the present state again."""
        for contact in self._contacts:
            contact.use_present_force()

    def penetration_message(self, begin: State, end: State) -> str:
        """Return which shells pass through each other in a step, in words; "" if none do."""
        ends = [*zip(self._at_begin(begin), self._configurations(end), strict=True)]
        # contacts between shells come last
        ends_of_shells = ends[len(ends) - len(self._shell_contacts) :]
        for contact, (begin_state, end_state) in zip(
            self._shell_contacts, ends_of_shells, strict=True
        ):
            if contact.passes_through(begin_state, end_state):
                return f"{contact.pair.words} pass through each other"
        return ""

    def stored_energy(self, u: Vector, mu: Amplitudes) -> float:
        """Return the energy of the shell itself together with that of its contacts."""
        self.use_state_forces()
        return self._system.stored_energy(u, mu)

    def _at_begin(self, begin: State) -> Sequence[Any]:
        """Return the configurations at the begin of a step, computed once."""
        # the displacement is compared by identity of the array
        if self._begin is None or self._begin[0] is not begin.u:
            self._begin = begin.u, self._configurations(begin)
        _, configurations = self._begin
        return configurations

    def _configurations(self, state: State) -> Sequence[Any]:
        """Return what the force of each contact depends on at a state."""
        return self._system.at_state(state).evaluate(
            lambda: [contact.configuration for contact in self._contacts]
        )
