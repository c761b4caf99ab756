"""What a case may ask for that could not be built: refused before anything is."""

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.expressions import formula, with_derivatives
from magshell_fenicsx.case.messages import shown
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.plan.body import layers
from magshell_fenicsx.plan.sources.registered import placed

Array = NDArray[np.float64]
MOST_UNKNOWNS = 2_000_000  # whose factors fill the memory of a large workstation
SOURCES = 1e-9  # of the field's derivatives: rounding
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
    for source in placed(case):
        bad = r0[~np.isfinite(source(r0)[0]).all(axis=1)]
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
