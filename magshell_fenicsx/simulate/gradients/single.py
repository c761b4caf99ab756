"""Derivatives by single numbers: an amplitude, or a key of the case."""

from magshell_fenicsx.assembly.terms import factor_of
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.continuation.system import State, dot
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, along, mixed
from magshell_fenicsx.simulate.numbers import carried, number_of, scene_with
from magshell_fenicsx.simulate.results import functional
from magshell_fenicsx.simulate.transfer import transfer

STEP = 1e-4  # of a number, or of one where it is smaller


def by_amplitude(adjoint: Adjoint, name: str) -> float:
    scene, state = adjoint.scene, adjoint.state
    if name in adjoint.rows:
        raise CaseError(f"{name}: is unknown here, as its conjugate is held")
    system, of = scene.model.system, adjoint.explicit
    found = dot(system.comm, adjoint.w, system.load(state.u, state.mu, name))
    found += sum(c * system.curvature(state.u, state.mu, i, name) for i, c in adjoint.rows.items())
    if adjoint.wave:
        system.at(state.u, state.mu)
        found += adjoint.wave[2] * sum(t.energy() for t in along(scene, adjoint) if t.amplitude == name)
    return float(found + (mixed(scene, state, of, name) + of.by_mu.get(name, 0.0) if of else 0.0))


def by_number(adjoint: Adjoint, key: str) -> float:
    """By a central difference of the contracted equations, on the same mesh: nothing is solved."""
    scene, state = adjoint.scene, adjoint.state
    value = number_of(scene.case, key)
    step = STEP * (abs(value) or 1.0)

    def contracted(p: float) -> float:
        other = scene_with(scene, key, p)
        u, w = (transfer(scene, other, v) for v in (state.u, adjoint.w))
        moved, system = carried(scene, other, State(u, state.mu)), other.model.system
        moved = system.placed(moved)
        explicit = functional(other, moved, adjoint.of).value if adjoint.explicit else 0.0
        rows = sum(c * system.potential(moved.u, moved.mu, name) for name, c in adjoint.rows.items())
        total = explicit + dot(system.comm, w, system.residual(moved.u, moved.mu)) + rows
        for term in along(other, adjoint):
            assert adjoint.wave
            total += adjoint.wave[2] * factor_of(term.amplitude, moved.mu) * term.energy()
        return float(total)

    return (contracted(value + step) - contracted(value - step)) / (2 * step)
