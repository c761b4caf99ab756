"""Blocks of design variables: numbers of the case, vectors of the remanence, scalar fields."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from magshell_fenicsx.assembly.field_gradient import FieldGradient
from magshell_fenicsx.input.section import si_size
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.mesh.multi_shell import ShellPose
from magshell_fenicsx.models.shell.control_points import ControlledPattern, ControlPoints
from magshell_fenicsx.simulate.scene import Scene

Array = NDArray[np.float64]
Limits = tuple[float | None, float | None]
GradientsByName = Mapping[str, Any]  # the gradients of a result, numbers and those by fields


@dataclass(frozen=True)
class Bounded:
    """Values whose variables run from 0 to 1 between their bounds.

    Attributes
    ----------
    name
        The key of the case, or the field.
    start
        The values of the case itself.
    """

    name: str
    start: Array
    bounds: tuple[float, float]

    @property
    def start_values(self) -> Array:
        """The variables at the start."""
        return np.asarray((self.start - self.bounds[0]) / (self.bounds[1] - self.bounds[0])).ravel()

    @property
    def limits(self) -> list[Limits]:
        """Bounds of the variables; all lie between 0 and 1."""
        return [(0.0, 1.0)] * self.start.size

    def values(self, x: Array) -> Array:
        """The values of variables, in the shape of `start`."""
        low, high = self.bounds
        return np.asarray(low + x * (high - low)).reshape(self.start.shape)


@dataclass(frozen=True)
class NumberVariable(Bounded):
    """A number of the case, in a unit."""

    unit: str

    @property
    def label(self) -> str:
        """The key with its unit, if it has one."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def gradient(self, x: Array, scene: Scene, gradients: GradientsByName) -> Array:
        slope = gradients.get(self.name, 0.0)
        return np.array([slope * si_size(self.unit) * (self.bounds[1] - self.bounds[0])])

    def put(self, data: dict[str, Any], x: Array) -> None:
        section: Any = data
        *names, last = self.name.split(".")
        for name in names:
            section = (
                section[int(name)] if isinstance(section, list) else section.setdefault(name, {})
            )
        value = float(self.values(x)[0])
        section[int(last) if isinstance(section, list) else last] = (
            f"{value:.15g} {self.unit}" if self.unit else value
        )


def by_components(scene: Scene, field_gradient: FieldGradient) -> Array:
    """The derivatives by the components of the remanence at its points; collective."""
    loads = scene.problem.loads
    magnetic = loads.magnetic or loads.remanence
    assert magnetic
    assert isinstance(magnetic.remanent, ControlledPattern)
    return np.asarray(
        field_gradient.field.function_space.mesh.comm.allreduce(
            magnetic.remanent.transposed(field_gradient.places, field_gradient.forces)
        )
    )


@dataclass(frozen=True)
class Vectors:
    """The remanence at points, of which each place has the mean.

    Each vector has a polar angle, an azimuth where it is not kept in a plane, and its length where
    that varies, from 0 to 1 between its bounds.

    Attributes
    ----------
    start
        (n, 3), or (n, 2) on a meridian.
    lengths
        Least and largest length; None: they stay as they are.
    """

    controls: ControlPoints
    start: Array
    lengths: tuple[float, float] | None
    name: str = "remanence"

    @property
    def planar(self) -> bool:
        """Whether the vectors stay in a plane."""
        return self.controls.is_axisymmetric or not self.controls.places[:, 1].any()

    @property
    def angles(self) -> int:
        """How many of its variables are angles; they come first."""
        return len(self.start) * (1 if self.planar else 2)

    @property
    def start_values(self) -> Array:
        horizontal = self.start[:, 0] if self.planar else np.hypot(*self.start[:, :2].T)
        parts = [np.arctan2(horizontal, self.start[:, -1])]
        if not self.planar:
            parts.append(np.arctan2(self.start[:, 1], self.start[:, 0]))
        if self.lengths:
            size = np.linalg.norm(self.start, axis=1)
            parts.append((size - self.lengths[0]) / (self.lengths[1] - self.lengths[0]))
        return np.concatenate(parts)

    @property
    def limits(self) -> list[Limits]:
        return [(None, None)] * self.angles + [(0.0, 1.0)] * (
            len(self.start) if self.lengths else 0
        )

    def vectors(self, x: Array) -> Array:
        """The vectors at the control points, (n, 3) or (n, 2), for variables x."""
        return self._polar(x)[0]

    def gradient(self, x: Array, scene: Scene, gradients: GradientsByName) -> Array:
        if not isinstance(field_gradient := gradients.get(self.name), FieldGradient):
            return np.zeros(len(x))
        forces = by_components(scene, field_gradient)
        return np.concatenate(
            [np.sum(forces * angle_derivative, axis=1) for angle_derivative in self._polar(x)[1]]
        )

    def _polar(self, x: Array) -> tuple[Array, list[Array]]:
        """Vectors, and their derivatives by each of their variables."""
        polar, *other_variables = x.reshape(-1, len(self.start))
        s, c = np.sin(polar), np.cos(polar)
        size, grows = np.linalg.norm(self.start, axis=1), 0.0
        if self.lengths:
            grows = self.lengths[1] - self.lengths[0]
            size = self.lengths[0] + other_variables[-1] * grows
        lengths = size[:, None]
        if self.planar:
            no_component = [] if self.controls.is_axisymmetric else [0 * s]
            unit, polar_derivative = (
                np.stack(v, axis=1) for v in ([s, *no_component, c], [c, *no_component, -s])
            )
            derivatives = [lengths * polar_derivative]
        else:
            a, b = np.cos(other_variables[0]), np.sin(other_variables[0])
            unit = np.stack([s * a, s * b, c], axis=1)
            derivatives = [
                lengths * np.stack([c * a, c * b, -s], axis=1),
                lengths * np.stack([-s * b, s * a, 0 * s], axis=1),
            ]
        return lengths * unit, [*derivatives, *([grows * unit] if self.lengths else [])]

    def put(self, data: dict[str, Any], x: Array) -> None:
        remanent = data["magnetic"].get("remanent") or {}
        flux_density = (
            {"flux_density": remanent["flux_density"]} if "flux_density" in remanent else {}
        )
        data["magnetic"]["remanent"] = {
            "kind": "points",
            "file": "",
            "filter": self.controls.width,
            **flux_density,
        }


@dataclass(frozen=True)
class ControlPointField(Bounded):
    """The values (n, components) of a scalar field at points, of which each place has the mean.

    They are factors of h, curvatures 11 and 22 over 1/R, or deviations over h. In the case such a
    field is a formula, with the weights of `models.shell.control_points`: it needs no file, and its
    symmetry is recognised by its values.

    Attributes
    ----------
    length
        R in the unit of the case's formulas, of a curvature.
    shells
        Of several: the place of each, and its thickness over h.
    """

    controls: ControlPoints
    length: float = 1.0
    shells: Mapping[str, tuple[ShellPose, float]] = field(default_factory=dict)

    def gradient(self, x: Array, scene: Scene, gradients: GradientsByName) -> Array:
        if not isinstance(field_gradient := gradients.get(self.name), FieldGradient):
            return np.zeros(len(x))
        places = field_gradient.places.reshape(-1, 3) @ rotation(scene.problem.azimuth)
        forces = field_gradient.forces.reshape(len(places), -1)[:, : self.start.shape[1]]
        if self.name == "thickness" and self.shells:
            forces = forces * self._shell_ratios(scene, field_gradient.forces.shape[:2])
        comm = field_gradient.field.function_space.mesh.comm
        pulled = comm.allreduce(np.asarray(self.controls.weights(places).T @ forces))
        unit = scene.problem.material.h if self.name == "deviation" else 1.0
        return np.asarray(pulled * unit * (self.bounds[1] - self.bounds[0])).ravel()

    def put(self, data: dict[str, Any], x: Array) -> None:
        values = self.values(x).T
        if self.name == "curvature":
            texts = [self._formula(component, self.controls, self.length) for component in values]
            data["natural"] = {**(data.get("natural") or {}), "curvature": [*texts, 0]}
            return
        alone = {"": (data["shell"], self.controls, 1.0)} if not self.shells else {}
        of_several = {
            name: (data["shells"][name]["shell"], *self._controls_on_shell(*pose_and_ratio))
            for name, pose_and_ratio in self.shells.items()
        }
        for shell, controls, ratio in (alone | of_several).values():
            if self.name == "thickness":
                shell["thickness_factor"] = self._formula(values[0], controls)
                continue
            defect = [shell.pop("defect")] if shell.get("defect") else []
            new = {"kind": "formula", "w0": self._formula(values[0] / ratio, controls)}
            shell["imperfections"] = [*defect, *(shell.get("imperfections") or ()), new]

    def _controls_on_shell(self, place: ShellPose, ratio: float) -> tuple[ControlPoints, float]:
        """The points in the frame of one of several shells, over its own length."""
        control_points = self.controls.places
        x = place.to_shell_frame(
            np.insert(control_points, 1, 0.0, axis=1)
            if self.controls.is_axisymmetric
            else control_points
        )
        points_of_shell = (
            np.column_stack([np.hypot(x[:, 0], x[:, 1]), x[:, 2]])
            if self.controls.is_axisymmetric
            else x
        )
        return ControlPoints(points_of_shell, self.controls.width / place.scale), ratio

    def _shell_ratios(self, scene: Scene, shape: tuple[int, ...]) -> Array:
        """Derivative (nodes of cells, 1) of the thickness over h by the factor of the thickness of
        each point's own shell.
        """
        surface = scene.model.meridian if scene.model.axisymmetric else scene.model.midsurface
        assert surface
        ratios = np.ones(shape)
        for name, (_, ratio) in self.shells.items():
            ratios[surface.patches[name][: shape[0]]] = ratio
        return ratios.reshape(-1, 1)

    def _formula(self, values: Array, controls: ControlPoints, R: float = 1.0) -> str:
        """Formula of the field for values at the control points, with lengths over R except for a
        curvature.
        """
        if np.ptp(values) == 0:
            return repr(float(values[0] / R))
        squared_width = repr(float(controls.width * R) ** 2)
        weights = [
            f"exp(-({self._square(place * R)})/{squared_width})" for place in controls.places
        ]
        parts = (f"{float(v / R)!r}*{w}" for v, w in zip(values, weights, strict=True))
        return f"({' + '.join(parts)})/({' + '.join(weights)})"

    def _square(self, place: Array) -> str:
        names = ("sqrt(x**2 + y**2)", "z") if self.controls.is_axisymmetric else ("x", "y", "z")
        return " + ".join(
            f"({name} - {float(c)!r})**2" for name, c in zip(names, place, strict=True)
        )
