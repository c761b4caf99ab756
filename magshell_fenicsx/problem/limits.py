"""What a problem may ask for that could not be built: refused before anything is."""

from dataclasses import dataclass
from math import log

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.platform.environment import available_memory
from magshell_fenicsx.problem.problem import Problem, layers
from magshell_fenicsx.problem.sizes import degree_of
from magshell_fenicsx.shape.sections import MeshSurface

PROCESS = 0.25e9  # bytes of a process before its model
PER_UNKNOWN = {2: 1.0e3, 3: 1.1e3, 4: 1.3e3, 5: 1.65e3}  # degree -> bytes over N ln N, full shells
SOLID = 0.7e3  # likewise of a body
EXCLUDED, INDEFINITE = (
    0.6,
    0.7,
)  # added parts: for the modes that a half excludes, and past an instability


@dataclass(frozen=True)
class Memory:
    """What a run takes, estimated: `unknowns` of a problem, of which each of some ranks has a part.

    Attributes
    ----------
    least
        Bytes on a path where the tangent stays positive definite, as measured (docs/scale.md).
    most
        On one past an instability, where factors of CHOLMOD and of MUMPS are kept.
    """

    unknowns: float
    least: float
    most: float

    @classmethod
    def of(
        cls, context: Context, unknowns: float, *, half: bool = False, ranks: int = 1, here: int = 1
    ) -> "Memory":
        """That of `here` of the `ranks` of a run, which are those on one machine."""
        each = (
            SOLID
            if context.solid
            else PER_UNKNOWN.get(degree_of(context), PER_UNKNOWN[max(PER_UNKNOWN)])
        )
        shared = each * unknowns * log(max(unknowns, 2.0)) * here / ranks
        least = PROCESS * here + shared * (1 + EXCLUDED * half)
        return cls(unknowns, least, least + INDEFINITE * shared)

    def words(self, free: float) -> str:
        return f"{self.least / 1e9:.3g} to {self.most / 1e9:.3g} GB of memory, and {free / 1e9:.3g} GB are free"


def unknowns_of(context: Context, cells: float) -> float:
    """Estimate the unknowns of a number of triangles before they are made: of degree k, one brings
    3 k^2/2.

    The body over it brings three hexahedra of degree 2 in each layer.
    """
    return cells * (
        36 * (2 * len(layers(context)) - 1) if context.solid else 1.5 * degree_of(context) ** 2
    )


def refuse_beyond_memory(problem: Problem, ranks: int = 1, here: int = 1) -> str | None:
    """What is to be said of a model that may be too large past an instability; None of others.

    Parameters
    ----------
    ranks, here
        The processes of the run, and those of them on this machine.

    Raises
    ------
    CaseError
        If even the least memory that it takes is not there.
    """
    try:
        free = available_memory()
    except ValueError as e:
        raise CaseError(str(e)) from None
    needed = Memory.of(problem.context, problem.unknowns, half=problem.half, ranks=ranks, here=here)
    if problem.axisymmetric or needed.most <= free:
        return None
    if needed.least <= free:
        return (
            f"mesh: about {needed.unknowns:.2g} unknowns take {needed.words(free)}: past an instability that may be "
            "too little"
        )
    shell, degree = problem.context.shell, degree_of(problem.context)
    how = f"lower mesh.refinement ({problem.mesh.refinement:g}) or mesh.degree ({degree})"
    if isinstance(shell, MeshSurface):
        how = f"take a coarser mesh file, or a lower mesh.degree ({degree})"
    hint = (
        ""
        if problem.half
        else "; where shell, fields and loads have a mirror plane, symmetry: half halves it"
    )
    raise CaseError(
        f"mesh: about {needed.unknowns:.2g} unknowns at radius/thickness {shell.R_over_h:g} take "
        f"{needed.words(free)}: {how}{hint}; ranks on several machines share it; MAGSHELL_MEMORY=GB in the environment "
        "says what to count on in place of what is free"
    )
