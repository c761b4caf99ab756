"""What holds a meridian: displacements that are zero at its ends, and whether it is held against rigid motions."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import STRAIGHT
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.shell.parameters import Condition, Held
from magshell_fenicsx.parts.supports.supports import NOT_HELD, RIGHT, no_mirror

Facets = NDArray[np.int32]
HORIZONTAL, AXIAL = {0, 1}, 2  # components of the displacement


@dataclass(frozen=True)
class Supports:
    """Facets of the meridian by what is held there.

    Attributes
    ----------
    axis
        The point on the axis, which no axisymmetric displacement moves off it.
    horizontal, axial
        Where the displacements normal to e3 and along e3 are zero.
    mirror
        Where a plane normal to e3 mirrors the shell.
    named
        Name of an end, or of a point on the axis -> facets, and the components of (U, W) that are held there.
    """

    axis: Facets
    horizontal: Facets
    axial: Facets
    mirror: Facets
    named: Mapping[str, tuple[Facets, tuple[int, ...]]]
    meridian: Meridian

    def held(self, V: fem.FunctionSpace) -> list[fem.DirichletBC]:
        """Of the axisymmetric displacement (U, W)."""
        return [_zero(V, self.axis, 0), _zero(V, self.horizontal, 0), _zero(V, self.axial, 1)]

    def held_waves(self, V: fem.FunctionSpace, m: int) -> list[fem.DirichletBC]:
        """Of the coefficients (U + V, V, W): a wave m = 1 may move the axis across itself."""
        at_axis = [_zero(V, self.axis, i) for i in ((0, 2) if m == 1 else (0, 1, 2))]
        return [*at_axis, *(_zero(V, self.horizontal, i) for i in range(2)), _zero(V, self.axial, 2)]

    def rigid_motions(self, r0: fem.Function) -> dict[int, int]:
        """The number of rigid motions that no support stops of m = 0 and 1: along and around e3, across and about e1.

        Of m = 0 the motion along e3 is 1, that around it is counted under -1. Each of m = 1 has a twin.
        """
        free = {0: 0, -1: len(self.turning()), 1: 0}
        for horizontal, axial in self._by_body():
            # moved by a along e1 and turned by b about e2 it moves by a + b z along e1, at most by b rho along e3
            rows = [[1.0, z] for _, z in self._places(r0, horizontal)]
            rows += [[0.0, rho] for rho, _ in self._places(r0, axial)]
            free[0] += not len(axial)
            free[1] += 2 - int(np.linalg.matrix_rank(np.array(rows), tol=1e-9) if rows else 0)
        return free

    def turning(self) -> list[NDArray[np.bool_]]:
        """The cells of each shell, or of those joined, that no support keeps from turning about e3."""
        bodies = zip(self.meridian.bodies, self._by_body(), strict=True)
        return [cells for cells, (horizontal, _) in bodies if not len(horizontal)]

    def free_motion(self, r0: fem.Function) -> str:
        """A rigid motion that is left free, as a message; empty if there is none. Nothing but supports holds it."""
        free = self.rigid_motions(r0)
        if free[0]:
            return NOT_HELD + "move along (0, 0, 1)"
        if free[1]:
            return NOT_HELD + ("move along (1, 0, 0)" if self.turning() else "turn")
        return ""

    def _by_body(self) -> list[tuple[Facets, Facets]]:
        """Where the displacements of each of these normal to e3 and along e3 are zero."""
        return list(zip(*map(self.meridian.by_body, (self.horizontal, self.axial)), strict=True))

    @staticmethod
    def _places(r0: fem.Function, facets: Facets) -> NDArray[np.float64]:
        dofs = fem.locate_dofs_topological(r0.function_space, 0, facets)
        return np.asarray(r0.x.array.reshape(-1, 2)[dofs])


def supports(meridian: Meridian, conditions: Mapping[str, Condition]) -> Supports:
    """The supports that conditions of named ends make, and those of a named point on the axis.

    Raises
    ------
    MeshError
        If an end lies in no plane of symmetry.
    """
    horizontal, axial, mirror = facets = [list[Facets]() for _ in range(3)]
    named: dict[str, tuple[Facets, tuple[int, ...]]] = {}
    for name, condition in conditions.items():
        end = meridian.ends[name] if name in meridian.ends else meridian.facets_at(name)
        held = set(condition.components) if isinstance(condition, Held) else set()
        if condition in ("clamped", "simply supported"):
            held = {*HORIZONTAL, AXIAL}
        if condition == "plane":
            _refuse_slanting(meridian, name)
            mirror.append(end)
            held = {AXIAL}
        if held >= HORIZONTAL:
            horizontal.append(end)
        if AXIAL in held:
            axial.append(end)
        both = tuple(i for i, part in enumerate((HORIZONTAL, {AXIAL})) if held >= part)
        if both:
            named[name] = end, both
    parts = [np.unique(np.concatenate([np.empty(0, np.int32), *f])) for f in facets]
    return Supports(meridian.axis, parts[0], parts[1], parts[2], named, meridian)


def _refuse_slanting(meridian: Meridian, name: str) -> None:
    """See that the surface crosses the plane of an end at right angles."""
    s, near = meridian.parameter(name), STRAIGHT if meridian.begins(name) else -STRAIGHT
    (rho, z), (rho_near, z_near) = meridian.section(np.array([s, s + near]))
    if abs(z_near - z) < RIGHT * np.hypot(rho_near - rho, z_near - z):
        raise MeshError(no_mirror(name))


def _zero(V: fem.FunctionSpace, facets: Facets, component: int) -> fem.DirichletBC:
    part = V.sub(component)
    return fem.dirichletbc(0.0, fem.locate_dofs_topological(part, 0, facets), part)
