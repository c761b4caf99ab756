"""The natural shape: the section of curvature and size without stress, and growth as a load.

The natural shape is what the shell would have without stress. Its amplitudes "natural_curvature"
and "natural_stretch" are load parameters, from 0 (as drawn) to 1 (as given). A step is a part of a
case's load programme; growth is a kind of it. An ability is what a section adds to a case: checks,
formulas, symmetry and the model's data. A user field is a function that a program gives on its
mesh. R is the reference length of the shell.
"""

import re
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import BeforeValidator, Field, model_validator

from magshell_fenicsx.input.expressions import Formula, formula
from magshell_fenicsx.input.section import _NUMBER, OrInMemory, Section, in_units
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.parts.ability import Ability, Account, Context, Formulas, Modelled, Offer
from magshell_fenicsx.parts.observables import Observables
from magshell_fenicsx.parts.path_step import LoadStep
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.parts.step_course import Target
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

if TYPE_CHECKING:
    from magshell_fenicsx.mesh.patch import PatchMesh
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.shape.outline import Outline

_PER_LENGTH = re.compile(
    rf"\s*(?P<number>{_NUMBER})[\s*]*"
    r"(?:1?\s*/\s*(?P<below>[^\W\d]+)|(?P<power>[^\W\d]+)\s*(?:\*\*|\^)\s*-1)\s*"
)
PLACE = ("x", "y", "z", "pi")


def per_length(value: Any) -> Any:
    """Return text such as "5/m" or "5 m^-1" as a number in 1/m, and any other value unchanged.

    Formulas such as "5/x" are left as they are.
    """
    matched = _PER_LENGTH.fullmatch(value) if isinstance(value, str) else None
    if not matched:
        return value
    # the unit below a stroke, as in 5/m, or with the power -1
    unit = matched["below"] or matched["power"]
    if unit in PLACE:  # in 5/x, x is a coordinate and no unit
        return value
    return in_units("1/metre")(f"{matched['number']} {unit}**-1")


def _components(
    numbers: int, minimum: float, maximum: float, *, lengths: bool = False
) -> BeforeValidator:
    """Return a validator of a curvature or stretch: one value, a list of `numbers`, or a mapping.

    A value is a number within bounds, or a formula; a mapping has a number or a list for each
    patch. A function of a program with one or `numbers` values is allowed too.

    Parameters
    ----------
    numbers
        Number of components of a list.
    minimum, maximum
        Bounds of each number; those of formulas are checked later, at places of the shell.
    lengths
        Whether numbers may be text per length, such as "5/m".
    """

    def checked_number(value: Any) -> Any:
        """Return a value that is a number within bounds, or a formula."""
        value = per_length(value) if lengths else value
        if isinstance(value, str):
            formula(value)  # raises if it is none
            return value
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if not is_number or not minimum <= value <= maximum:
            raise ValueError(
                f"{value!r}: allowed are numbers from {minimum:g} to {maximum:g}, and formulas of "
                "x, y, z"
            )
        return value

    def checked_list(value: Any) -> Any:
        """Return a checked value, or a list of `numbers` checked values."""
        if isinstance(value, list) and len(value) != numbers:
            raise ValueError(f"a list has {numbers} values, this has {len(value)}")
        return (
            [checked_number(v) for v in value] if isinstance(value, list) else checked_number(value)
        )

    def read(value: Any) -> Any:
        """Return the checked curvature or stretch."""
        # a function of a program
        if isinstance(value, UserField):
            if value.size not in (1, numbers):
                raise ValueError(f"a function of {value.size} numbers; allowed are 1 and {numbers}")
            return value
        # one value for the whole shell
        if not isinstance(value, dict):
            return value if value is None else checked_list(value)
        # a value for each patch
        if not value:
            raise ValueError("a mapping names at least one patch")
        _refuse_formulas_of_patches(value)
        return {name: checked_list(patch_value) for name, patch_value in value.items()}

    kind = Number | Annotated[list[Number], Field(min_length=numbers, max_length=numbers)]
    return BeforeValidator(read, json_schema_input_type=kind | dict[str, kind] | None)


def _refuse_formulas_of_patches(value_of_patch: dict[str, Any]) -> None:
    """Check that the values of patches are numbers, with or without a unit, and no formulas."""
    for name, value in value_of_patch.items():
        values = value if isinstance(value, list) else [value]
        # text that `per_length` returns unchanged has no unit: it is a formula
        if any(isinstance(v, str) and per_length(v) is v for v in values):
            raise ValueError(f"{name}: of a patch numbers, no formulas")


MAX_CURVATURE = 1e6  # of a natural shape by formula, over 1/R
Number = float | str
Component = Annotated[float | Formula, Field(union_mode="left_to_right")]  # a number stays one
Values = Annotated[
    Number | list[Number] | dict[str, Number | list[Number]] | UserField | None,
    OrInMemory(UserField),
]


class NaturalSection(Section, Ability):
    """The curvature and the size that the shell would have without stress: growth, swelling,
    pre-stretch.

    Both grow with amplitudes of their own, natural_curvature and natural_stretch, from 0 (the shell
    as drawn) to 1 (what is given here) and beyond. A step of kind: natural drives one; before a
    single load of another kind both grow to 1. Formulas are of the undeformed place x, y, z in the
    shell's length. A mapping has a value for each patch of a mesh, for the dimple, and for the
    rest.
    """

    curvature: Annotated[Values, _components(3, -1e9, 1e9, lengths=True)] = None
    """In addition to the drawn one, per natural length, positive where the surface bends towards
    its normal: one number for all directions (a sphere), or k11, k22, k12 in the frame of `along`
    [1/length]"""
    stretch: Annotated[Values, _components(2, 0.05, 20)] = None
    """Natural over drawn length: one number for all directions, the thickness too, or two along t1
    and t2 of `along`, with the thickness as drawn"""
    along: (
        Literal["meridian"] | Annotated[list[Component], Field(min_length=3, max_length=3)] | None
    ) = None
    """t1 of the frame t1, t2 = n x t1: away from the pole on the meridians of e3, or the part in
    the surface of a vector; by default [1, 0, 0] of a strip, a plate and a mesh, meridian of all
    else"""

    @model_validator(mode="after")
    def _something_grows(self) -> Self:
        if self.curvature is None and self.stretch is None:
            raise ValueError("give curvature, stretch, or both")
        return self

    @property
    def user_fields(self) -> list[UserField]:
        """The curvature and the stretch, where they are functions that a program gives."""
        return [value for value in (self.curvature, self.stretch) if isinstance(value, UserField)]

    @property
    def texts(self) -> list[str]:
        """The formulas of the curvature and the stretch."""
        return [
            text
            for value in (self.curvature, self.stretch)
            for text in components(value)
            if isinstance(text, str)
        ]

    def refuse_unfit(self, context: Context) -> None:
        """Refuse functions of a program in a solid: they are functions on the mid-surface."""
        if self.user_fields:
            context.needs("natural", "a mid-surface", hint="of a solid give numbers and formulas")

    def withdraws(self, context: Context) -> dict[Offer, str]:
        """Withdraw the drawn area where a stretch makes the shell larger without stress."""
        return {} if self.stretch is None else {"the area as drawn": "leave out natural.stretch"}

    def patches(self) -> dict[str, Iterable[str]]:
        values = {f"natural.{key}": getattr(self, key) for key in ("curvature", "stretch")}
        return {key: value for key, value in values.items() if isinstance(value, dict)}

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry of a shell that its natural shape preserves."""
        from magshell_fenicsx.parts.natural.planned import (
            natural_constraints,  # the solver takes long to import
        )

        return natural_constraints(context, outline)

    def formulas(self, context: Context) -> Iterable[Formulas]:
        """Yield the formulas of stretch and curvature, with the least and largest allowed value.

        Places are in the shell's unit of length, and curvatures in one over this unit.
        """
        from magshell_fenicsx.parts.natural.shape import (
            LARGEST,
            SMALLEST,
        )  # the solver takes long to import

        R = context.shell.reference
        bounds = {
            "stretch": (SMALLEST, LARGEST),
            "curvature": (-MAX_CURVATURE / R, MAX_CURVATURE / R),
        }
        for name, (minimum, maximum) in bounds.items():
            value = getattr(self, name)
            yield Formulas(f"natural.{name}", components(value), minimum, maximum, R)

    def contribution(self, context: Context, modelled: Modelled) -> "Loads":
        """Return the natural shape as the model's `Loads` have it."""
        # the solver takes long to import
        from magshell_fenicsx.parts.loads import Loads
        from magshell_fenicsx.parts.natural.planned import natural

        return Loads(natural=natural(context, modelled.turn, modelled.patch_rims))


def components(value: Any) -> list[float | str]:
    """Return the numbers and formulas of a curvature or stretch.

    Empty for values by patch, and for functions of a program.
    """
    if isinstance(value, list):
        return value
    return [value] if isinstance(value, float | int | str) else []


class GrowthSection(LoadStep):
    """The natural shape grows from the drawn one: the factor of `natural.curvature`, or of
    `natural.stretch` less one.

    `until: target` ends at a factor, the others need `grows`.
    """

    targets: ClassVar[dict[str, Target]] = {
        "curvature": Target("load", "natural_curvature"),
        "stretch": Target("load", "natural_stretch"),
    }
    rank_before_load: ClassVar[int] = 1
    kind: Literal["natural"]
    grows: Literal["curvature", "stretch"] | None = None
    """What grows, where no target says it"""
    curvature: float | None = Field(default=None, ge=-1e3, le=1e3)
    """Target of the factor of natural.curvature"""
    stretch: float | None = Field(default=None, ge=-1e3, le=1e3)
    """Target of the factor of natural.stretch less one"""

    @model_validator(mode="after")
    def _one_grows(self) -> Self:
        """Check that one of curvature and stretch grows, by a target or by `grows`."""
        growing_keys = {self.grows, *self._given_targets} - {None}
        if len(growing_keys) != 1:
            raise ValueError(
                "give curvature or stretch, the factor that it grows to, or without a target grows"
            )
        return self

    @property
    def grown_key(self) -> str:
        """The key of `natural` that grows: curvature or stretch."""
        return self.grows or "".join(self._given_targets)

    @property
    def amplitude(self) -> str:  # type: ignore[override]
        return f"natural_{self.grown_key}"

    @classmethod
    def steps_before_load(cls, context: Context) -> list[tuple[str, Step]]:
        """Return steps that let stretch and curvature grow to 1 before the only load of a case."""
        natural = context.section_of(NaturalSection)
        if natural is None:
            return []
        keys = [key for key in ("stretch", "curvature") if getattr(natural, key) is not None]
        return [("natural", cls.model_validate({"kind": "natural", key: 1.0})) for key in keys]

    def refuse_unfit(self, context: Context) -> None:
        if getattr(context.section_of(NaturalSection), self.grown_key, None) is None:
            raise ValueError(
                f"loading.{self.grown_key}: is a factor of natural.{self.grown_key}: give that too"
            )


class NaturalObservables(Observables):
    """The amplitudes of the natural shape."""

    quantities = (
        Quantity(
            "natural_curvature",
            "natural curvature",
            "Factor of the natural curvature; 0: as drawn.",
            "load",
        ),
        Quantity(
            "natural_stretch",
            "natural stretch",
            "Factor of the natural stretch less one; 0: as drawn.",
            "load",
        ),
    )

    def free_amplitudes(self, loads: "Loads") -> Mapping[str, float]:
        return dict.fromkeys(loads.natural.amplitudes if loads.natural else (), 0.0)

    def account(self, context: Context, loads: "Loads") -> Account:
        """Return the line of `magshell check` on the natural shape: what grows.

        A case without a natural shape has a line of what is left out.
        """
        if not loads.natural:
            return Account(left_out=["natural shape: as drawn"])
        names = " and ".join(name.removeprefix("natural_") for name in loads.natural.amplitudes)
        return Account([f"natural {names}: strains are measured from there"])

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        """Check that the surface has the patches with values of curvature and stretch.

        Raises
        ------
        MeshError
            With the name of a missing patch.
        """
        from magshell_fenicsx.models.shell.spatial_fields import (
            by_patch,
        )  # the solver takes long to import

        for key in ("curvature", "stretch"):
            if isinstance(values := getattr(loads.natural, key, None), Mapping):
                by_patch(values, surface.patches, len(surface.cells), f"natural.{key}")
