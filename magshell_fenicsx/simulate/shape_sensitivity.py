"""Sensitivities of the amplitude at a fold to the numbers of each imperfection.

They come from central differences of the residual, R_p = (R(r0 + s dr0/dp) - R(r0 - s dr0/dp))/(2 s): where the chart's
nodes stay, r0 alone depends on an imperfection. A rim makes r0 rough in p beside it, but R is smooth in r0.

Differences of folds converge to these derivatives on the same mesh: for depths with the square of their step, for what
moves a rim with the step itself. Between new meshes, whose edges follow the rim, they have the meshes' noise over the
step.
"""

from dataclasses import dataclass, replace
from math import degrees
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.fold import Fold, sensitivity
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.mesh.patch import Deviated, Deviation
from magshell_fenicsx.parts.imperfections.growth import grown_by
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionSection, LocalSection, flaws, in_frame
from magshell_fenicsx.shape.outline import ground_of
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage
from magshell_fenicsx.simulate.transfer import same_mesh, transfer

Array = NDArray[np.float64]
STEP, TINY = 1e-3, 1e-6  # of h, of a width or of the angle of a half-width: for the residual, and for dr0/dp


def to_imperfections(stage: Stage, fold: Fold) -> dict[str, float]:
    """Derivatives by the key of each number below `shell`, angles in degrees; collective.

    A number of a rim that separates patches of a remanence or of a natural shape is left out: the mesh has no place
    for a rim that moves. What a half or a meridian excludes by symmetry is zero.
    """
    case = stage.scene.case
    return {
        f"{key}.{name}": _derivative(stage, fold, key, name)
        for key, section in case.imperfections.items()
        for name in section.parameters
        if _varies(case, section, name)
    }


def _varies(case: Case, section: ImperfectionSection, name: str) -> bool:
    if section.patch and case.patches and name != "amplitude":
        return False
    if not name.startswith("at."):
        return True
    assert isinstance(section, LocalSection)
    spherical = case.shell.geometry in ("hemisphere", "cap") and section.at.point is None
    return spherical and section.at.polar != 0


def _derivative(stage: Stage, fold: Fold, key: str, name: str) -> float:
    scene, size = stage.scene, stage.scene.model.system.size
    if scene.plan.axisymmetric and name.startswith("at."):
        return 0.0
    unit = _unit(scene.case, key, name)
    step, tiny = STEP * unit, TINY * unit
    further, back = (_deviation(scene, changed(scene.case, key, name, c), key) for c in (tiny, -tiny))

    def out_of_balance(change: float) -> float:
        other = reshaped(scene, Along(further, back, change / (2 * tiny)))
        assert same_mesh(scene, other)
        vectors = (fold.state.u, fold.left)
        u, left = (np.concatenate([transfer(scene, other, v[:size]), v[size:]]) for v in vectors)
        moved, system = replace(fold, state=State(u, fold.state.mu), left=left), stage.on(other).newton.system
        return sensitivity(system, moved, system.residual(u, fold.state.mu))

    grown = [
        fold.state.mu[of]
        for of, keys in grown_by(scene.plan.programme, scene.case.imperfections).items()
        if key in keys
    ]
    return (grown or [1.0])[0] * (out_of_balance(step) - out_of_balance(-step)) / (2 * step)


def _unit(case: Case, key: str, name: str) -> float:
    section = case.imperfections[key]
    if name == "width":
        return float(getattr(section, name))
    if name.startswith("at."):
        assert isinstance(section, LocalSection)
        return degrees(section.half_width(case.shell.R_over_h, case.shell.poisson_ratio))
    return 1.0


def changed(case: Case, key: str, name: str, change: float) -> Case:
    """The case with another number of an imperfection, such as "at.polar" of "imperfections.0"."""
    new = _changed(case.imperfections[key], name, change)
    if key == "defect":
        return case.model_copy(update={"shell": case.shell.model_copy(update={"defect": new})})
    whole = [new if other == key else section for other, section in case.imperfections.items()]
    return case.model_copy(update={"shell": case.shell.model_copy(update={"imperfections": whole})})


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


def _deviation(scene: Scene, case: Case, key: str) -> Deviation:
    """The deviation of an imperfection of another case, in the frame of the scene's model."""
    plan, number = scene.plan, list(scene.case.imperfections).index(key)
    flaw = list(flaws(case.imperfections, ground_of(case.shell)).values())[number]  # that has random dimples one by one
    turned = in_frame(flaw.deviation, plan.azimuth)
    return _Mirrored(turned, plan.mirror) if plan.mirror else turned


def reshaped(scene: Scene, deviation: Deviation) -> Scene:
    """The scene on the same mesh in the chart, with one more deviation."""
    plan, model = scene.plan, scene.model

    def moved(embedding: object) -> Deviated:
        assert isinstance(embedding, Deviated)
        return replace(embedding, deviations=(*embedding.deviations, deviation))

    embedding = moved(plan.embedding)
    meridian = plan.meridian and replace(plan.meridian, embedding=moved(plan.meridian.embedding))
    shape = model.midsurface.reshaped(embedding) if model.midsurface else plan.shape
    return Scene(scene.case, scene.comm, replace(plan, embedding=embedding, meridian=meridian, shape=shape))
