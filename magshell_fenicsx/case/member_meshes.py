"""The meshes of several shells, whole or halved by a plane in which each shell is its own image.

A `Mirror` is a symmetry plane; the half on the side of its normal is modelled, and edges of the
other half are removed. A `Sector` lies between two planes through e3. A shell is held if a support
fixes it. Each shell has its own frame and length; its pose (`ShellPose`) maps them to the common
frame, in which lengths are over the R of the first shell. A chart is the pair of coordinates on a
surface. `part` and `member` are one of the shells, as `MemberCase`.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from math import sqrt
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.case.contact_mesh_size import (
    ONE_PLACE_DISTANCE,
    ChartedShell,
    ContactPlace,
    body_zones,
    contact_places,
)
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
from magshell_fenicsx.parts.bodies.body_setup import ContactZone
from magshell_fenicsx.parts.shell_outline import reference_shell_of
from magshell_fenicsx.parts.shell_sections import MeshSurface
from magshell_fenicsx.shape.reference_shell import ReferenceShell
from magshell_fenicsx.shape.symmetry_constraint import Vectors

if TYPE_CHECKING:
    from magshell_fenicsx.case.shells import MemberCase, SeveralShells

Array = NDArray[np.float64]


class MemberMeshes:
    """Meshes and mirror planes of several shells, for a `MultiShellMesh`.

    The frame of all shells is that of the case; lengths in it are over the R of the first shell.
    """

    def __init__(self, several: "SeveralShells") -> None:
        """Keep the shells of the case, each with a case of its own and its pose."""
        self._several = several

    def whole_shells(self) -> list[MemberShell]:
        """Return all shells, each meshed as a whole.

        Raises CaseError or MeshError, beginning with the key of the shell.
        """
        return [self._member(part, plane=None) for part in self._several.parts]

    def halved(self, plane: Mirror) -> MultiShellMesh:
        """Return the mesh of the halves of all shells on one side of a plane, or of their sectors.

        The plane is one of `mirrors`; the shells are meshed at first use.
        """
        assembly, members = self._several.assembly, self._several.parts

        def member_shells() -> list[MemberShell]:
            """Return the meshes of the halves, or of the sectors."""
            if isinstance(plane, Sector):
                return [self._sector(member, plane) for member in members]
            return [self._member(member, self._plane_of_shell(member, plane)) for member in members]

        # the digest of the mesh tells halves at different planes apart
        waves = f" {plane.waves}" if isinstance(plane, Sector) else ""
        return replace(
            assembly,
            digest=f"{assembly.digest} {plane.plane.tolist()}{waves}",
            members=member_shells,
            is_symmetric_part=True,
        )

    def mirrors(self, vectors: Vectors, loosely: bool) -> list[Mirror]:
        """Return the planes in which each shell is its own image, each for both of its halves.

        There are none if a shell is not held, because halves do not see motions across their plane.

        Parameters
        ----------
        vectors
            (3,) which the planes should contain, where the shapes leave a choice.
        loosely
            Whether planes of a mesh file count too that map areas and centres onto each other, but
            not the triangles.
        """
        mirrors = list[Mirror]()
        if not self._all_are_held:
            return mirrors
        members = self._several.parts
        for plane in self._candidates(vectors, loosely):
            for side in (plane, plane.reversed):  # either half may be the one that is modelled
                # the plane in each shell's frame; None for a shell that is not its own image
                own_mirrors = [self._mirror_of_shell(member, side, loosely) for member in members]
                is_known = any(side.is_plane_of(known_plane) for known_plane in mirrors)
                if is_known or not all(own_mirrors):
                    continue
                # the edges that the half loses. In the common mesh the name of an edge begins with
                # that of its shell
                removed_edges = dict[str, str]()
                for member, mirror in zip(members, own_mirrors, strict=True):
                    own_edges = mirror.removed_edges if mirror else {}
                    for a, b in own_edges.items():
                        removed_edges[f"{member.name}_{a}"] = f"{member.name}_{b}"
                mirrors.append(replace(side, removed_edges=removed_edges))
        return mirrors

    def normal(self, x: Array) -> Array:
        """Return the outward unit normal (3,) of the perfect shell nearest to a place x (3,)."""
        distances_and_normals = list[tuple[float, Array]]()
        for member in self._several.parts:
            place, perfect = (
                self._several.place(member),
                reference_shell_of(member.case.shell).perfect,
            )
            in_shell_frame, nodes = place.to_shell_frame(x), perfect.nodes
            chart = perfect.inverse(in_shell_frame)
            # of a mesh file all nodes are compared, of other shapes the nearest place alone
            feet = perfect.embedding(chart[None]) if nodes is None else nodes[:, :3]
            distance = place.scale * float(np.linalg.norm(feet - in_shell_frame, axis=1).min())
            distances_and_normals.append((distance, place.Q @ perfect.normal_near(chart)))
        _, nearest_normal = min(distances_and_normals, key=lambda entry: entry[0])
        return nearest_normal

    def _member(self, part: "MemberCase", plane: Mirror | None) -> MemberShell:
        """Return the mesh of a shell, or of its half or sector at a plane in the shell's frame.

        The pose of the result includes the angle about e3 by which the frame of its mesh is turned.
        """
        from magshell_fenicsx.case.planner import make_problem  # the solver takes long to import

        with part.naming():
            problem = make_problem(
                part.case,
                plane=plane,
                contact_places=[
                    *map(ContactPlace, self._contact_places_of_shells[part.name]),
                    *self._body_zones(part),
                ],
            )
            patch = problem.triangulated()
        place = self._several.place(part)
        pose = replace(place, Q=place.Q @ rotation(problem.azimuth).T)
        return MemberShell(
            part.name,
            patch,
            place=pose,
            points=tuple(part.section.points),  # their names
            normal=problem.outward,
        )

    def _sector(self, part: "MemberCase", sector: Sector) -> MemberShell:
        """Return the mesh of the sector of a shell between two planes through e3 of the case.

        A shell that is upside down has the two planes in the other order. Raises CaseError for a
        shell that is not closed around e3.
        """
        first_plane, second_plane = (
            self._plane_of_shell(part, side) for side in sector.planes.values()
        )
        # the mesh of a file may be closed around e3, too
        is_round = reference_shell_of(part.case.shell).perfect.round
        is_closed = is_round or isinstance(part.case.shell, MeshSurface)
        # the shell's own sector, in the same order of planes and in the other one
        same_order = _sector_between(first_plane, second_plane, sector.waves)
        other_order = _sector_between(second_plane, first_plane, sector.waves)
        if is_closed and same_order is not None:
            return self._member(part, same_order)
        if not is_closed or other_order is None:
            raise CaseError(
                part.refused(
                    f"place: symmetry: {sector.waves} needs shells that are closed around e3"
                )
            )
        member = self._member(part, other_order)
        # in the other order the edges at the two planes exchange their names
        other_edge = {SYMMETRY_EDGE: SECOND_SYMMETRY_EDGE, SECOND_SYMMETRY_EDGE: SYMMETRY_EDGE}
        edges = {other_edge.get(name, name): pairs for name, pairs in member.patch.edges.items()}
        return replace(member, patch=replace(member.patch, edges=edges))

    def _plane_of_shell(self, part: "MemberCase", plane: Mirror) -> Mirror:
        """Return a plane of all shells in the frame and over the length of one of them.

        The edges that the half loses have the shell's own names.
        """
        # names in the common mesh begin with the shell's name
        place, start = self._several.place(part), f"{part.name}_"
        offset = float(plane.offset - plane.normal @ place.position) / place.scale
        own_plane = Mirror.with_normal(place.Q.T @ plane.normal, offset)
        removed_edges = {
            a.removeprefix(start): b.removeprefix(start)
            for a, b in plane.removed_edges.items()
            if a.startswith(start)
        }
        return replace(own_plane, offset=_rounded(own_plane.offset), removed_edges=removed_edges)

    def _mirror_of_shell(self, part: "MemberCase", plane: Mirror, loosely: bool) -> Mirror | None:
        """Return a plane in a shell's frame if the shell is its own image in it, else None.

        With `loosely` the plane of a mesh file need not map its triangles onto each other.
        """
        from magshell_fenicsx.case.modelled_part import (
            own_mirror,
        )  # the solver takes long to import

        with part.naming():
            return own_mirror(part.case, self._plane_of_shell(part, plane), loosely=loosely)

    def _candidates(self, vectors: Vectors, loosely: bool) -> Iterator[Mirror]:
        """Yield planes that may be symmetry planes of all shells.

        They are planes through axes of revolution and planes of each shell's outline.

        Parameters
        ----------
        vectors
            (3,) which the planes should contain, where the shapes leave a choice.
        loosely
            Whether planes of a mesh file count too that map areas and centres onto each other, but
            not the triangles.
        """
        places = [self._several.place(member) for member in self._several.parts]
        shells_at_places = zip(places, self._reference_shells, strict=True)
        # place and direction of each axis of revolution
        axes = [
            (place.position, place.Q[:, 2])
            for place, reference_shell in shells_at_places
            if reference_shell.perfect.round
        ]
        for point, axis in axes:
            to_other_axes = [other_point - point for other_point, _ in axes]
            # planes through the axis and another axis, a given vector or a coordinate direction
            for direction in (*vectors, *to_other_axes, *np.eye(3)):
                normal = np.cross(axis, direction)
                if np.linalg.norm(normal) > ROUNDING:
                    unit = Mirror.with_normal(normal).normal
                    yield Mirror(unit, _rounded(float(unit @ point)))
        # planes of each shell, from its own frame to that of all shells
        for place, reference_shell in zip(places, self._reference_shells, strict=True):
            own_vectors = [place.Q.T @ vector for vector in vectors]
            for own_mirror in reference_shell.perfect.mirrors(own_vectors, loosely):
                normal = Mirror.with_normal(place.Q @ own_mirror.normal).normal
                offset = place.scale * own_mirror.offset + float(normal @ place.position)
                yield Mirror(normal, _rounded(offset))

    @cached_property
    def _reference_shells(self) -> Sequence[ReferenceShell]:
        """The undeformed surfaces of the shells."""
        return [reference_shell_of(part.case.shell) for part in self._several.parts]

    @cached_property
    def _contact_places_of_shells(self) -> Mapping[str, Sequence[Array]]:
        """Name of a shell -> places (3,), in its own frame, where other shells are nearest."""
        several, places, charted = self._several, dict[str, Array](), dict[str, ChartedShell]()
        thickness, one_place_distance = dict[str, Array | float](), dict[str, float]()
        if not several.pairs:
            return {member.name: [] for member in several.parts}
        for member, reference_shell in zip(several.parts, self._reference_shells, strict=True):
            h, place = 1 / member.case.shell.R_over_h, several.place(member)
            sample, scale = reference_shell.perfect.sample(), place.scale

            # the default arguments keep this shell's values when the loop goes on
            def half(
                x: Array, reference_shell: ReferenceShell = reference_shell, scale: float = scale
            ) -> Array:
                """Return half the thickness (n,) over the common length, at own places (n, 3)."""
                return np.asarray(scale * reference_shell.half_thickness(x))

            varies = half if reference_shell.thickness_factor else None  # None: it is uniform
            places[member.name] = place(sample)
            one_place_distance[member.name] = ONE_PLACE_DISTANCE * sqrt(h) * scale
            thickness[member.name] = 2 * varies(sample) if varies else h * scale
            if reference_shell.perfect.chart_samples() is not None:  # a mesh file has no chart
                charted[member.name] = ChartedShell(
                    reference_shell.perfect, place, place.to_shell_frame, varies
                )
        places_of_contact = contact_places(
            several.pairs, places, thickness, one_place_distance, charted
        )
        own_places = dict[str, list[Array]]()
        for member in several.parts:
            to_own_frame = several.place(member).to_shell_frame
            own_places[member.name] = [to_own_frame(x) for x in places_of_contact[member.name]]
        return own_places

    def _body_zones(self, part: "MemberCase") -> list[ContactZone]:
        """Return the zones of a shell in which rigid bodies press on it."""
        several = self._several
        return body_zones(
            several.bodies,
            reference_shell_of(part.case.shell),
            several.place(part),
            several.parts[0].case.shell.reference,
        )

    @property
    def _all_are_held(self) -> bool:
        """Whether each shell is held, or joined to a shell that is held.

        Halves do not see motions across their plane.
        """
        is_held = {member.name: member.section.boundary.fixes for member in self._several.parts}
        shell_of = self._several.shell_of
        pairs = [tuple(map(shell_of, edges)) for edges in self._several.joints]
        # a shell that is joined to a held one is held too. This is repeated as often as there are
        # joints, so that it reaches the end of a chain of shells
        for _ in pairs:
            for first_name, second_name in pairs:
                if first_name in is_held and second_name in is_held:
                    is_one_held = is_held[first_name] or is_held[second_name]
                    is_held[first_name] = is_held[second_name] = is_one_held
        return all(is_held.values())


def _sector_between(begin: Mirror, end: Mirror, waves: int) -> Sector | None:
    """Return the sector of 180/`waves` degrees that begins and ends at two planes through e3.

    None if they are no such planes.
    """
    sector = Sector.from_azimuth(begin.azimuth, waves)
    has_planes = sector.is_plane_of(begin) and sector.second_plane.is_plane_of(end)
    return sector if begin.through_e3 and has_planes else None


def _rounded(offset: float) -> float:
    """Return an offset over R, zero where it is rounding."""
    return 0.0 if abs(offset) < ROUNDING else offset
