"""Base classes of the models of shells and solids.

A model joins a displacement, the system of its terms, and what is observed of a state: volume
change, displacement of named points, contact pressures.

Lengths are over R, energies over E h R², forces over E h R. A state is a displacement u (this
rank's unknowns) with amplitudes mu, the load parameters by name. An evaluation is the system at one
state; `evaluate(f)` calls f there, and `integral(form)` sums a form over all ranks. A dead load
keeps its direction; its size is the sum of its forces' magnitudes, by which the work is divided to
give the displacement along it. w = -u . n0 is the deflection.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import ufl
from dolfinx import fem, la
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.finite_element_system import FiniteElementSystem
from magshell_fenicsx.assembly.free_parameters import PlacementAmplitudes
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.terms import FormTerm, LinearTerm
from magshell_fenicsx.continuation.system import Amplitudes, State, Vector
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.models.domains import Energy, Facets, IntegrationDomain
from magshell_fenicsx.models.shell import spatial_fields
from magshell_fenicsx.models.shell.formula_projection import CellGeometry
from magshell_fenicsx.models.shell.law import Law
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.parts.bodies.body_contact import BodyContact, Region
from magshell_fenicsx.parts.forces.load_vectors import DeadLoads, point_entries
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.applied import AppliedField
from magshell_fenicsx.parts.penalty_contact import PenaltyContact
from magshell_fenicsx.parts.stress import StressState
from magshell_fenicsx.parts.supports.support_motion import Support
from magshell_fenicsx.parts.supports.supports import free_motion
from magshell_fenicsx.shells.energy_factory import EnergyFactory

if TYPE_CHECKING:
    from magshell_fenicsx.parts.contact.pair_contact import PairContact

Array = NDArray[np.float64]


class ModelBase:
    """Base of all models: the observations of states that rows of a path consist of.

    A model sets the attributes in its constructor.

    Attributes
    ----------
    system
        System of equations that solvers take.
    material
        Thickness, elastic law and units of the shell.
    multiplicity
        Number of modelled parts that make the shell: 2 for a half, 2 m for a sector of 180/m
        degrees, else 1.
    u, r0
        Displacement and placement over R, in the space V.
    normals
        n0 (3,) at the named points.
    loads
        All that loads the model.
    load_size, load_sizes
        By amplitude, the sum of the sizes of its dead loads over E h R, and that sum as forms,
        which depend on the placement.
    kernels
        Log that compiles forms.
    supports
        Name of an edge, point or patch -> its support.
    without_potential
        Names of the edges at which a live pressure has no potential.
    fields
        Applied fields that are known by their values.
    observed
        Column -> form over the modelled part, of what the user's terms observe and of the
        polarisation that a field induces.
    contacts
        Approach of a body -> the state of its contact.
    shell_contacts
        The contacts of parts of the shell with each other, or with itself.
    planes
        Planes of symmetry at the edges of a shell.
    growing
        The placement with amplitudes of imperfections; None if none grows.
    axes
        Axes in space of the components of displacement and placement.
    thickness
        Factor (1,) of a shell's thickness; None for 1, and for a solid, which has it in its shape.
    midsurface
        The mesh of a mid-surface; None for a meridian or a solid.
    _volume
        Form of Delta V/R^3 of the modelled part.
    _probes
        Name of a point -> this rank's unknowns (n, 3) of the nodes that have it, and the factors
        (n,) of their displacements; of a vertex one node with the factor 1.
    """

    system: FiniteElementSystem
    material: Material
    multiplicity: int
    normals: Mapping[str, Array]
    u: fem.Function
    r0: fem.Function
    loads: Loads
    load_size: dict[str, float]
    load_sizes: dict[str, Sequence[ufl.Form]]
    V: fem.FunctionSpace
    kernels: KernelLog
    supports: Mapping[str, Support]
    without_potential: tuple[str, ...] = ()
    observed: dict[str, fem.Form]
    contacts: dict[str, BodyContact]
    shell_contacts: "Sequence[PairContact[Any]]" = ()
    planes: tuple[Mirror, ...] = ()
    fields: Sequence[AppliedField] = ()
    growing: PlacementAmplitudes | None = None
    axes: ClassVar[list[int]] = [0, 1, 2]
    thickness: fem.Function | None = None
    midsurface: Midsurface | None = None

    @cached_property
    def part_caches(self) -> dict[type, Any]:
        """Caches of parts that belong to this model, by their class."""
        return {}

    @property
    def law_of_cells(self) -> Law:
        """Law of each cell of this rank, for arrays (cells, n) of places in them."""
        return self.material.law

    @property
    def mirrored_facets(self) -> Facets:
        """Edges on the mirror planes of a half model or a sector; empty for other models."""
        return np.empty(0, dtype=np.int32)

    def observe(
        self,
        volume: fem.Form,
        points: Mapping[str, Array],
        cells_at_point: Callable[[str], NDArray[np.bool_] | None] | None = None,
    ) -> None:
        """Set the form of the volume change and the named vertices that are observed; collective.

        Parameters
        ----------
        volume
            Form of Delta V/R^3 of the modelled part.
        points
            Vertex name -> place (3,) over R.
        cells_at_point
            Function of a vertex name to a mask of this rank's cells that may have the vertex; None
            for all cells.
        """
        self._volume = volume
        V = self.system.u.function_space
        self._probes = {}
        for name, x in points.items():
            cells = cells_at_point and cells_at_point(name)
            # unknowns on which a force at the vertex acts; any direction without zeros gives all
            # three of them
            unknowns, factors = point_entries(V, x, np.ones(3), cells)
            self._probes[name] = unknowns.reshape(-1, 3), factors[::3]

    def observe_inside(self, name: str, cells: NDArray[np.int64], reference: Array) -> None:
        """Observe a point inside cells, which is no vertex; collective.

        Parameters
        ----------
        cells, reference
            Numbers (m,) of this rank's cells that have the point, and the place (m, d) in them.
        """
        V = self.system.u.function_space
        table = V.element.basix_element.tabulate(0, reference)[0, ..., 0]
        shares = fem.Function(V)
        # nodes of cells may belong to other ranks, which have no cell with the point: the first
        # rank that has one gives the values of its cell to all ranks
        rank = min(V.mesh.comm.allgather(V.mesh.comm.rank if len(cells) else V.mesh.comm.size))
        if rank == V.mesh.comm.rank:
            shares.x.array.reshape(-1, 3)[V.dofmap.list[cells[0]]] = table[0][:, None]
        shares.x.scatter_reverse(la.InsertMode.add)
        factors = shares.x.array.reshape(-1, 3)[: V.dofmap.index_map.size_local, 0]
        nodes = np.flatnonzero(factors)
        self._probes[name] = 3 * nodes[:, None] + np.arange(3), factors[nodes]

    def dead_load_term(self, name: str, dead: DeadLoads) -> LinearTerm:
        """Return the term of an amplitude's dead loads, without its moments.

        Also sets `load_size` and `load_sizes` of the amplitude.

        Parameters
        ----------
        name
            The amplitude.
        dead
            The assembled loads. Those spread over surfaces and edges also give forms, for
            derivatives by the placement.
        """
        self.load_size[name], self.load_sizes[name] = dead.size, dead.sizes
        unity, u = fem.Constant(self.V.mesh, 1.0), self.u
        forms = [
            FormTerm(
                name,
                -ufl.dot(direction, u) * measure,
                u,
                self.kernels,
                name,
                linear=True,
                over=unity * measure if is_total_given else None,
            )
            # a load of given total is spread over the integral of its measure
            for direction, measure, is_total_given in dead.spread
        ]
        return LinearTerm(name, *dead.entries, self.u, name, forms)

    def size_terms(self, name: str) -> list[FormTerm]:
        """Return the sizes of an amplitude's dead loads as terms that depend on the placement."""
        return [
            FormTerm(f"{name} size", form, self.u, self.kernels)
            for form in self.load_sizes.get(name, ())
        ]

    def free_motion(self, amplitudes: Amplitudes) -> str:
        """Return a message that names a rigid motion left free; "" if there is none; collective."""
        return free_motion(self.system, self.r0, amplitudes)

    def zero(self) -> Vector:
        """Return the undeformed displacement of this rank."""
        return np.zeros(self.system.size)

    def volume_change(self, u: Vector, mu: Amplitudes | None = None) -> float:
        """Return Delta V/R^3 of the whole shell; collective.

        `mu` are the amplitudes by which supports move; lids over moving edges then count too.
        """
        moving = self.system.moving
        swept_by_lids = 0.0
        edge_pressure = moving.edge_pressure if moving else None
        if mu and edge_pressure:
            swept_by_lids = edge_pressure.swept_volume(mu)
        at_state = self.system.at_state(State(u, dict(mu or {})))
        return self.multiplicity * (at_state.integral(self._volume) + swept_by_lids)

    def deflection(self, u: Vector, point: str) -> float:
        """Return w/R = -u . n0 at a named vertex; collective."""
        return -float(self.displacement(u, point) @ self.normals[point])

    def displacement(self, u: Vector, point: str) -> Array:
        """Return u/R (3,) at a named point; collective."""
        unknowns, factors = self._probes[point]
        return np.asarray(self.system.comm.allreduce(factors @ u[unknowns]))

    def probe(self, point: str) -> Array:
        """Return the matrix (3, local size) that maps u to the displacement of a named point.

        Each rank has the columns of its own unknowns.
        """
        rows = np.zeros((3, self.system.size))
        unknowns, factors = self._probes[point]
        rows[np.arange(3), unknowns] = factors[:, None]
        return rows

    def stresses(self, state: State) -> dict[str, StressState]:
        """Return name -> stresses at the points of `stress`, none of a solid; collective.

        Raises
        ------
        MeshError
            On every rank, if they have no single value at a point.
        """
        from magshell_fenicsx.shells.stress_recovery import (  # of few runs
            meridian_stresses,
            shell_stresses,
        )

        at_point: Any = shell_stresses if self.midsurface else meridian_stresses
        points = self.loads.stress.points if self.loads.stress else ()

        def at_points() -> dict[str, StressState]:
            """Return the stresses at the system's state."""
            return {point.name: at_point(self, point, state.mu) for point in points}

        return self.system.at_state(state).evaluate(at_points)

    def region(self, state: State, approach: str) -> Region:
        """Return the region where a body touches the shell; collective.

        `approach` is the amplitude of the body's approach, the key of `contacts`.
        """
        return self.system.at_state(state).evaluate(self.contacts[approach].region)

    @property
    def all_contacts(self) -> list[PenaltyContact[Any, Any]]:
        """All contacts: with bodies, then of parts of the shell."""
        return [*self.contacts.values(), *self.shell_contacts]

    @property
    def shell_cells(self) -> Mapping[str, NDArray[np.bool_]]:
        """Name of each of several shells -> flags (cells,) of its local cells; empty for one."""
        return {}

    @property
    def contact_history(self) -> dict[str, tuple[Any, float]]:
        """The numbers of contacts that a state keeps, with defaults: stiffnesses and cuts."""
        history = dict[str, tuple[Any, float]]()
        for contact in self.all_contacts:
            history |= contact.history
        return history

    def cell_pressures(self, state: State) -> Array | None:
        """Return the sum of all contact pressures in each local cell, (cells,), over E h/R.

        A cell has the mean pressure of each contact with a body, or of parts of the shell. None
        without contacts.
        """
        contacts = self.all_contacts
        if not contacts:
            return None

        def pressure_of_cells() -> Array:
            """Return the sum over all contacts in each cell, at the system's state."""
            return np.asarray(sum(contact.cell_pressures() for contact in contacts))

        return self.system.at_state(state).evaluate(pressure_of_cells)

    def cells_evenly_pressed(self, state: State) -> NDArray[np.bool_]:
        """Return a mask (cells,) of the local cells that a contact presses evenly.

        There the mean over the cell, as `cell_pressures` gives it, stands for the pressure.
        """

        def flags_of_cells() -> NDArray[np.bool_]:
            """Return whether any contact presses each cell evenly, at the system's state."""
            flags = [contact.evenly_pressed() for contact in self.all_contacts]
            return np.asarray(np.any(flags, axis=0))

        return self.system.at_state(state).evaluate(flags_of_cells)

    def cell_gaps(self, state: State) -> Array | None:
        """Return the least gap over R between parts of the shell in each local cell, (cells,).

        Where nothing is near it is the contact's reach less the thickness. None without contact
        pairs.
        """
        if not self.shell_contacts:
            return None

        def gaps_of_cells() -> Array:
            """Return the least gap over all contacts in each cell, at the system's state."""
            gaps = []
            for contact in self.shell_contacts:
                _, cell_gaps, _ = contact.cell_pressures_and_gaps()
                gaps.append(cell_gaps)
            return np.asarray(np.min(gaps, axis=0))

        return self.system.at_state(state).evaluate(gaps_of_cells)

    def loaded_deflection(self, u: Vector, name: str) -> float:
        """Return the w/R on which a force or the dead loads of an amplitude do work; collective.

        For a force it is the deflection at its point, or its mean over the patch; for dead loads
        the displacement along them. Moments alone have none: then it is the deflection of the pole.
        """
        load_unit = self.load_size.get(name, 0.0) if name in self.loads.dead else self.force_unit
        if not load_unit:  # moments alone
            return self.deflection(u, "pole")
        # Pi = -load times displacement, at an amplitude of one
        load = next(term for term in self.system.terms if term.name == name)
        energy = self.system.at_state(State(u, {})).evaluate(load.energy)
        return -float(self.system.comm.allreduce(energy)) / load_unit

    @property
    def force_unit(self) -> float:
        """Force on the modelled part with F R/(2 pi D) = 1, over E h R."""
        return 2 * np.pi * self.material.bending_stiffness / self.multiplicity


class ThinModel(ModelBase):
    """Base of the models of thin shells, on a mid-surface or a meridian.

    Attributes
    ----------
    factory
        Factory that made the energies.
    kernels
        Log that compiles forms.
    """

    factory: EnergyFactory
    kernels: KernelLog

    def user_and_body_energies(self, edges: Mapping[str, Facets]) -> list[Energy]:
        """Return the energies of the user's terms and of contacts with bodies; collective.

        Sets `observed` (forms of the user's columns and of the induced polarisation) and
        `contacts`.

        Parameters
        ----------
        edges
            Edge name -> its facets.
        """
        factory = self.factory
        # facets on which a term acts; None for the whole surface
        terms_and_facets = [
            (term, edges[term.on] if term.on else None) for term in self.loads.user_terms
        ]
        energies = [
            factory.user_energy(term, facets) for term, facets in terms_and_facets if term.density
        ]
        self.observed = self.kernels.compile_all(
            factory.observed(term, facets) for term, facets in terms_and_facets
        )
        if self.loads.magnetic:
            self.observed |= self.kernels.compile_all([factory.induced(self.loads.magnetic)])
        self.contacts = {}
        for contact in self.loads.contacts:
            energy, self.contacts[contact.amplitude] = factory.contact(contact)
            energies.append(energy)
        return energies

    @property
    def domain(self) -> IntegrationDomain:
        """Domain on which the densities are integrated."""
        return self.factory.domain

    @property
    def law_of_cells(self) -> Law:
        return self.factory.law_of_cells

    def over_area(self) -> Callable[[Expr], ufl.Form]:
        """Return the function that integrates an expression over the undeformed area."""
        integral = self.domain.over_area()
        return lambda f: self.domain.revolution_factor * integral(f)

    def cells_of_fields(self) -> CellGeometry:
        """Return the geometry of the cells in which formulas give fields."""
        return spatial_fields.cell_geometry(self.r0)

    def places(self, nodes: Array) -> tuple[Array, Array]:
        """Return undeformed places and normals at reference points `nodes` of all cells.

        Both have the shape (cells, points, 3).
        """
        return spatial_fields.positions_and_normals(self.r0, nodes)
