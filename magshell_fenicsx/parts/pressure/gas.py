"""A gas under the shell, as the conjugate of the pressure."""

from math import cos, pi, radians

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.continuation.device import Conjugate
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.course import GasSection
from magshell_fenicsx.shape.sections import CapSurface
from magshell_fenicsx.simulate.scene import Scene


def gas(scene: Scene, section: GasSection, state: State) -> Conjugate:
    """The conjugate of p/p_c where (ambient - p) V is that of a state (Boyle's law).

    Parameters
    ----------
    state
        In equilibrium, with the pressure p.

    Raises
    ------
    CaseError
        If the volume under the shell is not known, or the pressure is not below the ambient one.
    """
    case, unit = scene.case, scene.conjugate_unit("pressure")
    ambient = section.ambient_over_pc
    if ambient is None:
        if case.shell.youngs_modulus is None:
            raise CaseError("hold.pressure.gas.ambient: needs shell.youngs_modulus; or give ambient_over_pc")
        ambient = float(section.ambient or 0.0) / (scene.plan.material.classical_pressure * case.shell.youngs_modulus)
    first, now = section.volume or volume(case), state.mu["pressure"]
    changed = -scene.model.system.potential(state.u, state.mu, "pressure") / unit
    if first + changed <= 0:
        raise CaseError(f"hold.pressure.gas.volume: {first:.4g}: the shell has shrunk by {-changed:.4g} R^3 already")
    if now >= ambient:
        raise CaseError(f"hold.pressure.gas: the pressure, {now:.4g} p_c, is not below the ambient {ambient:.4g} p_c")
    content = (ambient - now) * (first + changed)

    def conjugate(p: float) -> tuple[float, float]:
        return unit * (content / (ambient - p) - first), unit * content / (ambient - p) ** 2

    return conjugate


def gas_by_begin(scene: Scene, section: GasSection, state: State, p: float) -> tuple[float, float]:
    """What the conjugate at p/p_c changes by with that of the state where the gas was closed in, and with p there."""
    unit, (now, then) = scene.conjugate_unit("pressure"), (p, state.mu["pressure"])
    q = -scene.model.system.potential(state.u, state.mu, "pressure")
    at_now, slope = gas(scene, section, state)(now)
    first = section.volume or volume(scene.case)
    ahead = (at_now / unit + first) / slope * unit  # ambient - p
    share = (ahead + now - then) / ahead
    return share, -(unit * first + q) / ahead


def volume(case: Case) -> float:
    """The volume between a spherical shell without its dimple and the plane of its edge, over R^3.

    Raises
    ------
    CaseError
        On any other shape.
    """
    shell = case.shell
    if shell.geometry == "hemisphere":
        return 2 * pi / 3
    if isinstance(shell, CapSurface) and shell.geometry == "cap":
        c = cos(radians(shell.polar))
        return pi * (2 + c) * (1 - c) ** 2 / 3
    raise CaseError(f"hold.pressure.gas.volume: give the volume of the gas under a {shell.geometry}")
