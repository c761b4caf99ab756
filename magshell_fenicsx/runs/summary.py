"""The result of a run, and summary.json; what the snaps of a run amount to."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.assembly.terms import factor_of
from magshell_fenicsx.continuation.factor import Stopwatch
from magshell_fenicsx.continuation.system import State, dot
from magshell_fenicsx.output.fields.modes import hertz
from magshell_fenicsx.output.report.verdict import place_in_units
from magshell_fenicsx.output.store.checkpoint import FILE
from magshell_fenicsx.output.store.table import LOCATED, Row
from magshell_fenicsx.parts.registered import SEEN
from magshell_fenicsx.platform.environment import code_version, fast_blas, versions
from magshell_fenicsx.quantities.registry import Sizes, amplitude
from magshell_fenicsx.runs.rows import Table, table
from magshell_fenicsx.shape.sections import ShellSection, Surface
from magshell_fenicsx.shells.modes import ShellMode
from magshell_fenicsx.simulate.adapt.ending import History, NoResult
from magshell_fenicsx.simulate.record import Record
from magshell_fenicsx.simulate.scene import Scene

if TYPE_CHECKING:
    from magshell_fenicsx.simulate.adapt.choice import Adapted

Array = NDArray[np.float64]

JUMP_BEGINS, JUMP_ENDS = 0.1, 0.9  # of the way of a snap: between them it jumps


def snaps(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return the motions that begin at a fold and end at rest (`then: snap`).

    `time` is from the release until the deflection is half way, in the unit of the column time;
    `departure` until it has done a tenth of the way, which grows without limit as the push at the
    fold vanishes; `jump` from there until it has done nine tenths. `overshoot` is the largest
    deflection beyond the last, over the way; `dissipated` the energy over E h R^2.
    """
    at_rest = []
    for i, fold in ((i, row) for i, row in enumerate(rows[:-1]) if row["label"] == "fold"):
        if rows[i + 1]["amplitude"] != "time":
            continue
        moving = [fold, *(row for row in rows[i + 1 :] if row["step"] == fold["step"])]
        if moving[-1]["label"] != "target":
            continue
        t, w, lost = (
            np.array([float(row[key]) for row in moving])
            for key in ("time", "w_over_h", "dissipated")
        )
        way = (w - w[0]) / (w[-1] - w[0])
        # the last two rows are of one time
        begun, half, done = (
            _first_at(part, t[:-1], way[:-1]) - t[0] for part in (JUMP_BEGINS, 0.5, JUMP_ENDS)
        )
        ends = {"point": fold["point"], "rest": moving[-1]["point"]}
        times = {"time": half, "departure": begun, "jump": done - begun}
        at_rest.append(
            {
                **ends,
                **times,
                "overshoot": float(way.max() - 1),
                "dissipated": float(lost[-1] - lost[0]),
            }
        )
    return at_rest


def _in_milliseconds(snap: dict[str, Any], sizes: Sizes) -> dict[str, float]:
    """Return the times of a snap of a case with units."""
    return {
        f"snap_{key}_ms": 1e3 * snap[key] * sizes.size("time")
        for key in ("time", "departure", "jump")
    }


def _first_at(part: float, times: Array, way: Array) -> float:
    """Return the first time at which a part of a way is done, by cubic interpolation; the last if
    it is not by then."""
    if not (way >= part).any():  # a creeping shell is put to rest from afar
        return float(times[-1])
    at = int(np.argmax(way >= part))
    passed = scipy.interpolate.CubicSpline(times, way - part)
    return float(scipy.optimize.brentq(passed, times[at - 1], times[at], xtol=1e-12 * times[at]))


@dataclass
class Result:
    """The result of a run.

    Attributes
    ----------
    rows
        One mapping per accepted point, with the columns of path.csv.
    last
        Displacement and amplitudes at the last point of the path.
    singular
        The same at the located instabilities, by row number.
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
    adapted
        The mesh and its error estimate, if the case has a tolerance.
    branch_error
        The estimated relative error at the end of a branch in a larger model, if that has its own
        mesh.
    walked
        The records that `value` is taken from.
    end
        Number of the row of `last`.
    kept
        States at the points whose frequencies are requested, by row number; not of the start and
        the end.
    frequencies
        The natural modes, by row number; their `eigenvalue` is omega^2 rho R^2/E.
    contact_changes
        Beside bodies how much their omega^2 depend on the bodies' stiffness; see
        `frequencies.contact_changes`.
    found
        The states of the solutions that searches have found, by row number.
    barrier
        The energy barrier over E h R^2 of a last step with `until: zero`; None without.
    gradients
        By result, as in summary.json.
    largest
        By row number of an instability the undeformed place where its mode moves most along the
        normal, in the shell's length; on rank 0, and not of a meridian, whose modes have rings.
    latest
        The record of `last`; None before the first.
    elsewhere
        The scenes of the rows that have another than `scene`, as of a branch that its model
        excludes.
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
    walked: History = field(default_factory=History)
    barrier: float | None = None
    end: int = 0
    found: dict[int, State] = field(default_factory=dict)
    kept: dict[int, State] = field(default_factory=dict)
    frequencies: dict[int, list[ShellMode]] = field(default_factory=dict)
    contact_changes: dict[int, list[float]] = field(default_factory=dict)
    gradients: dict[str, dict[str, Any]] = field(default_factory=dict)
    largest: dict[int, list[float]] = field(default_factory=dict)
    latest: Record | None = None
    elsewhere: dict[int, Scene] = field(default_factory=dict)

    def scene_of(self, row: int) -> Scene:
        """The scene of a row."""
        return self.elsewhere.get(row, self.scene)

    @property
    def refused(self) -> bool:
        """Whether the run stopped at the undeformed shell, which is unstable: it has no modes."""
        return bool(self.rows) and int(self.rows[0]["negative_pivots"]) > 0

    @property
    def history(self) -> Table:
        """The columns of path.csv; `history.to_pandas()` is a frame of pandas."""
        return table(self.rows, self.scene.extra_columns)

    @property
    def record(self) -> Record:
        """The last point of the path, as `follow` gives it: for `picture`, `surface`, `gradient`,
        and for its `u`.
        """
        assert self.latest, "a run has a first point"
        return self.latest

    @property
    def instabilities(self) -> list[Record]:
        """The same of the located instabilities on the path."""
        return list(self.walked.located)

    @property
    def limit_points(self) -> list[dict[str, Any]]:
        """The located instabilities."""
        return [
            {
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
            for number, row in enumerate(self.rows)
            if row["label"] in LOCATED
        ]

    def _mode_at(self, number: int) -> dict[str, list[float]]:
        """Where a mode is largest, over R or in m, and in the unit of the report."""
        if number not in self.largest:
            return {}
        place, shell = self.largest[number], self.scene.problem.context.shell
        shown = place_in_units(place, shell.geometry, in_metres=shell.with_units)
        return {
            "mode_at": place,
            **{f"mode_at_{unit}": numbers for unit, numbers in shown.items() if unit},
        }

    @property
    def knockdown(self) -> float | None:
        """k_d: p/p_c at the first instability under pressure; None if there is none, or at held
        volume.
        """
        at_volume = {
            step.number for step in self.scene.problem.programme if step.name in step.load.hold
        }
        points = (
            row for row in self.rows if row["label"] in LOCATED and row["amplitude"] == "pressure"
        )
        return next(
            (
                float(p["p_over_pc"])
                for p in points
                if not p["branch"] and p.get("step") not in at_volume
            ),
            None,
        )

    @property
    def critical_field(self) -> float | None:
        """λ_m at the first instability under the field; None if there is none."""
        points = (
            row for row in self.rows if row["label"] in LOCATED and row["amplitude"] == "lambda_m"
        )
        return next((float(row["lambda_m"]) for row in points if not row["branch"]), None)

    @property
    def value(self) -> float | None:
        """The scalar result that mesh.tolerance refers to; None if the run has none."""
        try:
            return self.walked.ending(self.scene, self.stopped).value
        except NoResult:
            return None


def summary(result: Result, total_s: float) -> dict[str, Any]:
    """The content of summary.json."""
    scene, asked = result.scene, result.adapted.asked if result.adapted else result.scene.problem
    material, model, newton = scene.problem.material, scene.model, scene.newton
    R_over_h, time_unit = 1 / material.h, scene.problem.time_unit
    snapped, sizes = snaps(result.rows), scene.sizes
    return {
        "case": asked.document.data,
        FILE: asked.document.name,
        **asked.document.outside,
        "sources": code_version(),
        "dimensionless": {
            "radius_to_thickness": R_over_h,
            "poisson_ratio": material.nu,
            "lambda_m": scene.problem.lambda_m,
            "Lambda_m": scene.problem.lambda_m * R_over_h,
            "pc_over_E": material.classical_pressure,
            "energy_unit": "E h R^2",
        },
        "dimensions": _dimensions(scene.problem.context.shell),
        "in_units": in_units(result),
        "model": {
            "included": scene.problem.included,
            "left_out": scene.left_out,
            **({"not_shown": scene.unshown} if scene.unshown else {}),
            "kernels": model.kernels.names,
            "forms": len(model.kernels.names),
            "penalty": model.sigma,
        },
        "stopped": result.stopped,
        "remarks": result.remarks,
        "limit_points": result.limit_points,
        "sensitivities": result.sensitivities,
        "gradients": result.gradients,
        "knockdown": result.knockdown,
        "critical_field": result.critical_field,
        "barrier": result.barrier,
        "snaps": snapped,
        **(_in_milliseconds(snapped[0], sizes) if snapped and sizes.unit("time") else {}),
        **{
            key: said
            for room in SEEN
            for key, said in room.summary(result.scene_of(result.end).sight, result.last).items()
        },
        "frequencies": [
            {
                "point": number,
                "omega2": [mode.eigenvalue for mode in modes],
                **(
                    {"hertz": [hertz(mode.eigenvalue, time_unit) for mode in modes]}
                    if time_unit
                    else {}
                ),
                **(
                    {"contact_change": result.contact_changes[number]}
                    if number in result.contact_changes
                    else {}
                ),
            }
            for number, modes in result.frequencies.items()
        ],
        "solutions": solutions(result),
        "most_excluded_pivots": max(
            (int(row["excluded_pivots"]) for row in result.rows), default=0
        ),
        "points": len(result.rows),
        "mesh": {"cells": scene.cells, "dofs": model.system.dofs, "degree": model.degree},
        **(
            {"tolerance": result.adapted.account(result.value, result.branch_error)}
            if result.adapted
            else {}
        ),
        "timing": {
            "jit_s": model.kernels.seconds,
            "setup_s": scene.setup_s,
            "assembly_s": model.system.assembly.seconds,
            "factor_s": newton.factorisation.stopwatch.seconds,
            "output_s": result.output.seconds,
            "solve_s": newton.factorisation.solving.seconds,
            "total_s": total_s,
        },
        "replayed": result.replayed,
        "factorisations": newton.factorisation.count,
        "iterations": newton.iterations,
        "ranks": scene.comm.size,
        "blas": fast_blas() or "reference",
        "versions": versions(),
    }


def solutions(result: Result) -> list[dict[str, Any]]:
    """What searches have found; the residual is over the sum of the sizes of all terms' forces.

    Collective.
    """
    entries = []
    for number, state in result.found.items():
        row, system = result.rows[number], result.scene_of(number).model.system
        residual = system.residual(state.u, state.mu)
        forces = (
            factor_of(t.amplitude, state.mu) * system.forces(state.u, state.mu, t.name)
            for t in system.terms
        )
        sizes = [np.sqrt(dot(system.comm, v, v)) for v in (residual, *forces)]
        keys = (
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
                **{key: row[key] for key in (*keys, "excluded_pivots", "error_over_h")},
                **result.scene.sizes.values({key: row[key] for key in keys}),
                "residual": sizes[0] / sum(sizes[1:]),
            }
        )
    return entries


def _with_units(row: Row) -> set[str]:
    """The columns of a limit point that may have units."""
    return {amplitude(str(row["amplitude"])).column, "p_over_pc", "w_pole_over_h"}


def in_units(result: Result) -> dict[str, float]:
    """The numbers of a case with units, with these in their names; none of a case without."""
    of, shell = result.scene.sizes.of, result.scene.problem.context.shell
    sizes = {}
    if "p_c" in of:
        sizes["classical_pressure_Pa"] = of["p_c"]
        if result.knockdown is not None:
            sizes["buckling_pressure_Pa"] = result.knockdown * of["p_c"]
    if "λ_m" in of and result.critical_field is not None:
        ending = "percent" if result.scene.sizes.field == "%" else "mT"
        sizes[f"critical_field_{ending}"] = result.critical_field * of["λ_m"]
    if "2πD/R" in of:
        sizes["unit_force_N"] = of["2πD/R"]
        sizes["bending_stiffness_N_m"] = of["2πD/R"] * shell.reference / (2 * np.pi)
        sizes["unit_energy_mJ"] = of["E h R²"]
        if result.barrier is not None:
            sizes["barrier_mJ"] = result.barrier * of["E h R²"]
    return sizes


def _dimensions(shell: ShellSection | Surface) -> dict[str, Any]:
    """The dimensions of the shell that the case gives, in SI or in the case's own units."""
    if isinstance(shell, ShellSection):
        lengths, in_si = {"radius": shell.radius, "thickness": shell.thickness}, True
    else:
        lengths, in_si = {"radius": shell.reference, "thickness": shell.thickness}, shell.with_units
    return {
        **lengths,
        "youngs_modulus": shell.youngs_modulus,
        "units": "SI" if in_si else "the case's own",
    }
