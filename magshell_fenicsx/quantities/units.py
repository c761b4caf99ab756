"""The sizes of a case's units, and the columns that a case with units has beside the dimensionless ones."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from math import pi, sqrt

from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import quantity


@dataclass(frozen=True)
class Sizes:
    """What one of a dimensionless number, or of a number in SI, is in the units that are shown.

    Attributes
    ----------
    of
        Scale (`Quantity.scale`) -> size; without an entry a quantity has no unit.
    field
        Unit of the field: mT, or % of the sources.
    moments
        Columns of reactions that are moments.
    """

    of: Mapping[str, float] = field(default_factory=dict)
    field: str = "mT"
    moments: Collection[str] = ()

    def column(self, name: str) -> Quantity | None:
        """The column in units for a dimensionless one; None if there is none."""
        known = quantity(name)
        if known.scale not in self.of or known.kind == "text":
            return None
        choice = {"λ_m": self.field, "reaction": "N m" if name in self.moments else "N"}
        unit = choice.get(known.scale)
        return next(each for each in known.in_units if unit in (None, each.unit))

    def columns(self, names: Iterable[str]) -> tuple[str, ...]:
        """The columns in units for some columns."""
        return tuple(found.name for name in names if (found := self.column(name)))

    def values(self, row: Mapping[str, float | int | str]) -> dict[str, float]:
        """The values of a row in units."""
        found = ((name, self.column(name)) for name in row)
        return {to.name: float(row[name]) * self.of[quantity(name).scale] + 0.0 for name, to in found if to}


def sizes(
    nu: float,
    R_over_h: float,
    *,
    R: float | None = None,
    E: float | None = None,
    per_lambda: float | None = None,
    in_seconds: bool = False,
) -> dict[str, float]:
    """Scale -> size in the units shown.

    Parameters
    ----------
    R, E
        Radius (m) and Young's modulus (Pa) of a case with units.
    per_lambda
        Applied flux density (mT), or strength of the sources (%), of lambda_m = 1.
    in_seconds
        Whether times are in seconds.

    Examples
    --------
    >>> found = sizes(0.5, 90, R=0.0252, E=1.8e6)
    >>> f"{found['p_c']:.4f} Pa, {found['h']:.3f} mm, {found['2πD/R']:.5f} N"
    '296.2963 Pa, 0.280 mm, 0.00109 N'
    """
    found = {}
    if E is not None:
        found["p_c"] = 2 * E / sqrt(3 * (1 - nu**2)) / R_over_h**2
    if R is not None:
        found |= {"h": 1e3 * R / R_over_h, "R³": 1e9 * R**3, "place": 1e3}
    if R is not None and E is not None:
        h = R / R_over_h
        found |= {"2πD/R": pi * E * h**3 / (6 * (1 - nu**2) * R), "E h R²": 1e3 * E * h * R**2}
        found |= {"E h/R²": E * h / R**2, **dict.fromkeys(("reaction", "moment", "force", "work"), 1.0)}
    if per_lambda is not None:
        found["λ_m"] = per_lambda
    if in_seconds:
        found["t"] = 1.0
    return found
