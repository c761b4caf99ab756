"""Integration domains of a shell: its mid-surface, or the meridian of what is closed around e3.

A domain gives the jets of fields, the measures of cells, of the edges between them and of the
boundary's edges, and the areas of cells there. So an energy is written as its density alone.

- A jet is a vector field's value with its first and second derivatives by two coordinates.
- r0 is the placement (the undeformed surface), u the displacement, v an addition to it.
- A covector m (2,) of an edge is zero along the edge and positive outward, in the coordinates of
  jets. The area of a cell at its edge, in the same coordinates, is per unit of the edge's
  parameter; the penalty of C0 elements has those of both sides.
- A wave varies as cos(m theta) or sin(m theta) around the axis e3.
- r0 changes if an imperfection grows. Volumes are then counted from the initial placement.

On a surface of revolution the coordinates are (s, theta), s the meridian's parameter; jets are
those at theta = 0. Their components are along (e_rho, e_theta, e_z), which turn with theta: e_rho'
= e_theta, e_theta' = -e_rho. In this order a_1 x a_2 points outward where s grows away from the
pole.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import basix
import basix.ufl
import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.shape_tables import ShapeTable
from magshell_fenicsx.models.shell import kinematics as kin
from magshell_fenicsx.models.shell.energy import Density, cell_quadrature, edge_quadrature
from magshell_fenicsx.models.shell.kinematics import Jet

Array = NDArray[np.float64]
Facets = NDArray[np.int32]


def revolved_jet(f: Expr) -> Jet:
    """Return the jet of the axisymmetric field U e_rho + W e_z, with f = (U, W) on the meridian."""
    return revolved_jet_of(_derivatives(f, 2))


def revolved_jet_of(derivatives: Sequence[Sequence[Expr]]) -> Jet:
    """Return the jet of the axisymmetric field U e_rho + W e_z, from f = (U, W) and derivatives.

    `derivatives` has the components of f, f' and f'', by the meridian's parameter s.
    """
    # by theta the vector e_rho turns: U e_rho has the derivatives U e_theta and -U e_rho
    (U, W), (Us, Ws), (Uss, Wss) = derivatives
    return Jet(
        r=_vector(U, 0, W),
        r1=_vector(Us, 0, Ws),
        r2=_vector(0, U, 0),
        r11=_vector(Uss, 0, Wss),
        r12=_vector(0, Us, 0),
        r22=_vector(-U, 0, 0),
    )


def wave_jets(f: Expr, m: Expr) -> tuple[Jet, Jet]:
    """Return jets of v = U cos(m theta) e_rho + V sin(m theta) e_theta + W cos(m theta) e_z.

    The unknowns are f = (P, V, W) with P = U + V, and m is the wave number. On the axis P = 0 for m
    = 1 (a translation has U = -V there); for every other m all three vanish.

    Returns
    -------
    cosine, sine
        Two jets: v = cosine.r cos(m theta) + sine.r sin(m theta), and so for each derivative.
    """
    return wave_jets_of(_derivatives(f, 3), m)


def wave_jets_of(derivatives: Sequence[Sequence[Expr]], m: Expr) -> tuple[Jet, Jet]:
    """Return the cosine and sine jets of a wave with the coefficients f = (P, V, W).

    `wave_jets` has their definition; `derivatives` has the components of f, f' and f'', by the
    meridian's parameter s.
    """
    # U = P - V
    (U, V, W), (Us, Vs, Ws), (Uss, Vss, Wss) = ((P - V, V, W) for P, V, W in derivatives)
    cosine = Jet(
        r=_vector(U, 0, W),
        r1=_vector(Us, 0, Ws),
        r2=_vector(0, U + m * V, 0),
        r11=_vector(Uss, 0, Wss),
        r12=_vector(0, Us + m * Vs, 0),
        r22=_vector(-(1 + m**2) * U - 2 * m * V, 0, -(m**2) * W),
    )
    sine = Jet(
        r=_vector(0, V, 0),
        r1=_vector(0, Vs, 0),
        r2=_vector(-m * U - V, 0, -m * W),
        r11=_vector(0, Vss, 0),
        r12=_vector(-m * Us - Vs, 0, -m * Ws),
        r22=_vector(0, -2 * m * U - (1 + m**2) * V, 0),
    )
    return cosine, sine


def _derivatives(f: Expr, components: int) -> list[list[Expr]]:
    """Return the components of f, f' and f'', derivatives by the meridian's parameter."""
    Df = ufl.grad(f)
    DDf = ufl.grad(Df)
    indices = range(components)
    return [[f[i] for i in indices], [Df[i, 0] for i in indices], [DDf[i, 0, 0] for i in indices]]


def _vector(*components: Expr) -> Expr:
    return ufl.as_vector(components)


@dataclass(frozen=True)
class Energy:
    """An energy as a function of the displacement's jet, so that waves may be added to it.

    Its attributes are otherwise those of a `Term` of the assembly.

    Attributes
    ----------
    form_of
        Energy on the domain as a function of the jet of u; the modelled part has
        `IntegrationDomain.revolution_factor` times as much.
    amplitude
        Name of the amplitude that multiplies the energy; None without one.
    linear
        Whether the energy is linear in the displacement.
    work
        Virtual work of a load without potential, a function of the jets of u and v, quadratic in u.
    density
        Density that is integrated; None for a load that is known by its vector.
    from_initial
        Whether it counts from the initial placement.
    reference_turn
        Of a moment: the turn (cosine and sine) from which its angle is counted, and -Pi of one
        radian. None for other energies.
    group, column
        Group and column of the `Term`; an empty group stands for the name.
    """

    name: str
    form_of: Callable[[Jet], ufl.Form]
    amplitude: str | None = None
    linear: bool = False
    work: Callable[[Jet, Jet], ufl.Form] | None = None
    density: Density | None = None
    from_initial: bool = False
    reference_turn: tuple[fem.Constant, float] | None = None
    group: str = ""
    column: str = ""

    def perturbed_form(self, u: Jet, v: Jet) -> ufl.Form:
        """Return a form whose Hessian in v, at v = 0, is that of the energy of u + v.

        A virtual work may have no potential, and its derivative by u then is not symmetric: the
        Hessian is the symmetric part.
        """
        if self.work is None:
            return self.form_of(u + v)
        return 0.25 * (self.work(u + v, v) - self.work(u - v, v))


@dataclass(frozen=True)
class HeldEdge:
    """Edges that hold the normal, or lie on a mirror plane.

    Attributes
    ----------
    facets
        Local numbers of the edges.
    plane
        Normal of the mirror plane; None for a clamped edge.
    turn
        The rotation of a clamped edge that moves; None if it does not move.
    """

    facets: Facets
    plane: fem.Constant | None = None
    turn: fem.Constant | None = None


@dataclass(frozen=True)
class IntegrationDomain:
    """Domain of a shell's integrals: the mid-surface, or its meridian, with the placement r0 on it.

    Attributes
    ----------
    r0
        The placement.
    jet
        Function from a field of the placement's space to its value and derivatives.
    covector
        Covector m (2,) of an edge.
    cell_area
        Area of a cell in the coordinates of jets, per unit of the parameter of its edge.
    rule, edge_rule, contact_rule
        Degrees of the quadrature on cells, along edges (None where these are points) and under
        contact.
    tables
        Function of the placement's space and of points in the reference cell, which must not be
        singular ones. It returns a function from nodal values, with ghosts, to jets (6, cells,
        points, 3).
    variant
        Lagrange variant of discontinuous fields, with nodes where the coordinates are regular.
    revolution_factor
        Factor of integrals: 2 pi on a meridian, where they are per radian; else 1.
    initial_placement
        Placement that volumes count from; None for r0.
    """

    r0: fem.Function
    jet: Callable[[Expr], Jet]
    covector: Expr
    cell_area: Expr
    rule: int
    edge_rule: int | None
    contact_rule: int
    tables: Callable[[fem.FunctionSpace, Array], Callable[[Array], Array]]
    variant: basix.LagrangeVariant
    revolution_factor: float = 1.0
    initial_placement: fem.Function | None = None

    @property
    def mesh(self) -> mesh.Mesh:
        return self.r0.function_space.mesh

    @property
    def j0(self) -> Jet:
        """Jet of the placement."""
        return self.jet(self.r0)

    def discontinuous(self, size: int) -> fem.FunctionSpace:
        """Return the space of discontinuous fields of `size` numbers, of the placement's degree."""
        cell, degree = self.mesh.basix_cell(), self.r0.function_space.element.basix_element.degree
        return fem.functionspace(
            self.mesh,
            basix.ufl.element("DG", cell, degree, lagrange_variant=self.variant, shape=(size,)),
        )

    def constant(self, value: float | NDArray[np.float64]) -> fem.Constant:
        """Return a number or a vector as a constant of forms on the domain."""
        return fem.Constant(self.mesh, value)

    def dx(self, rule: int | None = None) -> ufl.Measure:
        """Return the measure of the cells, in the surface's coordinates.

        `rule` is the degree of the quadrature; None for that of the domain.
        """
        return ufl.Measure(
            "dx", domain=self.mesh, metadata={"quadrature_degree": rule or self.rule}
        )

    def dS(self) -> ufl.Measure:
        """Return the measure of the edges between cells."""
        return ufl.Measure("dS", domain=self.mesh, metadata=self._along_edges)

    def ds(self, facets: Facets) -> ufl.Measure:
        """Return the measure of some edges of the boundary."""
        return self.measures_on([facets])[0]

    def measures_on(self, facet_groups: Sequence[Facets]) -> list[ufl.Measure]:
        """Return a measure for each group of boundary edges; groups do not overlap.

        A form may have only one measure of the boundary: so all are parts, with numbers from 1, of
        one tagged measure.
        """
        facets = np.concatenate(facet_groups)
        # the number of each facet's group
        numbers = np.repeat(
            np.arange(1, len(facet_groups) + 1),
            [len(facets_of_group) for facets_of_group in facet_groups],
        )
        order = np.argsort(facets)  # tags must be sorted by facets
        tags = mesh.meshtags(
            self.mesh, self.mesh.topology.dim - 1, facets[order], numbers[order].astype(np.int32)
        )
        ds = ufl.Measure("ds", domain=self.mesh, subdomain_data=tags, metadata=self._along_edges)
        return [ds(number) for number in range(1, len(facet_groups) + 1)]

    @property
    def _along_edges(self) -> dict[str, int]:
        """Metadata of measures along edges; empty on a meridian, where edges are points."""
        return {} if self.edge_rule is None else {"quadrature_degree": self.edge_rule}

    def over_area(self) -> Callable[[Expr], ufl.Form]:
        """Return a function from an expression to its integral over the undeformed area."""
        ratio = kin.area_ratio(self.j0)
        return lambda f: f * ratio * self.dx()

    def length(self, facets: Facets) -> ufl.Form:
        """Return the undeformed length of some edges."""
        _, _, stretch = kin.conormal(self.j0, self.covector)
        return stretch * self.ds(facets)

    def jets_from_initial(self, u: Jet) -> tuple[Jet, Jet]:
        """Return the jets of the initial placement and of the displacement from there to r0 + u."""
        if self.initial_placement is None:
            return self.j0, u
        initial = self.jet(self.initial_placement)
        return initial, self.j0 + u - initial

    def measure(self, density: Density) -> ufl.Measure:
        """Return the measure of the cells or edges on which a density is integrated.

        A form may have only one measure of the same edges.
        """
        if density.sides == 2:
            return self.dS()
        return self.dx(density.quadrature) if density.facets is None else self.ds(density.facets)

    def value(self, density: Density, u: Jet, *, from_initial: bool = False) -> Expr:
        """Return the value of a density at the displacement's jet u.

        With `from_initial` a density on cells counts the displacement from the initial placement.
        On interior edges the density takes pairs of jets, covectors, areas and fields, '+' first.
        """
        r0 = self.j0
        if density.sides == 2:
            pairs = ((j.side("+"), j.side("-")) for j in (r0, u))
            m, areas = ((f("+"), f("-")) for f in (self.covector, self.cell_area))
            # only fields differ on the two sides, constants do not
            sided = [
                (p("+"), p("-")) if isinstance(p, fem.Function) else p for p in density.parameters
            ]
            return density.function(*pairs, m, areas, *sided)
        if density.facets is not None:
            return density.function(r0, u, self.covector, self.cell_area, *density.parameters)
        return density.function(
            *(self.jets_from_initial(u) if from_initial else (r0, u)), *density.parameters
        )

    def integral(self, density: Density, u: Jet) -> ufl.Form:
        """Return the integral of a density at the displacement's jet u."""
        return self.value(density, u) * self.measure(density)

    def energy(
        self,
        name: str,
        density: Density,
        amplitude: str | None = None,
        *,
        from_initial: bool = False,
        **attributes: Any,
    ) -> Energy:
        """Return the energy of a density as a function of the displacement's jet.

        `amplitude` is the name of the load parameter that multiplies it; None for the factor 1.
        With `from_initial` the displacement counts from the initial placement. Further `attributes`
        are those of `Energy`, such as `linear` or `group`.
        """
        virtual_work, measure = density.work, self.measure(density)

        def form_of(u: Jet) -> ufl.Form:
            """Return the integral of the density at the displacement's jet u."""
            return self.value(density, u, from_initial=from_initial) * measure

        def work(u: Jet, v: Jet) -> ufl.Form:
            """Return the integral of the virtual work along the jet v, at the jet u."""
            assert virtual_work
            return virtual_work(self.j0, u, v, *density.parameters) * measure

        return Energy(
            name,
            form_of,
            amplitude,
            work=work if virtual_work else None,
            density=density,
            from_initial=from_initial,
            **attributes,
        )


def surface_domain(
    r0: fem.Function, initial_placement: fem.Function | None = None
) -> IntegrationDomain:
    """Return the domain of a mid-surface, a mesh of triangles with the placement r0."""
    mesh_of_surface, degree = r0.function_space.mesh, r0.function_space.element.basix_element.degree
    return IntegrationDomain(
        r0,
        lambda f: kin.jet(f, mesh_of_surface),
        kin.facet_covector(mesh_of_surface),
        ufl.CellVolume(mesh_of_surface) / ufl.FacetArea(mesh_of_surface),
        rule=cell_quadrature(degree),
        edge_rule=edge_quadrature(degree),
        contact_rule=3 * degree,  # the pressure at the rim of a contact is narrower than an element
        tables=_tables_on_surface,
        variant=basix.LagrangeVariant.gll_warped,
        initial_placement=initial_placement,
    )


def meridian_domain(
    r0: fem.Function, initial_placement: fem.Function | None = None
) -> IntegrationDomain:
    """Return the domain of a meridian, a mesh of intervals with the placement r0 = (rho, z)."""
    mesh_of_meridian = r0.function_space.mesh
    degree = r0.function_space.element.basix_element.degree
    return IntegrationDomain(
        r0,
        revolved_jet,
        ufl.as_vector(
            [ufl.FacetNormal(mesh_of_meridian)[0], 0]
        ),  # the length of an edge is then that per radian
        ufl.CellVolume(mesh_of_meridian) / 2,  # per radian, of a triangle
        rule=2 * degree
        + 2,  # one point more than the surface's: on the axis the densities are rational
        edge_rule=None,
        contact_rule=6 * degree,  # points are cheap here
        tables=_tables_on_meridian,
        variant=basix.LagrangeVariant.gl_isaac,  # inside: on the axis the coordinates are singular
        revolution_factor=2 * np.pi,
        initial_placement=initial_placement,
    )


def _tables_on_surface(V: fem.FunctionSpace, points: Array) -> Callable[[Array], Array]:
    """Return a function from nodal values to jets on a mid-surface.

    `points` (n, 2) are in the reference triangle; jets are (6, cells, n, 3), by its coordinates.
    """
    table, nodes = ShapeTable.tabulate(V.element.basix_element, points), V.dofmap.list
    return lambda nodal: np.asarray(np.moveaxis(table.jets(nodal.reshape(-1, 3)[nodes]), 2, 0))


def _tables_on_meridian(V: fem.FunctionSpace, points: Array) -> Callable[[Array], Array]:
    """Return a function from nodal values (U, W) to jets on a meridian, at azimuth zero.

    `points` (n, 1) are in [0, 1]. Jets are (6, cells, n, 3), along (e_rho, e_theta, e_z), by the
    coordinate of the reference cell and the azimuth.
    """
    shapes, nodes = V.element.basix_element.tabulate(2, points)[..., 0], V.dofmap.list

    def jets_of(nodal: Array) -> Array:
        """Return jets (6, cells, n, 3) from nodal values (U, W) of all local nodes."""
        derivatives = np.einsum("dpn,cni->dcpi", shapes, nodal.reshape(-1, 2)[nodes])
        (U, W), (Us, Ws), (Uss, Wss) = np.moveaxis(derivatives, -1, 1)
        jet_components = [(U, 0, W), (Us, 0, Ws), (0, U, 0), (Uss, 0, Wss), (0, Us, 0), (-U, 0, 0)]
        return np.array(
            [np.stack(np.broadcast_arrays(*vector), axis=-1) for vector in jet_components]
        )

    return jets_of
