"""Keys of loads in a case, with their types, for arguments of `python.Pressure` and others.

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


class CourseKeys(TypedDict, total=False):
    """Keys of every step but one in time: how far it goes, and what follows.

    Attributes
    ----------
    points
        Number of points up to the target.
    until
        Where the step ends.
    then
        What follows an instability at the end: a snap, or the branch.
    snap
        Keys of the motion of a snap.
    hold
        Amplitude -> "conjugate" where its conjugate is held in place of the load.
    search
        Keys of the search for further solutions at the end.
    branches, sensitivities
        Whether the branches of a bifurcation are followed, and sensitivities computed.
    """

    points: int
    until: Literal["limit", "bifurcation", "target", "points", "zero"]
    then: Literal["snap", "follow"]
    snap: Mapping[str, Any]
    hold: Mapping[str, Any]
    search: Mapping[str, Any]
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


StepKind: TypeAlias = Literal[
    "pressure",
    "indentation",
    "field",
    "rotation",
    "natural",
    "imperfection",
    "dead",
    "edge",
    "contact",
    "source",
    "time",
    "spin",
    "gravity",
    "interaction",
    "crease",
    "fold",
]


class StepKeys(CourseKeys, total=False):
    """Keys of steps of all kinds; which kind has which is checked when the step is made.

    Attributes
    ----------
    control
        What is prescribed: the load, what is conjugate to it, or the arc length of the path.
    factor
        Target of "field", "imperfection", "dead", "edge", "source", "interaction", "crease".
    pressure, volume_change, on, profile
        Of "pressure", as of `PressureKeys`.
    at, depth, force, patch
        Of "indentation": the point, and as of `ForceKeys`.
    body, approach
        Of "contact": the body's name and the target, beside `force`.
    loads, displacement
        Of "dead": the forces, tractions and moments, and a target.
    name, moves, reaction
        Of "edge": the name of its columns, what moves, and a target.
    grows, curvature, stretch
        Of "natural": what grows, and the targets.
    item
        Of "imperfection": its number.
    source, move, to, turn, strength
        Of "source": its number or name, and what becomes of it; `to` of "rotation" the direction.
    speed
        Of "spin": the target.
    direction, acceleration
        Of "gravity": where the weight points, and the target.
    duration, history, rho_inf, step, tolerance, errors, balance, drag, push, velocity, event
        Of "time".
    """

    control: Literal["volume", "load", "arc", "displacement", "reaction", "approach", "force"]
    factor: float
    pressure: Amount
    volume_change: Amount
    on: Mapping[str, Literal["outside", "inside"]]
    profile: str
    at: Mapping[str, Any]
    depth: Amount
    force: Amount
    patch: Amount
    body: str
    approach: Amount
    loads: Sequence[Mapping[str, Any]]
    displacement: Amount
    name: str
    moves: Sequence[Mapping[str, Any]]
    reaction: Amount
    grows: Literal["curvature", "stretch"]
    curvature: float
    stretch: float
    item: int
    source: int | str
    move: Sequence[Amount]
    to: Mapping[str, Any] | Sequence[Amount]
    turn: Mapping[str, Any]
    strength: float
    speed: Amount
    direction: Sequence[float]
    acceleration: Amount
    duration: Amount
    history: Mapping[str, Any]
    rho_inf: float
    step: Amount
    tolerance: float
    errors: Literal["step", "motion"]
    balance: float
    drag: Amount
    push: Mapping[str, Any]
    velocity: Sequence[Amount]
    event: Mapping[str, Any]


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
