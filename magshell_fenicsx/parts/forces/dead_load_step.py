"""The step `kind: dead`: loads that keep their direction, and the observables of forces.

A step of a case drives one amplitude, a load parameter by name, here the common factor of its
loads. The conjugate -dPi/dmu of an amplitude mu, with the energy Pi, is the displacement on which
it does work; steps may prescribe or hold it. A load varies if it is a formula of the undeformed
place. A potential is an energy as a formula of the deformed place. A context is the case around a
section, an outline the undeformed shell, its meridian the curve that it is revolved from, if it is.
E, h and R are modulus, thickness and reference length.
"""

from collections.abc import Iterable, Sequence
from math import copysign, sqrt
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, model_validator

from magshell_fenicsx.input.expressions import Formula, is_formula, symbolic
from magshell_fenicsx.input.section import Section, in_units, or_number
from magshell_fenicsx.mesh.grading import DiscFeature, Feature
from magshell_fenicsx.mesh.mirror import ROUNDING, Mirror
from magshell_fenicsx.models.shell.kinematics import Jet
from magshell_fenicsx.models.shell.own_term import OwnTerm, symbolic_functions
from magshell_fenicsx.parts.ability import Account, Context, Formulas, Modelled, Scales
from magshell_fenicsx.parts.observables import ModelView, Observables
from magshell_fenicsx.parts.path_step import Count, PathStep
from magshell_fenicsx.parts.step_course import LoadStart, MeshHints, SizingContext, Target, Until
from magshell_fenicsx.quantities.quantity import Quantity
from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.shape.field_symmetry import (
    FieldFunction,
    formula_field,
    is_axisymmetric,
    is_mirror_image,
)
from magshell_fenicsx.shape.meridian_chart import MeridianChart
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint, tilted, unit

if TYPE_CHECKING:
    from ufl.core.expr import Expr

    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.mesh.patch import PatchMesh
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.shape.outline import Outline

Array = NDArray[np.float64]
Finite = Annotated[float, Field(ge=-1e30, le=1e30)]
Moment = Annotated[float, or_number("newton", Finite), Field(ge=-1e30, le=1e30)]
Three = Field(min_length=3, max_length=3)
Force = Annotated[list[Moment], Three]
MAX_COMPONENT = 1e30


def _or_formula(unit: str) -> Any:
    """Return a pydantic validator of a component: a number, text with a unit, or a formula.

    Parameters
    ----------
    unit
        Unit of the component, such as "pascal". Formulas are of x, y, z and stay text.
    """

    def read(value: Any) -> Any:
        """Return a formula as it is, else the number of a component."""
        if isinstance(value, str) and is_formula(value):
            return value
        number = in_units(unit)(value)
        is_number = isinstance(number, int | float) and not isinstance(number, bool)
        # `not <=` also refuses nan
        if not is_number or not abs(number) <= MAX_COMPONENT:
            raise ValueError(
                f"{value!r}: allowed are numbers up to {MAX_COMPONENT:g} in size, with a unit, "
                "and formulas"
            )
        return number

    return BeforeValidator(read, json_schema_input_type=Finite | str)


Varying = float | str
# part of the largest load: a smaller part across normals is rounding of its formula
NORMAL_TOLERANCE = 1e-6
PerLength = Annotated[list[Annotated[Varying, _or_formula("newton/metre")]], Three]
PerArea = Annotated[list[Annotated[Varying, _or_formula("pascal")]], Three]
VaryingPressure = Annotated[Varying, _or_formula("pascal")]


class DeadLoadSection(Section):
    """One load, at a point of `points`, on an edge, or over the surface, in the units of the
    shell's numbers.

    On an edge: `force` in all, `per_length`, or `moment` per length about the edge's first tangent,
    which turns with the edge. Over the surface (`over: all`, or a patch of a mesh): `per_area`, or
    `pressure` along the undeformed normal, positive from outside. What is per length or area may be
    a formula of the undeformed place x, y, z in the shell's length, such as "cos(2*arctan2(y, x))".
    """

    at: str | None = None
    """A point of `points`"""
    edge: str | None = None
    """An edge of the geometry; or a line within it, a joined edge or a curve of a mesh file"""
    over: str | None = None
    """all, or a patch of a mesh"""
    force: Force | None = None
    """At a point, or in all on an edge [force]"""
    per_length: PerLength | None = None
    """On an edge [force/length]"""
    moment: Moment | None = None
    """On an edge, about its tangent with the surface on its left; positive turns the normal outward
    [force]"""
    per_area: PerArea | None = None
    """Over the surface [force/length²]"""
    pressure: VaryingPressure | None = None
    """Over the surface, against the undeformed normal [force/length²]"""
    potential: Formula | None = None
    """Over all: energy per undeformed area as a formula of the deformed place x, y, z in the
    shell's length, whose negative gradient is the force: gravity, springs, a field of force
    [force/length]"""

    @model_validator(mode="after")
    def _one_load_in_one_place(self) -> Self:
        """Check that the load has one place and one quantity that goes with it, not zero."""
        quantities_of_place = {
            "at": ("force",),
            "edge": ("force", "per_length", "moment"),
            "over": ("per_area", "pressure", "potential"),
        }
        places = [place for place in quantities_of_place if getattr(self, place) is not None]
        if len(places) != 1:
            raise ValueError(
                "a load is at a point, on an edge, or on a part of the surface: give one of at, "
                "edge, over"
            )
        # one quantity, and one that goes with the place
        quantities = {key for keys in quantities_of_place.values() for key in keys}
        given_keys = sorted(key for key in quantities if getattr(self, key) is not None)
        if len(given_keys) != 1 or given_keys[0] not in quantities_of_place[places[0]]:
            raise ValueError(
                f"with {places[0]} goes one of {', '.join(quantities_of_place[places[0]])}"
            )
        value = getattr(self, given_keys[0])
        if not (any(value) if isinstance(value, list) else value):
            raise ValueError(f"{given_keys[0]}: is zero")
        if self.potential is not None and self.over != "all":
            raise ValueError(f"potential: goes with over: all, not with {self.over}")
        return self

    @property
    def vector(self) -> list[Varying] | None:
        """The three components of a load with a direction in space; None of other loads."""
        return next(
            (list(v) for v in (self.force, self.per_length, self.per_area) if v is not None), None
        )

    @property
    def varies(self) -> bool:
        """Whether the load has a formula of the undeformed place."""
        return isinstance(self.pressure, str) or any(isinstance(v, str) for v in self.vector or [])


class DeadSection(PathStep):
    """Loads that keep their direction and grow by a common factor.

    A target is the `factor`, or the `displacement` of the loads along themselves (their work over
    the sum of their sizes) in the units of the shell's lengths.
    """

    amplitude: ClassVar[str] = "load"
    in_lengths: ClassVar[bool] = True
    targets: ClassVar[dict[str, Target]] = {
        "factor": Target("load", "load_factor"),
        "displacement": Target("conjugate", "w_over_h"),
    }
    kind: Literal["dead"]
    loads: list[DeadLoadSection] = Field(min_length=1, max_length=1000)
    """At a factor of one"""
    control: Literal["load", "displacement", "arc"] = "arc"
    """What is prescribed step by step: the factor, the displacement, or arc length, which passes
    every fold"""
    until: Until = "target"
    factor: float | None = Field(default=None, ge=-1e9, le=1e9)
    """Target of the common factor; with control: load or arc"""
    displacement: Annotated[float, or_number("metre"), Field(ge=-1e9, le=1e9)] | None = None
    """Target of the displacement along the loads; with control: displacement or arc [the shell's
    length]"""
    points: Count = 20

    @model_validator(mode="after")
    def _moments_have_no_displacement(self) -> Self:
        """Refuse targets and branches that loads with a moment or a potential cannot have.

        The energy of such loads is not linear in the displacement, so they have none along them.
        """
        if self.control == "displacement" or self.displacement is not None:
            for is_loaded, kind in ((self.turns, "moment"), (self.by_place, "potential")):
                if is_loaded:
                    raise ValueError(
                        f"displacement: a {kind} has none; take control: arc or load with factor"
                    )
        if self.branches and self.turns:
            raise ValueError(
                "branches: not with a moment, whose potential counts the turns along one path"
            )
        return self

    @property
    def turns(self) -> bool:
        """Whether a moment is among the loads."""
        return any(load.moment is not None for load in self.loads)

    @property
    def by_place(self) -> bool:
        """Whether a potential is among the loads."""
        return any(load.potential is not None for load in self.loads)

    @property
    def place(self) -> Any:
        return self.loads

    @property
    def conjugate(self) -> str:  # type: ignore[override]  # a moment or a potential has none
        return "" if self.turns or self.by_place else "displacement along the loads"

    def refuse_unfit(self, context: Context) -> None:
        """Refuse a case without a modulus, or without a point that a load names."""
        context.has_modulus("loads of kind: dead")
        for i, load in enumerate(self.loads):
            context.has_point(f"{context.step.key}.loads.{i}.at", load.at)

    def warning(self, context: Context, places: Array) -> str | None:
        """Return a warning that a pressure by formula keeps its direction, unlike that of a fluid.

        Formulas of components are such a pressure too if they are along the normals of a curved
        surface. Without such a load the result is None.
        """
        from magshell_fenicsx.parts.shell_outline import outline

        for i, load in enumerate(self.loads):
            if isinstance(load.pressure, str):
                key = "pressure"
            elif load.per_area and load.varies:
                # along the normals of the perfect shell
                perfect, length = outline(context.shell), context.shell.reference
                if not is_normal(load.per_area, perfect, length):
                    continue
                key = "per_area"
            else:
                continue
            # one warning for all such loads: the first of them is named
            return (
                f"{context.step.key}.loads.{i}.{key}: dead: per undeformed area, fixed to the "
                "material and along the undeformed normal; a live one, as of a fluid, turns with "
                "the surface (a ring buckles at 3/4 of the dead one): kind: pressure, with a "
                "profile where it varies"
            )
        return None

    def first_change(self, change: float, load_start: LoadStart, *, by_load: bool) -> float:
        """Return the first change of the factor: an equal part of the way to a target factor.

        Towards a target displacement it is 1e-3.

        Parameters
        ----------
        change
            The whole change to the target, of the factor or of the displacement.
        load_start
            Not used here: the amplitude where the step begins.
        by_load
            Whether the target is one of the factor.
        """
        return change / self.points if by_load else copysign(1e-3, change)

    def step(self, change: float | None, load_start: LoadStart) -> float | None:
        """Return the first step of the displacement if it is prescribed; else None."""
        return abs(change) / self.points if self.control == "displacement" and change else None

    def scale(self, load_start: LoadStart) -> float:
        return abs(self.factor or 1.0)

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry that the loads preserve: of all together, and of each potential.

        Loads along e3, on the axis or all around it, preserve rotations about e3. A mirror plane
        must map the loads to each other.
        """
        length = context.shell.reference
        constant_loads = [load for load in self.loads if not load.varies]
        # vectors and places that a mirror plane must contain; then all of them as unit vectors
        forces = [
            np.array(v)
            for load in constant_loads
            for v in (load.force, load.per_length, load.per_area)
            if v
        ]
        places = [np.array(context.points[load.at]) / length for load in self.loads if load.at]
        vectors = [unit(v) for v in (*forces, *places)]
        # places of the undeformed shell (n, 3), at which formulas are compared; without formulas
        # none are needed
        potentials = [load.potential for load in self.loads if load.potential]
        has_formulas = potentials or len(constant_loads) < len(self.loads)
        sampled_places = outline.sample() if has_formulas else np.zeros((0, 3))

        def mirrors(mirror: Mirror) -> bool:
            """Return whether a mirror plane maps the loads to each other.

            Loaded points must be on it, potentials must be the same on both sides, and the image of
            each load must be one of the loads.
            """
            has_points = all(
                abs(float(mirror.signed_distance(place))) < ROUNDING for place in places
            )
            keeps_potentials = has_points and all(
                is_mirror_image(formula_field(text, length), mirror, sampled_places)
                for text in potentials
            )
            return keeps_potentials and all(
                _has_image(load, self.loads, mirror, sampled_places, length) for load in self.loads
            )

        reason = self._reason_against_turns(vectors, outline.meridian, length)
        # each potential finds its symmetry by itself, as an energy in the case's frame
        case_frame = np.eye(3)
        energies = [
            potential(f"potential_{i}", text, case_frame, context.scales)
            for i, text in enumerate(potentials)
        ]
        return [
            SymmetryConstraint(reason, vectors, mirrors),
            *(energy.symmetry_constraint(outline) for energy in energies),
        ]

    def _reason_against_turns(
        self, vectors: Sequence[Array], meridian: MeridianChart | None, length: float
    ) -> str | None:
        """Return why the loads do not preserve rotations about e3; None if they do.

        Parameters
        ----------
        vectors
            Unit vectors of the constant loads, and directions to loaded points.
        meridian
            The meridian of a shell of revolution; None of other shells.
        length
            Length R in the unit of the formulas' places.
        """
        # whether formulas are the same all around e3; that is known on a meridian alone, and else
        # taken to be so
        is_same_around = not meridian or self._formulas_are_axisymmetric(meridian, length)
        if any(tilted(v) for v in vectors):
            return "a load is not along e3, or off the axis"
        # `over` names a part that is the same all around e3 if it is "all", or one shell of several
        # on meridians
        shell_names = [shell.name for shell in meridian.shell_meridians] if meridian else []
        if any(load.over not in (None, "all", *shell_names) for load in self.loads):
            return "a patch is loaded"
        return None if is_same_around else "a load differs around e3"

    def _formulas_are_axisymmetric(self, meridian: MeridianChart, length: float) -> bool:
        """Return whether the formulas of all loads and potentials are the same all around e3."""
        fields = [_load_field(load, length) for load in self.loads if load.varies]
        fields += [formula_field(load.potential, length) for load in self.loads if load.potential]
        return all(is_axisymmetric(field, meridian) for field in fields)

    def concentrated(self, context: Context, outline: "Outline") -> Sequence[str]:
        return [load.at for load in self.loads if load.at]

    @classmethod
    def mesh_features(
        cls, loads: Sequence[Self], place: Array, sizing: SizingContext
    ) -> list[Feature]:
        """Return the disc of small elements around a loaded point in the chart."""
        x, y = map(float, place)
        # how fast elements grow with the distance; the disc has no radius, so that they grow from
        # the point on
        growth = loads[0].mesh_hints(sizing).growth
        return [DiscFeature((x, y), radius=0.0, size=sizing.h, growth=growth)]

    def mesh_hints(self, sizing: SizingContext) -> MeshHints:
        """Return the largest size of elements over R: 2 sqrt(h/R) of a thin shell.

        A thick shell has no bound of its own.
        """
        size = 2 * sqrt(sizing.h)  # h is over R
        return MeshHints(largest=size if size < 0.35 else None)

    def formulas(self, context: Context) -> Iterable[Formulas]:
        """Yield the keys of all loads that may be formulas, with bounds and unit of places."""
        from magshell_fenicsx.models.shell.spatial_fields import (
            MAX_COMPONENT,
        )  # the solver takes long to import

        scales, key = context.scales, context.step.key
        for i, load in enumerate(self.loads):
            for name in ("per_length", "per_area", "pressure"):
                value = getattr(load, name)
                values = value if isinstance(value, list) else [value]
                # the model's largest load in the case's units: over E h on an edge, else over E h/R
                divisor = scales.R if name != "per_length" else 1.0
                largest = MAX_COMPONENT * (scales.E * scales.h / divisor)
                yield Formulas(
                    f"{key}.loads.{i}.{name}", values, -largest, largest, scales.R, load=True
                )
            if load.potential:  # a formula of the deformed place, checked at undeformed places
                largest = MAX_COMPONENT * scales.E * scales.h
                yield Formulas(
                    f"{key}.loads.{i}.potential",
                    [load.potential],
                    -largest,
                    largest,
                    scales.R,
                    deformed=True,
                )

    def contribution(self, context: Context, modelled: Modelled) -> "Loads":
        """Return the step's amplitude -> its loads, dimensionless.

        Loads on edges that the mirror removes from the model are left out.
        """
        # the solver takes long to import
        from magshell_fenicsx.parts.forces.load_vectors import dead_load
        from magshell_fenicsx.parts.loads import Loads

        mirror, name = modelled.mirror, context.step.name
        loads = (load for load in self.loads if not mirror or load.edge not in mirror.removed_edges)
        dead_loads = (
            dead_load(load, f"{name}_potential_{i}", context, modelled)
            for i, load in enumerate(loads)
        )
        return Loads(dead={name: tuple(dead_loads)})


def is_normal(components: Sequence[Varying], outline: "Outline", length: float) -> bool:
    """Return whether a load by formulas is along the undeformed normals of a curved surface.

    Parameters
    ----------
    components
        Three numbers or formulas.
    length
        Length R in the unit of the formulas' places.
    """
    sampled = outline.samples_with_normals()  # (n, 3) places over R, and unit normals there
    if sampled is None:  # normals are not known
        return False
    places, normals = sampled
    load = formula_field(components, length)(places)
    largest_tangential = np.linalg.norm(np.cross(load, normals), axis=1).max()
    # on a plane any load along the one normal would pass, though no pressure of a fluid is meant
    is_curved = np.linalg.norm(np.ptp(normals, axis=0)) > ROUNDING
    return bool(
        is_curved and largest_tangential < NORMAL_TOLERANCE * np.linalg.norm(load, axis=1).max()
    )


def _has_image(
    load: DeadLoadSection, loads: Iterable[DeadLoadSection], mirror: Mirror, x: Array, R: float
) -> bool:
    """Return whether a plane mirrors a load to one of several (`is_image`)."""
    return any(is_image(load, other, mirror, x, R) for other in loads)


def is_image(
    load: DeadLoadSection, other: DeadLoadSection, mirror: Mirror, x: Array, R: float
) -> bool:
    """Return whether a plane mirrors one load to another.

    Parameters
    ----------
    x
        (n, 3) places over R at which formulas are compared.
    R
        Length of the shell in the unit of formulas' places.
    """
    edge = load.edge and mirror.image_of_edge(load.edge)
    if load.varies or other.varies:  # values of formulas are compared at places and their images
        # both must be vectors, or both pressures, on edges that are images or over the same part
        if (edge, load.over, load.vector is None) != (other.edge, other.over, other.vector is None):
            return False
        return is_mirror_image(_load_field(load, R), mirror, x, image=_load_field(other, R))
    # points, patches, moments and pressures must be the same, and edges images of each other
    if (edge, load.at, load.over, load.moment, load.pressure, load.potential is None) != (
        other.edge,
        other.at,
        other.over,
        other.moment,
        other.pressure,
        other.potential is None,
    ):
        return False
    # vectors must be images of each other, to rounding
    for key in ("force", "per_length", "per_area"):
        vector, other_vector = getattr(load, key), getattr(other, key)
        if (vector is None) != (other_vector is None):
            return False
        if vector:
            difference = np.abs(mirror.reflection @ vector - other_vector).max()
            if difference > 1e-10 * np.linalg.norm(vector):
                return False
    return True


def _load_field(load: DeadLoadSection, R: float) -> FieldFunction:
    """Return the vector of a load, or its pressure, as a field; R is as in `is_image`."""
    return formula_field(load.vector or load.pressure or 0.0, R)


def potential(name: str, text: str, Q: Array, scales: Scales) -> OwnTerm:
    """Return the energy of a load that is a formula of the deformed place.

    The term's density is V(r) - V(r0) over E h, with the formula V: it is zero where nothing has
    moved.

    Parameters
    ----------
    name
        Name of the energy and its amplitude.
    text
        Formula of x, y, z: energy per undeformed area, in the case's units.
    Q
        (3, 3) rotation from the case's frame to the model's frame.
    scales
        Length, thickness and modulus in the case's units.
    """

    def energy_at(r: "Expr", scale: "Expr", energy_scale: "Expr") -> "Expr":
        # x = R Q^T r: coordinates in the case's frame and unit, of a place r in the model's frame
        x = []
        for i in range(3):
            coordinate_over_R = sum(float(Q[j, i]) * r[j] for j in range(3) if Q[j, i])
            x.append(scale * coordinate_over_R)
        return energy_scale * symbolic(text, symbolic_functions(), *x)

    def density(r0: Jet, u: Jet, scale: "Expr", energy_scale: "Expr") -> "Expr":
        return energy_at(r0.r + u.r, scale, energy_scale) - energy_at(r0.r, scale, energy_scale)

    # `scale` and `energy_scale` are parameters of the density: other values need no new kernel
    return OwnTerm(name, density, parameters=(scales.R, 1 / (scales.E * scales.h)))


def also_displaced(loads: "Loads") -> tuple[str, ...]:
    """Return the force and dead-load amplitudes that have a column of displacement of their own.

    The amplitude whose displacement is the column w_over_h is left out.
    """
    return tuple(name for name in (*loads.forces, *loads.dead) if name != loads.displaced)


class ForcesObservables(Observables):
    """The factors of forces and dead loads, and displacements along them."""

    quantities = (
        Quantity("load_factor", "load factor", "Common factor of all dead loads.", "load"),
    )
    column_rank: ClassVar[int] = 0

    def amplitudes(self, loads: "Loads") -> tuple[str, ...]:
        return (*loads.forces, *loads.dead)

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        """Return the columns of factors, and of displacements along further loads."""
        factors = (amplitude(name).column for name in self.amplitudes(loads) if name != "force")
        return (*factors, *(f"w_{name}_over_h" for name in also_displaced(loads)))

    def account(self, context: Context, loads: "Loads") -> Account:
        """Return the lines of `magshell check` on forces and dead loads.

        Without forces it lists them as left out.
        """
        # radii of patches over h, 0 for a point
        radii = [force.patch * context.shell.R_over_h for force in loads.forces.values()]
        lines = [
            f"force on a patch of radius {radius:g} h" if radius else "force at a point"
            for radius in radii
        ]
        if dead := loads.all_dead:
            lines.append(f"{len(dead)} dead load{'s' * (len(dead) > 1)}")
        return Account(lines, left_out=[] if loads.forces else ["force: none"])

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return column -> value at a state: factors of loads, and displacements over h.

        The displacements are those along the loads, of the loaded point, and of the pole, which
        takes the place of the others where nothing is loaded. Collective.
        """
        model, loads, h = view.model, view.loads, view.h
        pole = model.deflection(state.u, "pole") / h
        force = loads.forces.get("force")
        displaced = {f"w_{name}_over_h": name for name in also_displaced(loads)}
        if loads.displaced:
            displaced["w_over_h"] = loads.displaced
        return {
            "force": 0.0,
            "w_over_h": pole,
            "w_pole_over_h": pole,
            "w_point_over_h": model.deflection(state.u, force.point) / h if force else pole,
            **{amplitude(name).column: state.mu[name] for name in self.amplitudes(loads)},
            **{
                column: model.loaded_deflection(state.u, name) / h
                for column, name in displaced.items()
            },
        }

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        """Check that the surface has the patches on which dead loads are."""
        from magshell_fenicsx.models.shell.parameters import (
            AreaForce,
        )  # the solver takes long to import
        from magshell_fenicsx.models.shell.thickness import patch_of

        for load in loads.all_dead:
            if isinstance(load, AreaForce) and load.patch is not None:
                patch_of(surface.patches, load.patch)

    def conjugate_unit(self, view: ModelView, name: str) -> float | None:
        """Return -dPi/dmu of one unit of displacement along a load; None for other amplitudes.

        The unit is w = h of a force, and the shell's length of dead loads.
        """
        if name in view.loads.forces:
            return view.model.force_unit * view.h
        # loads of a moment or a potential alone have no size, and no displacement along them
        return (
            view.model.load_size.get(name, 0.0) / view.length if name in view.loads.dead else None
        )
