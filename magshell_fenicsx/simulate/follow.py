"""The history of a case: the steps of its programme, one after the other."""

from collections.abc import Iterator
from dataclasses import replace

from magshell_fenicsx.case.loads.step import PathStep
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.search import searched
from magshell_fenicsx.simulate.steps import LOCATED, held_by, records_of
from magshell_fenicsx.simulate.touch import refuse_penetration
from magshell_fenicsx.simulate.transient import released
from magshell_fenicsx.simulate.walked import Walked


def follow(scene: Scene, *, search: bool = True) -> Iterator[Record]:
    """Compute the history of a scene; yields every accepted point.

    Parameters
    ----------
    search
        Whether steps search for the further solutions that they request.

    Raises
    ------
    Stopped
        If a path is lost, a step before the last ends at an instability, or the field alone makes the shell unstable.
    """
    state, steps = scene.unloaded(), scene.case.programme
    pivots = scene.newton.factor_at(state).negative_pivots
    yield Record("start", "", Point(state, 0.0, 0.0 * state.u, 0.0, pivots, pivots, 0, 1))
    if pivots:
        raise Stopped(
            f"the undeformed shell is unstable in {pivots} directions: mesh.penalty is too small or the mesh too coarse"
        )
    for step in steps:
        where = f"step {step.number} of {len(steps)} ({step.kind}): " if isinstance(scene.case.loading, list) else ""
        scene.progress.beginning(step.number)
        walked, last, record = Walked(records_of(scene, step, state)), "", None
        try:
            for record in walked:
                last = record.label
                yield replace(record, step=step.number)
                refuse_penetration(scene, record.point.state)
            if isinstance(step.load, PathStep) and step.load.then == "snap" and record:
                walked = Walked(released(scene, step.load.snap, record, held_by(scene, step, record.point.state)))
                for record in walked:
                    last = record.label
                    yield replace(record, step=step.number)
                    refuse_penetration(scene, record.point.state)
        except Stopped as e:
            raise Stopped(f"{where}{e}") from None
        begin, state = state, walked.end
        for record in searched(scene, step, begin, state) if search else ():
            yield replace(record, step=step.number)
        if step is not steps[-1] and step.until in ("limit", "bifurcation") and last in LOCATED:
            raise Stopped(f"{where}ends at a {last}, from which the next step cannot start")
