"""A scene in one number of its case: the systems of `continuation.boundary`, and the instability
where it starts.

A number that only amplitudes depend on (a field, a stiffness, the factor of an earlier step) stays
in one scene. Every other one has a scene for each value, on the same mesh in the chart; where the
chart changes its size, the mesh with it. Of meridians these scenes share forms and kernels
(`renumbered`).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from math import isclose

import numpy as np

from magshell_fenicsx.continuation.augmented import BoundaryPoint, Kind, NoSystem
from magshell_fenicsx.continuation.boundary import BoundaryLost
from magshell_fenicsx.continuation.factor import Factorisation
from magshell_fenicsx.continuation.fold import times_tangent
from magshell_fenicsx.continuation.modes import NoEigenpair, critical_mode
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.system import State, Vector, max_abs
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.problem.columns import own_amplitudes
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.shells.waves import Waves
from magshell_fenicsx.simulate.numbers import alike, box_of, on_mesh_of
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.renumbered import Renumbered
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.sensitivity import stage_at
from magshell_fenicsx.simulate.stage import Stage
from magshell_fenicsx.simulate.steps import LOCATED
from magshell_fenicsx.simulate.transfer import transfer

Again = Callable[[float], Problem]
STEP = 1e-4  # of the range: of differences by p
# of the range: how far the test looks whether a number has influence, and whether by amplitudes
# alone
ASIDE = 0.1
SAME = 1e-10  # relative differences of forces that are rounding
SHARED = 1e-7  # differences of forces in shared forms, over their change by the number
KEPT = 8  # scenes
WAVES = "m = "
NO_WORK = 1e-3  # of a load along a mode, over both lengths: it is then no fold
SOLVES = 4  # inverse iterations for waves that are nearly neutral


class NoInstability(CaseError):
    """The case ends without an instability."""


class Excluded(CaseError):
    """The instability is one that the model excludes."""


class NoInfluence(CaseError):
    """The number changes nothing at the instability."""


def instability(records: Sequence[Record]) -> Record:
    """The first instability of a history's last step, which ends its case.

    Raises
    ------
    NoInstability
        If there is none.
    """
    own = [record for record in records if not record.branch]
    located = [record for record in own if record.label in LOCATED and record.step == own[-1].step]
    if not located:
        raise NoInstability(
            "the case ends without an instability, and a boundary is that of a fold or a bifurcation: give its last "
            "step until: limit, and a load that reaches one"
        )
    return located[0]


def refuse_excluded(mode: str) -> None:
    """See that a model has the mode of an instability.

    Raises
    ------
    Excluded
        If it has not.
    """
    if mode.startswith(WAVES) or mode == "antisymmetric":
        raise Excluded(
            f"the instability is one that the model excludes ({mode}): take symmetry: none"
        )


class Varied:
    """A `continuation.augmented.SystemFamily` of scenes.

    Parameters
    ----------
    scene, record
        The scene at `value`, and its instability.
    again
        Makes the problem at a value.
    ends
        The range of values.

    Attributes
    ----------
    kind, name
        Of the instability, and the amplitude in which it is.
    mode
        As of the record.
    m
        Number of waves around a meridian; 0: the mode is one of the model itself.
    alone
        Whether only amplitudes depend on the number.

    Raises
    ------
    CaseError
        If the number has no influence, or the instability cannot be followed.
    """

    def __init__(
        self, scene: Scene, record: Record, again: Again, value: float, ends: tuple[float, float]
    ) -> None:
        self.kind: Kind = "fold" if record.label == "fold" else "bifurcation"
        self.name, self.mode = record.amplitude, record.mode
        self.m = int(record.mode.removeprefix(WAVES)) if record.mode.startswith(WAVES) else 0
        self._again, self._ends, self._record = again, ends, record
        self._problems: dict[float, Problem] = {}
        self._stages: dict[float, Stage] = {}
        self._shared: Renumbered | None = None
        self._line: tuple[float, dict[str, float], dict[str, float]] | None = None
        self._refuse_unknown(scene)
        self._origin, self.alone = scene, False
        self._aside = self._value_aside(value)
        base = self._origin if self._origin is not scene else self._scene(value)
        self._first = replace(
            record, point=replace(record.point, state=self._state_in(base, value))
        )
        self._record_value = value
        self._stages[value] = self._base = stage_at(base, self._first)
        self.alone = self._by_amplitudes_alone(value)
        if not self.alone:
            self._share(value)
        self._line = self._affine(value, self._aside) if self.alone else None

    def _affine(
        self, a: float, b: float
    ) -> tuple[float, dict[str, float], dict[str, float]] | None:
        """A value, the amplitudes there and their rates, if they are linear in the value: no
        problem is made then.
        """
        low, middle, high = (self._mu(p) for p in (a, (a + b) / 2, b))
        if all(
            isclose(2 * middle[name], low[name] + high[name], rel_tol=1e-12, abs_tol=1e-300)
            for name in low
        ):
            return a, low, {name: (high[name] - low[name]) / (b - a) for name in low}
        return None

    def _value_aside(self, value: float) -> float:
        """Another value, to compare forces there.

        A term that is zero at the start, as a field may be, is there.
        """
        low, high = self._ends
        step = ASIDE * (high - low)
        others = [other for other in (value + step, value - step) if low <= other <= high]
        names = self._origin.unloaded().mu.keys()
        scenes = {other: self._scene(other) for other in others}
        own = {other: made.unloaded().mu.keys() for other, made in scenes.items()}
        aside = max(others, key=lambda other: len(own[other]))
        if own[aside] > names:  # its scene serves all values
            u, mu = (
                transfer(self._origin, scenes[aside], self._record.point.state.u),
                dict(self._record.point.state.mu),
            )
            self._origin = scenes[aside]
            new = {
                name: self._origin.problem.lambda_m if name == "lambda_m" else 0.0
                for name in own[aside] - names
            }
            point = replace(self._record.point, state=State(u, mu | new))
            self._record = replace(
                self._record, point=point, step=len(self._origin.problem.programme)
            )
            return (
                min(others, key=lambda other: other == aside)
                if len(others) > 1
                else (value + aside) / 2
            )
        return aside

    def _refuse_unknown(self, scene: Scene) -> None:
        record, programme = self._record, scene.problem.programme
        if not (self.m and scene.model.axisymmetric):
            refuse_excluded(record.mode)
        earlier = programme[: record.step - 1]
        step = programme[record.step - 1]
        if earlier and any(how != "load" for how in step.load.hold.values()):
            raise CaseError(
                f"{step.key}.hold: a boundary needs what is held to be held from the start: give one step"
            )
        for each in earlier:
            target = each.load.target or each.load.bound
            if each.load.hold or (target and target[0].quantity == "conjugate"):
                raise CaseError(
                    f"{each.key}: ends at a displacement or a volume, so its load changes along a boundary"
                )

    @cached_property
    def start(self) -> tuple[State, Vector]:
        """The instability in the unknowns of the family, and a null vector.

        Raises
        ------
        CaseError
            If there is no eigenvector.
        """
        state = self._base.enter(self._first.point.state)
        if self.m:
            return state, self.null_vector(self._record_value, state, self.m)
        try:
            return state, critical_mode(self._base.newton, state).vector
        except NoEigenpair as e:
            raise CaseError(f"the instability has no null vector: {e}") from None

    @property
    def excludes(self) -> bool:
        """Whether there are waves around a meridian, which its model excludes."""
        return self._base.scene.model.axisymmetric

    def kind_of(self, m: int, at: BoundaryPoint | None = None) -> Kind:
        """What a boundary of m waves is, or of the model's own mode (m = 0) near a point."""
        if m:
            return "bifurcation"
        if at is None:
            return self.kind
        system, phi = self.solver_at(at.p).system, self.mode_at(at, 0, self.m)
        load = system.load(at.state.u, at.state.mu, self.name)
        return (
            "fold"
            if abs(phi @ load) > NO_WORK * np.linalg.norm(load) * np.linalg.norm(phi)
            else "bifurcation"
        )

    def mode_at(self, crossing: BoundaryPoint, m: int, before: int) -> Vector:
        """The mode of m waves (0: of the model itself) that is neutral, beside that of the boundary
        `before`.

        Raises
        ------
        BoundaryLost
            If there is no eigenvector.
        """
        if not m:
            try:
                return critical_mode(self.solver_at(crossing.p), crossing.state).vector
            except NoEigenpair as e:
                raise BoundaryLost(
                    f"the mode that becomes critical has no null vector: {e}"
                ) from None
        return self.null_vector(
            crossing.p, crossing.state, m, crossing.phi if m == before else None
        )

    def null_vector(self, p: float, state: State, m: int, beside: Vector | None = None) -> Vector:
        """That of m waves at a state where these are neutral, nearly; across another one."""
        factors = self.factored_tangent(p, state, m)
        v = np.sin(1.0 + np.arange(factors.matrix.getLocalSize()[0]))
        for _ in range(SOLVES):
            v = factors.solve(v)
            v = v if beside is None else v - (beside @ v) / (beside @ beside) * beside
            v /= np.linalg.norm(v)
        return v

    def factored_tangent(self, p: float, state: State, m: int) -> Factorisation:
        """See `continuation.symmetry_breaking`."""
        stage = self._at(p)
        return _waves(stage).factor_at(stage.leave(state), m)

    def quadratic_form(self, p: float, state: State, m: int, v: Vector) -> float:
        """See `continuation.symmetry_breaking`."""
        return float(v @ self._times(self._at(p), state, m, v))

    def counts(self, p: float, state: State) -> list[int]:
        """See `continuation.symmetry_breaking`."""
        stage = self._at(p)
        return _waves(stage).counts(stage.leave(state))

    def _times(self, stage: Stage, state: State, m: int, v: Vector) -> Vector:
        """The tangent of m waves times v."""
        K = _waves(stage).tangent(stage.leave(state), m)
        x, y = K.createVecs()
        x.setArray(v)
        K.mult(x, y)
        return np.array(y.array_r)

    def solver_at(self, p: float) -> BorderedNewton:
        """The solver at a value."""
        return self._at(p).newton

    def _at(self, p: float) -> Stage:
        return self._base if self.alone else self._stage(p)

    def amplitudes(self, p: float) -> dict[str, float]:
        """The amplitudes beside that of the instability."""
        return self._fixed(self._at(p), p)

    @property
    def costly(self) -> bool:
        """Whether each value has a scene of its own."""
        return not self.alone

    def difference_weights(self, p: float, *, low_order: bool = False) -> list[tuple[float, float]]:
        """Weights and values of a difference of second order, on the side where values are allowed;
        one of low order is of first order, with one scene beside that of p itself.
        """
        d = STEP * abs(self._ends[1] - self._ends[0])
        if self._line:
            return [(0.5 / d, p + d), (-0.5 / d, p - d)]
        if low_order:
            try:
                self.problem(p + d)
            except NoSystem:
                d = -d
            return [(1 / d, p + d), (-1 / d, p)]
        try:
            for q in (p - d, p + d):
                self.problem(q)
        except NoSystem:
            sign = 1.0
            try:
                self.problem(p + 2 * d)
            except NoSystem:
                sign = -1.0
            return [
                (-1.5 * sign / d, p),
                (2 * sign / d, p + sign * d),
                (-0.5 * sign / d, p + 2 * sign * d),
            ]
        return [(0.5 / d, p + d), (-0.5 / d, p - d)]

    def problem(self, p: float) -> Problem:
        """The problem at a value.

        Raises
        ------
        NoSystem
            If it is not allowed.
        """
        if p not in self._problems:
            try:
                self._problems[p] = self._again(p)
            except CaseError as e:
                raise NoSystem(str(e)) from None
            while len(self._problems) > 4 * KEPT:
                self._problems.pop(next(iter(self._problems)))
        return self._problems[p]

    def _stage(self, p: float) -> Stage:
        stage = self._stages.pop(p, None)
        if stage is None:
            scene = self._scene(p)
            stage = (
                self._base.on(scene)
                if self._base.device or self._base.along
                else Stage(scene, scene.newton)
            )
        self._stages[p] = stage
        while len(self._stages) > KEPT:
            self._stages.pop(next(iter(self._stages)))
        return stage

    def _scene(self, p: float) -> Scene:
        """The scene at a value, on the mesh of the first one in its chart."""
        old, new = self._origin.problem, self.problem(p)
        if (old.axisymmetric, old.mirror, old.azimuth) != (
            new.axisymmetric,
            new.mirror,
            new.azimuth,
        ):
            raise NoSystem(
                "the symmetry of the model changes on the way: give the case symmetry: none"
            )
        try:
            on_mesh = moved(self._origin, new)
            if self._shared and (scene := self._shared.at(p, on_mesh)):
                return scene
            return Scene(on_mesh, self._origin.comm)
        except MeshError as e:
            raise NoSystem(f"there is no mesh: {e}") from None

    def _state_in(self, base: Scene, p: float) -> State:
        """The record's state in the unknowns of the family, which may be in another order."""
        state = self._record.point.state
        return State(transfer(self._origin, base, state.u), self._mu(p))

    def _mu(self, p: float) -> dict[str, float]:
        """The amplitudes of the model at the instability, those that are given being those of
        another problem.
        """
        if self._line:
            at, amplitudes, rates = self._line
            return {name: v + rates[name] * (p - at) for name, v in amplitudes.items()}
        old, new, mu = self._origin.problem, self.problem(p), dict(self._record.point.state.mu)
        for before, after in zip(
            old.programme[: self._record.step - 1], new.programme, strict=False
        ):
            one, two = (each.load.target or each.load.bound for each in (before, after))
            if (
                one
                and two
                and one[0].quantity == "load"
                and isclose(mu.get(before.name, np.nan), one[1], rel_tol=1e-9)
            ):
                mu[before.name] = two[1]
        given, now = own_amplitudes(old.loads), own_amplitudes(new.loads)
        mu |= {
            name: now[name] for name, v in given.items() if name in now and v and mu.get(name) == v
        }
        if old.lambda_m and new.lambda_m != old.lambda_m:
            ratio = new.lambda_m / old.lambda_m
            mu |= {
                name: ratio * v
                for name, v in mu.items()
                if name.startswith("lambda_") and name != self.name
            }
        return mu

    def _by_amplitudes_alone(self, value: float) -> bool:
        """Whether the forces of another value are those of other amplitudes in the same scene.

        Raises
        ------
        NoInfluence
            If they are the same.
        """
        other, comm = self._aside, self._origin.model.system.comm
        staged = (self._base, value), (self._stage(other), other), (self._base, other)
        before, after, moved_only = (self._forces(stage, p) for stage, p in staged)
        size = max_abs(comm, before) or 1.0
        if max_abs(comm, after - before) <= SAME * size:
            raise NoInfluence("it has no influence on this instability")
        return max_abs(comm, after - moved_only) <= SAME * size

    def _share(self, value: float) -> None:
        """Take the forms of one scene for all values, if the forces of those that have a scene are
        then the same.
        """
        shared = Renumbered.of(self._base.scene)
        if shared is None:
            return
        stages, comm = self._stages, self._origin.model.system.comm
        own = {p: self._forces(stage, p) for p, stage in stages.items()}
        change = max(max_abs(comm, forces - own[value]) for forces in own.values())
        self._shared, self._stages = shared, {}
        off = [max_abs(comm, self._forces(self._stage(p), p) - forces) for p, forces in own.items()]
        if max(off) <= SHARED * change:
            self._base = self._stage(value)
            return
        shared.leave()
        self._shared, self._stages = None, stages

    def _forces(self, stage: Stage, p: float) -> Vector:
        """At the instability, with other numbers: residual, load, and the tangent along the null
        vector.
        """
        system, (state, phi) = stage.newton.system, self.start
        mu = {**self._fixed(stage, p), self.name: state.mu[self.name]}
        here = State(state.u, mu)
        if self.m:
            along = self._times(stage, here, self.m, phi)
        elif (
            stage.scene.model.axisymmetric
        ):  # its matrices cost little, and differences are less exact
            along = stage.newton.factor_at(here).times(phi)
        else:
            along = times_tangent(system, here, phi)
        return np.concatenate(
            [system.residual(state.u, mu), system.load(state.u, mu, self.name), along]
        )

    def _fixed(self, stage: Stage, p: float) -> dict[str, float]:
        mu = stage.enter(State(self._first.point.state.u, self._mu(p))).mu
        return {name: v for name, v in mu.items() if name != self.name}


def _waves(stage: Stage) -> Waves:
    model = stage.scene.model
    assert model.axisymmetric
    return model.waves


def moved(scene: Scene, new: Problem) -> Problem:
    """A problem on the mesh of a scene, which is stretched with the chart."""
    made, old = on_mesh_of(scene, new), scene.problem
    if scene.model.axisymmetric:
        assert old.meridian
        assert new.meridian
        assert made.meridian
        vertices = made.meridian.vertices
        assert vertices is not None
        knots, places = old.meridian.knots, new.meridian.knots
        if knots.shape != places.shape:
            raise NoSystem("a rim of a dimple appears or vanishes on the way")
        return replace(
            made, meridian=replace(made.meridian, vertices=np.interp(vertices, knots, places))
        )
    if scene.model.midsurface and not alike(old.shape, new.shape):
        patch = scene.model.midsurface.with_embedding(new.embedding)
        one, two = box_of(old.shape), box_of(new.shape)
        if one is None or two is None or patch.nodes.shape[1] != 2:
            raise NoSystem("the mesh of this shape cannot move with the number")
        low, size = one[0], one[1] - one[0]
        stretched = two[0] + (patch.nodes - low) / size * (two[1] - two[0])
        return replace(made, shape=replace(patch, nodes=stretched), points=new.points)
    return made
