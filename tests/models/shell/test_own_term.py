"""One's own energies: what is found from a density, and that they go the way of the shell's own."""

import ctypes
from collections.abc import Callable

import numpy as np
import pytest
import ufl
from along import difference as tangent_difference
from conftest import CASES, TILTED, hemisphere, random_displacement
from test_fast_residual import difference as residual_difference
from ufl.core.expr import Expr

from magshell_fenicsx import Case, CaseError, Jet, OwnTerm, Scene
from magshell_fenicsx.case.planner import make_problem
from magshell_fenicsx.continuation.system import dot
from magshell_fenicsx.input.source import Source
from magshell_fenicsx.mesh.mirror import Y0_PLANE
from magshell_fenicsx.models.shell import densities
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.law import Koiter
from magshell_fenicsx.models.shell.parameters import AreaForce, Material
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.shells.shell import ShellModel
from magshell_fenicsx.simulate.follow import follow

E1, E2, E3 = np.eye(3)
Density = Callable[..., Expr]


def winkler(r0: Jet, u: Jet) -> Expr:
    return ufl.dot(u.r, kin.normal(r0)) ** 2 / 2


def weight(r0: Jet, u: Jet, g: Expr) -> Expr:
    return -ufl.dot(g, u.r)


def hydrostatic(r0: Jet, u: Jet, depth: Expr) -> Expr:
    """A live pressure that grows downwards, on a surface per undeformed area; not a potential at
    free edges.
    """
    r = r0 + u
    return (
        (depth - r.r[2] / 2)
        * r.r[2]
        * ufl.dot(kin.area_vector(r), ufl.as_vector([0, 0, 1]))
        / kin.area_ratio(r0)
    )


def stretching(r0: Jet, u: Jet) -> Expr:
    return ufl.tr(kin.mixed(kin.membrane_strain(r0, u), kin.inverse_metric(r0))) ** 2


def one_sided(r0: Jet, u: Jet) -> Expr:
    """A floor in the way of the lower half."""
    gap = (r0 + u).r[2] - 0.5
    return ufl.conditional(ufl.lt(gap, 0), gap**2, 0)


def twisting(r0: Jet, u: Jet) -> Expr:
    return ufl.dot(ufl.as_vector([0, 0, 1]), ufl.cross(r0.r, u.r))


def tilted(r0: Jet, u: Jet) -> Expr:
    """The normal's direction, an energy of first derivatives."""
    return -ufl.dot(kin.normal(r0 + u), ufl.as_vector([0.6, 0.0, 0.8]))


DENSITIES: dict[
    str, tuple[Density, tuple[np.ndarray | float, ...], tuple[str, ...], bool, bool, bool]
] = {
    # of what, whether linear, whether it turns about e3, whether it is mirrored in y = 0
    "winkler": (winkler, (), ("r",), False, True, True),
    "weight along e3": (weight, (E3,), ("r",), True, True, True),
    "weight along e1": (weight, (E1,), ("r",), True, False, True),
    "weight along e2": (weight, (E2,), ("r",), True, False, False),
    "hydrostatic": (hydrostatic, (2.0,), ("r", "r1", "r2"), False, True, True),
    "stretching": (stretching, (), ("r1", "r2"), False, True, True),
    "one-sided": (one_sided, (), ("r",), False, True, True),
    "twisting": (twisting, (), ("r",), True, True, False),
    "tilted": (tilted, (), ("r1", "r2"), False, False, True),
}


@pytest.mark.parametrize("name", DENSITIES)
def test_what_is_found_from_a_density(name: str) -> None:
    of, parameters, parts, linear, turns, mirrors = DENSITIES[name]
    term = OwnTerm("own", of, parameters)
    assert (term.parts, term.linear, term.turns, term.mirrored(Y0_PLANE)) == (
        parts,
        linear,
        turns,
        mirrors,
    )


def test_far_floor_is_not_taken_for_linear() -> None:
    """Where it is not touched the energy is zero, but not everywhere."""
    term = OwnTerm(
        "floor",
        lambda r0, u: ufl.conditional(ufl.lt((r0 + u).r[2], -10), ((r0 + u).r[2] + 10) ** 2, 0),
    )
    assert not term.linear


def test_density_that_is_not_defined_everywhere() -> None:
    """Has no symmetry that could be relied on."""
    term = OwnTerm("own", lambda r0, u: ufl.ln(r0.r[2]) * u.r[2])
    assert not term.turns
    assert not term.mirrored(Y0_PLANE)


OBSERVED: dict[str, tuple[Density, bool, bool]] = {
    # whether it turns about e3, whether it is mirrored in y = 0
    "u_x": (lambda r0, u: u.r[0], False, True),
    "u_y": (lambda r0, u: u.r[1], False, False),
    "u_z": (lambda r0, u: u.r[2], True, True),
    "twist": (twisting, True, False),
}


@pytest.mark.parametrize("name", OBSERVED)
def test_symmetry_of_what_is_observed(name: str) -> None:
    """Beside an energy that turns and mirrors."""
    of, turns, mirrors = OBSERVED[name]
    term = OwnTerm("own", winkler, (), observed={"seen": of})
    assert (term.turns, term.mirrored(Y0_PLANE)) == (turns, mirrors)


def test_another_observed_density_is_another_term() -> None:
    """A run is resumed with the same columns alone."""
    one, other = (
        OwnTerm(
            "own",
            None,
            observed={"first": winkler, "second": lambda r0, u, n=n: ufl.dot(u.r, u.r) ** n},
        )
        for n in (1, 2)
    )
    assert one.digest != other.digest


def test_whole_value_of_what_is_observed() -> None:
    """A cap under a load along x: the sum of u_y cancels, and that of u_x is the same on the model
    that is found.
    """
    shell = {
        "geometry": "cap",
        "radius": 1.0,
        "thickness": 0.05,
        "poisson_ratio": 0.3,
        "youngs_modulus": 1.0,
    }
    loads = [{"over": "all", "per_area": [1e-7, 0, 0]}]
    data = {
        "shell": shell,
        "boundary": {"rim": "clamped"},
        "mesh": {"degree": 2, "refinement": 0.4},
    }
    data |= {"loading": {"kind": "dead", "loads": loads, "factor": 1, "points": 1}}

    def observed(symmetry: str, **columns: Density) -> tuple[str, dict[str, float]]:
        case = Case.from_source(data | {"symmetry": symmetry})
        scene = Scene(case, terms=[OwnTerm("springs", winkler, value=1e-6, observed=columns)])
        *_, end = follow(scene)
        values = scene.observe(end.point.state)
        return scene.problem.included[0], {name: values[name] for name in columns}

    along, across = OBSERVED["u_x"][0], OBSERVED["u_y"][0]
    half, found = observed("auto", along=along)
    assert half.startswith("half")
    full, both = observed("auto", along=along, across=across)
    assert full.startswith("full")
    assert found["along"] == pytest.approx(both["along"], rel=1e-2)  # the two meshes differ
    assert abs(both["across"]) < 1e-3 * abs(both["along"])
    with pytest.raises(
        CaseError, match="symmetry: half: the energy springs or what it observes does not share it"
    ):
        observed("half", across=across)


@pytest.mark.parametrize(
    "energy", ["magnetic", "magnetic_first", "magnetic_torque", "magnetic_tau", "magnetic_couple"]
)
def test_symmetry_of_the_magnetic_densities(energy: str) -> None:
    """Fields along e3 turn and mirror; in the plane y = 0 they mirror; across it they do not."""
    of = getattr(densities, energy)
    fields = [(E3, E1 + E3, False, True), (E3, E3, True, True), (E3, E2 + E3, False, False)]
    for Br, Ba, turns, mirrors in fields if energy == "magnetic" else fields[:1]:
        term = OwnTerm("own", of, (Br, Ba))
        assert (term.turns, term.mirrored(Y0_PLANE)) == (turns, mirrors)


@pytest.mark.parametrize(
    ("name", "of", "said"),
    [
        ("a b", winkler, "identifier"),
        ("own", lambda r0, u: u.r, "shape"),
        ("own", lambda r0, u: ufl.dot(r0.r, r0.r), "does not depend"),
        (
            "own",
            lambda r0, u: u.r[0] * ufl.SpatialCoordinate(hemisphere(0.8).mesh)[0],
            "jets and parameters alone",
        ),
        (
            "own",
            lambda r0, u: densities.bending(r0, u, law=Koiter(0.1, 0.3)),
            "u.r11, u.r12, u.r22",
        ),
    ],
)
def test_what_no_term_can_be(name: str, of: Density, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        OwnTerm(name, of)


@pytest.mark.parametrize(
    "name", ["winkler", "weight along e1", "hydrostatic", "stretching", "one-sided", "tilted"]
)
def test_residual_and_tangent(name: str) -> None:
    """Of the point derivatives against those of the forms, on a shell with all other terms too."""
    of, parameters, *_ = DENSITIES[name]
    loads = Loads(pressure=True, magnetic=TILTED, user_terms=(OwnTerm("own", of, parameters),))
    model = ShellModel(hemisphere(0.8), Material(0.3, 0.05), 2, {"rim": "clamped"}, loads)
    u = random_displacement(model, 1e-2)
    for mu in (
        {"lambda_m": 0.4, "pressure": 0.3, "own": 1.3},
        {"lambda_m": 0.0, "pressure": 0.0, "own": 20.0},
    ):
        assert tangent_difference(model.system, u, mu) <= 1e-12
        assert residual_difference(model.system, u, mu) <= 1e-12


@pytest.mark.parametrize("name", ["winkler", "weight along e1", "hydrostatic", "tilted"])
def test_load_is_the_derivative_of_the_potential(name: str) -> None:
    """Central differences along a random displacement."""
    of, parameters, *_ = DENSITIES[name]
    loads = Loads(user_terms=(OwnTerm("own", of, parameters),))
    system = ShellModel(hemisphere(0.8), Material(0.3, 0.05), 2, {"rim": "clamped"}, loads).system
    model_u, v = (
        system.zero_at_supports(1e-2 * np.random.default_rng(i).standard_normal(system.size))
        for i in range(2)
    )
    step = 1e-3
    slope = (
        system.potential(model_u + step * v, {}, "own")
        - system.potential(model_u - step * v, {}, "own")
    ) / (2 * step)
    assert slope == pytest.approx(dot(system.comm, system.load(model_u, {}, "own"), v), rel=1e-6)


@pytest.mark.parametrize(
    ("file", "symmetry", "size"),
    [
        ("dimple_buckling.yaml", "half", 1e-2),
        ("solid_buckling.yaml", "half", 1e-4),
    ],
)
def test_the_shells_own_pressure_as_ones_own(file: str, symmetry: str, size: float) -> None:
    """The same density by both ways: potentials, load columns and residuals agree."""
    settings = ["mesh.degree=2", "mesh.refinement=0.5", f"symmetry={symmetry}"]
    case = Case.load(CASES / file, settings)
    unit = (
        Material(case.shell.poisson_ratio, 1 / case.shell.R_over_h).classical_pressure
        * case.shell.R_over_h
    )

    def pressure(r0: Jet, u: Jet, unit: Expr) -> Expr:
        return unit * densities.volume(r0, u) / kin.area_ratio(r0)

    scene = Scene(case, terms=[OwnTerm("own", pressure, (unit,))])
    system = scene.model.system
    u = system.zero_at_supports(size * np.random.default_rng(0).standard_normal(system.size))
    assert system.potential(u, {}, "own") == pytest.approx(
        system.potential(u, {}, "pressure"), rel=1e-11
    )
    ours, theirs = system.load(u, {}, "own"), system.load(u, {}, "pressure")
    assert np.abs(ours - theirs).max() < 1e-11 * np.abs(theirs).max()
    mu = {"own": -0.7, "pressure": 0.7}
    assert np.abs(system.residual(u, mu) - system.residual(u, dict.fromkeys(mu, 0.0))).max() < 1e-10


def test_weight_is_a_dead_load_on_any_surface() -> None:
    """On a cylinder: the column of the case file's own force per area."""
    case = Case.from_source(
        Source(
            "cylinder",
            {
                "shell": {
                    "geometry": "cylinder",
                    "radius": 100,
                    "length": 100,
                    "azimuth": [0, 90],
                    "thickness": 2,
                    "youngs_modulus": 30.0e3,
                    "poisson_ratio": 0.3,
                },
                "boundary": {"bottom": "clamped"},
                "loading": {
                    "kind": "dead",
                    "loads": [{"over": "all", "per_area": [0.1, 0.2, -0.3]}],
                    "factor": 1,
                },
                "mesh": {"size": 50, "degree": 3},
            },
        )
    )
    (dead,) = make_problem(case).loads.all_dead
    assert isinstance(dead, AreaForce)
    system = Scene(case, terms=[OwnTerm("own", weight, (dead.force,))]).model.system
    u = system.zero_at_supports(1e-2 * np.random.default_rng(0).standard_normal(system.size))
    ours, theirs = system.load(u, {}, "own"), system.load(u, {}, "load")
    assert np.abs(theirs).max() > 0
    assert np.abs(ours - theirs).max() < 1e-11 * np.abs(theirs).max()
    assert system.potential(u, {}, "own") == pytest.approx(
        system.potential(u, {}, "load"), rel=1e-9
    )


@pytest.mark.parametrize(
    ("name", "built"),
    [("winkler", "meridian"), ("weight along e1", "half shell"), ("weight along e2", "half shell")],
)
def test_smallest_model_that_shares_the_symmetry(name: str, built: str) -> None:
    of, parameters, *_ = DENSITIES[name]
    case = Case.load(CASES / "dimple_buckling.yaml")
    problem = make_problem(case, [OwnTerm("own", of, parameters)])
    assert problem.included[0] == built
    assert problem.included[-1] == "own energy: own"


def test_half_model_of_another_plane() -> None:
    """The half shell's frame is turned to its mirror plane. So is a direction in this plane."""
    settings = [
        "magnetic={lambda_m: 1e-3, remanent: {polar: 30, azimuth: 20}, "
        "applied: {polar: 60, azimuth: 20}}"
    ]
    case = Case.load(CASES / "dimple_buckling.yaml", settings)
    assert make_problem(case, [OwnTerm("own", winkler)]).is_half
    assert not make_problem(case, [OwnTerm("own", weight, (E1,))]).is_half
    within = np.array([np.cos(np.radians(20)), np.sin(np.radians(20)), 0.5])
    problem = make_problem(case, [OwnTerm("own", weight, (within,))])
    assert problem.is_half
    assert problem.azimuth == pytest.approx(np.radians(20))


@pytest.mark.parametrize(
    ("settings", "names", "said"),
    [
        (["symmetry=axisymmetric"], ["own"], "symmetry: axisymmetric: the energy own"),
        (["symmetry=half"], ["own"], "symmetry: half: the energy own"),
        ([], ["pressure"], "terms: pressure"),
        ([], ["w_over_h"], "terms: w_over_h"),
        ([], ["own", "own"], "terms: own"),
    ],
)
def test_what_the_plan_refuses(settings: list[str], names: list[str], said: str) -> None:
    case = Case.load(CASES / "dimple_buckling.yaml", settings)
    with pytest.raises(CaseError, match=said):
        make_problem(case, [OwnTerm(name, weight, (E1 + E2,)) for name in names])


def test_a_solid_has_no_curvature() -> None:
    case = Case.load(CASES / "solid_buckling.yaml")

    def mean_curvature(r0: Jet) -> Expr:
        b11, b12, b22 = (ufl.dot(kin.normal(r0), second) for second in (r0.r11, r0.r12, r0.r22))
        return (
            ufl.tr(kin.mixed(ufl.as_matrix([[b11, b12], [b12, b22]]), kin.inverse_metric(r0))) / 2
        )

    curved = OwnTerm("own", lambda r0, u: mean_curvature(r0) * u.r[2])
    with pytest.raises(CaseError, match=r"own depends on r0\.r11, r0\.r12, r0\.r22, which only"):
        make_problem(case, [curved])


def test_parameters_need_no_new_kernel() -> None:
    """Densities are compiled by what they are, not by the numbers in them."""
    models = [
        ShellModel(
            hemisphere(0.8),
            Material(0.3, 0.05),
            2,
            {"rim": "clamped"},
            Loads(user_terms=(OwnTerm("own", weight, (g,)),)),
        )
        for g in (E3, 2 * E3)
    ]
    served = [next(t for t in m.system.terms if t.name == "own").points for m in models]  # type: ignore[attr-defined]
    kernels = [
        next(part for part in each._parts if "own" in part.names)._points.gradient
        for each in served
    ]
    one, other = (ctypes.cast(kernel._function, ctypes.c_void_p).value for kernel in kernels)
    assert one == other
    u = random_displacement(models[0], 1e-2)
    assert models[1].system.potential(u, {}, "own") == pytest.approx(
        2 * models[0].system.potential(u, {}, "own")
    )


@pytest.mark.parametrize(("model", "symmetry"), [("shell", "half"), ("solid", "half")])
def test_a_term_that_only_observes(model: str, symmetry: str) -> None:
    """The mean displacement of the hanging strip is ρ g L²/(3 E), its area before that L²/10; no
    amplitude is added.
    """
    sections = {
        "model": model,
        "shell": {
            "geometry": "strip",
            "width": 0.1,
            "radius_to_thickness": 50.0,
            "poisson_ratio": 0.0,
        },
        "boundary": {"root": "clamped"},
        "loading": {"kind": "gravity", "direction": [1, 0, 0], "acceleration": 1e-3, "points": 1},
        "symmetry": symmetry,
    }
    seen = {"mean_ux": lambda r0, u: 10 * u.r[0], "area": lambda r0, u: ufl.as_ufl(1.0)}
    case = Case.from_source(sections)
    scene = Scene(case, terms=[OwnTerm("mean", None, observed=seen, of_volume=model == "solid")])
    *_, record = follow(scene)
    row = scene.observe(record.point.state)
    assert row["mean_ux"] == pytest.approx(1e-3 / 3, rel=2e-3)
    assert row["area"] == pytest.approx(0.1)
    assert "mean" not in scene.extra_columns
    assert "mean" not in record.point.state.mu


ALONG = (lambda r0, u: ufl.dot(u.r1, u.r1), lambda r0, u: ufl.dot(u.r1, u.r1) + ufl.dot(u.r2, u.r2))


@pytest.mark.parametrize(
    ("density", "observed", "on"),
    [
        *((of, {}, None) for of in ALONG),
        (None, {"seen": ALONG[0]}, None),
        (lambda r0, u: u.r[2], {"seen": lambda r0, u: ufl.dot(r0.r1, u.r)}, None),
        (lambda r0, u, edge: edge.stretch * u.r[2], {}, "rim"),
    ],
)
def test_cells_have_no_directions(
    density: Density | None, observed: dict[str, Density], on: str | None
) -> None:
    """r1 and r2 are along the sides of each cell: their lengths and directions are of the mesh, not
    of the shell."""
    with pytest.raises(
        ValueError,
        match=rf"own{': seen' if observed else ''}: depends on the coordinates of r1 and r2",
    ):
        OwnTerm("own", density, observed=observed, on=on)


def test_invariant_densities_are_accepted() -> None:
    """The surface's gradient, a bending energy that is observed, derivatives along an edge, one
    without a value."""

    def gradient(r0: Jet, u: Jet) -> Expr:
        up, along = kin.inverse_metric(r0), (u.r1, u.r2)
        return sum(up[i, j] * ufl.dot(along[i], along[j]) for i in range(2) for j in range(2))

    def bent(r0: Jet, u: Jet) -> Expr:
        return ufl.tr(kin.mixed(kin.curvature_change(r0, u), kin.inverse_metric(r0))) ** 2

    OwnTerm("own", gradient, observed={"bent": bent})
    OwnTerm("own", lambda r0, u, edge: ufl.dot(edge.by_outward(u), edge.by_length(u)), on="rim")
    OwnTerm("own", lambda r0, u: ufl.ln(r0.r[2]) * ufl.dot(kin.normal(r0 + u), u.r))
