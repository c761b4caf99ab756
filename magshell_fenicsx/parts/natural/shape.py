"""The natural shape: the metric and the curvature that a shell would have without stress.

With the stretch tensor U of the surface, the stretch s of its thickness and the curvature kappa,

    a_n = U a0 U,    b_n = sym(b0 U^2)/s + U kappa U,    h_n = s h,

so that grown alike in all directions, U = s = lambda, a shell is free of stress as its enlarged
image. Membrane and bending energy are those of a shell with these forms, per area of the natural
surface; U = 1 + mu_s T and s = 1 + mu_s t grow with the amplitude "natural_stretch", kappa with
"natural_curvature".

Of a body it is the growth tensor G in F = F_e G, on which no energy is spent. With the same
numbers, at the distance z along the normal n,

    G = (1 - s z kappa) U + s n n,

whose metric G^T G is that of the shell's natural forms, linear in z.

A jet is a map with its first and second derivatives at a point; `Forms` are the natural metric,
curvature and thickness at a point, in UFL. A pattern is a function of undeformed places r0 and unit
normals n0. Places are over R, the reference length; h is the thickness. A user field is a function
that a program gives on its mesh. a0 and b0 are metric and curvature of the undeformed surface, T
and t the stretches of surface and thickness less one, mu_s the amplitude of the stretch.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.memo import at_quadrature
from magshell_fenicsx.input.expressions import FormulaGroup
from magshell_fenicsx.mesh.hexahedra import MIDSURFACE_HEIGHT, BodyMesh
from magshell_fenicsx.mesh.patch import MeshError, UserField
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.energy import Constants, Density, Parameter
from magshell_fenicsx.models.shell.formula_projection import CellGeometry, project_formula
from magshell_fenicsx.models.shell.kinematics import Forms, Jet
from magshell_fenicsx.models.shell.spatial_fields import (
    Pattern,
    PlacementField,
    body_cell_geometry,
    body_positions_and_normals,
    by_patch,
    cell_geometry,
)

Array = NDArray[np.float64]
Varying: TypeAlias = Array | Pattern | Mapping[str, Array] | UserField
STRETCH, CURVATURE = "natural_stretch", "natural_curvature"
SIZE = 13  # numbers of a field: kappa and T as symmetric tensors in space, and t
FIELD = (
    [0, 1, 2, 0, 0, 1],
    [0, 1, 2, 1, 2, 2],
)  # the components of a tensor in space, in the field's order
SMALLEST, LARGEST = 0.05, 20.0  # of a natural stretch
NORMAL_AT, HEIGHT_AT = SIZE, SIZE + 3  # first numbers of n and z in the field of a body
NORMAL = 1e-6  # length in the surface of a unit vector that is normal to it


@dataclass(frozen=True)
class Natural:
    """The natural shape at both amplitudes equal to one.

    Attributes
    ----------
    curvature
        kappa_11, kappa_22, kappa_12 R, positive where the surface bends towards its normal; a
        vector (3,), a pattern, vectors of named patches, or a field that was given on the mesh.
        None: it does not grow, and there is no such amplitude.
    stretch
        The stretches along t1, along t2 and of the thickness, less one, given as the curvature is.
    along
        A pattern (function of places and normals) of vectors, whose part in the surface is along
        t1; t2 = n x t1.
    """

    curvature: Varying | None
    stretch: Varying | None
    along: Pattern

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Names of the amplitudes of the growing parts: natural_curvature, natural_stretch."""
        values_by_amplitude = {CURVATURE: self.curvature, STRETCH: self.stretch}
        return tuple(name for name, value in values_by_amplitude.items() if value is not None)

    def on_cells(
        self,
        patches: Mapping[str, NDArray[np.bool_]],
        cells: int,
        pattern_of: Callable[[UserField], Pattern] | None = None,
    ) -> "Natural":
        """Return the shape with arrays for cells in place of patches, and patterns for fields.

        Parameters
        ----------
        patches
            Name of a patch -> whether each cell belongs to it.
        cells
            Number of cells on this rank.
        pattern_of
            Function that makes a pattern (function of places and normals) of a field of a program.
            Without it such fields stay as they are.

        Raises
        ------
        MeshError
            If a named patch does not exist.
        """
        replaced = dict[str, Any]()
        for key, value in (("curvature", self.curvature), ("stretch", self.stretch)):
            if isinstance(value, Mapping):
                replaced[key] = by_patch(value, patches, cells, f"natural.{key}")
            elif isinstance(value, UserField) and pattern_of:
                replaced[key] = pattern_of(value)
        return replace(self, **replaced)

    def tensors_at(self, r0: Array, n0: Array) -> tuple[Array, Array, Array]:
        """Return T and kappa (..., 3, 3) in space, and t (...), at undeformed places.

        T is the stretch in the surface less one, kappa the natural curvature, t the stretch of the
        thickness less one. Places `r0` over R and unit normals `n0` are (cells, nodes, 3).

        Raises
        ------
        MeshError
            If a tensor that depends on the direction has no frame at some place.
        """
        stretch, curvature = (_values(value, r0, n0) for value in (self.stretch, self.curvature))
        needs_frame = (stretch[..., 0] != stretch[..., 1]) | _is_anisotropic(curvature)
        t1, t2 = self._frame(r0, n0, needs_frame)
        return _tensor(stretch[..., :2], t1, t2), _tensor(curvature, t1, t2), stretch[..., 2]

    def in_frame(self, forces: Array, r0: Array, n0: Array) -> Array:
        """Return derivatives (..., 3) of an energy by kappa_11, kappa_22, kappa_12 in the frame.

        `forces` (..., 6) are derivatives by the six numbers of kappa in the field. The chain rule
        multiplies them by the derivatives of these numbers by a component in the frame. Those are
        the numbers of the tensor with this component 1 and the others 0. Places and normals are
        (..., 3).
        """
        # no place needs the frame: where there is none, its vectors and the derivatives are zero
        t1, t2 = self._frame(r0, n0, needed=np.zeros(r0.shape[:-1], dtype=bool))
        unit_tensors = (
            _tensor(np.broadcast_to(e, r0.shape), t1, t2)[..., *FIELD] for e in np.eye(3)
        )
        return np.stack(
            [np.sum(forces * unit_tensor, axis=-1) for unit_tensor in unit_tensors], axis=-1
        )

    @property
    def formulas(self) -> FormulaGroup | None:
        """The formulas of stretch and curvature in one group; None without any.

        A `FormulaGroup` has functions, and the frame and the unit of length of their places. Those
        of stretch and curvature are the same, and are taken from the first group.
        """
        groups = (getattr(value, "formulas", None) for value in (self.stretch, self.curvature))
        known_groups: list[FormulaGroup] = [group for group in groups if group]
        if not known_groups:
            return None
        functions = [f for group in known_groups for f in group.functions]
        return replace(known_groups[0], functions=functions)

    def _frame(self, r0: Array, n0: Array, needed: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return the unit vectors t1 and t2 (cells, nodes, 3) of the frame in the surface.

        Both are zero where they do not exist and are not needed.

        Parameters
        ----------
        needed
            (cells, nodes) whether a tensor depends on the direction.

        Raises
        ------
        MeshError
            If the frame does not exist at a place where it is needed.
        """
        along = self.along(r0, n0)
        # its part in the surface, without the part along the normal
        along = along - np.einsum("...i,...i->...", along, n0)[..., None] * n0
        length = np.linalg.norm(along, axis=-1, keepdims=True)
        # `~ >` and not `<=`: a length that is no number has no direction either
        has_no_direction = needed & ~(length[..., 0] > NORMAL)
        if has_no_direction.any():
            x, y, z = r0[has_no_direction][0]
            raise MeshError(
                f"natural.along: has no direction in the surface at (x, y, z)/R = ({x:.3g}, "
                f"{y:.3g}, {z:.3g})"
            )
        t1 = np.where(length > NORMAL, along / np.maximum(length, 1e-300), 0.0)
        return t1, np.cross(n0, t1)


def meridians(r0: Array, n0: Array) -> Array:
    """Return the directions (..., 3) of meridians at places and normals, e_theta x n.

    On the axis they are e1. Places and unit normals are (..., 3); the directions are not
    normalised.
    """
    x, y = r0[..., 0], r0[..., 1]
    is_off_axis = np.hypot(x, y)[..., None] > NORMAL
    return np.where(
        is_off_axis, np.cross(np.stack([-y, x, 0 * x], axis=-1), n0), np.array([1.0, 0.0, 0.0])
    )


def natural_field(natural: Natural, cells: CellGeometry, V: fem.FunctionSpace) -> fem.Function:
    """Return the natural shape as a field that may jump between cells of V; collective.

    The field has 13 numbers at each node: six of kappa, six of T, and t. Formulas are projected
    onto polynomials.

    Parameters
    ----------
    cells
        The cells of this rank with their undeformed places over R.

    Raises
    ------
    MeshError
        On every rank, if a number is not finite, a stretch is out of bounds, or the frame has no
        direction.
    """
    # values at the nodes; the message of an error is kept, so that all ranks raise together: a rank
    # that raised alone would leave the others waiting
    message, element = None, V.element.basix_element
    r0, n0, _ = cells.evaluate(element.points)
    try:
        _refuse_unfit(natural, r0, n0)
        T, kappa, t = natural.tensors_at(r0, n0)
    except MeshError as e:
        message = str(e)
    if problems := [text for text in V.mesh.comm.allgather(message) if text]:
        raise MeshError(problems[0])
    Q = fem.functionspace(V.mesh, ("DG", element.degree, (SIZE,)))
    # the function makes the field anew for another placement r
    field = PlacementField(
        Q, "natural", lambda r: natural_field(natural, cell_geometry(r), r.function_space)
    )
    values = _numbers(T, kappa, t)
    # polynomials of the cells have all values exactly, but for formulas: these are projected
    if any(getattr(value, "by_formula", False) for value in (natural.stretch, natural.curvature)):
        fitted_numbers = project_formula(
            lambda x, n: _numbers(*natural.tensors_at(x, n)),
            cells,
            values,
            element,
            element.degree,
            bounded=True,
            formulas=natural.formulas,
        )
        values = fitted_numbers.nodal
    field.x.array.reshape(-1, SIZE)[Q.dofmap.list] = values
    return field


def _numbers(T: Array, kappa: Array, t: Array) -> Array:
    """Return the numbers (..., 13) of the field: six of kappa, six of T, and t.

    A symmetric tensor has its components in the order of `FIELD`: xx, yy, zz, xy, xz, yz.
    """
    return np.concatenate([kappa[..., *FIELD], T[..., *FIELD], t[..., None]], axis=-1)


def _refuse_unfit(natural: Natural, r0: Array, n0: Array) -> None:
    """Refuse stretches and curvatures out of bounds at places and normals (cells, nodes, 3).

    Raises
    ------
    MeshError
        With the first such place.
    """
    # `Natural` has stretches less one
    stretch, curvature = 1 + _values(natural.stretch, r0, n0), _values(natural.curvature, r0, n0)
    is_valid = {
        f"stretch: is not within {SMALLEST:g} to {LARGEST:g}": (stretch >= SMALLEST)
        & (stretch <= LARGEST),
        "curvature: has no finite value (or one above 1e6/R)": np.abs(curvature) <= 1e6,
    }
    for description, valid in is_valid.items():
        if not valid.all():
            x, y, z = r0[~valid.all(axis=-1)][0]
            raise MeshError(f"natural.{description} at (x, y, z)/R = ({x:.3g}, {y:.3g}, {z:.3g})")


@dataclass(frozen=True)
class Shape:
    """A natural shape in the densities of a model.

    Attributes
    ----------
    field
        The natural shape at amplitudes of one: 13 numbers at each node, six of kappa, six of T, and
        t; of a body then the normal and the height over R.
    curvature, stretch
        The amplitudes; None for one that stays 0.
    """

    field: fem.Function
    curvature: fem.Constant | None
    stretch: fem.Constant | None

    @classmethod
    def from_field(cls, field: fem.Function, natural: Natural, constants: Constants) -> "Shape":
        """Return the shape of a field, with amplitudes from `constants`.

        `constants` maps names to the constants that all terms of a model share; missing ones are
        added.
        """
        domain = field.function_space.mesh
        amplitudes = {
            name: constants.setdefault(name, fem.Constant(domain, 0.0))
            for name in natural.amplitudes
        }
        return cls(field, amplitudes.get(CURVATURE), amplitudes.get(STRETCH))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The field and the amplitudes, as parameters of a density."""
        return (self.field, *(p for p in (self.curvature, self.stretch) if p is not None))

    @property
    def values(self) -> tuple[Array, ...] | None:
        """The values that the natural volume depends on; None if it is the undeformed one."""
        return None if self.stretch is None else (self.field.x.array, self.stretch.value)

    def volume(self, first: Array, points: Array) -> Array:
        """Return the natural over the undeformed volume (cells, places) at the present amplitude.

        Parameters
        ----------
        first
            (2, cells, places, 3) tangents of the undeformed surface.
        points
            Reference points (places, 2) of the cells.
        """
        assert self.stretch is not None
        return np.asarray(
            np.polynomial.polynomial.polyval(
                float(self.stretch.value), self.volume_coefficients(first, points)
            )
        )

    def volume_coefficients(self, first: Array, points: Array) -> Array:
        """Return the coefficients (4, cells, places) of det(1 + mu T) (1 + mu t) by powers of mu.

        mu is the amplitude of the stretch. `first` (2, cells, places, 3) are the tangents of the
        undeformed surface at the reference points `points` (places, 2).
        """
        numbers = at_quadrature(self.field, points)
        # the symmetric T from the numbers 6 to 11 of the field: entries ij, and the same as ji
        T = np.empty((*numbers.shape[:2], 3, 3))
        T[..., *FIELD] = T[..., *FIELD[::-1]] = numbers[..., 6:12]
        # mixed components (2, 2) of T in the surface, a0^-1 times the covariant ones: their trace
        # and determinant are those of the tensor
        tangents = np.moveaxis(first, 0, -2)
        transposed = np.swapaxes(tangents, -1, -2)
        mixed = np.linalg.solve(tangents @ transposed, tangents @ T @ transposed)
        # coefficients of (1 + mu trace + mu^2 det) (1 + mu t)
        t, trace, det = numbers[..., 12], np.trace(mixed, axis1=-2, axis2=-1), np.linalg.det(mixed)
        return np.array([np.ones_like(t), trace + t, det + trace * t, det * t])

    def forms(self, r0: Jet, field: Expr, *amplitudes: Expr) -> Forms:
        """Return the natural forms (metric, curvature, thickness) at a point, as UFL expressions.

        Parameters
        ----------
        r0
            Jet of the undeformed placement: the map with its first and second derivatives.
        field, amplitudes
            The values of `parameters` at the point: of an amplitude that stays zero there is none.
        """
        curvature_factor, stretch_factor = _factors(self, amplitudes)
        return _forms(r0, field, curvature_factor, stretch_factor)


def _factors(shape: Shape, amplitudes: Sequence[Expr]) -> tuple[Expr | None, Expr | None]:
    """Return the factors of curvature and stretch; None for one whose amplitude stays zero.

    `amplitudes` are those of the two that vary, none, one or both: curvature before stretch.
    """
    has_curvature, has_stretch = shape.curvature is not None, shape.stretch is not None
    curvature_factor = amplitudes[0] if has_curvature else None
    stretch_factor = amplitudes[-1] if has_stretch else None
    return curvature_factor, stretch_factor


def _forms(
    r0: Jet, field: Expr, curvature_factor: Expr | None, stretch_factor: Expr | None
) -> Forms:
    """Return the natural forms at a point: strain, bend, metric, its inverse, area and thickness.

    The strain is (a_n - a0)/2, the bend b_n - b0; area and thickness are over the undeformed ones.
    The equations are those of the module's docstring, with mu_s the stretch factor. A factor of
    None stands for an amplitude that stays zero.

    Parameters
    ----------
    r0
        Jet of the undeformed placement: the map with its first and second derivatives.
    field
        The numbers of the natural shape: six of kappa, six of T, and t.
    curvature_factor, stretch_factor
        The present amplitudes, by which these numbers are multiplied.
    """
    a0, up, n0 = kin.metric(r0), kin.inverse_metric(r0), kin.normal(r0)
    # the field has kappa from number 0 on, T from 6 on, and t as 12
    kappa = (
        ufl.zero((2, 2)) if curvature_factor is None else curvature_factor * covariant(r0, field, 0)
    )
    if stretch_factor is None:  # metric and thickness are the undeformed ones
        return Forms(ufl.zero((2, 2)), kappa, a0, up, ufl.as_ufl(1), ufl.as_ufl(1))
    # curvature b0 of the undeformed surface; `up` is the inverse of its metric a0
    b12 = ufl.dot(n0, r0.r12)
    b0 = ufl.as_matrix([[ufl.dot(n0, r0.r11), b12], [b12, ufl.dot(n0, r0.r22)]])
    # stretches s = 1 + t of the thickness and U of the surface, whose components are mixed
    t = stretch_factor * field[12]
    U_less_1 = stretch_factor * ufl.dot(up, covariant(r0, field, 6))
    U = ufl.Identity(2) + U_less_1
    U_squared_less_1 = 2 * U_less_1 + ufl.dot(U_less_1, U_less_1)  # U^2 - 1
    metric = a0 + ufl.dot(a0, U_squared_less_1)
    # change of sym(b0 U^2)/s against b0
    bend = (ufl.sym(ufl.dot(b0, U_squared_less_1)) - t * b0) / (1 + t)
    return Forms(
        ufl.dot(a0, U_squared_less_1) / 2,
        bend if curvature_factor is None else bend + ufl.dot(ufl.transpose(U), ufl.dot(kappa, U)),
        metric,
        ufl.inv(metric),
        ufl.det(U),
        1 + t,
    )


def grown(density: Density, shape: Shape) -> Density:
    """Return the density of a shell with a growing natural shape.

    The new density takes the arguments of the old one, then the field and the amplitudes of the
    shape.

    Parameters
    ----------
    density
        Its function takes the natural forms as `natural`: of a point, or of both sides of an edge.
    """

    def with_natural_forms(*arguments: Expr) -> Expr:
        """Return the density; the last arguments are the values of the shape's parameters."""
        own_count = len(arguments) - len(shape.parameters)
        density_arguments, (field, *amplitudes) = arguments[:own_count], arguments[own_count:]
        r0 = density_arguments[0]  # the first argument is the undeformed placement
        if isinstance(r0, Jet):  # of a point
            return density.function(*density_arguments, natural=shape.forms(r0, field, *amplitudes))
        # of an edge: pairs of jets and of fields, one for each side
        forms_of_sides = tuple(
            shape.forms(r0_of_side, field_of_side, *amplitudes)
            for r0_of_side, field_of_side in zip(r0, field, strict=True)
        )
        return density.function(*density_arguments, natural=forms_of_sides)

    return replace(
        density, function=with_natural_forms, parameters=(*density.parameters, *shape.parameters)
    )


def covariant(r0: Jet, field: Expr, first: int) -> Expr:
    """Return the components (2, 2) in the surface's coordinates of a symmetric tensor in space.

    Parameters
    ----------
    r0
        Jet of the placement, whose first derivatives are the tangents.
    field, first
        The tensor's six components (order of `FIELD`) begin at the index `first` of the field.
    """
    xx, yy, zz, xy, xz, yz = (field[first + i] for i in range(6))
    S = ufl.as_matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    S1, S2 = ufl.dot(S, r0.r1), ufl.dot(S, r0.r2)
    S12 = ufl.dot(r0.r1, S2)
    return ufl.as_matrix([[ufl.dot(r0.r1, S1), S12], [S12, ufl.dot(r0.r2, S2)]])


def _values(value: Varying | None, r0: Array, n0: Array) -> Array:
    """Return the values (cells, nodes, 3) of a stretch or curvature; zero for None."""
    if value is None:
        return np.zeros_like(r0)
    assert not isinstance(value, Mapping | UserField)  # a model knows them in its cells
    return value(r0, n0) if callable(value) else np.broadcast_to(value, r0.shape)


def _is_anisotropic(curvature: Array) -> NDArray[np.bool_]:
    """Return whether curvatures (..., 3) as 11, 22, 12 depend on the direction."""
    return np.asarray((curvature[..., 0] != curvature[..., 1]) | (curvature[..., 2] != 0))


def _tensor(components: Array, t1: Array, t2: Array) -> Array:
    """Return the tensor (..., 3, 3) with components S_11, S_22 and perhaps S_12 in a frame t1, t2.

    Its normal component is S_22, which has no effect: only parts in the surface are used. So where
    S_11 = S_22 and S_12 = 0 it is S_22 times the unit tensor, exactly, without t1 and t2.
    """

    def product(a: Array, b: Array) -> Array:
        return np.asarray(a[..., :, None] * b[..., None, :])

    S_11, S_22 = components[..., 0, None, None], components[..., 1, None, None]
    tensor = S_22 * np.eye(3) + (S_11 - S_22) * product(t1, t1)
    if components.shape[-1] == 3:
        tensor = tensor + components[..., 2, None, None] * (product(t1, t2) + product(t2, t1))
    return np.asarray(tensor)


def body_shape(
    natural: Natural, body: BodyMesh, V: fem.FunctionSpace, constants: dict[str, fem.Constant]
) -> Shape:
    """Return the natural shape of a solid, with normals and heights; collective.

    Its field has at each node the 13 numbers of the shell, the normal n, and the height z over R
    above the mid-surface.

    Parameters
    ----------
    V
        The vector space of the displacement of the solid.
    constants
        Name -> constant that all terms of the model share; amplitudes are added to it.

    Raises
    ------
    MeshError
        On every rank, if a number is not finite, a stretch is out of bounds, or the frame has no
        direction; or if the body has no such patch.
    """
    natural = natural.on_cells(body.patches, len(body.layer_bounds))
    # at the nodes of each cell: normals, heights z, and the numbers of the shell; the body has its
    # heights as parts of its thickness, from the inner face
    _, normals = body_positions_and_normals(V)
    Z = fem.functionspace(V.mesh, ("Lagrange", V.element.basix_element.degree, (1,)))
    z = body.at_nodes(Z, (body.heights - MIDSURFACE_HEIGHT) * body.thickness)[Z.dofmap.list]
    shell_field = natural_field(natural, body_cell_geometry(V), V)
    # all of them in one field
    Q = fem.functionspace(V.mesh, ("DG", V.element.basix_element.degree, (HEIGHT_AT + 1,)))
    field = fem.Function(Q, name="natural")
    rows = field.x.array.reshape(-1, HEIGHT_AT + 1)
    shell_numbers = shell_field.x.array.reshape(-1, SIZE)[shell_field.function_space.dofmap.list]
    rows[Q.dofmap.list] = np.concatenate([shell_numbers, normals, z[..., None]], axis=-1)
    return Shape.from_field(field, natural, constants)


def growth_in_body(shape: Shape, field: Expr, *amplitudes: Expr) -> Expr:
    """Return the growth tensor G = (1 - s z kappa) U + s n n at a point, as a UFL expression.

    G (3, 3) is in space; U is the stretch in the surface, s (`thickness_stretch`) the one of the
    thickness. `field` has the 13 numbers of the shell, the normal n and the height z. `amplitudes`
    are those of curvature and stretch, without one that stays zero.
    """
    curvature_factor, stretch_factor = _factors(shape, amplitudes)
    n, z = ufl.as_vector([field[NORMAL_AT + i] for i in range(3)]), field[HEIGHT_AT]
    n = n / ufl.sqrt(ufl.dot(n, n))  # interpolation between nodes shortens it
    normal_projection = ufl.outer(n, n)
    P = ufl.Identity(3) - normal_projection  # projects onto the surface
    # the field has kappa from number 0 on, T from 6 on, and t as 12
    thickness_stretch, U = 1, P
    if stretch_factor is not None:
        T_in_surface = ufl.dot(P, ufl.dot(_tensor_in_space(field, 6), P))
        thickness_stretch, U = 1 + stretch_factor * field[12], P + stretch_factor * T_in_surface
    if curvature_factor is not None:
        kappa_U = ufl.dot(P, ufl.dot(_tensor_in_space(field, 0), U))
        U = U - thickness_stretch * z * curvature_factor * kappa_U  # now (1 - s z kappa) U
    return U + thickness_stretch * normal_projection


def _tensor_in_space(field: Expr, first: int) -> Expr:
    """Return the symmetric tensor whose six numbers begin at an index of a field."""
    xx, yy, zz, xy, xz, yz = (field[first + i] for i in range(6))
    return ufl.as_matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
