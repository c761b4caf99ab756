"""An energy of the mid-surface or of an edge that is given by its density alone.

A part of the program or a user writes the density as a function of jets that returns a UFL scalar.
`OwnTerm` finds out what the density depends on and which symmetries it has, and refuses a density
that is no valid energy.

- A jet is a vector field's value with its first and second derivatives by two coordinates of the
  surface; its six parts are named r, r1, r2, r11, r12 and r22.
- r0 is the placement (the undeformed mid-surface), u the displacement; lengths are over R.
- m is the covector (2,) of an edge: it is zero along the edge and positive outward.
- mu, the amplitude of a term, is the load parameter that multiplies its energy.
- A sample holds random numbers for the jets of r0 and u and for m. Densities are evaluated at
  samples to test their symmetries.
- An outline is the shape of a shell as far as symmetries need it: places on it and its meridian.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from math import isfinite, prod
from numbers import Real
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.input.expressions import formula_function
from magshell_fenicsx.mesh.mirror import Y0_PLANE, Mirror, rotation
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.models.shell.kinematics import (
    ALL_DERIVATIVES,
    FIRST_DERIVATIVES,
    SECOND_DERIVATIVES,
    Edge,
    Jet,
)
from magshell_fenicsx.platform.lazy_import import lazy_import
from magshell_fenicsx.shape.field_symmetry import formula_field, is_axisymmetric, is_mirror_image
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint

if TYPE_CHECKING:
    import ufl
    from ufl import Coefficient
    from ufl.core.expr import Expr

    from magshell_fenicsx.shape.outline import Outline
else:
    ufl = lazy_import("ufl")

Array = NDArray[np.float64]
Sample = tuple[Array, Array, Array]  # jets (6, 3) of r0 and u, and the covector (2,) of an edge
SYMMETRY_SAMPLES = 24  # random surfaces on which a symmetry is looked for
SYMMETRY_TOLERANCE = 1e-10  # difference of two values that is rounding, over the larger
OTHER_COORDINATES = np.array(
    [[1.1, 0.7], [-0.4, 0.8]]
)  # by the jets' own: turned, stretched and sheared
COORDINATE_SAMPLES, COORDINATE_TOLERANCE = (
    4,
    1e-6,
)  # samples in both; difference of values, over the larger, that is not rounding


def symbolic_functions() -> dict[str, Callable[..., Any]]:
    """Return UFL's functions by the names that formulas have."""
    functions = {name: getattr(ufl, name) for name in ("sin", "cos", "tan", "exp", "sqrt", "sign")}
    return functions | {"log": ufl.ln, "abs": abs, "arctan2": ufl.atan2}


@dataclass(frozen=True)
class Free:
    """A parameter of densities that is an amplitude of its own, and may enter them in any way.

    It is a place, an angle or a natural curvature, for instance. Its conjugate is -dPi/dp, a force
    on what it moves. `value` is that of the undeformed shell.
    """

    name: str
    value: float = 0.0


@dataclass(frozen=True)
class FormulaParameter:
    """A parameter that is a formula of x, y, z over R at the undeformed place.

    It is a number that varies over the surface. Each cell has the polynomial with the moments of
    the formula: what is narrower than a cell is not missed.

    Attributes
    ----------
    text
        The formula.
    key
        Key of the case file, for messages.
    turn
        Angle (rad) by which the model's frame is turned about e3 from the formula's.
    """

    text: str
    key: str
    turn: float = 0.0

    @property
    def of_place(self) -> Callable[[Array, Array, Array], Array]:
        """Formula as a function of arrays of coordinates in the model's frame."""
        case_formula = formula_function(self.text)
        if not self.turn:
            return case_formula
        Q = rotation(self.turn)
        return lambda x, y, z: case_formula(
            *(Q[0, i] * x + Q[1, i] * y + Q[2, i] * z for i in range(3))
        )

    def turns(self, outline: Outline) -> bool:
        """Return whether the formula is axisymmetric about e3 on the shell's surface.

        An outline without a meridian is not a surface of revolution.
        """
        return is_axisymmetric(formula_field(self.text), outline.meridian)

    def mirrored(self, mirror: Mirror, outline: Outline) -> bool:
        """Return whether a plane mirrors the formula."""
        return is_mirror_image(formula_field(self.text), mirror, outline.sample())


@dataclass(frozen=True)
class OwnTerm:
    """The energy mu Pi(u), Pi the integral of a density over the undeformed mid-surface or, with
    `on`, along an edge.

    The term, its amplitude mu and its column have its name. What the density depends on is
    found from it, and so are its derivatives and the symmetries that it leaves to a model.

    Parameters
    ----------
    name
        An identifier.
    density
        Of (r0, u, *parameters): jets of the placement and of the displacement (see
        `kinematics.Jet`; r = r0 + u), lengths in R, to a UFL scalar in E h per undeformed area. It
        must not depend on the coordinates that the jets are taken in: build it from values and from
        what `kinematics` offers. It may depend on the value and the first derivatives of u; an
        energy of its second derivatives would miss the rotations between cells. None: it has no
        energy and only observes, also second derivatives.
    parameters
        Numbers and vectors; other values of them need no new kernel. A `Free` one can be varied as
        mu can. A dolfinx function on the mesh that the shell was given on is a number, or a vector,
        of its value at each place; a formula of the place (`FormulaParameter`) is a number.
    value
        mu of the undeformed shell, which a path keeps unless it varies mu.
    observed
        Column -> density as above; mu times its integral over the whole shell is observed along a
        path, the integral itself without an energy. A model has only the symmetries that these
        leave too.
    of_volume
        Whether the densities are those of a volume, over E: the thickness multiplies them where it
        varies, and a solid has them in all of its body. They depend on the places r0.r and u.r
        alone.
    on
        Name of an edge. The densities are then in E h R per undeformed length of it, and take a
        `kinematics.Edge` after the jets: its outward conormal, and derivatives along this and by
        arc length. A solid has no such energies.
    key
        Key of the case file with this name, for messages.

    Raises
    ------
    ValueError
        If the name is no identifier or the density is none of these.
    """

    name: str
    density: Callable[..., Expr] | None
    parameters: tuple[float | Array | Free | UserField | FormulaParameter | Coefficient, ...] = ()
    value: float = 0.0
    observed: Mapping[str, Callable[..., Expr]] = field(default_factory=dict)
    of_volume: bool = False
    on: str | None = None
    key: str = ""

    def __post_init__(self) -> None:
        """Check the name, the value and the densities.

        Raises
        ------
        ValueError
            With the name of the term and what is allowed.
        """
        # what is given besides the densities
        if not self.name.isidentifier():
            raise ValueError(f"{self.name!r}: a term's name is an identifier, such as foundation")
        if not isinstance(self.value, Real) or not isfinite(self.value):
            raise ValueError(f"{self.name}: value: {self.value!r}: must be a finite number")
        if not isinstance(self.on, str | None):
            raise ValueError(f"{self.name}: on: {self.on!r}: must be the name of one edge")
        if not self.densities:
            raise ValueError(f"{self.name}: has neither a density nor anything that it observes")
        if self._lacks_density():
            raise ValueError(
                f"{self.name}: only observes: a value or a Free parameter needs a density"
            )
        # the first density as an expression: a scalar that is made of its arguments alone
        if self._symbolic.W.ufl_shape:
            raise ValueError(
                f"{self.name}: a density is a scalar; this has the shape "
                f"{self._symbolic.W.ufl_shape}"
            )
        if strangers := self._foreign_terminals():
            raise ValueError(
                f"{self.name}: a density is made of its jets and parameters alone; this holds "
                f"{strangers[0]}. "
                "The position is r0.r, a number that is the same everywhere goes into the "
                "parameters"
            )
        # what the energy depends on: the displacement and its first derivatives
        if self.density and not self.parts:
            raise ValueError(f"{self.name}: the density does not depend on the displacement")
        if self.density and (curved := [part for part in self.parts if part in SECOND_DERIVATIVES]):
            raise ValueError(
                f"{self.name}: the density depends on {', '.join(f'u.{part}' for part in curved)}; "
                "without a term on "
                "the edges it would miss the rotations between cells. Allowed are u.r, u.r1 and "
                "u.r2"
            )

        if self.of_volume and self.on is not None:
            raise ValueError(
                f"{self.name}: a density is that of a volume or that of an edge, not both"
            )
        self._refuse_coordinates()
        # derivatives of the placement or the displacement, which a volume does not have
        bent = {*self.parts, *self._parts_in(self._symbolic.r0)} - {"r"}
        if self.of_volume and bent:
            raise ValueError(
                f"{self.name}: a density of a volume depends on r0.r and u.r alone, not on "
                f"{min(bent)}"
            )

    @property
    def densities(self) -> tuple[Callable[..., Expr], ...]:
        """Density of the energy, if it has one, then those that it observes."""
        return (*((self.density,) if self.density else ()), *self.observed.values())

    @cached_property
    def parts(self) -> tuple[str, ...]:
        """The parts of the displacement's jet that the density depends on."""
        return self._parts_in(self._symbolic.u)

    @cached_property
    def placement_parts(self) -> tuple[str, ...]:
        """Parts of the placement's jet that the density needs.

        The first derivatives are always among them: the area of the surface takes them.
        """
        return tuple(
            name
            for name in ("r", *ALL_DERIVATIVES)
            if name in (*FIRST_DERIVATIVES, *self._parts_in(self._symbolic.r0))
        )

    @property
    def free_parameters(self) -> tuple[Free, ...]:
        """Parameters that are amplitudes."""
        return tuple(p for p in self.parameters if isinstance(p, Free))

    @property
    def varying(self) -> bool:
        """Whether a parameter is a function of the place."""
        return any(isinstance(p, UserField | ufl.Coefficient) for p in self.parameters)

    @property
    def formula_parameters(self) -> tuple[FormulaParameter, ...]:
        """Parameters that are formulas of the place."""
        return tuple(p for p in self.parameters if isinstance(p, FormulaParameter))

    def with_functions(
        self,
        formula_to_function: Callable[[FormulaParameter], Coefficient],
        field_to_function: Callable[[UserField], Coefficient] | None = None,
    ) -> OwnTerm:
        """Return the term with functions on a model's mesh in place of formulas and user fields.

        Other parameters (numbers, vectors, `Free` ones) stay as they are.

        Parameters
        ----------
        formula_to_function
            Makes the function (1,) of a formula.
        field_to_function
            Makes the function (size,) of a user's field; None to keep these.
        """

        def function_of(p: Any) -> Any:
            """Return the function in place of a parameter, or the parameter itself."""
            if isinstance(p, FormulaParameter):
                return formula_to_function(p)
            return field_to_function(p) if field_to_function and isinstance(p, UserField) else p

        return replace(self, parameters=tuple(map(function_of, self.parameters)))

    def turned(self, angle: float) -> OwnTerm:
        """Return the term for a model whose frame is turned by `angle` (rad) about e3.

        The densities of the returned term take jets in the model's frame. They rotate these jets
        into the frame in which the density was written, and then evaluate it. Cosine and sine of
        the angle are appended to the parameters, so that another angle needs no new kernel.
        """
        if not angle:
            return self
        # an axisymmetric density is the same in both frames
        if self.turns and not self.formula_parameters:
            return self

        def rotated(v: Expr, about: Expr) -> Expr:
            """Return a vector rotated about e3; `about` (2,) holds cosine and sine of the angle."""
            # cosine and sine, and the components of the vector
            (c, s), (x, y, z) = (about[0], about[1]), (v[0], v[1], v[2])
            return ufl.as_vector([c * x - s * y, s * x + c * y, z])

        def rotated_jet(jet: Jet, about: Expr) -> Jet:
            """Return a jet with each part rotated about e3."""
            return Jet(*(rotated(part, about) for part in jet.parts()))

        def in_frame(density: Callable[..., Expr]) -> Callable[..., Expr]:
            """Return a density of jets in the turned frame; its last parameter is the rotation."""

            def density_in_frame(r0: Jet, u: Jet, *arguments: Any) -> Expr:
                """Evaluate the density at rotated jets, with rotated vectors of an edge."""
                *arguments_left, rotation = arguments  # the appended parameter comes last
                if self.on is not None:
                    edge, *parameters_left = arguments_left
                    rotated_edge = replace(
                        edge,
                        outward=rotated(edge.outward, rotation),
                        along=rotated(edge.along, rotation),
                    )
                    arguments_left = [rotated_edge, *parameters_left]
                jets = rotated_jet(r0, rotation), rotated_jet(u, rotation)
                return density(*jets, *arguments_left)

            return density_in_frame

        parameters = (
            replace(p, turn=angle) if isinstance(p, FormulaParameter) else p
            for p in self.parameters
        )
        return replace(
            self,
            density=in_frame(self.density) if self.density else None,
            parameters=(*parameters, np.array([np.cos(angle), np.sin(angle)])),
            observed={column: in_frame(density) for column, density in self.observed.items()},
        )

    def at_point(self, density: Callable[..., Expr]) -> Callable[..., Expr]:
        """Return a density that takes its scalar functions on a mesh as vectors (1,).

        A function on a mesh is a vector at a point, also if it has one component. The given
        `density` expects a number in its place, so the vector is unpacked. A density without such
        parameters is returned as it is.
        """
        is_number = [
            isinstance(p, ufl.Coefficient) and p.ufl_shape == (1,) for p in self.parameters
        ]
        if not any(is_number):
            return density

        def density_of_numbers(*arguments: Any) -> Expr:
            """Evaluate the density with vectors (1,) unpacked."""
            # the parameters are the last arguments, after two jets and perhaps an edge
            count = len(is_number)
            jets_and_edge, parameters = arguments[:-count], arguments[-count:]
            unpacked = [
                p[0] if number else p for p, number in zip(parameters, is_number, strict=True)
            ]
            return density(*jets_and_edge, *unpacked)

        return density_of_numbers

    @cached_property
    def linear(self) -> bool:
        """Whether the density is linear in the displacement.

        Its second derivatives then vanish identically.
        """
        W, parts = self._symbolic.W, [getattr(self._symbolic.u, name) for name in self.parts]
        second = (
            ufl.algorithms.expand_derivatives(ufl.diff(ufl.diff(W, a), b))
            for a in parts
            for b in parts
        )
        return all(isinstance(derivative, ufl.constantvalue.Zero) for derivative in second)

    @cached_property
    def turns(self) -> bool:
        """Whether the densities stay the same if shell and displacement turn about e3.

        It is tested at random jets, each turned by another angle. A term with functions on a mesh
        counts as not turning.
        """

        def rotated(jet: Array, angle: float) -> Array:
            """Return a jet (6, 3) rotated about e3 by an angle (rad)."""
            c, s = np.cos(angle), np.sin(angle)
            return np.asarray(jet @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]))

        samples = enumerate(_random_samples(), 1)  # the number of a sample is its angle in rad
        return not self.varying and all(
            self._is_same((r0, u, m), (rotated(r0, a), rotated(u, a), m))
            for a, (r0, u, m) in samples
        )

    def mirrored(self, mirror: Mirror) -> bool:
        """Return whether the densities stay the same if shell and displacement are mirrored.

        It is tested at random jets. A term with functions on a mesh counts as not mirrored, and so
        does a term on an edge that the plane maps to another edge.
        """
        if self.varying:
            return False
        # a mirror image turns the normal over; so the two coordinates are exchanged, which turns it
        # back
        order = [
            ("r", *ALL_DERIVATIVES).index(name) for name in ("r", "r2", "r1", "r22", "r12", "r11")
        ]
        S = mirror.reflection

        def image(r0: Array, u: Array, m: Array) -> Sample:
            """Return the mirror image of a sample, with the two coordinates exchanged."""
            return np.vstack([mirror.image(r0[:1]), r0[order[1:]] @ S]), u[order] @ S, m[::-1]

        if self.on is not None and mirror.image_of_edge(self.on) != self.on:
            return False
        return all(self._is_same(sample, image(*sample)) for sample in _random_samples())

    def symmetry_constraint(self, outline: Outline) -> SymmetryConstraint:
        """Return which symmetries of a shell with this outline the term leaves to a model.

        They are the axisymmetry about e3, and mirror planes. A term without axisymmetry has the
        reason for the user in the constraint.
        """
        turns = self.turns and all(p.turns(outline) for p in self.formula_parameters)

        def mirrors(mirror: Mirror) -> bool:
            """Return whether a plane mirrors the densities and all formulas."""
            return self.mirrored(mirror) and all(
                p.mirrored(mirror, outline) for p in self.formula_parameters
            )

        # an axisymmetric model also has every plane through e3 as a mirror, such as y = 0
        is_shared = self.mirrored(Y0_PLANE) and turns
        words = f"the energy {self.name}{' or what it observes' if self.observed else ''}"
        return SymmetryConstraint(
            None if is_shared else f"{words} does not share it", (), mirrors, words
        )

    @property
    def digest(self) -> str:
        """A hash (16 hex digits) by which two equal terms are recognised.

        A function has no text to be hashed, so the densities enter by their values at random jets.
        """
        values = [
            self._value(sample, density)
            for density in self.densities
            for sample in _random_samples()
        ]
        free_parameters = [(p.name, p.value) for p in self.free_parameters]
        rounded = [f"{v:.9e}" for v in values]
        text = f"{self.name} {self.value!r} {free_parameters} {sorted(self.observed)} {rounded}"
        text += " of a volume" * self.of_volume
        text += "".join(f" {p.digest}" for p in self.parameters if isinstance(p, UserField))
        text += "".join(f" {p.text}" for p in self.formula_parameters)
        text += "" if self.on is None else f" on {self.on}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    @cached_property
    def _symbolic(self) -> Symbolic:
        """The first of `densities` as a UFL expression, with the variables that it is made of.

        These are UFL coefficients on a mesh of one triangle, without values. Dependence on a part
        of a jet is found by looking for its coefficient in the expression.

        Raises
        ------
        ValueError
            If the user's function fails.
        """
        import basix.ufl

        domain = ufl.Mesh(basix.ufl.element("Lagrange", "triangle", 1, shape=(2,)))
        V = ufl.FunctionSpace(domain, basix.ufl.element("DG", "triangle", 0, shape=(3,)))

        def jet() -> Jet:
            """Return a jet of new variables."""
            return Jet(*(ufl.variable(ufl.Coefficient(V)) for _ in range(1 + len(ALL_DERIVATIVES))))

        r0, u = jet(), jet()
        m = ufl.Coefficient(
            ufl.FunctionSpace(domain, basix.ufl.element("DG", "triangle", 0, shape=(2,)))
        )
        try:
            return Symbolic(self._expression(r0, u, m, self.densities[0]), r0, u, m)
        except Exception as e:  # of any kind: the density is the user's own program
            message = f"{type(e).__name__}: {e}"
            arguments = "r0, u" if self.on is None else "r0, u, an edge"
            raise ValueError(
                f"{self.name}: the density cannot be computed ({message}). It is a function of "
                f"{arguments} and "
                f"{len(self.parameters)} parameters, and returns a scalar made of r0.r, u.r, u.r1, "
                "... by functions of "
                "UFL (ufl.dot, ufl.sqrt, ...) and of kinematics, not of NumPy or math"
            ) from e

    def _lacks_density(self) -> bool:
        """Return whether the term only observes, but has a value or a parameter to vary."""
        if self.density is not None:
            return False
        return bool(self.free_parameters or self.value)

    def _foreign_terminals(self) -> list[Expr]:
        """Return fields, constants and coordinates in the density that are not its arguments.

        A density that holds such an object cannot be evaluated at points.
        """
        W, r0, u, m = self._symbolic
        arguments = [m, *(part.ufl_operands[0] for jet in (r0, u) for part in jet.parts())]
        return [
            terminal
            for terminal in ufl.corealg.traversal.traverse_unique_terminals(W)
            if isinstance(terminal, ufl.Coefficient | ufl.Constant | ufl.geometry.GeometricQuantity)
            and terminal not in arguments
        ]

    def _refuse_coordinates(self) -> None:
        """Refuse a density whose value depends on the coordinates of the surface.

        Each cell has its own two coordinates, by which jets are derived. So a density must have the
        same value at a sample in two systems of coordinates.

        Raises
        ------
        ValueError
            With the density that differs.
        """
        # columns of the densities, for messages. That of the energy has none (""), and is left out
        # where the term has no energy
        columns = ("", *self.observed)[-len(self.densities) :]
        for column, density in zip(columns, self.densities, strict=True):
            for sample in _random_samples()[:COORDINATE_SAMPLES]:
                value = self._value(sample, density)
                value_in_others = self._value(_in_other_coordinates(sample), density)
                difference = abs(value - value_in_others)
                # false for nan, where the density has no value
                if difference > COORDINATE_TOLERANCE * max(abs(value), abs(value_in_others)):
                    raise ValueError(
                        f"{self.name}{column and f': {column}'}: depends on the coordinates of r1 "
                        "and r2, which are "
                        "others in each cell: build it from kinematics (inverse_metric, "
                        "membrane_strain, normal, ...), "
                        "and derivatives along an edge by edge.by_outward and edge.by_length"
                    )

    def _parts_in(self, jet: Jet) -> tuple[str, ...]:
        """Return the names of the parts of a jet that the first density depends on.

        `jet` is that of r0 or of u in `_symbolic`.
        """
        coefficients = ufl.algorithms.extract_coefficients(self._symbolic.W)
        return tuple(
            name
            for name in ("r", *ALL_DERIVATIVES)
            if getattr(jet, name).ufl_operands[0] in coefficients
        )

    def _edge(self, r0: Jet, m: Expr) -> tuple[Edge, ...]:
        """Return the arguments of the densities between jets and parameters: an edge, or none."""
        return () if self.on is None else (Edge.of(r0, m),)

    def _expression(self, r0: Jet, u: Jet, m: Expr, density: Callable[..., Expr]) -> Expr:
        """Return a density at given jets as an expression of UFL."""
        return ufl.as_ufl(
            density(r0, u, *self._edge(r0, m), *(_as_expression(p) for p in self.parameters))
        )

    def _is_same(self, *samples: Sample) -> bool:
        """Return whether every density has the same value at two samples, to rounding."""
        for density in self.densities:
            first, second = (self._value(sample, density) for sample in samples)
            rounding = SYMMETRY_TOLERANCE * max(abs(first), abs(second))
            if not abs(first - second) <= rounding:  # also for nan: no symmetry is known
                return False
        return True

    def _value(self, sample: Sample, density: Callable[..., Expr]) -> float:
        """Return a density's value at a sample; nan where it has none, as for a negative root."""
        r0, u, m = sample
        try:
            # compound operators are expanded, then the expression of numbers is evaluated
            lowered = ufl.algorithms.apply_algebra_lowering.apply_algebra_lowering
            return float(
                lowered(self._expression(_as_jet(r0), _as_jet(u), _as_expression(m), density))(())
            )
        except (ArithmeticError, TypeError, ValueError):
            return np.nan


class Symbolic(NamedTuple):
    """A density W as an expression, with the jets of r0 and u and the covector m in it."""

    W: Expr
    r0: Jet
    u: Jet
    m: Expr


def _random_samples() -> list[Sample]:
    """Return `SYMMETRY_SAMPLES` samples (jets of r0 and u, a covector), the same at each call."""
    # places within a box about as large as a shell, displacements a quarter of that
    rng = np.random.default_rng(2026)
    jets = rng.uniform(-1, 1, (SYMMETRY_SAMPLES, 2, 6, 3))
    covectors = rng.uniform(-1, 1, (SYMMETRY_SAMPLES, 2))
    return [(jets[i, 0], jets[i, 1] / 4, covectors[i]) for i in range(SYMMETRY_SAMPLES)]


def _in_other_coordinates(sample: Sample) -> Sample:
    """Return a sample (jets of r0 and u, a covector) in other coordinates of the surface.

    The value of a jet stays; derivatives and covector transform by the matrix `OTHER_COORDINATES`.
    """
    A = OTHER_COORDINATES
    r0, u, m = sample
    r0, u = np.array(r0), np.array(u)  # copies, which are changed
    for jet in (r0, u):
        # second derivatives as a symmetric matrix of vectors
        second = jet[[3, 4, 4, 5]].reshape(2, 2, 3)  # rows 3 to 5 of a jet are r11, r12, r22
        jet[1:3] = A @ jet[1:3]  # rows 1 and 2 are r1 and r2
        jet[3:] = np.einsum("ai,bj,ijc->abc", A, A, second).reshape(4, 3)[[0, 1, 3]]
    return r0, u, A @ m


def _as_jet(parts: Array) -> Jet:
    return Jet(*map(_as_expression, parts))


def _as_expression(
    value: float | Array | Free | UserField | FormulaParameter | Coefficient,
) -> Expr:
    """Return a parameter's value as an expression, for tests of a density at samples.

    Formulas and functions vary over the shell. A representative value other than zero stands for
    them, so that no term of the density vanishes.
    """
    if isinstance(value, FormulaParameter):  # any number does
        value = 1.0
    if isinstance(value, UserField):  # its largest values, a number if there is one component
        value = np.where(value.largest == 0, 1.0, value.largest)
        value = value if len(value) > 1 else float(value[0])
    if isinstance(value, ufl.Coefficient):  # any number or vector does
        if value.ufl_shape not in ((), (1,)):
            value = np.arange(1.0, 1 + prod(value.ufl_shape))
        else:
            value = 1.0
    if isinstance(value, Free):
        return ufl.as_ufl(value.value or 1.0)  # not zero, where terms of the density may vanish
    if np.ndim(value) == 0:
        return ufl.as_ufl(float(value))
    return ufl.as_tensor(np.asarray(value, dtype=float).tolist())
