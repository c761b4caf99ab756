"""Maps of the magnetic field: grids on planes and in boxes, on which it is computed at each point
of a path.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Lengths, Section
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.magnetism.sensors import (
    refuse_unfit_reading,
    refuse_unknown_field,
    units,
)
from magshell_fenicsx.parts.part import Context, KeyAbility
from magshell_fenicsx.parts.seen import MapGrid, Seen, Sight
from magshell_fenicsx.shape.reference_shell import Coordinates

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.parts.loads import Loads

Array = NDArray[np.float64]
MOST = 1_000_000  # places of one map
LONGEST = 60  # of a name
SQUARE = 1e-9  # cosine of the angle between sides


class FieldMapSection(Section):
    """A grid on which the field is computed, at every point of the path: fields/map_NAME.pvd for
    ParaView, and drawn.

    It is a rectangle with two sides, or a box with three. In the shell it has no values.
    """

    corner: Coordinates
    """Where the sides begin [the shell's length; over R if that has no unit]"""
    sides: Annotated[list[Lengths], Field(min_length=2, max_length=3)]
    """Vectors along the sides, perpendicular to each other [the shell's length; over R if that has
    no unit]"""
    points: list[Annotated[int, Field(ge=2, le=10_000)]] = Field(
        default=[41, 41], min_length=2, max_length=3
    )
    """How many along each side, its ends included"""
    field: Literal["own", "total"] = "own"
    """The field of the magnetised shell alone, or with the applied one"""

    @model_validator(mode="after")
    def _is_a_grid(self) -> "FieldMapSection":
        if len(self.points) != len(self.sides):
            raise ValueError(
                f"points: {len(self.points)} numbers for {len(self.sides)} sides: give one for "
                "each side, as [41, 41] for two"
            )
        if np.prod(self.points) > MOST:
            raise ValueError(f"points: more than {MOST} places in all: give fewer")
        sides = np.array(self.sides)
        lengths = np.linalg.norm(sides, axis=1)
        if not lengths.all():
            raise ValueError("sides: a side has no length: give vectors that point somewhere")
        if any(abs(a @ b) > SQUARE for a, b in combinations(sides / lengths[:, None], 2)):
            raise ValueError("sides: are not perpendicular to each other")
        return self


FieldMaps = Annotated[dict[str, FieldMapSection], Field(max_length=100)]


@dataclass(frozen=True)
class FieldMap:
    """A map in the model's frame.

    Attributes
    ----------
    grid
        In the frame of the case, without values.
    places
        (n, 3) over R, of the grid in the model's frame.
    total
        Whether the applied field is added.
    own, applied
        See `sensors.Sensor`.
    """

    grid: MapGrid
    places: Array
    total: bool
    own: float
    applied: float


def field_maps(context: Context, turn: float) -> tuple[FieldMap, ...]:
    """The maps of a case, in a frame turned about e3 (rad)."""
    given: dict[str, FieldMapSection] = context.sections.get("field_maps") or {}
    own, R = units(context), context.shell.reference
    unit = unit_of_readings(context)
    grids = [
        (
            each,
            MapGrid(
                name,
                np.array(each.corner) / R,
                np.array(each.sides) / R,
                tuple(each.points),
                unit,
                each.field,
            ),
        )
        for name, each in given.items()
    ]
    return tuple(
        FieldMap(grid, grid.places @ rotation(turn).T, each.field == "total", *own)
        for each, grid in grids
    )


def unit_of_readings(context: Context) -> str:
    """What a reading is in: T, or what it is over."""
    magnetic, E = context.of(MagneticSection), context.shell.youngs_modulus
    if magnetic and magnetic.remanent is None:
        return "T" if E and magnetic.lambda_m is None else "sqrt(mu0 E)"
    return "T" if magnetic and magnetic.remanent and magnetic.remanent.flux_density else "|Br|"


class FieldMapping(KeyAbility[Mapping[str, FieldMapSection]]):
    """All maps of a case."""

    key = "field_maps"

    def refuse_unfit(self, context: Context) -> None:
        """See that something is magnetised, whose field there can be."""
        refuse_unfit_reading(self.key, context)
        for name in self.given:
            if not (name.isascii() and name.isidentifier() and len(name) <= LONGEST):
                raise ValueError(
                    f"field_maps: {name}: a name is made of at most {LONGEST} letters, digits and "
                    "_, as it is in names of files"
                )

    def refuse_unfit_values(self, context: Context, places: Array) -> None:
        """See that the applied field has a strength, where it is asked for."""
        for name, each in self.given.items():
            refuse_unknown_field(f"field_maps.{name}", each.field, context)

    def numbers(self, context: Context) -> list[str]:
        """How many places there are."""
        return [
            f"field map {name}: {' x '.join(map(str, each.points))} places, {each.field} field"
            for name, each in self.given.items()
        ]


class FieldMapsSeen(Seen):
    """What maps show."""

    def grids(self, loads: "Loads") -> Sequence[str]:
        return [each.grid.name for each in loads.field_maps]

    def on_grids(self, sight: Sight, state: "State") -> list[MapGrid]:
        from magshell_fenicsx.parts.magnetism.readings import (
            field_at,
        )  # the solver takes long to import

        return [
            replace(
                each.grid,
                values=field_at(
                    sight, state, each.places, each.own, each.applied if each.total else 0.0
                ),
            )
            for each in sight.loads.field_maps
        ]
