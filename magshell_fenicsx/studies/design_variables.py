"""The variables of a design as one vector, and the case that a vector stands for."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.assembly.forms import FieldGradient
from magshell_fenicsx.input.section import in_unit, si_size
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.input.tables import read_vectors, write_vectors
from magshell_fenicsx.mesh.mirror import rotation
from magshell_fenicsx.models.shell.controls import ByControls, Controls
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.magnetism.magnetisation import magnetisation
from magshell_fenicsx.problem.planner import make_plan
from magshell_fenicsx.problem.problem import Plan
from magshell_fenicsx.shape.outline import outline
from magshell_fenicsx.simulate.numbers import number_of
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.points import value_at
from magshell_fenicsx.studies.runner import Case, Made
from magshell_fenicsx.studies.sections import DesignSection, RemanenceVariables

Array = NDArray[np.float64]


Limits = tuple[float | None, float | None]
Found = Mapping[str, Any]  # the gradients of a result, numbers and those by fields


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
    def first(self) -> Array:
        """The variables at the start."""
        return np.asarray((self.start - self.bounds[0]) / (self.bounds[1] - self.bounds[0])).ravel()

    @property
    def limits(self) -> list[Limits]:
        """Their bounds."""
        return [(0.0, 1.0)] * self.start.size

    def values(self, x: Array) -> Array:
        """The values of variables, in the shape of `start`."""
        low, high = self.bounds
        return np.asarray(low + x * (high - low)).reshape(self.start.shape)


@dataclass(frozen=True)
class Number(Bounded):
    """A number of the case, in a unit."""

    unit: str

    @property
    def label(self) -> str:
        """The key with its unit, if it has one."""
        return f"{self.name} [{self.unit}]" if self.unit else self.name

    def gradient(self, x: Array, scene: Scene, found: Found) -> Array:
        slope = found.get(self.name, 0.0)
        return np.array([slope * si_size(self.unit) * (self.bounds[1] - self.bounds[0])])

    def put(self, data: dict[str, Any], x: Array) -> None:
        section: Any = data
        *names, last = self.name.split(".")
        for name in names:
            section = section[int(name)] if isinstance(section, list) else section.setdefault(name, {})
        value = float(self.values(x)[0])
        section[int(last) if isinstance(section, list) else last] = f"{value:.15g} {self.unit}" if self.unit else value


@dataclass(frozen=True)
class Vectors:
    """The remanence at points, of which each place has the mean.

    Each vector has a polar angle, an azimuth where it is not kept in a plane, and its length where that varies, from 0
    to 1 between its bounds.

    Attributes
    ----------
    start
        (n, 3), or (n, 2) on a meridian.
    lengths
        Least and largest length; None: they stay as they are.
    """

    controls: Controls
    start: Array
    lengths: tuple[float, float] | None
    name: str = "remanence"

    @property
    def planar(self) -> bool:
        """Whether the vectors stay in a plane."""
        return self.controls.around or not self.controls.places[:, 1].any()

    @property
    def angles(self) -> int:
        """How many of its variables are angles; they come first."""
        return len(self.start) * (1 if self.planar else 2)

    @property
    def first(self) -> Array:
        across = self.start[:, 0] if self.planar else np.hypot(*self.start[:, :2].T)
        parts = [np.arctan2(across, self.start[:, -1])]
        if not self.planar:
            parts.append(np.arctan2(self.start[:, 1], self.start[:, 0]))
        if self.lengths:
            size = np.linalg.norm(self.start, axis=1)
            parts.append((size - self.lengths[0]) / (self.lengths[1] - self.lengths[0]))
        return np.concatenate(parts)

    @property
    def limits(self) -> list[Limits]:
        return [(None, None)] * self.angles + [(0.0, 1.0)] * (len(self.start) if self.lengths else 0)

    def vectors(self, x: Array) -> Array:
        """At the points, (n, 3) or (n, 2)."""
        return self._polar(x)[0]

    def gradient(self, x: Array, scene: Scene, found: Found) -> Array:
        if not isinstance(by := found.get(self.name), FieldGradient):
            return np.zeros(len(x))
        magnetic = scene.plan.loads.magnetic
        assert magnetic
        assert isinstance(magnetic.remanent, ByControls)
        comm = by.field.function_space.mesh.comm
        forces = comm.allreduce(magnetic.remanent.pulled(by.places, by.forces))
        return np.concatenate([np.sum(forces * way, axis=1) for way in self._polar(x)[1]])

    def _polar(self, x: Array) -> tuple[Array, list[Array]]:
        """Vectors, and their derivatives by each of their variables."""
        polar, *more = x.reshape(-1, len(self.start))
        s, c = np.sin(polar), np.cos(polar)
        size, grows = np.linalg.norm(self.start, axis=1), 0.0
        if self.lengths:
            grows = self.lengths[1] - self.lengths[0]
            size = self.lengths[0] + more[-1] * grows
        one = size[:, None]
        if self.planar:
            still = [] if self.controls.around else [0 * s]
            unit, turned = (np.stack(v, axis=1) for v in ([s, *still, c], [c, *still, -s]))
            ways = [one * turned]
        else:
            a, b = np.cos(more[0]), np.sin(more[0])
            unit = np.stack([s * a, s * b, c], axis=1)
            ways = [one * np.stack([c * a, c * b, -s], axis=1), one * np.stack([-s * b, s * a, 0 * s], axis=1)]
        return one * unit, [*ways, *([grows * unit] if self.lengths else [])]

    def put(self, data: dict[str, Any], x: Array) -> None:
        known = data["magnetic"].get("remanent", {})
        kept = {"flux_density": known["flux_density"]} if "flux_density" in known else {}
        data["magnetic"]["remanent"] = {"kind": "points", "file": "", "filter": self.controls.width, **kept}


@dataclass(frozen=True)
class Between(Bounded):
    """The values (n, components) of a scalar field at points, of which each place has the mean.

    They are factors of h, curvatures 11 and 22 over 1/R, or deviations over h. In the case such a field is a formula,
    with the weights of `models.shell.controls`: it needs no file, and its symmetry is recognised by its values.

    Attributes
    ----------
    length
        R in the unit of the case's formulas, of a curvature.
    """

    controls: Controls
    length: float = 1.0

    def gradient(self, x: Array, scene: Scene, found: Found) -> Array:
        if not isinstance(by := found.get(self.name), FieldGradient):
            return np.zeros(len(x))
        places = by.places.reshape(-1, 3) @ rotation(scene.plan.azimuth)
        forces = by.forces.reshape(len(places), -1)[:, : self.start.shape[1]]
        comm = by.field.function_space.mesh.comm
        pulled = comm.allreduce(np.asarray(self.controls.weights(places).T @ forces))
        unit = scene.plan.material.h if self.name == "deviation" else 1.0
        return np.asarray(pulled * unit * (self.bounds[1] - self.bounds[0])).ravel()

    def put(self, data: dict[str, Any], x: Array) -> None:
        texts = [self._formula(values) for values in self.values(x).T]
        if self.name == "thickness":
            data["shell"]["thickness_factor"] = texts[0]
        elif self.name == "deviation":
            shell = data["shell"]
            defect = [shell.pop("defect")] if shell.get("defect") else []
            shell["imperfections"] = [*defect, *(shell.get("imperfections") or ()), {"kind": "formula", "w0": texts[0]}]
        else:
            data["natural"] = {**(data.get("natural") or {}), "curvature": [*texts, 0]}

    def _formula(self, values: Array) -> str:
        R = self.length if self.name == "curvature" else 1.0  # other formulas are of places over R
        if np.ptp(values) == 0:
            return repr(float(values[0] / R))
        below = repr(float(self.controls.width * R) ** 2)
        weights = [f"exp(-({self._square(place * R)})/{below})" for place in self.controls.places]
        parts = (f"{float(v / R)!r}*{w}" for v, w in zip(values, weights, strict=True))
        return f"({' + '.join(parts)})/({' + '.join(weights)})"

    def _square(self, place: Array) -> str:
        names = ("sqrt(x**2 + y**2)", "z") if self.controls.around else ("x", "y", "z")
        return " + ".join(f"({name} - {float(c)!r})**2" for name, c in zip(names, place, strict=True))


@dataclass(frozen=True)
class Variables:
    """What varies, as one vector: numbers, then the remanence, then scalar fields.

    Every part has a name, its variables at the start (`first`) and their bounds (`limits`); it takes its gradient from
    those of `simulate.gradients` (`gradient`) and gives plain data of the case what variables stand for (`put`).

    Attributes
    ----------
    case
        At the start.
    made
        Makes a case of its source.
    remanence
        None if it stays as it is.
    """

    source: Source
    case: Case
    made: Made
    scalars: tuple[Number, ...]
    remanence: Vectors | None = None
    fields: tuple[Between, ...] = ()

    @property
    def parts(self) -> Sequence[Number | Vectors | Between]:
        return [*self.scalars, *([self.remanence] if self.remanence else []), *self.fields]

    @property
    def blocks(self) -> dict[str, slice]:
        """What varies -> its variables."""
        ends = np.cumsum([0, *(part.first.size for part in self.parts)])
        return {part.name: slice(*ends[i : i + 2]) for i, part in enumerate(self.parts)}

    @property
    def names(self) -> tuple[str, ...]:
        """What results are differentiated by."""
        return tuple(part.name for part in self.parts)

    @property
    def controls(self) -> Controls | None:
        """Of the remanence, if that varies."""
        return self.remanence.controls if self.remanence else None

    @property
    def first(self) -> Array:
        """The vector of the case itself."""
        return np.concatenate([part.first for part in self.parts])

    @property
    def limits(self) -> list[Limits]:
        """Bounds of the vector."""
        return [limit for part in self.parts for limit in part.limits]

    def numbers(self, x: Array) -> dict[str, float]:
        """Key, with its unit if it has one -> value."""
        return {part.label: float(part.values(x[i : i + 1])[0]) for i, part in enumerate(self.scalars)}

    def vectors(self, x: Array) -> Array:
        """The remanence at its points, (n, 3) or (n, 2)."""
        assert self.remanence
        return self.remanence.vectors(x[self.blocks["remanence"]])

    def gradient(self, x: Array, scene: Scene, found: Found) -> Array:
        """A gradient by the vector from those of `simulate.gradients`; by what is not among them it is zero."""
        blocks = self.blocks
        return np.concatenate([part.gradient(x[blocks[part.name]], scene, found) for part in self.parts])

    def rounded(self, x: Array, steps: int) -> Array:
        """The vector with angles of the remanence at the nearest of so many steps of a turn."""
        assert self.remanence
        x, begin = np.array(x), len(self.scalars)
        angles = slice(begin, begin + self.remanence.angles)
        x[angles] = np.round(x[angles] * steps / (2 * np.pi)) * 2 * np.pi / steps
        return x

    def write(self, x: Array, file: Path) -> None:
        """Write the vectors of the remanence."""
        if self.remanence:
            write_vectors(file, self.remanence.controls.places, self.vectors(x))

    def data(self, x: Array, vectors: str) -> dict[str, Any]:
        """The case of a vector as plain data; `vectors` is the file of the remanence."""
        data, blocks = copy.deepcopy(self.source.data), self.blocks
        data.pop("design", None)
        for part in self.parts:
            part.put(data, x[blocks[part.name]])
        if self.remanence:
            data["magnetic"]["remanent"]["file"] = vectors
        return data

    def case_of(self, x: Array, vectors: Path) -> Case:
        """The case of a vector, whose remanence is in a file."""
        data = self.data(x, str(vectors.absolute()))
        return self.made(Source(self.source.name, data, folder=self.source.folder))


def variables(source: Source, case: Case, design: DesignSection, made: Made) -> Variables:
    """What a design varies.

    Raises
    ------
    CaseError
        If a key has no number or starts beyond its bounds, or there is no remanence to vary.
    """
    scalars, remanence = refuse_unfit_numbers(source, case, design), None
    if design.remanence:
        remanence = _remanence(case, design.remanence)
        if not (case.shell.geometry == "strip" or remanence.controls.around):
            source = copy.deepcopy(source)
            source.data["symmetry"] = "none"
            case = made(source)
    return Variables(source, case, made, scalars, remanence, _fields(case, design))


def refuse_unfit_numbers(source: Source, case: Case, design: DesignSection) -> tuple[Number, ...]:
    """The numbers of a design.

    Raises
    ------
    CaseError
        If a key has no number, another unit, or starts beyond its bounds.
    """
    numbers = []
    for key in design.numbers:
        low, high, unit = design.bounds(key)
        try:
            value, written = number_of(case, key), value_at(source.data, key.split("."))
        except CaseError as e:
            raise CaseError(f"design.numbers: {e}") from None
        start = value / si_size(unit)
        if isinstance(written, str):
            try:
                value = in_unit(written, unit)
            except ValueError:
                said = f"design.numbers: {key}: the case gives {written}: its bounds need such a unit"
                raise CaseError(said) from None
        elif unit:
            raise CaseError(f"design.numbers: {key}: is a number without a unit in the case: so are its bounds")
        if not low <= value <= high:
            raise CaseError(f"design.numbers: {key}: the case starts at {value:g}, beyond {low:g} to {high:g}")
        numbers.append(Number(key, np.array([start]), (low, high), unit))
    return tuple(numbers)


def _fields(case: Case, design: DesignSection) -> tuple[Between, ...]:
    """The scalar fields with their points and values at the start."""
    fields, plan = [], make_plan(case)
    for name, section in design.fields.items():
        places, width = _spread(case, plan, section.points, section.filter)
        if name == "thickness":
            start = (plan.thickness or Thickness()).at(places)[:, None]
        elif name == "curvature":
            start = _curvatures(plan, places)
        else:
            start = np.zeros((len(places), 1))
        low, high = section.values
        if not (low <= start.min() and start.max() <= high):
            raise CaseError(
                f"design.{name}.values: the case starts with {start.min():g} to {start.max():g}, beyond {low:g} to "
                f"{high:g}"
            )
        at = places[:, [0, 2]] if plan.meridian else places
        fields.append(Between(name, np.asarray(start), (low, high), Controls(at, width), case.shell.reference))
    return tuple(fields)


def _curvatures(plan: Plan, places: Array) -> Array:
    """The natural curvatures 11 and 22 of the case at places of its surface, (n, 2) over 1/R."""
    drawn = plan.loads.natural.curvature if plan.loads.natural else None
    if isinstance(drawn, Mapping):
        raise CaseError("design.curvature: natural.curvature starts by patches: start from numbers or formulas")
    if callable(drawn):
        return np.asarray(drawn(places[:, None], places[:, None])[:, 0, :2])
    return np.tile(np.zeros(2) if drawn is None else drawn[:2], (len(places), 1))


def _spread(case: Case, plan: Plan, count: int, width: float | None) -> tuple[Array, float]:
    """Points of the case's surface, and the filter or their distance."""
    places = _places(case, plan, count)
    return places, width or float(np.median(scipy.spatial.cKDTree(places).query(places, [2])[0]))


def _remanence(case: Case, section: RemanenceVariables) -> Vectors:
    """The vectors of the remanence that vary."""
    controls, start = _controls(case, section)
    sizes, lengths = np.linalg.norm(start, axis=1), section.magnitude
    if lengths is None:
        return Vectors(controls, start, None)
    low, high = lengths
    if not (low - 1e-9 <= sizes.min() and sizes.max() <= high + 1e-9):
        raise CaseError(
            f"design.remanence.magnitude: the vectors start with lengths {sizes.min():g} to {sizes.max():g}, beyond "
            f"{low:g} to {high:g}"
        )
    return Vectors(controls, start, (low, high))


def _controls(case: Case, section: RemanenceVariables) -> tuple[Controls, Array]:
    """The points of the remanence, and its vectors there at the start."""
    magnetic, count, width = case.magnetic, section.points, section.filter
    if magnetic is None or not case.lambda_m:
        raise CaseError("design.remanence: the case has no field, so no result depends on the remanence")
    if count is None:
        if not magnetic.remanent.file:
            raise CaseError("design.remanence: give points, or magnetic.remanent of kind: points")
        places, vectors = read_vectors(magnetic.remanent.path, "magnetic.remanent.file", magnetic.remanent.files)
        return Controls(places, width or magnetic.remanent.filter or 1.0), vectors
    plan = make_plan(case)
    places, width = _spread(case, plan, count, width)
    field = magnetisation(magnetic, case.context, 0.0, plan.within)
    if field.patches is not None:
        raise CaseError("design.remanence.points: the remanence starts by patches of a mesh: start from another kind")
    if callable(field.remanent):
        normals = places / np.maximum(np.linalg.norm(places, axis=1, keepdims=True), 1e-300)
        vectors = np.array(field.remanent(places[:, None], normals[:, None])[:, 0])
    else:
        vectors = np.tile(np.asarray(field.remanent, dtype=float), (count, 1))
    if plan.meridian:
        places, vectors = places[:, [0, 2]], vectors[:, [0, 2]]
    return Controls(places, width), vectors


def _places(case: Case, plan: Plan, count: int) -> Array:
    """Points (n, 3) along a meridian or a strip, or far from each other on the surface."""
    if plan.meridian:
        sample = plan.meridian.sample()
        return np.asarray(sample[np.linspace(0, len(sample) - 1, count).round().astype(int)] * [1.0, 0.0, 1.0])
    if case.shell.geometry == "strip":
        along = np.linspace(0.0, 1.0, count)
        return np.column_stack([along, 0 * along, 0 * along])
    sample = outline(case.shell).sample()
    chosen, away = [0], np.full(len(sample), np.inf)
    while len(chosen) < min(count, len(sample)):
        away = np.minimum(away, np.linalg.norm(sample - sample[chosen[-1]], axis=1))
        chosen.append(int(np.argmax(away)))
    return np.asarray(sample[chosen])
