"""The symmetry that each part of a case leaves; a model takes what all leave."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import atan2, hypot, pi

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.boundary import HeldSection
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.expressions import formula
from magshell_fenicsx.case.loading import DeadLoadSection, DeadSection, IndentationSection, RotationSection
from magshell_fenicsx.mesh.mirror import ROUNDING, Mirror
from magshell_fenicsx.plan.outline import Outline

Array = NDArray[np.float64]
Vectors = Sequence[Array]
PARALLEL = 1e-12


def _every(mirror: Mirror) -> bool:
    return True


def _none(mirror: Mirror) -> bool:
    return False


@dataclass(frozen=True)
class Leaves:
    """What one part leaves.

    Attributes
    ----------
    askew
        Why the case cannot be turned about e3 with this part; None if it can.
    vectors
        Vectors and places (3,) that a mirror plane through e3 must hold, so that they choose one.
    mirrors
        Whether a plane is left.
    """

    askew: str | None = None
    vectors: Vectors = ()
    mirrors: Callable[[Mirror], bool] = _every


def left(case: Case, outline: Outline, indented: Array | None) -> list[Leaves]:
    """What each part of a case leaves; `indented` is the place (3,) of an indentation, over R."""
    return [
        _shape(case, outline),
        *_supports(case),
        *(_field(case, outline) if case.magnetic and case.lambda_m else []),
        *_load(case, indented),
        *_named(case, outline),
    ]


def common_azimuth(vectors: Vectors) -> float | None:
    """Azimuth (rad) of the plane through e3 that holds all vectors; None if there is none.

    0 if every vector is along e3.
    """
    tilted = [v[:2] for v in vectors if hypot(*v[:2]) > PARALLEL]
    if not tilted:
        return 0.0
    x, y = tilted[0]
    if any(abs(x * v[1] - y * v[0]) > 1e-10 * hypot(x, y) * hypot(*v) for v in tilted):
        return None
    return atan2(y, x)


def mirror(parts: Sequence[Leaves], outline: Outline, *, loosely: bool = False) -> Mirror | None:
    """A plane that all parts leave, through e3 if there is one; None if there is none.

    Parameters
    ----------
    loosely
        Of a mesh file, see `mesh_mirrors`.
    """
    vectors = [v for part in parts for v in part.vectors]
    azimuth = common_azimuth(vectors) if outline.round else None
    upright: list[Mirror] = []
    if azimuth is not None:
        turns = (0.0, pi) if any(_tilted(v) for v in vectors) else (0.0, pi, pi / 2, -pi / 2)
        upright = [Mirror.upright(azimuth + turn) for turn in turns]

    def first(planes: Sequence[Mirror]) -> Mirror | None:
        return next((plane for plane in planes if all(part.mirrors(plane) for part in parts)), None)

    if any(part.mirrors is _none for part in parts):
        return None
    found = first(upright) or first(outline.mirrors([_unit(v) for v in vectors], False))
    return first(outline.mirrors([_unit(v) for v in vectors], True)) if loosely and not found else found


def askew(parts: Sequence[Leaves]) -> str | None:
    """What keeps a case from being a meridian turned about e3; None if nothing does."""
    return next((part.askew for part in parts if part.askew), None)


def _shape(case: Case, outline: Outline) -> Leaves:
    factor, geometry = case.thickness_factor, case.shell.geometry

    def mirrors(mirror: Mirror) -> bool:
        if not isinstance(factor, str):
            return True  # patches are mapped onto themselves
        x = outline.sample()
        return _alike(formula(factor)(*x.T), formula(factor)(*mirror.image(x).T))

    if not outline.disc:
        return Leaves("a meridian ends at a pole" if outline.round else f"not with a {geometry}", mirrors=mirrors)
    return Leaves("only the user knows whether the formula of the thickness is" if factor else None, mirrors=mirrors)


def _supports(case: Case) -> list[Leaves]:
    """A half does not see rigid motions across its plane: it needs a support against all."""
    conditions = case.boundary.conditions()
    found, fixed = list[Leaves](), False
    for name, condition in conditions.items():
        fixed = fixed or condition in ("clamped", "simply supported", "hinged")
        reason = None
        if isinstance(condition, HeldSection):
            fixed = fixed or len(condition.components) == 3
            reason = f"boundary.{name}: held components are those of e1, e2 and e3"
        elif condition == "symmetry":
            reason = f"boundary.{name}: a mirror plane of the case's own"
        found.append(Leaves(reason, mirrors=partial(_leaves_support, case, name)))
    if not fixed:
        found.append(Leaves("boundary: nothing is clamped, hinged or held as a whole", mirrors=_none))
    return found


def _leaves_support(case: Case, name: str, mirror: Mirror) -> bool:
    """The other half is held in the same way, and a point that is held is on the plane."""
    conditions = case.boundary.conditions()
    condition, other = conditions[name], conditions.get(mirror.other(name), "free")
    if isinstance(condition, HeldSection):
        held, S = np.diag([float(i in condition.components) for i in range(3)]), mirror.reflection
        if np.abs(S @ held @ S - held).max() > PARALLEL:
            return False
    place = case.points.get(name)
    off = 0.0 if place is None else float(mirror.beyond(np.array(place) / case.shell.reference))
    return abs(off) < ROUNDING and condition == other


def _field(case: Case, outline: Outline) -> list[Leaves]:
    """Remanence and applied field must both be symmetric to a plane, or both antisymmetric."""
    magnetic = case.magnetic
    assert magnetic
    vectors = [d.vector() for d in (*magnetic.remanent.directions(), magnetic.applied)]
    turning = [case.loading.to.vector()] if isinstance(case.loading, RotationSection) else []
    remanent, G = magnetic.remanent, np.array(magnetic.applied.gradient or np.zeros((3, 3)))
    fields: list[Callable[[Array], Array]] = [lambda x: np.asarray(x @ G.T)] if G.any() else []
    if remanent.components:
        texts = [formula(text) for text in remanent.components]
        fields.append(lambda x: np.stack([f(*x.T) for f in texts], axis=-1))
    askew = ["a field is not along e3"] if any(_tilted(v) for v in vectors) else []
    if remanent.components:
        askew.append("only the user knows whether the remanence's formula is")
    if np.abs(G - np.diag([G[0, 0], G[0, 0], G[2, 2]])).max() > PARALLEL:
        askew.append("the gradient of the applied field is not diag(a, a, b)")

    def mirrors(mirror: Mirror) -> bool:
        S, x = mirror.reflection, outline.sample() if fields else np.zeros((0, 3))

        def images(sign: float) -> bool:
            uniform = all(np.abs(S @ v - sign * v).max() <= 1e-10 for v in (*vectors, *turning))
            varying = all(
                _alike(sign * np.einsum("ni,ij->nj", field(x), S), field(mirror.image(x))) for field in fields
            )
            kinds = {"radial": 1.0, "tangential": float(S[2, 2])}
            return uniform and varying and kinds.get(remanent.kind, sign) == sign

        return images(1.0) or images(-1.0)

    return [Leaves(next(iter(askew), None), vectors, mirrors)]


def _load(case: Case, indented: Array | None) -> list[Leaves]:
    loading, R = case.loading, case.shell.reference
    if isinstance(loading, IndentationSection):
        assert indented is not None
        place = indented
        reason = "the force is not at the pole" if _tilted(place) else None
        return [Leaves(reason, [place], lambda mirror: bool(abs(mirror.beyond(place)) < ROUNDING))]
    if isinstance(loading, RotationSection):
        return [Leaves("the field turns", [loading.to.vector()])]
    if isinstance(loading, DeadSection):
        forces = [np.array(v) for load in loading.loads for v in (load.force, load.per_length, load.per_area) if v]
        places = [np.array(case.points[load.at]) / R for load in loading.loads if load.at]

        def mirrors(mirror: Mirror) -> bool:
            on_plane = all(abs(float(mirror.beyond(x))) < ROUNDING for x in places)
            return on_plane and all(any(_is_image(a, b, mirror) for b in loading.loads) for a in loading.loads)

        return [Leaves("a meridian takes no dead loads", [_unit(v) for v in (*forces, *places)], mirrors)]
    return []


def _is_image(load: DeadLoadSection, other: DeadLoadSection, mirror: Mirror) -> bool:
    edge = load.edge and mirror.other(load.edge)
    if (edge, load.at, load.over, load.moment, load.pressure) != (
        other.edge,
        other.at,
        other.over,
        other.moment,
        other.pressure,
    ):
        return False
    for here, there in ((getattr(x, key) for x in (load, other)) for key in ("force", "per_length", "per_area")):
        if (here is None) != (there is None):
            return False
        if here and np.abs(mirror.reflection @ here - there).max() > 1e-10 * np.linalg.norm(here):
            return False
    return True


def _named(case: Case, outline: Outline) -> list[Leaves]:
    """Named points lie on the half that is modelled, and so does the one that is reported without any."""
    places = [np.array(x) / case.shell.reference for x in case.points.values()]
    if not places and outline.highest is not None:
        places = [outline.embedding(outline.highest[None])[0]]

    def within(mirror: Mirror) -> bool:
        chosen = outline.round and mirror.through_e3 and not case.points  # then the chart begins at the plane
        return chosen or all(float(mirror.beyond(x)) > -ROUNDING for x in places)

    return [Leaves("points are named off the axis" if any(_tilted(x) for x in places) else None, mirrors=within)]


def _alike(here: Array, there: Array) -> bool:
    """Equal to rounding, and finite."""
    if not (np.isfinite(here).all() and np.isfinite(there).all()):
        return False
    return bool((np.abs(here - there) <= ROUNDING * np.abs(here).max(initial=0.0)).all())


def _tilted(v: Array) -> bool:
    return bool(hypot(*v[:2]) > PARALLEL)


def _unit(v: Array) -> Array:
    size = np.linalg.norm(v)
    return np.asarray(v / size) if size else v
