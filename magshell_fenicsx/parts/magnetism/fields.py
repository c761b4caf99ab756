"""The section `magnetic` of a case: the magnetisation of a shell and the applied field.

Out: checks of the section's keys against each other and against the case, the amplitude lambda_m,
and what the section adds to a model.

- lambda_m = |Br||Ba|/(mu_0 E) is the load parameter of the field, with the remanence Br, the
  applied flux density Ba and Young's modulus E. Without a remanence it is |Ba|/sqrt(mu_0 E).
- A shell is soft (soft-magnetic) if it has a susceptibility: a field magnetises it. It is soft
  alone if it has no remanence.
- Sources are magnets, coils and given fields, in tesla.
- Places are over R, the reference length of the shell; an outline is its undeformed shape.
- A `Context` is the case as a part sees it: its sections, steps and shell.
- "Refuse" means: raise an error with the key and what is allowed.
"""

from collections.abc import Iterable
from dataclasses import replace
from math import isnan, pi, sqrt
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from magshell_fenicsx.input.expressions import Formula, formula, formula_with_derivatives
from magshell_fenicsx.input.messages import shown_value
from magshell_fenicsx.input.section import Direction, FluxDensity, Section
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.parts.ability import Ability, Context, Formulas, Modelled
from magshell_fenicsx.parts.kinds import Sources
from magshell_fenicsx.parts.magnetism.remanent import RemanentSection, layer_average
from magshell_fenicsx.parts.revolution_sections import SurfaceSection
from magshell_fenicsx.parts.shell_sections import MeshSurface
from magshell_fenicsx.quantities.quantity import CaseSizes
from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

if TYPE_CHECKING:
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
MU_0 = 4e-7 * pi  # T m/A
SOURCE_TOLERANCE = 1e-9  # of the field's derivatives: rounding
MAX_FIELD_RATIO = 1e6  # of a field over its unit, as of a remanence
MAX_SUSCEPTIBILITY = 1e6  # of a susceptibility
MIN_LAMBDA, MAX_LAMBDA = (
    1e-12,
    10.0,
)  # of lambda_m: rounding, and a thousand times what destabilises a shell
FIELD = amplitude("lambda_m")  # the field's strength along its first direction
ANGLE = "angle"  # amplitude of a step that turns the field
# names of the dimensionless groups of a field -> their words: its strength, and that over h/R
GROUPS = {"lambda_m": "lambda_m", "Lambda_m": "Lambda_m = lambda_m R/h"}


class AppliedSection(Direction):
    """The applied flux density, uniform or linear in space: |B^a| (uniform b + gradient · r/R); or
    by formula.

    The unit vector b has the direction of polar and azimuth, r is the deformed place. The fields of
    sources are added.
    """

    flux_density: FluxDensity | None = Field(default=None, ge=-1e3, le=1e3)
    """|B^a|, at most 1000 T; with that of `remanent` in place of lambda_m; negative: the field is
    reversed"""
    uniform: float = Field(default=1.0, ge=-1e3, le=1e3)
    """Factor of the uniform part [|B^a|]"""
    gradient: list[list[Annotated[float, Field(ge=-1e3, le=1e3)]]] | None = Field(
        default=None, min_length=3, max_length=3
    )
    """Three rows of three numbers; energy: full alone has it [|B^a|/R]"""
    components: list[Formula] | None = Field(default=None, min_length=3, max_length=3)
    """Formulas of the deformed position x, y, z over R, in place of the other keys. On a shell the
    position is that of the mid-surface. They are written as those of `remanent`, must be twice
    differentiable, and need energy: full [|B^a|]"""
    sources: Sources | None = None
    """Magnets, coils, and fields on grids or by formulas, in tesla; without `flux_density` they are
    the whole field, |B^a| is 1 T, and λ_m is in proportion. They need lengths with units and
    energy: full"""

    @model_validator(mode="after")
    def _beside_sources(self) -> Self:
        """Refuse a field beside sources without a strength, and sources of the same name."""
        other_keys = {
            "polar",
            "azimuth",
            "uniform",
            "gradient",
            "components",
        } & self.model_fields_set
        has_sources_alone = bool(self.sources) and self.flux_density is None
        if has_sources_alone and other_keys:
            raise ValueError(
                f"{', '.join(sorted(other_keys))}: of a field beside the sources: give its "
                "flux_density too"
            )
        names = [source.name for source in self.sources or [] if source.name is not None]
        if repeated := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"sources: {repeated}: two of them have this name")
        return self

    @model_validator(mode="after")
    def _square(self) -> Self:
        """Refuse keys beside `components`, a gradient of a wrong shape, and a zero field."""
        if self.components and (
            other_keys := {"polar", "azimuth", "uniform", "gradient"} & self.model_fields_set
        ):
            raise ValueError(
                f"components are the whole field: leave out {', '.join(sorted(other_keys))}"
            )
        if self.gradient and any(len(row) != 3 for row in self.gradient):
            raise ValueError("gradient is three rows of three numbers")
        if self.uniform == 0 and not self.gradient:
            raise ValueError("uniform: 0 needs a gradient")
        return self

    @property
    def is_uniform(self) -> bool:
        """Whether the applied field is the same everywhere."""
        return not any((self.gradient, self.components, self.sources))

    @property
    def reference(self) -> float | None:
        """|B^a| in T, with its sign; 1 T where sources are the whole field, None if not given."""
        return (self.flux_density or 1.0) if self.sources else self.flux_density

    @property
    def has_field_beside_sources(self) -> bool:
        """Whether there is a field beside that of the sources."""
        return bool(self.flux_density) if self.sources else True


def _of_places(value: Any) -> Any:
    """Return the value of the key `susceptibility`, unchanged, after checking it.

    Allowed are a number from 0 to `MAX_SUSCEPTIBILITY`, a formula, or a mapping of patches to such
    numbers.

    Raises
    ------
    ValueError
        With what is allowed.
    """
    if isinstance(value, str):
        formula(value)
    elif isinstance(value, dict) and not value:
        raise ValueError("a mapping names at least one patch")
    else:
        for number in value.values() if isinstance(value, dict) else [value]:
            is_number = isinstance(number, int | float) and not isinstance(number, bool)
            if not is_number or not 0 <= number <= MAX_SUSCEPTIBILITY:
                raise ValueError(
                    f"{number!r}: allowed are numbers from 0 to {MAX_SUSCEPTIBILITY:g}, and "
                    "formulas of x, y, z"
                )
    return value


Susceptibility = Annotated[
    float | str | dict[str, float],
    BeforeValidator(_of_places, json_schema_input_type=float | str | dict[str, float]),
]


class MagneticSection(Section, Ability):
    """lambda_m, or both flux densities (and shell.youngs_modulus).

    A shell with a susceptibility and without `remanent` is soft alone: λ_m = |B^a|/√(μ0 E), or
    applied.flux_density.

    Energies: full, exact; first, torque and second are the paper's expansions in the displacement;
    second_consistent has the couple too that they leave out. See docs/theory.md.
    """

    energy: Literal["full", "first", "torque", "second", "second_consistent"] = "full"
    """The full magnetic energy, or an expansion"""
    remanence: Literal["deformation", "rotation"] = "deformation"
    """How B^r moves with the material: by F, which stretches it too (the paper's law), or by the
    rotation of F alone"""
    lambda_m: float | None = Field(default=None, ge=-10, le=10)
    """λ_m = |B^r||B^a|/(μ0 E); negative: the field is reversed; 0: no magnetic term"""
    susceptibility: Susceptibility | None = None
    """χ of a soft-magnetic shell, whose magnetisation follows the field as that of a thin sheet: a
    number, a formula of the undeformed place x, y, z over R, or a mapping of patches, and `rest`,
    to numbers. Beside a remanence it needs flux densities, and always energy: full"""
    saturation: FluxDensity | None = Field(default=None, gt=0, le=1e3)
    """The largest polarisation μ0 M of what is soft, by Langevin's law; left out, it grows in
    proportion to the field. It needs a susceptibility and flux densities"""
    interaction: Literal["none", "others", "all"] = "none"
    """Whether parts that are not connected, several shells or those of a mesh file, act on each
    other with their own fields (others), each part and any one shell on itself too (all), or feel
    the applied field alone (none). It needs remanent.flux_density and shell.youngs_modulus"""
    remanent: RemanentSection | None = RemanentSection.model_construct()
    """What is magnetised for good; left out, a shell with a susceptibility has nothing of it"""
    applied: AppliedSection = AppliedSection.model_construct()
    """The field"""

    @model_validator(mode="before")
    @classmethod
    def _soft_alone(cls, data: Any) -> Any:
        """Set `remanent` to none if a susceptibility is given and this key is not.

        So a soft shell has no remanence by default, and any other shell has one along e3.
        """
        if not isinstance(data, dict):
            return data
        if data.get("susceptibility") is not None and "remanent" not in data:
            return {**data, "remanent": None}
        return data

    @model_validator(mode="after")
    def _what_is_soft(self) -> Self:
        """Refuse combinations of keys that a soft-magnetic material does not allow."""
        if self.remanent is None and self.susceptibility is None:
            raise ValueError(
                "remanent: none is of a shell with a susceptibility: give that, or leave remanent "
                "out"
            )
        is_soft_in_tesla = self.susceptibility is not None and self.lambda_m is None
        if self.saturation is not None and not is_soft_in_tesla:
            raise ValueError(
                "saturation: is of a shell with a susceptibility in a field in tesla: give "
                "susceptibility and applied.flux_density (or sources), without lambda_m"
            )
        if self.susceptibility is not None and self.energy != "full":
            raise ValueError(
                f"energy: {self.energy}: the expansions are of a remanence: susceptibility needs "
                "full"
            )
        is_soft_with_remanence = self.susceptibility is not None and bool(self.remanent)
        if is_soft_with_remanence and self.lambda_m is not None:
            raise ValueError(
                "susceptibility: beside a remanence lambda_m does not say how strong the field "
                "is: give remanent.flux_density and applied.flux_density"
            )
        return self

    @model_validator(mode="after")
    def _what_acts(self) -> Self:
        """Refuse an interaction with keys that it does not allow.

        Only parts with a remanence that moves with F act on each other, in the full energy.
        """
        if self.interaction == "none":
            return self
        excluded = {
            "remanent: none": self.remanent is None,
            "susceptibility": self.susceptibility is not None,
            "remanence: rotation": self.remanence == "rotation",
            f"energy: {self.energy}": self.energy != "full",
        }
        if reason := next((key for key, is_given in excluded.items() if is_given), None):
            raise ValueError(
                f"interaction: {self.interaction}: not with {reason}: it is that of parts with a "
                "remanence alone, with remanence: deformation and energy: full"
            )
        return self

    @model_validator(mode="after")
    def _one_amplitude(self) -> Self:
        """Refuse keys that give the strength of the field twice, not at all, or as zero.

        It is given by lambda_m, or by both flux densities.
        """
        if self.remanent is None:
            self._one_field()
            return self
        densities = [self.remanent.flux_density, self.applied.reference]  # None where not given
        if self.lambda_m is not None and self.applied.sources:
            raise ValueError(
                "sources are in tesla: give remanent.flux_density in place of lambda_m"
            )
        if self.lambda_m is not None and densities != [None, None]:
            raise ValueError(
                "give lambda_m, or the flux densities of remanent and applied, not both"
            )
        if self.model_fields_set == {"remanence"}:
            raise ValueError(
                "remanence: is a law of a field, and there is none: give lambda_m or flux "
                "densities too"
            )
        strength_is_unknown = self.lambda_m is None and None in densities
        if strength_is_unknown and not self.without_field:
            raise ValueError("give lambda_m, or remanent.flux_density and applied.flux_density")
        if self.remanent.flux_density == 0:
            raise ValueError(
                "a remanence of length zero is no magnetisation: leave the section out"
            )
        if not self.applied.is_uniform and self.energy != "full":
            raise ValueError(
                "the approximate energies are of uniform fields; gradient, components and sources "
                "need energy: full"
            )
        return self

    @property
    def without_field(self) -> bool:
        """Whether the case has a remanence and no applied field.

        So it is if the section has `remanent`, and neither lambda_m nor `applied`: such a shell is
        only read by sensors, or its parts act on each other.
        """
        keys_given = self.model_fields_set
        has_remanence = self.remanent is not None and "remanent" in keys_given
        has_field = self.lambda_m is not None or "applied" in keys_given
        return has_remanence and not has_field

    def _one_field(self) -> None:
        """Refuse keys of a remanence for a shell that is soft alone."""
        if self.lambda_m is not None and self.applied.reference is not None:
            raise ValueError(
                "give lambda_m, or the flux density (or the sources) of applied, not both"
            )
        if self.lambda_m is None and self.applied.reference is None:
            raise ValueError("give lambda_m, or applied.flux_density; the shell is soft alone")
        if self.model_fields_set & {"remanence"}:
            raise ValueError("remanence: is a law of remanent, which this shell has not")

    def amplitude(self, youngs_modulus: float | None) -> float:
        """Return lambda_m = |Br||Ba|/(mu_0 E), or |Ba|/sqrt(mu_0 E) without a remanence.

        It is 0 without an applied field. `youngs_modulus` is in Pa.

        Raises
        ------
        ValueError
            If lambda_m follows from flux densities, and there is no modulus.
        """
        if self.lambda_m is not None:
            return self.lambda_m
        if self.without_field:
            return 0.0
        assert self.applied.reference is not None
        if youngs_modulus is None:
            raise ValueError("shell.youngs_modulus is needed to turn flux densities into lambda_m")
        return self.applied.reference / self.tesla(youngs_modulus)

    def apart_from_strength(self) -> dict[str, Any]:
        """Return the section as plain data, without keys that change the field's strength alone."""
        data = self.model_dump(mode="json")
        del data["lambda_m"]
        # beside a remanence, the ratio to it counts of a susceptibility: its flux density stays
        if self.remanent and self.susceptibility is None:
            del data["remanent"]["flux_density"]
        # beside sources, the applied flux density is that of a further field, and stays
        if not self.applied.sources:
            del data["applied"]["flux_density"]
        return data

    @staticmethod
    def with_strength(value: float) -> dict[str, float | None]:
        """Return keys of a case -> values that give its field a strength.

        None stands for a flux density that is not given, as the strength replaces it.
        """
        flux_densities = ("magnetic.remanent.flux_density", "magnetic.applied.flux_density")
        return {f"magnetic.{FIELD.name}": value, **dict.fromkeys(flux_densities)}

    def tesla(self, youngs_modulus: float) -> float:
        """Return the applied flux density (T) of lambda_m = 1; the modulus is in Pa."""
        if self.remanent is None:
            return sqrt(MU_0 * youngs_modulus)
        assert self.remanent.flux_density is not None
        return MU_0 * youngs_modulus / self.remanent.flux_density

    def refuse_unfit(self, context: Context) -> None:
        """Refuse a field of unknown strength, and shells that the magnetic energies do not allow.

        The energy `full` without interaction is allowed for all shells and solids.

        Raises
        ------
        ValueError
            With the key and what is allowed.
        """
        from magshell_fenicsx.parts.magnetism.sensors import is_read  # it needs this section

        shell = context.shell
        # units and strength of the field
        self.amplitude(shell.youngs_modulus)  # raises if the strength is unknown
        if self.applied.sources and not shell.with_units:
            raise ValueError(
                "magnetic.applied.sources: are in metres and tesla: give youngs_modulus and the "
                "shell's lengths units"
            )
        by_densities = self.lambda_m is None and not self.without_field
        lacks_units = isinstance(shell, SurfaceSection) and not shell.with_units
        if by_densities and lacks_units:
            raise ValueError(
                "magnetic: flux densities need shell.youngs_modulus in pascals: give "
                "youngs_modulus and lengths units, or lambda_m"
            )
        is_unread = self.without_field and not is_read(context)
        if is_unread and self.interaction == "none":
            raise ValueError(
                "magnetic: give lambda_m, or remanent.flux_density and applied.flux_density"
            )
        # what the energies need of the shell
        if self.interaction != "none":
            context.needs(
                f"magnetic.interaction: {self.interaction}",
                "the whole shell",
                "a mid-surface",
                "a thickness that does not change",
            )
        if self.energy != "full":
            energy_key = f"magnetic.energy: {self.energy}"
            context.needs(
                energy_key,
                "a mid-surface",
                "a thickness that does not change",
                hint="or give energy: full",
            )
        if self.remanent:
            _refuse_unfit_remanence(self.remanent, context)

    def patches(self) -> dict[str, Iterable[str]]:
        """Return the keys that have values by patch -> names of the patches."""
        values = {
            "magnetic.remanent.patches": self.remanent and self.remanent.patches,
            "magnetic.susceptibility": self.susceptibility,
        }
        return {key: value for key, value in values.items() if isinstance(value, dict)}

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return constraints that leave a model only the symmetries that magnetism preserves.

        The list is empty if no field acts on the shell, nothing magnetic is read, and parts do not
        act on each other. Parts that do exclude an axisymmetric model.
        """
        from magshell_fenicsx.parts.magnetism.interaction import has_effect
        from magshell_fenicsx.parts.magnetism.magnetisation import (
            remanence_constraints,
        )  # the solver takes long to import

        # this constraint has only a reason why the problem is not axisymmetric
        interacting = (
            [] if self.interaction == "none" else [SymmetryConstraint("parts act on each other")]
        )
        is_visible = has_effect(context)
        return interacting + (remanence_constraints(context, outline) if is_visible else [])

    def formulas(self, context: Context) -> Iterable[Formulas]:
        """Yield the formulas of the undeformed place, with the range of values that is allowed."""
        from magshell_fenicsx.models.shell.spatial_fields import (
            MAX_COMPONENT,
        )  # the solver takes long to import

        if self.remanent and isinstance(self.remanent.components, list):
            yield Formulas(
                "magnetic.remanent.components",
                self.remanent.components,
                minimum=-MAX_COMPONENT,
                maximum=MAX_COMPONENT,
                length=1.0,  # places are over R
            )
        if isinstance(self.susceptibility, str):
            yield Formulas(
                "magnetic.susceptibility",
                [self.susceptibility],
                minimum=0.0,
                maximum=MAX_SUSCEPTIBILITY,
                length=1.0,  # places are over R
            )

    def contribution(self, context: Context, modelled: Modelled) -> "Loads":
        from magshell_fenicsx.parts.magnetism.magnetisation import (
            contribution,
        )  # the solver takes long to import

        return contribution(context, modelled)

    def refuse_unfit_values(self, context: Context, places: Array) -> None:
        """Check lambda_m, and the values of sources and formulas at places (n, 3) over R.

        Raises
        ------
        CaseError
            With the key and the first place of a value that is not finite or too large.
        """
        from magshell_fenicsx.parts.magnetism.interaction import refuse_unfit_interaction

        refuse_unfit_interaction(context)
        lambda_m = strength(context)
        # with sources lambda_m is that of 1 T, and sources make less than 1 T on a shell
        largest = MAX_LAMBDA * (100.0 if self.applied.sources else 1.0)
        if lambda_m and not MIN_LAMBDA <= abs(lambda_m) <= largest:
            raise CaseError(
                f"magnetic: lambda_m is {lambda_m:.4g}; allowed are 0 and, of either sign, "
                f"{MIN_LAMBDA:g} to {largest:g}"
            )
        _refuse_unfit_sources(context, places)
        self._refuse_unfit_formulas(places)

    def _refuse_unfit_formulas(self, places: Array) -> None:
        """Refuse formulas of remanence and applied field without a finite value, or above 1e6.

        They are evaluated at places (n, 3) over R.

        Raises
        ------
        CaseError
            With the key and the first place of such a value.
        """
        components = {
            "remanent": self.remanent and self.remanent.components,
            "applied": self.applied.components,
        }
        keys_and_formulas = [
            (key, text)
            for key, texts in components.items()
            if isinstance(texts, list)
            for text in texts
        ]
        for key, text in keys_and_formulas:
            bad_places = places[~(np.abs(formula(text)(*places.T)) <= 1e6)]
            if len(bad_places):
                x, y, z = bad_places[0]
                raise CaseError(
                    f"magnetic.{key}.components: {shown_value(text)}: has no finite value (or one "
                    f"above 1e6) at (x, y, z) = ({x:.3g}, {y:.3g}, {z:.3g})"
                )

    def warning(self, context: Context, places: Array) -> str | None:
        """Return a warning if the formula of the applied field has a divergence or a curl.

        The field of magnets and currents elsewhere has neither. The formula is sampled at `places`
        (n, 3) over R. None if there is no such formula, or both vanish to rounding.
        """
        components = self.applied.components if strength(context) else None
        if not components:
            return None
        # gradient as [component, coordinate, place]; the curl is the skew part, by its norm
        G = np.stack([formula_with_derivatives(text)(places).gradient for text in components])
        divergence = np.nan_to_num(np.abs(np.trace(G)))
        curl = np.nan_to_num(np.linalg.norm(G - G.swapaxes(0, 1), axis=(0, 1)) / np.sqrt(2))
        largest_divergence, largest_curl = float(divergence.max()), float(curl.max())
        rounding = SOURCE_TOLERANCE * np.nan_to_num(np.abs(G)).max()
        if max(largest_divergence, largest_curl) <= rounding:
            return None
        x, y, z = places[np.argmax(np.maximum(divergence, curl))]
        return (
            "magnetic.applied.components: on the shell div B is up to "
            f"{largest_divergence:.3g} and curl B up to {largest_curl:.3g} B^a/R, most of it at "
            f"(x, y, z) = ({x:.3g}, {y:.3g}, {z:.3g}): magnets and currents elsewhere make no "
            "such field"
        )

    def numbers(self, context: Context) -> list[str]:
        """Return a line of `magshell check` with the strength (mT) of all sources on the shell.

        A user sees there if a source was placed in a wrong unit. The list is empty without sources.
        """
        from magshell_fenicsx.parts.magnetism.sources.field import (
            placed_sources,
        )  # the solver takes long to import
        from magshell_fenicsx.parts.shell_outline import outline

        if not (sources := placed_sources(context)):
            return []
        # values of sources are over the applied field's reference (T)
        places, unit = outline(context.shell).sample(), 1e3 * abs(self.applied.reference or 1.0)
        B = np.sum([source(places)[0] for source in sources], axis=0)
        strengths = unit * np.linalg.norm(B, axis=1)
        return [
            f"field of the sources on the undeformed shell: {strengths.min():.4g} to "
            f"{strengths.max():.4g} mT"
        ]

    def with_field(self, context: Context, units: CaseSizes) -> CaseSizes:
        """Return the units of a case, with the physical size of lambda_m = 1 added where known.

        It is a flux density in mT (`applied`). If sources are the whole field, it is their strength
        in percent of the strength in the case (`strength`).
        """
        if isnan(units.E) or self.without_field:
            return units
        remanence_is_known = self.remanent is None or bool(self.remanent.flux_density)
        if not remanence_is_known:
            return units
        if self.applied.has_field_beside_sources:
            return replace(units, applied=1e3 * self.tesla(units.E))
        return replace(units, strength=100 / strength(context))


def _refuse_unfit_remanence(remanent: RemanentSection, context: Context) -> None:
    """Refuse a remanence that the case's shell or solid does not allow."""
    if isinstance(remanent.components, UserField):
        context.needs("magnetic.remanent", "a mid-surface", hint="of a solid give formulas")
    # of a layered remanence a shell has the average over the thickness alone, a solid has all
    layers = remanent.layers
    if layers and not context.solid:
        size_of_average = np.linalg.norm(layer_average(layers))
        if size_of_average < 1e-9:
            raise ValueError(
                "magnetic.remanent.layers: the layers cancel: their average is a remanence of "
                "length zero, and a shell knows no more of them"
            )
    lacks_rest = remanent.patches is not None and "rest" not in remanent.patches
    if lacks_rest and not isinstance(context.shell, MeshSurface):
        raise ValueError("magnetic.remanent: patches needs the patch rest")


def strength(context: Context) -> float:
    """Return lambda_m of a case; 0 without a field."""
    magnetic = context.section_of(MagneticSection)
    return magnetic.amplitude(context.shell.youngs_modulus) if magnetic else 0.0


def dimensionless_groups(context: Context, R_over_h: float) -> dict[str, float]:
    """Return name -> value of the groups of `GROUPS`; they are 0 without a field."""
    value = strength(context)
    return dict(zip(GROUPS, (value, value * R_over_h), strict=True))


def _refuse_unfit_sources(context: Context, places: Array) -> None:
    """Refuse sources whose field is not finite, or too strong, at places (n, 3) over R.

    Raises
    ------
    CaseError
        With the key of the source and the first such place.
    """
    from magshell_fenicsx.parts.magnetism.sources.field import (
        placed_sources,
    )  # the solver takes long to import

    for source in placed_sources(context):
        B, *_ = source(places)
        is_finite = np.isfinite(B).all(axis=1)
        is_too_strong = (np.abs(B) > MAX_FIELD_RATIO).any(axis=1)
        # values that are not finite have another message
        strong_places = places[is_finite & is_too_strong]
        if len(strong_places):
            x, y, z = strong_places[0]
            raise CaseError(
                f"{source.key}: its field is above {MAX_FIELD_RATIO:g} times the unit of the "
                f"field at (x, y, z)/R = ({x:.3g}, {y:.3g}, {z:.3g})"
            )
        bad_places = places[~is_finite]
        if len(bad_places):
            x, y, z = bad_places[0]
            raise CaseError(
                f"{source.key}: the shell's point (x, y, z)/R = ({x:.3g}, {y:.3g}, {z:.3g}) "
                f"{source.nowhere}; see its position"
            )
