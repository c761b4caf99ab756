"""Base of all imperfections: their sections, sizes with units, and geometry."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import inf, radians, sqrt
from typing import Annotated, Any, ClassVar, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import (
    BeforeValidator,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    ValidationInfo,
)

from magshell_fenicsx.input.section import Section, Sized, in_units, with_unit
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.mesh.patch import Deviation
from magshell_fenicsx.parts.ability import Context, KeyAbility
from magshell_fenicsx.shape.reference_shell import At, Distance, ReferenceShell, locate

Array = NDArray[np.float64]
Values = TypeVar("Values")
KEYS = ("imperfections", "defect")
CONTEXT = (
    "of imperfections"  # key of the context of a validation: scale -> size in m, none without units
)
UNITS = {"h": "h", "width": "the unit of a dimple's width"}
DIMPLE_ELEMENT_SIZE = 0.45  # of sqrt(R h): elements that show a dimple


@dataclass(frozen=True)
class ImperfectionGeometry:
    """Geometry of one imperfection; places, lengths and w0 over R, in the frame of the case.

    Attributes
    ----------
    deviation
        Places (n, 3) of the perfect surface -> w0 (n,).
    size
        Largest element size that resolves it, within `reach` of its centre.
    centre
        Its centre (3,) on the perfect surface; None if it is everywhere.
    distance
        From its centre.
    reach
        How far it reaches from its centre, in the measure of `distance`.
    rim
        Whether the curvature jumps there.
    account
        What it was made from, for people.
    sizes
        Places (n, 3) -> element sizes (n,) that show it there, of one without a centre that varies
        more in some places; None where they are alike.
    """

    deviation: Deviation
    size: float = inf
    centre: Array | None = None
    distance: Distance | None = None
    reach: float = inf
    rim: bool = False
    account: str = ""
    sizes: Callable[[Array], Array] | None = None

    def is_within_rim(self, places: Array) -> NDArray[np.bool_]:
        """Return whether places (n, 3) are within the rim."""
        assert self.distance
        return np.asarray(self.distance(places) < self.reach)


@dataclass(frozen=True)
class Local:
    """The deviation -depth f((distance/width)²) around a place, with a profile f that is 1 there.

    Attributes
    ----------
    depth, width
        Over R; the width in the measure of `distance`, so on spheres in rad.
    distance
        From its centre.
    steepest
        The largest slope of f(t²) by t.
    reach, element_widths
        How far it reaches, and elements that show a narrow one, in widths.
    rim
        Whether the curvature jumps where it ends.
    """

    steepest: ClassVar[float]
    reach: ClassVar[float] = 1.0
    element_widths: ClassVar[float] = inf
    rim: ClassVar[bool] = False
    depth: float
    width: float
    distance: Distance

    @staticmethod
    def profile(squared: Array) -> Array:
        """f."""
        raise NotImplementedError

    def __call__(self, places: Array) -> Array:
        squared = np.asarray((self.distance(places) / self.width) ** 2, dtype=np.float64)
        return np.asarray(-self.depth * self.profile(squared))


@dataclass(frozen=True)
class RotatedFunction(Generic[Values]):
    """A function of places (n, 3) in a frame whose axes are the rows of `axes`."""

    of_place: Callable[[Array], Values]
    axes: Array

    def __call__(self, places: Array) -> Values:
        return self.of_place(places @ self.axes)


def in_frame(of_place: Callable[[Array], Values], turn: float) -> Callable[[Array], Values]:
    """A function of places in a frame turned about e3 (rad)."""
    return RotatedFunction(of_place, rotation(turn)) if turn else of_place


def half_width(width: float, R_over_h: float, nu: float) -> float:
    """Width of an imperfection over R (rad), from the width over (h R)^(1/2)/(12 (1 -
    nu^2))^(1/4)."""
    return width / sqrt(sqrt(12 * (1 - nu**2)) * R_over_h)


def number_over(scale: Literal["h", "width"]) -> BeforeValidator:
    """A validator: a length with a unit -> a number over h, or in the unit of a dimple's width; or
    a number.
    """

    def convert(value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            return value
        exact = in_units("metre")(value)
        if info.context and CONTEXT not in info.context:
            return 1.0  # the shell is wrong: any number will do
        sizes = (info.context or {}).get(CONTEXT)
        if not sizes:
            raise ValueError(
                "has a unit: that needs lengths of the shell with units; a number is in "
                f"{UNITS[scale]}"
            )
        return exact / sizes[scale]

    return BeforeValidator(convert, json_schema_input_type=float | with_unit("millimetre"))


def note_sizes(
    data: Any, handler: ModelWrapValidatorHandler[Any], info: ValidationInfo, *, with_units: bool
) -> None:
    """Note what the imperfections in plain data of a shell are over: the shell without them has
    these sizes.

    A wrong shell has none: its own message says what is wrong.
    """
    if (
        not isinstance(info.context, dict)
        or not isinstance(data, dict)
        or not any(map(_has_text, _imperfections(data)))
    ):
        return
    info.context.pop(CONTEXT, None)
    try:
        shell: Sized = handler({key: value for key, value in data.items() if key not in KEYS})
    except ValidationError:
        return
    R, R_over_h = shell.reference, shell.R_over_h
    sizes = {"h": R / R_over_h, "width": R * half_width(1.0, R_over_h, shell.poisson_ratio)}
    info.context[CONTEXT] = sizes if with_units else {}


def sizes_noted(info: ValidationInfo) -> Mapping[str, Any]:
    """The part of the context of a validation with the sizes, for what is validated later."""
    return {CONTEXT: (info.context or {}).get(CONTEXT, {})}


def _imperfections(data: dict[str, Any]) -> list[Any]:
    listed = data.get("imperfections")
    return [*(listed if isinstance(listed, list) else []), data.get("defect")]


def _has_text(part: Any) -> bool:
    """Whether a part of plain data has text that begins with a number, or the unit of random
    numbers.
    """
    if isinstance(part, dict):
        return any(key == "unit" or _has_text(value) for key, value in part.items())
    if isinstance(part, list):
        return any(map(_has_text, part))
    return isinstance(part, str) and part.strip()[:1] in {*"+-.0123456789"}


class ImperfectionSection(Section):
    """Base of all kinds: w0 along the outward normal of the perfect surface.

    Attributes
    ----------
    patch
        Whether the part within its rim is a patch with a name.
    """

    patch: ClassVar[bool] = False
    kind: str

    @property
    def parameters(self) -> tuple[str, ...]:
        """Numbers that a knockdown factor is differentiated by, as paths of keys below the
        section."""
        return ("amplitude",)

    def account(self) -> str:
        """Describe the imperfection in the account of what is built."""
        return self.kind

    @property
    def pending_modes(self) -> int:
        """Number of modes of the perfect shell that it needs and that are not yet computed."""
        return 0

    @property
    def of_perfect_shell(self) -> bool:
        """Whether it is computed from the perfect shell, with whose numbers it changes."""
        return False

    def listed(self) -> "Mapping[str, ImperfectionSection]":
        """Return the imperfections that are built of it, by their keys below its own.

        They are itself, with the key "", or others, whose keys begin with a dot.
        """
        return {"": self}

    def refuse_unfit(self, R_over_h: float, nu: float, edge: float | None) -> None:
        """Raise ValueError if a shell cannot have it.

        Parameters
        ----------
        edge
            Polar angle of the edge of a sphere (rad); None of other shells.
        """

    def geometry(self, reference: ReferenceShell, key: str) -> ImperfectionGeometry:
        """Return its geometry on the perfect shell; `key` is its key, with dots.

        Raises
        ------
        CaseError
            If the perfect surface has no such imperfection.
        """
        raise NotImplementedError


class LocalSection(ImperfectionSection):
    """Base of those around a place, which have a profile: the class `deviation`."""

    deviation: ClassVar[type[Local]]
    amplitude: Annotated[float, number_over("h")] = Field(ge=-50, le=50)
    """Depth δ, inwards; a bump is negative [h]"""
    width: Annotated[float, number_over("width")] = Field(ge=0.05, le=50)
    """Half-width. A number is φo of a dimple, or φg of a Gaussian one, in radians times (√(12(1 -
    ν²)) R/h)^(1/2); a length with a unit is R φo, or R φg"""
    at: At = At.model_construct()
    """Its centre"""

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("amplitude", "width", "at.polar", "at.azimuth")

    def half_width(self, R_over_h: float, nu: float) -> float:
        """Over R (rad)."""
        return half_width(self.width, R_over_h, nu)

    def refuse_unfit(self, R_over_h: float, nu: float, edge: float | None) -> None:
        depth = abs(self.amplitude) / R_over_h
        _refuse_steep(depth, self.deviation.steepest * depth / self.half_width(R_over_h, nu))

    def geometry(self, reference: ReferenceShell, key: str) -> ImperfectionGeometry:
        of, width = self.deviation, self.half_width(reference.R_over_h, reference.nu)
        place, distance = locate(self.at, reference, key)
        size = min(DIMPLE_ELEMENT_SIZE / sqrt(reference.R_over_h), of.element_widths * width)
        deviation = of(self.amplitude / reference.R_over_h, width, distance)
        return ImperfectionGeometry(deviation, size, place, distance, of.reach * width, of.rim)


def _refuse_steep(depth: float, slope: float) -> None:
    """Refuse a local imperfection by its depth over R and its steepest slope."""
    if depth > 0.5:
        raise ValueError(f"the dimple is {depth:.2g} radii deep; it must stay below half a radius")
    if slope > 2:
        raise ValueError(
            f"the dimple's steepest slope is {slope:.3g}: too steep for a shell, at most 2"
        )


@dataclass(frozen=True)
class Imperfect(KeyAbility[Mapping[str, ImperfectionSection]]):
    """All imperfections of a case, by their keys below `shell`."""

    key = "imperfections"

    def refuse_unfit(self, context: Context) -> None:
        """Refuse imperfections that the shell cannot have."""
        shell = context.shell
        if getattr(shell, "defect", None) and shell.imperfections:
            raise ValueError(
                "shell.imperfections: give these or defect; a dimple of the list is the same as "
                "defect"
            )
        edge = None if shell.edge_polar is None else radians(shell.edge_polar)
        for key, section in self.sections.items():
            try:
                section.refuse_unfit(shell.R_over_h, shell.poisson_ratio, edge)
            except ValueError as e:
                raise ValueError(f"shell.{key}: {e}") from None


def imperfection_geometries(
    imperfections: Mapping[str, ImperfectionSection], reference: ReferenceShell
) -> dict[str, ImperfectionGeometry]:
    """Key of each imperfection below `shell` -> what it brings."""
    return {
        key: section.geometry(reference, f"shell.{key}") for key, section in imperfections.items()
    }
