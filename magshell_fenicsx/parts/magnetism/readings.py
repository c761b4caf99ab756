"""What is observed of a magnetised shell: what sensors read, and what a field induces in a soft
one.

The solver takes long to import, and a case that is only checked needs no more than the names: its
imports are late.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.magnetism.fields import MU_0
from magshell_fenicsx.parts.magnetism.sensors import Sensor
from magshell_fenicsx.parts.seen import Seen, Sight, Slope
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


class FieldSeen(Seen):
    """How strong the field is and how far it has turned, columns of every run; and the moment of
    what is magnetised.
    """

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        return ()

    def observe(self, sight: Sight, state: "State") -> dict[str, float]:
        from magshell_fenicsx.parts.magnetism.direction import (  # the solver takes long to import
            field_angle,
            field_size,
        )

        angle = field_angle(state.mu, sight.loads.magnetic, sight.sense)
        return {"lambda_m": field_size(state.mu, sight.sense), "field_angle": angle}

    def summary(self, sight: Sight, state: "State") -> dict[str, Any]:
        from magshell_fenicsx.parts.magnetism.self_field import magnetic_moment, magnetisation_of

        of = magnetisation_of(sight.loads)
        if of is None or of.absent:
            return {}
        at = sight.model.system.at_state(state)
        moment = at.evaluate(lambda: magnetic_moment(sight, state.mu)) @ rotation(sight.azimuth)
        size = of.tesla * of.metres**3 / MU_0 if of.metres else 1.0
        unit = "√(E/μ0) R³" if of.soft and of.soft.alone else "|Br| R³/μ0"
        return {
            "magnetic_moment": {
                "value": (size * moment).tolist(),
                "unit": "A m²" if of.metres else unit,
            }
        }


class SoftSeen(Seen):
    """The mean polarisation that the field induces."""

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        from magshell_fenicsx.models.shell.patterns import by_patch

        soft = loads.magnetic.soft if loads.magnetic else None
        if soft and soft.patches:
            by_patch(soft.patches, surface.patches, len(surface.cells), "magnetic.susceptibility")

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        return INDUCED if loads.magnetic and loads.magnetic.soft else ()

    def observe(self, sight: Sight, state: "State") -> dict[str, float]:
        field = sight.loads.magnetic
        if field is None or field.soft is None:
            return {}
        at, forms = sight.model.system.at_state(state), sight.model.observed
        J = np.array([at.integral(forms[f"induced {axis}"]) for axis in "xyz"]) / at.integral(
            forms["induced volume"]
        )
        if 1 not in sight.model.axes:  # of a meridian, with which they turn
            J[:2] = 0.0
        if sight.mirror:
            sign = field.sign_of_images(state.mu, sight.model.r0, sight.mirror)
            J = sight.mirror.sum_over_images(J, sign) / sight.mirror.copies
        return dict(
            zip(INDUCED, map(float, field.soft.tesla * J @ rotation(sight.azimuth)), strict=True)
        )


class SensorsSeen(Seen):
    """What sensors read."""

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        from scipy.spatial import cKDTree

        if not loads.sensors or surface.nodes.shape[1] < 3:  # of a chart `sensors.depth` knows
            return
        corners = surface.embedding(surface.nodes)[surface.cells[:, :3]]
        spread = np.array([(i, j, 8 - i - j) for i in range(9) for j in range(9 - i)]) / 8.0
        near = cKDTree(np.einsum("mk,nki->nmi", spread, corners).reshape(-1, 3))
        for each in loads.sensors:
            if near.query(each.place)[0] < each.half:
                raise CaseError(
                    f"sensors.{each.name}.position: is in the shell, within half its thickness of "
                    "it: place it outside"
                )

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        return tuple(column for each in loads.sensors for column in each.columns)

    def differentiable(self, loads: "Loads") -> Sequence[str]:
        return self.columns(loads, ())

    def observe(self, sight: Sight, state: "State") -> dict[str, float]:
        if not sight.loads.sensors:
            return {}
        readings = self._readings(sight, state, sight.loads.sensors)
        columns = [column for each in sight.loads.sensors for column in each.columns]
        return dict(zip(columns, map(float, readings.ravel()), strict=True))

    def slope(self, sight: Sight, state: "State", column: str) -> Slope | None:
        from magshell_fenicsx.continuation.system import State
        from magshell_fenicsx.parts.magnetism.magnetised import ACROSS
        from magshell_fenicsx.parts.magnetism.self_field import (
            DIFFERENCE_STEP,
            DIFFERENCE_WEIGHTS,
            self_field,
        )

        matching = [
            (each, i)
            for each in sight.loads.sensors
            for i, name in enumerate(each.columns)
            if name == column
        ]
        if not matching:
            return None
        (sensor, i), own = matching[0], self_field(sight)
        e = sensor.own * rotation(sight.azimuth)[:, i]
        system = sight.model.system
        at, nodes = system.at_state(state), sight.model.r0.function_space.dofmap.list

        def derived() -> tuple[Array, Array]:
            into, part = own.derivatives(state.mu, sensor.place, e), np.zeros_like(system.u.x.array)
            size = into.by_u.shape[2]
            np.add.at(part.reshape(-1, size), nodes[: len(into.by_u)], into.by_u)
            return part, into.by_remanence

        part, by_remanence = at.evaluate(derived)
        by_mu = dict[str, float]()
        applied = sight.loads.magnetic
        if applied and (sensor.total or applied.soft):
            names = {"lambda_m", *ACROSS, *(name for each in applied.driven for name in each.names)}
            for name, value in ((name, state.mu[name]) for name in sorted(names & state.mu.keys())):
                size = DIFFERENCE_STEP * (abs(value) or 1.0)
                moved = (
                    (way, State(state.u, {**state.mu, name: value + way * size}))
                    for way, _ in DIFFERENCE_WEIGHTS
                )
                values = {
                    way: self._readings(sight, moved_state, [sensor])[0][i]
                    for way, moved_state in moved
                }
                by_mu[name] = float(sum(w / size * values[way] for way, w in DIFFERENCE_WEIGHTS))
        value = float(self._readings(sight, state, [sensor])[0][i])
        return Slope(value, at.summed(part), by_mu, own.Br, by_remanence)

    def _readings(self, sight: Sight, state: "State", of: Sequence[Sensor]) -> Array:
        """(n, 3) of each, in the case's frame."""
        places, total = np.array([each.place for each in of]), np.array([each.total for each in of])
        own, applied = (
            np.array([getattr(each, name) for each in of])[:, None] for name in ("own", "applied")
        )
        return field_at(sight, state, places, own, np.where(total[:, None], applied, 0.0))


def field_at(
    sight: Sight, state: "State", places: Array, own: Array | float, applied: Array | float
) -> Array:
    """The field (n, 3) at places (n, 3) over R of the model's frame, in the frame of the case;
    collective.

    It is nan in the shell.

    Parameters
    ----------
    own, applied
        What the field of a remanence of length one, and an applied one of lambda_m = 1 count; (n,
        1), or of all.
    """
    from magshell_fenicsx.parts.magnetism.self_field import magnetisation_of, self_field

    def present() -> Array:
        if magnetisation_of(sight.loads) is None:
            return np.zeros_like(places)
        shell = self_field(sight)
        return own * shell.B(shell.families(state.mu)[1], state.mu, places)

    B, outside = sight.model.system.at_state(state).evaluate(present), sight.loads.magnetic
    if outside and np.any(applied):
        B = B + applied * outside.at(state.mu, places)
    return np.asarray(B @ rotation(sight.azimuth))
