"""Observables of supports: reactions, and their work-conjugates to motions, in the case's units.

An observable is what is read from a state, as columns of path.csv. mu holds the amplitudes (load
parameters) of a state by name; Pi is the energy. The amplitude of a motion is its factor, and
-dPi/dmu its conjugate, which is in proportion to the reaction: a force, or a moment if the supports
only turn. E, h and R are Young's modulus, thickness and reference length; models measure forces
over E h R and lengths over R. A model of half a shell has the multiplicity 2.
"""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.parts.ability import Account, Context
from magshell_fenicsx.parts.observables import ModelView, Observables
from magshell_fenicsx.quantities.quantity import DISTANCE, MOMENT, REACTION, TURN, Quantity

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.observed_model import ObservedModel

Array = NDArray[np.float64]


def columns(supports: Iterable[str]) -> tuple[str, ...]:
    """Return the columns of supports in path.csv: forces and moments along the axes."""
    return tuple(f"{name}_{kind}{axis}" for name in supports for kind in "fm" for axis in "xyz")


def motion_columns(loads: "Loads") -> dict[str, str]:
    """Return amplitude of each motion of supports -> the column of its reaction."""
    names = list(dict.fromkeys(move.motion.name for move in loads.moves))
    return {name: "reaction" if len(names) == 1 else f"reaction_{name}" for name in names}


def moment_columns(loads: "Loads") -> set[str]:
    """Return the columns of reactions that are moments, while others are forces."""
    return {column for name, column in motion_columns(loads).items() if only_turns(loads, name)}


def motion_size(loads: "Loads", name: str) -> float:
    """Return the sum over supports of the lengths of a motion's translations, over R.

    Without translations it is the sum of the angles (rad). `name` is the motion's amplitude.
    """
    motions = [move.motion for move in loads.moves if move.motion.name == name for _ in move.names]
    sum_of_lengths = float(sum(np.linalg.norm(motion.shift) for motion in motions))
    return sum_of_lengths or float(sum(np.linalg.norm(motion.turn) for motion in motions))


def only_turns(loads: "Loads", name: str) -> bool:
    """Return whether a motion has rotations alone, so that its reaction is a moment.

    `name` is the motion's amplitude.
    """
    return not any(m.motion.shift.any() for m in loads.moves if m.motion.name == name)


class ReactionsObservables(Observables):
    """Motions of supports with their reactions, and the reactions of all supports."""

    quantities = (
        Quantity(
            "motion",
            "motion",
            "Factor of the motion of supports; the step may give it another name. With units its "
            "way has a column too: all translations together in mm, of rotations alone degrees.",
            "load",
            units=(DISTANCE, TURN),
        ),
        Quantity(
            "reaction",
            "reaction",
            "Reaction of the supports that move, along their motion; of several motions "
            "reaction_NAME. In the case's unit of force (N with units), of rotations alone in "
            "that of a moment.",
            "reaction",
            units=(REACTION, MOMENT),
            each=True,
        ),
    )

    def account(self, context: Context, loads: "Loads") -> Account:
        """Return the line of `magshell check` on supports that move; empty without."""
        moving_supports = dict.fromkeys(name for move in loads.moves for name in move.names)
        return Account(
            [f"supports that move: {', '.join(moving_supports)}"] if moving_supports else []
        )

    def amplitudes(self, loads: "Loads") -> tuple[str, ...]:
        return tuple(motion_columns(loads))

    def conjugates(self, loads: "Loads") -> dict[str, str]:
        return motion_columns(loads)

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        return (*super().columns(loads, supports), *columns(supports))

    def motions(self, loads: "Loads") -> dict[str, tuple[bool, float]]:
        return {
            name: (only_turns(loads, name), motion_size(loads, name))
            for name in motion_columns(loads)
        }

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return factors and reactions of motions, and reactions of supports, by column.

        All are in the case's units.
        """
        values: dict[str, float] = {}
        for name, column in motion_columns(view.loads).items():
            # the potential of an amplitude is dPi/dmu: minus its conjugate
            values |= {
                name: state.mu[name],
                column: view.potential(state, name) / -self._unit(view, name),
            }
        if view.reactions:
            frame = rotation(view.azimuth)
            values |= observed_reactions(
                view.model, state, view.mirror, frame, view.force, view.length
            )
        return values

    def conjugate_unit(self, view: ModelView, name: str) -> float | None:
        return self._unit(view, name) if name in self.amplitudes(view.loads) else None

    def _unit(self, view: ModelView, name: str) -> float:
        """Return -dPi/dmu of the motion `name` for a reaction of one in the case's unit.

        The reaction works along the sum of the lengths (or angles) of the motion. The reaction is
        that of the whole shell, Pi that of the model.
        """
        lever_arm = view.length if only_turns(view.loads, name) else 1.0
        return -motion_size(view.loads, name) / (view.force * lever_arm * view.model.multiplicity)


def observed_reactions(
    model: "ObservedModel",
    state: "State",
    mirror: Mirror | None,
    frame: Array,
    force: float,
    length: float,
) -> dict[str, float]:
    """Return column -> value of the forces and moments of all supports; collective.

    Parameters
    ----------
    mirror
        Mirror of a half model; None if all is modelled.
    frame
        (3, 3) rotation from the frame of the case to that of the model.
    force, length
        The units E h R and R in the case's units.
    """
    from magshell_fenicsx.parts.supports.reactions import (
        reactions,
    )  # the solver takes long to import

    by_column: dict[str, float] = {}
    for name, reaction in reactions(model, state, mirror).items():
        # from the model's frame to the case's
        values = np.concatenate(
            [force * reaction.force @ frame, force * length * reaction.moment @ frame]
        )
        by_column |= dict(zip(columns([name]), (float(v) for v in values), strict=True))
    return by_column
