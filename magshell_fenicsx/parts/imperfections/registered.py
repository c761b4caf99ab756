"""The imperfections of a case in order, from the function of each kind."""

from collections.abc import Callable
from typing import Any

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.parts.imperfections.data import data
from magshell_fenicsx.parts.imperfections.dimple import dimple
from magshell_fenicsx.parts.imperfections.flaw import Flaw
from magshell_fenicsx.parts.imperfections.formula import by_formula
from magshell_fenicsx.parts.imperfections.gaussian import gaussian
from magshell_fenicsx.parts.imperfections.modes import modes
from magshell_fenicsx.parts.imperfections.random import random_field
from magshell_fenicsx.shape.outline import Outline

KINDS: dict[str, Callable[[Any, Case, Outline, str], Flaw]] = {
    "dimple": dimple,
    "gaussian": gaussian,
    "formula": by_formula,
    "data": data,
    "modes": modes,
    "random": random_field,
}


def flaws(case: Case, drawn: Outline) -> dict[str, Flaw]:
    """Key of each imperfection below `shell` -> what it brings.

    Parameters
    ----------
    drawn
        The perfect shell.
    """
    return {key: KINDS[section.kind](section, case, drawn, key) for key, section in case.imperfections.items()}
