"""The symmetry that the imperfections of a case leave, by their values."""

from collections.abc import Mapping, Sequence
from functools import cache
from math import atan2

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.deviation import Deviation
from magshell_fenicsx.mesh.frame import rotation
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.plan.imperfections.flaw import Flaw
from magshell_fenicsx.plan.imperfections.rims import AXIS, contour
from magshell_fenicsx.plan.outline import Outline
from magshell_fenicsx.plan.symmetry import Leaves, common_azimuth
from magshell_fenicsx.plan.turning import ANGLES

Array = NDArray[np.float64]
SAME = 1e-9  # of the largest w0
PARTS = (0.2, 0.5, 0.8)  # of the reach, at which a local imperfection is compared


def leaves(found: Mapping[str, Flaw], drawn: Outline, *, each: bool) -> list[Leaves]:
    """What imperfections leave.

    Parameters
    ----------
    drawn
        The perfect shell.
    each
        Whether each must be its own image, as patches with names are.
    """
    if not found:
        return []
    grouped = [[flaw] for flaw in found.values()] if each else [list(found.values())]
    groups = [[flaw.deviation for flaw in group] for group in grouped]

    sample = cache(lambda: _sample(found, drawn))

    def mirrors(mirror: Mirror) -> bool:
        x = sample()
        return all(_same(_w0(group, x), _w0(group, mirror.image(x))) for group in groups)

    centres = [flaw.centre for flaw in found.values() if flaw.centre is not None]
    off = [centre for centre in centres if np.hypot(*centre[:2]) > AXIS]
    reason = None
    if off and drawn.round:
        reason = "an imperfection is off the axis"
    elif drawn.span:
        places = drawn.span.sample()[1:-1]
        turned = [np.concatenate([_w0(group, places @ rotation(a)) for group in groups]) for a in ANGLES[:24]]
        if not all(_same(turned[0], w0) for w0 in turned):
            reason = "an imperfection differs around e3"
    if not drawn.round:
        return [Leaves(reason, (), mirrors)]
    if common_azimuth(off) is None:
        return [Leaves(reason, (), mirrors, azimuths=_between(off))]
    return [Leaves(reason, off, mirrors)]


def _between(centres: Sequence[Array]) -> tuple[float, ...]:
    """Azimuths (rad) of the planes through e3 that map the first place to itself or to one at the same distance."""
    first, *others = centres
    alike = [x for x in others if abs(np.hypot(*x[:2]) - np.hypot(*first[:2])) < AXIS and abs(x[2] - first[2]) < AXIS]
    return tuple((atan2(x[1], x[0]) + atan2(first[1], first[0])) / 2 for x in (first, *alike))


def _sample(found: Mapping[str, Flaw], drawn: Outline) -> Array:
    """Places (n, 3) all over the shell, and around each local imperfection."""
    places = [drawn.sample()]
    for key, flaw in found.items():
        if flaw.centre is None:
            continue
        places.append(flaw.centre[None])
        chart = drawn.inverse(flaw.centre)
        if len(chart) == 2:
            places += [drawn.perfect(contour(key, flaw, drawn, 0.0, chart, part)[::7]) for part in PARTS]
    return np.concatenate(places)


def _w0(deviations: list[Deviation], x: Array) -> Array:
    return np.asarray(sum((deviation(x) for deviation in deviations), np.zeros(len(x))))


def _same(here: Array, there: Array) -> bool:
    return bool((np.abs(here - there) <= SAME * max(np.abs(here).max(), np.abs(there).max())).all())
