"""A scene: the model of a problem, of its mid-surface, its meridian or its body, and the solver."""

import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from math import copysign, nan
from typing import TYPE_CHECKING, Any
from warnings import warn

import numpy as np
from dolfinx import fem
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.assembly.terms import factor_of
from magshell_fenicsx.continuation.newton import BorderedNewton
from magshell_fenicsx.continuation.point import Journal, NoJournal, NoProgress, Progress
from magshell_fenicsx.continuation.snes import NewtonOptions
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.continuation.watch import Watch
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.hexahedra import sweep
from magshell_fenicsx.mesh.midsurface import Midsurface, distribute
from magshell_fenicsx.mesh.mirror import Y0, rotation
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.axisymmetric.meridian import Meridian, make_meridian
from magshell_fenicsx.models.shell.thickness import Thickness, refuse_unfit
from magshell_fenicsx.parts.magnetism.fields import strength
from magshell_fenicsx.parts.magnetism.source_step import source_columns
from magshell_fenicsx.parts.part import Context
from magshell_fenicsx.parts.registered import SEEN
from magshell_fenicsx.parts.seen import Sight
from magshell_fenicsx.parts.supports.motion import UNHELD
from magshell_fenicsx.platform.compiler import check_compiler
from magshell_fenicsx.platform.processes import from_first
from magshell_fenicsx.problem.columns import extra_columns, own_amplitudes, sizes_in_units
from magshell_fenicsx.problem.formulas import unshown, written
from magshell_fenicsx.problem.limits import refuse_beyond_memory
from magshell_fenicsx.problem.problem import Problem, meridian_vertices
from magshell_fenicsx.quantities.registry import Sizes
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.simulate.record import LeftOut, Record

if TYPE_CHECKING:
    from magshell_fenicsx.shells.shell import ShellModel
    from magshell_fenicsx.shells.solid import SolidModel

Array = NDArray[np.float64]
NOT_COUNTED = "boundary: the shell moves freely: its unstable directions are not counted"


def build_model(problem: Problem, comm: MPI.Comm) -> "ShellModel":
    """The whole shell, half of it or a sector, on all ranks together."""
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
        problem.mirror or Y0,
    )
    model.turns = problem.turns
    return model


def build_meridian_model(problem: Problem, *, assembled: bool = True) -> MeridianModel:
    """The meridian, whole on every rank; `assembled` as of the model."""
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
    """Its mesh, on every rank."""
    span = problem.meridian
    assert span
    named = {
        name: next(of for of, at in problem.points.items() if at is x)
        for name, x in problem.points.items()
    }
    points = {name: span.place_of(named[name], x) for name, x in problem.points.items()}
    pieces = [(piece.name, piece.ends) for piece in span.pieces]
    held = [name for name, condition in problem.conditions.items() if condition not in UNHELD]
    vertices = meridian_vertices(problem)
    return make_meridian(
        span.embedding, vertices, span.names, points, span.curvature, pieces, held, span.joints
    )


def build_solid_model(problem: Problem, comm: MPI.Comm) -> "SolidModel":
    """The whole body or half of it, on all ranks together."""
    from magshell_fenicsx.shells.solid import SolidModel

    def factor(x: Array) -> Array:
        thicknesses = (problem.thickness or Thickness()).at(x)
        refuse_unfit(thicknesses, x, comm)
        return thicknesses

    solid = problem.body
    assert solid
    body = sweep(
        from_first(comm, problem.triangulated), problem.material.h, solid.layers, comm, factor
    )
    return SolidModel(
        body,
        problem.material,
        solid.material,
        problem.conditions,
        problem.loads,
        problem.mirror or Y0,
    )


def build_midsurface(problem: Problem, comm: MPI.Comm) -> Midsurface:
    """Triangulate on rank 0, distribute to all."""
    return distribute(from_first(comm, problem.triangulated), comm)


class Scene:
    """A problem ready to be solved.

    Parameters
    ----------
    problem
        Everything that will be computed.

    Attributes
    ----------
    model, newton
        The shell as a system of terms, and the solver of its bordered systems.
    journal, progress
        The record of the solver's results for an interrupted run, and the listener to its status.
        The caller that runs the scene sets both.
    meshed
        Changes the mesh of a larger model to which a mode hands over; by default that of the case
        stays.
    warnings
        What is unphysical, or may be too large.
    loose
        Whether rigid motions may be left free: see `Problem.at_rest`.
    free_in_time
        Whether rigid motions are left free in a motion: see `Problem.moves_freely`.
    setup_s
        Time to build the scene in seconds, without compiling kernels.
    """

    def __init__(self, problem: Problem, comm: MPI.Comm = MPI.COMM_WORLD) -> None:
        start = time.perf_counter()
        if problem.awaited:
            raise CaseError(
                "shell.imperfections: kind: modes: compute them first, by simulate.perfect.with_modes(problem, comm)"
            )
        self.problem, self.comm = problem, comm
        from_first(comm, check_compiler)
        self.warnings = [
            said for said in (*self.problem.warnings, _beyond_memory(self.problem, comm)) if said
        ]
        self.model: ShellModel | MeridianModel | SolidModel
        if self.problem.axisymmetric:
            self.model = build_meridian_model(self.problem)
        elif self.problem.body:
            self.model = build_solid_model(self.problem, comm)
        else:
            self.model = build_model(self.problem, comm)
        surface = self.model.midsurface
        several = (
            surface is not None and surface.read
        )  # a file may have pieces, of which each must be held
        unsure = self.model.axisymmetric or several or not self.problem.fixed
        self.loose = unsure and self.problem.at_rest
        motion = self.model.free_motion(self.unloaded().mu) if unsure and not self.loose else ""
        if motion and not self.problem.moves_freely:
            raise MeshError(f"mesh: {flat}" if (flat := self.flat_triangle) else motion)
        self.free_in_time = bool(motion)
        if motion:
            self.warnings.append(NOT_COUNTED)
        # a body's penetration changes over far less than h: factors of a state near by are no
        # tangent's, and the first matrices only find what touches
        faces = {each.pair.setting: each.pair.stiffness for each in self.model.touchings}
        stiff = self.model.contacts or faces
        options = (
            NewtonOptions(fresh=0.0, patience=7, stiffnesses=faces, corners=True) if stiff else None
        )
        self.newton = BorderedNewton(self.model.system, options)
        self.journal: Journal = NoJournal()
        self.progress: Progress = NoProgress()
        self.meshed: Callable[[Problem], Problem] = lambda problem: problem
        self.setup_s = time.perf_counter() - start - self.model.kernels.seconds

    def retuned(self, context: Context) -> "Scene":
        """The same model and solver for what differs by the strength of the field alone."""
        return self._with(
            problem=replace(self.problem, context=context, lambda_m=strength(context))
        )

    def renumbered(self, problem: Problem, model: MeridianModel) -> "Scene":
        """The same for a problem that differs in numbers, with the model that has these."""
        return self._with(
            problem=problem, model=model, newton=BorderedNewton(model.system, self.newton.options)
        )

    def _with(self, **others: Any) -> "Scene":
        other = object.__new__(Scene)
        # what is cached is computed anew
        attributes = {name: of for name, of in vars(self).items() if name not in vars(Scene)}
        vars(other).update(attributes | others)
        return other

    @property
    def plan(self) -> Problem:
        """The name of `problem` in earlier versions."""
        warn("Scene.plan is now Scene.problem", DeprecationWarning, stacklevel=2)
        return self.problem

    @property
    def flat_triangle(self) -> str:
        """Where a triangle is too flat for the penalty, in words; empty if none is."""
        surface = self.model.midsurface
        return (
            self.problem.flat_triangle(surface.patch) if surface and not self.problem.body else ""
        )

    @property
    def cells(self) -> int:
        topology = self.model.V.mesh.topology
        return int(topology.index_map(topology.dim).size_global)

    @cached_property
    def watch(self) -> Watch:
        """The watch over the modes that the model excludes.

        Its first use compiles their kernels.
        """
        return Watch(self.model.excluded_modes)

    @cached_property
    def at_point_forces(self) -> LeftOut:
        """The instabilities at point forces that were left out."""
        return LeftOut()

    @cached_property
    def unshown(self) -> list[str]:
        """What the mesh misses of the problem's formulas, in words; collective."""
        model, formulas = self.model, written(self.problem.context)
        if not formulas:
            return []
        return unshown(
            formulas, model.cells_of_fields(), self.problem.azimuth, self.problem.material.h
        )

    def nowhere(self) -> str:
        """Where a step since the beginning of a walk has found no field, in words after a message;
        collective.
        """
        lost_here = [field.lost for field in self.model.fields if field.lost]
        said = [each for part in self.model.system.comm.allgather(lost_here) for each in part]
        return f"; on this way a step has found no field: {said[0]}" if said else ""

    @property
    def left_out(self) -> list[str]:
        """What the model lacks, for people."""
        return [
            *self.problem.left_out,
            *(said for room in SEEN for said in room.left_out(self.sight)),
        ]

    def unloaded(self) -> State:
        """The undeformed shell; amplitudes are zero, except user-defined ones with a value."""
        field = self.problem.loads.magnetic
        turns = (motion.name for motion in field.turns) if field else ()
        own = {
            *self.motions,
            *self.sources,
            *turns,
            *self.model.contacts,
            *self.model.system.parameters,
        }
        amplitudes = {t.amplitude for t in self.model.system.terms if t.amplitude} | own
        given = self._own_amplitudes
        return State(
            self.model.zero(),
            {name: given.get(name, 0.0) for name in sorted({*amplitudes, *given})},
        )

    def displacement(self, state: State) -> fem.Function:
        """See `Record.u`; collective."""
        self.refuse_foreign(state, more=True)
        model, surface = self.model, self.model.midsurface
        displacement = fem.Function(model.u.function_space, name="u")
        displacement.x.array[:] = model.system.at(state).of(lambda: model.u.x.array.copy())
        given = self.problem.given
        if not (surface and given and given.home):
            return displacement
        if self.problem.half:
            raise ValueError(
                "u: symmetry: half: half of the mesh is not modelled: take symmetry: none"
            )
        if MPI.Comm.Compare(self.comm, given.home.comm) not in (MPI.IDENT, MPI.CONGRUENT):
            raise ValueError(
                f"u: {self.comm.size} processes solve the scene and the mesh belongs to {given.home.comm.size}: "
                "make the scene with those of the mesh, ms.Scene(problem)"
            )
        return given.home.displacement(displacement, surface.given, given.scale)

    def refuse_foreign(self, state: State, *, more: bool = False) -> None:
        """Refuse a state of another scene, as far as it shows.

        Parameters
        ----------
        more
            Whether the state may have amplitudes that this scene has not.

        Raises
        ------
        ValueError
            If it has another number of unknowns or other amplitudes.
        """
        own = self.unloaded()
        if state.u.shape != own.u.shape:
            raise ValueError(
                f"this state is of another scene: it has {state.u.size} unknowns on this rank, this scene has "
                f"{own.u.size}; take records of follow or trace of the same scene"
            )
        others = state.mu.keys() - own.mu.keys() - {*self.model.system.history}
        if own.mu.keys() - state.mu.keys() or (others and not more):
            theirs, ours = (", ".join(sorted(mu)) or "none" for mu in (state.mu, own.mu))
            raise ValueError(
                f"this state is of another scene: its amplitudes are {theirs}, those of this scene {ours}"
            )

    def observe(self, state: State) -> dict[str, float]:
        """The physical columns of a table row: loads, displacements over h, volume, energies over E
        h R^2.
        """
        self.refuse_foreign(state, more=True)
        model, h, loads, sight = self.model, self.problem.material.h, self.model.loads, self.sight
        force = loads.forces.get("force")
        energies = self.energies(state)
        pole = model.deflection(state.u, "pole") / h
        columns = defaultdict[str, float](float)
        for t in {t.group: t for t in model.system.terms}.values():
            columns[t.column] += energies[t.group]
        split = "stretching" in columns  # a solid has no such split
        return {
            "p_over_pc": state.mu.get("pressure", 0.0),
            "force": 0.0,
            "w_over_h": model.loaded_deflection(state.u, loads.displaced) / h
            if loads.displaced
            else pole,
            "w_pole_over_h": pole,
            "w_point_over_h": model.deflection(state.u, force.point) / h if force else pole,
            "volume_change": model.volume_change(state.u, state.mu),
            "energy": sum(energies.values()),
            "stretching": columns["stretching"] if split else nan,
            "bending": columns["bending"] if split else nan,
            "magnetic": columns["magnetic"],
            **{name: energies[name] for name in ("U1", "Uq", "Utau")},
            **self._observe_points(state),
            **{name: state.mu[name] for name in self._own_amplitudes},
            **{
                column: value
                for room in SEEN
                for column, value in room.observe(sight, state).items()
            },
            **{
                column: (state.mu[term.name] if term.density else 1.0)
                * model.multiplicity
                * model.system.at(state).integral(model.observed[column])
                for term in self.problem.loads.own
                for column in term.observed
            },
        }

    def energies(self, state: State) -> dict[str, float]:
        """The energy of each term, over E h R^2; all parts of one field together."""
        model, by_group = self.model, defaultdict[str, float](float)
        potentials = model.system.energies(state.u, state.mu)
        for t in model.system.terms:
            by_group[t.group] += (
                model.multiplicity * factor_of(t.amplitude, state.mu) * potentials[t.name]
            )
        return by_group

    @property
    def _own_amplitudes(self) -> dict[str, float]:
        """The amplitudes of natural shape, imperfections, user-defined energies and parameters,
        with initial values.
        """
        return own_amplitudes(self.problem.loads)

    @property
    def motions(self) -> frozenset[str]:
        """The amplitudes of supports that move."""
        return frozenset(move.motion.name for move in self.problem.loads.moves)

    @property
    def sources(self) -> dict[str, str]:
        """See `source_columns`."""
        return source_columns(self.problem.loads)

    @cached_property
    def sizes(self) -> Sizes:
        """The sizes of the units."""
        return sizes_in_units(self.problem)

    @cached_property
    def extra_columns(self) -> tuple[str, ...]:
        """The columns of a row besides those of every run; the last ones are those in the case's
        units.
        """
        return extra_columns(self.problem)

    def stored(self, state: State, energy: float) -> float:
        """The energy of the shell itself: without the potentials of the loads."""
        system, of = self.model.system, self.model.multiplicity
        loads = (name for name in state.mu if name not in system.coordinates)
        return energy - of * sum(
            state.mu[name] * system.potential(state.u, state.mu, name) for name in loads
        )

    @property
    def sight(self) -> Sight:
        """What rooms of parts see of it."""
        problem = self.problem
        sense = copysign(1.0, problem.lambda_m)
        place = problem.mirror, problem.azimuth
        return Sight(self.model, problem.length, problem.modulus, *place, problem.reactions, sense)

    def to_magpylib(self, record: Record, parts: int = 8) -> Any:
        """The magnetised shell of a record as a source of magpylib, of charged triangles;
        collective.

        In m and T; of a case without units over R and |Br|. Each side of a cell is divided into
        `parts`.

        Raises
        ------
        CaseError
            If nothing is magnetised, or magpylib is missing.
        """
        from magshell_fenicsx.parts.magnetism.own_field import to_magpylib  # of few runs

        return to_magpylib(self.sight, record.point.state, parts)

    def conjugate_unit(self, name: str) -> float:
        """-dPi/dmu of one unit of a target: ΔV/R³ of a pressure, w/h of a force, the shell's length
        of dead loads.
        """
        units = (room.conjugate_unit(self.sight, name) for room in SEEN)
        return next((unit for unit in units if unit is not None), 0.0)

    def _observe_points(self, state: State) -> dict[str, float]:
        """The displacements of named points in the unit of the shell's lengths."""
        displacements: dict[str, float] = {}
        for point in self.problem.context.points:
            u = (
                self.problem.length
                * self.model.displacement(state.u, point)
                @ rotation(self.problem.azimuth)
            )
            displacements |= {
                f"{point}_u{axis}": float(c) for axis, c in zip("xyz", u, strict=True)
            }
        return displacements


def _beyond_memory(problem: Problem, comm: MPI.Comm) -> str | None:
    """See `refuse_beyond_memory`; every rank asks its own machine, and the first refusal is that of
    all.
    """
    if comm.size == 1:
        return refuse_beyond_memory(problem)
    machine = comm.Split_type(MPI.COMM_TYPE_SHARED)
    ranks_of_machine = machine.size
    machine.Free()
    said: str | CaseError | None
    try:
        said = refuse_beyond_memory(problem, comm.size, ranks_of_machine)
    except CaseError as e:
        said = e
    every = comm.allgather(said)
    for each in every:
        if isinstance(each, CaseError):
            raise each
    return next((each for each in every if each), None)
