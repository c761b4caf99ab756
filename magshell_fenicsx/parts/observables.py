"""What rooms of parts see of a state: their columns of path.csv, and the units of what is conjugate
to amplitudes.
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
        """What loads the model."""
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
        """Pi_i(u) of an amplitude, of what is modelled."""
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
    """A rectangle or a box in space with vectors at its points, in the frame of the case; lengths
    are over R.

    Attributes
    ----------
    corner, sides
        (3,) where it begins, and (2, 3) or (3, 3) its sides, perpendicular to each other.
    points
        How many along each side.
    unit
        Of the values.
    words
        What the values are.
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
        """(n, 3) of its points."""
        along = np.meshgrid(*(np.linspace(0.0, 1.0, n) for n in self.points[::-1]), indexing="ij")
        shares = np.stack([each.ravel() for each in along[::-1]], axis=-1)
        return np.asarray(self.corner + shares @ self.sides)


class Observables:
    """What a room sees; by default nothing.

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
    varied: ClassVar[tuple[Amplitude, ...]] = ()
    before_points: ClassVar[bool] = False

    def __init_subclass__(cls) -> None:
        register_for_all_cases(cls.quantities, cls.varied)

    def amplitudes(self, loads: "Loads") -> Sequence[str]:
        """Its amplitudes."""
        return ()

    def named(self, loads: "Loads") -> Sequence[str]:
        """Further amplitudes, which are columns themselves and begin at zero."""
        return ()

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        """See that the surface has the patches that it names.

        Raises
        ------
        MeshError
            With the name.
        """

    def conjugates(self, loads: "Loads") -> dict[str, str]:
        """Amplitude -> the column of what is conjugate to it, besides those of every run."""
        return {}

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        """Columns besides those of every run; `supports` are those whose reactions are reported."""
        return (*self.amplitudes(loads), *self.conjugates(loads).values())

    def moments(self, loads: "Loads") -> Sequence[str]:
        """Those of its columns that are moments where others of the kind are forces."""
        return ()

    def ways(self, loads: "Loads") -> dict[str, tuple[bool, float]]:
        """Of amplitudes that are motions: whether it turns, and how far it goes at one, over R or
        in rad.
        """
        return {}

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Column -> value."""
        return {}

    def grids(self, loads: "Loads") -> Sequence[str]:
        """Names of the grids in space on which it sees something."""
        return ()

    def on_grids(self, view: ModelView, state: "State") -> Sequence[MapGrid]:
        """These grids with what it sees there; collective."""
        return ()

    def differentiable(self, loads: "Loads") -> Sequence[str]:
        """Its columns that have a `slope`."""
        return ()

    def slope(self, view: ModelView, state: "State", column: str) -> Slope | None:
        """A column with its derivatives; None if it is another room's; collective."""
        return None

    def left_out(self, view: ModelView) -> Sequence[str]:
        """What the model lacks of it, for people."""
        return ()

    def summary(self, view: ModelView, state: "State") -> dict[str, Any]:
        """What summary.json says of the end of a path; collective."""
        return {}

    def conjugate_unit(self, view: ModelView, name: str) -> float | None:
        """-dPi/dmu of one unit of what is conjugate to an amplitude; None if it is another room's."""
        return None
