"""The symmetry that each part of a case leaves; a model takes what all leave."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import atan2, hypot, sin

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.boundary import HeldSection
from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.loading import DeadSection, IndentationSection, RotationSection
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.plan.outline import Outline
from magshell_fenicsx.plan.turning import scalar_turns, vector_turns

Array = NDArray[np.float64]
Vectors = Sequence[Array]
PARALLEL = 1e-12


def _every(azimuth: float) -> bool:
    return True


def _none(azimuth: float) -> bool:
    return False


def _along_x(azimuth: float) -> bool:
    return abs(sin(azimuth)) < PARALLEL


@dataclass(frozen=True)
class Leaves:
    """What one part leaves.

    Attributes
    ----------
    askew
        Why the case cannot be turned about e3 with this part; None if it can.
    vectors
        Vectors and places (3,) that a mirror plane through e3 must hold.
    mirrors
        Whether the plane through e3 at an azimuth (rad) is left, apart from `vectors`.
    energy
        The name of the energy that it is of, if any.
    """

    askew: str | None = None
    vectors: Vectors = ()
    mirrors: Callable[[float], bool] = _every
    energy: str = ""


def left(case: Case, outline: Outline, indented: Array | None, terms: Sequence[OwnTerm]) -> list[Leaves]:
    """What each part of a case leaves; `indented` is the place (3,) of an indentation, over R."""
    return [
        _shape(case, outline),
        *_supports(case),
        *(_field(case, outline) if case.magnetic and case.lambda_m else []),
        *_load(case, indented),
        *(_named(case) if case.points else []),
        *(_energy(term, outline) for term in terms),
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


def mirror(parts: Sequence[Leaves]) -> float | None:
    """Azimuth (rad) of a plane through e3 that all parts leave; None if there is none."""
    azimuth = common_azimuth([v for part in parts for v in part.vectors])
    return azimuth if azimuth is not None and all(part.mirrors(azimuth) for part in parts) else None


def askew(parts: Sequence[Leaves]) -> str | None:
    """What keeps a case from being a meridian turned about e3; None if nothing does."""
    return next((part.askew for part in parts if part.askew), None)


def unmirrored(parts: Sequence[Leaves]) -> str | None:
    """The name of an energy that keeps a case from being a half; None if there is none."""
    azimuth = common_azimuth([v for part in parts for v in part.vectors])
    return next((part.energy for part in parts if part.energy and not part.mirrors(azimuth or 0.0)), None)


def _energy(term: OwnTerm, outline: Outline) -> Leaves:
    """The frame of a half is turned to its plane, that of a strip excepted: a term that does not turn stays behind."""

    def mirrors(azimuth: float) -> bool:
        return term.mirrors and (not outline.round or azimuth == 0 or term.turns)

    shared = term.mirrors and term.turns
    return Leaves(None if shared else f"the energy {term.name} does not share it", (), mirrors, term.name)


def _shape(case: Case, outline: Outline) -> Leaves:
    geometry = case.shell.geometry
    factor = case.thickness_factor
    if outline.round and isinstance(factor, str) and not (outline.span and scalar_turns(factor, outline.span)):
        return Leaves("the thickness differs around e3", mirrors=_none)
    if outline.round:
        return Leaves(None if outline.span else "the section of the tube is closed: it has no edge to hold it by")
    if geometry == "strip":
        return Leaves("a strip is no surface of revolution", mirrors=_along_x)
    return Leaves(f"not with a {geometry} that is not closed around e3", mirrors=_none)


def _supports(case: Case) -> list[Leaves]:
    """A half does not see rigid motions across its plane: it needs a support against all."""
    found, fixed = list[Leaves](), False
    for name, condition in case.boundary.conditions().items():
        fixed = fixed or condition in ("clamped", "simply supported", "hinged")
        if not isinstance(condition, HeldSection):
            continue
        fixed = fixed or len(condition.components) == 3
        place = np.array(case.points.get(name, [0.0, 0.0, 1.0]))
        one_sided = len({0, 1} & set(condition.components)) == 1
        why = "is held along x or y alone" if one_sided else "is held off the axis" if _tilted(place) else None
        found.append(
            Leaves(why and f"boundary.{name}: {why}", [_unit(place)], mirrors=_along_x if one_sided else _every)
        )
    return found if fixed else [*found, Leaves(mirrors=_none)]


def _field(case: Case, outline: Outline) -> list[Leaves]:
    magnetic = case.magnetic
    assert magnetic
    vectors = [d.vector() for d in (*magnetic.remanent.directions(), magnetic.applied)]
    found = [Leaves("a field is not along e3" if any(_tilted(v) for v in vectors) else None, vectors)]

    def told(azimuth: float) -> bool:  # only the user knows whether it is symmetric to the plane y = 0
        return case.symmetry == "half" and not azimuth

    components, span = magnetic.remanent.components, outline.span
    if components and not (span and vector_turns(components, span)):
        found.append(Leaves("the formula of the remanence differs around e3", mirrors=told))
    if magnetic.applied.gradient:
        G = np.array(magnetic.applied.gradient)
        round_ = np.abs(G - np.diag([G[0, 0], G[0, 0], G[2, 2]])).max() <= PARALLEL
        found.append(Leaves(None if round_ else "the gradient of the applied field is not diag(a, a, b)", mirrors=told))
    return found


def _load(case: Case, indented: Array | None) -> list[Leaves]:
    loading = case.loading
    if isinstance(loading, IndentationSection):
        assert indented is not None
        return [Leaves("the force is not at the pole" if _tilted(indented) else None, [indented])]
    if isinstance(loading, RotationSection):
        return [Leaves("the field turns", [loading.to.vector()])]
    if isinstance(loading, DeadSection):
        forces = [np.array(v) for load in loading.loads for v in (load.force, load.per_length, load.per_area) if v]
        places = [np.array(case.points[load.at]) for load in loading.loads if load.at]
        patches = any(load.over not in (None, "all") for load in loading.loads)
        mirrors = _none if patches else _every
        vectors = [_unit(v) for v in (*forces, *places)]
        tilted = any(_tilted(v) for v in vectors)
        why = "a load is not along e3, or off the axis" if tilted else "a patch is loaded" if patches else None
        return [Leaves(why, vectors, mirrors)]
    return []


def _named(case: Case) -> list[Leaves]:
    """Named points lie on the half that is modelled, y >= 0."""
    places = [_unit(np.array(x)) for x in case.points.values()]

    def within(azimuth: float) -> bool:
        across = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        return all(x @ across > -PARALLEL for x in places)

    return [Leaves(mirrors=within)]


def _tilted(v: Array) -> bool:
    return bool(hypot(*v[:2]) > PARALLEL)


def _unit(v: Array) -> Array:
    size = np.linalg.norm(v)
    return np.asarray(v / size) if size else v
