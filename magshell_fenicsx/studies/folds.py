"""Folds of the pressure, followed from case to case.

They are followed along a parameter, or from the nearest case whose fold is known.

A fold is a state at which the pressure is stationary along the path, found by Newton's method for
the state and the null vector phi of its tangent. An amplitude is a load parameter, by name; mu has
those of a state, and u is the displacement. A scene is the model of a case with its solver. The
inertia is the number of unstable directions. A sample is a random case, its values what was drawn.
A strength is the size of a load that the case gives, as that of a magnetic field.
"""

import json
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.fold import Fold, FoldGuess, FoldLost, find_fold, predict_fold
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.stability_monitor import unstable_count
from magshell_fenicsx.continuation.system import State, Vector, dot
from magshell_fenicsx.output.store.table import Row
from magshell_fenicsx.runs.summary import Result
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.perfect import with_modes
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.scene_cache import SceneCache, with_strengths
from magshell_fenicsx.simulate.transfer import chart, matching, same_mesh, transfer
from magshell_fenicsx.studies.ensemble.samples import Values
from magshell_fenicsx.studies.points import Case

Array = NDArray[np.float64]
MAX_PREDICTOR_FOLDS = 3  # folds of one continuation, for a quadratic extrapolation
MOST_FOLDS = 20  # that are kept of earlier samples
LEAST_COSINE = 0.5  # between successive null vectors; a smaller value means a jump to another fold


def has_knockdown(case: Case) -> bool:
    """Return whether a case ends at a fold of the pressure that can be followed to others."""
    loading = case.loading
    if getattr(loading, "kind", "") != "pressure":
        return False
    # with a tolerance each point has its own mesh; a mesh file has no chart in which states are
    # transferred
    can_be_transferred = case.mesh.tolerance is None and case.shell.geometry != "mesh"
    # with branches or a target the run may end elsewhere than at its fold
    may_end_elsewhere = bool(loading.branches) or loading.end.bound is not None
    ends_at_fold = loading.until == "limit" and not may_end_elsewhere
    return can_be_transferred and ends_at_fold


def fold_row(scene: Scene, fold: Fold) -> Row:
    """Return a fold as a row of path.csv."""
    row: Row = {"label": "fold", "amplitude": fold.name, **scene.observe(fold.state)}
    row |= {"mode": "", "branch": 0, "load_error": 0.0}
    return {**row, **scene.sizes.values(row)}


def refuse_later(scene: Scene, fold: Fold, reference_mode: Vector) -> None:
    """Check that a fold is the first instability under growing pressure, as far as its state shows.

    Parameters
    ----------
    reference_mode
        The null vector of the fold that it was continued from, which its own must resemble.

    Raises
    ------
    FoldLost
        If its null vector is another, it is no maximum, or the shell is unstable there in another
        direction.
    """
    comm, mode = scene.newton.system.comm, fold.phi
    # the cosine of the angle between both null vectors must be large
    product = dot(comm, mode, reference_mode)
    squared_lengths = dot(comm, mode, mode) * dot(comm, reference_mode, reference_mode)
    if product < LEAST_COSINE * np.sqrt(squared_lengths):
        raise FoldLost("another fold was found")
    if fold.value <= 0 or fold.curvature >= 0:
        raise FoldLost("the fold is not a maximum of the pressure")
    # the first access to modes that a reduced model excludes is collective
    if fold.unstable or unstable_count(scene.model.symmetry_breaking_modes, fold.state):
        raise FoldLost("another instability comes before the fold")


def _constant_amplitudes(scene: Scene) -> dict[str, float]:
    """Return name -> value of the amplitudes that are constant while the pressure grows.

    Loads have the strength that the case gives by then; others are as in the unloaded state.
    """
    amplitudes, strengths = dict(scene.unloaded().mu), scene.problem.context.strengths
    return {name: strengths.get(name, value) for name, value in amplitudes.items()}


class Continuation:
    """Follows a fold of the pressure through a parameter p of the case.

    All scenes, models with their solvers, have the same kind of model.

    Attributes
    ----------
    _known
        Pairs (p, fold) of the last folds with their parameters, in the unknowns of the last scene.
    _scene
        The last scene.

    Parameters
    ----------
    p, scene, state
        Parameter, scene and state of the first fold, located by a path; Newton's method refines it.

    Raises
    ------
    FoldLost
        If there is no fold, or if it is not the first instability.
    """

    def __init__(self, p: float, scene: Scene, state: State) -> None:
        fold = find_fold(scene.newton, FoldGuess(state), "pressure")
        refuse_later(scene, fold, fold.phi)  # there is no earlier mode to compare with
        self._known, self._scene = [(p, fold)], scene

    def follow(self, p: float, scene: Scene) -> Fold:
        """Return the fold at another value of the parameter, and keep it for the next prediction.

        Parameters
        ----------
        p, scene
            The value, and the scene at this value.

        Raises
        ------
        FoldLost
            If none is found, or if there is evidence that it is not the first instability.
        """
        # pairs (parameter, known fold) in the unknowns of the new scene; they predict the fold at p
        transferred = [(q, self._transferred(fold, scene)) for q, fold in self._known]
        guess = predict_fold(scene.newton.system, transferred, p, _constant_amplitudes(scene))
        fold = find_fold(scene.newton, guess, "pressure")
        _, last_fold = transferred[-1]
        refuse_later(scene, fold, last_fold.phi)
        self._known, self._scene = [*transferred, (p, fold)][-MAX_PREDICTOR_FOLDS:], scene
        return fold

    def from_here(self) -> "Continuation":
        """Return a continuation that knows the last fold only, for another parameter."""
        continued = copy(self)
        continued._known = self._known[-1:]
        return continued

    def has_mesh_of(self, scene: Scene) -> bool:
        """Return whether a scene has the mesh, and the kind of model, of the last scene."""
        same_model = (
            type(scene.model) is type(self._scene.model)
            and scene.problem.is_half == self._scene.problem.is_half
        )
        return same_model and same_mesh(self._scene, scene)

    def _transferred(self, fold: Fold, scene: Scene) -> Fold:
        """Return a fold of the last scene, interpolated into the unknowns of another scene."""
        u, phi = (transfer(self._scene, scene, v) for v in (fold.state.u, fold.phi))
        return replace(fold, state=State(u, fold.state.mu), phi=phi)


@dataclass(frozen=True)
class _StoredFold:
    """A fold of a sample without its scene.

    Attributes
    ----------
    values
        Key -> drawn value of the sample.
    nodes
        (n, d) coordinates of the nodes in the chart of the surface, to recognise the mesh.
    u, phi
        Displacement and null vector.
    pressure
        Pressure at the fold, over the classical one.
    """

    values: Values
    nodes: Array
    u: Vector
    pressure: float
    phi: Vector


class KnownFolds:
    """Folds of the pressure of earlier samples on this rank.

    From these the folds of other samples on the same mesh are found.

    Attributes
    ----------
    _known
        The last folds, at most `MOST_FOLDS`.
    """

    def __init__(self) -> None:
        self._known: list[_StoredFold] = []

    def refined(
        self, values: Values, scene: Scene, guess: FoldGuess, reference_mode: Vector | None = None
    ) -> Fold:
        """Return the fold near a guess, to 1e-9, and keep it.

        Parameters
        ----------
        values
            Key -> drawn value of the sample.
        reference_mode
            Null vector of another sample's fold, which the fold must resemble. None for a guess on
            the path of this sample. There the fold need not resemble any mode, and the inertia
            alone decides: the soft mode on a path may be a mixture of modes of several defects.

        Raises
        ------
        FoldLost
            If none is found, or it is not seen to be the first instability.
        """
        fold = find_fold(scene.newton, guess, "pressure")
        # it must be the first instability, and resemble the reference; without one, itself
        refuse_later(scene, fold, fold.phi if reference_mode is None else reference_mode)
        stored_fold = _StoredFold(
            values=values,
            nodes=chart(scene),
            u=fold.state.u,
            pressure=fold.value,
            phi=fold.phi,
        )
        self._known = [*self._known, stored_fold][-MOST_FOLDS:]
        return fold

    def follow(self, values: Values, scene: Scene) -> Fold:
        """Return the fold of a sample, from the nearest known fold on its mesh.

        Parameters
        ----------
        values
            Key -> drawn value of the sample.
        scene
            The scene of the sample.

        Raises
        ------
        FoldLost
            If no known fold is on this mesh, none is found from the nearest one, or it is not seen
            to be the first instability.
        """
        amplitudes = _constant_amplitudes(scene)
        if amplitudes.keys() - {"pressure", *scene.problem.context.strengths}:
            raise FoldLost("other amplitudes are driven before the pressure")
        nodes = chart(scene)
        # the nearest known fold on the same mesh is the first and only one that is tried
        for neighbour in sorted(
            self._known, key=lambda neighbour: self._distance(values, neighbour.values)
        ):
            # the same nodes may have other numbers; None if the nodes differ
            node_order = (
                matching(neighbour.nodes, nodes) if neighbour.nodes.shape == nodes.shape else None
            )
            if node_order is None:
                continue
            # displacement and null vector in the order of this scene's nodes
            u, phi = (
                v.reshape(len(nodes), -1)[node_order].ravel() for v in (neighbour.u, neighbour.phi)
            )
            guess = FoldGuess(State(u, amplitudes | {"pressure": neighbour.pressure}), phi)
            return self.refined(values, scene, guess, reference_mode=phi)
        raise FoldLost("no fold is known on this mesh")

    def _distance(self, a: Values, b: Values) -> float:
        """Return the squared distance of two samples; infinite if they differ in a word.

        Each number counts over its standard deviation among the known samples.

        Parameters
        ----------
        a, b
            Key -> drawn value.
        """
        total = 0.0
        for key in a.keys() | b.keys():
            value_a, value_b = a.get(key), b.get(key)
            if value_a == value_b:
                continue
            if not isinstance(value_a, float | int) or not isinstance(value_b, float | int):
                return np.inf
            known_numbers = [
                v
                for known_fold in self._known
                if isinstance(v := known_fold.values.get(key), float | int)
            ]
            # the difference over the standard deviation, which is 1 if all values are the same
            deviation = float(np.std([*known_numbers, value_a])) or 1.0
            total += ((value_a - value_b) / deviation) ** 2
        return total


def result_of_fold(scene: Scene, fold: Fold) -> Result:
    """Return the result of a run whose path has a fold alone, which was found without the path."""
    point = Point(fold.state, fold.value, fold.phi, 0.0, fold.unstable, fold.unstable)
    record = Record("fold", fold.name, point, step=len(scene.problem.programme))
    history = History(located=[record])
    return Result(scene, fold.state, [fold_row(scene, fold)], path_history=history)


def scene_of(case: Case, scenes: SceneCache) -> Scene:
    """Return the scene of a case; cases that differ by the strengths of loads alone share one.

    Raises
    ------
    MeshError
        If the case cannot be meshed.
    """
    scene = scenes.scene_at(
        _apart_from_strength(case), lambda: with_modes(case.problem(), scenes.comm)
    )
    return with_strengths(scene, case.context)


def _apart_from_strength(case: Case) -> str:
    """Return a text of all that determines a scene but the strengths of loads.

    A strength is an amplitude, which a scene can change; one of zero has no terms.
    """
    data = case.model_dump(mode="json") | case.outside
    if case.magnetic:
        data["magnetic"] = case.magnetic.apart_from_strength()
    is_nonzero = {name: bool(strength) for name, strength in case.context.strengths.items()}
    return json.dumps([data, is_nonzero], sort_keys=True)
