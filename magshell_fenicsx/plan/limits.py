"""What a case may ask for that could not be built: refused before anything is."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.expressions import formula
from magshell_fenicsx.case.messages import shown
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.plan.body import layers

Array = NDArray[np.float64]
MOST_UNKNOWNS = 2_000_000  # whose factors fill the memory of a large workstation
SMALLEST_FIELD, LARGEST_FIELD = 1e-12, 10.0  # of lambda_m: rounding, and a thousand times what destabilises a shell


def refuse_too_many(case: Case, cells: float, hint: str = "") -> None:
    """Estimate the unknowns of a number of triangles before they are made: of degree k, one brings 3 k^2/2.

    The body over it brings three hexahedra of degree 2 in each layer.

    Raises
    ------
    CaseError
        If the unknowns are more than `MOST_UNKNOWNS`.
    """
    per_triangle = 1.5 * case.degree**2
    if case.model == "solid":
        per_triangle = 36 * (2 * len(layers(case)) - 1)
    unknowns = per_triangle * cells
    if unknowns > MOST_UNKNOWNS:
        raise CaseError(
            f"mesh: about {unknowns:.1e} unknowns at radius/thickness {case.shell.R_over_h:g}, at most "
            f"{MOST_UNKNOWNS:.0e} are built: lower mesh.refinement ({case.mesh.refinement:g}) or mesh.degree "
            f"({case.degree}){hint}"
        )


def refuse_unbounded_fields(case: Case, r0: Array) -> None:
    """Look at lambda_m and, at the points `r0` (n, 3), at the formulas of the remanence.

    Raises
    ------
    CaseError
        If one is not finite, or beyond all sense.
    """
    if case.lambda_m and not SMALLEST_FIELD <= abs(case.lambda_m) <= LARGEST_FIELD:
        raise CaseError(
            f"magnetic: lambda_m is {case.lambda_m:.4g}; allowed are 0 and, of either sign, "
            f"{SMALLEST_FIELD:g} to {LARGEST_FIELD:g}"
        )
    for text in (case.magnetic and case.magnetic.remanent.components) or []:
        bad = r0[~(np.abs(formula(text)(*r0.T)) <= 1e6)]
        if len(bad):
            x, y, z = bad[0]
            raise CaseError(
                f"magnetic.remanent.components: {shown(text)}: has no finite value (or one above 1e6) "
                f"at (x, y, z) = ({x:.3g}, {y:.3g}, {z:.3g})"
            )
