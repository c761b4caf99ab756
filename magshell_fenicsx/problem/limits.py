"""What a case may ask for that could not be built: refused before anything is."""

from dataclasses import dataclass
from math import log

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.expressions import formula, with_derivatives
from magshell_fenicsx.input.messages import shown
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.magnetism.sources.field import placed
from magshell_fenicsx.platform.memory import available
from magshell_fenicsx.problem.body import layers
from magshell_fenicsx.problem.problem import Plan
from magshell_fenicsx.shape.sections import MeshSurface

Array = NDArray[np.float64]
PROCESS = 0.25e9  # bytes of a process before its model
PER_UNKNOWN = {2: 1.0e3, 3: 1.1e3, 4: 1.3e3, 5: 1.65e3}  # degree -> bytes over N ln N, full shells
SOLID = 0.7e3  # likewise of a body
EXCLUDED, INDEFINITE = 0.6, 0.7  # added parts: for the modes that a half excludes, and past an instability
SOURCES = 1e-9  # of the field's derivatives: rounding
LARGEST_RATIO = 1e6  # of a field over its unit, as of a remanence
SMALLEST_FIELD, LARGEST_FIELD = 1e-12, 10.0  # of lambda_m: rounding, and a thousand times what destabilises a shell


@dataclass(frozen=True)
class Memory:
    """What a run takes, estimated: `unknowns` of a case, of which each of some ranks has a part.

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
    def of(cls, case: Case, unknowns: float, *, half: bool = False, ranks: int = 1, here: int = 1) -> "Memory":
        """That of `here` of the `ranks` of a run, which are those on one machine."""
        each = SOLID if case.model == "solid" else PER_UNKNOWN.get(case.degree, PER_UNKNOWN[max(PER_UNKNOWN)])
        shared = each * unknowns * log(max(unknowns, 2.0)) * here / ranks
        least = PROCESS * here + shared * (1 + EXCLUDED * half)
        return cls(unknowns, least, least + INDEFINITE * shared)

    def words(self, free: float) -> str:
        return f"{self.least / 1e9:.3g} to {self.most / 1e9:.3g} GB of memory, and {free / 1e9:.3g} GB are free"


def unknowns_of(case: Case, cells: float) -> float:
    """Estimate the unknowns of a number of triangles before they are made: of degree k, one brings 3 k^2/2.

    The body over it brings three hexahedra of degree 2 in each layer.
    """
    return cells * (36 * (2 * len(layers(case.context)) - 1) if case.model == "solid" else 1.5 * case.degree**2)


def refuse_beyond_memory(case: Case, plan: Plan, ranks: int = 1, here: int = 1) -> str | None:
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
        free = available()
    except ValueError as e:
        raise CaseError(str(e)) from None
    needed = Memory.of(case, plan.unknowns, half=plan.half, ranks=ranks, here=here)
    if plan.axisymmetric or needed.most <= free:
        return None
    if needed.least <= free:
        return (
            f"mesh: about {needed.unknowns:.2g} unknowns take {needed.words(free)}: past an instability that may be "
            "too little"
        )
    how = f"lower mesh.refinement ({case.mesh.refinement:g}) or mesh.degree ({case.degree})"
    if isinstance(case.shell, MeshSurface):
        how = f"take a coarser mesh file, or a lower mesh.degree ({case.degree})"
    hint = "" if plan.half else "; where shell, fields and loads have a mirror plane, symmetry: half halves it"
    raise CaseError(
        f"mesh: about {needed.unknowns:.2g} unknowns at radius/thickness {case.shell.R_over_h:g} take "
        f"{needed.words(free)}: {how}{hint}; ranks on several machines share it; MAGSHELL_MEMORY=GB in the environment "
        "says what to count on in place of what is free"
    )


def refuse_unbounded_fields(case: Case, r0: Array) -> None:
    """Look at lambda_m and, at the points `r0` (n, 3), at the formulas of the remanence and of the applied field.

    Raises
    ------
    CaseError
        If one is not finite, or beyond all sense.
    """
    largest = LARGEST_FIELD * (100.0 if case.sources else 1.0)  # of 1 T, which no source makes on a shell
    if case.lambda_m and not SMALLEST_FIELD <= abs(case.lambda_m) <= largest:
        raise CaseError(
            f"magnetic: lambda_m is {case.lambda_m:.4g}; allowed are 0 and, of either sign, "
            f"{SMALLEST_FIELD:g} to {largest:g}"
        )
    if not case.magnetic:
        return
    for source in placed(case.context):
        B = source(r0)[0]
        if len(strong := r0[np.isfinite(B).all(axis=1) & (np.abs(B) > LARGEST_RATIO).any(axis=1)]):
            x, y, z = strong[0]
            raise CaseError(
                f"{source.key}: its field is above {LARGEST_RATIO:g} times the unit of the field at (x, y, z)/R = "
                f"({x:.3g}, {y:.3g}, {z:.3g})"
            )
        bad = r0[~np.isfinite(B).all(axis=1)]
        if len(bad):
            x, y, z = bad[0]
            raise CaseError(
                f"{source.key}: the shell's point (x, y, z)/R = ({x:.3g}, {y:.3g}, {z:.3g}) {source.nowhere}; "
                "see its position"
            )
    found = {"remanent": case.magnetic.remanent.components, "applied": case.magnetic.applied.components}
    for key, text in ((key, text) for key, texts in found.items() for text in texts or []):
        bad = r0[~(np.abs(formula(text)(*r0.T)) <= 1e6)]
        if len(bad):
            x, y, z = bad[0]
            raise CaseError(
                f"magnetic.{key}.components: {shown(text)}: has no finite value (or one above 1e6) "
                f"at (x, y, z) = ({x:.3g}, {y:.3g}, {z:.3g})"
            )


def sources_beside(case: Case, r0: Array) -> str | None:
    """What is unphysical in formulas of the applied field at the points `r0` (n, 3); None if nothing is.

    A field of magnets and currents elsewhere has neither a divergence nor a curl.
    """
    components = case.magnetic.applied.components if case.magnetic and case.lambda_m else None
    if not components:
        return None
    G = np.stack([with_derivatives(text)(r0).gradient for text in components])
    divergence, curl = np.abs(np.trace(G)), np.linalg.norm(G - G.swapaxes(0, 1), axis=(0, 1)) / np.sqrt(2)
    known = np.nan_to_num(divergence), np.nan_to_num(curl)
    found = [float(values.max()) for values in known]
    if max(found) <= SOURCES * np.nan_to_num(np.abs(G)).max():
        return None
    x, y, z = r0[np.argmax(np.maximum(*known))]
    return (
        f"magnetic.applied.components: on the shell div B is up to {found[0]:.3g} and curl B up to {found[1]:.3g} "
        f"B^a/R, most of it at (x, y, z) = ({x:.3g}, {y:.3g}, {z:.3g}): "
        "magnets and currents elsewhere make no such field"
    )
