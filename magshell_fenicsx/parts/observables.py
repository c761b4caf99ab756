"""Observables: what parts observe of a state, as columns of path.csv, maps and lines of
summary.json; and the units of what is conjugate to amplitudes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.quantities.quantity import Amplitude, Quantity
from magshell_fenicsx.quantities.registry import register_for_all_cases

if TYPE_CHECKING:
    from dolfinx import fem

    from magshell_fenicsx.continuation.system import State, Vector
    from magshell_fenicsx.mesh.patch import PatchMesh
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.shells.model_base import ModelBase

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ModelView:
    """A model, and the units in which it is reported.

    Attributes
    ----------
    length
        R in the case's unit.
    modulus
        E in the case's unit.
    mirror, azimuth
        Plane of the half that is modelled, None for all; and azimuth of the model's frame (rad).
    reactions
        Whether those of all supports are reported.
    sense
        Sign of the case's field.
    """

    model: "ModelBase"
    length: float
    modulus: float
    mirror: Mirror | None
    azimuth: float
    reactions: bool
    sense: float = 1.0

    @property
    def loads(self) -> "Loads":
        """All that loads the model."""
        return self.model.loads

    @property
    def h(self) -> float:
        """The thickness over R."""
        return self.model.material.h

    @property
    def force(self) -> float:
        """E h R in the case's unit."""
        return self.modulus * self.h * self.length**2

    def potential(self, state: "State", name: str) -> float:
        """Return Pi_i(u) of an amplitude, of what is modelled."""
        return self.model.system.potential(state.u, state.mu, name)


@dataclass(frozen=True)
class Slope:
    """A column of a state with its derivatives.

    Attributes
    ----------
    by_u, by_mu
        By the displacement, zero at supports, and by amplitudes where it contains them itself.
    field, by_field
        A field of the terms, and the column's own derivatives by its values (cells, nodes,
        components) in own cells.
    """

    value: float
    by_u: "Vector"
    by_mu: Mapping[str, float]
    field: "fem.Function | None" = None
    by_field: "Array | None" = None


@dataclass(frozen=True)
class MapGrid:
    """Vectors at the points of a rectangle or a box in space, in the frame of the case.

    Attributes
    ----------
    corner, sides
        (3,) where it begins, and (2, 3) or (3, 3) its sides, perpendicular to each other; over R.
    points
        How many along each side.
    unit
        Of the values.
    words
        Meaning of the values.
    values
        (n, 3) at the points, along the first side first; nan where there are none.
    """

    name: str
    corner: Array
    sides: Array
    points: tuple[int, ...]
    unit: str
    words: str
    values: Array = field(default_factory=lambda: np.zeros((0, 3)))

    @property
    def places(self) -> Array:
        """The places (n, 3) of its points, over R."""
        coordinates = np.meshgrid(
            *(np.linspace(0.0, 1.0, n) for n in self.points[::-1]), indexing="ij"
        )
        shares = np.stack([coordinate.ravel() for coordinate in coordinates[::-1]], axis=-1)
        return np.asarray(self.corner + shares @ self.sides)


class Observables:
    """The base of what a part observes of a state; by default nothing.

    Attributes
    ----------
    quantities
        Its columns, where they are not those of every run; see `Quantity.each`.
    varied
        Its amplitudes with a curve of their own.
    before_points
        Whether its columns come before those of named points.
    """

    quantities: ClassVar[tuple[Quantity, ...]] = ()
    curve_amplitudes: ClassVar[tuple[Amplitude, ...]] = ()
    before_points: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        register_for_all_cases(cls.quantities, cls.curve_amplitudes)

    def amplitudes(self, loads: "Loads") -> Sequence[str]:
        """Return the amplitudes that are its columns."""
        return ()

    def free_amplitudes(self, loads: "Loads") -> Sequence[str]:
        """Return further amplitudes, which are columns themselves and begin at zero."""
        return ()

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        """Check that the surface has the patches that it names.

        Raises
        ------
        MeshError
            With the name.
        """

    def conjugates(self, loads: "Loads") -> dict[str, str]:
        """Return amplitude -> column of its conjugate, besides those of every run."""
        return {}

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        """Return columns besides those of every run; reactions of `supports` are reported."""
        return (*self.amplitudes(loads), *self.conjugates(loads).values())

    def moments(self, loads: "Loads") -> Sequence[str]:
        """Return the columns that are moments where others of the kind are forces."""
        return ()

    def motions(self, loads: "Loads") -> dict[str, tuple[bool, float]]:
        """Return amplitudes that are motions: whether each turns, and its way at one (over R, or
        rad).
        """
        return {}

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return column -> value."""
        return {}

    def grids(self, loads: "Loads") -> Sequence[str]:
        """Return the names of the grids in space on which it observes a field."""
        return ()

    def on_grids(self, view: ModelView, state: "State") -> Sequence[MapGrid]:
        """Return these grids with the fields there; collective."""
        return ()

    def differentiable(self, loads: "Loads") -> Sequence[str]:
        """Return the columns that have a `slope`."""
        return ()

    def slope(self, view: ModelView, state: "State", column: str) -> Slope | None:
        """Return a column with its derivatives; None if it is another part's. Collective."""
        return None

    def left_out(self, view: ModelView) -> Sequence[str]:
        """Return what the model lacks of it, for people."""
        return ()

    def summary(self, view: ModelView, state: "State") -> dict[str, Any]:
        """Return what summary.json says of the end of a path; collective."""
        return {}

    def conjugate_unit(self, view: ModelView, name: str) -> float | None:
        """Return -dPi/dmu of one unit of an amplitude's conjugate; None if it is another part's."""
        return None
