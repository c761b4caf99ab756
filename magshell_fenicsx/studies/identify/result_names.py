"""Names of the results of a case, as columns of measured data and sections give them.

A fold is a result that is a critical load (`FOLDS`: name -> load; `SCALES` has those with a unit).
An amount is a number, or text with a unit. A location is the key or file with which an error
message begins.
"""

import re
from collections.abc import Mapping

from magshell_fenicsx.input.section import number_and_unit
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.input.tables import (
    TableError,
    column_size,
)
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS, SCALES, refuse_unitless
from magshell_fenicsx.simulate.gradients.results import NamesOnlyScene, refuse_no_result
from magshell_fenicsx.simulate.gradients.vibration import NAMES
from magshell_fenicsx.simulate.readings import PrescribedQuantity
from magshell_fenicsx.simulate.results import differentiable
from magshell_fenicsx.studies.identify.sections import Amount, amount_text
from magshell_fenicsx.studies.points import Case

DISPLACEMENTS = ("ux", "uy", "uz")  # columns of a measured shape


class ResultNames:
    """Names of the results of a case, and of the quantity that its last step prescribes.

    Attributes
    ----------
    scene
        A scene without mesh, which knows names and units alone.
    places
        The load or displacement of the last step; None if there is none.

    `_dimensionless_names` are the names of all results without a unit.
    """

    def __init__(self, case: Case) -> None:
        """Make a scene without mesh for a case, and find the quantity of its last step."""
        self.scene = NamesOnlyScene(case.problem())
        try:
            self.places: PrescribedQuantity | None = PrescribedQuantity(self.scene)
        except CaseError:
            self.places = None

    def result_of(self, name: str, unit: str | None, location: str) -> tuple[str, str, float]:
        """Find the result of the case that a name and a unit in the data mean.

        Parameters
        ----------
        unit
            Unit of the data; None for a bare number.
        location
            Key or file with which messages begin.

        Returns
        -------
        result
            Name of the result in the case, such as `w_mm` for `w` in m.
        case_unit
            Unit of the result; "" if it has none.
        factor
            Size of `unit` in `case_unit`, by which data are multiplied.

        Raises
        ------
        CaseError
            If there is no such result, or a unit is missing or of another dimension.
        """
        units_by_result = self._units_by_result()
        if unit is None:
            self._refuse_missing_unit(name, units_by_result, location)
            _, case_unit = units_by_result.get(name, ("", ""))
            result, factor = name, 1.0
        else:
            # the result itself, or the name with a unit behind it
            fitting = [
                result_name
                for result_name in units_by_result
                if result_name == name
                or re.fullmatch(rf"{re.escape(name)}_[A-Za-z]\w*", result_name)
            ]
            if not fitting:
                raise CaseError(
                    f"{location}: {name}: has the unit {unit}, but no result of this name has one "
                    "in this case"
                )
            result = min(fitting, key=len)  # the name with nothing but a unit behind it
            _, case_unit = units_by_result[result]
            try:
                factor = column_size(name, unit, case_unit)
            except TableError as e:
                raise CaseError(f"{location}: {e}") from None
        # what the last step prescribes gives the place of a reading, and is no result
        if self.places is None or result != self.places.column:
            refuse_no_result(self.scene, [result], location)
            if result in SCALES:
                refuse_unitless(self.scene, result)
        return result, case_unit, factor

    def _units_by_result(self) -> dict[str, tuple[str, str]]:
        """Return name of a result in units of the case -> its dimensionless name, and its unit.

        Critical loads and frequencies in units have no other name here: "buckling_pressure_Pa" ->
        ("buckling_pressure_Pa", "Pa").
        """
        units_by_result = {
            q.name: (dimensionless_name, q.si)
            for dimensionless_name in self._dimensionless_names
            if (q := self.scene.sizes.column(dimensionless_name))
        }
        units_by_result |= {
            result_name: (result_name, result_name.rpartition("_")[2]) for result_name in SCALES
        } | {"hertz_1": ("hertz_1", "Hz")}
        return units_by_result

    def _refuse_missing_unit(
        self, name: str, units_by_result: Mapping[str, tuple[str, str]], location: str
    ) -> None:
        """Check that a name without a unit does not mean a result with one.

        In a case with units "w" would mean "w_mm", and "buckling_pressure" would mean
        "buckling_pressure_Pa".

        Parameters
        ----------
        units_by_result
            Name of a result in units of the case -> its dimensionless name, and its unit.

        Raises
        ------
        CaseError
            With the unit that is missing.
        """
        is_unknown = name not in self._dimensionless_names and name not in FOLDS

        def is_name_with_unit(result_name: str) -> bool:
            """Return whether the name becomes that of a result with a unit behind it."""
            dimensionless_name, unit = units_by_result[result_name]
            if dimensionless_name == name and result_name.startswith(f"{name}_"):
                return True
            return is_unknown and result_name == f"{name}_{unit}"

        name_with_unit = next(filter(is_name_with_unit, units_by_result), None)
        if name_with_unit and name_with_unit != name:
            _, unit = units_by_result[name_with_unit]
            raise CaseError(f"{location}: {name}: has no unit: write {name} [{unit}]")

    @property
    def _dimensionless_names(self) -> list[str]:
        """Names of all results without a unit; that of what the last step prescribes is first."""
        scene = self.scene
        place_names = [self.places.dimensionless_column] if self.places else []
        results = differentiable(scene, scene.unloaded())
        return [*place_names, *(name for name in results if name not in place_names)]

    def refuse_strange(self, name: str, location: str) -> None:
        """Check that a name of a column of data is a result of the case, with or without its unit.

        Raises
        ------
        CaseError
            If no result has the name.
        """
        names_in_units = [
            q.name for name in self._dimensionless_names if (q := self.scene.sizes.column(name))
        ]
        names = [
            *self._dimensionless_names,
            *names_in_units,
            *FOLDS,
            # critical loads without their unit
            *(base_name.rpartition("_")[0] for base_name in FOLDS if base_name in SCALES),
            *DISPLACEMENTS,
        ]
        if name not in names and not NAMES.fullmatch(name):
            raise CaseError(
                f"{location}: {name}: the case has no such result; allowed are {', '.join(names)}"
            )

    def amount(self, amount: Amount, result: str, location: str) -> float:
        """Return an amount (a number, or text with a unit) in the unit of a result in the case.

        Raises
        ------
        CaseError
            If the unit is missing or of another dimension.
        """
        number, unit = number_and_unit(str(amount))
        # unit of the result in the case, and the factor from `unit` to it; 1 without a unit
        _, case_unit, factor = (
            self._result_in_another_unit(result, unit, location)
            if unit
            else self.result_of(result, None, location)
        )
        lacks_unit = case_unit and not unit
        if lacks_unit and float(number):  # zero needs no unit
            text = amount_text(amount)
            raise CaseError(f"{location}: {text}: needs a unit, such as {text} {case_unit}")
        return float(number) * factor

    def _result_in_another_unit(
        self, result_name: str, unit: str, location: str
    ) -> tuple[str, str, float]:
        """Return a result, its unit in the case, and the size of another unit in this unit.

        The name is that in the case, which may end with the case's unit: "w_mm".

        Raises
        ------
        CaseError
            If the result has no unit, or one of another dimension.
        """
        result, case_unit, _ = self.result_of(result_name, None, location)
        if not case_unit:
            raise CaseError(
                f"{location}: {result_name} has no unit, so this number has none: {unit}"
            )
        try:
            return result, case_unit, column_size(result_name, unit, case_unit)
        except TableError as e:
            raise CaseError(f"{location}: {e}") from None
