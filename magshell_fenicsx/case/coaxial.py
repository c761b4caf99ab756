"""Meridians of several shells of revolution with one axis, along one common parameter.

The common parameter s runs through the shells one after the other, over the reference length R of
the first shell. The axis is e3. Each shell also has a meridian of its own, with its own parameter,
length and frame. A `MeridianChart` is a meridian with its embedding, which maps pairs (parameter,
0), called charts (n, 2), to places in the plane of e1 and e3. The foot of a place is the nearest
place of a shell. At a T-junction an edge of one shell stands on another shell. A pose (`ShellPose`)
is position, orientation and scale of a shell.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.mirror import ROUNDING
from magshell_fenicsx.mesh.multi_shell import MEETING_TOLERANCE, ShellPose
from magshell_fenicsx.mesh.patch import DeviatedEmbedding, MeshError
from magshell_fenicsx.parts.shell_outline import reference_shell_of
from magshell_fenicsx.problem.problem import Problem, meridian_vertices
from magshell_fenicsx.shape.meridian_chart import MeridianChart, ShellMeridian
from magshell_fenicsx.shape.outline import Outline

if TYPE_CHECKING:
    from magshell_fenicsx.case.shells import MemberCase, SeveralShells

Array = NDArray[np.float64]
PARAMETER_GAP = 1.0  # over R: parameters between two shells that belong to none
NO_MERIDIAN = "symmetry: axisymmetric: "  # begin of a message that says why there is no meridian


@dataclass(frozen=True)
class CoaxialShell:
    """Shell of revolution whose axis is the common axis of all shells.

    "The common frame" is that of the case; lengths in it are over the R of the first shell.

    Attributes
    ----------
    name
        Name of the shell.
    start
        Beginning of the shell in the common parameter.
    problem
        The problem of the shell alone.
    chart
        The shell's own meridian, over its own length.
    place
        Position, orientation and scale of the shell in the common frame.
    outline
        Its perfect surface, in its own frame.
    """

    name: str
    start: float
    problem: Problem
    chart: MeridianChart
    place: ShellPose
    outline: Outline

    @property
    def end(self) -> float:
        """End of the shell in the common parameter."""
        return self.start + self.place.scale * self.chart.length

    @property
    def upright(self) -> bool:
        """Whether the shell's own e3 points along the common e3.

        Otherwise its meridian runs backwards in the common parameter, so that its normal stays
        outside.
        """
        return bool(self.place.Q[2, 2] > 0)

    @property
    def wave_measure(self) -> float:
        """Measure of the largest number of waves around e3 in which the shell may buckle.

        Buckles are about as long as the root of thickness over curvature. So their number grows
        with the largest distance from the axis over that length.
        """
        reach = max(1.0, float(self.chart.sample()[:, 0].max()))
        return reach * float(np.sqrt(self.chart.curvature / self.problem.material.h))

    def own_parameter(self, s: Array) -> Array:
        """Return the shell's own parameters, clipped to its meridian, from common ones (n,)."""
        from_start = (s - self.start) / self.place.scale  # over the shell's own length
        own_s = from_start if self.upright else self.chart.length - from_start
        return np.clip(own_s, 0.0, self.chart.length)

    def parameter(self, own_parameter: Array) -> Array:
        """Return the common parameter from the shell's own parameters (n,)."""
        from_start = own_parameter if self.upright else self.chart.length - own_parameter
        return self.start + self.place.scale * from_start

    def places_at(self, s: Array) -> Array:
        """Return places (n, 3) in the plane of e1 and e3, at common parameters (n,)."""
        own_s = self.own_parameter(s)
        # charts (parameter, 0), then places in the shell's own frame and length
        places = self.chart.embedding(np.column_stack([own_s, 0 * own_s]))
        return self._in_common_frame(self.place.scale * places) + self._translation

    def normal(self, s: Array) -> Array:
        """Return outward unit normals (n, 3) in the common frame, at common parameters (n,)."""
        own_s = self.own_parameter(s)
        return self._in_common_frame(self.chart.normal(np.column_stack([own_s, 0 * own_s])))

    def deviation(self, s: Array) -> Array:
        """Return the deviation w0 (n, 1) of the imperfect shell, at common parameters (n,)."""
        own_s, embedding = self.own_parameter(s), self.chart.embedding
        w0 = 0 * own_s
        if isinstance(embedding, DeviatedEmbedding):
            w0 = embedding.w0(np.column_stack([own_s, 0 * own_s]))
        return np.asarray(self.place.scale * w0[:, None])

    def foot(self, x: Array) -> tuple[float, float]:
        """Return common parameter and azimuth (rad) of the shell's place nearest to x (3,)."""
        # a node of a mesh has the number of its shell as fourth entry, which is left out
        in_shell_frame = self.place.to_shell_frame(np.asarray(x)[:3])
        own_s, _ = self.chart.locate(self.outline.inverse(in_shell_frame))
        return float(self.parameter(np.array(own_s))), float(np.arctan2(x[1], x[0]))

    def vertices(self, body_contacts: Sequence[tuple[float, float]]) -> Array:
        """Return the common parameters (n,) of the mesh vertices on this shell, ascending.

        `body_contacts` are pairs of element size and reach where bodies press.
        """
        scale = self.place.scale
        # the mesh is made in the shell's own length
        own_contacts = tuple((size / scale, reach / scale) for size, reach in body_contacts)
        body_contacts = (*self.problem.body_contacts, *own_contacts)
        own_s = meridian_vertices(replace(self.problem, body_contacts=body_contacts))
        s = self.parameter(own_s)
        return np.asarray(s if self.upright else s[::-1])

    @property
    def names(self) -> list[str | None]:
        """Names of the shell's first and last end in the common parameter; None for a pole."""
        names = [name and f"{self.name}_{name}" for name in self.chart.names]
        return names if self.upright else names[::-1]

    @property
    def places(self) -> list[tuple[str | None, Array]]:
        """Name and place (3,) of the shell's first and last end in the common parameter."""
        return [
            (name, self.places_at(np.array([s]))[0])
            for name, s in zip(self.names, (self.start, self.end), strict=True)
        ]

    @property
    def shell_meridian(self) -> ShellMeridian:
        """The shell as a part of all meridians."""
        return ShellMeridian(self.name, (self.start, self.end), self.foot, self.vertices)

    def _in_common_frame(self, x: Array) -> Array:
        """Return vectors (n, 3) of the shell's own meridian plane in the common frame."""
        return np.asarray(x if self.upright else x * [1.0, 1.0, -1.0])

    @property
    def _translation(self) -> Array:
        """Vector (3,) from the origin of the shell to its place on the common axis, over R."""
        return self.place.position * [0.0, 0.0, 1.0]


@dataclass(frozen=True)
class CoaxialEmbedding:
    """Map from charts (n, 2) on all meridians to places (n, 3) in space.

    The first chart coordinate is the common parameter of all shells.

    Attributes
    ----------
    shells
        The shells, ascending along the common parameter.
    begins
        (shells,) beginning of the parameters that belong to each shell: half of the gap before it
        is its own, so that every parameter belongs to a shell.
    """

    shells: Sequence[CoaxialShell]
    begins: Array

    def __call__(self, chart: Array) -> Array:
        return self._values(chart, "places_at", 3)

    def normal(self, chart: Array) -> Array:
        """Return outward normals (n, 3) of the perfect shells."""
        return self._values(chart, "normal", 3)

    def w0(self, chart: Array) -> Array:
        """Return the deviations (n,) of the imperfect shells, over R."""
        return self._values(chart, "deviation", 1)[:, 0]

    def _values(self, chart: Array, name: str, size: int) -> Array:
        """Return the values (n, size) of method `name` of the shell to which each chart belongs.

        `name` is a method of `CoaxialShell` with parameters (n,) as its argument.
        """
        s, values = chart[:, 0], np.empty((len(chart), size))
        # the last shell that begins before the parameter, up to rounding
        shell_numbers = np.searchsorted(self.begins, s + ROUNDING, side="right") - 1
        for i, shell in enumerate(self.shells):
            values[shell_numbers == i] = getattr(shell, name)(s[shell_numbers == i])
        return values


def meridians(several: "SeveralShells") -> MeridianChart | str:
    """Return the joined meridians of all shells, or the reason why there are none.

    Lengths are over the R of the first shell.

    Returns
    -------
    The chart of the meridians along their common parameter; or a reason in words.

    Raises
    ------
    CaseError, MeshError
        If a shell alone cannot be planned; the message begins with its key.
    """
    # for each joint the names of its two shells
    joined_shells = [set(map(several.shell_of, names)) for names in several.joints]
    if any(set(pair) in joined_shells for pair in several.pairs):
        return "contact: shells that are joined to each other are modelled with their circumference"
    shells = list[CoaxialShell]()
    for member in several.parts:
        shell = _coaxial_shell(member, several)
        if isinstance(shell, str):
            return shell
        shells.append(shell)
    # the order of the shells along the common parameter
    successors = _successors(shells, several.joints)
    if isinstance(successors, str):
        return successors
    # at T-junctions a shell needs vertices where edges of others stand on it: there the second name
    # of a joint is that of the shell, not of an edge
    places = dict(name_and_place for shell in shells for name_and_place in shell.places)
    with_feet = []
    for shell in shells:
        feet = [places[edge] for edge, name in several.joints if name == shell.name]
        with_feet.append(_with_feet(shell, feet))
    ordered_shells = _in_chains(with_feet, successors)
    if len(ordered_shells) < len(shells):
        return "joints: shells are joined in a ring"
    return _joined_chart(ordered_shells, several)


def _coaxial_shell(member: "MemberCase", several: "SeveralShells") -> CoaxialShell | str:
    """Return one of several shells, with its own meridian, or the reason why it has none.

    It begins at 0 until its place in the common parameter is known.
    """
    place, outline = several.place(member), reference_shell_of(member.case.shell).perfect
    key = member.refused("place")
    distance_from_axis = np.hypot(*place.position[:2])
    slope_of_own_axis = np.hypot(*place.Q[:2, 2])
    if max(distance_from_axis, slope_of_own_axis) > ROUNDING:
        return f"{key}: its axis is not e3 through the origin"
    problem = _problem_of(member)
    if isinstance(problem, str):
        return member.refused(problem)
    assert problem.meridian
    return CoaxialShell(
        member.name,
        start=0.0,
        problem=problem,
        chart=problem.meridian,
        place=place,
        outline=outline,
    )


def _successors(
    shells: Sequence[CoaxialShell], joints: Sequence[tuple[str, str]]
) -> dict[str, str] | str:
    """Return the order of joined shells: name of a shell -> name of the one that follows it.

    `joints` are pairs of names of edges, in a T-junction of an edge and a shell. The next shell
    begins where this one ends, and is joined to it there. The result is a reason in words if two
    shells cannot be joined end to beginning.
    """
    # name of an edge -> (side, its place, its shell); the side is 0 at the beginning of the shell
    # in the common parameter, 1 at its end
    edges = {
        name: (side, place, shell)
        for shell in shells
        for side, (name, place) in enumerate(shell.places)
    }
    # the size of all shells, which scales the distance at which edges meet; they begin at 0 here
    samples = [shell.places_at(shell.end * np.arange(101.0) / 100) for shell in shells]
    extent = np.ptp(np.vstack(samples), axis=0).max()
    successors = dict[str, str]()
    for number, names in enumerate(joints):
        key, edge_words = f"joints.{number}.edges", " and ".join(names)
        if names[0] in edges and names[1] in {shell.name for shell in shells}:
            continue  # of a T-junction
        if any(name not in edges for name in names):
            return f"{key}: there is no such edge"
        # the beginning of one shell first, the end of the other last
        first_edge, last_edge = sorted((edges[name] for name in names), key=lambda edge: edge[0])
        begin_side, begin_place, next_shell = first_edge
        end_side, end_place, previous_shell = last_edge
        if (begin_side, end_side) != (0, 1):  # two beginnings, or two ends
            return f"{key}: the normals of {edge_words} point to opposite sides"
        if np.linalg.norm(begin_place - end_place) > MEETING_TOLERANCE * extent:
            return f"{key}: {edge_words} do not meet"
        successors[previous_shell.name] = next_shell.name
    return successors


def _with_feet(shell: CoaxialShell, feet: Sequence[Array]) -> CoaxialShell:
    """Return a shell whose mesh has vertices where edges of other shells stand on it.

    `feet` are the places (3,) of these edges.
    """
    parameters = []
    for place in feet:
        common_parameter, _ = shell.foot(place)
        parameters.append(float(shell.own_parameter(np.array(common_parameter))))
    # a jump of the curvature always has a vertex, so a foot is listed as one
    new_jumps = [s for s in parameters if np.abs(shell.chart.knots - s).min() > ROUNDING]
    chart = replace(shell.chart, curvature_jumps=(*shell.chart.curvature_jumps, *new_jumps))
    return replace(shell, problem=replace(shell.problem, meridian=chart), chart=chart)


def _in_chains(shells: Sequence[CoaxialShell], successors: Mapping[str, str]) -> list[CoaxialShell]:
    """Return the shells in the order of the common parameter, with their `start` set.

    A shell is followed without a gap by the one that is joined to its end. Shells in a closed ring
    are left out.

    Parameters
    ----------
    successors
        Name of a shell -> name of the shell that follows it.
    """
    by_name, ordered_shells = {shell.name: shell for shell in shells}, list[CoaxialShell]()
    # a chain begins with a shell that follows none
    first_names = [shell.name for shell in shells if shell.name not in successors.values()]
    end = -PARAMETER_GAP  # the first chain begins at zero
    for name in first_names:
        end += PARAMETER_GAP
        next_name = name or None
        while next_name:
            ordered_shells.append(replace(by_name[next_name], start=end))
            end = ordered_shells[-1].end
            next_name = successors.get(next_name)
    return ordered_shells


def _problem_of(part: "MemberCase") -> Problem | str:
    """Return the problem of a shell alone, reduced to its meridian.

    The result is a reason in words if the shell is not axisymmetric. Other errors are raised with
    the key of the shell.
    """
    # the planner finds the outlines of several shells
    from magshell_fenicsx.case.planner import make_problem

    try:
        return make_problem(part.case.model_copy(update={"symmetry": "axisymmetric"}))
    except (CaseError, MeshError) as e:
        if str(e).startswith(NO_MERIDIAN):
            return str(e).removeprefix(NO_MERIDIAN)
        raise type(e)(part.refused(str(e))) from None


def _joined_chart(shells: Sequence[CoaxialShell], several: "SeveralShells") -> MeridianChart:
    """Return the chart of all meridians.

    Parameters
    ----------
    shells
        The shells, in the order of the common parameter.
    several
        The shells of the case, with their joints.
    """
    # names: of the shells by their numbers in the case
    joints, names = several.joints, [member.name for member in several.parts]
    by_name = {shell.name: shell for shell in shells}
    # names of ends that are joined to each other; at a T-junction, which is left out, the second
    # name is that of a shell
    joined_ends = {name for joint in joints if joint[1] not in by_name for name in joint}
    # where the parameters that count as those of a shell begin: half of a gap belongs to each shell
    begins = [
        shell.start - (0 if shell.names[0] in joined_ends else PARAMETER_GAP / 2)
        for shell in shells
    ]
    embedding = CoaxialEmbedding(shells, np.array(begins))

    def locate(x: Array) -> tuple[float, float]:
        """Return common parameter and azimuth (rad) of a place, or of a node of a known shell.

        A place is (3,); a node is (4,), with the number of its shell last.
        """
        if len(x) > len("xyz"):
            return by_name[names[round(float(x[-1]))]].foot(x)
        return _nearest_foot(shells, x)

    # common parameters and places of all ends by name, and what the chart has of all shells
    parameters, places = dict[str | None, float](), dict[str | None, Array]()
    curvature_jumps, end_names = list[float](), list[str | None]()
    for shell in shells:
        parameters |= dict(zip(shell.names, (shell.start, shell.end), strict=True))
        places |= dict(shell.places)
        curvature_jumps += [
            float(shell.parameter(np.array(jump))) for jump in shell.chart.curvature_jumps
        ]
        end_names += [None if name in joined_ends else name for name in shell.names]

    def parameter_of(edge: str, foot: str) -> float:
        """Return the common parameter of an edge, or of the place of `foot` on a shell."""
        if edge in parameters:
            return parameters[edge]
        foot_parameter, _ = by_name[edge].foot(places[foot])  # `edge` is the name of a shell
        return foot_parameter

    chart = MeridianChart(
        shells[-1].end,
        tuple(curvature_jumps),
        tuple(end_names),
        embedding,
        embedding.normal,
        locate,
        shell_meridians=tuple(shell.shell_meridian for shell in shells),
        joints=tuple((parameters[foot], parameter_of(edge, foot)) for foot, edge in joints),
    )
    # all meridians share one number as curvature. It is set so that their measure of waves, reach
    # times the root of curvature over h, is the largest of any shell
    reach, h = max(1.0, float(chart.sample()[:, 0].max())), shells[0].problem.material.h
    waves = max(shell.wave_measure for shell in shells)
    return replace(chart, curvature=h * (waves / reach) ** 2)


def _nearest_foot(shells: Sequence[CoaxialShell], x: Array) -> tuple[float, float]:
    """Return common parameter and azimuth (rad) of the place of any shell nearest to x (3,)."""
    in_plane = np.array([np.hypot(x[0], x[1]), 0.0, x[2]])
    # the nearest place of each shell, and its distance in the plane of the meridians
    feet = [shell.foot(x) for shell in shells]
    distances = [
        np.linalg.norm(shell.places_at(np.array([s]))[0] - in_plane)
        for shell, (s, _) in zip(shells, feet, strict=True)
    ]
    return feet[int(np.argmin(distances))]
