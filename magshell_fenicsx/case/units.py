"""The units of a case."""

from collections.abc import Collection

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.targets import given
from magshell_fenicsx.parts.magnetism.fields import MU_0
from magshell_fenicsx.quantities.units import Sizes, sizes


def sizes_of(case: Case, moments: Collection[str] = ()) -> Sizes:
    """The sizes of what a case gives with units; `moments` are columns of reactions that are moments."""
    shell, magnetic = case.shell, case.magnetic
    R, E = given(shell)
    by_sources = magnetic is not None and not magnetic.applied.beside
    per_lambda = None
    if magnetic and magnetic.remanent.flux_density and E:
        per_lambda = 100 / case.lambda_m if by_sources else 1e3 * MU_0 * E / magnetic.remanent.flux_density
    of = sizes(
        shell.poisson_ratio,
        shell.R_over_h,
        R=R,
        E=E,
        per_lambda=per_lambda,
        in_seconds=shell.with_units and case.time_unit is not None,
    )
    return Sizes(of, "%" if by_sources else "mT", moments)
