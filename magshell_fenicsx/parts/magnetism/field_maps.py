"""Maps of the magnetic field: grids on planes and in boxes, on which it is computed at each point
of a path.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Lengths, Section
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.ability import Context, KeyAbility
from magshell_fenicsx.parts.magnetism.fields import MagneticSection
from magshell_fenicsx.parts.magnetism.sensors import (
    refuse_unfit_reading,
    refuse_unknown_field,
    units,
)
from magshell_fenicsx.parts.observables import MapGrid, ModelView
from magshell_fenicsx.shape.reference_shell import Coordinates

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.system import State

Array = NDArray[np.float64]
MAX_PLACES = 1_000_000  # places of one map
MAX_NAME_LENGTH = 60  # of a name
RIGHT_ANGLE_TOLERANCE = 1e-9  # cosine of the angle between sides


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
        """Refuse sides without length or not perpendicular, and unfit numbers of points."""
        if len(self.points) != len(self.sides):
            raise ValueError(
                f"points: {len(self.points)} numbers for {len(self.sides)} sides: give one for "
                "each side, as [41, 41] for two"
            )
        if np.prod(self.points) > MAX_PLACES:
            raise ValueError(f"points: more than {MAX_PLACES} places in all: give fewer")
        sides = np.array(self.sides)
        lengths = np.linalg.norm(sides, axis=1)
        if not lengths.all():
            raise ValueError("sides: a side has no length: give vectors that point somewhere")
        if any(
            abs(a @ b) > RIGHT_ANGLE_TOLERANCE for a, b in combinations(sides / lengths[:, None], 2)
        ):
            raise ValueError("sides: are not perpendicular to each other")
        return self


FieldMaps = Annotated[dict[str, FieldMapSection], Field(max_length=100)]


@dataclass(frozen=True)
class FieldMap:
    """A map of the magnetic field, in the frame of the model: a grid, without values.

    Attributes
    ----------
    grid
        The grid in the frame of the case, without values.
    places
        (n, 3) places of the grid over R, in the frame of the model.
    total
        Whether the applied field is added.
    own, applied
        Flux densities of a remanence of length one and of lambda_m = 1 (the amplitude of the
        applied field), in T or over |Br|.
    """

    grid: MapGrid
    places: Array
    total: bool
    own: float
    applied: float


def field_maps(context: Context, turn: float) -> tuple[FieldMap, ...]:
    """Return the maps of a case, in the frame of the model.

    `turn` (rad) is the angle about e3 by which this frame is turned from that of the case.
    """
    sections: dict[str, FieldMapSection] = context.sections.get("field_maps") or {}
    # flux densities of a remanence of length one, and of lambda_m = 1; and the name of their unit
    tesla_of_remanence, tesla_of_lambda = units(context)
    R, unit = context.shell.reference, unit_of_readings(context)
    maps = list[FieldMap]()
    for name, section in sections.items():
        grid = MapGrid(
            name,
            np.array(section.corner) / R,
            np.array(section.sides) / R,
            tuple(section.points),
            unit,
            section.field,
        )
        places_in_model = grid.places @ rotation(turn).T
        maps.append(
            FieldMap(
                grid,
                places_in_model,
                total=section.field == "total",
                own=tesla_of_remanence,
                applied=tesla_of_lambda,
            )
        )
    return tuple(maps)


def unit_of_readings(context: Context) -> str:
    """Return the unit of flux densities that are read: "T", "sqrt(mu0 E)" or "|Br|".

    It is T where the case has flux densities. Without them it is |Br|, or sqrt(mu0 E) of a shell
    without remanence.
    """
    magnetic, E = context.section_of(MagneticSection), context.shell.youngs_modulus
    if not magnetic:
        return "|Br|"
    if magnetic.remanent is None:
        return "T" if E and magnetic.lambda_m is None else "sqrt(mu0 E)"
    return "T" if magnetic.remanent.flux_density else "|Br|"


class FieldMapping(KeyAbility[Mapping[str, FieldMapSection]]):
    """All maps of a case."""

    key = "field_maps"

    def refuse_unfit(self, context: Context) -> None:
        """Refuse maps where nothing is magnetised, and names that no file can have."""
        refuse_unfit_reading(self.key, context)
        for name in self.sections:
            is_word = name.isascii() and name.isidentifier()
            if not is_word or len(name) > MAX_NAME_LENGTH:
                raise ValueError(
                    f"field_maps: {name}: a name is made of at most {MAX_NAME_LENGTH} letters, "
                    "digits and _, as it is in names of files"
                )

    def refuse_unfit_values(self, context: Context, places: Array) -> None:
        """Refuse the total field where the strength of the applied one is unknown."""
        for name, section in self.sections.items():
            refuse_unknown_field(f"field_maps.{name}", section.field, context)

    def numbers(self, context: Context) -> list[str]:
        """Return a line of `magshell check` for each map: its numbers of places and its field."""
        return [
            f"field map {name}: {' x '.join(map(str, section.points))} places, {section.field} "
            "field"
            for name, section in self.sections.items()
        ]


def maps_at(view: ModelView, state: "State") -> list[MapGrid]:
    """Return the grids of all maps with the flux density at a state; collective.

    Each has values (n, 3) in the unit of its `MapGrid`. `view` is the model with the frame and
    units in which it is reported. A map of the shell's own field has no applied field.
    """
    from magshell_fenicsx.parts.magnetism.readings import (
        field_at,
    )  # the solver takes long to import

    return [
        replace(
            field_map.grid,
            values=field_at(
                view,
                state,
                field_map.places,
                field_map.own,
                field_map.applied if field_map.total else 0.0,
            ),
        )
        for field_map in view.loads.field_maps
    ]
