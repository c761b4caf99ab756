"""The mesh that was chosen for a tolerance, how it was found, and the file that keeps it."""

import json
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.plan.plan import Plan
from magshell_fenicsx.plan.planner import make_plan
from magshell_fenicsx.simulate.adapt.size import Sampled
from magshell_fenicsx.simulate.scene import Scene


@dataclass(frozen=True)
class Choice:
    """A degree and a mesh; without sizes it has the default ones over `refinement`.

    With sizes, `refinement` says how much finer than by default it is in the mean, and scales nothing.
    """

    degree: int
    refinement: float
    size: Sampled | None = None

    def applied(self, asked: Case) -> tuple[Case, Plan]:
        """The case on this mesh, and its plan."""
        mesh = asked.mesh.model_copy(update={"degree": self.degree, "refinement": self.refinement})
        case = asked.model_copy(update={"mesh": mesh})
        plan = make_plan(case)
        return case, replace(plan, size=self.size) if self.size else plan

    def scene(self, asked: Case, comm: MPI.Comm) -> Scene:
        case, plan = self.applied(asked)
        return Scene(case, comm, plan)


@dataclass(frozen=True)
class Round:
    """A mesh that was tried; `estimate` is that of the relative error of the result."""

    degree: int
    refinement: float
    cells: int
    dofs: int
    result: float
    estimate: float


@dataclass(frozen=True)
class Adapted:
    """What the rounds have found.

    Attributes
    ----------
    asked
        The case with the tolerance.
    choice, best
        The mesh to take, and its round: that of fewest unknowns within the tolerance, or of the least error if
        there is none.
    rounds
        All in their order.
    """

    asked: Case
    choice: Choice
    best: Round
    rounds: list[Round]

    def account(self, result: float | None) -> dict[str, Any]:
        """For summary.json, after the run on this mesh; no estimate if that ended elsewhere than the rounds did.

        Parameters
        ----------
        result
            Of the run (`Ending.value`), None if it has none.
        """
        best = self.best
        same = result is not None and abs(result - best.result) <= best.estimate * abs(best.result)
        return {
            "tolerance": self.asked.mesh.tolerance,
            "error_estimate": best.estimate if same else None,
            "rounds": [asdict(r) for r in self.rounds],
        }

    def to_json(self) -> bytes:
        """All but the case, in full precision: a run that is resumed has the same mesh on any number of ranks."""
        size = self.choice.size
        sizes = size and {"points": size.points.tolist(), "sizes": size.sizes.tolist()}
        rounds = [asdict(r) for r in self.rounds]
        return json.dumps({"best": self.rounds.index(self.best), "rounds": rounds, "size": sizes}).encode()

    @classmethod
    def from_json(cls, asked: Case, content: bytes) -> "Adapted":
        """Of the same case."""
        known = json.loads(content)
        rounds = [Round(**r) for r in known["rounds"]]
        best, size = rounds[known["best"]], known["size"]
        sampled = Sampled(*(np.array(size[key]) for key in ("points", "sizes"))) if size else None
        return cls(asked, Choice(best.degree, best.refinement, sampled), best, rounds)
