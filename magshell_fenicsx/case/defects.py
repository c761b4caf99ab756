"""Defects of the mid-surface."""

from typing import Literal

from pydantic import Field

from magshell_fenicsx.case.base import Section


class DimpleSection(Section):
    """w0 = -delta (1 - (phi/phi_o)^2)^2 at the pole."""

    kind: Literal["dimple"]
    amplitude: float = Field(ge=0, le=50, description="delta/h")
    width: float = Field(ge=0.05, le=50, description="phi_bar_o = phi_o (sqrt(12 (1 - nu^2)) R/h)^(1/2)")
