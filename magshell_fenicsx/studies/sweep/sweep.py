"""A case over ranges of its keys; the ranks share the points, and existing points are kept.

An axis is one direction of a sweep: keys of the case that take the same values (tied with `+`). A
point is a case with a value for each axis; its outcome is what its run leaves. If the result is a
knockdown, the pressure of the first fold over the classical one, the fold of one point is followed
to the next along an axis (`chains`). A scalar is a further number of a run. A part is what
one of several jobs computes.
"""

import copy
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI
from pydantic import TypeAdapter, ValidationError

from magshell_fenicsx.input.source import CaseError, Source
from magshell_fenicsx.output.store.durable import Damaged, read_object, write_object
from magshell_fenicsx.output.store.folder import access_disk, user_folder
from magshell_fenicsx.output.store.table import COLUMNS, write_csv
from magshell_fenicsx.platform.processes import on_first_rank
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.quantities.quantity import number_with_error
from magshell_fenicsx.quantities.registry import endings, field_columns
from magshell_fenicsx.simulate.gradients.vibration import refuse_no_vibration
from magshell_fenicsx.studies.outcome import Outcome
from magshell_fenicsx.studies.points import (
    MOST_POINTS,
    Axis,
    MakeCase,
    SweepPoint,
    make_point,
    make_points,
    parse_axes,
    point_columns,
    swept_source,
    value_at,
)
from magshell_fenicsx.studies.results import Scalar, parse_scalar
from magshell_fenicsx.studies.runner import Say, compute, part_of
from magshell_fenicsx.studies.store import Folder, OutcomeStore, write_table
from magshell_fenicsx.studies.sweep.chains import Chain, SweepCache, make_chains, run_chain
from magshell_fenicsx.studies.sweep.picture import draw_sweep

NAME, TABLE, CURVES, PICTURE = "sweep.json", "sweep.csv", "curves.csv", "sweep.png"
FOLDER = Folder(
    "a sweep", (NAME, TABLE, CURVES, PICTURE), ("keys", "base", "points"), first_table=TABLE
)
# columns of sweep.csv that are of the limit point; its first ones, after the keys; of curves.csv
OF_LIMIT = ("p_over_pc", "w_pole_over_h", "kind", "mode", "amplitude", "value")
FIRST_COLUMNS = (
    *("k_d", *OF_LIMIT, "stopped", "found", "factorisations", "dofs", "wall_s"),
    *("point", "barrier"),
)
CURVE = (
    *(
        "label",
        "amplitude",
        "p_over_pc",
        *field_columns(),
        "field_angle",
        "force",
        "load_factor",
        "w_over_h",
    ),
    *("w_pole_over_h", "volume_change", "mode", "branch"),
)


@dataclass(frozen=True)
class Sweep:
    """A finished sweep.

    Attributes
    ----------
    points, outcomes
        The points in product order, the last axis fastest, and the outcome of each.
    results
        The requested number at each point, None where a run lacks it; empty if none was requested.
    """

    axes: list[Axis]
    points: list[SweepPoint]
    outcomes: list[Outcome]
    results: list[float | None]

    @property
    def stopped(self) -> int:
        """Number of points that ended before their target."""
        return sum(outcome.stopped is not None for outcome in self.outcomes)


def sweep(  # noqa: PLR0913 - what a user gives
    file: Path | str,
    over: Sequence[str],
    settings: Sequence[str] = (),
    out: Path | str = "results/sweep",
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    say: Say = print_line,
    *,
    make_case: MakeCase,
    result: str | None = None,
    full_paths: bool = False,
    part: str | None = None,
    executor: Executor | None = None,
) -> Sweep:
    """Run a case at all points of a product of axes; collective, and every rank works.

    If the result is a knockdown (`loading: {kind: pressure, until: limit}`), one path is computed
    up to its fold. The fold is then followed along the last axis with numbers (`Continuation`).

    Parameters
    ----------
    over
        One axis each: `key.path=start:stop:count` or `key.path=value,value`; keys tied with `+`.
    out
        Folder of sweep.csv, sweep.png and points/; existing points are kept if these sources
        computed them. Tables and picture have the points of earlier sweeps over the same keys too.
    say
        Called with one line per finished point, on the rank that finished it.
    make_case
        Makes a case of its source.
    result
        A further number of each point: knockdown, COLUMN@COLUMN=VALUE, ...; see `parse_scalar`.
    full_paths
        Compute the full path at every point.
    part
        "i/n": compute only the i-th of n equal shares of the points; several jobs may share one
        folder. None: compute all.
    executor
        Processes of another kind than ranks, which see the same files; see `concurrent.futures`.

    Returns
    -------
    The requested points of this part that have outcomes, on every rank.

    Raises
    ------
    CaseError
        Before the first point, if a point is not a valid case, or `out` cannot be written or has
        another sweep.
    DiskError
        If the tables cannot be written.
    """
    axes = parse_axes(over)
    scalar = parse_scalar(result, with_frequencies=True) if result else None
    # other numbers than a knockdown need the path
    is_another_number = scalar is not None and scalar.name != "knockdown"
    full_paths = full_paths or is_another_number
    source = on_first_rank(comm, lambda: swept_source(Path(file), axes, settings))
    requested = on_first_rank(comm, lambda: make_points(source, axes, make_case))
    frequency = scalar.column if scalar and scalar.is_frequency else ""
    if frequency:
        refuse_no_vibration(requested[0].case.problem(), frequency)
    share = share_of(part, len(requested))
    folder = FOLDER.prepare(user_folder(out), comm)
    # points of earlier sweeps in the folder come first, then the requested ones
    points = access_disk(comm, lambda: with_earlier(folder, source, axes, requested, make_case))
    earlier_count = len(points) - len(requested)
    own_points = points[earlier_count:][share.start : share.stop]
    store = OutcomeStore(folder / "points", Outcome)
    missing = store.missing(points, comm, lambda outcome: not scalar or outcome.serves(scalar))
    if part:
        own_ids = {id(point) for point in own_points}
        missing = [point for point in missing if id(point) in own_ids]
    if comm.rank == 0:
        say(_line_at_begin(len(requested), earlier_count, len(missing), comm.size))
        # a missing point has no usable outcome, but may have a file
        if known_count := sum(store.file(point.key).exists() for point in missing):
            say(
                f"{known_count} of these computed again: their files are of other sources of "
                "magshell_fenicsx, or damaged"
            )
    run = _ChainRunner(
        store,
        scalar,
        {point.key: number for number, point in enumerate(missing, 1)},
        SweepCache(COLUMNS if scalar else CURVE, frequency),
    )
    chains = make_chains(axes, points, missing, full_paths=full_paths)
    compute(chains, run, comm, say, executor)
    outcomes_of_points = [
        (point, outcome) for point in points if (outcome := store.outcome(point.key))
    ]
    assert part or len(outcomes_of_points) == len(points)  # other parts may not be finished
    if comm.rank == 0 and len(outcomes_of_points) < len(points):
        say(
            f"{len(points) - len(outcomes_of_points)} of {len(points)} points are left to other "
            "parts"
        )
    if outcomes_of_points:
        access_disk(comm, lambda: _write(axes, outcomes_of_points, scalar, folder))
    return _sweep_of(axes, own_points, outcomes_of_points, scalar)


@dataclass(frozen=True)
class _ChainRunner:
    """Computes chains of points, and keeps their outcomes.

    Attributes
    ----------
    store
        Keeps outcomes.
    scalar
        The requested number; None without.
    numbers
        Key of a point -> its number, from 1.
    cache
        Scenes and folds of this process.
    """

    store: OutcomeStore[Outcome]
    scalar: Scalar | None
    numbers: Mapping[str, int]
    cache: SweepCache

    def __call__(self, chain: Chain) -> Iterator[str]:
        """Compute a chain on this rank, keep each outcome, and yield a line of text for each."""
        for point, outcome in run_chain(chain, self.cache):
            self.store.keep(point.key, outcome, point.case)
            place = f"{self.numbers[point.key]:4d}/{len(self.numbers)}"
            yield f"{place}  {point.label}: {_words(outcome, self.scalar)}, {outcome.wall_s:.1f} s"


def _line_at_begin(
    requested_count: int, earlier_count: int, missing_count: int, rank_count: int
) -> str:
    """Return the line that says how many points there are, and how many are computed.

    Parameters
    ----------
    requested_count, earlier_count, missing_count
        Numbers of requested points, of further points of earlier sweeps, and of points without an
        outcome.
    """
    earlier_text = f" and {earlier_count} there" if earlier_count else ""
    return (
        f"{requested_count} points{earlier_text}, {missing_count} to compute on {rank_count} "
        f"rank{'s' * (rank_count > 1)}"
    )


def _sweep_of(
    axes: list[Axis],
    own_points: Sequence[SweepPoint],
    outcomes_of_points: Sequence[tuple[SweepPoint, Outcome]],
    scalar: Scalar | None,
) -> Sweep:
    """Return the finished sweep of some points, without those of earlier sweeps.

    Parameters
    ----------
    own_points
        The requested points of this part, which are among those of `outcomes_of_points`.
    outcomes_of_points
        All points that have an outcome, with it.
    scalar
        The requested number; None without.
    """
    own_ids = {id(point) for point in own_points}
    own_outcomes = [
        (point, outcome) for point, outcome in outcomes_of_points if id(point) in own_ids
    ]
    return Sweep(
        axes=axes,
        points=[point for point, _ in own_outcomes],
        outcomes=[outcome for _, outcome in own_outcomes],
        results=[outcome.value(scalar) for _, outcome in own_outcomes] if scalar else [],
    )


def share_of(part: str | None, count: int) -> range:
    """Return the numbers of the points of a part "i/n"; all for None.

    They are neighbours, so that folds can be followed from one to the next.

    Examples
    --------
    >>> share_of("1/2", 5), share_of("2/2", 5)
    (range(0, 2), range(2, 5))
    """
    i, n = part_of(part, count, "points")
    return range((i - 1) * count // n, i * count // n)


def _words(outcome: Outcome, scalar: Scalar | None) -> str:
    """Return the result of a point in words: the requested number, or by default its main result.

    The main result is the knockdown, the barrier or the limit point, the first that there is.
    """
    result_text = "no limit point"
    if scalar and scalar.name != "knockdown":
        value, error = outcome.value(scalar), outcome.error(scalar)
        result_text = f"no {scalar.name}"
        if value is not None:
            result_text = f"{scalar.name} = {number_with_error(value, error)}"
    elif outcome.knockdown is not None:
        pascals = outcome.in_units.get("buckling_pressure_Pa")
        in_pascals = f", {pascals:.6g} Pa" if pascals else ""
        k_d = number_with_error(outcome.knockdown, outcome.errors.get("knockdown"), 6)
        result_text = f"k_d = {k_d}{in_pascals} ({outcome.found})"
    elif outcome.barrier is not None:
        result_text = f"barrier = {outcome.barrier:.6g} E h R^2"
    elif outcome.limit:
        limit = outcome.limit
        result_text = f"{limit['kind']} at {limit['amplitude']} = {limit['value']:.6g}"
    return f"{result_text}, stopped early: {outcome.stopped}" if outcome.stopped else result_text


def _values_on(axes: Sequence[Axis], point: SweepPoint) -> list[str]:
    """Return the value of a point on each axis; tied keys have the same."""
    return [point.values[axis.keys[0]] for axis in axes]


def with_earlier(
    folder: Path,
    source: Source,
    axes: Sequence[Axis],
    points: Sequence[SweepPoint],
    make_case: MakeCase,
) -> list[SweepPoint]:
    """Return the points of the folder's earlier sweep and the new points; sweep.json gets all.

    Called on rank 0.

    Parameters
    ----------
    points
        The new points, which follow the earlier ones. An equal earlier point is dropped.

    Raises
    ------
    CaseError
        If the folder has a sweep over other keys, or of another case.
    """
    # for each earlier and each new point, its values on the axes as texts; tied keys have the same
    # value, so that the first one stands for the axis
    keys = [list(axis.keys) for axis in axes]
    base = _base(source, axes)  # a hash of the case without the swept keys
    earlier = _earlier(folder, keys, base)
    new_values = [_values_on(axes, point) for point in points]
    # axes with the values of all points: their units make equal numbers of different units equal
    all_axes = list[Axis]()
    for i, axis in enumerate(axes):
        values_on_axis = tuple(values[i] for values in (*new_values, *earlier))
        all_axes.append(Axis(axis.keys, values_on_axis))
    # a place is a text for each axis, the same for equal numbers
    new_places = {_place(values, all_axes) for values in new_values}
    earlier_only = [values for values in earlier if _place(values, all_axes) not in new_places]
    if (count := len(earlier_only) + len(new_values)) > MOST_POINTS:
        raise CaseError(
            f"--out {folder}: {count} points with those there; allowed at most {MOST_POINTS}"
        )
    write_object(folder / NAME, asdict(SweepContent(keys, base, [*earlier_only, *new_values])))
    return [*(make_point(source, axes, values, make_case) for values in earlier_only), *points]


def _place(values: Sequence[str], axes: Sequence[Axis]) -> tuple[str, ...]:
    """Return the values of a point as text, the same for equal numbers whatever their unit."""
    pairs = zip(values, axes, strict=True)
    return tuple(f"{axis.number(value):.10g}" if axis.numbers else value for value, axis in pairs)


@dataclass(frozen=True)
class SweepContent:
    """Content of sweep.json.

    Attributes
    ----------
    keys
        The swept keys of each axis.
    base
        Hash of the case without the swept keys.
    points
        For each point its value on each axis, as text.
    """

    keys: list[list[str]]
    base: str
    points: list[list[str]]


def _earlier(folder: Path, keys: list[list[str]], base: str) -> list[list[str]]:
    """Return the values of the points of the folder's sweep, for each the texts along the axes.

    Empty without a sweep.

    Parameters
    ----------
    keys, base
        Swept keys of each axis, and hash of the case, which the folder's sweep must share.

    Raises
    ------
    CaseError
        If the folder has a sweep over other keys, of another case or of an earlier version.
    Damaged
        If sweep.json has no sweep.
    """
    file = folder / NAME
    if not file.exists():
        # an empty table was only created to try the folder
        if (folder / TABLE).exists() and (folder / TABLE).stat().st_size:
            raise CaseError(
                f"--out {folder}: has a sweep.csv of an earlier version; give another folder"
            )
        return []
    try:
        stored_sweep = TypeAdapter(SweepContent).validate_python(read_object(file))
    except ValidationError:
        stored_sweep = None
    if stored_sweep is None or any(
        len(values) != len(stored_sweep.keys) for values in stored_sweep.points
    ):
        raise Damaged(f"{file}: is damaged: no keys, base and points of a sweep")
    # it must be over the same keys, and of the same case
    if stored_sweep.keys != keys:
        keys_text = " and ".join("+".join(axis_keys) for axis_keys in stored_sweep.keys)
        raise CaseError(
            f"--out {folder}: has a sweep over {keys_text}, which is kept; give another folder for "
            "other keys"
        )
    if stored_sweep.base != base:
        raise CaseError(
            f"--out {folder}: has a sweep of another case or other --set, which is kept; give "
            "another folder"
        )
    return stored_sweep.points


def _is_index(word: str, count: int) -> bool:
    """Return whether a word of a key is the number of one of `count` items, from 0."""
    return word.isdecimal() and int(word) < count


def _base(source: Source, axes: Sequence[Axis]) -> str:
    """Return a hash of the case as written, without the swept keys."""
    data = copy.deepcopy(source.data)
    for key in (key for axis in axes for key in axis.keys):
        *sections, last_word = key.split(".")
        section = value_at(data, sections)
        if isinstance(section, dict):
            section.pop(last_word, None)
        elif isinstance(section, list) and _is_index(last_word, len(section)):
            section[int(last_word)] = None  # keeps the numbers of the other items
    return hashlib.sha256(json.dumps(data, sort_keys=True, default=str).encode()).hexdigest()[:16]


def _write(
    axes: Sequence[Axis],
    outcomes_of_points: Sequence[tuple[SweepPoint, Outcome]],
    scalar: Scalar | None,
    folder: Path,
) -> None:
    """Write sweep.csv, curves.csv and the picture.

    Parameters
    ----------
    outcomes_of_points
        Each point with its outcome.
    scalar
        The requested number; None without.
    """
    points = [point for point, _ in outcomes_of_points]
    outcomes = [outcome for _, outcome in outcomes_of_points]
    results = [outcome.value(scalar) for outcome in outcomes] if scalar else None
    _write_points(axes, outcomes_of_points, scalar, results, folder / TABLE)
    _write_curves(outcomes_of_points, folder / CURVES)
    draw_sweep(
        axes,
        points,
        outcomes,
        folder / PICTURE,
        requested=(scalar.name, results) if scalar and results else None,
    )


def _write_points(
    axes: Sequence[Axis],
    outcomes_of_points: Sequence[tuple[SweepPoint, Outcome]],
    scalar: Scalar | None,
    results: Sequence[float | None] | None,
    file: Path,
) -> None:
    """Write sweep.csv, a row for each point.

    Values with units are columns of numbers too, and so are the results of a case with units.

    Parameters
    ----------
    outcomes_of_points
        Each point with its outcome.
    scalar, results
        The requested number, and its value at each point; None if none was requested.
    """
    rows = [
        {**point_columns(axes, point), **sweep_row(outcome), **_in_units(outcome)}
        for point, outcome in outcomes_of_points
    ]
    # with the requested number, if there is one, also under its name, which tells its unit
    if results and scalar:
        rows = [
            row
            | {"result": value, "result_error": (error := outcome.error(scalar))}
            | {scalar.name: value, f"{scalar.name}_error": error}
            for row, value, (_, outcome) in zip(rows, results, outcomes_of_points, strict=True)
        ]
    first_point, _ = outcomes_of_points[0]
    write_table(rows, file, first=(*first_point.values, *FIRST_COLUMNS))


def _write_curves(outcomes_of_points: Sequence[tuple[SweepPoint, Outcome]], file: Path) -> None:
    """Write curves.csv, a line for each point of each path, with the swept values."""
    lines = [
        {**point.values, **row} for point, outcome in outcomes_of_points for row in outcome.curve
    ]
    first_point, _ = outcomes_of_points[0]
    keys_of_lines = dict.fromkeys(key for line in lines for key in line)
    columns_of_curves = [key for key in CURVE if key in keys_of_lines]
    # swept keys, and columns that scenes add
    further_columns = [key for key in keys_of_lines if key not in COLUMNS]
    all_columns = dict.fromkeys((*first_point.values, *columns_of_curves, *further_columns))
    write_csv(lines, tuple(all_columns), file)


def _in_units(outcome: Outcome) -> dict[str, Any]:
    """Return the columns with units of the limit point, and the numbers of the case with units."""
    # endings of names that have a unit, such as "_mm"
    unit_endings, limit = tuple(f"_{ending}" for ending in endings()), outcome.limit or {}
    return {key: v for key, v in limit.items() if key.endswith(unit_endings)} | outcome.in_units


def sweep_row(outcome: Outcome) -> Mapping[str, Any]:
    """Return the row of sweep.csv for an outcome, without swept keys; missing values are None."""
    limit = outcome.limit or {}
    names = ("stopped", "found", "factorisations", "dofs", "wall_s", "barrier")
    return {
        "k_d": outcome.knockdown,
        **{key: limit.get(key) for key in OF_LIMIT},
        **{name: getattr(outcome, name) for name in names},
        **{
            column: outcome.errors.get(name)
            for name, column in (("knockdown", "k_d_error"), ("barrier", "barrier_error"))
        },
        "errors_not_estimated": outcome.why_not_estimated,
    }
