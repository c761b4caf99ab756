"""What the meridian model and the full shell must have in common: energies, volume, the surface
itself.
"""

import numpy as np
import pytest
from conftest import hemisphere as triangulated
from meridian_scenes import E3, hemisphere

from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.spatial_fields import WithinRims, tangential
from magshell_fenicsx.parts.imperfections.dimple import AT_POLE, Dimple
from magshell_fenicsx.parts.imperfections.imperfection import ImperfectionGeometry
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.shells.revolution import Revolution
from magshell_fenicsx.shells.shell import ShellModel

Array = np.ndarray
DIMPLE = Dimple(0.05, 0.5)
REACH = ImperfectionGeometry(DIMPLE, distance=AT_POLE, reach=DIMPLE.width)


def displacement(phi: Array) -> tuple[Array, Array]:
    """A smooth (U, W), zero on the equator."""
    return 0.1 * np.sin(phi) * np.cos(phi), -0.2 * np.cos(phi) ** 2 + 0.1 * np.cos(phi)


@pytest.mark.parametrize(
    "field",
    [
        Magnetisation(tangential, E3, "second_consistent", law="rotation"),
        Magnetisation(tangential, E3, gradient=np.diag([0.5, 0.5, -1.0]), law="rotation"),
        Magnetisation(
            WithinRims(((REACH.is_within_rim, -E3),), E3), E3, gradient=np.diag([0.5, 0.5, -1.0])
        ),
    ],
)
def test_energies_and_volume(field: Magnetisation) -> None:
    loads, R_over_h, nu = Loads(pressure=True, magnetic=field), 20, 0.3
    width = DIMPLE.width * np.sqrt(R_over_h) * (12 * (1 - nu**2)) ** 0.25
    line = hemisphere(R_over_h, nu, loads, dimple=(DIMPLE.depth * R_over_h, width))
    phi = line.V.tabulate_dof_coordinates()[:, 0]
    on_line = np.column_stack(displacement(phi)).ravel()

    surface = ShellModel(
        triangulated(0.1, dimple=DIMPLE), Material(nu, 1 / R_over_h), 4, {"rim": "clamped"}, loads
    )
    x, y, z = surface.r0.x.array.reshape(-1, 3).T
    phi, theta = np.arctan2(np.hypot(x, y), z), np.arctan2(y, x)
    U, W = displacement(phi)
    on_surface = np.column_stack([U * np.cos(theta), U * np.sin(theta), W]).ravel()

    expected, found = surface.system.energies(on_surface), line.system.energies(on_line)
    assert list(found) == list(expected)
    for name in found:
        if name.endswith("edges"):
            continue  # their penalty depends on the mesh
        assert found[name] == pytest.approx(expected[name], rel=2e-5), name
    assert line.volume_change(on_line) == pytest.approx(surface.volume_change(on_surface), rel=2e-5)
    assert line.deflection(on_line, "pole") == pytest.approx(
        surface.deflection(on_surface, "pole"), rel=1e-12
    )


def test_surface_of_revolution() -> None:
    model = hemisphere(90, 0.3, Loads(magnetic=Magnetisation(tangential, E3)))
    surface = Revolution(model, sectors=200)
    assert surface.n0 == pytest.approx(surface.r0, abs=1e-8)
    a, b, c = np.moveaxis(surface.r0[surface.cells], 1, 0)
    areas = np.cross(b - a, c - a) / 2
    assert (np.einsum("ij,ij->i", areas, a) > 0).all()
    assert np.linalg.norm(areas, axis=1).sum() == pytest.approx(2 * np.pi, rel=1e-3)
    u = model.zero()
    u[1::2] = -0.3
    assert surface.displacement(u) == pytest.approx(np.tile([0.0, 0.0, -0.3], (len(surface.r0), 1)))
