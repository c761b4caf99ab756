"""What the steps of Newton's method say of an iterate, and what PETSc's options do."""

from collections.abc import Iterator

import numpy as np
import pytest
from continuation.toys import Toy, pitchfork
from petsc4py import PETSc

from magshell_fenicsx.continuation.control import PrescribedConjugate, PrescribedLoad
from magshell_fenicsx.continuation.iterates import Iterates, NewtonStep, Verdict
from magshell_fenicsx.continuation.newton import BorderedNewton, NewtonResult
from magshell_fenicsx.continuation.system import State

FULL, CHORD = True, False


@pytest.mark.parametrize(
    ("steps", "rounding", "verdict"),
    [
        ([(1e-10, FULL)], 0.0, "converged"),  # the next step is the error, whatever came before
        ([(1.0, FULL), (1e-2, CHORD), (5e-10, CHORD)], 0.0, "converged"),
        ([(1e-5, FULL), (9e-6, FULL)], 1e-12, "go on"),  # a stall far above rounding is no solution
        # one at its level is, but not to the tolerance
        (
            [(1e-5, FULL), (9e-6, FULL)],
            2e-6,
            "rounding",
        ),
        # a new matrix has yet to show what it can do
        (
            [(1e-5, CHORD), (9e-6, FULL)],
            2e-6,
            "go on",
        ),
        # the old matrix had hidden the error
        (
            [(1e-7, FULL), (1e-9, CHORD), (2e-8, FULL)],
            0.0,
            "go on",
        ),
        ([(1e-3, FULL), (1e-4, FULL), (1e-4, CHORD), (1e-2, FULL)], 0.0, "diverged"),
        ([(1.0, FULL), (0.9, FULL), (0.8, FULL), (0.7, FULL), (0.6, FULL)], 0.0, "diverged"),
        ([(2e4, FULL)], 0.0, "diverged"),
        ([(np.nan, FULL)], 0.0, "diverged"),
    ],
)
def test_verdicts(steps: list[tuple[float, bool]], rounding: float, verdict: Verdict) -> None:
    iterates = Iterates(largest=1e4, steps=[NewtonStep(size, own) for size, own in steps])
    assert iterates.judge(1e-9, lambda: rounding) == verdict


@pytest.fixture
def options() -> Iterator[PETSc.Options]:
    """PETSc's options, which a test may set; none is left."""
    before = PETSc.Options().getAll()
    given = PETSc.Options()
    yield given
    for name in set(given.getAll()) - set(before):
        given.delValue(name)


def steep() -> Toy:
    """The force is the arc tangent of u: from afar Newton's full steps grow."""
    return Toy(np.arctan, lambda u: 1 / (1 + u**2), 1)


def from_afar(toy: Toy) -> NewtonResult:
    return BorderedNewton(toy).solve(
        State(np.full(1, 3.0), {"load": 0.0}), "load", PrescribedLoad("load", 0.0)
    )


@pytest.mark.parametrize("prefix", ["", "magshell_"])
def test_a_line_search_shortens_steps(options: PETSc.Options, prefix: str) -> None:
    assert not from_afar(steep()).converged
    options[f"{prefix}snes_linesearch_type"] = "bt"
    found = from_afar(steep())
    assert found.converged
    assert found.state.u[0] == pytest.approx(0.0, abs=1e-12)


def test_iterations_are_limited(options: PETSc.Options) -> None:
    options["snes_linesearch_type"], options["snes_max_it"] = "bt", 2
    found = from_afar(steep())
    assert (found.converged, found.iterations, found.reason) == (False, 2, "too many iterations")


def test_the_tolerance_is_an_option(options: PETSc.Options) -> None:
    options["snes_linesearch_type"], options["snes_stol"] = "bt", 1e-2
    loose = from_afar(steep())
    options["snes_stol"] = 1e-12
    assert 1e-8 < loose.error <= 1e-2
    assert from_afar(steep()).error <= 1e-12


def test_snes_reports(options: PETSc.Options, capfd: pytest.CaptureFixture[str]) -> None:
    options["snes_monitor"] = options["snes_converged_reason"] = ""
    options["snes_linesearch_type"] = "bt"
    found = from_afar(steep())
    lines = capfd.readouterr().out.splitlines()
    assert sum("SNES Function norm" in line for line in lines) == found.iterations + 1
    assert f"CONVERGED_SNORM_RELATIVE iterations {found.iterations}" in lines[-1]


def test_the_linear_solver_serves_others(options: PETSc.Options) -> None:
    """A Krylov method and an error-oriented line search solve for other right sides than the
    residual.
    """
    start, row = (
        State(np.array([0.1, 0.5]), {"load": 0.0}),
        PrescribedConjugate(toy := pitchfork(0.1), "load", 1.3),
    )
    plain = BorderedNewton(toy).solve(start, "load", row)
    options["ksp_type"], options["snes_linesearch_type"] = "gmres", "nleqerr"
    other = BorderedNewton(toy).solve(start, "load", row)
    assert plain.converged
    assert other.converged
    assert other.state.u == pytest.approx(plain.state.u, abs=1e-8)
    assert other.state.mu["load"] == pytest.approx(plain.state.mu["load"], abs=1e-8)
