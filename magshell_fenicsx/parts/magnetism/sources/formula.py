"""A field by formulas of x, y, z over the reference length R, in tesla."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from magshell_fenicsx.input.expressions import Formula, FormulasInSpace, formula_with_derivatives
from magshell_fenicsx.input.section import FluxDensity
from magshell_fenicsx.parts.magnetism.sources.source import Array, FieldOfSource, SourceSection


class FormulaSource(SourceSection):
    """A flux density by formulas of the deformed position; they must be twice differentiable."""

    kind: Literal["formula"]
    components: Annotated[list[Formula], Field(min_length=3, max_length=3)]
    """Of x, y, z over R along its own axes, from its position [flux_density]"""
    flux_density: Annotated[FluxDensity, Field(ge=-1e3, le=1e3)] = 1.0
    """What the components are over; 1 T by default"""

    def words(self) -> str:
        """Return the formulas, for the account of what is built."""
        return f"formulas ({', '.join(self.components)})"

    def field(self, key: str, R: float) -> FieldOfSource:
        """Return the field of the formulas in the source's own axes, places in m.

        `key` is not used. The field has no outline, and nowhere where a formula is not finite.
        """
        formulas = FormulasInSpace(
            [formula_with_derivatives(text) for text in self.components], np.eye(3)
        )

        def values(x: Array) -> tuple[Array, Array, Array]:
            """Return B at places x (n, 3) in m, with its first and second derivatives."""
            # derivatives are by lengths over R
            B, G, H = formulas(np.asarray(x / R))
            return self.flux_density * B, self.flux_density / R * G, self.flux_density / R**2 * H

        return FieldOfSource(values, [], "where there is no finite value or derivative of")
