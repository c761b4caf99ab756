"""A case, or what it is made from, as programs give it; the same case with other values, and as the
perfect shell.

On several ranks a file is as rank 0 reads it. A run writes down what its case says.
"""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

from pydantic import ValidationError

from magshell_fenicsx.case.case import Case
from magshell_fenicsx.case.shells import Part
from magshell_fenicsx.input.section import FileKeys, number_and_unit, si_size
from magshell_fenicsx.input.source import CaseError, Source, read_source
from magshell_fenicsx.platform.processes import on_first_rank
from magshell_fenicsx.problem.mesh_sizes import MeshSection
from magshell_fenicsx.shape.shell_sections import ShellSection, Surface

if TYPE_CHECKING:
    from mpi4py import MPI

OF_SHELLS = ("shells", "shell", "boundary", "points")  # what the data of several shells make


def opened(
    case: Case | Mapping[str, Any] | str | Path, comm: "MPI.Comm", settings: Sequence[str] = ()
) -> Case:
    """The case itself, or that of a mapping or of a file, with the same files on all ranks;
    collective.

    Raises
    ------
    CaseError
        On every rank, if it is neither, the file is no valid case, or the ranks have different
        cases.
    """
    if isinstance(case, str | Path):
        case = Case.from_source(read_together(case, comm, settings))
    if isinstance(case, Mapping):
        case = Case.from_source(Source("case", dict(case)))
    if not isinstance(case, Case):
        raise CaseError(
            f"give a problem, a Case, its mapping or the path of a case file, not a {type(case).__name__}; "
            "see Case.load"
        )
    return with_same_files(case, comm)


def read_together(file: str | Path, comm: "MPI.Comm", settings: Sequence[str] = ()) -> Source:
    """The case file as rank 0 reads it; collective. See `read_source`."""
    return on_first_rank(comm, lambda: read_source(Path(file), settings))


def with_same_files(case: Case, comm: "MPI.Comm") -> Case:
    """The case, whose files rank 0 reads for all ranks; collective.

    Raises
    ------
    CaseError
        On every rank, if the ranks have different cases.
    """
    readers = case.readers
    if comm.size == 1 or (readers and all(reader.files.shared for reader in readers.values())):
        return case
    own = case.model_dump_json()
    first, contents = on_first_rank(
        comm, lambda: (own, {key: _content(reader) for key, reader in readers.items()})
    )
    if sum(comm.allgather(first != own)):
        raise CaseError(
            "the ranks were given different cases: give the same on each, or the path of a file"
        )
    for key, reader in readers.items():
        reader.files.contents[reader.path] = contents[key]
    for reader in readers.values():
        reader.files.shared = True
    return case


def _content(reader: FileKeys) -> bytes | OSError:
    try:
        return reader.files.content(reader.path)
    except OSError as e:
        return e


def changed(case: Case, values: Mapping[str, Any]) -> Case:
    """The case whose file has other values, by keys such as "mesh.degree"; they are not looked at
    again.

    Raises
    ------
    CaseError
        If one is a number of the shell that is not allowed.
    """
    for key, value in values.items():
        case = _changed(case, key, value)
    return case


def _changed(case: Case, key: str, value: Any) -> Case:
    written = case.origin.data
    if case.several and key.split(".")[0] in ("shells", "mesh"):  # all of them are meshed anew
        return _of_data(case, key, value)
    replaced: Case = _replaced(case, key, value)
    if written is None:
        return replaced
    data = _written(case, written, key, value)  # which the next change builds on
    if key.startswith("shell."):  # no other number is one that others are given over
        other = _validated(data, case, key)
        replaced = replaced.model_copy(update={"shell": other.shell, "loading": other.loading})
    return replaced.written_as(replace(case.origin, data=data))


def _of_data(case: Case, key: str, value: Any) -> Case:
    """A case of several shells with another value, from its data."""
    if case.origin.data is None:
        raise CaseError(
            f"{key}: needs a case that was read from a file or a mapping: see Case.from_source"
        )
    data = _written(case, case.origin.data, key, value)
    tolerance = case.mesh.tolerance
    bare = (
        _written(case, data, "mesh.tolerance", None) if tolerance else data
    )  # what it chooses is no mistake
    made = _validated(bare, case, key).with_terms(case.own_terms)
    kept = {name: getattr(case, name) for name in type(case).model_fields if name not in OF_SHELLS}
    kept["mesh"] = made.mesh.model_copy(update={"tolerance": tolerance})
    if key.startswith("shells."):  # targets are over its numbers
        kept["loading"] = made.loading
    if "magnetic" in kept and any(section.remanent for section in (made.shells or {}).values()):
        kept["magnetic"] = made.magnetic
    again = made.model_copy(update=kept)
    return again.written_as(replace(case.origin, data=data))


def _written(case: Case, data: Mapping[str, Any], key: str, value: Any) -> dict[str, Any]:
    """Plain data of a case with another value, in the unit that the one before had."""
    changed = deepcopy(dict(data))
    *path, last = key.split(".")
    part: Any = changed
    for name in path:
        part = part[int(name)] if isinstance(part, list) else part.setdefault(name, {})
    at: Any = int(last) if isinstance(part, list) else last
    before = part[at] if isinstance(part, list) else part.get(at)
    number, unit = number_and_unit(before) if isinstance(before, str) else ("", "")
    if not unit or value is None:
        part[at] = value
        return changed
    size, held = si_size(unit), _held(case, key)
    if held and float(number):  # over h or a width, an imperfection is no number in SI units
        size = held / float(number)
    elif held is not None:
        part[at] = f"1 {unit}"
        size = _held(_validated(changed, case, key), key) or size
    part[at] = f"{value / size!r} {unit}"
    return changed


def _held(case: Case, key: str) -> float | None:
    """The number of a case at a key, in the size that it has there; None if it has none."""
    part: Any = case
    for name in key.split("."):
        if isinstance(part, list):
            part = part[int(name)]
        else:
            part = part.get(name) if isinstance(part, Mapping) else getattr(part, name, None)
    return part if isinstance(part, float) else None


def _validated(data: Mapping[str, Any], case: Case, key: str) -> Case:
    try:
        return Case.model_validate(data, context=case.origin.context)
    except ValidationError as e:
        raise CaseError(f"{key}: {e.errors()[0]['msg'].removeprefix('Value error, ')}") from None


def _replaced(part: Any, key: str, value: Any) -> Any:
    """A part of a case with another value; it is not validated again."""
    if not key:
        return value
    first, _, rest = key.partition(".")
    if isinstance(part, list):
        return [
            _replaced(item, rest, value) if i == int(first) else item for i, item in enumerate(part)
        ]
    if isinstance(part, dict):
        return {
            name: _replaced(item, rest, value) if name == first else item
            for name, item in part.items()
        }
    within = getattr(part, first)
    if within is None and rest:  # a section that the case leaves out
        within = get_args(type(part).model_fields[first].annotation)[0]()
    return part.model_copy(update={first: _replaced(within, rest, value)})


def perfect_case(case: Case) -> Case:
    """The case without imperfections, as a shell on the smallest model and the default mesh,
    whatever its own.

    Several shells keep their meshes, whose vertices meet at joints. A pressure at its end goes on
    to the first instability.

    Raises
    ------
    CaseError
        If the case has values for the patch of a dimple.
    """
    if case.dimples and case.patches:
        raise CaseError(
            "shell.imperfections: kind: modes: the perfect shell has no dimple, of which a patch is named"
        )
    mesh = case.mesh.model_copy(update={"tolerance": None}) if case.several else MeshSection()
    bare = case.model_copy(
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
        return bare
    return bare.with_shells(
        [
            Part(
                part.name,
                part.section.model_copy(
                    update={"shell": _without_imperfections(part.section.shell)}
                ),
                part.case.model_copy(update={"shell": _without_imperfections(part.case.shell)}),
            )
            for part in case.several.parts
        ]
    )


def _without_imperfections(shell: Surface | ShellSection) -> Surface | ShellSection:
    bare: dict[str, Any] = {"imperfections": []}
    if "defect" in type(shell).model_fields:
        bare["defect"] = None
    return shell.model_copy(update=bare)


def _to_the_limit(case: Case) -> Any:
    """The loading of the perfect shell, to the first instability."""
    loading = case.loading
    if not isinstance(loading, list):
        return loading and loading.on_perfect(last=True)
    loads = [load for each in loading if (load := each.on_perfect(last=False)) is not None]
    return [*loads[:-1], *(load.on_perfect(last=True) for load in loads[-1:])] or None
