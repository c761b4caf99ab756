"""Symmetry that the parts of a case preserve; the smallest model has what all of them preserve.

Each part (a load, a support, the shape) states a `SymmetryConstraint`. `common_mirror` and
`common_sector` find planes that all parts allow. `why_not_axisymmetric` says what forbids the model
of a meridian (docs/design.md). Lengths are over R.

A mirror is a symmetry plane with the half that is modelled, so that a plane comes twice; a sector
is the piece of 180/m degrees between two planes through e3 (the code calls m `waves`). "Allowed"
means: the part is the same at mirror images. An outline is the surface of the shell with its own
symmetry planes; it is round if it is closed around e3. A round surface has all planes through e3,
so that vectors and azimuths of the parts choose some as candidates.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import atan2, cos, hypot, pi, sin
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import ROUNDING, Mirror, Sector
from magshell_fenicsx.mesh.multi_shell import MultiShellMesh
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.shape.field_symmetry import formula_field, is_axisymmetric, is_mirror_image

if TYPE_CHECKING:  # outlines read meshes, which needs the solver
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
Vectors = Sequence[Array]
PARALLEL = 1e-12  # component across e3, or along a normal, that is rounding
COMMON_PLANE_TOLERANCE = 1e-10  # sine between vectors that one plane through e3 contains


def any_plane(mirror: Mirror) -> bool:
    """Allow all planes: the `mirrors` of a part without a constraint."""
    return True


def no_plane(mirror: Mirror) -> bool:
    """Allow no plane."""
    return False


@dataclass(frozen=True)
class SymmetryConstraint:
    """The symmetry that one part of a case preserves.

    Attributes
    ----------
    not_axisymmetric
        Why the case is not axisymmetric about e3 with this part; None if it is.
    vectors
        Vectors and places (3,) that a mirror plane through e3 must contain, so that they choose
        one.
    mirrors
        Function that tells whether a plane is a symmetry of the part.
    energy
        The energy, or the line within the surface, that states the constraint, in words; "" for
        other parts.
    azimuths
        Azimuths (rad) of further planes through e3 that may be preserved.
    """

    not_axisymmetric: str | None = None
    vectors: Vectors = ()
    mirrors: Callable[[Mirror], bool] = any_plane
    energy: str = ""
    azimuths: tuple[float, ...] = ()


def common_azimuth(vectors: Vectors) -> float | None:
    """Return the azimuth (rad) of the plane through e3 that contains all vectors (3,).

    It is 0 if every vector is along e3, and None if there is no such plane.
    """
    tilted_vectors = [v[:2] for v in vectors if hypot(*v[:2]) > PARALLEL]
    if not tilted_vectors:
        return 0.0
    x, y = tilted_vectors[0]
    for v in tilted_vectors:
        if abs(x * v[1] - y * v[0]) > COMMON_PLANE_TOLERANCE * hypot(x, y) * hypot(*v):
            return None
    return atan2(y, x)


def common_mirror(
    parts: Sequence[SymmetryConstraint], outline: "Outline", *, loosely: bool = False
) -> Mirror | None:
    """Return a plane that all parts allow, through e3 if there is one; None if there is none.

    Parameters
    ----------
    parts
        Constraints of all parts.
    outline
        The surface of the shell.
    loosely
        Whether the triangles of a mesh file need not be symmetric, if areas and centres of both
        halves are.
    """
    if any(part.mirrors is no_plane for part in parts):
        return None
    vectors = [v for part in parts for v in part.vectors]
    units = [unit(v) for v in vectors]  # candidates of an outline contain these, if possible

    def is_allowed(plane: Mirror) -> bool:
        return all(part.mirrors(plane) for part in parts)

    def first_allowed(planes: Sequence[Mirror]) -> Mirror | None:
        return next((plane for plane in planes if is_allowed(plane)), None)

    planes_through_axis = _planes_through_axis(parts, vectors) if outline.round else []
    # the second argument of `mirrors`: whether triangles of a mesh file need not be symmetric
    mirror = first_allowed(planes_through_axis) or first_allowed(outline.mirrors(units, False))
    if mirror is None and loosely:
        return first_allowed(outline.mirrors(units, True))
    return mirror


def _planes_through_axis(parts: Sequence[SymmetryConstraint], vectors: Vectors) -> list[Mirror]:
    """Return candidates for mirror planes through e3 of a round surface.

    All contain the `vectors` (3,) of the parts; some have azimuths that parts propose.
    """
    planes = list[Mirror]()
    azimuth = common_azimuth(vectors)
    if azimuth is not None:
        # both halves of the plane; if no vector chooses it, also those of the plane across
        turns = (0.0, pi) if any(tilted(v) for v in vectors) else (0.0, pi, pi / 2, -pi / 2)
        planes += [Mirror.through_axis(azimuth + turn) for turn in turns]
    azimuths_of_parts = [a for part in parts for a in part.azimuths]
    for a in azimuths_of_parts:
        # both halves, if the plane contains all vectors
        for turn in (0.0, pi):
            plane = Mirror.through_axis(a + turn)
            if all(abs(plane.normal @ unit(v)) <= PARALLEL for v in vectors):
                planes.append(plane)
    return planes


def common_sector(
    parts: Sequence[SymmetryConstraint], outline: "Outline", waves: int, places: Vectors = ()
) -> Sector | None:
    """Return a sector of 180/m degrees between two planes that all parts allow, or None.

    Parameters
    ----------
    waves
        m.
    places
        Named places (3,), which may choose where the sector begins.
    """
    vectors = [v for part in parts for v in part.vectors]
    azimuth = common_azimuth(vectors)
    if azimuth is None:
        return None
    if outline.round:
        azimuths = [azimuth, *(a for part in parts for a in part.azimuths)]
        azimuths += [atan2(x[1], x[0]) for x in places if tilted(x)]
        # a sector may begin or end at an azimuth, or begin on its other side
        begins = [a + turn for a in azimuths for turn in (0.0, -pi / waves, pi)]
    else:
        units = [unit(v) for v in (*vectors, *places)]
        begins = [plane.azimuth for plane in _outline_planes_through_axis(outline, units)]
    for begin in begins:
        sector = Sector.from_azimuth(begin, waves)
        planes = sector.planes.values()
        if not all(part.mirrors(plane) for part in parts for plane in planes):
            continue
        if outline.round or _ends_at_symmetry_plane(outline, sector):
            return sector
    return None


def _outline_planes_through_axis(outline: "Outline", vectors: Vectors) -> list[Mirror]:
    """Return the symmetry planes through e3 of an outline that is not round.

    Only planes that map each edge onto itself count.
    """
    planes = outline.mirrors(vectors, False)
    return [plane for plane in planes if plane.through_e3 and not plane.removed_edges]


def _ends_at_symmetry_plane(outline: "Outline", sector: Sector) -> bool:
    """Return whether the second plane of a sector is a symmetry plane of the outline."""
    end = sector.azimuth + sector.angle
    planes = _outline_planes_through_axis(outline, [np.array([cos(end), sin(end), 0.0])])
    return any(sector.second_plane.is_plane_of(plane) for plane in planes)


def why_not_axisymmetric(parts: Sequence[SymmetryConstraint]) -> str | None:
    """Return why a meridian that is turned about e3 cannot model the case; None if it can."""
    return next((part.not_axisymmetric for part in parts if part.not_axisymmetric), None)


def energy_without_mirror(parts: Sequence[SymmetryConstraint], outline: "Outline") -> str | None:
    """Return the energy or line, in words, that keeps a case from being modelled as a half.

    It does not allow the mirror plane that all other parts have in common. None if there is no such
    energy, or no such plane.
    """
    plane = common_mirror([part for part in parts if not part.energy], outline, loosely=True)
    if plane is None:
        return None
    energies = (part.energy for part in parts if part.energy and not part.mirrors(plane))
    return next(energies, None)


def tilted(v: Array) -> bool:
    """Return whether a vector or a place (3,) is not along e3."""
    return bool(hypot(*v[:2]) > PARALLEL)


def unit(v: Array) -> Array:
    """Return a vector (3,) over its length; zero stays zero.

    Even a vector as short as 1e-200 has a direction.
    """
    largest = np.abs(v).max()
    if not largest:
        return v
    scaled = v / largest
    return np.asarray(scaled / np.linalg.norm(scaled))


def shape_constraint(
    geometry: str, factor: str | Mapping[str, float] | UserField | None, outline: "Outline"
) -> SymmetryConstraint:
    """Return the symmetry that the mid-surface and its thickness preserve.

    Its mirrors test the thickness alone; planes of the surface come from the outline.

    Parameters
    ----------
    geometry
        The kind of surface in the user's words, such as "torus".
    factor
        Multiplies the thickness: a formula, numbers by the names of patches, or a field; None: 1.
    """

    def mirrors(mirror: Mirror) -> bool:
        if not isinstance(factor, str):
            return not isinstance(factor, UserField)  # patches are mapped onto themselves
        return is_mirror_image(formula_field(factor), mirror, outline.sample())

    reason, meridian = outline.why_no_meridian, outline.meridian
    # a surface that has a meridian may still have a thickness that differs around e3
    if meridian:
        if isinstance(factor, str) and not is_axisymmetric(formula_field(factor), meridian):
            reason = "the thickness differs around e3"
    elif reason is None and outline.round:
        reason = "the section of the tube is closed: it has no edge to hold it by"
    elif reason is None:
        reason = f"not with a {geometry} that is not closed around e3"
    return SymmetryConstraint(reason, mirrors=mirrors)


def patch_constraint(
    key: str, names: Iterable[str], assembly: MultiShellMesh | None
) -> SymmetryConstraint:
    """Return the constraint of patches that a key names.

    Where a case has several shells (`assembly`), their meridians know each whole shell by its name,
    but no other patch. So a name that is none of a shell forbids the meridian, also where the
    surface has no such patch. Patches of one shell (None) have no constraint.
    """
    patch = None
    if assembly:
        # `laws` has the names of the shells
        patch = next((name for name in sorted(names) if name not in assembly.laws), None)
    return SymmetryConstraint(f"{key}: {patch}: is no whole shell" if patch else None)


def points_constraint(
    points: Iterable[Sequence[float]], R: float, outline: "Outline"
) -> SymmetryConstraint:
    """Return the constraint that named points lie on the half that is modelled.

    If no point is named, the one whose displacement is reported must lie there.

    Parameters
    ----------
    points
        Places in the case's unit of length.
    R
        Reference length in that unit.
    """
    named_places = [np.array(x) / R for x in points]
    places = named_places
    if not named_places and outline.highest is not None:
        places = [outline.embedding(outline.highest[None])[0]]

    def mirrors(mirror: Mirror) -> bool:
        # a round surface is charted from any plane through e3, and the reported point lies on it
        is_plane_of_round_surface = outline.round and mirror.through_e3
        if is_plane_of_round_surface and not named_places:
            return True
        return all(float(mirror.signed_distance(x)) > -ROUNDING for x in places)

    return SymmetryConstraint(mirrors=mirrors)
