"""A case over ranges of its keys; the ranks share the points, and existing points are kept."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mpi4py import MPI

from magshell_fenicsx.input.source import CaseError
from magshell_fenicsx.output.store.folder import by_first, given_folder, prepare_folder, refuse_others
from magshell_fenicsx.platform.first import from_first
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.studies.sweep.axes import Axis, parse_axes
from magshell_fenicsx.studies.sweep.chain import Known, make_chains, run_chain
from magshell_fenicsx.studies.sweep.deal import deal, together
from magshell_fenicsx.studies.sweep.earlier import NAME, TABLE, with_earlier
from magshell_fenicsx.studies.sweep.outcome import Outcome, load, save
from magshell_fenicsx.studies.sweep.points import SweepPoint, make_points, swept_source
from magshell_fenicsx.studies.sweep.sweep_plot import draw_sweep
from magshell_fenicsx.studies.sweep.table import write_curves, write_sweep


@dataclass(frozen=True)
class Sweep:
    """A finished sweep: its points in product order, and their outcomes."""

    axes: list[Axis]
    points: list[SweepPoint]
    outcomes: list[Outcome]

    @property
    def stopped(self) -> int:
        """Number of points that ended before their target."""
        return sum(outcome.stopped is not None for outcome in self.outcomes)


def sweep(
    file: Path | str,
    over: Sequence[str],
    settings: Sequence[str] = (),
    out: Path | str = "results/sweep",
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    say: Callable[[str], None] = print_line,
    *,
    full_paths: bool = False,
    part: str | None = None,
) -> Sweep:
    """Run a case at all points of a product; collective, and every rank works.

    If the result is a knockdown (`loading: {kind: pressure, until: limit}`), one path is computed up to its fold, and
    then the fold is followed along the last axis with numbers; see `Continuation`.

    Parameters
    ----------
    over
        `key.path=start:stop:count` or `key.path=value,value`; keys tied with `+`.
    out
        Folder of sweep.csv, sweep.png and points/; existing points are kept if these sources computed them. Tables and
        picture have the points of earlier sweeps over the same keys too.
    say
        Called with one line per finished point, on the rank that finished it.
    full_paths
        Compute the full path at every point.
    part
        "i/n": compute only the i-th of n equal shares of the points; several jobs may share one folder.

    Raises
    ------
    CaseError
        Before the first point, if a point is not a valid case, or `out` cannot be written or has another sweep.
    DiskError
        If the tables cannot be written.
    """
    axes = parse_axes(over)
    source = from_first(comm, lambda: swept_source(Path(file), axes, settings))
    asked = from_first(comm, lambda: make_points(Path(file), axes, settings))
    share = share_of(part, len(asked))
    folder = prepare_folder(given_folder(out), comm, _ready)
    points = by_first(comm, lambda: with_earlier(folder, source, axes, asked))
    before = len(points) - len(asked)
    files = [folder / "points" / f"{point.key}.json" for point in points]
    missing = by_first(comm, lambda: _missing(points, files), "cannot be read")
    if part:
        missing = [number for number in missing if number - before in share]
    if comm.rank == 0:
        also = f" and {before} there" if before else ""
        ranks = f"{comm.size} rank{'s' if comm.size > 1 else ''}"
        say(f"{len(asked)} points{also}, {len(missing)} to compute on {ranks}")
        if again := sum(files[number].exists() for number in missing):
            say(f"{again} of these computed again: their files are of other sources of magshell_fenicsx, or damaged")
    chains = make_chains(axes, points, missing, full_paths=full_paths)
    shared = Known()
    with together(comm):
        for chain in deal(len(chains), comm):
            for number, outcome in run_chain(chains[chain], shared):
                save(outcome, points[number].case, files[number])
                place = f"{missing.index(number) + 1:4d}/{len(missing)}"
                say(f"{place}  {points[number].label}: {_result(outcome)}, {outcome.wall_s:.1f} s")
    found = [(point, known) for point, file in zip(points, files, strict=True) if (known := load(file))]
    assert part or len(found) == len(points)
    if comm.rank == 0 and len(found) < len(points):
        say(f"{len(points) - len(found)} of {len(points)} points are left to other parts")

    def write() -> None:
        done, outcomes = [point for point, _ in found], [outcome for _, outcome in found]
        write_sweep(axes, done, outcomes, folder / "sweep.csv")
        write_curves(done, outcomes, folder / "curves.csv")
        draw_sweep(axes, done, outcomes, folder / "sweep.png")

    if found:
        by_first(comm, write)
    mine = {id(point) for i, point in enumerate(asked) if not part or i in share}
    kept = [(point, outcome) for point, outcome in found if id(point) in mine]
    return Sweep(axes, [point for point, _ in kept], [outcome for _, outcome in kept])


def share_of(part: str | None, count: int) -> range:
    """The numbers of the points of a part "i/n": neighbours, whose folds can be followed.

    Examples
    --------
    >>> share_of("1/2", 5), share_of("2/2", 5)
    (range(0, 2), range(2, 5))
    """
    first, slash, number = (part or "1/1").partition("/")
    if not (slash and first.isdecimal() and number.isdecimal() and 1 <= int(first) <= int(number) <= count):
        raise CaseError(f"--part {part}: write it as i/n with 1 <= i <= n, and n at most the number of points")
    i, n = int(first), int(number)
    return range((i - 1) * count // n, i * count // n)


def _missing(points: Sequence[SweepPoint], files: Sequence[Path]) -> list[int]:
    """Numbers of the points to compute; only the first of equal points."""
    first = {point.key: i for i, point in reversed(list(enumerate(points)))}
    return sorted(i for i in first.values() if load(files[i]) is None)


def _ready(out: Path) -> None:
    refuse_others(out, (NAME, TABLE, "curves.csv", "sweep.png"), ("keys", "base", "points"), "a sweep")
    for folder in (out, out / "points"):
        folder.mkdir(parents=True, exist_ok=True)
    (out / TABLE).touch()


def _result(outcome: Outcome) -> str:
    found = "no limit point"
    if outcome.knockdown is not None:
        pascals = outcome.in_units.get("buckling_pressure_Pa")
        found = f"k_d = {outcome.knockdown:.6f}{f', {pascals:.6g} Pa' if pascals else ''} ({outcome.found})"
    elif outcome.barrier is not None:
        found = f"barrier = {outcome.barrier:.6g} E h R^2"
    elif outcome.limit:
        found = f"{outcome.limit['kind']} at {outcome.limit['amplitude']} = {outcome.limit['value']:.6g}"
    return f"{found}, stopped early: {outcome.stopped}" if outcome.stopped else found
