"""Base of all sources of the applied field: their sections, and their fields at their places.

A source is a magnet, a coil, a grid or formulas. It has axes of its own, in which places are in m
and B in T; `FieldOfSource` is its field there. `PlacedSource` is the field in the model's frame,
with places over R and B over |B^a|, the applied field's reference. A field (`FieldInSpace`) is a
function of places that returns B with its first and second derivatives. `Values` are functions of
places (n, 3) to arrays. A solid is a body as it is drawn; `magpylib` is the package that computes
fields.
"""

from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import product
from types import ModuleType
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from magshell_fenicsx.input.section import Direction, FluxDensity, Section, or_number
from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.parts.magnetism.moving_source import FieldInSpace
from magshell_fenicsx.shape.drawn_bodies import Solid

Array = NDArray[np.float64]
Values = Callable[[Array], Array]
Metres = Annotated[float, or_number("metre"), Field(ge=-1e6, le=1e6)]
Size = Annotated[float, or_number("metre"), Field(gt=0, le=1e6)]
Position = Annotated[list[Metres], Field(min_length=3, max_length=3)]
Polarization = (
    Annotated[FluxDensity, Field(ge=-1e3, le=1e3)]
    | Annotated[
        list[Annotated[FluxDensity, Field(ge=-1e3, le=1e3)]], Field(min_length=3, max_length=3)
    ]
)
Current = Annotated[float, or_number("ampere"), Field(ge=-1e9, le=1e9)]
SourceName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=40)]
# of `Harmonic`: step over the distance from the source, and degree of the harmonic polynomials
STEP, DEGREE = 0.005, 5


@dataclass(frozen=True)
class FieldOfSource:
    """The field of a source in its own axes.

    Attributes
    ----------
    values
        Places (n, 3) in m -> B in T with its first and second derivatives; not finite where there
        is no field.
    lines
        Outline of the source: places (n, 3) along lines, in m.
    nowhere
        Words for a place without a field, such as "inside".
    solid
        Faces of a magnet with its poles, in m; None for other sources.
    """

    values: FieldInSpace
    lines: Sequence[Array]
    nowhere: str
    solid: Solid | None = None


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
    def axes(self) -> Array:
        """Axes of the source as columns (3, 3), in the frame of the case."""
        # sines and cosines of the three angles
        (sp, cp), (sa, ca), (ss, cs) = (
            (np.sin(t), np.cos(t))
            for t in np.radians([self.axis.polar, self.axis.azimuth, self.spin])
        )
        # rotations by spin about z, then by polar about y, then by azimuth about z
        by_spin = np.array([[cs, -ss, 0.0], [ss, cs, 0.0], [0.0, 0.0, 1.0]])
        by_polar = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
        by_azimuth = np.array([[ca, -sa, 0.0], [sa, ca, 0.0], [0.0, 0.0, 1.0]])
        return np.asarray(by_azimuth @ by_polar @ by_spin)

    def words(self) -> str:
        """Return the source in words, for the account of what is built."""
        return f"{self.kind} at ({', '.join(f'{1e3 * x:g}' for x in self.position)}) mm"

    def field(self, key: str, R: float) -> FieldOfSource:
        """Return the field in the source's own axes.

        Parameters
        ----------
        key
            Key of the source in the case file, for messages.
        R
            Reference length in m, the unit of places in formulas.

        Raises
        ------
        CaseError
            If magpylib is missing, or a file is no grid.
        """
        raise NotImplementedError


class MagnetSection(SourceSection):
    """Base of all magnets."""

    position: Position
    """Of its middle [m]"""
    polarization: Polarization
    """Along its own z axis, or three components along its own axes: its remanence, μ0 times its
    magnetisation"""

    @property
    def vector(self) -> Array:
        """The polarization (3,) in its own axes, in T."""
        J = self.polarization
        return np.array(J if isinstance(J, list) else [0.0, 0.0, J])

    @abstractmethod
    def values(self, magnets: ModuleType) -> Values:
        """Return the function from places (n, 3) in m to B (n, 3) in T, in the magnet's own axes.

        `magnets` is the module of magpylib with its magnets.
        """

    @abstractmethod
    def distance(self, x: Array) -> Array:
        """Return the distance (n,) of places (n, 3) in m from the magnet; negative inside."""

    @abstractmethod
    def lines(self) -> list[Array]:
        """Return the outline for pictures: places (n, 3) along lines, in m."""

    @abstractmethod
    def solid(self) -> Solid:
        """Return the faces for pictures, in m."""

    def field(self, key: str, R: float) -> FieldOfSource:
        """Return the field of the magnet in its own axes.

        `key` is its key in the case file, for messages. R, the unit of formulas, is not used.
        """
        values = Harmonic(self.values(magpylib(key).magnet), self.distance)
        solid = self.solid().magnetised(
            self.strength * self.vector, self.name or f"{self.kind} magnet"
        )
        return FieldOfSource(values, self.lines(), "inside", solid)


def to_box(outside_by: Array) -> Array:
    """Return the distance (n,) of places from a box; negative inside.

    `outside_by` (n, m) is how far places are beyond the faces in each direction, negative within
    them.
    """
    distance_outside = np.linalg.norm(np.maximum(outside_by, 0.0), axis=1)
    minus_depth_inside = np.minimum(outside_by.max(axis=1), 0.0)
    return np.asarray(distance_outside + minus_depth_inside)


@dataclass(frozen=True)
class PlacedSource:
    """A source at its place as a `FieldInSpace`: lengths over R, B over |B^a|.

    Attributes
    ----------
    own
        Its field in its own axes.
    position
        (3,) over R, in the model's frame.
    axes
        (3, 3) the source's own axes as columns, in the same frame.
    length
        R in m.
    factor
        Number that multiplies B in T.
    key
        Key of the source in the case file.
    """

    own: FieldOfSource
    position: Array
    axes: Array
    length: float
    factor: float
    key: str

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return B (n, 3) over |B^a| at places x (n, 3) over R, with both derivatives."""
        # to the source's own axes, in m; a derivative by lengths over R has the factor R
        Q, R = self.axes, self.length
        B, G, H = self.own.values(R * (x - self.position) @ Q)
        return (
            self.factor * B @ Q.T,
            np.einsum("ai,bj,nij->nab", Q, Q, G, optimize=True) * (self.factor * R),
            np.einsum("ai,bj,ck,nijk->nabc", Q, Q, Q, H, optimize=True) * (self.factor * R**2),
        )

    def distance(self, x: Array) -> Array:
        """Return the distance (n,) of places (n, 3) from the source's body, over R.

        It is negative inside, and infinite if there is no body.
        """
        # grids and formulas have no body
        distance_to_source = getattr(self.own.values, "distance", None)
        return (
            np.full(len(x), np.inf)
            if distance_to_source is None
            else distance_to_source(self.length * (x - self.position) @ self.axes) / self.length
        )

    @property
    def nowhere(self) -> str:
        """Description of a place without a field."""
        return f"is {self.own.nowhere} {self.key}"

    @property
    def lines(self) -> list[Array]:
        """Outline: places (n, 3) along lines, over R."""
        return [self.position + line / self.length @ self.axes.T for line in self.own.lines]

    @property
    def solid(self) -> Solid | None:
        """Faces, over R; None without any."""
        own_solid = self.own.solid
        return (
            own_solid.transformed(self.axes, self.position, 1 / self.length) if own_solid else None
        )


def magpylib(key: str) -> ModuleType:
    """Return the package magpylib; only cases with magnets or coils need it.

    Raises
    ------
    CaseError
        If the package is missing, with the command that installs it.
    """
    try:
        import magpylib
    except ImportError:
        raise CaseError(
            f"{key}: magnets and coils need the package magpylib: python3 -m pip install "
            "--no-deps magpylib"
        ) from None
    return magpylib  # type: ignore[no-any-return]


@dataclass(frozen=True)
class Harmonic:
    """A field outside its sources with its derivatives, from its values alone.

    There B has neither a divergence nor a curl, so around any place it is the gradient of a series
    of harmonic polynomials. The values at the place itself, at six points on the axes and at eight
    on the diagonals of a cube, all at the distance a, determine the first and second derivatives
    exactly if the series ends at degree 5. What is left out is of order (a/d)^4, with the distance
    d from the nearest source; rounding is of order (d/a)^2. With a = 0.005 d both are 1e-9 of the
    derivatives of a cylinder magnet, measured against 27 points at 0.03 d.

    Attributes
    ----------
    values
        Places (n, 3) -> B (n, 3).
    distance
        Places (n, 3) -> distance (n,) from the nearest source, negative inside a magnet, where the
        field is nan.
    """

    values: Values
    distance: Values

    def __call__(self, x: Array) -> tuple[Array, Array, Array]:
        """Return B (n, 3) at places x (n, 3) with its first and second derivatives.

        All are nan inside a magnet and where the distance is not finite.
        """
        # points of the stencil around each place, at 0.005 of its distance
        d = self.distance(x)
        outside = np.isfinite(d) & (d > 0)
        B, G, H = (np.full((len(x), *shape), np.nan) for shape in ((3,), (3, 3), (3, 3, 3)))
        if not outside.any():
            return B, G, H
        points, first, second = stencil()
        step = STEP * d[outside]
        around = self.values((x[outside, None] + step[:, None, None] * points).reshape(-1, 3))
        flat = np.reshape(around, (len(step), 3 * len(points)))
        B[outside] = flat[:, :3]
        G[outside] = (flat @ first / step[:, None]).reshape(-1, 3, 3)
        H[outside] = (flat @ second / step[:, None] ** 2).reshape(-1, 3, 3, 3)
        return B, G, H


@cache
def stencil() -> tuple[Array, Array, Array]:
    """Return the points of `Harmonic` and the weights that give derivatives of values there.

    B is the gradient of a harmonic function. The harmonic polynomials of degree l are sums of
    powers (a . x)^l, where a are null vectors: a . a = 0. So weights that are exact for the
    gradients of these powers, up to the degree `DEGREE`, are exact for all such polynomials. Of
    these weights the least ones are taken.

    Returns
    -------
    points
        (m, 3) at the distance 0 or 1.
    first_weights, second_weights
        (3 m, 9) and (3 m, 27): from values at the points to first and second derivatives at 0.
    """
    axes, diagonals = (
        np.vstack([np.eye(3), -np.eye(3)]),
        np.array([*product((-1.0, 1.0), repeat=3)]) / np.sqrt(3),
    )
    points = np.vstack([np.zeros((1, 3)), axes, diagonals])
    # for the gradient of each power: its values at the points, and its derivatives at 0
    values, first, second = list[Array](), list[Array](), list[Array]()
    for degree in range(1, DEGREE + 1):
        # 2 l + 1 null vectors, as many as there are harmonic polynomials
        for t in 2 * np.pi * np.arange(2 * degree + 1) / (2 * degree + 1):
            a = np.array([np.cos(t), np.sin(t), 1j])
            # the gradient is l (a . x)^(l - 1) a; points with a . x = 0 make 0^0 a case of its own
            power = np.ones(len(points)) if degree == 1 else (points @ a) ** (degree - 1)
            # derivatives at 0 of the gradient of (a . x)^l
            by_x = 2.0 * (degree == 2) * np.outer(a, a).ravel()
            by_x_twice = 6.0 * (degree == 3) * np.einsum("i,j,k->ijk", a, a, a).ravel()
            for part in (np.real, np.imag):
                values.append(part(degree * np.outer(power, a).ravel()))
                first.append(part(by_x))
                second.append(part(by_x_twice))
    inverse = np.linalg.pinv(np.array(values), rcond=1e-10)
    first_weights, second_weights = (
        np.asarray(inverse @ np.array(rows), dtype=float) for rows in (first, second)
    )
    return points, first_weights, second_weights
