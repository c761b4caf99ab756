"""The sources of a case in order, from the function of each kind."""

from collections.abc import Callable
from typing import Any

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.mesh.frame import rotation
from magshell_fenicsx.parts.magnetism.sources.coil import coil
from magshell_fenicsx.parts.magnetism.sources.cuboid import cuboid
from magshell_fenicsx.parts.magnetism.sources.cylinder import cylinder
from magshell_fenicsx.parts.magnetism.sources.formula import by_formula
from magshell_fenicsx.parts.magnetism.sources.grid import grid
from magshell_fenicsx.parts.magnetism.sources.known import Known, Placed
from magshell_fenicsx.parts.magnetism.sources.ring import ring
from magshell_fenicsx.parts.magnetism.sources.sphere import sphere

KINDS: dict[str, Callable[[Any, Case, str], Known]] = {
    "cylinder": cylinder,
    "cuboid": cuboid,
    "sphere": sphere,
    "ring": ring,
    "coil": coil,
    "grid": grid,
    "formula": by_formula,
}


def placed(case: Case, turn: float = 0.0) -> list[Placed]:
    """The sources of a case, in a frame turned about e3 (rad).

    Raises
    ------
    CaseError
        If magpylib is missing, or a file is no grid.
    """
    if case.magnetic is None or not case.sources:
        return []
    R, unit, Q = case.shell.reference, case.magnetic.applied.reference, rotation(turn)
    assert unit
    found = []
    for i, section in enumerate(case.sources):
        key = f"magnetic.applied.sources.{i}"
        known = KINDS[section.kind](section, case, key)
        position = [x / R for x in section.position]
        found.append(Placed(known, Q @ position, Q @ section.axes, R, section.strength / unit, key))
    return found
