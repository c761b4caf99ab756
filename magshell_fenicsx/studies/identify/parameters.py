"""Parameters of an identification: numbers of the case with their priors.

A prior is what is known of a parameter before: mean and standard deviation. An amount is a number,
or text with a unit. A location is the key with which an error message begins.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.section import in_unit, number_and_unit
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.input.tables import (
    MAX_MEASURED_NUMBER,
)
from magshell_fenicsx.simulate.perturbation import number_at_key
from magshell_fenicsx.studies.design.blocks import NumberVariable
from magshell_fenicsx.studies.identify.sections import Amount, IdentifySection, amount_text
from magshell_fenicsx.studies.points import Case, value_at

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Parameter:
    """A number of the case that is to be identified, with its prior.

    Attributes
    ----------
    number
        Key, unit and value at the start.
    mean, deviation
        Mean and standard deviation of the prior, in the unit of the number. Without a prior the
        mean is the value at the start, and the deviation is infinite.
    """

    number: NumberVariable
    mean: float
    deviation: float

    @property
    def key(self) -> str:
        """Dotted key of the number in the case file."""
        return self.number.name

    @property
    def unit(self) -> str:
        """Unit in which the case gives the number; "" for a bare number."""
        return self.number.unit

    @property
    def start(self) -> float:
        """Value in the case file, in `unit`."""
        return float(self.number.start[0])


def parameters_of(source: Source, case: Case, section: IdentifySection) -> tuple[Parameter, ...]:
    """Return the parameters of an `identify` section, with their starts and priors.

    Raises
    ------
    CaseError
        If a key has no number, or its prior another unit.
    """
    parameters = []
    for key, parameter_section in section.parameters.items():
        location = f"identify.parameters.{key}"
        try:
            number_at_key(case.context, key)  # raises an error if there is no number
            start, unit = _number_as_written(source, case, key)
            # of the prior, in the unit of the number; nan without a prior
            mean, deviation = (
                _in_unit_of(unit, amount, key)
                for amount in (parameter_section.prior, parameter_section.deviation)
            )
        except CaseError as e:
            raise CaseError(f"{location}: {e}") from None
        if parameter_section.deviation is not None:
            refuse_size(deviation, parameter_section.deviation, f"{location}.deviation")
        if parameter_section.prior is None:
            mean, deviation = start, np.inf
        # a variable of a design is scaled with its bounds: with 0 and 1 it is the number itself
        number = NumberVariable(key, start=np.array([start]), bounds=(0.0, 1.0), unit=unit)
        parameters.append(Parameter(number, mean, deviation))
    return tuple(parameters)


def _number_as_written(source: Source, case: Case, key: str) -> tuple[float, str]:
    """Return the number at a key in the unit of the case file, and this unit ("" without).

    A default, which the file does not give, is taken from the validated case.
    """
    text = value_at(source.data, key.split("."))
    number, unit = number_and_unit(str(text))
    return (float(number), unit) if number else (number_at_key(case.context, key), "")


def _in_unit_of(unit: str, amount: Amount | None, key: str) -> float:
    """Return an amount of a prior in a unit; nan for None.

    Parameters
    ----------
    unit
        Unit of the number in the case; "" for a bare number.
    key
        Key of the number, for the message.

    Raises
    ------
    CaseError
        If the amount has no such unit.
    """
    if amount is None:
        return np.nan
    try:
        _, unit_of_amount = number_and_unit(str(amount))
        if unit and not unit_of_amount:
            raise ValueError
        return in_unit(str(amount), unit)
    except ValueError:
        expected = f"the unit {unit}" if unit else "no unit"
        raise CaseError(
            f"{amount_text(amount)}: the case gives {key} with {expected}: so has its prior"
        ) from None


def refuse_size(deviation: float, text: Amount, location: str) -> None:
    """Check that a standard deviation is positive and that its square is a floating-point number.

    Parameters
    ----------
    text
        The deviation as written in the case, for messages.

    Raises
    ------
    CaseError
        If it is not positive, or out of bounds.
    """
    if not deviation > 0:
        raise CaseError(f"{location}: must be positive, here {amount_text(text)}")
    if not 1 / MAX_MEASURED_NUMBER <= deviation <= MAX_MEASURED_NUMBER:
        raise CaseError(
            f"{location}: {amount_text(text)}: allowed are numbers from "
            f"{1 / MAX_MEASURED_NUMBER:g} to {MAX_MEASURED_NUMBER:g}"
        )
