"""A field by formulas."""

import numpy as np

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.sources.formula import FormulaSource
from magshell_fenicsx.input.expressions import with_derivatives
from magshell_fenicsx.input.formulas_in_space import FormulasInSpace
from magshell_fenicsx.parts.magnetism.sources.known import Array, Known


def by_formula(section: FormulaSource, case: Case, key: str) -> Known:
    """See `Known`."""
    R, formulas = case.shell.reference, FormulasInSpace([with_derivatives(t) for t in section.components], np.eye(3))

    def field(x: Array) -> tuple[Array, Array, Array]:
        B, G, H = formulas(np.asarray(x / R))
        return section.flux_density * B, section.flux_density / R * G, section.flux_density / R**2 * H

    return Known(field, [], "where there is no finite value or derivative of")
