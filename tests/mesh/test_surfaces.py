"""Built-in geometries: their areas, edges, normals and named points; cases that cannot be are refused."""

from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.source import CaseError, Source
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.plan import make_plan
from magshell_fenicsx.scene import build_midsurface
from magshell_fenicsx.shell import kinematics as kin

COMMON = {"thickness": 0.01, "poisson_ratio": 0.3}
THIRD = {"azimuth": [0, 120]}
ROUND = {"points": [[2, 0], [2, 1], [1, 2]]}
# geometry, area in the case's units, edges
SURFACES: list[tuple[dict[str, Any], float, set[str]]] = [
    ({"geometry": "plate", "length": 2, "width": 0.5}, 1.0, {"left", "right", "bottom", "top"}),
    ({"geometry": "cylinder", "radius": 2, "length": 3}, 12 * np.pi, {"bottom", "top"}),
    ({"geometry": "cylinder", "radius": 2, "length": 3, **THIRD}, 4 * np.pi, {"bottom", "top", "left", "right"}),
    ({"geometry": "cap", "radius": 2, "polar": 60}, 4 * np.pi, {"rim"}),
    ({"geometry": "cap", "radius": 2, "hole": 60}, 4 * np.pi, {"rim", "hole"}),
    ({"geometry": "cap", "radius": 1, "hole": 60, **THIRD}, np.pi / 3, {"rim", "hole", "left", "right"}),
    ({"geometry": "annulus", "radius": 2, "inner_radius": 1}, 3 * np.pi, {"inner", "outer"}),
    (
        {"geometry": "annulus", "radius": 2, "inner_radius": 1, "azimuth": [0, 360]},
        3 * np.pi,
        {"inner", "outer", "left", "right"},
    ),
    ({"geometry": "torus", "radius": 2, "tube_radius": 0.5}, 4 * np.pi**2, set()),
    (
        {"geometry": "torus", "radius": 2, "tube_radius": 0.5, "tube": [-90, 90]},
        2 * np.pi * (0.5 * np.pi * 2 + 0.5),
        {"bottom", "top"},
    ),
    # Guldin; a cone; r = cosh z; a paraboloid with its pole
    (
        {"geometry": "revolution", "profile": {"points": [[2, 0], [1, 1]]}},
        2 * np.pi * 1.5 * np.sqrt(2),
        {"bottom", "top"},
    ),
    (
        {"geometry": "revolution", "profile": {"radius": "(exp(z) + exp(-z))/2", "heights": [0, 1]}},
        np.pi * (1 + np.sinh(2) / 2),
        {"bottom", "top"},
    ),
    (
        {
            "geometry": "revolution",
            "profile": {"points": [[r, -r * r] for r in np.linspace(1, 0, 41).tolist()]},
        },
        np.pi / 6 * (5**1.5 - 1),
        {"rim"},
    ),
]


def built(shell: dict[str, Any], **sections: Any) -> Midsurface:
    data = {"shell": {**COMMON, **shell}, "boundary": {}, "mesh": {"size": 0.4}, **sections}
    return build_midsurface(make_plan(Case.from_source(Source("test", data))), MPI.COMM_SELF)


@pytest.mark.parametrize(("shell", "area", "edges"), SURFACES)
def test_area_and_edges(shell: dict[str, Any], area: float, edges: set[str]) -> None:
    surface = built(shell)
    R = make_plan(Case.from_source(Source("test", {"shell": {**COMMON, **shell}, "boundary": {}}))).length
    r0 = surface.placement(fem.functionspace(surface.mesh, ("Lagrange", 4, (3,))))
    dx = ufl.dx(metadata={"quadrature_degree": 8})
    found = fem.assemble_scalar(fem.form(kin.area_ratio(kin.jet(r0, surface.mesh)) * dx))
    assert found * R**2 == pytest.approx(area, rel=1e-4)
    assert set(surface.edges) == edges
    assert all(len(facets) for facets in surface.edges.values())
    surface.mesh.topology.create_connectivity(1, 2)
    assert sum(map(len, surface.edges.values())) == np.sum(
        np.diff(surface.mesh.topology.connectivity(1, 2).offsets) == 1
    )


@pytest.mark.parametrize("shell", [s for s, _, _ in SURFACES if s["geometry"] in ("cylinder", "cap", "torus")])
def test_normals_point_outwards(shell: dict[str, Any]) -> None:
    surface = built(shell)
    r0 = surface.placement(fem.functionspace(surface.mesh, ("Lagrange", 4, (3,))))
    j = kin.jet(r0, surface.mesh)
    across = ufl.as_vector([j.r[0], j.r[1], 0.0])
    centre = across / ufl.sqrt(ufl.dot(across, across)) if shell["geometry"] == "torus" else 0.0 * j.r
    inside = {"cylinder": ufl.as_vector([0.0, 0.0, j.r[2]]), "cap": 0.0 * j.r, "torus": centre}[shell["geometry"]]
    outward = ufl.dot(kin.normal(j), kin.unit(j.r - inside))
    least = fem.assemble_scalar(fem.form(ufl.conditional(ufl.lt(outward, 0.99), 1.0, 0.0) * ufl.dx))
    assert least == 0


POINTS = [
    ({"geometry": "cylinder", "radius": 2, "length": 3}, [0, -2, 1.2345]),
    ({"geometry": "cylinder", "radius": 2, "length": 3}, [2, 0, 0.7]),
    ({"geometry": "cap", "radius": 1, "hole": 20}, [0.6, 0, 0.8]),
    ({"geometry": "cap", "radius": 1}, [0.6, 0, 0.8]),
    ({"geometry": "cap", "radius": 1}, [0, 0, 1]),
    ({"geometry": "plate", "length": 2, "width": 0.5}, [0.77, 0.5, 0]),
    ({"geometry": "torus", "radius": 2, "tube_radius": 0.5}, [0, 1.5, 0]),
    ({"geometry": "revolution", "profile": {"points": [[2, 0], [1, 1]]}}, [0, 1.25, 0.75]),
    ({"geometry": "revolution", "profile": ROUND}, [2, 0, 0]),
]


@pytest.mark.parametrize(("shell", "place"), POINTS)
def test_named_points_are_vertices(shell: dict[str, Any], place: list[float]) -> None:
    surface = built(shell, points={"A": place})
    R = shell.get("radius") or shell.get("length") or 2.0
    x = np.array(place) / R
    assert surface.points["A"] == pytest.approx(x, abs=1e-9)
    assert np.linalg.norm(surface.mesh.geometry.x - x, axis=1).min() < 1e-9


REFUSED = [
    ({"shell.geometry": "sphere"}, "shell.geometry: 'sphere'; allowed: hemisphere, disc, strip, cap"),
    ({"points": {"A": [1, 1, 1]}}, "points.A: is not on the surface; a place near it that is: [0.70710678"),
    ({"shell.radius": "1 mm"}, "give every length and youngs_modulus a unit, or none"),
    ({"shell.azimuth": [10, 5]}, "must grow"),
    ({"shell.radiuss": 3}, "did you mean radius?"),
    ({"shell.thickness": 0.5}, "2 thicknesses"),
    ({"boundary": {"A": "clampd"}}, "must be clamped, simply supported, hinged, symmetry, free"),
    ({"boundary": {"A": {"held": ["w"]}}}, "must be clamped"),
    ({"loading": {"kind": "indentation", "at": {"polar": 0}, "depth": 1}}, "not on a cylinder"),
    ({"loading": {"kind": "dead", "loads": [{"edge": "top"}], "factor": 1}}, "one of force, per_length, moment"),
    ({"loading": {"kind": "dead", "loads": [{"at": "B", "force": [1, 0, 0]}], "factor": 1}}, "name it in points"),
    ({"loading": {"kind": "dead", "loads": [{"at": "B", "force": [0, 0, 0]}], "factor": 1}}, "force: is zero"),
    ({"symmetry": "half"}, "boundary: {name: symmetry}"),
    ({"mesh.tolerance": 1e-3}, "mesh.tolerance: not with a cylinder"),
    ({"shell.thickness_factor": "1 +"}, "is not a formula"),
]


@pytest.mark.parametrize(("changes", "said"), REFUSED)
def test_mistakes_are_named(changes: dict[str, Any], said: str) -> None:
    shell = {"geometry": "cylinder", "radius": 1, "length": 2, "youngs_modulus": 1, **COMMON}
    data: dict[str, Any] = {"shell": shell, "boundary": {"bottom": "clamped"}, "mesh": {}}
    for key, value in changes.items():
        *path, last = key.split(".")
        section = data
        for name in path:
            section = section[name]
        section[last] = value
    with pytest.raises(CaseError) as error:
        make_plan(Case.from_source(Source("test", data)))
    assert said in str(error.value)


def test_units_are_turned_into_si() -> None:
    shell = {"geometry": "cylinder", "radius": "25 mm", "length": "5 cm", "thickness": "0.5 mm", "poisson_ratio": 0.5}
    case = Case.from_source(Source("test", {"shell": shell, "boundary": {"bottom": "clamped"}}))
    assert case.shell.R_over_h == pytest.approx(50)
    assert make_plan(case).length == pytest.approx(0.025)
