"""Meridians of several shells of revolution with one axis, one after the other along one
parameter.
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
from magshell_fenicsx.problem.problem import Problem, meridian_vertices
from magshell_fenicsx.shape.meridian_chart import MeridianChart, ShellMeridian
from magshell_fenicsx.shape.outline import Outline, reference_shell_of

if TYPE_CHECKING:
    from magshell_fenicsx.case.shells import MemberCase, SeveralShells

Array = NDArray[np.float64]
PARAMETER_GAP = 1.0  # over R: parameters between two shells that belong to none
NO_MERIDIAN = "symmetry: axisymmetric: "  # begin of a message that says why there is no meridian


@dataclass(frozen=True)
class CoaxialShell:
    """Shell of revolution whose axis is that of all.

    Attributes
    ----------
    start
        Begin of the shell's parameter along all meridians, over the R of the first shell.
    problem
        The problem of the shell alone.
    chart, place, outline
        The shell's own meridian over its own length, its place, and its outline.
    """

    name: str
    start: float
    problem: Problem
    chart: MeridianChart
    place: ShellPose
    outline: Outline

    @property
    def end(self) -> float:
        """End of the shell's parameter along all meridians."""
        return self.start + self.place.scale * self.chart.length

    @property
    def upright(self) -> bool:
        """Whether the shell's own e3 is that of all.

        Otherwise its meridian is taken from its end, so that its normal stays outside.
        """
        return bool(self.place.Q[2, 2] > 0)

    @property
    def wave_measure(self) -> float:
        """Measure of the largest wave number around e3, see `shells.waves.Waves`."""
        reach = max(1.0, float(self.chart.sample()[:, 0].max()))
        return reach * float(np.sqrt(self.chart.curvature / self.problem.material.h))

    def own_parameter(self, s: Array) -> Array:
        """Return the parameter of the shell alone from that of all meridians."""
        t = (s - self.start) / self.place.scale
        return np.clip(t if self.upright else self.chart.length - t, 0.0, self.chart.length)

    def parameter(self, own_parameter: Array) -> Array:
        """Return the parameter of all meridians from that of the shell alone."""
        from_start = own_parameter if self.upright else self.chart.length - own_parameter
        return self.start + self.place.scale * from_start

    def places_at(self, s: Array) -> Array:
        """Return places (n, 3) in the plane of e1 and e3 at parameters (n,)."""
        own_s = self.own_parameter(s)
        places = self.chart.embedding(np.column_stack([own_s, 0 * own_s]))
        return self._in_common_frame(self.place.scale * places) + self._translation

    def normal(self, s: Array) -> Array:
        """Return outward normals (n, 3) at parameters (n,)."""
        own_s = self.own_parameter(s)
        return self._in_common_frame(self.chart.normal(np.column_stack([own_s, 0 * own_s])))

    def deviation(self, s: Array) -> Array:
        """Return w0 (n, 1) of the imperfect shell at parameters (n,), over R."""
        own_s, embedding = self.own_parameter(s), self.chart.embedding
        w0 = 0 * own_s
        if isinstance(embedding, DeviatedEmbedding):
            w0 = embedding.w0(np.column_stack([own_s, 0 * own_s]))
        return np.asarray(self.place.scale * w0[:, None])

    def foot(self, x: Array) -> tuple[float, float]:
        """Return parameter and azimuth (rad) of the nearest place to a place x in space."""
        in_shell_frame = self.place.to_shell_frame(np.asarray(x)[:3])
        own_s, _ = self.chart.locate(self.outline.inverse(in_shell_frame))
        return float(self.parameter(np.array(own_s))), float(np.arctan2(x[1], x[0]))

    def vertices(self, body_contacts: Sequence[tuple[float, float]]) -> Array:
        """Return the parameters of the vertices, see `ShellMeridian`.

        `body_contacts` are element size and reach where bodies press, over the first shell's R.
        """
        scale = self.place.scale
        own_contacts = tuple((size / scale, reach / scale) for size, reach in body_contacts)
        body_contacts = (*self.problem.body_contacts, *own_contacts)
        own_s = meridian_vertices(replace(self.problem, body_contacts=body_contacts))
        s = self.parameter(own_s)
        return np.asarray(s if self.upright else s[::-1])

    @property
    def names(self) -> list[str | None]:
        """Names of the shell's first and last end; None for a pole."""
        names = [name and f"{self.name}_{name}" for name in self.chart.names]
        return names if self.upright else names[::-1]

    @property
    def places(self) -> list[tuple[str | None, Array]]:
        """Names and places of the shell's ends."""
        return [
            (name, self.places_at(np.array([s]))[0])
            for name, s in zip(self.names, (self.start, self.end), strict=True)
        ]

    @property
    def shell_meridian(self) -> ShellMeridian:
        """The shell as a part of all meridians."""
        return ShellMeridian(self.name, (self.start, self.end), self.foot, self.vertices)

    def _in_common_frame(self, x: Array) -> Array:
        """Return vectors (n, 3) of the shell's frame in that of all."""
        return np.asarray(x if self.upright else x * [1.0, 1.0, -1.0])

    @property
    def _translation(self) -> Array:
        return self.place.position * [0.0, 0.0, 1.0]


@dataclass(frozen=True)
class CoaxialEmbedding:
    """Map from charts (n, 2) of all meridians to places (n, 3).

    Attributes
    ----------
    shells
        The shells, ascending along the parameter.
    begins
        Begin of the parameters that belong to each shell.
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
        """Return values (n, size) of a method of the shells."""
        s, values = chart[:, 0], np.empty((len(chart), size))
        shell_numbers = np.searchsorted(self.begins, s + ROUNDING, side="right") - 1
        for i, shell in enumerate(self.shells):
            values[shell_numbers == i] = getattr(shell, name)(s[shell_numbers == i])
        return values


def meridians(several: "SeveralShells") -> MeridianChart | str:
    """Return the meridians of all shells, over the R of the first one; or why there are none.

    Raises
    ------
    CaseError, MeshError
        If a shell alone cannot be built; the message begins with its key.
    """
    joined_shells = [{several.shell_of(name) for name in names} for names in several.joints]
    if any(set(pair) in joined_shells for pair in several.pairs):
        return "contact: shells that are joined to each other are modelled with their circumference"
    shells = list[CoaxialShell]()
    for part in several.parts:
        place, outline = several.place(part), reference_shell_of(part.case.shell).perfect
        key = part.refused("place")
        if max(np.hypot(*place.position[:2]), np.hypot(*place.Q[:2, 2])) > ROUNDING:
            return f"{key}: its axis is not e3 through the origin"
        problem = _problem_of(part)
        if isinstance(problem, str):
            return part.refused(problem)
        assert problem.meridian
        shells.append(CoaxialShell(part.name, 0.0, problem, problem.meridian, place, outline))
    successors = _successors(shells, several.joints)
    if isinstance(successors, str):
        return successors
    places = dict(name_and_place for shell in shells for name_and_place in shell.places)
    with_feet = []
    for shell in shells:
        feet = [places[edge] for edge, other in several.joints if other == shell.name]
        with_feet.append(_with_feet(shell, feet))
    ordered = _in_chains(with_feet, successors)
    if len(ordered) < len(shells):
        return "joints: shells are joined in a ring"
    return _joined_chart(ordered, several)


def _successors(
    shells: Sequence[CoaxialShell], joints: Sequence[tuple[str, str]]
) -> dict[str, str] | str:
    """Return shell -> the shell that goes on where it ends, joined to it.

    If two shells cannot be joined so, the result is the reason.
    """
    ends = {
        name: (end, begin_place, shell)
        for shell in shells
        for end, (name, begin_place) in enumerate(shell.places)
    }
    samples = [shell.places_at(shell.end * np.arange(101.0) / 100) for shell in shells]
    extent = np.ptp(np.vstack(samples), axis=0).max()
    successors = dict[str, str]()
    for number, names in enumerate(joints):
        key, edge_words = f"joints.{number}.edges", " and ".join(names)
        if names[0] in ends and names[1] in {shell.name for shell in shells}:
            continue  # of a T-junction
        if any(name not in ends for name in names):
            return f"{key}: there is no such edge"
        (begin, begin_place, next_shell), (end, end_place, previous_shell) = sorted(
            (ends[name] for name in names), key=lambda end: end[0]
        )
        if (begin, end) != (0, 1):
            return f"{key}: the normals of {edge_words} point to opposite sides"
        if np.linalg.norm(begin_place - end_place) > MEETING_TOLERANCE * extent:
            return f"{key}: {edge_words} do not meet"
        successors[previous_shell.name] = next_shell.name
    return successors


def _with_feet(shell: CoaxialShell, feet: Sequence[Array]) -> CoaxialShell:
    """Return a shell with cells that end where other shells stand, at places (3,)."""
    parameters = [float(shell.own_parameter(np.array(shell.foot(foot)[0]))) for foot in feet]
    new_jumps = [s for s in parameters if np.abs(shell.chart.knots - s).min() > ROUNDING]
    chart = replace(shell.chart, curvature_jumps=(*shell.chart.curvature_jumps, *new_jumps))
    return replace(shell, problem=replace(shell.problem, meridian=chart), chart=chart)


def _in_chains(shells: Sequence[CoaxialShell], successors: Mapping[str, str]) -> list[CoaxialShell]:
    """Return the shells in the order of the parameter.

    Each is followed by the shell that is joined to its end, without a gap.
    """
    by_name, ordered, end = (
        {shell.name: shell for shell in shells},
        list[CoaxialShell](),
        -PARAMETER_GAP,
    )
    for name in (shell.name for shell in shells if shell.name not in successors.values()):
        end, next_name = end + PARAMETER_GAP, name or None
        while next_name:
            ordered.append(replace(by_name[next_name], start=end))
            end, next_name = ordered[-1].end, successors.get(next_name)
    return ordered


def _problem_of(part: "MemberCase") -> Problem | str:
    """Return the problem of a shell alone, on its meridian; or why there is none."""
    # the planner finds the outlines of several shells
    from magshell_fenicsx.case.planner import make_problem

    try:
        return make_problem(part.case.model_copy(update={"symmetry": "axisymmetric"}))
    except (CaseError, MeshError) as e:
        if str(e).startswith(NO_MERIDIAN):
            return str(e).removeprefix(NO_MERIDIAN)
        raise type(e)(part.refused(str(e))) from None


def _joined_chart(shells: Sequence[CoaxialShell], several: "SeveralShells") -> MeridianChart:
    """Return the chart of all meridians, in the order of the parameter."""
    joints, names = several.joints, [part.name for part in several.parts]
    by_name = {shell.name: shell for shell in shells}
    joined_ends = {name for joint in joints if joint[1] not in by_name for name in joint}
    begins = []
    for shell in shells:
        is_joined = shell.names[0] in joined_ends
        begins.append(shell.start - (0 if is_joined else PARAMETER_GAP / 2))
    embedding = CoaxialEmbedding(shells, np.array(begins))

    def locate(x: Array) -> tuple[float, float]:
        """Return parameter and azimuth of a place (3,), or of a node with its shell's number."""
        if len(x) > len("xyz"):
            return by_name[names[round(float(x[-1]))]].foot(x)
        in_plane = np.array([np.hypot(x[0], x[1]), 0.0, x[2]])
        feet = [shell.foot(x) for shell in shells]
        distances = [
            np.linalg.norm(shell.places_at(np.array([s]))[0] - in_plane)
            for shell, (s, _) in zip(shells, feet, strict=True)
        ]
        return feet[int(np.argmin(distances))]

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
        if edge in parameters:
            return parameters[edge]
        return by_name[edge].foot(places[foot])[0]

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
    reach, h = max(1.0, float(chart.sample()[:, 0].max())), shells[0].problem.material.h
    waves = max(shell.wave_measure for shell in shells)
    return replace(chart, curvature=h * (waves / reach) ** 2)
