"""The history of a case: the natural shape, then the field, then the load."""

from collections.abc import Iterator

from magshell_fenicsx.case.loading import (
    DeadSection,
    FieldSection,
    GrowthSection,
    IndentationSection,
    PressureSection,
    RotationSection,
)
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.simulate import steps
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene


def follow(scene: Scene) -> Iterator[Record]:
    """Compute the history of a scene; yields every accepted point.

    Raises
    ------
    Stopped
        If the path is lost, or the field alone makes the shell unstable.
    """
    state = scene.unloaded()
    pivots = scene.newton.factor_at(state).negative_pivots
    yield Record("start", "", Point(state, 0.0, 0.0 * state.u, 0.0, pivots, pivots, 0, 1))
    if pivots:
        raise Stopped(
            f"the undeformed shell is unstable in {pivots} directions: mesh.penalty is too small or the mesh too coarse"
        )
    loading = scene.case.loading
    if isinstance(loading, GrowthSection):
        yield from steps.natural(scene, loading, state)
        return
    natural = scene.model.loads.natural
    for name in natural.amplitudes if natural else ():
        grows = GrowthSection.model_validate({"kind": "natural", name.removeprefix("natural_"): 1.0})
        for record in steps.natural(scene, grows, state):
            yield record
            state = record.point.state
        if state.mu[name] != 1.0:
            raise Stopped(f"{name} stops at {state.mu[name]:.6g}: the shell becomes unstable as it grows")
    if isinstance(loading, FieldSection):
        yield from steps.field_as_load(scene, loading, state)
        return
    if scene.model.loads.magnetic:
        for record in steps.field(scene, state):
            yield record
            state = record.point.state
    if isinstance(loading, PressureSection):
        yield from steps.pressure(scene, loading, state)
    elif isinstance(loading, IndentationSection):
        yield from steps.indentation(scene, loading, state)
    elif isinstance(loading, DeadSection):
        yield from steps.dead(scene, loading, state)
    elif isinstance(loading, RotationSection):
        yield from steps.rotation(scene, loading, state)
