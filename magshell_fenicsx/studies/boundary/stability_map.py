"""A map of boundaries of stability: the boundary in a key, for each value of a second one.

A boundary of stability is a curve of instabilities in the plane of a key of the case and a load.
Special points are its cusps, turning points, second modes and crossings.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.durable import write_object
from magshell_fenicsx.output.store.folder import access_disk, user_folder
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.simulate.perturbation import KEYS_OUTSIDE_THE_MODEL
from magshell_fenicsx.simulate.record import Stopped
from magshell_fenicsx.simulate.scene_family import ExcludedInstability, NoInstability
from magshell_fenicsx.studies.boundary.picture import draw_map
from magshell_fenicsx.studies.boundary.stability_boundary import (
    COLUMNS,
    StabilityBoundary,
    boundary,
)
from magshell_fenicsx.studies.boundary.varied_case import parse_range
from magshell_fenicsx.studies.points import Axis, MakeCase, parse_axis
from magshell_fenicsx.studies.runner import Say
from magshell_fenicsx.studies.store import Folder, write_table

FOLDER = Folder(
    "a map of boundaries",
    ("map.json", "boundary.csv", "boundary.png"),
    ("case", "keys", "without"),
    "boundaries",
)


def _is_another_number(axis: Axis, first: str) -> bool:
    """Return whether an axis is one number of the shell or its loads, other than the first key."""
    if len(axis.keys) > 1 or axis.numbers is None:
        return False
    return axis.name != first and axis.name.split(".")[0] not in KEYS_OUTSIDE_THE_MODEL


def second_axis(text: str, first: str) -> Axis:
    """Read the second `--over` of a map.

    Parameters
    ----------
    first
        The key of the first `--over`.

    Raises
    ------
    CaseError
        If the text is no list of numbers of one other key, each once.
    """
    axis = parse_axis(text)
    if not _is_another_number(axis, first):
        raise CaseError(
            f"--over {text}: the second key of a map is another number of the shell or its loads, "
            "written as "
            "key.path=first:last:count or key.path=value,value,..."
        )
    # each value once, in whatever unit it is written
    numbers = [axis.number(value) for value in axis.values]
    if repeated := next(
        (value for i, value in enumerate(axis.values) if numbers[i] in numbers[:i]), None
    ):
        raise CaseError(
            f"--over {text}: {repeated} stands twice: each value of the second key has one boundary"
        )
    return axis


def boundary_map(
    file: Path | str,
    overs: Sequence[str],
    settings: Sequence[str] = (),
    out: Path | str = "results/boundary",
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    say: Say = print_line,
    *,
    make_case: MakeCase,
    start: str | None = None,
) -> StabilityBoundary:
    """Follow the instability of a case in one key, for each value of a second one if there is one.

    Collective.

    Parameters
    ----------
    overs
        The first key with its range, as for `boundary`, and the second with its values, as for a
        sweep.
    out
        Folder of boundary.csv (with the columns `second` and `amplitude`, whose load it is),
        map.json, boundary.png and boundaries/, a folder for each value; what these have is kept.
    make_case
        Makes a case of its source.
    start
        Another start than the end of the case, "DIR:POINT" as for `boundary`; only for one key.

    Returns
    -------
    All boundaries one after the other, with the value of the second key in each row.

    Raises
    ------
    CaseError
        If a case or a range is not valid, or there is an instability at no value of the second key.
    """
    if len(overs) == 1:
        return boundary(file, overs[0], settings, out, comm, say, make_case=make_case, start=start)
    axis = _second_axis_of_map(overs, settings, start)
    folder, say_on_first_rank = user_folder(out), say if comm.rank == 0 else (lambda line: None)
    # rows of the table; and by values of the second key why there is no boundary, or the boundary
    rows = list[dict[str, Any]]()
    without, boundaries = dict[str, str](), dict[str, StabilityBoundary]()
    with FOLDER.locked(folder, comm, Path(file).name):
        for number, value in enumerate(axis.values, 1):
            say_on_first_rank(f"{axis.name} = {value}, {number} of {len(axis.values)}")
            line_settings = [*settings, f"{axis.name}={value}"]
            try:
                line_boundary = boundary(
                    file,
                    overs[0],
                    line_settings,
                    folder / "boundaries" / f"{number:03d}",
                    comm,
                    say,
                    make_case=make_case,
                )
            except (ExcludedInstability, NoInstability, Stopped) as e:  # other values go on
                without[value] = str(e)
                say_on_first_rank(f"{axis.name} = {value}: no boundary: {e}")
                continue
            except CaseError as e:  # the user gave --over, not --set
                raise CaseError(
                    str(e).replace(f"--set {line_settings[-1]}", f"--over {line_settings[-1]}")
                ) from None
            boundaries[value] = line_boundary
            rows += [
                {"second": axis.number(value), "amplitude": line_boundary.content["load"], **row}
                for row in line_boundary.rows
            ]
        if not rows:
            raise CaseError(
                f"--over {overs[1]}: the case has an instability at none of these values"
            )
        content = _content(file, settings, boundaries, without, axis)
        stability_map = StabilityBoundary(rows, content)
        access_disk(comm, lambda: _write(stability_map, folder))
    for line in content["said"]:
        say_on_first_rank(line)
    return stability_map


def _second_axis_of_map(overs: Sequence[str], settings: Sequence[str], start: str | None) -> Axis:
    """Check the arguments of a map, and return its second key with its values.

    Raises
    ------
    CaseError
        If there is a start, there are not two keys, one of them is not valid, or a setting has the
        second key.
    """
    if start:
        raise CaseError(
            f"--from {start}: a map starts at the end of each of its cases: give one --over"
        )
    if len(overs) != 2:
        raise CaseError(
            f"--over: {len(overs)} keys; a boundary takes one, and a map of boundaries two"
        )
    axis = second_axis(overs[1], first=parse_range(overs[0]).key)
    for setting in settings:
        if setting.partition("=")[0].strip() == axis.name:
            raise CaseError(f"--set {setting}: this key is swept by --over")
    return axis


def _content(
    file: Path | str,
    settings: Sequence[str],
    boundaries: dict[str, StabilityBoundary],
    without: dict[str, str],
    axis: Axis,
) -> dict[str, Any]:
    """Return the content of map.json.

    Parameters
    ----------
    boundaries
        Value of the second key as text -> its boundary.
    without
        Value of the second key as text -> why it has no boundary.
    axis
        The second key.
    """
    # all boundaries have the first key and its range alike
    first_content = next(iter(boundaries.values())).content
    loads = [line.content["load"] for line in boundaries.values()]
    special = [
        {"second": axis.number(value), **row}
        for value, line in boundaries.items()
        for row in line.special
    ]
    sentences = [
        f"{axis.name} = {value}: {text}"
        for value, line in boundaries.items()
        for text in line.content["said"]
    ]
    return {
        "case": Path(file).name,
        "settings": list(settings),
        "keys": [first_content["key"], axis.name],
        "units": [first_content["unit"], axis.unit],
        "range": [first_content["from"], first_content["to"]],
        "values": [axis.number(value) for value in axis.values],
        "load": max(loads, key=loads.count),  # the most frequent amplitude
        "kinds": {
            value: f"{line.content['kind']} {line.content['mode']}".strip()
            for value, line in boundaries.items()
        },
        "special": special,
        "said": sentences + [f"{axis.name} = {value}: no boundary" for value in without],
        "without": without,
        "stopped": [
            f"{axis.name} = {value}: {why}"
            for value, line in boundaries.items()
            for why in line.stopped
        ],
    }


def _write(stability_map: StabilityBoundary, folder: Path) -> None:
    """Write map.json, boundary.csv and boundary.png; called on rank 0."""
    write_object(folder / "map.json", stability_map.content)
    first_columns = ("second", "amplitude", *COLUMNS)
    write_table(stability_map.rows, folder / "boundary.csv", first=first_columns)
    draw_map(stability_map.rows, stability_map.content, folder / "boundary.png")
