"""Memory that a run needs, estimated before anything is built; what is too large is refused.

The estimates are fits of measured runs (docs/scale.md): a direct solver takes bytes in proportion
to N ln N for N unknowns. Ranks are the processes of a run, which share the unknowns. A half or a
sector is a part of a shell beside its symmetry planes.
"""

from dataclasses import dataclass
from math import log

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.ability import Context
from magshell_fenicsx.parts.shell_sections import MeshSurface
from magshell_fenicsx.platform.environment import available_memory
from magshell_fenicsx.problem.mesh_sizes import degree_of
from magshell_fenicsx.problem.problem import Problem, layer_bounds

BYTES_PER_PROCESS = 0.25e9  # before its model
# degree -> bytes over N ln N of N unknowns, of full shells
BYTES_PER_UNKNOWN = {2: 1.0e3, 3: 1.1e3, 4: 1.3e3, 5: 1.65e3}
BYTES_PER_UNKNOWN_OF_SOLID = 0.7e3
# parts that are added: for the symmetry-breaking modes of a half, and past an instability
SYMMETRY_BREAKING_SHARE, INDEFINITE_SHARE = 0.6, 0.7
# degree -> ratio of the bytes with factors of a skewed tangent K + N beside those of K
SKEWED_RATIO = {2: 1.7, 3: 1.8, 4: 1.9, 5: 2.0}
UNKNOWNS_PER_TRIANGLE = 1.5  # over the square of the degree
UNKNOWNS_PER_SOLID_LAYER = 36  # of three hexahedra of degree 2, for a layer of nodes


@dataclass(frozen=True)
class MemoryEstimate:
    """Memory that the ranks of a run on one machine need.

    Attributes
    ----------
    unknowns
        Number of unknowns of the problem, of which each rank has a part.
    min_bytes
        Bytes on a path where the tangent stays positive definite, as measured (docs/scale.md).
    max_bytes
        Bytes past an instability, where factors of CHOLMOD and of MUMPS are kept.
    """

    unknowns: float
    min_bytes: float
    max_bytes: float

    @classmethod
    def for_unknowns(
        cls,
        context: Context,
        unknowns: float,
        *,
        half: bool = False,
        skewed: bool = False,
        ranks: int = 1,
        local_ranks: int = 1,
    ) -> "MemoryEstimate":
        """Estimate the memory that the ranks on one machine need for a number of unknowns.

        Parameters
        ----------
        half
            Whether a half or a sector is modelled.
        skewed
            Whether the tangent is skewed, as beside an edge where a live pressure has no potential.
        ranks, local_ranks
            The processes of the run, and those of them on this machine.
        """
        # a degree that was not measured counts as the highest
        degree = min(degree_of(context), max(BYTES_PER_UNKNOWN))
        bytes_per_unknown = BYTES_PER_UNKNOWN[degree]
        if context.solid:
            bytes_per_unknown = BYTES_PER_UNKNOWN_OF_SOLID
        model_bytes = bytes_per_unknown * unknowns * log(max(unknowns, 2.0)) * local_ranks / ranks
        # a half also factors the tangent of its symmetry-breaking modes
        models = 1 + SYMMETRY_BREAKING_SHARE * half
        factors = SKEWED_RATIO[degree] if skewed else 1.0
        min_bytes = BYTES_PER_PROCESS * local_ranks + model_bytes * models * factors
        return cls(unknowns, min_bytes, min_bytes + INDEFINITE_SHARE * model_bytes)

    def words(self, free_bytes: float) -> str:
        """Return the estimate beside the free memory (bytes) as text."""
        return (
            f"{self.min_bytes / 1e9:.3g} to {self.max_bytes / 1e9:.3g} GB of memory, "
            f"and {free_bytes / 1e9:.3g} GB are free"
        )


def unknowns_of(context: Context, cells: float) -> float:
    """Return the estimated number of unknowns of a mesh with a number of triangles.

    A triangle of degree k adds 3 k^2/2 unknowns. In a solid it adds three hexahedra of degree 2 in
    each layer.
    """
    if context.solid:  # elements of degree 2 have 2 n + 1 layers of nodes; n + 1 bounds for n
        return cells * (UNKNOWNS_PER_SOLID_LAYER * (2 * len(layer_bounds(context)) - 1))
    return cells * (UNKNOWNS_PER_TRIANGLE * degree_of(context) ** 2)


def refuse_beyond_memory(
    problem: Problem, ranks: int = 1, local_ranks: int = 1, *, skewed: bool = False
) -> str | None:
    """Refuse a problem that needs more memory than is free.

    Parameters
    ----------
    ranks, local_ranks
        The processes of the run, and those of them on this machine.
    skewed
        Whether the tangent is known to be skewed, which takes the mesh to know.

    Returns
    -------
    warning
        Message about a model that may be too large past an instability; None if it is small enough.

    Raises
    ------
    CaseError
        If less memory is free than the problem needs at least.
    """
    try:
        free_bytes = available_memory()
    except ValueError as e:
        raise CaseError(str(e)) from None
    estimate = MemoryEstimate.for_unknowns(
        problem.context,
        problem.unknowns,
        half=problem.is_half,
        skewed=skewed,
        ranks=ranks,
        local_ranks=local_ranks,
    )
    # a meridian is always small
    if problem.axisymmetric or estimate.max_bytes <= free_bytes:
        return None
    if estimate.min_bytes <= free_bytes:
        return (
            f"mesh: about {estimate.unknowns:.2g} unknowns take {estimate.words(free_bytes)}: "
            "past an instability that may be too little"
        )
    shell, degree = problem.context.shell, degree_of(problem.context)
    remedy = f"lower mesh.refinement ({problem.mesh.refinement:g}) or mesh.degree ({degree})"
    if isinstance(shell, MeshSurface):
        remedy = f"take a coarser mesh file, or a lower mesh.degree ({degree})"
    hint = ""
    if not problem.is_half:
        hint = "; where shell, fields and loads have a mirror plane, symmetry: half halves it"
    raise CaseError(
        f"mesh: about {estimate.unknowns:.2g} unknowns at radius/thickness {shell.R_over_h:g} take "
        f"{estimate.words(free_bytes)}: {remedy}{hint}; ranks on several machines share it; "
        "MAGSHELL_MEMORY=GB in the environment says what to count on in place of what is free"
    )
