"""Observables of a magnetised shell: sensors, induced polarisation, the field and the moment.

The solver takes long to import, and a case that is only checked needs no more than the names: its
imports are late.

Observables are the columns and maps that one part of a case reads from a state: a displacement u
with amplitudes mu, the load parameters by name. `columns` gives their names, `observe` their values
at a state, `refuse_unfit` checks them against the mesh. A model view is a model with the units and
the frame in which it is reported; `rotation(view.azimuth)` turns a vector of the model's frame,
written as a row, into the frame of the case. An evaluation, `system.at_state(state)`, calls a
function at that state (`evaluate`) or integrates a form there. Lengths are over R, fields over |Br|
or, of a shell that is soft alone, over √(μ0 E).
"""

from collections.abc import Sequence
from math import copysign
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.ability import Account, Context
from magshell_fenicsx.parts.magnetism.fields import FIELD, MU_0, MagneticSection, strength
from magshell_fenicsx.parts.magnetism.sensors import Sensor
from magshell_fenicsx.parts.observables import ModelView, Observables, Slope
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import register

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.mesh.patch import PatchMesh
    from magshell_fenicsx.parts.loads import Loads

Array = NDArray[np.float64]
INDUCED = tuple(f"induced_{axis}" for axis in "xyz")
register(
    tuple(
        Quantity(
            name,
            f"induced polarisation along e{number}",
            "Mean over the soft shell of the polarisation μ0 M that the field induces, along "
            f"e{number}; in T, without units over that of λ_m = 1.",
            "load",
        )
        for number, name in enumerate(INDUCED, 1)
    )
)


class FieldObservables(Observables):
    """Observables of the applied field and of the magnetic moment.

    Strength and angle of the field are columns of every run; the moment is in summary.json.
    """

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        """Return no columns: strength and angle of the field are columns of every run."""
        return ()

    def account(self, context: Context, loads: "Loads") -> Account:
        """Return the lines of `magshell check` on the energy of the field and on its sources.

        Lines in `included` tell what is in the model, those in `left_out` what is not, and why.
        """
        magnetic, field, words = context.section_of(MagneticSection), loads.magnetic, list[str]()
        if loads.interaction:
            words = [
                "magnetised parts in each other's field, |Br|²/(mu_0 E) = "
                f"{loads.interaction.strength:g}"
            ]
        if magnetic is None or field is None:
            reason = "lambda_m is zero" if magnetic else "no magnetic section"
            return Account(included=words, left_out=[f"magnetic energy: {reason}"])
        law = "" if field.law == "deformation" else ", remanence that turns and does not stretch"
        if field.soft:
            remanence_text = "without remanence" if field.soft.alone else "beside the remanence"
            susceptibility = magnetic.susceptibility
            if isinstance(susceptibility, int | float):
                susceptibility = f"{susceptibility:g}"
            law += (
                f", soft magnetism of a sheet with the susceptibility {susceptibility} "
                f"{remanence_text}"
            )
            law += f", that saturates at {magnetic.saturation:g} T" if magnetic.saturation else ""
        sources = enumerate(magnetic.applied.sources or [])
        words += [f"source {source.name or i}: {source.words()}" for i, source in sources]
        energy_text = f"magnetic energy ({field.energy}){law}, lambda_m = {strength(context):g}"
        return Account(included=[energy_text, *words])

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return strength and angle of the applied field at a state, column -> value."""
        from magshell_fenicsx.parts.magnetism.direction import (  # the solver takes long to import
            field_angle,
            field_size,
        )

        sense = copysign(1.0, view.strengths.get(FIELD.name, 1.0))
        angle = field_angle(state.mu, view.loads.magnetic, sense)
        return {FIELD.column: field_size(state.mu, sense), "field_angle": angle}


def moment_in_summary(view: ModelView, state: "State") -> dict[str, Any]:
    """Return the magnetic moment at the end of a path, in the frame of the case; collective.

    It is in A m² with units, else over |Br| R³/μ0, or √(E/μ0) R³ of a shell that is soft alone.
    The result is {"magnetic_moment": {"value", "unit"}}, or empty if nothing is magnetised.
    """
    from magshell_fenicsx.parts.magnetism.self_field import magnetic_moment, magnetisation_of

    magnetisation = magnetisation_of(view.loads)
    if magnetisation is None or magnetisation.absent:
        return {}
    at_state = view.model.system.at_state(state)
    moment = at_state.evaluate(lambda: magnetic_moment(view, state.mu)) @ rotation(view.azimuth)
    moment_unit = (
        magnetisation.tesla * magnetisation.metres**3 / MU_0 if magnetisation.metres else 1.0
    )
    unit = "√(E/μ0) R³" if magnetisation.soft and magnetisation.soft.alone else "|Br| R³/μ0"
    return {
        "magnetic_moment": {
            "value": (moment_unit * moment).tolist(),
            "unit": "A m²" if magnetisation.metres else unit,
        }
    }


class SoftObservables(Observables):
    """Observables of a soft material: the mean polarisation that the field induces."""

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        """Refuse patches of a susceptibility that the surface does not have.

        Raises
        ------
        MeshError
            With the name of the patch.
        """
        from magshell_fenicsx.models.shell.spatial_fields import by_patch

        soft_magnet = loads.magnetic.soft if loads.magnetic else None
        if soft_magnet and soft_magnet.patches:
            # called for its check alone
            by_patch(
                soft_magnet.patches, surface.patches, len(surface.cells), "magnetic.susceptibility"
            )

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        return INDUCED if loads.magnetic and loads.magnetic.soft else ()

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return the mean induced polarisation along e1, e2 and e3 of the case; collective.

        Empty without a soft material.
        """
        field = view.loads.magnetic
        if field is None or field.soft is None:
            return {}
        at_state, forms = view.model.system.at_state(state), view.model.observed
        # integrals over the modelled part, divided by its volume
        integrals = np.array([at_state.integral(forms[f"induced {axis}"]) for axis in "xyz"])
        J = integrals / at_state.integral(forms["induced volume"])
        # on a meridian, components across e3 turn around it: their mean is zero
        if 1 not in view.model.axes:
            J[:2] = 0.0
        # the mean over all copies of the modelled part
        if view.mirror:
            sign = field.sign_of_images(state.mu, view.model.r0, view.mirror)
            J = view.mirror.sum_over_images(J, sign) / view.mirror.copies
        return dict(
            zip(INDUCED, map(float, field.soft.tesla * J @ rotation(view.azimuth)), strict=True)
        )


class SensorsObservables(Observables):
    """Observables of sensors: three columns of flux density for each."""

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        """Refuse sensors within half the thickness of a surface from a mesh file.

        Raises
        ------
        CaseError
            With the sensor.
        """
        # nodes in space: a mesh file; charts (n, 2) were tested by `sensors.depth`
        if not loads.sensors or surface.nodes.shape[1] < 3:
            return
        from scipy.spatial import cKDTree  # takes long to import

        corners = surface.embedding(surface.nodes)[surface.cells[:, :3]]
        # 45 places on each flat triangle, by barycentric coordinates in steps of 1/8
        barycentric = np.array([(i, j, 8 - i - j) for i in range(9) for j in range(9 - i)]) / 8.0
        surface_points = cKDTree(np.einsum("mk,nki->nmi", barycentric, corners).reshape(-1, 3))
        for sensor in loads.sensors:
            if surface_points.query(sensor.place)[0] < sensor.half:
                raise CaseError(
                    f"sensors.{sensor.name}.position: is in the shell, within half its thickness "
                    "of it: place it outside"
                )

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        return tuple(column for sensor in loads.sensors for column in sensor.columns)

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return the readings of all sensors, column -> value; collective."""
        if not view.loads.sensors:
            return {}
        readings = _readings(view, state, view.loads.sensors)
        columns = [column for each in view.loads.sensors for column in each.columns]
        return dict(zip(columns, map(float, readings.ravel()), strict=True))


def slope_of_sensor(view: ModelView, state: "State", column: str) -> Slope | None:
    """Return a column with its derivatives; None if no sensor has it. Collective.

    Derivatives by displacement and remanence are those of the shell's own field. Derivatives by
    amplitudes of the applied field are central differences of fourth order: it is read too, or
    induces a polarisation.
    """
    from magshell_fenicsx.parts.magnetism.self_field import self_field

    # the sensor of the column, and the number of the column's component
    sensors_and_components = [
        (sensor, i)
        for sensor in view.loads.sensors
        for i, name in enumerate(sensor.columns)
        if name == column
    ]
    if not sensors_and_components:
        return None
    (sensor, i), *_ = sensors_and_components
    self_field_of_model = self_field(view)
    # e_i of the case in the model's frame, times the unit: the column is direction . B
    direction = sensor.own * rotation(view.azimuth)[:, i]
    system = view.model.system
    at_state, nodes = system.at_state(state), view.model.r0.function_space.dofmap.list

    def nodal_derivatives() -> tuple[Array, Array]:
        """Return derivatives by u, summed at nodes, and by the remanence in cells."""
        # by the values at the nodes of each cell
        derivatives = self_field_of_model.derivatives(state.mu, sensor.place, direction)
        by_u = np.zeros_like(system.u.x.array)
        components = derivatives.by_u.shape[2]
        own_nodes = nodes[: len(derivatives.by_u)]
        np.add.at(by_u.reshape(-1, components), own_nodes, derivatives.by_u)
        return by_u, derivatives.by_remanence

    by_u, by_remanence = at_state.evaluate(nodal_derivatives)
    by_mu = _derivatives_by_field(view, state, sensor, component=i)
    (reading,) = _readings(view, state, [sensor])  # (3,)
    return Slope(
        value=float(reading[i]),
        by_u=at_state.summed(by_u),
        by_mu=by_mu,
        field=self_field_of_model.Br,
        by_field=by_remanence,
    )


def _derivatives_by_field(
    view: ModelView, state: "State", sensor: Sensor, component: int
) -> dict[str, float]:
    """Return the derivatives of a reading by the amplitudes of the applied field; collective.

    They are central differences. `component` is that of the reading, 0 to 2. Empty if the
    reading does not depend on the applied field.
    """
    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.parts.magnetism.self_field import DIFFERENCE_STEP, DIFFERENCE_WEIGHTS

    applied = view.loads.magnetic
    if not applied:
        return {}
    if not sensor.total and not applied.soft:
        return {}
    names_of_motions = (name for moving_field in applied.driven for name in moving_field.names)
    names = {FIELD.name, *FIELD.components, *names_of_motions}
    by_mu = dict[str, float]()
    for name in sorted(names & state.mu.keys()):
        value = state.mu[name]
        step = DIFFERENCE_STEP * (abs(value) or 1.0)
        readings = dict[int, float]()  # number of steps by which mu is moved -> reading
        for steps, _ in DIFFERENCE_WEIGHTS:
            moved_state = State(state.u, {**state.mu, name: value + steps * step})
            (reading,) = _readings(view, moved_state, [sensor])  # (3,)
            readings[steps] = reading[component]
        by_mu[name] = float(
            sum(weight / step * readings[steps] for steps, weight in DIFFERENCE_WEIGHTS)
        )
    return by_mu


def _readings(view: ModelView, state: "State", sensors: Sequence[Sensor]) -> Array:
    """Return the readings (sensors, 3) in the frame of the case; collective.

    Only sensors of the total field read the applied one.
    """
    places = np.array([sensor.place for sensor in sensors])
    own_units = np.array([sensor.own for sensor in sensors])[:, None]
    applied_units = np.array([sensor.applied for sensor in sensors])[:, None]
    reads_total = np.array([sensor.total for sensor in sensors])[:, None]
    applied_factors = np.where(reads_total, applied_units, 0.0)
    return field_at(view, state, places, own_units, applied_factors)


def field_at(
    view: ModelView,
    state: "State",
    places: Array,
    own_factor: Array | float,
    applied_factor: Array | float,
) -> Array:
    """Return the flux density (n, 3) at places over R, in the frame of the case; collective.

    It is nan in the shell.

    Parameters
    ----------
    places
        (n, 3) over R, in the frame of the model.
    own_factor, applied_factor
        Units of the shell's own field and of the applied one: what a remanence of length one, and
        an applied field of strength one, count for. Numbers, or (n, 1) for each place.
    """
    from magshell_fenicsx.parts.magnetism.self_field import magnetisation_of, self_field

    def own_field_there() -> Array:
        """Return the shell's own field at the places, times its unit; collective."""
        if magnetisation_of(view.loads) is None:
            return np.zeros_like(places)
        field_of_model = self_field(view)
        _, charges = field_of_model.families(state.mu)
        return own_factor * field_of_model.B(charges, state.mu, places)

    B, applied_field = (
        view.model.system.at_state(state).evaluate(own_field_there),
        view.loads.magnetic,
    )
    # the applied field is read where its factor is not zero
    if applied_field and np.any(applied_factor):
        B = B + applied_factor * applied_field.field_at(state.mu, places)
    return np.asarray(B @ rotation(view.azimuth))
