"""Kernels for many points in one call against NumPy, with vectors of four numbers and without."""

from collections.abc import Callable

import numpy as np
import pytest
import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.core.expr import Expr

from magshell_fenicsx.assembly import point_kernels
from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.point_kernels import Points
from magshell_fenicsx.platform.many import with_many

Array = np.ndarray
CASES: dict[str, tuple[Callable[..., Expr], Callable[..., Array]]] = {
    "roots and powers": (
        lambda a, b, c: ufl.as_vector([ufl.sqrt(1 + a[0] ** 2) * b**1.5 / c, c**-2 * a[1], 2 * c]),
        lambda a, b, c: np.stack([np.sqrt(1 + a[0] ** 2) * b**1.5 / c, a[1] / c**2, 2 * c + 0 * b], axis=1),
    ),
    "an angle": (
        lambda a, b, c: ufl.as_vector([c * ufl.atan2(a[0], b), a[1]]),
        lambda a, b, c: np.stack([c * np.arctan2(a[0], b), a[1]], axis=1),
    ),
    "a condition": (
        lambda a, b, c: ufl.as_vector([ufl.conditional(ufl.gt(a[0], c), b, -b)]),
        lambda a, b, c: np.where(a[0] > c, b, -b)[:, None],
    ),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize(("count", "one_call"), [(1, True), (4, True), (11, True), (11, False)])
def test_against_numpy(name: str, count: int, one_call: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where the number of points is no multiple of four, after a constant has changed, and by dolfinx alone."""
    if not one_call:
        monkeypatch.setattr(point_kernels, "many_of", lambda compiled: None)
    expression, expected = CASES[name]
    points, random = Points(11), np.random.default_rng(1)
    a, b, constant = points.field(2), points.field(1), fem.Constant(points._mesh, 0.4)
    a.x.array[:], b.x.array[:] = random.random(22), 1 + random.random(11)
    here = points.constant(constant)
    kernel = KernelLog().compile_expression(name, expression(a, b[0], here), MPI.COMM_SELF)
    for value in (0.4, 0.7):
        constant.value = value
        found = points.evaluate(kernel, count)
        wanted = expected(a.x.array.reshape(-1, 2).T, b.x.array, value)[:count]
        assert found == pytest.approx(wanted, rel=1e-14)
    assert (points._calls[kernel] is not None) == one_call
    assert points.evaluate(kernel, 0).size == 0


@pytest.mark.parametrize(
    ("line", "lanes"),
    [
        ("double sp_1 = sqrt(sp_0) / w[3] + -c[2];", True),
        ("double sp_1 = pow(w[3], -1.5);", True),
        ("double sp_1 = pow(w[3], sp_0);", False),
        ("double sp_1 = atan2(sp_0, w[3]);", False),
        ("double sp_1 = sp_0 < 1 ? w[3] : 0.0;", False),
        ("A[3 * iq + 1] += sp_1;", True),
        ("static const double table[2] = {1.0, 2.0};", False),
    ],
)
def test_what_can_be_vectors(line: str, lanes: bool) -> None:
    """In C a vector can take the place of a number in arithmetic, square roots and powers by a constant."""
    body = f"{{\n// Unstructured piecewise computations\ndouble sp_0 = w[1] * w[2];\n{line}\n}}"
    code = "#include <math.h>\nvoid tabulate_tensor_e(double* A, const double* w, const double* c)\n" + body
    code += "\n\nstatic double points_e[1] = {0.5};\nstatic int value_shape_e[1] = {2};\n"
    assert ("#define HAS_LANES" in with_many(code)) == lanes
