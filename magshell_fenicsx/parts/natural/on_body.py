"""The natural shape of a body: the growth tensor G in F = F_e G, on which no energy is spent.

With the numbers of `shell.natural`, evaluated through the thickness, at the distance z along the normal n,

    G = (1 - s z kappa) U + s n n,

whose metric G^T G is that of the shell's natural forms, linear in z.
"""

from dataclasses import replace

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.mesh.hexahedra import MIDDLE, Body
from magshell_fenicsx.models.solid.terms import Density
from magshell_fenicsx.parts.magnetism.remanence import cells_of_body, places
from magshell_fenicsx.parts.natural.shape import SIZE, Natural, Shape, natural_field

Array = NDArray[np.float64]
NORMAL, HEIGHT = SIZE, SIZE + 3  # first numbers of n and z in the field


def body_shape(natural: Natural, body: Body, V: fem.FunctionSpace, free: dict[str, fem.Constant]) -> Shape:
    """The natural shape of a body; collective.

    Raises
    ------
    MeshError
        As `natural_field`, or if the body has no such patch.
    """
    natural = natural.on(body.patches, len(body.between))
    _, normals = places(V)
    Z = fem.functionspace(V.mesh, ("Lagrange", V.element.basix_element.degree, (1,)))
    z = body.at_nodes(Z, (body.heights - MIDDLE) * body.thickness)[Z.dofmap.list]
    numbers = natural_field(natural, cells_of_body(V), V)
    Q = fem.functionspace(V.mesh, ("DG", V.element.basix_element.degree, (HEIGHT + 1,)))
    field = fem.Function(Q, name="natural")
    rows = field.x.array.reshape(-1, HEIGHT + 1)
    given = numbers.x.array.reshape(-1, SIZE)[numbers.function_space.dofmap.list]
    rows[Q.dofmap.list] = np.concatenate([given, normals, z[..., None]], axis=-1)
    return Shape.of(field, natural, free)


def grown(density: Density, shape: Shape) -> Density:
    """A density that takes a `growth`, of that shape."""

    def of(*arguments: Expr) -> Expr:
        count = len(arguments) - len(shape.parameters)
        return density.of(*arguments[:count], growth=_growth(shape, *arguments[count:]))

    return replace(density, of=of, parameters=(*density.parameters, *shape.parameters))


def _growth(shape: Shape, field: Expr, *amplitudes: Expr) -> Expr:
    given = list(amplitudes)
    bent, stretched = (given.pop(0) if p is not None else None for p in (shape.curvature, shape.stretch))
    n, z = ufl.as_vector([field[NORMAL + i] for i in range(3)]), field[HEIGHT]
    n = n / ufl.sqrt(ufl.dot(n, n))
    across = ufl.outer(n, n)
    P = ufl.Identity(3) - across
    s, U = 1, P
    if stretched is not None:
        s, U = 1 + stretched * field[12], P + stretched * ufl.dot(P, ufl.dot(_tensor(field, 6), P))
    if bent is not None:
        U = U - s * z * bent * ufl.dot(P, ufl.dot(_tensor(field, 0), U))
    return U + s * across


def _tensor(field: Expr, first: int) -> Expr:
    xx, yy, zz, xy, xz, yz = (field[first + i] for i in range(6))
    return ufl.as_matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
