"""How thick a shell is that keeps its volume: over its undeformed thickness, as an expression and at points.

Bodies touch its faces, which come nearer to each other as the surface stretches; a natural shape is what has grown
without stress, and its volume stays.
"""

from collections.abc import Callable

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.following import Follows, at_quadrature
from magshell_fenicsx.models.carriers import Carrier
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import Forms, Jet
from magshell_fenicsx.parts.natural.shape import FIELD, Shape

Array = NDArray[np.float64]
Thinning = Callable[[Array], Follows[Array]]  # from places in the reference cell to values there, (cells * places,)


def thinned(r0: Jet, u: Jet, natural: Forms | None = None) -> Expr:
    """The deformed thickness over the undeformed one: undeformed, or natural, over deformed area."""
    stretch = kin.area_ratio(r0) / kin.area_ratio(r0 + u)
    return stretch if natural is None else stretch * natural.area * natural.thickness


def thinning(carrier: Carrier, u: fem.Function, natural: Shape | None) -> Thinning:
    """The same at points, at the present displacement and natural shape."""
    r0, V = carrier.r0, u.function_space
    grown = natural if natural and natural.stretch is not None else None

    def at(points: Array) -> Follows[Array]:
        jets_of = carrier.tables(V, points)

        def values() -> Array:
            first = jets_of(r0.x.array)[1:3]
            area0, area = (np.linalg.norm(np.cross(*a), axis=-1) for a in (first, first + jets_of(u.x.array)[1:3]))
            factor = 1.0 if grown is None else _growth(grown, first, points)
            return np.asarray(factor * area0 / area).ravel()

        by = (grown.field.x.array, grown.stretch.value) if grown and grown.stretch else ()
        return Follows(values, lambda: (r0.x.array, u.x.array, *by))

    return at


def _growth(natural: Shape, first: Array, points: Array) -> Array:
    """Natural over undeformed volume (cells, places), where the surface has these tangents (2, cells, places, 3)."""
    assert natural.stretch is not None
    numbers = float(natural.stretch.value) * at_quadrature(natural.field, points)
    T = np.empty((*numbers.shape[:2], 3, 3))
    T[..., *FIELD] = T[..., *FIELD[::-1]] = numbers[..., 6:12]
    a = np.moveaxis(first, 0, -2)
    mixed = np.linalg.solve(a @ np.swapaxes(a, -1, -2), a @ T @ np.swapaxes(a, -1, -2))
    return np.asarray(np.linalg.det(np.eye(2) + mixed) * (1 + numbers[..., 12]))
