"""The folds that a rank knows, from which the fold of another sample on the same mesh is continued."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.fold import Fold, FoldLost, Guess, find_fold
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.transfer import chart, matching
from magshell_fenicsx.studies.ensemble.samples import Values
from magshell_fenicsx.studies.sweep.continuation import refuse_later

Array = NDArray[np.float64]
MOST = 20  # folds that are kept


@dataclass(frozen=True)
class _Known:
    """A fold without its scene: the drawn values, the nodes in the chart, displacement, pressure and null vector."""

    values: Values
    nodes: Array
    u: Vector
    pressure: float
    phi: Vector


class KnownFolds:
    """Folds of the pressure of earlier samples."""

    def __init__(self) -> None:
        self._known: list[_Known] = []

    def __bool__(self) -> bool:
        return bool(self._known)

    def polished(self, values: Values, scene: Scene, guess: Guess, expected: Vector | None = None) -> Fold:
        """The fold near a guess, to 1e-9; it is kept.

        A guess from another sample has the null vector that the fold must resemble. One from the path of this sample
        has a soft mode, which may be a mixture of the modes of several defects: there the inertia decides.

        Raises
        ------
        FoldLost
            If none is found, or it is not seen to be the first instability.
        """
        fold = find_fold(scene.newton, guess, "pressure")
        refuse_later(scene, fold, fold.phi if expected is None else expected)
        self._known = [*self._known, _Known(values, chart(scene), fold.state.u, fold.value, fold.phi)][-MOST:]
        return fold

    def follow(self, values: Values, scene: Scene) -> Fold:
        """The fold of a sample, from the nearest known one on its mesh.

        Raises
        ------
        FoldLost
            If no known fold is on this mesh; and see `polished`.
        """
        given = scene.unloaded().mu
        if given.keys() - {"pressure", "lambda_m"}:
            raise FoldLost("other amplitudes are driven before the pressure")
        if "lambda_m" in given:
            given = given | {"lambda_m": scene.case.lambda_m}
        nodes = chart(scene)
        for known in sorted(self._known, key=lambda known: self._distance(values, known.values)):
            order = matching(known.nodes, nodes) if known.nodes.shape == nodes.shape else None
            if order is None:
                continue
            u, phi = (v.reshape(len(nodes), -1)[order].ravel() for v in (known.u, known.phi))
            return self.polished(values, scene, Guess(State(u, given | {"pressure": known.pressure}), phi), phi)
        raise FoldLost("no fold is known on this mesh")

    def _distance(self, a: Values, b: Values) -> float:
        """The distance of two samples, each number over its scatter; with other words infinite."""
        total = 0.0
        for key in a.keys() | b.keys():
            x, y = a.get(key), b.get(key)
            if x == y:
                continue
            if not isinstance(x, float | int) or not isinstance(y, float | int):
                return np.inf
            numbers = [v for known in self._known if isinstance(v := known.values.get(key), float | int)]
            total += ((x - y) / (float(np.std([*numbers, x])) or 1.0)) ** 2
        return total
