"""Further solutions at the amplitudes of a known state, by deflation."""

import time
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property, partial

from magshell_fenicsx.continuation.control import GivenLoad
from magshell_fenicsx.continuation.path import StepOptions
from magshell_fenicsx.continuation.search import Limits, Settling, further
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.parts.course import SearchSection
from magshell_fenicsx.parts.step import ProgrammeStep
from magshell_fenicsx.simulate.guesses import dented
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.stage import Stage, plain, staged
from magshell_fenicsx.simulate.steps import held_by


def searched(scene: Scene, step: ProgrammeStep, begin: State, end: State) -> Iterator[Record]:
    """The solutions that the search of a step finds at its end, if the case requests one.

    Parameters
    ----------
    begin, end
        The states at both ends of the step.
    """
    if step.load.search:
        held = held_by(scene, step, begin)
        name = step.name if step.name in end.mu else "lambda_m"  # of a turning field
        for record in _solutions(staged(scene, end, held), name, end, step.load.search):
            yield replace(record, amplitude=step.name)


def solutions(
    scene: Scene,
    known: Record | State,
    *,
    most: int = 3,
    guesses: int = 12,
    stable: bool = False,
    seconds: float | None = None,
) -> Iterator[Record]:
    """Further equilibria at the amplitudes of a known one, such as snapped shapes; all amplitudes are loads.

    Every one is confirmed by Newton's method, and differs from all others. There may be more.

    Parameters
    ----------
    most
        Largest number of solutions.
    guesses, stable, seconds
        See `SearchSection`.

    Raises
    ------
    Stopped
        If the known state is no equilibrium.
    """
    state = known.point.state if isinstance(known, Record) else known
    scene.refuse_foreign(state)
    name = known.amplitude if isinstance(known, Record) and known.amplitude in state.mu else next(iter(state.mu))
    rest = scene.newton.solve(state, name, GivenLoad(name, state.mu[name]))
    if not rest.converged:
        raise Stopped(f"there is no equilibrium to start from near the given state: {rest.reason}")
    search = SearchSection(solutions=most, guesses=guesses, stable=stable, seconds=seconds)
    yield from _solutions(plain(scene), name, rest.state, search)


def _solutions(stage: Stage, name: str, state: State, search: SearchSection) -> Iterator[Record]:
    scene, start = stage.scene, time.perf_counter()
    dents = _Dents(stage, state)

    def over() -> bool:
        late = search.seconds is not None and time.perf_counter() - start > search.seconds
        return bool(scene.comm.bcast(late))

    path = stage.path(name, "load", StepOptions(1.0, 1.0, 1.0))
    made = [partial(dents.settled, number) for number in range(dents.count)]
    limits = Limits(search.solutions, search.guesses, over)
    excluded = scene.model.excluded_modes
    descend = dents.descended if search.stable else None
    for number, found in enumerate(further(path, stage.enter(state), made, limits, stage.displaced, descend), 1):
        point = stage.point(found)
        unstable = sum(excluded.counts(point.state)) if excluded else 0
        yield Record("solution", name, point, branch=number, excluded_pivots=unstable)


class _Dents:
    """Dented shells that have settled, as states of a stage."""

    def __init__(self, stage: Stage, state: State) -> None:
        self._stage, self._state = stage, state
        self._guesses = list(dented(stage.scene, state))
        self.count = len(self._guesses)

    @cached_property
    def _settling(self) -> Settling:
        return Settling(self._stage.scene.model.system, self._stage.scene.unloaded())

    def settled(self, number: int) -> State:
        return self._stage.enter(self._settling.settled(self._guesses[number]))

    def descended(self, state: State) -> State:
        """A state of the stage further down in energy; amplitudes whose conjugates are held stay."""
        return self._stage.enter(self._settling.settled(self._stage.leave(state)))
