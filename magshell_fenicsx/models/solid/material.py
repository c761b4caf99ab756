"""The compressible neo-Hookean solid that a shell's E and nu stand for."""

from dataclasses import dataclass


@dataclass(frozen=True)
class NeoHookean:
    """W = mu/2 (J^(-2/3) F:F - 3) + kappa/2 (J - 1)^2, both moduli over Young's modulus.

    The law of Zhao et al. (J. Mech. Phys. Solids 124, 2019), whose elements the paper takes.

    Examples
    --------
    >>> NeoHookean.of(0.0, 100.0)
    NeoHookean(shear=0.5, bulk=0.3333333333333333)
    >>> rubber = NeoHookean.of(0.5, 100.0)
    >>> round(rubber.bulk / rubber.shear, 9), round(rubber.youngs_modulus, 5), round(rubber.nu, 5)
    (100.0, 0.99668, 0.49502)
    """

    shear: float
    bulk: float

    @classmethod
    def of(cls, nu: float, bulk_to_shear: float) -> "NeoHookean":
        """With Young's modulus 1 for small strains.

        For nu = 0.5 the shear modulus of the incompressible solid, 1/3, and `bulk_to_shear` times that: both
        Young's modulus and nu then fall short of their limits, by 1/(3 bulk_to_shear).
        """
        shear = 1 / (2 * (1 + nu))
        return cls(shear, bulk_to_shear * shear if nu == 0.5 else 1 / (3 * (1 - 2 * nu)))

    @property
    def youngs_modulus(self) -> float:
        """For small strains."""
        return 9 * self.bulk * self.shear / (3 * self.bulk + self.shear)

    @property
    def nu(self) -> float:
        """Poisson's ratio for small strains."""
        return (3 * self.bulk - 2 * self.shear) / (2 * (3 * self.bulk + self.shear))
