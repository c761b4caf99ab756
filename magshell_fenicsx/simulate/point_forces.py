"""Instabilities within a thickness of a point force, which are not reported.

Their modes are local to the point (within a thickness), where shell theory does not hold, and they
depend on the mesh. Excluded modes are those that break a symmetry of the
model; a family of them shares a tangent; at a crossing one of them becomes neutral. A stage is the
scene with the solver of one step.
"""

from collections.abc import Callable

from magshell_fenicsx.continuation.modes import NoEigenpair, nearest_to_zero
from magshell_fenicsx.continuation.path import Path
from magshell_fenicsx.continuation.point import Point, RecordedValues
from magshell_fenicsx.continuation.stability_monitor import Crossing
from magshell_fenicsx.continuation.system import Vector
from magshell_fenicsx.quantities.mode_labels import waves_of_label
from magshell_fenicsx.shells.near_points import places_of_point_forces, point_of_mode
from magshell_fenicsx.simulate.stage import Stage


def point_of_crossing(stage: Stage, path: Path, crossing: Crossing) -> str:
    """Return the name of a point force, if an excluded mode at its crossing is local to it.

    Local means within a thickness. The name is "" for a mode of the shell. Collective.
    """
    modes = stage.scene.model.symmetry_breaking_modes
    assert modes, "they have crossed"
    family = next(family for family in modes.families if family.label == crossing.label)

    def mode() -> Vector:
        """Return the mode that is neutral at the crossing."""
        _, vector = nearest_to_zero(family.factor_at(stage.leave(crossing.point.state)))
        return vector

    return _recorded_point(stage, path, mode, waves=waves_of_label(crossing.label))


def point_of_instability(stage: Stage, path: Path, label: str, point: Point) -> str:
    """Return the name of a point force, if the mode of an instability is local to it.

    Local means within a thickness. The name is "" for a mode of the shell. The mode of a fold is
    the path's tangent. Collective.

    Parameters
    ----------
    label
        "fold" or "bifurcation".
    point
        The located point.
    """

    def mode() -> Vector:
        """Return the mode as a displacement of the model."""
        if label == "fold":
            return stage.displacement(point.du)
        _, null_vector = nearest_to_zero(stage.newton.factor_at(point.state))
        return stage.displacement(null_vector)

    return _recorded_point(stage, path, mode)


def _recorded_point(
    stage: Stage, path: Path, mode: Callable[[], Vector], waves: int | None = None
) -> str:
    """Return the name of the point force to which a mode is local, or "".

    The answer is recorded in the journal of the run, which a resumed run reads.

    Parameters
    ----------
    mode
        Function that returns the mode; it may raise `NoEigenpair`.
    waves
        Number of waves of the mode around a meridian; None of other modes.
    """
    model = stage.scene.model
    places = places_of_point_forces(model, stage.scene.problem.loads)
    if not places:
        return ""

    def name_of_point() -> RecordedValues:
        """Return the name of the point under the key "point"."""
        try:
            return RecordedValues({"point": point_of_mode(model, places, mode(), waves)})
        except NoEigenpair:
            return RecordedValues({"point": ""})

    return str(path.recorded_values(name_of_point).values["point"])
