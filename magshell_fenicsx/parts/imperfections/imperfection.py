"""Base of all imperfections: their sections, sizes with units, and geometry.

An imperfection is a deviation w0 from the perfect surface, along its outward normal. R is the
reference length of the shell, h its thickness, nu Poisson's ratio. A local imperfection has a
centre and a width; `locate` gives its place and the function of distances from there, which are
angles on a sphere. A case gives lengths as numbers over h or over a dimple's unit of width, or with
a unit: these are divided when the case is validated, by sizes in the context of the validation.
"""

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
        Function of places (n, 3) of the perfect surface -> w0 (n,).
    size
        Largest element size that resolves the imperfection, within `reach` of its centre.
    centre
        Centre (3,) on the perfect surface; None if the imperfection is everywhere.
    distance
        Function of places -> distance from the centre; None without a centre.
    reach
        Largest extent from the centre, in the measure of `distance`.
    rim
        Whether the curvature jumps at the reach.
    account
        Words about its origin, for people.
    sizes
        Places (n, 3) -> element sizes (n,) that resolve it there, for an imperfection without a
        centre that varies more in some places; None where they are alike.
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
        """Return whether places (n, 3) are within the rim of a local imperfection."""
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
        """Return the profile f (n,) at squares (n,) of distances over the width."""
        raise NotImplementedError

    def __call__(self, places: Array) -> Array:
        """Return w0 (n,) over R at places (n, 3) over R."""
        squared = np.asarray((self.distance(places) / self.width) ** 2, dtype=np.float64)
        return np.asarray(-self.depth * self.profile(squared))


@dataclass(frozen=True)
class RotatedFunction(Generic[Values]):
    """A function of places (n, 3) in a frame whose axes are the rows of `axes`.

    `of_place` is the function in the frame of the case.
    """

    of_place: Callable[[Array], Values]
    axes: Array

    def __call__(self, places: Array) -> Values:
        return self.of_place(places @ self.axes)


def in_frame(of_place: Callable[[Array], Values], turn: float) -> Callable[[Array], Values]:
    """Return a function of places (n, 3) in a frame that is turned about e3 by `turn` (rad)."""
    return RotatedFunction(of_place, rotation(turn)) if turn else of_place


def half_width(width: float, R_over_h: float, nu: float) -> float:
    """Return a width over R (rad) from a dimple's width over (h R)^(1/2)/(12 (1 - nu^2))^(1/4)."""
    return width / sqrt(sqrt(12 * (1 - nu**2)) * R_over_h)


def number_over(scale: Literal["h", "width"]) -> BeforeValidator:
    """Return a pydantic validator that keeps a number, or makes one of a length with a unit.

    The result is over h, or in the unit of a dimple's width, (h R)^(1/2)/(12 (1 - nu^2))^(1/4). The
    sizes of both in metres are in the context of the validation, where `note_sizes` puts them.
    """

    def convert(value: Any, info: ValidationInfo) -> Any:
        """Return a length with a unit over the size in the context, and a number unchanged."""
        if not isinstance(value, str):
            return value
        metres = in_units("metre")(value)
        # no sizes are noted if the shell itself is wrong, which has a message of its own: then any
        # number will do
        if info.context and CONTEXT not in info.context:
            return 1.0
        sizes = (info.context or {}).get(CONTEXT)
        if not sizes:
            raise ValueError(
                "has a unit: that needs lengths of the shell with units; a number is in "
                f"{UNITS[scale]}"
            )
        return metres / sizes[scale]

    return BeforeValidator(convert, json_schema_input_type=float | with_unit("millimetre"))


def note_sizes(
    data: Any, handler: ModelWrapValidatorHandler[Any], info: ValidationInfo, *, with_units: bool
) -> None:
    """Note in the context of a validation the sizes of the shell by which lengths are divided.

    Lengths of imperfections that have a unit become numbers over h, or over a dimple's unit of
    width. For that the shell is validated first without its imperfections. Its two sizes in metres
    are noted; without units of lengths an empty mapping. Nothing is noted for a wrong shell, whose
    own message says what is wrong. Nothing is noted either if no imperfection has a length as text:
    then the shell need not be validated twice.

    Parameters
    ----------
    data
        Plain data of the shell.
    handler
        Validates the data of a shell.
    with_units
        Whether lengths of the case have units.
    """
    if not isinstance(info.context, dict) or not isinstance(data, dict):
        return
    if not any(map(_has_text, _imperfections(data))):
        return
    info.context.pop(CONTEXT, None)  # sizes of an earlier shell of the case
    try:
        shell: Sized = handler({key: value for key, value in data.items() if key not in KEYS})
    except ValidationError:
        return
    R, R_over_h = shell.reference, shell.R_over_h
    sizes = {"h": R / R_over_h, "width": R * half_width(1.0, R_over_h, shell.poisson_ratio)}
    info.context[CONTEXT] = sizes if with_units else {}


def sizes_noted(info: ValidationInfo) -> Mapping[str, Any]:
    """Return the part of the context of a validation with the sizes, for later validations."""
    return {CONTEXT: (info.context or {}).get(CONTEXT, {})}


def _imperfections(data: dict[str, Any]) -> list[Any]:
    """Return the plain data of all imperfections of a shell."""
    listed = data.get("imperfections")
    return [*(listed if isinstance(listed, list) else []), data.get("defect")]


def _has_text(part: Any) -> bool:
    """Return whether plain data has text that begins with a number, or the key `unit`."""
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
        """Keys below the section of the numbers by which a knockdown factor is differentiated."""
        return ("amplitude",)

    def account(self) -> str:
        """Return a description of the imperfection for `magshell check`."""
        return self.kind

    @property
    def pending_modes(self) -> int:
        """Number of modes of the perfect shell that are needed and not yet computed."""
        return 0

    @property
    def of_perfect_shell(self) -> bool:
        """Whether the imperfection is computed from the perfect shell, and changes with it."""
        return False

    def listed(self) -> "Mapping[str, ImperfectionSection]":
        """Return the imperfections that the section stands for, by their keys below its own.

        Usually this is the section itself, with the key "". Others have keys that begin with a dot.
        """
        return {"": self}

    def refuse_unfit(self, R_over_h: float, nu: float, edge: float | None) -> None:
        """Refuse the imperfection of a shell with these numbers.

        Parameters
        ----------
        edge
            Polar angle of the edge of a sphere (rad); None of other shells.

        Raises
        ------
        ValueError
            If the shell cannot have it.
        """

    def geometry(self, reference: ReferenceShell, key: str) -> ImperfectionGeometry:
        """Return the imperfection's geometry on the perfect shell.

        `key` is the key of the section in the case, with dots, for messages.

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
    """Half-width. A length with a unit is R φo of a dimple, or R φg of a Gaussian one. A bare
    number is that angle in radians times (12(1 - ν²))^(1/4) √(R/h)"""
    at: At = At.model_construct()
    """Its centre"""

    @property
    def parameters(self) -> tuple[str, ...]:
        return ("amplitude", "width", "at.polar", "at.azimuth")

    def half_width(self, R_over_h: float, nu: float) -> float:
        """Return the half-width over R (rad) on a shell with these numbers."""
        return half_width(self.width, R_over_h, nu)

    def refuse_unfit(self, R_over_h: float, nu: float, edge: float | None) -> None:
        depth = abs(self.amplitude) / R_over_h
        steepest_slope = self.deviation.steepest * depth / self.half_width(R_over_h, nu)
        _refuse_steep(depth, steepest_slope)

    def geometry(self, reference: ReferenceShell, key: str) -> ImperfectionGeometry:
        """Return the geometry of the profile around the section's place on the perfect shell.

        Raises
        ------
        CaseError
            If the place is not on the surface.
        """
        profile_class, width = self.deviation, self.half_width(reference.R_over_h, reference.nu)
        # place (3,) of the centre, and the function from places to distances from it
        place, distance = locate(self.at, reference, key)
        # elements resolve the shell's own bending length, and a profile that is narrower
        size = min(
            DIMPLE_ELEMENT_SIZE / sqrt(reference.R_over_h), profile_class.element_widths * width
        )
        deviation = profile_class(self.amplitude / reference.R_over_h, width, distance)
        return ImperfectionGeometry(
            deviation,
            size,
            centre=place,
            distance=distance,
            reach=profile_class.reach * width,
            rim=profile_class.rim,
        )


def _refuse_steep(depth: float, slope: float) -> None:
    """Refuse a local imperfection that is too deep (over R) or too steep, by a ValueError."""
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
        """Refuse imperfections that the shell cannot have, as they are too deep, steep or wide.

        Raises
        ------
        ValueError
            With the key of the imperfection.
        """
        shell = context.shell
        if getattr(shell, "defect", None) and shell.imperfections:
            raise ValueError(
                "shell.imperfections: give these or defect; a dimple of the list is the same as "
                "defect"
            )
        edge = None if shell.edge_polar is None else radians(shell.edge_polar)  # of spheres
        for key, section in self.sections.items():
            try:
                section.refuse_unfit(shell.R_over_h, shell.poisson_ratio, edge)
            except ValueError as e:
                raise ValueError(f"shell.{key}: {e}") from None


def imperfection_geometries(
    imperfections: Mapping[str, ImperfectionSection], reference: ReferenceShell
) -> dict[str, ImperfectionGeometry]:
    """Return key of each imperfection below `shell` -> its geometry on the perfect shell."""
    return {
        key: section.geometry(reference, f"shell.{key}") for key, section in imperfections.items()
    }
