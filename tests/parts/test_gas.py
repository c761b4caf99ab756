"""A gas that is closed in under a shell, by Boyle's law."""

from dataclasses import replace

import pytest

from magshell_fenicsx.parts.pressure.pressure import EnclosedGas
from magshell_fenicsx.parts.shell_sections import ShellSection
from magshell_fenicsx.parts.step_course import GasSection

STEP = 1e-6  # of the differences


def test_derivatives_by_the_state_where_it_is_closed_in() -> None:
    """Those of the law by the conjugate and by the pressure there: its differences."""
    gas = EnclosedGas(
        section=GasSection(ambient_over_pc=5.0, volume=2.0),
        shell=ShellSection(geometry="hemisphere", radius_to_thickness=100.0, poisson_ratio=0.5),
        classical_pressure=1e-4,
        unit=0.3,
        pressure=0.4,
        conjugate=0.05,
    )
    by_conjugate, by_pressure = gas.by_begin(0.7)
    assert by_conjugate == pytest.approx(difference(gas, "conjugate"), rel=1e-7)
    assert by_pressure == pytest.approx(difference(gas, "pressure"), rel=1e-7)


def difference(gas: EnclosedGas, name: str) -> float:
    """Return the derivative of the conjugate at p = 0.7 p_c by a number of the gas."""
    value = getattr(gas, name)
    above, below = (replace(gas, **{name: value + step}).law()(0.7)[0] for step in (STEP, -STEP))
    return (above - below) / (2 * STEP)
