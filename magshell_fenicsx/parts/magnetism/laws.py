"""The magnetic terms of each law of the remanence and each energy."""

from magshell_fenicsx.models.shell import densities
from magshell_fenicsx.models.shell.densities import MagneticDensity
from magshell_fenicsx.models.shell.parameters import MagneticEnergy, RemanenceLaw
from magshell_fenicsx.parts.magnetism import rotation_law

LINEAR = ("U1", "couple")
FULL: dict[RemanenceLaw, MagneticDensity] = {"deformation": densities.magnetic, "rotation": rotation_law.magnetic}
_EXPANDED: dict[RemanenceLaw, dict[str, MagneticDensity]] = {
    "deformation": {
        "U1": densities.magnetic_first,
        "Uq": densities.magnetic_torque,
        "Utau": densities.magnetic_tau,
        "couple": densities.magnetic_couple,
    },
    "rotation": {
        "U1": rotation_law.magnetic_first,
        "Uq": rotation_law.magnetic_torque,
        "Utau": rotation_law.magnetic_tau,
        "couple": densities.magnetic_couple,
    },
}
_TERMS: dict[MagneticEnergy, tuple[str, ...]] = {
    "first": ("U1",),
    "torque": ("Uq",),
    "second": ("U1", "Uq", "Utau"),
    "second_consistent": ("U1", "Uq", "Utau", "couple"),
}


def magnetic_densities(law: RemanenceLaw, energy: MagneticEnergy) -> dict[str, MagneticDensity]:
    """Name of the term -> its density, linear in the applied field."""
    if energy == "full":
        return {"magnetic": FULL[law]}
    return {name: _EXPANDED[law][name] for name in _TERMS[energy]}
