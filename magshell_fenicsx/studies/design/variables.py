"""The variables of a design as one vector, and the case that a vector stands for.

Numbers and fields of the case vary; each is a block of the vector, with values scaled to 0 to 1
between their bounds, or angles. A field is given by values at control points: each place has their
mean, weighted by distance over the filter width. The fields are the remanence (vectors over |B^r|),
the thickness over h, the natural curvatures 11 and 22 over 1/R, and the deviation w0 of the shape
over h. On a meridian, where a field turns with the azimuth, points are (rho, z). A scene is the
model of a case with its solver. Places are over R. `case.several` has the shells of a case of
several ones; it is None for a single shell.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from magshell_fenicsx.input.section import in_unit, si_size
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.input.tables import read_vectors, write_vectors
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.models.shell.control_points import ControlPoints
from magshell_fenicsx.models.shell.thickness import Thickness
from magshell_fenicsx.parts.magnetism.interaction import acts
from magshell_fenicsx.parts.magnetism.magnetisation import magnetisation
from magshell_fenicsx.parts.shell_outline import outline
from magshell_fenicsx.problem.formulas import THICKNESS
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.simulate.perturbation import number_at_key
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.studies.design.blocks import (
    ControlPointField,
    GradientsByName,
    Limits,
    NumberVariable,
    Vectors,
)
from magshell_fenicsx.studies.design.sections import DesignSection, RemanenceVariables
from magshell_fenicsx.studies.points import Case, MakeCase, value_at

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Variables:
    """All design variables as one vector (p,): numbers, then the remanence, then scalar fields.

    Each part has a name, its variables at the start (`start_values`) and their bounds (`limits`).
    It converts gradients by the case's numbers and fields to gradients by its variables
    (`gradient`), and writes its values into plain data of the case (`put`).

    Attributes
    ----------
    source, case
        The case at the start.
    make_case
        Makes a case of its source.
    scalars
        Numbers that vary.
    remanence
        Vectors of the remanence; None if they do not vary.
    fields
        Scalar fields that vary.
    """

    source: Source
    case: Case
    make_case: MakeCase
    scalars: tuple[NumberVariable, ...]
    remanence: Vectors | None = None
    fields: tuple[ControlPointField, ...] = ()

    @property
    def parts(self) -> Sequence[NumberVariable | Vectors | ControlPointField]:
        """Numbers, remanence and fields in the order of the vector."""
        return [*self.scalars, *([self.remanence] if self.remanence else []), *self.fields]

    @property
    def blocks(self) -> dict[str, slice]:
        """Name of a block -> slice of its variables in the vector."""
        # where blocks begin and end
        ends = np.cumsum([0, *(part.start_values.size for part in self.parts)])
        return {part.name: slice(*ends[i : i + 2]) for i, part in enumerate(self.parts)}

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers and fields by which results are differentiated."""
        return tuple(part.name for part in self.parts)

    @property
    def controls(self) -> ControlPoints | None:
        """Control points of the remanence; None if it does not vary."""
        return self.remanence.controls if self.remanence else None

    @property
    def start_values(self) -> Array:
        """The vector of the case itself."""
        return np.concatenate([part.start_values for part in self.parts])

    @property
    def smooth(self) -> list[str]:
        """Keys of the case whose formulas are smooth, so that no narrow details are searched for.

        The fields are means over the distance of their control points, unless a filter is given.
        `Case.problem` takes these keys.
        """
        smooth_fields = [
            name
            for name, field_section in (self.case.design.fields.items() if self.case.design else ())
            if field_section.filter is None
        ]
        keys = {"thickness": THICKNESS, "curvature": "natural.curvature"}
        return [keys[name] for name in smooth_fields if name in keys]

    @property
    def limits(self) -> list[Limits]:
        """Lower and upper bound of each variable; None where there is none."""
        return [limit for part in self.parts for limit in part.limits]

    def numbers(self, x: Array) -> dict[str, float]:
        """Return key, with its unit if it has one -> value, of the numbers that vary."""
        # numbers are the first blocks, with one variable each
        return {
            part.label: float(part.values(x[i : i + 1])[0]) for i, part in enumerate(self.scalars)
        }

    def vectors(self, x: Array) -> Array:
        """Return the remanence at its control points, (n, 3) or (n, 2), over |B^r|."""
        assert self.remanence
        return self.remanence.vectors(x[self.blocks["remanence"]])

    def gradient(self, x: Array, scene: Scene, gradients: GradientsByName) -> Array:
        """Convert gradients of a result to its gradient (p,) by the variables; collective.

        Parameters
        ----------
        gradients
            Name of a number or field -> the gradient by it; a missing one is zero.
        """
        blocks = self.blocks
        return np.concatenate(
            [part.gradient(x[blocks[part.name]], scene, gradients) for part in self.parts]
        )

    def rounded(self, x: Array, steps: int) -> Array:
        """Return the vector with the angles of the remanence rounded.

        Parameters
        ----------
        steps
            Number of steps of a full turn, to which angles are rounded.
        """
        assert self.remanence
        # angles are the first variables of the remanence, whose block follows the numbers
        x, begin = np.array(x), len(self.scalars)
        angles = slice(begin, begin + self.remanence.angles)
        x[angles] = np.round(x[angles] * steps / (2 * np.pi)) * 2 * np.pi / steps
        return x

    def write(self, x: Array, file: Path) -> None:
        """Write the vectors of the remanence into a file; nothing if they do not vary."""
        if self.remanence:
            write_vectors(file, self.remanence.controls.places, self.vectors(x))

    def data(self, x: Array, vectors: str) -> dict[str, Any]:
        """Return the case for a vector of variables as plain data, without its design.

        Parameters
        ----------
        vectors
            Name of the file with the vectors of the remanence.
        """
        data, blocks = copy.deepcopy(self.source.data), self.blocks
        data.pop("design", None)
        for part in self.parts:
            part.put(data, x[blocks[part.name]])
        if self.remanence:
            data["magnetic"]["remanent"]["file"] = vectors
        return data

    def case_of(self, x: Array, vectors: Path) -> Case:
        """Return the case for a vector of variables.

        Parameters
        ----------
        vectors
            File with the vectors of the remanence.
        """
        data = self.data(x, str(vectors.absolute()))
        return self.make_case(Source(self.source.name, data, folder=self.source.folder))


def variables(source: Source, case: Case, design: DesignSection, make_case: MakeCase) -> Variables:
    """Build the design variables of a case.

    If the remanence does not stay in a plane, the case becomes that of the whole shell.

    Raises
    ------
    CaseError
        If a key has no number or starts beyond its bounds, or there is no remanence to vary.
    """
    scalars, remanence = refuse_unfit_numbers(source, case, design), None
    if design.remanence:
        remanence = _remanence(case, design.remanence)
        if not (case.shell.geometry == "strip" or remanence.controls.is_axisymmetric):
            source = copy.deepcopy(source)
            source.data["symmetry"] = "none"
            case = make_case(source)
    return Variables(source, case, make_case, scalars, remanence, _fields(case, design))


def refuse_unfit_numbers(
    source: Source, case: Case, design: DesignSection
) -> tuple[NumberVariable, ...]:
    """Return the numbers that a design varies, with their starts and bounds.

    Raises
    ------
    CaseError
        If a key has no number, another unit, or starts beyond its bounds.
    """
    numbers = []
    for key in design.numbers:
        low, high, unit = design.bounds(key)
        # the number in SI units, and as the case file has it: text with a unit, a bare number, or
        # None where it is a default
        try:
            si_value = number_at_key(case.context, key)
            as_written = value_at(source.data, key.split("."))
        except CaseError as e:
            raise CaseError(f"design.numbers: {e}") from None
        value = _value_in_unit_of_bounds(key, si_value, as_written, unit)
        if not low <= value <= high:
            raise CaseError(
                f"design.numbers: {key}: the case starts at {value:g}, beyond {low:g} to {high:g}"
            )
        start = np.array([si_value / si_size(unit)])
        numbers.append(NumberVariable(key, start, bounds=(low, high), unit=unit))
    return tuple(numbers)


def _value_in_unit_of_bounds(key: str, si_value: float, as_written: Any, unit: str) -> float:
    """Return a number of the case in the unit of its bounds, to compare it with these.

    Parameters
    ----------
    si_value, as_written
        The number in SI units, and as the case file has it: text with a unit, a bare number, or
        None where it is a default.
    unit
        Unit of the bounds; "" without.

    Raises
    ------
    CaseError
        If the case gives another kind of unit, or the bounds have one and the number has none.
    """
    if isinstance(as_written, str):
        try:
            return in_unit(as_written, unit)
        except ValueError:
            message = (
                f"design.numbers: {key}: the case gives {as_written}: its bounds need such a unit"
            )
            raise CaseError(message) from None
    if unit:
        raise CaseError(
            f"design.numbers: {key}: is a number without a unit in the case: so are its bounds"
        )
    return si_value


def _fields(case: Case, design: DesignSection) -> tuple[ControlPointField, ...]:
    """Return the scalar fields that a design varies, with control points and values at the start.

    Raises
    ------
    CaseError
        If a field starts beyond its bounds, or several shells have thickness factors of their own.
    """
    fields, problem, several = [], case.problem(), case.several
    # name of one of several shells -> its pose, and its thickness over h
    shells = (
        {part.name: (several.place(part), several.ratio(part)) for part in several.parts}
        if several
        else {}
    )
    for name, section in design.fields.items():
        places, width = _spread(case, problem, section.points, section.filter)
        if name == "thickness":
            _refuse_thickness_factors(case)
        start = _start_of_field(name, problem, places)
        low, high = section.values
        if not (low <= start.min() and start.max() <= high):
            raise CaseError(
                f"design.{name}.values: the case starts with {start.min():g} to {start.max():g}, "
                f"beyond {low:g} to "
                f"{high:g}"
            )
        points = places[:, [0, 2]] if problem.meridian else places  # (rho, z)
        fields.append(
            ControlPointField(
                name,
                np.asarray(start),
                bounds=(low, high),
                controls=ControlPoints(points, width),
                length=case.shell.reference,
                shells=shells,
            )
        )
    return tuple(fields)


def _refuse_thickness_factors(case: Case) -> None:
    """Check that no one of several shells has a thickness factor of its own.

    Raises
    ------
    CaseError
        With the first shell that has one.
    """
    if not case.several:
        return
    shells_with_factor = [
        part.name for part in case.several.parts if part.case.thickness_factor is not None
    ]
    if shells_with_factor:
        raise CaseError(
            f"design.thickness: starts even: leave out "
            f"shells.{shells_with_factor[0]}.shell.thickness_factor"
        )


def _start_of_field(name: str, problem: Problem, places: Array) -> Array:
    """Return the values (n, 1 or 2) of a field in the case itself, at places (n, 3).

    Raises
    ------
    CaseError
        If the natural curvature is given by patches or as a user's field.
    """
    if name == "thickness":  # that of several shells is 1 but for their patches
        return np.asarray((problem.thickness or Thickness()).values_at(places)[:, None])
    if name == "curvature":
        return _curvatures(problem, places)
    return np.zeros((len(places), 1))  # a deviation is added to the shape


def _curvatures(problem: Problem, places: Array) -> Array:
    """Return the natural curvatures 11 and 22 of the case at places (n, 3), (n, 2) over 1/R.

    Raises
    ------
    CaseError
        If the natural curvature is given by patches or as a user's field.
    """
    natural_curvature = problem.loads.natural.curvature if problem.loads.natural else None
    if isinstance(natural_curvature, Mapping | UserField):
        raise CaseError(
            "design.curvature: natural.curvature starts by patches: start from numbers or formulas"
        )
    if callable(natural_curvature):
        # a function of places and normals (cells, nodes, 3); places stand for the normals
        return np.asarray(natural_curvature(places[:, None], places[:, None])[:, 0, :2])
    return np.tile(
        np.zeros(2) if natural_curvature is None else natural_curvature[:2], (len(places), 1)
    )


def _spread(case: Case, problem: Problem, count: int, width: float | None) -> tuple[Array, float]:
    """Return control points (n, 3) spread over the surface, and the filter width.

    Parameters
    ----------
    count
        Number of points.
    width
        Filter width over R; None: the median distance of neighbouring points.
    """
    places = _places(case, problem, count)
    if width:
        return places, width
    # the second nearest point, [2], is the neighbour: the nearest one is the point itself
    distances, _ = scipy.spatial.cKDTree(places).query(places, [2])
    return places, float(np.median(distances))


def _remanence(case: Case, section: RemanenceVariables) -> Vectors:
    """Return the vectors of the remanence as variables, with their control points.

    Raises
    ------
    CaseError
        If the vectors start with lengths beyond the bounds.
    """
    controls, start = controls_of(case, section.points, section.filter, "design.remanence")
    sizes, length_bounds = np.linalg.norm(start, axis=1), section.magnitude
    if length_bounds is None:  # lengths stay as they are
        return Vectors(controls, start, lengths=None)
    low, high = length_bounds
    if not (low - 1e-9 <= sizes.min() and sizes.max() <= high + 1e-9):
        raise CaseError(
            f"design.remanence.magnitude: the vectors start with lengths {sizes.min():g} to "
            f"{sizes.max():g}, beyond "
            f"{low:g} to {high:g}"
        )
    return Vectors(controls, start, lengths=(low, high))


def _has_influence(case: Case) -> bool:
    """Return whether the remanence of a case has an influence on any result."""
    # another magnet feels the remanence without an applied field, as a sensor does
    return any(case.context.strengths.values()) or bool(case.sensors) or acts(case.context)


def controls_of(
    case: Case, count: int | None, width: float | None, key: str
) -> tuple[ControlPoints, Array]:
    """Return the control points of the remanence, and the vectors of the case at these points.

    Parameters
    ----------
    count
        Number of points; None: the points of a remanence of kind `points`.
    width
        Filter width over R; None: that of the remanence, or the distance of the points.
    key
        Key with which messages begin.

    Returns
    -------
    controls
        The points.
    vectors
        (n, 3), or (n, 2) on a meridian, over |B^r|.

    Raises
    ------
    CaseError
        If no remanence has an influence, or `count` is None and there are no points.
    """
    remanent = case.magnetic.remanent if case.magnetic else None
    if remanent is None or not _has_influence(case):
        raise CaseError(
            f"{key}: the case has no remanence in a field, of a neighbour or that a sensor reads, "
            "so no result "
            "depends on it"
        )
    if count is None:  # a remanence of kind `points` has its own points
        if not remanent.file:
            raise CaseError(f"{key}: give points, or magnetic.remanent of kind: points")
        places, vectors = read_vectors(remanent.path, "magnetic.remanent.file", remanent.files)
        width_of_remanent = remanent.filter or 1.0
        return ControlPoints(places, width or width_of_remanent), vectors
    # points spread over the surface, with the remanence of the case there
    problem = case.problem()
    places, width = _spread(case, problem, count, width)
    vectors = _remanence_at(places, case, problem, key)
    if problem.meridian:  # (rho, z)
        places, vectors = places[:, [0, 2]], vectors[:, [0, 2]]
    return ControlPoints(places, width), vectors


def _remanence_at(places: Array, case: Case, problem: Problem, key: str) -> Array:
    """Return the remanence (n, 3) of a case over |B^r|, at places (n, 3).

    Parameters
    ----------
    key
        Key with which messages begin.

    Raises
    ------
    CaseError
        If the remanence is given by patches of a mesh.
    """
    # the magnetisation in the frame of the case, turned by no angle
    field = magnetisation(case.magnetic, case.context, turn=0.0, patch_rims=problem.within)
    if field.patches is not None:
        raise CaseError(
            f"{key}.points: the remanence starts by patches of a mesh: start from another kind"
        )
    if callable(field.remanent):
        # outward directions of the points from the origin
        normals = places / np.maximum(np.linalg.norm(places, axis=1, keepdims=True), 1e-300)
        # a function of places and normals (cells, nodes, 3)
        return np.array(field.remanent(places[:, None], normals[:, None])[:, 0])
    return np.tile(np.asarray(field.remanent, dtype=float), (len(places), 1))


def _places(case: Case, problem: Problem, count: int) -> Array:
    """Return `count` points (n, 3) along a meridian or a strip, or all over the surface.

    On a surface they are far from each other. They are fewer where the sample of the meridian or of
    the surface has fewer places.
    """
    if problem.meridian:
        sample = problem.meridian.sample()
        # each place once: the default filter width is the distance of neighbours
        chosen = np.unique(np.linspace(0, len(sample) - 1, count).round().astype(int))
        # in the plane y = 0
        return np.asarray(sample[chosen] * [1.0, 0.0, 1.0])
    if case.shell.geometry == "strip":
        parameters = np.linspace(0.0, 1.0, count)
        return np.column_stack([parameters, 0 * parameters, 0 * parameters])
    sample = outline(case.shell).sample()
    chosen_points, distances = [0], np.full(len(sample), np.inf)
    # farthest-point sampling: next is the point farthest from all chosen points
    while len(chosen_points) < min(count, len(sample)):
        distances = np.minimum(
            distances, np.linalg.norm(sample - sample[chosen_points[-1]], axis=1)
        )
        chosen_points.append(int(np.argmax(distances)))
    return np.asarray(sample[chosen_points])
