"""The meshes of several shells, whole or halved by a plane in which each of them is its own mirror
image.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.meeting import APART, Charted, meetings
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import (
    ROUNDING,
    SECOND_SYMMETRY_EDGE,
    SYMMETRY_EDGE,
    Mirror,
    Sector,
    rotation,
)
from magshell_fenicsx.mesh.multi_shell import MemberShell, MultiShellMesh
from magshell_fenicsx.shape.outline import reference_shell_of
from magshell_fenicsx.shape.reference_shell import ReferenceShell
from magshell_fenicsx.shape.shell_sections import MeshSurface
from magshell_fenicsx.shape.symmetry_constraint import Vectors

if TYPE_CHECKING:
    from magshell_fenicsx.case.shells import Part, Several

Array = NDArray[np.float64]


class Members:
    """What an `MultiShellMesh` asks of several shells."""

    def __init__(self, several: "Several") -> None:
        self._several = several

    def whole(self) -> list[MemberShell]:
        """All shells as they are; a message of one begins with its key."""
        return [self._member(part, None) for part in self._several.parts]

    def half(self, plane: Mirror) -> MultiShellMesh:
        """The halves of all shells on the one side of a plane, which is one of `mirrors`, or their
        sectors.
        """
        whole, parts = self._several.assembly, self._several.parts

        def halves() -> list[MemberShell]:
            if isinstance(plane, Sector):
                return [self._sector(part, plane) for part in parts]
            return [self._member(part, self._own(part, plane)) for part in parts]

        waves = f" {plane.waves}" if isinstance(plane, Sector) else ""
        return replace(
            whole,
            digest=f"{whole.digest} {plane.plane.tolist()}{waves}",
            members=halves,
            is_symmetric_part=True,
        )

    def mirrors(self, vectors: Vectors, loosely: bool) -> list[Mirror]:
        """The planes in which each shell is its own image, as those of the halves on both of their
        sides.

        Parameters
        ----------
        vectors, loosely
            See `Outline.mirrors`.
        """
        mirrors = list[Mirror]()
        if not self._held:
            return mirrors
        for plane in self._candidates(vectors, loosely):
            for side in (plane, plane.reversed):
                kept = [self._kept(part, side, loosely) for part in self._several.parts]
                if all(kept) and not any(side.is_plane_of(other) for other in mirrors):
                    named = zip(self._several.parts, kept, strict=True)
                    lost = {
                        f"{p.name}_{a}": f"{p.name}_{b}"
                        for p, own in named
                        if own
                        for a, b in own.removed_edges.items()
                    }
                    mirrors.append(replace(side, removed_edges=lost))
        return mirrors

    def normal(self, x: Array) -> Array:
        """The outward unit normal (3,) at a place (3,) of the perfect shell that is nearest to it."""
        found = list[tuple[float, Array]]()
        for part in self._several.parts:
            place, perfect = self._several.place(part), reference_shell_of(part.case.shell).perfect
            own, nodes = place.to_shell_frame(x), perfect.nodes
            chart = perfect.inverse(own)
            feet = perfect.embedding(chart[None]) if nodes is None else nodes[:, :3]
            away = place.scale * float(np.linalg.norm(feet - own, axis=1).min())
            found.append((away, place.Q @ perfect.normal_near(chart)))
        return min(found, key=lambda each: each[0])[1]

    def _member(self, part: "Part", plane: Mirror | None) -> MemberShell:
        """A shell, or its half at a plane in the frame of the shell.

        The frame of its mesh is turned about e3.
        """
        from magshell_fenicsx.case.planner import make_problem  # the solver takes long to import

        with part.naming():
            problem = make_problem(part.case, plane=plane, met=self._met[part.name])
            patch = problem.triangulated()
        place = self._several.place(part)
        turned = replace(place, Q=place.Q @ rotation(problem.azimuth).T)
        return MemberShell(part.name, patch, turned, tuple(part.section.points), problem.outward)

    def _sector(self, part: "Part", sector: Sector) -> MemberShell:
        """The sector of a shell; one that is upside down has the two planes the other way round."""
        first, second = (self._own(part, side) for side in sector.planes.values())
        closed = reference_shell_of(part.case.shell).perfect.round or isinstance(
            part.case.shell, MeshSurface
        )
        for begin, end in ((first, second), (second, first)):
            own = Sector.from_azimuth(begin.azimuth, sector.waves)
            if (
                closed
                and begin.through_e3
                and own.is_plane_of(begin)
                and own.second_plane.is_plane_of(end)
            ):
                break
        else:
            raise CaseError(
                part.refused(
                    f"place: symmetry: {sector.waves} needs shells that are closed around e3"
                )
            )
        member = self._member(part, own)
        if begin is first:
            return member
        other = {SYMMETRY_EDGE: SECOND_SYMMETRY_EDGE, SECOND_SYMMETRY_EDGE: SYMMETRY_EDGE}
        edges = {other.get(name, name): pairs for name, pairs in member.patch.edges.items()}
        return replace(member, patch=replace(member.patch, edges=edges))

    def _own(self, part: "Part", plane: Mirror) -> Mirror:
        """A plane in the frame of a shell and over its own length, with its edges that are lost."""
        place, start = self._several.place(part), f"{part.name}_"
        offset = float(plane.offset - plane.normal @ place.position) / place.scale
        own = Mirror.with_normal(place.Q.T @ plane.normal, offset)
        lost = {
            a.removeprefix(start): b.removeprefix(start)
            for a, b in plane.removed_edges.items()
            if a.startswith(start)
        }
        return replace(own, offset=_rounded(own.offset), removed_edges=lost)

    def _kept(self, part: "Part", plane: Mirror, loosely: bool) -> Mirror | None:
        """The plane in the frame of a shell that is its own image in it; else None."""
        from magshell_fenicsx.case.planner import kept  # the solver takes long to import

        with part.naming():
            return kept(part.case, self._own(part, plane), loosely=loosely)

    def _candidates(self, vectors: Vectors, loosely: bool) -> Iterator[Mirror]:
        """Planes that some shell has: upright ones through axes of revolution, and those of its
        outline.
        """
        places = [self._several.place(part) for part in self._several.parts]
        grounds = zip(places, self._grounds, strict=True)
        axes = [
            (place.position, place.Q[:, 2]) for place, ground in grounds if ground.perfect.round
        ]
        for at, axis in axes:
            apart = [other - at for other, _ in axes]
            for along in (*vectors, *apart, np.eye(3)[0], np.eye(3)[1], np.eye(3)[2]):
                normal = np.cross(axis, along)
                if np.linalg.norm(normal) > ROUNDING:
                    unit = Mirror.with_normal(normal).normal
                    yield Mirror(unit, _rounded(float(unit @ at)))
        for place, ground in zip(places, self._grounds, strict=True):
            for own in ground.perfect.mirrors([place.Q.T @ v for v in vectors], loosely):
                normal = Mirror.with_normal(place.Q @ own.normal).normal
                yield Mirror(
                    normal, _rounded(place.scale * own.offset + float(normal @ place.position))
                )

    @cached_property
    def _grounds(self) -> Sequence[ReferenceShell]:
        return [reference_shell_of(part.case.shell) for part in self._several.parts]

    @cached_property
    def _met(self) -> Mapping[str, Sequence[Array]]:
        """Name of a shell -> places (3,) in its own frame where others that it may touch are
        nearest.
        """
        several, places, near = self._several, dict[str, Array](), dict[str, Charted]()
        thickness, apart = dict[str, Array | float](), dict[str, float]()
        if not several.pairs:
            return {part.name: [] for part in several.parts}
        for part, ground in zip(several.parts, self._grounds, strict=True):
            h, place = 1 / part.case.shell.R_over_h, several.place(part)
            sample, scale = ground.perfect.sample(), place.scale

            def half(x: Array, ground: ReferenceShell = ground, scale: float = scale) -> Array:
                return np.asarray(scale * ground.half_thickness(x))

            varies = half if ground.thickness_factor else None
            places[part.name], apart[part.name] = place(sample), APART * sqrt(h) * scale
            thickness[part.name] = 2 * varies(sample) if varies else h * scale
            if ground.perfect.chart_samples() is not None:
                near[part.name] = Charted(ground.perfect, place, place.to_shell_frame, varies)
        found = meetings(several.pairs, places, thickness, apart, near)
        return {
            part.name: [several.place(part).to_shell_frame(x) for x in found[part.name]]
            for part in several.parts
        }

    @property
    def _held(self) -> bool:
        """Whether each shell, or one that is joined to it, is held: halves do not see motions
        across their plane.
        """
        held = {part.name: part.section.boundary.fixes for part in self._several.parts}
        pairs = [tuple(self._several.of(name) for name in edges) for edges in self._several.joints]
        for _ in pairs:
            for one, other in pairs:
                if one in held and other in held:
                    held[one] = held[other] = held[one] or held[other]
        return all(held.values())


def _rounded(offset: float) -> float:
    return 0.0 if abs(offset) < ROUNDING else offset
