"""The measurements of a point of a study: repeated runs in separate processes, kept on disk.

A point is a case on a number of ranks. A sample has the times of one run: wall and CPU time of the
process, the phases of summary.json, and the peak memory. An origin has the sources and the mesh
file: keys of summary.json with their values.
"""

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
from magshell_fenicsx.studies.store import keep, stored_outcome

TIMES = ("wall_s", "cpu_s", *PHASES, "peak_mb")
Sample = dict[str, float | None]


@dataclass
class Timings:
    """The measurements of a point of a study on a number of ranks.

    Attributes
    ----------
    machine
        Fingerprint of the machine: processor, cores, memory, BLAS and versions.
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
    """Return the measurements of an earlier study in a file; empty ones if none can be used.

    Parameters
    ----------
    machine
        Fingerprint of this machine, which must have measured them.
    origin
        Keys of summary.json -> values that they must have: sources and mesh file.
    """
    content = _read(file)
    if content is None or content.machine != machine:
        return Timings(machine)
    is_usable = not content.failure and _is_of(origin, content.summary)
    return content if is_usable else Timings(machine)


def of_others(file: Path, origin: Origin) -> bool:
    """Return whether a file has measurements of other sources, which cannot be used."""
    content = _read(file)
    if content is None or content.summary is None:
        return False
    return not _is_of(origin, content.summary)


def _read(file: Path) -> Timings | None:
    """Return the measurements in a file; None if there are none, or they lack times."""
    timings = stored_outcome(file, TypeAdapter(Timings))
    return (
        timings
        if timings and all(sample.keys() >= set(TIMES) for sample in timings.samples)
        else None
    )


def _is_of(origin: Origin, summary: Mapping[str, Any] | None) -> bool:
    """Return whether summary.json is of these sources and mesh file; not if there is none."""
    return summary is not None and all(summary.get(key) == value for key, value in origin.items())


def complete(
    measured: Timings, arguments: Sequence[str], ranks: int, repeat: int, file: Path, origin: Origin
) -> None:
    """Run a point until it has `repeat` samples; every run is on disk before the next.

    Parameters
    ----------
    measured
        The measurements so far, which are changed in place.
    arguments
        The case and its settings, as for `magshell run`.
    ranks
        Number of MPI ranks.
    file
        File that keeps the measurements.
    origin
        Sources and mesh file; if a run is of others, they were changed during the study: a failure.

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
        if measured.first is None:  # it may have compiled kernels, so its times do not count
            measured.first = sample
        elif not measured.failure:
            measured.samples.append(sample)
        keep(file, asdict(measured))


def _run_once(measured: Timings, arguments: Sequence[str], ranks: int) -> Sample:
    """Run a case in a process of its own, and return its times.

    Sets summary and rows of the measurements; without results it sets the failure.
    """
    with TemporaryDirectory() as scratch:
        out = Path(scratch) / "run"
        usage = measure("magshell_fenicsx", ["run", *arguments, "--out", str(out)], ranks)
        try:
            measured.summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
            measured.rows = read_csv(out / "path.csv", dict)
        except OSError:
            measured.summary, measured.rows = None, []
            measured.failure = f"exit code {usage.code}: {usage.last_error or 'no message'}"
    # a failed run has no times of phases
    timing: dict[str, float] = (measured.summary or {}).get("timing", {})
    return {
        "wall_s": usage.wall_s,
        "cpu_s": usage.cpu_s,
        "peak_mb": usage.peak_mb,
        **{key: timing.get(key) for key in PHASES},
    }
