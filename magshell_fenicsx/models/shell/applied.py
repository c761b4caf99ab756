"""An applied flux density that is known by its values: its Taylor polynomial at the present place of each point.

The polynomial of second order has the first and second derivatives of the field itself, and so have the energies that
take it: the forms and kernels are the same for every field.
"""

from collections.abc import Callable

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.point_field import PointField
from magshell_fenicsx.models.shell.patterns import refuse_unbounded

Array = NDArray[np.float64]
# places (n, 3) over R -> B (n, 3), dB_i/dx_j (n, 3, 3), d2B_i/dx_j dx_k (n, 3, 3, 3), over the field's magnitude
FieldInSpace = Callable[[Array], tuple[Array, Array, Array]]
PAIRS = np.triu_indices(3)
SIZE = 3 + 3 + 3 + 9 + 18  # u*, B at r0, B*, G*, H* by pairs j <= k


def around(P: Expr, u: Expr) -> tuple[Expr, Expr]:
    """B at the displacement u from the polynomial P (`SIZE`,), and less what it is at u = 0."""
    d = u - ufl.as_vector([P[i] for i in range(3)])

    def component(i: int) -> Expr:
        linear = sum(P[9 + 3 * i + j] * d[j] for j in range(3))
        pairs = enumerate(zip(*PAIRS, strict=True))
        return P[6 + i] + linear + sum(P[18 + 6 * i + n] * d[int(j)] * d[int(k)] for n, (j, k) in pairs)

    B = ufl.as_vector([component(i) for i in range(3)])
    return B, B - ufl.as_vector([P[3 + i] for i in range(3)])


class AppliedField:
    """The polynomials of a field at the quadrature points of a shell, a meridian or a body.

    Parameters
    ----------
    of
        The field.
    r0, u
        Placement and displacement in one space; on a meridian along e_rho and e_z.
    degree
        Of the quadrature.

    Raises
    ------
    MeshError
        On every rank, if the field has no finite value or derivative on the undeformed surface.

    Attributes
    ----------
    polynomial
        The parameter of the densities.
    """

    def __init__(self, of: FieldInSpace, r0: fem.Function, u: fem.Function, degree: int) -> None:
        V = u.function_space
        self.polynomial = PointField(V.mesh, degree, SIZE)
        self._of, self._u = of, u
        self._known: Array = np.empty(0)
        self._shape = V.element.basix_element.tabulate(0, self.polynomial.points)[0, :, :, 0]
        self._nodes = V.dofmap.list
        self._r0 = self._at_points(r0)
        B, G, H = self._of(self._r0.reshape(-1, 3))
        known = np.isfinite(G).all(axis=(1, 2)) & np.isfinite(H).all(axis=(1, 2, 3))
        self._B0 = np.where(np.reshape(known, (-1, 1)), B, np.nan).reshape(self._r0.shape)
        refuse_unbounded(self._B0, self._r0, V.mesh.comm, "magnetic.applied")
        self.follow()

    def follow(self) -> None:
        """Renew the polynomials where the displacement has changed."""
        if np.array_equal(self._u.x.array, self._known):
            return
        self._known = np.array(self._u.x.array)
        u = self._at_points(self._u)
        B, G, H = self._of((self._r0 + u).reshape(-1, 3))
        second = H[:, :, *PAIRS] * np.where(PAIRS[0] == PAIRS[1], 0.5, 1.0)
        flat = [a.reshape(*u.shape[:2], -1) for a in (u, self._B0, B, G, second)]
        self.polynomial.renew(np.concatenate(flat, axis=-1))

    def _at_points(self, field: fem.Function) -> Array:
        """(cells, points, 3)."""
        size = field.function_space.dofmap.bs
        found = np.asarray(self._shape @ field.x.array.reshape(-1, size)[self._nodes])
        return np.insert(found, 1, 0.0, axis=-1) if size == 2 else found
