"""Shells that touch themselves: derivatives, patch tests, nearest places, and what is refused."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from magshell_fenicsx import Case, Scene
from magshell_fenicsx.assembly.nonlocal_terms import times
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.models.shell.antisymmetric import AntisymmetricModes
from magshell_fenicsx.parts.contact.surface_contact import SurfaceContact
from magshell_fenicsx.parts.contact.symmetry_images import ContactWithImages

Array = NDArray[np.float64]
RING: dict[str, Any] = {
    "shell": {
        "geometry": "cylinder", "radius": 1, "length": 0.12, "thickness": 0.02, "youngs_modulus": 1,
        "poisson_ratio": 0
    },
    "boundary": {
        "bottom": "symmetry", "top": "symmetry",
        "east": {"held": ["y"]}, "west": {"held": ["y"]}, "north": {"held": ["x"]},
    },
    "points": {"east": [1, 0, 0], "west": [-1, 0, 0], "north": [0, 1, 0]},
    "contact": [["shell", "shell"]],
    "mesh": {"size": 0.2, "degree": 3},
    "loading": {"kind": "pressure"},
    "symmetry": "none",
}  # fmt: skip


@cache
def ring() -> Scene:
    return Scene(Case.model_validate(RING))


def touching() -> SurfaceContact:
    (found,) = ring().model.shell_contacts
    assert isinstance(found, SurfaceContact)
    return found


def flattened(
    half: float,
    tilt: float,
    noise: float = 0.0,
    seed: int = 0,
    of: Scene | None = None,
    across: int = 1,
    wide: float = 0.4,
) -> Array:
    """The ring with walls at +-half h (1 + tilt x) where |x| < 0.5, and wide ends, with noise over
    h.

    Across x in place of y the wall in the east stays.
    """
    model = (of or ring()).model
    h, r = model.material.h, model.r0.x.array.reshape(-1, 3)
    u = np.zeros_like(r)
    along, far = r[:, 1 - across], r[:, across]
    width = half * h * (1 + tilt * along) + wide * np.maximum(np.abs(along) - 0.5, 0) ** 2
    u[:, across] = (
        np.tanh(far / 0.2) * width - far + (1 - across) * (1 - np.tanh(1 / 0.2) * half * h)
    )
    rough = np.random.default_rng(seed).standard_normal(u.size)
    return model.system.zero_at_supports((u.ravel() + noise * h * rough)[: model.system.size])


@pytest.mark.parametrize("seed", range(2))
def test_derivatives(seed: int) -> None:
    """Central differences of the energy and of the forces at a rough state, some points open: 1e-6.

    With the first number the cuts are those of the undeformed ring, of which no place faces
    another; with the others cells are cut where the walls have slid along each other.
    """
    system, h, mu = ring().model.system, ring().model.material.h, ring().unloaded().mu
    u, term = flattened(0.497, 0.02, 0.002, seed), touching()
    if seed:
        r = ring().model.r0.x.array.reshape(-1, 3)
        slid = u.reshape(-1, 3) + 0.7 * seed * h * np.outer(np.tanh(r[:, 1] / 0.2), [1, 0, 0])
        mu = mu | {
            term.pair.cuts: system.at_state(State(slid.ravel(), mu)).evaluate(term.improved_cuts)
        }
        assert (
            system.at_state(State(u, mu)).evaluate(lambda: len(term._active_set().places.point))
            > 2000
        )
    v = system.zero_at_supports(
        1e-7 * h * np.random.default_rng(seed + 9).standard_normal(system.size)
    )
    at = system.at_state(State(u, mu))
    entries = at.evaluate(term.entries)
    forces = [system.forces(u + side * v, mu, term.name) for side in (-0.5, 0.5)]
    Kv = times([(1.0, entries)], v)
    assert np.abs(forces[1] - forces[0] - Kv).max() < 1e-6 * np.abs(Kv).max()
    energies = [system.energies(u + side * 100 * v, mu)[term.name] for side in (-0.5, 0.5)]
    assert energies[1] - energies[0] == pytest.approx(
        100 * system.forces(u, mu, term.name) @ v, rel=1e-5
    )
    other = system.zero_at_supports(np.random.default_rng(seed).standard_normal(system.size))
    assert other @ Kv == pytest.approx(
        v @ times([(1.0, entries)], other), rel=1e-9
    )  # it is symmetric
    assert at.evaluate(term.least_gap) < 0


def test_the_tangent_holds_what_couples() -> None:
    """The assembled tangent of all terms, also where nothing touched at first."""
    system, h, mu = ring().model.system, ring().model.material.h, ring().unloaded().mu
    v = system.zero_at_supports(1e-8 * h * np.random.default_rng(1).standard_normal(system.size))
    for half in (0.6, 0.499, 0.6):
        u = flattened(half, 0.02)
        K = system.tangent(u, mu)
        given = K.createVecRight()
        given.array[:] = v
        Kv = (K * given).array * (system.zero_at_supports(np.ones(system.size)) != 0)
        low, high = (system.residual(u + side * v, mu) for side in (-0.5, 0.5))
        assert np.abs(high - low - Kv).max() < 1e-6 * np.abs(Kv).max()


def test_states_with_the_same_cuts_share_a_pattern() -> None:
    """The matrix is one object, which is analysed once, and its values are of the state alone."""
    system, mu, term = ring().model.system, ring().unloaded().mu, touching()
    u, deeper = (flattened(half, 0.02) for half in (0.499, 0.498))
    mu = mu | {term.pair.cuts: system.at_state(State(u, mu)).evaluate(term.improved_cuts)}
    K = system.tangent(u, mu)
    first = K.getValuesCSR()[2]
    assert system.tangent(deeper, mu).handle == K.handle
    assert np.abs(K.getValuesCSR()[2] - first).max() > 1e-3 * np.abs(first).max()
    assert system.tangent(u, mu).handle == K.handle
    assert (K.getValuesCSR()[2] == first).all()


@pytest.mark.parametrize(
    ("law", "across", "factor"),
    [("neo-hookean", 0, None), ("koiter", 1, "1 + 0.1*x + y**2/9")],
)
def test_a_half_touches_its_image(law: str, across: int, factor: str | None) -> None:
    """Walls that meet in the plane, or are pressed together across it: the energy and its
    variations, also by antisymmetric additions, are half of those of the whole ring; the force is
    that of the whole;
    1e-9.
    """
    pressed = {"tilt": 0.02 * across, "across": across, "wide": 0.4 if law == "koiter" else 2.5}
    shell = RING["shell"] | ({"law": law, "poisson_ratio": 0.5} if law != "koiter" else {})
    shell |= {"thickness_factor": factor} if factor else {}
    held = {**RING["boundary"], "east": {"held": ["x", "y", "z"]}}
    points = {name: RING["points"][name] for name in ("east", "west")}
    held.pop("north")
    half, whole = (
        Scene(
            Case.model_validate(
                RING | {"shell": shell, "boundary": held, "points": points, "symmetry": symmetry}
            )
        )
        for symmetry in ("half", "none")
    )
    plane, other = half.problem.mirror, half.model.symmetry_breaking_modes
    assert plane is not None
    assert isinstance(other, AntisymmetricModes)
    places, all_places = (scene.model.r0.x.array.reshape(-1, 3) for scene in (half, whole))
    beyond = plane.signed_distance(all_places) < -1e-9
    far, node = cKDTree(places).query(
        np.where(beyond[:, None], plane.image(all_places), all_places)
    )
    assert far.max() < 1e-12
    (own,), (of_whole,) = (scene.model.shell_contacts for scene in (half, whole))
    system, state = (
        half.model.system,
        State(flattened(0.497, of=half, **pressed), half.unloaded().mu),
    )
    system_of_whole, state_of_whole = (
        whole.model.system,
        State(flattened(0.497, of=whole, **pressed), whole.unloaded().mu),
    )
    force, force_of_whole = (
        scene.model.system.at_state(at).evaluate(each.force) / scene.model.force_unit
        for scene, at, each in ((half, state, own), (whole, state_of_whole, of_whole))
    )
    assert force == pytest.approx(force_of_whole, rel=1e-9)
    energy = system.energies(state.u, state.mu)[own.name]
    assert system_of_whole.energies(state_of_whole.u, state_of_whole.mu)[own.name] == pytest.approx(
        2 * energy, rel=1e-9
    )
    entries_of_whole = system_of_whole.at_state(state_of_whole).evaluate(of_whole.entries)
    forces, forces_of_whole = (
        each.forces(at.u, at.mu, own.name)
        for each, at in ((system, state), (system_of_whole, state_of_whole))
    )
    for of, sign in ((system, 1.0), (other.system, -1.0)):
        v = of.zero_at_supports(np.random.default_rng(4).standard_normal(of.size))
        image = sign * v.reshape(-1, 3)[node] @ plane.reflection
        v_of_whole = np.where(beyond[:, None], image, v.reshape(-1, 3)[node]).ravel()
        (term,) = (each for each in of.terms if isinstance(each, ContactWithImages))
        second = v @ times([(1.0, of.at_state(state).evaluate(term.entries))], v)
        assert v_of_whole @ times([(1.0, entries_of_whole)], v_of_whole) == pytest.approx(
            2 * second, rel=1e-9
        )
        first = forces @ v if sign > 0 else 0.0
        assert forces_of_whole @ v_of_whole == pytest.approx(
            2 * first, rel=1e-9, abs=1e-9 * abs(forces @ v)
        )


def test_the_material_around_a_point_does_not_touch_it() -> None:
    """A ring that is bent to any shape without contact has none; nor has it energy."""
    system, mu = ring().model.system, ring().unloaded().mu
    assert system.energies(0 * flattened(0.6, 0.0), mu)[touching().name] == 0
    assert system.energies(flattened(0.6, 0.0), mu)[touching().name] == 0
    at = system.at_state(State(0 * flattened(0.6, 0.0), mu))
    assert np.isnan(
        at.evaluate(touching().least_gap)
    )  # the farthest place of a ring is no nearest one


def test_nearest_places() -> None:
    """Against a search over a fine lattice of all cells that are not beside a point."""
    model, term = ring().model, touching()
    at = model.system.at_state(State(flattened(0.7, 0.3, 0.01), ring().unloaded().mu))
    h, cells, points = model.material.h, term._cells, term._rule
    places = at.evaluate(lambda: term._search.projections(term._displacement(), 4 * h))
    r = at.evaluate(lambda: term._r0 + term._displacement())
    x, n = term._search.places_of_points(points, r), 40
    X = np.array([(i, j) for i in range(n + 1) for j in range(n + 1 - i)]) / n
    fine = np.einsum("mk,nki->nmi", cells.element.tabulate(0, X)[0, :, :, 0], r[cells.nodes])
    inner = np.flatnonzero(np.abs(x[places.point, 0]) < 0.4)
    assert len(inner) > 300
    for k in inner[::20]:
        i = points.cell[places.point[k]]
        _, far = term._search._select_pairs(
            np.full(len(cells.nodes), i), np.arange(len(cells.nodes)), 0.0
        )
        least = np.linalg.norm(fine[far] - x[places.point[k]], axis=-1).min()
        assert places.distance[k] <= least + 1e-12
        assert places.distance[k] == pytest.approx(least, abs=0.05 * h)


@pytest.mark.slow
def test_the_least_gap_of_shells_that_are_apart() -> None:
    """As of the search for all places within the reach, in few of these; with the images of a
    sector."""
    cap = {
        "geometry": "cap",
        "radius": 1,
        "polar": 20,
        "hole": 2,
        "poisson_ratio": 0.3,
        "youngs_modulus": 1,
    }
    lower, upper = (
        {"shell": cap | {"thickness": h}, "boundary": {"rim": "hinged"}} for h in (0.036, 0.024)
    )
    shells = {"lower": lower, "upper": upper | {"place": {"position": [0, 0, 0.05]}}}
    loading = {
        "kind": "dead",
        "loads": [{"edge": "upper.hole", "force": [0, 0, -1]}],
        "until": "target",
        "factor": 1,
    }
    case = {
        "shells": shells,
        "contact": [["upper", "lower"]],
        "mesh": {"size": 0.08, "degree": 3},
        "loading": loading,
    }
    scene = Scene(Case.model_validate(case | {"symmetry": 6}))
    (term,), system = scene.model.shell_contacts, scene.model.system
    assert isinstance(term, ContactWithImages)
    u = system.zero_at_supports(2e-3 * np.random.default_rng(3).standard_normal(system.size))
    at = system.at_state(State(u, scene.unloaded().mu))
    facing, far, points = (
        term._search,
        term._reach,
        at.evaluate(lambda: term._active_set() and term._points),
    )
    every, few = (
        at.evaluate(
            lambda least=least: facing.projections(
                term._displacement(), far, points, least_only=bool(least)
            )
        )
        for least in (0, 1)
    )
    assert len(few.point) < 3 * len(points.cell) < len(every.point)
    nearest = np.full((2, len(points.cell)), np.inf)
    for distance, places in zip(nearest, (every, few), strict=True):
        np.minimum.at(distance, places.point, places.distance)
    assert np.isfinite(nearest).all()
    assert nearest[1] == pytest.approx(nearest[0], abs=1e-13)
    assert at.evaluate(term.least_gap) == pytest.approx(nearest[0].min() - term._h, abs=1e-13)


@pytest.mark.parametrize("deep", [3e-3, 0.2])
def test_folds_between_cells_have_no_jump(deep: float) -> None:
    """On large cells some points are opposite a side, where their nearest place changes cells:
    differences 1e-6.
    """
    thick = {**RING["shell"], "thickness": 0.08}
    scene = Scene(Case.model_validate(RING | {"shell": thick, "mesh": {"size": 0.3, "degree": 3}}))
    model, (term,) = scene.model, scene.model.shell_contacts
    system, h, r = model.system, model.material.h, model.r0.x.array.reshape(-1, 3)
    u = np.zeros_like(r)
    u[:, 1] = np.tanh(r[:, 1] / 0.3) * ((1 - deep) * h / 2 + 0.4 * r[:, 0] ** 2) - r[:, 1]
    u = system.zero_at_supports(u.ravel()[: system.size])
    v = system.zero_at_supports(1e-8 * h * np.random.default_rng(0).standard_normal(system.size))
    mu = scene.unloaded().mu
    at = system.at_state(State(u, mu))
    Kv = times([(1.0, at.evaluate(term.entries))], v)
    active = at.evaluate(term._active_set)
    assert active.joined_places.several.any()
    low, high = (system.forces(u + side * v, mu, term.name) for side in (-0.5, 0.5))
    assert np.abs(high - low - Kv).max() < 1e-6 * np.abs(Kv).max()


def test_a_step_that_passes_through() -> None:
    """Walls that change places on the straight way, and walls that only come near."""
    system, h = ring().model.system, ring().model.material.h
    here, there, near = (flattened(half, 0.0).reshape(-1, 3) for half in (0.7, -0.7, 0.51))
    assert touching().passes_through(here, there)
    assert not touching().passes_through(here, near)
    assert not touching().passes_through(here, here + 100 * h * np.array([0, 0, 1.0]))
    assert system.size == here.size


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            {"contact": [["shell", "other"]]},
            "other: allowed: shell; parts are the patches of a mesh file",
        ),
        ({"contact": [["shell", "shell"], ["shell", "shell"]]}, "a pair that stands twice"),
    ],
)
def test_what_is_refused(changed: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said.replace("(", r"\(")):
        Case.model_validate(RING | changed)
