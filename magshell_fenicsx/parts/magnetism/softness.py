"""The susceptibility of a case in the model's frame, and what a room sees of what a field induces."""

from collections.abc import Mapping
from math import sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.expressions import ByFormula, function
from magshell_fenicsx.mesh.mirror import Mirror, rotation
from magshell_fenicsx.models.shell.patterns import Inside, Pattern, WithinRims
from magshell_fenicsx.parts.magnetism.fields import MU_0, MagneticSection
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.magnetism.soft import Soft
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.seen import Sight
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.sections import MeshSurface
from magshell_fenicsx.shape.symmetry import mirrors_formula

Array = NDArray[np.float64]
PLACES = 50  # on each rank, where two fields are compared


def soft(context: Context, turn: float, within: Mapping[str, Inside]) -> Soft | None:
    """What is soft, in a frame turned about e3 (rad); None without a susceptibility; `within` is of `Problem`."""
    magnetic = context.of(MagneticSection)
    if magnetic is None or magnetic.susceptibility is None:
        return None
    chi, E, remanent = magnetic.susceptibility, context.shell.youngs_modulus, magnetic.remanent
    patches = dict[str, Array]()
    pattern: float | Pattern = float(chi) if isinstance(chi, float | int) else 0.0
    if isinstance(chi, str):
        pattern = ByFormula([function(chi)], rotation(turn), 1.0)
    elif isinstance(chi, dict) and isinstance(context.shell, MeshSurface):
        patches = {name: np.array([each]) for name, each in chi.items()}
    elif isinstance(chi, dict):
        rest = np.array([chi.get("rest", 0.0)])
        rims = tuple((inside, np.array([chi[name]]) if name in chi else rest) for name, inside in within.items())
        pattern = WithinRims(rims, rest) if rims else float(rest[0])
    scale = sqrt(MU_0 * E) / remanent.flux_density if remanent and remanent.flux_density and E else 1.0
    tesla = magnetic.tesla(E) if E and magnetic.lambda_m is None else 1.0
    largest = None if magnetic.saturation is None else magnetic.saturation / tesla
    return Soft(pattern, scale, tesla, remanent is None, patches or None, largest)


def soft_mirrored(chi: Any, outline: Outline, mirror: Mirror) -> bool:
    """Whether a plane mirrors a susceptibility; patches are mapped onto themselves."""
    return not isinstance(chi, str) or mirrors_formula(chi, mirror, outline.sample())


def parity(sight: Sight, field: Magnetisation, state: State, mirror: Mirror) -> float:
    """1 if the mirror images of the applied field continue it, -1 if their opposites do; collective."""
    x = sight.model.r0.x.array.reshape(-1, 3)
    x = x[:: len(x) // PLACES + 1]
    images = field.at(state.mu, mirror.image(x)) @ mirror.reflection
    return float(np.sign(sight.model.system.comm.allreduce(float(np.sum(images * field.at(state.mu, x))))))
