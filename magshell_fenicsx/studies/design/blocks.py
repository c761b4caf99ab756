"""Blocks of design variables: numbers of the case, vectors of the remanence, scalar fields.

A variable runs from 0 to 1 between the bounds of its value, or is an angle. A field is given by
values at control points, as their mean with weights that fall with distance. On a meridian the
points are (rho, z) and vectors have two components. A `FieldGradient` has the derivatives of a
result by a field at the nodes of the mesh ("forces"); transposed interpolation gives those by the
values at control points. Plain data are those of the case file. h and R are thickness and reference
length, |B^r| is the size of the remanence.
"""

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
    """Values with bounds as design variables, which run from 0 to 1 between the bounds.

    Attributes
    ----------
    name
        The key of the case, or the field.
    start
        The values of the case itself.
    bounds
        Lower and upper bound of all values.
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
        """Return the values for variables x, in the shape of `start`."""
        low, high = self.bounds
        return np.asarray(low + x * (high - low)).reshape(self.start.shape)


@dataclass(frozen=True)
class NumberVariable(Bounded):
    """A number of the case as a design variable; start and bounds are in its unit."""

    unit: str

    @property
    def label(self) -> str:
        """The key with its unit, if it has one."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def gradient(self, x: Array, scene: Scene, gradients: GradientsByName) -> Array:
        """Return the gradient (1,) of a result by the variable.

        Parameters
        ----------
        gradients
            Key -> derivative by the number in SI units; a missing one is zero.
        x, scene
            Not used: the derivative is constant. Other blocks need them.
        """
        slope = gradients.get(self.name, 0.0)
        return np.array([slope * si_size(self.unit) * (self.bounds[1] - self.bounds[0])])

    def put(self, data: dict[str, Any], x: Array) -> None:
        """Set the number in plain data of the case."""
        # the section or list of the number; missing sections are made
        section: Any = data
        *names, last_word = self.name.split(".")
        for name in names:
            section = (
                section[int(name)] if isinstance(section, list) else section.setdefault(name, {})
            )
        value = float(self.values(x)[0])
        index_or_key = int(last_word) if isinstance(section, list) else last_word
        section[index_or_key] = f"{value:.15g} {self.unit}" if self.unit else value


def by_components(scene: Scene, field_gradient: FieldGradient) -> Array:
    """Return the derivatives (n, 3 | 2) of a result by the remanence's vectors; collective.

    Parameters
    ----------
    field_gradient
        Gradient by the remanence as a field on the mesh.
    """
    loads = scene.problem.loads
    magnetic = loads.magnetic or loads.remanence
    assert magnetic
    assert isinstance(magnetic.remanent, ControlledPattern)
    # transposed interpolation: from places on this rank's mesh to control points; all ranks add up
    comm = field_gradient.field.function_space.mesh.comm
    of_this_rank = magnetic.remanent.transposed(field_gradient.places, field_gradient.forces)
    return np.asarray(comm.allreduce(of_this_rank))


@dataclass(frozen=True)
class Vectors:
    """The remanence at control points as design variables; each place of the shell has their mean.

    The variables of each vector are its polar angle, its azimuth unless it stays in a plane, and
    its length if this varies, from 0 to 1 between the bounds. All polar angles come first, then
    azimuths, then lengths.

    Attributes
    ----------
    controls
        The control points.
    start
        (n, 3), or (n, 2) on a meridian: vectors of the case itself, over |B^r|.
    lengths
        Least and largest length; None: lengths stay as they are.
    name
        Name of the block, and of the field in gradients.
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
        """Number of variables that are angles; they come first."""
        return len(self.start) * (1 if self.planar else 2)

    @property
    def start_values(self) -> Array:
        """Variables at the start: angles in radians, then scaled lengths."""
        # the polar angle is from z; in a plane it has a sign, and there is no azimuth
        horizontal = self.start[:, 0] if self.planar else np.hypot(*self.start[:, :2].T)
        angles_and_lengths = [np.arctan2(horizontal, self.start[:, -1])]
        if not self.planar:
            angles_and_lengths.append(np.arctan2(self.start[:, 1], self.start[:, 0]))
        if self.lengths:
            least, largest = self.lengths
            length = np.linalg.norm(self.start, axis=1)
            angles_and_lengths.append((length - least) / (largest - least))
        return np.concatenate(angles_and_lengths)

    @property
    def limits(self) -> list[Limits]:
        """Bounds of the variables: none for angles, 0 and 1 for lengths."""
        length_count = len(self.start) if self.lengths else 0
        return [(None, None)] * self.angles + [(0.0, 1.0)] * length_count

    def vectors(self, x: Array) -> Array:
        """The vectors at the control points, (n, 3) or (n, 2), for variables x."""
        vectors, _ = self._polar(x)
        return vectors

    def gradient(self, x: Array, scene: Scene, gradients: GradientsByName) -> Array:
        """Return the gradient of a result by the variables; collective.

        Parameters
        ----------
        x
            The variables.
        gradients
            Name of a field -> `FieldGradient`; without "remanence" the gradient is zero.
        """
        if not isinstance(field_gradient := gradients.get(self.name), FieldGradient):
            return np.zeros(len(x))
        forces = by_components(scene, field_gradient)
        _, derivatives = self._polar(x)
        # chain rule: angles of a vector change that vector alone
        return np.concatenate([np.sum(forces * derivative, axis=1) for derivative in derivatives])

    def _polar(self, x: Array) -> tuple[Array, list[Array]]:
        """Return vectors (n, 3 | 2) for variables x, and their derivatives (n, 3 | 2).

        There is one array of derivatives for each kind of variable: polar angles, azimuths unless
        the vectors stay in a plane, lengths if they vary.
        """
        # one row of variables for each kind; lengths are the last one if they vary
        polar, *other_variables = x.reshape(-1, len(self.start))
        s, c = np.sin(polar), np.cos(polar)
        # lengths (n,), and their derivative by the scaled variables; 0 if they do not vary
        length, length_range = np.linalg.norm(self.start, axis=1), 0.0
        if self.lengths:
            length_range = self.lengths[1] - self.lengths[0]
            length = self.lengths[0] + other_variables[-1] * length_range
        length_column = length[:, None]
        # unit vectors, and derivatives of the vectors by the angles
        if self.planar:
            # in the plane of x and z the vectors have y = 0; on a meridian no y at all
            y_component = [] if self.controls.is_axisymmetric else [0 * s]
            unit = np.stack([s, *y_component, c], axis=1)
            by_polar = np.stack([c, *y_component, -s], axis=1)
            derivatives = [length_column * by_polar]
        else:
            azimuth = other_variables[0]
            cos_azimuth, sin_azimuth = np.cos(azimuth), np.sin(azimuth)
            unit = np.stack([s * cos_azimuth, s * sin_azimuth, c], axis=1)
            by_polar = np.stack([c * cos_azimuth, c * sin_azimuth, -s], axis=1)
            by_azimuth = np.stack([-s * sin_azimuth, s * cos_azimuth, 0 * s], axis=1)
            derivatives = [length_column * by_polar, length_column * by_azimuth]
        if self.lengths:
            derivatives.append(length_range * unit)
        return length_column * unit, derivatives

    def put(self, data: dict[str, Any], x: Array) -> None:
        """Let the case have a remanence of kind `points`, whose file is named later.

        The vectors for x are in that file, so x is not used.
        """
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
    """A scalar field at control points as design variables; each place has their weighted mean.

    The values (n, components) are factors of h, curvatures 11 and 22 over 1/R, or deviations over
    h. In the case such a field is a formula, with the weights of `models.shell.control_points`: it
    needs no file, and its symmetry is recognised by its values.

    Attributes
    ----------
    controls
        The control points, over R.
    length
        R in the unit of the case's formulas, of a curvature.
    shells
        Name of one of several shells -> its pose, and its thickness over h.
    """

    controls: ControlPoints
    length: float = 1.0
    shells: Mapping[str, tuple[ShellPose, float]] = field(default_factory=dict)

    def gradient(self, x: Array, scene: Scene, gradients: GradientsByName) -> Array:
        """Return the gradient of a result by the variables; collective.

        Parameters
        ----------
        gradients
            Name of a field -> `FieldGradient`; without this field's name the gradient is zero.
        """
        if not isinstance(field_gradient := gradients.get(self.name), FieldGradient):
            return np.zeros(len(x))
        # from the model's frame, turned about e3, to that of the case
        places = field_gradient.places.reshape(-1, 3) @ rotation(scene.problem.azimuth)
        # derivatives (places, components) by the field's values there
        forces = field_gradient.forces.reshape(len(places), -1)[:, : self.start.shape[1]]
        if self.name == "thickness" and self.shells:
            forces = forces * self._shell_ratios(scene, field_gradient.forces.shape[:2])
        comm = field_gradient.field.function_space.mesh.comm
        # transposed interpolation: from places on the mesh to control points
        gradient_at_points = comm.allreduce(np.asarray(self.controls.weights(places).T @ forces))
        # a deviation is over h here, and over R in the model
        length_unit = scene.problem.material.h if self.name == "deviation" else 1.0
        return np.asarray(
            gradient_at_points * length_unit * (self.bounds[1] - self.bounds[0])
        ).ravel()

    def put(self, data: dict[str, Any], x: Array) -> None:
        """Write the field as a formula into plain data of the case, for each shell."""
        values = self.values(x).T
        if self.name == "curvature":
            formulas = [
                self._formula(component, self.controls, self.length) for component in values
            ]
            # the third component is the twist
            data["natural"] = {**(data.get("natural") or {}), "curvature": [*formulas, 0]}
            return
        # for each shell its section, control points in its frame, and its thickness over h
        shells = [] if self.shells else [(data["shell"], self.controls, 1.0)]
        for name, (pose, ratio_of_shell) in self.shells.items():
            section = data["shells"][name]["shell"]
            shells.append((section, self._controls_on_shell(pose), ratio_of_shell))
        for shell, controls, ratio in shells:
            if self.name == "thickness":
                shell["thickness_factor"] = self._formula(values[0], controls)
                continue
            # the deviation is one more imperfection; `defect` is short for a single one
            defect = [shell.pop("defect")] if shell.get("defect") else []
            imperfection = {"kind": "formula", "w0": self._formula(values[0] / ratio, controls)}
            shell["imperfections"] = [*defect, *(shell.get("imperfections") or ()), imperfection]

    def _controls_on_shell(self, pose: ShellPose) -> ControlPoints:
        """Return the control points in the frame of one of several shells, over its own length."""
        points = self.controls.places
        if self.controls.is_axisymmetric:  # (rho, z) of a meridian: (rho, 0, z) in space
            points = np.insert(points, 1, 0.0, axis=1)
        points_of_shell = pose.to_shell_frame(points)
        if self.controls.is_axisymmetric:  # and (rho, z) again
            x, y, z = points_of_shell.T
            points_of_shell = np.column_stack([np.hypot(x, y), z])
        return ControlPoints(points_of_shell, self.controls.width / pose.scale)

    def _shell_ratios(self, scene: Scene, shape: tuple[int, ...]) -> Array:
        """Return the thickness over h of each node's shell, (nodes of cells, 1).

        It is the derivative of a thickness over h by the factor of its shell.

        Parameters
        ----------
        shape
            Numbers of cells and of nodes per cell.
        """
        surface = scene.model.meridian if scene.model.axisymmetric else scene.model.midsurface
        assert surface
        ratios = np.ones(shape)
        for name, (_, ratio) in self.shells.items():
            cells_of_shell = surface.patches[name][: shape[0]]  # a mask; ghosts are left out
            ratios[cells_of_shell] = ratio
        return ratios.reshape(-1, 1)

    def _formula(self, values: Array, controls: ControlPoints, R: float = 1.0) -> str:
        """Return the formula of the field for values (n,) at the control points.

        It is the mean of the values with the weights exp(-d^2/width^2), at distances d.

        Parameters
        ----------
        R
            Length R in the unit of the formula's coordinates; values are over 1/R then.
        """
        if np.ptp(values) == 0:  # the mean of equal values is a constant
            return repr(float(values[0] / R))
        squared_width = repr(float(controls.width * R) ** 2)
        weights = [
            f"exp(-({self._square(place * R)})/{squared_width})" for place in controls.places
        ]
        terms = (f"{float(v / R)!r}*{w}" for v, w in zip(values, weights, strict=True))
        return f"({' + '.join(terms)})/({' + '.join(weights)})"

    def _square(self, place: Array) -> str:
        """Return the formula of the squared distance from a place."""
        names = ("sqrt(x**2 + y**2)", "z") if self.controls.is_axisymmetric else ("x", "y", "z")
        return " + ".join(
            f"({name} - {float(c)!r})**2" for name, c in zip(names, place, strict=True)
        )
