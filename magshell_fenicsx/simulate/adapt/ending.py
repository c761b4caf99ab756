"""The end of a run, and the same end on another mesh without computing the path.

To carry a field to another mesh is to evaluate it at the new nodes, by the polynomials of each
cell. Unlike `transfer`, which smooths, and scales between shells of different shape, this needs the
same chart; from one degree to a higher one on the same mesh it is exact.

Words and symbols:

- The chart has the coordinates of the undeformed surface: one along a meridian, two of a surface.
  Each of several shells has its own. xi are positions in the reference cell, the interval or
  triangle with corners 0 and 1.
- A distance in cells is one in the coordinates xi.
- The amplitude of a run is its load parameter; its conjugate -dPi/dmu is the displacement on which
  it does work (Pi: potential energy). A held conjugate is prescribed, so the amplitude is unknown.
- A located record is a fold or a bifurcation. A step departs where it leaves its path at a
  bifurcation for a branch, and hands over where this branch is in another model.
- Cuts and penalties are the settings of contact between shells, kept as entries of `State.mu`.
"""

from dataclasses import dataclass, field, replace
from typing import Literal

import basix
import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.continuation.control import ConstraintRow, PrescribedConjugate, PrescribedLoad
from magshell_fenicsx.continuation.fold import FoldGuess, FoldLost, find_fold
from magshell_fenicsx.continuation.system import State, System, Vector
from magshell_fenicsx.quantities.registry import amplitude
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
MOST_CHANGED = 10  # times that an end gets stiffer penalties or new cuts of shells that touch


class NotCarried(RuntimeError):
    """A point of one mesh is outside the other mesh."""


def carry(source: Scene, target: Scene, u: Vector) -> Vector:
    """Return a displacement of scene `source` in the unknowns of scene `target`; collective.

    It is zero at the supports of `target`.

    Parameters
    ----------
    u
        Unknowns of `source` on this rank.

    Raises
    ------
    NotCarried
        On every rank, if a node of `target` is more than a tenth of a cell outside all cells of its
        shell in `source`, or if one of several shells has no chart.
    """
    # cells of the source with its values, and places in the chart of this rank's target nodes
    comm, fields = target.comm, CellFields.of_scene(source)
    nodes_in_chart, values = _chart(target), values_of_all_cells(source, u)
    if nodes_in_chart.shape[1] > target.model.V.mesh.topology.dim:  # they are positions in space
        raise NotCarried("a mesh file has no chart")
    transferred = np.zeros((len(nodes_in_chart), values.shape[2]))
    # distance in cells and coordinates of the node that is farthest from all cells
    farthest = 0.0, list[float]()
    topology = source.model.V.mesh.topology
    owned_cells = topology.index_map(topology.dim).size_local
    # each of several shells has its own chart
    for cells_here, nodes_of_shell in zip(
        cells_of_shells(source), nodes_of_shells(target), strict=True
    ):
        # mask of the shell's cells, among the cells of all ranks
        is_source_cell = np.concatenate(
            source.model.system.comm.allgather(cells_here[:owned_cells])
        )
        # cell, position in it and distance from it of each node of the shell
        points = nodes_in_chart[nodes_of_shell]
        cells_in_subset, xi, distances = fields.subset(is_source_cell).places(points)
        cells = np.flatnonzero(is_source_cell)[cells_in_subset]  # numbers among all cells
        transferred[nodes_of_shell] = fields.evaluate(values, cells, xi)
        if nodes_of_shell.any():
            farthest_here = float(distances.max()), points[np.argmax(distances)].tolist()
            farthest = max(farthest, farthest_here)
    largest_distance, place = max(comm.allgather(farthest))
    if largest_distance > MAX_DISTANCE_IN_CELLS:
        raise NotCarried(
            f"the place {place} of the chart is {largest_distance:.2g} cells beside the other mesh"
        )
    return target.model.system.zero_at_supports(transferred.ravel())


def _chart(scene: Scene) -> Array:
    """Return coordinates (n, 1 or 2) of this rank's nodes in the chart of each shell."""
    return np.asarray(getattr(scene.model, "chart_by_shell", scene.model.chart)())


def values_of_all_cells(scene: Scene, u: Vector) -> Array:
    """Return values (cells, nodes, components) of a displacement on the cells of all ranks.

    The result is the same on every rank. Collective.

    Parameters
    ----------
    u
        Unknowns of this rank.
    """
    system, V = scene.model.system, scene.model.V
    topology = V.mesh.topology
    cells = V.dofmap.list[: topology.index_map(topology.dim).size_local]
    return np.concatenate(
        system.comm.allgather(system.with_ghosts(u).reshape(-1, V.dofmap.bs)[cells])
    )


class CellFields:
    """Cells in a chart, in which points can be located and fields be evaluated.

    Parameters
    ----------
    nodes
        (cells, nodes, 1 or 2), nodes of the map from the reference cell to the chart.
    element
        Lagrange element of this map.

    Attributes
    ----------
    _element
        The parameter `element`.
    _tree_of_centres
        Search tree of the cells' centres.
    """

    def __init__(self, nodes: Array, element: basix.finite_element.FiniteElement) -> None:
        self.nodes, self._element = nodes, element
        self._tree_of_centres = scipy.spatial.cKDTree(self.centres)

    @classmethod
    def of_scene(cls, scene: Scene) -> "CellFields":
        """Return the cells of all ranks; collective."""
        model, V = scene.model, scene.model.V
        if model.midsurface:  # cells beside a seam keep their own chart
            own_nodes = model.midsurface.chart_coordinates_by_shell(V)[
                : V.mesh.topology.index_map(2).size_local
            ]
            nodes = np.concatenate(scene.comm.allgather(own_nodes))
        else:
            chart_places = chart(scene)
            # gathered like a displacement, with zeros for the components that the chart has not
            count = chart_places.shape[1]
            padded_places = np.pad(chart_places, ((0, 0), (0, V.dofmap.bs - count)))
            nodes = values_of_all_cells(scene, padded_places.ravel())[..., :count]
        return cls(nodes, scene.model.V.element.basix_element)

    def subset(self, cells: NDArray[np.bool_]) -> "CellFields":
        """Return some of the cells alone.

        Parameters
        ----------
        cells
            (cells,), whether a cell is taken.
        """
        return self if cells.all() else CellFields(self.nodes[cells], self._element)

    @property
    def centres(self) -> Array:
        """Centres (cells, 1 or 2) of the cells, means of their corners."""
        return np.asarray(self._corners.mean(axis=1))

    def evaluate(self, values: Array, cells: NDArray[np.int64], xi: Array) -> Array:
        """Return values (n, components) of a field at positions in reference cells.

        Parameters
        ----------
        values
            (cells, nodes, components), the field's values at the nodes of each cell.
        cells, xi
            Cell (n,) of each point, and its position (n, 1 or 2) in the reference cell; `places`
            finds them.
        """
        return np.asarray(np.einsum("np,npc->nc", self.table(0, xi)[0], values[cells]))

    def places(self, x: Array) -> tuple[NDArray[np.int64], Array, Array]:
        """Locate points of the chart in the cells.

        First the cells with the nearest centres are searched. Points that are in none of these are
        searched among `WIDER` times as many cells, until no point is too far from its cell or all
        cells have been searched.

        Parameters
        ----------
        x
            Points (n, 1 or 2) of the chart.

        Returns
        -------
        cells
            (n,), the cell of each point; the nearest cell for a point outside all cells.
        xi
            (n, 1 or 2), the positions in the reference cell.
        distances
            (n,), the distances from the cells, in cells; zero inside.
        """
        candidate_count = min(CANDIDATES, len(self.nodes))
        candidates = self._nearest_cells(x, candidate_count)
        distances_if_straight = np.stack(
            [_distance_to_cell(self._as_if_straight(x, cells)) for cells in candidates.T]
        )
        # first guess: the candidate that is nearest with straight edges
        cells = candidates[np.arange(len(x)), distances_if_straight.argmin(axis=0)]
        xi, distances = self._in_cells(x, cells)
        accepted_distance = INSIDE_TOLERANCE
        # a large cell may have a distant centre
        while len(far_points := np.flatnonzero(distances > accepted_distance)):
            # one candidate of each far point after the other, the nearest centre first
            for cells_tried in self._nearest_cells(x[far_points], candidate_count).T:
                xi_tried, distances_tried = self._in_cells(x[far_points], cells_tried)
                is_nearer = distances_tried < distances[far_points]
                improved_points = far_points[is_nearer]
                cells[improved_points] = cells_tried[is_nearer]
                xi[improved_points] = xi_tried[is_nearer]
                distances[improved_points] = distances_tried[is_nearer]
            if candidate_count == len(self.nodes):
                break
            # the wider search is for points that would be refused; on a curved edge others remain
            accepted_distance = (
                INSIDE_TOLERANCE if candidate_count <= CANDIDATES else MAX_DISTANCE_IN_CELLS
            )
            candidate_count = min(WIDER * candidate_count, len(self.nodes))
        return cells, xi, np.where(distances > INSIDE_TOLERANCE, distances, 0.0)

    def _nearest_cells(self, x: Array, count: int) -> NDArray[np.int64]:
        """Return (n, count), the cells whose centres are the nearest to points (n, 1 or 2)."""
        _, cells = self._tree_of_centres.query(x, count)
        return np.asarray(cells.reshape(len(x), count))

    def _in_cells(self, x: Array, cells: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return positions of points in the reference cells of given cells, and distances.

        Newton's method inverts the map of a cell with curved edges. A distance is inf if the method
        fails, or if the point is far from the cell. Distances are in cells.

        Parameters
        ----------
        x
            Points (n, 1 or 2) of the chart.
        cells
            (n,), the cell of each point.
        """
        xi = self._as_if_straight(x, cells)
        distances = np.full(len(x), np.inf)
        near_points = np.flatnonzero(_distance_to_cell(xi) < NEAR_CELL_DISTANCE)
        if not len(near_points):
            return xi, distances
        # from here on of these points and their cells alone
        x, nodes = x[near_points], self.nodes[cells[near_points]]
        reference_points = xi[near_points]
        for _ in range(NEWTON_STEPS):
            table = self.table(1, reference_points)  # [0]: values, [1:]: first derivatives
            residuals = x - np.einsum("np,npd->nd", table[0], nodes)
            derivatives_of_map = np.einsum("jnp,npd->ndj", table[1:], nodes)
            step = _solve(derivatives_of_map, residuals)
            reference_points = reference_points + step
        has_converged = np.abs(step).max(axis=1) < INSIDE_TOLERANCE  # by the last step
        xi[near_points] = reference_points
        distances[near_points] = np.where(
            has_converged, _distance_to_cell(reference_points), np.inf
        )
        return xi, distances

    def table(self, derivatives: int, xi: Array) -> Array:
        """Return shape functions (derivative, n, nodes) at points of the reference cell.

        Parameters
        ----------
        derivatives
            Highest order of the derivatives.
        """
        return np.asarray(self._element.tabulate(derivatives, xi)[..., 0])

    @property
    def _corners(self) -> Array:
        """Corners (cells, 2 or 3, 1 or 2) of the cells, which are their first nodes."""
        return self.nodes[:, : self.nodes.shape[2] + 1]

    def _as_if_straight(self, x: Array, cells: NDArray[np.int64]) -> Array:
        """Return positions of points in the reference cells, as if the cells had straight edges."""
        corners = self._corners[cells]
        return _solve(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2), x - corners[:, 0])


def _distance_to_cell(xi: Array) -> Array:
    """Return the distance of positions (n, 1 or 2) from the reference cell; negative inside."""
    return np.asarray(np.maximum(-xi.min(axis=1), xi.sum(axis=1) - 1))


def _solve(matrices: Array, right: Array) -> Array:
    """Return solutions (n, k) of linear systems with matrices (n, k, k) and right sides (n, k)."""
    return np.asarray(np.linalg.solve(matrices, right[..., None])[..., 0])


class NoResult(RuntimeError):
    """A run has no scalar result to compare between meshes; the message has the reason."""


@dataclass(frozen=True)
class Ending:
    """The end of a run: its scalar result, with the state and the tangent there.

    Attributes
    ----------
    kind
        "fold" and "target" can be computed directly on another mesh, and so can, on a meridian or a
        grid, "instability", any other instability. "held", a target with another conjugate held,
        needs the path.
    name
        The amplitude that varied.
    value
        The result of the run: the amplitude at an instability. At a target, the amplitude if the
        conjugate displacement is prescribed (force at a depth, pressure at a volume), else the
        conjugate displacement.
    state
        State at the end.
    tangent
        Tangent of the path in u; at a fold the null vector. It is the weight of an error of u in
        the value.
    held
        The prescribed conjugate displacement; None if the load is prescribed.
    record
        The record of an instability; None of other ends.
    """

    kind: Literal["fold", "target", "held", "instability"]
    name: str
    value: float
    state: State
    tangent: Vector
    held: float | None = None
    record: Record | None = None


@dataclass
class History:
    """The records of a run on which its end depends; records of branches do not count.

    Attributes
    ----------
    last
        Last record that is no instability.
    end
        Last record of all.
    begin
        Last record before the last step.
    located
        Folds and bifurcations.
    begins
        Number of a step -> last record before it.
    first
        First record.
    """

    last: Record | None = None
    end: Record | None = None
    begin: Record | None = None
    located: list[Record] = field(default_factory=list)
    begins: dict[int, Record] = field(default_factory=dict)
    first: Record | None = None

    def add(self, record: Record) -> None:
        """Take the next record of the run."""
        if record.branch:
            return
        self.first, self.end = self.first or record, record
        if self.last and record.step != self.last.step:  # the first record of a step
            self.begins.setdefault(record.step, self.last)
        if record.label in ("fold", "bifurcation"):
            self.located.append(record)
        else:
            if self.last and record.step != self.last.step:
                self.begin = self.last
            self.last = record

    def ending(self, scene: Scene, stopped: str | None) -> Ending:
        """Return the end of the run.

        It is the target of the last step, if this step ends at one. Otherwise it is the first
        instability of the last step that has any, but with `until: bifurcation` the last one there.
        A bifurcation where the run goes over to a branch or to another model comes before these.

        Parameters
        ----------
        scene
            The first scene of the run.
        stopped
            Reason why the run stopped before its target; None if it did not.

        Raises
        ------
        NoResult
            If the history stopped before its target and not at an instability, or has no load.
        """
        steps = scene.problem.programme
        until = steps[-1].until if steps else "target"
        # beyond the hand-over meshes of the first model have no state to compare
        if self.handed_over:
            return _instability(self._departures(scene)[0])
        if self.last and self.last.amplitude == "time":
            raise NoResult("a motion ends at no single load")
        ends_at_target = until in ("target", "points", "zero") and not stopped
        loaded_record = self.last if self.last and self.last.amplitude else None
        if loaded_record and ends_at_target:
            return at_target(scene, loaded_record)
        if not self.located:
            no_instability = (
                "there is no instability up to the target"
                if steps and steps[-1].load.end.bound
                else "the case has neither a load nor a field"
            )
            raise NoResult(stopped or no_instability)
        located_in_last_step = [
            record for record in self.located if record.step == self.located[-1].step
        ]
        departures = [
            record
            for record in self._departures(scene)
            if record.step == located_in_last_step[0].step
        ]
        if departures:
            return _instability(departures[0])
        return _instability(located_in_last_step[-1 if until == "bifurcation" else 0])

    @property
    def handed_over(self) -> bool:
        """Whether the run has gone on in another model than the first one."""
        return bool(self.first and self.end) and self.end.scene is not self.first.scene  # type: ignore[union-attr]

    def _departures(self, scene: Scene) -> list[Record]:
        """Return the bifurcations at which a step leaves its path for a branch or a snap."""
        steps = scene.problem.programme
        return [
            record
            for record in self.located
            if record.label == "bifurcation" and leaves_path(steps[record.step - 1])
        ]


def _instability(end: Record) -> Ending:
    """Return the end of a run at the record of an instability.

    Raises
    ------
    NoResult
        If its step has no single load.
    """
    if end.amplitude not in end.point.state.mu:
        raise NoResult("an instability of a turning field is not a single load")
    # a fold of the model itself; an instability with a mode is one that the model excludes
    own_fold = end.label == "fold" and not end.mode
    state, tangent = end.point.state, end.point.du
    value = state.mu[end.amplitude]
    if own_fold:
        return Ending("fold", end.amplitude, value, state, tangent)
    return Ending("instability", end.amplitude, value, state, tangent, record=end)


def by_path(scene: Scene) -> Ending:
    """Return the end of a scene, by computing its whole history; collective.

    The history is computed up to its stop, or to where it goes on in another model.

    Raises
    ------
    NoResult
        If the history stopped before its target and not at an instability, or has no load.
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
    """Return the end of a scene, by Newton's method from the end on another mesh; collective.

    Where that fails, the whole path is computed.

    Parameters
    ----------
    source, neighbour
        Scene on the other mesh, and its end.

    Raises
    ------
    NoResult
        If the history stopped before its target and not at an instability, or has no load.
    """
    return near_by(scene, source, neighbour) or by_path(scene)


def near_by(scene: Scene, source: Scene, neighbour: Ending) -> Ending | None:
    """Return the end of a scene, by Newton's method from the end on another mesh; collective.

    Parameters
    ----------
    source, neighbour
        Scene on the other mesh, and its end.

    Returns
    -------
    Ending or None
        None if Newton's method fails, or if this kind of end needs a path.
    """
    if neighbour.kind in ("held", "instability"):
        return None
    try:
        # displacement and tangent of the other end, on the mesh of this scene
        u, tangent = (
            carry(source, scene, vector) for vector in (neighbour.state.u, neighbour.tangent)
        )
    except NotCarried:
        return None
    # cuts belong to a mesh: those of the other one are of no use here
    guess = with_cuts_here(scene, State(u, dict(neighbour.state.mu)))
    for _ in range(MOST_CHANGED):
        if neighbour.kind == "fold":
            end = _fold(scene, FoldGuess(guess, tangent), neighbour.name)
        else:
            end = _equilibrium(scene, guess, neighbour)
        if end is None:
            return None
        # cuts and penalties of shells that touch change until they are fit
        state_with_own_contact = with_own_contact(scene, end.state)
        if state_with_own_contact is None:
            # nodes of supports that move are there, so that the end can be carried on
            return replace(end, state=scene.model.system.with_moved_supports(end.state))
        guess, tangent = state_with_own_contact, end.tangent
    return None


def _fold(scene: Scene, guess: FoldGuess, name: str) -> Ending | None:
    """Return the end at the fold near a guess; None if there is none, or it is not the first.

    It is not the first instability of its path if other directions are unstable there.
    """
    try:
        fold = find_fold(scene.newton, guess, name)
    except FoldLost:
        return None
    return None if fold.unstable else Ending("fold", name, fold.value, fold.state, fold.phi)


def _equilibrium(scene: Scene, guess: State, neighbour: Ending) -> Ending | None:
    """Return the end at an equilibrium near a guess; None if Newton's method fails.

    The equilibrium has the load of the end on the other mesh, or its conjugate displacement where
    this was held.
    """
    newton, system = scene.newton, scene.newton.system
    name, held_value = neighbour.name, neighbour.held
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
    """Return the end of a run at a target of the record's step, or at the end of a branch.

    At the end of a branch, which has no target, the conjugate counts as held. With held conjugates
    of other amplitudes the end is of the kind "held".
    """
    system, state = scene.newton.system, record.point.state
    load = scene.problem.programme[record.step - 1].load
    target = load.end.target  # a pair: what it prescribes, and the value
    # a field that turns by an angle does its work through the component across
    varied_amplitude = amplitude(record.amplitude)
    name = (
        amplitude(varied_amplitude.turned_load).components[0]
        if varied_amplitude.turned_load
        else varied_amplitude.name
    )
    by_conjugate = target is None or target[0].quantity == "conjugate"
    held_value = (
        -system.potential(state.u, state.mu, name)
        if by_conjugate and not varied_amplitude.is_field
        else None
    )
    kind: Literal["target", "held"] = (
        "held" if any(law != "load" for law in load.hold.values()) else "target"
    )
    return Ending(
        kind, name, _value(system, state, name, held_value), state, record.point.du, held_value
    )


def _value(system: System, state: State, name: str, held_value: float | None) -> float:
    """Return the result at a target: the amplitude at a held conjugate, else the conjugate."""
    return state.mu[name] if held_value is not None else -system.potential(state.u, state.mu, name)
