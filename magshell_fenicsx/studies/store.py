"""The folder of a study: its tables, and the outcomes of its points, which are kept on disk.

A study is any command that runs a case many times, such as a sweep. A point is one of its cases; it
has a key, a hash of its problem. An outcome is what was computed at a point. It is in a file of its
own as soon as it is there, so that an interrupted study goes on. Outcomes of other sources of this
program are not used.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, is_dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Generic, TypeVar

from mpi4py import MPI
from pydantic import TypeAdapter

from magshell_fenicsx.output.store.durable import read_object, write_object
from magshell_fenicsx.output.store.folder import (
    DiskError,
    access_disk,
    locked_folder,
    prepare_folder,
    refuse_other_tables,
)
from magshell_fenicsx.output.store.table import write_csv
from magshell_fenicsx.platform.environment import code_version
from magshell_fenicsx.platform.processes import on_first_rank
from magshell_fenicsx.studies.points import Case, StudyPoint

OutcomeType = TypeVar("OutcomeType")
PointType = TypeVar("PointType", bound=StudyPoint)


@dataclass(frozen=True)
class Folder:
    """The files of a kind of study, such as a sweep, in its folder.

    Attributes
    ----------
    what
        Its name in messages: "an ensemble".
    tables
        Names of the files that the study writes; the first is a JSON object.
    keys
        Keys of that object, by which a folder of such a study is recognised.
    points
        Subfolder of the outcomes.
    first_table
        A table that is created empty at the start, so that an unwritable folder is refused at once.
    """

    what: str
    tables: tuple[str, ...]
    keys: tuple[str, ...]
    points: str = "points"
    first_table: str = ""

    def prepare(self, out: Path, comm: MPI.Comm, case: str = "") -> Path:
        """Make the folder, and return its path; collective. Several jobs may prepare the same one.

        Parameters
        ----------
        case
            Name of the case file; "" if it does not matter.

        Raises
        ------
        CaseError
            On every rank, if the folder has files of others or tables of another case file, or
            cannot be written.
        """

        def make(folder: Path) -> None:
            """Check the folder and make it; called on rank 0."""
            refuse_other_tables(folder, self.tables, self.keys, self.what, case)
            for directory in (folder, folder / self.points):
                directory.mkdir(parents=True, exist_ok=True)
            if self.first_table:
                (folder / self.first_table).touch()

        return prepare_folder(out, comm, make)

    @contextmanager
    def locked(self, out: Path, comm: MPI.Comm, case: str) -> Iterator[None]:
        """Prepare the folder and lock it for this job inside `with`; collective."""
        with locked_folder(out, comm, make=True):
            self.prepare(out, comm, case)
            yield


def keep(file: Path, content: Mapping[str, Any]) -> None:
    """Write an outcome as a JSON file.

    A killed study leaves the complete file or none. Two processes may write the same file.

    Raises
    ------
    DiskError
        For instance if the disk is full; earlier files are kept.
    """
    try:
        write_object(file, content)
    except OSError as e:
        raise DiskError(f"{file} cannot be written: {e.strerror}") from e


def stored_outcome(
    file: Path, kind: TypeAdapter[OutcomeType], key: str = "", **same: Any
) -> OutcomeType | None:
    """Return the outcome in a JSON file, validated as `kind`.

    None if there is no file, it is damaged, or it has other values than `same`.

    Parameters
    ----------
    key
        Key of the outcome in the file; "" for the whole content.
    same
        Keys of the file with the values that they must have.
    """
    try:
        content = read_object(file)
        if any(content[name] != value for name, value in same.items()):
            return None
        return kind.validate_python(content[key] if key else content)
    except (OSError, ValueError, KeyError, TypeError):
        return None


@dataclass(frozen=True)
class OutcomeStore(Generic[OutcomeType]):
    """The outcomes of a study on disk, a JSON file for each key.

    Attributes
    ----------
    folder
        Folder of the files.
    kind
        Type of an outcome: a dataclass, or plain data.
    origin
        What the outcomes depend on beside key and sources: name -> value, which a file must have.
    """

    folder: Path
    kind: type[OutcomeType]
    origin: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def _adapter(self) -> TypeAdapter[OutcomeType]:
        """Validator of outcomes."""
        return TypeAdapter(self.kind)

    def file(self, key: str) -> Path:
        """Return the file of an outcome."""
        return self.folder / f"{key}.json"

    def keep(self, key: str, outcome: OutcomeType, case: Case | None = None) -> None:
        """Write an outcome, with the version of the sources, and if given with its case.

        Raises
        ------
        DiskError
            For instance if the disk is full; earlier files are kept.
        """
        described_case = (
            {"case": case.model_dump(mode="json", exclude_none=True), **case.outside}
            if case is not None
            else {}
        )
        plain = asdict(outcome) if is_dataclass(outcome) else outcome  # type: ignore[arg-type]
        keep(
            self.file(key),
            {**described_case, **self.origin, "sources": code_version(), "outcome": plain},
        )

    def outcome(self, key: str) -> OutcomeType | None:
        """Return an outcome; None unless the present sources have computed it for this origin."""
        return stored_outcome(
            self.file(key), self._adapter, "outcome", sources=code_version(), **self.origin
        )

    def obtain(self, key: str, compute: Callable[[], OutcomeType], comm: MPI.Comm) -> OutcomeType:
        """Return an outcome, stored, or computed by all ranks together and kept; collective."""
        outcome = on_first_rank(comm, lambda: self.outcome(key))
        if outcome is None:
            outcome = compute()
            on_first_rank(comm, partial(self.keep, key, outcome))
        return outcome

    def missing(
        self,
        points: Iterable[PointType],
        comm: MPI.Comm,
        is_sufficient: Callable[[OutcomeType], bool] = lambda outcome: True,
    ) -> list[PointType]:
        """Return the points without an outcome that can be used, of equal ones the first.

        Collective.

        Parameters
        ----------
        is_sufficient
            Whether a stored outcome has what is wanted.
        """

        def is_missing(point: PointType) -> bool:
            """Return whether a point has to be computed; called on rank 0."""
            outcome = self.outcome(point.key)
            return outcome is None or not is_sufficient(outcome)

        first_points = dict[str, PointType]()
        for point in points:
            first_points.setdefault(point.key, point)
        missing_keys = access_disk(
            comm, lambda: {key for key, point in first_points.items() if is_missing(point)}
        )
        return [point for key, point in first_points.items() if key in missing_keys]


def write_table(rows: Iterable[Mapping[str, Any]], file: Path, first: Iterable[str] = ()) -> None:
    """Write rows as a CSV file; a column is empty where a row lacks it.

    Parameters
    ----------
    first
        The first columns. All others follow in the order in which rows have them.
    """
    rows = list(rows)
    columns = dict.fromkeys((*first, *(name for row in rows for name in row)))
    write_csv(rows, tuple(columns), file)
