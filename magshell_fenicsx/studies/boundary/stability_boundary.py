"""The boundary of stability of a case: its instability, followed in a second key.

Results are a table and a picture, with cusps and other special points.

A boundary of stability is a curve of instabilities (folds or bifurcations) in the plane of a number
of the case, its key, and a load. An amplitude is a load parameter, by name; mu has those of a
state. A mode is the null vector of an instability, by name: "" for one of the model itself, "m = 3"
for waves around a meridian (family m; 0 for the model's own modes), "antisymmetric" for one that a
half shell excludes. A crossing is a point where another family becomes critical first. A scene is
the model of a case with its solver; a `SceneFamily` has the scenes for all values of the key. The
journal of a part ("start", "whole", "up", "down") keeps its solves, so that an interrupted boundary
goes on.

`begin` is plain data of the instability at the start: label ("fold", "bifurcation" or "" for none),
mode, amplitude, step, its value, and the state (u as text, mu).
"""

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.continuation.augmented import BoundaryPoint, NoSystem
from magshell_fenicsx.continuation.boundary import Boundary, BoundaryLost, Label
from magshell_fenicsx.continuation.critical import critical_boundary, first_mode
from magshell_fenicsx.continuation.point import Point
from magshell_fenicsx.continuation.system import State
from magshell_fenicsx.input.source import CaseError, override, read_source
from magshell_fenicsx.output.store.durable import write_object
from magshell_fenicsx.output.store.folder import access_disk, user_folder
from magshell_fenicsx.platform.processes import on_first_rank
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.problem.columns import sizes_in_units
from magshell_fenicsx.problem.problem import Problem
from magshell_fenicsx.quantities.mode_labels import ANTISYMMETRIC, wave_label
from magshell_fenicsx.quantities.registry import amplitude
from magshell_fenicsx.simulate.follow import follow_alone
from magshell_fenicsx.simulate.record import Record, Stopped
from magshell_fenicsx.simulate.scene import Scene
from magshell_fenicsx.simulate.scene_family import SceneFamily, first_instability
from magshell_fenicsx.studies.boundary.journal import Journal, text_of, vector_of
from magshell_fenicsx.studies.boundary.picture import draw_boundary
from magshell_fenicsx.studies.boundary.start import Start, start_from
from magshell_fenicsx.studies.boundary.varied_case import VariedCase, VariedKey, parse_range
from magshell_fenicsx.studies.naming import load_text
from magshell_fenicsx.studies.points import MakeCase
from magshell_fenicsx.studies.runner import Say, compute, remaining_time_text, reporting_progress
from magshell_fenicsx.studies.store import Folder, write_table

FOLDER = Folder(
    "a boundary",
    ("boundary.json", "boundary.csv", "boundary.png"),
    ("case", "key", "load", "special"),
)
COLUMNS = ("key", "load", "kind", "mode", "error", "unstable", "factorisations")
END_TOLERANCE = 1e-6  # of the range: so close to its end a boundary is there
SPECIAL = ("cusp", "turn", "meeting", "crossing")
WORDS_OF_KINDS = {
    "cusp": "a cusp, where two folds are born",
    "turn": "the boundary turns: two instabilities meet there",
    "meeting": "a second mode is neutral",
    "crossing": "two bifurcations cross",
}
CHANGED = "a fold and a bifurcation change their order"


@dataclass(frozen=True)
class StabilityBoundary:
    """A finished boundary of stability: a curve of instabilities in the plane of a key and a load.

    Attributes
    ----------
    rows
        Rows of boundary.csv, from one end of the boundary to the other.
    content
        The content of boundary.json.
    """

    rows: list[dict[str, Any]]
    content: dict[str, Any]

    @property
    def special(self) -> list[dict[str, Any]]:
        """The cusps, turning points and meetings among the rows."""
        return [row for row in self.rows if row["kind"] in SPECIAL]

    @property
    def stopped(self) -> list[str]:
        """Why the boundary ends before the range does."""
        return list(self.content["stopped"])


def boundary(
    file: Path | str,
    over: str,
    settings: Sequence[str] = (),
    out: Path | str = "results/boundary",
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    say: Say = print_line,
    *,
    make_case: MakeCase,
    start: str | None = None,
) -> StabilityBoundary:
    """Follow the instability at the end of a case in a second key; collective, two ranks work.

    The case is run once. From its instability both directions are followed, through turning points,
    until the key leaves its range. Points that the folder has of an interrupted boundary are kept.
    The method is that of `continuation.boundary`.

    Parameters
    ----------
    over
        `key.path=first:last`, or with the least number of steps from the one to the other:
        `first:last:steps`.
    out
        Folder of boundary.csv, boundary.json, boundary.png and points/.
    make_case
        Makes a case of its source.
    start
        Another instability: "DIR:POINT", a located point of the run in a folder, whose case takes
        the place of `file`. None: the first instability of the last step.

    Raises
    ------
    CaseError
        If the case or an end of the range is invalid, the case ends without an instability, or the
        key has no influence on it or changes what a boundary cannot follow.
    Stopped
        If the path to the instability is lost.
    DiskError
        If the disk is full; solved points are kept.
    """
    span = parse_range(over)
    source = on_first_rank(comm, lambda: read_source(Path(file), settings))
    begun_at, source = on_first_rank(comm, lambda: start_from(start, source, make_case))
    # the case of another run takes the place of the file, and so of its settings
    for setting in settings if start else ():
        override(source, setting)
    varied_case, folder, name = (
        VariedCase(source, span, make_case),
        user_folder(out),
        Path(file).name,
    )
    say_on_first_rank: Say = say if comm.rank == 0 else lambda line: None
    with (
        FOLDER.locked(folder, comm, name),
        reporting_progress(comm, say_on_first_rank) as say_on_first_rank,
    ):
        say = say_on_first_rank if comm.rank == 0 else say
        journal = partial(Journal, folder / "points", varied_case.identity(begun_at.text))
        value = varied_case.start_value(may_be_outside=not start)
        begin = _begin(varied_case, value, begun_at, journal, comm, say_on_first_rank)
        say_on_first_rank(
            f"{span.key} = {span.text(value)}: {begin['label']} at "
            f"{load_text(begin['row'], begin['amplitude'])}"
        )
        directions = [
            sense for sense, end in ((-1, span.ends[0]), (1, span.ends[1])) if end != value
        ]

        def followed(sense: int) -> Iterator[str]:
            """Follow one direction, down (-1) or up (1) in the key, unless its journal is finished.

            Yields a line of text.
            """
            part_journal = journal("down" if sense < 0 else "up")
            if not part_journal.outcome:
                part_journal.finish(_followed(varied_case, value, sense, begin, part_journal, say))
            rows = part_journal.outcome["rows"]
            yield f"{len(rows) - 1} points from {span.text(value)} to {span.text(rows[-1]['key'])}"

        compute(directions, followed, comm, say)
        outcomes = access_disk(
            comm,
            lambda: {sense: journal("down" if sense < 0 else "up").outcome for sense in directions},
        )
        stability_boundary = _put_together(outcomes, begin, span, name, settings, begun_at.text)
        access_disk(comm, lambda: _write(stability_boundary, folder))
    for line in stability_boundary.content["said"]:
        say_on_first_rank(line)
    return stability_boundary


def _begin(
    varied_case: VariedCase,
    value: float,
    start: Start,
    journal: Callable[[str], Journal],
    comm: MPI.Intracomm,
    say: Say,
) -> dict[str, Any]:
    """Return the instability at which the boundary starts, as plain data; collective.

    A half cannot follow a mode that it excludes. The whole shell, of which such a mode is its own,
    then takes its place in `varied_case`.

    Parameters
    ----------
    value
        Value of the key at which the case is run, in the unit of the range.
    start
        Says which instability of the history is taken.
    journal
        Called with the name of a part; it returns the journal of this part.
    say
        Called with remarks of the run, on rank 0.

    Returns
    -------
    `begin` as the module describes it, with two more keys: `name_of_mode`, as reported, and
    `is_first`, whether it is meant to be the first instability of the case.

    Raises
    ------
    CaseError, Stopped
        As `_run_to_instability`; and if there is no instability.
    """

    def instability(part: str, start: Start) -> dict[str, Any]:
        """Return the instability in a history, of which the part keeps the journal."""
        return access_disk(
            comm, lambda: _run_to_instability(varied_case, value, journal(part), say, start)
        )

    begin = instability("start", start)
    name_of_mode = begin["mode"]
    if name_of_mode == ANTISYMMETRIC:
        say("the instability is antisymmetric: the whole shell is modelled")
        override(varied_case.source, "symmetry=none")
        # the points of the whole shell's history have other numbers
        begin = instability("whole", start.anywhere())
    if not begin["label"]:
        first_instability([])  # raises the error that there is none
    # the name is that of the first run, unless the whole shell has found a fold
    name_of_mode = name_of_mode if begin["label"] == "bifurcation" else begin["mode"]
    return {**begin, "name_of_mode": name_of_mode, "is_first": not start.text}


def _run_to_instability(
    varied_case: VariedCase,
    value: float,
    journal: Journal,
    say: Say,
    start: Start,
) -> dict[str, Any]:
    """Run the case to the instability at which the boundary starts, or take it from the journal.

    Parameters
    ----------
    value
        Value of the key at which the case is run, in the unit of the range.
    journal
        Keeps the outcome of the run.
    say
        Called with remarks of the run.
    start
        Says which instability of the history is taken.

    Returns
    -------
    `begin` as the module describes it, with the load in units and the work; the label is "" if
    there is no instability.

    Raises
    ------
    CaseError
        If the problem at an end of the range is not valid, or `start` is not found.
    Stopped
        If the path is lost before the instability.
    """
    for end in varied_case.span.ends:  # raises errors before anything is computed
        varied_case.problem(end)
    if journal.outcome:
        return journal.outcome
    scene = Scene(varied_case.problem(value), MPI.COMM_SELF)
    records, lost_reason = _records_to_start(scene, start, say)
    try:
        instability = start.instability_in(records)
    except CaseError:  # there is none in these records
        if lost_reason:
            raise lost_reason from None
        if start.text:
            raise
        return {"label": "", "mode": ""}
    state = instability.point.state
    outcome = {
        "label": instability.label,
        "mode": instability.mode,
        "amplitude": instability.amplitude,
        "step": instability.step,
        "value": state.mu[instability.amplitude],
        "row": _load(instability.amplitude, state.mu[instability.amplitude], scene.problem),
        "u": text_of(state.u),
        "mu": state.mu,
        "factorisations": scene.newton.factorisation.count,
    }
    journal.finish(outcome)
    return outcome


def _records_to_start(scene: Scene, start: Start, say: Say) -> tuple[list[Record], Stopped | None]:
    """Follow the history of a scene up to the instability at which the boundary starts.

    A path that is lost keeps its records, as it may be lost beyond the instability.

    Returns
    -------
    records
        The points of the history.
    lost_reason
        The exception that says why the path was lost; None if it was not.
    """
    records = list[Record]()
    try:
        for record in follow_alone(scene, remark=say):
            records.append(record)
            if start.complete(records):  # no further points are needed
                break
    except Stopped as e:
        return records, e
    return records, None


def _followed(
    varied_case: VariedCase,
    value: float,
    sense: int,
    begin: dict[str, Any],
    part_journal: Journal,
    say: Say,
) -> dict[str, Any]:
    """Follow the boundary in one direction from its start.

    Parameters
    ----------
    value
        Value of the key at the start, in the unit of the range.
    sense
        Direction of the key: -1 falling, 1 growing.
    begin
        The instability at the start, as `_begin` returns it.
    part_journal
        Journal that replays the solves of an interrupted boundary.

    Returns
    -------
    `rows`: points from the start as in boundary.csv; `stopped`: reason for an early end, else "";
    `alone`: whether one scene serves all values, as only amplitudes depend on the key.

    Raises
    ------
    CaseError
        If the key has no influence, or the instability cannot be followed.
    Stopped
        If not even the start is found.
    """
    span, family = varied_case.span, _scene_family(varied_case, value, begin)
    # changes of load and key that count as of order one in the arc length of the boundary
    scales = (abs(begin["value"]) or 1.0, span.ends[1] - span.ends[0])
    rows: list[dict[str, Any]] = []
    start_time, end = time.perf_counter(), span.ends[sense > 0]

    def take(label: Label, locus: BoundaryPoint, mode: Boundary) -> None:
        """Append a point of the boundary to `rows`, and say it with the remaining time."""
        row = _row(family, label, locus, mode, begin["name_of_mode"])
        rows.append(row)
        # largest part of the way so far, as the boundary may turn back
        covered_part = max((row_of_curve["key"] - value) / (end - value) for row_of_curve in rows)
        remaining = ""
        if covered_part > 0:
            # the rest is assumed to take as long in proportion
            elapsed = time.perf_counter() - start_time
            remaining = remaining_time_text(elapsed * (1 / covered_part - 1))
        say(_text_of_row(row, span, family.name) + remaining)

    def curve(m: int, start_point: BoundaryPoint | None = None) -> Boundary:
        """Return the boundary of modes with m waves around a meridian; 0: of the model itself.

        `start_point` is the crossing with another family at which this boundary begins; None if it
        begins at no crossing.
        """
        kind = family.kind_of(m, start_point)
        return Boundary(
            family, family.name, kind, scales, part_journal.recorded, m, family.excludes
        )

    try:
        mode = curve(family.m)
        start = mode.start(value, *family.start)
        if begin["is_first"]:  # another mode at nearly the same load may come before
            mode, start = first_mode(curve, family.mode_at, mode, start)
        rows.append(_row(family, "start", start, mode, begin["name_of_mode"]))
        for label, locus, points_of_curve in critical_boundary(
            curve, family.mode_at, mode, start, sense, span.ends, span.steps
        ):
            take(label, locus, points_of_curve)
    except (BoundaryLost, NoSystem) as e:
        if not rows:  # not even the start
            raise Stopped(str(e)) from None
        return {"rows": rows, "stopped": f"{span.key}: {e}", "alone": family.has_one_scene}
    return {"rows": rows, "stopped": "", "alone": family.has_one_scene}


def _scene_family(varied_case: VariedCase, value: float, begin: dict[str, Any]) -> SceneFamily:
    """Return the scenes of the case for all values of the key, about the instability at the start.

    Parameters
    ----------
    value
        Value of the key at the start, in the unit of the range.
    begin
        The instability at the start.

    Raises
    ------
    CaseError
        If the key has no influence, or the instability cannot be followed.
    """
    span, scene = varied_case.span, Scene(varied_case.problem(value), MPI.COMM_SELF)
    u = vector_of(begin["u"])
    # only the state of the point is known, and needed
    point = Point(
        State(u, begin["mu"]), s=0.0, du=0.0 * u, dmu=0.0, negative_pivots=0, negative_pivots_held=0
    )
    record = Record(begin["label"], begin["amplitude"], point, begin["mode"], step=begin["step"])
    try:
        return SceneFamily(scene, record, varied_case.problem, value, value_range=span.ends)
    except (CaseError, NoSystem) as e:
        raise CaseError(f"--over {span.key}: {e}") from None


def _text_of_row(row: dict[str, Any], span: VariedKey, name: str) -> str:
    """Return a row of boundary.csv as a line of text.

    Parameters
    ----------
    span
        Range of the key.
    name
        The amplitude of the load.
    """
    other_modes = f", {row['unstable']} other unstable" if row["unstable"] else ""
    key_text = f"{row['key']:.9g} {span.unit}".rstrip()
    return f"{span.key} = {key_text}: {row['kind']} at {load_text(row, name)}{other_modes}"


def _row(
    family: SceneFamily, label: Label, locus: BoundaryPoint, mode: Boundary, name_of_mode: str
) -> dict[str, Any]:
    """Return a row of boundary.csv.

    The unstable directions do not count the modes that are neutral at the point.

    Parameters
    ----------
    family
        The scenes of the boundary; its `m` is the number of waves of the mode that is followed, 0
        for a mode of the model itself.
    label
        "start", or the label of the point on the boundary.
    locus
        The point. At a crossing `locus.met` is the number of waves of the other family that is
        neutral there.
    mode
        The boundary that the point is on, with `m` waves.
    name_of_mode
        Name of the model's own mode, as in path.csv of the case.
    """
    # at a crossing two families are neutral: this boundary's and the one that it meets, whose
    # neutral mode counts as unstable there
    is_crossing = label == "crossing"
    wave_numbers = sorted({mode.m, locus.met} if is_crossing else {mode.m})
    unstable = locus.unstable - (locus.unstable_of(locus.met) if is_crossing else 0)
    # the model's own mode (0 waves) has its name if it is the one that is followed; where it
    # crosses a mode with waves, its kind ("fold" or "bifurcation") stands for it
    mode_name = "" if family.m else name_of_mode
    if len(wave_numbers) > 1 and not wave_numbers[0]:
        mode_name = family.kind_of(0, locus)
    return {
        "key": float(locus.p),
        **_load(family.name, locus.state.mu[family.name], family.problem(locus.p)),
        "kind": label if label in SPECIAL else mode.kind,
        "mode": ", ".join(wave_label(m) if m else mode_name for m in wave_numbers),
        "error": float(locus.load_error),
        "unstable": int(unstable),
        "factorisations": int(locus.factorisations),
    }


def _load(name: str, value: float, problem: Problem) -> dict[str, float]:
    """Return the columns of a load: `load`, and the load in the case's units if it has any."""
    # column in units -> number; empty for a case without units
    in_units = sizes_in_units(problem).values({amplitude(name).column: value})
    return {"load": float(value), **{column: float(number) for column, number in in_units.items()}}


def _put_together(
    outcomes: dict[int, dict[str, Any]],
    begin: dict[str, Any],
    span: VariedKey,
    name: str,
    settings: Sequence[str],
    start: str,
) -> StabilityBoundary:
    """Join both directions of the boundary into one curve; return it with its description.

    Parameters
    ----------
    outcomes
        Direction (-1 or 1) -> what `_followed` returns.
    begin
        The instability at the start, with its `name_of_mode`.
    name
        Name of the case file.
    start
        Run and point at which the boundary starts, DIR:POINT; "" for the case's first instability.
    """
    # a direction is missing where the start is at that end of the range
    down, up = (outcomes.get(sense, {"rows": [], "stopped": ""}) for sense in (-1, 1))
    # both directions begin with the start, which is taken once
    first_of_up = 1 if down["rows"] else 0
    rows = [*reversed(down["rows"]), *up["rows"][first_of_up:]]
    special = [row for row in rows if row["kind"] in SPECIAL]
    stopped = [outcome["stopped"] for outcome in (down, up) if outcome["stopped"]]
    sentences = [_sentence_of_special(row, span, begin["amplitude"]) for row in special]
    if not stopped:
        sentences += _sentences_of_unreached_ends(rows, span)
    content = {
        "case": name,
        "settings": list(settings),
        "start": start,
        "key": span.key,
        "unit": span.unit,
        "from": span.first,
        "to": span.last,
        "load": begin["amplitude"],
        "kind": begin["label"],
        "mode": begin["name_of_mode"],
        "points": len(rows),
        "special": special,
        "said": sentences
        or [f"no cusp between {span.text(span.first)} and {span.text(span.last)}"],
        "factorisations": {
            "run": begin["factorisations"],
            "boundary": sum(row["factorisations"] for row in rows),
        },
        "stopped": stopped,
    }
    return StabilityBoundary(rows, content)


def _sentence_of_special(row: dict[str, Any], span: VariedKey, name: str) -> str:
    """Describe a special point of the boundary, such as a cusp, in words.

    Parameters
    ----------
    row
        Its row of boundary.csv.
    span
        Range of the key.
    name
        The amplitude of the load.
    """
    place = f"{span.key} = {row['key']:.9g} {span.unit}".rstrip()
    # a crossing with a fold has its kind as the name of a mode
    words = CHANGED if "fold" in row["mode"] else WORDS_OF_KINDS[row["kind"]]
    modes = f", {row['mode']}" if row["kind"] == "crossing" else ""
    return f"{place}, {load_text(row, name)}: {words}{modes}"


def _sentences_of_unreached_ends(rows: list[dict[str, Any]], span: VariedKey) -> list[str]:
    """Return a sentence for each end of the range that a boundary does not reach.

    If nothing has stopped the boundary, it turns back before such an end.
    """
    sentences = list[str]()
    key_range = min(row["key"] for row in rows), max(row["key"] for row in rows)
    for end, key in zip(span.ends, key_range, strict=True):
        if abs(key - end) > END_TOLERANCE * abs(span.last - span.first):
            sentences.append(
                f"between {span.text(end)} and {span.text(key)} it has no points: it turns back "
                "before"
            )
    return sentences


def _write(stability_boundary: StabilityBoundary, folder: Path) -> None:
    """Write boundary.json, boundary.csv and boundary.png."""
    write_object(folder / "boundary.json", stability_boundary.content)
    write_table(stability_boundary.rows, folder / "boundary.csv", first=COLUMNS)
    draw_boundary(stability_boundary.rows, stability_boundary.content, folder / "boundary.png")
