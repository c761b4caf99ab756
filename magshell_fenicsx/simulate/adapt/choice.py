"""The mesh that a tolerance chooses: its degree, refinement, sizes and layers, and what was
estimated on the way.
"""

import json
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import scipy
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.continuation_run import LOAD_TOLERANCE
from magshell_fenicsx.mesh.grading import Size
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
NEIGHBOURS = 3
LARGEST_CHANGE = 2.5  # largest factor in one round, of a cell relative to the mean and of the mean
STEPS = 8  # sizes per factor of two; coarse steps make the mesh independent of rounding


@dataclass(frozen=True)
class Sampled:
    """The geometric mean of the sizes at the nearest points, weighted by their inverse distances.

    Attributes
    ----------
    points, sizes
        (n, 2) of the chart and (n,).
    precision
        With which gmsh integrates them along edges: they have steps, and its 1e-9 would take 300
        000 calls.
    """

    points: Array
    sizes: Array
    precision: ClassVar[float] = 1e-6

    def __call__(self, x: Array) -> float:
        distance, neighbours = self._tree.query(x, NEIGHBOURS)
        weight = 1 / (distance + 1e-12)
        return float(np.exp(weight @ np.log(self.sizes[neighbours]) / weight.sum()))

    @cached_property
    def _tree(self) -> "scipy.spatial.cKDTree":
        return scipy.spatial.cKDTree(self.points)


def equidistributed(
    old: Size, centres: Array, shares: Array, order: float, reduction: float, least_ratio: float
) -> tuple[Sampled, float]:
    """Sizes for which all cells have equal shares in the error, and the error falls by a factor.

    Parameters
    ----------
    old
        Size function of the mesh whose cells have `centres` (n, 2) and `shares` (n,) of the error.
    order
        Power of the size in the error; the share of one cell falls with the power `order` + 2.
    reduction
        Wanted error over the error on the old mesh.
    least_ratio
        Smallest size: the thickness, below which only the singularity of a point force remains.

    Returns
    -------
    Sizes, and the factor of the number of cells.
    """
    wish = (np.exp(np.log(shares).mean()) / shares) ** (1 / (order + 2))
    change = _smoothed(centres, np.clip(wish, 1 / LARGEST_CHANGE, LARGEST_CHANGE))
    expected_ratio = shares @ change**order / shares.sum()  # a cell becomes change^-2 cells
    change *= np.clip(
        (reduction / expected_ratio) ** (1 / order), 1 / LARGEST_CHANGE, LARGEST_CHANGE
    )
    change = 2 ** (np.round(STEPS * np.log2(change)) / STEPS)
    return Sampled(centres, np.maximum([old(x) for x in centres] * change, least_ratio)), float(
        np.mean(change**-2)
    )


def _smoothed(centres: Array, wish: Array) -> Array:
    """Geometric mean of a cell and its neighbours."""
    neighbours = scipy.spatial.cKDTree(centres).query(centres, NEIGHBOURS + 2)[1]
    return np.asarray(np.exp(np.log(wish)[neighbours].mean(axis=1)))


@dataclass(frozen=True)
class Choice:
    """A degree and a mesh; without `size` the elements have the default sizes over `refinement`.

    With `size`, `refinement` only records the mean refinement relative to the default. `layers` are
    those of a solid.
    """

    degree: int
    refinement: float
    size: Sampled | None = None
    layers: int | None = None

    def applied(self, requested: Problem) -> Problem:
        """The problem on this mesh."""
        mesh = {"mesh.degree": self.degree, "mesh.refinement": self.refinement}
        problem = requested.with_values(
            mesh | ({"solid.layers": self.layers} if self.layers else {})
        )
        return replace(problem, size=self.size) if self.size else problem

    def scene(self, requested: Problem, comm: MPI.Comm) -> Scene:
        return Scene(self.applied(requested), comm)


@dataclass(frozen=True)
class AdaptiveRound:
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
        The problem with the tolerance.
    choice, best
        The chosen mesh and its round: the fewest unknowns within the tolerance, or else the least
        error.
    rounds
        All rounds in order.
    branch
        The same of the larger model in which the run goes on; None if it does not, or no mesh is
        found for it.
    """

    asked: Problem
    choice: Choice
    best: AdaptiveRound
    rounds: list[AdaptiveRound]
    branch: "Adapted | None" = None

    def account(self, result: float | None, on_branch: float | None = None) -> dict[str, Any]:
        """The entry of summary.json; without an estimate if the run ended at another result than
        the rounds.

        The chosen mesh may be a cheaper one than that of the best estimate, which is there too.

        Parameters
        ----------
        result
            Result of the run (`Ending.value`), or None.
        on_branch
            The estimated relative error at the end of the branch, or None.
        """
        best, best_round = self.best, min(self.rounds, key=lambda each: each.estimate)
        result_tolerance = max(best.estimate, LOAD_TOLERANCE) * abs(best.result)
        is_same = result is not None and abs(result - best.result) <= result_tolerance
        return {
            "tolerance": self.asked.mesh.tolerance,
            "error_estimate": best.estimate if is_same else None,
            "best": {"result": best_round.result, "error_estimate": best_round.estimate}
            if is_same
            else None,
            "rounds": [asdict(r) for r in self.rounds],
            **({"branch": self.branch.of_branch(on_branch)} if self.branch else {}),
        }

    def of_branch(self, estimate: float | None) -> dict[str, Any]:
        """The part of the entry that is of the larger model."""
        return {"error_estimate": estimate, "rounds": [asdict(r) for r in self.rounds]}

    def to_json(self) -> bytes:
        """All except the problem, in full precision, so that a resumed run has the same mesh on any
        number of ranks.
        """
        return json.dumps(self._as_data()).encode()

    def _as_data(self) -> dict[str, Any]:
        size = self.choice.size
        sizes = size and {"points": size.points.tolist(), "sizes": size.sizes.tolist()}
        content = {
            "best": self.rounds.index(self.best),
            "rounds": [asdict(r) for r in self.rounds],
            "size": sizes,
        }
        return content | ({"branch": self.branch._as_data()} if self.branch else {})

    @classmethod
    def from_json(cls, requested: Problem, content: bytes) -> "Adapted":
        """Read the content of `to_json` for the same problem."""
        return cls._from_data(requested, json.loads(content))

    @classmethod
    def _from_data(cls, requested: Problem, values: dict[str, Any]) -> "Adapted":
        rounds = [AdaptiveRound(**r) for r in values["rounds"]]
        best, size = rounds[values["best"]], values["size"]
        sampled = Sampled(*(np.array(size[key]) for key in ("points", "sizes"))) if size else None
        branch = cls._from_data(requested, values["branch"]) if values.get("branch") else None
        return cls(
            requested,
            Choice(best.degree, best.refinement, sampled, best.layers),
            best,
            rounds,
            branch,
        )
