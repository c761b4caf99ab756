"""The remanence: the section `remanent` of a case, or of one of its shells.

A section is a part of a case file, checked by pydantic; validators raise ValueError. The remanence
B^r is the flux density of the magnetised material without a field; its direction is by polar angle
from e3 and azimuth around it. A pose is the place of one of several shells in the case.
"""

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from magshell_fenicsx.input.expressions import Formula
from magshell_fenicsx.input.section import Direction, FileKeys, FluxDensity, OrInMemory
from magshell_fenicsx.mesh.multi_shell import ShellPose
from magshell_fenicsx.mesh.patch import UserField


class Layer(Direction):
    """A layer of the thickness, magnetised in one direction."""

    fraction: float = Field(gt=0, le=1)
    """Of the thickness; all add up to one [h]"""


class RemanentSection(FileKeys, Direction):
    """The remanent flux density B^r; `polar` and `azimuth` belong to the uniform one.

    radial: along the normal. tangential: along the meridians, away from e3. expression: components
    as formulas of the undeformed position x, y, z over R. patches: a direction per named patch,
    "dimple" (within its rim) of a hemisphere, those of a mesh, and "rest". layers: from the inner
    face outwards; a shell takes their average. points: vectors at points, of which each place has
    the mean, weighted by exp(-(distance/filter)²).
    """

    kind: Literal[
        "uniform", "radial", "tangential", "expression", "patches", "layers", "points"
    ] = "uniform"
    """How it varies in space"""
    flux_density: FluxDensity | None = Field(default=None, ge=-1e3, le=1e3)
    """|B^r|, at most 1000 T; with that of `applied` in place of lambda_m; negative: the remanence
    is reversed"""
    components: Annotated[
        Annotated[list[Formula], Field(min_length=3, max_length=3)] | UserField | None,
        OrInMemory(UserField),
    ] = None
    """Of kind: expression: arithmetic of x, y, z, pi and sin, cos, tan, exp, log, sqrt, abs, sign,
    arctan2 [|B^r|]"""
    patches: dict[str, Direction] | None = None
    """Of kind: patches: name -> direction"""
    layers: list[Layer] | None = Field(default=None, min_length=1)
    """Of kind: layers: those through the thickness"""
    file: str | None = None
    """Of kind: points: CSV with the columns x, y, z, bx, by, bz, or rho, z, b_rho, b_z of a field
    that turns about e3; undeformed places over R, vectors over |B^r|, the path from the folder of
    the case"""
    filter: float | None = Field(default=None, gt=0, le=10)
    """Of kind: points: distance over which the points are averaged [R]"""

    _of_shell: tuple[ShellPose, float] | None = PrivateAttr(default=None)

    @model_validator(mode="after")
    def _keys_of_the_kind(self) -> Self:
        """Refuse keys that do not belong to the kind, or are missing for it, with a ValueError."""
        # key -> the kind that needs it, and alone may have it
        kind_of_key = {"components": "expression", "patches": "patches", "layers": "layers"}
        kind_of_key |= {"file": "points", "filter": "points"}
        for key, kind in kind_of_key.items():
            if (getattr(self, key) is not None) != (self.kind == kind):
                raise ValueError(
                    f"{key} belongs to kind: {kind}, and must be given there; the kind is "
                    f"{self.kind}"
                )
        if self.kind != "uniform" and {"polar", "azimuth"} & self.model_fields_set:
            raise ValueError(f"polar and azimuth belong to kind: uniform; the kind is {self.kind}")
        if isinstance(self.components, UserField) and self.components.size != 3:
            raise ValueError(
                f"components: a function of {self.components.size} numbers; a vector has three"
            )
        if self.layers and abs(sum(layer.fraction for layer in self.layers) - 1) > 1e-6:
            raise ValueError("the fractions of the layers must add up to 1")
        return self

    def placed(self, place: ShellPose, factor: float) -> "RemanentSection":
        """Return the remanence of one shell of several, in that shell's frame, times a factor."""
        copied = self.model_copy()
        copied._of_shell = place, factor
        return copied

    @property
    def of_shell(self) -> tuple[ShellPose, float] | None:
        """Place of its shell and factor of the remanence; None in the frame of the case."""
        return self._of_shell

    def directions(self) -> list[Direction]:
        """Return all directions that a mirror plane must hold.

        There are none for radial and tangential patterns, which allow every plane.
        """
        if self.kind == "uniform":
            return [self]
        return [*(self.patches or {}).values(), *(self.layers or [])]


def layer_average(layers: list[Layer], turn: float = 0.0) -> NDArray[np.float64]:
    """Return the average (3,) of the layers' unit vectors over the thickness.

    A shell keeps only this average. `turn` is the frame's azimuth in radians.
    """
    return np.asarray(np.sum([layer.fraction * layer.vector(turn) for layer in layers], axis=0))
