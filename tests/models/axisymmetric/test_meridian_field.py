"""An applied field by formulas on the meridian, against the built-in one."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.sparse
from meridian_scenes import E3, hemisphere
from petsc4py import PETSc

from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.expressions import FormulasInSpace, formula_with_derivatives
from magshell_fenicsx.models.shell.spatial_fields import tangential
from magshell_fenicsx.parts.loads import Loads
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation, RemanenceLaw


def dense(K: PETSc.Mat) -> np.ndarray:
    rows, columns, values = K.getValuesCSR()
    return np.asarray(scipy.sparse.csr_array((values, columns, rows), shape=K.size).toarray())


@pytest.mark.parametrize("law", ["deformation", "rotation"])
def test_on_the_meridian_and_its_waves(law: RemanenceLaw) -> None:
    """A field diag(a, a, b) . r as formulas and built in."""
    formulas = [formula_with_derivatives(text) for text in ("x/2", "y/2", "1 - z")]
    gradient = np.diag([0.5, 0.5, -1.0])
    built_in = Magnetisation(tangential, E3, gradient=gradient, law=law)
    known = replace(built_in, gradient=None, in_space=FormulasInSpace(formulas, np.eye(3)))
    models = [
        hemisphere(20, 0.3, Loads(magnetic=field), refinement=0.15) for field in (known, built_in)
    ]
    u = models[0].system.zero_at_supports(
        1e-2 * np.random.default_rng(0).standard_normal(models[0].system.size)
    )
    found = []
    for model in models:
        waves = model.waves
        K = [dense(waves.tangent(State(u, mu), 3)) for mu in ({"lambda_m": 0.0}, {"lambda_m": 1.0})]
        loads, energy = (
            model.system.load(u, {}, "lambda_m"),
            model.system.potential(u, {}, "lambda_m"),
        )
        found.append(
            [
                np.array([energy]),
                loads,
                K[1] - K[0],
                dense(model.system.tangent(u, {"lambda_m": 1.0})),
            ]
        )
    for here, there in zip(*found, strict=True):
        assert np.abs(here - there).max() <= 1e-10 * np.abs(there).max()
