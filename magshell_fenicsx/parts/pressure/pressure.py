"""The step `kind: pressure`, a gas under the shell as its conjugate, and their observables.

A live pressure turns with the surface; p is positive from outside, and over p_c, the classical
buckling pressure of a sphere. A step of a case drives one amplitude, a load parameter by name, here
p. Its conjugate -dPi/dp, with the energy Pi, is the change of the enclosed volume on which it does
work; at free edges that may move there is none. A step's course is how it goes on from its begin. A
view is a model with the units in which it is reported. Volumes are over R^3, h is over R.
"""

from dataclasses import dataclass, replace
from functools import partial
from math import copysign, cos, pi, radians, sqrt
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from magshell_fenicsx.input.expressions import Formula
from magshell_fenicsx.input.section import over_size
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.ability import Account, Context, Modelled
from magshell_fenicsx.parts.observables import ModelView, Observables
from magshell_fenicsx.parts.path_step import PathStep
from magshell_fenicsx.parts.revolution_sections import CapSurface
from magshell_fenicsx.parts.shell_sections import MeshSurface, ShellSection, Surface
from magshell_fenicsx.parts.step import Step
from magshell_fenicsx.parts.step_course import (
    GasSection,
    LoadStart,
    MeshHints,
    SizingContext,
    StepCourse,
    StepStart,
    Target,
    Until,
)
from magshell_fenicsx.quantities.quantity import PRESSURE, VOLUME
from magshell_fenicsx.shape.symmetry_constraint import SymmetryConstraint, patch_constraint

INFLATION_STEP_FACTOR = 10.0  # of the largest step of blown-up rubber, times E h/R over p_c

if TYPE_CHECKING:
    from collections.abc import Sequence

    from magshell_fenicsx.continuation.device import Conjugate
    from magshell_fenicsx.continuation.point import StepOptions
    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.mesh.patch import PatchMesh
    from magshell_fenicsx.parts.loads import Loads
    from magshell_fenicsx.shape.outline import Outline


class PressureSection(PathStep):
    """Live pressure, which follows the surface; p > 0 from outside."""

    amplitude: ClassVar[str] = "pressure"
    conjugate_control: ClassVar[str] = "volume"
    divides_whole_way: ClassVar[bool] = False
    targets: ClassVar[dict[str, Target]] = {
        "pressure": Target("load", "p_over_pc"),
        "volume_change": Target("conjugate", "volume_change"),
    }
    kind: Literal["pressure"]
    control: Literal["volume", "load", "arc"] = "volume"
    """What is prescribed step by step: ΔV, p, or arc length, which passes every fold. The default
    is load with a target `pressure`; and arc beside a free edge, where no ΔV is conjugate to p"""
    until: Until = "limit"
    pressure: Annotated[float, over_size(PRESSURE)] | None = Field(default=None, ge=-1e6, le=1e6)
    """Target p; with control: load or arc [p_c]"""
    volume_change: Annotated[float, over_size(VOLUME)] | None = Field(default=None, ge=-1e4, le=1e4)
    """Target ΔV; with control: volume or arc [R³]"""
    on: dict[str, Literal["outside", "inside"]] | None = Field(default=None, min_length=1)
    """Name of one of several shells, or of a patch of a mesh file -> the face that is pressed; by
    default all from outside. ΔV is then the volume that these sweep"""
    profile: Formula | None = None
    """Polynomial of the deformed place x, y, z over R that multiplies p, as the depth of a fluid,
    "1 - z"; with control: load or arc, since no ΔV is conjugate to p then. Its potential is the
    integral of p over the volume swept"""

    @model_validator(mode="before")
    @classmethod
    def _control_of_a_profile(cls, data: Any) -> Any:
        """Choose the arc length for a profile, if the case gives neither control nor a pressure."""
        keys = set(data) if isinstance(data, dict) else set()
        chooses = "profile" in keys and not keys & {"control", "pressure"}
        return {**data, "control": "arc"} if chooses else data

    @field_validator("profile")
    @classmethod
    def _profile_has_a_potential(cls, profile: str | None) -> str | None:
        """Refuse a profile that is no polynomial of a low degree."""
        from magshell_fenicsx.parts.pressure.profile import MAX_DEGREE, polynomial_degree

        degree = 0 if profile is None else polynomial_degree(profile)
        if degree is None or not 0 <= degree <= MAX_DEGREE:
            raise ValueError(
                f"{profile!r}: allowed are polynomials of x, y, z up to degree {MAX_DEGREE}, "
                "not zero, whose integral over the volume swept is exact"
            )
        return profile

    @model_validator(mode="after")
    def _no_volume_of_a_profile(self) -> Self:
        """Refuse a change of volume as control or target of a pressure with a profile."""
        by_volume = self.control == "volume" or self.volume_change is not None
        if self.profile is not None and by_volume:
            raise ValueError(
                "profile: no change of volume is conjugate to a pressure that varies: take "
                "control: load or arc, and a target pressure"
            )
        return self

    @property
    def conjugate(self) -> str:  # type: ignore[override]  # a pressure that varies has none
        return "volume" if self.profile is None else ""

    def refuse_unfit(self, context: Context) -> None:
        """Refuse `on` without several shells or patches, and two pressures that are not alike.

        Raises
        ------
        ValueError
            With the key of the step.
        """
        pressures = [s.load for s in context.steps if isinstance(s.load, PressureSection)]
        if self.profile is not None:
            self._refuse_unfit_profile(context, pressures)
        if self.on is None:
            return
        if context.solid or not isinstance(context.shell, MeshSurface):
            raise ValueError(
                f"{context.step.key}.on: names one of several shells, or a patch of a mesh file: "
                "leave it out"
            )
        if any(load.on not in (None, self.on) for load in pressures):
            raise ValueError(
                f"{context.step.key}.on: another step has a pressure elsewhere: there is one, on "
                "the same shells"
            )

    def _refuse_unfit_profile(
        self, context: Context, pressures: "Sequence[PressureSection]"
    ) -> None:
        """Refuse a profile on a solid, or beside a pressure with another one.

        Parameters
        ----------
        pressures
            All pressures of the programme.
        """
        key = f"{context.step.key}.profile"
        if context.solid:
            raise ValueError(f"{key}: needs a mid-surface: take model: shell")
        if any(load.profile != self.profile for load in pressures):
            raise ValueError(
                f"{key}: another step has a pressure with another profile: there is one: give "
                "both steps the same"
            )

    def symmetry_constraints(
        self, context: Context, outline: "Outline"
    ) -> list[SymmetryConstraint]:
        """Return the symmetry that a pressure on some patches, and its profile, preserve."""
        assembly = context.shell.assembly if isinstance(context.shell, MeshSurface) else None
        constraints = [
            *super().symmetry_constraints(context, outline),
            patch_constraint(f"{context.step.key}.on", self.on or (), assembly),
        ]
        if self.profile is not None:
            from magshell_fenicsx.parts.pressure.profile import PressureProfile

            term = PressureProfile(self.profile).energy_term("pressure")
            constraint, words = term.symmetry_constraint(outline), f"{context.step.key}.profile"
            reason = constraint.not_axisymmetric and f"{words} does not share it"
            constraints.append(replace(constraint, not_axisymmetric=reason, energy=words))
        return constraints

    def contribution(self, context: Context, modelled: Modelled) -> "Loads":
        """Return the faces that are pressed, and the profile of the pressure."""
        # the solver takes long to import
        from magshell_fenicsx.parts.loads import Loads
        from magshell_fenicsx.parts.pressure.profile import PressureProfile

        sides = {"outside": 1.0, "inside": -1.0}
        profile = None if self.profile is None else PressureProfile(self.profile, modelled.turn)
        return Loads(
            pressed_sides={name: sides[face] for name, face in (self.on or {}).items()},
            pressure_profile=profile,
        )

    def course(self, step_start: StepStart) -> StepCourse:
        """Return the course of the step, by arc length where the pressure has no potential.

        Rubber that is blown up gets longer steps, since it goes far beyond p_c.
        """
        course = super().course(step_start)
        # `open`: no change of volume is conjugate to the pressure, so none can be prescribed
        if step_start.open and "control" not in self.model_fields_set:
            course = replace(course, drive=replace(course.drive, control="arc"))
        # a pressure from inside blows up rubber
        if step_start.context.shell.law_section.incompressible and course.drive.first < 0:
            # E h/R, the size of such pressures, is about 1/h times p_c
            finer = partial(_longer, INFLATION_STEP_FACTOR / step_start.h)
            drive = replace(course.drive, scale=1 / step_start.h)
            course = replace(course, drive=drive, finer=finer)
        return course

    def on_perfect(self, *, last: bool) -> Step:
        """Return this step for the perfect shell; the last one goes to the first instability."""
        return (
            PressureSection(
                kind="pressure",
                control=self.control,
                hold=self.hold,
                on=self.on,
                profile=self.profile,
            )
            if last
            else self
        )

    def mesh_hints(self, sizing: SizingContext) -> MeshHints:
        """Return the largest size of elements over R: it shows buckles of about 3.6 sqrt(Rh).

        With a local imperfection, around which elements are small, there is none.
        """
        return MeshHints(largest=None if sizing.local else 1.2 * sqrt(sizing.h))

    def first_change(self, change: float, load_start: LoadStart, *, by_load: bool) -> float:
        """Return the first change of the pressure, 0.1 p_c towards the target."""
        return copysign(0.1, change)


def _longer(factor: float, steps: "StepOptions") -> "StepOptions":
    """Return step control with a largest step that is longer by a factor."""
    return replace(steps, largest=factor * steps.largest)


class PressureObservables(Observables):
    """The unit of the change of volume, which is conjugate to a live pressure; every run has it."""

    def refuse_unfit(self, loads: "Loads", surface: "PatchMesh") -> None:
        """Check that the surface has the patches that are pressed.

        Raises
        ------
        MeshError
            With the name of a missing patch.
        """
        from magshell_fenicsx.models.shell.thickness import (
            patch_of,
        )  # the solver takes long to import

        for name in loads.pressed_sides:
            patch_of(surface.patches, name, "loading.on")

    def account(self, context: Context, loads: "Loads") -> Account:
        """Return the line of `magshell check` on a live pressure, or on its absence."""
        if not loads.pressure:
            return Account(left_out=["pressure: not loaded by it (the volume is only reported)"])
        if context.solid:
            return Account(["live pressure on the outer face"])
        # empty if all of the shell is pressed from outside
        faces = ", ".join(
            f"{name} from {'outside' if side > 0 else 'inside'}"
            for name, side in loads.pressed_sides.items()
        )
        profile = loads.pressure_profile
        varying = f", times {profile.text} at the deformed place" if profile else ""
        return Account([f"live pressure{faces and f' on {faces}'}{varying}"])

    def conjugate_unit(self, view: ModelView, name: str) -> float | None:
        """Return -dPi/dmu of one unit of the change of volume, R^3; None of other amplitudes."""
        if name != PressureSection.amplitude:
            return None
        return -view.model.material.classical_pressure / view.h / view.model.multiplicity

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return the pressure and the change of volume, which every run has; collective."""
        return {
            "p_over_pc": state.mu.get("pressure", 0.0),
            "volume_change": view.model.volume_change(state.u, state.mu),
        }


@dataclass(frozen=True)
class EnclosedGas:
    """A gas under the shell that is closed in at an equilibrium, by Boyle's law.

    (ambient - p) V is constant. Here p is the live pressure from outside, so the gas has the
    pressure ambient - p.

    Attributes
    ----------
    section
        Section of the case on the gas.
    shell
        The shell, which gives the volume if the section does not.
    classical_pressure
        p_c/E.
    unit
        -dPi/dp of a change of volume by R^3, with p over p_c.
    pressure, conjugate
        p/p_c and -dPi/dp where the gas was closed in.
    """

    section: GasSection
    shell: ShellSection | Surface
    classical_pressure: float
    unit: float
    pressure: float
    conjugate: float

    def law(self) -> "Conjugate":
        """Return the conjugate -dPi/dp and its derivative as a function of p/p_c.

        Raises
        ------
        CaseError
            If the volume or the ambient pressure is not known, if the volume would not be positive,
            or if the pressure is not below the ambient one.
        """
        ambient = self.section.ambient_over_pc
        if ambient is None:
            if self.shell.youngs_modulus is None:
                raise CaseError(
                    "hold.pressure.gas.ambient: needs shell.youngs_modulus; or give ambient_over_pc"
                )
            ambient = float(self.section.ambient or 0.0) / (
                self.classical_pressure * self.shell.youngs_modulus
            )
        volume, pressure, unit = self._volume(), self.pressure, self.unit
        change = self.conjugate / unit  # of the volume over R^3, since the shell was undeformed
        if volume + change <= 0:
            raise CaseError(
                f"hold.pressure.gas.volume: {volume:.4g}: the shell has shrunk by {-change:.4g} "
                "R^3 already"
            )
        if pressure >= ambient:
            raise CaseError(
                f"hold.pressure.gas: the pressure, {pressure:.4g} p_c, is not below the ambient "
                f"{ambient:.4g} p_c"
            )
        # Boyle's constant: pressure of the gas over p_c times its volume over R^3
        content = (ambient - pressure) * (volume + change)

        def conjugate(p: float) -> tuple[float, float]:
            # `unit` times the change of volume since the shell was undeformed, and its derivative
            return unit * (content / (ambient - p) - volume), unit * content / (ambient - p) ** 2

        return conjugate

    def by_begin(self, p: float) -> tuple[float, float]:
        """Return derivatives of the conjugate at p/p_c by the state where the gas was closed in.

        The first is by the conjugate there, the second by p/p_c there. With the pressures a of the
        ambient and p0 at the begin, and the volumes V0 undeformed and V0 + dV at the begin, the law
        is (a - p) V = (a - p0) (V0 + dV).
        """
        conjugate, slope = self.law()(p)
        initial_volume = self._volume()
        # a - p: by the law it is the volume V at p over the derivative of V by p
        pressure_of_gas = (conjugate / self.unit + initial_volume) / slope * self.unit
        # (a - p0)/(a - p), and -(V0 + dV)/(a - p) in the unit of the conjugate
        by_conjugate = (pressure_of_gas + p - self.pressure) / pressure_of_gas
        by_pressure = -(self.unit * initial_volume + self.conjugate) / pressure_of_gas
        return by_conjugate, by_pressure

    def _volume(self) -> float:
        """Return the volume of the gas under the undeformed shell, over R^3."""
        return self.section.volume or cap_volume(self.shell)


def cap_volume(shell: ShellSection | Surface) -> float:
    """Return the volume over R^3 between a spherical shell and the plane of its edge.

    A dimple is left out.

    Raises
    ------
    CaseError
        If the shell is neither a hemisphere nor a cap.
    """
    if shell.geometry == "hemisphere":
        return 2 * pi / 3
    if isinstance(shell, CapSurface) and shell.geometry == "cap":
        c = cos(radians(shell.polar))  # of the polar angle of the edge
        return pi * (2 + c) * (1 - c) ** 2 / 3  # of a spherical cap of radius one
    raise CaseError(
        f"hold.pressure.gas.volume: give the volume of the gas under a {shell.geometry}"
    )
