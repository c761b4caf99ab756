"""A case with several shells as a case of one mesh file.

Edges, points and patches have the names that they have in the mesh of all.
"""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ValidationError

from magshell_fenicsx.case.shells import MemberCase, OneOfShells, SeveralShells, Shells
from magshell_fenicsx.input.section import Section, numbers_with_units
from magshell_fenicsx.mesh.patch import UserField
from magshell_fenicsx.parts.magnetism.remanent import RemanentSection
from magshell_fenicsx.shape.shell_sections import ShellSection

if TYPE_CHECKING:
    from magshell_fenicsx.case.case import Case

Array = NDArray[np.float64]
Keys = dict[str, Any]
REPLACED_KEYS = ("shell", "boundary", "points")
# sections that name edges, points and patches
SECTIONS_WITH_NAMES = ("loading", "contact", "joints", "natural", "magnetic")
FILE_KEYS = ("file", "program")  # their values are no such names
COMMON_KEYS = ("viscosity", "relaxation")
KEYS_OF_FIRST = ("law", "mooney", "mu", "alpha", *COMMON_KEYS)
MAX_RATIO = 1e6  # of a modulus or a density to that of the first shell, or the other way round
FORCE_KEYS = ("at", "patch", "depth")  # keys of a force that mesh sizes follow
NAME = re.compile(r"[A-Za-z]\w*")


class _ShellsAlone(Section):
    """Section `shells` alone, for messages with the keys of the case."""

    shells: Shells


def merge_shells(
    data: Any, context: Mapping[str, Any] | None, case: "type[Case]"
) -> "tuple[Any, SeveralShells | None]":
    """Return the data of a case with its shells as one mesh file, and the shells.

    Without `shells` the data are returned as they are, and None.

    Raises
    ------
    ValueError, ValidationError
        With the key and what is allowed.
    """
    if not isinstance(data, dict) or data.get("shells") is None:
        return data, None
    for key in REPLACED_KEYS:
        if data.get(key) is not None:
            raise ValueError(f"shells: each has its own {key}: leave out {key}, or shells")
    context_keys = (
        {key: context[key] for key in ("folder", "files") if key in context} if context else {}
    )
    sections = _ShellsAlone.model_validate(
        {"shells": data["shells"]}, context={**context_keys}
    ).shells
    for name in sections:
        _refuse_name(name, sections)
    # in the order of the file
    parts = [
        MemberCase(name, section, _case(name, section, data, {**context_keys}, case))
        for name, section in sections.items()
    ]
    joined_edges = _joined_edges(_with_mesh_names(data.get("joints"), sections))
    several = SeveralShells(parts, joined_edges, _pairs(data.get("contact")))
    common_keys = _common_shell(parts)
    merged_data = {
        key: _with_mesh_names(value, sections) if key in SECTIONS_WITH_NAMES else value
        for key, value in data.items()
    }
    merged_data |= {
        "shells": sections,
        "shell": {"geometry": "mesh", "file": several.file, **common_keys},
        "boundary": {
            f"{part.name}_{name}": condition
            for part in parts
            for name, condition in part.section.boundary.conditions().items()
        },
        "points": _points(several),
    }
    if any(section.remanent for section in sections.values()):
        merged_data["magnetic"] = _with_remanences(merged_data.get("magnetic"), several)
    return merged_data, several


def without_merged_keys(data: Keys, shells: Mapping[str, OneOfShells] | None) -> Keys:
    """Return the plain data of a case, without what its shells make."""
    if shells is None:
        return data
    magnetic = data.get("magnetic")
    if isinstance(magnetic, dict) and any(section.remanent for section in shells.values()):
        kept_keys = {key: value for key, value in magnetic.items() if key != "remanent"}
        data = {**data, "magnetic": kept_keys}
    return {key: value for key, value in data.items() if key not in REPLACED_KEYS}


def _refuse_name(name: str, names: Mapping[str, OneOfShells]) -> None:
    """Refuse a name of a shell that cannot be told from others."""
    if not NAME.fullmatch(name) or name == "shell":
        raise ValueError(
            f"shells: {name!r}: a name is a word of letters, digits and _, and not shell, which is "
            "all"
        )
    if other := next((other for other in names if other.startswith(f"{name}_")), None):
        raise ValueError(
            f"shells: {other}: begins as {name}_ does, by which edges of {name} are named: rename "
            "one"
        )


def _case(name: str, section: OneOfShells, data: Keys, context: Keys, case: "type[Case]") -> "Case":
    """Return the case of one shell alone."""
    shell_data = data["shells"][name]
    if isinstance(shell_data, BaseModel):
        shell_data = shell_data.model_dump(exclude_unset=True)
    own_data: Keys = {
        "shell": shell_data["shell"],
        "boundary": shell_data.get("boundary") or {},
        "points": shell_data.get("points") or {},
    }
    mesh = data.get("mesh") or {}
    sizes = {key: mesh[key] for key in ("degree", "size", "refinement") if key in mesh}
    for key, value in (shell_data.get("mesh") or {}).items():
        sizes[key] = value * sizes.get(key, 1.0) if key == "refinement" else value
    # loads that mesh sizes follow
    points = own_data["points"] if isinstance(own_data["points"], dict) else {}
    loads = [load for load in _forces_on(name, data) if load["at"]["point"] in points]
    if _presses(data.get("loading"), name):
        loads.append({"kind": "pressure"})
    if loads:
        own_data["loading"] = loads
    try:
        shell_case = case.model_validate(
            {**own_data, "mesh": sizes, "symmetry": "none"}, context=context
        )
    except ValidationError as e:
        error = e.errors()[0]
        message, key = error["msg"].removeprefix("Value error, "), ".".join(map(str, error["loc"]))
        raise ValueError(f"shells.{name}.{f'{key}: ' if key else ''}{message}") from None
    has_units = [*numbers_with_units(section.place, shell_data.get("place"), "place")]
    if has_units and not shell_case.shell.with_units:
        raise ValueError(
            f"shells.{name}.place: has a unit, but the shell's lengths have none: give all one, or "
            "none"
        )
    return shell_case


def _forces_on(name: str, data: Keys) -> list[Keys]:
    """Return the indentations of points of a shell as loads of its own case."""
    loading = data.get("loading")
    forces = list[Keys]()
    for load in loading if isinstance(loading, list) else [loading]:
        if not isinstance(load, dict) or load.get("kind") != "indentation":
            continue
        place = load.get("at")
        point = place.get("point") if isinstance(place, dict) else None
        if not isinstance(point, str) or not point.startswith((f"{name}.", f"{name}_")):
            continue
        own_point = point.split(".", 1)[1] if "." in point else point.removeprefix(f"{name}_")
        force: Keys = {"kind": "indentation"}
        if "depth" not in load:
            force |= {"control": "load", "force": 1.0}
        force |= {key: load[key] for key in FORCE_KEYS if key in load}
        forces.append(force | {"at": {"point": own_point}})
    return forces


def _joined_edges(joints: Any) -> list[tuple[str, str]]:
    """Return the edges of joints, as far as these are such."""
    if not isinstance(joints, list):
        return []
    edges = [joint.get("edges") for joint in joints if isinstance(joint, dict)]
    return [(pair[0], pair[1]) for pair in edges if isinstance(pair, list) and len(pair) == 2]


def _presses(loading: Any, name: str) -> bool:
    """Whether a step presses on a shell."""
    steps = loading if isinstance(loading, list) else [loading]
    pressures = [
        load for load in steps if isinstance(load, dict) and load.get("kind") == "pressure"
    ]
    return any(name in (load.get("on") or (name,)) for load in pressures)


def _common_shell(parts: Sequence[MemberCase]) -> Keys:
    """Return the keys of the shell that replaces all of them.

    Lengths and material are those of the first shell, which results are over.
    """
    first, shell = parts[0], parts[0].case.shell
    for part in parts:
        _refuse_unfit_shell(part, first)
    unit = _unit if shell.with_units else (lambda value, unit: value)
    keys: Keys = {
        "radius": unit(shell.reference, "m"),
        "thickness": unit(shell.reference / shell.R_over_h, "m"),
        "poisson_ratio": shell.poisson_ratio,
    }
    if shell.with_units:
        keys["unit"] = "m"
    if shell.modulus is not None:
        keys["youngs_modulus"] = unit(shell.modulus, "Pa")
    if shell.density is not None:
        keys["density"] = unit(shell.density, "kg/m**3")
    keys |= {key: getattr(shell, key) for key in KEYS_OF_FIRST if key in shell.model_fields_set}
    return keys


def _refuse_unfit_shell(part: MemberCase, first: MemberCase) -> None:
    """Refuse a shell that cannot be in one mesh with the first one."""
    shell, other = first.case.shell, part.case.shell
    if other.with_units != shell.with_units:
        names = (first.name, part.name) if shell.with_units else (part.name, first.name)
        raise ValueError(
            part.refused(
                f"shell: lengths of {names[0]} have units and those of {names[1]} none: "
                "give all of them one, or none"
            )
        )
    if isinstance(other.thickness_factor, UserField):
        raise ValueError(part.refused("shell.thickness_factor: of several shells a formula"))
    without_units = isinstance(other, ShellSection) and not other.with_units
    if without_units and other.youngs_modulus is not None:
        raise ValueError(
            part.refused("shell.youngs_modulus: has a unit: give radius and thickness theirs")
        )
    for key in COMMON_KEYS:
        if getattr(other, key) != getattr(shell, key):
            raise ValueError(
                part.refused(
                    f"shell.{key}: is another than that of {first.name}: several shells have it in "
                    "common; their law, youngs_modulus, poisson_ratio and density are their own"
                )
            )
    for key, name in (("modulus", "youngs_modulus"), ("density", "density")):
        value_of_first, value = getattr(shell, key), getattr(other, key)
        if (value_of_first is None) != (value is None):
            without, has = (part, first) if value is None else (first, part)
            raise ValueError(without.refused(f"shell.{name}: is missing; {has.name} has one"))
        if value_of_first is None:
            continue
        ratio = value / value_of_first
        if not 1 / MAX_RATIO <= ratio <= MAX_RATIO:
            raise ValueError(
                part.refused(
                    f"shell.{name}: is {ratio:.3g} times that of {first.name}: "
                    f"allowed 1/{MAX_RATIO:g} to {MAX_RATIO:g}; is the unit right?"
                )
            )


def _unit(value: float, unit: str) -> Any:
    """Return a number with its unit, as a case has it."""
    return f"{value!r} {unit}"


def _points(several: SeveralShells) -> dict[str, list[float]]:
    """Return name -> place in the frame of the case."""
    places = {}
    for part in several.parts:
        place = part.section.place
        for name, own_place in part.section.points.items():
            in_case = place.Q @ np.array(own_place) + np.array(place.position)
            places[f"{part.name}_{name}"] = [float(coordinate) for coordinate in in_case]
    return places


def _with_remanences(magnetic: Any, several: SeveralShells) -> Any:
    """Return the magnetic section with the remanence of each shell as one by patches."""
    if magnetic is not None and not isinstance(magnetic, dict):
        return magnetic
    section = magnetic or {}
    if "remanent" in section:
        raise ValueError(
            "magnetic.remanent: shells have a remanence of their own: give it here, or there"
        )
    sizes = {
        part.name: part.section.remanent.flux_density
        for part in several.parts
        if part.section.remanent
    }
    if len({size is None for size in sizes.values()}) > 1:
        without = next(name for name, size in sizes.items() if size is None)
        raise ValueError(
            f"shells.{without}.remanent.flux_density: is missing; other shells have one"
        )
    size = next(iter(sizes.values()))
    if 0 in sizes.values():
        raise ValueError(
            "shells: a remanence of length zero is no magnetisation: leave remanent out"
        )
    patches: dict[str, Any] = {}
    for part in several.parts:
        patches |= _remanences_of(part, several, size)
    density = {} if size is None else {"flux_density": f"{size!r} T"}
    # whole shells before their parts, which take their place
    shells = {part.name for part in several.parts}
    ordered = dict(sorted(patches.items(), key=lambda item: item[0] not in shells))
    return {**section, "remanent": {"kind": "patches", "patches": ordered, **density}}


def _remanences_of(part: MemberCase, several: SeveralShells, size: float | None) -> dict[str, Any]:
    """Return the remanence of a shell by patch, over the size of that of the first one."""
    remanent = part.section.remanent
    if remanent is None:
        return {}
    if remanent.kind == "patches" and part.case.shell.geometry != "mesh":
        raise ValueError(
            part.refused("remanent.patches: of several shells those of a mesh file alone")
        )
    factor = 1.0
    if size is not None and remanent.flux_density is not None:
        factor = remanent.flux_density / size
    patches: dict[str, Any] = {}
    for name, remanence in (remanent.patches or {"": remanent}).items():
        section = (
            remanence
            if isinstance(remanence, RemanentSection)
            else RemanentSection(**remanence.model_dump())
        )
        patch = part.name if name in ("", "rest") else f"{part.name}_{name}"
        patches[patch] = section.placed(several.place(part), factor)
    return patches


def _pairs(contact: Any) -> list[list[str]]:
    """Return the pairs of names in `contact`.

    What else it has is refused later.
    """
    entries_of_contact = contact if isinstance(contact, list | tuple) else []
    entries = [
        entry.get("between") if isinstance(entry, dict) else entry for entry in entries_of_contact
    ]
    pairs = [pair for pair in entries if isinstance(pair, list | tuple)]
    return [
        [*pair] for pair in pairs if len(pair) == 2 and all(isinstance(name, str) for name in pair)
    ]


def _with_mesh_names(data: Any, shells: Mapping[str, Any]) -> Any:
    """Return data with upper_rim in place of upper.rim."""
    pattern = re.compile(rf"({'|'.join(map(re.escape, shells))})\.(\w+)")

    def name(text: Any) -> Any:
        is_name = isinstance(text, str) and pattern.fullmatch(text)
        return pattern.sub(r"\1_\2", text) if is_name else text

    def walk(part: Any) -> Any:
        if isinstance(part, dict):
            return {
                name(key): value if key in FILE_KEYS else walk(value) for key, value in part.items()
            }
        return [walk(item) for item in part] if isinstance(part, list) else name(part)

    return walk(data)
