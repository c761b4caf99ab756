"""How a shell is released at a fold."""

from pydantic import Field

from magshell_fenicsx.input.section import Section


class SnapSection(Section):
    """Of `then: snap`."""

    push: float = Field(default=0.05, gt=0, le=10)
    """How far it leaves the fold, along the path's direction there [h]"""
    damping: float = Field(default=0.1, gt=0, le=10)
    """Part of the critical drag of the lowest mode of vibration that is not neutral at the fold"""
    tolerance: float = Field(default=1e-3, ge=1e-9, le=1)
    """Largest estimated error of a time step [h]"""
