"""The units of a case."""

from collections.abc import Collection
from dataclasses import replace
from math import isnan

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.targets import given
from magshell_fenicsx.parts.magnetism.fields import MU_0
from magshell_fenicsx.quantities.registry import Sizes


def sizes_of(case: Case, moments: Collection[str] = ()) -> Sizes:
    """The sizes of what a case gives with units; `moments` are columns of reactions that are moments."""
    shell, magnetic = case.shell, case.magnetic
    units = given(shell)
    if magnetic and magnetic.remanent.flux_density and not isnan(units.E):
        if magnetic.applied.beside:
            units = replace(units, applied=1e3 * MU_0 * units.E / magnetic.remanent.flux_density)
        else:
            units = replace(units, strength=100 / case.lambda_m)
    if shell.with_units and case.time_unit is not None:
        units = replace(units, second=1.0)
    return Sizes(units, moments)
