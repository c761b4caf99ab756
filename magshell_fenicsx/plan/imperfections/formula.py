"""An imperfection by a formula of the place."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.expressions import formula, with_derivatives
from magshell_fenicsx.case.imperfections.formula import FormulaSection
from magshell_fenicsx.case.messages import shown
from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.plan.imperfections.flaw import Flaw
from magshell_fenicsx.plan.outline import Outline

Array = NDArray[np.float64]
DEEPEST = 0.5  # over R


@dataclass(frozen=True)
class ByFormula:
    """A deviation."""

    w0: str
    factor: float

    def __call__(self, places: Array) -> Array:
        return np.asarray(self.factor * formula(self.w0)(*places.T))


def by_formula(section: FormulaSection, case: Case, drawn: Outline, key: str) -> Flaw:
    """See `Flaw`; the element size is 2.5/k of the shortest wave sin(k x) that the formula resembles.

    Raises
    ------
    CaseError
        If it is not finite somewhere, or too deep.
    """
    x = drawn.sample()
    deviation = ByFormula(section.w0, section.amplitude / case.shell.R_over_h)
    bad = x[~(np.abs(deviation(x)) <= DEEPEST)]
    if len(bad):
        place = ", ".join(f"{c:.3g}" for c in bad[0])
        raise CaseError(
            f"shell.{key}.w0: {shown(section.w0)}: has no finite value, or one above half a radius, at (x, y, z)/R = "
            f"({place})"
        )
    found = with_derivatives(section.w0)(x)
    curved = np.nan_to_num(np.linalg.norm(found.hessian, axis=(0, 1))).max()
    largest = np.ptp(found.value)
    return Flaw(deviation, 2.5 * np.sqrt(largest / 2 / curved) if curved * largest > 0 else np.inf)
