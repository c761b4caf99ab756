"""The registry of amplitudes and of columns of path.csv, in the order of the file.

Each column may have a second one in the units of a case. A quantity is a column with its words,
symbol and units; an amplitude is a load parameter that a path varies, and its conjugate the
displacement on which it does work. A family is a quantity or amplitude of which there may be
several: their names have an ending, such as a body's name.
"""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isnan, nan

from magshell_fenicsx.quantities.quantity import (
    DEGREES,
    DISTANCE,
    ENERGY,
    FIELD,
    MOMENT,
    PLACE,
    POINT_FORCE,
    PRESSURE,
    REACTION,
    SECOND_UNIT,
    STRENGTH,
    THICKNESS,
    TIME,
    TURN,
    VOLUME,
    Amplitude,
    CaseSizes,
    Kind,
    Quantity,
    Unit,
)
from magshell_fenicsx.quantities.stresses import stress_columns, stress_quantity

# Modes of the model itself in the column of modes; its symmetry excludes all others.
OWN_MODES = ("", "symmetric", "asymmetric")
LOAD_FACTOR = "load_factor"  # column of the factor of dead loads


def _energy(
    name: str, words: str, meaning: str, symbol: str = "", *, may_be_nan: bool = False
) -> Quantity:
    """Return the column of an energy over E h R²."""
    return Quantity(name, words, meaning, "energy", symbol, (ENERGY,), may_be_nan=may_be_nan)


def _w(name: str, note: str, meaning: str) -> Quantity:
    """Return the column of a displacement over h; `note` tells it from others."""
    return Quantity(name, "displacement", meaning, "displacement", "w/h", (THICKNESS,), note=note)


OF_EVERY_RUN = (
    Quantity("point", "point", "Number of the accepted point.", "count"),
    Quantity("label", "what", "start, field, step, target, fold, bifurcation or solution.", "text"),
    Quantity("amplitude", "varied", "The amplitude that varied.", "text"),
    Quantity(
        "p_over_pc",
        "pressure",
        "Live pressure, positive from outside, over p_c = 2E/√(3(1 - ν²)) (h/R)².",
        "load",
        "p/p_c",
        (PRESSURE,),
        stem="pressure",
    ),
    Quantity(
        "lambda_m",
        "field",
        "|Br||Ba|/(μ0 E), of a shell that is soft alone |Ba|/√(μ0 E), with the sign of the case; "
        "in SI the applied flux density.",
        "load",
        "λ_m",
        (FIELD, STRENGTH),
        stem="applied",
    ),
    Quantity(
        "force",
        "force",
        "Dead force of an indentation, positive inwards.",
        "load",
        "F R/(2πD)",
        (POINT_FORCE,),
        each=True,
    ),
    _w(
        "w_over_h",
        "",
        "Inward displacement at the force (its mean over a patch), along the dead loads, or else "
        "of the pole.",
    ),
    _w(
        "w_from_field_over_h",
        "since the field",
        "w_over_h minus its value at the end of the field.",
    ),
    _w(
        "w_pole_over_h",
        "of the pole",
        "Inward displacement of the pole, a disc's centre or a strip's tip; of the first named "
        "point if there is one.",
    ),
    Quantity(
        "volume_change",
        "change of volume",
        "Change of the volume under the shell, with rigid lids on closed edges that move; negative "
        "where it shrinks.",
        "displacement",
        "ΔV/R³",
        (VOLUME,),
        sign=-1.0,
    ),
    # a user-defined energy may be no number
    _energy("energy", "energy", "Π, the sum of all terms.", may_be_nan=True),
    Quantity(
        "negative_pivots",
        "unstable directions",
        "Number of unstable directions of the model, with all amplitudes fixed except those whose "
        "conjugate is held; at a fold, the number before it.",
        "count",
    ),
    Quantity(
        "negative_pivots_held",
        "unstable, w held",
        "The same number with the conjugate displacement fixed.",
        "count",
    ),
    Quantity("iterations", "iterations", "Iterations of Newton's method.", "count"),
    Quantity("factorisations", "factorisations", "Factorisations of the tangent.", "count"),
    Quantity("wall_s", "time", "Time since the start of the run.", "time", units=(SECOND_UNIT,)),
    _energy("stretching", "stretching", "Membrane energy; not of a solid.", may_be_nan=True),
    _energy(
        "bending",
        "bending",
        "Bending energy, including the edges; not of a solid.",
        may_be_nan=True,
    ),
    _energy("magnetic", "magnetic", "Magnetic energy."),
    _energy("U1", "first term", "First term of the approximate magnetic energies.", "U_1"),
    _energy(
        "Uq",
        "torques of rotations",
        "Torque term of the approximate magnetic energies, in rotations.",
        "U_q",
    ),
    _energy(
        "Utau",
        "torques of gradients",
        "Torque term of the approximate magnetic energies, in displacement gradients.",
        "U_τ",
    ),
    Quantity(
        "mode",
        "mode",
        "Mode of an instability: symmetric, asymmetric, m = 2, antisymmetric, ...",
        "text",
    ),
    Quantity(
        "field_angle",
        "field angle",
        "Angle by which the field has turned.",
        "load",
        units=(DEGREES,),
    ),
    Quantity(
        "branch",
        "branch",
        "0 is the path, 1 and 2 leave it at its first bifurcation; of a solution its number.",
        "count",
    ),
    _w("w_point_over_h", "of the loaded point", "Inward displacement of the loaded point itself."),
    Quantity(
        "error_over_h",
        "error of u",
        "Estimate of the algebraic error: the next Newton step; with errors: motion, that of steps "
        "in time.",
        "error",
        "",
        (THICKNESS,),
    ),
    Quantity(
        "load_error",
        "error of the load",
        "Estimate of the error of the amplitude at a located point.",
        "error",
    ),
    Quantity(
        "excluded_pivots",
        "unstable, excluded",
        "Number of unstable directions that the model's symmetry excludes.",
        "count",
    ),
    Quantity("step", "step", "Number of the programme's step; 0 is the start.", "count"),
)
IN_TIME = (  # of runs with a step of kind: time
    Quantity(
        "time",
        "time",
        "Time of the motion; in seconds, or the case's own unit, with shell.density.",
        "time",
        "t",
        (TIME,),
    ),
    _energy("kinetic", "kinetic", "Kinetic energy."),
    _energy(
        "stored", "stored", "Energy of the shell itself: all terms but the potentials of loads."
    ),
    _energy("dissipated", "dissipated", "Energy lost by drag and viscosity; none in static steps."),
    _energy(
        "work",
        "work",
        "Work of the loads in steps of kind: time, kinetic + stored + dissipated less what was "
        "stored.",
    ),
    _energy(
        "imbalance",
        "error of the balance",
        "Kinetic + stored + dissipated - work less its value where the step begins: what steps in "
        "time gain or lose.",
    ),
)
QUANTITIES = {q.name: q for q in (*OF_EVERY_RUN, *IN_TIME)}
AMPLITUDES = {
    a.name: a
    for a in (
        Amplitude(
            "pressure",
            "p_over_pc",
            "volume_change",
            critical_names=("knockdown", "buckling_pressure_Pa"),
        ),
        Amplitude("force", "force", "w_over_h", "at the load"),
        Amplitude("load", LOAD_FACTOR, "w_over_h", "along the loads"),
        Amplitude(
            "lambda_m",
            "lambda_m",
            components=("lambda_across", "lambda_third"),
            critical_names=("critical_field", "critical_field_mT"),
            history_name="field",
        ),
        Amplitude("angle", "field_angle", sideways=True, turned_load="lambda_m"),
        Amplitude("time", "time", sideways=True),
    )
}
# names of terms, and of amplitudes that only the solvers use
INTERNAL = ("push", "membrane", "couple")
# Names that neither a user-defined energy nor a factor may have.
RESERVED_NAMES = {*AMPLITUDES, *INTERNAL}
RESERVED_NAMES.update(name for a in AMPLITUDES.values() for name in a.components)


def register(quantities: Iterable[Quantity], amplitudes: Iterable[Amplitude] = ()) -> None:
    """Add the columns and amplitudes of a part of the program to the registry."""
    QUANTITIES.update({q.name: q for q in quantities})
    AMPLITUDES.update({a.name: a for a in amplitudes})


def register_for_all_cases(
    quantities: Iterable[Quantity], amplitudes: Iterable[Amplitude] = ()
) -> None:
    """Add columns and amplitudes that every case may have.

    User-defined energies and factors cannot have their names.
    """
    quantities, amplitudes = [*quantities], [*amplitudes]
    register(quantities, amplitudes)
    RESERVED_NAMES.update(column.name for q in quantities for column in (q, *q.in_units))
    RESERVED_NAMES.update(a.name for a in amplitudes)


register_for_all_cases(QUANTITIES.values())


def units_in_use() -> tuple[Unit, ...]:
    """Return the units of all columns, each once, also of those of supports and named points."""
    endings_of_points = (f"point_{ending}" for ending in stress_columns(has_stresses=True))
    columns = (*QUANTITIES.values(), *map(quantity, ("_ux", "_fx", "_mx", *endings_of_points)))
    return tuple(dict.fromkeys(unit for q in columns for unit in q.units))


def endings() -> dict[str, str]:
    """Return a mapping: ending of the name of a column in units -> the unit in words."""
    return {unit.ending: unit.shown for unit in units_in_use() if unit.ending}


def quantity(name: str) -> Quantity:
    """Return the quantity of a column of path.csv, also of one that is not registered.

    A name that tells no quantity is the factor of a motion or of a user's energy, which is a load.
    """
    factor = Quantity(name, name.replace("_", " "), "", "load", units=(DISTANCE, TURN))
    return told_quantity(name) or factor


def told_quantity(name: str) -> Quantity | None:
    """Return the quantity that the name of a dimensionless column tells; None if it tells none.

    Not registered are the columns of a second load ("force_2"), of its displacement
    ("w_force_2_over_h"), of one of several bodies, of the forces on a body ("ball_normal_force"),
    of the displacement, reaction or moment of a named place ("rim_ux"), and of a force, moment or
    stress at a point ("A_N11"). The factor of a motion or of a user's energy has any name.
    """
    if name in QUANTITIES:
        return QUANTITIES[name]
    # a second load, or its displacement
    if further_load := re.fullmatch(r"(force|load)_(\d+)", name):
        first_load = QUANTITIES[AMPLITUDES[further_load[1]].column]
        return replace(
            first_load,
            name=name,
            words=f"{first_load.words} {further_load[2]}",
            symbol=first_load.symbol and f"F_{further_load[2]} R/(2πD)",
        )
    if conjugate := re.fullmatch(r"w_((force|load)(_\d+)?)_over_h", name):
        return _w(
            name,
            f"at {conjugate[1].replace('_', ' ')}",
            f"Displacement conjugate to {conjugate[1]}, as w_over_h.",
        )
    if at_point := stress_quantity(name):
        return at_point
    # the amplitude of a second step of a kind
    if numbered_name := re.fullmatch(r"(\w+)_(\d+)", name):
        first_of_kind = QUANTITIES.get(numbered_name[1])
        if first_of_kind and first_of_kind.kind == "load":
            words = f"{first_of_kind.words} {numbered_name[2]}"
            return replace(first_of_kind, name=name, words=words, symbol="")
    # one of a family: of "approach_ball" it is "approach"; the longest name that fits is the right
    # one
    families = [q for q in QUANTITIES.values() if q.each and re.match(rf"{q.name}_[A-Za-z]", name)]
    if families:
        longest = max(families, key=lambda q: len(q.name))
        return longest.for_name(name.removeprefix(f"{longest.name}_"))
    if name.endswith("_normal_force"):  # of a body, and perhaps of one shell on it
        return Quantity(name, name.replace("_", " "), "", "reaction", units=(POINT_FORCE,))
    # of a named point, support or body: the displacement (u), force (f) or moment (m) along an axis
    kinds_and_units: dict[str, tuple[Kind, Unit]] = {
        "u": ("place", PLACE),
        "f": ("reaction", REACTION),
        "m": ("moment", MOMENT),
    }
    if ending := re.search(r"_([ufm])[xyz]$", name):
        kind, unit = kinds_and_units[ending[1]]
        return Quantity(name, name.replace("_", " "), "", kind, units=(unit,))
    return None


def is_column_of_numbers(name: str) -> bool:
    """Return whether a name tells a column of numbers in path.csv, in a unit or without.

    Examples
    --------
    >>> [is_column_of_numbers(name) for name in ("rim_mx", "rim_mx_N_m", "rim", "label")]
    [True, True, False, False]
    """
    if known_quantity := told_quantity(name):
        return known_quantity.kind != "text"
    if any(name == column.name for q in QUANTITIES.values() for column in q.in_units):
        return True
    # one that is not registered, in a unit: its name lost an "over_h" and has the unit's ending
    for ending in endings():
        words = name.removesuffix(f"_{ending}").split("_")
        places = range(1, len(words) + 1)
        over_h = ("_".join([*words[:i], "over_h", *words[i:]]) for i in places)
        for dimensionless in ("_".join(words), *over_h):
            candidate = told_quantity(dimensionless)
            if candidate and any(name == column.name for column in candidate.in_units):
                return True
    return False


def shown_quantity(name: str, columns: Collection[str]) -> Quantity:
    """Return the quantity of a column, in the case's units if `columns` has one in these.

    Parameters
    ----------
    name
        Name of the dimensionless column.
    columns
        Names of the columns that there are, for example a row of path.csv.
    """
    dimensionless = quantity(name)
    columns_in_units = (q for q in dimensionless.in_units if q.name in columns)
    return next(columns_in_units, dimensionless)


def amplitude(name: str) -> Amplitude:
    """Return the amplitude of a name: a load parameter that a path varies, with its columns.

    A second force or list of dead loads has its own columns: force_2 and w_force_2_over_h. A
    user-defined amplitude has a column of its own name.
    """
    if further_load := re.fullmatch(r"(force|load)_\d+", name):
        first_load = AMPLITUDES[further_load[1]]
        return Amplitude(name, column=name, conjugate=f"w_{name}_over_h", place=first_load.place)
    if name in AMPLITUDES:
        return AMPLITUDES[name]
    # one of a family, such as "approach_ball": its columns end in "_ball" too
    for family in AMPLITUDES.values():
        if family.each and name.startswith(f"{family.name}_"):
            suffix = name.removeprefix(family.name)
            column, conjugate = family.column + suffix, family.conjugate + suffix
            return replace(family, name=name, column=column, conjugate=conjugate)
    return Amplitude(name, name)


def field_columns() -> tuple[str, ...]:
    """Return the columns of the strengths of fields in space.

    Fields are a part of the shell's surroundings: they are shown beside the load that varies.
    """
    return tuple(a.column for a in AMPLITUDES.values() if a.components)


def principal(name: str) -> str:
    """Return the amplitude along the first direction of a load, of one of its components.

    Any other name is returned as it is.

    Examples
    --------
    >>> principal("lambda_across"), principal("pressure")
    ('lambda_m', 'pressure')
    """
    return next((a.name for a in AMPLITUDES.values() if name in a.components), name)


def axes_of(name: str, row: Collection[str] = ()) -> tuple[Quantity, Quantity]:
    """Return the quantities on the x and y axis of an amplitude's curve.

    They are its conjugate displacement and its value. An angle, the time and the factor of a motion
    are on the x axis, and the displacement or the reaction is on the y axis.

    Parameters
    ----------
    name
        Name of the amplitude.
    row
        Names of the columns that there are. Where w_over_h belongs to another load, this load has a
        column of its own; and the reaction of a motion may have one.
    """
    # a name that is not registered may be a motion of supports: against it stands its own
    # reaction, or that of the only motion
    reactions = sorted(q.name for q in QUANTITIES.values() if q.each and q.kind == "reaction")
    candidates = [*(f"{reaction}_{name}" for reaction in reactions), *reactions]
    if name not in AMPLITUDES:
        for reaction in candidates:
            if reaction in row:
                return shown_quantity(name, row), shown_quantity(reaction, row)
    # any other amplitude: its conjugate, in a column of its own if there is one
    varying, own_column = amplitude(name), f"w_{name}_over_h"
    conjugate = shown_quantity(own_column if own_column in row else varying.conjugate, row)
    value = shown_quantity(varying.column, row)
    if varying.conjugate == "w_over_h":  # the note says whose displacement it is
        conjugate = replace(conjugate, note=varying.place)
    return (value, conjugate) if varying.sideways else (conjugate, value)


@dataclass(frozen=True)
class Sizes:
    """Sizes of dimensionless numbers, or of numbers in SI, in the units of a case.

    Attributes
    ----------
    case_sizes
        Sizes that the case has with units; None without.
    moments
        Columns of reactions that are moments.
    distances
        Columns of motions -> the unit of their distance or angle, and its size.
    """

    case_sizes: CaseSizes | None = None
    moments: Collection[str] = ()
    distances: Mapping[str, tuple[Unit, float]] = field(default_factory=dict)

    @cached_property
    def by_unit(self) -> Mapping[str, float]:
        """Mapping: key of a unit -> its size, without those that the case lacks."""
        return {unit.key: size for unit in units_in_use() if (size := self._size(unit)) is not None}

    @property
    def field(self) -> str:
        """The unit of the applied field: mT, or % of the strength of its sources."""
        return (STRENGTH if self._size(STRENGTH) else FIELD).shown

    def _size(self, unit: Unit) -> float | None:
        """Return the size of a unit in this case; None if the case lacks it."""
        size = unit.size(self.case_sizes) if self.case_sizes and unit.ending else nan
        return None if isnan(size) else size

    def unit(self, name: str) -> Unit | None:
        """Return the unit of the column `name` in this case; None if it has none."""
        if name in self.distances:
            return self.distances[name][0]
        units = [unit for unit in quantity(name).units if self._size(unit) is not None]
        if name in self.moments:  # such a column has the unit of a force too
            units = [unit for unit in units if unit is MOMENT]
        return next(iter(units), None)

    def column(self, name: str) -> Quantity | None:
        """Return the column in units of the dimensionless column `name`; None if there is none."""
        unit = self.unit(name)
        return quantity(name).in_unit(unit) if unit else None

    def columns(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the names of the columns in units that dimensionless columns have in this case."""
        return tuple(in_unit.name for name in names if (in_unit := self.column(name)))

    def values(self, row: Mapping[str, float | int | str]) -> dict[str, float]:
        """Return the values of a row in the case's units, by the names of their columns."""
        values = {}
        for name in row:
            if unit := self.unit(name):
                column = quantity(name).in_unit(unit).name
                values[column] = float(row[name]) * self.size(name) + 0.0  # no -0
        return values

    def size(self, name: str) -> float:
        """Return the size, in the case's unit, of a 1 in the column `name`; 1 without a unit."""
        if name in self.distances:
            _, size = self.distances[name]
            return size
        unit = self.unit(name)
        return self.by_unit[unit.key] if unit else 1.0
