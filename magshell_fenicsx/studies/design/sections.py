"""The section `design` of a case: what varies, and what is wanted.

A key is a path of words with dots into the case. A result is a number of a run, by name.
"""

from typing import Annotated, Self

from pydantic import Discriminator, Field, Tag, model_validator

from magshell_fenicsx.input.expressions import Formula
from magshell_fenicsx.input.section import Section, in_unit, number_and_unit

Point = Annotated[list[float], Field(min_length=3, max_length=3)]
Bounds = Annotated[list[float], Field(min_length=2, max_length=2)]
TextWithUnit = Annotated[str, Field(pattern=r"^\s*[-+]?\.?[0-9]", examples=["20 mT"])]
Amounts = Annotated[list[float | TextWithUnit], Field(min_length=2, max_length=2)]


class ShapeSection(Section):
    """Where each place should be at the end of the path: the mean square distance over the area is
    least there.
    """

    components: Annotated[list[Formula], Field(min_length=3, max_length=3)] | None = None
    """The wanted place as formulas of the undeformed x, y, z over R [R]"""
    curve: Annotated[list[Point], Field(min_length=3)] | None = None
    """Of a strip: points of the curve of its middle line from the root on, which a spline joins; it
    is scaled to the strip's length [any length]
    """
    stages: Annotated[int, Field(ge=1, le=50)] = 1
    """Of a curve: it is first wanted with 1/stages of its curvature, then with 2/stages, and so on.
    All but the last have a quarter of the iterations
    """

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        """Check that either components or a curve are given, and stages only with a curve."""
        if (self.components is None) == (self.curve is None):
            raise ValueError("give components or curve")
        if self.stages > 1 and self.curve is None:
            raise ValueError("stages: belong to a curve")
        return self


OBJECTIVE_KEYS = ("maximise", "minimise", "reach", "shape")
Results = Annotated[
    Annotated[str, Tag("one")] | Annotated[list[str], Tag("several"), Field(min_length=1)],
    Discriminator(lambda data: "several" if isinstance(data, list) else "one"),
]


class ObjectiveSection(Section):
    """One of its keys; the results are knockdown, critical_field (in units buckling_pressure_Pa,
    critical_field_mT), mass (over that of the thickness h everywhere), barrier, natural frequencies
    (omega2_1, omega2_2, ... as in frequencies.csv, or hertz_1, ...), or a column of path.csv where
    the path ends, such as force_N or a force of a support.
    """

    maximise: Results | None = None
    """A result; of several the least, so that they end equal where nothing else stops them"""
    minimise: str | None = None
    """A result"""
    reach: str | None = None
    """A result that should have `value`"""
    value: float | None = None
    """Of `reach`"""
    shape: ShapeSection | None = None
    """A shape"""

    @model_validator(mode="after")
    def _one_of_them(self) -> Self:
        """Check that exactly one objective is given, and `value` with `reach` alone."""
        given_keys = [key for key in OBJECTIVE_KEYS if getattr(self, key) is not None]
        if len(given_keys) != 1:
            raise ValueError(
                f"give one of maximise, minimise, reach and shape, here "
                f"{', '.join(given_keys) or 'none'}"
            )
        if (self.reach is None) != (self.value is None):
            raise ValueError("reach and value belong together")
        return self

    @property
    def result(self) -> str:
        """Name of the first result; "shape" for a shape."""
        return self.results[0]

    @property
    def results(self) -> list[str]:
        """Names of all results of the objective; several for `maximise` alone."""
        if isinstance(self.maximise, list):
            return self.maximise
        extreme_result = self.maximise or self.minimise
        reached_result = self.reach or "shape"
        return [extreme_result or reached_result]


class LimitSection(Section):
    """A result within bounds."""

    of: str
    """A result, as in the objective"""
    least: float | None = None
    """Its least value"""
    most: float | None = None
    """Its largest value"""
    same_as: str | None = None
    """Another result that it is equal to, to 1e-3"""

    @model_validator(mode="after")
    def _bounds(self) -> Self:
        """Check that a limit has a bound."""
        if all(bound is None for bound in (self.least, self.most, self.same_as)):
            raise ValueError(f"of: {self.of}: give least, most, both, or same_as")
        return self

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the results that are limited."""
        return (self.of, self.same_as) if self.same_as else (self.of,)


class RemanenceVariables(Section):
    """The vectors of the remanence at points, of which each place has a mean; see `kind: points` of
    the remanence.

    Their directions are free. On a meridian the points lie along it; on a strip along its middle,
    and vectors stay in the plane of x and z; elsewhere they are spread over the surface, and all of
    it is modelled.
    """

    points: Annotated[int, Field(ge=2, le=20_000)] | None = None
    """How many; without it those of `magnetic.remanent`, kind: points"""
    filter: float | None = Field(default=None, gt=0, le=10)
    """Nothing varies over less than this; by default the distance of the points [R]"""
    magnitude: Bounds | None = None
    """Least and largest length of a vector, 0 < least < largest <= 1; by default lengths stay as
    they are [|B^r|]"""
    steps: Annotated[int, Field(ge=2, le=360)] | None = None
    """At the end polar angles (and azimuths) are rounded to the nearest of so many steps of a turn
    """

    @model_validator(mode="after")
    def _magnitudes(self) -> Self:
        """Check the bounds of the lengths."""
        if self.magnitude and not 0 < self.magnitude[0] < self.magnitude[1] <= 1:
            raise ValueError(f"magnitude: needs 0 < least < largest <= 1, here {self.magnitude}")
        return self


class FieldVariables(Section):
    """The values of a field at points, of which each place has the mean, weighted by
    exp(-(distance/filter)²).

    In the best case the field is a formula of x, y, z.
    """

    points: Annotated[int, Field(ge=2, le=300)]
    """How many, spread as those of the remanence"""
    values: Bounds
    """Least and largest value"""
    filter: float | None = Field(default=None, gt=0, le=10)
    """Nothing varies over less than this; by default the distance of the points [R]"""

    @model_validator(mode="after")
    def _bounds(self) -> Self:
        """Check that the bounds are ordered."""
        if not self.values[0] < self.values[1]:
            raise ValueError(f"values: the first must be less than the second, here {self.values}")
        return self


class DesignSection(Section):
    """What `magshell design` varies, and for what; other commands take the case without it."""

    objective: ObjectiveSection
    """What is wanted"""
    numbers: dict[str, Amounts] = Field(default_factory=dict)
    """Key of the case with a number (`magnetic.remanent.polar`, `shell.poisson_ratio`) -> least and
    largest value, with units where the key has one: `magnetic.applied.flux_density: [-20 mT, 20
    mT]`
    """
    remanence: RemanenceVariables | None = None
    """Vectors of the remanence that vary"""
    thickness: FieldVariables | None = None
    """Factor of the thickness, which varies: `shell.thickness_factor` [h]"""
    curvature: FieldVariables | None = None
    """Natural curvatures 11 and 22, which vary: `natural.curvature` [1/R]"""
    deviation: FieldVariables | None = None
    """Deviation w0 of the shape outwards, which varies from zero on: one more of
    `shell.imperfections` [h]
    """
    constraints: list[LimitSection] = Field(default_factory=list)
    """Results that must stay within bounds"""
    iterations: int = Field(default=60, ge=1, le=10_000)
    """At most so many steps of the optimiser"""
    verify: float = Field(default=1.5, ge=1, le=10)
    """The result is run again with `mesh.refinement` times this number"""

    @model_validator(mode="after")
    def _something_varies(self) -> Self:
        """Check that something varies, and that all bounds are ordered and in one unit."""
        has_numbers_or_remanence = bool(self.numbers) or self.remanence is not None
        if not has_numbers_or_remanence and not self.fields:
            raise ValueError(
                "needs numbers, remanence, thickness, curvature or deviation: otherwise nothing "
                "varies"
            )
        if self.thickness and self.thickness.values[0] <= 0:
            raise ValueError("thickness: values: must be positive")
        for key, bounds_text in self.numbers.items():
            try:
                lower, upper, _ = self.bounds(key)
            except ValueError as e:
                raise ValueError(f"numbers: {key}: {e}") from None
            if not lower < upper:
                places = ", ".join(map(str, bounds_text))
                raise ValueError(
                    f"numbers: {key}: the first bound must be less than the second, here {places}"
                )
        return self

    def bounds(self, key: str) -> tuple[float, float, str]:
        """Return lower and upper bound of a number, and their unit.

        The unit is that of the first bound with a unit; "" without.

        Raises
        ------
        ValueError
            If one bound is not in that unit.
        """
        lower, upper = map(str, self.numbers[key])
        unit = number_and_unit(lower)[1] or number_and_unit(upper)[1]
        # zero needs no unit
        for bound_text in (lower, upper) if unit else ():
            if not number_and_unit(bound_text)[1] and bound_text not in ("0", "0.0"):
                raise ValueError(
                    f"{bound_text.removesuffix('.0')} has no unit: give both bounds one"
                )
        return in_unit(lower, unit), in_unit(upper, unit), unit

    @property
    def fields(self) -> dict[str, FieldVariables]:
        """Name -> section of the scalar fields that vary."""
        fields_that_vary = {
            "thickness": self.thickness,
            "curvature": self.curvature,
            "deviation": self.deviation,
        }
        return {name: section for name, section in fields_that_vary.items() if section}

    def key_of(self, result: str) -> str:
        """Return the first key below `design` that names a result, such as `constraints.0.of`."""
        if result in self.objective.results:
            return next(
                f"objective.{key}"
                for key in OBJECTIVE_KEYS
                if getattr(self.objective, key) is not None
            )
        named_limits = ((f"constraints.{i}", limit) for i, limit in enumerate(self.constraints))
        return next(
            f"{key}.{'of' if limit.of == result else 'same_as'}"
            for key, limit in named_limits
            if result in limit.names
        )

    @property
    def named_results(self) -> dict[str, str]:
        """Name -> key in the case, of all results but a wanted shape."""
        shape = ["shape"] if self.objective.shape else []
        return {
            result: f"design.{self.key_of(result)}"
            for result in self.results
            if result not in shape
        }

    @property
    def results(self) -> list[str]:
        """Names of all results that are computed; that of the objective is first."""
        limited = (name for limit in self.constraints for name in limit.names)
        return list(dict.fromkeys([*self.objective.results, *limited]))
