"""A field by formulas, in tesla."""

from typing import Annotated, Literal

from pydantic import Field

from magshell_fenicsx.input.expressions import Formula
from magshell_fenicsx.input.section import FluxDensity
from magshell_fenicsx.parts.magnetism.sources.source import SourceSection


class FormulaSource(SourceSection):
    """A flux density by formulas of the deformed position; they must be twice differentiable."""

    kind: Literal["formula"]
    components: Annotated[list[Formula], Field(min_length=3, max_length=3)]
    """Of x, y, z over R along its own axes, from its position [flux_density]"""
    flux_density: Annotated[FluxDensity, Field(ge=-1e3, le=1e3)] = 1.0
    """What the components are over; 1 T by default"""

    def words(self) -> str:
        return f"formulas ({', '.join(self.components)})"
