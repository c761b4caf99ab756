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


def searched(evaluated: Callable[[Array], Evaluation], problem: Problem, vary: Variables, iterations: int) -> str:
    """Look for the best variables from those of the case on; why the optimiser ended."""
    known: list[tuple[Array, float]] = []

    def objective(x: Array) -> tuple[float, Array]:
        found = evaluated(x)
        if not found.values:
            away = x - min(known, key=lambda each: each[1])[0]
            return max(value for _, value in known) + WORSE, away / max(float(np.linalg.norm(away)), 1e-300)
        value = problem.objective(found)
        known.append((np.array(x), value))
        return value, problem.slope(found)

    def constrained(of: Callable[[Evaluation], Array]) -> Callable[[Array], Array]:
        last: list[Array] = []

        def at(x: Array) -> Array:
            found = evaluated(x)
            if found.values:
                last[:] = [of(found)]
            return last[0]

        return at

    options: dict[str, Any] = {"maxiter": iterations, "ftol": 1e-15}
    constraints: Any = ()
    if problem.section.constraints:
        method, options["ftol"] = "SLSQP", 1e-9
        constraints = {
            "type": "ineq",
            "fun": constrained(problem.constraints),
            "jac": constrained(problem.constraint_slopes),
        }
    else:
        method, options["gtol"] = "L-BFGS-B", 1e-9
    found = scipy.optimize.minimize(
        objective, vary.first, jac=True, method=method, bounds=vary.limits, constraints=constraints, options=options
    )
    return str(found.message)
