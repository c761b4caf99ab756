"""Keys of a case with their types, for arguments of `python.Shell`, `Pressure`, `Step` and others.

An editor and mypy know them from here. Values are checked when a problem is made.

An amount is a number over the load's unit, or text with a unit such as "100 Pa". What stands at a
place of the shell is a number, a formula, or a function or constant on the shell's mesh.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeAlias, TypedDict

from dolfinx import fem

Amount: TypeAlias = float | str
AtPlace: TypeAlias = float | str | fem.Function | fem.Constant
SectionName: TypeAlias = Literal[  # whose keys are free, or many
    "bodies",
    "boundary",
    "design",
    "ensemble",
    "field_maps",
    "frequencies",
    "gradients",
    "identify",
    "joints",
    "magnetic",
    "output",
    "points",
    "sensors",
    "shell",
    "shells",
    "solid",
    "stability",
]


class ProgrammeKeys(TypedDict, total=False):
    """Keys of every step.

    Attributes
    ----------
    points
        Number of points up to the target.
    hold
        Amplitude -> "conjugate" where its conjugate is held in place of the load.
    search
        Keys of the search for further solutions at the end.
    """

    points: int
    hold: Mapping[str, Any]
    search: Mapping[str, Any]


class CourseKeys(ProgrammeKeys, total=False):
    """Keys of a step whose load grows: how far it goes, and what follows.

    Attributes
    ----------
    until
        Where the step ends.
    then
        What follows an instability at the end: a snap, or the branch.
    snap
        Keys of the motion of a snap.
    branches, sensitivities
        Whether the branches of a bifurcation are followed, and sensitivities computed.
    """

    until: Literal["limit", "bifurcation", "target", "points", "zero"]
    then: Literal["snap", "follow"]
    snap: Mapping[str, Any]
    branches: bool
    sensitivities: bool


class PressureKeys(CourseKeys, total=False):
    """Keys of a step of kind "pressure".

    Attributes
    ----------
    control
        What is prescribed: the enclosed volume, the pressure, or the arc length of the path.
    pressure, volume_change
        The target: over p_c and R^3, or with a unit.
    on
        Shell or patch -> the side on which the pressure acts.
    profile
        Polynomial of the deformed place x, y, z over R that multiplies the pressure.
    """

    control: Literal["volume", "load", "arc"]
    pressure: Amount
    volume_change: Amount
    on: Mapping[str, Literal["outside", "inside"]]
    profile: str


class ForceKeys(CourseKeys, total=False):
    """Keys of a step of kind "indentation".

    Attributes
    ----------
    control
        What is prescribed: the displacement of the point, the force, or the arc length.
    depth, force
        The target: over h and 2 pi D/R, or with a unit.
    patch
        Radius of the patch over which the force is spread: over h, or with a unit.
    """

    control: Literal["displacement", "load", "arc"]
    depth: Amount
    force: Amount
    patch: Amount


class IndentationKeys(ForceKeys, total=False):
    """Keys of a step of kind "indentation": those of a force, and the place `at` which it acts."""

    at: Mapping[str, Any]


FactorKind: TypeAlias = Literal["field", "interaction", "crease", "fold"]


class FactorKeys(CourseKeys, total=False):
    """Keys of a step of one of the kinds `FactorKind`, whose target is a factor.

    Attributes
    ----------
    control
        What is prescribed: the load, or the arc length of the path. So it is of other kinds.
    factor
        The target, over what the case gives.
    """

    control: Literal["load", "arc"]
    factor: float


class ImperfectionKeys(FactorKeys, total=False):
    """Keys of a step of kind "imperfection": the number of the `item` that grows, and a factor."""

    item: int


class RotationKeys(ProgrammeKeys, total=False):
    """Keys of a step of kind "rotation": the direction `to` which the field turns."""

    to: Mapping[str, Any]


class NaturalStepKeys(CourseKeys, total=False):
    """Keys of a step of kind "natural": what grows, and the targets."""

    control: Literal["load", "arc"]
    grows: Literal["curvature", "stretch"]
    curvature: float
    stretch: float


class DeadLoadKeys(CourseKeys, total=False):
    """Keys of a step of kind "dead": the forces, tractions and moments, and a target."""

    control: Literal["load", "displacement", "arc"]
    loads: Sequence[Mapping[str, Any]]
    factor: float
    displacement: Amount


class EdgeKeys(CourseKeys, total=False):
    """Keys of a step of kind "edge": the name of its columns, what moves, and a target."""

    control: Literal["load", "reaction", "arc"]
    name: str
    moves: Sequence[Mapping[str, Any]]
    factor: float
    reaction: Amount


class ContactKeys(CourseKeys, total=False):
    """Keys of a step of kind "contact": the body's name, and a target."""

    control: Literal["approach", "force", "arc"]
    body: str
    approach: Amount
    force: Amount


class SourceKeys(FactorKeys, total=False):
    """Keys of a step of kind "source": its number or name, and what becomes of it."""

    name: str
    source: int | str
    move: Sequence[Amount]
    to: Sequence[Amount]
    turn: Mapping[str, Any]
    strength: float


class SpinKeys(CourseKeys, total=False):
    """Keys of a step of kind "spin": the target of the angular speed."""

    control: Literal["load", "arc"]
    speed: Amount


class GravityKeys(CourseKeys, total=False):
    """Keys of a step of kind "gravity": where the weight points, and the target."""

    control: Literal["load", "arc"]
    direction: Sequence[float]
    acceleration: Amount


class TimeKeys(ProgrammeKeys, total=False):
    """Keys of a step of kind "time", a motion.

    Attributes
    ----------
    duration, until, event
        Where it ends.
    history
        Amplitude -> its course in time.
    rho_inf, step, tolerance, errors, balance
        Of the integration in time.
    drag, push, velocity
        Damping, and how the motion begins.
    """

    duration: Amount
    until: Literal["duration", "rest", "event", "instability"]
    event: Mapping[str, Any]
    history: Mapping[str, Any]
    rho_inf: float
    step: Amount
    tolerance: float
    errors: Literal["step", "motion"]
    balance: float
    drag: Amount
    push: Mapping[str, Any]
    velocity: Sequence[Amount]


class FieldKeys(TypedDict, total=False):
    """Keys of the section `magnetic` besides the remanence, the applied field and `lambda_m`.

    Attributes
    ----------
    energy
        Which terms of the magnetic energy count.
    remanence
        Whether the remanence follows the deformation or the rotation alone.
    susceptibility, saturation
        Of a soft magnet: a number, a formula or numbers by patch; and its saturation.
    interaction
        Whether parts feel the fields of each other.
    """

    energy: Literal["full", "first", "torque", "second", "second_consistent"]
    remanence: Literal["deformation", "rotation"]
    susceptibility: Amount | Mapping[str, float]
    saturation: Amount
    interaction: Literal["none", "others", "all"]


class FoundationKeys(TypedDict, total=False):
    """Keys of the section `foundation`.

    Attributes
    ----------
    stiffness, tangential
        Of the springs along the normal and in the surface: over E/R, or with a unit.
    factor
        Number, formula or function that multiplies both.
    """

    stiffness: Amount
    tangential: Amount
    factor: AtPlace


class NaturalKeys(TypedDict, total=False):
    """Keys of the section `natural`, the shape that the shell would take alone.

    Attributes
    ----------
    curvature, stretch
        Natural curvature (in 1/m, or 1/R) and stretch: a number, a formula, a function, components,
        or one of these by patch.
    along
        "meridian", or a vector whose part in the surface is the first direction.
    """

    curvature: AtPlace | Sequence[AtPlace] | Mapping[str, Any]
    stretch: AtPlace | Sequence[AtPlace] | Mapping[str, Any]
    along: Literal["meridian"] | Sequence[float]


class MeshKeys(TypedDict, total=False):
    """Keys of the section `mesh`.

    Attributes
    ----------
    degree
        Polynomial degree of the displacement.
    refinement
        Factor of the number of elements along a line.
    size
        Length of elements: over R, or with a unit.
    penalty
        Factor of the interior penalty.
    tolerance
        Relative error of the result by which the mesh is chosen.
    """

    degree: int
    refinement: float
    size: Amount
    penalty: float
    tolerance: float


class ShellKeys(TypedDict, total=False):
    """Keys of the section `shell` that are no arguments of `python.Shell` of their own.

    Which geometry has which is checked when the shell is made.

    Attributes
    ----------
    radius_to_thickness, thickness, thickness_factor
        R/h or h, and what multiplies it at each place.
    youngs_modulus, poisson_ratio, density
        Of the material.
    law, mooney, mu, alpha
        The law of the material, and its parameters.
    laminate, viscosity, relaxation
        Plies in place of one material; damping.
    defect, imperfections
        Deviations from the perfect shape.
    azimuth, polar, hole, length, width, inner_radius, tube_radius, tube, profile
        Sizes of the geometry.
    """

    radius_to_thickness: float
    thickness: Amount
    thickness_factor: AtPlace
    youngs_modulus: Amount
    poisson_ratio: float
    density: Amount
    law: Literal["koiter", "neo-hookean", "mooney-rivlin", "ogden"]
    mooney: float
    mu: Sequence[float]
    alpha: Sequence[float]
    laminate: Mapping[str, Any]
    viscosity: Amount
    relaxation: Sequence[Mapping[str, Any]]
    defect: Mapping[str, Any]
    imperfections: Sequence[Mapping[str, Any]]
    azimuth: Sequence[float]
    polar: float
    hole: float
    length: Amount
    width: Amount
    inner_radius: Amount
    tube_radius: Amount
    tube: Sequence[float]
    profile: Mapping[str, Any]
