"""Conditions on the named edges of a geometry."""

from typing import Literal

from magshell_fenicsx.case.base import Section

EdgeCondition = Literal["clamped", "simply supported", "free"]


class BoundarySection(Section):
    """`equator` belongs to the hemisphere, `rim` to the disc."""

    equator: EdgeCondition | None = None
    rim: EdgeCondition | None = None
