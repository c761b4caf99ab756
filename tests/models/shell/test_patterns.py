"""Magnetisation patterns and gradients on the swelling hemisphere, u = e r0, and under translation:
closed forms.
"""

import numpy as np
import pytest
from conftest import hemisphere

from magshell_fenicsx.input.expressions import formula
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.spatial_fields import (
    Components,
    Pattern,
    WithinRims,
    radial,
    tangential,
)
from magshell_fenicsx.parts.imperfections.dimple import AT_POLE, Dimple
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionGeometry
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.magnetism.remanent import Layer, layer_average
from magshell_fenicsx.shells.shell import ShellModel

UP = np.array([0.0, 0, 1])
SIZE = 0.02


def model(
    remanent: Pattern | np.ndarray, gradient: np.ndarray | None = None, circle: float | None = None
) -> ShellModel:
    surface = hemisphere(0.3, dimple=Dimple(0.0, circle) if circle else None)
    return ShellModel(
        surface,
        Material(0.3, 0.05),
        3,
        {},
        Loads(magnetic=Magnetisation(remanent, UP, "full", gradient)),
    )


def swelling(of: ShellModel) -> float:
    """The energy over the size: -Ba . (I - n n) Br integrated."""
    return of.system.potential(SIZE * of.r0.x.array, {}, "lambda_m") / SIZE


def test_radial_stays_radial() -> None:
    assert swelling(model(radial)) == pytest.approx(0.0, abs=1e-5)


def test_tangential() -> None:
    """-Ba . t = sin phi, integrated: pi^2/2."""
    assert swelling(model(tangential)) == pytest.approx(np.pi**2 / 2, rel=1e-3)


def test_expression_of_position() -> None:
    """Br = z e3: -z (1 - z^2) integrated: -pi/2."""
    pattern = Components([formula("0"), formula("0*y"), formula("z")])
    assert swelling(model(pattern)) == pytest.approx(-np.pi / 2, rel=1e-4)


def test_patches_jump_at_the_rim() -> None:
    """Reversed within phi_o: the uniform energy less twice the cap's, 2 pi (2/3 - c + c^3/3)."""
    phi_o = 0.6
    c = np.cos(phi_o)
    uniform = -2 * np.pi * 2 / 3
    cap = -2 * np.pi * (2 / 3 - c + c**3 / 3)
    cap_only = ImperfectionGeometry(Dimple(0.0, phi_o), distance=AT_POLE, reach=phi_o)
    jumps = WithinRims(((cap_only.is_within_rim, -UP),), UP)
    assert swelling(model(jumps, circle=phi_o)) == pytest.approx(uniform - 2 * cap, rel=1e-4)


def test_layers_count_by_their_average() -> None:
    """B0 averages over the thickness: a fifth reversed leaves three fifths."""
    layers = [Layer(fraction=0.8), Layer(fraction=0.2, polar=180.0)]
    average = layer_average(layers)
    assert average == pytest.approx(0.6 * UP, abs=1e-12)
    assert swelling(model(average)) == pytest.approx(0.6 * swelling(model(UP)), rel=1e-12)


def test_gradient_pulls_a_rigid_shell() -> None:
    """A translation t gains -(G t) . Br per area: the body force of a constant gradient."""
    G = np.array([[-0.5, 0.2, 0.1], [0.2, -0.7, 0.3], [0.1, 0.3, 1.2]])
    Br, t = np.array([0.6, 0.0, 0.8]), np.array([0.3, -0.2, 0.5])
    shell = model(Br, G)
    found = shell.system.potential(np.tile(t, shell.system.size // 3), {}, "lambda_m")
    assert found == pytest.approx(-(G @ t) @ Br * 2 * np.pi, rel=1e-4)


@pytest.mark.parametrize(
    "text",
    ["x +", "__import__('os')", "x.real", "a", "x if y else z", "'x'", "(lambda: 1)()", "x[0]"],
)
def test_only_arithmetic_is_a_formula(text: str) -> None:
    with pytest.raises(ValueError, match=r"formula|allowed are numbers"):
        formula(text)


def test_operations_are_those_of_python() -> None:
    x, y, z = np.array([[0.3], [-0.7], [1.9]])
    for text in (
        "2 - x - y",
        "z / x / 2",
        "2 ** x ** y",
        "-x ** 2",
        "arctan2(x, -y) - +sqrt(z)",
        "(x - y) * (z - 1)",
    ):
        names = {"x": x, "y": y, "z": z, "sqrt": np.sqrt, "arctan2": np.arctan2}
        assert formula(text)(x, y, z) == eval(text, names)


@pytest.mark.parametrize("terms", [900, 4000])
def test_long_sums(terms: int) -> None:
    """The terms i x of a series add up to n (n - 1)/2 x; a table of a field may be as long."""
    found = formula(" + ".join(f"{i}*x" for i in range(terms)))(
        np.array([0.5]), np.zeros(1), np.zeros(1)
    )
    assert found == pytest.approx(terms * (terms - 1) / 4, rel=1e-12)
    assert formula("-" * terms + "x")(np.ones(1), np.zeros(1), np.zeros(1)) == 1.0


def test_brackets_within_each_other() -> None:
    """As many as Python reads; more, or longer sums than it reads, are refused with the reason."""
    assert formula("(" * 199 + "x" + ")" * 199)(np.ones(1), np.zeros(1), np.zeros(1)) == 1.0
    with pytest.raises(ValueError, match="allowed are 200 brackets within each other"):
        formula("(" * 300 + "x" + ")" * 300)
    with pytest.raises(ValueError, match="is too long: allowed are some thousand terms in a row"):
        formula("+".join(["x"] * 300_000))
