"""Problems as a program gives them: a problem, a case, a mapping like a case file, or a file."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.case_variants import open_case
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.problem.problem import Problem

ProblemSource: TypeAlias = Problem | Case | Mapping[str, Any] | str | Path


def problem_of(
    source: ProblemSource, comm: MPI.Comm = MPI.COMM_WORLD, terms: Sequence[OwnTerm] = ()
) -> Problem:
    """Return the problem itself, or that of a case, a mapping or the file at a path; collective.

    Parameters
    ----------
    terms
        User-defined energies besides those of the case, with their amplitudes at `OwnTerm.value`.

    Raises
    ------
    CaseError, MeshError
        If it is none of these, or no problem can be made of it.
    """
    if isinstance(source, Problem):
        if terms:
            raise CaseError(
                "terms: a problem has its energies already: give them to what makes the problem"
            )
        return source
    case = open_case(source, comm)
    try:
        return (case.with_terms([*case.own_terms, *terms]) if terms else case).problem()
    except (CaseError, MeshError) as e:
        raise type(e)(case.with_place(str(e))) from None


def processes(source: Any, comm: MPI.Comm | None = None) -> MPI.Comm:
    """Return the processes of a run: by default those of a problem's mesh, or all.

    Raises
    ------
    CaseError
        If `comm` is no communicator.
    """
    if comm is not None and not isinstance(comm, MPI.Comm):
        raise CaseError(f"comm: {comm!r}: give a communicator, such as MPI.COMM_WORLD of mpi4py")
    mesh_file = source.mesh_file if isinstance(source, Problem) else None
    if comm:
        return comm
    return mesh_file.user_mesh.comm if mesh_file and mesh_file.user_mesh else MPI.COMM_WORLD
