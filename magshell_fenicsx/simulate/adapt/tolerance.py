"""A mesh for a tolerance of the result: rounds of error estimation and remeshing that need only one
path.

    (a) Compute the whole path on a coarse mesh of degree 3. (b) Compute its end with one degree
    more; the change of the result estimates the error. If changes by two degrees in sequence have a
    large ratio, as where there is a point force, all further ones of a geometric series are added.
    (c) Stop if the estimate is at most the tolerance, and on a surface at least a fifth of it. (d)
    If it is larger, and the degree is below the one that suits the tolerance, continue with (b)
    with one degree more. (e) Else make a mesh on which all cells have equal shares in the error
    (`indicators`) and the expected error is 0.55 of the tolerance; compute its end by Newton's
    method from the end of (b); continue with (b).

Meridians are refined uniformly, where cells cost nothing. Of grids, whose lines go from edge to
edge, the lines are placed such that the intervals between them have equal shares. On a meridian and
on a surface of few cells the error may be far below a loose tolerance.

A solid has degree 2, so element size and layers are chosen. Each round solves on one mesh, with
smaller elements, and with one more layer. The two changes of the result estimate the two parts of
the error, as if it fell with the square of the size; the part that is too large is refined.

Words and symbols:

- The end of a run (`Ending`) is its scalar result with the state and the path's tangent there. A
  solution is a scene with its end. `carry` evaluates a displacement of one mesh on another one.
- A choice is degree and mesh; `refinement` divides the default sizes of its elements.
- A round is a mesh that was tried, with result and estimated error. Its coarse solution has the
  degree of the choice, its fine solution one degree more. Lists of what was tried have pairs of a
  round and its choice.
- h and R are thickness and reference length; energies are over E h R^2.
- `say` prints a line of the log, `doing` sets a line of status.
"""

from collections.abc import Callable
from dataclasses import replace
from math import inf

import basix
import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.fold import FoldLost
from magshell_fenicsx.continuation.modes import ModesNotFound, NoEigenpair
from magshell_fenicsx.continuation.system import Vector, dot
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.models.shell.law import work
from magshell_fenicsx.problem.memory import refuse_beyond_memory
from magshell_fenicsx.problem.mesh_sizes import SOLID_DEGREE, SolidSection
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.adapt.choice import (
    GRID_FACTOR,
    Adapted,
    AdaptiveRound,
    Choice,
    LineSpacing,
    Sampled,
    equidistributed,
    equidistributed_lines,
)
from magshell_fenicsx.simulate.adapt.ending import (
    CellFields,
    Ending,
    NoResult,
    NotCarried,
    by_path,
    carry,
    from_near,
    values_of_all_cells,
)
from magshell_fenicsx.simulate.degree_comparison import NotEstimated, state_on_other_mesh
from magshell_fenicsx.simulate.discretisation_error import SAFETY
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
STEP = 1e-30  # along the imaginary axis: the derivative is exact
# refinements of the first mesh, tried until the path has a result
FIRST_REFINEMENTS = 0.5, 1.0, 2.0
FINER = 1.5  # factor of the refinement that is compared with
SLOWEST, FASTEST = 1.25, 2.5  # factor of the refinement in one round
ERROR_SHARE = 0.4  # each part of the estimated error over the tolerance
MOST_ROUNDS = 6
MOST_LAYERS = 9
Say = Callable[[str], None]
# the fastest degree for tolerances down to the first number
DEGREES = (3e-3, 3), (2e-4, 4), (0.0, 5)
PATH_DEGREE = 3  # degree of the path
AIM, MIN_REDUCTION = 0.55, 1 / 5  # estimated error over the tolerance
COARSEST, FINEST = 0.1, 20.0  # limits of the refinement of a meridian
# least factor of the refinement of a meridian, where cells cost less than another round; contact
# makes the error fall slowly
MERIDIAN_FACTOR = 1.5
MAX_RATIO = 0.5  # of the changes of the result by two degrees in sequence
MIN_CELLS_TO_COARSEN = 50  # a surface with at most so many cells is not coarsened
Solved = tuple[Scene, Ending]


def indicators(
    coarse_solution: tuple[Scene, Ending], fine_solution: tuple[Scene, Ending]
) -> tuple[Array, Array]:
    """Return the share of each cell in the error of the result, up to a common factor; collective.

    The result J of a run is an amplitude on a path of equilibria, or its conjugate displacement.
    Dual weighted residuals (R. Becker, R. Rannacher, Acta Numerica 10, 2001) give its error: the
    adjoint solution is here the path's tangent z, and J - J_h = a(e_u, e_z) up to higher order,
    with the tangent stiffness a and the errors e_u, e_z of u and z. In each cell this is at most
    the product of the energy norms of e_u and e_z, which is the share. The errors are estimated
    with a solution of higher degree on the same mesh.

    Parameters
    ----------
    coarse_solution, fine_solution
        Scenes on one mesh with their ends; the second has a higher degree.

    Returns
    -------
    centres
        (n, 2), centres of the cells in the chart, in an order independent of the number of ranks.
    shares
        (n,), the share of each cell.
    """
    (scene, coarse_end), (fine_scene, fine_end) = coarse_solution, fine_solution
    cells, comm = CellFields.of_scene(fine_scene), fine_scene.newton.system.comm
    u, z = (carry(scene, fine_scene, vector) for vector in (coarse_end.state.u, coarse_end.tangent))
    scale = dot(comm, z, fine_end.tangent) / dot(comm, z, z)  # null vectors have no scale
    energy_of_cells = _TangentEnergy(fine_scene, cells, fine_end.state.u)
    shares = np.sqrt(
        energy_of_cells(fine_end.state.u - u) * energy_of_cells(fine_end.tangent - scale * z)
    )
    order = np.lexsort(cells.centres.round(9).T)
    return cells.centres[order], shares[order]


class _TangentEnergy:
    """Energy of the linearised strains of a variation v, cell by cell.

    It is half the second derivative of membrane and bending energy, with the strains dE_ij =
    sym(a_i . v,_j) and dK_ij = n . (v,_ij - G^k_ij v,_k). Here a_i are the deformed tangent vectors
    r,_i, n the normal, and G^k_ij the Christoffel symbols.

    Parameters
    ----------
    scene
        Scene of a surface.
    cells
        Its cells on all ranks.
    u
        Displacement about which strains are linearised, unknowns of this rank.

    Attributes
    ----------
    _scene
        The parameter `scene`.
    _table, _weights
        Shape functions with two derivatives at the quadrature points, and weights of these.
    _a, _normal
        Deformed tangent vectors a_i, and the deformed unit normal.
    _raise
        Inverse of the undeformed metric, which raises indices.
    _strain
        Membrane strain (metric - undeformed metric)/2.
    _gamma
        Christoffel symbols G^k_ij, with the indices i, j, k.
    _law
        The material at the points: membrane stress and bending energy.
    _area
        Undeformed area over that of the reference cell.
    """

    def __init__(self, scene: Scene, cells: CellFields, u: Vector) -> None:
        """Compute what does not depend on a variation: bases, metrics and stresses; collective."""
        model, self._scene = scene.model, scene
        # indices of arrays: n cells, q points, p nodes; i, j, k of the reference cell, c of space
        points, self._weights = basix.make_quadrature(basix.CellType.triangle, 2 * model.degree)
        self._table = cells.table(2, points)
        r0 = model.r0.x.array[: model.system.size]
        # r,_i and r,_ij of the undeformed place, and of the deformed one
        undeformed_tangents, undeformed_second = self._derivatives(r0)
        u_1, u_2 = self._derivatives(u)
        tangents, second_derivatives = undeformed_tangents + u_1, undeformed_second + u_2
        metric0, metric = (
            np.einsum("...ic,...jc->...ij", a, a) for a in (undeformed_tangents, tangents)
        )
        normal = np.cross(tangents[..., 0, :], tangents[..., 1, :])
        self._normal = normal / np.linalg.norm(normal, axis=-1, keepdims=True)
        self._a, self._raise = tangents, np.linalg.inv(metric0)
        self._strain = (metric - metric0) / 2
        places = np.einsum("qp,npc->nqc", self._table[0], values_of_all_cells(scene, r0))
        a1, a2 = undeformed_tangents[..., 0, :], undeformed_tangents[..., 1, :]
        material = scene.problem.material.law_in(_materials_of_all_cells(scene))
        self._law = material.at_point(places, a1, a2, np.cross(a1, a2))
        # a^k, with a^k . a_i = 1 for i = k, else 0
        dual_vectors = np.linalg.solve(metric, tangents)
        self._gamma = np.einsum("...ijc,...kc->...ijk", second_derivatives, dual_vectors)
        self._area = np.sqrt(np.linalg.det(metric0))

    def __call__(self, v: Vector) -> Array:
        """Return the energy (cells,) of a variation, over E h R^2; collective.

        Parameters
        ----------
        v
            The variation, unknowns of this rank.
        """
        law = self._law
        first_derivatives, second_derivatives = self._derivatives(v)
        E = np.einsum("...ic,...jc->...ij", self._a, first_derivatives)
        covariant_derivative = second_derivatives - np.einsum(
            "...ijk,...kc->...ijc", self._gamma, first_derivatives
        )
        K = np.einsum("...c,...ijc->...ij", self._normal, covariant_derivative)
        E, K = ((S + np.swapaxes(S, -1, -2)) / 2 for S in (E, K))  # their symmetric parts
        # the derivative of the stress along E, by a complex step
        membrane_second_derivative = (
            work(law.stress(self._strain + 1j * STEP * E, self._raise), E).imag / STEP
        )
        # the mean for K and -K is without the part linear in K, which plies have
        bending_energies = (law.bending(self._strain, S, self._raise) for S in (K, -K))
        density = membrane_second_derivative / 2 + sum(bending_energies) / 2
        return np.asarray((density * self._area) @ self._weights)

    def _derivatives(self, v: Vector) -> tuple[Array, Array]:
        """Return first and second derivatives of a vector field in the reference cells; collective.

        Their shapes are (cells, points, i, 3) and (cells, points, i, j, 3).
        """
        by_order = np.einsum("jqp,npc->jnqc", self._table, values_of_all_cells(self._scene, v))
        # basix orders derivatives as 0, x, y, xx, xy, yy: 3, 4, 5 are the second ones
        second = np.stack(
            [
                np.stack([by_order[3], by_order[4]], axis=-2),
                np.stack([by_order[4], by_order[5]], axis=-2),
            ],
            axis=-3,
        )
        return np.stack([by_order[1], by_order[2]], axis=-2), second


def _materials_of_all_cells(scene: Scene) -> Array | None:
    """Return four numbers of the material of each cell of all ranks, (cells, 4); collective.

    None where all cells have one material.
    """
    field = getattr(scene.model, "cell_materials", None)
    if field is None:
        return None
    own_count = field.function_space.dofmap.index_map.size_local
    own_materials = field.x.array.reshape(-1, 4)[:own_count]
    return np.asarray(np.concatenate(scene.comm.allgather(own_materials)))


def adapted_solid(problem: Problem, comm: MPI.Comm, say: Say, doing: Say) -> Adapted:
    """Find refinement and layers of a solid for its tolerance; collective.

    Each round solves on one mesh, and refines sizes or layers if their part of the error is too
    large.

    Parameters
    ----------
    say, doing
        Called with a line of text per round, and with words for the next activity.

    Raises
    ------
    NoResult
        If no mesh has a result, or the first mesh is too large.
    """
    tolerance, tried = problem.mesh.tolerance, list[tuple[AdaptiveRound, Choice]]()
    assert tolerance is not None
    refinement = FIRST_REFINEMENTS[0]
    layers = (problem.context.section_of(SolidSection) or SolidSection()).layers
    while len(tried) < MOST_ROUNDS:
        doing(f"a mesh for the tolerance {tolerance:g}: round {len(tried) + 1}")
        try:
            round_result, size_error, thickness_error = _round(problem, comm, refinement, layers)
        except NoResult:  # a first mesh may be too coarse: try the next one
            if tried or refinement == FIRST_REFINEMENTS[-1]:
                raise
            refinement = FIRST_REFINEMENTS[FIRST_REFINEMENTS.index(refinement) + 1]
            continue
        except CaseError:  # too large
            break
        tried.append((round_result, Choice(SOLID_DEGREE, refinement, layers=layers)))
        say(
            f"tolerance {tolerance:g}: refinement {refinement:g}, layers {layers}, "
            f"{round_result.dofs} "
            "unknowns: "
            f"result {round_result.result:.9g}, estimated error {size_error:.1e} by the size and "
            f"{thickness_error:.1e} by the layers"
        )
        if round_result.estimate <= tolerance or refinement >= FINEST:
            break
        # smaller elements, more layers, or both
        if size_error > ERROR_SHARE * tolerance:
            refinement = _finer(refinement, size_error / (ERROR_SHARE * tolerance))
        layers += thickness_error > ERROR_SHARE * tolerance and layers < MOST_LAYERS
    if not tried:
        raise NoResult("the first mesh is too large")
    best, choice = min(tried, key=lambda round_and_choice: round_and_choice[0].estimate)
    if best.estimate > tolerance:
        say(
            f"warning: no mesh was found for the tolerance; the least estimated error is "
            f"{best.estimate:.1e}"
        )
    return Adapted(problem, choice, best, [judged_round for judged_round, _ in tried])


def _finer(refinement: float, error_ratio: float) -> float:
    """Return the refinement that lowers an error by a factor, at most `FASTEST` times as fine.

    The error falls with the square of the size.
    """
    finer = round(refinement * float(np.clip(error_ratio**0.5, SLOWEST, FASTEST)), 3)
    return min(finer, FINEST)


def _round(
    problem: Problem, comm: MPI.Comm, refinement: float, layers: int
) -> tuple[AdaptiveRound, float, float]:
    """Return the result on one mesh of a solid, with its two errors; collective.

    Returns
    -------
    round, size_error, thickness_error
        The round, and the relative errors by the size of elements and by the number of layers. Both
        errors count as falling with the square of the size.
    """

    def result(refinement: float, layers: int) -> tuple[float, int, int]:
        """Return the result, and the numbers of cells and of unknowns."""
        scene = Choice(SOLID_DEGREE, refinement, layers=layers).scene(problem, comm)
        return by_path(scene).value, scene.cells, scene.model.system.dofs

    value, cells, dofs = result(refinement, layers)
    value_if_finer, *_ = result(min(FINER * refinement, FINEST), layers)
    value_if_more_layers, *_ = result(refinement, layers + 1)  # in the same thickness
    scale = max(abs(value_if_finer), np.finfo(float).tiny)
    # from size s to s/q, an error in proportion to s^2 changes by 1 - 1/q^2 of itself
    size_error = abs(value_if_finer - value) / scale / (1 - FINER**-2)
    thickness_error = abs(value_if_more_layers - value) / scale / (1 - (layers / (layers + 1)) ** 2)
    return (
        AdaptiveRound(
            SOLID_DEGREE, refinement, cells, dofs, value, size_error + thickness_error, layers
        ),
        size_error,
        thickness_error,
    )


def adapted(
    problem: Problem, comm: MPI.Comm, say: Say = lambda line: None, doing: Say = lambda what: None
) -> Adapted:
    """Find a mesh on which the relative error of the result is below `mesh.tolerance`; collective.

    The result is `Ending.value`: the amplitude at an instability (of a pressure the knock-down
    factor); at the last target the load if a displacement is prescribed, else the displacement on
    which the load does work. It should not be zero.

    Parameters
    ----------
    say
        Called with one line of text per round.
    doing
        Called with a short description of the next activity.

    Raises
    ------
    NoResult
        If the problem has no result on any first mesh.
    """
    tolerance = problem.mesh.tolerance
    assert tolerance is not None
    if problem.body:
        return adapted_solid(problem, comm, say, doing)
    doing(f"a mesh for the tolerance {tolerance:g}: the path on a coarse one")
    choice, coarse_solution = _coarsest_path(problem, comm)
    return rounds(problem, choice, coarse_solution, _on_other_mesh, say, doing)


def rounds(
    problem: Problem,
    choice: Choice,
    coarse_solution: Solved,
    transferred: "Callable[[Problem, Choice, Solved], Solved]",
    say: Say,
    doing: Say,
    suffix: str = "",
) -> Adapted:
    """Find a mesh by rounds of error estimation and remeshing, from a coarse one; collective.

    Parameters
    ----------
    choice, coarse_solution
        Degree and size of the coarse mesh, and the scene on this mesh with its end.
    transferred
        Function that computes scene and end on another mesh, from those on a mesh near by.
    say, doing
        Called with a line of text per round, and with words for the next activity.
    suffix
        Words in the lines of the rounds that say which part of the run they are about.
    """
    tolerance = problem.mesh.tolerance
    assert tolerance is not None
    highest_degree = max(choice.degree, _fastest_degree(tolerance))
    most_rounds = MOST_ROUNDS + highest_degree - choice.degree
    tried_rounds: list[tuple[AdaptiveRound, Choice]] = []
    # the change of the result by one degree less, and the factor by which a sequence of changes in
    # this ratio is more than its first one
    change_below, series = inf, 1.0
    while True:
        doing(
            f"a mesh for the tolerance {tolerance:g}: round {len(tried_rounds) + 1}, degree "
            f"{choice.degree}, estimating"
        )
        fine_choice = replace(choice, degree=choice.degree + 1)
        fine_solution = transferred(problem, fine_choice, coarse_solution)
        change = estimated(coarse_solution[1].value, fine_solution[1].value)
        if change_below < inf:
            series = 1 / (1 - min(change / change_below, MAX_RATIO))
        round_result = _judged(choice, coarse_solution, series * change)
        tried_rounds.append((round_result, choice))
        say(f"tolerance {tolerance:g}{suffix}: {_words_of_round(round_result)}")
        # A mesh far better than the tolerance is made coarser. A meridian need not: it is cheap.
        coarse_scene, _ = coarse_solution
        least_error = 0.0 if coarse_scene.problem.axisymmetric else MIN_REDUCTION * tolerance
        if least_error <= round_result.estimate <= tolerance or len(tried_rounds) == most_rounds:
            break
        # first up to the degree that suits the tolerance: the fine solution has one degree more
        if round_result.estimate > tolerance and choice.degree < highest_degree:
            choice, coarse_solution, change_below = fine_choice, fine_solution, change
            continue
        next_choice = _remeshed(
            choice,
            coarse_solution,
            fine_solution,
            reduction=AIM * tolerance / round_result.estimate,
        )
        if next_choice is None:  # there is no other mesh
            break
        doing(
            f"a mesh for the tolerance {tolerance:g}: round {len(tried_rounds) + 1}, degree "
            f"{next_choice.degree}, solving"
        )
        choice, coarse_solution = next_choice, transferred(problem, next_choice, fine_solution)
        change_below = inf
    best, choice = _best_round(tried_rounds, tolerance)
    is_within = best.estimate <= tolerance
    if not is_within:
        say(
            f"warning: no mesh was found for the tolerance{suffix}; the least estimated error is "
            f"{best.estimate:.1e}"
        )
    return Adapted(problem, choice, best, [judged_round for judged_round, _ in tried_rounds])


def _words_of_round(round_result: AdaptiveRound) -> str:
    """Return degree, size, result and estimated error of a round in words."""
    return (
        f"degree {round_result.degree}, {round_result.cells} cells, {round_result.dofs} unknowns: "
        f"result {round_result.result:.9g}, estimated error {round_result.estimate:.1e}"
    )


def _best_round(
    tried_rounds: list[tuple[AdaptiveRound, Choice]], tolerance: float
) -> tuple[AdaptiveRound, Choice]:
    """Return the round with the fewest unknowns within the tolerance, or else of the least error.

    Rounds come with their choices.
    """
    rounds_within = [tried for tried in tried_rounds if tried[0].estimate <= tolerance]
    if rounds_within:
        return min(rounds_within, key=lambda round_and_choice: round_and_choice[0].dofs)
    return min(tried_rounds, key=lambda round_and_choice: round_and_choice[0].estimate)


def _fastest_degree(tolerance: float) -> int:
    """Return the degree of elements that is the fastest for a tolerance."""
    return next(degree for least_tolerance, degree in DEGREES if tolerance >= least_tolerance)


def _coarsest_path(problem: Problem, comm: MPI.Comm) -> tuple[Choice, Solved]:
    """Return the coarsest of the first meshes on which the path has a result, with scene and end.

    Collective.

    Raises
    ------
    NoResult
        If no first mesh has a result.
    """
    for refinement in FIRST_REFINEMENTS:
        choice = Choice(PATH_DEGREE, refinement)
        scene = choice.scene(problem, comm)
        try:
            return choice, (scene, by_path(scene))
        except NoResult as e:  # a finer mesh may have one
            failure = e
    raise failure


def _on_other_mesh(problem: Problem, choice: Choice, neighbour: Solved) -> Solved:
    """Return scene and end on another mesh, from those on a mesh near by; collective."""
    scene = choice.scene(problem, neighbour[0].comm)
    return scene, _instability_near_by(scene, *neighbour) or from_near(scene, *neighbour)


def _instability_near_by(scene: Scene, source: Scene, neighbour: Ending) -> Ending | None:
    """Return an instability with a mode, by one step from that on another mesh; collective.

    Parameters
    ----------
    source, neighbour
        Scene on the other mesh, and its end.

    Returns
    -------
    Ending or None
        None if the end is another one, is not found so, or its path is needed: cells of surfaces
        that gmsh triangulates are chosen by its tangent.
    """
    record = neighbour.record
    if record is None or not _is_refined_uniformly(scene.problem, neighbour):
        return None
    try:
        state = state_on_other_mesh(source, scene, record, carry)
        tangent = carry(source, scene, neighbour.tangent)
    except (
        NotEstimated,
        NotCarried,
        FoldLost,
        NoEigenpair,
        ModesNotFound,
        np.linalg.LinAlgError,
    ):
        return None
    point = replace(record.point, state=state, du=tangent)
    return replace(
        neighbour,
        value=state.mu[neighbour.name],
        state=state,
        tangent=tangent,
        record=replace(record, point=point, scene=scene),
    )


def _judged(choice: Choice, coarse_solution: Solved, estimate: float) -> AdaptiveRound:
    """Return the round of a mesh, with the estimated relative error of its result."""
    scene, coarse_end = coarse_solution
    return AdaptiveRound(
        choice.degree,
        choice.refinement,
        scene.cells,
        scene.model.system.dofs,
        coarse_end.value,
        estimate,
    )


def estimated(low: float, high: float) -> float:
    """Return the relative error of the result `low`, from the result `high` of one degree more."""
    return SAFETY * abs(high - low) / max(abs(high), np.finfo(float).tiny)


def _remeshed(
    choice: Choice, coarse_solution: Solved, fine_solution: Solved, reduction: float
) -> Choice | None:
    """Return another mesh of the same degree with a given change of the error; collective.

    Meridians and mesh files are refined uniformly. Other surfaces get cells with equal shares in
    the error, and grids intervals between their lines.

    Parameters
    ----------
    reduction
        Factor of the error.

    Returns
    -------
    Choice or None
        None if there is no other mesh, or it would not fit into memory.
    """
    (scene, _), degree = coarse_solution, choice.degree
    order = 2 * degree - 2  # of convergence of an energy
    problem = scene.problem
    if _is_refined_uniformly(problem, coarse_solution[1]):
        refinement_factor = np.clip(reduction, 1e-3, 1e3) ** (-1 / order)
        if reduction < 1:
            least_factor = MERIDIAN_FACTOR if problem.axisymmetric else GRID_FACTOR
            refinement_factor = max(refinement_factor, least_factor)
        new_refinement = np.clip(choice.refinement * refinement_factor, COARSEST, FINEST)
        refinement = round(float(new_refinement), 3)
        return Choice(degree, refinement) if refinement != choice.refinement else None
    if reduction > 1 and scene.cells <= MIN_CELLS_TO_COARSEN:
        return None
    centres, shares = indicators(coarse_solution, fine_solution)
    # sizes of elements over the surface, and the expected ratio of the numbers of cells
    size: Sampled | LineSpacing
    if isinstance(grid := problem.shape, Grid):
        lines = [grid.lines(axis, list(problem.points.values())) for axis in range(2)]
        size, expected_ratio = equidistributed_lines(
            lines, centres, shares, order, reduction, problem.material.h
        )
    else:
        size, expected_ratio = equidistributed(
            problem.size, centres, shares, order, reduction, problem.material.h
        )
    # the fine solution must fit too; twice its unknowns, since the ratio is an estimate
    fine_scene, _ = fine_solution
    if not _fits(fine_scene, 2 * fine_scene.model.system.dofs * expected_ratio):
        return None
    return Choice(degree, round(choice.refinement * expected_ratio**0.5, 3), size)


def _is_refined_uniformly(problem: Problem, end: Ending) -> bool:
    """Return whether a finer mesh has smaller cells everywhere.

    It has on meridians, of mesh files, and on grids at an instability with a mode.
    """
    is_grid = isinstance(problem.shape, Grid)
    is_mode_on_grid = is_grid and end.record is not None
    return problem.axisymmetric or bool(problem.mesh_file) or is_mode_on_grid


def _fits(scene: Scene, unknowns: float) -> bool:
    """Return whether a mesh with so many unknowns fits into the memory of all ranks; collective."""
    try:
        refuse_beyond_memory(
            replace(scene.problem, unknowns=unknowns), scene.comm.size, scene.comm.size
        )
    except CaseError:
        return not scene.comm.allreduce(1)
    # every rank adds 1 if it refuses, else 0: the sum is the number of ranks that refuse
    return not scene.comm.allreduce(0)
