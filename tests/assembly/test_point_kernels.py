"""Kernels for many points in one call against NumPy, and their derivatives against those of UFL by
dolfinx.
"""

import shutil
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import fem
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.point_kernels import (
    BlockPairs,
    PointStorage,
    point_gradient,
    point_hessian,
    point_values,
)
from magshell_fenicsx.assembly.scalar_graph import ScalarGraph, terminals_of

Array = np.ndarray
i, j, k = ufl.indices(3)
CASES: dict[str, tuple[Callable[..., Expr], Callable[..., Array]]] = {
    "roots and powers": (
        lambda a, b, c: ufl.as_vector(
            [ufl.sqrt(1 + a[0] ** 2) * b**1.5 / c, c**-2 * a[1], 2 * c, b ** a[0]]
        ),
        lambda a, b, c: np.stack(
            [np.sqrt(1 + a[0] ** 2) * b**1.5 / c, a[1] / c**2, 2 * c + 0 * b, b ** a[0]], axis=1
        ),
    ),
    "an angle": (
        lambda a, b, c: ufl.as_vector([c * ufl.atan2(a[0], b), a[1]]),
        lambda a, b, c: np.stack([c * np.arctan2(a[0], b), a[1]], axis=1),
    ),
    "conditions": (
        lambda a, b, c: ufl.as_vector(
            [
                ufl.conditional(ufl.gt(a[0], c), b, -b),
                ufl.conditional(ufl.And(ufl.lt(a[0], c), ufl.Not(ufl.ge(a[1], 0.5))), 1.0, c),
                ufl.max_value(a[0], a[1])
                - ufl.min_value(a[0], c)
                + abs(a[0] - c)
                + ufl.sign(a[1] - c),
            ]
        ),
        lambda a, b, c: np.stack(
            [
                np.where(a[0] > c, b, -b),
                np.where((a[0] < c) & (a[1] < 0.5), 1.0, c),
                np.maximum(a[0], a[1]) - np.minimum(a[0], c) + abs(a[0] - c) + np.sign(a[1] - c),
            ],
            axis=1,
        ),
    ),
    "indices": (  # a trace of a product, a diagonal, an outer product that is transposed
        lambda a, b, c: ufl.as_vector(
            [
                ufl.as_matrix([[a[0], b], [c, a[1]]])[i, j] * ufl.as_matrix([[1, 2], [3, b]])[j, i],
                ufl.as_tensor(ufl.outer(a, a)[k, i], (i, k))[0, 1] + ufl.tr(ufl.outer(a, a)),
                ufl.det(ufl.as_matrix([[a[0], b], [c, a[1]]])),
            ]
        ),
        lambda a, b, c: np.stack(
            [
                a[0] + 3 * b + 2 * c + a[1] * b,
                a[0] * a[1] + a[0] ** 2 + a[1] ** 2,
                a[0] * a[1] - b * c,
            ],
            axis=1,
        ),
    ),
}


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("count", [1, 4, 11])
def test_against_numpy(name: str, count: int) -> None:
    """Also where the number of points is no multiple of four, and after a constant has changed."""
    expression, expected = CASES[name]
    points, random = PointStorage(11), np.random.default_rng(1)
    a, b, constant = points.field(2), points.field(1), fem.Constant(points._mesh, 0.4)
    a.x.array[:], b.x.array[:] = random.random(22), 1 + random.random(11)
    here = points.constant(constant)
    kernel = point_values(name, expression(a, b[0], here), KernelLog())
    for value in (0.4, 0.7):
        constant.value = value
        found = points.evaluate(kernel, count)
        wanted = expected(a.x.array.reshape(-1, 2).T, b.x.array, value)[:count]
        assert found == pytest.approx(wanted, rel=1e-13)
    assert points.evaluate(kernel, 0).size == 0


ENERGIES: dict[str, Callable[[Any], Expr]] = {  # of a vector of six numbers in (0, 1)
    "powers": lambda z: (
        z[0] ** 3 * z[1] ** -2 + z[2] ** 1.5 / (1 + z[3]) + (1 + z[4]) ** z[5] + z[0] ** 0.3
    ),
    "roots": lambda z: ufl.sqrt(ufl.dot(z, z)) * ufl.ln(1 + z[0] * z[5]) + ufl.exp(z[1] * z[2]),
    "angles": lambda z: (
        ufl.atan2(z[0], z[1]) * ufl.sin(z[2]) + ufl.cos(z[3] * z[4]) * ufl.tan(z[5])
    ),
    "arcs": lambda z: (
        ufl.asin(z[0] / 2) * ufl.acos(z[1] / 2) + ufl.atan(z[2] * z[3]) + ufl.erf(z[4])
    ),
    "hyperbolas": lambda z: (
        ufl.sinh(z[0]) * ufl.cosh(z[1]) + ufl.tanh(z[2] * z[3]) * ufl.bessel_J(1, z[4])
    ),
    "choices": lambda z: (
        ufl.conditional(ufl.gt(z[0], z[1]), z[0] ** 2 * z[2], z[1] * z[3]) * abs(z[4] - z[5])
    ),
    "normals": lambda z: (
        ufl.cross(
            ufl.as_vector([z[i] for i in range(3)]), ufl.as_vector([z[i] for i in range(3, 6)])
        )[0]
        ** 2
        / ufl.dot(z, z)
    ),
}


@pytest.mark.parametrize("name", ENERGIES)
def test_derivatives_against_ufl(name: str) -> None:
    """Every rule of differentiation, for gradient and Hessian, by dolfinx's own evaluation of UFL's
    derivatives.
    """
    points, log = PointStorage(7), KernelLog()
    z = points.field(6)
    z.x.array[:] = np.random.default_rng(2).random(42)
    W, cells = ENERGIES[name](z), np.arange(7, dtype=np.int32)
    first = ufl.diff(W, z)
    second = ufl.as_vector([ufl.diff(first, z)[i, j] for i in range(6) for j in range(6)])

    if not shutil.which("cc"):
        pytest.skip("dolfinx compiles expressions by cc alone")

    def by_dolfinx(expression: Expr) -> Array:
        values, point = np.empty((7, expression.ufl_shape[0])), np.full((1, 1), 0.5)
        found = fem.Expression(expression, point).eval(points._mesh, cells)
        values[z.function_space.dofmap.list[:, 0]] = found.reshape(
            values.shape
        )  # from dolfinx 0.10 with an axis of points
        return values

    gradient = points.evaluate(point_gradient(name, [(W, z)], log), 7).copy()
    assert gradient == pytest.approx(by_dolfinx(first), rel=1e-12, abs=1e-12)
    blocks = points.evaluate(
        point_hessian(name, W, z, 2, BlockPairs(((0, 0), (0, 1), (1, 1))), log, at_zero=False), 7
    )
    wanted = by_dolfinx(second).reshape(7, 2, 3, 2, 3)
    whole = blocks[:, :18].reshape(
        7, 6, 3
    )  # components (0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2) of three pairs
    for number, (c, d) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
        for pair, (a, b) in enumerate([(0, 0), (0, 1), (1, 1)]):
            both = (wanted[:, a, c, b, d] + wanted[:, a, d, b, c]) / 2
            assert whole[:, number, pair] == pytest.approx(both, rel=1e-12, abs=1e-12)
    skew = blocks[:, 18:].reshape(7, 3)
    for number, (c, d) in enumerate([(0, 1), (0, 2), (1, 2)]):
        both = (wanted[:, 0, c, 1, d] - wanted[:, 0, d, 1, c]) / 2
        assert skew[:, number] == pytest.approx(both, rel=1e-12, abs=1e-12)


def test_what_is_not_picked_needs_no_derivative() -> None:
    """The root of a negative number has none."""
    points, log = PointStorage(4), KernelLog()
    z = points.field(3)
    z.x.array[:] = [-1, 0, 0, 4, 0, 0, 0, 0, 0, 9, 0, 0]
    W = ufl.conditional(ufl.gt(z[0], 0), ufl.sqrt(z[0]), 0.0) ** 2
    gradient = points.evaluate(point_gradient("root", [(W, z)], log), 4).copy()
    assert gradient[:, 0] == pytest.approx([0, 1, 0, 1])
    hessian = points.evaluate(
        point_hessian("root", W, z, 1, BlockPairs(((0, 0),)), log, at_zero=False), 4
    )
    assert hessian == pytest.approx(0, abs=1e-15)


def test_at_zero() -> None:
    """The Hessian of a form that is quadratic in z but for terms that vanish at z = 0."""
    points, log = PointStorage(3), KernelLog()
    z, a = points.field(3), points.field(1)
    z.x.array[:], a.x.array[:] = 0.3, [1, 2, 3]
    W = a[0] * z[0] ** 2 / 2 + z[1] * z[2] * ufl.exp(z[0])
    found = points.evaluate(
        point_hessian("zero", W, z, 1, BlockPairs(((0, 0),)), log, at_zero=True), 3
    )
    assert found == pytest.approx(
        np.array([[1, 0, 0, 0, 0, 1], [2, 0, 0, 0, 0, 1], [3, 0, 0, 0, 0, 1]])
    )


def test_each_operation_occurs_once() -> None:
    """Sums and products in either order, numbers and what is multiplied by them."""
    s = ScalarGraph()
    x, y = s.node("field", 0, 0), s.node("field", 0, 1)
    assert s.add(x, y) == s.add(y, x)
    assert s.times(s.number(2), s.times(y, s.number(3))) == s.times(s.number(6), y)
    assert s.add(x, x) == s.times(s.number(2), x)
    assert s.times(x, s.zero) == s.divide(s.zero, y) == s.zero
    assert s.power(x, s.number(0.5)) == s.node("sqrt", x)


def test_equal_expressions_are_translated_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of other fields and constants; another number, order of arguments or result is another
    kernel.
    """
    translated = list[Expr]()
    components, new = (
        ScalarGraph.components,
        np.random.default_rng().uniform(),
    )  # an earlier run may have left a kernel

    def counted(self: ScalarGraph, e: Expr, *others: Any) -> Any:
        translated.append(e)
        return components(self, e, *others)

    monkeypatch.setattr(ScalarGraph, "components", counted)

    def value(W: Callable[..., Expr], *given: float) -> float:
        points = PointStorage(1)
        a, b, c = points.field(2), points.field(2), fem.Constant(points._mesh, float(given[4]))
        a.x.array[:], b.x.array[:] = given[:2], given[2:4]
        kernel = point_values("once", W(a, b, ufl.variable(c)), KernelLog())
        return float(points.evaluate(kernel, 1)[0, 0])

    def first(a: Expr, b: Expr, c: Expr) -> Expr:
        return ufl.as_vector([c * a[0] * b[1] + new * a[1]])

    assert value(first, 2, 3, 4, 5, 7) == pytest.approx(7 * 2 * 5 + 3 * new)
    assert len(translated) == 1
    assert value(first, 1, 4, 6, 2, 3) == pytest.approx(3 * 1 * 2 + 4 * new)
    assert len(translated) == 1
    assert value(lambda a, b, c: first(b, a, c), 2, 3, 4, 5, 7) == pytest.approx(
        7 * 4 * 3 + 5 * new
    )
    assert (
        value(lambda a, b, c: first(a, b, c) + ufl.as_vector([1e-9]), 2, 3, 4, 5, 7) > 70 + 3 * new
    )
    assert value(
        lambda a, b, c: first(a, b, c) + ufl.as_vector([2e-9]), 2, 3, 4, 5, 7
    ) == pytest.approx(70 + 3 * new + 2e-9, rel=1e-13)
    assert len(translated) == 4


def test_what_no_point_has_is_refused() -> None:
    x = ufl.SpatialCoordinate(PointStorage(1)._mesh)
    with pytest.raises(NotImplementedError, match="SpatialCoordinate"):
        ScalarGraph().components(x[0], *terminals_of([x[0]], ufl.Coefficient, ufl.Constant))
