"""Keys of loads in a case, with their types, for arguments of `python.Pressure` and others.

An editor and mypy know them from here. Values are checked when a problem is made.

An amount is a number over the load's unit, or text with a unit such as "100 Pa".
"""

from collections.abc import Mapping
from typing import Any, Literal, TypeAlias, TypedDict

Amount: TypeAlias = float | str


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
    """

    control: Literal["volume", "load", "arc"]
    pressure: Amount
    volume_change: Amount
    on: Mapping[str, Literal["outside", "inside"]]


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
