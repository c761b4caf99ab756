"""A case with several shells, rewritten as a case of one mesh file.

Edges, points and patches get the names that they have in the common mesh: `upper.rim` in the case
file becomes `upper_rim`. Plain data are the mapping that a case file contains, before pydantic
validates it; wrong entries are passed on here, and refused by the validation later. A `MemberCase`
is one shell with its section and a case of its own, in which it is planned and meshed alone. A
function `_refuse_...` raises ValueError with the key and what is allowed.
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
from magshell_fenicsx.parts.bodies.body import BodySection
from magshell_fenicsx.parts.kinds import Bodies, LawKeys
from magshell_fenicsx.parts.magnetism.remanent import RemanentSection
from magshell_fenicsx.parts.shell_sections import ShellSection

if TYPE_CHECKING:
    from magshell_fenicsx.case.case import Case

Array = NDArray[np.float64]
Keys = dict[str, Any]
REPLACED_KEYS = ("shell", "boundary", "points")
# sections that name edges, points and patches
SECTIONS_WITH_NAMES = ("loading", "contact", "joints", "natural", "magnetic", "stress")
FILE_KEYS = ("file", "program")  # their values are no such names
COMMON_KEYS = ("viscosity", "relaxation")
KEYS_OF_FIRST = (*LawKeys.model_fields, *COMMON_KEYS)
MAX_RATIO = 1e6  # of a modulus or a density to that of the first shell, or the other way round
FORCE_KEYS = ("at", "patch", "depth")  # keys of a force that mesh sizes follow
NAME = re.compile(r"[A-Za-z]\w*")


class _ShellsAlone(Section):
    """Section `shells` alone, for messages with the keys of the case."""

    shells: Shells


class _BodiesAlone(Section):
    """Section `bodies` alone."""

    bodies: Bodies


def merge_shells(
    data: Any, context: Mapping[str, Any] | None, case: "type[Case]"
) -> "tuple[Any, SeveralShells | None]":
    """Return the data of a case with its shells merged into one mesh file, and the shells.

    Parameters
    ----------
    data
        Plain data of a case; anything without `shells` is returned as it is, with None.
    context
        Folder and files of the case, for pydantic; None without.
    case
        The class `Case`.

    Raises
    ------
    ValueError, ValidationError
        With the key and what is allowed.
    """
    if not isinstance(data, dict) or data.get("shells") is None:
        return data, None
    # the case must not have keys of the merged shell, which are made here
    for key in REPLACED_KEYS:
        if data.get(key) is not None:
            raise ValueError(f"shells: each has its own {key}: leave out {key}, or shells")
    # folder and files of the case; each validation below gets a copy of them, which it may change,
    # without what pydantic has added to the context of the whole case
    context_keys = (
        {key: context[key] for key in ("folder", "files") if key in context} if context else {}
    )
    sections = _ShellsAlone.model_validate(
        {"shells": data["shells"]}, context={**context_keys}
    ).shells
    for name in sections:
        _refuse_name(name, sections)
    # the shells, each with a case of its own
    member_shells = [
        MemberCase(name, section, _case(name, section, data, {**context_keys}, case))
        for name, section in sections.items()
    ]
    joined_edges = _joined_edges(_with_mesh_names(data.get("joints"), sections))
    several = SeveralShells(
        member_shells, joined_edges, _pairs(data.get("contact")), _bodies(data.get("bodies"))
    )
    # the data of the case, with one shell that stands for all of them
    common_keys = _common_shell(member_shells)
    merged_data = {
        key: _with_mesh_names(value, sections) if key in SECTIONS_WITH_NAMES else value
        for key, value in data.items()
    }
    merged_data |= {
        "shells": sections,
        "shell": {"geometry": "mesh", "file": several.file, **common_keys},
        "boundary": {
            f"{member.name}_{name}": condition
            for member in member_shells
            for name, condition in member.section.boundary.conditions().items()
        },
        "points": _points(several),
    }
    if any(section.remanent for section in sections.values()):
        merged_data["magnetic"] = _with_remanences(merged_data.get("magnetic"), several)
    return merged_data, several


def without_merged_keys(data: Keys, shells: Mapping[str, OneOfShells] | None) -> Keys:
    """Return the plain data of a case without the keys that `merge_shells` has made.

    `shells` are the sections of several shells; None for one shell, whose data are returned
    unchanged.
    """
    if shells is None:
        return data
    magnetic = data.get("magnetic")
    if isinstance(magnetic, dict) and any(section.remanent for section in shells.values()):
        kept_keys = {key: value for key, value in magnetic.items() if key != "remanent"}
        data = {**data, "magnetic": kept_keys}
    return {key: value for key, value in data.items() if key not in REPLACED_KEYS}


def _refuse_name(name: str, names: Mapping[str, OneOfShells]) -> None:
    """Raise ValueError for a name of a shell from which names of edges would be ambiguous.

    `names` has the names of all shells as keys.
    """
    if not NAME.fullmatch(name) or name == "shell":
        raise ValueError(
            f"shells: {name!r}: a name is a word of letters, digits and _, and not shell, which is "
            "all"
        )
    if longer := next((longer for longer in names if longer.startswith(f"{name}_")), None):
        raise ValueError(
            f"shells: {longer}: begins as {name}_ does, by which edges of {name} are named: rename "
            "one"
        )


def _case(name: str, section: OneOfShells, data: Keys, context: Keys, case: "type[Case]") -> "Case":
    """Return the case of one shell alone, with the loads that its mesh sizes follow.

    Parameters
    ----------
    name, section
        Name of the shell, and its section.
    data
        Plain data of the whole case.
    context
        Folder and files of the case, for pydantic.
    case
        The class `Case`.

    Raises
    ------
    ValueError
        With the key in the whole case.
    """
    shell_data = data["shells"][name]  # a mapping, or a section from a program
    if isinstance(shell_data, BaseModel):
        shell_data = shell_data.model_dump(exclude_unset=True)
    own_data: Keys = {
        "shell": shell_data["shell"],
        "boundary": shell_data.get("boundary") or {},
        "points": shell_data.get("points") or {},
    }
    mesh_data = _mesh_data(data.get("mesh") or {}, shell_data.get("mesh") or {})
    # loads that mesh sizes follow: forces on points of this shell, and a pressure
    points = own_data["points"] if isinstance(own_data["points"], dict) else {}
    loads = [load for load in _forces_on(name, data) if load["at"]["point"] in points]
    if _presses(data.get("loading"), name):
        loads.append({"kind": "pressure"})
    if loads:
        own_data["loading"] = loads
    try:
        shell_case = case.model_validate(
            {**own_data, "mesh": mesh_data, "symmetry": "none"}, context=context
        )
    except ValidationError as e:
        error = e.errors()[0]  # the first one is told
        message, key = error["msg"].removeprefix("Value error, "), ".".join(map(str, error["loc"]))
        raise ValueError(f"shells.{name}.{f'{key}: ' if key else ''}{message}") from None
    # a position with a unit needs a shell with units
    keys_with_units = [*numbers_with_units(section.place, shell_data.get("place"), "place")]
    if keys_with_units and not shell_case.shell.with_units:
        raise ValueError(
            f"shells.{name}.place: has a unit, but the shell's lengths have none: give all one, or "
            "none"
        )
    return shell_case


def _mesh_data(common: Keys, own: Keys) -> Keys:
    """Return the section `mesh` of one shell's own case.

    `common` is the section of the whole case, `own` that of the shell. The refinements of both are
    multiplied. Other keys of the shell replace the common ones.
    """
    mesh_data = {key: common[key] for key in ("degree", "size", "refinement") if key in common}
    for key, value in own.items():
        mesh_data[key] = value * mesh_data.get(key, 1.0) if key == "refinement" else value
    return mesh_data


def _forces_on(name: str, data: Keys) -> list[Keys]:
    """Return the indentations of points of shell `name` as loads of that shell's own case.

    `data` is the plain data of the whole case.
    """
    loading = data.get("loading")
    forces = list[Keys]()
    for load in loading if isinstance(loading, list) else [loading]:
        if not isinstance(load, dict) or load.get("kind") != "indentation":
            continue
        # the point that the load names, in whatever form the data have
        place = load.get("at")
        point = place.get("point") if isinstance(place, dict) else None
        if not isinstance(point, str) or not point.startswith((f"{name}.", f"{name}_")):
            continue
        # the name without that of the shell: from "upper.tip", or "upper_tip" as in the common mesh
        own_point = point.split(".", 1)[1] if "." in point else point.removeprefix(f"{name}_")
        force: Keys = {"kind": "indentation"}
        if "depth" not in load:  # any force will do: mesh sizes follow its place, not its size
            force |= {"control": "load", "force": 1.0}
        force |= {key: load[key] for key in FORCE_KEYS if key in load}
        forces.append(force | {"at": {"point": own_point}})
    return forces


def _joined_edges(joints: Any) -> list[tuple[str, str]]:
    """Return the pairs of edge names in `joints`; entries that are no pair are refused later."""
    if not isinstance(joints, list):
        return []
    edges = [joint.get("edges") for joint in joints if isinstance(joint, dict)]
    return [(pair[0], pair[1]) for pair in edges if isinstance(pair, list) and len(pair) == 2]


def _presses(loading: Any, name: str) -> bool:
    """Whether a step of `loading` presses on shell `name`; without `on` it presses on all."""
    steps = loading if isinstance(loading, list) else [loading]
    pressures = [
        load for load in steps if isinstance(load, dict) and load.get("kind") == "pressure"
    ]
    return any(name in (load.get("on") or (name,)) for load in pressures)


def _common_shell(parts: Sequence[MemberCase]) -> Keys:
    """Return the keys of the shell section that stands for all shells `parts`.

    Lengths and material are those of the first shell, over which results are.
    """
    first_member, shell = parts[0], parts[0].case.shell
    for member in parts:
        _refuse_unfit_shell(member, first_member)
    # numbers become texts with units if the case has units
    in_unit = _unit if shell.with_units else (lambda value, unit: value)
    keys: Keys = {
        "radius": in_unit(shell.reference, "m"),
        "thickness": in_unit(shell.reference / shell.R_over_h, "m"),
        "poisson_ratio": shell.poisson_ratio,
    }
    if shell.with_units:
        keys["unit"] = "m"
    if shell.modulus is not None:
        keys["youngs_modulus"] = in_unit(shell.modulus, "Pa")
    if shell.density is not None:
        keys["density"] = in_unit(shell.density, "kg/m**3")
    keys |= {key: getattr(shell, key) for key in KEYS_OF_FIRST if key in shell.model_fields_set}
    return keys


def _refuse_unfit_shell(part: MemberCase, first: MemberCase) -> None:
    """Raise ValueError for a shell that cannot be in one mesh with the first one."""
    first_shell, shell = first.case.shell, part.case.shell
    # units, thickness factor and modulus have the right form
    if shell.with_units != first_shell.with_units:
        part_with, part_without = (first, part) if first_shell.with_units else (part, first)
        raise ValueError(
            part.refused(
                f"shell: lengths of {part_with.name} have units and those of {part_without.name} "
                "none: give all of them one, or none"
            )
        )
    if isinstance(shell.thickness_factor, UserField):
        raise ValueError(part.refused("shell.thickness_factor: of several shells a formula"))
    # a strip or a hemisphere has a modulus in units alone, so its lengths need them too
    without_units = isinstance(shell, ShellSection) and not shell.with_units
    if without_units and shell.youngs_modulus is not None:
        raise ValueError(
            part.refused("shell.youngs_modulus: has a unit: give radius and thickness theirs")
        )
    for key in COMMON_KEYS:  # all shells have the same value, or none
        if getattr(shell, key) != getattr(first_shell, key):
            raise ValueError(
                part.refused(
                    f"shell.{key}: is another than that of {first.name}: several shells have it in "
                    "common; their law, youngs_modulus, poisson_ratio and density are their own"
                )
            )
    # results are over the modulus and the density of the first shell: of each either all shells
    # have one or none has, and their ratios are limited
    for key, name in (("modulus", "youngs_modulus"), ("density", "density")):
        value_of_first, value = getattr(first_shell, key), getattr(shell, key)
        if (value_of_first is None) != (value is None):
            part_without, part_with = (part, first) if value is None else (first, part)
            raise ValueError(
                part_without.refused(f"shell.{name}: is missing; {part_with.name} has one")
            )
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
    """Return a number with its unit as text, in the form of a case file."""
    return f"{value!r} {unit}"


def _points(several: SeveralShells) -> dict[str, list[float]]:
    """Return name -> place (3,) of all shells' points, in the frame and the length of the case."""
    places = {}
    for member in several.parts:
        place = member.section.place
        for name, own_place in member.section.points.items():
            in_case = place.Q @ np.array(own_place) + np.array(place.position)
            places[f"{member.name}_{name}"] = [float(coordinate) for coordinate in in_case]
    return places


def _with_remanences(magnetic: Any, several: SeveralShells) -> Any:
    """Return the magnetic section with the remanences of the shells as one remanence by patches.

    All are over the flux density of the first shell that has one. Raises ValueError if some shells
    lack a flux density, or `magnetic` has a remanence of its own.
    """
    if magnetic is not None and not isinstance(magnetic, dict):
        return magnetic
    section = magnetic or {}
    if "remanent" in section:
        raise ValueError(
            "magnetic.remanent: shells have a remanence of their own: give it here, or there"
        )
    # name of a magnetised shell -> its flux density (T), or None
    flux_densities = {
        member.name: member.section.remanent.flux_density
        for member in several.parts
        if member.section.remanent
    }
    # either all of them have a flux density, or none; the first one is the unit of all remanences
    if len({flux_density is None for flux_density in flux_densities.values()}) > 1:
        without = next(
            name for name, flux_density in flux_densities.items() if flux_density is None
        )
        raise ValueError(
            f"shells.{without}.remanent.flux_density: is missing; other shells have one"
        )
    flux_density = next(iter(flux_densities.values()))
    if 0 in flux_densities.values():
        raise ValueError(
            "shells: a remanence of length zero is no magnetisation: leave remanent out"
        )
    patches: dict[str, Any] = {}
    for member in several.parts:
        patches |= _remanences_of(member, several, flux_density)
    density_key = {} if flux_density is None else {"flux_density": f"{flux_density!r} T"}
    shells = {member.name for member in several.parts}
    # whole shells come before their patches, whose remanence replaces theirs
    ordered = dict(sorted(patches.items(), key=lambda item: item[0] not in shells))
    return {**section, "remanent": {"kind": "patches", "patches": ordered, **density_key}}


def _remanences_of(
    part: MemberCase, several: SeveralShells, common_density: float | None
) -> dict[str, Any]:
    """Return patch -> remanence of one shell, over a common flux density.

    Parameters
    ----------
    common_density
        Flux density (T) of the first remanence of all shells; None if they have none.
    """
    remanent = part.section.remanent
    if remanent is None:
        return {}
    if remanent.kind == "patches" and part.case.shell.geometry != "mesh":
        raise ValueError(
            part.refused("remanent.patches: of several shells those of a mesh file alone")
        )
    factor = 1.0
    if common_density is not None and remanent.flux_density is not None:
        # from the shell's own flux density to the common one
        factor = remanent.flux_density / common_density
    patches: dict[str, Any] = {}
    # a remanence without patches is that of the whole shell, here of the name ""
    for name, remanence in (remanent.patches or {"": remanent}).items():
        section = (
            remanence
            if isinstance(remanence, RemanentSection)
            else RemanentSection(**remanence.model_dump())
        )
        # the patch in the common mesh: the whole shell for "" and for the rest of its patches
        patch = part.name if name in ("", "rest") else f"{part.name}_{name}"
        patches[patch] = section.placed(several.place(part), factor)
    return patches


def _pairs(contact: Any) -> list[list[str]]:
    """Return the pairs of names in the section `contact`; other entries are refused later."""
    entries_of_contact = contact if isinstance(contact, list | tuple) else []
    entries = [
        entry.get("between") if isinstance(entry, dict) else entry for entry in entries_of_contact
    ]
    pairs = [[*entry] for entry in entries if isinstance(entry, list | tuple)]
    return [pair for pair in pairs if _is_pair_of_names(pair)]


def _bodies(bodies: Any) -> Mapping[str, BodySection]:
    """Return the section `bodies`; none of wrong entries, which are refused later."""
    try:
        return _BodiesAlone.model_validate({"bodies": bodies or {}}).bodies
    except ValidationError:
        return {}


def _is_pair_of_names(entry: list[Any]) -> bool:
    """Return whether a list has two texts."""
    return len(entry) == 2 and all(isinstance(name, str) for name in entry)


def _with_mesh_names(data: Any, shells: Mapping[str, Any]) -> Any:
    """Return plain data with the names of the common mesh: `upper_rim` in place of `upper.rim`.

    Keys and values are renamed, except the values of keys that name files. `shells` has the names
    of all shells as keys.
    """
    # "upper.rim": the name of a shell, a dot, and a word
    pattern = re.compile(rf"({'|'.join(map(re.escape, shells))})\.(\w+)")

    def renamed(text: Any) -> Any:
        """Return the name of an edge, point or patch in the common mesh; other values unchanged."""
        is_name = isinstance(text, str) and pattern.fullmatch(text)
        return pattern.sub(r"\1_\2", text) if is_name else text

    def renamed_in(part: Any) -> Any:
        """Return a part of the data with all names in it replaced."""
        if isinstance(part, dict):
            return {
                renamed(key): value if key in FILE_KEYS else renamed_in(value)
                for key, value in part.items()
            }
        return [renamed_in(item) for item in part] if isinstance(part, list) else renamed(part)

    return renamed_in(data)
