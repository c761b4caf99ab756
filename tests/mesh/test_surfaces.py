"""Built-in geometries: their areas, edges, normals and named points; cases that cannot be are
refused.
"""

import re
from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from pydantic import ValidationError

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.check import describe
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.mesh.midsurface import Midsurface
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.parts.pressure.openings import moving_edges
from magshell_fenicsx.problem.memory import refuse_beyond_memory
from magshell_fenicsx.simulate.scene import build_midsurface

COMMON = {"thickness": 0.01, "poisson_ratio": 0.3}
THIRD = {"azimuth": [0, 120]}
ROUND = {"points": [[2, 0], [2, 1], [1, 2]]}
# geometry, area in the case's units, edges
SURFACES: list[tuple[dict[str, Any], float, set[str]]] = [
    ({"geometry": "plate", "length": 2, "width": 0.5}, 1.0, {"left", "right", "bottom", "top"}),
    ({"geometry": "cylinder", "radius": 2, "length": 3}, 12 * np.pi, {"bottom", "top"}),
    (
        {"geometry": "cylinder", "radius": 2, "length": 3, **THIRD},
        4 * np.pi,
        {"bottom", "top", "left", "right"},
    ),
    ({"geometry": "cap", "radius": 2, "polar": 60}, 4 * np.pi, {"rim"}),
    ({"geometry": "cap", "radius": 2, "hole": 60}, 4 * np.pi, {"rim", "hole"}),
    (
        {"geometry": "cap", "radius": 1, "hole": 60, **THIRD},
        np.pi / 3,
        {"rim", "hole", "left", "right"},
    ),
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
        {
            "geometry": "revolution",
            "profile": {"radius": "(exp(z) + exp(-z))/2", "heights": [0, 1]},
        },
        np.pi * (1 + np.sinh(2) / 2),
        {"bottom", "top"},
    ),
    (
        {
            "geometry": "revolution",
            "profile": {"points": [[r, -r * r] for r in np.linspace(1, 0, 41).tolist()]},
        },
        np.pi / 6 * (5**1.5 - 1),
        {"bottom"},
    ),
]


def built(shell: dict[str, Any], **sections: Any) -> Midsurface:
    data = {
        "shell": {**COMMON, **shell},
        "boundary": {},
        "mesh": {"size": 0.4},
        "symmetry": "none",
        **sections,
    }
    return build_midsurface(make_problem(Case.from_source(Source("test", data))), MPI.COMM_SELF)


@pytest.mark.parametrize(("shell", "area", "edges"), SURFACES)
def test_area_and_edges(shell: dict[str, Any], area: float, edges: set[str]) -> None:
    surface = built(shell)
    R = make_problem(
        Case.from_source(Source("test", {"shell": {**COMMON, **shell}, "boundary": {}}))
    ).length
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


@pytest.mark.parametrize(
    "shell", [s for s, _, _ in SURFACES if s["geometry"] in ("cylinder", "cap", "torus")]
)
def test_normals_point_outwards(shell: dict[str, Any]) -> None:
    surface = built(shell)
    r0 = surface.placement(fem.functionspace(surface.mesh, ("Lagrange", 4, (3,))))
    j = kin.jet(r0, surface.mesh)
    across = ufl.as_vector([j.r[0], j.r[1], 0.0])
    centre = (
        across / ufl.sqrt(ufl.dot(across, across)) if shell["geometry"] == "torus" else 0.0 * j.r
    )
    inside = {"cylinder": ufl.as_vector([0.0, 0.0, j.r[2]]), "cap": 0.0 * j.r, "torus": centre}[
        shell["geometry"]
    ]
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


STRIP = {
    "geometry": "strip",
    "radius": "30 mm",
    "thickness": "0.5 mm",
    "width": 0.2,
    "youngs_modulus": "1 MPa",
}
OFF = [
    (
        STRIP,
        [1, 0, 0],
        "points.A: is not on the surface; a place near it that is: [30 mm, 0 mm, 0 mm]; a number",
    ),
    (STRIP, ["30 mm", "6 mm", 0], "near it that is: [30 mm, 3 mm, 0 mm]"),
    ({"geometry": "plate", "length": 2, "width": 0.5}, [1, 0.6, 0], "near it that is: [1, 0.5, 0]"),
]


@pytest.mark.parametrize(("shell", "place", "said"), OFF)
def test_named_points_beside_the_surface(
    shell: dict[str, Any], place: list[float], said: str
) -> None:
    """A strip once took any point as one of its own, even 1 m away, where every displacement is
    nan.
    """
    edge = "root" if shell["geometry"] == "strip" else "left"
    data = {"shell": COMMON | shell, "boundary": {edge: "clamped"}, "points": {"A": place}}
    with pytest.raises(CaseError, match=re.escape(said)):
        make_problem(Case.model_validate(data))


@pytest.mark.parametrize(("shell", "place"), POINTS)
def test_named_points_are_vertices(shell: dict[str, Any], place: list[float]) -> None:
    surface = built(shell, points={"A": place})
    R = shell.get("radius") or shell.get("length") or 2.0
    x = np.array(place) / R
    assert surface.points["A"] == pytest.approx(x, abs=1e-9)
    assert np.linalg.norm(surface.mesh.geometry.x - x, axis=1).min() < 1e-9


def test_the_width_of_a_strip_may_have_a_unit() -> None:
    """6 mm of 30 mm are the number 0.2; without a length in units there is nothing that it could be
    over.
    """
    strip = {"geometry": "strip", "poisson_ratio": 0.3, "width": "6 mm", "youngs_modulus": "1 MPa"}
    data = {
        "shell": strip | {"radius": "30 mm", "thickness": "0.5 mm"},
        "boundary": {"root": "clamped"},
    }
    data["loading"] = {"kind": "dead", "loads": [{"at": "A", "force": [0, 0, "1 mN"]}], "factor": 1}
    data["points"] = {"A": ["30 mm", 0, 0]}
    assert Case.model_validate(data).width == pytest.approx(0.2, rel=1e-12)
    data["shell"] = strip | {"radius_to_thickness": 60}
    with pytest.raises(
        ValidationError, match="a width with a unit needs radius and thickness with units"
    ):
        Case.model_validate(data)


DENSITIES = {"remanent": {"flux_density": "60 mT"}, "applied": {"flux_density": "50 mT"}}
FILE = {**COMMON, "geometry": "mesh", "file": "part.msh", "radius": 1}
CAP = {"geometry": "cap", "radius": 1, "polar": 60}
MOMENT = {"kind": "dead", "loads": [{"edge": "top", "moment": 1}], "factor": 1}
REFUSED: list[tuple[dict[str, Any], str]] = [
    (
        {"shell.geometry": "sphere"},
        "shell.geometry: 'sphere'; allowed: hemisphere, disc, strip, cap",
    ),
    (
        {"points": {"A": [1, 1, 1]}},
        "points.A: is not on the surface; a place near it that is: [0.70710678",
    ),
    ({"shell.radius": "1 mm"}, "give every length and youngs_modulus a unit, or none"),
    ({"shell.azimuth": [10, 5]}, "must grow"),
    ({"shell.radiuss": 3}, "did you mean radius?"),
    ({"shell.thickness": 0.5}, "2 thicknesses"),
    ({"boundary": {"A": "clampd"}}, "must be clamped, simply supported, hinged, symmetry, free"),
    ({"boundary": {"A": {"held": ["w"]}}}, "must be clamped"),
    ({"loading": {"kind": "indentation", "at": {"polar": 0}, "depth": 1}}, "has no pole"),
    (
        {"loading": {"kind": "dead", "loads": [{"edge": "top"}], "factor": 1}},
        "one of force, per_length, moment",
    ),
    (
        {"loading": {"kind": "dead", "loads": [{"at": "B", "force": [1, 0, 0]}], "factor": 1}},
        "name it in points",
    ),
    (
        {"loading": {"kind": "dead", "loads": [{"at": "B", "force": [0, 0, 0]}], "factor": 1}},
        "force: is zero",
    ),
    (
        {
            "boundary": {"bottom": "clamped", "left": "hinged"},
            "shell.azimuth": [0, 90],
            "symmetry": "half",
        },
        "no common mir",
    ),
    ({"shell.thickness_factor": "1 +"}, "is not a formula"),
    ({"points": {"pole": [1, 0, 0]}}, "points.pole: is taken"),
    ({"magnetic": DENSITIES}, "give youngs_modulus and lengths units, or lambda_m"),
    ({"shell": FILE, "mesh.size": 0.1}, "mesh.size: not with geometry: mesh"),
    ({"shell": FILE, "mesh.refinement": 2}, "mesh.refinement: not with geometry: mesh"),
    ({"loading": {**MOMENT, "branches": True}}, "branches: not with a moment"),
    (
        {"points": {"A": [1, 0, "1 mm"]}},
        "points.A.2: has a unit, but the shell's lengths have none",
    ),
    ({"points": {"A$ ö": [1, 0, "1 mm"]}}, "test: points.A$ ö.2: has a unit, but"),
    ({"mesh.size": "1 mm"}, "mesh.size: has a unit, but the shell's lengths have none"),
    (
        {"loading": {**MOMENT, "loads": [{"edge": "top", "moment": "1 N"}]}},
        "loads.0.moment: has a unit, but",
    ),
    (
        {"loading": {**MOMENT, "loads": [{"edge": "top", "moment": "1 Pa"}]}},
        "is not convertible to newton",
    ),
    (
        {
            "shell": {
                **COMMON,
                "geometry": "revolution",
                "profile": {"points": [["1 m", 0], [2, 1]]},
            }
        },
        "give every length",
    ),
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
        make_problem(Case.from_source(Source("test", data)))
    assert said in str(error.value)


@pytest.mark.parametrize("boundary", [{}, {"top": "free"}])
def test_a_check_sees_that_nothing_is_held(boundary: dict[str, str]) -> None:
    shell = {"geometry": "cylinder", "radius": 1, "length": 2, **COMMON}
    with pytest.raises(CaseError, match="boundary: nothing is held"):
        describe(Case.from_source(Source("test", {"shell": shell, "boundary": boundary})))


@pytest.mark.parametrize("symmetry", ["auto", "none"])
@pytest.mark.parametrize(
    "shell",
    [
        {"geometry": "cylinder", "radius": 1, "length": 2, **COMMON},
        {"geometry": "hemisphere", "radius_to_thickness": 50, "poisson_ratio": 0.3},
    ],
)
def test_planes_of_symmetry_hold_no_shell_alone(shell: dict[str, Any], symmetry: str) -> None:
    """It moves across its axis: `check` refuses on meridian and surface what a run refuses."""
    edge = "equator" if shell["geometry"] == "hemisphere" else "bottom"
    data = {"shell": shell, "boundary": {edge: "symmetry"}, "symmetry": symmetry}
    with pytest.raises(CaseError, match=r"move in its planes of symmetry; .*held: \[x, y\]"):
        describe(Case.from_source(Source("test", data)))


def test_units_are_turned_into_si() -> None:
    shell = {
        "geometry": "cylinder",
        "radius": "25 mm",
        "length": "5 cm",
        "thickness": "0.5 mm",
        "poisson_ratio": 0.5,
    }
    case = Case.from_source(Source("test", {"shell": shell, "boundary": {"bottom": "clamped"}}))
    assert case.shell.R_over_h == pytest.approx(50)
    assert make_problem(case).length == pytest.approx(0.025)


def test_points_loads_and_sizes_may_have_units() -> None:
    """The same problem as of numbers in SI."""
    shell = {
        "geometry": "cylinder",
        "radius": "25 mm",
        "length": "5 cm",
        "thickness": "0.5 mm",
        "poisson_ratio": 0.5,
    }
    shell["youngs_modulus"] = "1 MPa"
    loads = [
        ({"at": "A", "force": ["2 mN", 0, 0]}, {"at": "A", "force": [2e-3, 0, 0]}),
        (
            {"edge": "top", "per_length": [0, 0, "3 mN/mm"]},
            {"edge": "top", "per_length": [0, 0, 3.0]},
        ),
        ({"edge": "top", "moment": "4 mN*m/m"}, {"edge": "top", "moment": 4e-3}),
        ({"over": "all", "per_area": [0, 0, "5 kPa"]}, {"over": "all", "per_area": [0, 0, 5e3]}),
        ({"over": "all", "pressure": "6 kPa"}, {"over": "all", "pressure": 6e3}),
    ]

    def problem(i: int, place: list[Any], size: Any) -> Any:
        dead = {"kind": "dead", "loads": [load[i] for load in loads], "factor": 1}
        data = {
            "shell": shell,
            "boundary": {"bottom": "clamped"},
            "points": {"A": place},
            "mesh": {"size": size},
        }
        return make_problem(Case.from_source(Source("test", {**data, "loading": dead})))

    texts, numbers = problem(0, ["25 mm", 0, "5 cm"], "5 mm"), problem(1, [0.025, 0, 0.05], 0.005)
    for here, there in zip(texts.loads.all_dead, numbers.loads.all_dead, strict=True):
        assert type(here) is type(there)
        for value, other in zip(vars(here).values(), vars(there).values(), strict=True):
            assert (
                value == other
                if value is None or isinstance(value, str)
                else value == pytest.approx(other)
            )
    assert texts.points["A"] == pytest.approx(numbers.points["A"])
    assert texts.shape == numbers.shape


@pytest.mark.parametrize("symmetry", ["none", "half"])
def test_a_half_is_not_told_to_take_half(symmetry: str) -> None:
    data = {
        "symmetry": symmetry,
        "shell": {**COMMON, **CAP, "hole": 1, "thickness": 1e-5},
        "boundary": {"rim": "clamped"},
        "mesh": {"refinement": 20},
    }
    case = Case.from_source(Source("test", data))
    with pytest.raises(CaseError) as error:
        refuse_beyond_memory(make_problem(case))
    assert "unknowns" in str(error.value)
    assert ("symmetry: half halves it" in str(error.value)) == (symmetry == "none")


def test_flux_densities_of_a_shell_with_units() -> None:
    """lambda_m = |Br||Ba|/(mu_0 E)."""
    shell = {
        "geometry": "plate",
        "length": "1 cm",
        "width": "1 cm",
        "thickness": "0.1 mm",
        "poisson_ratio": 0.5,
    }
    data = {
        "shell": {**shell, "youngs_modulus": "1.8 MPa"},
        "boundary": {"left": "clamped"},
        "magnetic": DENSITIES,
    }
    assert Case.from_source(Source("test", data)).lambda_m == pytest.approx(
        0.06 * 0.05 / (4e-7 * np.pi * 1.8e6)
    )


@pytest.mark.parametrize("azimuth", [[2, 362], [-180, 180], [0, 360]])
def test_a_profile_may_be_slit_anywhere(azimuth: list[float]) -> None:
    shell = {"geometry": "revolution", "profile": {"points": [[2, 0], [1, 1]]}, "azimuth": azimuth}
    assert {"left", "right"} < set(built(shell).edges)


PARABOLOID = SURFACES[-1][0]
NAMES = [
    (
        PARABOLOID,
        {"boundary": {"rim": "clamped"}},
        "boundary.rim: the surface has no such edge, only bottom",
    ),
    (
        PARABOLOID,
        {"boundary": {"bottom": "clamped"}, "loading": {**MOMENT}},
        "edge: top: the surface has only bottom",
    ),
    (
        CAP,
        {"points": {"rim": [0, 0, 1]}, "boundary": {"rim": {"held": ["z"]}}},
        "boundary.rim: is an edge and a point; give the point another name",
    ),
]


@pytest.mark.parametrize(("shell", "sections", "said"), NAMES)
def test_names_are_known_before_anything_is_solved(
    shell: dict[str, Any], sections: dict[str, Any], said: str
) -> None:
    """`magshell check` and `run` make the same triangulation."""
    data = {
        "shell": {**COMMON, **shell, "youngs_modulus": 1},
        "boundary": {},
        "mesh": {"size": 0.4},
        **sections,
    }
    with pytest.raises(MeshError, match=said):
        make_problem(Case.from_source(Source("test", data))).triangulated()
    with pytest.raises(CaseError, match=said):
        describe(Case.from_source(Source("test", data)))


def test_loads_on_the_edge_of_a_surface_with_a_pole() -> None:
    load = {"kind": "dead", "loads": [{"edge": "bottom", "per_length": [0, 0, 1]}], "factor": 1}
    data = {
        "shell": {**PARABOLOID, "youngs_modulus": 1},
        "boundary": {"bottom": {"held": ["x", "y"]}},
        "loading": load,
    }
    assert built(data["shell"], boundary=data["boundary"], loading=load).edges.keys() == {"bottom"}


CYLINDER = {"geometry": "cylinder", "radius": 1, "length": 1}
PLATE = {"geometry": "plate", "length": 1, "width": 1}
SQUARE = dict.fromkeys(("left", "right", "bottom", "top"), "hinged")
STRIP = {"geometry": "strip", "radius_to_thickness": 100, "width": 0.1, "poisson_ratio": 0}
ROOT = {"root": "clamped"}
OPEN: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    (CYLINDER, {"bottom": "clamped"}, "top"),
    (CYLINDER, {"bottom": "clamped", "top": {"held": ["x", "y"]}}, "top"),
    (PLATE, SQUARE | {"top": "free"}, "top"),
    (STRIP, ROOT, "tip"),
    (STRIP, {**ROOT, "tip": "clamped"}, "sides"),
]
CLOSED = [
    (CYLINDER, {"bottom": "symmetry", "top": {"held": ["x", "y", "z"]}}),
    (PLATE, SQUARE),
    (PLATE, SQUARE | {"left": "symmetry"}),
    (STRIP, {**ROOT, "tip": "clamped", "sides": "simply supported"}),
    ({"geometry": "torus", "radius": 1, "tube_radius": 0.3}, {}),
]


def pressed(shell: dict[str, Any], boundary: dict[str, Any]) -> Case:
    common = {} if shell is STRIP else COMMON
    data = {"shell": {**common, **shell}, "boundary": boundary, "loading": {"kind": "pressure"}}
    return Case.from_source(Source("test", data))


def open_to_pressure(shell: dict[str, Any], boundary: dict[str, Any]) -> list[str]:
    problem = make_problem(pressed(shell, boundary))
    edges = problem.triangulated().edges
    sides = {
        name: {tuple(pair) for pair in np.sort(edge, axis=1).tolist()}
        for name, edge in edges.items()
    }
    return moving_edges(sides, problem.conditions)


@pytest.mark.parametrize(("shell", "boundary", "edge"), OPEN)
def test_edges_that_a_live_pressure_leaves_open(
    shell: dict[str, Any], boundary: dict[str, Any], edge: str
) -> None:
    """The variation of int x.n/3 has the line integral of dx.(x cross t)/3 on every edge that can
    move.
    """
    assert edge in open_to_pressure(shell, boundary)


@pytest.mark.parametrize(("shell", "boundary"), CLOSED)
def test_live_pressure_where_edges_are_held(
    shell: dict[str, Any], boundary: dict[str, Any]
) -> None:
    assert open_to_pressure(shell, boundary) == []
