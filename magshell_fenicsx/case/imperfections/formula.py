"""An imperfection by a formula."""

from typing import Literal

from pydantic import Field

from magshell_fenicsx.input.expressions import Formula
from magshell_fenicsx.parts.imperfections.place import ImperfectionSection


class FormulaSection(ImperfectionSection):
    """w0/h as a formula of the place on the perfect surface; it must be smooth."""

    kind: Literal["formula"]
    w0: Formula
    """Outwards, of x, y, z over R [h]"""
    amplitude: float = Field(default=1.0, ge=-1e3, le=1e3)
    """Factor of the formula"""

    def account(self) -> str:
        return f"w0/h = {self.amplitude:g} ({self.w0})"
