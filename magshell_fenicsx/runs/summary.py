"""The result of a run, summary.json, and the numbers of its snaps.

A row has the columns of path.csv at one point of the path. An amplitude is a load parameter. A
scene is the model of a problem with its solver; another may follow where an instability breaks the
symmetry of the model. A record is a point of a history with its scene. k_d (knockdown) is p/p_c at
the first instability under pressure, λ_m the dimensionless field. A snap is the motion from a fold
to the next rest. Excluded pivots count unstable directions that the model's symmetry excludes. E,
h, R, D are Young's modulus, thickness, reference length and bending stiffness.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.assembly.terms import factor_of
from magshell_fenicsx.continuation.factor import Stopwatch
from magshell_fenicsx.continuation.system import State, dot
from magshell_fenicsx.output.fields.mode_fields import hertz
from magshell_fenicsx.output.report.verdict import place_in_units
from magshell_fenicsx.output.store.run_identity import CASE_FILE
from magshell_fenicsx.output.store.table import LOCATED, Row
from magshell_fenicsx.parts.magnetism.fields import dimensionless_groups
from magshell_fenicsx.parts.magnetism.readings import moment_in_summary
from magshell_fenicsx.parts.shell_sections import ShellSection, Surface
from magshell_fenicsx.platform.environment import code_version, fast_blas, versions
from magshell_fenicsx.quantities.registry import Sizes, amplitude
from magshell_fenicsx.runs.rows import Table, table
from magshell_fenicsx.shells.modes import ShellMode
from magshell_fenicsx.simulate.adapt.ending import History, NoResult
from magshell_fenicsx.simulate.discretisation_error import (
    ErrorEstimates,
    FineScenes,
    estimate_errors,
)
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene

if TYPE_CHECKING:
    from magshell_fenicsx.simulate.adapt.choice import Adapted

Array = NDArray[np.float64]

# result -> its names in units, of which a case has at most one
IN_UNITS = {
    "knockdown": {"buckling_pressure_Pa"},
    "critical_field": {"critical_field_mT", "critical_field_percent"},
    "barrier": {"barrier_mJ"},
}
LARGE_ERROR = 0.01  # relative: a larger estimated error is warned of
JUMP_BEGINS, JUMP_ENDS = 0.1, 0.9  # parts of the way of a snap, between which it jumps


def _numbers_in(rows: Sequence[Row], column: str) -> NDArray[np.float64]:
    """Return the numbers (n,) of a column of rows."""
    return np.array([float(row[column]) for row in rows])


def snaps(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the motions of a path from an instability to rest (`then: snap`).

    They begin at a fold; or in the row behind a bifurcation, in the model that has its mode.

    Returns
    -------
    list of dict
        For each snap: `point` and `rest`, the numbers of the rows where it begins and ends; times
        in the unit of the column time; `overshoot` and `dissipated`. `time` is from the release
        until half of the way of the deflection. `departure` is until a tenth of the way; it grows
        without limit as the push there vanishes. `jump` is from there until nine tenths.
        `overshoot` is the largest deflection beyond the last, over the way. `dissipated` is the
        energy over E h R^2.
    """
    motions = []
    for i, start in enumerate(rows[:-1]):
        is_behind_bifurcation = i > 0 and rows[i - 1]["label"] == "bifurcation"
        is_released = start["amplitude"] != "time" and rows[i + 1]["amplitude"] == "time"
        if not is_released or not (start["label"] == "fold" or is_behind_bifurcation):
            continue
        # rows of the motion, from the instability to the equilibrium at rest
        moving = [start, *(row for row in rows[i + 1 :] if row["step"] == start["step"])]
        if len(moving) == 1 or moving[-1]["label"] != "target":
            continue  # the motion is that of the next step, or has not come to rest
        t, w, dissipated = (_numbers_in(moving, key) for key in ("time", "w_over_h", "dissipated"))
        # times since the release at three parts of the way of the deflection. The last two rows are
        # of one time: the end of the motion, and the equilibrium at rest, which is left out.
        part_of_way = (w - w[0]) / (w[-1] - w[0])
        departure, half_time, end_of_jump = (
            _first_at(fraction, t[:-1], part_of_way[:-1]) - t[0]
            for fraction in (JUMP_BEGINS, 0.5, JUMP_ENDS)
        )
        rows_of_ends = {"point": start["point"], "rest": moving[-1]["point"]}
        times = {"time": half_time, "departure": departure, "jump": end_of_jump - departure}
        motions.append(
            {
                **rows_of_ends,
                **times,
                "overshoot": float(part_of_way.max() - 1),
                "dissipated": float(dissipated[-1] - dissipated[0]),
            }
        )
    return motions


def _in_milliseconds(snap: dict[str, Any], sizes: Sizes) -> dict[str, float]:
    """Return the times of a snap in milliseconds, by key of summary.json, for a case with units."""
    return {
        f"snap_{key}_ms": 1e3 * snap[key] * sizes.size("time")
        for key in ("time", "departure", "jump")
    }


def _first_at(fraction: float, times: Array, part_of_way: Array) -> float:
    """Return the first time at which a fraction of a way is done, by cubic interpolation.

    It is the last time if the fraction is not done by then.

    Parameters
    ----------
    times, part_of_way
        Times (n,), increasing, and the part of the way (n,) that is done at each.
    """
    # a shell that creeps is put to rest before it has done the whole way
    if not (part_of_way >= fraction).any():
        return float(times[-1])
    # the zero in the interval that ends at the first point beyond the fraction
    index = int(np.argmax(part_of_way >= fraction))
    difference = scipy.interpolate.CubicSpline(times, part_of_way - fraction)
    return float(
        scipy.optimize.brentq(difference, times[index - 1], times[index], xtol=1e-12 * times[index])
    )


@dataclass(repr=False)
class Result:
    """The result of a run.

    Attributes
    ----------
    scene
        The scene at the beginning of the path.
    last
        Displacement and amplitudes at the last point of the path.
    rows
        One mapping per accepted point, with the columns of path.csv.
    singular
        Displacement and amplitudes at the located instabilities, by row number.
    stopped
        Why the run ended before its target; None if it reached it.
    remarks
        What the result must not be read without: why the path stopped beyond its first instability
        with `until: limit`, or that a snap starts from a shell that has buckled before.
    replayed
        Number of solves taken from a checkpoint.
    sensitivities
        Sensitivities of the amplitude at the final fold, if the case requests them; see
        `simulate.sensitivity`.
    output
        Stopwatch of fields and pictures.
    adapted
        The mesh and its error estimate, if the case has a tolerance.
    branch_error
        The estimated relative error at the end of a branch in a larger model, if that has its own
        mesh.
    path_history
        The records that `value` is taken from.
    barrier
        The energy barrier over E h R^2 of a last step with `until: zero`; None without.
    end
        Number of the row of `last`.
    found
        The states of the solutions that searches have found, by row number.
    states_for_frequencies
        States at the points whose frequencies are requested, by row number; not of the start and
        the end.
    frequencies
        The natural modes, by row number; their `eigenvalue` is omega^2 rho R^2/E.
    contact_changes
        With bodies, the changes of omega^2 of these modes by stiffer bodies, by row number; see
        `modes.contact_changes`.
    gradients
        Gradients by result, as in summary.json.
    mode_places
        Row number of an instability -> the undeformed place where its mode moves most along the
        normal, in the shell's length; on rank 0. Empty for a meridian, whose modes have rings.
    last_record
        The record of `last`; None before the first.
    scenes_of_rows
        Row number -> scene, of the rows whose scene is not `scene`, as on a branch that its model
        excludes.
    fine_scenes
        The scenes by which errors are estimated, as long as they are needed.
    """

    scene: Scene
    last: State
    rows: list[Row] = field(default_factory=list)
    singular: dict[int, State] = field(default_factory=dict)
    stopped: str | None = None
    remarks: list[str] = field(default_factory=list)
    replayed: int = 0
    sensitivities: dict[str, float] = field(default_factory=dict)
    output: Stopwatch = field(default_factory=Stopwatch)
    adapted: "Adapted | None" = None
    branch_error: float | None = None
    path_history: History = field(default_factory=History)
    barrier: float | None = None
    end: int = 0
    found: dict[int, State] = field(default_factory=dict)
    states_for_frequencies: dict[int, State] = field(default_factory=dict)
    frequencies: dict[int, list[ShellMode]] = field(default_factory=dict)
    contact_changes: dict[int, list[float]] = field(default_factory=dict)
    gradients: dict[str, dict[str, Any]] = field(default_factory=dict)
    mode_places: dict[int, list[float]] = field(default_factory=dict)
    last_record: Record | None = None
    scenes_of_rows: dict[int, Scene] = field(default_factory=dict)
    fine_scenes: FineScenes = field(default_factory=FineScenes)

    def __repr__(self) -> str:
        """Return the result in a few lines: how it ended, and its instabilities."""
        lines = [f"Result of {self.scene.problem.document.name}: {len(self.rows)} points"]
        if self.stopped:
            lines.append(f"  stopped: {self.stopped}")
        lines += [f"  {record!r}" for record in self.instabilities]
        if self.last_record:
            lines.append(f"  end: {self.last_record!r}")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        """Return the columns of the path as a table of a notebook."""
        return self.history._repr_html_()

    @cached_property
    def error_estimates(self) -> ErrorEstimates:
        """Estimated errors of the results, and why others have none.

        The first access is collective, and solves with one degree more on the same mesh.
        """
        has_stopped = bool(self.stopped)
        estimates = estimate_errors(
            self.scene, self.path_history, self.fine_scenes, has_stopped=has_stopped
        )
        if self.scene.problem.frequencies is None:  # nothing else is compared
            self.fine_scenes.clear()
        errors, with_units = estimates.errors, in_units(self)
        # the same errors of results in units
        for name, number in self._main_results.items():
            for key in IN_UNITS[name] & with_units.keys():
                if number and name in errors:
                    errors[key] = errors[name] * abs(with_units[key] / number)
        return estimates

    @property
    def _main_results(self) -> dict[str, float | None]:
        """Name of a result that has a key of its own in summary.json -> its value."""
        return {
            "knockdown": self.knockdown,
            "critical_field": self.critical_field,
            "barrier": self.barrier,
        }

    @property
    def errors(self) -> dict[str, float]:
        """Name of a result -> its estimated absolute error; the first access is collective."""
        return self.error_estimates.errors

    @property
    def large_errors(self) -> dict[str, float]:
        """Result -> its estimated relative error, where this is above `LARGE_ERROR`; collective.

        At the end of the path the results are the column of the load and that of its conjugate. An
        error there is over the largest value on the path.
        """
        results = self._main_results
        if self.limit_points and not (self.knockdown or self.critical_field):
            results["limit_load"] = self.limit_points[0]["value"]
        if self.path_history.end and (name := self.path_history.end.amplitude):
            loaded = amplitude(name)
            for column in {loaded.column, loaded.conjugate} & self.rows[0].keys():
                results[f"{column}@end"] = max(abs(float(row[column])) for row in self.rows)
        relative_errors = {
            name: self.errors[name] / abs(value)
            for name, value in results.items()
            if value and name in self.errors
        }
        return {name: error for name, error in relative_errors.items() if error > LARGE_ERROR}

    def scene_of(self, row: int) -> Scene:
        """Return the scene (model and solver) of the row with a number."""
        return self.scenes_of_rows.get(row, self.scene)

    @property
    def is_refused(self) -> bool:
        """Whether the run stopped at the undeformed shell, which is unstable: it has no modes."""
        return bool(self.rows) and int(self.rows[0]["negative_pivots"]) > 0

    @property
    def history(self) -> Table:
        """Columns of path.csv; `history.to_pandas()` is a frame of pandas."""
        return table(self.rows, self.scene.extra_columns)

    @property
    def record(self) -> Record:
        """Last point of the path, as `follow` gives it: for `picture`, `surface`, `gradient`, and
        its `u`.
        """
        assert self.last_record, "a run has a first point"
        return self.last_record

    @property
    def instabilities(self) -> list[Record]:
        """Located instabilities on the path, as `follow` gives them."""
        return list(self.path_history.located)

    @property
    def limit_points(self) -> list[dict[str, Any]]:
        """Located instabilities, as entries of summary.json.

        Each has its load, displacement and kind, and the place where its mode is largest if known.
        """
        return [
            self._limit_point(number, row)
            for number, row in enumerate(self.rows)
            if row["label"] in LOCATED
        ]

    def _limit_point(self, number: int, row: Row) -> dict[str, Any]:
        """Return the located instability at a row, which has this number among the rows."""
        return {
            **self.scene.sizes.values({key: row[key] for key in _with_units(row)}),
            "amplitude": row["amplitude"],
            "value": row[amplitude(str(row["amplitude"])).column],
            "p_over_pc": row["p_over_pc"],
            "w_pole_over_h": row["w_pole_over_h"],
            "kind": row["label"],
            "mode": row["mode"],
            "branch": row["branch"],
            "load_error": row["load_error"],
            **self._mode_at(number),
        }

    def _mode_at(self, number: int) -> dict[str, list[float]]:
        """Return the entries of summary.json about where the mode of an instability is largest.

        `number` is the row of the instability. The place is over R or in metres (`mode_at`), and
        also in the unit of the report. Empty if the place is not known.
        """
        if number not in self.mode_places:
            return {}
        place, shell = self.mode_places[number], self.scene.problem.context.shell
        in_report_units = place_in_units(place, shell.geometry, in_metres=shell.with_units)
        return {
            "mode_at": place,
            **{f"mode_at_{unit}": values for unit, values in in_report_units.items() if unit},
        }

    @property
    def knockdown(self) -> float | None:
        """k_d: p/p_c at the first instability under pressure.

        None if there is none, or at held volume.
        """
        steps = self.scene.problem.programme
        # steps that hold the conjugate of their own amplitude: of a pressure, the volume
        at_held_volume = {step.number for step in steps if step.name in step.load.hold}
        for value, row in self._critical_loads("knockdown"):
            if row.get("step") not in at_held_volume:
                return value
        return None

    def _critical_loads(self, name: str) -> list[tuple[float, Row]]:
        """Return the loads at instabilities of the path itself, each with its row.

        `name` is that of such a load as a number of a run, as `Amplitude.critical_names` has it.
        """
        rows = [row for row in self.rows if row["label"] in LOCATED and not row["branch"]]
        loads = [amplitude(str(row["amplitude"])) for row in rows]
        return [
            (float(row[load.column]), row)
            for load, row in zip(loads, rows, strict=True)
            if name in load.critical_names
        ]

    @property
    def critical_field(self) -> float | None:
        """λ_m at the first instability under the field; None if there is none."""
        values = (value for value, _ in self._critical_loads("critical_field"))
        return next(values, None)

    @property
    def value(self) -> float | None:
        """Scalar result that mesh.tolerance refers to; None if the run has none."""
        try:
            return self.path_history.ending(self.scene, self.stopped).value
        except NoResult:
            return None


def summary(result: Result, estimates: ErrorEstimates, total_s: float) -> dict[str, Any]:
    """Return the content of summary.json of a run; collective.

    Parameters
    ----------
    estimates
        Estimated errors of the results.
    total_s
        Time of the run in seconds.
    """
    scene = result.scene
    # the problem as the case has it, before its mesh was adapted
    requested_problem = result.adapted.requested if result.adapted else scene.problem
    model, newton = scene.model, scene.newton
    # entries that only some runs have: of the first snap, and of mesh.tolerance
    snaps_of_run = snaps(result.rows)
    snap_times, tolerance = dict[str, float](), dict[str, Any]()
    if snaps_of_run and scene.sizes.unit("time"):
        snap_times = _in_milliseconds(snaps_of_run[0], scene.sizes)
    if result.adapted:
        tolerance = {"tolerance": result.adapted.account(result.value, result.branch_error)}
    # the magnetic moment at the end
    observed = moment_in_summary(result.scene_of(result.end).view, result.last)
    excluded_pivots = (int(row["excluded_pivots"]) for row in result.rows)
    return {
        "case": requested_problem.document.data,
        CASE_FILE: requested_problem.document.name,
        **requested_problem.document.outside,
        "sources": code_version(),
        "dimensionless": _dimensionless_numbers(scene),
        "dimensions": _dimensions(scene.problem.context.shell),
        "in_units": in_units(result),
        "model": _model_entry(scene),
        "stopped": result.stopped,
        "remarks": result.remarks,
        "limit_points": result.limit_points,
        "sensitivities": result.sensitivities,
        "gradients": result.gradients,
        "knockdown": result.knockdown,
        "critical_field": result.critical_field,
        "barrier": result.barrier,
        "errors": estimates.errors,
        "errors_not_estimated": estimates.reasons,
        "snaps": snaps_of_run,
        **snap_times,
        **observed,
        "frequencies": [_frequencies_of(result, number) for number in result.frequencies],
        "solutions": solutions(result),
        "most_excluded_pivots": max(excluded_pivots, default=0),
        "points": len(result.rows),
        "mesh": {"cells": scene.cells, "dofs": model.system.dofs, "degree": model.degree},
        **tolerance,
        "timing": _timing(result, total_s),
        "replayed": result.replayed,
        "factorisations": newton.factorisation.count,
        "iterations": newton.iterations,
        "ranks": scene.comm.size,
        "blas": fast_blas() or "reference",
        "versions": versions(),
    }


def _dimensionless_numbers(scene: Scene) -> dict[str, Any]:
    """Return the dimensionless numbers of a scene's shell, as an entry of summary.json."""
    material = scene.problem.material
    R_over_h = 1 / material.h
    return {
        "radius_to_thickness": R_over_h,
        "poisson_ratio": material.nu,
        **dimensionless_groups(scene.problem.context, R_over_h),
        "pc_over_E": material.classical_pressure,
        "energy_unit": "E h R^2",
    }


def _model_entry(scene: Scene) -> dict[str, Any]:
    """Return what the model includes and leaves out, and its kernels, as an entry of summary.json.

    `not_shown` are details of formulas that its cells miss, if there are any.
    """
    model = scene.model
    return {
        "included": scene.problem.included,
        "left_out": scene.left_out,
        **({"not_shown": scene.unresolved} if scene.unresolved else {}),
        "kernels": model.kernels.names,
        "forms": len(model.kernels.names),
        "penalty": model.sigma,
    }


def _timing(result: Result, total_s: float) -> dict[str, float]:
    """Return the times of the parts of a run, and of all of it, as an entry of summary.json."""
    model, factorisation = result.scene.model, result.scene.newton.factorisation
    return {
        "jit_s": model.kernels.seconds,
        "setup_s": result.scene.setup_s,
        "assembly_s": model.system.assembly.seconds,
        "factor_s": factorisation.stopwatch.seconds,
        "output_s": result.output.seconds,
        "solve_s": factorisation.solving.seconds,
        "total_s": total_s,
    }


def _frequencies_of(result: Result, number: int) -> dict[str, Any]:
    """Return the natural frequencies at the point of a row, as an entry of summary.json.

    `omega2` is omega^2 rho R^2/E of each mode, `hertz` its frequency in a case with units of time.
    """
    modes, time_unit = result.frequencies[number], result.scene.problem.time_unit
    entry: dict[str, Any] = {
        "point": number,
        "omega2": [mode.eigenvalue for mode in modes],
    }
    if time_unit:
        entry["hertz"] = [hertz(mode.eigenvalue, time_unit) for mode in modes]
    if number in result.contact_changes:
        entry["contact_change"] = result.contact_changes[number]
    return entry


def solutions(result: Result) -> list[dict[str, Any]]:
    """Return the solutions that searches have found, as in summary.json. Collective.

    Each entry has numbers of the solution's row. Its `residual` is the norm of the residual over
    the sum of the norms of the forces of all terms.
    """
    entries = []
    for number, state in result.found.items():
        row, system = result.rows[number], result.scene_of(number).model.system
        # norms of the residual, and of the forces of each term
        residual = system.residual(state.u, state.mu)
        forces = (
            factor_of(term.amplitude, state.mu) * system.forces(state.u, state.mu, term.name)
            for term in system.terms
        )
        norms = [np.sqrt(dot(system.comm, vector, vector)) for vector in (residual, *forces)]
        columns_with_units = (  # those that may also be there in units
            "p_over_pc",
            "w_over_h",
            "w_pole_over_h",
            "volume_change",
            "energy",
            "negative_pivots",
        )
        entries.append(
            {
                "point": number,
                "step": row["step"],
                "solution": row["branch"],
                "stable": not int(row["negative_pivots"]) + int(row["excluded_pivots"]),
                **{
                    key: row[key]
                    for key in (*columns_with_units, "excluded_pivots", "error_over_h")
                },
                **result.scene.sizes.values({key: row[key] for key in columns_with_units}),
                "residual": norms[0] / sum(norms[1:]),
            }
        )
    return entries


def _with_units(row: Row) -> set[str]:
    """Return the columns of a limit point's row that may also be there in units."""
    return {amplitude(str(row["amplitude"])).column, "p_over_pc", "w_pole_over_h"}


def in_units(result: Result) -> dict[str, float]:
    """Return numbers of a run by names that end in their units; empty without units.

    The keys are those of summary.json, such as "buckling_pressure_Pa" or "barrier_mJ".
    """
    unit_sizes, shell = result.scene.sizes.by_unit, result.scene.problem.context.shell
    numbers = {}
    if "p_c" in unit_sizes:
        numbers["classical_pressure_Pa"] = unit_sizes["p_c"]
        if result.knockdown is not None:
            numbers["buckling_pressure_Pa"] = result.knockdown * unit_sizes["p_c"]
    if "λ_m" in unit_sizes and result.critical_field is not None:
        ending = "percent" if result.scene.sizes.field == "%" else "mT"
        numbers[f"critical_field_{ending}"] = result.critical_field * unit_sizes["λ_m"]
    if "2πD/R" in unit_sizes:
        numbers["unit_force_N"] = unit_sizes["2πD/R"]
        # D = F R/(2π), with the unit F of forces
        numbers["bending_stiffness_N_m"] = unit_sizes["2πD/R"] * shell.reference / (2 * np.pi)
        numbers["unit_energy_mJ"] = unit_sizes["E h R²"]
        if result.barrier is not None:
            numbers["barrier_mJ"] = result.barrier * unit_sizes["E h R²"]
    return numbers


def _dimensions(shell: ShellSection | Surface) -> dict[str, Any]:
    """Return the dimensions of the shell that the case gives, in SI or in the case's own units.

    `units` says which; lengths in SI stand in mm too. Keys that the case does not give are None.
    """
    if isinstance(shell, ShellSection):  # its lengths always have units
        lengths, is_in_si = {"radius": shell.radius, "thickness": shell.thickness}, True
    else:
        lengths, is_in_si = (
            {"radius": shell.reference, "thickness": shell.thickness},
            shell.with_units,
        )
    in_mm = {f"{key}_mm": 1e3 * x for key, x in lengths.items() if is_in_si and x is not None}
    return {
        **lengths,
        **in_mm,
        "youngs_modulus": shell.youngs_modulus,
        "units": "SI" if is_in_si else "the case's own",
    }
