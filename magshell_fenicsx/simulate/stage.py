"""The solver of a step of a programme."""

from dataclasses import dataclass, replace

from magshell_fenicsx.continuation.along import Along
from magshell_fenicsx.continuation.device import Device
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.path import Control, Path, StepOptions
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import State
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

    def leave(self, state: State) -> State:
        """A state of the step's system as a state of the model."""
        state = self.along.expand(state) if self.along else state
        return self.device.leave(state) if self.device else state

    def point(self, point: Point) -> Point:
        """A point of the step's path with the model's displacement and amplitudes."""
        du = self.device.displacement(point.du) if self.device else point.du
        return replace(point, state=self.leave(point.state), du=du)

    def path(self, name: str, control: Control, options: StepOptions, scale: float = 1.0) -> Path:
        """A path of the step's system.

        Raises
        ------
        Stopped
            If the volume is prescribed where none is conjugate to the pressure.
        """
        open_at = self.scene.model.without_potential
        if control == "conjugate" and name == "pressure" and open_at:
            raise Stopped(
                f"control by volume: a pressure that follows the free edge {open_at[0]} is conjugate to no volume: "
                "use control: arc or control: load"
            )
        return Path(self.newton, name, control, options, scale, self.scene.journal, self.scene.progress)

    def begin(self, name: str, control: Control, state: State, first: float, scale: float = 1.0) -> tuple[Path, Point]:
        """A path from a state in equilibrium; its first step changes the amplitude by about `first`.

        `scale` is that of `Path`.
        """
        path = self.path(name, control, StepOptions(1.0, 1.0, 1.0), abs(scale))
        start = path.start(state, first)
        step = abs(first / start.dmu)
        return path.in_steps(StepOptions(step, (LONGEST if control == "arc" else 2) * step, 1e-5 * step)), start


def plain(scene: Scene) -> Stage:
    """A stage in which all other amplitudes are loads."""
    return Stage(scene, scene.newton)
