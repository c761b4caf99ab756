"""Rubbers of tests: those of the package, Ogden's fit to Treloar's, and Gent's, which the package
has not.
"""

from typing import Any

from gent import gent

from magshell_fenicsx.models.strain_energy import StrainEnergy
from magshell_fenicsx.parts.laws.mooney_rivlin import mooney_rivlin
from magshell_fenicsx.parts.laws.neo_hookean import neo_hookean

NEO_HOOKEAN = StrainEnergy(neo_hookean)
# R. W. Ogden, Proc. R. Soc. Lond. A 326, 1972: mu in MPa, as it is printed, and over E
MU, ALPHA = (0.63, 0.0012, -0.01), (1.3, 5.0, -2.0)
TRELOAR = tuple(mu / (1.5 * sum(m * a for m, a in zip(MU, ALPHA, strict=True))) for mu in MU), ALPHA


def mooney(share: float) -> StrainEnergy:
    """Rubber of Mooney and Rivlin with C01/(C10 + C01) = `share`."""
    return StrainEnergy(mooney_rivlin, (share,))


def stiffening(limit: float, share: float = 0.0) -> StrainEnergy:
    """Gent's rubber; with a share, Gent's logarithm of Mooney and Rivlin's energy."""

    def energy(first: Any, second: Any, limit: Any, share: Any) -> Any:
        return gent(6 * mooney_rivlin(first, second, share), second, limit)

    return StrainEnergy(energy, (limit, share))
