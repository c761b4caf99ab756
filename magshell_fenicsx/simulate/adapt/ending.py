"""The end of a run, and the same end on another mesh without computing the path."""

from dataclasses import dataclass, field, replace
from typing import Literal

from magshell_fenicsx.continuation.control import GivenConjugate, GivenLoad, Row
from magshell_fenicsx.continuation.fold import FoldLost, Guess, find_fold
from magshell_fenicsx.continuation.system import State, System, Vector
from magshell_fenicsx.simulate.adapt.carry import NotCarried, carry
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene

FIELDS = ("lambda_m", "angle")  # amplitudes whose value is prescribed


class NoResult(RuntimeError):
    """A run has no scalar result that could be compared between meshes; the message has the reason."""


@dataclass(frozen=True)
class Ending:
    """The end of a run.

    Attributes
    ----------
    kind
        A fold or a target can be computed directly; a target with another conjugate held ("held") and another
        instability need the path.
    name
        The amplitude that varied.
    value
        The result of the run: the amplitude at an instability. At a target, the amplitude if the conjugate
        displacement is prescribed (force at a depth, pressure at a volume), else the conjugate displacement.
    tangent
        Tangent of the path in u; at a fold the null vector. It is the weight of an error of u in the value.
    held
        The prescribed conjugate displacement; None if the load is prescribed.
    """

    kind: Literal["fold", "target", "held", "instability"]
    name: str
    value: float
    state: State
    tangent: Vector
    held: float | None = None


@dataclass
class History:
    """The records of a run that its end depends on.

    `begins` are the last ones before each step, `begin` that before the last one,
    `last` the last one that is no instability, `end` the last one of all.
    """

    last: Record | None = None
    end: Record | None = None
    begin: Record | None = None
    located: list[Record] = field(default_factory=list)
    begins: dict[int, Record] = field(default_factory=dict)

    def add(self, record: Record) -> None:
        if record.branch:
            return
        self.end = record
        if self.last and record.step != self.last.step:
            self.begins.setdefault(record.step, self.last)
        if record.label in ("fold", "bifurcation"):
            self.located.append(record)
        else:
            if self.last and record.step != self.last.step:
                self.begin = self.last
            self.last = record

    def ending(self, scene: Scene, stopped: str | None) -> Ending:
        """The first instability; the last one with `until: bifurcation`; the last target with a target.

        Raises
        ------
        NoResult
            If the history stopped before its target and not at an instability, or has no load.
        """
        steps = scene.plan.programme
        until = steps[-1].until if steps else "target"
        if (
            until in ("target", "points", "zero")
            and not stopped
            and self.last
            and self.last.amplitude not in ("", "time")
        ):
            found = _target(scene, self.last)
            return replace(found, kind="held") if any(how != "load" for how in steps[-1].load.hold.values()) else found
        if self.last and self.last.amplitude == "time":
            raise NoResult("a motion ends at no single load")
        if not self.located:
            raise NoResult(stopped or "the case has neither a load nor a field")
        in_last = [record for record in self.located if record.step == self.located[-1].step]
        end = in_last[-1 if until == "bifurcation" else 0]
        if end.amplitude not in end.point.state.mu:
            raise NoResult("an instability of a turning field is not a single load")
        own_fold = end.label == "fold" and not end.mode
        value = end.point.state.mu[end.amplitude]
        return Ending("fold" if own_fold else "instability", end.amplitude, value, end.point.state, end.point.du)


def by_path(scene: Scene) -> Ending:
    """The end of a scene by computing its whole history.

    Raises
    ------
    NoResult
        See `History.ending`.
    """
    history, stopped = History(), None
    try:
        for record in follow(scene, search=False, remark=lambda text: None):
            history.add(record)
    except Stopped as e:
        stopped = str(e)
    return history.ending(scene, stopped)


def from_near(scene: Scene, source: Scene, near: Ending) -> Ending:
    """The end of a scene by Newton's method from the end on another mesh; if this fails, by the path.

    Raises
    ------
    NoResult
        See `History.ending`.
    """
    if near.kind in ("held", "instability"):
        return by_path(scene)
    try:
        u, tangent = (carry(source, scene, v) for v in (near.state.u, near.tangent))
    except NotCarried:
        return by_path(scene)
    guess = State(u, dict(near.state.mu))
    is_fold = near.kind == "fold"
    found = _fold(scene, Guess(guess, tangent), near.name) if is_fold else _equilibrium(scene, guess, near)
    return found or by_path(scene)


def _fold(scene: Scene, guess: Guess, name: str) -> Ending | None:
    try:
        fold = find_fold(scene.newton, guess, name)
    except FoldLost:
        return None
    return None if fold.unstable else Ending("fold", name, fold.value, fold.state, fold.phi)


def _equilibrium(scene: Scene, guess: State, near: Ending) -> Ending | None:
    newton, system, name, held = scene.newton, scene.newton.system, near.name, near.held
    row: Row = GivenLoad(name, guess.mu[name]) if held is None else GivenConjugate(system, name, held)
    outcome = newton.solve(guess, name, row)
    if not outcome.converged:
        return None
    state = outcome.state
    tangent = newton.response(state, name, row, exact=True).du
    return Ending("target", name, _value(system, state, name, held), state, tangent, held)


def _target(scene: Scene, record: Record) -> Ending:
    system, state, target = scene.newton.system, record.point.state, scene.plan.programme[-1].load.target
    name = "lambda_across" if record.amplitude == "angle" else record.amplitude
    by_conjugate = target is None or target[0].quantity == "conjugate"
    held = -system.potential(state.u, state.mu, name) if by_conjugate and record.amplitude not in FIELDS else None
    return Ending("target", name, _value(system, state, name, held), state, record.point.du, held)


def _value(system: System, state: State, name: str, held: float | None) -> float:
    return state.mu[name] if held is not None else -system.potential(state.u, state.mu, name)
