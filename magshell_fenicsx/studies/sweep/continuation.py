"""Continuation of a fold under pressure from case to case, each with its own scene."""

from copy import copy
from dataclasses import replace

import numpy as np

from magshell_fenicsx.continuation.fold import Fold, FoldLost, Guess, find_fold, predict_fold
from magshell_fenicsx.continuation.system import State, Vector, dot
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.transfer import same_mesh, transfer

KEPT = 3  # folds, for a quadratic extrapolation
LEAST_COSINE = 0.5  # between successive null vectors; a smaller value means a jump to another fold


class Continuation:
    """Follows a fold of the pressure through a parameter p of the case.

    All scenes have the same kind of model. The known folds are stored in the unknowns of the last scene.

    Parameters
    ----------
    p, scene, state
        The first fold, located by a path; Newton's method refines it.

    Raises
    ------
    FoldLost
        If there is no fold, or if it is not the first instability.
    """

    def __init__(self, p: float, scene: Scene, state: State) -> None:
        fold = find_fold(scene.newton, Guess(state), "pressure")
        refuse_later(scene, fold, fold.phi)
        self._known, self._scene = [(p, fold)], scene

    def follow(self, p: float, scene: Scene) -> Fold:
        """The fold at another value of the parameter.

        Raises
        ------
        FoldLost
            If none is found, or if there is evidence that it is not the first instability.
        """
        known = [(q, self._moved(fold, scene)) for q, fold in self._known]
        given = scene.unloaded().mu
        others = {**given, **({"lambda_m": scene.case.lambda_m} if "lambda_m" in given else {})}
        guess = predict_fold(scene.newton.system, known, p, others)
        fold = find_fold(scene.newton, guess, "pressure")
        refuse_later(scene, fold, known[-1][1].phi)
        self._known, self._scene = [*known, (p, fold)][-KEPT:], scene
        return fold

    def from_here(self) -> "Continuation":
        """A continuation that knows the last fold only, in which another parameter may vary."""
        found = copy(self)
        found._known = self._known[-1:]
        return found

    def has_mesh_of(self, scene: Scene) -> bool:
        """Whether a scene has the mesh of the last one."""
        alike = type(scene.model) is type(self._scene.model) and scene.plan.half == self._scene.plan.half
        return alike and same_mesh(self._scene, scene)

    def _moved(self, fold: Fold, scene: Scene) -> Fold:
        u, phi = (transfer(self._scene, scene, v) for v in (fold.state.u, fold.phi))
        return replace(fold, state=State(u, fold.state.mu), phi=phi)


def refuse_later(scene: Scene, fold: Fold, expected: Vector) -> None:
    """Reject a fold that is not the first instability under growing pressure, as far as this state shows.

    Parameters
    ----------
    expected
        The null vector of the fold that it was continued from.

    Raises
    ------
    FoldLost
        If its null vector is another, it is no maximum, or the shell is unstable there in another direction.
    """
    comm, a, b = scene.newton.system.comm, fold.phi, expected
    if dot(comm, a, b) < LEAST_COSINE * np.sqrt(dot(comm, a, a) * dot(comm, b, b)):
        raise FoldLost("another fold was found")
    if fold.value <= 0 or fold.curvature >= 0:
        raise FoldLost("the fold is not a maximum of the pressure")
    modes = scene.model.excluded_modes
    if fold.unstable or (modes and modes.is_unstable(fold.state)):
        raise FoldLost("another instability comes before the fold")
