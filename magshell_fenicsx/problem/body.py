"""What a solid is made of besides the shell that it is the body of."""

from itertools import pairwise
from math import ceil

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.solid import SolidSection
from magshell_fenicsx.mesh.hexahedra import MIDDLE
from magshell_fenicsx.models.solid.material import NeoHookean

ROUNDING = 1e-9


def neo_hookean(case: Case) -> NeoHookean:
    """The solid's material."""
    return NeoHookean.of(case.shell.poisson_ratio, _section(case).bulk_to_shear)


def layers(case: Case) -> list[float]:
    """Where the elements through the thickness begin and end, from 0 inside to 1 outside.

    Magnetised layers end where elements do, and so does the inner half then: nodes lie in the middle.
    """
    count, magnetised = _section(case).layers, (case.magnetic and case.magnetic.remanent.layers) or []
    if not magnetised:
        return [n / count for n in range(count + 1)]
    tops = [sum(layer.fraction for layer in magnetised[: n + 1]) for n in range(len(magnetised) - 1)]
    ends = [0.0, *sorted({MIDDLE, *(round(top, 9) for top in tops)}), 1.0]
    found = [0.0]
    for low, high in pairwise(ends):
        parts = max(ceil((high - low) * count - ROUNDING), 1)
        found += [low + (high - low) * (n + 1) / parts for n in range(parts)]
    return found


def _section(case: Case) -> SolidSection:
    return case.solid or SolidSection()
