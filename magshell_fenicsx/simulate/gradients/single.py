"""Derivatives by single numbers: an amplitude, or a key of the case."""

from magshell_fenicsx.assembly.terms import factor_of
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.case.units import sizes_of
from magshell_fenicsx.continuation.system import State, dot
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, Place, along
from magshell_fenicsx.simulate.numbers import carried, number_of, scene_with, with_number
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.transfer import transfer

STEP = 1e-4  # of a number, or of one where it is smaller


def by_amplitude(adjoint: Adjoint, name: str) -> float:
    scene, system, found = adjoint.scene, adjoint.scene.model.system, adjoint.by_mu.get(name, 0.0)
    given = [place for place in adjoint.places if name not in place.rows]
    if not given:
        raise CaseError(f"{name}: is unknown here, as its conjugate is held")
    for place in given:
        u, mu = place.state.u, place.state.mu
        found += dot(system.comm, place.w, system.load(u, mu, name, held=False))
        found += place.energy and place.energy * system.potential(u, mu, name)
        found += sum(c * system.curvature(u, mu, i, name) for i, c in place.conjugates.items())
    if adjoint.directions:
        system.at(adjoint.state.u, adjoint.state.mu)
        own = sum(c * term.energy() for term, c in along(scene, adjoint) if term.amplitude == name)
        found += system.comm.allreduce(own)
    return float(found)


def by_number(adjoint: Adjoint, key: str) -> float:
    """By a central difference of the contracted equations, on the same mesh: nothing is solved."""
    scene = adjoint.scene
    value = number_of(scene.case, key)
    if adjoint.gas and key.startswith("shell."):
        raise CaseError(f"{key}: has no derivative while a gas is held, whose law depends on it")
    step = STEP * (abs(value) or 1.0)

    def contracted(p: float) -> float:
        other = scene_with(scene, key, p)
        states = [carried(scene, other, _moved(scene, other, place.state)) for place in adjoint.places]
        states = [other.model.system.placed(state) for state in states]
        total = sum(_at(scene, other, *each) for each in zip(adjoint.places, states, strict=True))
        if adjoint.by_itself:
            total += adjoint.by_itself(other, states[0])
        else:
            total += sum(_own(other, *each) for each in zip(adjoint.places, states, strict=True))
        other.model.system.at(states[0].u, states[0].mu)
        energies = sum(c * factor_of(t.amplitude, states[0].mu) * t.energy() for t, c in along(other, adjoint))
        return float(total + other.model.system.comm.allreduce(energies))

    return (contracted(value + step) - contracted(value - step)) / (2 * step)


def size_by_number(adjoint: Adjoint, key: str) -> float:
    """The derivative of the unit of the result: one p_c is more pascals on a thicker shell."""
    if not adjoint.scale:
        return 0.0
    case = adjoint.scene.case
    value = number_of(case, key)
    step = STEP * (abs(value) or 1.0)
    low, high = (sizes_of(with_number(case, key, value + d)).of[adjoint.scale] for d in (-step, step))
    return (high - low) / (2 * step)


def _moved(scene: Scene, other: Scene, state: State) -> State:
    return State(transfer(scene, other, state.u), state.mu)


def _at(scene: Scene, other: Scene, place: Place, state: State) -> float:
    """The residual and the rows of a place in another scene; what is held stays the same number of its unit."""
    system, here = other.model.system, place.state
    found = dot(system.comm, transfer(scene, other, place.w), system.forces(state.u, state.mu))
    for name, c in place.rows.items():
        held = -scene.model.system.potential(here.u, here.mu, name)
        unit = other.conjugate_unit(name) / scene.conjugate_unit(name)
        found += c * (system.potential(state.u, state.mu, name) + unit * held)
    return float(found)


def _own(other: Scene, place: Place, state: State) -> float:
    """What J itself contains of a place."""
    system = other.model.system
    found = sum(c * system.potential(state.u, state.mu, name) for name, c in place.potentials.items())
    if place.energy:
        found += place.energy / other.model.multiplicity * sum(other.energies(state).values())
    return float(found)
