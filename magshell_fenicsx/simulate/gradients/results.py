"""What can be differentiated, by name: columns, shapes, vibrations and barriers at the end of a history."""

from collections.abc import Iterable, Mapping, Sequence

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.simulate.adapt.ending import History
from magshell_fenicsx.simulate.gradients.adjoint import Adjoint, adjoint
from magshell_fenicsx.simulate.gradients.barriers import BARRIER, adjoint_of_barrier, refuse_no_barrier
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS, refuse_unitless
from magshell_fenicsx.simulate.gradients.vibration import (
    FIRST,
    NAMES,
    adjoints_of_vibrations,
    frequency,
    refuse_no_vibration,
    vibration,
)
from magshell_fenicsx.simulate.results import Target, differentiable
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.touch import rigid


def refuse_no_result(scene: Scene, results: Iterable[str], key: str, *, more: Sequence[str] = ()) -> None:
    """See before a history that the results at a key have gradients; `more` are allowed there too.

    Raises
    ------
    CaseError
        With those that have.
    """
    start = scene.unloaded()
    columns = differentiable(scene, start)
    for of in results:
        try:
            refuse_unitless(scene, of)
            if of == BARRIER:
                refuse_no_barrier(scene.problem)
            elif NAMES.fullmatch(of):
                refuse_no_vibration(scene.problem, of)
            elif of not in FOLDS and of not in columns and of not in start.mu:
                known = ", ".join((*FOLDS, *columns, BARRIER, *FIRST, *more))
                raise CaseError(f"{of}: has no gradient here; allowed are {known}")
        except CaseError as e:
            raise CaseError(f"{key}: {e}") from None


def adjoint_at_end(
    scene: Scene, history: History, of: str | Target, hold: Mapping[str, str] | None = None
) -> tuple[str, Adjoint]:
    """The kind of a result ("" of most) at the last point of a history, and its adjoint; collective.

    Raises
    ------
    CaseError
        If there is no such result.
    """
    assert history.end
    if of == BARRIER:
        return "", adjoint_of_barrier(scene, history.begin, history.end, history.begins)
    if isinstance(of, str) and NAMES.fullmatch(of):
        return adjoints_of_vibrations(scene, history.end, of, hold, begins=history.begins)[0]
    return "", adjoint(scene, history.end, of, hold, history.begins)


def vibration_at_end(scene: Scene, history: History, of: str) -> float | None:
    """The frequency of a name; None of another result; collective.

    Raises
    ------
    Lost
        If it cannot be computed.
    """
    if not NAMES.fullmatch(of):
        return None
    assert history.end
    state = rigid(scene, scene.model.system.placed(history.end.point.state))
    return frequency(scene.problem, of, vibration(scene, state, of).value)
