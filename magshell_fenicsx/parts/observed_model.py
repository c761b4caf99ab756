"""Protocol of a model, as far as parts read it to observe a state.

Lengths are over R, forces over E h R; E, h and R are Young's modulus, thickness and reference
length. An amplitude is a load parameter, by name.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

if TYPE_CHECKING:
    import numpy as np
    from dolfinx import fem
    from numpy.typing import NDArray

    from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
    from magshell_fenicsx.continuation.system import State, Vector
    from magshell_fenicsx.models.domains import Facets
    from magshell_fenicsx.models.shell.law import Law
    from magshell_fenicsx.models.shell.parameters import Material
    from magshell_fenicsx.parts.bodies.body_contact import BodyContact, Region
    from magshell_fenicsx.parts.contact.pair_contact import PairContact
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.parts.stress import StressState
    from magshell_fenicsx.parts.supports.support_motion import Support


class ObservedModel(Protocol):
    """A model of a shell, a meridian or a solid, as parts observe it.

    Attributes
    ----------
    system
        System of equations, with the displacement.
    material
        Thickness, elastic law and units of the shell.
    multiplicity
        Number of modelled parts that make the shell: 2 for a half, 2 m for a sector of 180/m
        degrees, else 1.
    r0
        Placement over R.
    axes
        Axes in space of the components of displacement and placement.
    thickness
        Factor (1,) of a shell's thickness; None for 1, and for a solid, which has it in its shape.
    loads
        All that loads the model.
    load_size
        By amplitude, the sum of the sizes of its dead loads over E h R.
    supports
        Name of an edge, point or patch -> its support.
    without_potential
        Names of the edges at which a live pressure has no potential.
    observed
        Column -> form over the modelled part, of what the user's terms observe and of the
        polarisation that a field induces.
    contacts
        Approach of a body -> the state of its contact.
    """

    system: "FiniteElementSystem"
    material: "Material"
    multiplicity: int
    r0: "fem.Function"
    axes: ClassVar[list[int]]
    thickness: "fem.Function | None"
    loads: "Loads"
    load_size: dict[str, float]
    supports: "Mapping[str, Support]"
    without_potential: tuple[str, ...]
    observed: "dict[str, fem.Form]"
    contacts: "dict[str, BodyContact]"

    @property
    def shell_contacts(self) -> "Sequence[PairContact[Any]]":
        """The contacts of parts of the shell with each other, or with itself."""

    @property
    def shell_cells(self) -> "Mapping[str, NDArray[np.bool_]]":
        """Name of each of several shells -> flags (cells,) of its local cells; empty for one."""

    @property
    def part_caches(self) -> dict[type, Any]:
        """Caches of parts that belong to this model, by their class."""

    @property
    def law_of_cells(self) -> "Law":
        """Law of each cell of this rank, for arrays (cells, n) of places in them."""

    @property
    def mirrored_facets(self) -> "Facets":
        """Edges on the mirror planes of a half model or a sector; empty for other models."""

    @property
    def force_unit(self) -> float:
        """Force on the modelled part with F R/(2 pi D) = 1, over E h R."""

    def region(self, state: "State", approach: str) -> "Region":
        """Return the region where a body touches the shell; collective.

        `approach` is the amplitude of the body's approach, the key of `contacts`.
        """

    def stresses(self, state: "State") -> "Mapping[str, StressState]":
        """Return name -> stresses at the points at which they are read; not of a solid; collective.

        Raises
        ------
        MeshError
            If they have no single value at a point.
        """

    def deflection(self, u: "Vector", point: str) -> float:
        """Return w/R = -u . n0 at a named vertex; collective."""

    def displacement(self, u: "Vector", point: str) -> "NDArray[np.float64]":
        """Return u/R (3,) at a named vertex; collective."""

    def volume_change(self, u: "Vector", mu: Mapping[str, float]) -> float:
        """Return Delta V/R^3 of the whole shell with supports moved by amplitudes; collective."""

    def loaded_deflection(self, u: "Vector", name: str) -> float:
        """Return the w/R on which a force or the dead loads of an amplitude work; collective."""
