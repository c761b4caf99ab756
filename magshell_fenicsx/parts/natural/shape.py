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
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TypeAlias

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
        The stretches along t1, along t2 and of the thickness, less one; likewise.
    along
        A pattern whose part in the surface is along t1; t2 = n x t1.
    """

    curvature: Varying | None
    stretch: Varying | None
    along: Pattern

    @property
    def amplitudes(self) -> tuple[str, ...]:
        """Names of the amplitudes."""
        values_by_amplitude = {CURVATURE: self.curvature, STRETCH: self.stretch}
        return tuple(name for name, value in values_by_amplitude.items() if value is not None)

    def on_cells(
        self,
        patches: Mapping[str, NDArray[np.bool_]],
        cells: int,
        pattern_of: Callable[[UserField], Pattern] | None = None,
    ) -> "Natural":
        """Return the shape with vectors for each cell in place of patches, and patterns of fields.

        Raises
        ------
        MeshError
            If there is no such patch.
        """
        values = {"curvature": self.curvature, "stretch": self.stretch}
        by_cell = {
            key: by_patch(value, patches, cells, f"natural.{key}")
            for key, value in values.items()
            if isinstance(value, Mapping)
        }
        varying = {key: value for key, value in values.items() if isinstance(value, UserField)}
        return replace(
            self,
            **by_cell,
            **{key: pattern_of(value) for key, value in varying.items() if pattern_of},
        )

    def tensors_at(self, r0: Array, n0: Array) -> tuple[Array, Array, Array]:
        """Return T and kappa (..., 3, 3) in space, and t (...), at undeformed places.

        Places and normals are (cells, nodes, 3).
        """
        stretch, curvature = (_values(value, r0, n0) for value in (self.stretch, self.curvature))
        t1, t2 = self._frame(
            r0, n0, (stretch[..., 0] != stretch[..., 1]) | _is_anisotropic(curvature)
        )
        return _tensor(stretch[..., :2], t1, t2), _tensor(curvature, t1, t2), stretch[..., 2]

    def in_frame(self, forces: Array, r0: Array, n0: Array) -> Array:
        """Return derivatives (..., 3) by kappa_11, kappa_22 and kappa_12, from those by the field.

        `forces` (..., 6) are derivatives by the six numbers of kappa in the field.
        """
        t1, t2 = self._frame(r0, n0, np.zeros(r0.shape[:-1], dtype=bool))
        ones = (_tensor(np.broadcast_to(e, r0.shape), t1, t2)[..., *FIELD] for e in np.eye(3))
        return np.stack([np.sum(forces * unit_tensor, axis=-1) for unit_tensor in ones], axis=-1)

    @property
    def formulas(self) -> FormulaGroup | None:
        """Formulas of stretch and curvature; None without any."""
        groups = (getattr(value, "formulas", None) for value in (self.stretch, self.curvature))
        known_groups = [value for value in groups if value]
        return (
            replace(
                known_groups[0], functions=[f for group in known_groups for f in group.functions]
            )
            if known_groups
            else None
        )

    def _frame(self, r0: Array, n0: Array, needed: NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return t1 and t2 (cells, nodes, 3); zero where they do not exist and are not needed."""
        d = self.along(r0, n0)
        d = d - np.einsum("...i,...i->...", d, n0)[..., None] * n0
        length = np.linalg.norm(d, axis=-1, keepdims=True)
        if (has_no_direction := needed & ~(length[..., 0] > NORMAL)).any():
            x, y, z = r0[has_no_direction][0]
            raise MeshError(
                f"natural.along: has no direction in the surface at (x, y, z)/R = ({x:.3g}, "
                f"{y:.3g}, {z:.3g})"
            )
        t1 = np.where(length > NORMAL, d / np.maximum(length, 1e-300), 0.0)
        return t1, np.cross(n0, t1)


def meridians(r0: Array, n0: Array) -> Array:
    """Return the directions (..., 3) of meridians, e_theta x n; on the axis e1."""
    x, y = r0[..., 0], r0[..., 1]
    off = np.hypot(x, y)[..., None] > NORMAL
    return np.where(off, np.cross(np.stack([-y, x, 0 * x], axis=-1), n0), np.array([1.0, 0.0, 0.0]))


def natural_field(natural: Natural, cells: CellGeometry, V: fem.FunctionSpace) -> fem.Function:
    """Return the natural shape as a field that may jump between cells of V; collective.

    Raises
    ------
    MeshError
        On every rank, if a number is not finite, a stretch is out of bounds, or the frame has no
        direction.
    """
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
    field = PlacementField(
        Q, "natural", lambda r: natural_field(natural, cell_geometry(r), r.function_space)
    )
    values = _numbers(T, kappa, t)
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
    """Return the numbers (..., SIZE) of a field."""
    return np.concatenate([kappa[..., *FIELD], T[..., *FIELD], t[..., None]], axis=-1)


def _refuse_unfit(natural: Natural, r0: Array, n0: Array) -> None:
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
    """A natural shape in the densities of a model: its field and its amplitudes; None for 0."""

    field: fem.Function
    curvature: fem.Constant | None
    stretch: fem.Constant | None

    @classmethod
    def from_field(cls, field: fem.Function, natural: Natural, constants: Constants) -> "Shape":
        """Return the shape with amplitudes from `constants`, which all terms of a model use."""
        domain = field.function_space.mesh
        amplitudes = {
            name: constants.setdefault(name, fem.Constant(domain, 0.0))
            for name in natural.amplitudes
        }
        return cls(field, amplitudes.get(CURVATURE), amplitudes.get(STRETCH))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The field, and the amplitudes that there are."""
        return (self.field, *(p for p in (self.curvature, self.stretch) if p is not None))

    @property
    def values(self) -> tuple[Array, ...] | None:
        """Values that the natural volume depends on; None if it is the undeformed one."""
        return None if self.stretch is None else (self.field.x.array, self.stretch.value)

    def volume(self, first: Array, points: Array) -> Array:
        """Return natural over undeformed volume (cells, places).

        `first` (2, cells, places, 3) are the tangents of the surface.
        """
        assert self.stretch is not None
        return np.asarray(
            np.polynomial.polynomial.polyval(
                float(self.stretch.value), self.volume_coefficients(first, points)
            )
        )

    def volume_coefficients(self, first: Array, points: Array) -> Array:
        """Return the coefficients (4, cells, places) of det(1 + mu T) (1 + mu t) by powers of mu.

        mu is the amplitude of the stretch.
        """
        numbers = at_quadrature(self.field, points)
        T = np.empty((*numbers.shape[:2], 3, 3))
        T[..., *FIELD] = T[..., *FIELD[::-1]] = numbers[..., 6:12]
        tangents = np.moveaxis(first, 0, -2)
        mixed = np.linalg.solve(
            tangents @ np.swapaxes(tangents, -1, -2), tangents @ T @ np.swapaxes(tangents, -1, -2)
        )
        t, trace, det = numbers[..., 12], np.trace(mixed, axis1=-2, axis2=-1), np.linalg.det(mixed)
        return np.array([np.ones_like(t), trace + t, det + trace * t, det * t])

    def forms(self, r0: Jet, field: Expr, *amplitudes: Expr) -> Forms:
        """Return the natural forms at a point where the field and the amplitudes have values."""
        values = list(amplitudes)
        bent, stretched = (
            values.pop(0) if p is not None else None for p in (self.curvature, self.stretch)
        )
        return _forms(r0, field, bent, stretched)


def _forms(
    r0: Jet, field: Expr, curvature_factor: Expr | None, stretch_factor: Expr | None
) -> Forms:
    a0, up, n0 = kin.metric(r0), kin.inverse_metric(r0), kin.normal(r0)
    kappa = (
        ufl.zero((2, 2)) if curvature_factor is None else curvature_factor * covariant(r0, field, 0)
    )
    if stretch_factor is None:
        return Forms(ufl.zero((2, 2)), kappa, a0, up, ufl.as_ufl(1), ufl.as_ufl(1))
    b12 = ufl.dot(n0, r0.r12)
    b0 = ufl.as_matrix([[ufl.dot(n0, r0.r11), b12], [b12, ufl.dot(n0, r0.r22)]])
    t = stretch_factor * field[12]
    mixed = stretch_factor * ufl.dot(up, covariant(r0, field, 6))
    U = ufl.Identity(2) + mixed
    twice = 2 * mixed + ufl.dot(mixed, mixed)  # U^2 - 1
    metric = a0 + ufl.dot(a0, twice)
    grown = (ufl.sym(ufl.dot(b0, twice)) - t * b0) / (1 + t)
    return Forms(
        ufl.dot(a0, twice) / 2,
        grown if curvature_factor is None else grown + ufl.dot(ufl.transpose(U), ufl.dot(kappa, U)),
        metric,
        ufl.inv(metric),
        ufl.det(U),
        1 + t,
    )


def grown(density: Density, shape: Shape) -> Density:
    """Return a density with natural forms, from one that takes `natural`."""

    def with_natural_forms(*arguments: Expr) -> Expr:
        count = len(arguments) - len(shape.parameters)
        of_density, (field, *amplitudes) = arguments[:count], arguments[count:]
        r0 = of_density[0]
        if isinstance(r0, Jet):
            return density.function(*of_density, natural=shape.forms(r0, field, *amplitudes))
        sides = tuple(shape.forms(j, side, *amplitudes) for j, side in zip(r0, field, strict=True))
        return density.function(*of_density, natural=sides)

    return replace(
        density, function=with_natural_forms, parameters=(*density.parameters, *shape.parameters)
    )


def covariant(r0: Jet, field: Expr, first: int) -> Expr:
    """Return the components in the surface's coordinates of a symmetric tensor in space."""
    xx, yy, zz, xy, xz, yz = (field[first + i] for i in range(6))
    S = ufl.as_matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    S1, S2 = ufl.dot(S, r0.r1), ufl.dot(S, r0.r2)
    S12 = ufl.dot(r0.r1, S2)
    return ufl.as_matrix([[ufl.dot(r0.r1, S1), S12], [S12, ufl.dot(r0.r2, S2)]])


def _values(value: Varying | None, r0: Array, n0: Array) -> Array:
    if value is None:
        return np.zeros_like(r0)
    assert not isinstance(value, Mapping | UserField)  # a model knows them in its cells
    return value(r0, n0) if callable(value) else np.broadcast_to(value, r0.shape)


def _is_anisotropic(curvature: Array) -> NDArray[np.bool_]:
    return np.asarray((curvature[..., 0] != curvature[..., 1]) | (curvature[..., 2] != 0))


def _tensor(components: Array, t1: Array, t2: Array) -> Array:
    """Return the tensor (..., 3, 3) with components S_11, S_22 and perhaps S_12 in a frame.

    Where it is isotropic it is S_22 times the unit tensor, exactly.
    """

    def product(a: Array, b: Array) -> Array:
        return np.asarray(a[..., :, None] * b[..., None, :])

    first, second = components[..., 0, None, None], components[..., 1, None, None]
    tensor = second * np.eye(3) + (first - second) * product(t1, t1)
    if components.shape[-1] == 3:
        tensor = tensor + components[..., 2, None, None] * (product(t1, t2) + product(t2, t1))
    return np.asarray(tensor)


def body_shape(
    natural: Natural, body: BodyMesh, V: fem.FunctionSpace, constants: dict[str, fem.Constant]
) -> Shape:
    """Return the natural shape of a solid; collective.

    Raises
    ------
    MeshError
        As `natural_field`, or if the body has no such patch.
    """
    natural = natural.on_cells(body.patches, len(body.layer_bounds))
    _, normals = body_positions_and_normals(V)
    Z = fem.functionspace(V.mesh, ("Lagrange", V.element.basix_element.degree, (1,)))
    z = body.at_nodes(Z, (body.heights - MIDSURFACE_HEIGHT) * body.thickness)[Z.dofmap.list]
    numbers = natural_field(natural, body_cell_geometry(V), V)
    Q = fem.functionspace(V.mesh, ("DG", V.element.basix_element.degree, (HEIGHT_AT + 1,)))
    field = fem.Function(Q, name="natural")
    rows = field.x.array.reshape(-1, HEIGHT_AT + 1)
    shell_numbers = numbers.x.array.reshape(-1, SIZE)[numbers.function_space.dofmap.list]
    rows[Q.dofmap.list] = np.concatenate([shell_numbers, normals, z[..., None]], axis=-1)
    return Shape.from_field(field, natural, constants)


def growth_in_body(shape: Shape, field: Expr, *amplitudes: Expr) -> Expr:
    """Return the growth tensor G in space at a point with values of field and amplitudes."""
    values = list(amplitudes)
    curvature_factor, stretch_factor = (
        values.pop(0) if p is not None else None for p in (shape.curvature, shape.stretch)
    )
    n, z = ufl.as_vector([field[NORMAL_AT + i] for i in range(3)]), field[HEIGHT_AT]
    n = n / ufl.sqrt(ufl.dot(n, n))
    normal_projection = ufl.outer(n, n)
    P = ufl.Identity(3) - normal_projection
    s, U = 1, P
    if stretch_factor is not None:
        s, U = (
            1 + stretch_factor * field[12],
            P + stretch_factor * ufl.dot(P, ufl.dot(_tensor_in_space(field, 6), P)),
        )
    if curvature_factor is not None:
        U = U - s * z * curvature_factor * ufl.dot(P, ufl.dot(_tensor_in_space(field, 0), U))
    return U + s * normal_projection


def _tensor_in_space(field: Expr, first: int) -> Expr:
    xx, yy, zz, xy, xz, yz = (field[first + i] for i in range(6))
    return ufl.as_matrix([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
