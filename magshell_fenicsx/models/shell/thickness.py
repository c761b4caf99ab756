"""A thickness that varies over the surface: its factor of h, and densities weighted with it.

- h is the thickness of the case, over R; the factor h(x)/h multiplies it at the place x.
- Values in cells are (cells, nodes): at the nodes of a discontinuous element of the placement's
  degree. Owned cells come first, then ghosts.
- A formula that varies within a cell is projected (`project_formula`); its polynomials stay within
  the range of the formula.
- A patch is a named part of a mesh, perhaps one of several shells, which then has a pose: its
  rotation, position and scale in the model.
- A placement is the map r0 to the undeformed surface.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from dolfinx import fem, mesh
from mpi4py import MPI
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.input.expressions import FormulaGroup
from magshell_fenicsx.mesh.multi_shell import ShellPose
from magshell_fenicsx.mesh.patch import MeshError, UserField, refuse_places
from magshell_fenicsx.models.shell.energy import Density
from magshell_fenicsx.models.shell.formula_projection import CellGeometry, project_formula
from magshell_fenicsx.models.shell.parameters import ShellMaterial
from magshell_fenicsx.models.shell.spatial_fields import (
    CellPolynomials,
    PlacementField,
    cell_geometry,
    positions_and_normals,
)

Array = NDArray[np.float64]
MIN_THICKNESS_FACTOR, MAX_THICKNESS_FACTOR = 1e-3, 1e3


@dataclass(frozen=True)
class Thickness:
    """The factor h(x)/h, which multiplies the thickness.

    It is given by one of `of_position` and `user_field`; without both it is 1. `patches` replace
    it on some patches.

    Attributes
    ----------
    of_position
        Function of arrays of x, y, z over R; None for 1.
    patches
        Patch of a mesh -> a number, or the factor of the shell that the patch is. Outside the
        patches the factor is that of the other attributes.
    formulas
        Formulas that vary in the function.
    user_field
        A field on the triangles of a mesh in place of the function.
    polynomials
        The user's field in the cells of a model.
    """

    of_position: Callable[[Array, Array, Array], Array] | None = None
    patches: "Mapping[str, float | PlacedFactor] | None" = None
    formulas: FormulaGroup | None = None
    user_field: UserField | None = None
    polynomials: CellPolynomials | None = None

    def values_at(self, x: Array) -> Array:
        """Return the factor (...) at places x (..., 3) over R, without patches.

        A user's field needs places (cells, n, 3) in cells.
        """
        if self.polynomials:
            return np.array(self.polynomials(x)[..., 0])
        if self.of_position:
            return np.array(self.of_position(*np.moveaxis(x, -1, 0)))
        return np.ones(x.shape[:-1])

    def values_in_cells(self, cells: CellGeometry, nodal: Array) -> Array:
        """Return the factor (cells, nodes), a formula projected by `project_formula`; collective.

        `nodal` are its values at the nodes. They are returned unless the factor is a formula.
        """
        if self.of_position is None:
            return nodal
        element = cells.element
        projection = project_formula(
            lambda x, n: self.values_at(x)[..., None],
            cells,
            nodal[..., None],
            element,
            element.degree,
            bounded=True,
            formulas=self.formulas,
        )
        return projection.nodal[..., 0]


@dataclass(frozen=True)
class PlacedFactor:
    """The thickness factor of one of several shells, times a number, with the shell's pose."""

    thickness: Thickness
    place: ShellPose
    factor: float

    def in_cells(self, cells: CellGeometry) -> Array:
        """Return the factor (cells, nodes) in cells of this shell; collective.

        The cells are those of a surface in space, or of a meridian with rho and z. The formula of
        the factor is in the shell's own frame, so places are moved there.
        """
        # x: the cells' nodes in the shell's frame, in space; nodal: in the components of the mesh,
        # which on a meridian are rho and z
        if cells.nodal.shape[-1] == 3:
            nodal = x = self.place.to_shell_frame(cells.nodal)
        else:
            x = self.place.to_shell_frame(np.insert(cells.nodal, 1, 0.0, axis=-1))
            nodal = np.stack([np.hypot(x[..., 0], x[..., 1]), x[..., 2]], axis=-1)
        return self.factor * self.thickness.values_in_cells(
            replace(cells, nodal=nodal), self.thickness.values_at(x)
        )


def refuse_unfit(factors: Array, x: Array, comm: MPI.Comm) -> None:
    """Refuse factors (...) of the thickness that are too small or too large; collective.

    `x` (..., 3) are their places over R.

    Raises
    ------
    MeshError
        On every rank, with the first such place.
    """
    refuse_places(
        x[~((factors >= MIN_THICKNESS_FACTOR) & (factors <= MAX_THICKNESS_FACTOR))],
        f"shell.thickness_factor: is not within {MIN_THICKNESS_FACTOR:g} to "
        f"{MAX_THICKNESS_FACTOR:g}",
        comm,
    )


def thickness_field(
    thickness: Thickness, r0: fem.Function, patches: Mapping[str, NDArray[np.bool_]] | None = None
) -> fem.Function:
    """Return h(x)/h as a discontinuous field (1,) of the placement's degree; collective.

    Its `rebuild` makes it on another placement.

    Parameters
    ----------
    thickness
        The factor.
    r0
        The placement.
    patches
        Patch -> flags (cells,) of this rank's cells in it; None without patches.

    Raises
    ------
    MeshError
        On every rank, if the factor is too small or too large somewhere, or a patch is unknown.
    """
    V = r0.function_space
    # values at the nodes without patches, checked before a formula is projected; normals are not
    # needed
    nodes, _ = positions_and_normals(r0)
    values = thickness.values_at(nodes)
    refuse_unfit(values, nodes, V.mesh.comm)
    if thickness.polynomials:  # they may leave the range of their nodal values
        between_nodes, sampled = thickness.polynomials.values_between_nodes()
        refuse_unfit(between_nodes[..., 0], sampled, V.mesh.comm)
    values = thickness.values_in_cells(cell_geometry(r0), values)  # (cells, nodes)
    # patches: one number, or the factor of the shell that the patch is
    for name, factor in (thickness.patches or {}).items():
        is_inside = patch_of(patches or {}, name, "shell.thickness_factor")
        if isinstance(factor, PlacedFactor):
            values[is_inside] = factor.in_cells(select_cells(cell_geometry(r0), is_inside))
        else:
            values[is_inside] = factor
    refuse_unfit(values, nodes, V.mesh.comm)
    Q = fem.functionspace(V.mesh, ("DG", V.element.basix_element.degree, (1,)))
    field = PlacementField(Q, "thickness", lambda r: thickness_field(thickness, r, patches))
    field.x.array[Q.dofmap.list] = values
    return field


def material_field(
    shells: Mapping[str, ShellMaterial], domain: mesh.Mesh, patches: Mapping[str, NDArray[np.bool_]]
) -> fem.Function:
    """Return the material of each cell as a field (4,), constant in cells.

    The numbers are modulus, Poisson's ratio, density and number of the law (`ShellMaterial`).
    `patches` maps each shell's name to flags (cells,) of this rank's cells in it, ghosts included.

    Raises
    ------
    MeshError
        If a shell has no patch.
    """
    Q = fem.functionspace(domain, ("DG", 0, (4,)))
    field = fem.Function(Q, name="material")
    values = field.x.array.reshape(-1, 4)
    for name, material in shells.items():
        is_in_shell = patch_of(patches, name, "shells")
        nodes_of_cells = Q.dofmap.list[is_in_shell][
            :, 0
        ]  # one in each: the field is constant there
        values[nodes_of_cells] = material.numbers
    return field


def select_cells(cells: CellGeometry, selection: NDArray[np.bool_]) -> CellGeometry:
    """Return the selected cells of this rank, by flags (cells,), with their geometry."""
    return replace(cells, nodal=cells.nodal[selection], owned=int(selection[: cells.owned].sum()))


def patch_of(
    patches: Mapping[str, NDArray[np.bool_]], name: str, key: str = "loading.loads"
) -> NDArray[np.bool_]:
    """Return flags (cells,) of the cells in a named patch; `key` is the key of the case.

    Raises
    ------
    MeshError
        If there is no such patch.
    """
    if name not in patches:
        allowed = ", ".join(patches) or "none"
        raise MeshError(f"{key}: {name}: the surface has no such patch, only {allowed}")
    return patches[name]


def thickness_weighted(density: Density, t: fem.Function, component: int = 0) -> Density:
    """Return a density times a component of the field t, which becomes its last parameter.

    The parameters of a density are fields and constants, the last arguments of its function. By
    default the component is the first one, the thickness over h.
    """

    def weighted(*arguments: Expr) -> Expr:
        """Return the density's value times the component; the field is the last argument."""
        *arguments_left, factor = arguments
        return factor[component] * density.function(*arguments_left)

    return replace(density, function=weighted, parameters=(*density.parameters, t))
