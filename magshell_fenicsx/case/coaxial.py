"""The meridians of several shells of revolution with one axis, one after the other along one
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
    from magshell_fenicsx.case.shells import Part, Several

Array = NDArray[np.float64]
APART = 1.0  # R: parameters between two shells that belong to none
ASKED = "symmetry: axisymmetric: "  # how a message begins that says why there is no meridian


@dataclass(frozen=True)
class Turned:
    """A shell of revolution with the axis of all.

    Attributes
    ----------
    start
        Where its parameter begins.
    span, place, outline
        Its own meridian over its own length, where it is, and its outline.
    """

    name: str
    start: float
    problem: Problem
    span: MeridianChart
    place: ShellPose
    outline: Outline

    @property
    def end(self) -> float:
        """Where its parameter ends."""
        return self.start + self.place.scale * self.span.length

    @property
    def upright(self) -> bool:
        """Whether its own e3 is that of all; else it is walked from its end, for its normal to stay
        outside.
        """
        return bool(self.place.Q[2, 2] > 0)

    @property
    def most_waves(self) -> float:
        """What the number of waves around e3 goes with, see `shells.waves.Waves`."""
        reach = max(1.0, float(self.span.sample()[:, 0].max()))
        return reach * float(np.sqrt(self.span.curvature / self.problem.material.h))

    def own(self, s: Array) -> Array:
        """Its own parameter."""
        t = (s - self.start) / self.place.scale
        return np.clip(t if self.upright else self.span.length - t, 0.0, self.span.length)

    def parameter(self, own: Array) -> Array:
        """That of all."""
        return self.start + self.place.scale * (own if self.upright else self.span.length - own)

    def at(self, s: Array) -> Array:
        """Places (n, 3) in the plane of e1 and e3."""
        own = self.own(s)
        return (
            self._turned(self.place.scale * self.span.embedding(np.column_stack([own, 0 * own])))
            + self._moved
        )

    def normal(self, s: Array) -> Array:
        """Outward normals (n, 3) there."""
        own = self.own(s)
        return self._turned(self.span.normal(np.column_stack([own, 0 * own])))

    def deviation(self, s: Array) -> Array:
        """w0 (n, 1) of the drawn shell there, over R."""
        own, drawn = self.own(s), self.span.embedding
        w0 = drawn.w0(np.column_stack([own, 0 * own])) if isinstance(drawn, DeviatedEmbedding) else 0 * own
        return np.asarray(self.place.scale * w0[:, None])

    def foot(self, x: Array) -> tuple[float, float]:
        """Parameter and azimuth (rad) of the nearest place to one in space."""
        own, _ = self.span.locate(self.outline.inverse(self.place.to_shell_frame(np.asarray(x)[:3])))
        return float(self.parameter(np.array(own))), float(np.arctan2(x[1], x[0]))

    def vertices(self, pressed: Sequence[tuple[float, float]]) -> Array:
        """See `ShellMeridian`."""
        own = tuple((size / self.place.scale, reach / self.place.scale) for size, reach in pressed)
        s = self.parameter(
            meridian_vertices(replace(self.problem, body_contacts=(*self.problem.body_contacts, *own)))
        )
        return np.asarray(s if self.upright else s[::-1])

    @property
    def names(self) -> list[str | None]:
        """Those of its first and last end; None for a pole."""
        named = [name and f"{self.name}_{name}" for name in self.span.names]
        return named if self.upright else named[::-1]

    @property
    def places(self) -> list[tuple[str | None, Array]]:
        """Their names and places."""
        return [
            (name, self.at(np.array([s]))[0])
            for name, s in zip(self.names, (self.start, self.end), strict=True)
        ]

    @property
    def piece(self) -> ShellMeridian:
        """It as a part of all."""
        return ShellMeridian(self.name, (self.start, self.end), self.foot, self.vertices)

    def _turned(self, x: Array) -> Array:
        return np.asarray(x if self.upright else x * [1.0, 1.0, -1.0])

    @property
    def _moved(self) -> Array:
        return self.place.position * [0.0, 0.0, 1.0]


@dataclass(frozen=True)
class Joined:
    """Charts (n, 2) of the meridians of all -> places (n, 3); the parameters of each follow its
    begin.
    """

    shells: Sequence[Turned]
    begins: Array

    def __call__(self, chart: Array) -> Array:
        return self._along(chart, "at", 3)

    def normal(self, chart: Array) -> Array:
        """Outward normals (n, 3) of the perfect shells."""
        return self._along(chart, "normal", 3)

    def w0(self, chart: Array) -> Array:
        """The deviations (n,) of the drawn shells, over R."""
        return self._along(chart, "deviation", 1)[:, 0]

    def _along(self, chart: Array, of: str, size: int) -> Array:
        s, values = chart[:, 0], np.empty((len(chart), size))
        which = np.searchsorted(self.begins, s + ROUNDING, side="right") - 1
        for i, shell in enumerate(self.shells):
            values[which == i] = getattr(shell, of)(s[which == i])
        return values


def meridians(several: "Several") -> MeridianChart | str:
    """Those of all shells, over the R of the first one; or why there are none.

    Raises
    ------
    CaseError, MeshError
        If a shell alone cannot be built; the message begins with its key.
    """
    joined = [{several.of(name) for name in names} for names in several.joints]
    if any(set(pair) in joined for pair in several.pairs):
        return "contact: shells that are joined to each other are modelled with their circumference"
    shells = list[Turned]()
    for part in several.parts:
        place, outline = several.place(part), reference_shell_of(part.case.shell).perfect
        key = part.refused("place")
        if max(np.hypot(*place.position[:2]), np.hypot(*place.Q[:2, 2])) > ROUNDING:
            return f"{key}: its axis is not e3 through the origin"
        problem = _alone(part)
        if isinstance(problem, str):
            return part.refused(problem)
        assert problem.meridian
        shells.append(Turned(part.name, 0.0, problem, problem.meridian, place, outline))
    after = _after(shells, several.joints)
    if isinstance(after, str):
        return after
    places = dict(of for shell in shells for of in shell.places)
    marked = [
        _marked(shell, [places[foot] for foot, on in several.joints if on == shell.name])
        for shell in shells
    ]
    ordered = _in_chains(marked, after)
    return (
        "joints: shells are joined in a ring"
        if len(ordered) < len(shells)
        else _joined(ordered, several)
    )


def _after(shells: Sequence[Turned], joints: Sequence[tuple[str, str]]) -> dict[str, str] | str:
    """Shell -> that which goes on where it ends, joined to it; or why two cannot be joined so."""
    ends = {name: (end, x, shell) for shell in shells for end, (name, x) in enumerate(shell.places)}
    along = [shell.at(shell.end * np.arange(101.0) / 100) for shell in shells]
    extent = np.ptp(np.vstack(along), axis=0).max()
    after = dict[str, str]()
    for number, names in enumerate(joints):
        key, both = f"joints.{number}.edges", " and ".join(names)
        if names[0] in ends and names[1] in {shell.name for shell in shells}:
            continue  # of a T-junction
        if any(name not in ends for name in names):
            return f"{key}: there is no such edge"
        (begin, x, after_it), (end, y, before_it) = sorted(
            (ends[name] for name in names), key=lambda end: end[0]
        )
        if (begin, end) != (0, 1):
            return f"{key}: the normals of {both} point to opposite sides"
        if np.linalg.norm(x - y) > MEETING_TOLERANCE * extent:
            return f"{key}: {both} do not meet"
        after[before_it.name] = after_it.name
    return after


def _marked(shell: Turned, feet: Sequence[Array]) -> Turned:
    """With cells that end where another shell stands, at places (3,)."""
    own = [float(shell.own(np.array(shell.foot(x)[0]))) for x in feet]
    new = [s for s in own if np.abs(shell.span.knots - s).min() > ROUNDING]
    span = replace(shell.span, curvature_jumps=(*shell.span.curvature_jumps, *new))
    return replace(shell, problem=replace(shell.problem, meridian=span), span=span)


def _in_chains(shells: Sequence[Turned], after: Mapping[str, str]) -> list[Turned]:
    """Along the parameter: each followed by that which is joined to its end, with none between."""
    by_name, ordered, end = {shell.name: shell for shell in shells}, list[Turned](), -APART
    for name in (shell.name for shell in shells if shell.name not in after.values()):
        end, of = end + APART, name or None
        while of:
            ordered.append(replace(by_name[of], start=end))
            end, of = ordered[-1].end, after.get(of)
    return ordered


def _alone(part: "Part") -> Problem | str:
    """The meridian of a shell alone; or why there is none."""
    from magshell_fenicsx.case.planner import (
        make_problem,
    )  # which finds the outlines of several shells

    try:
        return make_problem(part.case.model_copy(update={"symmetry": "axisymmetric"}))
    except (CaseError, MeshError) as e:
        if str(e).startswith(ASKED):
            return str(e).removeprefix(ASKED)
        raise type(e)(part.refused(str(e))) from None


def _joined(shells: Sequence[Turned], several: "Several") -> MeridianChart:
    joints, names = several.joints, [part.name for part in several.parts]
    by_name = {shell.name: shell for shell in shells}
    joined = {name for one, other in joints if other not in by_name for name in (one, other)}
    begins = [shell.start - (0 if shell.names[0] in joined else APART / 2) for shell in shells]
    drawn = Joined(shells, np.array(begins))

    def place(x: Array) -> tuple[float, float]:
        """Of a node of the triangulation, which has the number of its shell, or of a place (3,)."""
        if len(x) > len("xyz"):
            return by_name[names[round(float(x[-1]))]].foot(x)
        at = np.array([np.hypot(x[0], x[1]), 0.0, x[2]])
        feet = [shell.foot(x) for shell in shells]
        away = [
            np.linalg.norm(shell.at(np.array([s]))[0] - at)
            for shell, (s, _) in zip(shells, feet, strict=True)
        ]
        return feet[int(np.argmin(away))]

    at = {
        name: s
        for shell in shells
        for name, s in zip(shell.names, (shell.start, shell.end), strict=True)
    }
    places = dict(of for shell in shells for of in shell.places)
    span = MeridianChart(
        shells[-1].end,
        tuple(float(shell.parameter(np.array(c))) for shell in shells for c in shell.span.curvature_jumps),
        tuple(None if name in joined else name for shell in shells for name in shell.names),
        drawn,
        drawn.normal,
        place,
        shell_meridians=tuple(shell.piece for shell in shells),
        joints=tuple(
            (at[one], at[other] if other in at else by_name[other].foot(places[one])[0])
            for one, other in joints
        ),
    )
    reach, h = max(1.0, float(span.sample()[:, 0].max())), shells[0].problem.material.h
    waves = max(shell.most_waves for shell in shells)
    return replace(span, curvature=h * (waves / reach) ** 2)
