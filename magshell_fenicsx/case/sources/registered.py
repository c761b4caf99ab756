"""The kinds of sources."""

from typing import Annotated

from pydantic import Field

from magshell_fenicsx.case.sources.coil import CoilSection
from magshell_fenicsx.case.sources.cuboid import CuboidSection
from magshell_fenicsx.case.sources.cylinder import CylinderSection
from magshell_fenicsx.case.sources.formula import FormulaSource
from magshell_fenicsx.case.sources.grid import GridSection
from magshell_fenicsx.case.sources.ring import RingSection
from magshell_fenicsx.case.sources.sphere import SphereSection
from magshell_fenicsx.input.chosen import Chosen

Source = Annotated[
    CylinderSection | CuboidSection | SphereSection | RingSection | CoilSection | GridSection | FormulaSource,
    Chosen("kind"),
]
Sources = Annotated[list[Source], Field(min_length=1, max_length=1000)]
