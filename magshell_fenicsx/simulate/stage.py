"""The solver of a step of a programme."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

from magshell_fenicsx.continuation.device import Along, Curve, Device, Held, natural_scale
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Control, Path
from magshell_fenicsx.continuation.point import Point, StepOptions
from magshell_fenicsx.continuation.system import State, System, Vector
from magshell_fenicsx.simulate.onset import way_to_touch
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene import Scene

LONGEST = 50.0  # step by arc length, over the first


@dataclass(frozen=True)
class Stage:
    """A scene with a solver of its system, or of a substitute system for a step.

    Attributes
    ----------
    device
        Prescribes the conjugates of some amplitudes; None if all are loads.
    along
        Varies several amplitudes together; None if the step varies one amplitude of the model.
    """

    scene: Scene
    newton: BorderedNewton
    device: Device | None = None
    along: Along | None = None

    def enter(self, state: State) -> State:
        """A state of the model as a state of the step's system."""
        state = self.device.enter(state) if self.device else state
        return self.along.contract(state) if self.along else state

    def leave(self, state: State) -> State:
        """A state of the step's system as a state of the model."""
        state = self.along.expand(state) if self.along else state
        state = self.device.leave(state) if self.device else state
        return self.scene.model.system.placed(state)

    def point(self, point: Point) -> Point:
        """A point of the step's path with the model's displacement and amplitudes."""
        return replace(point, state=self.leave(point.state), du=self.displacement(point.du))

    def on(self, scene: Scene) -> "Stage":
        """The same step on another scene, with the same values of what is held."""
        system: System = scene.model.system
        device = self.device.on(system) if self.device else None
        along = self.along.on(device or system) if self.along else None
        return Stage(scene, scene.newton.on(along or device or system), device, along)

    def padded(self, u: Vector) -> Vector:
        """A vector of the model as one of the step's system."""
        return self.device.padded(u) if self.device else u

    def displaced(self, x: Vector) -> Vector:
        """A vector of the step's system with zeros for the unknown amplitudes and where nodes are
        held.
        """
        held = self.scene.model.system.held
        return self.padded(held(self.displacement(x)))

    def displacement(self, x: Vector) -> Vector:
        """The model's displacement of a vector of the step's system."""
        return self.device.displacement(x) if self.device else x

    def path(self, name: str, control: Control, options: StepOptions, scale: float = 1.0) -> Path:
        """A path of the step's system.

        Raises
        ------
        Stopped
            If the volume is prescribed where none is conjugate to the pressure.
        """
        if control == "conjugate":
            _refuse_open(self.scene, name)
        scene, given = (
            self.scene,
            (self.newton, name, control, options, scale, self.scene.journal, self.scene.progress),
        )
        return (
            Path(*given, partial(way_to_touch, scene, self.leave))
            if scene.model.touchings
            else Path(*given)
        )

    def begin(
        self, name: str, control: Control, state: State, first: float, scale: float = 1.0
    ) -> tuple[Path, Point]:
        """A path from a state of the model in equilibrium; its first step changes the amplitude by
        about `first`.

        `scale` is that of `Path`.
        """
        return self.resume(name, control, self.enter(state), first, scale)

    def resume(
        self, name: str, control: Control, state: State, first: float, scale: float = 1.0
    ) -> tuple[Path, Point]:
        """The same from a state of the step's system."""
        path = self.path(name, control, StepOptions(1.0, 1.0, 1.0), abs(scale))
        start = path.start(state, first)
        step = abs(first / start.dmu)
        return path.in_steps(
            StepOptions(step, (LONGEST if control == "arc" else 2) * step, 1e-5 * step)
        ), start


def _refuse_open(scene: Scene, name: str) -> None:
    if name == "pressure" and (open_at := scene.model.without_potential):
        raise Stopped(
            f"a volume cannot be held or prescribed: a pressure that follows the free edge {open_at[0]} is conjugate "
            "to none: use control: arc or control: load"
        )


def plain(scene: Scene) -> Stage:
    """A stage in which all other amplitudes are loads."""
    return Stage(scene, scene.newton)


def staged(
    scene: Scene,
    state: State,
    held: Mapping[str, Held] | None = None,
    curves: tuple[str, Mapping[str, Curve], float] | None = None,
) -> Stage:
    """The stage of a step.

    Parameters
    ----------
    state
        A state in equilibrium.
    held
        Amplitude -> its conjugate, see `Device`.
    curves
        Name of an amplitude, the amplitudes that are functions of it, and its value at the state.

    Raises
    ------
    Stopped
        If the volume is held where none is conjugate to the pressure.
    """
    for name in held or ():
        _refuse_open(scene, name)
    system: System = scene.model.system
    device, along = None, None
    if held:
        factors = scene.newton.factor_at(state)
        scale = {name: natural_scale(system, factors, state, name) for name in held}
        system = device = Device(system, held, scale)
    if curves:
        system = along = Along(system, *curves)
    return Stage(scene, scene.newton.on(system) if held or curves else scene.newton, device, along)
