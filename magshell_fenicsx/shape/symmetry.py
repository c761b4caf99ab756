"""The symmetry that each part of a case leaves; a model takes what all leave."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from math import atan2, hypot, pi

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.expressions import formula
from magshell_fenicsx.mesh.mirror import ROUNDING, Y0, Mirror
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.forces.dead import DeadSection
from magshell_fenicsx.parts.magnetism.field_step import RotationSection
from magshell_fenicsx.parts.magnetism.magnetisation import by_points
from magshell_fenicsx.parts.magnetism.sources.field import turns, values
from magshell_fenicsx.parts.motion.step import TimeSection
from magshell_fenicsx.parts.natural import planned as natural
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.parts.supports.boundary import HeldSection
from magshell_fenicsx.parts.supports.motion import EdgeSection
from magshell_fenicsx.parts.supports.moves import held_vectors, mirrored, sideways
from magshell_fenicsx.problem.loads_left import alike, is_image, load_turns
from magshell_fenicsx.shape.outline import Outline
from magshell_fenicsx.shape.turning import beside, field_turns, scalar_turns, vector_turns, vectors_of

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
    energy
        The name of the energy that it is of, if any.
    azimuths
        Of further planes through e3 (rad) that may be left.
    """

    askew: str | None = None
    vectors: Vectors = ()
    mirrors: Callable[[Mirror], bool] = _every
    energy: str = ""
    azimuths: tuple[float, ...] = ()


def left(case: Case, outline: Outline, indented: Mapping[str, Array], terms: Sequence[OwnTerm]) -> list[Leaves]:
    """What each part of a case leaves; `indented` is of `plan.loads`."""
    return [
        _shape(case, outline),
        *_supports(case),
        *(_field(case, outline) if case.magnetic and case.lambda_m else []),
        *_natural(case, outline),
        *_loads(case, outline, indented),
        *_named(case, outline),
        *(_energy(term, outline) for term in terms),
    ]


def field_fits(case: Case, outline: Outline, plane: Mirror | None, *, axisymmetric: bool) -> bool:
    """Whether a reduced model shows the remanence as it is, where without a field it does not reduce the model."""
    (part,) = _field(case, outline)
    return (part.askew is None or not axisymmetric) and (plane is None or part.mirrors(plane))


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

    if outline.round:
        between = [Mirror.upright(a + turn) for part in parts for a in part.azimuths for turn in (0.0, pi)]
        upright += [plane for plane in between if all(abs(plane.normal @ _unit(v)) <= PARALLEL for v in vectors)]

    def first(planes: Sequence[Mirror]) -> Mirror | None:
        return next((plane for plane in planes if all(part.mirrors(plane) for part in parts)), None)

    if any(part.mirrors is _none for part in parts):
        return None
    found = first(upright) or first(outline.mirrors([_unit(v) for v in vectors], False))
    return first(outline.mirrors([_unit(v) for v in vectors], True)) if loosely and not found else found


def askew(parts: Sequence[Leaves]) -> str | None:
    """What keeps a case from being a meridian turned about e3; None if nothing does."""
    return next((part.askew for part in parts if part.askew), None)


def unmirrored(parts: Sequence[Leaves], outline: Outline) -> str | None:
    """The name of an energy that alone keeps a case from being a half; None if there is none."""
    others = [part for part in parts if not part.energy]
    plane = mirror(others, outline, loosely=True)
    return next((part.energy for part in parts if plane and part.energy and not part.mirrors(plane)), None)


def _energy(term: OwnTerm, outline: Outline) -> Leaves:
    """The frame of a half of what is round is turned to its plane: a term that does not turn stays behind."""

    def mirrors(mirror: Mirror) -> bool:
        turned = outline.round and mirror.through_e3 and mirror.azimuth != 0
        return term.mirrored(Y0 if turned else mirror) and (not turned or term.turns)

    shared, name = term.mirrored(Y0) and term.turns, term.name + (" or what it observes" if term.observed else "")
    return Leaves(None if shared else f"the energy {name} does not share it", (), mirrors, name)


def _shape(case: Case, outline: Outline) -> Leaves:
    factor, geometry = case.thickness_factor, case.shell.geometry

    def mirrors(mirror: Mirror) -> bool:
        if not isinstance(factor, str):
            return True  # patches are mapped onto themselves
        x = outline.sample()
        return alike(formula(factor)(*x.T), formula(factor)(*mirror.image(x).T))

    reason = None
    if not outline.round:
        reason = f"not with a {geometry} that is not closed around e3"
    elif not outline.span:
        reason = "the section of the tube is closed: it has no edge to hold it by"
    elif isinstance(factor, str) and not scalar_turns(factor, outline.span):
        reason = "the thickness differs around e3"
    return Leaves(reason, mirrors=mirrors)


def _supports(case: Case) -> list[Leaves]:
    """A half does not see rigid motions across its plane: it needs a support against all."""
    conditions = case.boundary.conditions()
    found, fixed = list[Leaves](), False
    for name, condition in conditions.items():
        fixed = fixed or condition in ("clamped", "simply supported", "hinged")
        reason = None
        if isinstance(condition, HeldSection):
            fixed = fixed or len(condition.components) == 3
            one_sided = len({0, 1} & set(condition.components)) == 1
            off = _tilted(np.array(case.points.get(name, [0.0, 0.0, 1.0])))
            why = "is held along x or y alone" if one_sided else "is held off the axis" if off else None
            reason = why and f"boundary.{name}: {why}"
        found.append(Leaves(reason, mirrors=partial(_leaves_support, case, name)))
    if not fixed:  # a meridian asks for itself whether it is held
        found.append(Leaves(mirrors=_none))
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
    known = magnetic.applied.components if magnetic.applied.beside else None
    alone = known or not magnetic.applied.beside
    vectors = [d.vector() for d in (*magnetic.remanent.directions(), *([] if alone else [magnetic.applied]))]
    whole = turns(case)  # then the rotation is a part of the field at each place
    turning = [] if whole else [load.to.vector() for load in case.loads_of(RotationSection)]
    remanent, G = magnetic.remanent, np.array(magnetic.applied.gradient or np.zeros((3, 3)))
    fields: list[Callable[[Array], Array]] = [lambda x: np.asarray(x @ G.T)] if G.any() else []
    fields += [vectors_of(texts) for texts in (remanent.components, known) if texts]
    askew = ["a field is not along e3"] if any(_tilted(v) for v in vectors) else []
    if remanent.file:
        by_place = by_points(remanent)
        fields.append(lambda x: by_place(x, x))
        askew += [] if by_place.controls.around else ["the remanence is given at points in space"]
    if remanent.components and not (outline.span and vector_turns(remanent.components, outline.span)):
        askew.append("the formula of the remanence differs around e3")
    if known and not (outline.span and vector_turns(known, outline.span, in_space=True)):
        askew.append("the formula of the applied field differs around e3")
    sources = values(case) if case.sources or whole else []
    if sources and not (outline.span and all(field_turns(field, outline.span) for field in sources)):
        askew.append("the field of a source differs around e3")
    if np.abs(G - np.diag([G[0, 0], G[0, 0], G[2, 2]])).max() > PARALLEL:
        askew.append("the gradient of the applied field is not diag(a, a, b)")

    def mirrors(mirror: Mirror) -> bool:
        S, x = mirror.reflection, outline.sample() if fields or sources else np.zeros((0, 3))
        x = beside(x) if known else x

        def images(sign: float) -> bool:
            uniform = all(np.abs(S @ v - sign * v).max() <= 1e-10 for v in (*vectors, *turning))
            few = x[:: len(x) // 50 + 1]  # the field of a source is smooth
            varying = all(
                alike(sign * np.einsum("ni,ij->nj", field(places), S), field(mirror.image(places)))
                for field, places in (*((field, x) for field in fields), *((field, few) for field in sources))
            )
            kinds = {"radial": 1.0, "tangential": float(S[2, 2])}
            return uniform and varying and kinds.get(remanent.kind, sign) == sign

        return images(1.0) or images(-1.0)

    return [Leaves(next(iter(askew), None), [*vectors, *_of_sources(case)], mirrors)]


def _of_sources(case: Case) -> list[Array]:
    """What a mirror plane through e3 may hold: the places of sources, or the axes of those on e3."""
    places = [np.array(source.position) / case.shell.reference for source in case.sources]
    axes = [source.axes[:, 2] for source in case.sources]
    return [place if _tilted(place) else axis for place, axis in zip(places, axes, strict=True)]


def _natural(case: Case, outline: Outline) -> list[Leaves]:
    if case.natural is None:
        return []
    chosen = natural.along(case) if natural.uneven(case) else natural.MERIDIAN
    fixed = not isinstance(chosen, str) and all(isinstance(v, float | int) for v in chosen)
    vectors = [_unit(np.array(chosen, dtype=float))] if fixed else []
    return [Leaves(natural.askew(case, outline), vectors, lambda mirror: natural.mirrored(case, outline, mirror))]


def _loads(case: Case, outline: Outline, indented: Mapping[str, Array]) -> list[Leaves]:
    return [leaves for step in case.programme for leaves in _load(case, outline, step.load, indented.get(step.name))]


def _load(case: Case, outline: Outline, loading: Step, place: Array | None) -> list[Leaves]:
    """What a step leaves; `place` of a force, over R."""
    R = case.shell.reference
    if place is not None:
        reason = "the force is not at the pole" if _tilted(place) else None
        return [Leaves(reason, [place], lambda mirror: bool(abs(mirror.beyond(place)) < ROUNDING))]
    if isinstance(loading, TimeSection) and loading.velocity:
        given = vectors_of(loading.velocity)

        def keeps(mirror: Mirror) -> bool:
            S, x = mirror.reflection, outline.sample()
            return alike(given(R * x) @ S, given(R * mirror.image(x)))

        turns = outline.span and vector_turns(loading.velocity, outline.span, R)
        return [Leaves(None if turns else "the initial velocity differs around e3", (), keeps)]
    if isinstance(loading, RotationSection):
        return [Leaves("the field turns", [loading.to.vector()])]
    if isinstance(loading, EdgeSection):
        edge = loading
        return [Leaves(sideways(edge), held_vectors(edge), lambda mirror: mirrored(edge, R, mirror))]
    if isinstance(loading, DeadSection):
        fixed = [load for load in loading.loads if not load.varies]
        forces = [np.array(v) for load in fixed for v in (load.force, load.per_length, load.per_area) if v]
        places = [np.array(case.points[load.at]) / R for load in loading.loads if load.at]
        vectors = [_unit(v) for v in (*forces, *places)]
        x = outline.sample() if len(fixed) < len(loading.loads) else np.zeros((0, 3))
        patches = any(load.over not in (None, "all") for load in loading.loads)

        def mirrors(mirror: Mirror) -> bool:
            on_plane = all(abs(float(mirror.beyond(x))) < ROUNDING for x in places)
            return on_plane and all(any(is_image(a, b, mirror, x, R) for b in loading.loads) for a in loading.loads)

        tilted = any(_tilted(v) for v in vectors)
        why = "a load is not along e3, or off the axis" if tilted else "a patch is loaded" if patches else None
        span = outline.span
        if span and not all(load_turns(load, span, R) for load in loading.loads if load.varies):
            why = why or "a load differs around e3"
        return [Leaves(why, vectors, mirrors)]
    return []


def _named(case: Case, outline: Outline) -> list[Leaves]:
    """Named points lie on the half that is modelled, and so does the one that is reported without any."""
    places = [np.array(x) / case.shell.reference for x in case.points.values()]
    if not places and outline.highest is not None:
        places = [outline.embedding(outline.highest[None])[0]]

    def within(mirror: Mirror) -> bool:
        chosen = outline.round and mirror.through_e3 and not case.points  # then the chart begins at the plane
        return chosen or all(float(mirror.beyond(x)) > -ROUNDING for x in places)

    return [Leaves(mirrors=within)]


def _tilted(v: Array) -> bool:
    return bool(hypot(*v[:2]) > PARALLEL)


def _unit(v: Array) -> Array:
    size = np.linalg.norm(v)
    return np.asarray(v / size) if size else v
