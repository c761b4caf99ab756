"""Forms at v = 0: the matrix is that of the form from UFL's own algebra, which is done once."""

from pathlib import Path

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from mpi4py import MPI

from magshell_fenicsx.assembly.forms import at_zero
from magshell_fenicsx.assembly.kernels import JIT_OPTIONS
from magshell_fenicsx.platform import kept


def test_is_the_form_of_the_algebra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A coefficient and a constant before those that are left vanish with v."""
    domain = mesh.create_interval(MPI.COMM_SELF, 3, (0.0, 1.0))
    V = fem.functionspace(domain, ("Lagrange", 2))
    gone, left, v = (fem.Function(V) for _ in range(3))
    lost, found = fem.Constant(domain, 2.0), fem.Constant(domain, 3.0)
    left.interpolate(lambda x: 1 + x[0])
    energy = (lost * gone * v**3 + found * left * v**2 * (1 + v)) * ufl.dx
    gradient = ufl.derivative(energy, v, ufl.TestFunction(V))
    hessian = ufl.derivative(gradient, v, ufl.TrialFunction(V))

    def compiled(form: ufl.Form) -> fem.Form:
        return fem.form(form, jit_options=JIT_OPTIONS)

    def matrix() -> np.ndarray:
        return fem.assemble_matrix(at_zero(hessian, v, compiled)).to_dense()

    def interrupted(form: ufl.Form) -> fem.Form:
        raise KeyboardInterrupt

    expected = fem.assemble_matrix(compiled(ufl.replace(hessian, {v: ufl.zero()}))).to_dense()
    monkeypatch.setattr(kept, "kernel_cache", lambda: tmp_path)
    with pytest.raises(KeyboardInterrupt):
        at_zero(hessian, v, interrupted)
    assert list(tmp_path.iterdir()) == []
    assert (matrix() == expected).all()
    monkeypatch.setattr(ufl, "replace", None)  # from here on the file must do
    assert (matrix() == expected).all()
    found.value = 6.0
    assert (matrix() == 2 * expected).all()
    left.x.array[:] *= 2
    assert (matrix() == 4 * expected).all()
