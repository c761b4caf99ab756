"""An imperfection by a formula of the place.

w0 is the deviation along the outward normal; places and w0 are over R, the reference length, from
`ByFormula` on.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.expressions import Formula, formula, formula_with_derivatives
from magshell_fenicsx.input.messages import shown_value
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.imperfections.imperfection import (
    ImperfectionGeometry,
    ImperfectionSection,
)
from magshell_fenicsx.shape.reference_shell import ReferenceShell

Array = NDArray[np.float64]
MAX_DEPTH = 0.5  # over R
MAX_ELEMENT_SIZE = 1e5  # over R: elements of any size show it
MAX_LOCAL_SHARE = 0.2  # of the surface: where so much needs small elements, all get them


class FormulaSection(ImperfectionSection):
    """w0/h as a formula of the place on the perfect surface; it must be smooth."""

    kind: Literal["formula"]
    w0: Formula
    """Outwards, of x, y, z over R [h]"""
    amplitude: float = Field(default=1.0, ge=-1e3, le=1e3)
    """Factor of the formula"""

    def account(self) -> str:
        return f"w0/h = {self.amplitude:g} ({self.w0})"

    def geometry(self, reference: ReferenceShell, key: str) -> ImperfectionGeometry:
        """Return the geometry of the formula on the perfect shell.

        The element size is 2.5/k of the shortest wave a sin(k x) that the formula resembles: a is
        half its range, a k² its largest second derivative. It varies from place to place if only a
        small part of the surface needs small elements.

        Raises
        ------
        CaseError
            If the formula is not finite somewhere, or too deep.
        """
        x = reference.perfect.sample()
        deviation = ByFormula(self.w0, self.amplitude / reference.R_over_h)
        # places where the value is no number, or too large
        bad_places = x[~(np.abs(deviation(x)) <= MAX_DEPTH)]
        if len(bad_places):
            place = ", ".join(f"{c:.3g}" for c in bad_places[0])
            raise CaseError(
                f"{key}.w0: {shown_value(self.w0)}: has no finite value, or one above half a "
                f"radius, at (x, y, z)/R = ({place})"
            )
        # the formula without its factor, so that the size does not depend on the amplitude
        range_of_formula = np.ptp(deviation(x)) / abs(deviation.factor or 1.0)
        formula_derivatives = formula_with_derivatives(self.w0)

        def sizes(places: Array) -> Array:
            """Return 2.5/k (n,) of a wave with the whole range and the curvature at each place.

            From the range 2 a and the curvature a k^2 follows 1/k, the root of half their quotient.
            """
            taylor = formula_derivatives(places)  # values and derivatives of the formula
            curvature = np.nan_to_num(np.linalg.norm(taylor.hessian, axis=(0, 1)))
            depth = max(range_of_formula, float(np.ptp(np.nan_to_num(taylor.value))))
            # the least divisor makes the size huge, not infinite, where the formula is flat
            return np.asarray(
                2.5 * np.sqrt(depth / 2 / np.maximum(curvature, 1e-300 + 1e-12 * depth))
            )

        # the least size; infinite for a formula that is flat
        at_sample = sizes(x)
        size = np.inf
        if range_of_formula > 0 and at_sample.min() < MAX_ELEMENT_SIZE:
            size = float(at_sample.min())
        # the size varies from place to place if few places need about the least size
        is_local = not (at_sample < 2 * size).mean() > MAX_LOCAL_SHARE
        return ImperfectionGeometry(deviation, size, sizes=sizes if is_local else None)


@dataclass(frozen=True)
class ByFormula:
    """The deviation w0 over R: a formula of places over R, times a factor."""

    w0: str
    factor: float

    def __call__(self, places: Array) -> Array:
        """Return w0 (n,) at places (n, 3)."""
        return np.asarray(self.factor * formula(self.w0)(*places.T))
