"""What all sources of the applied field have in common."""

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.direction import Direction
from magshell_fenicsx.input.section import FluxDensity, Section, or_number

Metres = Annotated[float, or_number("metre"), Field(ge=-1e6, le=1e6)]
Size = Annotated[float, or_number("metre"), Field(gt=0, le=1e6)]
Position = Annotated[list[Metres], Field(min_length=3, max_length=3)]
Polarization = (
    Annotated[FluxDensity, Field(ge=-1e3, le=1e3)]
    | Annotated[list[Annotated[FluxDensity, Field(ge=-1e3, le=1e3)]], Field(min_length=3, max_length=3)]
)
Current = Annotated[float, or_number("ampere"), Field(ge=-1e9, le=1e9)]
SourceName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=40)]


class SourceSection(Section):
    """Base of all kinds: a field in tesla, in axes of its own at a place of its own."""

    kind: str
    name: SourceName | None = None
    """For steps and pictures; by default its number in the list, from 0"""
    position: Position = Field(default=[0.0, 0.0, 0.0])
    """Of its middle, or of the origin of its own axes [m]"""
    axis: Direction = Direction.model_construct()
    """Direction of its own z axis, e3 by default"""
    spin: float = 0.0
    """Angle by which its own x and y axes are turned about that [degree]"""
    strength: float = Field(default=1.0, ge=-1e6, le=1e6)
    """Factor of its field"""

    @property
    def axes(self) -> NDArray[np.float64]:
        """Its own axes as columns (3, 3)."""
        (sp, cp), (sa, ca), (ss, cs) = (
            (np.sin(t), np.cos(t)) for t in np.radians([self.axis.polar, self.axis.azimuth, self.spin])
        )
        about_z = np.array([[ca, -sa, 0.0], [sa, ca, 0.0], [0.0, 0.0, 1.0]])
        about_y = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
        return np.asarray(about_z @ about_y @ np.array([[cs, -ss, 0.0], [ss, cs, 0.0], [0.0, 0.0, 1.0]]))

    def words(self) -> str:
        """Its words in the account of what is built."""
        return f"{self.kind} at ({', '.join(f'{1e3 * x:g}' for x in self.position)}) mm"


class MagnetSection(SourceSection):
    """Base of all magnets."""

    position: Position
    """Of its middle [m]"""
    polarization: Polarization
    """Along its own z axis, or three components along its own axes: its remanence, μ0 times its magnetisation"""

    @property
    def vector(self) -> NDArray[np.float64]:
        """The polarization (3,) in its own axes, in T."""
        J = self.polarization
        return np.array(J if isinstance(J, list) else [0.0, 0.0, J])
