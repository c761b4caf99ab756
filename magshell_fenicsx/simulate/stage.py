"""Stage of a programme: a scene with the solver of one of its steps.

A step may hold conjugates of loads, or vary several amplitudes together. Then its system has other
unknowns than the model, and a stage translates states between the two.

An amplitude is a load parameter, by name in `State.mu`; its conjugate is the displacement on which
it does work. Where a conjugate is held, a `Device` makes the amplitude an unknown behind the
displacements. A `ParametrisedSystem` has one amplitude in place of several that are functions of
it.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

from magshell_fenicsx.continuation.device import (
    Curve,
    Device,
    HeldConjugate,
    ParametrisedSystem,
    natural_scale,
)
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Control, Path
from magshell_fenicsx.continuation.point import Point, StepOptions
from magshell_fenicsx.continuation.system import State, System, Vector
from magshell_fenicsx.simulate.contact_onset import first_contact
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene

LONGEST = 50.0  # step by arc length, over the first
LONGEST_CONTROLLED = 2.0  # step in a prescribed quantity, over the first
SHORTEST = 1e-5  # step, over the first


@dataclass(frozen=True)
class Stage:
    """A scene with the solver of one step of its programme.

    The step's system may have further unknowns, or one amplitude that stands for several; states
    are translated between this system and the model.

    Attributes
    ----------
    scene
        The model of a problem.
    newton
        Solver of the step's system.
    device
        Prescribes the conjugates of some amplitudes, which are then unknowns; None if all
        amplitudes are loads.
    parametrised
        Varies several amplitudes together; None if the step varies one amplitude of the model.
    """

    scene: Scene
    newton: BorderedNewton
    device: Device | None = None
    parametrised: ParametrisedSystem | None = None

    def enter(self, state: State) -> State:
        """Return a state of the model as a state of the step's system."""
        state = self.device.enter(state) if self.device else state
        return self.parametrised.contract(state) if self.parametrised else state

    def leave(self, state: State) -> State:
        """Return a state of the step's system as a state of the model."""
        state = self.parametrised.expand(state) if self.parametrised else state
        state = self.device.leave(state) if self.device else state
        return self.scene.model.system.with_moved_supports(state)

    def point(self, point: Point) -> Point:
        """Return a point of the step's path with the model's displacement and amplitudes."""
        return replace(point, state=self.leave(point.state), du=self.displacement(point.du))

    def on_scene(self, scene: Scene) -> "Stage":
        """Return the stage of the same step on another scene, with the same held conjugates.

        Parameters
        ----------
        scene
            Scene whose model has the same amplitudes.
        """
        system: System = scene.model.system
        device = self.device.for_system(system) if self.device else None
        inner_system: System = device or system
        parametrised = self.parametrised.for_system(inner_system) if self.parametrised else None
        newton = scene.newton.for_system(parametrised or inner_system)
        return Stage(scene, newton, device, parametrised)

    def padded(self, u: Vector) -> Vector:
        """Return a vector of the model as one of the step's system."""
        return self.device.padded(u) if self.device else u

    def displaced(self, x: Vector) -> Vector:
        """Return a vector of the step's system with its displacements alone.

        It has zeros for the unknown amplitudes and at supports.
        """
        zero_at_supports = self.scene.model.system.zero_at_supports
        return self.padded(zero_at_supports(self.displacement(x)))

    def displacement(self, x: Vector) -> Vector:
        """Return the displacement of the model in a vector of the step's system."""
        return self.device.displacement(x) if self.device else x

    def path(self, name: str, control: Control, options: StepOptions, scale: float = 1.0) -> Path:
        """Return a path of the step's system.

        Parameters
        ----------
        name
            The amplitude that varies.
        control
            What is prescribed: "load", "conjugate" or "arc" (the arc length).
        options
            Lengths of steps.
        scale
            Value of the amplitude that counts as of order one in the arc length.

        Raises
        ------
        Stopped
            If the volume is prescribed where none is conjugate to the pressure.
        """
        if control == "conjugate":
            _refuse_open(self.scene, name)
        scene = self.scene
        arguments = self.newton, name, control, options, scale, scene.journal, scene.progress
        # steps end where shells, or a shell and a body, first touch
        if scene.model.all_contacts:
            return Path(*arguments, partial(first_contact, scene, self.leave))
        return Path(*arguments)

    def begin(
        self, name: str, control: Control, state: State, first: float, scale: float = 1.0
    ) -> tuple[Path, Point]:
        """Return a path from a state of the model in equilibrium, and its first point.

        Parameters
        ----------
        name
            The amplitude that varies.
        control
            What is prescribed: "load", "conjugate" or "arc" (the arc length).
        scale
            Value of the amplitude that counts as of order one in the arc length.
        first
            About the change of the amplitude in the first step.
        """
        return self.resume(name, control, self.enter(state), first, scale)

    def resume(
        self, name: str, control: Control, state: State, first: float, scale: float = 1.0
    ) -> tuple[Path, Point]:
        """Return a path from a state of the step's system in equilibrium, and its first point.

        Parameters
        ----------
        name
            The amplitude that varies.
        control
            What is prescribed: "load", "conjugate" or "arc" (the arc length).
        first
            About the change of the amplitude in the first step.
        scale
            Value of the amplitude that counts as of order one in the arc length.
        """
        # a path gives the tangent at the start, from which its lengths of steps then follow
        path = self.path(name, control, StepOptions(1.0, 1.0, 1.0), abs(scale))
        start = path.start(state, first)
        # of the controlled quantity s, by the derivative dmu of the amplitude by s
        step = abs(first / start.dmu)
        longest = LONGEST if control == "arc" else LONGEST_CONTROLLED
        return path.with_step_options(StepOptions(step, longest * step, SHORTEST * step)), start


def _refuse_open(scene: Scene, name: str) -> None:
    """Check that the pressure has a potential, where a volume is to be held or prescribed.

    Raises
    ------
    Stopped
        If the pressure follows a free edge, and so has no potential.
    """
    if name == "pressure" and (open_at := scene.model.without_potential):
        raise Stopped(
            "a volume cannot be held or prescribed: a pressure that follows the free edge "
            f"{open_at[0]} is conjugate to none: use control: arc or control: load"
        )


def load_stage(scene: Scene) -> Stage:
    """Return a stage in which all amplitudes are loads."""
    return Stage(scene, scene.newton)


def make_stage(
    scene: Scene,
    state: State,
    held_conjugates: Mapping[str, HeldConjugate] | None = None,
    curves: tuple[str, Mapping[str, Curve], float] | None = None,
) -> Stage:
    """Return the stage of a step; collective.

    Parameters
    ----------
    state
        A state of the model in equilibrium.
    held_conjugates
        Amplitude that becomes unknown -> its conjugate: a number, or a function of the amplitude.
    curves
        Name of an amplitude, the amplitudes that are functions of it, and its value at the state.

    Raises
    ------
    Stopped
        If the volume is held where none is conjugate to the pressure.
    """
    for name in held_conjugates or ():
        _refuse_open(scene, name)
    system: System = scene.model.system
    device, parametrised = None, None
    if held_conjugates:
        factors = scene.newton.factor_at(state)
        # units of the unknown amplitudes, so that they are comparable with displacements
        scale = {name: natural_scale(system, factors, state, name) for name in held_conjugates}
        system = device = Device(system, held_conjugates, scale)
    if curves:
        system = parametrised = ParametrisedSystem(system, *curves)
    return Stage(
        scene,
        scene.newton.for_system(system) if held_conjugates or curves else scene.newton,
        device,
        parametrised,
    )
