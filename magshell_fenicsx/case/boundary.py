"""Conditions on the named edges of a geometry."""

from typing import Literal

from magshell_fenicsx.case.base import Section

EDGES = {"hemisphere": ("equator",), "disc": ("rim",), "strip": ("root", "tip", "sides")}
EdgeCondition = Literal["clamped", "simply supported", "free"]


class BoundarySection(Section):
    """Edges that are not named are free."""

    equator: EdgeCondition | None = None
    rim: EdgeCondition | None = None
    root: EdgeCondition | None = None
    tip: EdgeCondition | None = None
    sides: EdgeCondition | None = None

    def conditions(self) -> dict[str, EdgeCondition]:
        """Named edge -> condition."""
        return {name: condition for name, condition in self if condition is not None}
