"""Supports of a meridian: displacements that are zero at its ends, and rigid motions they stop.

U, V and W are the displacements away from the axis e3, around it and along it. An axisymmetric
displacement has U and W. A wave m varies as cos(m theta) (U, W) and sin(m theta) (V) around the
axis; its unknowns are U + V, V and W. rho and z are the distance from the axis and the height. A
facet is a point of the meridian's mesh. A body is a shell, or several that are joined.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from dolfinx import fem
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import PLANARITY_TOLERANCE
from magshell_fenicsx.mesh.patch import MeshError
from magshell_fenicsx.models.axisymmetric.meridian import Meridian
from magshell_fenicsx.models.shell.parameters import Condition, HeldComponents
from magshell_fenicsx.parts.supports.supports import MIN_CROSSING_COSINE, no_mirror

Array = NDArray[np.float64]
Facets = NDArray[np.int32]
HORIZONTAL, AXIAL = {0, 1}, 2  # components of the displacement


@dataclass(frozen=True)
class RigidMotions:
    """Rigid motions of the bodies of a shell of revolution; a body is a shell, or joined shells.

    Attributes
    ----------
    axial
        Displacements (n, nodes times 2) along e3, as components (U, W).
    torsional
        Rotations about e3 as waves m = 0, by coefficients (U + V, V, W), (n, nodes times 3).
    transverse
        Waves m = 1 that move a body across e3, or turn it about an axis across e3; also
        (n, nodes times 3). Each has a twin.
    """

    axial: Array
    torsional: Array
    transverse: Array


@dataclass(frozen=True)
class Supports:
    """Facets (points) of the meridian by the displacements that are zero there.

    Attributes
    ----------
    axis
        The points on the axis, which no axisymmetric displacement moves off it.
    horizontal, axial
        Where the displacements normal to e3 and along e3 are zero.
    mirror
        Where a plane normal to e3 mirrors the shell.
    by_name
        Name of an end, or of a point on the axis -> facets, and the components of (U, W) that are
        held there.
    meridian
        The meridian with its mesh.
    """

    axis: Facets
    horizontal: Facets
    axial: Facets
    mirror: Facets
    by_name: Mapping[str, tuple[Facets, tuple[int, ...]]]
    meridian: Meridian

    def axisymmetric_conditions(self, V: fem.FunctionSpace) -> list[fem.DirichletBC]:
        """Return the conditions of zero on the axisymmetric displacement (U, W) in the space V."""
        return [_zero(V, self.axis, 0), _zero(V, self.horizontal, 0), _zero(V, self.axial, 1)]

    def wave_conditions(self, V: fem.FunctionSpace, m: int) -> list[fem.DirichletBC]:
        """Return the conditions of zero on the coefficients (U + V, V, W) of waves m.

        V is their function space. A wave m = 1 may move the axis across itself.
        """
        # on the axis all are zero, but V of waves m = 1: a shift across the axis has U = -V
        at_axis = [_zero(V, self.axis, i) for i in ((0, 2) if m == 1 else (0, 1, 2))]
        return [
            *at_axis,
            *(_zero(V, self.horizontal, i) for i in range(2)),
            _zero(V, self.axial, 2),
        ]

    def unknowns_of_waves(self, r0: fem.Function, m: int) -> NDArray[np.int32]:
        """Return the numbers of the unknowns (U + V, V, W) of waves m that are zero.

        They follow from the supports, and at the axis from the form of the waves. No space of waves
        is needed: nodes have the same numbers in the spaces of displacements and of waves.

        Parameters
        ----------
        r0
            Undeformed placement, in the space of displacements.
        m
            Number of waves around the axis.
        """
        axis, horizontal, axial = (
            fem.locate_dofs_topological(r0.function_space, 0, facets)
            for facets in (self.axis, self.horizontal, self.axial)
        )
        # on the axis all are zero, but V (coefficient 1) of waves m = 1: a shift across the axis
        # has U = -V
        at_axis = [3 * axis + i for i in ((0, 2) if m == 1 else (0, 1, 2))]
        return np.concatenate([*at_axis, 3 * horizontal, 3 * horizontal + 1, 3 * axial + 2])

    def rigid_motions(self, r0: fem.Function) -> RigidMotions:
        """Return the rigid motions of each body, whatever supports hold it.

        A body is a shell, or shells that are joined; `r0` is the undeformed placement.
        """
        axial_motions = list[Array]()
        torsional_waves = list[Array]()
        transverse_waves = list[Array]()
        places = r0.x.array.reshape(-1, 2)
        for cells in self.meridian.bodies:
            # 1, rho and z at the nodes of this body, and zero on other bodies
            rho, z, ones = np.zeros((3, len(places)))
            nodes = r0.function_space.dofmap.list[cells]
            ones[nodes] = 1.0
            rho[nodes], z[nodes] = np.moveaxis(places[nodes], -1, 0)
            zero = 0.0 * ones
            axial_motions.append(np.column_stack([zero, ones]).ravel())
            torsional_waves.append(np.column_stack([rho, rho, zero]).ravel())
            # a shift across the axis (U = 1, V = -1), and a turn (U = z, V = -z, W = -rho)
            transverse_waves += [
                np.column_stack(wave).ravel() for wave in ([zero, -ones, zero], [zero, -z, -rho])
            ]
        return RigidMotions(
            np.array(axial_motions), np.array(torsional_waves), np.array(transverse_waves)
        )


def supports(meridian: Meridian, conditions: Mapping[str, Condition]) -> Supports:
    """Return the supports of a meridian, from the conditions of its named ends and points.

    Raises
    ------
    MeshError
        If an end with a plane of symmetry does not lie in one.
    """
    # facets where the displacement across e3 or along e3 is zero, and in planes of symmetry
    horizontal, axial, mirror = list[Facets](), list[Facets](), list[Facets]()
    named_ends: dict[str, tuple[Facets, tuple[int, ...]]] = {}
    for name, condition in conditions.items():
        # the facets of the name, and the components x, y, z that are held there
        end = meridian.ends[name] if name in meridian.ends else meridian.facets_at(name)
        components = set(condition.components) if isinstance(condition, HeldComponents) else set()
        if condition in ("clamped", "simply supported"):
            components = {*HORIZONTAL, AXIAL}
        if condition == "plane":
            _refuse_slanting(meridian, name)
            mirror.append(end)
            components = {AXIAL}
        if components >= HORIZONTAL:
            horizontal.append(end)
        if AXIAL in components:
            axial.append(end)
        # the components of (U, W) that are held: 0, U, where x and y both are; 1, W, where z is
        held_of_U_W = tuple(i for i, part in enumerate((HORIZONTAL, {AXIAL})) if components >= part)
        if held_of_U_W:
            named_ends[name] = end, held_of_U_W
    return Supports(
        axis=meridian.axis,
        horizontal=_joined(horizontal),
        axial=_joined(axial),
        mirror=_joined(mirror),
        by_name=named_ends,
        meridian=meridian,
    )


def _joined(facets: Sequence[Facets]) -> Facets:
    """Return facets of several arrays in one, sorted and each once; empty without any."""
    joined: Facets = np.unique(np.concatenate([np.empty(0, np.int32), *facets]))
    return joined


def _refuse_slanting(meridian: Meridian, name: str) -> None:
    """Refuse a surface that does not cross the plane of a named end at right angles.

    Raises
    ------
    MeshError
        If the meridian at the end is not nearly parallel to e3.
    """
    # the direction of the meridian at its end, from two points on it
    s = meridian.parameter(name)
    offset = PLANARITY_TOLERANCE if meridian.begins(name) else -PLANARITY_TOLERANCE  # inwards
    (rho, z), (rho_near, z_near) = meridian.section(np.array([s, s + offset]))
    if abs(z_near - z) < MIN_CROSSING_COSINE * np.hypot(rho_near - rho, z_near - z):
        raise MeshError(no_mirror(name))


def _zero(V: fem.FunctionSpace, facets: Facets, component: int) -> fem.DirichletBC:
    """Return the condition that a component is zero at facets (points) of a meridian."""
    part = V.sub(component)
    return fem.dirichletbc(0.0, fem.locate_dofs_topological(part, 0, facets), part)
