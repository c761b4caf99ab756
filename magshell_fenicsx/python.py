"""A problem in Python, without a case file: a shell, what holds it and what loads it, as objects.

They say what the sections of a case file say, in the same words and with the same messages; values
may be NumPy's, and where a formula may stand, a dolfinx function on the shell's mesh may stand too.

A case file is YAML: sections by key, each with keys of its own. `Keys` is such a section as a
dictionary. A part of a problem is a section or a step of the programme, the list of loadings; its
keys are made when the shell is known, on whose mesh functions are. A member shell is one of several
shells. An `OwnTerm` is an energy that a program defines.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import atan2, degrees, hypot
from pathlib import Path
from textwrap import shorten
from types import UnionType
from typing import Any, Literal, TypeAlias, Union, Unpack, get_args, get_origin, overload

import numpy as np
import ufl
from dolfinx import fem, mesh
from numpy.typing import NDArray
from pydantic import BaseModel

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.input.messages import refuse_unknown, unknown
from magshell_fenicsx.input.section import in_units
from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.mesh.user_mesh import MeshPart, UserMesh
from magshell_fenicsx.models.shell.own_term import OwnTerm
from magshell_fenicsx.parts.registered import FORMER_KINDS, STEPS
from magshell_fenicsx.parts.shell_sections import ShellSection, Surface
from magshell_fenicsx.platform.input_files import Files
from magshell_fenicsx.problem import problem
from magshell_fenicsx.python_keys import (
    ContactKeys,
    DeadLoadKeys,
    EdgeKeys,
    FactorKeys,
    FactorKind,
    FieldKeys,
    ForceKeys,
    FoundationKeys,
    GravityKeys,
    ImperfectionKeys,
    IndentationKeys,
    MeshKeys,
    NaturalKeys,
    NaturalStepKeys,
    PressureKeys,
    RotationKeys,
    SectionName,
    ShellKeys,
    SourceKeys,
    SpinKeys,
    TimeKeys,
)

Keys = dict[str, Any]
Vector: TypeAlias = Sequence[float | str] | fem.Function | Mapping[str, Any] | str
NAME = "Problem"  # in messages, in place of a file
MESH = "the mesh"  # in messages, in place of a mesh file
UNIONS = (Union, UnionType)
# a mesh so many times as long as the radius, or such a part of it, is not in metres
MAX_EXTENT_OVER_RADIUS = 50.0
# extents of a mesh in metres that is not said to be in metres
MIN_EXTENT_OVER_THICKNESS, MAX_EXTENT_OVER_THICKNESS = 3.0, 1e4
SHAPES: Mapping[str, type[BaseModel]] = {  # geometry -> its section
    geometry: section
    for section in (ShellSection, *get_args(Surface))
    for geometry in get_args(section.model_fields["geometry"].annotation)
}


class Shell:
    """The mid-surface, its thickness and its material.

    Parameters
    ----------
    surface
        A dolfinx mesh of triangles in space, of order 1 to 3; or a geometry of a case file, such as
        "hemisphere".
    edges, patches
        Of a mesh: name -> a value of the tags, or local numbers of facets or of cells. Every edge
        where the surface ends needs a name.
    facet_tags, cell_tags
        Of a mesh, as dolfinx reads them.
    radius
        The length R that formulas and dimensionless results are over; by default of a mesh half its
        largest extent.
    unit
        Of a mesh: the unit of its coordinates where the thickness has one, such as "mm"; by default
        the metre, which is refused where bounds, radius and thickness say otherwise: give "m" where
        it is right.
    name, place, points, mesh, remanent
        Of one of several shells: the name before its edges and points, `upper.rim`; and where it
        is, its named points, its elements (`{"size": "2 mm"}`) and its remanence, as a case has
        them under `shells`.
    keys
        Further keys of a case under `shell`: thickness, youngs_modulus, poisson_ratio, ... The
        thickness times `thickness_factor`, a formula of the place x, y, z over R or a function, is
        that of each place. A function is interpolated with x in the coordinates of the mesh, in mm
        for instance; a formula never has these.

    Raises
    ------
    MeshError
        On every rank, if the mesh is of another kind, or tags are missing.
    CaseError
        If a geometry or a key is none that a shell has, or `unit` seems to be forgotten.

    Attributes
    ----------
    user_mesh
        The dolfinx mesh; None of a geometry.
    files
        Store of the triangles of the mesh, which take the place of a file.
    _keys
        Keys of the section `shell` of a case, with their values.
    _member_keys
        Keys that only one of several shells may have; None for those that are not given.
    """

    def __init__(  # noqa: PLR0913 - what a user gives
        self,
        surface: mesh.Mesh | str,
        *,
        edges: Mapping[str, MeshPart] | None = None,
        patches: Mapping[str, MeshPart] | None = None,
        facet_tags: mesh.MeshTags | None = None,
        cell_tags: mesh.MeshTags | None = None,
        radius: float | str | None = None,
        unit: str | None = None,
        name: str | None = None,
        place: Mapping[str, Any] | None = None,
        points: Mapping[str, Sequence[Any]] | None = None,
        mesh: Mapping[str, Any] | None = None,
        remanent: Mapping[str, Any] | None = None,
        **keys: Unpack[ShellKeys],
    ) -> None:
        self.user_mesh: UserMesh | None = None
        self.name = name
        _refuse_nameless("shell.edges", edges, 'edges={"rim": 2}')
        _refuse_nameless("shell.patches", patches, 'patches={"magnet": 1}')
        self._keys: Keys = {**keys} if radius is None else {**keys, "radius": radius}
        if isinstance(self._keys.get("thickness"), fem.Function | fem.Constant):
            raise CaseError(
                f"{NAME}: shell.thickness: is a length alone: give a number or text, and "
                "thickness_factor, a function or a constant that multiplies it"
            )
        self._member_keys = {"place": place, "points": points, "mesh": mesh, "remanent": remanent}
        self.files = Files()
        geometry = surface if isinstance(surface, str) else "mesh"
        if geometry not in SHAPES:
            raise CaseError(f"{NAME}: {geometry}: {unknown(geometry, SHAPES, 'geometry')}")
        # names that are arguments here rather than keys of a case are known as well
        of_mesh = ("edges", "patches", "facet_tags", "cell_tags") if geometry == "mesh" else ()
        refuse_unknown(
            keys, SHAPES[geometry], f"{NAME}: shell", ("name", *self._member_keys, *of_mesh)
        )
        if isinstance(surface, str):
            _refuse_mesh_keys(
                surface,
                edges=edges,
                patches=patches,
                facet_tags=facet_tags,
                cell_tags=cell_tags,
                unit=unit,
            )
            self._keys |= {"geometry": surface}
            return
        if unfit := next((key for key in ("geometry", "file") if key in keys), None):
            raise CaseError(f"{NAME}: shell.{unfit}: the surface is the mesh; leave it out")
        self.user_mesh = UserMesh(surface)
        triangles = self.user_mesh.triangles(edges or {}, patches or {}, facet_tags, cell_tags)
        # the case names a file, which is never read: its content is given
        self.files.given[Path(MESH).absolute()] = triangles
        self._keys |= {"geometry": "mesh", "file": MESH}
        # without any unit all lengths are plain numbers; a mesh without its own unit is in metres
        thickness: Any = self._keys.get("thickness")
        has_units = isinstance(thickness, str)
        if has_units or unit is not None:
            self._keys["unit"] = unit or "m"
        extents = np.ptp(triangles.nodes, axis=0)
        if has_units:
            _refuse_unit(extents, unit, radius, thickness)
        if radius is None:
            half_extent = float(extents.max()) / 2
            self._keys["radius"] = f"{half_extent!r} {unit or 'm'}" if has_units else half_extent

    def one_of_several(self) -> Keys:
        """Return the section of a case for this shell, under `shells` and the shell's name."""
        keys = {
            key: self.plain_value(value, key)
            for key, value in self._member_keys.items()
            if value is not None
        }
        return {"shell": self.section(), "boundary": {}, **keys}

    def section(self) -> Keys:
        """Return the section `shell` of a case.

        Raises
        ------
        CaseError
            If the shell has keys that only one of several shells may have, but no name.
        """
        member_keys = [key for key, value in self._member_keys.items() if value is not None]
        if self.name is None and member_keys:
            raise CaseError(
                f"{NAME}: shell.{member_keys[0]}: is of one of several shells, which have names: "
                "give it to Problem"
            )
        return {key: self.plain_value(value, f"shell.{key}") for key, value in self._keys.items()}

    def plain_value(self, value: Any, key: str) -> Any:
        """Return a value as a case file has it: plain lists, mappings, numbers and text.

        A function or a constant on the mesh becomes a `UserField`.

        Parameters
        ----------
        key
            Key of the value in the case, for messages.
        """
        if isinstance(value, fem.Function | fem.Constant):
            return self.user_field(value, key)
        if callable(value) or isinstance(value, ufl.core.expr.Expr):
            is_expression = isinstance(value, ufl.core.expr.Expr)  # which can be called, too
            kind = "an expression of UFL" if is_expression else "a function of Python"
            raise CaseError(
                f"{NAME}: {key}: is {kind}"
                ': give a formula such as "1 + 0.2*x", or a dolfinx function: '
                "f = fem.Function(V); f.interpolate(...)"
            )
        if isinstance(value, np.ndarray | np.generic):
            return value.tolist()
        if isinstance(value, Mapping):
            return {name: self.plain_value(item, f"{key}.{name}") for name, item in value.items()}
        if isinstance(value, list | tuple):
            return [self.plain_value(item, key) for item in value]
        return value

    def user_field(self, function: fem.Function | fem.Constant, key: str) -> UserField:
        """Return a function or a constant on the shell's dolfinx mesh as a field of a case.

        Parameters
        ----------
        key
            Key of the function in the case, for messages.

        Raises
        ------
        MeshError
            If the function is on another mesh, or its space is not one of polynomials.
        CaseError
            If the shell has no mesh.
        """
        if self.user_mesh is None:
            raise CaseError(f"{NAME}: {key}: is a function; that needs a shell on a dolfinx mesh")
        return self.user_mesh.field(function, key)


class ProblemPart:
    """Part of a `Problem`: a section of a case, or a step of its programme.

    Parameters
    ----------
    key
        Key of the section; "loading" of a step.
    keys
        Function of the shell with the keys of the section and their values.
    text
        The part as a program writes it.
    """

    def __init__(self, key: str, keys: Callable[[Shell], Keys], text: str) -> None:
        self.key, self.keys, self.text = key, keys, text

    def __repr__(self) -> str:
        return self.text


class Section(ProblemPart):
    """Any section of a case, in its words: `Section("foundation", stiffness=0.02)`, ...

    A section that is a list is a keyword of `Problem` instead: `joints=[...]`, `contact=[...]`.

    Parameters
    ----------
    key
        Name of the section in a case, such as "natural".
    keys
        Keys of the section.

    Raises
    ------
    CaseError
        If a case has no such section, or the section has no such key.
    """

    @overload
    def __init__(self, key: Literal["foundation"], **keys: Unpack[FoundationKeys]) -> None: ...
    @overload
    def __init__(self, key: Literal["natural"], **keys: Unpack[NaturalKeys]) -> None: ...
    @overload
    def __init__(self, key: Literal["mesh"], **keys: Unpack[MeshKeys]) -> None: ...
    @overload
    def __init__(self, key: SectionName, **keys: Any) -> None: ...
    def __init__(self, key: str, **keys: Any) -> None:
        if key not in Case.model_fields:
            raise CaseError(f"{NAME}: {key}: {unknown(key, Case.model_fields, 'section')}")
        annotation = Case.model_fields[key].annotation
        members = get_args(annotation) if get_origin(annotation) in UNIONS else (annotation,)
        types = [member for member in members if isinstance(member, type)]
        sections = [member for member in types if issubclass(member, BaseModel)]
        # lists, and mappings of names to sections, have no keys that could be checked here
        if len(sections) == 1:
            refuse_unknown(keys, sections[0], f"{NAME}: {key}")
        super().__init__(
            key, lambda shell: shell.plain_value(keys, key), _call_text("Section", (key,), keys)
        )


class Step(ProblemPart):
    """A step of the programme, of any kind that a case has.

    Parameters
    ----------
    kind
        "dead", "indentation", "field", "natural", "contact", ...
    keys
        Further keys of the step in a case.

    Raises
    ------
    CaseError
        If a case has no such kind, or the step has no such key.
    """

    @overload
    def __init__(self, kind: Literal["pressure"], **keys: Unpack[PressureKeys]) -> None: ...
    @overload
    def __init__(self, kind: Literal["indentation"], **keys: Unpack[IndentationKeys]) -> None: ...
    @overload
    def __init__(self, kind: FactorKind, **keys: Unpack[FactorKeys]) -> None: ...
    @overload
    def __init__(self, kind: Literal["imperfection"], **keys: Unpack[ImperfectionKeys]) -> None: ...
    @overload
    def __init__(self, kind: Literal["rotation"], **keys: Unpack[RotationKeys]) -> None: ...
    @overload
    def __init__(self, kind: Literal["natural"], **keys: Unpack[NaturalStepKeys]) -> None: ...
    @overload
    def __init__(self, kind: Literal["dead"], **keys: Unpack[DeadLoadKeys]) -> None: ...
    @overload
    def __init__(self, kind: Literal["edge"], **keys: Unpack[EdgeKeys]) -> None: ...
    @overload
    def __init__(self, kind: Literal["contact"], **keys: Unpack[ContactKeys]) -> None: ...
    @overload
    def __init__(self, kind: Literal["source"], **keys: Unpack[SourceKeys]) -> None: ...
    @overload
    def __init__(self, kind: Literal["spin"], **keys: Unpack[SpinKeys]) -> None: ...
    @overload
    def __init__(self, kind: Literal["gravity"], **keys: Unpack[GravityKeys]) -> None: ...
    @overload
    def __init__(self, kind: Literal["time"], **keys: Unpack[TimeKeys]) -> None: ...
    def __init__(self, kind: str, **keys: Any) -> None:
        known_kind = dict(FORMER_KINDS).get(kind, kind)  # a name of earlier versions
        if known_kind not in STEPS:
            raise CaseError(f"{NAME}: {kind}: {unknown(kind, STEPS, 'kind of step')}")
        refuse_unknown(keys, STEPS[known_kind], f"{NAME}: loading")
        data = {"kind": known_kind, **keys}
        super().__init__(
            "loading",
            lambda shell: shell.plain_value(data, "loading"),
            _call_text("Step", (known_kind,), keys),
        )


class Pressure(Step):
    """A live pressure; by default up to the first instability.

    Parameters
    ----------
    keys
        Keys of a step of kind "pressure" in a case.
    """

    def __init__(self, **keys: Unpack[PressureKeys]) -> None:
        super().__init__("pressure", **keys)
        self.text = _call_text("Pressure", (), keys)


class Force(Step):
    """A force along the inward normal at one point.

    Parameters
    ----------
    at
        Name of a point, or angles as in a case.
    keys
        Keys of a step of kind "indentation" in a case; `depth` or `force` is where it ends.
    """

    def __init__(self, at: Mapping[str, Any] | str, **keys: Unpack[ForceKeys]) -> None:
        super().__init__("indentation", at={"point": at} if isinstance(at, str) else at, **keys)
        self.text = _call_text("Force", (at,), keys)
        if not keys.keys() & {"depth", "force", "until"}:
            raise CaseError(
                f'{NAME}: Force: {at}: where does it end? give depth, such as "2 mm", or force, or '
                'until="limit"'
            )


class _Support(ProblemPart):
    """A part that gives several named edges, patches or points one support condition."""

    def __init__(self, condition: Any, names: Sequence[str], text: str) -> None:
        for name in names:
            if not isinstance(name, str):
                raise CaseError(
                    f"{NAME}: boundary: {name!r}: is no name: name the tag in ms.Shell, "
                    'edges={"rim": ...}'
                )
        super().__init__("boundary", lambda shell: dict.fromkeys(names, condition), text)


class Clamped(_Support):
    """Edges or patches without displacement and rotation."""

    def __init__(self, *names: str) -> None:
        super().__init__("clamped", names, _call_text("Clamped", names))


class Hinged(_Support):
    """Edges or patches without displacement."""

    def __init__(self, *names: str) -> None:
        super().__init__("hinged", names, _call_text("Hinged", names))


class Held(_Support):
    """A support without displacements along some axes.

    Parameters
    ----------
    name
        An edge, a patch or a named point.
    components
        Axes along which it cannot move, such as "xz".
    """

    def __init__(self, name: str, components: str) -> None:
        super().__init__({"held": list(components)}, [name], _call_text("Held", (name, components)))


class OnPlane(_Support):
    """Edges in a mirror plane of a shape of which the shell is a part."""

    def __init__(self, *names: str) -> None:
        super().__init__("symmetry", names, _call_text("OnPlane", names))


def _call_text(name: str, arguments: Sequence[Any], keys: Mapping[str, Any] | None = None) -> str:
    """Return a call of a class as a program writes it, shortened where values are long."""
    texts = [repr(value) for value in arguments]
    texts += [f"{key}={value!r}" for key, value in (keys or {}).items()]
    return f"{name}({shorten(', '.join(texts), 200)})"


class Field(ProblemPart):
    """Remanence and applied field; in tesla, or with `lambda_m` over their magnitudes.

    Parameters
    ----------
    remanent, applied
        A vector of three numbers, texts with a unit such as "90 mT", or formulas; of the remanence
        too a function on the mesh or its kind in a case, such as "radial"; or all its keys in a
        case. In formulas x, y, z are the place over R, the `radius` of the shell, and never the
        coordinates of the mesh: of the remanence the undeformed place, of the applied field the
        deformed one. A function on the mesh is interpolated with x in the mesh's coordinates: with
        R = 40 mm, "sin(pi*x/2)" is `interpolate(lambda x: np.sin(np.pi * x[0] / 80))` on a mesh in
        mm.
    lambda_m
        |B^r| |B^a|/(mu_0 E). It is positive where the field is along `applied`, also as an
        amplitude, and negative where the field is reversed.
    keys
        What else a case has under `magnetic`.
    """

    def __init__(
        self,
        remanent: Vector,
        applied: Vector,
        *,
        lambda_m: float | None = None,
        **keys: Unpack[FieldKeys],
    ) -> None:
        def magnetic_keys(shell: Shell) -> Keys:
            """Return the section `magnetic` of a case with this shell."""
            dimensionless = lambda_m is not None
            section: Keys = {
                "remanent": _flux(
                    remanent, shell, "magnetic.remanent", dimensionless=dimensionless
                ),
                "applied": _flux(applied, shell, "magnetic.applied", dimensionless=dimensionless),
                **shell.plain_value(keys, "magnetic"),
            }
            if dimensionless:
                section["lambda_m"] = shell.plain_value(lambda_m, "magnetic.lambda_m")
            return section

        given = dict(keys) if lambda_m is None else {"lambda_m": lambda_m, **keys}
        super().__init__("magnetic", magnetic_keys, _call_text("Field", (remanent, applied), given))


def _refuse_nameless(key: str, value: Any, example: str) -> None:
    """Check that a value has names; None is not given.

    Raises
    ------
    CaseError
        If it is no mapping; the message has the example.
    """
    if value is not None and not isinstance(value, Mapping):
        raise CaseError(f"{NAME}: {key}: {value!r}: give names with their values: {example}")


def _refuse_mesh_keys(geometry: str, **mesh_keys: Any) -> None:
    """Refuse arguments that only a mesh may have, beside the name of a geometry.

    `mesh_keys` are the arguments by name; None stands for one that is not given.

    Raises
    ------
    CaseError
        With the first argument that is given.
    """
    unfit = next((key for key, value in mesh_keys.items() if value is not None), None)
    if unfit:
        raise CaseError(f"{NAME}: shell.{unfit}: is of a mesh; a {geometry} has its own edges")


def _refuse_unit(
    extents: NDArray[np.float64], unit: str | None, radius: float | str | None, thickness: str
) -> None:
    """Check that the bounds of a mesh may be those of a shell with this radius and thickness.

    Parameters
    ----------
    extents
        (3,), lengths of the mesh along its axes.
    unit, radius, thickness
        As the user has given them; a radius of None is not compared, nor is the thickness beside a
        unit. A mesh without a unit is in metres.

    Raises
    ------
    CaseError
        If the largest extent is far from the radius, or from that of a shell with this thickness.
    """
    unit_in_metres = _in_metres(f"1 {unit or 'm'}")
    if unit_in_metres is None:  # refused elsewhere
        return
    bounds = " x ".join(f"{length:.4g}" for length in extents)
    unnamed = "" if unit else "shell.unit: is not given, so "
    another = "another unit" if unit else 'unit="mm", for instance'
    limits = {"radius": (radius, 1 / MAX_EXTENT_OVER_RADIUS, MAX_EXTENT_OVER_RADIUS)}
    if unit is None:
        limits["thickness"] = (thickness, MIN_EXTENT_OVER_THICKNESS, MAX_EXTENT_OVER_THICKNESS)
    for name, (length, least, most) in limits.items():
        metres = _in_metres(length)  # None: not given, or refused elsewhere
        ratio = float(extents.max()) * unit_in_metres / (metres or np.nan)
        if metres and not least <= ratio <= most:
            way_out = "leave the radius out" if name == "radius" else 'unit="m" if that is right'
            raise CaseError(
                f"{NAME}: {unnamed}the mesh is {bounds} {unit or 'm'}, {ratio:.4g} times as long "
                f"as {name}, {length}: give {another}, or {way_out}"
            )


def _in_metres(length: Any) -> float | None:
    """Return a length in metres; None if it is no positive length, which is refused elsewhere.

    Parameters
    ----------
    length
        Number, or text with a unit.
    """
    try:
        metres = float(in_units("metre")(length))
    except (TypeError, ValueError):
        return None
    return metres if metres > 0 else None


def _flux(value: Vector, shell: Shell, key: str, *, dimensionless: bool) -> Keys:
    """Return the keys of a remanence or an applied field in a case's section `magnetic`.

    Numbers become a direction (polar and azimuth angle) and a magnitude; formulas become
    components.

    Parameters
    ----------
    value
        Vector of three numbers or formulas, function on the mesh, name of a kind such as "radial",
        or all keys of the section.
    key
        "magnetic.remanent" or "magnetic.applied".
    dimensionless
        Whether vectors are over their magnitudes, rather than in tesla.

    Raises
    ------
    CaseError
        If it is no vector of three numbers or formulas, or has a unit beside `lambda_m`.
    """

    def magnitude_key(tesla: float) -> Keys:
        """Return the key of a magnitude in tesla; no key in a dimensionless problem."""
        return {} if dimensionless else {"flux_density": f"{tesla!r} T"}

    # an applied field has no kinds
    expression_kind = {"kind": "expression"} if key.endswith("remanent") else {}
    if isinstance(value, Mapping):
        return {name: shell.plain_value(item, f"{key}.{name}") for name, item in value.items()}
    if isinstance(value, str):
        return {"kind": value}
    if isinstance(value, fem.Function):
        field = shell.user_field(value, key)
        # the largest magnitude, over which components are given; 1.0 for a field of zero
        magnitude = 1.0 if dimensionless else float(np.linalg.norm(field.largest)) or 1.0
        return {
            **expression_kind,
            "components": field.mapped(lambda B: np.asarray(B / magnitude)),
            **magnitude_key(magnitude),
        }
    components = shell.plain_value(value, key)
    if not isinstance(components, list) or len(components) != 3:
        raise CaseError(f"{NAME}: {key}: {components}: a vector has three components")
    if dimensionless and any(_in_tesla(item) != item for item in components):
        raise CaseError(
            f"{NAME}: {key}: {components}: with lambda_m vectors are over their magnitudes: give "
            "numbers, or leave lambda_m out"
        )
    components = [_in_tesla(item) for item in components]
    # formulas stay components; so does a zero vector in a dimensionless problem, where no magnitude
    # could say that it is zero
    is_dimensionless_zero = dimensionless and not any(components)
    if is_dimensionless_zero or any(isinstance(item, str) for item in components):
        return {**expression_kind, "components": list(map(str, components)), **magnitude_key(1.0)}
    try:
        x, y, z = map(float, components)
    except (TypeError, ValueError):
        raise CaseError(
            f"{NAME}: {key}: {components}: its components are numbers or formulas"
        ) from None
    direction = {"polar": degrees(atan2(hypot(x, y), z)), "azimuth": degrees(atan2(y, x))}
    return {**direction, **magnitude_key(hypot(x, y, z))}


def _in_tesla(component: Any) -> Any:
    """Return a component such as "90 mT" as a number in tesla; a number or a formula stays."""
    try:
        return in_units("tesla")(component)
    except ValueError:
        return component


class _ProblemType(type):
    """Type of `Problem`: problems of cases, too, are instances of it."""

    def __instancecheck__(cls, instance: object) -> bool:
        return isinstance(instance, problem.Problem)


class Problem(problem.Problem, metaclass=_ProblemType):
    """A complete problem, for `Model`, `follow` and other functions that take a problem.

    Parameters
    ----------
    shell
        The shell that is computed; or several, each with a name: `Clamped("upper.rim")` then holds
        the rim of `upper`.
    parts
        Supports, fields, steps and other sections, and one's own energies. The steps are a
        programme in this order; before a single one the natural shape grows and the field is
        applied.
    points
        Name -> place: texts with a unit such as "2 mm", or numbers in metres, or without units in
        the lengths of the shell; on a mesh a vertex.
    degree
        Polynomial degree of the displacement.
    symmetry
        As in a case; by default all of a mesh, and of other shapes the smallest part that all
        allow.
    sections
        Other sections of a case, by key.

    Raises
    ------
    CaseError, MeshError
        One message with every mistake of the keys; on every rank. Whether the mesh has the edges,
        patches and points that are named, and whether the supports hold the shell, is found out
        when a `Model` is made.
    """

    def __new__(  # type: ignore[misc]  # a problem is the same whatever makes it
        cls,
        shell: Shell | Sequence[Shell],
        *parts: ProblemPart | OwnTerm,
        points: Mapping[str, Sequence[Any]] | None = None,
        degree: int | None = None,
        symmetry: Literal["auto", "none", "half", "axisymmetric"] | None = None,
        **sections: Any,
    ) -> problem.Problem:
        _refuse_nameless("points", points, 'points={"tip": [1, 0, 0]}')
        member_shells = list(shell) if isinstance(shell, list | tuple) else []
        if member_shells:
            # any of them turns values into plain ones: none has a mesh, and so no functions
            shell = member_shells[0]
            _refuse_unfit_shells(member_shells)
        if not isinstance(shell, Shell):
            raise CaseError(f"{NAME}: {shell!r}: the first argument is what ms.Shell gives")
        case_data = {
            **_shell_data(shell, member_shells),
            "boundary": {},
            **shell.plain_value(sections, "case"),
        }
        steps, own_terms = list[Keys](), list[OwnTerm]()
        for part in parts:
            if isinstance(part, OwnTerm):
                own_terms.append(_on_mesh(part, shell))
            elif not isinstance(part, ProblemPart):
                raise CaseError(
                    f"{NAME}: {part!r}: allowed are what ms.Clamped, ms.Field, ms.Step, ... give, "
                    "and OwnTerm"
                )
            elif part.key == "loading":
                steps.append(part.keys(shell))
            else:
                _join(case_data, part.key, part.keys(shell))
        if steps and "loading" in case_data:
            raise CaseError(f"{NAME}: loading: is given twice, as steps and as a section")
        if steps:
            case_data["loading"] = steps[0] if len(steps) == 1 else steps
        _join(case_data, "points", shell.plain_value(points or {}, "points"))
        if member_shells:
            _distribute(case_data)
        if degree is not None:
            _join(case_data, "mesh", {"degree": degree})
        if symmetry or shell.user_mesh:
            case_data["symmetry"] = symmetry or "none"
        return (
            Case.from_source(Source(NAME, case_data, files=shell.files))
            .with_terms(own_terms)
            .problem()
        )


def _shell_data(shell: Shell, several: Sequence[Shell]) -> Keys:
    """Return the section `shell` of a case; of several shells the section `shells`, by name."""
    if not several:
        return {"shell": shell.section()}
    return {"shells": {member.name: member.one_of_several() for member in several}}


def _refuse_unfit_shells(several: Sequence[Any]) -> None:
    """Check that each of several shells has its own name, and a geometry rather than a mesh.

    Raises
    ------
    CaseError
        If a shell has no name or a mesh, or two shells have the same name.
    """
    for shell in several:
        if not isinstance(shell, Shell) or not shell.name:
            words = "a shell without a name" if isinstance(shell, Shell) else repr(shell)
            raise CaseError(
                f"{NAME}: {words}: of several shells each is what ms.Shell gives, with a name"
            )
        if shell.user_mesh:
            raise CaseError(
                f"{NAME}: {shell.name}: of several shells each has a geometry: write its mesh to a "
                "file"
            )
    names = [shell.name for shell in several]
    if doubled := next((name for name in names if names.count(name) > 1), None):
        raise CaseError(f"{NAME}: {doubled}: two shells have this name")


def _distribute(data: Keys) -> None:
    """Move supports and points of several shells into the section of each shell, in place.

    Their names begin with that of a shell and a dot, as in "upper.rim".

    Raises
    ------
    CaseError
        If a name does not begin so.
    """
    for key in ("boundary", "points"):
        for name, value in data.pop(key).items():
            shell, dot, name_in_shell = name.partition(".")
            if not dot or shell not in data["shells"]:
                raise CaseError(
                    f"{NAME}: {key}.{name}: begins with the name of a shell: "
                    f"{next(iter(data['shells']))}.rim"
                )
            _join(data["shells"][shell], key, {name_in_shell: value})


def _join(data: Keys, key: str, added: Keys) -> None:
    """Add keys to a section of `data`, in which nothing may be given twice.

    Parameters
    ----------
    key
        Name of the section; it is made if it is missing.
    added
        Keys of the section with their values.

    Raises
    ------
    CaseError
        If a key is given already, with another value.
    """
    section = data.get(key, {})  # a user may have given something else under this key
    if not isinstance(section, dict):
        raise CaseError(f"{NAME}: {key}: {section!r}: must be a section, with keys below it")
    for name, value in added.items():
        if name in section and section[name] != value:
            raise CaseError(
                f"{NAME}: {key}.{name}: is given twice, as {section[name]} and as {value}"
            )
    data[key] = {**section, **added}


def _on_mesh(term: OwnTerm, shell: Shell) -> OwnTerm:
    """Return a user-defined energy with `UserField`s in place of functions as its parameters.

    A field has the function's values in all triangles of the mesh. An energy without functions is
    returned itself.
    """
    functions = fem.Function | fem.Constant
    if not any(isinstance(p, functions) for p in term.parameters):
        return term
    parameters = tuple(
        shell.user_field(p, f"terms.{term.name}") if isinstance(p, functions) else p
        for p in term.parameters
    )
    return replace(term, parameters=parameters)
