"""Terms of a solid, each integrated from one density over a body or its faces.

`TermFactory` makes a term only when a scene asks for it; its kernel is compiled once. Lengths are
over R, energies over E h R²; h is the thickness, R the reference length. Densities per volume are
over E, so functions divide them by h.

X is the undeformed place, u the displacement, H = grad u, and v a test function. A body has an
outer face, and an end above each edge of its mid-surface. An end is hinged where only its middle
line is held. Layers are the surfaces through the thickness; their undeformed normals are n0. A
density is a function of X, u, H and parameters: constants, or fields on the mesh. An amplitude is a
load parameter, by name; a term with an amplitude is multiplied by it. `group` and `column` of a
term name its group of terms and its column in reported energies. A field "in space" is an applied
flux density known by its values at displaced places, as of a magnet.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import basix
import numpy as np
import ufl
from dolfinx import fem
from numpy.typing import NDArray
from ufl.core.expr import Expr

from magshell_fenicsx.assembly.kernels import KernelLog
from magshell_fenicsx.assembly.memo import PointField, at_quadrature
from magshell_fenicsx.assembly.terms import AngleTerm, DensityTerm
from magshell_fenicsx.mesh.hexahedra import (
    MIDSURFACE_HEIGHT,
    OUTER_FACE,
    QUADRATURE_DEGREE,
    BodyMesh,
    face_measure,
)
from magshell_fenicsx.models.shell.energy import Constants, constants_of, per_area
from magshell_fenicsx.models.shell.kinematics import ALL_DERIVATIVES, SECOND_DERIVATIVES, Jet
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.models.shell.spatial_fields import field_in_body, radial
from magshell_fenicsx.models.solid import body_densities
from magshell_fenicsx.models.solid.body_densities import CompressibleRubber
from magshell_fenicsx.parts.magnetism import rotation_on_solid as rotation_law
from magshell_fenicsx.parts.magnetism.applied import AppliedField
from magshell_fenicsx.parts.magnetism.fields import FIELD
from magshell_fenicsx.parts.magnetism.magnetised import Magnetisation
from magshell_fenicsx.parts.magnetism.saturation import SIZE
from magshell_fenicsx.parts.magnetism.soft_magnet import TERM, Sheet, SoftMagnet

REDUCED_QUADRATURE_DEGREE = 3  # quadrature degree: two points in each direction
# parts of a displacement's jet: value; reference derivatives; value and derivatives on a face
VALUE, GRADIENT, ON_FACE = (
    (0,),
    (1, 2, 3),
    (0, 1, 2),
)
Array = NDArray[np.float64]
Facets = NDArray[np.int32]
HEIGHT_TOLERANCE = 1e-9  # rounding of heights, 0 on the inner to 1 on the outer face


@dataclass(frozen=True)
class SolidDensity:
    """A density of a solid: the one source of a term's form and of its Hessians at points.

    Attributes
    ----------
    function
        The density as a function: in the body of (X, u, H, *parameters) per volume; on its outer
        face of (X, X1, X2, u, u1, u2, *parameters) per area of the
        reference cell; on ends, the faces above edges, of (X, u, H, n, t, *parameters) per area.
    parameters
        Numbers, or fields of vectors.
    parts
        Parts of the displacement's jet that it depends on: 0 the value, 1 to 3 the reference
        derivatives.
    degree
        Degree of the quadrature.
    region
        Where it is integrated: the body, its outer face, or ends.
    facets
        Local facets that it is integrated on, of faces.
    upper
        Whether it is integrated on the outer half of these facets alone: of a cell through which
        the middle line passes.
    work
        Virtual work of a load without potential, on faces; it takes v before the parameters.
    """

    function: Callable[..., Expr]
    parameters: tuple[fem.Constant | fem.Function, ...]
    parts: tuple[int, ...] = GRADIENT
    degree: int = QUADRATURE_DEGREE
    region: Literal["body", "outer", "end"] = "body"
    facets: Facets = field(default_factory=lambda: np.empty(0, dtype=np.int32))
    upper: bool = False
    work: Callable[..., Expr] | None = None

    @property
    def rule(self) -> tuple[Array, Array]:
        """Points on the reference facet, and their weights."""
        points, weights = basix.make_quadrature(basix.CellType.quadrilateral, self.degree)
        if self.upper:  # the second coordinate goes through the thickness
            return ((points + np.eye(2)[1]) / [1.0, 2.0], weights / 2)
        return (points, weights)


class SolidTerm(DensityTerm[SolidDensity]):
    """A term of a solid, with a `SolidDensity`."""


class EndMoment(AngleTerm, SolidTerm):
    """A moment on an end of a solid, whose work is counted by the turned angle."""


def unchanged(density: SolidDensity) -> SolidDensity:
    """Return the density as it is: the default of a body that grows nowhere."""
    return density


@dataclass(frozen=True)
class TermFactory:
    """Factory of the terms of one body.

    Attributes
    ----------
    body
        Mesh of the body with its named faces.
    u
        Displacement over R.
    material
        Elastic law, with its moduli over E.
    h
        Thickness over R.
    log
        Log that compiles forms, with their names and compile times.
    hinged
        Ends whose middle line alone is held.
    grown
        Function from a density to the same one on the body's natural shape, that without stress.
    free_constants
        Constants of the free parameters, by name.
    fields
        Applied fields, known by values, that were made.
    saturated
        Magnetisation state of a soft material that saturates: empty, or one field that was made.
    """

    body: BodyMesh
    u: fem.Function
    material: CompressibleRubber
    h: float
    log: KernelLog
    hinged: tuple[str, ...] = ()
    grown: Callable[[SolidDensity], SolidDensity] = unchanged
    free_constants: Constants = field(default_factory=dict)
    fields: list[AppliedField] = field(default_factory=list)
    saturated: list[PointField] = field(default_factory=list)

    def distortion(self) -> SolidTerm:
        """Return the term of distortion without change of volume."""
        material = self.material
        parameters = self._constants(material.shear, self.h, *material.energy.constants)
        density = partial(body_densities.distortion, energy=material.energy.function)
        return self._bulk("distortion", self.grown(SolidDensity(density, parameters)))

    def compression(self) -> SolidTerm:
        """Return the term of volume change, kappa/2 (J - 1)^2, with reduced quadrature.

        Two points in each direction: more constraints on J would lock the element. It is the same
        as a discontinuous trilinear pressure, eliminated (Malkus and Hughes, Comput. Methods Appl.
        Mech. Eng. 15, 1978). So the tangent is that of displacements alone and its inertia tells
        stability.
        """
        parameters = self._constants(self.material.bulk, self.h)
        return self._bulk(
            "compression",
            self.grown(
                SolidDensity(
                    body_densities.compression, parameters, degree=REDUCED_QUADRATURE_DEGREE
                )
            ),
        )

    def magnetic(self, field: Magnetisation) -> list[SolidTerm]:
        """Return the terms of a remanence and of a soft magnet in the applied field.

        The remanence's terms are linear in the field, whose strength is their amplitude. A field in
        space is known by its values at the displaced places; it is added to `fields`.
        """
        applied = None
        if field.in_space:
            # the place itself as a function
            X = fem.Function(self.u.function_space)
            X.interpolate(lambda x: x)
            applied = AppliedField(field.in_space, X, self.u, QUADRATURE_DEGREE, field.driven)
            self.fields.append(applied)
        if field.soft is None:
            return self.remanent(field, applied)
        # a soft magnet alone has no remanence
        return [
            *([] if field.soft.alone else self.remanent(field, applied)),
            self.soft_magnetic(field, field.soft, applied),
        ]

    def soft_magnetic(
        self, field: Magnetisation, soft_magnet: SoftMagnet, applied: AppliedField | None
    ) -> SolidTerm:
        """Return the term of a soft-magnetic body in the applied field.

        It is quadratic in the amplitudes of the field, or saturates. So no amplitude multiplies it
        as a whole: they are free parameters within it. `applied` is a field known by its values,
        else None.
        """
        sheet, (scale, h) = Sheet(field), self._constants(soft_magnet.scale, self.h)
        # susceptibility or magnetisation state, normals, and the numbers of the field
        law, n0, *parameters = self._sheet_parameters(sheet, soft_magnet, applied)
        density = SolidDensity(
            sheet.energy_in_solid, (law, scale, n0, h, *parameters), VALUE + GRADIENT
        )
        return self._bulk(TERM, density, group="magnetic", column="magnetic")

    def induced(self, field: Magnetisation) -> dict[str, ufl.Form]:
        """Return the forms that give the mean induced polarisation.

        Returns
        -------
        dict[str, ufl.Form]
            "induced x", "induced y" and "induced z": integrals of the polarisation over the
            undeformed volume of the modelled part. "induced volume": that volume. Empty without a
            soft material.
        """
        if field.soft is None:
            return {}
        # `magnetic`, called before, added the field in space last
        sheet, applied = Sheet(field), self.fields[-1] if field.in_space else None
        # susceptibility or magnetisation state, normals, and the numbers of the field
        law, n0, *parameters = self._sheet_parameters(sheet, field.soft, applied)
        densities = {"volume": SolidDensity(lambda X, u, H, one: one, self._constants(1.0))}
        for axis, e in zip("xyz", np.eye(3), strict=True):
            densities[axis] = SolidDensity(
                sheet.induced_in_solid, (law, *self._constants(e), n0, *parameters)
            )
        return {f"induced {name}": self._over_body(density) for name, density in densities.items()}

    def _sheet_parameters(
        self, sheet: Sheet, soft_magnet: SoftMagnet, applied: AppliedField | None
    ) -> "list[fem.Constant | fem.Function]":
        """Return the parameters of a soft-magnetic body's densities, in the order they take them.

        First the susceptibility, or the magnetisation state where the material saturates. Then the
        undeformed normals of layers, the amplitudes of the field and the vectors that these
        multiply. Last the polynomial of a field in space.
        """
        chi, V = soft_magnet.susceptibility, self.u.function_space
        if callable(chi):  # a function of the place
            law = field_in_body(
                chi, V, name="susceptibility", key="magnetic.susceptibility", size=1
            )
        else:
            law = self._constants(chi)[0]
        n0 = field_in_body(radial, V, name="n0")
        amplitudes = [
            self.free_constants.setdefault(name, self._constants(0.0)[0])
            for name in sheet.amplitudes
        ]
        polynomials = [applied.polynomial] if applied else []
        if soft_magnet.saturation is not None:
            if not self.saturated:  # the energy and the observed forms share the state
                self.saturated.append(self._saturated(sheet, law, n0, amplitudes, applied))
            law = self.saturated[0]
        return [law, n0, *amplitudes, *self._constants(*sheet.vectors), *polynomials]

    def _saturated(
        self,
        sheet: Sheet,
        chi: fem.Constant | fem.Function,
        n0: fem.Function,
        amplitudes: Sequence[fem.Constant],
        applied: AppliedField | None,
    ) -> PointField:
        """Return the magnetisation state of a saturating material at the quadrature points.

        The state holds two Taylor polynomials of the energy in the field, at u and at u = 0. It is
        computed again when the places, u or the field have changed.

        Parameters
        ----------
        chi
            The susceptibility.
        n0
            Undeformed normals of layers.
        amplitudes
            Amplitudes of the field.
        applied
            The field if it is known by its values, else None.
        """
        V = self.u.function_space
        saturation, X = PointField(V.mesh, QUADRATURE_DEGREE, 2 * SIZE), fem.Function(V)
        X.interpolate(lambda x: x)
        table = V.element.basix_element.tabulate(1, saturation.points)[..., 0]
        followed = (X, self.u)  # functions with whose values the state changes
        normals = at_quadrature(n0, saturation.points)

        def places_and_normals() -> list[Array]:
            """Return undeformed places, displacements, and present and undeformed normals."""
            # (4, cells, points, 3): values, then reference derivatives
            x0, u = (
                np.einsum("dqk,cki->dcqi", table, f.x.array.reshape(-1, 3)[V.dofmap.list])
                for f in followed
            )
            # derivatives of X and of u by the reference coordinates, as columns
            G, H = (np.moveaxis(jet[1:], 0, -1) for jet in (x0, u))
            F = np.eye(3) + H @ np.linalg.inv(G)
            # the present normal is along cof F n0, and so along F^-T n0
            n = np.linalg.solve(np.swapaxes(F, -1, -2), normals[..., None])[..., 0]
            return [x0[0], u[0], n / np.linalg.norm(n, axis=-1, keepdims=True), normals]

        return sheet.saturated(chi, amplitudes, applied, saturation, followed, places_and_normals)

    def remanent(self, field: Magnetisation, applied: AppliedField | None) -> list[SolidTerm]:
        """Return the terms of a remanence, linear in the applied field with its amplitudes.

        A field known by its values (`applied`) has one term. Otherwise each uniform direction of
        the field has its own amplitude, and a field gradient one more term.
        """
        pattern = field.remanent
        # the module with the densities of the law
        law = body_densities if field.law == "deformation" else rotation_law
        if callable(pattern):  # a function of the place
            Br = field_in_body(pattern, self.u.function_space)
        else:
            Br = self._constants(pattern)[0]
        if applied:
            density = SolidDensity(
                law.magnetic_in_space,
                (Br, applied.polynomial, *self._constants(self.h)),
                VALUE + GRADIENT,
            )
            return [self._bulk("magnetic", density, FIELD.name, column="magnetic")]
        terms = []
        for amplitude, suffix, Ba in field.uniform_parts:
            density = SolidDensity(law.magnetic, (Br, *self._constants(Ba, self.h)))
            term = self._bulk(
                "magnetic" + suffix,
                density,
                amplitude,
                linear=law is body_densities,  # a rotating remanence is not linear in u
                group="magnetic",
                column="magnetic",
            )
            terms.append(term)
        if field.gradient is not None:
            density = SolidDensity(
                law.magnetic_gradient,
                (Br, *self._constants(field.gradient, self.h)),
                VALUE + GRADIENT,
            )
            terms.append(self._bulk("magnetic gradient", density, FIELD.name, column="magnetic"))
        return terms

    def pressure(self, classical: float, *, potential: bool = True) -> list[SolidTerm]:
        """Return the terms of a live pressure with the amplitude p/p_c.

        It acts on the outer face and above the middle line of hinged ends.

        Parameters
        ----------
        classical
            p_c/E.
        potential
            Whether the load has a potential; otherwise its virtual work takes the place of the
            gradient.
        """
        v = None if potential else ufl.TestFunction(self.u.function_space)
        # the volume that points sweep from their undeformed places; p_c over E h/R is the unit
        densities = self._volume_densities(classical / self.h, origin=None, potential=potential)
        return [
            SolidTerm(
                name,
                density,
                self._on_faces([density]),
                self.u,
                self.log,
                "pressure",
                work=None if v is None else self._on_faces([density], v),
            )
            for name, density in densities.items()
        ]

    def user_term(self, term: OwnTerm, amplitude: str | None = None) -> SolidTerm:
        """Return a user's term, or one that a part of the package adds.

        It is integrated over the body's volume or on its outer face (`term.of_volume`). `amplitude`
        takes the place of the term's name as its amplitude.
        """
        assert term.density  # a term without a density only observes
        if term.of_volume:
            return self._bulk(
                term.name,
                self._volume_density(term, term.density),
                amplitude or term.name,
                linear=term.linear,
            )
        density = self._face_density(term, term.density)
        energy = self._on_faces([density])
        return SolidTerm(
            term.name, density, energy, self.u, self.log, amplitude or term.name, linear=term.linear
        )

    def observed(self, term: OwnTerm) -> dict[str, ufl.Form]:
        """Return the integrals that a term observes, by column name.

        They run over the body's volume or its outer face, as the term's energy does.
        """
        if term.of_volume:
            densities = {
                column: self._volume_density(term, density_function)
                for column, density_function in term.observed.items()
            }
            return {column: self._over_body(density) for column, density in densities.items()}
        return {
            column: self._on_faces([self._face_density(term, density_function)])
            for column, density_function in term.observed.items()
        }

    def _volume_density(self, term: OwnTerm, density_function: Callable[..., Expr]) -> SolidDensity:
        """Return the density per volume of a term that depends on places alone."""
        # jets with the value alone; derivatives are zero
        flat = [ufl.zero(3)] * len(ALL_DERIVATIVES)
        parameter_count = len(term.parameters)
        at_point = term.at_point(density_function)

        def per_volume(X: Expr, u: Expr, H: Expr, *parameters: Expr) -> Expr:
            # after the term's own parameters comes h: energies count over E h R²
            own_parameters, h = parameters[:parameter_count], parameters[parameter_count]
            return at_point(Jet(X, *flat), Jet(u, *flat), *own_parameters) / h

        constants = constants_of(term, self.u.function_space.mesh, self.free_constants)
        return SolidDensity(per_volume, (*constants, *self._constants(self.h)), VALUE)

    def _over_body(self, density: SolidDensity) -> ufl.Form:
        """Return the integral of a density at u over the undeformed body."""
        dx = ufl.Measure(
            "dx", domain=self.body.mesh, metadata={"quadrature_degree": density.degree}
        )
        X, H = ufl.SpatialCoordinate(self.body.mesh), ufl.grad(self.u)
        return density.function(X, self.u, H, *density.parameters) * dx

    def _face_density(self, term: OwnTerm, density_function: Callable[..., Expr]) -> SolidDensity:
        """Return a surface term's density on the outer face, per area of the reference cell."""
        # second derivatives are taken as zero: such a term must not depend on them
        flat = [ufl.zero(3)] * len(SECOND_DERIVATIVES)

        def on_face(
            X: Expr, X1: Expr, X2: Expr, u: Expr, u1: Expr, u2: Expr, *parameters: Expr
        ) -> Expr:
            return per_area(term.at_point(density_function))(
                Jet(X, X1, X2, *flat), Jet(u, u1, u2, *flat), *parameters
            )

        parameters = constants_of(term, self.u.function_space.mesh, self.free_constants)
        return SolidDensity(
            on_face, parameters, ON_FACE, region="outer", facets=self.body.faces[OUTER_FACE]
        )

    def volume_change(self, origin: Array | None) -> ufl.Form:
        """Return the form of Delta V/R^3 under the outer face of the modelled part.

        It is the change of the volume between the face and `origin` (3,) over R; with None, the
        volume that points sweep on straight ways from their undeformed places.
        """
        densities = self._volume_densities(1.0, origin)  # of a unit pressure
        return self._on_faces(list(densities.values()))

    def moment(self, name: str, edge: str, intensity: float, amplitude: str) -> EndMoment:
        """Return the term of a moment about the first tangent of an edge; collective.

        It acts on the end above the edge as a traction that is linear through the thickness.

        Parameters
        ----------
        name, edge
            Name of the term, and of the edge.
        intensity
            Moment per length of an amplitude of one, in E h R.
        amplitude
            Name of the amplitude.
        """
        Q = fem.functionspace(self.body.mesh, ("Lagrange", 2, (1,)))
        # cosine and sine of the reference angle, zero at first
        weight, reference_turn = fem.Function(Q), self._constants(np.array([1.0, 0.0]))[0]
        body = self.body
        # 6 z (1 - z)/h, z from 0 to 1: its integral over the thickness is one
        weight.x.array[:] = body.at_nodes(Q, 6 * body.heights * (1 - body.heights) / body.thickness)
        parameters = (weight, *self._constants(intensity), reference_turn)
        density = SolidDensity(
            body_densities.turning, parameters, region="end", facets=self.body.faces[edge]
        )
        term = EndMoment(name, density, self._on_faces([density]), self.u, self.log, amplitude)
        # the weight's integral over the end is the edge's length
        length = self.log.compile(
            "end length", weight[0] * face_measure(self.body.mesh, [self.body.faces[edge]])(1)
        )
        total_length = self.body.mesh.comm.allreduce(fem.assemble_scalar(length))
        term.set_reference_turn(reference_turn, intensity * total_length)
        return term

    def _volume_densities(
        self, unit: float, origin: Array | None, *, potential: bool = True
    ) -> dict[str, SolidDensity]:
        """Return densities of p times the change of volume under the outer face, by term name.

        On hinged ends the volume reaches down to the middle line: they have terms of their own.

        Parameters
        ----------
        unit
            Pressure of an amplitude of one, over E h/R.
        origin
            Point (3,) over R that the volume is counted from; None for volume swept by straight
            motion.
        potential
            Whether the pressure has a potential; otherwise densities also have a virtual work.
        """
        # an origin of zero needs no parameter: it is the densities' default
        parameters = self._constants(
            unit, *([origin] if origin is not None and origin.any() else [])
        )
        # densities on the outer face and on ends: of the volume from an origin, or swept
        face_density: Callable[..., Expr] = body_densities.pressure
        end_density: Callable[..., Expr] = body_densities.sealing
        if origin is None:
            face_density = body_densities.swept_volume
            end_density = body_densities.swept_volume_on_end
        face_work: Callable[..., Expr] | None = None
        end_work: Callable[..., Expr] | None = None
        if not potential:
            face_work = body_densities.follower_pressure_work
            end_work = body_densities.follower_pressure_work_on_end
        densities_by_name = {
            "pressure": SolidDensity(
                face_density,
                parameters,
                parts=ON_FACE,
                degree=QUADRATURE_DEGREE,
                region="outer",
                facets=self.body.faces[OUTER_FACE],
                work=face_work,
            )
        }
        # hinged ends: whole cells above the middle line, and cells of which the upper half is
        hinged_facets = self._hinged_facets_above() if self.hinged else {}
        for name, facets in hinged_facets.items():
            # all ranks have the same terms
            if self.body.mesh.comm.allreduce(len(facets)):
                densities_by_name[f"pressure {name}"] = SolidDensity(
                    end_density,
                    parameters,
                    parts=VALUE + GRADIENT,
                    degree=QUADRATURE_DEGREE,
                    region="end",
                    facets=facets,
                    upper=name == "upper",
                    work=end_work,
                )
        return densities_by_name

    def _hinged_facets_above(self) -> dict[str, Facets]:
        """Return the facets of hinged ends above the middle line.

        Returns
        -------
        dict[str, Facets]
            "whole": facets of cells wholly above the line. "upper": facets of cells through which
            the line passes, whose upper half is above it.
        """
        facets = np.unique(np.concatenate([self.body.faces[name] for name in self.hinged]))
        cells_of_facets = self.body.mesh.topology.connectivity(2, 3)
        cells = cells_of_facets.array[cells_of_facets.offsets[facets]]
        # heights of the lower and the upper face of the cell at each facet
        low, high = self.body.layer_bounds[cells].T
        begins_below = low < MIDSURFACE_HEIGHT - HEIGHT_TOLERANCE
        ends_above = high > MIDSURFACE_HEIGHT + HEIGHT_TOLERANCE
        return {
            "whole": facets[low > MIDSURFACE_HEIGHT - HEIGHT_TOLERANCE],
            "upper": facets[begins_below & ends_above],
        }

    def _bulk(
        self,
        name: str,
        density: SolidDensity,
        amplitude: str | None = None,
        *,
        linear: bool = False,
        group: str = "",
        column: str = "",
    ) -> SolidTerm:
        """Return the term of a density over the body.

        `linear` says whether the energy is linear in u. `group` and `column` are those of the term;
        an empty group stands for the name.
        """
        energy = self._over_body(density)
        term = SolidTerm(name, density, energy, self.u, self.log, amplitude, linear=linear)
        term.group, term.column = group or name, column
        return term

    def _on_faces(self, densities: Sequence[SolidDensity], v: Expr | None = None) -> ufl.Form:
        """Return the sum of the densities' integrals on their faces, at the displacement u.

        With the test function `v` it is the virtual work of each density in place of its energy.
        Densities on the outer face are per area of the reference cell, and functions of (X, X1, X2,
        u, u1, u2). Those on ends are per area, and functions of (X, u, H, n, t).
        """
        domain, u = self.body.mesh, self.u
        # J: columns are the derivatives of X by the reference coordinates
        X, J, H = ufl.SpatialCoordinate(domain), ufl.Jacobian(domain), ufl.grad(u)
        ds, forms = face_measure(domain, [density.facets for density in densities]), []
        # `face_measure` marks the facets of the first density with 1, and so on
        for tag, density in enumerate(densities, 1):
            function = density.function if v is None else density.work
            assert function
            parameters = density.parameters if v is None else (v, *density.parameters)
            if density.region == "outer":
                # coordinates of the outer face are the first two of the reference cell; division
                # by the area per reference area makes the measure one of the reference cell
                area = ufl.cross(J[:, 0], J[:, 1])
                arguments = X, J[:, 0], J[:, 1], u, ufl.dot(H, J[:, 0]), ufl.dot(H, J[:, 1])
                per_reference_area = function(*arguments, *parameters)
                forms.append(per_reference_area / ufl.sqrt(ufl.dot(area, area)) * ds(tag))
                continue
            # an end: n along the thickness, t along the edge
            n = J[:, 2] / ufl.sqrt(ufl.dot(J[:, 2], J[:, 2]))
            t = ufl.cross(n, ufl.FacetNormal(domain))
            per_area = function(X, u, H, n, t / ufl.sqrt(ufl.dot(t, t)), *parameters)
            measure = ds(tag)
            if density.upper:  # the outer half of a facet has its own rule
                points, weights = density.rule
                metadata = {
                    "quadrature_rule": "custom",
                    "quadrature_points": tuple(tuple(x) for x in points),
                    "quadrature_weights": tuple(weights),
                }
                measure = ds(tag, metadata=metadata)
            forms.append(per_area * measure)
        return sum(forms[1:], forms[0])

    def _constants(self, *values: float | Array) -> tuple[fem.Constant, ...]:
        """Return values as constants of forms."""
        return tuple(fem.Constant(self.body.mesh, value) for value in values)
