"""The symmetry that a part of a case leaves; a model takes what all leave."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import formula
from magshell_fenicsx.mesh.mirror import ROUNDING, Mirror, Sector
from magshell_fenicsx.mesh.patch import GivenField
from magshell_fenicsx.shape.turning import scalar_turns

if TYPE_CHECKING:  # it reads meshes, and needs the solver for that
    from magshell_fenicsx.shape.outline import Outline
    from magshell_fenicsx.shape.sections import ShellSection, Surface

Array = NDArray[np.float64]
Vectors = Sequence[Array]
PARALLEL = 1e-12


def everything(mirror: Mirror) -> bool:
    """All planes."""
    return True


def nothing(mirror: Mirror) -> bool:
    """No plane."""
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
    mirrors: Callable[[Mirror], bool] = everything
    energy: str = ""
    azimuths: tuple[float, ...] = ()


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


def mirror(parts: Sequence[Leaves], outline: "Outline", *, loosely: bool = False) -> Mirror | None:
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
        turns = (0.0, pi) if any(tilted(v) for v in vectors) else (0.0, pi, pi / 2, -pi / 2)
        upright = [Mirror.upright(azimuth + turn) for turn in turns]

    if outline.round:
        between = [
            Mirror.upright(a + turn) for part in parts for a in part.azimuths for turn in (0.0, pi)
        ]
        upright += [
            plane
            for plane in between
            if all(abs(plane.normal @ unit(v)) <= PARALLEL for v in vectors)
        ]

    def first(planes: Sequence[Mirror]) -> Mirror | None:
        return next((plane for plane in planes if all(part.mirrors(plane) for part in parts)), None)

    if any(part.mirrors is nothing for part in parts):
        return None
    chosen = first(upright) or first(outline.mirrors([unit(v) for v in vectors], False))
    return (
        first(outline.mirrors([unit(v) for v in vectors], True))
        if loosely and not chosen
        else chosen
    )


def sector(
    parts: Sequence[Leaves], outline: "Outline", waves: int, places: Vectors = ()
) -> Sector | None:
    """The sector of 180/m degrees between two planes that all parts leave; None if there is none.

    Parameters
    ----------
    places
        Named places (3,), which may choose where it begins.
    """
    vectors = [v for part in parts for v in part.vectors]
    azimuth = common_azimuth(vectors)
    if azimuth is None:
        return None
    if outline.round:
        beside = [a for part in parts for a in part.azimuths] + [
            atan2(x[1], x[0]) for x in places if tilted(x)
        ]
        begins = [a + turn for a in (azimuth, *beside) for turn in (0.0, -pi / waves, pi)]
    else:
        begins = [
            plane.azimuth for plane in _upright(outline, [unit(v) for v in (*vectors, *places)])
        ]
    sectors = (Sector.at(begin, waves) for begin in begins)
    fitting = (
        s for s in sectors if all(part.mirrors(side) for part in parts for side in s.sides.values())
    )
    return next((s for s in fitting if outline.round or _ends(outline, s)), None)


def _upright(outline: "Outline", vectors: Vectors) -> list[Mirror]:
    """The planes through e3 of an outline that is not round, which map each edge onto itself."""
    return [
        plane for plane in outline.mirrors(vectors, False) if plane.through_e3 and not plane.lost
    ]


def _ends(outline: "Outline", sector: Sector) -> bool:
    """Whether the second plane of a sector is one of an outline too."""
    end = sector.azimuth + sector.angle
    planes = _upright(outline, [np.array([cos(end), sin(end), 0.0])])
    return any(sector.second.is_plane_of(plane) for plane in planes)


def askew(parts: Sequence[Leaves]) -> str | None:
    """What keeps a case from being a meridian turned about e3; None if nothing does."""
    return next((part.askew for part in parts if part.askew), None)


def unmirrored(parts: Sequence[Leaves], outline: "Outline") -> str | None:
    """The name of an energy that alone keeps a case from being a half; None if there is none."""
    others = [part for part in parts if not part.energy]
    plane = mirror(others, outline, loosely=True)
    return next(
        (part.energy for part in parts if plane and part.energy and not part.mirrors(plane)), None
    )


def tilted(v: Array) -> bool:
    """Whether a vector or a place (3,) is not along e3."""
    return bool(hypot(*v[:2]) > PARALLEL)


def unit(v: Array) -> Array:
    """A vector (3,) over its length; zero stays zero, and what is as short as 1e-200 has a
    direction.
    """
    largest = np.abs(v).max()
    if not largest:
        return v
    large = v / largest
    return np.asarray(large / np.linalg.norm(large))


def of_shape(shell: "ShellSection | Surface", outline: "Outline") -> Leaves:
    """What the mid-surface and its thickness leave."""
    factor, geometry = shell.thickness_factor, shell.geometry

    def mirrors(mirror: Mirror) -> bool:
        if not isinstance(factor, str):
            return not isinstance(factor, GivenField)  # patches are mapped onto themselves
        return mirrors_formula(factor, mirror, outline.sample())

    reason = outline.askew
    if reason is None and not (outline.round or outline.span):
        reason = f"not with a {geometry} that is not closed around e3"
    elif reason is None and not outline.span:
        reason = "the section of the tube is closed: it has no edge to hold it by"
    elif isinstance(factor, str) and outline.span and not scalar_turns(factor, outline.span):
        reason = "the thickness differs around e3"
    return Leaves(reason, mirrors=mirrors)


def of_patches(key: str, names: Iterable[str], shell: "ShellSection | Surface") -> Leaves:
    """A patch of a shell is known on surfaces alone, as is the message about one that is not there."""
    assembly = getattr(shell, "assembly", None)
    patch = next((name for name in sorted(names) if assembly and name not in assembly.laws), None)
    return Leaves(f"{key}: {patch}: is no whole shell" if patch else None)


def of_points(points: Iterable[Sequence[float]], R: float, outline: "Outline") -> Leaves:
    """Named points lie on the half that is modelled, and so does the one that is reported without
    any.
    """
    named = [np.array(x) / R for x in points]
    places = named
    if not named and outline.highest is not None:
        places = [outline.embedding(outline.highest[None])[0]]

    def within(mirror: Mirror) -> bool:
        chosen = (
            outline.round and mirror.through_e3 and not named
        )  # then the chart begins at the plane
        return chosen or all(float(mirror.beyond(x)) > -ROUNDING for x in places)

    return Leaves(mirrors=within)


def mirrors_formula(text: str, mirror: Mirror, x: Array, length: float = 1.0) -> bool:
    """Whether a formula is the same at places (n, 3) over R and at their images; `length` is R in
    its unit.
    """
    of = formula(text)
    return alike(of(*(length * x).T), of(*(length * mirror.image(x)).T))


def alike(a: Array, b: Array) -> bool:
    """Equal to rounding, and finite."""
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        return False
    return bool((np.abs(a - b) <= ROUNDING * np.abs(a).max(initial=0.0)).all())
