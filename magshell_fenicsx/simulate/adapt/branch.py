"""A mesh for the branch on which a run goes on in another model, and the error at the branch's end.

The bifurcation has the mesh of the first model. The larger model, which has the mode that the first
one excludes by its symmetry, has a mesh of its own. It is found in the same rounds (meshes that are
tried, each with an estimated error). The result there is the load at the end of the branch if a
volume or a displacement is prescribed, else the displacement at the prescribed load.

A choice is degree and mesh; the end of a run is its result with the state there; `Solved` is a
scene with its end.
"""

from mpi4py import MPI

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.adapt.choice import Adapted, Choice
from magshell_fenicsx.simulate.adapt.ending import Ending, NoResult, at_target, near_by
from magshell_fenicsx.simulate.adapt.tolerance import (
    FIRST_REFINEMENTS,
    PATH_DEGREE,
    Say,
    Solved,
    estimated,
    rounds,
)
from magshell_fenicsx.simulate.follow import follow
from magshell_fenicsx.simulate.path_records import LOCATED
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene


def branched(
    first: Adapted, comm: MPI.Comm, say: Say = lambda line: None, doing: Say = lambda what: None
) -> Adapted | None:
    """Find the mesh of the larger model in which a branch is followed; collective.

    Parameters
    ----------
    first
        The mesh that was found for the first model.
    say, doing
        Called with one line of text per round, and with a description of the next activity.

    Returns
    -------
    Adapted or None
        None if the run does not go on in another model.

    Raises
    ------
    NoResult
        If the branch ends at no single load, or is lost.
    """
    doing("a mesh for the tolerance on the branch: the path on a coarse one")
    start_on_branch = _coarsest_branch(first, comm)
    if start_on_branch is None:
        return None
    choice, coarse_solution = start_on_branch
    larger_scene, _ = coarse_solution
    return rounds(
        larger_scene.problem,
        choice,
        coarse_solution,
        _on_finer_mesh,
        say,
        doing,
        suffix=" on the branch",
    )


def branch_error(adapted: Adapted, record: Record) -> float:
    """Return the estimated relative error of the result at the end of a branch; collective.

    Parameters
    ----------
    adapted
        The mesh that was found for the branch.
    record
        Last record of the branch.

    Raises
    ------
    NoResult
        If the branch ends at no single load, or its end is not found with one degree more.
    """
    scene, coarse_end = _ended(record)
    choice = adapted.choice
    higher_degree = Choice(choice.degree + 1, choice.refinement, choice.size)
    _, fine_end = _on_finer_mesh(scene.problem, higher_degree, (scene, coarse_end))
    return estimated(coarse_end.value, fine_end.value)


def _coarsest_branch(first: Adapted, comm: MPI.Comm) -> tuple[Choice, Solved] | None:
    """Return the coarsest mesh on which the branch has a result, with scene and end; collective.

    None without a branch in another model.

    Parameters
    ----------
    first
        The mesh that was found for the first model.

    Raises
    ------
    NoResult
        If the branch has no result on any mesh.
    """
    failure = NoResult("no mesh is fine enough")
    if first.requested.body:
        raise NoResult("of a solid nothing is carried between meshes")
    for refinement in FIRST_REFINEMENTS:
        scene, choice = first.choice.scene(first.requested, comm), Choice(PATH_DEGREE, refinement)
        scene.remesh = choice.applied  # the mesh of the larger model alone
        last_record: Record | None = None
        try:
            # the last record in the larger model that is no instability
            for record in follow(scene, search=False, remark=lambda text: None):
                if record.branch and record.scene is scene:  # the branch stays in the first model
                    break
                if record.scene is not scene and record.label not in LOCATED:
                    last_record = record
        except Stopped as e:
            failure = NoResult(str(e))
            continue
        if last_record is None:
            return None
        return choice, _ended(last_record)
    raise failure


def _ended(record: Record) -> tuple[Scene, Ending]:
    """Return the scene of a branch's last record, and the end there.

    Raises
    ------
    NoResult
        If the branch ends at no single load, or with another conjugate held.
    """
    if record.amplitude in ("", "time"):
        raise NoResult("a motion ends at no single load")
    assert record.scene
    end = at_target(record.scene, record)
    if end.kind == "held":  # on another mesh such an end cannot be solved directly
        raise NoResult("what is held besides loads needs the path")
    return record.scene, end


def _on_finer_mesh(problem: Problem, choice: Choice, neighbour: Solved) -> Solved:
    """Return scene and end on another mesh, from those on a mesh near by; collective.

    Raises
    ------
    NoResult
        If there is no such mesh, or no end on it.
    """
    try:
        scene = choice.scene(problem, neighbour[0].comm)
    except (CaseError, MeshError) as e:
        raise NoResult(str(e)) from None
    end = near_by(scene, *neighbour)
    if end is None:
        raise NoResult("the end of the branch is not found on another mesh")
    return scene, end
