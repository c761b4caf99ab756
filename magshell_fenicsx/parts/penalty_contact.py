"""Contact by a penalty, as a solver asks it: with a rigid body, or of a pair of shells.

A penalty is an energy of penetration, with a stiffness that may be raised. Methods without a state
are called with the system at one (`Evaluation.evaluate`). A configuration is what the gaps of a
contact depend on at a state, as an object that only the contact reads. Steps are those of a path or
of a motion in time; the way of a step is straight between its two configurations.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.parts.gap import SOFT_PENETRATION, Penalty

Array = NDArray[np.float64]
Configuration = TypeVar("Configuration")
Frozen = TypeVar("Frozen")
PASS_THROUGH_DISTANCE = 0.5  # thicknesses: faces that overlap by more pass through each other


class PenaltyOptions(Protocol):
    """Settings of a contact's penalty in a problem.

    Attributes
    ----------
    setting
        The name under which a state stores the stiffness if it was raised.
    stiffness
        Stiffness k at first, over E h/R^2.
    max_penetration
        Largest penetration that is allowed, over the thickness.
    has_given_stiffness
        Whether the case gives the stiffness, which then stays.
    """

    @property
    def setting(self) -> str: ...
    @property
    def stiffness(self) -> float: ...
    @property
    def max_penetration(self) -> float: ...
    @property
    def has_given_stiffness(self) -> bool: ...


@dataclass(frozen=True)
class GapAlongStep:
    """The gap of one contact on the straight way of a step; lengths are over R.

    Attributes
    ----------
    gap
        Part of the way -> least gap there; collective.
    largest_approach
        Upper bound of the distance by which the gap closes on the whole way.
    crossing_distance
        Overlap up to which no face has passed through another one, or through a body.
    """

    gap: Callable[[float], float]
    largest_approach: float
    crossing_distance: float


@dataclass(frozen=True)
class PressedPoints:
    """The quadrature points of contacts where the gap is closed.

    Attributes
    ----------
    places
        (n, 3) deformed places over R.
    pressure
        (n,) contact pressure over E h/R.
    area
        (n,) the area over R² that a point stands for in the force, on a meridian that of its ring.
    cell_area
        (n,) the area over R² of the cell of a point, on a meridian that of its ring.
    """

    places: Array
    pressure: Array
    area: Array
    cell_area: Array

    @classmethod
    def union(cls, parts: "Sequence[PressedPoints]", comm: MPI.Comm) -> "PressedPoints":
        """Return the points of several contacts and of all ranks as one set; collective."""
        tables = [
            np.column_stack([part.places, part.pressure, part.area, part.cell_area])
            for part in parts
        ]
        table = np.concatenate(comm.allgather(np.concatenate(tables)))
        return cls(table[:, :3], *table[:, 3:].T)

    def with_images(self, mirror: Mirror) -> "PressedPoints":
        """Return the points of all copies of a half or a sector, one copy after the other."""
        return PressedPoints(
            mirror.with_images(self.places),
            *(np.tile(v, mirror.copies) for v in (self.pressure, self.area, self.cell_area)),
        )


class PenaltyContact(ABC, Generic[Configuration, Frozen]):
    """A contact whose penetration costs energy. All methods are collective.

    Attributes
    ----------
    max_stiffening
        How much stiffer the penalty becomes at most.
    bound_at_points
        Share of the allowed penetration up to which the points of the contact may penetrate.
    ends_steps
        Whether steps of a path end where the contact closes.
    stiffness
        Stiffness k of the penalty, over E h/R^2: a number that a state sets.

    The field `_h` is the thickness over R.
    """

    max_stiffening: ClassVar[float]
    bound_at_points: ClassVar[float] = 1.0
    ends_steps: ClassVar[bool] = True
    stiffness: Any
    _h: float

    @property
    def penalty(self) -> Penalty:
        """The penalty with the present stiffness."""
        return Penalty(float(self.stiffness.value), SOFT_PENETRATION * self._h)

    @property
    @abstractmethod
    def options(self) -> PenaltyOptions:
        """Settings of the penalty in the problem."""

    @property
    @abstractmethod
    def history(self) -> Mapping[str, tuple[Any, float]]:
        """Name -> number that a state sets, and its default; see `FiniteElementSystem`."""

    @property
    @abstractmethod
    def configuration(self) -> Configuration:
        """The present configuration."""

    @abstractmethod
    def penetration(self) -> float:
        """Return the largest penetration over R, 0 without contact."""

    @abstractmethod
    def relative_penetration(self) -> float:
        """Return the largest penetration over the thickness, 0 without contact."""

    @abstractmethod
    def penetration_message(self, stiffness: float, *, moving: bool) -> str:
        """Return a message on a penetration beyond the allowed one; "" if there is none.

        Parameters
        ----------
        stiffness
            The present stiffness.
        moving
            Whether the state is one of a motion, in which shells hit each other.
        """

    @abstractmethod
    def cell_pressures(self) -> Array:
        """Return the mean contact pressure (cells,) in each local cell, over E h/R."""

    @abstractmethod
    def evenly_pressed(self) -> NDArray[np.bool_]:
        """Return the flags (cells,) of local cells that are pressed evenly, all over."""

    @abstractmethod
    def pressed_points(self) -> PressedPoints:
        """Return the points of this rank where the gap is closed, with their pressure."""

    @abstractmethod
    def freeze(self) -> Frozen:
        """Return what is in contact at present, for differences of states near this one."""

    @abstractmethod
    def expand_about(self, frozen: Frozen) -> None:
        """Replace the penalty by its Taylor polynomial about a frozen contact, for all states.

        A hard contact closes or opens within a far smaller distance than a difference moves the
        shell.

        Parameters
        ----------
        frozen
            The result of `freeze`, also of another model on the same mesh.
        """

    @abstractmethod
    def gap_along_step(self, begin: Configuration, end: Configuration) -> GapAlongStep | None:
        """Return the gap on the way of a step; None if it stays open."""

    @abstractmethod
    def average(self, begin: Configuration, end: Configuration, part: float) -> None:
        """Use the mean force of a step in time, until `use_present_force` is called.

        The mean does the work that the energy of the penalty changes by, but for what the step
        dissipates. docs/theory.md, Motion.

        Parameters
        ----------
        begin, end
            Configurations at both ends of the step.
        part
            Position within the step, from 0 to 1, at which the system takes its forces.
        """

    @abstractmethod
    def use_present_force(self) -> None:
        """Use the force of the present state again, after `average`."""
