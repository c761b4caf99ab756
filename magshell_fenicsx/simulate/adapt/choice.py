"""The mesh chosen for a tolerance, the rounds that led to it, and its file."""

import json
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from mpi4py import MPI

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.problem.elements import SolidSection
from magshell_fenicsx.problem.planner import make_plan
from magshell_fenicsx.problem.problem import Plan
from magshell_fenicsx.simulate.adapt.size import Sampled
from magshell_fenicsx.simulate.scene import Scene


@dataclass(frozen=True)
class Choice:
    """A degree and a mesh; without `size` the elements have the default sizes over `refinement`.

    With `size`, `refinement` only records the mean refinement relative to the default. `layers` are those of a solid.
    """

    degree: int
    refinement: float
    size: Sampled | None = None
    layers: int | None = None

    def applied(self, asked: Case) -> tuple[Case, Plan]:
        """The case on this mesh, and its plan."""
        mesh = asked.mesh.model_copy(update={"degree": self.degree, "refinement": self.refinement})
        case = asked.model_copy(update={"mesh": mesh})
        if self.layers:
            solid = (asked.solid or SolidSection()).model_copy(update={"layers": self.layers})
            case = case.model_copy(update={"solid": solid})
        plan = make_plan(case)
        return case, replace(plan, size=self.size) if self.size else plan

    def scene(self, asked: Case, comm: MPI.Comm) -> Scene:
        case, plan = self.applied(asked)
        return Scene(case, comm, plan)


@dataclass(frozen=True)
class Round:
    """A mesh that was tried; `estimate` is the estimated relative error of the result."""

    degree: int
    refinement: float
    cells: int
    dofs: int
    result: float
    estimate: float
    layers: int | None = None


@dataclass(frozen=True)
class Adapted:
    """The result of all rounds.

    Attributes
    ----------
    asked
        The case with the tolerance.
    choice, best
        The chosen mesh and its round: the fewest unknowns within the tolerance, or else the least error.
    rounds
        All rounds in order.
    """

    asked: Case
    choice: Choice
    best: Round
    rounds: list[Round]

    def account(self, result: float | None) -> dict[str, Any]:
        """The entry of summary.json; without an estimate if the run ended at another result than the rounds.

        The chosen mesh may be a cheaper one than that of the best estimate, which is there too.

        Parameters
        ----------
        result
            Result of the run (`Ending.value`), or None.
        """
        best, least = self.best, min(self.rounds, key=lambda each: each.estimate)
        same = result is not None and abs(result - best.result) <= best.estimate * abs(best.result)
        return {
            "tolerance": self.asked.mesh.tolerance,
            "error_estimate": best.estimate if same else None,
            "best": {"result": least.result, "error_estimate": least.estimate} if same else None,
            "rounds": [asdict(r) for r in self.rounds],
        }

    def to_json(self) -> bytes:
        """All except the case, in full precision, so that a resumed run has the same mesh on any number of ranks."""
        size = self.choice.size
        sizes = size and {"points": size.points.tolist(), "sizes": size.sizes.tolist()}
        rounds = [asdict(r) for r in self.rounds]
        return json.dumps({"best": self.rounds.index(self.best), "rounds": rounds, "size": sizes}).encode()

    @classmethod
    def from_json(cls, asked: Case, content: bytes) -> "Adapted":
        """Read the content of `to_json` for the same case."""
        known = json.loads(content)
        rounds = [Round(**r) for r in known["rounds"]]
        best, size = rounds[known["best"]], known["size"]
        sampled = Sampled(*(np.array(size[key]) for key in ("points", "sizes"))) if size else None
        return cls(asked, Choice(best.degree, best.refinement, sampled, best.layers), best, rounds)
