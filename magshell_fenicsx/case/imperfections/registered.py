"""The kinds of imperfections."""

from typing import Annotated

from pydantic import Field

from magshell_fenicsx.case.imperfections.data import DataSection
from magshell_fenicsx.case.imperfections.dimple import DimpleSection
from magshell_fenicsx.case.imperfections.formula import FormulaSection
from magshell_fenicsx.case.imperfections.gaussian import GaussianSection
from magshell_fenicsx.case.imperfections.modes import ModesSection
from magshell_fenicsx.case.imperfections.random import RandomSection
from magshell_fenicsx.input.chosen import Chosen

Imperfection = Annotated[
    DimpleSection | GaussianSection | FormulaSection | DataSection | ModesSection | RandomSection,
    Chosen("kind"),
]
Imperfections = Annotated[list[Imperfection], Field(max_length=1000)]
