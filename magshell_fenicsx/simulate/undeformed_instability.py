"""Why an undeformed shell is unstable: the place of its lowest mode, and the penalty that helps.

The undeformed shell has no stress, so that its energy has a minimum there. The energy of its finite
elements has none where the interior penalty does not hold the moments at an edge.
"""

import numpy as np
from numpy.typing import NDArray
from petsc4py import PETSc

from magshell_fenicsx.continuation.modes import ModesNotFound, lowest_modes
from magshell_fenicsx.continuation.system import State, symmetric_part
from magshell_fenicsx.mesh.patch import place_text
from magshell_fenicsx.models.shell.parameters import default_penalty
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
PENALTY_FACTOR = 4.0  # by which a message asks for a larger penalty than the present one


def cause_of_instability(scene: Scene, state: State) -> str:
    """Return in words why the undeformed shell is unstable, where, and what helps; collective."""
    problem = scene.problem
    length, unit = problem.unit_of_places
    place = _place_of_lowest_mode(scene, state)
    around = "" if place is None else f" around {place_text(place * length)}, {unit}"
    cause = f"mesh.penalty is too small or the mesh too coarse{around}"
    if problem.body:  # a solid has no penalty
        return cause
    default = default_penalty(problem.mesh.degree)
    penalty = problem.mesh.penalty or default
    if penalty < default:
        return f"{cause}: take mesh.penalty: {default:g}, the default"
    return f"{cause}: take mesh.penalty: {PENALTY_FACTOR * penalty:g}, or smaller elements there"


def _place_of_lowest_mode(scene: Scene, state: State) -> Array | None:
    """Return the place (3,) over R where the lowest mode of the tangent is largest; collective.

    Modes are those of the tangent over its diagonal, so that all elements count alike, whatever
    their size. None if the mode is not found.
    """
    model = scene.model
    K = symmetric_part(model.system.tangent(state.u, state.mu))
    diagonal = K.getDiagonal()
    diagonal.abs()
    scale = PETSc.Mat().createAIJ(K.getSizes(), nnz=1, comm=K.comm)
    scale.setDiagonal(diagonal)
    scale.assemble()
    try:
        mode, *_ = lowest_modes(K, scale, 1)
    except ModesNotFound:
        return None
    components = model.r0.function_space.dofmap.bs
    places = model.r0.x.array.reshape(-1, components)
    sizes = np.linalg.norm(
        (np.sqrt(diagonal.array_r) * mode.vector).reshape(-1, components), axis=1
    )
    largest = int(sizes.argmax())
    place = places[largest]
    if components == 2:  # (rho, z) of a meridian
        place = np.array([place[0], 0.0, place[1]])
    all_ranks = model.system.comm.allgather((float(sizes[largest]), place))
    return np.asarray(max(all_ranks, key=lambda size_and_place: size_and_place[0])[1])
