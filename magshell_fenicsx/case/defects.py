"""Defects of the mid-surface."""

from typing import Literal

from pydantic import Field

from magshell_fenicsx.case.base import Section


class DimpleSection(Section):
    """w0 = -δ (1 - (φ/φo)²)² around the pole, within the colatitude φo."""

    kind: Literal["dimple"]
    amplitude: float = Field(ge=0, le=50)
    """Depth δ [h]"""
    width: float = Field(ge=0.05, le=50)
    """Half-width φ̄o = φo (√(12(1 - ν²)) R/h)^(1/2)"""
