"""What a solid is made of besides the shell that it is the body of."""

from dataclasses import dataclass
from itertools import pairwise
from math import ceil

from magshell_fenicsx.mesh.hexahedra import MIDDLE
from magshell_fenicsx.models.solid.densities import NeoHookean
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.problem.elements import SolidSection

ROUNDING = 1e-9


@dataclass(frozen=True)
class Body:
    """The material of a solid, and where its elements through the thickness begin and end, 0 inside to 1 outside."""

    material: NeoHookean
    layers: list[float]


def body_of(context: Context) -> Body | None:
    """The solid of a case; None of a shell."""
    if not context.solid:
        return None
    ratio = _section(context).bulk_to_shear
    return Body(NeoHookean.of(context.shell.poisson_ratio, ratio), layers(context))


def layers(context: Context) -> list[float]:
    """Where the elements through the thickness begin and end, from 0 inside to 1 outside.

    Magnetised layers end where elements do, and so does the inner half then: nodes lie in the middle.
    """
    count, magnetic = _section(context).layers, context.of(MagneticSection)
    remanent = magnetic and magnetic.remanent
    magnetised = (remanent and remanent.layers) or []
    if not magnetised:
        return [n / count for n in range(count + 1)]
    tops = [sum(layer.fraction for layer in magnetised[: n + 1]) for n in range(len(magnetised) - 1)]
    ends = [0.0, *sorted({MIDDLE, *(round(top, 9) for top in tops)}), 1.0]
    begins = [0.0]
    for low, high in pairwise(ends):
        parts = max(ceil((high - low) * count - ROUNDING), 1)
        begins += [low + (high - low) * (n + 1) / parts for n in range(parts)]
    return begins


def _section(context: Context) -> SolidSection:
    return context.of(SolidSection) or SolidSection()
