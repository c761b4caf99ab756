"""The mesh that a tolerance chooses: its degree, refinement, sizes and layers, and what was
estimated on the way.

A round is one mesh that was tried, with its result and the estimated error. The share of a cell is
its part of the error. A size is the length of an element's edges, a function of the place in the
chart (coordinates of the undeformed surface). A branch leads from the first model to a larger one,
with a mesh of its own.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np
import scipy
from mpi4py import MPI
from numpy.typing import NDArray

from magshell_fenicsx.continuation.continuation_run import LOAD_TOLERANCE
from magshell_fenicsx.mesh.grading import Size
from magshell_fenicsx.mesh.grid import Grid
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
NEIGHBOURS = 3
LARGEST_CHANGE = 2.5  # largest factor in one round, of a cell relative to the mean and of the mean
GRID_FACTOR = 1.25  # least factor by which lines of a grid come nearer where they come nearest
STEPS = 8  # sizes per factor of two; coarse steps make the mesh independent of rounding


@dataclass(frozen=True)
class Sampled:
    """Sizes of elements as a function of the place in the chart, from sizes at points.

    It is the geometric mean of the sizes at the nearest points, weighted by inverse distances.

    Attributes
    ----------
    points, sizes
        (n, 2) of the chart and (n,).
    precision
        Precision with which gmsh integrates sizes along edges: they have steps, and its 1e-9 would
        take 300 000 calls.
    """

    points: Array
    sizes: Array
    precision: ClassVar[float] = 1e-6

    def __call__(self, x: Array) -> float:
        """Return the size at a place (2,) of the chart."""
        distance, neighbours = self._tree.query(x, NEIGHBOURS)
        weight = 1 / (distance + 1e-12)  # also at a point itself
        return float(np.exp(weight @ np.log(self.sizes[neighbours]) / weight.sum()))

    @cached_property
    def _tree(self) -> "scipy.spatial.cKDTree":
        """Search tree of the points."""
        return scipy.spatial.cKDTree(self.points)


@dataclass(frozen=True)
class LineSpacing:
    """Distances of a grid's lines across each axis, as a function of the coordinate.

    Attributes
    ----------
    coordinates, distances
        For each axis coordinates (n,) in increasing order, and distances (n,) there.
    """

    coordinates: tuple[Array, ...]
    distances: tuple[Array, ...]

    def __call__(self, axis: int, x: float) -> float:
        """Return the distance of the lines across an axis at a coordinate."""
        return float(np.interp(x, self.coordinates[axis], self.distances[axis]))


def equidistributed_lines(
    lines: Sequence[Array],
    centres: Array,
    shares: Array,
    order: float,
    reduction: float,
    least_distance: float,
) -> tuple[LineSpacing, float]:
    """Return distances of lines for which the intervals between them have equal shares.

    Parameters
    ----------
    lines
        Coordinates of the lines of the old grid across each axis.
    centres, shares
        (n, 2) of its cells, and (n,) their shares of the error.
    order
        Power of the size in the error.
    reduction
        Wanted error over the error on the old grid.
    least_distance
        Least distance, as `least_ratio` of `equidistributed`.

    Returns
    -------
    spacing, factor
        The distances, and the factor of the number of cells.
    """
    # for each axis the factors of the distances that give each interval the mean of the shares
    changes, expected_ratio = list[Array](), 0.0
    for axis in range(2):
        count = len(lines[axis]) - 1
        interval = np.clip(np.searchsorted(lines[axis], centres[:, axis]) - 1, 0, count - 1)
        sums = np.bincount(interval, shares, count)
        # a half has no cells beyond its plane of symmetry
        sums[sums == 0] = np.exp(np.log(sums[sums > 0]).mean())
        geometric_mean = np.exp(np.log(sums).mean())
        wished_change = (geometric_mean / sums) ** (1 / (order + 1))
        change = np.clip(wished_change, 1 / LARGEST_CHANGE, LARGEST_CHANGE)
        expected_ratio += float(sums @ change**order / sums.sum()) / 2
        changes.append(change)
    # a common factor gives the wanted reduction; some lines come nearer by `GRID_FACTOR` at least
    common = (reduction / expected_ratio) ** (1 / order)
    common = float(np.clip(common, 1 / LARGEST_CHANGE, LARGEST_CHANGE))
    if reduction < 1:
        common = min(common, 1 / (GRID_FACTOR * min(change.min() for change in changes)))
    changes = [2 ** (np.round(STEPS * np.log2(change * common)) / STEPS) for change in changes]
    middles = tuple((each[1:] + each[:-1]) / 2 for each in lines)
    distances = tuple(
        np.maximum(np.diff(each) * change, least_distance)
        for each, change in zip(lines, changes, strict=True)
    )
    factor_of_cells = float(np.prod([np.mean(1 / change) for change in changes]))
    return LineSpacing(middles, distances), factor_of_cells


def equidistributed(
    old: Size, centres: Array, shares: Array, order: float, reduction: float, least_ratio: float
) -> tuple[Sampled, float]:
    """Return sizes for which cells have equal shares in the error, which falls by a factor.

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
    sizes, factor
        The size function, and the factor of the number of cells.
    """
    # the factor of the size that gives each cell the geometric mean of the shares
    geometric_mean = np.exp(np.log(shares).mean())
    wished_change = (geometric_mean / shares) ** (1 / (order + 2))
    change = _smoothed(centres, np.clip(wished_change, 1 / LARGEST_CHANGE, LARGEST_CHANGE))
    expected_ratio = shares @ change**order / shares.sum()  # a cell becomes change^-2 cells
    # a common factor gives the wanted reduction
    change *= np.clip(
        (reduction / expected_ratio) ** (1 / order), 1 / LARGEST_CHANGE, LARGEST_CHANGE
    )
    change = 2 ** (np.round(STEPS * np.log2(change)) / STEPS)
    sizes = np.maximum([old(x) for x in centres] * change, least_ratio)
    factor_of_cells = float(np.mean(change**-2))
    return Sampled(centres, sizes), factor_of_cells


def _smoothed(centres: Array, wish: Array) -> Array:
    """Return the geometric means (n,) of values `wish` (n,) over each cell and its neighbours.

    `centres` (n, 2) are those of the cells.
    """
    # the nearest cell is the cell itself
    _, neighbours = scipy.spatial.cKDTree(centres).query(centres, NEIGHBOURS + 2)
    return np.asarray(np.exp(np.log(wish)[neighbours].mean(axis=1)))


# fields of both kinds of sizes, as they are kept for a run that is resumed
_KEYS_OF_SIZES = {Sampled: ("points", "sizes"), LineSpacing: ("coordinates", "distances")}


@dataclass(frozen=True)
class Choice:
    """A degree and a mesh; without `size` the elements have the default sizes over `refinement`.

    Attributes
    ----------
    size
        Size function of the mesh, or spacing of a grid's lines; with it `refinement` only records
        the mean refinement relative to the default.
    layers
        Number of layers of a solid; None of a shell.
    """

    degree: int
    refinement: float
    size: Sampled | LineSpacing | None = None
    layers: int | None = None

    def applied(self, requested: Problem) -> Problem:
        """Return the problem with this degree and mesh."""
        mesh = {"mesh.degree": self.degree, "mesh.refinement": self.refinement}
        problem = requested.with_values(
            mesh | ({"solid.layers": self.layers} if self.layers else {})
        )
        if isinstance(self.size, LineSpacing):
            assert isinstance(problem.shape, Grid)
            return replace(problem, shape=replace(problem.shape, size=self.size))
        return replace(problem, size=self.size) if self.size else problem

    def scene(self, requested: Problem, comm: MPI.Comm) -> Scene:
        """Return the scene of the problem with this degree and mesh; collective."""
        return Scene(self.applied(requested), comm)


@dataclass(frozen=True)
class AdaptiveRound:
    """A mesh that was tried, with its result.

    Attributes
    ----------
    cells, dofs
        Numbers of cells and unknowns.
    result
        Result of the run on this mesh (`Ending.value`).
    estimate
        Estimated relative error of the result.
    layers
        Number of layers of a solid; None of a shell.
    """

    degree: int
    refinement: float
    cells: int
    dofs: int
    result: float
    estimate: float
    layers: int | None = None


@dataclass(frozen=True)
class Adapted:
    """The mesh that was found for a tolerance, with all rounds.

    Attributes
    ----------
    requested
        The problem with the tolerance.
    choice, best
        The chosen mesh and its round: the fewest unknowns within the tolerance, or else the least
        error.
    rounds
        All rounds in order.
    branch
        The mesh that was found for the larger model in which the run goes on; None if the run does
        not, or no mesh is found.
    """

    requested: Problem
    choice: Choice
    best: AdaptiveRound
    rounds: list[AdaptiveRound]
    branch: "Adapted | None" = None

    def account(self, result: float | None, on_branch: float | None = None) -> dict[str, Any]:
        """Return the entry of summary.json on the tolerance.

        It has no estimate if the run ended at another result than the rounds, as the estimate is
        not about this result. The chosen mesh may be a cheaper one than that of the least error,
        whose result is in the entry "best".

        Parameters
        ----------
        result
            Result of the run (`Ending.value`), or None.
        on_branch
            The estimated relative error at the end of the branch, or None.
        """
        # the round of the chosen mesh, and that of the least error
        chosen, most_exact = self.best, min(self.rounds, key=lambda each: each.estimate)
        result_tolerance = max(chosen.estimate, LOAD_TOLERANCE) * abs(chosen.result)
        is_same = result is not None and abs(result - chosen.result) <= result_tolerance
        return {
            "tolerance": self.requested.mesh.tolerance,
            "error_estimate": chosen.estimate if is_same else None,
            "best": {"result": most_exact.result, "error_estimate": most_exact.estimate}
            if is_same
            else None,
            "rounds": [asdict(each_round) for each_round in self.rounds],
            **({"branch": self.branch.of_branch(on_branch)} if self.branch else {}),
        }

    def of_branch(self, estimate: float | None) -> dict[str, Any]:
        """Return the entry on the mesh of the larger model, with the estimated error at its end."""
        return {
            "error_estimate": estimate,
            "rounds": [asdict(each_round) for each_round in self.rounds],
        }

    def to_json(self) -> bytes:
        """Return all except the problem as JSON, in full precision.

        So a resumed run has the same mesh on any number of ranks.
        """
        return json.dumps(self._as_data()).encode()

    def _as_data(self) -> dict[str, Any]:
        """Return all except the problem as plain data for JSON; the best round by its index."""
        size, sizes = self.choice.size, None
        if size:
            keys = _KEYS_OF_SIZES[type(size)]
            sizes = {key: [each.tolist() for each in getattr(size, key)] for key in keys}
        content = {
            "best": self.rounds.index(self.best),
            "rounds": [asdict(each_round) for each_round in self.rounds],
            "size": sizes,
        }
        return content | ({"branch": self.branch._as_data()} if self.branch else {})

    @classmethod
    def from_json(cls, requested: Problem, content: bytes) -> "Adapted":
        """Return the mesh from the content of `to_json`, for the same problem."""
        return cls._from_data(requested, json.loads(content))

    @classmethod
    def _from_data(cls, requested: Problem, values: dict[str, Any]) -> "Adapted":
        """Return the mesh from the data of `_as_data`, for the same problem."""
        rounds = [AdaptiveRound(**round_data) for round_data in values["rounds"]]
        best, size = rounds[values["best"]], values["size"]
        sampled: Sampled | LineSpacing | None = None
        if size and "points" in size:
            sampled = Sampled(*(np.array(size[key]) for key in _KEYS_OF_SIZES[Sampled]))
        elif size:
            by_axis = (size[key] for key in _KEYS_OF_SIZES[LineSpacing])
            sampled = LineSpacing(*(tuple(map(np.array, each)) for each in by_axis))
        branch = cls._from_data(requested, values["branch"]) if values.get("branch") else None
        return cls(
            requested,
            Choice(best.degree, best.refinement, sampled, best.layers),
            best,
            rounds,
            branch,
        )
