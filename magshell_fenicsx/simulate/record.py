"""Records of a history: its points, and where each comes from.

A history is the sequence of equilibria (or moving states) of a case, step by step of its programme.
An amplitude is a load parameter, by name in `State.mu`. A model with symmetry excludes modes that
break it.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

from magshell_fenicsx.continuation.point import Point

if TYPE_CHECKING:
    from dolfinx import fem

    from magshell_fenicsx.continuation.fold import Fold
    from magshell_fenicsx.simulate.scene import Scene

Label = Literal["start", "field", "step", "target", "fold", "bifurcation", "solution"]

AT_POINT_FORCES = (
    "there it bends to radii below its thickness, where no shell theory holds and results depend "
    "on the mesh; spread the force: patch of kind: indentation, a pressure by formula, or a body"
)


@dataclass(frozen=True, repr=False)
class Record:
    """A point of the history, a row of path.csv, with its origin.

    A pickled record has its numbers alone: no scene, and no function `u`.

    Attributes
    ----------
    label
        "field": during the growth of the field; "step": between targets; "target": a requested
        point; "fold" and "bifurcation": a located instability; "solution": a further equilibrium at
        the amplitudes of the point where its step ends.
    amplitude
        The amplitude that varied ("" at the start).
    point
        State and tangent of the path, with the number of unstable directions.
    mode
        For a mode that a reduced model excludes and that becomes unstable or stable here:
        "antisymmetric" to the mirror plane of a half shell, or "m = 7" waves around an axisymmetric
        one. For a bifurcation of the model itself: "symmetric" if the load changes equally in both
        directions of the branch (a pitchfork), or "asymmetric".
    branch
        0 on the path itself, 1 and 2 in the two directions of the branch at its first bifurcation;
        of a solution its number.
    excluded_pivots
        Number of unstable directions that the model excludes; see
        `continuation.stability_monitor.StabilityMonitor`.
    step
        Number of the programme's step, from 1; 0 at the start.
    clock
        Columns of a step in time: time, kinetic, dissipated and work, since its begin.
    reached
        False at the end of a `trace` that has not come to its last target.
    scene
        Scene of the point: another than that of a run's begin where a mode has led out of its
        model.
    said
        A sentence that the point must not be read without.
    """

    label: Label
    amplitude: str
    point: Point
    mode: str = ""
    branch: int = 0
    excluded_pivots: int = 0
    step: int = 0
    clock: Mapping[str, float] = field(default_factory=dict)
    reached: bool = True
    scene: "Scene | None" = field(default=None, compare=False, repr=False)
    said: str = ""

    def __getstate__(self) -> dict[str, Any]:
        """Return what is pickled: a scene belongs to its process."""
        return vars(self) | {"scene": None}

    def __repr__(self) -> str:
        """Return the record in a line: its label, amplitudes and stability."""
        amplitudes = ", ".join(
            f"{name} = {value:.9g}" for name, value in self.point.state.mu.items()
        )
        mode = f" ({self.mode})" if self.mode else ""
        unstable = self.point.negative_pivots + self.excluded_pivots
        return f"Record {self.label}{mode}: {amplitudes or 'no load'}; {unstable} unstable"

    def with_scene(self, scene: "Scene", step: int | None = None) -> "Record":
        """Return the record as a point of a scene, with the number of a step or with its own."""
        return replace(self, step=self.step if step is None else step, scene=scene)

    def known_scene(self, name: str, advice: str = "") -> "Scene":
        """Return the scene of the point.

        Parameters
        ----------
        name
            What asks for it, for a message.
        advice
            What to write for a record without a scene; by default to give it one.

        Raises
        ------
        ValueError
            If the record was pickled.
        """
        if self.scene is None:
            advice = advice or f"record.with_scene(model).{name}()"
            raise ValueError(f"{name}: this record comes from another process: {advice}")
        return self.scene

    def fold(self) -> "Fold":
        """Return the fold at a record with the label "fold", with its null vector; collective.

        Its amplitude, `value`, has an error of some 1e-9; that of the record is as it was located.

        Raises
        ------
        ValueError
            If the record has another label, or was pickled.
        FoldLost
            If Newton's method for the fold fails.
        """
        from magshell_fenicsx.simulate.steps import fold_at

        return fold_at(self.known_scene("fold"), self)

    def branches(self) -> list["Record"]:
        """Return the first points of the branches at a bifurcation; collective.

        `ms.trace(record, name, first=...)` follows one. A mode of the model itself has two, along
        the mode and against it. A mode that the model excludes has one, in the smallest model that
        has the mode (`record.scene`): the other is the same shape, turned or mirrored. A warning,
        and `said` of its record, say how much the results of the two models differ. That model
        takes over the journal of the run, which must have ended.

        Raises
        ------
        ValueError
            If this record is no bifurcation, or was pickled.
        Stopped
            If no branch is found.
        """
        from magshell_fenicsx.simulate.steps import first_records_of_branches

        return first_records_of_branches(self)

    def solutions(
        self,
        *,
        most: int = 3,
        guesses: int = 12,
        stable: bool = False,
        seconds: float | None = None,
    ) -> "Iterator[Record]":
        """Find further equilibria at the same amplitudes, such as snapped shapes; collective.

        All amplitudes are loads. Each equilibrium is confirmed by Newton's method, and differs from
        all others. There may be more.

        Parameters
        ----------
        most
            Largest number of solutions.
        guesses
            Largest number of guesses that are tried.
        stable
            Whether each guess goes down in energy until it rests at a stable solution; only stable
            ones count then.
        seconds
            Time after which the search ends; None: without a limit.

        Raises
        ------
        ValueError
            If the record was pickled.
        Stopped
            If the record is no equilibrium.
        """
        from magshell_fenicsx.simulate.search import solutions

        scene = self.known_scene("solutions")
        return solutions(scene, self, most=most, guesses=guesses, stable=stable, seconds=seconds)

    @property
    def amplitudes(self) -> Mapping[str, float]:
        """The loads by name, each in the unit of its amplitude."""
        return MappingProxyType(dict(self.point.state.mu))

    @property
    def u(self) -> "fem.Function":
        """The displacement as a dolfinx function; collective.

        It is on the mesh that a program has given, in the lengths of its coordinates; else on the
        scene's own mesh, which is flat triangles or the meridian, in R.

        Raises
        ------
        ValueError
            If the record was pickled.
        """
        scene = self.known_scene("u", "model.put(record), then model.u")
        return scene.displacement(self.point.state)


@dataclass
class PointForceModes:
    """Notes on instabilities at point forces that were left out, one sentence for each force.

    Attributes
    ----------
    points
        Names of points that have a sentence.
    sentences
        Sentences that nobody has taken.
    """

    points: set[str] = field(default_factory=set)
    sentences: list[str] = field(default_factory=list)

    def note(self, point: str, at: str, modes: str) -> None:
        """Note the first instability at a point force; later ones at the same point are not noted.

        Parameters
        ----------
        point
            Name of the point.
        at
            Amplitude and its value, in words.
        modes
            Name of the mode, or words for the instability.
        """
        if point not in self.points:
            self.points.add(point)
            self.sentences.append(
                f"from {at} on modes are unstable within a thickness of the point force at {point} "
                f"({modes} first), and left out: {AT_POINT_FORCES}"
            )

    def take(self) -> list[str]:
        """Return the sentences that nobody has taken; they count as taken then."""
        sentences, self.sentences = self.sentences, []
        return sentences


class Stopped(RuntimeError):
    """The history ended before its target; the message has the place and the reason."""
