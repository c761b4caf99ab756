"""A mesh of a solid for a tolerance of the result. Its degree is 2, so element size and layers are chosen.

Each round solves on one mesh, with smaller elements, and with one more layer. The two changes of the result estimate
the two parts of the error, as if it fell with the square of the size; the part that is too large is refined.
"""

from collections.abc import Callable

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.problem.elements import SOLID_DEGREE, SolidSection
from magshell_fenicsx.simulate.adapt.choice import Adapted, Choice, Round
from magshell_fenicsx.simulate.adapt.ending import NoResult, by_path

FIRST = (0.5, 1.0, 2.0)  # refinements of the first mesh, tried until the path has a result
FINER = 1.5  # factor of the refinement that is compared with
LEAST, MOST = 1.25, 2.5  # factor of the refinement in one round
AIM = 0.4  # each part of the estimated error over the tolerance
MOST_ROUNDS = 6
FINEST, MOST_LAYERS = 20.0, 9


def adapted_solid(case: Case, comm: MPI.Comm, say: Callable[[str], None], doing: Callable[[str], None]) -> Adapted:
    """Find the mesh of a solid; see `tolerance.adapted`."""
    tolerance, tried = case.mesh.tolerance, list[tuple[Round, Choice]]()
    assert tolerance is not None
    refinement, layers = FIRST[0], (case.solid or SolidSection()).layers
    while len(tried) < MOST_ROUNDS:
        doing(f"a mesh for the tolerance {tolerance:g}: round {len(tried) + 1}")
        try:
            here, plane, through = _round(case, comm, refinement, layers)
        except NoResult:
            if tried or refinement == FIRST[-1]:
                raise
            refinement = FIRST[FIRST.index(refinement) + 1]
            continue
        except CaseError:  # too large
            break
        tried.append((here, Choice(SOLID_DEGREE, refinement, layers=layers)))
        say(
            f"tolerance {tolerance:g}: refinement {refinement:g}, layers {layers}, {here.dofs} unknowns: "
            f"result {here.result:.9g}, estimated error {plane:.1e} by the size and {through:.1e} by the layers"
        )
        if here.estimate <= tolerance or refinement >= FINEST:
            break
        if plane > AIM * tolerance:
            refinement = round(refinement * float(np.clip((plane / (AIM * tolerance)) ** 0.5, LEAST, MOST)), 3)
            refinement = min(refinement, FINEST)
        layers += through > AIM * tolerance and layers < MOST_LAYERS
    if not tried:
        raise NoResult("the first mesh is too large")
    best, choice = min(tried, key=lambda t: t[0].estimate)
    if best.estimate > tolerance:
        say(f"warning: no mesh was found for the tolerance; the least estimated error is {best.estimate:.1e}")
    return Adapted(case, choice, best, [r for r, _ in tried])


def _round(case: Case, comm: MPI.Comm, refinement: float, layers: int) -> tuple[Round, float, float]:
    """The result on one mesh, and the relative errors by the size of its elements and by its layers."""

    def result(refinement: float, layers: int) -> tuple[float, int, int]:
        scene = Choice(SOLID_DEGREE, refinement, layers=layers).scene(case, comm)
        return by_path(scene).value, scene.cells, scene.model.system.dofs

    value, cells, dofs = result(refinement, layers)
    finer, thicker = result(min(FINER * refinement, FINEST), layers)[0], result(refinement, layers + 1)[0]
    scale = max(abs(finer), np.finfo(float).tiny)
    plane = abs(finer - value) / scale / (1 - FINER**-2)
    through = abs(thicker - value) / scale / (1 - (layers / (layers + 1)) ** 2)
    return Round(SOLID_DEGREE, refinement, cells, dofs, value, plane + through, layers), plane, through
