"""Instabilities within a thickness of a point force: they are none of the shell, and are not
reported; see `shells.near_points`.
"""

from collections.abc import Callable

from magshell_fenicsx.continuation.modes import NoEigenpair, nearest_to_zero
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import Finding, Point
from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.continuation.watch import Crossing
from magshell_fenicsx.shells.near_points import places_of_point_forces, point_of_mode
from magshell_fenicsx.simulate.stage import Stage


def point_of_crossing(stage: Stage, path: Path, crossing: Crossing) -> str:
    """The point force within a thickness of which an excluded mode is; "" if it is one of the
    shell. Collective."""
    excluded = stage.scene.model.excluded_modes
    assert excluded, "they have crossed"
    family = next(each for each in excluded.families if each.label == crossing.label)

    def mode() -> Vector:
        return nearest_to_zero(family.factor_at(stage.leave(crossing.point.state)))[1]

    return _noted(stage, path, mode, getattr(family, "m", None))


def point_of_instability(stage: Stage, path: Path, label: str, point: Point) -> str:
    """The same of a fold or a bifurcation of the model itself; a fold's mode is the path's
    tangent."""

    def mode() -> Vector:
        if label == "fold":
            return stage.displacement(point.du)
        return stage.displacement(nearest_to_zero(stage.newton.factor_at(point.state))[1])

    return _noted(stage, path, mode)


def _noted(stage: Stage, path: Path, mode: Callable[[], Vector], waves: int | None = None) -> str:
    model = stage.scene.model
    places = places_of_point_forces(model, stage.scene.problem.loads)
    if not places:
        return ""

    def find() -> Finding:
        try:
            return Finding({"at": point_of_mode(model, places, mode(), waves)})
        except NoEigenpair:
            return Finding({"at": ""})

    return str(path.noted(find).values["at"])
