"""Fields on the surface of a shell: words, symbols and units, for pictures and the report.

The numbers of files, and of a case without units, are over the unit of each field. E_1, E_2, M_1,
M_2 are principal values of membrane strain and bending moment. F B^r is the remanence as the shell
carries it, B^a the applied field; magnetic loads are those of a uniform field. A hat marks a vector
over its largest length. Couples and springs are over the thickness at their place, so that they
have no unit where it varies.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import isnan

from magshell_fenicsx.quantities.quantity import (
    CONTACT_PRESSURE,
    THICKNESS,
    CaseSizes,
    Quantity,
    Unit,
    with_prefix,
)
from magshell_fenicsx.quantities.stresses import BENDING_MOMENT, STRESS

COUPLE = Unit(
    "h E λ_m", "N/m", "N_per_m", "N/m", lambda g: g.force_per_length * g.largest_field, symbol=""
)
MAGNETIC_PRESSURE = Unit("E λ_m", "Pa", "Pa", "Pa", lambda g: g.E * g.lambda_m)
SPRINGS = Unit("h E λ_m", "N/m", "N_per_m", "N/m", lambda g: g.force_per_length * g.lambda_m)
# of vectors, whose length is drawn
IN_PLANE_FORCE = replace(MAGNETIC_PRESSURE, size=lambda g: g.E * abs(g.lambda_m))
TORQUE = replace(SPRINGS, size=lambda g: g.force_per_length * abs(g.lambda_m))


def _field(name: str, words: str, symbol: str = "", *units: Unit) -> Quantity:
    """Return the quantity of a field; one without units is a pure number."""
    return Quantity(name, words, "", "field", symbol, units)


FIELDS = {
    field.name: field
    for field in (
        _field("w_over_h", "inward normal displacement", "w/h", THICKNESS),
        _field("E_1", "larger principal strain", "E_1"),
        _field("E_2", "smaller principal strain", "E_2"),
        _field("M_1", "larger principal moment", "M_1 R/D", BENDING_MOMENT),
        _field("M_2", "smaller principal moment", "M_2 R/D", BENDING_MOMENT),
        _field("stretch_1", "larger principal stretch", "λ_1"),
        _field("stretch_2", "smaller principal stretch", "λ_2"),
        _field("stretch_3", "stretch of the thickness", "λ_3"),
        _field("sigma_1", "true stress", "σ_1/E", STRESS),
        _field("sigma_2", "true stress", "σ_2/E", STRESS),
        _field("mises_top", "von Mises stress of the outer face", "", STRESS),
        _field("mises_middle", "von Mises stress of the middle", "", STRESS),
        _field("mises_bottom", "von Mises stress of the inner face", "", STRESS),
        _field("couple", "couple", "|F B̂^r × B̂^a|/(h E λ_m)", COUPLE),
        _field("p_mag", "magnetic pressure", "p_mag/(E λ_m)", MAGNETIC_PRESSURE),
        _field("f_mag", "in-plane force", "|f_mag|/(E λ_m)", IN_PLANE_FORCE),
        _field("k", "rotational springs", "k/(h E λ_m)", SPRINGS),
        _field("tau", "torque of gradients", "|τ(u)|/(h E λ_m)", TORQUE),
        _field("gap_over_h", "gap", "", THICKNESS),
        _field("contact_pressure", "contact pressure", "p R/(E h)", CONTACT_PRESSURE),
        _field("w0_over_h", "imperfections", "w_0/h", THICKNESS),
        _field("shell", "shell"),
    )
}


def in_case_unit(field: Quantity, sizes: CaseSizes, value: float) -> tuple[Quantity, float]:
    """Return a field in the unit of a case, and the size of a 1 of the field in that unit.

    The field itself and 1 are returned if it has no unit, or the case lacks what the unit needs.

    Parameters
    ----------
    sizes
        Sizes of the case at the state that is shown.
    value
        A number of the field, over its own unit, for which the prefix of the unit is chosen.

    Examples
    --------
    >>> sizes = CaseSizes(nu=0.5, R_over_h=100, R=0.01, E=2e6)
    >>> w, size = in_case_unit(FIELDS["w_over_h"], sizes, 3.0)
    >>> w.label, round(size, 6)
    ('inward normal displacement  $w$  (mm)', 0.1)
    >>> pressure, size = in_case_unit(FIELDS["contact_pressure"], sizes, 3.0)
    >>> pressure.label, round(size, 6)
    ('contact pressure  $p$  (kPa)', 20.0)
    """
    in_unit, (size,) = in_case_unit_along_path(field, [sizes], [value])
    return in_unit, size


def in_case_unit_along_path(
    field: Quantity, states: Sequence[CaseSizes], values: Sequence[float]
) -> tuple[Quantity, list[float]]:
    """Return a field in one unit for all states of a path, and the size of a 1 at each state.

    `states` are the sizes of the case there, `values` numbers of the field, as for `in_case_unit`.
    """
    for unit in field.units:
        sizes = [unit.size(state) for state in states]
        if any(map(isnan, sizes)):
            continue
        if unit.shown != unit.si:  # such as mm, which has a prefix
            return field.in_unit(unit), sizes
        largest = max(abs(size * value) for size, value in zip(sizes, values, strict=True))
        factor, prefixed_unit = with_prefix(largest, unit.si)
        return field.in_unit(replace(unit, shown=prefixed_unit)), [factor * size for size in sizes]
    return field, [1.0] * len(states)
