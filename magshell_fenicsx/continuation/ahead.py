"""The fold ahead of a stable point of a path, estimated from the softest mode there.

Along the softest mode phi (of length one, K phi = lambda phi) with the amplitude a, and with mu varied by m,
equilibrium is lambda a + c a^2/2 = b m with c = Pi'''(phi, phi, phi) and b = -phi . R_mu = lambda phi . du/dmu. The
fold is at a = -lambda/c, m = -lambda^2/(2 b c); all other modes follow mu linearly.
"""

import numpy as np

from magshell_fenicsx.continuation.augmented import third
from magshell_fenicsx.continuation.events import critical_mode
from magshell_fenicsx.continuation.fold import Guess
from magshell_fenicsx.continuation.inverse import NoEigenpair
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import dot

FAR = 0.6  # of the amplitude: a fold further ahead is not estimated well


def fold_ahead(newton: BorderedNewton, point: Point, name: str) -> Guess | None:
    """A guess of the next fold in the amplitude `name`, growing in size; None if it is far or not seen yet.

    The null vector of the guess points the way that the path goes. One factorisation.
    """
    system, state = newton.system, point.state
    comm, mu = system.comm, state.mu[name]
    try:
        mode = critical_mode(newton, state)
    except NoEigenpair:
        return None
    rate, phi = np.asarray(point.du / point.dmu), mode.vector
    along, cubic = dot(comm, phi, rate), dot(comm, phi, third(system, state, phi))
    pull = mode.eigenvalue * along
    if mode.eigenvalue <= 0 or not cubic * pull:
        return None
    step = -(mode.eigenvalue**2) / (2 * cubic * pull)
    if not 0 < step / mu < FAR:
        return None
    u = state.u + step * (rate - along * phi) - mode.eigenvalue / cubic * phi
    return Guess(state.with_(u, name, mu + step), np.sign(step * along) * phi)
