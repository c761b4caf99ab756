"""Stresses at points: the key `stress` of a case, and columns of membrane forces, moments, shear
forces and stresses of the faces.

N and M are force and moment per length of the undeformed surface; Q is the shear force per length,
the divergence of M. Directions 1 and 2 lie in the undeformed surface and turn with it: 1 is along
a vector's part in the surface, or along the meridian, and 2 is n x 1 with the outward normal n. The
top is the outer face. E is Young's modulus, h the thickness, D the bending stiffness and R the
reference length. A model's frame is turned about e3 from that of the case.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.parts.ability import (
    GEOMETRIES_WITHOUT_MERIDIAN,
    Ability,
    Context,
    Modelled,
)
from magshell_fenicsx.parts.observables import ModelView, Observables
from magshell_fenicsx.quantities.stresses import stress_columns

if TYPE_CHECKING:
    from magshell_fenicsx.continuation.system import State
    from magshell_fenicsx.parts.loads import Loads

Array = NDArray[np.float64]
LEAST_SINE = 1e-6  # of a direction and the normal: below, the direction has no part in the surface


@dataclass(frozen=True)
class StressPoint:
    """A point of the shell at which stresses are read, in the frame of the model.

    Attributes
    ----------
    name
        Name in the case, with which its columns begin.
    place
        (3,) over R; named points lie in the modelled part of a shell.
    vectors
        (n, 3): direction 1 is the part in the surface of the first one that is not normal to it.
    has_meridian
        Whether direction 1 is along the meridian about e3, where there is one.
    """

    name: str
    place: Array
    vectors: Array
    has_meridian: bool


@dataclass(frozen=True)
class StressReading:
    """The points of a case at which stresses are read.

    Attributes
    ----------
    points
        The points; there may be none, where fields alone are wanted.
    has_plies
        Whether a shell is a laminate, whose stresses jump between plies: then only forces and
        moments are read.
    """

    points: tuple[StressPoint, ...]
    has_plies: bool = False

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns of all points."""
        return tuple(
            f"{point.name}_{column}"
            for point in self.points
            for column in stress_columns(has_stresses=not self.has_plies)
        )


@dataclass(frozen=True)
class StressState:
    """Tensors at a point of a shell, in space.

    Attributes
    ----------
    normal
        Unit normal (3,) of the undeformed surface.
    place
        (3,) over R.
    tensors
        "N" over E h, "M" over D/R, "stress_top", "stress_middle" and "stress_bottom" over E -> (3,
        3), tangent to the surface.
    shear
        Q (3,) over D/R².
    """

    normal: Array
    place: Array
    tensors: Mapping[str, Array]
    shear: Array


@dataclass(frozen=True)
class StressPoints(Ability):
    """The points at which stresses are read: the key `stress`.

    Attributes
    ----------
    names
        Names of points of the case.
    """

    names: Sequence[str] = field(default_factory=list)

    @classmethod
    def from_context(cls, context: Context) -> "StressPoints | None":
        names = context.sections.get("stress")
        return None if names is None else cls(names)

    def refuse_unfit(self, context: Context) -> None:
        """Refuse unknown points, a solid, rubber, and growth, with a ValueError."""
        for i, name in enumerate(self.names):
            context.has_point(f"stress.{i}", name)
        context.needs("stress", "a mid-surface")
        context.needs(
            "stress",
            "a thickness that does not change",
            hint="of rubber fields/ have stretches and true stresses, sigma_1 and sigma_2",
        )
        natural = context.sections.get("natural")
        if natural and natural.stretch is not None:
            raise ValueError(
                "stress: not beside natural.stretch: forces per length are those of the drawn "
                "surface, which is not the grown one"
            )

    def contribution(self, context: Context, modelled: Modelled) -> "Loads":
        """Return the points in the frame of the model."""
        from magshell_fenicsx.parts.loads import Loads  # the solver takes long to import

        shell, Q = context.shell, rotation(modelled.turn)
        direction = self._direction(context)
        vectors = np.array([*([] if direction is None else [direction]), *np.eye(3)]) @ Q.T
        points = tuple(
            StressPoint(
                name,
                np.asarray(Q @ context.points[name] / shell.reference),
                vectors,
                has_meridian=direction is None,
            )
            for name in self.names
        )
        shells = context.sections.get("shells") or {}
        members = [shell, *(section.shell for section in shells.values())]
        return Loads(stress=StressReading(points, any(m.laminate for m in members)))

    @staticmethod
    def _direction(context: Context) -> Array | None:
        """Return the vector of direction 1, that of the plies if there are some; None: meridian."""
        shell = context.shell
        if shell.laminate:
            return shell.laminate.direction(shell.geometry)
        return np.eye(3)[0] if shell.geometry in GEOMETRIES_WITHOUT_MERIDIAN else None


class StressObservables(Observables):
    """Membrane forces, moments, shear forces and stresses at named points."""

    def columns(self, loads: "Loads", supports: Sequence[str]) -> tuple[str, ...]:
        return loads.stress.columns if loads.stress else ()

    def observe(self, view: ModelView, state: "State") -> dict[str, float]:
        """Return column -> number at all points; collective."""
        reading = view.loads.stress
        if not (reading and reading.points):
            return {}
        columns = dict[str, float]()
        states = view.model.stresses(state)
        for point in reading.points:
            for column, value in components(states[point.name], point).items():
                columns[f"{point.name}_{column}"] = value
        return {column: columns[column] for column in reading.columns}


def components(state: StressState, point: StressPoint) -> dict[str, float]:
    """Return the ending of a column -> number at a point, in the directions 1 and 2."""
    t = directions(point, state.normal, state.place)
    numbers = dict[str, float]()
    for name, T in state.tensors.items():
        symbol, _, layer = name.replace("stress", "sigma").partition("_")
        ending = f"_{layer}" if layer else ""
        in_surface = t @ T @ t.T
        for i, j in ((0, 0), (0, 1), (1, 1)):
            numbers[f"{symbol}{i + 1}{j + 1}{ending}"] = float(in_surface[i, j])
        if layer:
            numbers[f"mises_{layer}"] = float(von_mises(in_surface))
    Q1, Q2 = t @ state.shear
    return numbers | {"Q1": float(Q1), "Q2": float(Q2)}


def von_mises(S: Array) -> Array:
    """Return von Mises' stress (...) of plane stress S, (..., 2, 2) or in space (..., 3, 3)."""
    trace = np.einsum("...ii->...", S)
    square = 1.5 * np.einsum("...ij,...ij->...", S, S) - 0.5 * trace**2
    return np.asarray(np.sqrt(np.maximum(square, 0.0)))


def directions(point: StressPoint, normal: Array, place: Array) -> Array:
    """Return the unit vectors 1 and 2 (2, 3) of a point, in its tangent plane.

    `normal` and `place` (3,) are those of the undeformed surface.
    """
    # (e3 x r) x n is along the meridian, away from the pole; e3 x r is zero at the pole
    meridian = np.cross(np.cross(np.eye(3)[2], place), normal)
    vectors = [*([meridian] if point.has_meridian else []), *point.vectors]
    parts = [vector - (vector @ normal) * normal for vector in vectors]
    in_surface = next(part for part in parts if np.linalg.norm(part) > LEAST_SINE)
    first = in_surface / np.linalg.norm(in_surface)
    return np.stack([first, np.cross(normal, first)])
