"""The measurements of a point of a study: repeated runs in separate processes, kept on disk."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from pydantic import TypeAdapter

from magshell_fenicsx.output.store.stored_results import PHASES
from magshell_fenicsx.output.store.table import read_csv
from magshell_fenicsx.platform.processes import measure
from magshell_fenicsx.studies.runner import keep, stored_outcome

TIMES = ("wall_s", "cpu_s", *PHASES, "peak_mb")
Sample = dict[str, float | None]


@dataclass
class Timings:
    """The measurements of a point.

    Attributes
    ----------
    machine
        The machine, see `fingerprint`.
    first
        The first run, which may compile kernels; it is not among the samples.
    samples
        One for each further run, with the keys `TIMES`.
    summary, rows
        summary.json and path.csv of the last run; None and empty if it left none.
    failure
        Why a run left no results; None otherwise.
    """

    machine: dict[str, Any]
    first: Sample | None = None
    samples: list[Sample] = field(default_factory=list)
    summary: dict[str, Any] | None = None
    rows: list[dict[str, str]] = field(default_factory=list)
    failure: str | None = None

    def typical(self, key: str) -> float | None:
        """Median over the samples; None if no sample has the key."""
        values = [value for sample in self.samples if (value := sample[key]) is not None]
        return median(values) if values else None


# the sources and the mesh file: keys of summary.json and their values
Origin = Mapping[str, str | None]


def load(file: Path, machine: dict[str, Any], origin: Origin) -> Timings:
    """The usable measurements of an earlier study on this machine; empty without any."""
    content = _read(file)
    usable = (
        content
        and content.machine == machine
        and not content.failure
        and _is_of(origin, content.summary)
    )
    return content if content and usable else Timings(machine)


def of_others(file: Path, origin: Origin) -> bool:
    """Whether the file has measurements of other sources, which cannot be used."""
    content = _read(file)
    return (
        content is not None and content.summary is not None and not _is_of(origin, content.summary)
    )


def _read(file: Path) -> Timings | None:
    timings = stored_outcome(file, TypeAdapter(Timings))
    return (
        timings
        if timings and all(sample.keys() >= set(TIMES) for sample in timings.samples)
        else None
    )


def _is_of(origin: Origin, summary: Mapping[str, Any] | None) -> bool:
    return summary is not None and all(summary.get(key) == value for key, value in origin.items())


def complete(
    measured: Timings, arguments: Sequence[str], ranks: int, repeat: int, file: Path, origin: Origin
) -> None:
    """Run until there are `repeat` samples; every run is on disk before the next.

    Parameters
    ----------
    arguments
        The case and its settings, as for `magshell run`.

    Raises
    ------
    DiskError
        If the disk is full; earlier files are kept.
    """
    while not measured.failure and len(measured.samples) < repeat:
        sample = _run_once(measured, arguments, ranks)
        if measured.summary is not None and not _is_of(origin, measured.summary):
            measured.summary, measured.rows = None, []
            measured.failure = "the program or the mesh file was changed during the study"
        if measured.first is None:
            measured.first = sample
        elif not measured.failure:
            measured.samples.append(sample)
        keep(file, asdict(measured))


def _run_once(measured: Timings, arguments: Sequence[str], ranks: int) -> Sample:
    with TemporaryDirectory() as scratch:
        out = Path(scratch) / "run"
        used = measure("magshell_fenicsx", ["run", *arguments, "--out", str(out)], ranks)
        try:
            measured.summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
            measured.rows = read_csv(out / "path.csv", dict)
        except OSError:
            measured.summary, measured.rows = None, []
            measured.failure = f"exit code {used.code}: {used.last_error or 'no message'}"
    timing: dict[str, float] = (measured.summary or {}).get("timing", {})
    return {
        "wall_s": used.wall_s,
        "cpu_s": used.cpu_s,
        "peak_mb": used.peak_mb,
        **{key: timing.get(key) for key in PHASES},
    }
