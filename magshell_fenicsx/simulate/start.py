"""How a motion begins: along a mode of vibration, and with a velocity by formulas."""

from collections.abc import Sequence

import numpy as np

from magshell_fenicsx.assembly.moving import in_space
from magshell_fenicsx.continuation.system import State, Vector, dot, max_abs
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.models.modes import ShellModes
from magshell_fenicsx.parts.motion.step import PushSection
from magshell_fenicsx.shape.turning import vectors_of
from magshell_fenicsx.simulate.scene import Scene

SMALL = 1e-6  # deflection of a mode of size one that does not give its sign


def pushed(scene: Scene, push: PushSection, state: State, v: Vector) -> tuple[Vector, Vector]:
    """Displacement and velocity with a natural mode of the model itself, inward at the pole."""
    comm = scene.model.system.comm
    found = ShellModes(scene.model)
    own = [mode for mode in found.vibrations(state, push.mode) if not mode.label]
    if len(own) < push.mode:  # modes of other symmetries were lower
        own = [mode for mode in found.lowest(state, push.mode) if not mode.label]
    mode = own[push.mode - 1].vector
    phi = np.asarray(mode / max_abs(comm, mode))
    inward = scene.model.deflection(phi, "pole")
    if abs(inward) < SMALL:
        inward = dot(comm, phi, phi**2)
    h = np.copysign(scene.plan.material.h, inward)
    return state.u + push.displacement * h * phi, v + push.velocity * (scene.plan.time_unit or 1.0) * h * phi


def by_formula(scene: Scene, components: Sequence[str]) -> Vector:
    """The velocity with these components, formulas of the undeformed place, at the nodes; zero at supports."""
    model, R, Q = scene.model, scene.plan.length, rotation(scene.plan.azimuth)
    axes = model.axes
    places = in_space(model.r0.x.array, len(axes))
    found = vectors_of(components)(R * places @ Q) @ Q.T * (scene.plan.time_unit or 1.0) / R
    return np.asarray(model.system.held(np.ascontiguousarray(found[:, axes]).ravel()[: model.system.size]))
