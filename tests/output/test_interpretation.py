"""Magnetic loads against their closed forms on the sphere, Br = Ba = e3, and against the energy U1.

With b0 = -a0/R (outward normal): p_mag = (h/R) sin^2 phi, k = -cos^2 phi, and
f_mag = -3 (h/R) cos phi P e3, P the projection on the tangent plane.
"""

import numpy as np
import pytest
import ufl
from conftest import disc, hemisphere
from dolfinx import fem

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.parameters import Material
from magshell_fenicsx.models.shell.spatial_fields import radial
from magshell_fenicsx.output.fields.gathering import gatherer
from magshell_fenicsx.output.fields.surface import SurfaceGatherer
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.shells.shell import ShellModel

UP = E3 = np.array([0.0, 0.0, 1.0])
H = 0.05


def model(field: Magnetisation) -> ShellModel:
    return ShellModel(hemisphere(0.25), Material(0.3, H), 4, {}, Loads(magnetic=field))


def test_closed_forms_on_the_sphere() -> None:
    shell = model(Magnetisation(UP, UP))
    surface = SurfaceGatherer(shell).gather(shell.zero())
    assert surface is not None
    n, cos = surface.n0, surface.r0[:, 2]
    in_plane = UP - cos[:, None] * surface.r0
    assert surface.fields["p_mag"] == pytest.approx(H * (1 - cos**2), abs=2e-3 * H)
    assert surface.fields["k"] == pytest.approx(-(cos**2), abs=1e-5)
    assert surface.fields["f_mag"] == pytest.approx(-3 * H * cos[:, None] * in_plane, abs=1e-2 * H)
    assert surface.fields["tau"] == pytest.approx(np.zeros_like(n), abs=1e-14)


def test_closed_forms_on_the_meridian() -> None:
    """The same from the meridian model, turned around the axis."""
    shell = {"geometry": "hemisphere", "radius_to_thickness": 20, "poisson_ratio": 0.3}
    data = {"shell": shell, "boundary": {"equator": "clamped"}, "magnetic": {"lambda_m": 1e-3}}
    scene = Scene(Case.from_source(Source("meridian", data)))
    surface = gatherer(scene.model, scene.comm).gather(scene.model.zero())
    assert surface is not None
    cos = surface.n0[:, 2]
    in_plane = UP - cos[:, None] * surface.n0
    assert surface.fields["p_mag"] == pytest.approx(H * (1 - cos**2), abs=1e-4 * H)
    assert surface.fields["k"] == pytest.approx(-(cos**2), abs=1e-5)
    assert surface.fields["f_mag"] == pytest.approx(-3 * H * cos[:, None] * in_plane, abs=4e-3 * H)


def test_torque_of_a_swelling_sphere() -> None:
    """u = e r0: U = e P, so tau = -e (n . Br) P Ba."""
    Ba = np.array([0.6, 0.0, 0.8])
    shell = model(Magnetisation(UP, Ba))
    surface = SurfaceGatherer(shell).gather(0.01 * shell.r0.x.array)
    assert surface is not None
    n = surface.r0
    expected = -0.01 * n[:, 2:3] * (Ba - (n @ Ba)[:, None] * n)
    assert surface.fields["tau"] == pytest.approx(expected, abs=1e-6)


def test_first_order_energy_is_the_work_of_the_loads() -> None:
    """U1 = lambda_m E integral of f_mag . u - p_mag u . n0, for u = 0 on the edge; paper Eq.

    (eq:um1).
    """
    Ba = np.array([0.48, 0.36, 0.8])
    shell = model(Magnetisation(UP, Ba, "first"))
    x, y, z = shell.r0.x.array.reshape(-1, 3).T
    u = (z[:, None] * np.column_stack([x * z, y + z, 0.5 + x])).ravel()
    U1 = shell.system.potential(u, {}, "lambda_m")
    r0, v = kin.jet(shell.r0, shell.V.mesh), shell.u
    n0, Br, A = kin.normal(r0), ufl.as_vector(UP.tolist()), ufl.as_vector(Ba.tolist())
    P = ufl.Identity(3) - ufl.outer(n0, n0)
    # on the unit sphere b = -P, tr b = -2: f/h = -(n . Ba) P Br - 2 (n . Br) P Ba, p/h = P Br . Ba
    f = -ufl.dot(n0, A) * ufl.dot(P, Br) - 2 * ufl.dot(n0, Br) * ufl.dot(P, A)
    p = ufl.dot(ufl.dot(P, Br), A)
    work = (
        (ufl.dot(f, v) - p * ufl.dot(v, n0))
        * kin.area_ratio(r0)
        * ufl.dx(metadata={"quadrature_degree": 8})
    )
    assert fem.assemble_scalar(fem.form(work)) == pytest.approx(U1, rel=1e-4)


def test_first_order_energy_of_a_remanence_that_does_not_stretch() -> None:
    """U1 = integral of f_mag . u for u = 0 on the edge: f/h is half of that above less that of
    exchanged fields.
    """
    Ba = np.array([0.48, 0.36, 0.8])
    shell = model(Magnetisation(UP, Ba, "first", law="rotation"))
    surface = SurfaceGatherer(shell).gather(shell.zero())
    assert surface is not None
    n = surface.n0
    P = np.eye(3) - n[:, :, None] * n[:, None]
    expected = H / 2 * ((n @ Ba)[:, None] * (P @ UP) - (n @ UP)[:, None] * (P @ Ba))
    assert np.abs(surface.fields["p_mag"]).max() == 0
    assert surface.fields["f_mag"] == pytest.approx(expected, abs=2e-3 * H)
    x, y, z = shell.r0.x.array.reshape(-1, 3).T
    u = (z[:, None] * np.column_stack([x * z, y + z, 0.5 + x])).ravel()
    U1 = shell.system.potential(u, {}, "lambda_m")
    n0, Br, A = (
        kin.normal(kin.jet(shell.r0, shell.V.mesh)),
        ufl.as_vector(UP.tolist()),
        ufl.as_vector(Ba.tolist()),
    )
    f = (
        ufl.dot(n0, A) * (Br - ufl.dot(n0, Br) * n0) - ufl.dot(n0, Br) * (A - ufl.dot(n0, A) * n0)
    ) / 2
    area = kin.area_ratio(kin.jet(shell.r0, shell.V.mesh))
    work = ufl.dot(f, shell.u) * area * ufl.dx(metadata={"quadrature_degree": 8})
    assert fem.assemble_scalar(fem.form(work)) == pytest.approx(U1, rel=1e-4)


def test_springs_and_torques_of_a_remanence_that_does_not_stretch() -> None:
    """Of a plate: k is the mean over all axes in it; U_tau = q . tau where no area changes."""
    Br, Ba, D = (
        np.array([0.6, 0.0, 0.8]),
        np.array([0.48, 0.36, 0.8]),
        np.array([[0.1, 0.3], [-0.2, -0.1]]),
    )
    flat = ShellModel(
        disc(0.8), Material(0.3, H), 2, {}, Loads(magnetic=Magnetisation(Br, Ba, law="rotation"))
    )
    q = np.array([0.05, -0.08])
    u = (flat.r0.x.array.reshape(-1, 3)[:, :2] @ np.vstack([D, q]).T).ravel()
    surface = SurfaceGatherer(flat).gather(u)
    assert surface is not None
    mean = (2 * Ba[2] * Br[2] + Ba[:2] @ Br[:2]) / 2
    assert surface.fields["k"] == pytest.approx(-mean, abs=1e-12)
    parts = {}
    for kind in ("torque", "second"):
        field = Magnetisation(Br, Ba, kind, law="rotation")  # type: ignore[arg-type]
        other = ShellModel(disc(0.8), Material(0.3, H), 2, {}, Loads(magnetic=field))
        parts |= other.system.energies(u)
    area = 3 * flat.volume_change(np.tile(E3, len(u) // 3))
    assert surface.fields["tau"] @ [*q, 0.0] == pytest.approx(parts["Utau"] / area, rel=1e-10)
    assert parts["Uq"] / area != pytest.approx(
        -surface.fields["k"][0] / 2 * (q @ q)
    )  # it differs between axes


def test_springs_of_a_radial_remanence() -> None:
    """k = -(n . Ba)."""
    shell = model(Magnetisation(radial, UP))
    surface = SurfaceGatherer(shell).gather(shell.zero())
    assert surface is not None
    assert "f_mag" not in surface.fields
    assert surface.fields["k"] == pytest.approx(-surface.r0[:, 2], abs=1e-5)


def test_thickness_that_varies() -> None:
    """p_mag = h b0:B0 with the thickness that is there; f_mag, whose divergence takes that of h
    too, is not told.
    """
    pressures = []
    for factor in ({}, {"thickness_factor": "1 + z"}):
        shell = {
            "geometry": "cylinder",
            "radius": 1,
            "length": 1,
            "thickness": 0.02,
            "poisson_ratio": 0.3,
            **factor,
        }
        magnetic = {"lambda_m": 1e-3, "remanent": {"polar": 90}, "applied": {"polar": 90}}
        data = {
            "shell": shell,
            "boundary": {"bottom": "clamped"},
            "magnetic": magnetic,
            "symmetry": "none",
        }
        scene = Scene(Case.from_source({**data, "mesh": {"degree": 2, "size": 0.5}}))
        surface = SurfaceGatherer(scene.model).gather(scene.model.zero())  # type: ignore[arg-type]
        assert surface
        assert ("f_mag" in surface.fields) == (not factor)
        pressures.append(surface.fields["p_mag"])
    assert np.abs(pressures[0]).max() > 0.01
    assert pressures[1] == pytest.approx(pressures[0] * (1 + surface.r0[:, 2]), abs=1e-12)
