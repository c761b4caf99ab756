"""Folds of the pressure, followed from case to case: along a parameter, or from the nearest case
that is known.
"""

import json
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.fold import Fold, FoldGuess, FoldLost, find_fold, predict_fold
from magshell_fenicsx.continuation.system import State, Vector, dot
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.simulate.perfect import with_modes
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.transfer import chart, matching, same_mesh, transfer
from magshell_fenicsx.studies.runner import Case
from magshell_fenicsx.studies.samples import Values

Array = NDArray[np.float64]
MAX_PREDICTOR_FOLDS = 3  # folds of one continuation, for a quadratic extrapolation
MOST_FOLDS = 20  # that are kept of earlier samples
MOST_UNKNOWNS = 200_000  # of all kept scenes: 1 GB with their factors
LEAST_COSINE = 0.5  # between successive null vectors; a smaller value means a jump to another fold


def has_knockdown(case: Case) -> bool:
    """Whether its result is a fold of the pressure that can be followed to another case."""
    loading = case.loading
    # with a tolerance each point has its own mesh; a mesh file has no chart in which states are
    # transferred
    by_one_mesh = case.mesh.tolerance is None and case.shell.geometry != "mesh"
    if getattr(loading, "kind", "") != "pressure":
        return False
    # where the way ends before a fold, none is to be followed there
    return (
        by_one_mesh
        and loading.until == "limit"
        and not loading.branches
        and loading.limit_target is None
    )


def fold_row(scene: Scene, fold: Fold) -> Row:
    """A fold as a row of path.csv."""
    row: Row = {"label": "fold", "amplitude": fold.name, **scene.observe(fold.state)}
    row |= {"mode": "", "branch": 0, "load_error": 0.0}
    return {**row, **scene.sizes.values(row)}


def refuse_later(scene: Scene, fold: Fold, reference_mode: Vector) -> None:
    """Reject a fold that is not the first instability under growing pressure, as far as this state
    shows.

    Parameters
    ----------
    reference_mode
        The null vector of the fold that it was continued from.

    Raises
    ------
    FoldLost
        If its null vector is another, it is no maximum, or the shell is unstable there in another
        direction.
    """
    comm, a, b = scene.newton.system.comm, fold.phi, reference_mode
    if dot(comm, a, b) < LEAST_COSINE * np.sqrt(dot(comm, a, a) * dot(comm, b, b)):
        raise FoldLost("another fold was found")
    if fold.value <= 0 or fold.curvature >= 0:
        raise FoldLost("the fold is not a maximum of the pressure")
    modes = scene.model.symmetry_breaking_modes
    if fold.unstable or (modes and modes.is_unstable(fold.state)):
        raise FoldLost("another instability comes before the fold")


def _held_amplitudes(scene: Scene) -> dict[str, float]:
    """The amplitudes beside the pressure, the field in full."""
    amplitudes = dict(scene.unloaded().mu)
    return amplitudes | ({"lambda_m": scene.problem.lambda_m} if "lambda_m" in amplitudes else {})


class Continuation:
    """Follows a fold of the pressure through a parameter p of the case.

    All scenes have the same kind of model. The known folds are stored in the unknowns of the last
    scene.

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
        fold = find_fold(scene.newton, FoldGuess(state), "pressure")
        refuse_later(scene, fold, fold.phi)
        self._known, self._scene = [(p, fold)], scene

    def follow(self, p: float, scene: Scene) -> Fold:
        """The fold at another value of the parameter.

        Raises
        ------
        FoldLost
            If none is found, or if there is evidence that it is not the first instability.
        """
        transferred = [(q, self._transferred(fold, scene)) for q, fold in self._known]
        guess = predict_fold(scene.newton.system, transferred, p, _held_amplitudes(scene))
        fold = find_fold(scene.newton, guess, "pressure")
        refuse_later(scene, fold, transferred[-1][1].phi)
        self._known, self._scene = [*transferred, (p, fold)][-MAX_PREDICTOR_FOLDS:], scene
        return fold

    def from_here(self) -> "Continuation":
        """A continuation that knows the last fold only, in which another parameter may vary."""
        continued = copy(self)
        continued._known = self._known[-1:]
        return continued

    def has_mesh_of(self, scene: Scene) -> bool:
        """Whether a scene has the mesh of the last one."""
        same_model = (
            type(scene.model) is type(self._scene.model)
            and scene.problem.is_half == self._scene.problem.is_half
        )
        return same_model and same_mesh(self._scene, scene)

    def _transferred(self, fold: Fold, scene: Scene) -> Fold:
        u, phi = (transfer(self._scene, scene, v) for v in (fold.state.u, fold.phi))
        return replace(fold, state=State(u, fold.state.mu), phi=phi)


@dataclass(frozen=True)
class _StoredFold:
    """A fold without its scene: the drawn values, the nodes in the chart, displacement, pressure
    and null vector.
    """

    values: Values
    nodes: Array
    u: Vector
    pressure: float
    phi: Vector


class KnownFolds:
    """Folds of the pressure of earlier samples on this rank, from which those of others on the same
    mesh are found.
    """

    def __init__(self) -> None:
        self._known: list[_StoredFold] = []

    def refined(
        self, values: Values, scene: Scene, guess: FoldGuess, reference_mode: Vector | None = None
    ) -> Fold:
        """The fold near a guess, to 1e-9; it is kept.

        A guess from another sample has the null vector that the fold must resemble. One from the
        path of this sample has a soft mode, which may be a mixture of the modes of several defects:
        there the inertia decides.

        Raises
        ------
        FoldLost
            If none is found, or it is not seen to be the first instability.
        """
        fold = find_fold(scene.newton, guess, "pressure")
        refuse_later(scene, fold, fold.phi if reference_mode is None else reference_mode)
        self._known = [
            *self._known,
            _StoredFold(values, chart(scene), fold.state.u, fold.value, fold.phi),
        ][-MOST_FOLDS:]
        return fold

    def follow(self, values: Values, scene: Scene) -> Fold:
        """The fold of a sample, from the nearest known one on its mesh.

        Raises
        ------
        FoldLost
            If no known fold is on this mesh; and see `refined`.
        """
        amplitudes = _held_amplitudes(scene)
        if amplitudes.keys() - {"pressure", "lambda_m"}:
            raise FoldLost("other amplitudes are driven before the pressure")
        nodes = chart(scene)
        for neighbour in sorted(
            self._known, key=lambda neighbour: self._distance(values, neighbour.values)
        ):
            order = (
                matching(neighbour.nodes, nodes) if neighbour.nodes.shape == nodes.shape else None
            )
            if order is None:
                continue
            u, phi = (
                v.reshape(len(nodes), -1)[order].ravel() for v in (neighbour.u, neighbour.phi)
            )
            return self.refined(
                values,
                scene,
                FoldGuess(State(u, amplitudes | {"pressure": neighbour.pressure}), phi),
                phi,
            )
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
            numbers = [
                v
                for located in self._known
                if isinstance(v := located.values.get(key), float | int)
            ]
            total += ((x - y) / (float(np.std([*numbers, x])) or 1.0)) ** 2
        return total


class Scenes:
    """The scenes of a rank; cases that differ by the strength of the field alone share one.

    Those that were used last are kept.
    """

    def __init__(self) -> None:
        self._kept: dict[str, Scene] = {}

    def scene_of(self, case: Case) -> Scene:
        """The scene of a case, made anew if none is kept.

        Raises
        ------
        MeshError
            If it cannot be meshed.
        """
        key = _apart_from_strength(case)
        earlier_scene = self._kept.pop(key, None)
        if earlier_scene:
            scene = earlier_scene.with_field_strength(case.context)
        else:
            scene = Scene(with_modes(case.problem(), MPI.COMM_SELF), MPI.COMM_SELF)
        self._kept[key] = scene
        while (
            sum(scene_in_use.newton.system.size for scene_in_use in self._kept.values())
            > MOST_UNKNOWNS
            and len(self._kept) > 1
        ):
            self._kept.pop(next(iter(self._kept)))
        return scene


def _apart_from_strength(case: Case) -> str:
    """Return a key of all that determines a scene, except the size of lambda_m, which is a load
    amplitude.
    """
    data = case.model_dump(mode="json") | case.outside
    if magnetic := data.get("magnetic"):
        # then their ratio counts
        has_both = magnetic["susceptibility"] is not None and magnetic["remanent"] is not None
        magnetic.pop("lambda_m", None)
        if magnetic["remanent"] and not has_both:
            magnetic["remanent"].pop("flux_density", None)
        if not case.sources:  # otherwise it is that of the field beside them
            magnetic["applied"].pop("flux_density", None)
    return json.dumps([data, bool(case.lambda_m)], sort_keys=True)
