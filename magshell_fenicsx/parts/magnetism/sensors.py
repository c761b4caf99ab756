"""Sensors of the magnetic field: their section, places and units.

A sensor reads the flux density at a fixed place outside the shell: of the shell alone ("own"), or
with the applied one ("total"). A context holds the sections of a case. An offer is a property that
a case may have or lack, such as "the whole shell"; `context.needs(key, offer)` refuses a case that
lacks it. "Refuse" means: raise an error that names the key. lambda_m is the strength of the applied
field, which has a unit only if the case has flux densities.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan, sqrt
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.ability import Context, KeyAbility
from magshell_fenicsx.parts.magnetism.fields import MU_0, MagneticSection
from magshell_fenicsx.parts.shell_sections import MeshSurface, ShellSection, Surface
from magshell_fenicsx.shape.reference_shell import Coordinates

Array = NDArray[np.float64]
# iterations and difference step of Gauss and Newton's method for the nearest place of a surface
NEWTON_STEPS, DIFFERENCE_STEP = 8, 1e-6


class SensorSection(Section):
    """A point at which the field is read, outside the shell: columns NAME_Bx, NAME_By and NAME_Bz
    of path.csv.

    In T; where the case has no flux densities over |B^r|, of a shell that is soft alone over √(μ0
    E).
    """

    position: Coordinates
    """Where it is; it does not move [the shell's length; over R if that has no unit]"""
    field: Literal["own", "total"] = "own"
    """What it reads: the field of the magnetised shell alone, or with the applied one"""


Sensors = Annotated[dict[str, SensorSection], Field(max_length=1000)]


@dataclass(frozen=True)
class Sensor:
    """A sensor in the model's frame.

    Attributes
    ----------
    name
        Name in the case, with which its columns begin.
    place
        (3,) over R.
    total
        Whether it reads the applied field too.
    own, applied
        Flux densities in the unit of the columns: of a remanence of length one, and of lambda_m =
        1.
    half
        Half of the thickness over R.
    """

    name: str
    place: Array
    total: bool
    own: float
    applied: float
    half: float

    @property
    def columns(self) -> tuple[str, str, str]:
        return f"{self.name}_Bx", f"{self.name}_By", f"{self.name}_Bz"


def sensors(context: Context, turn: float) -> tuple[Sensor, ...]:
    """Return the sensors of a case in the frame of a model.

    `turn` is the azimuth of that frame about e3 in radians.
    """
    sections: dict[str, SensorSection] = context.sections.get("sensors") or {}
    # flux densities of a remanence of length one, and of lambda_m = 1
    shell, (unit_of_own, unit_of_applied) = context.shell, units(context)
    R, half = shell.reference, 0.5 / shell.R_over_h
    return tuple(
        Sensor(
            name,
            place=rotation(turn) @ np.array(section.position) / R,
            total=section.field == "total",
            own=unit_of_own,
            applied=unit_of_applied,
            half=half,
        )
        for name, section in sections.items()
    )


def units(context: Context) -> tuple[float, float]:
    """Return the flux densities of a remanence of length one and of lambda_m = 1.

    They are in T, or over |Br| without flux densities; nan if unknown. Without remanence, a shell
    that is soft alone has √(μ0 E) in place of |Br|.
    """
    magnetic, E = context.section_of(MagneticSection), context.shell.youngs_modulus
    if magnetic is None:
        return nan, nan
    if magnetic.remanent is None:
        tesla = sqrt(MU_0 * E) if E and magnetic.lambda_m is None else 1.0
        return tesla, tesla
    # the applied field's strength in T needs both Br and E
    Br = magnetic.remanent.flux_density
    return (Br, magnetic.tesla(E)) if Br and E else (Br or 1.0, nan)


class Sensing(KeyAbility[Mapping[str, SensorSection]]):
    """The part of all sensors of a case: its checks."""

    key = "sensors"

    def refuse_unfit(self, context: Context) -> None:
        """Refuse a case in which nothing is magnetised, with a ValueError."""
        refuse_unfit_reading(self.key, context)

    def refuse_unfit_values(self, context: Context, places: Array) -> None:
        """Refuse sensors in the undeformed shell, and names that are no identifiers.

        Raises
        ------
        CaseError
            With the sensor.
        """
        for name, section in self.sections.items():
            if not name.isidentifier():
                raise CaseError(
                    f"sensors: {name}: a name is made of letters, digits and _, as it begins "
                    "names of columns"
                )
            refuse_unknown_field(f"sensors.{name}", section.field, context)
            shell = context.shell
            if isinstance(shell, MeshSurface):  # tested with its nodes, see `SensorsObservables`
                continue
            if depth(shell, np.array(section.position) / shell.reference) < 0:
                x, y, z = section.position
                raise CaseError(
                    f"sensors.{name}.position: ({x:g}, {y:g}, {z:g}) is in the shell, within half "
                    "its thickness of the mid-surface: place it outside"
                )


def refuse_unfit_reading(key: str, context: Context) -> None:
    """Refuse a key that asks for a field which cannot be read in this case.

    Raises
    ------
    ValueError
        With the key.
    """
    if context.section_of(MagneticSection) is None:
        raise ValueError(f"{key}: need magnetic: nothing is magnetised, and no field applied")
    context.needs(key, "the whole shell")
    # where the thickness follows from the area, this must be that of the drawn shell
    if "a thickness that does not change" in context.missing_offers:
        context.needs(key, "the area as drawn")


def refuse_unknown_field(key: str, field: str, context: Context) -> None:
    """Refuse a reading of the total field where the strength of the applied one is unknown.

    `key` is the key of the reading, `field` is "own" or "total".

    Raises
    ------
    CaseError
        With the key.
    """
    if field != "total":
        return
    _, unit_of_applied = units(context)  # nan if unknown
    if not np.isfinite(unit_of_applied):
        raise CaseError(
            f"{key}.field: total: lambda_m does not say how strong the applied field is: give "
            "remanent.flux_density and applied.flux_density, or field: own"
        )


def is_read(context: Context) -> bool:
    """Return whether a case asks for the field outside the shell, by sensors or field maps."""
    return bool(context.sections.get("sensors") or context.sections.get("field_maps"))


def depth(shell: "ShellSection | Surface", x: Array) -> float:
    """Return the distance over R of a place from the nearest face of an undeformed shell.

    It is negative inside. `x` (3,) is over R. A chart is a place on the surface, in the coordinates
    of its outline.
    """
    from magshell_fenicsx.parts.shell_outline import outline  # reads meshes

    outline_of_shell = outline(shell)
    chart, half = np.asarray(outline_of_shell.inverse(x), dtype=float), 0.5 / shell.R_over_h
    # the method of Gauss and Newton for the nearest place of the surface, the foot
    for _ in range(NEWTON_STEPS):
        # the foot at the present chart, and places a small step along each coordinate
        steps = np.vstack([chart, *(chart + DIFFERENCE_STEP * e for e in np.eye(len(chart)))])
        foot, *neighbours = outline_of_shell.embedding(steps)
        tangents = np.array([place - foot for place in neighbours]).T / DIFFERENCE_STEP
        newton_step, *_ = np.linalg.lstsq(tangents, x - foot, rcond=None)
        # from the chart to a place and back: a chart beyond the edge returns to the edge
        (next_foot,) = outline_of_shell.embedding((chart + newton_step)[None])
        next_chart = np.asarray(outline_of_shell.inverse(next_foot), dtype=float)
        if not np.isfinite(next_chart).all():  # the last chart is kept
            break
        chart = next_chart
    (nearest_place,) = outline_of_shell.embedding(chart[None])
    return float(np.linalg.norm(x - nearest_place)) - half
