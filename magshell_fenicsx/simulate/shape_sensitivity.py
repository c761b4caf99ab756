"""Sensitivities of the amplitude at a fold to the numbers of each imperfection.

They come from central differences of the residual, R_p = (R(r0 + s dr0/dp) - R(r0 - s dr0/dp))/(2 s): where the chart's
nodes stay, r0 alone depends on an imperfection. A rim makes r0 rough in p beside it, but R is smooth in r0.

Differences of folds converge to these derivatives on the same mesh: for depths with the square of their step, for what
moves a rim with the step itself. Between new meshes, whose edges follow the rim, they have the meshes' noise over the
step.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import degrees
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.fold import Fold, sensitivity
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.mesh.patch import Deviated, Deviation
from magshell_fenicsx.parts.imperfections.growth import grown_by
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionSection, LocalSection, flaws, in_frame
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.shape.outline import ground_of
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage
from magshell_fenicsx.simulate.transfer import same_mesh, transfer

Array = NDArray[np.float64]
Imperfections: TypeAlias = Mapping[str, ImperfectionSection]
STEP, TINY = 1e-3, 1e-6  # of h, of a width or of the angle of a half-width: for the residual, and for dr0/dp


def to_imperfections(stage: Stage, fold: Fold) -> dict[str, float]:
    """Derivatives by the key of each number below `shell`, angles in degrees; collective.

    A number of a rim that separates patches of a remanence or of a natural shape is left out: the mesh has no place
    for a rim that moves. What a half or a meridian excludes by symmetry is zero.
    """
    problem = stage.scene.problem
    return {
        f"{key}.{name}": _derivative(stage, fold, key, name)
        for key, section in problem.imperfections.items()
        for name in section.parameters
        if _varies(problem, section, name)
    }


def _varies(problem: Problem, section: ImperfectionSection, name: str) -> bool:
    if section.patch and problem.patched and name != "amplitude":
        return False
    if not name.startswith("at."):
        return True
    assert isinstance(section, LocalSection)
    spherical = problem.context.shell.geometry in ("hemisphere", "cap") and section.at.point is None
    return spherical and section.at.polar != 0


def _derivative(stage: Stage, fold: Fold, key: str, name: str) -> float:
    scene, size = stage.scene, stage.scene.model.system.size
    if scene.problem.axisymmetric and name.startswith("at."):
        return 0.0
    problem = scene.problem
    unit = _unit(problem, key, name)
    step, tiny = STEP * unit, TINY * unit
    further, back = (_deviation(scene, changed(problem.imperfections, key, name, c), key) for c in (tiny, -tiny))

    def out_of_balance(change: float) -> float:
        other = reshaped(scene, Along(further, back, change / (2 * tiny)))
        assert same_mesh(scene, other)
        vectors = (fold.state.u, fold.left)
        u, left = (np.concatenate([transfer(scene, other, v[:size]), v[size:]]) for v in vectors)
        moved, system = replace(fold, state=State(u, fold.state.mu), left=left), stage.on(other).newton.system
        return sensitivity(system, moved, system.residual(u, fold.state.mu))

    grown = [
        fold.state.mu[of]
        for of, keys in grown_by(scene.problem.programme, problem.imperfections).items()
        if key in keys
    ]
    return (grown or [1.0])[0] * (out_of_balance(step) - out_of_balance(-step)) / (2 * step)


def _unit(problem: Problem, key: str, name: str) -> float:
    section, shell = problem.imperfections[key], problem.context.shell
    if name == "width":
        return float(getattr(section, name))
    if name.startswith("at."):
        assert isinstance(section, LocalSection)
        return degrees(section.half_width(shell.R_over_h, shell.poisson_ratio))
    return 1.0


def changed(sections: Imperfections, key: str, name: str, change: float) -> Imperfections:
    """Imperfections of which one has another number, such as "at.polar" of "imperfections.0"."""
    return {**sections, key: _changed(sections[key], name, change)}


def _changed(part: Any, path: str, change: float) -> Any:
    """A number, or a section or a list with another number somewhere in it."""
    if not path:
        return part + change
    first, _, rest = path.partition(".")
    if isinstance(part, list):
        return [_changed(item, rest, change) if i == int(first) else item for i, item in enumerate(part)]
    return part.model_copy(update={first: _changed(getattr(part, first), rest, change)})


@dataclass(frozen=True)
class Along:
    """A deviation along the derivative of another one, by the difference of two of its values."""

    further: Deviation
    back: Deviation
    factor: float

    def __call__(self, places: Array) -> Array:
        return np.asarray(self.factor * (self.further(places) - self.back(places)))


@dataclass(frozen=True)
class _Mirrored:
    """The mean of a deviation and its image: what half of a shell sees of it."""

    deviation: Deviation
    mirror: Mirror

    def __call__(self, places: Array) -> Array:
        return np.asarray((self.deviation(places) + self.deviation(self.mirror.image(places))) / 2)


def _deviation(scene: Scene, sections: Imperfections, key: str) -> Deviation:
    """The deviation of one of other imperfections, in the frame of the scene's model."""
    problem, number = scene.problem, list(sections).index(key)
    flaw = list(flaws(sections, ground_of(problem.context.shell)).values())[
        number
    ]  # that has random dimples one by one
    turned = in_frame(flaw.deviation, problem.azimuth)
    return _Mirrored(turned, problem.mirror) if problem.mirror else turned


def reshaped(scene: Scene, deviation: Deviation) -> Scene:
    """The scene on the same mesh in the chart, with one more deviation."""
    problem, model = scene.problem, scene.model

    def moved(embedding: object) -> Deviated:
        assert isinstance(embedding, Deviated)
        return replace(embedding, deviations=(*embedding.deviations, deviation))

    embedding = moved(problem.embedding)
    meridian = problem.meridian and replace(problem.meridian, embedding=moved(problem.meridian.embedding))
    shape = model.midsurface.reshaped(embedding) if model.midsurface else problem.shape
    return Scene(replace(problem, embedding=embedding, meridian=meridian, shape=shape), scene.comm)
