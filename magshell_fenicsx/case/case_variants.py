"""A case as programs give it, the same case with other values, and the case of its perfect shell.

On several ranks, all ranks have the files as rank 0 reads them. The plain data of a case are the
mapping that its file contains; its origin keeps them. The data of a changed case are changed too,
so that a run writes down the case that it solves. A key path names a value, such as "mesh.degree".
A case of several shells has a case of its own for each, a `MemberCase`. A reader is a section that
names a file.
"""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from pydantic import ValidationError

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.multi_shell_case import REPLACED_KEYS
from magshell_fenicsx.case.shells import MemberCase
from magshell_fenicsx.input.section import FileKeys, number_and_unit, si_size
from magshell_fenicsx.input.source import CaseError, Source, read_source
from magshell_fenicsx.parts.shell_sections import ShellSection, Surface
from magshell_fenicsx.platform.processes import on_first_rank
from magshell_fenicsx.problem.mesh_sizes import MeshSection

if TYPE_CHECKING:
    from mpi4py import MPI

KEYS_OF_SHELLS = ("shells", *REPLACED_KEYS)  # made of the data of several shells


def open_case(
    case: Case | Mapping[str, Any] | str | Path, comm: "MPI.Comm", settings: Sequence[str] = ()
) -> Case:
    """Return a validated case from a case, a mapping or the path of a file; collective.

    Its files are the same on all ranks.

    Parameters
    ----------
    settings
        `key.path=value` texts that replace values of a file.

    Raises
    ------
    CaseError
        On every rank, if `case` is of another kind, the file is no valid case, or the ranks have
        different cases.
    """
    if isinstance(case, str | Path):
        case = Case.from_source(read_together(case, comm, settings))
    if isinstance(case, Mapping):
        case = Case.from_source(Source("case", dict(case)))
    if not isinstance(case, Case):
        raise CaseError(
            "give a problem, a Case, its mapping or the path of a case file, not a "
            f"{type(case).__name__}; see Case.load"
        )
    return with_same_files(case, comm)


def read_together(file: str | Path, comm: "MPI.Comm", settings: Sequence[str] = ()) -> Source:
    """Return the case file as rank 0 reads it, on every rank; collective.

    `settings` are `key.path=value` texts that replace values of the file.
    """
    return on_first_rank(comm, lambda: read_source(Path(file), settings))


def with_same_files(case: Case, comm: "MPI.Comm") -> Case:
    """Return the case with all its files as rank 0 reads them; collective.

    Raises
    ------
    CaseError
        On every rank, if the ranks have different cases.
    """
    readers = case.readers
    # nothing to do on one rank, or where an earlier call has shared the files
    if comm.size == 1:
        return case
    if readers and all(reader.files.shared for reader in readers.values()):
        return case
    # the case of rank 0 as text, and key -> content of each file as rank 0 reads it
    case_json = case.model_dump_json()
    first_json, contents = on_first_rank(
        comm, lambda: (case_json, {key: _content(reader) for key, reader in readers.items()})
    )
    if sum(comm.allgather(first_json != case_json)):
        raise CaseError(
            "the ranks were given different cases: give the same on each, or the path of a file"
        )
    for key, reader in readers.items():
        reader.files.contents[reader.path] = contents[key]
    for reader in readers.values():
        reader.files.shared = True
    return case


def _content(reader: FileKeys) -> bytes | OSError:
    """Return the content of a section's file, or the error of reading it."""
    try:
        return reader.files.content(reader.path)
    except OSError as e:
        return e


def case_with_values(case: Case, values: Mapping[str, Any]) -> Case:
    """Return a copy of a case with other values of some keys.

    The values are not validated again.

    Parameters
    ----------
    values
        Key path such as "mesh.degree" -> value, as a validated case has it: a length in metres, not
        a text with a unit.

    Raises
    ------
    CaseError
        If a new value of the shell is not allowed.
    """
    for key, value in values.items():
        case = _case_with_value(case, key, value)
    return case


def _case_with_value(case: Case, key: str, value: Any) -> Case:
    """Return a copy of a case with another value at a key path, also in its plain data.

    A key of the shell changes numbers over which loads are given, so the loading is made again.
    """
    case_data = case.origin.data  # None for a case that a program has made
    if case.several and key.split(".")[0] in ("shells", "mesh"):  # all shells are meshed anew
        return _remade_case(case, key, value)
    replaced: Case = _with_value(case, key, value)
    if case_data is None:
        return replaced
    # the plain data are changed too: the next change begins with them
    data = _data_with_value(case, case_data, key, value)
    if key.startswith("shell."):  # loads may be given over numbers of the shell
        remade = _validated(data, case, key)
        replaced = replaced.model_copy(update={"shell": remade.shell, "loading": remade.loading})
    return replaced.written_as(replace(case.origin, data=data))


def _remade_case(case: Case, key: str, value: Any) -> Case:
    """Return a case of several shells with another value, made again from its plain data.

    Sections that the value does not concern are taken from `case`, with what programs have changed
    in them.
    """
    if case.origin.data is None:
        raise CaseError(
            f"{key}: needs a case that was read from a file or a mapping: see Case.from_source"
        )
    data = _data_with_value(case, case.origin.data, key, value)
    # the case may have a tolerance and the mesh that was chosen for it; validation would refuse
    # both together, so that it does not see the tolerance
    tolerance = case.mesh.tolerance
    data_to_validate = _data_with_value(case, data, "mesh.tolerance", None) if tolerance else data
    remade = _validated(data_to_validate, case, key).with_terms(case.own_terms)
    kept_names = [name for name in type(case).model_fields if name not in KEYS_OF_SHELLS]
    kept_sections = {name: getattr(case, name) for name in kept_names}
    kept_sections["mesh"] = remade.mesh.model_copy(update={"tolerance": tolerance})
    if key.startswith("shells."):  # targets of loads may be given over numbers of the shells
        kept_sections["loading"] = remade.loading
    # remanences of shells have been merged into the section `magnetic`
    if any(section.remanent for section in (remade.shells or {}).values()):
        kept_sections["magnetic"] = remade.magnetic
    return remade.model_copy(update=kept_sections).written_as(replace(case.origin, data=data))


def _data_with_value(case: Case, data: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Return plain data with another value at a key path, in the unit of the previous value.

    `value` is a number as the validated case has it, such as 0.002 for a length in metres. If the
    data have "1 mm", the result has "2.0 mm".
    """
    # the section below which the last key stands; in a list the key is a number
    new_data = deepcopy(dict(data))
    *path, last_key = key.split(".")
    section: Any = new_data
    for name in path:
        is_list = isinstance(section, list)
        section = section[int(name)] if is_list else section.setdefault(name, {})
    index: Any = int(last_key) if isinstance(section, list) else last_key
    previous = section[index] if isinstance(section, list) else section.get(index)
    # the previous value, such as "1 mm", as the texts of its number and its unit
    number, unit = number_and_unit(previous) if isinstance(previous, str) else ("", "")
    if not unit or value is None:
        section[index] = value
        return new_data
    # the size of the unit in numbers of the validated case. It is not always the SI size, because
    # validation may divide a number by h or by a width. So it is found from the current value; if
    # that is zero, from a trial with the value 1
    size_of_unit, current = si_size(unit), _number_at(case, key)
    if current and float(number):
        size_of_unit = current / float(number)
    elif current is not None:
        section[index] = f"1 {unit}"
        size_of_unit = _number_at(_validated(new_data, case, key), key) or size_of_unit
    section[index] = f"{value / size_of_unit!r} {unit}"
    return new_data


def _number_at(case: Case, key: str) -> float | None:
    """Return the number of a validated case at a key path; None if there is none."""
    section: Any = case
    for name in key.split("."):
        if isinstance(section, list):
            section = section[int(name)]
        else:
            section = (
                section.get(name) if isinstance(section, Mapping) else getattr(section, name, None)
            )
    return section if isinstance(section, float) else None


def _validated(data: Mapping[str, Any], case: Case, key: str) -> Case:
    """Return the case of plain data, validated in the context of `case`.

    Raises CaseError with `key`, whose value has changed, if the data are not valid.
    """
    try:
        return Case.model_validate(data, context=case.origin.context)
    except ValidationError as e:
        raise CaseError(f"{key}: {e.errors()[0]['msg'].removeprefix('Value error, ')}") from None


def _with_value(part: Any, key: str, value: Any) -> Any:
    """Return a part of a case with another value at a key path below it, without validation.

    An empty key path stands for the part itself.
    """
    if not key:
        return value
    first_key, _, further_keys = key.partition(".")
    if isinstance(part, list):
        return [
            _with_value(item, further_keys, value) if i == int(first_key) else item
            for i, item in enumerate(part)
        ]
    if isinstance(part, dict):
        return {
            name: _with_value(item, further_keys, value) if name == first_key else item
            for name, item in part.items()
        }
    inner_section = getattr(part, first_key)
    if inner_section is None and further_keys:
        # a section that the case leaves out: the first class of "Section | None", with defaults
        inner_section = get_args(type(part).model_fields[first_key].annotation)[0]()
    return part.model_copy(update={first_key: _with_value(inner_section, further_keys, value)})


def perfect_case(case: Case) -> Case:
    """Return the case without imperfections, as a shell on the smallest model and a default mesh.

    Several shells keep their meshes, whose vertices meet at joints. A pressure at its end goes on
    to the first instability.

    Raises
    ------
    CaseError
        If the case has values for the patch of a dimple, which the perfect shell lacks.
    """
    if case.dimples and case.patches:
        raise CaseError(
            "shell.imperfections: kind: modes: the perfect shell has no dimple, of which a patch "
            "is named"
        )
    mesh = case.mesh.model_copy(update={"tolerance": None}) if case.several else MeshSection()
    perfect = case.model_copy(
        update={
            "shell": _without_imperfections(case.shell),
            "mesh": mesh,
            "loading": _to_the_limit(case),
            "model": "shell",
            "solid": None,
            "symmetry": "auto",
            "stability": None,
        }
    )
    if not case.several:
        return perfect
    # of several shells each has a section, and a case of its own: both lose the imperfections
    perfect_shells = []
    for member in case.several.parts:
        section_shell = _without_imperfections(member.section.shell)
        case_shell = _without_imperfections(member.case.shell)
        section = member.section.model_copy(update={"shell": section_shell})
        own_case = member.case.model_copy(update={"shell": case_shell})
        perfect_shells.append(MemberCase(member.name, section, own_case))
    return perfect.with_shells(perfect_shells)


def _without_imperfections(shell: Surface | ShellSection) -> Surface | ShellSection:
    """Return the section of a shell without imperfections and defect."""
    changes: dict[str, Any] = {"imperfections": []}
    if "defect" in type(shell).model_fields:
        changes["defect"] = None
    return shell.model_copy(update=changes)


def _to_the_limit(case: Case) -> Any:
    """Return the loading of the perfect shell, which ends at its first instability.

    It is None if no load of the case remains. `on_perfect` returns a step for the perfect shell. It
    returns None for a step that the perfect shell does not have, such as the growth of an
    imperfection. With `last` the step goes to the first instability.
    """
    loading = case.loading
    if not isinstance(loading, list):
        return loading and loading.on_perfect(last=True)
    steps = [step.on_perfect(last=False) for step in loading]
    loads = [load for load in steps if load is not None]
    # the last one that remains goes to the first instability
    return [*loads[:-1], *(load.on_perfect(last=True) for load in loads[-1:])] or None
