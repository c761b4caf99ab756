"""Observables of shells that touch: the force, the least gap and the penalty's stiffness.

An observable is a column that is read from a state. A pair has two members that may touch: shells,
patches, or a shell and itself. A penalty of the penetration keeps them apart. A state stores the
penalty's stiffness among its amplitudes, under the name `Pair.setting`. A view is a model with the
units in which it is reported.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.parts.ability import Account, Context
from magshell_fenicsx.parts.contact.contact_section import WHOLE_SHELL
from magshell_fenicsx.parts.observables import ModelView, Observables
from magshell_fenicsx.quantities.quantity import POINT_FORCE, THICKNESS, Quantity

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.mesh.patch import PatchMesh
    from magshell_fenicsx.parts.contact.contact_section import Pair
    from magshell_fenicsx.parts.loads import Loads


class ContactObservables(Observables):
    """The observables of each pair that may touch: columns of path.csv."""

    quantities = (
        Quantity(
            "contact_force",
            "contact force",
            "Between shells that touch, or parts of one: the integral of the pressure over the "
            "contact; of several pairs contact_force_ONE_OTHER.",
            "load",
            "F R/(2πD)",
            (POINT_FORCE,),
            each=True,
        ),
        Quantity(
            "contact_gap_over_h",
            "least gap",
            "Between the faces of shells that may touch, negative by the penetration of the "
            "penalty; no number while no places nearer than 4 h face each other.",
            "error",
            "",
            (THICKNESS,),
            each=True,
        ),
        Quantity(
            "contact_penalty",
            "stiffness between shells",
            "Of the penalty, in E h/R²; raised fourfold where shells would penetrate by over 1e-3 "
            "of the thickness.",
            "error",
            each=True,
        ),
    )

    def account(self, context: Context, loads: "Loads") -> Account:
        """Return the lines of `magshell check` on pairs that may touch, with their stiffness."""
        return Account(
            [
                f"contact of {pair.words} without friction, stiffness k R²/(E h) = "
                f"{pair.stiffness:.4g}{', as given' if pair.has_given_stiffness else ''}"
                for pair in loads.pairs
            ]
        )

    def amplitudes(self, loads: "Loads") -> tuple[str, ...]:
        """Return the names under which a state stores the penalty's stiffness of all pairs."""
        return tuple(pair.setting for pair in loads.pairs)

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        """Check that the surface has the patches of all pairs, and that pairs share no cells.

        Raises
        ------
        MeshError
            With the name of the missing patch, or the two pairs.
        """
        # flags of cells by name; the whole shell counts as a patch
        patches = {**surface.patches, WHOLE_SHELL: np.ones(len(surface.cells), dtype=bool)}
        for number, pair in enumerate(loads.pairs):
            for name in pair.names:
                if name not in patches:
                    allowed = ", ".join(sorted(patches))
                    raise MeshError(
                        f"contact: {name}: the surface has no such part, only {allowed}"
                    )
            for earlier in loads.pairs[:number]:
                if _share_cells(pair, earlier, patches):
                    raise MeshError(
                        f"contact: {pair.words}: shares cells with {earlier.words}: no place is "
                        "in two pairs"
                    )

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        """Return the names of the columns of all pairs; `supports` are not used here."""
        return tuple(column for pair in loads.pairs for column in _columns(pair))

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return column -> value of all pairs at a state, in the units of the view; collective.

        They are the contact force, the least gap over h, and the stiffness of the penalty.
        """
        model, values = view.model, dict[str, float]()
        for contact in model.shell_contacts:
            evaluation = model.system.at_state(state)
            # both are functions of the present state, which is this one while they are evaluated
            force, gap = evaluation.evaluate(contact.force), evaluation.evaluate(contact.least_gap)
            # in the order of `quantities`
            numbers_of_pair = force / model.force_unit, gap / view.h, contact.stiffness.value
            values |= dict(zip(_columns(contact.pair), numbers_of_pair, strict=True))
        return values


def _share_cells(pair: "Pair", other: "Pair", patches: Mapping[str, NDArray[np.bool_]]) -> bool:
    """Return whether two pairs share cells on both sides, in either order of their members.

    Parameters
    ----------
    patches
        Name of a member -> flags (cells,) of its cells.
    """
    other_first, other_second = (patches[name] for name in other.names)
    own_first, own_second = (patches[name] for name in pair.names)
    # the first member shares cells with the first or with the second of the other pair
    straight = (own_first & other_first).any() and (own_second & other_second).any()
    crossed = (own_second & other_first).any() and (own_first & other_second).any()
    return bool(straight or crossed)


def _columns(pair: "Pair") -> Iterator[str]:
    """Return the names of the columns of a pair: those of the quantities, and the pair's suffix."""
    return (q.name + pair.suffix for q in ContactObservables.quantities)
