"""Laminates: their stiffnesses, isotropic plies against Koiter's law, residual and tangent.

The references are tensors turned in NumPy, Koiter's law, and finite differences.
"""

import numpy as np
import pytest
from along import check, difference
from conftest import disc, hemisphere, random_displacement
from plies import laminate, ply, section

from magshell_fenicsx.mesh.mirror import Mirror
from magshell_fenicsx.models.axisymmetric.meridian import make_meridian
from magshell_fenicsx.models.shell.laminate import Laminate
from magshell_fenicsx.models.shell.parameters import Condition, Material
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.natural.shape import Natural, meridians
from magshell_fenicsx.shells.meridian import MeridianModel
from magshell_fenicsx.shells.shell import ShellModel
from magshell_fenicsx.shells.stress_resultants import StressResultants

ISOTROPIC = {"E2": 1.0, "nu12": 0.3, "G12": 1 / 2.6}
ALIKE = laminate(ply(17, 1.0, 0.4, **ISOTROPIC), ply(-60, 1.0, **ISOTROPIC))
COUPLED = laminate(ply(20, 3.0, fraction=0.3), ply(-70, 0.7), along=[0.3, 1.0, 0.2])
CROSS = section(ply(0, 3.0), ply(90, 3.0))
NATURAL = Natural(np.array([0.3, -0.2, 0.1]), np.array([0.1, -0.05, 0.08]), meridians)
MU = {"pressure": 0.3, "natural_curvature": 0.5, "natural_stretch": 0.6}


def test_a_ply_is_a_turned_tensor() -> None:
    """Q of fibres at 25 degrees is the tensor of fibres at 0, each of its four indices turned."""
    nu21 = 0.25 / 3
    plain = np.array([[3.0, 0.25, 0], [0.25, 1.0, 0], [0, 0, 0.6 * (1 - 0.25 * nu21)]]) / (
        1 - 0.25 * nu21
    )
    pairs = {(0, 0): 0, (1, 1): 1, (0, 1): 2, (1, 0): 2}
    tensor = np.array(
        [
            [[[plain[pairs[i, j], pairs[k, m]] for m in (0, 1)] for k in (0, 1)] for j in (0, 1)]
            for i in (0, 1)
        ]
    )
    c, s = np.cos(np.radians(25)), np.sin(np.radians(25))
    turn = np.array([[c, -s], [s, c]])
    turned = np.einsum("ai,bj,ck,dm,ijkm->abcd", turn, turn, turn, turn, tensor)
    expected = [turned[0, 0, 0, 0], turned[0, 0, 1, 1], turned[1, 1, 1, 1]]
    expected += [turned[0, 0, 0, 1], turned[1, 1, 0, 1], turned[0, 1, 0, 1]]
    A, B, D = section(ply(25, 3.0)).matrices(2.0)
    assert pytest.approx(np.array(expected) / 2, rel=1e-12) == A
    assert pytest.approx(0) == B
    assert pytest.approx(A / 12) == D


def test_a_plane_nearly_across_the_fibres_is_no_mirror() -> None:
    """1e-3 rad off, of which the cosine is 1 to 5e-7; exactly along and across it is one."""
    plies = Laminate(CROSS.matrices(1.0), np.array([2.0, 0.0, 0.0]))
    assert [
        plies.mirrored(Mirror.with_normal(np.array(n)))
        for n in ([1, 0, 0], [0, 1, 0], [1, 1e-3, 0])
    ] == [True, True, False]
    of_meridians = Laminate(CROSS.matrices(1.0), None)
    planes = [
        Mirror.with_normal(np.array([1.0, 2.0, 0.0])),
        Mirror.with_normal(np.array([1.0, 0, 0]), 0.1),
        Mirror.with_normal(np.eye(3)[2], 0.1),
    ]
    assert [of_meridians.mirrored(plane) for plane in planes] == [True, False, True]


def test_cross_ply() -> None:
    """[0/90] with the 0 at the inner face: A11 = A22, B22 = -B11 > 0, by Jones, section 4.4.3."""
    A, B, D = CROSS.matrices(1.0)
    Q11, Q22 = np.array([3.0, 1.0]) / (1 - 0.25**2 / 3)
    assert A[[0, 2]] == pytest.approx([(Q11 + Q22) / 2] * 2)
    assert pytest.approx([(Q22 - Q11) / 8, 0, (Q11 - Q22) / 8, 0, 0, 0], abs=1e-15) == B
    assert D[[0, 2]] == pytest.approx([(Q11 + Q22) / 24] * 2)


def shell(
    of: Laminate | None, *, half: bool = False, natural: bool = False, varies: bool = False
) -> ShellModel:
    loads = Loads(pressure=True, natural=NATURAL if natural else None)
    surface = hemisphere(0.8, half=True) if half else hemisphere(0.8)
    thickness = Thickness(lambda x, y, z: 1 + 0.5 * z**2) if varies else None
    edges: dict[str, Condition] = {"rim": "clamped"}
    if half:
        edges["symmetry"] = "symmetry"
    return ShellModel(
        surface, Material(0.3, 0.05, laminate=of), 2, edges, loads, thickness=thickness
    )


def meridian(of: Laminate | None) -> MeridianModel:
    def ball(chart: np.ndarray) -> np.ndarray:
        s = chart[:, 0]
        return np.column_stack([np.sin(s), 0 * s, np.cos(s)])

    line = make_meridian(ball, np.linspace(0, np.pi / 2, 6), (None, "rim"))
    return MeridianModel(
        line, Material(0.3, 0.05, laminate=of), 4, {"rim": "clamped"}, Loads(pressure=True)
    )


@pytest.mark.parametrize("kind", [{"half": True}, {"natural": True, "varies": True}])
def test_isotropic_plies_are_koiters(kind: dict[str, bool]) -> None:
    """Forces and tangent to 1e-12."""
    models = [shell(of, **kind) for of in (None, ALIKE)]
    u = random_displacement(models[0], 2e-3)
    mu = {
        name: MU[name]
        for name in {t.amplitude for t in models[0].system.terms}
        | set(models[0].factory.free_constants)
        if name
    }
    forces = [model.system.residual(u, mu) for model in models]
    assert np.abs(forces[0] - forces[1]).max() <= 1e-12 * np.abs(forces[0]).max()
    K = [model.system.tangent(u, mu) for model in models]
    stiff = [K.getValuesCSR()[2] for K in K]  # type: ignore[union-attr]
    assert np.abs(stiff[0] - stiff[1]).max() <= 1e-12 * np.abs(stiff[0]).max()


def test_isotropic_plies_on_a_meridian() -> None:
    models = [meridian(of) for of in (None, Laminate(ALIKE.matrices, None))]
    u = random_displacement(models[0], 1e-3)
    forces = [model.system.residual(u, {"pressure": 0.3}) for model in models]
    assert np.abs(forces[0] - forces[1]).max() <= 1e-12 * np.abs(forces[0]).max()


@pytest.mark.parametrize("kind", [{}, {"natural": True, "varies": True}])
def test_residual_and_tangent(kind: dict[str, bool]) -> None:
    """Of coupled plies, by differences of the energy, and against FFCx's forms: interior and
    clamped edges too.
    """
    model = shell(COUPLED, **kind)
    mu = {
        name: MU[name]
        for name in {t.amplitude for t in model.system.terms} | set(model.factory.free_constants)
        if name
    }
    u = random_displacement(model, 2e-3)
    check(model.system, u, mu)
    assert difference(model.system, u, mu) <= 1e-12


def test_residual_and_tangent_of_a_half() -> None:
    """Of plies along the meridians: mirror edges, and the modes that the half excludes."""
    model = shell(Laminate(CROSS.matrices(1.0), None), half=True)
    u = random_displacement(model, 1e-3)
    check(model.system, u, {"pressure": 0.3})
    modes = model.symmetry_breaking_modes
    assert modes is not None
    assert difference(modes.system, u, {"pressure": 0.3}) <= 1e-12


def test_residual_and_tangent_of_a_meridian() -> None:
    model = meridian(Laminate(CROSS.matrices(1.0), None))
    check(model.system, random_displacement(model, 1e-3), {"pressure": 0.3})


def test_energy_of_a_stretched_disc() -> None:
    """E_11 = e in a direction at 30 degrees from the fibres of a ply, by Hooke's law of the ply."""
    one = section(ply(0, 3.0), along=[np.cos(np.pi / 6), np.sin(np.pi / 6), 0.0])
    model = ShellModel(
        disc(0.8),
        Material(0.3, 0.1, laminate=Laminate(one.matrices(1.0), one.direction("disc"))),
        2,
        {},
        Loads(),
    )
    x = model.r0.x.array.reshape(-1, 3)
    u = (x * [0.02, 0.0, 0.0]).ravel()
    E = 0.02 + 0.02**2 / 2
    c, s = np.cos(np.pi / 6), np.sin(np.pi / 6)
    strain = E * np.array([c * c, s * s, -2 * c * s])
    Q = section(ply(0, 3.0)).plies[0].stiffness
    area = ShellModel(disc(0.8), Material(0.3, 0.1), 2, {}, Loads()).system.energies(u)[
        "membrane"
    ] / (E**2 / 2 / 0.91)
    assert model.system.energies(u)["membrane"] == pytest.approx(
        area * strain @ Q @ strain / 2, rel=1e-12
    )


def test_moments_in_pictures() -> None:
    """A flat [0/90], fibres along x in a frame whose first vector is along y: M_11 = D k - B e
    about x, over D/R.
    """
    jet = np.zeros((6, 1, 1, 3))
    jet[1, ..., 1], jet[2, ..., 0] = 1.0, -1.0
    u, e, k = np.zeros((6, 1, 1, 3)), 1e-4, 1e-3
    u[2, ..., 0], u[5, ..., 2] = -e, k
    found = StressResultants(
        jet, Material(0.3, 0.1, laminate=laminate(ply(0, 3.0), ply(90, 3.0))), None
    ).values_of(u, {})
    _, B, D = CROSS.matrices(1.0)
    (M,) = found["M"][0] * 0.1**2 / (12 * (1 - 0.3**2))
    assert (
        pytest.approx(
            [0.1**2 * D[1] * k, 0, 0.1**2 * D[0] * k - 0.1 * B[0] * (e + e**2 / 2)],
            abs=1e-15,
            rel=1e-6,
        )
        == M
    )
