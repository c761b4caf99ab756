"""A point of a history and how it came about."""

from dataclasses import dataclass
from typing import Literal

from magshell_fenicsx.continuation.point import Point

Label = Literal["start", "field", "step", "target", "fold", "bifurcation"]


@dataclass(frozen=True)
class Record:
    """A point of the history and how it came about.

    Attributes
    ----------
    label
        "field": while the field grows; "step": on the way; "target": asked for;
        "fold" and "bifurcation": a located instability.
    amplitude
        The amplitude that varied ("" at the start).
    mode
        Of an instability that a reduced model excludes: "antisymmetric" to the mirror plane of a
        half shell, or "m = 7" waves around an axisymmetric one. There such a mode becomes unstable,
        or stable again.
        Of a bifurcation in the model itself: "symmetric" if the load changes alike in both
        directions of the branch (a pitchfork), or "asymmetric".
    branch
        0 on the path itself, 1 and 2 in the two directions of the branch at its first bifurcation.
    excluded_pivots
        Number of unstable directions that the model excludes; see `continuation.watch.Watch`.
    step
        Number of the programme's step, from 1; 0 at the start.
    """

    label: Label
    amplitude: str
    point: Point
    mode: str = ""
    branch: int = 0
    excluded_pivots: int = 0
    step: int = 0


class Stopped(RuntimeError):
    """The history ended before its target; the message says where and why."""
