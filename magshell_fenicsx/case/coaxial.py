"""The meridians of several shells of revolution with one axis, one after the other along one parameter."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.mesh.assembly import Place
from magshell_fenicsx.mesh.mirror import ROUNDING
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.problem.problem import Problem, meridian_vertices
from magshell_fenicsx.shape.outline import Outline, ground_of
from magshell_fenicsx.shape.turning import Piece, Span

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
    span: Span
    place: Place
    outline: Outline

    @property
    def end(self) -> float:
        """Where its parameter ends."""
        return self.start + self.place.scale * self.span.length

    @property
    def upright(self) -> bool:
        """Whether its own e3 is that of all; else it is walked from its end, for its normal to stay outside."""
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
        return self._turned(self.place.scale * self.span.embedding(np.column_stack([own, 0 * own]))) + self._moved

    def normal(self, s: Array) -> Array:
        """Outward normals (n, 3) there."""
        own = self.own(s)
        return self._turned(self.span.normal(np.column_stack([own, 0 * own])))

    def foot(self, x: Array) -> tuple[float, float]:
        """Parameter and azimuth (rad) of the nearest place to one in space."""
        own, _ = self.span.place(self.outline.inverse(self.place.own(np.asarray(x)[:3])))
        return float(self.parameter(np.array(own))), float(np.arctan2(x[1], x[0]))

    def vertices(self, pressed: Sequence[tuple[float, float]]) -> Array:
        """See `Piece`."""
        own = tuple((size / self.place.scale, reach / self.place.scale) for size, reach in pressed)
        s = self.parameter(meridian_vertices(replace(self.problem, pressed=(*self.problem.pressed, *own))))
        return np.asarray(s if self.upright else s[::-1])

    @property
    def piece(self) -> Piece:
        """It as a part of all."""
        named = [name and f"{self.name}_{name}" for name in self.span.names]
        first, last = named if self.upright else named[::-1]
        return Piece(self.name, (self.start, self.end), (first, last), self.foot, self.vertices)

    def _turned(self, x: Array) -> Array:
        return np.asarray(x if self.upright else x * [1.0, 1.0, -1.0])

    @property
    def _moved(self) -> Array:
        return self.place.position * [0.0, 0.0, 1.0]


def meridians(several: "Several") -> Span | str:
    """Those of all shells, over the R of the first one; or why there are none.

    Raises
    ------
    CaseError, MeshError
        If a shell alone cannot be built; the message begins with its key.
    """
    if several.joints:
        return "joints: shells that are joined are modelled all around"
    shells, start = list[Turned](), 0.0
    for part in several.parts:
        place, outline = several.place(part), ground_of(part.case.shell).perfect
        key = part.refused("place")
        if max(np.hypot(*place.position[:2]), np.hypot(*place.Q[:2, 2])) > ROUNDING:
            return f"{key}: its axis is not e3 through the origin"
        problem = _alone(part)
        if isinstance(problem, str):
            return part.refused(problem)
        assert problem.meridian
        shells.append(Turned(part.name, start, problem, problem.meridian, place, outline))
        start = shells[-1].end + APART
    return _joined(shells)


def _alone(part: "Part") -> Problem | str:
    """The meridian of a shell alone; or why there is none."""
    from magshell_fenicsx.case.planner import make_problem  # which finds the outlines of several shells

    try:
        return make_problem(part.case.model_copy(update={"symmetry": "axisymmetric"}))
    except (CaseError, MeshError) as e:
        if str(e).startswith(ASKED):
            return str(e).removeprefix(ASKED)
        raise type(e)(part.refused(str(e))) from None


def _joined(shells: Sequence[Turned]) -> Span:
    begins = np.array([shell.start for shell in shells])

    def along(chart: Array, of: str) -> Array:
        s, places = chart[:, 0], np.empty((len(chart), 3))
        which = np.searchsorted(begins, s + APART / 2, side="right") - 1
        for i, shell in enumerate(shells):
            places[which == i] = getattr(shell, of)(s[which == i])
        return places

    def place(x: Array) -> tuple[float, float]:
        """Of a node of the triangulation, which has the number of its shell, or of a place (3,)."""
        if len(x) > len("xyz"):
            return shells[round(float(x[-1]))].foot(x)
        at = np.array([np.hypot(x[0], x[1]), 0.0, x[2]])
        feet = [shell.foot(x) for shell in shells]
        away = [np.linalg.norm(shell.at(np.array([s]))[0] - at) for shell, (s, _) in zip(shells, feet, strict=True)]
        return feet[int(np.argmin(away))]

    pieces = tuple(shell.piece for shell in shells)
    span = Span(
        shells[-1].end,
        tuple(float(shell.parameter(np.array(c))) for shell in shells for c in shell.span.circles),
        tuple(name for piece in pieces for name in piece.names),
        lambda chart: along(chart, "at"),
        lambda chart: along(chart, "normal"),
        place,
        pieces=pieces,
    )
    reach, h = max(1.0, float(span.sample()[:, 0].max())), shells[0].problem.material.h
    waves = max(shell.most_waves for shell in shells)
    return replace(span, curvature=h * (waves / reach) ** 2)
