"""Random samples of a case; the ranks share them, existing ones are kept."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.input.source import CaseError, read_source
from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.folder import by_first, given_folder, prepare_folder, refuse_others
from magshell_fenicsx.platform import sources
from magshell_fenicsx.platform.first import from_first
from magshell_fenicsx.platform.terminal import print_line
from magshell_fenicsx.studies.ensemble.known import KnownFolds
from magshell_fenicsx.studies.ensemble.picture import draw_ensemble
from magshell_fenicsx.studies.ensemble.report import report
from magshell_fenicsx.studies.ensemble.samples import Sample, make_samples
from magshell_fenicsx.studies.ensemble.solve import FAILED, serves, solve
from magshell_fenicsx.studies.ensemble.statistics import statistics
from magshell_fenicsx.studies.ensemble.table import WITHOUT, Row, make_row, value, write_samples
from magshell_fenicsx.studies.study.scalar import Scalar, parse_scalar
from magshell_fenicsx.studies.sweep.deal import deal, together
from magshell_fenicsx.studies.sweep.outcome import Outcome, load, save

MOST_SAMPLES = 100_000


@dataclass(frozen=True)
class Ensemble:
    """A finished ensemble: the rows of samples.csv, and the content of summary.json."""

    rows: list[Row]
    content: dict[str, Any]

    @property
    def without_result(self) -> int:
        """Number of samples without the requested result."""
        return sum(row["status"] != "found" for row in self.rows)


def ensemble(
    file: Path | str,
    settings: Sequence[str] = (),
    *,
    samples: int,
    seed: int,
    result: str = "knockdown",
    out: Path | str = "results/ensemble",
    part: str | None = None,
    merge: Sequence[Path | str] = (),
    delete_weakest: int = 0,
    resume: bool = False,
    comm: MPI.Intracomm = MPI.COMM_WORLD,
    say: Callable[[str], None] = print_line,
) -> Ensemble:
    """Compute random samples of a case; collective, and every rank computes samples of its own.

    Parameters
    ----------
    result
        As of `magshell study`: knockdown, barrier, critical_field, COLUMN@COLUMN=VALUE or COLUMN@end.
    out
        Folder of samples.csv, summary.json, ensemble.png, report.md and points/; samples that are there are kept
        if these sources computed them.
    part
        "i/n": compute only every n-th sample, from the i-th; the files are then samples_i_of_n.csv and so on.
    merge
        Folders of parts: take their samples, compute none.
    delete_weakest
        Also compute each sample without so many of its defects, those with the least amplitudes.
    resume
        See that the folder has samples of this ensemble.
    say
        Called with one line per finished sample, on the rank that finished it.

    Raises
    ------
    CaseError
        Before the first sample: if one is no valid case, an argument is wrong, or `out` cannot be written.
    DiskError
        If the tables cannot be written.
    """
    scalar, numbers, ending = parse_scalar(result), _numbers(samples, seed, part), _ending(part)

    def drawn() -> list[list[Sample]]:
        source = read_source(Path(file), settings)
        return [make_samples(source, seed, numbers, less) for less in ([0, delete_weakest] if delete_weakest else [0])]

    variants = from_first(comm, drawn)
    every = {sample.key: sample for variant in variants for sample in variant}
    folder, name = given_folder(out), Path(file).name
    if resume or merge:
        places = [Path(place) for place in merge] or [folder]
        by_first(comm, lambda: _refuse_strange(places, every), "cannot be read")

    def ready(out: Path) -> None:
        tables = (f"summary{ending}.json", f"samples{ending}.csv", f"ensemble{ending}.png", f"report{ending}.md")
        refuse_others(out, tables, ("seed", "samples"), "an ensemble", name)
        (out / "points").mkdir(parents=True, exist_ok=True)

    prepare_folder(folder, comm, ready)
    if merge:
        by_first(comm, lambda: _copy(every, [Path(place) for place in merge], folder))
    missing = (
        []
        if merge
        else by_first(comm, lambda: [key for key in every if _known(folder, key, scalar) is None], "cannot be read")
    )
    if comm.rank == 0:
        ranks = f"{comm.size} rank{'s' if comm.size > 1 else ''}"
        say(f"{len(every)} samples, {len(missing)} to compute on {ranks}")
    _compute([every[key] for key in missing], scalar, folder, comm, say)
    rows = [_row(each, folder, scalar) for each in zip(*variants, strict=True)]
    content = {
        "case": name,
        "settings": list(settings),
        "seed": seed,
        "samples": samples,
        "part": part,
        "result": result,
        "deleted": delete_weakest,
        "sources": sources.ours(),
        **by_first(comm, lambda: statistics(rows, seed)),
    }
    by_first(comm, lambda: _write(rows, content, folder, ending))
    return Ensemble(rows, content)


def _compute(
    samples: Sequence[Sample], scalar: Scalar, folder: Path, comm: MPI.Intracomm, say: Callable[[str], None]
) -> None:
    known = KnownFolds()
    with together(comm):
        for i in deal(len(samples), comm):
            sample = samples[i]
            outcome = solve(sample, scalar, known)
            save(outcome, sample.case, _file(folder, sample.key))
            found = value(outcome, scalar)
            told = f"no {scalar.name}" if found is None else f"{scalar.name} = {found:.9g} ({outcome.found})"
            why = f", {outcome.stopped}" if outcome.stopped else ""
            say(f"{i + 1:5d}/{len(samples)}  sample {sample.number}: {told}{why}, {outcome.cpu_s:.1f} s")


def _numbers(samples: int, seed: int, part: str | None) -> range:
    """The numbers of the samples to compute."""
    if not 1 <= samples <= MOST_SAMPLES:
        raise CaseError(f"--samples {samples}: must be 1 to {MOST_SAMPLES}")
    if seed < 0:
        raise CaseError(f"--seed {seed}: must not be negative")
    if part is None:
        return range(samples)
    first, slash, count = part.partition("/")
    if not (slash and first.isdecimal() and count.isdecimal() and 1 <= int(first) <= int(count) <= samples):
        raise CaseError(f"--part {part}: write it as i/n with 1 <= i <= n, and n at most the number of samples")
    return range(int(first) - 1, samples, int(count))


def _ending(part: str | None) -> str:
    return f"_{part.replace('/', '_of_')}" if part else ""


def _file(folder: Path, key: str) -> Path:
    return folder / "points" / f"{key}.json"


def _known(folder: Path, key: str, scalar: Scalar) -> Outcome | None:
    """A usable outcome in the folder; an error may have been of the machine, and is tried again."""
    found = load(_file(folder, key))
    failed = found and (found.stopped or "").startswith(FAILED)
    return found if found and serves(found, scalar) and not failed else None


def _refuse_strange(places: Sequence[Path], every: dict[str, Sample]) -> None:
    for place in places:
        if not any(load(_file(place, key)) for key in every):
            raise CaseError(
                f"{place}: has no sample of this ensemble that these sources computed: look at case, --seed and --set"
            )


def _copy(every: dict[str, Sample], places: Sequence[Path], folder: Path) -> None:
    for key in every:
        source = next((file for place in places if load(file := _file(place, key))), None)
        if source and source.resolve() != _file(folder, key).resolve():
            write_whole(_file(folder, key), source.read_bytes())


def _row(variants: Sequence[Sample], folder: Path, scalar: Scalar) -> Row:
    """The row of a sample; with a second variant, the one without its weakest defects, also the result of that."""
    outcomes = [load(_file(folder, sample.key)) for sample in variants]
    row = make_row(variants[0], outcomes[0], scalar)
    if len(variants) > 1:
        row[WITHOUT] = value(outcomes[1], scalar)
        if row["status"] == "found" and row[WITHOUT] is None:
            less = make_row(variants[1], outcomes[1], scalar)
            row |= {"status": less["status"], "why": f"without the weakest defects: {less['why']}"}
    return row


def _write(rows: Sequence[Row], content: dict[str, Any], folder: Path, ending: str) -> None:
    write_samples(rows, folder / f"samples{ending}.csv")
    write_whole(folder / f"summary{ending}.json", (json.dumps(content, indent=1) + "\n").encode())
    draw_ensemble(rows, content["result"], folder / f"ensemble{ending}.png")
    text = report(content, rows)
    if ending:
        text = text.replace("(ensemble.png)", f"(ensemble{ending}.png)").replace("samples.csv", f"samples{ending}.csv")
    write_whole(folder / f"report{ending}.md", text.encode())
