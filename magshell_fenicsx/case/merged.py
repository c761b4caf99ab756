"""How a case with several shells becomes one of a mesh file, with the names of their edges, points
and patches.
"""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from magshell_fenicsx.case.shells import OneOfShells, Part, Several, Shells
from magshell_fenicsx.input.section import Section, numbers_with_units
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.parts.magnetism.remanent import RemanentSection
from magshell_fenicsx.shape.shell_sections import ShellSection

if TYPE_CHECKING:
    from magshell_fenicsx.case.case import Case

Array = NDArray[np.float64]
Keys = dict[str, Any]
INSTEAD_OF = ("shell", "boundary", "points")
OF_NAMES = (
    "loading",
    "contact",
    "joints",
    "natural",
    "magnetic",
)  # sections that name edges, points and patches
FILES = ("file", "program")  # their values are no such names
IN_COMMON = ("viscosity", "relaxation")
OF_FIRST = ("law", "mooney", "mu", "alpha", *IN_COMMON)
MOST_UNLIKE = 1e6  # a modulus or a density over that of the first shell, or the other way round
SHOWN = ("at", "patch", "depth")  # keys of a force that mesh sizes follow
NAME = re.compile(r"[A-Za-z]\w*")


class _Given(Section):
    """For messages with the keys of the case."""

    shells: Shells


def expanded(
    data: Any, context: Mapping[str, Any] | None, case: "type[Case]"
) -> "tuple[Any, Several | None]":
    """The data of a case with its shells as one, which is a mesh file in the words of a case; None
    without shells.

    Raises
    ------
    ValueError, ValidationError
        With the key and what is allowed.
    """
    if not isinstance(data, dict) or data.get("shells") is None:
        return data, None
    for key in INSTEAD_OF:
        if data.get(key) is not None:
            raise ValueError(f"shells: each has its own {key}: leave out {key}, or shells")
    around = {key: context[key] for key in ("folder", "files") if key in context} if context else {}
    sections = _Given.model_validate({"shells": data["shells"]}, context={**around}).shells
    for name in sections:
        _refuse_name(name, sections)
    parts = [
        Part(name, section, _case(name, section, data, {**around}, case))
        for name, section in sections.items()
    ]  # in the order of the file
    several = Several(
        parts, _joined(_renamed(data.get("joints"), sections)), _pairs(data.get("contact"))
    )
    first = _merged(parts)
    whole = {
        key: _renamed(value, sections) if key in OF_NAMES else value for key, value in data.items()
    }
    whole |= {
        "shells": sections,
        "shell": {"geometry": "mesh", "file": several.file, **first},
        "boundary": {
            f"{part.name}_{name}": condition
            for part in parts
            for name, condition in part.section.boundary.conditions().items()
        },
        "points": _points(several),
    }
    if any(section.remanent for section in sections.values()):
        whole["magnetic"] = _magnetised(whole.get("magnetic"), several)
    return whole, several


def written(data: Keys, shells: Mapping[str, OneOfShells] | None) -> Keys:
    """The plain data of a case, without what its shells make."""
    if shells is None:
        return data
    magnetic = data.get("magnetic")
    if isinstance(magnetic, dict) and any(section.remanent for section in shells.values()):
        data = {
            **data,
            "magnetic": {key: value for key, value in magnetic.items() if key != "remanent"},
        }
    return {key: value for key, value in data.items() if key not in INSTEAD_OF}


def _refuse_name(name: str, names: Mapping[str, OneOfShells]) -> None:
    if not NAME.fullmatch(name) or name == "shell":
        raise ValueError(
            f"shells: {name!r}: a name is a word of letters, digits and _, and not shell, which is all"
        )
    if other := next((other for other in names if other.startswith(f"{name}_")), None):
        raise ValueError(
            f"shells: {other}: begins as {name}_ does, by which edges of {name} are named: rename one"
        )


def _case(name: str, section: OneOfShells, data: Keys, context: Keys, case: "type[Case]") -> "Case":
    """That of one shell alone."""
    given, mesh = data["shells"][name], data.get("mesh") or {}
    given = given.model_dump(exclude_unset=True) if isinstance(given, BaseModel) else given
    own = {
        "shell": given["shell"],
        "boundary": given.get("boundary") or {},
        "points": given.get("points") or {},
    }
    sizes = {key: mesh[key] for key in ("degree", "size", "refinement") if key in mesh}
    for key, value in (given.get("mesh") or {}).items():
        sizes[key] = value * sizes.get(key, 1.0) if key == "refinement" else value
    loading = data.get("loading")
    forces = [
        {"kind": "indentation", **({} if "depth" in load else {"control": "load", "force": 1.0})}
        | {key: load[key] for key in SHOWN if key in load}
        | {"at": {"point": at.split(".", 1)[1] if "." in at else at.removeprefix(f"{name}_")}}
        for load in (loading if isinstance(loading, list) else [loading])
        if isinstance(load, dict)
        and load.get("kind") == "indentation"
        and isinstance(load.get("at"), dict)
        if isinstance(at := load["at"].get("point"), str)
        and at.startswith((f"{name}.", f"{name}_"))
    ]
    own_points = own["points"] if isinstance(own["points"], dict) else {}
    forces = [force for force in forces if force["at"]["point"] in own_points]  # type: ignore[index]
    steps = [
        *forces,
        *([{"kind": "pressure"}] if _presses(loading, name) else []),
    ]  # what mesh sizes follow
    try:
        made = case.model_validate(
            {**own, "mesh": sizes, "symmetry": "none", **({"loading": steps} if steps else {})},
            context=context,
        )
    except ValidationError as e:
        error = e.errors()[0]
        said, key = error["msg"].removeprefix("Value error, "), ".".join(map(str, error["loc"]))
        raise ValueError(f"shells.{name}.{f'{key}: ' if key else ''}{said}") from None
    if not made.shell.with_units and [
        *numbers_with_units(section.place, given.get("place"), "place")
    ]:
        raise ValueError(
            f"shells.{name}.place: has a unit, but the shell's lengths have none: give all one, or none"
        )
    return made


def _joined(joints: Any) -> list[tuple[str, str]]:
    """The edges of joints, as far as these are such."""
    edges = (
        [each.get("edges") for each in joints if isinstance(each, dict)]
        if isinstance(joints, list)
        else []
    )
    return [(each[0], each[1]) for each in edges if isinstance(each, list) and len(each) == 2]


def _presses(loading: Any, name: str) -> bool:
    """Whether a step presses on a shell."""
    steps = loading if isinstance(loading, list) else [loading]
    return any(
        isinstance(load, dict)
        and load.get("kind") == "pressure"
        and name in (load.get("on") or (name,))
        for load in steps
    )


def _merged(parts: Sequence[Part]) -> Keys:
    """Keys of the shell that stands for all: with lengths and material of the first, which results
    are over.
    """
    first, shell = parts[0], parts[0].case.shell
    for part in parts:
        other = part.case.shell
        if other.with_units != shell.with_units:
            one, none = (first.name, part.name) if shell.with_units else (part.name, first.name)
            raise ValueError(
                part.refused(
                    f"shell: lengths of {one} have units and those of {none} none: give all of them one, or none"
                )
            )
        if isinstance(other.thickness_factor, UserField):
            raise ValueError(part.refused("shell.thickness_factor: of several shells a formula"))
        if (
            isinstance(other, ShellSection)
            and not other.with_units
            and other.youngs_modulus is not None
        ):
            raise ValueError(
                part.refused("shell.youngs_modulus: has a unit: give radius and thickness theirs")
            )
        for key in IN_COMMON:
            if getattr(other, key) != getattr(shell, key):
                raise ValueError(
                    part.refused(
                        f"shell.{key}: is another than that of {first.name}: several shells have it in common; their "
                        "law, youngs_modulus, poisson_ratio and density are their own"
                    )
                )
        for key, name in (("modulus", "youngs_modulus"), ("density", "density")):
            one, own = getattr(shell, key), getattr(other, key)
            if (one is None) != (own is None):
                bare, has = (part, first) if own is None else (first, part)
                raise ValueError(bare.refused(f"shell.{name}: is missing; {has.name} has one"))
            if one is not None and not 1 / MOST_UNLIKE <= own / one <= MOST_UNLIKE:
                raise ValueError(
                    part.refused(
                        f"shell.{name}: is {own / one:.3g} times that of {first.name}: allowed 1/{MOST_UNLIKE:g} to "
                        f"{MOST_UNLIKE:g}; is the unit right?"
                    )
                )
    unit = _unit if shell.with_units else (lambda value, unit: value)
    of_first: Keys = {
        "radius": unit(shell.reference, "m"),
        "thickness": unit(shell.reference / shell.R_over_h, "m"),
        "poisson_ratio": shell.poisson_ratio,
        **({"unit": "m"} if shell.with_units else {}),
    }
    if shell.modulus is not None:
        of_first["youngs_modulus"] = unit(shell.modulus, "Pa")
    if shell.density is not None:
        of_first["density"] = unit(shell.density, "kg/m**3")
    written = {key: getattr(shell, key) for key in OF_FIRST if key in shell.model_fields_set}
    return of_first | written


def _unit(value: float, unit: str) -> Any:
    return f"{value!r} {unit}"


def _points(several: Several) -> dict[str, list[float]]:
    """Name -> place in the frame of the case."""
    places = {}
    for part in several.parts:
        place = part.section.place
        for name, x in part.section.points.items():
            at = place.Q @ np.array(x) + np.array(place.position)
            places[f"{part.name}_{name}"] = [float(c) for c in at]
    return places


def _magnetised(magnetic: Any, several: Several) -> Any:
    """The section with the remanence of each shell as one by patches."""
    if magnetic is not None and not isinstance(magnetic, dict):
        return magnetic
    given = magnetic or {}
    if "remanent" in given:
        raise ValueError(
            "magnetic.remanent: shells have a remanence of their own: give it here, or there"
        )
    sizes = {
        part.name: part.section.remanent.flux_density
        for part in several.parts
        if part.section.remanent
    }
    if len({size is None for size in sizes.values()}) > 1:
        bare = next(name for name, size in sizes.items() if size is None)
        raise ValueError(f"shells.{bare}.remanent.flux_density: is missing; other shells have one")
    size = next(iter(sizes.values()))
    if 0 in sizes.values():
        raise ValueError(
            "shells: a remanence of length zero is no magnetisation: leave remanent out"
        )
    patches: dict[str, Any] = {}
    for part in several.parts:
        remanent = part.section.remanent
        if remanent is None:
            continue
        if remanent.kind == "patches" and part.case.shell.geometry != "mesh":
            raise ValueError(
                part.refused("remanent.patches: of several shells those of a mesh file alone")
            )
        factor = (
            1.0 if size is None or remanent.flux_density is None else remanent.flux_density / size
        )
        for name, own in {"": remanent, **(remanent.patches or {})}.items():
            if own is remanent and remanent.patches:
                continue
            section = (
                own if isinstance(own, RemanentSection) else RemanentSection(**own.model_dump())
            )
            patches[part.name if name in ("", "rest") else f"{part.name}_{name}"] = section.placed(
                several.place(part), factor
            )
    density = {} if size is None else {"flux_density": f"{size!r} T"}
    whole = {
        part.name for part in several.parts
    }  # before those of their parts, which take their place
    ordered = dict(sorted(patches.items(), key=lambda item: item[0] not in whole))
    return {**given, "remanent": {"kind": "patches", "patches": ordered, **density}}


def _pairs(given: Any) -> list[list[str]]:
    """The pairs of names among what `contact` has; what else it has is refused later."""
    parts = given if isinstance(given, list | tuple) else []
    entries = [part.get("between") if isinstance(part, dict) else part for part in parts]
    pairs = [pair for pair in entries if isinstance(pair, list | tuple)]
    return [
        [*pair] for pair in pairs if len(pair) == 2 and all(isinstance(name, str) for name in pair)
    ]


def _renamed(part: Any, shells: Mapping[str, Any]) -> Any:
    """A part of the data with upper_rim in place of upper.rim."""
    pattern = re.compile(rf"({'|'.join(map(re.escape, shells))})\.(\w+)")

    def name(text: Any) -> Any:
        return (
            pattern.sub(r"\1_\2", text)
            if isinstance(text, str) and pattern.fullmatch(text)
            else text
        )

    def walk(part: Any) -> Any:
        if isinstance(part, dict):
            return {
                name(key): value if key in FILES else walk(value) for key, value in part.items()
            }
        return [walk(each) for each in part] if isinstance(part, list) else name(part)

    return walk(part)
