"""What `magshell identify` is given: measured columns as readings of a case, and numbers of it with
their priors.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.section import in_unit, number_and_unit
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.input.tables import GREATEST, TableError, TableRows, column_size, read_rows
from magshell_fenicsx.platform.reading import Files
from magshell_fenicsx.quantities.registry import QUANTITIES, endings
from magshell_fenicsx.simulate.gradients.instabilities import FOLDS, SCALES, refuse_unitless
from magshell_fenicsx.simulate.gradients.results import Expected, refuse_no_result
from magshell_fenicsx.simulate.gradients.vibration import NAMES
from magshell_fenicsx.simulate.numbers import number_of
from magshell_fenicsx.simulate.readings import Places, Reading
from magshell_fenicsx.simulate.results import differentiable
from magshell_fenicsx.studies.design_blocks import Number
from magshell_fenicsx.studies.identify_sections import Amount, CandidateSection, IdentifySection
from magshell_fenicsx.studies.points import value_at
from magshell_fenicsx.studies.runner import Case

Array = NDArray[np.float64]
HEADER = re.compile(r"\s*([\w.]+)\s*(?:[\[(]\s*([^\])]+?)\s*[\])])?\s*")
MOST_READINGS = 10_000
SHAPE, MOVED = (
    ("x", "y", "z"),
    ("ux", "uy", "uz"),
)  # columns of a shape: places, and what they are displaced by
OF_POINTS = "measured_"  # names of these places in the case


@dataclass(frozen=True)
class Parameter:
    """A number that is looked for, in its unit.

    Attributes
    ----------
    mean, deviation
        Of its prior; without one the deviation is infinite.
    """

    number: Number
    mean: float
    deviation: float

    @property
    def key(self) -> str:
        return self.number.name

    @property
    def unit(self) -> str:
        return self.number.unit

    @property
    def start(self) -> float:
        return float(self.number.start[0])


@dataclass(frozen=True)
class Column:
    """A measured result: its name in the file, and in the case's unit.

    Attributes
    ----------
    noise
        Its standard deviation in the case's unit; nan if it is to be estimated.
    """

    header: str
    of: str
    unit: str
    noise: float


@dataclass(frozen=True)
class Table:
    """What was measured.

    Attributes
    ----------
    columns
        The results.
    readings
        Settings of the case, as for `--set` -> readings, in the order of the data.
    data, column
        (n,) the numbers in the case's units, and which column each is of.
    places
        The column of the places; "" without.
    shape
        Name of a place of the shape -> where it is on the undeformed shell, in the unit of its
        displacements.
    missing
        Name of a column -> in how many rows it has no number.
    rows
        Settings -> the file and line of each reading, for messages.
    """

    columns: tuple[Column, ...]
    readings: Mapping[tuple[str, ...], list[Reading]]
    data: Array
    column: NDArray[np.int64]
    places: str
    shape: Mapping[str, list[float]] = field(default_factory=dict)
    missing: Mapping[str, int] = field(default_factory=dict)
    rows: Mapping[tuple[str, ...], list[str]] = field(default_factory=dict)


class Names:
    """The results of a case, and what its last step prescribes, by their names in a file."""

    def __init__(self, case: Case) -> None:
        self.scene = Expected(case.problem())
        try:
            self.places: Places | None = Places(self.scene)
        except CaseError:
            self.places = None

    def of(self, name: str, unit: str | None, where: str) -> tuple[str, str, float]:
        """The result of a name with a unit, the case's unit, and what one of that unit is in it.

        Raises
        ------
        CaseError
            If there is no such result, or a unit is missing.
        """
        scene = self.scene
        shown = {q.name: (base, q.si) for base in self._bare if (q := scene.sizes.column(base))}
        shown |= {of: (of, of.rpartition("_")[2]) for of in SCALES} | {"hertz_1": ("hertz_1", "Hz")}
        if unit is None:
            strange = name not in self._bare and name not in FOLDS
            near = next(
                (
                    of
                    for of, (base, si) in shown.items()
                    if (base == name and of.startswith(f"{name}_"))
                    or (strange and of == f"{name}_{si}")
                ),
                None,
            )
            if near and near != name:
                raise CaseError(f"{where}: {name}: has no unit: write {name} [{shown[near][1]}]")
            own = shown.get(name, ("", ""))[1]
            result = name
            factor = 1.0
        else:
            fitting = [
                of
                for of in shown
                if of == name or re.fullmatch(rf"{re.escape(name)}_[A-Za-z]\w*", of)
            ]
            if not fitting:
                raise CaseError(
                    f"{where}: {name}: has the unit {unit}, but no result of this name has one in this case"
                )
            result = min(fitting, key=len)
            own = shown[result][1]
            try:
                factor = column_size(name, unit, own)
            except TableError as e:
                raise CaseError(f"{where}: {e}") from None
        if self.places is None or result != self.places.column:
            refuse_no_result(scene, [result], where)
            if result in SCALES:
                refuse_unitless(scene, result)
        return result, own, factor

    @property
    def _bare(self) -> list[str]:
        scene = self.scene
        own = [self.places.bare] if self.places else []
        return [
            *own,
            *(name for name in differentiable(scene, scene.unloaded()) if name not in own),
        ]

    def refuse_strange(self, name: str, where: str) -> None:
        """See that a column of data may have a name, with or without its unit.

        Raises
        ------
        CaseError
            If no result has it.
        """
        units = [q.name for of in self._bare if (q := self.scene.sizes.column(of))]
        names = [
            *self._bare,
            *units,
            *FOLDS,
            *(of.rpartition("_")[0] for of in FOLDS if of in SCALES),
            *MOVED,
        ]
        if name not in names and not NAMES.fullmatch(name):
            raise CaseError(
                f"{where}: {name}: the case has no such result; allowed are {', '.join(names)}"
            )

    def amount(self, amount: Amount, of: str, where: str) -> float:
        """A number for a result, in its unit of the case.

        Raises
        ------
        CaseError
            If its unit is missing or another one.
        """
        number, unit = number_and_unit(str(amount))
        _, own, factor = self.of(of, None, where) if not unit else self._of_unit(of, unit, where)
        if own and not unit and float(number):
            raise CaseError(
                f"{where}: {_text(amount)}: needs a unit, such as {_text(amount)} {own}"
            )
        return float(number) * factor

    def _of_unit(self, of: str, unit: str, where: str) -> tuple[str, str, float]:
        result, own, _ = self.of(of, None, where)
        if not own:
            raise CaseError(f"{where}: {of} has no unit, so this number has none: {unit}")
        try:
            return result, own, column_size(of, unit, own)
        except TableError as e:
            raise CaseError(f"{where}: {e}") from None


def _text(amount: Amount) -> str:
    return amount if isinstance(amount, str) else f"{amount:g}"


def refuse_size(deviation: float, given: Amount, where: str) -> None:
    """See that a standard deviation is one, whose square is a number.

    Raises
    ------
    CaseError
        If it is not positive, or out of bounds.
    """
    if not deviation > 0:
        raise CaseError(f"{where}: must be positive, here {_text(given)}")
    if not 1 / GREATEST <= deviation <= GREATEST:
        raise CaseError(
            f"{where}: {_text(given)}: allowed are numbers from {1 / GREATEST:g} to {GREATEST:g}"
        )


def parameters_of(source: Source, case: Case, section: IdentifySection) -> tuple[Parameter, ...]:
    """The numbers that are looked for.

    Raises
    ------
    CaseError
        If a key has no number, or its prior another unit.
    """
    parameters = []
    for key, given in section.parameters.items():
        where = f"identify.parameters.{key}"
        try:
            number_of(case.context, key)
            start, unit = _written(source, case, key)
            mean, deviation = (
                _in_unit_of(unit, amount, key) for amount in (given.prior, given.deviation)
            )
        except CaseError as e:
            raise CaseError(f"{where}: {e}") from None
        if given.deviation is not None:
            refuse_size(deviation, given.deviation, f"{where}.deviation")
        prior = (mean, deviation) if given.prior is not None else (start, np.inf)
        parameters.append(Parameter(Number(key, np.array([start]), (0.0, 1.0), unit), *prior))
    return tuple(parameters)


def _written(source: Source, case: Case, key: str) -> tuple[float, str]:
    """A number of the case as it is written, and its unit."""
    written = value_at(source.data, key.split("."))
    number, unit = number_and_unit(str(written))
    return (float(number), unit) if number else (number_of(case.context, key), "")


def _in_unit_of(unit: str, amount: Amount | None, key: str) -> float:
    if amount is None:
        return np.nan
    try:
        if unit and not number_and_unit(str(amount))[1]:
            raise ValueError
        return in_unit(str(amount), unit)
    except ValueError:
        what = f"the unit {unit}" if unit else "no unit"
        raise CaseError(
            f"{_text(amount)}: the case gives {key} with {what}: so has its prior"
        ) from None


def with_shape(file: Path, source: Source) -> tuple[Source, list[str], dict[str, list[float]]]:
    """The case with the places of a measured shape as named points.

    Returns
    -------
    It, the name of each row's place, and where these are in the file's unit; the case itself and nothing without them.

    Raises
    ------
    CaseError
        If there are places without displacements, or these without places.
    """
    table = _rows_of(file)
    columns, units = table.columns, table.units
    where, there = f"--data {file}", [name for name in SHAPE if name in columns]
    if not there:
        return source, [], {}
    if len(there) < len(SHAPE) or not any(name in columns for name in MOVED):
        raise CaseError(
            f"{where}: a shape needs the columns {', '.join(SHAPE)} and of {', '.join(MOVED)} one or more"
        )
    rows: list[list[float]] = [
        list(map(float, row)) for row in np.column_stack([columns[name] for name in SHAPE])
    ]
    for axis in SHAPE:
        _refuse_missing(axis, columns[axis], table.lines, where)
    chosen = {tuple(row): f"{OF_POINTS}{i}" for i, row in reversed(list(enumerate(rows, 1)))}
    shape = {chosen[tuple(row)]: row for row in rows}
    texts = {
        name: [
            f"{v!r} {units[axis]}" if units[axis] else v for v, axis in zip(row, SHAPE, strict=True)
        ]
        for name, row in shape.items()
    }
    data = {**source.data, "points": {**(source.data.get("points") or {}), **texts}}
    varied = Source(source.name, data, source.places, source.folder, source.files)
    return varied, [chosen[tuple(row)] for row in rows], shape


def _rows_of(file: Path) -> TableRows:
    try:
        return read_rows(file, Files())
    except TableError as e:
        raise CaseError(f"--data {file}: {e}") from None


def _refuse_missing(name: str, values: Array, lines: Sequence[int], where: str) -> None:
    """See that a column that says what a row is of has a number in each."""
    for row in np.flatnonzero(np.isnan(values))[:1]:
        raise CaseError(f"{where}: line {lines[row]}: {name}: has a row without a number")


def refuse_twice(header: str, of: str, before: Mapping[str, str], where: str) -> None:
    """See that a column is of another result, or key, than those before it: headers by these.

    Raises
    ------
    CaseError
        With both headers.
    """
    alike = next((name for name in before if quantity_of(name) == quantity_of(of)), None)
    if alike is not None:
        raise CaseError(
            f"{where}: {before[alike]} and {header} are one measurement in two columns: leave one out"
        )


def quantity_of(result: str) -> str:
    """Return one name of what several results are, in units or without: of a fold its load.

    Examples
    --------
    >>> quantity_of("w_mm"), quantity_of("tip_ux_mm"), quantity_of("omega2_3")
    ('w_over_h', 'tip_ux', 'hertz_3')
    """
    if result in FOLDS:
        return f"fold of {FOLDS[result]}"
    if result.startswith("omega2_"):
        return result.replace("omega2_", "hertz_")
    for each in QUANTITIES.values():
        if any(result == in_units.name for in_units in each.in_units):
            return each.name
    ending = next((ending for ending in endings() if result.endswith(f"_{ending}")), "")
    return result.removesuffix(f"_{ending}")


def table_of(
    file: Path,
    case: Case,
    section: IdentifySection,
    rows: Sequence[str] = (),
    shape: Mapping[str, list[float]] | None = None,
) -> Table:
    """The measured columns; the points of the rows and their places are those of `with_shape`.

    Raises
    ------
    CaseError
        If a column is no result, has no unit, or the section names one that is not there.
    """
    rows_of_file = _rows_of(file)
    columns, units = rows_of_file.columns, rows_of_file.units
    names, where, taken = Names(case), f"--data {file}", dict[str, str]()
    at: Array = np.full(0, np.nan)
    keys, results = dict[str, tuple[str, Array]](), list[tuple[Column, Array]]()
    places = length = ""
    for header, values in columns.items():
        parts = HEADER.fullmatch(header)
        name, unit = (parts[1], parts[2] or units[header]) if parts else (header, None)
        if "." in name:
            refuse_twice(header, name, taken, where)
            _refuse_missing(header, values, rows_of_file.lines, where)
            keys[name], taken[name] = (unit or "", values), header
            continue
        if rows and name in SHAPE:
            continue
        moved = bool(rows) and name in MOVED
        of, own, factor = names.of(f"{rows[0]}_{name}" if moved else name, unit, where)
        refuse_twice(header, of, taken, where)
        taken[of] = header
        if names.places and of == names.places.column:
            _refuse_missing(header, values, rows_of_file.lines, where)
            at, places = values * factor, of
            continue
        noise = section.noise.get(name, section.noise.get(of))
        deviation = np.nan if noise is None else names.amount(noise, of, f"identify.noise.{name}")
        of = of.removeprefix(rows[0]) if moved else of
        length = own if moved else length
        if noise is not None:
            refuse_size(deviation, noise, f"identify.noise.{name}")
        results.append((Column(name, of, own, deviation), values * factor))
    if not results:
        raise CaseError(f"{where}: has no column with a result of this case")
    _refuse_unknown(section, [each for each, _ in results], where)
    table = _listed(results, keys, at, places, section, where, rows, rows_of_file.lines)
    sizes = (
        [column_size(axis, units[axis] or length, length) if length else 1.0 for axis in SHAPE]
        if shape
        else []
    )
    return replace(
        table,
        shape={
            name: [a * b for a, b in zip(at, sizes, strict=True)]
            for name, at in (shape or {}).items()
        },
    )


def _refuse_unknown(section: IdentifySection, columns: Iterable[Column], where: str) -> None:
    there = {name for each in columns for name in (each.header, each.of)}
    for key, named in (("noise", section.noise), ("changes", section.changes)):
        if strange := next((name for name in named if name not in there), None):
            raise CaseError(
                f"identify.{key}: {strange}: {where} has no such column, only {', '.join(sorted(there))}"
            )


def _listed(
    results: list[tuple[Column, Array]],
    keys: Mapping[str, tuple[str, Array]],
    at: Array,
    places: str,
    section: IdentifySection,
    where: str,
    points: Sequence[str],
    lines: Sequence[int],
) -> Table:
    """Rows as readings, those of the same settings together; an empty cell was not measured.

    `where` is the file, and `lines` are those of the rows in it, for messages.
    """
    readings, data = dict[tuple[str, ...], list[Reading]](), dict[tuple[str, ...], list[float]]()
    column, rows = dict[tuple[str, ...], list[int]](), dict[tuple[str, ...], list[str]]()
    for row in range(len(results[0][1])):
        settings = tuple(
            f"{key}={float(values[row])!r} {unit}".rstrip() for key, (unit, values) in keys.items()
        )
        place = float(at[row]) if places else None
        for number, (own, values) in enumerate(results):
            value = float(values[row])
            if np.isnan(value):
                continue
            bound = (
                place is not None
                and own.of not in FOLDS
                and not NAMES.fullmatch(own.of)
                and own.of != "barrier"
            )
            change = own.of in section.changes or own.header in section.changes
            of = f"{points[row]}{own.of}" if own.of.startswith("_") else own.of
            readings.setdefault(settings, []).append(Reading(of, place if bound else None, change))
            data.setdefault(settings, []).append(value)
            column.setdefault(settings, []).append(number)
            rows.setdefault(settings, []).append(f"{where}: line {lines[row]}")
    flat = np.array([value for each in data.values() for value in each])
    if not 0 < len(flat) <= MOST_READINGS or not np.isfinite(flat).all():
        raise CaseError(
            f"{where}: has {len(flat)} numbers; allowed are 1 to {MOST_READINGS}, all finite"
        )
    numbers = np.array([number for each in column.values() for number in each], dtype=np.int64)
    empty = {own.header: int(np.isnan(values).sum()) for own, values in results}
    missing = {header: count for header, count in empty.items() if count}
    return Table(
        tuple(own for own, _ in results),
        readings,
        flat,
        numbers,
        places,
        missing=missing,
        rows=rows,
    )


def refuse_unfit_section(source: Source, case: Case, section: IdentifySection) -> None:
    """See what can be seen of a section without data: that parameters are numbers and that results
    are there.

    Raises
    ------
    CaseError
        With the key.
    """
    parameters_of(source, case, section)
    names = Names(case)
    for key, named in (("noise", section.noise), ("changes", section.changes)):
        for name in named:
            names.refuse_strange(name, f"identify.{key}")
    for i, each in enumerate(section.candidates):
        candidate(names, each, f"identify.candidates.{i}")


def candidate(names: Names, section: CandidateSection, key: str) -> tuple[Reading, str, float]:
    """A further reading, its unit, and its noise.

    Raises
    ------
    CaseError
        If it is none.
    """
    of, unit, _ = names.of(section.of, None, f"{key}.of")
    noise = names.amount(section.noise, of, f"{key}.noise")
    refuse_size(noise, section.noise, f"{key}.noise")
    if section.at is None:
        return Reading(of), unit, noise
    if names.places is None:
        raise CaseError(
            f"{key}.at: the case has no last step that prescribes a load or a displacement"
        )
    return Reading(of, names.amount(section.at, names.places.column, f"{key}.at")), unit, noise
