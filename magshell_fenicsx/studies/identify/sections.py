"""The section `identify` of a case: which numbers are looked for, what is known of them, what else
may be measured.
"""

import re
from typing import Annotated, Self

from pydantic import Field, model_validator

from magshell_fenicsx.input.section import Section
from magshell_fenicsx.studies.design.sections import TextWithUnit

Amount = float | TextWithUnit


def amount_text(amount: Amount) -> str:
    """Return an amount as a text for messages."""
    return amount if isinstance(amount, str) else f"{amount:g}"


class ParameterSection(Section):
    """What is known of a number before anything is measured: nothing, or its prior, a normal
    distribution.
    """

    prior: Amount | None = None
    """Its mean, in the unit of the key"""
    deviation: Amount | None = None
    """Its standard deviation, in the unit of the key"""

    @model_validator(mode="after")
    def _prior_with_deviation(self) -> Self:
        """Check that mean and deviation of a prior are given together."""
        if (self.prior is None) != (self.deviation is None):
            raise ValueError("prior and deviation belong together")
        return self


class RemanenceSection(Section):
    """The remanence as a field of numbers: components of vectors at points, of which each place has
    a mean.

    Points and components are those of a design: along a meridian, or along a strip in the plane of
    x and z, elsewhere spread over the surface, all of which is modelled. The prior has the case's
    own remanence as its mean and is smooth; what is not given of it is chosen by the data, so that
    these are most likely.
    """

    points: Annotated[int, Field(ge=2, le=1000)] | None = None
    """How many; without it those of `magnetic.remanent`, kind: points"""
    filter: float | None = Field(default=None, gt=0, le=10)
    """Nothing varies over less than this; by default the distance of the points [R]"""
    deviation: float | None = Field(default=None, gt=0, le=100)
    """Standard deviation of a component before anything is measured [|B^r|]"""
    length: float | None = Field(default=None, gt=0, le=100)
    """Distance over which the field is smooth: at 1.4 times of it the correlation is 0.3 [R]"""


class CandidateSection(Section):
    """A further result: it is predicted with its 95 % band, and as a measurement compared with the
    others.
    """

    of: str
    """A result: a column of path.csv, knockdown, critical_field_mT, omega2_1, hertz_1, barrier, ...
    """
    at: Amount | None = None
    """Where the last step is then: its load or displacement, as in the data; by default the end of
    the path
    """
    noise: Amount
    """Standard deviation of such a measurement"""


class ProgrammeSection(Section):
    """A case that is predicted with the parameters found: this one with other settings, or another
    case file.

    It is run at the fit and for parameters drawn from the posterior; between the quantiles of these
    runs lie 95 % of them. Motions, snaps and several steps are predicted too, as a run follows
    them.
    """

    case: str | None = None
    """Another case file, beside this one, which has the same keys; by default this case"""
    settings: list[str] = Field(default_factory=list)
    """Other values in that case, as for `--set`: `["loading.3.duration=2 s"]`"""
    data: str | None = None
    """A CSV file to compare with: columns of path.csv with units. The first one is the place, such
    as `time [s]` or `applied [mT]`; a column `step` has the number of the step, by default the last
    one. Between the points of a run it is read on straight lines
    """
    of: list[str] = Field(default_factory=list)
    """Further results: a column, along the last step; or a number, as of a sweep:
    `time_s@tip_uz_mm=-2`, `knockdown`
    """
    changes: list[str] = Field(default_factory=list)
    """Columns that are counted from the begin of their step on"""
    samples: int = Field(default=40, ge=20, le=10_000)
    """Runs with drawn parameters; of fewer than 20 none is as far out as a 95 % band"""

    @model_validator(mode="after")
    def _something_is_predicted(self) -> Self:
        """Check that a prediction has data or results."""
        if not (self.data or self.of):
            raise ValueError("give data, of, or both: nothing is predicted")
        return self


class IdentifySection(Section):
    """What `magshell identify` looks for; every other command takes the case without it.

    Each column of the data is a result of the case with its unit: `middle_uz [mm]` or
    `middle_uz_mm`. One column is what the last step prescribes, its load or displacement (`applied
    [mT]`, `w [mm]`); without it all is read where the path ends. Columns with the name of a key
    (`magnetic.applied.flux_density [mT]`) change the case from row to row. A shape has the columns
    `x`, `y`, `z`, places on the undeformed shell, and `ux`, `uy`, `uz`, their displacements.
    """

    parameters: dict[str, ParameterSection] = Field(default_factory=dict)
    """Key of the case with a number (`shell.youngs_modulus`, `magnetic.remanent.flux_density`) ->
    what is known of it: `{}`, or `{prior: 4.2 MPa, deviation: 0.2 MPa}`. It starts where the case
    has it
    """
    remanence: RemanenceSection | None = None
    """The remanence as a field that is looked for, beside the parameters or alone"""
    noise: dict[str, Amount] = Field(default_factory=dict)
    """Column of the data -> standard deviation of its noise; by default estimated from the
    residuals
    """
    changes: list[str] = Field(default_factory=list)
    """Columns of the data that are measured from the begin of the last step on"""
    candidates: list[CandidateSection] = Field(default_factory=list)
    """Results to predict, of which one may be measured next"""
    predict: dict[str, ProgrammeSection] = Field(default_factory=dict)
    """Name -> another history, or another case, that is predicted with the parameters found"""
    narrow: str | None = None
    """What the next measurement should narrow: a parameter, by default the one with the largest
    relative deviation; or `remanence`, the root mean square over all numbers of the field
    """
    steps: int = Field(default=20, ge=1, le=1000)
    """At most so many steps of Gauss-Newton"""

    @model_validator(mode="after")
    def _something_is_looked_for(self) -> Self:
        """Check that a parameter or a field is to be identified."""
        if not (self.parameters or self.remanence):
            raise ValueError("give parameters, remanence, or both: nothing is looked for")
        return self

    @model_validator(mode="after")
    def _names_are_words(self) -> Self:
        """Check that names of predictions can be parts of file names."""
        if invalid := next((name for name in self.predict if not re.fullmatch(r"\w+", name)), None):
            raise ValueError(
                f"predict: {invalid}: a name has letters, digits and _ alone, as files have it"
            )
        return self

    @model_validator(mode="after")
    def _narrowed_one_is_looked_for(self) -> Self:
        """Check that `narrow` names a parameter or the field."""
        allowed = [*self.parameters, *(["remanence"] if self.remanence else [])]
        if self.narrow is not None and self.narrow not in allowed:
            raise ValueError(
                f"narrow: {self.narrow}: is none of the parameters: {', '.join(allowed)}"
            )
        return self
