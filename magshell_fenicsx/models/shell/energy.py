"""A term of the shell: the density as a function of point quantities, its parameters, its form.

- A density is an energy per area of the coordinates, or per unit of an edge's parameter, as a
  function of jets: a field's value with its first and second derivatives by two coordinates.
- r0 is the placement, u the displacement, v a virtual displacement or an addition to u.
- m is the covector (2,) of an edge: zero along it and positive outward. The area is that of a
  cell in the coordinates, per unit of the edge's parameter.
- A side is one of the cells beside a point: two on an interior edge, else one.
- A load without potential, as a live pressure, has a virtual work in place of an energy.
- A term is an energy in a sum, multiplied by its amplitude: a load parameter, by name.
- A free parameter is a number in densities that can be varied as a load parameter can.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, TypeAlias

import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import NDArray
from petsc4py import PETSc
from ufl import Coefficient
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.memo import PointField
from magshell_fenicsx.assembly.terms import AngleTerm, DensityTerm
from magshell_fenicsx.mesh.patch import MeshError, UserField
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.kinematics import FIRST_DERIVATIVES, Jet
from magshell_fenicsx.models.shell.law import Law
from magshell_fenicsx.models.shell.own_term import FormulaParameter, Free, OwnTerm
from magshell_fenicsx.platform import compat

Parameter: TypeAlias = fem.Constant | fem.Function
Constants = dict[str, fem.Constant]


@dataclass(frozen=True)
class Density:
    """An energy as a function of point quantities.

    Both its form and its derivatives at points are made from it.

    Attributes
    ----------
    function
        The density as a function: on cells of (r0, u, *parameters), per area of the coordinates; on
        boundary edges of (r0, u, m, area, *parameters), see `edges`; on interior edges the same
        with pairs of jets, covectors and areas.
    parameters
        Numbers, or fields that vary over the surface; on interior edges `function` takes a field as
        a pair.
    parts
        Parts of the displacement's jet that the density depends on.
    linear
        Parts among these in which it is linear, all together.
    facets
        Boundary edges on which it is integrated; None for cells and interior edges.
    sides
        Number of cells beside a point: 2 on interior edges, else 1.
    work
        Virtual work of a load without potential, on cells: a function of (r0, u, v, *parameters),
        linear in v.
    quadrature
        Degree of the quadrature on cells; None for `cell_quadrature`.
    reference_parts
        Parts of the placement's jet that it depends on besides `parts`.
    """

    function: Callable[..., Expr]
    parameters: tuple[Parameter, ...]
    parts: tuple[str, ...] = FIRST_DERIVATIVES
    linear: tuple[str, ...] = ()
    facets: NDArray[np.int32] | None = None
    sides: int = 1
    work: Callable[..., Expr] | None = None
    quadrature: int | None = None
    reference_parts: tuple[str, ...] = ()

    @property
    def jet_parts(self) -> tuple[str, ...]:
        """Parts of jets that must be known: first the displacement's, then the placement's."""
        return *self.parts, *self.reference_parts

    @property
    def on_edges(self) -> bool:
        """Whether it is integrated over edges."""
        return self.facets is not None or self.sides == 2

    def value_at(
        self,
        jets: Sequence[Sequence[Jet]],
        edge: tuple[Sequence[Expr], Sequence[Expr]] | None,
        parameters: Sequence[Parameter],
    ) -> Expr:
        """Return the value of the density, or of its virtual work, at given jets.

        Parameters
        ----------
        jets
            For each argument (r0, u, ...) its jets on every side. If there is a third one, v, a
            load without potential returns its virtual work along v; else the density is returned.
        edge
            The covectors and the areas of all sides; None on cells.
        parameters
            Values of the parameters. With two sides, a field that varies holds the values of both,
            one after the other.
        """
        # arguments in the order of `function`: jets, then on edges covectors and areas, each a
        # pair of both sides, or the value of the only one; then parameters
        sided = [
            tuple(side_values) if self.sides == 2 else side_values[0]
            for side_values in (*jets, *(edge or ()))
        ]
        fields = [
            _halves(p) if self.sides == 2 and isinstance(p, fem.Function) else p for p in parameters
        ]
        density = self.work if self.work and len(jets) == 3 else self.function
        return density(*sided, *fields)


def _halves(field: fem.Function) -> tuple[Expr, Expr]:
    """Return the vectors of both sides from a point field that holds one after the other."""
    size = field.ufl_shape[0] // 2
    first = ufl.as_vector([field[c] for c in range(size)])
    second = ufl.as_vector([field[size + c] for c in range(size)])
    return first, second


def per_area(density: Callable[..., Expr]) -> Callable[..., Expr]:
    """Turn a density per undeformed area into one per area of the coordinates."""

    def density_per_coordinates(r0: Jet, *rest: Any, **options: Any) -> Expr:
        """Return the density times the area of the surface per area of the coordinates."""
        return density(r0, *rest, **options) * kin.area_ratio(r0)

    return density_per_coordinates


def cell_quadrature(degree: int) -> int:
    """Return the degree of the rule on cells, for elements of a degree."""
    return 2 * degree


def edge_quadrature(degree: int) -> int:
    """Return the degree of the rule on edges, for elements of a degree.

    It is two below that of the cells: the force at a deflection of 20 h changes by 2e-5, and the
    edges cost a fifth less.
    """
    return 2 * degree - 2


class AtPoints(Protocol):
    """Computes energies without forms, see `residual.FastResidual`."""

    def energy(self, name: str) -> float:
        """Return the energy of a term on this rank's part, at the present u.

        The first call is collective: kernels are compiled.
        """


class ShellTerm(DensityTerm[Density]):
    """A term of a shell; its energy comes from points where these are known."""

    points: AtPoints | None = None

    @cached_property
    def _point_fields(self) -> list[PointField]:  # those of the form, which may not be needed
        return [field for field in self.density.parameters if isinstance(field, PointField)]

    def energy(self) -> float:
        return self.points.energy(self.name) if self.points else super().energy()


class MomentTerm(AngleTerm, ShellTerm):
    """A moment on an edge of a shell."""


class HessianTerm:
    """A term that contributes only a tangent: the Hessian in v, at v = 0, of an energy of u and v.

    It serves antisymmetric modes v of a half model, whose displacement u is symmetric.

    Parameters
    ----------
    name
        Name of the term.
    density
        Its density, which takes the jet of v after that of u.
    energy
        The same as a form.
    v
        The function that stands for v in the form.
    log
        Log of compiled kernels.
    """

    amplitude = None
    linear = False

    def __init__(
        self, name: str, density: Density, energy: ufl.Form, v: fem.Function, log: KernelLog
    ) -> None:
        self.name, self.density = name, density
        self.group, self.column = name, ""
        self._energy, self._v, self._log = energy, v, log

    @cached_property
    def tangent_form(self) -> fem.Form:
        """Form of the tangent; it takes long to compile, which is done at the first use."""
        V = self._v.function_space
        gradient = ufl.derivative(self._energy, self._v, ufl.TestFunction(V))
        hessian = ufl.derivative(gradient, self._v, ufl.TrialFunction(V))
        return self._log.compile(f"{self.name} tangent", hessian)

    def energy(self) -> float:
        return 0.0

    def compile_residual(self) -> None:
        """Compile nothing: the term has no residual."""

    def add_residual(self, b: NDArray[np.float64], factor: float) -> None:
        """Add nothing: symmetric states are in equilibrium with antisymmetric forces."""

    def compile_tangent(self) -> None:
        _ = self.tangent_form

    def add_tangent(self, K: PETSc.Mat, factor: float, clamped: list[fem.DirichletBC]) -> None:
        """Add the tangent to K; `factor` is not used, since the term has no amplitude."""
        compat.add_matrix(K, self.tangent_form, clamped)


def constants_of(
    term: OwnTerm, domain: mesh.Mesh, constants: Constants
) -> tuple[fem.Constant | fem.Function, ...]:
    """Return the parameters of a term as constants or functions on a mesh.

    A free parameter has the same constant in all terms: it is taken from `constants` by its name,
    or added there. Formulas must have been replaced by functions before.

    Raises
    ------
    MeshError
        If a parameter is a function on another mesh.
    """

    def constant(value: float | NDArray[np.float64]) -> fem.Constant:
        """Return a number or a vector as a constant on the mesh."""
        return fem.Constant(domain, np.asarray(value, dtype=float))

    def constant_or_field(
        p: float | NDArray[np.float64] | Free | UserField | FormulaParameter | Coefficient,
    ) -> fem.Constant | fem.Function:
        """Return a parameter as a constant, or unchanged if it is a function on this mesh."""
        if isinstance(p, Free):
            return constants.setdefault(p.name, constant(p.value))
        if (
            isinstance(p, Coefficient)
            and p.ufl_function_space().ufl_domain() == domain.ufl_domain()
        ):
            return p
        if isinstance(p, Coefficient | UserField):
            raise MeshError(
                f"terms: {term.name}: a function on a mesh: that is of a problem whose shell is on "
                "this mesh, "
                "see ms.Shell"
            )
        assert not isinstance(p, FormulaParameter)  # a model has made a function of it
        return constant(p)

    return tuple(constant_or_field(p) for p in term.parameters)


def elastic_density(
    density: Density,
    law: Law,
    thickness: Parameter | None = None,
    cell_materials: Parameter | None = None,
) -> Density:
    """Return a density whose law is made of parameters, from one that takes a keyword `law`.

    The numbers of the law are appended to the density's parameters, then the fields. So other
    numbers need no new kernel. On interior edges the given density takes a pair of laws.

    Parameters
    ----------
    density
        The density, whose function has the keyword `law`.
    law
        The law.
    thickness
        Field (1,) that multiplies the thickness; None for 1.
    cell_materials
        Field (4,) of `ShellMaterial.numbers` (modulus, nu, density, number of the law); None for
        one material.
    """

    def by_side(value: Any) -> Sequence[Any]:
        """Return a field's values on all sides as a sequence; of one side a bare value is given."""
        return value if density.sides == 2 else [value]

    def with_law(*arguments: Expr, **keywords: Any) -> Expr:
        """Return the density's value.

        The arguments are first the density's own, then the numbers of the law, then thickness and
        materials if there are such fields.
        """
        # fields are taken off from the end: the materials on all sides, then the thickness; what is
        # left ends with the numbers of the law
        arguments_left, factors, materials = list(arguments), [1] * density.sides, None
        if cell_materials is not None:
            materials = by_side(arguments_left.pop())
        if thickness is not None:
            factors = [factor[0] for factor in by_side(arguments_left.pop())]
        count = len(arguments_left) - len(law.numbers)
        own_arguments, numbers = arguments_left[:count], arguments_left[count:]
        laws = [law.with_numbers(*numbers).thicker(factor) for factor in factors]  # on each side
        if materials is not None:
            # components 0, 1 and 3 are modulus, nu and number of the law; the density is not used
            laws = [
                side_law.with_material(material[0], material[1], material[3])
                for side_law, material in zip(laws, materials, strict=True)
            ]
        law_argument = tuple(laws) if density.sides == 2 else laws[0]
        return density.function(*own_arguments, law=law_argument, **keywords)

    fields = (field for field in (thickness, cell_materials) if field is not None)
    parameters = (*density.parameters, *law.numbers, *fields)
    return replace(
        density,
        function=with_law,
        parameters=parameters,
        reference_parts=("r",) if law.depends_on_place else density.reference_parts,
    )
