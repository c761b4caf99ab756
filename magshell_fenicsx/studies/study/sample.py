"""The measurements of a point: repeated runs in separate processes, kept on disk."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from mpi4py import MPI

from magshell_fenicsx.output.store.durable import write_whole
from magshell_fenicsx.output.store.folder import by_first
from magshell_fenicsx.studies.study.measure import Usage, measure

PHASES = ("jit_s", "setup_s", "assembly_s", "factor_s", "solve_s", "output_s", "total_s")
TIMES = ("wall_s", "cpu_s", *PHASES, "peak_mb")
Sample = dict[str, float | None]


@dataclass
class Measured:
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


Origin = Mapping[str, str | None]  # the sources and the mesh file: keys of summary.json and their values


def load(file: Path, machine: dict[str, Any], origin: Origin) -> Measured:
    """The usable measurements of an earlier study on this machine; empty without any."""
    kept = _read(file)
    usable = kept and kept.machine == machine and not kept.failure and _is_of(origin, kept.summary)
    return kept if kept and usable else Measured(machine)


def of_others(file: Path, origin: Origin) -> bool:
    """Whether the file has measurements of other sources, which cannot be used."""
    kept = _read(file)
    return kept is not None and kept.summary is not None and not _is_of(origin, kept.summary)


def _read(file: Path) -> Measured | None:
    try:
        found = Measured(**json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError):
        return None
    lists = isinstance(found.samples, list) and isinstance(found.rows, list) and isinstance(found.summary, dict | None)
    sound = lists and all(isinstance(each, dict) and each.keys() >= set(TIMES) for each in found.samples)
    return found if sound and all(isinstance(row, dict) for row in found.rows) else None


def _is_of(origin: Origin, summary: Mapping[str, Any] | None) -> bool:
    return summary is not None and all(summary.get(key) == value for key, value in origin.items())


def complete(measured: Measured, arguments: Sequence[str], ranks: int, repeat: int, file: Path, origin: Origin) -> None:
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
        sample = _run(measured, arguments, ranks)
        if measured.summary is not None and not _is_of(origin, measured.summary):
            measured.failure = "the program or the mesh file was changed during the study"
        if measured.first is None:
            measured.first = sample
        elif not measured.failure:
            measured.samples.append(sample)
        content = (json.dumps(asdict(measured), indent=1) + "\n").encode()
        by_first(MPI.COMM_SELF, partial(write_whole, file, content))


def _run(measured: Measured, arguments: Sequence[str], ranks: int) -> Sample:
    with TemporaryDirectory() as scratch:
        out = Path(scratch) / "run"
        used = measure("magshell_fenicsx", ["run", *arguments, "--out", str(out)], ranks)
        try:
            measured.summary = json.loads((out / "summary.json").read_text(encoding="utf-8"))
            with (out / "path.csv").open(encoding="utf-8", newline="") as stream:
                measured.rows = list(csv.DictReader(stream))
        except OSError:
            measured.summary, measured.rows, measured.failure = None, [], _failure(used)
    timing: dict[str, float] = (measured.summary or {}).get("timing", {})
    return {
        "wall_s": used.wall_s,
        "cpu_s": used.cpu_s,
        "peak_mb": used.peak_mb,
        **{key: timing.get(key) for key in PHASES},
    }


def _failure(used: Usage) -> str:
    errors = used.errors.strip().splitlines()
    return f"exit code {used.code}: {errors[-1] if errors else 'no message'}"
