"""What the steps of Newton's method say of an iterate."""

import numpy as np
import pytest

from magshell_fenicsx.continuation.iterates import Iterates, Step, Verdict

FULL, CHORD = True, False


@pytest.mark.parametrize(
    ("steps", "rounding", "verdict"),
    [
        ([(1e-10, FULL)], 0.0, "converged"),  # the next step is the error, whatever came before
        ([(1.0, FULL), (1e-2, CHORD), (5e-10, CHORD)], 0.0, "converged"),
        ([(1e-5, FULL), (9e-6, FULL)], 1e-12, "go on"),  # a stall far above rounding is no solution
        ([(1e-5, FULL), (9e-6, FULL)], 2e-6, "rounding"),  # one at its level is, but not to the tolerance
        ([(1e-5, CHORD), (9e-6, FULL)], 2e-6, "go on"),  # a new matrix has yet to show what it can do
        ([(1e-7, FULL), (1e-9, CHORD), (2e-8, FULL)], 0.0, "go on"),  # the old matrix had hidden the error
        ([(1e-3, FULL), (1e-4, FULL), (1e-4, CHORD), (1e-2, FULL)], 0.0, "diverged"),
        ([(1.0, FULL), (0.9, FULL), (0.8, FULL), (0.7, FULL), (0.6, FULL)], 0.0, "diverged"),
        ([(2e4, FULL)], 0.0, "diverged"),
        ([(np.nan, FULL)], 0.0, "diverged"),
        ([(1.0, FULL), *[(0.5, CHORD)] * 5], 0.0, "too many"),
    ],
)
def test_verdicts(steps: list[tuple[float, bool]], rounding: float, verdict: Verdict) -> None:
    iterates = Iterates(largest=1e4, most=5, steps=[Step(size, own) for size, own in steps])
    assert iterates.judge(1e-9, lambda: rounding) == verdict
