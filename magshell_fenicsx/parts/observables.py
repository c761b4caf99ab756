"""Observables: what parts observe of a state, as columns of path.csv; and the units of what is
conjugate to amplitudes.

An amplitude mu is a load parameter, by name; its conjugate -dPi/dmu is the displacement on which it
does work. Pi is the energy, and Pi_i the potential of amplitude i, its derivative. R is the
reference length, E Young's modulus, h the thickness over R. A column is a name of a number in
path.csv.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.parts.ability import Account, Context
from magshell_fenicsx.quantities.quantity import Amplitude, Quantity
from magshell_fenicsx.quantities.registry import register_for_all_cases

if TYPE_CHECKING:
    from dolfinx import fem

    from magshell_fenicsx.continuation.system import State, Vector
    from magshell_fenicsx.mesh.patch import PatchMesh
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.observed_model import ObservedModel

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ModelView:
    """A model, and the units and the frame in which it is reported.

    Attributes
    ----------
    model
        The model of the shell.
    length
        R in the case's unit.
    modulus
        E in the case's unit.
    mirror, azimuth
        Plane of the half that is modelled, None for all; and azimuth of the model's frame (rad).
    reactions
        Whether reactions of all supports are reported.
    points
        Names of the points of the case.
    strengths
        Amplitude -> its value at a factor of one, of loads whose strength the case gives.
    """

    model: "ObservedModel"
    length: float
    modulus: float
    mirror: Mirror | None
    azimuth: float
    reactions: bool
    points: Sequence[str] = ()
    strengths: Mapping[str, float] = field(default_factory=dict)

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
        """The unit E h R of forces, in the case's unit."""
        return self.modulus * self.h * self.length**2

    def potential(self, state: "State", name: str) -> float:
        """Return Pi_i(u) of the amplitude `name` of the modelled part of the shell."""
        return self.model.system.potential(state.u, state.mu, name)

    def energies(self, state: "State") -> dict[str, float]:
        """Return group of terms -> energy over E h R² of the whole shell; collective.

        All terms of one field are one group. A term that an amplitude multiplies has this factor.
        """
        from magshell_fenicsx.assembly.terms import factor_of  # the solver takes long to import

        by_group = defaultdict[str, float](float)
        potentials = self.model.system.energies(state.u, state.mu)
        for term in self.model.system.terms:
            factor = self.model.multiplicity * factor_of(term.amplitude, state.mu)
            by_group[term.group] += factor * potentials[term.name]
        return by_group


@dataclass(frozen=True)
class Slope:
    """A column at a state, with its derivatives.

    Attributes
    ----------
    value
        The column.
    by_u
        Derivative by the displacement, zero at supports.
    by_mu
        Amplitude -> explicit derivative by it.
    field, by_field
        A field of the terms, and the column's explicit derivatives by its values (cells, nodes,
        components) in this rank's own cells; None without.
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
    name
        Name of the grid.
    corner, sides
        (3,) where the grid begins, and (2, 3) or (3, 3) its perpendicular sides; over R.
    points
        Number of points along each side.
    unit
        Unit of the values.
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
        """The places (n, 3) of the points over R, along the first side first."""
        # 0 to 1 along each side; reversed twice, so that the first side varies fastest
        coordinates = np.meshgrid(
            *(np.linspace(0.0, 1.0, n) for n in self.points[::-1]), indexing="ij"
        )
        shares = np.stack([coordinate.ravel() for coordinate in coordinates[::-1]], axis=-1)
        return np.asarray(self.corner + shares @ self.sides)


class Observables:
    """The base of what a part observes of a state; by default nothing.

    A run calls the methods to name its columns at the begin, and to fill them at each point.

    Attributes
    ----------
    quantities
        The part's columns, where they are not those of every run; see `Quantity.each`.
    curve_amplitudes
        The part's amplitudes with a curve of their own.
    column_rank
        Where the part's columns are in path.csv: 0 before those of named points, 1 right after
        those of free amplitudes, 2 behind.
    """

    quantities: ClassVar[tuple[Quantity, ...]] = ()
    curve_amplitudes: ClassVar[tuple[Amplitude, ...]] = ()
    column_rank: ClassVar[int] = 2

    def __init_subclass__(cls) -> None:
        register_for_all_cases(cls.quantities, cls.curve_amplitudes)

    def account(self, context: Context, loads: "Loads") -> Account:
        """Return the lines of `magshell check` on the part, or on its absence."""
        return Account()

    def amplitudes(self, loads: "Loads") -> Sequence[str]:
        """Return the part's amplitudes that are columns of path.csv."""
        return ()

    def free_amplitudes(self, loads: "Loads") -> Mapping[str, float]:
        """Return further amplitudes of the part, which are columns -> where they begin."""
        return {}

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        """Check that the surface has the patches that the part names.

        Raises
        ------
        MeshError
            With the name of a missing patch.
        """

    def conjugates(self, loads: "Loads") -> dict[str, str]:
        """Return amplitude -> column of its conjugate, but for amplitudes of every run."""
        return {}

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        """Return the part's columns besides those of every run.

        `supports` are the names of the supports whose reactions are reported.
        """
        return (*self.amplitudes(loads), *self.conjugates(loads).values())

    def motions(self, loads: "Loads") -> dict[str, tuple[bool, float]]:
        """Return the amplitudes that are motions, each with its way at an amplitude of one.

        Returns
        -------
        dict
            Amplitude -> whether it turns alone, and the way: an angle (rad), or else a length over
            R.
        """
        return {}

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return column -> value of the part at a state; by default its free amplitudes."""
        return {name: state.mu[name] for name in self.free_amplitudes(view.loads)}

    def conjugate_unit(self, view: ModelView, name: str) -> float | None:
        """Return -dPi/dmu of one unit of the conjugate of the amplitude `name`.

        None if the amplitude belongs to another part.
        """
        return None
