"""Incompressible rubber: its energies, its small strains, residual and tangent, its magnetic
energy.

The references are energies in three principal stretches, Koiter's law, and finite differences.
"""

import numpy as np
import pytest
from along import check, difference
from conftest import disc, hemisphere, random_displacement
from rubbers import NEO_HOOKEAN, mooney, stiffening

from magshell_fenicsx.models.axisymmetric.meridian import make_meridian
from magshell_fenicsx.models.shell.law import work
from magshell_fenicsx.models.shell.parameters import Condition, Material
from magshell_fenicsx.models.shell.rubber import Rubber
from magshell_fenicsx.models.shell.strains import TangentFrame
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.models.strain_energy import StrainEnergy
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.natural.shape import Natural, meridians
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.shells.shell import ShellModel

LIMIT, H = 40.0, 0.1
RUBBERS = [
    mooney(0.0),
    mooney(0.3),
    mooney(1.0),
    NEO_HOOKEAN,
    stiffening(LIMIT),
    stiffening(LIMIT, 0.3),
]
RNG = np.random.default_rng(7)


def invariants(E: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """I1 - 3 and I2 - 3 of three stretches."""
    first, second = np.moveaxis(1 + 2 * np.linalg.eigvalsh(E), -1, 0)
    third = 1 / (first * second)
    return first + second + third - 3, first * second + second * third + third * first - 3


def by_stretches(E: np.ndarray, energy: StrainEnergy) -> np.ndarray:
    """Energy per volume over E of a sheet (..., 2, 2) whose faces are free, as its formula is
    printed.
    """
    one, two = invariants(E)
    share = energy.constants[-1] if energy.constants else 0.0
    of_mooney = ((1 - share) * one + share * two) / 6
    if len(energy.constants) < 2:
        return np.asarray(of_mooney)
    return np.asarray(-LIMIT / 6 * np.log(1 - 6 * of_mooney / LIMIT))


def strains(count: int, size: float) -> np.ndarray:
    """(C - 1)/2 of random stretches, whose logarithms are of that size; (count, 2, 2)."""
    logarithm = RNG.standard_normal((count, 2, 2)) * size
    values, axes = np.linalg.eigh(logarithm + np.swapaxes(logarithm, 1, 2))
    return np.asarray((axes * np.exp(values)[:, None]) @ np.swapaxes(axes, 1, 2) - np.eye(2)) / 2


@pytest.mark.parametrize("energy", RUBBERS)
def test_energy_of_three_stretches(energy: StrainEnergy) -> None:
    E = strains(20, 0.3)
    assert Rubber(H, energy).membrane(E, np.eye(2)) == pytest.approx(
        by_stretches(E, energy), rel=1e-11
    )


@pytest.mark.parametrize("energy", RUBBERS)
def test_bending_about_one_axis_is_that_of_the_layers(energy: StrainEnergy) -> None:
    """Of K = c c the mean energy of layers with the strains E - z K/sqrt(d), to the order h^2, at
    any stretch.
    """
    law, E, c = Rubber(H, energy), strains(20, 0.2), RNG.standard_normal((20, 2))
    K = c[:, :, None] * c[:, None, :]
    d = np.linalg.det(np.eye(2) + 2 * E)
    e = 1e-3  # differences of fourth order
    at = [by_stretches(E + n * e * K, energy) for n in (-2, -1, 0, 1, 2)]
    twice = (-at[0] + 16 * at[1] - 30 * at[2] + 16 * at[3] - at[4]) / (12 * e**2)
    assert law.bending(E, K, np.eye(2)) == pytest.approx(H**2 / (24 * d) * twice, rel=1e-5)


@pytest.mark.parametrize("energy", RUBBERS)
def test_no_bending_is_free(energy: StrainEnergy) -> None:
    """The energy of bending is positive at every stretch, so that no wave of the size of an element
    grows.
    """
    law, E = Rubber(H, energy), strains(2000, 0.7)
    if energy.constants[:1] == (LIMIT,):
        E = E[np.max(invariants(E), axis=0) < 0.99 * LIMIT]
    assert len(E) > 1000
    basis = np.array([[[1, 0], [0, 0]], [[0, 1], [1, 0]], [[0, 0], [0, 1]]], dtype=float)
    stiff = np.array([np.stack(law.moment(E, K, np.eye(2)), axis=-1) for K in basis])
    stiff[:, :, 1] *= 2  # the work of M_12
    assert np.all(np.linalg.eigvalsh(np.moveaxis(stiff, 1, 0)) > 0)


@pytest.mark.parametrize("energy", RUBBERS)
def test_small_strains_are_koiters(energy: StrainEnergy) -> None:
    """The difference from Koiter's stress and bending is of the order of the strain, over two
    decades; that from the energy too, of which Gent's logarithm has no digits there.
    """
    law, koiter, K, E1 = (
        Rubber(H, energy),
        Rubber(H, energy).linear,
        strains(1, 0.3)[0],
        strains(1, 0.3)[0],
    )
    sizes, up = np.array([1e-3, 1e-4, 1e-5]), np.eye(2)
    pairs = [
        (lambda E: work(law.stress(E, up), E1), lambda E: work(koiter.stress(E, up), E1)),
        (lambda E: law.bending(E, K, up), lambda E: koiter.bending(E, K, up)),
    ]
    if energy.constants[:1] != (LIMIT,):
        pairs.append((lambda E: law.membrane(E, up), lambda E: koiter.membrane(E, up)))
    for of, known in pairs:
        off = [abs(of(size * E1) / known(size * E1) - 1) for size in sizes]
        order = np.diff(np.log(off)) / np.diff(np.log(sizes))
        assert order == pytest.approx(1, abs=0.02)


NATURAL = Natural(np.array([0.3, -0.2, 0.1]), np.array([0.1, -0.05, 0.08]), meridians)
FIELD = Magnetisation(np.array([0.6, 0.0, 0.8]), np.array([0.0, 0.6, 0.8]))
GRADED = Magnetisation(
    np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]), gradient=np.diag([0.5, 0.5, -1.0])
)
MU = {"pressure": 0.3, "lambda_m": 0.4, "natural_curvature": 0.5, "natural_stretch": 0.6}


def shell(
    energy: StrainEnergy, *, half: bool = False, natural: bool = False, varies: bool = False
) -> ShellModel:
    loads = Loads(
        pressure=True, magnetic=GRADED if half else FIELD, natural=NATURAL if natural else None
    )
    surface = hemisphere(0.8, half=True) if half else hemisphere(0.8)
    thickness = Thickness(lambda x, y, z: 1 + 0.5 * z**2) if varies else None
    edges: dict[str, Condition] = {"rim": "clamped"}
    if half:
        edges["symmetry"] = "symmetry"
    material = Material(0.5, 0.05, Rubber(0.05, energy))
    return ShellModel(surface, material, 2, edges, loads, thickness=thickness)


@pytest.mark.parametrize(
    ("energy", "kind"),
    [
        (mooney(0.2), {}),
        (mooney(0.2), {"half": True}),
        (mooney(0.2), {"natural": True, "varies": True}),
        (stiffening(LIMIT, 0.2), {"half": True}),
    ],
)
def test_residual_and_tangent(energy: StrainEnergy, kind: dict[str, bool]) -> None:
    """By differences of the energy, and against FFCx's forms: interior, clamped and mirror edges
    too.
    """
    model = shell(energy, **kind)
    mu = {
        name: MU[name]
        for name in {t.amplitude for t in model.system.terms} | set(model.factory.free_constants)
        if name
    }
    u = random_displacement(model, 2e-3)
    check(model.system, u, mu)
    assert difference(model.system, u, mu) <= 1e-12


def test_modes_that_a_half_excludes() -> None:
    model = shell(mooney(0.2), half=True)
    modes = model.symmetry_breaking_modes
    assert modes is not None
    assert difference(modes.system, random_displacement(model, 1e-3), MU) <= 1e-12


def test_thinned_remanence() -> None:
    """A disc stretched by 1.2 and 0.9, magnetised and in a field along its normal: 1 - 1/(1.2 0.9)
    per volume.
    """
    along = np.array([0.0, 0.0, 1.0])
    model = ShellModel(
        disc(0.8),
        Material(0.5, H, Rubber(H, NEO_HOOKEAN)),
        2,
        {},
        Loads(magnetic=Magnetisation(along, along)),
    )
    x = model.r0.x.array.reshape(-1, 3)
    u = (x * [0.2, -0.1, 0.0]).ravel()
    per_volume = by_stretches(np.diag([1.2**2 - 1, 0.9**2 - 1]) / 2, NEO_HOOKEAN)
    energies = model.system.energies(u)
    assert energies["magnetic"] / energies["membrane"] == pytest.approx(
        (1 - 1 / (1.2 * 0.9)) / per_volume
    )
    jet = np.zeros((3, 1, 3))
    jet[1:] = np.eye(3)[:2, None]
    frame, moved = (
        TangentFrame.from_jet(np.concatenate([jet, np.zeros((3, 1, 3))])),
        jet * [0.2, -0.1, 0.0],
    )
    assert frame.convected(along[None], moved, thins=True)[0] == pytest.approx(
        [0, 0, 1 / (1.2 * 0.9)]
    )


@pytest.mark.parametrize("energy", [mooney(0.2), stiffening(LIMIT, 0.2)])
def test_meridian(energy: StrainEnergy) -> None:
    """Residual and tangent of a hemisphere whose thickness varies, by differences of the energy."""

    def ball(chart: np.ndarray) -> np.ndarray:
        s = chart[:, 0]
        return np.column_stack([np.sin(s), 0 * s, np.cos(s)])

    meridian = make_meridian(ball, np.linspace(0, np.pi / 2, 6), (None, "rim"))
    thickness, loads = (
        Thickness(lambda x, y, z: 1 + 0.5 * z**2),
        Loads(pressure=True, magnetic=GRADED),
    )
    model = MeridianModel(
        meridian,
        Material(0.5, 0.05, Rubber(0.05, energy)),
        4,
        {"rim": "clamped"},
        loads,
        thickness=thickness,
    )
    check(model.system, random_displacement(model, 1e-3), {"pressure": 0.3, "lambda_m": 0.4})
