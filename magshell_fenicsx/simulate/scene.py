"""Scene: the model of a problem, of its mid-surface, its meridian or its body, and the solver.

A problem goes in: all numbers, formulas and shapes of a case. A scene comes out: the finite element
model with its solver, which computes equilibria, and what reports read from their states.

Words and symbols:

- A state has the displacement u of its model, over the reference length R, and mu: amplitudes by
  name. An amplitude is a load parameter or another number that may vary along a path; Pi is the
  potential energy.
- The model is a surface, a meridian (an axisymmetric shell) or a body (a solid), in each case the
  whole or a part with symmetry. `multiplicity` is the number of such parts in the whole.
- A term is an energy with its form; one that an amplitude multiplies is a load.
- Observables are the columns and lines that a part of the package (magnets, supports, ...) reads
  from a state. h is the thickness, E Young's modulus.
- Own energies and amplitudes are those that a program defines for its case.
"""

import time
from collections.abc import Callable, Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any
from warnings import warn

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.global_mesh import component_count
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.point import NoJournal, NoProgress, Progress, SolverJournal
from magshell_fenicsx.continuation.snes import NewtonOptions
from magshell_fenicsx.continuation.stability_monitor import StabilityMonitor
from magshell_fenicsx.continuation.system import State, Vector
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.hexahedra import sweep
from magshell_fenicsx.mesh.midsurface import Midsurface, distribute
from magshell_fenicsx.mesh.mirror import Y0_PLANE
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.mesh.user_mesh import UserMesh
from magshell_fenicsx.models.axisymmetric.meridian import Meridian, make_meridian
from magshell_fenicsx.models.shell.thickness import Thickness, refuse_unfit
from magshell_fenicsx.parts.magnetism.source_step import source_columns
from magshell_fenicsx.parts.observables import ModelView
from magshell_fenicsx.parts.pressure.openings import no_potential
from magshell_fenicsx.parts.registered import OBSERVABLES
from magshell_fenicsx.parts.supports.motion import UNHELD_CONDITIONS
from magshell_fenicsx.platform.compiler import check_compiler
from magshell_fenicsx.platform.processes import on_first_rank
from magshell_fenicsx.problem.columns import extra_columns, own_amplitudes, sizes_in_units
from magshell_fenicsx.problem.formulas import case_formulas, unresolved_formulas
from magshell_fenicsx.problem.memory import refuse_beyond_memory
from magshell_fenicsx.problem.problem import Problem, meridian_vertices
from magshell_fenicsx.quantities.registry import Sizes
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.simulate.record import PointForceModes, Record

if TYPE_CHECKING:
    from magshell_fenicsx.shells.shell import ShellModel
    from magshell_fenicsx.shells.solid import SolidModel

Array = NDArray[np.float64]
NOT_COUNTED = "boundary: the shell moves freely: its unstable directions are not counted"


def build_model(problem: Problem, comm: MPI.Comm) -> "ShellModel":
    """Return the model of a shell, of half of it or of a sector; collective."""
    from magshell_fenicsx.shells.shell import ShellModel  # a meridian does without

    surface = build_midsurface(problem, comm)
    model = ShellModel(
        surface,
        problem.material,
        problem.mesh.degree,
        problem.conditions,
        problem.loads,
        problem.mesh.penalty,
        problem.thickness,
        problem.mirror or Y0_PLANE,  # not used by the whole shell
    )
    # of a case that is axisymmetric in all: what has buckled may turn about e3 freely
    model.turns = problem.turns
    return model


def build_meridian_model(problem: Problem, *, assembled: bool = True) -> MeridianModel:
    """Return the model of an axisymmetric shell by its meridian, which is whole on every rank.

    Parameters
    ----------
    assembled
        Whether the model gets its system of terms; False: its numbers alone, for forms of another
        model.
    """
    return MeridianModel(
        build_meridian(problem),
        problem.material,
        problem.mesh.degree,
        problem.conditions,
        problem.loads,
        problem.mesh.penalty,
        problem.thickness,
        assembled=assembled,
    )


def build_meridian(problem: Problem) -> Meridian:
    """Return the mesh of the meridian of a problem, the same on every rank.

    Named points become nodes. Two names for one point share a node.
    """
    chart = problem.meridian
    assert chart
    points = {}
    for name, place in problem.points.items():
        # two names for one point have one place object; the first of them locates it
        first_name = next(
            other_name for other_name, other_place in problem.points.items() if other_place is place
        )
        points[name] = chart.locate_named(first_name, place)
    shells = [(shell.name, shell.ends) for shell in chart.shell_meridians]
    held_names = [  # points whose boundary condition supports the shell
        name for name, condition in problem.conditions.items() if condition not in UNHELD_CONDITIONS
    ]
    return make_meridian(
        chart.embedding,
        meridian_vertices(problem),
        chart.names,
        points,
        chart.curvature,
        shells,
        held_names,
        chart.joints,
    )


def build_solid_model(problem: Problem, comm: MPI.Comm) -> "SolidModel":
    """Return the model of a body or of half of it; collective.

    The body is the triangulated mid-surface, swept through its thickness in layers of elements.
    """
    from magshell_fenicsx.shells.solid import SolidModel

    def thickness_factor(x: Array) -> Array:
        """Return thickness over h (n,) at undeformed places (n, 3)."""
        thicknesses = (problem.thickness or Thickness()).values_at(x)
        refuse_unfit(thicknesses, x, comm)
        return thicknesses

    solid = problem.body
    assert solid
    body = sweep(
        on_first_rank(comm, problem.triangulated),
        problem.material.h,
        solid.layer_bounds,
        comm,
        thickness_factor,
    )
    return SolidModel(
        body,
        problem.material,
        solid.material,
        problem.conditions,
        problem.loads,
        problem.mirror or Y0_PLANE,
    )


def build_midsurface(problem: Problem, comm: MPI.Comm) -> Midsurface:
    """Return the mid-surface of a problem, triangulated on rank 0 and distributed to all."""
    return distribute(on_first_rank(comm, problem.triangulated), comm)


class Scene:
    """A problem ready to be solved: its finite element model with a solver.

    Parameters
    ----------
    problem
        Everything that will be computed.
    comm
        Ranks that share the model; all of them make the scene.

    Attributes
    ----------
    model, newton
        The shell as a system of terms, and the solver of its bordered systems.
    journal, progress
        The record of the solver's results for an interrupted run, and the listener to its status.
        The caller that runs the scene sets both.
    remesh
        Function that changes the mesh of a larger model's problem, where a mode has led out of this
        model; by default the mesh of the case stays.
    warnings
        Warnings of what is unphysical, or may be too large.
    allows_rigid_motion
        Whether supports may leave rigid motions free, as nothing loads the shell.
    free_in_time
        Whether supports leave rigid motions free in a step in time; pivots then do not count.
    setup_s
        Time to build the scene in seconds, without compiling kernels.
    """

    def __init__(self, problem: Problem, comm: MPI.Comm = MPI.COMM_WORLD) -> None:
        """Build the model, and check that supports hold it, or that it may move; collective."""
        start = time.perf_counter()
        if problem.pending_modes:
            raise CaseError(
                "shell.imperfections: kind: modes: compute them first, by "
                "simulate.perfect.with_modes(problem, comm)"
            )
        self.problem, self.comm = problem, comm
        on_first_rank(comm, check_compiler)
        memory_warning = beyond_memory(self.problem, comm)
        self.model: ShellModel | MeridianModel | SolidModel
        if self.problem.axisymmetric:
            self.model = build_meridian_model(self.problem)
        elif self.problem.body:
            self.model = build_solid_model(self.problem, comm)
        else:
            self.model = build_model(self.problem, comm)
        if self.problem.loads.pressure and self.model.without_potential:
            memory_warning = beyond_memory(self.problem, comm, skewed=True)
        warnings = (*self.problem.warnings, memory_warning)
        self.warnings = [warning for warning in warnings if warning]
        self._examine_supports()
        self.newton = BorderedNewton(self.model.system, self._newton_options())
        self.journal: SolverJournal = NoJournal()
        self.progress: Progress = NoProgress()
        self.remesh: Callable[[Problem], Problem] = lambda problem: problem
        self.setup_s = time.perf_counter() - start - self.model.kernels.seconds

    def _examine_supports(self) -> None:
        """Check that supports hold the shell, or that it may move; collective.

        Sets `allows_rigid_motion` and `free_in_time`, and adds a warning for a shell that moves
        freely.

        Raises
        ------
        MeshError
            If supports leave a rigid motion free and something needs it held.
        """
        surface = self.model.midsurface
        # A clamped support holds a shell for sure. But a mesh file may have several pieces, each of
        # which must be held. And a meridian is always examined.
        is_from_file = surface is not None and surface.from_mesh_file
        is_in_pieces = is_from_file and component_count(self.model.V) > 1
        may_be_loose = self.model.axisymmetric or is_in_pieces
        is_held_for_sure = self.problem.fixed and not may_be_loose
        # for frequencies alone, without loads, nothing need hold the shell
        self.allows_rigid_motion = not is_held_for_sure and self.problem.at_rest
        # message on a rigid motion that the supports leave free; "" without one
        free_motion = ""
        if not (is_held_for_sure or self.allows_rigid_motion):
            free_motion = self.model.free_motion(self.unloaded().mu)
        # only a case of steps in time may leave it free: inertia resists it
        if free_motion and not self.problem.moves_freely:
            raise MeshError(free_motion + self.problem.support_hint)
        self.free_in_time = bool(free_motion)
        if free_motion:
            self.warnings.append(NOT_COUNTED)

    def _newton_options(self) -> NewtonOptions | None:
        """Return the options of the solver of a model with contact; None (the default) without."""
        penalties = [contact.options for contact in self.model.all_contacts]
        stiffnesses = {penalty.setting: penalty.stiffness for penalty in penalties}
        if not stiffnesses:
            return None
        # A penetration changes over far less than h. So factors of a near-by state are of no use.
        # The first iterations only find out what touches, and the solver must have patience.
        return NewtonOptions(reuse_distance=0.0, patience=7, stiffnesses=stiffnesses)

    def copied(self, **changes: Any) -> "Scene":
        """Return a copy with changed attributes; cached properties are computed anew.

        Parameters
        ----------
        changes
            Name of an attribute -> its new value.
        """
        copied_scene = object.__new__(Scene)
        # cached properties are in the class too, other attributes in the instance alone
        attributes = {name: value for name, value in vars(self).items() if name not in vars(Scene)}
        vars(copied_scene).update(attributes | changes)
        return copied_scene

    def __repr__(self) -> str:
        """Return the model in a line."""
        kind, name = type(self).__name__, self.problem.document.name
        return f"{kind} of {name}: {self.cells} cells, {self.model.system.dofs} unknowns"

    @property
    def plan(self) -> Problem:
        """The name of `problem` in earlier versions."""
        warn("Scene.plan is now Scene.problem", DeprecationWarning, stacklevel=2)
        return self.problem

    @property
    def cells(self) -> int:
        """Number of cells of the mesh, on all ranks."""
        topology = self.model.V.mesh.topology
        return int(topology.index_map(topology.dim).size_global)

    @cached_property
    def stability_monitor(self) -> StabilityMonitor:
        """Monitor of the modes that the model excludes, which counts unstable ones along a path.

        Its first use compiles their kernels.
        """
        return StabilityMonitor(self.model.symmetry_breaking_modes)

    @cached_property
    def point_force_modes(self) -> PointForceModes:
        """Notes on instabilities at point forces that are left out of the history."""
        return PointForceModes()

    @cached_property
    def unresolved(self) -> list[str]:
        """Messages on details of the problem's formulas that the mesh misses; collective."""
        model, formulas = self.model, case_formulas(self.problem.context)
        if not formulas:
            return []
        return unresolved_formulas(
            formulas, model.cells_of_fields(), self.problem.azimuth, self.problem.material.h
        )

    def lost_field_text(self) -> str:
        """Return the end of a message on a path where an applied field was not known; collective.

        It is "" if every field was finite at all places since the begin of the path.
        """
        lost_here = [field.lost for field in self.model.fields if field.lost]
        places = [
            place
            for lost_places in self.model.system.comm.allgather(lost_here)
            for place in lost_places
        ]
        return f"; on this way a step has found no field: {places[0]}" if places else ""

    @property
    def left_out(self) -> list[str]:
        """Phrases for the physics that the model leaves out."""
        open_at = self.model.without_potential if self.problem.loads.pressure else ()
        return [*self.problem.left_out, *([no_potential(open_at)] if open_at else [])]

    def unloaded(self) -> State:
        """Return the state of the undeformed shell, without loads.

        Amplitudes are zero, except user-defined ones with an initial value.
        """
        field = self.problem.loads.magnetic
        # amplitudes that turn the field
        turns = (motion.name for motion in field.turns) if field else ()
        values = self._own_amplitudes  # with initial values
        names = {
            *self.motions,
            *self.sources,
            *turns,
            *self.model.contacts,
            *self.model.system.parameters,
            *(term.amplitude for term in self.model.system.terms if term.amplitude),
            *values,
        }
        return State(self.model.zero(), {name: values.get(name, 0.0) for name in sorted(names)})

    def read_functions(self) -> None:
        """Read the functions and constants that a program has given again; collective.

        The next solve has their present values.

        Raises
        ------
        MeshError
            On every rank, if a value is not allowed.
        """
        model = self.model
        if model.thin and not model.axisymmetric and model.read_functions():
            self.newton.forget_factors()

    def displacement(self, state: State) -> fem.Function:
        """Return the displacement of a state as a dolfinx function; collective.

        It is on the mesh that a program has given, in the lengths of its coordinates; else on the
        mesh of the model, over R.

        Parameters
        ----------
        state
            State of the scene; it may have further amplitudes.

        Raises
        ------
        ValueError
            If the state is of another scene, if the scene models half of a user's mesh, or if other
            ranks solve it than hold that mesh.
        """
        self.refuse_foreign(state, allows_more=True)
        model = self.model
        # all nodal values at the state, with those of moving supports
        values = model.system.at_state(state).evaluate(lambda: model.u.x.array.copy())
        return self.on_given_mesh(values)

    def on_given_mesh(self, values: Vector) -> fem.Function:
        """Return displacements of this rank's nodes, ghosts included, as a function; collective.

        It is on the mesh that a program has given, in the lengths of its coordinates; else on the
        mesh of the model, over R.

        Raises
        ------
        ValueError
            If the scene models half of a user's mesh, or if other ranks solve it than hold that
            mesh.
        """
        displacement = fem.Function(self.model.u.function_space, name="u")
        displacement.x.array[:] = values
        surface, user_mesh = self.model.midsurface, self.user_mesh()
        if not (surface and user_mesh):
            return displacement
        return user_mesh.displacement(displacement, surface.source_triangles, self._user_length)

    def unknowns_of(self, u: fem.Function) -> Vector:
        """Return the unknowns of a displacement like that of `displacement`; collective."""
        displacement = fem.Function(self.model.u.function_space)
        surface, user_mesh = self.model.midsurface, self.user_mesh()
        if surface and user_mesh:
            user_mesh.put_displacement(u, displacement, surface.source_triangles, self._user_length)
        else:
            displacement.x.array[:] = u.x.array
        return np.array(displacement.x.array[: self.model.system.size])

    @property
    def _user_length(self) -> float:
        """The unit of length of a program's mesh, over R."""
        assert self.problem.mesh_file
        return self.problem.mesh_file.scale

    def user_mesh(self, name: str = "u") -> UserMesh | None:
        """Return the mesh that a program has given; None without one.

        Parameters
        ----------
        name
            What needs its functions, for messages.

        Raises
        ------
        ValueError
            If functions on it are none of the scene: of half a mesh, or of other ranks.
        """
        mesh_file = self.problem.mesh_file
        user_mesh = mesh_file.user_mesh if mesh_file and self.model.midsurface else None
        if user_mesh is None:
            return None
        if self.problem.is_half:
            raise ValueError(
                f"{name}: symmetry: half: half of the mesh is not modelled: take symmetry: none"
            )
        if MPI.Comm.Compare(self.comm, user_mesh.comm) not in (MPI.IDENT, MPI.CONGRUENT):
            raise ValueError(
                f"{name}: {self.comm.size} processes solve the scene and the mesh belongs to "
                f"{user_mesh.comm.size}: make the scene with those of the mesh, ms.Model(problem)"
            )
        return user_mesh

    def refuse_unknown_amplitude(self, place: str, name: str) -> None:
        """Check that the scene has an amplitude; `place` begins the message.

        Raises
        ------
        ValueError
            If it has none of this name.
        """
        names = self.unloaded().mu
        if name not in names:
            raise ValueError(
                f"{place}: {name}: the scene has no such amplitude, only "
                f"{', '.join(names) or 'none'}"
            )

    @staticmethod
    def refuse_other_arguments(name: str, scene: object, records: Sequence[object]) -> None:
        """Check that a function of a model and of its records gets them in this order.

        Parameters
        ----------
        name
            Name of the function, for the message.

        Raises
        ------
        ValueError
            If `scene` is no scene, one of the others no record, or a record of another run.
        """
        if not isinstance(scene, Scene) or not all(isinstance(each, Record) for each in records):
            raise ValueError(f"{name}: give the model first, then what follow or trace yield")
        # models of one run, from which modes lead into others, share its journal
        foreign_records = [
            record
            for record in records
            if isinstance(record, Record)
            and record.scene
            and record.scene.journal is not scene.journal
        ]
        if foreign_records:
            scene.refuse_foreign(foreign_records[0].point.state)  # says in what they differ
            raise ValueError(
                f"{name}: a record is of another model: give record.scene in place of the model"
            )

    def refuse_foreign(self, state: State, *, allows_more: bool = False) -> None:
        """Check that a state may be one of this scene, by its numbers and names.

        Parameters
        ----------
        allows_more
            Whether the state may have amplitudes that this scene has not.

        Raises
        ------
        ValueError
            If it has another number of unknowns or other amplitudes.
        """
        unloaded = self.unloaded()
        if state.u.shape != unloaded.u.shape:
            raise ValueError(
                f"this state is of another scene: it has {state.u.size} unknowns on this rank, "
                f"this scene has {unloaded.u.size}; take records of follow or trace of the same "
                "scene"
            )
        # `system.history` has entries that a state keeps, as angles of edges; they come with the
        # first steps of a path
        further_amplitudes = state.mu.keys() - unloaded.mu.keys() - {*self.model.system.history}
        missing_amplitudes = unloaded.mu.keys() - state.mu.keys()
        has_too_many = further_amplitudes and not allows_more
        if missing_amplitudes or has_too_many:
            names_of_state, names_of_scene = (
                ", ".join(sorted(mu)) or "none" for mu in (state.mu, unloaded.mu)
            )
            raise ValueError(
                f"this state is of another scene: its amplitudes are {names_of_state}, those "
                f"of this scene {names_of_scene}"
            )

    def observe(self, state: State) -> dict[str, float]:
        """Return column of path.csv -> its dimensionless value at a state; collective.

        Loads are over their unit, displacements over h, the change of volume over R^3, and energies
        over E h R^2. A column without a value is NaN.
        """
        self.refuse_foreign(state, allows_more=True)
        view, columns = self.view, dict[str, float]()
        for observables in OBSERVABLES:
            columns |= observables.observe(view, state)
        return columns

    def energies(self, state: State) -> dict[str, float]:
        """Return group of terms -> energy over E h R^2 of the whole shell; collective."""
        return self.view.energies(state)

    @property
    def _own_amplitudes(self) -> dict[str, float]:
        """Initial amplitudes of natural shape, imperfections, own energies and parameters."""
        return own_amplitudes(self.problem.loads)

    @property
    def motions(self) -> frozenset[str]:
        """Names of the amplitudes that move supports."""
        return frozenset(move.motion.name for move in self.problem.loads.moves)

    @property
    def sources(self) -> dict[str, str]:
        """Amplitude of a moving source of the field -> its column in path.csv."""
        return source_columns(self.problem.loads)

    @cached_property
    def sizes(self) -> Sizes:
        """Sizes of the case's units, by which dimensionless columns become columns in units."""
        return sizes_in_units(self.problem)

    @cached_property
    def extra_columns(self) -> tuple[str, ...]:
        """Columns of a row besides those of every run; those in the case's units come last."""
        return extra_columns(self.problem)

    def energy_of_shell(self, state: State, energy: float) -> float:
        """Return the energy of the shell itself: without the potentials of the loads.

        The potential of a load is mu dPi/dmu. Coordinates, as positions of supports and free
        parameters, are amplitudes without a potential of their own.

        Parameters
        ----------
        energy
            Energy of the state with the potentials of the loads, over E h R^2.
        """
        system = self.model.system
        potentials = sum(
            mu * system.potential(state.u, state.mu, name)
            for name, mu in state.mu.items()
            if name not in system.coordinates
        )
        return energy - self.model.multiplicity * potentials

    @property
    def view(self) -> ModelView:
        """The model with the units and the frame of reports, for observables of parts."""
        problem = self.problem
        return ModelView(
            self.model,
            problem.length,
            problem.modulus,
            problem.mirror,
            problem.azimuth,
            problem.reactions,
            tuple(problem.context.points),
            problem.context.strengths,
        )

    def to_magpylib(self, record: Record, parts: int = 8) -> Any:
        """Return the magnetised shell of a record as a source of magpylib; collective.

        It is of charged triangles, in m and T; of a case without units over R and |Br|. Each side
        of a cell is divided into `parts`.

        Raises
        ------
        CaseError
            If nothing is magnetised, or magpylib is missing.
        """
        from magshell_fenicsx.parts.magnetism.self_field import to_magpylib  # of few runs

        return to_magpylib(self.view, record.point.state, parts)

    def conjugate_unit(self, name: str) -> float:
        """Return the value of -dPi/dmu that is one unit of the conjugate of an amplitude.

        Targets of steps are in this unit: ΔV/R³ of a pressure, w/h of a force, and the shell's
        length of dead loads. It is 0 for an amplitude that has no such unit.
        """
        units = (observables.conjugate_unit(self.view, name) for observables in OBSERVABLES)
        return next((unit for unit in units if unit is not None), 0.0)


def beyond_memory(problem: Problem, comm: MPI.Comm, *, skewed: bool = False) -> str | None:
    """Return a warning if a problem comes near the machine's memory, else None; collective.

    Every rank asks its own machine. If one of them has too little memory, all ranks raise the same
    error.

    Parameters
    ----------
    skewed
        Whether the tangent is known to be skewed.

    Raises
    ------
    CaseError
        If the problem needs more memory than a machine has.
    """
    if comm.size == 1:
        return refuse_beyond_memory(problem, skewed=skewed)
    machine = comm.Split_type(MPI.COMM_TYPE_SHARED)
    ranks_of_machine = machine.size
    machine.Free()
    outcome: str | CaseError | None
    try:
        outcome = refuse_beyond_memory(problem, comm.size, ranks_of_machine, skewed=skewed)
    except CaseError as e:
        outcome = e
    outcomes = comm.allgather(outcome)
    for error in outcomes:
        if isinstance(error, CaseError):
            raise error
    # the first warning of any rank
    return next((warning for warning in outcomes if warning), None)
