"""SciPy's optimisers on a design: L-BFGS-B without constraints, SLSQP with them."""

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.studies.design.evaluate import Evaluation
from magshell_fenicsx.studies.design.problem import Problem
from magshell_fenicsx.studies.design.variables import Variables

Array = NDArray[np.float64]
WORSE = 1.0  # a lost path counts as this much worse than the worst found


def searched(
    evaluated: Callable[[Array], Evaluation], problem: Problem, vary: Variables, first: Array, iterations: int
) -> str:
    """Look for the best variables from the first on; why the optimiser ended."""
    if problem.lowest:
        return _raised(evaluated, problem, vary, first, iterations)
    known: list[tuple[Array, float]] = []

    def objective(x: Array) -> tuple[float, Array]:
        found = evaluated(x)
        if not found.values:
            away = x - min(known, key=lambda each: each[1])[0]
            uphill = np.asarray(away / max(float(np.linalg.norm(away)), 1e-300))
            return max(value for _, value in known) + WORSE, uphill
        value = problem.objective(found)
        known.append((np.array(x), value))
        return value, problem.slope(found)

    options: dict[str, Any] = {"maxiter": iterations, "ftol": 1e-15, "gtol": 1e-9}
    method, constraints = "L-BFGS-B", dict[str, Any]()
    if problem.section.constraints:
        method, options = "SLSQP", {"maxiter": iterations, "ftol": 1e-9}
        constraints = _kept(evaluated, problem.constraints, problem.constraint_slopes)
    found = scipy.optimize.minimize(
        objective,
        first,
        jac=True,
        method=method,
        bounds=vary.limits,
        constraints=constraints or (),
        options=options,
    )
    return str(found.message)


def _raised(
    evaluated: Callable[[Array], Evaluation], problem: Problem, vary: Variables, first: Array, iterations: int
) -> str:
    """Raise the lowest of several instabilities: the largest t with all of them above t, for (x, t).

    Where two of them cross, their minimum has a corner, and this problem has none.
    """

    def above(found: Evaluation, t: float) -> Array:
        return np.concatenate([problem.lowest_values(found) - t, problem.constraints(found)])

    def slopes(found: Evaluation) -> Array:
        lowest, others = problem.lowest_slopes(found), problem.constraint_slopes(found)
        with_t = [np.column_stack([lowest, -np.ones(len(lowest))])]
        return np.vstack([*with_t, *([np.column_stack([others, np.zeros(len(others))])] if len(others) else [])])

    last: list[Evaluation] = []

    def at(z: Array) -> tuple[Array, Array]:
        found = evaluated(z[:-1])
        if found.values:
            last[:] = [found]
        values = above(last[0], z[-1])
        return (values if found.values else values * 0 - WORSE), slopes(last[0])

    start = np.append(first, problem.lowest_values(evaluated(first)).min())
    down = np.append(0 * first, -1.0)
    found = scipy.optimize.minimize(
        lambda z: (-z[-1], down),
        start,
        jac=True,
        method="SLSQP",
        bounds=[*vary.limits, (None, None)],
        constraints={"type": "ineq", "fun": lambda z: at(z)[0], "jac": lambda z: at(z)[1]},
        options={"maxiter": iterations, "ftol": 1e-7},
    )
    return str(found.message)


def _kept(
    evaluated: Callable[[Array], Evaluation],
    values: Callable[[Evaluation], Array],
    slopes: Callable[[Evaluation], Array],
) -> dict[str, Any]:
    """Constraints for SciPy; a lost path has those of the last one that is known."""
    last: list[Evaluation] = []

    def at(x: Array) -> Evaluation:
        found = evaluated(x)
        if found.values:
            last[:] = [found]
        return last[0]

    return {"type": "ineq", "fun": lambda x: values(at(x)), "jac": lambda x: slopes(at(x))}
