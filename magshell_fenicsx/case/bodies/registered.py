"""The kinds of rigid bodies."""

from typing import Annotated

from pydantic import Field

from magshell_fenicsx.case.bodies.box import BoxSection
from magshell_fenicsx.case.bodies.cylinder import CylinderSection
from magshell_fenicsx.case.bodies.plane import PlaneSection
from magshell_fenicsx.case.bodies.rod import RodSection
from magshell_fenicsx.case.bodies.sphere import SphereSection
from magshell_fenicsx.input.chosen import Chosen

Body = Annotated[PlaneSection | SphereSection | CylinderSection | RodSection | BoxSection, Chosen("kind")]
Bodies = Annotated[dict[str, Body], Field(max_length=100)]
