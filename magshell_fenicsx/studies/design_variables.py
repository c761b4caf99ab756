"""The variables of a design as one vector, and the case that a vector stands for."""

import copy
from collections.abc import Mapping
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
from magshell_fenicsx.studies.sections import DesignSection

Array = NDArray[np.float64]


def refuse_unfit_numbers(source: Source, case: Case, design: DesignSection) -> tuple[Array, tuple[str, ...]]:
    """The bounds (numbers, 2) of the numbers of a design, and their units.

    Raises
    ------
    CaseError
        If a key has no number, another unit, or starts beyond its bounds.
    """
    found, units = [], []
    for key in design.numbers:
        low, high, unit = design.bounds(key)
        try:
            value, written = number_of(case, key), value_at(source.data, key.split("."))
        except CaseError as e:
            raise CaseError(f"design.numbers: {e}") from None
        if isinstance(written, str):
            try:
                value = in_unit(written, unit)
            except ValueError:
                raise CaseError(
                    f"design.numbers: {key}: the case gives {written}: its bounds need such a unit"
                ) from None
        elif unit:
            raise CaseError(f"design.numbers: {key}: is a number without a unit in the case: so are its bounds")
        if not low <= value <= high:
            raise CaseError(f"design.numbers: {key}: the case starts at {value:g}, beyond {low:g} to {high:g}")
        found.append((low, high))
        units.append(unit)
    return np.array(found, dtype=float).reshape(-1, 2), tuple(units)


@dataclass(frozen=True)
class Between:
    """The values of one field; as variables they run from 0 to 1 between their bounds.

    Attributes
    ----------
    start
        (n, components): factors of h, curvatures 11 and 22 over 1/R, or deviations over h.
    length
        R in the unit of the case's formulas, of a curvature.
    """

    name: str
    controls: Controls
    start: Array
    bounds: tuple[float, float]
    length: float = 1.0

    @property
    def first(self) -> Array:
        """The variables at the start."""
        return np.asarray((self.start - self.bounds[0]) / (self.bounds[1] - self.bounds[0])).ravel()

    def values(self, x: Array) -> Array:
        """(n, components) of variables."""
        low, high = self.bounds
        return np.asarray(low + x * (high - low)).reshape(self.start.shape)

    def gradient(self, scene: Scene, found: FieldGradient) -> Array:
        """By the variables; collective."""
        places = found.places.reshape(-1, 3) @ rotation(scene.plan.azimuth)
        forces = found.forces.reshape(len(places), -1)[:, : self.start.shape[1]]
        comm = found.field.function_space.mesh.comm
        pulled = comm.allreduce(np.asarray(self.controls.weights(places).T @ forces))
        unit = scene.plan.material.h if self.name == "deviation" else 1.0
        return np.asarray(pulled * unit * (self.bounds[1] - self.bounds[0])).ravel()

    def put(self, data: dict[str, Any], x: Array) -> None:
        """Give plain data of the case the field of variables."""
        texts = [self._formula(values) for values in self.values(x).T]
        if self.name == "thickness":
            data["shell"]["thickness_factor"] = texts[0]
        elif self.name == "deviation":
            shell = data["shell"]
            defect = [shell.pop("defect")] if shell.get("defect") else []
            shell["imperfections"] = [*defect, *(shell.get("imperfections") or ()), {"kind": "formula", "w0": texts[0]}]
        else:
            known = data.get("natural") or {}
            data["natural"] = {**known, "curvature": [*texts, 0]}

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
    """What varies.

    Attributes
    ----------
    case
        At the start.
    made
        Makes a case of its source.
    keys, bounds, units
        Of the numbers; (numbers, 2), in these units.
    controls, start
        Of the remanence, None without; its vectors at the start.
    lengths
        Least and largest length of a vector; None: they stay as they are.
    fields
        Scalar fields, in this order after all else.
    """

    source: Source
    case: Case
    made: Made
    keys: tuple[str, ...]
    bounds: Array
    units: tuple[str, ...]
    controls: Controls | None
    start: Array
    lengths: tuple[float, float] | None
    fields: tuple[Between, ...] = ()

    @property
    def blocks(self) -> dict[str, slice]:
        """What varies -> its variables."""
        found, at = {key: slice(i, i + 1) for i, key in enumerate(self.keys)}, len(self.keys)
        sizes = {"remanence": len(self._angles) + (len(self.start) if self.lengths else 0)} if self.controls else {}
        for name, size in (sizes | {field.name: field.start.size for field in self.fields}).items():
            found[name] = slice(at, at + size)
            at += size
        return found

    @property
    def names(self) -> tuple[str, ...]:
        """What results are differentiated by."""
        return tuple(self.blocks)

    @property
    def _angles(self) -> range:
        """Of the vectors, after the numbers."""
        return range(0 if self.controls is None else len(self.start) * (1 if self.planar else 2))

    @property
    def planar(self) -> bool:
        """Whether the vectors stay in a plane."""
        return self.controls is not None and (self.controls.around or not self.controls.places[:, 1].any())

    @property
    def first(self) -> Array:
        """The vector of the case itself."""
        numbers = np.array([number_of(self.case, key) for key in self.keys]) / self._sizes
        parts = [(numbers - self.bounds[:, 0]) / np.ptp(self.bounds, axis=1)]
        if self.controls is not None:
            size = np.linalg.norm(self.start, axis=1)
            across = self.start[:, 0] if self.planar else np.hypot(*self.start[:, :2].T)
            parts.append(np.arctan2(across, self.start[:, -1]))
            if not self.planar:
                parts.append(np.arctan2(self.start[:, 1], self.start[:, 0]))
            if self.lengths:
                parts.append((size - self.lengths[0]) / (self.lengths[1] - self.lengths[0]))
        return np.concatenate([*parts, *(field.first for field in self.fields)])

    @property
    def limits(self) -> list[tuple[float | None, float | None]]:
        """Bounds of the vector."""
        free: list[tuple[float | None, float | None]] = [(None, None)] * len(self._angles)
        between = (len(self.start) if self.lengths else 0) + sum(field.start.size for field in self.fields)
        return [*[(0.0, 1.0)] * len(self.keys), *free, *[(0.0, 1.0)] * between]

    @property
    def _sizes(self) -> Array:
        """Of the numbers' units in SI."""
        return np.array([si_size(unit) for unit in self.units])

    def numbers(self, x: Array) -> dict[str, float]:
        """Key, with its unit if it has one -> value."""
        named = (f"{key} [{unit}]" if unit else key for key, unit in zip(self.keys, self.units, strict=True))
        return dict(zip(named, self._numbers(x).values(), strict=True))

    def _numbers(self, x: Array) -> dict[str, float]:
        """Key -> value in its unit."""
        low, high = self.bounds.T
        values = low + x[: len(self.keys)] * (high - low)
        return dict(zip(self.keys, map(float, values), strict=True))

    def vectors(self, x: Array) -> Array:
        """The remanence at its points, (n, 3) or (n, 2)."""
        return self._polar(x)[0]

    def gradient(self, x: Array, scene: Scene, found: Mapping[str, float | FieldGradient]) -> Array:
        """A gradient by the vector from those of `simulate.gradients`; by what is not among them it is zero."""
        total = np.zeros(len(x))
        slopes = np.array([found.get(key, 0.0) for key in self.keys])
        total[: len(self.keys)] = slopes * self._sizes * np.ptp(self.bounds, axis=1)
        for field in self.fields:
            if isinstance(by := found.get(field.name), FieldGradient):
                total[self.blocks[field.name]] = field.gradient(scene, by)
        if self.controls is not None and isinstance(by := found.get("remanence"), FieldGradient):
            magnetic = scene.plan.loads.magnetic
            assert magnetic
            assert isinstance(magnetic.remanent, ByControls)
            comm = by.field.function_space.mesh.comm
            forces = comm.allreduce(magnetic.remanent.pulled(by.places, by.forces))
            ways = [np.sum(forces * way, axis=1) for way in self._polar(x)[1]]
            total[self.blocks["remanence"]] = np.concatenate(ways)
        return total

    def _polar(self, x: Array) -> tuple[Array, list[Array]]:
        """Vectors, and their derivatives by each of their variables."""
        n, rest = len(self.start), x[self.blocks["remanence"]]
        polar, *more = rest.reshape(-1, n)
        s, c = np.sin(polar), np.cos(polar)
        size, grows = np.linalg.norm(self.start, axis=1), 0.0
        if self.lengths:
            grows = self.lengths[1] - self.lengths[0]
            size = self.lengths[0] + more[-1] * grows
        one = size[:, None]
        if self.planar:
            still = [] if self.controls and self.controls.around else [0 * s]
            unit, turned = (np.stack(v, axis=1) for v in ([s, *still, c], [c, *still, -s]))
            ways = [one * turned]
        else:
            a, b = np.cos(more[0]), np.sin(more[0])
            unit = np.stack([s * a, s * b, c], axis=1)
            ways = [one * np.stack([c * a, c * b, -s], axis=1), one * np.stack([-s * b, s * a, 0 * s], axis=1)]
        return one * unit, [*ways, *([grows * unit] if self.lengths else [])]

    def rounded(self, x: Array, steps: int) -> Array:
        """The vector with angles at the nearest of so many steps of a turn."""
        x = np.array(x)
        angles = slice(len(self.keys), len(self.keys) + len(self._angles))
        x[angles] = np.round(x[angles] * steps / (2 * np.pi)) * 2 * np.pi / steps
        return x

    def write(self, x: Array, file: Path) -> None:
        """Write the vectors."""
        if self.controls is not None:
            write_vectors(file, self.controls.places, self.vectors(x))

    def data(self, x: Array, vectors: str) -> dict[str, Any]:
        """The case of a vector as plain data; `vectors` is the file of the remanence."""
        data = copy.deepcopy(self.source.data)
        data.pop("design", None)
        for (key, value), unit in zip(self._numbers(x).items(), self.units, strict=True):
            section, names = data, key.split(".")
            for name in names[:-1]:
                section = section[int(name)] if isinstance(section, list) else section.setdefault(name, {})
            section[int(names[-1]) if isinstance(section, list) else names[-1]] = (
                f"{value:.15g} {unit}" if unit else value
            )
        if self.controls is not None:
            known = data["magnetic"].get("remanent", {})
            kept = {"flux_density": known["flux_density"]} if "flux_density" in known else {}
            data["magnetic"]["remanent"] = {"kind": "points", "file": vectors, "filter": self.controls.width, **kept}
        for field in self.fields:
            field.put(data, x[self.blocks[field.name]])
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
    bounds, units = refuse_unfit_numbers(source, case, design)
    controls, start = None, np.asarray(np.zeros((0, 3)))
    if design.remanence:
        controls, start = _controls(case, design)
        if not (case.shell.geometry == "strip" or controls.around):
            source = copy.deepcopy(source)
            source.data["symmetry"] = "none"
            case = made(source)
    lengths = design.remanence and design.remanence.magnitude
    sizes = np.linalg.norm(start, axis=1)
    if lengths and not (lengths[0] - 1e-9 <= sizes.min() and sizes.max() <= lengths[1] + 1e-9):
        raise CaseError(
            f"design.remanence.magnitude: the vectors start with lengths {sizes.min():g} to {sizes.max():g}, beyond "
            f"{lengths[0]:g} to {lengths[1]:g}"
        )
    between = (lengths[0], lengths[1]) if lengths else None
    fields = _fields(case, design)
    return Variables(source, case, made, tuple(design.numbers), bounds, units, controls, start, between, fields)


def _fields(case: Case, design: DesignSection) -> tuple[Between, ...]:
    """The scalar fields with their points and values at the start."""
    found, plan = [], make_plan(case)
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
        found.append(Between(name, Controls(at, width), np.asarray(start), (low, high), case.shell.reference))
    return tuple(found)


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


def _controls(case: Case, design: DesignSection) -> tuple[Controls, Array]:
    """The points of the remanence, and its vectors there at the start."""
    assert design.remanence
    magnetic, count, width = case.magnetic, design.remanence.points, design.remanence.filter
    if magnetic is None or not case.lambda_m:
        raise CaseError("design.remanence: the case has no field, so no result depends on the remanence")
    if count is None:
        if not magnetic.remanent.file:
            raise CaseError("design.remanence: give points, or magnetic.remanent of kind: points")
        places, vectors = read_vectors(magnetic.remanent.path, "magnetic.remanent.file", magnetic.remanent.files)
        return Controls(places, width or magnetic.remanent.filter or 1.0), vectors
    plan = make_plan(case)
    places, width = _spread(case, plan, count, width)
    field = magnetisation(magnetic, case, 0.0, plan.within)
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
