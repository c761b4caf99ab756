"""The end of a run, and the same end on another mesh without computing the path.

Fields are carried between meshes of one case by the polynomials of each cell. `transfer` smooths,
and scales between shells of different shape. Here source and target have the same chart, and to a
higher degree on the same mesh it is exact.
"""

from dataclasses import dataclass, field
from typing import Literal

import basix
import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.continuation.control import ConstraintRow, PrescribedConjugate, PrescribedLoad
from magshell_fenicsx.continuation.fold import FoldGuess, FoldLost, find_fold
from magshell_fenicsx.continuation.system import State, System, Vector
from magshell_fenicsx.simulate.contact_control import with_cuts_here, with_own_contact
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.steps import leaves_path
from magshell_fenicsx.simulate.transfer import cells_of_shells, chart, nodes_of_shells

Array = NDArray[np.float64]
CANDIDATES = 12  # number of nearest cells that are searched for a point
WIDER = 8  # factor of that number if none of them contains the point
NEWTON_STEPS = 4  # for the position in a cell with a curved edge
INSIDE_TOLERANCE = 1e-6  # distance from a cell, in cells, below which a point is inside: rounding
MAX_DISTANCE_IN_CELLS = (
    0.1  # largest distance, in cells; two meshes approximate a curved edge differently
)
NEAR_CELL_DISTANCE = 1.0  # distance, in cells, beyond which a cell's map is not inverted
FIELDS = ("lambda_m", "angle")  # amplitudes whose value is prescribed
MOST_CHANGED = 10  # times that an end gets stiffer penalties or new cuts of shells that touch


class NotCarried(RuntimeError):
    """A point of one mesh is outside the other mesh."""


def carry(source: Scene, target: Scene, u: Vector) -> Vector:
    """A displacement of `source` in the unknowns of `target`, zero at its supports; collective.

    Raises
    ------
    NotCarried
        On every rank, if a node of `target` is more than a tenth of a cell outside all cells of its
        shell in `source`, or one of several shells has no chart.
    """
    fields, comm, x, values = (
        CellFields.of_scene(source),
        target.comm,
        _chart(target),
        values_of_all_cells(source, u),
    )
    if x.shape[1] > target.model.V.mesh.topology.dim:
        raise NotCarried("a mesh file has no chart")
    transferred, worst = np.zeros((len(x), values.shape[2])), (0.0, list[float]())
    owned_cells = source.model.V.mesh.topology.index_map(
        source.model.V.mesh.topology.dim
    ).size_local
    for cells_here, nodes_of_shell in zip(
        cells_of_shells(source), nodes_of_shells(target), strict=True
    ):
        is_source_cell = np.concatenate(
            source.model.system.comm.allgather(cells_here[:owned_cells])
        )
        cells, xi, distances = fields.subset(is_source_cell).places(x[nodes_of_shell])
        transferred[nodes_of_shell] = fields.evaluate(
            values, np.flatnonzero(is_source_cell)[cells], xi
        )
        if nodes_of_shell.any():
            worst = max(
                worst, (float(distances.max()), x[nodes_of_shell][np.argmax(distances)].tolist())
            )
    largest_distance, place = max(comm.allgather(worst))
    if largest_distance > MAX_DISTANCE_IN_CELLS:
        raise NotCarried(
            f"the place {place} of the chart is {largest_distance:.2g} cells beside the other mesh"
        )
    return target.model.system.zero_at_supports(transferred.ravel())


def _chart(scene: Scene) -> Array:
    """Coordinates (n, 1 or 2) of this rank's nodes in the chart, of several shells in their own."""
    return np.asarray(getattr(scene.model, "chart_by_shell", scene.model.chart)())


def values_of_all_cells(scene: Scene, u: Vector) -> Array:
    """Values (cells, nodes, components) of a displacement on the cells of all ranks, on every rank;
    collective.
    """
    system, V = scene.model.system, scene.model.V
    topology = V.mesh.topology
    cells = V.dofmap.list[: topology.index_map(topology.dim).size_local]
    return np.concatenate(
        system.comm.allgather(system.with_ghosts(u).reshape(-1, V.dofmap.bs)[cells])
    )


class CellFields:
    """Cells in a chart, in which points can be located.

    Parameters
    ----------
    nodes
        (cells, nodes, 1 or 2) nodes of the map from the reference cell to the chart.
    """

    def __init__(self, nodes: Array, element: basix.finite_element.FiniteElement) -> None:
        self.nodes, self._element = nodes, element
        self._near = scipy.spatial.cKDTree(self.centres)

    @classmethod
    def of_scene(cls, scene: Scene) -> "CellFields":
        """The cells of all ranks; collective."""
        model, V = scene.model, scene.model.V
        if model.midsurface:  # cells beside a seam keep their own chart
            own_nodes = model.midsurface.chart_coordinates_by_shell(V)[
                : V.mesh.topology.index_map(2).size_local
            ]
            nodes = np.concatenate(scene.comm.allgather(own_nodes))
        else:
            x = chart(scene)
            nodes = values_of_all_cells(
                scene, np.pad(x, ((0, 0), (0, V.dofmap.bs - x.shape[1]))).ravel()
            )[..., : x.shape[1]]
        return cls(nodes, scene.model.V.element.basix_element)

    def subset(self, cells: NDArray[np.bool_]) -> "CellFields":
        """Some of the cells alone."""
        return self if cells.all() else CellFields(self.nodes[cells], self._element)

    @property
    def centres(self) -> Array:
        """(cells, 1 or 2)."""
        return np.asarray(self._corners.mean(axis=1))

    def evaluate(self, values: Array, cells: NDArray[np.int64], xi: Array) -> Array:
        """Values (n, components) of a field of `values_of_all_cells` at positions found by
        `places`.
        """
        return np.asarray(np.einsum("np,npc->nc", self.table(0, xi)[0], values[cells]))

    def places(self, x: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """Locate points x (n, 1 or 2) of the chart.

        Returns
        -------
        The cells (n,), the nearest for a point outside all cells; the positions (n, 1 or 2) in the
        reference cell; and the distances (n,) from the cells, in cells, zero inside.
        """
        count = min(CANDIDATES, len(self.nodes))
        candidates = self._near.query(x, count)[1].reshape(len(x), count)
        straight = np.stack(
            [_distance_to_cell(self._as_if_straight(x, cells)) for cells in candidates.T]
        )
        cells = candidates[np.arange(len(x)), straight.argmin(axis=0)]
        xi, distances = self._in_cells(x, cells)
        enough = INSIDE_TOLERANCE
        # a large cell may have a distant centre
        while len(far_points := np.flatnonzero(distances > enough)):
            candidates = self._near.query(x[far_points], count)[1].reshape(len(far_points), count)
            for tried in candidates.T:
                xi_tried, off = self._in_cells(x[far_points], tried)
                better = far_points[off < distances[far_points]]
                cells[better], xi[better], distances[better] = (
                    a[off < distances[far_points]] for a in (tried, xi_tried, off)
                )
            if count == len(self.nodes):
                break
            enough = INSIDE_TOLERANCE if count <= CANDIDATES else MAX_DISTANCE_IN_CELLS
            count = min(WIDER * count, len(self.nodes))
        return cells, xi, np.where(distances > INSIDE_TOLERANCE, distances, 0.0)

    def _in_cells(self, x: Array, cells: NDArray[np.int64]) -> tuple[Array, Array]:
        """Positions of points in the reference cells of given cells, and distances; inf if Newton's
        method fails.
        """
        xi = self._as_if_straight(x, cells)
        distances = np.full(len(x), np.inf)
        near_cells = np.flatnonzero(_distance_to_cell(xi) < NEAR_CELL_DISTANCE)
        if not len(near_cells):
            return xi, distances
        x, nodes, reference_points = x[near_cells], self.nodes[cells[near_cells]], xi[near_cells]
        for _ in range(NEWTON_STEPS):
            table = self.table(1, reference_points)
            rest = x - np.einsum("np,npd->nd", table[0], nodes)
            step = _solve(np.einsum("jnp,npd->ndj", table[1:], nodes), rest)
            reference_points = reference_points + step
        xi[near_cells], distances[near_cells] = (
            reference_points,
            np.where(
                np.abs(step).max(axis=1) < INSIDE_TOLERANCE,
                _distance_to_cell(reference_points),
                np.inf,
            ),
        )
        return xi, distances

    def table(self, derivatives: int, xi: Array) -> Array:
        """Shape functions and derivatives (derivative, n, nodes) at points of a reference cell."""
        return np.asarray(self._element.tabulate(derivatives, xi)[..., 0])

    @property
    def _corners(self) -> Array:
        return self.nodes[:, : self.nodes.shape[2] + 1]

    def _as_if_straight(self, x: Array, cells: NDArray[np.int64]) -> Array:
        """Positions in the reference cells, as if the cells had straight edges."""
        corners = self._corners[cells]
        return _solve(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2), x - corners[:, 0])


def _distance_to_cell(xi: Array) -> Array:
    """Distance of positions (n, 1 or 2) from the reference cell; negative inside."""
    return np.asarray(np.maximum(-xi.min(axis=1), xi.sum(axis=1) - 1))


def _solve(matrices: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(matrices, right[..., None])[..., 0])


class NoResult(RuntimeError):
    """A run has no scalar result to compare between meshes; the message has the reason."""


@dataclass(frozen=True)
class Ending:
    """The end of a run.

    Attributes
    ----------
    kind
        A fold or a target can be computed directly; a target with another conjugate held ("held")
        and another instability need the path.
    name
        The amplitude that varied.
    value
        The result of the run: the amplitude at an instability. At a target, the amplitude if the
        conjugate displacement is prescribed (force at a depth, pressure at a volume), else the
        conjugate displacement.
    tangent
        Tangent of the path in u; at a fold the null vector. It is the weight of an error of u in
        the value.
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
    `last` the last one that is no instability, `end` the last one of all, `first` the first one.
    """

    last: Record | None = None
    end: Record | None = None
    begin: Record | None = None
    located: list[Record] = field(default_factory=list)
    begins: dict[int, Record] = field(default_factory=dict)
    first: Record | None = None

    def add(self, record: Record) -> None:
        if record.branch:
            return
        self.first, self.end = self.first or record, record
        if self.last and record.step != self.last.step:
            self.begins.setdefault(record.step, self.last)
        if record.label in ("fold", "bifurcation"):
            self.located.append(record)
        else:
            if self.last and record.step != self.last.step:
                self.begin = self.last
            self.last = record

    def ending(self, scene: Scene, stopped: str | None) -> Ending:
        """The first instability; the last one with `until: bifurcation`; the last target with a
        target.

        Of a run that goes on in another model, or along a branch, the bifurcation where it begins.

        Raises
        ------
        NoResult
            If the history stopped before its target and not at an instability, or has no load.
        """
        steps = scene.problem.programme
        until = steps[-1].until if steps else "target"
        if self.handed_over:  # beyond it meshes of the first model have no state to compare
            return _instability(self._departures(scene)[0])
        if (
            until in ("target", "points", "zero")
            and not stopped
            and self.last
            and self.last.amplitude not in ("", "time")
        ):
            return at_target(scene, self.last)
        if self.last and self.last.amplitude == "time":
            raise NoResult("a motion ends at no single load")
        if not self.located:
            no_instability = (
                "there is no instability up to the target"
                if steps and steps[-1].load.limit_target
                else ""
            )
            raise NoResult(stopped or no_instability or "the case has neither a load nor a field")
        in_last = [record for record in self.located if record.step == self.located[-1].step]
        departures = [
            record for record in self._departures(scene) if record.step == in_last[0].step
        ]
        return _instability(
            departures[0] if departures else in_last[-1 if until == "bifurcation" else 0]
        )

    @property
    def handed_over(self) -> bool:
        """Whether the last record is of another model than the first one."""
        return bool(self.first and self.end) and self.end.scene is not self.first.scene  # type: ignore[union-attr]

    def _departures(self, scene: Scene) -> list[Record]:
        """The bifurcations of steps that leave the path there."""
        steps = scene.problem.programme
        return [
            r for r in self.located if r.label == "bifurcation" and leaves_path(steps[r.step - 1])
        ]


def _instability(end: Record) -> Ending:
    if end.amplitude not in end.point.state.mu:
        raise NoResult("an instability of a turning field is not a single load")
    own_fold = end.label == "fold" and not end.mode
    value = end.point.state.mu[end.amplitude]
    return Ending(
        "fold" if own_fold else "instability", end.amplitude, value, end.point.state, end.point.du
    )


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
            if history.handed_over:
                break
    except Stopped as e:
        stopped = str(e)
    return history.ending(scene, stopped)


def from_near(scene: Scene, source: Scene, neighbour: Ending) -> Ending:
    """The end of a scene by Newton's method from the end on another mesh; if this fails, by the
    path.

    Raises
    ------
    NoResult
        See `History.ending`.
    """
    return near_by(scene, source, neighbour) or by_path(scene)


def near_by(scene: Scene, source: Scene, neighbour: Ending) -> Ending | None:
    """The end of a scene by Newton's method from the end on another mesh; None if it fails, or
    needs a path.
    """
    if neighbour.kind in ("held", "instability"):
        return None
    try:
        u, tangent = (carry(source, scene, v) for v in (neighbour.state.u, neighbour.tangent))
    except NotCarried:
        return None
    guess = with_cuts_here(scene, State(u, dict(neighbour.state.mu)))
    for _ in range(MOST_CHANGED):
        is_fold = neighbour.kind == "fold"
        end = (
            _fold(scene, FoldGuess(guess, tangent), neighbour.name)
            if is_fold
            else _equilibrium(scene, guess, neighbour)
        )
        if end is None or (own_result := with_own_contact(scene, end.state)) is None:
            return end
        guess, tangent = own_result, end.tangent
    return None


def _fold(scene: Scene, guess: FoldGuess, name: str) -> Ending | None:
    try:
        fold = find_fold(scene.newton, guess, name)
    except FoldLost:
        return None
    return None if fold.unstable else Ending("fold", name, fold.value, fold.state, fold.phi)


def _equilibrium(scene: Scene, guess: State, neighbour: Ending) -> Ending | None:
    newton, system, name, held_value = (
        scene.newton,
        scene.newton.system,
        neighbour.name,
        neighbour.held,
    )
    row: ConstraintRow = (
        PrescribedLoad(name, guess.mu[name])
        if held_value is None
        else PrescribedConjugate(system, name, held_value)
    )
    outcome = newton.solve(guess, name, row)
    if not outcome.converged:
        return None
    state = outcome.state
    tangent = newton.response(state, name, row, exact=True).du
    return Ending(
        "target", name, _value(system, state, name, held_value), state, tangent, held_value
    )


def at_target(scene: Scene, record: Record) -> Ending:
    """The end of a run at a target of the record's step, or of a branch after so many points."""
    system, state, step = (
        scene.newton.system,
        record.point.state,
        scene.problem.programme[record.step - 1].load,
    )
    target = step.target
    name = "lambda_across" if record.amplitude == "angle" else record.amplitude
    by_conjugate = target is None or target[0].quantity == "conjugate"
    held_value = (
        -system.potential(state.u, state.mu, name)
        if by_conjugate and record.amplitude not in FIELDS
        else None
    )
    kind: Literal["target", "held"] = (
        "held" if any(how != "load" for how in step.hold.values()) else "target"
    )
    return Ending(
        kind, name, _value(system, state, name, held_value), state, record.point.du, held_value
    )


def _value(system: System, state: State, name: str, held_value: float | None) -> float:
    return state.mu[name] if held_value is not None else -system.potential(state.u, state.mu, name)
