"""Family of scenes in one number of their case: the systems of `continuation.boundary`.

A number that only amplitudes depend on (a field, a stiffness, the factor of an earlier step) stays
in one scene. Every other one has a scene for each value, on the same mesh in the chart; where the
chart changes its size, the mesh with it. Of meridians these scenes share forms and kernels
(`scene_cache`).

Words and symbols:

- p is the number of the case. A boundary of stability is the curve (mu, p) on which one
  instability, a fold or a bifurcation in the amplitude mu, stays critical; `self.name` is this
  amplitude. All other amplitudes of a state (load parameters, by name) are functions of p.
- A wave has m crests around a meridian; the meridian's own axisymmetric model excludes it, so it
  has a tangent of its own. m = 0 stands for a mode of the model itself.
- A stage is the scene with the solver of the step in which the instability is. `enter` and `leave`
  convert states of the model to states of the stage's system and back. A stage has a device if it
  holds conjugates of amplitudes, and is parametrised if it varies several amplitudes together.
- `transfer(a, b, u)` gives a displacement of scene a in the unknowns of scene b.
- The chart has the coordinates of the undeformed surface. A knot of a meridian is a value of its
  parameter at which cells must end, as at a rim.
- The programme is the list of the case's steps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
from magshell_fenicsx.parts.registered import strength_ratios
from magshell_fenicsx.problem.columns import own_amplitudes
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.mode_labels import breaks_symmetry, waves_of_label
from magshell_fenicsx.shells.waves import Waves
from magshell_fenicsx.simulate.path_records import LOCATED
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.scene_cache import SceneCache, UnfitMesh
from magshell_fenicsx.simulate.stage import Stage
from magshell_fenicsx.simulate.steps import stage_of_record
from magshell_fenicsx.simulate.transfer import transfer

MakeProblem = Callable[[float], Problem]  # from a value of the number
DIFFERENCE_STEP = 1e-4  # of the range: of differences by the number
# of the range: distance of the value at which the influence of the number is tested
TEST_DISTANCE = 0.1
FORCE_TOLERANCE = 1e-10  # relative differences of forces that are rounding
# differences of forces in shared forms, over their change by the number
SHARED_FORMS_TOLERANCE = 1e-7
MAX_STAGES = 8  # that are remembered
MAX_PROBLEMS = 4 * MAX_STAGES
# work of a load along a mode, over the lengths of both: with less it is no fold
MIN_FOLD_WORK = 1e-3
INVERSE_ITERATIONS = 4  # for waves that are nearly neutral
LINEARITY_TOLERANCE = 1e-12  # relative: amplitudes that depend on the number
TINY_AMPLITUDE = 1e-300


class NoInstability(CaseError):
    """The case ends without an instability."""


class ExcludedInstability(CaseError):
    """The instability is one that the model excludes."""


class NoInfluence(CaseError):
    """The number changes nothing at the instability."""


def first_instability(records: Sequence[Record]) -> Record:
    """Return the first instability of a history's last step, from which a boundary is followed.

    Parameters
    ----------
    records
        Rows of a history in order; those of branches do not count.

    Raises
    ------
    NoInstability
        If the last step has no located fold or bifurcation.
    """
    records_of_path = [record for record in records if not record.branch]
    last_step = records_of_path[-1].step if records_of_path else 0
    instabilities = [
        record for record in records_of_path if record.label in LOCATED and record.step == last_step
    ]
    if not instabilities:
        raise NoInstability(
            "the case ends without an instability, and a boundary is that of a fold or a "
            "bifurcation: give its last step until: limit, and a load that reaches one"
        )
    return instabilities[0]


def refuse_excluded_mode(mode: str) -> None:
    """Check that the model itself has the mode of an instability.

    Parameters
    ----------
    mode
        Name of the mode: "m = 7" and "antisymmetric" are modes that a reduced
        model excludes.

    Raises
    ------
    ExcludedInstability
        If the model excludes it.
    """
    if breaks_symmetry(mode):
        raise ExcludedInstability(
            f"the instability is one that the model excludes ({mode}): take symmetry: none"
        )


@dataclass(frozen=True)
class _LinearAmplitudes:
    """Amplitudes that are linear in the number p, so that no problem is made for its values.

    Attributes
    ----------
    value
        A value of p.
    amplitudes
        Amplitude -> its value at this p.
    rates
        Amplitude -> its derivative by p.
    """

    value: float
    amplitudes: dict[str, float]
    rates: dict[str, float]

    def at(self, p: float) -> dict[str, float]:
        """Return amplitude -> its value at another p."""
        return {
            name: amplitude + self.rates[name] * (p - self.value)
            for name, amplitude in self.amplitudes.items()
        }


class SceneFamily:
    """Scenes of one case in a number p of this case; a `continuation.augmented.SystemFamily`.

    It gives systems and tangents at any p, for a boundary of stability that follows one
    instability. All methods that take a state take one of the stage's system (a scene with the
    solver of a step).

    Parameters
    ----------
    scene
        Scene of the case at p = `value`.
    record
        Row of its history at the instability that is followed.
    make_problem
        Makes the problem at a value of p.
    value
        The number p of the case itself.
    value_range
        Least and largest value of p.

    Attributes
    ----------
    kind, name
        Kind of the instability, and the amplitude in which it is located.
    mode
        Name of the mode at the instability; "m = 7" for waves around a meridian.
    m
        Number of waves around a meridian; 0: the mode is one of the model itself.
    has_one_scene
        Whether only amplitudes depend on p, so that one scene serves all values.
    _origin
        The scene whose mesh and amplitudes all others have: that of the case, or one at another p
        that has more amplitudes.
    _make_problem, _range
        The parameters `make_problem` and `value_range`.
    _record_value
        Value of p in the record: the parameter `value`.
    _record
        Row at the instability, in the unknowns of the origin.
    _base, _first
        The stage that is used at p = `value`, and the row at the instability in its unknowns.
    _test_value
        Another value of p, at which forces are compared with those at `value`.
    _problems, _stages
        The latest problems and stages, by the value of p.
    _linear_amplitudes
        Amplitudes as linear functions of p; None if they are not linear, or not only these depend
        on p.
    _scenes
        Scenes on the mesh of the origin, which may share its forms.

    Raises
    ------
    CaseError
        If the number has no influence, or the instability cannot be followed.

    Notes
    -----
    The scene belongs to the family from then on: its forms may hold the numbers of other scenes.
    """

    def __init__(
        self,
        scene: Scene,
        record: Record,
        make_problem: MakeProblem,
        value: float,
        value_range: tuple[float, float],
    ) -> None:
        """Find out how scenes depend on the number, and whether they can share a scene or forms."""
        self.kind: Kind = "fold" if record.label == "fold" else "bifurcation"
        self.name, self.mode = record.amplitude, record.mode
        self.m = waves_of_label(record.mode) or 0
        self._make_problem, self._range, self._record = make_problem, value_range, record
        self._problems: dict[float, Problem] = {}
        self._stages: dict[float, Stage] = {}
        self._linear_amplitudes: _LinearAmplitudes | None = None
        self._refuse_unfollowable(scene)
        # origin: the scene whose mesh, state and amplitudes all others have
        self._origin, self.has_one_scene = scene, False
        self._scenes = SceneCache(base=scene, moves_mesh=True)
        self._test_value = self._choose_test_value(value)
        state = State(self._record.point.state.u, self._amplitudes(value))
        self._first = replace(record, point=replace(record.point, state=state))
        self._record_value = value
        self._stages[value] = self._base = stage_of_record(self._origin, self._first)
        self.has_one_scene = self._depends_by_amplitudes_alone(value)
        if not self.has_one_scene:
            self._share_forms(value)
        else:
            self._linear_amplitudes = self._find_linear_amplitudes(value, self._test_value)

    def _find_linear_amplitudes(self, a: float, b: float) -> _LinearAmplitudes | None:
        """Return the amplitudes as linear functions of p, or None if one is not linear.

        Values at the middle of `a` and `b` are compared with means of the values at the two ends.
        """
        low, middle, high = (self._amplitudes(p) for p in (a, (a + b) / 2, b))
        for name in low:
            sum_of_ends = low[name] + high[name]
            is_linear = isclose(
                2 * middle[name], sum_of_ends, rel_tol=LINEARITY_TOLERANCE, abs_tol=TINY_AMPLITUDE
            )
            if not is_linear:
                return None
        rates = {name: (high[name] - low[name]) / (b - a) for name in low}
        return _LinearAmplitudes(value=a, amplitudes=low, rates=rates)

    def _choose_test_value(self, value: float) -> float:
        """Return another value of p, at which forces are compared with those at `value`.

        A term that is zero at the start, as a field may be, is missing in the first scene. If the
        scene at another value has more amplitudes, it becomes the origin of the family, and the
        record's state is transferred to it. There a new load whose strength the case gives is
        whole, and other new amplitudes are zero.
        """
        low, high = self._range
        step = TEST_DISTANCE * (high - low)
        candidates = [p for p in (value + step, value - step) if low <= p <= high]
        # names of amplitudes, of the first scene and of those at the candidates
        names = self._origin.unloaded().mu.keys()
        scenes = {p: self._scene(p) for p in candidates}
        names_at = {p: scene.unloaded().mu.keys() for p, scene in scenes.items()}
        # the candidate whose scene has the most amplitudes
        test_value = max(candidates, key=lambda p: len(names_at[p]))
        new_names = names_at[test_value] - names
        has_all_and_more = names_at[test_value] > names
        if not has_all_and_more:
            return test_value
        # the scene there has all amplitudes, so it becomes the origin
        old_origin, old_state = self._origin, self._record.point.state
        self._origin = scenes[test_value]
        self._scenes = SceneCache(base=self._origin, moves_mesh=True)
        problem = self._origin.problem
        u, mu = transfer(old_origin, self._origin, old_state.u), dict(old_state.mu)
        strengths = problem.context.strengths
        mu |= {name: strengths.get(name, 0.0) for name in new_names}
        point = replace(self._record.point, state=State(u, mu))
        self._record = replace(self._record, point=point, step=len(problem.programme))
        # a test value other than that of the new origin: the other candidate, if there is one
        if len(candidates) > 1:
            return min(candidates, key=lambda p: p == test_value)
        return (value + test_value) / 2

    def _refuse_unfollowable(self, scene: Scene) -> None:
        """Check that an instability can be followed along a boundary.

        Raises
        ------
        ExcludedInstability
            If the model excludes its mode.
        CaseError
            If the loads of earlier steps, or held conjugates, would change along the boundary.
        """
        record, programme = self._record, scene.problem.programme
        # waves around a meridian are excluded modes that can be followed
        if not (self.m and scene.model.axisymmetric):
            refuse_excluded_mode(record.mode)
        earlier_steps, step = programme[: record.step - 1], programme[record.step - 1]
        # A step may hold conjugates (displacements on which loads do work) at values of the state
        # before it. After earlier steps p would change these values.
        if earlier_steps and any(law != "load" for law in step.load.hold.values()):
            raise CaseError(
                f"{step.key}.hold: a boundary needs what is held to be held from the start: give "
                "one step"
            )
        for earlier in earlier_steps:
            # a target is a pair of what it prescribes and its value
            target = earlier.load.end.goal
            ends_at_conjugate = target and target[0].quantity == "conjugate"
            if earlier.load.hold or ends_at_conjugate:
                raise CaseError(
                    f"{earlier.key}: ends at a displacement or a volume, so its load changes along "
                    "a boundary"
                )

    @cached_property
    def start(self) -> tuple[State, Vector]:
        """State of the stage's system at the instability, and a null vector of its tangent.

        The null vector is that of the waves where `m` is not zero. Collective.

        Raises
        ------
        CaseError
            If there is no eigenvector.
        """
        state = self._base.enter(self._first.point.state)
        if self.m:  # waves have a tangent of their own
            return state, self.null_vector(self._record_value, state, self.m)
        try:
            return state, critical_mode(self._base.newton, state).vector
        except NoEigenpair as e:
            raise CaseError(f"the instability has no null vector: {e}") from None

    @property
    def excludes(self) -> bool:
        """Whether the model is a meridian, whose waves around it are excluded modes."""
        return self._base.scene.model.axisymmetric

    def kind_of(self, m: int, at: BoundaryPoint | None = None) -> Kind:
        """Return the kind of a boundary of m waves, or of the model's own mode (m = 0).

        It is a fold where the load does work along the null vector. Waves are bifurcations, as an
        axisymmetric load does no work on them.

        Parameters
        ----------
        at
            A point of the boundary near the place in question; None: the kind of the first
            instability.
        """
        if m:
            return "bifurcation"
        if at is None:
            return self.kind
        system, phi = self.solver_at(at.p).system, self.mode_at(at, 0, self.m)
        load = system.load(at.state.u, at.state.mu, self.name)
        work_scale = np.linalg.norm(load) * np.linalg.norm(phi)
        return "fold" if abs(phi @ load) > MIN_FOLD_WORK * work_scale else "bifurcation"

    def mode_at(self, crossing: BoundaryPoint, m: int, m_of_boundary: int) -> Vector:
        """Return the other neutral mode at a point where two boundaries cross.

        Parameters
        ----------
        crossing
            Point of the boundary at which another mode is neutral as well.
        m
            Number of waves of the mode that is returned; 0: the critical mode of the model itself.
        m_of_boundary
            Number of waves of the boundary's mode. Waves (m > 0) of the same number are made
            orthogonal to this mode.

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
        other_mode = crossing.phi if m == m_of_boundary else None
        return self.null_vector(crossing.p, crossing.state, m, other_mode)

    def null_vector(
        self, p: float, state: State, m: int, other_mode: Vector | None = None
    ) -> Vector:
        """Return a nearly neutral mode of m waves, of length one, by inverse iteration.

        Parameters
        ----------
        p, state
            Number, and state of the stage's system, at which waves are nearly neutral.
        other_mode
            Neutral mode of as many waves that is known already; the result is orthogonal to it.
            None: no such mode.
        """
        factors = self.factored_tangent(p, state, m)
        # a fixed first guess without symmetries, so that repeated runs agree
        vector = np.sin(1.0 + np.arange(factors.matrix.getLocalSize()[0]))
        for _ in range(INVERSE_ITERATIONS):
            vector = factors.solve(vector)
            if other_mode is not None:
                vector = vector - (other_mode @ vector) / (other_mode @ other_mode) * other_mode
            vector /= np.linalg.norm(vector)
        return vector

    def factored_tangent(self, p: float, state: State, m: int) -> Factorisation:
        """Return the factors of the tangent of m waves at p and a state of the stage's system.

        Part of the interface that `continuation.symmetry_breaking` needs.
        """
        stage = self._stage_at(p)
        return _waves(stage).factor_at(stage.leave(state), m)

    def quadratic_form(self, p: float, state: State, m: int, v: Vector) -> float:
        """Return v . K v, with the tangent K of m waves at p and a state of the stage's system.

        Part of the interface that `continuation.symmetry_breaking` needs.
        """
        return float(v @ self._times_tangent(self._stage_at(p), state, m, v))

    def counts(self, p: float, state: State) -> list[int]:
        """Return the number of unstable directions for each number of waves m = 1, 2, ...

        Part of the interface that `continuation.symmetry_breaking` needs.
        """
        stage = self._stage_at(p)
        return _waves(stage).counts(stage.leave(state))

    def _times_tangent(self, stage: Stage, state: State, m: int, v: Vector) -> Vector:
        """Return K v, with the tangent K of m waves at a state of the stage's system."""
        K = _waves(stage).tangent(stage.leave(state), m)
        x, y = K.createVecs()
        x.setArray(v)
        K.mult(x, y)
        return np.array(y.array_r)

    def solver_at(self, p: float) -> BorderedNewton:
        """Return the solver of the stage's system at p.

        Raises
        ------
        NoSystem
            If there is no scene at p.
        """
        return self._stage_at(p).newton

    def _stage_at(self, p: float) -> Stage:
        """Return the stage at p: the only one, or that of the scene at p."""
        return self._base if self.has_one_scene else self._stage(p)

    def amplitudes(self, p: float) -> dict[str, float]:
        """Return amplitude -> its value at p, for all but the amplitude of the instability."""
        return self._other_amplitudes(self._stage_at(p), p)

    @property
    def costly(self) -> bool:
        """Whether each value of p has a scene of its own."""
        return not self.has_one_scene

    def difference_weights(self, p: float, *, low_order: bool = False) -> list[tuple[float, float]]:
        """Return pairs of weight and value of p for a difference quotient by p.

        The derivative of a quantity by p is about the sum of weight times the quantity at the
        value. It is of second order: central, or to one side with three values where p has no
        problem on both sides.

        Parameters
        ----------
        low_order
            Whether to take a difference of first order, from p itself and one more value.
        """
        step = DIFFERENCE_STEP * abs(self._range[1] - self._range[0])
        central = [(0.5 / step, p + step), (-0.5 / step, p - step)]
        if self._linear_amplitudes:  # no problem is made for these values
            return central
        if low_order:
            step = step if self._has_problem(p + step) else -step
            return [(1 / step, p + step), (-1 / step, p)]
        if self._has_problem(p - step) and self._has_problem(p + step):
            return central
        # (-3 f(p) + 4 f(p + step) - f(p + 2 step))/(2 step)
        step = step if self._has_problem(p + 2 * step) else -step
        return [(-1.5 / step, p), (2 / step, p + step), (-0.5 / step, p + 2 * step)]

    def _has_problem(self, p: float) -> bool:
        """Return whether a value of p is allowed in the case."""
        try:
            self.problem(p)
        except NoSystem:
            return False
        return True

    def problem(self, p: float) -> Problem:
        """Return the problem at p; the latest `MAX_PROBLEMS` are remembered.

        Raises
        ------
        NoSystem
            If p is not allowed in the case.
        """
        if p not in self._problems:
            try:
                self._problems[p] = self._make_problem(p)
            except CaseError as e:
                raise NoSystem(str(e)) from None
            while len(self._problems) > MAX_PROBLEMS:
                self._problems.pop(next(iter(self._problems)))  # the oldest
        return self._problems[p]

    def _stage(self, p: float) -> Stage:
        """Return the stage of the scene at p; the `MAX_STAGES` most recently used are kept."""
        stage = self._stages.pop(p, None)  # put back at the end: the first is the least recent
        if stage is None:
            scene = self._scene(p)
            # a system with further unknowns or parameters, as that of the base; or the model's own
            if self._base.device or self._base.parametrised:
                stage = self._base.on_scene(scene)
            else:
                stage = Stage(scene, scene.newton)
        self._stages[p] = stage
        while len(self._stages) > MAX_STAGES:
            self._stages.pop(next(iter(self._stages)))
        return stage

    def _scene(self, p: float) -> Scene:
        """Return the scene at p, on the mesh of the first one in its chart; collective.

        Raises
        ------
        NoSystem
            If the model's symmetry or the mesh differs in kind, or there is no mesh.
        """
        problem = self.problem(p)
        try:
            return self._scenes.scene_for(problem)
        except UnfitMesh as e:
            raise NoSystem(str(e)) from None
        except MeshError as e:
            raise NoSystem(f"there is no mesh: {e}") from None

    def _amplitudes(self, p: float) -> dict[str, float]:
        """Return amplitude of the model -> its value at the instability, for the number p.

        An amplitude changes with p in three cases. It is at the target of an earlier step: it takes
        the target of the problem at p. It still has its initial value: it takes the initial value
        at p. It is a component of the magnetic field: it scales with the strength of the field.
        """
        if self._linear_amplitudes:
            return self._linear_amplitudes.at(p)
        old, new, mu = self._origin.problem, self.problem(p), dict(self._record.point.state.mu)
        # at the target of an earlier step; a target is a pair of what it prescribes and its value
        earlier_steps = old.programme[: self._record.step - 1]
        for old_step, new_step in zip(earlier_steps, new.programme, strict=False):
            old_target, new_target = (step.load.end.goal for step in (old_step, new_step))
            if not (old_target and new_target):
                continue
            if old_target[0].quantity != "load":
                continue
            # a later step may have moved it away from the target
            if isclose(mu.get(old_step.name, np.nan), old_target[1], rel_tol=1e-9):
                mu[old_step.name] = new_target[1]
        # at the initial value
        old_values, new_values = own_amplitudes(old.loads), own_amplitudes(new.loads)
        names_at_initial_value = [
            name for name, value in old_values.items() if value and mu.get(name) == value
        ]
        mu |= {name: new_values[name] for name in names_at_initial_value if name in new_values}
        # loads whose strength the case gives, but that whose instability is followed
        ratios = strength_ratios(old.context, new.context)
        changing_names = (ratios.keys() & mu.keys()) - {self.name}
        return mu | {name: ratios[name] * mu[name] for name in changing_names}

    def _depends_by_amplitudes_alone(self, value: float) -> bool:
        """Return whether p enters the forces by amplitudes alone; collective.

        The forces of the scene at a test value of p are computed. They are compared with the forces
        of the scene at `value`, once with its own amplitudes and once with the amplitudes at the
        test value. Only in the second case may they be equal.

        Raises
        ------
        NoInfluence
            If p does not change the forces.
        """
        p, comm = self._test_value, self._origin.model.system.comm
        forces = self._forces(self._base, value)
        forces_at_p = self._forces(self._stage(p), p)
        forces_by_amplitudes = self._forces(self._base, p)
        size = max_abs(comm, forces) or 1.0
        if max_abs(comm, forces_at_p - forces) <= FORCE_TOLERANCE * size:
            raise NoInfluence("it has no influence on this instability")
        return max_abs(comm, forces_at_p - forces_by_amplitudes) <= FORCE_TOLERANCE * size

    def _share_forms(self, value: float) -> None:
        """Let the scenes at all p share the forms of one meridian, if forces stay the same.

        The values of p that have a scene so far serve as a test: forces with shared forms must
        equal those of their own scenes, relative to the change of forces by p. Otherwise each value
        keeps a scene of its own.
        """
        if not self._scenes.share_forms():
            return
        stages, comm = self._stages, self._origin.model.system.comm
        # forces of the scenes with forms of their own, and how much they change with p
        forces_at = {p: self._forces(stage, p) for p, stage in stages.items()}
        change = max(max_abs(comm, forces - forces_at[value]) for forces in forces_at.values())
        # the same with shared forms: `_stage` now makes stages that have these
        self._stages = {}
        differences = [
            max_abs(comm, self._forces(self._stage(p), p) - forces)
            for p, forces in forces_at.items()
        ]
        if max(differences) <= SHARED_FORMS_TOLERANCE * change:
            self._base = self._stage(value)
            return
        # back to scenes with forms of their own
        self._scenes.leave_forms()
        self._stages = stages

    def _forces(self, stage: Stage, p: float) -> Vector:
        """Return the quantities of a stage at p that a boundary depends on, in one vector.

        They are residual, load, and tangent times the null vector, at the displacement of the first
        instability, on this rank. Two scenes with equal ones count as the same.
        """
        system, (state, phi) = stage.newton.system, self.start
        mu = {**self._other_amplitudes(stage, p), self.name: state.mu[self.name]}
        state_at_p = State(state.u, mu)
        if self.m:
            product = self._times_tangent(stage, state_at_p, self.m, phi)
        elif stage.scene.model.axisymmetric:
            # its matrices cost little, and differences are less exact
            product = stage.newton.factor_at(state_at_p).times(phi)
        else:  # by differences of residuals
            product = times_tangent(system, state_at_p, phi)
        return np.concatenate(
            [system.residual(state.u, mu), system.load(state.u, mu, self.name), product]
        )

    def _other_amplitudes(self, stage: Stage, p: float) -> dict[str, float]:
        """Return the amplitudes of a stage's system at p, without that of the instability."""
        mu = stage.enter(State(self._first.point.state.u, self._amplitudes(p))).mu
        return {name: value for name, value in mu.items() if name != self.name}


def _waves(stage: Stage) -> Waves:
    """Return the waves around the meridian of a stage, which its axisymmetric model excludes."""
    model = stage.scene.model
    assert model.axisymmetric
    return model.waves
