"""A case over ranges of its keys; the ranks share the points, and existing points are kept."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mpi4py import MPI

from magshell_fenicsx.case.source import CaseError
from magshell_fenicsx.output.store.folder import by_first, prepare_folder
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.studies.sweep.axes import Axis, parse_axes
from magshell_fenicsx.studies.sweep.chain import Known, make_chains, run_chain
from magshell_fenicsx.studies.sweep.deal import deal, together
from magshell_fenicsx.studies.sweep.outcome import Outcome, load, save
from magshell_fenicsx.studies.sweep.points import SweepPoint, identity, make_points
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
) -> Sweep:
    """Run a case at all points of a product; collective, and every rank works.

    If the result is a knockdown (`loading: {kind: pressure, until: limit}`), one path is computed up to its fold, and
    then the fold is followed along the last axis with numbers; see `Continuation`.

    Parameters
    ----------
    over
        `key.path=start:stop:count` or `key.path=value,value`; keys tied with `+`.
    out
        Folder of sweep.csv, sweep.png and points/; existing points are kept if these sources computed them.
    say
        Called with one line per finished point, on the rank that finished it.
    full_paths
        Compute the full path at every point.

    Raises
    ------
    CaseError
        Before the first point, if a point is not a valid case or `out` cannot be written; or if the mesh file changes.
    DiskError
        If the tables cannot be written.
    """
    axes = parse_axes(over)
    points = make_points(Path(file), axes, settings)
    folder = prepare_folder(Path(out), comm, _ready)
    files = [folder / "points" / f"{point.key}.json" for point in points]
    missing = by_first(comm, lambda: _missing(points, files), "cannot be read")
    if comm.rank == 0:
        say(f"{len(points)} points, {len(missing)} to compute on {comm.size} rank{'s' if comm.size > 1 else ''}")
        if again := sum(files[number].exists() for number in missing):
            say(f"{again} of these computed again: their files are of other sources of magshell_fenicsx, or damaged")
    chains = make_chains(axes, points, missing, full_paths=full_paths)
    known = Known()
    with together(comm):
        for chain in deal(len(chains), comm):
            for number, outcome in run_chain(chains[chain], known):
                if identity(points[number].case) != points[number].key:
                    raise CaseError(f"{file}: its mesh file was changed during the sweep; start it again")
                save(outcome, points[number].case, files[number])
                place = f"{missing.index(number) + 1:4d}/{len(missing)}"
                say(f"{place}  {points[number].label}: {_result(outcome)}, {outcome.wall_s:.1f} s")
    outcomes = [found for result in files if (found := load(result))]
    assert len(outcomes) == len(points)

    def write() -> None:
        write_sweep(points, outcomes, folder / "sweep.csv")
        write_curves(points, outcomes, folder / "curves.csv")
        draw_sweep(axes, points, outcomes, folder / "sweep.png")

    by_first(comm, write)
    return Sweep(axes, points, outcomes)


def _missing(points: Sequence[SweepPoint], files: Sequence[Path]) -> list[int]:
    """Numbers of the points to compute; only the first of equal points."""
    first = {point.key: i for i, point in reversed(list(enumerate(points)))}
    return sorted(i for i in first.values() if load(files[i]) is None)


def _ready(out: Path) -> None:
    (out / "points").mkdir(parents=True, exist_ok=True)
    (out / "sweep.csv").touch()


def _result(outcome: Outcome) -> str:
    found = "no limit point"
    if outcome.knockdown is not None:
        found = f"k_d = {outcome.knockdown:.6f} ({outcome.found})"
    elif outcome.barrier is not None:
        found = f"barrier = {outcome.barrier:.6g} E h R^2"
    elif outcome.limit:
        found = f"{outcome.limit['kind']} at {outcome.limit['amplitude']} = {outcome.limit['value']:.6g}"
    return f"{found}, stopped early: {outcome.stopped}" if outcome.stopped else found
