"""An imperfection by a formula of the place."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.imperfections.formula import FormulaSection
from magshell_fenicsx.input.expressions import formula, with_derivatives
from magshell_fenicsx.input.messages import shown
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.imperfections.flaw import Flaw
from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
DEEPEST = 0.5  # over R
WIDE = 1e5  # over R: elements of any size show it
ALIKE = 0.2  # of the surface: where so much needs small elements, all get them


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
    largest, derived = np.ptp(deviation(x)) / abs(deviation.factor or 1.0), with_derivatives(section.w0)

    def sizes(places: Array) -> Array:
        """2.5/k of the wave with the depth of the whole and the curvature of each place."""
        found = derived(places)
        curved = np.nan_to_num(np.linalg.norm(found.hessian, axis=(0, 1)))
        depth = max(largest, float(np.ptp(np.nan_to_num(found.value))))
        return np.asarray(2.5 * np.sqrt(depth / 2 / np.maximum(curved, 1e-300 + 1e-12 * depth)))

    at = sizes(x)
    size = float(at.min()) if largest > 0 and at.min() < WIDE else np.inf
    local = not (at < 2 * size).mean() > ALIKE
    return Flaw(deviation, size, sizes=sizes if local else None)
