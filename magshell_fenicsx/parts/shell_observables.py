"""Observables of every run: energies, displacements of named points, and own energies.

Own energies are those of a program and of parts, each with a density: a term of the model with an
amplitude of its name. An amplitude is a load parameter.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from math import nan
from typing import TYPE_CHECKING, ClassVar

from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.observables import ModelView, Observables

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.parts.loads import Loads

ENERGY_GROUPS = ("U1", "Uq", "Utau")  # groups of terms with a column of their own


class EnergyObservables(Observables):
    """The energies over E h R² that every run has: of all terms, and of some of them."""

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return column -> energy; collective.

        A column of several groups of terms is their sum. The energy of a solid is not split into
        stretching and bending.
        """
        energies, sums = view.energies(state), defaultdict[str, float](float)
        for group, column in {t.group: t.column for t in view.model.system.terms}.items():
            sums[column] += energies[group]
        is_split = "stretching" in sums
        return {
            "energy": sum(energies.values()),
            "stretching": sums["stretching"] if is_split else nan,
            "bending": sums["bending"] if is_split else nan,
            "magnetic": sums["magnetic"],
            **{group: energies.get(group, 0.0) for group in ENERGY_GROUPS},
        }


class PointObservables(Observables):
    """The displacements of the named points of a case, whose columns are those of every run."""

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return column -> component of a displacement, in the case's unit of length; collective.

        Components are in the frame of the case.
        """
        displacements = dict[str, float]()
        for point in view.points:
            u = view.length * view.model.displacement(state.u, point)
            u = u @ rotation(view.azimuth)  # from the model's frame to the case's
            displacements |= {
                f"{point}_u{axis}": float(component)
                for axis, component in zip("xyz", u, strict=True)
            }
        return displacements


class OwnEnergyObservables(Observables):
    """The amplitudes of own energies, their parameters, and the integrals that they observe."""

    column_rank: ClassVar[int] = 1

    def free_amplitudes(self, loads: "Loads") -> Mapping[str, float]:
        # a term without a density only observes
        terms = [term for term in loads.user_terms if term.density]
        return {term.name: term.value for term in terms} | {
            parameter.name: parameter.value for term in terms for parameter in term.free_parameters
        }

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        return tuple(column for term in loads.user_terms for column in term.observed)

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return column -> amplitude, or integral over the shell that a term observes; collective.

        Integrals of a term are times its amplitude, if it has one.
        """
        model, columns = view.model, super().observe(view, state)
        for term in view.loads.user_terms:
            factor = state.mu[term.name] if term.density else 1.0
            for column in term.observed:
                integral = model.system.at_state(state).integral(model.observed[column])
                columns[column] = factor * model.multiplicity * integral
        return columns
